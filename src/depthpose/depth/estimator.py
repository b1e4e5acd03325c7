"""One image, or a rectified pair, to one depth estimate in metres."""

from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, UInt8
from torch import Tensor

from depthpose.core.camera import (
    Camera,
    StereoRig,
    check_image_matches_camera,
    check_rectified,
    read_camera,
)
from depthpose.core.checkpoint import find_weights, say_terms
from depthpose.core.errors import InputError
from depthpose.core.files import read_image
from depthpose.depth.config import MatcherConfig, SGBMConfig
from depthpose.depth.disparity import (
    depth_from_disparity,
    disparity_from_depth,
    resize_disparity,
)
from depthpose.depth.stereo import Matcher, PSMNetMatcher, SGBMMatcher
from depthpose.depth.synthesis import Synthesiser
from depthpose.depth.types import DepthEstimate, Match, StereoInput
from depthpose.depth.weights import DepthWeights, read_depth_weights

Picture = str | Path | Float[Tensor, "3 _ _"] | UInt8[np.ndarray, "_ _ 3"]
"""A file, a tensor of RGB in [0, 1], or an array of 8-bit RGB."""


class FakestereoNet:
    """Metric depth from one image, by a synthesised right view, or from a rectified pair.

    Example::

        net = FakestereoNet.load("default")
        net.estimate("street.png", "camera.json").depth_m  # (H, W), metres
        net.estimate("left.png", "rig.json", right="right.png").depth_m

    Args:
        matcher: pair to disparity.
        synthesiser: left view to right view; None matches real pairs only.
    """

    def __init__(self, matcher: Matcher, synthesiser: Synthesiser | None = None) -> None:
        self.matcher = matcher
        self.synthesiser = synthesiser

    @classmethod
    def load(
        cls,
        weights: str | Path | None = None,
        *,
        matcher: str | Path | Matcher | None = None,
        config: MatcherConfig | SGBMConfig | None = None,
    ) -> "FakestereoNet":
        """Build an estimator from weights, by file or by name.

        Args:
            weights: weights of both networks, of the generator alone (then ``matcher`` is
                needed), or of PSMNet alone (then real pairs only). None: ``matcher`` alone.
            matcher: ``psmnet`` (the one of the weights), ``sgbm`` (OpenCV's, which needs none),
                weights with a matcher by file or name, or any matcher of your own.
            config: how the matcher runs.

        Raises:
            InputError: no such weights, or no matcher in what was given.
        """
        found = None
        if weights is not None:
            found = read_depth_weights(find_weights(weights))
            say_terms(found.facts)
        run = config if isinstance(config, MatcherConfig) else MatcherConfig()
        chosen = _choose_matcher(weights, found, matcher, config)
        if found is None or found.generator is None:
            return cls(chosen)
        return cls(chosen, Synthesiser(found.generator, run.device))

    def estimate(
        self,
        image: Picture,
        camera: Camera | str | Path | None,
        *,
        right: Picture | None = None,
        name: str | None = None,
        with_check: bool = True,
    ) -> DepthEstimate:
        """Estimate depth of ``image``, alone or as the left one of a rectified pair.

        Args:
            image: the image, the left one of a pair.
            camera: camera or rig, or its JSON file. One image needs its focal length, for the
                image is brought to the rig that the generator imitates; a baseline is not looked
                at. A pair without camera gives disparity only.
            right: right image, the same size and rows.
            name: what to call the input in errors; the file's name by default.
            with_check: look whether the pair is rectified and in the right order first.

        Raises:
            InputError: a file that cannot be read, sizes that disagree, a camera without what is
                needed, a pair that is swapped or not rectified.
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
        if pair.right is None:
            return self._estimate_alone(pair)
        right = _usable_right(pair)
        if with_check:
            refuse_unrectified(pair)
        match = self._match(pair.left, right, pair.camera)
        depth_m = None
        if isinstance(pair.camera, StereoRig):
            depth_m = depth_from_disparity(match.disparity_px, pair.camera)
        return DepthEstimate(
            depth_m=depth_m, disparity_px=match.disparity_px, confidence=match.confidence
        )

    def _estimate_alone(self, image: StereoInput) -> DepthEstimate:
        """Bring the image to the virtual rig, draw its right view, match, and come back."""
        synthesiser, camera = self._usable_alone(image)
        rig = synthesiser.generator.config
        height, width = image.left.shape[1:]
        virtual_px = rig.virtual_focal_px
        left = resize_image(image.left, *focal_size(camera, virtual_px))
        right = synthesiser.synthesise(left)
        match = self._match(left, right, virtual_camera(camera, virtual_px))
        seen_px = resize_disparity(match.disparity_px, height, width)
        imitated = StereoRig(
            width=width, height=height, K=camera.K, baseline_m=rig.virtual_baseline_m
        )
        depth_m = depth_from_disparity(seen_px, imitated)
        own = disparity_from_depth(depth_m, camera) if isinstance(camera, StereoRig) else seen_px
        return DepthEstimate(
            depth_m=depth_m,
            disparity_px=own,
            confidence=_resized_map(match.confidence, height, width),
            right=resize_image(right, height, width),
        )

    def _match(self, left: Tensor, right: Tensor, camera: Camera | None) -> Match:
        """Match at the focal length that the matcher's weights want, and come back."""
        work_px = work_focal_px(self.matcher)
        if work_px is None or camera is None:
            return self.matcher.match(left, right)
        height, width = left.shape[1:]
        size = focal_size(camera, work_px)
        found = self.matcher.match(resize_image(left, *size), resize_image(right, *size))
        return Match(
            disparity_px=resize_disparity(found.disparity_px, height, width),
            confidence=_resized_map(found.confidence, height, width),
        )

    def _usable_alone(self, image: StereoInput) -> tuple[Synthesiser, Camera]:
        if self.synthesiser is None:
            raise InputError(
                f"{image.name}: there is no right image, and these weights match pairs only; give "
                "right=, or weights with a generator ('depthpose weights list')."
            )
        if image.camera is None:
            raise InputError(
                f"{image.name}: metres from one image need its focal length. Give a camera: "
                '{"width", "height", "K"}; a phone\'s main camera has about 0.75 widths.'
            )
        height, width = image.left.shape[1:]
        check_image_matches_camera(image.camera, width, height, image.name)
        return self.synthesiser, image.camera


