"""Depth as one ONNX graph, the estimator's own steps included, and its comparison with PyTorch."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from depthpose.core.camera import Camera, StereoRig
from depthpose.core.errors import InputError, refuse_unknown
from depthpose.core.export import Case, Export, Graph, Limit, Value, network_model
from depthpose.depth.config import MatcherConfig
from depthpose.depth.disparity import LEAST_PX, SKY_M
from depthpose.depth.estimator import FakestereoNet
from depthpose.depth.stereo import LightStereo, NetworkMatcher, PSMNet, StereoNetwork
from depthpose.depth.stereo.layers import interpolation_matrix, linear_taps
from depthpose.depth.stereo.matcher import IMAGENET_MEAN, IMAGENET_STD
from depthpose.depth.stereo.psmnet import WINDOW_PX
from depthpose.depth.synthesis import (
    COLUMNS_SHARE,
    ROWS_SHARE,
    Generator,
    SelectionGenerator,
    make_synthesiser,
    read_logits,
)
from depthpose.depth.types import DepthEstimate, StereoInput, Views
from depthpose.depth.weights import DepthWeights, make_matcher

_0 = np.float32(0)
_1 = np.float32(1)
_2 = np.float32(2)
_HALF = np.float32(0.5)


def _side(size: Value, axis: int) -> Value:
    """Give the number of rows (axis 0) or columns (1), as a list of one."""
    return size.slice([axis], [axis + 1], [0])


def _resized_image(image: Value, size: Value) -> Value:
    """Resize images, averaging where they shrink."""
    resized = image.op("Resize", None, None, size, mode="linear", axes=[2, 3],
                       antialias=1, exclude_outside=1)  # fmt: skip
    return resized.op("Clip", _0, _1)


def _resized_map(values: Value, size: Value) -> Value:
    """Resize maps (batch, height, width) without averaging."""
    lifted = values.op("Unsqueeze", [1])
    return lifted.op("Resize", None, None, size, mode="linear", axes=[2, 3]).op("Squeeze", [1])


def _ratio(wide: Value, narrow: Value) -> Value:
    """Give the ratio of the widths of two images, by which disparities scale."""
    wide_px = _side(wide, 1).cast(np.float64)
    narrow_px = _side(narrow, 1).cast(np.float64)
    return (wide_px / narrow_px).cast(np.float32)


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
        self, left: Views, right: Views
    ) -> tuple[Float[Tensor, "b h w"], Float[Tensor, "b h w"]]:
        """Give disparity [px] and confidence of normalised images."""
        near = self.network.features(left)
        far = self.network.features(right)
        cost0 = self.network.aggregate(gathered_volume(near, far, self.bins))
        cost = self.network.refine(cost0)[-1][:, 0]
        align = self.network.config.align_corners
        wide = F.interpolate(cost, left.shape[-2:], mode="bilinear", align_corners=align)
        probability = F.conv2d(wide, self.matrix).softmax(1)
        steps_px = torch.arange(self.network.config.max_disparity_px).to(cost)[:, None, None]
        disparity_px = (probability * steps_px).sum(1)
        is_near = (steps_px - disparity_px[:, None]).abs() <= WINDOW_PX
        return disparity_px, (probability * is_near).sum(1).clamp(0, 1)


class _Dynamic(nn.Module):
    def __init__(self, network: Any) -> None:  # noqa: ANN401
        super().__init__()
        self.network = network


class DynamicLightStereo(_Dynamic):
    """The light network with what its matcher makes of its scores."""

    def forward(self, left: Views, right: Views) -> tuple[Maps, ...]:
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


class DynamicSelection(_Dynamic):
    """The generator that selects, and what its logits say, at half of the image's sides."""

    def forward(self, image: Views) -> tuple[Tensor, ...]:
        """Give log of disparity, sky and confidence of the left view; the first two of the right.

        Disparity is counted in pixels of the image's width. Where the weights know streets, how
        probable one is follows, (b,).
        """
        features = self.network.encoder(image)
        left, right = (
            read_logits(logits, self.network.planes) for logits in self.network.decode(features)
        )
        street = self.network.street_probability(features[-1])
        return *left, *right[:2], *(() if street is None else (street,))


