"""PSMNet: the plain network, and the inference that must equal it."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional

from depthpose.core.checkpoint import read_torch_file
from depthpose.core.errors import InputError
from depthpose.core.files import read_disparity_png, read_image
from depthpose.depth.config import MatcherConfig, PSMNetConfig
from depthpose.depth.metrics import disparity_errors, sparsification_area
from depthpose.depth.stereo import (
    Footprint,
    PSMNet,
    PSMNetInference,
    PSMNetMatcher,
    Steps,
    import_psmnet,
    load_psmnet,
    normalise,
    psmnet_from_published,
    tile_change_px,
)
from depthpose.depth.stereo.expectation import Size, expected_disparity
from depthpose.depth.stereo.psmnet import concatenation_volume, soft_argmin

TINY = PSMNetConfig(max_disparity_px=32, width=4, blocks=(1, 2, 1, 1), pools=(8, 4, 2, 1))
WIDER = PSMNetConfig(
    max_disparity_px=48, width=6, blocks=(1, 1, 1, 1), pools=(4, 2), align_corners=False
)


def network(config: PSMNetConfig, seed: int = 0) -> PSMNet:
    """A network whose batch statistics are as random as its weights."""
    torch.manual_seed(seed)
    made = PSMNet(config)
    for module in made.modules():
        if isinstance(module, nn.BatchNorm2d | nn.BatchNorm3d):
            nn.init.uniform_(module.running_mean, -0.2, 0.2)
            nn.init.uniform_(module.running_var, 0.5, 2.0)
            nn.init.uniform_(module.weight, 0.5, 1.5)
            nn.init.uniform_(module.bias, -0.2, 0.2)
    return made.eval()


def images(height: int, width: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    left, right = torch.rand(2, 3, height, width, generator=generator)
    return left, right


def plain(made: PSMNet, left: Tensor, right: Tensor) -> Tensor:
    """The network itself, padded top and right, in float64."""
    h, w = left.shape[-2:]
    least = made.config.min_side_px
    rows, columns = (max(least, -(-side // 16) * 16) for side in (h, w))
    pair = [
        functional.pad(normalise(i.double()), (0, columns - w, rows - h, 0))[None]
        for i in (left, right)
    ]
    with torch.no_grad():
        return made.double()(*pair)[-1][0, -h:, :w]


def test_the_default_network_has_its_published_size() -> None:
    assert sum(p.numel() for p in PSMNet().parameters()) == 5_224_768


@pytest.mark.parametrize("config", [TINY, WIDER])
@pytest.mark.parametrize("size", [(32, 48), (48, 80), (37, 61), (16, 100)])
def test_inference_equals_the_plain_network(config: PSMNetConfig, size: tuple[int, int]) -> None:
    made = network(config)
    left, right = images(*size)
    found = PSMNetMatcher(made, MatcherConfig()).match(left, right)
    assert found.disparity_px.shape == size
    expected = plain(made, left, right)
    torch.testing.assert_close(found.disparity_px.double(), expected, rtol=1e-4, atol=1e-3)


def test_inference_in_float64_equals_to_rounding() -> None:
    made = network(TINY).double()
    left, right = (normalise(i.double()) for i in images(48, 64))
    found = PSMNetInference(made, torch.float64).match(left, right, Steps())
    with torch.no_grad():
        expected = made(left[None], right[None])[-1][0]
    torch.testing.assert_close(found.disparity_px, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("rows", [2, 6, 100])
def test_slabs_of_any_height_change_nothing(rows: int) -> None:
    made = network(TINY).double()
    left, right = (normalise(i.double()) for i in images(64, 48))
    inference = PSMNetInference(made, torch.float64)
    one = inference.match(left, right, Steps(rows=rows, chunk_bytes=1)).disparity_px
    other = inference.match(left, right, Steps(rows=12)).disparity_px
    torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-9)


def test_a_bound_that_works_changes_nothing_and_a_smaller_one_says_the_least() -> None:
    made = network(TINY)
    left, right = images(96, 128)
    free = PSMNetMatcher(made).match(left, right).disparity_px
    with pytest.raises(InputError, match="the least that works is") as caught:
        PSMNetMatcher(made, MatcherConfig(max_memory_bytes=1000)).match(left, right)
    least = int(str(caught.value).partition("the least that works is ")[2].partition(";")[0])
    bounded = PSMNetMatcher(made, MatcherConfig(max_memory_bytes=least)).match(left, right)
    torch.testing.assert_close(bounded.disparity_px, free, rtol=0, atol=1e-3)
    with pytest.raises(InputError, match="the least that works is"):
        PSMNetMatcher(made, MatcherConfig(max_memory_bytes=least - 1)).match(left, right)


def test_a_smaller_bound_plans_smaller_slabs() -> None:
    footprint = Footprint(config=PSMNetConfig(), height=384, width=1248, dtype=torch.float32)
    free = footprint.plan(None)
    least = footprint.estimate_bytes(Steps(rows=2))
    assert footprint.plan(least).rows == 2 < free.rows
    assert least < 1_000_000_000


def test_the_volume_is_zero_where_the_right_pixel_falls_outside() -> None:
    left, right = torch.rand(2, 1, 3, 4, 9)
    volume = concatenation_volume(left, right, 5)
    for d in range(5):
        assert torch.equal(volume[0, :3, d, :, d:], left[0, :, :, d:])
        assert torch.equal(volume[0, 3:, d, :, d:], right[0, :, :, : 9 - d])
        assert bool((volume[0, :, d, :, :d] == 0).all())


@pytest.mark.parametrize("align_corners", [True, False])
def test_the_chunked_soft_argmin_equals_the_formula(align_corners: bool) -> None:
    cost = 3 * torch.randn(1, 1, 4, 5, 6, dtype=torch.float64)
    size = (16, 20, 24)
    upsampled = functional.interpolate(cost, size, mode="trilinear", align_corners=align_corners)
    weights = torch.arange(16, dtype=torch.float64)[:, None, None]
    expected = (upsampled[0, 0].softmax(0) * weights).sum(0)
    assert torch.allclose(soft_argmin(cost, size, align_corners=align_corners)[0], expected)
    chunked, confidence = expected_disparity(
        cost[0, 0].permute(1, 2, 0).contiguous(), Size(*size), align_corners=align_corners,
        chunk_bytes=1, with_confidence=True,
    )  # fmt: skip
    torch.testing.assert_close(chunked, expected)
    near = (weights - expected).abs() <= 4
    assert confidence is not None
    torch.testing.assert_close(confidence, (upsampled[0, 0].softmax(0) * near).sum(0))


def test_training_answers_three_maps_with_finite_gradients() -> None:
    made = PSMNet(TINY).train()
    left, right = images(32, 48)
    batch = [torch.stack([normalise(i), normalise(i.flip(0))]) for i in (left, right)]
    maps = made(*batch)
    assert [tuple(m.shape) for m in maps] == [(2, 32, 48)] * 3
    sum(m.mean() for m in maps).backward()
    gradients = [p.grad for p in made.parameters()]
    assert all(g is not None and bool(torch.isfinite(g).all()) for g in gradients)


def test_the_network_learns_one_batch() -> None:
    torch.manual_seed(0)
    made = PSMNet(TINY).train()
    wide = torch.rand(2, 3, 32, 72)
    pair = [normalise(wide[..., :64].contiguous()), normalise(wide[..., 8:].contiguous())]
    optimiser = torch.optim.Adam(made.parameters(), 3e-3)
    losses: list[float] = []
    for _ in range(40):
        loss = sum(functional.smooth_l1_loss(m, torch.full_like(m, 8.0)) for m in made(*pair))
        assert isinstance(loss, Tensor)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.2 * losses[0]


def test_a_size_that_does_not_suit_is_refused() -> None:
    with pytest.raises(InputError, match="multiples of 16 and at least 32 px, got 40x48"):
        PSMNet(TINY)(torch.zeros(1, 3, 40, 48), torch.zeros(1, 3, 40, 48))


@pytest.mark.parametrize(
    ("knobs", "message"),
    [
        ({"max_disparity_px": 100}, "multiple of 16"),
        ({"width": 0}, "width must be 1 or more"),
        ({"blocks": (1, 0, 1, 1)}, "each stage needs 1 block"),
        ({"pools": ()}, "pools must hold windows"),
    ],
)
def test_a_network_that_cannot_be_is_refused(knobs: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        PSMNetConfig(**knobs)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(
    ("knobs", "message"),
    [
        ({"max_memory_bytes": 0}, "max_memory_bytes must be positive"),
        ({"tile_px": (0, 64)}, "two positive sizes"),
        ({"tile_overlap_px": -1}, "0 or more"),
        ({"device": "warp"}, "device 'warp' cannot be used here"),
    ],
)
def test_a_run_that_cannot_be_is_refused(knobs: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        PSMNetMatcher(PSMNet(TINY), MatcherConfig(**knobs))  # pyright: ignore[reportArgumentType]


def test_one_tile_over_all_changes_nothing_and_small_ones_little() -> None:
    made = network(TINY)
    left, right = images(64, 128)
    whole = PSMNetMatcher(made, MatcherConfig(tile_px=(64, 128)))
    assert tile_change_px(whole, left, right) == 0
    tiled = PSMNetMatcher(made, MatcherConfig(tile_px=(32, 64), tile_overlap_px=16))
    assert 0 < tile_change_px(tiled, left, right) < 5
    with pytest.raises(InputError, match="needs a matcher with tiles"):
        tile_change_px(PSMNetMatcher(made), left, right)


def test_confidence_lies_in_0_to_1_and_the_check_lowers_it() -> None:
    made = network(TINY)
    left, right = images(64, 96)
    simple = PSMNetMatcher(made).match(left, right).confidence
    checked = PSMNetMatcher(made, MatcherConfig(with_left_right_check=True)).match(left, right)
    assert simple is not None
    assert checked.confidence is not None
    assert 0 <= float(simple.min()) <= float(simple.max()) <= 1
    assert bool((checked.confidence <= simple + 1e-6).all())
    without = PSMNetMatcher(made, MatcherConfig(with_confidence=False)).match(left, right)
    assert without.confidence is None


def test_bf16_stays_near() -> None:
    made = network(TINY)
    left, right = images(64, 96)
    exact = PSMNetMatcher(made).match(left, right).disparity_px
    coarse = PSMNetMatcher(made, MatcherConfig(precision="bf16")).match(left, right).disparity_px
    assert 0 < float((exact - coarse).abs().mean()) < 0.5


@pytest.fixture
def published(real: Path) -> dict[str, Tensor]:
    return read_torch_file(real / "reference/psmnet/published_kitti2015.tar")["state_dict"]


@pytest.mark.data
def test_the_published_weights_give_the_published_output(
    real: Path, published: dict[str, Tensor]
) -> None:
    reference = np.load(real / "reference/psmnet/kitti2015_000046_10.npz")
    expected = torch.from_numpy(reference["disparity"])
    home = real / "depth/kitti_2015/training"
    left, right = (
        read_image(home / side / "000046_10.png")[:, 110:366, 400:912].contiguous()
        for side in ("image_2", "image_3")
    )
    matcher = PSMNetMatcher(psmnet_from_published(published, align_corners=True))
    match = matcher.match(left, right)
    torch.testing.assert_close(match.disparity_px, expected, rtol=0, atol=1e-3)

    truth = read_disparity_png(home / "disp_occ_0/000046_10.png")[110:366, 400:912]
    seen = torch.isfinite(truth)
    assert disparity_errors(expected[seen], truth[seen]).epe_px == pytest.approx(0.2267, abs=1e-4)
    error = (match.disparity_px - truth).abs()[seen]
    assert match.confidence is not None
    score = sparsification_area(error, match.confidence[seen])
    assert score < 0.8 * sparsification_area(error, torch.ones_like(error))


@pytest.mark.data
def test_an_import_is_a_file_of_ours(real: Path, tmp_path: Path) -> None:
    source = real / "reference/psmnet/published_kitti2015.tar"
    import_psmnet(source, tmp_path / "w.safetensors", align_corners=True)
    assert load_psmnet(tmp_path / "w.safetensors").network_config == PSMNetConfig()


@pytest.mark.data
@pytest.mark.parametrize("prefix", ["", "module."])
def test_a_state_is_taken_strictly(published: dict[str, Tensor], prefix: str) -> None:
    state = {prefix + name.removeprefix("module."): value for name, value in published.items()}
    psmnet_from_published(state, align_corners=False)
    first = next(iter(state))
    with pytest.raises(InputError, match="missing: "):
        psmnet_from_published({n: v for n, v in state.items() if n != first}, align_corners=True)
    with pytest.raises(InputError, match="unknown: strange"):
        psmnet_from_published({**state, "strange": torch.zeros(1)}, align_corners=True)
    with pytest.raises(InputError, match="misshaped: "):
        psmnet_from_published({**state, first: torch.zeros(1)}, align_corners=True)


@pytest.mark.parametrize("content", [{"state_dict": [1]}, {"epoch": 3}])
def test_a_file_that_holds_no_state_is_refused(content: dict[str, object], tmp_path: Path) -> None:
    torch.save(content, tmp_path / "x.tar")
    with pytest.raises(InputError, match="holds no 'state_dict' of tensors"):
        import_psmnet(tmp_path / "x.tar", tmp_path / "w.safetensors", align_corners=True)
    assert not (tmp_path / "w.safetensors").exists()


_MEASURE = """
import resource, sys, torch
from depthpose.depth.config import MatcherConfig
from depthpose.depth.stereo import PSMNet, PSMNetMatcher
torch.manual_seed(0)
matcher = PSMNetMatcher(PSMNet().eval(), MatcherConfig(max_memory_bytes=1_000_000_000))
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
matcher.match(torch.rand(3, 375, 1242), torch.rand(3, 375, 1242))
print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024)
"""


@pytest.mark.slow
def test_a_full_frame_stays_below_a_bound_of_one_gigabyte() -> None:
    answer = subprocess.run([sys.executable, "-c", _MEASURE], capture_output=True, check=True)
    assert int(answer.stdout) < 1_000_000_000
