"""Exports of depth: ONNX graphs, each with the cases by which it is compared with PyTorch."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from depthpose.core.camera import Camera, StereoRig
from depthpose.core.errors import refuse_unknown
from depthpose.core.export import Case, Export, Limit
from depthpose.depth.config import MatcherConfig, SelectionConfig
from depthpose.depth.estimator import FakestereoNet
from depthpose.depth.generators import SelectionGenerator
from depthpose.depth.graphs import EXPORTED_MATCHERS, image_graph, pair_graph
from depthpose.depth.stereo import Matcher, match_in_usual_range
from depthpose.depth.synthesis import make_synthesiser
from depthpose.depth.triangulation import estimate_from_pair
from depthpose.depth.types import DepthEstimate, DepthInput, View
from depthpose.depth.weights import DepthWeights, make_matcher

_LIMITS = {
    "depth_m": Limit(value=0.01, is_relative=True),
    "disparity_px": Limit(value=0.05),
    # Its mean: single values jump where a plane lies at the border of those that count as near.
    "confidence": Limit(value=1e-3, of="mean"),
    "right": Limit(value=1e-3),
    "image_confidence": Limit(value=1e-3),
}
_MAX_FLIPPED_SHARE = 1e-3
"""Share of pixels that may be sky in one result and not in the other, and so differ in all maps."""
_SELECTING_LIMITS = {
    name: limit if limit.of == "mean" else replace(limit, flips=_MAX_FLIPPED_SHARE)
    for name, limit in _LIMITS.items()
} | {"is_sky": Limit(value=_MAX_FLIPPED_SHARE, of="mean")}
"""Limits of networks that choose between candidates: where two scores tie, the last bit decides."""


@dataclass(frozen=True)
class _CaseSize:
    """Size and number of the images of a case."""

    rows: int
    columns: int
    focal_share: float  # focal length as a share of the network's
    count: int = 1


_CASE_SIZES = (
    _CaseSize(256, 512, 1.0),
    _CaseSize(375, 1242, 2.0),
    _CaseSize(190, 300, 0.8, count=2),
    _CaseSize(233, 401, 1.3),
)
"""Sides that networks take; sides that are stretched to such; images that are enlarged; and sides
that are padded."""
_SHIFT_PX = 6
"""Disparity of the scenes at the network's focal length."""
_SKY_COLOR = (0.72, 0.82, 0.95)
"""RGB of the sky at its brightest."""
_SKY_SHARE = 0.97
"""Share of the sky in its pixels; the rest is noise, so that it has a little texture."""
_QUICK = MatcherConfig(speed="quick")
"""Graphs match pairs at the focal length of the weights' training, as this speed does."""
_MIN_COMPARED_PX = 1.0
"""Disparity from which depths are compared: below it depth depends on the last bit of disparity."""


@dataclass(frozen=True, kw_only=True)
class Target:
    """A kind of graph that weights are exported as."""

    fits: Callable[[DepthWeights], bool]  #: whether it is the default for weights
    #: makes the export of weights, with facts for the user of the file
    export: Callable[[DepthWeights, dict[str, Any]], Export]


def make_export(weights: DepthWeights, what: str | None, facts: dict[str, Any]) -> Export:
    """Make the export of weights: functions for its graph and for cases to test it, and facts.

    Args:
        weights: the networks.
        what: a key of ``TARGETS``; None: the first that fits the weights.
        facts: facts of the weights, for the user of the file, by name.

    Raises:
        InputError: there is no such target.
    """
    if what is None:
        what = next(name for name, target in TARGETS.items() if target.fits(weights))
    refuse_unknown("what", what, TARGETS)
    return TARGETS[what].export(weights, facts)


def _make_pair_export(weights: DepthWeights, facts: dict[str, Any]) -> Export:
    """Make the export of a matcher: its graph, and cases that compare it with PyTorch."""
    return Export(
        graph=lambda: pair_graph(weights),
        cases=lambda: _make_pair_cases(weights),
        limits=_SELECTING_LIMITS if _has_selecting_matcher(weights) else _LIMITS,
        facts={**facts, "what": "rectified pair, RGB in [0, 1] -> disparity [px], ..."},
    )


def _has_selecting_matcher(weights: DepthWeights) -> bool:
    """Whether weights have a matcher that chooses between candidates."""
    if weights.matcher is None:
        return False
    exported = EXPORTED_MATCHERS.get(type(weights.matcher))
    return exported is not None and exported.is_selecting


def _make_pair_cases(weights: DepthWeights) -> Iterator[Case]:
    """Make cases of synthetic pairs of several sizes, with PyTorch's estimates."""
    assert weights.matcher is not None
    matcher = make_matcher(weights.matcher, _QUICK)
    outputs = ["disparity_px", "confidence"]
    has_sky = weights.matcher.config.with_sky
    if has_sky:
        outputs.append("is_sky")
    work_focal_px = weights.matcher.config.work_focal_px
    for size in _CASE_SIZES:
        # Without a focal length of its own, the network does not use the camera.
        left, right, camera = _make_scenes(size, work_focal_px or 1.0, with_sky=has_sky)
        inputs = {"left": left.numpy(), "right": right.numpy()}
        rig = None
        if work_focal_px is not None:
            rig = StereoRig(width=camera.width, height=camera.height, K=camera.K, baseline_m=0.5)
            inputs["K"] = camera.K.numpy()
        pairs = zip(left, right, strict=True)
        estimates = [_estimate_as_graph(matcher, *pair, rig) for pair in pairs]
        yield _make_case(inputs, estimates, outputs)


