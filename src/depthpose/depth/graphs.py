"""Depth as one ONNX graph, the estimator's own steps included."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from depthpose.core.arrays import IMAGENET_MEAN, IMAGENET_STD
from depthpose.core.errors import InputError
from depthpose.core.export import Graph, Value, convert_network
from depthpose.depth.disparity import MIN_DISPARITY_PX, SKY_M
from depthpose.depth.generators import Generator, SelectionGenerator
from depthpose.depth.stereo import LightStereo, PSMNet, StereoNetwork
from depthpose.depth.stereo.layers import interpolation_matrix, linear_taps
from depthpose.depth.stereo.psmnet import WINDOW_PX
from depthpose.depth.synthesis import MAX_COLUMN_STRETCH, MAX_ROW_STRETCH, read_logits
from depthpose.depth.types import Views
from depthpose.depth.weights import DepthWeights

# float32 constants of graphs: operators of ONNX take no Python floats beside float32.
_0 = np.float32(0)
_1 = np.float32(1)
_2 = np.float32(2)
_HALF = np.float32(0.5)
_NAN = np.float32(np.nan)


def _slice_side(size: Value, axis: int) -> Value:
    """Take the rows (axis 0) or columns (1) of a size, as a list of one number."""
    return size.slice([axis], [axis + 1], [0])


def _resize_image(image: Value, size: Value) -> Value:
    """Resize images to rows and columns, with antialiasing where they shrink; clip to [0, 1]."""
    # As torch does, pixels beyond the border are left out and the other weights add up to 1; by
    # default ONNX would repeat the pixels of the border.
    resized = image.op(
        "Resize", None, None, size, mode="linear", axes=[2, 3], antialias=1, exclude_outside=1
    )
    return resized.op("Clip", _0, _1)


def _resize_map(values: Value, size: Value) -> Value:
    """Resize maps (batch, height, width) to rows and columns, without antialiasing."""
    with_channel = values.op("Unsqueeze", [1])
    resized = with_channel.op("Resize", None, None, size, mode="linear", axes=[2, 3])
    return resized.op("Squeeze", [1])


def _compute_width_ratio(size: Value, other: Value) -> Value:
    """Compute the width of a size as a multiple of another's, by which disparities scale."""
    width = _slice_side(size, 1).cast(np.float64)
    other_width = _slice_side(other, 1).cast(np.float64)
    return (width / other_width).cast(np.float32)


def _compute_size_at_focal_length(
    size: Value, target_px: float, focal_px: Value | np.ndarray
) -> Value:
    """Compute (rows, columns) at which images have a focal length, as ``size_at_focal_length``.

    ``size``: (rows, columns) of the images; ``target_px``: the focal length; ``focal_px``: those of
    the images in the same order, (fy, fx).
    """
    scaled = size.cast(np.float64) * target_px / focal_px
    return scaled.op("Round").op("Max", 1.0).cast(np.int64)


Maps = Float[Tensor, "b rows columns"]


