"""The options of commands: their types and how ``--help`` shows them.

Types become words (``{None}|PATH`` is PATH), and a default that is nothing is not shown. Paths and
weights that do not exist are refused before anything is loaded.
"""

import os
import re
import shutil
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import is_dataclass, replace
from difflib import get_close_matches
from enum import Enum
from functools import cache, partial
from inspect import BoundArguments, cleandoc, signature, unwrap
from itertools import groupby
from pathlib import Path
from types import NoneType, UnionType
from typing import (
    Annotated,
    Any,
    Literal,
    NamedTuple,
    Protocol,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
    runtime_checkable,
)

import docstring_parser
import tyro

from depthpose.core.errors import InputError


class ValueKind(Enum):
    """The kinds of values of options that are looked up before a command runs."""

    INPUT = "a file or folder that is read"
    NEW = "a file or folder that need not exist"
    WEIGHTS = "weights, by name or file"


Source = Annotated[str, ValueKind.INPUT]
"""A file, folder, pattern or URL that is read; a ``Path`` is a file or folder that is read."""
NewPath = Annotated[Path, ValueKind.NEW]
"""A file or folder that need not exist: it is written, or the command itself says it is missing."""
NewPlace = Annotated[str, ValueKind.NEW]
"""A folder or URL that is written."""
WeightsName = Annotated[str, ValueKind.WEIGHTS]
"""Weights, by name or file, or one of ``_NOT_WEIGHTS``."""

_NOT_WEIGHTS = ("sgbm", "nothing", "register")
"""Words that may stand in place of weights."""
_PREFIXES = "^(both|sgbm|own|matched|quick|fine):"
"""Before the name of weights: how they are used."""
_POSITIONAL = get_args(tyro.conf.Positional[int])[1]
"""The mark of positional arguments in their types."""
_PLACEHOLDERS = {Path: "PATH", str: "TEXT", int: "N", float: "NUMBER"}
_EMPTY_DEFAULTS = ("", "None")
"""Defaults that ``--help`` does not show."""
_MAX_WIDTH = 100
"""Characters of a line of help; a wider terminal is not filled, for long lines are hard to read."""
Config = TypeVar("Config", bound=Any)


def _describe_default(default: str) -> str:
    """Make the note on the default for ``--help``; empty where there is none."""
    return "" if default in _EMPTY_DEFAULTS else f"(default: {default})"


shown_as = partial(tyro.conf.arg, help_behavior_hint=_describe_default)
"""Show an option with this ``metavar`` in the place of its value; None: as tyro does."""

Device = Annotated[str, shown_as(metavar="DEVICE", help="cpu, cuda, cuda:1, ...")]


class Option(NamedTuple):
    """An option of a command."""

    parameter: str  #: parameter of the command's function: the option, or the group it belongs to
    name: str  #: its name, with underscores
    kind: ValueKind | None  #: kind of its value; None: neither a file nor weights


@cache  # a second call would annotate the fields of groups once more, and all later ones be slower
def make_parser(
    command: Callable[..., int],
) -> tuple[Callable[..., BoundArguments], list[Option]]:
    """Make a function that tyro can parse options for, and list the options of a command.

    The function has the signature and docstring of the command, with types that say how ``--help``
    shows them. It returns the arguments that the command is called with.
    """
    hints = get_type_hints(command, include_extras=True)
    command_signature = signature(command)
    options: list[Option] = []
    for parameter in command_signature.parameters.values():
        if is_dataclass(parameter.default):  # a group of options: each of its fields is one
            group = type(parameter.default)
            types = get_type_hints(group, include_extras=True)
            texts = _read_help_texts(group)
            group.__annotations__, parameter_options = _with_help(types, parameter.name, texts)
        else:
            types = {parameter.name: hints[parameter.name]}
            texts = _read_help_texts(command)
            annotated, parameter_options = _with_help(types, parameter.name, texts)
            hints |= annotated
        options += parameter_options
    parameters = [
        parameter.replace(annotation=hints[name])
        for name, parameter in command_signature.parameters.items()
    ]

    def parse(*words: object, **options: object) -> BoundArguments:
        """Bind parsed options to the parameters of the command."""
        return command_signature.bind(*words, **options)

    function = unwrap(parse)  # tests wrap functions to check types, and tyro reads the inner one
    function.__doc__ = command.__doc__
    function.__module__ = command.__module__
    function.__annotations__ = hints
    vars(function)["__signature__"] = command_signature.replace(parameters=parameters)
    return function, options


