from pathlib import Path

import numpy as np
import pytest
import torch
from tests.synthetic_street import make_street

from depthpose import FakestereoNet
from depthpose.core.camera import Camera, StereoRig, write_camera
from depthpose.core.errors import InputError
from depthpose.core.files import write_image
from depthpose.depth.stereo import CallableMatcher, infinity_px
from depthpose.depth.types import DepthEstimate, DepthInput, DepthSample, Match


@pytest.fixture(scope="module")
def street() -> DepthSample:
    return make_street(0.4)


def test_the_street_is_estimated_in_metres(street: DepthSample) -> None:
    pair, truth_m = street.input, street.truth.depth_m
    assert pair.right is not None
    assert truth_m is not None
    net = FakestereoNet.load(matcher="sgbm")
    estimate = net.estimate(pair.left, pair.camera, right=pair.right)
    assert estimate.depth_m is not None
    error = ((estimate.depth_m - truth_m).abs() / truth_m).nanmedian()
    assert error < 0.03


def test_files_arrays_and_tensors_give_one_answer(street: DepthSample, tmp_path: Path) -> None:
    pair = street.input
    assert pair.right is not None
    assert pair.camera is not None
    left, right = (
        (image.permute(1, 2, 0) * 255).round().byte().numpy() for image in (pair.left, pair.right)
    )
    write_image(tmp_path / "l.png", pair.left)
    write_image(tmp_path / "r.png", pair.right)
    write_camera(tmp_path / "c.json", pair.camera)
    net = FakestereoNet.load(matcher="sgbm")
    by_file = net.estimate(str(tmp_path / "l.png"), tmp_path / "c.json", right=tmp_path / "r.png")
    by_array = net.estimate(left, pair.camera, right=right)
    assert torch.equal(by_file.disparity_px.nan_to_num(0), by_array.disparity_px.nan_to_num(0))


def test_without_a_camera_there_is_disparity_only() -> None:
    net = FakestereoNet(CallableMatcher(lambda left, _: left.mean(0) + 5), with_check=False)
    image = np.zeros((20, 30, 3), np.uint8)
    estimate = net.estimate(image, None, right=image)
    assert estimate.depth_m is None
    assert estimate.disparity_px.shape == (20, 30)


def _camera(width: int) -> Camera:
    return Camera(width=width, height=20, K=_intrinsics())


def _intrinsics() -> torch.Tensor:
    return torch.tensor([[30.0, 0, 15], [0, 30, 10], [0, 0, 1]], dtype=torch.float64)


@pytest.mark.parametrize(
    ("right", "camera", "message"),
    [
        (None, None, "there is no right image.*give right="),
        (torch.zeros(3, 20, 31), None, "left image is 30x20 and the right one 31x20"),
        (torch.zeros(3, 20, 30), _camera(30), 'Add "baseline_m"'),
        (torch.zeros(3, 20, 30), _camera(60), "60"),
    ],
)
def test_an_unusable_pair_is_refused(
    right: torch.Tensor | None, camera: Camera | None, message: str
) -> None:
    net = FakestereoNet(CallableMatcher(lambda left, _: left.mean(0)), with_check=False)
    with pytest.raises(InputError, match=message):
        net.estimate(torch.zeros(3, 20, 30), camera, right=right)


def test_a_swapped_pair_is_recognised(street: DepthSample) -> None:
    pair = street.input
    net = FakestereoNet.load(matcher="sgbm")
    assert pair.right is not None
    with pytest.raises(InputError, match=r"street: .*swap"):
        net.estimate(pair.right, pair.camera, right=pair.left, name="street")


@pytest.mark.parametrize(
    ("weights", "matcher", "message"),
    [
        ("w.safetensors", "sgbm", "neither a file nor the name of weights"),
        (None, "sgmb", "'sgmb': neither a file nor the name"),
    ],
)
def test_a_matcher_and_its_weights_belong_together(
    weights: str | None, matcher: str | None, message: str
) -> None:
    with pytest.raises(InputError, match=message):
        FakestereoNet.load(weights, matcher=matcher)


