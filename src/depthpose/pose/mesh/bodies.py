"""The part in a CAD file, and small bodies far from it that the file holds too."""

import warnings
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from depthpose.core.errors import InputError, Notice
from depthpose.core.files import AnyPath

_SMALL_BODY_GAP = 0.25  # diagonals of the part's box: a small body farther away is not of the part
_BODY_GAP = 1.0  # the same for a body of any other size
_SMALL_SHARE = 0.05  # of the part's area: a body of less is small
_MOST_NAMED = 3  # bodies in a message


@dataclass(frozen=True, kw_only=True, eq=False)
class _Bodies:
    """The connected bodies of a mesh (b of them): the box about each, and its area."""

    of_face: np.ndarray  #: index of the body of each face (m,)
    low: np.ndarray  #: least x, y and z of each body (b, 3)
    high: np.ndarray  #: largest x, y and z (b, 3)
    area: np.ndarray  #: (b,)

    def diagonal_of(self, is_chosen: np.ndarray) -> float:
        """Measure the diagonal of the box about some of the bodies."""
        size = self.high[is_chosen].max(0) - self.low[is_chosen].min(0)
        return float(np.linalg.norm(size))


def mark_part(
    path: AnyPath, vertices: np.ndarray, faces: np.ndarray, area: np.ndarray
) -> np.ndarray:
    """Mark the faces of a file's part: all but those of small bodies that lie far from the rest.

    A sketch point or a screw beside the origin would set the diameter of the part and attract
    keypoints: it is left out, and a notice names it.

    Args:
        path: of the file, for messages.
        vertices: (n, 3), no two at one place.
        faces: (m, 3), indices of their corners.
        area: of each face (m,).

    Returns:
        Whether each face is of the part (m,).

    Raises:
        InputError: a body far from the part is too large to be left out.
    """
    bodies = _split_bodies(vertices, faces, area)
    is_part = _mark_part_bodies(bodies)
    if is_part.all():
        return np.ones(len(faces), bool)

    # The other bodies are left out where they are small together; else the file is refused.
    listing = _list_bodies(bodies, np.flatnonzero(~is_part))
    diagonal = bodies.diagonal_of(is_part)
    if bodies.area[~is_part].sum() >= _SMALL_SHARE * bodies.area[is_part].sum():
        raise InputError(
            f"{path}: holds bodies that lie farther from each other than they are long (a part of "
            f"{diagonal:.4g}; {listing}), and it cannot be known which of them is the "
            "object; export that one alone"
        )
    count = int((~is_part).sum())
    warnings.warn(
        f"{path}: left out {count} small {'body' if count == 1 else 'bodies'} far from the part of "
        f"{diagonal:.4g} ({listing}, in the file's unit); export the part alone",
        Notice,
        stacklevel=3,
    )
    return is_part[bodies.of_face]


def _split_bodies(vertices: np.ndarray, faces: np.ndarray, area: np.ndarray) -> _Bodies:
    """Split a mesh into its connected components; arguments as of :func:`mark_part`."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]])
    graph = coo_array((np.ones(len(edges), bool), edges.T), shape=(len(vertices),) * 2)
    _, component_of_vertex = connected_components(graph, directed=False)
    # Vertices of no face are components too: bodies are numbered without these.
    component_of_face = component_of_vertex[faces[:, 0]]
    _, of_face = np.unique(component_of_face, return_inverse=True)

    count = int(of_face.max()) + 1
    low = np.full((count, 3), np.inf)
    high = np.full((count, 3), -np.inf)
    corners = vertices[faces]
    np.minimum.at(low, of_face, corners.min(1))
    np.maximum.at(high, of_face, corners.max(1))
    return _Bodies(of_face=of_face, low=low, high=high, area=np.bincount(of_face, area, count))


def _mark_part_bodies(bodies: _Bodies) -> np.ndarray:
    """Mark the bodies of the part (b,): the largest, those near it, those near these, and so on."""
    is_part = np.zeros(len(bodies.area), bool)
    is_part[bodies.area.argmax()] = True
    while True:
        # The gap between the box about the part so far and the box of each body.
        above = bodies.low - bodies.high[is_part].max(0)
        below = bodies.low[is_part].min(0) - bodies.high
        gap_along_axes = np.maximum(0, np.maximum(above, below))
        gap = np.linalg.norm(gap_along_axes, axis=1)

        # A small body must be nearer than a large one.
        is_small = bodies.area < _SMALL_SHARE * bodies.area[is_part].sum()
        limit = bodies.diagonal_of(is_part) * np.where(is_small, _SMALL_BODY_GAP, _BODY_GAP)
        is_near = gap <= limit
        if not (is_near & ~is_part).any():
            return is_part
        is_part |= is_near


def _list_bodies(bodies: _Bodies, indices: np.ndarray) -> str:
    """Describe size and place of three bodies at most for a message, and count the others."""
    descriptions: list[str] = []
    for k in indices[:_MOST_NAMED]:
        extent = np.linalg.norm(bodies.high[k] - bodies.low[k])
        place = ", ".join(f"{coordinate:.4g}" for coordinate in bodies.low[k])
        descriptions.append(f"one of {extent:.3g} at ({place})")
    more = len(indices) - _MOST_NAMED
    return ", ".join(descriptions) + (f" and {more} more" if more > 0 else "")
