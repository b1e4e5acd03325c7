"""GeoPoseNet: clouds and depth images of known objects to poses, by a network's directions.

Several clouds go through the network at once. The directions of each vote for keypoints; the pose
is fitted to these, refined by ICP, and checked. A baseline regresses the pose from a depth image.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from depthpose.core.checkpoint import find_weights, warn_of_terms
from depthpose.core.devices import (
    force_float32,
    map_in_threads,
    refused_memory,
    usable_device,
)
from depthpose.core.errors import InputError
from depthpose.core.rigid import Rigid
from depthpose.core.stopwatch import Stopwatch
from depthpose.pose.cloud import ObjectCloud, cloud_from_depth, prepare_cloud, require_points
from depthpose.pose.config import EstimateConfig
from depthpose.pose.estimator import NEEDS_MASK, PoseEstimator
from depthpose.pose.geometry.grid import VoxelGrid, sample_and_voxelise
from depthpose.pose.icp import refine_best, rotate_starts
from depthpose.pose.networks.baselines import DepthCrop, DepthImageNet, cut_depth, make_poses
from depthpose.pose.pipeline import judge, propose_by_pairs
from depthpose.pose.propose import fit_poses, meet_lines, vote_ransac
from depthpose.pose.refusals import Refused, estimate_or_refusal, unreadable_on_error
from depthpose.pose.types import (
    AnyInput,
    PoseEstimate,
    Status,
    ViewInput,
    Vote,
    VotingPoints,
)
from depthpose.pose.verify.observability import free_motions, without_motions
from depthpose.pose.verify.target_object import TargetObject, has_surface, require_surface
from depthpose.pose.weights import PoseWeights, read_pose_weights

_DOUBTED: tuple[Status, ...] = ("votes do not meet", "keypoints do not fit", "doubtful")
"""Statuses for which another method may find the pose; the others are due to the input."""
_COMPARED = 100  # points at which the best of symmetric copies is chosen


class VotingDirections(NamedTuple):
    """The points that vote, in the camera frame, and the network's directions at them."""

    points_m: Float[Tensor, "n 3"]  #: where the votes start
    directions: Float[Tensor, "n k 3"]  #: to each keypoint, of any length


@dataclass(kw_only=True, eq=False)
class CloudJob:
    """A cloud that is prepared for the network, and then its directions."""

    pose_input: AnyInput  #: from which the cloud is lifted
    target: TargetObject  #: its object
    cloud: ObjectCloud  #: all points of the object
    voxels: VoxelGrid  #: with the points that the network sees and that vote, one for each voxel
    watch: Stopwatch  #: of the stages so far
    is_expected: bool  #: whether the input is meant to show the object
    #: of the network at each voting point, in the camera frame; empty before it is run.
    directions: Float[Tensor, "n k 3"] = field(default_factory=lambda: torch.empty(0, 0, 3))


def _group_by_voxels(
    clouds: Iterable[CloudJob | PoseEstimate], most: int
) -> Iterator[list[CloudJob | PoseEstimate]]:
    """Group clouds, in their order, so that each group has ``most`` voxels at most or is one cloud.

    Estimates, of inputs that need no network, count as clouds without voxels.
    """
    group: list[CloudJob | PoseEstimate] = []
    group_voxels = 0
    for item in clouds:
        voxels = len(item.voxels.points_m) if isinstance(item, CloudJob) else 0
        if group and group_voxels + voxels > most:
            yield group
            group = []
            group_voxels = 0
        group.append(item)
        group_voxels += voxels
    if group:
        yield group


