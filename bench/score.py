"""The sections of ``bench/real.py``: their type, and the errors of a pose that they measure.

Errors are of points of the model's surface, in diameters: ADD, to the nearest copy of the true pose
by the symmetries that the dataset declares, and ADD-S, from each true point to the nearest posed
one. A pose is right if its error is below 0.1.
"""

import inspect
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, NamedTuple

from torch import Tensor

from depthpose import GeoPoseNet, Registration
from depthpose.core.rigid import Rigid
from depthpose.pose.mesh import sample_surface, symmetry_transforms
from depthpose.pose.metrics import add_of_nearest_m, adds_m
from depthpose.pose.types import ObjectModel, PoseEstimate

Row = dict[str, Any]
Job = Callable[[], list[Row]]
Use = Literal["choice", "held"]
"""Whether a set takes part when a method or a limit is chosen, or is only looked at afterwards."""

RIGHT = 0.1  # largest error of a right pose, in diameters
POINTS = 1000  # of the surface, by which errors are measured


class Section(NamedTuple):
    """A part of the scoreboard, which ``bench/real.py`` runs and prints.

    ``jobs`` makes its jobs from the folder of the data and the number of seeds; each runs in one
    process and returns rows. ``table`` sums up the rows of all jobs to lines, which are named by
    their first column.
    """

    title: str
    jobs: Callable[[Path, int], list[Job]]
    table: Callable[[Sequence[Row]], list[Row]]


def errors_of(estimate: PoseEstimate, truth: Rigid, model: ObjectModel) -> Row:
    """Measure an answer: its status and errors (None without a pose).

    ``named`` says whether the answer or one of its alternatives is right by ADD.
    """
    row: Row = {
        "status": estimate.status, "certainty": estimate.certainty,
        "identity": None if estimate.identity is None else estimate.identity.status,
        "add": None, "adds": None, "named": False,
    }  # fmt: skip
    pose = estimate.camera_from_model
    if pose is None:
        return row
    row["add"] = add_to_copy(pose, truth, model)
    row["adds"] = float(adds_m(pose, truth, surface_points(model))) / model.diameter_m
    poses = [pose, *(alternative.camera_from_model for alternative in estimate.alternatives)]
    row["named"] = any(add_to_copy(candidate, truth, model) < RIGHT for candidate in poses)
    return row


def add_to_copy(pose: Rigid, truth: Rigid, model: ObjectModel) -> float:
    """Compute ADD, in diameters, to the nearest copy of the truth by the declared symmetries."""
    copies = symmetry_transforms(model.symmetries)
    error_m = add_of_nearest_m(pose, truth, surface_points(model), copies)
    return float(error_m) / model.diameter_m


@lru_cache(maxsize=64)
def surface_points(model: ObjectModel) -> Tensor:
    """Sample points of a model's surface; of a model of bare points, some of them."""
    return sample_surface(model, POINTS)[0]


def is_right(error: float | None) -> bool:
    """Whether an error in diameters is that of a right answer; None: there is no answer."""
    return error is not None and error < RIGHT


def accepts(function: Callable[..., Any], argument: str) -> bool:
    """Whether a function has an argument, so that earlier versions can be measured too."""
    return argument in inspect.signature(function).parameters


def use_seed(estimator: Registration | GeoPoseNet, seed: int) -> None:
    """Set the seed by which an estimator samples points."""
    config = estimator.config
    estimator.config = replace(config, voting=replace(config.voting, seed=seed))


def median(values: Sequence[float]) -> float | None:
    """Return the middle value, of two the larger; None of no values."""
    return sorted(values)[len(values) // 2] if values else None
