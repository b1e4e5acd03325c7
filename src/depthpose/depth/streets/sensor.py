"""From light to a picture: exposure, glare, blur, noise, tone, 8 bits, JPEG."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from depthpose.depth.degrade import through_jpeg


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """How one camera of a pair turns light into numbers.

    Attributes:
        exposure: factor of the light, by channel.
        blur: share of a pixel's light that falls on its neighbours, in each direction.
        glare: share of the light that the lens scatters widely.
        black: light below which there is only black.
        vignette: loss in the corners.
        noise: deviation of full light's noise, and of darkness'.
        gamma: exponent of the tone curve.
        jpeg_quality: None: not compressed.
        noise_seed: of this picture.
    """

    exposure: tuple[float, float, float]
    blur: float
    glare: float
    black: float
    vignette: float
    noise: tuple[float, float]
    gamma: float
    jpeg_quality: int | None
    noise_seed: int


def draw_sensors(
    rng: np.random.Generator, light: Float[Tensor, "h w 3"], jpeg_share: float
) -> tuple[Sensor, Sensor]:
    """Draw the cameras of a pair: alike, but for a little gain and colour.

    Args:
        rng: random numbers.
        light: what the left one receives; the exposure is set by it, sky aside.
        jpeg_share: how many pictures are compressed.
    """
    luminance = light.mean(-1)
    metered = luminance[len(luminance) // 3 :].clamp(max=1.2).mean() + 1e-3
    # Rounded, for the last bits of a long mean depend on how many threads took part.
    exposure = float(f"{float(0.27 / metered):.4g}") * float(np.exp(rng.normal(0, 0.28)))
    white = np.exp(rng.normal(0, 0.035, 3))
    is_jpeg = bool(rng.random() < jpeg_share)
    common = {
        "blur": rng.uniform(0.0, 0.22),
        "glare": rng.uniform(0, 0.02),
        "black": rng.uniform(0, 0.025),
        "vignette": rng.uniform(0, 0.2),
        "noise": (rng.uniform(0.004, 0.025), rng.uniform(0.0005, 0.004)),
        "gamma": rng.uniform(1.6, 2.1),
        "jpeg_quality": int(rng.integers(75, 98)) if is_jpeg else None,
    }
    gain = np.exp(rng.normal(0, 0.02) + rng.normal(0, 0.006, 3))
    seeds = rng.integers(1 << 31, size=2)
    left, right = (
        Sensor(exposure=tuple((exposure * white * factor).tolist()), noise_seed=int(seed), **common)
        for factor, seed in ((1.0, seeds[0]), (gain, seeds[1]))
    )
    return left, right


def expose(light: Float[Tensor, "h w 3"], sensor: Sensor) -> Float[Tensor, "3 h w"]:
    """Take a picture: RGB in [0, 1], in steps of 1/255."""
    signal = light.permute(2, 0, 1) * torch.tensor(sensor.exposure)[:, None, None]
    signal = signal * _vignette(signal, sensor.vignette)
    signal = _blurred(_with_glare(signal, sensor.glare), sensor.blur)
    generator = torch.Generator().manual_seed(sensor.noise_seed)
    shot, dark = sensor.noise
    deviation = (signal * shot**2 + dark**2).sqrt()
    signal = signal + torch.randn(signal.shape, generator=generator) * deviation
    # A shoulder before white, as cameras have; the brightest is lost all the same.
    signal = (signal - sensor.black) / (1 - sensor.black)
    signal = (signal * 1.12 / (1 + 0.12 * signal.clamp(min=0))).clamp(0, 1)
    picture = (signal ** (1 / sensor.gamma) * 255 + 0.5).floor() / 255
    return picture if sensor.jpeg_quality is None else through_jpeg(picture, sensor.jpeg_quality)


def _vignette(signal: Float[Tensor, "3 h w"], loss: float) -> Float[Tensor, "h w"]:
    height, width = signal.shape[1:]
    y = torch.linspace(-1, 1, height)[:, None] * height / width
    x = torch.linspace(-1, 1, width)[None]
    return 1 - loss * (x**2 + y**2) / 1.1


def _with_glare(signal: Float[Tensor, "3 h w"], share: float) -> Float[Tensor, "3 h w"]:
    height, width = signal.shape[1:]
    small = F.adaptive_avg_pool2d(
        signal.clamp(max=6)[None], (max(height // 32, 1), max(width // 32, 1))
    )
    wide = F.interpolate(F.avg_pool2d(small, 3, 1, 1), (height, width), mode="bilinear")[0]
    return torch.lerp(signal.clamp(max=8), wide, share)


def _blurred(signal: Float[Tensor, "3 h w"], share: float) -> Float[Tensor, "3 h w"]:
    for axis in (1, 2):
        size = signal.shape[axis]
        before = signal.narrow(axis, 0, 1), signal.narrow(axis, 0, size - 1)
        after = signal.narrow(axis, 1, size - 1), signal.narrow(axis, size - 1, 1)
        beside = torch.cat(before, axis) + torch.cat(after, axis)
        signal = signal * (1 - share) + beside * (share / 2)
    return signal
