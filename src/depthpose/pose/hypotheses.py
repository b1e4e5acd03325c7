"""Competing poses of one object: refined, distinct, each with its evidence."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float64
from torch import Tensor

from depthpose.core.arrays import take_evenly
from depthpose.core.rigid import Rigid
from depthpose.pose.config import IcpConfig
from depthpose.pose.copies import PreparedObject, with_copies
from depthpose.pose.decide import Hypothesis, share_among_copies, share_among_poses
from depthpose.pose.evidence import Observation, compare
from depthpose.pose.refine import RefinedPose, refine_pose, refine_roughly
from depthpose.pose.surface import NEAR, Surface

_POINTS = 250  # of the cloud that refine a competing pose
_STEPS = 6  # of ICP for poses that were refined roughly
_SHARE_POINTS = 1000  # of the cloud that say what a pose leaves unexplained
_UNEXPLAINED_MORE = 0.25
"""A competing pose that leaves by so much more of the readings unexplained is not compared."""
_MOST_LEADING = 8  #: poses that are compared, and of one of them so many copies
_MOST_COPIES = 24


@dataclass(frozen=True, kw_only=True)
class Competition:
    """Poses that compete for one object, and their probabilities.

    Attributes:
        best: the likeliest pose.
        share: of the probability that it or one of its near-symmetric copies has.
        copies: near-symmetric copies of it, with their shares of the whole.
        others: other poses, with theirs.
        best_share: share of the best itself.
    """

    best: Hypothesis
    share: float
    best_share: float
    copies: list[tuple[Hypothesis, float]]
    others: list[tuple[Hypothesis, float]]


def compete(
    cloud_m: Float64[Tensor, "n 3"],
    refined: RefinedPose,
    others: Rigid,
    prepared: PreparedObject,
    observation: Observation,
    icp: IcpConfig,
    votes_rad: Callable[[Rigid], float] | None = None,
) -> Competition:
    """Compare a refined pose with others, with its look-alikes and with its near-symmetric copies.

    Args:
        cloud_m: points of the object, in the camera frame.
        refined: the leading pose.
        others: at which refinement ended elsewhere.
        prepared: the object.
        observation: of it.
        icp: of the refinement.
        votes_rad: mean angle between a network's directions and those to the keypoints of a pose.
    """
    copies = with_copies(prepared)
    surface = prepared.surface

    def hypothesis(pose: Rigid, source: RefinedPose, k: int | None) -> Hypothesis:
        covariance = source.covariance if k is None else source.covariance[k]
        residual = source.residual_m if k is None else source.residual_m[k]
        return Hypothesis(
            pose=pose,
            covariance=covariance,
            residual_m=float(residual),
            evidence=compare(observation, pose, surface),
            votes_rad=None if votes_rad is None else votes_rad(pose),
        )

    # Which pose is it, up to near-symmetric copies?
    first = refined.camera_from_model.double()
    starts = Rigid.cat([others.double(), first @ copies.lookalikes])
    tried = _refined(cloud_m, first, starts, surface, icp, _MOST_LEADING)
    alike = Rigid.cat([copies.symmetries, copies.copies])
    leading = [hypothesis(first, refined, None)]
    for k in range(0 if tried is None else len(tried.camera_from_model.R)):
        pose = tried.camera_from_model[k]
        before = Rigid.stack([h.pose for h in leading])
        if not bool(copies.is_same(pose, before, alike).any()):
            leading.append(hypothesis(pose, tried, k))
    shares = share_among_poses(leading)
    winner = int(shares.argmax())
    rest = [(h, float(shares[k])) for k, h in enumerate(leading) if k != winner]

    # And which of its copies?
    pose = leading[winner].pose
    group = [leading[winner]]
    tried = _refined(cloud_m, pose, pose @ copies.copies, surface, icp, _MOST_COPIES)
    for k in range(0 if tried is None else len(tried.camera_from_model.R)):
        copy = tried.camera_from_model[k]
        before = Rigid.stack([h.pose for h in group])
        if not bool(copies.is_same(copy, before, copies.symmetries).any()):
            group.append(hypothesis(copy, tried, k))
    share = float(shares[winner])
    copy_shares = share * share_among_copies(group)
    best = int(copy_shares.argmax())
    return Competition(
        best=group[best],
        share=share,
        best_share=float(copy_shares[best]),
        copies=[(h, float(copy_shares[k])) for k, h in enumerate(group) if k != best],
        others=rest,
    )


def _refined(
    cloud_m: Float64[Tensor, "n 3"],
    leading: Rigid,
    starts: Rigid,
    surface: Surface,
    icp: IcpConfig,
    most: int,
) -> RefinedPose | None:
    """Refine competing poses, but for those that explain much less than the leading one."""
    if len(starts.R) == 0:
        return None
    rough = refine_roughly(cloud_m, starts, surface, icp)
    every = Rigid.cat([leading[None], rough])
    unexplained = _unexplained(cloud_m, every, surface)
    order = unexplained[1:].argsort(stable=True)[:most]
    order = order[unexplained[1:][order] <= unexplained[0] + _UNEXPLAINED_MORE]
    if len(order) == 0:
        return None
    short = replace(
        icp,
        iterations=_STEPS,
        cloud_points=min(_POINTS, icp.cloud_points),
        start_distance_diameters=icp.end_distance_diameters,
    )
    return refine_pose(cloud_m, rough[order], surface, short)


def _unexplained(
    cloud_m: Float64[Tensor, "n 3"], poses: Rigid, surface: Surface
) -> Float64[Tensor, " b"]:
    """Share of a cloud that is not near each posed surface, by the table of what lies near."""
    local_m = poses.inverse().apply(take_evenly(cloud_m, _SHARE_POINTS))
    nearest_m = surface.points_m[surface.boxes.look_up(local_m)]
    is_far = (local_m - nearest_m).norm(dim=-1) > NEAR * surface.diameter_m
    return is_far.double().mean(-1)
