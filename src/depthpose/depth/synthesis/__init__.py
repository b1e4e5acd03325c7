"""Left image to right image: a U-Net (pix2pix), or selection of disparities (Deep3D)."""

from depthpose.depth.synthesis.generator import (
    PatchDiscriminator,
    PixelDiscriminator,
    UNetGenerator,
    make_discriminator,
)
from depthpose.depth.synthesis.selection import SelectionGenerator
from depthpose.depth.synthesis.synthesiser import (
    Generator,
    SelectionSynthesiser,
    SynthesisedViews,
    Synthesiser,
    UNetSynthesiser,
    make_synthesiser,
)

__all__ = [
    "Generator",
    "PatchDiscriminator",
    "PixelDiscriminator",
    "SelectionGenerator",
    "SelectionSynthesiser",
    "SynthesisedViews",
    "Synthesiser",
    "UNetGenerator",
    "UNetSynthesiser",
    "make_discriminator",
    "make_synthesiser",
]
