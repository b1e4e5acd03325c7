"""What is in messages, and the worker that takes the latest: without ROS."""

import threading
import time
import warnings
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from depthpose.core.camera import Camera
from depthpose.core.errors import InputError
from depthpose.core.rigid import Rigid, perturb, rotation_by
from depthpose.pose.types import PoseEstimate
from depthpose_ros.messages import (
    Header,
    Image,
    Stamp,
    camera_of,
    covariance_of,
    depth_of,
    image_from_depth,
    mask_of,
    picture_of,
    pose_from_rigid,
    rig_of,
    topic_names,
)
from depthpose_ros.work import Latest

HEADER = Header(Stamp(12, 345), "camera")
H, W = 3, 5


def image(values: np.ndarray, encoding: str, *, pad: int = 0, big: bool = False) -> Image:
    """Make a message as a driver does: rows may be padded, numbers of either order."""
    values = values.astype(values.dtype.newbyteorder(">" if big else "<"))
    rows = values.reshape(len(values), -1).view(np.uint8)
    rows = np.pad(rows, ((0, 0), (0, pad)), constant_values=7)
    h, w = values.shape[:2]
    return Image(HEADER, h, w, encoding, int(big), rows.shape[1], rows.tobytes())


def info(fx: float = 100.0, tx: float = 0.0, **changed: object) -> Any:  # noqa: ANN401
    k = [fx, 0, 2.0, 0, fx, 1.0, 0, 0, 1]
    p = [fx, 0, 2.0, tx, 0, fx, 1.0, 0, 0, 0, 1, 0]
    fields = {"width": W, "height": H, "k": k, "p": p, "d": [], **changed}
    return SimpleNamespace(**fields)


RGB = np.arange(H * W * 3, dtype=np.uint8).reshape(H, W, 3)


@pytest.mark.parametrize("pad", [0, 3])
@pytest.mark.parametrize(
    ("encoding", "values"),
    [
        ("rgb8", RGB),
        ("bgr8", RGB[..., ::-1].copy()),
        ("rgba8", np.dstack([RGB, RGB[..., :1]])),
        ("bgra8", np.dstack([RGB[..., ::-1], RGB[..., :1]])),
    ],
)
def test_pictures_come_as_rgb(encoding: str, values: np.ndarray, pad: int) -> None:
    assert np.array_equal(picture_of(image(values, encoding, pad=pad)), RGB)


@pytest.mark.parametrize("big", [False, True])
def test_sixteen_bits_of_grey_are_shares_in_either_byte_order(big: bool) -> None:
    grey = np.array([[0, 65535], [256, 1]], np.uint16)
    found = picture_of(image(grey, "mono16", big=big))
    assert np.allclose(found, grey / 65535)
    assert found.dtype == np.float32
    assert np.array_equal(picture_of(image(RGB[..., 0], "mono8")), RGB[..., 0])


@pytest.mark.parametrize("big", [False, True])
def test_depth_is_metres_and_unknown_is_nan(big: bool) -> None:
    mm = np.array([[0, 1500], [65535, 1]], np.uint16)
    found = depth_of(image(mm, "16UC1", big=big, pad=2))
    assert np.allclose(found, [[np.nan, 1.5], [65.535, 0.001]], equal_nan=True)
    metres = np.array([[np.nan, 1.5], [np.inf, 0.0]], np.float32)
    found = depth_of(image(metres, "32FC1", big=big))
    assert np.allclose(found, [[np.nan, 1.5], [np.nan, np.nan]], equal_nan=True)


