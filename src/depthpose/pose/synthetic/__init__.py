"""Synthetic views of known objects: partial clouds and depth windows, and whole frames."""

from depthpose.pose.synthetic.frames import make_frames as make_frames
from depthpose.pose.synthetic.parts import PARTS as PARTS
from depthpose.pose.synthetic.parts import make_part as make_part
from depthpose.pose.synthetic.views import Objects as Objects
from depthpose.pose.synthetic.views import occlude as occlude
from depthpose.pose.synthetic.views import simulate_depth as simulate_depth
