"""6D detection as BOP has measured it since 2024: average precision, so that wrong poses count."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from depthpose.core.camera import project
from depthpose.core.files import image_size
from depthpose.core.rigid import Rigid
from depthpose.pose.datasets import BopDataset, Instance
from depthpose.pose.evaluate.errors import BOP_WIDTH_PX, METRICS, ErrorContext, Errors
from depthpose.pose.metrics import BOP_PIXELS, BOP_SHARES, average_precision
from depthpose.pose.predictions import Place, Prediction, place_of, score_of

LEAST_VISIBLE = 0.1
"""Least visible share of an instance that counts: one that is hidden more is neither missed nor
wrongly detected."""
MOST_ESTIMATES = 100  #: of one image that count: those of the highest scores of all its objects
_LIMITS = {"mssd_m": BOP_SHARES, "mspd_px": BOP_PIXELS}  # in diameters, and in pixels
_COLUMNS = {"mssd_m": "ap_mssd", "mspd_px": "ap_mspd"}
_FAR_DIAMETERS = 1.0
"""Lower bound of MSSD, in diameters, beyond which it is not computed: twice its largest limit."""
_CUBE_CORNERS = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0], dtype=torch.float64)] * 3)
"""Corners (8, 3) of the cube of side 2 about the origin."""

ErrorsOfPairs = Mapping[tuple[str, str], Mapping[str, Errors]]
"""Errors by their names, for each pair of an estimate and an instance, by the names of both."""


@dataclass(kw_only=True, eq=False)
class _ObjectInImage:
    """The instances and estimates of one object in one image."""

    instances: list[Instance] = field(default_factory=list)  #: what is annotated
    predictions: list[Prediction] = field(default_factory=list)  #: the highest scores first


def score_detections(
    dataset: BopDataset,
    predictions: Sequence[Prediction],
    contexts: Mapping[int, ErrorContext],
    measured: ErrorsOfPairs,
) -> dict[int, dict[str, float | None]]:
    """Compute ``ap_mssd``, ``ap_mspd`` and their mean ``ap`` of each object, by its number.

    For each error and threshold the estimates of an image, those of the highest scores first, are
    matched with the instance of the least error below the threshold that is not matched yet. An
    estimate that is not matched is wrong. Instances of which less than a tenth is visible, and
    estimates matched with them, do not count. The average precision is that of all images of the
    dataset; means are over thresholds, then over errors (Nguyen et al. 2025, BOP Challenge 2024).
    None where no instance counts.

    Args:
        dataset: instances with truth; estimates of other images are left out.
        predictions: with their places, or the names of instances.
        contexts: of the errors, by the number of the object.
        measured: errors that were measured before, to save time.
    """
    images = _group_by_image(dataset, predictions)
    scores: dict[int, dict[str, float | None]] = {}
    for number, context in contexts.items():
        images_of_object = [image for place, image in images.items() if place.object_id == number]
        tables = [_measure_errors(image, context, measured) for image in images_of_object]
        precisions: dict[str, float | None] = {}
        for error, limits in _LIMITS.items():
            unit = context.diameter_m if error == "mssd_m" else 1.0
            tables_of_error = [table[error] for table in tables]
            at_limits = [
                _measure_precision(images_of_object, tables_of_error, unit * limit)
                for limit in limits
            ]
            precisions[_COLUMNS[error]] = average_measured(at_limits)
        scores[number] = {"ap": average_measured(list(precisions.values())), **precisions}
    return scores


def average_measured(values: Sequence[float | None]) -> float | None:
    """Average the values that are not None; None where there are none."""
    numbers = [value for value in values if value is not None]
    return sum(numbers) / len(numbers) if numbers else None


def _group_by_image(
    dataset: BopDataset, predictions: Sequence[Prediction]
) -> dict[Place, _ObjectInImage]:
    """Group instances and estimates by image and object, estimates of the highest scores first."""
    # The instances of each object in each image.
    images: dict[Place, _ObjectInImage] = defaultdict(_ObjectInImage)
    places = {instance.name: place_of(instance) for instance in dataset.instances}
    for instance in dataset.instances:
        images[place_of(instance)].instances.append(instance)

    # The estimates of images of the dataset; of one image at most 100.
    image_keys = {place[:2] for place in images}
    numbers = {place.object_id for place in images}
    of_image: dict[tuple[int, int], list[tuple[Place, Prediction]]] = defaultdict(list)
    for prediction in predictions:
        place = prediction.place or places.get(prediction.estimate.name)
        if place is not None and place[:2] in image_keys and prediction.estimate.is_posed:
            of_image[place[:2]].append((place, prediction))
    for entries in of_image.values():
        entries.sort(key=lambda entry: -score_of(entry[1].estimate))
        for place, prediction in entries[:MOST_ESTIMATES]:
            if place.object_id in numbers:
                images[place].predictions.append(prediction)
    return images


def _measure_errors(
    image: _ObjectInImage, context: ErrorContext, measured: ErrorsOfPairs
) -> dict[str, Float[Tensor, "estimates instances"]]:
    """Measure each estimate of an object in an image against each instance: a table for each error.

    An error that is certainly beyond its limits is infinite.
    """
    size = (len(image.predictions), len(image.instances))
    tables = {name: torch.full(size, torch.inf, dtype=torch.float64) for name in _LIMITS}
    for row, prediction in enumerate(image.predictions):
        pose = prediction.estimate.camera_from_model
        assert pose is not None
        for column, instance in enumerate(image.instances):
            errors = measured.get((prediction.estimate.name, instance.name), {})
            for error, table in tables.items():
                if error in errors:
                    table[row, column] = float(errors[error])
                elif not _is_certainly_far(error, pose, instance, context):
                    table[row, column] = float(METRICS[error].measure(pose, instance, context))
    return tables


def _is_certainly_far(error: str, pose: Rigid, instance: Instance, context: ErrorContext) -> bool:
    """Whether an error is certainly beyond all its limits, by a bound that is fast to compute.

    Args:
        error: ``mssd_m`` or ``mspd_px``.
        pose: the estimate, ``camera_from_model``.
        instance: with its true pose, of which each symmetric copy is compared.
        context: the model and its symmetries.
    """
    vertices_m = context.model.vertices_m.double()
    centroid_m = vertices_m.mean(0)
    centroid_copies_m = context.symmetries.double().apply(centroid_m[None])[:, 0]
    true_pose = instance.camera_from_model.double()
    estimated_m = pose.double().apply(vertices_m)

    # MSSD is the largest distance of a vertex, so at least that of the centroid, at every copy.
    if error == "mssd_m":
        true_centroids_m = true_pose.apply(centroid_copies_m)
        distance_m = float((true_centroids_m - estimated_m.mean(0)).norm(dim=-1).min())
        return distance_m > _FAR_DIAMETERS * context.diameter_m

    # All vertices at all copies lie in a ball about the true centroid, and so in the cube about it.
    radius_m = (vertices_m - centroid_m).norm(dim=-1).max()
    largest_shift_m = (centroid_copies_m - centroid_m).norm(dim=-1).max()
    cube_corners_m = (
        true_pose.apply(centroid_m[None]) + (radius_m + largest_shift_m) * _CUBE_CORNERS
    )

    # MSPD has a lower bound: the gap between the two projections' bounding boxes.
    estimated_px = project(estimated_m, instance.K)
    true_px = project(cube_corners_m, instance.K)
    if not bool(estimated_px.isfinite().all() & true_px.isfinite().all()):
        return False  # a point lies behind the camera
    right_gap = estimated_px.amin(0) - true_px.amax(0)
    left_gap = true_px.amin(0) - estimated_px.amax(0)
    gap_px = float(torch.maximum(right_gap, left_gap).clamp(min=0).norm())
    return gap_px * BOP_WIDTH_PX / image_size(instance.depth)[0] > BOP_PIXELS[-1]


def _measure_precision(
    images: Sequence[_ObjectInImage], tables: Sequence[Float[Tensor, "_ _"]], limit: float
) -> float | None:
    """Measure the average precision of one object at one threshold; None if no instance counts.

    In each image, the highest score first, an estimate is matched with the nearest instance that is
    left. One that is matched with a mostly hidden instance is neither right nor wrong, as in BOP.

    Args:
        images: the object in all images.
        tables: errors of each image's estimates (rows) against its instances.
        limit: error below which an estimate is right.
    """
    counted: list[tuple[float, bool]] = []  # score, and whether it is right
    targets = 0
    for image, table in zip(images, tables, strict=True):
        hidden = {k for k, instance in enumerate(image.instances) if _is_hidden(instance)}
        targets += len(image.instances) - len(hidden)
        unmatched = set(range(len(image.instances)))
        for row, prediction in enumerate(image.predictions):
            nearest = min(sorted(unmatched), key=lambda k: float(table[row, k]), default=None)
            is_right = nearest is not None and float(table[row, nearest]) < limit
            if is_right:
                unmatched.discard(nearest)
            if not (is_right and nearest in hidden):
                counted.append((score_of(prediction.estimate), is_right))
    if targets == 0:
        return None
    counted.sort(key=lambda pair: -pair[0])
    return average_precision([is_right for _, is_right in counted], targets)


def _is_hidden(instance: Instance) -> bool:
    """Whether less than a tenth of an instance is visible; False where that is not annotated."""
    return instance.visible_fraction is not None and instance.visible_fraction < LEAST_VISIBLE
