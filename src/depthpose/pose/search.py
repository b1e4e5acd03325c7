"""Known objects in a depth image without a mask: votes propose poses, the evidence decides.

Point pairs of the whole image, or of a region of it, vote for poses of each object. Each proposal
is refined on the readings that it explains, and compared with the image. Proposals that explain the
same readings are one place; there the object is estimated from the readings that the best proposal
explains. Places that explain the same readings compete.
"""

import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, Literal, NamedTuple

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from depthpose.core.devices import map_in_threads
from depthpose.core.rigid import Rigid
from depthpose.core.stopwatch import Stopwatch
from depthpose.pose.cloud import cloud_from_depth, require_same_size, why_nothing_seen
from depthpose.pose.config import EstimateConfig
from depthpose.pose.footprint import crop_to_region, explained_frame_mask, why_background_excludes
from depthpose.pose.frame import Frame, prepare_frame
from depthpose.pose.icp import refine_roughly
from depthpose.pose.picking import rank_picks
from depthpose.pose.pipeline import register
from depthpose.pose.propose.image import propose_in_frame
from depthpose.pose.refusals import answer
from depthpose.pose.types import CloudInput, Evidence, PoseEstimate, ViewInput
from depthpose.pose.verify.decide import (
    LEAST_SHARE,
    explain_doubt,
    likeliest_object,
    with_share,
    with_status,
)
from depthpose.pose.verify.evidence import compare, observe
from depthpose.pose.verify.known_object import KnownObject
from depthpose.pose.verify.probability import (
    LEAST_POSSIBLE,
    log_odds_right,
    probability_of_instances,
    probability_right,
)

_MOST_PLACES = 40
"""Largest number of proposals that are looked at in an image."""
_LEAST_PLACES = 6
"""Number of places of each object that are looked at in any case."""
_ROUNDS = 4
"""An image is searched at most so many times for an object that is there more than once."""
_MOST_TOGETHER = 8
"""Largest number of proposals of one object at one place."""
_LEAST_PIXELS = 100
"""Of the image at full resolution, that a pose must explain: fewer show no shape."""
_SHARED = 0.3
"""Estimates that explain so large a share of the same readings are of one thing; one stays."""
_SAME_PLACE = 0.5
"""Poses that explain so much of the same readings are at one place; two objects compete there."""


Instances = Literal["one", "one at most", "any number"]  #: see ``SearchTargets.instances``


@dataclass(frozen=True, kw_only=True, eq=False)
class SearchTargets:
    """What is looked for."""

    objects: Mapping[str, KnownObject]  #: by their names
    config: EstimateConfig  #: of ICP and limits
    #: how many of each object there are: ``one`` in a detector's box, ``one at most`` in a frame of
    #: a track, ``any number`` in another image.
    instances: Instances = "any number"

    @property
    def is_expected(self) -> bool:
        """Whether each object is expected to be there."""
        return self.instances == "one"

    @property
    def is_single(self) -> bool:
        """Whether each object is there once at most."""
        return self.instances != "any number"


@dataclass(frozen=True, kw_only=True, eq=False)
class _Place:
    """Where an object may be: a pose, and the readings of the frame that it explains."""

    object: str
    pose: Rigid
    explained: Bool[Tensor, "h w"]

    @cached_property
    def pixels(self) -> Int64[Tensor, " n"]:
        """Indices of the readings that it explains, row after row."""
        return self.explained.flatten().nonzero()[:, 0]

    def shared_with(self, other: "_Place") -> float:
        """Share of the smaller one's readings that both explain."""
        both_px = int(other.explained.flatten()[self.pixels].count_nonzero())
        return both_px / max(1, min(len(self.pixels), len(other.pixels)))


@dataclass(frozen=True, kw_only=True, eq=False)
class _JudgedPlace(_Place):
    """A place whose object was estimated."""

    estimate: PoseEstimate
    log_odds: float  #: of its being right


@dataclass(frozen=True, kw_only=True, eq=False)
class _Miss:
    """A place at which an object was refused."""

    object: str  #: its name
    middle_m: Float[Tensor, "3"]  #: of the proposed object, in the camera frame
    agreement: float  #: share of what was compared that supports the pose
    reason: str  #: of the refusal


