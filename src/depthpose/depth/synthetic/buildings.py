"""Houses: walls with recessed windows, doors, roofs, balconies and shop fronts."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from depthpose.depth.synthetic.mesh import MeshBuilder
from depthpose.depth.synthetic.textures import Color, Number, Surface

_PLASTERS: list[Color] = [
    (0.62, 0.57, 0.46), (0.58, 0.47, 0.26), (0.5, 0.5, 0.5), (0.55, 0.36, 0.28), (0.36, 0.4, 0.35),
    (0.75, 0.73, 0.68), (0.45, 0.33, 0.24),
]  # fmt: skip
_ROOFS: list[Color] = [(0.2, 0.075, 0.045), (0.06, 0.06, 0.067), (0.14, 0.08, 0.06)]
_FRAMES: list[Color] = [(0.75, 0.75, 0.73), (0.07, 0.045, 0.03), (0.03, 0.033, 0.036)]
_SQUARE = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])


class Style(NamedTuple):
    """What the walls of one house have in common.

    Attributes:
        wall: what they are made of.
        storey_m: height of a storey.
        window_m: width and height of a window.
        gap_m: wall between two windows.
        recess_m: how deep the panes lie.
        frame: colour of the window frames.
        with_details: sills, frames and gutters; left out where too far away to be seen.
    """

    wall: Surface
    storey_m: Number
    window_m: tuple[Number, Number]
    gap_m: Number
    recess_m: float
    frame: Color
    with_details: bool


class Plot(NamedTuple):
    """Place of a house along a straight street.

    Attributes:
        x_m: its front, which looks to the street.
        z_m: start and end along the street.
        side: 1 on the right of the street, -1 on the left.
        depth_m: from front to back.
        height_m: of the walls.
        ground_m: y of the ground.
    """

    x_m: Number
    z_m: tuple[Number, Number]
    side: int
    depth_m: Number
    height_m: float
    ground_m: Number


class _Wall(NamedTuple):
    """A wall's own frame: from a bottom corner along it, up, and outwards."""

    corner: Float[np.ndarray, "3"]
    along: Float[np.ndarray, "3"]
    outward: Float[np.ndarray, "3"]
    length_m: Number
    height_m: float

    def at(self, across_up: np.ndarray, out_m: Number = 0.0) -> np.ndarray:
        """Points (..., 2) on the wall [m] to space."""
        up = np.array([0.0, -1, 0])
        points = self.corner + across_up[..., :1] * self.along + across_up[..., 1:] * up
        return points + out_m * self.outward


def draw_style(rng: np.random.Generator, *, with_details: bool) -> Style:
    """Draw what a house looks like."""
    kind = str(rng.choice(["brick", "plaster", "stone"], p=[0.24, 0.6, 0.16]))
    base = {"brick": (0.3, 0.12, 0.08), "stone": (0.3, 0.26, 0.22)}.get(
        kind, _PLASTERS[rng.integers(len(_PLASTERS))]
    )
    r, g, b = np.array(base) * rng.uniform(0.4, 1.0) * (1 + 0.08 * rng.normal(size=3))
    tile_m = {"brick": 1.8, "stone": 2.6, "plaster": 3.4}[kind] * rng.uniform(0.85, 1.2)
    return Style(
        wall=Surface(kind, (r, g, b), tile_m, int(rng.integers(8))),
        storey_m=rng.uniform(2.7, 3.5),
        window_m=(rng.uniform(0.8, 1.7), rng.uniform(1.1, 1.9)),
        gap_m=rng.uniform(0.6, 1.9),
        recess_m=rng.uniform(0.06, 0.25),
        frame=_FRAMES[rng.choice(3, p=[0.6, 0.2, 0.2])],
        with_details=with_details,
    )


def add_house(builder: MeshBuilder, rng: np.random.Generator, plot: Plot, style: Style) -> None:
    """Add one house."""
    builder.begin_thing()
    for wall, windows in _walls(plot):
        _add_wall(builder, rng, wall, style if windows else None, style.wall)
    if rng.random() < 0.7:
        _add_gable_roof(builder, rng, plot, style)
    else:
        _add_flat_roof(builder, rng, plot)
    if style.with_details:
        _add_trim(builder, rng, plot, style)


