"""The nodes on recorded messages: a bag of ROS 2, written and read by rosbags, without rclpy.

What is around the networks in ``nodes.py`` runs on a test double of rclpy (``rclpy_double``).
"""

import dataclasses
import importlib
import re
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from tests.ros import rclpy_double

from depthpose import FakestereoNet, GeoPoseNet
from depthpose.core.camera import Camera, StereoRig
from depthpose.core.errors import InputError
from depthpose.core.files import write_depth_png
from depthpose.core.rigid import Rigid
from depthpose.depth.config import StreetsConfig
from depthpose.depth.synthetic import Streets
from depthpose.depth.types import StereoSample
from depthpose.pose.config import MeshConfig
from depthpose.pose.mesh import make_model
from depthpose.pose.search import nothing_found
from depthpose.pose.types import Alternative, PoseEstimate, ViewInput
from depthpose_ros.messages import depth_of
from depthpose_ros.work import DepthFromImage, DepthFromPair, Poses

ROS = Path(__file__).parents[2] / "ros" / "depthpose_ros"
FRAME_ID, STAMP = "left_camera_optical", (1700000000, 123456789)


@pytest.fixture(scope="module")
def street() -> StereoSample:
    return Streets(StreetsConfig(seed=771, scale=0.5, jpeg_share=0.0))[0]


def ros2() -> Any:  # noqa: ANN401
    """Message classes of ROS 2, with the bytes that they have on the wire."""
    types = pytest.importorskip("rosbags.typesys")
    return types.get_typestore(types.Stores.ROS2_JAZZY)


def rig_of_street(street: StereoSample) -> StereoRig:
    rig = street.input.camera
    assert isinstance(rig, StereoRig)
    return rig


