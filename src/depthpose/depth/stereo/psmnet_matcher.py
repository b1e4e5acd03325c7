"""PSMNet as a matcher: images of any size in, disparity and confidence out."""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

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

AGREEMENT_PX = 3.0
"""Difference of left and right disparity at which their agreement is down to 1/e."""


class PSMNetMatcher:
    """The network with the world around it: normalisation, padding, device, memory.

    The weights are copied: training ``network`` further does not change this matcher.

    Raises:
        InputError: the device does not exist on this machine.
    """

    def __init__(self, network: PSMNet, config: MatcherConfig | None = None) -> None:
        self.config = config or MatcherConfig()
        self.network_config = network.config
        self._device = _usable_device(self.config.device)
        self._inference = PSMNetInference(
            network,
            DTYPES[self.config.precision],
            self._device,
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
    def match_whole(self, left: Tensor, right: Tensor) -> Match:
        """Match one pair without tiles, whatever the config says: what tiles are compared with.

        Raises:
            InputError: as :meth:`match`.
        """
        return self._match(left, right, with_tiles=False)

    def _match(self, left: Tensor, right: Tensor, *, with_tiles: bool) -> Match:
        check_pair(left, right)
        one_way = self._match_tiled if with_tiles else self._match_padded
        pair = [normalise(image.to(self._device, torch.float32)) for image in (left, right)]
        found = one_way(pair[0], pair[1])
        if self.config.with_left_right_check:
            mirrored = one_way(pair[1].flip(-1), pair[0].flip(-1))
            found = lower_where_disagreeing(found, mirrored.disparity_px.flip(-1))
        confidence = None if found.confidence is None else found.confidence.to(left.device)
        return Match(disparity_px=found.disparity_px.to(left.device), confidence=confidence)

    def _match_tiled(self, left: Tensor, right: Tensor) -> Match:
        assert self.config.tile_px is not None
        reach = self.network_config.max_disparity_px
        tiling = Tiling(*self.config.tile_px, self.config.tile_overlap_px, reach)
        return match_tiles(self._match_padded, left, right, tiling)

    def _match_padded(self, left: Tensor, right: Tensor) -> Match:
        """Match a normalised pair of any size: pad, run, crop back."""
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
        confidence = None if found.confidence is None else found.confidence[-h:, :w]
        return Match(disparity_px=found.disparity_px[-h:, :w], confidence=confidence)


def normalise(image: Float[Tensor, "*batch 3 h w"]) -> Float[Tensor, "*batch 3 h w"]:
    """RGB in [0, 1] to what the network was trained on: ImageNet's mean 0 and deviation 1."""
    mean = image.new_tensor(IMAGENET_MEAN)[:, None, None]
    return (image - mean) / image.new_tensor(IMAGENET_STD)[:, None, None]


def pad_top_right(image: Float[Tensor, "3 h w"], least: int) -> Float[Tensor, "3 h2 w2"]:
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


def _usable_device(name: str) -> torch.device:
    try:
        device = torch.device(name)
        torch.empty(1, device=device)
    except (RuntimeError, AssertionError) as error:
        raise InputError(
            f"device {name!r} cannot be used here ({str(error).splitlines()[0]}); take 'cpu'"
        ) from error
    return device
