"""Poses that fit: the evidence against each, how likely each is, how they differ in words.

The best of them is the answer, or the reason why it is withheld.
"""

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import torch
from jaxtyping import Float, Float64, Int64
from torch import Tensor
from torch.nn.functional import normalize

from depthpose.core.arrays import take_evenly
from depthpose.core.rigid import Rigid, cross_matrix, geodesic_rad
from depthpose.pose.cloud import local_planes
from depthpose.pose.config import EstimateConfig, IcpConfig, RefusalConfig
from depthpose.pose.estimator.fit import SHOWN, fit_of, identity_of, seen_about
from depthpose.pose.estimator.inputs import ObjectCloud, Refusal
from depthpose.pose.mesh import near_symmetries, sample_surface, symmetry_transforms
from depthpose.pose.mesh import true_symmetries as find_true
from depthpose.pose.refine import RefinedPose, refine_pose
from depthpose.pose.surface import NEAR, Surface, look_along_rays
from depthpose.pose.types import Alternative, Fit, ObjectModel, PoseEstimate, PoseFit, Vote
from depthpose.pose.voting import free_motions

_SAMPLED = 1000
"""At most so many points of the cloud are used, evenly taken."""
_THINNED = 500
"""Of so many points 20 neighbours reach about 0.08 diameters: far enough for normals that a real
sensor's noise, alike from pixel to pixel, does not turn."""
_TILTED = 250
"""At so many of them the normal is looked at."""
_COMPARED = 100
"""At about so many points a copy is chosen."""
_FLOOR = 0.01
"""Added to a signal before its logarithm is taken."""
_SAME = 0.1
"""Mean distance of the model's points at two poses, in diameters, up to which they are one."""
_NAMED = 0.02
"""Candidates of a smaller share are not named."""
_STEP = math.pi / 16
_ICP_POINTS = 250
"""Points of the cloud that refine candidates."""
_POINTS = 100
_ALONG = math.cos(math.radians(15))
_LONGER = 1.15
"""An axis is the longest or shortest where it differs by so much from the next."""


