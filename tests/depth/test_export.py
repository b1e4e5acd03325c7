import dataclasses
import json
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tests.depth.constant_selection import CONFIG, of_all_kinds
from tests.depth.short_encoder import short_encoder

from depthpose.cli import main
from depthpose.core.errors import InputError
from depthpose.core.export import convert_network
from depthpose.core.files import write_image
from depthpose.depth.config import (
    GeneratorConfig,
    MatcherConfig,
    PSMNetConfig,
)
from depthpose.depth.estimator import FakestereoNet
from depthpose.depth.export import make_export
from depthpose.depth.generators import SelectionGenerator, UNetGenerator
from depthpose.depth.graphs import (
    DynamicPSMNet,
    DynamicSelection,
    gathered_volume,
)
from depthpose.depth.stereo import PSMNet
from depthpose.depth.stereo.psmnet import concatenation_volume
from depthpose.depth.weights import DepthWeights, write_depth_weights

onnxruntime = pytest.importorskip("onnxruntime")
DOCS = (Path(__file__).parents[2] / "docs/export.md").read_text()
TERMS = {"licence": "MIT", "trained_on": "nothing"}


def tiny_matcher(**settings: object) -> PSMNet:
    torch.manual_seed(1)
    size = {"width": 2, "max_disparity_px": 32, "blocks": (1, 1, 1, 1), "pools": (8, 4)}
    return PSMNet(PSMNetConfig(**size | settings)).eval()  # pyright: ignore[reportArgumentType]


def calm_matcher() -> PSMNet:
    """A matcher of broad distributions: an untrained one jumps where a view changes little."""
    matcher = tiny_matcher(work_focal_px=70.0)
    with torch.no_grad():
        for name, weight in matcher.named_parameters():
            if name.startswith("heads.") and name.endswith(".cost.weight"):
                weight.mul_(0.002)
    return matcher


def tiny_weights(**settings: object) -> DepthWeights:
    torch.manual_seed(0)
    rig = {"width": 2, "levels": 4, "virtual_focal_px": 90.0, "virtual_baseline_m": 0.5}
    generator = UNetGenerator(GeneratorConfig(**rig | settings)).eval()  # pyright: ignore[reportArgumentType]
    matcher = tiny_matcher(work_focal_px=70.0)
    return DepthWeights(generator=generator, matcher=matcher, facts=TERMS)


def of_streets() -> SelectionGenerator:
    """:func:`of_all_kinds` with a layer that knows streets, and refuses all but sure ones."""
    torch.manual_seed(3)
    generator = of_all_kinds()
    generator.config = dataclasses.replace(
        generator.config, least_confidence=0.99, with_street=True
    )
    generator.street = torch.nn.Linear(3 * generator.encoder.channels[-1], 1)
    return generator


@pytest.fixture(scope="module", params=["short", pytest.param("whole", marks=pytest.mark.slow)])
def encoder(request: pytest.FixtureRequest) -> Iterator[str]:
    """Which encoder the networks have: a short one, for the quick tests, or the whole one."""
    with short_encoder() if request.param == "short" else nullcontext():
        yield request.param


@pytest.fixture(scope="module")
def selection_network(encoder: str) -> Any:  # noqa: ANN401 - an ONNX model
    """The network of :func:`of_streets`, exported once: that is what takes the time."""
    assert encoder
    module, multiple = DynamicSelection(of_streets()).eval(), CONFIG.side_multiple_px
    return convert_network(module, [torch.rand(2, 3, 2 * multiple, 3 * multiple)], multiple)


