"""Weights with the config that made them: safetensors, loaded strictly; others' files, safely."""

import hashlib
import json
import pickle
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import torch
from safetensors import safe_open
from safetensors.torch import save
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from depthpose.core.errors import InputError, Notice
from depthpose.core.files.disk import refuse_number, refused_as, write_bytes
from depthpose.core.hub import SHIPPED as SHIPPED
from depthpose.core.hub import find_weights as find_weights

NetworkT = TypeVar("NetworkT", bound=nn.Module)
_DRAWS = (nn.init.normal_, nn.init.uniform_, nn.init.kaiming_normal_, nn.init.kaiming_uniform_)
"""Functions that draw random weights, and may be skipped as a whole."""
_SAFETENSORS = (
    "safetensors file", "a published checkpoint is imported by 'depthpose weights import'"
)  # fmt: skip
"""What a file should be, and what to do where it is not."""


class LicenceNotice(Notice):
    """Weights whose terms restrict their use."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Checkpoint:
    """What a weights file holds."""

    kind: str  #: which network the weights belong to, e.g. ``psmnet``
    config: Mapping[str, Any]  #: of that network, as ``config_to_dict`` gives it
    state: Mapping[str, Tensor]  #: tensors by the names of the network's ``state_dict``
    facts: Mapping[str, str] = field(default_factory=dict)  #: the card, such as ``licence``


def save_checkpoint(path: Path, checkpoint: Checkpoint) -> None:
    """Write weights and config to one ``.safetensors`` file, all or nothing."""
    if path.suffix != ".safetensors":
        raise InputError(
            f"{path}: weights are written as safetensors; end the name in .safetensors."
        )
    metadata = {"kind": checkpoint.kind, "config": json.dumps(dict(checkpoint.config))}
    state = {name: tensor.detach().cpu().contiguous() for name, tensor in checkpoint.state.items()}
    content = save(state, metadata={**checkpoint.facts, **metadata})
    # Its header has the metadata in random order, so equal weights would get different checksums.
    size = int.from_bytes(content[:8], "little")
    header = json.dumps(
        json.loads(content[8 : 8 + size]), sort_keys=True, separators=(",", ":"), ensure_ascii=False
    ).encode()
    assert len(header) <= size, "the same entries, no longer than before"
    # safetensors' own writer does not name a full disk.
    rest = memoryview(content)[8 + size :]
    write_bytes(path, b"".join([content[:8], header.ljust(size), rest]))


def read_checkpoint(path: Path, kind: str | None = None) -> Checkpoint:
    """Read a file that :func:`save_checkpoint` wrote.

    Args:
        path: a ``.safetensors`` file.
        kind: the kind that the caller can use; None takes any.

    Raises:
        InputError: missing, truncated, not safetensors, without our metadata, of another kind, or
            with numbers that are not finite.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: there is no such weights file.")
    with refused_as(path, *_SAFETENSORS), safe_open(path, framework="pt") as file:
        metadata = dict(file.metadata() or {})
        state = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    if "kind" not in metadata or "config" not in metadata:
        raise InputError(
            f"{path}: no 'kind' and 'config' in its metadata, so no depthpose weights. A "
            "published checkpoint is imported by 'depthpose weights import'."
        )
    held = metadata.pop("kind")
    if kind is not None and held != kind:
        raise InputError(f"{path}: holds weights of kind {held!r}, but {kind!r} is needed here.")
    try:
        config = json.loads(metadata.pop("config"), parse_constant=refuse_number)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: its 'config' is not JSON ({error}).") from error
    if not isinstance(config, dict):
        raise InputError(f"{path}: its 'config' is not a mapping.")
    return Checkpoint(kind=held, config=config, state=_finite(path, state), facts=metadata)


def load_weights(network: nn.Module, checkpoint: Checkpoint, source: str) -> None:
    """Copy the weights into ``network``; every name and shape must agree.

    Raises:
        InputError: the first names that are missing, unexpected or of another shape.
    """
    _refuse_misfits(network, checkpoint, source)
    network.load_state_dict(dict(checkpoint.state))


def build_network(make: Callable[[], NetworkT], checkpoint: Checkpoint, source: str) -> NetworkT:
    """Make a network and copy the weights into it, as :func:`load_weights` does.

    Its shapes are compared before it takes memory: a config may say any size.

    Args:
        make: makes the network of the checkpoint's config.
        checkpoint: its weights.
        source: what to call them in errors.

    Raises:
        InputError: as there, or a config of which no network can be made.
    """
    with (
        refused_as(source, "config of a network", "file and config are of different versions"),
        _WithoutDrawing(),
    ):
        with torch.device("meta"):
            _refuse_misfits(make(), checkpoint, source)
        network = make()
    network.load_state_dict(dict(checkpoint.state))
    return network


class _WithoutDrawing(TorchFunctionMode):
    """Draws no random weights: on the meta device torch would import its compiler for that, 1 s."""

    def __torch_function__(
        self,
        func: Callable[..., Any],
        types: Sequence[type],
        args: Sequence[Any] = (),
        kwargs: Mapping[str, Any] | None = None,
    ) -> Any:  # noqa: ANN401
        options = kwargs or {}
        if func in _DRAWS:
            return args[0] if args else options["tensor"]
        return func(*args, **options)


def _refuse_misfits(network: nn.Module, checkpoint: Checkpoint, source: str) -> None:
    problems = misfits(network.state_dict(), checkpoint.state)
    if problems:
        raise InputError(
            f"{source}: {len(problems)} tensors do not fit the network of its config: "
            f"{'; '.join(problems[:3])}. File and config belong to different versions."
        )


