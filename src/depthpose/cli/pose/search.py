"""``depthpose pose predict`` without masks: whole depth images are searched for objects."""

import re
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from tqdm import tqdm

from depthpose.cli.pose.dataset import choose_objects, dataset_settings, match_names, open_dataset
from depthpose.cli.pose.dataset_jobs import make_image_job
from depthpose.cli.pose.methods import PoseMethod, resolve_object
from depthpose.cli.pose.options import DataSetOptions, PoseInputs
from depthpose.cli.pose.output import (
    claim_for_dataset,
    claim_for_jobs,
    is_result_of,
    make_picture_job,
    print_result,
    write_files,
)
from depthpose.cli.pose.plans import plan_searches
from depthpose.core.errors import InputError
from depthpose.core.processes import find_rank
from depthpose.core.runner import Job, Results, run_jobs
from depthpose.pose.predictions import (
    Place,
    PoseJob,
    Prediction,
    read_earlier_predictions,
    refuse_unreadable,
    write_predictions,
)
from depthpose.pose.types import PoseEstimate, ViewInput


class SearchResults(Results[ViewInput, list[PoseEstimate]]):
    """The estimates of each searched image, often several, in the ``poses.json`` of a folder.

    The file is written after every image, and keeps what earlier runs found in other images.
    ``by_image``: the predictions of this run and of earlier ones, by the image's name.
    """

    def __init__(
        self,
        folder: Path,
        images: Sequence[str],
        objects: Sequence[str],
        is_of_image: Callable[[Prediction, str], bool],
        numbers: Mapping[str, int] | None = None,
    ) -> None:
        """Sort the predictions of earlier runs by images.

        Args:
            folder: folder of ``poses.json``.
            images: names of the images of this run.
            objects: names of the objects that are searched for.
            is_of_image: whether a prediction is of the image of this name.
            numbers: number of each object in the dataset, by its name; None: no dataset.
        """
        self.by_image: dict[str, list[Prediction]] = {}
        self._folder = folder
        self._images = images
        self._objects = objects
        self._numbers = numbers
        self._in_other_images = list(read_earlier_predictions(folder).values())
        for image in images:
            in_image = [p for p in self._in_other_images if is_of_image(p, image)]
            self._in_other_images = [p for p in self._in_other_images if p not in in_image]
            is_unreadable = any(p.estimate.status == "unreadable" for p in in_image)
            if in_image and not is_unreadable:  # else it is searched again
                self.by_image[image] = in_image

    def is_finished(self, job: Job[ViewInput]) -> bool:
        """Whether the image has been searched."""
        return job.name in self.by_image

    def store(self, job: Job[ViewInput], result: list[PoseEstimate]) -> None:
        """Write the estimates of an image."""
        self._keep(job, result)

    def store_failure(self, job: Job[ViewInput], error: InputError) -> None:
        """Write for each object why an image cannot be read."""
        names = [job.name]
        if len(self._objects) > 1:
            names = [f"{job.name}_{k}" for k in range(len(self._objects))]
        unreadable = [
            refuse_unreadable(name, object, error)
            for name, object in zip(names, self._objects, strict=True)
        ]
        self._keep(job, unreadable)

    def _keep(self, job: Job[ViewInput], estimates: Sequence[PoseEstimate]) -> None:
        """Keep the estimates of an image, and write the file."""
        assert isinstance(job, PoseJob)
        self.by_image[job.name] = [
            Prediction(estimate=estimate, place=self._place_of(job, estimate))
            for estimate in estimates
        ]
        self.flush()

    def flush(self) -> None:
        """Write ``poses.json``."""
        predictions = [p for image in self._images for p in self.by_image.get(image, ())]
        write_predictions(self._folder, [*predictions, *self._in_other_images])

    def _place_of(self, job: PoseJob[ViewInput], estimate: PoseEstimate) -> Place | None:
        """Return scene, image and object number of an estimate; None outside a dataset."""
        if self._numbers is None or job.place is None:
            return None
        return job.place._replace(object_id=self._numbers[estimate.object])


def _find_in_each(
    method: PoseMethod, objects: Sequence[str], views: Sequence[ViewInput]
) -> list[list[PoseEstimate]]:
    """Find objects in each view."""
    return [method.find(view, objects) for view in views]


def _search_images(
    method: PoseMethod,
    objects: Sequence[str],
    jobs: Sequence[PoseJob[Any]],
    results: SearchResults,
) -> tuple[list[Prediction], list[PoseJob[Any]]]:
    """Search the images that are not searched yet.

    Args:
        method: finds the objects.
        objects: names of the objects.
        jobs: the images.
        results: store of what is found.

    Returns:
        The predictions of all images, and for each a job that reads its image with the mask of that
        object alone, for pictures.
    """
    outcomes = run_jobs(jobs, partial(_find_in_each, method, objects), results)
    for _ in tqdm(outcomes, total=len(jobs), disable=None, unit=" images"):
        pass  # an image is searched as its outcome is asked for
    predictions: list[Prediction] = []
    object_jobs: list[PoseJob[Any]] = []
    for job in jobs:
        for prediction in results.by_image[job.name]:
            predictions.append(prediction)
            object_jobs.append(make_picture_job(job, prediction, method))
    return predictions, object_jobs


