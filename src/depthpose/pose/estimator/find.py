"""Known objects in a depth image without a mask: regions, hypotheses, and answers that agree."""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from depthpose.core.camera import back_project, project
from depthpose.core.rigid import Rigid
from depthpose.pose.augment import grow_mask
from depthpose.pose.config import RefusalConfig
from depthpose.pose.estimator.candidates import share_out
from depthpose.pose.estimator.fit import BORDER_PX
from depthpose.pose.estimator.inputs import nothing_seen
from depthpose.pose.regions import (
    extent_m,
    find_regions,
    is_on_plane,
    largest_plane,
    part_cloud,
)
from depthpose.pose.surface import NEAR, Surface
from depthpose.pose.types import CloudInput, ObjectModel, PoseEstimate, ViewInput

_SMALLEST, _LARGEST = 0.25, 1.25
"""Shares of an object's diameter between which the extent of a region may lie."""
_AREA = 0.3
"""A region of less than this share of an object's smallest silhouette leaves most of it unseen."""
_TOGETHER = 1.25
"""Two regions may be parts of one object where together they are no longer than this: the length
of a bent thing, measured from its median, comes out too long."""
_MOST_PAIRS = 20
_FRAGMENT = 0.03
"""A region of fewer points than this share of another adds nothing to it."""
_HIDDEN = 0.5
"""Of the surface that faces the camera: where more is unseen, the rest fits too many places."""
_REST = 0.25
"""A region of which so large a share is unexplained is tried again without the rest."""
_LEAST_POINTS = 60
_SHARED = 0.3
"""Answers that explain so large a share of the same points are of one thing; one of them stays."""
_SUNK = 0.15
"""Where a table or wall lies before more of the posed surface, there is no such object."""
_FLAT = 0.9
"""What lies on one plane by so large a share is flat: anything of its outline looks the same."""
_CONTINUED = 0.4
"""Where the plane goes on beside so much of it, the outline is a cut through something larger."""
_RIM = 0.05
"""Width of what is looked at beside it, in diameters."""
_NAMED = 0.02
"""Other objects of a larger share are named."""
_ONE = 0.8
"""Where no object among several has so large a share of the probability, none is answered."""
_WHOLE, _HALF = 0.9, 0.5
"""An answer explains so much of its region, or half of it and leaves enough for another object:
a region slightly larger than the object is another object, but for what a sensor adds to its edge:
of real objects 0.93 and 0.94 were explained."""

EstimateMany = Callable[[Sequence[CloudInput]], list[PoseEstimate]]


@dataclass(frozen=True, kw_only=True, eq=False)
class SearchTargets:
    """What is looked for.

    Attributes:
        models: the objects, by name.
        surface_of: gives the surface of an object by its name.
        refusal: how its candidates are compared.
        estimate_many: clouds to poses.
    """

    models: Mapping[str, ObjectModel]
    surface_of: Callable[[str], Surface]
    refusal: RefusalConfig
    estimate_many: EstimateMany


@dataclass(frozen=True, kw_only=True, eq=False)
class _Scene:
    """A view, and which of its pixels show a plane that was taken away."""

    view: ViewInput
    is_plane: Bool[Tensor, "h w"]


@dataclass(frozen=True, kw_only=True, eq=False)
class _Answer:
    """An answer for a region, and which of all readings it explains."""

    estimate: PoseEstimate
    points_m: Float[Tensor, "n 3"]
    explained: Tensor
    share: float

    @property
    def is_whole(self) -> bool:
        """Whether what it leaves of its region is nothing, or something of its own."""
        explained = float(self.explained.double().mean())
        return explained >= _WHOLE or _HALF <= explained <= 1 - _REST

    @property
    def worth(self) -> float:
        """How sure it is, and how much it explains: of two that are equally sure the larger."""
        fit = self.estimate.fit
        agrees = 1.0 if fit is None else fit.agrees
        return agrees * self.share * float(self.explained.double().mean())


