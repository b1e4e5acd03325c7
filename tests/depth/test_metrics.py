import math

import pytest
import torch

from depthpose.core.errors import InputError
from depthpose.depth.metrics import (
    error_by_decile,
    garg_crop,
    measure,
    score_confidence,
    sparsification_area,
    view_errors,
)


def test_the_truth_has_no_error() -> None:
    truth = torch.rand(100) * 80 + 1
    assert list(measure("depth", truth, truth).values()) == [0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0]


def test_depth_errors_of_a_worked_example() -> None:
    errors = measure("depth", torch.tensor([2.0, 10.0]), torch.tensor([1.0, 10.0]))
    assert errors["abs_rel"] == 0.5
    assert errors["sq_rel"] == 0.5
    assert errors["rmse"] == pytest.approx(math.sqrt(0.5))
    assert errors["rmse_log"] == pytest.approx(math.log(2) / math.sqrt(2))
    assert (errors["d1"], errors["d2"], errors["d3"]) == (0.5, 0.5, 0.5)


def test_the_thresholds_are_strict() -> None:
    errors = measure("depth", torch.tensor([1.25]), torch.tensor([1.0]))
    assert (errors["d1"], errors["d2"]) == (0.0, 1.0)


def test_relative_errors_do_not_change_with_the_unit() -> None:
    predicted, truth = torch.rand(50) + 1, torch.rand(50) + 1
    one, other = measure("depth", predicted, truth), measure("depth", 8 * predicted, 8 * truth)
    assert one["abs_rel"] == pytest.approx(other["abs_rel"])
    assert one["rmse_log"] == pytest.approx(other["rmse_log"])
    assert 8 * one["rmse"] == pytest.approx(other["rmse"])


def test_the_order_of_pixels_does_not_matter() -> None:
    predicted, truth = torch.rand(5000) + 1, torch.rand(5000) + 1
    turned = measure("depth", predicted.flip(0), truth.flip(0))
    assert turned["abs_rel"] == pytest.approx(
        measure("depth", predicted, truth)["abs_rel"], rel=1e-12
    )


