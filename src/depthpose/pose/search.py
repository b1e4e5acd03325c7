"""Known objects in a depth image without a mask: votes propose poses, the evidence decides.

Point pairs of the whole image, or of a region of it, vote for poses of each object. Each proposal
is refined on the readings that it explains, and compared with the image. Proposals that explain the
same readings are one place; there the object is estimated from the readings that the best proposal
explains. Places that explain the same readings compete.
"""

import math
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor
from torch.nn.functional import softplus

from depthpose.core.camera import back_project, project
from depthpose.core.devices import each_in_threads
from depthpose.core.rigid import Rigid
from depthpose.pose.cloud import cloud_from_depth, grow_mask
from depthpose.pose.config import EstimateConfig
from depthpose.pose.copies import PreparedObject
from depthpose.pose.decide import (
    LEAST_NAMED,
    PRIOR_MANY,
    PRIOR_PROPOSED,
    contradiction,
    log_odds_right,
    probability_right,
)
from depthpose.pose.evidence import BORDER_PX, compare, observe
from depthpose.pose.frame import (
    Frame,
    is_on_plane,
    largest_plane,
    prepare_frame,
    share_behind,
)
from depthpose.pose.icp import refine_roughly
from depthpose.pose.inputs import nothing_seen
from depthpose.pose.picking import with_pick_ranks
from depthpose.pose.propose.image import propose_in_frame
from depthpose.pose.surface import NEAR, Surface
from depthpose.pose.types import (
    CloudInput,
    Evidence,
    KnownBackground,
    PoseEstimate,
    ViewInput,
)

_MOST_PLACES, _LEAST_PROPOSALS = 40, 4
"""Proposals that are looked at in an image, and of each object at least."""
_HOPELESS = 0.02
"""A refined proposal that is less likely is given up."""
_ROUNDS = 4
"""So often an image is searched for an object that is there more than once, at most."""
_MOST_TOGETHER = 8
"""Proposals of one object at one place at most."""
_LEAST_PIXELS = 100
"""Of the whole image: fewer show no shape."""
_SHARED = 0.3
"""Estimates that explain so large a share of the same readings are of one thing; one stays."""
_RIVAL = 0.5
"""Poses of two objects that explain so much of the same readings compete."""
_FLAT = 0.9
"""What lies on one plane by so large a share is flat: anything of its outline looks the same."""
_CONTINUED = 0.4
"""Where the plane goes on beside so much of it, the outline is a cut through something larger."""
_RIM = 0.05
"""Width of what is looked at beside it, in diameters."""
_REGION_MARGIN = 0.5
"""Of the larger side of a region: so far about it planes and neighbours are looked at."""
_SUNK = 0.05
"""Of a surface no larger share lies in a bin, table or wall: its pose is off by less."""
_LEAST_SHARE = 0.8
"""Where no object among several has so large a share of the probability, none is reported."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SearchTargets:
    """What is looked for.

    Attributes:
        names: of the objects.
        object_of: gives an object by its name, with its point pairs and copies.
        estimate_near: estimates objects from clouds and the poses that were proposed for them.
        config: of ICP, and of what a real object is off from its model.
        min_probability: with which a pose must be right to be given.
        prior_odds: of the best pose at a place being right.
        is_single: search once, for one object.
    """

    names: Sequence[str]
    object_of: Callable[[str], PreparedObject]
    estimate_near: Callable[[Sequence[CloudInput], Sequence[Rigid], float], list[PoseEstimate]]
    config: EstimateConfig
    min_probability: float
    prior_odds: float = PRIOR_PROPOSED
    is_single: bool = False


@dataclass(frozen=True, kw_only=True, eq=False)
class _Place:
    """Where an object may be: a pose, and the readings of the frame that it explains."""

    object: str
    pose: Rigid
    explained: Bool[Tensor, "h w"]

    @cached_property
    def area_px(self) -> int:
        """Readings that it explains."""
        return int(self.explained.count_nonzero())

    def shared_with(self, other: "_Place") -> float:
        """Share of the smaller one's readings that both explain."""
        both_px = int((self.explained & other.explained).count_nonzero())
        return both_px / max(1, min(self.area_px, other.area_px))


@dataclass(frozen=True, kw_only=True, eq=False)
class _Judged(_Place):
    """A place whose object was estimated."""

    estimate: PoseEstimate
    log_odds: float  #: of its being right


