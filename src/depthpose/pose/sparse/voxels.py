"""Features on voxels: what sparse layers take and give."""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float, Int, Int64
from torch import Tensor

from depthpose.core.errors import InputError
from depthpose.pose.sparse.cache import CoordinateCache
from depthpose.pose.sparse.keys import Keys, pack, unpack

Duplicates = Literal["refuse", "mean"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Voxels:
    """Features of the voxels of one level, of one or several clouds.

    Rows stand in the order of the level's sorted keys, so the order in which points were given
    changes no bit of any result; :meth:`at_points` answers in the order given.

    Attributes:
        features: one row a voxel.
        cache: coordinates of all levels, and the kernel maps among them.
        level: coordinates here are multiples of ``2**level``.
        row_of_point: row at level 0 of each point given.
    """

    features: Float[Tensor, "n c"]
    cache: CoordinateCache
    level: int = 0
    row_of_point: Int64[Tensor, " points"]

    @classmethod
    def from_points(
        cls,
        coordinates: Int[Tensor, "points 4"],
        features: Float[Tensor, "points c"] | None = None,
        *,
        duplicates: Duplicates = "refuse",
    ) -> "Voxels":
        """Make voxels from rows of (cloud, x, y, z).

        Args:
            coordinates: integers; clouds are numbered from 0, x, y, z may be negative.
            features: of each point; None: the number 1.
            duplicates: what becomes of points in one voxel: an error, or the mean of their
                features (each point then gets its voxel's answer).

        Raises:
            InputError: coordinates out of range, or duplicates that are not wanted.
        """
        if features is None:
            features = torch.ones(len(coordinates), 1, device=coordinates.device)
        given = pack(coordinates)
        keys, row_of_point, counts = torch.unique(given, return_inverse=True, return_counts=True)
        if duplicates == "refuse":
            _refuse_duplicates(keys, counts)
            features = features[torch.argsort(given)]
        else:
            features = _means(features, row_of_point, counts)
        return cls(features=features, cache=CoordinateCache(keys), row_of_point=row_of_point)

    @property
    def coordinates(self) -> Int64[Tensor, "n 4"]:
        """(cloud, x, y, z) of each row, in voxels of level 0."""
        return self.cache.coordinates(self.level)

    def with_features(self, features: Float[Tensor, "m c2"], level: int | None = None) -> "Voxels":
        """Give other features of the same level, or of another one of the same voxels."""
        level = self.level if level is None else level
        assert len(features) == len(self.cache.keys(level)), "features and voxels differ in number"
        return Voxels(
            features=features, cache=self.cache, level=level, row_of_point=self.row_of_point
        )

    def at_points(self) -> Float[Tensor, "points c"]:
        """Features of the voxel of each point, in the order in which points were given."""
        assert self.level == 0, f"points lie in voxels of level 0, these are of level {self.level}"
        return self.features[self.row_of_point]


def _refuse_duplicates(keys: Keys, counts: Int64[Tensor, " n"]) -> None:
    repeated = counts > 1
    if bool(repeated.any()):
        cloud, *xyz = unpack(keys[repeated][:1])[0].tolist()
        raise InputError(
            f"{int((counts - 1).sum())} points share a voxel with another, the first at {xyz} of "
            f"cloud {cloud}; keep one point a voxel, or say duplicates='mean'."
        )


def _means(features: Tensor, rows: Tensor, counts: Tensor) -> Tensor:
    """Average the rows of each voxel, in the order given so that the sum has the same bits."""
    order = torch.argsort(rows, stable=True)
    starts = counts.cumsum(0) - counts
    sums = torch.nn.functional.embedding_bag(order, features, starts, mode="sum")
    return sums / counts[:, None].to(features.dtype)
