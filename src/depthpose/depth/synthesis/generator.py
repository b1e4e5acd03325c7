"""U-Net generator of pix2pix (Isola et al., CVPR 2017): left view to right view.

With the discriminators of pix2pix: is this right view real, given its left one?
"""

from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from depthpose.core.errors import InputError
from depthpose.depth.config import GeneratorConfig

Images = Float[Tensor, "b 3 h w"]


class UNetGenerator(nn.Module):
    """Strided 4x4 convolutions down to a bottleneck and up again, with skips by concatenation.

    Takes and answers RGB in [-1, 1]; both sides are multiples of ``2 ** levels``. There is no noise
    input (thesis, 2.3.3). Eight levels at width 64 have 54,413,955 parameters; skips are
    concatenated before their ReLU. Dropout works in train mode alone.
    """

    def __init__(self, config: GeneratorConfig | None = None) -> None:
        super().__init__()
        self.config = config or GeneratorConfig()
        widths = self.config.widths
        pairs = list(zip((3, *widths), widths, strict=False))
        inner = len(widths) - 1
        # No norm in the outermost level (raw colours) nor the innermost (one pixel may be left).
        self.down = nn.ModuleList(
            _Level(nn.Conv2d(a, b, 4, 2, 1, bias=False), with_norm=0 < level < inner)
            for level, (a, b) in enumerate(pairs)
        )
        self.up = nn.ModuleList(self._up_level(level) for level in range(len(widths)))
        self.apply(initialise)

    def _up_level(self, level: int) -> nn.Module:
        """Level of the decoder that answers at the size of the encoder's input of ``level``."""
        widths = self.config.widths
        inputs = widths[level] * (1 if level == len(widths) - 1 else 2)
        if level == 0:
            return _Level(nn.ConvTranspose2d(inputs, 3, 4, 2, 1), with_norm=False)
        outputs = widths[level - 1]
        conv = nn.ConvTranspose2d(inputs, outputs, 4, 2, 1, bias=False)
        return _Level(conv, with_norm=True, dropout=0.5 if self._has_dropout(level) else 0.0)

    def _has_dropout(self, level: int) -> bool:
        """The three inner blocks between full widths, without the innermost itself."""
        return 5 <= level + 1 < self.config.levels and self.config.with_dropout

    def forward(self, left: Images) -> Images:
        """Draw the right view of each image.

        Raises:
            InputError: a side is no multiple of ``2 ** levels``.
        """
        self._check_size(left)
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

    def _check_size(self, image: Images) -> None:
        side = self.config.side_multiple_px
        if image.shape[-2] % side or image.shape[-1] % side:
            raise InputError(
                f"the generator of {self.config.levels} levels takes sides that are multiples of "
                f"{side} px, got {image.shape[-2]}x{image.shape[-1]}; pad them, as Synthesiser does"
            )


class _Level(nn.Module):
    """Convolution, norm and dropout of one level; activations stand before it."""

    def __init__(
        self, conv: nn.Conv2d | nn.ConvTranspose2d, *, with_norm: bool, dropout: float = 0.0
    ) -> None:
        super().__init__()
        self.conv = conv
        self.norm = nn.BatchNorm2d(conv.out_channels) if with_norm else nn.Identity()
        self.dropout = nn.Dropout(dropout) if dropout else nn.Identity()

    def forward(self, x: Tensor) -> Tensor:
        return self.dropout(self.norm(self.conv(x)))


def initialise(module: nn.Module) -> None:
    """Draw weights as pix2pix does: N(0, 0.02), batch norm N(1, 0.02), biases zero."""
    if isinstance(module, nn.Conv2d | nn.ConvTranspose2d):
        nn.init.normal_(module.weight, 0.0, 0.02)
    elif isinstance(module, nn.BatchNorm2d):
        nn.init.normal_(module.weight, 1.0, 0.02)
    else:
        return
    if module.bias is not None:
        nn.init.zeros_(module.bias)


Logits = Float[Tensor, "b 1 rows columns"]


class PatchDiscriminator(nn.Module):
    """Score each 70x70 patch: C64-C128-C256-C512-1; 2,768,705 parameters at width 64."""

    def __init__(self, width: int = 64) -> None:
        super().__init__()
        widths = (width, 2 * width, 4 * width, 8 * width)
        layers: list[nn.Module] = [nn.Conv2d(6, width, 4, 2, 1), nn.LeakyReLU(0.2)]
        for inputs, outputs, stride in zip(widths, widths[1:], (2, 2, 1), strict=False):
            layers += [
                nn.Conv2d(inputs, outputs, 4, stride, 1, bias=False),
                nn.BatchNorm2d(outputs),
                nn.LeakyReLU(0.2),
            ]
        self.layers = nn.Sequential(*layers, nn.Conv2d(widths[-1], 1, 4, 1, 1))
        self.apply(initialise)

    def forward(self, left: Images, right: Images) -> Logits:
        """Answer one logit a patch; images are RGB in [-1, 1]."""
        return self.layers(torch.cat([left, right], 1))


class PixelDiscriminator(nn.Module):
    """Score each pixel alone: 1x1 convolutions 64-128-1; 9,024 parameters at width 64."""

    def __init__(self, width: int = 64) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Conv2d(6, width, 1),
            nn.LeakyReLU(0.2),
            nn.Conv2d(width, 2 * width, 1, bias=False),
            nn.BatchNorm2d(2 * width),
            nn.LeakyReLU(0.2),
            nn.Conv2d(2 * width, 1, 1, bias=False),
        )
        self.apply(initialise)

    def forward(self, left: Images, right: Images) -> Logits:
        """Answer one logit a pixel; images are RGB in [-1, 1]."""
        return self.layers(torch.cat([left, right], 1))


def make_discriminator(kind: Literal["patch", "pixel"], width: int) -> nn.Module:
    """Make a discriminator by name.

    Raises:
        InputError: there is none of that name.
    """
    if kind not in ("patch", "pixel"):
        raise InputError(f"discriminator must be 'patch' or 'pixel', got {kind!r}")
    return PatchDiscriminator(width) if kind == "patch" else PixelDiscriminator(width)
