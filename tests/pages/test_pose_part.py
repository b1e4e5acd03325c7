"""A pose as a part of a page."""

import math
from dataclasses import replace

import pytest
import torch
from tests.pages.read_page import drawings
from tests.pose.synthetic_objects import K, bracket, cloud_of, pose_at, view_of

from depthpose.core.rigid import Rigid
from depthpose.pose.types import CloudInput, PoseEstimate, ViewInput
from depthpose.report.overlay import FOUND, TRUE
from depthpose.report.pose import PoseShown, pose_section, standard_deviations
from depthpose.report.tables import Section

POSE = pose_at(seed=1)
FOUND_HERE = PoseEstimate(
    name="one",
    object="bracket",
    status="ok",
    camera_from_model=POSE,
    covariance=torch.eye(6).double() * 1e-6,
    inlier_share=0.5,
    risk=0.125,
)
REFUSED = PoseEstimate(
    name="one", object="bracket", status="doubtful", reason="the votes <do not> meet"
)


def shown(estimate: PoseEstimate, truth: Rigid | None = None) -> Section:
    depth_m, mask = view_of(bracket(), POSE)
    view = ViewInput(name="one", depth_m=depth_m, mask=mask, K=K, object="bracket")
    return pose_section(
        "one", PoseShown(given=view, estimate=estimate, model=bracket(), truth=truth)
    )


def has_ink(section: Section, color: tuple[float, float, float]) -> list[bool]:
    ink = torch.tensor(color)[:, None, None]
    return [bool(torch.isclose(p.image, ink).all(0).any()) for p in drawings(section)]


def test_the_numbers_are_those_of_the_estimate() -> None:
    section = shown(FOUND_HERE)
    R_t, spread, covariance = section.tables.values()
    for row, (R, t) in zip(R_t, zip(POSE.R.tolist(), POSE.t_m.tolist(), strict=True), strict=True):
        assert [float(cell) for cell in row] == pytest.approx([*R, t], abs=1e-5)
    turn_deg, origin_mm = standard_deviations(POSE, torch.eye(6).double() * 1e-6)
    assert [float(cell) for cell in spread[1][1:]] == pytest.approx(turn_deg, abs=1e-3)
    assert [float(cell) for cell in spread[2][1:]] == pytest.approx(origin_mm, abs=1e-3)
    assert [float(row[k]) for k, row in enumerate(covariance)] == [1e-6] * 6
    assert dict(section.facts)["risk that no named pose is right"] == "0.125"
    x, y, z = POSE.t_m.tolist()
    assert (
        section.text
        == f"The bracket is at x {x:.4f}, y {y:.4f}, z {z:.4f} m in the camera's frame."
    )


def test_an_estimate_is_blue_and_the_truth_green() -> None:
    alone, beside = shown(FOUND_HERE), shown(FOUND_HERE, pose_at(x_m=0.02, seed=1))
    assert has_ink(alone, FOUND) == [True, True]
    assert has_ink(alone, TRUE) == [False, False]
    assert has_ink(beside, TRUE) == [True, True]
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
    assert has_ink(section, FOUND) == [False, False]
    assert [layer.name for layer in section.scenes[0].layers] == ["the object, as seen", "all else"]


def test_a_cloud_has_no_picture() -> None:
    cloud = CloudInput(name="one", points_m=cloud_of(bracket(), POSE), object="bracket")
    section = pose_section("one", PoseShown(given=cloud, estimate=FOUND_HERE, model=bracket()))
    assert not section.pictures
    assert "all else" not in [layer.name for layer in section.scenes[0].layers]


def test_an_empty_mask_is_not_shown_from_near_by() -> None:
    depth_m, mask = view_of(bracket(), POSE)
    view = ViewInput(name="one", depth_m=depth_m, mask=mask & False, K=K, object="bracket")
    estimate = replace(REFUSED, reason="nothing")
    section = pose_section("one", PoseShown(given=view, estimate=estimate, model=bracket()))
    assert len(section.pictures) == 1


def test_a_turn_about_the_camera_moves_an_origin_that_is_far_from_it() -> None:
    pose = Rigid(torch.eye(3), torch.tensor([0.0, 0.0, 2.0]))
    covariance = torch.zeros(6, 6)
    covariance[1, 1] = 0.01**2  # about y: two metres ahead, sideways by 20 mm
    turn_deg, origin_mm = standard_deviations(pose, covariance)
    assert turn_deg == pytest.approx([0.0, math.degrees(0.01), 0.0], rel=1e-5)
    assert origin_mm == pytest.approx([20.0, 0.0, 0.0], rel=1e-5)
    # A translation that takes the turn back leaves the origin where it is.
    covariance[3, 3], covariance[1, 3], covariance[3, 1] = 0.02**2, -0.0002, -0.0002
    assert standard_deviations(pose, covariance)[1] == pytest.approx([0.0, 0.0, 0.0], abs=0.02)
