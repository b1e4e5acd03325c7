"""Errors of estimates against truth by published conventions, and which estimate is of what."""

import math
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from depthpose.core.camera import project
from depthpose.core.camera.pinhole import crop_intrinsics
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

BOP_WIDTH_PX = 640  #: width of the image in which MSPD is measured
_MARGIN_PX = 2  # of the window in which VSD is measured


@dataclass(frozen=True, kw_only=True, eq=False)
class ErrorContext:
    """The object and the settings by which errors are measured."""

    model: ObjectModel  #: the object
    diameter_m: float  #: by the table that ``EvaluationConfig.diameters`` names
    is_adds: bool  #: whether ADD-S decides a success, not ADD
    vsd_delta_m: float | None  #: as in ``EvaluationConfig``; None: VSD is not measured
    symmetries: Rigid  #: motions of the model that leave it as it is, the identity first
    triangles_m: Float[Tensor, "f 3 3"]  #: drawn for VSD; a model of points is drawn as discs


Errors = Float[Tensor, " n"]  #: one number; of VSD one for each tau, whose mean a row shows


@dataclass(frozen=True, kw_only=True)
class Metric:
    """An error of a pose, and how it is summed up in the rows of objects."""

    #: from the estimated ``camera_from_model``, the instance and the context to the error.
    measure: Callable[[Rigid, Instance, ErrorContext], Errors | Tensor | float]
    missing: tuple[float, ...] = (math.inf,)  #: the error of an instance without an estimate
    is_wanted: Callable[[ErrorContext], bool] = lambda _: True  #: whether it is measured at all
    #: columns of the rows of objects: from the name to a function of the errors (n, t) of all
    #: instances and their diameters [m] (n).
    summaries: Mapping[str, Callable[[Tensor, Tensor], float]] = field(default_factory=dict)
    has_median: bool = False  #: whether rows hold the median over estimates, ``NAME_median``


def find_nearest_copy(
    estimated: Rigid, true: Rigid, symmetries: Rigid, declared: Symmetries | None = None
) -> Rigid:
    """Find the symmetric copy of the true pose whose rotation is nearest to an estimate's.

    Args:
        estimated: ``camera_from_model``.
        true: the same, annotated.
        symmetries: motions of the model that leave it as it is, the identity first; rotations
            about an axis in steps.
        declared: the same symmetries with their axes; rotations about these are then exact, not
            rounded to a step.

    Returns:
        The copy, ``camera_from_model``.
    """
    # The nearest of the copies T_true S.
    R = symmetries.R.double()
    t_m = symmetries.t_m.double()
    true_R = true.R.double()
    copies = Rigid(true_R @ R, (true_R @ t_m[..., None])[..., 0] + true.t_m)
    nearest = int(geodesic_rad(estimated.R.double().expand_as(R), copies.R).argmin())
    copy = copies[nearest]
    if declared is None or not declared.continuous:
        return copy

    # A ball is rotated about its centre to the estimated rotation itself.
    estimated_R = estimated.R.double()
    copy_R_estimated = copy.R.mT @ estimated_R
    centre_m = declared.ball_centre_m
    if centre_m is not None:
        centre_m = centre_m.to(estimated_R)
        return copy @ Rigid(copy_R_estimated, centre_m - copy_R_estimated @ centre_m)

    # Else the copy is rotated about each axis a to the angle at which trace(D^T rotation(angle)),
    # with D from copy to estimate, is largest, and so the difference of the rotations least:
    # tan(angle) = a . (D32 - D23, D13 - D31, D21 - D12) / (trace(D) - a^T D a).
    skew = copy_R_estimated - copy_R_estimated.mT
    skew_vector = torch.stack([skew[2, 1], skew[0, 2], skew[1, 0]])
    rotated: list[Rigid] = []
    for axis in declared.continuous:
        a = axis.direction.to(estimated_R) / axis.direction.norm()
        cosine_part = copy_R_estimated.trace() - a @ copy_R_estimated @ a
        angle = torch.atan2(a @ skew_vector, cosine_part)
        rotated.append(copy @ turn_about(a, axis.point_m.to(estimated_R), angle))
    return min(rotated, key=lambda pose: float(geodesic_rad(estimated_R, pose.R)))


@lru_cache(maxsize=4)
def _read_depth(path: Path, unit_m: float, changed_ns: int) -> Float[Tensor, "h w"]:  # noqa: ARG001
    """Read a depth image, once for the instances in it; ``changed_ns``: a changed one anew."""
    return read_depth_png(path, unit_m)


