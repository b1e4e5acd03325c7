"""Settings as frozen dataclasses: ranges in their types, and conversion from and to YAML."""

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

from depthpose.core.errors import InputError, refuse_unknown, suggest_name

ConfigT = TypeVar("ConfigT")
_LONGEST = 500  # letters of a value that an error shows
_MAX_BYTES = 2**17  # largest config file: a hundred times the largest that comes with depthpose


Seed = Annotated[int, "[0, 9223372036854775808)"]
"""Seed of a generator of random numbers, 63 bits."""
ASCENDING = "ascending"
"""Annotation of a setting of two numbers: a range, whose lower end comes first."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Rule:
    """The rule that a setting must keep to, as its type says."""

    choices: tuple[str, ...]  # the allowed words; none: any value
    interval: str  # such as "[16, inf)", for each number in the setting; "": any number
    multiples_of: tuple[Any, ...]  # the setting must be a multiple of each
    is_ascending: bool  # whether the first of two numbers may not exceed the second


class Settings:
    """Base of dataclasses of settings whose types say what is allowed.

    ``Annotated[int, "[16, inf)", 16]`` is an interval, and a number that the setting must be a
    multiple of. ``ASCENDING`` behind the interval says that the first of two numbers must not
    exceed the second. Of ``Literal`` the words are allowed. None keeps to every rule.

    Raises:
        InputError: a value breaks these rules.
    """

    def __post_init__(self) -> None:
        """Check every setting against the rule of its type."""
        for name, rule in _read_rules(type(self)).items():
            value = getattr(self, name)
            if value is None:
                continue
            default = getattr(type(self), name, None)
            _check_entries(name, value, rule, default)
            _check_order(name, value, rule)
            _check_multiple(name, value, rule, default)


def _check_entries(name: str, value: Any, rule: _Rule, default: Any) -> None:  # noqa: ANN401
    """Refuse a value that is no allowed word or lies outside of the interval.

    The rule applies to each entry of a tuple. ``default`` is named in the error, unless it is None.
    """
    entries = value if isinstance(value, tuple) else (value,)
    for entry in entries:
        if entry is None:
            continue
        if rule.choices and entry not in rule.choices:
            refuse_unknown(name, entry, rule.choices)
        if rule.interval and not _is_in_interval(entry, rule.interval):
            remedy = "" if default is None else f"; the default is {default}"
            raise InputError(
                f"{name} must be in {rule.interval}, got {value!r:.{_LONGEST}}{remedy}"
            )


def _check_order(name: str, value: Any, rule: _Rule) -> None:  # noqa: ANN401
    """Refuse a range whose lower end exceeds its upper end."""
    if rule.is_ascending and value[0] > value[1]:
        raise InputError(f"{name} must be a range, the lower end first, got {value}; swap the two")


def _check_multiple(name: str, value: Any, rule: _Rule, default: Any) -> None:  # noqa: ANN401
    """Refuse a number that is no multiple of each divisor; the error suggests one that is.

    It is the default, or where that is None the next larger multiple.
    """
    for divisor in rule.multiples_of:
        if value % divisor:
            suggested = math.ceil(value / divisor) * divisor if default is None else default
            raise InputError(
                f"{name} must be a multiple of {divisor}, got {value}; take {suggested}"
            )


def _is_in_interval(number: float, interval: str) -> bool:
    """Whether a number lies in an interval such as ``[16, inf)``: brackets include their end."""
    low, high = (float(end) for end in interval[1:-1].split(", "))
    is_above = number >= low if interval[0] == "[" else number > low
    is_below = number <= high if interval[-1] == "]" else number < high
    return is_above and is_below


@cache
def _read_rules(kind: type) -> dict[str, _Rule]:
    """Read the rules of a class of settings from its type hints, by the names of the settings."""
    rules: dict[str, _Rule] = {}
    for name, hint in get_type_hints(kind, include_extras=True).items():
        interval = ""
        notes: list[Any] = []
        plain = hint
        if get_origin(hint) is Annotated:
            interval, *notes = hint.__metadata__
            plain = get_args(hint)[0]

        # A Literal may be the type itself or a part of it, as in ``Literal["a", "b"] | None``.
        parts = (plain, *get_args(plain))
        literal = next((part for part in parts if get_origin(part) is Literal), None)
        choices = get_args(literal)
        if not all(isinstance(choice, str) for choice in choices):
            choices = ()
        if choices or interval or notes:
            rules[name] = _Rule(
                choices=choices,
                interval=interval,
                multiples_of=tuple(note for note in notes if note != ASCENDING),
                is_ascending=ASCENDING in notes,
            )
    return rules


def read_config(path: Path, kind: type[ConfigT]) -> ConfigT:
    """Read settings from a YAML file; those that it leaves out have their defaults.

    Args:
        path: the file.
        kind: the dataclass of the settings.

    Raises:
        InputError: the file is missing or no YAML, a key is unknown (the message suggests the
            nearest), or ``kind`` refuses a value.
    """
    # Imported here, so that the command line knows its options without loading torch.
    from depthpose.core.files import read_text
    from depthpose.core.files.disk import parse_yaml

    content = parse_yaml(path, read_text(path, _MAX_BYTES))
    if content is None:  # an empty file
        content = {}
    if not isinstance(content, Mapping):
        raise InputError(
            f"{path}: holds a {type(content).__name__}, but a config is a mapping of names to "
            "values, one 'name: value' a line."
        )
    return config_from_dict(_merge_nested_defaults(content, kind), kind, source=str(path))


def _merge_nested_defaults(content: Mapping[Any, Any], kind: type) -> dict[Any, Any]:
    """Fill in the nested settings that ``content`` leaves out, with the defaults of ``kind``.

    A field of ``kind`` that is a dataclass may have another default than that dataclass itself. If
    its class variable ``INSTEAD`` maps a setting in ``content`` to another one, the default of that
    other one is left out.
    """
    merged = dict(content)
    for field in dataclasses.fields(kind):
        differences = content.get(field.name)
        default = field.default
        if field.default_factory is not dataclasses.MISSING:
            default = field.default_factory()
        if not isinstance(differences, Mapping) or not dataclasses.is_dataclass(default):
            continue
        replaced_by = getattr(default, "INSTEAD", {})
        replaced = {replaced_by[key] for key in differences if key in replaced_by}
        defaults = config_to_dict(default)
        remaining = {key: value for key, value in defaults.items() if key not in replaced}
        merged[field.name] = remaining | _merge_nested_defaults(differences, type(default))
    return merged


def config_from_dict(
    content: Mapping[Any, Any], kind: type[ConfigT], *, source: str, prefix: str = ""
) -> ConfigT:
    """Build the dataclass ``kind`` from a mapping.

    Args:
        content: settings by name; those that are left out have their defaults.
        kind: the dataclass of the settings.
        source: what errors call the mapping, such as the path of its file.
        prefix: prefix of the settings' names in errors, such as ``loop.``.

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
                f"{suggest_name(str(key)[:_LONGEST], defaults)}"
            )
        # A default may be infinite, where no other number may.
        is_default = isinstance(value, float) and value == defaults[key]
        values[key] = value
        if not is_default:
            values[key] = _convert(value, hints[key], source, f"{prefix}{key}")
    try:
        return kind(**values)
    except (ValueError, TypeError, OverflowError, AttributeError) as error:
        raise InputError(f"{source}: {str(error)[:_LONGEST]}") from error


