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
from depthpose.depth.stereo.network_matcher import (
    STEP_PX,
    NetworkMatcher,
    SearchRange,
    StereoNetwork,
)
from depthpose.depth.types import Map, Maps, Match, View, Views

CHUNK_BYTES = 6 << 20
"""Size of the rows of which the soft arg-min is computed at a time; it fits the caches."""

WINDOW_PX = 2.0
"""The confidence is the probability of disparities within this distance of the estimated one; this
width ranks errors best (AUSE)."""


def expected_disparity(
    cost: Float[Tensor, "h4 w4 d4"],
    size: tuple[int, int, int],
    *,
    align_corners: bool,
    chunk_bytes: int = CHUNK_BYTES,
    with_confidence: bool,
) -> tuple[Map, Map | None]:
    """Compute the expected disparity of a cost enlarged to full size, some rows at a time.

    Equals :func:`soft_argmin` of a cost in float32 or wider, in less memory: about four tensors of
    ``chunk_bytes`` are alive at a time.

    Args:
        cost: cost of each disparity of each pixel, at quarter size; larger is likelier.
        size: disparities, rows and columns at full size.
        align_corners: how the cost is enlarged.
        chunk_bytes: size of the rows that are computed at a time.
        with_confidence: compute the confidence too.

    Returns:
        The disparity [px]; and the confidence, the probability within ``WINDOW_PX`` of it.
    """
    count, rows, columns = size
    row_taps, column_taps, disparity_taps = (
        layers.linear_taps(small, large, cost, align_corners=align_corners)
        for small, large in zip(cost.shape, (rows, columns, count), strict=True)
    )
    disparity_matrix = layers.interpolation_matrix(disparity_taps, cost.shape[2]).T.contiguous()
    disparities_px = torch.arange(count, device=cost.device).to(cost)
    disparity_px = cost.new_empty(rows, columns)
    confidence = torch.empty_like(disparity_px) if with_confidence else None
    step = max(1, chunk_bytes // (columns * count * cost.element_size()))
    for first in range(0, rows, step):
        y = slice(first, first + step)

        # The cost of these rows, interpolated along rows, columns and disparities in turn.
        row_share = row_taps.share[y, None, None]
        of_rows = torch.lerp(cost[row_taps.low[y]], cost[row_taps.high[y]], row_share)
        low = of_rows.index_select(1, column_taps.low)
        high = of_rows.index_select(1, column_taps.high)
        of_pixels = torch.lerp(low, high, column_taps.share[:, None])
        probability = (of_pixels @ disparity_matrix).softmax(-1)

        torch.matmul(probability, disparities_px, out=disparity_px[y])
        if confidence is not None:
            is_near = (disparities_px - disparity_px[y, :, None]).abs_() <= WINDOW_PX
            torch.sum(probability.mul_(is_near), -1, out=confidence[y])
            confidence[y].clamp_(0, 1)
    return disparity_px, confidence


class ResidualBlock(nn.Module):
    """Two convolutions and a shortcut; no ReLU after the sum, as in the paper's code."""

    def __init__(self, inputs: int, outputs: int, stride: int, dilation: int) -> None:
        super().__init__()
        self.first = ConvNorm(nn.Conv2d, inputs, outputs, 3, stride, dilation)
        self.second = ConvNorm(nn.Conv2d, outputs, outputs, 3, 1, dilation)
        keeps_size = stride == 1 and inputs == outputs
        self.shortcut = None if keeps_size else ConvNorm(nn.Conv2d, inputs, outputs, 1, stride)

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b k h2 w2"]:
        """Add the output of two convolutions to the input."""
        shortcut = x if self.shortcut is None else self.shortcut(x)
        return self.second(F.relu(self.first(x))) + shortcut


class FeatureExtractor(nn.Module):
    """One view to ``config.width`` features for each pixel at quarter size."""

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
        # The first block of each stage changes the channels and the size: input and output
        # channels, stride, dilation.
        stages = ((c, c, 1, 1), (c, 2 * c, 2, 1), (2 * c, 4 * c, 1, 1), (4 * c, 4 * c, 1, 2))
        self.stages = nn.ModuleList()
        for (inputs, outputs, stride, dilation), count in zip(stages, config.blocks, strict=True):
            rest = (ResidualBlock(outputs, outputs, 1, dilation) for _ in range(count - 1))
            self.stages.append(
                nn.Sequential(ResidualBlock(inputs, outputs, stride, dilation), *rest)
            )
        self.pyramid = nn.ModuleList([ConvNorm(nn.Conv2d, 4 * c, c, 1) for _ in config.pools])
        self.fuse = ConvNorm(nn.Conv2d, (6 + len(config.pools)) * c, 4 * c)
        self.project = nn.Conv2d(4 * c, c, 1, bias=False)

    def forward(self, image: Views) -> Float[Tensor, "b c h4 w4"]:
        """Compute features of normalised views, with local and global context."""
        x = image
        for layer in self.stem:
            x = F.relu(layer(x))
        local = self.stages[1](self.stages[0](x))
        deep = self.stages[3](self.stages[2](local))
        # The spatial pyramid: means over ever larger windows.
        levels = []
        for layer, pool in zip(reversed(self.pyramid), reversed(self.pools), strict=True):
            pooled = F.relu(layer(F.avg_pool2d(deep, pool)))
            size = deep.shape[-2:]
            align = self.align_corners
            levels.append(F.interpolate(pooled, size, mode="bilinear", align_corners=align))
        fused = F.relu(self.fuse(torch.cat([local, deep, *levels], 1)))
        return self.project(fused)


class Hourglass(nn.Module):
    """Down to a quarter of a volume's sides and back, so that far evidence reaches each voxel."""

    def __init__(self, c: int) -> None:
        super().__init__()
        self.down1 = ConvNorm(nn.Conv3d, c, 2 * c, stride=2)
        self.same1 = ConvNorm(nn.Conv3d, 2 * c, 2 * c)
        self.down2 = ConvNorm(nn.Conv3d, 2 * c, 2 * c, stride=2)
        self.same2 = ConvNorm(nn.Conv3d, 2 * c, 2 * c)
        self.up2 = ConvNorm(nn.ConvTranspose3d, 2 * c, 2 * c, stride=2)
        self.up1 = ConvNorm(nn.ConvTranspose3d, 2 * c, c, stride=2)

    def forward(
        self, x: Volume, first_down: Volume | None, last_up: Volume | None
    ) -> tuple[Volume, Volume]:
        """Compute the volumes at half size, on the way down and on the way up.

        ``down1`` is applied before, and ``up1`` after it, by :meth:`PSMNet.refine`.

        Args:
            x: the output of ``down1`` of this hourglass; it is overwritten.
            first_down: volume of the first hourglass on its way down; None in the first itself.
            last_up: volume of the hourglass before on its way up; None in the first.
        """
        down = self.same1(x.relu_())
        down = (down if last_up is None else down.add_(last_up)).relu_()
        quarter = self.same2(self.down2(down).relu_()).relu_()
        up = self.up2(quarter)
        return down, up.add_(down if first_down is None else first_down).relu_()


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
    """Concatenate, for each disparity, left features and the right ones that they match.

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
    """Compute the expected disparity [px] of a cost enlarged to ``size``.

    It is ``sum_d d softmax(cost)_d``, eq. 2.2 of the thesis. A larger cost is likelier here, so the
    softmax is that of the cost, not of its negative. ``size``: disparities, rows, columns.
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

    #: rows at 1/4 size that are computed at a time where a large volume would be held, with no
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
        """Estimate the disparity of the left view.

        Returns:
            Disparity [px] after each of the three hourglasses in training; after the last alone in
            eval mode.

        Raises:
            InputError: the images' size does not suit the network.
        """
        height, width = left.shape[-2:]
        least = self.config.min_side_px
        if height % 16 or width % 16 or min(height, width) < least:
            raise InputError(
                f"PSMNet takes sides that are multiples of 16 and at least {least} px, got "
                f"{height}x{width}; pad the pair, as PSMNetMatcher does"
            )
        size = (self.config.max_disparity_px, height, width)
        costs = self.costs(left, right)
        used_costs = costs if self.training else costs[-1:]
        align = self.config.align_corners
        return tuple(soft_argmin(cost, size, align_corners=align) for cost in used_costs)

    def costs(
        self, left: Views, right: Views, span_px: int | None = None
    ) -> tuple[Volume, Volume, Volume]:
        """Compute the cost at quarter size after each hourglass; each adds to the one before.

        ``span_px``: number of disparities, in place of that of the training: the same filters can
        search more.
        """
        bins = (span_px or self.config.max_disparity_px) // STEP_PX
        volume = layers.by_rows(
            lambda left, right: self.aggregate(concatenation_volume(left, right, bins)),
            (self.features(left), self.features(right)),
            halo=4,  # four convolutions follow each other
            rows=self.rows,
        )
        return self.refine(volume)

    def aggregate(self, volume: Volume) -> Volume:
        """Compute the volume that the hourglasses refine from a concatenation volume."""
        x = self.dres0[0](volume).relu_()
        del volume
        x = self.dres0[1](x).relu_()
        return self.dres1[1](self.dres1[0](x).relu_()).add_(x)

    def refine(self, volume: Volume) -> tuple[Volume, Volume, Volume]:
        """Compute the cost after each hourglass, from the volume of :meth:`aggregate`."""
        x = volume
        first_down = None
        up = None
        costs = []
        for module, head in zip(self.hourglasses, self.heads, strict=True):
            hourglass = cast("Hourglass", module)
            # Under the same name, so that one volume of the full size is held beside ``volume``.
            x = hourglass.down1(x)
            down, up = hourglass(x, first_down, up)
            first_down = down if first_down is None else first_down
            del down
            x = hourglass.up1(up).add_(volume)
            cost = layers.by_rows(head, (x,), halo=2, rows=self.rows)  # two convolutions
            costs.append(cost + costs[-1] if costs else cost)
        return cast("tuple[Volume, Volume, Volume]", tuple(costs))


ROWS = 32
"""Rows at quarter size that a matcher computes at a time."""


def psmnet_bytes(
    config: PSMNetConfig,
    span_px: int,
    height: int,
    width: int,
    dtype: torch.dtype,
    rows: int = ROWS,
) -> int:
    """Estimate the peak memory of matching a padded pair [bytes], with margin for the allocator.

    Two volumes of ``span_px`` disparities are held whole; ``rows`` at quarter size are computed at
    a time.
    """
    h = height // 4
    w = width // 4
    bins = span_px // STEP_PX
    row_bytes = config.width * w * dtype.itemsize
    map_bytes = row_bytes * h
    volume_bytes = map_bytes * bins
    cost_bytes = 4 * bins * h * w  # float32, one channel

    # Volumes of some rows, with the halo of the head's convolutions and of the aggregation's.
    head_slab_bytes = min(rows + 2 * 2, h) * row_bytes * bins
    aggregation_slab_bytes = min(rows + 2 * 4, h) * row_bytes * bins
    head_slabs = 2 if dtype.itemsize >= 4 else 4  # the head computes in float32

    # In the first stage five half-size maps, each of four times the pixels; in the last one joined
    # levels, twice.
    levels = 6 + len(config.pools)
    features_bytes = 2 * map_bytes * max(5 * 4, 2 * levels + 12)
    # The volume; of some rows the concatenation, and what a convolution makes of it.
    aggregation_bytes = volume_bytes + 2 * map_bytes + 3 * aggregation_slab_bytes
    # The volume, what is added to it, three half-size volumes; some rows in the head.
    hourglass_bytes = 2 * volume_bytes + 3 * volume_bytes // 4
    head_bytes = head_slabs * head_slab_bytes + 3 * cost_bytes
    # Costs, four maps of the full size in float32, and the rows of the soft arg-min.
    maps_bytes = 4 * 4 * height * width
    argmin_bytes = 4 * cost_bytes + maps_bytes + 5 * CHUNK_BYTES
    peak_bytes = max(features_bytes, aggregation_bytes, hourglass_bytes + head_bytes, argmin_bytes)
    return int(layers.MARGIN * peak_bytes) + layers.OVERHEAD_BYTES


class PSMNetMatcher(NetworkMatcher):
    """PSMNet with pre- and post-processing, as :class:`NetworkMatcher` says."""

    fine_pixels = 280_000
    """Pixels of a fine match at most: an image of KITTI at three quarters of its resolution."""
    activation_bytes = staticmethod(psmnet_bytes)

    def fold(self, network: PSMNet, example: Tensor) -> PSMNet:
        """Keep the last convolution of each head in float32, fold the batch norms of the rest.

        Volumes are then computed some rows at a time.
        """
        # The 8 significant bits of bf16 would round the expectation to whole pixels.
        in_float32 = torch.empty(0, device=self.device)
        no_bias = torch.zeros(1)
        for head in network.heads:
            cost = cast("nn.Conv3d", head.cost)
            head.cost = layers.VolumeConv(cost, cost.weight, no_bias, in_float32)
        network.rows = ROWS
        return layers.fold(network, example)

    def run(self, left: View, right: View, search: SearchRange) -> Match:
        """Match a normalised pair whose sides suit the network."""
        assert search.first_px == 0, "its volume begins at 0"
        height, width = left.shape[1:]
        left_views = left[None].to(self.dtype, memory_format=torch.channels_last)
        right_views = right[None].to(self.dtype, memory_format=torch.channels_last)
        cost = self._network.costs(left_views, right_views, search.span_px)[-1][0, 0]
        disparity_px, confidence = expected_disparity(
            cost.permute(1, 2, 0).contiguous(),
            (search.span_px, height, width),
            align_corners=self._network.config.align_corners,
            with_confidence=self.config.with_confidence,
        )
        return Match(disparity_px=disparity_px, confidence=confidence)


_PARTS = {"0": "conv", "1": "norm"}
"""Our names of the layers of a convolution with a norm, by the authors' numbers."""
_HOURGLASS = ("down1", "same1", "down2", "same2", "up2", "up1")
_RENAMES = {
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
"""Patterns of the authors' names, each with our name: of the feature extractor, and of the rest."""


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
    for published_name, tensor in state.items():  # an unknown name stays as it is, and is refused
        name = published_name.removeprefix("module.")
        prefix = next(prefix for prefix in _RENAMES if name.startswith(prefix))
        name = name.removeprefix(prefix)
        for pattern, our_name in _RENAMES[prefix]:
            name = re.sub(pattern, our_name, name)
        renamed[f"features.{name}" if prefix else name] = tensor
    # The counts of batches have no effect at inference; files older than 2018 do not hold them.
    counts = {
        name: tensor
        for name, tensor in network.state_dict().items()
        if name.endswith("batches_tracked")
    }
    checkpoint = Checkpoint(kind="psmnet", config={}, state={**counts, **renamed})
    load_weights(
        network, checkpoint, "the checkpoint of the stacked-hourglass PSMNet ('state_dict')"
    )
    return network.eval()


def import_psmnet(file: Path, out: Path, *, align_corners: bool) -> None:
    """Convert the authors' checkpoint to a weights file of ours.

    Args:
        file: their ``.tar``, a PyTorch file, not an archive to unpack. It is read without running
            the code that it may hold.
        out: the weights file.
        align_corners: as for :func:`psmnet_from_published`; recorded in ``out``.

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
