import math
from pathlib import Path

import pytest
import torch
from torch.nn import functional

from depthpose.core.camera import check_rectified
from depthpose.core.errors import InputError
from depthpose.core.files import read_image


def texture(height: int, width: int, seed: int = 0) -> torch.Tensor:
    """Make smooth noise of several scales: corners everywhere, nothing repeats."""
    generator = torch.Generator().manual_seed(seed)
    layers = [
        functional.interpolate(
            torch.rand(1, 3, height // step + 2, width // step + 2, generator=generator),
            (height, width),
            mode="bicubic",
            align_corners=False,
        )
        for step in (3, 6, 20)
    ]
    return torch.stack(layers).mean(0)[0].clamp(0, 1)


def sample(image: torch.Tensor, u: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
    height, width = image.shape[1:]
    grid = torch.stack([(2 * u + 1) / width - 1, (2 * v + 1) / height - 1], -1)
    return functional.grid_sample(image[None], grid[None], "bicubic", "border", False)[0]


def pair(
    down_px: float = 0, turn_rad: float = 0, height: int = 240, width: int = 480
) -> tuple[torch.Tensor, torch.Tensor]:
    """Make a left image and what a camera to its right sees of a slanted floor."""
    v, u = torch.meshgrid(torch.arange(height).float(), torch.arange(width).float(), indexing="ij")
    x, y = u - width / 2, v - height / 2
    cosine, sine = math.cos(turn_rad), math.sin(turn_rad)
    seen_u, seen_v = cosine * x - sine * y + width / 2, sine * x + cosine * y + height / 2
    seen_v = seen_v - down_px
    left = texture(height, width)
    return left, sample(left, seen_u + 5 + 40 * seen_v / height, seen_v).clamp(0, 1)


def test_a_good_pair_passes() -> None:
    report = check_rectified(*pair())
    assert report.is_rectified is True
    assert report.is_swapped is False
    assert report.positive_share == 1
    assert abs(report.vertical_offset_px) < 0.1
    assert report.vertical_spread_px < 0.2
    assert report.message.startswith("rows agree to 0.0 px")


def test_a_swapped_pair_is_recognised() -> None:
    left, right = pair()
    report = check_rectified(right, left)
    assert report.is_swapped is True
    assert report.is_rectified is True
    assert report.positive_share == 0
    assert "left and right look swapped (only 0% of disparities are positive)" in report.message
    assert "exchange the two images" in report.message


@pytest.mark.parametrize("down_px", [2.0, -2.0, 4.5])
def test_a_vertical_offset_is_recognised_and_measured(down_px: float) -> None:
    report = check_rectified(*pair(down_px))
    assert report.is_rectified is False
    assert report.is_swapped is False
    assert report.vertical_offset_px == pytest.approx(down_px, abs=0.1)
    assert f"the right image lies {down_px:+.1f} px lower" in report.message
    assert "rectify the pair" in report.message


@pytest.mark.parametrize("degrees", [0.6, -1.0])
def test_a_small_rotation_is_recognised(degrees: float) -> None:
    report = check_rectified(*pair(turn_rad=math.radians(degrees)))
    assert report.is_rectified is False
    assert report.is_swapped is False
    assert report.vertical_spread_px > 0.75


def test_a_wide_image_is_scaled_down_and_measured_in_its_own_pixels() -> None:
    left, right = pair(1.5, height=300, width=480)
    wide = [
        functional.interpolate(i[None], scale_factor=4, mode="bicubic")[0] for i in (left, right)
    ]
    report = check_rectified(*(i.clamp(0, 1) for i in wide))
    assert report.vertical_offset_px == pytest.approx(6, abs=0.4)


def test_brightness_and_contrast_do_not_matter() -> None:
    left, right = pair()
    report = check_rectified(left, right * 0.4 + 0.3)
    assert report.is_rectified is True


@pytest.mark.parametrize(
    ("left", "right"),
    [
        (torch.zeros(3, 120, 200), torch.zeros(3, 120, 200)),
        (texture(120, 200), texture(120, 200, seed=1)),
        (torch.rand(3, 120, 200), torch.rand(3, 120, 200)),
        (torch.rand(3, 5, 6), torch.rand(3, 5, 6)),
        (torch.full((3, 120, 200), torch.nan), torch.full((3, 120, 200), torch.nan)),
        ((torch.arange(200) % 8 / 8).expand(3, 120, 200),) * 2,
        (texture(480, 60).repeat(1, 1, 2), texture(480, 60).repeat(1, 1, 2)),
    ],
    ids=["black", "unrelated", "noise", "tiny", "nan", "stripes", "repeated"],
)
def test_where_too_little_matches_it_cannot_tell(left: torch.Tensor, right: torch.Tensor) -> None:
    report = check_rectified(left, right)
    assert report.is_rectified is None
    assert report.is_swapped is None
    assert report.matches < 25
    assert "cannot tell whether the pair is rectified" in report.message


def test_one_image_twice_has_an_unknown_order() -> None:
    left, _ = pair()
    report = check_rectified(left, left)
    assert report.is_rectified is True
    assert report.is_swapped is None
    assert math.isnan(report.positive_share)


def test_images_of_two_sizes_are_refused() -> None:
    with pytest.raises(
        InputError, match="the left image is 6x5 but the right one 7x5; both images"
    ):
        check_rectified(torch.zeros(3, 5, 6), torch.zeros(3, 5, 7))


@pytest.mark.data
@pytest.mark.parametrize("step", [24, pytest.param(1, marks=pytest.mark.slow)])
def test_no_real_pair_raises_a_false_alarm_and_every_swap_is_seen(real: Path, step: int) -> None:
    lefts = sorted((real / "depth/street_pairs").glob("*/left/*"))[::step]
    assert lefts
    for left_path in lefts:
        right_path = left_path.parents[1] / "right" / left_path.name
        left, right = read_image(left_path), read_image(right_path)
        good, swapped = check_rectified(left, right), check_rectified(right, left)
        assert (good.is_rectified, good.is_swapped) == (True, False), (left_path, good)
        assert (swapped.is_rectified, swapped.is_swapped) == (True, True), (left_path, swapped)
        lower = check_rectified(left, right.roll(2, 1))
        assert lower.is_rectified is False, (left_path, lower)
