"""Synthetic views of known objects: partial clouds and depth windows, and whole frames."""

from depthpose.pose.synthetic.depth_sensors import simulate_depth as simulate_depth
from depthpose.pose.synthetic.frames import make_frames as make_frames
from depthpose.pose.synthetic.occluders import occlude as occlude
from depthpose.pose.synthetic.parts import PARTS as PARTS
from depthpose.pose.synthetic.parts import make_part as make_part
from depthpose.pose.synthetic.views import SyntheticViews as SyntheticViews
