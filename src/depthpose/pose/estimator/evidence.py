"""What speaks for and against a pose: signals that need no truth, each larger where it is worse."""

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from depthpose.core.arrays import take_evenly
from depthpose.core.rigid import Rigid, cross_matrix
from depthpose.pose.refine import Surface
from depthpose.pose.types import PoseFit, Vote

NEAR = 0.05
"""Of the diameter: a point of the cloud within this distance lies on the posed surface."""
_CELL = 1 / 24
"""Side of a ray's cell at the object, in diameters: several samples of the surface in each."""
_JUDGED = 1000
"""At most so many points of the cloud are judged, evenly taken."""

SIGNALS: dict[str, str] = {
    "disagree": "{:.0%} of the directions miss the keypoint that they are for",
    "lost": "{:.0%} of the keypoints break the model's distances and were outvoted",
    "misfit": "the keypoints fit the model badly for how sure they are (log misfit {:.2g})",
    "bend": "the keypoints miss the model's by {:.1%} of the diameter",
    "moved": "ICP moved the voted pose by {:.1%} of the diameter",
    "gap": "the points lie {:.1%} of the diameter off the posed surface",
    "far": "{:.0%} of the points are nowhere near the posed surface",
    "front": "the posed surface would hide {:.0%} of the points that were seen",
    "unseen": "{:.0%} of the posed surface that faces the camera has no point",
}
"""Name of each signal, and what it says to people."""


def vote_signals(vote: Vote, fit: PoseFit, diameter_m: float) -> dict[str, float]:
    """Say how well the directions meet, and how well the keypoints fit the model."""
    used = fit.is_used
    return {
        "disagree": 1 - float(vote.inlier_share[used].mean()),
        "lost": 1 - float(used.float().mean()),
        "misfit": float(fit.misfit.log1p()),
        "bend": float(fit.residual_m) / diameter_m,
    }


def surface_signals(
    cloud_m: Float[Tensor, "n 3"], pose: Rigid, surface: Surface
) -> dict[str, float]:
    """Say how well the posed surface explains the cloud, and the cloud the surface.

    Rays are those of a camera at the origin: a cell of them is as wide, where the object is, as
    1/24 of its diameter. A point seen through the posed surface contradicts the pose; surface
    that nobody saw may merely be hidden by something else.
    """
    limit_m = NEAR * surface.diameter_m
    distance_m = _distances(take_evenly(cloud_m.double(), _JUDGED), pose, surface)
    near_m = distance_m[distance_m < limit_m]
    gap_m = float(near_m.square().mean().sqrt()) if len(near_m) else limit_m
    front, unseen = _look_along_rays(cloud_m.double(), pose, surface)
    far = 1 - len(near_m) / len(distance_m)
    return {"gap": gap_m / surface.diameter_m, "far": far, "front": front, "unseen": unseen}


def hold_of(
    cloud_m: Float[Tensor, "n 3"], pose: Rigid, surface: Surface, free: Float[Tensor, "m 6"]
) -> tuple[float, Float64[Tensor, "6"]]:
    """Say how firmly the seen surface holds the object: 0 where it may slide along itself.

    A motion ``y = (d/2 w, v)`` about the middle of the cloud moves a surface point at ``a`` with
    normal ``n`` across itself by ``n . v + (a x n) . w``. The hold is the root mean square of that
    over the points near the surface, for the unit motion that moves it least (Gelfand et al.,
    Geometrically Stable Sampling for the ICP Algorithm, 2003).

    Args:
        cloud_m: of the object, in the camera frame.
        pose: of the object.
        surface: of its model.
        free: declared symmetries, as :func:`~depthpose.pose.voting.free_motions` gives them; they
            are left out.

    Returns:
        The hold, and the weakest motion: (rotation, translation at the middle of the cloud), unit
        length after scaling.
    """
    points = take_evenly(cloud_m.double(), _JUDGED)
    local = pose.inverse().apply(points)
    distance_m, index = surface.tree.query(local.numpy(), workers=1)
    near = torch.from_numpy(distance_m < NEAR * surface.diameter_m)
    weakest = torch.zeros(6, dtype=torch.float64)
    if int(near.sum()) < 6:
        return 0.0, weakest
    normal = (surface.normals[torch.from_numpy(index)] @ pose.R.mT)[near]
    middle, radius_m = points.mean(0), surface.diameter_m / 2
    arm = points[near] - middle
    J = torch.cat([torch.linalg.cross(arm, normal) / radius_m, normal], -1)
    basis = _complement(_scaled(free.double(), middle, radius_m))
    values, vectors = torch.linalg.eigh(basis.T @ (J.T @ J / len(J)) @ basis)
    return float(values[0].clamp(min=0).sqrt()), basis @ vectors[:, 0]


