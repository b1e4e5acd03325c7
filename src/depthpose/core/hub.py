"""Weights on the Hugging Face hub.

Their names are ``hf://OWNER/NAME``, ``hf://OWNER/NAME@REVISION`` or
``hf://OWNER/NAME/FILE.safetensors``, as in huggingface_hub's own file system. Files lie in that
library's cache, and its settings hold: HF_HOME, HF_ENDPOINT, HF_HUB_OFFLINE, the token of
``hf auth login``.
"""

import re
from functools import cache
from importlib import import_module
from pathlib import Path

from depthpose.core.errors import InputError, import_extra

WEIGHTS_FILE = "model.safetensors"
"""Usual name of the weights file in a repository on the hub."""

_REPOSITORY = r"[\w-][\w.-]*/[\w-][\w.-]*"
# A pathlib.Path of the name has one slash where the name has two.
_HUB_NAME = re.compile(
    rf"hf://?(?P<repository>{_REPOSITORY})(@(?P<revision>[^/@]+))?(/(?P<file>.+))?"
)

ON_HUB = "hf:/"
"""Beginning of the names of weights on the hub, also of a name that became a path."""
_LONGEST_REASON = 200  # letters that are shown of another library's message


@cache
def fetch_weights(name: str) -> Path:
    """Return the local file of weights on the hub, which is downloaded if it is not in the cache.

    A process gets the same file every time, so that a checksum is that of the weights it loads.

    Args:
        name: their name, as above.

    Raises:
        InputError: no such name, repository, revision or file; no access; no connection.
        MissingExtraError: the extra ``hub`` is not installed.
    """
    reference = _HUB_NAME.fullmatch(name)
    if reference is None:
        raise InputError(
            f"{name!r}: weights on the hub are hf://OWNER/NAME, hf://OWNER/NAME@REVISION or "
            "hf://OWNER/NAME/FILE.safetensors."
        )
    file = reference["file"] or WEIGHTS_FILE
    if not file.endswith(".safetensors"):
        raise InputError(f"{name!r}: only .safetensors are fetched: they cannot run code.")
    hub = import_extra("huggingface_hub", "huggingface_hub", "hub", "weights on the hub")
    try:
        path = hub.hf_hub_download(reference["repository"], file, revision=reference["revision"])
    except Exception as error:
        explanation = _explain_hub_error(error)
        if explanation is None:
            raise
        raise InputError(f"{name}: {explanation}") from error
    return Path(path)


def _explain_hub_error(error: Exception) -> str | None:
    """Explain an error of the hub's library, with a remedy; None for an error of another origin."""
    errors = import_module("huggingface_hub.errors")
    reason = " ".join(str(error).split())[:_LONGEST_REASON] or type(error).__name__
    # The library's errors derive from those of the HTTP library that it is built on: requests,
    # httpx or its successor.
    http_errors = [
        base for base in errors.HfHubHTTPError.__mro__[1:] if base.__module__ != "builtins"
    ]
    # The first that fits counts: special errors come before their base classes.
    explanations = (
        (errors.HFValidationError, f"no name that the hub allows: {reason}"),
        (
            errors.GatedRepoError,
            "its owner asks for consent; give it on the repository's page, then 'hf auth login'.",
        ),
        (
            errors.RepositoryNotFoundError,
            "there is no such repository, or it is private: check the name, or 'hf auth login' "
            "with an account that may read it.",
        ),
        (errors.RevisionNotFoundError, "the repository has no such revision."),
        (
            (errors.LocalEntryNotFoundError, errors.OfflineModeIsEnabled),
            "the hub cannot be reached, and it is not in the cache. Connect once, unset "
            "HF_HUB_OFFLINE, or copy the repository's folder here and give its path.",
        ),
        (
            errors.EntryNotFoundError,
            f"the repository has no such file ({WEIGHTS_FILE} by default); "
            "name it: hf://OWNER/NAME/FILE.safetensors.",
        ),
        (
            (OSError, *http_errors),  # of the connection, of access, of a full disk
            f"the hub refused: {reason}; try again, or copy the file here and give its path.",
        ),
    )
    for kinds, explanation in explanations:
        if isinstance(error, kinds):
            return explanation
    return None
