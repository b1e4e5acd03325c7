"""Directions of one cloud to its pose: vote, drop outliers, fit, refine, check."""

import time
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from depthpose.core.rigid import Rigid
from depthpose.pose.config import EstimateConfig, RefusalConfig, VotingConfig
from depthpose.pose.estimator.alternatives import (
    Candidate,
    Copies,
    alternatives_among,
    evidence_of,
    find_candidates,
    share_out,
)
from depthpose.pose.estimator.doubt import Posed, find_doubt
from depthpose.pose.estimator.evidence import vote_signals, without_motions
from depthpose.pose.estimator.prepare import Refusal
from depthpose.pose.estimator.prepare import Voted as Voted
from depthpose.pose.estimator.refusal import risk_of
from depthpose.pose.refine import refine_best
from depthpose.pose.surface import Surface
from depthpose.pose.types import Alternative, ObjectModel, PoseEstimate, PoseFit, Vote
from depthpose.pose.voting import (
    consistent_keypoints,
    fit_pose,
    free_motions,
    meet_lines,
    vote_ransac,
)

_LEAST = 4
"""Keypoints that must agree: three fix a pose with nothing left to contradict it."""


@dataclass
class _Clock:
    """Seconds of each stage."""

    seconds: dict[str, float] = field(default_factory=dict)
    last: float = field(default_factory=time.perf_counter)

    def note(self, stage: str) -> None:
        now = time.perf_counter()
        self.seconds[stage] = now - self.last
        self.last = now


class _Found(NamedTuple):
    """A pose, its covariance and residual, what speaks against it, and which others fit."""

    pose: Rigid
    covariance: Float[Tensor, "6 6"]
    residual_m: float
    signals: dict[str, float]
    share: float
    alternatives: tuple[Alternative, ...]


def pose_from_directions(
    voted: Voted,
    model: ObjectModel,
    surface: Surface,
    copies: Copies,
    refusal: RefusalConfig,
    config: EstimateConfig,
) -> PoseEstimate:
    """Vote for the keypoints, fit the pose, refine and check it.

    Args:
        voted: the cloud and the network's directions (a fourth component is the logit of how far
            to trust each).
        model: the object.
        surface: of the same object.
        copies: of the same object, what it may be confused with.
        refusal: when the answer is withheld.
        config: voting and ICP.
    """
    clock = _Clock()
    vote = cast_votes(voted, config.voting)
    clock.note("voting")
    fits = _fits(vote, model, config, refusal.is_calibrated)
    if isinstance(fits, Refusal):
        return _withheld(model, fits, clock)
    clock.note("svd")
    found = _refine(voted, fits, (model, surface, copies), refusal, config)
    if config.with_icp:
        clock.note("icp")
    free = free_motions(model.symmetries.continuous, found.pose)
    answer = _answer(model, vote, found, free)
    posed = Posed(voted.cloud.cloud_m, found.pose, model, surface, free)
    reason = find_doubt(posed, found.signals, refusal, with_icp=config.with_icp)
    clock.note("check")
    risk = risk_of(found.signals, refusal)
    if reason is not None:
        return _withheld(model, reason, clock, answer, risk)
    return _with_certainty(replace(answer, risk=risk, seconds=clock.seconds), found)


def _with_certainty(answer: PoseEstimate, found: _Found) -> PoseEstimate:
    """Share what the risk leaves among the pose and its alternatives."""
    if answer.risk is None and not found.alternatives:
        return answer
    known = 1.0 if answer.risk is None else 1 - answer.risk
    others = tuple(replace(a, probability=known * a.probability) for a in found.alternatives)
    return replace(answer, certainty=known * found.share, alternatives=others)


def cast_votes(voted: Voted, config: VotingConfig) -> Vote:
    """Let the directions vote, by RANSAC or least squares, in float64."""
    points = voted.cloud.points_m.double()
    directions = voted.outputs[..., :3].double()
    weight = voted.outputs[..., 3].double().sigmoid() if voted.outputs.shape[-1] == 4 else None
    if config.method == "ransac":
        return vote_ransac(points, directions, weight, config)
    return meet_lines(points, directions, weight, config.refinements)


