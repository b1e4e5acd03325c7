"""Weights files of depth: a generator, a matcher, or both in one file."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from torch import Tensor

from depthpose.core import checkpoint as checkpoints
from depthpose.core.config import config_from_dict, config_to_dict
from depthpose.core.errors import InputError
from depthpose.depth import stereo
from depthpose.depth.config import (
    Answer,
    GeneratorConfig,
    LightConfig,
    MatcherConfig,
    PSMNetConfig,
    SelectionConfig,
)
from depthpose.depth.generators import Generator, SelectionGenerator, UNetGenerator


@dataclass(frozen=True, kw_only=True)
class GeneratorKind:
    """Classes of one kind of network, by which its weights are read and written."""

    config: type  #: dataclass of the network's sizes and conventions, which its weights file holds
    network: type  #: module that is built from a config, and has it as the attribute ``config``


@dataclass(frozen=True, kw_only=True)
class MatcherKind(GeneratorKind):
    """Classes of one kind of matcher, by which its weights are read, written and run."""

    network: type[stereo.StereoNetwork]
    #: makes a matcher of a module in eval mode
    matcher: Callable[[Any, MatcherConfig], stereo.Matcher]


MATCHERS = {
    "psmnet": MatcherKind(config=PSMNetConfig, network=stereo.PSMNet, matcher=stereo.PSMNetMatcher),
    "light": MatcherKind(
        config=LightConfig, network=stereo.LightStereo, matcher=stereo.LightMatcher
    ),
}
"""Kinds of matchers with weights: a new one is a file with its three parts and one entry here."""

BOTH = "fakestereo"
"""Kind of a file with a generator and a matcher."""
_SELECTION = "selection"
Use = Literal["images", "pairs"]
"""What networks are used for: depth of single images, or of real pairs."""
GENERATORS = {
    "generator": GeneratorKind(config=GeneratorConfig, network=UNetGenerator),
    _SELECTION: GeneratorKind(config=SelectionConfig, network=SelectionGenerator),
}
"""Kinds of generators with weights."""


def _list_kinds() -> dict[str, GeneratorKind]:
    """Return all kinds of networks by name, generators first.

    They are joined at each call, for users may add to ``MATCHERS``.
    """
    return {**GENERATORS, **MATCHERS}


@dataclass(frozen=True, kw_only=True, eq=False)
class DepthWeights:
    """Networks of one weights file, in eval mode."""

    generator: Generator | None  #: left view to right view, or None in a file of the matcher alone
    #: pair to disparity, of any kind of ``MATCHERS``, or None in a file of the generator alone
    matcher: stereo.StereoNetwork | None
    facts: Mapping[str, str]  #: the card in short


def read_depth_weights(
    path: Path, *, use: Use | None = None, answer: Answer | None = None
) -> DepthWeights:
    """Read a weights file of any kind of generator or matcher.

    Args:
        path: the file.
        use: build only the networks that this use takes, if the file holds both; None: all.
        answer: where depth of one image is to come from, in place of what the weights say.

    Raises:
        InputError: not such weights, weights that do not fit their own config, or an ``answer``
            that they cannot give.
    """
    checkpoint = checkpoints.read_checkpoint(path)
    is_both = checkpoint.kind == BOTH
    parts = _split(checkpoint, path) if is_both else {checkpoint.kind: checkpoint}
    configs = {
        kind: _read_network_config(kind, part.config, str(path)) for kind, part in parts.items()
    }
    if answer is not None:
        generator_kind = next((kind for kind in configs if kind in GENERATORS), None)
        if generator_kind is None:
            raise InputError(_no_answer(answer))
        configs[generator_kind] = _with_answer(configs[generator_kind], answer)

    networks: dict[str, Any] = {}
    for kind in _choose_kinds(configs, use):
        make = partial(_list_kinds()[kind].network, configs[kind])
        networks[kind] = checkpoints.build_network(make, parts[kind], str(path)).eval()
    return DepthWeights(
        generator=next((networks[kind] for kind in GENERATORS if kind in networks), None),
        matcher=next((networks[kind] for kind in MATCHERS if kind in networks), None),
        facts=checkpoint.facts,
    )


def _choose_kinds(configs: Mapping[str, Any], use: Use | None) -> list[str]:
    """Choose the networks that a use takes; a file of one network is built for any use.

    ``configs``: those of the file's networks, by kind.
    """
    kinds = list(configs)
    if len(kinds) == 1 or use is None:
        return kinds
    if use == "pairs":
        return [kind for kind in kinds if kind in MATCHERS]

    # Images need no matcher where the generator estimates disparity itself.
    generator_kinds = [kind for kind in kinds if kind in GENERATORS]
    has_own_answer = any(configs[kind].answer == "own" for kind in generator_kinds)
    return generator_kinds if has_own_answer else kinds


def _with_answer(
    config: GeneratorConfig | SelectionConfig, answer: Answer
) -> GeneratorConfig | SelectionConfig:
    """Set where depth of one image comes from: a generator that selects has both answers.

    A U-Net has only the second; to ask for it changes nothing.
    """
    if isinstance(config, SelectionConfig):
        return replace(config, answer=answer)
    if answer != config.answer:
        raise InputError(_no_answer(answer))
    return config


def _no_answer(answer: Answer) -> str:
    """Say that weights cannot give an answer."""
    return (
        f"answer is {answer!r}, which takes the weights of a generator that selects; omit it: "
        "these have no generator, or a U-Net, which estimates no disparity."
    )


def _split(checkpoint: checkpoints.Checkpoint, path: Path) -> dict[str, checkpoints.Checkpoint]:
    """Split the checkpoint of two networks into one for each, by kind, the generator first."""
    parts: dict[str, checkpoints.Checkpoint] = {}
    for kind in _list_kinds():
        if kind not in checkpoint.config:
            continue
        config = checkpoint.config[kind]
        if not isinstance(config, Mapping):
            raise InputError(f"{path}: its config has no {kind!r}; the file is damaged.")
        prefix = f"{kind}."
        state = {
            name.removeprefix(prefix): tensor
            for name, tensor in checkpoint.state.items()
            if name.startswith(prefix)
        }
        parts[kind] = checkpoints.Checkpoint(kind=kind, config=config, state=state)
    if not (set(parts) & set(GENERATORS) and set(parts) & set(MATCHERS)):
        raise InputError(
            f"{path}: its config names {sorted(checkpoint.config)}, but it should hold a "
            "generator and a matcher; the file is damaged."
        )
    return parts


def _read_network_config(kind: str, settings: Mapping[str, Any], source: str) -> Any:  # noqa: ANN401
    """Make the config of a network from the metadata of its file; ``source`` is for errors.

    Raises:
        InputError: the kind is unknown, or a setting.
    """
    if kind not in _list_kinds():
        raise InputError(
            f"{source}: holds weights of kind {kind!r}; depth takes "
            f"{', '.join(map(repr, _list_kinds()))} or {BOTH!r}."
        )
    return config_from_dict(settings, _list_kinds()[kind].config, source=source)


def settings_of(checkpoint: checkpoints.Checkpoint, source: str) -> dict[str, Any]:
    """Return the settings of a file's networks, by kind where there are two.

    Settings that the file does not hold are at their defaults. ``source``: the file, for errors.

    Raises:
        InputError: the kind is unknown, or a setting, or its value is not allowed.
    """
    if checkpoint.kind != BOTH:
        return config_to_dict(_read_network_config(checkpoint.kind, checkpoint.config, source))
    return {
        kind: config_to_dict(_read_network_config(kind, settings, source))
        for kind, settings in checkpoint.config.items()
    }


def read_generator(path: Path) -> Generator:
    """Read the generator of a weights file.

    Raises:
        InputError: the file holds none.
    """
    generator = read_depth_weights(path).generator
    if generator is None:
        raise InputError(f"{path}: holds no generator, only a matcher; give a generator's weights.")
    return generator


def read_matcher(path: Path) -> stereo.StereoNetwork:
    """Read the matcher of a weights file, of any kind.

    Raises:
        InputError: the file holds none.
    """
    matcher = read_depth_weights(path).matcher
    if matcher is None:
        raise InputError(f"{path}: holds no matcher, only a generator; give a matcher's weights.")
    return matcher


def write_depth_weights(
    path: Path,
    *,
    generator: Generator | None = None,
    matcher: stereo.StereoNetwork | None = None,
    facts: Mapping[str, str],
    with_half: bool = False,
) -> None:
    """Write one network, or both, to one file.

    Args:
        path: the ``.safetensors`` file.
        generator: left view to right view.
        matcher: pair to disparity.
        facts: ``trained_on``, ``licence`` and the like.
        with_half: store 16-bit floats: half the size.
    """
    # The kind of each network follows from its class.
    networks: dict[str, Any] = {}
    for kind, classes in _list_kinds().items():
        for network in (generator, matcher):
            if isinstance(network, classes.network):
                networks[kind] = network
    assert networks, "a weights file holds at least one network"

    configs: dict[str, Any] = {}
    states: dict[str, dict[str, Tensor]] = {}
    for kind, network in networks.items():
        configs[kind] = config_to_dict(network.config)
        states[kind] = checkpoints.halve_state(network) if with_half else network.state_dict()

    if len(networks) == 1:
        kind = next(iter(networks))
        config = configs[kind]
        state = states[kind]
    else:
        kind = BOTH
        config = configs
        state = {
            f"{part}.{name}": tensor
            for part, part_state in states.items()
            for name, tensor in part_state.items()
        }
    checkpoints.save_checkpoint(
        path, checkpoints.Checkpoint(kind=kind, config=config, state=state, facts=facts)
    )


def make_matcher(network: stereo.StereoNetwork, config: MatcherConfig) -> stereo.Matcher:
    """Make the matcher that runs a network of any kind of ``MATCHERS``.

    Raises:
        InputError: the network is of no such kind.
    """
    for kind in MATCHERS.values():
        if isinstance(network, kind.network):
            return kind.matcher(network, config)
    raise InputError(
        f"{type(network).__name__} is no network of a matcher; known are {', '.join(MATCHERS)}"
    )


def refuse_alarm_share(images: int, alarm_share: float) -> None:
    """Refuse a share of false alarms that is not between 0 and 1, or is less than one image.

    Raises:
        InputError: it is; the message has the number of images that it takes.
    """
    if not 0 < alarm_share < 1:
        raise InputError(f"alarm_share is {alarm_share:g}; it must be above 0 and below 1")
    if images * alarm_share < 1:
        raise InputError(
            f"{images} images cannot say what refuses {alarm_share:g} of them; "
            f"give {math.ceil(1 / alarm_share)} images or more, or a larger share"
        )


def calibrate_weights(
    weights: Path, image_confidence: list[float], alarm_share: float, out: Path
) -> float:
    """Write weights whose ``least_confidence`` refuses a share of images that they should accept.

    Args:
        weights: weights with a generator that selects; its tensors stay as they are.
        image_confidence: confidences of images that the weights should accept
            (``DepthEstimate.image_confidence``).
        alarm_share: share of these that may be refused all the same, 0..1.
        out: the weights file that is written.

    Returns:
        The ``least_confidence`` of the written weights.

    Raises:
        InputError: too few images for that share, or weights of another kind.
    """
    refuse_alarm_share(len(image_confidence), alarm_share)
    quantile = float(np.quantile(image_confidence, alarm_share))
    least_confidence = min(round(quantile, 4), 0.9999)  # the config takes values below 1
    checkpoint = checkpoints.read_checkpoint(weights)
    is_both = checkpoint.kind == BOTH
    config = dict(checkpoint.config)
    selection = config.get(_SELECTION) if is_both else config
    if checkpoint.kind not in (BOTH, _SELECTION) or not isinstance(selection, dict):
        raise InputError(
            f"{weights}: holds no generator that selects; take weights of 'train select'"
        )
    changed = {**selection, "least_confidence": least_confidence}
    config = {**config, _SELECTION: changed} if is_both else changed
    checkpoints.save_checkpoint(out, replace(checkpoint, config=config))
    return least_confidence
