"""The fine speed of a generator that selects: an image is looked at in two sizes."""

import math

import pytest
import torch
from tests.depth.constant_selection import BASELINE_M, FOCAL_PX, sure_of

from depthpose.core.camera import Camera
from depthpose.core.errors import InputError
from depthpose.depth.config import SelectionConfig, Speed
from depthpose.depth.estimator import FakestereoNet
from depthpose.depth.synthesis import SelectionSynthesiser
from depthpose.depth.synthesis.selection import Selected, average


def depth_m(plane: int, speed: Speed, focal_px: float) -> torch.Tensor:
    """Depth by a network that says the same disparity of every pixel, whatever the size."""
    K = torch.tensor([[focal_px, 0, 95.5], [0, focal_px, 63.5], [0, 0, 1]], dtype=torch.float64)
    camera = Camera(width=192, height=128, K=K)
    net = FakestereoNet(None, SelectionSynthesiser(sure_of(plane), speed=speed))
    found = net.estimate(torch.rand(3, 128, 192), camera)
    assert found.depth_m is not None
    return found.depth_m


@pytest.mark.parametrize(
    ("plane", "speed", "focal_px", "disparity_px"),
    [
        (3, "fine", 2 * FOCAL_PX, 4 / math.sqrt(1.4)),  # 4 px in both, so 4 / 1.4 in the larger
        (3, "quick", 2 * FOCAL_PX, 4.0),
        (3, "fine", 1.3 * FOCAL_PX, 4.0),  # the larger would have more pixels than the image
        (4, "fine", 2 * FOCAL_PX, 8.0),  # the larger cannot say more than 8 / 1.4
    ],
)
def test_what_both_sizes_say_is_averaged(
    plane: int, speed: Speed, focal_px: float, disparity_px: float
) -> None:
    expected = torch.full((128, 192), FOCAL_PX * BASELINE_M / disparity_px)
    torch.testing.assert_close(depth_m(plane, speed, focal_px), expected, rtol=0.01, atol=0)


def test_an_average_keeps_the_confidence_of_the_first() -> None:
    def seen(disparity_px: float, sky: float, confidence: float) -> Selected:
        return Selected(*(torch.full((1, 2, 3), v) for v in (disparity_px, sky, confidence)))

    found = average([seen(4.0, 0.9, 0.7), seen(9.0, 0.3, 0.2)], [80.0, 40.0])
    torch.testing.assert_close(found.disparity_px, torch.full((1, 2, 3), 6.0))
    torch.testing.assert_close(found.sky, torch.full((1, 2, 3), 0.6))
    torch.testing.assert_close(found.confidence, torch.full((1, 2, 3), 0.7))
    alone = average([seen(35.0, 0.9, 0.7), seen(9.0, 0.3, 0.2)], [80.0, 40.0])
    torch.testing.assert_close(alone.disparity_px, torch.full((1, 2, 3), 35.0))
    torch.testing.assert_close(alone.sky, torch.full((1, 2, 3), 0.9))


@pytest.mark.parametrize("scales", [(), (1.4,), (1.0, 0.0), (1.0, 5.0)])
def test_scales_begin_with_the_size_of_the_training(scales: tuple[float, ...]) -> None:
    with pytest.raises(InputError, match="scales must begin with 1"):
        SelectionConfig(scales=scales)
