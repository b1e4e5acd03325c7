"""Errors of estimates against truth, by the conventions of those who published."""

import math
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from depthpose.core.camera import project
from depthpose.core.files import image_size, read_depth_png
from depthpose.core.render import rasterize
from depthpose.core.rigid import Rigid, geodesic_rad
from depthpose.pose.datasets import BopDataset, Instance
from depthpose.pose.mesh import turn_about
from depthpose.pose.metrics import (
    BOP_PIXELS,
    BOP_SHARES,
    SUCCESS_SHARE,
    add_m,
    adds_m,
    auc,
    average_recall,
    mspd_px,
    mssd_m,
    vsd,
)
from depthpose.pose.predictions import Place, Prediction, place_of, score_of
from depthpose.pose.types import ObjectModel, PoseEstimate, Symmetries

BOP_WIDTH_PX = 640
_MARGIN_PX = 2


@dataclass(frozen=True, kw_only=True, eq=False)
class ErrorContext:
    """What the errors of an object depend on."""

    model: ObjectModel  #: the object
    diameter_m: float  #: of the table that was asked for
    is_adds: bool  #: whether ADD-S decides a success
    vsd_delta_m: float | None  #: see ``EvaluationConfig``; None: VSD is not measured
    symmetries: Rigid  #: motions of the model that leave it as it is, the identity first
    triangles_m: Float[Tensor, "f 3 3"]  #: what VSD draws; a model of points is drawn as discs


Errors = Float[Tensor, " n"]  #: one number, or several whose mean a row shows (VSD: one a tau)


@dataclass(frozen=True, kw_only=True)
class Metric:
    """An error of a pose, and what the rows of objects say of it."""

    #: ``(estimated, instance, context)``, the first ``camera_from_model``, to the error.
    measure: Callable[[Rigid, Instance, ErrorContext], Errors | Tensor | float]
    missing: tuple[float, ...] = (math.inf,)  #: the error of an instance without an answer
    is_wanted: Callable[[ErrorContext], bool] = lambda _: True  #: whether it is measured at all
    #: columns of the rows of objects: name to a function of the errors (n, t) of all instances and
    #: their diameters [m] (n).
    summaries: Mapping[str, Callable[[Tensor, Tensor], float]] = field(default_factory=dict)
    has_median: bool = False  #: whether rows of objects hold the median of answers, ``NAME_median``


def nearest_copy(
    estimated: Rigid, true: Rigid, symmetries: Rigid, declared: Symmetries | None = None
) -> Rigid:
    """Give the true pose that is turned least against an estimate, of those that look alike.

    ``symmetries`` are motions of the model that leave it as it is, the identity first. With the
    ``declared`` ones that they are of, turns about their axes are exact, not one of the steps.
    """
    R, t_m = symmetries.R.double(), symmetries.t_m.double()
    copies = Rigid(true.R.double() @ R, (true.R.double() @ t_m[..., None])[..., 0] + true.t_m)
    nearest = int(geodesic_rad(estimated.R.double().expand_as(R), copies.R).argmin())
    copy = copies[nearest]
    if declared is None or not declared.continuous:
        return copy
    # Turned about the axes of revolution until it is nearest.
    wanted, centre_m = estimated.R.double(), declared.ball_centre_m
    relative = copy.R.mT @ wanted
    if centre_m is not None:
        centre_m = centre_m.to(wanted)
        return copy @ Rigid(relative, centre_m - relative @ centre_m)
    turns = []
    for axis in declared.continuous:
        a = axis.direction.to(wanted) / axis.direction.norm()
        # The trace of relative^T turn(angle) is largest there.
        skew = relative - relative.mT
        across = torch.stack([skew[2, 1], skew[0, 2], skew[1, 0]])
        angle = torch.atan2(a @ across, relative.trace() - a @ relative @ a)
        turns.append(copy @ turn_about(a, axis.point_m.to(wanted), angle))
    return min(turns, key=lambda one: float(geodesic_rad(wanted, one.R)))


