import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from tests.pose.synthetic_frames import (
    K,
    frame_models,
    make_dataset,
    moved,
    pose_in_frame,
    predictions_of,
)

from depthpose.core.errors import InputError
from depthpose.core.rigid import Rigid, geodesic_rad, perturb
from depthpose.pose.config import EvaluationConfig
from depthpose.pose.datasets import BopDataset, BopTarget
from depthpose.pose.evaluate import (
    InstanceRow,
    ObjectRow,
    Origin,
    RiskRow,
    errors,
    evaluate,
    find_nearest_copy,
    hash_frames,
    prepare_errors,
    read_any_predictions,
    select_targets,
)
from depthpose.pose.mesh import symmetry_transforms, turn_about
from depthpose.pose.metrics import add_m, adds_m, mspd_px
from depthpose.pose.predictions import Place, write_bop_results, write_predictions
from depthpose.pose.types import Axis, Symmetries


def columns(rows: Sequence[ObjectRow | InstanceRow | RiskRow]) -> list[dict[str, Any]]:
    return [row.columns() for row in rows]


@pytest.fixture(scope="module")
def synthetic(tmp_path_factory: pytest.TempPathFactory) -> BopDataset:
    return make_dataset(tmp_path_factory.mktemp("made"))


def test_the_truth_itself_is_perfect(synthetic: BopDataset) -> None:
    result = evaluate(synthetic, predictions_of(synthetic, lambda i: i.camera_from_model))
    assert [row.object for row in result.rows] == ["bracket", "bottle", "mean", "all"]
    for row in columns(result.rows):
        for name in ("success", "coverage", "auc", "ar", "ar_vsd", "ar_mssd", "ar_mspd"):
            assert row[name] == pytest.approx(1.0), (row["object"], name)
        assert row["refused"] == row["wrong"] == 0.0
        assert row["rotation_deg_median"] == pytest.approx(0.0, abs=1e-5)
        assert row["ms_network"] == pytest.approx(20.0)
        assert row["ms_total"] == pytest.approx(25.0)
        assert "ms_icp" not in row
        assert row["frames_sha256"] == hash_frames(synthetic.instances)[:12]
    assert [row.metric for row in result.rows[:2]] == ["ADD", "ADD-S"]
    assert columns(result.rows)[2]["instances"] == columns(result.rows)[3]["instances"] == 6


def test_the_time_of_a_search_is_divided_among_its_estimates(synthetic: BopDataset) -> None:
    predictions = [
        replace(
            prediction,
            estimate=replace(prediction.estimate, seconds={"icp": 0.5, "search": 3.0}),
        )
        for prediction in predictions_of(synthetic, lambda i: i.camera_from_model)
    ]
    rows = columns(evaluate(synthetic, predictions).per_instance)
    images = len({(i.scene_id, i.image_id) for i in synthetic.instances})
    assert sum(row["ms_total"] for row in rows) == pytest.approx(3000 * images)
    assert {row["ms_icp"] for row in rows} == {500.0}, "an estimate's own stages are shown"


def test_a_turn_about_the_axis_of_a_bottle_is_no_error(synthetic: BopDataset) -> None:
    turn = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]).double()
    quarter = Rigid(turn, torch.zeros(3).double())
    result = evaluate(synthetic, predictions_of(synthetic, lambda i: i.camera_from_model @ quarter))
    bracket, bottle = columns(result.rows[:2])
    assert bracket["wrong"] == 1.0
    assert bracket["rotation_deg_median"] == pytest.approx(90.0)
    assert bottle["success"] == 1.0
    # BOP turns about an axis in steps: half a step is left.
    assert bottle["rotation_deg_median"] < math.degrees(0.01)
    assert bottle["ar"] > 0.99


