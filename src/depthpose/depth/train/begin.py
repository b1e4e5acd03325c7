"""Networks at the start of a training: their config's, with the weights that it names."""

from typing import Any, cast

from torch import nn

from depthpose.core.checkpoint import find_weights
from depthpose.core.config import config_to_dict
from depthpose.core.errors import InputError
from depthpose.depth.encoder import load_encoder
from depthpose.depth.stereo import StereoNetwork
from depthpose.depth.stereo.registry import make_network
from depthpose.depth.synthesis import Generator
from depthpose.depth.train.config import SelectTraining, StereoTraining
from depthpose.depth.weights import read_matcher

_FREE_OF_WEIGHTS = ("max_disparity_px", "with_street", "least_confidence")
"""Settings that the weights of a training do not depend on: a matcher searches any disparities in
the same way, and which images are refused is found after a training."""
_CAN_BE_ADDED = ("with_agreement", "with_refinement", "with_sky")
"""Parts that begin with next to no effect, so weights without them can be trained on with them."""


def refuse_frozen_random(config: SelectTraining | StereoTraining) -> None:
    """Refuse to keep the first layers of an encoder that begins at random."""
    if config.with_frozen_stem and config.encoder is None and config.start is None:
        raise InputError(
            "with_frozen_stem keeps the encoder's first layers as they are, and nothing says what "
            "they begin with: give --encoder ('depthpose weights import efficientnet-lite0'), "
            "--start, or with_frozen_stem: false with encoder_rate: 1.0."
        )


def start_from(network: Generator | StereoNetwork, found: nn.Module, source: str) -> None:
    """Copy weights whose config is the network's own, but for what no weight depends on.

    What the network has beyond them keeps its beginning, where that has no effect.

    Raises:
        InputError: another kind of network, or a setting differs, so the weights would mean
            something else.
    """
    if type(found) is not type(network):
        raise InputError(
            f"{source}: holds weights of {type(found).__name__}, but the config trains "
            f"{type(network).__name__}. Give weights of that network."
        )
    wanted, given = config_to_dict(network.config), config_to_dict(cast("Any", found).config)
    for setting, value in wanted.items():
        is_added = setting in _CAN_BE_ADDED and value and not given[setting]
        if given[setting] != value and setting not in _FREE_OF_WEIGHTS and not is_added:
            raise InputError(
                f"{source}: was trained with {setting} = {given[setting]!r}, but the config says "
                f"{value!r}. Give the config the weights' own."
            )
    own = network.state_dict()
    network.load_state_dict(own | {k: t for k, t in found.state_dict().items() if k in own})


def make_matcher_network(config: StereoTraining) -> StereoNetwork:
    """Make the network that a config trains, with the weights that it begins with."""
    matcher = make_network(config.network)
    if config.encoder is not None:
        if matcher.encoder is None:
            raise InputError(
                f"--encoder {config.encoder}: {type(matcher).__name__} has no encoder of its own "
                "kind; give the config a light network (light: {}), or leave it out."
            )
        load_encoder(matcher.encoder, find_weights(config.encoder))
    if matcher.encoder is not None:
        refuse_frozen_random(config)
    if config.start is not None:
        start_from(matcher, read_matcher(find_weights(config.start)), config.start)
    return matcher