@dataclass(frozen=True, kw_only=True, eq=False)
class _Miss:
    """A place at which an object was refused.

    Attributes:
        object: its name.
        middle_m: of the proposed pose, in the camera frame.
        agreement: share of what was compared that supports the pose.
        reason: of the refusal.
    """

    object: str
    middle_m: Float[Tensor, "3"]
    agreement: float
    reason: str


def find_objects(view: ViewInput, targets: SearchTargets) -> list[PoseEstimate]:
    """Pose every known object that a depth image shows, the surest first; refuse the others.

    Where poses of several objects explain the same readings, they share the probability of one, and
    where none has most of it none is reported. Where an object is there more than once, the rest of
    the image is searched for more of it. Of an object that is not found a refusal says where it was
    looked for and what its nearest miss was.

    Args:
        view: depth and camera; its mask limits where is looked.
        targets: what for.
    """
    began = time.perf_counter()
    whole = view
    view = _window_of_region(view)
    smallest_m = min(targets.object_of(name).surface.diameter_m for name in targets.names)
    frame = prepare_frame(view.depth_m, view.K, smallest_m, view.background)
    is_unclaimed = view.mask[:: frame.step, :: frame.step].clone()
    names = list(targets.names)
    accepted: list[_Judged] = []
    taken: list[_Judged] = []
    misses: list[_Miss] = []
    for _ in range(1 if targets.is_single else _ROUNDS):
        proposed = _propose(frame, is_unclaimed, names, taken, targets)
        likely, hopeless = _refine(proposed, frame, view, targets)
        judged, refused = _judge(_group(likely), frame, view, targets)
        misses += hopeless + refused
        if targets.is_single:
            judged, outside = _within(judged, is_unclaimed, targets)
            misses += outside
        more, taken, uncertain = _suppress(judged, taken, targets)
        misses += uncertain
        accepted += more
        for place in more:
            is_unclaimed &= ~place.explained
        # What is there twice may be there more often; what was found once is not asked for again.
        count = Counter(place.object for place in accepted)
        names = sorted({place.object for place in more if count[place.object] > 1})
        if not names:
            break
    accepted, missed = _weigh_instances(accepted, targets)
    misses += missed
    accepted.sort(key=lambda place: -place.log_odds)
    spent_s = time.perf_counter() - began
    estimates = [
        replace(place.estimate, seconds={**place.estimate.seconds, "search": spent_s})
        for place in accepted
    ]
    if not targets.is_single:
        surfaces = {name: targets.object_of(name).surface for name in targets.names}
        estimates = with_pick_ranks(estimates, view, surfaces)
    posed = {estimate.object for estimate in estimates}
    estimates += [
        nothing_found(whole, name, [miss for miss in misses if miss.object == name], spent_s)
        for name in targets.names
        if name not in posed
    ]
    if len(estimates) == 1:
        return [replace(estimates[0], name=view.name)]
    return [replace(estimate, name=f"{view.name}_{k}") for k, estimate in enumerate(estimates)]


def _propose(
    frame: Frame,
    is_unclaimed: Bool[Tensor, "h w"],
    names: Sequence[str],
    taken: Sequence[_Place],
    targets: SearchTargets,
) -> list[_Place]:
    """Propose poses of every object: the best of all, and some of each, but where one is taken."""

    def propose(name: str) -> list[tuple[float, int, str, Rigid]]:
        pairs = targets.object_of(name).pairs
        assert pairs is not None
        poses, agreement = propose_in_frame(frame, is_unclaimed, pairs, len(names))
        return [
            (float(agreement[rank]), rank, name, poses[rank])
            for rank in range(min(len(agreement), _MOST_PLACES))
        ]

    proposals = [
        proposal
        for group in each_in_threads(propose, names, torch.get_num_threads())
        for proposal in group
    ]
    proposals.sort(key=lambda proposal: -proposal[0])
    places: list[_Place] = []
    for number, (_, rank, name, pose) in enumerate(proposals):
        if number >= _MOST_PLACES and rank >= _LEAST_PROPOSALS:
            continue
        explained = explained_mask(frame, pose, targets.object_of(name).surface)
        place = _Place(object=name, pose=pose, explained=explained)
        is_taken = any(place.shared_with(other) > _SHARED for other in taken)
        if place.area_px * frame.step**2 >= _LEAST_PIXELS and not is_taken:
            places.append(place)
    return places


