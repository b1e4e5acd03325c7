"""The generator computed by OpenVINO, beside torch's own."""

import importlib.util
import subprocess
import sys
from pathlib import Path
from typing import Literal

import pytest
import torch
from tests.depth.constant_selection import BASELINE_M, CONFIG, FOCAL_PX, of_all_kinds

from depthpose.core.camera import StereoRig
from depthpose.core.devices import computes_bf16
from depthpose.core.errors import InputError, MissingExtraError
from depthpose.depth.config import GeneratorConfig, MatcherConfig
from depthpose.depth.estimator import FakestereoNet
from depthpose.depth.synthesis import UNetGenerator
from depthpose.depth.weights import write_depth_weights

with_openvino = pytest.mark.skipif(
    importlib.util.find_spec("openvino") is None, reason="OpenVINO is not installed"
)


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("weights") / "w.safetensors"
    write_depth_weights(path, generator=of_all_kinds(), facts={})
    return path


@with_openvino
def test_openvino_answers_what_torch_does_at_any_size(weights: Path) -> None:
    nets = [
        FakestereoNet.load(weights, engine=engine, allow_ood=True)
        for engine in ("torch", "openvino")
    ]
    multiple = CONFIG.side_multiple_px
    for height, width in ((2 * multiple, 3 * multiple), (90, 170), (multiple, 5 * multiple)):
        K = torch.tensor(
            [[FOCAL_PX, 0, width / 2], [0, FOCAL_PX, height / 2], [0, 0, 1]], dtype=torch.float64
        )
        rig = StereoRig(width=width, height=height, K=K, baseline_m=BASELINE_M)
        image = torch.rand(3, height, width, generator=torch.Generator().manual_seed(height))
        first, second = (net.estimate(image, rig) for net in nets)
        off_px = (first.disparity_px - second.disparity_px).abs()
        assert float((off_px > 1e-3).float().mean()) < 1e-2  # the border of the sky
        assert first.confidence is not None
        assert second.confidence is not None
        assert float((first.confidence - second.confidence).abs().mean()) < 1e-3


@with_openvino
def test_an_answer_stays_when_the_next_image_comes(weights: Path) -> None:
    net = FakestereoNet.load(weights, engine="openvino", allow_ood=True)
    assert net.synthesiser is not None
    first = net.synthesiser.draw(torch.zeros(1, 3, 64, 96))
    kept = first.disparity_px.clone() if first.disparity_px is not None else None
    net.synthesiser.draw(torch.rand(1, 3, 64, 96))
    assert kept is not None
    assert torch.equal(first.disparity_px, kept)  # pyright: ignore[reportArgumentType]


@with_openvino
@pytest.mark.skipif(not computes_bf16("cpu"), reason="this processor has no bf16")
def test_bf16_is_another_answer_near_that_of_fp32(weights: Path) -> None:
    drawn = []
    precisions: list[Literal["fp32", "bf16"]] = ["fp32", "bf16"]
    for precision in precisions:
        net = FakestereoNet.load(
            weights,
            engine="openvino",
            config=MatcherConfig(precision=precision),
        )
        assert net.synthesiser is not None
        image = torch.rand(1, 3, 64, 96, generator=torch.Generator().manual_seed(0))
        confidence = net.synthesiser.draw(image).confidence
        assert confidence is not None
        drawn.append(confidence)
    assert not torch.equal(*drawn)
    assert float((drawn[0] - drawn[1]).abs().mean()) < 0.05


@with_openvino
def test_openvino_is_imported_without_its_telemetry() -> None:
    words = (
        "import sys; from depthpose.depth.synthesis.openvino import import_openvino;"
        "print(import_openvino().__name__, sys.modules['openvino_telemetry'])"
    )
    done = subprocess.run([sys.executable, "-c", words], check=True, capture_output=True, text=True)
    assert done.stdout.split() == ["openvino", "None"]


def test_without_openvino_the_extra_is_named(
    weights: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "openvino", None)
    with pytest.raises(MissingExtraError, match=r"pip install -e '.\[openvino\]'"):
        FakestereoNet.load(weights, engine="openvino")


def test_engines_that_cannot_compute_the_weights_are_refused(weights: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="engine is 'tensorrt'; Known: 'openvino', 'torch'"):
        FakestereoNet.load(weights, engine="tensorrt")
    with pytest.raises(InputError, match="device is 'cuda:7'; omit one of the two"):
        FakestereoNet.load(weights, engine="openvino", config=MatcherConfig(device="cuda:7"))
    with pytest.raises(InputError, match="engine is 'openvino', and there is no generator"):
        FakestereoNet.load(matcher="sgbm", engine="openvino")
    painter = UNetGenerator(GeneratorConfig(width=2, levels=3))
    path = tmp_path / "painter.safetensors"
    write_depth_weights(path, generator=painter, facts={})
    with pytest.raises(InputError, match="these weights hold a U-Net"):
        FakestereoNet.load(path, matcher="sgbm", engine="openvino")
