"""Options that several depth commands take: each is declared, and described, once."""

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from depthpose.cli.arguments import (
    Device,
    Source,
    WeightsName,
    refuse_below,
    refuse_outside,
    shown_as,
)
from depthpose.core.errors import InputError
from depthpose.depth.config import COLOR_RANGE_M, Answer, BaselineName, MatcherConfig, Speed

_SIZE = re.compile(
    r"\s*(?P<number>\d+(?:\.\d+)?)\s*(?P<prefix>[KMGT]?)(?P<binary>i?)B?\s*", re.IGNORECASE
)
_EXPONENTS = {"": 0, "K": 1, "M": 2, "G": 3, "T": 4}
"""Exponents of 1000, or of 1024, by the prefix of a size in bytes."""
_MIN_HEIGHT_M = 0.1
_MAX_HEIGHT_M = 20.0
_MAX_TILT_DEG = 45.0
"""Heights and tilts of cameras that see a road; beyond them a unit or sign is wrong."""


def _parse_bytes(text: str) -> int:
    """Parse ``--max-memory`` to bytes: 1GB, 800M or 1500000; GiB and the like are of 1024."""
    size = _SIZE.fullmatch(text)
    if size is None or (size["binary"] and not size["prefix"]) or not float(size["number"]):
        raise InputError(f"--max-memory {text!r}: not a size. Write, say, 1GB, 800MB or 1.5GiB.")
    base = 1024 if size["binary"] else 1000
    return int(float(size["number"]) * base ** _EXPONENTS[size["prefix"].upper()])


@dataclass(frozen=True, kw_only=True)
class MatcherOptions:
    """The settings by which the networks of the weights run."""

    speed: Speed = "fine"
    """quick: at the size that the weights were trained at; fine: one image in a larger size too, a
    pair at up to 280,000 pixels (PSMNet) or 650,000 (light): for KITTI 3 times the time."""
    device: Device = "cpu"
    max_memory: Annotated[str | None, shown_as(metavar="SIZE")] = None
    """limit on a matcher's activations, such as 1GB or 800MB; the result stays exact."""
    precision: Literal["fp32", "bf16"] = "fp32"
    """fp32, or bf16: faster, with errors of a few hundredths of a pixel."""

    @property
    def config(self) -> MatcherConfig:
        """The settings of the networks that these options stand for."""
        return MatcherConfig(
            device=self.device,
            precision=self.precision,
            max_memory_bytes=None if self.max_memory is None else _parse_bytes(self.max_memory),
            speed=self.speed,
        )


@dataclass(frozen=True, kw_only=True)
class LensOptions:
    """The known facts of the camera of single images; without any of them their EXIF is read."""

    camera: Path | None = None
    """JSON file: {"width", "height", "K": 3x3}, or a file of ROS, OpenCV, KITTI and others, which
    the error of an unknown file lists. A baseline in it is ignored: one image has none."""
    focal_px: float | None = None
    """focal length in pixels, in place of a camera; its axis meets the centre of the image."""
    fov: float | None = None
    """horizontal field of view in degrees, in place of both."""


@dataclass(frozen=True, kw_only=True)
class ScaleOptions:
    """The known lengths that set the metres of single images."""

    camera_height: float | None = None
    """height of the camera above the road in metres, which else is estimated ("mount_height_m" of a
    camera file)."""
    camera_tilt: float | None = None
    """tilt of the camera in degrees, negative downwards, which else is estimated of each image
    ("tilt_deg" of a camera file)."""
    one_mount: bool = False
    """the images, by their names, are frames of one camera on one vehicle, as those of a video
    always are: its height is held, its tilt smoothed."""
    known_distance: str | None = None
    """X,Y,METRES: column and row of a pixel and its measured depth along the optical axis, which
    sets the scale of each image."""

    def refuse_unusable(self) -> None:
        """Refuse heights and tilts that no camera over a road has, and no three numbers."""
        height_m = self.camera_height
        tilt_deg = self.camera_tilt
        if height_m is not None:
            refuse_outside(_MIN_HEIGHT_M, _MAX_HEIGHT_M, "--camera-height", height_m, " metres")
        if tilt_deg is not None:
            refuse_outside(-_MAX_TILT_DEG, _MAX_TILT_DEG, "--camera-tilt", tilt_deg, " degrees")
        if self.known_distance is not None:
            self.parse_known_distance()

    def parse_known_distance(self) -> tuple[float, float, float]:
        """Parse ``--known-distance``, which must be set.

        Returns:
            Column and row [px] of a pixel, and its depth [m].

        Raises:
            InputError: the option holds no three numbers.
        """
        assert self.known_distance is not None
        try:
            column, row, metres = (float(word) for word in self.known_distance.split(","))
        except ValueError as error:
            raise InputError(
                f"--known-distance {self.known_distance}: write X,Y,METRES, such as 640,300,12.5"
            ) from error
        return column, row, metres


