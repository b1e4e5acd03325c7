"""Where the disparities of a pair lie is measured, and they are searched there."""

import dataclasses
from functools import cache

import pytest
import torch
from torch import Tensor

from depthpose.core.camera import Camera, StereoRig
from depthpose.core.camera.pinhole import intrinsics
from depthpose.core.checkpoint import SHIPPED
from depthpose.depth.config import MatcherConfig
from depthpose.depth.estimator import FakestereoNet
from depthpose.depth.stereo import (
    DisparityRange,
    LightMatcher,
    SearchRange,
    choose_search_range,
    doubt_hidden,
    doubt_outside,
    measure_disparity_range,
    move_match_back,
    move_views,
)
from depthpose.depth.stereo.light_layers import correlation_volume, unit_groups
from depthpose.depth.types import DepthInput, Match

needs_weights = pytest.mark.skipif(
    not (SHIPPED / "default.safetensors").is_file(), reason="no weights ship yet"
)


@cache
def matcher(max_disparity_px: float | None = None) -> LightMatcher:
    config = MatcherConfig(max_disparity_px=max_disparity_px)
    found = FakestereoNet.load("default", config=config, use="pairs").matcher
    assert isinstance(found, LightMatcher)
    return found


def planes(near_px: int, far_px: int, width: int = 320, height: int = 96) -> tuple[Tensor, ...]:
    """A textured strip before a textured wall: left view, right view, true disparity."""
    generator = torch.Generator().manual_seed(3)
    # Coarse and fine, as surfaces are, so that it is seen in a small copy too.
    texture = torch.zeros(2, 3, height, 2 * width)
    for block in (2, 8, 24):
        noise = torch.rand(2, 3, height // block + 1, 2 * width // block + 1, generator=generator)
        larger = torch.nn.functional.interpolate(noise, scale_factor=float(block), mode="nearest")
        texture += larger[..., :height, : 2 * width] / 3
    wall, strip = texture
    start = width // 2
    is_near = (torch.arange(width) >= width // 2) & (torch.arange(width) < 3 * width // 4)
    left = torch.where(is_near, strip[..., start : start + width], wall[..., start : start + width])
    columns = torch.arange(width)
    right = wall[..., start + far_px : start + far_px + width].clone()
    shown = (columns + near_px >= width // 2) & (columns + near_px < 3 * width // 4)
    right[..., shown] = strip[..., start + near_px + columns[shown]]
    truth_px = torch.where(is_near, near_px, far_px).float().expand(height, width)
    return left, right, truth_px


def range_of(low_px: float, high_px: float, size: tuple[int, int] = (96, 320)) -> DisparityRange:
    return range_from(torch.full(size, high_px), low_px, high_px)


def range_from(
    left_px: Tensor, low_px: float, high_px: float, right_px: Tensor | None = None
) -> DisparityRange:
    """A range that a copy of these disparities has, all of them sure."""
    return DisparityRange(
        low_px=low_px,
        high_px=high_px,
        step_px=4.0,
        left_px=left_px,
        right_px=left_px if right_px is None else right_px,
        is_sure=torch.ones_like(left_px, dtype=torch.bool),
    )


def rig(width: int = 320, height: int = 96, apart_px: float = 0.0) -> StereoRig:
    K = intrinsics(558.0, 558.0, width / 2, height / 2)
    return StereoRig(
        width=width, height=height, K=K, baseline_m=0.1, cx_right_minus_left_px=apart_px
    )


@needs_weights
@pytest.mark.parametrize(("near_px", "far_px"), [(30, 6), (140, 20), (150, 110)])
def test_both_ends_of_a_pair_are_measured(near_px: int, far_px: int) -> None:
    left, right, _ = planes(near_px, far_px)
    measured = measure_disparity_range(matcher(), left, right, 0.0)
    assert measured.low_px <= far_px
    if far_px < 50:  # else the right view shows nothing of a third of the left one
        assert far_px <= measured.low_px + 3 * measured.step_px
    assert measured.high_px - 3 * measured.step_px <= near_px <= measured.high_px


@needs_weights
def test_black_borders_say_nothing_about_a_pair() -> None:
    """They match each other over the whole width."""
    left, right, _ = planes(30, 6)
    usual = measure_disparity_range(matcher(), left, right, 0.0)
    for view, columns in ((left, 16), (right, 24)):
        view[..., :columns] = 0.0
        view[..., -columns:] = 0.0
        view[..., -8:, :] = 0.0
    measured = measure_disparity_range(matcher(), left, right, 0.0)
    assert measured.high_px <= usual.high_px + measured.step_px
    assert not bool(measured.is_sure[:, :16].any())


@needs_weights
@pytest.mark.parametrize(("near_px", "far_px"), [(40, 10), (260, 180), (200, 24)])
def test_a_pair_is_matched_wherever_its_disparities_lie(near_px: int, far_px: int) -> None:
    left, right, truth_px = planes(near_px, far_px, width=640)
    net = FakestereoNet(matcher(), with_check=False)
    pair = DepthInput(name="planes", left=left, right=right, camera=None)
    found = net.estimate_input(pair)
    is_seen = truth_px <= torch.arange(640)
    is_seen[:, :320] &= torch.arange(320) >= far_px
    # The wall is hidden beside the strip where the right view sees the strip.
    hidden = (torch.arange(640) >= 320 - (near_px - far_px)) & (torch.arange(640) < 320)
    error_px = (found.disparity_px - truth_px).abs()[is_seen & ~hidden]
    assert float(error_px.median()) < 1
    assert float((error_px > 3).float().mean()) < 0.1
    assert not found.warning


@needs_weights
@pytest.mark.parametrize("high_px", [20.0, 90.0])
def test_streets_are_searched_from_infinity_on(high_px: float) -> None:
    """At the camera's usual size, through the disparities of training and those that are there."""
    camera = rig(1242, 375)
    search = choose_search_range(matcher(), range_of(0.0, high_px), (375, 1242), camera)
    trained_px = matcher().network_config.max_disparity_px
    assert search.first_px == 0
    usual = matcher().usual_search((375, 1242), camera)
    assert trained_px <= search.span_px <= usual.span_px
    assert search.end_in_images_px >= high_px
    assert search.scale == usual.scale


@needs_weights
def test_a_search_takes_no_more_memory_than_usual() -> None:
    camera = rig(1280, 720)
    usual = choose_search_range(matcher(), range_of(0.0, 100.0), (720, 1280), camera)
    for high_px in (200.0, 300.0, 450.0, 640.0):
        search = choose_search_range(matcher(), range_of(0.0, high_px), (720, 1280), camera)
        assert search.first_px <= 0
        assert search.end_in_images_px >= high_px
        voxels = search.scale**2 * search.span_px
        step = 1 + 36 / search.span_px  # disparities are searched in whole steps
        usual_voxels = usual.scale**2 * usual.span_px
        assert voxels <= step * usual_voxels * 1.001
        assert voxels >= 0.9 * usual_voxels, "a size smaller than need be loses detail"
    near = choose_search_range(matcher(), range_of(420.0, 540.0), (720, 1280), camera)
    assert near.scale == usual.scale, "a table at arm's length needs no smaller size"
    assert near.first_px > 0


@needs_weights
def test_what_lies_beyond_the_search_is_named_and_has_no_confidence() -> None:
    left, right, truth_px = planes(250, 16, width=640)
    net = FakestereoNet(matcher(60.0), with_check=False)
    pair = DepthInput(name="planes", left=left, right=right, camera=rig(640))
    found = net.estimate_input(pair)
    # At the camera's usual size a search holds more than what was asked for, but not 250 px.
    assert "disparities beyond" in found.warning
    assert "--max-disparity" in found.warning
    assert found.confidence is not None
    is_near = truth_px > 200
    assert float(found.confidence[is_near].median()) == 0
    assert float((found.confidence[is_near] > 0.1).float().mean()) < 0.02


@needs_weights
@pytest.mark.parametrize("limit_px", [150.0, 100.0])
def test_a_limit_within_the_search_counts(limit_px: float) -> None:
    """The search holds more than what is asked for, or all of it: a strip of 180, a wall of 120."""
    left, right, truth_px = planes(180, 120, width=640)
    pair = DepthInput(name="planes", left=left, right=right, camera=rig(640))
    free = FakestereoNet(matcher(), with_check=False).estimate_input(pair)
    found = FakestereoNet(matcher(limit_px), with_check=False).estimate_input(pair)
    assert free.warning == ""
    assert f"disparities beyond {limit_px:.0f} px" in found.warning
    assert found.confidence is not None
    assert free.confidence is not None
    is_beyond = found.disparity_px > limit_px
    assert bool(is_beyond[truth_px > limit_px].float().mean() > 0.9)
    assert not bool(found.confidence[is_beyond].any())
    assert bool((free.confidence[is_beyond] > 0.5).any())


@needs_weights
@pytest.mark.parametrize("with_confidence", [True, False])
def test_a_pair_is_warned_of_without_a_confidence_too(with_confidence: bool) -> None:
    left, right, _ = planes(250, 16, width=640)
    config = MatcherConfig(max_disparity_px=60.0, with_confidence=with_confidence)
    net = FakestereoNet.load("default", config=config, use="pairs", with_check=False)
    found = net.estimate_input(DepthInput(name="planes", left=left, right=right, camera=rig(640)))
    assert (found.confidence is not None) == with_confidence
    assert "disparities beyond 60 px" in found.warning


def test_doubt_leaves_what_was_searched() -> None:
    confidence = torch.full((2, 4), 0.9)
    match = Match(disparity_px=torch.full((2, 4), 50.0), confidence=confidence)
    coarse_px = torch.tensor([[0.0, 1, 2, 3], [0, 1, 2, 3]]) + 48
    measured = range_from(coarse_px, 0.0, 60.0)
    search = SearchRange(scale=1.0, first_px=0, span_px=128)
    kept = doubt_outside(match, measured, search)
    assert kept.warning == ""
    assert kept.confidence is not None
    assert torch.equal(kept.confidence, confidence)
    at_end = dataclasses.replace(match, disparity_px=torch.full((2, 4), 126.0))
    doubted = doubt_outside(at_end, measured, search)
    assert doubted.confidence is not None
    assert not bool(doubted.confidence.any()), "the last step may stand for all that is beyond"


def test_hidden_places_are_doubted_by_the_copy_of_the_right_view() -> None:
    """Where the right view sees a near strip, the wall behind it is hidden from it."""
    left_px = torch.full((4, 40), 2.0)
    right_px = left_px.clone()
    right_px[:, 10:20] = 12.0
    confidence = torch.ones(4, 40)
    confidence[:, 39] = 0.9
    match = Match(disparity_px=left_px, confidence=confidence)
    measured = range_from(left_px, 0.0, 20.0, right_px)
    doubted = doubt_hidden(match, measured).confidence
    assert doubted is not None
    hidden = torch.zeros(40, dtype=torch.bool)
    hidden[12:22] = True
    hidden[:2] = True  # outside the right view
    assert float(doubted[:, hidden].max()) < 0.51
    torch.testing.assert_close(doubted[:, ~hidden], confidence[:, ~hidden])
    unsure = dataclasses.replace(match, confidence=None)
    assert doubt_hidden(unsure, measured).confidence is None


@pytest.mark.parametrize("first", [0, 3, -2])
def test_a_volume_may_begin_anywhere(first: int) -> None:
    generator = torch.Generator().manual_seed(1)
    left, right = torch.randn(2, 1, 6, 3, 9, generator=generator).unbind()
    groups = unit_groups(left, 2), unit_groups(right, 2)
    found = correlation_volume(*groups, 4, first)
    for k in range(4):
        for x in range(9):
            at = x - (first + k)
            expected = torch.zeros(1, 2, 3)
            if 0 <= at < 9:
                expected = (groups[0][..., x] * groups[1][..., at]).sum(2)
            torch.testing.assert_close(found[:, :, k, :, x], expected)


@pytest.mark.parametrize("first_px", [-7, 0, 5])
def test_views_are_moved_and_their_match_moved_back(first_px: int) -> None:
    left = torch.rand(3, 4, 30)
    right = torch.rand(3, 4, 30)
    one, other = move_views(left, right, first_px)
    assert one.shape == other.shape
    added = max(-first_px, 0)
    for x in range(10, 25):
        d = 8
        # Disparity d of the given pair is d - first of the moved one.
        torch.testing.assert_close(one[..., x + added], left[..., x])
        torch.testing.assert_close(other[..., x + added - (d - first_px)], right[..., x - d])
    flat = torch.full(one.shape[1:], 8.0 - first_px)
    back = move_match_back(Match(disparity_px=flat, confidence=torch.ones_like(flat)), first_px)
    assert torch.equal(back.disparity_px, torch.full((4, 30), 8.0))
    assert back.confidence is not None
    assert int((back.confidence == 0).sum()) == 4 * max(first_px, 0)


@needs_weights
def test_principal_points_apart_move_the_search() -> None:
    """Infinity of such a rig has a negative disparity."""
    left, right, truth_px = planes(20, -25, width=320)
    net = FakestereoNet(matcher(), with_check=False)
    camera: Camera = rig(320, apart_px=30.0)
    pair = DepthInput(name="apart", left=left, right=right, camera=camera)
    found = net.estimate_input(pair)
    is_wall = truth_px < 0
    is_wall[:, 110:160] = False
    is_wall[:, 290:] = False
    error_px = (found.disparity_px - truth_px).abs()[is_wall]
    assert float(error_px.median()) < 1


@needs_weights
def test_the_left_right_check_takes_two_runs_more_and_searches_the_same(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The narrow copy is matched both ways anyway, and its range is that without the check."""
    left, right, _ = planes(40, 10)
    searches: list[SearchRange] = []
    run = LightMatcher.run

    def count(self: LightMatcher, left: Tensor, right: Tensor, search: SearchRange) -> Match:
        searches.append(search)
        return run(self, left, right, search)

    monkeypatch.setattr(LightMatcher, "run", count)
    plain = matcher().match(left, right)
    copy, _, search = searches
    searches.clear()
    config = MatcherConfig(with_left_right_check=True)
    checking = FakestereoNet.load("default", config=config, use="pairs").matcher
    assert isinstance(checking, LightMatcher)
    checked = checking.match(left, right)
    assert searches == [copy, copy, search, search]
    assert torch.equal(checked.disparity_px, plain.disparity_px)
