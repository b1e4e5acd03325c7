"""YAML to frozen dataclass and back. The dataclass has defaults, checks and help."""

import dataclasses
import math
import types
from collections.abc import Mapping
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import yaml

from depthpose.core.errors import InputError, nearest_name, refuse_unknown

ConfigT = TypeVar("ConfigT")
_LONGEST = 500  # letters of a value that an error shows
_MAX_BYTES = 2**17  # largest config file: a hundred times the largest of ours


Seed = Annotated[int, "[0, 9223372036854775808)"]
"""What random numbers begin with: 63 bits."""
ASCENDING = "ascending"
"""Of a setting of two numbers: they are a range."""


class Settings:
    """Base of settings whose types say ranges: ``Annotated[int, "[16, inf)", 16]``.

    A number behind the range is one that the setting is a multiple of; ``ASCENDING`` there says
    that the lower end of a range comes first.

    Raises:
        InputError: a number that breaks these rules, or a word that the type does not know.
    """

    def __post_init__(self) -> None:
        rules = _rules_of(type(self))
        check_settings(self, **{name: rule[0] for name, rule in rules.items()})
        for name, (_, *more) in rules.items():
            value = getattr(self, name)
            if ASCENDING in more and value is not None and value[0] > value[1]:
                raise InputError(
                    f"{name} must be a range, the lower end first, got {value}; turn it"
                )
            steps = [step for step in more if step != ASCENDING]
            if any(value % step for step in steps):
                raise InputError(
                    f"{name} must be a multiple of {steps[0]}, got {value}; take "
                    f"{getattr(type(self), name)}"
                )


@cache
def _rules_of(kind: type) -> dict[str, tuple[Any, ...]]:
    hints = get_type_hints(kind, include_extras=True)
    return {n: hint.__metadata__ for n, hint in hints.items() if get_origin(hint) is Annotated}


def check_settings(config: Any, **ranges: str) -> None:  # noqa: ANN401  any dataclass
    """Refuse numbers outside their ranges, and words that the type of a setting does not know.

    Args:
        config: the dataclass of the settings. Those that are None are left out, and of several
            numbers each is looked at.
        ranges: intervals by the names of settings, written as in mathematics: ``"[0, 1)"``.

    Raises:
        InputError: the setting, what it may be, and its default are said.
    """
    for name, words in _words_of(type(config)).items():
        value = getattr(config, name)
        for word in value if isinstance(value, tuple) else (value,):
            if word is not None:
                refuse_unknown(name, word, words)
    defaults = _defaults_of(type(config))
    for name, interval in ranges.items():
        value, default = getattr(config, name), defaults[name]
        low, high = (float(end) for end in interval[1:-1].split(", "))
        for number in value if isinstance(value, tuple) else (value,):
            if number is None:
                continue
            is_above = number >= low if interval[0] == "[" else number > low
            is_below = number <= high if interval[-1] == "]" else number < high
            if not (is_above and is_below):
                known = default is not dataclasses.MISSING and default is not None
                remedy = f"; the default is {default}" if known else ""
                raise InputError(f"{name} must be in {interval}, got {_shown(value)}{remedy}")


@cache
def _words_of(kind: type) -> dict[str, tuple[str, ...]]:
    """Settings whose type lists the words that it knows."""
    words = {}
    for name, hint in get_type_hints(kind).items():
        choices = [hint, *get_args(hint)]
        literal = next((c for c in choices if get_origin(c) is Literal), None)
        if literal is not None and all(isinstance(word, str) for word in get_args(literal)):
            words[name] = get_args(literal)
    return words


def _defaults_of(kind: type) -> dict[str, Any]:
    return {
        f.name: f.default if f.default_factory is dataclasses.MISSING else f.default_factory()
        for f in dataclasses.fields(kind)
    }


def read_config(path: Path, kind: type[ConfigT]) -> ConfigT:
    """Read a YAML file that holds the differences from the defaults of ``kind``.

    Raises:
        InputError: not YAML, an unknown key (its nearest name is said), or a value refused.
    """
    from depthpose.core.files import read_text  # here: options load without torch
    from depthpose.core.files.text import parse_yaml

    content = parse_yaml(path, read_text(path, _MAX_BYTES))
    content = {} if content is None else content
    if not isinstance(content, Mapping):
        raise InputError(
            f"{path}: holds a {type(content).__name__}, but a config is a mapping of names to "
            "values, one 'name: value' a line."
        )
    return config_from_dict(_over_defaults(content, kind), kind, source=str(path))


def _over_defaults(content: Mapping[Any, Any], kind: type) -> dict[Any, Any]:
    """Merge nested differences into the defaults of ``kind``."""
    laid = dict(content)
    for name, default in _defaults_of(kind).items():
        own = content.get(name)
        if isinstance(own, Mapping) and dataclasses.is_dataclass(default):
            rivals = getattr(type(default), "INSTEAD", {})  # given, it removes the other's default
            left_out = {rivals[key] for key in own if key in rivals}
            kept = {k: v for k, v in config_to_dict(default).items() if k not in left_out}
            laid[name] = kept | _over_defaults(own, type(default))
    return laid


