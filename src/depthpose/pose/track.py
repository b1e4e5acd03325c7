"""One object through a sequence of frames: ICP from the last pose, and a search where it is lost.

As long as the frames agree with the refined poses, a frame costs no more than ICP.
"""

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from depthpose.core.arrays import take_evenly
from depthpose.core.camera.pinhole import crop_intrinsics
from depthpose.core.rigid import Rigid
from depthpose.core.stopwatch import Stopwatch
from depthpose.pose.cloud import cloud_from_depth, require_same_size
from depthpose.pose.config import EstimateConfig, RefusalConfig
from depthpose.pose.geometry.surface import NEAR, Surface
from depthpose.pose.icp import refine_best
from depthpose.pose.planes import Plane, is_on_plane, largest_plane
from depthpose.pose.refusals import Refused, unreadable_on_error
from depthpose.pose.types import (
    Alternative,
    AnyInput,
    CloudInput,
    Evidence,
    PoseEstimate,
    ViewInput,
)
from depthpose.pose.verify.decide import require_observable, require_right, with_status
from depthpose.pose.verify.evidence import Observation, compare, observe
from depthpose.pose.verify.observability import free_motions, without_motions
from depthpose.pose.verify.probability import (
    PRIOR_EXPECTED,
    log_likelihood_ratio,
    probability_right,
)
from depthpose.pose.verify.target_object import TargetObject

_MARGIN_DIAMETERS = 0.15
"""Largest distance from the surface at the last or the predicted pose of points that may be the
object's: between two frames it moves by less."""
_NEAREST_SHARE = 0.1
"""The front of the ball about an object counts as no nearer than this share of the middle's depth:
a ball about the camera has no outline in the image."""
_MOST_POINTS = 10_000  # points about the object that are used, evenly taken
_LEAST_POINTS = 60  # with fewer points about it the object is not followed
_NEW_EVIDENCE = 0.2
"""Share of a frame's evidence that is new: sensor and object err alike in the next frame."""
_MOST_LOG_ODDS = 9.0  # largest log odds of a track: a few contradicting frames must end it
_LEAST_CERTAINTY = 1e-4  # with which a track begins: later frames can change finite log odds
_SUPPORTS = 2  # planes beside the object that are looked for: a table and a wall
_SUPPORT_POINTS = 1000  # points beside the object in which these planes are looked for
_SUPPORT_DEVIATIONS = 3.0  # standard deviations up to which a point lies on such a plane
_LEAST_LEFT_SHARE = 0.2  # least share of the points near an object that its support leaves
_FLAT_SHARE = 0.9  # share of a flat object's surface that lies in the plane of its support


def _gather_scene(pose_input: AnyInput, poses: Rigid, surface: Surface) -> Float64[Tensor, "n 3"]:
    """Gather the points of a frame whose rays pass the object, at one of several poses, or near it.

    Args:
        pose_input: the frame.
        poses: where the object may be, a batch.
        surface: of the model.
    """
    # A ball about the object at all of these poses, and what lies beside it.
    middles_m = (poses.R @ surface.points_m.mean(0)) + poses.t_m
    middle_m = middles_m.mean(0)
    spread_m = float((middles_m - middle_m).norm(dim=-1).max())
    radius_m = (0.5 + 2 * _MARGIN_DIAMETERS) * surface.diameter_m + spread_m
    if isinstance(pose_input, ViewInput):
        points_m = _lift_square_about(pose_input, middle_m, radius_m)
        return take_evenly(points_m, _MOST_POINTS)

    # Of a cloud the points whose rays meet a square about the ball.
    points_m = pose_input.points_m.double()
    points_m = points_m[points_m.isfinite().all(-1) & (points_m[:, 2] > 0)]
    offset = points_m[:, :2] / points_m[:, 2:] - middle_m[:2] / middle_m[2]
    nearest_m = (middle_m[2] - radius_m).clamp(min=_NEAREST_SHARE * middle_m[2])
    is_toward = offset.abs().amax(-1) < radius_m / nearest_m
    return take_evenly(points_m[is_toward], _MOST_POINTS)