def _refine(
    places: Sequence[_Place], frame: Frame, view: ViewInput, targets: SearchTargets
) -> tuple[list[_Place], list[_Miss]]:
    """Refine each proposal on the readings that it explains; rank them by their evidence.

    Returns:
        The proposals that may be right, the likeliest first; and the hopeless ones.
    """
    icp = targets.config.icp
    object_m = targets.config.object_deviation_m

    def refine(place: _Place) -> tuple[Rigid, Evidence]:
        surface = targets.object_of(place.object).surface
        cloud_m = _readings_of(place, frame, view)
        pose = refine_roughly(cloud_m, place.pose[None], surface, icp)[0]
        observation = observe(cloud_m, view, surface.diameter_m, object_m, is_masked=False)
        return pose, compare(observation, pose, surface)

    likely: list[tuple[float, _Place]] = []
    hopeless: list[_Miss] = []
    refined = each_in_threads(refine, places, torch.get_num_threads())
    for place, (pose, evidence) in zip(places, refined, strict=True):
        probability = probability_right(evidence, targets.prior_odds)
        if probability < _HOPELESS:
            reason = contradiction(evidence, probability)
            hopeless.append(_miss_at(place, evidence, reason, targets))
            continue
        explained = explained_mask(frame, pose, targets.object_of(place.object).surface)
        likely.append((probability, replace(place, pose=pose, explained=explained)))
    likely.sort(key=lambda pair: -pair[0])
    return [place for _, place in likely], hopeless


def _readings_of(place: _Place, frame: Frame, view: ViewInput) -> Float[Tensor, "n 3"]:
    """Give the readings that a place explains, of all pixels of the view, in the camera frame."""
    height, width = view.depth_m.shape
    mask = place.explained.repeat_interleave(frame.step, 0).repeat_interleave(frame.step, 1)
    return cloud_from_depth(view.depth_m, mask[:height, :width], view.K)


def _group(places: Sequence[_Place]) -> list[list[_Place]]:
    """Gather proposals of an object that explain the same readings; the likeliest leads each."""
    groups: list[list[_Place]] = []
    for place in places:
        same = [group for group in groups if group[0].object == place.object]
        group = next((group for group in same if place.shared_with(group[0]) > _RIVAL), None)
        if group is None:
            groups.append([place])
        elif len(group) < _MOST_TOGETHER:
            group.append(place)
    return groups


def _judge(
    groups: Sequence[Sequence[_Place]], frame: Frame, view: ViewInput, targets: SearchTargets
) -> tuple[list[_Judged], list[_Miss]]:
    """Estimate the object of each place from what its best pose explains; separate refusals."""
    inputs: list[CloudInput] = []
    for number, group in enumerate(groups):
        cloud_m = _readings_of(group[0], frame, view)
        name = f"{view.name}_{number}"
        inputs.append(CloudInput(name=name, points_m=cloud_m, object=group[0].object, view=view))
    proposals = [Rigid.stack([place.pose for place in group]) for group in groups]
    judged: list[_Judged] = []
    misses: list[_Miss] = []
    estimates = targets.estimate_near(inputs, proposals, targets.prior_odds) if inputs else []
    for estimate, group in zip(estimates, groups, strict=True):
        surface = targets.object_of(estimate.object).surface
        evidence = estimate.evidence
        reason = estimate.reason
        if estimate.camera_from_model is not None:
            reason = _exclusion_by_background(
                frame, view, estimate.camera_from_model.double(), surface
            )
        if estimate.camera_from_model is None or evidence is None or reason:
            misses.append(_miss_at(group[0], evidence, reason, targets))
            continue
        pose = estimate.camera_from_model.double()
        judged.append(
            _Judged(
                object=estimate.object,
                pose=pose,
                explained=explained_mask(frame, pose, surface),
                estimate=estimate,
                log_odds=math.log(targets.prior_odds) + log_odds_right(evidence),
            )
        )
    return judged, misses


def _miss_at(
    place: _Place, evidence: Evidence | None, reason: str, targets: SearchTargets
) -> _Miss:
    """Describe a place at which an object was refused."""
    surface = targets.object_of(place.object).surface
    return _Miss(
        object=place.object,
        middle_m=place.pose.apply(surface.middle_m[None])[0],
        agreement=0.0 if evidence is None else evidence.agreement,
        reason=reason,
    )


