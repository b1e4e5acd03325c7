"""The depth networks, and steps around them that depend on sizes, as parts of an ONNX graph."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, cast

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from depthpose.core.errors import InputError
from depthpose.core.export import Graph, Value, network_model
from depthpose.depth.config import Answer, GeneratorConfig, SelectionConfig
from depthpose.depth.estimator.rig import SKY_M
from depthpose.depth.stereo import StereoNetwork
from depthpose.depth.stereo.light import LEAST_PX, LightStereo
from depthpose.depth.stereo.matcher import IMAGENET_MEAN, IMAGENET_STD, NetworkConfig
from depthpose.depth.stereo.psmnet import WINDOW_PX, PSMNet, interpolation_matrix, linear_taps
from depthpose.depth.synthesis import Generator, SelectionGenerator, UNetGenerator
from depthpose.depth.synthesis.networks import read_logits
from depthpose.depth.synthesis.synthesiser import COLUMNS_SHARE, ROWS_SHARE
from depthpose.depth.weights import DepthWeights


def size_of(image: Value) -> Value:
    """Give rows and columns of images."""
    return image.op("Shape", start=2, end=4)


def focal_yx(K: Value) -> Value:
    """Give the focal lengths of rows and of columns [px]."""
    return K.op("Reshape", [-1]).op("Gather", [4, 0])


def focal_size(size: Value, focal_px: Any, wanted_px: float) -> Value:  # noqa: ANN401
    """Give rows and columns at which an image has the wanted focal length."""
    scaled = (size.cast(np.float64) * float(wanted_px)) / focal_px
    return scaled.op("Round").op("Max", 1.0).cast(np.int64)


def resized_image(image: Value, size: Value) -> Value:
    """Resize images, averaging where they shrink."""
    resized = image.op("Resize", None, None, size, mode="linear", axes=[2, 3],
                       antialias=1, exclude_outside=1)  # fmt: skip
    return resized.op("Clip", np.float32(0), np.float32(1))


def resized_map(values: Value, size: Value) -> Value:
    """Resize maps (batch, height, width) without averaging."""
    lifted = values.op("Unsqueeze", [1])
    return lifted.op("Resize", None, None, size, mode="linear", axes=[2, 3]).op("Squeeze", [1])


def ratio(wide: Value, narrow: Value) -> Value:
    """Say how many times as wide, for disparities."""
    many, few = (columns(size).cast(np.float64) for size in (wide, narrow))
    return (many / few).cast(np.float32)


def rows(size: Value) -> Value:
    """Give the first of two sides, as a list of one."""
    return size.slice([0], [1], [0])


def columns(size: Value) -> Value:
    """Give the second of two sides, as a list of one."""
    return size.slice([1], [2], [0])


def joined(*sides: Any) -> Value:  # noqa: ANN401
    """Put sides one after the other; one at least is a value."""
    graph = next(side.graph for side in sides if isinstance(side, Value))
    parts = [side if isinstance(side, Value) else [side] for side in sides]
    return graph.op("Concat", *parts, axis=0)


def pads(image: Value, *, before: Any = None, after: Any = None) -> Value:  # noqa: ANN401
    """Give the widths that Pad takes, of rows and columns."""
    none = [0, 0]
    parts = [none, none if before is None else before, none, none if after is None else after]
    return image.graph.op("Concat", *parts, axis=0)


Maps = Float[Tensor, "b rows columns"]


class DynamicPSMNet(nn.Module):
    """PSMNet with its soft arg-min, in eval mode.

    Disparities are few and fixed, so their interpolation is a matrix; rows and columns are resized.
    """

    matrix: Tensor

    def __init__(self, network: PSMNet) -> None:
        super().__init__()
        self.network = network
        config = network.config
        self.bins = config.max_disparity_px // 4
        taps = linear_taps(
            self.bins, config.max_disparity_px, torch.zeros(1), align_corners=config.align_corners
        )
        self.register_buffer("matrix", interpolation_matrix(taps, self.bins)[..., None, None])

    def forward(
        self, left: Float[Tensor, "b 3 h w"], right: Float[Tensor, "b 3 h w"]
    ) -> tuple[Float[Tensor, "b h w"], Float[Tensor, "b h w"]]:
        """Give disparity [px] and confidence of normalised images."""
        near, far = self.network.features(left), self.network.features(right)
        cost = self.network.costs_of(gathered_volume(near, far, self.bins))[-1][:, 0]
        align = self.network.config.align_corners
        wide = F.interpolate(cost, left.shape[-2:], mode="bilinear", align_corners=align)
        probability = F.conv2d(wide, self.matrix).softmax(1)
        steps_px = torch.arange(self.network.config.max_disparity_px).to(cost)[:, None, None]
        disparity_px = (probability * steps_px).sum(1)
        is_near = (steps_px - disparity_px[:, None]).abs() <= WINDOW_PX
        return disparity_px, (probability * is_near).sum(1).clamp(0, 1)


class DynamicLightStereo(nn.Module):
    """The light network with what its matcher makes of its scores."""

    def __init__(self, network: LightStereo) -> None:
        super().__init__()
        self.network = network

    def forward(
        self, left: Float[Tensor, "b 3 h w"], right: Float[Tensor, "b 3 h w"]
    ) -> tuple[Maps, ...]:
        """Give disparity [px], confidence and, with that class, the sky of normalised images."""
        max_disparity_px = self.network.config.max_disparity_px
        read = self.network.read(left, right, max_disparity_px, with_confidence=True)
        assert read.confidence is not None
        sky = () if read.sky is None else ((read.sky > 0.5).float(),)
        return read.heads[-1], read.confidence, *sky


DYNAMIC_SHAPE_NETWORKS: dict[type[StereoNetwork], Callable[[Any], nn.Module]] = {
    PSMNet: DynamicPSMNet,
    LightStereo: DynamicLightStereo,
}
"""Each kind of matcher network in its form with dynamic shapes: a new kind is one entry."""


def dynamic_shape_network(matcher: StereoNetwork) -> nn.Module:
    """Give a matcher's network, with its post-processing, in a form with dynamic shapes."""
    if type(matcher) not in DYNAMIC_SHAPE_NETWORKS:
        known = ", ".join(kind.__name__ for kind in DYNAMIC_SHAPE_NETWORKS)
        raise InputError(
            f"the matcher is {type(matcher).__name__}, and no file is made of it; give weights of "
            f"one of {known}."
        )
    return DYNAMIC_SHAPE_NETWORKS[type(matcher)](matcher).eval()


