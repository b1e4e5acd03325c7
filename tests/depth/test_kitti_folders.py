"""Layouts, calibration, splits and the check, on synthetic folders and on the real samples."""

from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from depthpose.core.errors import InputError
from depthpose.core.files import write_depth_png, write_image, write_map
from depthpose.depth.datasets import (
    check_dataset,
    list_truth_kinds,
    open_dataset,
    read_lidar_depth,
    read_split,
    read_true_depth,
)
from depthpose.depth.datasets.frames import read_object_calibration, read_plain_calibration

W, H = 20, 12
P2 = "700 0 10 45 0 700 6 0.2 0 0 1 0.003"
P3 = "700 0 10 -325 0 700 6 2.2 0 0 1 0.003"
EYE = "1 0 0 0 1 0 0 0 1"
LIDAR = "0 -1 0 0 0 0 -1 0 1 0 0 0"  # x forward, y left, z up to x right, y down, z forward
OBJECT_TEXT = f"P0: {P2}\nP1: {P2}\nP2: {P2}\nP3: {P3}\nR0_rect: {EYE}\nTr_velo_to_cam: {LIDAR}\n"


def picture(path: Path, width: int = W) -> None:
    write_image(path, torch.rand(3, H, width))


def write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def scan(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.array([[10, 0, 0, 0.5], [20, 0.05, 0.02, 0.1]], np.float32).tofile(path)


def make_object(home: Path) -> None:
    for name in ("000000", "000001"):
        picture(home / "image_2" / f"{name}.png")
        picture(home / "image_3" / f"{name}.png")
        write(home / "calib" / f"{name}.txt", OBJECT_TEXT)
        scan(home / "velodyne" / f"{name}.bin")


def make_raw(home: Path, drive: str = "2011_09_26_drive_0002_sync") -> None:
    date = home / drive[:10]
    for name in ("0000000007", "0000000008"):
        picture(date / drive / "image_02/data" / f"{name}.jpg")
        picture(date / drive / "image_03/data" / f"{name}.jpg")
        scan(date / drive / "velodyne_points/data" / f"{name}.bin")
    text = f"calib_time: 09-Jan-2012 13:57:47\nP_rect_02: {P2}\nP_rect_03: {P3}\nR_rect_00: {EYE}\n"
    write(date / "calib_cam_to_cam.txt", text)
    write(date / "calib_velo_to_cam.txt", "R: 0 -1 0 0 0 -1 1 0 0\nT: 0 0 0\n")


def make_2015(home: Path) -> None:
    for name in ("000000_10", "000000_11"):
        picture(home / "training/image_2" / f"{name}.png")
        picture(home / "training/image_3" / f"{name}.png")
    for kind in ("disp_occ_0", "disp_noc_0"):
        write_depth_png(home / "training" / kind / "000000_10.png", torch.full((H, W), 3.0))


def make_2012(home: Path) -> None:
    picture(home / "training/colored_0/000003_10.png")
    picture(home / "training/colored_1/000003_10.png")
    write(home / "training/calib/000003.txt", f"P0: {P2}\nP1: {P3}\nP2: {P2}\nP3: {P3}\n")
    write_depth_png(home / "training/disp_occ/000003_10.png", torch.full((H, W), 3.0))


def make_middlebury(home: Path) -> None:
    picture(home / "Chair/im0.png")
    picture(home / "Chair/im1.png")
    write(
        home / "Chair/calib.txt",
        "cam0=[900 0 10; 0 900 6; 0 0 1]\ncam1=[900 0 15; 0 900 6; 0 0 1]\ndoffs=5\n"
        f"baseline=193.0\nwidth={W}\nheight={H}\nndisp=70\n",
    )
    write_map(home / "Chair/disp0GT.pfm", torch.full((H, W), 4.0))


def make_pairs(home: Path) -> None:
    for name in ("a", "b"):
        picture(home / "left" / f"{name}.png")
        picture(home / "right" / f"{name}.jpg")
    write(home / "calib.txt", "# rig\nfocal_px: 700\ncx: 10\ncy: 6\nbaseline_m: 0.5\n")
    write_depth_png(home / "lidar_depth/a.png", torch.full((H, W), 9.0))


def make_odometry(home: Path) -> None:
    for side in ("image_2", "image_3"):
        picture(home / "sequences/02" / side / "000000.png")
    scan(home / "sequences/02/velodyne/000000.bin")
    text = f"P0: {P2}\nP1: {P2}\nP2: {P2}\nP3: {P3}\nTr: {LIDAR}\n"
    write(home / "sequences/02/calib.txt", text)


MAKERS: dict[str, tuple[Callable[[Path], None], int, float]] = {
    "KITTI raw": (make_raw, 2, 370 / 700),
    "KITTI object or 2015": (make_object, 2, 370 / 700),
    "KITTI odometry": (make_odometry, 1, 370 / 700),
    "KITTI 2012": (make_2012, 1, 370 / 700),
    "Middlebury": (make_middlebury, 1, 0.193),
    "pairs": (make_pairs, 2, 0.5),
}


@pytest.mark.parametrize("layout", MAKERS)
def test_each_layout_is_recognised_and_read(layout: str, tmp_path: Path) -> None:
    make, count, baseline_m = MAKERS[layout]
    make(tmp_path)
    dataset = open_dataset(tmp_path)
    assert (dataset.layout, len(dataset)) == (layout, count)
    sample = dataset[0]
    assert sample.input.right is not None
    assert sample.input.right.shape == sample.input.left.shape == (3, H, W)
    rig = dataset.read_rig(0)
    assert rig is not None
    assert rig.baseline_m == pytest.approx(baseline_m)
    assert check_dataset(tmp_path).is_ok


def test_the_training_folder_is_a_root_too(tmp_path: Path) -> None:
    make_object(tmp_path / "training")
    assert [frame.name for frame in open_dataset(tmp_path).frames] == ["000000", "000001"]
    assert [frame.name for frame in open_dataset(tmp_path / "training").frames] == [
        "000000",
        "000001",
    ]


def test_of_a_stereo_set_only_the_first_moments_count(tmp_path: Path) -> None:
    make_2015(tmp_path)
    dataset = open_dataset(tmp_path)
    assert [frame.name for frame in dataset.frames] == ["000000_10"]
    assert dataset.frames[0].disparity_noc is not None
    assert dataset.read_rig(0) is None
    assert dataset[0].truth.disparity_px is not None


def test_the_baseline_is_that_of_the_calibration_and_so_is_doffs(tmp_path: Path) -> None:
    make_middlebury(tmp_path)
    rig = open_dataset(tmp_path).read_rig(0)
    assert rig is not None
    assert rig.cx_right_minus_left_px == 5.0


@pytest.mark.parametrize(
    ("make", "inside", "name"),
    [
        (make_middlebury, "Chair", "Chair"),
        (make_raw, "2011_09_26/2011_09_26_drive_0002_sync", None),
    ],
)
def test_the_working_folder_has_a_name(
    make: Callable[[Path], None],
    inside: str,
    name: str | None,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    make(tmp_path)
    named = [frame.name for frame in open_dataset(tmp_path / inside).frames]
    assert name is None or named == [name]
    monkeypatch.chdir(tmp_path / inside)
    assert [frame.name for frame in open_dataset(".").frames] == named


def test_raw_and_object_calibration_draw_the_same_scan(tmp_path: Path) -> None:
    make_raw(tmp_path / "raw")
    make_object(tmp_path / "object")
    drawn = [
        read_lidar_depth(open_dataset(tmp_path / name).frames[0], "camera_z")
        for name in ("raw", "object")
    ]
    assert torch.equal(drawn[0].nan_to_num(0.0), drawn[1].nan_to_num(0.0))
    assert int(torch.isfinite(drawn[0]).sum()) == 2


def test_a_drawn_scan_serves_camera_z_only(tmp_path: Path) -> None:
    make_pairs(tmp_path)
    frame = open_dataset(tmp_path).frames[0]
    assert read_lidar_depth(frame, "camera_z")[0, 0].item() == 9.0
    with pytest.raises(InputError, match="a: has no LiDAR scan of the kind velodyne_x"):
        read_lidar_depth(frame, "velodyne_x")


def test_annotated_depth_is_found_beside_the_drives(tmp_path: Path) -> None:
    make_raw(tmp_path)
    drive = "2011_09_26_drive_0002_sync"
    inside = f"{drive}/proj_depth/groundtruth/image_02/0000000007.png"
    write_depth_png(tmp_path / "val" / inside, torch.full((H, W), 5.0))
    assert open_dataset(tmp_path).frames[0].depth == tmp_path / "val" / inside


def test_what_is_known_of_a_depth_is_the_scan_where_there_is_one(tmp_path: Path) -> None:
    make_raw(tmp_path)
    drive = "2011_09_26_drive_0002_sync"
    inside = f"{drive}/proj_depth/groundtruth/image_02/0000000007.png"
    write_depth_png(tmp_path / "val" / inside, torch.full((H, W), 5.0))
    for index in range(2):  # with an annotated map, and with a scan alone
        known_m = read_true_depth(open_dataset(tmp_path), index)
        assert known_m is not None
        assert known_m[known_m.isfinite()].tolist() == pytest.approx([20.003, 10.003], abs=0.01)


@pytest.mark.parametrize("home", ["", "data_depth_velodyne/"])
def test_a_scan_of_the_depth_prediction_set_stands_in_for_one_of_points(
    home: str, tmp_path: Path
) -> None:
    """Its downloads hold drawn scans (16 bit, camera z) and no points."""
    make_raw(tmp_path)
    drive = "2011_09_26_drive_0002_sync"
    for points in (tmp_path / f"2011_09_26/{drive}/velodyne_points/data").iterdir():
        points.unlink()
    inside = f"{home}train/{drive}/proj_depth/velodyne_raw/image_02/0000000007.png"
    drawn = torch.full((H, W), torch.nan)
    drawn[3, 4] = 7.5
    write_depth_png(tmp_path / inside, drawn)
    frame, other = open_dataset(tmp_path).frames
    assert list_truth_kinds(other) == ()
    assert list_truth_kinds(frame) == ("scan",)
    assert read_lidar_depth(frame, "camera_z").nan_to_num(0.0).sum().item() == 7.5
    assert read_lidar_depth(frame, "camera_z")[3, 4].item() == 7.5
    with pytest.raises(InputError, match="no LiDAR scan of the kind velodyne_x"):
        read_lidar_depth(frame, "velodyne_x")
    report = check_dataset(tmp_path)
    assert (report.counts["LiDAR scans"], report.problems) == (1, [])
    write_depth_png(tmp_path / inside, drawn[:, 1:])
    with pytest.raises(InputError, match="but its left image is"):
        read_lidar_depth(frame, "camera_z")
    assert "but its left image is" in check_dataset(tmp_path).problems[0].message


def test_points_come_before_a_drawn_scan(tmp_path: Path) -> None:
    """The published protocol draws the points itself."""
    make_raw(tmp_path)
    drive = tmp_path / "2011_09_26/2011_09_26_drive_0002_sync"
    frame = open_dataset(tmp_path).frames[0]
    own = read_lidar_depth(frame, "camera_z")
    inside = "proj_depth/velodyne_raw/image_02/0000000007.png"
    write_depth_png(drive / inside, torch.full((H, W), 50.0))
    frame = open_dataset(tmp_path).frames[0]
    assert frame.scan == drive / inside
    torch.testing.assert_close(read_lidar_depth(frame, "camera_z"), own, equal_nan=True)


def test_one_line_a_pair_gives_each_its_own_camera(tmp_path: Path) -> None:
    make_pairs(tmp_path)
    write(
        tmp_path / "calib.txt", f"# name ...\na {W} {H} 700 10 6 0.5 own\nb {W} {H} 650 10 6 0.4\n"
    )
    dataset = open_dataset(tmp_path)
    rigs = [dataset.read_rig(i) for i in range(2)]
    assert [rig.baseline_m for rig in rigs if rig is not None] == [0.5, 0.4]


@pytest.mark.parametrize("more", ["", " 700 0"])
def test_a_name_that_begins_with_another_and_numbers_keeps_its_own_line(
    tmp_path: Path, more: str
) -> None:
    names = {"scan": 0.5, "scan 2": 0.4, "scan 2 3": 0.3}
    lines = [f"{name} {W} {H} 700 10 6 {metres}{more}\n" for name, metres in names.items()]
    write(tmp_path / "calib.txt", "".join(lines))
    for name, metres in names.items():
        assert read_plain_calibration(tmp_path / "calib.txt", name, W, H).baseline_m == metres


def test_a_line_of_seven_numbers_is_refused(tmp_path: Path) -> None:
    write(tmp_path / "calib.txt", f"a {W} {H} 700 10 6 0.5 710\n")
    with pytest.raises(InputError, match=r"'a' is no calibration: .* or with eight, which go on"):
        read_plain_calibration(tmp_path / "calib.txt", "a", W, H)


def _truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:60])


