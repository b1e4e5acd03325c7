"""Whole commands on a synthetic street: tables, figures, baselines, processes."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from tests.pages.read_page import read_page
from tests.synthetic_street import make_street

from depthpose.cli import main
from depthpose.cli.depth.evaluate import with_origin
from depthpose.cli.depth.methods import DepthMethod
from depthpose.cli.thesis.depth import write_figure, write_reproduced_table
from depthpose.core.camera import StereoRig, write_camera
from depthpose.core.errors import InputError
from depthpose.core.files import read_image, write_depth_png, write_image
from depthpose.depth.datasets import open_dataset
from depthpose.depth.disparity import disparity_from_depth
from depthpose.depth.evaluate import Evaluation, EvaluationRow
from depthpose.depth.types import DepthEstimate, DepthInput
from depthpose.thesis.depth import TABLES

CAMERA_Z = ("--protocol", "eigen-raw-camera")


class FlatMono:
    """Sees the left view and says one depth everywhere; with the real right view, another."""

    def __init__(self, depth_m: float) -> None:
        self.depth_m = depth_m
        self.seen: list[str] = []

    def estimate_input(self, pair: DepthInput) -> DepthEstimate:
        assert isinstance(pair.camera, StereoRig)
        is_mono = pair.right is None
        self.seen.append("left" if is_mono else "both")
        depth_m = torch.full(pair.left.shape[1:], self.depth_m if is_mono else 2 * self.depth_m)
        disparity_px = disparity_from_depth(depth_m, pair.camera)
        right = pair.left if is_mono else None
        return DepthEstimate(input=pair, depth_m=depth_m, disparity_px=disparity_px, right=right)


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four pairs of the synthetic street with depth, 497 x 150."""
    folder = tmp_path_factory.mktemp("street")
    sample = make_street(0.4)
    assert sample.input.right is not None
    assert sample.input.camera is not None
    assert sample.truth.depth_m is not None
    for k, name in enumerate("abcd"):
        light = 1 - 0.1 * k
        write_image(folder / "left" / f"{name}.png", light * sample.input.left)
        write_image(folder / "right" / f"{name}.png", light * sample.input.right)
        write_depth_png(folder / "lidar_depth" / f"{name}.png", sample.truth.depth_m)
    write_camera(folder / "camera.json", sample.input.camera)
    return folder


