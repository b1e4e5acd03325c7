"""Poses that fit as well as the best: found by the shape of the model, shared, named, counted."""

import math
import re
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from tests.pose.synthetic_objects import (
    K,
    Oracle,
    bar,
    bottle,
    boxes,
    bracket,
    cloud_of,
    generator,
    noisy,
    pose_at,
    tiny_weights,
    view_of,
)

from depthpose.core.rigid import Rigid, geodesic_rad, rotation_by
from depthpose.pose.cloud import cloud_from_depth
from depthpose.pose.config import EstimateConfig
from depthpose.pose.icp import refine_exactly
from depthpose.pose.mesh import (
    NearSymmetry,
    SymmetryProposal,
    cache,
    near_symmetries,
    near_symmetry,
    symmetries_from_proposals,
    symmetry,
    true_symmetries,
    turn_about,
    with_found_symmetries,
)
from depthpose.pose.metrics import add_m
from depthpose.pose.registration import Registration
from depthpose.pose.synthetic.parts import make_part
from depthpose.pose.types import ObjectModel, PoseFit, Symmetries, ViewInput
from depthpose.pose.verify import hypotheses
from depthpose.pose.verify.evidence import observe
from depthpose.pose.verify.hypotheses import compete
from depthpose.pose.verify.target_object import TargetObject

EYE = torch.eye(3, dtype=torch.float64)


def half_turn(axis: list[float]) -> Rigid:
    angle = torch.tensor(math.pi, dtype=torch.float64)
    return turn_about(torch.tensor(axis).double(), torch.zeros(3).double(), angle)


def test_near_symmetries_of_a_bar_are_its_half_turns_and_a_bracket_has_none() -> None:
    found = near_symmetries(bar())
    assert len(found) == 3
    for axis in ([1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]):
        wanted = half_turn(axis).R
        near = [one for one in found if float(geodesic_rad(one.model_from_model.R, wanted)) < 0.1]
        assert len(near) == 1, axis
        # About the long axis the copy is exact; end for end, the ends differ.
        assert (near[0].deviation < 0.003) == (axis[0] == 1.0)
    assert all(one.deviation > 0.05 for one in near_symmetries(bracket()))


def test_declared_symmetries_are_no_other_pose_and_rough_found_ones_are() -> None:
    turns = [half_turn([1.0, 0, 0]), half_turn([0, 0, 1.0])]
    both = Rigid(torch.stack([t.R for t in turns]), torch.stack([t.t_m for t in turns]))
    model = bar(0.008)
    declared = replace(model, symmetries=Symmetries(discrete=both))
    assert true_symmetries(declared).discrete is both
    assert all(
        float(geodesic_rad(one.model_from_model.R, turn.R)) > 0.5
        for one in near_symmetries(declared)
        for turn in turns
    )
    taken = replace(model, symmetries=Symmetries(discrete=both, is_found=True))
    kept = true_symmetries(taken).discrete
    assert kept is not None
    assert len(kept.R) == 1
    assert torch.equal(kept.R[0], turns[0].R)
    assert any(
        float(geodesic_rad(one.model_from_model.R, turns[1].R)) < 0.1
        for one in near_symmetries(taken)
    )


def test_an_answer_that_may_be_turned_names_the_other_ends() -> None:
    """Which end is which hardly shows: the pose is sure up to that, and the copies are named."""
    model, truth = bar(0.002), pose_at(seed=3)
    cloud = noisy(cloud_of(model, truth))
    found = Oracle(tiny_weights(model), [truth], noise=0.3).estimate(cloud=cloud)
    assert found.is_ok, found.reason
    assert found.certainty is not None
    assert found.copy_certainty is not None
    assert found.certainty > 0.9
    assert found.copy_certainty < 0.9
    copies = [other for other in found.alternatives if other.is_copy]
    assert copies
    assert all(
        re.fullmatch(
            r"rotated by 1(79|80) degrees about the (long|middle|short) axis", c.difference
        )
        for c in copies
    )
    likely = [other.probability for other in found.alternatives]
    assert likely == sorted(likely, reverse=True)
    of_copies = sum(other.probability for other in copies)
    assert found.certainty == pytest.approx(found.copy_certainty + of_copies, abs=0.05)
    poses = [found.camera_from_model, *(other.camera_from_model for other in copies)]
    errors_m = [float(add_m(pose, truth, model.vertices_m)) for pose in poses if pose is not None]
    assert min(errors_m) < 0.005


