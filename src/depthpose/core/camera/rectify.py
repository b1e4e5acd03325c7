"""The calibration of two raw cameras (of ROS, OpenCV or Kalibr), and rectification by OpenCV."""

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float32, Float64
from torch import Tensor

from depthpose.core.camera.formats.camera_fields import (
    Fields,
    find_matrix,
    find_size,
    is_ros,
    is_ros_pair,
    normalise_keys,
    order_ros_pair,
    parse_numbers,
    parse_storage,
    read_pair_files,
)
from depthpose.core.camera.formats.camera_file import prefixed_errors
from depthpose.core.camera.formats.facts import (
    WIDE_BASELINE_M,
    camera_from_facts,
    facts_from_projections,
    refuse_baseline,
    refuse_unequal_focal_lengths,
)
from depthpose.core.camera.lens import is_fisheye_lens
from depthpose.core.camera.pinhole import Size, StereoRig, check_intrinsics, intrinsics
from depthpose.core.errors import InputError, Notice, import_opencv
from depthpose.core.files import AnyPath, read_json, read_text
from depthpose.core.files.disk import MAX_LIST_BYTES
from depthpose.core.rigid import Rigid, is_rotation

# Keys of OpenCV's calibrations, in lower case, letters and digits only.
_K = {
    "left": ("k1", "m1", "cameramatrix1", "cameramatrixleft", "leftcameramatrix"),
    "right": ("k2", "m2", "cameramatrix2", "cameramatrixright", "rightcameramatrix"),
}
_D = {
    "left": ("d1", "distcoeffs1", "distcoefs1", "distcoef1", "distortion1", "distcoeffsleft",
             "distortioncoefficients1", "distortioncoefficientsleft"),
    "right": ("d2", "distcoeffs2", "distcoefs2", "distcoef2", "distortion2", "distcoeffsright",
              "distortioncoefficients2", "distortioncoefficientsright"),
}  # fmt: skip
_R = ("r", "rotation", "rotationmatrix")
_T = ("t", "translation", "translationvector")
_PINHOLE_COUNTS = (4, 5, 8, 12, 14)  # numbers of distortion coefficients that OpenCV takes
_FISHEYE_COUNTS = (4,)
_MAX_BASELINE_M = 10.0  # where the user says the unit
_MIN_ROTATION_DEG = 0.2  # a smaller difference may be an error of the calibration
# R seems transposed if its transpose would turn the cameras by less than this share of what R does.
_TRANSPOSED_SHARE = 0.5
_MAX_ENLARGEMENT = 4  # largest ratio of fx after rectification to fx before
_MAX_FOCAL_RATIO = 1.5  # largest ratio of fx of a pair; a larger one is of images of two sizes
_ROTATION_TOLERANCE = 1e-3  # by which entries of R R^T may differ from those of the identity
_KNOWN = (
    "a camchain of Kalibr, OpenCV's K1, D1, K2, D2, R and T (in one file, or intrinsics.yml and "
    "extrinsics.yml in a folder), or a folder with left.yaml and right.yaml of ROS"
)


@dataclass(frozen=True, kw_only=True, eq=False)
class RawCamera:
    """A camera whose lens distorts."""

    K: Float64[Tensor, "3 3"]  #: intrinsic matrix [px]
    #: OpenCV's coefficients: k1, k2, p1, p2, k3, ... of a pinhole; k1 to k4 of a fisheye
    distortion: tuple[float, ...]
    is_fisheye: bool = False  #: an equidistant fisheye (Kannala and Brandt 2006), else a pinhole


@dataclass(frozen=True, kw_only=True, eq=False)
class RawPair:
    """The calibration of two cameras whose images are not rectified."""

    left: RawCamera  #: the left camera
    right: RawCamera  #: the right one
    right_from_left: Rigid  #: carries points from the left camera's frame to the right one's [m]
    size: Size | None  #: width and height of both images [px]; None where the file does not say it


