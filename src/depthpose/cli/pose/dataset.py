"""A dataset as options name it: its instances, its settings, and the objects of a method."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from depthpose.cli.pose.methods import PoseMethod
from depthpose.core.errors import InputError
from depthpose.pose import datasets
from depthpose.pose.evaluate import select_targets
from depthpose.pose.types import ObjectModel

_SAME_DIAMETER = 0.05
"""Largest relative difference of the diameters of one object in a dataset and in weights."""


def open_dataset(
    folder: Path, split: str, targets: Path | None = None, objects: Sequence[str] = ()
) -> datasets.BopDataset:
    """Open the instances of a split, restricted to targets and objects.

    Args:
        folder: of the dataset.
        split: name of the split.
        targets: BOP's list of targets; None: all instances.
        objects: names or numbers of those to keep; empty: all.

    Raises:
        InputError: the dataset or the list cannot be read, or nothing is left.
    """
    dataset = datasets.open_bop(folder, split)
    if targets is not None:
        dataset = select_targets(dataset, datasets.read_targets(targets, folder))
    return dataset.of_objects(*objects) if objects else dataset


def dataset_settings(dataset: datasets.BopDataset) -> dict[str, Any]:
    """List the settings that identify a dataset, wherever its folder lies."""
    return {
        "dataset": dataset.folder.resolve().name,
        "split": dataset.split,
        "annotations_sha256": dataset.sha256[:12],
    }


def match_names(dataset: datasets.BopDataset, models: Sequence[ObjectModel]) -> dict[int, str]:
    """Match the objects of a dataset to a method's, by name, else by number.

    Returns:
        The method's name of each object, by the object's number in the dataset.

    Raises:
        InputError: the method has no such object, or one of another diameter.
    """
    matched_models = _match_models(dataset, models)
    names: dict[int, str] = {}
    for number, dataset_model in dataset.objects.items():
        model = matched_models.get(number)
        if model is None:
            model_names = ", ".join(f"{m.name} ({m.number})" for m in models)
            raise InputError(
                f"object {number} ({dataset_model.name}) is none of those the weights know: "
                f"{model_names}. Leave it out by --objects"
            )
        if abs(model.diameter_m / dataset_model.diameter_m - 1) > _SAME_DIAMETER:
            raise InputError(
                f"object {number} ({dataset_model.name}) is {dataset_model.diameter_m:.4f} m "
                f"across, but the weights' {model.name} is {model.diameter_m:.4f} m: another "
                "object, or another unit"
            )
        names[number] = model.name
    return names


def _match_models(
    dataset: datasets.BopDataset, models: Sequence[ObjectModel]
) -> dict[int, ObjectModel]:
    """Match the objects of a dataset to a method's models.

    A model matches by the object's name; else by its number, unless the dataset has another object
    of the model's name.

    Returns:
        The model of each object that has one, by the object's number in the dataset.
    """
    names_in_dataset = set(datasets.read_object_names(dataset.folder).values())
    by_name = {model.name: model for model in models}
    by_number = {model.number: model for model in models if model.name not in names_in_dataset}
    matched_models: dict[int, ObjectModel] = {}
    for number, dataset_model in dataset.objects.items():
        model = by_name.get(dataset_model.name) or by_number.get(number)
        if model is not None:
            matched_models[number] = model
    return matched_models


def choose_objects(
    dataset: datasets.BopDataset, method: PoseMethod, object: str | None
) -> datasets.BopDataset:
    """Restrict a dataset to the objects that a method has, or to the one named.

    Objects that the method does not have are printed. ``object``: name or number; None: all.

    Raises:
        InputError: the method has none of the objects.
    """
    numbers = {model.name: model.number for model in method.models}
    if object is not None:
        names_in_dataset = datasets.read_object_names(dataset.folder).values()
        if object not in names_in_dataset and object in numbers:
            return dataset.of_objects(numbers[object])  # the method's own name of the object
        return dataset.of_objects(object)  # the dataset's name or number of it

    object_ids = sorted({instance.object_id for instance in dataset.instances})
    matched_models = _match_models(dataset, method.models)
    matched_ids = [number for number in object_ids if number in matched_models]
    left_out = sorted(set(object_ids) - set(matched_ids))
    if not matched_ids:
        raise InputError(
            f"{dataset.folder}: holds objects {left_out}, but the {method.holder} know "
            f"{', '.join(numbers)}; give {method.holder} of its objects"
        )
    if left_out:
        message = f"left out, as the {method.holder} do not know them: objects {left_out}"
        print(message, file=sys.stderr)
    return dataset.of_objects(*matched_ids)
