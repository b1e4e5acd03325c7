"""Export targets of depth weights, and the estimates that their graphs are compared with."""

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any, cast

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from depthpose.core.camera import Camera, StereoRig
from depthpose.core.errors import refuse_unknown
from depthpose.core.export import Case, Export, Limit
from depthpose.depth.config import MatcherConfig
from depthpose.depth.estimator import FakestereoNet
from depthpose.depth.export.graph import image_graph, pair_graph
from depthpose.depth.stereo import LightStereo, StereoNetwork, make_matcher
from depthpose.depth.stereo.matcher import NetworkConfig
from depthpose.depth.synthesis import SelectionGenerator, make_synthesiser
from depthpose.depth.types import DepthEstimate, StereoInput
from depthpose.depth.weights import DepthWeights

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
    name: limit if limit.of == "mean" else dataclasses.replace(limit, flips=_FLIPS)
    for name, limit in _LIMITS.items()
} | {"is_sky": Limit(value=_FLIPS, of="mean")}
"""Where two scores tie, the last bit decides between candidates."""
_FLIPPING: tuple[type[StereoNetwork], ...] = (LightStereo,)
"""Matchers that choose between candidates."""
_PAIR_OUTPUTS = ("disparity_px", "confidence")
_SIZES = ((256, 512, 1.0, 1), (375, 1242, 2.0, 1), (190, 300, 0.8, 2), (233, 401, 1.3, 1))
"""Rows, columns, focal length over the one that the weights want, images: a multiple of what the
networks take; one that is stretched to it; one that is enlarged; one that is padded."""
_SHIFT_PX = 6
_SKY = (0.72, 0.82, 0.95)
"""RGB of the sky at its brightest."""
_QUICK = MatcherConfig(speed="quick")
"""Graphs match pairs at the focal length of the weights' training."""
_LEAST_PX = 1.0
"""Disparity from which depths are compared."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Target:
    """What a graph computes.

    Attributes:
        fits: whether it is what weights are exported as by default.
        export: makes the graph and its test cases of weights and further facts for its user.
    """

    fits: Callable[[DepthWeights], bool]
    export: Callable[[DepthWeights, dict[str, Any]], Export]


def depth_export(weights: DepthWeights, what: str | None, facts: dict[str, Any]) -> Export:
    """Describe the file that weights are exported to."""
    if what is None:
        what = next(name for name, target in TARGETS.items() if target.fits(weights))
    refuse_unknown("what", what, TARGETS)
    return TARGETS[what].export(weights, facts)


def _pair_export(weights: DepthWeights, facts: dict[str, Any]) -> Export:
    return Export(
        graph=lambda: pair_graph(weights),
        cases=lambda: _pair_cases(weights),
        limits=_FLIPPING_LIMITS if isinstance(weights.matcher, _FLIPPING) else _LIMITS,
        facts={**facts, "what": "rectified pair, RGB in [0, 1] -> disparity [px], ..."},
    )


def _image_export(weights: DepthWeights, facts: dict[str, Any]) -> Export:
    names = ("virtual_focal_px", "virtual_baseline_m", "answer")
    generator = weights.generator
    rig = {} if generator is None else {name: getattr(generator.config, name) for name in names}
    selects = isinstance(weights.generator, SelectionGenerator)
    chooses = selects or isinstance(weights.matcher, _FLIPPING)
    return Export(
        graph=lambda: image_graph(weights),
        cases=lambda: _image_cases(weights),
        limits=_FLIPPING_LIMITS if chooses else _LIMITS,
        facts={**facts, **rig, "what": "image, RGB in [0, 1], and K [px] -> depth [m], ..."},
    )


TARGETS = {
    "image": Target(fits=lambda weights: weights.generator is not None, export=_image_export),
    "pair": Target(fits=lambda weights: weights.matcher is not None, export=_pair_export),
}
"""One image to depth, a rectified pair to disparity: a new target is a function and one entry."""


def _image_cases(weights: DepthWeights) -> Iterator[Case]:
    assert weights.generator is not None
    matcher = None if weights.matcher is None else make_matcher(weights.matcher, _QUICK)
    # The scenes of the proof need not be like the images that the weights were trained on.
    synthesiser = make_synthesiser(weights.generator, speed=_QUICK.speed)
    net = FakestereoNet(matcher, synthesiser, allow_ood=True)
    selects = isinstance(weights.generator, SelectionGenerator)
    sky = ("is_sky",) if selects or _sees_sky(weights.matcher) else ()
    street = ("image_confidence",) if getattr(weights.generator, "street", None) else ()
    for size in _SIZES:
        scenes, _ = _scenes(*size)
        images = _under_sky(scenes) if sky else scenes
        camera = _camera(size, weights.generator.config.virtual_focal_px)
        given = [StereoInput(name="proof", left=one, right=None, camera=camera) for one in images]
        inputs = {"image": images.numpy(), "K": camera.K.numpy()}
        # A depth beyond all bounds, or none, is a matter of the last bit of a disparity near zero.
        found = [net.estimate_pair(one) for one in given]
        case = _case(inputs, found, ("depth_m", *_PAIR_OUTPUTS, "right", *sky, *street))
        is_near = case.expected["disparity_px"] >= _LEAST_PX
        where = {"depth_m": is_near | case.expected["is_sky"] if sky else is_near}
        yield dataclasses.replace(case, where=where)


def _pair_cases(weights: DepthWeights) -> Iterator[Case]:
    assert weights.matcher is not None
    net = FakestereoNet(make_matcher(weights.matcher, _QUICK))
    sky = ("is_sky",) if _sees_sky(weights.matcher) else ()
    work_px = cast("NetworkConfig", weights.matcher.config).work_focal_px
    for size in _SIZES:
        left, right = _scenes(*size)
        if sky:
            left, right = _under_sky(left), _under_sky(right)
        inputs = {"left": left.numpy(), "right": right.numpy()}
        rig = None
        if work_px is not None:
            camera = _camera(size, work_px)
            rig = StereoRig(width=camera.width, height=camera.height, K=camera.K, baseline_m=0.5)
            inputs["K"] = camera.K.numpy()
        found = [
            net.estimate_pair(
                StereoInput(name="proof", left=one, right=other, camera=rig), with_check=False
            )
            for one, other in zip(left, right, strict=True)
        ]
        yield _case(inputs, found, (*_PAIR_OUTPUTS, *sky))


def _sees_sky(matcher: StereoNetwork | None) -> bool:
    return matcher is not None and getattr(matcher.config, "with_sky", False)


def _case(
    inputs: dict[str, np.ndarray], found: list[DepthEstimate], outputs: tuple[str, ...]
) -> Case:
    expected = {
        name: torch.stack([torch.as_tensor(getattr(one, name)) for one in found]).numpy()
        for name in outputs
    }
    shape = next(iter(inputs.values())).shape
    return Case(name="x".join(map(str, shape)), inputs=inputs, expected=expected)


def _camera(size: tuple[int, int, float, int], focal_px: float) -> Camera:
    rows, columns, share, _ = size
    f = share * focal_px
    K = torch.tensor([[f, 0, columns / 2], [0, f, rows / 2], [0, 0, 1]], dtype=torch.float64)
    return Camera(width=columns, height=rows, K=K)


def _under_sky(images: Tensor) -> Tensor:
    """Lay a bright, smooth sky over the upper two fifths, for weights that know the sky."""
    rows = images.shape[2] * 2 // 5
    sky = torch.tensor(_SKY)[:, None, None] * torch.linspace(0.9, 1.0, rows)[:, None]
    hazy = torch.lerp(images[:, :, :rows], sky, 0.97)
    return torch.cat([hazy, images[:, :, rows:]], 2)


def _scenes(rows: int, columns: int, share: float, count: int) -> tuple[Tensor, Tensor]:
    """Make images of smooth noise, and the same moved to the left: pairs that match everywhere."""
    shift = round(_SHIFT_PX * share)
    noise = torch.rand(
        count, 3, rows // 6, columns // 6, generator=torch.Generator().manual_seed(0)
    )
    scene = F.interpolate(noise, (rows, columns + shift), mode="bicubic").clamp(0, 1)
    return scene[..., :columns].contiguous(), scene[..., shift:].contiguous()
