"""Networks as matchers: normalisation, padding, the working focal length, the left-right check."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import partial
from operator import methodcaller
from typing import Any, ClassVar

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from depthpose.core.arrays import IMAGENET_MEAN, IMAGENET_STD
from depthpose.core.camera import Camera
from depthpose.core.devices import usable_device, usable_precision
from depthpose.core.errors import InputError
from depthpose.depth import disparity
from depthpose.depth.config import MatcherConfig, NetworkConfig
from depthpose.depth.encoder import LiteEncoder
from depthpose.depth.stereo.matcher import Matcher, match_from_infinity
from depthpose.depth.types import Map, Maps, Match, View, Views

STEP_PX = 4
"""Distance of neighbouring disparities that have a score, in every network here: their volumes have
a quarter of the image's size."""
DTYPES = {"fp32": torch.float32, "bf16": torch.bfloat16}
AGREEMENT_PX = 3.0
"""Difference of left and right disparity at which their agreement falls to 1/e."""


@dataclass(frozen=True, kw_only=True)
class SearchRange:
    """The size at which a pair is matched, and the disparities that are searched there."""

    scale: float  #: the size, as a multiple of that of the images
    first_px: int  #: the least disparity, in pixels at that size, a multiple of 4
    span_px: int  #: how many disparities are searched from ``first_px`` on

    @property
    def end_in_images_px(self) -> float:
        """The bound above which none is searched, in pixels of the images."""
        return (self.first_px + self.span_px) / self.scale


class StereoNetwork(nn.Module):
    """A network from a normalised pair to disparity maps, the last of which is its output.

    In training it gives at most three maps, the last of which weighs most; else one.
    """

    config: Any  #: its sizes and conventions, a :class:`~depthpose.depth.config.NetworkConfig`
    #: the part that may begin with weights of ImageNet, which trains more slowly
    encoder: LiteEncoder | None = None
    sky: nn.Module | None = None  #: the class of the sky, which may be trained alone

    def forward_with_sky(self, left: Views, right: Views) -> tuple[tuple[Maps, ...], Maps | None]:
        """Estimate the disparity maps [px], and P(sky) where the network has that class."""
        return self(left, right), None


