"""What does not belong together is refused, on reading and in the check."""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from tests.synthetic_street import make_street

from depthpose.core.errors import InputError
from depthpose.core.files import write_depth_png, write_image, write_map
from depthpose.depth.datasets import check_dataset, open_dataset, read_lidar_depth, read_split
from depthpose.depth.datasets.frames import read_object_calibration

W, H = 20, 12
P2, P3 = "700 0 10 45 0 700 6 0.2 0 0 1 0.003", "700 0 10 -325 0 700 6 2.2 0 0 1 0.003"
TEXT = f"P2: {P2}\nP3: {P3}\nR0_rect: 1 0 0 0 1 0 0 0 1\n"
LIDAR = "Tr_velo_to_cam: 0 -1 0 0 0 0 -1 0 1 0 0 0\n"
DRIVE = "2011_09_26/2011_09_26_drive_0002_sync"


def put(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


def picture(path: Path, width: int = W) -> None:
    write_image(path, torch.rand(3, H, width))


@pytest.fixture
def pairs(tmp_path: Path) -> Path:
    for name in ("a", "b"):
        picture(tmp_path / f"left/{name}.png")
        picture(tmp_path / f"right/{name}.png")
    put(tmp_path / "calib.txt", "focal_px: 700\ncx: 10\ncy: 6\nbaseline_m: 0.5\n")
    return tmp_path


@pytest.fixture
def raw(tmp_path: Path) -> Path:
    picture(tmp_path / DRIVE / "image_02/data/0000000007.png")
    put(tmp_path / "2011_09_26/calib_cam_to_cam.txt", f"P_rect_02: {P2}\nP_rect_03: {P3}\n")
    return tmp_path


def _wide_right(home: Path) -> None:
    picture(home / "right/a.png", W + 2)


def _small_depth(home: Path) -> None:
    write_depth_png(home / "lidar_depth/a.png", torch.ones(5, 5))


def _wide_camera(home: Path) -> None:
    put(home / "calib.txt", "".join(f"{n} 1242 375 700 600 180 0.5\n" for n in "ab"))


def _two_lines(home: Path) -> None:
    put(home / "calib.txt", f"a {W} {H} 700 10 6 0.5\na {W} {H} 99 10 6 0.5\n")


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (_wide_right, r"right/a\.png: is 22x12, but its left image is 20x12"),
        (_small_depth, r"lidar_depth/a\.png: is 5x5, but its left image is 20x12"),
        (_wide_camera, r"left/a\.png is 20x12 but its camera is 1242x375"),
        (_two_lines, r"calib\.txt: 2 lines for 'a'"),
    ],
)
def test_a_sample_of_parts_that_differ_is_refused(
    spoil: Callable[[Path], None], message: str, pairs: Path
) -> None:
    spoil(pairs)
    with pytest.raises(InputError, match=message):
        open_dataset(pairs)[0]
    assert not check_dataset(pairs).is_ok


def test_a_scaled_image_of_kitti_is_refused(raw: Path) -> None:
    path = raw / "2011_09_26/calib_cam_to_cam.txt"
    put(path, path.read_text() + "S_rect_02: 1242 375\n")
    with pytest.raises(InputError, match="S_rect_02 says 1242x375, but the image is 20x12"):
        open_dataset(raw)[0]


def test_two_images_of_one_name_are_refused(pairs: Path) -> None:
    picture(pairs / "left/a.jpg")
    with pytest.raises(InputError, match=r"a\.png: has the same name as .*a\.jpg; remove one"):
        open_dataset(pairs)


def test_hidden_files_are_no_frames(pairs: Path) -> None:
    shutil.copy(pairs / "left/a.png", pairs / "left/._a.png")
    assert [frame.name for frame in open_dataset(pairs).frames] == ["a", "b"]


@pytest.mark.parametrize("start", ["", "2011_09_26", DRIVE])
def test_raw_opens_at_root_date_and_drive_with_its_annotated_depth(start: str, raw: Path) -> None:
    inside = f"{Path(DRIVE).name}/proj_depth/groundtruth/image_02/0000000007.png"
    write_depth_png(raw / "train" / inside, torch.ones(H, W))
    frames = open_dataset(raw / start).frames
    assert [frame.name for frame in frames] == ["2011_09_26_drive_0002_sync_0000000007"]
    assert frames[0].depth == raw / "train" / inside
    assert frames[0].calibration == raw / "2011_09_26"


def test_scenes_of_one_name_in_two_sets_keep_apart(tmp_path: Path) -> None:
    text = f"cam0=[900 0 10; 0 900 6; 0 0 1]\ndoffs=5\nbaseline=193\nwidth={W}\nheight={H}\n"
    for size in ("H", "Q"):
        picture(tmp_path / size / "Chair/im0.png")
        put(tmp_path / size / "Chair/calib.txt", text)
        write_map(tmp_path / size / "Chair/disp0GT.pfm", torch.full((H, W), 4.0))
    names = [[f.name for f in open_dataset(tmp_path / s).frames] for s in ("", "H", "H/Chair")]
    assert names == [["H_Chair", "Q_Chair"], ["Chair"], ["Chair"]]


def test_second_moments_are_left_out_where_there_is_no_truth(tmp_path: Path) -> None:
    for moment in ("10", "11"):
        picture(tmp_path / f"testing/image_2/000000_{moment}.png")
    frames = open_dataset(tmp_path / "testing").frames
    assert [frame.name for frame in frames] == ["000000_10"]


