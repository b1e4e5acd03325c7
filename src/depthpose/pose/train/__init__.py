"""Training of the direction network in the one loop: synthetic views, real frames, or both."""

from depthpose.pose.train.clouds import Cloud as Cloud
from depthpose.pose.train.clouds import CloudBatch as CloudBatch
from depthpose.pose.train.clouds import TrainingClouds as TrainingClouds
from depthpose.pose.train.clouds import read_models as read_models
from depthpose.pose.train.config import FramesConfig as FramesConfig
from depthpose.pose.train.config import HeldOutConfig as HeldOutConfig
from depthpose.pose.train.config import ModelsConfig as ModelsConfig
from depthpose.pose.train.config import PoseTraining as PoseTraining
from depthpose.pose.train.held_out import HeldOut as HeldOut
from depthpose.pose.train.other_configs import DepthImageTraining as DepthImageTraining
from depthpose.pose.train.other_configs import PointNetTraining as PointNetTraining
from depthpose.pose.train.other_configs import (
    SegmentationTraining as SegmentationTraining,
)
from depthpose.pose.train.runs import STAGES as STAGES
from depthpose.pose.train.runs import train_pose as train_pose
from depthpose.pose.train.task import PoseTask as PoseTask
