"""OpenCV's matcher, the user's own, and what is no pair."""

import importlib

import numpy as np
import pytest
import torch
from torch import Tensor

from depthpose.core.errors import InputError, MissingExtraError
from depthpose.depth.config import SGBMConfig
from depthpose.depth.stereo import CallableMatcher, Matcher, SGBMMatcher, check_pair, fill_holes

NAN = torch.nan


def shifted_pair(shift: int = 12) -> tuple[Tensor, Tensor]:
    """A wide texture seen from two places ``shift`` px apart."""
    wide = torch.rand(3, 60, 300 + shift, generator=torch.Generator().manual_seed(0))
    return wide[..., :300].contiguous(), wide[..., shift:].contiguous()


def test_sgbm_finds_a_constant_shift() -> None:
    left, right = shifted_pair()
    match = SGBMMatcher(SGBMConfig(num_disparities=32)).match(left, right)
    found = match.disparity_px[torch.isfinite(match.disparity_px)]
    assert found.numel() > 0.5 * match.disparity_px.numel()
    assert float((found - 12).abs().median()) < 0.1
    assert bool(torch.isnan(match.disparity_px[:, :31]).all())


def test_filled_holes_leave_none_and_say_which() -> None:
    left, right = shifted_pair()
    match = SGBMMatcher(SGBMConfig(num_disparities=32, with_filled_holes=True)).match(left, right)
    assert bool(torch.isfinite(match.disparity_px).all())
    assert match.confidence is not None
    assert set(match.confidence.unique().tolist()) == {0.0, 1.0}


def literal_fill(row: list[float]) -> list[float]:
    filled = list(row)
    for i, value in enumerate(row):
        if np.isnan(value):
            before = [v for v in row[:i] if not np.isnan(v)][-1:]
            after = [v for v in row[i:] if not np.isnan(v)][:1]
            filled[i] = min(before + after)
    return filled


@pytest.mark.parametrize("seed", range(5))
def test_a_hole_takes_the_smaller_neighbour_of_its_row(seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    disparity_px = torch.rand(6, 15, generator=generator)
    disparity_px[torch.rand(6, 15, generator=generator) < 0.6] = NAN
    disparity_px[:, 7] = 0.5  # every row has a value
    expected = [literal_fill(row) for row in disparity_px.tolist()]
    torch.testing.assert_close(fill_holes(disparity_px), torch.tensor(expected))


def test_an_empty_row_takes_the_nearest_row() -> None:
    disparity_px = torch.tensor([[1.0, 1.0], [NAN, NAN], [NAN, NAN], [5.0, 5.0]])
    assert fill_holes(disparity_px)[:, 0].tolist() == [1.0, 1.0, 5.0, 5.0]


def test_nothing_to_fill_from_is_refused() -> None:
    with pytest.raises(InputError, match="no pixel was matched"):
        fill_holes(torch.full((3, 3), NAN))


def test_an_image_narrower_than_the_range_is_refused() -> None:
    with pytest.raises(InputError, match="take a smaller multiple of 16"):
        SGBMMatcher().match(torch.zeros(3, 20, 100), torch.zeros(3, 20, 100))


def test_without_opencv_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(name: str) -> None:
        raise ImportError(name)

    monkeypatch.setattr(importlib, "import_module", refuse)
    with pytest.raises(MissingExtraError, match=r"pip install 'depthpose\[opencv\]'"):
        SGBMMatcher()


@pytest.mark.parametrize("with_numpy_images", [False, True])
def test_a_function_is_a_matcher(with_numpy_images: bool) -> None:
    def answer(left: Tensor | np.ndarray, right: Tensor | np.ndarray) -> np.ndarray:
        assert isinstance(left, np.ndarray) == with_numpy_images
        assert left.shape == ((4, 5, 3) if with_numpy_images else (3, 4, 5))
        return np.full((4, 5), 7, np.int32)

    matcher = CallableMatcher(answer, with_numpy_images=with_numpy_images)
    assert isinstance(matcher, Matcher)
    match = matcher.match(torch.zeros(3, 4, 5), torch.zeros(3, 4, 5))
    assert match.disparity_px.unique().tolist() == [7.0]


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        ("text", "answered str; let it answer a tensor or array"),
        (torch.zeros(2, 2), r"answered shape \(2, 2\) for images of \(4, 5\)"),
        (torch.full((4, 5), torch.inf), "answered infinite disparity"),
        (torch.full((4, 5), NAN), "answered NaN for every pixel"),
        (torch.full((4, 5), -1.0), "answered negative disparity.*is the pair swapped"),
    ],
)
def test_an_answer_that_is_no_disparity_is_refused(answer: object, message: str) -> None:
    with pytest.raises(InputError, match=message):
        CallableMatcher(lambda _, __: answer).match(torch.zeros(3, 4, 5), torch.zeros(3, 4, 5))


GOOD = torch.zeros(3, 8, 9)


@pytest.mark.parametrize(
    ("right", "message"),
    [
        (torch.zeros(3, 8, 10), "left image is 8x9 and right image 8x10"),
        (torch.zeros(8, 9), r"must have shape \(3, H, W\), got \(8, 9\)"),
        (torch.zeros(1, 3, 8, 9), "match pairs one by one"),
        (torch.zeros(4, 8, 9), "drop alpha"),
        (torch.zeros(3, 8, 9, dtype=torch.uint8), "float in .0, 1., got torch.uint8; divide by"),
        (torch.zeros(3, 0, 9), "is empty"),
        (torch.full((3, 8, 9), NAN), "NaN or infinite"),
        (torch.full((3, 8, 9), 200.0), "must lie in .0, 1., got 200"),
        (-torch.ones(3, 8, 9), "do not normalise: the matcher does"),
    ],
)
def test_what_is_no_pair_is_refused(right: Tensor, message: str) -> None:
    with pytest.raises(InputError, match=message):
        check_pair(GOOD, right)


@pytest.mark.parametrize(
    ("knobs", "message"),
    [
        ({"num_disparities": 100}, "multiple of 16"),
        ({"block_size": 4}, "odd and positive"),
        ({"p1": 900, "p2": 800}, "0 < p1 < p2"),
    ],
)
def test_settings_that_opencv_would_misread_are_refused(
    knobs: dict[str, int], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        SGBMConfig(**knobs)  # pyright: ignore[reportArgumentType]
