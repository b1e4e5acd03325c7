"""Known objects in a depth image without a mask: regions, questions, and answers that agree."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from depthpose.core.camera import project
from depthpose.core.rigid import Rigid
from depthpose.pose.config import RefusalConfig
from depthpose.pose.estimator.alternatives import share_out
from depthpose.pose.regions import extent_m, find_regions, part_cloud
from depthpose.pose.surface import NEAR, Surface
from depthpose.pose.types import CloudInput, ObjectModel, PoseEstimate, ViewInput

_SMALLEST, _LARGEST = 0.25, 1.25
"""Shares of an object's diameter between which the extent of a region may lie."""
_TOGETHER = 1.1
"""Two regions may be parts of one object where together they are no longer than this."""
_MOST_PAIRS = 20
_REST = 0.25
"""A region of which so large a share is unexplained is asked again without the rest."""
_LEAST_POINTS = 60
_SHARED = 0.3
"""Answers that explain so large a share of the same points are of one thing; one of them stays."""
_SEEN_THROUGH = 0.2
"""Where the camera saw through more of the posed surface, there is no such object."""
_BEHIND = 1.0
"""By how many times what counts as near a reading lies behind the surface that it saw through."""

EstimateMany = Callable[[Sequence[CloudInput]], list[PoseEstimate]]


@dataclass(frozen=True, kw_only=True, eq=False)
class Known:
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
class _Answer:
    """An answer for a region, and which of all readings it explains."""

    estimate: PoseEstimate
    points_m: Float[Tensor, "n 3"]
    explained: Tensor
    share: float

    @property
    def worth(self) -> float:
        """How sure it is, and how much it explains: of two that are equally sure the larger."""
        risk = 0.0 if self.estimate.risk is None else self.estimate.risk
        return (1 - risk) * self.share * float(self.explained.double().mean())


def find_objects(view: ViewInput, known: Known) -> list[PoseEstimate]:
    """Pose every known object that a depth image shows, the surest first; what is none is left out.

    Regions are asked for every object whose size they may have; so are pairs of them that may be
    parts of one object, and parts of one that is too long. Where several objects answer they share
    the probability of one by what speaks against each. What an answer leaves unexplained of its
    region is asked once more. An answer through whose surface the camera saw is left out, and of
    answers that explain the same points the best stays.

    Args:
        view: depth and camera; its mask limits where is looked.
        known: what for.
    """
    largest_m = max(model.diameter_m for model in known.models.values())
    depth_m = torch.where(view.mask, view.depth_m, torch.nan)
    clouds = find_regions(depth_m, view.K, largest_m)
    clouds = [*clouds, *_pairs(clouds, largest_m), *_parts(clouds, largest_m)]
    answers = _ask(clouds, view, known)
    rest = [answer.points_m[~answer.explained] for answer in answers]
    again = [cloud for cloud, answer in zip(rest, answers, strict=True)
             if len(cloud) >= max(_LEAST_POINTS, _REST * len(answer.points_m))]  # fmt: skip
    answers += _ask(again, view, known)
    kept = _without_overlap(answers, known)
    return [replace(a.estimate, name=f"{view.name}_{k}") for k, a in enumerate(kept)]


def _pairs(clouds: Sequence[Tensor], largest_m: float) -> list[Tensor]:
    """Join regions that may be two parts of one object, something before it or a thin place."""
    joined: list[Tensor] = []
    for a, first in enumerate(clouds):
        for second in clouds[a + 1 :]:
            apart_m = float((first.median(0).values - second.median(0).values).norm())
            if apart_m > largest_m:
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


def _ask(clouds: Sequence[Tensor], view: ViewInput, known: Known) -> list[_Answer]:
    """Ask every cloud for every object of its size; give the best answer of each cloud."""
    asked: list[tuple[int, CloudInput]] = []
    for k, cloud in enumerate(clouds):
        size_m = extent_m(cloud)
        asked += [
            (k, CloudInput(name=f"{view.name}_{k}", points_m=cloud, object=name))
            for name, model in known.models.items()
            if _SMALLEST * model.diameter_m <= size_m <= _LARGEST * model.diameter_m
        ]
    found = known.estimate_many([given for _, given in asked]) if asked else []
    of_cloud: dict[int, list[PoseEstimate]] = {}
    for (k, _), estimate in zip(asked, found, strict=True):
        if estimate.camera_from_model is not None and not _is_seen_through(view, estimate, known):
            of_cloud.setdefault(k, []).append(estimate)
    return [_best(some, clouds[k], known) for k, some in of_cloud.items()]


def _best(some: Sequence[PoseEstimate], cloud: Tensor, known: Known) -> _Answer:
    """Choose among objects that answered for one cloud; the others lower its certainty."""
    slopes = known.refusal.candidate_slopes
    shares = share_out([estimate.signals for estimate in some], slopes)
    number = int(shares.argmax())
    share, estimate = float(shares[number]), some[number]
    certainty = None if estimate.certainty is None else share * estimate.certainty
    others = tuple(replace(a, probability=share * a.probability) for a in estimate.alternatives)
    pose = estimate.camera_from_model
    assert pose is not None
    return _Answer(
        estimate=replace(estimate, certainty=certainty, alternatives=others),
        points_m=cloud,
        explained=_is_explained(cloud, pose, known.surface_of(estimate.object)),
        share=share,
    )


def _is_explained(cloud: Tensor, pose: Rigid, surface: Surface) -> Tensor:
    local_m = Rigid(pose.R.double(), pose.t_m.double()).inverse().apply(cloud.double())
    distance_m = (local_m - surface.points_m[surface.nearest(local_m)]).norm(dim=-1)
    return distance_m < NEAR * surface.diameter_m


def _is_seen_through(view: ViewInput, estimate: PoseEstimate, known: Known) -> bool:
    """Whether readings lie behind much of the posed surface that faces the camera."""
    pose = estimate.camera_from_model
    assert pose is not None
    surface = known.surface_of(estimate.object)
    pose = Rigid(pose.R.double(), pose.t_m.double())
    posed_m = pose.apply(surface.points_m)
    u, v = project(posed_m, view.K.double()).round().long().unbind(-1)
    height, width = view.depth_m.shape
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height) & (posed_m[:, 2] > 0)
    if not bool(inside.any()):
        return True
    measured_m = view.depth_m.double()[v[inside], u[inside]]
    behind_m = measured_m - posed_m[inside, 2]
    read = measured_m.isfinite()
    through = behind_m[read] > _BEHIND * NEAR * surface.diameter_m
    return bool(read.any()) and float(through.double().mean()) > _SEEN_THROUGH


def _without_overlap(answers: Sequence[_Answer], known: Known) -> list[_Answer]:
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
