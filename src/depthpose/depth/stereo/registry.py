"""Matchers with weights, by the kind that their weights files name."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from depthpose.core.errors import InputError
from depthpose.depth.config import LightConfig, MatcherConfig, PSMNetConfig
from depthpose.depth.stereo.light import LightStereo
from depthpose.depth.stereo.light_matcher import LightMatcher
from depthpose.depth.stereo.matcher import Matcher
from depthpose.depth.stereo.network_matcher import StereoNetwork
from depthpose.depth.stereo.psmnet import PSMNet
from depthpose.depth.stereo.psmnet_matcher import PSMNetMatcher


@dataclass(frozen=True, kw_only=True)
class MatcherKind:
    """What it takes to read, write and run one kind of matcher.

    Attributes:
        config: dataclass of the network's sizes and conventions, which its weights file holds.
        network: makes the module of a config, and keeps it as the attribute ``config``.
        matcher: makes a matcher of a module in eval mode.
    """

    config: type
    network: type[StereoNetwork]
    matcher: Callable[[Any, MatcherConfig], Matcher]


MATCHERS = {
    "psmnet": MatcherKind(config=PSMNetConfig, network=PSMNet, matcher=PSMNetMatcher),
    "light": MatcherKind(config=LightConfig, network=LightStereo, matcher=LightMatcher),
}
"""Kinds of matchers with weights: a new one is a file with its three parts and one entry here."""


def make_network(config: Any) -> StereoNetwork:  # noqa: ANN401
    """Make the network of a config of any kind, with random weights."""
    return next(k.network(config) for k in MATCHERS.values() if isinstance(config, k.config))


def make_matcher(network: StereoNetwork, config: MatcherConfig) -> Matcher:
    """Make the matcher of a network of any kind.

    Raises:
        InputError: no kind has such a network.
    """
    for kind in MATCHERS.values():
        if isinstance(network, kind.network):
            return kind.matcher(network, config)
    raise InputError(
        f"{type(network).__name__} is no network of a matcher; known are {', '.join(MATCHERS)}"
    )
