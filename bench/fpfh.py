"""Open3D's registration, with which other scripts compare ours: FPFH features, RANSAC and ICP.

Imported by ``pose_peers`` and ``synthetic_linemod``; radii and distances are those of Open3D's
tutorial on global registration.
"""

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
from depthpose.report.pose import select_object_points

VOXEL_DIAMETERS = 0.03  # side of a voxel, in diameters of the object
MODEL_POINTS = 20_000  # sampled of the surface of a model
MIN_POINTS = 3  # Open3D crashes on fewer, or answers the identity

# Radii and distances in voxels.
NORMAL_RADIUS = 2.0
FEATURE_RADIUS = 5.0  # of FPFH (Rusu et al. 2009)
MAX_RANSAC_DISTANCE = 1.5
MAX_ICP_DISTANCE = 0.4

MAX_NORMAL_NEIGHBOURS = 30
MAX_FEATURE_NEIGHBOURS = 100
SAMPLE_SIZE = 3  # correspondences of a hypothesis
MIN_EDGE_RATIO = 0.9  # of the lengths between two sampled correspondences
MAX_ITERATIONS = 100_000
CONFIDENCE = 0.999


class FpfhEstimator:
    """Registration of several objects, called as our estimators are; models are prepared once.

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
        self._open3d = import_extra("open3d", "open3d", "open3d", "registration by FPFH")
        self._voxel_diameters = voxel_diameters
        self._seed = seed
        self._models = {model.name: model for model in models}
        self._targets = {model.name: self._prepare_model(model) for model in models}

    def estimate_many(self, inputs: Sequence[CloudInput | ViewInput]) -> list[PoseEstimate]:
        """Pose inputs one after the other; where RANSAC finds nothing, the answer is a refusal."""
        return [self._estimate(cloud_or_view) for cloud_or_view in inputs]

    def _estimate(self, cloud_or_view: CloudInput | ViewInput) -> PoseEstimate:
        start_s = time.perf_counter()
        name = cloud_or_view.name
        model = self._models[cloud_or_view.object]
        points_m = select_object_points(cloud_or_view, model.diameter_m)
        if len(points_m) < MIN_POINTS:
            reason = f"the cloud has {len(points_m)} points, and a pose takes {MIN_POINTS}"
            return PoseEstimate(
                name=name, object=model.name, status="too few points", reason=reason
            )
        result = self._register(points_m, model)
        seconds = {"registration": time.perf_counter() - start_s}
        if not len(result.correspondence_set):
            reason = "RANSAC found no pose that any correspondence of features agrees with"
            return PoseEstimate(
                name=name, object=model.name, status="no pose found", reason=reason, seconds=seconds
            )
        matrix = torch.from_numpy(np.array(result.transformation))
        model_from_camera = Rigid(matrix[:3, :3], matrix[:3, 3])
        pose = model_from_camera.inverse()
        return PoseEstimate(
            name=name,
            object=model.name,
            status="ok",
            camera_from_model=Rigid(pose.R.to(points_m), pose.t_m.to(points_m)),
            inlier_share=float(result.fitness),
            residual_m=float(result.inlier_rmse),
            seconds=seconds,
        )

    def _register(self, points_m: Float[Tensor, "n 3"], model: ObjectModel) -> Any:  # noqa: ANN401 - Open3D has no types
        """Register points to a model by RANSAC, then by point-to-plane ICP where RANSAC agrees."""
        open3d = self._open3d
        registration = open3d.pipelines.registration
        voxel_m = self._voxel_m(model)
        max_distance_m = MAX_RANSAC_DISTANCE * voxel_m
        target, target_features = self._targets[model.name]
        source, source_features = self._prepare(self._to_cloud(points_m), voxel_m)
        open3d.utility.random.seed(self._seed)
        # Open3D prints a line for each cloud of which few features are mutually nearest.
        with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
            result = registration.registration_ransac_based_on_feature_matching(
                source,
                target,
                source_features,
                target_features,
                True,
                max_distance_m,
                registration.TransformationEstimationPointToPoint(False),
                SAMPLE_SIZE,
                [
                    registration.CorrespondenceCheckerBasedOnEdgeLength(MIN_EDGE_RATIO),
                    registration.CorrespondenceCheckerBasedOnDistance(max_distance_m),
                ],
                registration.RANSACConvergenceCriteria(MAX_ITERATIONS, CONFIDENCE),
            )
        if not len(result.correspondence_set):
            return result
        return registration.registration_icp(
            source,
            target,
            MAX_ICP_DISTANCE * voxel_m,
            result.transformation,
            registration.TransformationEstimationPointToPlane(),
        )

    def _voxel_m(self, model: ObjectModel) -> float:
        return self._voxel_diameters * model.diameter_m

    def _prepare_model(self, model: ObjectModel) -> tuple[Any, Any]:
        """Sample the surface of a model; return the thinned cloud and its features."""
        points_m, normals = sample_surface(model, MODEL_POINTS)
        cloud = self._to_cloud(points_m)
        cloud.normals = self._open3d.utility.Vector3dVector(normals.double().numpy())
        return self._prepare(cloud, self._voxel_m(model))

    def _to_cloud(self, points_m: Float[Tensor, "n 3"]) -> Any:  # noqa: ANN401 - Open3D has no types
        cloud = self._open3d.geometry.PointCloud()
        cloud.points = self._open3d.utility.Vector3dVector(points_m.double().cpu().numpy())
        return cloud

    def _prepare(self, cloud: Any, voxel_m: float) -> tuple[Any, Any]:  # noqa: ANN401
        """Thin a cloud to voxels and compute features; normals are made to face the camera."""
        open3d = self._open3d
        search = open3d.geometry.KDTreeSearchParamHybrid
        cloud = cloud.voxel_down_sample(voxel_m)
        if not cloud.has_normals():
            radius_m = NORMAL_RADIUS * voxel_m
            cloud.estimate_normals(search(radius=radius_m, max_nn=MAX_NORMAL_NEIGHBOURS))
            cloud.orient_normals_towards_camera_location(np.zeros(3))
        radius_m = FEATURE_RADIUS * voxel_m
        features = open3d.pipelines.registration.compute_fpfh_feature(
            cloud, search(radius=radius_m, max_nn=MAX_FEATURE_NEIGHBOURS)
        )
        return cloud, features