def search_files(method: PoseMethod, inputs: PoseInputs, out: Path) -> int:
    """Find objects in every depth image, write the files of each, and return the exit code.

    Every object that is searched for has an entry, found or not: in an image NAME they are called
    NAME_0, NAME_1, ..., or NAME where a single object was searched for and not found. A rerun
    searches the images that are not finished, and those that could not be read.

    Args:
        method: finds the objects.
        inputs: options that name the images and objects.
        out: folder of the results.

    Raises:
        InputError: the method cannot search, or images or options cannot be used.
    """
    if inputs.object is None:
        objects = [model.name for model in method.models]
    else:
        objects = [resolve_object(inputs.object, method)]
    if method.estimator.needs_mask:
        raise InputError(
            "--depth without --mask: these weights need masked views; give --mask, --box or "
            "--detections"
        )
    if find_rank().world > 1:
        raise InputError("--depth without --mask is done by one process; give --mask, or start one")
    plan = plan_searches(method, inputs, objects, out)
    jobs = plan.jobs
    _refuse_numbered_names({job.name for job in jobs})
    settings = {**method.settings, **plan.settings}
    claim_for_jobs(out, settings, jobs, is_result_of)
    results = SearchResults(out, [job.name for job in jobs], objects, _has_name_of_image)
    predictions, object_jobs = _search_images(method, objects, jobs, results)

    # The files of results have names of their own, which are claimed once they are known.
    claim_for_jobs(out, settings, object_jobs, is_result_of)
    write_files(predictions, object_jobs, out, method, input_count=len(jobs))
    return print_result(predictions, out, len(jobs))


def _has_name_of_image(prediction: Prediction, image: str) -> bool:
    """Whether a prediction is of the depth image of this name, by its own name."""
    return is_result_of(prediction.estimate.name, image)


def _has_place_in_image(prediction: Prediction, image: str) -> bool:
    """Whether a prediction is of the image of this name, by its place in a dataset."""
    return prediction.place is not None and _name_image(prediction.place[:2]) == image


def _refuse_numbered_names(names: Collection[str]) -> None:
    """Refuse an image that is named as an object in another image would be: NAME_1 beside NAME."""
    for name in sorted(names):
        image = re.sub(r"_\d+$", "", name)
        if image != name and image in names:
            raise InputError(
                f"two depth images are called {image!r} and {name!r}, and so would be what is "
                "found in the first; rename one"
            )


def search_dataset(
    method: PoseMethod, options: DataSetOptions, object: str | None, out: Path
) -> int:
    """Search every image of a dataset for each of its objects (6D detection).

    The method is given neither masks nor which objects an image shows. A rerun searches the images
    that are not finished.

    Args:
        method: finds the objects.
        options: the dataset.
        object: name or number of the only object that is searched for; None: all.
        out: folder of the results.

    Returns:
        The exit code.
    """
    assert options.bop is not None
    if method.estimator.needs_mask:
        raise InputError("--masks search: these weights need masked views; give other --masks")
    if find_rank().world > 1:
        raise InputError("--masks search is done by one process; give other --masks, or start one")
    dataset = open_dataset(options.bop, options.split, options.targets)
    dataset = choose_objects(dataset, method, object)
    names = match_names(dataset, method.models)
    numbers = {name: number for number, name in names.items()}
    settings = {
        **method.settings,
        **dataset_settings(dataset),
        "masks": "search",
        "find": sorted(numbers),
    }
    claim_for_dataset(out, settings, dataset)

    # A job for each image, which is read by any of its instances. A view must name an object, of
    # which a search makes no use.
    images = {(i.scene_id, i.image_id): i for i in dataset.instances}
    any_object = next(iter(numbers))
    jobs = [
        make_image_job(instance, _name_image(image), any_object)
        for image, instance in sorted(images.items())
    ]

    results = SearchResults(
        out, [job.name for job in jobs], list(numbers), _has_place_in_image, numbers
    )
    predictions, object_jobs = _search_images(method, list(numbers), jobs, results)
    write_files(predictions, object_jobs, out, method, dataset, input_count=len(images))
    return print_result(predictions, out, len(images))


def _name_image(image: tuple[int, int]) -> str:
    """Name an image of a dataset by its scene and its number."""
    scene_id, image_id = image
    return f"{scene_id:06d}_{image_id:06d}"