def test_without_a_name_the_default_is_loaded() -> None:
    """Its files say the same as those that are named; from_pretrained is what others call it."""
    said = "FakestereoNet(SelectionSynthesiser + LightMatcher, weights 'default', cpu)"
    for net in (
        FakestereoNet.load(),
        FakestereoNet.from_pretrained("default"),
    ):
        assert repr(net) == said
    assert repr(FakestereoNet.load(matcher="sgbm")) == "FakestereoNet(SGBMMatcher)"


def test_an_estimate_is_one_readable_line() -> None:
    depth_m = torch.full((20, 30), 4.0)
    depth_m[:10], depth_m[0], depth_m[1, 1] = 12, torch.nan, 45_399  # one pixel is far away
    px, sky = torch.full((20, 30), 8.0), torch.arange(20)[:, None].expand(20, 30) < 1
    seen = DepthInput(name="a", left=torch.zeros(3, 20, 30), right=None, camera=None)
    whole = DepthEstimate(
        input=seen, depth_m=depth_m, disparity_px=px, confidence=px / 16, is_sky=sky
    )
    assert repr(whole) == (
        "DepthEstimate(30x20, depth 4.0 .. 12.0 m (1 to 99 %, median 4.0, known of 95%), "
        "mean confidence 0.50, sky 5%)"
    )
    alone = DepthEstimate(input=seen, depth_m=None, disparity_px=px)
    assert repr(alone) == "DepthEstimate(30x20, disparity 8.0 .. 8.0 px (1 to 99 %, median 8.0))"
    empty = DepthEstimate(input=seen, depth_m=depth_m * torch.nan, disparity_px=px)
    assert repr(empty) == "DepthEstimate(30x20, depth nowhere known)"


def test_the_rig_decides_the_metres() -> None:
    net = FakestereoNet(CallableMatcher(lambda left, _: left.mean(0) * 0 + 3), with_check=False)
    image = torch.zeros(3, 20, 30)
    rig = StereoRig(width=30, height=20, K=_intrinsics(), baseline_m=0.2)
    estimate = net.estimate(image, rig, right=image)
    assert estimate.depth_m is not None
    assert estimate.depth_m[0, 0].item() == pytest.approx(2.0)


def apart_rig(columns: int) -> StereoRig:
    K = torch.tensor([[300.0, 0, 120], [0, 300, 60], [0, 0, 1]], dtype=torch.float64)
    apart = float(columns)
    return StereoRig(width=240, height=120, K=K, baseline_m=0.2, cx_right_minus_left_px=apart)


@pytest.mark.parametrize("columns", [20, -12])
def test_far_points_of_a_rig_with_principal_points_apart_are_matched(columns: int) -> None:
    """A wall at a disparity of 6 px, less the difference of the principal points."""
    generator = torch.Generator().manual_seed(1)
    wide = torch.nn.functional.interpolate(
        torch.rand(1, 3, 60, 160, generator=generator), (120, 320), mode="bilinear"
    )[0]
    disparity = 6 - columns
    left, right = wide[..., 40:280], wide[..., 40 + disparity : 280 + disparity]
    found = FakestereoNet.load(matcher="sgbm").estimate(left, apart_rig(columns), right=right)
    assert found.depth_m is not None
    assert float(found.disparity_px.nanmedian()) == pytest.approx(disparity, abs=0.1)
    assert float(found.depth_m.nanmedian()) == pytest.approx(300 * 0.2 / 6, rel=0.02)


