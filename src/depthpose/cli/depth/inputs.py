"""Inputs of the depth commands: images, pairs and videos are listed, and read with their camera."""

import re
import sys
from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from torch import Tensor

from depthpose.cli.depth.options import LensOptions, ScaleOptions
from depthpose.core.camera import (
    Camera,
    FieldOfView,
    StereoRig,
    camera_of,
    read_camera,
    refuse_unusable_focal,
)
from depthpose.core.camera.formats.facts import camera_keys
from depthpose.core.engine import InputFormat
from depthpose.core.errors import InputError
from depthpose.core.files import (
    VIDEO_SUFFIXES,
    image_size,
    list_images,
    read_exif_focal,
    read_image,
    read_video,
)
from depthpose.core.files.disk import find_partners, refuse_equal_stems
from depthpose.core.files.images import LISTED_SUFFIXES, refuse_among_inputs
from depthpose.core.runner import Job
from depthpose.depth.types import DepthInput

IMAGES = InputFormat(roles=("image",), suffixes=LISTED_SUFFIXES)
PAIRS = InputFormat(roles=("left", "right"), suffixes=LISTED_SUFFIXES)
_SAME_FOCAL = 0.01
"""Largest relative difference of the focal lengths of images of one camera."""


def list_images_and_videos(words: Sequence[str], out: Path) -> list[Path]:
    """List the images and videos of files, folders and patterns.

    Raises:
        InputError: nothing is found, two of them would have results of one name, or ``out``, the
            folder of the results, lies among them.
    """
    sources: list[Path] = []
    for word in words:
        sources += [Path(word)] if is_video(word) else list_images(word)
    refuse_equal_stems(sources)
    stems = [path.stem for path in sources]
    for video in filter(is_video, sources):
        frame = next((stem for stem in stems if is_frame_name(stem, video)), None)
        if frame is not None:
            raise InputError(
                f"an input is called {frame!r}, as a frame of a video would be, and so would their "
                "results; rename one of the two"
            )
    refuse_among_inputs(out, words, sources)
    return sources


def list_pairs(left: str, right: str) -> list[tuple[Path, Path]]:
    """List the images of two folders or patterns, paired by their names or the numbers in them.

    Two single files are a pair, whatever their names.

    Raises:
        InputError: nothing is found, two left images have one name, or an image has no partner.
    """
    lefts = list_images(left)
    rights = list_images(right)
    refuse_equal_stems(lefts)
    left_stems = [path.stem for path in lefts]
    right_stems = [path.stem for path in rights]
    are_files = lefts == [Path(left)] and rights == [Path(right)]
    if not are_files:
        partners = find_partners(left_stems, right_stems, f"{left} and {right}")
        rights = [rights[k] for k in partners]
    return list(zip(lefts, rights, strict=True))


def is_video(path: str | Path) -> bool:
    """Whether a file is a video, by its suffix."""
    return Path(path).suffix.lower() in VIDEO_SUFFIXES


def is_frame_name(name: str, video: Path) -> bool:
    """Whether a result has the name of a frame of this video: VIDEO_000012, say."""
    return re.fullmatch(re.escape(video.stem) + r"_\d{6}", name) is not None


def select_result_names(names: Collection[str], files: Sequence[Path]) -> list[str]:
    """Select, of the names of results, those of one input: an image, a pair, or a video's frames.

    ``files``: the file or files of the input.
    """
    if is_video(files[0]):
        return sorted(name for name in names if is_frame_name(name, files[0]))
    name = files[0].stem
    return [name] if name in names else []


def read_lens(options: LensOptions, sources: Sequence[Path]) -> Camera | FieldOfView | float:
    """Read the camera of single images: a file, a field of view or a focal length [px].

    Without any of these options the focal length is that of the EXIF of ``sources``, the images.
    """
    focal_px = options.focal_px
    if focal_px is not None:
        refuse_unusable_focal(focal_px)
    if options.fov is not None:
        return FieldOfView(options.fov)
    if options.camera is None:
        return _read_exif_focal_px(sources) if focal_px is None else focal_px

    camera = read_camera(options.camera, _read_first_size(sources))
    if not isinstance(camera, StereoRig):
        return camera
    print("the camera's baseline is ignored: one image has none", file=sys.stderr)
    keys = {key: getattr(camera, key) for key in ("mount_height_m", "tilt_deg")}
    return Camera(width=camera.width, height=camera.height, K=camera.K, **keys)


