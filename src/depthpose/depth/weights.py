"""Weights of depth on disk: a generator, a matcher, or both in one file."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

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
from depthpose.depth.synthesis import Generator, SelectionGenerator, UNetGenerator


@dataclass(frozen=True, kw_only=True)
class GeneratorKind:
    """What it takes to read and write one kind of network."""

    config: type  #: dataclass of the network's sizes and conventions, which its weights file holds
    network: type  #: makes the module of a config, and keeps it as the attribute ``config``


@dataclass(frozen=True, kw_only=True)
class MatcherKind(GeneratorKind):
    """What it takes to read, write and run one kind of matcher."""

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
_SELECTION = "selection"
Use = Literal["images", "pairs"]
"""What networks are for: depth of single images, or of real pairs."""
GENERATORS = {
    "generator": GeneratorKind(config=GeneratorConfig, network=UNetGenerator),
    _SELECTION: GeneratorKind(config=SelectionConfig, network=SelectionGenerator),
}


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
        use: build only the networks that this takes, if the file holds both; None: all.
        answer: where depth of one image is to come from, in place of what the weights say.

    Raises:
        InputError: not such weights, or weights that do not fit their own config.
    """
    checkpoint = checkpoints.read_checkpoint(path)
    kinds = {**GENERATORS, **MATCHERS}
    if checkpoint.kind not in (*kinds, BOTH):
        raise InputError(
            f"{path}: holds weights of kind {checkpoint.kind!r}; depth takes "
            f"{', '.join(map(repr, kinds))} or {BOTH!r}."
        )
    is_both = checkpoint.kind == BOTH
    parts = {} if is_both else {checkpoint.kind: checkpoint}
    for kind in kinds if is_both else ():  # its config names the networks
        if kind not in checkpoint.config:
            continue
        config = checkpoint.config[kind]
        prefix = f"{kind}."
        if not isinstance(config, Mapping):
            raise InputError(f"{path}: its config has no {kind!r}; the file is damaged.")
        tensors = checkpoint.state.items()
        state = {key.removeprefix(prefix): t for key, t in tensors if key.startswith(prefix)}
        parts[kind] = checkpoints.Checkpoint(kind=kind, config=config, state=state)
    if is_both and not (set(parts) & set(GENERATORS) and set(parts) & set(MATCHERS)):
        raise InputError(
            f"{path}: its config names {sorted(checkpoint.config)}, but it should hold a "
            "generator and a matcher; the file is damaged."
        )
    built: dict[str, Any] = {}
    for kind, part in parts.items():  # a generator first
        if use == "pairs" and is_both and kind in GENERATORS:
            continue
        config = _config_of(kind, part.config, str(path))
        make = partial(kinds[kind].network, config)
        built[kind] = checkpoints.build_network(make, part, str(path)).eval()
        if use == "images" and kind in GENERATORS and (answer or config.answer) == "own":
            break  # it takes no matcher
    return DepthWeights(
        generator=next((built[kind] for kind in GENERATORS if kind in built), None),
        matcher=next((built[kind] for kind in MATCHERS if kind in built), None),
        facts=checkpoint.facts,
    )


def _config_of(kind: str, settings: Mapping[str, Any], source: str) -> Any:  # noqa: ANN401
    """Make the config of a network from the metadata of its file."""
    return config_from_dict(settings, {**GENERATORS, **MATCHERS}[kind].config, source=source)


def settings_of(checkpoint: checkpoints.Checkpoint, source: str) -> dict[str, Any]:
    """Give the settings of a file's networks, by kind where there are two.

    Those that the file does not have are at their defaults.

    Raises:
        InputError: a setting is unknown, or has a value that is refused.
    """
    if checkpoint.kind != BOTH:
        return config_to_dict(_config_of(checkpoint.kind, checkpoint.config, source))
    return {
        kind: config_to_dict(_config_of(kind, settings, source))
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
    parts: dict[str, Any] = {}
    for name, kind in (*GENERATORS.items(), *MATCHERS.items()):
        for part in (generator, matcher):
            if isinstance(part, kind.network):
                parts[name] = part
    assert parts, "a weights file holds a network at least"
    states = {
        k: checkpoints.half_state(part) if with_half else part.state_dict()
        for k, part in parts.items()
    }
    configs = {kind: config_to_dict(part.config) for kind, part in parts.items()}
    if len(parts) == 1:
        kind = next(iter(parts))
        config = configs[kind]
        state = states[kind]
    else:
        kind = BOTH
        config = configs
        state = {f"{name}.{key}": t for name, s in states.items() for key, t in s.items()}
    checkpoints.save_checkpoint(
        path, checkpoints.Checkpoint(kind=kind, config=config, state=state, facts=facts)
    )


def make_matcher(network: stereo.StereoNetwork, config: MatcherConfig) -> stereo.Matcher:
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


def refuse_share(images: int, alarm_share: float) -> None:
    """Refuse a share of images that so many of them cannot tell."""
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
    """Write weights that refuse all but ``1 - alarm_share`` of images like some that are known.

    Args:
        weights: with a generator that selects; its tensors stay as they are.
        image_confidence: of images that the weights shall know.
        alarm_share: share of these that may be refused, 0..1.
        out: the file of the weights.

    Returns:
        The ``least_confidence`` that they bear.

    Raises:
        InputError: too few images for that share, or weights of another kind.
    """
    refuse_share(len(image_confidence), alarm_share)
    least = min(round(float(np.quantile(image_confidence, alarm_share)), 4), 0.9999)
    checkpoint = checkpoints.read_checkpoint(weights)
    config = dict(checkpoint.config)
    selection = {BOTH: config.get(_SELECTION), _SELECTION: config}.get(checkpoint.kind)
    if not isinstance(selection, dict):
        raise InputError(
            f"{weights}: holds no generator that selects; take weights of 'train select'"
        )
    changed = {**selection, "least_confidence": least}
    config = {**config, _SELECTION: changed} if checkpoint.kind == BOTH else changed
    checkpoints.save_checkpoint(out, replace(checkpoint, config=config))
    return least