class DynamicSelection(nn.Module):
    """The generator that selects, and what its logits say, at half of the image's sides."""

    def __init__(self, generator: SelectionGenerator) -> None:
        super().__init__()
        self.generator = generator

    def forward(self, image: Float[Tensor, "b 3 h w"]) -> tuple[Tensor, ...]:
        """Give log of disparity, sky and confidence of the left view; the first two of the right.

        Disparity is counted in pixels of the image's width. Where the weights know streets, how
        probable one is follows, (b,).
        """
        features = self.generator.encoder(image)
        left, right = (
            read_logits(logits, self.generator.planes) for logits in self.generator.decode(features)
        )
        street = self.generator.find_street(features[-1])
        return *left, *right[:2], *(() if street is None else (street,))


def gathered_volume(
    left: Float[Tensor, "b c h w"], right: Float[Tensor, "b c h w"], bins: int
) -> Float[Tensor, "b c2 {bins} h w"]:
    """Make ``concatenation_volume`` by one gather in place of a copy a disparity."""
    column = torch.arange(left.shape[-1]) - torch.arange(bins)[:, None]
    is_inside = (column >= 0).to(left.dtype)
    sides = [left[..., None, :] * is_inside, right[..., column.clamp(min=0)] * is_inside]
    return torch.cat(sides, 1).transpose(2, 3)


@dataclass(frozen=True, kw_only=True, eq=False)
class DrawnValues:
    """:class:`~depthpose.depth.synthesis.SynthesisedViews` as values of a graph."""

    right: Value
    disparity_px: Value | None = None
    confidence: Value | None = None
    is_sky: Value | None = None
    street: Value | None = None


