"""Masks of a dataset by their names: annotated, published, detected or segmented ones."""

import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any

from tqdm import tqdm

from depthpose.cli.file_names import name_files
from depthpose.cli.pose.dataset import dataset_settings
from depthpose.cli.pose.dataset_jobs import make_best_detection_jobs, make_instance_jobs
from depthpose.core.checkpoint import file_sha256, find_weights
from depthpose.core.errors import InputError
from depthpose.core.files import read_image, write_json
from depthpose.core.run_folder import claim_folder
from depthpose.pose import datasets
from depthpose.pose.datasets.entries import read_integer, read_rows
from depthpose.pose.predictions import PoseJob
from depthpose.pose.segmentation import Segmenter
from depthpose.pose.types import ViewInput


@dataclass(frozen=True, kw_only=True, eq=False)
class Masks:
    """One kind of masks of a dataset."""

    name: str  #: name in tables
    #: makes a job for each mask, given the method's names of the objects by their numbers
    make_jobs: Callable[[Mapping[int, str]], list[PoseJob[ViewInput]]]
    settings: Mapping[str, Any]  #: JSON values that decide which masks they are


def prepare_masks(
    kinds: Sequence[str], dataset: datasets.BopDataset, out: Path, device: str = "cpu"
) -> list[Masks]:
    """Prepare each kind of masks; images are segmented now where a kind is a segmentation.

    Args:
        kinds: each ``truth`` (annotated masks), ``predicted`` (those that came with
            Linemod_preprocessed), a JSON file of BOP detections, or weights of a segmentation.
        dataset: dataset whose instances are masked.
        out: folder of the run; segmented masks are written below it.
        device: device that segments.
    """
    paths = [find_mask_file(kind) for kind in kinds]
    names = name_files(kinds, paths)
    masks: list[Masks] = []
    for kind, path, name in zip(kinds, paths, names, strict=True):
        if path is not None:
            masks.append(_take_detected_masks(path, name, dataset, out, device))
        elif kind == "predicted":
            masks.append(_take_predicted_masks(dataset))
        else:
            make_jobs = partial(make_instance_jobs, dataset)
            masks.append(Masks(name=name, make_jobs=make_jobs, settings={}))
    return masks


def _take_detected_masks(
    path: Path, name: str, dataset: datasets.BopDataset, out: Path, device: str
) -> Masks:
    """Take masks from a JSON file of BOP detections, or segment the images by weights."""
    if path.suffix == ".json":
        detections = datasets.read_detections(path)
    else:
        detections = _segment_dataset(path, name, dataset, out, device)
    make_jobs = partial(make_best_detection_jobs, dataset, detections=detections)
    return Masks(name=name, make_jobs=make_jobs, settings={"masks_sha256": file_sha256(path)})


def _take_predicted_masks(dataset: datasets.BopDataset) -> Masks:
    """Take the masks that a segmentation network left in the dataset, as it was published."""
    predicted_mask = datasets.LAYOUTS[dataset.layout].predicted_mask
    if predicted_mask is None:
        raise InputError(
            f"{dataset.folder}: came without predicted masks, as Linemod_preprocessed has "
            "them; give --masks a file of BOP detections, or weights of a segmentation"
        )
    make_jobs = partial(make_instance_jobs, dataset, predicted_mask=predicted_mask)
    return Masks(name="predicted", make_jobs=make_jobs, settings={"masks_of": "segnet_results"})


def find_mask_file(kind: str) -> Path | None:
    """Find the file of a kind of masks, as :func:`prepare_masks` takes it.

    Returns:
        The file of detections, or of weights; None for ``truth`` and ``predicted``, which are in
        the dataset.
    """
    if kind in ("truth", "predicted"):
        return None
    return Path(kind) if kind.endswith(".json") else find_weights(kind)


