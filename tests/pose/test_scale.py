"""A copy of another size is not the object: the scale is measured, said and refused."""

from typing import get_args

import pytest
import torch
from bench.negatives import NegativeKind, mirrored, negative_of, scaled
from tests.pose.synthetic_objects import (
    Oracle,
    box_faces,
    bracket,
    bracket_surface,
    cloud_of,
    noisy,
    pose_at,
    tiny_weights,
)

from depthpose.core.arrays import take_evenly
from depthpose.core.loop import make_sample_generator
from depthpose.core.rigid import Rigid
from depthpose.pose.config import EstimateConfig, RefusalConfig
from depthpose.pose.geometry.surface import prepare_surface
from depthpose.pose.icp import refine_exactly
from depthpose.pose.mesh import make_model
from depthpose.pose.types import PoseEstimate
from depthpose.pose.verify import identity
from depthpose.pose.verify.identity import Scale, _fit_scale, measure_scale

TRUTH = pose_at(seed=1)


@pytest.mark.parametrize("times", [0.8, 0.9, 0.97, 1.0, 1.1, 1.2])
def test_the_scale_of_a_copy_is_measured(times: float) -> None:
    model = bracket()
    surface, cloud_m = bracket_surface(), noisy(cloud_of(scaled(model, times), TRUTH))
    begun = refine_exactly(cloud_m.double(), Rigid(TRUTH.R.double(), TRUTH.t_m.double()), surface)
    scale = measure_scale(cloud_m, begun.camera_from_model, surface)
    assert scale.times == pytest.approx(times, abs=0.012)
    assert scale.sigma < 0.02
    assert (scale.gain > 0.05) == (abs(times - 1) > 0.09)


def test_the_deviation_of_a_scale_is_that_of_errors_that_neighbours_share() -> None:
    """As sensors have them: here some eight of the 400 points in a cell of 3 cm err alike."""
    surface = prepare_surface(bracket(), deviation_m=0.0)
    cloud_m = take_evenly(cloud_of(bracket(), TRUTH).double(), 400)
    cells = (cloud_m / 0.03).floor() @ torch.tensor([1.0, 1e3, 1e6], dtype=torch.float64)
    cell = cells.unique(return_inverse=True)[1]
    pose = Rigid(TRUTH.R.double(), TRUTH.t_m.double())
    errors: list[float] = []
    for seed in range(16):
        generator = torch.Generator().manual_seed(seed)
        noise_m = 0.0015 * torch.randn(int(cell.max()) + 1, generator=generator).double()[cell]
        seen_m = cloud_m * (1 + noise_m[:, None] / cloud_m.norm(dim=1, keepdim=True))
        scale = measure_scale(seen_m, pose, surface)
        errors.append((scale.times - 1) / scale.sigma)
    assert 0.4 < float(torch.tensor(errors).square().mean().sqrt()) < 1.6


@pytest.mark.parametrize("far", [1.05, 1.4])
def test_a_step_that_only_shifts_is_not_the_last(far: float) -> None:
    """Points beyond the last limit of the distance pull a cube aside, and neither turn nor grow it.

    The first steps, whose limits are wider, shift it; with the last limit it is back.
    """
    corners, faces = box_faces()
    surface = prepare_surface(make_model(0.1 * corners, faces, name="cube"))
    lines = torch.linspace(-0.035, 0.035, 8, dtype=torch.float64)
    a, b = torch.cartesian_prod(lines, lines).T
    half = torch.full_like(a, 0.05)
    sides = [(half, a, b), (-half, a, b), (a, half, b), (a, -half, b), (a, b, half), (a, b, -half)]
    cube_m = torch.cat([torch.stack(side, -1) for side in sides])
    is_middle = (cube_m[:, 0].abs() == 0.05) & (cube_m[:, 1:].abs() < 0.02).all(-1)
    beside_m = cube_m[is_middle] + torch.tensor([far * surface.near_m, 0.0, 0.0])
    points_m = torch.cat([cube_m, beside_m])
    start = torch.ones(1, dtype=torch.float64)
    _, moved_m = _fit_scale(points_m[None], start, surface, is_exact=True)
    assert float((moved_m[0] - points_m).norm(dim=-1).max()) < 1e-5


