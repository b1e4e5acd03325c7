"""Predictions as files: ``poses.json``, which records a run as it goes, and BOP's csv."""

import csv
import math
import warnings
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from io import StringIO
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, cast, get_args

import torch
from torch import Tensor

from depthpose.core.config import config_from_dict
from depthpose.core.data_frame import make_data_frame
from depthpose.core.errors import InputError, Notice, suggest_name
from depthpose.core.files import write_json
from depthpose.core.files.disk import read_bytes, refuse_heavy_text, refused_as, write_bytes
from depthpose.core.rigid import Rigid, is_rigid
from depthpose.core.runner import Job, Results
from depthpose.pose.datasets import BopDataset, Instance
from depthpose.pose.datasets.entries import (
    LARGEST_ID,
    make_pose,
    read_integer,
    read_number,
    read_rows,
)
from depthpose.pose.types import (
    POSED,
    Alternative,
    Evidence,
    Identity,
    PoseEstimate,
    Status,
    Tracking,
)

POSES = "poses.json"  #: name of the file of predictions
VERSION = 2  #: of an entry of ``poses.json``; ``docs/poses.schema.json`` describes it
PICTURE = "pose.png"  #: after ``NAME.``: the picture that shows a pose
CLOUD = "pose.ply"  #: after ``NAME.``: the cloud that shows a pose
STAGES = (
    "search", "segmentation", "cloud", "network", "proposal", "icp", "evidence", "decision",
    "tracking",
)  # fmt: skip
"""The keys of an estimate's ``seconds``, in order; a stage that was not run is missing."""
_STAGES_WITHIN_SEARCH = frozenset({"cloud", "proposal", "icp", "evidence", "decision"})
"""Stages of the registrations that a search makes: the time of ``search`` includes theirs."""

_ROTATION_SLACK = 1e-4  # largest deviation of a rotation matrix times its transpose from identity
_PLACE = ("scene_id", "im_id", "obj_id")  # keys of a :class:`Place` in a file


class Place(NamedTuple):
    """The scene, image and object of a BOP dataset that an estimate is of."""

    scene_id: int  #: number of the scene
    image_id: int  #: number of the image in it
    object_id: int  #: BOP's ``obj_id``


@dataclass(frozen=True, kw_only=True, eq=False)
class Prediction:
    """An estimate, or a refusal, and its place in a dataset."""

    estimate: PoseEstimate  #: by the annotated mask of an instance it has the instance's name
    place: Place | None = None  #: scene, image and object; None for an input of no dataset


class Predictions(list[Prediction]):
    """A list of predictions that can be converted to a table of pandas."""

    def to_frame(self) -> Any:  # noqa: ANN401  pandas is no dependency
        """Convert to a ``pandas.DataFrame``: a row for each estimate, columns as in ``poses.json``.

        Values of nested names are columns too, such as ``evidence.supported`` and ``seconds.icp``.

        Raises:
            ImportError: pandas is not installed.
        """
        return make_data_frame(prediction_row(prediction) for prediction in self)


def place_of(instance: Instance) -> Place:
    """Return the place of an annotated instance: its scene, image and object."""
    return Place(instance.scene_id, instance.image_id, instance.object_id)


def write_predictions(folder: Path, predictions: Iterable[Prediction]) -> None:
    """Write ``poses.json``: a list of estimates and refusals, in metres, radians and seconds.

    Raises:
        InputError: the disk refuses.
    """
    write_json(folder / POSES, [prediction_row(prediction) for prediction in predictions])


def read_predictions(folder: Path) -> Predictions:
    """Read what :func:`write_predictions` wrote.

    Raises:
        InputError: the file is missing or damaged, or two estimates have one name.
    """
    path = folder / POSES
    rows = enumerate(read_rows(path))
    predictions = Predictions(parse_prediction(row, f"{path}: entry {i}") for i, row in rows)
    names: set[str] = set()
    for prediction in predictions:
        name = prediction.estimate.name
        if name in names:
            raise InputError(f"{path}: two estimates are called {name!r}; keep one of them")
        names.add(name)
    return predictions


def read_earlier_predictions(folder: Path) -> dict[str, Prediction]:
    """Read the predictions of earlier runs by name, of a folder and its parts of several processes.

    A damaged file counts as missing, and gives a notice.
    """
    predictions: dict[str, Prediction] = {}
    for part in (folder, *sorted(folder.glob("part-*"))):
        try:
            earlier = read_predictions(part) if (part / POSES).is_file() else []
        except InputError as error:
            warnings.warn(f"{error} - it is damaged, and made again", Notice, stacklevel=2)
            continue
        for prediction in earlier:
            # An input that one part could read counts as read, though another part could not.
            name = prediction.estimate.name
            if prediction.estimate.status != "unreadable" or name not in predictions:
                predictions[name] = prediction
    return predictions


