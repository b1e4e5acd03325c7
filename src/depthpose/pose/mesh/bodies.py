"""The part in a CAD file, and small bodies far from it that the file holds too."""

import warnings

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from depthpose.core.errors import InputError, Notice
from depthpose.core.files import AnyPath

_SMALL_BODY_GAP = 0.25  # diagonals of the box about a part: a small body farther away is not of it
_BODY_GAP = 1.0  # the same for a body of any size
_SMALL = 0.05  # of the part's area: a smaller body far away is left out
_MOST_NAMED = 3  # bodies in a message


def mark_part(
    path: AnyPath, vertices: np.ndarray, faces: np.ndarray, area: np.ndarray
) -> np.ndarray:
    """Mark the faces of a file's part: all but those of small bodies that lie far from the rest.

    The largest body is of the part, and so are bodies near it, and bodies near those. A small body
    farther away, a sketch point or a screw beside the origin, would set the diameter of the part
    and attract keypoints: it is left out, and a notice names it.

    Args:
        path: of the file, for messages.
        vertices: (n, 3), no two at one place.
        faces: (m, 3), indices of their corners.
        area: of each face.

    Raises:
        InputError: a body far from the part is too large to be left out.
    """
    # Bodies are the connected components of the mesh.
    sides = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]])
    joined = coo_array((np.ones(len(sides), bool), sides.T), shape=(len(vertices),) * 2)
    _, label = connected_components(joined, directed=False)
    _, body = np.unique(label[faces[:, 0]], return_inverse=True)
    count = int(body.max()) + 1
    all_faces = np.ones(len(faces), bool)
    if count == 1:
        return all_faces

    # The box about each body, and its area.
    low = np.full((count, 3), np.inf)
    high = np.full((count, 3), -np.inf)
    corners = vertices[faces]
    np.minimum.at(low, body, corners.min(1))
    np.maximum.at(high, body, corners.max(1))
    size = np.bincount(body, area, count)

    # From the largest body on, near bodies join the part until none is left.
    is_part = np.zeros(count, bool)
    is_part[size.argmax()] = True
    while True:
        part_low = low[is_part].min(0)
        part_high = high[is_part].max(0)
        diagonal = float(np.linalg.norm(part_high - part_low))
        gap_along_axes = np.maximum(low - part_high, part_low - high)
        gap = np.linalg.norm(np.maximum(0, gap_along_axes), axis=1)
        is_small = size < _SMALL * size[is_part].sum()
        is_near = gap <= diagonal * np.where(is_small, _SMALL_BODY_GAP, _BODY_GAP)
        if not (is_near & ~is_part).any():
            break
        is_part |= is_near
    if is_part.all():
        return all_faces

    # The others are named: left out where they are small, else refused.
    left_out = np.flatnonzero(~is_part)
    extent = np.linalg.norm(high - low, axis=1)
    listing = ", ".join(
        f"one of {extent[k]:.3g} at ({', '.join(f'{value:.4g}' for value in low[k])})"
        for k in left_out[:_MOST_NAMED]
    )
    others = f" and {len(left_out) - _MOST_NAMED} more" if len(left_out) > _MOST_NAMED else ""
    if size[left_out].sum() >= _SMALL * size[is_part].sum():
        raise InputError(
            f"{path}: holds bodies that lie farther from each other than they are long (a part of "
            f"{diagonal:.4g}; {listing}{others}), and it cannot be known which of them is the "
            "object; export that one alone"
        )
    bodies = f"{len(left_out)} small {'body' if len(left_out) == 1 else 'bodies'}"
    warnings.warn(
        f"{path}: left out {bodies} far from the part of {diagonal:.4g} ({listing}{others}, in the "
        "file's unit); export the part alone",
        Notice,
        stacklevel=3,
    )
    return is_part[body]
