"""Poses at which a model may be in a whole depth image: votes, clusters, ICP, and the image."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d, normalize, pad

from depthpose.core.camera import project
from depthpose.core.rigid import Rigid, perturb, rotation_by
from depthpose.pose.frame import Frame
from depthpose.pose.mesh.models import fibonacci_directions
from depthpose.pose.surface import NEAR, Surface
from depthpose.pose.voting.point_pairs import STEP, PairTable, vote_poses

_NOISE_PER_M = 0.0015
"""Standard deviation of a depth sensor's readings, for the square of the depth in metres (Nguyen et
al. 2012): beyond where it is as large as what counts as near, no shape is seen."""
_REFERENCES, _FEWEST, _ALL_REFERENCES = 2000, 200, 6000
"""Points of the scene that vote with each of the others: at most, at least, and for all objects."""
_EVERY = 8
"""One point of so many votes: of a small object in a large scene enough must."""
_LEAST_POINTS = 30
_MOST_POINTS = 20_000
_PEAKS = 3
_VIEWS = 128
_CELL = 1 / 24
"""Side of a cell of a model's picture, in diameters."""
_POINTS, _RING = 160, 64
"""Cells of a picture at most, and those beside its silhouette."""
_TOGETHER, _TOGETHER_RAD = 0.1, math.radians(25)
"""Poses are one up to this distance of their middles, in diameters, and this angle."""
_TURNED = 0.7
"""Cosine of the angle between the normals of the image and of the posed surface, at least."""
_HELD = 0.02
"""Damping of ICP: a motion that moves the readings across the surface by less is hardly taken."""
_ASIDE, _ASIDE_RAD = 0.2, math.radians(30)
"""A pose is compared with those moved across the view by so much of the diameter, and turned by
so much: where a wall or noise agrees with it, it agrees as well with these."""
_BESIDE = 0.08
"""Of the diameter: where what is beside a silhouette is no farther than so much from its border in
depth, the same surface goes on."""


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


@dataclass(frozen=True, kw_only=True, eq=False)
class Views:
    """What a camera far off sees of a model, from many sides, in the model's frame.

    Attributes:
        toward: unit vectors to the camera.
        points_m: what is seen, spread evenly over the picture; NaN where there are fewer.
        normals: theirs.
        beside_m: places beside the silhouette, as far off as its border; NaN where there are fewer.
    """

    toward: Float64[Tensor, "v 3"]
    points_m: Float64[Tensor, "v n 3"]
    normals: Float64[Tensor, "v n 3"]
    beside_m: Float64[Tensor, "v m 3"]


def prepare_views(surface: Surface) -> Views:
    """Look at a model from many sides, once for many images."""
    toward = fibonacci_directions(_VIEWS).double()
    _, _, axes = torch.linalg.svd(toward[:, None])
    cell_m, middle_m = _CELL * surface.diameter_m, _middle_m(surface)
    side = 2 * round(0.5 / _CELL) + 10
    views = [_view_of(surface, way, across[1:], middle_m, cell_m, side)
             for way, across in zip(toward, axes, strict=True)]  # fmt: skip
    points_m, normals, beside_m = (torch.stack(parts) for parts in zip(*views, strict=True))
    return Views(toward=toward, points_m=points_m, normals=normals, beside_m=beside_m)