def work_focal_px(matcher: Matcher) -> float | None:
    """Focal length that the matcher's weights were trained at, where they say so [px]."""
    return matcher.network_config.work_focal_px if isinstance(matcher, PSMNetMatcher) else None


def focal_size(camera: Camera, focal_px: float) -> tuple[int, int]:
    """Rows and columns at which the camera's image has ``focal_px``, with square pixels."""
    rows = round(camera.height * focal_px / float(camera.K[1, 1]))
    columns = round(camera.width * focal_px / float(camera.K[0, 0]))
    return max(rows, 1), max(columns, 1)


def virtual_camera(camera: Camera, focal_px: float) -> Camera:
    """Make the camera of the image brought to ``focal_px``."""
    rows, columns = focal_size(camera, focal_px)
    K = torch.tensor(
        [[focal_px, 0, (columns - 1) / 2], [0, focal_px, (rows - 1) / 2], [0, 0, 1]],
        dtype=torch.float64,
    )
    return Camera(width=columns, height=rows, K=K)


def resize_image(
    image: Float[Tensor, "3 _ _"], height: int, width: int
) -> Float[Tensor, "3 {height} {width}"]:
    """Resize bilinearly, averaging where it shrinks."""
    if image.shape[1:] == (height, width):
        return image
    shrinks = height < image.shape[1] or width < image.shape[2]
    resized = F.interpolate(image[None], (height, width), mode="bilinear", antialias=shrinks)
    return resized[0].clamp(0, 1)


def refuse_unrectified(pair: StereoInput) -> None:
    """Raise where the two images are swapped, or their rows do not correspond.

    Raises:
        InputError: with what was measured and what to do.
    """
    report = check_rectified(pair.left, _usable_right(pair))
    if report.is_swapped or report.is_rectified is False:
        raise InputError(f"{pair.name}: {report.message}")


def _choose_matcher(
    weights: str | Path | None,
    found: DepthWeights | None,
    matcher: str | Path | Matcher | None,
    config: MatcherConfig | SGBMConfig | None,
) -> Matcher:
    run = config if isinstance(config, MatcherConfig) else MatcherConfig()
    if isinstance(config, SGBMConfig) and matcher != "sgbm":
        raise InputError(
            f"config is of SGBM, but matcher is {matcher!r}; give matcher='sgbm' or a MatcherConfig"
        )
    if matcher == "sgbm":
        if found is not None and found.generator is None:
            raise InputError(
                f"weights is {str(weights)!r} and matcher is 'sgbm', which takes no weights of a "
                "matcher. Leave one of the two away."
            )
        return SGBMMatcher(config if isinstance(config, SGBMConfig) else SGBMConfig())
    # Paths first: a Path has a method 'match' too, and would pass for a matcher.
    if isinstance(matcher, str | Path) and matcher != "psmnet":
        found = read_depth_weights(find_weights(matcher))
    elif matcher is not None and not isinstance(matcher, str | Path):
        return matcher
    if found is None or found.matcher is None:
        raise InputError(
            f"weights is {None if weights is None else str(weights)!r} and matcher is "
            f"{None if matcher is None else str(matcher)!r}: there is no matcher in that. Give "
            "weights='psmnet.safetensors' or matcher='sgbm', which needs none; a generator and a "
            "matcher become one file by 'depthpose weights pack G --matcher S --out W'."
        )
    return PSMNetMatcher(found.matcher, run)


def _usable_right(pair: StereoInput) -> Float[Tensor, "3 h w"]:
    if pair.right is None:
        raise InputError(f"{pair.name}: there is no right image; give right=.")
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


def _resized_map(
    values: Float[Tensor, "_ _"] | None, height: int, width: int
) -> Float[Tensor, "{height} {width}"] | None:
    if values is None or values.shape == (height, width):
        return values
    return F.interpolate(values[None, None], (height, width), mode="bilinear")[0, 0]


def _tensor(image: Picture) -> Float[Tensor, "3 h w"]:
    match image:
        case str() | Path():
            return read_image(Path(image))
        case np.ndarray() if image.dtype != np.uint8:
            raise InputError(
                f"the image is an array of {image.dtype}; give 8-bit RGB (H, W, 3), or a tensor "
                "(3, H, W) of float in [0, 1]"
            )
        case np.ndarray():
            return torch.from_numpy(np.ascontiguousarray(image)).permute(2, 0, 1).float() / 255
        case _:
            return image