def test_the_right_end_is_the_estimate_or_named() -> None:
    model, truth = bar(0.03), pose_at(seed=3)
    found = Oracle(tiny_weights(model), [truth]).estimate(cloud=noisy(cloud_of(model, truth)))
    assert found.is_ok, found.reason
    assert found.copy_certainty is not None
    poses = [found.camera_from_model, *(other.camera_from_model for other in found.alternatives)]
    errors_m = [float(add_m(pose, truth, model.vertices_m)) for pose in poses if pose is not None]
    assert min(errors_m) < 0.005


@pytest.mark.parametrize("seed", [3, 7])
def test_copies_of_a_plate_stay_where_its_symmetry_has_them(seed: int) -> None:
    """Its back says little of where it lies in its plane, and rough steps shift it there."""
    boss = ((0.028, 0.028, 0.008), (0.035, 0.018, 0.005))
    plate = boxes("plate", ((0.15, 0.1, 0.003), (0, 0, 0)), boss)
    noise = generator(seed)
    tilt = rotation_by(0.4 * torch.randn(3, generator=noise).double())
    from_behind = half_turn([1.0, 0.0, 0.0]).R
    truth = Rigid(tilt @ from_behind, torch.tensor([0.0, 0.0, 0.4]).double())
    depth_m, mask = view_of(plate, truth.float())
    depth_m = depth_m + 0.0012 * torch.randn(depth_m.shape, generator=noise)
    view = ViewInput(name="a", depth_m=depth_m.float(), mask=mask, K=K, object=plate.name)
    cloud_m = cloud_from_depth(view.depth_m, mask, K).double()
    target = TargetObject(number=0, model=plate)

    leading = truth @ half_turn([1.0, 0.0, 0.0])
    refined = refine_exactly(cloud_m, leading, target.surface, start_diameters=0.05)
    observation = observe(cloud_m, view, target.surface, is_masked=True)
    none = Rigid(torch.zeros(0, 3, 3).double(), torch.zeros(0, 3).double())
    competition = compete(observation, refined, none, target, EstimateConfig())
    poses = [competition.best.pose, *(copy.pose for copy, _ in competition.copies)]
    errors = [float(add_m(pose.float(), truth.float(), plate.vertices_m)) for pose in poses]
    assert min(errors) < 0.004


def turned_about_near_axis(target: TargetObject, pose: Rigid, degrees: float) -> PoseFit:
    """A pose after a rotation about the axis of the object's near-symmetric copies."""
    axis = target.copies.near_axis
    assert axis is not None
    angle = torch.tensor(math.radians(degrees), dtype=torch.float64)
    turn = turn_about(axis.direction.double(), axis.point_m.double(), angle)
    return PoseFit(
        camera_from_model=pose @ turn, covariance=torch.eye(6), residual_m=torch.zeros(()),
        inlier_share=torch.ones(()),
    )  # fmt: skip


