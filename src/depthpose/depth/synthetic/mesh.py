"""Triangle meshes of synthetic scenes, and their builder.

Coordinates are metres; x right, y down, z forward, as in a camera's frame. A model stands at the
origin on y = 0 and faces along z.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from depthpose.depth.synthetic.materials import MATERIAL_IDS, Appearance, Color, Number

Values = Sequence | np.ndarray | float | int
"""Anything that NumPy converts to an array."""

Rotation = Float[np.ndarray, "3 3"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Mesh:
    """Triangles without shared corners."""

    corners: Float32[np.ndarray, "n 3 3"]  # positions [m]
    uv: Float32[np.ndarray, "n 3 2"]  # coordinates in the texture [tiles]
    normals: Float32[np.ndarray, "n 3 3"]  # at the corners, smooth where the surface is round
    tint: Float32[np.ndarray, "n 3"]  # linear colour
    material: Int[np.ndarray, " n"]  # number of the material
    layer: Int[np.ndarray, " n"]  # number of the texture
    object_id: Int[np.ndarray, " n"]  # number of the object to which the triangle belongs

    def __len__(self) -> int:
        return len(self.corners)

    def select(self, is_selected: Bool[np.ndarray, " n"]) -> "Mesh":
        """Return the mesh of the triangles where a mask is true."""
        return Mesh(
            **{field.name: getattr(self, field.name)[is_selected] for field in fields(Mesh)}
        )


def join_meshes(meshes: Sequence[Mesh]) -> Mesh:
    """Join meshes to one."""
    joined: dict[str, np.ndarray] = {}
    for field_ in fields(Mesh):
        joined[field_.name] = np.concatenate([getattr(mesh, field_.name) for mesh in meshes])
    return Mesh(**joined)


def rotation_about_y(yaw_rad: Number) -> Float[np.ndarray, "3 3"]:
    """Make the rotation about y; a positive angle rotates z towards x, to the right."""
    c = np.cos(yaw_rad)
    s = np.sin(yaw_rad)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def place_model(
    model: Mesh,
    position: Values,
    yaw_rad: Number = 0.0,
    scale: Values = 1.0,
    tints: Mapping[str, Color] | None = None,
) -> Mesh:
    """Return a copy of a model, scaled, then rotated about y, then moved to a position.

    Args:
        model: the model, at the origin.
        position: where it stands (x, y, z) [m].
        yaw_rad: rotation about y; a positive one rotates z towards x, to the right.
        scale: factor of its size, or one for each axis.
        tints: for some materials, colours by which theirs are multiplied.
    """
    factor = np.broadcast_to(np.asarray(scale, np.float32), 3)
    R = rotation_about_y(yaw_rad).astype(np.float32)
    corners = (model.corners * factor) @ R.T + np.asarray(position, np.float32)
    tint = model.tint
    for material, color in (tints or {}).items():
        is_of_material = (model.material == MATERIAL_IDS[material])[:, None]
        tint = np.where(is_of_material, tint * np.asarray(color, np.float32), tint)
    return replace(model, corners=corners, normals=model.normals @ R.T, tint=tint)


MIN_DISTANCE_M = 2.5
"""Least distance of a model from the camera: with a baseline of 0.53 m and half of KITTI's
resolution that is a disparity of 77 px."""

UNIT_SQUARE = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
"""Corners of a texture tile, in the order of the corners of a quad."""

_CUBE_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float32)
_CUBE_FACES = [[0, 1, 3, 2], [5, 4, 6, 7], [4, 5, 1, 0], [2, 3, 7, 6], [4, 0, 2, 6], [1, 5, 7, 3]]
"""Numbers of the four corners of each face."""
_FACE_WIDTH_AXIS = [2, 2, 2, 2, 0, 0]
_FACE_HEIGHT_AXIS = [1, 1, 0, 0, 1, 1]
"""Axes of the box along the width and height of each face."""


class _Box(NamedTuple):
    """A box that a builder has yet to make."""

    centre: Values
    size: Values  # along x, y and z before the rotation [m]
    R: Rotation
    taper: float  # factor of x and z of the upper face
    appearance: Appearance
    object_id: int


@dataclass(eq=False)
class MeshBuilder:
    """Builds a mesh: each ``add`` method adds triangles to the object that was begun last."""

    rng: np.random.Generator  # random numbers of all that is built
    object_id: int = 0  # number of the object to which added triangles belong
    _parts: list[Mesh] = field(default_factory=list)
    _boxes: list[_Box] = field(default_factory=list)

    def begin_object(self) -> None:
        """Begin an object, to which all triangles belong that are added from here on."""
        self.object_id += 1

    def add_model(self, model: Mesh) -> None:
        """Add a placed model as one object, unless it is nearer than ``MIN_DISTANCE_M``."""
        distance_m = np.hypot(model.corners[..., 0], model.corners[..., 2])
        if len(model) and distance_m.min() < MIN_DISTANCE_M:
            return
        self.begin_object()
        object_ids = np.full(len(model), self.object_id, np.int32)
        self._parts.append(replace(model, object_id=object_ids))

    def add_triangles(
        self,
        corners: Values,
        uv_m: Values,
        appearance: Appearance,
        normals: Values | None = None,
        tint: Values | None = None,
    ) -> None:
        """Add triangles.

        Args:
            corners: corners (n, 3, 3) [m].
            uv_m: coordinates on the surface [m], broadcast to (n, 3, 2).
            appearance: what they look like.
            normals: unit normals at the corners, broadcast to (n, 3, 3); None: of the planes.
            tint: a colour for each triangle, in place of the appearance's.
        """
        positions = np.asarray(corners, np.float32)
        uv = np.asarray(uv_m, np.float32) / appearance.tile_m
        material = MATERIAL_IDS[appearance.material]
        color = appearance.tint if tint is None else tint
        part = _make_mesh(positions, uv, normals, color, material, appearance.layer, self.object_id)
        self._parts.append(part)

    def add_quads(
        self,
        corners: Values,
        uv_m: Values,
        appearance: Appearance,
        normals: Values | None = None,
        tint: Values | None = None,
    ) -> None:
        """Add four-cornered faces (n, 4, 3) [m], whose corners follow their border.

        ``uv_m`` and ``normals`` are of these corners; else as of :meth:`add_triangles`.
        """
        faces = np.asarray(corners, np.float32)
        n = len(faces)
        uv_m = _split_quads(_broadcast(uv_m, (n, 4, 2)))
        if normals is not None:
            normals = _split_quads(_broadcast(normals, (n, 4, 3)))
        if tint is not None:
            tint = np.tile(_broadcast(tint, (n, 3)), (2, 1))
        self.add_triangles(_split_quads(faces), uv_m, appearance, normals, tint)

    def add_rectangle(
        self, corner: Values, along: Values, up: Values, appearance: Appearance
    ) -> None:
        """Add one rectangle: a corner and its two sides, as vectors [m]."""
        p, a, b = (np.asarray(vector, np.float64) for vector in (corner, along, up))
        size_m = [np.linalg.norm(a), np.linalg.norm(b)]
        self.add_quads([[p, p + a, p + a + b, p + b]], [UNIT_SQUARE * size_m], appearance)

    def add_box(
        self,
        centre: Values,
        size: Values,
        appearance: Appearance,
        rotation: Rotation | None = None,
        taper: float = 1.0,
    ) -> None:
        """Add a box. Boxes are made all at once, in :meth:`finish`, which is much faster.

        Args:
            centre: centre of the box [m].
            size: along x, y and z, before it is rotated [m].
            appearance: what it looks like.
            rotation: rotation of the box.
            taper: factor of x and z of its upper face, that toward -y.
        """
        R = np.eye(3) if rotation is None else rotation
        self._boxes.append(_Box(centre, size, R, taper, appearance, self.object_id))

    def add_tube(
        self,
        start: Values,
        stop: Values,
        radii_m: Number | tuple[Number, Number],
        appearance: Appearance,
        sides: int = 8,
    ) -> None:
        """Add a cylinder from one point to another [m], open at both ends.

        Two radii, at ``start`` and at ``stop``, make it a cone's frustum.
        """
        start_radius, stop_radius = radii_m if isinstance(radii_m, tuple) else (radii_m, radii_m)
        p = np.asarray(start, np.float64)
        q = np.asarray(stop, np.float64)
        length = float(np.linalg.norm(q - p))
        across, other = _find_perpendicular_axes((q - p) / length)
        angle = np.linspace(0, 2 * np.pi, sides + 1)
        ring = np.cos(angle)[:, None] * across + np.sin(angle)[:, None] * other

        start_ring = p + ring * start_radius
        stop_ring = q + ring * stop_radius
        around = angle * max(start_radius, stop_radius)
        start_uv, stop_uv = (np.stack([around, 0 * around + v], -1) for v in (0.0, length))
        self.add_quads(
            quads_between(start_ring, stop_ring),
            quads_between(start_uv, stop_uv),
            appearance,
            quads_between(ring, ring),
        )

    def add_disc(
        self,
        centre: Values,
        axis: Values,
        radius_m: Number,
        appearance: Appearance,
        sides: int = 12,
    ) -> None:
        """Add a flat regular polygon, perpendicular to ``axis``.

        ``radius_m`` is that of its corners. Its texture is one tile from side to side.
        """
        middle = np.asarray(centre, np.float64)
        direction = np.asarray(axis, np.float64)
        across, other = _find_perpendicular_axes(direction / np.linalg.norm(direction))
        angle = np.linspace(0, 2 * np.pi, sides + 1) + np.pi / sides
        unit_rim = np.stack([np.cos(angle), np.sin(angle)], -1)
        rim = middle + radius_m * (unit_rim[:, :1] * across + unit_rim[:, 1:] * other)
        rim_uv = (0.5 + 0.5 * unit_rim) * appearance.tile_m

        # A triangle from the centre to each side.
        hub = np.broadcast_to(middle, rim.shape)
        hub_uv = np.full_like(rim_uv, 0.5 * appearance.tile_m)
        corners = np.stack([hub[1:], rim[:-1], rim[1:]], 1)
        uv_m = np.stack([hub_uv[1:], rim_uv[:-1], rim_uv[1:]], 1)
        self.add_triangles(corners, uv_m, appearance)

    def add_ellipsoid(
        self,
        centre: Values,
        radii_m: Values,
        appearance: Appearance,
        level: int = 2,
        dents: Number = 0.0,
    ) -> None:
        """Add an ellipsoid: an icosahedron whose faces are divided in four ``level`` times.

        ``radii_m``: one, or one for each axis. ``dents``: amplitude of random dents, as a share of
        the radius.
        """
        directions = _make_sphere(level)
        radii = np.broadcast_to(np.asarray(radii_m, np.float64), 3)

        # Dents are a sum of six sine waves over the sphere, of random directions and frequencies.
        swelling = np.ones(len(directions))
        for _ in range(6 if dents else 0):
            wave = self.rng.normal(size=3) * self.rng.uniform(1.5, 4)
            swelling += dents / 3 * np.sin(directions @ wave + self.rng.uniform(0, 6.28))
        points = directions * swelling[:, None] * radii + np.asarray(centre)

        # An ellipsoid's normal at radii * d is along d / radii; dents do not change it.
        normals = directions / radii
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        longitude = np.arctan2(directions[:, 0], directions[:, 2])
        uv_m = np.stack([longitude, directions[:, 1]], 1) * radii.mean()
        self.add_triangles(
            points.reshape(-1, 3, 3), uv_m.reshape(-1, 3, 2), appearance, normals.reshape(-1, 3, 3)
        )

    def finish(self) -> Mesh:
        """Return the mesh of all triangles that were added."""
        if self._boxes:
            self._parts = [*self._parts, _make_boxes(self._boxes)]
            self._boxes = []
        return join_meshes(self._parts)


def _make_boxes(boxes: Sequence[_Box]) -> Mesh:
    """Make the mesh of boxes."""
    # The eight corners of each box: the unit cube scaled, tapered, rotated and moved.
    centre = np.array([box.centre for box in boxes], np.float32)
    size = np.array([box.size for box in boxes], np.float32)
    R = np.array([box.R for box in boxes], np.float32)
    taper = np.array([box.taper for box in boxes], np.float32)
    is_upper = _CUBE_CORNERS[:, 1] < 0
    vertices = _CUBE_CORNERS * (size / 2)[:, None]
    vertices[:, is_upper] *= np.stack([taper, np.ones_like(taper), taper], 1)[:, None]
    vertices = np.einsum("kij,kvj->kvi", R, vertices) + centre[:, None]

    # The texture of each of the six faces begins at its first corner.
    uv = np.zeros((len(boxes), 6, 4, 2), np.float32)
    tile_m = np.array([box.appearance.tile_m for box in boxes], np.float32)[:, None]
    uv[:, :, 1:3, 0] = (size[:, _FACE_WIDTH_AXIS] / tile_m)[:, :, None]
    uv[:, :, 2:, 1] = (size[:, _FACE_HEIGHT_AXIS] / tile_m)[:, :, None]

    # The number of each triangle's box: six faces each, in the order of ``_split_quads``.
    box_number = np.tile(np.repeat(np.arange(len(boxes)), 6), 2)
    return _make_mesh(
        _split_quads(vertices[:, _CUBE_FACES].reshape(-1, 4, 3)),
        _split_quads(uv.reshape(-1, 4, 2)),
        None,
        np.array([box.appearance.tint for box in boxes])[box_number],
        np.array([MATERIAL_IDS[box.appearance.material] for box in boxes])[box_number],
        np.array([box.appearance.layer for box in boxes])[box_number],
        np.array([box.object_id for box in boxes])[box_number],
    )


_MIN_TINT = 0.005
_MAX_TINT = 0.97
"""Range of the channels of a tint: nothing is quite black or white."""


def _make_mesh(
    corners: Float32[np.ndarray, "n 3 3"],
    uv: Values,
    normals: Values | None,
    tint: Values,
    material: Values,
    layer: Values,
    object_id: Values,
) -> Mesh:
    """Make a mesh of triangles; all values but ``corners`` are broadcast to them.

    Without ``normals`` they are those of the planes.
    """
    n = len(corners)
    if normals is None:
        normals = _compute_plane_normals(corners)[:, None]
    return Mesh(
        corners=corners,
        uv=_broadcast(uv, (n, 3, 2)),
        normals=_broadcast(normals, (n, 3, 3)),
        tint=_broadcast(np.clip(tint, _MIN_TINT, _MAX_TINT), (n, 3)),
        material=np.array(np.broadcast_to(material, n), np.int32),
        layer=np.array(np.broadcast_to(layer, n), np.int32),
        object_id=np.array(np.broadcast_to(object_id, n), np.int32),
    )


def _compute_plane_normals(corners: Float32[np.ndarray, "n 3 3"]) -> Float32[np.ndarray, "n 3"]:
    """Compute the unit normals of triangles; zero where a triangle has no area."""
    # The cross product of two sides, written out: np.cross is several times slower.
    ax, ay, az = (corners[:, 1] - corners[:, 0]).T
    bx, by, bz = (corners[:, 2] - corners[:, 0]).T
    cross = np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], 1)
    length = np.sqrt((cross**2).sum(1, keepdims=True))
    return cross / (length + 1e-12)


def _broadcast(values: Values, shape: tuple[int, ...]) -> Float32[np.ndarray, "..."]:
    """Broadcast values to a shape, as a new array of float32."""
    return np.ascontiguousarray(np.broadcast_to(np.asarray(values, np.float32), shape))


def quads_between(lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Return the four-cornered faces (n - 1, 4, ...) between two rows of n points (n, ...)."""
    return np.stack([lower[:-1], lower[1:], upper[1:], upper[:-1]], 1)


