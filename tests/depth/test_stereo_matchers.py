"""What matchers take and refuse; the matcher of OpenCV; functions of the user's."""

import sys

import numpy as np
import pytest
import torch
from torch import Tensor

from depthpose.core.errors import InputError, MissingExtraError
from depthpose.depth.config import SGBMConfig
from depthpose.depth.stereo import CallableMatcher, SGBMMatcher, check_views, fill_holes

GOOD = torch.full((3, 8, 10), 0.5)
NAN = float("nan")


@pytest.mark.parametrize(
    ("left", "right", "text"),
    [
        (GOOD, GOOD[:, :7], "left image is 8x10 and right image 7x10; .*crop or resize both"),
        (GOOD, GOOD[:, :, :9], "left image is 8x10 and right image 8x9"),
        (GOOD[:, :0], GOOD, r"left image is empty: shape \(3, 0, 10\)"),
        (GOOD, GOOD[:, :, :0], "right image is empty"),
        (GOOD * NAN, GOOD, "left image holds NaN or infinite values"),
        (GOOD, GOOD / 0, "right image holds NaN or infinite values"),
        (GOOD * 255, GOOD, r"left image must lie in \[0, 1\], got 127.5 .. 127.5; divide 8-bit"),
        (GOOD - 1, GOOD, r"must lie in \[0, 1\], got -0.5"),
        (GOOD.to(torch.uint8), GOOD, "must be float in .*got torch.uint8; divide by 255"),
        (GOOD[0], GOOD, r"must have shape \(3, H, W\), got \(8, 10\)"),
        (GOOD[None], GOOD, "give one image at a time"),
        (GOOD.permute(1, 2, 0), GOOD, "move channels first"),
        (torch.ones(4, 8, 10), GOOD, "drop alpha"),
        (GOOD.numpy(), GOOD, "left image must be a tensor, got ndarray"),
        (None, GOOD, "left image must be a tensor, got NoneType"),
    ],
)
def test_unusable_pairs_are_refused_with_a_remedy(left: object, right: object, text: str) -> None:
    with pytest.raises(InputError, match=text):
        check_views(left, right)


def test_function_of_the_users_is_a_matcher() -> None:
    matcher = CallableMatcher(lambda left, right: left[0] + right[0])
    assert torch.equal(matcher.match(GOOD, GOOD).disparity_px, torch.ones(8, 10))


def test_function_may_ask_for_arrays() -> None:
    def match(left: np.ndarray, right: np.ndarray) -> np.ndarray:
        assert left.shape == right.shape == (8, 10, 3)
        return np.where(left[..., 0] > 0.6, 1, np.nan) if left.max() > 1 else np.ones((8, 10), int)

    matcher = CallableMatcher(match, with_numpy_images=True)
    assert torch.equal(matcher.match(GOOD, GOOD).disparity_px, torch.ones(8, 10))


@pytest.mark.parametrize(
    ("answer", "text"),
    [
        (torch.ones(8, 9), r"answered shape \(8, 9\) for images of \(8, 10\)"),
        (torch.full((8, 10), float("inf")), "infinite disparity; use NaN"),
        (torch.full((8, 10), NAN), "NaN for every pixel"),
        (-torch.ones(8, 10), "negative disparity .least -1 px.; is the pair swapped"),
        ("no", "answered str; let it answer a tensor or array"),
        (np.array(["a"]), "answered ndarray"),
    ],
)
def test_answers_that_are_no_disparity_are_refused(answer: object, text: str) -> None:
    with pytest.raises(InputError, match=text):
        CallableMatcher(lambda *_: answer).match(GOOD, GOOD)


def shifted_pair(shift_px: int) -> tuple[Tensor, Tensor]:
    """A textured wall seen by both cameras."""
    texture = torch.rand(3, 60, 200, generator=torch.Generator().manual_seed(0))
    return texture[..., :160], texture[..., shift_px : 160 + shift_px]


def test_sgbm_finds_the_shift_of_a_wall() -> None:
    pytest.importorskip("cv2")
    left, right = shifted_pair(12)
    found = SGBMMatcher(SGBMConfig(num_disparities=32)).match(left, right).disparity_px
    assert bool(found[:, :12].isnan().all())
    assert float(found[5:-5, 40:].nanmedian()) == pytest.approx(12, abs=0.1)


def test_sgbm_fills_what_it_did_not_match_and_says_where() -> None:
    pytest.importorskip("cv2")
    config = SGBMConfig(num_disparities=32, with_filled_holes=True)
    found = SGBMMatcher(config).match(*shifted_pair(12))
    assert bool(torch.isfinite(found.disparity_px).all())
    assert found.confidence is not None
    assert float(found.confidence[:, :12].max()) == 0
    assert float(found.confidence.max()) == 1


def test_sgbm_refuses_images_narrower_than_its_range() -> None:
    pytest.importorskip("cv2")
    with pytest.raises(InputError, match="10 px wide and num_disparities is 192"):
        SGBMMatcher().match(GOOD, GOOD)


def test_missing_opencv_says_which_extra_brings_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(MissingExtraError, match=r"pip install -e '.\[opencv\]'"):
        SGBMMatcher()


def test_holes_take_the_smaller_neighbour_and_empty_rows_the_nearest_row() -> None:
    holes = torch.tensor([[NAN] * 5, [NAN, 4, NAN, 2, NAN], [7, NAN, NAN, NAN, 9], [NAN] * 5])
    filled = fill_holes(holes)
    assert filled[1].tolist() == [4, 4, 2, 2, 2]
    assert filled[2].tolist() == [7, 7, 7, 7, 9]
    assert torch.equal(filled[0], filled[1])
    assert torch.equal(filled[3], filled[2])


def test_nothing_to_fill_from_is_an_error() -> None:
    with pytest.raises(InputError, match="no pixel was matched"):
        fill_holes(torch.full((2, 2), NAN))


def test_sgbm_config_refuses_nonsense() -> None:
    with pytest.raises(InputError, match="multiple of 16, got 100"):
        SGBMConfig(num_disparities=100)
