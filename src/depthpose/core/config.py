"""YAML to frozen dataclass and back. The dataclass has defaults, checks and help."""

import dataclasses
import json
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
        for name, (words, interval, notes) in _rules_of(type(self)).items():
            value = getattr(self, name)
            default = getattr(type(self), name, None)
            several = value if isinstance(value, tuple) else (value,)
            for single in (each for each in several if each is not None):
                if words and single not in words:
                    refuse_unknown(name, single, words)
                if interval:
                    low, high = (float(end) for end in interval[1:-1].split(", "))
                    is_above = single >= low if interval[0] == "[" else single > low
                    is_below = single <= high if interval[-1] == "]" else single < high
                    if not (is_above and is_below):
                        remedy = "" if default is None else f"; the default is {default}"
                        raise InputError(
                            f"{name} must be in {interval}, got {value!r:.{_LONGEST}}{remedy}"
                        )
            if ASCENDING in notes and value is not None and value[0] > value[1]:
                raise InputError(
                    f"{name} must be a range, the lower end first, got {value}; turn it"
                )
            steps = [step for step in notes if step != ASCENDING]
            if any(value % step for step in steps):
                raise InputError(
                    f"{name} must be a multiple of {steps[0]}, got {value}; take {default}"
                )


@cache
def _rules_of(kind: type) -> dict[str, tuple[tuple[Any, ...], str, tuple[Any, ...]]]:
    """Give the allowed words, the interval and the notes of each setting, from its type."""
    rules: dict[str, tuple[tuple[Any, ...], str, tuple[Any, ...]]] = {}
    for name, hint in get_type_hints(kind, include_extras=True).items():
        is_annotated = get_origin(hint) is Annotated
        interval, *notes = hint.__metadata__ if is_annotated else ("",)
        plain = get_args(hint)[0] if is_annotated else hint
        choices = (choice for choice in (plain, *get_args(plain)) if get_origin(choice) is Literal)
        words = get_args(next(choices, None))
        if not all(isinstance(word, str) for word in words):
            words = ()
        if words or interval or notes:
            rules[name] = words, interval, tuple(notes)
    return rules


def read_config(path: Path, kind: type[ConfigT]) -> ConfigT:
    """Read a YAML file that holds the differences from the defaults of ``kind``.

    Raises:
        InputError: not YAML, an unknown key (its nearest name is said), or a value refused.
    """
    from depthpose.core.files import read_text  # here: options load without torch
    from depthpose.core.files.disk import parse_yaml

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
    merged = dict(content)
    for field in dataclasses.fields(kind):
        nested = content.get(field.name)
        make = field.default_factory
        default = field.default if make is dataclasses.MISSING else make()
        if isinstance(nested, Mapping) and dataclasses.is_dataclass(default):
            rivals = getattr(default, "INSTEAD", {})  # given, it removes the other's default
            left_out = {rivals[key] for key in nested if key in rivals}
            defaults = {k: v for k, v in config_to_dict(default).items() if k not in left_out}
            merged[field.name] = defaults | _over_defaults(nested, type(default))
    return merged


def config_from_dict(
    content: Mapping[Any, Any], kind: type[ConfigT], *, source: str, prefix: str = ""
) -> ConfigT:
    """Build the dataclass ``kind`` from a mapping.

    Args:
        content: settings by name; what is left out has its default.
        kind: a dataclass.
        source: names the mapping in errors.
        prefix: begins the names of its settings there.

    Raises:
        InputError: an unknown key, a wrong type, or a value that ``kind`` refuses.
    """
    assert dataclasses.is_dataclass(kind)
    hints = get_type_hints(kind)
    defaults = {field.name: field.default for field in dataclasses.fields(kind)}
    values: dict[str, Any] = {}
    for key, value in content.items():
        if key not in defaults:
            raise InputError(
                f"{source}: unknown key {prefix + str(key)!r:.{_LONGEST}}; "
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


def _value_of(value: Any, hint: Any, source: str, name: str) -> Any:  # noqa: ANN401, C901, PLR0911, PLR0912
    """Convert a value to the type of a setting; only lossless conversions are done."""
    origin = get_origin(hint)
    parts = get_args(hint)
    if origin in (Union, types.UnionType):
        if value is None and type(None) in parts:
            return None
        *others, last = (part for part in parts if part is not type(None))
        for other in others:
            with suppress(InputError):
                return _value_of(value, other, source, name)
        return _value_of(value, last, source, name)
    context = f"{source}: {name} is {value!r:.{_LONGEST}}"
    if origin in (tuple, list):
        is_free = origin is list or parts[-1] is Ellipsis
        times = 1 if is_free else len(parts)
        if not isinstance(value, list | tuple):
            count = "a list" if is_free else f"a list of {times} values"
            remedy = "write its values in brackets, or leave the key out"
            if isinstance(value, str | int | float):
                remedy = f"write [{', '.join([str(value)[:_LONGEST]] * times)}]"
            raise InputError(f"{context}, but {count} is needed: {remedy}")
        if not is_free and len(value) != times:
            raise InputError(f"{context}, but {times} values are needed: give so many")
        pairs = zip(value, parts[:1] * len(value) if is_free else parts, strict=True)
        items = [_value_of(v, part, source, f"{name}[{k}]") for k, (v, part) in enumerate(pairs)]
        return items if origin is list else tuple(items)
    if origin is dict and isinstance(value, Mapping):
        return {k: _value_of(item, parts[1], source, f"{name}.{k}") for k, item in value.items()}
    if origin is Literal and value in parts:
        return value
    if dataclasses.is_dataclass(hint) and isinstance(value, Mapping):
        assert isinstance(hint, type)
        return config_from_dict(value, hint, source=source, prefix=f"{name}.")
    if hint is float:
        what = "finite number is needed: write one, or leave the key out for the default"
        try:
            number = float("none" if isinstance(value, bool) else value)
        except OverflowError:
            number = math.inf
        except (TypeError, ValueError):
            number = math.nan
            what = "number is needed: write one"
        if not math.isfinite(number):
            raise InputError(f"{context}, but a {what}")
        return number
    if hint is int and isinstance(value, bool):
        raise InputError(f"{context}, but a whole number is needed: write one")
    if hint is Path and isinstance(value, str):
        return Path(value)
    if isinstance(hint, type) and isinstance(value, hint):
        return value
    raise InputError(f"{context}, which is not of type {hint}. Give a value of that type.")


def config_to_dict(config: object) -> dict[str, Any]:
    """Give every setting of a config with its value, nested, ready for YAML and JSON."""
    return json.loads(json.dumps(dataclasses.asdict(config), default=str))  # pyright: ignore[reportArgumentType]


def write_config(path: Path, config: object) -> None:
    """Write every setting of ``config``, defaults too, so that the file is a full record."""
    from depthpose.core.files import atomic_write  # here: options load without torch

    with atomic_write(path) as temporary:
        temporary.write_text(yaml.safe_dump(config_to_dict(config), sort_keys=False))