def _measure_vsd(
    estimated: Rigid, instance: Instance, context: ErrorContext
) -> Float[Tensor, "10"]:
    """Measure the visible surface discrepancy at each of BOP's ten tolerances, 0..1."""
    assert context.vsd_delta_m is not None
    changed_ns = instance.depth.stat().st_mtime_ns if instance.depth.is_file() else 0
    depth_m = _read_depth(instance.depth, instance.depth_unit_m, changed_ns)
    true = instance.camera_from_model
    K = instance.K.double()

    # Pixels that neither pose covers do not count: only the window about both is rendered.
    estimated_m = estimated.double().apply(context.triangles_m).reshape(-1, 3)
    true_m = true.double().apply(context.triangles_m).reshape(-1, 3)
    pixels = project(torch.cat([estimated_m, true_m]), K)
    image_size_px = torch.tensor(depth_m.shape).flip(0)
    low = torch.zeros_like(image_size_px)
    high = image_size_px
    if bool(pixels.isfinite().all()):  # else a point lies behind the camera
        low = (pixels.amin(0) - _MARGIN_PX).clamp(min=0).minimum(image_size_px - 1).long()
        high = (pixels.amax(0) + _MARGIN_PX + 1).clamp(min=1).minimum(image_size_px).long()
    left, top = low.tolist()
    right, bottom = torch.maximum(high, low + 1).tolist()
    window_m = depth_m[top:bottom, left:right]
    window_K = crop_intrinsics(K, left, top)
    height, width = window_m.shape

    def render(pose: Rigid) -> Float[Tensor, "h w"]:
        """Render the depth [m] of the object in the window."""
        triangles_m = pose.double().apply(context.triangles_m)
        return rasterize(triangles_m, window_K, width, height, with_barycentric=False).depth_m

    taus_m = [share * context.diameter_m for share in BOP_SHARES]
    return vsd(estimated, true, window_m, window_K, render, taus_m, context.vsd_delta_m)


def _measure_add(estimated: Rigid, instance: Instance, context: ErrorContext) -> Tensor:
    """Measure ADD [m], or ADD-S where that decides a success."""
    measure = adds_m if context.is_adds else add_m
    return measure(estimated, instance.camera_from_model, context.model.vertices_m)


def _measure_adds(estimated: Rigid, instance: Instance, context: ErrorContext) -> Tensor:
    """Measure ADD-S [m]."""
    return adds_m(estimated, instance.camera_from_model, context.model.vertices_m)


def _measure_mssd(estimated: Rigid, instance: Instance, context: ErrorContext) -> Tensor:
    """Measure MSSD [m]."""
    points_m = context.model.vertices_m
    return mssd_m(estimated, instance.camera_from_model, points_m, context.symmetries)


def _measure_mspd(estimated: Rigid, instance: Instance, context: ErrorContext) -> Tensor:
    """Measure MSPD [px], scaled to an image 640 wide."""
    points_m = context.model.vertices_m
    true = instance.camera_from_model
    error_px = mspd_px(estimated, true, points_m, context.symmetries, instance.K)
    return (BOP_WIDTH_PX / image_size(instance.depth)[0]) * error_px


def _find_true_copy(estimated: Rigid, instance: Instance, context: ErrorContext) -> Rigid:
    """Find the symmetric copy of the annotated pose that is nearest to an estimate."""
    true = instance.camera_from_model
    return find_nearest_copy(estimated, true, context.symmetries, context.model.symmetries)


def _measure_rotation_deg(estimated: Rigid, instance: Instance, context: ErrorContext) -> Tensor:
    """Measure the angle to the nearest symmetric copy of the true pose [deg]."""
    true = _find_true_copy(estimated, instance, context)
    return geodesic_rad(estimated.R.double(), true.R.double()).rad2deg()


def _measure_translation_m(estimated: Rigid, instance: Instance, context: ErrorContext) -> Tensor:
    """Measure the distance to the nearest symmetric copy of the true pose [m]."""
    true = _find_true_copy(estimated, instance, context)
    return (true.t_m.double() - estimated.t_m.double()).norm(dim=-1)


METRICS = {
    "error_m": Metric(measure=_measure_add, summaries={"auc": lambda errors, _: auc(errors[:, 0])}),
    "adds_m": Metric(
        measure=_measure_adds, summaries={"auc_adds": lambda errors, _: auc(errors[:, 0])}
    ),
    "mssd_m": Metric(
        measure=_measure_mssd,
        summaries={
            "ar_mssd": lambda errors, diameters_m: average_recall(
                errors / diameters_m[:, None], BOP_SHARES
            )
        },
    ),
    "mspd_px": Metric(
        measure=_measure_mspd,
        summaries={"ar_mspd": lambda errors, _: average_recall(errors, BOP_PIXELS)},
    ),
    "rotation_deg": Metric(measure=_measure_rotation_deg, has_median=True),
    "translation_m": Metric(measure=_measure_translation_m, has_median=True),
    "vsd": Metric(
        measure=_measure_vsd,
        missing=(1.0,) * len(BOP_SHARES),
        is_wanted=lambda context: context.vsd_delta_m is not None,
        summaries={"ar_vsd": lambda errors, _: average_recall(errors, BOP_SHARES)},
    ),
}
"""Columns of instances, in order; a new metric is one entry. Rotation and translation are against
the nearest of the true poses that look alike."""


