"""Registration: poses of objects by their models alone, without training."""

import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch

from depthpose.core.arrays import take_evenly
from depthpose.core.devices import each_in_threads, own_arithmetic
from depthpose.core.errors import InputError
from depthpose.core.rigid import Rigid
from depthpose.core.units import Unit
from depthpose.pose.cloud import Refusal, local_planes, prepare_cloud
from depthpose.pose.config import CloudConfig, EstimateConfig, RefusalConfig
from depthpose.pose.estimator.base import PoseEstimator, or_unreadable
from depthpose.pose.estimator.candidates import (
    Candidate,
    find_candidates,
    find_copies,
    nearest_posed,
    surface_signals,
    tilt_of,
)
from depthpose.pose.estimator.fit import answer_of, refused
from depthpose.pose.mesh import read_model, refuse_one_name, with_found_symmetries
from depthpose.pose.refine import refine_best
from depthpose.pose.types import AnyInput, CloudInput, ObjectModel, PoseEstimate
from depthpose.pose.voting.point_pairs import prepare_pairs, propose_poses, thin

CANDIDATE_SLOPES = {
    name: slope for name, slope in RefusalConfig().candidate_slopes.items() if name != "disagree"
}
"""As of :class:`RefusalConfig`; no network disagrees."""
REFUSAL = RefusalConfig(candidate_slopes=CANDIDATE_SLOPES)
_VOXEL = 0.05  # of the diameter
_LEAST = 500  # points of a model without faces
_PROPOSALS = 40
_SMOOTHED = 1500  # of so many points 20 neighbours lay the plane that gives a normal


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
        if not models:
            raise InputError(
                "registration looks for CAD files and none is given; name one: STL, PLY, OBJ or GLB"
            )
        refuse_one_name(models)
        for model in models:
            points = len(model.vertices_m)
            if len(model.faces) == 0 and points < _LEAST:
                raise InputError(
                    f"{model.name}: {points} points without faces are no surface; export the part "
                    f"as a mesh with triangles, such as STL, or give {_LEAST} points"
                )
        if config is not None and not config.with_icp:
            raise InputError("registration refines by ICP; omit --no-icp (with_icp=False)")
        if config is not None and config.register_refused:
            raise InputError(
                "registration has no network whose refusals it could register; omit "
                "--register-refused (register_refused=True)"
            )
        super().__init__(models, config, refusal or REFUSAL)

    @classmethod
    @own_arithmetic()
    def load(
        cls, *cad: str | Path, unit: Unit | None = None, config: EstimateConfig | None = None
    ) -> "Registration":
        """Read CAD files; symmetries that are found in a part make its copies one answer.

        Args:
            cad: PLY, STL, OBJ, GLB; an object is called as its file.
            unit: of the numbers in the files; None where all are GLB, which has metres.
            config: as above.

        Raises:
            InputError: no file, two of one name, one that is not read, without a surface or unit.
        """
        if not all(isinstance(path, str | Path) for path in cad):
            raise InputError("Registration.load takes paths one by one: load(*files, unit=...)")
        models = [read_model(path, unit, number=k) for k, path in enumerate(cad, start=1)]
        return cls([with_found_symmetries(m, None, is_taken=True) for m in models], config)

    def __repr__(self) -> str:
        return f"Registration(of {self._objects_in_short()})"

    def prepare(self) -> None:
        """Prepare every model now, about a second each; else it is done when first asked for."""
        for name in self.objects:
            known, up_to_symmetry = self._known(name), self.config.up_to_symmetry
            if known.copies is None:
                known.copies = find_copies(known.model, up_to_symmetry=up_to_symmetry)
            self._pairs(known)

    def _each(
        self, inputs: Iterable[AnyInput], threads: int, *, is_likely: bool = True
    ) -> Iterator[PoseEstimate]:
        """Register one by one, whatever is likely; a model is prepared when first asked for."""
        del is_likely
        return each_in_threads(partial(or_unreadable, self._estimate), inputs, threads)

    def _pose_near(
        self, inputs: Sequence[CloudInput], poses: Sequence[Rigid]
    ) -> list[PoseEstimate]:
        """Refine the poses that were proposed, without votes of the clouds alone."""
        both, threads = zip(inputs, poses, strict=True), torch.get_num_threads()
        return list(each_in_threads(lambda one: self._estimate(*one), both, threads))

    def _estimate(self, given: AnyInput, poses: Rigid | None = None) -> PoseEstimate:
        """Estimate a pose, from those that were proposed if there are any."""
        known = self._known(given.object)
        model, surface = known.model, known.surface
        began = time.perf_counter()
        cloud = CloudConfig(voxel_m=min(0.9, _VOXEL * model.diameter_m), max_points=None)
        prepared = prepare_cloud(given, model, cloud, self.config)
        seconds = {"cloud": time.perf_counter() - began}
        if isinstance(prepared, Refusal):
            return refused(given, prepared, seconds)
        began = time.perf_counter()
        proposals, cloud_m = poses, prepared.cloud_m.double()
        if proposals is None:
            generator = torch.Generator().manual_seed(self.config.voting.seed)
            dense_m = take_evenly(cloud_m, _SMOOTHED)
            some_m = dense_m[thin(dense_m, torch.zeros_like(dense_m), _VOXEL * surface.diameter_m)]
            normals, _ = local_planes(dense_m, some_m)
            if known.pairs is None:
                known.pairs = prepare_pairs(surface)
            proposals = propose_poses(some_m, normals, known.pairs, surface, _PROPOSALS, generator)
        voted = time.perf_counter()
        seconds["voting"] = voted - began
        best = refine_best(cloud_m, proposals, surface, replace(self.config.icp, starts=1))
        icp = best.refined
        if float(icp.inlier_share) == 0:
            reason = "no pose lays the model near the points: another object, or too little of it"
            return refused(given, Refusal(status="votes do not meet", reason=reason), seconds)
        first = Candidate(icp.camera_from_model, icp.covariance, float(icp.residual_m))
        candidates = find_candidates(
            cloud_m, first, best.others, known, self.config, is_refined=True
        )
        found = Rigid.stack([one.pose for one in candidates])
        evidence = surface_signals(cloud_m, found, surface)
        for pose, signals in zip([one.pose for one in candidates], evidence, strict=True):
            # The plane through neighbours is tilted where a part has edges and thin features too,
            # whatever the pose: so it is on the cloud moved onto the posed surface.
            _, index = nearest_posed(cloud_m, pose, surface)
            own = tilt_of(pose.apply(surface.points_m[index]), pose[None], surface)
            signals["tilt"] = max(0.0, signals["tilt"] - float(own))
        seconds["icp"] = time.perf_counter() - voted
        return answer_of(prepared, known, candidates, evidence, self.refusal, self.config, seconds)