def _estimate_as_graph(
    matcher: Matcher, left: View, right: View, rig: StereoRig | None
) -> DepthEstimate:
    """Estimate depth of a pair as a graph does, which does not measure its disparities."""
    pair = DepthInput(name="case", left=left, right=right, camera=rig)
    return estimate_from_pair(pair, match_in_usual_range(matcher, left, right, rig))


def _make_image_cases(weights: DepthWeights) -> Iterator[Case]:
    """Make cases of synthetic images of several sizes, with PyTorch's estimates."""
    assert weights.generator is not None
    matcher = None if weights.matcher is None else make_matcher(weights.matcher, _QUICK)
    # The scenes need not be like the images that the weights were trained on.
    synthesiser = make_synthesiser(weights.generator, speed=_QUICK.speed)
    net = FakestereoNet(matcher, synthesiser, allow_ood=True)
    outputs = ["depth_m", "disparity_px", "confidence", "right"]
    generator_config = weights.generator.config
    has_sky = isinstance(generator_config, SelectionConfig)
    if weights.matcher is not None:
        has_sky = has_sky or weights.matcher.config.with_sky
    if has_sky:
        outputs.append("is_sky")
    if isinstance(generator_config, SelectionConfig) and generator_config.with_street:
        outputs.append("image_confidence")
    focal_px = generator_config.virtual_focal_px
    for size in _CASE_SIZES:
        images, _, camera = _make_scenes(size, focal_px, with_sky=has_sky)
        inputs = {"image": images.numpy(), "K": camera.K.numpy()}
        views = (DepthInput(name="case", left=view, right=None, camera=camera) for view in images)
        estimates = [net.estimate_input(view) for view in views]
        case = _make_case(inputs, estimates, outputs)
        is_compared = case.expected["disparity_px"] >= _MIN_COMPARED_PX
        if has_sky:
            is_compared = is_compared | case.expected["is_sky"]
        yield replace(case, where={"depth_m": is_compared})


def _make_image_export(weights: DepthWeights, facts: dict[str, Any]) -> Export:
    """Make the export of a generator: its graph, and cases that compare it with PyTorch."""
    generator = weights.generator
    rig_facts: dict[str, Any] = {}
    if generator is not None:
        names = ("virtual_focal_px", "virtual_baseline_m", "answer")
        rig_facts = {name: getattr(generator.config, name) for name in names}
    is_selecting = isinstance(generator, SelectionGenerator) or _has_selecting_matcher(weights)
    return Export(
        graph=lambda: image_graph(weights),
        cases=lambda: _make_image_cases(weights),
        limits=_SELECTING_LIMITS if is_selecting else _LIMITS,
        facts={**facts, **rig_facts, "what": "image, RGB in [0, 1], and K [px] -> depth [m], ..."},
    )


TARGETS = {
    "image": Target(fits=lambda weights: weights.generator is not None, export=_make_image_export),
    "pair": Target(fits=lambda weights: weights.matcher is not None, export=_make_pair_export),
}
"""One image to depth, a rectified pair to disparity: a new target is a function and one entry."""


def _make_case(
    inputs: dict[str, np.ndarray], estimates: list[DepthEstimate], outputs: Sequence[str]
) -> Case:
    """Make a case of inputs and of the fields ``outputs`` of PyTorch's estimates from them."""
    expected: dict[str, np.ndarray] = {}
    for output in outputs:
        values = [torch.as_tensor(getattr(estimate, output)) for estimate in estimates]
        expected[output] = torch.stack(values).numpy()
    shape = next(iter(inputs.values())).shape
    return Case(name="x".join(map(str, shape)), inputs=inputs, expected=expected)


def _make_scenes(
    size: _CaseSize, network_focal_px: float, *, with_sky: bool
) -> tuple[Tensor, Tensor, Camera]:
    """Make left and right views of smooth noise, shifted by one disparity, and their camera.

    ``network_focal_px``: focal length at which the network sees images.
    """
    rows = size.rows
    columns = size.columns
    focal_px = size.focal_share * network_focal_px
    K = torch.tensor(
        [[focal_px, 0, columns / 2], [0, focal_px, rows / 2], [0, 0, 1]], dtype=torch.float64
    )
    camera = Camera(width=columns, height=rows, K=K)
    shift = round(_SHIFT_PX * size.focal_share)
    random = torch.Generator().manual_seed(0)
    # Coarse noise, enlarged about six times, so that it is smooth.
    noise = torch.rand(size.count, 3, rows // 6, columns // 6, generator=random)
    scene = F.interpolate(noise, (rows, columns + shift), mode="bicubic").clamp(0, 1)
    if with_sky:  # bright and nearly without texture, over the upper two fifths
        sky_rows = rows * 2 // 5
        brightness = torch.linspace(0.9, 1.0, sky_rows)[:, None]
        sky = torch.tensor(_SKY_COLOR)[:, None, None] * brightness
        scene[:, :, :sky_rows] = torch.lerp(scene[:, :, :sky_rows], sky, _SKY_SHARE)
    return scene[..., :columns].contiguous(), scene[..., shift:].contiguous(), camera
