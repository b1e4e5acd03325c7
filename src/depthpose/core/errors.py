"""The one error that bad input raises, the notice that stops nothing, and the nearest name."""

import re
from collections.abc import Iterable
from difflib import get_close_matches
from importlib import import_module
from typing import Any


class InputError(ValueError):
    """Something the user gave cannot be used.

    The message names the value, the rule it breaks and the remedy. Nothing else escapes from a
    reader, whatever bytes it is given; the command line turns it into exit code 2.
    """


class MissingExtraError(ImportError):
    """An optional dependency is not installed; the message says which extra brings it."""

    def __init__(self, package: str, extra: str, purpose: str) -> None:
        super().__init__(
            f"{purpose} needs {package}, which is not installed: {install_command(extra)}"
        )


def install_command(extra: str) -> str:
    """Give the command that installs an extra; the package index has no release yet."""
    clone = f"pip install -e '.[{extra}]' in the clone of depthpose"
    return f"{clone}, or pip install 'WHEEL[{extra}]' with the file of the wheel"


class Notice(UserWarning):
    """A warning that stops nothing; the command line prints it as one line."""


_OF_MEMORY = re.compile(
    r"(out of|not enough|insufficient) memory|(can't|cannot|unable to|failed to) (allocate|map)"
    r"|bad_alloc",
    re.IGNORECASE,
)


def full_memory(error: BaseException) -> str | None:
    """Give the message of an out-of-memory error of any library, with the remedy; else None."""
    if not isinstance(error, MemoryError) and _OF_MEMORY.search(str(error)) is None:
        return None
    cause = " ".join(str(error).split())[:200] or "no more is given"
    return (
        f"the memory is full ({cause}); end other programs, raise the limit (ulimit -v), take "
        "smaller images, or give a stereo matcher --max-memory"
    )


def import_extra(module: str, package: str, extra: str, purpose: str) -> Any:  # noqa: ANN401
    """Import an optional dependency where it is used.

    Args:
        module: its name in Python.
        package: its name for pip.
        extra: of depthpose, which brings it.
        purpose: what needs it.

    Raises:
        MissingExtraError: it is not installed.
        InputError: it is installed and does not load.
    """
    try:
        return import_module(module)
    except (ImportError, OSError) as error:  # OSError: of a library that ctypes loads
        names = (module, module.partition(".")[0])
        if isinstance(error, ModuleNotFoundError) and error.name in names:
            raise MissingExtraError(package, extra, purpose) from error
        if (reason := full_memory(error)) is not None:
            raise InputError(f"{purpose} needs {package}: {reason}") from error
        raise InputError(
            f"{purpose} needs {package}, which is installed and does not load: {error}; a library "
            "of the system is missing, or the package is damaged"
        ) from error


def import_opencv(purpose: str) -> Any:  # noqa: ANN401  OpenCV's classes carry no types
    """Import OpenCV, as :func:`import_extra`."""
    return import_extra("cv2", "opencv-python-headless", "opencv", purpose)


def refuse_unknown(what: str, name: object, names: Iterable[str]) -> None:
    """Refuse a word that is none of the known ones.

    Raises:
        InputError: that is so; the nearest is said.
    """
    names = tuple(names)
    if name not in names:
        raise InputError(f"{what} is {name!r}; {nearest_name(str(name), names)}")


def nearest_name(name: str, candidates: Iterable[str]) -> str:
    """Give the end of an error message: the name that was probably meant, and all names.

    Returns:
        ``did you mean 'x'? Known: 'a', 'x'.``, or only the list where nothing is near.
    """
    names = sorted(candidates)
    near = get_close_matches(name, names, n=1)
    hint = f"did you mean {near[0]!r}? " if near else ""
    return f"{hint}Known: {', '.join(map(repr, names)) or 'none'}."