def test_a_copy_that_drifts_competes_where_it_began_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """One drifts onto the winner and one to another angle: each start stays, and the new angle."""
    mug = make_part("mug", 1)
    target = TargetObject(number=0, model=mug)
    truth = pose_at(seed=1).double()
    turned = partial(turned_about_near_axis, target, truth)
    competitors = [
        hypotheses._Competitor(refined=turned(0.0), start=turned(60.0).camera_from_model),
        hypotheses._Competitor(refined=turned(150.0), start=turned(120.0).camera_from_model),
        hypotheses._Competitor(refined=turned(203.0), start=turned(200.0).camera_from_model),
    ]
    monkeypatch.setattr(hypotheses, "_refine_competitors", lambda *_: competitors)
    copies = hypotheses._refine_distinct_copies(
        torch.zeros(1, 3).double(), turned(0.0), target, EstimateConfig(), None
    )
    angles = [
        math.degrees(float(geodesic_rad(copy.camera_from_model.R, truth.R))) for copy in copies
    ]
    assert angles == pytest.approx([60, 120, 150, 360 - 203], abs=0.01)


def test_a_pose_that_is_one_of_the_copies_competes_with_none(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Between two copies about an axis lies no other pose: the group has its probability."""
    mug = make_part("mug", 1)
    target = TargetObject(number=0, model=mug)
    truth = pose_at(seed=1).double()
    turned = partial(turned_about_near_axis, target, truth)

    upside_down = rotation_by(torch.tensor([math.pi, 0.0, 0.0])).double()
    other = replace(turned(0), camera_from_model=Rigid(truth.R @ upside_down, truth.t_m))
    different = [turned(0), turned(49.5), other]
    monkeypatch.setattr(hypotheses, "_refine_different_poses", lambda *_: different)
    monkeypatch.setattr(hypotheses, "_refine_distinct_copies", lambda *_: [turned(49.5)])
    cloud_m = cloud_of(mug, truth.float()).double()
    observation = observe(cloud_m, None, target.surface, is_masked=True)
    others = Rigid.stack([truth])
    competition = compete(observation, turned(0), others, target, EstimateConfig())
    assert len(competition.others) == 1
    total = competition.group_share + competition.others[0][1]
    assert total == pytest.approx(1)
    assert torch.equal(competition.others[0][0].pose.R, other.camera_from_model.R)


@pytest.mark.slow
def test_only_what_has_a_copy_is_less_certain_of_it() -> None:
    """A bottle whose ends are alike declares its axis alone: it may stand on its head."""
    for model in (bracket(), bottle()):
        truth = pose_at(seed=5)
        net = Oracle(tiny_weights(model), [truth])
        found = net.estimate(cloud=noisy(cloud_of(model, truth)))
        assert found.is_ok, found.reason
        assert found.copy_certainty is not None
        assert (found.copy_certainty > 0.95) == (model.name == "bracket"), found.alternatives
        on_its_head = [a for a in found.alternatives if "rotated by 180 degrees" in a.difference]
        assert bool(on_its_head) == (model.name == "bottle")
        assert all(other.is_copy for other in on_its_head)


def test_a_copy_that_drifted_about_an_axis_is_put_back_to_its_angle_alone() -> None:
    """What refinement changed besides, here a shift, stays."""
    mug = make_part("mug", 1)
    target = TargetObject(number=0, model=mug)
    shift = Rigid(torch.eye(3).double(), torch.tensor([0.0, 0.0, 0.004]).double())
    turned = partial(turned_about_near_axis, target, pose_at(seed=1).double())
    start = turned(30.0).camera_from_model
    drifted = turned(70.0)
    refined = replace(drifted, camera_from_model=shift @ drifted.camera_from_model)
    undone = hypotheses._undo_drift(refined, start, target.copies.near_axis)
    expected = (shift @ start).matrix()
    torch.testing.assert_close(undone.camera_from_model.matrix(), expected, atol=1e-6, rtol=0)
    assert hypotheses._undo_drift(refined, start, None).camera_from_model is start


def test_proposals_of_a_shape_are_cached_to_the_bit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DEPTHPOSE_CACHE", str(tmp_path))
    direction = ((EYE[0] + EYE[2] / 3) / math.hypot(1, 1 / 3)).tolist()
    point_m = (EYE.mean(0) / 7).tolist()
    given = [
        SymmetryProposal("continuous", direction, point_m, None, 0.1 / 3, 2 / 3),
        SymmetryProposal("discrete", direction, point_m, math.pi, 0.1 / 3, 2 / 3),
    ]
    searches: list[float] = []

    def search(_: ObjectModel, tolerance: float) -> list[SymmetryProposal]:
        searches.append(tolerance)
        return given

    monkeypatch.setattr(symmetry, "propose_symmetries", search)
    wanted = symmetries_from_proposals(given)
    for tolerance in (0.02, 0.02, 0.03):
        cache.read_or_compute.cache_clear()
        model = with_found_symmetries(bar(), tolerance)
        found, (own,) = model.symmetries, wanted.continuous
        assert found.discrete is not None
        assert wanted.discrete is not None
        assert torch.equal(found.discrete.matrix(), wanted.discrete.matrix())
        assert torch.equal(found.continuous[0].direction, own.direction)
        assert torch.equal(found.continuous[0].point_m, own.point_m)
    assert searches == [0.02, 0.03], "another tolerance is another search"


def test_what_was_found_is_kept_for_the_next_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DEPTHPOSE_CACHE", str(tmp_path))
    cache.read_or_compute.cache_clear()
    model = replace(bar(), symmetries=Symmetries(is_found=True))
    true = near_symmetry._search_near_symmetries(model)
    searches: list[ObjectModel] = []

    def counted(model: ObjectModel) -> Any:  # noqa: ANN401
        searches.append(model)
        return true

    monkeypatch.setattr(near_symmetry, "_search_near_symmetries", counted)
    found = near_symmetries(model)
    assert found
    (path,) = tmp_path.glob("near_symmetries/*.json")
    searches.clear()

    def again() -> tuple[NearSymmetry, ...]:
        cache.read_or_compute.cache_clear()
        return near_symmetries(model)

    assert all(
        one.deviation == other.deviation
        and torch.equal(one.model_from_model.matrix(), other.model_from_model.matrix())
        for one, other in zip(again(), found, strict=True)
    )
    assert true_symmetries(model).is_found
    assert not searches
    path.write_text('{"near": [[1')
    assert len(again()) == len(found)
    assert len(searches) == 1, "a damaged file is no answer"
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("DEPTHPOSE_CACHE", str(tmp_path / "file"))
    assert len(again()) == len(found), "what cannot be written is found again"
    assert len(searches) == 2


@pytest.mark.parametrize("handle", ["at the side", "behind"])
def test_a_mug_is_turned_to_its_handle_and_by_any_angle_where_none_is_seen(handle: str) -> None:
    """In an exact mask a handle says which rotation is right; without one many fit."""
    mug = make_part("mug")
    x = [1.0, 0, 0] if handle == "at the side" else [0, 0, 1.0]  # where the handle is
    y = torch.linalg.cross(torch.tensor([0, -1.0, 0]), torch.tensor(x))
    R = torch.stack([torch.tensor(x), y, torch.tensor([0, -1.0, 0])], 1)
    truth = Rigid(R, torch.tensor([0.0, 0.05, 0.6]))
    seen, mask = view_of(mug, truth)
    depth_m = torch.where(mask, seen, torch.tensor(1.2).to(seen)).float()
    depth_m += 0.0005 * torch.randn(240, 320, generator=torch.Generator().manual_seed(0))
    view = ViewInput(name="a", depth_m=depth_m, mask=mask, K=K, object="mug")
    (found,) = Registration([mug]).estimate_many([view])
    if handle == "at the side":
        assert found.camera_from_model is not None, found.reason
        assert float(add_m(found.camera_from_model, truth, mug.vertices_m)) < 0.003
        assert (found.certainty or 0) > 0.8
    elif found.camera_from_model is not None:
        poses = [found.camera_from_model, *(a.camera_from_model for a in found.alternatives)]
        assert len(poses) > 3
        off_m = min(float(add_m(pose, truth, mug.vertices_m)) for pose in poses)
        assert off_m < 0.2 * mug.diameter_m
    else:
        assert found.status in ("not observable", "doubtful"), found.reason