def _fits(
    vote: Vote, model: ObjectModel, config: EstimateConfig, is_judged: bool
) -> PoseFit | Refusal:
    """Fit the keypoints that agree; where a risk decides, also all of them."""
    found = (vote.condition <= config.voting.max_condition) & (vote.inlier_share > 0)
    total = len(found)
    if int(found.sum()) < _LEAST:
        return Refusal(
            status="votes do not meet",
            reason=f"the directions meet at {int(found.sum())} of {total} keypoints, but {_LEAST} "
            "are needed: too few points, or not the object that the mask promises",
        )
    strict, rough = config.voting.rigidity_diameters, config.rough_rigidity_diameters
    limit_m = model.diameter_m * (rough if is_judged else strict)
    used = consistent_keypoints(vote.keypoints_m, model.keypoints_m, limit_m, found)
    choices = [used] if int(used.sum()) >= _LEAST else []
    if is_judged and (not choices or config.with_icp) and not torch.equal(used, found):
        choices.append(found)
    if not choices:
        return Refusal(
            status="keypoints do not fit",
            reason=f"{int(used.sum())} of {total} keypoints have the model's distances within "
            f"{limit_m:.2g} m, but {_LEAST} are needed: another object, or too much of it occluded",
        )
    count = len(choices)
    return fit_pose(
        vote.keypoints_m.expand(count, -1, -1),
        vote.covariance_m2.expand(count, -1, -1, -1),
        model.keypoints_m,
        torch.stack(choices),
    )


def _refine(
    voted: Voted,
    fits: PoseFit,
    known: tuple[ObjectModel, Surface, Copies],
    refusal: RefusalConfig,
    config: EstimateConfig,
) -> _Found:
    model, surface, copies = known
    cloud_m = voted.cloud.cloud_m
    fit, scatter, refined = _row(fits, 0), 0.0, None
    others = _none_of(fit.camera_from_model)
    if config.with_icp:
        best = refine_best(cloud_m.double(), fits.camera_from_model, surface, config.icp)
        scatter = 1.0  # where ICP finds no near surface, nothing supports the pose
        if float(best.refined.inlier_share) > 0:
            fit, scatter, refined = _row(fits, best.start), best.scatter, best.refined
            others = best.others
    source = fit if refined is None else refined
    given = source.camera_from_model
    pose = Rigid(given.R.double(), given.t_m.double())
    first = Candidate(pose, source.covariance, float(source.residual_m))
    icp = None if refined is None else config.icp
    candidates = find_candidates(cloud_m, first, others, copies, surface, icp)
    evidence = [evidence_of(voted, one.pose, model, copies, surface) for one in candidates]
    shares = share_out(evidence, refusal.candidate_slopes)
    number = int(shares.argsort(descending=True, stable=True)[0])
    chosen = candidates[number]
    signals = {
        **vote_signals(voted.cloud, fit),
        "scatter": scatter,
        **evidence[number],
    }
    alternatives = alternatives_among(candidates, evidence, shares, copies)
    return _Found(*chosen, signals, float(shares[number]), alternatives)


def _none_of(pose: Rigid) -> Rigid:
    return Rigid(pose.R.double().new_zeros(0, 3, 3), pose.t_m.double().new_zeros(0, 3))


def _row(fits: PoseFit, number: int) -> PoseFit:
    pose = fits.camera_from_model
    return PoseFit(
        camera_from_model=Rigid(pose.R[number], pose.t_m[number]),
        covariance=fits.covariance[number],
        residual_m=fits.residual_m[number],
        misfit=fits.misfit[number],
        is_used=fits.is_used[number],
    )


def _answer(
    model: ObjectModel, vote: Vote, found: _Found, free: Float[Tensor, "m 6"]
) -> PoseEstimate:
    # Worked out in float64, given as points and models come: in float32.
    return PoseEstimate(
        name="",
        object=model.name,
        status="ok",
        camera_from_model=Rigid(found.pose.R.float(), found.pose.t_m.float()),
        keypoints_m=vote.keypoints_m.float(),
        covariance=without_motions(found.covariance, free).float(),
        free_motions=free.float(),
        inlier_share=float(vote.inlier_share.mean()),
        residual_m=found.residual_m,
        signals=found.signals,
    )


def _withheld(
    model: ObjectModel,
    refusal: Refusal,
    clock: _Clock,
    answer: PoseEstimate | None = None,
    risk: float | None = None,
) -> PoseEstimate:
    """Keep what was found out but the pose: a refusal cannot be taken for an answer."""
    known = answer is not None
    return PoseEstimate(
        name="",
        object=model.name,
        status=refusal.status,
        reason=refusal.reason,
        keypoints_m=answer.keypoints_m if known else None,
        inlier_share=answer.inlier_share if known else None,
        residual_m=answer.residual_m if known else None,
        risk=risk,
        signals=answer.signals if known else {},
        seconds=clock.seconds,
    )
