"""Random numbers of synthetic scenes: a generator for each purpose, and distributions."""

from enum import IntEnum

import numpy as np
from jaxtyping import Float64


class Stream(IntEnum):
    """What random numbers are for: the first number of a seed, so that no two purposes share any.

    A changed value changes every scene that was ever rendered.
    """

    TEXTURES = 5
    TREE = 11
    BUSH = 12
    HEDGE = 13
    VEHICLE = 21
    PEDESTRIAN = 31
    CYCLIST = 32
    LAMP = 41
    SIGN = 42
    TRAFFIC_LIGHT = 43
    SMALL_OBJECT = 44
    FENCE = 45
    STREET = 71
    RIG = 72
    CAMERAS = 73
    CLUTTER = 74
    IS_CLUTTER = 75
    NEAR_SCENE = 76
    NEAR_CAMERAS = 78
    DOTS = 79


def make_rng(stream: Stream, *seed: int) -> np.random.Generator:
    """Make the generator of random numbers for one purpose and a seed of any whole numbers."""
    return np.random.default_rng([int(stream), *seed])


def draw_log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """Draw a number between ``low`` and ``high`` whose logarithm is uniformly distributed."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def draw_rotation(rng: np.random.Generator) -> Float64[np.ndarray, "3 3"]:
    """Draw a uniformly distributed rotation."""
    # QR of a Gaussian matrix, with a positive diagonal of R, gives a uniform orthogonal Q.
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))

    # A reflection (determinant -1) becomes a rotation.
    return q * np.sign(np.linalg.det(q))
