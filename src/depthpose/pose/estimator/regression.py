"""Views to poses by the regressed depth image: the baseline, with the same refinement as ours."""

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch

from depthpose.core.checkpoint import find_weights, warn_of_terms
from depthpose.core.devices import own_arithmetic, usable_device
from depthpose.core.errors import InputError
from depthpose.core.rigid import Rigid
from depthpose.pose.baselines import DepthCrop, DepthImageNet, cut_depth, poses_of
from depthpose.pose.cloud import cloud_from_depth, refusal_of
from depthpose.pose.config import EstimateConfig
from depthpose.pose.refine import refine_best
from depthpose.pose.surface import Surface, prepare_surface
from depthpose.pose.types import ObjectModel, PoseEstimate, ViewInput
from depthpose.pose.weights import PoseWeights, read_pose_weights


class DepthImageRegressor:
    """The baseline as an estimator. It refuses nothing but views with too little of the object.

    Args:
        weights: of kind ``depth-image``.
        config: whether ICP follows, and the device; the rest is of voting.

    Raises:
        InputError: the weights are of another kind, or ``register_refused`` is set.
    """

    def __init__(self, weights: PoseWeights, config: EstimateConfig | None = None) -> None:
        if not isinstance(weights.network, DepthImageNet):
            raise InputError(
                "these weights cast votes and regress no depth image; load them as GeoPoseNet"
            )
        self.config = EstimateConfig() if config is None else config
        if self.config.register_refused:
            raise InputError(
                "a regressed depth image refuses nothing that could be registered; omit "
                "--register-refused (register_refused=True)"
            )
        self.weights = weights
        self._network = weights.network.to(usable_device(self.config.device)).eval()
        self._numbers = {model.name: k for k, model in enumerate(weights.models)}
        self._surfaces: dict[int, Surface] = {}

    @classmethod
    @own_arithmetic()
    def load(
        cls, weights: str | Path, config: EstimateConfig | None = None
    ) -> "DepthImageRegressor":
        """Build an estimator from weights, by file or by name.

        Raises:
            InputError: no such weights, or of another kind.
        """
        found = read_pose_weights(find_weights(weights))
        warn_of_terms(found.facts)
        return cls(found, config)

    @property
    def objects(self) -> tuple[str, ...]:
        """Names of the objects that the weights know."""
        return tuple(self._numbers)

    @torch.no_grad()
    @own_arithmetic()
    def estimate_many(self, inputs: Sequence[ViewInput]) -> list[PoseEstimate]:
        """Estimate one after the other.

        Raises:
            InputError: an object that the weights do not know.
        """
        return [self._estimate(given) for given in inputs]

    def _estimate(self, given: ViewInput) -> PoseEstimate:
        if given.object not in self._numbers:
            raise InputError(
                f"object {given.object!r}: the weights do not know it; they know "
                f"{', '.join(self.objects)}"
            )
        number = self._numbers[given.object]
        model = self.weights.models[number]
        start = time.perf_counter()
        assert isinstance(self._network, DepthImageNet)
        crop = cut_depth(given, self._network.config, model.diameter_m)
        if crop is None:
            return PoseEstimate(
                name=given.name,
                object=given.object,
                status="too few points",
                reason=f"fewer than {self._network.config.min_points} masked pixels have a depth",
            )
        batch = DepthCrop(*(part[None].to(self.config.device) for part in crop))
        numbers = torch.tensor([number], device=self.config.device)
        poses = poses_of(self._network(batch.image, numbers), batch)
        pose = Rigid(poses.R[0].cpu().float(), poses.t_m[0].cpu().float())
        found = PoseEstimate(
            name=given.name,
            object=given.object,
            status="ok",
            camera_from_model=pose,
            seconds={"network": time.perf_counter() - start},
        )
        return self._refined(found, given, model, number) if self.config.with_icp else found

    def _refined(
        self, found: PoseEstimate, given: ViewInput, model: ObjectModel, number: int
    ) -> PoseEstimate:
        start = time.perf_counter()
        if number not in self._surfaces:
            self._surfaces[number] = prepare_surface(model, self.config.icp.surface_points)
        points_m = cloud_from_depth(
            given.depth_m, given.mask, given.K, model.diameter_m, self.weights.cloud
        ).float()
        if (few := refusal_of(points_m, self.weights.cloud)) is not None:
            return replace(found, status="too few points", reason=few, camera_from_model=None)
        assert found.camera_from_model is not None
        refined = refine_best(
            points_m, found.camera_from_model, self._surfaces[number], self.config.icp
        ).refined
        found = replace(found, seconds={**found.seconds, "icp": time.perf_counter() - start})
        if float(refined.inlier_share) == 0:  # nothing near the surface: ICP had no say
            return found
        return replace(
            found,
            camera_from_model=refined.camera_from_model,
            covariance=refined.covariance,
            residual_m=float(refined.residual_m),
        )
