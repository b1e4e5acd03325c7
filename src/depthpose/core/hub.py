"""Weights by what names them: a file, a folder, a name in the package, or one on the hub.

Nothing heavy is imported here, so that a name that leads nowhere is refused at once.

On the Hugging Face hub a name is ``hf://OWNER/NAME``, ``hf://OWNER/NAME@REVISION`` or
``hf://OWNER/NAME/FILE.safetensors``, as huggingface_hub's own file system writes it. Nothing else
is fetched. Files lie in that library's cache, and its settings hold: HF_HOME, HF_ENDPOINT,
HF_HUB_OFFLINE, the token of ``hf auth login``.
"""

import re
from functools import cache
from importlib import import_module
from pathlib import Path

from depthpose.core.errors import InputError, import_extra, nearest_name

WEIGHTS_FILE = "model.safetensors"
"""Name of the weights in a repository, as others on the hub call theirs."""

_NAME = r"[\w-][\w.-]*/[\w-][\w.-]*"
# One slash is left of the two where the name was made a path.
_REFERENCE = re.compile(rf"hf://?(?P<repository>{_NAME})(@(?P<revision>[^/@]+))?(/(?P<file>.+))?")


ON_HUB = "hf:/"
"""Begins a name of the hub."""


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
        errors.HFValidationError: "no name that the hub allows: {said}",
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
            "the hub refused: {said}; try again, or copy the file here and give its path."
        ),
    }
    try:
        path = hub.hf_hub_download(reference["repository"], file, revision=reference["revision"])
    except Exception as error:
        said = " ".join(str(error).split())[:200] or type(error).__name__
        for kinds, remedy in remedies.items():
            if isinstance(error, kinds):
                raise InputError(f"{name}: {remedy.replace('{said}', said)}") from error
        raise
    return Path(path)


SHIPPED = Path(__file__).parents[1] / "weights"
"""Folder of the weights that come with the package."""

_IN_REPOSITORY = ("kitti-nc", "linemod-nc", "bunny-nc", "ycb")  # weights that stay out of the wheel


def find_weights(name: str | Path) -> Path:
    """Find a weights file: by its path, its folder, its name in the package, or on the hub.

    Args:
        name: a file; weights that came with the package, by name; a folder with one file of
            weights, or with ``model.safetensors``; or ``hf://OWNER/NAME`` (``core.hub``).

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
        which = ", ".join(file.name for file in files) or "none"
        raise InputError(
            f"{path}: a folder of weights holds one .safetensors file, or one called "
            f"{WEIGHTS_FILE}; here: {which}. Name the file."
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
