"""The work of the nodes: messages in, messages out, the latest first. Nothing here needs ROS."""

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from depthpose import FakestereoNet, GeoPoseNet, Registration
from depthpose.cli.pose.transforms import read_pose
from depthpose.core.errors import InputError
from depthpose.core.files import MAP_SUFFIXES
from depthpose.core.units import Unit
from depthpose.pose.background import AnyBackground, PosedBin, add_background
from depthpose.pose.datasets import number_objects
from depthpose.pose.inputs import depth_input, view_input
from depthpose.pose.types import PoseEstimate
from depthpose_ros.messages import (
    Image,
    Pose,
    camera_of,
    copied_header,
    depth_of,
    image_from_depth,
    mask_of,
    picture_of,
    pose_from_rigid,
    rig_of,
)


@dataclass
class DepthFromImage:
    """One rectified image and its camera to a depth image; ``warn`` is told of doubts.

    ``camera_info`` does not say where a camera is mounted: its height above the road [m], and its
    tilt [degrees, negative downwards], set the scale where they are given.
    """

    net: FakestereoNet
    encoding: str = "32FC1"
    warn: Callable[[str], None] = print
    mount_height_m: float | None = None
    tilt_deg: float | None = None

    def __call__(self, image: Any, info: Any) -> Image:  # noqa: ANN401
        """Estimate; stamp and frame are the image's.

        Raises:
            InputError: what the messages lack, or an image unlike those that the weights know.
        """
        camera = replace(
            camera_of(info), mount_height_m=self.mount_height_m, tilt_deg=self.tilt_deg
        )
        estimate = self.net.estimate(picture_of(image), camera)
        if estimate.warning:
            self.warn(estimate.warning)
        assert estimate.depth_m is not None, "one image has a camera, and so metres"
        return image_from_depth(copied_header(image), estimate.depth_m, self.encoding)


@dataclass
class DepthFromPair:
    """A rectified pair and both cameras to a depth image of the left view, as above."""

    net: FakestereoNet
    encoding: str = "32FC1"
    warn: Callable[[str], None] = print

    def __call__(self, left: Any, right: Any, left_info: Any, right_info: Any) -> Image:  # noqa: ANN401
        """Match; stamp and frame are the left image's.

        Raises:
            InputError: what the messages lack, or a pair that is none, swapped or not rectified.
        """
        rig = rig_of(left_info, right_info)
        estimate = self.net.estimate(picture_of(left), rig, right=picture_of(right))
        if estimate.warning:
            self.warn(estimate.warning)
        assert estimate.depth_m is not None, "a rig gives metres"
        return image_from_depth(copied_header(left), estimate.depth_m, self.encoding)


@dataclass
class Poses:
    """A depth image, with a mask or without, to poses of known objects.

    Attributes:
        net: the pose estimator.
        object: its name; None: the only one that is known, or all objects without a mask.
        background: what a search takes for no object: an empty frame of this camera [m], or a bin
            at its pose; None: not known. With a mask it has no effect.
    """

    net: GeoPoseNet | Registration
    object: str | None = None
    background: AnyBackground | None = None

    def estimates(
        self,
        depth: Any,  # noqa: ANN401
        info: Any,  # noqa: ANN401
        mask: Any = None,  # noqa: ANN401
        objects: Sequence[str] | None = None,
    ) -> list[PoseEstimate]:
        """Estimate what is there, the surest first, and say why of what is not found.

        A mask that numbers several objects (1, 2, ...) shows an instance of one object a number.
        ``objects``: which may be there, in place of that of the node.

        Raises:
            InputError: what the messages lack.
        """
        depth_m, camera = depth_of(depth), camera_of(info)
        wanted = ([] if self.object is None else [self.object]) if objects is None else [*objects]
        if mask is None:
            names = wanted or [*self.net.objects]
            view = view_input(depth_m, None, camera, names[0], "depth")
            return self.net.find(add_background(view, self.background, camera), objects=names)
        if len(wanted) > 1:
            raise InputError(
                f"a mask is of one object, and {', '.join(wanted)} are asked for; ask for one, or "
                "leave the mask out"
            )
        arguments: dict[str, Any] = {
            "depth": depth_m,
            "mask": mask_of(mask),
            "camera": camera,
            "object": wanted[0] if wanted else None,
        }
        if int(number_objects(arguments["mask"]).max()) > 1:
            return self.net.estimate_instances(**arguments)
        return [self.net.estimate(**arguments)]

    def __call__(self, depth: Any, info: Any, mask: Any = None) -> list[tuple[str, Pose]]:  # noqa: ANN401
        """Give name and pose of what was found, the surest first; stamp and frame are the depth's.

        Raises:
            InputError: what the messages lack; with a mask, also why nothing in it has a pose.
        """
        estimates = self.estimates(depth, info, mask)
        refuse_unanswered(estimates, is_masked=mask is not None)
        header = copied_header(depth)
        poses = [(sure.object, sure.camera_from_model) for sure in estimates if sure.is_ok]
        return [(name, pose_from_rigid(header, pose)) for name, pose in poses if pose is not None]


def read_background(
    empty_frame: str, bin_file: str, bin_pose: str, bin_unit: Unit
) -> AnyBackground | None:
    """Read what the camera sees without the objects; None where no file is given.

    Args:
        empty_frame: a depth image, PNG or TIFF in millimetres, or NPY or PFM in metres; or empty.
        bin_file: CAD file of a bin in place of it; or empty.
        bin_pose: text file with the 4x4 matrix ``camera_from_model`` of the bin in metres.
        bin_unit: of the CAD file.

    Raises:
        InputError: both are given, a file cannot be read, or a bin has no pose.
    """
    if empty_frame and bin_file:
        raise InputError(
            f"empty_frame {empty_frame} and bin {bin_file} are both given; take one of them out"
        )
    if bin_file:
        if not bin_pose:
            raise InputError(
                f"bin {bin_file}: where is it? Give bin_pose, a text file with its 4x4 matrix "
                "camera_from_model in metres, or empty_frame in place of both"
            )
        return PosedBin.load(bin_file, read_pose(Path(bin_pose), "bin_pose"), bin_unit)
    if empty_frame:
        is_map = Path(empty_frame).suffix.lower() in MAP_SUFFIXES
        return depth_input(empty_frame, None, "empty_frame", None if is_map else "mm")[0]
    return None


def refuse_unanswered(estimates: Sequence[PoseEstimate], *, is_masked: bool) -> None:
    """Say why nothing in a mask has a sure pose.

    Raises:
        InputError: that is so.
    """
    if is_masked and not any(estimate.is_ok for estimate in estimates):
        raise InputError(f"{estimates[0].object}: no pose: {estimates[0].reason}")


class Latest:
    """Processes the newest input; input that arrives meanwhile replaces what is waiting.

    A node that is slower than its camera then answers with the newest frame, not with an old one.

    Args:
        work: called in a thread of its own, with what was given to :meth:`put`.
    """

    def __init__(self, work: Callable[..., None]) -> None:
        self._work = work
        self._waiting: tuple[Any, ...] | None = None
        self._is_closed = False
        self._changed = threading.Condition()
        self.dropped = 0
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def put(self, *messages: Any) -> None:  # noqa: ANN401
        """Hand over the newest messages, and return at once."""
        with self._changed:
            self.dropped += self._waiting is not None
            self._waiting = messages
            self._changed.notify_all()

    def close(self) -> None:
        """Finish the present input, and end."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()
        self._thread.join()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._is_closed or self._waiting is not None)
                if self._is_closed:
                    return
                messages = self._waiting
                self._waiting = None
            assert messages is not None
            self._work(*messages)
