"""Weights of the depth room on disk: a generator, a matcher, or both in one file."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor, nn

from depthpose.core.checkpoint import Checkpoint, build_network, read_checkpoint, save_checkpoint
from depthpose.core.config import config_from_dict, config_to_dict
from depthpose.core.errors import InputError
from depthpose.depth.config import GeneratorConfig, PSMNetConfig
from depthpose.depth.stereo import PSMNet
from depthpose.depth.stereo.weights import KIND as PSMNET
from depthpose.depth.synthesis import UNetGenerator

GENERATOR, MATCHER, BOTH = "generator", PSMNET, "fakestereo"


@dataclass(frozen=True, kw_only=True, eq=False)
class DepthWeights:
    """Networks of one weights file, in eval mode.

    Attributes:
        generator: left view to right view, or None in a file of the matcher alone.
        matcher: pair to disparity, or None in a file of the generator alone.
        facts: the card in short.
    """

    generator: UNetGenerator | None
    matcher: PSMNet | None
    facts: Mapping[str, str]


def read_depth_weights(path: Path) -> DepthWeights:
    """Read a weights file of any kind of this room.

    Raises:
        InputError: not such weights, or weights that do not fit their own config.
    """
    checkpoint = read_checkpoint(path)
    if checkpoint.kind not in (GENERATOR, MATCHER, BOTH):
        raise InputError(
            f"{path}: holds weights of kind {checkpoint.kind!r}; depth takes {GENERATOR!r}, "
            f"{MATCHER!r} or {BOTH!r}."
        )
    parts = _split(checkpoint, str(path)) if checkpoint.kind == BOTH else {checkpoint.kind: checkpoint}
    generator = matcher = None
    if GENERATOR in parts:
        config = config_from_dict(parts[GENERATOR].config, GeneratorConfig, source=str(path))
        generator = build_network(lambda: UNetGenerator(config), parts[GENERATOR], str(path)).eval()
    if MATCHER in parts:
        knobs = config_from_dict(parts[MATCHER].config, PSMNetConfig, source=str(path))
        matcher = build_network(lambda: PSMNet(knobs), parts[MATCHER], str(path)).eval()
    return DepthWeights(generator=generator, matcher=matcher, facts=checkpoint.facts)


def read_generator(path: Path) -> UNetGenerator:
    """Read the generator of a weights file.

    Raises:
        InputError: the file holds none.
    """
    generator = read_depth_weights(path).generator
    if generator is None:
        raise InputError(f"{path}: holds no generator, only a matcher; give a generator's weights.")
    return generator


def read_matcher(path: Path) -> PSMNet:
    """Read the matcher of a weights file.

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
    generator: UNetGenerator | None = None,
    matcher: PSMNet | None = None,
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
    parts: dict[str, nn.Module] = {}
    parts |= {} if generator is None else {GENERATOR: generator}
    parts |= {} if matcher is None else {MATCHER: matcher}
    assert parts, "a weights file holds a network at least"
    states = {name: _state(module, with_half=with_half) for name, module in parts.items()}
    configs = {name: config_to_dict(module.config) for name, module in parts.items()}
    if len(parts) == 1:
        kind = next(iter(parts))
        config, state = configs[kind], states[kind]
    else:
        kind, config = BOTH, configs
        state = {f"{name}.{key}": t for name, s in states.items() for key, t in s.items()}
    save_checkpoint(path, Checkpoint(kind=kind, config=config, state=state, facts=facts))


def _split(checkpoint: Checkpoint, source: str) -> dict[str, Checkpoint]:
    parts: dict[str, Checkpoint] = {}
    for kind in (GENERATOR, MATCHER):
        state = {
            key.removeprefix(f"{kind}."): tensor
            for key, tensor in checkpoint.state.items()
            if key.startswith(f"{kind}.")
        }
        config = checkpoint.config.get(kind)
        if not isinstance(config, Mapping):
            raise InputError(f"{source}: its config has no {kind!r}; the file is damaged.")
        parts[kind] = Checkpoint(kind=kind, config=config, state=state)
    return parts


def _state(module: nn.Module, *, with_half: bool) -> dict[str, Tensor]:
    state = module.state_dict()
    if not with_half:
        return state
    return {k: t.to(torch.float16) if t.is_floating_point() else t for k, t in state.items()}
