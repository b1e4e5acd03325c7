"""The free test: found keypoints must have the distances that the model's have."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def distance_errors(
    keypoints_m: Float[Tensor, "*batch k 3"], model_keypoints_m: Float[Tensor, "k 3"]
) -> Float[Tensor, "*batch k k"]:
    """Found minus known distance of each pair of keypoints [m]: 28 pairs of 8, each twice."""
    return _distances(keypoints_m) - _distances(model_keypoints_m.to(keypoints_m))


def consistent_keypoints(
    keypoints_m: Float[Tensor, "*batch k 3"],
    model_keypoints_m: Float[Tensor, "k 3"],
    tolerance_m: float,
    is_found: Bool[Tensor, "*batch k"] | None = None,
) -> Bool[Tensor, "*batch k"]:
    """Outvote keypoints until no pair of those that stay breaks its distance.

    In each round the keypoint in most broken pairs goes; of equals the one with the larger sum of
    errors. Two keypoints that are wrong together by a common motion cannot be told from right ones
    by this test, except where they are in the minority.

    Args:
        keypoints_m: found.
        model_keypoints_m: known, in any frame: distances alone count.
        tolerance_m: by how much a distance may differ.
        is_found: those to begin with; None: all.

    Returns:
        Those that stay; three or more of them fix a pose.
    """
    errors_m = distance_errors(keypoints_m, model_keypoints_m).abs()
    count = keypoints_m.shape[-2]
    stays = torch.ones(keypoints_m.shape[:-1], dtype=torch.bool, device=keypoints_m.device)
    stays = stays if is_found is None else is_found.clone()
    # Errors beyond the limit decide ties: capped, so that they never weigh as much as a pair.
    severity = (errors_m / tolerance_m).clamp(max=100.0) / (200.0 * count)
    for _ in range(count):
        pairs = stays[..., :, None] & stays[..., None, :]
        broken = pairs & (errors_m > tolerance_m)
        blame = (broken * (1 + severity)).sum(-1)
        worst = torch.nn.functional.one_hot(blame.argmax(-1), count).bool()
        stays = stays & ~(worst & broken.any((-1, -2))[..., None])
    return stays


def _distances(points_m: Float[Tensor, "*batch k 3"]) -> Float[Tensor, "*batch k k"]:
    return (points_m[..., :, None, :] - points_m[..., None, :, :]).norm(dim=-1)
