"""Directions of one cloud to its pose: vote, drop outliers, fit, refine, check."""

import math
import time
from collections.abc import Sequence
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
from depthpose.pose.estimator.evidence import (
    observability,
    surface_signals,
    vote_signals,
    without_motions,
)
from depthpose.pose.estimator.prepare import Prepared, Refusal
from depthpose.pose.estimator.prepare import Voted as Voted
from depthpose.pose.estimator.refusal import reason_of, risk_of
from depthpose.pose.estimator.scale import Scale, scale_of
from depthpose.pose.refine import Refined, refine_best
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
        return _withheld(model.name, fits, clock)
    clock.note("svd")
    found = _refine(voted, fits, (model, surface, copies), refusal, config)
    if config.with_icp:
        clock.note("icp")
    answer = _answer(model, found, vote)
    if not config.with_icp:
        refusal = replace(refusal, max_scale_error=1.0)  # only a refined pose tells the scale
    return _checked(voted.cloud, found, answer, surface, refusal, clock)


def pose_from_proposals(
    cloud: Prepared,
    proposals: Rigid,
    known: tuple[ObjectModel, Surface, Copies],
    refusal: RefusalConfig,
    config: EstimateConfig,
) -> PoseEstimate:
    """Refine the best of proposed poses and check it; no network takes part.

    Args:
        cloud: of the object.
        proposals: poses, the likeliest first; one at least.
        known: the object, its surface and what it may be confused with.
        refusal: when the answer is withheld; it weighs no signal of votes for keypoints.
        config: of ICP, which begins at the proposals alone.
    """
    model, surface, copies = known
    clock = _Clock()
    icp = replace(config.icp, starts=1)
    best = refine_best(cloud.cloud_m.double(), proposals, surface, icp)
    if float(best.refined.inlier_share) == 0:
        reason = "no pose lays the model near the points: another object, or too little of it"
        return _withheld(model.name, Refusal(status="votes do not meet", reason=reason), clock)
    first = _candidate(best.refined)
    candidates = find_candidates(cloud.cloud_m, first, best.others, copies, surface, icp)
    evidence = [surface_signals(cloud.cloud_m, one.pose, surface) for one in candidates]
    signals = {"few": 10 / len(cloud.points_m), "scatter": best.scatter}
    found = _choose(candidates, evidence, signals, copies, refusal)
    clock.note("icp")
    return _checked(cloud, found, _answer(model, found), surface, refusal, clock)


def _checked(
    cloud: Prepared,
    found: _Found,
    answer: PoseEstimate,
    surface: Surface,
    refusal: RefusalConfig,
    clock: _Clock,
) -> PoseEstimate:
    """Withhold an answer that is doubtful."""
    reason = _doubt(cloud, found, surface, refusal, answer)
    if reason is None and refusal.max_scale_error < 1:
        scale = scale_of(cloud.cloud_m, found.pose, surface)
        answer.signals["scale"] = scale.times
        reason = _other_size(scale, refusal)
    clock.note("check")
    risk = risk_of(found.signals, refusal)
    if reason is not None:
        return _withheld(answer.object, reason, clock, answer, risk)
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
    first = _candidate(fit if refined is None else refined)
    icp = None if refined is None else config.icp
    candidates = find_candidates(cloud_m, first, others, copies, surface, icp)
    evidence = [evidence_of(voted, one.pose, model, copies, surface) for one in candidates]
    signals = {**vote_signals(voted.cloud, fit), "scatter": scatter}
    return _choose(candidates, evidence, signals, copies, refusal)


def _candidate(source: PoseFit | Refined) -> Candidate:
    given = source.camera_from_model
    pose = Rigid(given.R.double(), given.t_m.double())
    return Candidate(pose, source.covariance, float(source.residual_m))


def _choose(
    candidates: Sequence[Candidate],
    evidence: Sequence[dict[str, float]],
    signals: dict[str, float],
    copies: Copies,
    refusal: RefusalConfig,
) -> _Found:
    """Choose among the poses that fit by what speaks against each."""
    shares = share_out(evidence, refusal.candidate_slopes)
    number = int(shares.argsort(descending=True, stable=True)[0])
    alternatives = alternatives_among(candidates, evidence, shares, copies)
    every = {**signals, **evidence[number]}
    return _Found(*candidates[number], every, float(shares[number]), alternatives)


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


def _answer(model: ObjectModel, found: _Found, vote: Vote | None = None) -> PoseEstimate:
    free = free_motions(model.symmetries.continuous, found.pose)
    # Worked out in float64, given as points and models come: in float32.
    return PoseEstimate(
        name="",
        object=model.name,
        status="ok",
        camera_from_model=Rigid(found.pose.R.float(), found.pose.t_m.float()),
        keypoints_m=None if vote is None else vote.keypoints_m.float(),
        covariance=without_motions(found.covariance, free).float(),
        free_motions=free.float(),
        inlier_share=None if vote is None else float(vote.inlier_share.mean()),
        residual_m=found.residual_m,
        signals=found.signals,
    )


def _doubt(
    cloud: Prepared,
    found: _Found,
    surface: Surface,
    config: RefusalConfig,
    answer: PoseEstimate,
) -> Refusal | None:
    risk = risk_of(found.signals, config)
    if risk is not None and risk > config.max_risk:
        return Refusal(status="doubtful", reason=reason_of(found.signals, risk, config))
    assert answer.free_motions is not None
    free = answer.free_motions.double()
    observable, motion = observability(cloud.cloud_m, found.pose, surface, free)
    if observable >= config.min_hold:
        return None
    turn = float(motion[:3].norm())
    what = "turn" if turn > math.sqrt(0.5) else "shift"
    return Refusal(
        status="not observable",
        reason=f"the seen part of the object may {what} along itself: that moves its surface "
        f"across itself by {observable:.1%} of the motion alone, and no declared symmetry allows "
        "it. Declare the symmetry, or look from a side that shows more",
    )


def _other_size(scale: Scale, config: RefusalConfig) -> Refusal | None:
    if scale.error <= config.max_scale_error:
        return None
    return Refusal(
        status="doubtful",
        reason=f"the cloud fits the object best at {scale.times:.2f} times its size (standard "
        f"deviation {scale.sigma:.2f}), and {config.max_scale_error:.0%} are allowed: a copy of "
        "another size, another object, or a wrong unit or camera",
    )


def _withheld(
    object: str,
    refusal: Refusal,
    clock: _Clock,
    answer: PoseEstimate | None = None,
    risk: float | None = None,
) -> PoseEstimate:
    """Keep what was found out but the pose: a refusal cannot be taken for an answer."""
    known = answer is not None
    return PoseEstimate(
        name="",
        object=object,
        status=refusal.status,
        reason=refusal.reason,
        keypoints_m=answer.keypoints_m if known else None,
        inlier_share=answer.inlier_share if known else None,
        residual_m=answer.residual_m if known else None,
        risk=risk,
        signals=answer.signals if known else {},
        seconds=clock.seconds,
    )
