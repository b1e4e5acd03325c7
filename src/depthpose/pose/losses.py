"""Losses of the pose networks."""

from collections.abc import Callable

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from depthpose.core.errors import refuse_unknown
from depthpose.core.rigid import Rigid

Directions = Float[Tensor, "points keypoints 3"]


POINT_LOSSES: dict[str, Callable[[Directions, Directions], Float[Tensor, " points"]]] = {
    "mse": lambda predicted, truth: (predicted - truth).square().mean((-2, -1)),
    "cosine": lambda predicted, truth: (1 - F.cosine_similarity(predicted, truth, dim=-1)).mean(-1),
    "l1": lambda predicted, truth: (predicted - truth).abs().mean((-2, -1)),
}
"""Losses of the raw directions of each point, averaged over keypoints; a training config's ``loss``
names one, and a new one is one more entry. ``mse`` and ``l1`` pull to unit length too; ``cosine``
leaves the length alone."""


def direction_loss(
    predicted: Directions,
    points_m: Float[Tensor, "points 3"],
    copies_m: Float[Tensor, "instances copies keypoints 3"],
    instance: Int[Tensor, " points"],
    mode: str = "mse",
) -> Float[Tensor, ""]:
    """Average over instances the least loss that any symmetric copy of the truth gives.

    It is the same whichever of the symmetric truths comes first. The copy is chosen once for a
    whole instance: a choice point by point, or an average of copies, would teach votes that meet at
    the axis of symmetry.

    Args:
        predicted: raw outputs of each point's own class.
        points_m: where each point lies, in the frame of the keypoints.
        copies_m: keypoints of each instance under each of its object's symmetries; objects with
            fewer than others repeat a copy.
        instance: which instance each point belongs to.
        mode: a key of ``POINT_LOSSES``.

    Raises:
        InputError: there is no such loss.
    """
    refuse_unknown("loss", mode, POINT_LOSSES)
    if not len(predicted):
        return predicted.sum()
    points = torch.bincount(instance, minlength=len(copies_m))

    def average_losses(
        truth_m: Float[Tensor, "instances keypoints 3"],
    ) -> Float[Tensor, " instances"]:
        """Average the losses of each instance's points for given true keypoints."""
        # A direction is 0 where a point lies on its keypoint.
        truth = F.normalize(truth_m[instance] - points_m[:, None], dim=-1, eps=1e-9)
        losses = POINT_LOSSES[mode](predicted, truth)
        sums = losses.new_zeros(len(points)).index_add(0, instance, losses)
        return sums / points.clamp(min=1).to(losses.dtype)

    with torch.no_grad():
        losses_of_copies = [average_losses(truth_m) for truth_m in copies_m.unbind(1)]
        best_copy = torch.stack(losses_of_copies).argmin(0)
    instances = torch.arange(len(copies_m), device=best_copy.device)
    means = average_losses(copies_m[instances, best_copy])
    return means.sum() / (points > 0).sum()


def model_point_loss(
    predicted: Rigid, truth: Rigid, points_m: Float[Tensor, "b n 3"], copies: Rigid
) -> Float[Tensor, " b"]:
    """Measure ADD [m] of each pose to the nearest symmetric copy of its truth.

    It is the mean distance of points of each object, differentiable in the predicted pose.

    Args:
        predicted: ``camera_from_model`` (b).
        truth: the same.
        points_m: of each object's surface.
        copies: symmetries, ``model_from_model`` (b, c), the identity among them.
    """
    predicted_m = predicted.apply(points_m)

    # T_true S p for each symmetry S: (b, c, n, 3)
    true = Rigid(truth.R[:, None].expand_as(copies.R), truth.t_m[:, None].expand_as(copies.t_m))
    repeated_m = points_m[:, None].expand(-1, copies.R.shape[1], -1, -1)
    true_m = true.apply(copies.apply(repeated_m))
    return (predicted_m[:, None] - true_m).norm(dim=-1).mean(-1).amin(-1)
