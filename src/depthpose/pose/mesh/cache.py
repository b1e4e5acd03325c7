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

_POSE_FOLDER = Path(__file__).parents[1]
"""Folder of the code on which cached values may depend."""


@lru_cache(maxsize=64)
def read_or_compute(
    model: ObjectModel,
    compute: Callable[..., Any],
    name: str,
    *settings: float,
) -> Any:  # noqa: ANN401
    """Read ``compute(model, *settings)`` from the cache, or compute it and write it there.

    The cache is ``$DEPTHPOSE_CACHE``, where that can be written to. A file is named by the bytes of
    the shape, of its symmetries and of the code of poses.

    Args:
        model: the object.
        compute: a function that returns JSON values, and takes long.
        name: of the folder of its values in the cache.
        settings: further arguments of the function.

    Returns:
        What the function returns; as JSON holds it, a list for a tuple, where it was read.
    """
    # The digest of all that the values depend on.
    symmetries = model.symmetries
    tensors = [model.vertices_m, model.faces]
    if symmetries.discrete is not None:
        tensors += [symmetries.discrete.R, symmetries.discrete.t_m]
    for axis in symmetries.continuous:
        tensors += [axis.direction, axis.point_m]
    digest = sha256(f"{symmetries.is_found}".encode())
    for path in sorted(_POSE_FOLDER.rglob("*.py")):
        digest.update(path.read_bytes())
    for tensor in tensors:
        digest.update(tensor.contiguous().numpy().tobytes())

    name_with_settings = "_".join(map(str, (name, *settings)))
    path = cache_folder() / name_with_settings / f"{digest.hexdigest()}.json"
    try:
        return read_json(path)
    except (InputError, OSError):
        value = compute(model, *settings)
        with suppress(InputError, OSError):
            write_json(path, value)
        return value
