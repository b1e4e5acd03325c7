"""Messages as plain dataclasses, and their contents as arrays: nothing here needs ROS.

The fields are those of ``std_msgs``, ``sensor_msgs``, ``geometry_msgs`` and ``vision_msgs``, so
that a message of rclpy is read as it is, and :mod:`depthpose_ros.nodes` copies an answer field by
field.
"""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from depthpose.core.camera import Camera, StereoRig
from depthpose.core.camera.formats.camera_fields import (
    facts_from_fields,
    facts_from_ros_pair,
    normalise_keys,
)
from depthpose.core.camera.formats.facts import CameraFacts, camera_from_facts
from depthpose.core.errors import InputError, refuse_unknown
from depthpose.core.files.images import scale_16_bit
from depthpose.core.rigid import Rigid, cross_matrix
from depthpose.pose.predictions import score_of
from depthpose.pose.types import ObjectModel, PoseEstimate


@dataclass
class Stamp:
    """``builtin_interfaces/Time``."""

    sec: int = 0
    nanosec: int = 0


@dataclass
class Header:
    """``std_msgs/Header``."""

    stamp: Stamp = field(default_factory=Stamp)
    frame_id: str = ""


@dataclass
class Image:
    """``sensor_msgs/Image``."""

    header: Header
    height: int
    width: int
    encoding: str
    is_bigendian: int
    step: int
    data: bytes


@dataclass
class Pose:
    """``geometry_msgs/PoseStamped``, flat: metres, and a quaternion."""

    header: Header
    position: tuple[float, float, float]
    orientation: tuple[float, float, float, float]


@dataclass
class Hypothesis:
    """``vision_msgs/ObjectHypothesisWithPose``, flat."""

    class_id: str
    score: float
    pose: Pose
    covariance: tuple[float, ...]  #: 36 numbers: x, y, z, and turns about these axes


@dataclass
class Detection:
    """``vision_msgs/Detection3D``: its hypotheses, the likeliest first, and the box about it."""

    header: Header
    results: list[Hypothesis]
    centre: Pose
    size: tuple[float, float, float]


_PICTURES = {"rgb8": (0, 1, 2), "bgr8": (2, 1, 0), "rgba8": (0, 1, 2), "bgra8": (2, 1, 0)}
_GREYS = {"mono8": np.uint8, "8UC1": np.uint8, "mono16": np.uint16}
DEPTHS = {"32FC1": np.float32, "16UC1": np.uint16}
"""Depth images: metres, and millimetres (REP 118)."""
_MM = 0.001


def picture_of(message: Any) -> np.ndarray:  # noqa: ANN401  ROS's classes carry no types
    """Give a colour or grey picture as RGB (H, W, 3), or grey (H, W), 8 bit or floats in [0, 1].

    Raises:
        InputError: another encoding (Bayer images are to be debayered first), or too few bytes.
    """
    refuse_unknown("encoding of an image", message.encoding, [*_PICTURES, *_GREYS])
    if message.encoding in _PICTURES:
        channels = 4 if "a" in message.encoding else 3
        values = _rows(message, np.uint8, channels)
        return np.ascontiguousarray(values[..., _PICTURES[message.encoding]])
    grey = _rows(message, _GREYS[message.encoding], 1)[..., 0]
    if grey.dtype == np.uint8:
        return grey
    return scale_16_bit(grey, message.header.frame_id or "image")


def depth_of(message: Any) -> np.ndarray:  # noqa: ANN401
    """Give a depth image in metres (H, W), NaN where nothing is known.

    Raises:
        InputError: another encoding than 32FC1 and 16UC1, or too few bytes.
    """
    refuse_unknown("encoding of a depth image", message.encoding, DEPTHS)
    depth = _rows(message, DEPTHS[message.encoding], 1)[..., 0].astype(np.float32)
    if message.encoding == "16UC1":
        depth *= np.float32(_MM)
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(np.nan))


