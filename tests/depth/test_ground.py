"""The road in a depth map, and the scale by the camera's height or one measured distance."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxtyping import Float
from torch import Tensor

from depthpose.core.camera import Camera, StereoRig
from depthpose.core.errors import InputError
from depthpose.depth.disparity import depth_from_disparity, disparity_from_depth
from depthpose.depth.ground import fit_ground
from depthpose.depth.mount import MountFilter, scale_by_distance, scale_by_mount
from depthpose.depth.predictions import write_estimate
from depthpose.depth.types import DepthEstimate, DepthInput

K = torch.tensor([[300.0, 0, 199.5], [0, 300, 99.5], [0, 0, 1]], dtype=torch.float64)
CAMERA = Camera(width=400, height=200, K=K)


def road(height_m: float, tilt_deg: float, roll_deg: float) -> Float[Tensor, "200 400"]:
    """Depth of a road below a camera that looks up by the tilt; a wall beyond 30 m."""
    v, u = torch.meshgrid(torch.arange(200.0), torch.arange(400.0), indexing="ij")
    x, y = (u.double() - 199.5) / 300, (v.double() - 99.5) / 300
    tilt, roll = math.tan(math.radians(tilt_deg)), math.tan(math.radians(roll_deg))
    down = torch.tensor([-roll, 1, -tilt], dtype=torch.float64)
    down = down / down.norm()
    inverse = (down[0] * x + down[1] * y + down[2]) / height_m
    return (1 / inverse.clamp(min=1 / 30)).float()


def estimate(depth_m: Float[Tensor, "h w"]) -> DepthEstimate:
    """Make an estimate whose sky is the uppermost 20 rows."""
    is_sky = torch.zeros_like(depth_m, dtype=torch.bool)
    is_sky[:20] = True
    known = torch.where(is_sky, torch.nan, depth_m)
    px = torch.where(is_sky, 0.01, 100 / depth_m)
    return DepthEstimate(input=seen(), depth_m=known, disparity_px=px, is_sky=is_sky)


def seen(**mount: float) -> DepthInput:
    """Make an input of the camera with what is known of its mount."""
    camera = replace(CAMERA, **mount)
    return DepthInput(name="street", left=torch.zeros(3, 200, 400), right=None, camera=camera)


def correct(
    given: DepthEstimate, image: DepthInput, mount: MountFilter | None = None
) -> DepthEstimate:
    """Correct an estimate as one of this image."""
    return scale_by_mount(replace(given, input=image), mount)


def test_ground_that_is_not_quite_flat_is_ground_and_what_stands_on_it_is_less_sure() -> None:
    """Of a road judged 7 % too far the camera's height says as much as of the plane beside it."""
    depth_m = road(1.5, 0, 0)
    bump = (slice(150, 160), slice(180, 220))
    box = (slice(150, 160), slice(250, 290))
    plane = (slice(150, 160), slice(100, 140))
    depth_m[bump] *= 1.07
    depth_m[box] *= 0.7
    found = correct(estimate(depth_m), seen(mount_height_m=2.0, tilt_deg=0.0))
    assert found.depth_m is not None
    factor = found.depth_m / depth_m
    assert float(factor[plane].mean()) > 1.2
    torch.testing.assert_close(factor[bump], factor[plane], rtol=0.005, atol=0)
    assert float(factor[box].mean()) < 0.98 * float(factor[plane].mean())


def test_where_the_map_is_tilted_up_too_far_the_camera_stands_higher_than_in_it() -> None:
    """A map has the height of its training near by and the true one far off."""
    heights_m: list[float] = []
    for tilt_deg in (-2.0, 0.0, 2.0):
        found = correct(estimate(road(1.5, tilt_deg, 0)), seen(tilt_deg=0.0))
        assert found.ground is not None
        heights_m.append(found.ground.height_m)
    assert heights_m == sorted(heights_m)
    assert heights_m[2] / heights_m[0] == pytest.approx(math.exp(4 * 0.06), rel=0.05)


def test_a_measured_distance_scales_the_height_and_its_deviation_alike() -> None:
    judged = correct(estimate(road(1.5, 0, 0)), seen())
    assert judged.ground is not None
    assert judged.depth_m is not None
    twice_m = 2 * float(judged.depth_m[190, 200])
    found = scale_by_distance(judged, (200, 190, twice_m)).ground
    assert found is not None
    assert found.height_m == pytest.approx(2 * judged.ground.height_m, rel=0.02)
    share = judged.ground.height_std_m / judged.ground.height_m
    assert found.height_std_m == pytest.approx(share * found.height_m)


