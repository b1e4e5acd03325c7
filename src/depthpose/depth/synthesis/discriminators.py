"""Discriminators of pix2pix: is this right view real, given its left one?"""

from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from depthpose.core.errors import InputError
from depthpose.depth.synthesis.generator import initialise

Images = Float[Tensor, "b 3 h w"]
Logits = Float[Tensor, "b 1 rows columns"]


class PatchDiscriminator(nn.Module):
    """Judge each 70x70 patch: C64-C128-C256-C512-1; 2,768,705 parameters at width 64."""

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
    """Judge each pixel alone: 1x1 convolutions 64-128-1; 9,024 parameters at width 64."""

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
