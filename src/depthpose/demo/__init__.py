"""The newcomer's first run: a made street, matched, measured against its exact truth, on a page."""

from depthpose.demo.page import DemoResult as DemoResult
from depthpose.demo.page import make_demo as make_demo
