"""YAML to frozen dataclass and back. The dataclass has defaults, checks and help."""

import dataclasses
import math
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

import dacite
import yaml

from depthpose.core.errors import InputError, nearest_name, refuse_unknown

LONGEST = 500
"""Letters of a value that an error shows."""


def refuse_distorted(content: Mapping[Any, Any], kind: type, source: str, prefix: str = "") -> None:
    """Refuse what would be cast to something else than was meant.

    These are text or one number where a list belongs, truth values and text where a number
    belongs, and numbers that are not finite, unless the setting's default is not finite itself.
    """
    hints = get_type_hints(kind)
    fields = {field.name: field for field in dataclasses.fields(kind)}
    for name, value in content.items():
        if not isinstance(value, float) or value != default_of(fields[name]):
            _refuse(value, hints[name], source, f"{prefix}{name}")


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
    defaults = {field.name: default_of(field) for field in dataclasses.fields(config)}
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
                raise InputError(f"{name} must be in {interval}, got {shown(value)}{remedy}")


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


def default_of(field: dataclasses.Field[Any]) -> object:
    """Give the default of a setting; ``dataclasses.MISSING`` where it has none."""
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return field.default


def dataclass_in(hint: object) -> type | None:
    """Give the dataclass that a type is, or may be; None where there is none."""
    candidates = (hint, *get_args(hint))
    return next(
        (c for c in candidates if isinstance(c, type) and dataclasses.is_dataclass(c)), None
    )


def shown(value: object) -> str:
    """Show a value in an error, not beyond some length."""
    text = repr(value)
    return text if len(text) <= LONGEST else f"{text[:LONGEST]}..."


def _refuse(value: object, hint: object, source: str, name: str) -> None:
    nested = dataclass_in(hint)
    choices = [hint, *get_args(hint)]
    listed = next((c for c in choices if get_origin(c) is tuple), None)
    if value is None and type(None) in choices:
        return
    if nested is not None:
        if isinstance(value, Mapping):
            refuse_distorted(value, nested, source, f"{name}.")
    elif listed is not None:
        _refuse_list(value, get_args(listed), source, name)
    elif get_origin(hint) is dict:
        for key, item in value.items() if isinstance(value, Mapping) else ():
            _refuse(item, get_args(hint)[1], source, f"{name}.{key}")
    elif float in choices or int in choices:
        _refuse_number(value, source, name, is_whole=float not in choices)


def _refuse_list(value: object, hints: tuple[Any, ...], source: str, name: str) -> None:
    is_free = hints[-1] is Ellipsis
    if not isinstance(value, list | tuple):
        count = "a list" if is_free else f"a list of {len(hints)} values"
        raise InputError(
            f"{source}: {name} is {shown(value)}, but {count} is needed: "
            f"{_as_list(value, 1 if is_free else len(hints))}"
        )
    if not is_free and len(value) != len(hints):
        raise InputError(
            f"{source}: {name} is {shown(value)}, but {len(hints)} values are needed: give so many"
        )
    each = hints[:1] * len(value) if is_free else hints
    for place, (item, hint) in enumerate(zip(value, each, strict=True)):
        _refuse(item, hint, source, f"{name}[{place}]")


def _as_list(value: object, count: int) -> str:
    if isinstance(value, str | int | float):
        return f"write [{', '.join([str(value)[:LONGEST]] * count)}]"
    return "write its values in brackets, or leave the key out"


def _refuse_number(value: object, source: str, name: str, *, is_whole: bool) -> None:
    sort = "a whole number" if is_whole else "a number"
    if isinstance(value, bool):
        raise InputError(f"{source}: {name} is {value}, but {sort} is needed: write one")
    if is_whole:
        return  # a wrong type; no cast makes it right
    try:
        is_finite = math.isfinite(float(value))  # pyright: ignore[reportArgumentType]
    except (TypeError, ValueError):
        raise InputError(
            f"{source}: {name} is {shown(value)}, but {sort} is needed: write one"
        ) from None
    except OverflowError:
        is_finite = False
    if not is_finite:
        raise InputError(
            f"{source}: {name} is {shown(value)}, but a finite number is needed: write one, or "
            "leave the key out for the default"
        )


ConfigT = TypeVar("ConfigT")

_MAX_BYTES = 2**17
"""Largest config file: a hundred times the largest of ours."""


