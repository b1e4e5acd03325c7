"""BOP's layout and that of Linemod_preprocessed: read, write and check; detections."""

from depthpose.pose.datasets.dataset import BopDataset as BopDataset
from depthpose.pose.datasets.dataset import BopFrame as BopFrame
from depthpose.pose.datasets.dataset import BopObject as BopObject
from depthpose.pose.datasets.dataset import check_bop as check_bop
from depthpose.pose.datasets.dataset import open_bop as open_bop
from depthpose.pose.datasets.dataset import write_bop_models as write_bop_models
from depthpose.pose.datasets.dataset import write_bop_scene as write_bop_scene
from depthpose.pose.datasets.layouts import LAYOUTS as LAYOUTS
from depthpose.pose.datasets.layouts import BopTarget as BopTarget
from depthpose.pose.datasets.layouts import Instance as Instance
from depthpose.pose.datasets.layouts import Layout as Layout
from depthpose.pose.datasets.layouts import object_names as object_names
from depthpose.pose.datasets.layouts import read_targets as read_targets
from depthpose.pose.datasets.masks import Detection as Detection
from depthpose.pose.datasets.masks import decode_rle as decode_rle
from depthpose.pose.datasets.masks import encode_rle as encode_rle
from depthpose.pose.datasets.masks import number_objects as number_objects
from depthpose.pose.datasets.masks import one_mask as one_mask
from depthpose.pose.datasets.masks import read_detections as read_detections
from depthpose.pose.datasets.masks import read_labels as read_labels
from depthpose.pose.datasets.masks import read_mask as read_mask
from depthpose.pose.datasets.masks import write_detections as write_detections
