"""Synthetic CAD parts, made by formula: for the demo, the weights ``parts``, and tests.

Each is a few closed surfaces that run into one another, as assemblies are exported; the sizes are
in millimetres, as CAD files are.
"""

import math

import numpy as np
import torch

from depthpose.core.errors import InputError, suggest_name
from depthpose.core.units import metres_of
from depthpose.pose.config import MeshConfig
from depthpose.pose.mesh import make_model, turn_about
from depthpose.pose.types import Axis, ObjectModel, Symmetries

Mesh = tuple[np.ndarray, np.ndarray]  #: corners (n, 3) [mm]; outward faces (m, 3)

_CIRCLE_CORNERS = 96
_TEETH = 6  # of the flange
_Y = (0.0, 1.0, 0.0)
_NO_AREA = 1e-9  # [mm^2] of a triangle at an end that is one point

PARTS = ("bracket", "flange", "mug", "connector", "spool")
"""Names of the parts."""


def make_part(name: str, number: int = 0, config: MeshConfig | None = None) -> ObjectModel:
    """Make a part by its name, with the symmetries that it has by construction.

    Raises:
        InputError: there is no such part.
    """
    vertices, faces = make_part_mesh(name)
    up = torch.tensor([0.0, 0.0, 1.0]).double()
    origin = torch.zeros(3).double()
    symmetries = Symmetries()
    if name == "flange":
        angle = torch.arange(1, _TEETH).double() * (2 * math.pi / _TEETH)
        symmetries = Symmetries(discrete=turn_about(up, origin, angle))
    elif name == "spool":
        symmetries = Symmetries(continuous=(Axis(direction=up, point_m=origin),))
    return make_model(
        torch.from_numpy(vertices) * metres_of("mm"),
        torch.from_numpy(faces),
        name=name,
        number=number,
        symmetries=symmetries,
        config=config,
    )


def make_part_mesh(name: str) -> Mesh:
    """Make the mesh of a part, named as in ``PARTS``.

    Raises:
        InputError: there is no such part.
    """
    match name:
        case "bracket":
            return _make_bracket()
        case "flange":
            return _make_flange()
        case "mug":
            return _make_mug()
        case "connector":
            return _make_connector()
        case "spool":
            return _make_spool()
        case _:
            raise InputError(f"no part is called {name!r}; {suggest_name(name, PARTS)}")


def _make_bracket() -> Mesh:
    """Make two plates with an off-centre hole each, a rib and a boss: no symmetry."""
    base = _make_plate((120.0, 70.0, 8.0), (25.0, 5.0), 12.0)
    wall = rotate(_make_plate((70.0, 80.0, 8.0), (-10.0, 12.0), 20.0), _Y, 90.0)
    rib = make_box((45.0, 8.0, 40.0))
    boss = make_ring(make_circle(9.0), make_circle(4.0), 22.0)
    return join(
        base,
        move(wall, (-56.0, 0.0, 36.0)),
        move(rib, (-32.0, 24.0, 22.0)),
        move(boss, (38.0, -18.0, 12.0)),
    )


def _make_flange() -> Mesh:
    """Make a disc with teeth, and a hub on one side: alike after sixths of a turn."""
    angle = np.arange(_CIRCLE_CORNERS) * (2 * math.pi / _CIRCLE_CORNERS)
    radius = 50 + 9 * np.tanh(4 * np.cos(_TEETH * angle))
    toothed = np.stack([radius * np.cos(angle), radius * np.sin(angle)], 1)
    disc = make_ring(toothed, make_circle(14.0), 14.0)
    hub = make_ring(make_circle(26.0), make_circle(14.0), 30.0)
    return join(disc, move(hub, (0.0, 0.0, 20.0)))


def _make_mug() -> Mesh:
    """Make a cup with a handle, wider above than below: no turn leaves it as it is."""
    radii = (0.0, 32.0, 36.0, 42.0, 38.0, 33.0, 0.0)
    heights = (0.0, 0.0, 6.0, 95.0, 95.0, 10.0, 6.0)
    cup = revolve(list(zip(radii, heights, strict=True)))
    bow = np.linspace(-1.25, 1.25, 24)
    path = np.stack([37 + 30 * np.cos(bow), 0 * bow, 52 + 30 * np.sin(bow)], 1)
    handle = _make_hose(path, 5.5)
    return join(cup, handle)


def _make_connector() -> Mesh:
    """Make a plug with a key, a collar, two pins and a bent cable: no symmetry."""
    pins: list[Mesh] = []
    for y, length in ((-9.0, 24.0), (3.0, 14.0)):
        upright = make_ring(make_circle(3.5), make_circle(1.5), length)
        pins.append(move(rotate(upright, _Y, 90.0), (30.0 + length / 2.0, y, 4.0)))
    body = make_box((60.0, 34.0, 26.0))
    key = make_box((26.0, 8.0, 7.0))
    collar = make_box((14.0, 44.0, 16.0))
    bend = np.linspace(0, 1.4, 20)
    path = np.stack([-28 - 40 * np.sin(bend), 6 + 0 * bend, 40 * (1 - np.cos(bend))], 1)
    cable = _make_hose(path, 7.0)
    return join(
        body,
        move(key, (-8.0, 6.0, 16.0)),
        move(collar, (22.0, 0.0, -3.0)),
        *pins,
        cable,
    )


def _make_spool() -> Mesh:
    """Make a body of revolution with unlike ends: only its axis can be known."""
    radii = (0.0, 34.0, 34.0, 14.0, 12.0, 24.0, 24.0, 8.0, 8.0, 0.0)
    heights = (0.0, 0.0, 7.0, 14.0, 55.0, 62.0, 70.0, 70.0, 50.0, 50.0)
    return revolve(list(zip(radii, heights, strict=True)))


