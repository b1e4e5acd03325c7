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
from depthpose.report.page import Scale, Scene


@dataclass(frozen=True, kw_only=True, eq=False)
class Shown:
    """A picture among the files, with what its colours mean.

    ``values``: file with a number for each pixel, which the page shows under the pointer.
    """

    file: str
    caption: str
    values: str | None = None
    unit: str = ""
    scale: Scale | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Answer:
    """An estimate, or a refusal: a sentence and what is shown below it, and files to download.

    ``terms``: of the weights, where they restrict use.
    """

    is_ok: bool
    sentence: str
    facts: Sequence[tuple[str, str]]
    scene: Scene
    terms: str = ""
    tables: Mapping[str, Sequence[Sequence[str]]] = field(default_factory=dict)
    pictures: Sequence[Shown] = ()
    files: Mapping[str, bytes] = field(default_factory=dict)


MOST_PIXELS = 12_500_000  # most pixels of a picture: those of a phone's
KINDS: dict[str, tuple[str, tuple[str, ...]]] = {
    "image": ("a picture", LISTED_SUFFIXES),
    "right": ("a picture", LISTED_SUFFIXES),
    "depth": ("a depth image", DEPTH_SUFFIXES),
    "mask": ("a mask", LISTED_SUFFIXES),
    "camera": ("a camera file", CAMERA_SUFFIXES),
    "cloud": ("a point cloud", tuple(CLOUD_READERS)),
    "cad": ("a model file", tuple(MESH_READERS)),
}
"""What each field of the forms takes."""

_FIELDS = "the camera fields"
_LONGEST_NAME = 60


@dataclass(frozen=True, kw_only=True)
class Form:
    """Fields as typed, and files, of one request, whose folder is removed with it."""

    folder: Path
    fields: Mapping[str, str]
    files: Mapping[str, Path]

    def file(self, field: str) -> Path:
        """Give the file of a field."""
        if field not in self.files:
            what, suffixes = KINDS[field]
            raise InputError(f"{field}: no file; choose {what} ({', '.join(suffixes)})")
        return self.files[field]

    def number(self, field: str) -> float | None:
        """Give the number of a field; None where it was left empty."""
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

    def camera(self, keys: Mapping[str, Any], size: tuple[int, int] | None = None) -> Camera:
        """Read the camera file that was sent, or make a camera of the fields."""
        if "camera" in self.files:
            return read_camera(self.files["camera"], size)
        path = self.folder / _FIELDS
        # The same way as a file, so that the same mistakes are found.
        write_json(path, {k: v for k, v in keys.items() if v is not None})
        return read_camera(path)

    def pinhole_keys(self, size: tuple[int, int], focal_px: float | None) -> dict[str, Any]:
        """Give size and K of a camera from the fields; the principal point may be the centre."""
        cx = self.number("cx_px")
        cy = self.number("cy_px")
        cx = (size[0] - 1) / 2 if cx is None else cx
        cy = (size[1] - 1) / 2 if cy is None else cy
        K = [[focal_px, 0.0, cx], [0.0, focal_px, cy], [0.0, 0.0, 1.0]]
        return {"width": size[0], "height": size[1], "K": K}


def without_paths(text: str, folder: Path) -> str:
    """Take this machine's folders out of a message: a user knows the names of the files."""
    fields = "|".join(KINDS)
    return re.sub(f"{re.escape(str(folder))}/(({fields})/)?", "", text)


def refuse_large(name: str, width: int, height: int) -> None:
    """Refuse a picture or map of more pixels than this page takes."""
    if width * height > MOST_PIXELS:
        raise InputError(
            f"{name} has {width}x{height} pixels, more than the {MOST_PIXELS / 1e6:g} million "
            "that this page takes; scale it down, or use the command line"
        )


def keep_file(folder: Path, field: str, sent_name: str, data: bytes) -> Path:
    """Write an uploaded file, under its own name where that is harmless."""
    if field not in KINDS:
        raise InputError(f"{field!r} is no file field of this page; known are {', '.join(KINDS)}")
    what, suffixes = KINDS[field]
    # ASCII alone: results bear the name too, and go into the header of an answer.
    name = re.sub(r"[^A-Za-z0-9_.-]+", "_", sent_name.replace("\\", "/").rpartition("/")[2])
    path = Path(name.lstrip(".-"))
    if path.suffix.lower() not in suffixes or not path.stem:
        raise InputError(
            f"{field}: {sent_name!r} is not {what}; this field takes {', '.join(suffixes)}"
        )
    path_of_copy = folder / field / f"{path.stem[:_LONGEST_NAME]}{path.suffix}"
    write_bytes(path_of_copy, data)
    return path_of_copy


EXAMPLE_SEED = 9  # no weights were trained on streets or views of this seed


def example_form(folder: Path, fields: dict[str, str]) -> dict[str, Any]:
    """Give the content of a form as the page takes it; each file is named after its field."""
    files = [
        {"field": p.stem, "name": f"example-{p.name}", "data": b64encode(p.read_bytes()).decode()}
        for p in sorted(folder.iterdir())
    ]
    return {"files": files, "fields": fields}
