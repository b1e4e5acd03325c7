"""Kernel maps in ONNX operators: which voxel each voxel meets, level by level.

The clouds' common box is laid out as a table of cells for each level; a cell holds the row of its
voxel, or one past the last row where it is empty. What a kernel meets is then one gather. All
tables count in cells of the finest level, so that one addition moves a voxel of any level.
"""

import numpy as np

from depthpose.core.export import Value
from depthpose.pose.sparse import kernel_offsets

LEVELS = 4
MARGIN = 1 << (LEVELS - 1)
"""Cells about the box: as far as a kernel of 3 looks on the coarsest level (of 7: 3 cells)."""


class KernelMaps:
    """Writes the maps of all levels into a graph, each once.

    Args:
        coordinates: (cloud, x, y, z) of each voxel, int64; distinct.
    """

    def __init__(self, coordinates: Value) -> None:
        self._graph = coordinates.graph
        edge = np.array([1, *[1 << (LEVELS - 1)] * 3])
        low = coordinates.op("ReduceMin", [0])
        # From a multiple of the coarsest step: coarse voxels are multiples of it in the whole grid.
        self._places = coordinates - (low - low % edge)
        sides = self._places.op("ReduceMax", [0], keepdims=0) + np.array([1, *[1 + 2 * MARGIN] * 3])
        y, z = (sides.slice([axis], [axis + 1], [0]) for axis in (2, 3))
        x = sides.slice([1], [2], [0])
        self._strides = self._graph.op("Concat", x * y * z, y * z, z, [1], axis=0)
        self._cells = sides.op("ReduceProd", [0], keepdims=1)
        self._standing = [self._cells_of(level) for level in range(LEVELS)]
        self._rows = [self._table(cells) for cells in self._standing]
        self._maps: dict[tuple[int, int, int], Value] = {}

    def rows_met(self, kernel: int, level_in: int, level_out: int) -> Value:
        """Give the row of ``level_in`` that each voxel of ``level_out`` meets at each offset.

        (voxels, kernel^3); one past the last row where there is none.
        """
        key = (kernel, level_in, level_out)
        if key not in self._maps:
            step = 1 << min(level_in, level_out)
            # Going down the kernel stands on the coarse voxel; going up, on what reads.
            step = -step if level_out < level_in else step
            offsets = np.array([(0, *offset) for offset in kernel_offsets(kernel)]) * step
            moves = self._graph.op("MatMul", offsets, self._strides)
            cells = self._standing[level_out].op("Unsqueeze", [1]) + moves
            self._maps[key] = self._rows[level_in].op("Gather", cells)
        return self._maps[key]

    def _cells_of(self, level: int) -> Value:
        """Cell of each voxel of a level; the finest keeps the order given."""
        corner = self._places - self._places % np.array([1, *[1 << level] * 3])
        cells = ((corner + np.array([0, *[MARGIN] * 3])) * self._strides).op(
            "ReduceSum", [1], keepdims=0
        )
        return cells if level == 0 else cells.op("Unique", sorted=1)

    def _table(self, cells: Value) -> Value:
        count = cells.op("Shape")
        empty = count.op("Expand", self._cells)
        numbers = self._graph.op("Range", 0, count.op("Squeeze"), 1)
        return empty.op("ScatterElements", cells, numbers, axis=0)