@pytest.mark.parametrize("encoding", ["32FC1", "16UC1"])
def test_depth_comes_back_with_its_stamp_and_frame(encoding: str) -> None:
    depth_m = torch.tensor([[1.25, torch.nan, 70.0], [0.001, 2.0, 65.535]])
    made = image_from_depth(HEADER, depth_m, encoding)
    assert (made.header, made.encoding, made.is_bigendian) == (HEADER, encoding, 0)
    assert (made.height, made.width, made.step * made.height) == (2, 3, len(made.data))
    expected = depth_m.numpy().copy()
    if encoding == "16UC1":
        expected[0, 2] = np.nan  # 70 m are beyond 65535 mm
    assert np.allclose(depth_of(made), expected, atol=1e-6, equal_nan=True)


def test_masks_are_what_is_not_zero() -> None:
    values = np.array([[0, 1], [255, 0]], np.uint8)
    assert mask_of(image(values, "mono8")).tolist() == values.tolist()


@pytest.mark.parametrize(
    ("read", "message", "said"),
    [
        (picture_of, image(RGB, "bayer_rggb8"), "encoding of an image is 'bayer_rggb8'"),
        (depth_of, image(RGB, "rgb8"), "encoding of a depth image is 'rgb8'; Known: '16UC1'"),
        (mask_of, image(RGB, "rgb8"), "encoding of a mask is 'rgb8'"),
        (picture_of, Image(HEADER, 2, 2, "mono8", 0, 2, b"abc"), "needs 4 bytes, and there are 3"),
        (picture_of, Image(HEADER, 2, 2, "rgb8", 0, 2, b"abcd"), "needs 12 bytes"),
        (picture_of, Image(HEADER, 0, 2, "mono8", 0, 2, b""), "an image of 2x0"),
    ],
)
def test_images_that_cannot_be_read_are_refused(read: Any, message: Image, said: str) -> None:  # noqa: ANN401
    with pytest.raises(InputError, match=said):
        read(message)


def test_the_camera_is_that_of_the_window_and_binning() -> None:
    roi = SimpleNamespace(x_offset=100, y_offset=40, width=320, height=240)
    p = [500.0, 0, 320, 0, 0, 500, 240, 0, 0, 0, 1, 0]
    whole = {"width": 640, "height": 480, "p": p}
    cut = camera_of(info(**whole, roi=roi, binning_x=0, binning_y=0))
    assert (cut.width, cut.height) == (320, 240)
    assert (float(cut.K[0, 2]), float(cut.K[1, 2])) == (220, 200)
    right = {**whole, "p": [*p[:3], -50.0, *p[4:]]}
    sides = (info(**one, binning_x=2, binning_y=2) for one in (whole, right))
    rig = rig_of(*sides)
    assert (rig.width, rig.height, rig.baseline_m) == (320, 240, pytest.approx(0.1))
    assert float(rig.K[0, 0]) == 250
    with pytest.raises(InputError, match="fx of the left camera is 500 and of the right one 600"):
        rig_of(info(**whole), info(**{**right, "p": [600.0, 0, 320, -50, 0, 600, *p[6:]]}))


def test_the_camera_is_that_of_the_rectified_image() -> None:
    raw = info(d=[0.1, 0, 0, 0, 0], k=[50.0, 0, 1, 0, 50, 1, 0, 0, 1])
    assert camera_of(raw).K[0].tolist() == [100, 0, 2]
    assert camera_of(info(p=[0.0] * 12)).K[0].tolist() == [100, 0, 2]
    # The right camera of a pair by itself, and the lower one of two that stand above each other.
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert type(camera_of(info(tx=-12.0))) is Camera
    lower = [100.0, 0, 2, 0, 0, 100, 1, -30, 0, 0, 1, 0]
    assert camera_of(info(p=lower)).K[0].tolist() == [100, 0, 2]
    rig = rig_of(info(), info(tx=-12.0))
    assert (rig.baseline_m, rig.cx_right_minus_left_px) == (0.12, 0)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (lambda: camera_of(info(p=[0.0] * 12, d=[0.1])), "has distortion and no P"),
        (lambda: camera_of(info(0.0)), "not calibrated"),
        (lambda: rig_of(info(), info()), r"no -fx \* baseline"),
        (lambda: rig_of(info(tx=-12.0), info()), "is it of the left camera"),
        (lambda: rig_of(info(), info(0.0)), r"no -fx \* baseline"),
    ],
)
def test_cameras_that_are_not_calibrated_are_refused(given: Any, said: str) -> None:  # noqa: ANN401
    with pytest.raises(InputError, match=said):
        given()


