"""Masks by their words: files of detections, and weights of a segmentation."""

import json
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tests.pose.synthetic_frames import HEIGHT, WIDTH, make_dataset

from depthpose import GeoPoseNet
from depthpose.cli import main
from depthpose.core.files import write_image
from depthpose.pose.datasets import (
    BopDataset,
    Detection,
    encode_rle,
    read_detections,
    read_mask,
    write_detections,
)
from depthpose.pose.networks.fcn import FCN, SegmentationConfig, normalise_colors
from depthpose.pose.predictions import read_predictions
from depthpose.pose.search import nothing_found
from depthpose.pose.segmentation import SegmentationWeights, write_segmentation
from depthpose.pose.types import PoseEstimate, ViewInput

LEFT = torch.arange(WIDTH).expand(HEIGHT, WIDTH) < WIDTH // 2
PICTURE = torch.stack([LEFT, ~LEFT, LEFT & False]).float()
"""Red on the left, where object 7 is, green on the right, where object 10 is."""


@pytest.fixture(scope="module")
def synthetic(tmp_path_factory: pytest.TempPathFactory) -> BopDataset:
    data = make_dataset(tmp_path_factory.mktemp("cli") / "made", frames=2)
    for instance in data.instances:
        assert instance.rgb is not None
        write_image(instance.rgb, PICTURE)
    return data


def halves(
    path: Path, names: Sequence[str] = ("bracket", "bottle"), numbers: Sequence[int] = (7, 10)
) -> Path:
    """Weights that take the red half for their first object, the green one for the second."""
    torch.manual_seed(0)
    config = SegmentationConfig(stride=32, widths=(4, 4, 8, 8), long_side_px=WIDTH)
    network = FCN(2, config).eval()
    with torch.no_grad():
        features = network.encoder(normalise_colors(PICTURE)[None])[-1][0]
        red, green = features[:, :, 0].mean(1), features[:, :, -1].mean(1)
        score = network.scores[0]
        score.get_parameter("weight").copy_(
            torch.stack([red * 0, red - green, green - red])[..., None, None]
        )
        bias = (red - green) @ (red + green) / 2
        score.get_parameter("bias").copy_(torch.stack([bias * 0 - 100, -bias, bias]))
    weights = SegmentationWeights(network=network, objects=tuple(names), numbers=tuple(numbers))
    write_segmentation(path, weights)
    return path


def found_by_truth(synthetic: BopDataset, path: Path) -> Path:
    masks = [read_mask(i.mask) for i in synthetic.instances if i.mask is not None]
    write_detections(
        path,
        [
            Detection(scene_id=i.scene_id, image_id=i.image_id, object_id=i.object_id, score=0.9,
                      segmentation=encode_rle(mask), seconds=0.5)
            for i, mask in zip(synthetic.instances, masks, strict=True)
        ],
    )  # fmt: skip
    return path


def statuses(out: Path) -> dict[str, str]:
    rows = json.loads((out / "instances.json").read_text())
    return {row["instance"]: row["status"] for row in rows}


def test_predict_takes_a_file_of_detections(
    synthetic: BopDataset, weights: Path, tmp_path: Path
) -> None:
    found = found_by_truth(synthetic, tmp_path / "found.json")
    words = ["pose", "predict", "--bop", str(synthetic.folder), "--weights", str(weights)]
    assert main([*words, "--out", str(tmp_path / "truth")]) == 0
    assert main([*words, "--out", str(tmp_path / "out"), "--masks", str(found)]) == 0
    by_truth, by_file = (read_predictions(tmp_path / name) for name in ("truth", "out"))
    assert len(by_file) == len(synthetic.instances)
    for one, other in zip(by_truth, by_file, strict=True):
        # The same pixels, the same pose or refusal; the time of the segmentation is counted.
        assert (one.place, one.estimate.status) == (other.place, other.estimate.status)
        assert one.estimate.inlier_share == other.estimate.inlier_share
        assert other.estimate.seconds["segmentation"] == 0.25