def _lift_square_about(
    view: ViewInput, middle_m: Float64[Tensor, "3"], radius_m: float
) -> Float64[Tensor, "n 3"]:
    """Lift the foreground in a square about a ball to points of the camera frame."""
    # The square in the image.
    z_m = float(middle_m[2])
    K = view.K.double()
    nearest_m = max(z_m - radius_m, _NEAREST_SHARE * z_m)
    u, v = (K @ (middle_m / z_m))[:2].tolist()
    across_px = float(K[0, 0]) * radius_m / nearest_m
    down_px = float(K[1, 1]) * radius_m / nearest_m
    height, width = view.depth_m.shape
    left = min(max(round(u - across_px), 0), width)
    right = min(max(round(u + across_px), 0), width)
    top = min(max(round(v - down_px), 0), height)
    bottom = min(max(round(v + down_px), 0), height)

    window = (slice(top, bottom), slice(left, right))
    window_K = crop_intrinsics(K, left, top)
    return cloud_from_depth(view.depth_m[window], view.foreground[window], window_K).double()


@dataclass(frozen=True, kw_only=True, eq=False)
class _FrameMotion:
    """How an object moved between two frames: rotated about its own origin, and shifted."""

    R: Float64[Tensor, "3 3"]  #: rotation of the object, in the axes of the camera
    shift_m: Float64[Tensor, "3"]  #: of its origin, in the camera frame

    @classmethod
    def between(cls, before: Rigid, after: Rigid) -> "_FrameMotion":
        """Compute the motion from one pose to the next."""
        return cls(R=after.R @ before.R.mT, shift_m=after.t_m - before.t_m)

    def move(self, pose: Rigid) -> Rigid:
        """Apply the motion to a pose."""
        return Rigid(self.R @ pose.R, pose.t_m + self.shift_m)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Track:
    """The state of an object that is followed."""

    pose: Rigid  #: in the last frame
    motion: _FrameMotion | None  #: from the frame before the last to it; None: not known
    log_odds: float  #: that the pose is right, up to near-symmetries, by all frames
    first: PoseEstimate | None  #: that the track began with; None: it began with a given pose


def track(
    frames: Iterable[AnyInput | PoseEstimate],
    target: TargetObject,
    config: EstimateConfig,
    search: Callable[[AnyInput], PoseEstimate],
    first: Rigid | None = None,
) -> Iterator[PoseEstimate]:
    """Estimate the pose of one object in frame after frame, each from that of the frame before.

    Args:
        frames: views or clouds. In place of a frame that cannot be read, an estimate that says so:
            it is yielded unchanged, and the next frame is estimated from the pose before.
        target: the object.
        config: of ICP and limits.
        search: poses the object in a frame where it is not followed.
        first: its rough pose ``camera_from_model`` in the first frame; None: it is searched.

    Yields:
        An estimate for each frame, whose ``tracking`` says how it came about. A frame that cannot
        be taken, as a mask of another size, is ``unreadable``.
    """
    current = None
    if first is not None:
        log_odds = math.log(PRIOR_EXPECTED)
        current = _Track(pose=first.double(), motion=None, log_odds=log_odds, first=None)
    for pose_input in frames:
        if isinstance(pose_input, PoseEstimate):
            yield pose_input
            continue
        work = partial(_follow_or_search, pose_input, current, target, config, search)
        outcome = unreadable_on_error(pose_input, work)
        if isinstance(outcome, PoseEstimate):
            yield outcome
            continue
        estimate, following = outcome
        # In a cloud without its depth image a lost object is looked for only where it was. It did
        # not go on as it moved before, or it would have been found there.
        is_bare_cloud = isinstance(pose_input, CloudInput) and pose_input.view is None
        if following is None and is_bare_cloud and current is not None:
            following = replace(current, motion=None)
        current = following
        yield estimate


def _follow_or_search(
    pose_input: AnyInput,
    current: _Track | None,
    target: TargetObject,
    config: EstimateConfig,
    search: Callable[[AnyInput], PoseEstimate],
) -> tuple[PoseEstimate, _Track | None]:
    """Follow the object into a frame, or else search it there.

    Returns:
        The estimate, and the track after this frame; None for it where the object is lost.

    Raises:
        InputError: mask and depth of the frame differ in size.
    """
    if isinstance(pose_input, ViewInput):
        require_same_size(pose_input.mask, pose_input.depth_m)

    # Followed from the frame before.
    watch = Stopwatch()
    if current is not None:
        try:
            with watch.stage("tracking"):
                estimate, following = _follow(pose_input, current, target, config)
        except Refused:  # searched below
            pass
        else:
            return replace(estimate, name=pose_input.name, seconds=watch.seconds), following

    # Searched: not known from the frame before, or not seen where it was.
    searched = search(pose_input)
    seconds = {**watch.seconds, **searched.seconds}
    pose = searched.camera_from_model
    tracking = "lost" if pose is None else "found"
    estimate = replace(searched, name=pose_input.name, seconds=seconds, tracking=tracking)
    if pose is None:
        return estimate, None

    # A track that begins at another object stays there: only an `ok` pose of an image begins one.
    is_tested = isinstance(pose_input, ViewInput) and searched.certainty is not None
    if is_tested and not searched.is_ok:
        return estimate, None
    certainty = min(max(searched.certainty or 0.0, _LEAST_CERTAINTY), 1 - _LEAST_CERTAINTY)
    log_odds = math.log(certainty / (1 - certainty))
    return estimate, _Track(pose=pose.double(), motion=None, log_odds=log_odds, first=searched)


