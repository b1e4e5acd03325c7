"""The page of ``depthpose demo``: synthetic parts posed, a street and a real pair matched."""

from depthpose.demo.page import DemoResult as DemoResult
from depthpose.demo.page import make_demo as make_demo