def _weigh_instances(
    accepted: Sequence[_Judged], targets: SearchTargets
) -> tuple[list[_Judged], list[_Miss]]:
    """Weigh the places of each object by each other; separate those that are not likely enough."""
    remaining: list[_Judged] = []
    misses: list[_Miss] = []
    for name in dict.fromkeys(place.object for place in accepted):
        places = [place for place in accepted if place.object == name]
        log_odds = torch.tensor([place.log_odds for place in places], dtype=torch.float64)
        prior_many = 0.0 if targets.is_single else PRIOR_MANY
        probabilities = probability_of_instances(log_odds, prior_many)
        shares = probabilities / log_odds.sigmoid()  # of the probability that each has by itself
        for k, place in enumerate(places):
            probability = float(probabilities[k])
            if probability >= targets.min_probability:
                estimate = _scaled(place.estimate, float(shares[k]))
                remaining.append(replace(place, estimate=estimate))
            else:
                reason = (
                    f"beside the surer ones it is right with a probability of {probability:.0%}"
                )
                misses.append(_miss_at(place, place.estimate.evidence, reason, targets))
    return remaining, misses


def probability_of_instances(
    log_odds: Float64[Tensor, " n"], prior_many: float
) -> Float64[Tensor, " n"]:
    """Give the probability of each place of one object, of which there is one or any number.

    A table holds one of each object, a bin holds many: so a second place needs more evidence than
    the first, and where several have it further ones need no more.

    Args:
        log_odds: of each place being right, by itself.
        prior_many: odds of any number of instances, and not one at most; 0 in a detector's box.
    """
    by_itself = log_odds.sigmoid()
    none_or_one = torch.cat([log_odds.new_zeros(1), log_odds])
    log_many = (
        log_odds.new_tensor(prior_many).log() + softplus(log_odds).sum()
    )  # of all choices of places
    many = (log_many - none_or_one.logsumexp(0)).sigmoid()
    return many * by_itself + (1 - many) * none_or_one.softmax(0)[1:]


def _within(
    judged: Sequence[_Judged], is_region: Bool[Tensor, "h w"], targets: SearchTargets
) -> tuple[list[_Judged], list[_Miss]]:
    """Separate places that lie mostly beside a region: they are of something else."""
    inside: list[_Judged] = []
    misses: list[_Miss] = []
    for place in judged:
        if float(is_region[place.explained].double().mean()) > 0.5:
            inside.append(place)
        else:
            reason = "most of it lies beside the box"
            misses.append(_miss_at(place, place.estimate.evidence, reason, targets))
    return inside, misses


def _suppress(
    judged: Sequence[_Judged], before: Sequence[_Judged], targets: SearchTargets
) -> tuple[list[_Judged], list[_Judged], list[_Miss]]:
    """Non-maximum suppression: in order of probability, keep what explains other readings.

    Returns:
        What is kept; all whose readings are taken, by what may be one of several objects too; and
        places at which an object is not kept for the sake of another.
    """
    kept: list[_Judged] = []
    misses: list[_Miss] = []
    taken = list(before)
    ranked = sorted(judged, key=lambda place: -place.log_odds)
    for number, place in enumerate(ranked):
        surer = next((other for other in taken if place.shared_with(other) > _SHARED), None)
        if surer is not None:
            if surer.object != place.object:
                reason = f"what lies there is more likely {surer.object}"
                misses.append(_miss_at(place, place.estimate.evidence, reason, targets))
            continue
        taken.append(place)
        rivals = {place.object: place}
        for other in ranked[number + 1 :]:
            if place.shared_with(other) > _RIVAL:
                rivals.setdefault(other.object, other)
        estimate, share = choose_object_of_place(list(rivals.values()))
        if share >= _LEAST_SHARE:
            kept.append(replace(place, estimate=estimate))
        else:
            others = ", ".join(name for name in rivals if name != place.object)
            reason = f"what lies there may be {others} as well"
            misses.append(_miss_at(place, place.estimate.evidence, reason, targets))
    return kept, taken, misses


