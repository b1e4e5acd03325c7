"""Words of a command's ``--help``: what belongs into the place of a value, and what holds without.

Types become words (``{None}|PATH`` is PATH), and a default that is nothing is not shown.
"""

from collections.abc import Callable
from dataclasses import is_dataclass
from inspect import signature, unwrap
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import tyro

from depthpose.cli.early import PATHS, WEIGHTS

_OF_TYPES = {Path: "PATH", str: "TEXT", int: "N", float: "NUMBER"}
_OF_NAMES = {"max_memory": "SIZE", "device": "DEVICE", "view": "live|FILE.rrd", "out": "PATH"}
_NOTHING = ("", "None")


def in_words(metavar: str | None) -> Any:  # noqa: ANN401  tyro's own object
    """Show an option with this in the place of its value; None: as tyro does."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint=_hint)


def in_words_of(command: Callable[..., int]) -> Callable[[Callable[..., int]], Callable[..., int]]:
    """Let a function that stands for a command look like it to tyro, with each option in words.

    Groups of options, which are dataclasses, have words of their own.
    """
    hints = get_type_hints(command, include_extras=True)
    shape = signature(command)
    for name, parameter in shape.parameters.items():
        if not is_dataclass(parameter.default):
            hints[name] = Annotated[hints[name], in_words(_metavar(name, hints[name]))]
    worded = [p.replace(annotation=hints[n]) for n, p in shape.parameters.items()]

    def dress(given: Callable[..., int]) -> Callable[..., int]:
        function = unwrap(given)  # tyro looks behind what checks types in tests, and so do we
        function.__doc__, function.__module__ = command.__doc__, command.__module__
        function.__annotations__ = hints
        vars(function)["__signature__"] = shape.replace(parameters=worded)
        return function

    return dress


def _hint(default: str) -> str:
    return "" if default in _NOTHING else f"(default: {default})"


def _metavar(name: str, hint: Any) -> str | None:  # noqa: ANN401
    """Name a value; None where tyro's own name will do: of positional arguments and flags."""
    if get_origin(hint) is Annotated:
        return None
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
