"""Depth as one ONNX graph, the estimator's own steps included, compared with PyTorch."""

from depthpose.depth.export.proof import TARGETS as TARGETS
from depthpose.depth.export.proof import depth_export as depth_export