@settings(max_examples=5, deadline=None)
@given(st.floats(0.8, 3.5), st.floats(-8, 4), st.floats(-6, 6))
def test_height_tilt_and_roll_of_a_plane_are_found(height: float, tilt: float, roll: float) -> None:
    found = fit_ground(road(height, tilt, roll), CAMERA)
    assert found is not None
    assert found.height_m == pytest.approx(height, rel=0.05)
    # The foot of the wall is near the road's plane, and tilts it where 30 m are seen far down.
    assert found.tilt_deg == pytest.approx(tilt, abs=0.45)
    assert found.roll_deg == pytest.approx(roll, abs=0.2)


def test_things_on_the_road_and_noise_move_the_fit_little_and_are_in_its_deviation() -> None:
    depth_m = road(1.5, -2, 1)
    clean = fit_ground(depth_m, CAMERA)
    noise = torch.randn(depth_m.shape, generator=torch.Generator().manual_seed(0))
    depth_m = depth_m * (1 + 0.03 * noise)
    depth_m[110:190, 230:300] = 6.0  # a car
    found = fit_ground(depth_m, CAMERA)
    assert found is not None and clean is not None  # noqa: PT018
    assert found.height_m == pytest.approx(1.5, rel=0.03)
    assert found.tilt_deg == pytest.approx(-2, abs=0.5)
    assert found.height_std_m > 3 * clean.height_std_m


def test_deviations_are_those_of_the_jackknife() -> None:
    """Quenouille and Tukey: (n - 1) / n of the squares about the mean, one of n strips left out."""
    noise = torch.randn(200, 400, generator=torch.Generator().manual_seed(0))
    depth_m = road(1.5, -2, 1) * (1 + 0.005 * noise)  # all of it stays on the plane
    found, strips = fit_ground(depth_m, CAMERA), 8
    assert found is not None
    left, right = 400 // 7, 400 * 6 // 7  # the columns that are looked at
    strip = (torch.arange(400) - left) * strips // (right - left)
    left_out: list[tuple[float, float]] = []
    for number in range(strips):
        part_m = depth_m.clone()
        part_m[:, strip == number] = torch.nan
        part = fit_ground(part_m, CAMERA)
        assert part is not None
        left_out.append((part.height_m, part.tilt_deg))
    parts = torch.tensor(left_out, dtype=torch.float64)
    spread = ((parts - parts.mean(0)).square().sum(0) * (strips - 1) / strips).sqrt().tolist()
    assert [found.height_std_m, found.tilt_std_deg] == pytest.approx(spread, rel=1e-3)


def test_a_road_of_few_points_in_every_strip_is_no_ground() -> None:
    """Of 32 points on a plane no strip can be left out, so nothing says how sure the plane is."""
    small = Camera(
        width=28,
        height=20,
        K=torch.tensor([[20.0, 0, 14], [0, 20, 10], [0, 0, 1]], dtype=torch.float64),
    )
    depth_m = torch.full((20, 28), torch.nan)
    depth_m[12, 4:24] = 1.5 * 20 / 2
    depth_m[13, 4:24] = 1.5 * 20 / 3
    depth_m[12:14, [6, 11, 16, 21]] = torch.nan
    noise = torch.rand(2, 20, generator=torch.Generator().manual_seed(1))
    depth_m[16:18, 4:24] = 6 * torch.exp(3 * noise)
    assert fit_ground(depth_m, small) is None


@pytest.mark.parametrize(
    "depth_m",
    [
        torch.full((200, 400), 5.0),
        torch.full((200, 400), torch.nan),
        1 + 20 * torch.rand(200, 400, generator=torch.Generator().manual_seed(1)),
        road(1.5, 0, 0).flip(0),
        road(1.5, 0, 0).T.contiguous()[:200, :].repeat(1, 2),
    ],
    ids=["a wall", "nothing", "noise", "a ceiling", "turned"],
)
def test_what_is_no_road_is_none(depth_m: Float[Tensor, "200 400"]) -> None:
    assert fit_ground(depth_m, CAMERA) is None
    with pytest.raises(InputError, match=r"no road is seen .* give --known-distance"):
        correct(estimate(depth_m), seen(mount_height_m=1.5))


