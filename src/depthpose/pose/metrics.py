"""How far a pose is from the truth: ADD, ADD-S, MSSD, MSPD, VSD, degrees, metres; IoU of masks.

Definitions of Hinterstoisser et al. (2012) and of the BOP toolkit (Hodan et al. 2018, 2020).
Computed in float64.
"""

from collections.abc import Callable, Sequence

import torch
from jaxtyping import Bool, Float, Int, Int64
from scipy.spatial import KDTree
from torch import Tensor

from depthpose.core.camera import pixel_grid, project
from depthpose.core.rigid import Rigid

VSD_DELTA_M = 0.015  #: tolerance of visibility [m]; BOP takes 15 mm for all sets but ITODD (5 mm)
BOP_SHARES = tuple(round(0.05 * i, 2) for i in range(1, 11))
"""BOP's taus of VSD and thresholds of VSD and MSSD: 0.05 to 0.5 (of the diameter)."""
BOP_PIXELS = tuple(5.0 * i for i in range(1, 11))  #: BOP's, of MSPD [px], at 640 px width

SUCCESS_SHARE = 0.1  #: of the diameter: a pose is right whose ADD or ADD-S is below

_MOST_COORDINATES = 2**22  # of posed points in memory at a time

RenderDepth = Callable[[Rigid], Float[Tensor, "h w"]]
"""Renders the depth [m] of an object at a pose; NaN, 0 or infinity where it is not."""


def add_m(estimated: Rigid, true: Rigid, points_m: Float[Tensor, "n 3"]) -> Float[Tensor, "*batch"]:
    """Measure ADD [m]: the mean distance of each model point at one pose to itself at the other."""
    gap_m = _pose_points(estimated, points_m) - _pose_points(true, points_m)
    return gap_m.norm(dim=-1).mean(-1)


def adds_m(
    estimated: Rigid, true: Rigid, points_m: Float[Tensor, "n 3"]
) -> Float[Tensor, "*batch"]:
    """Measure ADD-S [m]: the mean distance of each true point to the nearest estimated one.

    This is the definition of BOP and Hinterstoisser. DenseFusion and the method's published code
    measure from each estimated point to the nearest true one.
    """
    true_m = _pose_points(true, points_m)
    estimated_m = _pose_points(estimated, points_m)
    batch = true_m.shape[:-2]
    pose_by_pose = (-1, len(points_m), 3)
    means_m: list[float] = []
    for true_points_m, estimated_points_m in zip(
        true_m.reshape(pose_by_pose), estimated_m.reshape(pose_by_pose), strict=True
    ):
        distance_m, _ = KDTree(estimated_points_m.numpy()).query(true_points_m.numpy())
        means_m.append(float(distance_m.mean()))
    return torch.tensor(means_m, dtype=torch.float64).reshape(batch)


def add_of_nearest_m(
    estimated: Rigid, true: Rigid, points_m: Float[Tensor, "n 3"], symmetries: Rigid
) -> Float[Tensor, ""]:
    """Measure ADD [m] of a pose to the nearest symmetric copy of the true pose.

    ADD-S is lower: it forgives any pose with the surface near the true one, such as a U rotated by
    90 degrees, and not only symmetries.

    Args:
        estimated: ``camera_from_model``, one.
        true: the same, annotated.
        points_m: points of the model, in its own frame.
        symmetries: ``model_from_model``, a batch with the identity, of
            ``mesh.symmetry_transforms``.
    """
    estimated_m = _pose_points(estimated, points_m)
    errors_m = [
        (_pose_points(copies, points_m) - estimated_m).norm(dim=-1).mean(-1)
        for copies in _split_symmetric_copies(true, symmetries, len(points_m))
    ]
    return torch.cat(errors_m).min()


def mssd_m(
    estimated: Rigid, true: Rigid, points_m: Float[Tensor, "n 3"], symmetries: Rigid
) -> Float[Tensor, ""]:
    """Measure MSSD [m]: the largest distance of a model point from itself at the true pose.

    The true pose is the symmetric copy for which it is least. The arguments are those of
    :func:`add_of_nearest_m`.
    """
    estimated_m = _pose_points(estimated, points_m)
    errors_m = [
        (_pose_points(copies, points_m) - estimated_m).norm(dim=-1).amax(-1)
        for copies in _split_symmetric_copies(true, symmetries, len(points_m))
    ]
    return torch.cat(errors_m).min()


