"""FCN: an image to the masks of known objects."""

from depthpose.pose.segmentation.network import FCN as FCN
from depthpose.pose.segmentation.network import KIND as KIND
from depthpose.pose.segmentation.network import SegmentationConfig as SegmentationConfig
from depthpose.pose.segmentation.network import SegmentationWeights as SegmentationWeights
from depthpose.pose.segmentation.network import read_segmentation as read_segmentation
from depthpose.pose.segmentation.network import write_segmentation as write_segmentation
from depthpose.pose.segmentation.segmenter import Overlap as Overlap
from depthpose.pose.segmentation.segmenter import Segmentation as Segmentation
from depthpose.pose.segmentation.segmenter import Segmenter as Segmenter
from depthpose.pose.segmentation.segmenter import class_probabilities as class_probabilities
from depthpose.pose.segmentation.segmenter import connected_parts as connected_parts
from depthpose.pose.segmentation.segmenter import label_parts as label_parts
from depthpose.pose.segmentation.segmenter import resize_image as resize_image