def read_config(path: Path, kind: type[ConfigT]) -> ConfigT:
    """Read a YAML file that holds the differences from the defaults of ``kind``.

    Raises:
        InputError: not YAML, an unknown key (its nearest name is said), or a value refused.
    """
    from depthpose.core.files import read_text  # here: options load without torch
    from depthpose.core.files.text import parse_yaml

    content = parse_yaml(path, read_text(path, _MAX_BYTES))
    if content is None:
        content = {}
    if not isinstance(content, Mapping):
        raise InputError(
            f"{path}: holds a {type(content).__name__}, but a config is a mapping of names to "
            "values, one 'name: value' a line."
        )
    content = _without_retired(content, kind)
    _refuse_unknown_keys(content, kind, str(path), prefix="")
    return config_from_dict(_over_defaults(content, kind), kind, source=str(path))


def config_from_dict(content: Mapping[Any, Any], kind: type[ConfigT], *, source: str) -> ConfigT:
    """Build the dataclass ``kind`` from a mapping; ``source`` names the mapping in errors.

    Raises:
        InputError: an unknown key, a wrong type, or a value that ``kind`` refuses.
    """
    content = _without_retired(content, kind)
    _refuse_unknown_keys(content, kind, source, prefix="")
    refuse_distorted(content, kind, source)
    try:
        return dacite.from_dict(kind, content, dacite.Config(cast=[tuple, float, Path]))
    except dacite.WrongTypeError as error:
        raise InputError(
            f"{source}: {error.field_path} is {shown(error.value)}, which is not of type "
            f"{error.field_type}. Give a value of that type."
        ) from error
    except (dacite.DaciteError, ValueError, TypeError, OverflowError, AttributeError) as error:
        raise InputError(f"{source}: {str(error)[:LONGEST]}") from error


def config_to_dict(config: object) -> dict[str, Any]:
    """Give every setting of a config with its value, nested, ready for YAML and JSON."""
    plain = dataclasses.asdict(config)  # pyright: ignore[reportArgumentType]
    return {name: _plain_value(value) for name, value in plain.items()}


def write_config(path: Path, config: object) -> None:
    """Write every setting of ``config``, defaults too, so that the file is a full record."""
    from depthpose.core.files import atomic_write  # here: options load without torch

    with atomic_write(path) as temporary:
        temporary.write_text(yaml.safe_dump(config_to_dict(config), sort_keys=False))


def _over_defaults(content: Mapping[Any, Any], kind: type) -> dict[str, Any]:
    """Merge nested differences into the defaults of ``kind``, which may differ from their class's.

    A setting given instead of another (``INSTEAD`` in its class) removes that one's default.
    """
    laid: dict[str, Any] = dict(content)
    for field in dataclasses.fields(kind):
        own = content.get(field.name)
        default = default_of(field)
        if isinstance(own, Mapping) and dataclasses.is_dataclass(default):
            rivals = getattr(type(default), "INSTEAD", {})
            left_out = {rivals[name] for name in own if name in rivals}
            kept = {k: v for k, v in config_to_dict(default).items() if k not in left_out}
            nested = _over_defaults(own, type(default))
            laid[field.name] = kept | nested
    return laid


def _without_retired(content: Mapping[Any, Any], kind: type) -> Mapping[Any, Any]:
    """Leave out settings of before that mean nothing any more (``RETIRED`` in their class)."""
    retired = getattr(kind, "RETIRED", ())
    return {name: value for name, value in content.items() if name not in retired}


def _plain_value(value: object) -> object:
    match value:
        case dict():
            return {name: _plain_value(item) for name, item in value.items()}
        case tuple() | list():
            return [_plain_value(item) for item in value]
        case Path():
            return str(value)
        case _:
            return value


def _refuse_unknown_keys(content: Mapping[Any, Any], kind: type, source: str, prefix: str) -> None:
    hints = get_type_hints(kind)
    known = [field.name for field in dataclasses.fields(kind)]
    for key, value in content.items():
        if key not in known:
            raise InputError(
                f"{source}: unknown key {shown(prefix + str(key))}; "
                f"{nearest_name(str(key)[:LONGEST], known)}"
            )
        nested = dataclass_in(hints[key])
        if nested is not None and isinstance(value, Mapping):
            _refuse_unknown_keys(value, nested, source, f"{prefix}{key}.")
