"""What a synthetic scene consists of: its mesh, its weather and the markings of its road."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float64

from depthpose.depth.synthetic.mesh import Mesh
from depthpose.depth.synthetic.road import Place

Vector = Float64[np.ndarray, "3"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Weather:
    """The light of a scene; colours are linear RGB, 1 the white of a bright sky."""

    sun: Vector  # unit vector towards the sun, in the world's frame (y down)
    sun_color: Vector  # light of the sun; small where clouds cover it
    zenith: Vector  # light of the sky at the zenith
    horizon: Vector  # light of the sky at the horizon
    is_overcast: bool  # no shadows are cast
    cloud: float  # cover of clouds: 0 a clear sky, 1 covered
    haze_m: float  # distance at which two thirds of the light come from haze
    shift: tuple[float, float]  # offset of the textures of clouds and stains [tiles]


def draw_weather(rng: np.random.Generator) -> Weather:
    """Draw random weather: mostly sunny, as KITTI's, else overcast; sometimes hazy."""
    is_overcast = bool(rng.random() < 0.25)

    # Direction to the sun.
    elevation = np.deg2rad(rng.uniform(12, 62))
    azimuth = rng.uniform(0, 2 * np.pi)
    cos_elevation = np.cos(elevation)
    sun = np.array(
        [cos_elevation * np.sin(azimuth), -np.sin(elevation), cos_elevation * np.cos(azimuth)]
    )

    # Light of the sun, redder where it is low: 0 at 0.2 rad, 1 from 0.8 rad on.
    whiteness = np.clip((elevation - 0.2) / 0.6, 0, 1)
    sun_strength = rng.uniform(0, 0.2) if is_overcast else rng.uniform(3.2, 5.0)
    sun_color = np.array([1.0, 0.78 + 0.18 * whiteness, 0.55 + 0.36 * whiteness]) * sun_strength

    # Light of the sky. With glare it is brighter, and whiter at the horizon.
    sky_strength = rng.uniform(0.8, 1.5) * (1.2 if is_overcast else 1.0)
    zenith_hue = np.array([0.85, 0.9, 1.0]) if is_overcast else np.array([0.13, 0.33, 0.85])
    horizon_hue = np.array([0.95, 0.98, 1.0]) if is_overcast else np.array([0.42, 0.68, 1.05])
    glare = 1.0 if is_overcast else max(1.0, float(np.exp(rng.uniform(-0.5, 1.3))))
    whitened_hue = horizon_hue / glare + (1 - 1 / glare)

    is_hazy = rng.random() < 0.12
    haze_m = rng.uniform(220, 600) if is_hazy else rng.uniform(600, 4000)
    return Weather(
        sun=sun,
        sun_color=sun_color,
        zenith=zenith_hue * sky_strength * glare**0.5,
        horizon=whitened_hue * sky_strength * glare,
        is_overcast=is_overcast,
        cloud=float(rng.uniform(0.3, 1)) if is_overcast else float(rng.uniform(0, 1)) ** 2,
        haze_m=float(haze_m),
        shift=(float(rng.random()), float(rng.random())),
    )


@dataclass(frozen=True, kw_only=True)
class LaneLine:
    """A line of paint along the road, solid or dashed."""

    x_m: float
    half_width_m: float
    period_m: float  # distance from dash to dash
    dash_m: float  # length of a dash; of a solid line the period


@dataclass(frozen=True, kw_only=True)
class CrossBar:
    """A bar of paint across the road: a stop line, or with stripes a zebra crossing."""

    s_m: float  # its middle along the road
    half_length_m: float  # half of its extent along the road
    first_x_m: float
    last_x_m: float
    is_striped: bool


@dataclass(frozen=True, kw_only=True)
class Markings:
    """Paint on the road, in road coordinates (x across, s along) [m]."""

    lines: tuple[LaneLine, ...]
    bars: tuple[CrossBar, ...]
    brightness: float  # brightness of the paint
    first_lane_x_m: float  # x of the left edge of the left lane
    lane_m: float  # width of the lanes: wheels darken two tracks in each


NO_MARKINGS = Markings(
    lines=(),
    bars=(),
    brightness=0.5,
    first_lane_x_m=0.0,
    lane_m=3.0,
)
"""Markings of a scene without a road."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SyntheticScene:
    """Surfaces and light, in the frame of the left camera (x right, y down, z forward) [m]."""

    mesh: Mesh  #: all surfaces
    markings: Markings  #: paint on the road
    weather: Weather  #: the light, in the world's frame
    camera_from_world: Float64[np.ndarray, "3 3"]  #: rotation of the camera
    place: Place | Literal["clutter"]  #: kind of the surroundings; clutter: no street
