"""Bodies of a mesh, and those that lie far from the part: what a CAD file holds beside it."""

import warnings

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from depthpose.core.errors import InputError, Notice
from depthpose.core.files import AnyPath

_FAR = 0.25  # diagonals of the box about a part: a small body farther away is not of the part
_APART = 1.0  # the same of a body of any size
_SMALL = 0.05  # of the part's area: so small a body changes the part's size and no pose
_MOST_NAMED = 3


def faces_of_part(
    path: AnyPath, vertices: np.ndarray, faces: np.ndarray, area: np.ndarray
) -> np.ndarray:
    """Mark the faces of a file's part: all but those of small bodies that lie far from the rest.

    The largest body is of the part, and so is what is near to it, and near to that. A small body
    beyond, a sketch point or a screw beside the origin, would set the diameter of the part and draw
    its keypoints: it is left out, and a notice names it.

    Args:
        path: of the file, for what is said.
        vertices: (n, 3); points at one place have one number.
        faces: (m, 3) numbers of their corners.
        area: of each face.

    Raises:
        InputError: a body far from the part is too large to be left out.
    """
    sides = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]])
    joined = coo_array((np.ones(len(sides), bool), sides.T), shape=(len(vertices),) * 2)
    _, label = connected_components(joined, directed=False)
    _, body = np.unique(label[faces[:, 0]], return_inverse=True)
    count = int(body.max()) + 1
    whole = np.ones(len(faces), bool)
    if count == 1:
        return whole

    # The box about each body, and its area.
    low = np.full((count, 3), np.inf)
    high = np.full((count, 3), -np.inf)
    corners = vertices[faces]
    np.minimum.at(low, body, corners.min(1))
    np.maximum.at(high, body, corners.max(1))
    size = np.bincount(body, area, count)

    # From the largest body on, what is near joins the part until nothing more does.
    is_part = np.zeros(count, bool)
    is_part[size.argmax()] = True
    while True:
        part_low = low[is_part].min(0)
        part_high = high[is_part].max(0)
        diagonal = float(np.linalg.norm(part_high - part_low))
        gap = np.linalg.norm(np.maximum(0, np.maximum(low - part_high, part_low - high)), axis=1)
        is_small = size < _SMALL * size[is_part].sum()
        is_near = gap <= diagonal * np.where(is_small, _FAR, _APART)
        if not (is_near & ~is_part).any():
            break
        is_part |= is_near
    if is_part.all():
        return whole

    left_out = np.flatnonzero(~is_part)
    extent = np.linalg.norm(high - low, axis=1)
    listing = ", ".join(
        f"one of {extent[k]:.3g} at ({', '.join(f'{value:.4g}' for value in low[k])})"
        for k in left_out[:_MOST_NAMED]
    )
    more = f" and {len(left_out) - _MOST_NAMED} more" if len(left_out) > _MOST_NAMED else ""
    if size[left_out].sum() >= _SMALL * size[is_part].sum():
        raise InputError(
            f"{path}: holds bodies that lie farther from each other than they are long (a part of "
            f"{diagonal:.4g}; {listing}{more}), and it cannot be known which of them is the "
            "object; export that one alone"
        )
    bodies = f"{len(left_out)} small {'body' if len(left_out) == 1 else 'bodies'}"
    warnings.warn(
        f"{path}: left out {bodies} far from the part of {diagonal:.4g} ({listing}{more}, in the "
        "file's unit); export the part alone",
        Notice,
        stacklevel=3,
    )
    return is_part[body]
