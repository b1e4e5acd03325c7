"""Pairs on disk as training samples: one kind of truth, and the focal length that was asked for."""

from pathlib import Path
from typing import Any

import pytest
import torch
from tests.depth.test_kitti_folders import make_object, make_raw, write

from depthpose.core.config import config_to_dict
from depthpose.core.errors import InputError, Notice
from depthpose.core.files import read_json, write_depth_png, write_image
from depthpose.core.loop import LoopConfig, TrainingRun
from depthpose.depth.config import AugmentConfig, PairsConfig, StreetsConfig
from depthpose.depth.datasets import open_dataset
from depthpose.depth.train import TrainingPairs, train_stereo
from depthpose.depth.train.config import StereoTraining

FOCAL_PX, BASELINE_M = 100.0, 0.5


def make_pairs(home: Path, names: tuple[str, ...] = ("0",)) -> None:
    """Write pairs of noise, 60x80, in a plain folder, without truth."""
    for name in names:
        for side in ("left", "right"):
            write_image(home / side / f"{name}.png", torch.rand(3, 60, 80))
    camera = {"focal_px": FOCAL_PX, "cx": 40, "cy": 30, "baseline_m": BASELINE_M}
    write(home / "calib.txt", "".join(f"{key}: {value}\n" for key, value in camera.items()))


def known(home: Path, **changes: Any) -> set[float]:  # noqa: ANN401
    """All disparities that a training on one folder learns from."""
    pairs = TrainingPairs(PairsConfig(folders=(str(home),), **changes), 0, needs_truth=True)
    seen = torch.cat([pairs.read(index).left_px.flatten() for index in range(len(pairs))])
    return {round(float(value), 2) for value in seen[torch.isfinite(seen)].unique()}


def test_a_camera_of_a_small_angle_keeps_the_focal_length_that_was_asked_for(
    tmp_path: Path,
) -> None:
    """A focal length of 1.25 widths, a crop of one: the picture is narrower than the crop."""
    make_pairs(tmp_path)
    write_depth_png(tmp_path / "disp_occ" / "0.png", torch.full((60, 80), 20.0))
    config = PairsConfig(
        folders=(str(tmp_path),), focal_px=200.0, augment=AugmentConfig(crop_px=(100, 200))
    )
    pairs = TrainingPairs(config, 0, needs_truth=True)
    for index in range(6):
        pair = pairs[index]
        assert pair.left.shape == (3, 100, 200)
        assert float(pair.focal_px) == pytest.approx(200.0)
        seen = pair.left_px[torch.isfinite(pair.left_px)]
        torch.testing.assert_close(seen, torch.full_like(seen, 40.0))


def test_the_truth_of_a_folder_with_two_kinds_must_be_said(tmp_path: Path) -> None:
    make_pairs(tmp_path, names=("0", "1"))
    write_depth_png(tmp_path / "disp_occ" / "0.png", torch.full((60, 80), 20.0))
    write_depth_png(tmp_path / "lidar_depth" / "1.png", torch.full((60, 80), 10.0))
    message = r"several kinds of truth \(disparity of 1 frames, scan of 1 frames\).* set truth"
    with pytest.raises(InputError, match=message):
        known(tmp_path)
    assert known(tmp_path, truth="disparity") == {20.0}
    assert known(tmp_path, truth="scan") == {FOCAL_PX * BASELINE_M / 10}
    assert known(tmp_path, exclude=("1",)) == {20.0}
    with pytest.raises(InputError, match="no frame has truth: annotated; there is disparity of 1"):
        known(tmp_path, truth="annotated")


def test_an_annotated_map_no_longer_displaces_the_scan(tmp_path: Path) -> None:
    """One of two frames has a map beside its scan."""
    make_object(tmp_path)
    write_depth_png(tmp_path / "gt_depth_map" / "000000.png", torch.full((12, 20), 40.0))
    with pytest.raises(InputError, match=r"scan of 2 frames, annotated of 1 frames"):
        known(tmp_path)
    assert sorted(known(tmp_path, truth="scan")) == pytest.approx([18.5, 37.0], rel=1e-3)
    assert sorted(known(tmp_path, truth="annotated")) == pytest.approx([9.25], rel=1e-3)


