"""Known objects in a depth image without a mask: votes propose poses, the image judges them."""

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool
from torch import Tensor

from depthpose.core.arrays import take_evenly
from depthpose.core.camera import back_project
from depthpose.core.devices import each_in_threads
from depthpose.core.rigid import Rigid
from depthpose.pose.cloud import cloud_from_depth, grow_mask
from depthpose.pose.config import RefusalConfig
from depthpose.pose.estimator.candidates import KnownObject
from depthpose.pose.estimator.fit import (
    BORDER_PX,
    Seen,
    fit_of,
    seen_about,
    sensor_size_error,
    share_out,
)
from depthpose.pose.estimator.hypotheses import (
    compare_with_image,
    log_odds_wrong,
    propose_in_frame,
)
from depthpose.pose.estimator.inputs import nothing_seen
from depthpose.pose.frame import Frame, is_on_plane, largest_plane, prepare_frame
from depthpose.pose.surface import NEAR, Surface
from depthpose.pose.types import CloudInput, PoseEstimate, ViewInput

_MOST_LOG_ODDS = 4.0
"""Proposed poses with larger log odds of being wrong are not refined and judged."""
_ANSWERED, _ANOTHER, _LESS_SURE = 0.5, -0.5, 1.5
"""A pose is answered where its log odds of being wrong, once refined, are below the first, or below
0 where several objects are asked for, of which each may be missing; a second one of an object, and
what tracking begins at, where they are below the second, and no more than the third above those of
the first one: of copies of a part the surest two are about as sure. Most things are there once;
where two are, there are often many, and the first limit holds again."""
_LEAST_CERTAINTY = 0.25
"""Of all but the surest of an object: less is a guess among four poses."""
_DISAGREES, _UNSEEN, _GAP = 20.3, 4.6, 216.0
"""Weights in log odds of being wrong: of the share of the surface that disagrees with the camera,
of what it did not see, and of the distance of the object's points to the surface, in diameters."""
_COMPARED = 500
"""Points of an object that are laid on the surface."""
_BENT, _MOST_DEVIATIONS = 2.0, 4.0
"""A sensor bends what it sees: a fitted size deviates by so many times what its noise explains. A
size that is off by more deviations than the second counts as one that is off by these."""
_MOST_JUDGED, _LEAST_JUDGED = 40, 4
"""Poses that are judged in an image, and of each object at least."""
_ALIGNED, _CLEARLY = 0.7, 0.01
"""Cosine of the normals from which a reading and the surface are alike, and by how much more a
turned pose must score to take the place of the one that was proposed."""
_ROUNDS = 4
"""So often an image is searched for an object that is there more than once, at most."""
_MOST_TOGETHER = 8
"""Poses of one object at one place at most."""
_LEAST_PIXELS = 100
"""Of the whole image: fewer show no shape."""
_SHARED = 0.3
"""Answers that explain so large a share of the same points are of one thing; one of them stays."""
_RIVAL = 0.5
"""Poses of two objects that explain so much of the same points share the probability of one."""
_FLAT = 0.9
"""What lies on one plane by so large a share is flat: anything of its outline looks the same."""
_CONTINUED = 0.4
"""Where the plane goes on beside so much of it, the outline is a cut through something larger."""
_RIM = 0.05
"""Width of what is looked at beside it, in diameters."""
_NAMED = 0.02
"""Other objects of a larger share of the probability are named."""
_LEAST_SHARE = 0.8
"""Where no object among several has so large a share of the probability, none is answered."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SearchTargets:
    """What is looked for.

    Attributes:
        names: of the objects.
        object_of: gives an object by its name, with its point pairs and turns.
        pose_near: clouds and the poses that were proposed for them to estimates.
        max_size_error: of :class:`RefusalConfig`.
        is_sure: answer only what is likelier there than not, and search once, as tracking does.
    """

    names: Sequence[str]
    object_of: Callable[[str], KnownObject]
    pose_near: Callable[[Sequence[CloudInput], Sequence[Rigid]], list[PoseEstimate]]
    max_size_error: float
    is_sure: bool = False


@dataclass(frozen=True, kw_only=True, eq=False)
class _Proposal:
    """A pose of an object, and log odds of its being wrong; ``rank``: among those of its object."""

    object: str
    pose: Rigid
    log_odds: float
    rank: int = 0


@dataclass(frozen=True, kw_only=True, eq=False)
class _Candidate(_Proposal):
    """One that is judged, with the pixels of a frame on it."""

    explained: Bool[Tensor, "h w"]

    def shared_with(self, other: "_Candidate") -> float:
        """Share of the smaller one's pixels that both explain."""
        both = float((self.explained & other.explained).sum())
        return both / max(1.0, min(float(self.explained.sum()), float(other.explained.sum())))