def _make_pointer(path: Path) -> None:
    path.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n")


def _resize(path: Path) -> None:
    picture(path, W + 2)


def _empty(path: Path) -> None:
    path.write_bytes(b"")


def _odd(path: Path) -> None:
    path.write_bytes(b"\x00" * 17)


def _nan(path: Path) -> None:
    np.full((3, 4), np.nan, np.float32).tofile(path)


def _no_truth(path: Path) -> None:
    write_depth_png(path, torch.full((H, W), torch.nan))


def _small_truth(path: Path) -> None:
    write_depth_png(path, torch.ones(H, W + 4))


def _no_p3(path: Path) -> None:
    path.write_text(OBJECT_TEXT.replace("P3:", "P9:"))


def _short_p2(path: Path) -> None:
    path.write_text(OBJECT_TEXT.replace(f"P2: {P2}", "P2: 1 2 3"))


def _swapped(path: Path) -> None:
    text = OBJECT_TEXT.replace(f"P2: {P2}", "P2: @").replace(f"P3: {P3}", f"P3: {P2}")
    path.write_text(text.replace("P2: @", f"P2: {P3}"))


@pytest.mark.parametrize(
    ("make", "file", "spoil", "kind", "message"),
    [
        (make_object, "image_2/000001.png", _truncate, "unreadable", "file is truncated"),
        (make_object, "image_3/000000.png", _make_pointer, "unreadable", "Git LFS pointer"),
        (make_object, "image_3/000000.png", _resize, "mismatch", "is 22x12, but its left"),
        (make_object, "velodyne/000000.bin", _empty, "unreadable", "0 bytes"),
        (make_object, "velodyne/000000.bin", _odd, "unreadable", "17"),
        (make_object, "velodyne/000000.bin", _nan, "unreadable", "NaN or infinity"),
        (make_object, "calib/000000.txt", _no_p3, "unreadable", "has no line 'P3:'"),
        (make_object, "calib/000000.txt", _short_p2, "unreadable", "P2 holds 3 numbers"),
        (make_object, "calib/000000.txt", _swapped, "unreadable", "baseline"),
        (make_object, "calib/000001.txt", _odd, "unreadable", "not 'KEY: numbers'"),
        (make_pairs, "lidar_depth/a.png", _no_truth, "empty", "holds no value"),
        (make_pairs, "lidar_depth/a.png", _small_truth, "mismatch", "is 24x12"),
        (make_pairs, "calib.txt", _empty, "unreadable", "neither 'focal_px"),
        (make_middlebury, "Chair/calib.txt", _empty, "unreadable", "no camera that is known"),
        (make_middlebury, "Chair/disp0GT.pfm", _truncate, "unreadable", "it is truncated"),
        (make_raw, "2011_09_26/calib_velo_to_cam.txt", Path.unlink, "missing", "nothing of the L"),
    ],
)
def test_the_check_names_what_is_wrong(
    make: Callable[[Path], None],
    file: str,
    spoil: Callable[[Path], None],
    kind: str,
    message: str,
    tmp_path: Path,
) -> None:
    make(tmp_path)
    spoil(tmp_path / file)
    report = check_dataset(tmp_path)
    assert not report.is_ok
    problem = report.problems[0]
    assert problem.kind == kind
    assert message in problem.message
    assert problem.path == tmp_path / file or kind == "missing"


