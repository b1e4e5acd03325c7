"""Small networks and short trainings of depth, which several tests share."""

import shutil
from pathlib import Path

import pytest
import torch
from tests.synthetic_street import write_pairs
from torch import Tensor, nn

from depthpose.core.loop import LoopConfig
from depthpose.depth.config import AugmentConfig, GeneratorConfig, PairsConfig, PSMNetConfig
from depthpose.depth.generators import UNetGenerator
from depthpose.depth.stereo import PSMNet
from depthpose.depth.weights import write_depth_weights

LOOP = LoopConfig(steps=3, batch_size=2, device="cpu", log_every_steps=1)
TINY_MATCHER = PSMNetConfig(width=2, max_disparity_px=16, blocks=(1, 1, 1, 1), pools=(2,))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A plain folder of three synthetic pairs with disparity."""
    return write_pairs(tmp_path_factory.mktemp("pairs"), (0.2, 0.2, 0.25))


@pytest.fixture(scope="module")
def held_folder(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    """The same pairs in other files, to hold out."""
    return str(shutil.copytree(folder, tmp_path_factory.mktemp("held") / "pairs"))


@pytest.fixture
def pairs(folder: Path) -> PairsConfig:
    """Crops of those pairs, as a training takes them."""
    return PairsConfig(
        folders=(str(folder),), focal_px=130.0, augment=AugmentConfig(crop_px=(64, 96))
    )


def snapshot(module: nn.Module) -> dict[str, Tensor]:
    """What a network holds now, by name."""
    return {name: tensor.clone() for name, tensor in module.state_dict().items()}


def write_tiny_weights(home: Path) -> None:
    """Write untrained weights: ``w`` of both networks, ``m`` of the matcher alone."""
    torch.manual_seed(0)
    generator = UNetGenerator(GeneratorConfig(width=2, levels=3, virtual_focal_px=70.0))
    matcher = PSMNet(TINY_MATCHER)
    facts = {"trained_on": "nothing", "licence": "MIT"}
    write_depth_weights(home / "w.safetensors", generator=generator, matcher=matcher, facts=facts)
    write_depth_weights(home / "m.safetensors", matcher=matcher, facts=facts)