def find_objects(view: ViewInput, known: SearchTargets) -> list[PoseEstimate]:
    """Pose every known object that a depth image shows, the surest first; what is none is left out.

    Point pairs of the whole image vote for poses of each object. Those with which the image agrees
    are gathered by the readings that they explain; from those of the likeliest the object is
    estimated. Where poses of several objects explain the same, they share the probability of one by
    the evidence against each, and where none has most of it none is answered. Where an object is
    there more than once, the rest of the image is searched for more of it.

    Args:
        view: depth and camera; its mask limits where is looked.
        known: what for.
    """
    frame = prepare_frame(torch.where(view.mask, view.depth_m, torch.nan), view.K)
    found, taken = list[tuple[_Candidate, PoseEstimate]](), list[_Candidate]()
    names, is_left = known.names, torch.ones_like(frame.depth_m, dtype=torch.bool)
    for _ in range(1 if known.is_sure else _ROUNDS):
        groups: list[list[_Candidate]] = []
        for one in _candidates(frame, is_left, replace(known, names=names)):
            if any(one.shared_with(other) > _SHARED for other in taken):
                continue
            same = (some for some in groups if some[0].object == one.object)
            own = next((some for some in same if one.shared_with(some[0]) > _RIVAL), None)
            if own is None:
                pose = _best_turned(frame, one.pose, known.object_of(one.object))
                explained = explained_mask(frame, pose, known.object_of(one.object).surface)
                groups.append([replace(one, pose=pose, explained=explained)])
            elif len(own) < _MOST_TOGETHER:
                own.append(one)
        more, taken = _without_rivals(_judged(groups, frame, view, known), taken)
        found += more
        for one, _ in more:
            is_left &= ~one.explained
        count = Counter(one.object for one, _ in found)
        names = sorted({one.object for one, _ in more if count[one.object] > 1})
        if not names:
            break
    found.sort(key=lambda answer: answer[0].log_odds)
    return [replace(estimate, name=f"{view.name}_{k}") for k, (_, estimate) in enumerate(found)]


def _candidates(
    frame: Frame, is_left: Bool[Tensor, "h w"], known: SearchTargets
) -> list[_Candidate]:
    """Propose poses of every object, and take the likeliest of all, and of each object some."""

    def propose(name: str) -> list[_Proposal]:
        pairs = known.object_of(name).pairs
        assert pairs is not None
        poses, log_odds = propose_in_frame(frame, is_left, pairs, len(known.names))
        likely = (log_odds < _MOST_LOG_ODDS).nonzero()[:_MOST_JUDGED, 0].tolist()
        return [
            _Proposal(object=name, pose=poses[k], log_odds=float(log_odds[k]), rank=rank)
            for rank, k in enumerate(likely)
        ]

    each = each_in_threads(propose, known.names, torch.get_num_threads())
    every = sorted((one for some in each for one in some), key=lambda one: one.log_odds)
    found = list[_Candidate]()
    for k, one in enumerate(every):
        if k < _MOST_JUDGED or one.rank < _LEAST_JUDGED:
            own = explained_mask(frame, one.pose, known.object_of(one.object).surface)
            if int(own.sum()) * frame.step**2 >= _LEAST_PIXELS:
                found.append(_Candidate(**vars(one), explained=own))
    return found


def _best_turned(frame: Frame, pose: Rigid, known: KnownObject) -> Rigid:
    """Give the pose or the one of its turns at which the object explains most readings about it.

    A handle that a wrong turn of a mug leaves out does not contradict it: a neighbour may be there.
    So each is scored by the readings that it explains, over the most that one does, less the share
    of its surface that the image contradicts.
    """
    surface, copies = known.surface, known.copies
    assert copies is not None
    if len(copies.turns.R) == 0:
        return pose
    every = Rigid.cat([pose[None], pose[None] @ copies.turns])
    about = (frame.depth_m > 0) & (frame.plane_m < surface.diameter_m)
    middle_m = pose.apply(surface.middle_m[None])[0]
    about &= (frame.points_m - middle_m).norm(dim=-1) < surface.diameter_m
    local_m = every.inverse().apply(frame.points_m[about])
    index = surface.boxes.look_up(local_m)
    is_near = (local_m - surface.points_m[index]).norm(dim=-1) < NEAR * surface.diameter_m
    cosine = ((surface.normals[index] @ every.R.mT) * frame.normals[about]).sum(-1).abs()
    number = (is_near & ((cosine > _ALIGNED) | ~frame.is_smooth[about])).sum(-1)
    contradicted = compare_with_image(frame, every, surface).contradicted
    score = number / number.max().clamp(min=1) - contradicted
    best = int(score.argmax())
    return every[best] if float(score[best] - score[0]) > _CLEARLY else pose


