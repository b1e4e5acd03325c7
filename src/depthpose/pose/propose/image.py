"""Proposals of a model's poses in a whole depth image: voting, refinement, and a score."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor
from torch.nn.functional import normalize

from depthpose.core.rigid import Rigid, perturb
from depthpose.pose.frame import Frame, readings_toward
from depthpose.pose.geometry.surface import NEAR, Surface
from depthpose.pose.icp import tukey_weight
from depthpose.pose.propose.point_pairs import STEP, PairTable, vote_poses
from depthpose.pose.sensor import SHARED_PER_WHITE

# Votes.
_REFERENCE_EVERY = 8
"""One in this many points of the scene is a reference, which votes with each of the others:
enough must lie on a small object in a large scene."""
_WANTED_REFERENCES = 600
"""References that are wanted, if there are as many points, before the limits below."""
_MOST_REFERENCES = 2000
_MOST_REFERENCES_OF_ALL = 6000
"""References at most for one object, and for all objects of a search together, but for the least
number of each."""
_FEWEST_REFERENCES = 200
"""References for each object at least, however many are searched."""
_LEAST_POINTS = 30
"""Fewest points of a scene: with fewer nothing is proposed."""
_MOST_POINTS = 20_000
_ORDER_SEED = 0
"""Seed of the order of a scene's points, so that an image always has the same proposals."""
_PEAKS = 3
"""Poses that each reference point proposes."""
_LEAST_SCORE = 0.25
"""Poses with a lower score are not proposed."""
_SAME_DIAMETERS = 0.1
_SAME_RAD = math.radians(25)
"""Distance of the middles, in diameters, and angle up to which two poses are the same."""
_PLACE_DIAMETERS = 0.25
"""Distance of the middles up to which two poses are at one place."""

# Normals and ICP.
_MIN_COSINE = 0.7
"""Cosine of the angle between the normals of the image and of the posed surface, at least."""
_MIN_MEAN_NORMAL = 0.7
"""Length of the mean of unit normals, at least, where a cell holds one surface."""
_MIN_COSINE_ICP = 0.5
"""The same in ICP, whose poses are rough."""
_DAMPING = 0.02
"""Damping of ICP, in weights of all readings: it suppresses motions that few readings constrain."""

# The score of a pose.
_DEVIATIONS = 2.0
"""Standard deviations of the error that neighbouring readings share, by which a reading may lie
farther off the surface than the stage's limit."""
_LEAST_READ = 0.5
"""A score is divided by the points that are read, at least by this share of the visible ones."""
_MORE_THAN_KEPT = 5
"""Times as many poses as are kept are searched for distinct ones."""


class _Stage(NamedTuple):
    """How closely poses are compared with an image.

    Attributes:
        every: n: every n-th visible point of the model is compared.
        near: distance up to which a reading lies on the surface, beside noise, in diameters.
        icp_limits: distance up to which a reading counts in each step of ICP, in diameters.
        most: poses that enter the next stage.
        most_at_place: of them at one place: a surface that fits anywhere, as that of a small part
            seen end on, else fills the list with poses on a few large things.
    """

    every: int
    near: float
    icp_limits: tuple[float, ...]
    most: int
    most_at_place: int


_STAGES = (
    _Stage(every=4, near=0.1, icp_limits=(), most=200, most_at_place=8),
    _Stage(every=2, near=0.06, icp_limits=(0.15, 0.12, 0.1, 0.08), most=60, most_at_place=4),
    _Stage(
        every=1,
        near=NEAR,
        icp_limits=(0.08, 0.06, 0.05, 0.05, 0.05, 0.05),
        most=60,
        most_at_place=4,
    ),
)


def propose_in_frame(
    frame: Frame, is_unclaimed: Bool[Tensor, "h w"], table: PairTable, model_count: int = 1
) -> tuple[Rigid, Float64[Tensor, " b"]]:
    """Propose poses of a model in an image: point pairs vote, the best are refined and scored.

    Args:
        frame: the image.
        is_unclaimed: pixels that may vote: in the mask, and explained by no object found before.
        table: point pairs of the model.
        model_count: number of models that are searched in the image, which share its time.

    Returns:
        Poses ``camera_from_model``, roughly refined, the best first, and the score of each
        (:func:`score_by_image`).
    """
    # A random sample of the scene's points votes, the first of them as reference points.
    surface = table.surface
    points_m, normals = _average_scene_points(frame, is_unclaimed, surface)
    generator = torch.Generator().manual_seed(_ORDER_SEED)
    sample = torch.randperm(len(points_m), generator=generator)[:_MOST_POINTS]
    references = torch.arange(_choose_number_of_references(len(sample), model_count))
    poses, score = vote_poses(points_m[sample], normals[sample], references, table, _PEAKS)

    # Fewer and fewer poses are refined and compared, more and more closely. The number of votes is
    # not compared: the first stage replaces it by a score.
    for stage in _STAGES:
        poses = refine_projectively(frame, poses, surface, stage)
        score = score_by_image(frame, poses, surface, stage)
        best = _choose_best(poses, score, surface, stage)
        poses = poses[best]
        score = score[best]
    is_good = score >= _LEAST_SCORE
    return poses[is_good], score[is_good]


