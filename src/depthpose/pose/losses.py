"""Losses of the pose networks."""

from collections.abc import Callable

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from depthpose.core.errors import refuse_unknown
from depthpose.core.rigid import Rigid

Directions = Float[Tensor, "points keypoints 3"]  #: from points to keypoints, of any length

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
    """Compute the loss of directions to the best symmetric copy of the true keypoints.

    For each instance it is the mean over its points, for the copy with the least mean. The copy is
    chosen once for a whole instance: a choice point by point, or an average of copies, would teach
    votes that meet at the axis of symmetry.

    Args:
        predicted: raw outputs of each point's own class.
        points_m: where each point lies, in the frame of the keypoints.
        copies_m: true keypoints of each instance under each of its object's symmetries; objects
            with fewer symmetries than others repeat a copy.
        instance: which instance each point belongs to.
        mode: a key of ``POINT_LOSSES``.

    Returns:
        The mean over the instances that have points; 0 without points.

    Raises:
        InputError: there is no such loss.
    """
    refuse_unknown("loss", mode, POINT_LOSSES)
    if not len(predicted):
        return predicted.sum()
    # The best copy of each instance, without gradients; then its loss, with them.
    with torch.no_grad():
        losses_of_copies = [
            _average_losses(predicted, points_m, keypoints_m, instance, mode)
            for keypoints_m in copies_m.unbind(1)
        ]
        best_copy = torch.stack(losses_of_copies).argmin(0)
    instances = torch.arange(len(copies_m), device=best_copy.device)
    best_m = copies_m[instances, best_copy]
    losses = _average_losses(predicted, points_m, best_m, instance, mode)
    has_points = torch.bincount(instance, minlength=len(copies_m)) > 0
    return losses.sum() / has_points.sum()


def _average_losses(
    predicted: Directions,
    points_m: Float[Tensor, "points 3"],
    keypoints_m: Float[Tensor, "instances keypoints 3"],
    instance: Int[Tensor, " points"],
    mode: str,
) -> Float[Tensor, " instances"]:
    """Average the losses of the points of each instance; 0 for one without points.

    Args:
        predicted: directions of each point.
        points_m: where each point lies.
        keypoints_m: true ones of each instance.
        instance: which instance each point belongs to.
        mode: a key of ``POINT_LOSSES``.
    """
    # A true direction is 0 where a point lies on its keypoint.
    true = F.normalize(keypoints_m[instance] - points_m[:, None], dim=-1, eps=1e-9)
    losses = POINT_LOSSES[mode](predicted, true)
    sums = losses.new_zeros(len(keypoints_m)).index_add(0, instance, losses)
    counts = torch.bincount(instance, minlength=len(keypoints_m))
    return sums / counts.clamp(min=1).to(losses.dtype)


def model_point_loss(
    predicted: Rigid, truth: Rigid, points_m: Float[Tensor, "b n 3"], symmetries: Rigid
) -> Float[Tensor, " b"]:
    """Compute ADD [m] of each pose to the nearest symmetric copy of its truth.

    ADD is the mean distance of the points of an object at the predicted pose from themselves at the
    true one. It is differentiable in the predicted pose.

    Args:
        predicted: ``camera_from_model`` (b).
        truth: the same.
        points_m: points of each object's surface, in its own frame.
        symmetries: ``model_from_model`` (b, c), the identity among them.
    """
    predicted_m = predicted.apply(points_m)

    # T_true S p for each symmetry S: (b, c, n, 3)
    copy_count = symmetries.R.shape[1]
    symmetric_m = symmetries.apply(points_m[:, None].expand(-1, copy_count, -1, -1))
    true_R = truth.R[:, None].expand_as(symmetries.R)
    true_t_m = truth.t_m[:, None].expand_as(symmetries.t_m)
    true_m = Rigid(true_R, true_t_m).apply(symmetric_m)
    add_m = (predicted_m[:, None] - true_m).norm(dim=-1).mean(-1)
    return add_m.amin(-1)
