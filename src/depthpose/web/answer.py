"""A checked form that a browser sent, and what the page shows of one estimate."""

import math
import re
from base64 import b64encode
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from depthpose.core.camera import CAMERA_SUFFIXES, Camera, read_camera
from depthpose.core.errors import InputError
from depthpose.core.files import CLOUD_READERS, DEPTH_SUFFIXES, write_json
from depthpose.core.files.disk import write_bytes
from depthpose.core.files.images import LISTED_SUFFIXES
from depthpose.pose.mesh import MESH_READERS
from depthpose.report.page import ColorBar, Scene


@dataclass(frozen=True, kw_only=True, eq=False)
class ShownPicture:
    """A picture that the page shows; its files are among those of the answer."""

    file: str  #: name of the picture's file
    caption: str
    values: str | None = None  #: file with a number for each pixel, shown under the pointer
    unit: str = ""  #: unit of these numbers
    scale: ColorBar | None = None  #: what the colours mean; None: they are no numbers


@dataclass(frozen=True, kw_only=True, eq=False)
class Answer:
    """An estimate or a refusal, as the page shows it, with files to download."""

    is_ok: bool  #: neither refused nor warned of
    sentence: str  #: the result, or why there is none, in words
    facts: Sequence[tuple[str, str]]  #: names and values
    scene: Scene  #: the 3D view
    terms: str = ""  #: terms of the weights, where they restrict use
    tables: Mapping[str, Sequence[Sequence[str]]] = field(default_factory=dict)  #: by captions
    pictures: Sequence[ShownPicture] = ()
    files: Mapping[str, bytes] = field(default_factory=dict)  #: by names


MAX_PIXELS = 12_500_000
"""Most pixels of a picture that is sent: those of a phone's camera."""
FILE_FIELDS: dict[str, tuple[str, tuple[str, ...]]] = {
    "image": ("a picture", LISTED_SUFFIXES),
    "right": ("a picture", LISTED_SUFFIXES),
    "depth": ("a depth image", DEPTH_SUFFIXES),
    "mask": ("a mask", LISTED_SUFFIXES),
    "empty_frame": ("a depth image", DEPTH_SUFFIXES),
    "camera": ("a camera file", CAMERA_SUFFIXES),
    "cloud": ("a point cloud", tuple(CLOUD_READERS)),
    "cad": ("a model file", tuple(MESH_READERS)),
}
"""The files that each field of the forms takes: in words, and their suffixes."""

_CAMERA_OF_FIELDS = "the camera fields"
"""Name of the file that is written of these fields, as errors show it."""
_MAX_NAME_LENGTH = 60
"""Characters of the name that a file keeps."""


@dataclass(frozen=True, kw_only=True)
class Form:
    """Fields and files of one request."""

    folder: Path  #: of the request, deleted when it is answered
    fields: Mapping[str, str]  #: as typed, by the fields' names
    files: Mapping[str, Path]  #: those sent, by the fields' names

    def require_file(self, field: str) -> Path:
        """Return the path of a field's file.

        Raises:
            InputError: none was sent.
        """
        if field not in self.files:
            noun, suffixes = FILE_FIELDS[field]
            raise InputError(f"{field}: no file; choose {noun} ({', '.join(suffixes)})")
        return self.files[field]

    def read_number(self, field: str) -> float | None:
        """Read the number of a field; None where it was left empty.

        Raises:
            InputError: it is no finite number.
        """
        text = self.fields.get(field, "").strip()
        if not text:
            return None
        try:
            value = float(text.replace(",", "."))
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise InputError(f"{field} is {text!r}; write a number such as 0.5")
        return value

    def make_camera(self, keys: Mapping[str, Any], size: tuple[int, int] | None = None) -> Camera:
        """Read the camera file that was sent, or make a camera of fields.

        Args:
            keys: keys and values of a camera file, from the fields; a value of None was left empty.
            size: width and height of the image [px], for a camera file without them.

        Raises:
            InputError: the file or the values are no camera.
        """
        if "camera" in self.files:
            return read_camera(self.files["camera"], size)
        # Written and read as a file is, so that the same mistakes are found.
        path = self.folder / _CAMERA_OF_FIELDS
        write_json(path, {key: value for key, value in keys.items() if value is not None})
        return read_camera(path)

    def make_pinhole_keys(self, size: tuple[int, int], focal_px: float | None) -> dict[str, Any]:
        """Make the keys and values of a camera file for size and K.

        An empty principal point is the centre. ``size``: width and height of the image [px].
        """
        cx = self.read_number("cx_px")
        cy = self.read_number("cy_px")
        cx = (size[0] - 1) / 2 if cx is None else cx
        cy = (size[1] - 1) / 2 if cy is None else cy
        K = [[focal_px, 0.0, cx], [0.0, focal_px, cy], [0.0, 0.0, 1.0]]
        return {"width": size[0], "height": size[1], "K": K}


def remove_paths(text: str, folder: Path) -> str:
    """Remove the folder of a request from a message, so that files have their own names in it."""
    fields = "|".join(FILE_FIELDS)
    return re.sub(f"{re.escape(str(folder))}/(({fields})/)?", "", text)


def refuse_large(name: str, width: int, height: int) -> None:
    """Refuse a picture or map of more pixels than this page takes.

    Raises:
        InputError: it has more; ``name`` is its name in the message.
    """
    if width * height > MAX_PIXELS:
        raise InputError(
            f"{name} has {width}x{height} pixels, more than the {MAX_PIXELS / 1e6:g} million "
            "that this page takes; scale it down, or use the command line"
        )


def write_upload(folder: Path, field: str, sent_name: str, data: bytes) -> Path:
    """Write an uploaded file into the folder of a request, and return its path.

    It keeps its name, shortened and without characters that are not safe in names.

    Raises:
        InputError: the field takes no files, or none of this suffix.
    """
    if field not in FILE_FIELDS:
        raise InputError(
            f"{field!r} is no file field of this page; known are {', '.join(FILE_FIELDS)}"
        )
    noun, suffixes = FILE_FIELDS[field]
    # ASCII alone: results bear the name too, and go into the header of an answer.
    name = re.sub(r"[^A-Za-z0-9_.-]+", "_", sent_name.replace("\\", "/").rpartition("/")[2])
    path = Path(name.lstrip(".-"))
    if path.suffix.lower() not in suffixes or not path.stem:
        raise InputError(
            f"{field}: {sent_name!r} is not {noun}; this field takes {', '.join(suffixes)}"
        )
    written = folder / field / f"{path.stem[:_MAX_NAME_LENGTH]}{path.suffix}"
    write_bytes(written, data)
    return written


EXAMPLE_SEED = 9
"""Seed of streets and views that no weights were trained on."""


def encode_example(folder: Path, fields: dict[str, str]) -> dict[str, Any]:
    """Encode the content of a form as JSON by which the page fills it.

    Args:
        folder: its files, whose stems are the names of the file fields.
        fields: values of the other fields by their names.
    """
    files: list[dict[str, str]] = []
    for path in sorted(folder.iterdir()):
        data = b64encode(path.read_bytes()).decode()
        files.append({"field": path.stem, "name": f"example-{path.name}", "data": data})
    return {"files": files, "fields": fields}
