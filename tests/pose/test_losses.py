import math

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from depthpose.pose.losses import (
    CONFIDENCE_SCALE_RAD,
    POINT_LOSSES,
    choose_copies,
    confidence_loss,
    confidence_target,
    direction_loss,
    instance_means,
    point_losses,
    unit_directions,
)


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_directions_have_length_one_or_none() -> None:
    points = torch.tensor([[0.0, 0.0, 1.0], [3.0, 4.0, 0.0]])
    keypoints = torch.tensor([[[0.0, 0.0, 3.0]], [[3.0, 4.0, 0.0]]])
    assert unit_directions(points, keypoints).tolist() == [[[0, 0, 1]], [[0, 0, 0]]]


def test_each_mode_by_hand() -> None:
    found = torch.tensor([[[0.0, 2.0, 0.0], [1.0, 0.0, 0.0]]])
    truth = torch.tensor([[[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]])
    assert float(point_losses(found, truth, "mse")) == pytest.approx((4 + 1) / 6)
    assert float(point_losses(found, truth, "l1")) == pytest.approx((2 + 1) / 6)
    assert float(point_losses(found, truth, "cosine")) == pytest.approx(1 / 2)


def test_instances_count_alike_whatever_their_size() -> None:
    means = instance_means(torch.tensor([1.0, 3.0, 5.0]), torch.tensor([0, 0, 2]), 3)
    assert means.tolist() == [2, 0, 5]


def test_the_loss_by_hand() -> None:
    """Instance 0: two points, right and opposite; 1: one point, right under its second copy."""
    points = torch.zeros(3, 3)
    ahead, behind = torch.tensor([[1.0, 0, 0]]), torch.tensor([[-1.0, 0, 0]])
    copies = torch.stack([torch.stack([ahead, ahead]), torch.stack([ahead, behind])])
    found = torch.stack([ahead, behind, behind])
    loss = direction_loss(found, points, copies, torch.tensor([0, 0, 1]))
    assert float(loss) == pytest.approx(((0 + 4 / 3) / 2 + 0) / 2)
    assert choose_copies(found, points, copies, torch.tensor([0, 0, 1])).tolist() == [0, 1]


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
    still = found.detach()
    assert float(confidence_loss(torch.zeros(0, 2), still, still)) == 0


def test_trust_is_one_for_a_right_vote_and_a_half_at_the_scale() -> None:
    turned = torch.tensor([math.cos(CONFIDENCE_SCALE_RAD), math.sin(CONFIDENCE_SCALE_RAD), 0])
    truth = torch.tensor([1.0, 0, 0]).expand(1, 3, 3)
    found = torch.stack([3 * truth[0, 0], turned, -truth[0, 0]])[None]
    target = confidence_target(found, truth)[0]
    backwards = 1 / (1 + (math.pi / CONFIDENCE_SCALE_RAD) ** 2)
    assert target.tolist() == pytest.approx([1, 0.5, backwards], rel=1e-5)


def test_the_confidence_pays_cross_entropy_and_leaves_the_vote_alone() -> None:
    found = torch.tensor([[[1.0, 0, 0]]], requires_grad=True)
    logits = torch.tensor([[0.7]], requires_grad=True)
    loss = confidence_loss(logits, found, torch.tensor([[[1.0, 0, 0]]]))
    assert float(loss.detach()) == pytest.approx(-math.log(1 / (1 + math.exp(-0.7))))
    loss.backward()
    assert found.grad is None
    assert logits.grad is not None
    assert float(logits.grad) == pytest.approx(float(F.sigmoid(torch.tensor(0.7))) - 1)