def test_the_check_counts_and_notes_what_is_not_there(tmp_path: Path) -> None:
    make_pairs(tmp_path)
    (tmp_path / "right/b.jpg").unlink()
    seen: list[tuple[int, int]] = []
    report = check_dataset(tmp_path, progress=lambda done, total: seen.append((done, total)))
    assert report.is_ok
    assert report.counts["frames"] == 2
    assert report.counts["right views"] == 1
    notes = [note.message for note in report.notices]
    small = (
        "beside a.png: only 0 of the 25 matches needed: cannot tell whether the pair is rectified"
    )
    assert notes == ["mixes PNG and JPEG images", small, "has no right view"]
    assert seen == [(1, 2), (2, 2)]
    assert "nothing is wrong, 3 notices" in report.summary


def test_two_images_of_one_name_are_a_mismatch(tmp_path: Path) -> None:
    make_pairs(tmp_path)
    picture(tmp_path / "left/a.jpg")
    assert "the same name" in check_dataset(tmp_path).problems[0].message


def test_the_check_of_a_split_names_missing_frames(tmp_path: Path) -> None:
    make_raw(tmp_path)
    report = check_dataset(tmp_path, "eigen-test")
    assert len(report.problems) == 697
    assert report.problems[0].kind == "missing"


@pytest.mark.parametrize(
    ("prepare", "message"),
    [
        (lambda _: None, "there is no such folder"),
        (Path.mkdir, "no layout that is known here. It holds nothing. Known: packed shards"),
        (lambda home: write(home / "notes.txt", ""), r"It holds notes\.txt"),
    ],
)
def test_a_folder_of_no_layout_is_refused(
    prepare: Callable[[Path], None], message: str, tmp_path: Path
) -> None:
    prepare(tmp_path / "x")
    with pytest.raises(InputError, match=message):
        open_dataset(tmp_path / "x")


