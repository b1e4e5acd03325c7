"""How far a moved surface lies off itself, and the motion that fits it best."""

from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float, Float64
from scipy.spatial import KDTree
from torch import Tensor

from depthpose.core.arrays import take_evenly
from depthpose.core.rigid import Rigid, fit_rigid
from depthpose.pose.mesh.models import sample_surface
from depthpose.pose.types import ObjectModel

EXACT_SHARE = 0.999
"""Share of the surface within ``EXACT_DEVIATION``: a key or a notch is a few percent of it, a hole
in a long profile two thousandths."""
_USUAL_SHARE = 0.98  # of the points: the farthest of a scan are stray
_SAMPLES = 20_000  # of the surface: spaced by about a hundredth of the diameter
_NEAREST_SAMPLES = 4  # of the surface, that are compared with a point in an exact measure
_ICP_STEPS = 20
_ICP_SHARE = 0.9  # points that count in each step of ICP


class SurfaceDeviation:
    """Measures how far a moved surface lies off itself, in diameters.

    Args:
        model: the object, a mesh or points with normals.
    """

    def __init__(self, model: ObjectModel) -> None:
        samples_m, normals = sample_surface(model, _SAMPLES)
        self.centre_m = samples_m.double().mean(0)  #: of the surface, about which it is rotated
        #: samples of the surface about the centre, in diameters.
        self.points = (samples_m.double() - self.centre_m) / model.diameter_m
        #: middle of the box about them.
        self.middle = (self.points.amin(0) + self.points.amax(0)) / 2
        #: principal axes, one a row.
        self.axes = torch.linalg.eigh(self.points.T @ self.points).eigenvectors.T
        self.compared_points = take_evenly(self.points, 1000)  #: some of them, which are moved
        self._few_points = take_evenly(self.points, 100)  # to measure thousands of rotations
        self._dense_points = take_evenly(self.points, 10_000)  # for exact measures
        self._normals = normals.double().numpy()
        self._tree = KDTree(self.points.numpy())
        # Typical spacing of samples: the median distance to the fourth neighbour.
        neighbours, _ = self._tree.query(self.compared_points.numpy(), k=5)
        self._spacing = float(np.median(neighbours[:, 4]))
        self._rough_tree = KDTree(take_evenly(self.points, 2500).numpy())  # a fast, coarse one

    def find_nearest(self, moved: Float[Tensor, "*batch m 3"]) -> tuple[np.ndarray, np.ndarray]:
        """Find the sample nearest to each point: its distance [diameters] and its index."""
        distance, index = self._tree.query(moved.numpy(), workers=torch.get_num_threads())
        return np.asarray(distance), np.asarray(index)

    def rough_distance(self, R: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch"]:
        """Measure the mean distance of few rotated points to the surface, for many rotations."""
        rotated = (self._few_points @ R.mT).numpy()
        distance, _ = self._rough_tree.query(rotated, workers=torch.get_num_threads())
        return torch.from_numpy(np.asarray(distance)).mean(-1)

    def deviation(
        self,
        R: Float[Tensor, "*batch 3 3"],
        shift: Float[Tensor, "*batch 3"] | None = None,
        share: float = _USUAL_SHARE,
    ) -> Float[Tensor, "*batch"]:
        """Measure how far the surface lies off itself after a rotation and a shift.

        It is the distance within which a share of the points lies, and the larger one of two ways:
        from the moved surface to the other and back.

        Args:
            R: rotation about the centre.
            shift: in diameters; None: none.
            share: of the points; from ``EXACT_SHARE`` on more points and samples are compared.
        """
        forward = Rigid(R, torch.zeros_like(R[..., 0]) if shift is None else shift)
        forward_deviation = self.deviation_one_way(forward, share)
        backward_deviation = self.deviation_one_way(forward.inverse(), share)
        return torch.maximum(forward_deviation, backward_deviation)

    def deviation_one_way(
        self, motion: Rigid, share: float = _USUAL_SHARE
    ) -> Float[Tensor, "*batch"]:
        """Measure how far the moved surface lies off the surface, as :meth:`deviation` does.

        It is a lower bound of that, in half of the time.
        """
        # The nearest samples of each moved point; in an exact measure several.
        is_exact = share >= EXACT_SHARE
        points = self._dense_points if is_exact else self.compared_points
        count = _NEAREST_SAMPLES if is_exact else 1
        moved = motion.apply(points).numpy()
        distance, index = self._tree.query(moved, k=count, workers=torch.get_num_threads())
        distance = np.reshape(distance, (*moved.shape[:-1], count))
        index = np.reshape(index, distance.shape)

        # Between samples the distance is that to the tangent plane, beside an edge that to the
        # sample. The least of several samples counts, since the nearest one may lie on the other
        # side of an edge.
        gap = moved[..., None, :] - self.points.numpy()[index]
        height = np.abs((gap * self._normals[index]).sum(-1))
        beside = np.maximum(distance - self._spacing, 0)
        distance_to_surface = np.maximum(height, beside).min(-1)
        return torch.from_numpy(distance_to_surface).quantile(share, dim=-1)


@lru_cache(maxsize=4)
def sample_deviation(model: ObjectModel) -> SurfaceDeviation:
    """Sample the surface of a model for measures of deviation, once for its several searches."""
    return SurfaceDeviation(model)


def refine_motion(surface: SurfaceDeviation, points: Float64[Tensor, "n 3"], start: Rigid) -> Rigid:
    """Refine a motion that carries points nearly onto a surface, by ICP.

    Args:
        surface: about its centre, in units of the object's diameter.
        points: samples of the surface, or of its mirror image, in the same frame and unit.
        start: the motion to begin with.
    """
    motion = start
    for _ in range(_ICP_STEPS):
        distance, index = surface.find_nearest(motion.apply(points))
        is_near = torch.from_numpy(distance <= np.quantile(distance, _ICP_SHARE)).double()
        motion = fit_rigid(points, surface.points[torch.from_numpy(index)], is_near)
    return motion
