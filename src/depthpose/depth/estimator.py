"""One image, or a rectified pair, to one depth estimate in metres."""

from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from depthpose.core.camera import (
    Camera,
    StereoRig,
    check_image_matches_camera,
    check_rectified,
    read_camera,
)
from depthpose.core.errors import InputError
from depthpose.core.files import read_image
from depthpose.depth.config import MatcherConfig, SGBMConfig
from depthpose.depth.disparity import depth_from_disparity
from depthpose.depth.stereo import Matcher, SGBMMatcher, load_psmnet
from depthpose.depth.types import DepthEstimate, StereoInput

Picture = str | Path | Float[Tensor, "3 _ _"] | UInt8[np.ndarray, "_ _ 3"]
"""A file, a tensor of RGB in [0, 1], or an array of 8-bit RGB."""


class FakestereoNet:
    """Metric depth from a rectified pair of images, by any stereo matcher.

    Example::

        net = FakestereoNet.load("psmnet.safetensors")
        estimate = net.estimate("left.png", "camera.json", right="right.png")
        estimate.depth_m  # (H, W), metres
    """

    def __init__(self, matcher: Matcher) -> None:
        self.matcher = matcher

    @classmethod
    def load(
        cls,
        weights: str | Path | None = None,
        *,
        matcher: Literal["psmnet", "sgbm"] | None = None,
        config: MatcherConfig | SGBMConfig | None = None,
    ) -> "FakestereoNet":
        """Build an estimator from weights, or with OpenCV's matcher, which needs none.

        Args:
            weights: a ``.safetensors`` file of PSMNet.
            matcher: ``psmnet`` (the default where weights are given) or ``sgbm``.
            config: how the matcher runs.

        Raises:
            InputError: neither weights nor a matcher that needs none, or both.
        """
        if (weights is None) == (matcher != "sgbm"):
            raise InputError(
                f"weights is {weights!r} and matcher is {matcher!r}: 'psmnet' needs a weights file "
                "and 'sgbm' takes none. Give weights='psmnet.safetensors' or matcher='sgbm'."
            )
        if weights is None:
            return cls(SGBMMatcher(config if isinstance(config, SGBMConfig) else SGBMConfig()))
        chosen = config if isinstance(config, MatcherConfig) else MatcherConfig()
        return cls(load_psmnet(Path(weights), chosen))

    def estimate(
        self,
        image: Picture,
        camera: Camera | str | Path | None,
        *,
        right: Picture | None = None,
        name: str | None = None,
        with_check: bool = True,
    ) -> DepthEstimate:
        """Estimate depth of ``image``, the left one of a rectified pair.

        Args:
            image: left image.
            camera: the rig, or its JSON file. None gives disparity only.
            right: right image, the same size and rows.
            name: what to call the pair in errors; the file's name by default.
            with_check: look whether the pair is rectified and in the right order first.

        Raises:
            InputError: a file that cannot be read, sizes that disagree, a camera without baseline,
                a pair that is swapped or not rectified.
        """
        chosen = name or (Path(image).stem if isinstance(image, str | Path) else "image")
        pair = StereoInput(
            name=chosen,
            left=_tensor(image),
            right=None if right is None else _tensor(right),
            camera=read_camera(Path(camera)) if isinstance(camera, str | Path) else camera,
        )
        return self.estimate_pair(pair, with_check=with_check)

    @torch.inference_mode()
    def estimate_pair(self, pair: StereoInput, *, with_check: bool = False) -> DepthEstimate:
        """Estimate depth of one input whose images are read already."""
        right = _usable_right(pair)
        if with_check:
            refuse_unrectified(pair)
        match = self.matcher.match(pair.left, right)
        depth_m = None
        if isinstance(pair.camera, StereoRig):
            depth_m = depth_from_disparity(match.disparity_px, pair.camera)
        return DepthEstimate(
            depth_m=depth_m, disparity_px=match.disparity_px, confidence=match.confidence
        )


def refuse_unrectified(pair: StereoInput) -> None:
    """Raise where the two images are swapped, or their rows do not correspond.

    Raises:
        InputError: with what was measured and what to do.
    """
    report = check_rectified(pair.left, _usable_right(pair))
    if report.is_swapped or report.is_rectified is False:
        raise InputError(f"{pair.name}: {report.message}")


def _usable_right(pair: StereoInput) -> Float[Tensor, "3 h w"]:
    if pair.right is None:
        raise InputError(
            f"{pair.name}: there is no right image, and this model matches pairs; give right=."
        )
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


def _tensor(image: Picture) -> Float[Tensor, "3 h w"]:
    match image:
        case str() | Path():
            return read_image(Path(image))
        case np.ndarray():
            return torch.from_numpy(np.ascontiguousarray(image)).permute(2, 0, 1).float() / 255
        case _:
            return image