def _vsd(estimated: Rigid, instance: Instance, context: ErrorContext) -> Float[Tensor, "10"]:
    assert context.vsd_delta_m is not None
    depth_m = _read_depth(instance.depth, instance.depth_unit_m)
    poses, K = (estimated, instance.camera_from_model), instance.K.double().clone()
    # What neither pose covers does not count: only the window about both is drawn.
    size = torch.tensor(depth_m.shape).flip(0)
    points_m = torch.cat([one.double().apply(context.triangles_m).reshape(-1, 3) for one in poses])
    pixels = project(points_m, K)
    low, high = torch.zeros_like(size), size
    if bool(pixels.isfinite().all()):  # else something lies behind the camera
        low = (pixels.amin(0) - _MARGIN_PX).clamp(min=0).minimum(size - 1).long()
        high = (pixels.amax(0) + _MARGIN_PX + 1).clamp(min=1).minimum(size).long()
    (left, top), (right, bottom) = low.tolist(), torch.maximum(high, low + 1).tolist()
    K[0, 2] -= left
    K[1, 2] -= top
    window = depth_m[top:bottom, left:right]
    height, width = window.shape

    def render(pose: Rigid) -> Float[Tensor, "h w"]:
        triangles_m = pose.double().apply(context.triangles_m)
        return rasterize(triangles_m, K, width, height, with_barycentric=False).depth_m

    taus_m = [share * context.diameter_m for share in BOP_SHARES]
    return vsd(*poses, window, K, render, taus_m, context.vsd_delta_m)


_read_depth = lru_cache(maxsize=4)(read_depth_png)  # instances of one image follow each other

METRICS = {  # i: the instance, c: its context
    "error_m": Metric(  # ADD, or ADD-S where that decides a success
        measure=lambda pose, i, c: (adds_m if c.is_adds else add_m)(
            pose, i.camera_from_model, c.model.vertices_m
        ),
        summaries={"auc": lambda errors, _: auc(errors[:, 0])},
    ),
    "adds_m": Metric(
        measure=lambda pose, i, c: adds_m(pose, i.camera_from_model, c.model.vertices_m),
        summaries={"auc_adds": lambda errors, _: auc(errors[:, 0])},
    ),
    "mssd_m": Metric(
        measure=lambda pose, i, c: mssd_m(
            pose, i.camera_from_model, c.model.vertices_m, c.symmetries
        ),
        summaries={"ar_mssd": lambda errors, d: average_recall(errors / d[:, None], BOP_SHARES)},
    ),
    "mspd_px": Metric(  # scaled to an image 640 wide
        measure=lambda pose, i, c: (
            (BOP_WIDTH_PX / image_size(i.depth)[0])
            * mspd_px(pose, i.camera_from_model, c.model.vertices_m, c.symmetries, i.K)
        ),
        summaries={"ar_mspd": lambda errors, _: average_recall(errors, BOP_PIXELS)},
    ),
    "rotation_deg": Metric(
        measure=lambda pose, i, c: geodesic_rad(
            pose.R.double(),
            nearest_copy(pose, i.camera_from_model, c.symmetries, c.model.symmetries).R.double(),
        ).rad2deg(),
        has_median=True,
    ),
    "translation_m": Metric(
        measure=lambda pose, i, c: (
            nearest_copy(pose, i.camera_from_model, c.symmetries, c.model.symmetries).t_m.double()
            - pose.t_m.double()
        ).norm(dim=-1),
        has_median=True,
    ),
    "vsd": Metric(
        measure=_vsd,
        missing=(1.0,) * len(BOP_SHARES),
        is_wanted=lambda context: context.vsd_delta_m is not None,
        summaries={"ar_vsd": lambda errors, _: average_recall(errors, BOP_SHARES)},
    ),
}
"""Columns of instances, in order; a new metric is one entry. Rotation and translation are against
the nearest of the true poses that look alike."""


_POINTS = 500
_NEAR_DIAMETERS = 1.0


