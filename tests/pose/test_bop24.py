"""BOP's average precision of 6D detection, and the layout of its datasets of several sensors."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tests.pose.synthetic_frames import make_dataset, moved, predictions_of

from depthpose.core.errors import InputError
from depthpose.core.rigid import Rigid
from depthpose.pose.config import EvaluationConfig
from depthpose.pose.datasets import BopDataset, Instance, check_bop, open_bop, read_targets
from depthpose.pose.evaluate import evaluate, select_targets
from depthpose.pose.evaluate.detection import _is_certainly_far
from depthpose.pose.evaluate.errors import METRICS, ErrorContext
from depthpose.pose.mesh import symmetry_transforms
from depthpose.pose.metrics import average_precision
from depthpose.pose.predictions import Prediction, name_bop_results, place_of

METRIC_LIMITS = {"mssd_m": 0.5 * 0.02, "mspd_px": 50 * 160 / 640}
WITHOUT_VSD = EvaluationConfig(with_vsd=False)


@pytest.fixture(scope="module")
def synthetic(tmp_path_factory: pytest.TempPathFactory) -> BopDataset:
    return make_dataset(tmp_path_factory.mktemp("made"))


def test_average_precision_is_that_of_coco() -> None:
    assert average_precision([True] * 4, 4) == pytest.approx(1)
    assert average_precision([], 4) == 0
    assert average_precision([False, False], 4) == 0
    # What follows the last right answer costs nothing.
    assert average_precision([True, True, False, False], 2) == pytest.approx(1)
    # Half are found at full precision: recalls from 0 to 0.5 are 51 of 101.
    assert average_precision([True, True], 4) == pytest.approx(51 / 101)
    # Right at ranks 2 and 3 of 3: precisions 1/2 and 2/3 at recalls 1/2 and 1.
    assert average_precision([False, True, True], 2) == pytest.approx(2 / 3)
    # Right at ranks 1 and 4: 1 up to recall 1/2, then 2/4.
    assert average_precision([True, False, False, True], 2) == pytest.approx((51 + 50 / 2) / 101)


def scores(
    dataset: BopDataset, predictions: list[Prediction]
) -> dict[str, dict[str, float | None]]:
    rows = evaluate(dataset, predictions, WITHOUT_VSD).rows
    return {row.object: {k: row.scores[k] for k in ("ap", "ap_mssd", "ap_mspd")} for row in rows}


def scored(dataset: BopDataset, score_of: Callable[[Instance], float]) -> list[Prediction]:
    """The truth of each instance, with a score of one's own and a name of no instance."""
    predictions = predictions_of(dataset, lambda i: i.camera_from_model)
    return [
        replace(p, estimate=replace(p.estimate, name=f"found {k}", inlier_share=score_of(i)))
        for k, (p, i) in enumerate(zip(predictions, dataset.instances, strict=True))
    ]


def test_the_truth_has_full_precision(synthetic: BopDataset) -> None:
    found = scores(synthetic, predictions_of(synthetic, lambda i: i.camera_from_model))
    for row in ("bracket", "bottle", "mean"):
        assert found[row] == pytest.approx({"ap": 1, "ap_mssd": 1, "ap_mspd": 1})
    assert found["all"] == {"ap": None, "ap_mssd": None, "ap_mspd": None}


def test_wrong_answers_count_by_their_scores(synthetic: BopDataset) -> None:
    right = scored(synthetic, lambda _: 0.5)
    brackets = [i for i in synthetic.instances if i.object_id == 7]
    away = moved(brackets[0], [0, 0, 0, 0.3, 0, 0])
    for score, expected in ((0.4, 1.0), (0.9, 3 / 4)):
        estimate = replace(right[0].estimate, name="x", camera_from_model=away, inlier_share=score)
        more = Prediction(estimate=estimate, place=place_of(brackets[0]))
        found = scores(synthetic, [*right, more])
        assert found["bracket"]["ap"] == pytest.approx(expected)
        assert found["bottle"]["ap"] == pytest.approx(1)
        assert found["mean"]["ap"] == pytest.approx((expected + 1) / 2)
    # A second answer for one instance is a wrong one.
    twice = replace(right[0], estimate=replace(right[0].estimate, name="x", inlier_share=0.9))
    found = scores(synthetic, [*scored(synthetic, lambda _: 0.5), twice])
    # The surest takes it; of the three equal ones that follow the one left over is the first.
    expected = average_precision([True, False, True, True], 3)
    assert found["bracket"]["ap"] == pytest.approx(expected)


def test_precision_falls_with_the_error(synthetic: BopDataset) -> None:
    # The whole model is moved along the axis: MSSD is the shift, in twelve hundredths of its size.
    share = 0.12
    diameter_m = synthetic.objects[7].diameter_m
    found = scores(
        synthetic,
        predictions_of(synthetic, lambda i: moved(i, [0, 0, 0, 0, 0, share * diameter_m])),
    )
    assert found["bracket"]["ap_mssd"] == pytest.approx(0.8)  # from 0.15 to 0.5 it is below


def test_what_is_hardly_seen_does_not_count(synthetic: BopDataset) -> None:
    first = synthetic.instances[0]
    hidden = [replace(first, visible_fraction=0.05), *synthetic.instances[1:]]
    dataset = replace(synthetic, instances=hidden)
    predictions = scored(dataset, lambda _: 0.5)
    assert first.object_id == 7
    assert scores(dataset, predictions)["bracket"]["ap"] == pytest.approx(1)
    assert scores(dataset, predictions[1:])["bracket"]["ap"] == pytest.approx(1)
    # Of an object that is nowhere seen enough there is no precision, and the mean is the others'.
    every = [
        replace(i, visible_fraction=0.05) if i.object_id == 7 else i for i in synthetic.instances
    ]
    found = scores(replace(synthetic, instances=every), predictions)
    assert found["bracket"] == {"ap": None, "ap_mssd": None, "ap_mspd": None}
    assert found["mean"] == pytest.approx({"ap": 1, "ap_mssd": 1, "ap_mspd": 1})


