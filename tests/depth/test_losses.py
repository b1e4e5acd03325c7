import math
from typing import Literal

import pytest
import torch

from depthpose.core.config import config_from_dict
from depthpose.core.errors import InputError
from depthpose.core.loop import Update
from depthpose.depth.augment import TrainingPair
from depthpose.depth.config import GeneratorConfig
from depthpose.depth.generators import UNetGenerator
from depthpose.depth.losses import (
    adversarial_loss,
    disparity_loss,
    heads_loss,
    log_disparity_loss,
    plane_loss,
    stereo_loss,
    view_loss,
)
from depthpose.depth.train import ViewTask
from depthpose.depth.train.config import FinetuneTraining, StereoTraining, ViewTraining

NAN = float("nan")
LOGITS = torch.tensor([2.0, -1.0]).reshape(1, 1, 1, 2)


def log1exp(x: float) -> float:
    return math.log(1 + math.exp(x))


def test_cross_entropy_by_hand() -> None:
    real = adversarial_loss(LOGITS, "vanilla", is_real=True)
    fake = adversarial_loss(LOGITS, "vanilla", is_real=False)
    assert float(real) == pytest.approx((log1exp(-2) + log1exp(1)) / 2, rel=1e-6)
    assert float(fake) == pytest.approx((log1exp(2) + log1exp(-1)) / 2, rel=1e-6)


def test_least_squares_by_hand() -> None:
    assert float(adversarial_loss(2 * LOGITS, "lsgan", is_real=True)) == pytest.approx((9 + 9) / 2)
    fake = adversarial_loss(2 * LOGITS, "lsgan", is_real=False)
    assert float(fake) == pytest.approx((16 + 4) / 2)


def updates_of(
    discriminator: Literal["patch", "none"], monkeypatch: pytest.MonkeyPatch
) -> list[Update]:
    """Updates by a drawn view of zeros, and a real one of 0.5 and -1."""
    config = ViewTraining(discriminator=discriminator)
    task = ViewTask(UNetGenerator(GeneratorConfig(width=1, levels=2)), config, None)
    monkeypatch.setattr(task.generator, "forward", torch.zeros_like)
    for name in set(task.modules) - {"generator"}:
        score = lambda _, view: LOGITS if bool(view.any()) else 3 * LOGITS  # noqa: E731
        monkeypatch.setattr(task.modules[name], "forward", score)
    right = torch.tensor([0.75, 0.0]).expand(1, 3, 1, 2)
    return list(task.step(TrainingPair(right, right, right[:, 0], right[:, 0])))


def test_the_discriminator_pays_half_of_both_mistakes(monkeypatch: pytest.MonkeyPatch) -> None:
    loss = updates_of("patch", monkeypatch)[0].loss
    real = (log1exp(-2) + log1exp(1)) / 2
    fake = (log1exp(6) + log1exp(-3)) / 2
    assert float(loss) == pytest.approx((real + fake) / 2, rel=1e-6)


