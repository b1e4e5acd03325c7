"""Estimates as files: ``poses.json`` keeps everything, BOP's csv the poses."""

import math
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar, cast, get_args

import torch
from torch import Tensor

from depthpose.core.errors import InputError, nearest_name
from depthpose.core.files import write_json
from depthpose.core.rigid import Rigid
from depthpose.core.run import claim_folder
from depthpose.pose.bop import BopDataset, BopResult, Instance, read_results, write_results
from depthpose.pose.bop.parse import integer, number, read_rows
from depthpose.pose.types import PoseEstimate, Status

POSES = "poses.json"
STAGES = ("segmentation", "network", "voting", "svd", "icp")
"""What an estimate's ``seconds`` are of, in order; a stage that was not run is missing."""

_SAVE_EVERY = 200
_ROTATION_SLACK = 1e-4
_PLACE = ("scene_id", "im_id", "obj_id")

Input = TypeVar("Input")


class Place(NamedTuple):
    """Where in a BOP data set an estimate belongs."""

    scene_id: int
    image_id: int
    object_id: int


@dataclass(frozen=True, kw_only=True, eq=False)
class Prediction:
    """An estimate as a file keeps it.

    Attributes:
        estimate: or refusal; from the annotated mask of an instance it bears the instance's name.
        place: scene, image and object; None for a cloud of no data set.
    """

    estimate: PoseEstimate
    place: Place | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Job(Generic[Input]):
    """One thing to estimate: what it is called, where it belongs, and how its input is read.

    Attributes:
        name: that of the input: unique in a run.
        read: gives the input; called only where the estimate is not there yet.
        place: as :class:`Prediction` has it.
    """

    name: str
    read: Callable[[], Input]
    place: Place | None = None


def place_of(instance: Instance) -> Place:
    """Say where an annotated object belongs."""
    return Place(instance.scene_id, instance.image_id, instance.object_id)


def results_name(dataset: BopDataset) -> str:
    """Name the BOP csv of a data set: ``depthpose_DATASET-SPLIT.csv``."""
    return f"depthpose_{dataset.folder.resolve().name}-{dataset.split}.csv"


def predict(
    estimate_many: Callable[[Sequence[Input]], Sequence[PoseEstimate]],
    jobs: Iterable[Job[Input]],
    folder: Path,
    settings: dict[str, Any],
    batch: int = 1,
) -> Generator[str, None, None]:
    """Estimate what is not finished yet, and yield each name; ``poses.json`` grows as it goes.

    What was estimated is saved every 200 jobs, and when the work ends or is interrupted.

    Args:
        estimate_many: gives an estimate for each input, of the same name.
        jobs: all that there are to do, the finished ones too.
        folder: where ``poses.json`` goes; refused if other settings made what it holds.
        settings: what decides the results.
        batch: how many inputs are handed over at once. Each then takes an equal share of the time.
    """
    claim_folder(folder, settings)
    wanted = list(jobs)
    done = {p.estimate.name: p for p in read_predictions(folder)} if is_started(folder) else {}
    yield from (job.name for job in wanted if job.name in done)
    left = [job for job in wanted if job.name not in done]
    saved = len(done)
    try:
        for start in range(0, len(left), batch):
            some = left[start : start + batch]
            estimates = estimate_many([job.read() for job in some])
            for job, estimate in zip(some, estimates, strict=True):
                assert estimate.name == job.name, f"{estimate.name!r} is not {job.name!r}"
                done[job.name] = Prediction(estimate=estimate, place=job.place)
                yield job.name
            if len(done) >= saved + _SAVE_EVERY:
                write_predictions(folder, done.values())
                saved = len(done)
    finally:
        if len(done) > saved or not is_started(folder):
            write_predictions(folder, done.values())


def is_started(folder: Path) -> bool:
    """Whether a folder holds predictions."""
    return (folder / POSES).is_file()


def write_predictions(folder: Path, predictions: Iterable[Prediction]) -> None:
    """Write ``poses.json``: a list of estimates and refusals, in metres, radians and seconds.

    Raises:
        InputError: the disk refuses.
    """
    write_json(folder / POSES, [_row(prediction) for prediction in predictions])


def read_predictions(folder: Path) -> list[Prediction]:
    """Read what :func:`write_predictions` wrote.

    Raises:
        InputError: the file is missing or damaged, or two estimates have one name.
    """
    path = folder / POSES
    found = [_prediction(row, f"{path}: entry {i}") for i, row in enumerate(read_rows(path))]
    names: set[str] = set()
    for prediction in found:
        name = prediction.estimate.name
        if name in names:
            raise InputError(f"{path}: two estimates are called {name!r}; keep one of them")
        names.add(name)
    return found


def read_bop_results(path: Path) -> list[Prediction]:
    """Read anybody's BOP csv as predictions.

    A row has a share of its image's time; its score is kept as the share of votes that agree.

    Raises:
        InputError: the file is missing or damaged.
    """
    results = read_results(path)
    rows_of = Counter((result.scene_id, result.image_id) for result in results)
    found: list[Prediction] = []
    for row, result in enumerate(results, 1):
        place = Place(result.scene_id, result.image_id, result.object_id)
        whole_s = result.seconds
        estimate = PoseEstimate(
            name=f"row {row}",
            object=f"obj_{result.object_id:06d}",
            status="ok",
            camera_from_model=result.camera_from_model,
            inlier_share=result.score,
            seconds={} if whole_s is None else {"image": whole_s / rows_of[place[:2]]},
        )
        found.append(Prediction(estimate=estimate, place=place))
    return found