def drawn(left: Value, generator: Generator) -> DrawnValues:
    """Draw right views."""
    if isinstance(generator, SelectionGenerator):
        return _selected(left, generator)
    if generator.config.test_mode != "running":
        raise InputError(
            "the generator's test_mode is 'batch': it draws with dropout, other views each time, "
            "so no file can agree with it; export weights whose test_mode is 'running'."
        )
    return DrawnValues(right=_painted(left, generator))


def _painted(left: Value, generator: UNetGenerator) -> Value:
    """What ``draw_right`` does: near a multiple stretched to it, else mirrored up to one."""
    size, multiple = size_of(left), generator.config.side_multiple_px
    stretched = _near_multiple(size, multiple)
    image = resized_image(left, stretched) * np.float32(2) - np.float32(1)
    example = torch.zeros(2, 3, 2 * multiple, 3 * multiple)
    network = network_model(generator, [example], multiple)
    (found,) = left.graph.call(network, _mirrored(image, stretched, multiple))
    cropped = (found + np.float32(1)).slice([0, 0], stretched, [2, 3]) / np.float32(2)
    return resized_image(cropped, size)


def _selected(left: Value, generator: SelectionGenerator) -> DrawnValues:
    """What ``select_views`` and ``shift_left`` do."""
    size, multiple = size_of(left), generator.config.side_multiple_px
    # Even, since logits stand for two rows and two columns.
    even = (_near_multiple(size, multiple) / 2 * 2).op("Max", 2)
    image = _mirrored(resized_image(left, even), even, multiple)
    example = torch.rand(2, 3, 2 * multiple, 3 * multiple)
    network = network_model(DynamicSelection(generator).eval(), [example], multiple)
    outputs = left.graph.call(network, image)
    maps = [m.slice([0, 0], even / 2, [1, 2]) for m in outputs[:5]]
    log_px, sky, sure, right_log_px, right_sky = (resized_map(m, size) for m in maps)
    scale = ratio(size, even)
    is_sky = sky.op("Greater", np.float32(0.5))
    known = sure * (sky * np.float32(-1) + np.float32(1))
    shift_px = right_log_px.op("Exp") * scale
    right_is_sky = right_sky.op("Greater", np.float32(0.5))
    return DrawnValues(
        right=_shifted(left, right_is_sky.op("Where", np.float32(0), shift_px)),
        disparity_px=log_px.op("Exp") * scale,
        confidence=is_sky.op("Where", sky, known),
        is_sky=is_sky,
        street=outputs[5] if generator.config.with_street else None,
    )


def _shifted(left: Value, shift_px: Value) -> Value:
    """Look the left image up at ``x + shift``; beyond the border the border repeats."""
    size = size_of(left)
    places = [  # 0, 1, ... of each side
        left.graph.op("Range", 0, side(size).op("Squeeze", [0]), 1).cast(np.float32)
        for side in (rows, columns)
    ]
    row = places[0].op("Unsqueeze", [1])
    y, x = (
        (values * np.float32(2) + np.float32(1)) / side(size).cast(np.float32) - np.float32(1)
        for values, side in ((row, rows), (shift_px + places[1], columns))
    )
    grid = left.graph.op("Concat", *(
        v.op("Expand", shift_px.op("Shape")).op("Unsqueeze", [-1]) for v in (x, y)), axis=-1
    )  # fmt: skip
    return left.op("GridSample", grid, mode="bilinear", padding_mode="border", align_corners=0)


def _near_multiple(size: Value, multiple: int) -> Value:
    """Give the multiple that a side is close to, or the side itself."""
    sides = size.cast(np.float64)
    nearest = (sides / float(multiple)).op("Round").op("Max", 1.0) * float(multiple)
    off = (nearest - sides).op("Abs")
    is_near = off.op("LessOrEqual", sides * np.array([ROWS_SHARE, COLUMNS_SHARE]))
    return is_near.op("Where", nearest, sides).cast(np.int64)


