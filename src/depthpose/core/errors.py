"""The errors and notices that users see, and functions that word their messages."""

import re
from collections.abc import Callable, Iterable
from difflib import get_close_matches
from importlib import import_module
from typing import Any, TypeVar


class InputError(ValueError):
    """What the user gave cannot be used.

    The message names the value, the rule that it breaks and the remedy. Readers of files raise no
    other error, whatever bytes they read; commands print it and end with exit code 2.
    """


Result = TypeVar("Result")


def result_or_error(function: Callable[..., Result], *arguments: object) -> Result | InputError:
    """Call a function, and return the InputError that it raises: of many, one costs no other."""
    try:
        return function(*arguments)
    except InputError as error:
        return error


class MissingExtraError(ImportError):
    """An optional dependency is not installed; the message says which extra brings it."""

    def __init__(self, package: str, extra: str, purpose: str) -> None:
        super().__init__(
            f"{purpose} needs {package}, which is not installed: {install_command(extra)}"
        )


def install_command(extra: str) -> str:
    """Describe how an extra is installed: from a clone or a wheel; no index has a release yet."""
    clone = f"pip install -e '.[{extra}]' in the clone of depthpose"
    return f"{clone}, or pip install 'WHEEL[{extra}]' with the file of the wheel"


class Notice(UserWarning):
    """A warning for the user, which commands print as one line."""


_OUT_OF_MEMORY = re.compile(
    r"(out of|not enough|insufficient) memory|(can't|cannot|unable to|failed to) (allocate|map)"
    r"|bad_alloc",
    re.IGNORECASE,
)
_LONGEST_CAUSE = 200  # letters that are shown of another library's message


def describe_full_memory(error: BaseException) -> str | None:
    """Describe an out-of-memory error of any library, with remedies; None for another error.

    Libraries raise it by many types; it is recognised by the message.
    """
    if not isinstance(error, MemoryError) and _OUT_OF_MEMORY.search(str(error)) is None:
        return None
    cause = " ".join(str(error).split())[:_LONGEST_CAUSE] or "no more is given"
    return (
        f"the memory is full ({cause}); end other programs, raise the limit (ulimit -v), take "
        "smaller images, or give a stereo matcher --max-memory"
    )


def import_extra(module: str, package: str, extra: str, purpose: str) -> Any:  # noqa: ANN401
    """Import and return an optional dependency.

    Args:
        module: its name in Python, such as ``cv2``.
        package: its name for pip.
        extra: the extra of depthpose that installs it.
        purpose: what needs it, with which errors begin.

    Raises:
        MissingExtraError: it is not installed.
        InputError: it is installed and does not load.
    """
    try:
        return import_module(module)
    except (ImportError, OSError) as error:  # OSError: of a library that ctypes loads
        top_module = module.partition(".")[0]
        # Where another module is missing, it is one that this dependency needs itself.
        if isinstance(error, ModuleNotFoundError) and error.name in (module, top_module):
            raise MissingExtraError(package, extra, purpose) from error
        reason = describe_full_memory(error)
        if reason is not None:
            raise InputError(f"{purpose} needs {package}: {reason}") from error
        raise InputError(
            f"{purpose} needs {package}, which is installed and does not load: {error}; a library "
            "of the system is missing, or the package is damaged"
        ) from error


def import_opencv(purpose: str) -> Any:  # noqa: ANN401  OpenCV's classes carry no types
    """Import and return OpenCV's ``cv2`` (the extra ``opencv``), as :func:`import_extra` does."""
    return import_extra("cv2", "opencv-python-headless", "opencv", purpose)


def refuse_unknown(what: str, name: object, names: Iterable[str]) -> None:
    """Refuse a name that is not among the allowed ones.

    Args:
        what: what has that name, such as ``unit``, for the error.
        name: the name.
        names: the allowed names.

    Raises:
        InputError: it is not among them; the message suggests the nearest.
    """
    allowed_names = tuple(names)
    if name not in allowed_names:
        raise InputError(f"{what} is {name!r}; {suggest_name(str(name), allowed_names)}")


def suggest_name(name: str, candidates: Iterable[str]) -> str:
    """Word the end of an error about an unknown name: the most similar candidate, and all of them.

    Returns:
        ``did you mean 'x'? Known: 'a', 'x'.``, or only the list where no candidate is similar.
    """
    sorted_names = sorted(candidates)
    similar = get_close_matches(name, sorted_names, n=1)
    suggestion = f"did you mean {similar[0]!r}? " if similar else ""
    return f"{suggestion}Known: {', '.join(map(repr, sorted_names)) or 'none'}."
