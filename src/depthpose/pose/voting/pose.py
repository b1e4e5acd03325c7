"""Keypoints to pose: Kabsch, then the most likely pose under the keypoints' own covariances.

A check needs no truth: found keypoints must have the distances that the model's have.
"""

import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from depthpose.core.rigid import Rigid, cross_matrix, fit_rigid, perturb
from depthpose.pose.compiled import serves
from depthpose.pose.types import Axis, PoseFit, Symmetries

_STEPS = 4
"""Gauss-Newton from Kabsch converges quadratically; the fourth step is below float64's noise."""


def fit_pose(
    keypoints_m: Float[Tensor, "*batch k 3"],
    covariance_m2: Float[Tensor, "*batch k 3 3"],
    model_keypoints_m: Float[Tensor, "k 3"],
    is_used: Bool[Tensor, "*batch k"] | None = None,
) -> PoseFit:
    """Carry the model's keypoints onto the found ones.

    Begins with the weighted Kabsch fit, weights one over each covariance's trace, then minimises
    ``sum e^T C^-1 e`` with ``e = R m + t - p`` over left perturbations. A vote is far surer across
    its lines than along them, which one weight a keypoint cannot say. The covariance of the pose is
    the inverse of ``sum J^T C^-1 J`` with ``J = [-[R m + t]_x, I]``.

    Args:
        keypoints_m: found, in the camera frame.
        covariance_m2: of each; a lower bound keeps exact keypoints finite.
        model_keypoints_m: known, in the model frame.
        is_used: which count; None: all. Three at least, not on a line.

    Raises:
        InputError: fewer than three keypoints are used.
    """
    found, model = keypoints_m.double(), model_keypoints_m.double()
    model = model.expand_as(found)
    used = torch.ones_like(found[..., 0], dtype=torch.bool) if is_used is None else is_used
    information = torch.linalg.inv(_with_floor(covariance_m2.double(), model))
    information = information * used[..., None, None]
    trace = information.diagonal(dim1=-2, dim2=-1).sum(-1)
    pose = fit_rigid(model, found, _balanced(trace))
    pose, H = _polished(pose, (model, found, information))
    error_m = pose.apply(model) - found
    count = used.sum(-1)
    misfit = (error_m[..., None, :] @ information @ error_m[..., None]).sum((-1, -2, -3))
    square = (error_m.square().sum(-1) * used).sum(-1) / count
    return PoseFit(
        camera_from_model=Rigid(pose.R.to(keypoints_m), pose.t_m.to(keypoints_m)),
        covariance=torch.linalg.inv(H).to(keypoints_m),
        residual_m=square.sqrt().to(keypoints_m),
        misfit=(misfit / (3 * count - 6).clamp(min=1)).to(keypoints_m),
        is_used=used,
    )


def free_motions(axes: tuple[Axis, ...], camera_from_model: Rigid) -> Float[Tensor, "m 6"]:
    """Give the motions of the camera frame that turn the object about its axes of revolution.

    Unit vectors of (rotation, translation): along them no observation says anything, the variance
    is infinite, and the pose is valid all the same. Two axes make a ball, which is free to turn
    about the third too.
    """
    rows = []
    for axis in _with_third(axes):
        direction = camera_from_model.R @ axis.direction.to(camera_from_model.R)
        point_m = camera_from_model.apply(axis.point_m.to(camera_from_model.R)[None])[0]
        # Turning by w about a line through c moves c nowhere: w x c + v = 0.
        motion = torch.cat([direction, torch.linalg.cross(point_m, direction)])
        rows.append(motion / motion.norm())
    return torch.stack(rows) if rows else camera_from_model.R.new_zeros(0, 6)


def _with_third(axes: tuple[Axis, ...]) -> tuple[Axis, ...]:
    """Give one axis, or three of a ball: turns about two make those about every axis."""
    centre_m = Symmetries(continuous=axes).ball_centre_m
    if centre_m is None:
        return axes[:1]
    return tuple(Axis(direction=row, point_m=centre_m) for row in torch.eye(3).to(centre_m))