def _judged(
    groups: Sequence[Sequence[_Candidate]], frame: Frame, view: ViewInput, known: SearchTargets
) -> list[tuple[_Candidate, PoseEstimate]]:
    """Estimate each object from what its likeliest pose explains; leave out what is refused."""
    inputs: list[CloudInput] = []
    height, width = view.depth_m.shape
    for k, some in enumerate(groups):
        mask = some[0].explained
        mask = mask.repeat_interleave(frame.step, 0).repeat_interleave(frame.step, 1)
        cloud_m = cloud_from_depth(view.depth_m, mask[:height, :width] & view.mask, view.K)
        name = f"{view.name}_{k}"
        inputs.append(CloudInput(name=name, points_m=cloud_m, object=some[0].object, view=view))
    poses = [Rigid.stack([one.pose for one in some]) for some in groups]
    answers: list[tuple[_Candidate, PoseEstimate]] = []
    most_log_odds = _ANSWERED if len(known.names) == 1 else 0.0
    if known.is_sure:
        most_log_odds = _ANOTHER
    estimates = known.pose_near(inputs, poses) if inputs else []
    for one, estimate in zip(inputs, estimates, strict=True):
        if estimate.camera_from_model is None:
            continue
        surface = known.object_of(estimate.object).surface
        pose = estimate.camera_from_model.double()
        seen = seen_about(one.points_m, view, surface.diameter_m)
        fit = fit_of(seen, pose, surface, rim=1)
        log_odds = float(log_odds_wrong(frame, pose[None], surface))
        own = explained_mask(frame, pose, surface)
        log_odds += _DISAGREES * (1 - fit.agrees) + _UNSEEN * (1 - fit.seen)
        # Median distance of points to the planes through the nearest samples, in diameters.
        local_m = pose.inverse().apply(take_evenly(frame.points_m[own], _COMPARED))
        index = surface.nearest(local_m)
        along_m = ((local_m - surface.points_m[index]) * surface.normals[index]).sum(-1)
        gap = float(along_m.abs().median()) / surface.diameter_m if len(along_m) else NEAR
        log_odds += _GAP * gap
        off = size_deviations(estimate, view, surface, known.max_size_error)
        log_odds += 0.5 * min(off, _MOST_DEVIATIONS) ** 2  # of a normal distribution
        if log_odds < most_log_odds and not is_cut_out(seen, pose, surface):
            found = _Candidate(object=estimate.object, pose=pose, log_odds=log_odds, explained=own)
            answers.append((found, estimate))
    return answers


def size_deviations(
    estimate: PoseEstimate, view: ViewInput, surface: Surface, max_size_error: float
) -> float:
    """Give by how many standard deviations the size that fits best differs from the model's.

    The deviation of the fit knows the noise of the readings alone: it is taken twice, for a sensor
    bends what it sees. Added to it is half of what the model and the sensor may be off by.

    Args:
        estimate: with a pose.
        view: in which it was found.
        surface: of the model.
        max_size_error: by so much a thing may differ in size from its model.
    """
    identity, pose = estimate.identity, estimate.camera_from_model
    if identity is None or identity.size is None or identity.size_deviation is None:
        return 0.0
    assert pose is not None
    distance_m = float(pose.apply(surface.points_m.mean(0, keepdim=True).float())[0, 2])
    sensor = sensor_size_error(distance_m, float(view.K[0, 0]), surface.diameter_m)
    expected = math.hypot(0.5 * (max_size_error + sensor), _BENT * identity.size_deviation)
    return abs(identity.size - 1) / expected


