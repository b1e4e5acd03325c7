"""The configs of the thesis, built as training builds them, against its printed numbers."""

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import yaml
from tests.pose.synthetic_linemod import make_linemod
from tests.pose.synthetic_objects import bracket
from torch import nn

from depthpose.core.config import config_to_dict, read_config
from depthpose.core.loop import TrainingRun
from depthpose.depth.config import PairsConfig
from depthpose.depth.datasets import read_split
from depthpose.depth.generators import UNetGenerator
from depthpose.depth.stereo import PSMNet
from depthpose.depth.train import STAGES as DEPTH_STAGES
from depthpose.depth.train import runs as depth_runs
from depthpose.depth.train.config import StereoTraining, ViewTraining
from depthpose.depth.train.pairs import TrainingPairs
from depthpose.pose.train import STAGES as POSE_STAGES

CONFIGS = Path(__file__).parents[1] / "configs"
OBJECTS = (1, 2, 4, 5, 6, 8, 9, 10, 11, 12, 13, 14, 15)
DEPTH = ("view", "stereo", "finetune")
POSE = {
    "thesis": "pose",
    "thesis-pointnet": "pointnet",
    "thesis-depth-image": "depth-image",
    "thesis-masks": "segmentation",
}
NO_WEIGHT_FOLLOWS = frozenset({
    # Given by words of the command: where the data lies, what a stage begins with.
    "generator", "matcher", "pairs.folders", "pairs.streets", "pairs.exclude", "pairs.limit",
    "models.cad", "models.unit", "models.parts", "models.symmetry_tolerance",
    # How fast, and what is looked at meanwhile.
    "pairs.with_cache", "loop.steps", "loop.workers", "loop.device", "loop.save_every_steps",
    "loop.validate_every_steps", "loop.log_every_steps", "held_out",
    # Without a meaning beside what is written.
    "encoder", "encoder_rate", "with_frozen_stem",
    "confidence_weight", "adam.halvings", "generator_adam.halvings", "discriminator_adam.halvings",
    # These follow from the models.
    "network.classes", "network.keypoints", "network.inputs",
})  # fmt: skip
ONLY_LOOKED_AT = ("held_out.", "objects.")
"""Made views teach nothing where all samples are frames (share 1)."""


class Training(NamedTuple):
    """What the loop was about to be given."""

    task: Any
    samples: Any
    config: Any

    @property
    def steps(self) -> int:
        return self.config.loop.total_steps(len(self.samples), 1)

    def rates(self, name: str, *epochs: int) -> list[float]:
        """Learning rate of an optimiser in the first step of an epoch."""
        _, adam = self.task.optimizers[name]
        return [adam.rate_at(epoch, round(self.config.loop.epochs)) for epoch in epochs]

    def learns(self, name: str) -> int:
        """Numbers that an optimiser moves."""
        (group,) = self.task.optimizers[name][0].param_groups
        return sum(p.numel() for p in group["params"] if p.requires_grad)

    def betas(self, name: str) -> tuple[float, float]:
        return self.task.optimizers[name][0].param_groups[0]["betas"]


class _BegunError(Exception):
    pass


class _NamedPairs(TrainingPairs):
    """As many pairs as the split names, and none of them on disk."""

    def __init__(self, config: PairsConfig, _seed: int, **needs: object) -> None:
        assert config.split is not None
        self.config, self.needs = config, needs
        self.names = read_split(config.split).names

    def __len__(self) -> int:
        return len(self.names)


def begun(
    monkeypatch: pytest.MonkeyPatch, where: object, name: str, begin: Callable[[], object]
) -> tuple[Any, ...]:
    """Run a training up to a function, and give what that is called with."""
    caught: list[tuple[Any, ...]] = []

    def stop(*given: Any, **more: Any) -> None:  # noqa: ANN401
        caught.append(given)
        raise _BegunError

    monkeypatch.setattr(where, name, stop)
    with pytest.raises(_BegunError):
        begin()
    return caught[0]


def depth_training(name: str, monkeypatch: pytest.MonkeyPatch, folder: Path) -> Training:
    kind, run_stage = DEPTH_STAGES[name]
    config = read_config(CONFIGS / f"depth/{name}.yaml", kind)
    monkeypatch.setattr(depth_runs, "TrainingPairs", _NamedPairs)
    run = TrainingRun(folder=folder)
    task, pairs, config, _ = begun(
        monkeypatch, depth_runs, "_run_stage", lambda: run_stage(config, run)
    )
    return Training(task, pairs, config)