def _split_quads(quads: np.ndarray) -> np.ndarray:
    """Split n four-cornered faces into 2 n triangles: all first halves, then all second ones."""
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def _find_perpendicular_axes(direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return two unit vectors perpendicular to a unit vector and to each other."""
    aside = np.array([0.0, 1, 0]) if abs(direction[1]) < 0.9 else np.array([0.0, 0, 1])
    across = np.cross(aside, direction)
    across /= np.linalg.norm(across)
    return across, np.cross(direction, across)


_ICOSAHEDRON_FACES = [
    (0, 11, 5), (0, 5, 1), (0, 1, 7), (0, 7, 10), (0, 10, 11), (1, 5, 9), (5, 11, 4),
    (11, 10, 2), (10, 7, 6), (7, 1, 8), (3, 9, 4), (3, 4, 2), (3, 2, 6), (3, 6, 8),
    (3, 8, 9), (4, 9, 5), (2, 4, 11), (6, 2, 10), (8, 6, 7), (9, 8, 1),
]  # fmt: skip


@cache
def _make_sphere(level: int) -> Float[np.ndarray, "n 3"]:
    """Make the corners of a unit sphere's triangles, three in a row for each.

    They are those of an icosahedron whose faces are divided in four ``level`` times.
    """
    t = (1 + 5**0.5) / 2  # the golden ratio
    corners = [(-1, t, 0), (1, t, 0), (-1, -t, 0), (1, -t, 0), (0, -1, t), (0, 1, t),
               (0, -1, -t), (0, 1, -t), (t, 0, -1), (t, 0, 1), (-t, 0, -1), (-t, 0, 1)]  # fmt: skip
    triangles = scale_to_unit(np.array(corners, float))[np.array(_ICOSAHEDRON_FACES)]
    for _ in range(level):
        a, b, c = triangles.transpose(1, 0, 2)
        ab = scale_to_unit(a + b)
        bc = scale_to_unit(b + c)
        ca = scale_to_unit(c + a)
        quarters = [(a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca)]
        triangles = np.concatenate([np.stack(quarter, 1) for quarter in quarters])
    return triangles.reshape(-1, 3)


def scale_to_unit(vectors: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Scale vectors to length 1."""
    return vectors / (np.linalg.norm(vectors, axis=1, keepdims=True) + 1e-9)