def gathered_volume(
    left: Float[Tensor, "b c h w"], right: Float[Tensor, "b c h w"], bins: int
) -> Float[Tensor, "b c2 {bins} h w"]:
    """Make ``concatenation_volume`` by one gather in place of a copy a disparity."""
    column = torch.arange(left.shape[-1]) - torch.arange(bins)[:, None]
    is_inside = (column >= 0).to(left.dtype)
    sides = [left[..., None, :] * is_inside, right[..., column.clamp(min=0)] * is_inside]
    return torch.cat(sides, 1).transpose(2, 3)


class _Maps(NamedTuple):
    """Disparity [px], confidence, and 1 in the sky where it is known."""

    disparity_px: Value
    confidence: Value
    sky: Value | None = None


class _Generated(NamedTuple):
    """What a generator makes of left views."""

    right: Value
    left_maps: _Maps | None = None  # of a generator that estimates disparity
    street: Value | None = None  # probability that the image shows a street


def _generate(left: Value, generator: Generator) -> _Generated:
    """Do in ONNX operators what ``draw_right`` does, by ``select_views`` or by the U-Net."""
    size = left.op("Shape", start=2, end=4)
    multiple = generator.config.side_multiple_px
    # The multiple that a side is close to, or the side itself.
    sides = size.cast(np.float64)
    nearest = (sides / float(multiple)).op("Round").op("Max", 1.0) * float(multiple)
    limits = sides * np.array([ROWS_SHARE, COLUMNS_SHARE])
    is_near = (nearest - sides).op("Abs").op("LessOrEqual", limits)
    near = is_near.op("Where", nearest, sides).cast(np.int64)
    example = torch.rand(2, 3, 2 * multiple, 3 * multiple)
    if not isinstance(generator, SelectionGenerator):
        image = _resized_image(left, near) * _2 - _1
        network = network_model(generator, [example], multiple)
        (selection,) = left.graph.call(network, _mirrored(image, near, multiple))
        cropped = (selection + _1).slice([0, 0], near, [2, 3]) / _2
        return _Generated(_resized_image(cropped, size))
    even = (near / 2 * 2).op("Max", 2)  # since logits stand for two rows and two columns
    image = _mirrored(_resized_image(left, even), even, multiple)
    network = network_model(DynamicSelection(generator).eval(), [example], multiple)
    outputs = left.graph.call(network, image)
    maps = [m.slice([0, 0], even / 2, [1, 2]) for m in outputs[:5]]
    log_px, sky, match_confidence, right_log_px, right_sky = (_resized_map(m, size) for m in maps)
    scale = _ratio(size, even)
    is_sky = sky.op("Greater", _HALF)
    confidence = is_sky.op("Where", sky, match_confidence * (sky * np.float32(-1) + _1))
    of_left = _Maps(log_px.op("Exp") * scale, confidence, is_sky.cast(np.float32))
    right_px = right_sky.op("Greater", _HALF).op("Where", _0, right_log_px.op("Exp") * scale)
    street = outputs[5] if generator.config.with_street else None
    # Look the left image up at ``x + shift``; beyond the border the border repeats.
    graph = left.graph
    row, column = (  # 0, 1, ... of each side
        graph.op("Range", 0, _side(size, axis).op("Squeeze", [0]), 1).cast(np.float32)
        for axis in (0, 1)
    )
    y, x = (
        (values * _2 + _1) / _side(size, axis).cast(np.float32) - _1
        for axis, values in enumerate((row.op("Unsqueeze", [1]), right_px + column))
    )
    parts = (v.op("Expand", right_px.op("Shape")).op("Unsqueeze", [-1]) for v in (x, y))
    grid = graph.op("Concat", *parts, axis=-1)
    right = left.op("GridSample", grid, mode="bilinear", padding_mode="border", align_corners=0)
    return _Generated(right, of_left, street)


def _mirrored(image: Value, size: Value, multiple: int) -> Value:
    """Pad images at the right and below by mirroring, until both sides are multiples."""
    lacking = (size + (multiple - 1)) / multiple * multiple - size
    none = [0, 0]
    pads = image.graph.op("Concat", none, none, none, lacking, axis=0)
    return image.op("Pad", pads, mode="reflect")


