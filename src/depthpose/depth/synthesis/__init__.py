"""Left image to right image: a U-Net that paints (pix2pix), a network that selects (Deep3D)."""

from depthpose.depth.synthesis.generator import (
    PatchDiscriminator,
    PixelDiscriminator,
    UNetGenerator,
    make_discriminator,
)
from depthpose.depth.synthesis.openvino import openvino_generator
from depthpose.depth.synthesis.selection import SelectionGenerator
from depthpose.depth.synthesis.synthesiser import (
    Drawn,
    Generator,
    PaintingSynthesiser,
    SelectionSynthesiser,
    Synthesiser,
    make_synthesiser,
)

__all__ = [
    "Drawn",
    "Generator",
    "PaintingSynthesiser",
    "PatchDiscriminator",
    "PixelDiscriminator",
    "SelectionGenerator",
    "SelectionSynthesiser",
    "Synthesiser",
    "UNetGenerator",
    "make_discriminator",
    "make_synthesiser",
    "openvino_generator",
]
