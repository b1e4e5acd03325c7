"""Competing poses of one object: refined, distinct, each with its evidence."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import torch
from jaxtyping import Float64
from torch import Tensor

from depthpose.core.arrays import take_evenly
from depthpose.core.rigid import Rigid
from depthpose.pose.config import EstimateConfig
from depthpose.pose.geometry.surface import Surface
from depthpose.pose.icp import refine_exactly, refine_roughly
from depthpose.pose.mesh import turn_about
from depthpose.pose.types import Axis, Evidence, PoseFit, ViewInput
from depthpose.pose.verify.color import measure_color_agreement
from depthpose.pose.verify.color_copies import align_print, propose_color_copies
from depthpose.pose.verify.evidence import Observation, compare
from depthpose.pose.verify.probability import (
    LEAST_AREA,
    VOTES_RAD,
    log_likelihood_of_copy,
    log_likelihood_ratio,
)
from depthpose.pose.verify.sliding import slide
from depthpose.pose.verify.target_object import TargetObject

_POINTS = 250  # points of the cloud that refine a competing pose
_STEPS = 6  # steps of ICP for poses that were refined roughly
_SHARE_POINTS = 1000  # points of the cloud that measure what a pose leaves unexplained
_UNEXPLAINED_MORE = 0.25
"""A competing pose that leaves by so much more of the readings unexplained is not compared."""
_MOST_SLID = 12
_LEAST_SLID = 0.02
"""Largest number of poses that slide in each round, and the share of the probability from which
they do."""
_MOST_LEADING = 8  # largest number of different poses that are compared
_MOST_COPIES = 45  # and of near-symmetric copies of the best of them


@dataclass(frozen=True, kw_only=True, eq=False)
class Hypothesis:
    """A refined pose and the evidence for it."""

    refined: PoseFit  #: the pose, with its covariance and residual
    evidence: Evidence  #: of the pose
    #: mean angle between a network's directions and those to the keypoints of the pose; None
    #: without a network.
    votes_rad: float | None = None
    log_color: float = 0.0  #: log likelihood of the colour image; 0 without one

    @property
    def pose(self) -> Rigid:
        """``camera_from_model``, in double precision."""
        return self.refined.camera_from_model.double()


@dataclass(frozen=True, kw_only=True, eq=False)
class Competition:
    """Poses that compete for one object, and how they share the probability of one."""

    best: Hypothesis  #: the likeliest pose
    best_share: float  #: its share
    copies: list[tuple[Hypothesis, float]]  #: near-symmetric copies of it, with their shares
    others: list[tuple[Hypothesis, float]]  #: other poses, with theirs

    @property
    def group_share(self) -> float:
        """Share of the best pose and its near-symmetric copies together."""
        return self.best_share + sum(share for _, share in self.copies)


def compete(
    observation: Observation,
    refined: PoseFit,
    others: Rigid,
    target: TargetObject,
    config: EstimateConfig,
    votes_rad: Callable[[Rigid], float] | None = None,
) -> Competition:
    """Compare a refined pose with others and its look-alikes, and the winner with its copies.

    Args:
        observation: of the object; a colour image of its view tells copies apart.
        refined: the leading pose.
        others: further poses, refined or only proposed.
        target: the object.
        config: of the refinement; without ICP poses stay where they are.
        votes_rad: mean angle between a network's directions and those to the keypoints of a pose.
    """
    cloud_m = observation.cloud_m
    view = observation.colored_view
    is_masked = observation.is_masked
    hypothesize = partial(_hypothesize, target=target, observation=observation, votes_rad=votes_rad)

    # First round: which pose is it, up to near-symmetric copies? Each pose stands for its copies,
    # one of which may have the surface colours that are observed.
    different_fits = _refine_different_poses(cloud_m, refined, others, target, config)
    different = [hypothesize(fit) for fit in different_fits]
    if config.with_icp:
        shares = share_among_poses(different, is_masked=is_masked)
        different = _slide_likely(different, shares, target, observation)
    if view is not None:
        different = _merge_by_colored_copy(different, target, view)
    shares = share_among_poses(different, is_masked=is_masked)
    winner = different[int(shares.argmax())]

    # The winner's copies. Another of the different poses may be one too: one between two copies
    # about an axis. Together they have the shares of all of these.
    copy_fits = _refine_distinct_copies(cloud_m, winner.refined, target, config, view)
    copies = [hypothesize(fit) for fit in copy_fits]
    if config.with_icp:
        shares_with_winner = share_among_copies([winner, *copies], is_masked=is_masked)
        copies = _slide_likely(copies, shares_with_winner[1:], target, observation)
    is_copy = _mark_copies(different, [winner, *copies], target)
    joining = [
        hypothesis
        for hypothesis, joins in zip(different, is_copy, strict=True)
        if joins and hypothesis is not winner
    ]
    group_share = float(shares[torch.tensor(is_copy)].sum())

    # Second round: which of the copies is it? Each has its own colours.
    group = [winner, *copies, *joining]
    if view is not None:
        group = _with_own_color(group, target, view)
    copy_shares = group_share * share_among_copies(group, is_masked=is_masked)
    distinct = _merge_same_poses(group, copy_shares.tolist(), target)
    best, best_share = max(distinct, key=lambda copy: copy[1])
    return Competition(
        best=best,
        best_share=best_share,
        copies=[(copy, share) for copy, share in distinct if copy is not best],
        others=[(h, float(shares[k])) for k, h in enumerate(different) if not is_copy[k]],
    )


def _hypothesize(
    refined: PoseFit,
    target: TargetObject,
    observation: Observation,
    votes_rad: Callable[[Rigid], float] | None,
) -> Hypothesis:
    """Compare a refined pose with the depth that was observed, and with a network's votes."""
    pose = refined.camera_from_model.double()
    return Hypothesis(
        refined=refined,
        evidence=compare(observation, pose, target.surface),
        votes_rad=None if votes_rad is None else votes_rad(pose),
    )


