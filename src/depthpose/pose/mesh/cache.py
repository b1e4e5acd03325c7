"""Values of a shape that take long to compute, kept on the disk."""

from collections.abc import Callable
from contextlib import suppress
from functools import lru_cache
from hashlib import sha256
from pathlib import Path
from typing import Any

from depthpose.core.errors import InputError
from depthpose.core.files import cache_folder, read_json, write_json
from depthpose.pose.types import ObjectModel


@lru_cache(maxsize=64)
def cached(model: ObjectModel, compute: Callable[..., Any], name: str, *settings: float) -> Any:  # noqa: ANN401
    """Compute ``compute(model, *settings)``, JSON values that take long, or read them from a cache.

    The cache is ``$DEPTHPOSE_CACHE``, where that can be written to. Its key is made of the bytes of
    the shape and its symmetries, and of the code that computes.

    Args:
        model: the object.
        compute: the function.
        name: of the folder of its values in the cache.
        settings: further arguments.
    """
    # What the values depend on.
    symmetries = model.symmetries
    tensors = [model.vertices_m, model.faces]
    if symmetries.discrete is not None:
        tensors.append(symmetries.discrete.R)
    tensors += [axis.direction for axis in symmetries.continuous]
    digest = sha256(f"{symmetries.is_found}".encode())
    code = {*Path(__file__).parent.glob("*.py"), Path(compute.__code__.co_filename)}
    for path in sorted(code):
        digest.update(path.read_bytes())
    for tensor in tensors:
        digest.update(tensor.contiguous().numpy().tobytes())

    # Read, or computed and written.
    folder = "_".join(map(str, (name, *settings)))
    path = cache_folder() / folder / f"{digest.hexdigest()}.json"
    try:
        return read_json(path)
    except (InputError, OSError):
        value = compute(model, *settings)
        with suppress(InputError, OSError):
            write_json(path, value)
        return value
