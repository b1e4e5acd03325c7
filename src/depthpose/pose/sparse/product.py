"""Matrix products in blocks of rows: through the faster of torch's two CPU libraries."""

import torch
from jaxtyping import Float
from torch import Tensor

BLOCK_PRODUCTS = 1 << 23
"""Multiplications in a block: fewer cost more calls, more fall out of the cache (measured)."""


def block_rows(x: Tensor, kernel: Tensor) -> int:
    """Rows to multiply at once; all of them where oneDNN does not serve.

    On an AMD processor oneDNN makes a convolution of 10,000 voxels 1.4 times as fast as MKL does,
    but it compiles code for each new shape, which takes milliseconds: blocks keep to one shape,
    and ragged ends go to MKL.
    """
    if not _has_onednn(x):
        return 1 << 62
    return max(1, BLOCK_PRODUCTS // kernel.numel())


def multiply(
    rows: Float[Tensor, "n inputs"], kernel: Float[Tensor, "inputs outputs"], block: int
) -> Float[Tensor, "n outputs"]:
    """Multiply up to ``block`` rows."""
    if len(rows) < block or not _has_onednn(rows):
        return torch.mm(rows, kernel)
    # The one name by which torch multiplies strided float32 through oneDNN is private to it.
    return torch.ops.mkldnn._linear_pointwise(rows, kernel.T, None, "none", [], "")


def add_product(out: Tensor, x: Tensor, kernel: Tensor) -> Tensor:
    """Add ``x @ kernel`` to ``out`` in place."""
    block = block_rows(x, kernel)
    for part, rows in zip(out.split(block), x.split(block), strict=True):
        if len(rows) < block:
            part.addmm_(rows, kernel)
        else:
            part.add_(multiply(rows, kernel, block))
    return out


def _has_onednn(x: Tensor) -> bool:
    is_usable = x.device.type == "cpu" and x.dtype == torch.float32
    return is_usable and torch.backends.mkldnn.is_available()
