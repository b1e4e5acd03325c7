"""Whether compiled functions are used, and how they are compiled."""

import inspect
import os
from collections.abc import Callable
from functools import cache
from importlib.util import find_spec
from typing import Any

_SWITCH = "DEPTHPOSE_COMPILED"
"""Environment variable; 0 keeps to torch."""


@cache
def is_compiled() -> bool:
    """Whether numba is there, and the user did not switch it off by ``DEPTHPOSE_COMPILED=0``."""
    return os.environ.get(_SWITCH, "1") != "0" and find_spec("numba") is not None


def compiled(function: Callable[..., Any]) -> Any:  # noqa: ANN401  numba's dispatcher
    """Compile a function when it is first called; what was compiled is kept on disk."""
    from numba import njit

    # Tests check annotations by wrapping every function: numba wants what is inside.
    return njit(cache=True, nogil=True, error_model="numpy")(inspect.unwrap(function))
