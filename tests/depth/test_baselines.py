from dataclasses import replace
from pathlib import Path

import pytest
import torch

from depthpose.core.camera import StereoRig, resize_camera, write_camera
from depthpose.core.errors import InputError
from depthpose.core.files import write_depth_png, write_image
from depthpose.depth.baselines import NearestImageBaseline, RowDepthBaseline, fill_by_pyramid
from depthpose.depth.datasets import Dataset, join_datasets, open_dataset, read_true_depth
from depthpose.depth.disparity import depth_from_disparity
from depthpose.depth.types import DepthInput

W, H = 48, 32


def rig() -> StereoRig:
    K = torch.tensor([[40.0, 0, 23.5], [0, 40, 15.5], [0, 0, 1]], dtype=torch.float64)
    return StereoRig(width=W, height=H, K=K, baseline_m=0.5)


def road_m(height: int = H, camera: StereoRig | None = None) -> torch.Tensor:
    """A road 1.5 m below the camera; nothing is known above the horizon."""
    used = camera or rig()
    slope = (torch.arange(height) - float(used.K[1, 2])) / float(used.K[1, 1])
    return torch.where(slope > 0, 1.5 / slope, torch.nan)[:, None].expand(height, used.width)


def write_frames(home: Path, frames: dict[str, tuple[torch.Tensor, torch.Tensor]]) -> Dataset:
    for name, (image, depth_m) in frames.items():
        write_image(home / "left" / f"{name}.png", image)
        write_depth_png(home / "lidar_depth" / f"{name}.png", depth_m)
    write_camera(home / "camera.json", rig())
    return open_dataset(home)


def pair_of(image: torch.Tensor, camera: StereoRig | None = None) -> DepthInput:
    return DepthInput(name="x", left=image, right=None, camera=camera or rig())


def test_rows_learn_a_road(tmp_path: Path) -> None:
    data = write_frames(tmp_path, {"a": (torch.rand(3, H, W), road_m())})
    estimate = RowDepthBaseline.fit(data).estimate_input(pair_of(torch.rand(3, H, W)))
    assert estimate.depth_m is not None
    inside = (road_m() > 1.0) & (road_m() < 80)
    known_m = road_m()[inside]
    assert (((estimate.depth_m[inside] - known_m) / known_m).abs() < 0.005).all()
    again_m = depth_from_disparity(estimate.disparity_px, rig())
    assert torch.allclose(again_m, estimate.depth_m, rtol=1e-5)


def test_rows_follow_the_camera_and_not_the_size(tmp_path: Path) -> None:
    data = write_frames(tmp_path, {"a": (torch.rand(3, H, W), road_m())})
    larger = resize_camera(rig(), 2 * W, 2 * H)
    estimate = RowDepthBaseline.fit(data).estimate_input(
        pair_of(torch.rand(3, 2 * H, 2 * W), larger)
    )
    assert estimate.depth_m is not None
    truth_m = road_m(2 * H, larger)
    inside = (truth_m > 2.0) & (truth_m < 20)
    assert ((estimate.depth_m - truth_m).abs() / truth_m)[inside].max() < 0.15


def test_a_row_takes_the_constant_of_least_relative_error(tmp_path: Path) -> None:
    depths_m = torch.tensor([2.0, 2.0, 4.0, 30.0, 30.0, 30.0, 30.0, 30.0])
    sparse_m = torch.full((H, W), torch.nan)
    sparse_m[20, :8] = depths_m
    data = write_frames(tmp_path, {"a": (torch.rand(3, H, W), sparse_m)})
    estimate = RowDepthBaseline.fit(data).estimate_input(pair_of(torch.rand(3, H, W)))
    assert estimate.depth_m is not None
    candidates_m = torch.linspace(1, 80, 7901)
    loss = ((candidates_m[:, None] - depths_m).abs() / depths_m).mean(1)
    assert float(estimate.depth_m[20, 0]) == pytest.approx(float(candidates_m[loss.argmin()]), 2e-3)
    assert torch.allclose(estimate.depth_m, estimate.depth_m[20, 0].expand(H, W))  # rows without


def test_a_frame_with_more_points_has_no_louder_voice(tmp_path: Path) -> None:
    few, many = torch.full((H, W), torch.nan), torch.full((H, W), torch.nan)
    few[20, :2], many[20, :40] = 5.0, 20.0
    images = torch.rand(2, 3, H, W)
    data = write_frames(tmp_path, {"a": (images[0], few), "b": (images[1], many)})
    estimate = RowDepthBaseline.fit(data).estimate_input(pair_of(images[0]))
    assert estimate.depth_m is not None
    assert float(estimate.depth_m[20, 0]) == pytest.approx(5.0, 2e-3)


