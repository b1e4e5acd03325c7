"""Names and numbers of camera files in YAML, and in the YAML and XML of OpenCV (FileStorage)."""

import re
from collections.abc import Mapping
from typing import Any
from xml.etree import ElementTree

import numpy as np
import yaml

from depthpose.core.camera.facts import KNOWN_FILES
from depthpose.core.errors import InputError
from depthpose.core.files import AnyPath
from depthpose.core.files.disk import refused_as
from depthpose.core.files.text import YamlLoader, refuse_yaml_bomb

Names = dict[str, Any]
"""Values by name; names in small letters and digits alone, for everyone spells them otherwise."""

_YAML_HEAD = re.compile(r"\A\s*%YAML[^\n]*\n")
_DECLARATION = re.compile(r"<!(?!--)")
_MAX_TEXT = 2**18
"""Of YAML and XML: ten times the largest camera file."""


def read_storage(path: AnyPath, text: str) -> Names | None:
    """Parse YAML (OpenCV's kind too), or the XML of OpenCV; None where it is neither.

    Raises:
        InputError: it is damaged, or refers to something outside or to itself.
    """
    if len(text) > _MAX_TEXT:
        return None
    if text.lstrip().startswith("<"):
        return _read_xml(path, text)
    body = _YAML_HEAD.sub("", text)
    with refused_as(path, "camera file", f"correct it there; known are {KNOWN_FILES}"):
        refuse_yaml_bomb(path, body)
        loader = _Loader(body)
        content = loader.get_data() if loader.check_data() else None
    return named(content) if isinstance(content, Mapping) else None


def named(content: Mapping[Any, Any]) -> Names:
    """Normalise the names of a file: lower case, letters and digits only."""
    return {re.sub(r"[^a-z0-9]", "", str(key).lower()): value for key, value in content.items()}


def matrix(names: Names, known: tuple[str, ...], count: int) -> np.ndarray | None:
    """Take the first matrix of ``count`` numbers among some names, in rows."""
    for name in known:
        found = numbers(names.get(name))
        if found is not None and len(found) == count:
            return np.array(found).reshape(count // (4 if count > 9 else 3), -1)
    return None


def scalar(names: Names, name: str) -> float | None:
    """Take one number."""
    found = numbers(names.get(name))
    return None if found is None or len(found) != 1 else found[0]


def numbers(value: object) -> list[float] | None:
    """Take the numbers of a matrix, a list of lists, a list, text or one number; else None."""
    words: Any = value.get("data") if isinstance(value, Mapping) else value
    if isinstance(words, list):
        words = [v for row in words for v in (row if isinstance(row, list) else [row])]
    else:
        words = words.split() if isinstance(words, str) else [words]
    try:
        found = [float(word) for word in words if not isinstance(word, bool)]
    except (TypeError, ValueError, OverflowError):
        return None
    if not np.isfinite(found).all():
        raise InputError("a matrix of it holds NaN or infinity; calibrate again")
    return found if found and len(found) == len(words) else None


class _Loader(YamlLoader):
    """Plain values, OpenCV's tags ignored."""


def _of_opencv(loader: Any, _suffix: str, node: yaml.Node) -> object:  # noqa: ANN401 - yaml's
    if isinstance(node, yaml.MappingNode):
        return loader.construct_mapping(node, deep=True)
    if isinstance(node, yaml.SequenceNode):
        return loader.construct_sequence(node, deep=True)
    return loader.construct_scalar(node)


_Loader.add_multi_constructor("tag:yaml.org,2002:opencv-", _of_opencv)


def _read_xml(path: AnyPath, text: str) -> Names | None:
    if _DECLARATION.search(text):
        raise InputError(
            f"{path}: XML with declarations (<!...>), which no camera needs; drop them"
        )
    with refused_as(path, "camera file", "correct it there"):
        root = ElementTree.fromstring(text)  # noqa: S314  entities are refused above
    if root.tag != "opencv_storage":
        return None
    return named({node.tag: {leaf.tag: leaf.text for leaf in node} or node.text for node in root})
