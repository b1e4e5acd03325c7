"""Training of the direction network in the one loop: synthetic views, real frames, or both."""

from depthpose.pose.train.clouds import CloudBatch as CloudBatch
from depthpose.pose.train.clouds import TrainingCloud as TrainingCloud
from depthpose.pose.train.clouds import TrainingClouds as TrainingClouds
from depthpose.pose.train.clouds import read_models as read_models
from depthpose.pose.train.config import DepthImageTraining as DepthImageTraining
from depthpose.pose.train.config import FramesConfig as FramesConfig
from depthpose.pose.train.config import HeldOutConfig as HeldOutConfig
from depthpose.pose.train.config import ModelsConfig as ModelsConfig
from depthpose.pose.train.config import PointNetTraining as PointNetTraining
from depthpose.pose.train.config import PoseTraining as PoseTraining
from depthpose.pose.train.config import SegmentationTraining as SegmentationTraining
from depthpose.pose.train.masks import train_segmentation
from depthpose.pose.train.poses import PoseTask as PoseTask
from depthpose.pose.train.poses import train_pose_network as train_pose_network

STAGES = {
    "pose": (PoseTraining, train_pose_network),
    "pointnet": (PointNetTraining, train_pose_network),
    "depth-image": (DepthImageTraining, train_pose_network),
    "segmentation": (SegmentationTraining, train_segmentation),
}
"""Config and function of each network, by its word on the command line."""
