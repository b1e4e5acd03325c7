"""The sparse ResUNet: a partial cloud to directions from each point to the keypoints."""

from depthpose.pose.network.published import KIND as KIND
from depthpose.pose.network.published import import_fcgf as import_fcgf
from depthpose.pose.network.published import network_of as network_of
from depthpose.pose.network.published import read_network as read_network
from depthpose.pose.network.published import resunet_from_published as resunet_from_published
from depthpose.pose.network.published import write_network as write_network
from depthpose.pose.network.resunet import ResUNet as ResUNet
from depthpose.pose.network.resunet import ResUNetConfig as ResUNetConfig
from depthpose.pose.network.resunet import fold_norms as fold_norms
from depthpose.pose.network.resunet import unfold_norms as unfold_norms
