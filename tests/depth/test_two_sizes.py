"""The fine speed of a generator that selects: an image is looked at in two sizes."""

import math

import pytest
import torch
from tests.depth.constant_selection import BASELINE_M, FOCAL_PX, sure_of

from depthpose.core.camera import Camera
from depthpose.depth.config import Speed
from depthpose.depth.estimator import FakestereoNet
from depthpose.depth.synthesis import SelectionSynthesiser, ViewEstimate, average_sizes
from depthpose.depth.types import DepthInput


def two_sizes(plane: int, speed: Speed = "fine") -> FakestereoNet:
    """A network that says the same disparity of every pixel, whatever the size."""
    return FakestereoNet(None, SelectionSynthesiser(sure_of(plane), speed=speed))


def depth_m(plane: int, speed: Speed, focal_px: float) -> torch.Tensor:
    K = torch.tensor([[focal_px, 0, 95.5], [0, focal_px, 63.5], [0, 0, 1]], dtype=torch.float64)
    camera = Camera(width=192, height=128, K=K)
    found = two_sizes(plane, speed).estimate(torch.rand(3, 128, 192), camera)
    assert found.depth_m is not None
    return found.depth_m


@pytest.mark.parametrize(
    ("plane", "speed", "focal_px", "disparity_px"),
    [
        (2, "fine", 2 * FOCAL_PX, 2 / math.sqrt(1.4)),  # 2 px in both, so 2 / 1.4 in the larger
        (2, "quick", 2 * FOCAL_PX, 2.0),
        (2, "fine", 1.3 * FOCAL_PX, 2.0),  # the larger would have more pixels than the image
        (3, "fine", 2 * FOCAL_PX, 4.0),  # the larger cannot say much more: 8 / 1.4 at most
    ],
)
def test_what_both_sizes_say_is_averaged(
    plane: int, speed: Speed, focal_px: float, disparity_px: float
) -> None:
    expected = torch.full((128, 192), FOCAL_PX * BASELINE_M / disparity_px)
    torch.testing.assert_close(depth_m(plane, speed, focal_px), expected, rtol=0.01, atol=0)


def test_an_average_is_as_sure_as_the_first() -> None:
    def seen(disparity_px: float, sky: float, sure: float) -> ViewEstimate:
        return ViewEstimate(*(torch.full((1, 2, 3), v) for v in (disparity_px, sky, sure)))

    found = average_sizes([seen(4.0, 0.9, 0.7), seen(9.0, 0.3, 0.2)], [80.0, 40.0])
    torch.testing.assert_close(found.disparity_px, torch.full((1, 2, 3), 6.0))
    torch.testing.assert_close(found.sky, torch.full((1, 2, 3), 0.6))
    torch.testing.assert_close(found.confidence, torch.full((1, 2, 3), 0.7))
    alone = average_sizes([seen(35.0, 0.9, 0.7), seen(9.0, 0.3, 0.2)], [80.0, 40.0])
    torch.testing.assert_close(alone.disparity_px, torch.full((1, 2, 3), 35.0))
    torch.testing.assert_close(alone.sky, torch.full((1, 2, 3), 0.9))


@pytest.mark.parametrize(
    ("size", "focal_px", "sizes"),
    [
        ((192, 128), (240.0, 240.0), [(64, 96), (90, 134)]),
        ((192, 128), (240.0, 150.0), [(102, 96)]),  # 150 px are fewer than 1.4 x 120
    ],
)
def test_a_larger_size_needs_the_pixels_along_both_sides(
    size: tuple[int, int], focal_px: tuple[float, float], sizes: list[tuple[int, int]]
) -> None:
    K = torch.diag(torch.tensor([*focal_px, 1.0], dtype=torch.float64))
    camera = Camera(width=size[0], height=size[1], K=K)
    image = DepthInput(name="a", left=torch.rand(3, size[1], size[0]), right=None, camera=camera)
    assert two_sizes(3).virtual_sizes(image) == sizes


@pytest.mark.parametrize("kind", [torch.float16, torch.bfloat16, torch.float64])
def test_an_image_of_other_numbers_is_taken(kind: torch.dtype) -> None:
    camera = Camera(width=192, height=128, K=torch.diag(torch.tensor([240.0, 240.0, 1.0]).double()))
    image = DepthInput(name="a", left=torch.rand(3, 128, 192).to(kind), right=None, camera=camera)
    found = two_sizes(3).estimate_input(image)
    assert found.depth_m is not None
    assert found.depth_m.dtype == torch.float32
