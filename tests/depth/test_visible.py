"""What an image shows nothing of has no depth, and no confidence."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from depthpose import FakestereoNet
from depthpose.core.camera import StereoRig
from depthpose.depth.stereo import CallableMatcher
from depthpose.depth.triangulation import estimate_from_pair, estimate_from_virtual
from depthpose.depth.types import DepthInput, Match
from depthpose.depth.visible import find_blank_borders, measure_texture

H, W = 96, 160


def noise() -> Tensor:
    return 0.1 + 0.8 * torch.rand(3, H, W, generator=torch.Generator().manual_seed(0))


def bars(image: Tensor, value: float, top: int = 12, bottom: int = 12) -> Tensor:
    image = image.clone()
    image[:, :top] = value
    image[:, H - bottom :] = value
    return image


def wedge(image: Tensor) -> Tensor:
    """Black where column and row are small, as a turned view leaves it, and a dark spot within."""
    is_black = torch.arange(W) + 2 * torch.arange(H)[:, None] < 60
    image = torch.where(is_black, 0.0, image)
    image[:, 60:64, 100:104] = 0
    return image


@pytest.mark.parametrize("value", [0.0, 16 / 255, 1.0])
def test_bars_are_no_picture(value: float) -> None:
    blank = find_blank_borders(bars(noise(), value))
    assert bool(blank[:12].all())
    assert bool(blank[-12:].all())
    assert not bool(blank[14:-14].any())
    assert torch.equal(find_blank_borders(bars(noise(), value).mT), blank.mT)


def test_what_rectification_leaves_black_is_no_picture() -> None:
    blank = find_blank_borders(wedge(noise()))
    is_black = torch.arange(W) + 2 * torch.arange(H)[:, None] < 60
    assert bool(blank[is_black].all())
    assert not bool(blank[60:64, 100:104].any()), "a dark thing in the picture"
    assert float(blank.float().mean()) < 1.2 * float(is_black.float().mean())


def tree(image: Tensor, column: int) -> Tensor:
    """A dark tree at the upper border, through whose leaves the sky is seen."""
    leaves = torch.rand(30, 40, generator=torch.Generator().manual_seed(2)) < 0.8
    crown = image[:, :30, column : column + 40]
    crown[:, leaves] = 0
    return image


def car(image: Tensor) -> Tensor:
    """A black car that the lower border cuts, a third as wide as the image."""
    image[:, 70:, 50:104] = 0
    return image


@pytest.mark.parametrize(
    "image",
    [
        tree(noise(), 0),
        tree(noise(), 60),
        car(noise()),
        bars(noise(), 1.0, bottom=0),  # an over-exposed sky
        bars(noise(), 0.5, bottom=0),  # a drawn one
        torch.zeros(3, H, W),
        torch.ones(3, H, W),
        noise(),
        torch.linspace(0.2, 0.8, W).expand(3, H, -1),
    ],
    ids=[
        "tree in a corner",
        "tree",
        "car",
        "white above",
        "grey above",
        "black",
        "white",
        "noise",
        "ramp",
    ],
)
def test_a_picture_has_no_blank_border(image: Tensor) -> None:
    assert not bool(find_blank_borders(image).any())


def test_texture_is_what_spreads_by_more_than_rounding() -> None:
    image = noise()
    image[:, 20:70, 30:120] = 1.0
    levels = torch.randint(0, 2, (50, 90), generator=torch.Generator().manual_seed(1)) / 255
    seen = measure_texture(image)
    assert float(seen[30:60, 40:110].max()) == 0
    assert float(seen[:10].min()) == 1
    image[:, 20:70, 30:120] = 0.9 + 3 * levels
    assert float(measure_texture(image)[30:60, 40:110].min()) == 1


def test_texture_of_a_large_image_is_that_of_the_picture_not_of_its_pixels() -> None:
    """Bricks of 32 columns in an image of 2484, which a matcher sees at half that size."""
    stripes = (torch.arange(2484) // 32 % 2).float().expand(3, 60, -1)
    assert float(measure_texture(stripes[:, :30, ::2])[:, 32:-32].min()) == 1
    assert float(measure_texture(stripes)[:, 64:-64].min()) == 1


def rig() -> StereoRig:
    K = torch.tensor([[100.0, 0, W / 2], [0, 100, H / 2], [0, 0, 1]], dtype=torch.float64)
    return StereoRig(width=W, height=H, K=K, baseline_m=0.5)


@pytest.mark.parametrize("change", [wedge, lambda image: bars(image, 0.0)], ids=["wedge", "bars"])
def test_a_pair_has_no_depth_where_there_is_no_picture(change: Callable[[Tensor], Tensor]) -> None:
    scene = torch.nn.functional.pad(noise(), (8, 0, 0, 0))
    left, right = change(scene[..., :W]), change(scene[..., 8:])
    net = FakestereoNet(CallableMatcher(lambda *_: torch.full((H, W), 8.0)), with_check=False)
    found = net.estimate_input(DepthInput(name="x", left=left, right=right, camera=rig()))
    blank = find_blank_borders(left)
    assert found.depth_m is not None
    assert bool(found.depth_m[blank].isnan().all())
    assert bool(found.disparity_px[blank].isnan().all())
    assert torch.allclose(found.depth_m[~blank], torch.tensor(100 * 0.5 / 8))


def test_the_confidence_of_a_plain_wall_and_of_what_the_right_view_lacks_is_0() -> None:
    left, right = noise(), noise()
    left[:, 20:70, 60:120] = 1.0
    right[:, :, :40] = 0
    sky = torch.zeros(H, W, dtype=torch.bool)
    sky[20:70, 60:120] = True
    match = Match(disparity_px=torch.full((H, W), 8.0), confidence=torch.ones(H, W), is_sky=sky)
    found = estimate_from_pair(DepthInput(name="x", left=left, right=right, camera=rig()), match)
    assert found.confidence is not None
    assert float(found.confidence[30:60, 70:110].max()) == 0
    assert float(found.confidence[:10, 60:].min()) == 1
    assert float(found.confidence[:, 8:46].max()) == 0


def test_plain_sky_of_one_image_may_be_a_wall_and_depth_beside_it_keeps_its_confidence() -> None:
    """Depth of a plain road comes from what is about it: there is no reason to doubt it."""
    image = noise()
    image[:, 20:90, 60:120] = 1.0
    sky = torch.zeros(H, W, dtype=torch.bool)
    sky[:50] = True
    match = Match(disparity_px=torch.full((H, W), 8.0), confidence=torch.ones(H, W), is_sky=sky)
    seen = DepthInput(name="x", left=image, right=None, camera=rig())
    found = estimate_from_virtual(seen, match, image, 0.5)
    assert found.confidence is not None
    assert float(found.confidence[30:50, 70:110].max()) == 0
    assert float(found.confidence[:10].min()) == 1
    assert float(found.confidence[50:].min()) == 1
