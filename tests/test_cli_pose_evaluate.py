import csv
import json
import shutil
from pathlib import Path

import pytest
import torch
from tests.pages.read_page import read_page
from tests.pose.synthetic_frames import frame_models, make_dataset, moved, predictions_of
from tests.pose.synthetic_objects import tiny_weights

from depthpose.cli import main
from depthpose.core.checkpoint import file_sha256
from depthpose.pose.datasets import BopDataset, Detection, encode_rle, read_mask, write_detections
from depthpose.pose.evaluate import hash_frames
from depthpose.pose.predictions import read_predictions, write_bop_results, write_predictions
from depthpose.pose.weights import write_pose_weights


@pytest.fixture(scope="module")
def synthetic(tmp_path_factory: pytest.TempPathFactory) -> BopDataset:
    return make_dataset(tmp_path_factory.mktemp("cli") / "made", frames=2)


def rows_of(out: Path) -> list[dict[str, object]]:
    return json.loads((out / "rows.json").read_text())


def test_a_csv_is_measured(
    synthetic: BopDataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "theirs_made-test.csv"
    off = predictions_of(synthetic, lambda i: moved(i, [0.0] * 5 + [0.01]) if i.index else None)
    write_bop_results(file, off)
    out = tmp_path / "out"
    words = ["--bop", str(synthetic.folder), "--csv", str(file), "--out", str(out)]
    assert main(["pose", "evaluate", *words]) == 0
    bracket, bottle, mean, pooled = rows_of(out)
    assert (bracket["refused"], bracket["success"]) == (1.0, 0.0)
    assert (bottle["refused"], bottle["success"]) == (0.0, 1.0)
    assert mean["success"] == pooled["success"] == 0.5
    assert mean["method"] == "theirs_made-test"
    assert mean["weights_sha256"] == file_sha256(file)[:12]
    assert mean["frames_sha256"] == hash_frames(synthetic.instances)[:12]
    assert mean["diameters"] == "bop"
    assert "| theirs_made-test |" in (out / "table.md").read_text()
    with (out / "instances.csv").open() as lines:
        statuses = [row["status"] for row in csv.DictReader(lines)]
    assert statuses == ["missing", "ok"] * 2
    assert "Success by masks" in (out / "report.html").read_text()
    said = capsys.readouterr().out
    assert "4 instances, layout BOP; objects: bracket, bottle" in said
    heads = next(line for line in said.splitlines() if line.startswith("method")).split()
    assert heads[:5] == ["method", "object", "instances", "success", "wrong"]
    assert len(heads) <= 11
    assert len(mean) > 20, "the files hold every column"


def test_no_table_of_an_earlier_run_is_left_where_nothing_is_posed(
    synthetic: BopDataset, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    posed = tmp_path / "posed"
    refused = tmp_path / "refused"
    write_predictions(posed, predictions_of(synthetic, lambda i: moved(i, [0.0] * 6)))
    write_predictions(refused, predictions_of(synthetic, lambda _: None))
    words = ["pose", "evaluate", "--bop", str(synthetic.folder), "--out", str(out), "--predictions"]
    assert main([*words, str(posed)]) == 0
    assert len(list(out.glob("risk.*"))) == 3
    assert main([*words, str(refused)]) == 0
    assert not list(out.glob("risk.*"))


def test_the_page_shows_best_median_and_worst_beside_the_truth(
    synthetic: BopDataset, tmp_path: Path
) -> None:
    off_m = {name: 0.004 * (k + 1) for k, name in enumerate(i.name for i in synthetic.instances)}
    refused = synthetic.instances[2].name
    found = predictions_of(
        synthetic, lambda i: None if i.name == refused else moved(i, [0.0] * 5 + [off_m[i.name]])
    )
    write_predictions(tmp_path / "own", found)
    words = ["--bop", str(synthetic.folder), "--predictions", str(tmp_path / "own"), "--no-vsd"]
    assert main(["pose", "evaluate", *words, "--out", str(tmp_path / "out")]) == 0
    page = read_page(tmp_path / "out/report.html")
    shown = [text for text in page.texts["h2"] if text.startswith("own: ")]
    names = {
        instance.name: synthetic.objects[instance.object_id].name
        for instance in synthetic.instances
    }
    rows = json.loads((tmp_path / "out/instances.json").read_text())
    size = {row["instance"]: (row["error_m"] or 9.0) / row["diameter_m"] for row in rows}
    ranked = sorted((i for i in names if i != refused), key=size.__getitem__, reverse=True)
    roles = zip(("worst", "median", "best"), ranked, strict=True)
    assert shown == [
        *(f"own: {names[i]} in {i}, {role} answer of 3" for role, i in roles),
        f"own: {names[refused]} in {refused}, one of 1 refused",
    ]
    for k, name in enumerate([*ranked, refused]):
        layers = page.layers(k)
        assert {"true box", "true edges"} <= set(layers)
        assert ("posed model" in layers) == (name != refused)
    errors = [f"{row['error_m']:.4f}" for row in rows if row["error_m"] is not None]
    assert set(errors) <= set(page.texts["td"])
    reason = next(row["reason"] for row in rows if row["instance"] == refused)
    assert any(f": {reason}." in text for text in page.texts["p"])


@pytest.mark.slow
def test_weights_predict_once_with_true_and_predicted_masks(
    synthetic: BopDataset, weights: Path, tmp_path: Path
) -> None:
    # Of the second image nothing is detected; of the first both, and something of another set.
    seen = [i for i in synthetic.instances if i.image_id == 0]
    masks = [read_mask(i.mask) for i in seen if i.mask is not None]
    found = [
        Detection(scene_id=i.scene_id, image_id=i.image_id, object_id=i.object_id, score=0.9,
                  segmentation=encode_rle(mask), seconds=0.5)
        for i, mask in zip(seen, masks, strict=True)
    ]  # fmt: skip
    stray = Detection(scene_id=9, image_id=0, object_id=7, score=1.0,
                      segmentation=encode_rle(masks[0]))  # fmt: skip
    write_detections(tmp_path / "found.json", [*found, stray])
    out = tmp_path / "out"
    words = ["--bop", str(synthetic.folder), "--weights", str(weights), "--out", str(out)]
    words += ["--masks", "truth", str(tmp_path / "found.json"), "--no-vsd"]
    assert main(["pose", "evaluate", *words]) == 0
    homes = [out / "predictions" / f"tiny_{masks}" for masks in ("truth", "found")]
    assert [len(read_predictions(home)) for home in homes] == [4, 2]
    first = [p.estimate for p in read_predictions(homes[0])[:2]]
    again = [p.estimate for p in read_predictions(homes[1])]
    for one, other in zip(first, again, strict=True):
        # The same pixels, the same pose or refusal.
        assert one.status == other.status
        assert other.seconds["segmentation"] == 0.25
        if one.keypoints_m is not None:
            assert other.keypoints_m is not None
            assert torch.equal(one.keypoints_m, other.keypoints_m)
    assert (homes[0] / "depthpose_made-test.csv").is_file()
    rows = rows_of(out)
    assert [(row["masks"], row["object"]) for row in rows[::4]] == [
        ("truth", "bracket"), ("found", "bracket"),
    ]  # fmt: skip
    assert {row["weights_sha256"] for row in rows} == {file_sha256(weights)[:12]}
    assert rows[0]["ar"] is None
    before = [(home / "poses.json").stat().st_mtime_ns for home in homes]
    assert main(["pose", "evaluate", *words]) == 0
    assert before == [(home / "poses.json").stat().st_mtime_ns for home in homes]


def test_registration_without_training_is_a_word_in_place_of_weights(
    synthetic: BopDataset, tmp_path: Path
) -> None:
    words = ["--bop", str(synthetic.folder), "--weights", "register", "--objects", "7", "--no-vsd"]
    assert main(["pose", "evaluate", *words, "--out", str(tmp_path / "out")]) == 0
    assert {row["method"] for row in rows_of(tmp_path / "out")} == {"register"}


def test_what_cannot_be_measured_is_refused(
    synthetic: BopDataset, weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    here = ["--bop", str(synthetic.folder), "--out", str(tmp_path / "out")]
    few = tmp_path / "few.safetensors"
    write_pose_weights(few, tiny_weights(frame_models()[0]))
    nobody = tmp_path / "nobody.json"
    nobody.write_text("[]")
    for words, said in (
        ([], "measure --weights FILE, --csv FILE or --predictions DIR"),
        (["--weights", str(few)], "object 10 (bottle) is none of those the weights know"),
        (["--weights", str(weights), "--masks", "predicted"], "came without predicted masks"),
        (["--weights", str(weights), "--masks", str(nobody)], "none of the 0 detections is of an"),
        (
            ["--weights", str(weights), "--objects", "duck"],
            "no instance of 'duck'; objects here: 7",
        ),
    ):
        assert main(["pose", "evaluate", *here, *words]) == 2
        assert said in capsys.readouterr().err
    assert (
        main(["pose", "evaluate", *here, "--weights", str(few), "--objects", "7", "--no-vsd"]) == 0
    )


def test_weights_and_predictions_of_one_name_are_distinguished(
    synthetic: BopDataset, weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = [tmp_path / folder / "pose.safetensors" for folder in ("x", "y")]
    for file in files:
        file.parent.mkdir()
        file.write_bytes(weights.read_bytes())
    words = ["pose", "evaluate", "--bop", str(synthetic.folder), "--no-vsd", "--out"]
    out = tmp_path / "out"
    assert main([*words, str(out), "--weights", *map(str, files)]) == 0
    assert [row["method"] for row in rows_of(out)[::4]] == ["x-pose", "y-pose"]
    page = (out / "report.html").read_text()
    assert "x-pose" in page
    assert "y-pose" in page
    homes = [str(out / "predictions" / "x-pose_truth"), str(tmp_path / "z" / "x-pose_truth")]
    shutil.copytree(homes[0], homes[1])
    again = [*words, str(tmp_path / "again"), "--predictions", *homes]
    assert main(again) == 0
    methods = {str(row["method"]) for row in rows_of(tmp_path / "again")}
    assert methods == {"predictions-x-pose", "z-x-pose"}
    assert main([*again, homes[0]]) == 2
    assert "two predictions by 'x-pose', masks 'truth', are given" in capsys.readouterr().err
    twice = [*words, str(out), "--weights", str(files[0]), str(files[0])]
    assert main(twice) == 2
    assert "x/pose: 2 that are given have this name" in capsys.readouterr().err


def test_predictions_whose_record_names_another_data_set_are_refused(
    synthetic: BopDataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    home = tmp_path / "theirs"
    write_predictions(home, predictions_of(synthetic, lambda i: i.camera_from_model))
    words = [
        "pose",
        "evaluate",
        "--bop",
        str(synthetic.folder),
        "--no-vsd",
        "--predictions",
        str(home),
    ]
    words += ["--out", str(tmp_path / "out")]
    for settings, said in (
        ({"dataset": "made", "split": "train"}, "the split 'train', but 'test' is measured"),
        ({"dataset": "lm", "split": "test"}, "the dataset 'lm', but 'made' is measured; give"),
    ):
        (home / "run.json").write_text(json.dumps({"settings": settings}))
        assert main(words) == 2
        assert said in capsys.readouterr().err
    (home / "run.json").write_text(json.dumps({"settings": {"dataset": "made", "split": "test"}}))
    assert main(words) == 0