_IMAGES = ("batch", 3, "height", "width")
_MAPS = ("batch", "height", "width")


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
    K = graph.input("K", np.float64, (3, 3)).op("Reshape", [-1])
    full = image.op("Shape", start=2, end=4)
    scaled = full.cast(np.float64) * float(rig.virtual_focal_px) / K.op("Gather", [4, 0])
    small = scaled.op("Round").op("Max", 1.0).cast(np.int64)
    left = _resized_image(image, small)
    right, of_left, street = _generate(left, generator)
    maps = of_left
    if rig.answer == "matched":
        assert weights.matcher is not None, "checked before"
        maps = _matched(left, right, np.array([rig.virtual_focal_px] * 2), weights.matcher)
        if of_left is not None:
            maps = maps._replace(sky=of_left.sky)
    assert maps is not None
    disparity_px = _resized_map(maps.disparity_px, full) * _ratio(full, small)
    # Depth is that over disparity.
    focal_m_px = K.op("Gather", 0).cast(np.float32) * np.float32(rig.virtual_baseline_m)
    is_known = disparity_px.op("Greater", _0)
    depth_m = is_known.op("Where", focal_m_px / disparity_px, np.float32(np.nan))
    if maps.sky is not None:
        is_sky = _resized_map(maps.sky, full).op("Greater", _HALF)
        depth_m = is_sky.op("Where", np.float32(np.nan), depth_m)
        disparity_px = is_sky.op("Where", focal_m_px / np.float32(SKY_M), disparity_px)
        graph.output("is_sky", is_sky, np.bool_, _MAPS)
    graph.output("depth_m", depth_m, np.float32, _MAPS)
    graph.output("disparity_px", disparity_px, np.float32, _MAPS)
    graph.output("confidence", _resized_map(maps.confidence, full), np.float32, _MAPS)
    graph.output("right", _resized_image(right, full), np.float32, _IMAGES)
    if street is not None:
        graph.output("image_confidence", street, np.float32, ("batch",))
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
    graph = Graph()
    left = graph.input("left", np.float32, _IMAGES)
    right = graph.input("right", np.float32, _IMAGES)
    focal_px = None
    if getattr(weights.matcher.config, "work_focal_px", None) is not None:
        K = graph.input("K", np.float64, (3, 3))
        focal_px = K.op("Reshape", [-1]).op("Gather", [4, 0])
    disparity_px, confidence, sky = _matched(left, right, focal_px, weights.matcher)
    if sky is not None:
        is_sky = sky.op("Greater", _HALF)
        disparity_px = is_sky.op("Where", np.float32(LEAST_PX), disparity_px)
        graph.output("is_sky", is_sky, np.bool_, _MAPS)
    graph.output("disparity_px", disparity_px, np.float32, _MAPS)
    graph.output("confidence", confidence, np.float32, _MAPS)
    return graph


def _matched(
    left: Value, right: Value, focal_px: Value | np.ndarray | None, matcher: StereoNetwork
) -> _Maps:
    """Match at the focal length that the weights need, and resize the result to the images."""
    if type(matcher) not in DYNAMIC_SHAPE_NETWORKS:
        kinds = ", ".join(kind.__name__ for kind in DYNAMIC_SHAPE_NETWORKS)
        raise InputError(
            f"the matcher is {type(matcher).__name__}, and no file is made of it; give weights of "
            f"one of {kinds}."
        )
    network = DYNAMIC_SHAPE_NETWORKS[type(matcher)](matcher).eval()
    config = matcher.config
    graph = left.graph
    size = work = left.op("Shape", start=2, end=4)
    if config.work_focal_px is not None:
        scaled = size.cast(np.float64) * float(config.work_focal_px) / focal_px
        work = scaled.op("Round").op("Max", 1.0).cast(np.int64)
    least = config.min_side_px
    step = config.step_px
    lacking = ((work + (step - 1)) / step * step).op("Max", least) - work
    above = _side(lacking, 0)
    beside = _side(lacking, 1)
    pads = graph.op("Concat", [0, 0], above, [0, 0, 0, 0], beside, axis=0)
    mean, deviation = (
        np.array(v, np.float32)[:, None, None] for v in (IMAGENET_MEAN, IMAGENET_STD)
    )
    padded = [
        ((_resized_image(view, work) - mean) / deviation).op("Pad", pads) for view in (left, right)
    ]
    example = [torch.rand(2, 3, least + step, least + 2 * step) for _ in range(2)]
    maps = graph.call(network_model(network, example, step), *padded)
    first = graph.op("Concat", above, [0], axis=0)
    last = graph.op("Concat", [1 << 62], _side(work, 1), axis=0)
    disparity_px, confidence, *sky = (
        _resized_map(m.slice(first, last, [1, 2]), size) for m in maps
    )
    is_sky = [values.op("Greater", _HALF).cast(np.float32) for values in sky]
    return _Maps(disparity_px * _ratio(size, work), confidence, *is_sky)


