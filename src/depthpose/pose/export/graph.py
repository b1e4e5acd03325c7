"""The sparse ResUNet in ONNX operators: gather, multiply, add."""

from typing import cast

import numpy as np
from torch import Tensor, nn

from depthpose.core.export import Graph, Value
from depthpose.pose.export.maps import KernelMaps
from depthpose.pose.network import ResUNet, fold_norms
from depthpose.pose.network.resunet import Block, ConvNorm
from depthpose.pose.sparse import SparseConv


def direction_graph(network: ResUNet) -> Graph:
    """Write what ``ResUNet.forward`` does, kernel maps and levels included.

    Inputs ``coordinates`` (voxels, 4; int64: cloud, x, y, z; each voxel once) and ``features``
    (voxels, ``config.inputs``; float32: the number 1 where there is one). Output ``directions``
    (voxels, classes, keypoints, components), not normalised, in the order of the voxels given.
    """
    config = network.config
    writer = _Writer(fold_norms(network.eval()))
    shape = ("voxels", config.classes, config.keypoints, config.components)
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
            nobody = np.zeros((1, inputs), np.float32)
            rows = self.maps.rows_met(conv.kernel, level_in, level_out)
            met = self.graph.op("Concat", x, nobody, axis=0).op("Gather", rows)
            x = met.op("Reshape", [-1, volume * inputs])
        out = x.op("MatMul", _array(conv.weight.flatten(0, 1)))
        return out if conv.bias is None else out + _array(conv.bias)


def _pairs(layers: nn.ModuleList, blocks: nn.ModuleList) -> list[tuple[ConvNorm, Block]]:
    return cast("list[tuple[ConvNorm, Block]]", list(zip(layers, blocks, strict=True)))


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().float().cpu().numpy()