def test_errors_are_those_of_the_definitions(synthetic: BopDataset) -> None:
    def off(instance):  # noqa: ANN001, ANN202
        return moved(instance, [0.0, 0.0, 0.0, 0.0, 0.0, 0.012])

    result = evaluate(synthetic, predictions_of(synthetic, off))
    for row, instance in zip(columns(result.per_instance), synthetic.instances, strict=True):
        points = synthetic.objects[instance.object_id].vertices_m
        error = add_m if row["metric"] == "ADD" else adds_m
        exact = float(error(off(instance), instance.camera_from_model, points))
        assert row["error_m"] == pytest.approx(exact)
        assert row["mssd_m"] == pytest.approx(0.012, rel=1e-3)
        assert row["translation_m"] == pytest.approx(0.012)
        if row["metric"] == "ADD":
            # As in an image 640 wide: four times these pixels.
            eye = symmetry_transforms(Symmetries())
            pixels = mspd_px(off(instance), instance.camera_from_model, points, eye, K)
            assert row["mspd_px"] == pytest.approx(4 * float(pixels))
        # 12 mm are beyond the first tau (0.05 d) of a bottle of 18 cm, within all others.
        assert 0 < row["vsd"] < 0.4
    # Moved away by 12 mm: AUC is what is left of 10 cm.
    assert columns(result.rows)[0]["auc"] == pytest.approx(1 - 0.12)


def test_a_missing_or_refused_estimate_stays_in_every_denominator(synthetic: BopDataset) -> None:
    first, second = synthetic.instances[0].name, synthetic.instances[2].name
    every = predictions_of(synthetic, lambda i: None if i.name == second else i.camera_from_model)
    result = evaluate(synthetic, [p for p in every if p.estimate.name != first])
    bracket, bottle, mean, pooled = columns(result.rows)
    for name in ("success", "coverage", "auc", "ar", "ar_vsd", "ar_mssd", "ar_mspd"):
        assert bracket[name] == pytest.approx(1 / 3), name
        assert bottle[name] == pytest.approx(1.0), name
        assert mean[name] == pooled[name] == pytest.approx(2 / 3), name
    assert bracket["refused"] == pytest.approx(2 / 3)
    assert bracket["wrong"] == 0.0
    statuses = [row.status for row in result.per_instance]
    assert statuses == ["missing", "ok", "votes do not meet", "ok", "ok", "ok"]
    assert result.per_instance[0].error("error_m") is None
    assert result.per_instance[2].reason == "the directions are parallel"


