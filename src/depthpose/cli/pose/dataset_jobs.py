"""Instances, detections and images of a dataset become jobs, each of which reads one view."""

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch

from depthpose.core.errors import InputError
from depthpose.core.files import read_depth_png
from depthpose.pose.datasets import BopDataset, Detection, Instance, mask_view, read_mask
from depthpose.pose.predictions import Place, PoseJob, place_of
from depthpose.pose.types import ViewInput


def make_instance_jobs(
    dataset: BopDataset, names: Mapping[int, str], predicted_mask: str | None = None
) -> list[PoseJob[ViewInput]]:
    """Make a job of each annotated instance, by its annotated mask or a predicted one.

    Args:
        dataset: with the instances.
        names: of the objects in the estimator, by number.
        predicted_mask: pattern of the files of predicted masks (``Layout.predicted_mask``); None:
            annotated masks.
    """
    jobs: list[PoseJob[ViewInput]] = []
    for instance in dataset.instances:
        mask = None
        object = names[instance.object_id]
        if predicted_mask is not None:
            file = predicted_mask.format(object=instance.object_id, image=instance.image_id)
            mask = dataset.folder / file
        read = partial(_read_instance, dataset, instance, object, mask)
        job = PoseJob(name=instance.name, read=read, object=object, place=place_of(instance))
        jobs.append(job)
    return jobs


def _read_instance(
    dataset: BopDataset, instance: Instance, object: str, mask: Path | None
) -> ViewInput:
    """Read the view of an instance, with the mask of a file; without one with its annotated mask.

    ``object``: the estimator's name of the object.
    """
    pixels = None if mask is None else read_mask(mask)
    return replace(dataset.view(instance, pixels).input, object=object)


def make_best_detection_jobs(
    dataset: BopDataset, names: Mapping[int, str], detections: Sequence[Detection]
) -> list[PoseJob[ViewInput]]:
    """Make jobs of the detections with the highest scores, as many as an image has instances.

    They are as many for each object. An instance that is not detected has no job, and counts as
    missing. The time of an image's detection is divided among its jobs.

    Args:
        dataset: with the instances.
        names: of the objects in the estimator, by number.
        detections: those of images that are not in the dataset are left out.

    Raises:
        InputError: a detection lacks its scene, image or object, or none is of the dataset.
    """
    # The best detections of each object in each image.
    instances_of_place: dict[Place, list[Instance]] = defaultdict(list)
    for instance in dataset.instances:
        instances_of_place[place_of(instance)].append(instance)
    best_of_place: dict[Place, list[Detection]] = defaultdict(list)
    for detection in sorted(detections, key=lambda d: -d.score):
        if detection.scene_id is None or detection.image_id is None or detection.object_id is None:
            raise InputError(
                f"{dataset.folder}: a detection of {detection.label!r} lacks scene_id, image_id or "
                "category_id; detections of a dataset have all three"
            )
        place = Place(detection.scene_id, detection.image_id, detection.object_id)
        if len(best_of_place[place]) < len(instances_of_place.get(place, ())):
            best_of_place[place].append(detection)
    chosen = [
        (place, k, detection)
        for place, best in best_of_place.items()
        for k, detection in enumerate(best)
    ]
    if not chosen:
        raise InputError(
            f"{dataset.folder}: none of the {len(detections)} detections is of an image and object "
            f"of split {dataset.split!r}; give those of this very split"
        )

    # A job for each, in the order of places.
    jobs_of_image = Counter(place[:2] for place, _, _ in chosen)
    jobs: list[PoseJob[ViewInput]] = []
    for place, k, detection in sorted(chosen, key=lambda item: item[:2]):
        name = f"{place.scene_id:06d}_{place.image_id:06d}_object{place.object_id}_{k}"
        seconds: dict[str, float] = {}
        if detection.seconds is not None:
            seconds = {"segmentation": detection.seconds / jobs_of_image[place[:2]]}
        instance = instances_of_place[place][0]  # any: only its image and camera are used
        object = names[place.object_id]
        read = partial(_read_image, instance, name, object, detection)
        jobs.append(PoseJob(name=name, read=read, object=object, place=place, seconds=seconds))
    return jobs


def make_image_job(instance: Instance, name: str, object: str) -> PoseJob[ViewInput]:
    """Make the job that reads the whole depth image of an instance, without its mask.

    Args:
        instance: whose image and camera are read.
        name: of the job.
        object: an object that may be in the image.
    """
    read = partial(_read_image, instance, name, object)
    return PoseJob(name=name, read=read, object=object, place=place_of(instance))


def _read_image(
    instance: Instance, name: str, object: str, detection: Detection | None = None
) -> ViewInput:
    """Read the depth image of an instance, with the mask or box of a detection, or without any."""
    depth_m = read_depth_png(instance.depth, instance.depth_unit_m)
    everywhere = torch.ones_like(depth_m, dtype=torch.bool)
    view = ViewInput(name=name, depth_m=depth_m, mask=everywhere, K=instance.K, object=object)
    return view if detection is None else mask_view(view, detection)