def _convert(value: Any, hint: Any, source: str, name: str) -> Any:  # noqa: ANN401, PLR0911
    """Convert a value from YAML or JSON to the type of a setting, where that loses nothing.

    Args:
        value: what the file holds.
        hint: type of the setting.
        source: what errors call the file.
        name: what errors call the setting.

    Raises:
        InputError: it cannot be converted without loss.
    """
    origin = get_origin(hint)
    shown = f"{source}: {name} is {value!r:.{_LONGEST}}"
    if origin in (Union, types.UnionType):
        return _convert_to_union(value, get_args(hint), source, name)
    if origin in (tuple, list):
        return _convert_to_sequence(value, hint, source, name)
    if origin is dict and isinstance(value, Mapping):
        _, value_hint = get_args(hint)
        return {k: _convert(v, value_hint, source, f"{name}.{k}") for k, v in value.items()}
    if origin is Literal and value in get_args(hint):
        return value
    if dataclasses.is_dataclass(hint) and isinstance(value, Mapping):
        assert isinstance(hint, type)
        return config_from_dict(value, hint, source=source, prefix=f"{name}.")
    if hint is float:
        return _convert_to_float(value, shown)
    if hint is int and isinstance(value, bool):
        raise InputError(f"{shown}, but a whole number is needed: write one")
    if hint is Path and isinstance(value, str):
        return Path(value)
    if isinstance(hint, type) and isinstance(value, hint):
        return value
    raise InputError(f"{shown}, which is not of type {hint}. Give a value of that type.")


