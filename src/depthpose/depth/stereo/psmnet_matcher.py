"""PSMNet as a matcher: images of any size in, disparity and confidence out."""

from collections.abc import Sequence
from dataclasses import replace

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from depthpose.core.devices import usable_device, usable_precision
from depthpose.core.errors import InputError
from depthpose.depth.config import MatcherConfig
from depthpose.depth.disparity import left_right_difference_px
from depthpose.depth.stereo.inference import PSMNetInference
from depthpose.depth.stereo.matcher import check_pair
from depthpose.depth.stereo.plan import Footprint
from depthpose.depth.stereo.psmnet import PSMNet
from depthpose.depth.stereo.tiles import Tiling, match_tiles
from depthpose.depth.types import Match

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
DTYPES = {"fp32": torch.float32, "bf16": torch.bfloat16}

Views = Float[Tensor, "b 3 h w"]

AGREEMENT_PX = 3.0
"""Difference of left and right disparity at which their agreement is down to 1/e."""


class PSMNetMatcher:
    """The network with the world around it: normalisation, padding, device, memory.

    The weights are copied: training ``network`` further does not change this matcher. Where the
    processor has no bf16, ``config`` says fp32 in its place.

    Raises:
        InputError: the device does not exist on this machine.
    """

    def __init__(self, network: PSMNet, config: MatcherConfig | None = None) -> None:
        config = config or MatcherConfig()
        self.device = usable_device(config.device)
        self.config = with_usable_precision(config)
        self.network_config = network.config
        self._inference = PSMNetInference(
            network,
            DTYPES[self.config.precision],
            self.device,
            with_compile=self.config.with_compile,
        )

    @torch.no_grad()
    def match(self, left: Tensor, right: Tensor) -> Match:
        """Match one pair of any size.

        Raises:
            InputError: unusable images, or a memory bound that is too small for them.
        """
        return self._match(left, right, with_tiles=self.config.tile_px is not None)

    @torch.no_grad()
    def match_many(self, pairs: Sequence[tuple[Tensor, Tensor]]) -> list[Match]:
        """Match pairs; those of one size together, unless memory is bounded or there are tiles.

        A processor is busy with one pair; it is a GPU that gains.

        Raises:
            InputError: as :meth:`match`.
        """
        is_alone = self.config.tile_px is not None or self.config.max_memory_bytes is not None
        if is_alone or len({left.shape for left, _ in pairs}) > 1:
            return [self.match(left, right) for left, right in pairs]
        for left, right in pairs:
            check_pair(left, right)
        views = [self._normalised(torch.stack(list(of))) for of in zip(*pairs, strict=True)]
        return self._match_both_ways(views[0], views[1], pairs[0][0].device)

    @torch.no_grad()
    def match_whole(self, left: Tensor, right: Tensor) -> Match:
        """Match one pair without tiles, whatever the config says: what tiles are compared with.

        Raises:
            InputError: as :meth:`match`.
        """
        return self._match(left, right, with_tiles=False)

    def _match(self, left: Tensor, right: Tensor, *, with_tiles: bool) -> Match:
        check_pair(left, right)
        pair = [self._normalised(image[None]) for image in (left, right)]
        return self._match_both_ways(pair[0], pair[1], left.device, with_tiles=with_tiles)[0]

    def _normalised(self, views: Views) -> Views:
        return normalise(views.to(self.device, torch.float32))

    def _match_both_ways(
        self, left: Views, right: Views, device: torch.device, *, with_tiles: bool = False
    ) -> list[Match]:
        one_way = self._match_tiled if with_tiles else self._match_padded
        found = one_way(left, right)
        if self.config.with_left_right_check:
            mirrored = one_way(right.flip(-1), left.flip(-1))
            found = [
                lower_where_disagreeing(match, other.disparity_px.flip(-1))
                for match, other in zip(found, mirrored, strict=True)
            ]
        return [_moved(match, device) for match in found]

    def _match_tiled(self, left: Views, right: Views) -> list[Match]:
        assert self.config.tile_px is not None
        reach = self.network_config.max_disparity_px
        tiling = Tiling(*self.config.tile_px, self.config.tile_overlap_px, reach)

        def match_tile(one: Tensor, other: Tensor) -> Match:
            return self._match_padded(one[None], other[None])[0]

        both = zip(left, right, strict=True)
        return [match_tiles(match_tile, one, other, tiling) for one, other in both]

    def _match_padded(self, left: Views, right: Views) -> list[Match]:
        """Match normalised pairs of any size: pad, run, crop back."""
        h, w = left.shape[-2:]
        least = self.network_config.min_side_px
        padded = pad_top_right(left, least), pad_top_right(right, least)
        footprint = Footprint(
            config=self.network_config,
            height=padded[0].shape[-2],
            width=padded[0].shape[-1],
            dtype=DTYPES[self.config.precision],
        )
        steps = footprint.plan(self.config.max_memory_bytes)
        found = self._inference.match(*padded, steps, with_confidence=self.config.with_confidence)
        return [_cropped(match, h, w) for match in found]