def find_objects(view: ViewInput, targets: SearchTargets) -> list[PoseEstimate]:
    """Pose every known object that a depth image shows, the surest first; refuse the others.

    Where poses of several objects explain the same readings, they share the probability of one, and
    where none has most of it none is reported. Where an object is there more than once, the rest of
    the image is searched for more of it. For an object that is not found, the refusal says where it
    was searched and what the nearest miss was.

    Args:
        view: depth and camera; only its mask is searched.
        targets: what for.

    Raises:
        InputError: mask and depth differ in size.
    """
    require_same_size(view.mask, view.depth_m)

    # The part of the image that is searched, its normals and its background.
    began = time.perf_counter()
    region = crop_to_region(view)
    smallest_m = min(target.surface.diameter_m for target in targets.objects.values())
    frame = prepare_frame(region.depth_m, region.K, smallest_m, region.background)
    is_unclaimed = region.mask[:: frame.step, :: frame.step].clone()

    # Round after round: propose, refine, judge, suppress. What is posed claims its readings.
    names = list(targets.objects)
    posed: list[_JudgedPlace] = []
    claimed: list[_JudgedPlace] = []  # posed, or of one of several objects
    misses: list[_Miss] = []
    for _ in range(1 if targets.is_single else _ROUNDS):
        proposals = _propose(frame, is_unclaimed, names, claimed, targets)
        likely, hopeless = _refine(proposals, frame, region, targets)
        judged, rejected = _judge(_group(likely), frame, region, targets)
        misses += hopeless + rejected
        if targets.is_single:
            judged, outside = _within(judged, is_unclaimed, targets)
            misses += outside
        kept, claimed, uncertain = _suppress(judged, claimed, targets)
        misses += uncertain
        posed += kept
        for place in kept:
            is_unclaimed &= ~place.explained
        # What is there twice may be there more often; what is there once is not looked for again.
        count = Counter(place.object for place in posed)
        names = sorted({place.object for place in kept if count[place.object] > 1})
        if not names:
            break

    # The places of one object are weighed by each other.
    posed, unlikely = _weigh_instances(posed, targets)
    misses += unlikely
    posed.sort(key=lambda place: -place.log_odds)

    # An estimate for each place, and for each object without one a refusal.
    spent_s = time.perf_counter() - began
    estimates: list[PoseEstimate] = []
    for place in posed:
        estimate = with_status(place.estimate, targets.config.min_certainty)
        estimates.append(replace(estimate, seconds={**estimate.seconds, "search": spent_s}))
    if not targets.is_single:
        surfaces = {name: target.surface for name, target in targets.objects.items()}
        estimates = rank_picks(estimates, region, surfaces)
    missing = set(targets.objects) - {place.object for place in posed}
    estimates += [
        nothing_found(view, name, [miss for miss in misses if miss.object == name], spent_s)
        for name in targets.objects
        if name in missing
    ]
    if len(estimates) == 1:
        return [replace(estimates[0], name=view.name)]
    return [replace(estimate, name=f"{view.name}_{k}") for k, estimate in enumerate(estimates)]


class _Proposal(NamedTuple):
    """A pose that votes propose."""

    score: float  #: by :func:`~depthpose.pose.propose.image.score_by_image`
    object: str  #: its name
    pose: Rigid  #: of the object


def _propose(
    frame: Frame,
    is_unclaimed: Bool[Tensor, "h w"],
    names: Sequence[str],
    claimed: Sequence[_Place],
    targets: SearchTargets,
) -> list[_Place]:
    """Propose poses: the best of all objects, and some places of each; none at a claimed place."""

    def propose_object(name: str) -> list[_Proposal]:
        """Propose poses of one object, the best first."""
        pairs = targets.objects[name].pairs
        poses, score = propose_in_frame(frame, is_unclaimed, pairs, len(names))
        return [
            _Proposal(score=float(score[k]), object=name, pose=poses[k])
            for k in range(min(len(score), _MOST_PLACES))
        ]

    proposals = [
        proposal
        for group in map_in_threads(propose_object, names, torch.get_num_threads())
        for proposal in group
    ]
    proposals.sort(key=lambda proposal: -proposal.score)

    # The best of all objects, several at one place too: they are joint starts of its refinement.
    # Beyond these, only proposals at new places of objects with few places yet.
    places: list[_Place] = []
    count_of_object = Counter[str]()
    for number, proposal in enumerate(proposals):
        if number >= _MOST_PLACES and count_of_object[proposal.object] >= _LEAST_PLACES:
            continue
        surface = targets.objects[proposal.object].surface
        explained = explained_frame_mask(frame, proposal.pose, surface)
        place = _Place(object=proposal.object, pose=proposal.pose, explained=explained)
        is_claimed = any(place.shared_with(other) > _SHARED for other in claimed)
        if is_claimed or len(place.pixels) * frame.step**2 < _LEAST_PIXELS:
            continue
        same_object = [other for other in places if other.object == place.object]
        is_new = all(place.shared_with(other) <= _SAME_PLACE for other in same_object)
        if is_new:
            count_of_object[proposal.object] += 1
        if is_new or number < _MOST_PLACES:
            places.append(place)
    return places


