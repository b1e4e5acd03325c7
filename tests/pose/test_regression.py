"""The regressed depth image as an estimator: its refinement, and what it refuses."""

import math
from dataclasses import replace

import pytest
import torch
from tests.pose.synthetic_objects import FACTS, K, bracket, pose_at, view_of

from depthpose.core.errors import InputError
from depthpose.core.rigid import Rigid, perturb
from depthpose.pose.config import CloudConfig, EstimateConfig, IcpConfig, RefusalConfig
from depthpose.pose.metrics import add_m
from depthpose.pose.network_pose import DepthImageRegressor
from depthpose.pose.networks.baselines import DepthImageConfig, DepthImageNet
from depthpose.pose.types import KnownBackground, ViewInput
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
    # So far turned that ICP from this start alone ends elsewhere.
    start = perturb(pose_at(), torch.tensor([math.radians(60), 0.0, 0.0, 0.0, 0.0, 0.0]))
    wrong = Rigid(start.R[None], pose_at().t_m[None])
    monkeypatch.setattr("depthpose.pose.network_pose.make_poses", lambda *_: wrong)
    errors_m: list[float] = []
    for starts in (7, 1):
        config = EstimateConfig(icp=IcpConfig(starts=starts))
        (found,) = DepthImageRegressor(weights, config).estimate_many([seen()])
        assert found.camera_from_model is not None
        error_m = add_m(found.camera_from_model, pose_at(), bracket().vertices_m)
        errors_m.append(float(error_m))
    assert errors_m[0] < 0.0005
    assert errors_m[1] > 0.01


def test_a_regressed_depth_image_has_no_refusals_to_register(weights: PoseWeights) -> None:
    with pytest.raises(InputError, match="refuses nothing that could be registered; omit"):
        DepthImageRegressor(weights, EstimateConfig(register_refused=True))


def test_limits_of_the_weights_hold(weights: PoseWeights) -> None:
    strict = replace(weights, refusal=RefusalConfig(min_probability=0.99))
    assert DepthImageRegressor(strict).config.limits.min_probability == 0.99
    given = EstimateConfig(refusal=RefusalConfig(min_probability=0.7))
    assert DepthImageRegressor(strict, given).config.limits.min_probability == 0.7


def test_an_object_that_is_no_longer_seen_is_lost(weights: PoseWeights) -> None:
    """A regressor cannot search for it, and the sequence goes on."""
    view = seen()
    wall = replace(view, name="wall", depth_m=torch.full_like(view.depth_m, 2.0))
    frames = [view, wall, wall]
    found = list(DepthImageRegressor(weights).track(frames, object="bracket", first=pose_at()))
    assert [one.tracking for one in found] == ["tracked", "lost", "lost"]
    assert "takes a depth image with a mask" in found[1].reason


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


def test_a_box_is_no_mask(weights: PoseWeights) -> None:
    """What is in a box beside the object would be regressed with it, and nothing be refused."""
    view = seen()
    with pytest.raises(InputError, match="takes a depth image with a mask; give both"):
        DepthImageRegressor(weights).estimate(
            depth=view.depth_m.numpy(), box=(0, 0, 320, 240), camera=K.numpy()
        )


@pytest.mark.parametrize("is_region", [False, True])
def test_a_refusal_of_too_few_pixels_says_what_it_took(
    weights: PoseWeights, is_region: bool
) -> None:
    """Of an empty region too, which stands for an object that was not detected."""
    view = seen()
    empty = replace(view, mask=torch.zeros_like(view.mask), is_region=is_region)
    (refused,) = DepthImageRegressor(weights).estimate_many([empty])
    assert refused.status == "too few points"
    assert list(refused.seconds) == ["network"]


def test_a_known_background_is_not_taken_for_the_object(weights: PoseWeights) -> None:
    depth_m, mask = view_of(bracket(), pose_at())
    everywhere = torch.ones_like(mask)
    wall_m = torch.full_like(depth_m, 1.2)
    background = KnownBackground(depth_m=wall_m, is_seen=~mask)
    loose = ViewInput(
        name="seen",
        depth_m=torch.where(mask, depth_m, wall_m),
        mask=everywhere,
        K=K,
        object="bracket",
        background=background,
    )
    net = DepthImageRegressor(weights)
    by_background, by_mask = net.estimate_many([loose, seen()])
    assert by_background.camera_from_model is not None
    assert by_mask.camera_from_model is not None
    assert torch.equal(by_background.camera_from_model.t_m, by_mask.camera_from_model.t_m)
