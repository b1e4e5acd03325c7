"""What it takes to add a matcher, a layout, a metric, a loss or an export target."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from depthpose.cli import main
from depthpose.core.camera import Camera, StereoRig, write_camera
from depthpose.core.config import config_from_dict
from depthpose.core.errors import InputError
from depthpose.core.export import Case, Export, Graph, Limit
from depthpose.core.files import read_map, write_depth_png, write_image, write_map
from depthpose.core.loop import LoopConfig, TrainingRun
from depthpose.depth.augment import TrainingPair
from depthpose.depth.config import (
    AugmentConfig,
    GeneratorConfig,
    MatcherConfig,
    NetworkConfig,
    PairsConfig,
)
from depthpose.depth.datasets import open_dataset
from depthpose.depth.datasets.frames import FramePaths
from depthpose.depth.datasets.layouts import LAYOUTS, Layout
from depthpose.depth.estimator import FakestereoNet
from depthpose.depth.export import TARGETS, Target, make_export
from depthpose.depth.generators import UNetGenerator
from depthpose.depth.losses import ADVERSARIAL_LOSSES, adversarial_loss
from depthpose.depth.metrics import METRICS, Metric
from depthpose.depth.stereo import StereoNetwork
from depthpose.depth.train.config import FinetuneTraining, StereoTraining
from depthpose.depth.train.runs import train_finetune, train_stereo
from depthpose.depth.train.stereo_task import StereoTask
from depthpose.depth.types import Match
from depthpose.depth.weights import (
    MATCHERS,
    DepthWeights,
    MatcherKind,
    read_depth_weights,
    write_depth_weights,
)

W, H = 64, 32
FACTS = {"licence": "MIT", "trained_on": "nothing"}


@pytest.fixture
def pairs(tmp_path: Path) -> Path:
    """Two pairs with a true disparity of 5 px, in the layout 'pairs'."""
    K = torch.tensor([[80.0, 0, 31], [0, 80, 15], [0, 0, 1]], dtype=torch.float64)
    home = tmp_path / "pairs"
    for name in "ab":
        write_image(home / "left" / f"{name}.png", torch.rand(3, H, W))
        write_image(home / "right" / f"{name}.png", torch.rand(3, H, W))
        write_depth_png(home / "disp_occ" / f"{name}.png", torch.full((H, W), 5.0))
    write_camera(home / "camera.json", StereoRig(width=W, height=H, K=K, baseline_m=0.5))
    return home


@dataclass(frozen=True, kw_only=True)
class FlatConfig(NetworkConfig):
    """Settings of the example's network."""

    most_px: float = 10.0


class FlatNetwork(StereoNetwork):
    """Learns one disparity for all pixels."""

    def __init__(self, config: FlatConfig) -> None:
        super().__init__()
        self.config = config
        self.share = nn.Parameter(torch.tensor(0.4))

    def forward(self, left: Tensor, right: Tensor) -> tuple[Tensor]:  # noqa: ARG002
        """Give every pixel one disparity [px]."""
        return (self.share * self.config.most_px + torch.zeros_like(left[:, 0]),)


class FlatMatcher:
    """Runs the example's network."""

    def __init__(self, network: FlatNetwork, config: MatcherConfig) -> None:
        self.config = config
        self.value_px = float(network.share.detach()) * network.config.most_px

    def match(
        self,
        left: Tensor,
        right: Tensor,  # noqa: ARG002
        camera: Camera | None = None,  # noqa: ARG002
    ) -> Match:
        """Give every pixel one disparity."""
        return Match(disparity_px=torch.full(tuple(left.shape[-2:]), self.value_px))


