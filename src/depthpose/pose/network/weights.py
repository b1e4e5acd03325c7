"""A bare network on disk: what the importer of published weights makes, without any object."""

from collections.abc import Mapping
from pathlib import Path

from depthpose.core.checkpoint import Checkpoint, build_network, read_checkpoint, save_checkpoint
from depthpose.core.config import config_from_dict, config_to_dict
from depthpose.pose.network.config import ResUNetConfig
from depthpose.pose.network.resunet import ResUNet

KIND = "resunet"


def write_network(path: Path, network: ResUNet, facts: Mapping[str, str]) -> None:
    """Write a network with its config to one ``.safetensors`` file."""
    config, state = config_to_dict(network.config), network.state_dict()
    facts = {**facts, "norm_mode": network.config.norm}
    save_checkpoint(path, Checkpoint(kind=KIND, config=config, state=state, facts=facts))


def read_network(path: Path) -> ResUNet:
    """Read what :func:`write_network` wrote, in eval mode.

    Raises:
        InputError: no such weights, or weights that do not fit their own config.
    """
    return network_of(read_checkpoint(path, KIND), str(path))


def network_of(checkpoint: Checkpoint, source: str) -> ResUNet:
    """Build the network of a checkpoint, in eval mode; 16-bit weights come back as 32-bit.

    Raises:
        InputError: weights that do not fit their own config.
    """
    config = config_from_dict(checkpoint.config, ResUNetConfig, source=source)
    return build_network(lambda: ResUNet(config), checkpoint, source).eval()