def mask_of(message: Any) -> np.ndarray:  # noqa: ANN401
    """Give a mask (H, W), 0 outside the object, or a number for each of several.

    Raises:
        InputError: another encoding than mono8 and 8UC1, or too few bytes.
    """
    refuse_unknown("encoding of a mask", message.encoding, ["mono8", "8UC1"])
    return _rows(message, np.uint8, 1)[..., 0]


def image_from_depth(header: Header, depth_m: torch.Tensor, encoding: str) -> Image:
    """Make a depth image; 16UC1 holds 65.535 m at most, what is farther is unknown there.

    Args:
        header: of the image that it was made from: its stamp and frame.
        depth_m: (H, W), NaN where nothing is known.
        encoding: 32FC1 or 16UC1.
    """
    refuse_unknown("encoding", encoding, DEPTHS)
    values = depth_m.cpu().numpy().astype("<f4")
    if encoding == "16UC1":
        mm = np.rint(np.nan_to_num(values.astype(np.float64) / _MM))
        values = np.where((mm >= 1) & (mm <= 65535), mm, 0).astype("<u2")
    height, width = values.shape
    step = width * values.itemsize
    return Image(header, height, width, encoding, 0, step, values.tobytes())


def camera_of(info: Any) -> Camera:  # noqa: ANN401
    """Give the camera of rectified images: P of ``sensor_msgs/CameraInfo``, or K where P is empty.

    It is that of the published image: cut to the ROI of the message, and binned.

    Raises:
        InputError: no calibration, K alone with distortion, or values that no camera has.
    """
    return camera_from_facts(_facts(info), None)


def rig_of(left: Any, right: Any) -> StereoRig:  # noqa: ANN401
    """Give the rectified rig; the right camera's P holds -fx times the baseline.

    Raises:
        InputError: as :func:`camera_of`, no baseline, or two infos of different rectifications.
    """
    _facts(left)
    P, Q = (np.array(info.p, np.float64).reshape(3, 4) for info in (left, right))
    if not Q[0, 0] > 0 or not P[0, 3] / max(P[0, 0], 1e-9) > Q[0, 3] / Q[0, 0]:
        raise InputError(
            "the right camera_info has no -fx * baseline in P[3]: is it of the left camera, or is "
            "the pair not calibrated?"
        )
    rig = camera_from_facts(facts_from_ros_pair(*map(_names, (left, right))), None)
    assert isinstance(rig, StereoRig)
    return rig


def _names(info: Any) -> dict[str, Any]:  # noqa: ANN401
    """Name the values as files of ROS do; without the lens, which P is free of."""
    roi = getattr(info, "roi", None)
    window = {key: getattr(roi, key, 0) for key in ("x_offset", "y_offset", "width", "height")}
    fields = {"width": info.width, "height": info.height, "p": list(info.p), "k": list(info.k)}
    binning = {key: getattr(info, key, 0) for key in ("binning_x", "binning_y")}
    return normalise_keys({**fields, **binning, "roi": window})


def _facts(info: Any) -> CameraFacts:  # noqa: ANN401
    if not info.p[0] > 0 and any(abs(k) > 0 for k in info.d):
        raise InputError(
            "camera_info has distortion and no P: calibrate, and give rectified images (image_proc)"
        )
    if not (info.p[0] > 0 or info.k[0] > 0):
        raise InputError("camera_info holds no K and no P: the camera is not calibrated")
    # Where the camera stands in its rig does not matter for its own images.
    projection = [*info.p[:3], 0.0, *info.p[4:7], 0.0, *info.p[8:]] if info.p[0] > 0 else None
    facts = facts_from_fields(_names(info) | {"p": projection})
    assert facts is not None
    return facts


def topic_names(objects: Sequence[str]) -> dict[str, str]:
    """Name the topics of objects: letters, digits and underscores, and no digit in front.

    Raises:
        InputError: two objects would have one topic.
    """
    names: dict[str, str] = {}
    for object in objects:
        name = re.sub(r"\W", "_", object, flags=re.ASCII)
        name = f"_{name}" if name[:1].isdigit() else name
        if name in names.values():
            raise InputError(
                f"object {object!r} would have the topic {name!r}, as another one has; rename its "
                "CAD file"
            )
        names[object] = name
    return names


