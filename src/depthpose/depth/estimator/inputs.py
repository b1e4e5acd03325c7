"""What an estimate can take: pictures of any form, pairs that are pairs."""

import warnings
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Shaped
from PIL.Image import Image
from torch import Tensor

from depthpose.core.arrays import check_image
from depthpose.core.camera import (
    AnyLens,
    StereoRig,
    camera_of,
    check_image_matches_camera,
    check_rectified,
)
from depthpose.core.errors import InputError, Notice
from depthpose.core.files import picture_tensor, read_exif_focal, read_image
from depthpose.depth.types import StereoInput, View

Picture = str | Path | Image | Shaped[Tensor, "..."] | Shaped[np.ndarray, "..."]
"""A file, a picture of Pillow's, an array or a tensor: RGB, RGBA (alpha is dropped) or grey, whole
numbers of 8 bits or floats in [0, 1], (H, W, C), (C, H, W) or (H, W). The order of the channels
cannot be seen in the values: OpenCV reads BGR, which ``image[..., ::-1]`` turns into RGB."""
_CHANNELS = (1, 3, 4)
_VALUES = (
    "give 8-bit numbers, or floats in [0, 1]: divide by the largest value that it can hold (65535 "
    "of 16 bits)"
)


def as_tensor(image: object, name: str = "the image") -> View:
    """Read a :data:`Picture`, or bring it to RGB in [0, 1]; a batch of one is its image."""
    match image:
        case str() | Path():
            return read_image(Path(image))
        case Image():
            return picture_tensor(image, name)
        case np.ndarray() if image.dtype != np.uint8 and image.dtype.kind != "f":
            raise InputError(f"{name} is an array of {image.dtype}; {_VALUES}")
        case np.ndarray():
            kind = np.uint8 if image.dtype == np.uint8 else np.float32
            values = torch.from_numpy(np.require(image, kind, requirements=["C", "W"]))
            return _rgb(values, (-1, 0), f"{name} is an array")
        case Tensor() if image.dtype != torch.uint8 and not image.is_floating_point():
            raise InputError(f"{name} is a tensor of {image.dtype}; {_VALUES}")
        case Tensor():
            return _rgb(image, (0, -1), f"{name} is a tensor")
        case _:
            return check_image(image, name)


def _rgb(values: Tensor, sides: tuple[int, int], what: str) -> View:
    """Bring three channels in [0, 1] to the front."""
    shape = tuple(values.shape)
    if values.ndim == 4 and shape[0] != 1:
        raise InputError(
            f"{what} of shape {shape}, a batch; give one image, or the batch to "
            "estimate_many(batch, camera)"
        )
    one = values[0] if values.ndim == 4 else values
    planes = one[None] if one.ndim == 2 else one
    found = (k for k in sides if planes.ndim == 3 and planes.shape[k] in _CHANNELS)
    side = 0 if one.ndim == 2 else next(found, None)
    if side is None:
        raise InputError(f"{what} of shape {shape}; give (H, W, 3), (3, H, W) or grey (H, W)")
    planes = planes.movedim(side, 0)[:3]
    scaled = planes.float() / 255 if planes.dtype == torch.uint8 else planes.float()
    return check_image(scaled.expand(3, -1, -1), what.partition(" is ")[0])


def as_input(
    image: object, name: str, camera: AnyLens | None, *, with_exif: bool = True
) -> StereoInput:
    """Take a picture and what is known of its camera; without that, ask the picture's EXIF.

    What is an input already stays it.
    """
    if isinstance(image, StereoInput):
        return image
    left = as_tensor(image)
    if camera is None and with_exif:
        camera = exif_focal_px(image, name)
    camera = camera_of(camera, (left.shape[2], left.shape[1]))
    return StereoInput(name=name, left=left, right=None, camera=camera)


def exif_focal_px(image: object, name: str) -> float | None:
    """Give the focal length of a photograph's EXIF [px], with a :class:`Notice` of it, or None."""
    found = read_exif_focal(image) if isinstance(image, str | Path | Image) else None
    if found is None:
        return None
    said = f"{name}: a focal length of {found[0]:.0f} px, by its EXIF ({found[1]})"
    warnings.warn(f"{said}; of a cropped picture it is another", Notice, stacklevel=4)
    return found[0]


def refuse_unrectified(pair: StereoInput) -> str:
    """Raise where two images are no pair, are swapped, or their rows do not correspond.

    Returns:
        A warning where this cannot be told, else nothing.

    Raises:
        InputError: with what was measured and what to do.
    """
    right, camera = usable_right(pair), pair.camera
    apart_px = camera.cx_right_minus_left_px if isinstance(camera, StereoRig) else 0.0
    report = check_rectified(pair.left, right, apart_px)
    if report.is_wrong:
        raise InputError(
            f"{pair.name}: {report.message} (--no-check, in Python with_check=False, matches them "
            "all the same.)"
        )
    return report.message if report.is_rectified is None else ""


def usable_right(pair: StereoInput) -> View:
    """Give the right view of a pair that can be matched.

    Raises:
        InputError: there is none, its size is another, the camera has no baseline, or an image
            does not lie in [0, 1].
    """
    if pair.right is None:
        raise InputError(f"{pair.name}: there is no right image; give right=.")
    check_image(pair.left, f"{pair.name}: the left image")
    check_image(pair.right, f"{pair.name}: the right image")
    if pair.right.shape != pair.left.shape:
        left, right = pair.left.shape[1:], pair.right.shape[1:]
        raise InputError(
            f"{pair.name}: the left image is {left[1]}x{left[0]} and the right one "
            f"{right[1]}x{right[0]}; a rectified pair has one size. Rectify the pair again."
        )
    if pair.camera is not None:
        height, width = pair.left.shape[1:]
        check_image_matches_camera(pair.camera, width, height, pair.name)
        if not isinstance(pair.camera, StereoRig):
            raise InputError(
                f"{pair.name}: the camera has no baseline, so disparity cannot become metres. Add "
                '"baseline_m" (the distance between the two cameras in metres) to its file.'
            )
    return pair.right
