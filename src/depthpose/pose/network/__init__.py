"""The sparse ResUNet: a partial cloud to directions from each point to the keypoints."""

from depthpose.pose.network.fold import fold_norms, unfold_norms
from depthpose.pose.network.published import (
    KIND,
    import_fcgf,
    network_of,
    read_network,
    resunet_from_published,
    write_network,
)
from depthpose.pose.network.resunet import ResUNet, ResUNetConfig

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
