"""Triangles with what covers them, and the builder that collects them.

Metres; x right, y down, z forward, as in a camera's frame. A model stands at the origin on y = 0
and looks along z.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from depthpose.depth.synthetic.textures import NUMBER, Color, Number, Surface, Values

Rotation = Float[np.ndarray, "3 3"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Mesh:
    """Triangles, each for itself: no corner is shared."""

    corners: Float32[np.ndarray, "n 3 3"]  # positions [m]
    uv: Float32[np.ndarray, "n 3 2"]  # place in the texture, in tiles
    normals: Float32[np.ndarray, "n 3 3"]  # at the corners, smooth where the surface is round
    tint: Float32[np.ndarray, "n 3"]  # linear colour
    material: Int[np.ndarray, " n"]  # number of the material
    layer: Int[np.ndarray, " n"]  # number of the texture
    thing: Int[np.ndarray, " n"]  # which object the triangle belongs to

    def __len__(self) -> int:
        return len(self.corners)

    def part(self, kept: Bool[np.ndarray, " n"]) -> "Mesh":
        """Some of its triangles."""
        return Mesh(**{field.name: getattr(self, field.name)[kept] for field in fields(Mesh)})


def join(meshes: Sequence[Mesh]) -> Mesh:
    """Put meshes together as one."""
    parts = {f.name: [getattr(mesh, f.name) for mesh in meshes] for f in fields(Mesh)}
    return Mesh(**{name: np.concatenate(values) for name, values in parts.items()})


def place(
    mesh: Mesh,
    position: Values,
    yaw_rad: Number = 0.0,
    scale: Values = 1.0,
    tints: Mapping[str, Color] | None = None,
) -> Mesh:
    """Copy a model to its place; a positive yaw turns z towards x, to the right."""
    factor = np.broadcast_to(np.asarray(scale, np.float32), 3)
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    R = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]).astype(np.float32)
    corners = (mesh.corners * factor) @ R.T + np.asarray(position, np.float32)
    tint = mesh.tint
    for material, color in (tints or {}).items():
        is_it = (mesh.material == NUMBER[material])[:, None]
        tint = np.where(is_it, tint * np.asarray(color, np.float32), tint)
    return replace(mesh, corners=corners, normals=mesh.normals @ R.T, tint=tint)


NEAREST_M = 2.5
"""A car drives where nothing is nearer to its camera: with a baseline of 0.53 m and half of
KITTI's resolution that is a disparity of 77 px."""

_CUBE = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float32)
_FACES = [[0, 1, 3, 2], [5, 4, 6, 7], [4, 5, 1, 0], [2, 3, 7, 6], [4, 0, 2, 6], [1, 5, 7, 3]]
_FACE_WIDTH = [2, 2, 2, 2, 0, 0]
_FACE_HEIGHT = [1, 1, 0, 0, 1, 1]