def match(
    instances: Sequence[Instance],
    predictions: Sequence[Prediction],
    models: Mapping[int, ObjectModel],
) -> dict[str, PoseEstimate]:
    """Give each instance the estimate that answers for it, by the instance's name.

    An estimate with an instance's name was computed from its mask, and is its own, unless
    it says that it belongs elsewhere: in another data set names may be the same. Of the
    others an image with n instances of an object takes the n of the highest scores, as BOP does,
    and sets them against the instances so that the sum of ADD-S, at most a diameter each, is least.
    BOP does so anew for each error and threshold. Refusals go to instances that are left over.
    """
    places = {instance.name: place_of(instance) for instance in instances}
    matched: dict[str, PoseEstimate] = {}
    others: list[Prediction] = []
    for prediction in predictions:
        place = places.get(prediction.estimate.name)
        if place is not None and prediction.place in (None, place):
            matched[prediction.estimate.name] = prediction.estimate
        else:
            others.append(prediction)
    waiting: dict[Place, list[Instance]] = defaultdict(list)
    for instance in instances:
        if instance.name not in matched:
            waiting[place_of(instance)].append(instance)
    offered: dict[Place, list[PoseEstimate]] = defaultdict(list)
    for prediction in others:
        if prediction.place is not None and prediction.place in waiting:
            offered[prediction.place].append(prediction.estimate)
    for place, estimates in offered.items():
        left, model = waiting[place], models[place.object_id]
        ranked = sorted((e for e in estimates if e.is_posed), key=score_of, reverse=True)
        answers = ranked[: len(left)]
        points_m = model.vertices_m[:: max(1, len(model.vertices_m) // _POINTS)]
        costs = np.zeros((len(left), len(answers)))
        for row, column in np.ndindex(costs.shape if len(left) > 1 else (0, 0)):
            pose, true = answers[column].camera_from_model, left[row].camera_from_model
            assert pose is not None
            error_m = float(adds_m(pose, true, points_m))
            costs[row, column] = min(error_m, _NEAR_DIAMETERS * model.diameter_m)
        for row, column in zip(*linear_sum_assignment(costs), strict=True):
            matched[left[row].name] = answers[column]
        refusals = [estimate for estimate in estimates if not estimate.is_posed]
        left = [instance for instance in left if instance.name not in matched]
        matched |= {i.name: e for i, e in zip(left, refusals, strict=False)}
    return matched


_TRIED = 40  # instances that each change is tried on
_MORE = 0.2  # a change is said where so large a share more is right by it
_SCALES = {
    1.0: "",
    1000.0: "t were 1000 times larger (is it in metres? BOP's csv has millimetres)",
    10.0: "t were 10 times larger (is it in centimetres? BOP's csv has millimetres)",
    0.001: "t were 1000 times smaller (is it in mm? poses.json has metres, BOP's csv mm)",
}
_TURNS = {
    "": lambda pose: pose,
    "R were transposed (it is written row by row)": lambda pose: Rigid(pose.R.mT, pose.t_m),
    "poses were inverted (they are camera_from_model)": lambda pose: pose.inverse(),
    "y and z of the camera were negated (y is down, z forward; OpenGL's are y up, z backward)": (
        lambda pose: Rigid(_FLIP.to(pose.R) @ pose.R, _FLIP.to(pose.t_m) @ pose.t_m)
    ),
}
_FLIP = torch.diag(torch.tensor([1.0, -1.0, -1.0]))

_STEPS = {
    f"{what} numbers were one {words}": tuple(step * (k == place) for k in range(3))
    for words, step in (("smaller (are yours counted from 1?)", -1), ("larger (from 0?)", 1))
    for place, what in enumerate(("image", "object"), 1)
}


def convention_advice(
    dataset: BopDataset,
    predictions: Sequence[Prediction],
    contexts: Mapping[int, ErrorContext],
) -> str | None:
    """Say by which change of all predictions many more were right; None where by none."""
    answers = [p for p in predictions if p.estimate.is_posed]

    def count_right(
        scale: float = 1.0, turn: str = "", step: Sequence[int] = (0, 0, 0)
    ) -> tuple[int, int]:
        moved = [
            one if one.place is None else replace(one, place=Place(*np.add(one.place, step)))
            for one in answers
        ]
        there = match(dataset.instances, moved, dataset.objects)
        seen = [instance for instance in dataset.instances if instance.name in there]
        some = seen[:: max(1, len(seen) // _TRIED)][:_TRIED]
        places, names = {place_of(one) for one in some}, {one.name for one in some}
        changed: list[Prediction] = []
        for one in moved:
            pose = one.estimate.camera_from_model
            if pose is not None and (one.place in places or one.estimate.name in names):
                pose = _TURNS[turn](Rigid(pose.R.double(), pose.t_m.double()))
                pose = Rigid(pose.R, pose.t_m * scale)
                estimate = replace(one.estimate, camera_from_model=pose)
                changed.append(replace(one, estimate=estimate))
        found, right = match(some, changed, dataset.objects), 0
        for instance in (one for one in some if one.name in found):
            pose, context = found[instance.name].camera_from_model, contexts[instance.object_id]
            assert pose is not None
            error_m = METRICS["error_m"].measure(pose, instance, context)
            right += float(error_m) < SUCCESS_SHARE * context.diameter_m
        return right, len(some)

    now, tried = count_right()
    if now > (1 - _MORE) * tried > 0:
        return None
    changes = [(*count_right(step=step), words) for words, step in _STEPS.items()]
    changes += [
        (*count_right(scale, turn), " and ".join(filter(None, (words, turn))))
        for turn in _TURNS
        for scale, words in _SCALES.items()
    ]
    best, of, advice = max(changes, key=lambda change: change[0])
    if best < now + max(1, min(3, of), _MORE * of):
        return None
    return (
        f"{now} of {tried} answers that were tried are right, but {best} of {of} were if {advice}"
    )
