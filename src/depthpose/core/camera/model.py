"""The two cameras: a pinhole, and the left one of a rectified pair."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from depthpose.core.errors import InputError

MAX_SIDE_PX = 2**20
"""Of an image: a number beyond is a mistake, and none that is computed with."""
MAX_BASELINE_M = 100
"""No rig on the ground is this wide: such a number was in millimetres."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Camera:
    """A pinhole camera without lens distortion. The centre of the first pixel is (0, 0).

    Attributes:
        width: image width [px].
        height: image height [px].
        K: intrinsic matrix ``[[fx, skew, cx], [0, fy, cy], [0, 0, 1]]`` [px], float64.
        depth_unit_m: metres a unit of this camera's depth images, where it has any.

    Raises:
        InputError: a value is out of its range.
    """

    width: int
    height: int
    K: Float[Tensor, "3 3"]
    depth_unit_m: float | None = None

    def __post_init__(self) -> None:
        for name, size in (("width", self.width), ("height", self.height)):
            if not 1 <= size <= MAX_SIDE_PX:
                raise InputError(
                    f"{name} is {str(size)[:20]}, but an image has 1 to {MAX_SIDE_PX} pixels in a "
                    "row; mend it"
                )
        check_intrinsics(self.K)
        if self.depth_unit_m is not None and not 0 < self.depth_unit_m < math.inf:
            raise InputError(
                f"depth_unit_m is {self.depth_unit_m}, but a unit is a positive number of metres; "
                "0.001 means millimetres"
            )


@dataclass(frozen=True, kw_only=True, eq=False)
class StereoRig(Camera):
    """The left camera of a rectified pair, and where the right one stands.

    Attributes:
        baseline_m: the right camera's x in the left camera's frame [m], positive.
        cx_right_minus_left_px: difference of the two principal points (Middlebury's ``doffs``).
            depth = fx * baseline_m / (disparity + cx_right_minus_left_px).

    Raises:
        InputError: a value is out of its range.
    """

    baseline_m: float
    cx_right_minus_left_px: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 < self.baseline_m < math.inf:
            raise InputError(
                f"baseline_m is {self.baseline_m}, but the right camera stands at a positive x; "
                "are left and right exchanged? Give its distance from the left one in metres"
            )
        if self.baseline_m >= MAX_BASELINE_M:
            raise InputError(
                f"baseline_m is {self.baseline_m:g}, which looks like millimetres; divide by 1000"
            )
        if not math.isfinite(self.cx_right_minus_left_px):
            raise InputError(
                f"cx_right_minus_left_px is {self.cx_right_minus_left_px}; give pixels, or leave "
                "it out where both principal points agree"
            )


def check_intrinsics(K: Tensor) -> None:
    """Refuse a matrix that is no intrinsic matrix.

    Raises:
        InputError: the shape, the type or a value of ``K`` is wrong.
    """
    form = "[[fx, skew, cx], [0, fy, cy], [0, 0, 1]]"
    if not isinstance(K, Tensor):
        raise InputError(
            f"K is a {type(K).__name__}, not a tensor; pass torch.tensor(K, dtype=torch.float64)"
        )
    if tuple(K.shape) != (3, 3):
        raise InputError(f"K is {tuple(K.shape)}, not 3x3; write {form}")
    if K.dtype != torch.float64:
        raise InputError(f"K is of {K.dtype}, not torch.float64; pass K.double()")
    rows = K.tolist()
    if not bool(K.isfinite().all()):
        raise InputError(f"K is {rows}, not finite; write {form}")
    if rows[2] != [0, 0, 1] or rows[1][0] != 0:
        is_transposed = rows[0][1:] == [0, 0] and rows[0][0] != 0 and K[:, 2].tolist() == [0, 0, 1]
        hint = "it looks transposed; " if is_transposed else ""
        raise InputError(f"K is {rows}; {hint}write {form}")
    if rows[0][0] <= 0 or rows[1][1] <= 0:
        raise InputError(
            f"K has fx {rows[0][0]:g} and fy {rows[1][1]:g}, but focal lengths are positive; "
            f"write {form}"
        )
