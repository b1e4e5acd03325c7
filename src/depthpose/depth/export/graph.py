"""The networks of this room as one ONNX graph, with all that the estimator does around them.

Sizes stay free: the graph computes them from the images that it is given. Networks come from
``torch.export``; what stands around them (the virtual rig, padding, and the way back) is written
in operators, because sizes there depend on a focal length, which no exporter follows.
"""

from typing import Any

import numpy as np
import torch

from depthpose.core.errors import InputError
from depthpose.core.export import Graph, Value, network_model
from depthpose.depth.config import GeneratorConfig
from depthpose.depth.estimator.sky import BRIGHT, PLAIN, SHARE
from depthpose.depth.export.network import SizelessPSMNet
from depthpose.depth.stereo.psmnet import PSMNet
from depthpose.depth.stereo.psmnet_matcher import IMAGENET_MEAN, IMAGENET_STD
from depthpose.depth.synthesis import UNetGenerator
from depthpose.depth.synthesis.synthesiser import COLUMNS_SHARE, ROWS_SHARE
from depthpose.depth.weights import DepthWeights

_IMAGES = ("batch", 3, "height", "width")
_MAPS = ("batch", "height", "width")


def image_graph(weights: DepthWeights) -> Graph:
    """Write one image to depth: what ``FakestereoNet.estimate`` does without a right view.

    Inputs ``image`` (batch, 3, height, width; RGB in [0, 1]) and ``K`` (3, 3; float64, of all
    images). Outputs ``depth_m``, ``disparity_px`` (of the imitated rig, in the image's pixels),
    ``confidence`` (each batch, height, width) and ``right``, the drawn view.

    Raises:
        InputError: a network is missing, or the generator draws by chance.
    """
    generator, matcher = weights.generator, weights.matcher
    if generator is None or matcher is None:
        raise InputError(
            f"depth from one image needs a generator and a matcher, and these weights lack the "
            f"{'generator' if generator is None else 'matcher'}; 'depthpose weights pack' makes "
            "one file of both."
        )
    rig = generator.config
    if rig.test_mode != "running":
        raise InputError(
            "the generator's test_mode is 'batch': it draws with dropout, other views each time, "
            "which a file cannot be held to; export weights whose test_mode is 'running'."
        )
    graph = Graph()
    image = graph.input("image", np.float32, _IMAGES)
    K = graph.input("K", np.float64, (3, 3))
    full = _size(image)
    small = _focal_size(full, _focal_yx(K), rig.virtual_focal_px)
    left = _resized_image(image, small)
    right = _drawn(left, small, generator)
    focal_yx = np.array([rig.virtual_focal_px] * 2)
    found = [_resized_map(m, full) for m in _matched(left, right, focal_yx, matcher)]
    disparity_px = found[0] * _ratio(full, small)
    confidence = _lowered_in_sky(found[1], image)
    _output_maps(graph, _depth(disparity_px, K, rig), disparity_px, confidence)
    graph.output("right", _resized_image(right, full), np.float32, _IMAGES)
    return graph


def pair_graph(weights: DepthWeights) -> Graph:
    """Write a rectified pair to disparity: what ``FakestereoNet.estimate`` does with ``right=``.

    Inputs ``left`` and ``right`` (batch, 3, height, width; RGB in [0, 1]), and ``K`` (3, 3;
    float64) where the weights were trained at one focal length. Outputs ``disparity_px`` and
    ``confidence`` (batch, height, width). Depth is ``fx * baseline / disparity``.

    Raises:
        InputError: there is no matcher in the weights.
    """
    matcher = weights.matcher
    if matcher is None:
        raise InputError("these weights hold no matcher, only a generator; give a matcher's.")
    graph = Graph()
    left = graph.input("left", np.float32, _IMAGES)
    right = graph.input("right", np.float32, _IMAGES)
    focal_yx = None
    if matcher.config.work_focal_px is not None:
        focal_yx = _focal_yx(graph.input("K", np.float64, (3, 3)))
    _output_maps(graph, None, *_matched(left, right, focal_yx, matcher))
    return graph


def _drawn(left: Value, size: Value, generator: UNetGenerator) -> Value:
    """What ``draw_right`` does: near a multiple stretched to it, else mirrored up to one."""
    multiple = generator.config.side_multiple_px
    sides = size.cast(np.float64)
    nearest = (sides / float(multiple)).op("Round").op("Max", 1.0) * float(multiple)
    off = (nearest - sides).op("Abs")
    is_near = off.op("LessOrEqual", sides * np.array([ROWS_SHARE, COLUMNS_SHARE]))
    stretched = is_near.op("Where", nearest, sides).cast(np.int64)
    image = _resized_image(left, stretched) * np.float32(2) - np.float32(1)
    lacking = (stretched + (multiple - 1)) / multiple * multiple - stretched
    mirrored = image.op("Pad", _pads(left, after=lacking), mode="reflect")
    example = torch.zeros(2, 3, 2 * multiple, 3 * multiple)
    (drawn,) = left.graph.call(network_model(generator, [example], multiple), mirrored)
    cropped = (drawn + np.float32(1)).slice([0, 0], stretched, [2, 3]) / np.float32(2)
    return _resized_image(cropped, size)


