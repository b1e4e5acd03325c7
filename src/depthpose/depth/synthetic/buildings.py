"""Houses: walls with recessed windows, doors, roofs, balconies and shop fronts."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from depthpose.depth.synthetic.materials import Appearance, Color, Number
from depthpose.depth.synthetic.mesh import UNIT_SQUARE, MeshBuilder

_PLASTERS: list[Color] = [
    (0.62, 0.57, 0.46), (0.58, 0.47, 0.26), (0.5, 0.5, 0.5), (0.55, 0.36, 0.28), (0.36, 0.4, 0.35),
    (0.75, 0.73, 0.68), (0.45, 0.33, 0.24),
]  # fmt: skip
_ROOFS: list[Color] = [(0.2, 0.075, 0.045), (0.06, 0.06, 0.067), (0.14, 0.08, 0.06)]
_FRAMES: list[Color] = [(0.75, 0.75, 0.73), (0.07, 0.045, 0.03), (0.03, 0.033, 0.036)]
_FRAME_SHARES = (0.6, 0.2, 0.2)
_UP = np.array([0.0, -1, 0])
_AHEAD = np.array([0.0, 0, 1])
_MIN_WINDOWED_WALL_M = 2.2
"""Shorter walls have no windows."""
_SILL_M = 0.9
"""Height of the sills above the floor."""


class Style(NamedTuple):
    """Style of the walls of one house."""

    wall: Appearance
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


def add_house(builder: MeshBuilder, plot: Plot, *, with_details: bool) -> None:
    """Add one house: its walls, of which the back and one end have no windows, and a roof."""
    rng = builder.rng
    style = _draw_style(rng, with_details=with_details)

    # Four walls: the front, the near end, the far end and the back.
    builder.begin_object()
    away = np.array([float(plot.side), 0, 0])
    length = plot.stop_m - plot.start_m
    back_m = plot.x_m + plot.side * plot.depth_m
    for x, z, along, outward, wall_m, has_windows in (
        (plot.x_m, plot.start_m, _AHEAD, -away, length, True),
        (plot.x_m, plot.start_m, away, -_AHEAD, plot.depth_m, True),
        (plot.x_m, plot.stop_m, away, _AHEAD, plot.depth_m, False),
        (back_m, plot.start_m, _AHEAD, away, length, False),
    ):
        wall = _Wall(np.array([x, plot.ground_m, z]), along, outward)
        if has_windows and wall_m >= _MIN_WINDOWED_WALL_M:
            _add_windowed_wall(builder, wall, style, wall_m, plot.height_m)
        else:
            face = UNIT_SQUARE * [wall_m, plot.height_m]
            builder.add_quads([wall.to_space(face)], [face], style.wall)

    if rng.random() < 0.7:
        _add_gable_roof(builder, plot, style)
    else:
        _add_flat_roof(builder, plot)
    if style.with_details:
        _add_trim(builder, plot, style)


def _draw_style(rng: np.random.Generator, *, with_details: bool) -> Style:
    """Draw the material and colour of the walls of a house, and the sizes of its windows."""
    material = str(rng.choice(["brick", "plaster", "stone"], p=[0.24, 0.6, 0.16]))
    plaster = _PLASTERS[rng.integers(len(_PLASTERS))]  # drawn for the other materials too
    base = {"brick": (0.3, 0.12, 0.08), "stone": (0.3, 0.26, 0.22)}.get(material, plaster)
    color = np.array(base) * rng.uniform(0.4, 1.0) * (1 + 0.08 * rng.normal(size=3))
    red, green, blue = color
    usual_tile_m = {"brick": 1.8, "stone": 2.6, "plaster": 3.4}[material]
    tile_m = usual_tile_m * rng.uniform(0.85, 1.2)
    return Style(
        wall=Appearance(material, (red, green, blue), tile_m, int(rng.integers(8))),
        storey_m=rng.uniform(2.7, 3.5),
        window_m=(rng.uniform(0.8, 1.7), rng.uniform(1.1, 1.9)),
        gap_m=rng.uniform(0.6, 1.9),
        recess_m=rng.uniform(0.06, 0.25),
        frame=_FRAMES[rng.choice(len(_FRAMES), p=_FRAME_SHARES)],
        with_details=with_details,
    )


class _Wall(NamedTuple):
    """A wall's own frame: from a bottom corner along it, up, and outwards."""

    corner: Float[np.ndarray, "3"]  # [m]
    along: Float[np.ndarray, "3"]  # unit vector
    outward: Float[np.ndarray, "3"]  # unit vector

    def to_space(self, along_and_up: np.ndarray, out_m: Number = 0.0) -> np.ndarray:
        """Convert points of the wall to points in space (..., 3) [m].

        ``along_and_up``: distances (..., 2) from the corner, along the wall and up [m]; ``out_m``:
        distance in front of the wall.
        """
        points = self.corner + along_and_up[..., :1] * self.along + along_and_up[..., 1:] * _UP
        return points + out_m * self.outward


