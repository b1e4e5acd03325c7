"""Pinhole camera and rectified stereo rig."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True, kw_only=True, eq=False)
class Camera:
    """A pinhole camera without lens distortion. The centre of the first pixel is (0, 0).

    Attributes:
        width: image width [px].
        height: image height [px].
        K: intrinsic matrix ``[[fx, skew, cx], [0, fy, cy], [0, 0, 1]]`` [px], float64.
        depth_unit_m: metres a unit of this camera's depth images, where it has any.
    """

    width: int
    height: int
    K: Float[Tensor, "3 3"]
    depth_unit_m: float | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class StereoRig(Camera):
    """The left camera of a rectified pair, and where the right one stands.

    Attributes:
        baseline_m: the right camera's x in the left camera's frame [m], positive.
        cx_right_minus_left_px: difference of the two principal points (Middlebury's ``doffs``).
            depth = fx * baseline_m / (disparity + cx_right_minus_left_px).
    """

    baseline_m: float
    cx_right_minus_left_px: float = 0.0
