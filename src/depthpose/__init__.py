"""Metric depth from one camera, and the 6-DoF pose of a known object from a depth sensor."""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from depthpose.depth.estimator import FakestereoNet as FakestereoNet
    from depthpose.depth.estimator import pipeline as pipeline
    from depthpose.pose.network_pose import GeoPoseNet as GeoPoseNet
    from depthpose.pose.registration import Registration as Registration

__version__ = "0.1.0"
__all__ = ["FakestereoNet", "GeoPoseNet", "Registration", "__version__", "pipeline"]

_HOMES = {
    "FakestereoNet": "depthpose.depth.estimator",
    "GeoPoseNet": "depthpose.pose.network_pose",
    "Registration": "depthpose.pose.registration",
    "pipeline": "depthpose.depth.estimator",
}


def __getattr__(name: str) -> object:
    """Import an estimator when it is first asked for, so that importing depthpose costs nothing."""
    if name not in _HOMES:
        raise AttributeError(f"module 'depthpose' has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    """List the public names, which are imported when they are asked for."""
    return sorted(__all__)
