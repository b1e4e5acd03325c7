"""Made streets on disk: written, checked, resumed, and read as KITTI is read."""

import os
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from depthpose.cli import main
from depthpose.core.errors import InputError
from depthpose.depth.config import StreetsConfig
from depthpose.depth.datasets import (
    has_calibration,
    has_raw_frame,
    open_dataset,
    read_lidar_depth,
    write_raw_frame,
)
from depthpose.depth.disparity import disparity_from_depth
from depthpose.depth.synthetic import render_street


@pytest.fixture(scope="module")
def synthetic(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("made")
    assert main(make(folder, 3)) == 0
    return folder


def make(folder: Path, number: int, *more: str) -> list[str]:
    return ["data", "make", "streets", "--out", str(folder), "--number", str(number),
            "--scale", "0.25", "--seed", "7", *more]  # fmt: skip


def test_the_check_finds_nothing_wrong(synthetic: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["data", "check", str(synthetic)]) == 0
    said = capsys.readouterr().out
    assert "KITTI raw: 3 frames, 3 right views, 3 calibrations, 3 LiDAR scans" in said
    assert "3 disparity maps; nothing is wrong" in said


def test_finished_frames_are_kept(synthetic: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = {path: path.stat().st_mtime_ns for path in synthetic.rglob("*.png")}
    assert main(make(synthetic, 3)) == 0
    assert "0 frames made, 3 were there" in capsys.readouterr().out
    assert before == {path: path.stat().st_mtime_ns for path in synthetic.rglob("*.png")}


def test_other_settings_are_refused(synthetic: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = make(synthetic, 3)
    words[words.index("0.25")] = "0.5"
    assert main(words) == 2
    assert "scale = 0.25, but now it is 0.5" in capsys.readouterr().err
    assert main(make(synthetic, 0)) == 2


def test_what_is_read_is_metric(synthetic: Path) -> None:
    dataset = open_dataset(synthetic)
    frame = dataset.frames[0]
    rig, truth = dataset.read_rig(0), dataset.read_truth(0)
    assert rig is not None
    assert truth.disparity_px is not None
    scan_m = read_lidar_depth(frame, "camera_z")
    # KITTI's own protocol draws a point one pixel up and to the left.
    expected = disparity_from_depth(scan_m, rig).roll((1, 1), (0, 1))
    difference = (expected - truth.disparity_px).abs()
    known = difference[difference.isfinite()]
    assert len(known) > 3000
    assert float(known.median()) < 0.1
    assert int(torch.isnan(truth.disparity_px).sum()) > 0


def test_one_date_has_one_calibration(tmp_path: Path) -> None:
    drive = "2100_02_01_drive_0001_sync"
    raw = render_street(StreetsConfig(scale=0.05), 0)
    write_raw_frame(tmp_path, drive, 3, raw)
    other = replace(raw, rig=replace(raw.rig, baseline_m=0.6))
    with pytest.raises(InputError, match="another rig or scale"):
        write_raw_frame(tmp_path, drive, 4, other)
    assert has_raw_frame(tmp_path, drive, 3)
    assert has_calibration(tmp_path, drive[:10])
    left = tmp_path / drive[:10] / drive / "image_02/data/0000000003.png"
    good, times = left.read_bytes(), left.stat()
    left.write_bytes(good[:-5])
    assert not has_raw_frame(tmp_path, drive, 3)
    left.write_bytes(good)
    os.utime(left, ns=(times.st_atime_ns, times.st_mtime_ns))
    assert has_raw_frame(tmp_path, drive, 3)
    assert not has_raw_frame(tmp_path, drive, 4)
    rig = open_dataset(tmp_path).read_rig(0)
    assert rig is not None
    assert rig.baseline_m == pytest.approx(0.5327, abs=0.006)
