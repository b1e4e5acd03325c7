import math
import re
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
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


def moved(image: torch.Tensor, degrees: float, scale: float) -> torch.Tensor:
    """Turn and enlarge an image about its centre."""
    height, width = image.shape[1:]
    v, u = torch.meshgrid(torch.arange(height).float(), torch.arange(width).float(), indexing="ij")
    x, y = (u + 0.5 - width / 2) / scale, (v + 0.5 - height / 2) / scale
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return sample(image, c * x + s * y + width / 2 - 0.5, c * y - s * x + height / 2 - 0.5).clamp(
        0, 1
    )


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


@pytest.mark.parametrize("down_px", [-6, 30, 120])
def test_an_offset_of_any_size_is_measured(down_px: int) -> None:
    report = check_rectified(*pair(down_px))
    assert report.is_rectified is False
    assert report.vertical_offset_px == pytest.approx(down_px, abs=0.2)


@pytest.mark.parametrize("degrees", [0.6, -1.0, 8.0])
def test_a_small_rotation_is_recognised(degrees: float) -> None:
    report = check_rectified(*pair(turn_rad=math.radians(degrees)))
    assert report.is_rectified is False
    assert report.is_swapped is False
    assert report.vertical_spread_px > 0.75
    found = re.search(r"turned by ([+-][\d.]+) degrees and scaled by", report.message)
    assert found is not None, report.message
    assert float(found[1]) == pytest.approx(-degrees, abs=0.15)


@pytest.mark.parametrize("degrees", [15.0, -45.0, 75.0, -90.0])
def test_a_large_rotation_is_named(degrees: float) -> None:
    left, right = pair()
    report = check_rectified(left, moved(right, degrees, 1.0))
    assert report.is_rectified is False
    found = re.search(r"turned by (?:about )?([+-]?[\d.]+) degrees", report.message)
    assert found is not None, report.message
    assert float(found[1]) == pytest.approx(degrees, abs=2)


@pytest.mark.parametrize("scale", [0.7, 1.05, 1.5])
def test_another_scale_is_named(scale: float) -> None:
    left, right = pair()
    report = check_rectified(left, moved(right, 0.0, scale))
    assert report.is_rectified is False
    found = re.search(r"scaled by (?:about )?([\d.]+\d)", report.message)
    assert found is not None, report.message
    assert float(found[1]) == pytest.approx(scale, abs=0.03)


@pytest.mark.parametrize(
    ("flip", "how"),
    [((2,), "mirrored"), ((1, 2), "upside down"), ((1,), "mirrored top to bottom")],
)
def test_a_flip_is_named(flip: tuple[int, ...], how: str) -> None:
    left, right = pair()
    report = check_rectified(left, right.flip(flip))
    assert report.is_rectified is False
    assert f"the right image is {how} beside the left one; turn it back" in report.message


def test_a_wide_image_is_scaled_down_and_measured_in_its_own_pixels() -> None:
    left, right = pair(1.5, height=300, width=480)
    wide = [
        functional.interpolate(i[None], scale_factor=4, mode="bicubic")[0] for i in (left, right)
    ]
    report = check_rectified(wide[0].clamp(0, 1), wide[1].clamp(0, 1))
    assert report.vertical_offset_px == pytest.approx(6, abs=0.4)


def test_brightness_and_contrast_do_not_matter() -> None:
    left, right = pair()
    report = check_rectified(left, right * 0.4 + 0.3)
    assert report.is_rectified is True


STRIPES = (torch.arange(200) % 8 / 8).expand(3, 120, 200)
TILES = texture(40, 40).repeat(1, 4, 8)