class NetworkMatcher(ABC):
    """A network with pre- and post-processing: normalisation, padding, device, memory.

    A kind of network adds :meth:`fold`, :meth:`run`, :meth:`activation_bytes` and ``fine_pixels``.
    The weights are copied: training ``network`` further does not change this matcher. Where the
    processor has no bf16, ``config`` says fp32 in its place.

    Args:
        network: the network. Its attribute ``rows`` is how many rows of a volume are computed at a
            time; None: all.
        config: how it is run; None: the defaults.

    Raises:
        InputError: the device does not exist on this machine; a largest disparity for a network
            that searches those of its training alone.
    """

    takes_largest_disparity: ClassVar[bool] = False
    """Whether ``max_disparity_px`` of the config may bound the search."""
    fine_pixels: ClassVar[int]
    """Most pixels of an image that is matched at the speed ``fine``."""
    largest_upscale: ClassVar[float] = 1.0
    """Largest factor by which the sides of an image are enlarged for a fine match."""
    largest_span_factor: ClassVar[float] = 1.5
    """Most disparities that a fine match searches, as a multiple of those of the training."""
    activation_bytes: ClassVar[Callable[..., int]]
    """Peak memory of a padded pair [bytes], by the network's config, span, height, width, type and
    rows."""

    def __init__(self, network: StereoNetwork, config: MatcherConfig | None = None) -> None:
        config = config or MatcherConfig()
        if config.max_disparity_px is not None and not self.takes_largest_disparity:
            raise InputError(
                f"max_disparity_px is {config.max_disparity_px:g}, but this network searches the "
                f"{network.config.max_disparity_px} disparities that it was trained with; omit it "
                "(--max-disparity), or take weights with a light matcher, as 'default'"
            )
        self.device = usable_device(config.device)
        precision = usable_precision(config.precision, config.device)
        self.config = replace(config, precision=precision)
        self.dtype = DTYPES[precision]
        self.network_config: NetworkConfig = network.config
        example = torch.empty(0, dtype=self.dtype, device=self.device)
        self._network = self.fold(deepcopy(network).eval().to(self.device), example)

    @abstractmethod
    def fold(self, network: Any, example: Tensor) -> Any:  # noqa: ANN401
        """Fold batch norm into the convolutions, in place, and return the network.

        Weights get the type and the device of ``example``.
        """

    @abstractmethod
    def run(self, left: View, right: View, search: SearchRange) -> Match:
        """Match a normalised pair whose sides suit the network.

        Args:
            left: left view, ``(3, H, W)``.
            right: right view, the same size.
            search: its ``first_px`` and ``span_px`` are the disparities that are searched.

        Returns:
            The match, in pixels of these views; its disparities include ``first_px``.
        """

    def match(self, left: Tensor, right: Tensor, camera: Camera | None = None) -> Match:
        """Match one pair of any size within :meth:`usual_search`, from infinity on.

        Args:
            left: left image, ``(3, H, W)`` RGB in [0, 1].
            right: right image, the same size.
            camera: camera of the left image; None: it is not known.

        Returns:
            The match, at the size and on the device of ``left``.

        Raises:
            InputError: unusable images, or a memory bound that is too small for them.
        """
        match_from_zero = partial(match_in_usual_range, self, camera=camera)
        return match_from_infinity(match_from_zero, left, right, camera)

    @torch.no_grad()
    def match_within(
        self,
        left: Tensor,
        right: Tensor,
        search: SearchRange,
        camera: Camera | None = None,
        *,
        with_left_right_check: bool = False,
    ) -> Match:
        """Match one pair at the size and within the disparities of a search.

        Args:
            left: left image, as for :meth:`match`.
            right: right image, the same size.
            search: size and disparities.
            camera: camera of the left image; with one, pixels become square.
            with_left_right_check: match the mirrored pair too, and lower the confidence where both
                disagree.

        Returns:
            The match, at the size and on the device of ``left``.

        Raises:
            InputError: a memory bound that is too small for the images.
        """
        height, width = left.shape[1:]
        size = self._scale_size((height, width), search.scale, camera)
        left_view, right_view = (
            normalise(disparity.resize_image(view, *size).to(self.device, torch.float32))
            for view in (left, right)
        )
        match = self._match_padded(left_view, right_view, search)
        if with_left_right_check:
            # Mirrored, the right view is a left one.
            mirrored = self._match_padded(right_view.flip(-1), left_view.flip(-1), search)
            match = lower_where_disagreeing(match, mirrored.disparity_px.flip(-1))
        match = disparity.apply_to_maps(match, methodcaller("to", left.device))
        return disparity.resize_match(match, height, width)

    def _match_padded(self, left: View, right: View, search: SearchRange) -> Match:
        """Pad a pair to sides that suit the network, match it, and crop the match again.

        Raises:
            InputError: the network needs more memory than the config allows.
        """
        height, width = left.shape[1:]
        padded_left = pad_top_right(left, self.network_config)
        padded_right = pad_top_right(right, self.network_config)
        self._refuse_memory(search.span_px, *padded_left.shape[1:])
        match = self.run(padded_left, padded_right, search)
        return disparity.apply_to_maps(match, lambda values: values[-height:, :width])

    def _refuse_memory(self, span_px: int, height: int, width: int) -> None:
        """Refuse images whose matching takes more memory than the config allows."""
        limit_bytes = self.config.max_memory_bytes
        if limit_bytes is None:
            return
        rows = self._network.rows or height // 4  # of a volume, at quarter size
        needed_bytes = self.activation_bytes(
            self.network_config, span_px, height, width, self.dtype, rows
        )
        if needed_bytes > limit_bytes:
            quick = "" if self.network_config.work_focal_px is None else " or speed='quick'"
            raise InputError(
                f"max_memory_bytes={limit_bytes} is too small for images of "
                f"{height}x{width} (padded): this matcher takes {needed_bytes}; allow "
                f"that, take precision='bf16'{quick}, or match the pair at a smaller size"
            )

    def usual_search(self, size: Sequence[int], camera: Camera | None) -> SearchRange:
        """Compute the search of a camera's pairs, from 0 px on, without regard to their images.

        Networks of one focal length see images at that; at the speed ``fine`` at that of an image
        of ``fine_pixels``, where it is larger. Other networks, and images without a camera, are
        matched at their own size.

        Args:
            size: rows and columns of the images.
            camera: camera of the left image, where it is known.
        """
        trained_px = self.network_config.max_disparity_px
        trained_focal_px = self.network_config.work_focal_px
        if camera is None or trained_focal_px is None:
            return SearchRange(scale=1.0, first_px=0, span_px=trained_px)
        image_focal_px = float(camera.K[0, 0])
        focal_px = trained_focal_px
        if self.config.speed == "fine":
            focal_px = max(trained_focal_px, image_focal_px * self.fine_scale(size))
        # Disparities grow with the focal length; the same filters search more of them.
        span_factor = min(focal_px / trained_focal_px, self.largest_span_factor)
        return SearchRange(
            scale=focal_px / image_focal_px,
            first_px=0,
            span_px=self.whole_steps(trained_px * span_factor),
        )

    def fine_scale(self, size: Sequence[int]) -> float:
        """Compute the factor by which the sides of images of a size change for a fine match."""
        rows, columns = size
        return min(math.sqrt(self.fine_pixels / (rows * columns)), self.largest_upscale)

    def work_size(self, camera: Camera) -> tuple[int, int]:
        """Compute the rows and columns at which images of a camera are usually matched [px]."""
        size = (camera.height, camera.width)
        return self._scale_size(size, self.usual_search(size, camera).scale, camera)

    def _scale_size(
        self, size: tuple[int, int], scale: float, camera: Camera | None
    ) -> tuple[int, int]:
        """Compute the rows and columns of scaled images; with a camera, pixels become square.

        Networks that match pairs as they are leave the shape of pixels, too.
        """
        rows, columns = size
        if camera is None or self.network_config.work_focal_px is None:
            return max(1, round(rows * scale)), max(1, round(columns * scale))
        camera = replace(camera, height=rows, width=columns)
        return disparity.size_at_focal_length(camera, scale * float(camera.K[0, 0]))

    def whole_steps(self, disparity_px: float) -> int:
        """Round a number of disparities [px] up to a multiple of the network's step."""
        step_px = self.network_config.step_px
        without_float_error_px = round(disparity_px, 3)  # which would add a whole step
        return max(1, math.ceil(without_float_error_px / step_px)) * step_px


