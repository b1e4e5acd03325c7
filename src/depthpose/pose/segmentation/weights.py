"""Weights of segmentation on disk: the network with the names of its objects."""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import torch

from depthpose.core.checkpoint import Checkpoint, build_network, read_checkpoint, save_checkpoint
from depthpose.core.config import config_from_dict, config_to_dict
from depthpose.core.errors import InputError
from depthpose.pose.segmentation.config import SegmentationConfig
from depthpose.pose.segmentation.network import FCN

KIND = "segmentation"


@dataclass(frozen=True, kw_only=True, eq=False)
class SegmentationWeights:
    """What a weights file of this kind holds.

    Attributes:
        network: in eval mode; class 0 is the background, class ``1 + i`` is ``objects[i]``.
        objects: names, in the order of the classes.
        numbers: BOP's ``obj_id`` of each.
        facts: the card in short: ``trained_on``, ``licence`` and the like.
    """

    network: FCN
    objects: tuple[str, ...]
    numbers: tuple[int, ...]
    facts: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        assert len(self.objects) == len(self.numbers) == self.network.classes - 1


def write_segmentation(
    path: Path, weights: SegmentationWeights, *, with_half: bool = False
) -> None:
    """Write a network with its config and objects to one ``.safetensors`` file.

    Args:
        path: where to.
        weights: what to write.
        with_half: store 16-bit floats: half the size.
    """
    config = {
        "network": config_to_dict(weights.network.config),
        "objects": list(weights.objects),
        "numbers": list(weights.numbers),
    }
    state = weights.network.state_dict()
    if with_half:
        state = {k: t.to(torch.float16) if t.is_floating_point() else t for k, t in state.items()}
    save_checkpoint(path, Checkpoint(kind=KIND, config=config, state=state, facts=weights.facts))


def read_segmentation(path: Path) -> SegmentationWeights:
    """Read what :func:`write_segmentation` wrote.

    Raises:
        InputError: no such weights, or weights that do not fit their own config.
    """
    checkpoint = read_checkpoint(path, KIND)
    config = config_from_dict(checkpoint.config, _FileConfig, source=str(path))
    if len(config.objects) != len(config.numbers) or not config.objects:
        raise InputError(
            f"{path}: its config names {len(config.objects)} objects and {len(config.numbers)} "
            "numbers; each object has both. Export it again."
        )
    count, knobs = len(config.objects), config.network
    network = build_network(lambda: FCN(count, knobs), checkpoint, str(path))
    return SegmentationWeights(
        network=network.eval(),
        objects=config.objects,
        numbers=config.numbers,
        facts=checkpoint.facts,
    )


@dataclass(frozen=True)
class _FileConfig:
    network: SegmentationConfig = dataclasses.field(default_factory=SegmentationConfig)
    objects: tuple[str, ...] = ()
    numbers: tuple[int, ...] = ()
