"""Random changes that keep a pose true."""

import dataclasses
import math
from pathlib import Path

import pytest
import torch

from depthpose.core.config import config_to_dict, read_config, write_config
from depthpose.core.errors import InputError
from depthpose.pose.config import ObjectsConfig, SyntheticSensorConfig
from depthpose.pose.synthetic.depth_sensors import simulate_depth
from depthpose.pose.synthetic.occluders import draw_levels, occlude
from depthpose.pose.synthetic.random_numbers import random_index, random_rotation
from depthpose.pose.synthetic.views import grow_mask
from depthpose.pose.train import PoseTraining


def _generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_rotations_are_rotations_and_cover_the_sphere_evenly() -> None:
    generator = _generator()
    R = torch.stack([random_rotation(generator) for _ in range(2000)])
    assert torch.allclose(R @ R.mT, torch.eye(3).double().expand(2000, 3, 3), atol=1e-12)
    assert torch.allclose(torch.linalg.det(R), torch.ones(2000).double())
    # A uniform rotation has mean 0 and every entry the variance 1/3.
    assert R.mean(0).abs().max() < 0.05
    assert (R.square().mean(0) - 1 / 3).abs().max() < 0.03


def test_an_occluder_hides_exactly_its_share_and_stands_nearer() -> None:
    silhouette = draw_levels(60, 80, _generator(9)) < 0.3
    depth_m = torch.where(silhouette, 0.8 + 0.1 * torch.rand(60, 80), 1.5)
    for seed in range(40):
        hidden_m, visible = occlude(depth_m, silhouette, 0.3, _generator(seed))
        everything = int(silhouette.sum())
        # A wide pixel of equal level may be hidden with the last one.
        assert abs(1 - int(visible.sum()) / everything - 0.3) < 0.02
        assert not (visible & ~silhouette).any()
        assert torch.equal(hidden_m[visible], depth_m[visible])
        gone = silhouette & ~visible
        assert bool((hidden_m[gone] < depth_m[gone]).all())


def test_nothing_is_hidden_by_no_share() -> None:
    silhouette = torch.ones(5, 6, dtype=torch.bool)
    depth_m, visible = occlude(torch.ones(5, 6), silhouette, 0.0, _generator())
    assert torch.equal(depth_m, torch.ones(5, 6))
    assert torch.equal(visible, silhouette)


def test_a_mask_grows_and_shrinks_by_pixels() -> None:
    mask = torch.zeros(20, 20, dtype=torch.bool)
    mask[8:12, 8:12] = True
    grown, shrunk = grow_mask(mask, 2), grow_mask(mask, -1)
    assert int(grown.sum()) == 8 * 8
    assert bool(grown[6:14, 6:14].all())
    assert int(shrunk.sum()) == 2 * 2
    assert bool(shrunk[9:11, 9:11].all())
    assert torch.equal(grow_mask(mask, 0), mask)


def _sensor(kind: str, noise: float = 1.0, missing: float = 0.0) -> SyntheticSensorConfig:
    return SyntheticSensorConfig(
        kinds=(kind,),  # pyright: ignore[reportArgumentType]
        noise=(noise, noise),
        missing=(missing, missing),
        offset_m=(0.0, 0.0),
    )


def test_structured_light_reads_whole_steps_of_disparity() -> None:
    wall_m = torch.full((50, 60), 1.1)
    read_m = simulate_depth(wall_m, (572.0, 572.0), _sensor("structured light"), _generator())
    steps = 8 * 572.0 * 0.075 / read_m
    assert torch.allclose(steps, steps.round(), atol=1e-3)
    assert len(torch.unique(read_m)) > 3


@pytest.mark.parametrize(
    ("kind", "at_1_m", "at_2_m"),
    [
        ("structured light", 0.0012 + 0.0019 * 0.36, 0.0012 + 0.0019 * 2.56),
        ("time of flight", 0.003, 0.009),
        ("active stereo", 0.003, 0.012),
        ("laser", 0.0005, 0.0005),
    ],
)
def test_noise_is_that_of_the_sensor(kind: str, at_1_m: float, at_2_m: float) -> None:
    for distance_m, sigma_m in ((1.0, at_1_m), (2.0, at_2_m)):
        wall_m = torch.full((200, 200), distance_m)
        # Fine steps of disparity, so that they add nothing to speak of.
        read_m = simulate_depth(wall_m, (572.0, 1e6), _sensor(kind), _generator(3))
        # Noise that neighbours share has fewer independent readings on the same wall.
        own = 0.25 if kind == "active stereo" else 0.03
        assert abs(float(read_m.std()) / sigma_m - 1) < own
        assert abs(float(read_m.mean()) - distance_m) < own * sigma_m