def _mirrored(image: Value, size: Value, multiple: int) -> Value:
    """Mirror the right and lower border until both sides are multiples."""
    lacking = (size + (multiple - 1)) / multiple * multiple - size
    return image.op("Pad", pads(image, after=lacking), mode="reflect")


_IMAGES = ("batch", 3, "height", "width")
_MAPS = ("batch", "height", "width")


class _Maps(NamedTuple):
    """Disparity [px], confidence, and 1 in the sky where it is known."""

    disparity_px: Value
    confidence: Value
    sky: Value | None = None


def image_graph(weights: DepthWeights) -> Graph:
    """Write one image to depth: what ``FakestereoNet.estimate`` does without a right view.

    Inputs ``image`` (batch, 3, height, width; RGB in [0, 1]) and ``K`` (3, 3; float64, of all
    images). Outputs ``depth_m``, ``disparity_px`` (of the imitated rig, in the image's pixels),
    ``confidence`` (each batch, height, width) and ``right``, the drawn view; of networks that know
    the sky ``is_sky`` too (batch, height, width; bool), of weights that know streets
    ``image_confidence`` (batch), how probable one is.
    """
    generator = weights.generator
    if generator is None or (weights.matcher is None and generator.config.answer != "own"):
        raise InputError(
            f"depth from one image needs a generator and a matcher, and these weights lack the "
            f"{'generator' if generator is None else 'matcher'}; 'depthpose weights pack' makes "
            "one file of both."
        )
    rig = generator.config
    graph = Graph()
    image = graph.input("image", np.float32, _IMAGES)
    K = graph.input("K", np.float64, (3, 3))
    full = size_of(image)
    small = focal_size(full, focal_yx(K), rig.virtual_focal_px)
    left = resized_image(image, small)
    seen = drawn(left, generator)
    found = _answered(left, seen, weights.matcher, rig)
    disparity_px = resized_map(found.disparity_px, full) * ratio(full, small)
    confidence = resized_map(found.confidence, full)
    fx = K.op("Reshape", [-1]).op("Gather", 0).cast(np.float32)
    focal_m_px = fx * np.float32(rig.virtual_baseline_m)  # depth is that over disparity
    depth_m = focal_m_px / disparity_px
    depth_m = disparity_px.op("Greater", np.float32(0)).op("Where", depth_m, np.float32(np.nan))
    if found.sky is not None:
        is_sky = resized_map(found.sky, full).op("Greater", np.float32(0.5))
        depth_m = is_sky.op("Where", np.float32(np.nan), depth_m)
        disparity_px = is_sky.op("Where", focal_m_px / np.float32(SKY_M), disparity_px)
        graph.output("is_sky", is_sky, np.bool_, _MAPS)
    _output_maps(graph, depth_m, disparity_px, confidence)
    graph.output("right", resized_image(seen.right, full), np.float32, _IMAGES)
    if seen.street is not None:
        graph.output("image_confidence", seen.street, np.float32, ("batch",))
    return graph


def pair_graph(weights: DepthWeights) -> Graph:
    """Write a rectified pair to disparity: what ``FakestereoNet.estimate`` does with ``right=``.

    Inputs ``left`` and ``right`` (batch, 3, height, width; RGB in [0, 1]), and ``K`` (3, 3;
    float64) where the weights were trained at one focal length. Outputs ``disparity_px`` and
    ``confidence`` (batch, height, width), and of a network that knows the sky ``is_sky`` (the same;
    bool), where disparity is 0.01 px. Elsewhere depth is ``fx * baseline / disparity``.
    """
    if weights.matcher is None:
        raise InputError("these weights hold no matcher, only a generator; give a matcher's.")
    network = dynamic_shape_network(weights.matcher)
    config = cast("NetworkConfig", weights.matcher.config)
    graph = Graph()
    left = graph.input("left", np.float32, _IMAGES)
    right = graph.input("right", np.float32, _IMAGES)
    focal_px = None
    if config.work_focal_px is not None:
        focal_px = focal_yx(graph.input("K", np.float64, (3, 3)))
    found = _matched(left, right, focal_px, network, config)
    disparity_px = found.disparity_px
    if found.sky is not None:
        is_sky = found.sky.op("Greater", np.float32(0.5))
        disparity_px = is_sky.op("Where", np.float32(LEAST_PX), disparity_px)
        graph.output("is_sky", is_sky, np.bool_, _MAPS)
    _output_maps(graph, None, disparity_px, found.confidence)
    return graph


