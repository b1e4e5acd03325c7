"""Open3D's registration, the peer of other benches: FPFH features, RANSAC and ICP."""

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from depthpose.core.errors import import_extra
from depthpose.core.rigid import Rigid
from depthpose.pose.mesh import sample_surface
from depthpose.pose.types import CloudInput, ObjectModel, PoseEstimate, ViewInput
from depthpose.report.pose import object_points

VOXEL_DIAMETERS = 0.03  # side of a voxel in diameters of the object
_ITERATIONS = 100_000  # of RANSAC, at most
_MODEL_POINTS = 20_000
_NORMAL, _FEATURE, _CORRESPONDENCE, _ICP = 2.0, 5.0, 1.5, 0.4
"""Radius for normals and for features (Rusu et al. 2009), reach of RANSAC's correspondences and of
the point-to-plane ICP that follows, in voxels, as Open3D's tutorial has them."""
_LEAST = 3  # points that a pose takes; Open3D answers fewer with a crash or with the identity


class FpfhEstimator:
    """Registration of several objects, each model prepared once; called as the networks are.

    ``voxel_diameters`` is the side of a voxel, ``seed`` that of RANSAC.

    Raises:
        MissingExtraError: Open3D is not installed.
    """

    def __init__(
        self,
        models: Sequence[ObjectModel],
        voxel_diameters: float = VOXEL_DIAMETERS,
        seed: int = 0,
    ) -> None:
        self._voxel_diameters, self._seed = voxel_diameters, seed
        self._open3d = import_extra("open3d", "open3d", "open3d", "registration by FPFH")
        self._models = {model.name: model for model in models}
        self._targets: dict[str, tuple[Any, Any]] = {}
        for model in models:
            points_m, normals = sample_surface(model, _MODEL_POINTS)
            cloud = self._cloud(points_m)
            cloud.normals = self._open3d.utility.Vector3dVector(normals.double().numpy())
            self._targets[model.name] = self._prepare(cloud, self._voxel_m(model))

    def estimate_many(self, inputs: Sequence[CloudInput | ViewInput]) -> list[PoseEstimate]:
        """Pose one after the other; RANSAC that finds nothing is a refusal."""
        return [self._estimate(given) for given in inputs]

    def _estimate(self, given: CloudInput | ViewInput) -> PoseEstimate:
        began, model = time.perf_counter(), self._models[given.object]
        points_m = object_points(given, model.diameter_m)
        if len(points_m) < _LEAST:
            reason = f"the cloud has {len(points_m)} points, and a pose takes {_LEAST}"
            return PoseEstimate(
                name=given.name, object=given.object, status="too few points", reason=reason
            )
        o3d, voxel_m = self._open3d, self._voxel_m(model)
        target, its_features = self._targets[model.name]
        source, features = self._prepare(self._cloud(points_m), voxel_m)
        o3d.utility.random.seed(self._seed)
        # It prints a line for each cloud of which few features are mutually nearest.
        r, limit_m = o3d.pipelines.registration, _CORRESPONDENCE * voxel_m
        with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
            found = r.registration_ransac_based_on_feature_matching(
                source, target, features, its_features, True, limit_m,
                r.TransformationEstimationPointToPoint(False), 3,
                [
                    r.CorrespondenceCheckerBasedOnEdgeLength(0.9),
                    r.CorrespondenceCheckerBasedOnDistance(limit_m),
                ],
                r.RANSACConvergenceCriteria(_ITERATIONS, 0.999),
            )  # fmt: skip
        if len(found.correspondence_set):
            found = r.registration_icp(
                source, target, _ICP * voxel_m, found.transformation,
                r.TransformationEstimationPointToPlane(),
            )  # fmt: skip
        seconds = {"registration": time.perf_counter() - began}
        if not len(found.correspondence_set):
            reason = "RANSAC found no pose that any correspondence of features agrees with"
            return PoseEstimate(
                name=given.name, object=given.object, status="no pose found",
                reason=reason, seconds=seconds,
            )  # fmt: skip
        T = torch.from_numpy(np.array(found.transformation))
        pose = Rigid(T[:3, :3], T[:3, 3]).inverse()
        return PoseEstimate(
            name=given.name,
            object=given.object,
            status="ok",
            camera_from_model=Rigid(pose.R.to(points_m), pose.t_m.to(points_m)),
            inlier_share=float(found.fitness),
            residual_m=float(found.inlier_rmse),
            seconds=seconds,
        )

    def _voxel_m(self, model: ObjectModel) -> float:
        return self._voxel_diameters * model.diameter_m

    def _cloud(self, points_m: Float[Tensor, "n 3"]) -> Any:  # noqa: ANN401 - Open3D has no types
        cloud = self._open3d.geometry.PointCloud()
        cloud.points = self._open3d.utility.Vector3dVector(points_m.double().cpu().numpy())
        return cloud

    def _prepare(self, cloud: Any, voxel_m: float) -> tuple[Any, Any]:  # noqa: ANN401
        """Thin a cloud to voxels; normals of a measured one point to the camera."""
        o3d = self._open3d
        cloud = cloud.voxel_down_sample(voxel_m)
        near = o3d.geometry.KDTreeSearchParamHybrid
        if not cloud.has_normals():
            cloud.estimate_normals(near(radius=_NORMAL * voxel_m, max_nn=30))
            cloud.orient_normals_towards_camera_location(np.zeros(3))
        features = o3d.pipelines.registration.compute_fpfh_feature(
            cloud, near(radius=_FEATURE * voxel_m, max_nn=100)
        )
        return cloud, features
