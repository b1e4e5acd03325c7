"""The nodes: parameters, topics and threads around :mod:`depthpose_ros.work`."""

import math
import traceback
from collections.abc import Callable, Sequence
from typing import Any

import rclpy
from depthpose_msgs.srv import FindObjects
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from message_filters import ApproximateTimeSynchronizer, Subscriber
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, Image
from vision_msgs.msg import Detection3D, Detection3DArray, ObjectHypothesisWithPose

from depthpose import FakestereoNet, GeoPoseNet, Registration
from depthpose.cli.pose.methods import read_base
from depthpose.core.errors import InputError
from depthpose.depth.config import MatcherConfig
from depthpose.pose.predictions import score_of
from depthpose_ros import messages
from depthpose_ros.work import (
    DepthFromImage,
    DepthFromPair,
    Latest,
    Poses,
    read_background,
    refuse_unanswered,
)

NEWEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Sensor data, and the last message alone."""
_QUEUE = 4
_LEAST_SLOP_S = 1e-6
"""The synchronizer takes stamps that differ by less than the slop: with a slop of 0 it takes none.
"""


class WorkNode(Node):
    """Waits for messages of one time, processes the newest, and warns of input it cannot use."""

    def __init__(self, name: str, **parameters: object) -> None:
        super().__init__(name)
        for key, value in parameters.items():
            self.declare_parameter(key, value)
        self._latest: Latest | None = None

    def warn(self, message: str) -> None:
        """Log a warning, at most one in five seconds."""
        self.get_logger().warning(message, throttle_duration_sec=5.0)

    def value(self, name: str) -> Any:  # noqa: ANN401
        """Give a parameter."""
        return self.get_parameter(name).value

    def work_on(self, topics: dict[str, type], slop_s: float, work: Callable[..., None]) -> None:
        """Call ``work`` with messages of these topics whose stamps agree within ``slop_s``.

        A message for which it fails costs no other: what failed is logged.
        """

        def guarded(*arrived: Any) -> None:  # noqa: ANN401
            try:
                work(*arrived)
            except InputError as error:
                self.warn(str(error))
            except Exception:  # noqa: BLE001  the thread must live on
                self.get_logger().error(traceback.format_exc())

        self._latest = Latest(guarded)
        subscribers = [
            Subscriber(self, kind, topic, qos_profile=NEWEST) for topic, kind in topics.items()
        ]
        slop_s = max(slop_s, _LEAST_SLOP_S)
        self._synchronizer = ApproximateTimeSynchronizer(subscribers, _QUEUE, slop_s)
        self._synchronizer.registerCallback(self._latest.put)

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
        height_m, tilt_deg = [None if math.isnan(number) else float(number) for number in mount]
        work = DepthFromImage(net, self.value("encoding"), self.warn, height_m, tilt_deg)
        depth = self.create_publisher(Image, "~/depth", NEWEST)
        topics = {"image_rect": Image, "camera_info": CameraInfo}
        self.work_on(topics, 0.0, lambda *arrived: depth.publish(image_message(work(*arrived))))


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
            topics,
            self.value("slop_s"),
            lambda *arrived: depth.publish(image_message(work(*arrived))),
        )


class PosesNode(WorkNode):
    """``depth``, ``camera_info`` and, if asked for, ``mask`` to poses of known objects.

    ``~/detections`` has all that was found, with their alternatives, ``~/OBJECT/pose`` and
    ``~/OBJECT/pose_with_covariance`` what is sure, ``~/OBJECT/base_pose`` the same in the frame of
    a robot. The service ``~/find_objects`` answers one image.
    """

    def __init__(self) -> None:
        super().__init__(
            "poses", weights="parts", cad="", cad_unit="mm", object="", with_mask=False,
            slop_s=0.01, empty_frame="", bin="", bin_pose="", base_from_camera="",
            base_frame="base_link",
        )  # fmt: skip
        files = [file.strip() for file in self.value("cad").split(",") if file.strip()]
        if files:
            net = Registration.load(*files, unit=self.value("cad_unit"))
            net.prepare()
        else:
            net = GeoPoseNet.load(self.value("weights"))
        background = read_background(
            self.value("empty_frame"), self.value("bin"), self.value("bin_pose"),
            self.value("cad_unit"),
        )  # fmt: skip
        self._poses = Poses(net, self.value("object") or None, background)
        self._models = {model.name: model for model in net.models}
        self._base = read_base(self.value("base_from_camera").split())
        self._detections = self.create_publisher(Detection3DArray, "~/detections", 10)
        kinds = {"pose": PoseStamped, "pose_with_covariance": PoseWithCovarianceStamped}
        kinds |= {} if self._base is None else {"base_pose": PoseStamped}
        names = messages.topic_names(net.objects)
        self._published = {
            (object, topic): self.create_publisher(kind, f"~/{name}/{topic}", 10)
            for object, name in names.items()
            for topic, kind in kinds.items()
        }
        self.create_service(FindObjects, "~/find_objects", self._answer)
        topics = {"depth": Image, "camera_info": CameraInfo}
        topics |= {"mask": Image} if self.value("with_mask") else {}
        self.work_on(topics, self.value("slop_s"), self._publish)

    def _publish(self, depth: Any, info: Any, mask: Any = None) -> None:  # noqa: ANN401
        estimates = self._poses.estimates(depth, info, mask)
        header = messages.copied_header(depth)
        detections = [
            messages.detection_from(header, estimate, self._models[estimate.object])
            for estimate in estimates
            if estimate.is_posed
        ]
        self._detections.publish(detections_message(header, detections))
        for estimate in estimates:
            pose = estimate.camera_from_model
            if pose is None or not estimate.is_ok:
                continue
            plain = messages.pose_from_rigid(header, pose)
            covariance = messages.covariance_of(estimate)
            self._published[estimate.object, "pose"].publish(pose_message(plain))
            self._published[estimate.object, "pose_with_covariance"].publish(
                covariance_message(plain, covariance)
            )
            if self._base is not None:
                there = messages.Header(header.stamp, self.value("base_frame"))
                based = messages.pose_from_rigid(there, self._base @ pose.double())
                self._published[estimate.object, "base_pose"].publish(pose_message(based))
        refuse_unanswered(estimates, is_masked=mask is not None)

    def _answer(self, request: Any, response: Any) -> Any:  # noqa: ANN401
        """Answer the service: ids, scores and poses, and what was not found."""
        mask = request.mask if request.mask.height else None
        objects = list(request.objects) or None
        try:
            estimates = self._poses.estimates(request.depth, request.camera_info, mask, objects)
        except Exception as error:  # noqa: BLE001  who asks must be answered
            if not isinstance(error, InputError):
                self.get_logger().error(traceback.format_exc())
            response.success = False
            response.message = str(error) or type(error).__name__
            return response
        header = messages.copied_header(request.depth)
        posed = [estimate for estimate in estimates if estimate.camera_from_model is not None]
        refused = [estimate for estimate in estimates if estimate.camera_from_model is None]
        response.success = True
        response.ids = [estimate.object for estimate in posed]
        response.scores = [score_of(estimate) for estimate in posed]
        response.poses = [
            pose_message(messages.pose_from_rigid(header, estimate.camera_from_model))
            for estimate in posed
            if estimate.camera_from_model is not None
        ]
        response.visible_shares = [estimate.visible_share or 0.0 for estimate in posed]
        response.pick_ranks = [estimate.pick_rank or 0 for estimate in posed]
        response.missing = [estimate.object for estimate in refused]
        response.reasons = [estimate.reason for estimate in refused]
        return response


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
    _copy_pose(plain, message.pose)
    return message


def covariance_message(
    plain: messages.Pose, covariance: Sequence[float]
) -> PoseWithCovarianceStamped:
    """Copy a plain pose and its covariance into ROS's."""
    message = PoseWithCovarianceStamped()
    _copy_header(plain.header, message)
    _copy_pose(plain, message.pose.pose)
    message.pose.covariance = list(covariance)
    return message


def detections_message(
    header: messages.Header, detections: Sequence[messages.Detection]
) -> Detection3DArray:
    """Copy plain detections into ROS's."""
    array = Detection3DArray()
    _copy_header(header, array)
    array.detections = []
    for plain in detections:
        detection = Detection3D()
        _copy_header(header, detection)
        _copy_pose(plain.centre, detection.bbox.center)
        size = detection.bbox.size
        size.x, size.y, size.z = plain.size
        detection.results = []
        for hypothesis in plain.results:
            result = ObjectHypothesisWithPose()
            result.hypothesis.class_id = hypothesis.class_id
            result.hypothesis.score = hypothesis.score
            _copy_pose(hypothesis.pose, result.pose.pose)
            result.pose.covariance = list(hypothesis.covariance)
            detection.results.append(result)
        array.detections.append(detection)
    return array


def _copy_pose(plain: messages.Pose, pose: Any) -> None:  # noqa: ANN401
    place, turn = pose.position, pose.orientation
    place.x, place.y, place.z = plain.position
    turn.x, turn.y, turn.z, turn.w = plain.orientation


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
