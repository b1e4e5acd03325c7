"""Reading and writing of videos, frame by frame, by OpenCV (the extra ``opencv``)."""

import math
import warnings
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from depthpose.core.errors import InputError, Notice, import_opencv
from depthpose.core.files.disk import AnyPath, atomic_write, make_suffix_error
from depthpose.core.files.images import MAX_PIXELS

VIDEO_SUFFIXES = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v")
"""Suffixes of files that are taken for a video."""

_NO_VIDEO = "not a video that OpenCV can decode; convert it to MP4 (H.264)"
_CODECS = {".mp4": "vp09", ".avi": "MJPG"}  # VP9: OpenCV's own wheels have no H.264


@dataclass(frozen=True, kw_only=True)
class Video:
    """A video on disk. Iterating decodes it anew from its first frame, one frame at a time."""

    path: Path  #: the file
    fps: float  #: frames a second
    frames: int  #: number of frames, as the file's header says; 0 where it does not
    size: tuple[int, int]  #: width and height of a frame, once its pixels are square [px]

    def __iter__(self) -> Iterator[tuple[str, Float[Tensor, "3 h w"]]]:
        """Yield the name (``STEM_000000``, ``STEM_000001``, ...) and RGB in [0, 1] of each frame.

        Raises:
            InputError: not one frame can be decoded.

        Warns:
            Notice: there are fewer frames than the file's header says.
        """
        cv2 = import_opencv("reading a video")
        capture = cv2.VideoCapture(str(self.path))
        if not capture.isOpened():
            raise InputError(f"{self.path}: {_NO_VIDEO}")
        index = 0
        try:
            while True:
                is_read, blue_green_red = capture.read()
                if not is_read:
                    break
                if blue_green_red.shape[1::-1] != self.size:  # pixels that are not square
                    blue_green_red = cv2.resize(blue_green_red, self.size)
                red_green_blue = np.ascontiguousarray(blue_green_red[..., ::-1])
                image = torch.from_numpy(red_green_blue).permute(2, 0, 1).float() / 255
                yield f"{self.path.stem}_{index:06d}", image
                index += 1
        finally:
            capture.release()
        if index == 0:
            raise InputError(f"{self.path}: {_NO_VIDEO}")
        if index < self.frames:
            message = (
                f"{self.path}: ends after {index} of the {self.frames} frames that its header "
                "says; the next one cannot be decoded, so the file is damaged or cut off"
            )
            warnings.warn(message, Notice, stacklevel=2)


def read_video(path: AnyPath) -> Video:
    """Open a video, decoding only its first frame.

    If the file says that pixels are not square, frames are stretched until they are, in width or in
    height.

    Raises:
        InputError: no such file, no video, or not one frame can be decoded.
        MissingExtraError: OpenCV is not installed.

    Warns:
        Notice: frames are stretched.
    """
    path = Path(path)
    if path.suffix.lower() not in VIDEO_SUFFIXES:
        raise make_suffix_error(path, "video", VIDEO_SUFFIXES)
    cv2 = import_opencv("reading a video")
    if not path.is_file():  # OpenCV would take a pattern, an address or a camera's number too
        raise InputError(f"{path}: no such file; check the path")
    capture = cv2.VideoCapture(str(path))
    if not capture.isOpened():
        raise InputError(f"{path}: {_NO_VIDEO}")

    fps = capture.get(cv2.CAP_PROP_FPS)
    frames = capture.get(cv2.CAP_PROP_FRAME_COUNT)
    pixel_width = capture.get(cv2.CAP_PROP_SAR_NUM)
    pixel_height = capture.get(cv2.CAP_PROP_SAR_DEN)
    is_read, first_frame = capture.read()
    capture.release()
    if not is_read or not 0 < fps < math.inf:
        raise InputError(f"{path}: {_NO_VIDEO}")

    # Pixels that are not square: frames become so large that they are.
    height, width = first_frame.shape[:2]
    size = (width, height)
    if pixel_width > 0 and pixel_height > 0 and pixel_width != pixel_height:
        aspect = pixel_width / pixel_height
        size = (round(width * max(aspect, 1)), round(height * max(1 / aspect, 1)))
        message = (
            f"{path}: its pixels are {pixel_width:g}:{pixel_height:g}, so frames of "
            f"{width}x{height} become {size[0]}x{size[1]}; a focal length or camera is taken to be "
            "of that size"
        )
        warnings.warn(message, Notice, stacklevel=2)
    if size[0] * size[1] > MAX_PIXELS:
        raise InputError(f"{path}: frames of {size[0]}x{size[1]}; scale it down")
    return Video(path=path, fps=float(fps), frames=max(0, int(frames)), size=size)


