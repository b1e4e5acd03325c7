"""Export of the direction network to ONNX: a dense graph, and its proof."""

from collections.abc import Iterator
from functools import partial
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor, nn

from depthpose.core.config import config_to_dict
from depthpose.core.errors import InputError
from depthpose.core.export import Case, Export, Graph, Limit, Value
from depthpose.pose.mesh.models import sample_surface
from depthpose.pose.network import Block, ConvNorm, ResUNet, fold_norms
from depthpose.pose.sparse import SparseConv, Voxels, batch_coordinates, kernel_offsets
from depthpose.pose.weights import PoseWeights

LEVELS = 4
MARGIN = 1 << (LEVELS - 1)  #: cells about the box that a kernel of 3 reads on the coarsest level


class KernelMaps:
    """Writes the maps of all levels into a graph, each once."""

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
        self._level_cells: list[Value] = []
        for level in range(LEVELS):  # the cell of each voxel; the finest keeps the order given
            corner = self._places - self._places % np.array([1, *[1 << level] * 3])
            places = (corner + np.array([0, *[MARGIN] * 3])) * self._strides
            cells = places.op("ReduceSum", [1], keepdims=0)
            self._level_cells.append(cells.op("Unique", sorted=1) if level else cells)
        self._rows = [self._table(cells) for cells in self._level_cells]
        self._maps: dict[tuple[int, int, int], Value] = {}

    def neighbour_rows(self, kernel: int, level_in: int, level_out: int) -> Value:
        """Give rows of ``level_in`` at offsets (voxels, kernel^3); one past the last: none."""
        key = (kernel, level_in, level_out)
        if key not in self._maps:
            step = 1 << min(level_in, level_out)
            # Going down the kernel is centred on the coarse voxel; going up, on what reads.
            step = -step if level_out < level_in else step
            offsets = np.array([(0, *offset) for offset in kernel_offsets(kernel)]) * step
            moves = self._graph.op("MatMul", offsets, self._strides)
            cells = self._level_cells[level_out].op("Unsqueeze", [1]) + moves
            self._maps[key] = self._rows[level_in].op("Gather", cells)
        return self._maps[key]

    def _table(self, cells: Value) -> Value:
        count = cells.op("Shape")
        empty = count.op("Expand", self._cells)
        numbers = self._graph.op("Range", 0, count.op("Squeeze"), 1)
        return empty.op("ScatterElements", cells, numbers, axis=0)


def direction_graph(network: ResUNet) -> Graph:
    """Write what ``ResUNet.forward`` does, kernel maps and levels included.

    Inputs ``coordinates`` (voxels, 4; int64: cloud, x, y, z; each voxel once) and ``features``
    (voxels, ``config.inputs``; float32: the number 1 where there is one). Output ``directions``
    (voxels, classes, keypoints, 3), not normalised, in the order of the voxels given.
    """
    config = network.config
    writer = _Writer(fold_norms(network.eval()))
    shape = ("voxels", config.classes, config.keypoints, 3)
    writer.graph.output("directions", writer.directions(shape), np.float32, shape)
    return writer.graph


class _Writer:
    def __init__(self, network: ResUNet) -> None:
        self.network = network
        self.graph = Graph()
        coordinates = self.graph.input("coordinates", np.int64, ("voxels", 4))
        self.features = self.graph.input("features", np.float32, ("voxels", network.config.inputs))
        self.maps = KernelMaps(coordinates)

    def directions(self, shape: tuple[int | str, ...]) -> Value:
        """Go down and up again, as ``ResUNet`` does."""
        net, seen = self.network, list[Value]()
        x = self.features
        for level, (down, block) in enumerate(_pairs(net.down, net.down_blocks)):
            x = self._block(block, self._convolved(down, x, max(level - 1, 0), level), level)
            seen.append(x)
        x = seen.pop()
        for up, block in _pairs(net.up, net.up_blocks):
            level = len(seen) - 1
            x = self._block(block, self._convolved(up, x, level + 1, level), level)
            x = self.graph.op("Concat", x, seen.pop(), axis=1)
        outputs = self._conv(net.final, self._conv(net.mix, x, 0, 0).op("Relu"), 0, 0)
        return outputs.op("Reshape", [-1, *shape[1:]])

    def _block(self, block: Block, x: Value, level: int) -> Value:
        branch = self._convolved(block.first, x, level, level).op("Relu")
        return (self._convolved(block.second, branch, level, level) + x).op("Relu")

    def _convolved(self, layer: ConvNorm, x: Value, level_in: int, level_out: int) -> Value:
        assert layer.norm is None, "norms are folded before a graph is written"
        return self._conv(layer.conv, x, level_in, level_out)

    def _conv(self, conv: SparseConv, x: Value, level_in: int, level_out: int) -> Value:
        volume, inputs, _ = conv.weight.shape
        if conv.kernel > 1:
            empty = np.zeros((1, inputs), np.float32)
            rows = self.maps.neighbour_rows(conv.kernel, level_in, level_out)
            met = self.graph.op("Concat", x, empty, axis=0).op("Gather", rows)
            x = met.op("Reshape", [-1, volume * inputs])
        out = x.op("MatMul", _array(conv.weight.flatten(0, 1)))
        return out if conv.bias is None else out + _array(conv.bias)


def _pairs(layers: nn.ModuleList, blocks: nn.ModuleList) -> list[tuple[ConvNorm, Block]]:
    return cast("list[tuple[ConvNorm, Block]]", list(zip(layers, blocks, strict=True)))


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().float().cpu().numpy()


_POINTS = ((1,), (150,), (1500,), (700, 40, 1100))
"""Points of each cloud of a case, before one a voxel is kept."""


def pose_export(weights: PoseWeights, facts: dict[str, Any]) -> Export:
    """Describe what is exported of weights: the network of directions."""
    network = weights.network
    if not isinstance(network, ResUNet):
        raise InputError(
            f"these weights are of a baseline ({type(network).__name__}); what is exported is the "
            "sparse network: give weights of kind 'geoposenet'."
        )
    known = {
        "cloud": config_to_dict(weights.cloud),
        "objects": [model.name for model in weights.models],
        "keypoints_m": [model.keypoints_m.tolist() for model in weights.models],
    }
    return Export(
        graph=partial(direction_graph, network),
        cases=partial(_cases, weights, network),
        limits={"directions": Limit(value=1e-4)},
        facts={
            **facts, **known,
            "what": "voxels (cloud, x, y, z) and their features -> directions to keypoints",
        },
    )  # fmt: skip


def _cases(weights: PoseWeights, network: ResUNet) -> Iterator[Case]:
    for counts in _POINTS:
        coordinates = batch_coordinates(
            [_cells(weights, count, k) for k, count in enumerate(counts)]
        )
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


def _cells(weights: PoseWeights, count: int, k: int) -> Tensor:
    """Voxels of an object's surface, in no order."""
    points_m, _ = sample_surface(weights.models[k % len(weights.models)], count)
    cells = torch.floor(points_m / weights.cloud.voxel_m).long().unique(dim=0)
    return cells[torch.randperm(len(cells), generator=torch.Generator().manual_seed(count))]
