"""One object from its points: propose, refine, compare, compete, decide.

:func:`register` does all of it by the model alone. A network proposes a pose in its own way
(:mod:`depthpose.pose.network_pose`), with which those of point pairs compete; what follows,
:func:`judge`, is the same for both.
"""

from collections.abc import Callable
from dataclasses import replace

import torch

from depthpose.core.arrays import take_evenly
from depthpose.core.rigid import Rigid
from depthpose.core.stopwatch import Stopwatch
from depthpose.pose.cloud import ObjectCloud, prepare_cloud
from depthpose.pose.config import CloudConfig, EstimateConfig
from depthpose.pose.geometry.grid import fit_local_planes, thin_cloud
from depthpose.pose.icp import refine_best
from depthpose.pose.propose.point_pairs import propose_poses
from depthpose.pose.refusals import Refused
from depthpose.pose.types import AnyInput, PoseEstimate, PoseFit
from depthpose.pose.verify.decide import decide
from depthpose.pose.verify.evidence import observe
from depthpose.pose.verify.hypotheses import compete
from depthpose.pose.verify.target_object import TargetObject

_VOTING_DIAMETERS = 0.05  # distance of the points that vote
_PROPOSALS = 40  # poses that point pairs propose
_SMOOTHED_POINTS = 1500  # of so many, 20 neighbours give a normal that noise hardly turns


def register(
    pose_input: AnyInput,
    target: TargetObject,
    config: EstimateConfig,
    watch: Stopwatch,
    *,
    proposals: Rigid | None = None,
    is_expected: bool = True,
) -> PoseEstimate:
    """Register a model to the points of an object: of a mask, or where a search proposed it.

    Args:
        pose_input: the points.
        target: the object.
        config: of ICP and limits.
        watch: to which the times of the stages are added.
        proposals: poses of a search; None: point pairs of the points propose.
        is_expected: whether a mask or a detector's box says that the object is there.

    Raises:
        InputError: mask and depth differ in size.
        Refused: the points do not allow a pose.
    """
    # The usable points of the object.
    with watch.stage("cloud"):
        cloud = prepare_cloud(pose_input, target.model, CloudConfig(), config)

    # Propose.
    with watch.stage("proposal"):
        if proposals is None:
            proposals = propose_by_pairs(cloud, target, config.voting.seed)

    # Refine.
    with watch.stage("icp"):
        cloud_m = cloud.cloud_m.double()
        refined, others = refine_best(cloud_m, proposals, target.surface, config.icp)
    if float(refined.inlier_share) == 0:
        raise Refused(
            "no pose found",
            "no pose brings the model near the points: another object, or too little of it",
        )

    # Compare, compete, decide.
    return judge(cloud, target, refined, others, config, watch, is_expected=is_expected)


def propose_by_pairs(cloud: ObjectCloud, target: TargetObject, seed: int) -> Rigid:
    """Propose poses by the point pairs of a cloud."""
    dense_m = take_evenly(cloud.cloud_m.double(), _SMOOTHED_POINTS)
    step_m = _VOTING_DIAMETERS * target.surface.diameter_m
    voting_m = dense_m[thin_cloud(dense_m, torch.zeros_like(dense_m), step_m)]
    normals, _ = fit_local_planes(dense_m, voting_m)
    generator = torch.Generator().manual_seed(seed)
    return propose_poses(voting_m, normals, target.pairs, _PROPOSALS, generator)


def judge(
    cloud: ObjectCloud,
    target: TargetObject,
    refined: PoseFit,
    others: Rigid,
    config: EstimateConfig,
    watch: Stopwatch,
    *,
    is_expected: bool,
    votes_rad: Callable[[Rigid], float] | None = None,
) -> PoseEstimate:
    """Compare a refined pose with the depth image and with its competitors, and decide.

    Args:
        cloud: points of the object.
        target: the object.
        refined: the best pose.
        others: at which refinement ended too, or that were proposed.
        config: of limits, and of ICP, without which competing poses stay where they are.
        watch: of the stages before, to which this one's are added.
        is_expected: whether a mask or a detector's box says that the object is there.
        votes_rad: angle between a network's directions and a pose, as :func:`compete` takes it.

    Raises:
        Refused: the best pose is not observable, doubtful, or of another object.
    """
    # The best pose against its near-symmetric copies, look-alikes and other local minima.
    with watch.stage("evidence"):
        observation = observe(cloud.cloud_m, cloud.view, target.surface, is_masked=cloud.is_masked)
        competition = compete(observation, refined, others, target, config, votes_rad)

    with watch.stage("decision"):
        estimate = decide(competition, observation, target, config, is_expected=is_expected)
    return replace(estimate, name=cloud.name, seconds=watch.seconds)
