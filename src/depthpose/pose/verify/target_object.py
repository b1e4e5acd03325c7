"""An object that is posed, with all that is computed of its model, once for many inputs."""

from dataclasses import dataclass
from functools import cached_property

from depthpose.core.errors import InputError
from depthpose.pose.geometry.surface import Surface, prepare_surface
from depthpose.pose.propose.point_pairs import PairTable, prepare_pairs
from depthpose.pose.types import ObjectModel
from depthpose.pose.verify.copies import SymmetricCopies, find_copies

_LEAST_POINTS = 500  # a model without faces and with fewer points has no surface


@dataclass(kw_only=True, eq=False)
class TargetObject:
    """An object that is posed; each part of what its model gives is computed at its first use."""

    number: int  #: among the models of an estimator
    model: ObjectModel  #: the object
    surface_points: int = 10_000  #: samples of its surface
    deviation_m: float | None = None  #: of the real surface, as :func:`prepare_surface` takes it

    def prepare(self, *, is_searched: bool = False) -> "TargetObject":
        """Compute all parts now, in some seconds, so that the time of no input includes it.

        ``is_searched``: also what only a search in an image needs.
        """
        _ = self.surface.sample_tree
        _ = self.copies
        if has_surface(self.model):
            _ = self.pairs
            if is_searched:
                _ = self.surface.views
        return self

    @cached_property
    def surface(self) -> Surface:
        """The surface of the model."""
        return prepare_surface(self.model, self.surface_points, self.deviation_m)

    @cached_property
    def copies(self) -> SymmetricCopies:
        """Motions after which the object looks alike, or nearly."""
        return find_copies(self.model)

    @cached_property
    def pairs(self) -> PairTable:
        """Pairs of surface points, which vote for poses of the object.

        Raises:
            InputError: the model has no surface.
        """
        require_surface(self.model)
        return prepare_pairs(self.surface)


def has_surface(model: ObjectModel) -> bool:
    """Whether a model has faces, or points enough to be a surface."""
    return len(model.faces) > 0 or len(model.vertices_m) >= _LEAST_POINTS


def require_surface(model: ObjectModel) -> None:
    """Raise an :class:`InputError` if a model is fewer than 500 points without faces."""
    if not has_surface(model):
        raise InputError(
            f"{model.name}: {len(model.vertices_m)} points without faces are no surface; export "
            f"the part as a mesh with triangles, such as STL, or give {_LEAST_POINTS} points"
        )