def _refine(
    places: Sequence[_Place], frame: Frame, view: ViewInput, targets: SearchTargets
) -> tuple[list[_Place], list[_Miss]]:
    """Refine each proposal on the readings that it explains; rank them by their evidence.

    Returns:
        The proposals that may be right, the likeliest first; and the hopeless ones.
    """
    end_diameters = targets.config.icp.end_distance_diameters

    def refine(place: _Place) -> tuple[Rigid, Evidence]:
        """Refine the pose of a place, and compare it with the image."""
        surface = targets.objects[place.object].surface
        cloud_m = _readings_of(place, frame, view)
        pose = refine_roughly(cloud_m, place.pose[None], surface, end_diameters)[0]
        observation = observe(cloud_m, view, surface, is_masked=False)
        return pose, compare(observation, pose, surface)

    likely: list[tuple[float, _Place]] = []
    hopeless: list[_Miss] = []
    refined = map_in_threads(refine, places, torch.get_num_threads())
    for place, (pose, evidence) in zip(places, refined, strict=True):
        probability = probability_right(evidence, is_expected=targets.is_expected)
        if probability < LEAST_POSSIBLE:
            reason = explain_doubt(evidence, probability, is_masked=False)
            hopeless.append(_miss_at(place, evidence, reason, targets))
            continue
        explained = explained_frame_mask(frame, pose, targets.objects[place.object].surface)
        likely.append((probability, replace(place, pose=pose, explained=explained)))
    likely.sort(key=lambda pair: -pair[0])
    return [place for _, place in likely], hopeless


def _readings_of(place: _Place, frame: Frame, view: ViewInput) -> Float[Tensor, "n 3"]:
    """Collect the readings that a place explains, of the unthinned view, in the camera frame."""
    height, width = view.depth_m.shape
    mask = place.explained.repeat_interleave(frame.step, 0).repeat_interleave(frame.step, 1)
    part = crop_to_region(replace(view, mask=mask[:height, :width]), margin=0)
    return cloud_from_depth(part.depth_m, part.mask, part.K)


def _group(places: Sequence[_Place]) -> list[list[_Place]]:
    """Gather proposals of an object that explain the same readings; the likeliest leads each."""
    groups: list[list[_Place]] = []
    for place in places:
        same = [group for group in groups if group[0].object == place.object]
        group = next((group for group in same if place.shared_with(group[0]) > _SAME_PLACE), None)
        if group is None:
            groups.append([place])
        elif len(group) < _MOST_TOGETHER:
            group.append(place)
    return groups


def _judge(
    groups: Sequence[Sequence[_Place]], frame: Frame, view: ViewInput, targets: SearchTargets
) -> tuple[list[_JudgedPlace], list[_Miss]]:
    """Estimate the object of each place from what its best pose explains; separate refusals."""

    def estimate_place(numbered: tuple[int, Sequence[_Place]]) -> PoseEstimate:
        """Estimate the object of a group of proposals, which has a number."""
        number, group = numbered
        leader = group[0]
        cloud = CloudInput(
            name=f"{view.name}_{number}",
            points_m=_readings_of(leader, frame, view),
            object=leader.object,
            view=view,
            is_masked=False,
        )
        watch = Stopwatch()
        work = partial(
            register,
            cloud,
            targets.objects[leader.object],
            targets.config,
            watch,
            proposals=Rigid.stack([place.pose for place in group]),
            is_expected=targets.is_expected,
        )
        return answer(cloud, watch, work)

    judged: list[_JudgedPlace] = []
    misses: list[_Miss] = []
    estimates = map_in_threads(estimate_place, enumerate(groups), torch.get_num_threads())
    for estimate, group in zip(estimates, groups, strict=True):
        surface = targets.objects[estimate.object].surface
        evidence = estimate.evidence
        reason = estimate.reason
        if estimate.camera_from_model is not None:
            reason = why_background_excludes(frame, estimate.camera_from_model.double(), surface)
        if estimate.camera_from_model is None or evidence is None or reason:
            misses.append(_miss_at(group[0], evidence, reason, targets))
            continue
        pose = estimate.camera_from_model.double()
        judged.append(
            _JudgedPlace(
                object=estimate.object,
                pose=pose,
                explained=explained_frame_mask(frame, pose, surface),
                estimate=estimate,
                log_odds=log_odds_right(evidence, is_expected=targets.is_expected),
            )
        )
    return judged, misses


def _miss_at(
    place: _Place, evidence: Evidence | None, reason: str, targets: SearchTargets
) -> _Miss:
    """Describe a place at which an object was refused."""
    surface = targets.objects[place.object].surface
    return _Miss(
        object=place.object,
        middle_m=place.pose.apply(surface.middle_m[None])[0],
        agreement=0.0 if evidence is None else evidence.agreement,
        reason=reason,
    )


