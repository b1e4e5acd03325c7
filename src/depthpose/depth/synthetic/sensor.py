"""The sensor of a synthetic camera: from light to a picture, with the faults of real ones."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from depthpose.depth.augment import through_jpeg
from depthpose.depth.types import View


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """Properties of one camera of a pair, by which light becomes a picture."""

    exposure: tuple[float, float, float]  # factor of the light, by channel
    blur: float  # share of a pixel's light that falls on its neighbours, along each axis
    glare: float  # share of the light that the lens scatters widely
    black: float  # light below which all is black
    vignette: float  # loss of light in the corners, as a share
    shot_noise: float  # its standard deviation at white; it grows with the root of the light
    read_noise: float  # its standard deviation, at any light
    gamma: float  # exponent of the tone curve
    jpeg_quality: int | None  # None: not compressed
    noise_seed: int  # seed of the noise of this picture


_METERED_LIGHT = 0.27
"""Mean light of a picture of a usual exposure, where 1 is white."""


def draw_sensors(
    rng: np.random.Generator, light: Float[Tensor, "h w 3"], jpeg_share: float
) -> tuple[Sensor, Sensor]:
    """Draw the cameras of a pair at random, equal but for small differences of gain and colour.

    Their exposure is metered by ``light``; ``jpeg_share`` is the probability of compression.
    """
    # The sky counts little: the upper third is left out, and bright light is cut off.
    luminance = light.mean(-1)
    metered = luminance[len(luminance) // 3 :].clamp(max=1.2).mean() + 1e-3
    # Rounded, for the last bits of a long mean depend on how many threads took part.
    usual_exposure = float(f"{float(_METERED_LIGHT / metered):.4g}")
    exposure = usual_exposure * float(np.exp(rng.normal(0, 0.28)))

    white_balance = np.exp(rng.normal(0, 0.035, 3))
    is_jpeg = bool(rng.random() < jpeg_share)
    common = {
        "blur": rng.uniform(0.0, 0.22),
        "glare": rng.uniform(0, 0.02),
        "black": rng.uniform(0, 0.025),
        "vignette": rng.uniform(0, 0.2),
        "shot_noise": rng.uniform(0.004, 0.025),
        "read_noise": rng.uniform(0.0005, 0.004),
        "gamma": rng.uniform(1.6, 2.1),
        "jpeg_quality": int(rng.integers(75, 98)) if is_jpeg else None,
    }
    right_gain = np.exp(rng.normal(0, 0.02) + rng.normal(0, 0.006, 3))
    left_seed, right_seed = (int(seed) for seed in rng.integers(1 << 31, size=2))
    left_exposure = tuple((exposure * white_balance).tolist())
    right_exposure = tuple((exposure * white_balance * right_gain).tolist())
    left = Sensor(exposure=left_exposure, noise_seed=left_seed, **common)
    right = Sensor(exposure=right_exposure, noise_seed=right_seed, **common)
    return left, right


_GLARE_BLOCK_PX = 32
"""Side of the blocks whose light glare spreads over their neighbours."""
_MAX_GLARE_LIGHT = 6
_SATURATED_LIGHT = 8
"""Most light of a pixel, in units of white, that glare spreads, and that the pixel itself takes."""
_CORNER_RADIUS_2 = 1.1
"""Squared distance of the corners of an image of 3:1 from its centre, in half widths."""
_SHOULDER = 0.12
"""How much the tone curve flattens towards white."""


def expose(light: Float[Tensor, "h w 3"], sensor: Sensor) -> View:
    """Take a picture of the light by a sensor: RGB in [0, 1], in steps of 1/255."""
    # Exposure, and a vignette that grows with the squared distance from the centre.
    signal = light.permute(2, 0, 1) * torch.tensor(sensor.exposure)[:, None, None]
    height, width = signal.shape[1:]
    y = torch.linspace(-1, 1, height)[:, None] * height / width
    x = torch.linspace(-1, 1, width)[None]
    signal = signal * (1 - sensor.vignette * (x**2 + y**2) / _CORNER_RADIUS_2)

    # Veiling glare: light of blocks spreads over their neighbours.
    blocks = (max(height // _GLARE_BLOCK_PX, 1), max(width // _GLARE_BLOCK_PX, 1))
    block_light = F.adaptive_avg_pool2d(signal.clamp(max=_MAX_GLARE_LIGHT)[None], blocks)
    spread = F.avg_pool2d(block_light, 3, 1, 1)
    glare = F.interpolate(spread, (height, width), mode="bilinear")[0]
    signal = torch.lerp(signal.clamp(max=_SATURATED_LIGHT), glare, sensor.glare)

    # Blur of the lens: three taps along both axes; at the border a pixel is its own neighbour.
    for axis, size in ((1, height), (2, width)):
        before = signal.narrow(axis, 0, 1), signal.narrow(axis, 0, size - 1)
        after = signal.narrow(axis, 1, size - 1), signal.narrow(axis, size - 1, 1)
        beside = torch.cat(before, axis) + torch.cat(after, axis)
        signal = signal * (1 - sensor.blur) + beside * (sensor.blur / 2)

    # Shot noise and read noise.
    generator = torch.Generator().manual_seed(sensor.noise_seed)
    deviation = (signal * sensor.shot_noise**2 + sensor.read_noise**2).sqrt()
    signal = signal + torch.randn(signal.shape, generator=generator) * deviation

    # The tone curve: a shoulder before white, as cameras have; beyond it light is clipped.
    signal = (signal - sensor.black) / (1 - sensor.black)
    signal = (signal * (1 + _SHOULDER) / (1 + _SHOULDER * signal.clamp(min=0))).clamp(0, 1)
    picture = (signal ** (1 / sensor.gamma) * 255 + 0.5).floor() / 255
    return picture if sensor.jpeg_quality is None else through_jpeg(picture, sensor.jpeg_quality)
