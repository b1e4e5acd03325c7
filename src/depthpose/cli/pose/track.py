"""The run of ``depthpose pose track``: an object is followed through the frames of a sequence."""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from tqdm import tqdm

from depthpose.cli import file_names
from depthpose.cli.pose.dataset import choose_objects, dataset_settings, match_names, open_dataset
from depthpose.cli.pose.dataset_jobs import make_image_job
from depthpose.cli.pose.file_jobs import make_cloud_jobs, make_depth_jobs
from depthpose.cli.pose.methods import PoseMethod, resolve_object
from depthpose.cli.pose.options import SequenceOptions
from depthpose.cli.pose.output import (
    claim_for_dataset,
    claim_for_jobs,
    make_picture_job,
    print_result,
    write_files,
)
from depthpose.cli.pose.plans import camera_settings, unit_settings
from depthpose.cli.pose.transforms import read_pose
from depthpose.core.errors import InputError
from depthpose.core.rigid import Rigid
from depthpose.pose.datasets import BopDataset, Instance
from depthpose.pose.inputs import AnyInput
from depthpose.pose.predictions import (
    PoseJob,
    Prediction,
    read_earlier_predictions,
    refuse_unreadable,
    write_predictions,
)
from depthpose.pose.types import PoseEstimate


def track_files(method: PoseMethod, frames: SequenceOptions, out: Path) -> int:
    """Follow one object through depth images with a camera, or clouds; return the exit code.

    Args:
        method: follows the object.
        frames: options that name the files, the object and perhaps its first pose.
        out: folder of the results.
    """
    object = resolve_object(frames.object, method)
    settings = {**method.settings, "track": object, **unit_settings(frames.unit)}
    first_pose = None
    if frames.first is not None:
        first_pose = read_pose(frames.first)
        settings["first"] = file_names.name_with_checksum(frames.first)
    if frames.cloud is not None:
        jobs = make_cloud_jobs(frames.cloud, frames.unit or "m", object, out)
    else:
        assert frames.depth is not None
        assert frames.camera is not None
        jobs = make_depth_jobs(frames.depth, frames.camera, object, frames.unit, out)
        settings |= camera_settings(frames.camera)
    claim_for_jobs(out, settings, jobs)
    predictions = _follow_object(method, jobs, object, first_pose)
    return _write_sequences(method, predictions, jobs, out)


def track_dataset(method: PoseMethod, frames: SequenceOptions, out: Path) -> int:
    """Follow each object of a method, or the one named, in each scene; return the exit code.

    Args:
        method: follows the objects.
        frames: options that name the dataset and perhaps the object.
        out: folder of the results.
    """
    assert frames.bop is not None
    dataset = open_dataset(frames.bop, frames.split)
    dataset = choose_objects(dataset, method, frames.object)
    names = match_names(dataset, method.models)
    settings = {
        **method.settings,
        **dataset_settings(dataset),
        "track": sorted(names.values()),
    }
    claim_for_dataset(out, settings, dataset)

    # A sequence for each scene and object: its first instance in each image, by image number.
    instances_of: dict[tuple[int, int], dict[int, Instance]] = {}
    for instance in sorted(dataset.instances, key=lambda i: (i.image_id, i.index)):
        by_image = instances_of.setdefault((instance.scene_id, instance.object_id), {})
        by_image.setdefault(instance.image_id, instance)
    sequences = [
        [make_image_job(instance, instance.name, names[number]) for instance in by_image.values()]
        for (_, number), by_image in sorted(instances_of.items())
    ]
    jobs = [job for sequence in sequences for job in sequence]
    predictions = (
        prediction
        for sequence in sequences
        for prediction in _follow_object(method, sequence, sequence[0].object)
    )
    return _write_sequences(method, predictions, jobs, out, dataset)


def _write_sequences(
    method: PoseMethod,
    followed: Iterable[Prediction],
    jobs: Sequence[PoseJob[Any]],
    out: Path,
    dataset: BopDataset | None = None,
) -> int:
    """Follow sequences, write the files of their predictions, and print a summary.

    ``poses.json`` is written after an interruption too; it then keeps what an earlier run had of
    the frames that this one did not reach.

    Args:
        method: the method that follows.
        followed: predictions of the frames, each made as it is asked for.
        jobs: the frames.
        out: folder of the results.
        dataset: dataset of the frames; None: they are files.

    Returns:
        The exit code.
    """
    earlier = list(read_earlier_predictions(out).values())
    predictions: list[Prediction] = []
    try:
        for prediction in followed:
            predictions.append(prediction)  # noqa: PERF402  those before an interruption must be there
        earlier = []
    finally:
        names = {prediction.estimate.name for prediction in predictions}
        if predictions:
            others = [p for p in earlier if p.estimate.name not in names]
            write_predictions(out, [*predictions, *others])
    picture_jobs = [
        make_picture_job(job, prediction, method)
        for prediction, job in zip(predictions, jobs, strict=True)
    ]
    write_files(predictions, picture_jobs, out, method, dataset)
    code = print_result(predictions, out)
    counts = Counter(p.estimate.tracking for p in predictions)
    print(", ".join(f"{counts[state]} {state}" for state in ("tracked", "found", "lost")))
    return code


def _read_frames(jobs: Sequence[PoseJob[Any]], object: str) -> Iterator[AnyInput | PoseEstimate]:
    """Read frames one by one; in place of an unreadable one stands a refusal of ``object``."""
    for job in tqdm(jobs, disable=None, unit=" frames"):
        try:
            frame = job.read()
        except InputError as error:
            frame = refuse_unreadable(job.name, object, error)
        yield frame


def _follow_object(
    method: PoseMethod, jobs: Sequence[PoseJob[Any]], object: str, first_pose: Rigid | None = None
) -> Iterator[Prediction]:
    """Follow an object frame by frame; an unreadable frame has an estimate with that reason.

    ``first_pose``: about where it is in the first frame; None: it is searched for.
    """
    estimates = method.track(_read_frames(jobs, object), object, first_pose)
    for job, estimate in zip(jobs, estimates, strict=True):
        yield Prediction(estimate=estimate, place=job.place)
