"""Raw pairs with known cameras: a rectified pair seen by turned lenses that distort."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
import yaml

from depthpose.core.camera import RawCamera, RawPair, StereoRig
from depthpose.core.rigid import Rigid
from depthpose.depth.types import DepthInput

BENT = {False: (-0.25, 0.08, 0.001, -0.0005, 0.0), True: (0.05, -0.02, 0.01, 0.0)}
"""Distortion of a pinhole, and of a fisheye lens."""
TURNS = ((0.01, -0.012, 0.008), (-0.008, 0.01, -0.012))
"""Rotation vectors from each raw camera to the rectified frame [rad]."""


@dataclass(frozen=True, eq=False)
class DrawnPair:
    """A raw pair and how it was drawn.

    Attributes:
        left: the raw left image.
        right: the raw right image.
        pair: the calibration.
        turns: rotations from each raw camera to the rectified frame.
    """

    left: torch.Tensor
    right: torch.Tensor
    pair: RawPair
    turns: tuple[np.ndarray, np.ndarray]


def make_raw(seen: DepthInput, *, is_fisheye: bool = False) -> DrawnPair:
    """Draw a rectified pair as two turned lenses see it, in the size of the pair."""
    rig = seen.camera
    assert isinstance(rig, StereoRig)
    assert seen.right is not None
    f = float(rig.K[0, 0])
    turns = tuple(cv2.Rodrigues(np.array(turn))[0] for turn in TURNS)
    cameras = []
    for scale, shift_px in ((0.97, 1.5), (0.98, -2.0)):
        K = np.array([[scale * f, 0, rig.width / 2 + shift_px], [0, 1.01 * scale * f,
                     rig.height / 2 - shift_px], [0, 0, 1]])  # fmt: skip
        bent = tuple(scale * k for k in BENT[is_fisheye])
        cameras.append(RawCamera(K=torch.from_numpy(K), distortion=bent, is_fisheye=is_fisheye))
    along = np.array([-rig.baseline_m, 0, 0])
    motion = Rigid(*(torch.from_numpy(turns[1].T @ part) for part in (turns[0], along)))
    left, right = (
        _bend(image, rig.K.numpy(), camera, turn)
        for image, camera, turn in zip((seen.left, seen.right), cameras, turns, strict=True)
    )
    size = (rig.width, rig.height)
    pair = RawPair(left=cameras[0], right=cameras[1], right_from_left=motion, size=size)
    return DrawnPair(left, right, pair, (turns[0], turns[1]))


def _bend(image: torch.Tensor, K: np.ndarray, camera: RawCamera, turn: np.ndarray) -> torch.Tensor:
    """Draw a picture as a lens behind a turned camera sees it."""
    height, width = image.shape[1:]
    u, v = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    pixels = np.stack([u, v], -1).reshape(-1, 1, 2)
    undo = cv2.fisheye.undistortPoints if camera.is_fisheye else cv2.undistortPoints
    bent = np.array(camera.distortion)
    seen = undo(pixels, camera.K.numpy(), bent, R=turn, P=K).reshape(height, width, 2)
    x, y = np.ascontiguousarray(seen.astype(np.float32).transpose(2, 0, 1))
    source = np.ascontiguousarray(image.permute(1, 2, 0).numpy())
    drawn = cv2.remap(source, x, y, cv2.INTER_LANCZOS4)
    return torch.from_numpy(drawn).permute(2, 0, 1).clamp(0, 1).contiguous()


def opencv_names(pair: RawPair) -> dict[str, Any]:
    """What a user of OpenCV writes after ``stereoCalibrate``."""
    names: dict[str, Any] = {}
    for number, camera in enumerate((pair.left, pair.right), start=1):
        names[f"K{number}"] = camera.K.numpy()
        names[f"D{number}"] = np.array([camera.distortion])
    motion = pair.right_from_left
    return {**names, "R": motion.R.numpy(), "T": motion.t_m.numpy()[:, None]}


def write_opencv(path: Path, names: dict[str, Any], size: tuple[int, int] | None = None) -> Path:
    """Write matrices as OpenCV does (FileStorage)."""
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in names.items():
        storage.write(name, value)
    if size is not None:
        storage.write("image_width", size[0])
        storage.write("image_height", size[1])
    storage.release()
    return path


def write_kalibr(path: Path, pair: RawPair) -> Path:
    """Write a camchain as Kalibr does."""
    content: dict[str, Any] = {}
    for number, camera in enumerate((pair.left, pair.right)):
        K = camera.K
        content[f"cam{number}"] = {
            "camera_model": "pinhole",
            "intrinsics": [float(K[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2))],
            "distortion_model": "equidistant" if camera.is_fisheye else "radtan",
            "distortion_coeffs": list(camera.distortion[:4]),
            "resolution": list(pair.size or ()),
        }
    content["cam1"]["T_cn_cnm1"] = pair.right_from_left.matrix().tolist()
    path.write_text(yaml.safe_dump(content))
    return path


def write_ros(folder: Path, drawn: DrawnPair, baseline_m: float) -> Path:
    """Write left.yaml and right.yaml as ROS's calibrator does."""
    folder.mkdir()
    assert drawn.pair.size is not None
    width, height = drawn.pair.size
    sides = zip(("left", "right"), (drawn.pair.left, drawn.pair.right), drawn.turns, strict=True)
    for side, camera, turn in sides:
        P = np.hstack([camera.K.numpy(), np.zeros((3, 1))])
        P[0, 3] = -P[0, 0] * baseline_m if side == "right" else 0
        model = "equidistant" if camera.is_fisheye else "plumb_bob"
        matrices = {"camera_matrix": camera.K.numpy(), "rectification_matrix": turn,
                    "projection_matrix": P,
                    "distortion_coefficients": np.array([camera.distortion])}  # fmt: skip
        content: dict[str, Any] = {
            name: {"rows": len(one), "cols": one.shape[1], "data": one.ravel().tolist()}
            for name, one in matrices.items()
        }
        content |= {"image_width": width, "image_height": height, "distortion_model": model}
        (folder / f"{side}.yaml").write_text(yaml.safe_dump(content))
    return folder