def score_of(estimate: PoseEstimate) -> float:
    """Return the score of an estimate, 0..1: its certainty, or else its share of inliers.

    It is 1 where the estimate has neither.
    """
    if estimate.certainty is not None:
        return estimate.certainty
    return 1.0 if estimate.inlier_share is None else estimate.inlier_share


def prediction_row(prediction: Prediction) -> dict[str, Any]:
    """Convert a prediction to the JSON values of an entry of ``poses.json``."""
    # Name, place and status.
    estimate = prediction.estimate
    place = prediction.place
    pose = estimate.camera_from_model
    row: dict[str, Any] = {"version": VERSION, "name": estimate.name, "object": estimate.object}
    row |= dict(zip(_PLACE, place, strict=True)) if place is not None else {}
    row |= {"status": estimate.status, "reason": estimate.reason}

    # Poses, and other tables of numbers.
    row["camera_from_model"] = None if pose is None else pose.matrix().tolist()
    base = estimate.base_from_model
    row["base_from_model"] = None if base is None else base.matrix().tolist()
    for name in ("covariance", "free_motions", "keypoints_m"):
        values: Tensor | None = getattr(estimate, name)
        row[name] = None if values is None else values.double().tolist()

    # Numbers. JSON has no infinity: the deviation along a free axis becomes null, and so does the
    # distance where no point lies near the surface.
    for name in ("origin_std_mm", "rotation_std_deg"):
        values = None if pose is None else getattr(estimate, name)
        deviations = [] if values is None else values.tolist()
        row[name] = [v if math.isfinite(v) else None for v in deviations] or None
    for name in ("inlier_share", "residual_m", "certainty", "copy_certainty"):
        value: float | None = getattr(estimate, name)
        row[name] = value if value is not None and math.isfinite(value) else None
    row["visible_share"] = estimate.visible_share
    row["pick_rank"] = estimate.pick_rank

    # Dataclasses.
    for name in ("evidence", "identity"):
        record = getattr(estimate, name)
        row[name] = None if record is None else asdict(record)
    row["alternatives"] = [
        {
            "camera_from_model": other.camera_from_model.matrix().tolist(),
            "probability": other.probability,
            "difference": other.difference,
            "is_copy": other.is_copy,
        }
        for other in estimate.alternatives
    ]
    if estimate.tracking is not None:
        row["tracking"] = estimate.tracking
    return row | {"seconds": dict(estimate.seconds)}


def parse_prediction(row: dict[str, Any], source: str) -> Prediction:
    """Convert an entry of ``poses.json`` to a prediction: the inverse of :func:`prediction_row`.

    Args:
        row: JSON values of the entry.
        source: of the entry, in errors.

    Raises:
        InputError: a value is missing or impossible.
    """
    if row.get("version", VERSION) != VERSION:
        raise InputError(
            f"{source}: version is {row['version']!r}, and this depthpose reads {VERSION}; read it "
            "with the depthpose that wrote it, or a newer one"
        )

    # Names and status.
    name = row.get("name")
    object_name = row.get("object")
    if not isinstance(name, str) or not isinstance(object_name, str):
        raise InputError(
            f"{source}: name and object are {name!r} and {object_name!r}; write two words"
        )
    status = row.get("status")
    reason = row.get("reason", "")
    if status not in get_args(Status):
        statuses = get_args(Status)
        raise InputError(f"{source}: status {status!r}: {suggest_name(str(status), statuses)}")

    # How it came about, and its pose; a refusal has none, but a reason.
    tracking = row.get("tracking")
    if tracking is not None and tracking not in get_args(Tracking):
        raise InputError(f"{source}: tracking is {tracking!r}; write one of {get_args(Tracking)}")
    pose = _parse_pose(row, source)
    if (pose is not None) != (status in POSED):
        raise InputError(
            f"{source}: an estimate that is ok or ambiguous has a camera_from_model, a refused one "
            f"none; its status is {status!r}"
        )
    if status != "ok" and not reason:
        raise InputError(
            f"{source}: every estimate but one that is ok has a reason; its status is {status!r}"
        )

    # All other values, and the place.
    values = _parse_values(row, source)
    estimate = PoseEstimate(
        name=name,
        object=object_name,
        status=cast("Status", status),
        reason=str(reason),
        camera_from_model=pose,
        base_from_model=_parse_pose(row, source, "base_from_model"),
        alternatives=_parse_alternatives(row, source),
        tracking=cast("Tracking | None", tracking),
        pick_rank=None if row.get("pick_rank") is None else read_integer(row, "pick_rank", source),
        **values,
    )
    has_place = any(row.get(key) is not None for key in _PLACE)
    place = Place(*(read_integer(row, key, source) for key in _PLACE)) if has_place else None
    return Prediction(estimate=estimate, place=place)


