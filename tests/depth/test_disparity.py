import pytest
import torch
from torch import Tensor

from depthpose.core.camera import Camera, StereoRig
from depthpose.core.camera.pinhole import intrinsics
from depthpose.depth.disparity import (
    apply_to_maps,
    depth_from_disparity,
    depth_std_from_confidence,
    disparity_from_depth,
    resize_match,
    right_disparity_from_left,
    size_at_focal_length,
    warp_right_to_left,
)
from depthpose.depth.types import Match


def rig(offset_px: float = 0.0, f: float = 100.0) -> StereoRig:
    K = torch.tensor([[f, 0, 20], [0, f, 10], [0, 0, 1]], dtype=torch.float64)
    return StereoRig(width=40, height=20, K=K, baseline_m=0.5, cx_right_minus_left_px=offset_px)


def test_depth_of_a_worked_example() -> None:
    disparity_px = torch.tensor([[5.0, 50.0]])
    assert depth_from_disparity(disparity_px, rig()).tolist() == [[10.0, 1.0]]
    assert depth_from_disparity(disparity_px, rig(offset_px=5.0))[0, 0].item() == 5.0


def test_the_deviation_of_depth_is_what_that_of_its_disparity_does_to_it() -> None:
    """At the confidence of 0.3 a tenth of the disparity, and of the surest 0.2 px."""
    disparity_px = torch.tensor([[2.0, 10.0, 40.0]]).double()
    depth_m = depth_from_disparity(disparity_px, rig())
    for sure, deviation_px in ((0.3, 0.1 * disparity_px), (1.0, torch.full((1, 3), 0.2))):
        confidence = torch.full_like(disparity_px, sure)
        found_m = depth_std_from_confidence(depth_m, confidence, rig())
        step_px = 1e-4 * deviation_px
        moved_m = (depth_m - depth_from_disparity(disparity_px + step_px, rig())) / 1e-4
        torch.testing.assert_close(found_m, moved_m, rtol=1e-3, atol=0)


@pytest.mark.parametrize("offset_px", [-6.0, 6.0])
def test_principal_points_do_not_change_the_deviation_of_depth(offset_px: float) -> None:
    """They shift the disparities of the images, below zero even, and not how sure a match is."""
    depth_m = torch.tensor([[2.0, 10.0, 40.0, torch.nan]])
    confidence = torch.full_like(depth_m, 0.3)
    torch.testing.assert_close(
        depth_std_from_confidence(depth_m, confidence, rig(offset_px)),
        depth_std_from_confidence(depth_m, confidence, rig()),
        equal_nan=True,
    )


def test_pixels_that_are_not_square_become_so() -> None:
    """A wheel is round at the size where both focal lengths are alike."""
    squeezed = Camera(width=640, height=480, K=intrinsics(400, 800, 319.5, 239.5))
    assert size_at_focal_length(squeezed, 800.0) == (480, 1280)


@pytest.mark.parametrize("offset_px", [0.0, 7.5])
def test_disparity_and_depth_undo_each_other(offset_px: float) -> None:
    disparity_px = torch.rand(6, 7) * 90 + 1
    there = depth_from_disparity(disparity_px, rig(offset_px))
    torch.testing.assert_close(disparity_from_depth(there, rig(offset_px)), disparity_px)


@pytest.mark.parametrize("value", [0.0, -3.0, torch.nan])
def test_no_depth_without_positive_disparity(value: float) -> None:
    assert bool(torch.isnan(depth_from_disparity(torch.tensor([[value]]), rig())).all())
    assert bool(torch.isnan(disparity_from_depth(torch.tensor([[value]]), rig())).all())


def test_resizing_keeps_the_depth_of_a_slanted_plane() -> None:
    plane = torch.linspace(10, 20, 32).expand(16, 32).contiguous()
    half = resize_match(Match(disparity_px=plane), 8, 16).disparity_px
    inner = (plane[::2, 0::2] + plane[::2, 1::2]) / 2
    torch.testing.assert_close(half, inner / 2)


