"""All levels and kernel maps of one set of voxels, each made once."""

from torch import Tensor

from depthpose.pose.sparse.kernel_map import KernelMap, Meetings, kernel_offsets
from depthpose.pose.sparse.keys import REACH, Keys, coarsen, unpack
from depthpose.pose.sparse.search import MARGIN, VoxelIndex, reach_beyond


class CoordinateCache:
    """Sorted keys of every level, and the meetings of every kernel that was asked for.

    Level ``l`` holds coordinates that are multiples of ``2**l``. A transposed convolution lands on
    the stored coordinates of the finer level, never on new ones.
    """

    def __init__(self, keys: Keys) -> None:
        """Begin with the sorted, distinct keys of level 0."""
        self._keys = {0: keys}
        self._indices: dict[int, VoxelIndex] = {}
        self._meetings: dict[tuple[int, int, int], Meetings] = {}

    def keys(self, level: int) -> Keys:
        """Give the sorted keys of a level."""
        if level not in self._keys:
            self._keys[level] = coarsen(self.keys(level - 1), 2**level)
        return self._keys[level]

    def coordinates(self, level: int) -> Tensor:
        """Give (cloud, x, y, z) of each voxel of a level, in voxels of level 0."""
        return unpack(self.keys(level))

    def kernel_map(
        self, level: int, kernel: int, stride: int = 1, *, is_transposed: bool = False
    ) -> KernelMap:
        """Find what a convolution reads and writes.

        Args:
            level: the level that it reads.
            kernel: its size: 1, 3, 5 or 7 (3 at most with stride 4); with a stride 2 and 4 too.
            stride: a power of two; with 1 it writes the level that it reads.
            is_transposed: True writes a finer level, False a coarser one.
        """
        assert stride & (stride - 1) == 0, f"stride must be a power of two, got {stride}"
        assert kernel % 2 or stride > 1, "an even kernel has no centre: it needs a stride"
        reach = reach_beyond(kernel, stride)
        assert reach <= MARGIN, f"kernel {kernel} with stride {stride} looks {reach} cells beyond"
        levels = stride.bit_length() - 1
        fine = level - levels if is_transposed else level
        assert fine >= 0, f"level {level} has no level {levels} finer"
        key = (fine, kernel, levels)
        if key not in self._meetings:
            self._meetings[key] = self._meet(*key)
        return KernelMap(meetings=self._meetings[key], is_transposed=is_transposed)

    def _meet(self, fine: int, kernel: int, levels: int) -> Meetings:
        assert kernel * 2**fine <= REACH, f"kernel {kernel} at level {fine} reaches too far"
        if fine not in self._indices:
            self._indices[fine] = VoxelIndex(self.keys(fine), 2**fine)
        table = self._indices[fine].find(self.keys(fine + levels), kernel_offsets(kernel))
        centre = None if levels else kernel**3 // 2
        return Meetings(table=table, fine_rows=len(self.keys(fine)), centre=centre)
