import pytest
import torch
from torch import Tensor

from depthpose.core.rigid import Rigid, rotation_by
from depthpose.pose.losses import (
    POINT_LOSSES,
    direction_loss,
    model_point_loss,
)


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_directions_have_length_one_or_none() -> None:
    points = torch.tensor([[0.0, 0.0, 1.0], [3.0, 4.0, 0.0]])
    keypoints = torch.tensor([[[0.0, 0.0, 3.0]], [[3.0, 4.0, 0.0]]])
    right = torch.tensor([[[0.0, 0.0, 1.0]], [[0.0, 0.0, 0.0]]])
    assert float(direction_loss(right, points, keypoints[:, None], torch.arange(2))) == 0


def test_each_mode_by_hand() -> None:
    found = torch.tensor([[[0.0, 2.0, 0.0], [1.0, 0.0, 0.0]]])
    truth = torch.tensor([[[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]])
    by_hand = {"mse": (4 + 1) / 6, "l1": (2 + 1) / 6, "cosine": 1 / 2}
    for mode, expected in by_hand.items():
        loss = direction_loss(found, torch.zeros(1, 3), truth[:, None], torch.tensor([0]), mode)
        assert float(loss) == pytest.approx(expected)


def test_the_loss_by_hand() -> None:
    """Instance 0: two points, right and opposite; 1: one point, right under its second copy."""
    points = torch.zeros(3, 3)
    ahead, behind = torch.tensor([[1.0, 0, 0]]), torch.tensor([[-1.0, 0, 0]])
    copies = torch.stack([torch.stack([ahead, ahead]), torch.stack([ahead, behind])])
    found = torch.stack([ahead, behind, behind])
    loss = direction_loss(found, points, copies, torch.tensor([0, 0, 1]))
    assert float(loss) == pytest.approx(((0 + 4 / 3) / 2 + 0) / 2)


@pytest.mark.parametrize("mode", POINT_LOSSES)
def test_repeated_copies_change_no_loss(mode: str) -> None:
    points, found = random(20, 3, seed=0), random(20, 5, 3, seed=1)
    copies, instance = random(3, 4, 5, 3, seed=2), torch.arange(20) % 3
    padded = torch.cat([copies, copies[:, :2]], 1)
    torch.testing.assert_close(
        direction_loss(found, points, padded, instance, mode),
        direction_loss(found, points, copies, instance, mode),
    )


def test_one_copy_serves_a_whole_instance() -> None:
    """Half the points agree with one copy, half with the other: no mixture is right."""
    points = torch.zeros(2, 3)
    copies = torch.tensor([[[[1.0, 0, 0]], [[-1.0, 0, 0]]]])
    found = torch.tensor([[[1.0, 0, 0]], [[-1.0, 0, 0]]])
    loss = direction_loss(found, points, copies, torch.tensor([0, 0]))
    assert float(loss) == pytest.approx((0 + 4 / 3) / 2)


def test_an_instance_without_points_is_none_that_is_right() -> None:
    copies = torch.tensor([[[[0.0, 0, 1]]], [[[0.0, 1, 0]]], [[[1.0, 0, 0]]]])
    found = torch.tensor([[[0.0, 0, -1]], [[0.0, -1, 0]]])
    loss = direction_loss(found, torch.zeros(2, 3), copies, torch.tensor([0, 1]))
    assert float(loss) == pytest.approx(4 / 3)


def test_gradients_are_finite_on_a_keypoint_and_reach_no_truth() -> None:
    points = torch.zeros(2, 3)
    found = torch.zeros(2, 1, 3, requires_grad=True)
    copies = torch.zeros(1, 1, 1, 3)
    for mode in POINT_LOSSES:
        (gradient,) = torch.autograd.grad(
            direction_loss(found, points, copies, torch.tensor([0, 0]), mode), found
        )
        assert bool(gradient.isfinite().all())


def test_no_points_no_loss() -> None:
    found = torch.zeros(0, 2, 3, requires_grad=True)
    nothing = torch.zeros(0, dtype=torch.int64)
    loss = direction_loss(found, torch.zeros(0, 3), torch.zeros(1, 1, 2, 3), nothing)
    loss.backward()
    assert float(loss.detach()) == 0


def test_a_pose_that_looks_like_the_truth_costs_nothing() -> None:
    """Symmetries are motions in the model's frame, before the pose."""
    truth = Rigid(rotation_by(random(2, 3, seed=1)), random(2, 3, seed=2))
    turn = Rigid(rotation_by(random(3, seed=3)), random(3, seed=4))
    eye = Rigid(torch.eye(3).double(), torch.zeros(3).double())
    copies = Rigid.stack([Rigid.stack([eye, turn])] * 2)
    points_m = random(2, 20, 3, seed=5)
    alike = truth @ Rigid.stack([turn, turn])
    assert model_point_loss(alike, truth, points_m, copies).tolist() == pytest.approx([0, 0])
    other = Rigid.stack([turn, turn]) @ truth
    assert float(model_point_loss(other, truth, points_m, copies).min()) > 0.1


def test_the_loss_of_a_shifted_pose_is_its_shift() -> None:
    truth = Rigid(rotation_by(random(2, 3, seed=1)), random(2, 3, seed=2))
    shifted = Rigid(truth.R, truth.t_m + torch.tensor([0.0, 3.0, 4.0]))
    eye = Rigid(torch.eye(3).double()[None], torch.zeros(1, 3).double())
    copies = Rigid.stack([eye, eye])
    found = model_point_loss(shifted, truth, random(2, 20, 3, seed=5), copies)
    assert found.tolist() == pytest.approx([5, 5])