def _cropped(match: Match, height: int, width: int) -> Match:
    confidence = None if match.confidence is None else match.confidence[-height:, :width]
    return Match(disparity_px=match.disparity_px[-height:, :width], confidence=confidence)


def _moved(match: Match, device: torch.device) -> Match:
    confidence = None if match.confidence is None else match.confidence.to(device)
    return Match(disparity_px=match.disparity_px.to(device), confidence=confidence)


def with_usable_precision(config: MatcherConfig) -> MatcherConfig:
    """Give a config whose precision its device computes in; says so where it is another."""
    is_bf16 = usable_precision(config.precision, config.device) == "bf16"
    return replace(config, precision="bf16" if is_bf16 else "fp32")


def normalise(image: Float[Tensor, "*batch 3 h w"]) -> Float[Tensor, "*batch 3 h w"]:
    """RGB in [0, 1] to what the network was trained on: ImageNet's mean 0 and deviation 1."""
    mean = image.new_tensor(IMAGENET_MEAN)[:, None, None]
    return (image - mean) / image.new_tensor(IMAGENET_STD)[:, None, None]


def pad_top_right(
    image: Float[Tensor, "*batch 3 h w"], least: int
) -> Float[Tensor, "*batch 3 h2 w2"]:
    """Pad a normalised image with zeros, top and right, to multiples of 16 of at least ``least``.

    Top and right, as the authors do: columns stay where they are, so disparity does too.
    """
    h, w = (max(least, -(-side // 16) * 16) for side in image.shape[-2:])
    return F.pad(image, (0, w - image.shape[-1], h - image.shape[-2], 0))


def lower_where_disagreeing(found: Match, right_px: Float[Tensor, "h w"]) -> Match:
    """Lower the confidence where the right view's own disparity is another.

    Halved at least where the point left looks at lies outside the right view: nothing there can
    agree, and nothing contradicts.
    """
    difference_px = left_right_difference_px(found.disparity_px, right_px)
    agreement = torch.exp(-difference_px / AGREEMENT_PX).nan_to_num(0.0)
    confidence = agreement if found.confidence is None else found.confidence * (1 + agreement) / 2
    return Match(disparity_px=found.disparity_px, confidence=confidence)


def tile_change_px(matcher: PSMNetMatcher, left: Tensor, right: Tensor) -> float:
    """Mean difference that tiles make to the disparity of a pair [px].

    Raises:
        InputError: the matcher uses no tiles, or the pair is unusable.
    """
    if matcher.config.tile_px is None:
        raise InputError("tile_change_px needs a matcher with tiles; set tile_px in its config")
    tiled = matcher.match(left, right).disparity_px
    whole = matcher.match_whole(left, right).disparity_px
    return float((tiled - whole).abs().mean())