def config_from_dict(content: Mapping[Any, Any], kind: type[ConfigT], *, source: str) -> ConfigT:
    """Build the dataclass ``kind`` from a mapping; ``source`` names the mapping in errors.

    Names of settings of before (``RETIRED`` in their class) are left out.

    Raises:
        InputError: an unknown key, a wrong type, or a value that ``kind`` refuses.
    """
    return _build(content, kind, source, "")


def _build(content: Mapping[Any, Any], kind: type[Any], source: str, prefix: str) -> Any:  # noqa: ANN401
    hints = get_type_hints(kind)
    defaults = _defaults_of(kind)
    values: dict[str, Any] = {}
    for key, value in content.items():
        if key in getattr(kind, "RETIRED", ()):
            continue
        if key not in defaults:
            raise InputError(
                f"{source}: unknown key {_shown(prefix + str(key))}; "
                f"{nearest_name(str(key)[:_LONGEST], defaults)}"
            )
        # A default may be infinite, where no other number may.
        is_default = isinstance(value, float) and value == defaults[key]
        name = f"{prefix}{key}"
        values[key] = value if is_default else _value_of(value, hints[key], source, name)
    try:
        return kind(**values)
    except (ValueError, TypeError, OverflowError, AttributeError) as error:
        raise InputError(f"{source}: {str(error)[:_LONGEST]}") from error


def _value_of(value: Any, hint: Any, source: str, name: str) -> Any:  # noqa: ANN401, PLR0911
    """Give a value of the type that a setting has; nothing is cast to what was not meant."""
    if get_origin(hint) in (Union, types.UnionType):
        if value is None and type(None) in get_args(hint):
            return None
        *others, hint = (choice for choice in get_args(hint) if choice is not type(None))
        for other in others:
            with suppress(InputError):
                return _value_of(value, other, source, name)
    if get_origin(hint) is tuple:
        return tuple(_list_of(value, get_args(hint), source, name))
    if get_origin(hint) is list:
        return _list_of(value, (*get_args(hint), ...), source, name)
    if get_origin(hint) is dict and isinstance(value, Mapping):
        kind = get_args(hint)[1]
        return {k: _value_of(item, kind, source, f"{name}.{k}") for k, item in value.items()}
    if get_origin(hint) is Literal and value in get_args(hint):
        return value
    if dataclasses.is_dataclass(hint) and isinstance(value, Mapping):
        assert isinstance(hint, type)
        return _build(value, hint, source, f"{name}.")
    if hint is float:
        return _number_of(value, source, name)
    if hint is int and isinstance(value, bool):
        raise InputError(f"{source}: {name} is {value}, but a whole number is needed: write one")
    if hint is Path and isinstance(value, str):
        return Path(value)
    if isinstance(hint, type) and isinstance(value, hint):
        return value
    raise InputError(
        f"{source}: {name} is {_shown(value)}, which is not of type {hint}. Give a value of that "
        "type."
    )


def _list_of(value: object, hints: tuple[Any, ...], source: str, name: str) -> list[Any]:
    is_free = hints[-1] is Ellipsis
    if not isinstance(value, list | tuple):
        count = "a list" if is_free else f"a list of {len(hints)} values"
        remedy = "write its values in brackets, or leave the key out"
        if isinstance(value, str | int | float):
            times = 1 if is_free else len(hints)
            remedy = f"write [{', '.join([str(value)[:_LONGEST]] * times)}]"
        raise InputError(f"{source}: {name} is {_shown(value)}, but {count} is needed: {remedy}")
    if not is_free and len(value) != len(hints):
        raise InputError(
            f"{source}: {name} is {_shown(value)}, but {len(hints)} values are needed: give so many"
        )
    each = hints[:1] * len(value) if is_free else hints
    pairs = enumerate(zip(value, each, strict=True))
    return [_value_of(item, hint, source, f"{name}[{k}]") for k, (item, hint) in pairs]


def _number_of(value: Any, source: str, name: str) -> float:  # noqa: ANN401
    what = "finite number is needed: write one, or leave the key out for the default"
    try:
        number = float("none" if isinstance(value, bool) else value)
    except OverflowError:
        number = math.inf
    except (TypeError, ValueError):
        number, what = math.nan, "number is needed: write one"
    if not math.isfinite(number):
        raise InputError(f"{source}: {name} is {_shown(value)}, but a {what}")
    return number


def _shown(value: object) -> str:
    text = repr(value)
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}..."


def config_to_dict(config: object) -> dict[str, Any]:
    """Give every setting of a config with its value, nested, ready for YAML and JSON."""

    def plain(value: Any) -> Any:  # noqa: ANN401
        if isinstance(value, dict):
            return {name: plain(item) for name, item in value.items()}
        if isinstance(value, tuple | list):
            return [plain(item) for item in value]
        return str(value) if isinstance(value, Path) else value

    return plain(dataclasses.asdict(config))  # pyright: ignore[reportArgumentType]


def write_config(path: Path, config: object) -> None:
    """Write every setting of ``config``, defaults too, so that the file is a full record."""
    from depthpose.core.files import atomic_write  # here: options load without torch

    with atomic_write(path) as temporary:
        temporary.write_text(yaml.safe_dump(config_to_dict(config), sort_keys=False))
