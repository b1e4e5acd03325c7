"""Predicted masks as BOP shares them: a JSON list with COCO's run lengths."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jaxtyping import Bool
from torch import Tensor

from depthpose.core.files import write_json
from depthpose.pose.bop.masks import Runs, decode_rle, read_runs
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
    segmentation: Runs
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
        segmentation=read_runs(row.get("segmentation"), source),
        seconds=seconds if seconds >= 0 else None,
    )
