"""The direction network as a task of the loop."""

from collections.abc import Iterator, Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from depthpose.core.loop import Evidence, Turn, make_adam
from depthpose.pose.losses import choose_copies, confidence_loss, direction_loss, unit_directions
from depthpose.pose.mesh import symmetry_transforms
from depthpose.pose.train.clouds import CloudBatch
from depthpose.pose.train.config import PoseTraining
from depthpose.pose.train.held_out import HeldOut
from depthpose.pose.types import ObjectModel
from depthpose.pose.weights import DirectionNet

_SYMMETRY_STEP = 0.05
"""Turns about a continuous axis are tried every 5.7 degrees; the vote's own error is larger."""


class PoseTask:
    """Directions from each point to the keypoints of its object (thesis, 3.3).

    A symmetric object's copy of the truth is chosen once for each cloud.
    """

    def __init__(
        self,
        network: DirectionNet,
        models: Sequence[ObjectModel],
        config: PoseTraining,
        held_out: HeldOut | None,
    ) -> None:
        self.config, self.held_out = config, held_out
        self.network = network.train()
        self.modules: dict[str, nn.Module] = {"network": network}
        self.optimizers = {"network": (make_adam(network.parameters(), config.adam), config.adam)}
        self._copies_m = keypoint_copies(models)

    def step(self, batch: CloudBatch) -> Iterator[Turn]:
        """One turn: all clouds at once."""
        instance = batch.instance
        outputs = self.network.directions(batch.seen).float()
        found, copies_m = outputs[..., :3], self._posed(batch)
        loss = direction_loss(found, batch.points_m, copies_m, instance, self.config.loss)
        facts: dict[str, Tensor] = {"directions": loss.detach()}
        if self.network.config.with_confidence:
            trust = self._confidence(outputs, batch, copies_m)
            loss, facts["confidence"] = loss + self.config.confidence_weight * trust, trust.detach()
        yield Turn("network", loss, facts)

    def validate(self) -> Evidence:
        """Pose held-out views with the network as it stands."""
        if self.held_out is None:
            return Evidence()
        self.network.eval()
        evidence = self.held_out.look(self.network)
        self.network.train()
        return evidence

    def _posed(self, batch: CloudBatch) -> Float[Tensor, "clouds copies keypoints 3"]:
        copies = self._copies_m.to(batch.R)[batch.class_of]
        return copies @ batch.R.mT[:, None] + batch.t_m[:, None, None]

    def _confidence(
        self, outputs: Tensor, batch: CloudBatch, copies_m: Float[Tensor, "clouds copies k 3"]
    ) -> Float[Tensor, ""]:
        found, logits, instance = outputs[..., :3], outputs[..., 3], batch.instance
        copy = choose_copies(found, batch.points_m, copies_m, instance, self.config.loss)
        truth_m = copies_m[torch.arange(len(copy), device=copy.device), copy][instance]
        return confidence_loss(logits, found, unit_directions(batch.points_m, truth_m))


def keypoint_copies(models: Sequence[ObjectModel]) -> Float[Tensor, "classes copies k 3"]:
    """Keypoints of each object under each of its symmetries; the first is repeated to the most."""
    every = []
    for model in models:
        turns = symmetry_transforms(model.symmetries, _SYMMETRY_STEP)
        keypoints = model.keypoints_m.double()
        every.append(keypoints @ turns.R.double().mT + turns.t_m.double()[:, None])
    most = max(map(len, every))
    rows = [torch.cat([c, c[:1].expand(most - len(c), -1, -1)]) for c in every]
    return torch.stack(rows).float()
