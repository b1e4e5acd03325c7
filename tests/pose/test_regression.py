"""The regressed depth image as an estimator: its refinement, and what it refuses."""

from dataclasses import replace

import pytest
import torch
from tests.pose.made_object import FACTS, K, bracket, pose_at, view_of

from depthpose.pose.baselines import DepthImageConfig, DepthImageNet
from depthpose.pose.cloud import cloud_from_depth
from depthpose.pose.config import CloudConfig, EstimateConfig, RefusalConfig
from depthpose.pose.estimator import DepthImageRegressor, regression
from depthpose.pose.refine import prepare_surface, refine_best
from depthpose.pose.types import ViewInput
from depthpose.pose.weights import PoseWeights


@pytest.fixture(scope="module")
def weights() -> PoseWeights:
    torch.manual_seed(0)
    config = DepthImageConfig(crop_px=32, widths=(4, 4, 8, 8))
    network = DepthImageNet(config).eval()
    return PoseWeights(
        network=network, models=(bracket(),), cloud=CloudConfig(), refusal=RefusalConfig(),
        facts=FACTS,
    )  # fmt: skip


def seen() -> ViewInput:
    depth_m, mask = view_of(bracket(), pose_at())
    return ViewInput(name="seen", depth_m=depth_m, mask=mask, K=K, object="bracket")


def test_the_refinement_is_ours_from_several_starts(
    weights: PoseWeights, monkeypatch: pytest.MonkeyPatch
) -> None:
    config, view = EstimateConfig(), seen()
    start = pose_at(z_m=0.81)
    monkeypatch.setattr(
        regression, "poses_of", lambda *_: replace(start, R=start.R[None], t_m=start.t_m[None])
    )
    (found,) = DepthImageRegressor(weights, config).estimate_many([view])
    points_m = cloud_from_depth(view.depth_m, view.mask, K, bracket().diameter_m).float()
    best = refine_best(points_m, start, prepare_surface(bracket(), config.icp), config.icp)
    assert found.camera_from_model is not None
    assert torch.equal(found.camera_from_model.t_m, best.camera_from_model.t_m)
    assert found.residual_m == float(best.residual_m)


def test_blobs_far_from_their_middle_are_refused_and_stop_no_other(weights: PoseWeights) -> None:
    view = seen()
    mask = torch.zeros_like(view.mask)
    mask[:20, :20] = mask[:20, -20:] = mask[-20:, 150:170] = True
    depth_m = torch.where(mask, 1.5, torch.nan)
    blobs = ViewInput(name="blobs", depth_m=depth_m, mask=mask, K=K, object="bracket")
    refused, found = DepthImageRegressor(weights).estimate_many([blobs, view])
    assert (refused.name, refused.status) == ("blobs", "too few points")
    assert refused.reason.startswith("the cloud has 0 points, fewer than the ")
    assert found.is_ok
