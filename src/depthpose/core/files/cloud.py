"""Point clouds: PLY, PCD, NPY, text and KITTI's binary scans."""

import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from io import BytesIO, TextIOWrapper
from itertools import chain, islice
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

from depthpose.core.errors import InputError, import_extra
from depthpose.core.files.disk import (
    MAX_TEXT_BYTES,
    AnyPath,
    read_bytes,
    refused_as,
    refused_suffix,
    write_bytes,
)
from depthpose.core.files.images import read_npy, to_float32
from depthpose.core.files.points import (
    Columns,
    encode_pcd,
    encode_ply,
    parse_rows,
    plain_numbers,
    read_pcd,
    read_ply_elements,
)

_ENCODERS = {".ply": encode_ply, ".pcd": encode_pcd}
_COLOR = ("red", "green", "blue")
_PARTS = re.compile(r"[\s,;]+")
_LOOKED_AT = 100  # rows by which a table is understood
_MOST_COLUMNS = 12  # of so few rows that more are points, side by side
_MAX_SCAN_BYTES = 2**26  # largest scan of a LiDAR that is read, thirty times KITTI's


@dataclass(frozen=True, kw_only=True, eq=False)
class Cloud:
    """Points as a file holds them: its unit and frame are known to the caller alone."""

    points: Float32[Tensor, "n 3"]  #: coordinates
    color: Float32[Tensor, "n 3"] | None = None  #: RGB in [0, 1], one a point, or None

    def to_open3d(self) -> Any:  # noqa: ANN401  Open3D's classes carry no types
        """Give the same points, and colours where there are, as ``open3d.geometry.PointCloud``.

        Raises:
            MissingExtraError: Open3D is not installed.
        """
        open3d = import_extra("open3d", "open3d", "open3d", "a cloud of Open3D")
        cloud = open3d.geometry.PointCloud()
        cloud.points = open3d.utility.Vector3dVector(self.points.double().cpu().numpy())
        if self.color is not None:
            cloud.colors = open3d.utility.Vector3dVector(self.color.double().cpu().numpy())
        return cloud


def read_cloud(path: AnyPath) -> Cloud:
    """Read a point cloud: ``.ply``, ``.pcd``, ``.npy`` or text (``.xyz``, ``.txt``).

    NPY and text hold a point a row. Columns after the third are ignored, and so is a first column
    that numbers the points. Text may begin with a line of column names (``x y z`` among them) or
    with the number of points, and may have decimal commas if blanks or semicolons separate the
    numbers. Points with a NaN coordinate, as organised clouds have without a reading, are left out.

    Raises:
        InputError: the file is missing, damaged, without x, y and z, or no point is finite; a
            coordinate is infinite; a colour is out of range.
    """
    reader = CLOUD_READERS.get(Path(path).suffix.lower())
    if reader is None:
        raise refused_suffix(path, "point cloud", tuple(CLOUD_READERS))
    return reader(path)


