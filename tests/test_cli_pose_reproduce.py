"""Tables and figures of chapter 3 as commands, on synthetic frames in both layouts."""

import json
from pathlib import Path

import pytest
from tests.pose.synthetic_frames import frame_models, make_dataset, moved, predictions_of
from tests.pose.synthetic_linemod import linemod_models, make_linemod
from tests.pose.synthetic_objects import FACTS, tiny_weights

from depthpose.cli import main
from depthpose.core.files import read_image
from depthpose.pose.datasets import BopDataset
from depthpose.pose.predictions import write_bop_results
from depthpose.pose.weights import write_pose_weights


@pytest.fixture(scope="module")
def linemod(tmp_path_factory: pytest.TempPathFactory) -> BopDataset:
    return make_linemod(tmp_path_factory.mktemp("lm") / "Linemod_preprocessed")


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Untrained, of the objects of that folder."""
    path = tmp_path_factory.mktemp("weights") / "tiny.safetensors"
    write_pose_weights(path, tiny_weights(*linemod_models()))
    return path


def rows_of(out: Path, name: str = "rows") -> list[dict[str, object]]:
    return json.loads((out / f"{name}.json").read_text())


@pytest.mark.slow
def test_table_3_2_walks_over_the_layout_of_the_thesis(
    linemod: BopDataset, weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    theirs = tmp_path / "oracle_lm-test.csv"
    good = predictions_of(
        linemod, lambda i: moved(i, [0.0] * 5 + [0.004 if i.object_id == 7 else 0.3])
    )
    write_bop_results(theirs, good)
    out = tmp_path / "out"
    words = ["--linemod", str(linemod.folder), "--weights", str(weights), "--out", str(out)]
    words += ["--csv", str(theirs), "--masks", "truth", "predicted", "--pictures", "1"]
    assert main(["reproduce", "3.2", *words]) == 0
    rows = rows_of(out)
    ours = [row for row in rows if row["source"] == "ours"]
    assert [(row["method"], row["masks"]) for row in ours] == [
        ("tiny", "truth"), ("tiny", "predicted"), ("oracle_lm-test", ""),
    ]  # fmt: skip
    # Four test frames of the lists; an object that LineMOD has bears its column's name.
    assert {row["instances"] for row in ours} == {4}
    oracle = ours[2]
    assert (oracle["obj_000007"], oracle["eggbox*"], oracle["mean"]) == (100.0, 0.0, 50.0)
    assert sum(row["source"] == "published" for row in rows) == 11
    difference = next(r for r in rows if r["method"] == "oracle_lm-test - DenseFusion, iterative")
    assert difference["eggbox*"] == pytest.approx(-99.8)
    # The masks are the same here, and so is what comes of them.
    assert ours[0]["mean"] == ours[1]["mean"]
    every = rows_of(out, "all")
    metrics = {(row["object"], row["metric"]) for row in every if "metric" in row}
    assert metrics == {("obj_000007", "ADD"), ("obj_000010", "ADD-S")}
    page = (out / "report.html").read_text()
    assert "Figure 3-5: tiny_truth" in page
    assert "ADD-S where there is a star" in (out / "report.md").read_text()
    changed = [*words, "--diameters", "pvnet"]
    assert main(["reproduce", "3.2", *changed]) == 2
    assert "diameters = 'bop', but now it is 'pvnet'" in capsys.readouterr().err
    for more, said in (
        (["--masks", "truth"], "made with masks = ['truth', 'predicted'], but now it is ['truth']"),
        (["--vsd"], "made with rule.with_vsd = False, but now it is True"),
        (["--pictures", "-1"], "--pictures -1: give 0 or more, such as 4"),
    ):
        assert main(["reproduce", "3.2", *words, *more]) == 2
        assert said in capsys.readouterr().err
    write_bop_results(theirs, good[:1])
    assert main(["reproduce", "3.2", *words]) == 2
    assert "made with csv = ['oracle_lm-test.csv " in capsys.readouterr().err
    assert rows_of(out) == rows


def test_table_3_2_is_of_linemod_alone(
    weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # Its objects bear numbers of LineMOD, as those of most datasets do.
    own, plain = make_dataset(tmp_path / "own"), make_linemod(tmp_path / "plain", frame_models())
    words = ["reproduce", "3.2", "--weights", str(weights), "--out", str(tmp_path / "out")]
    for folder, name in ((own.folder, "bracket"), (plain.folder, "obj_000007")):
        assert main([*words, "--bop", str(folder)]) == 2
        said = capsys.readouterr().err
        assert f"object 7 ({name}, " in said
        assert "is none of LineMOD" in said
        assert "for other datasets take 'reproduce 3.1'" in said
    assert not (tmp_path / "out").exists()


def test_table_3_1_sets_methods_side_by_side(
    linemod: BopDataset, weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # Trainings call their weights alike.
    other = tmp_path / "other" / weights.name
    other.parent.mkdir()
    other.write_bytes(weights.read_bytes())
    words = ["--bop", str(linemod.folder), "--out", str(tmp_path / "out"), "--pictures", "0"]
    assert main(["reproduce", "3.1", *words, "--weights", str(weights), str(other)]) == 0
    ours, theirs, difference = rows_of(tmp_path / "out")
    assert (ours["method"], theirs["method"]) == (f"{weights.parent.name}-tiny", "other-tiny")
    assert difference["mean"] == 0.0
    assert main(["reproduce", "3.1", *words, "--weights", str(weights)]) == 2
    assert "give two weights or more" in capsys.readouterr().err
    assert main(["reproduce", "3.2", "--weights", str(weights), "--out", str(tmp_path)]) == 2
    assert "give --linemod FOLDER, or --bop FOLDER" in capsys.readouterr().err


def test_table_3_3_votes_on_frames_and_on_synthetic_views(
    linemod: BopDataset, weights: Path, tmp_path: Path
) -> None:
    words = ["reproduce", "3.3", "--weights", str(weights), "--points", "60"]
    real = ["--linemod", str(linemod.folder), "--out", str(tmp_path / "frames")]
    assert main([*words, *real]) == 0
    assert main([*words, "--synthetic", "2", "--out", str(tmp_path / "made")]) == 0
    for home, instances in (("frames", 4), ("made", 2)):
        rows = rows_of(tmp_path / home)
        assert len(rows) == 9
        assert {row["instances"] for row in rows} == {instances}
        ways = {(row["method"], row["hypotheses"]) for row in rows}
        assert ways >= {("RANSAC, ours", 1024), ("least squares, ours", None)}
        assert all(row["weights"] == "tiny" for row in rows)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--objects", "flange", "--split", "foo"],
         "--objects and --split: has no effect here; it chooses from a dataset"),
        (["--points", "-5"], "--points -5: give 1 or more, such as 500"),
        (["--points", "60", "60"], "--points 60 is given twice"),
        (["--points"], "--points without a value"),
        (["--synthetic", "0"], "--synthetic 0: give 1 or more, such as 40"),
        (["--synthetic", "2", "--bop", "."],
             "rendered where no dataset is given. Leave --synthetic out"),
    ],
)  # fmt: skip
def test_options_of_table_3_3_are_never_ignored(
    weights: Path, tmp_path: Path, words: list[str], message: str,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    out = tmp_path / "out"
    assert main(["reproduce", "3.3", "--weights", str(weights), "--out", str(out), *words]) == 2
    assert message in capsys.readouterr().err
    assert not out.exists()


def test_results_of_views_are_not_replaced_by_others(
    weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = tmp_path / "other.safetensors"
    write_pose_weights(other, tiny_weights(*linemod_models(), facts=FACTS | {"licence": "CC0"}))
    table = ["reproduce", "3.3", "--points", "60", "--out", str(tmp_path / "table")]
    figure = ["figure", "3-5", "--out", str(tmp_path / "figure")]
    own = ["--weights", str(weights)]
    assert main([*table, *own, "--synthetic", "1"]) == 0
    assert main([*figure, *own, "--number", "1"]) == 0
    before = (tmp_path / "table/rows.json").read_bytes()
    for words, setting in (
        ([*table, *own, "--synthetic", "2"], "synthetic = 1, but now it is 2"),
        ([*table, *own, "--synthetic", "1", "--points", "50"], "points = [60], but now it is [50]"),
        ([*table, "--weights", str(other), "--synthetic", "1"], "weights_sha256 = "),
        ([*figure, *own, "--number", "2"], "synthetic = 1, but now it is 2"),
        ([*figure, "--weights", str(other), "--number", "1"], "weights_sha256 = "),
    ):
        assert main(words) == 2
        assert f"holds results made with {setting}" in capsys.readouterr().err
    assert (tmp_path / "table/rows.json").read_bytes() == before
    assert main([*figure, *own, "--number", "1"]) == 0
    assert main(["figure", "3-5", *own, "--number", "0", "--out", str(tmp_path / "no")]) == 2
    assert "--number 0: give 1 or more" in capsys.readouterr().err


def test_figures_are_drawn_and_explained(
    linemod: BopDataset, weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for number, more, size in (
        ("3-2", ["--number", "2", "--perplexity", "10"], (400, 808)),
        ("3-4", ["--number", "2"], (480, 1456)),
        ("3-5", ["--number", "2"], (360, 728)),
    ):
        out = tmp_path / number
        words = ["--weights", str(weights), "--linemod", str(linemod.folder), "--out", str(out)]
        assert main(["figure", number, *words, *more]) == 0
        picture = read_image(out / f"figure-{number}.png")
        assert tuple(picture.shape[1:]) == size
        assert (out / "report.html").read_text().count("<figure>") == (3 if number == "3-4" else 2)
    boxes = read_image(tmp_path / "3-5" / "figure-3-5.png")
    is_green = (boxes[1] > 0.7) & (boxes[0] < 0.2)
    assert int(is_green.sum()) > 200
    words = ["--weights", str(weights), "--out", str(tmp_path / "x"), "--keypoint", "8"]
    assert main(["figure", "3-4", "--number", "1", *words]) == 2
    assert "--keypoint 8: there are 8, from 0 on" in capsys.readouterr().err