def test_extending_matchers_with_weights(
    pairs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kind = MatcherKind(config=FlatConfig, network=FlatNetwork, matcher=FlatMatcher)
    monkeypatch.setitem(MATCHERS, "flat", kind)
    weights = tmp_path / "flat.safetensors"
    write_depth_weights(weights, matcher=FlatNetwork(FlatConfig(most_px=20.0)), facts=FACTS)
    dataset = open_dataset(pairs)
    for net in (FakestereoNet.load(weights), FakestereoNet.load(matcher=weights)):
        found = net.estimate_input(dataset.read_input(0))
        assert torch.equal(found.disparity_px, torch.full((H, W), 8.0))
        assert found.depth_m is not None
    given = [str(pairs / "left"), str(pairs / "right")]
    camera = ["--camera", str(pairs / "camera.json"), "--no-check"]
    for k, how in enumerate((["--weights", str(weights)], ["--matcher", str(weights)])):
        out = tmp_path / f"match-{k}"
        assert main(["depth", "match", *given, *camera, *how, "--out", str(out)]) == 0
        assert float(read_map(out / "a.disparity_px.npy")[0, 0]) == 8.0
    data = ["--data", str(pairs), "--protocol", "kitti-2015"]
    out = tmp_path / "evaluated"
    assert main(["depth", "evaluate", *data, "--weights", str(weights), "--out", str(out)]) == 0
    assert "| flat | both views | fine | flat |" in (out / "table.md").read_text()


def test_extending_matchers_with_training(
    pairs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kind = MatcherKind(config=FlatConfig, network=FlatNetwork, matcher=FlatMatcher)
    monkeypatch.setitem(MATCHERS, "flat", kind)
    network = FlatNetwork(FlatConfig())
    truth_px = torch.full((2, H, W), 5.0)
    images = torch.rand(2, 3, H, W)
    batch = TrainingPair(left=images, right=images, left_px=truth_px, right_px=truth_px)
    (turn,) = StereoTask(network, StereoTraining(), None).step(batch)
    turn.loss.backward()
    assert network.share.grad is not None
    assert float(network.share.grad) < 0, "4 px found, 5 px true"
    assert float(turn.facts["epe"]) == pytest.approx(1.0)

    # A training by its config, as the command reads it from YAML.
    words: dict[str, Any] = {"kind": "flat", "network": {"most_px": 12.0}}
    words["loop"] = {"steps": 1, "batch_size": 1}
    words["pairs"] = {"folders": [str(pairs)], "augment": {"crop_px": [16, 16]}}
    training = config_from_dict(words, StereoTraining, source="flat.yaml")
    trained = read_depth_weights(
        train_stereo(training, TrainingRun(folder=tmp_path / "stereo"))
    ).matcher
    assert isinstance(trained, FlatNetwork)
    assert trained.config.most_px == 12.0

    # Fine-tuning a generator takes its matcher from any weights.
    weights, generator = tmp_path / "flat.safetensors", tmp_path / "generator.safetensors"
    write_depth_weights(weights, matcher=network, facts=FACTS)
    small = GeneratorConfig(levels=2, width=4, virtual_focal_px=50.0,
                            virtual_baseline_m=0.5)  # fmt: skip
    write_depth_weights(generator, generator=UNetGenerator(small), facts=FACTS)
    config = FinetuneTraining(
        generator=str(generator),
        matcher=str(weights),
        pairs=PairsConfig(folders=(str(pairs),), augment=AugmentConfig(crop_px=(16, 16))),
        loop=LoopConfig(steps=1, batch_size=1),
    )
    out = train_finetune(config, TrainingRun(folder=tmp_path / "run"))
    assert isinstance(read_depth_weights(out).matcher, FlatNetwork)


def test_a_matcher_without_a_graph_is_not_exported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kind = MatcherKind(config=FlatConfig, network=FlatNetwork, matcher=FlatMatcher)
    monkeypatch.setitem(MATCHERS, "flat", kind)
    weights = tmp_path / "flat.safetensors"
    write_depth_weights(weights, matcher=FlatNetwork(FlatConfig()), facts=FACTS)
    with pytest.raises(InputError, match="the matcher is FlatNetwork, and no file is made of it"):
        make_export(read_depth_weights(weights), "pair", {}).graph()


def test_extending_layouts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def find(folder: Path) -> Iterable[FramePaths]:
        for left in sorted(folder.glob("*-cam0.png")):
            name = left.stem.removesuffix("-cam0")
            right = folder / f"{name}-cam1.png"
            yield FramePaths(name=name, left=left, right=right, calibration=None, style="plain")

    monkeypatch.setitem(LAYOUTS, "numbered", Layout(find=find, parts="NAME-cam0.png"))
    for side in (0, 1):
        write_image(tmp_path / f"x-cam{side}.png", torch.full((3, H, W), side / 2))
    dataset = open_dataset(tmp_path)
    assert (dataset.layout, [frame.name for frame in dataset.frames]) == ("numbered", ["x"])
    right = dataset.read_input(0).right
    assert right is not None
    assert float(right.mean()) == pytest.approx(0.5, abs=0.01)
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"numbered \(NAME-cam0\.png\)"):
        open_dataset(tmp_path / "empty")


def test_extending_metrics(
    pairs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def median_px(predicted: Tensor, true: Tensor) -> float:
        return float((predicted - true).abs().median())

    metric = Metric(name="median_px", of="disparity", function=median_px)
    monkeypatch.setitem(METRICS, metric.name, metric)
    for name, error in (("a", 1.0), ("b", 2.0)):
        path = tmp_path / "p" / f"{name}.disparity_px.npy"
        write_map(path, torch.full((H, W), 5.0 + error))
    out = tmp_path / "out"
    data = ["--data", str(pairs), "--protocol", "kitti-2015", "--predictions", str(tmp_path / "p")]
    assert main(["depth", "evaluate", *data, "--out", str(out)]) == 0
    assert "epe_px  d1_all  median_px" in capsys.readouterr().out
    assert "median_px" in (out / "rows.csv").read_text().splitlines()[0]
    assert (out / "rows.csv").read_text().splitlines()[1].endswith(",1.5")
    assert "median_px" in (out / "report.html").read_text().replace("<wbr>", "")


def test_the_worst_frame_is_that_of_the_lowest_value_where_higher_is_better(
    pairs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    metric = Metric(name="epe_px", of="disparity", function=_share_close, better="higher")
    monkeypatch.setitem(METRICS, "epe_px", metric)
    for name, error in (("a", 0.5), ("b", 2.0)):
        path = tmp_path / "p" / f"{name}.disparity_px.npy"
        write_map(path, torch.full((H, W), 5.0 + error))
    out = tmp_path / "out"
    data = ["--data", str(pairs), "--protocol", "kitti-2015", "--predictions", str(tmp_path / "p")]
    assert main(["depth", "evaluate", *data, "--out", str(out)]) == 0
    page = (out / "report.html").read_text()
    assert "p: b, worst" in page
    assert "p: a, best" in page


def _share_close(predicted: Tensor, true: Tensor) -> float:
    return float(((predicted - true).abs() < 1).double().mean())


def test_extending_adversarial_losses(monkeypatch: pytest.MonkeyPatch) -> None:
    def hinge(logits: Tensor, wanted: Tensor) -> Tensor:
        return (1 - (2 * wanted - 1) * logits).clamp(min=0).mean()

    monkeypatch.setitem(ADVERSARIAL_LOSSES, "hinge", hinge)
    logits = torch.full((1, 1, 2, 2), 0.25)
    assert float(adversarial_loss(logits, "hinge", is_real=True)) == pytest.approx(0.75)
    assert float(adversarial_loss(logits, "hinge", is_real=False)) == pytest.approx(1.25)


def test_extending_export_targets(monkeypatch: pytest.MonkeyPatch) -> None:
    def views(weights: DepthWeights, facts: dict[str, object]) -> Export:
        cases: list[Case] = []
        limits = {"right": Limit(value=1e-3)}
        return Export(graph=Graph, cases=lambda: cases, limits=limits, facts=facts)

    weights = DepthWeights(generator=None, matcher=FlatNetwork(FlatConfig()), facts=FACTS)
    with pytest.raises(InputError, match=r"what is 'views'; .*'image', 'pair'"):
        make_export(weights, "views", {})
    monkeypatch.setitem(TARGETS, "views", Target(fits=lambda _: False, export=views))
    export = make_export(weights, "views", {"licence": "MIT"})
    assert list(export.limits) == ["right"]
    assert make_export(weights, None, {}).facts["what"].startswith("rectified pair")