def _walls(plot: Plot) -> list[tuple[_Wall, bool]]:
    """Front, the two ends and the back; the back has no windows, for nobody sees it."""
    (start, stop), side, ground = plot.z_m, plot.side, plot.ground_m
    ahead, away = np.array([0.0, 0, 1]), np.array([float(side), 0, 0])
    front, back = plot.x_m, plot.x_m + side * plot.depth_m
    length = stop - start
    wall = lambda x, z, along, outward, size: _Wall(  # noqa: E731
        np.array([x, ground, z]), along, outward, size, plot.height_m
    )
    return [
        (wall(front, start, ahead, -away, length), True),
        (wall(front, start, away, -ahead, plot.depth_m), True),
        (wall(front, stop, away, ahead, plot.depth_m), False),
        (wall(back, start, ahead, away, length), False),
    ]


def _add_wall(
    builder: MeshBuilder,
    rng: np.random.Generator,
    wall: _Wall,
    style: Style | None,
    surface: Surface,
) -> None:
    length, height = wall.length_m, wall.height_m
    if style is None or length < 2.2:
        face = _SQUARE * [length, height]
        builder.quads([wall.at(face)], [face], surface)
        return
    columns, rows = _grid(style, length, height)
    panels, windows = _cut(columns, rows)
    offset = rng.uniform(0, 5, 2)
    builder.quads(wall.at(panels), panels + offset, surface)
    _add_windows(builder, rng, wall, style, windows)


