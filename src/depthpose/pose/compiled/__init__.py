"""Inner loops of a pose, compiled by numba where the extra ``fast`` is installed.

Each gives what the torch code beside it gives, to rounding, in a small part of the time: clouds
have hundreds of points, and most of torch's time is the overhead of its calls. The first call of
each function compiles it; what was compiled is kept on disk until a source changes.
"""

import inspect
import os
import warnings
from collections.abc import Callable
from functools import cache
from hashlib import sha256
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from depthpose.core.errors import Notice

SLACK = 0.1  #: sine of the angle by which a surface may face away and still count as visible
GRAZING = 0.1  #: sine of the angle between a ray and a plane below which they do not meet nearby
DISTANCES = 15  #: bins of the length of a point pair; the longest pair is in the last one
ANGLES = 15  #: bins of an angle of a point pair, from 0 to 180 degrees
TURNS = 30  #: bins of the rotation about the normal of the first point of a pair, 360 degrees
MOST_ALIKE = 150
"""Of the model's pairs with the same feature at most so many vote: all pairs of a plane are alike
and say little."""
_SWITCH = "DEPTHPOSE_COMPILED"  # environment variable; 0 keeps to torch


@cache
def is_compiled() -> bool:
    """Whether numba can be imported, and the user did not switch it off (``DEPTHPOSE_COMPILED=0``).

    Warns:
        Notice: numba is installed and cannot be imported, for instance beside a NumPy that is newer
            than it knows.
    """
    if os.environ.get(_SWITCH, "1") == "0" or find_spec("numba") is None:
        return False
    try:
        import_module("numba")
    except Exception as error:  # noqa: BLE001  whatever it is, torch computes the same
        warnings.warn(
            f"numba does not work here ({error}): poses are computed by torch, in two and a half "
            f"times the time. Install another version of it, or set {_SWITCH}=0.",
            Notice,
            stacklevel=2,
        )
        return False
    return True


def use_numba(*tensors: Tensor) -> bool:
    """Whether compiled functions serve for these: on the processor, and without gradients."""
    with_gradients = torch.is_grad_enabled() and any(t.requires_grad for t in tensors)
    return not with_gradients and all(t.device.type == "cpu" for t in tensors) and is_compiled()


def compiled(function: Callable[..., Any]) -> Any:  # noqa: ANN401  numba's dispatcher
    """Compile a function when it is first called; what was compiled is kept on disk."""
    from numba import njit

    # Tests check annotations by wrapping every function: numba wants what is inside.
    inner = inspect.unwrap(function)

    # A cache folder named by the contents of all source files: numba itself checks the file of a
    # function alone, and functions call those of other files.
    config: Any = import_module("numba").config
    before = config.CACHE_DIR
    folder = Path(__file__).parent
    digest = sha256()
    for path in sorted(folder.glob("*.py")):
        digest.update(path.read_bytes())
    config.CACHE_DIR = str(folder / "__pycache__" / f"numba-{digest.hexdigest()[:16]}")
    try:
        return njit(cache=True, nogil=True, error_model="numpy")(inner)
    except RuntimeError:  # no folder that may be written to
        return njit(nogil=True, error_model="numpy")(inner)
    finally:
        config.CACHE_DIR = before