_LIMITS = {
    "depth_m": Limit(value=0.01, is_relative=True),
    "disparity_px": Limit(value=0.05),
    # A disparity is near the answer or not: where one lies on that border, confidence jumps.
    "confidence": Limit(value=1e-3, of="mean"),
    "right": Limit(value=1e-3),
    "image_confidence": Limit(value=1e-3),
}
_FLIPS = 1e-3
"""Share of pixels that may be sky in one answer alone, with all that follows from it."""
_FLIPPING_LIMITS = {
    name: limit if limit.of == "mean" else replace(limit, flips=_FLIPS)
    for name, limit in _LIMITS.items()
} | {"is_sky": Limit(value=_FLIPS, of="mean")}
"""Where two scores tie, the last bit decides between candidates."""
_FLIPPING: tuple[type[StereoNetwork], ...] = (LightStereo,)
"""Matchers that choose between candidates."""


@dataclass(frozen=True)
class _Size:
    """Of the images of a case: how many, and their focal length as a share of the network's."""

    rows: int
    columns: int
    focal_share: float
    count: int = 1


_SIZES = (
    _Size(256, 512, 1.0),
    _Size(375, 1242, 2.0),
    _Size(190, 300, 0.8, count=2),
    _Size(233, 401, 1.3),
)
"""A multiple of what the networks take; one that is stretched to it; one that is enlarged; one that
is padded."""
_SHIFT_PX = 6
_SKY = (0.72, 0.82, 0.95)
"""RGB of the sky at its brightest."""
_QUICK = MatcherConfig(speed="quick")
"""Graphs match pairs at the focal length of the weights' training."""
_LEAST_PX = 1.0
"""Disparity from which depths are compared."""


@dataclass(frozen=True, kw_only=True)
class Target:
    """What a graph computes."""

    fits: Callable[[DepthWeights], bool]  # whether it is what weights are exported as by default
    export: Callable[[DepthWeights, dict[str, Any]], Export]  # of weights, and facts for its user


def depth_export(weights: DepthWeights, what: str | None, facts: dict[str, Any]) -> Export:
    """Describe the file that weights are exported to."""
    if what is None:
        what = next(name for name, target in TARGETS.items() if target.fits(weights))
    refuse_unknown("what", what, TARGETS)
    return TARGETS[what].export(weights, facts)


def _pair_export(weights: DepthWeights, facts: dict[str, Any]) -> Export:
    """Describe the export of a matcher: its graph, and cases by which the graph is proven."""

    def cases() -> Iterator[Case]:
        """Match synthetic pairs of several sizes by PyTorch."""
        assert weights.matcher is not None
        matcher = make_matcher(weights.matcher, _QUICK)
        if isinstance(matcher, NetworkMatcher):
            matcher.finds_range = False  # nor does a graph
        net = FakestereoNet(matcher)
        sky = ("is_sky",) if getattr(weights.matcher.config, "with_sky", False) else ()
        work_px = weights.matcher.config.work_focal_px
        for size in _SIZES:
            left, right, camera = _scenes(size, work_px or 1.0, with_sky=bool(sky))
            inputs = {"left": left.numpy(), "right": right.numpy()}
            rig = None
            if work_px is not None:
                rig = StereoRig(
                    width=camera.width, height=camera.height, K=camera.K, baseline_m=0.5
                )
                inputs["K"] = camera.K.numpy()
            pairs = (
                StereoInput(name="proof", left=left_view, right=right_view, camera=rig)
                for left_view, right_view in zip(left, right, strict=True)
            )
            estimates = [net.estimate_pair(pair, with_check=False) for pair in pairs]
            yield _case(inputs, estimates, ("disparity_px", "confidence", *sky))

    return Export(
        graph=lambda: pair_graph(weights),
        cases=cases,
        limits=_FLIPPING_LIMITS if isinstance(weights.matcher, _FLIPPING) else _LIMITS,
        facts={**facts, "what": "rectified pair, RGB in [0, 1] -> disparity [px], ..."},
    )