def _parse_values(row: dict[str, Any], source: str) -> dict[str, Any]:
    """Parse tables, numbers, times and dataclasses of an entry, by the fields of an estimate."""
    values: dict[str, Any] = {
        "keypoints_m": _parse_table(row, "keypoints_m", 3, source),
        "covariance": _parse_table(row, "covariance", 6, source, rows=6),
        "free_motions": _parse_table(row, "free_motions", 6, source),
    }
    for key in ("inlier_share", "residual_m", "certainty", "copy_certainty"):
        values[key] = None if row.get(key) is None else read_number(row, key, None, source)

    # Times of stages.
    seconds = row.get("seconds", {})
    if not isinstance(seconds, dict):
        raise InputError(f"{source}: seconds is {seconds!r}, where names to numbers belong")
    values["seconds"] = {str(stage): read_number(seconds, stage, None, source) for stage in seconds}

    # Dataclasses.
    for key, kind in (("evidence", Evidence), ("identity", Identity)):
        value = row.get(key)
        where = f"{source}: {key}"
        if value is not None and not isinstance(value, dict):
            raise InputError(f"{where} is {value!r}, where names to values belong")
        values[key] = None if value is None else config_from_dict(value, kind, source=where)
    return values


def _parse_alternatives(row: dict[str, Any], source: str) -> tuple[Alternative, ...]:
    """Parse the alternative poses of an entry."""
    entries = row.get("alternatives", [])
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise InputError(f"{source}: alternatives are no list of poses; write [...] of them")
    alternatives: list[Alternative] = []
    for k, entry in enumerate(entries):
        where = f"{source}: alternative {k}"
        pose = _parse_pose(entry, where)
        if pose is None:
            raise InputError(f"{where}: has no camera_from_model; leave it out, or write it")
        alternatives.append(
            Alternative(
                camera_from_model=pose,
                probability=read_number(entry, "probability", None, where),
                difference=str(entry.get("difference", "")),
                is_copy=bool(entry.get("is_copy", False)),
            )
        )
    return tuple(alternatives)


def _parse_pose(row: dict[str, Any], source: str, key: str = "camera_from_model") -> Rigid | None:
    """Parse a pose of ``poses.json``; None where the entry has none."""
    matrix = _parse_table(row, key, 4, source, rows=4)
    if matrix is None:
        return None
    if not is_rigid(matrix, _ROTATION_SLACK):
        raise InputError(
            f"{source}: {key} is no rigid transform; write 4 rows of 4, a rotation, "
            "metres, and 0 0 0 1 below"
        )
    return Rigid(matrix[:3, :3].clone(), matrix[:3, 3].clone())


def _parse_table(
    row: dict[str, Any], key: str, width: int, source: str, rows: int | None = None
) -> Tensor | None:
    """Parse a table of ``width`` columns, and of ``rows`` rows where given; None without one."""
    if row.get(key) is None:
        return None
    try:
        return torch.tensor(row[key], dtype=torch.float64).reshape(rows or -1, width)
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        count = "" if rows is None else f"{rows} "
        raise InputError(
            f"{source}: {key} is not {count}rows of {width} numbers; write them so"
        ) from error


_SAVE_EVERY = 200  # results, after which the file is written

Input = TypeVar("Input")


@dataclass(frozen=True, kw_only=True, eq=False)
class PoseJob(Job[Input]):
    """One input of an estimator of poses."""

    object: str  #: name of the object that the input shows, or may show
    place: Place | None = None  #: as in :class:`Prediction`
    seconds: Mapping[str, float] = field(default_factory=dict)  #: of earlier stages, such as a mask


def refuse_unreadable(name: str, object: str, error: InputError) -> PoseEstimate:
    """Build the estimate, without a pose, that says why an input cannot be read."""
    reason = f"cannot be read: {error}"
    return PoseEstimate(name=name, object=object, status="unreadable", reason=reason)


