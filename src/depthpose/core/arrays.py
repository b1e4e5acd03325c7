"""Shape names, and the units and conventions they carry; rows taken at even steps.

Everything that flows is a ``torch.Tensor``; only files know bytes. Batched forms put ``*batch`` in
front. Invalid values of a map are NaN in memory and in NPY files, and 0 in 16-bit PNG files.
"""

import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

Image = Float[Tensor, "3 h w"]
"""RGB in [0, 1], float32."""

Map = Float[Tensor, "h w"]
"""One number a pixel; its unit stands in the variable's name (``_m``, ``_px``). NaN: invalid."""

Mask = Bool[Tensor, "h w"]
"""True where a pixel counts."""

Points = Float[Tensor, "n 3"]
"""Points of a cloud, in the frame and unit that the variable's name says."""

Matrix3 = Float[Tensor, "3 3"]
"""A 3x3 matrix: intrinsics ``K``, fundamental ``F``, essential ``E`` or a rotation ``R``."""


def take_evenly(rows: Shaped[Tensor, "n ..."], count: int) -> Shaped[Tensor, "m ..."]:
    """Take ``count`` rows at even steps, the first among them; all where there are no more."""
    if len(rows) <= count:
        return rows
    return rows[torch.arange(count, device=rows.device) * len(rows) // count]
