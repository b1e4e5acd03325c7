import dataclasses
import functools
from collections.abc import Callable

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.synthetic_street import make_street
from torch import Tensor

from depthpose.core.camera import StereoRig
from depthpose.core.errors import InputError
from depthpose.depth.augment import (
    TrainingPair,
    augment,
    crop_pair,
    flip_and_swap,
    jitter_colors,
    make_views_differ,
    pad_pair,
    scale_pair,
    shift_up,
)
from depthpose.depth.config import AugmentConfig, DegradeConfig
from depthpose.depth.disparity import right_disparity_from_left, warp_right_to_left


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def smooth_image(width: int, seed: int) -> Tensor:
    noise = torch.rand(1, 3, 8, 20, generator=generator(seed))
    return torch.nn.functional.interpolate(noise, (40, width), mode="bicubic")[0].clamp(0, 1)


def plane_pair(disparity_px: int = 6, seed: int = 0) -> TrainingPair:
    """A frontal plane: left[x] = right[x - d], so both views have disparity d."""
    wide = smooth_image(120 + disparity_px, seed)
    known = torch.full((40, 120), float(disparity_px))
    return TrainingPair(wide[..., :120], wide[..., disparity_px:], known, known.clone())


def photometric_error(pair: TrainingPair, left_px: Tensor) -> float:
    return float((warp_right_to_left(pair.right, left_px) - pair.left).abs().nanmean())


@pytest.mark.parametrize("disparity_px", [0, 3, 11])
def test_flip_and_swap_keeps_every_disparity(disparity_px: int) -> None:
    pair = plane_pair(disparity_px)
    flipped = flip_and_swap(pair)
    assert torch.equal(flipped.left_px, pair.right_px.flip(-1))
    assert photometric_error(flipped, flipped.left_px) < 1e-6
    for one, other in zip(flip_and_swap(flipped), pair, strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=0, equal_nan=True)


def test_a_flip_without_a_swap_would_break_the_pair() -> None:
    pair = plane_pair(8)
    broken = TrainingPair(*(part.flip(-1) for part in pair[:4]))
    assert photometric_error(broken, broken.left_px) > 0.02


def test_flip_and_swap_of_a_street_keeps_left_and_right_consistent() -> None:
    street = make_street(0.2)
    assert street.input.right is not None
    assert street.truth.disparity_px is not None
    unknown = torch.full_like(street.truth.disparity_px, torch.nan)
    pair = TrainingPair(street.input.left, street.input.right, street.truth.disparity_px, unknown)
    flipped = flip_and_swap(pair)
    assert bool(flipped.left_px.isnan().all()), "nobody knows the right view's disparity"
    assert torch.equal(flipped.right_px.flip(-1).nan_to_num(0), pair.left_px.nan_to_num(0))
    # The old left view, looked up in the new pair by the truth that is now the right view's.
    back = flip_and_swap(flipped)
    assert photometric_error(back, back.left_px) == photometric_error(pair, pair.left_px)


@settings(max_examples=25, deadline=None)
@given(st.floats(0.4, 2.0), st.integers(1, 12))
def test_scaling_scales_disparity_by_the_ratio_of_the_widths(scale: float, px: int) -> None:
    pair = plane_pair(px)
    scaled = scale_pair(pair, scale)
    ratio = scaled.left.shape[-1] / 120
    assert scaled.left_px.unique().tolist() == pytest.approx([px * ratio])
    assert abs(ratio - scale) <= 0.5 / 120 + 1e-9
    assert photometric_error(scaled, scaled.left_px) < 0.02


def test_scaling_never_mixes_known_with_unknown() -> None:
    pair = plane_pair(4)
    pair.left_px[::2] = torch.nan
    scaled = scale_pair(pair, 0.7)
    known = scaled.left_px[~scaled.left_px.isnan()]
    assert known.unique().tolist() == pytest.approx([4 * 84 / 120])


BASELINE_M = 0.5


@functools.cache
def street_pair() -> TrainingPair:
    """A street whose depth is known exactly, with the focal length of its rig."""
    street = make_street(0.2)
    rig, truth = street.input.camera, street.truth
    assert street.input.right is not None
    assert isinstance(rig, StereoRig)
    assert truth.disparity_px is not None
    right_px = right_disparity_from_left(truth.disparity_px)
    focal_px = rig.K[0, 0].float()
    return TrainingPair(
        street.input.left, street.input.right, truth.disparity_px, right_px, focal_px
    )


