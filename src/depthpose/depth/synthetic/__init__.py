"""Synthetic streets and near scenes with exact disparity: training data that costs nothing."""

from depthpose.depth.synthetic.dataset import CAMERA_FROM_VELODYNE as CAMERA_FROM_VELODYNE
from depthpose.depth.synthetic.dataset import StreetFrame as StreetFrame
from depthpose.depth.synthetic.dataset import Streets as Streets
from depthpose.depth.synthetic.dataset import draw_scene as draw_scene
from depthpose.depth.synthetic.dataset import draw_street as draw_street
from depthpose.depth.synthetic.near import NearScene as NearScene
from depthpose.depth.synthetic.near import draw_near as draw_near
from depthpose.depth.synthetic.near import make_near as make_near
from depthpose.depth.synthetic.scene import StreetScene as StreetScene
from depthpose.depth.synthetic.scene import kitti_rig as kitti_rig
from depthpose.depth.synthetic.scene import make_clutter as make_clutter
from depthpose.depth.synthetic.scene import make_scene as make_scene
from depthpose.depth.synthetic.scene import rig_number as rig_number
