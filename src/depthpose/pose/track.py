"""One object through a sequence of frames: ICP from the last pose, and detection where it is lost.

A frame costs ICP alone as long as what was seen agrees with the pose that comes out.
"""

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from depthpose.core.arrays import take_evenly
from depthpose.core.rigid import Rigid
from depthpose.pose.cloud import Refusal, cloud_from_depth
from depthpose.pose.config import IcpConfig, RefusalConfig
from depthpose.pose.frame import is_on_plane, largest_plane
from depthpose.pose.icp import refine_best
from depthpose.pose.observability import free_motions, observability, without_motions
from depthpose.pose.surface import NEAR, Surface, compare_depths
from depthpose.pose.types import AnyInput, CloudInput, ObjectModel, PoseEstimate, ViewInput

MARGIN = 0.15
"""Of the diameter: points so far from the surface at the last or the predicted pose may be the
object's; between two frames it moves by less."""
_MOST_POINTS = 10_000  # of what a camera saw about the object, evenly taken
_LEAST_POINTS = 60
_THROUGH = 0.1  # where the camera saw through more of the posed surface, the object is not there
_SEEN = 0.35  # where less of the posed surface was seen, it may be anywhere
_SEEN_BESIDE, _REST_SEEN = 0.2, 0.5
"""Of an object that is followed and occluded less is enough, if so much of the rest was seen."""
_SUPPORTS = 2  # planes beside the object that are looked for: a table and a wall
_BESIDE = 1000  # points beside the object that show them
_ON = 3.0  # standard deviations of a plane's points: nearer ones are of it


def scene_about(given: AnyInput, poses: Rigid, surface: Surface) -> Float64[Tensor, "n 3"]:
    """Give all points in the direction of the object at one of several poses, and about it."""
    middles_m = (poses.R @ surface.points_m.mean(0)) + poses.t_m
    middle_m = middles_m.mean(0)
    radius_m = (0.5 + 2 * MARGIN) * surface.diameter_m
    radius_m += float((middles_m - middle_m).norm(dim=-1).max())
    if isinstance(given, ViewInput):
        # The square about a ball, cut out of the view.
        z_m, K = float(middle_m[2]), given.K.double().clone()
        near_m = max(z_m - radius_m, 0.1 * z_m)
        u, v = (K @ (middle_m / z_m))[:2].tolist()
        across, down = (float(K[k, k]) * radius_m / near_m for k in range(2))
        height, width = given.depth_m.shape
        left, right = (min(max(round(u + s * across), 0), width) for s in (-1, 1))
        top, bottom = (min(max(round(v + s * down), 0), height) for s in (-1, 1))
        part = (slice(top, bottom), slice(left, right))
        K[0, 2] -= left
        K[1, 2] -= top
        points_m = cloud_from_depth(given.depth_m[part], given.mask[part], K).double()
        return take_evenly(points_m, _MOST_POINTS)
    points_m = given.points_m.double()
    points_m = points_m[points_m.isfinite().all(-1) & (points_m[:, 2] > 0)]
    offset = points_m[:, :2] / points_m[:, 2:] - middle_m[:2] / middle_m[2]
    near = offset.abs().amax(-1) < radius_m / (middle_m[2] - radius_m).clamp(min=0.1 * middle_m[2])
    return take_evenly(points_m[near], _MOST_POINTS)


@dataclass(frozen=True, kw_only=True, eq=False)
class TrackedObject:
    """What is followed, and how it is looked for."""

    model: ObjectModel  #: the object
    surface: Surface  #: of the model
    refusal: RefusalConfig  #: when a pose is refused
    icp: IcpConfig  #: of the first steps
    look: Callable[[AnyInput], PoseEstimate]  #: estimates the object in a frame not yet known


@dataclass(frozen=True, kw_only=True, eq=False)
class _Last:
    """The last pose, how it moved from the one before, and the estimate that all began with."""

    pose: Rigid
    moved: Rigid | None
    origin: PoseEstimate | None


def track(
    frames: Iterable[AnyInput | PoseEstimate], known: TrackedObject, first: Rigid | None = None
) -> Iterator[PoseEstimate]:
    """Estimate one object in frame after frame, each from the pose of the frame before.

    In place of a frame that cannot be read there is an estimate that says so: it is given as it is,
    and the object is looked for in the next where it was before.
    """
    last = None if first is None else _Last(pose=first.double(), moved=None, origin=None)
    for given in frames:
        if isinstance(given, PoseEstimate):
            yield given
            continue
        estimate = _next(given, last, known)
        if estimate.camera_from_model is None:
            # In a cloud of a whole scene it can be looked for only where it was.
            is_scene = isinstance(given, CloudInput) and given.view is None
            last = replace(last, moved=None) if is_scene and last is not None else None
        else:
            pose = estimate.camera_from_model.double()
            if estimate.tracking == "found" or last is None:
                last = _Last(pose=pose, moved=None, origin=estimate)
            else:  # the turn about the object's origin, and its shift
                moved = Rigid(pose.R @ last.pose.R.mT, pose.t_m - last.pose.t_m)
                last = replace(last, pose=pose, moved=moved)
        yield estimate


