"""Made street scenes with exact disparity: the data that costs nothing and knows everything."""

from depthpose.depth.streets.clutter import make_clutter as make_clutter
from depthpose.depth.streets.dataset import Streets as Streets
from depthpose.depth.streets.frame import StreetFrame as StreetFrame
from depthpose.depth.streets.frame import draw_scene as draw_scene
from depthpose.depth.streets.frame import draw_street as draw_street
from depthpose.depth.streets.lidar import camera_from_velodyne as camera_from_velodyne
from depthpose.depth.streets.rigs import kitti_rig as kitti_rig
from depthpose.depth.streets.rigs import rig_number as rig_number
from depthpose.depth.streets.rigs import street_rig as street_rig
from depthpose.depth.streets.scene import StreetScene as StreetScene
from depthpose.depth.streets.scene import make_scene as make_scene
