import dataclasses
from collections import Counter
from dataclasses import replace
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from depthpose.core.camera import StereoRig, resize_camera
from depthpose.core.errors import InputError
from depthpose.depth.config import StreetsConfig
from depthpose.depth.disparity import warp_right_to_left
from depthpose.depth.synthetic import (
    CAMERA_FROM_VELODYNE,
    Streets,
    SyntheticFrame,
    kitti_rig,
    make_clutter,
    make_street,
    render_scene,
    render_street,
    roadside,
    traffic,
)
from depthpose.depth.synthetic.road import draw_road
from depthpose.depth.synthetic.sensor import draw_sensors

PLAIN = StreetsConfig(scale=0.25, jpeg_share=0.0, rectification_error_px=0.0)


KITTI_EIGHTH = resize_camera(kitti_rig(), 155, 47)


@pytest.fixture(scope="module")
def frames() -> list[SyntheticFrame]:
    config = replace(PLAIN, with_lidar=True)
    streets = [render_street(config, index) for index in (0, 8)]
    clutter = [render_street(replace(config, clutter_share=1.0), index) for index in (0,)]
    return streets + clutter


def test_a_frame_is_a_function_of_seed_and_index() -> None:
    config = StreetsConfig(scale=0.1)
    one = Streets(config)[5]
    render_street(config, 6)
    other = Streets(config)[5]
    assert torch.equal(one.input.left, other.input.left)
    assert one.input.right is not None
    assert other.input.right is not None
    assert torch.equal(one.input.right, other.input.right)
    for name in ("disparity_px", "depth_m", "right_disparity_px"):
        a, b = getattr(one.truth, name), getattr(other.truth, name)
        assert torch.equal(a.nan_to_num(-1), b.nan_to_num(-1))
    assert one.truth.occluded is not None
    assert other.truth.occluded is not None
    assert torch.equal(one.truth.occluded, other.truth.occluded)
    assert not torch.equal(one.input.left, Streets(replace(config, seed=1))[5].input.left)


def test_clutter_takes_its_share_and_leaves_the_streets_as_they_are() -> None:
    config = StreetsConfig(scale=0.05)
    half = replace(config, clutter_share=0.5)
    streets = [bool(render_street(half, i).is_road.any()) for i in range(6)]
    assert 1 <= sum(streets) <= 5
    first = streets.index(True)
    assert torch.equal(render_street(half, first).left, render_street(config, first).left)


def test_clutter_is_within_reach_of_a_matcher_and_of_all_kinds() -> None:
    scenes = [make_clutter((0, index)) for index in range(20)]
    materials = {int(m) for scene in scenes for m in np.unique(scene.mesh.material)}
    assert len(materials) >= 20
    for scene in scenes[:3]:
        disparity_px = 8 * render_scene(scene, KITTI_EIGHTH, PLAIN).disparity_px.nan_to_num(0)
        assert float(disparity_px.quantile(0.95)) < 128
        assert float(disparity_px.std()) > 5


