from dataclasses import replace

import numpy as np
import pytest
import torch
from tests.pose.synthetic_frames import pose_in_frame
from tests.pose.synthetic_objects import bracket, tiny_weights

from depthpose.core.errors import InputError
from depthpose.core.rigid import Rigid
from depthpose.pose.config import CloudConfig
from depthpose.pose.evaluate import Conditions, ObjectRow, Origin
from depthpose.pose.network_pose import GeoPoseNet
from depthpose.pose.synthetic import SyntheticViews
from depthpose.thesis.pose_tables import (
    LINEMOD,
    LINEMOD_DIAMETERS_M,
    ROWS,
    find_linemod_number,
    join_by_object,
)
from depthpose.thesis.pose_voting import (
    VotingCase,
    collect_votes,
    compare_voting,
    ransac_one_by_one,
)


def test_printed_means_are_those_of_the_printed_numbers() -> None:
    whole = [row for row in ROWS if row.printed]
    assert len(whole) == 8
    means = {row.method: sum(map(float, row.printed.split())) / 13 for row in whole}
    # One row's printed mean is not that of its printed numbers, and its note says so.
    assert round(means.pop("SSD-6D + ICP"), 1) == 76.7
    for row in whole:
        if row.method in means:
            assert means[row.method] == pytest.approx(row.mean, abs=0.06), row.method
        else:
            assert "76.7" in row.note


def measured(name: str, success: float, method: str = "ours", diameters: str = "bop") -> ObjectRow:
    return ObjectRow(
        object=name,
        instances=4,
        annotated=4,
        success=success,
        refused=0.1,
        wrong=0.2,
        coverage=0.9,
        scores={"auc": 0.5},
        ms={"network": 12.0},
        conditions=Conditions(diameters=diameters, frames="lm test", frames_sha256="cd"),
        origin=Origin(method=method, masks="truth", weights="w", weights_sha256="ab"),
    )


def test_ours_stand_beside_the_print_and_below_the_difference() -> None:
    rows = [measured("obj_01", 0.9), measured("obj_10", 1.0), measured("mean", 0.95)]
    table = join_by_object(rows, {"obj_01": 1, "obj_10": 10}, with_published=True)
    assert [row["source"] for row in table] == ["published"] * 11 + ["ours"] + ["difference"] * 3
    ours, last = table[11], table[-1]
    assert (ours["ape"], ours["eggbox*"], ours["mean"]) == (90.0, 100.0, 95.0)
    assert last["method"] == "ours - DenseFusion, iterative"
    assert last["ape"] == pytest.approx(90.0 - 92.3)
    assert last["mean"] is None  # theirs is over thirteen objects
    every = {name: number for number, name in LINEMOD.items()}
    rows = [measured(name, 0.5, diameters="pvnet") for name in (*every, "mean")]
    last = join_by_object(rows, every, with_published=True)[-1]
    assert last["mean"] == pytest.approx(50.0 - 94.3)
    assert last["diameters"] == "pvnet against bop"


def test_an_object_of_linemod_is_known_by_name_or_diameter() -> None:
    def found(name: str, number: int, diameter_m: float) -> int:
        model = replace(bracket(name), number=number, diameter_m=diameter_m)
        return find_linemod_number(model)

    assert set(LINEMOD) < set(LINEMOD_DIAMETERS_M)
    assert found("obj_000006", 6, 0.1545) == 6
    assert found("cat", 1, 0.1526) == 6  # numbered anew, with the diameter of PVNet's table
    assert found("eggbox", 10, 0.1646) == 10
    assert found("bowl", 3, 0.1674) == 3
    for name, number, diameter_m, said in (
        ("obj_000001", 1, 0.1717, "LineMOD's object 1 is 0.1021 m"),  # YCB's first
        ("obj_000021", 21, 0.1, "0.1000 m across) is none of LineMOD. Table"),
        ("flange", 6, 0.1545, "object 6 (flange, "),
        ("can", 5, 0.12, "LineMOD's object 5 is 0.2014 m"),
    ):
        with pytest.raises(InputError, match="take 'reproduce") as refused:
            found(name, number, diameter_m)
        assert said in str(refused.value)


def test_columns_of_a_table_come_in_the_declared_order() -> None:
    rows = [measured("obj_01", 0.9)]
    table = join_by_object(rows, {"obj_01": 1}, with_published=True)
    assert list(table[2]) == [
        "source", "method", "masks", "input", "mean", "diameters", "note", "printed in",
    ]  # fmt: skip
    assert list(table[11]) == [
        "source", "method", "masks", "input", "ape", "mean", "refused", "wrong", "auc", "instances",
        "diameters", "weights", "weights_sha256", "frames", "frames_sha256", "ms_network",
    ]  # fmt: skip
    # Where there is no difference the column is empty, not left out.
    assert table[-1] == {
        "source": "difference", "method": "ours - DenseFusion, iterative", "masks": "truth",
        "ape": pytest.approx(90 - 92.3), "mean": None,
    }  # fmt: skip