def find_objects(view: ViewInput, known: SearchTargets) -> list[PoseEstimate]:
    """Pose every known object that a depth image shows, the surest first; what is none is left out.

    Regions are tried for every object whose size they may have; so are their pieces beside narrow
    necks, pairs of them that may be parts of one object, and parts of one that is too long. Where
    several objects answer they share the probability of one by the evidence against each, and where
    none has most of it none is answered. What an
    answer leaves unexplained of its region is tried once more. An answer is left out through whose
    surface the camera saw, or that lies behind a plane that was seen, or is cut out of one, or that
    explains not quite all of its region; of answers that explain the same points the best stays.

    Args:
        view: depth and camera; its mask limits where is looked.
        known: what for.
    """
    largest_m = max(model.diameter_m for model in known.models.values())
    depth_m = torch.where(view.mask, view.depth_m, torch.nan)
    regions = find_regions(depth_m, view.K, largest_m)
    whole = regions.clouds_m
    clouds = [*whole, *regions.pieces_m, *_pairs(whole, largest_m), *_parts(whole, largest_m)]
    scene = _Scene(view=view, is_plane=regions.is_plane)
    answers = _estimate_regions(clouds, scene, known)
    rest = [answer.points_m[~answer.explained] for answer in answers]
    again = [cloud for cloud, answer in zip(rest, answers, strict=True)
             if len(cloud) >= max(_LEAST_POINTS, _REST * len(answer.points_m))]  # fmt: skip
    answers += _estimate_regions(again, scene, known)
    kept = _without_overlap([a for a in answers if a.is_whole], known)
    kept = [answer for answer in kept if answer.share >= _ONE]  # the others may be another object
    return [replace(a.estimate, name=f"{view.name}_{k}") for k, a in enumerate(kept)]


def nothing_found(view: ViewInput, object: str, spent_s: float = 0.0) -> PoseEstimate:
    """Say that a depth image shows no object, or none of several, surely."""
    read_m = view.depth_m[view.mask & (view.depth_m > 0)]
    spent = {"check": spent_s}
    if len(read_m) == 0:
        return PoseEstimate(
            name=view.name,
            object=object,
            status="too few points",
            reason=nothing_seen(view),
            seconds=spent,
        )
    return PoseEstimate(
        name=view.name,
        object=object,
        status="doubtful",
        reason=f"nothing beside the planes of the image is surely {object}; its depths are "
        f"{float(read_m.min()):.3g} to {float(read_m.max()):.3g} m: if they are right, give a "
        "mask, or look from nearer by",
        seconds=spent,
    )


def _pairs(clouds: Sequence[Tensor], largest_m: float) -> list[Tensor]:
    """Join regions that may be two parts of one object, something before it or a thin place."""
    joined: list[Tensor] = []
    for a, first in enumerate(clouds):
        for second in clouds[a + 1 :]:
            apart_m = float((first.median(0).values - second.median(0).values).norm())
            if apart_m > largest_m or len(second) < _FRAGMENT * len(first):
                continue
            both = torch.cat([first, second])
            if extent_m(both) <= _TOGETHER * largest_m:
                joined.append(both)
    return joined[:_MOST_PAIRS]


def _parts(clouds: Sequence[Tensor], largest_m: float) -> list[Tensor]:
    """Split regions that are too long for one object."""
    parts: list[Tensor] = []
    for cloud in clouds:
        times = extent_m(cloud) / largest_m
        if _LARGEST < times < math.inf:
            parts += part_cloud(cloud, min(4, 1 + round(times)))
    return [part for part in parts if len(part) >= _LEAST_POINTS]