def test_a_split_that_is_not_there_is_refused(tmp_path: Path) -> None:
    make_raw(tmp_path)
    with pytest.raises(InputError, match="697 of the 697 frames of eigen-test are missing, first"):
        open_dataset(tmp_path, "eigen-test")


@pytest.mark.parametrize(
    ("name", "count"),
    [
        ("eigen-train", 22600),
        ("eigen-val", 888),
        ("eigen-train-val", 23488),
        ("eigen-test", 697),
        ("eigen-benchmark", 652),
    ],
)
def test_the_splits_have_their_published_sizes(name: str, count: int) -> None:
    split = read_split(name)
    assert len(set(split.frames)) == len(split.names) == count


def test_the_splits_keep_their_published_facts() -> None:
    train, val, test = (set(read_split(f"eigen-{n}").frames) for n in ("train", "val", "test"))
    assert not train & val
    assert set(read_split("eigen-train-val").frames) == train | val
    assert not {drive for drive, _ in train | val} & {drive for drive, _ in test}
    assert set(read_split("eigen-benchmark").frames) < test
    dates = Counter(drive[:10] for drive, _ in test)
    assert sorted(dates.values()) == [25, 25, 50, 75, 522]
    assert Counter(drive[:10] for drive, _ in train)["2011_09_30"] == 8760