def _follow(
    pose_input: AnyInput, current: _Track, target: TargetObject, config: EstimateConfig
) -> tuple[PoseEstimate, _Track]:
    """Refine the last pose and the predicted one, and weigh the better one by the evidence.

    Returns:
        The estimate, still without a name, and the track after this frame.

    Raises:
        Refused: the object is not followed.
    """
    # Where it may be: at its last pose, or going on as it moved last.
    surface = target.surface
    starts = [current.pose]
    if current.motion is not None:
        starts.insert(0, current.motion.move(current.pose))
    poses = Rigid.stack(starts)

    # The points near these poses, without the plane that the object lies on.
    scene_m = _gather_scene(pose_input, poses, surface)
    is_near = _mark_near(scene_m, poses, surface, _MARGIN_DIAMETERS)
    is_support = _mark_support(scene_m, is_near, current.pose.apply(surface.points_m))
    cloud_m = scene_m[is_near & ~is_support]
    if len(cloud_m) < _LEAST_POINTS:
        reason = f"{len(cloud_m)} points lie where the object was, below {_LEAST_POINTS}"
        raise Refused("too few points", reason)

    # Refined, and the points that lie on it then.
    refined, _ = refine_best(cloud_m, poses, surface, config.icp)
    pose = refined.camera_from_model.double()
    object_m = scene_m[_mark_near(scene_m, pose[None], surface, NEAR) & ~is_support]
    if len(object_m) < _LEAST_POINTS:
        reason = f"{len(object_m)} points lie on the object, below {_LEAST_POINTS}"
        raise Refused("too few points", reason)

    # Is the pose right, and does what is seen of the object determine it?
    view = pose_input if isinstance(pose_input, ViewInput) else pose_input.view
    observation = observe(object_m, view, surface, is_masked=False)
    weighed = _weigh_pose(observation, pose, current.log_odds, surface, config.limits)
    free = free_motions(target.model.symmetries.continuous, pose)
    fixed = require_observable(observation, target, pose, free, config.limits)
    covariance = refined.covariance if fixed is None else fixed.set_deviation(refined.covariance)

    # The estimate, and the track that the next frame begins with.
    estimate = PoseEstimate(
        name="",
        object=target.model.name,
        status="ok",
        camera_from_model=refined.camera_from_model.float(),
        covariance=without_motions(covariance, free).float(),
        free_motions=free.float(),
        residual_m=float(refined.residual_m),
        evidence=weighed.evidence,
        certainty=weighed.certainty,
        copy_certainty=weighed.certainty,
        tracking="tracked",
    )
    estimate = _carry_copies(estimate, pose, current.first)
    estimate = with_status(estimate, config.min_certainty)
    motion = _FrameMotion.between(current.pose, pose)
    following = replace(current, pose=pose, motion=motion, log_odds=weighed.log_odds)
    return estimate, following


class _WeighedPose(NamedTuple):
    """The evidence for a pose, and what follows from it."""

    evidence: Evidence  #: of this frame
    log_odds: float  #: that the pose is right, by all frames
    certainty: float  #: the probability of these odds


def _weigh_pose(
    observation: Observation,
    pose: Rigid,
    log_odds: float,
    surface: Surface,
    limits: RefusalConfig,
) -> _WeighedPose:
    """Weigh a pose by the evidence of its frame, alone and together with the frames before.

    Args:
        observation: of the object in the frame.
        pose: ``camera_from_model``.
        log_odds: that the track is right, by the frames before.
        surface: of the model.
        limits: the least probability.

    Raises:
        Refused: the pose is doubtful, by this frame or by all.
    """
    # By this frame alone.
    evidence = compare(observation, pose, surface)
    probability = probability_right(evidence, is_expected=True)
    require_right(evidence, probability, limits, is_masked=False)

    # Together with the frames before.
    log_odds += _NEW_EVIDENCE * log_likelihood_ratio(evidence)
    log_odds = min(max(log_odds, -_MOST_LOG_ODDS), _MOST_LOG_ODDS)
    certainty = 1 / (1 + math.exp(-log_odds))
    if certainty < limits.min_probability:
        reason = (
            f"together with the frames before it the pose is right with a probability of "
            f"{certainty:.0%}, though by this frame alone with {probability:.0%}"
        )
        raise Refused("doubtful", reason)
    return _WeighedPose(evidence, log_odds, certainty)


