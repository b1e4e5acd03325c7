"""Networks as matchers: normalisation, padding, the working focal length, the left-right check."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
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
from depthpose.depth.stereo.matcher import check_pair
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

    fine_pixels: ClassVar[int]
    """Most pixels of an image that is matched at the speed ``fine``."""
    largest_upscale: ClassVar[float] = 1.0
    """Largest factor by which the sides of an image are enlarged for a fine match."""
    largest_span_factor: ClassVar[float] = 1.5
    """Most disparities that a fine match searches, as a multiple of those of the training."""
    finds_range: bool = False
    """Whether the disparities of a pair are measured first, and searched where they lie."""
    activation_bytes: ClassVar[Callable[..., int]]
    """Peak memory of a padded pair [bytes], by the network's config, height, width, type, rows."""

    def __init__(self, network: StereoNetwork, config: MatcherConfig | None = None) -> None:
        config = config or MatcherConfig()
        if config.max_disparity_px is not None and not self.finds_range:
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
    def run(
        self,
        left: Views,
        right: Views,
        network_config: Any,  # noqa: ANN401
        first_px: int = 0,
    ) -> list[Match]:
        """Match normalised pairs whose sides suit the network.

        Args:
            left: left views.
            right: right views, the same size.
            network_config: config of the network, perhaps of more disparities than in training.
            first_px: the least disparity that is searched, a multiple of ``STEP_PX``; 0 for
                networks that do not find the range.

        Returns:
            A match for each pair, in pixels of these views; its disparities include ``first_px``.
        """

    @torch.no_grad()
    def match(self, left: Tensor, right: Tensor) -> Match:
        """Match one pair of any size.

        Raises:
            InputError: unusable images, or a memory bound that is too small for them.
        """
        return self.match_many([(left, right)])[0]

    @torch.no_grad()
    def match_many(
        self,
        pairs: Sequence[tuple[Tensor, Tensor]],
        camera: Camera | None = None,
        search: SearchRange | None = None,
    ) -> list[Match]:
        """Match pairs: together if all become one size and memory is unbounded, else one by one.

        Args:
            pairs: left and right images, as for :meth:`match`.
            camera: camera of the left images, which are then matched at :meth:`work_size`; None: it
                is not known.
            search: size and disparities of the search, in place of those of the camera.

        Returns:
            A match of each pair, at its size and on its device.

        Raises:
            InputError: as :meth:`match`.
        """
        for left, right in pairs:
            check_pair(left, right)
        views, network_config = self._resize_views(pairs, camera, search)
        first_px = 0 if search is None else search.first_px
        is_one_size = len({left.shape for left, _ in views}) == 1
        is_together = is_one_size and self.config.max_memory_bytes is None
        groups = [views] if is_together else [[pair] for pair in views]
        matches: list[Match] = []
        for group in groups:
            matches += self._match_group(group, network_config, first_px)

        # Back to the size and the device of the images.
        matches_of_images: list[Match] = []
        for match, (left, _) in zip(matches, pairs, strict=True):
            moved = disparity.apply_to_maps(match, methodcaller("to", left.device))
            matches_of_images.append(disparity.resize_match(moved, *left.shape[1:]))
        return matches_of_images

    def _resize_views(
        self,
        pairs: Sequence[tuple[Tensor, Tensor]],
        camera: Camera | None,
        search: SearchRange | None,
    ) -> tuple[Sequence[tuple[Tensor, ...]], Any]:
        """Resize pairs to the size at which they are matched.

        Returns:
            The resized pairs; and the network's config, with the number of disparities for that
            size.
        """
        trained = self.network_config
        if search is not None:
            sizes = [_compute_scaled_size(left, search.scale, camera) for left, _ in pairs]
            largest_px = search.span_px
        elif camera is not None and trained.work_focal_px is not None:
            sizes = [self.work_size(camera)] * len(pairs)
            largest_px = self.work_disparities(camera)
        else:
            return pairs, trained
        views = [
            tuple(disparity.resize_image(view, *size) for view in pair)
            for pair, size in zip(pairs, sizes, strict=True)
        ]
        return views, replace(trained, max_disparity_px=largest_px)

    def _match_group(
        self,
        group: Sequence[tuple[Tensor, ...]],
        network_config: Any,  # noqa: ANN401
        first_px: int,
    ) -> list[Match]:
        """Match pairs of one size in one call of the network, or two with the left-right check."""
        lefts, rights = zip(*group, strict=True)
        left = normalise(torch.stack(lefts).to(self.device, torch.float32))
        right = normalise(torch.stack(rights).to(self.device, torch.float32))
        matches = self._match_padded(left, right, network_config, first_px)
        if not self.config.with_left_right_check:
            return matches
        # Mirrored, the right view is a left one.
        mirrored = self._match_padded(right.flip(-1), left.flip(-1), network_config, first_px)
        return [
            lower_where_disagreeing(match, mirrored_match.disparity_px.flip(-1))
            for match, mirrored_match in zip(matches, mirrored, strict=True)
        ]

    def _match_padded(
        self,
        left: Views,
        right: Views,
        network_config: Any,  # noqa: ANN401
        first_px: int,
    ) -> list[Match]:
        """Pad pairs to sides that suit the network, match them, and crop the matches again.

        Raises:
            InputError: the network needs more memory than the config allows.
        """
        height, width = left.shape[-2:]
        padded_left = pad_top_right(left, network_config)
        padded_right = pad_top_right(right, network_config)
        self._refuse_memory(network_config, *padded_left.shape[-2:])
        matches = self.run(padded_left, padded_right, network_config, first_px)
        return [
            disparity.apply_to_maps(match, lambda values: values[-height:, :width])
            for match in matches
        ]

    def _refuse_memory(self, network_config: Any, height: int, width: int) -> None:  # noqa: ANN401
        """Refuse images whose matching takes more memory than the config allows."""
        limit_bytes = self.config.max_memory_bytes
        if limit_bytes is None:
            return
        rows = self._network.rows or height // 4  # of a volume, at quarter size
        needed_bytes = self.activation_bytes(network_config, height, width, self.dtype, rows)
        if needed_bytes > limit_bytes:
            quick = "" if network_config.work_focal_px is None else " or speed='quick'"
            raise InputError(
                f"max_memory_bytes={limit_bytes} is too small for images of "
                f"{height}x{width} (padded): this matcher takes {needed_bytes}; allow "
                f"that, take precision='bf16'{quick}, or match the pair at a smaller size"
            )

    def work_size(self, camera: Camera) -> tuple[int, int]:
        """Compute the rows and columns at which images of a camera are matched [px]."""
        if self.network_config.work_focal_px is None:
            return camera.height, camera.width
        return disparity.size_at_focal_length(camera, self.matching_focal_px(camera))

    def work_disparities(self, camera: Camera) -> int:
        """Compute the number of disparities that are searched at :meth:`work_size` [px]."""
        trained = self.network_config
        if trained.work_focal_px is None:
            return trained.max_disparity_px
        # Disparities grow with the focal length; the same filters search more of them.
        ratio = self.matching_focal_px(camera) / trained.work_focal_px
        span_factor = min(ratio, self.largest_span_factor)
        return self.whole_steps(trained.max_disparity_px * span_factor)

    def whole_steps(self, disparity_px: float) -> int:
        """Round a number of disparities [px] up to a multiple of the network's step."""
        step_px = self.network_config.step_px
        without_float_error_px = round(disparity_px, 3)  # which would add a whole step
        return max(1, math.ceil(without_float_error_px / step_px)) * step_px

    def matching_focal_px(self, camera: Camera) -> float:
        """Compute the focal length at which images of a camera are matched [px].

        At the speed ``fine`` it is that of an image of ``fine_pixels``, but at least that of the
        training.
        """
        trained_px = self.network_config.work_focal_px
        if trained_px is None:
            return float(camera.K[0, 0])
        if self.config.speed == "quick":
            return trained_px
        scale = math.sqrt(self.fine_pixels / (camera.height * camera.width))
        fine_px = float(camera.K[0, 0]) * min(scale, self.largest_upscale)
        return max(trained_px, fine_px)


def _compute_scaled_size(left: View, scale: float, camera: Camera | None) -> tuple[int, int]:
    """Compute the rows and columns of a scaled view; with a camera, pixels become square."""
    if camera is not None:
        return disparity.size_at_focal_length(camera, scale * float(camera.K[0, 0]))
    return max(1, round(left.shape[1] * scale)), max(1, round(left.shape[2] * scale))


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
    # Disparities at the matching points: NaN outside the right view.
    matched_px = disparity.warp_right_to_left(right_px[None], match.disparity_px)[0]
    difference_px = ((match.disparity_px - matched_px).abs() - tolerance_px).clamp(min=0)
    agreement = torch.exp(-difference_px / decay_px).nan_to_num(0.0)
    if match.confidence is None:
        return replace(match, confidence=agreement)
    confidence = match.confidence * (1 + agreement) / 2
    if match.is_sky is not None:
        confidence = torch.where(match.is_sky, match.confidence, confidence)
    return replace(match, confidence=confidence)
