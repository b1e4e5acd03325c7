"""Weights of the ResUNet on disk."""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from depthpose.core.checkpoint import Checkpoint, load_weights, read_checkpoint, save_checkpoint
from depthpose.core.config import config_from_dict, config_to_dict
from depthpose.core.errors import InputError
from depthpose.pose.network.config import ResUNetConfig
from depthpose.pose.network.resunet import ResUNet

KIND = "geoposenet"


@dataclass(frozen=True, kw_only=True, eq=False)
class NetworkWeights:
    """What a weights file of this kind holds.

    Attributes:
        network: in eval mode.
        settings: what else one must know to use it, by name: voxel size, objects, keypoints.
        facts: the card in short: ``trained_on``, ``licence`` and the like.
    """

    network: ResUNet
    settings: Mapping[str, Any] = field(default_factory=dict)
    facts: Mapping[str, str] = field(default_factory=dict)


def write_network(path: Path, weights: NetworkWeights) -> None:
    """Write a network with its config and settings to one ``.safetensors`` file."""
    config = {**weights.settings, "network": config_to_dict(weights.network.config)}
    facts = {**weights.facts, "norm_mode": weights.network.config.norm}
    state = weights.network.state_dict()
    save_checkpoint(path, Checkpoint(kind=KIND, config=config, state=state, facts=facts))


def read_network(path: Path) -> NetworkWeights:
    """Read what :func:`write_network` wrote; 16-bit weights come back as 32-bit.

    Raises:
        InputError: no such weights, or weights that do not fit their own config.
    """
    checkpoint = read_checkpoint(path, KIND)
    settings = dict(checkpoint.config)
    config = settings.pop("network", None)
    if not isinstance(config, Mapping):
        raise InputError(f"{path}: its config has no 'network', so the network's size is unknown.")
    network = ResUNet(config_from_dict(config, ResUNetConfig, source=str(path)))
    load_weights(network, checkpoint, str(path))
    facts = {k: v for k, v in checkpoint.facts.items() if k != "norm_mode"}
    return dataclasses.replace(
        NetworkWeights(network=network.eval()), settings=settings, facts=facts
    )