def match_in_usual_range(
    matcher: Matcher, left: Tensor, right: Tensor, camera: Camera | None = None
) -> Match:
    """Match a pair within the usual search of its camera, without measuring its disparities.

    So views are matched that a network synthesised, and pairs in exported graphs. Images are not
    checked by networks.

    Args:
        matcher: a network's; any other matches in its own way.
        left: left image, ``(3, H, W)`` RGB in [0, 1].
        right: right image, the same size.
        camera: camera of the left image, where it is known.

    Raises:
        InputError: what the matcher raises.
    """
    if not isinstance(matcher, NetworkMatcher):
        return matcher.match(left, right, camera)
    search = matcher.usual_search(left.shape[1:], camera)
    with_check = matcher.config.with_left_right_check
    return matcher.match_within(left, right, search, camera, with_left_right_check=with_check)


def normalise(image: Float[Tensor, "*batch 3 h w"]) -> Float[Tensor, "*batch 3 h w"]:
    """Normalise RGB in [0, 1] by ImageNet's mean and deviation, as in the training."""
    mean = image.new_tensor(IMAGENET_MEAN)[:, None, None]
    return (image - mean) / image.new_tensor(IMAGENET_STD)[:, None, None]


def pad_top_right(
    image: Float[Tensor, "*batch 3 h w"], network: NetworkConfig
) -> Float[Tensor, "*batch 3 h2 w2"]:
    """Pad a normalised image with zeros, at the top and right, to a size that suits the network.

    So PSMNet's authors do. Columns keep their numbers, and so disparity stays the same.
    """
    height, width = image.shape[-2:]
    rows_above = _round_up_side(height, network) - height
    columns_right = _round_up_side(width, network) - width
    return F.pad(image, (0, columns_right, rows_above, 0))


def _round_up_side(side_px: int, network: NetworkConfig) -> int:
    """Round a side up to the next one that the network takes."""
    steps = math.ceil(side_px / network.step_px)
    return max(network.min_side_px, steps * network.step_px)


def lower_where_disagreeing(
    match: Match, right_px: Map, tolerance_px: float = 0.0, decay_px: float = AGREEMENT_PX
) -> Match:
    """Lower the confidence where the disparity of the right view differs from that of the left one.

    The agreement of both is ``exp(-difference / decay_px)``, and 0 where the matching point lies
    outside the right view. The confidence is multiplied by ``(1 + agreement) / 2``; without one,
    the agreement becomes the confidence. The sky keeps its confidence.

    Args:
        match: match of the left view.
        right_px: disparity of the right view.
        tolerance_px: a difference up to this counts as none.
        decay_px: difference beyond the tolerance at which the agreement falls to 1/e.
    """
    difference_px = disparity.left_right_difference(match.disparity_px, right_px)
    beyond_px = (difference_px - tolerance_px).clamp(min=0)
    agreement = torch.exp(-beyond_px / decay_px).nan_to_num(0.0)  # NaN outside the right view
    if match.confidence is None:
        return replace(match, confidence=agreement)
    confidence = match.confidence * (1 + agreement) / 2
    if match.is_sky is not None:
        confidence = torch.where(match.is_sky, match.confidence, confidence)
    return replace(match, confidence=confidence)
