"""The values of options in ``--help``; paths and weights that do not exist, refused early.

Types become words (``{None}|PATH`` is PATH), and a default that is nothing is not shown.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, is_dataclass
from difflib import get_close_matches
from inspect import signature, unwrap
from itertools import pairwise
from pathlib import Path
from types import NoneType, UnionType
from typing import (
    Annotated,
    Any,
    Literal,
    TypeVar,
    Union,
    dataclass_transform,
    get_args,
    get_origin,
    get_type_hints,
)

import tyro

from depthpose.core.errors import InputError
from depthpose.core.hub import find_weights, is_on_hub

PATHS = frozenset({
    *("images", "left", "right", "camera", "cloud", "depth", "mask", "bop", "data", "held_out"),
    *("train", "evaluation", "path", "config", "cad", "csv", "predictions", "targets", "file"),
    *("models", "kitti", "linemod", "results", "folder"),
})  # fmt: skip
"""Arguments of commands that name files or folders that are read."""
WEIGHTS = frozenset({"weights", "pose_weights", "matcher", "generator", "start", "encoder"})
"""Arguments that name weights, by name or file."""
_WORDS = ("sgbm", "nothing", "open3d", "register")
"""What they may say in place of weights."""
_PREFIXES = ("both:", "sgbm:", "own:", "matched:", "joined:", "quick:", "fine:")
"""Before the name of weights: how they are used."""


def refuse_empty(words: Sequence[str]) -> None:
    """Refuse an option that names a file or folder by nothing, which would be the current folder.

    A script whose variable is unset gives such a word.

    Args:
        words: what follows the name of a command.

    Raises:
        InputError: the option that is empty.
    """
    for word, after in pairwise([*words, "end"]):
        option, sign, value = word.partition("=")
        name = option.removeprefix("--").replace("-", "_")
        is_path = option.startswith("--") and name in {"out", *PATHS, *WEIGHTS}
        if is_path and (value if sign else after) == "":
            raise InputError(
                f"{option} is empty; name a file or folder (the current folder is '.'), or check "
                "the variable that should hold it"
            )


def refuse_missing(given: Mapping[str, object]) -> None:
    """Refuse paths and weights that do not exist.

    Args:
        given: the arguments of a command by name.

    Raises:
        InputError: a path or weights that are not there.
    """
    for name, value in given.items():
        if is_dataclass(value):  # a group of options
            refuse_missing(vars(value))
        for one in value if isinstance(value, list | tuple) else [value]:
            if name in PATHS and isinstance(one, str | Path):
                _refuse_path(str(one))
            elif name in WEIGHTS and isinstance(one, str):
                _refuse_weights(one)


def _refuse_path(path: str) -> None:
    if any(mark in path for mark in ("://", "*", "?", "[", "{")) or Path(path).exists():
        return
    wanted = Path(path)
    beside = [p.name for p in wanted.parent.iterdir()] if wanted.parent.is_dir() else []
    near = get_close_matches(wanted.name, beside, n=1)
    hint = f"; did you mean {str(wanted.parent / near[0])!r}?" if near else "; check the path"
    raise InputError(f"{path}: there is no such file or folder{hint}")


def _refuse_weights(name: str) -> None:
    for prefix in _PREFIXES:
        name = name.removeprefix(prefix)
    if name not in _WORDS and not is_on_hub(name):
        find_weights(name)


_OF_TYPES = {Path: "PATH", str: "TEXT", int: "N", float: "NUMBER"}
_OF_NAMES = {"max_memory": "SIZE", "device": "DEVICE", "view": "live|FILE.rrd", "out": "PATH",
             "address": "HOST:PORT"}  # fmt: skip
_NOTHING = ("", "None")
Group = TypeVar("Group")


def in_words(metavar: str | None) -> Any:  # noqa: ANN401  tyro's own object
    """Show an option with this in the place of its value; None: as tyro does."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint=_hint)


@dataclass_transform(frozen_default=True, kw_only_default=True)
def group(options: type[Group]) -> type[Group]:
    """Make a class a frozen dataclass of options, each shown with its type in words."""
    options = dataclass(frozen=True, kw_only=True)(options)
    for name, hint in get_type_hints(options, include_extras=True).items():
        if name in options.__annotations__:
            options.__annotations__[name] = Annotated[hint, in_words(_metavar(name, hint))]
    return options


def in_words_of(command: Callable[..., int]) -> Callable[[Callable[..., int]], Callable[..., int]]:
    """Give a wrapper the signature of its command, with option types in words, for tyro.

    Groups of options, which are dataclasses, have words of their own.
    """
    hints = get_type_hints(command, include_extras=True)
    shape = signature(command)
    for name, parameter in shape.parameters.items():
        if not is_dataclass(parameter.default):
            hints[name] = Annotated[hints[name], in_words(_metavar(name, hints[name]))]
    worded = [p.replace(annotation=hints[n]) for n, p in shape.parameters.items()]

    def with_signature(given: Callable[..., int]) -> Callable[..., int]:
        function = unwrap(given)  # tyro looks behind what checks types in tests, and so do we
        function.__doc__, function.__module__ = command.__doc__, command.__module__
        function.__annotations__ = hints
        vars(function)["__signature__"] = shape.replace(parameters=worded)
        return function

    return with_signature


def _hint(default: str) -> str:
    return "" if default in _NOTHING else f"(default: {default})"


def _metavar(name: str, hint: Any) -> str | None:  # noqa: ANN401
    """Name a value; None where tyro's own name will do: of positional arguments and flags."""
    if get_origin(hint) is Annotated:  # described elsewhere, or positional
        return _OF_NAMES.get(name) if name in _OF_NAMES and get_args(hint)[0] is str else None
    if get_origin(hint) in (Union, UnionType):
        (hint,) = (part for part in get_args(hint) if part is not NoneType)
    if get_origin(hint) is Literal:
        return f"{{{','.join(map(str, get_args(hint)))}}}"
    if get_origin(hint) in (tuple, list):
        parts = get_args(hint)
        one = _metavar(name, parts[0])
        return one and (f"{one} ..." if parts[1:] in ((), (...,)) else " ".join([one] * len(parts)))
    if hint is str and name in (*PATHS, *_OF_NAMES):
        return _OF_NAMES.get(name, "PATH")
    return "NAME|FILE" if hint is str and name in WEIGHTS else _OF_TYPES.get(hint)
