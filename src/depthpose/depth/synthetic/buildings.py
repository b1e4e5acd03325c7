"""Houses: walls with recessed windows, doors, roofs, balconies and shop fronts."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from depthpose.depth.synthetic.mesh import Color, MeshBuilder, Number, Surface

_PLASTERS: list[Color] = [
    (0.62, 0.57, 0.46), (0.58, 0.47, 0.26), (0.5, 0.5, 0.5), (0.55, 0.36, 0.28), (0.36, 0.4, 0.35),
    (0.75, 0.73, 0.68), (0.45, 0.33, 0.24),
]  # fmt: skip
_ROOFS: list[Color] = [(0.2, 0.075, 0.045), (0.06, 0.06, 0.067), (0.14, 0.08, 0.06)]
_FRAMES: list[Color] = [(0.75, 0.75, 0.73), (0.07, 0.045, 0.03), (0.03, 0.033, 0.036)]
_SQUARE = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
_UP = np.array([0.0, -1, 0])
_AHEAD = np.array([0.0, 0, 1])


class Style(NamedTuple):
    """Style of the walls of one house."""

    wall: Surface
    storey_m: Number
    window_m: tuple[Number, Number]  # width and height
    gap_m: Number  # wall between two windows
    recess_m: float  # depth of the panes behind the wall
    frame: Color  # colour of the frames of windows
    with_details: bool  # sills, frames and gutters; left out where they are finer than a pixel


class Plot(NamedTuple):
    """Position and size of a house along a straight street."""

    x_m: Number  # its front, which faces the street
    start_m: Number  # along the street
    stop_m: Number
    side: int  # 1 on the right of the street, -1 on the left
    depth_m: Number  # distance from front to back
    height_m: float  # height of the walls
    ground_m: Number  # y of the ground


def add_house(b: MeshBuilder, plot: Plot, *, with_details: bool) -> None:
    """Add one house: its walls, of which the back and one end have no windows, and a roof."""
    # Material of the walls, and sizes of the windows.
    kind = str(b.rng.choice(["brick", "plaster", "stone"], p=[0.24, 0.6, 0.16]))
    base = {"brick": (0.3, 0.12, 0.08), "stone": (0.3, 0.26, 0.22)}.get(
        kind, _PLASTERS[b.rng.integers(len(_PLASTERS))]
    )
    red, green, blue = np.array(base) * b.rng.uniform(0.4, 1.0) * (1 + 0.08 * b.rng.normal(size=3))
    tile_m = {"brick": 1.8, "stone": 2.6, "plaster": 3.4}[kind] * b.rng.uniform(0.85, 1.2)
    style = Style(
        wall=Surface(kind, (red, green, blue), tile_m, int(b.rng.integers(8))),
        storey_m=b.rng.uniform(2.7, 3.5),
        window_m=(b.rng.uniform(0.8, 1.7), b.rng.uniform(1.1, 1.9)),
        gap_m=b.rng.uniform(0.6, 1.9),
        recess_m=b.rng.uniform(0.06, 0.25),
        frame=_FRAMES[b.rng.choice(3, p=[0.6, 0.2, 0.2])],
        with_details=with_details,
    )

    # Four walls: the front, the near end, the far end and the back.
    b.thing += 1
    away = np.array([float(plot.side), 0, 0])
    length = plot.stop_m - plot.start_m
    back_m = plot.x_m + plot.side * plot.depth_m
    for x, z, along, outward, size, has_windows in (
        (plot.x_m, plot.start_m, _AHEAD, -away, length, True),
        (plot.x_m, plot.start_m, away, -_AHEAD, plot.depth_m, True),
        (plot.x_m, plot.stop_m, away, _AHEAD, plot.depth_m, False),
        (back_m, plot.start_m, _AHEAD, away, length, False),
    ):
        wall = _Wall(np.array([x, plot.ground_m, z]), along, outward)
        if has_windows and size >= 2.2:
            _add_windows(b, wall, style, size, plot.height_m)
        else:
            face = _SQUARE * [size, plot.height_m]
            b.quads([wall.at(face)], [face], style.wall)

    # A gable roof, or a flat one, at times with a structure on it.
    if b.rng.random() < 0.7:
        _add_gable_roof(b, plot, style)
    else:
        top = plot.ground_m - plot.height_m
        middle = plot.x_m + plot.side * plot.depth_m / 2
        tar = Surface("concrete", (0.3, 0.3, 0.3), 3.0)
        z = (plot.start_m + plot.stop_m) / 2
        b.box((middle, top - 0.1, z), (plot.depth_m + 0.4, 0.35, length + 0.4), tar)
        if b.rng.random() < 0.5:
            z = b.rng.uniform(plot.start_m + 2, plot.stop_m - 2)
            b.box((middle, top - 1.2, z), (3, 2, 3), tar)
    if style.with_details:
        _add_trim(b, plot, style)


class _Wall(NamedTuple):
    """A wall's own frame: from a bottom corner along it, up, and outwards."""

    corner: Float[np.ndarray, "3"]
    along: Float[np.ndarray, "3"]
    outward: Float[np.ndarray, "3"]

    def at(self, across_up: np.ndarray, out_m: Number = 0.0) -> np.ndarray:
        """Convert points (..., 2) on the wall [m] to space, ``out_m`` in front of it."""
        points = self.corner + across_up[..., :1] * self.along + across_up[..., 1:] * _UP
        return points + out_m * self.outward


