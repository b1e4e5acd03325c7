"""Poses at which a model may be in a whole depth image: votes, clusters, ICP, and the image."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor
from torch.nn.functional import normalize

from depthpose.core.rigid import Rigid, perturb
from depthpose.pose.frame import Frame, readings_toward
from depthpose.pose.propose.point_pairs import STEP, PairTable, vote_poses
from depthpose.pose.sensor import NOISE_PER_M2
from depthpose.pose.surface import BESIDE, NEAR, Surface

_REFERENCES, _FEWEST, _ALL_REFERENCES = 2000, 200, 6000
"""Points of the scene that vote with each of the others: at most, at least, and for all objects."""
_EVERY = 8
"""One point of so many votes: of a small object in a large scene enough must."""
_LEAST_POINTS = 30
_MOST_POINTS = 20_000
_PEAKS = 3
_LEAST_AGREEMENT = 0.25
"""Poses with which the image agrees less are none."""
_TOGETHER, _TOGETHER_RAD = 0.1, math.radians(25)
"""Poses are one up to this distance of their middles, in diameters, and this angle."""
_MIN_COSINE = 0.7
"""Cosine of the angle between the normals of the image and of the posed surface, at least."""
_HELD = 0.02
"""Damping of ICP: a motion that moves the readings across the surface by less is hardly taken."""


Points = Float64[Tensor, "b n 3"]


class _Stage(NamedTuple):
    """How closely poses are compared with an image.

    Attributes:
        every: one point of so many of what is seen is compared.
        fits: of the diameter, beside the sensor's noise: a reading so near to the surface is of it.
        limits: of the diameter: up to so far a reading counts in each step of ICP.
        kept: poses that go on.
    """

    every: int
    fits: float
    limits: tuple[float, ...]
    kept: int


_STAGES = (
    _Stage(4, 0.1, (), 200),
    _Stage(2, 0.06, (0.15, 0.12, 0.1, 0.08), 60),
    _Stage(1, NEAR, (0.08, 0.06, 0.05, 0.05, 0.05, 0.05), 60),
)


def propose_in_frame(
    frame: Frame, is_left: Bool[Tensor, "h w"], table: PairTable, models: int = 1
) -> tuple[Rigid, Float64[Tensor, " b"]]:
    """Let point pairs of the whole image vote; refine and keep what the image agrees with best.

    Args:
        frame: the image.
        is_left: pixels that may vote: in the mask, and not explained by an object found before.
        table: point pairs of the model.
        models: so many are searched in the image.

    Returns:
        Poses, roughly refined, the best first, and how well the image agrees with each, at most 1
        (``ImageEvidence.agreement``).
    """
    surface = table.surface
    points_m, normals = _scene_points(frame, is_left, surface)
    generator = torch.Generator().manual_seed(0)
    order = torch.randperm(len(points_m), generator=generator)[:_MOST_POINTS]
    most = max(600, len(order) // _EVERY)
    most = max(_FEWEST, min(most, _REFERENCES, _ALL_REFERENCES // models))
    references = torch.arange(min(most, len(order)) if len(order) >= _LEAST_POINTS else 0)
    poses, _ = vote_poses(points_m[order], normals[order], references, table, _PEAKS)
    for stage in _STAGES[:-1]:
        poses = _projected(frame, poses, surface, stage)
        agreement = compare_with_image(frame, poses, surface, stage).agreement
        poses = poses[_distinct(poses, agreement, surface, stage.kept)]
    poses = _projected(frame, poses, surface, _STAGES[-1])
    agreement = compare_with_image(frame, poses, surface).agreement
    best = _distinct(poses, agreement, surface, _STAGES[-1].kept)
    best = best[agreement[best] >= _LEAST_AGREEMENT]
    return poses[best], agreement[best]


def _scene_points(
    frame: Frame, is_left: Bool[Tensor, "h w"], surface: Surface
) -> tuple[Float64[Tensor, "n 3"], Float64[Tensor, "n 3"]]:
    """Average points and normals in cells, without planes and what is too far to have a shape."""
    used = frame.is_smooth & is_left & (frame.background_limit_m < surface.diameter_m)
    # Beyond where the noise is as large as what counts as near, no shape is seen.
    used &= NOISE_PER_M2 * frame.depth_m.square() < NEAR * surface.diameter_m
    points_m, normals = frame.points_m[used], frame.normals[used]
    if len(points_m) == 0:
        return points_m, normals
    cell = (points_m / (STEP * surface.diameter_m)).floor().long()
    cell -= cell.amin(0)
    size = cell.amax(0) + 1
    key = (cell[:, 0] * size[1] + cell[:, 1]) * size[2] + cell[:, 2]
    _, place, count = key.unique(return_inverse=True, return_counts=True)
    sums = points_m.new_zeros(len(count), 6)
    sums = sums.index_add_(0, place, torch.cat([points_m, normals], 1)) / count[:, None]
    is_one = sums[:, 3:].norm(dim=-1) > _MIN_COSINE
    return sums[is_one, :3], normalize(sums[is_one, 3:], dim=-1)


def _distinct(
    poses: Rigid, agreement: Float64[Tensor, " b"], surface: Surface, most: int
) -> Int64[Tensor, " c"]:
    """Choose the best poses, none nearly as one before it."""
    order = agreement.argsort(descending=True, stable=True)[: 5 * most]
    middles_m, turns = poses[order].apply(surface.middle_m[None])[:, 0], poses.R[order].flatten(1)
    near = torch.cdist(middles_m, middles_m) < _TOGETHER * surface.diameter_m
    near &= turns @ turns.T > 1 + 2 * math.cos(_TOGETHER_RAD)
    is_left, chosen = torch.ones(len(order), dtype=torch.bool), list[int]()
    for k in range(len(order)):
        if is_left[k] and len(chosen) < most:
            chosen.append(k)
            is_left &= ~near[k]
    return order[chosen]


def _projected(frame: Frame, poses: Rigid, surface: Surface, stage: _Stage) -> Rigid:
    """Bring what a camera sees of each posed surface onto what it saw, pixel by pixel.

    Point to plane, each point with the reading in its own direction (Blais and Levine 1995): the
    inner side of a thin wall draws no reading of the outer one.
    """
    usable = frame.is_smooth & (frame.background_limit_m < surface.diameter_m)
    radius_m = surface.diameter_m / 2
    held = _HELD * torch.diag(torch.tensor([radius_m**2] * 3 + [1.0] * 3, dtype=torch.float64))
    for share in stage.limits:
        posed_m, normals, _, _ = _posed(poses, surface, stage.every)
        at = readings_toward(frame, posed_m)
        normal = frame.normals.flatten(0, 1)[at.pixel]
        seen_m = frame.points_m.flatten(0, 1)[at.pixel]
        gap_m, limit_m = seen_m - posed_m, share * surface.diameter_m
        used = at.is_read & usable.flatten()[at.pixel] & ((normal * normals).sum(-1).abs() > 0.5)
        weight = (1 - gap_m.square().sum(-1) / limit_m**2).clamp(min=0).square()
        weight, middle_m = torch.where(used, weight, 0.0), poses.apply(surface.middle_m[None])
        J = torch.cat([torch.linalg.cross(posed_m - middle_m, normal), normal], -1)
        J = torch.where(used[..., None], J, 0.0)
        weighted = J.mT * weight[:, None]
        # Few readings hold little: what they do not hold stays where it was voted for.
        H = weighted @ J + weight.sum(-1)[:, None, None].clamp(min=1.0) * held
        distance_m = torch.where(used, (gap_m * normal).sum(-1), 0.0)
        motion = torch.linalg.solve(H, weighted @ distance_m[..., None])[..., 0]
        turned = perturb(Rigid(poses.R, poses.t_m - middle_m[:, 0]), motion)
        poses = Rigid(turned.R, turned.t_m + middle_m[:, 0])
    return poses


class ImageEvidence(NamedTuple):
    """How well an image agrees with each of several poses.

    Attributes:
        agreement: share of the surface that was seen where it should be, less what contradicts it.
        continued: share of what is beside the silhouette in which the same surface goes on.
        contradicted: share of the surface through which the camera saw, or a table before it.
    """

    agreement: Float64[Tensor, " b"]
    continued: Float64[Tensor, " b"]
    contradicted: Float64[Tensor, " b"]


def compare_with_image(
    frame: Frame, poses: Rigid, surface: Surface, stage: _Stage = _STAGES[-1]
) -> ImageEvidence:
    """Compare posed surfaces with what the camera saw in their direction, and beside it.

    What was seen at a point's depth and turned alike agrees. What was seen behind it, a table
    before it, and a surface that goes on beyond its silhouette contradict it.
    """
    posed_m, normals, is_inner, beside_m = _posed(poses, surface, stage.every)
    # A plane that is wider than the object is no side of it.
    at = readings_toward(frame, posed_m)
    no_side = (frame.background_limit_m >= surface.diameter_m).flatten()
    limit_m = stage.fits * surface.diameter_m + 2 * NOISE_PER_M2 * posed_m[..., 2].square()
    gap_m, is_side = at.depth_m - posed_m[..., 2], ~no_side[at.pixel]
    cosine = (normals * frame.normals.flatten(0, 1)[at.pixel]).sum(-1).abs()
    fits = at.is_read & (gap_m.abs() < limit_m)
    agrees = fits & is_side & ((cosine > _MIN_COSINE) | ~frame.is_smooth.flatten()[at.pixel])
    before = at.is_read & (gap_m < -limit_m)
    # A sensor cuts rims and edges: the camera saw through where it saw nothing near beside either,
    # and where the surface goes on around; what it cut off counts as not read.
    through = at.is_read & (frame.nearest_m.flatten()[at.pixel] > posed_m[..., 2] + limit_m)
    is_cut, through = through & ~is_inner, through & is_inner
    contradicted = through | (before & ~is_side)
    partly = (fits & ~agrees).double() + 0.4 * (before & is_side).double()
    number = posed_m[..., 2].isfinite().sum(1).clamp(min=1)
    read = (at.is_read & ~is_cut).sum(1).maximum(number / 2).double()
    good = agrees.sum(1) - contradicted.sum(1) - 0.5 * partly.sum(1)
    at = readings_toward(frame, beside_m)
    gap_m, limit_m = at.depth_m - beside_m[..., 2], BESIDE * surface.diameter_m
    is_level, is_table = at.is_read & (gap_m.abs() < limit_m), no_side[at.pixel]
    beside = beside_m[..., 2].isfinite().sum(1).clamp(min=1).double()
    continued = (is_level & ~is_table).sum(1) / beside
    return ImageEvidence(
        agreement=good / read - 0.6 * continued,
        continued=continued,
        contradicted=contradicted.sum(1) / read,
    )


def _posed(
    poses: Rigid, surface: Surface, every: int
) -> tuple[Points, Points, Bool[Tensor, "b n"], Float64[Tensor, "b m 3"]]:
    """Pose what a camera sees from the nearest of the sides that the model was looked at from."""
    middle_m = surface.middle_m
    way_m = -(poses.t_m[:, None] @ poses.R)[:, 0] - middle_m
    views = surface.views
    side = (way_m @ views.toward.T).argmax(-1)
    points_m, beside_m = (poses.apply(part[side, ::every])
                          for part in (views.points_m, views.beside_m))  # fmt: skip
    normals = views.normals[side, ::every] @ poses.R.mT
    return points_m, normals, views.is_inner[side, ::every], beside_m