def disagreement(
    cloud: ObjectCloud, outputs: Float[Tensor, "n k c"], copies_m: Float[Tensor, "b m k 3"]
) -> Float64[Tensor, " b"]:
    """Mean angle between the network's directions and those to the keypoints of each pose [rad].

    ``copies_m``: for each pose the keypoints of the copies that the network could not distinguish
    from it; the copy counts at which the directions point best, by their mean cosine.
    """
    directions = normalize(outputs.double(), dim=-1)
    points_m = cloud.points_m.double()

    def cosines(some_m: Tensor, few: int) -> Float64[Tensor, "*batch m k"]:
        way = normalize(some_m[..., None, :, :] - points_m[::few, None], dim=-1)
        return (directions[::few] * way).sum(-1)

    best = torch.zeros(len(copies_m), dtype=torch.long)
    if copies_m.shape[1] > 1:
        few = max(1, len(points_m) // _COMPARED)
        best = cosines(copies_m, few).mean((-2, -1)).argmax(-1)
    chosen_m = copies_m[torch.arange(len(copies_m)), best]
    return cosines(chosen_m, 1).clamp(-1, 1).arccos().mean((-2, -1))


def log_signal(signal: float) -> float:
    """Take the logarithm in which signals are weighed: finite where there is none."""
    return math.log(_FLOOR + signal)


class CloudNormals(NamedTuple):
    """Some points of a cloud in float64, and their normals."""

    points_m: Float64[Tensor, "n 3"]
    normals: Float64[Tensor, "n 3"]


def cloud_normals(cloud_m: Float[Tensor, "n 3"]) -> CloudNormals:
    """Lay planes through some points of a cloud, once for all poses that are compared with it."""
    thinned_m = take_evenly(cloud_m.double(), _THINNED)
    some_m = take_evenly(thinned_m, _TILTED)
    return CloudNormals(some_m, local_planes(thinned_m, some_m)[0])


def surface_signals(
    cloud_m: Float[Tensor, "n 3"],
    poses: Rigid,
    surface: Surface,
    normals: CloudNormals | None = None,
) -> list[dict[str, float]]:
    """Say for each pose how well its surface explains the cloud, and the cloud the surface.

    A point seen through the posed surface contradicts the pose; surface that nobody saw may merely
    be occluded by something else.
    """
    normals = cloud_normals(cloud_m) if normals is None else normals
    limit_m = NEAR * surface.diameter_m
    points_m = take_evenly(cloud_m.double(), _SAMPLED)
    distance_m, _ = _nearest(points_m, poses, surface)
    is_near = distance_m < limit_m
    number = is_near.sum(-1)
    near_m2 = torch.where(is_near, distance_m.square(), 0.0).sum(-1) / number.clamp(min=1)
    front, unseen = look_along_rays(cloud_m.double(), poses, surface)
    columns = {
        "tilt": tilt_of(normals, poses, surface),
        "gap": torch.where(number > 0, near_m2.sqrt(), limit_m) / surface.diameter_m,
        "far": 1 - number / len(points_m),
        "front": front,
        "unseen": unseen,
    }
    rows = zip(*(column.tolist() for column in columns.values()), strict=True)
    return [dict(zip(columns, row, strict=True)) for row in rows]


def observability(
    cloud_m: Float[Tensor, "n 3"], pose: Rigid, surface: Surface, free: Float[Tensor, "m 6"]
) -> tuple[float, Float64[Tensor, "6"]]:
    """Measure how well the seen surface determines the pose: 0 where a motion is unobservable.

    A motion ``y = (d/2 w, v)`` about the middle of the cloud moves a surface point at ``a`` with
    normal ``n`` across itself by ``n . v + (a x n) . w``. The observability is the root mean square
    of that over the points near the surface, for the unit motion that moves it least (Gelfand et
    al., Geometrically Stable Sampling for the ICP Algorithm, 2003). Motions of declared symmetries
    (``free``) are left out. The weakest motion is given too: (rotation, translation at the middle
    of the cloud), of unit length after scaling.
    """
    points = take_evenly(cloud_m.double(), _SAMPLED)
    distance_m, index = _nearest(points, pose, surface)
    near = distance_m < NEAR * surface.diameter_m
    weakest = torch.zeros(6, dtype=torch.float64)
    if int(near.sum()) < 6:
        return 0.0, weakest
    normal = (surface.normals[index] @ pose.R.mT)[near]
    middle, radius_m = points.mean(0), surface.diameter_m / 2
    arm = points[near] - middle
    J = torch.cat([torch.linalg.cross(arm, normal) / radius_m, normal], -1)
    # Declared symmetries as motions about the middle, turns in metres at the radius.
    turn, shift = free[:, :3].double(), free[:, 3:].double()
    own = torch.cat([turn * radius_m, shift + turn @ cross_matrix(middle)], -1)
    basis = _complement(own)
    values, vectors = torch.linalg.eigh(basis.T @ (J.T @ J / len(J)) @ basis)
    return float(values[0].clamp(min=0).sqrt()), basis @ vectors[:, 0]


def without_motions(
    covariance: Float[Tensor, "6 6"], free: Float[Tensor, "m 6"]
) -> Float[Tensor, "6 6"]:
    """Give the covariance where the pose does not move along ``free``: finite, and 0 along them."""
    if len(free) == 0:
        return covariance
    basis = _complement(free.double())
    # Rotations and metres differ in size; the information of the rest is what counts.
    information = torch.linalg.inv(covariance.double())
    inner = torch.linalg.inv(basis.T @ information @ basis)
    return (basis @ inner @ basis.T).to(covariance)


def tilt_of(cloud: CloudNormals, poses: Rigid, surface: Surface) -> Float64[Tensor, " b"]:
    """Mean of 1 - |cosine| between normals of the cloud and of each posed surface near it."""
    distance_m, index = _nearest(cloud.points_m, poses, surface)
    is_near = distance_m < NEAR * surface.diameter_m
    cosine = (cloud.normals * (surface.normals[index] @ poses.R.mT)).sum(-1).abs()
    return 1 - torch.where(is_near, cosine, 0.0).sum(-1) / is_near.sum(-1).clamp(min=1)


def _nearest(
    points_m: Float64[Tensor, "n 3"], pose: Rigid, surface: Surface
) -> tuple[Float64[Tensor, "*batch n"], Int64[Tensor, "*batch n"]]:
    """Distance of each point to a posed surface, and the number of the point of it there."""
    local_m = pose.inverse().apply(points_m)
    index = surface.nearest(local_m)
    return (local_m - surface.points_m[index]).norm(dim=-1), index


def _complement(motions: Float64[Tensor, "m 6"]) -> Float64[Tensor, "6 r"]:
    """Give an orthonormal basis of what is orthogonal to all of the motions."""
    if len(motions) == 0:
        return torch.eye(6, dtype=torch.float64)
    _, values, rows = torch.linalg.svd(motions)
    rank = int((values > 1e-9 * values[0]).sum())
    return rows[rank:].T


@dataclass(frozen=True, kw_only=True, eq=False)
class PoseAmbiguities:
    """Pose ambiguities of a model.

    Attributes:
        same: ``model_from_model`` of the copies that are one answer, the identity first.
        near: of those that are another answer and look nearly alike.
        trained: of those that the network was trained to treat as one, the identity first.
        points_m: of the model, by which poses are compared.
        middle_m: of its box.
        axes: rows: its principal axes, from the longest.
        lengths_m: its extent along each.
        diameter_m: of the model.
    """

    same: Rigid
    near: Rigid
    trained: Rigid
    points_m: Float64[Tensor, "n 3"]
    middle_m: Float64[Tensor, "3"]
    axes: Float64[Tensor, "3 3"]
    lengths_m: Float64[Tensor, "3"]
    diameter_m: float


class Candidate(NamedTuple):
    """A pose that may be the right one, its covariance and what distance is left [m]."""

    pose: Rigid
    covariance: Float[Tensor, "6 6"]
    residual_m: float


def find_copies(model: ObjectModel, *, up_to_symmetry: bool) -> PoseAmbiguities:
    """Search a model for its near-symmetries, or count them as one answer with the true ones."""
    points_m = sample_surface(model, 2000)[0].double()
    near = [one.model_from_model for one in near_symmetries(model)]
    none = Rigid(torch.zeros(0, 3, 3).double(), torch.zeros(0, 3).double())
    turns = Rigid.stack(near) if near else none
    true = find_true(model)
    same = symmetry_transforms(true, _STEP).double()
    if up_to_symmetry:
        every = symmetry_transforms(model.symmetries, _STEP)
        same = Rigid.cat([same, every.double(), turns])
        turns = none
    trained = symmetry_transforms(model.symmetries, 2 * _STEP)
    compared_m = take_evenly(points_m, _POINTS)
    centre_m = true.ball_centre_m
    if centre_m is not None:  # every turn of a ball is the same pose: its centre alone says where
        compared_m = centre_m.to(points_m)[None]
        turns = none
    offset_m = points_m - points_m.mean(0)
    axes = torch.linalg.eigh(offset_m.T @ offset_m).eigenvectors.T.flip(0)
    along_m = points_m @ axes.T
    return PoseAmbiguities(
        same=same,
        near=turns,
        trained=trained.double(),
        points_m=compared_m,
        middle_m=(points_m.amin(0) + points_m.amax(0)) / 2,
        axes=axes,
        lengths_m=along_m.amax(0) - along_m.amin(0),
        diameter_m=model.diameter_m,
    )


def near_symmetry_lines(model: ObjectModel) -> list[str]:
    """Say after which turns a model looks nearly as before, and by how much it deviates."""
    copies = find_copies(model, up_to_symmetry=False)
    here = Rigid(torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))
    return [
        f"{difference_of(one.model_from_model, here, copies)} ({one.deviation:.1%})"
        for one in near_symmetries(model)
    ]