def _polished(
    pose: Rigid, terms: tuple[Tensor, Tensor, Tensor]
) -> tuple[Rigid, Float64[Tensor, "*batch 6 6"]]:
    """Go to the most likely pose; give its information matrix too."""
    if serves(pose.R, *terms):
        from depthpose.pose.compiled.fit import fitted

        return fitted(pose, terms, _STEPS)
    for _ in range(_STEPS):
        H, step = _normal_equations(pose, terms)
        pose = perturb(pose, torch.linalg.solve(H, step))
    return pose, _normal_equations(pose, terms)[0]


def _normal_equations(
    pose: Rigid, terms: tuple[Tensor, Tensor, Tensor]
) -> tuple[Float64[Tensor, "*batch 6 6"], Float64[Tensor, "*batch 6"]]:
    model, found, information = terms
    moved_m = pose.apply(model)
    eye = torch.eye(3, dtype=moved_m.dtype, device=moved_m.device).expand(*moved_m.shape, 3)
    J = torch.cat([-cross_matrix(moved_m), eye], -1)
    weighted = J.mT @ information
    step = (weighted @ (found - moved_m)[..., None]).sum(-3).squeeze(-1)
    return (weighted @ J).sum(-3), step


def _with_floor(
    covariance_m2: Float64[Tensor, "*batch k 3 3"], model: Float64[Tensor, "*batch k 3"]
) -> Float64[Tensor, "*batch k 3 3"]:
    # No keypoint is known better than a millionth of the object, whatever its votes say.
    spread = (model - model.mean(-2, keepdim=True)).square().sum(-1).mean(-1)
    eye = torch.eye(3, dtype=model.dtype, device=model.device)
    return covariance_m2 + (1e-12 * spread)[..., None, None, None] * eye


def _balanced(trace: Float64[Tensor, "*batch k"]) -> Float64[Tensor, "*batch k"]:
    """Keep one keypoint that looks exact from deciding alone; a rotation takes three."""
    return trace.clamp(max=100 * trace.median(-1, keepdim=True).values.clamp(min=1e-300))


def distance_errors(
    keypoints_m: Float[Tensor, "*batch k 3"], model_keypoints_m: Float[Tensor, "k 3"]
) -> Float[Tensor, "*batch k k"]:
    """Found minus known distance of each pair of keypoints [m]: 28 pairs of 8, each twice."""
    return _distances(keypoints_m) - _distances(model_keypoints_m.to(keypoints_m))


def consistent_keypoints(
    keypoints_m: Float[Tensor, "*batch k 3"],
    model_keypoints_m: Float[Tensor, "k 3"],
    tolerance_m: float,
    is_found: Bool[Tensor, "*batch k"] | None = None,
) -> Bool[Tensor, "*batch k"]:
    """Outvote keypoints until no pair of those that stay breaks its distance.

    In each round the keypoint in most broken pairs goes; of equals the one with the larger sum of
    errors. Two keypoints that are wrong together by a common motion cannot be distinguished from
    right ones by this test, except where they are in the minority.

    Args:
        keypoints_m: found.
        model_keypoints_m: known, in any frame: distances alone count.
        tolerance_m: by how much a distance may differ.
        is_found: those to begin with; None: all.

    Returns:
        Those that stay; three or more of them fix a pose.
    """
    errors_m = distance_errors(keypoints_m, model_keypoints_m).abs()
    count = keypoints_m.shape[-2]
    stays = torch.ones(keypoints_m.shape[:-1], dtype=torch.bool, device=keypoints_m.device)
    stays = stays if is_found is None else is_found.clone()
    # Errors beyond the limit decide ties: capped, so that they never weigh as much as a pair.
    severity = (errors_m / tolerance_m).clamp(max=100.0) / (200.0 * count)
    for _ in range(count):
        pairs = stays[..., :, None] & stays[..., None, :]
        broken = pairs & (errors_m > tolerance_m)
        blame = (broken * (1 + severity)).sum(-1)
        worst = torch.nn.functional.one_hot(blame.argmax(-1), count).bool()
        stays = stays & ~(worst & broken.any((-1, -2))[..., None])
    return stays


def _distances(points_m: Float[Tensor, "*batch k 3"]) -> Float[Tensor, "*batch k k"]:
    return (points_m[..., :, None, :] - points_m[..., None, :, :]).norm(dim=-1)
