"""Export of the direction network to ONNX: its graph, and the cases that prove it right."""

from collections.abc import Iterator
from functools import partial
from typing import Any, cast

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from depthpose.core.config import config_to_dict
from depthpose.core.errors import InputError
from depthpose.core.export import Case, Export, Graph, Limit, Value
from depthpose.pose.mesh.models import sample_surface
from depthpose.pose.networks.kernel_map import list_offsets
from depthpose.pose.networks.resunet import ConvNorm, ResidualBlock, ResUNet, fold_norms
from depthpose.pose.networks.sparse import SparseConv, Voxels
from depthpose.pose.weights import PoseWeights

LEVELS = 4  #: of the network; a voxel of level ``l`` is ``2**l`` cells wide
MARGIN = 1 << (LEVELS - 1)  #: cells about the box that a kernel of 3 reads on the coarsest level


class GraphConvolutions:
    """Writes sparse convolutions of given voxels into a graph; the maps of kernels are shared."""

    def __init__(self, coordinates: Value) -> None:
        """Number the cells of a box about all voxels.

        Args:
            coordinates: (cloud, x, y, z) of each voxel, a value of the graph.
        """
        self._graph = coordinates.graph
        # From a multiple of the coarsest step: coarse voxels are multiples of it in the whole grid.
        coarsest = np.array([1, *[1 << (LEVELS - 1)] * 3])
        low = coordinates.op("ReduceMin", [0])
        self._places = coordinates - (low - low % coarsest)

        # The number of a cell is the sum of its place times the strides of the box.
        margins = np.array([1, *[1 + 2 * MARGIN] * 3])
        sides = self._places.op("ReduceMax", [0], keepdims=0) + margins
        x, y, z = (sides.slice([axis], [axis + 1], [0]) for axis in (1, 2, 3))
        self._strides = self._graph.op("Concat", x * y * z, y * z, z, [1], axis=0)
        cell_count = sides.op("ReduceProd", [0], keepdims=1)

        # Of each level: the cell of each voxel (voxels,), on the finest level in the order of the
        # points; and the row of the voxel in each cell (cells,), one past the last in empty cells.
        self._level_cells: list[Value] = []
        self._row_of_cell: list[Value] = []
        for level in range(LEVELS):
            step = np.array([1, *[1 << level] * 3])
            margin = np.array([0, *[MARGIN] * 3])
            corner = self._places - self._places % step
            products = (corner + margin) * self._strides
            cells = products.op("ReduceSum", [1], keepdims=0)
            cells = cells.op("Unique", sorted=1) if level else cells
            self._level_cells.append(cells)
            count = cells.op("Shape")
            rows = self._graph.op("Range", 0, count.op("Squeeze"), 1)
            empty = count.op("Expand", cell_count)
            self._row_of_cell.append(empty.op("ScatterElements", cells, rows, axis=0))
        # By (kernel, level in, level out): the row that each output voxel reads at each offset
        # (voxels out, kernel^3), one past the last where there is none.
        self._read_rows: dict[tuple[int, int, int], Value] = {}

    def convolve(
        self, layer: SparseConv | ConvNorm, x: Value, level_in: int, level_out: int
    ) -> Value:
        """Write the convolution of features of ``level_in`` to the voxels of ``level_out``.

        Args:
            layer: its weights; norms are folded.
            x: features (voxels in, channels), a value of the graph.
            level_in: 0 is the finest.
            level_out: the same level, or the one above or below.

        Returns:
            The features (voxels out, channels).
        """
        if isinstance(layer, ConvNorm):
            assert layer.norm is None, "norms are folded before a graph is written"
            layer = layer.conv
        volume, inputs, _ = layer.weight.shape
        if layer.kernel > 1:
            # The features that are read, (voxels out, kernel^3, inputs): 0 where there is no voxel.
            read_rows = self._find_read_rows(layer.kernel, level_in, level_out)
            empty = np.zeros((1, inputs), np.float32)
            padded = self._graph.op("Concat", x, empty, axis=0)
            read = padded.op("Gather", read_rows)
            x = read.op("Reshape", [-1, volume * inputs])
        out = x.op("MatMul", layer.weight.flatten(0, 1).detach().float().cpu().numpy())
        return out if layer.bias is None else out + layer.bias.detach().float().cpu().numpy()

    def _find_read_rows(self, kernel: int, level_in: int, level_out: int) -> Value:
        """Find the rows that each output voxel reads, (voxels out, kernel^3); once for each kernel.

        A pair of voxels has ``fine = coarse + offset * step``, with the step of the finer level. So
        going up, a fine voxel reads ``coarse = fine - offset * step``.
        """
        key = (kernel, level_in, level_out)
        if key not in self._read_rows:
            step = 1 << min(level_in, level_out)
            sign = -1 if level_out < level_in else 1
            offsets = np.array([(0, *offset) for offset in list_offsets(kernel)]) * sign * step
            cell_offsets = self._graph.op("MatMul", offsets, self._strides)  # (kernel^3,)
            cells = self._level_cells[level_out].op("Unsqueeze", [1]) + cell_offsets
            self._read_rows[key] = self._row_of_cell[level_in].op("Gather", cells)
        return self._read_rows[key]


