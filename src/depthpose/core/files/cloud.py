"""Reading and writing of point clouds: PLY, PCD, NPY, text and KITTI's binary scans."""

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
    make_suffix_error,
    read_bytes,
    refused_as,
    write_bytes,
)
from depthpose.core.files.images import read_npy, to_float32
from depthpose.core.files.points import (
    Columns,
    encode_pcd,
    encode_ply,
    parse_rows,
    read_pcd,
    read_ply_elements,
    spell_nan,
)

_ENCODERS = {".ply": encode_ply, ".pcd": encode_pcd}
_COLOR_NAMES = ("red", "green", "blue")
_SEPARATORS = re.compile(r"[\s,;]+")
_INSPECTED_ROWS = 100  # first rows of a table, by which its layout is recognised
# A table of fewer rows and more columns is taken to be transposed.
_LEAST_ROWS = 5
_MAX_COLUMNS = 12
_MAX_SCAN_BYTES = 2**26  # largest scan of a LiDAR that is read, thirty times KITTI's


@dataclass(frozen=True, kw_only=True, eq=False)
class PointCloud:
    """Points as a file has them, in a unit and a frame that it does not say."""

    points: Float32[Tensor, "n 3"]  #: coordinates
    color: Float32[Tensor, "n 3"] | None = None  #: RGB in [0, 1], one a point, or None

    def to_open3d(self) -> Any:  # noqa: ANN401  Open3D's classes carry no types
        """Convert points, and colours where there are any, to ``open3d.geometry.PointCloud``.

        Raises:
            MissingExtraError: Open3D is not installed.
        """
        open3d = import_extra("open3d", "open3d", "open3d", "a cloud of Open3D")
        cloud = open3d.geometry.PointCloud()
        cloud.points = open3d.utility.Vector3dVector(self.points.double().cpu().numpy())
        if self.color is not None:
            cloud.colors = open3d.utility.Vector3dVector(self.color.double().cpu().numpy())
        return cloud


def read_cloud(path: AnyPath) -> PointCloud:
    """Read a point cloud: ``.ply``, ``.pcd``, ``.npy`` or text (``.xyz``, ``.txt``).

    NPY and text have one point a row. Columns after x, y and z are ignored, and so is a first
    column that numbers the points. Text may begin with a line of column names (``x y z`` among
    them) or with the number of points, and may have decimal commas if blanks or semicolons separate
    the numbers. Points with a NaN coordinate are left out: in organised clouds these are pixels
    without a reading.

    Raises:
        InputError: the file is missing, damaged, without x, y and z, or no point is finite; a
            coordinate is infinite; a colour is out of range.
    """
    reader = CLOUD_READERS.get(Path(path).suffix.lower())
    if reader is None:
        raise make_suffix_error(path, "point cloud", tuple(CLOUD_READERS))
    return reader(path)


def write_cloud(path: AnyPath, cloud: PointCloud) -> None:
    """Write a point cloud as binary ``.ply`` or ``.pcd``, colours in 8 bits.

    Raises:
        InputError: a coordinate or colour is not finite, the suffix is another, the disk refuses.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in _ENCODERS:
        raise make_suffix_error(path, "written point cloud", tuple(_ENCODERS))
    points = cloud.points.detach().cpu().numpy()
    color = None if cloud.color is None else cloud.color.detach().cpu().numpy()
    if not np.isfinite(points).all() or (color is not None and not np.isfinite(color).all()):
        raise InputError(f"{path}: the cloud holds NaN or infinity; leave those points out")
    rgb = None if color is None else np.rint(color.clip(0, 1) * 255).astype(np.uint8)
    write_bytes(path, _ENCODERS[suffix](points, rgb))


def read_points_bin(path: AnyPath, columns: int = 4) -> Float32[Tensor, "n columns"]:
    """Read rows of little-endian float32, such as KITTI's Velodyne scans (x, y, z, reflectance).

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