@pytest.fixture
def selection(
    selection_network: Any,  # noqa: ANN401
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> Path:
    """Folder with ``w.safetensors``: a generator that selects, without a matcher."""

    def exported_once(module: torch.nn.Module, images: list[torch.Tensor], multiple: int) -> Any:  # noqa: ANN401
        if isinstance(module, DynamicSelection):
            return selection_network
        return convert_network(module, images, multiple)

    monkeypatch.setattr("depthpose.depth.graphs.convert_network", exported_once)
    write_depth_weights(tmp_path / "w.safetensors", generator=of_all_kinds(), facts=TERMS)
    return tmp_path


def export_to(folder: Path, *words: str) -> int:
    file = str(folder / "w.safetensors")
    return main(["export", "depth", "--weights", file, "--out", str(folder / "depth.onnx"), *words])


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with ``w.safetensors``, and ``depth.onnx`` made of it by the command."""
    folder = tmp_path_factory.mktemp("export")
    weights = tiny_weights()
    write_depth_weights(
        folder / "w.safetensors",
        generator=weights.generator, matcher=weights.matcher, facts=TERMS,
    )  # fmt: skip
    assert export_to(folder) == 0
    return folder


@pytest.mark.parametrize("width", [3, 8, 20])
def test_the_gathered_volume_is_the_concatenation_volume(width: int) -> None:
    left, right = torch.rand(2, 2, 3, 5, width).unbind()
    assert torch.equal(gathered_volume(left, right, 8), concatenation_volume(left, right, 8))


@pytest.mark.parametrize("align_corners", [True, False])
def test_the_sizeless_network_is_the_network(align_corners: bool) -> None:
    matcher = tiny_matcher(align_corners=align_corners)
    pair = torch.randn(2, 2, 3, 48, 64).unbind()
    with torch.no_grad():
        disparity_px, confidence = DynamicPSMNet(matcher)(*pair)
        expected_px = matcher(*pair)[-1]
    assert expected_px.std() > 1
    torch.testing.assert_close(disparity_px, expected_px, rtol=0, atol=2e-3)
    assert 0 <= confidence.min() <= confidence.max() <= 1


@pytest.mark.slow
def test_depth_from_one_image_is_the_estimators_at_every_size(exported: Path) -> None:
    record = json.loads((exported / "depth.proof.json").read_text())
    found = {(row["input"], row["output"]): row for row in record["differences"]}
    assert len(found) == 16
    largest = {name: 0.0 for _, name in found}
    for (_, name), row in found.items():
        largest[name] = max(largest[name], row["largest difference"])
    assert largest["right"] < 1e-4
    assert largest["disparity_px"] < 0.03
    assert largest["depth_m"] < 5e-3
    assert record["facts"]["virtual_baseline_m"] == 0.5
    assert record["facts"]["licence"] == "MIT"


@pytest.mark.filterwarnings("ignore:proof. unlike")
def test_weights_that_refuse_unlike_images_are_exported(selection: Path) -> None:
    """The scenes of the proof are unlike what such weights were trained on."""
    write_depth_weights(selection / "strict.safetensors", generator=of_streets(), facts=TERMS)
    words = ["--weights", str(selection / "strict.safetensors")]
    assert main(["export", "depth", *words, "--out", str(selection / "d.onnx")]) == 0
    rows = json.loads((selection / "d.proof.json").read_text())["differences"]
    assert "image_confidence" in {row["output"] for row in rows}


@pytest.mark.slow
def test_a_pair_needs_no_focal_length_where_the_weights_know_none(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_depth_weights(tmp_path / "m.safetensors", matcher=tiny_matcher(), facts=TERMS)
    words = ["--weights", str(tmp_path / "m.safetensors"), "--out", str(tmp_path / "m.onnx")]
    assert main(["export", "depth", *words]) == 0
    assert "| disparity_px |" in capsys.readouterr().out
    import onnxruntime

    session = onnxruntime.InferenceSession(str(tmp_path / "m.onnx"))
    assert [given.name for given in session.get_inputs()] == ["left", "right"]


@pytest.mark.slow
def test_a_pair_at_the_focal_length_of_the_weights(exported: Path) -> None:
    words = ["--weights", str(exported / "w.safetensors"), "--out", str(exported / "pair.onnx")]
    assert main(["export", "depth", *words, "--what", "pair"]) == 0
    rows = json.loads((exported / "pair.proof.json").read_text())["differences"]
    assert {row["output"] for row in rows} == {"disparity_px", "confidence"}


def test_an_answer_of_its_own_is_exported_without_a_matcher(selection: Path) -> None:
    """At every size, in batches; the sky is a decision, which may flip on its border."""
    assert export_to(selection) == 0
    record = json.loads((selection / "depth.proof.json").read_text())
    found = {(row["input"], row["output"]): row for row in record["differences"]}
    assert len(found) == 20
    for (_, name), row in found.items():
        assert row["largest difference" if name == "depth_m" else "mean difference"] < 2e-3
        assert row.get("flipped", 0.0) < 1e-3
    assert record["facts"]["answer"] == "own"
    infer_as_documented(selection, least_px=0.0)


@pytest.mark.slow
@pytest.mark.parametrize("encoder", ["short"], indirect=True)
def test_the_matcher_is_asked_where_the_weights_say_so(selection: Path) -> None:
    matcher = calm_matcher()
    generator = of_all_kinds("matched")
    write_depth_weights(
        selection / "w.safetensors", generator=generator, matcher=matcher, facts=TERMS
    )
    assert export_to(selection) == 0
    rows = json.loads((selection / "depth.proof.json").read_text())["differences"]
    assert {row["output"] for row in rows} >= {"depth_m", "is_sky"}
    lone = DepthWeights(generator=generator, matcher=None, facts=TERMS)
    with pytest.raises(InputError, match="lack the matcher"):
        make_export(lone, None, {}).graph()


def test_another_sky_is_no_proof(selection: Path) -> None:
    """What is held to the limits is the sky too: the proof must fail where it is another."""
    limits = make_export(
        DepthWeights(generator=of_all_kinds(), matcher=None, facts=TERMS), None, {}
    ).limits
    assert 0 < limits["depth_m"].flips <= 1e-3
    network = of_all_kinds()
    bias = network.head.bias
    assert bias is not None
    with torch.no_grad():
        bias[0] += 1.0
    write_depth_weights(selection / "w.safetensors", generator=network, facts=TERMS)
    assert export_to(selection) == 2
    assert not (selection / "depth.onnx").exists()


@pytest.mark.slow
def test_inference_without_torch_as_the_documentation_says(exported: Path) -> None:
    infer_as_documented(exported, least_px=1.0)


def infer_as_documented(exported: Path, least_px: float) -> None:
    """Run the lines of docs/export.md where torch is not, and compare with the estimator."""
    torch.manual_seed(2)
    image = torch.nn.functional.interpolate(torch.rand(1, 3, 9, 20), (70, 150), mode="bicubic")[0]
    write_image(exported / "street.png", image.clamp(0, 1))
    K = [[100.0, 0, 75], [0, 101.0, 35], [0, 0, 1]]
    camera = {"width": 150, "height": 70, "K": K}
    (exported / "camera.json").write_text(json.dumps(camera))
    (code,) = re.findall(r"```python\n(import json\n.*?)```", DOCS, re.DOTALL)
    blocked = "import sys\nsys.modules['torch'] = None\nsys.modules['depthpose'] = None\n"
    subprocess.run(
        [sys.executable, "-c", blocked + code], cwd=exported, check=True, capture_output=True
    )
    quick = MatcherConfig(speed="quick")
    net = FakestereoNet.load(exported / "w.safetensors", config=quick)
    expected = net.estimate(exported / "street.png", exported / "camera.json")
    assert expected.depth_m is not None
    depth_m = np.load(exported / "street.depth_m.npy")
    assert depth_m.shape == (70, 150)
    is_near = expected.disparity_px.numpy() >= least_px
    assert is_near.sum() > 1000
    is_close = np.isclose(depth_m, expected.depth_m.numpy(), rtol=0.01, equal_nan=True)
    assert is_close[is_near].mean() > (0.999 if expected.is_sky is not None else 1 - 1e-9)
    assert (expected.is_sky is not None) == bool(np.isnan(depth_m).any())


def test_weights_that_cannot_are_refused(tmp_path: Path) -> None:
    whole = tiny_weights()
    no_matcher = dataclasses.replace(whole, matcher=None)
    no_generator = dataclasses.replace(whole, generator=None)
    with pytest.raises(InputError, match=r"lack the matcher; 'depthpose weights pack'"):
        make_export(no_matcher, "image", {}).graph()
    with pytest.raises(InputError, match=r"lack the generator; 'depthpose weights pack'"):
        make_export(no_generator, "image", {}).graph()
    with pytest.raises(InputError, match="hold no matcher, only a generator"):
        make_export(no_matcher, "pair", {}).graph()
