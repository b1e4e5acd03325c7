"""Epipolar geometry of a rectified rig (Hartley and Zisserman 2004, chapters 9 and 11)."""

import torch
from jaxtyping import Float
from torch import Tensor

from depthpose.core.camera.model import StereoRig


def essential_matrix(rig: StereoRig) -> Float[Tensor, "3 3"]:
    """Make E with ``x_right^T E x_left = 0`` for rays ``x = K^-1 (u, v, 1)``.

    ``E = [t]_x R`` (Hartley and Zisserman, 9.12), where ``p_right = R p_left + t``. The right
    camera of a rectified rig stands at (baseline, 0, 0), so R = I and t = (-baseline, 0, 0).
    """
    baseline_m = rig.baseline_m
    return rig.K.new_tensor([[0, 0, 0], [0, 0, baseline_m], [0, -baseline_m, 0]])


def fundamental_matrix(rig: StereoRig) -> Float[Tensor, "3 3"]:
    """Make F with ``x_right^T F x_left = 0`` for pixels ``x = (u, v, 1)``; its scale is arbitrary.

    ``F = K_right^-T E K_left^-1`` (Hartley and Zisserman, 9.12). The two K differ by a shift along
    the rows, where the epipole lies, so F is the same with either of them.
    """
    inverse = rig.K.inverse()
    return inverse.mT @ essential_matrix(rig) @ inverse


def epipolar_distance_px(
    points_left: Float[Tensor, "n 2"], points_right: Float[Tensor, "n 2"], F: Float[Tensor, "3 3"]
) -> Float[Tensor, " n"]:
    """Measure how far matched pixels lie from each other's epipolar lines [px].

    The root mean square of the two distances, symmetric in the images (Hartley and Zisserman,
    11.10), computed in F's precision. Two pixels a rectified pair shifts apart by d rows are d
    apart. At an epipole, where no line is defined, it is 0.
    """
    left, right = _homogeneous(points_left.to(F)), _homogeneous(points_right.to(F))
    lines_right, lines_left = left @ F.mT, right @ F
    residual = (right * lines_right).sum(-1)
    floor = torch.finfo(F.dtype).eps * torch.linalg.matrix_norm(F)
    near, far = (line[:, :2].norm(dim=-1).clamp_min(floor) for line in (lines_left, lines_right))
    # The root is of the lines alone: at residual 0 its gradient would be infinite.
    distance_px = residual.abs() * ((near**-2 + far**-2) / 2).sqrt()
    return distance_px.to(points_left.dtype)


def _homogeneous(points: Float[Tensor, "n 2"]) -> Float[Tensor, "n 3"]:
    return torch.cat([points, torch.ones_like(points[:, :1])], -1)