def _image_export(weights: DepthWeights, facts: dict[str, Any]) -> Export:
    """Describe the export of a generator: its graph, and cases by which the graph is proven."""

    def cases() -> Iterator[Case]:
        """Estimate synthetic images of several sizes by PyTorch."""
        assert weights.generator is not None
        matcher = None if weights.matcher is None else make_matcher(weights.matcher, _QUICK)
        # The scenes of the proof need not be like the images that the weights were trained on.
        synthesiser = make_synthesiser(weights.generator, speed=_QUICK.speed)
        net = FakestereoNet(matcher, synthesiser, allow_ood=True)
        selects = isinstance(weights.generator, SelectionGenerator)
        matcher_config = None if weights.matcher is None else weights.matcher.config
        sky = ("is_sky",) if selects or getattr(matcher_config, "with_sky", False) else ()
        street = ("image_confidence",) if getattr(weights.generator, "street", None) else ()
        for size in _SIZES:
            focal_px = weights.generator.config.virtual_focal_px
            images, _, camera = _scenes(size, focal_px, with_sky=bool(sky))
            inputs = {"image": images.numpy(), "K": camera.K.numpy()}
            # A depth beyond all bounds, or none, hangs on the last bit of a disparity near zero.
            views = (
                StereoInput(name="proof", left=view, right=None, camera=camera) for view in images
            )
            estimates = [net.estimate_pair(view) for view in views]
            case = _case(
                inputs, estimates, ("depth_m", "disparity_px", "confidence", "right", *sky, *street)
            )
            is_near = case.expected["disparity_px"] >= _LEAST_PX
            compared = {"depth_m": is_near | case.expected["is_sky"] if sky else is_near}
            yield replace(case, where=compared)

    generator = weights.generator
    names = ("virtual_focal_px", "virtual_baseline_m", "answer")
    rig = {} if generator is None else {name: getattr(generator.config, name) for name in names}
    chooses = isinstance(generator, SelectionGenerator) or isinstance(weights.matcher, _FLIPPING)
    return Export(
        graph=lambda: image_graph(weights),
        cases=cases,
        limits=_FLIPPING_LIMITS if chooses else _LIMITS,
        facts={**facts, **rig, "what": "image, RGB in [0, 1], and K [px] -> depth [m], ..."},
    )


TARGETS = {
    "image": Target(fits=lambda weights: weights.generator is not None, export=_image_export),
    "pair": Target(fits=lambda weights: weights.matcher is not None, export=_pair_export),
}
"""One image to depth, a rectified pair to disparity: a new target is a function and one entry."""


def _case(
    inputs: dict[str, np.ndarray], estimates: list[DepthEstimate], outputs: tuple[str, ...]
) -> Case:
    """Make a case of inputs and of what PyTorch estimates from them."""
    expected = {
        name: torch.stack(
            [torch.as_tensor(getattr(estimate, name)) for estimate in estimates]
        ).numpy()
        for name in outputs
    }
    shape = next(iter(inputs.values())).shape
    return Case(name="x".join(map(str, shape)), inputs=inputs, expected=expected)


def _scenes(
    size: _Size, network_focal_px: float, *, with_sky: bool
) -> tuple[Tensor, Tensor, Camera]:
    """Make pairs of smooth noise, the right view moved by one disparity, and their camera."""
    rows = size.rows
    columns = size.columns
    f = size.focal_share * network_focal_px
    K = torch.tensor([[f, 0, columns / 2], [0, f, rows / 2], [0, 0, 1]], dtype=torch.float64)
    camera = Camera(width=columns, height=rows, K=K)
    shift = round(_SHIFT_PX * size.focal_share)
    chance = torch.Generator().manual_seed(0)
    noise = torch.rand(size.count, 3, rows // 6, columns // 6, generator=chance)
    scene = F.interpolate(noise, (rows, columns + shift), mode="bicubic").clamp(0, 1)
    if with_sky:  # bright and nearly without texture, over the upper two fifths
        top = rows * 2 // 5
        sky = torch.tensor(_SKY)[:, None, None] * torch.linspace(0.9, 1.0, top)[:, None]
        scene[:, :, :top] = torch.lerp(scene[:, :, :top], sky, 0.97)
    return scene[..., :columns].contiguous(), scene[..., shift:].contiguous(), camera