def explained_mask(image: Frame | ViewInput, pose: Rigid, surface: Surface) -> Bool[Tensor, "h w"]:
    """Mark the pixels whose points lie on a posed surface; in a frame, none of its background."""
    pose = pose.double()
    window = _pixels_about(image, pose, surface)
    depth_m = image.depth_m[window].double()
    if isinstance(image, Frame):
        points_m = image.points_m[window]
        is_explained = (depth_m > 0) & (image.background_limit_m[window] < surface.diameter_m)
    else:
        points_m = back_project(depth_m, _window_intrinsics(image.K, window).double())
        is_explained = points_m.isfinite().all(-1) & image.mask[window]
    local_m = pose.inverse().apply(points_m[is_explained])
    distance_m = (local_m - surface.points_m[surface.boxes.look_up(local_m)]).norm(dim=-1)
    # The nearest sample is nearer than the one of the box by its diagonal at most.
    limit_m = NEAR * surface.diameter_m
    is_open = (distance_m >= limit_m) & (distance_m < limit_m + math.sqrt(3) * surface.boxes.side_m)
    nearest_m = surface.points_m[surface.nearest(local_m[is_open])]
    distance_m[is_open] = (local_m[is_open] - nearest_m).norm(dim=-1)
    is_explained[is_explained.clone()] = distance_m < limit_m
    explained = torch.zeros(image.depth_m.shape, dtype=torch.bool)
    explained[window] = is_explained
    return explained


def _pixels_about(image: Frame | ViewInput, pose: Rigid, surface: Surface) -> tuple[slice, slice]:
    """Rows and columns in which a posed surface lies, with a margin."""
    height, width = image.depth_m.shape
    posed_m = pose.double().apply(surface.points_m)
    pixel = project(posed_m[posed_m[:, 2] > 0], image.K.double())
    if len(pixel) == 0:
        return slice(0, 0), slice(0, 0)
    low = pixel.amin(0)
    high = pixel.amax(0)
    margin = 0.1 * (high - low) + 2 * BORDER_PX
    left, top = (low - margin).floor().tolist()
    right, bottom = (high + margin).ceil().tolist()
    rows = slice(min(max(int(top), 0), height), min(max(int(bottom) + 1, 0), height))
    columns = slice(min(max(int(left), 0), width), min(max(int(right) + 1, 0), width))
    return rows, columns


def _window_intrinsics(
    K: Float[Tensor, "3 3"], window: tuple[slice, slice]
) -> Float[Tensor, "3 3"]:
    """Intrinsic matrix of a part of an image."""
    K = K.clone()
    K[0, 2] -= window[1].start
    K[1, 2] -= window[0].start
    return K


def _window_of_region(view: ViewInput) -> ViewInput:
    """Cut a view about its mask, with a margin in which planes and neighbours show."""
    rows, columns = view.mask.any(1).nonzero()[:, 0], view.mask.any(0).nonzero()[:, 0]
    if len(rows) == 0:
        return view
    margin = int(_REGION_MARGIN * max(int(rows[-1] - rows[0]), int(columns[-1] - columns[0])))
    part = (
        slice(max(int(rows[0]) - margin, 0), int(rows[-1]) + margin + 1),
        slice(max(int(columns[0]) - margin, 0), int(columns[-1]) + margin + 1),
    )
    return _cut(view, part)


def _cut(view: ViewInput, part: tuple[slice, slice]) -> ViewInput:
    """Cut a part out of a view."""
    K = _window_intrinsics(view.K, part)
    known = view.background
    if known is not None:
        known = KnownBackground(depth_m=known.depth_m[part], is_seen=known.is_seen[part])
    return replace(view, depth_m=view.depth_m[part], mask=view.mask[part], K=K, background=known)


def _exclusion_by_background(frame: Frame, view: ViewInput, pose: Rigid, surface: Surface) -> str:
    """Say why the background of an image excludes a pose; nothing where it does not."""
    if is_cut_out(view, pose, surface):
        return "it would be cut out of a plane that goes on beside it"
    points_m = pose.apply(surface.points_m)
    wider = [other for other in frame.backgrounds if other.diameter_m >= surface.diameter_m]
    for background in wider:
        share = share_behind(frame, background, points_m, NEAR * surface.diameter_m)
        if share > _SUNK:
            return f"{share:.0%} of it would lie in the bin, table or wall before which it is seen"
    return ""