def test_predict_segments_by_weights_once(
    synthetic: BopDataset, weights: Path, tmp_path: Path
) -> None:
    masks, out = halves(tmp_path / "halves.safetensors"), tmp_path / "out"
    words = ["pose", "predict", "--bop", str(synthetic.folder), "--weights", str(weights)]
    words += ["--masks", str(masks), "--out", str(out)]
    assert main(words) == 0
    found = read_detections(out / "detections" / "halves.json")
    assert sorted((d.image_id, d.object_id) for d in found) == [(0, 7), (0, 10), (1, 7), (1, 10)]
    for one in found:
        half = LEFT if one.object_id == 7 else ~LEFT
        assert float((one.mask(HEIGHT, WIDTH) == half).float().mean()) > 0.75
    places = {p.place for p in read_predictions(out)}
    assert len(places) == 4
    assert all(p.estimate.seconds["segmentation"] > 0 for p in read_predictions(out))
    before = (out / "detections" / "halves.json").stat().st_mtime_ns
    assert main(words) == 0
    assert before == (out / "detections" / "halves.json").stat().st_mtime_ns


def evaluation(data: BopDataset, weights: Path) -> list[str]:
    given = ["--bop", str(data.folder), "--weights", str(weights), "--no-vsd"]
    return ["pose", "evaluate", *given]


def test_objects_asked_for_later_are_found_too(
    synthetic: BopDataset, weights: Path, tmp_path: Path
) -> None:
    masks, out = halves(tmp_path / "halves.safetensors"), tmp_path / "out"
    words = evaluation(synthetic, weights)
    words += ["--masks", str(masks), "--out", str(out)]
    assert main([*words, "--objects", "7"]) == 0
    assert len(statuses(out)) == 2
    assert main([*words, "--objects", "7", "10"]) == 0
    assert len(statuses(out)) == 4
    assert "missing" not in statuses(out).values()
    targets = tmp_path / "targets.json"
    row = {"scene_id": 1, "im_id": 1, "obj_id": 10, "inst_count": 1}
    targets.write_text(json.dumps([row]))
    other = [*words[:-1], str(tmp_path / "other")]
    assert main([*other, "--targets", str(targets)]) == 0
    assert main(other) == 0
    assert "missing" not in statuses(tmp_path / "other").values()
    record = out / "detections" / "halves" / "images.json"
    record.write_text('[{"scene_id": 1}]')
    assert main(words) == 0
    assert "im_id" in record.read_text(), "a damaged list is made again"


