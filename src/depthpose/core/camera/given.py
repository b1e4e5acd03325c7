"""What a caller knows of a camera, a file, a matrix, a mapping or a focal length, to one camera."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from depthpose.core.camera.camera_file import read_camera
from depthpose.core.camera.camera_json import facts_from_json
from depthpose.core.camera.facts import CameraFacts, Size, camera_from_facts
from depthpose.core.camera.model import Camera, check_intrinsics
from depthpose.core.errors import InputError

AnyCamera = (
    str | Path | Camera | Mapping[str, Any] | Sequence[Sequence[float]] | np.ndarray | Tensor
)
"""A camera, its file, what our JSON or BOP's holds as a dict, or its 3x3 matrix K alone."""
AnyLens = AnyCamera | float
"""The same, or the focal length alone [px]: the principal point is then the image's centre."""


def camera_of(camera: AnyLens | None, size: Size) -> Camera | None:
    """Make the camera of an image from what is known of it; None where nothing is.

    Args:
        camera: what is known. A dict without width and height, a matrix and a focal length take
            the size of the image.
        size: width and height of the image.

    Raises:
        InputError: it is no camera of this image.
    """
    if camera is None or isinstance(camera, Camera):
        return camera
    if isinstance(camera, str | Path):
        return read_camera(Path(camera), size)
    if isinstance(camera, int | float):
        return centred_camera(size, camera)
    facts = _from_mapping(camera, size) if isinstance(camera, Mapping) else _from_matrix(camera)
    return camera_from_facts(facts, size)


def choose_lens(camera: AnyLens | None, focal_px: float | None) -> AnyLens | None:
    """Give the one of the two that was given; None where neither was.

    Raises:
        InputError: both were.
    """
    if camera is not None and focal_px is not None:
        raise InputError("camera and focal_px are both given; leave one of the two away")
    return camera if focal_px is None else focal_px


def centred_camera(size: Size, focal_px: float) -> Camera:
    """Make the camera of which the focal length alone is known; its axis meets the centre.

    Raises:
        InputError: no focal length in pixels.
    """
    if not 1 < focal_px < 1e6:
        raise InputError(f"focal_px is {focal_px}: not a focal length in pixels; KITTI's is 721.5")
    width, height = size
    K = [[focal_px, 0, (width - 1) / 2], [0, focal_px, (height - 1) / 2], [0, 0, 1]]
    return Camera(width=width, height=height, K=torch.tensor(K, dtype=torch.float64))


def intrinsics_of(K: object) -> Float[Tensor, "3 3"]:
    """Take a 3x3 list, array or tensor of any real numbers as an intrinsic matrix, in float64.

    Raises:
        InputError: it is none.
    """
    values = K.detach().cpu().numpy() if isinstance(K, Tensor) else K
    try:
        matrix = torch.from_numpy(np.array("none" if K is None else values, dtype=np.float64))
    except (TypeError, ValueError) as error:
        raise InputError(
            f"camera is a {type(K).__name__}; give a Camera(width=, height=, K=), or a StereoRig "
            "for metres from a pair, its file, a dict of its keys, or the 3x3 matrix K"
        ) from error
    check_intrinsics(matrix)
    return matrix


def _from_matrix(K: object) -> CameraFacts:
    return CameraFacts(kind="a matrix K", K=intrinsics_of(K))


def _from_mapping(camera: Mapping[str, Any], size: Size) -> CameraFacts:
    keys = {key: np.asarray(value).tolist() for key, value in camera.items()}
    if {"width", "height"} & keys.keys():
        return facts_from_json(keys)
    # Without a size of its own the matrix may be that of another resolution: that is looked at.
    facts = facts_from_json({"width": size[0], "height": size[1], **keys})
    return replace(facts, size=None)