@pytest.mark.data
@pytest.mark.parametrize(
    ("file", "name"),
    [
        ("eigen/test_files.txt", "eigen-test"),
        ("eigen_full/train_files.txt", "eigen-train"),
        ("eigen_full/val_files.txt", "eigen-val"),
        ("eigen_benchmark/test_files.txt", "eigen-benchmark"),
    ],
)
def test_lists_of_others_are_recognised(real: Path, file: str, name: str) -> None:
    assert read_split(real / "depth/splits" / file).name == name


def test_a_list_of_image_paths_is_read(tmp_path: Path) -> None:
    home = "2011_09_26/2011_09_26_drive_0002_sync"
    line = f"{home}/image_02/data/0000000007.jpg {home}/image_03/data/0000000007.jpg\n"
    (tmp_path / "mine.txt").write_text(line)
    split = read_split(tmp_path / "mine.txt")
    assert (split.name, split.frames) == ("mine.txt", (("2011_09_26_drive_0002_sync", 7),))
    make_raw(tmp_path / "data")
    chosen = open_dataset(tmp_path / "data", tmp_path / "mine.txt")
    assert [frame.name for frame in chosen.frames] == ["2011_09_26_drive_0002_sync_0000000007"]


def test_a_file_of_train_and_val_is_the_joined_split(tmp_path: Path) -> None:
    frames = [f for part in ("val", "train") for f in read_split(f"eigen-{part}").frames]
    lines = [f"{drive[:10]}/{drive} {number} l" for drive, number in frames]
    (tmp_path / "both.txt").write_text("\n".join(lines))
    assert read_split(tmp_path / "both.txt") == read_split("eigen-train-val")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "names no frame"),
        ("some words", "line 1 is 'some words', but a frame is"),
        ("2011_09_26/2011_09_26_drive_0002_sync 7 r\n", "names no frame"),
        ("2011_09_26/2011_09_26_drive_0002_sync seven l\n", "line 1 is"),
    ],
)
def test_a_bad_list_is_refused(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "s.txt").write_text(text)
    with pytest.raises(InputError, match=message):
        read_split(tmp_path / "s.txt")