def find_candidates(
    cloud_m: Float[Tensor, "n 3"],
    best: Candidate,
    others: Rigid,
    copies: PoseAmbiguities,
    surface: Surface,
    config: IcpConfig | None,
) -> list[Candidate]:
    """Refine ``others``, at which ICP ended elsewhere, and the nearly symmetric copies of the best.

    The best comes first, then those that are other poses than it and than each other. Without a
    config of ICP the copies stay where they are.
    """
    starts = Rigid.cat([others, best.pose @ copies.near])
    kept = [best]
    if len(starts.R) == 0:
        return kept
    if config is None:
        poses = [starts[k] for k in range(len(starts.R))]
        tried = [best._replace(pose=pose) for pose in poses]
    else:
        short = replace(
            config,
            iterations=(config.iterations + 1) // 2,
            cloud_points=min(_ICP_POINTS, config.cloud_points),
        )
        found = refine_pose(cloud_m.double(), starts, surface, short)
        tried = [
            Candidate(found.camera_from_model[k], found.covariance[k], float(found.residual_m[k]))
            for k in range(len(starts.R))
            if float(found.inlier_share[k]) > 0  # else it is near no surface
        ]
    for one in tried:
        every = Rigid.stack([other.pose for other in kept])[:, None] @ copies.same
        gap_m = one.pose.apply(copies.points_m) - every.apply(copies.points_m)
        if float(gap_m.norm(dim=-1).mean(-1).min()) >= _SAME * copies.diameter_m:
            kept.append(one)
    return kept