def mspd_px(
    estimated: Rigid,
    true: Rigid,
    points_m: Float[Tensor, "n 3"],
    symmetries: Rigid,
    K: Float[Tensor, "3 3"],
) -> Float[Tensor, ""]:
    """Measure MSPD [px]: the largest distance of a projected point from itself at the true pose.

    The true pose is the symmetric copy for which it is least. Infinite where a point lies behind
    the camera. BOP scales it by 640 / image width before its thresholds; see
    :func:`average_recall`. The arguments are those of :func:`add_of_nearest_m`, and ``K`` is the
    intrinsic matrix.
    """
    pixels = project(_pose_points(estimated, points_m), K)
    errors_px: list[Tensor] = []
    for copies in _split_symmetric_copies(true, symmetries, len(points_m)):
        distance_px = (project(_pose_points(copies, points_m), K) - pixels).norm(dim=-1)
        errors_px.append(distance_px.nan_to_num(torch.inf).amax(-1))
    return torch.cat(errors_px).min()


def vsd(
    estimated: Rigid,
    true: Rigid,
    depth_m: Float[Tensor, "h w"],
    K: Float[Tensor, "3 3"],
    render: RenderDepth,
    taus_m: Sequence[float],
    delta_m: float = VSD_DELTA_M,
) -> Float[Tensor, " t"]:
    """Measure VSD: the share of the visible surface that is off by ``tau`` or more, for each tau.

    Distances are those from the camera's centre, not along its axis. A pixel of a render is
    visible where the measured surface is not more than ``delta_m`` in front of it, or where
    there is no reading ("bop19"); the estimate is visible also where the truth is. A pixel
    visible in one render alone counts as off. 1 where neither is visible anywhere.

    Args:
        estimated: ``camera_from_model``.
        true: the same, annotated.
        depth_m: measured; NaN or 0 where there is no reading.
        K: intrinsic matrix of that image.
        render: depth of the object at a pose, in this camera; with ``core.render``
            ``lambda pose: rasterize(pose.apply(corners), K, width, height).depth_m``.
        taus_m: tolerances; BOP's are ``BOP_SHARES`` times the diameter.
        delta_m: tolerance of visibility.

    Returns:
        The share for each tau, 0..1.
    """
    measured_m = _distance_from_depth(depth_m, K)
    estimated_m = _distance_from_depth(render(estimated), K)
    true_m = _distance_from_depth(render(true), K)

    # What is visible of each render, and of both.
    is_true_visible = _is_visible(true_m, measured_m, delta_m)
    is_estimated_visible = _is_visible(estimated_m, measured_m, delta_m)
    is_estimated_visible |= is_true_visible & (estimated_m > 0)
    in_both = is_true_visible & is_estimated_visible
    in_either = is_true_visible | is_estimated_visible
    count = int(in_either.sum())
    if count == 0:
        return torch.ones(len(taus_m), dtype=torch.float64)

    # The share that is off by each tolerance or more.
    gap_m = (true_m[in_both] - estimated_m[in_both]).abs()
    in_one_alone = count - int(in_both.sum())
    off_in_both = torch.stack([(gap_m >= tau_m).sum() for tau_m in taus_m])
    return (off_in_both.double() + in_one_alone) / count


def _distance_from_depth(
    depth_m: Float[Tensor, "h w"], K: Float[Tensor, "3 3"]
) -> Float[Tensor, "h w"]:
    """Convert depth along the optical axis to the distance from the camera's centre, 0 for none."""
    # The length of the ray of each pixel, (x, y, 1).
    height, width = depth_m.shape
    pixels = pixel_grid(height, width, torch.float64)
    y = (pixels[..., 1] - K[1, 2]) / K[1, 1]
    x = (pixels[..., 0] - K[0, 2] - K[0, 1] * y) / K[0, 0]
    ray_length = (x * x + y * y + 1).sqrt()
    return depth_m.double().nan_to_num(nan=0.0, posinf=0.0) * ray_length


