"""A test double of what the nodes use of ROS 2: no ROS, only what is said to it is written down.

It holds no transport: a test hands messages to the callback that a node has registered.
"""

import sys
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest


class Node:
    """Keeps parameters, publishers and warnings; ``given`` overrides parameters."""

    given: dict[str, Any] = {}  # noqa: RUF012

    def __init__(self, name: str) -> None:
        self.name = name
        self.parameters: dict[str, Any] = {}
        self.publishers_made: dict[str, SimpleNamespace] = {}
        self.warnings: list[str] = []
        self.errors: list[str] = []

    def declare_parameter(self, name: str, value: object) -> None:
        self.parameters[name] = self.given.get(name, value)

    def get_parameter(self, name: str) -> SimpleNamespace:
        return SimpleNamespace(value=self.parameters[name])

    def create_publisher(self, kind: type, topic: str, qos: object) -> SimpleNamespace:
        sent: list[Any] = []
        made = SimpleNamespace(kind=kind, qos=qos, sent=sent, publish=sent.append)
        self.publishers_made[topic] = made
        return made

    def create_service(self, kind: type, name: str, callback: Any) -> SimpleNamespace:  # noqa: ANN401
        self.services_made = {name: SimpleNamespace(kind=kind, call=callback)}
        return self.services_made[name]

    def get_logger(self) -> SimpleNamespace:
        return SimpleNamespace(
            warning=lambda said, **_: self.warnings.append(said), error=self.errors.append
        )

    def destroy_node(self) -> None:
        pass


class Subscriber:
    def __init__(self, node: Node, kind: type, topic: str, *, qos_profile: object) -> None:
        self.node, self.kind, self.topic, self.qos = node, kind, topic, qos_profile


class ApproximateTimeSynchronizer:
    def __init__(self, heard: list[Subscriber], queue: int, slop_s: float) -> None:
        assert slop_s > 0, "ROS's takes stamps that differ by less than the slop"
        self.heard, self.queue, self.slop_s = heard, queue, slop_s

    def registerCallback(self, callback: Any) -> None:  # noqa: ANN401, N802
        self.callback = callback


def message(*fields: str) -> type:
    """Make an empty message class; its fields are set from outside."""

    class Message(SimpleNamespace):
        def __init__(self) -> None:
            header = SimpleNamespace(stamp=SimpleNamespace(sec=0, nanosec=0), frame_id="")
            super().__init__(header=header, **{name: SimpleNamespace() for name in fields})

    return Message


def pose() -> SimpleNamespace:
    return SimpleNamespace(position=SimpleNamespace(), orientation=SimpleNamespace())


def pose_stamped() -> Any:  # noqa: ANN401
    made = message()()
    made.pose = pose()
    return made


def pose_with_covariance_stamped() -> Any:  # noqa: ANN401
    made = message()()
    made.pose = SimpleNamespace(pose=pose(), covariance=[])
    return made


def detection() -> Any:  # noqa: ANN401
    made = message()()
    made.bbox = SimpleNamespace(center=pose(), size=SimpleNamespace())
    made.results, made.id = [], ""
    return made


def hypothesis() -> SimpleNamespace:
    posed = SimpleNamespace(pose=pose(), covariance=[])
    return SimpleNamespace(hypothesis=SimpleNamespace(), pose=posed)


def install(monkeypatch: pytest.MonkeyPatch, **parameters: object) -> None:
    """Let ``import rclpy`` and its like find the double."""
    monkeypatch.setattr(Node, "given", parameters)
    modules = {
        "rclpy": {},
        "rclpy.node": {"Node": Node},
        "rclpy.qos": {
            "QoSProfile": SimpleNamespace,
            "ReliabilityPolicy": SimpleNamespace(BEST_EFFORT="best effort"),
        },
        "message_filters": {
            "Subscriber": Subscriber,
            "ApproximateTimeSynchronizer": ApproximateTimeSynchronizer,
        },
        "sensor_msgs": {},
        "sensor_msgs.msg": {"Image": message(), "CameraInfo": message()},
        "geometry_msgs": {},
        "geometry_msgs.msg": {
            "PoseStamped": pose_stamped,
            "PoseWithCovarianceStamped": pose_with_covariance_stamped,
        },
        "vision_msgs": {},
        "vision_msgs.msg": {
            "Detection3D": detection,
            "Detection3DArray": message("detections"),
            "ObjectHypothesisWithPose": hypothesis,
        },
        "depthpose_msgs": {},
        "depthpose_msgs.srv": {"FindObjects": SimpleNamespace},
    }
    for name, content in modules.items():
        module = ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.delitem(sys.modules, "depthpose_ros.nodes", raising=False)
