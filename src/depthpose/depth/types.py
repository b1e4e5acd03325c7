"""Types of depth: input apart from truth, and the estimate."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from depthpose.core.camera import Camera, StereoRig, back_project
from depthpose.core.errors import InputError
from depthpose.core.files import Cloud

View = Float[Tensor, "3 h w"]  # an image, RGB in [0, 1]
Views = Float[Tensor, "b 3 h w"]
Map = Float[Tensor, "h w"]  # a number a pixel, NaN where it is not known
Maps = Float[Tensor, "b h w"]
Mask = Bool[Tensor, "h w"]


@dataclass(frozen=True, kw_only=True, eq=False)
class StereoInput:
    """What a depth estimate may use. There is no truth here, so none can leak."""

    name: str  #: what the files made from this input are called
    left: View  #: left (reference) image, RGB in [0, 1]
    #: right image of the rectified pair, or None for one image alone. That its size is the left
    #: one's is checked by the estimator.
    right: Float[Tensor, "3 right_h right_w"] | None
    camera: Camera | None  #: intrinsics of the left image; its baseline makes disparity metric


@dataclass(frozen=True, kw_only=True, eq=False)
class StereoTruth:
    """What is known about the left image of a sample; NaN where nothing is known."""

    disparity_px: Map | None = None  #: disparity of the left image
    #: depth of the left image (camera z unless the dataset's protocol says otherwise)
    depth_m: Map | None = None
    #: left pixels whose point the right view does not show: hidden there, or outside
    occluded: Mask | None = None
    #: disparity of the right image, positive like the left one's
    right_disparity_px: Map | None = None
    is_sky: Mask | None = None  #: left pixels that show the sky


@dataclass(frozen=True, kw_only=True, eq=False)
class StereoSample:
    """One sample of a dataset."""

    input: StereoInput
    truth: StereoTruth


@dataclass(frozen=True, kw_only=True, eq=False)
class RawFrame:
    """A pair with its truth, as it is written to a folder of KITTI's raw layout."""

    left: View  #: left image (camera 2)
    right: View  #: right image (camera 3)
    rig: StereoRig  #: the cameras
    disparity_px: Map  #: of the left image; NaN where unknown
    occluded: Mask  #: left pixels that the right view does not show
    is_sky: Mask  #: left pixels that show the sky
    #: one LiDAR scan, x forward, y left, z up [m] and reflectance; or None
    lidar_points: Float[Tensor, "n 4"] | None
    camera_from_velodyne: Float64[np.ndarray, "4 4"]  #: from the LiDAR to the left camera


@dataclass(frozen=True, kw_only=True, eq=False)
class Match:
    """What a stereo matcher returns for one pair."""

    disparity_px: Map  #: disparity of the left image, dense or NaN where the matcher has no answer
    #: 0 (guess) to 1 (sure), from the matching distribution; None where the matcher has no
    #: distribution
    confidence: Map | None = None
    #: left pixels that show the sky, whose disparity means nothing; None where the matcher does not
    #: know the sky
    is_sky: Mask | None = None