def share_out(
    candidates: Sequence[Mapping[str, float]], slopes: Mapping[str, float]
) -> Float64[Tensor, " b"]:
    """Share the probability of one among candidates: ``exp(-sum slope log(0.01 + signal))``."""
    odds = [-sum(k * log_signal(one[name]) for name, k in slopes.items()) for one in candidates]
    return torch.tensor(odds, dtype=torch.float64).softmax(0)


def alternatives_among(
    candidates: Sequence[Candidate],
    evidence: Sequence[dict[str, float]],
    shares: Float64[Tensor, " b"],
    copies: PoseAmbiguities,
) -> tuple[Alternative, ...]:
    """Name the candidates beside the best, the likeliest first; unlikely ones are left out.

    Their probabilities are shares of one, in which the best has its own.
    """
    best, *order = shares.argsort(descending=True, stable=True).tolist()
    pose = candidates[best].pose
    return tuple(
        Alternative(
            camera_from_model=other.float(),
            probability=float(shares[k]),
            difference=difference_of(other, pose, copies),
            signals=evidence[k],
        )
        for k in order
        for other in [candidates[k].pose]
        if float(shares[k]) >= _NAMED
    )


def difference_of(pose: Rigid, from_pose: Rigid, copies: PoseAmbiguities) -> str:
    """Say how a pose differs from another: by which turn about which axis of the model."""
    turn = from_pose.R.double().mT @ pose.R.double()
    angle = math.degrees(float(geodesic_rad(turn, torch.eye(3, dtype=torch.float64))))
    middle_m = copies.middle_m[None]
    shift_m = float((pose.apply(middle_m) - from_pose.apply(middle_m)).norm())
    # The direction that the turn leaves alone, of the sign of a turn by up to 180 degrees.
    axis = torch.linalg.svd(turn - torch.eye(3, dtype=turn.dtype)).Vh[-1]
    skew = torch.stack([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    axis = axis if float(axis @ skew) >= 0 else -axis
    lengths, names = copies.lengths_m, {}
    if lengths[0] > _LONGER * lengths[1]:
        names[0] = "the long axis"
    if lengths[1] > _LONGER * lengths[2]:
        names[2] = "the short axis"
    if len(names) == 2:  # then the one between is known too
        names[1] = "the middle axis"
    x, y, z = (round(value, 2) + 0.0 for value in axis.tolist())  # no -0.00
    along = [name for k, name in names.items() if abs(float(copies.axes[k] @ axis)) > _ALONG]
    about = along[0] if along else f"the model's axis ({x:.2f}, {y:.2f}, {z:.2f})"
    words = f"turned by {angle:.0f} degrees about {about}"
    if shift_m > _SAME / 2 * copies.diameter_m:
        words += f" and shifted by {1000 * shift_m:.0f} mm"
    return words


@dataclass
class Clock:
    """Seconds of each stage."""

    seconds: dict[str, float] = field(default_factory=dict)
    last: float = field(default_factory=time.perf_counter)

    def note(self, stage: str) -> None:
        """Give a stage the time since the one before."""
        now = time.perf_counter()
        self.seconds[stage] = now - self.last
        self.last = now


def candidate_of(source: PoseFit | RefinedPose) -> Candidate:
    """Take a fitted or a refined pose as one that may be right."""
    return Candidate(source.camera_from_model.double(), source.covariance, float(source.residual_m))


def answer_of(
    cloud: ObjectCloud,
    model: ObjectModel,
    surface: Surface,
    copies: PoseAmbiguities,
    candidates: Sequence[Candidate],
    evidence: Sequence[dict[str, float]],
    refusal: RefusalConfig,
    config: EstimateConfig,
    clock: Clock,
    vote: Vote | None = None,
) -> PoseEstimate:
    """Choose among poses by the evidence against each; ask whether it fits and is that object."""
    seen = seen_about(cloud.cloud_m, cloud.view, surface.diameter_m)
    shares = share_out(evidence, refusal.candidate_slopes)
    number = int(shares.argsort(descending=True, stable=True)[0])
    fit = fit_of(seen, candidates[number].pose, surface)
    shares = shares * min(1.0, fit.agrees / SHOWN)  # the rest is that of a pose that was not found
    pose, covariance, residual_m = candidates[number]
    free = free_motions(model.symmetries.continuous, pose)
    reason, identity = misfit_of(fit, refusal), None
    if reason is None:
        observable, motion = observability(cloud.cloud_m, pose, surface, free)
        if observable < refusal.min_hold:
            what = "turn" if float(motion[:3].norm()) > math.sqrt(0.5) else "shift"
            reason = Refusal(
                status="not observable",
                reason=f"the seen part of the object leaves one {what} undetermined: it moves the "
                f"surface along its normals by {observable:.1%} of the motion only; no declared "
                "symmetry allows it. Declare the symmetry, or look from a side that shows more",
            )
    if reason is None and config.with_icp and refusal.max_size_error < 1:
        identity = identity_of(cloud, pose, model, surface, fit, seen, refusal.max_size_error)
        if identity.status == "contradicted":
            reason = Refusal(status="doubtful", reason=identity.reason)
    clock.note("check")
    # Worked out in float64, given as points and models come: in float32.
    answer = PoseEstimate(
        name="",
        object=model.name,
        status="ok",
        camera_from_model=pose.float(),
        keypoints_m=None if vote is None else vote.keypoints_m.float(),
        covariance=without_motions(covariance, free).float(),
        free_motions=free.float(),
        inlier_share=None if vote is None else float(vote.inlier_share.mean()),
        residual_m=residual_m,
        signals=evidence[number],
        fit=fit,
        identity=identity,
        certainty=float(shares[number]),
        alternatives=alternatives_among(candidates, evidence, shares, copies),
        seconds=clock.seconds,
    )
    if reason is not None:
        return withheld(answer.object, reason, clock, answer)
    return with_status(answer, config.min_certainty)


def with_status(answer: PoseEstimate, min_certainty: float) -> PoseEstimate:
    """Say that a pose is ambiguous where its certainty is below the limit, and else ok."""
    if answer.camera_from_model is None:
        return answer
    if answer.certainty is None or answer.certainty >= min_certainty:
        return replace(answer, status="ok", reason="")
    others = (
        f"{len(answer.alternatives)} others fit too" if answer.alternatives else "others may fit"
    )
    reason = (
        f"this pose has a certainty of {answer.certainty:.0%}, below min_certainty "
        f"{min_certainty:.0%}: {others}"
    )
    return replace(answer, status="ambiguous", reason=reason)


def misfit_of(fit: Fit, limits: RefusalConfig) -> Refusal | None:
    """Say why a pose does not fit what the camera saw; None where it does."""
    if fit.agrees < limits.min_agreement:
        reason = (
            f"of the posed surface that was seen {1 - fit.agrees:.0%} lies where the camera saw "
            f"something else, and {1 - limits.min_agreement:.0%} may: another object or pose"
        )
    elif fit.beyond > limits.max_beyond:
        reason = (
            f"{fit.beyond:.1%} of the object's readings lie beside the posed silhouette, and "
            f"{limits.max_beyond:.0%} may: another object, a larger one, or a mask of more than it"
        )
    elif fit.explained < limits.min_explained:
        reason = (
            f"{1 - fit.explained:.0%} of the object's readings are nowhere near the posed surface, "
            f"and {1 - limits.min_explained:.0%} may be: another object, or a mask of more than it"
        )
    else:
        return None
    return Refusal(status="doubtful", reason=reason)


def withheld(
    object: str, refusal: Refusal, clock: Clock, answer: PoseEstimate | None = None
) -> PoseEstimate:
    """Keep what was found out but the pose: a refusal cannot be taken for an answer."""
    known = PoseEstimate(name="", object=object, status=refusal.status, reason=refusal.reason,
                         seconds=clock.seconds)  # fmt: skip
    if answer is None:
        return known
    kept = ("keypoints_m", "inlier_share", "residual_m", "fit", "identity", "signals")
    return replace(known, **{name: getattr(answer, name) for name in kept})