def test_a_folder_of_datasets_names_them(pairs: Path) -> None:
    (pairs / "set").mkdir()
    for name in ("left", "right"):
        (pairs / name).rename(pairs / "set" / name)
    with pytest.raises(InputError, match="Open one of its folders instead: set"):
        open_dataset(pairs)


def _lone_right(home: Path) -> None:
    (home / "left/b.png").unlink()


def _far_depth(home: Path) -> None:
    write_depth_png(home / "lidar_depth/a.png", torch.full((H, W), 250.0))


def _wide_disparity(home: Path) -> None:
    write_depth_png(home / "disp_occ/a.png", torch.full((H, W), 21.0))


def _wide_baseline(home: Path) -> None:
    put(home / "calib.txt", "focal_px: 700\ncx: 10\ncy: 6\nbaseline_m: 54\n")


@pytest.mark.parametrize(
    ("spoil", "kind", "message"),
    [
        (_lone_right, "missing", "has no left view"),
        (_far_depth, "mismatch", "holds 250 m, beyond 200 m"),
        (_wide_disparity, "mismatch", "holds 21 px, beyond 20 px"),
        (_wide_baseline, "unreadable", "baseline_m is 54, which looks like millimetres"),
    ],
)
def test_the_check_names_what_is_implausible(
    spoil: Callable[[Path], None], kind: str, message: str, pairs: Path
) -> None:
    assert check_dataset(pairs).is_ok
    spoil(pairs)
    problem = check_dataset(pairs).problems[0]
    assert problem.kind == kind
    assert message in problem.message


def test_scans_without_calibration_are_a_problem(raw: Path) -> None:
    (raw / "2011_09_26/calib_cam_to_cam.txt").unlink()
    assert check_dataset(raw).is_ok
    (raw / DRIVE / "velodyne_points/data").mkdir(parents=True)
    np.ones((2, 4), np.float32).tofile(raw / DRIVE / "velodyne_points/data/0000000007.bin")
    assert "its scan cannot be projected" in check_dataset(raw).problems[0].message


def test_png_beside_jpeg_is_noted(pairs: Path) -> None:
    (pairs / "right/b.png").unlink()
    picture(pairs / "right/b.jpg")
    report = check_dataset(pairs)
    assert report.is_ok
    notes = [note.message for note in report.notices]
    assert notes[0] == "mixes PNG and JPEG images"
    assert all("cannot tell whether the pair is rectified" in note for note in notes[1:])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("P2: 1e-300 0 0 1e300 0 1 0 0 0 0 1 0\nP3: 1e-300 0 0 -1e300 0 1 0 0 0 0 1 0", "baseline"),
        (TEXT + "Tr_velo_to_cam:" + " 1e308" * 12, "multiply to infinity"),
    ],
)
def test_numbers_that_overflow_are_refused_without_a_warning(
    text: str, message: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=message):
        read_object_calibration(put(tmp_path / "c.txt", text), W, H)


def test_a_scan_beyond_float32_draws_nothing_wrong(tmp_path: Path) -> None:
    picture(tmp_path / "image_2/0.png")
    put(tmp_path / "calib/0.txt", TEXT + LIDAR.replace("1", "1e200"))
    (tmp_path / "velodyne").mkdir()
    np.array([[10, 0, 0, 0]], np.float32).tofile(tmp_path / "velodyne/0.bin")
    assert read_lidar_depth(open_dataset(tmp_path).frames[0], "camera_z").shape == (H, W)


@pytest.mark.parametrize(
    "line",
    [
        f"{DRIVE}/image_02/data/0000000007.png {DRIVE}/image_03/data/0000000008.png",
        f"{DRIVE}/image_02/data/0000000007.png {DRIVE[:-9]}0009_sync/image_03/data/0000000007.png",
        f"{DRIVE} \N{ARABIC-INDIC DIGIT THREE} l",
    ],
)
def test_a_line_of_two_frames_or_of_none_is_refused(line: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="line 1 is"):
        read_split(put(tmp_path / "s.txt", line))


def test_a_split_name_too_long_for_the_disk_is_refused() -> None:
    with pytest.raises(InputError, match="no such file"):
        read_split("a" * 5000)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda d: d, ""),
        (lambda d: 2 * d, "0.5 times its disparities it agrees with"),
        (lambda d: d / 16, "16 times its disparities it agrees with"),
        (lambda d: d.flip(0), "upside down it agrees with"),
        (lambda d: torch.full_like(d, 30.0), "matches between left and right: is it of this pair"),
    ],
    ids=["true", "twice", "sixteenth", "turned", "constant"],
)
def test_truth_that_the_pair_contradicts_is_named(
    tmp_path: Path, change: Callable[[torch.Tensor], torch.Tensor], said: str
) -> None:
    street = make_street(0.4)
    assert street.input.right is not None
    assert street.truth.disparity_px is not None
    write_image(tmp_path / "left/a.png", street.input.left)
    write_image(tmp_path / "right/a.png", street.input.right)
    write_depth_png(tmp_path / "disp_occ/a.png", change(street.truth.disparity_px))
    problems = [p.message for p in check_dataset(tmp_path).problems if p.kind == "mismatch"]
    assert len(problems) == bool(said)
    assert said in " ".join(problems)
