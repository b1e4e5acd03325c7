"""Weights files: safetensors with the network's config inside, and published PyTorch checkpoints.

Weights are named by a file, a folder, a name in the package, or one on the hub (``core.hub``). Each
file has a card: facts such as ``licence``, ``trained_on``, and ``terms`` if they restrict its use.
"""

import hashlib
import json
import pickle
import warnings
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import torch
from safetensors import safe_open
from safetensors.torch import save
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from depthpose.core.config import config_to_dict
from depthpose.core.errors import InputError, Notice, suggest_name
from depthpose.core.files.disk import parse_finite, refused_as, write_bytes
from depthpose.core.hub import ON_HUB, WEIGHTS_FILE, fetch_weights

NetworkT = TypeVar("NetworkT", bound=nn.Module)
_RANDOM_INITS = (
    nn.init.normal_, nn.init.uniform_, nn.init.kaiming_normal_, nn.init.kaiming_uniform_
)  # fmt: skip
"""Functions that fill a tensor with random weights, and do nothing else."""
SHIPPED = Path(__file__).parents[1] / "weights"
"""Folder of the weights that come with the package."""

_NOT_IN_WHEEL = ("kitti-nc", "linemod-nc", "bunny-nc", "ycb")
"""Names of weights that are in the repository, and not in the wheel."""


class LicenceNotice(Notice):
    """Terms that restrict the use of weights."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Checkpoint:
    """The contents of a weights file."""

    kind: str  #: kind of network, such as ``psmnet``
    config: Mapping[str, Any]  #: its config (:func:`depthpose.core.config.config_to_dict`)
    state: Mapping[str, Tensor]  #: its ``state_dict``: tensors by name
    facts: Mapping[str, str] = field(default_factory=dict)  #: the card, such as ``licence``


def save_checkpoint(path: Path, checkpoint: Checkpoint) -> None:
    """Write a checkpoint to one ``.safetensors`` file, whole or not at all.

    Raises:
        InputError: the suffix is another, or the disk refuses.
    """
    if path.suffix != ".safetensors":
        raise InputError(
            f"{path}: weights are written as safetensors; end the name in .safetensors."
        )
    metadata = {"kind": checkpoint.kind, "config": json.dumps(dict(checkpoint.config))}
    state = {name: tensor.detach().cpu().contiguous() for name, tensor in checkpoint.state.items()}
    content = save(state, metadata={**checkpoint.facts, **metadata})
    # Not by safetensors' own writer, whose error does not name a full disk.
    write_bytes(path, _sort_header(content))


def _sort_header(content: bytes) -> bytes:
    """Sort the JSON header of a safetensors file, so that equal weights have equal checksums.

    The library writes metadata in random order. A file is the size of its header (8 bytes), the
    header, and the tensors.
    """
    size = int.from_bytes(content[:8], "little")
    entries = json.loads(content[8 : 8 + size])
    header = json.dumps(entries, sort_keys=True, separators=(",", ":"), ensure_ascii=False).encode()
    assert len(header) <= size, "the same entries, no longer than before"
    tensors = memoryview(content)[8 + size :]
    return b"".join([content[:8], header.ljust(size), tensors])


def find_weights(name: str | Path) -> Path:
    """Find a weights file by its path, its folder, its name in the package, or its name on the hub.

    Args:
        name: a file; the name of weights that come with the package; a folder with one file of
            weights, or with ``model.safetensors``; or ``hf://OWNER/NAME``, which is downloaded.

    Raises:
        InputError: it is none of these (the message suggests the nearest name), or the hub does not
            answer.
    """
    path = Path(name)
    shipped = {file.stem: file for file in SHIPPED.glob("*.safetensors")}
    if path.is_file():
        return path
    if str(name) in shipped:
        return shipped[str(name)]
    if path.is_dir():
        return _find_weights_in_folder(path)
    if str(name).startswith(ON_HUB):
        return fetch_weights(str(name))
    if str(name) in _NOT_IN_WHEEL:
        raise InputError(
            f"weights {str(name)!r}: not in the wheel, for their terms or their size. Take "
            f"src/depthpose/weights/{name}.safetensors from the repository and give its path."
        )
    raise InputError(
        f"weights {str(name)!r}: neither a file nor the name of weights that came with depthpose; "
        f"{suggest_name(str(name), shipped)} 'depthpose weights import' imports published ones, "
        "hf://OWNER/NAME those on the hub."
    )


def _find_weights_in_folder(folder: Path) -> Path:
    """Find the only ``.safetensors`` file of a folder, or the one with the usual name.

    Raises:
        InputError: there is none, or several of other names.
    """
    files = sorted(folder.glob("*.safetensors"))
    usual = [file for file in files if file.name == WEIGHTS_FILE]
    candidates = usual or files
    if len(candidates) == 1:
        return candidates[0]
    file_names = ", ".join(file.name for file in files) or "none"
    raise InputError(
        f"{folder}: a folder of weights holds one .safetensors file, or one called "
        f"{WEIGHTS_FILE}; here: {file_names}. Name the file."
    )


def read_checkpoint(path: Path, kind: str | None = None) -> Checkpoint:
    """Read a file that :func:`save_checkpoint` wrote.

    Args:
        path: a ``.safetensors`` file.
        kind: the kind that the caller can use; None takes any.

    Raises:
        InputError: the file is missing, damaged, no safetensors, without the metadata of
            depthpose's weights, of another kind, or holds numbers that are not finite.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: there is no such weights file.")
    state, metadata = _read_safetensors(path)
    if "kind" not in metadata or "config" not in metadata:
        raise InputError(
            f"{path}: no 'kind' and 'config' in its metadata, so no depthpose weights. A "
            "published checkpoint is imported by 'depthpose weights import'."
        )
    stored_kind = metadata.pop("kind")
    if kind is not None and stored_kind != kind:
        raise InputError(
            f"{path}: holds weights of kind {stored_kind!r}, but {kind!r} is needed here."
        )
    try:
        config = json.loads(metadata.pop("config"), parse_constant=parse_finite)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: its 'config' is not JSON ({error}).") from error
    if not isinstance(config, dict):
        raise InputError(f"{path}: its 'config' is not a mapping.")
    _refuse_impossible_numbers(path, state)
    return Checkpoint(kind=stored_kind, config=config, state=state, facts=metadata)