def _slide_likely(
    hypotheses: Sequence[Hypothesis],
    shares: Float64[Tensor, " n"],
    target: TargetObject,
    observation: Observation,
) -> list[Hypothesis]:
    """Slide the likely hypotheses to where the image fits them best; the others stay.

    ``shares``: the share of the probability that each hypothesis has.
    """
    slid = list(hypotheses)
    for k in shares.argsort(descending=True)[:_MOST_SLID].tolist():
        if float(shares[k]) >= _LEAST_SLID:
            likely = hypotheses[k]
            refined, evidence = slide(likely.refined, likely.evidence, observation, target.surface)
            slid[k] = replace(likely, refined=refined, evidence=evidence)
    return slid


def _mark_copies(
    hypotheses: Sequence[Hypothesis], copies: Sequence[Hypothesis], target: TargetObject
) -> list[bool]:
    """Mark the hypotheses at the pose of one of the copies, up to exact and near-symmetries."""
    copy_poses = Rigid.stack([copy.pose for copy in copies])
    symmetries = _all_symmetries(target)
    return [
        bool(target.copies.is_same(hypothesis.pose, copy_poses, symmetries).any())
        for hypothesis in hypotheses
    ]


def _merge_same_poses(
    hypotheses: Sequence[Hypothesis], shares: Sequence[float], target: TargetObject
) -> list[tuple[Hypothesis, float]]:
    """Merge hypotheses of one pose: the likeliest stands for all of them, and has their shares.

    Poses are one that differ by an exact symmetry of the model and by what refinement leaves.
    """
    distinct: list[tuple[Hypothesis, float]] = []
    for k in sorted(range(len(shares)), key=lambda k: -shares[k]):
        same = None
        if distinct:
            poses = Rigid.stack([hypothesis.pose for hypothesis, _ in distinct])
            is_same = target.copies.is_same(hypotheses[k].pose, poses, target.copies.symmetries)
            same = int(is_same.int().argmax()) if bool(is_same.any()) else None
        if same is None:
            distinct.append((hypotheses[k], shares[k]))
        else:
            distinct[same] = (distinct[same][0], distinct[same][1] + shares[k])
    return distinct


def _refine_different_poses(
    cloud_m: Float64[Tensor, "n 3"],
    leading: PoseFit,
    others: Rigid,
    target: TargetObject,
    config: EstimateConfig,
) -> list[PoseFit]:
    """List the leading pose, and refined others that are neither it nor a copy of one before.

    Others are the ones given, and the look-alikes of the leading pose.
    """
    copies = target.copies
    leading_pose = leading.camera_from_model.double()
    starts = Rigid.cat([others.double(), leading_pose @ copies.lookalikes])
    competitors = _refine_competitors(
        cloud_m, leading, starts, target.surface, config, _MOST_LEADING
    )

    different = [leading]
    for competitor in competitors:
        pose = competitor.refined.camera_from_model
        before = Rigid.stack([other.camera_from_model.double() for other in different])
        if not bool(copies.is_same(pose, before, _all_symmetries(target)).any()):
            different.append(competitor.refined)
    return different


def _all_symmetries(target: TargetObject) -> Rigid:
    """Join exact and near-symmetries of an object, which lead from a pose to its copies."""
    return Rigid.cat([target.copies.symmetries, target.copies.near_copies])


