"""Sparse convolution in torch operations, CPU and CUDA alike; small ones compiled by numba.

Conventions are MinkowskiEngine's (Choy et al., CVPR 2019), so that its published weights fit:
a coarser level holds ``floor(c / 2) * 2`` of the finer one's coordinates, the offsets of a kernel
run with x fastest, odd kernels are centred and even ones start at 0.
"""

from depthpose.pose.sparse.conv import RowNorm as RowNorm
from depthpose.pose.sparse.conv import SparseConv as SparseConv
from depthpose.pose.sparse.conv import SparseConvTranspose as SparseConvTranspose
from depthpose.pose.sparse.conv import Voxels as Voxels
from depthpose.pose.sparse.conv import conv as conv
from depthpose.pose.sparse.kernel_map import COORDINATE_LIMIT as COORDINATE_LIMIT
from depthpose.pose.sparse.kernel_map import CoordinateCache as CoordinateCache
from depthpose.pose.sparse.kernel_map import KernelMap as KernelMap
from depthpose.pose.sparse.kernel_map import batch_coordinates as batch_coordinates
from depthpose.pose.sparse.kernel_map import kernel_offsets as kernel_offsets