def without_motions(
    covariance: Float[Tensor, "6 6"], free: Float[Tensor, "m 6"]
) -> Float[Tensor, "6 6"]:
    """Give the covariance where the pose does not move along ``free``: finite, and 0 along them."""
    if len(free) == 0:
        return covariance
    basis = _complement(free.double())
    # Rotations and metres differ in size; the information of the rest is what counts.
    information = torch.linalg.inv(covariance.double())
    inner = torch.linalg.inv(basis.T @ information @ basis)
    return (basis @ inner @ basis.T).to(covariance)


def _look_along_rays(
    cloud_m: Float64[Tensor, "n 3"], pose: Rigid, surface: Surface
) -> tuple[float, float]:
    posed_m = pose.apply(surface.points_m)
    posed_m = posed_m[posed_m[:, 2] > 0]
    if len(posed_m) == 0:
        return 1.0, 1.0
    scale = float(cloud_m[:, 2].median()) / (_CELL * surface.diameter_m)
    rays = torch.cat([posed_m[:, :2] / posed_m[:, 2:], cloud_m[:, :2] / cloud_m[:, 2:]])
    cells = torch.floor(rays * scale).long()
    _, cell = torch.unique(cells, dim=0, return_inverse=True)
    mine, theirs = cell[: len(posed_m)], cell[len(posed_m) :]
    nearest_m = torch.full((int(cell.max()) + 1,), torch.inf, dtype=torch.float64)
    nearest_m.scatter_reduce_(0, mine, posed_m[:, 2], "amin")
    hidden = nearest_m[theirs] < cloud_m[:, 2] - 1.5 * NEAR * surface.diameter_m
    is_seen = torch.zeros(len(nearest_m), dtype=torch.bool)
    is_seen[theirs] = True
    unseen = ~is_seen[nearest_m.isfinite()]
    return float(hidden.double().mean()), float(unseen.double().mean())


def _distances(
    points: Float64[Tensor, "n 3"], pose: Rigid, surface: Surface
) -> Float64[Tensor, " n"]:
    distance_m, _ = surface.tree.query(pose.inverse().apply(points).numpy(), workers=1)
    return torch.from_numpy(distance_m)


def _scaled(
    motions: Float64[Tensor, "m 6"], middle: Float64[Tensor, "3"], radius_m: float
) -> Float64[Tensor, "m 6"]:
    """Write motions about the origin as motions about ``middle``, turns in metres at the radius."""
    turn, shift = motions[:, :3], motions[:, 3:]
    return torch.cat([turn * radius_m, shift + turn @ cross_matrix(middle)], -1)


def _complement(motions: Float64[Tensor, "m 6"]) -> Float64[Tensor, "6 r"]:
    """Give an orthonormal basis of what is orthogonal to all of the motions."""
    if len(motions) == 0:
        return torch.eye(6, dtype=torch.float64)
    _, values, rows = torch.linalg.svd(motions)
    rank = int((values > 1e-9 * values[0]).sum())
    return rows[rank:].T
