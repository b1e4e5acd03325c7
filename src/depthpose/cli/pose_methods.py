"""Methods of the pose room by their words, and the masks that they are shown."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from time import perf_counter
from typing import Any

from tqdm import tqdm

from depthpose.core.checkpoint import file_sha256, find_weights, read_checkpoint, say_terms
from depthpose.core.config import config_to_dict
from depthpose.core.errors import InputError
from depthpose.core.files import read_image
from depthpose.core.run import claim_folder
from depthpose.pose.baselines import DepthImageNet
from depthpose.pose.bop import (
    BopDataset,
    Detection,
    Instance,
    encode_rle,
    read_detections,
    write_detections,
)
from depthpose.pose.bop.linemod import segnet_mask
from depthpose.pose.config import EstimateConfig
from depthpose.pose.estimator import DepthImageRegressor, GeoPoseNet
from depthpose.pose.predictions import (
    Job,
    detection_jobs,
    instance_jobs,
    predict,
    read_predictions,
    results_name,
    write_bop_results,
)
from depthpose.pose.segmentation import Segmenter
from depthpose.pose.types import ObjectModel, PoseEstimate, ViewInput
from depthpose.pose.weights import read_pose_weights

_SAME_DIAMETER = 0.05

EstimateMany = Callable[[Sequence[ViewInput]], Sequence[PoseEstimate]]


@dataclass(frozen=True, kw_only=True, eq=False)
class PoseMethod:
    """An estimator, what to call it, the objects it knows, and what decides its results."""

    name: str
    estimate_many: EstimateMany
    models: Sequence[ObjectModel]
    settings: Mapping[str, Any]


@dataclass(frozen=True, kw_only=True, eq=False)
class Masks:
    """Which pixels a method is shown: what to call them, and the jobs that they make."""

    name: str
    jobs: Callable[[Mapping[int, str]], list[Job[ViewInput]]]
    settings: Mapping[str, Any]


def pose_method(word: str, config: EstimateConfig) -> PoseMethod:
    """Build the estimator of a weights file of any kind, given by its path or by name.

    Raises:
        InputError: there are no such weights, or they pose nothing.
    """
    path = find_weights(word)
    found = read_pose_weights(path)
    say_terms(found.facts)
    is_regressor = isinstance(found.network, DepthImageNet)
    net = DepthImageRegressor(found, config) if is_regressor else GeoPoseNet(found, config)
    suffix = "" if config.voting.method == "ransac" else "-least-squares"
    suffix += "" if config.with_icp else "-without-icp"
    facts = {"kind": read_checkpoint(path).kind, "weights": path.stem}
    facts |= {"weights_sha256": file_sha256(path)}
    return PoseMethod(
        name=path.stem + suffix,
        estimate_many=net.estimate_many,
        models=found.models,
        settings={**facts, "estimate": config_to_dict(config)},
    )


def find_masks(word: str, dataset: BopDataset, out: Path) -> Masks:
    """Understand ``truth``, ``predicted``, a file of BOP detections or segmentation weights.

    Raises:
        InputError: it is none of these, or the data set came without predicted masks.
    """
    if word == "truth":
        return Masks(name="truth", jobs=lambda names: instance_jobs(dataset, names), settings={})
    if word == "predicted":
        return _shipped_masks(dataset)
    if word.endswith(".json"):
        return _detected_masks(dataset, Path(word), Path(word).stem)
    path = find_weights(word)
    found = out / "detections" / f"{path.stem}.json"
    claim_folder(found.parent / path.stem, {"weights_sha256": file_sha256(path), **_of(dataset)})
    if not found.is_file():
        write_detections(found, list(_detect(Segmenter.load(path), dataset)))
    return _detected_masks(dataset, found, path.stem)


def predict_all(
    dataset: BopDataset, method: PoseMethod, masks: Masks, out: Path, batch: int = 1
) -> Path:
    """Estimate every instance that is not estimated yet, and write ``poses.json`` and BOP's csv.

    Returns:
        The folder of the predictions.
    """
    jobs = masks.jobs(match_names(dataset, method.models))
    home = out / "predictions" / f"{method.name}_{masks.name}"
    settings = {**method.settings, "masks": masks.name, **masks.settings, **_of(dataset)}
    written = predict(method.estimate_many, jobs, home, settings, batch)
    label = f"{method.name}, {masks.name} masks"
    for _ in tqdm(written, label, total=len(jobs), disable=None, unit=" instances"):
        pass
    write_bop_results(home / results_name(dataset), read_predictions(home))
    return home


def match_names(dataset: BopDataset, models: Sequence[ObjectModel]) -> dict[int, str]:
    """Find what a method calls each object of a data set: by its name, else by its number.

    Raises:
        InputError: the method does not know an object, or means another one of that number.
    """
    by_name = {model.name: model for model in models}
    by_number = {model.number: model for model in models}
    names: dict[int, str] = {}
    for number, own in dataset.objects.items():
        model = by_name.get(own.name) or by_number.get(number)
        if model is None:
            known = ", ".join(f"{m.name} ({m.number})" for m in models)
            raise InputError(
                f"object {number} ({own.name}) is none of those the weights know: {known}. Leave "
                "it out by --objects"
            )
        if abs(model.diameter_m / own.diameter_m - 1) > _SAME_DIAMETER:
            raise InputError(
                f"object {number} ({own.name}) is {own.diameter_m:.4f} m across, but the weights' "
                f"{model.name} is {model.diameter_m:.4f} m: another object, or another unit"
            )
        names[number] = model.name
    return names


def _of(dataset: BopDataset) -> dict[str, Any]:
    return {"dataset": dataset.folder.resolve().name, "split": dataset.split}


def _shipped_masks(dataset: BopDataset) -> Masks:
    def mask_of(instance: Instance) -> Path:
        return segnet_mask(dataset.folder, instance)

    if dataset.layout == "BOP":
        raise InputError(
            f"{dataset.folder}: came without predicted masks, as Linemod_preprocessed has them; "
            "give --masks a file of BOP detections, or weights of a segmentation"
        )
    return Masks(
        name="predicted",
        jobs=lambda names: instance_jobs(dataset, names, mask_of),
        settings={"masks_of": "segnet_results"},
    )


def _detected_masks(dataset: BopDataset, file: Path, name: str) -> Masks:
    detections = read_detections(file)
    return Masks(
        name=name,
        jobs=lambda names: detection_jobs(dataset, names, detections),
        settings={"masks_sha256": file_sha256(file)},
    )


def _detect(segmenter: Segmenter, dataset: BopDataset) -> Iterable[Detection]:
    """Segment each picture once; what it took is its time."""
    numbers = {model.name: number for number, model in dataset.objects.items()}
    ordered = sorted(dataset.instances, key=lambda i: (i.scene_id, i.image_id))
    images = [next(some) for _, some in groupby(ordered, key=lambda i: (i.scene_id, i.image_id))]
    for shown in tqdm(images, "segmentation", disable=None, unit=" images"):
        if shown.rgb is None:
            raise InputError(f"{shown.name}: has no picture, and a segmentation looks at pictures")
        start = perf_counter()
        found = segmenter.segment(read_image(shown.rgb))
        spent_s = perf_counter() - start
        for name, masks in found.masks.items():
            for mask, score in zip(masks, found.scores[name].tolist(), strict=True):
                if name in numbers:
                    yield Detection(
                        scene_id=shown.scene_id,
                        image_id=shown.image_id,
                        object_id=numbers[name],
                        score=score,
                        segmentation=encode_rle(mask),
                        seconds=spent_s,
                    )