@pytest.fixture(scope="module")
def recorded(street: StereoSample, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The messages of a pair, out of a real bag: serialised, written, read and parsed again."""
    bags, store = pytest.importorskip("rosbags.rosbag2"), ros2()
    kinds = store.types
    stamp = kinds["builtin_interfaces/msg/Time"](*STAMP)
    header = kinds["std_msgs/msg/Header"](stamp, FRAME_ID)
    rig = rig_of_street(street)
    roi = kinds["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    messages = {}
    for side, view, tx in (
        ("left", street.input.left, 0.0),
        ("right", street.input.right, -float(rig.K[0, 0]) * rig.baseline_m),
    ):
        assert view is not None
        pixels = (view * 255).round().byte().permute(1, 2, 0).flip(2).numpy()
        height, width, _ = pixels.shape
        messages[f"/{side}/image_rect"] = kinds["sensor_msgs/msg/Image"](
            header, height, width, "bgr8", 0, 3 * width, np.ascontiguousarray(pixels).ravel()
        )
        P = np.c_[rig.K.numpy(), [tx, 0, 0]]
        messages[f"/{side}/camera_info"] = kinds["sensor_msgs/msg/CameraInfo"](
            header, height, width, "plumb_bob", np.zeros(5), rig.K.numpy().ravel(),
            np.eye(3).ravel(), P.ravel(), 0, 0, roi,
        )  # fmt: skip
    bag = tmp_path_factory.mktemp("bag") / "pair"
    with bags.Writer(bag, version=9) as writer:
        for topic, message in messages.items():
            there = writer.add_connection(topic, message.__msgtype__, typestore=store)
            writer.write(there, STAMP[0], store.serialize_cdr(message, message.__msgtype__))
    with bags.Reader(bag) as reader:
        return {
            one.topic: store.deserialize_cdr(data, one.msgtype)
            for one, _, data in reader.messages()
        }


def pictures(street: StereoSample) -> list[torch.Tensor]:
    assert street.input.right is not None
    return [(v * 255).round().byte() for v in (street.input.left, street.input.right)]


def test_recorded_pairs_give_the_depth_of_the_estimator(
    street: StereoSample, recorded: dict[str, Any]
) -> None:
    net, (left, right) = FakestereoNet.load(matcher="sgbm"), pictures(street)
    topics = [f"/{s}/{t}" for t in ("image_rect", "camera_info") for s in ("left", "right")]
    made = DepthFromPair(net)(*(recorded[topic] for topic in topics))
    assert (made.header.stamp.sec, made.header.stamp.nanosec) == STAMP
    assert (made.header.frame_id, made.encoding) == (FRAME_ID, "32FC1")
    expected = net.estimate(left, rig_of_street(street), right=right).depth_m
    assert expected is not None
    assert np.allclose(depth_of(made), expected.numpy(), rtol=1e-4, equal_nan=True)


def test_of_a_pair_that_shows_too_little_a_warning_is_given(recorded: dict[str, Any]) -> None:
    said: list[str] = []
    image = recorded["/left/image_rect"]
    row = np.linspace(0, 255, image.width).repeat(3)
    bare = [
        dataclasses.replace(image, data=np.tile(share * row, image.height).astype(np.uint8))
        for share in (1.0, 0.9)
    ]
    infos = [recorded[f"/{side}/camera_info"] for side in ("left", "right")]
    DepthFromPair(FakestereoNet.load(matcher="sgbm"), warn=said.append)(*bare, *infos)
    assert len(said) == 1
    assert "cannot tell whether the pair is rectified" in said[0]


def test_recorded_images_give_the_depth_of_the_estimator(
    street: StereoSample, recorded: dict[str, Any]
) -> None:
    net = FakestereoNet.load("default", allow_ood=True)
    rig = rig_of_street(street)
    given = (recorded["/left/image_rect"], recorded["/left/camera_info"])
    made = DepthFromImage(net, "16UC1")(*given)
    camera = Camera(width=rig.width, height=rig.height, K=rig.K)
    expected = net.estimate(pictures(street)[0], camera).depth_m
    assert expected is not None
    is_near = expected.numpy() < 65
    assert np.allclose(depth_of(made)[is_near], expected.numpy()[is_near], atol=2e-3)
    assert np.isnan(depth_of(made)[expected.isnan().numpy()]).all()
    higher = DepthFromImage(net, mount_height_m=3.0)(*given)
    mounted = Camera(width=rig.width, height=rig.height, K=rig.K, mount_height_m=3.0)
    by_height = net.estimate(pictures(street)[0], mounted).depth_m
    assert by_height is not None
    assert np.array_equal(depth_of(higher), by_height, equal_nan=True)
    assert np.nanmedian(depth_of(higher)) > 1.1 * np.nanmedian(expected)


def test_the_answer_is_a_message_of_ros(street: StereoSample, recorded: dict[str, Any]) -> None:
    store = ros2()
    topics = [f"/{s}/{t}" for t in ("image_rect", "camera_info") for s in ("left", "right")]
    plain = DepthFromPair(FakestereoNet.load(matcher="sgbm"))(*(recorded[t] for t in topics))
    kinds = store.types
    header = kinds["std_msgs/msg/Header"](
        kinds["builtin_interfaces/msg/Time"](plain.header.stamp.sec, plain.header.stamp.nanosec),
        plain.header.frame_id,
    )
    rest = (plain.height, plain.width, plain.encoding, plain.is_bigendian, plain.step)
    image = kinds["sensor_msgs/msg/Image"](header, *rest, np.frombuffer(plain.data, np.uint8))
    data = store.serialize_cdr(image, "sensor_msgs/msg/Image")
    back = store.deserialize_cdr(data, "sensor_msgs/msg/Image")
    assert np.array_equal(depth_of(back), depth_of(plain), equal_nan=True)


CUP = make_model(
    torch.tensor([[0.0, 0, 0], [0.1, 0, 0], [0, 0.2, 0], [0, 0, 0.3]]),
    torch.tensor([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]),
    name="cup",
    config=MeshConfig(keypoints=4),
)


class KnowsPose:
    """Poses a cup wherever it is asked."""

    objects = ("cup",)
    models = (CUP,)
    pose = Rigid(torch.eye(3), torch.tensor([0.1, 0.2, 0.7]))

    def answer(self) -> PoseEstimate:
        turned = Rigid(torch.diag(torch.tensor([1.0, -1, -1])), self.pose.t_m)
        other = Alternative(camera_from_model=turned, probability=0.04, difference="upside down")
        return PoseEstimate(
            name="input", object="cup", status="ok", camera_from_model=self.pose, certainty=0.95,
            covariance=torch.eye(6) * 1e-6, alternatives=(other,), pick_rank=1,
        )  # fmt: skip

    def find(self, view: ViewInput, *, objects: list[str]) -> list[Any]:
        return [self.answer(), *(nothing_found(view, name, [], 0.0) for name in objects[1:])]

    def estimate(self, *, mask: np.ndarray, object: str, **_: object) -> Any:  # noqa: ANN401, ARG002
        if mask.any():
            return self.answer()
        reason = "the mask is empty"
        return PoseEstimate(name="input", object="cup", status="too few points", reason=reason)

    def estimate_instances(self, *, mask: np.ndarray, object: str, **_: object) -> list[Any]:
        return [self.estimate(mask=mask == k, object=object) for k in np.unique(mask[mask > 0])]


def depth_messages(street: StereoSample, recorded: dict[str, Any]) -> tuple[Any, Any]:
    topics = [f"/{s}/{t}" for t in ("image_rect", "camera_info") for s in ("left", "right")]
    depth = DepthFromPair(FakestereoNet.load(matcher="sgbm"))(*(recorded[t] for t in topics))
    return depth, recorded["/left/camera_info"]


def test_poses_bear_the_depths_stamp_and_a_refusal_says_why(
    street: StereoSample, recorded: dict[str, Any]
) -> None:
    depth, info = depth_messages(street, recorded)
    net: Any = KnowsPose()
    ((name, pose),) = Poses(net)(depth, info)
    assert (name, pose.header) == ("cup", depth.header)
    assert pose.position == pytest.approx((0.1, 0.2, 0.7))
    assert pose.orientation == pytest.approx((0, 0, 0, 1))
    pixels = np.zeros((depth.height, depth.width), np.uint8)
    mask = SimpleNamespace(
        header=depth.header, height=depth.height, width=depth.width, encoding="mono8",
        is_bigendian=0, step=depth.width, data=pixels,
    )  # fmt: skip
    with pytest.raises(InputError, match="cup: no pose: the mask is empty"):
        Poses(net, "cup")(depth, info, mask)
    pixels[0, 0] = 1
    assert Poses(net, "cup")(depth, info, mask)[0][0] == "cup"
    # Numbers are instances: a pose of each.
    pixels[10:20, 10:20], pixels[30:40, 10:20] = 1, 2
    assert [name for name, _ in Poses(net, "cup")(depth, info, mask)] == ["cup", "cup"]


def test_parts_are_posed_from_messages(after_demo: Path) -> None:
    from depthpose.core.camera import read_camera
    from depthpose.core.files import read_depth_png, read_image
    from depthpose_ros.messages import Header, Image, image_from_depth

    part = after_demo / "out/demo/part"
    camera = read_camera(part / "camera.json", None)
    assert camera.depth_unit_m is not None
    depth_m = read_depth_png(part / "depth.png", camera.depth_unit_m)
    info = SimpleNamespace(
        width=camera.width, height=camera.height, k=camera.K.numpy().ravel(),
        p=np.c_[camera.K.numpy(), np.zeros(3)].ravel(), d=[],
    )  # fmt: skip
    pixels = (read_image(part / "mask.png")[0] > 0).numpy().astype(np.uint8)
    height, width = pixels.shape
    mask = Image(Header(), height, width, "mono8", 0, width, pixels.tobytes())
    net = GeoPoseNet.load("parts")
    ((name, pose),) = Poses(net, "flange")(image_from_depth(Header(), depth_m, "32FC1"), info, mask)
    expected = net.estimate(depth=depth_m, mask=pixels, camera=camera, object="flange")
    assert expected.camera_from_model is not None
    assert name == "flange"
    assert pose.position == pytest.approx(expected.camera_from_model.t_m.tolist(), abs=1e-4)


# nodes.py, on the double


def started_node(monkeypatch: pytest.MonkeyPatch, name: str, **parameters: object) -> Any:  # noqa: ANN401
    rclpy_double.install(monkeypatch, **parameters)
    return getattr(importlib.import_module("depthpose_ros.nodes"), name)()


def wait_until(is_so: Any) -> None:  # noqa: ANN401
    deadline = time.monotonic() + 60
    while not is_so() and time.monotonic() < deadline:
        time.sleep(0.02)
    assert is_so()


def test_the_node_of_a_pair_publishes_depth_and_warns_of_what_it_cannot_use(
    recorded: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    node = started_node(monkeypatch, "DepthPairNode", weights="sgbm", encoding="16UC1")
    topics = [one.topic for one in node._synchronizer.heard]
    assert {one.qos.depth for one in node._synchronizer.heard} == {1}
    assert {one.qos.reliability for one in node._synchronizer.heard} == {"best effort"}
    given = [recorded[f"/{topic}"] for topic in topics]
    node._synchronizer.callback(*given)
    sent = node.publishers_made["~/depth"].sent
    wait_until(lambda: sent)
    assert (sent[0].encoding, sent[0].header.frame_id) == ("16UC1", FRAME_ID)
    assert (sent[0].header.stamp.sec, sent[0].header.stamp.nanosec) == STAMP
    node._synchronizer.callback(given[0], given[1], given[2], given[2])
    wait_until(lambda: node.warnings)
    assert "no -fx * baseline" in node.warnings[0]
    node.destroy_node()


def test_a_message_that_fails_costs_no_other(
    recorded: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    node = started_node(monkeypatch, "DepthPairNode", weights="sgbm")
    given = [recorded[f"/{one.topic}"] for one in node._synchronizer.heard]
    node._synchronizer.callback(None, *given[1:])
    wait_until(lambda: node.errors)
    assert "AttributeError" in node.errors[0]
    node._synchronizer.callback(*given)
    wait_until(lambda: node.publishers_made["~/depth"].sent)
    node.destroy_node()


def poses_node(monkeypatch: pytest.MonkeyPatch, **parameters: object) -> Any:  # noqa: ANN401
    monkeypatch.setattr(GeoPoseNet, "load", lambda _: KnowsPose())
    return started_node(monkeypatch, "PosesNode", **parameters)


def test_the_node_of_poses_publishes_what_others_expect(
    street: StereoSample, recorded: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    base = "0 -1 0 0.5 1 0 0 0 0 0 1 2 0 0 0 1"
    node = poses_node(monkeypatch, base_from_camera=base, base_frame="world")
    node._synchronizer.callback(*depth_messages(street, recorded))
    sent = {topic: made.sent for topic, made in node.publishers_made.items()}
    assert sorted(sent) == [
        "~/cup/base_pose", "~/cup/pose", "~/cup/pose_with_covariance", "~/detections",
    ]  # fmt: skip
    wait_until(lambda: all(sent.values()))
    node.destroy_node()

    (array,) = sent["~/detections"]
    assert (array.header.stamp.sec, array.header.frame_id) == (STAMP[0], FRAME_ID)
    (detection,) = array.detections
    # The likeliest first, and the alternative behind it.
    scores = [(r.hypothesis.class_id, r.hypothesis.score) for r in detection.results]
    assert scores == [("cup", 0.95), ("cup", 0.04)]
    assert detection.results[1].pose.pose.orientation.x == pytest.approx(1)
    # The box is about the model, not about its origin.
    assert vars(detection.bbox.center.position) == pytest.approx({"x": 0.15, "y": 0.3, "z": 0.85})
    assert vars(detection.bbox.size) == pytest.approx({"x": 0.1, "y": 0.2, "z": 0.3})
    (posed,) = sent["~/cup/pose_with_covariance"]
    assert posed.pose.pose.position.z == pytest.approx(0.7)
    assert len(posed.pose.covariance) == 36
    (based,) = sent["~/cup/base_pose"]
    assert based.header.frame_id == "world"
    assert vars(based.pose.position) == pytest.approx({"x": 0.3, "y": 0.1, "z": 2.7})


def test_the_node_of_poses_searches_before_an_empty_frame(
    street: StereoSample,
    recorded: dict[str, Any],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    depth, info = depth_messages(street, recorded)
    empty_m = torch.as_tensor(depth_of(depth)) + 0.5
    write_depth_png(tmp_path / "empty.png", empty_m, 0.001)
    node = poses_node(monkeypatch, empty_frame=str(tmp_path / "empty.png"))
    searched: list[ViewInput] = []
    monkeypatch.setattr(KnowsPose, "find", lambda _, view, **__: searched.append(view) or [])
    node._poses.estimates(depth, info)
    node.destroy_node()
    (view,) = searched
    assert view.background is not None
    gap_m = (view.background.depth_m - empty_m).abs()
    assert float(gap_m.nanmedian()) < 0.001

    with pytest.raises(InputError, match="where is it"):
        poses_node(monkeypatch, bin="bin.stl")
    with pytest.raises(InputError, match="both given"):
        poses_node(monkeypatch, bin="bin.stl", empty_frame="empty.png")


def test_the_service_answers_one_image(
    street: StereoSample, recorded: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    node = poses_node(monkeypatch)
    depth, info = depth_messages(street, recorded)
    service = node.services_made["~/find_objects"]
    empty = SimpleNamespace(height=0, width=0)

    def ask(mask: Any = empty, **changes: Any) -> Any:  # noqa: ANN401
        fields = {"depth": depth, "camera_info": info, "mask": mask, "objects": [], **changes}
        return service.call(SimpleNamespace(**fields), SimpleNamespace(message=""))

    found = ask()
    assert (found.success, found.ids, found.scores) == (True, ["cup"], [0.95])
    assert found.poses[0].pose.position.z == pytest.approx(0.7)
    assert (found.missing, found.reasons) == ([], [])
    # What is asked for and not found has a row too.
    both = ask(objects=["cup", "plate"])
    assert (both.ids, both.missing, both.pick_ranks) == (["cup"], ["plate"], [1])
    assert "is surely plate" in both.reasons[0]
    pixels = np.zeros((depth.height, depth.width), np.uint8)
    mask = SimpleNamespace(
        header=depth.header, height=depth.height, width=depth.width, encoding="mono8",
        is_bigendian=0, step=depth.width, data=pixels,
    )  # fmt: skip
    refused = ask(mask)
    assert (refused.ids, refused.missing) == ([], ["cup"])
    assert refused.reasons == ["the mask is empty"]
    unusable = ask(depth=SimpleNamespace(**{**vars(depth), "encoding": "rgb8"}))
    assert not unusable.success
    assert "encoding of a depth image is 'rgb8'" in unusable.message
    node.destroy_node()


def test_the_service_has_the_fields_that_the_node_reads_and_sets() -> None:
    types = pytest.importorskip("rosbags.typesys")
    text = (ROS.parent / "depthpose_msgs" / "srv" / "FindObjects.srv").read_text()
    asked, _, answered = text.partition("---")
    store = ros2()
    for name, part in (("Request", asked), ("Response", answered)):
        known = types.get_types_from_msg(part, f"depthpose_msgs/msg/{name}")
        store.register(known)
    fields = {
        name: set(store.types[f"depthpose_msgs/msg/{name}"].__dataclass_fields__)
        for name in ("Request", "Response")
    }
    node = (ROS / "depthpose_ros" / "nodes.py").read_text()
    for kind, word in (("Request", "request"), ("Response", "response")):
        used = set(re.findall(rf"\b{word}\.(\w+)", node))
        assert used == fields[kind] - {"__msgtype__"}, kind


def test_every_parameter_of_the_file_is_one_that_the_node_declares(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    files = yaml.safe_load((ROS / "config" / "depthpose.yaml").read_text())
    nodes = {"depth_image": "DepthImageNode", "depth_pair": "DepthPairNode", "poses": "PosesNode"}
    assert {name.rpartition("/")[2] for name in files} == set(nodes)
    for name, content in files.items():
        node = started_node(monkeypatch, nodes[name.rpartition("/")[2]])
        # Printed, since a NaN, which says "not known", equals none.
        assert repr(node.parameters) == repr(content["ros__parameters"])
        node.destroy_node()


def test_what_colcon_needs_is_there_and_says_one_version() -> None:
    setup, package = (ROS / "setup.py").read_text(), (ROS / "package.xml").read_text()
    assert (ROS / "resource" / "depthpose_ros").is_file()
    assert "<version>0.1.0</version>" in package
    assert 'version="0.1.0"' in setup
    for launch in (ROS / "launch").iterdir():
        name = launch.name.removesuffix(".launch.py")
        assert f'executable="{name}"' in launch.read_text()
        assert f"{name} = {{NAME}}.nodes:{name}" in setup
        compile(launch.read_text(), str(launch), "exec")