def depths_m(pair: TrainingPair) -> Tensor:
    """Depth of all pixels of the left view that have truth, as one row."""
    depth_m = pair.focal_px * BASELINE_M / pair.left_px
    return depth_m[torch.isfinite(depth_m)]


CHANGES: dict[str, Callable[[TrainingPair, torch.Generator], TrainingPair]] = {
    "scaled": lambda pair, drawn: scale_pair(pair, 0.5 + float(torch.rand((), generator=drawn))),
    "cropped": lambda pair, drawn: crop_pair(pair, (60, 150), drawn),
    "flipped twice": lambda pair, _: flip_and_swap(flip_and_swap(pair)),
    "recoloured": lambda pair, drawn: jitter_colors(pair, 0.3, drawn),
    "set apart": lambda pair, drawn: make_views_differ(
        pair, AugmentConfig(erased_share=1.0, misaligned_px=1.0), drawn
    ),
    "padded": lambda pair, _: pad_pair(pair, (90, 300)),
    "all, crop too wide": lambda pair, drawn: augment(
        pair, AugmentConfig(crop_px=(60, 300), scale=(0.8, 1.3), flip_share=0.0), drawn
    ),
    "all, crop too high": lambda pair, drawn: augment(
        pair, AugmentConfig(crop_px=(120, 100), scale=(0.8, 1.3), flip_share=0.0), drawn
    ),
}


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize("seed", range(4))
def test_depth_stays_what_it_was(change: str, seed: int) -> None:
    """Each depth after a change is one of before, and the views still agree with it."""
    pair = street_pair()
    changed = CHANGES[change](pair, generator(seed))
    before, after = depths_m(pair).sort().values, depths_m(changed)
    assert len(after) > 0.1 * len(before)
    place = torch.searchsorted(before, after).clamp(1, len(before) - 1)
    nearest = torch.minimum((before[place] - after).abs(), (before[place - 1] - after).abs())
    assert float((nearest / after).max()) < 1e-5
    error = (warp_right_to_left(changed.right, changed.left_px) - changed.left).abs()
    assert float(error.nanmedian()) < 0.05


def test_a_flip_keeps_the_depths_of_the_other_view() -> None:
    pair = street_pair()
    flipped = flip_and_swap(pair)
    mirrored = pair._replace(left_px=pair.right_px)
    assert torch.equal(depths_m(flipped).sort().values, depths_m(mirrored).sort().values)
    assert torch.equal(flip_and_swap(flipped).focal_px, pair.focal_px)


def test_a_pair_narrower_than_the_crop_keeps_its_focal_length() -> None:
    """It is padded; enlarged to the crop it would have another focal length, and be cut."""
    pair = street_pair()
    height, width = pair.left.shape[-2:]
    config = AugmentConfig(crop_px=(height, width + 70), jitter=0.0, flip_share=0.0)
    made = augment(pair, config, generator())
    assert torch.equal(made.focal_px, pair.focal_px)
    torch.testing.assert_close(made.left[..., :width], pair.left)
    torch.testing.assert_close(made.right[..., :width], pair.right)
    assert float(made.left[..., width:].abs().max()) == 0
    assert bool(made.left_px[:, width:].isnan().all())
    assert bool(made.right_px[:, width:].isnan().all())


def test_a_crop_that_would_be_mostly_black_is_refused() -> None:
    with pytest.raises(InputError, match=r"40x120 .* less than half of a crop of 40x241"):
        augment(plane_pair(), AugmentConfig(crop_px=(40, 241)), generator())
    assert augment(plane_pair(), AugmentConfig(crop_px=(80, 240)), generator()).left.shape[1] == 80


def test_a_crop_keeps_columns_together() -> None:
    pair = crop_pair(plane_pair(7), (20, 60), generator(3))
    assert pair.left.shape == (3, 20, 60)
    assert photometric_error(pair, pair.left_px) < 1e-6


def test_a_crop_that_does_not_fit_is_refused() -> None:
    with pytest.raises(InputError, match=r"crop of 41x10 .* does not fit into images of 40x120"):
        crop_pair(plane_pair(), (41, 10), generator())


def test_colours_change_alike_in_both_views() -> None:
    pair = plane_pair(5)
    changed = jitter_colors(pair, 0.2, generator(1))
    assert not torch.equal(changed.left, pair.left)
    assert photometric_error(changed, changed.left_px) < 1e-6
    assert changed.left.min() >= 0
    assert changed.left.max() <= 1