def pose_from_rigid(header: Header, pose: Rigid) -> Pose:
    """Make a pose of the object in the frame of the depth image."""
    x, y, z = (float(v) for v in pose.t_m)
    quaternion = Rotation.from_matrix(pose.R.double().cpu().numpy()).as_quat()
    qx, qy, qz, qw = (float(v) for v in quaternion)
    return Pose(header, (x, y, z), (qx, qy, qz, qw))


def covariance_of(estimate: PoseEstimate) -> tuple[float, ...]:
    """Give the covariance as ``geometry_msgs/PoseWithCovariance`` has it: place, then rotation.

    That of an estimate is of a motion about the camera's origin; ROS's is of the place of the
    object, and of turns about the camera's axes there. A turn that a symmetry leaves free has the
    variance of an even distribution. All are 0, which says that nothing is known, where the
    estimate has none.
    """
    if estimate.covariance is None or estimate.camera_from_model is None:
        return (0.0,) * 36
    covariance = estimate.covariance.double().cpu()
    for motion in [] if estimate.free_motions is None else estimate.free_motions.double().cpu():
        turn = float(motion[:3].norm())
        if turn > 0:
            covariance = covariance + math.pi**2 / 3 / turn**2 * torch.outer(motion, motion)
    place_m = estimate.camera_from_model.t_m.double().cpu()
    eye = torch.eye(3, dtype=torch.float64)
    moved = torch.cat([-cross_matrix(place_m), eye], 1)  # a turn moves the place by turn x place
    change = torch.cat([moved, torch.cat([eye, torch.zeros(3, 3).double()], 1)])
    return tuple((change @ covariance @ change.mT).flatten().tolist())


def detection_from(header: Header, estimate: PoseEstimate, model: ObjectModel) -> Detection:
    """Make a detection of an estimate that has a pose; its alternatives are further hypotheses.

    The covariance of an alternative is not known.
    """
    assert estimate.camera_from_model is not None
    low, high = model.vertices_m.amin(0).double(), model.vertices_m.amax(0).double()
    centre = Rigid(torch.eye(3).double(), (low + high) / 2)
    poses = [(estimate.camera_from_model, score_of(estimate), covariance_of(estimate))]
    poses += [(o.camera_from_model, o.probability, (0.0,) * 36) for o in estimate.alternatives]
    results = [
        Hypothesis(estimate.object, score, pose_from_rigid(header, pose), covariance)
        for pose, score, covariance in poses
    ]
    x, y, z = (high - low).tolist()
    boxed = estimate.camera_from_model.double() @ centre
    return Detection(header, results, pose_from_rigid(header, boxed), (x, y, z))


def copied_header(message: Any) -> Header:  # noqa: ANN401
    """Take stamp and frame over, whatever class they are of."""
    stamp = message.header.stamp
    return Header(Stamp(stamp.sec, stamp.nanosec), message.header.frame_id)


def _rows(message: Any, dtype: type, channels: int) -> np.ndarray:  # noqa: ANN401
    """Give the pixels (H, W, channels); rows may be longer than their pixels (``step``)."""
    kind = np.dtype(dtype).newbyteorder(">" if message.is_bigendian else "<")
    height, width, step = message.height, message.width, message.step
    data = np.frombuffer(bytes(message.data), np.uint8)
    used = width * channels * kind.itemsize
    if height * width == 0 or step < used or len(data) < height * step:
        raise InputError(
            f"an image of {width}x{height} {message.encoding} with rows of {step} bytes needs "
            f"{height * max(step, used)} bytes, and there are {len(data)}"
        )
    rows = data[: height * step].reshape(height, step)[:, :used]
    values = np.ascontiguousarray(rows).view(kind).reshape(height, width, channels)
    return values.astype(dtype)