def read_raw_pair(
    path: AnyPath, *, unit_m: float | None = None, is_fisheye: bool | None = None
) -> RawPair:
    """Read the calibration of a pair: of OpenCV, ROS or Kalibr, recognised by its content.

    Args:
        path: the file, or the folder of the pair's two files.
        unit_m: length of a unit of the translation between the cameras [m]; None: it is in metres,
            and refused if the cameras then stand farther apart than those of common rigs.
        is_fisheye: whether lenses are fisheyes that the file does not name (OpenCV's does not);
            None: they are pinholes.

    Raises:
        InputError: the file is missing or damaged, does not describe two cameras, names another
            lens model, or a value cannot be right: the rotation, the distance, the order.

    Warns:
        Notice: the rotation seems transposed.
    """
    with prefixed_errors(path):
        pair = _read_pair(Path(path), unit_m or 1.0, is_fisheye)
        R = pair.right_from_left.R

        # The distance of the cameras, and the rotation between them.
        baseline_m = float(pair.right_from_left.t_m.norm())
        if not baseline_m:
            raise InputError("T is 0: both cameras stand in one place; calibrate as a pair")
        remedy = "--unit cm or mm scales it, and --unit m says that it is in metres"
        refuse_baseline(baseline_m, remedy, _MAX_BASELINE_M if unit_m else WIDE_BASELINE_M)
        if not is_rotation(R, _ROTATION_TOLERANCE):
            raise InputError(f"R is {R.tolist()}, which is no rotation; copy it anew")
        _warn_if_transposed(path, pair.right_from_left)

        # The position of the second camera in the frame of the first.
        x, y, z = pair.right_from_left.inverse().t_m.tolist()
        if abs(x) < max(abs(y), abs(z)):
            raise InputError(
                f"the second camera stands at ({x:g}, {y:g}, {z:g}) m of the first, above or "
                "before it more than beside it; turn the images by 90 degrees and calibrate those"
            )
        if x < 0:
            raise InputError(
                "its second camera stands to the left of its first; exchange the two in the file: "
                "R becomes its transpose, T becomes -R^T T"
            )
        return pair


def _warn_if_transposed(path: AnyPath, right_from_left: Rigid) -> None:
    """Warn if R turns the cameras far more away from their baseline than its transpose would.

    Where that is a rotation about the vertical, it changes only disparities: rows agree all the
    same, and the check of the rectified pair finds nothing.
    """
    R = right_from_left.R
    t_m = right_from_left.t_m
    # The baseline is t in the right camera's frame, and R^T t in the left one's.
    right_deg = _measure_baseline_angle(t_m)
    as_read_deg = _measure_baseline_angle(R.mT @ t_m) + right_deg
    transposed_deg = _measure_baseline_angle(R @ t_m) + right_deg
    is_far_less = transposed_deg < _TRANSPOSED_SHARE * as_read_deg
    if is_far_less and as_read_deg - transposed_deg > _MIN_ROTATION_DEG:
        message = (
            f"{path}: is R transposed? By it the cameras are turned {as_read_deg:.2f} degrees from "
            f"the line between them, with its transpose by {transposed_deg:.2f}; it carries points "
            "of camera 1 to camera 2. Compare a measured distance"
        )
        warnings.warn(message, Notice, stacklevel=3)


def _measure_baseline_angle(baseline_m: Tensor) -> float:
    """Compute the angle between the baseline, in a camera's frame, and the camera's rows [deg]."""
    off_axis_m = float(baseline_m[1:].norm())
    return math.degrees(math.atan2(off_axis_m, abs(float(baseline_m[0]))))


def _read_pair(path: Path, unit_m: float, is_fisheye: bool | None) -> RawPair:
    """Read the calibration of a pair: two files of ROS or OpenCV in a folder, or one file.

    Its values are not checked. Arguments are those of :func:`read_raw_pair`.
    """
    if path.is_dir():
        first, second = read_pair_files(path)
        if is_ros_pair(first, second):
            return _read_ros_pair(first, second, unit_m, is_fisheye)
        return _read_opencv_pair(first | second, unit_m, is_fisheye)
    text = read_text(path, MAX_LIST_BYTES)
    is_json = text.lstrip()[:1] == "{"
    content = read_json(path) if is_json else None
    fields = normalise_keys(content) if isinstance(content, Mapping) else parse_storage(path, text)
    if fields is None:
        raise InputError(f"no calibration of two cameras; known are {_KNOWN}")
    if "cam0" in fields:
        return _read_kalibr_pair(fields, unit_m, is_fisheye)
    return _read_opencv_pair(fields, unit_m, is_fisheye)