@dataclass(frozen=True, kw_only=True)
class Ground:
    """The plane of a road below a camera: of a map alone, or the camera's mount by all cues."""

    height_m: float  #: of the camera above it
    tilt_deg: float  #: of the optical axis against it; positive looks up
    roll_deg: float  #: positive where the horizon falls to the right
    share: float  #: of the lower part of the image that lies on it, 0..1
    #: standard deviation of the height; of a map alone by the choice of columns (a jackknife), to
    #: which the scale of the depth adds
    height_std_m: float
    tilt_std_deg: float  #: the same of the tilt

    def __str__(self) -> str:
        """Say it in one line."""
        return (
            f"road {self.height_m:.2f} +- {self.height_std_m:.2f} m below the camera, tilt "
            f"{self.tilt_deg:.1f} +- {self.tilt_std_deg:.1f} degrees, roll {self.roll_deg:.1f}"
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class DepthEstimate:
    """Depth of one left image."""

    #: metres along the optical axis; NaN where disparity is invalid, and in the sky. None without a
    #: rig.
    depth_m: Map | None
    #: disparity that the depth was made from, at the size of the input; in the sky that of a point
    #: 10 km away, or 0.01 of a pair without a rig
    disparity_px: Map
    confidence: Map | None = None  #: 0..1, or None
    right: View | None = None  #: the synthesised right view, or None where a real one was given
    #: where the image shows the sky, or None where the weights do not know it
    is_sky: Mask | None = None
    #: how probable it is that the image shows a street, or by weights that do not say that the mean
    #: confidence of the generator, 0..1: low for images out of distribution. None for pairs, and
    #: where the generator has no confidence.
    image_confidence: float | None = None
    ground: Ground | None = None  #: the road, of one image alone; None where none was found
    #: why the whole estimate is doubtful, such as an image unlike those that the weights know, or a
    #: pair of which it cannot be told whether it is rectified; else empty
    warning: str = ""
    #: what it was estimated from, for its colours and camera; None where files hold the estimate
    #: alone
    input: StereoInput | None = None

    def is_sure(self, min_confidence: float | None = None) -> Mask:
        """Give the pixels whose depth has at least this confidence.

        Args:
            min_confidence: 0..1; None: 0.5 of a pair, where it says that the disparity is more
                probably right within 15 % than not; all of one image, and where the matcher has no
                confidence.
        """
        values = self.disparity_px if self.depth_m is None else self.depth_m
        is_estimated = torch.isfinite(values)
        is_pair = self.input is not None and self.input.right is not None
        least = (0.5 if is_pair else 0.0) if min_confidence is None else min_confidence
        if self.confidence is None or least <= 0:
            return is_estimated
        return is_estimated & (self.confidence >= least)

    def cloud(self, far_m: float = 80.0, min_confidence: float | None = None) -> Cloud:
        """Give the coloured points nearer than ``far_m``, in metres in the left camera's frame.

        Args:
            far_m: farther ones are left out.
            min_confidence: less sure ones are left out, as :meth:`is_sure` says.

        Raises:
            InputError: there are no metres, or the input is not known.
        """
        if self.input is None:
            raise InputError("this estimate came without its image; estimate again, or set input=")
        if self.depth_m is None or self.input.camera is None:
            raise InputError(
                f"{self.input.name}: a cloud needs metres: give a camera with a baseline."
            )
        points_m = back_project(self.depth_m, self.input.camera.K).reshape(-1, 3)
        is_kept = self.is_sure(min_confidence).reshape(-1)
        is_kept &= torch.isfinite(points_m).all(-1) & (points_m[:, 2] <= far_m)
        color = self.input.left.permute(1, 2, 0).reshape(-1, 3)
        return Cloud(points=points_m[is_kept].float(), color=color[is_kept])

    def to_open3d(self, far_m: float = 80.0) -> Any:  # noqa: ANN401  Open3D carries no types
        """Give :meth:`cloud` as ``open3d.geometry.PointCloud`` (extra ``open3d``).

        Raises:
            InputError: as :meth:`cloud`.
            MissingExtraError: Open3D is not installed.
        """
        return self.cloud(far_m).to_open3d()

    def __repr__(self) -> str:
        """Say it in one line: size, metres, certainty."""
        height, width = self.disparity_px.shape
        what = "depth"
        unit = "m"
        values = self.depth_m
        if values is None:
            what = "disparity"
            unit = "px"
            values = self.disparity_px
        finite = values[values.isfinite()]
        spread = "nowhere known"
        if len(finite):
            # What is farthest is one pixel.
            low, middle, high = np.percentile(finite.numpy(force=True), (1, 50, 99))
            share = len(finite) / values.numel()
            part = "" if share == 1 else f", known of {share:.0%}"
            spread = f"{low:.1f} .. {high:.1f} {unit} (1 to 99 %, median {middle:.1f}{part})"
        parts = [f"{width}x{height}", f"{what} {spread}"]
        if self.confidence is not None:
            parts.append(f"mean confidence {float(self.confidence.nanmean()):.2f}")
        if self.is_sky is not None:
            parts.append(f"sky {float(self.is_sky.float().mean()):.0%}")
        if self.warning:
            parts.append(f"warning: {self.warning}")
        return f"DepthEstimate({', '.join(parts)})"


@dataclass(frozen=True, kw_only=True, eq=False)
class DepthError:
    """How far an estimate is from the truth, at the size of the image."""

    #: absolute error of disparity [px], or that of depth as a share of the truth; NaN where nothing
    #: is compared
    error: Map
    is_disparity: bool  #: which of the two
    true_depth_m: Map | None = None  #: the truth as depth, where it is known
