"""A copy of another size is not the object: the scale is measured, said and refused."""

from typing import get_args

import pytest
import torch
from tests.pose.synthetic_objects import Oracle, bracket, cloud_of, noisy, pose_at, tiny_weights

from depthpose.core.errors import InputError
from depthpose.core.loop import sample_generator
from depthpose.core.rigid import Rigid
from depthpose.pose.config import EstimateConfig, RefusalConfig
from depthpose.pose.estimator.scale import scale_of
from depthpose.pose.refine import refine_pose
from depthpose.pose.surface import prepare_surface
from depthpose.pose.synthetic.negatives import NegativeKind, mirrored, negative_of, scaled
from depthpose.pose.types import PoseEstimate

TRUTH = pose_at(seed=1)


@pytest.mark.parametrize("times", [0.8, 0.9, 0.97, 1.0, 1.1, 1.2])
def test_the_scale_of_a_copy_is_measured(times: float) -> None:
    model = bracket()
    surface, cloud_m = prepare_surface(model), noisy(cloud_of(scaled(model, times), TRUTH))
    begun = refine_pose(cloud_m.double(), Rigid(TRUTH.R.double(), TRUTH.t_m.double()), surface)
    scale = scale_of(cloud_m, begun.camera_from_model, surface)
    assert scale.times == pytest.approx(times, abs=0.012)
    assert scale.sigma < 0.02
    assert (scale.error > 0.03) == (abs(times - 1) > 0.09)


def estimated(times: float, max_scale_error: float = 0.03) -> PoseEstimate:
    model = bracket()
    refusal = RefusalConfig(max_risk=1.0, max_scale_error=max_scale_error)
    net = Oracle(tiny_weights(model, refusal=refusal), [TRUTH])
    return net.estimate(cloud=noisy(cloud_of(scaled(model, times), TRUTH)))


def test_a_copy_of_another_size_is_refused_with_its_scale() -> None:
    refused = estimated(0.9)
    assert refused.status == "doubtful"
    assert refused.reason.startswith("the cloud fits the object best at 0.9")
    assert "3% are allowed" in refused.reason
    assert refused.camera_from_model is None
    assert refused.signals["scale"] == pytest.approx(0.9, abs=0.02)
    for times in (1.0, 0.98, 1.02):
        assert estimated(times).is_ok
    assert estimated(0.9, max_scale_error=1.0).is_ok
    assert "scale" not in estimated(0.9, max_scale_error=1.0).signals


def test_without_icp_the_scale_is_not_measured() -> None:
    config = EstimateConfig(with_icp=False)
    net = Oracle(tiny_weights(bracket()), [TRUTH], config=config)
    assert "scale" not in net.estimate(cloud=noisy(cloud_of(bracket(), TRUTH))).signals


def test_a_share_beyond_its_range_is_refused() -> None:
    with pytest.raises(InputError, match=r"max_scale_error is 0.0, but it is a share above 0"):
        RefusalConfig(max_scale_error=0.0)


@pytest.mark.parametrize("kind", get_args(NegativeKind))
def test_negatives_bear_the_name_and_are_something_else(kind: NegativeKind) -> None:
    model = bracket()
    other = negative_of(model, kind, [model], sample_generator(1, 0))
    assert other.name == model.name
    assert 0.2 < other.diameter_m / model.diameter_m < 3
    if kind in ("scaled", "mirrored"):
        assert len(other.vertices_m) == len(model.vertices_m)
        assert not torch.allclose(other.vertices_m, model.vertices_m)
    else:
        assert other.vertices_m.shape != model.vertices_m.shape


def test_a_mirrored_object_has_its_normals_outward() -> None:
    once = mirrored(bracket())
    corners = once.triangles_m
    across = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert bool(((across * once.normals[once.faces].mean(1)).sum(-1) > 0).all())
    twice = mirrored(once)
    assert torch.equal(twice.vertices_m, bracket().vertices_m)