def _with_help(
    types: Mapping[str, Any], parameter: str, texts: Mapping[str, str]
) -> tuple[dict[str, Any], list[Option]]:
    """Annotate the types of options with their placeholders and texts for ``--help``.

    Args:
        types: types of the options, by name.
        parameter: parameter of the command that the options belong to.
        texts: help texts of the options, by name.

    Returns:
        The annotated types, and the options.
    """
    annotated: dict[str, Any] = {}
    options: list[Option] = []
    for name, hint in types.items():
        placeholder, kind = _choose_placeholder(hint)
        marks = getattr(hint, "__metadata__", ())
        if any(hasattr(mark, "metavar") for mark in marks):  # the declaration has its own
            placeholder = None
        annotated[name] = Annotated[hint, shown_as(metavar=placeholder, help=texts.get(name))]
        options.append(Option(parameter, name, kind))
    return annotated, options


def _read_help_texts(described: type | Callable[..., int]) -> dict[str, str]:
    """Read the text of each option from the docstrings of a command, or of a group's fields.

    Each text becomes a single line, for tyro would keep the line breaks of the source code.
    """
    sources: list[Any] = [described]
    if isinstance(described, type):  # fields may be inherited; a subclass has the last word
        sources = [base for base in reversed(described.mro()) if base is not object]
    texts: dict[str, str] = {}
    for source in sources:
        for option in docstring_parser.parse_from_object(source).params:
            texts[option.arg_name] = " ".join((option.description or "").split())
    return texts


def format_description(command: Callable[..., int]) -> str:
    """Format a command's docstring for ``--help``: without its arguments, as wide as the terminal.

    Lines are indented, since tyro joins those that begin with a letter; lines that the docstring
    indents (examples, lists) stay as they are.
    """
    width = min(shutil.get_terminal_size().columns, _MAX_WIDTH) - 2
    text = cleandoc(command.__doc__ or "").partition("\nArgs:")[0].strip()
    wrapped: list[str] = []
    for is_prose, run in groupby(text.splitlines(), lambda line: line[:1] not in ("", " ")):
        lines = list(run)
        wrapped += textwrap.wrap(" ".join(lines), width) if is_prose else lines
    return textwrap.indent("\n".join(wrapped), "  ")


def _choose_placeholder(hint: Any) -> tuple[str | None, ValueKind | None]:  # noqa: ANN401  any type
    """Choose the placeholder of a value in ``--help``, and find its kind, by its type.

    Returns:
        The placeholder, None where tyro's own will do; and the kind, None where the value is
        neither a file nor weights.
    """
    origin = get_origin(hint)
    parts = get_args(hint)
    if origin is Annotated:
        kind = next((mark for mark in parts if isinstance(mark, ValueKind)), None)
        if kind is None:
            return None, _choose_placeholder(parts[0])[1]
        placeholder = "NAME|FILE" if kind is ValueKind.WEIGHTS else "PATH"
        is_positional = _POSITIONAL in parts  # shown by its own name
        return None if is_positional else placeholder, kind
    if origin in (Union, UnionType):
        return _choose_placeholder(next(part for part in parts if part is not NoneType))
    if origin is Literal:
        return f"{{{','.join(map(str, parts))}}}", None
    if origin in (tuple, list):
        placeholder, kind = _choose_placeholder(parts[0])
        has_any_length = parts[1:] in ((), (...,))
        if placeholder is not None and has_any_length:
            placeholder = f"{placeholder} ..."
        elif placeholder is not None:
            placeholder = " ".join([placeholder] * len(parts))
        return placeholder, kind
    return _PLACEHOLDERS.get(hint), ValueKind.INPUT if hint is Path else None


