"""Known objects in a depth image without a mask, by their models alone.

The image, or a region of it, is searched in rounds:

1. propose: point pairs vote for poses of each object, the candidates;
2. refine: each is refined by ICP on its inliers, the readings that it explains, and compared with
   the image;
3. group: candidates of one object with mostly the same inliers are starts of one registration;
4. register: the object is estimated from the inliers of the best candidate of its group;
5. non-maximum suppression: of candidates that share inliers the likeliest stays;
6. objects that explain the same inliers share the probability of one.

At the end the instances of each object are weighed by each other. A stage that rejects a candidate
says why; the best of them is the nearest miss of an object that is not found.
"""

import math
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, Literal

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from depthpose.core.devices import map_in_threads
from depthpose.core.rigid import Rigid
from depthpose.core.stopwatch import Stopwatch
from depthpose.pose.cloud import cloud_from_depth, require_same_size, why_nothing_seen
from depthpose.pose.config import EstimateConfig
from depthpose.pose.frame import Frame, crop_to_region, prepare_frame
from depthpose.pose.geometry.surface import Surface
from depthpose.pose.icp import refine_roughly
from depthpose.pose.inliers import frame_inliers, share_in_background
from depthpose.pose.picking import rank_picks
from depthpose.pose.pipeline import register
from depthpose.pose.propose.image import propose_in_frame
from depthpose.pose.refusals import estimate_or_refusal
from depthpose.pose.types import CloudInput, Evidence, PoseEstimate, ViewInput
from depthpose.pose.verify.decide import (
    LEAST_SHARE,
    explain_doubt,
    likeliest_object,
    with_share,
    with_status,
)
from depthpose.pose.verify.evidence import compare, observe
from depthpose.pose.verify.probability import (
    LEAST_POSSIBLE,
    log_odds_right,
    probability_of_instances,
    probability_right,
)
from depthpose.pose.verify.target_object import TargetObject

_MOST_PROPOSALS = 40
"""Largest number of proposals that are looked at in an image."""
_LEAST_PLACES = 6
"""Number of places of each object that are looked at in any case."""
_ROUNDS = 4
"""An image is searched at most so many times for an object that is there more than once."""
_MOST_TOGETHER = 8
"""Largest number of candidates of one object in a group."""
_LEAST_PIXELS = 100
"""Of the image at full resolution, that a pose must explain: fewer show no shape."""
_MOST_OVERLAP = 0.3
"""Candidates with a larger overlap are of one thing: the likeliest suppresses the others."""
_SAME_PLACE = 0.5
"""Candidates with a larger overlap are at one place: those of one object are a group, those of
several objects are rivals."""
_MOST_SUNK = 0.05
"""Largest share of the surface that may lie in a bin, table or wall: right poses err by less."""
_LEAST_INSIDE = 0.5
"""Least share of the inliers that must lie in the region of the only instance."""


Instances = Literal["one", "one at most", "any number"]  #: see ``SearchTargets.instances``


@dataclass(frozen=True, kw_only=True, eq=False)
class SearchTargets:
    """What is looked for."""

    objects: Mapping[str, TargetObject]  #: by their names
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
class Candidate:
    """A pose that an object may have in the image, and what is known of it so far."""

    object: str  #: its name
    surface: Surface  #: of the object
    pose: Rigid  #: ``camera_from_model``
    inliers: Bool[Tensor, "h w"]  #: readings of the frame that the pose explains
    evidence: Evidence | None = None  #: of the pose; None: it was not compared with the image
    log_odds: float = -math.inf  #: of the pose being right, by its evidence
    estimate: PoseEstimate | None = None  #: of the object, where it was registered
    rejected: str = ""  #: why the object is not there, in a sentence; empty while it may be

    @cached_property
    def pixels(self) -> Int64[Tensor, " n"]:
        """Indices of the inliers, row after row."""
        return self.inliers.flatten().nonzero()[:, 0]

    def overlap(self, other: "Candidate") -> float:
        """Compute the overlap coefficient: share of the fewer inliers that both have."""
        both_px = int(other.inliers.flatten()[self.pixels].count_nonzero())
        return both_px / max(1, min(len(self.pixels), len(other.pixels)))

    @property
    def middle_m(self) -> Float[Tensor, "3"]:
        """The middle of the posed object, in the camera frame."""
        return self.pose.apply(self.surface.middle_m[None])[0]

    @property
    def agreement(self) -> float:
        """Share of what was compared that supports the pose, 0..1."""
        return 0.0 if self.evidence is None else self.evidence.agreement