def _read_ros_pair(
    first: Fields, second: Fields, unit_m: float, is_fisheye: bool | None
) -> RawPair:
    """Read ROS's two ``camera_info``, whose R and P describe the rectified pair.

    Each R carries points from a raw camera to the rectified one, and the rectified cameras differ
    in x alone. So ``right_from_left`` has the rotation ``R_right^T R_left`` and the translation
    ``R_right^T (x_left - x_right, 0, 0)``.
    """
    pair = order_ros_pair(first, second)
    xs: list[float] = []  # x of both rectified cameras, in the frame of the left or of a third one
    for fields in pair:
        P = find_matrix(fields, ("projectionmatrix", "p"), 12)
        if P is None or P[0, 0] <= 0:
            raise InputError("no projection_matrix with a focal length; calibrate as a pair")
        xs.append(-P[0, 3] / P[0, 0])
    cameras: list[RawCamera] = []
    rotations: list[np.ndarray] = []
    for side, fields in zip(("left", "right"), pair, strict=True):
        K = find_matrix(fields, ("cameramatrix", "k"), 9)
        D = _find_numbers(fields, ("distortioncoefficients", "d"))
        has_fisheye = _choose_lens_model(fields, is_fisheye)
        cameras.append(_make_camera(K, D, has_fisheye, f"the {side} camera"))
        R = find_matrix(fields, ("rectificationmatrix", "r"), 9)
        if R is None:
            raise InputError(f"no rectification_matrix of the {side} camera; write the whole pair")
        rotations.append(R)
    left_R, right_R = rotations
    left_x, right_x = xs
    translation_m = np.array([unit_m * (left_x - right_x), 0, 0])
    motion = _make_rigid(right_R.T @ left_R, right_R.T @ translation_m)
    return _make_pair(cameras[0], cameras[1], motion, find_size(first))


def _read_opencv_pair(fields: Fields, unit_m: float, is_fisheye: bool | None) -> RawPair:
    """Read OpenCV's ``stereoCalibrate``, whose R and T carry points of camera 1 to camera 2."""
    if not any(key in fields for side_keys in _K.values() for key in side_keys):
        reason = "it has no camera matrices K1 and K2"
        if is_ros(fields) or "cameramatrix" in fields:
            reason = "it describes a single camera"
        raise InputError(f"{reason}; give the calibration of a pair: {_KNOWN}")

    have_fisheyes = _choose_lens_model(fields, is_fisheye)
    cameras: list[RawCamera] = []
    for side in ("left", "right"):
        K = find_matrix(fields, _K[side], 9)
        D = _find_numbers(fields, _D[side])
        cameras.append(_make_camera(K, D, have_fisheyes, f"the {side} camera"))
    left, right = cameras

    R = find_matrix(fields, _R, 9)
    T = _find_numbers(fields, _T)
    if R is None or T is None or len(T) != 3:
        raise InputError("no R of 9 numbers and T of 3, from camera 1 to 2; write both")
    return _make_pair(left, right, _make_rigid(R, unit_m * np.array(T)), find_size(fields))


def _read_kalibr_pair(fields: Fields, unit_m: float, is_fisheye: bool | None) -> RawPair:
    """Read Kalibr's camchain, whose ``T_cn_cnm1`` carries points of cam0 to cam1."""
    if not all(isinstance(fields.get(owner), Mapping) for owner in ("cam0", "cam1")):
        raise InputError("a camchain without cam0 and cam1; calibrate both cameras together")
    first = normalise_keys(fields["cam0"])
    second = normalise_keys(fields["cam1"])
    motion = find_matrix(second, ("tcncnm1",), 16)
    if motion is None:
        raise InputError("cam1 has no T_cn_cnm1 of 16 numbers; calibrate both cameras together")
    resolution = parse_numbers(first.get("resolution"))
    if resolution != parse_numbers(second.get("resolution")):
        raise InputError("cam0 and cam1 have images of two sizes; a pair has one")
    size = None if resolution is None else (int(resolution[0]), int(resolution[-1]))
    cameras: list[RawCamera] = []
    for camera, owner in ((first, "cam0"), (second, "cam1")):
        has_fisheye = _choose_lens_model(camera, is_fisheye, f"{owner}'s")
        values = parse_numbers(camera.get("intrinsics"))
        if values is None or len(values) != 4:
            raise InputError(f"{owner} has no intrinsics [fx, fy, cx, cy]; copy the camchain anew")
        D = parse_numbers(camera.get("distortioncoeffs"))
        cameras.append(_make_camera(intrinsics(*values).numpy(), D, has_fisheye, owner))
    right_from_left = _make_rigid(motion[:3, :3], unit_m * motion[:3, 3])
    return _make_pair(cameras[0], cameras[1], right_from_left, size)


