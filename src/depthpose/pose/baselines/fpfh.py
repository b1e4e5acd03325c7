"""FPFH features, RANSAC and ICP of Open3D: the classical peer, which needs no training."""

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from depthpose.core.errors import import_open3d
from depthpose.core.rigid import Rigid
from depthpose.pose.baselines.config import FpfhConfig
from depthpose.pose.cloud import cloud_from_depth
from depthpose.pose.mesh import sample_surface
from depthpose.pose.types import CloudInput, ObjectModel, PoseEstimate, ViewInput

_MODEL_POINTS = 20_000
_NORMAL, _FEATURE, _CORRESPONDENCE, _ICP = 2.0, 5.0, 1.5, 0.4
"""Radius for normals and for features (Rusu et al. 2009), reach of RANSAC's correspondences and of
the point-to-plane ICP that follows, in voxels, as Open3D's tutorial has them."""
_LEAST = 3
"""Points that a pose takes; Open3D answers fewer with a crash or with the identity."""


class FpfhRegistration:
    """Poses of one object: its model is prepared once.

    Raises:
        MissingExtraError: Open3D is not installed.
    """

    def __init__(self, model: ObjectModel, config: FpfhConfig | None = None) -> None:
        self.model, self.config = model, config or FpfhConfig()
        self._open3d = import_open3d("registration by FPFH")
        points_m, normals = sample_surface(model, _MODEL_POINTS)
        cloud = self._cloud(points_m)
        cloud.normals = self._open3d.utility.Vector3dVector(normals.double().numpy())
        self._target, self._target_features = self._prepare(cloud)

    def estimate(self, given: CloudInput) -> PoseEstimate:
        """Pose a cloud; RANSAC that finds nothing is a refusal."""
        began = time.perf_counter()
        if len(given.points_m) < _LEAST:
            reason = f"the cloud has {len(given.points_m)} points, and a pose takes {_LEAST}"
            return PoseEstimate(
                name=given.name, object=given.object, status="too few points", reason=reason
            )
        o3d = self._open3d
        source, features = self._prepare(self._cloud(given.points_m))
        o3d.utility.random.seed(self.config.seed)
        # It prints a line for each cloud of which few features are mutually nearest.
        with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
            found = self._ransac(source, features)
        if len(found.correspondence_set):
            r = o3d.pipelines.registration
            found = r.registration_icp(
                source, self._target, _ICP * self._voxel_m, found.transformation,
                r.TransformationEstimationPointToPlane(),
            )  # fmt: skip
        seconds = {"registration": time.perf_counter() - began}
        if not len(found.correspondence_set):
            reason = "RANSAC found no pose that any correspondence of features agrees with"
            return PoseEstimate(
                name=given.name, object=given.object, status="votes do not meet",
                reason=reason, seconds=seconds,
            )  # fmt: skip
        T = torch.from_numpy(np.array(found.transformation))
        pose = Rigid(T[:3, :3], T[:3, 3]).inverse()
        return PoseEstimate(
            name=given.name,
            object=given.object,
            status="ok",
            camera_from_model=Rigid(pose.R.to(given.points_m), pose.t_m.to(given.points_m)),
            inlier_share=float(found.fitness),
            residual_m=float(found.inlier_rmse),
            seconds=seconds,
        )

    @property
    def _voxel_m(self) -> float:
        return self.config.voxel_diameters * self.model.diameter_m

    def _cloud(self, points_m: Float[Tensor, "n 3"]) -> Any:  # noqa: ANN401 - Open3D has no types
        cloud = self._open3d.geometry.PointCloud()
        cloud.points = self._open3d.utility.Vector3dVector(points_m.double().cpu().numpy())
        return cloud

    def _prepare(self, cloud: Any) -> tuple[Any, Any]:  # noqa: ANN401
        """Thin a cloud to voxels; normals of a measured one point to the camera."""
        o3d, voxel_m = self._open3d, self._voxel_m
        cloud = cloud.voxel_down_sample(voxel_m)
        near = o3d.geometry.KDTreeSearchParamHybrid
        if not cloud.has_normals():
            cloud.estimate_normals(near(radius=_NORMAL * voxel_m, max_nn=30))
            cloud.orient_normals_towards_camera_location(np.zeros(3))
        features = o3d.pipelines.registration.compute_fpfh_feature(
            cloud, near(radius=_FEATURE * voxel_m, max_nn=100)
        )
        return cloud, features

    def _ransac(self, source: Any, features: Any) -> Any:  # noqa: ANN401
        r = self._open3d.pipelines.registration
        limit_m = _CORRESPONDENCE * self._voxel_m
        return r.registration_ransac_based_on_feature_matching(
            source, self._target, features, self._target_features, True, limit_m,
            r.TransformationEstimationPointToPoint(False), 3,
            [
                r.CorrespondenceCheckerBasedOnEdgeLength(0.9),
                r.CorrespondenceCheckerBasedOnDistance(limit_m),
            ],
            r.RANSACConvergenceCriteria(self.config.iterations, 0.999),
        )  # fmt: skip


class FpfhEstimator:
    """Registration of several objects from their masked depth, called as the networks are.

    Raises:
        MissingExtraError: Open3D is not installed.
    """

    def __init__(self, models: Sequence[ObjectModel], config: FpfhConfig | None = None) -> None:
        self._peers = {model.name: FpfhRegistration(model, config) for model in models}

    def estimate_many(self, inputs: Sequence[ViewInput]) -> list[PoseEstimate]:
        """Pose one after the other."""
        estimates = []
        for given in inputs:
            peer = self._peers[given.object]
            points_m = cloud_from_depth(given.depth_m, given.mask, given.K, peer.model.diameter_m)
            cloud = CloudInput(name=given.name, points_m=points_m.float(), object=given.object)
            estimates.append(peer.estimate(cloud))
        return estimates
