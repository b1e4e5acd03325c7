"""Directions of one cloud to its pose: vote, drop outliers, fit, refine, check."""

import torch

from depthpose.core.rigid import Rigid
from depthpose.pose.config import EstimateConfig, RefusalConfig, VotingConfig
from depthpose.pose.estimator.alternatives import PoseAmbiguities, evidence_of, find_candidates
from depthpose.pose.estimator.answer import (
    Clock,
    Found,
    Posed,
    answer_of,
    candidate_of,
    choose,
    judged,
    misfit_of,
    withheld,
)
from depthpose.pose.estimator.fit import fit_of, seen_about
from depthpose.pose.estimator.prepare import Refusal
from depthpose.pose.estimator.prepare import Voted as Voted
from depthpose.pose.refine import refine_best
from depthpose.pose.surface import Surface
from depthpose.pose.types import ObjectModel, PoseEstimate, PoseFit, Vote
from depthpose.pose.voting import consistent_keypoints, fit_pose, meet_lines, vote_ransac

_LEAST = 4
"""Keypoints that must agree: three fix a pose with nothing left to contradict it."""


def pose_from_directions(
    voted: Voted,
    known: tuple[ObjectModel, Surface, PoseAmbiguities],
    refusal: RefusalConfig,
    config: EstimateConfig,
    *,
    is_likely: bool = True,
) -> PoseEstimate:
    """Vote for the keypoints, fit the pose, refine and check it.

    Args:
        voted: the cloud and the network's directions (a fourth component is the logit of how far
            to trust each).
        known: the object, its surface and what it may be confused with.
        refusal: when the answer is withheld.
        config: voting and ICP.
        is_likely: whether the cloud is likely to show the object; else the other poses that fit are
            not compared where the best does not fit by itself.
    """
    model, surface, _ = known
    clock = Clock()
    vote = cast_votes(voted, config.voting)
    clock.note("voting")
    fits = _fits(vote, model, config)
    if isinstance(fits, Refusal):
        return withheld(model.name, fits, clock)
    clock.note("svd")
    found = _refine(voted, fits, known, refusal, config, is_likely)
    if isinstance(found, Refusal):
        clock.note("icp")
        return withheld(model.name, found, clock)
    if config.with_icp:
        clock.note("icp")
    answer = answer_of(model, found, vote)
    assert answer.free_motions is not None
    free = answer.free_motions.double()
    posed = Posed(voted.cloud, found.pose, model, surface, free)
    return judged(posed, found, answer, refusal, config, clock)


def cast_votes(voted: Voted, config: VotingConfig) -> Vote:
    """Let the directions vote, by RANSAC or least squares, in float64."""
    points = voted.cloud.points_m.double()
    directions = voted.outputs[..., :3].double()
    weight = voted.outputs[..., 3].double().sigmoid() if voted.outputs.shape[-1] == 4 else None
    if config.method == "ransac":
        return vote_ransac(points, directions, weight, config)
    return meet_lines(points, directions, weight, config.refinements)


def _fits(vote: Vote, model: ObjectModel, config: EstimateConfig) -> PoseFit | Refusal:
    """Fit the keypoints that agree; where ICP refines the fits, also all of them."""
    found = (vote.condition <= config.voting.max_condition) & (vote.inlier_share > 0)
    total = len(found)
    if int(found.sum()) < _LEAST:
        return Refusal(
            status="votes do not meet",
            reason=f"the directions meet at {int(found.sum())} of {total} keypoints, but {_LEAST} "
            "are needed: too few points, or not the object that the mask promises",
        )
    strict, rough = config.voting.rigidity_diameters, config.rough_rigidity_diameters
    limit_m = model.diameter_m * (rough if config.with_icp else strict)
    used = consistent_keypoints(vote.keypoints_m, model.keypoints_m, limit_m, found)
    choices = [used] if int(used.sum()) >= _LEAST else []
    if config.with_icp and not torch.equal(used, found):
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
    known: tuple[ObjectModel, Surface, PoseAmbiguities],
    refusal: RefusalConfig,
    config: EstimateConfig,
    is_likely: bool,
) -> Found | Refusal:
    model, surface, copies = known
    cloud_m = voted.cloud.cloud_m
    fit, refined = _row(fits, 0), None
    others = _none_of(fit.camera_from_model)
    if config.with_icp:
        best = refine_best(cloud_m.double(), fits.camera_from_model, surface, config.icp)
        if float(best.refined.inlier_share) > 0:
            fit, refined = _row(fits, best.start), best.refined
            others = best.others
    first = candidate_of(fit if refined is None else refined)
    icp = None if refined is None else config.icp
    if not is_likely:
        seen = seen_about(cloud_m, voted.cloud.view, surface.diameter_m)
        refused = misfit_of(fit_of(seen, first.pose, surface), refusal)
        if refused is not None:
            return refused
    candidates = find_candidates(cloud_m, first, others, copies, surface, icp)
    poses = Rigid.stack([one.pose for one in candidates])
    evidence = evidence_of(voted, poses, model, copies, surface)
    return choose(candidates, evidence, copies, refusal)


def _none_of(pose: Rigid) -> Rigid:
    return Rigid(pose.R.double().new_zeros(0, 3, 3), pose.t_m.double().new_zeros(0, 3))


def _row(fits: PoseFit, number: int) -> PoseFit:
    pose = fits.camera_from_model
    return PoseFit(
        camera_from_model=pose[number],
        covariance=fits.covariance[number],
        residual_m=fits.residual_m[number],
        misfit=fits.misfit[number],
        is_used=fits.is_used[number],
    )