def refuse_missing(options: Sequence[Option], values: Mapping[str, Any]) -> None:
    """Refuse paths and weights that do not exist.

    Paths are looked up first, for weights need torch, which is slow to load. Patterns and URLs are
    left to the command.

    Args:
        options: options of the command.
        values: arguments of the command, by its parameters.

    Raises:
        InputError: one does not exist.
    """
    with_paths = [option for option in options if option.kind in (ValueKind.INPUT, ValueKind.NEW)]
    for option in with_paths:
        for word in _list_words(option, values):
            if not any(mark in word for mark in ("://", *"*?[{")):
                _refuse_missing_path(word, must_exist=option.kind is ValueKind.INPUT)
    for option in options:
        if option.kind is ValueKind.WEIGHTS:
            for word in _list_words(option, values):
                _refuse_missing_weights(word)


def _list_words(option: Option, values: Mapping[str, Any]) -> list[str]:
    """List the words of an option: of several values, of one, or of none."""
    if option.parameter not in values:
        return []
    value = values[option.parameter]
    if option.parameter != option.name:  # a field of a group of options
        value = getattr(value, option.name)
    words = value if isinstance(value, list | tuple) else [value]
    return [str(word) for word in words if word is not None]


def _refuse_missing_path(word: str, *, must_exist: bool) -> None:
    """Refuse a path that does not exist; one that need not exist only behind a broken link."""
    path = Path(word)
    if path.exists():
        return
    if any(map(os.path.islink, (path, *path.parents))):
        from depthpose.core.files.disk import refuse_broken_link  # loads torch

        refuse_broken_link(path)
    if not must_exist:
        return
    folder = path.parent
    names = [neighbour.name for neighbour in folder.iterdir()] if folder.is_dir() else []
    near = get_close_matches(path.name, names, n=1)
    hint = f"did you mean {str(folder / near[0])!r}?" if near else "check the path"
    raise InputError(f"{word}: there is no such file or folder; {hint}")


def _refuse_missing_weights(word: str) -> None:
    """Refuse weights that do not exist, other than those of the Hugging Face hub."""
    name = re.sub(_PREFIXES, "", word)
    if name not in _NOT_WEIGHTS and not name.startswith("hf:/"):
        from depthpose.core.checkpoint import find_weights  # loads torch

        find_weights(name)


@runtime_checkable
class _CheckedOptions(Protocol):
    """A group of options with values that can be out of their range."""

    def refuse_unusable(self) -> None:
        """Raise an ``InputError`` for a value out of its range."""


def refuse_unusable(values: Mapping[str, Any]) -> None:
    """Refuse values out of their range, in the groups of options that check their own.

    Args:
        values: arguments of the command, by its parameters.

    Raises:
        InputError: a value is out of its range.
    """
    for value in values.values():
        if isinstance(value, _CheckedOptions):
            value.refuse_unusable()


def refuse_below(least: int, option: str, value: float, usual: str) -> None:
    """Refuse a number that is too small; ``usual`` is a value that the error suggests."""
    if value < least:
        raise InputError(f"{option} {value}: give {least} or more, such as {usual}")


def refuse_outside(least: float, most: float, option: str, value: float, words: str) -> None:
    """Refuse a number out of its range; ``words`` follow the range: its unit, say."""
    if not least <= value <= most:
        raise InputError(f"{option} {value:g}: give {least:g} to {most:g}{words}")


def replace_unless_none(config: Config, **values: object) -> Config:
    """Return a copy of a config with other values; a value of None leaves its setting as it is."""
    return replace(config, **{name: value for name, value in values.items() if value is not None})