def test_the_generator_is_paid_for_views_that_are_taken_for_real(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Not for those that the discriminator sees through: then it would learn to draw fakes."""
    update = updates_of("patch", monkeypatch)[1]
    taken_for_real = (log1exp(-6) + log1exp(3)) / 2
    assert float(update.facts["adversarial"]) == pytest.approx(taken_for_real, rel=1e-6)
    assert float(update.loss) == pytest.approx(taken_for_real + 75, rel=1e-6)


def test_l1_by_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    (update,) = updates_of("none", monkeypatch)
    assert float(update.facts["l1"]) == pytest.approx(0.75)
    assert float(update.loss) == pytest.approx(75)


def test_smooth_l1_by_hand() -> None:
    """0.5 x^2 within 1 px, |x| - 0.5 beyond; unknown, zero and out-of-range truth do not count."""
    found = torch.tensor([[[5.5, 8.0, 3.0, 3.0, 3.0]]])
    truth = torch.tensor([[[5.0, 5.0, NAN, 0.0, 96.0]]])
    assert float(disparity_loss(found, truth, 96)) == pytest.approx((0.125 + 2.5) / 2)


def test_the_sky_may_be_learnt_as_no_disparity() -> None:
    found, truth = torch.full((1, 1, 2), 3.0), torch.tensor([[[3.0, 0.0]]])
    assert float(disparity_loss(found, truth, 96)) == 0
    assert float(disparity_loss(found, truth, 96, sky_weight=1.0)) == pytest.approx(2.5 / 2)
    assert float(disparity_loss(found, truth, 96, sky_weight=0.25)) == pytest.approx(0.625 / 1.25)


def test_the_heads_weigh_a_half_seven_tenths_and_one() -> None:
    truth = torch.full((1, 1, 1), 5.0)
    heads = [truth + 1.5, truth + 2.5, truth + 3.5]
    assert float(heads_loss(heads, truth, 96)) == pytest.approx(0.5 * 1 + 0.7 * 2 + 1.0 * 3)


def test_the_last_of_fewer_heads_weighs_one_too() -> None:
    truth = torch.full((1, 1, 1), 5.0)
    heads = [truth + 2.5, truth + 3.5]
    assert float(heads_loss(heads, truth, 96)) == pytest.approx(0.7 * 2 + 1.0 * 3)
    assert float(heads_loss(heads[1:], truth, 96)) == pytest.approx(1.0 * 3)


def test_the_sky_weighs_as_a_disparity_or_as_a_class() -> None:
    truth = torch.tensor([[[5.0, 0.0]]])
    heads = [truth + 2.5]
    without_class = stereo_loss(heads, None, truth, 96, 0.25)
    assert without_class.sky is None
    assert float(without_class.total) == pytest.approx(2.0)  # both pixels are 2.5 px off
    with_class = stereo_loss(heads, torch.tensor([[[0.2, 0.7]]]), truth, 96, 0.25)
    sky = -(math.log(0.8) + math.log(0.7)) / 2
    assert with_class.sky is not None
    assert float(with_class.sky) == pytest.approx(sky, abs=1e-3)
    assert float(with_class.total) == pytest.approx(2.0 + 0.25 * sky, abs=1e-3)


def test_unknown_truth_gives_no_gradient_and_no_nan() -> None:
    found = torch.ones(1, 1, 3, requires_grad=True)
    disparity_loss(found, torch.tensor([[[NAN, 3.0, NAN]]]), 96).backward()
    assert found.grad is not None
    assert found.grad.flatten().tolist() == [0.0, -1.0, 0.0]


def test_no_truth_at_all_costs_nothing() -> None:
    found = torch.ones(1, 1, 3, requires_grad=True)
    loss = disparity_loss(found, torch.full((1, 1, 3), NAN), 96)
    loss.backward()
    assert float(loss.detach()) == 0


def test_the_error_of_the_logarithm_counts_each_image_alike() -> None:
    """Image 1 has one known pixel, off by a factor of e; image 2 has two, one off by e^4."""
    truth = torch.tensor([[[2.0, NAN, 0.0]], [[2.0, 4.0, NAN]], [[NAN, NAN, 0.0]]])
    found = torch.tensor([[[2.0, 9.0, 9.0]], [[2.0, 4.0, 9.0]], [[9.0, 9.0, 9.0]]]).log()
    found[0, 0, 0] += 1
    found[1, 0, 1] -= 4
    assert float(log_disparity_loss(found, truth, (0.5, 50.0))) == pytest.approx((1 + 2) / 2)


def test_truth_beyond_the_range_counts_as_its_end() -> None:
    truth, found = torch.tensor([[[100.0]]]), torch.tensor([[[math.log(50.0)]]])
    assert float(log_disparity_loss(found, truth, (0.5, 50.0))) == pytest.approx(0.0, abs=1e-6)


def test_cross_entropy_is_shared_between_two_planes() -> None:
    planes = torch.tensor([1.0, 2.0, 4.0, 8.0])
    shares = torch.tensor([0.1, 0.2, 0.3, 0.15, 0.25])  # sky, 1, 2, 4, 8 px
    logits = shares.log()[None, :, None, None].expand(1, 5, 1, 4)
    truth = torch.tensor([[[0.0, 2.0**1.5, NAN, 100.0]]])  # sky, between 2 and 4, unknown, far off
    expected = [-math.log(0.1), -(math.log(0.3) + math.log(0.15)) / 2, -math.log(0.25)]
    assert float(plane_loss(logits, truth, planes)) == pytest.approx(sum(expected) / 3, rel=1e-5)


def test_a_view_that_is_right_costs_nothing() -> None:
    views = torch.rand(2, 3, 4, 6, generator=torch.Generator().manual_seed(0))
    assert view_loss(views, views).tolist() == [0.0, 0.0]
    brighter = view_loss(views + 0.1, views)
    torch.testing.assert_close(brighter, torch.full((2,), 0.1), rtol=1e-4, atol=0)


def test_unknown_truth_gives_the_selecting_losses_no_nan() -> None:
    truth = torch.tensor([[[NAN, 3.0]]])
    found = torch.zeros(1, 1, 2, requires_grad=True)
    logits = torch.zeros(1, 5, 1, 2, requires_grad=True)
    loss = log_disparity_loss(found, truth, (0.5, 50.0))
    loss = loss + plane_loss(logits, truth, torch.tensor([1.0, 2.0, 4.0, 8.0]))
    loss.backward()
    for part in (found, logits):
        assert part.grad is not None
        assert bool(part.grad.isfinite().all())
        assert not bool(part.grad[..., 0].any())


@pytest.mark.parametrize("name", ["sky_weight", "encoder_rate"])
@pytest.mark.parametrize("value", [-0.1, 1.1])
def test_a_weight_that_is_no_share_is_refused(name: str, value: float) -> None:
    with pytest.raises(InputError, match=rf"{name} must be in \[0, 1\], got {value}"):
        config_from_dict({name: value}, StereoTraining, source="here")


@pytest.mark.parametrize(
    ("name", "value", "kind", "least"),
    [
        ("l1_weight", -3, FinetuneTraining, 0),
        ("l1_weight", -3, ViewTraining, 0),
        ("discriminator_width", -4, ViewTraining, 1),
    ],
)
def test_what_cannot_train_is_refused(name: str, value: int, kind: type, least: int) -> None:
    with pytest.raises(InputError, match=rf"{name} must be in \[{least}, inf\), got {value}"):
        config_from_dict({name: value}, kind, source="here")
