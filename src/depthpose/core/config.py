"""YAML to frozen dataclass and back. The dataclass has defaults, checks and help."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

import dacite
import yaml

from depthpose.core.config_values import (
    LONGEST,
    dataclass_in,
    default_of,
    refuse_distorted,
    shown,
)
from depthpose.core.errors import InputError, nearest_name
from depthpose.core.files import atomic_write, read_text
from depthpose.core.files.text import parse_yaml

ConfigT = TypeVar("ConfigT")

_MAX_BYTES = 2**17
"""Of a config: a hundred times the largest of ours."""


def read_config(path: Path, kind: type[ConfigT]) -> ConfigT:
    """Read a YAML file that holds the differences from the defaults of ``kind``.

    Raises:
        InputError: not YAML, an unknown key (its nearest name is said), or a value refused.
    """
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