def _choose_number_of_references(point_count: int, model_count: int) -> int:
    """Choose how many of a scene's points vote with each of the others, in a search of models."""
    if point_count < _LEAST_POINTS:
        return 0
    wanted = max(_WANTED_REFERENCES, point_count // _REFERENCE_EVERY)
    most = min(_MOST_REFERENCES, _MOST_REFERENCES_OF_ALL // model_count)
    return min(point_count, max(_FEWEST_REFERENCES, min(wanted, most)))


def _average_scene_points(
    frame: Frame, is_unclaimed: Bool[Tensor, "h w"], surface: Surface
) -> tuple[Float64[Tensor, "n 3"], Float64[Tensor, "n 3"]]:
    """Average the points that may be of an object in cells, and their normals.

    Left out are the frame's background, and readings too far away to show a shape.

    Returns:
        One point and its unit normal for each cell, in the camera frame.
    """
    is_used = frame.is_smooth & is_unclaimed & frame.may_show(surface.diameter_m)
    # Where the noise is as large as the limit of nearness, no shape is visible.
    is_used &= frame.noise_per_m2 * frame.depth_m.square() < surface.near_m
    points_m = frame.points_m[is_used]
    normals = frame.normals[is_used]
    if len(points_m) == 0:
        return points_m, normals

    # The cell of each point.
    place = (points_m / (STEP * surface.diameter_m)).floor().long()
    place -= place.amin(0)
    size = place.amax(0) + 1
    key = (place[:, 0] * size[1] + place[:, 1]) * size[2] + place[:, 2]
    _, cell, count = key.unique(return_inverse=True, return_counts=True)

    # Means of each cell; where normals differ much it holds several surfaces.
    sums = points_m.new_zeros(len(count), 6)
    sums.index_add_(0, cell, torch.cat([points_m, normals], 1))
    mean_m, mean_normal = (sums / count[:, None]).split(3, dim=1)
    is_one_surface = mean_normal.norm(dim=-1) > _MIN_MEAN_NORMAL
    return mean_m[is_one_surface], normalize(mean_normal[is_one_surface], dim=-1)


def _choose_best(
    poses: Rigid, score: Float64[Tensor, " b"], surface: Surface, stage: _Stage
) -> Int64[Tensor, " c"]:
    """Choose the best poses of a stage: none that is nearly a better one, few at each place.

    ``poses`` are all that were compared, with their ``score``. Returns indices of them.
    """
    order = score.argsort(descending=True, stable=True)[: _MORE_THAN_KEPT * stage.most]
    middles_m = poses[order].apply(surface.middle_m[None])[:, 0]
    distance = torch.cdist(middles_m, middles_m) / surface.diameter_m
    # The trace of a relative rotation is 1 + 2 cos(angle).
    rotations = poses.R[order].flatten(1)
    is_turned_little = rotations @ rotations.T > 1 + 2 * math.cos(_SAME_RAD)
    is_same = (distance < _SAME_DIAMETERS) & is_turned_little
    is_at_place = distance < _PLACE_DIAMETERS

    is_open = torch.ones(len(order), dtype=torch.bool)
    count_at_place = torch.zeros(len(order), dtype=torch.long)  # chosen poses near each
    chosen: list[int] = []
    for k in range(len(order)):
        if is_open[k] and len(chosen) < stage.most:
            chosen.append(k)
            count_at_place += is_at_place[k]
            is_open &= ~is_same[k] & (count_at_place < stage.most_at_place)
    return order[chosen]


def refine_projectively(frame: Frame, poses: Rigid, surface: Surface, stage: _Stage) -> Rigid:
    """Refine poses by projective point-to-plane ICP (Blais and Levine 1995).

    Each visible point of the posed surface is matched with the reading in its own direction, so
    that the inner side of a thin wall is not matched with readings of the outer one.

    Args:
        frame: the image.
        poses: a batch, ``camera_from_model``.
        surface: of the model.
        stage: how many points are used, and the limit of each step.

    Returns:
        The refined poses, in the same order.
    """
    is_usable = (frame.is_smooth & frame.may_show(surface.diameter_m)).flatten()
    for limit in stage.icp_limits:
        # Each visible point of the surface, and the reading in its direction.
        visible = _look_up_visible_points(poses, surface, stage.every)
        readings = readings_toward(frame, visible.points_m)
        normal = frame.normals.flatten(0, 1)[readings.pixel]
        gap_m = frame.points_m.flatten(0, 1)[readings.pixel] - visible.points_m
        is_alike = (normal * visible.normals).sum(-1).abs() > _MIN_COSINE_ICP
        is_used = readings.is_read & is_usable[readings.pixel] & is_alike

        # One step, weighted by Tukey's function of the gap.
        limit_m = limit * surface.diameter_m
        weight = torch.from_numpy(tukey_weight(gap_m.square().sum(-1).numpy(), limit_m))
        weight = torch.where(is_used, weight, 0.0)
        distance_m = torch.where(is_used, (gap_m * normal).sum(-1), 0.0)
        middle_m = poses.apply(surface.middle_m[None])
        arm_m = visible.points_m - middle_m
        J = torch.cat([torch.linalg.cross(arm_m, normal), normal], -1)
        J = torch.where(is_used[..., None], J, 0.0)
        motion = _solve_damped(J, distance_m, weight, surface.diameter_m / 2)

        # The motion is about the middle of the object.
        moved = perturb(Rigid(poses.R, poses.t_m - middle_m[:, 0]), motion)
        poses = Rigid(moved.R, moved.t_m + middle_m[:, 0])
    return poses


def _solve_damped(
    J: Float64[Tensor, "b n 6"],
    distance_m: Float64[Tensor, "b n"],
    weight: Float64[Tensor, "b n"],
    radius_m: float,
) -> Float64[Tensor, "b 6"]:
    """Compute the motions of a step of Gauss-Newton: ``(J^T W J + D) motion = J^T W distance``.

    The damping D makes a motion that few readings constrain small. ``radius_m``,
    of the object, converts a rotation to the distance by which it moves the surface.
    """
    squared_arms = torch.tensor([radius_m**2] * 3 + [1.0] * 3, dtype=torch.float64)
    damping = _DAMPING * torch.diag(squared_arms)
    weighted = J.mT * weight[:, None]
    total_weight = weight.sum(-1)[:, None, None].clamp(min=1.0)
    H = weighted @ J + total_weight * damping
    return torch.linalg.solve(H, weighted @ distance_m[..., None])[..., 0]


def score_by_image(
    frame: Frame, poses: Rigid, surface: Surface, stage: _Stage = _STAGES[-1]
) -> Float64[Tensor, " b"]:
    """Score posed surfaces by the readings in the directions of their points, to rank proposals.

    Args:
        frame: the image.
        poses: a batch, ``camera_from_model``.
        surface: of the model.
        stage: how many points are compared, and how closely.

    Returns:
        The share of the surface with a reading at its depth and with its normal, less the share
        with a reading there of another normal, that the camera saw through, or that a background
        hides; at most 1.
    """
    # The reading in the direction of each visible point, and how far behind the point it is.
    visible = _look_up_visible_points(poses, surface, stage.every)
    depth_m = visible.points_m[..., 2]
    readings = readings_toward(frame, visible.points_m)
    gap_m = readings.depth_m - depth_m
    noise_m = SHARED_PER_WHITE * frame.noise_per_m2 * depth_m.square()
    limit_m = stage.near * surface.diameter_m + _DEVIATIONS * noise_m
    is_background = ~frame.may_show(surface.diameter_m).flatten()[readings.pixel]

    # At the depth of the surface, with its normal or another one.
    is_at_depth = readings.is_read & (gap_m.abs() < limit_m)
    cosine = (visible.normals * frame.normals.flatten(0, 1)[readings.pixel]).sum(-1).abs()
    has_other_normal = (cosine <= _MIN_COSINE) & frame.is_smooth.flatten()[readings.pixel]
    supports = is_at_depth & ~has_other_normal & ~is_background

    # Behind a background, or seen through. A sensor cuts rims and edges: a point of an edge without
    # a reading near it counts as not read.
    is_hidden = readings.is_read & (gap_m < -limit_m) & is_background
    nearest_m = frame.nearest_m.flatten()[readings.pixel]
    is_through = readings.is_read & (nearest_m > depth_m + limit_m)
    is_cut = is_through & ~visible.is_inner
    contradicts = (is_at_depth & has_other_normal) | is_hidden | (is_through & visible.is_inner)

    # As shares of the points that are read, or of half of all points where less of them is read.
    count = depth_m.isfinite().sum(1).clamp(min=1)
    read = (readings.is_read & ~is_cut).sum(1).maximum(_LEAST_READ * count).double()
    return (supports.sum(1) - contradicts.sum(1)) / read


class _Visible(NamedTuple):
    """The visible points of posed surfaces, in the camera frame."""

    points_m: Float64[Tensor, "b n 3"]  #: NaN where a view has fewer points
    normals: Float64[Tensor, "b n 3"]  #: of these points
    is_inner: Bool[Tensor, "b n"]  #: whether a point is of no rim or edge, which sensors cut


def _look_up_visible_points(poses: Rigid, surface: Surface, every: int) -> _Visible:
    """Find the points of each posed surface that are visible in the stored view nearest to it.

    ``every``: n: every n-th of them is taken.
    """
    views = surface.views
    camera_m = -(poses.t_m[:, None] @ poses.R)[:, 0]  # in the model frame
    nearest = ((camera_m - surface.middle_m) @ views.toward.T).argmax(-1)
    return _Visible(
        points_m=poses.apply(views.points_m[nearest, ::every]),
        normals=views.normals[nearest, ::every] @ poses.R.mT,
        is_inner=views.is_inner[nearest, ::every],
    )
