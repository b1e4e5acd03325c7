"""A PointNet that gives directions to keypoints: the second baseline of table 3.1."""

from collections.abc import Sequence
from itertools import pairwise

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from depthpose.pose.baselines.config import PointNetConfig
from depthpose.pose.sparse import RowNorm
from depthpose.pose.types import SeenPoints

_TRANSFORM_POOLED, _TRANSFORM_HEAD = (64, 128, 1024), (512, 256)


class PointNet(nn.Module):
    """Points to raw directions, each from itself and the maximum over its cloud.

    Qi et al. (CVPR 2017), network for segmentation; clouds of any size, one after the other in
    rows. Answers in the form that the sparse network gives, so that the same voting follows.
    """

    def __init__(self, config: PointNetConfig | None = None) -> None:
        super().__init__()
        self.config = config = config or PointNetConfig()
        c = config
        self.turn_points = _Transform(3) if c.with_transforms else None
        self.local = _layers((3, *c.local))
        self.turn_features = _Transform(c.local[1]) if c.with_transforms else None
        self.pooled = _layers((c.local[1], *c.pooled))
        self.head = _layers((c.local[1] + c.pooled[2], *c.head))
        self.final = nn.Linear(c.head[2], c.outputs)

    def forward(
        self, points_m: Float[Tensor, "points 3"], cloud: Int[Tensor, " points"]
    ) -> Float[Tensor, "points classes keypoints components"]:
        """Give the raw directions of each point to the keypoints of every class.

        Args:
            points_m: about the mean of their cloud.
            cloud: which cloud each belongs to, 0, 1, ..., ascending.
        """
        c = self.config
        outputs = self.final(self.features(points_m, cloud))
        return outputs.view(len(outputs), c.classes, c.keypoints, c.components)

    def directions(self, seen: SeenPoints) -> Float[Tensor, "points keypoints components"]:
        """Answer for each point's own class: what every network that votes offers."""
        points_m, cloud = seen.points_m, seen.coordinates[:, 0].long()
        sizes = torch.bincount(cloud)
        sums_m = points_m.new_zeros(len(sizes), 3).index_add(0, cloud, points_m)
        local_m = points_m - (sums_m / sizes[:, None])[cloud]
        rows = torch.arange(len(points_m), device=points_m.device)
        return self(local_m, cloud)[rows, seen.class_of_point]

    def features(
        self, points_m: Float[Tensor, "points 3"], cloud: Int[Tensor, " points"]
    ) -> Float[Tensor, "points width"]:
        """Give what the last layer sees of each point."""
        x = points_m / self.config.unit_m
        count = int(cloud.max()) + 1
        if self.turn_points is not None:
            x = _turned(x, self.turn_points(x, cloud, count), cloud)
        x = self.local(x)
        if self.turn_features is not None:
            x = _turned(x, self.turn_features(x, cloud, count), cloud)
        whole = _largest(self.pooled(x), cloud, count)
        return self.head(torch.cat([x, whole[cloud]], 1))


class _Transform(nn.Module):
    """T-Net: a matrix for each cloud, which begins as the identity."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.width = width
        self.pooled = _layers((width, *_TRANSFORM_POOLED))
        self.head = _layers((_TRANSFORM_POOLED[-1], *_TRANSFORM_HEAD))
        self.final = nn.Linear(_TRANSFORM_HEAD[-1], width * width)
        nn.init.zeros_(self.final.weight)
        nn.init.zeros_(self.final.bias)

    def forward(
        self, x: Float[Tensor, "points c"], cloud: Int[Tensor, " points"], count: int
    ) -> Float[Tensor, "clouds c c"]:
        matrix = self.final(self.head(_largest(self.pooled(x), cloud, count)))
        eye = torch.eye(self.width, device=x.device, dtype=x.dtype)
        return matrix.view(count, self.width, self.width) + eye


def _layers(widths: Sequence[int]) -> nn.Sequential:
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(widths):
        layers += [nn.Linear(inputs, outputs, bias=False), RowNorm(outputs), nn.ReLU()]
    return nn.Sequential(*layers)


def _turned(x: Tensor, turn: Tensor, cloud: Tensor) -> Float[Tensor, "points c"]:
    """Multiply the rows of each cloud by its matrix."""
    sizes = torch.bincount(cloud, minlength=len(turn)).tolist()
    return torch.cat([part @ T for part, T in zip(x.split(sizes), turn, strict=True)])


def _largest(x: Tensor, cloud: Tensor, count: int) -> Float[Tensor, "clouds c"]:
    """Maximum over the points of each cloud."""
    sizes = torch.bincount(cloud, minlength=count).tolist()
    return torch.stack([part.amax(0) for part in x.split(sizes)])