def _add_windowed_wall(
    builder: MeshBuilder, wall: _Wall, style: Style, length: Number, height: Number
) -> None:
    """Add a wall of a length and height [m] with recessed windows."""
    rng = builder.rng
    panels, windows = _divide_wall(style, length, height)
    texture_origin = rng.uniform(0, 5, 2)  # so that walls differ
    builder.add_quads(wall.to_space(panels), panels + texture_origin, style.wall)

    # Panes behind the wall, some of them covered by blinds or curtains.
    outer = wall.to_space(windows)
    inner = wall.to_space(windows, -style.recess_m)
    count = len(windows)
    uv = UNIT_SQUARE + rng.integers(0, 8, (count, 1, 2))
    is_covered = rng.random((count, 1)) < 0.3
    dark = np.array([0.05, 0.06, 0.07]) * rng.uniform(0.3, 2.0, (count, 1))
    covered = np.array([0.35, 0.33, 0.28]) * rng.uniform(0.5, 1.2, (count, 1))
    pane = Appearance("pane", (1, 1, 1), 1.0, int(rng.integers(3)))
    builder.add_quads(inner, uv, pane, tint=np.where(is_covered, covered, dark))

    # The four sides of each recess, from an edge of the wall to one of the pane.
    next_corner = [1, 2, 3, 0]
    sides = np.stack([outer, outer[:, next_corner], inner[:, next_corner], inner], 2)
    reveal = Appearance("plaster", style.wall.tint)
    builder.add_quads(sides.reshape(-1, 4, 3), UNIT_SQUARE * [0.5, 0.1], reveal)

    if style.with_details:
        _add_window_details(builder, wall, style, windows)


