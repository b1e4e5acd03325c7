import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.nn import functional

from depthpose.core.camera import (
    Camera,
    StereoRig,
    back_project,
    crop_camera,
    pixel_grid,
    project,
    resize_camera,
)
from depthpose.core.camera.pinhole import check_intrinsics
from depthpose.core.errors import InputError

K = torch.tensor([[700.0, 3.0, 610.0], [0, 720.0, 170.0], [0, 0, 1]], dtype=torch.float64)
RIG = StereoRig(width=1242, height=375, K=K, baseline_m=0.54, cx_right_minus_left_px=12.5)
Change = tuple[str, float | int | torch.Tensor, str]


def points(*batch: int) -> torch.Tensor:
    spread = torch.rand(*batch, 3, dtype=torch.float64) - 0.5
    return spread * torch.tensor([8.0, 3.0, 0.0]) + torch.tensor([0, 0, 4.0]) + spread


@pytest.mark.parametrize("batch", [(5,), (2, 5), (2, 3, 5)])
def test_project_is_the_matrix_product_point_by_point(batch: tuple[int, ...]) -> None:
    points_m = points(*batch)
    for point, pixel in zip(
        points_m.reshape(-1, 3), project(points_m, K).reshape(-1, 2), strict=True
    ):
        u, v, w = (K @ point).tolist()
        assert pixel.tolist() == pytest.approx([u / w, v / w])


def test_a_point_on_the_axis_falls_on_the_principal_point() -> None:
    axis = torch.tensor([[0, 0, 2.0]], dtype=torch.float64)
    assert project(axis, K).tolist() == [[610, 170]]


@pytest.mark.parametrize("z", [0.0, -1.0])
def test_what_is_not_in_front_has_no_pixel_and_no_gradient(z: float) -> None:
    points_m = torch.tensor([[1.0, 1.0, z], [1.0, 1.0, 2.0]], requires_grad=True)
    pixels = project(points_m, K)
    assert pixels[0].isnan().all()
    pixels[1].sum().backward()
    assert points_m.grad is not None
    assert points_m.grad.isfinite().all()
    assert points_m.grad[0].tolist() == [0, 0, 0]


@pytest.mark.parametrize("batch", [(), (2,)])
def test_projecting_what_was_back_projected_gives_the_pixels(batch: tuple[int, ...]) -> None:
    depth_m = torch.rand(*batch, 4, 6, dtype=torch.float64) + 0.5
    points_m = back_project(depth_m, K)
    assert torch.equal(points_m[..., 2], depth_m)
    pixels = project(points_m.flatten(-3, -2), K)
    grid = pixel_grid(4, 6, dtype=torch.float64).reshape(-1, 2)
    torch.testing.assert_close(pixels, grid.expand_as(pixels))


def test_unknown_depth_has_no_point() -> None:
    assert back_project(torch.tensor([[torch.nan, 1.0]]), K).isnan().all(-1).tolist() == [
        [True, False]
    ]


def test_the_grid_counts_columns_first() -> None:
    assert pixel_grid(2, 3)[1].tolist() == [[0, 1], [1, 1], [2, 1]]


@given(st.integers(0, 40), st.integers(0, 30), st.integers(1, 200), st.integers(1, 100))
def test_a_crop_moves_pixels(left: int, top: int, width: int, height: int) -> None:
    window = crop_camera(RIG, left, top, width, height)
    points_m = points(5)
    moved = project(points_m, K) - torch.tensor([left, top], dtype=torch.float64)
    torch.testing.assert_close(project(points_m, window.K), moved)
    assert (window.width, window.height) == (width, height)
    assert isinstance(window, StereoRig)
    assert (window.baseline_m, window.cx_right_minus_left_px) == (0.54, 12.5)


@given(st.integers(1, 3000), st.integers(1, 3000))
def test_resizing_there_and_back_changes_nothing(width: int, height: int) -> None:
    back = resize_camera(resize_camera(RIG, width, height), 1242, 375)
    torch.testing.assert_close(back.K, RIG.K)
    assert back.cx_right_minus_left_px == pytest.approx(12.5)