def test_topics_have_names_that_ros_takes() -> None:
    assert topic_names(["bracket-v2", "003_cracker_box", "cup"]) == {
        "bracket-v2": "bracket_v2",
        "003_cracker_box": "_003_cracker_box",
        "cup": "cup",
    }
    with pytest.raises(InputError, match=r"object 'a_b' would have the topic 'a_b', as another"):
        topic_names(["a b", "a_b"])


def test_a_pose_is_metres_and_a_unit_quaternion() -> None:
    R = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    pose = pose_from_rigid(HEADER, Rigid(R, torch.tensor([0.1, 0.2, 0.7])))
    assert pose.position == pytest.approx((0.1, 0.2, 0.7))
    assert pose.orientation == pytest.approx((0, 0, 0.5**0.5, 0.5**0.5))


def test_a_covariance_is_that_of_the_place_and_of_turns_about_it() -> None:
    """Draw motions as an estimate has them, and look where they take the object."""
    generator = torch.Generator().manual_seed(0)
    root = torch.randn(6, 6, generator=generator).double() * 1e-3
    pose = Rigid(
        rotation_by(torch.tensor([0.3, -0.2, 0.5]).double()), torch.tensor([0.1, 0.2, 0.7])
    )
    pose = pose.double()
    estimate = PoseEstimate(
        name="a", object="b", status="ok", camera_from_model=pose, covariance=root @ root.mT
    )
    motions = torch.randn(20_000, 6, generator=generator).double() @ root.mT
    moved = perturb(Rigid(pose.R.expand(20_000, 3, 3), pose.t_m.expand(20_000, 3)), motions)
    drawn = torch.cat([moved.t_m - pose.t_m, motions[:, :3]], 1)
    expected = drawn.mT @ drawn / len(drawn)
    found = torch.tensor(covariance_of(estimate)).reshape(6, 6)
    assert float((found - expected).norm() / expected.norm()) < 0.03


def test_a_turn_that_is_free_has_the_variance_of_an_even_one() -> None:
    axis = torch.tensor([0.0, 0, 1])
    place_m = torch.tensor([0.1, 0.2, 0.7])
    # A turn about an axis through the object leaves its place where it is.
    motion = torch.cat([axis, -torch.linalg.cross(axis, place_m)])
    estimate = PoseEstimate(
        name="a", object="b", status="ok", camera_from_model=Rigid(torch.eye(3), place_m),
        covariance=torch.zeros(6, 6), free_motions=(motion / motion.norm())[None],
    )  # fmt: skip
    found = torch.tensor(covariance_of(estimate)).reshape(6, 6)
    assert found.diagonal().tolist() == pytest.approx([0] * 5 + [np.pi**2 / 3], abs=1e-6)
    nothing = PoseEstimate(name="a", object="b", status="doubtful", reason="why")
    assert covariance_of(nothing) == (0.0,) * 36


def test_a_slow_worker_takes_the_newest_frame_and_drops_those_between() -> None:
    begun, go, done = threading.Event(), threading.Event(), []

    def work(frame: int) -> None:
        begun.set()
        go.wait(10)
        done.append(frame)

    latest = Latest(work)
    latest.put(0)
    assert begun.wait(10)
    for frame in (1, 2, 3):
        latest.put(frame)
    go.set()
    deadline = time.monotonic() + 10
    while len(done) < 2 and time.monotonic() < deadline:
        time.sleep(0.01)
    latest.close()
    assert done == [0, 3]
    assert latest.dropped == 2