def make_circle(radius: float) -> np.ndarray:
    """Make the corners of a circle about the origin, counter-clockwise (n, 2)."""
    angle = np.arange(_CIRCLE_CORNERS) * (2 * math.pi / _CIRCLE_CORNERS)
    return radius * np.stack([np.cos(angle), np.sin(angle)], 1)


def _make_plate(
    size: tuple[float, float, float], hole_at: tuple[float, float], hole_diameter: float
) -> Mesh:
    """Make a plate about the origin with a round hole along z.

    Args:
        size: in x, y and z.
        hole_at: x and y of the middle of the hole.
        hole_diameter: of the hole.
    """
    # The outline about the middle of the hole: where rays from it at equal angles meet the border.
    unit = make_circle(1.0)
    middle = np.array(hole_at)
    low = -np.array(size[:2]) / 2 - middle
    high = np.array(size[:2]) / 2 - middle
    with np.errstate(divide="ignore", invalid="ignore"):
        toward_low = np.where(unit < 0, low / unit, np.inf)
        extent = np.where(unit > 0, high / unit, toward_low).min(1)
    corners = np.array([[x, y] for x in (low[0], high[0]) for y in (low[1], high[1])])
    outline = unit * extent[:, None]
    # The ray nearest to each corner goes to the corner itself, or the plate would lack its corners.
    for corner in corners:
        nearest_ray = np.argmax(unit @ (corner / np.linalg.norm(corner)))
        outline[nearest_ray] = corner
    return move(make_ring(outline, make_circle(hole_diameter / 2), size[2]), (*hole_at, 0.0))


def make_ring(outer: np.ndarray, inner: np.ndarray, height: float) -> Mesh:
    """Extrude the area between two outlines of equally many corners along z.

    Args:
        outer: corners in x and y, counter-clockwise (n, 2).
        inner: those of the hole (n, 2).
        height: the ring reaches from -height/2 to height/2.
    """
    low = np.full((len(outer), 1), -height / 2)
    high = np.full((len(outer), 1), height / 2)
    loops = [
        np.hstack([outer, low]),
        np.hstack([outer, high]),
        np.hstack([inner, high]),
        np.hstack([inner, low]),
    ]
    return _make_skin([*loops, loops[0]])


def make_box(size: tuple[float, float, float]) -> Mesh:
    """Make a box about the origin."""
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    # Each side is cut into two triangles.
    faces = [face for a, b, c, d in quads for face in ((a, b, c), (a, c, d))]
    return signs * (np.array(size) / 2), np.array(faces)


def revolve(profile: list[tuple[float, float]]) -> Mesh:
    """Revolve a profile of (radius, height) about z.

    It begins at the lower end of the axis, goes up along the outside, and comes back to the axis.
    """
    loops: list[np.ndarray] = []
    for radius, height in profile:
        heights = np.full((_CIRCLE_CORNERS, 1), height)
        loops.append(np.hstack([make_circle(radius), heights]))
    return _make_skin(loops)


def _make_hose(path: np.ndarray, radius: float) -> Mesh:
    """Make a round hose along a path in a plane y = constant, closed at its ends."""
    along = np.gradient(path, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    side = np.array(_Y)
    outline = make_circle(radius)
    loops = []
    for point, direction in zip(path, along, strict=True):
        across = np.cross(side, direction)
        loops.append(point + outline[:, :1] * across + outline[:, 1:] * side)
    # A loop whose corners all lie on the path closes an end.
    first = np.repeat(path[:1], _CIRCLE_CORNERS, 0)
    last = np.repeat(path[-1:], _CIRCLE_CORNERS, 0)
    return _make_skin([first, *loops, last])


def _make_skin(loops: list[np.ndarray]) -> Mesh:
    """Make the surface between successive loops of equally many corners.

    Corners run counter-clockwise, as seen against the order of the loops.
    """
    # Two triangles between each pair of successive corners of a loop and those of the next loop.
    count = len(loops[0])
    vertices = np.concatenate(loops)
    loop, corner = np.meshgrid(np.arange(len(loops) - 1), np.arange(count), indexing="ij")
    a = loop * count + corner
    b = loop * count + (corner + 1) % count
    next_a = a + count
    next_b = b + count
    triangles = np.stack([a, b, next_b, a, next_b, next_a], -1).reshape(-1, 3)

    # Those at an end that is one point have no area, and are left out.
    corners = vertices[triangles]
    first_side = corners[:, 1] - corners[:, 0]
    second_side = corners[:, 2] - corners[:, 0]
    doubled_area = np.linalg.norm(np.cross(first_side, second_side), axis=1)
    return vertices, triangles[doubled_area > _NO_AREA]


def move(mesh: Mesh, shift: tuple[float, ...]) -> Mesh:
    """Shift a mesh by a vector (x, y, z)."""
    vertices, faces = mesh
    return vertices + np.array(shift), faces


def rotate(mesh: Mesh, axis: tuple[float, float, float], degrees: float) -> Mesh:
    """Rotate a mesh about an axis through the origin."""
    vertices, faces = mesh
    turn = turn_about(
        torch.tensor(axis, dtype=torch.float64),
        torch.zeros(3).double(),
        torch.tensor(math.radians(degrees)).double(),
    )
    return vertices @ turn.R.numpy().T, faces


def join(*meshes: Mesh) -> Mesh:
    """Join several meshes to one."""
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in meshes)])
    faces = [faces + start for (_, faces), start in zip(meshes, starts, strict=False)]
    vertices = np.concatenate([part_vertices for part_vertices, _ in meshes])
    return vertices, np.concatenate(faces)
