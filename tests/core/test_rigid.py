import numpy as np
import pytest
import torch

from depthpose.core.errors import InputError
from depthpose.core.rigid import (
    Rigid,
    cross_matrix,
    fit_rigid,
    geodesic_rad,
    is_rigid,
    perturb,
    rotation_by,
)

Batch = tuple[int, ...]


def random_rigid(batch: Batch) -> Rigid:
    q, _ = torch.linalg.qr(torch.randn(*batch, 3, 3, dtype=torch.float64))
    q[..., 0] *= torch.linalg.det(q)[..., None].sign()
    return Rigid(q, torch.randn(*batch, 3, dtype=torch.float64))


@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
def test_fit_recovers_the_transform_that_made_the_points(batch: Batch) -> None:
    truth = random_rigid(batch)
    source = torch.randn(*batch, 9, 3, dtype=torch.float64)
    found = fit_rigid(source, truth.apply(source), torch.rand(*batch, 9, dtype=torch.float64) + 0.1)
    torch.testing.assert_close(found.R, truth.R)
    torch.testing.assert_close(found.t_m, truth.t_m)


def test_fit_never_answers_with_a_reflection() -> None:
    source = torch.randn(50, 6, 3, dtype=torch.float64)
    mirrored = source * torch.tensor([1.0, 1.0, -1.0])
    found = fit_rigid(source, mirrored, torch.ones(50, 6, dtype=torch.float64))
    torch.testing.assert_close(torch.linalg.det(found.R), torch.ones(50, dtype=torch.float64))


def test_fit_of_planar_points_is_a_rotation() -> None:
    truth = random_rigid(())
    plane = torch.randn(8, 3, dtype=torch.float64) * torch.tensor([1.0, 1.0, 0.0])
    found = fit_rigid(plane, truth.apply(plane), torch.ones(8, dtype=torch.float64))
    torch.testing.assert_close(found.R, truth.R)


def test_fit_ignores_points_without_weight() -> None:
    truth = random_rigid(())
    source = torch.randn(7, 3, dtype=torch.float64)
    target = truth.apply(source)
    target[0] += 100
    weight = torch.tensor([0.0, 1, 1, 1, 1, 1, 1], dtype=torch.float64)
    torch.testing.assert_close(fit_rigid(source, target, weight).R, truth.R)


def test_fit_says_how_many_points_it_needs() -> None:
    with pytest.raises(InputError, match="2 points carry weight, but a rotation is fixed by 3"):
        fit_rigid(torch.zeros(3, 3), torch.zeros(3, 3), torch.tensor([1.0, 1.0, 0.0]))


@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
def test_composition_is_application_one_after_the_other(batch: Batch) -> None:
    first, second = random_rigid(batch), random_rigid(batch)
    points = torch.randn(*batch, 5, 3, dtype=torch.float64)
    torch.testing.assert_close((second @ first).apply(points), second.apply(first.apply(points)))


def test_inverse_undoes() -> None:
    pose = random_rigid((3,))
    points = torch.randn(3, 5, 3, dtype=torch.float64)
    torch.testing.assert_close(pose.inverse().apply(pose.apply(points)), points)


@pytest.mark.parametrize("angle", [0.0, 1e-8, 1e-3, 1.0, 3.0])
def test_geodesic_measures_the_angle_about_an_axis(angle: float) -> None:
    a = torch.tensor(angle, dtype=torch.float64)
    c, s, o, i = a.cos(), a.sin(), torch.zeros_like(a), torch.ones_like(a)
    turn = torch.stack([c, -s, o, s, c, o, o, o, i]).reshape(3, 3)
    R = random_rigid(()).R
    torch.testing.assert_close(geodesic_rad(turn @ R, R), a, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
def test_a_transform_is_a_4x4_matrix_to_torch_and_numpy(batch: Batch) -> None:
    pose = random_rigid(batch)
    points = torch.randn(*batch, 5, 3, dtype=torch.float64)
    ones = torch.cat([points, torch.ones(*batch, 5, 1, dtype=torch.float64)], -1)
    moved = ones @ Rigid(pose.R, pose.t_m).matrix().mT
    torch.testing.assert_close(moved[..., :3], pose.apply(points))
    as_array = np.asarray(Rigid(pose.R.float(), pose.t_m.float()))
    assert (as_array.shape, as_array.dtype) == ((*batch, 4, 4), np.float64)
    np.testing.assert_allclose(as_array, pose.matrix().numpy(), atol=1e-6)
    assert np.asarray(pose, dtype=np.float32).dtype == np.float32


def test_a_transform_is_one_readable_line() -> None:
    pose = Rigid(torch.eye(3), torch.tensor([0.1, -0.25, 1.0]))
    rows = "[1.0000, 0.0000, 0.0000], [0.0000, 1.0000, 0.0000], [0.0000, 0.0000, 1.0000]"
    assert repr(pose) == f"Rigid(R=[{rows}], t_m=[0.1000, -0.2500, 1.0000])"
    assert repr(random_rigid((2, 3))) == "Rigid(a batch of (2, 3))"


def test_batches_are_stacked_joined_and_taken_apart() -> None:
    one, other = (Rigid(torch.eye(3), torch.full((3,), k)) for k in (1.0, 2.0))
    both = Rigid.stack([one, other])
    assert both.t_m.shape == (2, 3)
    assert torch.equal(both[1].t_m, other.t_m)
    assert torch.equal(Rigid.cat([both[[1]], one[None]]).t_m, both[[1, 0]].t_m)
    assert both.double().R.dtype == torch.float64
    assert both.double().float().t_m.dtype == torch.float32


@pytest.mark.parametrize("angle_rad", [0.0, 1e-9, 1e-3, 0.5, 2.0, 3.1, 3.14159265, 6.0])
def test_a_rotation_is_the_exponential_of_its_vector(angle_rad: float) -> None:
    vector = torch.randn(20, 3, dtype=torch.float64)
    vector = angle_rad * vector / vector.norm(dim=-1, keepdim=True)
    expected = torch.linalg.matrix_exp(cross_matrix(vector))
    torch.testing.assert_close(rotation_by(vector), expected, rtol=0, atol=1e-12)


def test_a_motion_is_one_in_the_frame_of_the_camera() -> None:
    """Not of the model: the object turns about the camera and is shifted along its axes."""
    pose, motion = random_rigid(()), torch.randn(6, dtype=torch.float64)
    point = torch.randn(5, 3, dtype=torch.float64)
    seen = pose.apply(point) @ rotation_by(motion[:3]).mT + motion[3:]
    torch.testing.assert_close(perturb(pose, motion).apply(point), seen)


def test_a_rigid_matrix_is_a_rotation_within_the_slack_and_0_0_0_1() -> None:
    matrix = random_rigid(()).matrix()
    assert is_rigid(matrix, slack=1e-6)
    stretched = matrix.clone()
    stretched[:3, :3] *= 1.001
    assert not is_rigid(stretched, slack=1e-4)
    assert is_rigid(stretched, slack=1e-2)
    mirrored = matrix.clone()
    mirrored[:3, 0] *= -1
    assert not is_rigid(mirrored, slack=1e-4)
    assert not is_rigid(matrix.T, slack=1e-4), "a translation in the last row"
    assert not is_rigid(torch.full((4, 4), torch.nan), slack=1e-4)
    for unusable in (torch.nan, torch.inf):
        moved = matrix.clone()
        moved[0, 3] = unusable
        assert not is_rigid(moved, slack=1e-4)
