"""What an estimate can take: pictures of any form, pairs that are pairs."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from depthpose.core.arrays import check_image
from depthpose.core.camera import StereoRig, check_image_matches_camera, check_rectified
from depthpose.core.errors import InputError
from depthpose.core.files import read_image
from depthpose.depth.types import StereoInput

Picture = str | Path | Float[Tensor, "3 _ _"] | UInt8[np.ndarray, "_ _ 3"]
"""A file, a tensor of RGB in [0, 1], or an array of 8-bit RGB. The order of the channels cannot be
told from the values: OpenCV reads BGR, which ``image[..., ::-1]`` turns into RGB."""


def as_tensor(image: object) -> Float[Tensor, "3 h w"]:
    """Read a :data:`Picture`, or bring it to RGB in [0, 1].

    Raises:
        InputError: an array that is not 8-bit (H, W, 3), a tensor that is not (3, H, W) in
            [0, 1], or a file that cannot be read.
    """
    match image:
        case str() | Path():
            return read_image(Path(image))
        case np.ndarray() if image.dtype != np.uint8:
            raise InputError(
                f"the image is an array of {image.dtype}; give 8-bit RGB (H, W, 3), or a tensor "
                "(3, H, W) of float in [0, 1]"
            )
        case np.ndarray() if image.ndim != 3 or image.shape[2] != 3:
            raise InputError(
                f"the image is an array of shape {image.shape}; give 8-bit RGB (H, W, 3): drop "
                "alpha, repeat grey three times"
            )
        case np.ndarray():
            return torch.from_numpy(np.ascontiguousarray(image)).permute(2, 0, 1).float() / 255
        case _:
            return check_image(image, "the image")


def refuse_unrectified(pair: StereoInput) -> None:
    """Raise where the two images are swapped, or their rows do not correspond.

    Raises:
        InputError: with what was measured and what to do.
    """
    right = usable_right(pair)
    if torch.equal(pair.left, right):
        raise InputError(
            f"{pair.name}: left and right are the same picture; give the view of each camera"
        )
    report = check_rectified(pair.left, right)
    if report.is_swapped or report.is_rectified is False:
        raise InputError(f"{pair.name}: {report.message}")


def usable_right(pair: StereoInput) -> Float[Tensor, "3 h w"]:
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
