"""The named protocols: which truth, and which of its pixels count."""

from dataclasses import dataclass
from typing import Literal

from depthpose.core.errors import InputError, nearest_name
from depthpose.depth.kitti import Frame, has_lidar


@dataclass(frozen=True, kw_only=True)
class Protocol:
    """How a prediction is held against the truth.

    In all protocols of depth truth counts between 0.001 m and the cap, and predictions are clamped
    to that range.

    Attributes:
        summary: one line for people.
        truth: ``velodyne_x`` and ``camera_z`` project one LiDAR scan; ``depth`` and ``disparity``
            read the truth that the dataset ships.
        with_crop: only truth inside the crop of Garg et al. counts.
    """

    summary: str
    truth: Literal["velodyne_x", "camera_z", "depth", "disparity"]
    with_crop: bool


PROTOCOLS = {
    "eigen-raw": Protocol(
        summary="one LiDAR scan, depth = LiDAR x, Garg crop: monodepth's, and the thesis's",
        truth="velodyne_x",
        with_crop=True,
    ),
    "eigen-raw-camera": Protocol(
        summary="the same with depth = camera z", truth="camera_z", with_crop=True
    ),
    "eigen-improved": Protocol(
        summary="annotated depth maps, no crop: monodepth2's",
        truth="depth",
        with_crop=False,
    ),
    "eigen-improved-garg": Protocol(
        summary="annotated depth maps, Garg crop: BTS's, AdaBins'",
        truth="depth",
        with_crop=True,
    ),
    "kitti-2015": Protocol(
        summary="disparity: EPE and D1 (> 3 px and > 5 %), all pixels and those both views see",
        truth="disparity",
        with_crop=False,
    ),
}


def find_protocol(name: str) -> Protocol:
    """Give a protocol by name.

    Raises:
        InputError: there is none; the nearest name is said.
    """
    if name not in PROTOCOLS:
        raise InputError(f"protocol {name!r}: {nearest_name(name, PROTOCOLS)}")
    return PROTOCOLS[name]


def has_truth(frame: Frame, rule: Protocol) -> bool:
    """Whether a frame has the truth that a protocol needs, told by its files alone."""
    match rule.truth:
        case "disparity":
            return frame.disparity is not None
        case "depth":
            return frame.depth is not None
        case _:
            return has_lidar(frame, rule.truth)
