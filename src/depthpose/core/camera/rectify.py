"""Rectify a pair with OpenCV, and measure what rows still differ by."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor

from depthpose.core.arrays import grey_of
from depthpose.core.camera.facts import Size, camera_from_facts, facts_from_projections
from depthpose.core.camera.pinhole import StereoRig
from depthpose.core.camera.raw_pair import RawCamera, RawPair
from depthpose.core.errors import InputError, import_opencv
from depthpose.core.rigid import Rigid

_FEATURES = 4000
_RATIO = 0.75  # Lowe 2004, section 7.1, says 0.8
_RANSAC_PX = 1.0
_MIN_MATCHES = 25
_MAX_SWAPPED_SHARE = 0.2

Maps = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True, kw_only=True, eq=False)
class Rectifier:
    """What takes a calibrated pair to a rectified one.

    Attributes:
        rig: the camera of the rectified pair.
        rectified_from_raw: carries points from the raw left camera's frame to the rectified one's
            (a rotation alone): what is known of the raw camera, such as where a LiDAR stands, is
            carried along by it.
        left_maps: column and row of the raw left image for each pixel of the rectified one.
        right_maps: the same of the right image.
    """

    rig: StereoRig
    rectified_from_raw: Rigid
    left_maps: Maps
    right_maps: Maps

    @cached_property
    def seen_share(self) -> float:
        """Share of the rectified left image that the raw one shows; the rest is black."""
        x, y = self.left_maps
        inside = (x >= 0) & (x <= self.rig.width - 1) & (y >= 0) & (y <= self.rig.height - 1)
        return float(inside.mean())

    def rectify(
        self, left: Float32[Tensor, "3 h w"], right: Float32[Tensor, "3 h w"]
    ) -> tuple[Float32[Tensor, "3 h w"], Float32[Tensor, "3 h w"]]:
        """Rectify the two images of a pair; what a raw image does not show is black.

        Raises:
            InputError: an image is not of the calibration's size.
        """
        for image, name in ((left, "the left image"), (right, "the right image")):
            self.refuse_other_size(image, name)
        return _warp(left, self.left_maps), _warp(right, self.right_maps)

    def refuse_other_size(self, image: Float32[Tensor, "3 h w"], name: str) -> None:
        """Refuse an image that is not of the calibration's size.

        Raises:
            InputError: that is so.
        """
        height, width = image.shape[1:]
        if (width, height) != (self.rig.width, self.rig.height):
            raise InputError(
                f"{name} is {width}x{height}, but the cameras were calibrated at "
                f"{self.rig.width}x{self.rig.height}; give the raw images in that size"
            )


def make_rectifier(pair: RawPair, size: Size, keep: float = 0.0) -> Rectifier:
    """Choose the rectified cameras (Bouguet's method, as OpenCV's ``stereoRectify`` has it).

    Args:
        pair: the calibration.
        size: width and height of the images [px], for calibrations that do not say it.
        keep: 0: only what the raw images show; 1: all that they show, with black borders.

    Raises:
        InputError: ``keep`` is out of range, or the lens bends too much for a flat image.
        MissingExtraError: OpenCV is not installed.
    """
    cv2 = import_opencv("rectifying a pair")
    if not 0 <= keep <= 1:
        raise InputError(f"--keep {keep:g}: 0 keeps what both lenses show, 1 keeps all; take 0")
    size = pair.size or size
    R, t = (part.numpy() for part in (pair.right_from_left.R, pair.right_from_left.t_m[:, None]))
    lenses = (*_numbers(pair.left), *_numbers(pair.right))
    flags = cv2.CALIB_ZERO_DISPARITY
    if pair.left.is_fisheye:
        R1, R2, P1, P2, *_ = cv2.fisheye.stereoRectify(
            *lenses, size, R, t, flags, newImageSize=size, balance=keep
        )
    else:
        R1, R2, P1, P2, *_ = cv2.stereoRectify(*lenses, size, R, t, flags=flags, alpha=keep)
    return Rectifier(
        rig=_rig(P1, P2, size),
        rectified_from_raw=Rigid(torch.from_numpy(R1), torch.zeros(3).double()),
        left_maps=_maps(pair.left, R1, P1, size),
        right_maps=_maps(pair.right, R2, P2, size),
    )


@dataclass(frozen=True, kw_only=True)
class EpipolarResidual:
    """By how much the rows of matched features differ.

    Attributes:
        median_px: half of the matches differ by less; NaN without matches.
        p95_px: 95 % differ by less; NaN without matches.
        matches: how many there are.
        is_swapped: whether the left image looks like the right one.
    """

    median_px: float
    p95_px: float
    matches: int
    is_swapped: bool

    @property
    def is_known(self) -> bool:
        """Whether enough features matched to tell."""
        return self.matches >= _MIN_MATCHES


def epipolar_residual(shift_px: Float[np.ndarray, "n 2"]) -> EpipolarResidual:
    """Sum up the shifts of matched features (:func:`match_features`), of one pair or of many."""
    if not len(shift_px):
        return EpipolarResidual(median_px=math.nan, p95_px=math.nan, matches=0, is_swapped=False)
    rows_px, columns_px = np.abs(shift_px[:, 1]), shift_px[:, 0]
    clear = columns_px[np.abs(columns_px) > 1]
    is_swapped = len(clear) >= _MIN_MATCHES and (clear < 0).mean() <= _MAX_SWAPPED_SHARE
    return EpipolarResidual(
        median_px=float(np.median(rows_px)),
        p95_px=float(np.quantile(rows_px, 0.95)),
        matches=len(shift_px),
        is_swapped=bool(is_swapped),
    )


def match_features(
    left: Float32[Tensor, "3 h w"], right: Float32[Tensor, "3 h w"]
) -> Float[np.ndarray, "n 2"]:
    """Match SIFT features; give column and row of the right one less those of the left one [px].

    A match is each other's best by Lowe's ratio. Outliers are those that agree with no epipolar
    geometry (RANSAC); which one it is, rectified or not, is left open, so that a wrong
    rectification is seen.
    """
    cv2 = import_opencv("matching features")
    sift, matcher = cv2.SIFT_create(_FEATURES), cv2.BFMatcher()
    (one, first), (two, second) = (sift.detectAndCompute(_grey(i), None) for i in (left, right))
    if first is None or second is None or min(len(one), len(two)) < 2:
        return np.zeros((0, 2))
    there, back = (
        {m.queryIdx: m.trainIdx for m, n in found if m.distance < _RATIO * n.distance}
        for found in (matcher.knnMatch(first, second, k=2), matcher.knnMatch(second, first, k=2))
    )
    mutual = [(i, j) for i, j in there.items() if back.get(j) == i]
    if len(mutual) < 8:
        return np.zeros((0, 2))
    a, b = np.array([one[i].pt for i, _ in mutual]), np.array([two[j].pt for _, j in mutual])
    cv2.setRNGSeed(0)
    _, inlier = cv2.findFundamentalMat(a, b, cv2.FM_RANSAC, _RANSAC_PX, 0.999, 2000)
    return (b - a) if inlier is None else (b - a)[inlier.ravel() > 0]


def _warp(image: Float32[Tensor, "3 h w"], maps: Maps) -> Float32[Tensor, "3 h w"]:
    cv2 = import_opencv("rectifying a pair")
    pixels = np.ascontiguousarray(image.permute(1, 2, 0).numpy())
    warped = cv2.remap(pixels, *maps, cv2.INTER_CUBIC)
    return torch.from_numpy(warped).permute(2, 0, 1).clamp(0, 1).contiguous()


def _rig(P1: np.ndarray, P2: np.ndarray, size: Size) -> StereoRig:
    rig = camera_from_facts(facts_from_projections("the rectified pair", P1, P2, size), size)
    assert isinstance(rig, StereoRig), "two projections have a baseline"
    return rig


def _maps(camera: RawCamera, R: np.ndarray, P: np.ndarray, size: Size) -> Maps:
    cv2 = import_opencv("rectifying a pair")
    make = cv2.fisheye.initUndistortRectifyMap if camera.is_fisheye else cv2.initUndistortRectifyMap
    return make(*_numbers(camera), R, P[:, :3], size, cv2.CV_32FC1)


def _numbers(camera: RawCamera) -> tuple[np.ndarray, np.ndarray]:
    return camera.K.numpy(), np.array(camera.distortion)


def _grey(image: Float32[Tensor, "3 h w"]) -> np.ndarray:
    return np.ascontiguousarray((255 * grey_of(image)).round().clamp(0, 255).byte().numpy())
