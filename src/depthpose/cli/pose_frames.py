"""Whole depth images, without masks: searched one by one, or followed as a sequence."""

import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from depthpose.cli import pose_jobs, pose_methods, pose_output
from depthpose.cli.pose_methods import PoseMethod
from depthpose.cli.pose_options import DataSetOptions, PoseInputs, SequenceOptions
from depthpose.core.errors import InputError
from depthpose.core.files import read_depth_png
from depthpose.core.rigid import Rigid
from depthpose.core.run import find_rank
from depthpose.core.runner import Job, Results, run_jobs
from depthpose.pose.datasets import BopDataset, Instance, open_bop, read_targets
from depthpose.pose.evaluate import select_targets
from depthpose.pose.footprint import explained_mask
from depthpose.pose.inputs import AnyInput
from depthpose.pose.predictions import (
    Place,
    PoseJob,
    Prediction,
    earlier_predictions,
    place_of,
    unreadable_estimate,
    write_predictions,
)
from depthpose.pose.surface import prepare_surface
from depthpose.pose.types import PoseEstimate, ViewInput


class SearchResults(Results[ViewInput, list[PoseEstimate]]):
    """The estimates of each image, perhaps several, in the ``poses.json`` of a folder.

    The file is written after every image, and keeps what earlier runs found in other images.
    """

    def __init__(
        self,
        folder: Path,
        images: Sequence[str],
        earlier: Sequence[Prediction],
        is_of_image: Callable[[Prediction, str], bool],
        numbers: Mapping[str, int] | None = None,
    ) -> None:
        """Sort the predictions of earlier runs by images; ``numbers``: of a data set's objects."""
        self.by_image: dict[str, list[Prediction]] = {}
        self._folder = folder
        self._images = images
        self._numbers = numbers
        self._of_other_images = list(earlier)
        for image in images:
            of_image = [p for p in self._of_other_images if is_of_image(p, image)]
            if of_image:
                self.by_image[image] = of_image
                self._of_other_images = [p for p in self._of_other_images if p not in of_image]

    def is_finished(self, job: Job[ViewInput]) -> bool:
        """Whether the image has been searched."""
        return job.name in self.by_image

    def store(self, job: Job[ViewInput], data: ViewInput, result: list[PoseEstimate]) -> None:  # noqa: ARG002
        """Write what was found in an image."""
        assert isinstance(job, PoseJob)
        self.by_image[job.name] = [
            Prediction(estimate=estimate, place=self._place_of(job, estimate))
            for estimate in result
        ]
        self.flush()

    def store_failure(self, job: Job[ViewInput], error: InputError) -> None:
        """Write why an image cannot be read; of a data set, which must be whole, it is an error."""
        assert isinstance(job, PoseJob)
        if job.object is None:
            raise error
        self.by_image[job.name] = [
            Prediction(estimate=unreadable_estimate(job.name, job.object, error))
        ]
        self.flush()

    def flush(self) -> None:
        """Write ``poses.json``."""
        predictions = [p for image in self._images for p in self.by_image.get(image, ())]
        write_predictions(self._folder, [*predictions, *self._of_other_images])

    def _place_of(self, job: PoseJob[ViewInput], estimate: PoseEstimate) -> Place | None:
        if self._numbers is None or job.place is None:
            return None
        return job.place._replace(object_id=self._numbers[estimate.object])


def _search(
    method: PoseMethod,
    objects: Sequence[str],
    jobs: Sequence[PoseJob[Any]],
    results: SearchResults,
) -> tuple[list[Prediction], list[PoseJob[Any]]]:
    """Search images for objects; give the predictions, and a job for each that shows it alone."""
    find = method.find
    assert find is not None

    def find_in_each(views: Sequence[ViewInput]) -> list[list[PoseEstimate]]:
        return [find(view, objects) for view in views]

    outcomes = run_jobs(jobs, find_in_each, results)
    for _ in tqdm(outcomes, total=len(jobs), disable=None, unit=" images"):
        pass
    predictions: list[Prediction] = []
    single_jobs: list[PoseJob[Any]] = []
    for job in jobs:
        for prediction in results.by_image[job.name]:
            read = partial(_read_explained, job, prediction, method)
            predictions.append(prediction)
            single_jobs.append(replace(job, name=prediction.estimate.name, read=read))
    return predictions, single_jobs