def _weigh_instances(
    accepted: Sequence[_JudgedPlace], targets: SearchTargets
) -> tuple[list[_JudgedPlace], list[_Miss]]:
    """Weigh the places of each object by each other; separate poses that are likelier wrong.

    A pose may be likelier wrong than right because another place is surer, and a table holds one
    of each object; or because another pose explains its place as well.
    """
    remaining: list[_JudgedPlace] = []
    misses: list[_Miss] = []
    for name in dict.fromkeys(place.object for place in accepted):
        places = [place for place in accepted if place.object == name]
        log_odds = torch.tensor([place.log_odds for place in places], dtype=torch.float64)
        probabilities = probability_of_instances(log_odds, is_single=targets.is_single)
        shares = probabilities / log_odds.sigmoid()  # of the probability that each has by itself
        for place, share in zip(places, shares.tolist(), strict=True):
            estimate = with_share(place.estimate, share)
            assert estimate.certainty is not None, "judged poses have evidence"
            if estimate.certainty >= targets.config.limits.min_probability:
                remaining.append(replace(place, estimate=estimate))
            else:
                reason = (
                    "weighed against other poses and places, it is right with a probability of "
                    f"{estimate.certainty:.0%}"
                )
                misses.append(_miss_at(place, estimate.evidence, reason, targets))
    return remaining, misses


def _within(
    judged: Sequence[_JudgedPlace], is_region: Bool[Tensor, "h w"], targets: SearchTargets
) -> tuple[list[_JudgedPlace], list[_Miss]]:
    """Separate the places that lie mostly in a region from those that do not, as misses."""
    inside: list[_JudgedPlace] = []
    misses: list[_Miss] = []
    for place in judged:
        if float(is_region[place.explained].double().mean()) > 0.5:
            inside.append(place)
        else:
            reason = "most of it lies outside the given region"
            misses.append(_miss_at(place, place.estimate.evidence, reason, targets))
    return inside, misses


def _suppress(
    judged: Sequence[_JudgedPlace], before: Sequence[_JudgedPlace], targets: SearchTargets
) -> tuple[list[_JudgedPlace], list[_JudgedPlace], list[_Miss]]:
    """Keep places in order of probability, each only if no surer one explains its readings.

    Returns:
        The places that are kept; all places that claim readings, those of ``before`` and those that
        may show one of several objects too; and, as misses, the places at which an object is not
        kept because of another.
    """
    kept: list[_JudgedPlace] = []
    misses: list[_Miss] = []
    taken = list(before)
    ranked = sorted(judged, key=lambda place: -place.log_odds)
    for number, place in enumerate(ranked):
        # Its readings may be taken by a surer place, even of the same object.
        surer = next((other for other in taken if place.shared_with(other) > _SHARED), None)
        if surer is not None:
            if surer.object != place.object:
                reason = f"what lies there is more likely {surer.object}"
                misses.append(_miss_at(place, place.estimate.evidence, reason, targets))
            continue
        taken.append(place)

        # Other objects at this place share the probability of one with it.
        rivals = {place.object: place}
        for other in ranked[number + 1 :]:
            if place.shared_with(other) > _SAME_PLACE:
                rivals.setdefault(other.object, other)
        estimate, shares = likeliest_object([rival.estimate for rival in rivals.values()])
        if float(shares.max()) >= LEAST_SHARE:
            kept.append(replace(place, estimate=estimate))
        else:
            others = ", ".join(name for name in rivals if name != place.object)
            reason = f"what lies there may be {others} as well"
            misses.append(_miss_at(place, place.estimate.evidence, reason, targets))
    return kept, taken, misses


def nothing_found(
    view: ViewInput, object: str, misses: Sequence[_Miss], spent_s: float
) -> PoseEstimate:
    """Build the refusal of an object that an image does not surely show, with its nearest miss."""
    read_m = view.depth_m[view.mask & (view.depth_m > 0)]
    facts: dict[str, Any] = {"name": view.name, "object": object, "seconds": {"search": spent_s}}
    if len(read_m) == 0:
        return PoseEstimate(status="too few points", reason=why_nothing_seen(view), **facts)
    reason = (
        f"nothing before the background of the image is surely {object}; its depths are "
        f"{float(read_m.min()):.3g} to {float(read_m.max()):.3g} m: if they are right, give a "
        "mask, or look from nearer by"
    )
    if not misses:
        reason += ". No place in it is enough like the object to be compared"
    else:
        nearest = max(misses, key=lambda miss: miss.agreement)
        x, y, z = nearest.middle_m.tolist()
        reason += (
            f". Of {len(misses)} places that were compared the nearest miss, at ({x:.3f}, {y:.3f}, "
            f"{z:.3f}) m: {nearest.reason}"
        )
    return PoseEstimate(status="doubtful", reason=reason, **facts)