def _segment_dataset(
    path: Path, name: str, dataset: datasets.BopDataset, out: Path, device: str
) -> list[datasets.Detection]:
    """Segment the images of a dataset by weights, except those that an earlier run segmented.

    Detections of all objects of the weights are written to ``OUT/detections/NAME.json``, so that a
    later run may ask for other objects, or for more images.

    Args:
        path: file of the weights.
        name: name of the masks.
        dataset: dataset whose images are segmented.
        out: folder of the run.
        device: device that segments.

    Returns:
        The detections of all images that any run has segmented.
    """
    segmenter = Segmenter.load(path, device)
    numbers = _match_numbers(segmenter, dataset, path)

    detections_folder = out / "detections" / name
    claim_folder(
        detections_folder, {"weights_sha256": file_sha256(path), **dataset_settings(dataset)}
    )
    detections_file = detections_folder.parent / f"{name}.json"
    images_file = detections_folder / "images.json"
    segmented: set[tuple[int, int]] = set()
    detections: list[datasets.Detection] = []
    with suppress(InputError):  # damaged or missing: all is segmented again
        earlier = datasets.read_detections(detections_file)
        segmented = _read_segmented_images(images_file)
        detections = [d for d in earlier if (d.scene_id, d.image_id) in segmented]

    images = {(i.scene_id, i.image_id): i for i in dataset.instances}
    unsegmented = [images[image] for image in sorted(images.keys() - segmented)]
    if unsegmented:
        for instance in tqdm(unsegmented, "segmentation", disable=None, unit=" images"):
            detections += _segment_image(segmenter, instance, numbers)
        datasets.write_detections(detections_file, detections)
        rows = [
            {"scene_id": scene, "im_id": image}
            for scene, image in sorted(segmented | images.keys())
        ]
        write_json(images_file, rows)
    return detections


def _match_numbers(
    segmenter: Segmenter, dataset: datasets.BopDataset, path: Path
) -> dict[str, int]:
    """Match the objects of a segmentation to those of a dataset: by name, else by number.

    Objects of the dataset that are not segmented are printed. ``path``: the weights, for errors.

    Returns:
        The number of each object in the dataset, by its name in the weights.

    Raises:
        InputError: no object of the dataset is segmented.
    """
    names = datasets.read_object_names(dataset.folder)
    number_by_name = {name: number for number, name in names.items()}
    weights_numbers = dict(zip(segmenter.weights.objects, segmenter.weights.numbers, strict=True))
    numbers: dict[str, int] = {}
    for name, number in weights_numbers.items():
        if name in number_by_name:
            numbers[name] = number_by_name[name]
        elif names.get(number) not in weights_numbers:  # the number is no other object's
            numbers[name] = number

    wanted = {instance.object_id for instance in dataset.instances}
    missing = sorted(wanted - set(numbers.values()))
    if len(missing) == len(wanted):
        weights_objects = ", ".join(f"{name} ({k})" for name, k in weights_numbers.items())
        raise InputError(
            f"{path}: segments {weights_objects}, but {dataset.folder} shows objects {missing}; "
            "give weights of its objects"
        )
    if missing:
        print(f"{path}: segments no objects {missing}; each is missing", file=sys.stderr)
    return numbers


def _read_segmented_images(path: Path) -> set[tuple[int, int]]:
    """Read which images an earlier run segmented: scene and image numbers."""
    source = str(path)
    return {
        (read_integer(row, "scene_id", source), read_integer(row, "im_id", source))
        for row in read_rows(path)
    }


def _segment_image(
    segmenter: Segmenter, instance: datasets.Instance, numbers: Mapping[str, int]
) -> list[datasets.Detection]:
    """Segment the image of an instance into detections of objects of the dataset.

    ``numbers``: number of each object in the dataset, by its name in the weights.

    Raises:
        InputError: the image has no colour picture.
    """
    if instance.rgb is None:
        raise InputError(f"{instance.name}: has no picture, and a segmentation needs pictures")
    start = perf_counter()
    segmented = segmenter.segment(read_image(instance.rgb))
    seconds = perf_counter() - start

    detections: list[datasets.Detection] = []
    for object, masks in segmented.masks.items():
        if object not in numbers:
            continue
        scores = segmented.scores[object].tolist()
        for mask, score in zip(masks, scores, strict=True):
            detection = datasets.Detection(
                scene_id=instance.scene_id,
                image_id=instance.image_id,
                object_id=numbers[object],
                score=score,
                segmentation=datasets.encode_rle(mask),
                seconds=seconds,
            )
            detections.append(detection)
    return detections
