"""Laws of matching with PSMNet: the plain network's answer, whatever the size and the rows."""

import copy
import subprocess
import sys
from dataclasses import replace

import pytest
import torch
import torch.nn.functional as F
from tests.depth.random_norms import with_random_norms

from depthpose.core.camera import Camera
from depthpose.core.devices import PrecisionNotice, computes_bf16
from depthpose.core.errors import InputError
from depthpose.depth.config import MatcherConfig, PSMNetConfig, Speed
from depthpose.depth.stereo import (
    PSMNet,
    PSMNetMatcher,
    SearchRange,
    layers,
    normalise,
    psmnet,
)
from depthpose.depth.stereo.network_matcher import lower_where_disagreeing, pad_top_right
from depthpose.depth.stereo.psmnet import (
    concatenation_volume,
    expected_disparity,
    psmnet_bytes,
    soft_argmin,
)
from depthpose.depth.types import Match

SMALL = PSMNetConfig(max_disparity_px=32, width=4, blocks=(1, 2, 1, 1), pools=(4, 2))


def random_network(config: PSMNetConfig, seed: int = 0) -> PSMNet:
    """A network in eval mode whose batch norms do something."""
    torch.manual_seed(seed)
    return with_random_norms(PSMNet(config))


def plain(network: PSMNet, left: torch.Tensor, right: torch.Tensor) -> torch.Tensor:
    """The plain network with the matcher's padding."""
    h, w = left.shape[-2:]
    pair = [pad_top_right(normalise(i), network.config)[None] for i in (left, right)]
    with torch.no_grad():
        return network(*pair)[-1][0, -h:, :w]


@pytest.mark.parametrize(
    ("config", "size"),
    [
        (SMALL, (32, 48)),
        (SMALL, (96, 128)),
        (SMALL, (37, 101)),
        (SMALL, (1, 1)),
        (PSMNetConfig(max_disparity_px=64, width=8, blocks=(1, 1, 1, 1), pools=(2,)), (48, 32)),
        (
            PSMNetConfig(
                max_disparity_px=16, width=3, blocks=(1, 2, 2, 1), pools=(4, 2), align_corners=False
            ),
            (64, 80),
        ),
    ],
)
def test_inference_equals_the_plain_network(config: PSMNetConfig, size: tuple[int, int]) -> None:
    network = random_network(config)
    left, right = torch.rand(2, 3, *size)
    found = PSMNetMatcher(network).match(left, right)
    assert found.disparity_px.shape == size
    assert torch.allclose(found.disparity_px, plain(network, left, right), atol=1e-3)
    assert found.confidence is not None
    assert bool(((found.confidence >= 0) & (found.confidence <= 1)).all())


def test_without_onednn_operators_the_answer_is_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    network = random_network(SMALL)
    left, right = torch.rand(2, 3, 37, 101)
    by_name = PSMNetMatcher(network).match(left, right)
    calls: list[str] = []

    def refuse(*_: object) -> None:
        calls.append("called")
        raise RuntimeError("no such operator")

    monkeypatch.setattr(torch, "mkldnn_convolution", refuse)
    layers.has_onednn_operators.cache_clear()
    try:
        documented = PSMNetMatcher(network).match(left, right)
        assert not layers.has_onednn_operators()
    finally:
        layers.has_onednn_operators.cache_clear()
    assert len(calls) == torch.backends.mkldnn.is_available()
    assert torch.allclose(by_name.disparity_px, documented.disparity_px, atol=1e-3)
    assert by_name.confidence is not None
    assert documented.confidence is not None
    assert torch.allclose(by_name.confidence, documented.confidence, atol=1e-3)