def test_baselines_stand_below_the_method() -> None:
    rows = [measured(name, 0.9) for name in ("cat", "mean")]
    rows += [measured(name, 0.4, "pointnet") for name in ("cat", "mean")]
    ours, theirs, difference = join_by_object(rows, {"cat": 6}, with_published=False)
    assert (ours["cat"], theirs["cat"]) == (90.0, 40.0)
    assert difference["method"] == "ours - pointnet"
    assert difference["cat"] == difference["mean"] == pytest.approx(50.0)


def test_only_rows_of_one_kind_of_masks_are_subtracted() -> None:
    rows: list[ObjectRow] = []
    for masks, ours, theirs in (("truth", 0.9, 0.4), ("predicted", 0.7, 0.1)):
        for method, share in (("ours", ours), ("pointnet", theirs)):
            row = measured("cat", share, method)
            assert row.origin is not None
            rows.append(replace(row, origin=replace(row.origin, masks=masks)))
    table = join_by_object(rows, {"cat": 6}, with_published=False)
    differences = [row for row in table if row["source"] == "difference"]
    assert {row["masks"]: row["cat"] for row in differences} == {
        "truth": pytest.approx(50.0),
        "predicted": pytest.approx(60.0),
    }


def exact_case(points: int, wrong: float, seed: int = 0) -> VotingCase:
    """A cloud of the bracket whose votes are exact, but for a share that points anywhere."""
    generator = torch.Generator().manual_seed(seed)
    model, pose = bracket(), pose_in_frame(0.0, seed)
    truth = Rigid(pose.R.float(), pose.t_m.float())
    chosen = torch.randint(len(model.vertices_m), (points,), generator=generator)
    jitter = 0.03 * torch.rand(points, 3, generator=generator)
    points_m = truth.apply(model.vertices_m[chosen] + jitter)
    ways = truth.apply(model.keypoints_m) - points_m[:, None]
    stray = torch.randn(ways.shape, generator=generator)
    is_wrong = torch.rand(points, 1, 1, generator=generator) < wrong
    n = torch.nn.functional.normalize(torch.where(is_wrong, stray, ways), dim=-1)
    return VotingCase(points_m=points_m, directions=n, model=model, truth=truth, is_adds=False)


def test_one_by_one_finds_what_most_directions_meet_at() -> None:
    case = exact_case(200, 0.3)
    points, n = (part.double().numpy() for part in (case.points_m, case.directions))
    found = ransac_one_by_one(points, n, 50)
    true = case.truth.apply(case.model.keypoints_m).double().numpy()
    # Stray directions within 8 degrees are inliers too.
    assert np.abs(found - true).max() < 0.004
    parallel = np.broadcast_to(np.array([0.0, 0.0, 1.0]), n.shape)
    assert np.isfinite(ransac_one_by_one(points, parallel, 5)).all()


def test_every_way_of_voting_sees_the_same_and_fails_alike() -> None:
    cases = [exact_case(60, 0.2, seed) for seed in range(3)]
    rows = compare_voting([*cases, None], 60)
    ways = [(row["method"], row["hypotheses"], row["inliers by"]) for row in rows]
    assert len(set(ways)) == len(ways) == 9
    for row in rows:
        assert (row["points"], row["votes"], row["instances"]) == (60, 60.0, 4)
        assert row["milliseconds"] > 0
        if "RANSAC" in row["method"] and row["inliers by"] == "angle":
            # What cannot be posed is a failure of every way.
            assert row["success"] == 75.0, row
    assert rows[0]["times faster"] == 1.0
    assert list(rows[0]) == [
        "points", "votes", "method", "hypotheses", "inliers by", "instances", "success",
        "milliseconds", "times faster",
    ]  # fmt: skip
    with pytest.raises(InputError, match="none of the 1 views has enough points"):
        compare_voting([None], 60)


def test_votes_stand_at_the_points_of_the_view() -> None:
    model = bracket()
    net = GeoPoseNet(tiny_weights(model))
    views = [SyntheticViews([model]).view(i) for i in range(2)]
    empty = replace(views[0].input, mask=torch.zeros_like(views[0].input.mask))
    cases = list(collect_votes(net, [*views, replace(views[0], input=empty)], 50))
    assert cases[2] is None
    first, again = cases[0], next(collect_votes(net, views, 50))
    assert first is not None
    assert again is not None
    assert len(first.points_m) == 50
    assert torch.equal(first.directions, again.directions)
    lengths = first.directions.norm(dim=-1)
    assert bool(((lengths - 1).abs() < 1e-5).logical_or(lengths == 0).all())


def test_votes_are_those_of_the_estimator() -> None:
    model = bracket()
    weights = replace(tiny_weights(model), cloud=CloudConfig(max_points=None))
    net = GeoPoseNet(weights)
    view = SyntheticViews([model]).view(1)
    _, voted = net.estimate_with_votes(view.input)
    assert voted is not None
    case = next(collect_votes(net, [view], 100_000))
    assert case is not None
    expected = torch.nn.functional.normalize(voted.directions, dim=-1)
    # A kept point of each voxel; the estimator drops flying pixels by the same rule.
    gaps = (case.points_m[None] - voted.points_m[:, None]).norm(dim=-1)
    place = gaps.argmin(1)
    assert float(gaps.amin(1).max()) == 0.0
    assert torch.allclose(case.directions[place], expected, atol=1e-4)
