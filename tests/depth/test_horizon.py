"""Tilt and roll by the straight edges of an image."""

import math

import numpy as np
import pytest
import torch
from jaxtyping import Float
from PIL import Image, ImageDraw
from torch import Tensor

from depthpose.core.camera import Camera
from depthpose.core.camera.pinhole import intrinsics, resize_camera
from depthpose.depth.horizon import Angles, find_angles, find_segments

CAMERA = Camera(width=640, height=360, K=intrinsics(400.0, 400.0, 319.5, 179.5))
ABOUT = {"tilt_std_deg": 1.0, "roll_std_deg": 1.2}


def street(tilt_deg: float, roll_deg: float, scale: int = 1) -> Float[Tensor, "3 h w"]:
    """Draw lanes, eaves, corners of houses and poles of a street 1.6 m below a camera."""
    tilt = math.radians(tilt_deg)
    roll = math.radians(roll_deg)
    pitched = np.array([
        [1, 0, 0], [0, math.cos(tilt), math.sin(tilt)], [0, -math.sin(tilt), math.cos(tilt)],
    ])  # fmt: skip
    rolled = np.array([
        [math.cos(roll), -math.sin(roll), 0], [math.sin(roll), math.cos(roll), 0], [0, 0, 1],
    ])  # fmt: skip
    camera_from_world = rolled @ pitched
    sides = (-9.0, 9.0)
    lanes = [((x, 1.6, 4.0), (x, 1.6, 60.0)) for x in (-7.0, -3.5, -0.5, 3.0, 6.5)]
    eaves = [((x, y, 12.0), (x, y, 60.0)) for x in sides for y in (-6.0, -3.0, 0.0)]
    poles = [((x, -6.0, z), (x, 1.6, z)) for x in sides for z in (15.0, 22.0, 30.0, 40.0)]
    picture = Image.new("L", (640 * 4, 360 * 4), 90)
    draw = ImageDraw.Draw(picture)
    for ends in (*lanes, *eaves, *poles):
        pixels: list[tuple[float, float]] = []
        for end in ends:
            point = CAMERA.K.numpy() @ (camera_from_world @ np.array(end))
            u, v = point[:2] / point[2]
            pixels.append(((u + 0.5) * 4, (v + 0.5) * 4))
        draw.line(pixels, fill=220, width=12)
    small = picture.resize((640 * scale, 360 * scale), Image.Resampling.BOX)
    return torch.from_numpy(np.asarray(small).copy()).float().expand(3, -1, -1) / 255


@pytest.mark.parametrize(("tilt", "roll"), [(0.0, 0.0), (-5.0, 2.0), (5.0, -2.0)])
def test_edges_of_a_street_say_its_tilt_and_roll(tilt: float, roll: float) -> None:
    expected = Angles(tilt_deg=tilt + 1.2, roll_deg=roll - 1.0, **ABOUT)
    found = find_angles(street(tilt, roll), CAMERA, expected)
    assert found.tilt_deg == pytest.approx(tilt, abs=0.2)
    assert found.roll_deg == pytest.approx(roll, abs=0.5)
    assert found.tilt_std_deg < 0.3
    assert found.roll_std_deg < 0.8


@pytest.mark.parametrize("scale", [2, 4])
def test_a_large_image_says_the_same_as_a_small_one(scale: int) -> None:
    """Half a pixel of the smaller copy that a large image is made would be 0.03 degrees."""
    expected = Angles(tilt_deg=0.0, roll_deg=0.0, **ABOUT)
    large = resize_camera(CAMERA, 640 * scale, 360 * scale)
    small = find_angles(street(1.0, 0.5), CAMERA, expected)
    found = find_angles(street(1.0, 0.5, scale=scale), large, expected)
    assert found.tilt_deg == pytest.approx(small.tilt_deg, abs=0.01)
    assert found.roll_deg == pytest.approx(small.roll_deg, abs=0.01)


@pytest.mark.parametrize("value", [0.0, 0.5, 1.0])
def test_without_edges_what_is_expected_stays(value: float) -> None:
    expected = Angles(tilt_deg=-2.0, roll_deg=1.0, **ABOUT)
    found = find_angles(torch.full((3, 360, 640), value), CAMERA, expected)
    assert found.tilt_deg == pytest.approx(-2.0, abs=1e-6)
    assert found.roll_deg == pytest.approx(1.0, abs=1e-6)
    assert found.tilt_std_deg == pytest.approx(1.0, rel=0.05)
    assert found.roll_std_deg == pytest.approx(1.2, rel=0.1)


@pytest.mark.parametrize("slope", [0.1, 0.0])
def test_segments_are_the_straight_edges_to_a_part_of_a_pixel(slope: float) -> None:
    v, u = np.mgrid[:100, :200].astype(float)
    grey = 1 / (1 + np.exp(-(v - 50.3 - slope * (u - 100)) / 0.7))
    grey[:, :30] = 0.5
    longest = find_segments(grey)[0]
    along = longest[3] / longest[2]
    assert along == pytest.approx(slope, abs=0.005)
    assert longest[1] == pytest.approx(50.3 + slope * (longest[0] - 100), abs=0.1)
    assert longest[4] == pytest.approx(170, abs=10)


def test_a_circle_has_no_long_segment() -> None:
    v, u = np.mgrid[:200, :200].astype(float)
    grey = (np.hypot(u - 100, v - 100) < 60).astype(float)
    segments = find_segments(grey)
    assert len(segments) == 0 or segments[0, 4] < 45
