"""Polygons of model files, cut into triangles: convex ones as fans, others by ear clipping."""

from collections import OrderedDict
from collections.abc import Iterator

import numpy as np

from depthpose.core.errors import InputError
from depthpose.core.files import AnyPath

_MOST_CORNERS = 5_000  # of one polygon
_MOST_COMPARISONS = 2e8  # of corners, to clip all polygons that are not convex: some ten seconds
_CORNER_OVERHEAD = 1000.0  # of each corner, in comparisons: its step in Python takes as long
_MOST_TOGETHER = 2**20  # corners of polygons that are cut at a time, for memory
_MOST_ROUNDS = 3  # about a polygon in search of ears; one that needs more crosses itself
_FLAT = 1e-9  # of the square of a polygon's extent: an area that is smaller is none
_OVERLAP = 1e-3  # of all area: share that polygons which cross themselves may cover twice


def cut_polygons(
    path: AnyPath, vertices: np.ndarray, sizes: np.ndarray, corners: np.ndarray
) -> np.ndarray:
    """Cut simple polygons without holes into triangles, whose corners are those of the polygons.

    A polygon that is not planar is cut as it looks along its normal (Newell's).

    Args:
        path: of the file, for errors.
        vertices: points (n, 3).
        sizes: number of corners of each polygon (p,); polygons of none are left out.
        corners: indices of their points, one polygon after the other.

    Returns:
        Triangles (m, 3), as indices of points, in the order of the polygons.

    Raises:
        InputError: an index is out of range, a polygon has too many corners or crosses itself.
    """
    _refuse_corners(path, len(vertices), sizes, corners)
    starts = np.cumsum(sizes) - sizes

    # Polygons of equally many corners are cut together.
    triangles_of_groups = [np.empty((0, 3), np.int64)]
    polygon_of_triangle = [np.empty(0, np.int64)]
    overlap = np.zeros(len(sizes))  # area of each polygon that its triangles cover twice
    area = 0.0
    comparisons = 0.0
    for group in _group_by_size(sizes):
        size = int(sizes[group[0]])
        polygons = corners[starts[group, None] + np.arange(size)]
        points = vertices[polygons]
        normals, is_reflex = _find_reflex_corners(points)
        comparisons += _count_comparisons(is_reflex)
        if comparisons > _MOST_COMPARISONS:
            raise InputError(
                f"{path}: its polygons that are not convex have too many corners to be cut in some "
                f"seconds (one of {size} among them); export it as triangles"
            )

        # From places in each polygon to indices of points.
        places = _cut_equal_polygons(points, normals, is_reflex)
        triangles = np.take_along_axis(polygons[:, None], places, 2)
        triangles_of_groups.append(triangles.reshape(-1, 3))
        polygon_of_triangle.append(group.repeat(size - 2))
        if size > 3:
            areas, overlap[group] = _measure_overlap(vertices[triangles], normals)
            area += float(areas.sum())

    # The triangles of a polygon that crosses itself cover some of it twice.
    if overlap.sum() > _OVERLAP * area:
        raise InputError(
            f"{path}: face {overlap.argmax()} crosses itself (its corners are not in the order of "
            "its border), so its surface is unknown; export it as triangles"
        )
    order = np.argsort(np.concatenate(polygon_of_triangle), kind="stable")
    return np.concatenate(triangles_of_groups)[order]


def _refuse_corners(path: AnyPath, points: int, sizes: np.ndarray, corners: np.ndarray) -> None:
    """Refuse corners at points that do not exist, and polygons of too few or too many corners.

    ``points`` is the number of points; the other arguments are those of :func:`cut_polygons`.
    """
    is_outside = (corners < 0) | (corners >= points)
    if is_outside.any():
        first = int(is_outside.argmax())
        ends = np.cumsum(sizes)
        face = int(np.searchsorted(ends, first, "right"))
        raise InputError(
            f"{path}: face {face} names point {corners[first]}, but the {points} points are "
            f"numbered 0 .. {points - 1}; the file is damaged. Export it again."
        )
    is_wrong_size = ((sizes > 0) & (sizes < 3)) | (sizes > _MOST_CORNERS)
    if is_wrong_size.any():
        face = int(is_wrong_size.argmax())
        raise InputError(
            f"{path}: face {face} has {sizes[face]} corners, and 3 to "
            f"{_MOST_CORNERS} are read; the file is truncated, or export it as triangles"
        )


