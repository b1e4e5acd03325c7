"""Imports what commands import when they run; nothing else."""

from contextlib import suppress
from importlib import import_module

for name in (
    "cli", "core.engine", "core.export", "core.loop", "demo", "depth.datasets", "depth.estimator",
    "depth.evaluate", "depth.synthetic", "depth.train", "pose.datasets", "pose.estimator",
    "pose.evaluate", "pose.network_pose", "pose.registration", "pose.synthetic", "pose.train",
    "report.depth", "report.pose",
):  # fmt: skip
    import_module(f"depthpose.{name}")
for name in ("cv2", "onnxscript", "onnxruntime", "accelerate", "skimage", "tyro",
             "torch.utils.tensorboard", "torch.onnx", "torch._dynamo", "torch.distributed.tensor",
             "trimesh.exchange.load", "networkx", "tests.core.engine.doubles"):  # fmt: skip
    with suppress(ImportError):
        import_module(name)
