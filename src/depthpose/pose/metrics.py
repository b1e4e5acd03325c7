"""How far a pose is from the truth: ADD, ADD-S, MSSD, MSPD, VSD, degrees and metres.

Definitions of Hinterstoisser et al. (2012) and of the BOP toolkit (Hodan et al. 2018, 2020).
Computed in float64.
"""

from collections.abc import Callable, Sequence

import torch
from jaxtyping import Float
from scipy.spatial import KDTree
from torch import Tensor

from depthpose.core.camera import pixel_grid, project
from depthpose.core.rigid import Rigid

VSD_DELTA_M = 0.015  #: tolerance of visibility [m]; BOP takes 15 mm for all sets but ITODD (5 mm)
BOP_SHARES = tuple(round(0.05 * i, 2) for i in range(1, 11))
"""BOP's taus of VSD and thresholds of VSD and MSSD: 0.05 to 0.5 (of the diameter)."""
BOP_PIXELS = tuple(5.0 * i for i in range(1, 11))  #: BOP's, of MSPD [px], at 640 px width

SUCCESS_SHARE = 0.1  #: of the diameter: a pose is right whose ADD or ADD-S is below

_CHUNK = 2**22

RenderDepth = Callable[[Rigid], Float[Tensor, "h w"]]
"""Renders the depth [m] of an object at a pose; NaN, 0 or infinity where it is not."""


def add_m(estimated: Rigid, true: Rigid, points_m: Float[Tensor, "n 3"]) -> Float[Tensor, "*batch"]:
    """ADD [m]: mean distance of each model point at one pose to itself at the other."""
    return (_moved(estimated, points_m) - _moved(true, points_m)).norm(dim=-1).mean(-1)


def adds_m(
    estimated: Rigid, true: Rigid, points_m: Float[Tensor, "n 3"]
) -> Float[Tensor, "*batch"]:
    """ADD-S [m]: mean distance of each true point to the nearest estimated one.

    So BOP and Hinterstoisser; DenseFusion and the method's published code go the other way, from
    each estimated point to the nearest true one.
    """
    first = _moved(true, points_m)
    second = _moved(estimated, points_m)
    rows = zip(first.reshape(-1, *first.shape[-2:]), second.reshape(-1, *second.shape[-2:]),
               strict=True)  # fmt: skip
    means = [float(KDTree(b.numpy()).query(a.numpy())[0].mean()) for a, b in rows]
    return torch.tensor(means, dtype=torch.float64).reshape(first.shape[:-2])


def add_of_nearest_m(
    estimated: Rigid, true: Rigid, points_m: Float[Tensor, "n 3"], symmetries: Rigid
) -> Float[Tensor, ""]:
    """ADD [m] for the most lenient symmetric truth.

    ADD-S is lower: it forgives any pose that lays the surface near itself, such as a U turned by
    90 degrees, and not only those that leave the object as it is. Poses are ``camera_from_model``,
    symmetries a batch with the identity, of ``mesh.symmetry_transforms``.
    """
    moved_m = _moved(estimated, points_m)
    copies = _symmetric_copies(true, symmetries, len(points_m))
    return torch.cat([(_moved(c, points_m) - moved_m).norm(dim=-1).mean(-1) for c in copies]).min()


def mssd_m(
    estimated: Rigid, true: Rigid, points_m: Float[Tensor, "n 3"], symmetries: Rigid
) -> Float[Tensor, ""]:
    """MSSD [m]: largest distance of a surface point, for the most lenient symmetric truth.

    The arguments are those of :func:`add_of_nearest_m`.
    """
    moved_m = _moved(estimated, points_m)
    copies = _symmetric_copies(true, symmetries, len(points_m))
    return torch.cat([(_moved(c, points_m) - moved_m).norm(dim=-1).amax(-1) for c in copies]).min()


def mspd_px(
    estimated: Rigid,
    true: Rigid,
    points_m: Float[Tensor, "n 3"],
    symmetries: Rigid,
    K: Float[Tensor, "3 3"],
) -> Float[Tensor, ""]:
    """MSPD [px]: largest distance of a projected point, for the most lenient symmetric truth.

    Infinite where a point lies behind the camera. BOP scales it by 640 / image width before its
    thresholds; see :func:`average_recall`.
    """
    pixels = project(_moved(estimated, points_m), K)
    largest = [
        (project(_moved(copy, points_m), K) - pixels).norm(dim=-1).nan_to_num(torch.inf).amax(-1)
        for copy in _symmetric_copies(true, symmetries, len(points_m))
    ]
    return torch.cat(largest).min()