def test_the_nearest_image_gives_its_own_depth(tmp_path: Path) -> None:
    images = torch.rand(3, 3, H, W)
    frames = {n: (images[k], torch.full((H, W), 4.0 + k)) for k, n in enumerate("abc")}
    baseline = NearestImageBaseline.fit(write_frames(tmp_path, frames))
    darker = (0.6 * images[1] + 0.02 * torch.rand(3, H, W)).clamp(0, 1)
    estimate = baseline.estimate_input(pair_of(darker))
    assert estimate.depth_m is not None
    assert torch.allclose(estimate.depth_m, torch.full((H, W), 5.0), rtol=1e-3)
    twice_as_long = replace(rig(), K=rig().K * torch.tensor([[2.0], [2.0], [1.0]]))
    farther = baseline.estimate_input(pair_of(darker, twice_as_long)).depth_m
    assert farther is not None
    assert torch.allclose(farther, torch.full((H, W), 10.0), rtol=1e-3)


def test_haze_changes_nothing_about_what_looks_most_alike(tmp_path: Path) -> None:
    """A picture of little contrast is as grey as any other: what counts is where it is brighter."""
    pattern, other = torch.rand(2, 3, H, W)
    grey = 0.6 + 0.02 * (other - 0.5)
    frames = {"a": (pattern, torch.full((H, W), 4.0)), "b": (grey, torch.full((H, W), 9.0))}
    baseline = NearestImageBaseline.fit(write_frames(tmp_path, frames))
    depth_m = baseline.estimate_input(pair_of(0.2 * pattern + 0.5)).depth_m
    assert depth_m is not None
    assert torch.allclose(depth_m, torch.full((H, W), 4.0), rtol=1e-3)


def test_holes_take_the_smallest_cell_with_values() -> None:
    nan = torch.nan
    values = torch.tensor(
        [[1.0, nan, nan, nan], [3.0, nan, nan, nan], [nan] * 4, [nan, nan, 7, nan]]
    )
    filled = fill_by_pyramid(values)
    assert filled[0].tolist() == [1.0, 2.0, 4.5, 4.5]
    assert filled[3].tolist() == [4.5, 4.5, 7.0, 7.0]
    assert torch.equal(fill_by_pyramid(filled), filled)
    assert bool(torch.isnan(fill_by_pyramid(torch.full((3, 5), nan))).all())
    odd = torch.full((3, 5), nan)
    odd[2, 4] = 1.0
    assert torch.equal(fill_by_pyramid(odd), torch.ones(3, 5))


def test_disparity_serves_where_no_depth_is_known(tmp_path: Path) -> None:
    write_image(tmp_path / "left/a.png", torch.rand(3, H, W))
    write_depth_png(tmp_path / "disp_occ/a.png", torch.full((H, W), 4.0))
    write_camera(tmp_path / "camera.json", rig())
    known_m = read_true_depth(open_dataset(tmp_path), 0)
    assert known_m is not None
    assert torch.allclose(known_m, torch.full((H, W), 5.0))


def test_nothing_to_learn_from_is_refused(tmp_path: Path) -> None:
    write_image(tmp_path / "left/a.png", torch.rand(3, H, W))
    data = open_dataset(tmp_path)
    for baseline in (RowDepthBaseline, NearestImageBaseline):
        with pytest.raises(InputError, match="none of its 1 frames has both truth and calibration"):
            baseline.fit(data)


def test_a_baseline_needs_a_rig(tmp_path: Path) -> None:
    data = write_frames(tmp_path, {"a": (torch.rand(3, H, W), road_m())})
    pair = DepthInput(name="x", left=torch.rand(3, H, W), right=None, camera=None)
    for baseline in (RowDepthBaseline.fit(data), NearestImageBaseline.fit(data)):
        with pytest.raises(InputError, match="x: has no rig"):
            baseline.estimate_input(pair)


def test_frames_are_kept_out_by_name(tmp_path: Path) -> None:
    image = torch.rand(3, H, W)
    one = write_frames(tmp_path / "one", {"a": (image, road_m()), "b": (image, road_m())})
    two = write_frames(tmp_path / "two", {"c": (image, road_m())})
    joined = join_datasets([one, two], ["b"])
    assert [frame.name for frame in joined.frames] == ["a", "c"]
    assert joined.name == "one + two"
    with pytest.raises(InputError, match="no frame of one, two is called 'd'"):
        join_datasets([one, two], ["d"])