def test_without_vsd_no_depth_is_decoded(
    synthetic: BopDataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    answers = predictions_of(synthetic, lambda i: i.camera_from_model)
    monkeypatch.setattr(errors, "read_depth_png", None)
    result = evaluate(synthetic, answers, EvaluationConfig(with_vsd=False))
    assert columns(result.rows)[0]["ar_mspd"] == pytest.approx(1.0)


def test_a_wrong_answer_is_no_refusal(synthetic: BopDataset) -> None:
    far = [0.0, 0.0, 0.0, 0.0, 0.0, 0.5]
    first = synthetic.instances[0].name
    every = predictions_of(
        synthetic, lambda i: moved(i, far) if i.name == first else i.camera_from_model
    )
    every[0] = replace(every[0], estimate=replace(every[0].estimate, inlier_share=0.1))
    result = evaluate(synthetic, every)
    assert columns(result.rows)[0]["wrong"] == pytest.approx(1 / 3)
    assert columns(result.rows)[0]["refused"] == 0.0
    # The wrong one is the least sure: who asks for less gets no wrong answer.
    assert [row.risk for row in result.risk][-1] == pytest.approx(1 / 6)
    assert [row.risk for row in result.risk][:-1] == [0.0] * (len(result.risk) - 1)
    assert result.risk[-1].coverage == 1.0


def test_behind_the_camera_is_measured_too(synthetic: BopDataset) -> None:
    back = [0.0, 0.0, 0.0, 0.0, 0.0, -1.5]
    result = evaluate(synthetic, predictions_of(synthetic, lambda i: moved(i, back)))
    assert columns(result.rows)[-1]["ar"] == 0.0
    assert result.per_instance[0].error("mspd_px") is None
    assert result.per_instance[0].error("vsd") == 1.0


def test_files_are_measured_alike(synthetic: BopDataset, tmp_path: Path) -> None:
    every = predictions_of(synthetic, lambda i: moved(i, [0.1, 0.0, 0.0, 0.0, 0.0, 0.01]))
    write_predictions(tmp_path, every)
    write_bop_results(tmp_path / "ours_made-test.csv", every)
    ours = columns(evaluate(synthetic, read_any_predictions(tmp_path)).rows)
    csv = columns(evaluate(synthetic, read_any_predictions(tmp_path / "ours_made-test.csv")).rows)
    for one, other in zip(ours, csv, strict=True):
        for name in ("success", "auc", "ar", "rotation_deg_median", "ms_total"):
            assert one[name] == pytest.approx(other[name]), name
    assert "ms_network" not in csv[0]


def test_several_of_an_object_are_set_against_their_nearest(synthetic: BopDataset) -> None:
    # Both objects of each image are taken for brackets, and their estimates have no names.
    two = replace(synthetic, instances=[replace(i, object_id=7) for i in synthetic.instances[:2]])
    answers = predictions_of(two, lambda i: moved(i, [0.0] * 5 + [0.001]))
    stray = predictions_of(two, lambda i: moved(i, [0.0] * 5 + [0.4]))[0]
    stray = replace(stray, estimate=replace(stray.estimate, inlier_share=0.2))
    nameless = [
        replace(p, estimate=replace(p.estimate, name=f"row {k}"))
        for k, p in enumerate([stray, *reversed(answers)])
    ]
    row = evaluate(two, nameless).rows[0]
    assert (row.success, row.instances) == (1.0, 2)


def test_the_diameter_table_is_named_and_decides(synthetic: BopDataset) -> None:
    cat = replace(synthetic.objects[7], number=6, diameter_m=0.154546)
    pvnet = EvaluationConfig(diameters="pvnet")
    assert prepare_errors(cat, EvaluationConfig()).diameter_m == 0.154546
    assert prepare_errors(cat, pvnet).diameter_m == 0.152633
    with pytest.raises(InputError, match=r"object 7 \(bracket\) .* no object of PVNet's table"):
        evaluate(synthetic, predictions_of(synthetic, lambda i: i.camera_from_model), pvnet)


def test_symmetry_or_the_rule_decides_which_of_the_two_adds(synthetic: BopDataset) -> None:
    up, origin = torch.tensor([0.0, 0.0, 1.0]), torch.zeros(3)
    turned = Symmetries(discrete=turn_about(up, origin, torch.tensor([math.pi])))
    glue = replace(synthetic.objects[7], symmetries=turned)
    cat = replace(glue, symmetries=Symmetries())
    assert prepare_errors(glue, EvaluationConfig()).is_adds
    assert not prepare_errors(cat, EvaluationConfig()).is_adds
    assert prepare_errors(cat, EvaluationConfig(adds="all")).is_adds


def test_targets_keep_the_most_visible(synthetic: BopDataset) -> None:
    hidden = replace(synthetic.instances[1], object_id=7, visible_fraction=0.2)
    some = replace(synthetic, instances=[hidden, *synthetic.instances])
    target = BopTarget(scene_id=1, image_id=0, object_id=7, count=1)
    assert [i.name for i in select_targets(some, [target]).instances] == [
        synthetic.instances[0].name
    ]
    assert hash_frames(some.instances) != hash_frames(synthetic.instances)
    with pytest.raises(InputError, match="ask for 3 of object 7 in scene 1, image 0, but 2"):
        select_targets(some, [replace(target, count=3)])


def test_an_estimate_that_belongs_elsewhere_answers_for_none(synthetic: BopDataset) -> None:
    every = predictions_of(synthetic, lambda i: i.camera_from_model)
    elsewhere = [replace(p, place=Place(9, 9, 99)) for p in every]
    with pytest.raises(InputError, match="none of the 6 predictions is of one of its 6 instances"):
        evaluate(synthetic, elsewhere)
    result = evaluate(synthetic, [*every[:1], *elsewhere[1:]])
    assert [row.status for row in result.per_instance] == ["ok"] + ["missing"] * 5
    nowhere = [replace(p, place=None) for p in every]
    assert evaluate(synthetic, nowhere).rows[-1].success == 1.0


def test_predictions_of_another_data_set_are_refused(synthetic: BopDataset) -> None:
    unknown = [
        replace(p, estimate=replace(p.estimate, name=f"x{k}"), place=None)
        for k, p in enumerate(predictions_of(synthetic, lambda i: i.camera_from_model))
    ]
    with pytest.raises(InputError, match="none of the 6 predictions is of one of its 6 instances"):
        evaluate(synthetic, unknown)
    assert evaluate(synthetic, []).rows[0].refused == 1.0
    with pytest.raises(InputError, match=r"vsd_delta_m must be in \(0, 1\), got 15"):
        EvaluationConfig(vsd_delta_m=15.0)


def test_the_nearest_copy_of_what_turns_freely_is_the_estimate_itself() -> None:
    bracket, bottle = frame_models()
    true = pose_in_frame(0.0, 3)
    (axis,) = bottle.symmetries.continuous
    turn = perturb(
        Rigid(torch.eye(3).double(), torch.zeros(3).double()),
        torch.cat([0.5 * math.pi * axis.direction.double(), torch.zeros(3).double()]),
    )
    found = Rigid(true.R @ turn.R, true.t_m)
    free = find_nearest_copy(found, true, symmetry_transforms(bottle.symmetries))
    fixed = find_nearest_copy(found, true, symmetry_transforms(bracket.symmetries))
    assert math.degrees(float(geodesic_rad(found.R.double(), free.R.double()))) < 3
    assert torch.allclose(fixed.R, true.R)
    assert torch.allclose(fixed.t_m, true.t_m)


_SCORES = ["auc", "auc_adds", "ar_mssd", "ar_mspd", "ar_vsd", "ar", "rotation_deg_median",
           "translation_m_median", "ap", "ap_mssd", "ap_mspd"]  # fmt: skip


def test_columns_come_in_the_declared_order(synthetic: BopDataset) -> None:
    origin = Origin(method="ours", masks="truth", weights="w", weights_sha256="ab")
    exact = predictions_of(synthetic, lambda i: i.camera_from_model)
    found = evaluate(synthetic, exact, origin=origin)
    who, times = ["method", "masks"], ["ms_network", "ms_proposal", "ms_total"]
    stamp = ["diameters", "frames", "frames_sha256"]
    assert list(found.per_instance[0].columns()) == [
        *who, "instance", "object", "status", "is_success", "score", "visible_fraction", "truth",
        "diameter_m", "metric", "error_m", "adds_m", "mssd_m", "mspd_px", "rotation_deg",
        "translation_m", "vsd", *times, "reason",
    ]  # fmt: skip
    shares = ["object", "instances", "annotated", "success", "refused", "wrong", "coverage"]
    every = [*who, "weights", "weights_sha256", *shares, *_SCORES, *times]
    assert list(found.rows[0].columns()) == [*every, "metric", "diameter_m", *stamp]
    assert list(found.rows[2].columns()) == list(found.rows[3].columns()) == [*every, *stamp]
    risk = [*who, "coverage", "answers", "least_score", "risk", *stamp]
    assert list(found.risk[0].columns()) == risk


def test_turns_about_an_axis_of_revolution_are_no_error() -> None:
    """Also by angles between the steps of the symmetry, about an axis beside the origin."""
    true = pose_in_frame(0.0, 3)
    true = Rigid(true.R.double(), true.t_m.double())
    upright = Axis(
        direction=torch.tensor([0.0, 0, 1]).double(), point_m=torch.tensor([0.2, 0, 0]).double()
    )
    across = Axis(
        direction=torch.tensor([1.0, 0, 0]).double(), point_m=torch.tensor([0.2, 0, 0]).double()
    )
    bottle, ball = Symmetries(continuous=(upright,)), Symmetries(continuous=(upright, across))
    turn = turn_about(upright.direction, upright.point_m, torch.tensor(0.123).double())
    tilt = turn_about(
        torch.tensor([1.0, 2, 3]).double(), upright.point_m, torch.tensor(1.1).double()
    )
    for declared, motion in ((bottle, turn), (ball, tilt)):
        found = true @ motion
        copy = find_nearest_copy(found, true, symmetry_transforms(declared), declared)
        assert float(geodesic_rad(found.R.double(), copy.R.double())) < 1e-6
        assert torch.allclose(found.t_m, copy.t_m, atol=1e-9)
    tilted = find_nearest_copy(true @ tilt, true, symmetry_transforms(bottle), bottle)
    assert float(geodesic_rad((true @ tilt).R.double(), tilted.R.double())) > 0.5, (
        "a bottle may not be tilted"
    )


FLIP = torch.diag(torch.tensor([1.0, -1.0, -1.0])).double()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda p: Rigid(p.R, p.t_m / 1000), "were if t were 1000 times larger (is it in metres?"),
        (lambda p: Rigid(p.R, p.t_m / 10), "were if t were 10 times larger (is it in centimetres?"),
        (lambda p: Rigid(p.R, p.t_m * 1000), "were if t were 1000 times smaller (is it in mm?"),
        (lambda p: Rigid(p.R.mT, p.t_m), "were if R were transposed"),
        (lambda p: p.inverse(), "were if poses were inverted"),
        (lambda p: Rigid(p.inverse().R, p.inverse().t_m / 1000),
         "BOP's csv has millimetres) and poses were inverted"),
        (lambda p: Rigid(FLIP @ p.R.double(), FLIP @ p.t_m.double()), "OpenGL's are y up"),
        (lambda p: Rigid(p.R, p.t_m + p.t_m.new_tensor([0.1, 0, 0])), None),
        (lambda p: p, None),
    ],
)  # fmt: skip
def test_poses_by_another_convention_are_named(
    synthetic: BopDataset, change: Callable[[Rigid], Rigid], said: str | None
) -> None:
    poses = predictions_of(synthetic, lambda i: change(i.camera_from_model))
    found = evaluate(synthetic, poses, EvaluationConfig(with_vsd=False))
    if said is None:
        assert found.advice is None
        return
    assert found.rows[-1].success == 0
    assert found.advice is not None
    assert found.advice.startswith("0 of 6 answers that were tried are right, but 6 of 6 were if")
    assert said in found.advice


@pytest.mark.parametrize(
    ("step", "said"),
    [
        ((0, 1, 0), "image numbers were one smaller (are yours counted from 1?)"),
        ((0, -1, 0), "image numbers were one larger (from 0?)"),
    ],
)
def test_poses_numbered_from_another_first_are_named(
    synthetic: BopDataset, step: tuple[int, int, int], said: str
) -> None:
    poses = [
        replace(
            one,
            estimate=replace(one.estimate, name=f"row {k}"),
            place=Place(*(a + b for a, b in zip(one.place or (), step, strict=True))),
        )
        for k, one in enumerate(predictions_of(synthetic, lambda i: i.camera_from_model))
    ]
    found = evaluate(synthetic, poses, EvaluationConfig(with_vsd=False))
    assert found.advice is not None
    assert found.advice.endswith(f"right, but 6 of 6 were if {said}")


def test_a_csv_of_a_header_alone_is_refused(tmp_path: Path) -> None:
    (tmp_path / "none.csv").write_text("scene_id,im_id,obj_id,score,R,t,time\n")
    with pytest.raises(InputError, match=r"none\.csv: holds no pose, so there is nothing to meas"):
        read_any_predictions(tmp_path / "none.csv")