def _carry_copies(estimate: PoseEstimate, pose: Rigid, first: PoseEstimate | None) -> PoseEstimate:
    """Add to an estimate the near-symmetric copies that its track began with, moved to its pose.

    Args:
        estimate: with its certainty.
        pose: of the estimate, in float64.
        first: the estimate that the track began with; without copies ``estimate`` stays as it is.
    """
    if first is None or not first.certainty or first.copy_certainty is None:
        return estimate
    assert first.camera_from_model is not None
    assert estimate.certainty is not None

    # The shares of the copies in the certainty do not change while the object is followed.
    scale = estimate.certainty / first.certainty
    model_from_camera = first.camera_from_model.double().inverse()  # in the first frame
    copies: list[Alternative] = []
    for copy in first.alternatives:
        if copy.is_copy:
            model_from_copy = model_from_camera @ copy.camera_from_model.double()
            copy_pose = (pose @ model_from_copy).float()
            probability = scale * copy.probability
            copies.append(replace(copy, camera_from_model=copy_pose, probability=probability))
    copy_certainty = scale * first.copy_certainty
    return replace(estimate, copy_certainty=copy_certainty, alternatives=tuple(copies))


class _Support(NamedTuple):
    """A table or wall that an object lies on or before: a slab about a plane."""

    plane: Plane
    half_m: float  #: half the thickness of the slab

    def holds(self, points_m: Float64[Tensor, "n 3"]) -> Bool[Tensor, " n"]:
        """Whether points lie in the slab."""
        return self.plane.height_m(points_m).abs() < self.half_m


def _mark_support(
    scene_m: Float64[Tensor, "n 3"], is_near: Bool[Tensor, " n"], posed_m: Float64[Tensor, "m 3"]
) -> Bool[Tensor, " n"]:
    """Mark the points of the supports of an object, onto which ICP would pull it.

    A flat object that lies in its support cannot be told from it: then no point is marked.

    Args:
        scene_m: points about the object, in the camera frame.
        is_near: which of them may be the object's.
        posed_m: its surface at the last pose.
    """
    is_support = torch.zeros_like(is_near)
    is_flat = torch.zeros(len(posed_m), dtype=torch.bool)
    for support in _find_supports(scene_m[~is_near]):
        is_support |= support.holds(scene_m)
        is_flat |= support.holds(posed_m)

    # If little is left of an object that is not flat, it was taken away.
    left = int((is_near & ~is_support).sum())
    is_little_left = left < max(_LEAST_POINTS, _LEAST_LEFT_SHARE * int(is_near.sum()))
    is_object_flat = float(is_flat.double().mean()) > _FLAT_SHARE
    return torch.zeros_like(is_near) if is_little_left and is_object_flat else is_support


def _find_supports(beside_m: Float64[Tensor, "n 3"]) -> list[_Support]:
    """Find the largest planes of the points beside an object, one after the other.

    A support is as thick as the deviations of its points from the plane say.
    """
    supports: list[_Support] = []
    generator = torch.Generator().manual_seed(0)  # of RANSAC: the same frame, the same planes
    for _ in range(_SUPPORTS):
        some_m = take_evenly(beside_m, _SUPPORT_POINTS)
        plane = largest_plane(some_m, generator)
        if plane is None:
            break
        height_m = plane.height_m(some_m[is_on_plane(some_m, plane)])
        if len(height_m) < _LEAST_POINTS:
            break
        rms_m = float(height_m.square().mean().sqrt())
        support = _Support(plane, _SUPPORT_DEVIATIONS * rms_m)
        supports.append(support)
        beside_m = beside_m[~support.holds(beside_m)]
    return supports


def _mark_near(
    points_m: Float64[Tensor, "n 3"], poses: Rigid, surface: Surface, limit: float
) -> Bool[Tensor, " n"]:
    """Mark the points within a limit, in diameters, of the surface at one of several poses."""
    local_m = poses.inverse().apply(points_m)
    distance_m = surface.nearest(local_m, is_exact=False).distance_m
    return (distance_m < limit * surface.diameter_m).any(0)