_POINTS = 500  # points of a model by which poses are assigned to instances
_LARGEST_COST_DIAMETERS = 1.0  # largest cost of an assignment; larger errors cost the same


def match_instances(
    instances: Sequence[Instance],
    predictions: Sequence[Prediction],
    models: Mapping[int, ObjectModel],
) -> dict[str, PoseEstimate]:
    """Match each instance with one estimate at most; return estimates by the instances' names.

    An estimate with an instance's name was computed from its mask and belongs to it, unless its
    place is another: in another dataset names may be the same. Of the others an image with n
    instances of an object takes the n of the highest scores, as BOP does, and matches them so that
    the sum of ADD-S, at most a diameter each, is least. BOP does so anew for each error and
    threshold. Refusals are matched with instances that are left over.
    """
    # Estimates that have the name of their instance.
    places = {instance.name: place_of(instance) for instance in instances}
    matched: dict[str, PoseEstimate] = {}
    unnamed: list[Prediction] = []
    for prediction in predictions:
        name = prediction.estimate.name
        if name in places and prediction.place in (None, places[name]):
            matched[name] = prediction.estimate
        else:
            unnamed.append(prediction)

    # The others, by image and object.
    unmatched: dict[Place, list[Instance]] = defaultdict(list)
    for instance in instances:
        if instance.name not in matched:
            unmatched[place_of(instance)].append(instance)
    offered: dict[Place, list[PoseEstimate]] = defaultdict(list)
    for prediction in unnamed:
        if prediction.place is not None and prediction.place in unmatched:
            offered[prediction.place].append(prediction.estimate)

    # For each place the poses of the highest scores, then refusals.
    for place, estimates in offered.items():
        instances_there = unmatched[place]
        model = models[place.object_id]
        posed = sorted((e for e in estimates if e.is_posed), key=score_of, reverse=True)
        matched |= _assign(instances_there, posed[: len(instances_there)], model)
        refusals = [estimate for estimate in estimates if not estimate.is_posed]
        left_over = [instance for instance in instances_there if instance.name not in matched]
        for instance, refusal in zip(left_over, refusals, strict=False):
            matched[instance.name] = refusal
    return matched


