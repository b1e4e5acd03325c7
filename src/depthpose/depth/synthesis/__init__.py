"""Left image to right image: a U-Net (pix2pix), or selection of disparities (Deep3D)."""

from depthpose.depth.synthesis.networks import (
    PatchDiscriminator,
    PixelDiscriminator,
    SelectionGenerator,
    UNetGenerator,
    make_discriminator,
)
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
