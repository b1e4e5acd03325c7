"""GeoPoseNet: clouds and depth images of known objects to poses.

Several clouds go through the network at once.
"""

import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from depthpose.core.checkpoint import find_weights, warn_of_terms
from depthpose.core.devices import each_in_threads, own_arithmetic, usable_device
from depthpose.core.errors import InputError
from depthpose.pose.baselines import DepthImageNet
from depthpose.pose.config import EstimateConfig, RefusalConfig
from depthpose.pose.estimator.base import PoseEstimator, answered, or_unreadable, refused
from depthpose.pose.estimator.pose import Voted, pose_from_directions
from depthpose.pose.estimator.prepare import AnyInput, Prepared, Refusal, prepare_cloud
from depthpose.pose.estimator.register import Registration
from depthpose.pose.types import ObjectModel, PoseEstimate, SeenPoints, Status
from depthpose.pose.weights import DirectionNet, PoseWeights, read_pose_weights

_DOUBTED: tuple[Status, ...] = ("votes do not meet", "keypoints do not fit", "doubtful")
"""What the network could not answer, and another method may; the rest is due to the input."""


def network_directions(
    network: DirectionNet, clouds: list[Prepared], numbers: list[int], device: str
) -> list[Float[Tensor, "n k c"]]:
    """Ask the network for the directions to the keypoints, in the camera frame, cloud by cloud.

    Args:
        network: of directions, in eval mode.
        clouds: their points and voxels.
        numbers: the object's number of each.
        device: where the network is.
    """
    counts = [len(cloud.points_m) for cloud in clouds]
    cloud_of_point = torch.repeat_interleave(torch.arange(len(clouds)), torch.tensor(counts))
    grids = [cloud.voxels for cloud in clouds]
    coordinates = torch.cat([grid.coordinates for grid in grids])
    turned = (c.points_m @ c.voxels.grid_from_camera.mT for c in clouds)
    seen = SeenPoints(
        points_m=torch.cat(list(turned)),
        coordinates=torch.cat([cloud_of_point[:, None], coordinates], 1),
        features=torch.cat([grid.features for grid in grids]),
        class_of_point=torch.tensor(numbers)[cloud_of_point],
    )
    outputs = network.directions(seen.to(device)).float().cpu()
    return [
        _in_camera(some, grid.grid_from_camera)
        for some, grid in zip(outputs.split(counts), grids, strict=True)
    ]


def batches(clouds: Iterable["_Cloud"], most: int) -> Iterator[list["_Cloud"]]:
    """Group clouds so that each group has ``most`` voxels at most, or is one cloud."""
    group: list[_Cloud] = []
    total = 0
    for one in clouds:
        count = len(one.prepared.points_m) if isinstance(one.prepared, Prepared) else 0
        if group and total + count > most:
            yield group
            group, total = [], 0
        group.append(one)
        total += count
    if group:
        yield group


def _in_camera(
    outputs: Float[Tensor, "n k c"], grid_from_camera: Float[Tensor, "3 3"]
) -> Float[Tensor, "n k c"]:
    """Turn directions back from the network's grid; further components stay."""
    directions = outputs[..., :3] @ grid_from_camera
    return torch.cat([directions, outputs[..., 3:]], -1)


