"""Types of depth: the input of an estimate, the truth, matches and estimates."""

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from depthpose.core.camera import Camera, StereoRig, back_project
from depthpose.core.errors import InputError
from depthpose.core.files import PointCloud

View = Float[Tensor, "3 h w"]  # an image, RGB in [0, 1]
Views = Float[Tensor, "b 3 h w"]
Map = Float[Tensor, "h w"]  # one value for each pixel, NaN where it is unknown
Maps = Float[Tensor, "b h w"]
Mask = Bool[Tensor, "h w"]


@dataclass(frozen=True, kw_only=True, eq=False)
class DepthInput:
    """Everything that a depth estimate may use; it holds no truth, so none can leak."""

    name: str  #: name of the files that are made from this input
    left: View  #: left (reference) image, RGB in [0, 1]
    #: right image of the rectified pair, or None for a single image. The estimator checks that its
    #: size is that of the left one.
    right: Float[Tensor, "3 right_h right_w"] | None
    camera: Camera | None  #: intrinsics of the left image; its baseline makes disparity metric


@dataclass(frozen=True, kw_only=True, eq=False)
class DepthTruth:
    """Truth of a sample; None for a map that the dataset does not have, NaN for unknown pixels."""

    disparity_px: Map | None = None  #: disparity of the left image
    #: depth of the left image (camera z unless the dataset's protocol says otherwise)
    depth_m: Map | None = None
    #: left pixels whose point the right view does not show: occluded there, or outside
    occluded: Mask | None = None
    #: disparity of the right image, positive like the left one's
    right_disparity_px: Map | None = None
    is_sky: Mask | None = None  #: left pixels that show the sky


@dataclass(frozen=True, kw_only=True, eq=False)
class DepthSample:
    """One sample of a dataset."""

    input: DepthInput  #: what an estimator may use
    truth: DepthTruth  #: what its estimate is compared with


@dataclass(frozen=True, kw_only=True, eq=False)
class RawFrame:
    """A synthetic pair with its truth, which is written in KITTI's raw or Middlebury's layout."""

    left: View  #: left image (KITTI's camera 2)
    right: View  #: right image (camera 3)
    rig: StereoRig  #: both cameras
    disparity_px: Map  #: disparity of the left image; NaN where unknown
    occluded: Mask  #: left pixels that the right view does not show
    is_sky: Mask  #: left pixels that show the sky
    #: one LiDAR scan, x forward, y left, z up [m] and reflectance; or None
    lidar_points: Float[Tensor, "n 4"] | None
    camera_from_velodyne: Float64[np.ndarray, "4 4"]  #: transform from the LiDAR to the left camera


@dataclass(frozen=True, kw_only=True, eq=False)
class Match:
    """Result of a stereo matcher for one pair."""

    disparity_px: Map  #: disparity of the left image; NaN where the matcher has none
    #: 0 (guess) to 1 (sure), from the distribution over disparities; None where the matcher has no
    #: such distribution
    confidence: Map | None = None
    #: left pixels that show the sky, whose disparity has no meaning; None where the matcher does
    #: not recognise the sky
    is_sky: Mask | None = None
    warning: str = ""  #: why the match is doubtful as a whole; else empty


