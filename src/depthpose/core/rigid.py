"""Rigid transforms: apply, compose, invert, compare, fit."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from depthpose.core.errors import InputError


@dataclass(frozen=True, eq=False)
class Rigid:
    """``target_from_source``: carries source points to the target frame, ``R @ p + t``."""

    R: Float[Tensor, "*batch 3 3"]  #: rotation, orthonormal with determinant +1
    t_m: Float[Tensor, "*batch 3"]  #: translation [m]

    def apply(self, points_m: Float[Tensor, "*points n 3"]) -> Float[Tensor, "*moved n 3"]:
        """Move points from the source frame to the target frame; batch axes are broadcast."""
        return points_m @ self.R.mT + self.t_m[..., None, :]

    def __matmul__(self, other: "Rigid") -> "Rigid":
        """Compose: ``a_from_b @ b_from_c`` is ``a_from_c``."""
        moved_m = (self.R @ other.t_m[..., None]).squeeze(-1)
        return Rigid(self.R @ other.R, moved_m + self.t_m)

    def inverse(self) -> "Rigid":
        """Give ``source_from_target``."""
        return Rigid(self.R.mT, -(self.R.mT @ self.t_m[..., None]).squeeze(-1))

    def double(self) -> "Rigid":
        """Give it in float64."""
        return Rigid(self.R.double(), self.t_m.double())

    def float(self) -> "Rigid":
        """Give it in float32."""
        return Rigid(self.R.float(), self.t_m.float())

    def __getitem__(
        self, index: int | list[int] | Tensor | slice | tuple[slice | None, ...] | None
    ) -> "Rigid":
        """Give one of a batch or several as a batch; each None is a new axis of one."""
        return Rigid(self.R[index], self.t_m[index])

    @classmethod
    def stack(cls, poses: Sequence["Rigid"]) -> "Rigid":
        """Make a batch; at least of one."""
        return cls(torch.stack([p.R for p in poses]), torch.stack([p.t_m for p in poses]))

    @classmethod
    def cat(cls, batches: Sequence["Rigid"]) -> "Rigid":
        """Join batches; at least one."""
        return cls(torch.cat([b.R for b in batches]), torch.cat([b.t_m for b in batches]))

    def matrix(self) -> Float64[Tensor, "*batch 4 4"]:
        """Give ``[[R, t], [0, 1]]``, the translation in metres."""
        top = torch.cat([self.R, self.t_m[..., None]], -1).double()
        last = top.new_tensor([0, 0, 0, 1]).expand(*top.shape[:-2], 1, 4)
        return torch.cat([top, last], -2)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:  # noqa: ANN401
        """Give :meth:`matrix` to numpy, whose ``asarray`` and functions then take a transform."""
        return np.array(self.matrix().detach().cpu().numpy(), dtype=dtype, copy=copy)

    def __repr__(self) -> str:
        """Say it in one line: of a batch its size alone."""
        if self.t_m.ndim > 1:
            return f"Rigid(a batch of {tuple(self.t_m.shape[:-1])})"
        rows = (*self.R.tolist(), self.t_m.tolist())
        x, y, z, t = (", ".join(f"{number:.4f}" for number in row) for row in rows)
        return f"Rigid(R=[[{x}], [{y}], [{z}]], t_m=[{t}])"


def fit_rigid(
    source_m: Float[Tensor, "*batch n 3"],
    target_m: Float[Tensor, "*batch n 3"],
    weight: Float[Tensor, "*batch n"],
) -> Rigid:
    """Find the rigid transform that best carries ``source_m`` onto ``target_m``.

    Minimises ``sum_i w_i |R s_i + t - t_i|^2`` in closed form (Kabsch 1976; Umeyama 1991 for the
    sign). A reflection is excluded: ``det(R) = +1`` for mirrored and planar points too. Where the
    weighted points lie on a line the rotation about it is arbitrary.

    Raises:
        InputError: fewer than three points of some batch entry carry weight.
    """
    supported = (weight > 0).sum(-1)
    if bool((supported < 3).any()):
        raise InputError(
            f"fit_rigid: {int(supported.min())} points carry weight, but a rotation is fixed by 3 "
            "or more. Give more points or a positive weight to more of them."
        )
    share = (weight / weight.sum(-1, keepdim=True))[..., None]
    source_mean_m = (share * source_m).sum(-2, keepdim=True)
    target_mean_m = (share * target_m).sum(-2, keepdim=True)
    covariance = (target_m - target_mean_m).mT @ (share * (source_m - source_mean_m))
    u, _, vh = torch.linalg.svd(covariance)
    sign = torch.ones_like(u[..., 0])
    sign[..., -1] = torch.where(torch.linalg.det(u @ vh) < 0, -1.0, 1.0)
    R = (u * sign[..., None, :]) @ vh
    return Rigid(R, (target_mean_m - source_mean_m @ R.mT).squeeze(-2))


def geodesic_rad(
    first: Float[Tensor, "*batch 3 3"], second: Float[Tensor, "*batch 3 3"]
) -> Float[Tensor, "*batch"]:
    """Angle between two rotations [rad].

    By the chord, ``|A - B|_F = 2 sqrt(2) sin(angle / 2)``: accurate near zero, where the usual
    arc cosine of the trace loses half of the digits, and less so near pi.
    """
    chord = torch.linalg.matrix_norm(first - second) / 8**0.5
    return 2 * torch.asin(chord.clamp(max=1.0))


def perturb(pose: Rigid, motion: Float[Tensor, "*batch 6"]) -> Rigid:
    """Move a pose by (rotation vector [rad], translation [m]) in the camera frame."""
    return Rigid(rotation_by(motion[..., :3]), motion[..., 3:]) @ pose


def rotation_by(vector: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Give the rotation by a rotation vector [rad]: Rodrigues' formula, exact down to no turn."""
    angle = torch.linalg.vector_norm(vector, dim=-1)[..., None, None]
    cross = cross_matrix(vector)
    eye = torch.eye(3, dtype=vector.dtype, device=vector.device)
    # torch.sinc(x) is sin(pi x) / (pi x); (1 - cos a) / a^2 is half of the square of sinc(a / 2).
    half = torch.sinc(angle / (2 * torch.pi))
    return eye + torch.sinc(angle / torch.pi) * cross + half.square() / 2 * (cross @ cross)


def cross_matrix(vector: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Give ``[v]_x``, with ``[v]_x w = v x w``."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    rows = [zero, -z, y, z, zero, -x, -y, x, zero]
    return torch.stack(rows, -1).unflatten(-1, (3, 3))
