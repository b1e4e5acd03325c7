"""Sparse convolution in torch operations, CPU and CUDA alike; small ones compiled by numba.

Conventions are MinkowskiEngine's (Choy et al., CVPR 2019), so that its published weights fit:
a coarser level holds ``floor(c / 2) * 2`` of the finer one's coordinates, the offsets of a kernel
run with x fastest, odd kernels are centred and even ones start at 0.
"""

from depthpose.pose.sparse.conv import conv
from depthpose.pose.sparse.kernel_map import CoordinateCache, KernelMap, kernel_offsets
from depthpose.pose.sparse.keys import COORDINATE_LIMIT, batch_coordinates
from depthpose.pose.sparse.layers import RowNorm, SparseConv, SparseConvTranspose, Voxels

__all__ = [
    "COORDINATE_LIMIT",
    "CoordinateCache",
    "KernelMap",
    "RowNorm",
    "SparseConv",
    "SparseConvTranspose",
    "Voxels",
    "batch_coordinates",
    "conv",
    "kernel_offsets",
]