def _estimate_regions(
    clouds: Sequence[Tensor], scene: _Scene, known: SearchTargets
) -> list[_Answer]:
    """Estimate every object of its size from every cloud; give the best of each cloud."""
    view, inputs = scene.view, list[tuple[int, CloudInput]]()
    for k, cloud in enumerate(clouds):
        inputs += [
            (k, CloudInput(name=f"{view.name}_{k}", points_m=cloud, object=name, view=view))
            for name in _of_this_size(cloud, view, known)
        ]
    found = known.estimate_many([given for _, given in inputs]) if inputs else []
    of_cloud: dict[int, list[PoseEstimate]] = {}
    for (k, _), estimate in zip(inputs, found, strict=True):
        if estimate.is_posed and _is_possible(scene, estimate, known):
            of_cloud.setdefault(k, []).append(estimate)
    return [_best(some, clouds[k], known) for k, some in of_cloud.items()]


def _of_this_size(cloud: Tensor, view: ViewInput, known: SearchTargets) -> list[str]:
    """Name the objects that a region may be, by how long it is and what area it has."""
    size_m, pixel_m = extent_m(cloud), 1 / (view.K[0, 0] * view.K[1, 1]).double().sqrt()
    area_m2 = float((cloud[:, 2].double() * pixel_m).square().sum())
    return [
        name
        for name, model in known.models.items()
        if _SMALLEST * model.diameter_m <= size_m <= _LARGEST * model.diameter_m
        and area_m2 >= _AREA * known.surface_of(name).least_silhouette_m2
    ]


def which_object(estimates: Sequence[PoseEstimate], refusal: RefusalConfig) -> PoseEstimate:
    """Choose which object one input shows, from the answers for every object that it may be.

    Those that are refused are none; the others share the probability of one.

    Args:
        estimates: for the same input, one an object.
        refusal: how they are compared.

    Returns:
        The best, its certainty given the others; refused where none is ok, or where another object
        is too likely.
    """
    some = [estimate for estimate in estimates if estimate.is_posed]
    spent: Counter[str] = Counter()
    for estimate in estimates:
        spent.update(estimate.seconds)
    if not some:
        least = max(estimates, key=lambda one: 0.0 if one.fit is None else one.fit.agrees)
        names = ", ".join(one.object for one in estimates)
        reason = f"none of {names} surely; {least.object} comes nearest: {least.reason}"
        return replace(least, reason=reason, seconds=dict(spent))
    shares = share_out([one.signals for one in some], refusal.candidate_slopes)
    best, share = _given_others(some, shares)
    if share < _ONE:
        said = ", ".join(
            f"{one.object} ({float(s):.0%})" for one, s in zip(some, shares, strict=True)
        )
        return PoseEstimate(
            name=best.name, object=best.object, status="doubtful", signals=best.signals,
            reason=f"it may be {said}; say which by object", seconds=dict(spent),
        )  # fmt: skip
    return replace(best, seconds=dict(spent))


def _given_others(some: Sequence[PoseEstimate], shares: Tensor) -> tuple[PoseEstimate, float]:
    """Take the likeliest; the others lower its certainty."""
    number = int(shares.argmax())
    share, estimate = float(shares[number]), some[number]
    certainty = None if estimate.certainty is None else share * estimate.certainty
    others = tuple(replace(a, probability=share * a.probability) for a in estimate.alternatives)
    found = replace(estimate, certainty=certainty, alternatives=others)
    if len(some) > 1 and estimate.identity is not None and share < 1 - _NAMED:
        second = some[int(shares.topk(2).indices[1])].object
        reason = f"it may be {second} ({1 - share:.0%} for all other objects)"
        identity = replace(estimate.identity, status="not excluded", other=second, reason=reason)
        found = replace(found, identity=identity)
    return found, share


def _best(some: Sequence[PoseEstimate], cloud: Tensor, known: SearchTargets) -> _Answer:
    """Choose among objects that answered for one cloud; the others lower its certainty."""
    shares = share_out([estimate.signals for estimate in some], known.refusal.candidate_slopes)
    estimate, share = _given_others(some, shares)
    pose = estimate.camera_from_model
    assert pose is not None
    return _Answer(
        estimate=estimate,
        points_m=cloud,
        explained=_is_explained(cloud, pose, known.surface_of(estimate.object)),
        share=share,
    )


