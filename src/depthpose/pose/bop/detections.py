"""Predicted masks as BOP shares them: a JSON list with COCO's run lengths."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from depthpose.core.errors import InputError
from depthpose.core.files import write_json
from depthpose.core.files.images import MAX_PIXELS
from depthpose.pose.bop.parse import integer, number, read_rows


@dataclass(frozen=True, kw_only=True, eq=False)
class Detection:
    """One predicted object.

    Attributes:
        scene_id: number of the scene.
        image_id: number of the image.
        object_id: which object (``category_id``).
        score: how sure.
        segmentation: run lengths as in the file, checked.
        seconds: what the image took, where it is said.
    """

    scene_id: int
    image_id: int
    object_id: int
    score: float
    segmentation: tuple[tuple[int, ...], int, int]
    seconds: float | None = None

    @property
    def mask(self) -> Bool[Tensor, "h w"]:
        """The object's pixels."""
        return decode_rle(*self.segmentation)


def read_detections(path: str | Path) -> list[Detection]:
    """Read a file of detections; run lengths compressed or not.

    Raises:
        InputError: it is missing or damaged, or an entry has no mask.
    """
    path = Path(path)
    return [_read(row, f"{path}: entry {i}") for i, row in enumerate(read_rows(path))]


def write_detections(path: str | Path, detections: Sequence[Detection]) -> None:
    """Write detections as BOP shares them, run lengths as plain numbers.

    Raises:
        InputError: the disk refuses.
    """
    write_json(Path(path), [_row(detection) for detection in detections])


def decode_rle(counts: tuple[int, ...], height: int, width: int) -> Bool[Tensor, "h w"]:
    """Turn run lengths, column by column and beginning with the background, into a mask."""
    values = np.arange(len(counts)) % 2 == 1
    flat = np.repeat(values, counts)
    return torch.from_numpy(flat.reshape(width, height).T.copy())


def encode_rle(mask: Bool[Tensor, "h w"]) -> tuple[tuple[int, ...], int, int]:
    """Turn a mask into run lengths and its size."""
    flat = mask.cpu().numpy().T.reshape(-1)
    ends = np.flatnonzero(np.diff(flat)) + 1
    runs = np.diff(np.concatenate([[0], ends, [flat.size]])).tolist()
    starts_on_object = flat.size > 0 and bool(flat[0])
    return tuple([0, *runs] if starts_on_object else runs), mask.shape[0], mask.shape[1]


def mask_box(mask: Bool[Tensor, "h w"]) -> list[int]:
    """Left, top, width and height; BOP writes -1 four times where there is nothing."""
    rows, columns = mask.nonzero(as_tuple=True)
    if len(rows) == 0:
        return [-1] * 4
    left, top = int(columns.min()), int(rows.min())
    return [left, top, int(columns.max()) - left + 1, int(rows.max()) - top + 1]


def _row(detection: Detection) -> dict[str, Any]:
    counts, height, width = detection.segmentation
    return {
        "scene_id": detection.scene_id,
        "image_id": detection.image_id,
        "category_id": detection.object_id,
        "score": detection.score,
        "bbox": mask_box(detection.mask),
        "segmentation": {"size": [height, width], "counts": list(counts)},
        "time": -1.0 if detection.seconds is None else detection.seconds,
    }


def _read(row: dict[str, Any], source: str) -> Detection:
    seconds = number(row, "time", -1.0, source)
    return Detection(
        scene_id=integer(row, "scene_id", source),
        image_id=integer(row, "image_id", source),
        object_id=integer(row, "category_id", source),
        score=number(row, "score", None, source),
        segmentation=_segmentation(row.get("segmentation"), source),
        seconds=seconds if seconds >= 0 else None,
    )


def _segmentation(entry: object, source: str) -> tuple[tuple[int, ...], int, int]:
    what = f"{source}: the segmentation is no run lengths"
    if not isinstance(entry, dict) or "counts" not in entry:
        raise InputError(f'{what}; write {{"size": [height, width], "counts": [...]}}')
    size, counts = entry.get("size"), entry["counts"]
    if not _is_list_of_counts(size) or len(size) != 2 or 0 in size:
        raise InputError(f"{what}: its size is {size!r}, where [height, width] belongs")
    height, width = size
    runs = _decompress(counts) if isinstance(counts, str) else counts
    if not _is_list_of_counts(runs) or sum(runs) != height * width or height * width > MAX_PIXELS:
        raise InputError(f"{what} of {height}x{width} pixels: they do not add up to it")
    return tuple(runs), height, width


def _is_list_of_counts(value: object) -> TypeGuard[list[int]]:
    return isinstance(value, list) and all(isinstance(v, int) and v >= 0 for v in value)


def _decompress(text: str) -> list[int]:
    """Undo COCO's text form: five bits a character, runs as differences from the last but one."""
    runs: list[int] = []
    value = shift = 0
    for character in text:
        bits = ord(character) - 48
        value |= (bits & 0x1F) << shift
        shift += 5
        if bits & 0x20:
            continue
        if bits & 0x10:
            value -= 1 << shift
        runs.append(value + (runs[-2] if len(runs) > 2 else 0))
        value = shift = 0
    return runs