def _read_safetensors(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Read the tensors of a safetensors file by name, and its metadata."""
    remedy = "a published checkpoint is imported by 'depthpose weights import'"
    with (
        refused_as(path, "safetensors file", remedy),
        safe_open(path, framework="pt") as file,
    ):
        state = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        return state, dict(file.metadata() or {})


def file_sha256(path: Path) -> str:
    """Compute the SHA-256 of a file, in hexadecimal."""
    with Path(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def load_weights(network: nn.Module, checkpoint: Checkpoint, source: str) -> None:
    """Copy the weights of a checkpoint into a network; every name and shape must agree.

    Args:
        network: the network; changed in place.
        checkpoint: the weights.
        source: what errors call the weights, such as their file.

    Raises:
        InputError: tensors are missing, unexpected or of another shape; the first ones are named.
    """
    problems = list_misfits(network.state_dict(), checkpoint.state)
    if problems:
        raise InputError(
            f"{source}: {len(problems)} tensors do not fit the network of its config: "
            f"{'; '.join(problems[:3])}. File and config belong to different versions."
        )
    network.load_state_dict(dict(checkpoint.state))


def refuse_other_network(
    network: nn.Module, loaded: nn.Module, source: str, independent: Collection[str] = ()
) -> None:
    """Refuse to begin a training with the weights of another network.

    Args:
        network: the network that is to be trained; its ``config`` is a dataclass.
        loaded: the network that the weights were loaded into; its ``config`` is one too.
        source: what errors call the weights, such as their file.
        independent: settings that may differ, since the weights do not depend on them.

    Raises:
        InputError: the networks differ in their class, or in another setting.
    """
    if type(loaded) is not type(network):
        raise InputError(
            f"{source}: holds weights of {type(loaded).__name__}, but the config trains "
            f"{type(network).__name__}. Give weights of that network."
        )
    config = config_to_dict(network.config)
    loaded_config = config_to_dict(loaded.config)
    for name, value in config.items():
        if name not in independent and loaded_config[name] != value:
            raise InputError(
                f"{source}: was trained with {name} = {loaded_config[name]!r}, but the config says "
                f"{value!r}. Give the config the weights' own."
            )


def build_network(make: Callable[[], NetworkT], checkpoint: Checkpoint, source: str) -> NetworkT:
    """Make a network and copy the weights of a checkpoint into it.

    Shapes are compared before the network takes memory: a damaged config may name any size.

    Args:
        make: makes the network of the checkpoint's config.
        checkpoint: its weights.
        source: what errors call the weights, such as their file.

    Raises:
        InputError: no network can be made of the config, or tensors do not fit it
            (:func:`load_weights`).
    """
    with (
        refused_as(source, "config of a network", "file and config are of different versions"),
        _SkipRandomInit(),
    ):
        with torch.device("meta"):
            load_weights(make(), checkpoint, source)  # compares shapes, and copies nothing
        network = make()
    network.load_state_dict(dict(checkpoint.state))
    return network


class _SkipRandomInit(TorchFunctionMode):
    """Skips the initialisation of weights, which are replaced anyway.

    On the meta device torch would import its compiler for it, which takes 1 s.
    """

    def __torch_function__(
        self,
        func: Callable[..., Any],
        types: Sequence[type],
        args: Sequence[Any] = (),
        kwargs: Mapping[str, Any] | None = None,
    ) -> Any:  # noqa: ANN401
        options = kwargs or {}
        if func in _RANDOM_INITS:
            return args[0] if args else options["tensor"]  # the tensor, as it is
        return func(*args, **options)


def list_misfits(wanted: Mapping[str, Tensor], tensors: Mapping[str, Tensor]) -> list[str]:
    """List where the names and shapes of tensors differ from wanted ones.

    Returns:
        A phrase for each tensor that is missing, unexpected or of another shape, such as
        ``conv.bias is missing``, sorted; empty where all agree.
    """
    problems = [f"{name} is missing" for name in wanted.keys() - tensors.keys()]
    problems += [f"{name} is unexpected" for name in tensors.keys() - wanted.keys()]
    problems += [
        f"{name} is {tuple(tensors[name].shape)}, not {tuple(tensor.shape)}"
        for name, tensor in wanted.items()
        if name in tensors and tensors[name].shape != tensor.shape
    ]
    return sorted(problems)


def read_torch_file(path: Path) -> Mapping[str, Any]:
    """Read a PyTorch checkpoint of other people without running any code in it.

    ``torch.load(weights_only=True)`` refuses every pickled object but tensors and containers.

    Returns:
        The mapping that the file holds, of names to tensors or whatever else.

    Raises:
        InputError: the file is missing, no PyTorch file, no mapping, or holds pickled code.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: there is no such checkpoint file.")
    try:
        # An open file, because torch would choose another format by the suffix of a path.
        with path.open("rb") as file:
            content = torch.load(file, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        raise InputError(
            f"{path}: refused, as no checkpoint of tensors alone: it is broken, or holds "
            "pickled objects that could run code on loading. Ask its author for one of tensors."
        ) from error
    except Exception as error:  # on damaged bytes an unpickler may raise anything
        raise InputError(f"{path}: not a readable PyTorch checkpoint ({error}).") from error
    if not isinstance(content, Mapping):
        raise InputError(
            f"{path}: holds a {type(content).__name__}, but a checkpoint maps names to tensors."
        )
    return content


def read_published(path: Path, network: str) -> Mapping[str, Tensor]:
    """Read the tensors of a published checkpoint, by name.

    Args:
        path: a ``.safetensors`` file, else a PyTorch file.
        network: what errors call the network.

    Raises:
        InputError: the file is missing or damaged, or holds pickled code, other things than tensors
            by name, or numbers that are not finite.
    """
    path = Path(path)
    if path.suffix == ".safetensors":
        state, _ = _read_safetensors(path)
    else:
        content = read_torch_file(path)
        state = content.get("state_dict", content)
        if not isinstance(state, Mapping) or not all(isinstance(v, Tensor) for v in state.values()):
            raise InputError(
                f"{path}: holds no tensors by name, so it is no {network}. Its entries are "
                f"{', '.join(map(repr, list(content)[:5]))}."
            )
    _refuse_impossible_numbers(path, state)
    return state


def save_imported(
    out: Path, kind: str, network: nn.Module, source: Path, facts: Mapping[str, str]
) -> None:
    """Write the weights of a network that was imported from a published checkpoint.

    Args:
        out: the ``.safetensors`` file.
        kind: kind of the network.
        network: the network with the weights.
        source: the published file, whose checksum goes onto the card.
        facts: the card: ``trained_on``, ``licence`` and, if there are any, ``terms``.
    """
    origin = {"origin": f"imported from a file with sha256 {file_sha256(source)}"}
    card = {**origin, **facts}
    checkpoint = Checkpoint(kind=kind, config={}, state=network.state_dict(), facts=card)
    save_checkpoint(out, checkpoint)


def halve_state(network: nn.Module) -> dict[str, Tensor]:
    """Return the ``state_dict`` of a network with its floating-point tensors as float16."""
    state = network.state_dict()
    return {
        name: tensor.to(torch.float16) if tensor.is_floating_point() else tensor
        for name, tensor in state.items()
    }


def warn_of_terms(facts: Mapping[str, str]) -> None:
    """Warn (:class:`LicenceNotice`) if the card of weights has terms of use."""
    if terms := facts.get("terms", ""):
        warnings.warn(terms, LicenceNotice, stacklevel=3)


def join_terms(*cards: Mapping[str, str]) -> str:
    """Join the terms of use of all cards, each once: the terms of every part bind the whole."""
    joined = ""
    for card in cards:
        terms = card.get("terms", "")
        if not terms or _has_phrase(joined, terms):
            continue
        joined = terms if _has_phrase(terms, joined) else f"{joined} {terms}".strip()
    return joined


def _has_phrase(text: str, phrase: str) -> bool:
    """Whether a text has a phrase as whole words: "commercial" is not in "non-commercial"."""
    return f" {phrase} " in f" {text} "


def add_terms(facts: Mapping[str, str], made_of: Iterable[str | Path]) -> dict[str, str]:
    """Add the terms of weights to the card of new weights that are made of them.

    Args:
        facts: the card, with terms of its own if it has any; it is not changed.
        made_of: names of these weights, as :func:`find_weights` takes them.

    Raises:
        InputError: there are no such weights.
    """
    cards = [read_checkpoint(find_weights(name)).facts for name in made_of]
    terms = join_terms(facts, *cards)
    return {**facts, "terms": terms} if terms else dict(facts)


def _refuse_impossible_numbers(path: Path, state: Mapping[str, Tensor]) -> None:
    """Refuse tensors with NaN or infinity, and negative variances of batch norm.

    A network with such weights may give plausible, but wrong results.
    """
    for name, tensor in state.items():
        # A sum takes no memory. Only where it is not finite are the numbers counted.
        bad_count = 0
        if tensor.is_floating_point() and not tensor.sum(dtype=torch.float32).isfinite():
            bad_count = tensor.numel() - int(tensor.isfinite().sum())
        if bad_count:
            raise InputError(
                f"{path}: {bad_count} of the {tensor.numel()} numbers of {name!r} are NaN or "
                "infinite, so its training diverged or the file is damaged; take other weights"
            )
        if name.endswith("running_var") and (tensor < 0).any():
            raise InputError(
                f"{path}: {name!r} holds a variance below 0, so the file is damaged; take other "
                "weights"
            )
