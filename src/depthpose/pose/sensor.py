"""Errors of depth cameras and of real objects: noise, offsets, and the tolerance of a plane.

A depth camera errs in four ways. Each reading has noise of its own. Neighbouring readings also
share an error, because stereo and structured light match windows of several pixels: a patch of
readings that is off together is one observation, not hundreds. For the same reason a reading may be
that of a neighbour some pixels away, which on a slanted surface has another depth. And all readings
of an object are shifted alike along the ray, which refinement takes up in the pose. Beside the
camera, a real object deviates from its file: by a few tenths of a millimetre if it is machined, by
a millimetre or more if the file is a scan or the object a carton.

Noise grows with the square of the depth. Where it is given for that square, as ``noise_per_m2``,
its unit is metres per square metre of depth.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

NOISE_PER_M2 = 0.0015
"""Standard deviation [m] of a Kinect's readings, for the square of the depth in metres (Nguyen et
al., 3DIMPVT 2012): taken where the noise cannot be measured."""
NOISIEST_PER_M2 = 4 * NOISE_PER_M2
"""Largest noise that is measured on an object, for the square of the depth in metres: what is above
it is the shape of the object."""
LARGEST_OFFSET_M = 0.006
"""Largest offset along the ray that all readings of a depth camera share: 3 to 6 mm were measured
(``bench/sensors.py``). Its standard deviation is a setting, ``IcpConfig.sensor_offset_m``."""
FLAT_M = 0.0005
"""Real tables and walls are flat to half a millimetre."""
EDGE_PX = 3
"""Readings up to so many pixels from an edge may be of either side: stereo matches windows, and
masks end so far from the silhouette."""
LATERAL_PX = 1.0
"""Standard deviation of the position of a reading across the optical axis [px]. Residuals grow with
the slant of a surface as if it were 0.5 to 1.2 px on elbows in real bins, 0.8 to 1.6 px on steep
sides of YCB objects (``bench/slants.py``)."""
FINEST_RAD = 2e-4
"""Least angle between the rays of two pixels: points of a cloud at a smaller one are of several
frames."""
LAG_PX = 3
"""Noise is measured between readings so many pixels apart: direct neighbours of a real sensor share
their error."""
SHARED_PER_WHITE = 2.5
"""Standard deviation of the error that neighbours share, over that of the noise of one reading.
Planes before a Kinect and a RealSense show 2 to 4 (``bench/sensors.py``). Of an image that shows
less, what it shows is taken (:func:`measure_shared_per_white`)."""
_BLOCK_PX = 5
"""Side of the blocks of readings whose means show the error that neighbours share."""
_BLOCK_LAG = 4
"""Means are compared so many blocks, 20 pixels, apart: real depth errs over such distances."""
_LEAST_FILLED = 0.6
"""Least share of a block that has readings."""
_LEAST_BLOCKS = 100
"""Least number of second differences, of means and of readings, that measure the ratio."""
AVERAGED_PER_WHITE = 0.55
"""Standard deviation of means of five by five readings some ten pixels apart, over that of the
noise of one reading. With it and half a millimetre, some four fifths of the means on planes before
a Kinect and RealSenses are within two deviations of a straight line (``bench/sensors.py``)."""
CORRELATION_PX = 10
"""Side of the square of readings that counts as one independent observation. A Kinect smooths its
noise as a Gaussian of 3 px does, which makes squares of 4 pi 3^2 pixels independent; a RealSense
smooths by 5 px."""
CORRELATION_RAD = CORRELATION_PX / 570  #: the same as an angle, for a Kinect of 640 columns
LEAST_DEVIATION_M = 1e-5
"""Least standard deviation of a reading: no depth camera measures finer, and the rounding of some
metres to single precision is less than a tenth of it."""
INDEPENDENT_SIDES = 6.0
"""Independent deviations of a real object from its model, however many readings there are: whole
sides deviate, of which a body has about six."""
_TOLERATED = 4.0
"""Largest distance of a reading from its plane, over the error that neighbours share."""
_WIDEST_M = 0.004
_WIDEST_PER_M2 = 0.003
"""That distance is at most 4 mm, and 3 mm for the square of the depth in metres: twice the
noise of a Kinect."""
_DEVIATION_PER_MEDIAN = 1.4826  # standard deviation over median magnitude of a normal distribution
_DEVIATION_OF_DIFFERENCE = math.sqrt(6)
"""Standard deviation of a second difference over that of an independent reading: the variance of
``a - 2 b + c`` is 1 + 4 + 1 times that of a reading."""
_LEAST_DIFFERENCES = 30  # least number of second differences whose median measures the noise
_LEAST_COSINE = 0.3
"""A smaller cosine between ray and normal counts as this one: the sensor hardly measures there."""


@dataclass(frozen=True, kw_only=True)
class DepthNoise:
    """Standard deviations of readings from the surface of a model, in metres."""

    white_std_m: float  #: of a reading along the optical axis, independent of others
    shared_std_m: float  #: along the axis, of the error that neighbouring readings share
    lateral_std_m: float  #: of the position of a reading across the axis
    object_std_m: float  #: of the real surface from the model, along its normal

    def deviation_m(self, cosine: np.ndarray, readings: int) -> np.ndarray:
        """Compute the standard deviation of a mean of neighbouring readings along the optical axis.

        Args:
            cosine: between the ray and the surface normal, of any shape.
            readings: number of independent readings that are averaged.

        Returns:
            Metres, in the shape of ``cosine``; ``LEAST_DEVIATION_M`` or more.
        """
        cosine = np.clip(cosine, _LEAST_COSINE, 1.0)
        noise_m2 = self.white_std_m**2 / readings + self.shared_std_m**2
        # On a surface whose normal is at this angle to the ray, a shift across the axis changes the
        # depth by tan(angle) times as much, and one along the normal by 1 / cos(angle).
        tangent = np.sqrt(1 / cosine**2 - 1)
        lateral_m = self.lateral_std_m * tangent
        object_m = self.object_std_m / cosine
        return np.maximum(np.sqrt(noise_m2 + lateral_m**2 + object_m**2), LEAST_DEVIATION_M)


def measure_noise(
    depth_m: np.ndarray,
    is_object: np.ndarray,
    object_std_m: float,
    focal_px: float,
    shared_per_white: float = SHARED_PER_WHITE,
) -> DepthNoise:
    """Measure the noise of a depth image on an object, and derive its other errors.

    The noise of a reading follows from the median second difference of readings three pixels apart,
    to which a slope adds nothing and a curved surface little. On an object too thin for it all
    readings are taken; where these are too few, the noise is that of a Kinect. The error across the
    axis is as large as measured on other depth cameras (``LATERAL_PX``).

    Args:
        depth_m: (h, w), NaN where there is no reading.
        is_object: (h, w) pixels of one object, without its border.
        object_std_m: standard deviation of the real surface from its model.
        focal_px: of the depth image.
        shared_per_white: error that neighbours share, over the noise of one reading.
    """
    # Second differences on the object, or in the whole image where these are too few.
    masked_m = np.where(is_object, depth_m, np.nan)
    distance_m = float(np.nanmedian(masked_m)) if np.isfinite(masked_m).any() else 0.0
    bend_m, _ = _take_second_differences(masked_m, LAG_PX)
    if len(bend_m) < _LEAST_DIFFERENCES:
        bend_m, _ = _take_second_differences(depth_m, LAG_PX)

    # The noise that they show, or that of a Kinect.
    if len(bend_m) < _LEAST_DIFFERENCES:
        white_std_m = NOISE_PER_M2 * distance_m**2
    else:
        difference_std_m = _DEVIATION_PER_MEDIAN * float(np.median(np.abs(bend_m)))
        white_std_m = difference_std_m / _DEVIATION_OF_DIFFERENCE
        # On a small object its own curvature is in the differences: no sensor is so noisy.
        white_std_m = min(white_std_m, NOISIEST_PER_M2 * distance_m**2)
    return DepthNoise(
        white_std_m=white_std_m,
        shared_std_m=shared_per_white * white_std_m,
        lateral_std_m=LATERAL_PX * distance_m / focal_px,
        object_std_m=object_std_m,
    )


def measure_shared_per_white(depth_m: Float[Tensor, "h w"]) -> float:
    """Measure the error that neighbouring readings share, over the noise of one reading.

    Means of blocks of readings have little noise of their own: their second differences show what
    neighbours share. Curved surfaces add to them, so the measured ratio is bounded.

    Args:
        depth_m: a whole depth image [m]; NaN or 0 where there is no reading.

    Returns:
        Ratio of the two standard deviations, ``SHARED_PER_WHITE`` at most; as much where readings
        are too few, or without noise.
    """
    read_m = np.where(depth_m.numpy() > 0, depth_m.double().numpy(), np.nan)
    height = read_m.shape[0] // _BLOCK_PX
    width = read_m.shape[1] // _BLOCK_PX
    whole_m = read_m[: height * _BLOCK_PX, : width * _BLOCK_PX]
    blocks_m = whole_m.reshape(height, _BLOCK_PX, width, _BLOCK_PX)
    is_read = np.isfinite(blocks_m)
    count = is_read.sum((1, 3))
    sum_m = np.where(is_read, blocks_m, 0).sum((1, 3))
    is_filled = count >= _LEAST_FILLED * _BLOCK_PX**2
    mean_m = np.where(is_filled, sum_m / np.maximum(count, 1), np.nan)

    # Both over the square of the depth, with which noise grows.
    shared_bend_m, shared_middle_m = _take_second_differences(mean_m, _BLOCK_LAG)
    bend_m, middle_m = _take_second_differences(read_m, LAG_PX, every=_BLOCK_PX)
    if min(len(shared_bend_m), len(bend_m)) < _LEAST_BLOCKS:
        return SHARED_PER_WHITE
    shared = float(np.median(np.abs(shared_bend_m) / shared_middle_m**2))
    white = float(np.median(np.abs(bend_m) / middle_m**2))
    return min(SHARED_PER_WHITE, shared / white) if white > 0 else SHARED_PER_WHITE


def _take_second_differences(
    depth_m: np.ndarray, lag: int, every: int = 1
) -> tuple[np.ndarray, np.ndarray]:
    """Take second differences of readings ``lag`` apart, and the reading in the middle of each.

    They are taken along every ``every``-th row and column, where all three readings are finite.
    """
    bends_m: list[np.ndarray] = []
    middles_m: list[np.ndarray] = []
    for along_m in (depth_m[::every], depth_m.T[::every]):
        ends_m = along_m[:, : -2 * lag] + along_m[:, 2 * lag :]
        middle_m = along_m[:, lag:-lag]
        bend_m = ends_m - 2 * middle_m
        is_finite = np.isfinite(bend_m)
        bends_m.append(bend_m[is_finite])
        middles_m.append(middle_m[is_finite])
    return np.concatenate(bends_m), np.concatenate(middles_m)


def measure_noise_per_m2(depth_m: Float64[Tensor, "h w"]) -> float:
    """Measure the noise of a whole image, per square metre of depth.

    It follows from second differences, as in :func:`measure_noise`, each over the square of its
    depth; where there are none, it is that of a Kinect.

    Args:
        depth_m: 0 where there is no reading.

    Returns:
        The standard deviation of a reading [m] over the square of its depth [m^2].
    """
    read_m = torch.where(depth_m > 0, depth_m, torch.nan)
    bend_m, middle_m = _take_second_differences(read_m.numpy(), LAG_PX)
    if len(bend_m) == 0:
        return NOISE_PER_M2
    bend_per_m2 = torch.from_numpy(np.abs(bend_m) / np.square(middle_m))
    difference_std_per_m2 = _DEVIATION_PER_MEDIAN * float(bend_per_m2.median())
    return difference_std_per_m2 / _DEVIATION_OF_DIFFERENCE


def plane_tolerance_m(depth_m: Float64[Tensor, "*n"], noise_per_m2: float) -> Float64[Tensor, "*n"]:
    """Compute the largest distance [m] from a plane at which a reading counts as one of it.

    Args:
        depth_m: depths of the readings.
        noise_per_m2: noise of the image (:func:`measure_noise_per_m2`).
    """
    depth_m2 = depth_m.square()
    tolerance_m = FLAT_M + _TOLERATED * SHARED_PER_WHITE * noise_per_m2 * depth_m2
    return torch.minimum(tolerance_m, _WIDEST_M + _WIDEST_PER_M2 * depth_m2)