def estimated(times: float, max_size_error: float = 0.03) -> PoseEstimate:
    model = bracket()
    refusal = RefusalConfig(max_size_error=max_size_error, min_probability=0.0)
    net = Oracle(tiny_weights(model, refusal=refusal), [TRUTH])
    return net.estimate(cloud=noisy(cloud_of(scaled(model, times), TRUTH)))


def test_a_copy_of_another_size_is_contradicted_with_its_size() -> None:
    refused = estimated(0.85)
    assert refused.status == "doubtful"
    assert refused.camera_from_model is None
    assert refused.identity is not None
    assert refused.identity.status == "contradicted"
    assert refused.identity.size == pytest.approx(0.85, abs=0.02)
    assert refused.reason.startswith("0.85 times the model's size fits best (standard deviation")
    assert ", and the sensor explains " in refused.reason
    for times in (1.0, 0.98, 1.02):
        found = estimated(times)
        assert found.is_ok
        assert found.identity is not None
        assert found.identity.status == "confirmed", found.identity
    unmeasured = estimated(0.85, max_size_error=1.0)
    assert unmeasured.is_ok
    assert unmeasured.identity is None


@pytest.mark.parametrize(("times", "status"), [(1.03, "confirmed"), (1.07, "not excluded")])
def test_an_identity_is_confirmed_where_the_size_that_fits_is_near(
    times: float, status: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    scale = Scale(times=times, pose=TRUTH.double(), sigma=0.01, gain=0.03)
    monkeypatch.setattr("depthpose.pose.verify.identity.measure_scale", lambda *_: scale)
    found = estimated(1.0).identity
    assert found is not None
    assert found.status == status
    assert found.reason.endswith(", and not that of the model") == (status == "not excluded")


@pytest.mark.parametrize(
    ("gain", "is_seen", "status"),
    [(0.03, True, "ok"), (0.07, False, "ok"), (0.07, True, "doubtful")],
)
def test_another_size_refuses_where_it_fits_clearly_better_in_the_image_too(
    gain: float, is_seen: bool, status: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is seen of a bowl from above fits at many sizes: one that gains little says nothing."""
    scale = Scale(times=1.2, pose=TRUTH.double(), sigma=0.02, gain=gain)
    monkeypatch.setattr(identity, "measure_scale", lambda *_: scale)
    monkeypatch.setattr(identity, "_is_size_seen", lambda *_: is_seen)
    found = estimated(1.0)
    assert found.status == status
    assert found.identity is not None
    assert found.identity.status == ("not excluded" if status == "ok" else "contradicted")


def test_without_icp_nobody_asks_whether_it_is_the_object() -> None:
    config = EstimateConfig(with_icp=False)
    net = Oracle(tiny_weights(bracket()), [TRUTH], config=config)
    found = net.estimate(cloud=noisy(cloud_of(bracket(), TRUTH)))
    assert found.is_ok
    assert found.identity is None


@pytest.mark.parametrize("kind", get_args(NegativeKind))
def test_negatives_bear_the_name_and_are_something_else(kind: NegativeKind) -> None:
    model = bracket()
    other = negative_of(model, kind, [model], make_sample_generator(1, 0))
    assert other.name == model.name
    assert 0.2 < other.diameter_m / model.diameter_m < 3
    if kind in ("scaled", "mirrored"):
        assert len(other.vertices_m) == len(model.vertices_m)
        assert not torch.allclose(other.vertices_m, model.vertices_m)
    else:
        assert other.vertices_m.shape != model.vertices_m.shape


def test_a_mirrored_object_has_its_normals_outward() -> None:
    once = mirrored(bracket())
    corners = once.vertices_m[once.faces]
    across = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert bool(((across * once.normals[once.faces].mean(1)).sum(-1) > 0).all())
    twice = mirrored(once)
    assert torch.equal(twice.vertices_m, bracket().vertices_m)
