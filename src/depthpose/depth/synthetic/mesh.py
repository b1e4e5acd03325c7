"""Meshes of synthetic scenes: materials, their seamless textures, triangles and their builder.

A texture modulates a surface's colour, so its mean is about 1. Textures are made from noise, once
in a process, and shared by all scenes. Coordinates are metres; x right, y down, z forward, as in a
camera's frame. A model stands at the origin on y = 0 and faces along z.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cache, partialmethod
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Float16, Float32, Int
from torch import Tensor

Number = float | int
"""A length, an angle or a share."""

Values = Sequence | np.ndarray | float | int
"""Anything that NumPy converts to an array."""

Numbers = Float[Tensor, " n"]
Vectors = Float[Tensor, "n 3"]
Indices = Int[Tensor, " n"]

Color = tuple[Number, Number, Number]
"""Linear RGB, 0 black to 1 white."""


class Material(NamedTuple):
    """Optical properties of a material."""

    variants: int  # number of its different textures
    specular: float = 0.0  # reflectance at normal incidence, 0..1
    translucency: float = 0.0  # share of the light that comes through from behind
    glow: float = 0.0  # emitted light, as a share of its colour


MATERIALS: dict[str, Material] = {
    "road": Material(4), "pavement": Material(3), "grass": Material(3), "dirt": Material(2),
    "curb": Material(1), "brick": Material(3), "plaster": Material(3), "stone": Material(3),
    "concrete": Material(2), "roof": Material(3), "bark": Material(2),
    "leaf": Material(3, translucency=0.35), "wood": Material(2),
    "metal": Material(2, specular=0.05), "paint": Material(1, specular=0.05),
    "side": Material(3, specular=0.05), "glass": Material(1, specular=0.07),
    "pane": Material(3, specular=0.06), "tyre": Material(1), "wheel": Material(2, specular=0.05),
    "plate": Material(2, specular=0.02), "lamp": Material(1, specular=0.05, glow=0.35),
    "sign": Material(6, specular=0.02), "poster": Material(4), "cloth": Material(4),
    "skin": Material(1), "hills": Material(2),
}  # fmt: skip
NUMBER = {name: number for number, name in enumerate(MATERIALS)}
"""Number of each material in meshes."""

_counts = [material.variants for material in MATERIALS.values()]
FIRST_LAYER = {name: sum(_counts[:number]) for name, number in NUMBER.items()}
"""Number of each material's first texture in the stack of all textures."""

LAYERS = sum(_counts)
"""Number of all textures."""


class Surface(NamedTuple):
    """Appearance of a part of a mesh."""

    material: str  # a name of ``MATERIALS``
    tint: Color = (1.0, 1.0, 1.0)  # colour that the texture modulates
    tile_m: Number = 1.0  # side of one tile of the texture
    variant: int = 0  # number of the material's texture; larger numbers begin again

    @property
    def layer(self) -> int:
        """The number of the texture in the stack of all textures."""
        variants = MATERIALS[self.material].variants
        return FIRST_LAYER[self.material] + int(self.variant) % variants


SIDE_PX = 256
LEVELS = 9
"""Number of levels of a texture, with sides from 256 pixels down to 1."""