def build_direction_graph(network: ResUNet) -> Graph:
    """Build the graph of ``ResUNet.forward``, kernel maps and levels included.

    Inputs ``coordinates`` (voxels, 4; int64: cloud, x, y, z; each voxel once) and ``features``
    (voxels, ``config.inputs``; float32: the number 1 where there is one). Output ``directions``
    (voxels, classes, keypoints, 3), not normalised, in the order of the voxels given.
    """
    net = fold_norms(network.eval())
    graph = Graph()
    coordinates = graph.input("coordinates", np.int64, ("voxels", 4))
    x = graph.input("features", np.float32, ("voxels", net.config.inputs))
    convolve = GraphConvolutions(coordinates).convolve

    # Down: each level convolves the finer one, and a residual block follows.
    downs = zip(net.down, net.down_blocks, strict=True)
    skips: list[Value] = []
    for level, (down, block) in enumerate(cast("Iterator[tuple[ConvNorm, ResidualBlock]]", downs)):
        x = convolve(down, x, max(level - 1, 0), level)
        branch = convolve(block.first, x, level, level).op("Relu")
        x = (convolve(block.second, branch, level, level) + x).op("Relu")
        skips.append(x)

    # Up: the same, and the features of the way down are added as channels.
    x = skips.pop()
    ups = zip(net.up, net.up_blocks, strict=True)
    for up, block in cast("Iterator[tuple[ConvNorm, ResidualBlock]]", ups):
        level = len(skips) - 1
        x = convolve(up, x, level + 1, level)
        branch = convolve(block.first, x, level, level).op("Relu")
        x = (convolve(block.second, branch, level, level) + x).op("Relu")
        x = graph.op("Concat", x, skips.pop(), axis=1)

    # The last layers, point by point.
    outputs = convolve(net.final, convolve(net.mix, x, 0, 0).op("Relu"), 0, 0)
    shape = ("voxels", net.config.classes, net.config.keypoints, 3)
    graph.output("directions", outputs.op("Reshape", [-1, *shape[1:]]), np.float32, shape)
    return graph


_POINT_COUNTS = ((1,), (150,), (1500,), (700, 40, 1100))
"""Points of each cloud of each test case, of which one a voxel is kept."""


def pose_export(weights: PoseWeights, facts: dict[str, Any]) -> Export:
    """Describe the export of the direction network of weights: graph, test cases and metadata.

    Args:
        weights: of a sparse network.
        facts: further metadata.

    Raises:
        InputError: the weights are of a baseline.
    """
    network = weights.network
    if not isinstance(network, ResUNet):
        raise InputError(
            f"these weights are of a baseline ({type(network).__name__}); what is exported is the "
            "sparse network: give weights of kind 'geoposenet'."
        )
    model_facts = {
        "cloud": config_to_dict(weights.cloud),
        "objects": [model.name for model in weights.models],
        "keypoints_m": [model.keypoints_m.tolist() for model in weights.models],
    }
    return Export(
        graph=partial(build_direction_graph, network),
        cases=partial(_make_cases, weights, network),
        limits={"directions": Limit(value=1e-4)},
        facts={
            **facts, **model_facts,
            "what": "voxels (cloud, x, y, z) and their features -> directions to keypoints",
        },
    )  # fmt: skip


def _make_cases(weights: PoseWeights, network: ResUNet) -> Iterator[Case]:
    """Yield voxels of surfaces, in one cloud and in several, with the outputs of the network."""
    for counts in _POINT_COUNTS:
        # Voxels of the objects' surfaces, in no order: rows (cloud, x, y, z).
        clouds: list[Tensor] = []
        for cloud, count in enumerate(counts):
            points_m, _ = sample_surface(weights.models[cloud % len(weights.models)], count)
            cells = torch.floor(points_m / weights.cloud.voxel_m).long().unique(dim=0)
            generator = torch.Generator().manual_seed(count)
            shuffled = cells[torch.randperm(len(cells), generator=generator)]
            clouds.append(F.pad(shuffled, (1, 0), value=cloud))
        coordinates = torch.cat(clouds)

        # Their features, and the outputs of the network.
        generator = torch.Generator().manual_seed(0)
        features = torch.ones(len(coordinates), network.config.inputs)
        if network.config.inputs > 1:
            features = torch.randn(features.shape, generator=generator)
        with torch.no_grad():
            directions = network(Voxels.from_points(coordinates, features))
        yield Case(
            name=f"voxels {len(coordinates)}, clouds {len(counts)}",
            inputs={"coordinates": coordinates.numpy(), "features": features.numpy()},
            expected={"directions": directions.numpy()},
        )