def test_noise_that_neighbours_share_falls_off_with_their_distance() -> None:
    config = dataclasses.replace(_sensor("time of flight"), noise_correlation_px=(4.0, 4.0))
    noise_m = simulate_depth(torch.full((400, 400), 1.0), (286.0, 572.0), config, _generator(1)) - 1
    assert abs(float(noise_m.std()) / 0.003 - 1) < 0.1
    for lag in (1, 2, 4):  # the window shows half as many pixels: 2 for 4
        product = (noise_m[:, :-lag] * noise_m[:, lag:]).mean() / noise_m.var()
        assert abs(float(product) - math.exp(-((lag / 2.0) ** 2) / 4)) < 0.08
    alone = (
        simulate_depth(torch.full((400, 400), 1.0), (286.0, 572.0), _sensor("laser"), _generator(1))
        - 1
    )
    assert abs(float((alone[:, :-1] * alone[:, 1:]).mean() / alone.var())) < 0.02


def test_active_stereo_moves_edges_and_shades_what_one_camera_sees() -> None:
    depth_m = torch.full((60, 200), 1.0)
    depth_m[:, 100:140] = 0.7
    read_m = simulate_depth(depth_m, (572.0, 572.0), _sensor("active stereo", 0.0), _generator())
    lost = read_m.isnan()
    width = int(572.0 * 0.05 * (1 / 0.7 - 1))
    assert bool(lost[:, 100 - width + 2 : 98].all())
    assert not lost[:, 145:].any()
    edge = read_m[:, 137:143] < 0.85
    assert len({int(row.sum()) for row in edge}) > 2  # the edge is not straight any more


def test_no_sensor_changes_nothing() -> None:
    depth_m = torch.rand(9, 9) + 0.5
    assert torch.equal(
        simulate_depth(depth_m, (50.0, 50.0), _sensor("none"), _generator()), depth_m
    )


def test_the_projector_leaves_a_shadow_beside_what_is_near() -> None:
    depth_m = torch.full((20, 200), 1.0)
    depth_m[:, 60:80] = 0.7
    read_m = simulate_depth(depth_m, (572.0, 572.0), _sensor("structured light", 0.0), _generator())
    lost = read_m.isnan()
    # f b (1/0.7 - 1/1.0) = 18.4 px, less the tolerance; where the step itself is is not counted.
    width = 572.0 * 0.075 * (1 / 0.7 - 1)
    assert bool(lost[:, 82 : 80 + int(width) - 2].all())
    assert not lost[:, 110:].any()
    assert not lost[:, :58].any()


def test_time_of_flight_mixes_depths_at_edges_alone() -> None:
    depth_m = torch.full((40, 40), 1.0)
    depth_m[:, 20:] = 2.0
    read_m = simulate_depth(depth_m, (572.0, 572.0), _sensor("time of flight", 0.0), _generator())
    assert bool(((read_m[:, 19] > 1) & (read_m[:, 19] < 2)).all())
    assert torch.equal(read_m[:, :19], depth_m[:, :19])
    assert torch.equal(read_m[:, 20:], depth_m[:, 20:])


def test_grazing_surfaces_are_not_read_but_edges_are() -> None:
    # z grows by 20 mm a pixel of 1/572 m at 1 m: 85 degrees.
    ramp_m = 1.0 + 0.02 * torch.arange(1, 31.0).expand(10, 30)
    assert bool(
        simulate_depth(ramp_m, (572.0, 572.0), _sensor("laser", 0.0), _generator()).isfinite().all()
    )
    lost = simulate_depth(
        ramp_m, (572.0, 572.0), _sensor("time of flight", 0.0), _generator()
    ).isnan()
    assert bool(lost[:, 1:10].all())
    step_m = torch.where(torch.arange(30) < 15, 1.0, 1.5).expand(10, 30)
    read_m = simulate_depth(step_m, (572.0, 572.0), _sensor("laser", 0.0), _generator())
    assert torch.equal(read_m, step_m)