class GeoPoseNet(PoseEstimator):
    """The 6-DoF pose of a known object from its partial cloud, or the reason why there is none.

    Example::

        net = GeoPoseNet.load("parts")
        found = net.estimate(cloud="mug.ply", unit="mm", object="mug")
        print(found.camera_from_model if found.is_ok else found.reason)

    Args:
        weights: the network and the objects that it knows.
        config: voting, ICP, limits, device.

    Raises:
        InputError: weights that cast no votes, a device that is not there, or models without a
            surface that ``register_refused`` is to register.
    """

    name = ""
    """What the weights were called; nothing where they came from memory."""

    def __init__(self, weights: PoseWeights, config: EstimateConfig | None = None) -> None:
        super().__init__(weights.models, config)
        self.weights = weights
        if isinstance(weights.network, DepthImageNet):
            raise InputError(
                "these weights regress a depth image and cast no votes; load them as "
                "DepthImageRegressor"
            )
        self._network = weights.network.to(usable_device(self.config.device)).eval()
        self._registration = (
            Registration(weights.models, replace(self.config, register_refused=False))
            if self.config.register_refused
            else None
        )

    @classmethod
    @own_arithmetic()
    def load(
        cls, weights: str | Path = "parts", config: EstimateConfig | None = None
    ) -> "GeoPoseNet":
        """Build an estimator from weights, by file, folder, name or ``hf://OWNER/NAME``.

        Weights whose terms bind the user say so (:class:`LicenceNotice`).

        Raises:
            InputError: no such weights, or none of a pose network.
        """
        found = read_pose_weights(find_weights(weights))
        warn_of_terms(found.facts)
        net = cls(found, config)
        net.name = str(weights)
        return net

    from_pretrained = load
    """The same as :meth:`load`."""

    def __repr__(self) -> str:
        """Say it in one line: the network, its objects, weights, device."""
        said = f"{type(self._network).__name__} of {', '.join(self.objects)}"
        named = f", weights {self.name!r}" if self.name else ""
        return f"GeoPoseNet({said}{named}, {self.config.device})"

    @property
    def terms(self) -> str:
        """Terms of the weights, where they bind whoever uses them; else nothing."""
        return self.weights.facts.get("terms", "")

    @property
    def models(self) -> Sequence[ObjectModel]:
        """The objects that the weights know."""
        return self.weights.models

    @property
    def refusal(self) -> RefusalConfig:
        """When an answer is withheld."""
        return self.weights.refusal

    def _each(
        self, inputs: Iterable[AnyInput], threads: int, *, is_likely: bool = True
    ) -> Iterator[PoseEstimate]:
        """Ask the network for several clouds together, and register what it doubts.

        The answer for an input does not depend on those beside it, but for the rounding of the
        network's sums. Only what is likely is registered, where the config wants it.
        """
        for given, found, _ in self._with_votes(inputs, threads, is_likely=is_likely):
            is_doubted = is_likely and found.status in _DOUBTED
            yield self._registered(given, found) if self._registration and is_doubted else found

    def _registered(self, given: AnyInput, doubted: PoseEstimate) -> PoseEstimate:
        """Answer by the model alone, else as the network did."""
        assert self._registration is not None
        start = time.perf_counter()
        (found,) = self._registration.estimate_many([given])
        spent_s = time.perf_counter() - start
        best = found if found.is_posed else doubted
        return replace(best, seconds={**doubted.seconds, "registration": spent_s})

    @torch.no_grad()
    @own_arithmetic()
    def estimate_with_votes(self, given: AnyInput) -> tuple[PoseEstimate, Voted | None]:
        """Estimate one pose, and give what the network said of each keypoint at each point.

        What the network doubts is not registered here.

        Returns:
            The estimate, and the cloud with the outputs in the camera frame; None for them where
            the network was not run, as there is too little to pose.

        Raises:
            InputError: an unknown object, or a mask that does not fit its depth image.
        """
        ((_, found, voted),) = self._with_votes([given], 1)
        return answered(found), voted

    def _with_votes(
        self, inputs: Iterable[AnyInput], threads: int, *, is_likely: bool = True
    ) -> Iterator[tuple[AnyInput, PoseEstimate, Voted | None]]:
        prepared = each_in_threads(self._prepare, inputs, threads)
        work = partial(self._pose, is_likely=is_likely)
        for some in batches(prepared, self.config.batch_voxels):
            yield from each_in_threads(work, self._ask(some), threads)

    def _prepare(self, given: AnyInput) -> "_Cloud":
        def prepare(given: AnyInput) -> Prepared | Refusal:
            model = self.weights.models[self._number(given.object)]
            return prepare_cloud(given, model, self.weights.cloud, self.config)

        start = time.perf_counter()
        prepared = or_unreadable(prepare, given)
        seconds = {"cloud": time.perf_counter() - start}
        if isinstance(prepared, Refusal):
            prepared = refused(given, prepared, seconds)
        return _Cloud(given=given, prepared=prepared, seconds=seconds)

    def _ask(self, clouds: list["_Cloud"]) -> Iterator["_Cloud"]:
        """Ask the network for clouds together; each has a share of the time."""
        ready = [(one, one.prepared) for one in clouds if isinstance(one.prepared, Prepared)]
        numbers = [self._number(one.given.object) for one, _ in ready]
        outputs, spent_s = self._directions([p for _, p in ready], numbers) if ready else ([], 0.0)
        total, left = sum(map(len, outputs)), iter(outputs)
        for one in clouds:
            if isinstance(one.prepared, Prepared):
                own = next(left)
                seconds = {**one.seconds, "network": spent_s * len(own) / total}
                yield replace(one, outputs=own, seconds=seconds)
            else:
                yield one

    def _directions(
        self, clouds: list[Prepared], numbers: list[int]
    ) -> tuple[list[Float[Tensor, "n k c"]], float]:
        start = time.perf_counter()
        found = network_directions(self._network, clouds, numbers, self.config.device)
        return found, time.perf_counter() - start

    def _pose(
        self, one: "_Cloud", *, is_likely: bool
    ) -> tuple[AnyInput, PoseEstimate, Voted | None]:
        if isinstance(one.prepared, PoseEstimate):
            return one.given, one.prepared, None
        assert one.outputs is not None, "asked before"
        voted = Voted(one.prepared, one.outputs)

        def pose(given: AnyInput) -> PoseEstimate:
            number = self._number(given.object)
            known = (self.weights.models[number], self._surface(number), self._copies_of(number))
            return pose_from_directions(
                voted, known, self.weights.refusal, self.config, is_likely=is_likely
            )

        found = or_unreadable(pose, one.given)
        seconds = {**one.seconds, **found.seconds}
        return one.given, replace(found, name=one.given.name, seconds=seconds), voted


@dataclass(frozen=True, kw_only=True, eq=False)
class _Cloud:
    """An input on its way: a cloud, what the network says of it, the seconds; or a refusal."""

    given: AnyInput
    prepared: Prepared | PoseEstimate
    seconds: dict[str, float]
    outputs: Float[Tensor, "n k c"] | None = None