def write_cloud(path: AnyPath, cloud: Cloud) -> None:
    """Write a point cloud as binary ``.ply`` or ``.pcd``, colours in 8 bits.

    Raises:
        InputError: a coordinate or colour is not finite, the suffix is another, the disk refuses.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in _ENCODERS:
        raise refused_suffix(path, "written point cloud", tuple(_ENCODERS))
    points = cloud.points.detach().cpu().numpy()
    color = None if cloud.color is None else cloud.color.detach().cpu().numpy()
    if not np.isfinite(points).all() or (color is not None and not np.isfinite(color).all()):
        raise InputError(f"{path}: the cloud holds NaN or infinity; leave those points out")
    rgb = None if color is None else np.rint(color.clip(0, 1) * 255).astype(np.uint8)
    write_bytes(path, _ENCODERS[suffix](points, rgb))


def read_points_bin(path: AnyPath, columns: int = 4) -> Float32[Tensor, "n columns"]:
    """Read rows of little-endian float32, as KITTI's Velodyne scans (x, y, z, reflectance).

    Raises:
        InputError: the file is missing, empty, no whole number of rows, or not finite.
    """
    data = read_bytes(path, _MAX_SCAN_BYTES)
    if columns < 1 or not data or len(data) % (4 * columns):
        raise InputError(
            f"{path}: {len(data)} bytes are no whole number of rows of {columns} float32; it is "
            "empty, truncated or of another format"
        )
    rows = to_float32(np.frombuffer(data, "<f4").reshape(-1, columns))
    if not np.isfinite(rows).all():
        raise InputError(f"{path}: holds NaN or infinity; it is damaged or of another format")
    return torch.from_numpy(rows)


def _from_columns(path: AnyPath, columns: Columns) -> Cloud:
    """Make a cloud of columns x, y, z and perhaps colours; rows with NaN are left out.

    Colours are packed as PCL packs them (``rgb``, ``rgba``), or a column each.
    """
    missing = [name for name in "xyz" if name not in columns]
    if missing and columns:
        raise InputError(f"{path}: no {missing} among the columns {list(columns)}; name them x y z")
    points = np.empty((0, 3), np.float32)
    if columns:
        points = np.stack([to_float32(columns[name]) for name in "xyz"], -1)
    packed = columns.get("rgb", columns.get("rgba"))
    color = None
    if packed is not None and packed.dtype.itemsize == 4:
        if packed.dtype.kind == "f":
            bits = packed.astype(np.float32).view(np.uint32)
        else:
            bits = packed.astype(np.int64).astype(np.uint32)
        color = to_float32(
            np.stack([(bits >> shift) & 255 for shift in (16, 8, 0)], -1).astype(np.uint8)
        ) / np.float32(255)
    elif columns.keys() >= set(_COLOR):
        color = np.stack([columns[name] for name in _COLOR], -1)
        if color.dtype.kind != "f":
            color = color / np.iinfo(color.dtype).max
        if not ((color >= 0) & (color <= 1)).all():
            raise InputError(f"{path}: colours beyond [0, 1]; store floats in [0, 1], or uchar")
        color = to_float32(color)
    if np.isinf(points).any():
        raise InputError(f"{path}: a coordinate is infinite or beyond float32; leave it out")
    is_complete = ~np.isnan(points).any(-1)
    if not is_complete.any():
        raise InputError(f"{path}: {len(points)} points, none with finite coordinates; give some")
    return Cloud(
        points=torch.from_numpy(points[is_complete]),
        color=None if color is None else torch.from_numpy(color[is_complete]),
    )


def _from_rows(path: AnyPath, table: np.ndarray) -> Cloud:
    """Make a cloud of a table without names, whose first column may number the rows."""
    if table.ndim != 2 or table.shape[1] < 3:
        raise InputError(f"{path}: points are rows of 3 numbers or more, got shape {table.shape}")
    if len(table) < 5 and table.shape[1] > _MOST_COLUMNS:
        raise InputError(
            f"{path}: {len(table)} rows of {table.shape[1]} numbers, where each row is a point; "
            "save the transpose (array.T)"
        )
    # Columns that number the points, or say where in an image they were, are no coordinates.
    with np.errstate(invalid="ignore"):
        is_whole = (table[:_LOOKED_AT] == np.trunc(table[:_LOOKED_AT])).all(0)
        steps = np.diff(table[:, 0])
    is_long = table.shape[1] > 3 and len(table) > 3 and bool(is_whole[0])
    if is_long and table.shape[1] > 4 and is_whole[1] and not is_whole[2:5].any():
        raise InputError(
            f"{path}: rows begin by two whole numbers ({table[0, 0]:g} and {table[0, 1]:g}), which "
            "look like a pixel's place; leave them out, or name the columns in a first line "
            "(u v x y z)"
        )
    counts = (steps > 0).all() and ((steps == 1).all() or not is_whole[1:4].any())
    first = int(is_long and counts)
    return _from_columns(path, {axis: table[:, first + k] for k, axis in enumerate("xyz")})


def _read_text(path: AnyPath) -> Cloud:
    """Read a cloud of text: rows of numbers, perhaps below names, a count or comments."""
    text = TextIOWrapper(BytesIO(read_bytes(path, MAX_TEXT_BYTES)), "utf-8-sig")
    noted: list[str] = []
    rows = _rows_of(text, noted)
    with refused_as(path, "text", "save it as UTF-8"):
        head = list(islice(rows, _LOOKED_AT))
    names: list[str] = []
    first, *comments = (
        [word.strip("\"'").lower() for word in _PARTS.split(line.strip())]
        for line in (head[0] if head else "", *noted)
    )
    try:
        list(map(float, filter(None, first)))
    except ValueError:  # no row of numbers
        names = first
    if names and not set("xyz") <= set(names):
        raise InputError(
            f"{path}: begins by {head[0][:60]!r}, neither numbers nor names of columns with x, y "
            "and z; take that line out"
        )
    head = head[1:] if names else head
    is_count = len(head) > 1 and head[0].isdecimal() and len(_PARTS.split(head[1])) > 2
    count = int(head[0]) if is_count else None
    body = head[1:] if is_count else head
    width = len(_PARTS.split(body[0])) if body else 0
    if not names:
        fitting = (words for words in comments if len(words) == width and set("xyz") <= set(words))
        names = next(fitting, [])
    rows = chain(body, rows)
    table = parse_rows(path, map(_blank_separated(path, body, names), rows))
    if count not in (None, len(table)):
        raise InputError(f"{path}: declares {count} points but {len(table)} rows follow")
    if not names:
        return _from_rows(path, table)
    if table.shape[1] != len(names):
        raise InputError(f"{path}: names {len(names)} columns, but rows have {table.shape[1]}")
    return _from_rows(path, table[:, [names.index(axis) for axis in "xyz"]])


def _rows_of(text: Iterable[str], noted: list[str]) -> Iterator[str]:
    """Give rows without comments; comments before the first row are added to ``noted``."""
    is_begun = False
    for line in text:
        if line.isspace():
            continue
        row, _, comment = plain_numbers(line).partition("#")
        if row.lstrip().startswith("//"):
            comment = row.strip().removeprefix("//")
            row = ""
        if row := row.strip():
            is_begun = True
            yield row
        elif not is_begun:
            noted.append(comment)


def _blank_separated(path: AnyPath, head: list[str], names: list[str]) -> Callable[[str], str]:
    """Tell from the first rows what commas mean; give a function that blanks separators."""
    text = " ".join(head)
    words = [re.split(r"[\s;]+", row.strip(" ;,")) for row in head]
    commas = [word.rstrip(",").count(",") for row in words for word in row]
    most = max(commas, default=0)
    is_decimal = most == 1 and all(len(row) > 2 for row in words)
    if most == 1 and "." not in text:
        return lambda row: re.sub(r",(?=\s|$)|;", " ", row).replace(",", ".")
    # Of 0,1,0,2,0,7 nobody knows whether there are six numbers or three.
    is_both = not names and most > 4 and most % 2 == 1 and "." not in text
    if (is_decimal and min(commas) == 1) or is_both:
        raise InputError(
            f"{path}: commas may part numbers or be decimal signs ({head[-1][:60]!r}); save it "
            "with decimal points, or with a first line of names (x,y,z,...)"
        )
    return lambda row: row.replace(",", " ").replace(";", " ")


CLOUD_READERS: dict[str, Callable[[AnyPath], Cloud]] = {
    ".ply": lambda path: _from_columns(path, read_ply_elements(path, "vertex")[0]),
    ".pcd": lambda path: _from_columns(path, read_pcd(path)),
    ".npy": lambda path: _from_rows(path, read_npy(path)),
    ".xyz": _read_text,
    ".txt": _read_text,
}
"""Suffix to reader: one more entry, and every command, folder and page takes the new format."""