def _without_rivals(
    answers: Sequence[tuple[_Candidate, PoseEstimate]], before: Sequence[_Candidate]
) -> tuple[list[tuple[_Candidate, PoseEstimate]], list[_Candidate]]:
    """Keep answers from the surest down that explain what none before does, if they are likely.

    Gives them, and all whose place is taken: where it may be another object, by none.
    """
    kept, taken = list[tuple[_Candidate, PoseEstimate]](), list(before)
    ranked = sorted(answers, key=lambda answer: answer[0].log_odds)
    for k, (one, estimate) in enumerate(ranked):
        if any(one.shared_with(other) > _SHARED for other in taken):
            continue
        same = [other.log_odds for other in taken if other.object == one.object]
        if len(same) == 1 and one.log_odds > min(_ANOTHER, same[0] + _LESS_SURE):
            continue
        there = 1 / (1 + math.exp(one.log_odds))
        if same and there * (estimate.certainty or 0.0) < _LEAST_CERTAINTY:
            continue
        taken.append(one)
        rivals = {one.object: (one.log_odds, estimate)}
        for other, its in ranked[k + 1 :]:
            if one.shared_with(other) > _RIVAL:
                rivals.setdefault(other.object, (other.log_odds, its))
        log_odds = torch.tensor([log_odds for log_odds, _ in rivals.values()], dtype=torch.float64)
        some, shares = [its for _, its in rivals.values()], (-log_odds).softmax(0)
        best, share = _given_others(some, shares, there)
        if share >= _LEAST_SHARE:  # else it may be another object
            kept.append((one, best))
    return kept, taken


def explained_mask(
    seen: Frame | Seen | ViewInput, pose: Rigid, surface: Surface
) -> Bool[Tensor, "h w"]:
    """Mark the pixels whose points lie on a posed surface; in a frame, none of wider planes."""
    if isinstance(seen, Frame):
        points_m = seen.points_m
        found = (seen.depth_m > 0) & (seen.plane_m < surface.diameter_m)
    else:
        points_m = back_project(seen.depth_m.double(), seen.K.double())
        found = points_m.isfinite().all(-1)
        if isinstance(seen, ViewInput):
            found &= seen.mask
    pose = pose.double()
    middle_m = pose.apply(surface.points_m.mean(0, keepdim=True))
    found[found.clone()] = (points_m[found] - middle_m).norm(dim=-1) < surface.diameter_m
    local_m, limit_m = pose.inverse().apply(points_m[found]), NEAR * surface.diameter_m
    gap_m = (local_m - surface.points_m[surface.boxes.look_up(local_m)]).norm(dim=-1)
    # The nearest sample is nearer than the one of the box by its diagonal at most.
    is_open = (gap_m >= limit_m) & (gap_m < limit_m + math.sqrt(3) * surface.boxes.side_m)
    some_m = local_m[is_open]
    gap_m[is_open] = (some_m - surface.points_m[surface.nearest(some_m)]).norm(dim=-1)
    found[found.clone()] = gap_m < limit_m
    return found


def is_cut_out(seen: Seen, pose: Rigid, surface: Surface) -> bool:
    """Whether what lies on a posed surface is flat, and goes on in its plane beyond the outline.

    Args:
        seen: about the object.
        pose: of the object.
        surface: of its model.
    """
    own, points_m = explained_mask(seen, pose, surface), back_project(seen.depth_m, seen.K)
    plane = largest_plane(points_m[own], torch.Generator().manual_seed(0))
    if plane is None or float(is_on_plane(points_m[own], plane).double().mean()) < _FLAT:
        return False
    pixel_m = float(points_m[own][:, 2].median() / seen.K[0, 0])
    reach = BORDER_PX + math.ceil(_RIM * surface.diameter_m / pixel_m)
    rim = grow_mask(own, reach) & ~grow_mask(own, BORDER_PX)
    return float(is_on_plane(points_m[rim], plane).double().mean()) > _CONTINUED


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
    if share < _LEAST_SHARE:
        said = ", ".join(
            f"{one.object} ({float(s):.0%})" for one, s in zip(some, shares, strict=True)
        )
        return PoseEstimate(
            name=best.name, object=best.object, status="doubtful", signals=best.signals,
            reason=f"it may be {said}; say which by object", seconds=dict(spent),
        )  # fmt: skip
    return replace(best, seconds=dict(spent))


def _given_others(
    some: Sequence[PoseEstimate], shares: Tensor, there: float = 1.0
) -> tuple[PoseEstimate, float]:
    """Take the likeliest and its share of the probability ``there`` that any of them is right."""
    number = int(shares.argmax())
    share, estimate = float(shares[number]), some[number]
    certainty = estimate.certainty
    if certainty is not None:
        certainty = there * (share * certainty)
    others = tuple(
        replace(a, probability=there * (share * a.probability)) for a in estimate.alternatives
    )
    found = replace(estimate, certainty=certainty, alternatives=others)
    if len(some) > 1 and estimate.identity is not None and share < 1 - _NAMED:
        second = some[int(shares.topk(2).indices[1])].object
        reason = f"it may be {second} ({1 - share:.0%} for all other objects)"
        identity = replace(estimate.identity, status="not excluded", other=second, reason=reason)
        found = replace(found, identity=identity)
    return found, share
