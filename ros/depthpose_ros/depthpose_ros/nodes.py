"""The nodes: parameters, topics and threads around :mod:`depthpose_ros.work`."""

import math
from collections.abc import Callable
from typing import Any

import rclpy
from geometry_msgs.msg import PoseStamped
from message_filters import ApproximateTimeSynchronizer, Subscriber
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, Image

from depthpose import FakestereoNet, GeoPoseNet
from depthpose.core.errors import InputError
from depthpose.depth.config import MatcherConfig
from depthpose_ros import messages
from depthpose_ros.work import DepthFromImage, DepthFromPair, Latest, Poses

NEWEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Sensor data, and the last message alone."""
_QUEUE = 4


class WorkNode(Node):
    """Waits for messages of one time, processes the newest, and warns of input it cannot use."""

    def __init__(self, name: str, **parameters: object) -> None:
        super().__init__(name)
        for key, value in parameters.items():
            self.declare_parameter(key, value)
        self._latest: Latest | None = None

    def warn(self, said: str) -> None:
        """Log a warning, at most one in five seconds."""
        self.get_logger().warning(said, throttle_duration_sec=5.0)

    def value(self, name: str) -> Any:  # noqa: ANN401
        """Give a parameter."""
        return self.get_parameter(name).value

    def work_on(self, topics: dict[str, type], slop_s: float, work: Callable[..., None]) -> None:
        """Call ``work`` with messages of these topics whose stamps agree within ``slop_s``."""

        def guarded(*given: Any) -> None:  # noqa: ANN401
            try:
                work(*given)
            except InputError as error:
                self.warn(str(error))

        self._latest = Latest(guarded)
        heard = [
            Subscriber(self, kind, topic, qos_profile=NEWEST) for topic, kind in topics.items()
        ]
        both = ApproximateTimeSynchronizer(heard, _QUEUE, slop_s)
        both.registerCallback(self._latest.put)
        self._heard = both

    def destroy_node(self) -> None:
        """End the thread before the node is destroyed."""
        if self._latest is not None:
            self._latest.close()
        super().destroy_node()


class DepthImageNode(WorkNode):
    """``image_rect`` and ``camera_info`` to ``~/depth``."""

    def __init__(self) -> None:
        super().__init__(
            "depth_image", weights="default", encoding="32FC1", device="cpu", speed="fine",
            allow_ood=False, camera_height_m=math.nan, camera_tilt_deg=math.nan,
        )  # fmt: skip
        net = FakestereoNet.load(
            self.value("weights"),
            config=MatcherConfig(device=self.value("device"), speed=self.value("speed")),
            allow_ood=self.value("allow_ood"),
        )
        mount = [self.value(name) for name in ("camera_height_m", "camera_tilt_deg")]
        known = [None if math.isnan(number) else float(number) for number in mount]
        work = DepthFromImage(net, self.value("encoding"), self.warn, *known)
        depth = self.create_publisher(Image, "~/depth", NEWEST)
        topics = {"image_rect": Image, "camera_info": CameraInfo}
        self.work_on(topics, 0.0, lambda *given: depth.publish(image_message(work(*given))))


class DepthPairNode(WorkNode):
    """``left/image_rect``, ``right/image_rect`` and both ``camera_info`` to ``~/depth``."""

    def __init__(self) -> None:
        super().__init__(
            "depth_pair", weights="default", encoding="32FC1", device="cpu", speed="fine",
            slop_s=0.01,
        )  # fmt: skip
        weights = self.value("weights")
        config = MatcherConfig(device=self.value("device"), speed=self.value("speed"))
        net = (
            FakestereoNet.load(matcher="sgbm")
            if weights == "sgbm"
            else FakestereoNet.load(weights, config=config)
        )
        work = DepthFromPair(net, self.value("encoding"), self.warn)
        depth = self.create_publisher(Image, "~/depth", NEWEST)
        sides = ("left", "right")
        topics = {f"{side}/image_rect": Image for side in sides}
        topics |= {f"{side}/camera_info": CameraInfo for side in sides}
        self.work_on(
            topics, self.value("slop_s"), lambda *given: depth.publish(image_message(work(*given)))
        )


class PosesNode(WorkNode):
    """``depth``, ``camera_info`` and, if asked for, ``mask`` to ``~/OBJECT/pose``."""

    def __init__(self) -> None:
        super().__init__("poses", weights="parts", object="", with_mask=False, slop_s=0.01)
        net = GeoPoseNet.load(self.value("weights"))
        work = Poses(net, self.value("object") or None)
        found = {name: self.create_publisher(PoseStamped, f"~/{name}/pose", 10)
                 for name in net.objects}  # fmt: skip
        topics = {"depth": Image, "camera_info": CameraInfo}
        topics |= {"mask": Image} if self.value("with_mask") else {}

        def publish(*given: Any) -> None:  # noqa: ANN401
            for name, pose in work(*given):
                found[name].publish(pose_message(pose))

        self.work_on(topics, self.value("slop_s"), publish)


def image_message(plain: messages.Image) -> Image:
    """Copy a plain image into ROS's."""
    message = Image()
    _copy_header(plain.header, message)
    for name in ("height", "width", "encoding", "is_bigendian", "step", "data"):
        setattr(message, name, getattr(plain, name))
    return message


def pose_message(plain: messages.Pose) -> PoseStamped:
    """Copy a plain pose into ROS's."""
    message = PoseStamped()
    _copy_header(plain.header, message)
    place, turn = message.pose.position, message.pose.orientation
    place.x, place.y, place.z = plain.position
    turn.x, turn.y, turn.z, turn.w = plain.orientation
    return message


def _copy_header(plain: messages.Header, message: Any) -> None:  # noqa: ANN401
    message.header.stamp.sec = plain.stamp.sec
    message.header.stamp.nanosec = plain.stamp.nanosec
    message.header.frame_id = plain.frame_id


def _spin(make: Callable[[], WorkNode]) -> None:
    rclpy.init()
    node = make()
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


def depth_image() -> None:
    """Run the node of one image."""
    _spin(DepthImageNode)


def depth_pair() -> None:
    """Run the node of a pair."""
    _spin(DepthPairNode)


def poses() -> None:
    """Run the node of poses."""
    _spin(PosesNode)