class MeshBuilder:
    """Collects triangles; every method adds to what is there. ``rng`` draws what is random."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self._parts: list[Mesh] = []
        self._boxes: list[tuple] = []
        self._thing = 0

    def begin_thing(self) -> None:
        """Say that what follows is another object."""
        self._thing += 1

    def add(self, mesh: Mesh) -> None:
        """Add a placed model as one object, unless it would stand against the camera."""
        if len(mesh) and np.hypot(mesh.corners[..., 0], mesh.corners[..., 2]).min() < NEAREST_M:
            return
        self.begin_thing()
        self._parts.append(replace(mesh, thing=np.full(len(mesh), self._thing, np.int32)))

    def triangles(
        self,
        corners: Values,
        uv_m: Values,
        surface: Surface,
        normals: Values | None = None,
        tint: Values | None = None,
    ) -> None:
        """Add triangles (n, 3, 3) [m].

        ``uv_m`` is the place on the surface [m], broadcast to (n, 3, 2); normals are those of the
        planes by default; ``tint`` holds colours, one a triangle, instead of the surface's.
        """
        positions = np.asarray(corners, np.float32)
        uv = np.asarray(uv_m, np.float32) / surface.tile_m
        material, color = NUMBER[surface.material], surface.tint if tint is None else tint
        self._parts.append(
            _mesh(positions, uv, normals, color, material, surface.layer, self._thing)
        )

    def quads(
        self,
        corners: Values,
        uv_m: Values,
        surface: Surface,
        normals: Values | None = None,
        tint: Values | None = None,
    ) -> None:
        """Add four-cornered faces (n, 4, 3), corners in turn; see :meth:`triangles`."""
        faces = np.asarray(corners, np.float32)
        n = len(faces)
        if normals is not None:
            normals = _halves(_full(normals, (n, 4, 3)))
        if tint is not None:
            tint = np.tile(_full(tint, (n, 3)), (2, 1))
        self.triangles(_halves(faces), _halves(_full(uv_m, (n, 4, 2))), surface, normals, tint)

    def rectangle(self, corner: Values, along: Values, up: Values, surface: Surface) -> None:
        """Add one rectangle: a corner and its two sides [m]."""
        p, a, b = (np.asarray(v, np.float64) for v in (corner, along, up))
        width, height = np.linalg.norm(a), np.linalg.norm(b)
        uv = [[0, 0], [width, 0], [width, height], [0, height]]
        self.quads([[p, p + a, p + a + b, p + b]], [uv], surface)

    def box(
        self,
        centre: Values,
        size: Values,
        surface: Surface,
        rotation: Rotation | None = None,
        taper: float = 1.0,
    ) -> None:
        """Add a box; ``taper`` scales its top. Boxes are made all at once, in :meth:`finish`."""
        R = np.eye(3) if rotation is None else rotation
        self._boxes.append((centre, size, R, taper, surface, self._thing))

    def tube(
        self,
        start: Values,
        stop: Values,
        radii_m: Number | tuple[Number, Number],
        surface: Surface,
        sides: int = 8,
    ) -> None:
        """Add a cone's frustum without ends, from one point to another; one radius: a cylinder."""
        first, last = radii_m if isinstance(radii_m, tuple) else (radii_m, radii_m)
        p, q = np.asarray(start, np.float64), np.asarray(stop, np.float64)
        length = float(np.linalg.norm(q - p))
        across, other = _across((q - p) / length)
        angle = np.linspace(0, 2 * np.pi, sides + 1)
        ring = np.cos(angle)[:, None] * across + np.sin(angle)[:, None] * other
        low, high = p + ring * first, q + ring * last
        around = angle * max(first, last)
        below, above = (np.stack([around, 0 * around + d], -1) for d in (0.0, length))
        self.quads(between(low, high), between(below, above), surface, between(ring, ring))

    def disc(
        self, centre: Values, axis: Values, radius_m: Number, surface: Surface, sides: int = 12
    ) -> None:
        """Add a flat polygon; its texture is one tile from side to side."""
        middle = np.asarray(centre, np.float64)
        direction = np.asarray(axis, np.float64)
        across, other = _across(direction / np.linalg.norm(direction))
        angle = np.linspace(0, 2 * np.pi, sides + 1) + np.pi / sides
        rim_uv = np.stack([np.cos(angle), np.sin(angle)], -1)
        rim = middle + radius_m * (rim_uv[:, :1] * across + rim_uv[:, 1:] * other)
        uv = (0.5 + 0.5 * rim_uv) * surface.tile_m
        hub, hub_uv = np.broadcast_to(middle, rim.shape), np.full_like(uv, 0.5 * surface.tile_m)
        faces, places = (np.stack([c[1:], e[:-1], e[1:]], 1) for c, e in ((hub, rim), (hub_uv, uv)))
        self.triangles(faces, places, surface)

    def finish(self) -> Mesh:
        """Give all that was added, as one mesh; boxes one by one would cost more than all else."""
        if not self._boxes:
            return join(self._parts)
        centres, sizes, turns, tapers, surfaces, things = zip(*self._boxes, strict=True)
        centre, size, R, taper = (np.array(v, np.float32) for v in (centres, sizes, turns, tapers))
        vertices = _CUBE * (size / 2)[:, None]
        vertices[:, _CUBE[:, 1] < 0] *= np.stack([taper, 0 * taper + 1, taper], 1)[:, None]
        vertices = np.einsum("kij,kvj->kvi", R, vertices) + centre[:, None]
        uv = np.zeros((len(surfaces), 6, 4, 2), np.float32)
        tile = np.array([surface.tile_m for surface in surfaces], np.float32)[:, None]
        uv[:, :, 1:3, 0] = (size[:, _FACE_WIDTH] / tile)[:, :, None]
        uv[:, :, 2:, 1] = (size[:, _FACE_HEIGHT] / tile)[:, :, None]
        row = np.tile(np.repeat(np.arange(len(surfaces)), 6), 2)  # six faces, in both halves
        boxes = _mesh(
            _halves(vertices[:, _FACES].reshape(-1, 4, 3)),
            _halves(uv.reshape(-1, 4, 2)),
            None,
            np.array([surface.tint for surface in surfaces])[row],
            np.array([NUMBER[surface.material] for surface in surfaces])[row],
            np.array([surface.layer for surface in surfaces])[row],
            np.array(things)[row],
        )
        self._parts, self._boxes = [*self._parts, boxes], []
        return join(self._parts)


def _mesh(
    corners: Float32[np.ndarray, "n 3 3"],
    uv: Values,
    normals: Values | None,
    tint: Values,
    material: Values,
    layer: Values,
    thing: Values,
) -> Mesh:
    """Make triangles of what is broadcast to them; without normals, those of their planes."""
    n = len(corners)
    flat = normals
    if flat is None:
        (ax, ay, az), (bx, by, bz) = ((corners[:, k] - corners[:, 0]).T for k in (1, 2))
        across = np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], 1)
        flat = (across / (np.sqrt((across**2).sum(1, keepdims=True)) + 1e-12))[:, None]
    each = lambda number: np.array(np.broadcast_to(number, n), np.int32)  # noqa: E731
    return Mesh(
        corners=corners,
        uv=_full(uv, (n, 3, 2)),
        normals=_full(flat, (n, 3, 3)),
        tint=_full(np.clip(tint, 0.005, 0.97), (n, 3)),
        material=each(material),
        layer=each(layer),
        thing=each(thing),
    )


def _full(values: Values, shape: tuple[int, ...]) -> Float32[np.ndarray, "..."]:
    return np.ascontiguousarray(np.broadcast_to(np.asarray(values, np.float32), shape))


def between(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Give the four-cornered faces (n - 1, 4, ...) between two rows of n points."""
    return np.stack([low[:-1], low[1:], high[1:], high[:-1]], 1)


def _halves(faces: np.ndarray) -> np.ndarray:
    return np.concatenate([faces[:, [0, 1, 2]], faces[:, [0, 2, 3]]])


def _across(direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors across a direction; the second points up where it can."""
    aside = np.array([0.0, 1, 0]) if abs(direction[1]) < 0.9 else np.array([0.0, 0, 1])
    across = np.cross(aside, direction)
    across /= np.linalg.norm(across)
    return across, np.cross(direction, across)