def _read_exif_focal_px(sources: Sequence[Path]) -> float:
    """Read the focal length [px] on which the EXIF of all images agrees, and print it.

    Raises:
        InputError: an image has none in its EXIF (a video never has), none can be read, or two
            differ.
    """
    focal_of: dict[str, tuple[float, str]] = {}  # by file name: focal length [px], EXIF's tags
    for source in sources:
        try:
            focal = None if is_video(source) else read_exif_focal(source)
        except InputError:  # the image fails by itself, later
            continue
        if focal is None:
            raise InputError(
                f"metres from one image need its focal length, and {source.name} has none in "
                "its EXIF: give --camera FILE, --focal-px, or --fov, the angle from left to "
                "right (a phone's main camera has about 0.75 times the image's width, or 67 "
                "degrees)"
            )
        focal_of[source.name] = focal

    if not focal_of:
        raise InputError(
            "no image can be read; give --camera, --focal-px or --fov, and intact ones"
        )

    first = next(iter(focal_of))
    focal_px, tags = focal_of[first]
    for other, (other_px, _) in focal_of.items():
        if abs(other_px / focal_px - 1) > _SAME_FOCAL:
            raise InputError(
                f"the EXIF of {first} says a focal length of {focal_px:.0f} px and that of "
                f"{other} {other_px:.0f} px; predict them apart"
            )

    print(
        f"a focal length of {focal_px:.0f} px, by the EXIF of {first} ({tags}); of a cropped "
        "picture it is another",
        file=sys.stderr,
    )
    return focal_px


def _read_first_size(sources: Sequence[Path]) -> tuple[int, int] | None:
    """Read width and height [px] of the first image or video that can be read, None if none can."""
    for source in sources:
        with suppress(InputError):  # the image fails by itself, later
            if not is_video(source):
                return image_size(source)
            _, frame = next(iter(read_video(source)))
            return (frame.shape[2], frame.shape[1])
    return None


@dataclass(frozen=True, kw_only=True)
class InputReader:
    """Reads images, frames of videos and pairs, with their camera, for the estimator."""

    camera: Camera | FieldOfView | float  #: of images (a number: focal length [px]); rig of pairs
    #: known lengths; height and tilt take the place of the camera's
    scale: ScaleOptions = field(default_factory=ScaleOptions)
    files: InputFormat = IMAGES  #: what an input consists of

    def make_jobs(self, files: Sequence[Path]) -> Iterator[Job[DepthInput]]:
        """Make the job of an image or a pair, or the jobs of all frames of a video."""
        if not is_video(files[0]):
            name = files[0].stem
            yield Job(name=name, read=partial(self.read_input, name, *files))
            return
        for name, frame in read_video(files[0]):
            yield Job(name=name, read=partial(self._make_input, name, frame))

    def read_input(self, name: str, left: Path, right: Path | None = None) -> DepthInput:
        """Read an image or a pair.

        Raises:
            InputError: a file cannot be read.
        """
        image = read_image(left)
        depth_input = self._make_input(name, image)
        return depth_input if right is None else replace(depth_input, right=read_image(right))

    def _make_input(self, name: str, image: Tensor) -> DepthInput:
        """Make the input of one image, with the camera of its size."""
        height, width = image.shape[1:]
        camera = camera_of(self.camera, (width, height))
        assert camera is not None
        if self.scale.camera_height is not None:
            camera = replace(camera, mount_height_m=self.scale.camera_height)
        if self.scale.camera_tilt is not None:
            camera = replace(camera, tilt_deg=self.scale.camera_tilt)
        return DepthInput(name=name, left=image, right=None, camera=camera)

    def camera_settings(self) -> dict[str, Any]:
        """List the JSON values of the camera, and of the lengths that set the scale."""
        if isinstance(self.camera, FieldOfView):
            camera: dict[str, Any] = {"fov_deg": self.camera.degrees}
        elif isinstance(self.camera, StereoRig):
            camera = {
                "K": self.camera.K.tolist(),
                "baseline_m": self.camera.baseline_m,
                "cx_right_minus_left_px": self.camera.cx_right_minus_left_px,
            }
        elif isinstance(self.camera, Camera):
            keys = camera_keys(self.camera)
            camera = {key: keys[key] for key in ("K", "mount_height_m", "tilt_deg") if key in keys}
        else:
            camera = {"focal_px": self.camera}
        scale = asdict(self.scale)
        return camera | {key: value for key, value in scale.items() if value not in (None, False)}