def test_a_scan_of_the_depth_prediction_set_is_learnt_from(tmp_path: Path) -> None:
    make_raw(tmp_path)
    drive = tmp_path / "2011_09_26/2011_09_26_drive_0002_sync"
    for points in drive.glob("velodyne_points/data/*.bin"):
        points.unlink()
    drawn = drive / "proj_depth/velodyne_raw/image_02/0000000007.png"
    write_depth_png(drawn, torch.full((12, 20), 20.0))
    pair = open_dataset(tmp_path).read_rig(0)
    assert pair is not None
    wanted_px = float(pair.K[0, 0]) * pair.baseline_m / 20
    assert sorted(known(tmp_path, truth="scan")) == pytest.approx([wanted_px], abs=0.01)


def test_a_drawn_scan_of_another_size_is_refused(tmp_path: Path) -> None:
    make_pairs(tmp_path)
    write_depth_png(tmp_path / "lidar_depth" / "0.png", torch.full((30, 40), 10.0))
    with pytest.raises(InputError, match="is 40x30, but its left image is 80x60"):
        known(tmp_path)


def test_depth_without_a_calibration_is_no_truth(tmp_path: Path) -> None:
    make_pairs(tmp_path)
    (tmp_path / "calib.txt").unlink()
    write_depth_png(tmp_path / "lidar_depth" / "0.png", torch.full((60, 80), 10.0))
    with pytest.raises(InputError, match="0: has depth as its truth but no calibration"):
        known(tmp_path)


def test_each_folder_must_give_something(tmp_path: Path) -> None:
    """A folder that silently adds nothing would make another training than the one asked for."""
    for name in ("full", "empty"):
        make_pairs(tmp_path / name)
    write_depth_png(tmp_path / "full" / "disp_occ" / "0.png", torch.full((60, 80), 20.0))
    folders = (str(tmp_path / "full"), str(tmp_path / "empty"))
    with pytest.raises(InputError, match="empty: no frame has a right view and a truth"):
        TrainingPairs(PairsConfig(folders=folders), 0, needs_truth=True)
    assert len(TrainingPairs(PairsConfig(folders=folders), 0, needs_truth=False)) == 2


@pytest.mark.parametrize("needs_truth", [True, False])
def test_streets_that_are_none_are_refused(needs_truth: bool) -> None:
    config = PairsConfig(streets=StreetsConfig(frames=0))
    with pytest.raises(InputError, match=r"streets\.frames is 0, so there is no pair; give 1 or"):
        TrainingPairs(config, 0, needs_truth=needs_truth)


def test_the_record_of_a_run_says_the_truth_of_each_folder(tmp_path: Path) -> None:
    home = tmp_path / "mine"
    make_pairs(home)
    write_depth_png(home / "lidar_depth" / "0.png", torch.full((60, 80), 10.0))
    config = StereoTraining(
        network={"width": 4, "max_disparity_px": 48, "blocks": [1, 1, 1, 1], "pools": [4, 2]},
        pairs=PairsConfig(
            folders=(str(home),),
            streets=StreetsConfig(frames=1, scale=0.2),
            augment=AugmentConfig(crop_px=(48, 64)),
        ),
        loop=LoopConfig(steps=1, batch_size=1, device="cpu"),
    )
    path = train_stereo(config, TrainingRun(folder=tmp_path / "run"))
    record = read_json(tmp_path / "run" / "run.json")
    assert isinstance(record, dict)
    assert record["settings"]["truth"] == ["synthetic streets: disparity", "mine: scan"]
    assert (
        "- **Truth**: synthetic streets: disparity, mine: scan\n"
        in path.with_suffix(".md").read_text()
    )
    assert config_to_dict(config)["pairs"]["truth"] is None


def test_right_views_that_are_missing_are_counted(tmp_path: Path) -> None:
    make_pairs(tmp_path, ("0", "1", "2"))
    TrainingPairs(PairsConfig(folders=(str(tmp_path),)), 0, needs_truth=False)
    (tmp_path / "right" / "1.png").unlink()
    with pytest.warns(Notice, match="1 of 3 images have no right view, and are left out"):
        pairs = TrainingPairs(PairsConfig(folders=(str(tmp_path),)), 0, needs_truth=False)
    assert len(pairs) == 2


def test_both_spellings_of_an_accent_are_one_name(tmp_path: Path) -> None:
    make_pairs(tmp_path, ("caf\u00e9", "street"))
    (tmp_path / "right" / "caf\u00e9.png").rename(tmp_path / "right" / "cafe\u0301.png")
    frames = open_dataset(tmp_path).frames
    assert [frame.name for frame in frames] == ["caf\u00e9", "street"]
    assert all(frame.right is not None for frame in frames)