@pytest.fixture(scope="module")
def linemod(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Thirteen objects with LineMOD's numbers, a training frame each."""
    folder = tmp_path_factory.mktemp("lm") / "Linemod_preprocessed"
    models = [dataclasses.replace(bracket(), number=number) for number in OBJECTS]
    make_linemod(folder, models)
    return folder


def pose_training(
    name: str, monkeypatch: pytest.MonkeyPatch, linemod: Path, folder: Path
) -> Training:
    kind, run_stage = POSE_STAGES[POSE[name]]
    config = read_config(CONFIGS / f"pose/{name}.yaml", kind)
    parts = {"models": "bop", "frames": "folder", "images": "folder"}
    there = {
        part: dataclasses.replace(getattr(config, part), **{setting: str(linemod)})
        for part, setting in parts.items()
        if hasattr(config, part)
    }
    config = dataclasses.replace(config, **there)
    run = TrainingRun(folder=folder)
    _, task, samples, *_ = begun(monkeypatch, TrainingRun, "train", lambda: run_stage(config, run))
    return Training(task, samples, task.config)


def parameters(module: nn.Module) -> int:
    return sum(p.numel() for p in module.parameters())


def settings(content: Mapping[str, Any], prefix: str = "") -> set[str]:
    """Dotted names of all settings that hold no further ones."""
    found: set[str] = set()
    for name, value in content.items():
        place = f"{prefix}{name}"
        found |= settings(value, f"{place}.") if isinstance(value, Mapping) else {place}
    return found


@pytest.mark.parametrize(
    ("path", "kind"),
    [(f"depth/{name}.yaml", DEPTH_STAGES[name][0]) for name in DEPTH]
    + [(f"pose/{name}.yaml", POSE_STAGES[what][0]) for name, what in POSE.items()],
)
def test_no_default_is_relied_on(path: str, kind: type) -> None:
    """A default may change for other reasons, and a published setting may not change with it."""
    written = settings(yaml.safe_load((CONFIGS / path).read_text()))
    every = settings(config_to_dict(read_config(CONFIGS / path, kind)))
    free = NO_WEIGHT_FOLLOWS | {setting for setting in every if setting.startswith(ONLY_LOOKED_AT)}
    assert every - written - free == set()


def test_the_generator_is_trained_as_printed(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Chapter 2.4.2 of the thesis, and pix2pix where it is silent."""
    found = depth_training("view", monkeypatch, tmp_path)
    assert found.learns("generator") == parameters(found.task.generator) == 54_413_955
    assert found.learns("discriminator") == 2_768_705
    for name in ("generator", "discriminator"):
        assert found.betas(name) == (0.5, 0.999)
        assert found.rates(name, 0, 100, 150, 200) == [1e-4, 1e-4, 5e-5, 0.0]
    assert (found.config.l1_weight, found.config.gan_mode) == (100.0, "vanilla")
    assert len(found.samples) == 23_488
    assert found.steps == 200 * 23_488 // 4
    assert found.samples.needs == {"needs_truth": False, "baseline_m": 0.5327}
    pairs = found.samples.config
    assert pairs.focal_px == found.task.generator.config.virtual_focal_px == 493.0
    assert sum(isinstance(m, nn.Dropout) for m in found.task.generator.modules()) == 3
    augment = {"crop_px": (256, 512), "scale": (1.0, 1.0), "jitter": 0.2, "flip_share": 0.5}
    augment |= {"per_view": None, "erased_share": 0.0, "misaligned_px": 0.0}
    assert dataclasses.asdict(pairs.augment) == augment


def test_the_matcher_is_trained_as_printed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    found = depth_training("stereo", monkeypatch, tmp_path)
    (name,) = found.task.optimizers
    assert found.learns(name) == 5_224_768
    assert found.betas(name) == (0.9, 0.999)
    assert found.rates(name, 0, 4, 5, 10, 15, 19) == [1e-4, 1e-4, 5e-5, 2.5e-5, 1.25e-5, 1.25e-5]
    assert found.config.network_config.max_disparity_px == 192
    assert (len(found.samples), found.steps) == (23_488, 20 * 23_488 // 4)
    assert found.samples.needs["needs_truth"]
    assert found.samples.config.augment == PairsConfig().augment
    assert found.samples.config.augment.crop_px == (256, 512)


def test_fine_tuning_moves_the_generator_alone(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Chapter 2.5.3: 60 epochs, depth as the only supervision, the matcher as it is."""
    view = read_config(CONFIGS / "depth/view.yaml", ViewTraining)
    stereo = read_config(CONFIGS / "depth/stereo.yaml", StereoTraining)
    made = {"generator": UNetGenerator(view.generator), "matcher": PSMNet(stereo.network_config)}
    monkeypatch.setattr(depth_runs, "find_weights", Path)
    for reader, part in (("read_generator", "generator"), ("read_matcher", "matcher")):
        monkeypatch.setattr(depth_runs, reader, lambda _, n=made[part]: n)
    kind, run_stage = DEPTH_STAGES["finetune"]
    words = {part: f"{part}.safetensors" for part in made}
    monkeypatch.setitem(
        DEPTH_STAGES,
        "finetune",
        (kind, lambda config, run: run_stage(dataclasses.replace(config, **words), run)),
    )
    found = depth_training("finetune", monkeypatch, tmp_path)
    assert list(found.task.optimizers) == ["generator"]
    assert found.learns("generator") == 54_413_955
    assert not any(p.requires_grad for p in found.task.matcher.parameters())
    assert not any(m.training for m in found.task.matcher.modules())
    assert found.betas("generator") == (0.5, 0.999)
    assert found.rates("generator", 0, 59) == [1e-4, 1e-4]
    assert found.config.l1_weight == 0.0
    assert (len(found.samples), found.steps) == (23_488, 352_320)
    assert found.samples.config.focal_px == 493.0


def test_the_pose_network_is_the_published_one(
    monkeypatch: pytest.MonkeyPatch, linemod: Path, tmp_path: Path
) -> None:
    """Figure 3-3: 312 outputs, no batch norm; Adam as published, halved every 100 epochs."""
    found = pose_training("thesis", monkeypatch, linemod, tmp_path)
    network = found.task.network
    assert found.learns("network") == parameters(network) == 8_774_168
    assert not [m for m in network.modules() if isinstance(m, nn.BatchNorm1d)]
    assert [n for n, _ in network.named_parameters() if n.endswith("bias")] == ["final.bias"]
    assert network.final.weight.shape[1:] == (64, 13 * 8 * 3)
    assert network.down[0].conv.weight.shape == (7**3, 1, 32)
    config = found.config
    assert (config.cloud.voxel_m, config.cloud.max_points) == (0.001, 500)
    assert config.loss == "mse"
    assert (config.loop.batch_size, config.loop.epochs) == (8, 500)
    assert found.rates("network", 0, 99, 100, 250, 499) == [1e-4, 1e-4, 5e-5, 2.5e-5, 6.25e-6]
    assert found.betas("network") == (0.9, 0.999)
    assert len(found.samples) == 13, "each training frame once an epoch, and no synthetic view"
    cloud = found.samples[0]
    assert cloud.features.unique().tolist() == [1.0]
    assert len(cloud.points_m) <= 500


def test_the_baselines_see_what_the_method_sees(
    monkeypatch: pytest.MonkeyPatch, linemod: Path, tmp_path: Path
) -> None:
    """Table 3.1: another network, and the same frames, points, schedule and keypoints."""
    ours = pose_training("thesis", monkeypatch, linemod, tmp_path / "ours").config
    sizes = {}
    for name in ("thesis-pointnet", "thesis-depth-image"):
        found = pose_training(name, monkeypatch, linemod, tmp_path / name)
        sizes[name] = found.learns("network")
        assert sizes[name] == parameters(found.task.network)
        for part in ("models", "frames", "cloud", "adam", "loop"):
            assert getattr(found.config, part) == getattr(ours, part), part
        assert len(found.samples) == 13
    assert sizes["thesis-pointnet"] >= 3_500_000
    # ResNet-18 with one channel in, and nine numbers of each object in place of 1,000 classes.
    encoder = 11_689_512 - 513 * 1000 - 2 * 64 * 7**2
    assert sizes["thesis-depth-image"] == encoder + 513 * 13 * 9
    assert found.config.network.crop_px == 128


def test_the_segmentation_knows_the_same_objects(
    monkeypatch: pytest.MonkeyPatch, linemod: Path, tmp_path: Path
) -> None:
    found = pose_training("thesis-masks", monkeypatch, linemod, tmp_path)
    assert tuple(found.task.objects) == OBJECTS
    assert found.task.network.classes == 14
    assert found.config.network.stride == 8
    assert len(found.samples) == 13