@pytest.mark.parametrize(
    ("predicted", "truth", "message"),
    [
        ([], [], "no pixel to compare"),
        ([0.0], [1.0], "predicted depth holds values that are not positive"),
        ([math.nan], [1.0], "predicted depth"),
        ([1.0], [math.inf], "true depth"),
    ],
)
def test_unusable_depth_is_refused(
    predicted: list[float], truth: list[float], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        measure("depth", torch.tensor(predicted), torch.tensor(truth))


def test_a_pixel_is_bad_when_off_by_both_measures() -> None:
    truth = torch.tensor([10.0, 10.0, 100.0, 100.0])
    errors = measure("disparity", truth + torch.tensor([3.0, 3.1, 4.9, 5.1]), truth)
    assert errors["d1_all"] == 0.5
    assert errors["epe_px"] == pytest.approx(4.025, rel=1e-6)


def test_disparity_without_pixels_is_refused() -> None:
    with pytest.raises(InputError, match="no pixel to compare"):
        measure("disparity", torch.zeros(0), torch.zeros(0))


@pytest.mark.parametrize(
    ("size", "rows", "columns"),
    [
        ((375, 1242), (153, 371), (44, 1197)),
        ((370, 1224), (151, 366), (43, 1180)),
        ((374, 1238), (152, 370), (44, 1193)),
        ((370, 1226), (151, 366), (44, 1181)),
        ((376, 1241), (153, 372), (44, 1196)),
    ],
)
def test_the_crop_of_each_size(
    size: tuple[int, int], rows: tuple[int, int], columns: tuple[int, int]
) -> None:
    inside = garg_crop(*size).nonzero()
    assert inside.amin(0).tolist() == [rows[0], columns[0]]
    assert inside.amax(0).tolist() == [rows[1] - 1, columns[1] - 1]
    assert len(inside) == (rows[1] - rows[0]) * (columns[1] - columns[0])


def test_an_oracle_leaves_no_area() -> None:
    error = torch.rand(500)
    assert sparsification_area(error, -error) == pytest.approx(0, abs=1e-9)


def test_a_good_confidence_beats_a_constant_which_beats_a_false_one() -> None:
    error = torch.rand(2000)
    good = -error + 0.1 * torch.randn(2000)
    areas = [sparsification_area(error, c) for c in (good, torch.ones(2000), error)]
    assert areas[0] < areas[1] < areas[2]


def test_the_area_of_a_constant_is_that_under_the_oracle() -> None:
    error = torch.linspace(0, 1, 1001)
    area = sparsification_area(error, torch.ones(1001))
    assert area == pytest.approx(0.49, abs=0.01)  # remaining error 1 against (1 - removed)


@pytest.mark.parametrize(("count", "left"), [(3, 2), (5, 3)])
def test_the_area_of_a_worked_example(count: int, left: int) -> None:
    """None is removed, then a half: what is left is rounded up."""
    error = torch.tensor([1.0, 2.0, 6.0, 7.0, 9.0])[:count]
    area = sparsification_area(error, error, steps=2)
    worst = error[-left:].mean()
    oracle = error[:left].mean()
    assert area == pytest.approx(float((worst - oracle) / error.mean()) / 2)


def test_ties_do_not_depend_on_the_order() -> None:
    error = torch.rand(100)
    confidence = (torch.rand(100) * 4).round()
    turned = sparsification_area(error.flip(0), confidence.flip(0))
    assert sparsification_area(error, confidence) == pytest.approx(turned)


def test_no_error_has_no_area() -> None:
    assert sparsification_area(torch.zeros(4), torch.rand(4)) == 0.0


def test_sparsification_without_pixels_is_refused() -> None:
    with pytest.raises(InputError, match="no pixel to compare"):
        sparsification_area(torch.zeros(0), torch.zeros(0))


def test_a_confidence_stands_between_oracle_and_chance() -> None:
    error = torch.rand(2000)
    oracle, chance = score_confidence(error, -error), score_confidence(error, torch.ones(2000))
    assert (oracle["ause"], oracle["ause_share"]) == (0.0, 0.0)
    assert chance["ause_share"] == 1.0
    assert score_confidence(error, error)["ause_share"] > 1
    assert 0 < score_confidence(error, torch.rand(2000) - error)["ause_share"] < 1
    assert oracle["ause_random"] == chance["ause"]


def test_equal_errors_leave_nothing_to_order() -> None:
    assert score_confidence(torch.ones(50), torch.rand(50))["ause_share"] == 0.0


def test_deciles_of_a_worked_example() -> None:
    error = torch.arange(20.0).flip(0)
    expected = [18.5 - 2 * k for k in range(10)]
    assert error_by_decile(error, torch.arange(20.0)).tolist() == expected


def test_deciles_of_an_ignorant_confidence_are_equal() -> None:
    assert error_by_decile(torch.arange(20.0), torch.zeros(20)).tolist() == [9.5] * 10


def test_deciles_without_pixels_are_nan() -> None:
    deciles = error_by_decile(torch.ones(3), torch.rand(3))
    assert int(torch.isnan(deciles).sum()) == 7


def test_the_mean_of_full_deciles_is_the_mean_error() -> None:
    error = torch.rand(500)
    mean = float(error_by_decile(error, torch.rand(500)).mean())
    assert mean == pytest.approx(float(error.double().mean()))


def test_a_drawn_view_is_compared_by_hand() -> None:
    real = torch.zeros(3, 2, 3)
    real[:, :, 1] = 1.0
    drawn = real / 2
    found = view_errors(drawn, real)
    assert found["right_l1"] == pytest.approx(0.5 / 3)
    assert found["right_psnr_db"] == pytest.approx(-10 * math.log10(0.25 / 3))
    assert found["right_sharpness"] == pytest.approx(0.5)
    assert view_errors(real, real)["right_psnr_db"] == pytest.approx(120)