def share_among_poses(
    hypotheses: Sequence[Hypothesis], *, is_masked: bool
) -> Float64[Tensor, " n"]:
    """Share the probability of one among different poses of an object.

    If one of them is right the others are wrong, and wrong poses leave much contradicted: so each
    is weighed by how much better its evidence fits a right pose than a wrong one.
    """
    if not is_masked:
        hypotheses = _against_each_other(hypotheses)
    weights = [log_likelihood_ratio(h.evidence) + _log_without_depth(h) for h in hypotheses]
    return torch.tensor(weights, dtype=torch.float64).softmax(0)


def share_among_copies(
    hypotheses: Sequence[Hypothesis], *, is_masked: bool
) -> Float64[Tensor, " n"]:
    """Share the probability of one among near-symmetric copies of a pose.

    Wrong copies are contradicted little, for they look nearly alike: so each is weighed by how well
    its evidence fits a right pose. A network's votes say nothing here: it saw no more.
    """
    area = max(LEAST_AREA, *(hypothesis.evidence.visible for hypothesis in hypotheses))
    if not is_masked:
        hypotheses = _against_each_other(hypotheses)
    weights = [log_likelihood_of_copy(h.evidence, area) + h.log_color for h in hypotheses]
    return torch.tensor(weights, dtype=torch.float64).softmax(0)


