"""Left image to right image: U-Net generator, patch and pixel discriminators (pix2pix)."""

from depthpose.depth.synthesis.discriminators import (
    PatchDiscriminator,
    PixelDiscriminator,
    make_discriminator,
)
from depthpose.depth.synthesis.generator import UNetGenerator
from depthpose.depth.synthesis.synthesiser import Synthesiser

__all__ = [
    "PatchDiscriminator",
    "PixelDiscriminator",
    "Synthesiser",
    "UNetGenerator",
    "make_discriminator",
]