def _cloud_from_columns(path: AnyPath, columns: Columns) -> PointCloud:
    """Make a cloud of columns x, y, z and perhaps colours; points with NaN are left out.

    Raises:
        InputError: a column is missing, a coordinate is infinite, or no point is finite.
    """
    # A file without points may have no columns.
    missing = [name for name in "xyz" if name not in columns]
    if missing and columns:
        raise InputError(f"{path}: no {missing} among the columns {list(columns)}; name them x y z")
    points = np.empty((0, 3), np.float32)
    if columns:
        points = np.stack([to_float32(columns[name]) for name in "xyz"], -1)
    color = _color_from_columns(path, columns)
    if np.isinf(points).any():
        raise InputError(f"{path}: a coordinate is infinite or beyond float32; leave it out")
    is_complete = ~np.isnan(points).any(-1)
    if not is_complete.any():
        raise InputError(f"{path}: {len(points)} points, none with finite coordinates; give some")
    return PointCloud(
        points=torch.from_numpy(points[is_complete]),
        color=None if color is None else torch.from_numpy(color[is_complete]),
    )


def _color_from_columns(path: AnyPath, columns: Columns) -> np.ndarray | None:
    """Read colours (n, 3) in [0, 1] from three columns, or from PCL's packed one (``rgb``).

    None where there are neither.
    """
    packed = columns.get("rgb", columns.get("rgba"))
    if packed is not None and packed.dtype.itemsize == 4:
        if packed.dtype.kind == "f":  # whose bits are the colour
            bits = packed.astype(np.float32).view(np.uint32)
        else:
            bits = packed.astype(np.int64).astype(np.uint32)
        channels = [(bits >> shift) & 255 for shift in (16, 8, 0)]  # red, green, blue
        return to_float32(np.stack(channels, -1)) / np.float32(255)
    if not columns.keys() >= set(_COLOR_NAMES):
        return None
    color = np.stack([columns[name] for name in _COLOR_NAMES], -1)
    if color.dtype.kind != "f":
        color = color / np.iinfo(color.dtype).max
    if not ((color >= 0) & (color <= 1)).all():
        raise InputError(f"{path}: colours beyond [0, 1]; store floats in [0, 1], or uchar")
    return to_float32(color)


def _cloud_from_table(path: AnyPath, table: np.ndarray) -> PointCloud:
    """Make a cloud of a table without column names: x, y, z, perhaps after numbers of the points.

    Raises:
        InputError: the table is transposed, or its rows begin with pixels.
    """
    if table.ndim != 2 or table.shape[1] < 3:
        raise InputError(f"{path}: points are rows of 3 numbers or more, got shape {table.shape}")
    rows, columns = table.shape
    if rows < _LEAST_ROWS and columns > _MAX_COLUMNS:
        raise InputError(
            f"{path}: {rows} rows of {columns} numbers, where each row is a point; "
            "save the transpose (array.T)"
        )

    # Whole numbers at the beginning of rows may be pixels or point numbers, and no coordinates.
    with np.errstate(invalid="ignore"):
        inspected = table[:_INSPECTED_ROWS]
        is_whole = (inspected == np.trunc(inspected)).all(0)
        steps = np.diff(table[:, 0])
    has_whole_first = columns > 3 and rows > 3 and bool(is_whole[0])
    if has_whole_first and columns > 4 and is_whole[1] and not is_whole[2:5].any():
        raise InputError(
            f"{path}: rows begin by two whole numbers ({table[0, 0]:g} and {table[0, 1]:g}), which "
            "look like a pixel's place; leave them out, or name the columns in a first line "
            "(u v x y z)"
        )

    # Numbers of points ascend: by one, or beside coordinates that are no whole numbers.
    is_ascending = (steps > 0).all()
    is_numbering = is_ascending and ((steps == 1).all() or not is_whole[1:4].any())
    first = 1 if has_whole_first and is_numbering else 0
    columns_xyz = {"x": table[:, first], "y": table[:, first + 1], "z": table[:, first + 2]}
    return _cloud_from_columns(path, columns_xyz)