def _against_each_other(hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Count readings that another pose explains, and a pose does not, against it.

    Where no mask says which readings are the object's, nothing else does: a mug's handle that one
    copy leaves out may be of a neighbour.

    Returns:
        The hypotheses, with the area of such readings as ``beside`` in their evidence.
    """
    most = max(hypothesis.evidence.explained for hypothesis in hypotheses)
    compared: list[Hypothesis] = []
    for hypothesis in hypotheses:
        evidence = hypothesis.evidence
        # Part of it is counted already, where the surface goes on beyond the silhouette.
        unexplained = max(0.0, most - evidence.explained - evidence.continued)
        compared.append(replace(hypothesis, evidence=replace(evidence, beside=unexplained)))
    return compared


def _log_without_depth(hypothesis: Hypothesis) -> float:
    """Compute the log likelihood of what other sources than depth say: a colour image, votes."""
    log_votes = 0.0 if hypothesis.votes_rad is None else -hypothesis.votes_rad / VOTES_RAD
    return log_votes + hypothesis.log_color


class _Competitor(NamedTuple):
    """A competing pose, refined and as it was proposed."""

    refined: PoseFit
    start: Rigid  #: the pose before refinement


def _refine_distinct_copies(
    cloud_m: Float64[Tensor, "n 3"],
    winner: PoseFit,
    target: TargetObject,
    config: EstimateConfig,
    view: ViewInput | None,
) -> list[PoseFit]:
    """Refine the near-symmetric copies of the winning pose; leave out exact copies of others."""
    winner_pose = winner.camera_from_model.double()
    starts = winner_pose @ target.copies.near_copies
    if view is not None:  # colours show finer rotations about an axis than shape does
        starts = Rigid.cat([propose_color_copies(winner_pose, target.model, view), starts])
    competitors = _refine_competitors(cloud_m, winner, starts, target.surface, config, _MOST_COPIES)

    distinct: list[PoseFit] = []
    distinct_poses = [winner_pose]
    for competitor in competitors:
        for copy in _settle_copy(competitor, target, view):
            pose = copy.camera_from_model
            before = Rigid.stack(distinct_poses)
            if not target.copies.is_same(pose, before, target.copies.symmetries).any():
                distinct.append(copy)
                distinct_poses.append(pose.double())
    return distinct


def _settle_copy(
    competitor: _Competitor, target: TargetObject, view: ViewInput | None
) -> list[PoseFit]:
    """List where a copy may lie: where refinement ended and, if it drifted away, its start too.

    Where little observed fixes a copy, refinement lets it drift toward others: both compete.
    """
    refined, start = competitor
    if view is not None:
        # Depth lets a copy drift about an axis of its shape, where its print fixes the angle.
        settled = align_print(refined.camera_from_model, target.model, view)
        refined = replace(refined, camera_from_model=settled)
    copies = target.copies
    if copies.is_same(refined.camera_from_model, start[None], copies.symmetries).any():
        return [refined]
    return [_undo_drift(refined, start, copies.near_axis), refined]


def _undo_drift(refined: PoseFit, start: Rigid, axis: Axis | None) -> PoseFit:
    """Rotate a refined pose about an axis of its model back to the angle at which it started.

    Without an axis it is put back to its start, which nothing refined.
    """
    if axis is None:
        return replace(refined, camera_from_model=start)
    pose = refined.camera_from_model.double()
    direction = axis.direction.double()
    twist_rad = _measure_twist(start.R.double().mT @ pose.R, direction)
    back = turn_about(direction, axis.point_m.double(), -twist_rad)
    return replace(refined, camera_from_model=pose @ back)


def _measure_twist(R: Float64[Tensor, "3 3"], axis: Float64[Tensor, "3"]) -> Float64[Tensor, ""]:
    """Measure the angle [rad] of a rotation's twist about a unit axis (swing-twist decomposition).

    tan(angle / 2) is the axial vector of R - R^T along the axis, over 1 + trace R.
    """
    axial = torch.stack([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    return 2 * torch.atan2(axial @ axis, 1 + R.trace())


def _merge_by_colored_copy(
    hypotheses: Sequence[Hypothesis], target: TargetObject, view: ViewInput
) -> list[Hypothesis]:
    """Merge poses that are copies of each other, with the colour evidence of their best copies.

    Each pose stands for all of its copies. Poses whose best copies by colour are one pose are
    copies of each other: the first stands for them.
    """
    copies = target.copies
    symmetries = _all_symmetries(target)
    distinct: list[Hypothesis] = []
    best_copies: list[Rigid] = []
    for hypothesis in hypotheses:
        colored = propose_color_copies(hypothesis.pose, target.model, view, motions=symmetries)
        likelihood = measure_color_agreement(colored, target.model, view).log_likelihood
        best = colored[int(likelihood.argmax())]
        if best_copies and copies.is_same(best, Rigid.stack(best_copies), copies.symmetries).any():
            continue
        distinct.append(replace(hypothesis, log_color=float(likelihood.max())))
        best_copies.append(best)
    return distinct


def _with_own_color(
    hypotheses: Sequence[Hypothesis], target: TargetObject, view: ViewInput
) -> list[Hypothesis]:
    """Return poses with the colour evidence of each alone."""
    colored: list[Hypothesis] = []
    for hypothesis in hypotheses:
        color = measure_color_agreement(hypothesis.pose[None], target.model, view)
        colored.append(replace(hypothesis, log_color=float(color.log_likelihood[0])))
    return colored


def _refine_competitors(
    cloud_m: Float64[Tensor, "n 3"],
    leading: PoseFit,
    starts: Rigid,
    surface: Surface,
    config: EstimateConfig,
    max_count: int,
) -> list[_Competitor]:
    """Refine competing poses, but for those that explain much less than the leading one.

    Args:
        cloud_m: points of the object, in the camera frame.
        leading: the best pose so far.
        starts: the poses that compete with it.
        surface: of the model.
        config: of the refinement; without ICP all poses compete as they are.
        max_count: how many are refined at most, those that explain most of the cloud.
    """
    if not config.with_icp:
        # Their covariance is not known; at copies of the leading pose it is that of the leading.
        return [
            _Competitor(replace(leading, camera_from_model=starts[k]), starts[k])
            for k in range(len(starts.R))
        ]
    if len(starts.R) == 0:
        return []

    # Roughly. Such steps may move a pose along directions that the points hardly constrain: the
    # result is taken only where it explains more of the cloud than the start.
    rough = refine_roughly(cloud_m, starts, surface, config.icp.end_distance_diameters)
    unexplained_before = _measure_unexplained(cloud_m, starts, surface)
    unexplained_after = _measure_unexplained(cloud_m, rough, surface)
    is_better = unexplained_after < unexplained_before
    improved = Rigid(
        R=torch.where(is_better[:, None, None], rough.R, starts.R),
        t_m=torch.where(is_better[:, None], rough.t_m, starts.t_m),
    )

    # Those that leave too much of the cloud unexplained are dropped.
    unexplained = torch.minimum(unexplained_before, unexplained_after)
    leading_unexplained = _measure_unexplained(
        cloud_m, leading.camera_from_model.double()[None], surface
    )
    order = unexplained.argsort(stable=True)[:max_count]
    order = order[unexplained[order] <= leading_unexplained + _UNEXPLAINED_MORE]
    if len(order) == 0:
        return []

    # Then exactly, a few steps for each.
    batch = refine_exactly(
        cloud_m,
        improved[order],
        surface,
        iterations=_STEPS,
        start_diameters=config.icp.end_distance_diameters,
        end_diameters=config.icp.end_distance_diameters,
        max_points=min(_POINTS, config.icp.cloud_points),
        sensor_offset_m=config.icp.sensor_offset_m,
    )
    return [_Competitor(batch[row], starts[start]) for row, start in enumerate(order.tolist())]


def _measure_unexplained(
    cloud_m: Float64[Tensor, "n 3"], poses: Rigid, surface: Surface
) -> Float64[Tensor, " b"]:
    """Measure the share of a cloud that is far from each posed surface, by its nearest samples."""
    local_m = poses.inverse().apply(take_evenly(cloud_m, _SHARE_POINTS))
    is_far = surface.nearest(local_m, is_exact=False).distance_m > surface.near_m
    return is_far.double().mean(-1)