def _find_numbers(fields: Fields, keys: tuple[str, ...]) -> list[float] | None:
    """Return the numbers of the first of some keys that has any; None where none has."""
    for key in keys:
        values = parse_numbers(fields.get(key))
        if values:
            return values
    return None


def _choose_lens_model(fields: Fields, is_fisheye: bool | None, owner: str = "its") -> bool:
    """Decide whether a lens is a fisheye: as its file says, else as the user does.

    Args:
        fields: values of the file.
        is_fisheye: what the user says; None: nothing, so that the lens is a pinhole.
        owner: whose lens it is, for errors.

    Raises:
        InputError: the user calls a lens a fisheye that the file calls a pinhole.
    """
    is_named_fisheye = is_fisheye_lens(fields, owner)
    if is_fisheye and is_named_fisheye is False:
        raise InputError(
            f"{owner} distortion model is that of a pinhole, no fisheye; omit --fisheye"
        )
    return bool(is_fisheye) if is_named_fisheye is None else is_named_fisheye


def _make_camera(
    K: np.ndarray | None, distortion: list[float] | None, is_fisheye: bool, owner: str
) -> RawCamera:
    """Make a raw camera of the values of a file.

    Args:
        K: intrinsic matrix; None: the file has none.
        distortion: coefficients; None: the file has none.
        is_fisheye: whether the lens is a fisheye.
        owner: what errors call the camera.

    Raises:
        InputError: K or the distortion is missing, or not of the lens model.
    """
    if K is None:
        raise InputError(f"no camera matrix of 9 numbers of {owner}; write K1 and K2")
    if distortion is None:
        raise InputError(f"no distortion of {owner}; write D1 and D2, zeros where a lens has none")
    counts = _FISHEYE_COUNTS if is_fisheye else _PINHOLE_COUNTS
    if len(distortion) not in counts:
        model = "a fisheye lens" if is_fisheye else "a pinhole with distortion"
        raise InputError(
            f"{owner} has {len(distortion)} coefficients of distortion, and {model} has "
            f"{' or '.join(map(str, counts))}; look at its model"
        )
    matrix = torch.from_numpy(np.ascontiguousarray(K, np.float64))
    check_intrinsics(matrix)
    refuse_unequal_focal_lengths(matrix)
    return RawCamera(K=matrix, distortion=tuple(distortion), is_fisheye=is_fisheye)


def _make_rigid(R: np.ndarray, t_m: np.ndarray) -> Rigid:
    """Make a transform of numpy's R and t, in float64."""
    return Rigid(
        torch.from_numpy(np.array(R, np.float64)), torch.from_numpy(np.array(t_m, np.float64))
    )


def _make_pair(
    left: RawCamera, right: RawCamera, right_from_left: Rigid, size: Size | None
) -> RawPair:
    """Make a pair of two raw cameras, of one lens model and of images of one size.

    Raises:
        InputError: the cameras cannot be those of one pair.
    """
    if left.is_fisheye != right.is_fisheye:
        raise InputError("one lens is a fisheye and the other is none; calibrate both as one kind")
    left_fx = float(left.K[0, 0])
    right_fx = float(right.K[0, 0])
    if not 1 / _MAX_FOCAL_RATIO < left_fx / right_fx < _MAX_FOCAL_RATIO:
        raise InputError(
            f"fx is {left_fx:g} on the left and {right_fx:g} on the right, as of images of two "
            "sizes; scale one camera matrix and its images to those of the other"
        )
    return RawPair(left=left, right=right, right_from_left=right_from_left, size=size)


