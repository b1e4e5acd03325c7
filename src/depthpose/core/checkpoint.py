"""Weights with the config that made them: safetensors, loaded strictly; others' files, safely.

Weights are named by a file, a folder, a name in the package, or one on the Hugging Face hub:
``hf://OWNER/NAME``, ``hf://OWNER/NAME@REVISION`` or ``hf://OWNER/NAME/FILE.safetensors``, as
huggingface_hub's own file system writes it. Nothing else is fetched. Files lie in that library's
cache, and its settings hold: HF_HOME, HF_ENDPOINT, HF_HUB_OFFLINE, the token of ``hf auth login``.
"""

import hashlib
import json
import pickle
import re
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, TypeVar

import torch
from safetensors import safe_open
from safetensors.torch import save
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from depthpose.core.errors import InputError, Notice, import_extra, nearest_name
from depthpose.core.files.disk import finite_number, refused_as, write_bytes

NetworkT = TypeVar("NetworkT", bound=nn.Module)
_DRAWS = (nn.init.normal_, nn.init.uniform_, nn.init.kaiming_normal_, nn.init.kaiming_uniform_)
"""Functions that draw random weights, and may be skipped as a whole."""
_SAFETENSORS = (
    "safetensors file", "a published checkpoint is imported by 'depthpose weights import'"
)  # fmt: skip
"""What a file should be, and what to do where it is not."""

WEIGHTS_FILE = "model.safetensors"
"""Name of the weights in a repository, as others on the hub call theirs."""

_NAME = r"[\w-][\w.-]*/[\w-][\w.-]*"
# One slash is left of the two where the name was made a path.
_REFERENCE = re.compile(rf"hf://?(?P<repository>{_NAME})(@(?P<revision>[^/@]+))?(/(?P<file>.+))?")


ON_HUB = "hf:/"
"""Begins a name of the hub."""
SHIPPED = Path(__file__).parents[1] / "weights"
"""Folder of the weights that come with the package."""

_IN_REPOSITORY = ("kitti-nc", "linemod-nc", "bunny-nc", "ycb")  # weights that stay out of the wheel


