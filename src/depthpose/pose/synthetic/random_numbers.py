"""Random numbers, indices and rotations, whose chance is a generator alone."""

import torch
from jaxtyping import Float64
from torch import Tensor


def uniform(generator: torch.Generator, low: float, high: float) -> float:
    """Draw a number from ``low`` to ``high``, all equally likely."""
    return low + (high - low) * float(torch.rand((), generator=generator))


def random_index(generator: torch.Generator, count: int) -> int:
    """Draw a whole number, 0 to count - 1, all equally likely."""
    return int(torch.randint(count, (), generator=generator))


def random_rotation(generator: torch.Generator) -> Float64[Tensor, "3 3"]:
    """Draw a rotation, all equally likely: a quaternion of four normal numbers, in float64."""
    q = torch.randn(4, generator=generator, dtype=torch.float64)
    w, x, y, z = (q / q.norm()).tolist()
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return torch.tensor(rows, dtype=torch.float64)
