"""KITTI, Middlebury and plain folders of pairs: disk to samples, splits, the check of a folder."""

from depthpose.depth.datasets.check import check_dataset as check_dataset
from depthpose.depth.datasets.dataset import Dataset as Dataset
from depthpose.depth.datasets.dataset import Split as Split
from depthpose.depth.datasets.dataset import join_datasets as join_datasets
from depthpose.depth.datasets.dataset import open_dataset as open_dataset
from depthpose.depth.datasets.dataset import read_split as read_split
from depthpose.depth.datasets.dataset import read_true_depth as read_true_depth
from depthpose.depth.datasets.dataset import refuse_shared_frames as refuse_shared_frames
from depthpose.depth.datasets.frames import FramePaths as FramePaths
from depthpose.depth.datasets.frames import KittiCalibration as KittiCalibration
from depthpose.depth.datasets.frames import has_lidar as has_lidar
from depthpose.depth.datasets.frames import list_truth_kinds as list_truth_kinds
from depthpose.depth.datasets.frames import project_lidar as project_lidar
from depthpose.depth.datasets.frames import read_disparity as read_disparity
from depthpose.depth.datasets.frames import read_kitti_calibration as read_kitti_calibration
from depthpose.depth.datasets.frames import read_lidar_depth as read_lidar_depth
from depthpose.depth.datasets.packed import pack_frames as pack_frames
from depthpose.depth.datasets.writing import has_calibration as has_calibration
from depthpose.depth.datasets.writing import has_raw_frame as has_raw_frame
from depthpose.depth.datasets.writing import has_scene as has_scene
from depthpose.depth.datasets.writing import write_raw_frame as write_raw_frame
from depthpose.depth.datasets.writing import write_scene as write_scene