class LicenceNotice(Notice):
    """Weights whose terms restrict their use."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Checkpoint:
    """The contents of a weights file."""

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


def find_weights(name: str | Path) -> Path:
    """Find a weights file: by its path, its folder, its name in the package, or on the hub.

    Args:
        name: a file; weights that came with the package, by name; a folder with one file of
            weights, or with ``model.safetensors``; or ``hf://OWNER/NAME``.

    Raises:
        InputError: none of these; the nearest name is said.
    """
    path = Path(name)
    shipped = {file.stem: file for file in SHIPPED.glob("*.safetensors")}
    if path.is_file():
        return path
    if str(name) in shipped:
        return shipped[str(name)]
    if path.is_dir():
        files = sorted(path.glob("*.safetensors"))
        named = [file for file in files if file.name == WEIGHTS_FILE] or files
        if len(named) == 1:
            return named[0]
        file_names = ", ".join(file.name for file in files) or "none"
        raise InputError(
            f"{path}: a folder of weights holds one .safetensors file, or one called "
            f"{WEIGHTS_FILE}; here: {file_names}. Name the file."
        )
    if str(name).startswith(ON_HUB):
        return fetch_weights(str(name))
    if str(name) in _IN_REPOSITORY:
        raise InputError(
            f"weights {str(name)!r}: not in the wheel, for their terms or their size. Take "
            f"src/depthpose/weights/{name}.safetensors from the repository and give its path."
        )
    raise InputError(
        f"weights {str(name)!r}: neither a file nor the name of weights that came with depthpose; "
        f"{nearest_name(str(name), shipped)} 'depthpose weights import' imports published ones, "
        "hf://OWNER/NAME those on the hub."
    )


@cache
def fetch_weights(name: str) -> Path:
    """Give the local file of weights on the hub, downloaded if the cache has not got them.

    Asked again, one process gets the same file: what is fingerprinted is what is loaded.

    Raises:
        InputError: no such name, repository, revision or file; no access; no connection.
        MissingExtraError: the extra ``hub`` is not installed.
    """
    reference = _REFERENCE.fullmatch(name)
    if reference is None:
        raise InputError(
            f"{name!r}: weights on the hub are hf://OWNER/NAME, hf://OWNER/NAME@REVISION or "
            "hf://OWNER/NAME/FILE.safetensors."
        )
    file = reference["file"] or WEIGHTS_FILE
    if not file.endswith(".safetensors"):
        raise InputError(f"{name!r}: only .safetensors are fetched: they cannot run code.")
    hub = import_extra("huggingface_hub", "huggingface_hub", "hub", "weights on the hub")
    errors = import_module("huggingface_hub.errors")
    remedies = {
        errors.HFValidationError: "no name that the hub allows: {reason}",
        errors.GatedRepoError: "its owner asks for consent; give it on the repository's page, then "
        "'hf auth login'.",
        errors.RepositoryNotFoundError: "there is no such repository, or it is private: check the "
        "name, or 'hf auth login' with an account that may read it.",
        errors.RevisionNotFoundError: "the repository has no such revision.",
        (errors.LocalEntryNotFoundError, errors.OfflineModeIsEnabled): "the hub cannot be reached, "
        "and it is not in the cache. Connect once, unset HF_HUB_OFFLINE, or copy the repository's "
        "folder here and give its path.",
        errors.EntryNotFoundError: f"the repository has no such file ({WEIGHTS_FILE} by default); "
        "name it: hf://OWNER/NAME/FILE.safetensors.",
        # Of the connection, of access, of a full disk. Base classes of the library's errors: of
        # requests, of httpx or its successor.
        (OSError, *(k for k in errors.HfHubHTTPError.__mro__[1:] if k.__module__ != "builtins")): (
            "the hub refused: {reason}; try again, or copy the file here and give its path."
        ),
    }
    try:
        path = hub.hf_hub_download(reference["repository"], file, revision=reference["revision"])
    except Exception as error:
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        for kinds, remedy in remedies.items():
            if isinstance(error, kinds):
                raise InputError(f"{name}: {remedy.replace('{reason}', reason)}") from error
        raise
    return Path(path)


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
    stored_kind = metadata.pop("kind")
    if kind is not None and stored_kind != kind:
        raise InputError(
            f"{path}: holds weights of kind {stored_kind!r}, but {kind!r} is needed here."
        )
    try:
        config = json.loads(metadata.pop("config"), parse_constant=finite_number)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: its 'config' is not JSON ({error}).") from error
    if not isinstance(config, dict):
        raise InputError(f"{path}: its 'config' is not a mapping.")
    return Checkpoint(kind=stored_kind, config=config, state=_finite(path, state), facts=metadata)


def file_sha256(path: Path) -> str:
    """Compute a file's sha256, recorded beside every number that was made with it."""
    with Path(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def load_weights(network: nn.Module, checkpoint: Checkpoint, source: str) -> None:
    """Copy the weights into ``network``; every name and shape must agree.

    Raises:
        InputError: the first names that are missing, unexpected or of another shape.
    """
    problems = misfits(network.state_dict(), checkpoint.state)
    if problems:
        raise InputError(
            f"{source}: {len(problems)} tensors do not fit the network of its config: "
            f"{'; '.join(problems[:3])}. File and config belong to different versions."
        )
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
            load_weights(make(), checkpoint, source)  # compares shapes, and copies nothing
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


def misfits(wanted: Mapping[str, Tensor], tensors: Mapping[str, Tensor]) -> list[str]:
    """List the tensors that are missing, unexpected or of another shape, by name."""
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

    Errors say that it should hold ``network``.

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

    The card's ``facts`` say ``trained_on`` and ``licence``.
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


def _finite(path: Path, state: Mapping[str, Tensor]) -> Mapping[str, Tensor]:
    """Refuse tensors with NaN or infinity, of which a network would make plausible nonsense."""
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