def find_objects(view: ViewInput, targets: SearchTargets) -> list[PoseEstimate]:
    """Pose every known object that a depth image shows, by their evidence; refuse the others.

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
    is_searched = region.mask[:: frame.step, :: frame.step].clone()

    names = list(targets.objects)
    examined: list[Candidate] = []  # what each stage makes of them
    claimed: list[Candidate] = []  # all maxima, whose places are taken
    accepted: list[Candidate] = []  # the maxima that show a certain object
    for _ in range(1 if targets.is_single else _ROUNDS):
        proposed = _propose(frame, is_searched, names, claimed, targets)
        refined = _refine(proposed, frame, region, targets)
        registered = _register(_group(refined), frame, region, is_searched, targets)
        maxima, suppressed = _suppress(registered, claimed)
        answered = _weigh_objects(maxima, registered)
        examined += [*refined, *registered, *suppressed, *answered]

        # No later candidate may lie where a maximum lies, though it may be open which object it
        # shows; the inliers of what is accepted are not even searched again.
        claimed += maxima
        new = _remaining(answered)
        accepted += new
        for candidate in new:
            is_searched &= ~candidate.inliers

        # What is there twice may be there more often; what is there once is not looked for again.
        count = Counter(candidate.object for candidate in accepted)
        names = sorted({candidate.object for candidate in new if count[candidate.object] > 1})
        if not names:
            break

    weighed = _weigh_instances(accepted, targets)
    examined += weighed

    spent_s = time.perf_counter() - began
    estimates = _answer_instances(weighed, region, targets, spent_s)
    answered_names = {candidate.object for candidate in _remaining(weighed)}
    rejected = [candidate for candidate in examined if candidate.rejected]
    for name in targets.objects:
        if name not in answered_names:
            misses = [candidate for candidate in rejected if candidate.object == name]
            estimates.append(nothing_found(view, name, misses, spent_s))
    if len(estimates) == 1:
        return [replace(estimates[0], name=view.name)]
    return [replace(estimate, name=f"{view.name}_{k}") for k, estimate in enumerate(estimates)]


def _answer_instances(
    weighed: Sequence[Candidate], view: ViewInput, targets: SearchTargets, spent_s: float
) -> list[PoseEstimate]:
    """Make the estimate of each instance, the surest first, and rank them for picking."""
    estimates: list[PoseEstimate] = []
    for candidate in _rank(weighed):
        assert candidate.estimate is not None, "what is accepted was registered"
        estimate = with_status(candidate.estimate, targets.config.min_certainty)
        estimates.append(replace(estimate, seconds={**estimate.seconds, "search": spent_s}))
    if targets.is_single:
        return estimates
    surfaces = {name: target.surface for name, target in targets.objects.items()}
    return rank_picks(estimates, view, surfaces)


def _remaining(candidates: Sequence[Candidate]) -> list[Candidate]:
    """Leave out the rejected candidates."""
    return [candidate for candidate in candidates if not candidate.rejected]


def _propose(
    frame: Frame,
    is_searched: Bool[Tensor, "h w"],
    names: Sequence[str],
    claimed: Sequence[Candidate],
    targets: SearchTargets,
) -> list[Candidate]:
    """Propose poses: the best of all objects, and some places of each; none at a claimed place."""

    def propose_object(name: str) -> list[tuple[float, str, Rigid]]:
        """Propose poses of one object: their scores, the best first, its name, and the poses."""
        pairs = targets.objects[name].pairs
        poses, scores = propose_in_frame(frame, is_searched, pairs, len(names))
        best = scores.tolist()[:_MOST_PROPOSALS]
        return [(score, name, poses[k]) for k, score in enumerate(best)]

    proposals = [
        proposal
        for of_object in map_in_threads(propose_object, names, torch.get_num_threads())
        for proposal in of_object
    ]
    proposals.sort(key=lambda proposal: -proposal[0])

    # The best of all objects, several at one place too: they are joint starts of its registration.
    # Beyond these, only proposals at new places of objects with few places yet.
    candidates: list[Candidate] = []
    places_of_object = Counter[str]()
    for number, (_, name, pose) in enumerate(proposals):
        if number >= _MOST_PROPOSALS and places_of_object[name] >= _LEAST_PLACES:
            continue
        surface = targets.objects[name].surface
        inliers = frame_inliers(frame, pose, surface)
        candidate = Candidate(object=name, surface=surface, pose=pose, inliers=inliers)
        is_claimed = any(candidate.overlap(other) > _MOST_OVERLAP for other in claimed)
        if is_claimed or len(candidate.pixels) * frame.step**2 < _LEAST_PIXELS:
            continue
        same_object = [other for other in candidates if other.object == name]
        is_new = all(candidate.overlap(other) <= _SAME_PLACE for other in same_object)
        if is_new:
            places_of_object[name] += 1
        if is_new or number < _MOST_PROPOSALS:
            candidates.append(candidate)
    return candidates


def _refine(
    candidates: Sequence[Candidate], frame: Frame, view: ViewInput, targets: SearchTargets
) -> list[Candidate]:
    """Refine each candidate on its inliers; reject those that the image then contradicts."""
    end_diameters = targets.config.icp.end_distance_diameters

    def refine(candidate: Candidate) -> Candidate:
        """Refine the pose of one candidate, and compare it with the image."""
        surface = candidate.surface
        cloud_m = _lift_inliers(candidate, frame, view)
        pose = refine_roughly(cloud_m, candidate.pose[None], surface, end_diameters)[0]
        observation = observe(cloud_m, view, surface, is_masked=False)
        evidence = compare(observation, pose, surface)
        refined = _move(candidate, pose, evidence, frame, targets)
        probability = probability_right(evidence, is_expected=targets.is_expected)
        if probability < LEAST_POSSIBLE:
            reason = explain_doubt(evidence, probability, is_masked=False)
            return replace(refined, rejected=reason)
        return refined

    return list(map_in_threads(refine, candidates, torch.get_num_threads()))


def _lift_inliers(candidate: Candidate, frame: Frame, view: ViewInput) -> Float[Tensor, "n 3"]:
    """Lift the inliers of a candidate to points, of the unthinned view, in the camera frame."""
    height, width = view.depth_m.shape
    mask = candidate.inliers.repeat_interleave(frame.step, 0).repeat_interleave(frame.step, 1)
    part = crop_to_region(replace(view, mask=mask[:height, :width]), margin=0)
    return cloud_from_depth(part.depth_m, part.mask, part.K)


def _move(
    candidate: Candidate, pose: Rigid, evidence: Evidence, frame: Frame, targets: SearchTargets
) -> Candidate:
    """Move a candidate to another pose, with its inliers and its evidence there."""
    return replace(
        candidate,
        pose=pose,
        inliers=frame_inliers(frame, pose, candidate.surface),
        evidence=evidence,
        log_odds=log_odds_right(evidence, is_expected=targets.is_expected),
    )


def _group(candidates: Sequence[Candidate]) -> list[list[Candidate]]:
    """Group the candidates of one object at one place; the likeliest leads each group."""
    groups: list[list[Candidate]] = []
    for candidate in _rank(candidates):
        group = next((group for group in groups if _is_same_place(candidate, group[0])), None)
        if group is None:
            groups.append([candidate])
        elif len(group) < _MOST_TOGETHER:
            group.append(candidate)
    return groups


def _rank(candidates: Sequence[Candidate]) -> list[Candidate]:
    """Sort the remaining candidates, the likeliest first."""
    return sorted(_remaining(candidates), key=lambda candidate: -candidate.log_odds)


def _is_same_place(candidate: Candidate, leader: Candidate) -> bool:
    """Whether a candidate is of the object and at the place of the leader of a group."""
    return candidate.object == leader.object and candidate.overlap(leader) > _SAME_PLACE


def _register(
    groups: Sequence[Sequence[Candidate]],
    frame: Frame,
    view: ViewInput,
    is_searched: Bool[Tensor, "h w"],
    targets: SearchTargets,
) -> list[Candidate]:
    """Register the object of each group, from all its poses, to the inliers of its leader.

    ``is_searched``: the readings among which the object is, where one instance is expected.
    """

    def register_group(numbered: tuple[int, Sequence[Candidate]]) -> PoseEstimate:
        """Register the object of one group, which has a number."""
        number, group = numbered
        leader = group[0]
        cloud = CloudInput(
            name=f"{view.name}_{number}",
            points_m=_lift_inliers(leader, frame, view),
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
            proposals=Rigid.stack([candidate.pose for candidate in group]),
            is_expected=targets.is_expected,
        )
        return estimate_or_refusal(cloud, watch, work)

    estimates = map_in_threads(register_group, enumerate(groups), torch.get_num_threads())
    return [
        _take_estimate(group[0], estimate, frame, is_searched, targets)
        for estimate, group in zip(estimates, groups, strict=True)
    ]


def _take_estimate(
    candidate: Candidate,
    estimate: PoseEstimate,
    frame: Frame,
    is_searched: Bool[Tensor, "h w"],
    targets: SearchTargets,
) -> Candidate:
    """Give a candidate its estimate; reject what is refused, or lies where no object can be."""
    evidence = estimate.evidence
    if estimate.camera_from_model is None:
        evidence = evidence or candidate.evidence  # that of its start, if it was refused before
        return replace(candidate, evidence=evidence, rejected=estimate.reason)
    assert evidence is not None, "poses in a view are compared with it"
    pose = estimate.camera_from_model.double()
    posed = replace(_move(candidate, pose, evidence, frame, targets), estimate=estimate)

    # No object lies in its background.
    sunk_share = share_in_background(frame, pose, candidate.surface)
    if sunk_share > _MOST_SUNK:
        reason = (
            f"{sunk_share:.0%} of it would lie in the bin, table or wall before which it is seen"
        )
        return replace(posed, rejected=reason)

    # The only instance lies in the region that was given.
    inside_share = float(is_searched[posed.inliers].double().mean())
    if targets.is_single and not inside_share > _LEAST_INSIDE:  # without inliers it is NaN
        return replace(posed, rejected="most of it lies outside the given region")
    return posed


def _suppress(
    candidates: Sequence[Candidate], claimed: Sequence[Candidate]
) -> tuple[list[Candidate], list[Candidate]]:
    """Suppress each candidate that overlaps a likelier one, or one that has claimed its inliers.

    Returns:
        The maxima, which nothing suppresses; and the candidates that another object suppresses,
        rejected. What is suppressed by its own object is the same instance, and left out.
    """
    maxima: list[Candidate] = []
    suppressed: list[Candidate] = []
    for candidate in _rank(candidates):
        likelier = [*claimed, *maxima]
        overlapping = (other for other in likelier if candidate.overlap(other) > _MOST_OVERLAP)
        suppressor = next(overlapping, None)
        if suppressor is None:
            maxima.append(candidate)
        elif suppressor.object != candidate.object:
            reason = f"what lies there is more likely {suppressor.object}"
            suppressed.append(replace(candidate, rejected=reason))
    return maxima, suppressed


def _weigh_objects(maxima: Sequence[Candidate], candidates: Sequence[Candidate]) -> list[Candidate]:
    """Weigh each maximum by its rivals, the other objects at its place, one of which is there.

    Args:
        maxima: those that nothing suppresses.
        candidates: all that were registered, which the rivals are taken from.

    Returns:
        The maxima with their shares of the probability of one object; rejected where it is small.
    """
    ranked = _rank(candidates)
    weighed: list[Candidate] = []
    for candidate in maxima:
        # The likeliest of each other object. Likelier rivals, which another maximum suppressed, do
        # not count.
        rivals = {candidate.object: candidate}
        for other in ranked[ranked.index(candidate) + 1 :]:
            if candidate.overlap(other) > _SAME_PLACE:
                rivals.setdefault(other.object, other)
        estimates = [rival.estimate for rival in rivals.values() if rival.estimate is not None]
        likeliest, shares = likeliest_object(estimates)
        # With a share so large it is itself the likeliest.
        if float(shares[0]) >= LEAST_SHARE:
            weighed.append(replace(candidate, estimate=likeliest))
        else:
            others = ", ".join(name for name in rivals if name != candidate.object)
            reason = f"what lies there may be {others} as well"
            weighed.append(replace(candidate, rejected=reason))
    return weighed


def _weigh_instances(accepted: Sequence[Candidate], targets: SearchTargets) -> list[Candidate]:
    """Weigh the instances of each object by each other; reject poses that are likelier wrong.

    A pose may be likelier wrong than right because another instance is surer, and a table holds one
    of each object; or because another pose explains its place as well.
    """
    weighed: list[Candidate] = []
    for name in dict.fromkeys(candidate.object for candidate in accepted):
        instances = [candidate for candidate in accepted if candidate.object == name]
        log_odds = torch.tensor(
            [candidate.log_odds for candidate in instances], dtype=torch.float64
        )
        probabilities = probability_of_instances(log_odds, is_single=targets.is_single)
        shares = probabilities / log_odds.sigmoid()  # of the probability that each has by itself
        for candidate, share in zip(instances, shares.tolist(), strict=True):
            assert candidate.estimate is not None, "what is accepted was registered"
            estimate = with_share(candidate.estimate, share)
            assert estimate.certainty is not None, "registered poses have evidence"
            reason = ""
            if estimate.certainty < targets.config.limits.min_probability:
                reason = (
                    "weighed against other poses and places, it is right with a probability of "
                    f"{estimate.certainty:.0%}"
                )
            weighed.append(replace(candidate, estimate=estimate, rejected=reason))
    return weighed


def nothing_found(
    view: ViewInput, object: str, rejected: Sequence[Candidate], spent_s: float
) -> PoseEstimate:
    """Build the refusal of an object that an image does not surely show, with its nearest miss.

    Args:
        view: depth and camera.
        object: its name.
        rejected: candidates of it.
        spent_s: duration of the search.
    """
    read_m = view.depth_m[view.mask & (view.depth_m > 0)]
    facts: dict[str, Any] = {"name": view.name, "object": object, "seconds": {"search": spent_s}}
    if len(read_m) == 0:
        return PoseEstimate(status="too few points", reason=why_nothing_seen(view), **facts)
    reason = (
        f"nothing before the background of the image is surely {object}; its depths are "
        f"{float(read_m.min()):.3g} to {float(read_m.max()):.3g} m: if they are right, give a "
        "mask, or look from nearer by"
    )
    if not rejected:
        reason += ". No place in it is enough like the object to be compared"
    else:
        nearest = max(rejected, key=lambda candidate: candidate.agreement)
        x, y, z = nearest.middle_m.tolist()
        reason += (
            f". Of {len(rejected)} poses that were compared the nearest miss, at ({x:.3f}, "
            f"{y:.3f}, {z:.3f}) m: {nearest.rejected}"
        )
    return PoseEstimate(status="doubtful", reason=reason, **facts)