def _view_of(
    surface: Surface, toward: Tensor, across: Tensor, middle_m: Tensor, cell_m: float, side: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Gather a surface in cells of a picture; give the nearest points, and places beside them."""
    about_m = surface.points_m - middle_m
    column, row = (about_m @ across.T / cell_m).floor().long().add(side // 2).unbind(-1)
    place, near_m = row * side + column, about_m @ toward
    most_m = near_m.new_full((side**2,), -torch.inf).scatter_reduce_(0, place, near_m, "amax")
    first = torch.full((side**2,), len(place))
    first[place[near_m == most_m[place]]] = torch.arange(len(place))[near_m == most_m[place]]
    # Between sparse points the far side shows: it is none that a camera would see.
    picture_m = most_m.reshape(1, side, side)
    is_seen = most_m > max_pool2d(picture_m, 3, 1, 1).flatten() - _BESIDE * surface.diameter_m
    is_seen &= most_m.isfinite()
    shown = _spread(first[is_seen], _POINTS)
    filled = is_seen.double().reshape(1, side, side)
    wide, narrow = (max_pool2d(filled, size, 1, size // 2) for size in (5, 3))
    shown_m = torch.where(filled > 0, picture_m, 0.0)
    border_m = avg_pool2d(shown_m, 5, 1, 2) / avg_pool2d(filled, 5, 1, 2)
    ring = _spread(((wide > 0) & (narrow == 0)).flatten().nonzero()[:, 0], _RING)
    at = torch.stack([ring % side, ring.div(side, rounding_mode="floor")], -1).double()
    at += 0.5 - side // 2
    beside_m = at * cell_m @ across + border_m.flatten()[ring, None] * toward + middle_m
    parts = (surface.points_m[shown], surface.normals[shown], beside_m)
    points_m, normals, beside_m = (
        pad(part, (0, 0, 0, most - len(part)), value=torch.nan)
        for part, most in zip(parts, (_POINTS, _POINTS, _RING), strict=True)
    )
    return points_m, normals, beside_m


def _spread(index: Int64[Tensor, " n"], most: int) -> Int64[Tensor, " m"]:
    """Take so many at most, in an order of chance: the first ones are a sample of all."""
    chance = torch.randperm(len(index), generator=torch.Generator().manual_seed(0))
    return index[chance[:most]]


def propose_in_frame(
    frame: Frame, surface: Surface, table: PairTable, views: Views, of: int = 1
) -> tuple[Rigid, "Agreement"]:
    """Let point pairs of the whole image vote; refine and keep what the image agrees with best.

    Args:
        frame: the image.
        surface: of the model.
        table: its point pairs.
        views: what a camera sees of it.
        of: so many models are searched in the image.

    Returns:
        Poses, roughly refined, the best first, and how the image agrees with each.
    """
    points_m, normals = _scene_points(frame, surface)
    generator = torch.Generator().manual_seed(0)
    order = torch.randperm(len(points_m), generator=generator)[:_MOST_POINTS]
    most = max(600, len(order) // _EVERY)
    most = max(_FEWEST, min(most, _REFERENCES, _ALL_REFERENCES // of))
    references = torch.arange(min(most, len(order)) if len(order) >= _LEAST_POINTS else 0)
    poses, _ = vote_poses(points_m[order], normals[order], references, table, _PEAKS)
    for stage in _STAGES[:-1]:
        poses = _projected(frame, poses, surface, views, stage)
        worth = compare_with_image(frame, poses, surface, views, stage).worth
        poses = poses[_distinct(poses, worth, surface, stage.kept)]
    poses = _projected(frame, poses, surface, views, _STAGES[-1])
    seen = compare_with_image(frame, poses, surface, views)
    best = _distinct(poses, seen.worth, surface, _STAGES[-1].kept)
    return poses[best], Agreement(*(values[best] for values in seen))


def is_no_side(frame: Frame, surface: Surface) -> Bool[Tensor, "h w"]:
    """Mark the pixels of planes that are too wide to be a side of the object."""
    return frame.plane_m >= surface.diameter_m


def _scene_points(
    frame: Frame, surface: Surface
) -> tuple[Float64[Tensor, "n 3"], Float64[Tensor, "n 3"]]:
    """Average points and normals in cells, without planes and what is too far to have a shape."""
    used = frame.is_smooth & ~is_no_side(frame, surface)
    used &= _NOISE_PER_M * frame.depth_m.square() < NEAR * surface.diameter_m
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
    is_one = sums[:, 3:].norm(dim=-1) > _TURNED
    return sums[is_one, :3], normalize(sums[is_one, 3:], dim=-1)


def _distinct(
    poses: Rigid, worth: Float64[Tensor, " b"], surface: Surface, most: int
) -> Int64[Tensor, " c"]:
    """Choose the best poses, none nearly as one before it."""
    order = worth.argsort(descending=True, stable=True)[: 5 * most]
    middles_m, turns = poses[order].apply(_middle_m(surface)[None])[:, 0], poses.R[order].flatten(1)
    near = torch.cdist(middles_m, middles_m) < _TOGETHER * surface.diameter_m
    near &= turns @ turns.T > 1 + 2 * math.cos(_TOGETHER_RAD)
    is_left, chosen = torch.ones(len(order), dtype=torch.bool), list[int]()
    for k in range(len(order)):
        if is_left[k] and len(chosen) < most:
            chosen.append(k)
            is_left &= ~near[k]
    return order[chosen]


def _middle_m(surface: Surface) -> Float64[Tensor, "3"]:
    return (surface.points_m.amin(0) + surface.points_m.amax(0)) / 2


def _projected(frame: Frame, poses: Rigid, surface: Surface, views: Views, stage: _Stage) -> Rigid:
    """Bring what a camera sees of each posed surface onto what it saw, pixel by pixel.

    Point to plane, each point with the reading in its own direction (Blais and Levine 1995): the
    inner side of a thin wall draws no reading of the outer one.
    """
    usable = frame.is_smooth & ~is_no_side(frame, surface)
    radius_m = surface.diameter_m / 2
    held = _HELD * torch.diag(torch.tensor([radius_m**2] * 3 + [1.0] * 3, dtype=torch.float64))
    for share in stage.limits:
        posed_m, normals, _ = _posed(poses, surface, views, stage.every)
        at = _look_up(frame, posed_m)
        normal = frame.normals.flatten(0, 1)[at.pixel]
        seen_m = frame.points_m.flatten(0, 1)[at.pixel]
        gap_m, limit_m = seen_m - posed_m, share * surface.diameter_m
        used = at.is_read & usable.flatten()[at.pixel] & ((normal * normals).sum(-1).abs() > 0.5)
        weight = (1 - gap_m.square().sum(-1) / limit_m**2).clamp(min=0).square()
        weight, middle_m = torch.where(used, weight, 0.0), poses.apply(_middle_m(surface)[None])
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


class Agreement(NamedTuple):
    """How well an image agrees with each of several poses.

    Attributes:
        worth: share of the surface that was seen where it should be, less what contradicts: 1 at
            most.
        goes_on: share of what is beside the silhouette in which the same surface goes on.
        parted: share of it in which the camera saw a table or wall, or far behind.
        against: share of the surface through which the camera saw, or a table before it.
    """

    worth: Float64[Tensor, " b"]
    goes_on: Float64[Tensor, " b"]
    parted: Float64[Tensor, " b"]
    against: Float64[Tensor, " b"]

    @property
    def rough_doubt(self) -> Float64[Tensor, " b"]:
        """What this says against each pose, of those that are not refined yet."""
        return 2.9 * self.against + 20.0 * self.goes_on + 3.2 * (1 - self.parted)


def compare_with_image(
    frame: Frame, poses: Rigid, surface: Surface, views: Views, stage: _Stage = _STAGES[-1]
) -> Agreement:
    """Compare posed surfaces with what the camera saw in their direction, and beside it.

    What was seen at a point's depth and turned alike agrees. What was seen behind it, a table
    before it, and a surface that goes on beyond its silhouette contradict it.
    """
    posed_m, normals, beside_m = _posed(poses, surface, views, stage.every)
    at, no_side = _look_up(frame, posed_m), is_no_side(frame, surface).flatten()
    limit_m = stage.fits * surface.diameter_m + 2 * _NOISE_PER_M * posed_m[..., 2].square()
    gap_m, is_side = at.depth_m - posed_m[..., 2], ~no_side[at.pixel]
    cosine = (normals * frame.normals.flatten(0, 1)[at.pixel]).sum(-1).abs()
    fits = at.is_read & (gap_m.abs() < limit_m)
    agrees = fits & is_side & ((cosine > _TURNED) | ~frame.is_smooth.flatten()[at.pixel])
    before = at.is_read & (gap_m < -limit_m)
    # A sensor cuts rims and edges: the camera saw through where it saw nothing near beside either.
    least_m = torch.where(frame.depth_m > 0, frame.depth_m, torch.inf)
    least_m = -max_pool2d(-least_m[None], 3, 1, 1).flatten()
    through = at.is_read & (least_m[at.pixel] > posed_m[..., 2] + limit_m)
    against = through | (before & ~is_side)
    partly = (fits & ~agrees).double() + 0.4 * (before & is_side).double()
    number = posed_m[..., 2].isfinite().sum(1).clamp(min=1)
    read = at.is_read.sum(1).maximum(number / 2).double()
    good = agrees.sum(1) - against.sum(1) - 0.5 * partly.sum(1)
    at = _look_up(frame, beside_m)
    gap_m, limit_m = at.depth_m - beside_m[..., 2], _BESIDE * surface.diameter_m
    is_level, is_table = at.is_read & (gap_m.abs() < limit_m), no_side[at.pixel]
    is_parted = (at.is_read & (gap_m >= limit_m)) | (is_level & is_table)
    beside = beside_m[..., 2].isfinite().sum(1).clamp(min=1).double()
    goes_on = (is_level & ~is_table).sum(1) / beside
    return Agreement(
        worth=good / read - 0.6 * goes_on,
        goes_on=goes_on,
        parted=is_parted.sum(1) / beside,
        against=against.sum(1) / read,
    )


def doubts_of(frame: Frame, poses: Rigid, surface: Surface, views: Views) -> Float64[Tensor, " b"]:
    """Give the log odds of poses' being wrong, by the image alone.

    What counts is by how much better the image agrees with a pose than with those beside it, what
    contradicts it, and whether its silhouette is one: logistic regression on synthetic frames.

    Args:
        frame: the image.
        poses: of the model, refined.
        surface: of the model.
        views: what a camera sees of it.
    """
    seen, middle_m = compare_with_image(frame, poses, surface, views), _middle_m(surface)
    ways = torch.cat([torch.eye(3, dtype=torch.float64), -torch.eye(3, dtype=torch.float64)])
    across_m = ways[[0, 1, 3, 4]] * _ASIDE * surface.diameter_m
    R = poses.R[:, None] @ rotation_by(_ASIDE_RAD * ways)
    turned = Rigid(R, poses.apply(middle_m[None]) - R @ middle_m)
    shifted = Rigid(poses.R[:, None].expand(-1, 4, 3, 3), poses.t_m[:, None] + across_m)
    beside = Rigid(torch.cat([shifted.R, turned.R], 1).flatten(0, 1),
                   torch.cat([shifted.t_m, turned.t_m], 1).flatten(0, 1))  # fmt: skip
    worth = compare_with_image(frame, beside, surface, views).worth.reshape(-1, len(ways) + 4)
    alike = 4.15 * worth[:, :4].amax(1) + 6.44 * worth[:, 4:].mean(1) - 10.59 * seen.worth
    return alike + 4.97 * seen.goes_on - 6.66 * seen.parted + 4.91 * seen.against + 12.34


def _posed(
    poses: Rigid, surface: Surface, views: Views, every: int
) -> tuple[Float64[Tensor, "b n 3"], Float64[Tensor, "b n 3"], Float64[Tensor, "b m 3"]]:
    """Pose what a camera sees from the nearest of the sides that the model was looked at from."""
    middle_m = _middle_m(surface)
    way_m = -(poses.t_m[:, None] @ poses.R)[:, 0] - middle_m
    side = (way_m @ views.toward.T).argmax(-1)
    points_m, beside_m = (poses.apply(part[side, ::every])
                          for part in (views.points_m, views.beside_m))  # fmt: skip
    return points_m, views.normals[side, ::every] @ poses.R.mT, beside_m


class _Looked(NamedTuple):
    """The pixels in which points lie, their depth, and whether there is any."""

    pixel: Int64[Tensor, "b n"]
    depth_m: Float64[Tensor, "b n"]
    is_read: Bool[Tensor, "b n"]


def _look_up(frame: Frame, points_m: Float64[Tensor, "b n 3"]) -> _Looked:
    height, width = frame.depth_m.shape
    pixel = project(points_m, frame.K).round()
    column, row = pixel.unbind(-1)
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height) & (points_m[..., 2] > 0)
    place = torch.where(inside, row * width + column, 0).long()
    depth_m = frame.depth_m.flatten()[place]
    return _Looked(place, depth_m, inside & (depth_m > 0))