@dataclass(frozen=True, kw_only=True)
class Ground:
    """The road as a plane below a camera: fitted to one depth map, or combined from all cues.

    The latter is the camera's mount (``find_mount`` of ``depth/mount.py``).
    """

    height_m: float  #: height of the camera above the plane
    tilt_deg: float  #: tilt of the optical axis against the plane; positive looks up
    roll_deg: float  #: positive where the horizon falls to the right
    share: float  #: share of the lower part of the image that lies on the plane, 0..1
    #: standard deviation of the height. That of a fit to one map is a jackknife's over its columns,
    #: without the error of the map's scale
    height_std_m: float
    tilt_std_deg: float  #: standard deviation of the tilt

    def __str__(self) -> str:
        """Return height, tilt and roll in one line of text."""
        return (
            f"road {self.height_m:.2f} +- {self.height_std_m:.2f} m below the camera, tilt "
            f"{self.tilt_deg:.1f} +- {self.tilt_std_deg:.1f} degrees, roll {self.roll_deg:.1f}"
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class DepthEstimate:
    """Depth of one left image."""

    input: DepthInput  #: what it was estimated from, with its colours and camera
    #: metres along the optical axis; NaN where disparity is invalid, and in the sky. None without a
    #: rig.
    depth_m: Map | None
    #: disparity that the depth was made from, at the size of the input; in the sky that of a point
    #: 10 km away, or 0.01 for a pair without a rig
    disparity_px: Map
    confidence: Map | None = None  #: 0..1; None where the method has none
    right: View | None = None  #: the synthesised right view; None for a real pair
    #: pixels that show the sky; None where the weights do not recognise it
    is_sky: Mask | None = None
    #: probability that the image shows a street, or, where the weights do not give that, the mean
    #: confidence of the generator, 0..1: low for images out of distribution. None for pairs, and
    #: where the generator has no confidence.
    image_confidence: float | None = None
    ground: Ground | None = None  #: the road, of a single image; None where there is none
    #: why the whole estimate is doubtful, such as an image out of distribution, or a pair that does
    #: not tell whether it is rectified; else empty
    warning: str = ""

    def is_sure(self, min_confidence: float | None = None) -> Mask:
        """Find the pixels that have depth, and a confidence that is high enough.

        Without depth those with disparity count. Without a confidence all of them are sure.

        Args:
            min_confidence: 0..1; None: 0.5 for a pair, from which the disparity is more probably
                right than wrong (within 15 % by the light matcher, within 2 px by PSMNet); 0 for a
                single image.
        """
        values = self.disparity_px if self.depth_m is None else self.depth_m
        is_estimated = torch.isfinite(values)
        if min_confidence is None:
            min_confidence = 0.0 if self.input.right is None else 0.5
        if self.confidence is None or min_confidence <= 0:
            return is_estimated
        return is_estimated & (self.confidence >= min_confidence)

    def cloud(self, far_m: float = 80.0, min_confidence: float | None = None) -> PointCloud:
        """Back-project depth to coloured points [m] in the left camera's frame.

        Args:
            far_m: points farther than this are left out.
            min_confidence: points of less confidence are left out, as :meth:`is_sure` says.

        Raises:
            InputError: the estimate has no metres.
        """
        if self.depth_m is None or self.input.camera is None:
            raise InputError(
                f"{self.input.name}: a cloud needs metres: give a camera with a baseline."
            )
        points_m = back_project(self.depth_m, self.input.camera.K).reshape(-1, 3)
        is_near = torch.isfinite(points_m).all(-1) & (points_m[:, 2] <= far_m)
        is_included = self.is_sure(min_confidence).reshape(-1) & is_near
        color = self.input.left.permute(1, 2, 0).reshape(-1, 3)
        return PointCloud(points=points_m[is_included].float(), color=color[is_included])

    def to_open3d(self, far_m: float = 80.0) -> Any:  # noqa: ANN401  Open3D carries no types
        """Convert :meth:`cloud` to an ``open3d.geometry.PointCloud`` (extra ``open3d``).

        Raises:
            InputError: as :meth:`cloud`.
            MissingExtraError: Open3D is not installed.
        """
        return self.cloud(far_m).to_open3d()

    def __repr__(self) -> str:
        """Return size, range of depth, confidence and warning in one line of text."""
        height, width = self.disparity_px.shape
        if self.depth_m is not None:
            quantity = "depth"
            unit = "m"
            values = self.depth_m
        else:
            quantity = "disparity"
            unit = "px"
            values = self.disparity_px

        # Percentiles, for the extremes are single pixels.
        finite = values[values.isfinite()]
        value_range = "nowhere known"
        if len(finite):
            low, median, high = np.percentile(finite.numpy(force=True), (1, 50, 99))
            share = len(finite) / values.numel()
            coverage = "" if share == 1 else f", known of {share:.0%}"
            value_range = (
                f"{low:.1f} .. {high:.1f} {unit} (1 to 99 %, median {median:.1f}{coverage})"
            )

        parts = [f"{width}x{height}", f"{quantity} {value_range}"]
        if self.confidence is not None:
            parts.append(f"mean confidence {float(self.confidence.nanmean()):.2f}")
        if self.is_sky is not None:
            parts.append(f"sky {float(self.is_sky.float().mean()):.0%}")
        if self.warning:
            parts.append(f"warning: {self.warning}")
        return f"DepthEstimate({', '.join(parts)})"


@runtime_checkable
class Estimator(Protocol):
    """Anything that estimates depth: :class:`FakestereoNet`, a baseline, or your own method."""

    def estimate_input(self, depth_input: DepthInput, /) -> DepthEstimate:
        """Estimate depth of one input, whose images are in memory."""
        ...


@dataclass(frozen=True, kw_only=True, eq=False)
class ErrorMaps:
    """Error of an estimate at each pixel of the image."""

    #: absolute error of disparity [px], or that of depth as a share of the truth; NaN where no
    #: pixel is compared
    error: Map
    is_disparity: bool  #: whether ``error`` is that of disparity
    true_depth_m: Map | None = None  #: the truth as depth; None where no rig converts it
