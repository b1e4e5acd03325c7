"""What a camera, weather and files do to a picture: changes of the input alone, never of truth."""

from io import BytesIO

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from depthpose.depth.config import DegradeConfig

Picture = Float[Tensor, "3 h w"]
_LUMA = (0.299, 0.587, 0.114)


def degrade(image: Picture, config: DegradeConfig, generator: torch.Generator) -> Picture:
    """Change colours and sharpness of an image at random; where things are stays as it is.

    Args:
        image: RGB in [0, 1].
        config: how much, and how often.
        generator: decides.
    """
    draw = _Draw(generator)
    if draw.share(config.hue_share):
        image = image[torch.randperm(3, generator=generator)]
    image = _recoloured(image, config.colour, draw)
    if draw.share(config.veil_share):
        image = _veiled(image, draw)
    if draw.share(config.glare_share):
        image = _glaring(image, draw)
    if draw.share(config.blur_share):
        image = _blurred(image, draw.between(0.3, config.blur_px))
    if draw.share(config.noise_share):
        noise = torch.randn(image.shape, generator=generator)
        image = image + noise * draw.between(0.0, config.noise)
    image = image.clamp(0, 1)
    if draw.share(config.jpeg_share):
        image = through_jpeg(image, int(draw.between(40.0, 95.0)))
    return image


def through_jpeg(image: Picture, quality: int) -> Picture:
    """Give what is left of an image after JPEG of ``quality`` (1 to 95), 4:4:4."""
    pixels = (image.permute(1, 2, 0) * 255).round().byte().numpy()
    file = BytesIO()
    Image.fromarray(pixels).save(file, "JPEG", quality=quality, subsampling=0)
    decoded = np.array(Image.open(file), np.float32) / 255
    return torch.from_numpy(decoded).permute(2, 0, 1).contiguous()


class _Draw:
    """Random numbers of one image."""

    def __init__(self, generator: torch.Generator) -> None:
        self.generator = generator

    def between(self, low: float, high: float) -> float:
        return low + (high - low) * float(torch.rand((), generator=self.generator))

    def share(self, share: float) -> bool:
        return self.between(0.0, 1.0) < share


def _recoloured(image: Picture, strength: float, draw: _Draw) -> Picture:
    """Scale exposure, contrast, saturation and each channel by 1 +- ``strength``; bend by gamma."""
    exposure, contrast, saturation, gamma = (
        draw.between(1 - strength, 1 + strength) for _ in range(4)
    )
    tint = torch.tensor([draw.between(1 - strength / 3, 1 + strength / 3) for _ in range(3)])
    grey = (image * image.new_tensor(_LUMA)[:, None, None]).sum(0)
    image = grey + (image - grey) * saturation
    mean = image.mean()
    image = ((image - mean) * contrast + mean) * exposure * tint[:, None, None]
    return image.clamp(0, 1) ** gamma


def _veiled(image: Picture, draw: _Draw) -> Picture:
    """Lay haze over the image: a share of one light grey everywhere."""
    return torch.lerp(image, torch.full_like(image, draw.between(0.5, 1.0)), draw.between(0.0, 0.4))


def _glaring(image: Picture, draw: _Draw) -> Picture:
    """Add light that fades from one place on: a low sun, a lamp."""
    height, width = image.shape[1:]
    y = torch.linspace(0, 1, height)[:, None] - draw.between(0.0, 0.6)
    x = (torch.linspace(0, 1, width) - draw.between(0.0, 1.0)) * width / height
    reach = draw.between(0.2, 0.8)
    return image + draw.between(0.1, 0.6) * torch.exp(-(x**2 + y**2) / (2 * reach**2))


def _blurred(image: Picture, deviation_px: float) -> Picture:
    places = torch.arange(-3.0, 4.0)
    kernel = torch.exp(-(places**2) / (2 * deviation_px**2))
    kernel = kernel / kernel.sum()
    padded = F.pad(image[:, None], (3, 3, 3, 3), mode="replicate")
    blurred = F.conv2d(F.conv2d(padded, kernel[None, None, None]), kernel[None, None, :, None])
    return blurred[:, 0]
