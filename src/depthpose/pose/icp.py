"""Point-to-plane ICP: refines poses of a model's surface on a cloud."""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor

from depthpose.core.arrays import take_evenly
from depthpose.core.errors import InputError
from depthpose.core.rigid import Rigid, cross_matrix, perturb, rotation_by
from depthpose.pose.compiled import (
    GRAZING,
    LOOKED_UP,
    ON_RAY,
    SEARCHED,
    SLACK,
    use_numba,
)
from depthpose.pose.config import IcpConfig
from depthpose.pose.surface import Surface, finite_array, look_along_rays

_CONVERGED = 3e-4  # stop when a step turns [rad] and shifts [diameters] by less than this
_TURN_RAD = math.radians(15)  # by how much further starts are turned
_ROUGH_LIMITS = (3.0, 2.4, 2.0, 1.6, 1.4, 1.2, 1.0, 1.0, 1.0, 1.0)
"""Of the starts, step by step, over the last limit of all: they begin farther off."""
_ROUGH_POINTS = 100  # points of the cloud that refine and compare starts
_OCCLUDING_POINTS = 1000  # points of the cloud that show what a pose would occlude
_UNSEEN = 0.3  # a surface that should be seen and is not: something may occlude it
_OTHER = 0.1  # mean distance between the points of two poses, in diameters, from which they are two
_MOST_OTHERS = 3  # poses beside the best at which starts ended, that are kept
_TRUST = 0.02
"""Another start must bring so large a share of the points nearer to the surface than the given one
to be believed: a plane fits many places, and noise would choose among them. Where a start ended
roughly must explain the cloud better by as much than where it ended exactly to be preferred."""

_BLOCKS = (0.15, 0.2, 0.3, 0.4)  # sides of blocks of points whose errors may be alike, in diameters
_REST = 0.03
"""Of what holds a pose so much is always taken to be left where a block is left out: else a block
that alone holds a direction would make it infinitely uncertain."""
_LEAST_SLOPE = 0.25  # least information of the weighted residuals, over that of constant weights


@dataclass(frozen=True, kw_only=True, eq=False)
class RefinedPose:
    """A refined pose, with leading batch axes of the poses that it began from."""

    camera_from_model: Rigid  #: the pose
    #: of (rotation, translation) as :class:`~depthpose.pose.types.PoseFit` says, from the
    #: residuals, of which neighbours may be alike, and an offset of all readings along the ray
    #: (``IcpConfig.sensor_offset_m``); what the surface does not fix (a turn of a ball) is far too
    #: uncertain to be missed. Local: of this minimum alone, whether it is the right one or not.
    covariance: Float[Tensor, "*batch 6 6"]
    residual_m: Float[Tensor, "*batch"]  #: root mean square distance to the surface, of what counts
    inlier_share: Float[Tensor, "*batch"]  #: share of the points within the last limit


class BestStart(NamedTuple):
    """The best of several refined poses."""

    refined: RefinedPose  #: it
    start: int  #: number of the given pose that it began from
    others: Rigid  #: the best poses beside it, three at most, roughly refined