def test_resizing_follows_the_image() -> None:
    # Each pixel holds its own coordinates; the scaled image must agree with the scaled camera.
    camera = Camera(width=40, height=20, K=torch.eye(3, dtype=torch.float64))
    coordinates = pixel_grid(20, 40, dtype=torch.float64).permute(2, 0, 1)[None]
    small = functional.interpolate(coordinates, (10, 10), mode="bilinear", align_corners=False)
    pixels = project(torch.cat([small[0], torch.ones_like(small[0, :1])]).flatten(1).T, camera.K)
    moved = pixels @ resize_camera(camera, 10, 10).K[:2, :2].T
    moved = moved + resize_camera(camera, 10, 10).K[:2, 2]
    torch.testing.assert_close(moved, pixel_grid(10, 10, dtype=torch.float64).reshape(-1, 2))


def test_metres_do_not_change_with_the_image() -> None:
    points_m = points(6)
    right_K = K.clone()
    right_K[0, 2] += RIG.cx_right_minus_left_px
    right = resize_camera(Camera(width=1242, height=375, K=right_K), 621, 125)
    left = resize_camera(RIG, 621, 125)
    shifted = points_m - points_m.new_tensor([left.baseline_m, 0, 0])
    disparity_px = (project(points_m, left.K) - project(shifted, right.K))[:, 0]
    depth_m = left.K[0, 0] * left.baseline_m / (disparity_px + left.cx_right_minus_left_px)
    torch.testing.assert_close(depth_m, points_m[:, 2])


def matrix(*rows: list[float]) -> torch.Tensor:
    return torch.tensor(rows, dtype=torch.float64)


BAD: list[Change] = [
    ("width", 0, "width is 0, but an image has 1 to"),
    ("height", -3, "height is -3, but an image has 1 to"),
    ("K", K.float(), r"K is of torch\.float32, not torch\.float64; pass K\.double\(\)"),
    ("K", K / 0, r"K is .*, not finite; write"),
    ("K", K * 2, r"K is .*; write \[\[fx, skew, cx\], \[0, fy, cy\], \[0, 0, 1\]\]"),
    ("K", matrix([7, 0, 0], [0, 7, 0], [6, 1, 1]), "it looks transposed; write"),
    ("K", matrix([0, 0, 6], [0, 7, 1], [0, 0, 1]), "has fx 0 and fy 7, but focal lengths are posi"),
    ("K", matrix([7, 0, 6], [0, -7, 1], [0, 0, 1]), "has fx 7 and fy -7"),
    ("depth_unit_m", 0.0, r"depth_unit_m is 0\.0, .*; 0\.001 means millimetres"),
    ("depth_unit_m", float("nan"), "depth_unit_m is nan"),
    ("baseline_m", 0.0, r"baseline_m is 0\.0, but the right camera stands at a positive x"),
    ("baseline_m", -0.5, r"baseline_m is -0\.5"),
    ("baseline_m", float("inf"), "baseline_m is inf"),
    ("baseline_m", 193.001, r"baseline_m is 193\.001, which looks like millimetres; divide by 10"),
    ("cx_right_minus_left_px", float("nan"), "cx_right_minus_left_px is nan; give pixels"),
]


@pytest.mark.parametrize(("name", "value", "said"), BAD)
def test_a_camera_that_cannot_be_is_refused(name: str, value: object, said: str) -> None:
    good = {"width": 1242, "height": 375, "K": K, "baseline_m": 0.54, "depth_unit_m": 0.001}
    with pytest.raises(InputError, match=said):
        StereoRig(**{**good, name: value})


def test_a_matrix_of_another_shape_is_refused() -> None:
    with pytest.raises(InputError, match=r"K is \(2, 3\), not 3x3; write \[\[fx, skew, cx\]"):
        check_intrinsics(K[:2])


def test_sizes_that_cannot_be_are_refused() -> None:
    with pytest.raises(InputError, match=r"window 1242x375 at \(1, 0\) does not lie inside the im"):
        crop_camera(RIG, 1, 0, 1242, 375)
    with pytest.raises(InputError, match="make it smaller"):
        crop_camera(RIG, 0, 0, 0, 5)
    with pytest.raises(InputError, match="cannot resize to 0x5; both sizes are 1 at least"):
        resize_camera(RIG, 0, 5)