def write_bop_results(path: Path, predictions: Iterable[Prediction]) -> None:
    """Write BOP's csv; refused ones have no row. An image's time is the sum over its estimates.

    Raises:
        InputError: a pose belongs to no scene, or the disk refuses.
    """
    known = list(predictions)
    seconds: dict[tuple[int, int], float] = {}
    for prediction in known:
        if prediction.place is not None:
            image = prediction.place[:2]
            spent = sum(prediction.estimate.seconds.values())
            seconds[image] = seconds.get(image, 0.0) + spent
    write_results(path, [_result(p, seconds) for p in known if p.estimate.is_ok])


def score_of(estimate: PoseEstimate) -> float:
    """Say how sure an estimate is, 0..1: the share of the votes that agree; 1 where unknown."""
    return 1.0 if estimate.inlier_share is None else estimate.inlier_share


def _result(prediction: Prediction, seconds: dict[tuple[int, int], float]) -> BopResult:
    pose, place = prediction.estimate.camera_from_model, prediction.place
    if place is None:
        raise InputError(
            f"{prediction.estimate.name}: belongs to no scene of a BOP data set, and its csv is of "
            "such; leave it out"
        )
    assert pose is not None
    spent_s = seconds[place[:2]]
    return BopResult(
        scene_id=place.scene_id,
        image_id=place.image_id,
        object_id=place.object_id,
        score=score_of(prediction.estimate),
        camera_from_model=pose,
        seconds=spent_s if spent_s > 0 else None,
    )


def _row(prediction: Prediction) -> dict[str, Any]:
    estimate, place = prediction.estimate, prediction.place
    pose = estimate.camera_from_model
    row: dict[str, Any] = {"name": estimate.name, "object": estimate.object}
    row |= dict(zip(_PLACE, place, strict=True)) if place is not None else {}
    row |= {"status": estimate.status, "reason": estimate.reason}
    row["camera_from_model"] = None if pose is None else _matrix(pose)
    for name in ("covariance", "free_motions", "keypoints_m"):
        values: Tensor | None = getattr(estimate, name)
        row[name] = None if values is None else values.double().tolist()
    for name in ("inlier_share", "residual_m"):
        value: float | None = getattr(estimate, name)
        # JSON has no infinity, and nothing near the surface is no distance.
        row[name] = value if value is not None and math.isfinite(value) else None
    return row | {"seconds": dict(estimate.seconds)}


def _matrix(pose: Rigid) -> list[list[float]]:
    top = torch.cat([pose.R.double(), pose.t_m.double()[:, None]], 1).tolist()
    return [*top, [0.0, 0.0, 0.0, 1.0]]


def _prediction(row: dict[str, Any], source: str) -> Prediction:
    name, what = row.get("name"), row.get("object")
    if not isinstance(name, str) or not isinstance(what, str):
        raise InputError(f"{source}: name and object are {name!r} and {what!r}; write two words")
    status, reason = _status(row.get("status"), source), row.get("reason", "")
    pose = _pose(row.get("camera_from_model"), source)
    if (pose is not None) != (status == "ok") or (status != "ok" and not reason):
        raise InputError(
            f"{source}: an estimate that is ok has a camera_from_model, a refused one none, but a "
            f"reason; its status is {status!r}"
        )
    estimate = PoseEstimate(
        name=name,
        object=what,
        status=status,
        reason=str(reason),
        camera_from_model=pose,
        keypoints_m=_table(row, "keypoints_m", 3, source),
        covariance=_table(row, "covariance", 6, source),
        free_motions=_table(row, "free_motions", 6, source),
        inlier_share=_optional(row, "inlier_share", source),
        residual_m=_optional(row, "residual_m", source),
        seconds=_seconds(row, source),
    )
    has_place = any(row.get(key) is not None for key in _PLACE)
    place = Place(*(integer(row, key, source) for key in _PLACE)) if has_place else None
    return Prediction(estimate=estimate, place=place)


def _status(entry: object, source: str) -> Status:
    known = get_args(Status)
    if entry not in known:
        raise InputError(f"{source}: status {entry!r}: {nearest_name(str(entry), known)}")
    return cast("Status", entry)


def _pose(entry: object, source: str) -> Rigid | None:
    if entry is None:
        return None
    matrix = _numbers(entry, 4, f"{source}: camera_from_model")
    R = matrix[:3, :3]
    eye = torch.eye(3, dtype=torch.float64)
    is_rotation = torch.allclose(R @ R.T, eye, atol=_ROTATION_SLACK) and torch.linalg.det(R) > 0
    if len(matrix) != 4 or not is_rotation or matrix[3].tolist() != [0, 0, 0, 1]:
        raise InputError(
            f"{source}: camera_from_model is no rigid transform; write 4 rows of 4, a rotation, "
            "metres, and 0 0 0 1 below"
        )
    return Rigid(R.clone(), matrix[:3, 3].clone())


def _table(row: dict[str, Any], key: str, width: int, source: str) -> Tensor | None:
    return None if row.get(key) is None else _numbers(row[key], width, f"{source}: {key}")


def _numbers(entry: object, width: int, source: str) -> Tensor:
    try:
        values = torch.tensor(entry, dtype=torch.float64).reshape(-1, width)
    except (TypeError, ValueError, RuntimeError) as error:
        raise InputError(f"{source} is not rows of {width} numbers; write them so") from error
    return values


def _optional(row: dict[str, Any], key: str, source: str) -> float | None:
    return None if row.get(key) is None else number(row, key, None, source)


def _seconds(row: dict[str, Any], source: str) -> dict[str, float]:
    spent = row.get("seconds", {})
    if not isinstance(spent, dict):
        raise InputError(f"{source}: seconds is {spent!r}, where stages to numbers belong")
    return {str(stage): number(spent, stage, None, source) for stage in spent}
