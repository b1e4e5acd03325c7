import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from tests.pose.synthetic_frames import make_dataset

from depthpose.core.errors import InputError
from depthpose.core.rigid import Rigid
from depthpose.pose.datasets import (
    Detection,
    decode_rle,
    encode_rle,
    open_bop,
    read_detections,
    read_targets,
    write_detections,
)
from depthpose.pose.datasets.masks import read_mask
from depthpose.pose.predictions import Place, Prediction, read_bop_results, write_bop_results
from depthpose.pose.types import PoseEstimate


def test_masks_of_every_kind_are_read(tmp_path: Path) -> None:
    mask = np.zeros((4, 5), np.uint8)
    mask[1:3, 2:] = 255
    rgba = np.stack([mask, mask, mask, np.full_like(mask, 255)], -1)
    kinds = {"grey": mask, "rgb": np.stack([mask] * 3, -1), "rgba": rgba, "bool": mask > 0}
    kinds["grey and alpha"] = rgba[:, :, 2:]
    for name, values in kinds.items():
        Image.fromarray(values).save(tmp_path / f"{name}.png")
        assert torch.equal(read_mask(tmp_path / f"{name}.png"), torch.from_numpy(mask > 0)), name


def test_depth_may_be_tiff_as_in_itodd(tmp_path: Path) -> None:
    made = make_dataset(tmp_path / "made", frames=1)
    depth_m = made.view(made.instances[0]).input.depth_m
    file = made.instances[0].depth
    Image.open(file).save(file.with_suffix(".tif"))
    file.unlink()
    again = open_bop(made.folder, "test")
    assert again.instances[0].depth.suffix == ".tif"
    read_m = again.view(again.instances[0]).input.depth_m
    torch.testing.assert_close(read_m, depth_m, rtol=0, atol=0, equal_nan=True)


def test_results_go_out_and_come_back(tmp_path: Path) -> None:
    q, _ = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(0)).double())
    pose = Rigid(q * torch.linalg.det(q), torch.tensor([0.1, -0.2, 1 / 3], dtype=torch.float64))
    rows = [
        Prediction(estimate=PoseEstimate(name=f"row {k}", object="obj_000005", status="ok",
                                         camera_from_model=pose, inlier_share=0.5,
                                         seconds={} if i else {"image": 0.125}),
                   place=Place(1, i, 5))
        for k, i in enumerate((0, 0, 1), 1)
    ]  # fmt: skip
    path = tmp_path / "ours_lm-test.csv"
    write_bop_results(path, rows)
    lines = path.read_text().splitlines()
    assert lines[0] == "scene_id,im_id,obj_id,score,R,t,time"
    assert lines[1].split(",")[5] == "100.0 -200.0 333.3333333333333"
    assert [line.split(",")[6] for line in lines[1:]] == ["0.25", "0.25", "-1"]
    again = read_bop_results(path)
    for row, other in zip(rows, again, strict=True):
        found = other.estimate.camera_from_model
        assert found is not None
        assert torch.allclose(pose.R, found.R, atol=1e-15)
        assert torch.allclose(pose.t_m, found.t_m, atol=1e-15)
        assert row.place == other.place
        for part in ("name", "object", "inlier_share", "seconds"):
            assert getattr(row.estimate, part) == getattr(other.estimate, part)


def test_bad_results_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "r.csv"
    head = "scene_id,im_id,obj_id,score,R,t,time\n"
    eye = "1 0 0 0 1 0 0 0 1"
    for text, said in (
        ("", "the first line is not"),
        (f"{head}1,2,3\n", "line 2: 3 values, where 7 belong"),
        (f"{head}1,2,x,1,{eye},1 2 3,0\n", "invalid literal"),
        (f"{head}1,2,3,1,1 0 0,1 2 3,0\n", "3 numbers of R and 3 of t, where 9 and 3"),
        (f"{head}1,2,3,nan,{eye},1 2 3,0\n", "finite ones belong"),
        (f"{head}1,2,3,1,{eye.replace('1', '2')},1 2 3,0\n", "the rotation .* is none"),
        (f"{head}1,2,3,1,{eye},1 2 3,0\n1,2,3,1,{eye},1 2 3,1\n", "time is that of the whole im"),
    ):
        path.write_text(text)
        with pytest.raises(InputError, match=said):
            read_bop_results(path)


def test_run_lengths_are_coco_s(tmp_path: Path) -> None:
    mask = torch.zeros(4, 5, dtype=torch.bool)
    mask[1:3, 2:] = True
    assert encode_rle(mask) == ((9, 2, 2, 2, 2, 2, 1), 4, 5)
    for some in (mask, ~mask, torch.zeros(2, 3, dtype=torch.bool), torch.ones(2, 3).bool()):
        assert torch.equal(decode_rle(*encode_rle(some)), some)
    row = {"scene_id": 1, "image_id": 2, "category_id": 3, "score": 0.5, "time": 0.1}
    for counts in ([9, 2, 2, 2, 2, 2, 1], "922000O"):
        segmentation = {"size": [4, 5], "counts": counts}
        (tmp_path / "d.json").write_text(json.dumps([{**row, "segmentation": segmentation}]))
        (found,) = read_detections(tmp_path / "d.json")
        assert torch.equal(found.mask(4, 5), mask)
        assert (found.object_id, found.seconds) == (3, 0.1)


def test_written_detections_come_back(tmp_path: Path) -> None:
    mask = torch.zeros(5, 7, dtype=torch.bool)
    mask[1:3, 2:6] = True
    empty = Detection(scene_id=1, image_id=2, object_id=5, score=0.1,
                      segmentation=encode_rle(mask & False))  # fmt: skip
    given = Detection(scene_id=3, image_id=4, object_id=6, score=0.75,
                      segmentation=encode_rle(mask), seconds=0.5)  # fmt: skip
    write_detections(tmp_path / "d.json", [given, empty])
    found = read_detections(tmp_path / "d.json")
    assert [vars(d) for d in found] == [vars(given), vars(empty)]
    boxes = [row["bbox"] for row in json.loads((tmp_path / "d.json").read_text())]
    assert boxes == [[2, 1, 4, 2], [-1, -1, -1, -1]]


def test_damaged_detections_are_refused(tmp_path: Path) -> None:
    row: dict[str, object] = {"scene_id": 1, "image_id": 2, "category_id": 3, "score": 0.5}
    for entry, said in (
        (None, "neither of a box and a mask"),
        ({"size": [4], "counts": [20]}, "where .height, width. belongs"),
        ({"size": [4, 5], "counts": [19]}, "do not add up"),
        ({"size": [4, 5], "counts": "garbage"}, "do not add up"),
        ({"size": [4, 5], "counts": [-1, 21]}, "do not add up"),
    ):
        (tmp_path / "d.json").write_text(json.dumps([{**row, "segmentation": entry}]))
        with pytest.raises(InputError, match=said):
            read_detections(tmp_path / "d.json")
    (tmp_path / "d.json").write_text("{}")
    with pytest.raises(InputError, match="is no list of objects"):
        read_detections(tmp_path / "d.json")


def test_targets(tmp_path: Path) -> None:
    rows = [{"im_id": 3, "inst_count": 1, "obj_id": 5, "scene_id": 2}]
    (tmp_path / "t.json").write_text(json.dumps(rows))
    (target,) = read_targets("t.json", tmp_path)
    assert [target] == read_targets(tmp_path / "t.json")
    assert (target.scene_id, target.image_id, target.object_id, target.count) == (2, 3, 5, 1)
