"""Features on voxels, and sparse convolutions of them as modules."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int, Int64
from torch import Tensor, nn

from depthpose.core.errors import InputError
from depthpose.pose.sparse.conv import conv
from depthpose.pose.sparse.kernel_map import CoordinateCache
from depthpose.pose.sparse.keys import Keys, pack, unpack


@dataclass(frozen=True, kw_only=True, eq=False)
class Voxels:
    """Features of the voxels of one level, of one or several clouds.

    Rows are in the order of the level's sorted keys, so the order in which points were given
    changes no bit of any result; :meth:`at_points` answers in the order given.

    Attributes:
        features: one row a voxel.
        cache: coordinates of all levels, and the kernel maps among them.
        level: coordinates here are multiples of ``2**level``.
        row_of_point: row at level 0 of each point given.
    """

    features: Float[Tensor, "n c"]
    cache: CoordinateCache
    level: int = 0
    row_of_point: Int64[Tensor, " points"]

    @classmethod
    def from_points(
        cls,
        coordinates: Int[Tensor, "points 4"],
        features: Float[Tensor, "points c"] | None = None,
    ) -> "Voxels":
        """Make voxels from rows of (cloud, x, y, z).

        Args:
            coordinates: integers; clouds are numbered from 0, x, y, z may be negative.
            features: of each point; None: the number 1.

        Raises:
            InputError: coordinates out of range, or two points in one voxel.
        """
        if features is None:
            features = torch.ones(len(coordinates), 1, device=coordinates.device)
        given = pack(coordinates)
        keys, row_of_point, counts = torch.unique(given, return_inverse=True, return_counts=True)
        _refuse_duplicates(keys, counts)
        features = features[torch.argsort(given)]
        return cls(features=features, cache=CoordinateCache(keys), row_of_point=row_of_point)

    @property
    def coordinates(self) -> Int64[Tensor, "n 4"]:
        """(cloud, x, y, z) of each row, in voxels of level 0."""
        return self.cache.coordinates(self.level)

    def with_features(self, features: Float[Tensor, "m c2"], level: int | None = None) -> "Voxels":
        """Give other features of the same level, or of another one of the same voxels."""
        level = self.level if level is None else level
        assert len(features) == len(self.cache.keys(level)), "features and voxels differ in number"
        return Voxels(
            features=features, cache=self.cache, level=level, row_of_point=self.row_of_point
        )

    def at_points(self) -> Float[Tensor, "points c"]:
        """Features of the voxel of each point, in the order in which points were given."""
        assert self.level == 0, f"points lie in voxels of level 0, these are of level {self.level}"
        return self.features[self.row_of_point]


def _refuse_duplicates(keys: Keys, counts: Int64[Tensor, " n"]) -> None:
    repeated = counts > 1
    if bool(repeated.any()):
        cloud, *xyz = unpack(keys[repeated][:1])[0].tolist()
        raise InputError(
            f"{int((counts - 1).sum())} points share a voxel with another, the first at {xyz} of "
            f"cloud {cloud}; keep one point a voxel."
        )


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