def search_files(method: PoseMethod, inputs: PoseInputs, out: Path) -> int:
    """Find objects in every depth image, write the files of each, and give the exit code.

    Every object that is looked for has an entry, found or not: in an image NAME they are called
    NAME_0, NAME_1, ..., or NAME where one was looked for and not found. A rerun goes on where it
    was, and reads again what could not be read.
    """
    objects = tuple(model.name for model in method.models)
    if inputs.object is not None:
        objects = (pose_jobs.object_named(inputs.object, method),)
    if method.find is None:
        raise InputError(
            "--depth without --mask: these weights need masked views; give --mask, --box or "
            "--detections"
        )
    if find_rank().world > 1:
        raise InputError("--depth without --mask is done by one process; give --mask, or start one")
    plan = pose_jobs.plan_searches(method, inputs, objects, out)
    jobs = plan.jobs
    names = {job.name for job in jobs}
    for name in sorted(names):
        if (plain := re.sub(r"_\d+$", "", name)) != name and plain in names:
            raise InputError(
                f"two depth images are called {plain!r} and {name!r}, and so would be what is "
                "found in the first; rename one"
            )
    settings = {**method.settings, **plan.settings}
    pose_output.claim_for_jobs(out, settings, jobs, pose_output.is_result_of)
    earlier = [p for p in earlier_predictions(out).values() if p.estimate.status != "unreadable"]

    def is_of_image(prediction: Prediction, image: str) -> bool:
        return pose_output.is_result_of(prediction.estimate.name, image)

    results = SearchResults(out, [job.name for job in jobs], earlier, is_of_image)
    predictions, searched = _search(method, objects, jobs, results)
    pose_output.claim_for_jobs(out, settings, searched, pose_output.is_result_of)
    pose_output.write_files(predictions, searched, out, method, input_count=len(jobs))
    return pose_output.print_result(predictions, out, len(jobs))


def search_dataset(
    method: PoseMethod, options: DataSetOptions, object: str | None, out: Path
) -> int:
    """Search every image of a data set for every object of it, as 6D detection; give the exit code.

    No mask and no identity is told. A rerun goes on where it was.
    """
    assert options.bop is not None
    if method.find is None:
        raise InputError("--masks search: these weights need masked views; give other --masks")
    if find_rank().world > 1:
        raise InputError("--masks search is done by one process; give other --masks, or start one")
    dataset = open_bop(options.bop, options.split)
    if options.targets is not None:
        dataset = select_targets(dataset, read_targets(options.targets, options.bop))
    dataset = pose_methods.choose_objects(dataset, method, object)
    numbers = {name: n for n, name in pose_methods.match_names(dataset, method.models).items()}
    settings = {**method.settings, **pose_methods.dataset_settings(dataset), "masks": "search"}
    settings["find"] = sorted(numbers)
    pose_output.claim_for_dataset(out, settings, dataset)
    images = {(i.scene_id, i.image_id): i for i in dataset.instances}
    some_object = next(iter(numbers))
    jobs = [
        PoseJob(
            name=_image_name(place),
            read=partial(_whole_view, instance, some_object, _image_name(place)),
            place=place_of(instance),
        )
        for place, instance in sorted(images.items())
    ]

    def is_of_image(prediction: Prediction, image: str) -> bool:
        return prediction.place is not None and _image_name(prediction.place[:2]) == image

    earlier = list(earlier_predictions(out).values())
    results = SearchResults(out, [job.name for job in jobs], earlier, is_of_image, numbers)
    predictions, searched = _search(method, list(numbers), jobs, results)
    pose_output.write_files(predictions, searched, out, method, dataset, input_count=len(images))
    return pose_output.print_result(predictions, out, len(images))


def _frame_job(instance: Instance, object: str) -> PoseJob[Any]:
    """Take the whole depth image of an instance as a frame of a sequence."""
    read = partial(_whole_view, instance, object, instance.name)
    return PoseJob(name=instance.name, read=read, object=object, place=place_of(instance))


def _image_name(place: tuple[int, int]) -> str:
    """Name an image of a data set by its scene and its number."""
    scene_id, image_id = place
    return f"{scene_id:06d}_{image_id:06d}"


def _read_explained(job: PoseJob[Any], prediction: Prediction, method: PoseMethod) -> AnyInput:
    """Read a whole depth image with the mask of the pixels that a predicted pose explains."""
    view = job.read()
    pose = prediction.estimate.camera_from_model
    model = {model.name: model for model in method.models}.get(prediction.estimate.object)
    if model is None or pose is None or not isinstance(view, ViewInput):
        return view
    mask = explained_mask(view, pose, prepare_surface(model))
    return replace(view, name=prediction.estimate.name, mask=mask, object=model.name)


