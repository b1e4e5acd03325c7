"""What is exported of pose weights, and the clouds that it is tested on."""

from collections.abc import Iterator
from functools import partial
from typing import Any

import torch
from torch import Tensor

from depthpose.core.config import config_to_dict
from depthpose.core.errors import InputError
from depthpose.core.export import Case, Export, Limit
from depthpose.pose.export.graph import direction_graph
from depthpose.pose.mesh.sampling import sample_surface
from depthpose.pose.network import ResUNet
from depthpose.pose.sparse import Voxels, batch_coordinates
from depthpose.pose.weights import PoseWeights

_POINTS = ((1,), (150,), (1500,), (700, 40, 1100))
"""Points of each cloud of a case, before one a voxel is kept."""


def pose_export(weights: PoseWeights, facts: dict[str, Any]) -> Export:
    """Describe what is exported of weights: the network of directions.

    Args:
        weights: of the method, not of a baseline.
        facts: what else a user of the file must know.

    Raises:
        InputError: weights of a baseline.
    """
    network = weights.network
    if not isinstance(network, ResUNet):
        raise InputError(
            f"these weights are of a baseline ({type(network).__name__}); what is exported is the "
            "sparse network: give weights of kind 'geoposenet'."
        )
    known = {
        "cloud": config_to_dict(weights.cloud),
        "objects": [model.name for model in weights.models],
        "keypoints_m": [model.keypoints_m.tolist() for model in weights.models],
    }
    return Export(
        graph=partial(direction_graph, network),
        cases=partial(_cases, weights, network),
        limits={"directions": Limit(value=1e-4)},
        facts={
            **facts, **known,
            "what": "voxels (cloud, x, y, z) and their features -> directions to keypoints",
        },
    )  # fmt: skip


def _cases(weights: PoseWeights, network: ResUNet) -> Iterator[Case]:
    for counts in _POINTS:
        coordinates = batch_coordinates(
            [_cells(weights, count, k) for k, count in enumerate(counts)]
        )
        generator = torch.Generator().manual_seed(0)
        features = torch.ones(len(coordinates), network.config.inputs)
        if network.config.inputs > 1:
            features = torch.randn(features.shape, generator=generator)
        with torch.no_grad():
            directions = network(Voxels.from_points(coordinates, features))
        yield Case(
            name=f"voxels {len(coordinates)}, clouds {len(counts)}",
            inputs={"coordinates": coordinates.numpy(), "features": features.numpy()},
            expected={"directions": directions.numpy()},
        )


def _cells(weights: PoseWeights, count: int, k: int) -> Tensor:
    """Voxels of an object's surface, in no order."""
    points_m, _ = sample_surface(weights.models[k % len(weights.models)], count)
    cells = torch.floor(points_m / weights.cloud.voxel_m).long().unique(dim=0)
    return cells[torch.randperm(len(cells), generator=torch.Generator().manual_seed(count))]
