"""Poses that fit as well as the best: found by the shape of the model, shared, named, counted."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from tests.pose.synthetic_objects import (
    K,
    Oracle,
    bottle,
    box_faces,
    bracket,
    cloud_of,
    pose_at,
    tiny_weights,
    view_of,
)

from depthpose.core.rigid import Rigid, geodesic_rad
from depthpose.pose.cloud import cloud_from_depth
from depthpose.pose.config import EstimateConfig, IcpConfig
from depthpose.pose.copies import (
    Candidate,
    KnownObject,
    difference_of,
    find_candidates,
    find_copies,
    turn_best,
    with_copies,
)
from depthpose.pose.identity import share_out
from depthpose.pose.mesh import (
    NearSymmetry,
    SymmetryProposal,
    make_model,
    near_symmetries,
    symmetries_from_proposals,
    symmetry,
    true_symmetries,
    turn_about,
    with_found_symmetries,
)
from depthpose.pose.metrics import add_m
from depthpose.pose.surface import prepare_surface
from depthpose.pose.synthetic.parts import make_part
from depthpose.pose.types import ObjectModel, Symmetries

EYE = torch.eye(3, dtype=torch.float64)


def bar(bump_m: float = 0.004) -> ObjectModel:
    """A bar of 20 x 7 x 3 cm, one end of which is a little narrower."""
    corners, faces = box_faces()
    vertices = corners * torch.tensor([0.2, 0.07, 0.03])
    is_end = (vertices[:, 0] > 0)[:, None]
    vertices = torch.where(is_end, vertices - bump_m * vertices.sign() * torch.tensor([0, 1, 0]),
                           vertices)  # fmt: skip
    return make_model(vertices, faces, name="bar", number=1)


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
    model, truth = bar(0.002), pose_at(seed=3)
    cloud = cloud_of(model, truth)
    found = Oracle(tiny_weights(model), [truth], noise=0.3).estimate(cloud=cloud)
    assert found.status == "ambiguous", found.reason
    assert found.certainty is not None
    assert found.certainty < 0.9
    assert {a.difference for a in found.alternatives} <= {
        f"turned by {angle} degrees about the {axis} axis"
        for axis in ("long", "middle", "short") for angle in (178, 179, 180)
    }  # fmt: skip
    likely = [a.probability for a in found.alternatives]
    assert likely == sorted(likely, reverse=True)
    assert 0.93 < found.certainty + sum(likely) <= 1 + 1e-9
    for other in found.alternatives:
        assert float(add_m(other.camera_from_model, truth, model.vertices_m)) > 0.02


def test_up_to_symmetry_the_copies_are_one_answer() -> None:
    model, truth = bar(), pose_at(seed=3)
    config = EstimateConfig(up_to_symmetry=True)
    net = Oracle(tiny_weights(model), [truth], config=config)
    found = net.estimate(cloud=cloud_of(model, truth))
    assert found.is_ok, found.reason
    assert found.alternatives == ()
    assert found.certainty == pytest.approx(1)


def test_only_what_has_a_copy_is_less_certain() -> None:
    """A bottle whose ends are alike declares its axis alone: it may stand on its head."""
    for model in (bracket(), bottle()):
        truth = pose_at(seed=5)
        net = Oracle(tiny_weights(model), [truth])
        found = net.estimate(cloud=cloud_of(model, truth))
        assert found.is_posed, found.reason
        assert found.certainty is not None
        assert (found.certainty > 0.99) == (model.name == "bracket")
        assert len(found.alternatives) == (model.name == "bottle")
        assert all("turned by 180 degrees" in one.difference for one in found.alternatives)


def test_shares_are_of_one_and_fall_with_what_speaks_against() -> None:
    shares = share_out([{"far": 0.0}, {"far": 0.01}, {"far": 0.03}], {"far": 1.0})
    # exp(-log x) is 1 / x: 1 / 0.01, 1 / 0.02 and 1 / 0.04.
    assert shares.tolist() == pytest.approx([4 / 7, 2 / 7, 1 / 7])
    without_network = share_out([{"far": 0.0}, {"far": 0.01}], {"far": 1.0, "disagree": 1.0})
    assert without_network.tolist() == pytest.approx([2 / 3, 1 / 3])


def test_words_tell_the_axis_and_the_shift() -> None:
    copies = find_copies(bar(), up_to_symmetry=False)
    first = pose_at(seed=1)
    first = Rigid(first.R.double(), first.t_m.double())
    turned = first @ half_turn([0, 0, 1.0])
    assert difference_of(turned, first, copies) == "turned by 180 degrees about the short axis"
    moved = Rigid(turned.R, turned.t_m + torch.tensor([0.03, 0, 0]))
    words = "turned by 180 degrees about the short axis and shifted by 30 mm"
    assert difference_of(moved, first, copies) == words
    oblique = first @ turn_about(torch.tensor([1.0, 1.0, 0]).double(), torch.zeros(3).double(),
                                 torch.tensor(math.pi / 2, dtype=torch.float64))  # fmt: skip
    said = difference_of(oblique, first, copies)
    assert said == "turned by 90 degrees about the model's axis (0.71, 0.71, 0.00)"


def test_proposals_of_a_shape_are_kept_to_the_bit(
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
        symmetry.kept.cache_clear()
        model = with_found_symmetries(bar(), None, is_taken=True, tolerance=tolerance)
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
    symmetry.kept.cache_clear()
    model = replace(bar(), symmetries=Symmetries(is_found=True))
    true = symmetry._search(model)
    searches: list[ObjectModel] = []

    def counted(model: ObjectModel) -> Any:  # noqa: ANN401
        searches.append(model)
        return true

    monkeypatch.setattr(symmetry, "_search", counted)
    found = near_symmetries(model)
    assert found
    (path,) = tmp_path.glob("near_symmetries/*.json")
    searches.clear()

    def again() -> tuple[NearSymmetry, ...]:
        symmetry.kept.cache_clear()
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
    """A network takes a wrong turn of a mug: in its mask the readings say which one is right."""
    mug = make_part("mug")
    x = [1.0, 0, 0] if handle == "at the side" else [0, 0, 1.0]  # where the handle is
    y = torch.linalg.cross(torch.tensor([0, -1.0, 0]), torch.tensor(x))
    R = torch.stack([torch.tensor(x), y, torch.tensor([0, -1.0, 0])], 1)
    truth = Rigid(R, torch.tensor([0.0, 0.05, 0.6])).double()
    seen, mask = view_of(mug, truth.float())
    cloud_m = cloud_from_depth(seen, mask, K).double()
    known = KnownObject(number=0, model=mug, surface=prepare_surface(mug))
    with_copies(known, up_to_symmetry=False)
    about = turn_about(torch.tensor([0, 0, 1.0]).double(), torch.zeros(3).double(),
                       torch.tensor(2.0).double())  # fmt: skip
    wrong = Candidate(truth @ about, torch.eye(6).double(), 0.0)
    none = wrong.pose[None][[]]
    best, others, turned = turn_best(cloud_m, wrong, none, known, IcpConfig())
    config = EstimateConfig()
    found = find_candidates(cloud_m, best, others, turned, known, config, is_refined=True)
    off = [float(add_m(one.pose, truth, mug.vertices_m.double())) for one in found]
    if handle == "behind":
        assert len(found) > 5
        assert min(off) < 0.1 * mug.diameter_m
    else:
        assert len(found) == 1
        assert off[0] < 0.02 * mug.diameter_m


def test_turns_of_what_looks_nearly_alike_are_one_answer_up_to_symmetry_and_a_mugs_are_not() -> (
    None
):
    near, mug = find_copies(bar(), up_to_symmetry=False), make_part("mug")
    assert near.mostly == 3
    assert find_copies(bar(), up_to_symmetry=True).mostly == 0
    assert find_copies(mug, up_to_symmetry=True).mostly > 10
    assert find_copies(bracket(), up_to_symmetry=False).mostly == 0