def test_readings_go_missing_at_about_the_share() -> None:
    wall_m = torch.full((400, 400), 1.0)
    shares = [
        float(
            simulate_depth(wall_m, (572.0, 572.0), _sensor("laser", 1.0, 0.2), _generator(seed))
            .isnan()
            .float()
            .mean()
        )
        for seed in range(10)
    ]
    assert 0.15 < sum(shares) / 10 < 0.25


def test_whole_numbers_stay_below_their_count() -> None:
    generator = _generator()
    assert {random_index(generator, 3) for _ in range(50)} == {0, 1, 2}


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"number": 0}, "number must be in [1, inf), got 0; the default is 1000"),
        ({"seed": -1}, "seed must be in [0, 9223372036854775808), got -1"),
        (
            {"seed": 2**64},
            "seed must be in [0, 9223372036854775808), got 18446744073709551616",
        ),
        (
            {"centre_px": (-5000.0, 9000.0)},
            "centre_px is (-5000.0, 9000.0), but the principal point lies within the image, and "
            "image_px is (640, 480); leave it out for the default, (325.2611, 242.04899)",
        ),
        ({"image_px": (320, 240), "centre_px": (325.3, 242.0)}, "centre_px is (325.3, 242.0)"),
        ({"image_px": (0, 480)}, "image_px must be in (0, inf), got (0, 480)"),
        ({"occluded_share": 1.5}, "occluded_share must be in [0, 1], got 1.5"),
        ({"mask_error_px": -1}, "mask_error_px must be in [0, 20], got -1; the default is 3"),
        ({"distance_m": (1.1, 0.6)}, "distance_m must be a range, the lower end first"),
        ({"distance_m": (600.0, 1100.0)}, "distance_m must be in [0.05, 20], got (600"),
        ({"resolution": (0.0, 1.0)}, "resolution must be in [0.05, 4], got (0.0"),
        (
            {"occlusion": (0.0, 1.0)},
            "occlusion must be in [0, 0.95], got (0.0, 1.0)",
        ),
    ],
)
def test_bad_settings_of_objects_are_refused(values: dict, text: str) -> None:
    with pytest.raises(InputError) as error:
        ObjectsConfig(**values)
    assert text in str(error.value)


def test_the_principal_point_is_that_of_the_image(tmp_path: Path) -> None:
    assert ObjectsConfig().centre_px == (325.2611, 242.04899)
    assert config_to_dict(ObjectsConfig())["centre_px"] == [325.2611, 242.04899]
    assert ObjectsConfig(image_px=(320, 240)).centre_px == (159.5, 119.5)
    assert ObjectsConfig(centre_px=(0.0, 479.0)).centre_px == (0.0, 479.0)
    path = tmp_path / "c.yaml"
    for text, centre_px in (
        ("{image_px: [320, 240]}", (159.5, 119.5)),
        ("{image_px: [320, 240], centre_px: [160, 121]}", (160.0, 121.0)),
        ("{image_px: [640, 480], number: 3}", (325.2611, 242.04899)),
    ):
        path.write_text(f"objects: {text}")
        assert read_config(path, PoseTraining).objects.centre_px == centre_px
    write_config(path, PoseTraining(objects=ObjectsConfig(centre_px=(300.0, 200.0))))
    assert read_config(path, PoseTraining).objects.centre_px == (300.0, 200.0)


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"kinds": ()}, "kinds is (); name one or more of structured light, active stereo, ti"),
        ({"noise": (2.0, 1.0)}, "noise must be a range, the lower end first, got (2.0, 1.0)"),
        (
            {"noise_correlation_px": (-1.0, 2.0)},
            "noise_correlation_px must be in [0, 30], got (-1.0, 2.0)",
        ),
        ({"missing": (0.0, 1.0)}, "missing must be in [0, 0.9], got (0.0, 1.0)"),
    ],
)
def test_bad_settings_of_a_sensor_are_refused(values: dict, text: str) -> None:
    with pytest.raises(InputError) as error:
        SyntheticSensorConfig(**values)
    assert text in str(error.value)
