"""What is computed of a model's shape once: kept in memory, and on disk for later processes."""

from collections import OrderedDict
from collections.abc import Callable
from contextlib import suppress
from functools import cache, lru_cache
from hashlib import sha256
from pathlib import Path
from typing import Any, TypeVar

from depthpose.core.errors import InputError
from depthpose.core.files import cache_folder, read_json, write_json
from depthpose.pose.types import ObjectModel

ValueT = TypeVar("ValueT")

_MOST = 128
"""Values in memory."""
_memory: OrderedDict[str, Any] = OrderedDict()


def kept(
    model: ObjectModel,
    name: str,
    compute: Callable[[ObjectModel], Any],
    decode: Callable[[Any], ValueT],
) -> ValueT:
    """Give a value of a model that takes long to compute.

    It is kept in ``$DEPTHPOSE_CACHE``, where that can be written to.

    Args:
        model: of which vertices, faces and symmetries count.
        name: of the value, and of its folder in the cache.
        compute: gives the value in a form that JSON has.
        decode: makes the value of that form; what it cannot read is computed again.
    """
    key = _key_of(model)
    place = f"{name}/{key}"
    if place not in _memory:
        _memory[place] = _on_disk(cache_folder() / name / f"{key}.json", model, compute, decode)
        while len(_memory) > _MOST:
            _memory.popitem(last=False)
    return _memory[place]


def _on_disk(
    path: Path,
    model: ObjectModel,
    compute: Callable[[ObjectModel], Any],
    decode: Callable[[Any], ValueT],
) -> ValueT:
    with suppress(InputError, OSError, KeyError, TypeError, ValueError, RuntimeError):
        return decode(read_json(path))
    found = compute(model)
    with suppress(InputError, OSError):
        write_json(path, found)
    return decode(found)


@lru_cache(maxsize=64)
def _key_of(model: ObjectModel) -> str:
    """Name a shape and its symmetries by their bytes, and by the code that computes."""
    symmetries = model.symmetries
    every = [model.vertices_m, model.faces]
    if symmetries.discrete is not None:
        every.append(symmetries.discrete.R)
    every += [axis.direction for axis in symmetries.continuous]
    digest = sha256(f"{symmetries.is_found} {_code()}".encode())
    for tensor in every:
        digest.update(tensor.contiguous().numpy().tobytes())
    return digest.hexdigest()


@cache
def _code() -> str:
    """Name the sources of this package."""
    digest = sha256()
    for path in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()