@dataclass(frozen=True, kw_only=True)
class PairMatcherOptions(MatcherOptions):
    """The settings by which the matcher of the weights runs; sgbm takes none of these."""

    left_right_check: bool = False
    """match the mirrored pair too, which makes the confidence better."""
    max_disparity: float | None = None
    """largest disparity in pixels of the images; left out, it is measured. What lies beyond is
    named, and has a confidence of 0. Only for the light matcher, that of 'default'."""


@dataclass(frozen=True, kw_only=True)
class CloudOptions:
    """The clouds that are written."""

    cloud: bool = False
    """write a coloured point cloud of what is nearer than 80 m, NAME.cloud.ply."""
    min_confidence: float = 0.0
    """smallest confidence of points in clouds, 0 to 1; the share that is left out is printed."""

    def refuse_unusable(self) -> None:
        """Refuse a confidence that is no share."""
        refuse_outside(0, 1, "--min-confidence", self.min_confidence, "; 0 leaves nothing out")


@dataclass(frozen=True, kw_only=True)
class DepthMatchOptions(CloudOptions):
    """The matcher of real pairs, their check, and the clouds that are written."""

    min_confidence: float = 0.5
    weights: WeightsName = "default"
    """weights with a matcher, by name or file."""
    matcher: WeightsName | None = None
    """what matches the two views: sgbm (OpenCV's, which needs no weights), or weights with a
    matcher, by name or file. Left out: that of the weights."""
    check: bool = True
    """refuse pairs that are swapped, not rectified or no pair; warn where this cannot be told."""


@dataclass(frozen=True, kw_only=True)
class ImageNetworkOptions:
    """The networks that answer depth of one image."""

    weights: WeightsName = "default"
    """weights with a generator, by name or file ('depthpose weights list')."""
    matcher: WeightsName | None = None
    """what matches the synthesised view: sgbm (OpenCV's), or other weights with a matcher, by name
    or file. Left out: that of the weights."""
    answer: Answer | None = None
    """own: the generator's own disparity; matched: the matcher on left and synthesised right view.
    Default: what the weights say; with --matcher, matched."""
    allow_ood: bool = False
    """also answer out-of-distribution images, with a warning (NAME.warning.txt)."""


@dataclass(frozen=True, kw_only=True)
class PredictOutput(CloudOptions):
    """The files that are written, and the number of images that go together."""

    color_range: tuple[float, float] = COLOR_RANGE_M
    """metres of the brightest and the darkest colour, the same for all pictures."""
    batch: int = 1
    """images of one size that go through the networks together: for a GPU."""

    def refuse_unusable(self) -> None:
        """Refuse colours whose depths are not in their order, and a batch without an image."""
        super().refuse_unusable()
        refuse_below(1, "--batch", self.batch, "16")
        near_m, far_m = self.color_range
        if not 0 < near_m < far_m:
            raise InputError(
                f"--color-range {near_m, far_m}: give near and far metres, near first."
            )


@dataclass(frozen=True, kw_only=True)
class DepthMethodOptions:
    """The methods that are measured; several share one table."""

    weights: tuple[WeightsName, ...] = ()
    """files or names. Weights with a generator are given the left view alone; 'both:NAME' gives
    their matcher the real right view too, 'sgbm:NAME' lets OpenCV match the synthesised one,
    'own:NAME' and 'matched:NAME' take the depth of one image from the generator, or from the
    matcher on the synthesised view; 'quick:NAME' and 'fine:NAME' are 'both:NAME' at that speed (for
    one image, give --speed)."""
    matcher: Literal["sgbm"] | None = None
    """sgbm measures OpenCV's StereoSGBM on both views, and no weights."""
    holes: Literal["fill", "leave"] = "fill"
    """sgbm's pixels without an answer: fill, as KITTI's devkit does, or leave out ('coverage' is
    then the share that was measured)."""
    predictions: Source | None = None
    """measure these files: NAME.disparity_px.npy or NAME.depth_m.npy; or the shards, path or URL,
    of 'depth predict|match --engine ray'."""
    baseline: tuple[BaselineName, ...] = ()
    """what every method must beat: rows (the best constant depth of each image row) or nearest (the
    depth of the training image that looks most alike), or both."""
    train: tuple[Path, ...] = ()
    """folders with the frames that a baseline is fitted to."""
    train_without: tuple[str, ...] = ()
    """names of frames to leave out of them."""


@dataclass(frozen=True, kw_only=True)
class ProtocolOptions:
    """The protocol by which prediction and truth are compared."""

    protocol: str = "eigen-raw"
    """name of the protocol; eigen-raw is the thesis's."""
    cap: tuple[float, ...] = (80.0, 50.0)
    """metres beyond which truth does not count; a row each."""

    def refuse_unusable(self) -> None:
        """Refuse caps that are not distances, a repeated one, and an empty list of them."""
        if not self.cap:
            raise InputError("--cap without a value: give a distance in metres, such as 80")
        for cap_m in self.cap:
            if not 0 < cap_m < math.inf:
                raise InputError(f"--cap {cap_m:g}: a distance in metres, above 0")
            if self.cap.count(cap_m) > 1:
                raise InputError(f"--cap {cap_m:g} is given twice; each cap is a row: give it once")