def test_an_onednn_operator_that_answers_otherwise_is_not_used(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def wrong(volume: torch.Tensor, *_: torch.Tensor) -> torch.Tensor:
        return torch.zeros_like(volume)

    monkeypatch.setattr(torch, "mkldnn_convolution", wrong)
    layers.has_onednn_operators.cache_clear()
    try:
        assert not layers.has_onednn_operators()
    finally:
        layers.has_onednn_operators.cache_clear()


@pytest.mark.parametrize("rows", [1, 2, 3, 6, 10, 64])
def test_any_number_of_rows_gives_one_answer_in_double_precision(rows: int) -> None:
    network = random_network(SMALL).double()
    left, right = torch.rand(2, 2, 3, 80, 96, dtype=torch.float64)
    folded = layers.fold(copy.deepcopy(network), left)
    folded.rows = rows
    with torch.no_grad():
        found_px, expected_px = (one(left, right)[-1] for one in (folded, network))
    assert float((found_px - expected_px).abs().max()) < 1e-9


def test_no_concatenation_volume_of_all_rows_is_made(monkeypatch: pytest.MonkeyPatch) -> None:
    matcher = PSMNetMatcher(random_network(SMALL))
    made: list[int] = []

    def noted(left: torch.Tensor, right: torch.Tensor, bins: int) -> torch.Tensor:
        made.append(left.shape[-2])
        return concatenation_volume(left, right, bins)

    monkeypatch.setattr(psmnet, "concatenation_volume", noted)
    left, right = torch.rand(2, 3, 400, 32)
    matcher.match(left, right)
    assert made == [36, 40, 40, 8], "32 rows of 100 at a time, and four on each side"


def test_more_disparities_than_in_training_equal_a_network_made_for_them() -> None:
    network = random_network(SMALL)
    farther = PSMNet(replace(SMALL, max_disparity_px=48)).eval()
    farther.load_state_dict(network.state_dict())
    left, right = torch.randn(2, 3, 32, 64)
    search = SearchRange(scale=1.0, first_px=0, span_px=48)
    with torch.no_grad():
        found = PSMNetMatcher(network).run(left, right, search)
        expected_px = farther(left[None], right[None])[-1][0]
    assert torch.allclose(found.disparity_px, expected_px, atol=1e-3)


@pytest.mark.skipif(not computes_bf16("cpu"), reason="this processor has no arithmetic for bf16")
@pytest.mark.parametrize(
    ("speed", "focal_px", "disparities"),
    [("quick", 400.0, 64), ("fine", 40.0, 64), ("fine", 70.0, 96), ("fine", 400.0, 96)],
)
def test_a_larger_size_is_searched_through_half_as_many_disparities_more_at_most(
    speed: Speed, focal_px: float, disparities: int
) -> None:
    """The filters of the volume know no more."""
    config = PSMNetConfig(
        width=2, max_disparity_px=64, blocks=(1, 1, 1, 1), pools=(2,), work_focal_px=50.0
    )
    matcher = PSMNetMatcher(random_network(config), MatcherConfig(speed=speed))
    K = torch.tensor([[focal_px, 0, 100], [0, focal_px, 50], [0, 0, 1]], dtype=torch.float64)
    camera = Camera(width=200, height=100, K=K)
    assert matcher.usual_search((100, 200), camera).span_px == disparities


@pytest.mark.skipif(not computes_bf16("cpu"), reason="this processor has no arithmetic for bf16")
def test_bf16_stays_near() -> None:
    network = random_network(SMALL)
    left, right = torch.rand(2, 3, 64, 96)
    found = PSMNetMatcher(network, MatcherConfig(precision="bf16")).match(left, right)
    assert found.disparity_px.dtype == torch.float32
    assert float((found.disparity_px - plain(network, left, right)).abs().mean()) < 0.3


def test_without_bf16_fp32_is_taken_and_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("depthpose.core.devices.computes_bf16", lambda _: False)
    network = random_network(SMALL)
    left, right = torch.rand(2, 3, 64, 96)
    with pytest.warns(PrecisionNotice, match=r"no arithmetic for bf16 .*; fp32 is taken"):
        matcher = PSMNetMatcher(network, MatcherConfig(precision="bf16"))
    assert matcher.config.precision == "fp32"
    expected = PSMNetMatcher(network).match(left, right)
    assert torch.equal(matcher.match(left, right).disparity_px, expected.disparity_px)


@pytest.mark.parametrize("align_corners", [True, False])
@pytest.mark.parametrize("chunk_bytes", [1, 5000, 1 << 30])
def test_chunked_expectation_equals_the_whole_one(align_corners: bool, chunk_bytes: int) -> None:
    cost = 3 * torch.randn(6, 7, 8, dtype=torch.float64)
    found, confidence = expected_disparity(
        cost,
        (32, 24, 28),
        align_corners=align_corners,
        chunk_bytes=chunk_bytes,
        with_confidence=True,
    )
    volume = cost.permute(2, 0, 1)[None, None]
    expected = soft_argmin(volume, (32, 24, 28), align_corners=align_corners)[0]
    assert torch.allclose(found, expected, atol=1e-10)
    assert confidence is not None
    full = F.interpolate(volume, (32, 24, 28), mode="trilinear", align_corners=align_corners)
    distance = (torch.arange(32)[:, None, None] - expected).abs()
    brute = (full[0, 0].softmax(0) * (distance <= 2)).sum(0)
    assert torch.allclose(confidence, brute, atol=1e-10)


def test_confidence_is_one_where_one_disparity_wins_and_small_where_two_do() -> None:
    cost = torch.zeros(4, 4, 16)
    cost[..., 3] = 100
    cost[2:, :, 12] = 100
    _, confidence = expected_disparity(
        cost, (64, 4, 4), align_corners=True, chunk_bytes=1 << 20, with_confidence=True
    )
    assert confidence is not None
    assert float(confidence[:2].min()) > 0.9
    assert float(confidence[2:].max()) < 0.1


@pytest.mark.parametrize("size", [(64, 96), (160, 320)])
def test_a_bound_is_met_or_refused_with_the_least_that_works(size: tuple[int, int]) -> None:
    network = random_network(SMALL)
    left, right = torch.rand(2, 3, *size)
    with pytest.raises(InputError, match="this matcher takes") as caught:
        PSMNetMatcher(network, MatcherConfig(max_memory_bytes=1000)).match(left, right)
    assert "max_memory_bytes=1000 is too small for images of" in str(caught.value)
    assert "precision='bf16'" in str(caught.value)
    assert "at a smaller size" in str(caught.value)
    least = int(str(caught.value).split("this matcher takes ")[1].split(";")[0])
    free = PSMNetMatcher(network).match(left, right)
    bound = PSMNetMatcher(network, MatcherConfig(max_memory_bytes=least)).match(left, right)
    assert torch.equal(free.disparity_px, bound.disparity_px)
    with pytest.raises(InputError, match=f"this matcher takes {least}"):
        PSMNetMatcher(network, MatcherConfig(max_memory_bytes=least - 1)).match(left, right)


def test_the_published_size_takes_less_than_1_gb_of_a_pair_of_kitti() -> None:
    network, size = PSMNetConfig(), (384, 1248)
    span_px = network.max_disparity_px
    whole = psmnet_bytes(network, span_px, *size, torch.float32)
    assert whole < 1_000_000_000
    assert psmnet_bytes(network, span_px, *size, torch.bfloat16) < whole
    assert psmnet_bytes(network, span_px, *size, torch.float32, rows=8) < whole


def test_left_right_check_lowers_confidence_where_views_disagree() -> None:
    found = Match(disparity_px=torch.full((2, 20), 5.0), confidence=torch.ones(2, 20))
    right_px = torch.full((2, 20), 5.0)
    right_px[:, 10:] = 9.0
    confidence = lower_where_disagreeing(found, right_px).confidence
    assert confidence is not None
    assert torch.allclose(confidence[:, 5:14], torch.ones(2, 9))
    assert float(confidence[:, 16:].max()) < 0.7
    assert float(confidence[:, :4].max()) == pytest.approx(0.5)


def test_left_right_check_runs_through_the_matcher() -> None:
    network = random_network(SMALL)
    left, right = torch.rand(2, 3, 40, 70)
    plain_match = PSMNetMatcher(network).match(left, right)
    checked = PSMNetMatcher(network, MatcherConfig(with_left_right_check=True)).match(left, right)
    assert torch.allclose(plain_match.disparity_px, checked.disparity_px, atol=1e-4)
    assert plain_match.confidence is not None
    assert checked.confidence is not None
    assert bool((checked.confidence <= plain_match.confidence + 1e-5).all())


def test_matcher_keeps_its_own_weights() -> None:
    network = random_network(SMALL)
    left, right = torch.rand(2, 3, 32, 48)
    matcher = PSMNetMatcher(network)
    before = matcher.match(left, right).disparity_px
    for parameter in network.parameters():
        parameter.data.zero_()
    assert torch.equal(matcher.match(left, right).disparity_px, before)


def test_unknown_device_is_refused() -> None:
    with pytest.raises(InputError, match="device 'toaster' cannot be used here"):
        PSMNetMatcher(random_network(SMALL), MatcherConfig(device="toaster"))
    with pytest.raises(InputError, match=r"this network searches the .* omit it"):
        PSMNetMatcher(random_network(SMALL), MatcherConfig(max_disparity_px=100.0))


_PSMNET = """
from depthpose.depth.stereo import PSMNet, PSMNetMatcher as Matcher
from depthpose.depth.stereo.psmnet import psmnet_bytes
network = PSMNet().eval()
least = psmnet_bytes(network.config, 192, 256, 1024, torch.float32)
"""
_LIGHT = """
from depthpose.depth.config import LightConfig
from depthpose.depth.stereo import LightMatcher as Matcher, LightStereo
from depthpose.depth.stereo.light import light_bytes
network = LightStereo(LightConfig()).eval()
least = light_bytes(network.config, 192, 256, 1024, torch.float32)
"""


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
@pytest.mark.parametrize("network", [_PSMNET, _LIGHT], ids=["psmnet", "light"])
def test_peak_memory_of_a_bounded_run_stays_below_its_bound(network: str) -> None:
    """In a process of its own: memory that earlier tests left behind would hide the rise."""
    code = f"""
import torch
from pathlib import Path
from depthpose.depth.config import MatcherConfig
from depthpose.depth.stereo import match_in_usual_range
{network}
def kilobytes(field):
    lines = Path("/proc/self/status").read_text().splitlines()
    return int(next(line for line in lines if field in line).split()[1])

matcher = Matcher(network, MatcherConfig(max_memory_bytes=least))
pair = torch.rand(2, 3, 256, 1024)
# Loads the operators, which are no activations.
match_in_usual_range(matcher, *pair[..., :64, :128])
before = kilobytes("VmRSS")
Path("/proc/self/clear_refs").write_text("5")
match_in_usual_range(matcher, *pair)
print(least, 1024 * (kilobytes("VmHWM") - before))
"""
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    least, rise = map(int, done.stdout.split())
    assert rise <= least