class RemapTables(NamedTuple):
    """Where each pixel of a rectified image lies in the raw one [px]."""

    column: Float32[np.ndarray, "h w"]
    row: Float32[np.ndarray, "h w"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Rectifier:
    """Rectifies the images of a calibrated pair."""

    rig: StereoRig  #: the camera of the rectified pair
    #: rotation from the frame of the raw left camera to that of the rectified one, by which a pose
    #: that is calibrated to the raw camera (of a LiDAR, say) is carried along
    rectified_from_raw: Rigid
    left_tables: RemapTables  #: of the left image
    right_tables: RemapTables  #: of the right image

    def rectify(
        self,
        left: Float32[Tensor, "3 _ _"],
        right: Float32[Tensor, "3 _ _"],
        names: Sequence[str] = ("the left image", "the right image"),
    ) -> tuple[Float32[Tensor, "3 h w"], Float32[Tensor, "3 h w"]]:
        """Rectify the two images of a pair; what a raw image does not show is black.

        Args:
            left: the raw left image, RGB in [0, 1].
            right: the raw right one.
            names: what errors call the two.

        Raises:
            InputError: an image is not of the calibration's size.
        """
        cv2 = import_opencv("rectifying a pair")
        size = (self.rig.width, self.rig.height)
        warped: list[Tensor] = []
        views = zip((left, right), names, (self.left_tables, self.right_tables), strict=True)
        for image, name, tables in views:
            if (image.shape[2], image.shape[1]) != size:
                raise InputError(
                    f"{name} is {image.shape[2]}x{image.shape[1]}, but the cameras were calibrated "
                    f"at {size[0]}x{size[1]}; give the raw images in that size"
                )
            pixels = np.ascontiguousarray(image.permute(1, 2, 0).numpy())
            cubic = torch.from_numpy(cv2.remap(pixels, *tables, cv2.INTER_CUBIC))
            warped.append(cubic.permute(2, 0, 1).clamp(0, 1).contiguous())
        return warped[0], warped[1]


def make_rectifier(pair: RawPair, size: Size, keep: float = 0.0) -> Rectifier:
    """Compute the rectification of a pair by Bouguet's method (OpenCV's ``stereoRectify``).

    Args:
        pair: the calibration.
        size: width and height of the images [px], for calibrations without it.
        keep: 0 crops to what both raw images show; 1 keeps all that they show, with black borders;
            numbers between are between.

    Raises:
        InputError: ``keep`` is out of range, or a distortion that no lens has.
        MissingExtraError: OpenCV is not installed.
    """
    cv2 = import_opencv("rectifying a pair")
    if not 0 <= keep <= 1:
        raise InputError(f"--keep {keep:g}: 0 keeps what both lenses show, 1 keeps all; take 0")
    size = pair.size or size
    R = pair.right_from_left.R.numpy()
    t = pair.right_from_left.t_m[:, None].numpy()
    # Intrinsic matrix and distortion of each camera, as OpenCV's functions take them.
    left = (pair.left.K.numpy(), np.array(pair.left.distortion))
    right = (pair.right.K.numpy(), np.array(pair.right.distortion))

    # OpenCV's rotations R1 and R2 to the rectified cameras, whose projections are P1 and P2.
    flags = cv2.CALIB_ZERO_DISPARITY
    make_tables = cv2.initUndistortRectifyMap
    if pair.left.is_fisheye:
        make_tables = cv2.fisheye.initUndistortRectifyMap
        R1, R2, P1, P2, *_ = cv2.fisheye.stereoRectify(
            *left, *right, size, R, t, flags, newImageSize=size, balance=keep
        )
    else:
        R1, R2, P1, P2, *_ = cv2.stereoRectify(*left, *right, size, R, t, flags=flags, alpha=keep)

    # The rig; images are enlarged by so much only where the calibration is wrong.
    rig = camera_from_facts(facts_from_projections("the rectified pair", P1, P2, size), size)
    assert isinstance(rig, StereoRig), "two projections have a baseline"
    raw_px = float(pair.left.K[0, 0])
    rectified_px = float(rig.K[0, 0])
    if rectified_px > _MAX_ENLARGEMENT * raw_px:
        raise InputError(
            f"rectified, fx would be {rectified_px:.0f} px where the raw lens has {raw_px:.0f}: so "
            f"much no lens bends; check the distortion {pair.left.distortion} and the rotation, or "
            "whether the lens is a fisheye (--fisheye)"
        )
    return Rectifier(
        rig=rig,
        rectified_from_raw=Rigid(torch.from_numpy(R1), torch.zeros(3).double()),
        left_tables=RemapTables(*make_tables(*left, R1, P1[:, :3], size, cv2.CV_32FC1)),
        right_tables=RemapTables(*make_tables(*right, R2, P2[:, :3], size, cv2.CV_32FC1)),
    )