def test_a_known_mount_gives_the_near_road_its_depth_and_leaves_the_sky() -> None:
    given = estimate(road(1.6, -3, 0))
    found = correct(given, seen(mount_height_m=2.4, tilt_deg=-3.0))
    assert found.ground is not None
    assert (found.ground.height_m, found.ground.tilt_deg) == (2.4, -3.0)
    truth = road(2.4, -3, 0)
    assert found.depth_m is not None and given.depth_m is not None  # noqa: PT018
    near = truth < 10
    torch.testing.assert_close(found.depth_m[near], truth[near], rtol=0.04, atol=0)
    torch.testing.assert_close(
        found.disparity_px[100:] * found.depth_m[100:],
        given.disparity_px[100:] * given.depth_m[100:],
    )
    torch.testing.assert_close(found.disparity_px[:20], given.disparity_px[:20])


def test_ground_and_sizes_are_joined_by_inverse_variances_in_the_logarithm_of_depth() -> None:
    """A pixel of the road, worked out by hand: 0.12 by size, 0.03 of the height, 0.2 degrees."""
    given = estimate(road(1.6, -3, 0))
    found = correct(given, seen(mount_height_m=2.4, tilt_deg=-1.0))
    assert found.depth_m is not None and given.depth_m is not None  # noqa: PT018
    for row in (120, 150, 190):
        by_size_m = float(given.depth_m[row, 200])
        by_ground_m = float(road(2.4, -1, 0)[row, 200])
        off = math.radians(0.2) * max(by_size_m, by_ground_m) / 2.4
        weight = 0.12**2 / (0.12**2 + 0.03**2 + off**2)
        expected = by_size_m * (by_ground_m / by_size_m) ** weight
        # The image is black, so that the roll stays that of the map.
        assert float(found.depth_m[row, 200]) == pytest.approx(expected, rel=0.01)


def test_what_stands_on_the_road_is_moved_half_of_the_way_as_its_size_says_the_other() -> None:
    depth_m = road(1.6, -3, 0)
    wall = (slice(100, 150), slice(150, 250))
    depth_m[wall] = 3.0
    found = correct(estimate(depth_m), seen(mount_height_m=2.4, tilt_deg=-3.0))
    assert found.depth_m is not None
    standing = torch.full((50, 100), 3.0 * math.sqrt(1.5))
    torch.testing.assert_close(found.depth_m[wall], standing, rtol=0.02, atol=0)


def test_a_tilt_alone_is_taken_and_a_wrong_map_gets_a_better_shape() -> None:
    """The median-scaled error knows no scale: what falls is that of the shape."""
    truth = road(1.6, -1, 0)
    wrong = estimate(road(1.6, -3, 0))
    found = correct(wrong, seen(tilt_deg=-1.0))
    assert found.ground is not None
    assert found.ground.tilt_deg == -1.0
    errors: list[float] = []
    for depth_m in (wrong.depth_m, found.depth_m):
        assert depth_m is not None
        ratio = (depth_m / truth)[110:]
        errors.append(float((ratio / ratio.median() - 1).abs().mean()))
    assert errors[1] < 0.5 * errors[0]


def test_without_anything_given_or_seen_the_map_counts_less_what_maps_are_off() -> None:
    found = correct(estimate(road(1.6, -3, 1)), seen())
    assert found.ground is not None
    assert found.ground.tilt_deg == pytest.approx(-2.6, abs=0.1)
    assert found.ground.roll_deg == pytest.approx(1, abs=0.1)
    assert found.ground.height_m == pytest.approx(1.6, rel=0.02)
    assert 0.7 < found.ground.tilt_std_deg < 1.0
    assert 0.1 < found.ground.height_std_m / found.ground.height_m < 0.2


def test_frames_of_one_mount_hold_the_height_and_smooth_the_tilt() -> None:
    noise = np.random.default_rng(0)
    heights = 1.6 * np.exp(0.06 * noise.standard_normal(20))
    tilts = -2 + 0.6 * noise.standard_normal(20)
    mount = MountFilter()
    held: list[float] = []
    smooth: list[float] = []
    for height_m, tilt_deg in zip(heights, tilts, strict=True):
        found = correct(estimate(road(height_m, tilt_deg, 0)), seen(), mount)
        assert found.ground is not None
        assert mount.last == found.ground
        held.append(found.ground.height_m)
        smooth.append(found.ground.tilt_deg)
    assert held[0] == pytest.approx(heights[0], rel=0.02)
    assert held[-1] == pytest.approx(1.6, rel=0.03)
    assert np.std(held[10:]) < 0.2 * np.std(heights[10:])
    assert np.std(smooth) < 0.8 * np.std(tilts)
    # Where no road is seen the mount stays that of the frames before.
    before = mount.last
    correct(estimate(torch.full((200, 400), 5.0)), seen(), mount)
    assert mount.last == before


