"""A camera in any form that a caller of the package has it in, such as a matrix K or an angle."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from depthpose.core.camera.formats.camera_file import read_camera
from depthpose.core.camera.formats.camera_json import facts_from_json
from depthpose.core.camera.formats.facts import CameraFacts, camera_from_facts
from depthpose.core.camera.pinhole import Camera, Size, check_intrinsics, intrinsics
from depthpose.core.errors import InputError

_MAX_FOCAL_PX = 1e6  # larger numbers are no focal length

AnyCamera = (
    str | Path | Camera | Mapping[str, Any] | Sequence[Sequence[float]] | np.ndarray | Tensor
)
"""A camera, its file, a dict with the keys of depthpose's JSON or of BOP's, or its 3x3 matrix K."""


@dataclass(frozen=True)
class FieldOfView:
    """The horizontal angle that an image spans, in place of a focal length [degrees]."""

    degrees: float

    def __post_init__(self) -> None:
        """Refuse angles that no pinhole has."""
        if not 1 <= self.degrees <= 170:
            raise InputError(
                f"fov is {self.degrees:g} degrees; a pinhole camera spans 1 to 170 degrees from "
                "left to right"
            )


AnyLens = AnyCamera | FieldOfView | float | np.number[Any]
"""A camera in any form of ``AnyCamera``, or its focal length [px] or field of view alone: the
principal point is then the image's centre."""


def camera_of(camera: AnyLens | None, size: Size) -> Camera | None:
    """Convert a camera in any form to the camera of an image; None stays None.

    Args:
        camera: a camera, its file, a dict, a matrix, a focal length or a field of view. A dict
            without width and height, a matrix and a focal length take the size of the image.
        size: width and height of the image.

    Raises:
        InputError: it is no camera of this image.
    """
    if camera is None or isinstance(camera, Camera):
        return camera
    if isinstance(camera, str | Path):
        return read_camera(Path(camera), size)
    if isinstance(camera, FieldOfView):
        camera = size[0] / 2 / math.tan(math.radians(camera.degrees / 2))
    if isinstance(camera, np.generic | np.ndarray | Tensor) and camera.ndim == 0:
        camera = float(camera)
    if isinstance(camera, int | float):
        return _make_focal_camera(camera, size)
    if isinstance(camera, Mapping):
        keys = {key: np.asarray(value).tolist() for key, value in camera.items()}
        if {"width", "height"} & keys.keys():
            return camera_from_facts(facts_from_json(keys), size)
        facts = facts_from_json({"width": size[0], "height": size[1], **keys})
        # The size is not the dict's own, so that K is checked for another resolution.
        return camera_from_facts(replace(facts, size=None), size)
    return camera_from_facts(CameraFacts(kind="a matrix K", K=intrinsics_of(camera)), size)


def refuse_unusable_focal(focal_px: float) -> None:
    """Refuse a number that is no focal length [px]: that in millimetres, say.

    Raises:
        InputError: it is 1 or less, a million or more, or NaN.
    """
    if not 1 < focal_px < _MAX_FOCAL_PX:
        raise InputError(f"focal_px is {focal_px}: not a focal length in pixels; KITTI's is 721.5")


def _make_focal_camera(focal_px: float, size: Size) -> Camera:
    """Make the camera of a focal length [px], with the image's centre as principal point."""
    refuse_unusable_focal(focal_px)
    width, height = size
    K = intrinsics(focal_px, focal_px, (width - 1) / 2, (height - 1) / 2)
    return Camera(width=width, height=height, K=K)


def choose_lens(
    camera: AnyLens | None, focal_px: float | None, fov_deg: float | None = None
) -> AnyLens | None:
    """Return the one argument that is not None, or None where all are.

    Args:
        camera: a camera in any form.
        focal_px: focal length [px].
        fov_deg: horizontal field of view [degrees]; returned as :class:`FieldOfView`.

    Raises:
        InputError: more than one is set, or no pinhole has such a field of view.
    """
    fov = None if fov_deg is None else FieldOfView(fov_deg)
    arguments = {"camera": camera, "focal_px": focal_px, "fov_deg": fov}
    chosen = {name: lens for name, lens in arguments.items() if lens is not None}
    if len(chosen) > 1:
        first, second = list(chosen)[:2]
        raise InputError(f"{first} and {second} are both given; omit one of the two")
    return next(iter(chosen.values()), None)


def intrinsics_of(K: object) -> Float[Tensor, "3 3"]:
    """Convert a 3x3 list, array or tensor of any real numbers to an intrinsic matrix in float64.

    Raises:
        InputError: it is no intrinsic matrix.
    """
    values = K.detach().cpu().numpy() if isinstance(K, Tensor) else K
    try:
        # numpy would read None as NaN.
        matrix = torch.from_numpy(np.array("none" if K is None else values, dtype=np.float64))
        matrix = matrix.reshape(3, 3) if matrix.shape == (9,) else matrix
    except (TypeError, ValueError) as error:
        raise InputError(
            f"camera is a {type(K).__name__}; give a Camera(width=, height=, K=), or a StereoRig "
            "for metres from a pair, its file, a dict of its keys, or the 3x3 matrix K"
        ) from error
    check_intrinsics(matrix)
    return matrix