def track_files(method: PoseMethod, frames: SequenceOptions, out: Path) -> int:
    """Follow one object through depth images with a camera, or clouds; give the exit code."""
    unit = frames.unit
    start = None if frames.first is None else pose_methods.read_pose(frames.first)
    name = pose_jobs.object_named(frames.object, method)
    settings = {**method.settings, "track": name, **pose_jobs.unit_facts(unit)}
    if frames.cloud is not None:
        jobs = pose_jobs.cloud_jobs(frames.cloud, unit or "m", name, out)
    else:
        assert frames.depth is not None
        assert frames.camera is not None
        jobs = pose_jobs.frame_jobs(frames.depth, frames.camera, name, unit, out)
        settings |= pose_jobs.camera_facts(frames.camera)
    if frames.first is not None:
        settings |= {"first": pose_methods.name_with_checksum(frames.first)}
    pose_output.claim_for_jobs(out, settings, jobs)
    return _write_sequences(method, _follow(method, jobs, name, start), jobs, out)


def track_dataset(method: PoseMethod, frames: SequenceOptions, out: Path) -> int:
    """Follow each known object of each scene, or one; give the exit code."""
    assert frames.bop is not None
    dataset = open_bop(frames.bop, frames.split)
    dataset = pose_methods.choose_objects(dataset, method, frames.object)
    names = pose_methods.match_names(dataset, method.models)
    settings = {
        **method.settings,
        **pose_methods.dataset_settings(dataset),
        "track": sorted(names.values()),
    }
    pose_output.claim_for_dataset(out, settings, dataset)
    # The first instance of an object in each image of a scene is followed.
    first_instances: dict[tuple[int, int], dict[int, Instance]] = {}
    for instance in sorted(dataset.instances, key=lambda i: (i.image_id, i.index)):
        of_object = first_instances.setdefault((instance.scene_id, instance.object_id), {})
        of_object.setdefault(instance.image_id, instance)
    sequences = [
        [_frame_job(instance, names[number]) for instance in by_image.values()]
        for (_, number), by_image in sorted(first_instances.items())
    ]
    jobs = [job for sequence in sequences for job in sequence]
    followed = (
        prediction
        for sequence in sequences
        for prediction in _follow(method, sequence, str(sequence[0].object))
    )
    return _write_sequences(method, followed, jobs, out, dataset)


def _whole_view(instance: Instance, object: str, name: str) -> ViewInput:
    """Read the depth image of an instance without its mask."""
    depth_m = read_depth_png(instance.depth, instance.depth_unit_m)
    everywhere = torch.ones_like(depth_m, dtype=torch.bool)
    return ViewInput(name=name, depth_m=depth_m, mask=everywhere, K=instance.K, object=object)


def _write_sequences(
    method: PoseMethod,
    followed: Iterable[Prediction],
    jobs: Sequence[PoseJob[Any]],
    out: Path,
    dataset: BopDataset | None = None,
) -> int:
    """Follow sequences, write the files of their predictions, and print what became of the frames.

    They are written where the work is interrupted, too; what an earlier run found of frames that
    this one did not reach stays in the file.
    """
    earlier = list(earlier_predictions(out).values())
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
    pairs = zip(predictions, jobs, strict=True)
    explained = [
        replace(
            job,
            name=prediction.estimate.name,
            read=partial(_read_explained, job, prediction, method),
        )
        for prediction, job in pairs
    ]
    pose_output.write_files(predictions, explained, out, method, dataset)
    code = pose_output.print_result(predictions, out)
    kinds = Counter(p.estimate.tracking for p in predictions if p.estimate.tracking is not None)
    print(", ".join(f"{kinds[kind]} {kind}" for kind in ("tracked", "found", "lost")))
    return code


def _follow(
    method: PoseMethod, jobs: Sequence[PoseJob[Any]], name: str, first: Rigid | None = None
) -> Iterator[Prediction]:
    """Follow an object frame by frame; an unreadable frame gets an estimate that says so."""

    def frames() -> Iterator[AnyInput | PoseEstimate]:
        """Read the frames one by one; one that cannot be read is an estimate that says so."""
        for job in tqdm(jobs, disable=None, unit=" frames"):
            try:
                frame = job.read()
            except InputError as error:
                frame = unreadable_estimate(job.name, name, error)
            yield frame

    assert method.track is not None
    estimates = method.track(frames(), name, first)
    for job, estimate in zip(jobs, estimates, strict=True):
        yield Prediction(estimate=estimate, place=job.place)