def _add_windows(b: MeshBuilder, wall: _Wall, style: Style, length: Number, height: Number) -> None:
    """Add a wall with windows, recessed panes and, with details, frames and sills.

    The wall is divided into a grid; cells of an odd row and an odd column are windows.
    """
    rng = b.rng

    # The lines of the grid, and its cells.
    width, tall = style.window_m
    count = max(1, int(length // (width + style.gap_m)))
    storeys = max(1, int((height - 0.5) // style.storey_m))
    left = (np.arange(count) + 0.5) * (length / count) - width / 2
    sill = np.arange(storeys) * style.storey_m + 0.9
    top = np.minimum(sill + tall, height - 0.15)
    columns = np.concatenate([[0], np.stack([left, left + width], 1).ravel(), [length]])
    rows = np.concatenate([[0], np.stack([sill, top], 1).ravel(), [height]])
    x0, y0 = np.meshgrid(columns[:-1], rows[:-1], indexing="ij")
    x1, y1 = np.meshgrid(columns[1:], rows[1:], indexing="ij")
    cells = _rectangles(x0, x1, y0, y1)
    is_window = np.zeros(cells.shape[:2], bool)
    is_window[1::2, 1::2] = True
    panels = cells[~is_window]
    windows = cells[is_window]

    # The wall, and panes behind it, some of them covered by blinds or curtains.
    b.quads(wall.at(panels), panels + rng.uniform(0, 5, 2), style.wall)
    outer = wall.at(windows)
    inner = wall.at(windows, -style.recess_m)
    count = len(windows)
    uv = _SQUARE + rng.integers(0, 8, (count, 1, 2))
    is_covered = rng.random((count, 1)) < 0.3
    dark = np.array([0.05, 0.06, 0.07]) * rng.uniform(0.3, 2.0, (count, 1))
    covered = np.array([0.35, 0.33, 0.28]) * rng.uniform(0.5, 1.2, (count, 1))
    pane = Surface("pane", (1, 1, 1), 1.0, int(rng.integers(3)))
    b.quads(inner, uv, pane, tint=np.where(is_covered, covered, dark))

    # The sides of the recesses.
    after = [1, 2, 3, 0]
    reveal = np.stack([outer, outer[:, after], inner[:, after], inner], 2).reshape(-1, 4, 3)
    b.quads(reveal, _SQUARE * [0.5, 0.1], Surface("plaster", style.wall.tint))
    if not style.with_details:
        return

    # Frames: at four sides of each window, and a bar in the middle.
    left, low = windows[:, 0].T
    right, high = windows[:, 2].T
    middle = (left + right) / 2
    bar = 0.07
    frames = np.concatenate(
        [
            _rectangles(left, left + bar, low, high),
            _rectangles(right - bar, right, low, high),
            _rectangles(middle - bar / 2, middle + bar / 2, low, high),
            _rectangles(left, right, high - bar, high),
            _rectangles(left, right, low, low + bar),
        ]
    )
    b.quads(wall.at(frames, 0.03 - style.recess_m), frames, Surface("wood", style.frame))

    # Sills: their fronts and tops.
    sill = _rectangles(left - 0.1, right + 0.1, low - 0.09, low)
    front = wall.at(sill, 0.12)
    stone = Surface("concrete", (0.4, 0.39, 0.36))
    b.quads(front, sill, stone)
    top = np.stack([front[:, 3], front[:, 2], wall.at(sill)[:, 2], wall.at(sill)[:, 3]], 1)
    b.quads(top, _SQUARE * [1, 0.12], stone)


def _rectangles(x0: np.ndarray, x1: np.ndarray, y0: np.ndarray, y1: np.ndarray) -> np.ndarray:
    """Give the corners (..., 4, 2) of rectangles between x0 and x1, y0 and y1, in order."""
    return np.stack([np.stack(c, -1) for c in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))], -2)


def _add_gable_roof(b: MeshBuilder, plot: Plot, style: Style) -> None:
    """Add a gable roof with its ridge along the street, gables, a chimney and at times dormers."""
    rng = b.rng
    start = plot.start_m
    stop = plot.stop_m
    side = plot.side
    rise = rng.uniform(1.8, 4.2)
    over = rng.uniform(0.2, 0.5)
    half = plot.depth_m / 2
    top = plot.ground_m - plot.height_m
    ridge_x = plot.x_m + side * half
    slate = Surface("roof", _ROOFS[rng.integers(len(_ROOFS))], 2.4, int(rng.integers(3)))
    slope = np.hypot(half + over, rise)

    # Both slopes, which go on below the walls' top over the eaves, and the gables.
    eave_y = top + rise * over / half
    first = start - over
    last = stop + over
    for sign in (-1, 1):
        x = ridge_x + sign * (half + over)
        face = [(x, eave_y, first), (x, eave_y, last),
                (ridge_x, top - rise, last), (ridge_x, top - rise, first)]  # fmt: skip
        b.quads([face], [_SQUARE * [last - first, slope]], slate)
        board = [*face[:2], (x, eave_y + 0.15, last), (x, eave_y + 0.15, first)]
        b.quads([board], [_SQUARE], Surface("wood", style.frame))
    for z in (start, stop):
        gable = [(ridge_x - half, top, z), (ridge_x + half, top, z), (ridge_x, top - rise, z)]
        b.triangles([gable], [[[0, 0], [plot.depth_m, 0], [half, rise]]], style.wall)

    # A chimney, and at times dormers.
    x = ridge_x + rng.uniform(-1, 1) * half * 0.5
    z = rng.uniform(start + 1, stop - 1)
    chimney = Surface("brick", (0.28, 0.13, 0.09), 1.8)
    b.box((x, top - rise * 0.8, z), (0.6, 1.8, 0.6), chimney)
    if rng.random() < 0.5:
        glass = Surface("pane", (0.05, 0.055, 0.06))
        x = plot.x_m + side * half * 0.45
        front = x - side * (half * 0.25 + 0.01)
        for z in np.arange(start + 2, stop - 2, rng.uniform(3, 5)):
            b.box((x, top - rise * 0.5, z), (half * 0.5, rise * 0.5, 1.5), style.wall)
            corner = (front, top - rise * 0.32, z - 0.5)
            b.rectangle(corner, (0, 0, 1.0), (0, -rise * 0.35, 0), glass)


def _add_trim(b: MeshBuilder, plot: Plot, style: Style) -> None:
    """Add a plinth, a rain pipe and a door; at times balconies or a shop."""
    rng = b.rng
    x = plot.x_m
    y = plot.ground_m
    side = plot.side
    start = plot.start_m
    stop = plot.stop_m
    middle = (start + stop) / 2
    length = stop - start

    # Plinth, rain pipe and door.
    plinth = Surface("stone", (0.2, 0.19, 0.18), 2.0)
    b.box((x, y - 0.25, middle), (0.12, 0.6, length), plinth)
    foot, head = ((x - side * 0.07, at, start + 0.3) for at in (y, y - plot.height_m))
    b.tube(foot, head, 0.05, Surface("metal", (0.2, 0.18, 0.15)))
    door_z = rng.uniform(start + 1, stop - 1.5)
    door = Surface("wood", tuple(rng.uniform(0.03, 0.35, 3)), 1.0, int(rng.integers(2)))
    b.box((x, y - 1.05, door_z), (0.1, 2.1, 1.1), door)

    if rng.random() < 0.25:  # a balcony on each storey above the first, one above the other
        slab = Surface("concrete", (0.42, 0.42, 0.4), 2.0)
        rail = Surface("metal", (0.05, 0.05, 0.05))
        z = rng.uniform(start + 1.5, stop - 1.5)
        outer = x - side * 0.98
        for storey in range(1, int((plot.height_m - 0.6) // style.storey_m)):
            up = y - storey * style.storey_m
            b.box((x - side * 0.5, up, z), (1.0, 0.14, 2.4), slab)
            for shift in np.linspace(-1.2, 1.2, 9):
                b.box((outer, up - 0.5, z + shift), (0.03, 0.9, 0.03), rail)
            b.box((outer, up - 0.97, z), (0.05, 0.05, 2.45), rail)

    if rng.random() < 0.25:  # a shop window, a board above it, perhaps an awning
        width = min(5.0, length - 1)
        glass = Surface("pane", (0.12, 0.12, 0.12), 2.5)
        b.box((x - side * 0.02, y - 1.3, middle), (0.06, 2.0, width), glass)
        board = Surface("poster", tuple(rng.uniform(0.2, 0.9, 3)), 2.0, int(rng.integers(4)))
        b.box((x - side * 0.1, y - 3.0, middle), (0.15, 0.6, width), board)
        if rng.random() < 0.5:
            low = y - 2.3
            high = y - 2.75
            out = x - side * 1.3
            first = middle - width / 2
            last = middle + width / 2
            face = [(out, low, first), (out, low, last), (x, high, last), (x, high, first)]
            cloth = Surface("cloth", tuple(rng.uniform(0.05, 0.7, 3)))
            b.quads([face], [_SQUARE * [width, 1.4]], cloth)
