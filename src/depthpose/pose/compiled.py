"""Loops that numba compiles when they are first called: :func:`compiled`.

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

    It may call other compiled functions. Arrays are in the processor's memory, contiguous, and
    not checked: an index beyond the end reads what lies there. What was compiled is kept on disk
    until the file of a function, or of one that it calls, changes. Importing imports no numba.
    """
    return cast(Callable[Arguments, Result], _Compiled(loop))


class _Compiled:
    """A function that numba compiles, imported when first needed."""

    def __init__(self, loop: Callable[..., Any]) -> None:
        # Tests check annotations by wrapping every function: numba takes what is inside.
        self.loop = inspect.unwrap(loop)
        self.__doc__ = loop.__doc__

    def __call__(self, *arguments: object) -> Any:  # noqa: ANN401  what the loop returns
        return self._dispatcher(*arguments)

    @property
    def _numba_type_(self) -> Any:  # noqa: ANN401  of numba
        """The type by which numba knows this function where another loop calls it."""
        return self._dispatcher._numba_type_

    @cached_property
    def _dispatcher(self) -> Any:  # noqa: ANN401  of numba
        """The function of numba, which compiles the loop for each set of types."""
        from numba import njit

        # numba keeps compiled code by a function's name and until its file changes; the functions
        # that it calls are in the code too, so the name says of which files they are.
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
    """Give row ``i`` of an array (n, 3)."""
    return array[i, 0], array[i, 1], array[i, 2]


@compiled
def minus(a: Vector, b: Vector) -> Vector:
    """Subtract a vector from another one."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@compiled
def dot(a: Vector, b: Vector) -> float:
    """Give the inner product of two vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled
def cross(a: Vector, b: Vector) -> Vector:
    """Give the cross product of two vectors."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@compiled
def rotate(R: np.ndarray, a: Vector) -> Vector:
    """Rotate a vector: give ``R a``."""
    return dot(vector(R, 0), a), dot(vector(R, 1), a), dot(vector(R, 2), a)