class PoseResults(Results[Input, PoseEstimate]):
    """One estimate for each input, in the ``poses.json`` of a folder.

    Inputs that were unreadable are tried again, for they may have been repaired. The file is
    written every 200 results, and when the run ends or is interrupted.

    Args:
        folder: folder of the file.
        run_folder: folder of the run where several processes share it, each with a ``folder`` of
            its own: what any of them finished counts as finished. None: ``folder``.
        must_read: an input that cannot be read is an error; else an estimate says so.
    """

    def __init__(
        self, folder: Path, run_folder: Path | None = None, *, must_read: bool = False
    ) -> None:
        self.folder = folder
        self._must_read = must_read
        self.predictions = read_earlier_predictions(folder)  #: by the names of the inputs
        predictions_of_run = self.predictions
        if run_folder is not None and run_folder != folder:
            predictions_of_run = read_earlier_predictions(run_folder)
        self._finished = {
            name
            for name, prediction in predictions_of_run.items()
            if prediction.estimate.status != "unreadable"
        }
        self._unsaved = 0

    def is_finished(self, job: Job[Input]) -> bool:
        """Whether an earlier run estimated or refused this input."""
        return job.name in self._finished

    def store(self, job: Job[Input], result: PoseEstimate) -> None:
        """Keep an estimate with the place of its input and the times of earlier stages."""
        assert isinstance(job, PoseJob)
        assert result.name == job.name, f"{result.name!r} is not {job.name!r}"
        self._keep(job, result)

    def store_failure(self, job: Job[Input], error: InputError) -> None:
        """Keep an estimate that says why the input cannot be read, unless that is an error."""
        assert isinstance(job, PoseJob)
        if self._must_read:
            raise error
        self._keep(job, refuse_unreadable(job.name, job.object, error))

    def _keep(self, job: PoseJob[Input], estimate: PoseEstimate) -> None:
        """Add an estimate to the predictions, and write the file after every 200."""
        timed = replace(estimate, seconds={**job.seconds, **estimate.seconds})
        self.predictions[job.name] = Prediction(estimate=timed, place=job.place)
        self._unsaved += 1
        if self._unsaved >= _SAVE_EVERY:
            self.flush()

    def flush(self) -> None:
        """Write ``poses.json``."""
        if self._unsaved or not (self.folder / POSES).is_file():
            write_predictions(self.folder, self.predictions.values())
            self._unsaved = 0


def additive_seconds(predictions: Sequence[Prediction]) -> list[dict[str, float]]:
    """List the seconds of each prediction so that their sum is the time of all together.

    The estimates of one search all hold the time of the whole search: it is divided among them. The
    stages within a search, whose time that of the search includes, are left out.
    """
    # Estimates of one image that hold the very same time come from one search: regions of an image
    # are searched one by one, and take different times.
    searches: list[tuple[object, float | None]] = []
    for prediction in predictions:
        image = prediction.place[:2] if prediction.place else prediction.estimate.name
        searches.append((image, prediction.estimate.seconds.get("search")))
    estimate_count = Counter(searches)

    # The share of each prediction in its search, without the stages within it.
    rows: list[dict[str, float]] = []
    for prediction, search in zip(predictions, searches, strict=True):
        seconds = dict(prediction.estimate.seconds)
        if "search" in seconds:
            for stage in _STAGES_WITHIN_SEARCH:
                seconds.pop(stage, None)
            seconds["search"] /= estimate_count[search]
        rows.append(seconds)
    return rows


_HEADER = ["scene_id", "im_id", "obj_id", "score", "R", "t", "time"]  # of BOP's csv
_TIME_SLACK_S = 0.001  # BOP's toolkit refuses rows of an image whose times differ by more


def name_bop_results(dataset: BopDataset, method: str = "depthpose") -> str:
    """Name the BOP csv of a dataset: ``METHOD_DATASET-SPLIT.csv``."""
    # BOP's toolkit splits names at _, which a split such as test_primesense may hold.
    split = dataset.folder_of_split.replace("_", "-")
    return f"{method}_{dataset.folder.resolve().name}-{split}.csv"