def _is_explained(cloud: Tensor, pose: Rigid, surface: Surface) -> Tensor:
    local_m = pose.double().inverse().apply(cloud.double())
    distance_m = (local_m - surface.points_m[surface.nearest(local_m)]).norm(dim=-1)
    return distance_m < NEAR * surface.diameter_m


def explained_mask(view: ViewInput, pose: Rigid, surface: Surface) -> Bool[Tensor, "h w"]:
    """Mark the pixels of a depth image whose points lie on a posed surface."""
    points_m = back_project(view.depth_m.double(), view.K.double())
    is_read = points_m.isfinite().all(-1) & view.mask
    near = is_read.clone()
    middle_m = pose.double().apply(surface.points_m.mean(0, keepdim=True))
    near[is_read] = (points_m[is_read] - middle_m).norm(dim=-1) < surface.diameter_m
    explained = torch.zeros_like(near)
    if bool(near.any()):
        explained[near] = _is_explained(points_m[near], pose, surface)
    return explained


def _is_possible(scene: _Scene, estimate: PoseEstimate, known: SearchTargets) -> bool:
    """Whether enough of the surface was seen, no plane before it, and more than a cut of one."""
    pose, signals = estimate.camera_from_model, estimate.signals
    assert pose is not None
    if signals["unseen"] > _HIDDEN:
        return False
    surface = known.surface_of(estimate.object)
    posed_m = pose.double().apply(surface.points_m)
    u, v = project(posed_m, scene.view.K.double()).round().long().unbind(-1)
    height, width = scene.view.depth_m.shape
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height) & (posed_m[:, 2] > 0)
    seen_m = scene.view.depth_m.double()[v[inside], u[inside]]
    is_read = seen_m.isfinite() & (seen_m > 0)
    if not bool(is_read.any()):
        return False
    is_before = seen_m < posed_m[inside, 2] - NEAR * surface.diameter_m
    is_sunk = is_before & scene.is_plane[v[inside], u[inside]]
    if float(is_sunk[is_read].double().mean()) > _SUNK:
        return False
    return not is_cut_out(scene.view, pose, surface)


def is_cut_out(view: ViewInput, pose: Rigid, surface: Surface) -> bool:
    """Whether what lies on a posed surface is flat, and goes on in its plane beyond the outline.

    Args:
        view: depth and camera; its mask limits what may lie on the surface, not what goes on.
        pose: of the object.
        surface: of its model.
    """
    own = explained_mask(view, pose, surface)
    points_m = back_project(view.depth_m.double(), view.K.double())
    plane = largest_plane(points_m[own], torch.Generator().manual_seed(0))
    if plane is None or float(is_on_plane(points_m[own], plane).double().mean()) < _FLAT:
        return False
    pixel_m = float(points_m[own][:, 2].median() / view.K[0, 0])
    reach = BORDER_PX + math.ceil(_RIM * surface.diameter_m / pixel_m)
    rim = grow_mask(own, reach) & ~grow_mask(own, BORDER_PX)
    return float(is_on_plane(points_m[rim], plane).double().mean()) > _CONTINUED


def _without_overlap(answers: Sequence[_Answer], known: SearchTargets) -> list[_Answer]:
    """Keep answers from the best down that explain points which none before does."""
    kept: list[_Answer] = []
    for answer in sorted(answers, key=lambda a: -a.worth):
        own = answer.points_m[answer.explained]
        if len(own) == 0:
            continue
        taken = torch.zeros(len(own), dtype=torch.bool)
        for other in kept:
            pose = other.estimate.camera_from_model
            assert pose is not None
            taken |= _is_explained(own, pose, known.surface_of(other.estimate.object))
        if float(taken.double().mean()) < _SHARED:
            kept.append(answer)
    return kept
