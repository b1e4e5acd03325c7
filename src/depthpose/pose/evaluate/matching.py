"""Which estimate is of which instance."""

from collections import defaultdict
from collections.abc import Mapping, Sequence

import numpy as np
from scipy.optimize import linear_sum_assignment

from depthpose.pose.bop import Instance
from depthpose.pose.metrics import adds_m
from depthpose.pose.predictions import Place, Prediction, place_of, score_of
from depthpose.pose.types import ObjectModel, PoseEstimate

_POINTS = 500
_NEAR_DIAMETERS = 1.0


def match(
    instances: Sequence[Instance],
    predictions: Sequence[Prediction],
    models: Mapping[int, ObjectModel],
) -> dict[str, PoseEstimate]:
    """Give each instance the estimate that answers for it, by the instance's name.

    An estimate that bears an instance's name was made from its very mask, and is its own, unless
    it says that it belongs elsewhere: in another data set names may be the same. Of the
    others an image with n instances of an object takes the n of the highest scores, as BOP does,
    and sets them against the instances so that the sum of ADD-S, at most a diameter each, is least.
    BOP does so anew for each error and threshold. Refusals go to instances that are left over.
    """
    places = {instance.name: place_of(instance) for instance in instances}
    own = [p for p in predictions if _is_own(p, places)]
    found = {p.estimate.name: p.estimate for p in own}
    waiting: dict[Place, list[Instance]] = defaultdict(list)
    for instance in instances:
        if instance.name not in found:
            waiting[place_of(instance)].append(instance)
    offered: dict[Place, list[PoseEstimate]] = defaultdict(list)
    for prediction in predictions:
        if not _is_own(prediction, places) and prediction.place in waiting:
            assert prediction.place is not None
            offered[prediction.place].append(prediction.estimate)
    for place, estimates in offered.items():
        found |= _assign(waiting[place], estimates, models[place.object_id])
    return found


def _is_own(prediction: Prediction, places: Mapping[str, Place]) -> bool:
    place = places.get(prediction.estimate.name)
    return place is not None and prediction.place in (None, place)


def _assign(
    instances: list[Instance], estimates: list[PoseEstimate], model: ObjectModel
) -> dict[str, PoseEstimate]:
    ranked = sorted((e for e in estimates if e.is_ok), key=score_of, reverse=True)
    answers = ranked[: len(instances)]
    chosen: dict[str, PoseEstimate] = {}
    if len(instances) == 1 and answers:
        chosen[instances[0].name] = answers[0]
    elif answers:
        costs = np.array([[_cost(i, e, model) for e in answers] for i in instances])
        for row, column in zip(*linear_sum_assignment(costs), strict=True):
            chosen[instances[row].name] = answers[column]
    refusals = [estimate for estimate in estimates if not estimate.is_ok]
    left = [instance for instance in instances if instance.name not in chosen]
    return chosen | {i.name: e for i, e in zip(left, refusals, strict=False)}


def _cost(instance: Instance, estimate: PoseEstimate, model: ObjectModel) -> float:
    assert estimate.camera_from_model is not None
    step = max(1, len(model.vertices_m) // _POINTS)
    error_m = adds_m(
        estimate.camera_from_model, instance.camera_from_model, model.vertices_m[::step]
    )
    return min(float(error_m), _NEAR_DIAMETERS * model.diameter_m)
