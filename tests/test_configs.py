"""Every config is read, says its command, and takes its first step."""

import dataclasses
import re
from pathlib import Path

import pytest
import torch

from depthpose.core.config import config_to_dict, read_config
from depthpose.depth.augment import TrainingPair
from depthpose.depth.datasets import open_dataset, read_split
from depthpose.depth.disparity import size_at_focal_length
from depthpose.depth.generators import UNetGenerator
from depthpose.depth.stereo import PSMNet
from depthpose.depth.synthesis import MAX_ROW_STRETCH
from depthpose.depth.synthetic import kitti_rig
from depthpose.depth.train import STAGES, FinetuneTask, ViewTask
from depthpose.depth.train.config import FinetuneTraining, StereoTraining, ViewTraining

FOLDER = Path(__file__).parents[1] / "configs" / "depth"
FILES = sorted(FOLDER.glob("*.yaml"))


WHOLLY_KEPT_BACK = ("kitti2015_eval_drives", "kitti_raw_0056")
"""Folders of samples whose frames are all of Eigen test drives."""
KEPT_BACK = {
    "kitti_object": ("000001", "000002", "000050", "001207", "001267", "001531", "001554"),
    "kitti_object_more": (
        "train_000007",
        "train_000008",
        "train_000009",
        "train_000010",
        "train_000013",
    ),
    "kitti_raw": (
        *(f"2011_09_26_drive_9001_sync_{k:010d}" for k in (0, 1)),
        *(f"2011_09_26_drive_0052_sync_{k:010d}" for k in (0, 4, 8, 12, 16, 20, 26, 30)),
    ),
}
"""Frames of Eigen test drives beside others: no training may see them."""


def stage_of(path: Path) -> str:
    return path.stem.rpartition("-")[2]


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_a_config_is_read_and_opens_with_its_own_command(path: Path) -> None:
    read_config(path, STAGES[stage_of(path)][0])
    head = [line for line in path.read_text().splitlines() if line.startswith("#")]
    command = f"depthpose depth train {stage_of(path)} --config configs/depth/{path.name}"
    assert any(command in line for line in head)
    assert re.search("[Ww]all time|Published result|compact generator through", "\n".join(head))


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_no_training_sees_a_frame_of_a_test_drive(path: Path) -> None:
    config = read_config(path, STAGES[stage_of(path)][0])
    for pairs in filter(None, (config.pairs, getattr(config, "held_out", None))):
        for folder in pairs.folders:
            name = Path(folder).name
            assert name not in WHOLLY_KEPT_BACK
            assert set(KEPT_BACK.get(name, ())) <= set(pairs.exclude)


@pytest.mark.data
def test_the_frames_that_are_kept_back_are_those_of_the_samples(real: Path) -> None:
    """A frame of another name would be left out of nothing."""
    homes = {"kitti_object": "kitti_object", "kitti_raw": "kitti_raw"}
    for name, frames in KEPT_BACK.items():
        dataset = open_dataset(real / "depth" / homes.get(name, f"street_pairs/{name}"))
        assert set(frames) <= {frame.name for frame in dataset.frames}
    drives = {drive for drive, _ in read_split("eigen-test").frames}
    for name in WHOLLY_KEPT_BACK:
        assert _drives(real / "depth/street_pairs" / name / "index.txt") <= drives
    seen = _drives(real / "depth/street_pairs/kitti2015_train_drives/index.txt")
    assert len(seen) == 14
    assert not seen & drives


def _drives(index: Path) -> set[str]:
    return set(re.findall(r"\d{4}_\d\d_\d\d_drive_\d{4}_sync", index.read_text()))


@pytest.mark.parametrize("name", ["view", "stereo", "finetune"])
def test_one_setting_leaves_the_stages_other_defaults(name: str, tmp_path: Path) -> None:
    """Nested defaults are the stage's: Adam's betas for the GAN, the length of each loop."""
    kind = STAGES[name][0]
    adam = "generator_adam" if name == "view" else "adam"
    (tmp_path / "c.yaml").write_text(f"{adam}: {{learning_rate: 0.5}}\nloop: {{batch_size: 2}}\n")
    found, default = config_to_dict(read_config(tmp_path / "c.yaml", kind)), config_to_dict(kind())
    default[adam]["learning_rate"], default["loop"]["batch_size"] = 0.5, 2
    assert found == default
    (tmp_path / "c.yaml").write_text("loop: {steps: 7}\n")
    assert read_config(tmp_path / "c.yaml", kind).loop.epochs is None


@pytest.mark.parametrize("name", ["view", "stereo", "finetune"])
def test_the_thesis_settings_are_the_defaults(name: str) -> None:
    """The three full configs only spell out what the dataclasses say already."""
    kind = STAGES[name][0]
    found = config_to_dict(read_config(FOLDER / f"{name}.yaml", kind))
    default = config_to_dict(kind())
    for part in ("pairs", "network"):
        if isinstance(found.get(part), dict):
            del found[part], default[part]
    del found["loop"]["workers"], default["loop"]["workers"]
    assert found == default


@pytest.mark.parametrize("name", ["view", "compact-view"])
def test_a_crop_is_the_whole_height_of_every_rig(name: str) -> None:
    """So a frame at test is resized by 3 % at most and never mirrored, whatever KITTI's day."""
    config = read_config(FOLDER / f"{name}.yaml", ViewTraining)
    crop_rows = config.pairs.augment.crop_px[0]
    assert crop_rows % config.generator.side_multiple_px == 0
    for number in range(5):
        rows, _ = size_at_focal_length(kitti_rig(number), config.generator.virtual_focal_px)
        assert crop_rows <= rows <= (1 + MAX_ROW_STRETCH) * crop_rows


def pair(height: int, width: int) -> TrainingPair:
    generator = torch.Generator().manual_seed(0)
    images = torch.rand(2, 1, 3, height, width, generator=generator)
    truth = torch.full((1, height, width), 5.0)
    return TrainingPair(images[0], images[1], truth, truth)


@pytest.mark.slow
def test_the_full_widths_take_a_step() -> None:
    """54 million parameters against a 70x70 discriminator, then the full PSMNet, at 256x512."""
    view = read_config(FOLDER / "view.yaml", ViewTraining)
    stereo = read_config(FOLDER / "stereo.yaml", StereoTraining)
    tune = read_config(FOLDER / "finetune.yaml", FinetuneTraining)
    network = UNetGenerator(view.generator)
    for task in (
        ViewTask(network, view, None),
        FinetuneTask(network, PSMNet(stereo.network_config), tune, None),
    ):
        for turn in task.step(pair(256, 512)):
            assert bool(turn.loss.isfinite())
            turn.loss.backward()
            task.optimizers[turn.optimizer][0].step()
    assert all(bool(p.isfinite().all()) for p in network.parameters())


def test_the_compact_set_takes_a_step() -> None:
    view = read_config(FOLDER / "compact-view.yaml", ViewTraining)
    stereo = read_config(FOLDER / "compact-stereo.yaml", StereoTraining)
    assert view.generator.virtual_focal_px == stereo.network_config.work_focal_px
    small = dataclasses.replace(stereo.network_config, blocks=(1, 1, 1, 1))
    task = FinetuneTask(UNetGenerator(view.generator), PSMNet(small), FinetuneTraining(), None)
    (turn,) = task.step(pair(192, 256))
    turn.loss.backward()
    assert bool(turn.loss.isfinite())
