"""One image, or a rectified pair, to one depth estimate in metres."""

from depthpose.depth.estimator.net import AnyPicture as AnyPicture
from depthpose.depth.estimator.net import FakestereoNet as FakestereoNet
from depthpose.depth.estimator.pair import check_rectified_pair as check_rectified_pair
from depthpose.depth.estimator.transformers_pipeline import DepthPipeline as DepthPipeline
from depthpose.depth.estimator.transformers_pipeline import pipeline as pipeline
