"""Registration: poses of objects from their models alone, without training.

Point pairs propose poses, ICP refines them, the posed models are compared with the depth image, and
the evidence decides.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch

from depthpose.core.arrays import take_evenly
from depthpose.core.devices import each_in_threads, force_float32
from depthpose.core.errors import InputError
from depthpose.core.rigid import Rigid
from depthpose.core.units import Unit
from depthpose.pose.cloud import ObjectCloud, local_planes, prepare_cloud, thin
from depthpose.pose.config import CloudConfig, EstimateConfig, RefusalConfig
from depthpose.pose.copies import PreparedObject
from depthpose.pose.decide import refused, seconds_of_all
from depthpose.pose.estimator import PoseEstimator
from depthpose.pose.icp import refine_best
from depthpose.pose.inputs import AnyInput
from depthpose.pose.mesh import (
    AnyModel,
    AnySymmetry,
    declare_symmetry,
    read_model,
    refuse_one_name,
    symmetry_of_each,
    with_found_symmetries,
)
from depthpose.pose.probability import PRIOR_MASKED
from depthpose.pose.propose.point_pairs import propose_poses
from depthpose.pose.types import CloudInput, ObjectModel, PoseEstimate, Refusal, ViewInput

_VOTING_DIAMETERS = 0.05  # distance of the points that vote
_LEAST_POINTS = 500  # of a model without faces
_PROPOSALS = 40
_SMOOTHED_POINTS = 1500  # of so many, 20 neighbours give a normal that noise hardly turns


class Registration(PoseEstimator):
    """Poses of objects whose models are seen for the first time.

    Pairs of points of the cloud propose poses, ICP refines them, and the evidence against the best
    decides whether it is the answer, as it does for :class:`~depthpose.GeoPoseNet`.

    Example::

        parts = Registration.load("part.stl", unit="mm")
        found = parts.estimate(cloud="scan.ply", unit="mm")

    Args:
        models: the objects.
        config: ICP, limits; the seed is that of voting.
        refusal: when an answer is withheld; None: by the usual limits.

    Raises:
        InputError: no model, two of one name, or one of few points without faces.
    """

    _holder = "the models"

    def __init__(
        self,
        models: Sequence[ObjectModel],
        config: EstimateConfig | None = None,
        refusal: RefusalConfig | None = None,
    ) -> None:
        super().__init__(models, config, refusal or RefusalConfig())
        if not models:
            raise InputError(
                "registration looks for CAD files and none is given; name one: STL, PLY, OBJ or GLB"
            )
        refuse_one_name(models)
        for model in models:
            points = len(model.vertices_m)
            if len(model.faces) == 0 and points < _LEAST_POINTS:
                raise InputError(
                    f"{model.name}: {points} points without faces are no surface; export the part "
                    f"as a mesh with triangles, such as STL, or give {_LEAST_POINTS} points"
                )
        if config is not None and not config.with_icp:
            raise InputError("registration refines by ICP; omit --no-icp (with_icp=False)")
        if config is not None and config.register_refused:
            raise InputError(
                "registration has no network whose refusals it could register; omit "
                "--register-refused (register_refused=True)"
            )

    @classmethod
    @force_float32()
    def load(
        cls,
        *cad: AnyModel,
        unit: Unit | None = None,
        config: EstimateConfig | None = None,
        symmetry: AnySymmetry | Mapping[str, AnySymmetry] | Sequence[str] | None = None,
    ) -> "Registration":
        """Read CAD files; declared or found symmetries of a part make its copies one answer.

        Args:
            cad: PLY, STL, OBJ, GLB, or meshes of trimesh or Open3D; an object is called as its
                file, or as :func:`~depthpose.pose.mesh.read_model` says.
            unit: of the numbers in the files; None where all are GLB, which has metres.
            config: as above.
            symmetry: that a part has, in place of those that are found: ``"z,18"`` looks alike
                after each of 18 equal turns about an axis along z, ``"z,free"`` after any, and
                ``"z,6+x,2"`` has two axes; BOP's entry of an object, or a JSON file of it. The axis
                goes where the surface has it. Of several files a dict from names.

        Raises:
            InputError: no file, two of one name, one that is not read, without a surface or unit; a
                symmetry that is none, or of no object.
        """
        models = [read_model(path, unit, number=k) for k, path in enumerate(cad, start=1)]
        declared = symmetry_of_each(symmetry, [model.name for model in models])
        models = [
            declare_symmetry(m, declared[m.name]) if m.name in declared else m for m in models
        ]
        return cls([with_found_symmetries(m, None, is_taken=True) for m in models], config)

    def __repr__(self) -> str:
        names = self.objects
        objects = ", ".join(names) if len(names) <= 5 else f"{len(names)} objects"
        return f"Registration(of {objects})"

    def prepare(self) -> None:
        """Prepare every model now, about a second each; else it is done when first asked for."""
        for name in self.objects:
            self._prepared_object(name)

    def _estimate_near(
        self, inputs: Sequence[CloudInput], proposals: Sequence[Rigid], prior_odds: float
    ) -> list[PoseEstimate]:
        """Estimate objects of a search from the poses that were proposed for each."""

        def estimate(pair: tuple[CloudInput, Rigid]) -> PoseEstimate:
            pose_input, proposed = pair
            return self._estimate_cloud(pose_input, proposed, prior_odds)

        pairs = zip(inputs, proposals, strict=True)
        return list(each_in_threads(estimate, pairs, torch.get_num_threads()))

    def _estimate(self, pose_input: AnyInput) -> PoseEstimate:
        """Estimate a pose from the points of a mask; from its region, if the mask does not fit."""
        if isinstance(pose_input, ViewInput) and pose_input.is_region:
            return self._estimate_in_region(pose_input)
        estimate = self._estimate_cloud(pose_input, None, PRIOR_MASKED)
        if estimate.status != "doubtful" or not isinstance(pose_input, ViewInput):
            return estimate
        in_region = self._estimate_in_region(replace(pose_input, is_region=True))
        seconds = seconds_of_all([estimate, in_region])
        return replace(in_region if in_region.is_posed else estimate, seconds=seconds)

    def _estimate_cloud(
        self, pose_input: AnyInput, proposals: Rigid | None, prior_odds: float
    ) -> PoseEstimate:
        """Estimate a pose from a mask's points, or from those at poses that a search proposed.

        Args:
            pose_input: the points.
            proposals: of a search; None: point pairs of the points propose.
            prior_odds: of the best pose being right.
        """
        prepared = self._prepared_object(pose_input.object)
        is_masked = proposals is None

        # The usable points of the object.
        began = time.perf_counter()
        cloud = prepare_cloud(pose_input, prepared.model, CloudConfig(), self.config)
        seconds = {"cloud": time.perf_counter() - began}
        if isinstance(cloud, Refusal):
            return refused(pose_input, cloud, seconds)

        # Propose.
        began = time.perf_counter()
        if proposals is None:
            proposals = self._propose(cloud, prepared)
        seconds["proposal"] = time.perf_counter() - began

        # Refine, from each pose alone: the proposals are many.
        began = time.perf_counter()
        icp = replace(self.config.icp, starts=1)
        refinement = refine_best(cloud.cloud_m.double(), proposals, prepared.surface, icp)
        seconds["icp"] = time.perf_counter() - began
        if float(refinement.refined.inlier_share) == 0:
            reason = "no pose brings the model near the points: another object, or too little of it"
            return refused(pose_input, Refusal(status="no pose found", reason=reason), seconds)

        return self._judge(
            cloud,
            prepared,
            refinement,
            icp,
            seconds,
            prior_odds=prior_odds,
            is_masked=is_masked,
        )

    def _propose(self, cloud: ObjectCloud, prepared: PreparedObject) -> Rigid:
        """Propose poses by the point pairs of a cloud."""
        dense_m = take_evenly(cloud.cloud_m.double(), _SMOOTHED_POINTS)
        step_m = _VOTING_DIAMETERS * prepared.surface.diameter_m
        voting_m = dense_m[thin(dense_m, torch.zeros_like(dense_m), step_m)]
        normals, _ = local_planes(dense_m, voting_m)
        generator = torch.Generator().manual_seed(self.config.voting.seed)
        return propose_poses(voting_m, normals, prepared.pairs, _PROPOSALS, generator)
