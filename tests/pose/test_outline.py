"""How far a cloud and a posed silhouette reach beyond each other."""

from dataclasses import replace

import pytest
import torch
from tests.pose.synthetic_objects import K, Oracle, bracket, pose_at, tiny_weights, view_of

from depthpose.core.camera import back_project
from depthpose.core.rigid import Rigid
from depthpose.pose.config import RefusalConfig
from depthpose.pose.estimator.outline import overhang, shortfall
from depthpose.pose.surface import prepare_surface
from depthpose.pose.synthetic.negatives import scaled
from depthpose.pose.types import CloudInput, ObjectModel, PoseEstimate, ViewInput

TRUTH = pose_at()
SURFACE = prepare_surface(bracket())


def view(model: ObjectModel) -> ViewInput:
    """A model before a wall."""
    depth_m, mask = view_of(model, TRUTH)
    depth_m = torch.where(mask, depth_m, torch.tensor(1.3).to(depth_m))
    return ViewInput(name="a", depth_m=depth_m.float(), mask=mask, K=K, object="bracket")


def cloud(given: ViewInput) -> torch.Tensor:
    return back_project(given.depth_m.double(), K)[given.mask]


def reached(model: ObjectModel) -> tuple[float, float]:
    given = view(model)
    points_m = cloud(given)
    return overhang(points_m, TRUTH, SURFACE), shortfall(given, points_m, TRUTH, SURFACE)


def test_a_larger_copy_reaches_beyond_the_silhouette_and_a_smaller_one_falls_short() -> None:
    over, short = reached(bracket())
    larger, smaller = reached(scaled(bracket(), 1.15)), reached(scaled(bracket(), 0.85))
    assert over < 0.015
    assert short < 0.015
    assert larger[0] > 0.03
    assert larger[1] < 0.015
    assert smaller[0] < 0.015
    assert smaller[1] > 0.03


def test_a_shift_across_the_view_is_measured_in_diameters() -> None:
    given = view(bracket())
    shift = torch.tensor([0.1 * SURFACE.diameter_m, 0.0, 0.0]).to(TRUTH.t_m)
    beside = Rigid(TRUTH.R, TRUTH.t_m + shift)
    assert 0.05 < overhang(cloud(given), beside, SURFACE) < 0.12
    assert 0.05 < shortfall(given, cloud(given), beside, SURFACE) < 0.12


@pytest.mark.parametrize("depth_m", [torch.nan, 0.4])
def test_what_is_occluded_or_has_no_reading_does_not_fall_short(depth_m: float) -> None:
    given = view(bracket())
    columns = torch.arange(320).expand(240, 320)
    kept = given.mask & (columns < columns[given.mask].median())
    other_m = torch.where(kept, given.depth_m, torch.tensor(depth_m))
    half = replace(given, depth_m=other_m, mask=kept)
    assert shortfall(half, cloud(half), TRUTH, SURFACE) == 0
    through = torch.where(kept, given.depth_m, torch.tensor(1.3))
    half = replace(half, depth_m=through)
    assert shortfall(half, cloud(half), TRUTH, SURFACE) > 0.2


def test_a_pose_behind_the_camera_does_not_end_in_numbers_that_are_none() -> None:
    given = view(bracket())
    behind = Rigid(TRUTH.R, -TRUTH.t_m)
    assert overhang(cloud(given), behind, SURFACE) >= 0
    assert shortfall(given, cloud(given), behind, SURFACE) >= 0


def estimated(
    given: ViewInput | CloudInput, signal: str, slope: float, bias: float
) -> PoseEstimate:
    refusal = RefusalConfig(max_risk=0.5, bias=bias, slopes={signal: slope})
    return Oracle(tiny_weights(bracket(), refusal=refusal), [TRUTH]).estimate_many([given])[0]


@pytest.mark.parametrize(
    ("times", "signal", "slope", "bias", "said"),
    [
        (1.03, "overhang", 10.0, 40.4, "beyond the posed silhouette"),
        (0.98, "shortfall", 2.2, 8.9, "where the camera saw what lies behind"),
    ],
)
def test_what_reaches_too_far_is_refused_with_its_reason(
    times: float, signal: str, slope: float, bias: float, said: str
) -> None:
    assert estimated(view(bracket()), signal, slope, bias).is_ok
    found = estimated(view(scaled(bracket(), times)), signal, slope, bias)
    assert found.status == "doubtful"
    assert said in found.reason


def test_a_cloud_alone_does_not_fall_short() -> None:
    given = view(bracket())
    alone = CloudInput(name="a", points_m=cloud(given).float(), object="bracket")
    found = estimated(alone, "overhang", 10.0, 40.4)
    assert found.is_ok
    assert found.signals["overhang"] < 0.015
    assert "shortfall" not in found.signals