def _convert_to_union(value: Any, hints: tuple[Any, ...], source: str, name: str) -> Any:  # noqa: ANN401
    """Convert a value to the first of several types that accepts it.

    Raises:
        InputError: none does; the message is that of the last type.
    """
    if value is None and type(None) in hints:
        return None
    *first_hints, last_hint = (hint for hint in hints if hint is not type(None))
    for hint in first_hints:
        with suppress(InputError):
            return _convert(value, hint, source, name)
    return _convert(value, last_hint, source, name)


def _convert_to_sequence(
    value: Any,  # noqa: ANN401
    hint: Any,  # noqa: ANN401
    source: str,
    name: str,
) -> list[Any] | tuple[Any, ...]:
    """Convert a value, entry by entry, to a list, or to a tuple of any or of a fixed length."""
    shown = f"{source}: {name} is {value!r:.{_LONGEST}}"
    is_list = get_origin(hint) is list
    entry_hints = get_args(hint)
    has_any_length = is_list or entry_hints[-1] is Ellipsis
    length = 1 if has_any_length else len(entry_hints)
    if not isinstance(value, list | tuple):
        needed = "a list" if has_any_length else f"a list of {length} values"
        remedy = "write its values in brackets, or leave the key out"
        if isinstance(value, str | int | float):
            repeated = ", ".join([str(value)[:_LONGEST]] * length)
            remedy = f"write [{repeated}]"
        raise InputError(f"{shown}, but {needed} is needed: {remedy}")
    if has_any_length:
        entry_hints = entry_hints[:1] * len(value)
    elif len(value) != length:
        raise InputError(f"{shown}, but {length} values are needed: give so many")
    entries = [
        _convert(entry, entry_hint, source, f"{name}[{index}]")
        for index, (entry, entry_hint) in enumerate(zip(value, entry_hints, strict=True))
    ]
    return entries if is_list else tuple(entries)


def _convert_to_float(value: Any, shown: str) -> float:  # noqa: ANN401
    """Convert a number, or text such as ``1e-4`` (no number in YAML 1.1), to a finite float.

    ``shown`` is the setting and its value, with which the error begins.
    """
    needed = "finite number is needed: write one, or leave the key out for the default"
    try:
        # A bool is refused like text: Python would convert True to 1.0.
        number = float("none" if isinstance(value, bool) else value)
    except OverflowError:
        number = math.inf
    except (TypeError, ValueError):
        number = math.nan
        needed = "number is needed: write one"
    if not math.isfinite(number):
        raise InputError(f"{shown}, but a {needed}")
    return number


def config_to_dict(config: object) -> dict[str, Any]:
    """Convert a config to nested mappings of every setting: tuples as lists, paths as text."""
    return json.loads(json.dumps(dataclasses.asdict(config), default=str))  # pyright: ignore[reportArgumentType]


def write_config(path: Path, config: object) -> None:
    """Write all settings as YAML, defaults too, so that the file is a full record."""
    from depthpose.core.files import atomic_write  # imported here as in read_config

    with atomic_write(path) as temporary:
        temporary.write_text(yaml.safe_dump(config_to_dict(config), sort_keys=False))