def test_errors_are_skipped_only_where_they_are_beyond_the_limits(
    synthetic: BopDataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    from depthpose.pose.evaluate import detection

    shifts = torch.linspace(0, 0.4, 6).tolist()
    predictions = [
        replace(p, estimate=replace(p.estimate, name=f"{k} {p.estimate.name}", inlier_share=1 - s))
        for k, s in enumerate(shifts)
        for p in predictions_of(synthetic, lambda i, s=s: moved(i, [0, s, 0, s, 0.3 * s, 2 * s]))
    ]
    found = scores(synthetic, predictions)
    monkeypatch.setattr(detection, "_is_certainly_far", lambda *_: False)
    assert scores(synthetic, predictions) == found


def sensors(folder: Path) -> Path:
    """The files of a dataset as BOP-Industrial names them: two sensors with depth, one without."""
    make_dataset(folder, frames=2)
    scene = folder / "test" / "000001"
    names = {"depth": "depth", "rgb": "gray", "mask": "mask", "mask_visib": "mask_visib"}
    for old, new in names.items():
        (scene / old).rename(scene / f"{new}_photoneo")
    for name in ("scene_camera", "scene_gt", "scene_gt_info"):
        content = (scene / f"{name}.json").read_text()
        (scene / f"{name}.json").unlink()
        for sensor in ("photoneo", "cam1", "cam2"):
            (scene / f"{name}_{sensor}.json").write_text(content)
    (scene / "depth_cam1").mkdir()
    return folder


def test_data_sets_of_several_sensors_are_read(tmp_path: Path) -> None:
    plain = make_dataset(tmp_path / "plain", frames=2)
    folder = sensors(tmp_path / "ipd")
    with pytest.raises(
        InputError, match=r"'test' is of several sensors; .*: test_cam1, test_photo"
    ):
        open_bop(folder, "test")
    with pytest.raises(InputError, match="no split 'val' with a scene"):
        open_bop(folder, "val")
    dataset = open_bop(folder, "test_photoneo")
    assert [i.name for i in dataset.instances] == [i.name for i in plain.instances]
    first, expected = dataset.view(dataset.instances[0]), plain.view(plain.instances[0])
    assert torch.equal(first.input.mask, expected.input.mask)
    assert torch.equal(first.input.depth_m.nan_to_num(), expected.input.depth_m.nan_to_num())
    rgb = dataset.instances[0].rgb
    assert rgb is not None
    assert rgb.parent.name == "gray_photoneo"
    # BOP's toolkit knows the split by its folder.
    assert name_bop_results(dataset) == "depthpose_ipd-test.csv"
    assert check_bop(folder, "test_photoneo").problems == []


def test_a_split_whose_poses_are_kept_back_says_so(tmp_path: Path) -> None:
    folder = sensors(tmp_path / "ipd")
    (folder / "test/000001/scene_gt_photoneo.json").unlink()
    with pytest.raises(InputError, match=r"no scene_gt_photoneo.json: its poses are not annotated"):
        open_bop(folder, "test_photoneo")


def test_targets_of_detection_are_whole_images(synthetic: BopDataset, tmp_path: Path) -> None:
    rows = [{"scene_id": 1, "im_id": 2}, {"scene_id": 1, "im_id": 0}]
    (tmp_path / "test_targets_bop24.json").write_text(json.dumps(rows))
    targets = read_targets("test_targets_bop24.json", tmp_path)
    chosen = select_targets(synthetic, targets)
    assert [(i.image_id, i.object_id) for i in chosen.instances] == [
        (0, 7),
        (0, 10),
        (2, 7),
        (2, 10),
    ]
    with pytest.raises(InputError, match="nothing that the 1 targets ask for is annotated"):
        select_targets(synthetic, [replace(targets[0], scene_id=8)])


@pytest.mark.parametrize("error", ["mssd_m", "mspd_px"])
def test_a_symmetric_copy_is_not_far(synthetic: BopDataset, error: str) -> None:
    """A body of revolution of which only one side has vertices, rotated by half a turn."""
    bottle = synthetic.objects[10]
    x_m = bottle.vertices_m[:, 0]
    on_one_side = x_m > 0.6 * x_m.max()
    model = replace(
        bottle,
        vertices_m=bottle.vertices_m[on_one_side],
        normals=bottle.normals[on_one_side],
        faces=bottle.faces[:0],
        diameter_m=0.02,
    )
    context = ErrorContext(
        model=model,
        diameter_m=model.diameter_m,
        is_adds=True,
        vsd_delta_m=None,
        symmetries=symmetry_transforms(model.symmetries),
        triangles_m=torch.zeros(0, 3, 3),
    )
    instance = next(i for i in synthetic.instances if i.object_id == 10)
    magnified = replace(instance, K=instance.K * torch.tensor([[8.0], [8], [1]]))
    half_turn = Rigid(torch.diag(torch.tensor([-1.0, -1, 1])).double(), torch.zeros(3).double())
    pose = instance.camera_from_model.double() @ half_turn
    assert float(METRICS[error].measure(pose, magnified, context)) < METRIC_LIMITS[error]
    assert not _is_certainly_far(error, pose, magnified, context)
    away = Rigid(pose.R, pose.t_m + torch.tensor([0.5, 0.0, 0.0]))
    assert _is_certainly_far(error, away, magnified, context)