def _group_by_size(sizes: np.ndarray) -> Iterator[np.ndarray]:
    """Group polygons of equally many corners; yield the indices of each group.

    A large group is divided, so that none exceeds the memory.
    """
    order = np.argsort(sizes, kind="stable")
    for same_size in np.split(order, np.flatnonzero(np.diff(sizes[order])) + 1):
        size = int(sizes[same_size[0]]) if len(same_size) else 0
        if size < 3:  # polygons of no corners; those of one and two were refused
            continue
        step = max(1, _MOST_TOGETHER // size)
        for start in range(0, len(same_size), step):
            yield same_size[start : start + step]


def _find_reflex_corners(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find which corners of polygons are reflex: their inner angle is above 180 degrees.

    Args:
        points: corners of each polygon (m, n, 3).

    Returns:
        The normal of each polygon (m, 3), as long as its doubled area, and the flags (m, n).
    """
    points = points - points[:, :1]
    after = np.roll(points, -1, 1)
    before = np.roll(points, 1, 1)
    normals = np.cross(points, after).sum(1)
    turns = np.einsum("mnc,mc->mn", np.cross(points - before, after - points), normals)
    return normals, turns < -_FLAT * (normals**2).sum(-1, keepdims=True)


def _count_comparisons(is_reflex: np.ndarray) -> float:
    """Estimate the time to clip the ears of polygons, in comparisons of two corners.

    Each corner is compared with all reflex ones. Convex polygons are cut as fans, without any.

    Args:
        is_reflex: which corners of the polygons are reflex (m, n).
    """
    reflex_count = is_reflex.sum(1)
    comparisons_of_corner = _CORNER_OVERHEAD + reflex_count[reflex_count > 0]
    return float((is_reflex.shape[1] * comparisons_of_corner).sum())


def _measure_overlap(corners: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Measure the area of polygons' triangles, and how much of it covers their polygon twice.

    Both (m,) are doubled, as the length of a normal is the doubled area of its polygon. A polygon
    without area, whose normal is 0, counts whole.

    Args:
        corners: of the triangles of each polygon (m, t, 3, 3).
        normals: of the polygons (m, 3).
    """
    sides = corners[..., 1:, :] - corners[..., :1, :]
    doubled = np.cross(sides[..., 0, :], sides[..., 1, :])
    length = np.linalg.norm(normals, axis=-1)
    along = np.abs(np.einsum("mtc,mc->mt", doubled, normals)).sum(-1)
    area = np.linalg.norm(doubled, axis=-1).sum(-1)
    projected = np.divide(along, length, where=length > _FLAT * area, out=area.copy())
    return area, projected - length


def _cut_equal_polygons(
    points: np.ndarray, normals: np.ndarray, is_reflex: np.ndarray
) -> np.ndarray:
    """Cut polygons of equally many corners into triangles.

    Args:
        points: corners of each polygon (m, n, 3).
        normals: of the polygons (m, 3).
        is_reflex: which corners are reflex (m, n).

    Returns:
        Corners of the triangles, as places in the polygon (m, n - 2, 3).
    """
    # As fans about the first corner.
    points = points - points[:, :1]
    steps = np.arange(points.shape[1] - 2)
    fan = np.stack([np.zeros_like(steps), steps + 1, steps + 2], -1)
    places = np.repeat(fan[None], len(points), 0)

    # By ears, where a corner is reflex.
    for k in np.flatnonzero(is_reflex.any(1)):
        # Projected along its normal, which then points at the viewer.
        least_axis = np.eye(3)[np.abs(normals[k]).argmin()]
        across = np.cross(normals[k], least_axis)
        basis = np.stack([across, np.cross(normals[k], across)], -1)
        unit_basis = basis / np.linalg.norm(basis, axis=0).clip(1e-300)
        places[k] = _clip_ears(points[k] @ unit_basis, is_reflex[k])
    return places


def _clip_ears(points: np.ndarray, is_reflex: np.ndarray) -> list[list[int]]:
    """Cut a polygon into triangles by cutting off ears: corners whose triangles hold no other one.

    A triangle that holds any corner holds a reflex one, so that only these are tested.

    Args:
        points: corners of the polygon (n, 2), in order.
        is_reflex: which of them are reflex (n,); changed.

    Returns:
        Corners of the n - 2 triangles, as places in the polygon.
    """
    # The corners that are left as a ring, and those of them that wait to be examined.
    count = len(points)
    before = [count - 1, *range(count - 1)]
    after = [*range(1, count), 0]
    is_left = np.ones(count, bool)
    waiting = OrderedDict.fromkeys([*range(1, count), 0])

    # Rounds about the ring, until a triangle is left. A cut may straighten a reflex corner, and
    # makes none: a flag that is out of date costs a test alone.
    straight = _FLAT * float(np.ptp(points, axis=0).max()) ** 2
    ears: list[list[int]] = []
    rounds = 0
    must_cut = False
    while True:
        ears_before = len(ears)
        while waiting and len(ears) < count - 3:
            k, _ = waiting.popitem(last=False)
            ear = [before[k], k, after[k]]
            is_cut = must_cut or rounds > _MOST_ROUNDS or _is_ear(points, ear, is_reflex, straight)
            if not is_cut:
                continue

            # The ear is cut off: its neighbours become those of each other.
            ears.append(ear)
            is_left[k] = False
            is_reflex[k] = False
            must_cut = False
            after[ear[0]] = ear[2]
            before[ear[2]] = ear[0]
            # Both wait again, unless they still do. The one after the ear comes first, so that ears
            # do not fan out from one corner as needles.
            waiting.setdefault(ear[2])
            waiting.setdefault(ear[0])
        if len(ears) >= count - 3:
            return [*ears, np.flatnonzero(is_left).tolist()]

        # No ear is left: the polygon crosses or touches itself. All corners are examined once more,
        # and if none of them was an ear in this round, the next is cut whatever it is.
        must_cut = len(ears) == ears_before
        rounds += 1
        waiting = OrderedDict.fromkeys(np.flatnonzero(is_left).tolist())


def _is_ear(points: np.ndarray, ear: list[int], is_reflex: np.ndarray, straight: float) -> bool:
    """Whether the triangle of three successive corners lies in the polygon, and holds no other one.

    Args:
        points: corners of the polygon (n, 2).
        ear: places of the three corners.
        is_reflex: which corners are reflex (n,).
        straight: doubled area of the triangle up to which its middle corner is straight.
    """
    # A straight corner is cut off with no area; a reflex one is no ear.
    triangle = points[ear]
    sides = np.roll(triangle, -1, 0) - triangle
    turn = sides[0, 0] * sides[1, 1] - sides[0, 1] * sides[1, 0]
    if abs(turn) <= straight:
        return True
    if turn < 0:
        return False

    # Another corner lies within if it is on the inner side of all three sides.
    offsets = points[is_reflex] - triangle[:, None]  # from each of the three to each reflex corner
    is_within = (sides[:, :1] * offsets[..., 1] >= sides[:, 1:] * offsets[..., 0]).all(0)
    is_within &= offsets.any(-1).all(0)  # one at the place of a corner of the ear does no harm
    return not is_within.any()
