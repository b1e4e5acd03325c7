"""Depth as one ONNX graph, the estimator's own steps included, and the proof that it agrees."""

from depthpose.depth.export.proof import What as What
from depthpose.depth.export.proof import depth_export as depth_export
