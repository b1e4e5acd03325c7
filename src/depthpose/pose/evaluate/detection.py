"""6D detection as BOP has measured it since 2024: average precision, so wrong answers count too."""

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
"""Share of an instance that is seen; one of less is neither missed nor wrongly found."""
MOST_ESTIMATES = 100  #: of one image: the surest of all its objects
_LIMITS = {"mssd_m": BOP_SHARES, "mspd_px": BOP_PIXELS}  # of the diameter, and pixels
_COLUMNS = {"mssd_m": "ap_mssd", "mspd_px": "ap_mspd"}
_AWAY_DIAMETERS = 1.0
"""Centres of two poses that are so far apart: MSSD is beyond its largest limit, half a diameter."""

Pairs = Mapping[tuple[str, str], Mapping[str, Errors]]
"""Errors by the names of an estimate and an instance."""


@dataclass(kw_only=True, eq=False)
class _Image:
    """The instances and estimates of one object in one image."""

    instances: list[Instance] = field(default_factory=list)
    predictions: list[Prediction] = field(default_factory=list)


def detection_scores(
    dataset: BopDataset,
    predictions: Sequence[Prediction],
    contexts: Mapping[int, ErrorContext],
    measured: Pairs,
) -> dict[int, dict[str, float | None]]:
    """Give ``ap_mssd``, ``ap_mspd`` and their mean ``ap`` of each object, by its number.

    For each error and threshold the estimates of an image, the surest first, take the instance of
    the least error below the threshold that none has taken yet. An estimate that takes none is
    wrong; one that takes an instance of which less than a tenth is seen does not count, nor does
    such an instance. The average precision is that of all images of the data set; means are over
    thresholds, then over errors (Nguyen et al. 2025, BOP Challenge 2024). None where no instance
    counts.

    Args:
        dataset: instances with truth; estimates of other images are left out.
        predictions: with their places, or the names of instances.
        contexts: what the errors of each object depend on.
        measured: errors that are known already.
    """
    images = _by_image(dataset, predictions)
    scores: dict[int, dict[str, float | None]] = {}
    for number, context in contexts.items():
        shown = [image for place, image in images.items() if place.object_id == number]
        tables = [_error_tables(image, context, measured) for image in shown]
        row: dict[str, float | None] = {}
        for name, limits in _LIMITS.items():
            scale = context.diameter_m if name == "mssd_m" else 1.0
            of_limits = [
                _precision(shown, [table[name] for table in tables], scale * limit)
                for limit in limits
            ]
            counted = [value for value in of_limits if value is not None]
            row[_COLUMNS[name]] = sum(counted) / len(counted) if counted else None
        both = [value for value in row.values() if value is not None]
        scores[number] = {"ap": sum(both) / len(both) if both else None, **row}
    return scores


def _by_image(dataset: BopDataset, predictions: Sequence[Prediction]) -> dict[Place, _Image]:
    """Share instances and estimates among images and objects, the surest estimates first."""
    images: dict[Place, _Image] = defaultdict(_Image)
    places = {instance.name: place_of(instance) for instance in dataset.instances}
    for instance in dataset.instances:
        images[place_of(instance)].instances.append(instance)
    there = {place[:2] for place in images}
    numbers = {place.object_id for place in images}
    of_image: dict[tuple[int, int], list[tuple[Place, Prediction]]] = defaultdict(list)
    for prediction in predictions:
        place = prediction.place or places.get(prediction.estimate.name)
        if place is not None and place[:2] in there and prediction.estimate.is_posed:
            of_image[place[:2]].append((place, prediction))
    for pairs in of_image.values():
        pairs.sort(key=lambda pair: -score_of(pair[1].estimate))
        for place, prediction in pairs[:MOST_ESTIMATES]:
            if place.object_id in numbers:
                images[place].predictions.append(prediction)
    return images


def _error_tables(
    image: _Image, context: ErrorContext, measured: Pairs
) -> dict[str, Float[Tensor, "estimates instances"]]:
    """Measure every estimate against every instance; infinite where it is surely beyond limits."""
    size = (len(image.predictions), len(image.instances))
    tables = {name: torch.full(size, torch.inf, dtype=torch.float64) for name in _LIMITS}
    for row, prediction in enumerate(image.predictions):
        pose = prediction.estimate.camera_from_model
        assert pose is not None
        for column, instance in enumerate(image.instances):
            errors = measured.get((prediction.estimate.name, instance.name), {})
            for name, table in tables.items():
                if name in errors:
                    table[row, column] = float(errors[name])
                elif not _is_far(name, pose, instance, context):
                    table[row, column] = float(METRICS[name].measure(pose, instance, context))
    return tables


def _is_far(name: str, pose: Rigid, instance: Instance, context: ErrorContext) -> bool:
    """Say whether an error is beyond all its limits, without measuring it."""
    points_m = context.model.vertices_m.double()
    posed_m = [p.double().apply(points_m) for p in (pose, instance.camera_from_model)]
    if name == "mssd_m":
        away_m = float((posed_m[0].mean(0) - posed_m[1].mean(0)).norm())
        return away_m > _AWAY_DIAMETERS * context.model.diameter_m
    pixels = [project(points, instance.K) for points in posed_m]
    if not all(
        bool(places.isfinite().all()) for places in pixels
    ):  # a point lies behind the camera
        return False
    # No two points are nearer than the boxes about them.
    first, second = ((places.amin(0), places.amax(0)) for places in pixels)
    gap = torch.maximum(first[0] - second[1], second[0] - first[1]).clamp(min=0).norm()
    return float(gap) * BOP_WIDTH_PX / image_size(instance.depth)[0] > BOP_PIXELS[-1]


def _precision(
    images: Sequence[_Image], tables: Sequence[Float[Tensor, "_ _"]], limit: float
) -> float | None:
    """Give the average precision of one object at one threshold; None where nothing counts.

    In each image, the surest first, an estimate takes the nearest instance that is left. One that
    takes a mostly hidden instance is neither right nor wrong, as BOP has it.
    """
    counted: list[tuple[float, bool]] = []  # score, and whether it is right
    targets = 0
    for image, table in zip(images, tables, strict=True):
        hidden = {
            column
            for column, instance in enumerate(image.instances)
            if (1.0 if instance.visible_fraction is None else instance.visible_fraction)
            < LEAST_VISIBLE
        }
        targets += len(image.instances) - len(hidden)
        taken: set[int] = set()
        for row, prediction in enumerate(image.predictions):
            free = [k for k in range(len(image.instances)) if k not in taken]
            best = min(free, key=lambda k: float(table[row, k]), default=None)
            is_right = best is not None and float(table[row, best]) < limit
            if is_right:
                assert best is not None
                taken.add(best)
            if not (is_right and best in hidden):
                counted.append((score_of(prediction.estimate), is_right))
    if targets == 0:
        return None
    counted.sort(key=lambda pair: -pair[0])
    return average_precision([is_right for _, is_right in counted], targets)