def vsd(
    estimated: Rigid,
    true: Rigid,
    depth_m: Float[Tensor, "h w"],
    K: Float[Tensor, "3 3"],
    render: RenderDepth,
    taus_m: Sequence[float],
    delta_m: float = VSD_DELTA_M,
) -> Float[Tensor, " t"]:
    """VSD: share of the visible surface whose distance is off by ``tau`` or more, for each tau.

    Distances are those from the camera's centre, not along its axis. A pixel of a render is
    visible where the measured surface is not more than ``delta_m`` in front of it, or where
    nothing was measured ("bop19"); the estimate is visible also where the truth is. A pixel
    visible in one render alone is off. 1 where neither is visible anywhere.

    Args:
        estimated: ``camera_from_model``.
        true: the same, annotated.
        depth_m: measured; NaN or 0 where there is no reading.
        K: intrinsic matrix of that image.
        render: depth of the object at a pose, in this camera; with ``core.render``
            ``lambda pose: rasterize(pose.apply(corners), K, width, height).depth_m``.
        taus_m: tolerances; BOP's are ``BOP_SHARES`` times the diameter.
        delta_m: tolerance of visibility.
    """
    # Distance from the centre of a point at depth 1, by pixel.
    height, width = depth_m.shape
    pixels = pixel_grid(height, width, torch.float64)
    y = (pixels[..., 1] - K[1, 2]) / K[1, 1]
    x = (pixels[..., 0] - K[0, 2] - K[0, 1] * y) / K[0, 0]
    rays = (x * x + y * y + 1).sqrt()
    measured, predicted, known = (
        image_m.double().nan_to_num(nan=0.0, posinf=0.0) * rays
        for image_m in (depth_m, render(estimated), render(true))
    )
    is_known, is_found = (
        (model > 0) & ((model - measured <= delta_m) | (measured == 0))
        for model in (known, predicted)
    )
    is_found |= is_known & (predicted > 0)
    both = is_known & is_found
    either = is_known | is_found
    count = int(either.sum())
    if count == 0:
        return torch.ones(len(taus_m), dtype=torch.float64)
    gap_m = (known[both] - predicted[both]).abs()
    alone = count - int(both.sum())
    bad = torch.stack([(gap_m >= tau).sum() for tau in taus_m])
    return (bad.double() + alone) / count


def auc(error_m: Float[Tensor, " n"], limit_m: float = 0.1) -> float:
    """Area under the share of errors below a threshold, for thresholds 0 to ``limit_m``; 0..1.

    The exact area. PoseCNN's script takes the upper step at each error and is larger by up to one
    part in the number of errors. A missing estimate is NaN or infinite, and counts as 0.
    """
    gain = (1 - error_m.double() / limit_m).clamp(min=0)
    return float(gain.nan_to_num(0.0).mean())


def average_recall(errors: Float[Tensor, "n t"], thresholds: Sequence[float]) -> float:
    """BOP's average recall: share of errors below each threshold, mean over thresholds and taus.

    A missing estimate is infinite or NaN: it stays in the denominator.

    Args:
        errors: one row a target; the taus of VSD, or one column. MSPD is scaled by 640 / width and
            MSSD divided by the diameter first.
        thresholds: ``BOP_SHARES`` for VSD and MSSD, ``BOP_PIXELS`` for MSPD.
    """
    return float(torch.stack([(errors < limit).double().mean() for limit in thresholds]).mean())


def average_precision(is_right: Sequence[bool], targets: int) -> float:
    """Average precision of answers, the surest first, among so many things to be found; 0..1.

    The mean, over 101 recalls from 0 to 1, of the best precision at that recall or a higher one:
    COCO's interpolation, as BOP takes it for 6D detection since 2024.

    Args:
        is_right: of each answer, in the order of falling scores.
        targets: how many there are to be found, at least 1.
    """
    right = torch.tensor(list(is_right), dtype=torch.float64).cumsum(0)
    if len(right) == 0:
        return 0.0
    recall = right / targets
    precision = right / torch.arange(1, len(right) + 1, dtype=torch.float64)
    best = precision.flip(0).cummax(0).values.flip(0)  # at this recall or a higher one
    wanted = torch.linspace(0, 1, 101, dtype=torch.float64)
    place = torch.searchsorted(recall, wanted)
    return float(torch.cat([best, best.new_zeros(1)])[place].mean())


def _moved(pose: Rigid, points_m: Float[Tensor, "n 3"]) -> Float[Tensor, "*batch n 3"]:
    points = points_m.double()
    return points @ pose.R.double().mT + pose.t_m.double()[..., None, :]


def _symmetric_copies(true: Rigid, symmetries: Rigid, points: int) -> list[Rigid]:
    """Poses that look like the true one, in groups that fit into memory."""
    pose = true.double()
    R = symmetries.R.double()
    t_m = symmetries.t_m.double()
    size = max(1, _CHUNK // (3 * points))
    return [
        Rigid(pose.R @ rows, pose.t_m + (pose.R @ shift[..., None]).squeeze(-1))
        for rows, shift in zip(R.split(size), t_m.split(size), strict=True)
    ]
