"""One partial cloud to one pose, or to a reasoned refusal."""

from depthpose.pose.estimator.base import Registration as Registration
from depthpose.pose.estimator.net import CloudDirections as CloudDirections
from depthpose.pose.estimator.net import DepthImageRegressor as DepthImageRegressor
from depthpose.pose.estimator.net import GeoPoseNet as GeoPoseNet
