"""PSMNet, stacked hourglass: a rectified pair to disparity (Chang and Chen, CVPR 2018).

The features of one view come first: residual layers and a spatial pyramid, at 1/4 size.
"""

import re
from collections import OrderedDict
from collections.abc import Mapping
from pathlib import Path
from typing import cast

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from depthpose.core.checkpoint import (
    Checkpoint,
    file_sha256,
    load_weights,
    read_published,
    save_checkpoint,
)
from depthpose.core.config import config_to_dict
from depthpose.core.errors import InputError
from depthpose.depth.config import PSMNetConfig
from depthpose.depth.stereo import layers
from depthpose.depth.stereo.layers import ConvNorm, Volume
from depthpose.depth.stereo.network_matcher import NetworkMatcher, StereoNetwork
from depthpose.depth.types import Map, Maps, Match, Views

CHUNK_BYTES = 6 << 20
"""Size of one piece of the soft arg-min; it fits the caches."""


WINDOW_PX = 2.0
"""Half width of the window whose probability is the confidence; ranks errors best (AUSE)."""


def expected_disparity(
    cost: Float[Tensor, "h4 w4 d4"],
    size: tuple[int, int, int],
    *,
    align_corners: bool,
    chunk_bytes: int = CHUNK_BYTES,
    with_confidence: bool,
) -> tuple[Map, Map | None]:
    """Enlarge the cost to ``size`` and take the expected disparity [px], some rows at a time.

    Equals :func:`soft_argmin` of a cost in float32 or wider; ``size`` is disparities, rows and
    columns. About four pieces of ``chunk_bytes`` are alive at a time. The confidence is the
    probability within ``WINDOW_PX`` of the expectation.
    """
    count, rows, columns = size
    down, across, deep = (
        layers.linear_taps(small, large, cost, align_corners=align_corners)
        for small, large in zip(cost.shape, (rows, columns, count), strict=True)
    )
    matrix = layers.interpolation_matrix(deep, cost.shape[2]).T.contiguous()
    bins = torch.arange(count, device=cost.device).to(cost)
    disparity_px = cost.new_empty(rows, columns)
    confidence = torch.empty_like(disparity_px) if with_confidence else None
    step = max(1, chunk_bytes // (columns * count * cost.element_size()))
    for first in range(0, rows, step):
        y = slice(first, first + step)
        wide = torch.lerp(cost[down.low[y]], cost[down.high[y]], down.share[y, None, None])
        low, high = (wide.index_select(1, taps) for taps in (across.low, across.high))
        probability = (torch.lerp(low, high, across.share[:, None]) @ matrix).softmax(-1)
        torch.matmul(probability, bins, out=disparity_px[y])
        if confidence is not None:
            near = (bins - disparity_px[y, :, None]).abs_() <= WINDOW_PX
            torch.sum(probability.mul_(near), -1, out=confidence[y])
            confidence[y].clamp_(0, 1)
    return disparity_px, confidence


class Block(nn.Module):
    """Two convolutions and a shortcut; no ReLU after the sum, as in the paper's code."""

    def __init__(self, inputs: int, outputs: int, stride: int, dilation: int) -> None:
        super().__init__()
        self.first = ConvNorm(nn.Conv2d, inputs, outputs, 3, stride, dilation)
        self.second = ConvNorm(nn.Conv2d, outputs, outputs, 3, 1, dilation)
        keeps_size = stride == 1 and inputs == outputs
        self.shortcut = None if keeps_size else ConvNorm(nn.Conv2d, inputs, outputs, 1, stride)

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b k h2 w2"]:
        """Add what two convolutions see to the input."""
        shortcut = x if self.shortcut is None else self.shortcut(x)
        return self.second(F.relu(self.first(x))) + shortcut


class FeatureExtractor(nn.Module):
    """One view to ``width`` features for each pixel of a quarter-size grid."""

    def __init__(self, config: PSMNetConfig) -> None:
        super().__init__()
        c = config.width
        self.align_corners = config.align_corners
        self.pools = config.pools
        stem = (
            ConvNorm(nn.Conv2d, 3, c, stride=2),
            ConvNorm(nn.Conv2d, c, c),
            ConvNorm(nn.Conv2d, c, c),
        )
        self.stem = nn.ModuleList(stem)
        # The first block of each stage changes the channels and the size.
        kinds = ((c, c, 1, 1), (c, 2 * c, 2, 1), (2 * c, 4 * c, 1, 1), (4 * c, 4 * c, 1, 2))
        self.stages = nn.ModuleList()
        for (inputs, outputs, stride, dilation), count in zip(kinds, config.blocks, strict=True):
            rest = (Block(outputs, outputs, 1, dilation) for _ in range(count - 1))
            self.stages.append(nn.Sequential(Block(inputs, outputs, stride, dilation), *rest))
        self.pyramid = nn.ModuleList([ConvNorm(nn.Conv2d, 4 * c, c, 1) for _ in config.pools])
        self.fuse = ConvNorm(nn.Conv2d, (6 + len(config.pools)) * c, 4 * c)
        self.project = nn.Conv2d(4 * c, c, 1, bias=False)

    def forward(self, image: Views) -> Float[Tensor, "b c h4 w4"]:
        """Give features of each pixel with local and global context."""
        x = image
        for layer in self.stem:
            x = F.relu(layer(x))
        raw = self.stages[1](self.stages[0](x))
        last = self.stages[3](self.stages[2](raw))
        levels = []
        for layer, pool in zip(reversed(self.pyramid), reversed(self.pools), strict=True):
            pooled = F.relu(layer(F.avg_pool2d(last, pool)))
            size = last.shape[-2:]
            align = self.align_corners
            levels.append(F.interpolate(pooled, size, mode="bilinear", align_corners=align))
        return self.project(F.relu(self.fuse(torch.cat([raw, last, *levels], 1))))


class Hourglass(nn.Module):
    """Down to a quarter of the volume and back, to let far evidence reach each voxel."""

    def __init__(self, c: int) -> None:
        super().__init__()
        self.down1 = ConvNorm(nn.Conv3d, c, 2 * c, stride=2)
        self.same1 = ConvNorm(nn.Conv3d, 2 * c, 2 * c)
        self.down2 = ConvNorm(nn.Conv3d, 2 * c, 2 * c, stride=2)
        self.same2 = ConvNorm(nn.Conv3d, 2 * c, 2 * c)
        self.up2 = ConvNorm(nn.ConvTranspose3d, 2 * c, 2 * c, stride=2)
        self.up1 = ConvNorm(nn.ConvTranspose3d, 2 * c, c, stride=2)

    def forward(
        self, x: Volume, first: Volume | None, before: Volume | None
    ) -> tuple[Volume, Volume]:
        """Give the half-size volumes going down and coming up, between ``down1`` and ``up1``.

        Args:
            x: what ``down1`` made of the volume that the hourglass refines; it is overwritten.
            first: half-size volume of the first hourglass going down; None in the first itself.
            before: half-size volume of the hourglass before, coming up; None in the first.
        """
        down = self.same1(x.relu_())
        down = (down if before is None else down.add_(before)).relu_()
        up = self.up2(self.same2(self.down2(down).relu_()).relu_())
        return down, up.add_(down if first is None else first).relu_()


class Head(nn.Sequential):
    """Volume of features to one cost a voxel; a larger cost means a likelier match."""

    def __init__(self, c: int) -> None:
        parts: OrderedDict[str, nn.Module] = OrderedDict(hidden=ConvNorm(nn.Conv3d, c, c))
        parts["relu"] = nn.ReLU(inplace=True)
        parts["cost"] = nn.Conv3d(c, 1, 3, 1, 1, bias=False)
        super().__init__(parts)


def concatenation_volume(
    left: Float[Tensor, "b c h w"], right: Float[Tensor, "b c h w"], bins: int
) -> Volume:
    """Put left features beside the right ones that each disparity would match them with.

    Voxel ``(d, y, x)`` holds ``left[y, x]`` and ``right[y, x - d]``, or zeros where the right
    pixel falls outside the image.
    """
    b, c, h, w = left.shape
    volume = left.new_zeros(b, 2 * c, bins, h, w)
    for d in range(min(bins, w)):
        volume[:, :c, d, :, d:] = left[..., d:]
        volume[:, c:, d, :, d:] = right[..., : w - d]
    return volume


def soft_argmin(cost: Volume, size: tuple[int, int, int], *, align_corners: bool) -> Maps:
    """Enlarge the cost to ``size`` (disparities, rows, columns) and take the expected disparity.

    ``sum_d d softmax(cost)_d`` [px], eq. 2.2 of the thesis; costs are likelihoods here, so no
    sign stands before them.
    """
    if cost.dtype in (torch.bfloat16, torch.float16):
        cost = cost.float()  # 8 bits of mantissa would round the expectation to whole pixels
    full = F.interpolate(cost, size=size, mode="trilinear", align_corners=align_corners)[:, 0]
    disparity_px = torch.arange(size[0], dtype=full.dtype, device=full.device)
    return (full.softmax(1) * disparity_px[:, None, None]).sum(1)


class PSMNet(StereoNetwork):
    """Rectified pair to disparity: features, concatenation volume, three hourglasses, three heads.

    Images are RGB normalised by ImageNet's mean and deviation; both sides are multiples of 16 and
    at least ``config.min_side_px``. The default size has 5,224,768 parameters.
    """

    #: at 1/4 size, that are computed at a time where something large would be held, with no
    #: gradient; None, as in training and in exported graphs: all
    rows: int | None = None

    def __init__(self, config: PSMNetConfig | None = None) -> None:
        super().__init__()
        self.config = config or PSMNetConfig()
        c = self.config.width
        self.features = FeatureExtractor(self.config)
        self.dres0 = nn.ModuleList([ConvNorm(nn.Conv3d, 2 * c, c), ConvNorm(nn.Conv3d, c, c)])
        self.dres1 = nn.ModuleList([ConvNorm(nn.Conv3d, c, c), ConvNorm(nn.Conv3d, c, c)])
        self.hourglasses = nn.ModuleList([Hourglass(c) for _ in range(3)])
        self.heads = nn.ModuleList([Head(c) for _ in range(3)])
        for module in self.modules():  # as the authors did: deconvolutions keep PyTorch's default
            if isinstance(module, nn.Conv2d | nn.Conv3d):
                taps = module.weight[0, 0].numel()
                nn.init.normal_(module.weight, 0, (2 / (taps * module.out_channels)) ** 0.5)

    def forward(self, left: Views, right: Views) -> tuple[Maps, ...]:
        """Match the pair.

        Returns:
            Disparity of the left view [px], after each of the three hourglasses while training,
            after the last alone in eval mode. The last is always the answer.

        Raises:
            InputError: the images' size does not suit the network.
        """
        h, w = left.shape[-2:]
        least = self.config.min_side_px
        if h % 16 or w % 16 or min(h, w) < least:
            raise InputError(
                f"PSMNet takes sides that are multiples of 16 and at least {least} px, got "
                f"{h}x{w}; pad the pair, as PSMNetMatcher does"
            )
        size = (self.config.max_disparity_px, h, w)
        costs = self.costs(left, right)
        align = self.config.align_corners
        return tuple(
            soft_argmin(cost, size, align_corners=align)
            for cost in (costs if self.training else costs[-1:])
        )

    def costs(
        self, left: Views, right: Views, max_disparity_px: int | None = None
    ) -> tuple[Volume, Volume, Volume]:
        """Give the quarter-size cost after each hourglass; each adds to the one before.

        ``max_disparity_px`` takes the place of the network's own: the same filters look over all
        disparities, so they can look farther than they did in training.
        """
        bins = (max_disparity_px or self.config.max_disparity_px) // 4

        volume = layers.by_rows(
            lambda near, far: self.aggregate(concatenation_volume(near, far, bins)),
            (self.features(left), self.features(right)),
            halo=4,  # four convolutions follow each other
            rows=self.rows,
        )
        return self.refine(volume)

    def aggregate(self, volume: Volume) -> Volume:
        """Give the volume that the hourglasses refine, of a concatenation volume."""
        x = self.dres0[0](volume).relu_()
        del volume
        x = self.dres0[1](x).relu_()
        return self.dres1[1](self.dres1[0](x).relu_()).add_(x)

    def refine(self, cost0: Volume) -> tuple[Volume, Volume, Volume]:
        """Give the cost after each hourglass."""
        x = cost0
        first = None
        up = None
        costs = []
        for module, head in zip(self.hourglasses, self.heads, strict=True):
            hourglass = cast("Hourglass", module)
            # Under the same name, so that one volume of the full size is held beside ``cost0``.
            x = hourglass.down1(x)
            down, up = hourglass(x, first, up)
            first = down if first is None else first
            del down
            x = hourglass.up1(up).add_(cost0)
            cost = layers.by_rows(head, (x,), halo=2, rows=self.rows)
            costs.append(cost + costs[-1] if costs else cost)
        return cast("tuple[Volume, Volume, Volume]", tuple(costs))


ROWS = 32
"""Rows at quarter size that a matcher computes at a time."""


def psmnet_bytes(
    config: PSMNetConfig, height: int, width: int, dtype: torch.dtype, rows: int = ROWS
) -> int:
    """Estimate the peak memory of a padded pair [bytes], with margin for the allocator.

    Two volumes of the largest size are held whole; ``rows`` at quarter size are computed at a time.
    """
    h = height // 4
    w = width // 4
    row_bytes = config.width * w * dtype.itemsize
    map_bytes = row_bytes * h
    bins = config.max_disparity_px // 4
    volume_bytes = map_bytes * bins

    slab2_bytes, slab4_bytes = (min(rows + 2 * halo, h) * row_bytes * bins for halo in (2, 4))
    levels = 6 + len(config.pools)
    cost_bytes = 4 * bins * h * w
    # Costs are computed in float32.
    head_slabs = 2 if dtype.itemsize >= 4 else 4
    stages = (
        # Five half-size maps in the first stage; joined levels, twice, in the last.
        2 * map_bytes * max(5 * 4, 2 * levels + 12),
        # ``cost0``; of some rows the concatenation, and what a convolution makes of it.
        volume_bytes + 2 * map_bytes + 3 * slab4_bytes,
        # ``cost0``, what is added to it, three half-size volumes; some rows in the head.
        2 * volume_bytes + 3 * volume_bytes // 4 + head_slabs * slab2_bytes + 3 * cost_bytes,
        4 * cost_bytes + 16 * height * width + 5 * CHUNK_BYTES,
    )
    return int(layers.MARGIN * max(stages)) + layers.OVERHEAD_BYTES


class PSMNetMatcher(NetworkMatcher):
    """PSMNet with pre- and post-processing, as :class:`NetworkMatcher` says."""

    fine_pixels = 280_000
    """Pixels of a fine match at most: an image of KITTI at three quarters of its resolution."""
    activation_bytes = staticmethod(psmnet_bytes)

    def fold(self, network: PSMNet, example: Tensor) -> PSMNet:
        """Fold batch norm, and compute some rows at a time."""
        for head in network.heads:
            # In float32 at least: 8 bits would round the expectation to whole pixels.
            cost = cast("nn.Conv3d", head.cost)
            wide = torch.empty(0, device=self.device)
            head.cost = layers.VolumeConv(cost, cost.weight, torch.zeros(1), wide)
        network.rows = ROWS
        return layers.fold(network, example)

    def run(
        self, left: Views, right: Views, network_config: PSMNetConfig, first_px: int = 0
    ) -> list[Match]:
        """Match normalised pairs whose sides suit the network."""
        assert first_px == 0, "its volume begins at 0; the views are moved instead"
        near, far = (v.to(self.dtype, memory_format=torch.channels_last) for v in (left, right))
        costs = self._network.costs(near, far, network_config.max_disparity_px)[-1][:, 0]
        height, width = left.shape[-2:]
        matches = [
            expected_disparity(
                cost.permute(1, 2, 0).contiguous(),
                (network_config.max_disparity_px, height, width),
                align_corners=network_config.align_corners,
                with_confidence=self.config.with_confidence,
            )
            for cost in costs
        ]
        return [Match(disparity_px=d, confidence=c) for d, c in matches]


_PARTS = {"0": "conv", "1": "norm"}
_HOURGLASS = ("down1", "same1", "down2", "same2", "up2", "up1")
_PUBLISHED_NAMES = {
    "feature_extraction.": (
        (r"firstconv\.([024])\.([01])\.", lambda m: f"stem.{int(m[1]) // 2}.{_PARTS[m[2]]}."),
        (r"layer(\d)\.", lambda m: f"stages.{int(m[1]) - 1}."),
        (r"conv1\.0\.([01])\.", lambda m: f"first.{_PARTS[m[1]]}."),
        (r"conv2\.([01])\.", lambda m: f"second.{_PARTS[m[1]]}."),
        (r"downsample\.([01])\.", lambda m: f"shortcut.{_PARTS[m[1]]}."),
        (r"branch(\d)\.1\.([01])\.", lambda m: f"pyramid.{int(m[1]) - 1}.{_PARTS[m[2]]}."),
        (r"lastconv\.0\.([01])\.", lambda m: f"fuse.{_PARTS[m[1]]}."),
        (r"lastconv\.2\.", lambda _: "project."),
    ),
    "": (
        (r"^(dres[01])\.([02])\.([01])\.", lambda m: f"{m[1]}.{int(m[2]) // 2}.{_PARTS[m[3]]}."),
        (
            r"^dres([234])\.conv([1-6])(?:\.0)?\.([01])\.",
            lambda m: f"hourglasses.{int(m[1]) - 2}.{_HOURGLASS[int(m[2]) - 1]}.{_PARTS[m[3]]}.",
        ),
        (r"^classif(\d)\.0\.([01])\.", lambda m: f"heads.{int(m[1]) - 1}.hidden.{_PARTS[m[2]]}."),
        (r"^classif(\d)\.2\.", lambda m: f"heads.{int(m[1]) - 1}.cost."),
    ),
}
"""Patterns of the authors' names, of the feature extractor and of the rest, and ours."""


def psmnet_from_published(state: Mapping[str, Tensor], *, align_corners: bool) -> PSMNet:
    """Make a PSMNet of default size, in eval mode, from the authors' state dict.

    Args:
        state: what their checkpoint holds under ``state_dict``, with or without ``module.``.
        align_corners: True for their weights of 2018 (KITTI 2015), False for those of 2021. The
            file does not say, and a wrong choice costs about a pixel.

    Raises:
        InputError: a name is missing, unknown or holds another shape; nothing is half loaded.
    """
    network = PSMNet(PSMNetConfig(align_corners=align_corners))
    renamed: dict[str, Tensor] = {}
    for published, value in state.items():  # an unknown name stays as it is, and is refused
        name = published.removeprefix("module.")
        prefix = next(prefix for prefix in _PUBLISHED_NAMES if name.startswith(prefix))
        name = name.removeprefix(prefix)
        for pattern, ours in _PUBLISHED_NAMES[prefix]:
            name = re.sub(pattern, ours, name)
        renamed[f"features.{name}" if prefix else name] = value
    # The count of batches steers nothing at inference; files older than 2018 do not hold it.
    uncounted = {n: v for n, v in network.state_dict().items() if n.endswith("batches_tracked")}
    checkpoint = Checkpoint(kind="psmnet", config={}, state={**uncounted, **renamed})
    load_weights(
        network, checkpoint, "the checkpoint of the stacked-hourglass PSMNet ('state_dict')"
    )
    return network.eval()


def import_psmnet(file: Path, out: Path, *, align_corners: bool) -> None:
    """Turn the authors' checkpoint into a weights file of ours.

    Their ``.tar`` is a PyTorch file, not an archive to unpack, and read without its code.
    ``align_corners`` (:func:`psmnet_from_published`) is recorded in ``out``.

    Raises:
        InputError: not a checkpoint of the published network.
    """
    state = read_published(file, "checkpoint of PSMNet")
    try:
        network = psmnet_from_published(state, align_corners=align_corners)
    except InputError as error:
        raise InputError(f"{file}: {error}") from error
    facts = {
        "align_corners": str(align_corners).lower(),
        "origin": f"imported from a file with sha256 {file_sha256(file)}",
        "trained_on": "not recorded in the published file",
        "licence": "as published by its authors",
    }
    config = config_to_dict(network.config)
    state = network.state_dict()
    save_checkpoint(out, Checkpoint(kind="psmnet", config=config, state=state, facts=facts))