@pytest.mark.parametrize(
    ("left", "right"),
    [
        (torch.rand(3, 5, 6), torch.rand(3, 5, 6)),
        (torch.full((3, 120, 200), torch.nan), torch.full((3, 120, 200), torch.nan)),
        (STRIPES, STRIPES.roll(3, 2)),
        (TILES[..., 8:], TILES[..., :-8]),
        (torch.linspace(0, 1, 200).expand(3, 120, 200), torch.rand(3, 1, 200).expand(3, 120, 200)),
    ],
    ids=["tiny", "nan", "stripes", "tiles", "columns"],
)
def test_where_too_little_matches_it_cannot_tell(left: torch.Tensor, right: torch.Tensor) -> None:
    report = check_rectified(left, right)
    assert report.is_rectified is None
    assert report.is_swapped is None
    assert not report.is_wrong
    assert report.matches < 25
    assert "cannot tell whether the pair is rectified" in report.message


@pytest.mark.parametrize("seed", [1, 2])
def test_images_of_two_scenes_do_not_belong_together(seed: int) -> None:
    report = check_rectified(texture(240, 480), texture(240, 480, seed))
    assert report.is_pair is False
    assert f"not belong together: {report.matches} of {report.corners} corners" in report.message


def test_noise_does_not_belong_together() -> None:
    generator = torch.Generator().manual_seed(0)
    left, right = torch.rand(2, 3, 120, 200, generator=generator)
    report = check_rectified(left, right)
    assert report.is_pair is False
    assert "the images do not belong together: 0 of 200 corners" in report.message


@pytest.mark.parametrize("grey", [0.0, 0.5, 1.0])
def test_an_image_that_shows_nothing_is_named(grey: float) -> None:
    blank, image = torch.full((3, 240, 480), grey), pair()[0]
    dark = blank + 0.02 * torch.rand(3, 240, 480)
    for left, right, side in ((blank, dark, "left"), (image, blank, "right")):
        report = check_rectified(left, right)
        assert report.is_pair is False
        assert f"the {side} image shows nothing that could be matched" in report.message


def test_one_view_twice_is_no_pair() -> None:
    left, _ = pair()
    assert check_rectified(left, left).message.startswith("left and right are the same picture")
    file = BytesIO()
    Image.fromarray((255 * left).byte().permute(1, 2, 0).numpy()).save(file, "JPEG", quality=60)
    saved = torch.from_numpy(np.array(Image.open(file))).permute(2, 0, 1) / 255
    noise = 0.05 * torch.randn(left.shape, generator=torch.Generator().manual_seed(0))
    for again in (saved, (left + noise).clamp(0, 1), left * 0.6, left**1.5):
        report = check_rectified(left, again)
        assert report.is_pair is False
        assert "left and right show the same view" in report.message
        assert "lies within 0.5 px of its place" in report.message


def test_a_wall_is_a_pair() -> None:
    """All of it has one disparity, which is not that of one view twice."""
    wide = texture(240, 500)
    report = check_rectified(wide[..., :480], wide[..., 3:483])
    assert (report.is_pair, report.is_rectified, report.is_swapped) == (True, True, False)


@pytest.mark.parametrize("apart_px", [-150.0, 40.0, 66.0])
def test_known_principal_points_apart_are_no_swap(apart_px: float) -> None:
    left, right = pair()
    cut = int(abs(apart_px))
    if apart_px < 0:
        left, right = left[..., :-cut], right[..., cut:]
    else:
        left, right = left[..., cut:], right[..., :-cut]
    good, swapped = (
        check_rectified(left, right, apart_px), check_rectified(right, left, -apart_px)
    )  # fmt: skip
    assert (good.is_rectified, good.is_swapped) == (True, False)
    assert (swapped.is_rectified, swapped.is_swapped) == (True, True)


def test_images_of_two_sizes_are_refused() -> None:
    with pytest.raises(
        InputError, match="the left image is 6x5 but the right one 7x5; both images"
    ):
        check_rectified(torch.zeros(3, 5, 6), torch.zeros(3, 5, 7))


@pytest.mark.data
@pytest.mark.parametrize("step", [72, pytest.param(3, marks=pytest.mark.slow)])
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
