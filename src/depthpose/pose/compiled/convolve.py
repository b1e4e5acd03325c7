"""Sparse convolution of small clouds: no call for each offset, nothing gathered."""

import numpy as np
from torch import Tensor

from depthpose.pose.compiled import compiled


@compiled
def rows_of(keys, standing, moves):
    """Give the row of each key ``standing + move``, one past the last where there is none.

    Both lists ascend: it walks along them at once.
    """
    rows = np.empty((len(moves), len(standing)), np.int32)
    for k in range(len(moves)):
        row = 0
        for j in range(len(standing)):
            wanted = standing[j] + moves[k]
            while row < len(keys) and keys[row] < wanted:
                row += 1
            is_there = row < len(keys) and keys[row] == wanted
            rows[k, j] = row if is_there else len(keys)
    return rows


@compiled
def _add_row(out, row, weight):
    """``out += row @ weight``: four inputs at once, outputs along the vector unit."""
    inputs, outputs = weight.shape
    whole = inputs - inputs % 4
    for c in range(0, whole, 4):
        a, b, e, f = row[c], row[c + 1], row[c + 2], row[c + 3]
        wa, wb, we, wf = weight[c], weight[c + 1], weight[c + 2], weight[c + 3]
        for k in range(outputs):
            out[k] += a * wa[k] + b * wb[k] + e * we[k] + f * wf[k]
    for c in range(whole, inputs):
        a, wa = row[c], weight[c]
        for k in range(outputs):
            out[k] += a * wa[k]


def convolved(
    x: Tensor, weight: Tensor, table: Tensor, fine_rows: int, is_transposed: bool
) -> Tensor:
    """Convolve: ``out[o] = sum over neighbours (i, k) of o of x[i] @ weight[k]``."""
    coarse_rows = table.shape[1]
    read, written = (coarse_rows, fine_rows) if is_transposed else (fine_rows, coarse_rows)
    assert x.shape == (read, weight.shape[1]), "a row for each voxel, a channel for each weight"
    assert len(weight) == len(table), "a weight for each offset"
    out = x.new_zeros(written, weight.shape[2])
    x, weight, table = x.detach().contiguous(), weight.detach().contiguous(), table.contiguous()
    _convolve(x.numpy(), weight.numpy(), table.numpy(), is_transposed, out.numpy())
    return out


@compiled
def _convolve(x, weight, table, is_transposed, out):
    fine = len(out) if is_transposed else len(x)
    for k in range(len(table)):
        kernel = weight[k]
        for coarse in range(table.shape[1]):
            row = table[k, coarse]
            if row < fine:
                if is_transposed:
                    _add_row(out[row], x[coarse], kernel)
                else:
                    _add_row(out[coarse], x[row], kernel)
