"""Several clouds through the network of directions at once."""

from collections.abc import Iterator

import torch
from jaxtyping import Float
from torch import Tensor

from depthpose.pose.estimator.prepare import Prepared
from depthpose.pose.types import SeenPoints
from depthpose.pose.weights import DirectionNet


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


def batches(
    ready: list[tuple[int, Prepared, float]], most: int
) -> Iterator[list[tuple[int, Prepared, float]]]:
    """Group clouds so that each group has ``most`` voxels at most, or is one cloud."""
    group: list[tuple[int, Prepared, float]] = []
    total = 0
    for item in ready:
        count = len(item[1].points_m)
        if group and total + count > most:
            yield group
            group, total = [], 0
        group.append(item)
        total += count
    if group:
        yield group


def _in_camera(
    outputs: Float[Tensor, "n k c"], grid_from_camera: Float[Tensor, "3 3"]
) -> Float[Tensor, "n k c"]:
    """Turn directions back from the network's grid; what stands behind them stays."""
    directions = outputs[..., :3] @ grid_from_camera
    return torch.cat([directions, outputs[..., 3:]], -1)
