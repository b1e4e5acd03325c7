"""What there is to estimate, and doing what is not done yet."""

from collections import Counter, defaultdict
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Generic, TypeVar

from depthpose.core.errors import InputError
from depthpose.core.run import claim_folder
from depthpose.pose.datasets import BopDataset, Detection, Instance, read_mask
from depthpose.pose.predictions.records import (
    POSES,
    Place,
    Prediction,
    is_finished,
    is_started,
    kept_predictions,
    place_of,
    write_predictions,
)
from depthpose.pose.types import PoseEstimate, ViewInput

_SAVE_EVERY = 200

Input = TypeVar("Input")


@dataclass(frozen=True, kw_only=True, eq=False)
class Job(Generic[Input]):
    """One thing to estimate: what it is called, where it belongs, and how its input is read.

    Attributes:
        name: that of the input: unique in a run.
        read: gives the input; called only where the estimate is not there yet.
        place: as :class:`Prediction` has it.
        seconds: what was spent before, on its mask.
        source: file or files that the input is read from.
    """

    name: str
    read: Callable[[], Input]
    place: Place | None = None
    seconds: Mapping[str, float] = field(default_factory=dict)
    source: Path | tuple[Path, ...] | None = None


def predict(
    estimate_many: Callable[[Sequence[Input]], Sequence[PoseEstimate]],
    jobs: Iterable[Job[Input]],
    folder: Path,
    settings: dict[str, Any],
    batch: int = 1,
) -> Generator[str, None, None]:
    """Estimate what is not finished yet, and yield each name; ``poses.json`` grows as it goes.

    What was unreadable is tried again.

    What was estimated is saved every 200 jobs, and when the work ends or is interrupted.

    Args:
        estimate_many: gives an estimate for each input, of the same name.
        jobs: all that there are to do, the finished ones too.
        folder: where ``poses.json`` goes; refused if other settings made what it holds.
        settings: what decides the results.
        batch: how many inputs are handed over at once. Each then takes an equal share of the time.
    """
    claim_folder(folder, settings, [POSES])
    wanted = list(jobs)
    done = {p.estimate.name: p for p in kept_predictions(folder)}
    finished = {name for name, prediction in done.items() if is_finished(prediction)}
    yield from (job.name for job in wanted if job.name in finished)
    left = [job for job in wanted if job.name not in finished]
    unsaved = 0
    try:
        for start in range(0, len(left), batch):
            some = left[start : start + batch]
            estimates = estimate_many([job.read() for job in some])
            for job, estimate in zip(some, estimates, strict=True):
                assert estimate.name == job.name, f"{estimate.name!r} is not {job.name!r}"
                spent = {**job.seconds, **estimate.seconds}
                done[job.name] = Prediction(
                    estimate=replace(estimate, seconds=spent), place=job.place
                )
                unsaved += 1
                yield job.name
            if unsaved >= _SAVE_EVERY:
                write_predictions(folder, done.values())
                unsaved = 0
    finally:
        if unsaved or not is_started(folder):
            write_predictions(folder, done.values())


def instance_jobs(
    dataset: BopDataset,
    names: Mapping[int, str],
    mask_of: Callable[[Instance], Path] | None = None,
) -> list[Job[ViewInput]]:
    """Take every annotated instance by its mask.

    Args:
        dataset: what there is to estimate.
        names: what the estimator calls each object, by its number.
        mask_of: names the predicted mask of an instance, an image; None: the annotated masks.
    """

    def read(instance: Instance) -> ViewInput:
        mask = None if mask_of is None else read_mask(mask_of(instance))
        return replace(dataset.view(instance, mask).input, object=names[instance.object_id])

    return [
        Job(name=instance.name, read=partial(read, instance), place=place_of(instance))
        for instance in dataset.instances
    ]


def detection_jobs(
    dataset: BopDataset, names: Mapping[int, str], detections: Sequence[Detection]
) -> list[Job[ViewInput]]:
    """Take the surest detections of each object, as many as an image shows of it.

    What is not detected has no job, and is missing in what is measured. The time of an image's
    detection is shared by all its jobs.

    Args:
        dataset: what there is to find.
        names: what the estimator calls each object, by its number.
        detections: masks of any images; those of images that ``dataset`` has not are left out.

    Raises:
        InputError: no detection is of the data set.
    """
    shown: dict[Place, list[Instance]] = defaultdict(list)
    for instance in dataset.instances:
        shown[place_of(instance)].append(instance)
    found: dict[Place, list[Detection]] = defaultdict(list)
    for one in sorted(detections, key=lambda d: -d.score):
        place = Place(one.scene_id, one.image_id, one.object_id)
        if len(found[place]) < len(shown.get(place, ())):
            found[place].append(one)
    kept = [(place, k, one) for place, every in found.items() for k, one in enumerate(every)]
    if not kept:
        raise InputError(
            f"{dataset.folder}: none of the {len(detections)} detections is of an image and object "
            f"of split {dataset.split!r}; give those of this very split"
        )
    sharing = Counter(place[:2] for place, _, _ in kept)

    def read(instance: Instance, name: str, one: Detection) -> ViewInput:
        view = dataset.view(instance, one.mask).input
        return replace(view, name=name, object=names[instance.object_id])

    jobs: list[Job[ViewInput]] = []
    for place, k, one in sorted(kept, key=lambda item: item[:2]):
        name = f"{place.scene_id:06d}_{place.image_id:06d}_object{place.object_id}_{k}"
        seconds = {} if one.seconds is None else {"segmentation": one.seconds / sharing[place[:2]]}
        jobs.append(
            Job(
                name=name,
                read=partial(read, shown[place][0], name, one),
                place=place,
                seconds=seconds,
            )
        )
    return jobs