def test_streets_vary_in_what_stands_there_and_how(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: Counter[str] = Counter()

    def counted(module: ModuleType, name: str) -> None:
        make = getattr(module, name)

        def note(*words: Any, **more: Any) -> Any:  # noqa: ANN401
            drawn[f"vehicle {words[0]}" if name == "make_vehicle" else name] += 1
            return make(*words, **more)

        monkeypatch.setattr(module, name, note)

    at_roadside = (
        "make_tree",
        "make_bush",
        "make_hedge",
        "make_lamp",
        "make_sign",
        "make_fence",
        "add_house",
    )
    for module, names in {
        traffic: ("make_pedestrian", "make_cyclist", "make_vehicle"),
        roadside: at_roadside,
    }.items():
        for name in names:
            counted(module, name)
    scenes = [make_street((0, index)) for index in range(10)]
    assert len({scene.place for scene in scenes}) >= 3
    assert sum(kind.startswith("vehicle") for kind in drawn) >= 3
    for what in ("make_pedestrian", "make_cyclist", *at_roadside):
        assert drawn[what] > 0, what
    assert {scene.weather.is_overcast for scene in scenes} == {True, False}
    assert any(scene.weather.haze_m < 600 for scene in scenes)
    turns = np.stack([scene.camera_from_world for scene in scenes])
    assert len(np.unique(turns.round(4), axis=0)) == len(scenes)  # pitch, yaw and roll


def test_roads_bend_climb_and_cross() -> None:
    roads = [draw_road(np.random.default_rng(seed)) for seed in range(40)]
    heights = np.array([np.ptp(road.centre.y_m) for road in roads])
    headings = np.rad2deg([np.ptp(road.centre.heading_rad) for road in roads])
    assert (heights > 1).any()
    assert (heights < 0.5).any()
    assert (headings > 10).any()
    assert (headings < 1).any()
    sides = {len(street.sides) for road in roads for street in road.side_streets}
    assert sides == {1, 2}  # junctions and crossings
    assert any(not road.side_streets for road in roads)
    assert len({road.lanes for road in roads}) >= 2


def test_cameras_differ_in_light_noise_and_compression() -> None:
    rng, light = np.random.default_rng(0), torch.full((6, 8, 3), 0.2)
    left = [draw_sensors(rng, light, 0.5)[0] for _ in range(30)]
    for field in dataclasses.fields(left[0]):
        assert len({str(getattr(sensor, field.name)) for sensor in left}) > 1, field.name


def photometric_error(frame: SyntheticFrame, shift_px: float) -> float:
    warped = warp_right_to_left(frame.right, frame.disparity_px + shift_px)
    seen = ~frame.occluded & ~frame.is_sky
    return float((warped - frame.left).abs().mean(0)[seen].nanmean())


def test_the_right_view_warped_by_the_disparity_is_the_left(frames: list[SyntheticFrame]) -> None:
    for frame in frames:
        exact = photometric_error(frame, 0.0)
        assert exact < 0.04
        assert exact < 0.75 * min(photometric_error(frame, 2.0), photometric_error(frame, -2.0))


def test_disparity_and_depth_are_one(frames: list[SyntheticFrame]) -> None:
    for frame in frames:
        expected = float(frame.rig.K[0, 0]) * frame.rig.baseline_m / frame.depth_m
        assert torch.equal(frame.is_sky, frame.disparity_px.isnan())
        torch.testing.assert_close(frame.disparity_px, expected, equal_nan=True)
        assert float(frame.depth_m.nan_to_num(9).min()) > 1


def test_occlusion_agrees_with_the_right_disparity(frames: list[SyntheticFrame]) -> None:
    for frame in frames:
        height, width = frame.occluded.shape
        columns = (torch.arange(width) - frame.disparity_px).round()
        is_inside = (columns >= 0) & ~frame.is_sky
        rows = torch.arange(height)[:, None].expand(height, width)
        right = frame.right_disparity_px.nan_to_num(0.0)[
            rows, columns.nan_to_num(0).clamp(min=0).long()
        ]
        difference = right - frame.disparity_px
        seen = difference[is_inside & ~frame.occluded].abs()
        assert float((seen < 1).float().mean()) > 0.96
        # Where nothing is hidden by what is nearer, nothing is nearer there.
        hidden = difference[is_inside & frame.occluded]
        assert float((hidden > 0).float().mean()) > 0.85
        assert bool(frame.occluded[~frame.is_sky & (columns < -0.5)].all())


def sparse_depth(points: Tensor, rig: StereoRig) -> Tensor:
    """Draw a scan into the left image: depth at the nearest pixel [m], the nearest return wins."""
    homogeneous = torch.cat([points[:, :3], torch.ones(len(points), 1)], 1).double()
    in_camera = (homogeneous @ torch.from_numpy(CAMERA_FROM_VELODYNE).T)[:, :3]
    in_camera = in_camera[in_camera[:, 2] > 0.1]
    pixels = in_camera @ rig.K.T
    column, row = (pixels[:, :2] / pixels[:, 2:]).round().long().unbind(1)
    inside = (column >= 0) & (column < rig.width) & (row >= 0) & (row < rig.height)
    depth_m = torch.full((rig.height * rig.width,), torch.inf)
    place = (row * rig.width + column)[inside]
    depth_m.scatter_reduce_(0, place, in_camera[inside, 2].float(), "amin")
    return torch.where(depth_m.isinf(), torch.nan, depth_m).reshape(rig.height, rig.width)


def test_the_lidar_agrees_with_the_depth(frames: list[SyntheticFrame]) -> None:
    for frame in frames:
        assert frame.lidar_points is not None
        assert len(frame.lidar_points) > 10_000
        lidar_m = sparse_depth(frame.lidar_points, frame.rig)
        both = lidar_m.isfinite() & ~frame.is_sky
        share = ((lidar_m - frame.depth_m).abs() / frame.depth_m)[both]
        assert int(both.sum()) > 3000
        assert float(share.median()) < 0.01
        assert float((share < 0.06).float().mean()) > 0.85


def test_one_scene_has_the_same_metres_at_two_focal_lengths() -> None:
    scene = make_street((4, 2))
    rig = resize_camera(kitti_rig(), 240, 72)
    K = torch.diag(torch.tensor([2.0, 2.0, 1.0], dtype=torch.float64)) @ rig.K
    large = StereoRig(width=470, height=140, K=K, baseline_m=0.3)
    small_frame, large_frame = (render_scene(scene, one, PLAIN) for one in (rig, large))
    # Pixel (u, v) of the small picture looks along the ray of (2 u, 2 v) of the large one.
    at_large = large_frame.depth_m[::2, ::2]
    at_small = small_frame.depth_m[: at_large.shape[0], : at_large.shape[1]]
    torch.testing.assert_close(at_large, at_small, rtol=1e-5, atol=0, equal_nan=True)
    ratio = small_frame.disparity_px[:70, :235] / large_frame.disparity_px[::2, ::2]
    assert float((ratio - rig.baseline_m / 0.6).nan_to_num(0.0).abs().max()) < 1e-4


def test_frames_are_pictures(frames: list[SyntheticFrame]) -> None:
    for frame in frames:
        for image in (frame.left, frame.right):
            assert image.dtype == torch.float32
            assert 0 <= float(image.min()) < 0.3
            assert 0.6 < float(image.max()) <= 1
            assert 0.2 < float(image.mean()) < 0.75
            assert float(image.std()) > 0.08
    for street in frames[:2]:
        assert 0.1 < float(street.is_road.float().mean()) < 0.6


def test_what_cannot_be_drawn_is_refused() -> None:
    with pytest.raises(InputError, match="scale must be"):
        StreetsConfig(scale=0.0)
    with pytest.raises(InputError, match="seed must be"):
        StreetsConfig(seed=-1)
    with pytest.raises(InputError, match="jpeg_share"):
        StreetsConfig(jpeg_share=2.0)
    with pytest.raises(InputError, match="rectification_error_px"):
        StreetsConfig(rectification_error_px=-1.0)
    with pytest.raises(InputError, match="index is -1"):
        render_street(PLAIN, -1)
    with pytest.raises(IndexError):
        Streets(StreetsConfig(frames=3))[3]
    assert len(Streets(StreetsConfig(frames=3))) == 3