def is_cut_out(view: ViewInput, pose: Rigid, surface: Surface) -> bool:
    """Whether what lies on a posed surface is flat, and goes on in its plane beyond the outline.

    Args:
        view: in which the pose was found.
        pose: of the object.
        surface: of its model.
    """
    window = _cut(view, _pixels_about(view, pose, surface))
    explained = explained_mask(window, pose, surface)
    points_m = back_project(window.depth_m.double(), window.K.double())
    plane = largest_plane(points_m[explained], torch.Generator().manual_seed(0))
    if plane is None:
        return False
    if float(is_on_plane(points_m[explained], plane).double().mean()) < _FLAT:
        return False
    pixel_m = float(points_m[explained][:, 2].median() / window.K[0, 0])
    reach = BORDER_PX + math.ceil(_RIM * surface.diameter_m / pixel_m)
    rim = grow_mask(explained, reach) & ~grow_mask(explained, BORDER_PX)
    if window.background is not None:
        rim &= ~window.background.is_seen
    return float(is_on_plane(points_m[rim], plane).double().mean()) > _CONTINUED


def nothing_found(
    view: ViewInput, object: str, misses: Sequence[_Miss], spent_s: float
) -> PoseEstimate:
    """Say that a depth image does not show an object surely, and what its nearest miss was."""
    read_m = view.depth_m[view.mask & (view.depth_m > 0)]
    facts: dict[str, Any] = {"name": view.name, "object": object, "seconds": {"search": spent_s}}
    if len(read_m) == 0:
        return PoseEstimate(status="too few points", reason=nothing_seen(view), **facts)
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


def choose_object(estimates: Sequence[PoseEstimate]) -> PoseEstimate:
    """Choose which object one input shows, from the estimates for every object that it may be.

    An object that was refused is not the one; one of the others is.

    Args:
        estimates: for the same input, one an object.

    Returns:
        The best, its certainty given the others; refused where none is posed, or where another
        object is too likely.
    """
    posed = [estimate for estimate in estimates if estimate.is_posed]
    seconds: Counter[str] = Counter()
    for estimate in estimates:
        seconds.update(estimate.seconds)
    if not posed:
        nearest = max(estimates, key=lambda e: 0.0 if e.evidence is None else e.evidence.agreement)
        names = ", ".join(estimate.object for estimate in estimates)
        reason = f"none of {names} surely; {nearest.object} comes nearest: {nearest.reason}"
        return replace(nearest, reason=reason, seconds=dict(seconds))
    shares = _object_shares(posed)
    best, share = _likeliest(posed, shares)
    if share < _LEAST_SHARE:
        candidates = ", ".join(
            f"{estimate.object} ({float(its_share):.0%})"
            for estimate, its_share in zip(posed, shares, strict=True)
        )
        return PoseEstimate(
            name=best.name,
            object=best.object,
            status="doubtful",
            reason=f"it may be {candidates}; say which by object",
            seconds=dict(seconds),
        )
    return replace(best, seconds=dict(seconds))


def choose_object_of_place(places: Sequence[_Judged]) -> tuple[PoseEstimate, float]:
    """Give the estimate of the likeliest object of one place, and its share among the objects."""
    estimates = [place.estimate for place in places]
    return _likeliest(estimates, _object_shares(estimates))


def _object_shares(estimates: Sequence[PoseEstimate]) -> Tensor:
    """Give the probability of each object, if the readings are of one of them.

    Each is weighed by the evidence of its best pose.
    """
    evidences = [estimate.evidence for estimate in estimates if estimate.evidence is not None]
    log_odds = [log_odds_right(evidence) for evidence in evidences]
    return torch.tensor(log_odds, dtype=torch.float64).softmax(0)


def _likeliest(estimates: Sequence[PoseEstimate], shares: Tensor) -> tuple[PoseEstimate, float]:
    """Give the likeliest estimate, its probabilities multiplied by its share among the objects."""
    best = int(shares.argmax())
    share, estimate = float(shares[best]), estimates[best]
    chosen = _scaled(estimate, share)
    if len(estimates) > 1 and estimate.identity is not None and share < 1 - LEAST_NAMED:
        second = estimates[int(shares.topk(2).indices[1])].object
        reason = f"it may be {second} ({1 - share:.0%} for all other objects)"
        identity = replace(estimate.identity, status="not excluded", other=second, reason=reason)
        chosen = replace(chosen, identity=identity)
    return chosen, share


def _scaled(estimate: PoseEstimate, share: float) -> PoseEstimate:
    """Multiply the probabilities of an estimate by a share."""
    certainty, copy_certainty = estimate.certainty, estimate.copy_certainty
    return replace(
        estimate,
        certainty=None if certainty is None else share * certainty,
        copy_certainty=None if copy_certainty is None else share * copy_certainty,
        alternatives=tuple(
            replace(alternative, probability=share * alternative.probability)
            for alternative in estimate.alternatives
        ),
    )
