"""Synthetic streets and near scenes with exact disparity: training data that costs nothing."""

from depthpose.depth.synthetic.clutter import make_clutter as make_clutter
from depthpose.depth.synthetic.dataset import Streets as Streets
from depthpose.depth.synthetic.dataset import SyntheticFrame as SyntheticFrame
from depthpose.depth.synthetic.dataset import render_scene as render_scene
from depthpose.depth.synthetic.dataset import render_street as render_street
from depthpose.depth.synthetic.kitti_rigs import KITTI_RIG_COUNT as KITTI_RIG_COUNT
from depthpose.depth.synthetic.kitti_rigs import draw_rig_number as draw_rig_number
from depthpose.depth.synthetic.kitti_rigs import kitti_rig as kitti_rig
from depthpose.depth.synthetic.lidar import CAMERA_FROM_VELODYNE as CAMERA_FROM_VELODYNE
from depthpose.depth.synthetic.near import NearScene as NearScene
from depthpose.depth.synthetic.near import make_near as make_near
from depthpose.depth.synthetic.near import render_near as render_near
from depthpose.depth.synthetic.scene import SyntheticScene as SyntheticScene
from depthpose.depth.synthetic.street import make_street as make_street