def _answered(
    left: Value,
    seen: DrawnValues,
    matcher: StereoNetwork | None,
    rig: GeneratorConfig | SelectionConfig,
) -> _Maps:
    """Take the generator's own disparity, the matcher's, or both."""
    answer: Answer = rig.answer
    if answer == "own":
        return _own(seen)
    assert matcher is not None, "checked before"
    focal_px = np.array([rig.virtual_focal_px] * 2)
    config = cast("NetworkConfig", matcher.config)
    matched = _matched(left, seen.right, focal_px, dynamic_shape_network(matcher), config)
    if answer == "matched":
        return matched if seen.is_sky is None else matched._replace(sky=_own(seen).sky)
    return _both(_own(seen), matched)


def _own(seen: DrawnValues) -> _Maps:
    assert seen.disparity_px is not None and seen.confidence is not None  # noqa: PT018
    sky = None if seen.is_sky is None else seen.is_sky.cast(np.float32)
    return _Maps(seen.disparity_px, seen.confidence, sky)


def _both(one: _Maps, other: _Maps) -> _Maps:
    """What ``join_matches`` does: the mean of the logarithms, weighed by confidence."""
    is_known = other.disparity_px.op("Greater", np.float32(0))
    weight = is_known.op("Where", other.confidence, np.float32(0))
    if other.sky is not None:
        weight = weight * (other.sky * np.float32(-1) + np.float32(1))
    share = weight / (weight + one.confidence).op("Max", np.float32(1e-6))
    logs = [maps.disparity_px.op("Max", np.float32(1e-3)).op("Log") for maps in (one, other)]
    log_px = _between(logs[0], logs[1], share)
    return _Maps(log_px.op("Exp"), _between(one.confidence, weight, share), one.sky)


def _between(start: Value, end: Value, share: Value) -> Value:
    return start + (end - start) * share


def _matched(
    left: Value,
    right: Value,
    focal_px: Value | np.ndarray | None,
    network: nn.Module,
    config: NetworkConfig,
) -> _Maps:
    """Match at the focal length that the weights want, and come back to the images' size."""
    size = work = size_of(left)
    if config.work_focal_px is not None:
        work = focal_size(size, focal_px, config.work_focal_px)
    least, step = config.min_side_px, config.step_px
    lacking = ((work + (step - 1)) / step * step).op("Max", least) - work
    above, beside = rows(lacking), columns(lacking)
    widths = pads(left, before=joined(above, 0), after=joined(0, beside))
    mean, deviation = (
        np.array(v, np.float32)[:, None, None] for v in (IMAGENET_MEAN, IMAGENET_STD)
    )
    padded = [
        ((resized_image(view, work) - mean) / deviation).op("Pad", widths) for view in (left, right)
    ]
    example = [torch.rand(2, 3, least + step, least + 2 * step) for _ in range(2)]
    found = left.graph.call(network_model(network, example, step), *padded)
    whole = 1 << 62
    found = [m.slice(joined(above, 0), joined(whole, columns(work)), [1, 2]) for m in found]
    disparity_px, confidence, *sky = (resized_map(m, size) for m in found)
    is_sky = [values.op("Greater", np.float32(0.5)).cast(np.float32) for values in sky]
    return _Maps(disparity_px * ratio(size, work), confidence, *is_sky)


def _output_maps(graph: Graph, *maps: Value | None) -> None:
    for name, values in zip(("depth_m", "disparity_px", "confidence"), maps, strict=True):
        if values is not None:
            graph.output(name, values, np.float32, _MAPS)
