"""What a depth image shows behind a posed object: a camera does not see through it."""

import math
from dataclasses import replace

import pytest
import torch
from tests.pose.synthetic_objects import K, Oracle, bracket, pose_at, tiny_weights, view_of
from torch import Tensor

from depthpose.core.camera import back_project
from depthpose.core.rigid import Rigid
from depthpose.pose.config import RefusalConfig
from depthpose.pose.estimator.scene import seen_through
from depthpose.pose.surface import prepare_surface
from depthpose.pose.types import CloudInput, PoseEstimate, ViewInput

WALL_M = 1.3
REFUSAL = RefusalConfig(max_risk=0.5, bias=6.0, slopes={"through": 2.0})
"""Lets 4 % of the posed surface be seen through."""


def view(truth: Rigid, keep: Tensor | None = None) -> ViewInput:
    """A bracket before a wall; where it is not kept, the wall is seen."""
    depth_m, mask = view_of(bracket(), truth)
    mask = mask if keep is None else mask & keep
    depth_m = torch.where(mask, depth_m, torch.tensor(WALL_M).to(depth_m))
    return ViewInput(name="a", depth_m=depth_m.float(), mask=mask, K=K, object="bracket")


def left_part() -> Tensor:
    """Pixels left of the middle of the bracket's silhouette."""
    _, mask = view_of(bracket(), pose_at())
    columns = torch.arange(320).expand(240, 320)
    return columns < columns[mask].median()


def estimated(given: ViewInput | CloudInput) -> PoseEstimate:
    return Oracle(tiny_weights(bracket(), refusal=REFUSAL), [pose_at()]).estimate_many([given])[0]


def test_a_camera_does_not_see_through_an_object_but_beside_it() -> None:
    surface, truth = prepare_surface(bracket()), pose_at()
    assert seen_through(view(truth), truth, surface) < 0.02
    beside = Rigid(truth.R, truth.t_m + torch.tensor([0.5 * surface.diameter_m, 0.0, 0.0]))
    assert seen_through(view(truth), beside, surface) > 0.3
    assert 0.3 < seen_through(view(truth, left_part()), truth, surface) < 0.7


def test_what_has_no_reading_or_is_occluded_is_not_seen_through() -> None:
    surface, truth = prepare_surface(bracket()), pose_at()
    half = view(truth, left_part())
    for depth_m in (torch.nan, 0.4):
        other_m = torch.where(half.mask, half.depth_m, torch.tensor(depth_m))
        assert seen_through(replace(half, depth_m=other_m), truth, surface) == 0


def test_a_pose_that_was_seen_through_is_refused_with_its_reason() -> None:
    whole = estimated(view(pose_at()))
    assert whole.is_ok
    assert whole.signals["through"] < 0.02
    found = estimated(view(pose_at(), left_part()))
    assert found.status == "doubtful"
    assert found.reason.startswith("the camera saw through")
    assert found.signals["through"] > 0.3


def test_a_cloud_alone_does_not_say_what_is_behind_it() -> None:
    given = view(pose_at(), left_part())
    points_m = back_project(given.depth_m.double(), K)[given.mask]
    found = estimated(CloudInput(name="a", points_m=points_m.float(), object="bracket"))
    assert found.is_ok
    assert "through" not in found.signals
    assert found.risk == pytest.approx(1 / (1 + math.exp(-6) * 100**2), rel=1e-3)
