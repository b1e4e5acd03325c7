"""Whether compiled functions are used, and how they are compiled."""

import inspect
import os
import warnings
from collections.abc import Callable
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from typing import Any

from depthpose.core.errors import Notice

_SWITCH = "DEPTHPOSE_COMPILED"
"""Environment variable; 0 keeps to torch."""


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


def compiled(function: Callable[..., Any]) -> Any:  # noqa: ANN401  numba's dispatcher
    """Compile a function when it is first called; what was compiled is kept on disk."""
    from numba import njit

    # Tests check annotations by wrapping every function: numba wants what is inside.
    return njit(cache=True, nogil=True, error_model="numpy")(inspect.unwrap(function))
