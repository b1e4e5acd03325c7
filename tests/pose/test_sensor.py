"""The noise of a depth image, as evidence is counted in it."""

import math

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from depthpose.pose.sensor import (
    FLAT_M,
    LEAST_DEVIATION_M,
    NOISE_PER_M2,
    SHARED_PER_WHITE,
    DepthNoise,
    measure_noise,
    measure_noise_per_m2,
    measure_shared_per_white,
    plane_tolerance_m,
)


def tilted_plane(noise_m: float) -> np.ndarray:
    """A plane that leans away, 120 x 160 readings with independent noise."""
    columns, rows = np.meshgrid(np.arange(160), np.arange(120))
    noise = np.random.default_rng(0).normal(size=(120, 160))
    return 0.8 + 0.0004 * columns + 0.0007 * rows + noise_m * noise


@pytest.mark.parametrize("noise_m", [0.0, 0.0005, 0.003])
def test_noise_of_a_leaning_plane_is_that_of_its_readings(noise_m: float) -> None:
    everywhere = np.ones((120, 160), dtype=bool)
    noise = measure_noise(tilted_plane(noise_m), everywhere, object_std_m=0.001, focal_px=570.0)
    assert noise.white_std_m == pytest.approx(noise_m, rel=0.05, abs=1e-9)
    assert noise.shared_std_m == SHARED_PER_WHITE * noise.white_std_m
    assert noise.object_std_m == 0.001


def test_what_neighbours_share_is_measured_and_never_more_than_real_sensors_share() -> None:
    """Independent noise of 2 mm leaves a fifth in means of 25; waves of 30 px and 2 mm stay."""
    generator = np.random.default_rng(1)
    white_m = 0.8 + 0.002 * generator.normal(size=(240, 320))
    white = measure_shared_per_white(torch.from_numpy(white_m))
    assert white == pytest.approx(0.2, abs=0.05)
    smooth = gaussian_filter(generator.normal(size=(240, 320)), 6)
    wave_m = 0.002 * smooth / smooth.std()
    assert 0.6 < measure_shared_per_white(torch.from_numpy(white_m + wave_m)) < 1.5
    larger = measure_shared_per_white(torch.from_numpy(white_m + 10 * wave_m))
    assert larger == SHARED_PER_WHITE


def test_where_too_little_is_read_neighbours_share_what_real_sensors_share() -> None:
    assert measure_shared_per_white(torch.zeros(240, 320)) == SHARED_PER_WHITE
    assert measure_shared_per_white(torch.ones(7, 9)) == SHARED_PER_WHITE
    assert measure_shared_per_white(torch.full((240, 320), 0.8)) == SHARED_PER_WHITE, "no noise"


def test_only_readings_of_the_object_are_measured() -> None:
    """What is beside the object is rougher, and some of its own pixels have no reading."""
    is_object = np.zeros((120, 160), dtype=bool)
    is_object[30:90, 40:120] = True
    depth_m = np.where(is_object, tilted_plane(0.001), tilted_plane(0.05))
    depth_m[40:50, 60:70] = np.nan
    noise = measure_noise(depth_m, is_object, object_std_m=0.0, focal_px=570.0)
    assert noise.white_std_m == pytest.approx(0.001, rel=0.1)


def test_an_object_too_thin_to_be_measured_has_the_noise_of_what_is_about_it() -> None:
    is_object = np.zeros((120, 160), dtype=bool)
    is_object[50:54, 50:54] = True
    noise = measure_noise(tilted_plane(0.003), is_object, object_std_m=0.001, focal_px=570.0)
    assert noise.white_std_m == pytest.approx(0.003, rel=0.05)


def test_where_nothing_can_be_measured_the_noise_is_that_of_a_kinect() -> None:
    depth_m = np.full((120, 160), np.nan)
    depth_m[50:54, 50:54] = 0.8
    noise = measure_noise(depth_m, np.isfinite(depth_m), object_std_m=0.001, focal_px=570.0)
    assert noise.white_std_m == pytest.approx(NOISE_PER_M2 * 0.8**2)


def test_averaging_lowers_independent_noise_alone() -> None:
    noise = DepthNoise(white_std_m=0.003, shared_std_m=0.0, lateral_std_m=0.0, object_std_m=0.0)
    assert noise.deviation_m(np.ones(1), 9) == pytest.approx(0.001)
    shared = DepthNoise(white_std_m=0.0, shared_std_m=0.003, lateral_std_m=0.0, object_std_m=0.004)
    assert shared.deviation_m(np.ones(1), 900) == pytest.approx(0.005)


def test_nothing_is_measured_exactly() -> None:
    """Residuals are divided by the deviation: without noise, from the front, it is not 0."""
    exact = DepthNoise(white_std_m=0.0, shared_std_m=0.0, lateral_std_m=0.001, object_std_m=0.0)
    assert exact.deviation_m(np.ones(2), 9).tolist() == [LEAST_DEVIATION_M] * 2


def test_a_slanted_surface_deviates_more_along_the_ray() -> None:
    noise = DepthNoise(white_std_m=0.0, shared_std_m=0.0, lateral_std_m=0.0, object_std_m=0.001)
    front, slanted, grazing = noise.deviation_m(np.array([1.0, 0.5, 0.01]), 9)
    assert front == pytest.approx(0.001)
    assert slanted == pytest.approx(0.002)
    assert grazing < 0.004, "what is seen along the surface is hardly measured"


def test_a_slant_turns_a_shift_across_the_axis_into_depth() -> None:
    noise = DepthNoise(white_std_m=0.003, shared_std_m=0.0, lateral_std_m=0.001, object_std_m=0.0)
    front, diagonal = noise.deviation_m(np.array([1.0, math.sqrt(0.5)]), 9)
    assert front == pytest.approx(0.001), "noise is along the axis, whatever the slant"
    assert diagonal == pytest.approx(math.hypot(0.001, 0.001))


def test_noise_of_a_whole_image_is_that_for_the_square_of_its_depth() -> None:
    depth_m = tilted_plane(0.0)
    noise = np.random.default_rng(1).normal(size=depth_m.shape)
    noisy_m = torch.from_numpy(depth_m + 0.002 * depth_m**2 * noise)
    noisy_m[::7, ::5] = 0.0
    assert measure_noise_per_m2(noisy_m) == pytest.approx(0.002, rel=0.05)
    assert measure_noise_per_m2(torch.zeros(120, 160).double()) == NOISE_PER_M2


def test_a_reading_may_lie_off_its_plane_by_the_noise_but_not_by_any() -> None:
    depth_m = torch.tensor([0.5, 1.0, 2.0], dtype=torch.float64)
    assert plane_tolerance_m(depth_m, 0.0).tolist() == [FLAT_M] * 3
    assert float(plane_tolerance_m(depth_m, 0.0001)[1]) == pytest.approx(FLAT_M + 0.001)
    assert float(plane_tolerance_m(depth_m, 1.0)[2]) == pytest.approx(0.004 + 4 * 0.003)
