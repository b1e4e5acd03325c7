"""The sparse network as one ONNX graph, kernel maps included, and the proof that it agrees."""

from depthpose.pose.export.proof import pose_export as pose_export