class DynamicPSMNet(nn.Module):
    """PSMNet with its soft arg-min and its confidence, in operators that allow any image size.

    The number of disparities is fixed, so their interpolation is a matrix; rows and columns are
    resized.
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
        self, left: Views, right: Views
    ) -> tuple[Float[Tensor, "b h w"], Float[Tensor, "b h w"]]:
        """Estimate disparity [px] and confidence from normalised images."""
        config = self.network.config
        left_features = self.network.features(left)
        right_features = self.network.features(right)
        volume = gathered_volume(left_features, right_features, self.bins)
        cost = self.network.refine(self.network.aggregate(volume))[-1][:, 0]

        # Costs at the size of the images and for each disparity.
        resized = F.interpolate(
            cost, left.shape[-2:], mode="bilinear", align_corners=config.align_corners
        )
        probability = F.conv2d(resized, self.matrix).softmax(1)

        disparities_px = torch.arange(config.max_disparity_px).to(cost)[:, None, None]
        disparity_px = (probability * disparities_px).sum(1)
        is_near = (disparities_px - disparity_px[:, None]).abs() <= WINDOW_PX
        return disparity_px, (probability * is_near).sum(1).clamp(0, 1)


class _ExportedNetwork(nn.Module):
    """A network with the post-processing that its graph contains."""

    def __init__(self, network: Any) -> None:  # noqa: ANN401
        super().__init__()
        self.network = network


class DynamicLightStereo(_ExportedNetwork):
    """The light network with the post-processing of its matcher."""

    def forward(self, left: Views, right: Views) -> tuple[Maps, ...]:
        """Estimate disparity [px], confidence and sky (1, elsewhere 0) from normalised images.

        The sky is left out where the network does not recognise it.
        """
        max_disparity_px = self.network.config.max_disparity_px
        output = self.network.match_views(left, right, max_disparity_px, with_confidence=True)
        assert output.confidence is not None
        if output.sky is None:
            return output.heads[-1], output.confidence
        return output.heads[-1], output.confidence, (output.sky > 0.5).float()


@dataclass(frozen=True, kw_only=True)
class ExportedMatcher:
    """How a kind of matcher network is exported."""

    module: Callable[[Any], nn.Module]  #: makes the module of a network, for any image size
    #: it chooses between candidates: where two scores tie, the last bit decides
    is_selecting: bool = False


EXPORTED_MATCHERS: dict[type[StereoNetwork], ExportedMatcher] = {
    PSMNet: ExportedMatcher(module=DynamicPSMNet),
    LightStereo: ExportedMatcher(module=DynamicLightStereo, is_selecting=True),
}
"""Kinds of matcher networks that are exported: a new kind is one entry."""


class DynamicSelection(_ExportedNetwork):
    """The selecting generator with the post-processing of its logits, at half the image size."""

    def forward(self, image: Views) -> tuple[Tensor, ...]:
        """Estimate log of disparity, sky and confidence of the left view; log and sky of the right.

        Disparity is counted in pixels of the image's width. The probability of a street follows,
        (b,), where the weights have a layer for it.
        """
        planes = self.network.planes
        features = self.network.encoder(image)
        left_logits, right_logits = self.network.decode(features)
        left_log_px, left_sky, left_confidence = read_logits(left_logits, planes)
        right_log_px, right_sky, _ = read_logits(right_logits, planes)
        outputs = (left_log_px, left_sky, left_confidence, right_log_px, right_sky)
        street_probability = self.network.street_probability(features[-1])
        return outputs if street_probability is None else (*outputs, street_probability)


def gathered_volume(
    left: Float[Tensor, "b c h w"], right: Float[Tensor, "b c h w"], bins: int
) -> Float[Tensor, "b c2 {bins} h w"]:
    """Make the ``concatenation_volume`` of PSMNet by one gather, which ONNX can express."""
    right_column = torch.arange(left.shape[-1]) - torch.arange(bins)[:, None]
    is_inside = (right_column >= 0).to(left.dtype)
    left_part = left[..., None, :] * is_inside
    right_part = right[..., right_column.clamp(min=0)] * is_inside
    return torch.cat([left_part, right_part], 1).transpose(2, 3)


class _Maps(NamedTuple):
    """Maps of left views in a graph."""

    disparity_px: Value
    confidence: Value
    sky: Value | None = None  # 1 in the sky; None where the weights do not recognise it


class _GeneratorOutputs(NamedTuple):
    """Outputs of a generator for left views in a graph."""

    right: Value
    left_maps: _Maps | None = None  # None of a generator that estimates no disparity
    street_probability: Value | None = None  # None where the weights do not give it


def _add_generator(left: Value, generator: Generator) -> _GeneratorOutputs:
    """Add a generator to a graph, with its resizing and padding, as its synthesiser runs it."""
    size = left.op("Shape", start=2, end=4)
    multiple = generator.config.side_multiple_px

    # Each side is stretched to the nearest multiple, if that is close enough, else kept.
    sides = size.cast(np.float64)
    nearest = (sides / float(multiple)).op("Round").op("Max", 1.0) * float(multiple)
    limits = sides * np.array([MAX_ROW_STRETCH, MAX_COLUMN_STRETCH])
    is_near = (nearest - sides).op("Abs").op("LessOrEqual", limits)
    network_size = is_near.op("Where", nearest, sides).cast(np.int64)

    if isinstance(generator, SelectionGenerator):
        return _add_selection_generator(left, size, network_size, generator)
    example = _make_example_image(multiple)
    image = _resize_image(left, network_size) * _2 - _1
    network = convert_network(generator, [example], multiple)
    (output,) = left.graph.call(network, _pad_by_reflection(image, network_size, multiple))
    right = (output + _1).slice([0, 0], network_size, [2, 3]) / _2
    return _GeneratorOutputs(_resize_image(right, size))


def _add_selection_generator(
    left: Value, size: Value, network_size: Value, generator: SelectionGenerator
) -> _GeneratorOutputs:
    """Add a selecting generator to a graph.

    ``size``: rows and columns of ``left``; ``network_size``: those to which the network's input is
    resized before it is padded.
    """
    multiple = generator.config.side_multiple_px
    # Even sides, for a logit stands for two rows and two columns; integers are divided.
    even_size = (network_size / 2 * 2).op("Max", 2)
    image = _pad_by_reflection(_resize_image(left, even_size), even_size, multiple)
    network = convert_network(
        DynamicSelection(generator).eval(), [_make_example_image(multiple)], multiple
    )
    outputs = left.graph.call(network, image)
    log_px, sky, disparity_confidence, right_log_px, right_sky = (
        _resize_map(output.slice([0, 0], even_size / 2, [1, 2]), size) for output in outputs[:5]
    )
    street_probability = outputs[5] if generator.config.with_street else None

    # The left view.
    scale = _compute_width_ratio(size, even_size)
    is_sky = sky.op("Greater", _HALF)
    not_sky = sky * np.float32(-1) + _1
    confidence = is_sky.op("Where", sky, disparity_confidence * not_sky)
    left_maps = _Maps(log_px.op("Exp") * scale, confidence, is_sky.cast(np.float32))

    # The right view; the sky is not shifted.
    is_right_sky = right_sky.op("Greater", _HALF)
    right_px = is_right_sky.op("Where", _0, right_log_px.op("Exp") * scale)
    return _GeneratorOutputs(
        _warp_left_to_right(left, right_px, size), left_maps, street_probability
    )


def _warp_left_to_right(left: Value, right_px: Value, size: Value) -> Value:
    """Add the warp of left views to right ones, as ``warp_left_to_right`` of ``synthesis`` does.

    Args:
        left: (batch, 3, height, width).
        right_px: disparity of the right views (batch, height, width).
        size: height and width (2,).
    """
    graph = left.graph
    height = _slice_side(size, 0)
    width = _slice_side(size, 1)

    # The place in the left view of each pixel of the right one: rows (height, 1), columns (batch,
    # height, width).
    row = graph.op("Range", 0, height.op("Squeeze", [0]), 1).cast(np.float32).op("Unsqueeze", [1])
    right_column = graph.op("Range", 0, width.op("Squeeze", [0]), 1).cast(np.float32)
    left_column = right_px + right_column

    # GridSample's coordinates: -1 and 1 are the outer borders of the image.
    y = (row * _2 + _1) / height.cast(np.float32) - _1
    x = (left_column * _2 + _1) / width.cast(np.float32) - _1

    # Its grid (batch, height, width, 2), of x and y.
    shape = right_px.op("Shape")
    grid_x = x.op("Expand", shape).op("Unsqueeze", [-1])
    grid_y = y.op("Expand", shape).op("Unsqueeze", [-1])
    grid = graph.op("Concat", grid_x, grid_y, axis=-1)
    return left.op("GridSample", grid, mode="bilinear", padding_mode="border", align_corners=0)


def _take_sky(maps: _Maps, by_generator: _Maps) -> _Maps:
    """Take the sky, with the confidence there, from the generator, as the estimator does."""
    assert by_generator.sky is not None, "a selecting generator gives the sky"
    is_sky = by_generator.sky.op("Greater", _HALF)
    confidence = is_sky.op("Where", by_generator.confidence, maps.confidence)
    return maps._replace(sky=by_generator.sky, confidence=confidence)


def _make_example_image(multiple: int) -> Tensor:
    """Make an example image, as ``convert_network`` needs it to trace a generator."""
    return torch.rand(2, 3, 2 * multiple, 3 * multiple)


def _pad_by_reflection(image: Value, size: Value, multiple: int) -> Value:
    """Pad images of a size at the right and below, until both sides are multiples."""
    padded_size = (size + (multiple - 1)) / multiple * multiple  # integers are divided
    no_pads = [0, 0]
    # Pads before and after each of the axes batch, channel, row, column.
    pads = image.graph.op("Concat", no_pads, no_pads, no_pads, padded_size - size, axis=0)
    return image.op("Pad", pads, mode="reflect")


_IMAGES_SHAPE = ("batch", 3, "height", "width")
_MAPS_SHAPE = ("batch", "height", "width")


def image_graph(weights: DepthWeights) -> Graph:
    """Make the graph of depth from one image: the networks of ``FakestereoNet.estimate``.

    Left out is what follows them there: the correction by the mount of the camera, no depth and no
    confidence in blank borders, the removal of skies that are too small to be one, and the weight
    of the texture in the confidence of the sky.

    Inputs are ``image`` (batch, 3, height, width; RGB in [0, 1]) and ``K`` (3, 3; float64, of all
    images). Outputs are ``depth_m``, ``disparity_px`` (of the imitated rig, in the image's pixels),
    ``confidence`` (each batch, height, width) and ``right``, the synthesised view; with networks
    that recognise the sky also ``is_sky`` (batch, height, width; bool), and with weights that
    recognise streets ``image_confidence`` (batch), the probability of a street.

    Raises:
        InputError: the weights have no generator, or no matcher where they need one.
    """
    generator = weights.generator
    if generator is None or (weights.matcher is None and generator.config.answer != "own"):
        raise InputError(
            f"depth from one image needs a generator and a matcher, and these weights lack the "
            f"{'generator' if generator is None else 'matcher'}; 'depthpose weights pack' makes "
            "one file of both."
        )
    config = generator.config
    graph = Graph()
    image = graph.input("image", np.float32, _IMAGES_SHAPE)
    K = graph.input("K", np.float64, (3, 3)).op("Reshape", [-1])

    # The virtual rig: the right view, and maps of the left one.
    size = image.op("Shape", start=2, end=4)
    focal_px = K.op("Gather", [4, 0])  # fy, fx
    virtual_size = _compute_size_at_focal_length(size, float(config.virtual_focal_px), focal_px)
    left = _resize_image(image, virtual_size)
    right, generator_maps, street_probability = _add_generator(left, generator)
    maps = generator_maps
    if config.answer == "matched":
        assert weights.matcher is not None, "checked before"
        maps = _add_matcher(left, right, np.array([config.virtual_focal_px] * 2), weights.matcher)
        if generator_maps is not None:
            maps = _take_sky(maps, generator_maps)
    assert maps is not None

    # Depth at the size of the image.
    disparity_px = _resize_map(maps.disparity_px, size) * _compute_width_ratio(size, virtual_size)
    focal_m_px = K.op("Gather", 0).cast(np.float32) * np.float32(config.virtual_baseline_m)
    is_positive = disparity_px.op("Greater", _0)
    depth_m = is_positive.op("Where", focal_m_px / disparity_px, _NAN)
    if maps.sky is not None:
        is_sky = _resize_map(maps.sky, size).op("Greater", _HALF)
        depth_m = is_sky.op("Where", _NAN, depth_m)
        disparity_px = is_sky.op("Where", focal_m_px / np.float32(SKY_M), disparity_px)
        graph.output("is_sky", is_sky, np.bool_, _MAPS_SHAPE)
    graph.output("depth_m", depth_m, np.float32, _MAPS_SHAPE)
    graph.output("disparity_px", disparity_px, np.float32, _MAPS_SHAPE)
    graph.output("confidence", _resize_map(maps.confidence, size), np.float32, _MAPS_SHAPE)
    graph.output("right", _resize_image(right, size), np.float32, _IMAGES_SHAPE)
    if street_probability is not None:
        graph.output("image_confidence", street_probability, np.float32, ("batch",))
    return graph


def pair_graph(weights: DepthWeights) -> Graph:
    """Make the graph of disparity of a rectified pair, as ``match_in_usual_range`` computes it.

    Of ``FakestereoNet.estimate`` with ``right=`` are left out: the check that it is a pair, the
    measured range of the disparities with the doubts of hidden places and of what lies beyond, the
    shift of the principal points, no disparity and no confidence in blank borders, the removal of
    skies that are too small to be one, and the weight of the texture in the confidence.

    Inputs are ``left`` and ``right`` (batch, 3, height, width; RGB in [0, 1]), and ``K`` (3, 3;
    float64) where the weights were trained at one focal length. Outputs are ``disparity_px`` and
    ``confidence`` (batch, height, width), and with a network that recognises the sky ``is_sky``
    (the same; bool), where disparity is 0.01 px. Elsewhere depth is ``fx * baseline / disparity``.

    Raises:
        InputError: the weights have no matcher, or one of a kind that is not exported.
    """
    if weights.matcher is None:
        raise InputError("these weights hold no matcher, only a generator; give a matcher's.")
    graph = Graph()
    left = graph.input("left", np.float32, _IMAGES_SHAPE)
    right = graph.input("right", np.float32, _IMAGES_SHAPE)
    focal_px = None
    if weights.matcher.config.work_focal_px is not None:
        K = graph.input("K", np.float64, (3, 3))
        focal_px = K.op("Reshape", [-1]).op("Gather", [4, 0])  # fy, fx
    disparity_px, confidence, sky = _add_matcher(left, right, focal_px, weights.matcher)
    if sky is not None:
        is_sky = sky.op("Greater", _HALF)
        disparity_px = is_sky.op("Where", np.float32(MIN_DISPARITY_PX), disparity_px)
        graph.output("is_sky", is_sky, np.bool_, _MAPS_SHAPE)
    graph.output("disparity_px", disparity_px, np.float32, _MAPS_SHAPE)
    graph.output("confidence", confidence, np.float32, _MAPS_SHAPE)
    return graph


def _add_matcher(
    left: Value, right: Value, focal_px: Value | np.ndarray | None, matcher: StereoNetwork
) -> _Maps:
    """Add a matcher to a graph, which matches at the focal length of its training.

    Args:
        left: left views.
        right: right views.
        focal_px: focal lengths of the images, (fy, fx), where the matcher needs them.
        matcher: the network.

    Returns:
        Maps of the images' size.

    Raises:
        InputError: the network is of a kind that is not exported.
    """
    if type(matcher) not in EXPORTED_MATCHERS:
        kinds = ", ".join(kind.__name__ for kind in EXPORTED_MATCHERS)
        raise InputError(
            f"the matcher is {type(matcher).__name__}, and no file is made of it; give weights of "
            f"one of {kinds}."
        )
    network = EXPORTED_MATCHERS[type(matcher)].module(matcher).eval()
    config = matcher.config
    graph = left.graph
    size = left.op("Shape", start=2, end=4)
    work_size = size
    if config.work_focal_px is not None:
        assert focal_px is not None
        work_size = _compute_size_at_focal_length(size, float(config.work_focal_px), focal_px)

    # Normalised images, padded above and at the right to the sides that the network takes. Sides
    # are integers, whose quotients are rounded down.
    min_side = config.min_side_px
    step = config.step_px
    padded_size = ((work_size + (step - 1)) / step * step).op("Max", min_side)
    padding = padded_size - work_size
    rows_above = _slice_side(padding, 0)
    columns_right = _slice_side(padding, 1)
    # Pads before the axes batch, channel, row and column, then those after them.
    pads = graph.op("Concat", [0, 0], rows_above, [0, 0, 0, 0], columns_right, axis=0)
    mean = np.array(IMAGENET_MEAN, np.float32)[:, None, None]
    deviation = np.array(IMAGENET_STD, np.float32)[:, None, None]
    padded = [
        ((_resize_image(view, work_size) - mean) / deviation).op("Pad", pads)
        for view in (left, right)
    ]

    example = [torch.rand(2, 3, min_side + step, min_side + 2 * step) for _ in range(2)]
    outputs = graph.call(convert_network(network, example, step), *padded)

    # Maps without the padding, at the size of the images.
    first = graph.op("Concat", rows_above, [0], axis=0)
    # A number beyond all rows means to the last row.
    last = graph.op("Concat", [1 << 62], _slice_side(work_size, 1), axis=0)
    disparity_px, confidence, *sky = (
        _resize_map(output.slice(first, last, [1, 2]), size) for output in outputs
    )
    is_sky = [values.op("Greater", _HALF).cast(np.float32) for values in sky]
    return _Maps(disparity_px * _compute_width_ratio(size, work_size), confidence, *is_sky)
