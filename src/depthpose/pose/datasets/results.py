"""BOP's results file: ``scene_id,im_id,obj_id,score,R,t,time``, mm and seconds."""

import csv
import math
from collections.abc import Iterable
from dataclasses import dataclass
from io import StringIO
from pathlib import Path

from depthpose.core.errors import InputError
from depthpose.core.files.disk import refused_as, write_bytes
from depthpose.core.files.store import read_bytes
from depthpose.core.files.text import refuse_heavy
from depthpose.core.rigid import Rigid
from depthpose.pose.datasets.parse import MOST, make_pose

_HEADER = ["scene_id", "im_id", "obj_id", "score", "R", "t", "time"]
_SAME_TIME_S = 0.001
"""BOP's toolkit refuses rows of an image whose times differ by more."""


@dataclass(frozen=True, kw_only=True, eq=False)
class BopResult:
    """One estimated pose.

    Attributes:
        scene_id: number of the scene.
        image_id: number of the image.
        object_id: which object.
        score: how sure.
        camera_from_model: the pose.
        seconds: what the whole image took, the same for all its rows; None where unknown.
    """

    scene_id: int
    image_id: int
    object_id: int
    score: float
    camera_from_model: Rigid
    seconds: float | None = None


def write_results(path: str | Path, results: Iterable[BopResult]) -> None:
    """Write estimates; refused ones have no row. Numbers keep all their digits.

    Raises:
        InputError: rows of an image have different times, or the disk refuses.
    """
    rows = list(results)
    _refuse_times(path, rows)
    text = StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(_HEADER)
    for row in rows:
        pose = row.camera_from_model
        R = " ".join(repr(value) for value in pose.R.double().flatten().tolist())
        t = " ".join(repr(value) for value in (1000 * pose.t_m.double()).tolist())
        seconds = -1 if row.seconds is None else row.seconds
        writer.writerow([row.scene_id, row.image_id, row.object_id, row.score, R, t, seconds])
    write_bytes(path, text.getvalue().encode())


def read_results(path: str | Path) -> list[BopResult]:
    """Read a results file, whoever wrote it.

    Raises:
        InputError: it is missing or damaged, or rows of an image have different times.
    """
    data = read_bytes(path)
    refuse_heavy(path, data, {b"\n": 300, b",": 60})
    with refused_as(path, "results file", "write it anew"):
        rows = list(csv.reader(data.decode("utf-8-sig").splitlines()))
    if not rows or [name.strip() for name in rows[0]] != _HEADER:
        raise InputError(f"{path}: the first line is not {','.join(_HEADER)}; put it there")
    results = [_read(row, f"{path}: line {i}") for i, row in enumerate(rows[1:], 2) if row]
    _refuse_times(path, results)
    return results


def _read(row: list[str], source: str) -> BopResult:
    if len(row) != len(_HEADER):
        raise InputError(f"{source}: {len(row)} values, where {len(_HEADER)} belong")
    try:
        scene, image, wanted = (int(value) for value in row[:3])
        score, seconds = float(row[3]), float(row[6])
        R, t_mm = ([float(value) for value in text.split()] for text in row[4:6])
    except ValueError as error:
        raise InputError(f"{source}: {error}; write numbers, R and t parted by blanks") from error
    everything = [score, seconds, *R, *t_mm]
    if not all(0 <= value <= MOST for value in (scene, image, wanted)):
        raise InputError(f"{source}: scene, image and object are numbers from 0 to {MOST}")
    if len(R) != 9 or len(t_mm) != 3 or not all(map(math.isfinite, everything)):
        raise InputError(f"{source}: {len(R)} numbers of R and {len(t_mm)} of t, where 9 and 3 "
                         "finite ones belong")  # fmt: skip
    return BopResult(
        scene_id=scene,
        image_id=image,
        object_id=wanted,
        score=score,
        camera_from_model=make_pose(R, t_mm, source),
        seconds=seconds if seconds >= 0 else None,
    )


def _refuse_times(path: str | Path, rows: list[BopResult]) -> None:
    first: dict[tuple[int, int], float | None] = {}
    for row in rows:
        place = (row.scene_id, row.image_id)
        said = first.setdefault(place, row.seconds)
        if (said is None) != (row.seconds is None) or (
            said is not None and row.seconds is not None and abs(said - row.seconds) > _SAME_TIME_S
        ):
            raise InputError(
                f"{path}: scene {place[0]} image {place[1]} took {said} s in one row and "
                f"{row.seconds} s in another; time is that of the whole image, the same in all"
            )