@pytest.fixture(scope="module")
def trained(street: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same pairs in another folder, for baselines."""
    return shutil.copytree(street, tmp_path_factory.mktemp("trained") / "pairs")


def rows_of(folder: Path) -> list[dict[str, object]]:
    return json.loads((folder / "rows.json").read_text())


def reproduce(table: str, street: Path, out: Path, *more: str) -> int:
    given = ["reproduce", table, "--kitti", str(street), "--split", "all", "--out", str(out)]
    return main([*given, *CAMERA_Z, *more])


def write_table(
    number: str, street: Path, methods: list[tuple[str, DepthMethod]], out: Path
) -> int:
    caps_m, pictures = (80.0, 50.0), 1
    data = open_dataset(street)
    return write_reproduced_table(
        TABLES[number], data, methods, out, "eigen-raw-camera", caps_m, pictures
    )


def mono(name: str, depth_m: float) -> DepthMethod:
    settings = {"matcher": "fakestereo", "weights": name, "weights_sha256": name * 8}
    return DepthMethod(name, FlatMono(depth_m), settings, with_right=False)


@pytest.mark.slow
def test_table_2_2_is_made_by_one_command(
    street: Path, trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    more = ("--matcher", "sgbm", "--train", str(trained), "--train-without", "a")
    assert reproduce("2.2", street, tmp_path, *more) == 0
    printed = capsys.readouterr().out
    assert "| published | Luo et al. [73] |  | 80 | 0.0620 |" in printed
    rows = rows_of(tmp_path)
    sources = [row["source"] for row in rows if row["cap_m"] == 80]
    assert sources == ["published", "published", "ours", "difference", "ours", "ours"]
    sgbm, difference = rows[2], rows[3]
    assert difference["abs_rel"] == pytest.approx(float(str(sgbm["abs_rel"])) - 0.076)
    assert difference["protocol"] == "eigen-raw-camera against eigen-raw"
    for name in ("table.md", "rows.csv", "frames.json", "confidence.json", "run.json"):
        assert (tmp_path / name).is_file()
    page, markdown = ((tmp_path / f"report.{end}").read_text() for end in ("html", "md"))
    for text in (page, markdown):
        assert "baseline: nearest" in text
        assert "num_disparities" in text
        assert "torch" in text
    assert "real right image" in page
    assert "## Settings" in markdown


def test_rows_of_confidence_name_the_speed() -> None:
    row = EvaluationRow(
        protocol="p",
        dataset="d",
        cap_m=80.0,
        frames=1,
        confidence_decile=1,
        metrics={"abs_rel": 0.1},
    )
    given = Evaluation(rows=[], per_frame=[], deciles=[row], skipped={})
    settings = {"matcher": "light", "weights": "default", "weights_sha256": 64 * "0"}
    found = [
        with_origin(given, speed, settings | {"speed": speed}).deciles[0]
        for speed in ("quick", "fine")
    ]
    assert [row.columns()["speed"] for row in found] == ["quick", "fine"]


def test_a_baseline_is_a_row_of_its_own(street: Path, trained: Path, tmp_path: Path) -> None:
    words = ["depth", "evaluate", "--data", str(street), "--out", str(tmp_path), *CAMERA_Z]
    assert main([*words, "--baseline", "rows", "--train", str(trained)]) == 0
    assert {row["method"] for row in rows_of(tmp_path)} == {"baseline: rows"}


@pytest.mark.parametrize(
    "words",
    [
        ("depth", "evaluate", "--baseline", "rows", "--data"),
        ("reproduce", "2.2", "--matcher", "sgbm", "--split", "all", "--kitti"),
    ],
)
def test_a_baseline_is_not_measured_on_the_frames_that_it_is_fitted_to(
    words: tuple[str, ...],
    street: Path,
    trained: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    train = ["--train", str(trained), f"{street}/../{street.name}", "--train-without", "a"]
    assert main([*words, str(street), *CAMERA_Z, *train, "--out", str(tmp_path / "out")]) == 2
    said = "3 of the frames to measure are trained on too, b first, so their error would be too"
    assert said in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_baselines_know_the_street_they_were_fitted_to(
    street: Path, trained: Path, tmp_path: Path
) -> None:
    words = ["depth", "evaluate", "--data", str(street), "--out", str(tmp_path), *CAMERA_Z]
    assert main([*words, "--baseline", "rows", "nearest", "--train", str(trained)]) == 0
    by_method = {row["method"]: row for row in rows_of(tmp_path) if row["cap_m"] == 80}
    assert set(by_method) == {"baseline: rows", "baseline: nearest"}
    nearest, rows = (
        float(str(by_method[f"baseline: {n}"]["abs_rel"])) for n in ("nearest", "rows")
    )
    assert nearest < 0.01 < rows < 0.5
    assert "ause" not in by_method["baseline: rows"]
    page = read_page(tmp_path / "report.html")
    measured = json.loads((tmp_path / "frames.json").read_text())
    for method in by_method:
        own = [r["abs_rel"] for r in measured if (r["method"], r["cap_m"]) == (method, 80)]
        for role, error in (("worst", max(own)), ("best", min(own))):
            said = f"The {role} of 4 frames by abs_rel: {error:.4f}, truth up to 80 m."
            assert said in page.texts["p"]
            assert f"{error:.4f}" in page.texts["td"]
    assert len(page.scenes) == 6
    assert all(page.layers(k) == ["points", "true points"] for k in range(len(page.scenes)))


def test_table_2_3_sets_each_weights_beside_its_row(street: Path, tmp_path: Path) -> None:
    methods = (mono("apart", 20.0), mono("tuned", 10.0))
    chosen = list(zip(TABLES["2.3"].thesis_rows, methods, strict=True))
    assert write_table("2.3", street, chosen, tmp_path) == 0
    rows = [row for row in rows_of(tmp_path) if row["cap_m"] == 80]
    names = [(row["source"], row["method"], row["weights"]) for row in rows]
    assert names == [
        ("published", "without fine-tuning", ""),
        ("published", "fine-tune cGANs", ""),
        ("ours", "fakestereo", "apart"),
        ("difference", "fakestereo - without fine-tuning", "apart"),
        ("ours", "fakestereo", "tuned"),
        ("difference", "fakestereo - fine-tune cGANs", "tuned"),
    ]
    page = (tmp_path / "report.html").read_text()
    assert "Figure 2-1: apart" in page
    assert "predicted right image" in page
    assert "(e) depth from left and real right" in page


def test_a_method_of_one_image_is_never_shown_the_right_view(street: Path, tmp_path: Path) -> None:
    method = mono("w", 15.0)
    write_table("2.1", street, [("thesis, Ours", method)], tmp_path)
    assert isinstance(method.estimator, FlatMono)
    assert method.estimator.seen == ["left"] * 4 + [
        "both"
    ]  # the last one is figure 2-1's upper bound


def test_a_rerun_measures_the_same_files_and_refuses_other_settings(
    street: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert reproduce("2.2", street, tmp_path, "--matcher", "sgbm", "--cap", "80") == 0
    before = (tmp_path / "rows.json").read_bytes()
    written = (tmp_path / "predictions/sgbm-filled/a.disparity_px.npy").stat().st_mtime_ns
    assert reproduce("2.2", street, tmp_path, "--matcher", "sgbm", "--cap", "80") == 0
    assert (tmp_path / "rows.json").read_bytes() == before
    again = (tmp_path / "predictions/sgbm-filled/a.disparity_px.npy").stat().st_mtime_ns
    assert again == written
    assert reproduce("2.2", street, tmp_path, "--matcher", "sgbm", "--cap", "50") == 2
    assert "made with caps_m = [80.0], but now it is [50.0]" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["2.1", "--matcher", "sgbm"], "table 2.1 is of one image; table 2.2 takes it"),
        (["2.2"], "nothing to measure; give --weights FILE or --matcher sgbm"),
        (
            ["2.3", "--weights", "default"],
            "but 1 weights were given; give one for each, in this order",
        ),
        (["2.1", "--weights", "nope"], "neither a file nor the name of weights"),
        (["2.2", "--matcher", "sgbm", "--protocol", "kitti-2015"], "the tables hold depth"),
        (["2.2", "--matcher", "sgbm", "--cap", "80", "80"], "--cap 80 is given twice"),
        (["2.2", "--matcher", "sgbm", "--cap", "0"], "--cap 0: a distance in metres, above 0"),
        (["2.2", "--matcher", "sgbm", "--cap", "nan"], "--cap nan: a distance in metres"),
        (["2.2", "--matcher", "sgbm", "--cap"], "--cap without a value"),
        (
            ["2.2", "--matcher", "sgbm", "--beside", "kitti-nc"],
            "--beside kitti-nc: adds methods of one image, and table 2.2 is of pairs",
        ),
        (
            ["2.2", "--matcher", "sgbm", "--train-without", "a"],
            "--train-without: has no effect here; it leaves frames",
        ),
        (["2.2", "--matcher", "sgbm", "--device", "cuda"], "no network is measured"),
        (["2.2", "--matcher", "sgbm", "--pictures", "-1"], "--pictures -1: give 0 or more"),
    ],
)
def test_an_order_that_cannot_be_filled_is_refused_before_work(
    street: Path, tmp_path: Path, words: list[str], message: str,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    rest = ["--kitti", str(street), "--split", "all", "--out", str(tmp_path / "o")]
    assert main(["reproduce", *words, *rest]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "o").exists()


def test_the_frames_of_the_split_must_be_there(
    street: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["reproduce", "2.2", "--kitti", str(street), "--matcher", "sgbm"]
    assert main([*words, "--out", str(tmp_path / "o")]) == 2
    assert "697 of the 697 frames of eigen-test are missing" in capsys.readouterr().err


def test_figures_are_drawn_and_explained(
    street: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data, method = open_dataset(street), mono("w", 15.0)
    assert write_figure("2-5", data, [0, 2], method, tmp_path / "five") == 0
    assert "predicted depth; predicted right image; LiDAR" in capsys.readouterr().out
    picture = read_image(tmp_path / "five/figure-2-5.png")
    assert picture.shape == (3, 5 * 187 + 5 * 8 + 18, 2 * 621 + 8)
    assert write_figure("2-1", data, [1], method, tmp_path / "one") == 0
    page = (tmp_path / "one/report.html").read_text()
    assert page.count("<figure>") == 6
    assert "(c) synthesised right image" in page


def test_a_figure_of_other_frames_or_weights_needs_another_folder(
    street: Path, tmp_path: Path
) -> None:
    data, method = open_dataset(street), mono("w", 15.0)
    assert write_figure("2-5", data, [0, 2], method, tmp_path) == 0
    assert write_figure("2-5", data, [0, 2], method, tmp_path) == 0
    with pytest.raises(InputError, match="holds results made with frames = "):
        write_figure("2-5", data, [1], method, tmp_path)
    with pytest.raises(InputError, match=r"made with method\.weights = 'w'"):
        write_figure("2-5", data, [0, 2], mono("v", 15.0), tmp_path)
    shutil.copytree(street, tmp_path / "copy")
    with pytest.raises(InputError, match="holds results made with frames_sha256 = "):
        write_figure("2-5", open_dataset(tmp_path / "copy"), [0, 2], method, tmp_path)


def test_an_unknown_frame_has_no_figure(
    street: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [
        "figure",
        "2-5",
        "--kitti",
        str(street),
        "--weights",
        "default",
        "--out",
        str(tmp_path),
    ]
    assert main([*words, "--frames", "e"]) == 2
    assert "no frame 'e'; Known: 'a', 'b', 'c', 'd'" in capsys.readouterr().err


def test_two_ranks_share_the_frames_and_the_first_measures(
    street: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    words = ["depth", "evaluate", "--data", str(street), "--matcher", "sgbm", *CAMERA_Z]
    assert main([*words, "--out", str(tmp_path / "alone")]) == 0
    capsys.readouterr()
    monkeypatch.setenv("WORLD_SIZE", "2")
    for rank in "10":
        monkeypatch.setenv("RANK", rank)
        assert main([*words, "--out", str(tmp_path / "both")]) == 0
        assert ("the page:" in capsys.readouterr().out) == (rank == "0")
    assert rows_of(tmp_path / "both") == rows_of(tmp_path / "alone")


@pytest.mark.slow
def test_two_processes_at_once_give_what_one_gives(street: Path, tmp_path: Path) -> None:
    words = ["depth", "evaluate", "--data", str(street), "--matcher", "sgbm", *CAMERA_Z]
    assert main([*words, "--out", str(tmp_path / "alone")]) == 0
    command = [sys.executable, "-m", "depthpose", *words, "--out", str(tmp_path / "both")]
    both = [
        subprocess.Popen(command, env=os.environ | {"RANK": rank, "WORLD_SIZE": "2"}, text=True,
                         stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        for rank in "01"
    ]  # fmt: skip
    said = [process.communicate(timeout=120) for process in both]
    assert [process.returncode for process in both] == [0, 0], said
    assert rows_of(tmp_path / "both") == rows_of(tmp_path / "alone")
    assert "the page:" in said[0][0]
    assert "the page:" not in said[1][0]


@pytest.mark.data
@pytest.mark.slow
def test_published_weights_make_table_2_2(real: Path, tmp_path: Path) -> None:
    weights, published = tmp_path / "w.safetensors", "reference/psmnet/published_kitti2015.tar"
    imported = ["weights", "import", "psmnet", str(real / published), "--align-corners", "true"]
    assert main([*imported, "--out", str(weights)]) == 0
    for name in ("image_02", "image_03", "velodyne_points"):
        drive = Path("2011_09_26/2011_09_26_drive_9001_sync") / name
        (tmp_path / "raw" / drive.parent).mkdir(parents=True, exist_ok=True)
        (tmp_path / "raw" / drive).symlink_to(real / "depth/kitti_raw" / drive)
    for source in (real / "depth/kitti_raw/2011_09_26").glob("*.txt"):
        (tmp_path / "raw/2011_09_26" / source.name).symlink_to(source)
    words = ["reproduce", "2.2", "--kitti", str(tmp_path / "raw"), "--split", "all", "--cap", "80"]
    assert main([*words, "--weights", str(weights), "--out", str(tmp_path / "o")]) == 0
    ours = next(row for row in rows_of(tmp_path / "o") if row["source"] == "ours")
    assert ours["protocol"] == "eigen-raw"
    assert float(str(ours["abs_rel"])) < 0.1
    assert float(str(ours["ause_share"])) < 1