def _matched(
    left: Value, right: Value, focal_yx: Value | np.ndarray | None, matcher: PSMNet
) -> tuple[Value, Value]:
    """Match at the focal length that the weights want, and come back to the images' size."""
    size = work = _size(left)
    if matcher.config.work_focal_px is not None:
        work = _focal_size(size, focal_yx, matcher.config.work_focal_px)
    least = matcher.config.min_side_px
    lacking = ((work + 15) / 16 * 16).op("Max", least) - work
    rows, columns = lacking.slice([0], [1], [0]), lacking.slice([1], [2], [0])
    pads = _pads(left, before=_joined(rows, 0), after=_joined(0, columns))
    mean, deviation = (
        np.array(v, np.float32)[:, None, None] for v in (IMAGENET_MEAN, IMAGENET_STD)
    )
    padded = [
        ((_resized_image(view, work) - mean) / deviation).op("Pad", pads) for view in (left, right)
    ]
    network = SizelessPSMNet(matcher).eval()
    example = [torch.rand(2, 3, least + 16, least + 32) for _ in range(2)]
    found = left.graph.call(network_model(network, example, 16), *padded)
    whole = 1 << 62
    found = [m.slice(_joined(rows, 0), _joined(whole, work.slice([1], [2], [0])), [1, 2])
             for m in found]  # fmt: skip
    disparity_px, confidence = (_resized_map(m, size) for m in found)
    return disparity_px * _ratio(size, work), confidence


def _depth(disparity_px: Value, K: Value, rig: GeneratorConfig) -> Value:
    fx = K.op("Reshape", [-1]).op("Gather", 0).cast(np.float32)
    depth_m = (fx * np.float32(rig.virtual_baseline_m)) / disparity_px
    return disparity_px.op("Greater", np.float32(0)).op("Where", depth_m, np.float32(np.nan))


def _lowered_in_sky(confidence: Value, image: Value) -> Value:
    """What ``lower_in_sky`` does."""
    value = image.op("ReduceMax", [1], keepdims=1)
    most, least = (one.op("MaxPool", kernel_shape=[3, 3], pads=[1] * 4)
                   for one in (value, value.op("Neg")))  # fmt: skip
    is_dark = value.op("LessOrEqual", np.float32(BRIGHT))
    is_other = is_dark.op("Or", (most + least).op("GreaterOrEqual", np.float32(PLAIN)))
    is_sky = is_other.cast(np.float32).op("CumSum", 2).op("Equal", np.float32(0))
    return is_sky.op("Squeeze", [1]).op("Where", confidence * np.float32(SHARE), confidence)


def _output_maps(graph: Graph, *maps: Value | None) -> None:
    for name, values in zip(("depth_m", "disparity_px", "confidence"), maps, strict=True):
        if values is not None:
            graph.output(name, values, np.float32, _MAPS)


def _size(image: Value) -> Value:
    """Rows and columns."""
    return image.op("Shape", start=2, end=4)


def _focal_yx(K: Value) -> Value:
    """Focal lengths of rows and of columns [px]."""
    return K.op("Reshape", [-1]).op("Gather", [4, 0])


def _focal_size(size: Value, focal_yx: Any, wanted_px: float) -> Value:  # noqa: ANN401
    """Rows and columns at which an image has the wanted focal length."""
    scaled = (size.cast(np.float64) * float(wanted_px)) / focal_yx
    return scaled.op("Round").op("Max", 1.0).cast(np.int64)


def _resized_image(image: Value, size: Value) -> Value:
    resized = image.op("Resize", None, None, size, mode="linear", axes=[2, 3],
                       antialias=1, exclude_outside=1)  # fmt: skip
    return resized.op("Clip", np.float32(0), np.float32(1))


def _resized_map(values: Value, size: Value) -> Value:
    lifted = values.op("Unsqueeze", [1])
    return lifted.op("Resize", None, None, size, mode="linear", axes=[2, 3]).op("Squeeze", [1])


def _ratio(wide: Value, narrow: Value) -> Value:
    """How many times as wide, for disparities."""
    many, few = (size.slice([1], [2], [0]).cast(np.float64) for size in (wide, narrow))
    return (many / few).cast(np.float32)


def _joined(*sides: Any) -> Value:  # noqa: ANN401
    """Put sides one after the other; one at least is a value."""
    graph = next(side.graph for side in sides if isinstance(side, Value))
    parts = [side if isinstance(side, Value) else [side] for side in sides]
    return graph.op("Concat", *parts, axis=0)


def _pads(image: Value, *, before: Any = None, after: Any = None) -> Value:  # noqa: ANN401
    """Widths that Pad takes, of rows and columns."""
    none = [0, 0]
    parts = [none, none if before is None else before, none, none if after is None else after]
    return image.graph.op("Concat", *parts, axis=0)