def read_bop_results(path: str | Path) -> list[Prediction]:
    """Read the predictions of a BOP csv (mm, seconds) by any method.

    The time of an image is divided among its rows; a score becomes the share of inliers.

    Raises:
        InputError: the file is missing or damaged, or rows of an image have different times.
    """
    # The lines of the file.
    data = read_bytes(path)
    refuse_heavy_text(path, data, {b"\n": 300, b",": 60})
    with refused_as(path, "results file", "write it anew"):
        rows = list(csv.reader(data.decode("utf-8-sig").splitlines()))
    if not rows or [name.strip() for name in rows[0]] != _HEADER:
        raise InputError(f"{path}: the first line is not {','.join(_HEADER)}; put it there")

    # An estimate for each line, and the time of each image.
    estimates: list[tuple[Place, PoseEstimate]] = []
    image_s: dict[tuple[int, int], float] = {}
    for line, row in enumerate(rows[1:], 2):
        if not row:
            continue
        place, estimate, time_s = _parse_bop_row(row, len(estimates) + 1, f"{path}: line {line}")
        estimates.append((place, estimate))

        # All rows of an image have its time; a negative one means that it is not known.
        first_time_s = image_s.setdefault(place[:2], time_s)
        is_known_once = (first_time_s < 0) != (time_s < 0)
        is_other_time = time_s >= 0 and abs(first_time_s - time_s) > _TIME_SLACK_S
        if is_known_once or is_other_time:
            raise InputError(
                f"{path}: scene {place.scene_id} image {place.image_id} took {first_time_s} s in "
                f"one row and {time_s} s in another; time is that of the whole image, "
                "the same in all"
            )

    # The time of an image, divided among its estimates.
    estimate_count = Counter(place[:2] for place, _ in estimates)
    shares: dict[tuple[int, int], dict[str, float]] = {}
    for image, time_s in image_s.items():
        if time_s >= 0:
            shares[image] = {"image": time_s / estimate_count[image]}
    return [
        Prediction(estimate=replace(estimate, seconds=shares.get(place[:2], {})), place=place)
        for place, estimate in estimates
    ]


def _parse_bop_row(
    row: Sequence[str], number: int, source: str
) -> tuple[Place, PoseEstimate, float]:
    """Parse a row of BOP's csv: its place, an estimate named after ``number``, the image's time."""
    # The numbers of the row.
    if len(row) != len(_HEADER):
        raise InputError(f"{source}: {len(row)} values, where {len(_HEADER)} belong")
    try:
        place = Place(*(int(value) for value in row[:3]))
        score = float(row[3])
        time_s = float(row[6])
        R = [float(value) for value in row[4].split()]
        t_mm = [float(value) for value in row[5].split()]
    except ValueError as error:
        raise InputError(
            f"{source}: {error}; write numbers, and separate those of R and t by spaces"
        ) from error

    # Are they possible?
    if not all(0 <= value <= LARGEST_ID for value in place):
        raise InputError(f"{source}: scene, image and object are numbers from 0 to {LARGEST_ID}")
    if len(R) != 9 or len(t_mm) != 3 or not all(map(math.isfinite, [score, time_s, *R, *t_mm])):
        raise InputError(f"{source}: {len(R)} numbers of R and {len(t_mm)} of t, where 9 and 3 "
                         "finite ones belong")  # fmt: skip
    estimate = PoseEstimate(
        name=f"row {number}",
        object=f"obj_{place.object_id:06d}",
        status="ok",
        camera_from_model=make_pose(R, t_mm, source),
        inlier_share=score,
    )
    return place, estimate, time_s


def write_bop_results(
    path: str | Path, predictions: Iterable[Prediction], *, with_alternatives: bool = False
) -> None:
    """Write the poses of predictions as BOP's csv, without refusals.

    An image's time is the sum over its estimates, in which a search of the image counts once.

    Args:
        path: of the csv. Numbers keep all their digits.
        predictions: with places in a dataset.
        with_alternatives: write a row for each alternative too, with its probability as the score.
            Leave them out of a csv that is measured: BOP takes the best rows of an image.

    Raises:
        InputError: a pose belongs to no scene, or the disk refuses.
    """
    # The time of each image.
    entries = list(predictions)
    image_s: dict[tuple[int, int], float] = defaultdict(float)
    for prediction, seconds in zip(entries, additive_seconds(entries), strict=True):
        if prediction.place is not None:
            image_s[prediction.place[:2]] += sum(seconds.values())

    # A row for each pose.
    text = StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(_HEADER)
    for prediction in entries:
        estimate = prediction.estimate
        place = prediction.place
        if estimate.camera_from_model is None:
            continue
        if place is None:
            raise InputError(
                f"{estimate.name}: belongs to no scene of a BOP dataset, and its csv is of such; "
                "leave it out"
            )
        scored_poses = [(estimate.camera_from_model, score_of(estimate))]
        if with_alternatives:
            others = estimate.alternatives
            scored_poses += [(other.camera_from_model, other.probability) for other in others]
        for pose, score in scored_poses:
            R = " ".join(repr(value) for value in pose.R.double().flatten().tolist())
            t_mm = " ".join(repr(value) for value in (1000 * pose.t_m.double()).tolist())
            writer.writerow([*place, score, R, t_mm, image_s[place[:2]] or -1])
    write_bytes(path, text.getvalue().encode())