def _is_visible(
    rendered_m: Float[Tensor, "h w"], measured_m: Float[Tensor, "h w"], delta_m: float
) -> Bool[Tensor, "h w"]:
    """Mark the pixels of a rendered object that no measured surface occludes.

    Both images hold distances from the camera's centre, 0 for none.
    """
    is_unoccluded = (rendered_m - measured_m <= delta_m) | (measured_m == 0)
    return (rendered_m > 0) & is_unoccluded


def auc(error_m: Float[Tensor, " n"], limit_m: float = 0.1) -> float:
    """Compute the area under the curve of recall, by thresholds from 0 to ``limit_m``; 0..1.

    The recall is the share of errors below a threshold. The area is exact; PoseCNN's script takes
    the upper step at each error and is larger by up to one part in the number of errors. A missing
    estimate is NaN or infinite, and counts as 0.
    """
    gain = (1 - error_m.double() / limit_m).clamp(min=0)
    return float(gain.nan_to_num(0.0).mean())


def average_recall(errors: Float[Tensor, "n t"], thresholds: Sequence[float]) -> float:
    """Compute BOP's average recall: the mean over thresholds of the share of errors below them.

    A missing estimate is infinite or NaN, and counts as wrong.

    Args:
        errors: one row a target; the taus of VSD, or one column. MSPD is scaled by 640 / width and
            MSSD divided by the diameter first.
        thresholds: ``BOP_SHARES`` for VSD and MSSD, ``BOP_PIXELS`` for MSPD.
    """
    recalls = [(errors < threshold).double().mean() for threshold in thresholds]
    return float(torch.stack(recalls).mean())


def average_precision(is_right: Sequence[bool], targets: int) -> float:
    """Compute the average precision of detections; 0..1.

    It is the mean over 101 recalls from 0 to 1 of the best precision at a recall or a higher one:
    COCO's interpolation, as BOP takes it for 6D detection since 2024.

    Args:
        is_right: of each detection, in the order of falling scores.
        targets: number of objects to be detected, at least 1.
    """
    # Recall and precision of the first n detections, for each n.
    right_count = torch.tensor(list(is_right), dtype=torch.float64).cumsum(0)
    if len(right_count) == 0:
        return 0.0
    recall = right_count / targets
    precision = right_count / torch.arange(1, len(right_count) + 1, dtype=torch.float64)

    # The best precision at each of 101 recalls or a higher one; 0 at one that is not reached.
    best = precision.flip(0).cummax(0).values.flip(0)
    best = torch.cat([best, best.new_zeros(1)])
    recalls = torch.linspace(0, 1, 101, dtype=torch.float64)
    place = torch.searchsorted(recall, recalls)
    return float(best[place].mean())


def _pose_points(pose: Rigid, points_m: Float[Tensor, "n 3"]) -> Float[Tensor, "*batch n 3"]:
    """Move model points to the camera frame by a pose, or by each of a batch, in float64."""
    points = points_m.double()
    return points @ pose.R.double().mT + pose.t_m.double()[..., None, :]


def _split_symmetric_copies(true: Rigid, symmetries: Rigid, points: int) -> list[Rigid]:
    """List the symmetric copies of a true pose, in batches that fit into memory.

    ``points`` is the number of points that each batch will be applied to.
    """
    copies = true.double() @ symmetries.double()
    size = max(1, _MOST_COORDINATES // (3 * points))
    return [copies[first : first + size] for first in range(0, len(copies.R), size)]


def count_overlap(
    predicted: Int[Tensor, "*b h w"], truth: Int[Tensor, "*b h w"], classes: int
) -> Int64[Tensor, "classes classes"]:
    """Count the pixels of an image or a batch by true class (row) and predicted class (column)."""
    pairs = (truth * classes + predicted).flatten().cpu()
    return torch.bincount(pairs, minlength=classes**2).view(classes, classes)


def intersection_over_union(table: Int64[Tensor, "c c"]) -> Float[Tensor, " c"]:
    """Compute the IoU of each class from a table of :func:`count_overlap`.

    It is NaN for a class without a true or predicted pixel.
    """
    intersection = table.diagonal()
    union = table.sum(0) + table.sum(1) - intersection
    return torch.where(union > 0, intersection / union, torch.nan)
