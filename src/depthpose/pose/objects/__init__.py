"""Made views of known objects: partial clouds and depth windows, and whole frames."""

from depthpose.pose.objects.dataset import Objects as Objects
from depthpose.pose.objects.frames import make_frames as make_frames
from depthpose.pose.objects.parts import PARTS as PARTS
from depthpose.pose.objects.parts import make_part as make_part
from depthpose.pose.objects.parts import write_part as write_part
from depthpose.pose.objects.surface import drawn_triangles as drawn_triangles
from depthpose.pose.objects.surface import surfel_triangles as surfel_triangles
