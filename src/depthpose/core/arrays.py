"""Shape names, and the units and conventions they carry.

Everything that flows is a ``torch.Tensor``; only files know bytes. Batched forms put ``*batch`` in
front. Invalid values of a map are NaN in memory and in NPY files, and 0 in 16-bit PNG files.
"""

from jaxtyping import Bool, Float
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