def _divide_wall(
    style: Style, length: Number, height: Number
) -> tuple[Float[np.ndarray, "n 4 2"], Float[np.ndarray, "m 4 2"]]:
    """Divide a wall into panels and windows: the corners of each on the wall [m].

    They are the cells of a grid, of which those in an odd row and an odd column are windows.
    """
    window_width, window_height = style.window_m
    column_count = max(1, int(length // (window_width + style.gap_m)))
    storey_count = max(1, int((height - 0.5) // style.storey_m))
    left = (np.arange(column_count) + 0.5) * (length / column_count) - window_width / 2
    sill = np.arange(storey_count) * style.storey_m + _SILL_M
    top = np.minimum(sill + window_height, height - 0.15)

    # The lines of the grid, and its cells.
    x = np.concatenate([[0], np.stack([left, left + window_width], 1).ravel(), [length]])
    y = np.concatenate([[0], np.stack([sill, top], 1).ravel(), [height]])
    x0, y0 = np.meshgrid(x[:-1], y[:-1], indexing="ij")
    x1, y1 = np.meshgrid(x[1:], y[1:], indexing="ij")
    cells = _make_rectangle_corners(x0, x1, y0, y1)
    is_window = np.zeros(cells.shape[:2], bool)
    is_window[1::2, 1::2] = True
    return cells[~is_window], cells[is_window]


_FRAME_BAR_M = 0.07
"""Width of the bars of a window's frame."""


def _add_window_details(
    builder: MeshBuilder, wall: _Wall, style: Style, windows: Float[np.ndarray, "n 4 2"]
) -> None:
    """Add frames and sills to windows, whose corners on the wall are given [m]."""
    left, low = windows[:, 0].T
    right, high = windows[:, 2].T
    middle = (left + right) / 2

    # Frames: at four sides of each window, and a bar in the middle.
    bar = _FRAME_BAR_M
    frames = np.concatenate(
        [
            _make_rectangle_corners(left, left + bar, low, high),
            _make_rectangle_corners(right - bar, right, low, high),
            _make_rectangle_corners(middle - bar / 2, middle + bar / 2, low, high),
            _make_rectangle_corners(left, right, high - bar, high),
            _make_rectangle_corners(left, right, low, low + bar),
        ]
    )
    wood = Appearance("wood", style.frame)
    builder.add_quads(wall.to_space(frames, 0.03 - style.recess_m), frames, wood)

    # Sills: their fronts, which stand out from the wall, and their tops.
    sill_m = 0.12
    stone = Appearance("concrete", (0.4, 0.39, 0.36))
    face = _make_rectangle_corners(left - 0.1, right + 0.1, low - 0.09, low)
    front = wall.to_space(face, sill_m)
    back = wall.to_space(face)
    builder.add_quads(front, face, stone)
    top = np.stack([front[:, 3], front[:, 2], back[:, 2], back[:, 3]], 1)
    builder.add_quads(top, UNIT_SQUARE * [1, sill_m], stone)


def _make_rectangle_corners(
    x0: np.ndarray, x1: np.ndarray, y0: np.ndarray, y1: np.ndarray
) -> np.ndarray:
    """Return the corners (..., 4, 2) of rectangles from x0 to x1 and y0 to y1, along the border."""
    corners = [np.stack(corner, -1) for corner in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))]
    return np.stack(corners, -2)


def _add_flat_roof(builder: MeshBuilder, plot: Plot) -> None:
    """Add a flat roof, at times with a structure on it."""
    rng = builder.rng
    top = plot.ground_m - plot.height_m
    x = plot.x_m + plot.side * plot.depth_m / 2
    z = (plot.start_m + plot.stop_m) / 2
    tar = Appearance("concrete", (0.3, 0.3, 0.3), 3.0)
    length = plot.stop_m - plot.start_m
    builder.add_box((x, top - 0.1, z), (plot.depth_m + 0.4, 0.35, length + 0.4), tar)
    if rng.random() < 0.5:
        z = rng.uniform(plot.start_m + 2, plot.stop_m - 2)
        builder.add_box((x, top - 1.2, z), (3, 2, 3), tar)


def _add_gable_roof(builder: MeshBuilder, plot: Plot, style: Style) -> None:
    """Add a gable roof with its ridge along the street, gables, a chimney and at times dormers."""
    rng = builder.rng
    rise = rng.uniform(1.8, 4.2)
    overhang = rng.uniform(0.2, 0.5)
    half = plot.depth_m / 2
    top = plot.ground_m - plot.height_m
    ridge_x = plot.x_m + plot.side * half
    color = _ROOFS[rng.integers(len(_ROOFS))]
    slate = Appearance("roof", color, 2.4, int(rng.integers(3)))
    board = Appearance("wood", style.frame)

    # Both slopes, which go on below the walls' top over the eaves, with a board along the eaves.
    eave_y = top + rise * overhang / half
    first = plot.start_m - overhang
    last = plot.stop_m + overhang
    slope_m = np.hypot(half + overhang, rise)
    for sign in (-1, 1):
        x = ridge_x + sign * (half + overhang)
        eave = [(x, eave_y, first), (x, eave_y, last)]
        ridge = [(ridge_x, top - rise, last), (ridge_x, top - rise, first)]
        builder.add_quads([eave + ridge], [UNIT_SQUARE * [last - first, slope_m]], slate)
        below = [(x, eave_y + 0.15, last), (x, eave_y + 0.15, first)]
        builder.add_quads([eave + below], [UNIT_SQUARE], board)

    # Both gables, and a chimney.
    gable_uv = [[0, 0], [plot.depth_m, 0], [half, rise]]
    for z in (plot.start_m, plot.stop_m):
        gable = [(ridge_x - half, top, z), (ridge_x + half, top, z), (ridge_x, top - rise, z)]
        builder.add_triangles([gable], [gable_uv], style.wall)
    x = ridge_x + rng.uniform(-1, 1) * half * 0.5
    z = rng.uniform(plot.start_m + 1, plot.stop_m - 1)
    chimney = Appearance("brick", (0.28, 0.13, 0.09), 1.8)
    builder.add_box((x, top - rise * 0.8, z), (0.6, 1.8, 0.6), chimney)
    if rng.random() < 0.5:
        _add_dormers(builder, plot, style, rise)


def _add_dormers(builder: MeshBuilder, plot: Plot, style: Style, rise: Number) -> None:
    """Add dormers with windows to the slope at the street of a roof that rises by ``rise`` [m]."""
    half = plot.depth_m / 2
    top = plot.ground_m - plot.height_m
    glass = Appearance("pane", (0.05, 0.055, 0.06))
    x = plot.x_m + plot.side * half * 0.45
    front_x = x - plot.side * (half * 0.25 + 0.01)
    step = builder.rng.uniform(3, 5)
    for z in np.arange(plot.start_m + 2, plot.stop_m - 2, step):
        builder.add_box((x, top - rise * 0.5, z), (half * 0.5, rise * 0.5, 1.5), style.wall)
        corner = (front_x, top - rise * 0.32, z - 0.5)
        builder.add_rectangle(corner, (0, 0, 1.0), (0, -rise * 0.35, 0), glass)


def _add_trim(builder: MeshBuilder, plot: Plot, style: Style) -> None:
    """Add a plinth, a rain pipe and a door; at times balconies or a shop."""
    rng = builder.rng
    x = plot.x_m
    y = plot.ground_m
    middle_z = (plot.start_m + plot.stop_m) / 2
    length = plot.stop_m - plot.start_m

    plinth = Appearance("stone", (0.2, 0.19, 0.18), 2.0)
    builder.add_box((x, y - 0.25, middle_z), (0.12, 0.6, length), plinth)
    pipe_x = x - plot.side * 0.07
    pipe_z = plot.start_m + 0.3
    pipe = Appearance("metal", (0.2, 0.18, 0.15))
    builder.add_tube((pipe_x, y, pipe_z), (pipe_x, y - plot.height_m, pipe_z), 0.05, pipe)
    door_z = rng.uniform(plot.start_m + 1, plot.stop_m - 1.5)
    door = Appearance("wood", tuple(rng.uniform(0.03, 0.35, 3)), 1.0, int(rng.integers(2)))
    builder.add_box((x, y - 1.05, door_z), (0.1, 2.1, 1.1), door)

    if rng.random() < 0.25:
        _add_balconies(builder, plot, style.storey_m)
    if rng.random() < 0.25:
        _add_shop(builder, plot)


def _add_balconies(builder: MeshBuilder, plot: Plot, storey_m: Number) -> None:
    """Add a balcony to each storey above the first, one above the other."""
    slab = Appearance("concrete", (0.42, 0.42, 0.4), 2.0)
    rail = Appearance("metal", (0.05, 0.05, 0.05))
    z = builder.rng.uniform(plot.start_m + 1.5, plot.stop_m - 1.5)
    slab_x = plot.x_m - plot.side * 0.5
    rail_x = plot.x_m - plot.side * 0.98
    for storey in range(1, int((plot.height_m - 0.6) // storey_m)):
        y = plot.ground_m - storey * storey_m
        builder.add_box((slab_x, y, z), (1.0, 0.14, 2.4), slab)
        for offset in np.linspace(-1.2, 1.2, 9):
            builder.add_box((rail_x, y - 0.5, z + offset), (0.03, 0.9, 0.03), rail)
        builder.add_box((rail_x, y - 0.97, z), (0.05, 0.05, 2.45), rail)


def _add_shop(builder: MeshBuilder, plot: Plot) -> None:
    """Add a shop window, a board above it, and at times an awning."""
    rng = builder.rng
    x = plot.x_m
    y = plot.ground_m
    z = (plot.start_m + plot.stop_m) / 2
    width = min(5.0, plot.stop_m - plot.start_m - 1)
    glass = Appearance("pane", (0.12, 0.12, 0.12), 2.5)
    builder.add_box((x - plot.side * 0.02, y - 1.3, z), (0.06, 2.0, width), glass)
    board = Appearance("poster", tuple(rng.uniform(0.2, 0.9, 3)), 2.0, int(rng.integers(4)))
    builder.add_box((x - plot.side * 0.1, y - 3.0, z), (0.15, 0.6, width), board)

    if rng.random() < 0.5:
        outer_x = x - plot.side * 1.3
        outer_y = y - 2.3
        wall_y = y - 2.75
        first = z - width / 2
        last = z + width / 2
        awning = [(outer_x, outer_y, first), (outer_x, outer_y, last),
                  (x, wall_y, last), (x, wall_y, first)]  # fmt: skip
        cloth = Appearance("cloth", tuple(rng.uniform(0.05, 0.7, 3)))
        builder.add_quads([awning], [UNIT_SQUARE * [width, 1.4]], cloth)