def test_each_colour_factor_stays_in_its_range() -> None:
    """On a grey image contrast and saturation do nothing, so brightness shows alone."""
    flat = torch.full((3, 4, 4), 0.4)
    unknown = torch.full((4, 4), torch.nan)
    pair = TrainingPair(flat, flat, unknown, unknown)
    seen = [float(jitter_colors(pair, 0.2, generator(s)).left.mean()) / 0.4 for s in range(200)]
    assert 0.8 - 1e-6 <= min(seen) < 0.83
    assert 1.17 < max(seen) <= 1.2 + 1e-6


def test_augmentation_follows_its_generator() -> None:
    config = AugmentConfig(crop_px=(20, 60), scale=(0.8, 1.3))
    pair = plane_pair(6)
    one, again, other = (augment(pair, config, generator(s)) for s in (1, 1, 2))
    assert torch.equal(one.left, again.left)
    assert not torch.equal(one.left, other.left)
    for seed in range(20):
        made = augment(pair, config, generator(seed))
        assert photometric_error(made, made.left_px) < 0.03


def test_flips_come_at_their_share() -> None:
    config = AugmentConfig(crop_px=(40, 120), jitter=0.0)
    pair = plane_pair(6)
    marked = TrainingPair(pair.left, pair.right, pair.left_px, pair.right_px + 1)
    flips = [float(augment(marked, config, generator(s)).left_px[0, 0]) == 7 for s in range(200)]
    assert 70 < sum(flips) < 130
    never = dataclasses.replace(config, flip_share=0.0)
    assert all(augment(marked, never, generator(s)).left_px[0, 0] == 6 for s in range(20))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"crop_px": (0, 5)}, "crop_px must be in"),
        ({"scale": (0.0, 1.0)}, "scale must be"),
        ({"scale": (2.0, 1.0)}, "scale must be"),
        ({"scale": (100.0, 100.0)}, r"scale must be in \(0, 10\]"),
        ({"jitter": 1.0}, "jitter must be in"),
        ({"flip_share": 1.5}, "flip_share must be in"),
        ({"erased_share": -0.1}, "erased_share must be in"),
        ({"misaligned_px": 10.0}, "misaligned_px must be in"),
    ],
)
def test_bad_settings_are_refused(changes: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        AugmentConfig(**changes)  # pyright: ignore[reportArgumentType]


def test_rows_of_one_view_are_off_in_proportion() -> None:
    image = torch.arange(20.0)[None, :, None].expand(3, 20, 9).contiguous()
    torch.testing.assert_close(shift_up(image, 2.0, 2.0)[:, :-2], image[:, 2:], rtol=0, atol=1e-4)
    turned = shift_up(image, -1.0, 1.0)[0, 10] - 10
    torch.testing.assert_close(turned, torch.linspace(-1, 1, 9), rtol=0, atol=1e-4)


def test_a_patch_of_the_right_view_is_erased() -> None:
    pair = street_pair()
    found = make_views_differ(pair, AugmentConfig(erased_share=1.0), generator(0))
    assert torch.equal(found.left, pair.left)
    changed = (found.right != pair.right).any(0)
    height, width = changed.shape
    sides = (int(changed.any(1).sum()) / height, int(changed.any(0).sum()) / width)
    assert all(1 / 6 - 0.02 < side < 1 / 3 + 0.02 for side in sides), sides
    assert found.right[:, changed].unique(dim=1).shape[1] == 1


def test_views_are_degraded_each_on_its_own() -> None:
    pair = street_pair()._replace(right=street_pair().left)
    config = AugmentConfig(per_view=DegradeConfig(color=0.3, hue_share=0.0))
    found = make_views_differ(pair, config, generator(3))
    assert not torch.allclose(found.left, found.right, atol=0.02)
    assert torch.equal(found.left_px.nan_to_num(-1.0), pair.left_px.nan_to_num(-1.0))
    assert make_views_differ(pair, AugmentConfig(), generator(3)) == pair


def test_no_scale_is_drawn_at_which_half_of_the_crop_would_be_black() -> None:
    """A pair of 112 rows at 0.5 has 56, less than half of a crop of 128."""
    images, px = torch.rand(3, 112, 373), torch.full((112, 373), 5.0)
    pair = TrainingPair(images, images, px, px)
    config = AugmentConfig(crop_px=(128, 128), scale=(0.5, 1.2))
    for seed in range(40):
        cropped = augment(pair, config, torch.Generator().manual_seed(seed))
        assert cropped.left.shape == (3, 128, 128)
