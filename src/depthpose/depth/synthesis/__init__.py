"""Left image to right image: a U-Net (pix2pix), or selection of disparities (Deep3D)."""

from depthpose.depth.synthesis.networks import PatchDiscriminator as PatchDiscriminator
from depthpose.depth.synthesis.networks import PixelDiscriminator as PixelDiscriminator
from depthpose.depth.synthesis.networks import SelectionGenerator as SelectionGenerator
from depthpose.depth.synthesis.networks import UNetGenerator as UNetGenerator
from depthpose.depth.synthesis.networks import make_discriminator as make_discriminator
from depthpose.depth.synthesis.synthesiser import Generator as Generator
from depthpose.depth.synthesis.synthesiser import SelectionSynthesiser as SelectionSynthesiser
from depthpose.depth.synthesis.synthesiser import SynthesisedViews as SynthesisedViews
from depthpose.depth.synthesis.synthesiser import Synthesiser as Synthesiser
from depthpose.depth.synthesis.synthesiser import UNetSynthesiser as UNetSynthesiser
from depthpose.depth.synthesis.synthesiser import make_synthesiser as make_synthesiser