def refine_pose(
    points_m: Float[Tensor, "n 3"],
    initial: Rigid,
    surface: Surface,
    config: IcpConfig | None = None,
) -> RefinedPose:
    """Move poses so that the cloud lies on the surface; all of a batch at once.

    Every point of a partial cloud has a place on the whole model, so points seek the surface and
    not the reverse. Each step minimises ``sum w (n . (T^-1 x - s))^2`` over the nearest surface
    point ``s`` with normal ``n`` (Chen and Medioni 1991) that faces the camera; the weight is
    Tukey's, and its limit shrinks from ``start_distance`` to ``end_distance``. After half of
    the steps ``s`` is where the ray of ``x`` meets the surface: noise is along the ray, and the
    nearest point would be on another face where it errs inward near an edge, and draw the model
    toward the camera.

    Where no point of the cloud comes near the surface a pose stays as it was, with an
    ``inlier_share`` of 0.

    Args:
        points_m: of the object, in the camera frame.
        initial: poses to begin from, ``camera_from_model``; one or a batch.
        surface: of :func:`~depthpose.pose.surface.prepare_surface`.
        config: limits and number of steps.

    Raises:
        InputError: there is no point, or one is not finite.
    """
    config = IcpConfig() if config is None else config
    # The limit shrinks in even ratios over half of the steps; then it is kept, and checked by.
    start = config.start_distance_diameters
    end = config.end_distance_diameters
    half = max(1, config.iterations // 2)
    shares = [start * (end / start) ** min(1.0, i / half) for i in range(config.iterations)]
    limits_m = [share * surface.diameter_m for share in (*shares, end)]
    most = config.cloud_points
    initial = initial.double()
    pose, index = _iterated(points_m, most, initial, surface, limits_m, is_exact=True)
    cloud = take_evenly(points_m.double(), most)
    H, _, J, weight, residual_m, spread_m = _normal_equations(
        cloud, pose, surface, limits_m[-1], index, ON_RAY
    )
    local = _covariance(cloud, H, J, weight, residual_m, limits_m[-1], surface.diameter_m)
    middle_m = cloud.mean(0)
    ray = torch.nn.functional.normalize(middle_m, dim=0)
    offset_m = config.sensor_offset_m * torch.cat([torch.zeros(3), ray])
    local = local + torch.outer(offset_m, offset_m)
    eye = torch.eye(3, dtype=torch.float64)
    zero = torch.zeros(3, 3, dtype=torch.float64)
    # w x (p - c) + v = w x p + (v + c x w)
    shift = torch.cat([torch.cat([eye, zero], 1), torch.cat([cross_matrix(middle_m), eye], 1)])
    return RefinedPose(
        camera_from_model=Rigid(pose.R.to(points_m), pose.t_m.to(points_m)),
        covariance=(shift @ local @ shift.mT).to(points_m),
        residual_m=spread_m.to(points_m),
        inlier_share=(weight > 0).to(points_m).mean(-1),
    )


def refine_best(
    points_m: Float[Tensor, "n 3"],
    initial: Rigid,
    surface: Surface,
    config: IcpConfig | None = None,
) -> BestStart:
    """Refine poses, and beside each ones turned from it; give what explains the cloud best.

    All begin with some of the points and a table of what lies near
    (:class:`~depthpose.pose.surface.Boxes`); the best goes on exactly, in half of the steps, from
    the given pose where it was that one. It is the one that leaves the most points near the
    surface, less those that it would have occluded and some of the surface that it shows and nobody
    saw.

    Args:
        points_m: of the object, in the camera frame.
        initial: ``camera_from_model``, one or several; the first is trusted most.
        surface: of :func:`~depthpose.pose.surface.prepare_surface`.
        config: ``starts`` and what :func:`refine_pose` takes.

    Raises:
        InputError: there is no point, or one is not finite.
    """
    config = IcpConfig() if config is None else config
    given = Rigid(initial.R.reshape(-1, 3, 3), initial.t_m.reshape(-1, 3))
    # The poses, then all of them turned once, twice ... about the middle of the object.
    poses = given.double()
    axes = torch.eye(3, dtype=torch.float64)
    middle_m = poses.R @ surface.points_m.mean(0) + poses.t_m
    axes = torch.cat([torch.zeros(1, 3).double(), axes, -axes])[: config.starts]
    turns = rotation_by(_TURN_RAD * axes)[:, None]
    turned_m = (turns @ (poses.t_m - middle_m)[..., None]).squeeze(-1) + middle_m
    starts = Rigid((turns @ poses.R).flatten(0, 1), turned_m.flatten(0, 1))
    tried = refine_roughly(points_m, starts, surface, config)
    end_m = config.end_distance_diameters * surface.diameter_m
    score = _score(points_m, tried, surface, end_m)
    best = int(score.argmax())
    short = replace(config, iterations=(config.iterations + 1) // 2)
    refined = None
    if best < len(given.R):  # the table is rough: where little holds a pose, starts drift by it
        refined = refine_pose(points_m, given[best], surface, short)
        exact = refined.camera_from_model.double()
        rough = tried[best]
        both = Rigid.stack([exact, rough])
        if float(_score(points_m, both, surface, end_m).diff()) > 0:
            refined = None  # it began farther off than exact steps reach
    if refined is None:
        short = replace(short, start_distance_diameters=config.end_distance_diameters)
        refined = refine_pose(points_m, tried[best], surface, short)
    pose = refined.camera_from_model.double()
    # From the best down, those that carry the object elsewhere than any before, symmetries aside.
    others: list[int] = []
    own_m = surface.points_m[:: max(1, len(surface.points_m) // 50)]
    copies_m = surface.symmetries.apply(own_m)
    for k in score.argsort(descending=True).tolist():
        if len(others) == _MOST_OTHERS or score[k] == -torch.inf:
            break
        before = Rigid.stack([pose, *(tried[one] for one in others)])
        moved_m = (before.inverse() @ tried[k]).apply(own_m)
        gap_m = (moved_m[:, None] - copies_m).norm(dim=-1).mean(-1)
        if float(gap_m.min()) > _OTHER * surface.diameter_m:
            others.append(k)
    return BestStart(refined, best % len(given.R), tried[others])


def refine_roughly(
    points_m: Float[Tensor, "n 3"], starts: Rigid, surface: Surface, config: IcpConfig
) -> Rigid:
    """Refine a batch of poses with a hundred of the points and a table of what lies near.

    Args:
        points_m: of the object, in the camera frame.
        starts: poses in float64, ``camera_from_model``.
        surface: of the model.
        config: its last limit.
    """
    end_m = config.end_distance_diameters * surface.diameter_m
    limits_m = [share * end_m for share in _ROUGH_LIMITS]
    return _iterated(points_m, _ROUGH_POINTS, starts, surface, limits_m, is_exact=False)[0]


def _iterated(
    points_m: Float[Tensor, "m 3"],
    most: int,
    pose: Rigid,
    surface: Surface,
    limits_m: list[float],
    *,
    is_exact: bool,
) -> tuple[Rigid, Int64[Tensor, "*batch n"]]:
    """Step to where a cloud of ``most`` points lies on the surface; give their samples, or -1."""
    if len(points_m) == 0 or not bool(points_m.isfinite().all()):
        raise InputError(
            f"ICP of {len(points_m)} points, {int((~points_m.isfinite().all(-1)).sum())} of them "
            "not finite: leave those out, and refuse a cloud of none."
        )
    cloud = take_evenly(points_m.double(), most)
    if use_numba(cloud, pose.R, pose.t_m):
        from depthpose.pose.compiled.poses import refine

        parts = [part.detach().numpy() for part in (pose.R, pose.t_m)]
        R, t_m = (torch.from_numpy(finite_array(part).copy()) for part in parts)
        target = surface.target
        points = finite_array(cloud.detach().numpy())
        arrays = (points, R.view(-1, 3, 3).numpy(), t_m.view(-1, 3).numpy(), np.array(limits_m))
        places = np.full((len(arrays[2]), len(points)), -1)
        refine(*arrays, surface.diameter_m, _CONVERGED, target, is_exact, places)
        index = torch.from_numpy(np.append(target.tree.order, -1)[places])
        return Rigid(R, t_m), index.view(*t_m.shape[:-1], len(points))
    scale = torch.tensor([1.0] * 3 + [surface.diameter_m] * 3, dtype=torch.float64)
    moves = torch.ones_like(pose.t_m[..., :1])
    index = torch.full((*pose.t_m.shape[:-1], len(cloud)), -1)
    steps = len(limits_m) - 1
    for k, limit_m in enumerate(limits_m):
        how = LOOKED_UP if not is_exact else SEARCHED if 2 * k < steps else ON_RAY
        matches = match(cloud, pose, surface, limit_m, how, index)
        index = torch.where(moves > 0, matches, index)
        if k == steps:
            break
        H, pull, *_ = _normal_equations(cloud, pose, surface, limit_m, index, how)
        motion = torch.linalg.solve(H, pull) * moves
        # About the middle itself: a turn by w about the camera, which is D away, with the shift
        # that makes it one about the object to first order would leave the object w^2 D / 2 off.
        turned = perturb(Rigid(pose.R, pose.t_m - cloud.mean(0)), motion)
        pose = Rigid(turned.R, turned.t_m + cloud.mean(0))
        if limit_m <= limits_m[-1] and how != SEARCHED:
            moves = ((motion / scale).abs() >= _CONVERGED).any(-1, keepdim=True).double()
            if not bool(moves.any()):
                break
    return pose, index


def _score(
    points_m: Float[Tensor, "n 3"], poses: Rigid, surface: Surface, limit_m: float
) -> Float64[Tensor, " b"]:
    """Score each pose: share of points near the surface, less distance and contradictions."""
    cloud = take_evenly(points_m.double(), _OCCLUDING_POINTS)
    front, unseen = look_along_rays(cloud, poses, surface, every=4)
    few = take_evenly(cloud, _ROUGH_POINTS)
    index = match(few, poses, surface, limit_m, LOOKED_UP)
    *_, weight, _, spread_m = _normal_equations(few, poses, surface, limit_m, index, LOOKED_UP)
    near = (weight > 0).double().mean(-1)
    # Of equals, the nearer one.
    score = near - spread_m / surface.diameter_m - front - _UNSEEN * unseen
    score[0] += _TRUST  # the first pose is trusted more
    return score


def match(
    cloud_m: Float64[Tensor, "n 3"],
    pose: Rigid,
    surface: Surface,
    limit_m: float,
    how: int,
    before: Int64[Tensor, "*batch n"] | None = None,
) -> Int64[Tensor, "*batch n"]:
    """Give for each point the number of a sample of the surface that the camera may see, or -1.

    A sample is seen where its outer side faces the camera, or nearly; one without a known side
    always, and all where the camera is within a ball about the surface.

    Args:
        cloud_m: in the camera frame.
        pose: ``camera_from_model``, one or a batch.
        surface: of the model.
        limit_m: beyond it nothing is searched.
        how: ``LOOKED_UP``, by the table of boxes; ``SEARCHED``, the nearest; or ``ON_RAY``, the
            nearest to where the point's ray meets the plane of its sample ``before``.
        before: what was found a step earlier.
    """
    poses = Rigid(pose.R.reshape(-1, 3, 3), pose.t_m.reshape(-1, 3))
    local_m = poses.inverse().apply(cloud_m)
    eyes_m = poses.inverse().t_m[:, None]
    if how == LOOKED_UP:
        index = surface.boxes.look_up(local_m)
        index = torch.where(_is_seen(eyes_m, index, surface), index, surface.across[index])
        is_good = (index >= 0) & _is_seen(eyes_m, index, surface)
        return torch.where(is_good, index, -1).reshape(*pose.t_m.shape[:-1], -1)
    if how == ON_RAY and before is not None:
        own = before.reshape(local_m.shape[:2])
        ray_m = local_m - eyes_m
        normal = surface.normals[own]
        point_m = surface.points_m[own]
        slope = (normal * ray_m).sum(-1, keepdim=True)
        share = (normal * (point_m - local_m)).sum(-1, keepdim=True) / slope
        is_met = slope.square() > GRAZING**2 * ray_m.square().sum(-1, keepdim=True)
        meet_m = torch.where(is_met, local_m + share * ray_m, point_m)
        local_m = torch.where(own[..., None] >= 0, meet_m, local_m)
    # Ask for ever more of the nearest samples until one is seen.
    count = 1
    total = len(surface.points_m)
    index = torch.full(local_m.shape[:2], -1)
    which, place = (index < 0).nonzero(as_tuple=True)
    while len(which):
        asked = local_m[which, place].numpy()
        _, nearest = surface.tree.query(asked, k=range(1, count + 1), distance_upper_bound=limit_m)
        nearest = torch.from_numpy(nearest)
        is_some = nearest < total  # the tree's word for none within the limit
        nearest = nearest.clamp(max=total - 1)
        is_good = is_some & _is_seen(eyes_m[which, 0, None], nearest, surface)
        first = is_good.int().argmax(1)
        is_done = is_good.any(1)
        index[which[is_done], place[is_done]] = nearest[is_done, first[is_done]]
        is_left = ~is_done & is_some.all(1) & (count < total)
        which = which[is_left]
        place = place[is_left]
        count = min(8 * count, total)
    return index.reshape(*pose.t_m.shape[:-1], -1)


def _is_seen(
    eyes_m: Float64[Tensor, "b k 3"], index: Int64[Tensor, "b n"], surface: Surface
) -> Bool[Tensor, "b n"]:
    distance_m = (eyes_m - surface.ball_m[:3]).norm(dim=-1)
    toward_m = ((eyes_m - surface.points_m[index]) * surface.outward[index]).sum(-1)
    return (toward_m >= -SLACK * distance_m) | (distance_m <= surface.ball_m[3])


def _normal_equations(
    cloud: Float[Tensor, "n 3"],
    pose: Rigid,
    surface: Surface,
    limit_m: float,
    index: Int64[Tensor, "*batch n"],
    how: int,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Linearise about the middle of the cloud, where turning and shifting hardly mix.

    Gives the information, its right side, the derivatives, weights and residuals of the points, and
    the root mean square distance of those that count, infinite where none does.
    """
    # In the camera frame, where the covariance is wanted.
    normal = surface.normals[index] @ pose.R.mT
    target = surface.points_m[index] @ pose.R.mT + pose.t_m[..., None, :]
    gap = cloud - target
    residual_m = (normal * gap).sum(-1)
    # Tukey's weight of the whole gap: a point beyond an edge is near the plane, not the surface.
    square = gap.square().sum(-1)
    if how == ON_RAY:  # along the ray it is the residual that counts
        along = (gap * cloud).sum(-1).square() / cloud.square().sum(-1)
        square = square - along + residual_m.square()
    weight = torch.where(index >= 0, (1 - square / limit_m**2).clamp(min=0).square(), 0.0)
    arm = target - cloud.mean(0)
    # Moving the model by (w, v) moves its point by w x arm + v, and lowers the residual.
    J = torch.cat([torch.linalg.cross(arm, normal), normal], -1)
    weighted = J.mT * weight[..., None, :]
    H = weighted @ J
    # A direction that no point constrains stays where it was.
    size = H.diagonal(dim1=-2, dim2=-1).amax(-1)[..., None, None].clamp(min=1e-6)
    H = H + 1e-9 * size * torch.eye(6, dtype=torch.float64)
    pull = (weighted @ residual_m[..., None]).squeeze(-1)
    total = weight.sum(-1)
    mean_square = (weight * residual_m.square()).sum(-1) / total.clamp(min=1e-12)
    return H, pull, J, weight, residual_m, torch.where(total > 0, mean_square, torch.inf).sqrt()


def _covariance(
    cloud: Float64[Tensor, "n 3"],
    H: Float64[Tensor, "*batch 6 6"],
    J: Float64[Tensor, "*batch n 6"],
    weight: Float64[Tensor, "*batch n"],
    residual_m: Float64[Tensor, "*batch n"],
    limit_m: float,
    diameter_m: float,
) -> Float64[Tensor, "*batch 6 6"]:
    """Say how uncertain a motion about the middle of the cloud is, by the residuals.

    Independent errors give ``s^2 / A``, where ``A`` has the slope of the weighted residual (Huber
    1981): Tukey's weights hold less than they weigh. Neighbours may err alike, and the fit takes up
    what few points alone hold: how far it moves where a block of the view is left out (MacKinnon
    and White's jackknife) says both. Of several sizes of blocks that of the largest moves counts,
    for nobody knows how far errors reach; there are few blocks, so each direction is as uncertain
    as all are in the mean, over independent errors, or more.
    """
    root = weight.sqrt()
    slope = root * (root - 4 * (residual_m / limit_m).square())
    half = torch.linalg.cholesky(H)
    bent = torch.linalg.solve_triangular(half, J.mT * slope[..., None, :] @ J, upper=False)
    bent = torch.linalg.solve_triangular(half, bent.mT, upper=False)
    values, ways = torch.linalg.eigh(bent)
    variance = (weight * residual_m.square()).sum(-1) / (weight.sum(-1) - 6).clamp(min=1)
    # Of s^2 / A a root, and the root's inverse: A itself may be singular to rounding.
    spread_m = variance.clamp(min=1e-20).sqrt()[..., None, None]
    size = values.clamp(min=_LEAST_SLOPE).sqrt()[..., None, :]
    own = spread_m * torch.linalg.solve_triangular(half.mT, ways / size, upper=True)
    from_own = (half @ ways * size).mT / spread_m
    inverse = own @ own.mT / spread_m.square()
    pulls = (weight * residual_m)[..., None] * J
    shares = (slope[..., None] * J)[..., None] * J[..., None, :]
    flat_m = cloud[:, :2] / cloud[:, 2:] * cloud[:, 2].mean()
    eye = torch.eye(6, dtype=torch.float64)
    most = torch.ones_like(values)
    ways = eye.expand_as(own)
    for side in _BLOCKS:
        cells = (flat_m / (side * diameter_m)).floor() @ torch.tensor([1.0, 1e6]).double()
        _, block = cells.unique(return_inverse=True)
        count = int(block.max()) + 1
        pull = pulls.new_zeros(*pulls.shape[:-2], count, 6).index_add_(-2, block, pulls)
        held = shares.new_zeros(*shares.shape[:-3], count, 6, 6).index_add_(-3, block, shares)
        rest = eye * (1 + _REST) - held @ inverse[..., None, :, :]
        moves = torch.linalg.solve(rest, pull[..., None]).squeeze(-1) @ inverse
        moves = from_own @ moves.mT
        values, axes = torch.linalg.eigh(moves @ moves.mT)
        is_more = values.sum(-1, keepdim=True) > most.sum(-1, keepdim=True)
        most = torch.where(is_more, values, most)
        ways = torch.where(is_more[..., None], axes, ways)
    least = most.mean(-1, keepdim=True).clamp(min=1)
    spread = own @ ways
    return (spread * torch.maximum(most, least)[..., None, :]) @ spread.mT