def _assign(
    instances: Sequence[Instance], estimates: Sequence[PoseEstimate], model: ObjectModel
) -> dict[str, PoseEstimate]:
    """Assign poses to instances of an object so that the sum of ADD-S is least (Hungarian)."""
    points_m = model.vertices_m[:: max(1, len(model.vertices_m) // _POINTS)]
    costs_m = np.zeros((len(instances), len(estimates)))
    if len(instances) > 1:
        for row, column in np.ndindex(costs_m.shape):
            pose = estimates[column].camera_from_model
            assert pose is not None
            error_m = float(adds_m(pose, instances[row].camera_from_model, points_m))
            costs_m[row, column] = min(error_m, _LARGEST_COST_DIAMETERS * model.diameter_m)
    assigned = zip(*linear_sum_assignment(costs_m), strict=True)
    return {instances[row].name: estimates[column] for row, column in assigned}


_TRIED = 40  # instances that each change is tried on
_LEAST_GAIN = 0.2  # least share of them that a change makes right, for it to be advised
_FEWEST_GAINED = 3  # least number of them that a change makes right, where as many are tried
_SCALES = {
    1.0: "",
    1000.0: "t were 1000 times larger (is it in metres? BOP's csv has millimetres)",
    10.0: "t were 10 times larger (is it in centimetres? BOP's csv has millimetres)",
    0.001: "t were 1000 times smaller (is it in mm? poses.json has metres, BOP's csv mm)",
}
_FLIP = torch.diag(torch.tensor([1.0, -1.0, -1.0]))
_CONVENTIONS: dict[str, Callable[[Rigid], Rigid]] = {
    "": lambda pose: pose,
    "R were transposed (it is written row by row)": lambda pose: Rigid(pose.R.mT, pose.t_m),
    "poses were inverted (they are camera_from_model)": lambda pose: pose.inverse(),
    "y and z of the camera were negated (y is down, z forward; OpenGL's are y up, z backward)": (
        lambda pose: Rigid(_FLIP.to(pose.R) @ pose.R, _FLIP.to(pose.t_m) @ pose.t_m)
    ),
}
_COUNTED_FROM = {"smaller (are yours counted from 1?)": -1, "larger (from 0?)": 1}


@dataclass(frozen=True, kw_only=True)
class _Change:
    """A change of all predictions that a mistake in the convention of a file may call for."""

    description: str = ""  #: completes "poses were right if ..."
    image_step: int = 0  #: added to the numbers of images
    object_step: int = 0  #: added to the numbers of objects
    convention: str = ""  #: of poses, a key of ``_CONVENTIONS``
    scale: float = 1.0  #: factor of translations

    def renumber(self, prediction: Prediction) -> Prediction:
        """Return a prediction with its numbers of image and object changed."""
        place = prediction.place
        if place is None:
            return prediction
        image_id = place.image_id + self.image_step
        object_id = place.object_id + self.object_step
        return replace(prediction, place=Place(place.scene_id, image_id, object_id))

    def repose(self, prediction: Prediction) -> Prediction:
        """Return a prediction with the convention and the scale of its pose changed."""
        pose = prediction.estimate.camera_from_model
        assert pose is not None
        pose = _CONVENTIONS[self.convention](pose.double())
        pose = Rigid(pose.R, pose.t_m * self.scale)
        return replace(prediction, estimate=replace(prediction.estimate, camera_from_model=pose))


def _list_changes() -> list[_Change]:
    """List the changes that are tried: of numbers by one, and of conventions and units of poses."""
    changes: list[_Change] = []
    for text, step in _COUNTED_FROM.items():
        changes.append(_Change(description=f"image numbers were one {text}", image_step=step))
        changes.append(_Change(description=f"object numbers were one {text}", object_step=step))
    for convention in _CONVENTIONS:
        for scale, text in _SCALES.items():
            both = " and ".join(filter(None, (text, convention)))
            changes.append(_Change(description=both, convention=convention, scale=scale))
    return changes


def advise_convention(
    dataset: BopDataset,
    predictions: Sequence[Prediction],
    contexts: Mapping[int, ErrorContext],
) -> str | None:
    """Advise a change of all predictions after which many more were right; None if there is none.

    Args:
        dataset: instances with truth.
        predictions: of any method.
        contexts: of the errors, by the number of the object.
    """
    # Where most are right as they are, no change makes many more right.
    posed = [p for p in predictions if p.estimate.is_posed]
    right, tried = _count_right(dataset, posed, contexts, _Change())
    if tried > 0 and right > (1 - _LEAST_GAIN) * tried:
        return None

    # The change after which most are right, if these are more by a fifth of those that were tried,
    # and by three, or by all of fewer.
    changes = _list_changes()
    counts = [_count_right(dataset, posed, contexts, change) for change in changes]
    best = max(range(len(changes)), key=lambda k: counts[k][0])
    best_right, best_tried = counts[best]
    least_gain = max(1, min(_FEWEST_GAINED, best_tried), _LEAST_GAIN * best_tried)
    if best_right < right + least_gain:
        return None
    return (
        f"{right} of {tried} answers that were tried are right, but {best_right} of {best_tried} "
        f"were if {changes[best].description}"
    )


def _count_right(
    dataset: BopDataset,
    posed: Sequence[Prediction],
    contexts: Mapping[int, ErrorContext],
    change: _Change,
) -> tuple[int, int]:
    """Count on some instances how many predictions are right after a change.

    Returns:
        The number of right ones, and the number of these instances.
    """
    # Some instances that have an estimate, once numbers are changed.
    renumbered = [change.renumber(prediction) for prediction in posed]
    matched = match_instances(dataset.instances, renumbered, dataset.objects)
    with_estimate = [instance for instance in dataset.instances if instance.name in matched]
    tried = with_estimate[:: max(1, len(with_estimate) // _TRIED)][:_TRIED]
    places = {place_of(instance) for instance in tried}
    names = {instance.name for instance in tried}
    reposed = [
        change.repose(prediction)
        for prediction in renumbered
        if prediction.place in places or prediction.estimate.name in names
    ]

    # A pose may be nearest to another instance of its object once it is changed.
    matched = match_instances(tried, reposed, dataset.objects)
    right = 0
    for instance in tried:
        if instance.name not in matched:
            continue
        pose = matched[instance.name].camera_from_model
        context = contexts[instance.object_id]
        assert pose is not None
        error_m = METRICS["error_m"].measure(pose, instance, context)
        right += float(error_m) < SUCCESS_SHARE * context.diameter_m
    return right, len(tried)