@pytest.mark.parametrize(("columns", "width"), [(20, 260), (200, 440), (-100, 240)])
def test_views_are_moved_by_the_difference_of_their_principal_points(
    columns: int, width: int
) -> None:
    """Whatever the size and the sign: the matcher is shown a rig whose principal points agree."""
    image = torch.rand(3, 120, 240)

    def match(left: torch.Tensor, right: torch.Tensor) -> torch.Tensor:
        assert left.shape == right.shape == (3, 120, width)
        moved = max(columns, 0)
        assert torch.equal(left[..., moved:], image)
        kept = image[..., :columns] if columns < 0 else image
        assert torch.equal(right[..., max(-columns, 0) : max(-columns, 0) + kept.shape[2]], kept)
        return left.mean(0) * 0 + 6

    net = FakestereoNet(CallableMatcher(match), with_check=False)
    found = net.estimate(image, apart_rig(columns), right=image)
    assert found.disparity_px.shape == (120, 240)
    assert float(found.disparity_px.median()) == pytest.approx(6 - columns)
    assert found.depth_m is not None
    assert float(found.depth_m.median()) == pytest.approx(300 * 0.2 / 6)


@pytest.mark.parametrize("columns", [240, -240, 5000])
def test_principal_points_farther_apart_than_the_images_are_refused(columns: int) -> None:
    net = FakestereoNet(CallableMatcher(lambda left, _: left.mean(0)), with_check=False)
    image = torch.rand(3, 120, 240)
    said = rf"cx_right_minus_left_px is {columns}, and the images are 240 px wide: the two views"
    with pytest.raises(InputError, match=said):
        net.estimate(image, apart_rig(columns), right=image)


class SeesCamera:
    """A matcher of the user's, which doubts what it answers."""

    def match(
        self,
        left: torch.Tensor,
        right: torch.Tensor,  # noqa: ARG002
        camera: Camera | None = None,
    ) -> Match:
        assert left.shape == (3, 120, 240)
        flat = torch.full(left.shape[1:], 6 + infinity_px(camera))
        return Match(disparity_px=flat, warning="it rained")


def test_a_matcher_is_given_the_camera_and_may_warn() -> None:
    image = torch.rand(3, 120, 240)
    net = FakestereoNet(SeesCamera(), with_check=False)
    found = net.estimate(image, apart_rig(20), right=image)
    assert float(found.disparity_px.median()) == -14
    assert found.depth_m is not None
    assert float(found.depth_m.median()) == pytest.approx(300 * 0.2 / 6)
    assert found.warning == "it rained"
    bare = torch.linspace(0, 1, 240).expand(3, 120, 240)
    found = FakestereoNet(SeesCamera()).estimate(bare, right=bare.roll(2, 1) * 0.9)
    assert "cannot tell whether the pair" in found.warning
    assert found.warning.endswith("; it rained")


@pytest.mark.parametrize("how", ["estimate", "estimate_input", "estimate_many"])
def test_every_way_refuses_a_pair_that_is_none_and_warns_of_doubt(how: str) -> None:
    def estimate(left: torch.Tensor, right: torch.Tensor, *, with_check: bool) -> DepthEstimate:
        matcher = CallableMatcher(lambda left, _: left.mean(0) * 0 + 3)
        net = FakestereoNet(matcher, with_check=with_check)
        pair = DepthInput(name="street", left=left, right=right, camera=None)
        if how == "estimate":
            return net.estimate(left, right=right, name="street")
        if how == "estimate_input":
            return net.estimate_input(pair)
        found = net.estimate_many([pair])[0]
        if isinstance(found, InputError):
            raise found
        return found

    left, right = torch.rand(2, 3, 80, 120, generator=torch.Generator().manual_seed(0))
    with pytest.raises(InputError, match=r"street: the images do not belong together: 0 of \d+"):
        estimate(left, right, with_check=True)
    assert estimate(left, right, with_check=False).warning == ""
    bare = torch.linspace(0, 1, 120).expand(3, 80, 120)
    found = estimate(bare, bare.roll(2, 1) * 0.9, with_check=True)
    assert found.warning.startswith("only 0 of the 25 matches needed: cannot tell whether the pair")
    assert f"warning: {found.warning}" in repr(found)