Plane = Float[np.ndarray, "256 256"]
Picture = Float[np.ndarray, "256 256 3"]
_y, _x = np.mgrid[:SIDE_PX, :SIDE_PX].astype(np.float32) / SIDE_PX
"""Coordinates of the pixels of a texture, in tiles."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Textures:
    """All textures at all levels of detail."""

    texels: Float16[Tensor, "n 3"]  # texels of all textures, level by level
    starts: Int[Tensor, " levels"]  # where each level begins
    clouds: Float[Tensor, "256 256"]  # a field of noise for clouds
    stains: Float[Tensor, "256 256"]  # a field of noise for unevenness over metres


@cache
def textures() -> Textures:
    """Make all textures, once in a process; it takes a second."""
    rng = np.random.default_rng(5)
    stack = np.ones((LAYERS, SIDE_PX, SIDE_PX, 3), np.float32)
    for name, material in MATERIALS.items():
        for variant in range(material.variants):
            paint = _paint_thing if name in _THINGS else _paint_surface
            painted = paint(name, _Noise(rng), variant)
            is_grey = painted.ndim == 2
            stack[FIRST_LAYER[name] + variant] = painted[..., None] if is_grey else painted

    # Each level has half the side of the one before.
    level = np.clip(stack, 0.02, 3)
    levels = []
    for _ in range(LEVELS):
        levels.append(level.reshape(-1, 3))
        half = level.shape[1] // 2
        if half:
            level = level.reshape(LAYERS, half, 2, half, 2, 3).mean((2, 4))
    starts = np.cumsum([0, *(len(texels) for texels in levels[:-1])])

    return Textures(
        texels=torch.from_numpy(np.concatenate(levels).astype(np.float16)),
        starts=torch.from_numpy(starts),
        clouds=torch.from_numpy(_Noise(rng).smooth(2.6, (1, 100))),
        stains=torch.from_numpy(_Noise(rng).smooth(2.0, (1, 64))),
    )


def sample_texture(
    textures: Textures, layer: Indices, uv: Float[Tensor, "n 2"], level: Numbers
) -> Vectors:
    """Sample textures bilinearly, in the nearest level of detail.

    Args:
        textures: all textures.
        layer: number of the texture of each sample.
        uv: coordinates in tiles.
        level: fractional level: 0 is the full size, 1 half of it.
    """
    # The four texels about each place; sides are powers of two, so a mask repeats the texture.
    whole = level.round().clamp(0, LEVELS - 1).long()
    side = SIDE_PX >> whole
    place = uv * side[:, None] - 0.5
    low = place.floor()
    share = place - low
    column, row = low.long().unbind(1)
    mask = side - 1
    start = textures.starts.to(layer.device)[whole] + layer * side * side
    left = column & mask
    right = (column + 1) & mask
    above = start + (row & mask) * side
    below = start + ((row + 1) & mask) * side

    # Their mean, weighted by nearness.
    texels = textures.texels
    a, b, c, d = (
        texels.index_select(0, index).float()
        for index in (above + left, above + right, below + left, below + right)
    )
    across = share[:, :1]
    down = share[:, 1:]
    top = torch.lerp(a, b, across)
    bottom = torch.lerp(c, d, across)
    return torch.lerp(top, bottom, down)


@dataclass(frozen=True)
class _Noise:
    """Seamless fields of noise with a mean of 0 and a deviation of 1."""

    rng: np.random.Generator

    def smooth(
        self, fall: Number, band: tuple[Number, Number], stretch: tuple[Number, Number] = (1, 1)
    ) -> Plane:
        """Make noise whose power falls with the frequency.

        Args:
            fall: exponent of the fall.
            band: lowest and highest frequency, in periods per tile.
            stretch: factors of the frequencies along y and x.
        """
        fy = np.fft.fftfreq(SIDE_PX)[:, None] * SIDE_PX / stretch[0]
        fx = np.fft.rfftfreq(SIDE_PX)[None] * SIDE_PX / stretch[1]
        often = np.hypot(fx, fy)
        is_in = (often >= band[0]) & (often <= band[1])
        strength = np.where(is_in, 1 / np.maximum(often, 1) ** (fall / 2 + 0.5), 0)
        turn = np.exp(2j * np.pi * self.rng.random(strength.shape))
        field = np.fft.irfft2(strength * turn, s=(SIDE_PX, SIDE_PX))
        return (field / field.std()).astype(np.float32)

    rough = partialmethod(smooth, 1.6, (1, 128))  # coarse and fine together
    fine = partialmethod(smooth, 0.3, (24, 128))  # grains
    broad = partialmethod(smooth, 2.4, (1, 20))  # patches

    def mottled(self, shares: Mapping[str, float]) -> Plane:
        """Make grey with noise of the named kinds, which are drawn in their order."""
        plane = np.ones((SIDE_PX, SIDE_PX), np.float32)
        for kind, share in shares.items():
            plane = plane + share * getattr(self, kind)()
        return plane

    def bricks(
        self, rows: int, columns: int, joint: Number, spread: Number
    ) -> tuple[Plane, Picture, Plane]:
        """Make a bond of bricks in staggered rows.

        Gives a mask, 1 on the bricks and 0 in the joints; a random shade of each brick; and the
        height in its row, 0..1. ``joint``: width of the joints in rows.
        """
        row = np.floor(_y * rows).astype(int)
        across = _x * columns + 0.5 * (row % 2)
        column = np.floor(across).astype(int) % columns
        in_row = (_y * rows) % 1
        in_column = across % 1
        edge = np.minimum(
            np.minimum(in_column, 1 - in_column) * rows / columns, np.minimum(in_row, 1 - in_row)
        )
        is_brick = np.clip((edge - joint / 2) / (joint * 0.6), 0, 1)
        shade = 1 + spread * self.rng.normal(size=(rows, columns, 1))
        shade = shade + 0.3 * spread * self.rng.normal(size=(rows, columns, 3))
        return is_brick, shade[row, column].astype(np.float32), in_row


_MOTTLED = {
    "dirt": {"rough": 0.2, "fine": 0.18, "broad": 0.12},
    "curb": {"rough": 0.2, "fine": 0.18, "broad": 0.12},
    "pavement": {"rough": 0.08, "fine": 0.14},
    "stone": {"fine": 0.09, "rough": 0.12},
    "concrete": {"fine": 0.07, "rough": 0.09, "broad": 0.08},
    "paint": {"broad": 0.03, "fine": 0.012},
    "glass": {"broad": 0.15},
    "tyre": {"fine": 0.2, "rough": 0.15},
    "skin": {"broad": 0.06},
}
"""Materials that are grey with noise: its kinds, drawn in this order, and their shares."""

_SLABS = {
    "pavement": (((4, 4), (12, 6), (8, 8)), 0.05, 0.07),
    "stone": (((8, 5), (6, 3), (12, 6)), 0.06, 0.14),
}
"""Rows and columns of the slabs of each variant, width of their joints, spread of their shades."""


def _paint_surface(name: str, noise: _Noise, variant: int) -> Plane | Picture:
    """Paint one variant of what covers the ground, walls and plants, grey or in colours."""
    match name:
        case "road":
            cracks = np.clip(1 - np.abs(noise.smooth(1.8, (2, 60))) / 0.035, 0, 1)
            cracks = cracks * np.clip(noise.broad() - 0.4 * variant % 1, 0, 1)
            rough = noise.rough()
            fine = noise.fine()
            broad = noise.broad()
            painted = (
                1 + (0.24 + 0.05 * variant) * fine + 0.14 * rough + 0.06 * broad - 0.6 * cracks
            )
        case "grass":
            fine = noise.fine()
            rough = noise.rough()
            broad = noise.broad()
            dry = 0.14 + 0.1 * variant
            red = 1 + 0.34 * fine + 0.26 * rough + dry * broad
            green = 1 + 0.32 * fine + 0.24 * rough + 0.4 * dry * broad
            painted = np.stack([red, green, 1 + 0.3 * fine + 0.22 * rough], 2)
        case "brick":
            is_brick, shade, _ = noise.bricks(24, (8, 6, 10)[variant], 0.1, 0.16)
            wall = shade * (1 + 0.1 * noise.fine() + 0.08 * noise.rough())[..., None]
            joint = (1.3 + 0.08 * noise.fine())[..., None] * np.array([0.9, 1.3, 1.5])
            wall = np.where(is_brick[..., None] > 0.5, wall, joint)
            painted = wall * (1 + 0.1 * noise.broad())[..., None]
        case "plaster":
            streaks = np.clip(noise.smooth(2.2, (1, 60), (0.25, 1)) - 0.6, 0, 2)
            fine = noise.fine()
            rough = noise.rough()
            broad = noise.broad()
            plain = 1 + 0.05 * fine + 0.06 * rough + 0.07 * broad
            painted = plain - (0.06 + 0.06 * variant) * streaks
        case "roof":
            _, shade, in_row = noise.bricks((14, 20, 10)[variant], 12, 0.04, 0.13)
            grains = 1 + 0.09 * noise.fine() + 0.1 * noise.broad()
            painted = shade * ((0.55 + 0.65 * in_row) * grains)[..., None]
        case "leaf":  # light and dark clumps: a ball covered with it looks like foliage
            fine = noise.fine()
            rough = noise.rough()
            clumps = np.clip(1 + 0.55 * noise.smooth(0.8, (6, 60)) + 0.2 * fine, 0.1, 2.5)
            painted = np.stack([clumps + 0.15 * rough, clumps + 0.1 * rough, clumps], 2)
        case "wood":
            is_board, shade, _ = noise.bricks(1, 6, 0.03 * variant + 1e-3, 0.08)
            grain = 0.2 * noise.smooth(1.4, (2, 128), (0.15, 1)) + 0.05 * noise.fine()
            painted = shade * ((1 + grain) * (0.5 + 0.5 * is_board))[..., None]
        case "bark":
            painted = 1 + 0.38 * noise.smooth(1.2, (4, 128), (0.18, 1)) + 0.12 * noise.fine()
        case "metal":
            painted = 1 + 0.06 * noise.fine() + (0.08 + 0.1 * variant) * noise.broad()
        case "hills":
            painted = 1 + 0.4 * noise.smooth(1.0, (16, 128)) + 0.15 * noise.broad()
        case "pavement" | "stone":
            sizes, joint, spread = _SLABS[name]
            is_slab, shade, _ = noise.bricks(*sizes[variant], joint, spread)
            grey = noise.mottled(_MOTTLED[name])
            painted = shade * (grey * (0.55 + 0.45 * is_slab))[..., None]
        case _:
            painted = noise.mottled(_MOTTLED[name])
    return painted


_THINGS = ("side", "pane", "wheel", "plate", "lamp", "sign", "poster", "cloth")
"""Materials whose textures have figures."""


def _paint_thing(name: str, noise: _Noise, variant: int) -> Plane | Picture:
    """Paint one variant of a texture with figures, grey or in colours."""
    colored = np.ones((SIDE_PX, SIDE_PX, 3), np.float32)
    rng = noise.rng
    match name:
        case "side":  # a car's flank from rear (u = 0) to front, sill to roof: doors, handles
            grey = 1 + 0.04 * noise.broad() + 0.1 * np.clip((_y - 0.2) * 2, -0.5, 0.6)
            is_door = (_y > 0.16) & (_y < 0.62)
            for where in ((0.3, 0.5, 0.7), (0.34, 0.68), (0.28, 0.49, 0.72))[variant]:
                grey -= 0.8 * np.clip(1 - np.abs(_x - where) / 0.006, 0, 1) * is_door
                handle = (np.abs(_x - where - 0.04) < 0.018) & (np.abs(_y - 0.52) < 0.01)
                grey[handle] = 0.35
            grey[np.abs(_y - 0.34) < 0.012 * (variant > 0)] *= 0.55
            grey[_y < 0.15] *= 0.3
            dirt = np.clip((0.32 - _y) * 3, 0, 1) * (0.5 + 0.3 * noise.rough())
            return grey * (1 - 0.35 * dirt)
        case "pane":  # curtains, blinds, or the dark of a room
            curtain = np.clip(np.abs(_x - 0.5) * 2 - 0.55, 0, 1) * 2.5 * (1 + 0.3 * np.sin(_x * 90))
            blind = 0.35 * np.sign(np.sin(_y * np.pi * 40)) * (_y > (0.2, 0.55, 2)[variant])
            return 0.75 + 0.4 * _y + 0.15 * noise.broad() + curtain * (variant != 1) + blind
        case "wheel":
            y = _y - 0.5
            x = _x - 0.5
            turn = np.arctan2(y, x)
            out = np.hypot(x, y)
            spokes = np.cos(turn * (5, 7)[variant]) > -0.1
            return np.where((spokes | (out > 0.42) | (out < 0.12)), 1.1, 0.15).astype(np.float32)
        case "plate":
            for x in range(22, 22 + 7 * 31, 31):
                colored[10:50, x : x + int(rng.integers(8, 22))] = 0.08
            colored[:, :14] = (0.1, 0.2, 0.9)
        case "lamp":
            noise.broad()  # drawn, so that the numbers after it stay those of earlier scenes
            return 1 + 0.15 * np.sign(np.sin(_x * 40 * np.pi))
        case "sign":  # dark figures on a light ground: bars, arrows, words
            colors = [(0.1, 0.1, 0.1), (0.05, 0.05, 0.05), (1.0, 0.08, 0.08), (0.1, 0.2, 0.9)]
            color = np.array(colors[variant % 4])
            for _ in range((3, 5, 8, 14, 24, 4)[variant]):
                width = rng.integers(10, 110)
                height = rng.integers(8, 60)
                x = rng.integers(30, 220 - width // 2)
                y = rng.integers(30, 220 - height // 2)
                colored[y : y + height, x : x + width] = color * rng.uniform(0.5, 1.2)
        case "poster":
            for _ in range(50):
                width = rng.integers(6, 90)
                height = rng.integers(4, 60)
                x, y = rng.integers(0, SIDE_PX, 2)
                colored[y : y + height, x : x + width] = rng.uniform(0.05, 1.4, 3)
        case _:  # cloth
            stripes = np.sign(np.sin(_x[:1] * 2 * np.pi * 6)) * (0, 0.18, 0, 0.3)[variant]
            folds = noise.smooth(2.0, (2, 30), (0.4, 1))
            return 1 + 0.16 * folds + 0.07 * noise.fine() + stripes
    return colored


Rotation = Float[np.ndarray, "3 3"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Mesh:
    """Triangles without shared corners."""

    corners: Float32[np.ndarray, "n 3 3"]  # positions [m]
    uv: Float32[np.ndarray, "n 3 2"]  # place in the texture, in tiles
    normals: Float32[np.ndarray, "n 3 3"]  # at the corners, smooth where the surface is round
    tint: Float32[np.ndarray, "n 3"]  # linear colour
    material: Int[np.ndarray, " n"]  # number of the material
    layer: Int[np.ndarray, " n"]  # number of the texture
    thing: Int[np.ndarray, " n"]  # number of the object to which the triangle belongs

    def __len__(self) -> int:
        return len(self.corners)

    def part(self, is_part: Bool[np.ndarray, " n"]) -> "Mesh":
        """Give the mesh of the triangles of a mask."""
        return Mesh(**{field.name: getattr(self, field.name)[is_part] for field in fields(Mesh)})


def join(meshes: Sequence[Mesh]) -> Mesh:
    """Join meshes to one."""
    parts = {f.name: [getattr(mesh, f.name) for mesh in meshes] for f in fields(Mesh)}
    return Mesh(**{name: np.concatenate(values) for name, values in parts.items()})


def place(
    mesh: Mesh,
    position: Values,
    yaw_rad: Number = 0.0,
    scale: Values = 1.0,
    tints: Mapping[str, Color] | None = None,
) -> Mesh:
    """Copy a model to a position.

    Args:
        mesh: the model, at the origin.
        position: where it stands [m].
        yaw_rad: rotation about y; a positive one rotates z towards x, to the right.
        scale: factor of its size, or one for each axis.
        tints: colours by which those of materials are multiplied.
    """
    factor = np.broadcast_to(np.asarray(scale, np.float32), 3)
    c = np.cos(yaw_rad)
    s = np.sin(yaw_rad)
    R = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]).astype(np.float32)
    corners = (mesh.corners * factor) @ R.T + np.asarray(position, np.float32)
    tint = mesh.tint
    for material, color in (tints or {}).items():
        is_of_material = (mesh.material == NUMBER[material])[:, None]
        tint = np.where(is_of_material, tint * np.asarray(color, np.float32), tint)
    return replace(mesh, corners=corners, normals=mesh.normals @ R.T, tint=tint)


NEAREST_M = 2.5
"""Least distance of a model from the camera: with a baseline of 0.53 m and half of KITTI's
resolution that is a disparity of 77 px."""

_CUBE = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float32)
_FACES = [[0, 1, 3, 2], [5, 4, 6, 7], [4, 5, 1, 0], [2, 3, 7, 6], [4, 0, 2, 6], [1, 5, 7, 3]]
_FACE_WIDTH = [2, 2, 2, 2, 0, 0]
_FACE_HEIGHT = [1, 1, 0, 0, 1, 1]


@dataclass(eq=False)
class MeshBuilder:
    """Builds a mesh; every method adds triangles."""

    rng: np.random.Generator  # random numbers of all that is built
    thing: int = 0  # number of the object to which triangles belong
    _parts: list[Mesh] = field(default_factory=list)
    _boxes: list[tuple] = field(default_factory=list)

    def add(self, mesh: Mesh) -> None:
        """Add a placed model as one object, unless it is nearer than ``NEAREST_M``."""
        if len(mesh) and np.hypot(mesh.corners[..., 0], mesh.corners[..., 2]).min() < NEAREST_M:
            return
        self.thing += 1
        self._parts.append(replace(mesh, thing=np.full(len(mesh), self.thing, np.int32)))

    def triangles(
        self,
        corners: Values,
        uv_m: Values,
        surface: Surface,
        normals: Values | None = None,
        tint: Values | None = None,
    ) -> None:
        """Add triangles (n, 3, 3) [m].

        ``uv_m`` holds coordinates on the surface [m], broadcast to (n, 3, 2). Without ``normals``
        they are those of the planes. ``tint``: a colour for each triangle, in place of the
        surface's.
        """
        positions = np.asarray(corners, np.float32)
        uv = np.asarray(uv_m, np.float32) / surface.tile_m
        material = NUMBER[surface.material]
        color = surface.tint if tint is None else tint
        self._parts.append(
            _make_mesh(positions, uv, normals, color, material, surface.layer, self.thing)
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
            normals = _split_quads(_broadcast(normals, (n, 4, 3)))
        if tint is not None:
            tint = np.tile(_broadcast(tint, (n, 3)), (2, 1))
        self.triangles(
            _split_quads(faces), _split_quads(_broadcast(uv_m, (n, 4, 2))), surface, normals, tint
        )

    def rectangle(self, corner: Values, along: Values, up: Values, surface: Surface) -> None:
        """Add one rectangle: a corner and its two sides [m]."""
        p, a, b = (np.asarray(v, np.float64) for v in (corner, along, up))
        width = np.linalg.norm(a)
        height = np.linalg.norm(b)
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
        """Add a box. Boxes are made all at once, in :meth:`finish`.

        Args:
            centre: centre of the box [m].
            size: along x, y and z, before it is rotated [m].
            surface: what it looks like.
            rotation: rotation of the box.
            taper: scales its upper face, toward -y.
        """
        R = np.eye(3) if rotation is None else rotation
        self._boxes.append((centre, size, R, taper, surface, self.thing))

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
        p = np.asarray(start, np.float64)
        q = np.asarray(stop, np.float64)
        length = float(np.linalg.norm(q - p))
        across, other = _perpendicular_axes((q - p) / length)
        angle = np.linspace(0, 2 * np.pi, sides + 1)
        ring = np.cos(angle)[:, None] * across + np.sin(angle)[:, None] * other
        low = p + ring * first
        high = q + ring * last
        around = angle * max(first, last)
        below, above = (np.stack([around, 0 * around + d], -1) for d in (0.0, length))
        self.quads(between(low, high), between(below, above), surface, between(ring, ring))

    def disc(
        self, centre: Values, axis: Values, radius_m: Number, surface: Surface, sides: int = 12
    ) -> None:
        """Add a flat polygon; its texture is one tile from side to side."""
        middle = np.asarray(centre, np.float64)
        direction = np.asarray(axis, np.float64)
        across, other = _perpendicular_axes(direction / np.linalg.norm(direction))
        angle = np.linspace(0, 2 * np.pi, sides + 1) + np.pi / sides
        rim_uv = np.stack([np.cos(angle), np.sin(angle)], -1)
        rim = middle + radius_m * (rim_uv[:, :1] * across + rim_uv[:, 1:] * other)
        uv = (0.5 + 0.5 * rim_uv) * surface.tile_m
        hub = np.broadcast_to(middle, rim.shape)
        hub_uv = np.full_like(uv, 0.5 * surface.tile_m)
        faces, places = (np.stack([c[1:], e[:-1], e[1:]], 1) for c, e in ((hub, rim), (hub_uv, uv)))
        self.triangles(faces, places, surface)

    def finish(self) -> Mesh:
        """Give the mesh of all triangles; boxes are made together, which is much faster."""
        if not self._boxes:
            return join(self._parts)

        # The eight corners of each box.
        centres, sizes, turns, tapers, surfaces, things = zip(*self._boxes, strict=True)
        centre, size, R, taper = (np.array(v, np.float32) for v in (centres, sizes, turns, tapers))
        vertices = _CUBE * (size / 2)[:, None]
        vertices[:, _CUBE[:, 1] < 0] *= np.stack([taper, 0 * taper + 1, taper], 1)[:, None]
        vertices = np.einsum("kij,kvj->kvi", R, vertices) + centre[:, None]

        # Its six faces, each of two triangles.
        uv = np.zeros((len(surfaces), 6, 4, 2), np.float32)
        tile = np.array([surface.tile_m for surface in surfaces], np.float32)[:, None]
        uv[:, :, 1:3, 0] = (size[:, _FACE_WIDTH] / tile)[:, :, None]
        uv[:, :, 2:, 1] = (size[:, _FACE_HEIGHT] / tile)[:, :, None]
        row = np.tile(np.repeat(np.arange(len(surfaces)), 6), 2)  # six faces, in both halves
        boxes = _make_mesh(
            _split_quads(vertices[:, _FACES].reshape(-1, 4, 3)),
            _split_quads(uv.reshape(-1, 4, 2)),
            None,
            np.array([surface.tint for surface in surfaces])[row],
            np.array([NUMBER[surface.material] for surface in surfaces])[row],
            np.array([surface.layer for surface in surfaces])[row],
            np.array(things)[row],
        )
        self._parts = [*self._parts, boxes]
        self._boxes = []
        return join(self._parts)


def _make_mesh(
    corners: Float32[np.ndarray, "n 3 3"],
    uv: Values,
    normals: Values | None,
    tint: Values,
    material: Values,
    layer: Values,
    thing: Values,
) -> Mesh:
    """Make a mesh of triangles; values are broadcast to them.

    Without ``normals`` they are those of the planes.
    """
    n = len(corners)
    corner_normals = normals
    if corner_normals is None:
        (ax, ay, az), (bx, by, bz) = ((corners[:, k] - corners[:, 0]).T for k in (1, 2))
        across = np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], 1)
        length = np.sqrt((across**2).sum(1, keepdims=True))
        corner_normals = (across / (length + 1e-12))[:, None]

    def for_each(number: Values) -> Int[np.ndarray, " n"]:
        """Repeat a number for each triangle, or take one for each."""
        return np.array(np.broadcast_to(number, n), np.int32)

    return Mesh(
        corners=corners,
        uv=_broadcast(uv, (n, 3, 2)),
        normals=_broadcast(corner_normals, (n, 3, 3)),
        tint=_broadcast(np.clip(tint, 0.005, 0.97), (n, 3)),
        material=for_each(material),
        layer=for_each(layer),
        thing=for_each(thing),
    )


def _broadcast(values: Values, shape: tuple[int, ...]) -> Float32[np.ndarray, "..."]:
    """Broadcast values to a shape, as a new array of float32."""
    return np.ascontiguousarray(np.broadcast_to(np.asarray(values, np.float32), shape))


def between(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Give the four-cornered faces (n - 1, 4, ...) between two rows of n points."""
    return np.stack([low[:-1], low[1:], high[1:], high[:-1]], 1)


def _split_quads(faces: np.ndarray) -> np.ndarray:
    """Split four-cornered faces into triangles: all first halves, then all second ones."""
    return np.concatenate([faces[:, [0, 1, 2]], faces[:, [0, 2, 3]]])


def _perpendicular_axes(direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Give two unit vectors perpendicular to a direction and to each other."""
    aside = np.array([0.0, 1, 0]) if abs(direction[1]) < 0.9 else np.array([0.0, 0, 1])
    across = np.cross(aside, direction)
    across /= np.linalg.norm(across)
    return across, np.cross(direction, across)