class GeoPoseNet(PoseEstimator):
    """Estimates 6-DoF poses of known objects from partial clouds, or says why there is none.

    Example::

        net = GeoPoseNet.load("parts")
        estimate = net.estimate(cloud="mug.ply", unit="mm", object="mug")
        print(estimate.camera_from_model if estimate.is_ok else estimate.reason)

    Args:
        weights: the network and the objects that it knows.
        config: voting, ICP, limits, device.

    Raises:
        InputError: weights that cast no votes, a device that is not there, or models without a
            surface that ``register_refused`` is to register.
    """

    name = ""
    """By which the weights were loaded; empty where they came from memory."""

    def __init__(self, weights: PoseWeights, config: EstimateConfig | None = None) -> None:
        super().__init__(weights.models, config, weights.refusal)
        self.weights = weights
        self.terms = weights.facts.get("terms", "")
        """Terms of the weights that bind whoever uses them; empty without any."""
        if isinstance(weights.network, DepthImageNet):
            raise InputError(
                "these weights regress a depth image and cast no votes; give "
                "read_pose_weights(FILE) to DepthImageRegressor"
            )
        self._network = weights.network.to(usable_device(self.config.device)).eval()
        if self.config.register_refused:
            for model in self.models:
                require_surface(model)

    @classmethod
    @force_float32()
    def load(
        cls, weights: str | Path = "parts", config: EstimateConfig | None = None
    ) -> "GeoPoseNet":
        """Build an estimator from weights, by file, folder, name or ``hf://OWNER/NAME``.

        Weights whose terms bind the user say so (:class:`LicenceNotice`).

        Raises:
            InputError: no such weights, or none of a pose network.
        """
        loaded = read_pose_weights(find_weights(weights))
        warn_of_terms(loaded.facts)
        net = cls(loaded, config)
        net.name = str(weights)
        return net

    from_pretrained = load
    """The same as :meth:`load`."""

    def __repr__(self) -> str:
        names = self.objects
        weights = f", weights {self.name!r}" if self.name else ""
        objects = ", ".join(names) if len(names) <= 5 else f"{len(names)} objects"
        kind = type(self._network).__name__
        return f"GeoPoseNet({kind} of {objects}{weights}, {self.config.device})"

    def _estimate(self, pose_input: AnyInput, *, is_expected: bool = True) -> PoseEstimate:
        """Prepare the cloud of an input, run the network on it, and pose it by its votes."""
        job = self._prepare(pose_input, is_expected=is_expected)
        self._run_network([job])
        return self._pose_or_register(job)

    def _estimate_each(self, inputs: Iterable[AnyInput], threads: int) -> Iterator[PoseEstimate]:
        """Do as :meth:`_estimate` does, with one run of the network for several clouds.

        The pose of an input does not depend on those beside it, but for the rounding of the
        network's sums.
        """

        def prepare(pose_input: AnyInput) -> CloudJob | PoseEstimate:
            """Prepare the cloud of one input."""
            return unreadable_on_error(pose_input, partial(self._prepare, pose_input))

        def pose(job: CloudJob | PoseEstimate) -> PoseEstimate:
            """Pose one cloud."""
            if isinstance(job, PoseEstimate):
                return job
            return unreadable_on_error(job.pose_input, partial(self._pose_or_register, job))

        jobs = map_in_threads(prepare, inputs, threads)
        for group in _group_by_voxels(jobs, self.config.batch_voxels):
            self._run_network(group)
            yield from map_in_threads(pose, group, threads)

    @torch.no_grad()
    @force_float32()
    def estimate_with_votes(
        self, pose_input: AnyInput
    ) -> tuple[PoseEstimate, VotingDirections | None]:
        """Estimate one pose without registering it, and return the directions that voted for it.

        Returns:
            The estimate, and the points that vote with their directions in the camera frame; None
            for these where the network was not run, as there is too little to pose.

        Raises:
            InputError: an unknown object, or a mask that does not fit its depth image.
        """
        with refused_memory(pose_input.name):
            job = self._prepare(pose_input)
            if isinstance(job, PoseEstimate):
                return job, None
            self._run_network([job])
            voted = estimate_or_refusal(
                pose_input, job.watch, partial(self._estimate_by_votes, job)
            )
            return voted, VotingDirections(job.voxels.points_m, job.directions)

    def _prepare(
        self, pose_input: AnyInput, *, is_expected: bool = True
    ) -> CloudJob | PoseEstimate:
        """Lift an input to the cloud and the voxels that the network takes.

        For a region, or an input that is refused, the finished estimate is returned instead.
        """
        if isinstance(pose_input, ViewInput) and pose_input.is_region:
            return self._search_region(pose_input, is_expected=is_expected)
        target = self._find_object(pose_input.object).prepare()
        watch = Stopwatch()

        def lift() -> CloudJob:
            """Lift it to the points of the object, and these to voxels."""
            with watch.stage("cloud"):
                cloud = prepare_cloud(pose_input, target.model, self.weights.cloud, self.config)
                seed = self.config.voting.seed
                voxels = sample_and_voxelise(cloud.cloud_m, self.weights.cloud, seed)
            return CloudJob(
                pose_input=pose_input,
                target=target,
                cloud=cloud,
                voxels=voxels,
                watch=watch,
                is_expected=is_expected,
            )

        return estimate_or_refusal(pose_input, watch, lift)

    def _run_network(self, group: Sequence[CloudJob | PoseEstimate]) -> None:
        """Run the network once on all clouds of a group, and set their ``directions``."""
        jobs = [item for item in group if isinstance(item, CloudJob)]
        if not jobs:
            return
        watch = Stopwatch()
        with watch.stage("network"):
            # The voxels of all clouds, one after the other.
            grids = [job.voxels for job in jobs]
            counts = [len(grid.points_m) for grid in grids]
            cloud_of_point = torch.repeat_interleave(torch.arange(len(jobs)), torch.tensor(counts))
            numbers = torch.tensor([job.target.number for job in jobs])
            coordinates = torch.cat([grid.coordinates for grid in grids])
            points_m = [grid.points_m @ grid.grid_from_camera.mT for grid in grids]
            device = self.config.device
            network_input = VotingPoints(
                points_m=torch.cat(points_m).to(device),
                coordinates=torch.cat([cloud_of_point[:, None], coordinates], 1).to(device),
                features=torch.cat([grid.features for grid in grids]).to(device),
                class_of_point=numbers[cloud_of_point].to(device),
            )
            outputs = self._network.directions(network_input).float().cpu().split(counts)

        # Back to each cloud, in the camera frame; each has a share of the time.
        for job, directions, count in zip(jobs, outputs, counts, strict=True):
            job.directions = directions @ job.voxels.grid_from_camera
            job.watch.seconds["network"] = watch.seconds["network"] * count / sum(counts)

    def _pose_or_register(self, job: CloudJob | PoseEstimate) -> PoseEstimate:
        """Pose a cloud by its votes, or by registration where these are doubted.

        It is registered if the config says so and the input is expected to show its object. An
        estimate stays as it is.
        """
        if isinstance(job, PoseEstimate):
            return job
        voted = estimate_or_refusal(
            job.pose_input, job.watch, partial(self._estimate_by_votes, job)
        )
        may_register = self.config.register_refused and job.is_expected
        if not may_register or voted.status not in _DOUBTED:
            return voted
        watch = Stopwatch()
        with watch.stage("registration"):
            work = partial(self._register_or_search, job.pose_input)
            registered = unreadable_on_error(job.pose_input, work)
        best = registered if registered.is_posed else voted
        return replace(best, seconds={**voted.seconds, **watch.seconds})

    def _estimate_by_votes(self, job: CloudJob) -> PoseEstimate:
        """Vote for the keypoints, fit the pose to them, refine it, and decide by the evidence.

        Args:
            job: a cloud with directions.

        Raises:
            Refused: the votes or the evidence do not allow a pose.
        """
        config = self.config
        target = job.target
        watch = job.watch

        # Propose: where the directions meet are the keypoints, to which the model's are fitted.
        with watch.stage("proposal"):
            vote = self._vote(job)
            fits = fit_poses(vote, target.model, config)

        # Refine; where ICP brings no point near the model, the fit of the keypoints stays.
        poses = fits.camera_from_model.double()
        refined = fits[0]
        others = poses[:0]
        if config.with_icp:
            with watch.stage("icp"):
                cloud_m = job.cloud.cloud_m.double()
                rotated = rotate_starts(poses, target.surface, config.icp.starts)
                by_icp, minima = refine_best(cloud_m, poses, target.surface, config.icp, rotated)
            if float(by_icp.inlier_share) > 0:
                refined = by_icp
                others = minima

        # Where little of a part is visible, all votes may mean the wrong end of it. Poses that
        # point pairs propose compete with the one that was voted for.
        if config.with_icp and job.is_expected and has_surface(target.model):
            with watch.stage("proposal"):
                proposals = propose_by_pairs(job.cloud, target, config.voting.seed)
            others = Rigid.cat([others, proposals])

        # Compare, compete, decide.
        voted: dict[str, Any] = {
            "keypoints_m": vote.keypoints_m.float(),
            "inlier_share": float(vote.inlier_share.mean()),
        }
        try:
            estimate = judge(
                job.cloud,
                target,
                refined,
                others,
                config,
                watch,
                is_expected=job.is_expected,
                votes_rad=partial(self._measure_disagreement, job),
            )
        except Refused as refused:
            measured = {**voted, **refused.measured}
            raise Refused(refused.status, refused.reason, **measured) from refused
        return replace(estimate, **voted)

    def _vote(self, job: CloudJob) -> Vote:
        """Find the keypoints, in the camera frame, where the directions at the points meet."""
        points_m = job.voxels.points_m.double()
        directions = job.directions.double()
        voting = self.config.voting
        if voting.method == "ransac":
            return vote_ransac(points_m, directions, config=voting)
        return meet_lines(points_m, directions, refinements=voting.refinements)

    def _measure_disagreement(self, job: CloudJob, pose: Rigid) -> float:
        """Measure the mean angle [rad] between the directions and those to a pose's keypoints.

        The network was trained to treat symmetric copies of a pose as one: the angle is measured to
        the copy whose keypoints the directions fit best.
        """
        # The copy that fits some of the directions best.
        keypoints_m = job.target.model.keypoints_m.double()
        copies_m = (pose @ job.target.copies.trained).apply(keypoints_m)
        points_m = job.voxels.points_m.double()
        directions = normalize(job.directions.double(), dim=-1)
        step = max(1, len(points_m) // _COMPARED)
        to_copies = normalize(copies_m[:, None] - points_m[::step, None], dim=-1)
        cosines = (directions[::step] * to_copies).sum(-1)  # (copies, points, keypoints)
        best = int(cosines.mean((-2, -1)).argmax())

        # The angle to it, over all of them.
        to_best = normalize(copies_m[best] - points_m[:, None], dim=-1)
        angles_rad = (directions * to_best).sum(-1).clamp(-1, 1).arccos()
        return float(angles_rad.mean())


class DepthImageRegressor(PoseEstimator):
    """The baseline as an estimator: a pose regressed from a masked depth image, and ICP.

    It refuses nothing but views with too little of the object.

    Args:
        weights: of kind ``depth-image``.
        config: whether ICP follows, its settings, and the device; the rest is not used.

    Raises:
        InputError: the weights are of another kind, or ``register_refused`` is set.
    """

    needs_mask = True

    def __init__(self, weights: PoseWeights, config: EstimateConfig | None = None) -> None:
        super().__init__(weights.models, config, weights.refusal)
        if not isinstance(weights.network, DepthImageNet):
            raise InputError(
                "these weights cast votes and regress no depth image; load them as GeoPoseNet"
            )
        if self.config.register_refused:
            raise InputError(
                "a regressed depth image refuses nothing that could be registered; omit "
                "--register-refused (register_refused=True)"
            )
        self._network = weights.network.to(usable_device(self.config.device)).eval()
        self._cloud = weights.cloud

    def _estimate(self, pose_input: AnyInput, *, is_expected: bool = True) -> PoseEstimate:
        """Regress the pose from a crop of the depth image, and refine it by ICP."""
        target = self._find_object(pose_input.object)
        if not isinstance(pose_input, ViewInput):
            raise InputError(NEEDS_MASK)
        # An empty region means that nothing was detected: it is refused below for too few pixels.
        if pose_input.is_region and bool(pose_input.mask.any()):
            raise InputError(NEEDS_MASK)
        if not is_expected:
            names = ", ".join(self.objects)
            raise InputError(f"object: say which of {names}; a regressor refuses none")
        _ = target.surface  # computed before any stage is timed
        watch = Stopwatch()
        work = partial(self._regress, pose_input, target, watch)
        return estimate_or_refusal(pose_input, watch, work)

    def _regress(
        self, pose_input: ViewInput, target: TargetObject, watch: Stopwatch
    ) -> PoseEstimate:
        """Regress the pose of one object, and refine it.

        Args:
            pose_input: a depth image with the mask of the object.
            target: the object.
            watch: to which the times of the stages are added.

        Raises:
            Refused: the mask has too few readings.
        """
        config = self._network.config
        model = target.model
        pose_input = replace(pose_input, mask=pose_input.foreground)

        # The crop that the network sees, and the pose that it regresses.
        with watch.stage("network"):
            crop = cut_depth(pose_input, config, model.diameter_m)
        if crop is None:
            reason = f"fewer than {config.min_points} masked pixels have a depth"
            raise Refused("too few points", reason)
        with watch.stage("network"):
            batch = DepthCrop(*(part[None].to(self.config.device) for part in crop))
            numbers = torch.tensor([target.number], device=self.config.device)
            poses = make_poses(self._network(batch.image, numbers), batch)
            pose = Rigid(poses.R[0].cpu().float(), poses.t_m[0].cpu().float())
        estimate = PoseEstimate(
            name=pose_input.name,
            object=pose_input.object,
            status="ok",
            camera_from_model=pose,
            seconds=watch.seconds,
        )
        if not self.config.with_icp:
            return estimate

        # Refined on the points of the mask.
        with watch.stage("icp"):
            points_m = cloud_from_depth(
                pose_input.depth_m, pose_input.mask, pose_input.K, model.diameter_m, self._cloud
            ).float()
        require_points(points_m, self._cloud)
        with watch.stage("icp"):
            icp = self.config.icp
            rotated = rotate_starts(pose[None].double(), target.surface, icp.starts)
            refined, _ = refine_best(points_m, pose, target.surface, icp, rotated)
        if float(refined.inlier_share) == 0:  # no point near the surface: nothing was refined
            return estimate
        free = free_motions(model.symmetries.continuous, refined.camera_from_model.double())
        return replace(
            estimate,
            camera_from_model=refined.camera_from_model,
            covariance=without_motions(refined.covariance.double(), free).float(),
            free_motions=free.float(),
            residual_m=float(refined.residual_m),
        )
