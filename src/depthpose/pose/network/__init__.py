"""The sparse ResUNet: a partial cloud to directions from each point to the keypoints."""

from depthpose.pose.network.config import ResUNetConfig
from depthpose.pose.network.fold import fold_norms, unfold_norms
from depthpose.pose.network.published import import_fcgf, resunet_from_published
from depthpose.pose.network.resunet import ResUNet
from depthpose.pose.network.weights import KIND, network_of, read_network, write_network

__all__ = [
    "KIND",
    "ResUNet",
    "ResUNetConfig",
    "fold_norms",
    "import_fcgf",
    "network_of",
    "read_network",
    "resunet_from_published",
    "unfold_norms",
    "write_network",
]
