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
        """Invert: ``source_from_target``."""
        return Rigid(self.R.mT, -(self.R.mT @ self.t_m[..., None]).squeeze(-1))

    def double(self) -> "Rigid":
        """Convert rotation and translation to float64."""
        return Rigid(self.R.double(), self.t_m.double())

    def float(self) -> "Rigid":
        """Convert rotation and translation to float32."""
        return Rigid(self.R.float(), self.t_m.float())

    def __getitem__(
        self, index: int | list[int] | Tensor | slice | tuple[slice | None, ...] | None
    ) -> "Rigid":
        """Index the batch axes like a tensor's; None inserts an axis of length 1."""
        return Rigid(self.R[index], self.t_m[index])

    @classmethod
    def stack(cls, poses: Sequence["Rigid"]) -> "Rigid":
        """Stack one or more transforms along a new first axis."""
        return cls(torch.stack([p.R for p in poses]), torch.stack([p.t_m for p in poses]))

    @classmethod
    def cat(cls, batches: Sequence["Rigid"]) -> "Rigid":
        """Concatenate one or more batches along their first axis."""
        return cls(torch.cat([b.R for b in batches]), torch.cat([b.t_m for b in batches]))

    def matrix(self) -> Float64[Tensor, "*batch 4 4"]:
        """Make the homogeneous matrix ``[[R, t], [0, 1]]``, the translation in metres."""
        upper_rows = torch.cat([self.R, self.t_m[..., None]], -1).double()
        last_row = upper_rows.new_tensor([0, 0, 0, 1]).expand(*upper_rows.shape[:-2], 1, 4)
        return torch.cat([upper_rows, last_row], -2)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:  # noqa: ANN401
        """Convert :meth:`matrix` for numpy: so ``np.asarray`` accepts a transform."""
        return np.array(self.matrix().detach().cpu().numpy(), dtype=dtype, copy=copy)

    def __repr__(self) -> str:
        """Show R and t to four decimals; for a batch only its shape."""
        if self.t_m.ndim > 1:
            return f"Rigid(a batch of {tuple(self.t_m.shape[:-1])})"

        R_rows = ", ".join(_format_vector(row) for row in self.R.tolist())
        return f"Rigid(R=[{R_rows}], t_m={_format_vector(self.t_m.tolist())})"


def _format_vector(vector: list[float]) -> str:
    """Format a vector in brackets, with four decimals."""
    return f"[{', '.join(f'{number:.4f}' for number in vector)}]"


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
    weighted_count = (weight > 0).sum(-1)
    if bool((weighted_count < 3).any()):
        raise InputError(
            f"fit_rigid: {int(weighted_count.min())} points carry weight, but a rotation is fixed "
            "by 3 or more. Give more points or a positive weight to more of them."
        )

    # The cross-covariance of both point sets about their weighted means.
    normalised = (weight / weight.sum(-1, keepdim=True))[..., None]
    source_mean_m = (normalised * source_m).sum(-2, keepdim=True)
    target_mean_m = (normalised * target_m).sum(-2, keepdim=True)
    covariance = (target_m - target_mean_m).mT @ (normalised * (source_m - source_mean_m))

    # Its polar rotation; the least singular direction is flipped where that would be a reflection.
    u, _, vh = torch.linalg.svd(covariance)
    sign = torch.ones_like(u[..., 0])
    sign[..., -1] = torch.where(torch.linalg.det(u @ vh) < 0, -1.0, 1.0)
    R = (u * sign[..., None, :]) @ vh
    return Rigid(R, (target_mean_m - source_mean_m @ R.mT).squeeze(-2))


def is_rotation(R: Float[Tensor, "3 3"], slack: float) -> bool:
    """Whether a matrix is a rotation: ``R @ R.T`` within ``slack`` of the identity, and det > 0."""
    eye = torch.eye(3, dtype=R.dtype, device=R.device)
    return torch.allclose(R @ R.mT, eye, atol=slack) and bool(torch.linalg.det(R) > 0)


def is_rigid(matrix: Float[Tensor, "4 4"], slack: float) -> bool:
    """Whether a matrix is ``[R t; 0 0 0 1]`` of a rotation R within ``slack`` and a finite t."""
    is_finite = bool(matrix.isfinite().all())
    return is_finite and is_rotation(matrix[:3, :3], slack) and matrix[3].tolist() == [0, 0, 0, 1]


def geodesic_rad(
    first: Float[Tensor, "*batch 3 3"], second: Float[Tensor, "*batch 3 3"]
) -> Float[Tensor, "*batch"]:
    """Compute the angle between two rotations [rad].

    It follows from the chord, ``|A - B|_F = 2 sqrt(2) sin(angle / 2)``: accurate near zero, where
    the usual arc cosine of the trace loses half of the digits, and less so near pi.
    """
    chord = torch.linalg.matrix_norm(first - second) / 8**0.5
    return 2 * torch.asin(chord.clamp(max=1.0))


def perturb(pose: Rigid, motion: Float[Tensor, "*batch 6"]) -> Rigid:
    """Move a pose by ``motion``, a rotation vector [rad] and a translation [m] in its target frame.

    It is rotated about the origin of that frame (the camera) first, then translated.
    """
    return Rigid(rotation_by(motion[..., :3]), motion[..., 3:]) @ pose


def move_reference(
    covariance: Float64[Tensor, "*batch 6 6"], shift_m: Float64[Tensor, "3"]
) -> Float64[Tensor, "*batch 6 6"]:
    """Convert the covariance of a motion about a point to that of the same motion about another.

    A rotation w about a point c with the translation v moves the origin by ``c x w + v``.

    Args:
        covariance: of (rotation vector [rad], translation [m]).
        shift_m: from the new point to the old one, in the same axes.
    """
    eye = torch.eye(3, dtype=torch.float64)
    zero = torch.zeros(3, 3, dtype=torch.float64)
    rotation_rows = torch.cat([eye, zero], 1)
    translation_rows = torch.cat([cross_matrix(shift_m), eye], 1)
    new_from_old = torch.cat([rotation_rows, translation_rows])
    return new_from_old @ covariance @ new_from_old.mT


def rotation_by(vector: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Make the rotation matrix of a rotation vector, axis times angle [rad].

    Rodrigues' formula, in a form that stays accurate down to an angle of 0.
    """
    angle = torch.linalg.vector_norm(vector, dim=-1)[..., None, None]
    cross = cross_matrix(vector)
    eye = torch.eye(3, dtype=vector.dtype, device=vector.device)
    # torch.sinc(x) is sin(pi x) / (pi x), which is defined at 0 too.
    sine_term = torch.sinc(angle / torch.pi)  # sin(a) / a
    cosine_term = torch.sinc(angle / (2 * torch.pi)).square() / 2  # (1 - cos(a)) / a^2
    return eye + sine_term * cross + cosine_term * (cross @ cross)


def cross_matrix(vector: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Make the skew matrix ``[v]_x`` of a vector, by which ``[v]_x w`` is the product ``v x w``."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    entries = [zero, -z, y, z, zero, -x, -y, x, zero]
    return torch.stack(entries, -1).unflatten(-1, (3, 3))