def test_objects_are_matched_by_name_else_by_number(
    synthetic: BopDataset, weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [
        "pose",
        "predict",
        "--bop",
        str(synthetic.folder),
        "--weights",
        str(weights),
        "--masks",
    ]
    for names, numbers, objects in (
        (("obj_000007", "obj_000010"), (7, 10), {7, 10}),
        (("bracket", "bottle"), (1, 2), {7, 10}),
        # The name tells more than the number.
        (("obj_000010", "bottle"), (10, 7), {10}),
    ):
        masks = halves(tmp_path / f"{names[0]}.safetensors", names, numbers)
        out = tmp_path / "-".join((*names, *map(str, numbers)))
        assert main([*words, str(masks), "--out", str(out)]) == 0
        assert {p.place.object_id for p in read_predictions(out) if p.place} == objects
    assert "segments no objects [7]; each is missing" in capsys.readouterr().err
    masks = halves(tmp_path / "strange.safetensors", ("cup", "pan"), (1, 2))
    assert main([*words, str(masks), "--out", str(tmp_path / "strange")]) == 2
    said = capsys.readouterr().err
    assert "segments cup (1), pan (2), but" in said
    assert "shows objects [7, 10]; give weights of its objects" in said


def test_masks_of_one_name_are_distinguished_by_their_folders(
    synthetic: BopDataset, weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for folder in ("x", "y"):
        (tmp_path / folder).mkdir()
        found_by_truth(synthetic, tmp_path / folder / "found.json")
    files = [str(tmp_path / folder / "found.json") for folder in ("x", "y")]
    words = evaluation(synthetic, weights)
    words += ["--out", str(tmp_path / "out"), "--masks"]
    assert main([*words, *files]) == 0
    rows = json.loads((tmp_path / "out" / "rows.json").read_text())
    assert {row["masks"] for row in rows} == {"x-found", "y-found"}
    assert main([*words, files[0], files[0]]) == 2
    assert "x/found: 2 that are given have this name" in capsys.readouterr().err


def test_a_data_set_is_searched_without_masks(
    synthetic: BopDataset, weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """6D detection: what is found is right for one object, and the other has a row that says no."""
    truths = {(i.image_id, i.object_id): i.camera_from_model for i in synthetic.instances}
    searched: list[str] = []

    def find(_: GeoPoseNet, view: ViewInput, *, objects: Sequence[str]) -> list[PoseEstimate]:
        searched.append(view.name)
        assert sorted(objects) == ["bottle", "bracket"]
        assert bool(view.mask.all())
        pose = truths[int(view.name[-6:]), 7]
        found = PoseEstimate(
            name=f"{view.name}_0", object="bracket", status="ok", camera_from_model=pose
        )
        return [found, replace(nothing_found(view, "bottle", [], 0.0), name=f"{view.name}_1")]

    monkeypatch.setattr(GeoPoseNet, "find", find)
    words = ["pose", "predict", "--bop", str(synthetic.folder), "--weights", str(weights)]
    words += ["--masks", "search", "--out", str(tmp_path / "out")]
    assert main(words) == 0
    rows = {
        p.estimate.name: (p.place, p.estimate.status) for p in read_predictions(tmp_path / "out")
    }
    assert rows == {
        f"000001_{image:06d}_{k}": ((1, image, number), status)
        for image in (0, 1)
        for k, (number, status) in enumerate(((7, "ok"), (10, "doubtful")))
    }
    assert searched == ["000001_000000", "000001_000001"]
    assert main(words) == 0
    assert len(searched) == 2, "what is there is not searched again"
    out = tmp_path / "measured"
    words = ["--bop", str(synthetic.folder), "--predictions", str(tmp_path / "out"), "--no-vsd"]
    assert main(["pose", "evaluate", *words, "--out", str(out)]) == 0
    found = {row["object"]: row["ap"] for row in json.loads((out / "rows.json").read_text())}
    assert found == {"bracket": pytest.approx(1), "bottle": 0, "mean": pytest.approx(0.5),
                     "all": None}  # fmt: skip


def test_an_unreadable_image_of_a_searched_dataset_stops_no_other(
    synthetic: BopDataset, weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each object has a row that says so; once the image is mended it is searched."""
    searched: list[str] = []

    def find(_: GeoPoseNet, view: ViewInput, *, objects: Sequence[str]) -> list[PoseEstimate]:
        searched.append(view.name)
        return [
            replace(nothing_found(view, name, [], 0.0), name=f"{view.name}_{k}")
            for k, name in enumerate(objects)
        ]

    monkeypatch.setattr(GeoPoseNet, "find", find)
    folder = tmp_path / "dataset"
    shutil.copytree(synthetic.folder, folder)
    instance = next(i for i in synthetic.instances if i.image_id == 0)
    torn = folder / instance.depth.relative_to(synthetic.folder)
    whole = torn.read_bytes()
    torn.write_bytes(whole[:100])
    words = ["pose", "predict", "--bop", str(folder), "--weights", str(weights)]
    words += ["--masks", "search", "--out", str(tmp_path / "out")]

    assert main(words) == 1
    rows = [p for p in read_predictions(tmp_path / "out") if p.estimate.status == "unreadable"]
    assert {(p.estimate.object, p.place) for p in rows} == {
        ("bracket", (1, 0, 7)),
        ("bottle", (1, 0, 10)),
    }
    assert all("depth" in p.estimate.reason for p in rows)
    assert searched == ["000001_000001"]

    torn.write_bytes(whole)
    assert main(words) == 0
    assert searched == ["000001_000001", "000001_000000"]
    statuses = [p.estimate.status for p in read_predictions(tmp_path / "out")]
    assert statuses == ["doubtful"] * 4
