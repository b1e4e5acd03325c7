"""The decorator of loops that numba compiles, :func:`compiled`, and vectors for such loops.

Clouds have hundreds of points, for which most of the time of an operation of NumPy or torch is
that of its call. A compiled loop has no such calls.
"""

import inspect
from collections.abc import Callable
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import Any, ParamSpec, TypeVar, cast

import numpy as np
from torch import Tensor

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


def compiled(loop: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Decorate a function of numbers and arrays: numba compiles it when it is first called.

    It may call other compiled functions. Arrays must be contiguous, on the CPU, and an index is not
    checked: one beyond the end reads what lies there. What was compiled is kept on disk until the
    file of the function, or of one that it calls, changes. Decorating alone imports no numba.
    """
    return cast(Callable[Arguments, Result], _Compiled(loop))


class _Compiled:
    """A function that numba compiles at the first call; only then numba is imported."""

    def __init__(self, loop: Callable[..., Any]) -> None:
        # Where annotations are checked every function is wrapped: numba takes what is inside.
        self.loop = inspect.unwrap(loop)
        self.__doc__ = loop.__doc__

    def __call__(self, *arguments: object) -> Any:  # noqa: ANN401  what the loop returns
        return self._dispatcher(*arguments)

    @property
    def _numba_type_(self) -> Any:  # noqa: ANN401  of numba
        """The type of this function, which numba asks for where another loop calls it."""
        return self._dispatcher._numba_type_

    @cached_property
    def _dispatcher(self) -> Any:  # noqa: ANN401  of numba
        """Numba's function, which compiles the loop for each set of argument types."""
        from numba import njit

        # numba keeps compiled code by a function's name until its own file changes. The code holds
        # the functions that it calls too, so a hash of their files is added to the name.
        digest = sha256()
        for file in sorted(_find_source_files(self.loop)):
            digest.update(Path(file).read_bytes())
        self.loop.__qualname__ = f"{self.loop.__name__}_{digest.hexdigest()[:16]}"
        try:
            return njit(cache=True, nogil=True, error_model="numpy")(self.loop)
        except RuntimeError:  # no folder that may be written to
            return njit(nogil=True, error_model="numpy")(self.loop)


def _find_source_files(loop: Callable[..., Any]) -> set[str]:
    """Find the files of a function and of all compiled functions that it calls."""
    files = {loop.__code__.co_filename}
    for name in loop.__code__.co_names:
        called = loop.__globals__.get(name)
        if isinstance(called, _Compiled):
            files |= _find_source_files(called.loop)
    return files


def array_of(tensor: Tensor) -> np.ndarray:
    """Convert a tensor of the CPU to a contiguous array for compiled loops, without its gradient.

    Raises:
        ValueError: a value is not finite.
    """
    array = np.ascontiguousarray(tensor.detach().numpy())
    if not np.isfinite(array).all():
        raise ValueError("values must be finite; leave out what is not")
    return array


# Vectors of three numbers, in compiled loops. They are tuples, and innermost functions take arrays
# one by one: to make an array of a row, or to take one out of a tuple, counts its references, which
# made ICP take three times the time.

Vector = tuple[float, float, float]


@compiled
def vector(array: np.ndarray, i: int | np.int64) -> Vector:
    """Take row ``i`` of an array (n, 3) as a vector."""
    return array[i, 0], array[i, 1], array[i, 2]


@compiled
def minus(a: Vector, b: Vector) -> Vector:
    """Compute ``a - b``."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@compiled
def dot(a: Vector, b: Vector) -> float:
    """Compute the inner product ``a . b``."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled
def cross(a: Vector, b: Vector) -> Vector:
    """Compute the cross product ``a x b``."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@compiled
def rotate(R: np.ndarray, a: Vector) -> Vector:
    """Rotate a vector: compute ``R a`` of a rotation matrix (3, 3)."""
    return dot(vector(R, 0), a), dot(vector(R, 1), a), dot(vector(R, 2), a)
