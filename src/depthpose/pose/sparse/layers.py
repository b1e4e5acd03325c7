"""Sparse convolutions as modules."""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from depthpose.pose.sparse.conv import conv
from depthpose.pose.sparse.voxels import Voxels


class RowNorm(nn.BatchNorm1d):
    """Batch norm over rows (voxels, points, clouds), which takes a single one.

    One row has no variance; torch refuses it in training. Its running statistics serve instead.
    """

    def forward(self, input: Float[Tensor, "n c"]) -> Float[Tensor, "n c"]:
        """Normalise each channel over all rows."""
        if len(input) > 1:
            return super().forward(input)
        statistics = (self.running_mean, self.running_var)
        return F.batch_norm(input, *statistics, self.weight, self.bias, eps=self.eps)


class SparseConv(nn.Module):
    """Convolution on voxels; with a stride it writes the coarser level.

    ``weight`` is (kernel^3, inputs, outputs), its rows in the order of ``kernel_offsets``.
    """

    is_transposed = False

    def __init__(
        self, inputs: int, outputs: int, kernel: int = 3, stride: int = 1, *, has_bias: bool = False
    ) -> None:
        super().__init__()
        self.kernel, self.stride = kernel, stride
        self.weight = nn.Parameter(torch.empty(kernel**3, inputs, outputs))
        self.bias = nn.Parameter(torch.zeros(outputs)) if has_bias else None
        nn.init.normal_(self.weight, std=(2 / self.fan_in) ** 0.5)

    @property
    def fan_in(self) -> float:
        """Numbers that one output is summed from, on a surface.

        Voxels of a surface fill about 1.5 k^2 of a kernel's k^3 cells (counted: 13 to 14 of 27).
        Where it is transposed, each coarse voxel feeds about 4 fine ones.
        """
        taps = 1.5 * self.kernel**2 if self.kernel > 1 else 1.0
        if self.is_transposed:
            taps = max(1.0, taps / self.stride**2)
        return taps * self.weight.shape[1]

    def forward(self, voxels: Voxels) -> Voxels:
        """Convolve."""
        if self.kernel == 1 and self.stride == 1:
            return voxels.with_features(self._plus_bias(voxels.features @ self.weight[0]))
        levels = self.stride.bit_length() - 1
        level = voxels.level - levels if self.is_transposed else voxels.level + levels
        kernel_map = voxels.cache.kernel_map(
            voxels.level, self.kernel, self.stride, is_transposed=self.is_transposed
        )
        return voxels.with_features(
            self._plus_bias(conv(voxels.features, self.weight, kernel_map)), level
        )

    def _plus_bias(self, features: Tensor) -> Tensor:
        return features if self.bias is None else features + self.bias


class SparseConvTranspose(SparseConv):
    """Transposed convolution: back onto the stored voxels of the finer level."""

    is_transposed = True