@pytest.mark.data
def test_the_joined_list_of_others_is_recognised(real: Path, tmp_path: Path) -> None:
    parts = [real / "depth/splits/eigen_full" / f"{name}_files.txt" for name in ("train", "val")]
    write(tmp_path / "both.txt", "".join(part.read_text().rstrip() + "\n" for part in parts))
    assert read_split(tmp_path / "both.txt").name == "eigen-train-val"


def test_an_unknown_split_names_the_nearest() -> None:
    with pytest.raises(InputError, match="did you mean 'eigen-test'"):
        read_split("eigen_tst")


@settings(
    max_examples=80, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(noise=st.one_of(st.binary(max_size=300), st.text(max_size=200).map(str.encode)))
def test_no_bytes_let_another_error_escape(tmp_path: Path, noise: bytes) -> None:
    path = tmp_path / "x.txt"
    for content in (noise, b"P2: " + noise, OBJECT_TEXT.encode() + noise, b"focal_px: " + noise):
        path.write_bytes(content)
        for read in (
            lambda: read_object_calibration(path, W, H),
            lambda: read_plain_calibration(path, "a", W, H),
            lambda: read_split(path),
        ):
            with suppress(InputError):
                read()


@pytest.mark.data
@pytest.mark.parametrize(
    ("folder", "count", "parts"),
    [
        ("kitti_raw", 18, {"right views": 10, "LiDAR scans": 10, "calibrations": 10}),
        ("kitti_object", 12, {"right views": 12, "LiDAR scans": 3, "depth maps": 7}),
        ("kitti_2015", 1, {"right views": 1, "disparity maps": 1}),
        ("middlebury/2014_trainingQ", 1, {"disparity maps": 1}),
        pytest.param(
            "street_pairs/kitti2015_eval_drives", 25, {"disparity maps": 25, "depth maps": 25},
            marks=pytest.mark.slow,
        ),
        pytest.param(
            "street_pairs/kitti_object_more", 15, {"calibrations": 15, "depth maps": 15},
            marks=pytest.mark.slow,
        ),
        ("street_pairs/kitti_raw_0056", 4, {"right views": 4}),
        ("street_pairs/kitti_single", 3, {"calibrations": 3}),
    ],
)  # fmt: skip
def test_the_real_samples_pass_the_check(
    real: Path, folder: str, count: int, parts: dict[str, int]
) -> None:
    report = check_dataset(real / "depth" / folder)
    assert report.problems == []
    assert report.counts["frames"] == count
    assert parts.items() <= report.counts.items()


def test_capitals_and_maps_of_floats_are_found(tmp_path: Path) -> None:
    """-1 and 0 in a map of floats are no truth."""
    make_pairs(tmp_path)
    for side, ending in (("left", "png"), ("right", "jpg")):
        old = tmp_path / side / f"a.{ending}"
        old.rename(old.with_suffix(f".{ending.upper()}"))
    (tmp_path / "lidar_depth/a.png").unlink()
    depth_m, disparity_px = torch.full((H, W), 9.0), torch.full((H, W), 4.0)
    depth_m[0], disparity_px[:2], disparity_px[2] = 0.0, -1.0, torch.nan
    write_map(tmp_path / "lidar_depth/a.npy", depth_m)
    (tmp_path / "disp_occ").mkdir()
    write_map(tmp_path / "disp_occ/a.pfm", disparity_px)
    (tmp_path / "disp_occ/a.pfm").rename(tmp_path / "disp_occ/a.PFM")
    report = check_dataset(tmp_path)
    assert report.is_ok
    assert report.counts | {"right views": 2, "depth maps": 1, "disparity maps": 1} == report.counts
    truth = open_dataset(tmp_path).read_truth(0)
    assert truth.depth_m is not None
    assert truth.disparity_px is not None
    assert int(truth.depth_m.isnan().sum()) == W
    assert int(truth.disparity_px.isnan().sum()) == 3 * W


def test_maps_that_belong_to_no_frame_are_a_problem(tmp_path: Path) -> None:
    make_pairs(tmp_path)
    (tmp_path / "lidar_depth/a.png").rename(tmp_path / "lidar_depth/a.mat")
    (problem,) = check_dataset(tmp_path).problems
    assert (
        "lidar_depth: holds no file of a frame's name" in str(problem.path) + ": " + problem.message
    )


def test_a_grey_sequence_has_the_rig_and_scans_of_its_cameras(tmp_path: Path) -> None:
    for side in ("image_0", "image_1"):
        picture(tmp_path / side / "000000.png")
    scan(tmp_path / "velodyne/000000.bin")
    text = f"P0: {P2}\nP1: {P3.replace('-325', '-305')}\nP2: {P2}\nP3: {P3}\nTr: {LIDAR}\n"
    write(tmp_path / "calib.txt", text)
    dataset = open_dataset(tmp_path)
    rig = dataset.read_rig(0)
    assert dataset.frames[0].name == "000000"
    assert rig is not None
    assert rig.baseline_m == pytest.approx(350 / 700)
    assert bool(read_lidar_depth(dataset.frames[0], "camera_z").isfinite().any())


def test_the_selection_of_frames_has_one_camera_and_both_truths(tmp_path: Path) -> None:
    home = tmp_path / "val_selection_cropped"
    name = "2011_09_26_drive_0002_sync_{}0000000005_image_02"
    picture(home / "image" / f"{name.format('image_')}.png")
    write(home / "intrinsics" / f"{name.format('image_')}.txt", "700 0 10 0 700 6 0 0 1")
    for k, kind in enumerate(("groundtruth_depth", "velodyne_raw")):
        path = home / kind / f"{name.format(f'{kind}_')}.png"
        write_depth_png(path, torch.full((H, W), 9.0 + k))
    for folder in (tmp_path, home):
        dataset = open_dataset(folder)
        assert check_dataset(folder).is_ok
        assert dataset.read_rig(0) is None
        assert dataset.read_input(0).camera is not None
        assert list_truth_kinds(dataset.frames[0]) == ("scan", "annotated")
        assert float(read_lidar_depth(dataset.frames[0], "camera_z").mean()) == 10


def test_drives_that_are_not_rectified_are_named(tmp_path: Path) -> None:
    drive = tmp_path / "2011_09_26/2011_09_26_drive_0002_extract"
    picture(drive / "image_02/data/0000000000.png")
    for folder in (tmp_path, drive.parent, drive):
        with pytest.raises(InputError, match=r"_extract .* neither rectified nor synch.* _sync"):
            open_dataset(folder)