def test_resizing_in_one_direction_scales_disparity_by_the_columns() -> None:
    px = torch.full((6, 8), 12.0)
    assert torch.equal(resize_match(Match(disparity_px=px), 3, 8).disparity_px, px[:3])
    narrow = resize_match(Match(disparity_px=px), 6, 4).disparity_px
    assert torch.equal(narrow, torch.full((6, 4), 6.0))


def test_resizing_to_its_own_size_changes_nothing() -> None:
    disparity_px = torch.rand(5, 9)
    same = resize_match(Match(disparity_px=disparity_px), 5, 9)
    assert torch.equal(same.disparity_px, disparity_px)


def test_a_resized_or_cropped_match_keeps_its_warning() -> None:
    match = Match(disparity_px=torch.rand(5, 9), warning="it rained")
    assert resize_match(match, 10, 18).warning == "it rained"
    cropped = apply_to_maps(match, lambda values: values[1:])
    assert (cropped.disparity_px.shape, cropped.confidence) == ((4, 9), None)
    assert cropped.warning == "it rained"


def test_warping_by_zero_is_the_identity() -> None:
    right = torch.rand(3, 6, 8)
    torch.testing.assert_close(warp_right_to_left(right, torch.zeros(6, 8)), right)


@pytest.mark.parametrize("shift", [1, 3])
def test_warping_by_whole_pixels_moves_columns(shift: int) -> None:
    right = torch.rand(3, 6, 8)
    warped = warp_right_to_left(right, torch.full((6, 8), float(shift)))
    torch.testing.assert_close(warped[..., shift:], right[..., :-shift])
    assert bool(torch.isnan(warped[..., :shift]).all())


def test_warping_lets_gradient_reach_the_disparity() -> None:
    disparity_px = torch.full((4, 8), 1.5, requires_grad=True)
    warped = warp_right_to_left(torch.rand(3, 4, 8), disparity_px)
    warped.nan_to_num(0.0).sum().backward()
    assert isinstance(disparity_px.grad, Tensor)
    assert bool(torch.isfinite(disparity_px.grad).all())


def test_both_views_of_one_surface_agree() -> None:
    left_px, right_px = torch.full((4, 9), 2.0), torch.full((4, 9), 2.0)
    right_px[:, 5] = 4.0
    difference = (left_px - warp_right_to_left(right_px[None], left_px)[0]).abs()
    assert bool(torch.isnan(difference[:, :2]).all())
    assert difference[0, 2:].tolist() == [0, 0, 0, 0, 0, 2, 0]


def test_disparity_is_carried_to_the_right_view_and_back() -> None:
    """Mirrored, the right view's disparity is a left one's: carried again, it is ours."""
    left_px = torch.full((4, 40), 3.0)
    left_px[:, 20:26] = 8.0
    right_px = right_disparity_from_left(left_px)
    assert right_px[0, 12:18].tolist() == [8.0] * 6
    assert right_px[0, 18:23].isnan().tolist() == [True] * 5, "seen by the right view alone"
    back = right_disparity_from_left(right_px.flip(-1)).flip(-1)
    is_known = torch.isfinite(back)
    assert torch.equal(back[is_known], left_px[is_known])
    assert bool(is_known[0, 20:26].all())


def test_the_nearest_point_hides_those_behind_it() -> None:
    left_px = torch.full((1, 10), torch.nan)
    left_px[0, 5], left_px[0, 7] = 2.0, 4.0
    assert right_disparity_from_left(left_px)[0, 3] == 4.0
    assert int(torch.isfinite(right_disparity_from_left(left_px)).sum()) == 1


def test_points_outside_the_right_view_are_dropped() -> None:
    left_px = torch.tensor([[5.0, torch.nan, 1.0]])
    right_px = right_disparity_from_left(left_px)
    assert right_px[0, 1] == 1.0
    assert right_px[0, [0, 2]].isnan().all()


def test_a_point_lands_on_the_pixel_nearest_to_its_place() -> None:
    left_px = torch.full((1, 12), torch.nan)
    left_px[0, 10], left_px[0, 6] = 1.3, 1.6  # at 8.7 and 4.4 of the right view
    known = right_disparity_from_left(left_px)[0].isfinite().nonzero().flatten().tolist()
    assert known == [4, 9]
