"""Networks that synthesise the right view: a U-Net, or a selection of disparities.

The U-Net is pix2pix's (Isola et al., CVPR 2017). The selecting generator gives, for each pixel of
either view, a distribution over disparities (Xie et al., Deep3D, ECCV 2016; Luo et al., Single View
Stereo Matching, CVPR 2018): that of the right view says where to sample the left image, and that of
the left view is depth already. Class 0 is the sky, whose disparity is zero.
"""

import math
from collections import OrderedDict
from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from depthpose.core.errors import InputError
from depthpose.depth.config import GeneratorConfig, SelectionConfig
from depthpose.depth.encoder import LiteEncoder
from depthpose.depth.types import Views

_FIRST_DROPOUT_LEVEL = 4  # outermost level of the decoder with dropout


class UNetGenerator(nn.Module):
    """pix2pix's U-Net: strided 4x4 convolutions down to a bottleneck and up again, with skips.

    Left views to right views, RGB in [-1, 1]; both sides are multiples of ``2 ** levels``. There is
    no noise input (thesis, 2.3.3). Eight levels at width 64 have 54,413,955 parameters; skips are
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

        # The decoder: the output of a level has the size of the encoder's input of that level.
        for level, outputs in enumerate((3, *widths[:-1])):
            inputs = widths[level] if level == deepest else 2 * widths[level]  # with a skip
            conv = nn.ConvTranspose2d(inputs, outputs, 4, 2, 1, bias=level == 0)
            norm = nn.BatchNorm2d(outputs) if level > 0 else nn.Identity()
            # pix2pix has dropout in the three blocks of full width that are not the innermost.
            is_inner = _FIRST_DROPOUT_LEVEL <= level < deepest
            has_dropout = self.config.with_dropout and is_inner
            dropout = nn.Dropout(0.5) if has_dropout else nn.Identity()
            self.up.append(nn.Sequential(OrderedDict(conv=conv, norm=norm, dropout=dropout)))
        self.apply(_initialise_as_pix2pix)

    def forward(self, left: Views) -> Views:
        """Synthesise the right view of each left view, RGB in [-1, 1].

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


def _initialise_as_pix2pix(module: nn.Module) -> None:
    """Initialise a layer as pix2pix does: weights N(0, 0.02), of norms N(1, 0.02), biases zero."""
    if isinstance(module, nn.Conv2d | nn.ConvTranspose2d):
        nn.init.normal_(module.weight, 0.0, 0.02)
    elif isinstance(module, nn.BatchNorm2d):
        nn.init.normal_(module.weight, 1.0, 0.02)
    else:
        return
    if module.bias is not None:
        nn.init.zeros_(module.bias)


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
        self.apply(_initialise_as_pix2pix)

    def forward(self, left: Views, right: Views) -> Float[Tensor, "b 1 rows columns"]:
        """Compute the logit that each patch or pixel is real; images are RGB in [-1, 1]."""
        return self.layers(torch.cat([left, right], 1))


Logits = Float[Tensor, "b classes rows columns"]
Planes = Float[Tensor, " planes"]


class SelectionGenerator(nn.Module):
    """EfficientNet-Lite, a decoder with skips, and logits over disparities and the sky.

    Takes RGB in [0, 1], sides multiples of 32. Its logits, of the left and of the right view at
    half the size, are those of class 0, the sky, and of classes k, the disparities
    ``planes[k - 1]`` [px at the input's width].
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

        # The heads: logits of both views, and a logistic regression whether the image is a street.
        self.head = nn.Conv2d(widths[-1], 2 * (self.config.planes + 1), 1)
        # Three moments of each feature (:meth:`street_probability`).
        self.street = nn.Linear(3 * deepest_channels, 1) if self.config.with_street else None

        # Computed on the CPU: for the meta device torch would import its compiler.
        low, high = self.config.disparity_px
        log_planes = torch.linspace(math.log(low), math.log(high), self.config.planes, device="cpu")
        planes = log_planes.exp()
        device = torch.get_default_device()
        planes = planes if device.type == "meta" else planes.to(device)
        self.register_buffer("planes", planes, persistent=False)

    def forward(self, image: Views) -> tuple[Logits, Logits]:
        """Compute the logits of the left and of the right view.

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
        """Compute the logits of both views from the encoder's features, from stride 2 to 32."""
        *skips, deepest = features
        x = self.top(deepest)
        for level, skip in zip(self.decoder, reversed(skips), strict=True):
            enlarged = F.interpolate(x, scale_factor=2.0, mode="nearest")
            x = level(torch.cat([enlarged, skip], 1))
        left, right = self.head(x).chunk(2, 1)
        return left, right

    def street_probability(self, deepest: Float[Tensor, "b c _ _"]) -> Float[Tensor, " b"] | None:
        """Compute the probability that each image shows a street, by a logistic regression.

        None where the weights have no such regression. ``deepest``: the encoder's features at
        stride 32.
        """
        if self.street is None:
            return None
        # A street has its sky above and its road below, so the regression takes moments over the
        # rows: features weighted by the first three Legendre polynomials of y, -1 (top) to 1.
        rows = deepest.shape[2]
        y = (2 * torch.arange(rows, device=deepest.device) + 1) / rows - 1
        row_means = deepest.float().mean(3)
        polynomials = (torch.ones_like(y), y, 1.5 * y**2 - 0.5)
        moments = [(row_means * polynomial).mean(2) for polynomial in polynomials]
        return self.street(torch.cat(moments, 1))[:, 0].sigmoid()


Generator = UNetGenerator | SelectionGenerator
"""A network that synthesises right views."""
