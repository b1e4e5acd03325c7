"""The light of a day: sun, sky, clouds and haze."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

Vector = Float64[np.ndarray, "3"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Weather:
    """What lights a scene.

    Attributes:
        sun: unit vector towards the sun, in the world's frame (y down).
        sun_color: linear light of the sun; small where clouds hide it.
        zenith: light of the sky overhead.
        horizon: light of the sky low down.
        is_overcast: no shadows are cast.
        cloud: 0 a clear sky, 1 covered.
        haze_m: distance at which two thirds of the light are the haze's.
        shift: where clouds and unevenness lie in their textures.
    """

    sun: Vector
    sun_color: Vector
    zenith: Vector
    horizon: Vector
    is_overcast: bool
    cloud: float
    haze_m: float
    shift: tuple[float, float]


def draw_weather(rng: np.random.Generator) -> Weather:
    """Draw a day: mostly sun, as where KITTI was recorded, else overcast; sometimes hazy."""
    is_overcast = bool(rng.random() < 0.25)
    height = np.deg2rad(rng.uniform(12, 62))
    turn = rng.uniform(0, 2 * np.pi)
    sun = np.array([np.cos(height) * np.sin(turn), -np.sin(height), np.cos(height) * np.cos(turn)])
    low = np.clip((height - 0.2) / 0.6, 0, 1)
    strength = rng.uniform(0, 0.2) if is_overcast else rng.uniform(3.2, 5.0)
    sky = rng.uniform(0.8, 1.5) * (1.2 if is_overcast else 1.0)
    blue = np.array([0.85, 0.9, 1.0]) if is_overcast else np.array([0.13, 0.33, 0.85])
    pale = np.array([0.95, 0.98, 1.0]) if is_overcast else np.array([0.42, 0.68, 1.05])
    glare = 1.0 if is_overcast else max(1.0, float(np.exp(rng.uniform(-0.5, 1.3))))
    haze = rng.uniform(220, 600) if rng.random() < 0.12 else rng.uniform(600, 4000)
    return Weather(
        sun=sun,
        sun_color=np.array([1.0, 0.78 + 0.18 * low, 0.55 + 0.36 * low]) * strength,
        zenith=blue * sky * glare**0.5,
        # The more it glares, the whiter it is.
        horizon=(pale / glare + (1 - 1 / glare)) * sky * glare,
        is_overcast=is_overcast,
        cloud=float(rng.uniform(0.3, 1)) if is_overcast else float(rng.uniform(0, 1)) ** 2,
        haze_m=float(haze),
        shift=(float(rng.random()), float(rng.random())),
    )
