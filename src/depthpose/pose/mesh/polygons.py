"""Polygons to triangles: convex ones as a fan, concave ones by ear clipping (Meisters 1975)."""

import numpy as np

from depthpose.core.errors import InputError
from depthpose.core.files import AnyPath

_MOST_CORNERS = 5_000
"""Of one polygon: clipping takes time by the square of them, here a second."""
_FLAT = 1e-9
"""Of the square of a polygon's area: a corner that turns back by less is straight."""
_OVERLAP = 1e-3
"""Of all area: polygons that cross themselves may lay so much of it twice."""


def cut_polygons(
    path: AnyPath, vertices: np.ndarray, sizes: np.ndarray, corners: np.ndarray
) -> np.ndarray:
    """Cut simple polygons without holes into triangles of the same corners, in their order.

    A polygon that is not planar is cut as it looks along the normal of its area (Newell's); one
    of fewer than three corners is none.

    Args:
        path: of the file, for errors.
        vertices: (n, 3).
        sizes: how many corners each polygon has.
        corners: of all polygons, one after the other: rows of ``vertices``.

    Returns:
        Triangles (t, 3).

    Raises:
        InputError: a corner is none of the vertices, a polygon has more corners than are cut, or
            polygons cross themselves.
    """
    starts = np.cumsum(sizes) - sizes
    wrong = (corners < 0) | (corners >= len(vertices))
    if wrong.any():
        at = int(wrong.argmax())
        face = int(np.searchsorted(starts, at, "right")) - 1
        raise InputError(
            f"{path}: face {face} names point {corners[at]}, but the {len(vertices)} points are "
            f"numbered 0 .. {len(vertices) - 1}; the file is damaged. Export it again."
        )
    if sizes.max(initial=0) > _MOST_CORNERS:
        raise InputError(
            f"{path}: face {sizes.argmax()} has {sizes.max()} corners, more than {_MOST_CORNERS}; "
            "export it as triangles"
        )
    found, owners = [np.empty((0, 3), np.int64)], [np.empty(0, np.int64)]
    overlap, area = np.zeros(len(sizes)), 0.0
    for size in np.unique(sizes[sizes > 2]):
        which = np.flatnonzero(sizes == size)
        polygons = corners[starts[which, None] + np.arange(size)]
        normals, local = _cut(vertices[polygons])
        triangles = np.take_along_axis(polygons[:, None], local, 2)
        found.append(triangles.reshape(-1, 3))
        owners.append(which.repeat(size - 2))
        if size > 3:
            sides = vertices[triangles[..., 1:]] - vertices[triangles[..., :1]]
            doubled = np.cross(sides[..., 0, :], sides[..., 1, :])
            length = np.linalg.norm(normals, axis=-1)
            along = np.abs(np.einsum("mtc,mc->mt", doubled, normals)).sum(-1)
            each = np.linalg.norm(doubled, axis=-1).sum(-1)
            seen = np.divide(along, length, where=length > _FLAT * each, out=each.copy())
            overlap[which] = seen - length
            area += float(each.sum())
    if overlap.sum() > _OVERLAP * area:
        raise InputError(
            f"{path}: face {overlap.argmax()} crosses itself (its corners are not in the order of "
            "its border), so its surface is unknown; export it as triangles"
        )
    return np.concatenate(found)[np.argsort(np.concatenate(owners), kind="stable")]


def _cut(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cut polygons (m, n, 3) of equally many corners; normals (m, 3), corners (m, n - 2, 3)."""
    count = points.shape[1]
    points = points - points[:, :1]
    after, before = np.roll(points, -1, 1), np.roll(points, 1, 1)
    normals = np.cross(points, after).sum(1)
    turns = np.einsum("mnc,mc->mn", np.cross(points - before, after - points), normals)
    is_back = turns < -_FLAT * (normals**2).sum(-1, keepdims=True)
    # Of four corners one turns back at most, and a fan from there is right.
    first = np.where(is_back.any(1), turns.argmin(1), 0)
    steps = np.arange(count - 2)
    fan = np.stack([0 * steps, steps + 1, steps + 2], -1)
    local = (first[:, None, None] + fan) % count
    for k in np.flatnonzero(is_back.any(1)) if count > 4 else ():
        local[k] = _clip_ears(_seen_along(points[k], normals[k]))
    return normals, local


def _seen_along(points: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Project points (n, 3) along a normal, which then points at the viewer: (n, 2)."""
    across = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    basis = np.stack([across, np.cross(normal, across)], -1)
    return points @ (basis / np.linalg.norm(basis, axis=0).clip(1e-300))


def _clip_ears(points: np.ndarray) -> list[tuple[int, int, int]]:
    """Cut off a corner whose triangle holds no other, again and again; points (n, 2), in order.

    Where there is none (the polygon crosses itself), the next corner is taken.
    """
    left, ears, places = list(range(len(points))), [], points.tolist()
    least = _FLAT * float(np.ptp(points, axis=0).max()) ** 2
    is_back = np.array([_turn(places, k - 1, k, (k + 1) % len(left)) < 0 for k in left])
    at = tried = 0
    while len(left) > 3:
        at %= len(left)
        a, b, c = left[at - 1], left[at], left[(at + 1) % len(left)]
        turn = _turn(places, a, b, c)
        ear = [places[a], places[b], places[c]]
        is_ear = abs(turn) <= least or (turn > 0 and not _holds(points, is_back, ear))
        if not is_ear and tried < len(left):
            at, tried = at + 1, tried + 1
            continue
        ears.append((a, b, c))
        del left[at]
        is_back[b] = False
        for k in (at - 1, at):
            middle = k % len(left)
            around = (left[middle - 1], left[middle], left[(middle + 1) % len(left)])
            is_back[left[middle]] = _turn(places, *around) < 0
        # The corner before is skipped: a fan of needles is cut where it can be avoided.
        at, tried = at + 1, 0
    return [*ears, (left[0], left[1], left[2])]


def _turn(places: list[list[float]], a: int, b: int, c: int) -> float:
    """Twice the area of a triangle, positive where it turns left."""
    (ax, ay), (bx, by), (cx, cy) = places[a], places[b], places[c]
    return (bx - ax) * (cy - by) - (by - ay) * (cx - bx)


def _holds(points: np.ndarray, is_back: np.ndarray, ear: list[list[float]]) -> bool:
    """Whether a corner that turns back lies in or on a triangle, and not at one of its own."""
    x, y = points[is_back].T
    is_inside = np.ones(len(x), bool)
    for (ax, ay), (bx, by) in zip(ear, [*ear[1:], ear[0]], strict=True):
        is_inside &= (bx - ax) * (y - ay) >= (by - ay) * (x - ax)
        is_inside &= (x != ax) | (y != ay)
    return bool(is_inside.any())