def test_what_is_as_steep_as_a_bank_is_no_road() -> None:
    assert fit_ground(road(3.5, -22, 0), CAMERA) is None
    assert fit_ground(road(1.65, -12, 0), CAMERA) is not None


def test_a_known_tilt_corrects_a_wrong_one() -> None:
    wrong = estimate(road(1.6, -1.5, 0))
    by_tilt, alone = (
        correct(wrong, seen(**mount)).depth_m
        for mount in ({"mount_height_m": 1.6, "tilt_deg": -3.0}, {"mount_height_m": 1.6})
    )
    truth = road(1.6, -3, 0)[140:]
    assert by_tilt is not None and alone is not None  # noqa: PT018
    errors = [float((part[140:] / truth - 1).abs().mean()) for part in (by_tilt, alone)]
    assert errors[0] < errors[1]


@pytest.mark.parametrize("tilt_deg", [30.0, -9.0])
def test_a_tilt_that_the_road_contradicts_is_refused(tilt_deg: float) -> None:
    with pytest.raises(InputError, match=r"degrees is given, and the road that is seen says 0.0"):
        correct(estimate(road(1.6, 0, 0)), seen(mount_height_m=1.6, tilt_deg=tilt_deg))


def test_a_known_distance_sets_the_scale_by_the_median_around_it() -> None:
    depth_m = road(1.6, 0, 0)
    depth_m[150, 200] = 1000.0  # one wrong pixel
    found = scale_by_distance(estimate(depth_m), (200.0, 150.0, 19.2))
    assert found.depth_m is not None
    expected = float(road(1.6, 0, 0)[150, 100]) * 19.2 / float(road(1.6, 0, 0)[150, 200])
    assert float(found.depth_m[150, 100]) == pytest.approx(expected, rel=0.01)


def test_of_a_rig_whose_principal_points_differ_disparity_and_depth_stay_one_triangulation() -> (
    None
):
    rig = StereoRig(width=400, height=200, K=CAMERA.K, baseline_m=0.2, cx_right_minus_left_px=40)
    depth_m = torch.full((200, 400), 2.0)
    image = replace(seen(), camera=rig)
    given = DepthEstimate(
        input=image, depth_m=depth_m, disparity_px=disparity_from_depth(depth_m, rig)
    )
    found = scale_by_distance(given, (200.0, 100.0, 4.0))
    assert found.depth_m is not None
    torch.testing.assert_close(found.depth_m, 2 * depth_m)
    torch.testing.assert_close(depth_from_disparity(found.disparity_px, rig), 2 * depth_m)


@pytest.mark.parametrize(
    ("known", "message"),
    [
        ((200.0, 5.0, 10.0), "no depth at this pixel"),
        ((400.0, 50.0, 10.0), "the image is 400x200, columns 0 to 399"),
        ((-1.0, 50.0, 10.0), "columns 0 to 399"),
        ((20.0, 150.0, 0.0), "must be a positive number"),
        ((20.0, 150.0, math.nan), "must be a positive number"),
        ((math.nan, 150.0, 3.0), "columns 0 to 399"),
    ],
)
def test_a_known_distance_that_cannot_be_is_refused(
    known: tuple[float, float, float], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        scale_by_distance(estimate(road(1.6, 0, 0)), known)


def test_a_file_holds_the_digits_that_are_the_same_in_every_run(tmp_path: Path) -> None:
    """Threads add up in another order, and the last digits of a fit change."""
    ground = fit_ground(road(1.65, -1.0, 0.5), CAMERA)
    assert ground is not None
    written: list[bytes] = []
    for changed in (0.0, 1e-13):
        again = replace(ground, **{k: v * (1 + changed) for k, v in vars(ground).items()})
        image = DepthInput(name="a", left=torch.zeros(3, 4, 5), right=None, camera=None)
        found = DepthEstimate(
            input=image, disparity_px=torch.ones(4, 5), depth_m=None, ground=again
        )
        write_estimate(tmp_path, found)
        written.append((tmp_path / "a.ground.json").read_bytes())
    assert written[0] == written[1]
    row = json.loads(written[0])
    assert row == {name: round(value, 6) for name, value in vars(ground).items()}