def _next(given: AnyInput, last: _Last | None, known: TrackedObject) -> PoseEstimate:
    """Follow the object into a frame, or look for it there."""
    followed_s = 0.0
    if last is not None:
        began = time.perf_counter()
        followed = _follow(given, last, known)
        followed_s = time.perf_counter() - began
        if isinstance(followed, PoseEstimate):
            return replace(followed, name=given.name, seconds={"icp": followed_s})
    found = known.look(given)
    spent = {**found.seconds, "icp": found.seconds.get("icp", 0.0) + followed_s}
    doubt, pose = None, found.camera_from_model
    if pose is not None:  # compared with the frame, as one that was followed is
        scene_m = scene_about(given, Rigid.stack([pose.double()]), known.surface)
        doubt = _contradiction(compare_depths(scene_m, pose.double(), known.surface))
    if doubt is not None:
        return PoseEstimate(
            name=given.name, object=found.object, status=doubt.status, reason=doubt.reason,
            seconds=spent, tracking="lost",
        )  # fmt: skip
    tracking = "lost" if pose is None else "found"
    return replace(found, name=given.name, seconds=spent, tracking=tracking)


def _contradiction(
    shares: tuple[float, float, float], *, is_followed: bool = False
) -> Refusal | None:
    """Say why a posed surface seen, seen through and occluded to these shares is not there."""
    agrees, through, before = shares
    least = min(_SEEN, max(_SEEN_BESIDE, _REST_SEEN * (1 - before))) if is_followed else _SEEN
    if through > _THROUGH:
        return Refusal(
            status="doubtful", reason=f"the camera saw through {through:.0%} of the posed surface"
        )
    if agrees >= least:
        return None
    return Refusal(
        status="doubtful",
        reason=f"{agrees:.0%} of the posed surface was seen, {before:.0%} is occluded, and "
        f"{least:.0%} must be seen",
    )


def _follow(given: AnyInput, last: _Last, known: TrackedObject) -> PoseEstimate | Refusal:
    """Refine the last pose and the predicted one; take the better if the scene agrees with it."""
    surface, starts = known.surface, [last.pose]
    if last.moved is not None:  # the pose that goes on as it moved last
        moved = Rigid(last.moved.R @ last.pose.R, last.pose.t_m + last.moved.t_m)
        starts.insert(0, moved)
    starts = Rigid.stack(starts)
    scene_m = scene_about(given, starts, surface)
    near = _is_near(scene_m, starts, surface, MARGIN)
    is_support = _is_support(scene_m, near, last.pose.apply(surface.points_m))
    cloud_m = scene_m[near & ~is_support]
    if len(cloud_m) < _LEAST_POINTS:
        return Refusal(
            status="too few points",
            reason=f"{len(cloud_m)} points lie where the object was, below {_LEAST_POINTS}",
        )
    refined = refine_best(cloud_m, starts, surface, replace(known.icp, starts=1)).refined
    pose = refined.camera_from_model.double()
    shares = compare_depths(scene_m, pose, surface)
    if (contradiction := _contradiction(shares, is_followed=True)) is not None:
        return contradiction
    own_m = scene_m[_is_near(scene_m, Rigid.stack([pose]), surface, NEAR) & ~is_support]
    free = free_motions(known.model.symmetries.continuous, pose)
    observable, _ = observability(own_m, pose, surface, free)
    if observable < known.refusal.min_observability:
        return Refusal(
            status="not observable",
            reason="the seen part of the object does not fix its pose (observability "
            f"{observable:.1%})",
        )
    covariance = refined.covariance
    if len(free):
        covariance = without_motions(covariance, free)
    answer = PoseEstimate(
        name="",
        object=known.model.name,
        status="ok",
        camera_from_model=refined.camera_from_model.float(),
        covariance=covariance.float(),
        free_motions=free.float(),
        residual_m=float(refined.residual_m),
        tracking="tracked",
    )
    if (origin := last.origin) is None:
        return answer
    assert origin.camera_from_model is not None
    back = origin.camera_from_model.double().inverse()
    carried = tuple(
        replace(a, camera_from_model=(pose @ (back @ a.camera_from_model.double())).float())
        for a in origin.alternatives
    )
    return replace(answer, status=origin.status, reason=origin.reason,
                   certainty=origin.certainty, alternatives=carried)  # fmt: skip


def _is_support(
    scene_m: Float64[Tensor, "n 3"], near: Bool[Tensor, " n"], posed_m: Float64[Tensor, "m 3"]
) -> Bool[Tensor, " n"]:
    """Whether points are of a table or wall beside the object, onto which ICP would pull it."""
    is_support, is_flat = torch.zeros_like(near), torch.zeros(len(posed_m), dtype=torch.bool)
    generator = torch.Generator().manual_seed(0)
    for _ in range(_SUPPORTS):
        beside_m = take_evenly(scene_m[~near & ~is_support], _BESIDE)
        plane = largest_plane(beside_m, generator)
        if plane is None:
            break
        normal, offset = plane
        gap_m = (beside_m @ normal - offset)[is_on_plane(beside_m, plane)]
        if len(gap_m) < _LEAST_POINTS:
            break
        limit_m = _ON * gap_m.square().mean().sqrt()
        is_support |= (scene_m @ normal - offset).abs() < limit_m
        is_flat |= (posed_m @ normal - offset).abs() < limit_m
    # What is as flat as the noise cannot be parted from what it lies on; else it was taken away.
    few = int((near & ~is_support).sum()) < max(_LEAST_POINTS, 0.2 * int(near.sum()))
    return torch.zeros_like(near) if few and float(is_flat.double().mean()) > 0.9 else is_support


def _is_near(
    points_m: Float64[Tensor, "n 3"], poses: Rigid, surface: Surface, limit: float
) -> Bool[Tensor, " n"]:
    """Whether points are within a limit, in diameters, of the surface at one of several poses."""
    local_m = poses.inverse().apply(points_m)
    gap_m = (local_m - surface.points_m[surface.boxes.look_up(local_m)]).norm(dim=-1)
    return (gap_m < limit * surface.diameter_m).any(0)
