"""What the method is measured against: a depth image regressed, a PointNet, classical features."""

from depthpose.pose.baselines.config import DepthImageConfig as DepthImageConfig
from depthpose.pose.baselines.config import FpfhConfig as FpfhConfig
from depthpose.pose.baselines.config import PointNetConfig as PointNetConfig
from depthpose.pose.baselines.depth_image import DepthCrop as DepthCrop
from depthpose.pose.baselines.depth_image import DepthImageNet as DepthImageNet
from depthpose.pose.baselines.depth_image import cut_depth as cut_depth
from depthpose.pose.baselines.depth_image import poses_of as poses_of
from depthpose.pose.baselines.depth_image import rotation_from_6d as rotation_from_6d
from depthpose.pose.baselines.fpfh import FpfhEstimator as FpfhEstimator
from depthpose.pose.baselines.fpfh import FpfhRegistration as FpfhRegistration
from depthpose.pose.baselines.pointnet import PointNet as PointNet