def misfits(wanted: Mapping[str, Tensor], tensors: Mapping[str, Tensor]) -> list[str]:
    """Say in order of the names which tensors are missing, unexpected or of another shape."""
    problems = [f"{name} is missing" for name in wanted.keys() - tensors.keys()]
    problems += [f"{name} is unexpected" for name in tensors.keys() - wanted.keys()]
    problems += [
        f"{name} is {tuple(tensors[name].shape)}, not {tuple(tensor.shape)}"
        for name, tensor in wanted.items()
        if name in tensors and tensors[name].shape != tensor.shape
    ]
    return sorted(problems)


def read_torch_file(path: Path) -> Mapping[str, Any]:
    """Read a foreign PyTorch checkpoint without running any code in it.

    ``torch.load(weights_only=True)`` refuses every pickled object but tensors and containers.

    Raises:
        InputError: missing, not a PyTorch file, or holding pickled code.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: there is no such checkpoint file.")
    try:
        # An open file, not a path: by a path's ending torch would choose another format.
        with path.open("rb") as file:
            content = torch.load(file, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        raise InputError(
            f"{path}: refused, as no checkpoint of tensors alone: it is broken, or holds "
            "pickled objects that could run code on loading. Ask its author for one of tensors."
        ) from error
    except Exception as error:  # an unpickler raises whatever broken bytes lead it to
        raise InputError(f"{path}: not a readable PyTorch checkpoint ({error}).") from error
    if not isinstance(content, Mapping):
        raise InputError(
            f"{path}: holds a {type(content).__name__}, but a checkpoint maps names to tensors."
        )
    return content


def read_published(path: Path, network: str) -> Mapping[str, Tensor]:
    """Read the tensors of a foreign checkpoint: safetensors by its suffix, or else a PyTorch file.

    Args:
        path: of the checkpoint.
        network: what it should hold, for errors.

    Raises:
        InputError: missing, damaged, holding pickled code, no tensors by name, or numbers that are
            not finite.
    """
    path = Path(path)
    if path.suffix == ".safetensors":
        with refused_as(path, *_SAFETENSORS), safe_open(path, framework="pt") as file:
            return _finite(path, {name: file.get_tensor(name) for name in file.keys()})  # noqa: SIM118
    content = read_torch_file(path)
    state = content.get("state_dict", content)
    if not isinstance(state, Mapping) or not all(isinstance(v, Tensor) for v in state.values()):
        raise InputError(
            f"{path}: holds no tensors by name, so it is no {network}. Its entries are "
            f"{', '.join(map(repr, list(content)[:5]))}."
        )
    return _finite(path, state)


def save_imported(
    out: Path, kind: str, network: nn.Module, source: Path, facts: Mapping[str, str]
) -> None:
    """Write the weights of an imported network, with the checksum of the file that they are from.

    Args:
        out: the ``.safetensors`` file to write.
        kind: of the checkpoint.
        network: with the weights.
        source: the published file.
        facts: what the card says of them: ``trained_on``, ``licence``.
    """
    origin = {"origin": f"imported from a file with sha256 {file_sha256(source)}"}
    state = network.state_dict()
    save_checkpoint(out, Checkpoint(kind=kind, config={}, state=state, facts={**origin, **facts}))


def half_state(network: nn.Module) -> dict[str, Tensor]:
    """Give the state of a network with its floating-point numbers in 16 bits."""
    state = network.state_dict()
    return {k: t.to(torch.float16) if t.is_floating_point() else t for k, t in state.items()}


def warn_of_terms(facts: Mapping[str, str]) -> None:
    """Warn of the terms of use of weights that have any."""
    if terms := facts.get("terms", ""):
        warnings.warn(terms, LicenceNotice, stacklevel=3)


def join_terms(*cards: Mapping[str, str]) -> str:
    """Give the terms of all cards together: those of the parts bind the whole; none comes twice."""
    joined = ""
    for terms in filter(None, (card.get("terms", "") for card in cards)):
        if f" {joined} " in f" {terms} ":  # whole words: "commercial" is not "non-commercial"
            joined = terms
        elif f" {terms} " not in f" {joined} ":
            joined = f"{joined} {terms}".strip()
    return joined


def bound_facts(facts: Mapping[str, str], made_of: Iterable[str | Path]) -> dict[str, str]:
    """Add to a card the terms of the weights that something is made of.

    Args:
        facts: the card, with terms of its own if it has any.
        made_of: what names weights, as for :func:`find_weights`.

    Raises:
        InputError: there are no such weights.
    """
    cards = [read_checkpoint(find_weights(name)).facts for name in made_of]
    terms = join_terms(facts, *cards)
    return {**facts, "terms": terms} if terms else dict(facts)


def file_sha256(path: Path) -> str:
    """Compute a file's sha256, recorded beside every number that was made with it."""
    with Path(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _finite(path: Path, state: Mapping[str, Tensor]) -> Mapping[str, Tensor]:
    """Refuse numbers of which a network would make depth or poses of nothing."""
    for name, tensor in state.items():
        # A sum takes no memory; a large one may overflow though every number is finite.
        is_finite = not tensor.is_floating_point() or tensor.sum(dtype=torch.float32).isfinite()
        if not is_finite and (bad := tensor.numel() - int(tensor.isfinite().sum())):
            raise InputError(
                f"{path}: {bad} of the {tensor.numel()} numbers of {name!r} are NaN or infinite, "
                "so its training diverged or the file is damaged; take other weights"
            )
        if name.endswith("running_var") and (tensor < 0).any():
            raise InputError(
                f"{path}: {name!r} holds a variance below 0, so the file is damaged; take other "
                "weights"
            )
    return state
