"""A pose as a part of a page."""

import math
from dataclasses import replace
from typing import Any, cast

import pytest
import torch
from tests.pages.read_page import drawings
from tests.pose.synthetic_objects import K, bracket, cloud_of, pose_at, view_of

from depthpose.core.rigid import Rigid, perturb
from depthpose.pose.predictions import Prediction, prediction_row
from depthpose.pose.types import Axis, CloudInput, PoseEstimate, ViewInput
from depthpose.pose.verify.observability import free_motions
from depthpose.report.page import Section
from depthpose.report.pose import ESTIMATED, TRUTH, make_pose_section

POSE = pose_at(seed=1)
FOUND_HERE = PoseEstimate(
    name="one",
    object="bracket",
    status="ok",
    camera_from_model=POSE,
    covariance=torch.eye(6).double() * 1e-6,
    inlier_share=0.5,
    certainty=0.875,
)
REFUSED = PoseEstimate(
    name="one", object="bracket", status="doubtful", reason="the votes <do not> meet"
)


def shown(estimate: PoseEstimate, truth: Rigid | None = None) -> Section:
    depth_m, mask = view_of(bracket(), POSE)
    view = ViewInput(name="one", depth_m=depth_m, mask=mask, K=K, object="bracket")
    return make_pose_section("one", view, estimate, bracket(), truth=truth)


def has_ink(section: Section, color: tuple[float, float, float]) -> list[bool]:
    ink = torch.tensor(color)[:, None, None]
    return [bool(torch.isclose(p.image, ink).all(0).any()) for p in drawings(section)]


def test_the_numbers_are_those_of_the_estimate() -> None:
    section = shown(FOUND_HERE)
    R_t, spread, covariance = section.tables.values()
    for row, (R, t) in zip(R_t, zip(POSE.R.tolist(), POSE.t_m.tolist(), strict=True), strict=True):
        assert [float(cell) for cell in row] == pytest.approx([*R, t], abs=1e-5)
    for row, std in zip(
        spread[1:], (FOUND_HERE.origin_std_mm, FOUND_HERE.rotation_std_deg), strict=True
    ):
        assert std is not None
        assert [float(cell) for cell in row[1:]] == pytest.approx(std.tolist(), abs=1e-3)
    assert [float(row[k]) for k, row in enumerate(covariance)] == [1e-6] * 6
    assert dict(section.facts)["certainty, up to near-symmetry"] == "0.875"
    x, y, z = POSE.t_m.tolist()
    assert (
        section.text
        == f"The bracket is at x {x:.4f}, y {y:.4f}, z {z:.4f} m in the camera's frame."
    )


def test_an_estimate_is_blue_and_the_truth_green() -> None:
    alone, beside = shown(FOUND_HERE), shown(FOUND_HERE, pose_at(x_m=0.02, seed=1))
    assert has_ink(alone, ESTIMATED) == [True, True]
    assert has_ink(alone, TRUTH) == [False, False]
    assert has_ink(beside, TRUTH) == [True, True]
    names = {layer.name: layer.is_shown for layer in beside.scenes[0].layers}
    assert all(names[name] for name in ("true box", "true edges", "its box"))
    names = {layer.name: layer.is_shown for layer in alone.scenes[0].layers}
    assert "true box" not in names
    assert not names["its box"]


def test_a_refusal_says_why_and_shows_the_mask() -> None:
    section = shown(REFUSED)
    assert section.text == "Refused (doubtful): the votes <do not> meet."
    assert not section.tables
    assert has_ink(section, (1.0, 0.85, 0.1)) == [True, True]
    assert has_ink(section, ESTIMATED) == [False, False]
    assert [layer.name for layer in section.scenes[0].layers] == ["the object, as seen", "all else"]


def test_a_cloud_has_no_picture() -> None:
    cloud = CloudInput(name="one", points_m=cloud_of(bracket(), POSE), object="bracket")
    section = make_pose_section("one", cloud, FOUND_HERE, bracket())
    assert not section.pictures
    assert "all else" not in [layer.name for layer in section.scenes[0].layers]


def test_an_empty_mask_is_not_shown_from_near_by() -> None:
    depth_m, mask = view_of(bracket(), POSE)
    view = ViewInput(name="one", depth_m=depth_m, mask=mask & False, K=K, object="bracket")
    estimate = replace(REFUSED, reason="nothing")
    section = make_pose_section("one", view, estimate, bracket())
    assert len(section.pictures) == 1


def deviations(**given: Rigid | torch.Tensor) -> tuple[list[float], list[float]]:
    found = replace(FOUND_HERE, **cast("Any", given))
    origin_mm, rotation_deg = found.origin_std_mm, found.rotation_std_deg
    assert origin_mm is not None
    assert rotation_deg is not None
    return origin_mm.tolist(), rotation_deg.tolist()


def test_a_turn_about_the_camera_moves_an_origin_that_is_far_from_it() -> None:
    pose = Rigid(torch.eye(3), torch.tensor([0.0, 0.0, 2.0]))
    covariance = torch.zeros(6, 6)
    covariance[1, 1] = 0.01**2  # about y: two metres ahead, sideways by 20 mm
    origin_mm, rotation_deg = deviations(camera_from_model=pose, covariance=covariance)
    assert rotation_deg == pytest.approx([0.0, math.degrees(0.01), 0.0], rel=1e-5)
    assert origin_mm == pytest.approx([20.0, 0.0, 0.0], rel=1e-5)
    # A translation that takes the turn back leaves the origin where it is.
    covariance[3, 3], covariance[1, 3], covariance[3, 1] = 0.02**2, -0.0002, -0.0002
    origin_mm, _ = deviations(camera_from_model=pose, covariance=covariance)
    assert origin_mm == pytest.approx([0.0, 0.0, 0.0], abs=0.02)


def test_deviations_are_those_of_poses_drawn_from_the_covariance() -> None:
    generator = torch.Generator().manual_seed(0)
    root = torch.randn(6, 6, generator=generator, dtype=torch.float64) * 2e-3
    pose = Rigid(POSE.R.double(), POSE.t_m.double())
    drawn = torch.randn(4000, 6, generator=generator, dtype=torch.float64) @ root.mT
    true = perturb(Rigid(pose.R.expand(4000, 3, 3), pose.t_m.expand(4000, 3)), drawn)
    origin_mm, rotation_deg = deviations(covariance=root @ root.mT)
    assert origin_mm == pytest.approx((1000 * true.t_m.std(0)).tolist(), rel=0.05)
    turn = pose.R.mT @ true.R  # in the model frame
    about = torch.stack([turn[:, 2, 1], turn[:, 0, 2], turn[:, 1, 0]])
    assert rotation_deg == pytest.approx(about.std(1).rad2deg().tolist(), rel=0.05)


def test_what_a_symmetry_leaves_free_has_no_deviation() -> None:
    axis = Axis(direction=torch.tensor([0.0, 0.0, 1.0]), point_m=torch.zeros(3))
    free = free_motions((axis,), Rigid(POSE.R.double(), POSE.t_m.double()))
    origin_mm, rotation_deg = deviations(free_motions=free)
    assert all(math.isfinite(one) for one in (*origin_mm, *rotation_deg[:2]))
    assert math.isinf(rotation_deg[2])
    row = prediction_row(Prediction(estimate=replace(FOUND_HERE, free_motions=free)))
    assert row["rotation_std_deg"][2] is None
    assert row["origin_std_mm"] == pytest.approx(origin_mm)
    tables = shown(replace(FOUND_HERE, free_motions=free)).tables
    assert tables["standard deviations about this answer alone"][2][3] == "free"
