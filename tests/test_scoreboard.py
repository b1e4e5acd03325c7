"""The scoreboard counts as it says: what is right, named, sure and wrong, and what was before."""

import math
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
import trimesh

from depthpose.core.rigid import Rigid, rotation_by
from depthpose.pose.mesh import make_model
from depthpose.pose.types import Alternative, Identity, ObjectModel, PoseEstimate

BENCH = Path(__file__).parents[1] / "bench"
TRUTH = Rigid(torch.eye(3), torch.tensor([0.0, 0.0, 0.5]))
HALF_TURN = Rigid(rotation_by(torch.tensor([0.0, 0.0, math.pi])), torch.zeros(3))


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """Import the scripts as they import each other."""
    monkeypatch.syspath_prepend(str(BENCH))
    sections = {name: import_module(f"score_{name}") for name in ("instances", "reports", "scenes")}
    shared = {name: import_module(name) for name in ("real", "score")}
    return SimpleNamespace(**shared, **sections)


@pytest.fixture(scope="module")
def carton() -> ObjectModel:
    """A box of 200x100x60 mm, which looks alike after half turns; no symmetry is declared."""
    mesh = trimesh.creation.box((0.2, 0.1, 0.06)).subdivide()
    vertices_m = torch.from_numpy(mesh.vertices.copy()).float()
    return make_model(vertices_m, torch.from_numpy(mesh.faces.copy()), name="carton")


def answer(pose: Rigid, *others: Rigid, **more: Any) -> PoseEstimate:  # noqa: ANN401
    """An estimate with its alternatives; ok unless another status is given."""
    alternatives = tuple(
        Alternative(camera_from_model=other, probability=0.4, difference="turned")
        for other in others
    )
    facts: dict[str, Any] = {"status": "ok", "object": "carton", **more}
    return PoseEstimate(name="", camera_from_model=pose, alternatives=alternatives, **facts)


def refusal() -> PoseEstimate:
    """No answer."""
    return PoseEstimate(name="", object="carton", status="doubtful", reason="occluded")


def test_a_half_turned_box_is_right_by_its_surface_alone_and_named_by_an_alternative(
    bench: SimpleNamespace, carton: ObjectModel
) -> None:
    turned = TRUTH @ HALF_TURN
    alone = bench.score.errors_of(answer(turned), TRUTH, carton)
    assert alone["adds"] < 0.1 < alone["add"]
    assert not alone["named"]
    assert bench.score.errors_of(answer(turned, TRUTH), TRUTH, carton)["named"]


def test_a_line_counts_sure_and_wrong_answers_and_refusals(
    bench: SimpleNamespace, carton: ObjectModel
) -> None:
    far = Rigid(TRUTH.R, TRUTH.t_m + 0.1)
    unsure = answer(far, status="ambiguous", reason="two poses fit")
    estimates = (answer(TRUTH), answer(far), unsure, refusal())
    rows = [{**bench.score.errors_of(one, TRUTH, carton), "cpu_s": 1.0} for one in estimates]
    line = bench.instances.line("cartons", rows)
    expected = {"n": 4, "right (ADD-S)": 1, "right (ADD)": 1, "right or named (ADD)": 1, "ok": 2,
                "ok, wrong (ADD-S)": 1, "refused": 1}  # fmt: skip
    assert {name: line[name] for name in expected} == expected


def test_an_answer_in_a_bin_is_an_instance_or_wrong_or_in_a_region_without_truth(
    bench: SimpleNamespace, carton: ObjectModel
) -> None:
    K = torch.tensor([[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]])
    aside = Rigid(TRUTH.R, TRUTH.t_m + torch.tensor([0.15, 0.0, 0.0]))
    ignored = torch.zeros(480, 640, dtype=torch.bool)
    other = Rigid(TRUTH.R, TRUTH.t_m - torch.tensor([0.2, 0.0, 0.0]))
    judge = bench.scenes.verdict
    assert judge(answer(TRUTH), [other, TRUTH], carton, K, ignored) == 1
    assert judge(answer(aside), [other, TRUTH], carton, K, ignored) == "wrong"
    ignored[:, 320:] = True
    assert judge(answer(aside), [other, TRUTH], carton, K, ignored) == "ignored"


def test_a_box_covers_the_mask_and_its_margin_and_ends_at_the_image(bench: SimpleNamespace) -> None:
    mask = torch.zeros(40, 50, dtype=torch.bool)
    mask[2:10, 20:30] = True
    region = bench.instances.region_of(mask, bench.instances.Region("box", 5))
    if "box" in region:
        assert region["box"] == (15, 0, 35, 15)
    else:
        assert region["mask"].nonzero().amin(0).tolist() == [0, 15]
        assert region["mask"].nonzero().amax(0).tolist() == [14, 34]


def test_a_confirmed_identity_misleads_where_the_part_is_another(bench: SimpleNamespace) -> None:
    twin = next(case for case in bench.reports.CASES if case.name == "B the twin's file")
    errors = {"named": True}
    sure = answer(TRUTH, object="B_twin_other", identity=Identity(status="confirmed"))
    unsure = answer(TRUTH, object="B_twin_other", identity=Identity(status="not excluded"))
    assert not bench.reports.is_fair(twin, sure, errors)
    assert bench.reports.is_fair(twin, unsure, errors)


def test_an_earlier_figure_stands_beside_one_that_differs(bench: SimpleNamespace) -> None:
    table = [{"set": "lm", "right": 2, "ok": 1}, {"set": "new", "right": 1, "ok": 1}]
    lines = bench.real.with_earlier(table, [{"set": "lm", "right": 1, "ok": 1}])
    assert lines == [
        {"set": "lm", "right": "2 (1)", "ok": "1"}, {"set": "new", "right": "1", "ok": "1"}
    ]  # fmt: skip