def _grid(style: Style, length: Number, height: float) -> tuple[np.ndarray, np.ndarray]:
    """Lines across and up between which windows (odd places) and wall (even ones) lie."""
    width, tall = style.window_m
    count = max(1, int(length // (width + style.gap_m)))
    storeys = max(1, int((height - 0.5) // style.storey_m))
    pitch = length / count
    left = (np.arange(count) + 0.5) * pitch - width / 2
    sill = np.arange(storeys) * style.storey_m + 0.9
    top = np.minimum(sill + tall, height - 0.15)
    columns = np.concatenate([[0], np.stack([left, left + width], 1).ravel(), [length]])
    rows = np.concatenate([[0], np.stack([sill, top], 1).ravel(), [height]])
    return columns, rows


def _cut(columns: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cells (n, 4, 2) of the grid that are wall, and those that are windows."""
    low = np.stack(np.meshgrid(columns[:-1], rows[:-1], indexing="ij"), -1)
    high = np.stack(np.meshgrid(columns[1:], rows[1:], indexing="ij"), -1)
    corners = [low, np.stack([high[..., 0], low[..., 1]], -1),
               high, np.stack([low[..., 0], high[..., 1]], -1)]  # fmt: skip
    cells = np.stack(corners, -2)
    is_window = np.zeros(cells.shape[:2], bool)
    is_window[1::2, 1::2] = True
    return cells[~is_window], cells[is_window]


def _add_windows(
    builder: MeshBuilder,
    rng: np.random.Generator,
    wall: _Wall,
    style: Style,
    windows: Float[np.ndarray, "n 4 2"],
) -> None:
    count = len(windows)
    outer, inner = wall.at(windows), wall.at(windows, -style.recess_m)
    uv = _SQUARE + rng.integers(0, 8, (count, 1, 2))
    is_covered = rng.random((count, 1)) < 0.3  # by blinds or curtains
    dark = np.array([0.05, 0.06, 0.07]) * rng.uniform(0.3, 2.0, (count, 1))
    covered = np.array([0.35, 0.33, 0.28]) * rng.uniform(0.5, 1.2, (count, 1))
    pane = Surface("pane", (1, 1, 1), 1.0, int(rng.integers(3)))
    builder.quads(inner, uv, pane, tint=np.where(is_covered, covered, dark))
    after = [1, 2, 3, 0]
    reveal = np.stack([outer, outer[:, after], inner[:, after], inner], 2).reshape(-1, 4, 3)
    builder.quads(reveal, _SQUARE * [0.5, 0.1], Surface("plaster", style.wall.tint))
    if style.with_details:
        _add_frames(builder, wall, style, windows)


def _add_frames(
    builder: MeshBuilder, wall: _Wall, style: Style, windows: Float[np.ndarray, "n 4 2"]
) -> None:
    left, right = windows[:, 0, 0], windows[:, 1, 0]
    low, high = windows[:, 0, 1], windows[:, 2, 1]
    middle, bar = (left + right) / 2, 0.07
    cells = lambda x0, x1, y0, y1: np.stack(  # noqa: E731
        [np.stack(corner, 1) for corner in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))], 1
    )
    frames = np.concatenate(
        [
            cells(left, left + bar, low, high),
            cells(right - bar, right, low, high),
            cells(middle - bar / 2, middle + bar / 2, low, high),
            cells(left, right, high - bar, high),
            cells(left, right, low, low + bar),
        ]
    )
    builder.quads(wall.at(frames, 0.03 - style.recess_m), frames, Surface("wood", style.frame))
    sill = cells(left - 0.1, right + 0.1, low - 0.09, low)
    front = wall.at(sill, 0.12)
    stone = Surface("concrete", (0.4, 0.39, 0.36))
    builder.quads(front, sill, stone)
    top = np.stack([front[:, 3], front[:, 2], wall.at(sill)[:, 2], wall.at(sill)[:, 3]], 1)
    builder.quads(top, _SQUARE * [1, 0.12], stone)


def _add_gable_roof(
    builder: MeshBuilder, rng: np.random.Generator, plot: Plot, style: Style
) -> None:
    """Two slopes over the eaves, the ridge along the street, and the walls' triangles below."""
    (start, stop), side = plot.z_m, plot.side
    rise, over = rng.uniform(1.8, 4.2), rng.uniform(0.2, 0.5)
    half, top = plot.depth_m / 2, plot.ground_m - plot.height_m
    ridge_x = plot.x_m + side * half
    slate = Surface("roof", _ROOFS[rng.integers(len(_ROOFS))], 2.4, int(rng.integers(3)))
    slope = np.hypot(half + over, rise)
    drop = rise * over / half  # the slopes go on, below the walls' top, over the eaves
    first, last = start - over, stop + over
    for sign in (-1, 1):
        eave = ridge_x + sign * (half + over)
        face = [(eave, top + drop, first), (eave, top + drop, last),
                (ridge_x, top - rise, last), (ridge_x, top - rise, first)]  # fmt: skip
        builder.quads([face], [_SQUARE * [last - first, slope]], slate)
        board = [(eave, top + drop, first), (eave, top + drop, last),
                 (eave, top + drop + 0.15, last), (eave, top + drop + 0.15, first)]  # fmt: skip
        builder.quads([board], [_SQUARE], Surface("wood", style.frame))
    for z in (start, stop):
        gable = [(ridge_x - half, top, z), (ridge_x + half, top, z), (ridge_x, top - rise, z)]
        builder.triangles([gable], [[[0, 0], [plot.depth_m, 0], [half, rise]]], style.wall)
    where = (
        ridge_x + rng.uniform(-1, 1) * half * 0.5,
        top - rise * 0.8,
        rng.uniform(start + 1, stop - 1),
    )
    builder.box(where, (0.6, 1.8, 0.6), Surface("brick", (0.28, 0.13, 0.09), 1.8))
    if rng.random() < 0.5:
        _add_dormer(builder, rng, plot, style, rise)


def _add_dormer(
    builder: MeshBuilder, rng: np.random.Generator, plot: Plot, style: Style, rise: float
) -> None:
    top, half = plot.ground_m - plot.height_m, plot.depth_m / 2
    for z in np.arange(plot.z_m[0] + 2, plot.z_m[1] - 2, rng.uniform(3, 5)):
        x = plot.x_m + plot.side * half * 0.45
        builder.box((x, top - rise * 0.5, z), (half * 0.5, rise * 0.5, 1.5), style.wall)
        front = x - plot.side * (half * 0.25 + 0.01)
        glass = Surface("pane", (0.05, 0.055, 0.06))
        builder.rectangle(
            (front, top - rise * 0.32, z - 0.5), (0, 0, 1.0), (0, -rise * 0.35, 0), glass
        )


def _add_flat_roof(builder: MeshBuilder, rng: np.random.Generator, plot: Plot) -> None:
    (start, stop), side = plot.z_m, plot.side
    top, middle = plot.ground_m - plot.height_m, plot.x_m + side * plot.depth_m / 2
    tar = Surface("concrete", (0.3, 0.3, 0.3), 3.0)
    size = (plot.depth_m + 0.4, 0.35, stop - start + 0.4)
    builder.box((middle, top - 0.1, (start + stop) / 2), size, tar)
    if rng.random() < 0.5:
        builder.box((middle, top - 1.2, rng.uniform(start + 2, stop - 2)), (3, 2, 3), tar)


def _add_trim(builder: MeshBuilder, rng: np.random.Generator, plot: Plot, style: Style) -> None:
    (start, stop), side, ground = plot.z_m, plot.side, plot.ground_m
    x, middle, length = plot.x_m, (start + stop) / 2, stop - start
    top = ground - plot.height_m
    builder.box(
        (x, ground - 0.25, middle), (0.12, 0.6, length), Surface("stone", (0.2, 0.19, 0.18), 2.0)
    )
    pipe = Surface("metal", (0.2, 0.18, 0.15))
    builder.tube(
        (x - side * 0.07, ground, start + 0.3),
        (x - side * 0.07, top, start + 0.3),
        (0.05, 0.05),
        pipe,
    )
    door_z = rng.uniform(start + 1, stop - 1.5)
    door = Surface("wood", tuple(rng.uniform(0.03, 0.35, 3)), 1.0, int(rng.integers(2)))
    builder.box((x, ground - 1.05, door_z), (0.1, 2.1, 1.1), door)
    if rng.random() < 0.25:
        _add_balconies(builder, rng, plot, style)
    if rng.random() < 0.25:
        _add_shop(builder, rng, plot)


def _add_balconies(
    builder: MeshBuilder, rng: np.random.Generator, plot: Plot, style: Style
) -> None:
    slab, rail = Surface("concrete", (0.42, 0.42, 0.4), 2.0), Surface("metal", (0.05, 0.05, 0.05))
    z = rng.uniform(plot.z_m[0] + 1.5, plot.z_m[1] - 1.5)
    for storey in range(1, int((plot.height_m - 0.6) // style.storey_m)):
        y = plot.ground_m - storey * style.storey_m
        x = plot.x_m - plot.side * 0.5
        builder.box((x, y, z), (1.0, 0.14, 2.4), slab)
        outer = plot.x_m - plot.side * 0.98
        for shift in np.linspace(-1.2, 1.2, 9):
            builder.box((outer, y - 0.5, z + shift), (0.03, 0.9, 0.03), rail)
        builder.box((outer, y - 0.97, z), (0.05, 0.05, 2.45), rail)


def _add_shop(builder: MeshBuilder, rng: np.random.Generator, plot: Plot) -> None:
    """A shop window, an awning or a board above it."""
    x, y, side = plot.x_m, plot.ground_m, plot.side
    z, width = (plot.z_m[0] + plot.z_m[1]) / 2, min(5.0, plot.z_m[1] - plot.z_m[0] - 1)
    glass = Surface("pane", (0.12, 0.12, 0.12), 2.5)
    builder.box((x - side * 0.02, y - 1.3, z), (0.06, 2.0, width), glass)
    builder.box(
        (x - side * 0.1, y - 3.0, z),
        (0.15, 0.6, width),
        Surface("poster", tuple(rng.uniform(0.2, 0.9, 3)), 2.0, int(rng.integers(4))),
    )
    if rng.random() < 0.5:
        low, high, out = y - 2.3, y - 2.75, x - side * 1.3
        start, stop = z - width / 2, z + width / 2
        face = [(out, low, start), (out, low, stop), (x, high, stop), (x, high, start)]
        cloth = Surface("cloth", tuple(rng.uniform(0.05, 0.7, 3)))
        builder.quads([face], [_SQUARE * [width, 1.4]], cloth)