def _read_text(path: AnyPath) -> PointCloud:
    """Read a cloud of text: rows of numbers, perhaps after column names, a count or comments."""
    text = TextIOWrapper(BytesIO(read_bytes(path, MAX_TEXT_BYTES)), "utf-8-sig")
    comments: list[str] = []
    rows = _strip_comments(text, comments)
    with refused_as(path, "text", "save it as UTF-8"):
        head = list(islice(rows, _INSPECTED_ROWS))

    # Names of columns in the first line.
    names: list[str] = []
    if head and not _is_row_of_numbers(head[0]):
        names = _split_names(head[0])
        if not set("xyz") <= set(names):
            raise InputError(
                f"{path}: begins by {head[0][:60]!r}, neither numbers nor names of columns with x, "
                "y and z; take that line out"
            )
        head = head[1:]

    # The number of points, alone in a line.
    count = None
    if len(head) > 1 and head[0].isdecimal() and len(_SEPARATORS.split(head[1])) > 2:
        count = int(head[0])
        head = head[1:]

    # Or the names are in a comment that has as many words as a row.
    width = len(_SEPARATORS.split(head[0])) if head else 0
    for comment in comments if not names else ():
        words = _split_names(comment)
        if len(words) == width and set("xyz") <= set(words):
            names = words
            break

    is_decimal = _are_commas_decimal(path, head, names)
    blank_separated = (
        _separate_by_blanks(row, with_decimal_commas=is_decimal) for row in chain(head, rows)
    )
    table = parse_rows(path, blank_separated)
    if count not in (None, len(table)):
        raise InputError(f"{path}: declares {count} points but {len(table)} rows follow")
    if names:
        if table.shape[1] != len(names):
            raise InputError(f"{path}: names {len(names)} columns, but rows have {table.shape[1]}")
        table = table[:, [names.index(axis) for axis in "xyz"]]
    return _cloud_from_table(path, table)


def _split_names(line: str) -> list[str]:
    """Split a line into names of columns, in lower case and without quotation marks."""
    return [word.strip("\"'").lower() for word in _SEPARATORS.split(line.strip())]


def _is_row_of_numbers(line: str) -> bool:
    """Whether all words of a line are numbers."""
    try:
        for word in filter(None, _split_names(line)):
            float(word)
    except ValueError:
        return False
    return True


def _strip_comments(text: Iterable[str], comments: list[str]) -> Iterator[str]:
    """Yield the rows of a text without their comments.

    A comment begins with ``#``, or at the beginning of a line with ``//``. Comments before the
    first row are appended to ``comments``.
    """
    has_row = False
    for line in text:
        if line.isspace():
            continue
        row, _, comment = spell_nan(line).partition("#")
        row = row.strip()
        if row.startswith("//"):
            comment = row.removeprefix("//")
            row = ""
        if row:
            has_row = True
            yield row
        elif not has_row:
            comments.append(comment)


def _are_commas_decimal(path: AnyPath, head: list[str], names: list[str]) -> bool:
    """Whether commas are decimal signs, and do not separate numbers, as the first rows tell.

    Args:
        path: the file, for the error.
        head: the first rows.
        names: names of the columns; empty where there are none.

    Raises:
        InputError: commas may be either.
    """
    has_points = "." in " ".join(head)
    words_of_rows = [re.split(r"[\s;]+", row.strip(" ;,")) for row in head]
    commas = [word.rstrip(",").count(",") for words in words_of_rows for word in words]
    most_commas = max(commas, default=0)
    if most_commas == 1 and not has_points:
        return True

    # Every word is two numbers, or one with a decimal comma and points elsewhere.
    has_three_words = all(len(words) > 2 for words in words_of_rows)
    is_each_word_ambiguous = most_commas == 1 and min(commas) == 1 and has_three_words
    # 0,1,0,2,0,7 may be six numbers or three.
    is_row_ambiguous = not names and not has_points and most_commas > 4 and most_commas % 2 == 1
    if is_each_word_ambiguous or is_row_ambiguous:
        raise InputError(
            f"{path}: commas may part numbers or be decimal signs ({head[-1][:60]!r}); save it "
            "with decimal points, or with a first line of names (x,y,z,...)"
        )
    return False


def _separate_by_blanks(row: str, *, with_decimal_commas: bool) -> str:
    """Replace the separators of a row by blanks, and decimal commas by points."""
    if not with_decimal_commas:
        return row.replace(",", " ").replace(";", " ")
    without_separators = re.sub(r",(?=\s|$)|;", " ", row)
    return without_separators.replace(",", ".")


CLOUD_READERS: dict[str, Callable[[AnyPath], PointCloud]] = {
    ".ply": lambda path: _cloud_from_columns(path, read_ply_elements(path, "vertex")[0]),
    ".pcd": lambda path: _cloud_from_columns(path, read_pcd(path)),
    ".npy": lambda path: _cloud_from_table(path, read_npy(path)),
    ".xyz": _read_text,
    ".txt": _read_text,
}
"""Reader of each suffix. Every command, folder and page accepts a format that is added here."""