def write_video(path: AnyPath, images: Iterable[Float[Tensor, "3 _ _"]], fps: float) -> int:
    """Write RGB images in [0, 1] as a video, whole or not at all, and count its frames.

    Args:
        path: ``.mp4`` (VP9, which browsers play) or ``.avi`` (motion JPEG). An OpenCV without
            VP9 writes MPEG-4 in its place, with a :class:`Notice`.
        images: the frames, all of one size; taken one at a time.
        fps: frames a second.

    Returns:
        The number of frames.

    Raises:
        InputError: another suffix, no frame, frames of two sizes, or the encoder refuses.
        MissingExtraError: OpenCV is not installed.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in _CODECS:
        raise make_suffix_error(path, "writable video", tuple(_CODECS))
    if not 0 < fps < math.inf:
        raise InputError(f"{path}: fps is {fps:g}, but a video has a positive rate; give, say, 10")
    cv2 = import_opencv("writing a video")

    writer = None
    first_size = (0, 0)
    count = 0
    with atomic_write(path) as part:
        try:
            for image in images:
                size = (image.shape[2], image.shape[1])
                if writer is None:
                    first_size = size
                    writer = _open_writer(cv2, path, part, fps, size)
                if size != first_size:
                    raise InputError(
                        f"{path}: frame {count} is {size[0]}x{size[1]}, but the first one is "
                        f"{first_size[0]}x{first_size[1]}; a video has one size"
                    )
                pixels = image.detach().cpu().clamp(0, 1).mul(255).round().byte().permute(1, 2, 0)
                blue_green_red = np.ascontiguousarray(pixels.numpy()[..., ::-1])
                writer.write(blue_green_red)
                count += 1
        finally:
            if writer is not None:
                writer.release()
        # The encoder does not report a full disk, so the frames of the file are counted.
        readable = _count_frames(cv2, part)
        if count == 0 or readable != count:
            raise InputError(
                f"{path}: the encoder wrote {readable} of {count} frames; free the space if the "
                "disk is full, else try .avi, or PNGs"
            )
    return count


def _open_writer(
    cv2: Any,  # noqa: ANN401  OpenCV's classes carry no types
    path: AnyPath,
    part: Path,
    fps: float,
    size: tuple[int, int],
) -> Any:  # noqa: ANN401
    """Open OpenCV's encoder to a file; without VP9 it is MPEG-4, with a notice.

    Args:
        cv2: OpenCV.
        path: what the notice calls the file.
        part: the file that is written.
        fps: frames a second.
        size: width and height of the frames [px].
    """
    codec = cv2.VideoWriter_fourcc(*_CODECS[part.suffix.lower()])
    writer = cv2.VideoWriter(str(part), codec, float(fps), size)
    if part.suffix.lower() == ".mp4" and not writer.isOpened():
        message = "OpenCV encodes no VP9 here, so it is MPEG-4, which no browser plays"
        warnings.warn(f"{path}: {message}", Notice, stacklevel=3)
        codec = cv2.VideoWriter_fourcc(*"mp4v")
        writer = cv2.VideoWriter(str(part), codec, float(fps), size)
    return writer


def _count_frames(cv2: Any, path: Path) -> int:  # noqa: ANN401
    """Count the frames of a video that can be read; 0 where the file is missing or empty."""
    if not path.is_file() or not path.stat().st_size:
        return 0
    capture = cv2.VideoCapture(str(path))
    count = 0
    while capture.isOpened() and capture.grab():
        count += 1
    capture.release()
    return count
