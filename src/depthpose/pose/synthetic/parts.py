"""Synthetic CAD parts, made by formula: for the demo, the default weights, and tests.

Each is a few closed surfaces that run into one another, as assemblies are exported; the sizes are
in millimetres, as CAD files are.
"""

import math

import numpy as np
import torch

from depthpose.core.errors import InputError, nearest_name
from depthpose.core.units import metres_of
from depthpose.pose.config import MeshConfig
from depthpose.pose.mesh import make_model, turn_about
from depthpose.pose.types import Axis, ObjectModel, Symmetries

Mesh = tuple[np.ndarray, np.ndarray]  #: corners (n, 3) [mm]; outward faces (m, 3)

_CIRCLE_CORNERS = 96
_TEETH = 6  # of the flange


PARTS = ("bracket", "flange", "mug", "connector", "spool")
"""Names of the parts."""


def make_part(name: str, number: int = 0, config: MeshConfig | None = None) -> ObjectModel:
    """Make a part by its name, with the symmetries that it has by construction.

    Raises:
        InputError: there is no such part.
    """
    vertices, faces = part_mesh(name)
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


def part_mesh(name: str) -> Mesh:
    """Make the mesh of a part.

    Raises:
        InputError: there is no such part.
    """
    match name:
        case "bracket":  # two plates with an off-centre hole each, and a rib: no symmetry
            base = _plate((120.0, 70.0, 8.0), (25.0, 5.0), 12.0)
            wall = turned(_plate((70.0, 80.0, 8.0), (-10.0, 12.0), 20.0), (0.0, 1.0, 0.0), 90.0)
            return joined(
                base,
                moved(wall, (-56.0, 0.0, 36.0)),
                moved(box((45.0, 8.0, 40.0)), (-32.0, 24.0, 22.0)),
                moved(ring(circle(9.0), circle(4.0), 22.0), (38.0, -18.0, 12.0)),
            )
        case "flange":  # a disc with teeth and a hub on one side: alike after sixths of a turn
            angle = np.arange(_CIRCLE_CORNERS) * (2 * math.pi / _CIRCLE_CORNERS)
            radius = 50 + 9 * np.tanh(4 * np.cos(_TEETH * angle))
            outer = np.stack([radius * np.cos(angle), radius * np.sin(angle)], 1)
            disc = ring(outer, circle(14.0), 14.0)
            return joined(disc, moved(ring(circle(26.0), circle(14.0), 30.0), (0.0, 0.0, 20.0)))
        case "mug":  # a cup with a handle, wider above than below: no turn leaves it as it is
            radii = (0.0, 32.0, 36.0, 42.0, 38.0, 33.0, 0.0)
            heights = (0.0, 0.0, 6.0, 95.0, 95.0, 10.0, 6.0)
            bow = np.linspace(-1.25, 1.25, 24)
            path = np.stack([37 + 30 * np.cos(bow), 0 * bow, 52 + 30 * np.sin(bow)], 1)
            return joined(revolved(list(zip(radii, heights, strict=True))), _hose(path, 5.5))
        case "connector":  # a plug with a key, two pins and a bent cable: no symmetry
            pins = [
                moved(turned(ring(circle(3.5), circle(1.5), length), (0.0, 1.0, 0.0), 90.0),
                      (30.0 + length / 2.0, y, 4.0))
                for y, length in ((-9.0, 24.0), (3.0, 14.0))
            ]  # fmt: skip
            bend = np.linspace(0, 1.4, 20)
            path = np.stack([-28 - 40 * np.sin(bend), 6 + 0 * bend, 40 * (1 - np.cos(bend))], 1)
            return joined(
                box((60.0, 34.0, 26.0)),
                moved(box((26.0, 8.0, 7.0)), (-8.0, 6.0, 16.0)),
                moved(box((14.0, 44.0, 16.0)), (22.0, 0.0, -3.0)),  # a collar
                *pins,
                _hose(path, 7.0),
            )
        case "spool":  # a body of revolution with unlike ends: only its axis can be known
            radii = (0.0, 34.0, 34.0, 14.0, 12.0, 24.0, 24.0, 8.0, 8.0, 0.0)
            heights = (0.0, 0.0, 7.0, 14.0, 55.0, 62.0, 70.0, 70.0, 50.0, 50.0)
            return revolved(list(zip(radii, heights, strict=True)))
        case _:
            raise InputError(f"no part is called {name!r}; {nearest_name(name, PARTS)}")


def circle(radius: float) -> np.ndarray:
    """Give the corners of a circle about the origin (n, 2)."""
    angle = np.arange(_CIRCLE_CORNERS) * (2 * math.pi / _CIRCLE_CORNERS)
    return radius * np.stack([np.cos(angle), np.sin(angle)], 1)


def _plate(size: tuple[float, float, float], hole_at: tuple[float, float], hole: float) -> Mesh:
    """Make a plate about the origin with a round hole.

    Args:
        size: in x, y and z.
        hole_at: x and y of the middle of the hole.
        hole: its diameter.
    """
    # The outline about the middle of the hole: where rays from it at equal angles meet the border.
    unit = circle(1.0)
    middle = np.array(hole_at)
    low = -np.array(size[:2]) / 2 - middle
    high = np.array(size[:2]) / 2 - middle
    with np.errstate(divide="ignore", invalid="ignore"):
        extent = np.where(unit > 0, high / unit, np.where(unit < 0, low / unit, np.inf)).min(1)
    corners = np.array([[x, y] for x in (low[0], high[0]) for y in (low[1], high[1])])
    outline = unit * extent[:, None]
    # The ray nearest to each corner goes to the corner itself, or the plate would lack its corners.
    for corner in corners:
        outline[np.argmax(unit @ (corner / np.linalg.norm(corner)))] = corner
    return moved(ring(outline, circle(hole / 2), size[2]), (*hole_at, 0.0))


def ring(outer: np.ndarray, inner: np.ndarray, height: float) -> Mesh:
    """Extrude the area between two outlines of equally many corners, from -height/2 to height/2."""
    low, high = (np.full((len(outer), 1), z) for z in (-height / 2, height / 2))
    loops = [
        np.hstack([outer, low]),
        np.hstack([outer, high]),
        np.hstack([inner, high]),
        np.hstack([inner, low]),
    ]
    return _skin([*loops, loops[0]])


def box(size: tuple[float, float, float]) -> Mesh:
    """Make a box about the origin."""
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [face for a, b, c, d in quads for face in ((a, b, c), (a, c, d))]
    return signs * (np.array(size) / 2), np.array(faces)


def revolved(profile: list[tuple[float, float]]) -> Mesh:
    """Revolve a profile of (radius, height) about z.

    It begins at the lower end of the axis, goes up along the outside, and comes back to the axis.
    """
    loops = [np.hstack([circle(r), np.full((_CIRCLE_CORNERS, 1), z)]) for r, z in profile]
    return _skin(loops)


def _hose(path: np.ndarray, radius: float) -> Mesh:
    """Make a round hose along a path in a plane y = constant, closed at its ends."""
    along = np.gradient(path, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    side = np.array([0.0, 1.0, 0.0])
    outline = circle(radius)
    loops = []
    for point, direction in zip(path, along, strict=True):
        across = np.cross(side, direction)
        loops.append(point + outline[:, :1] * across + outline[:, 1:] * side)
    ends = [np.repeat(path[i][None], _CIRCLE_CORNERS, 0) for i in (0, -1)]
    return _skin([ends[0], *loops, ends[1]])


def _skin(loops: list[np.ndarray]) -> Mesh:
    """Make the surface between successive loops of equally many corners.

    Corners run counter-clockwise, as seen against the order of the loops.
    """
    count = len(loops[0])
    vertices = np.concatenate(loops)
    i, j = np.meshgrid(np.arange(len(loops) - 1), np.arange(count), indexing="ij")
    a = i * count + j
    b = i * count + (j + 1) % count
    quads = np.stack([a, b, b + count, a, b + count, a + count], -1).reshape(-1, 3)
    corners = vertices[quads]
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    return vertices, quads[area > 1e-9]


def moved(mesh: Mesh, shift: tuple[float, ...]) -> Mesh:
    """Give a mesh shifted by a vector."""
    return mesh[0] + np.array(shift), mesh[1]


def turned(mesh: Mesh, axis: tuple[float, float, float], degrees: float) -> Mesh:
    """Give a mesh rotated about an axis through the origin."""
    turn = turn_about(
        torch.tensor(axis, dtype=torch.float64),
        torch.zeros(3).double(),
        torch.tensor(math.radians(degrees)).double(),
    )
    return mesh[0] @ turn.R.numpy().T, mesh[1]


def joined(*meshes: Mesh) -> Mesh:
    """Give several meshes as one."""
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in meshes)])
    faces = [faces + start for (_, faces), start in zip(meshes, starts, strict=False)]
    return np.concatenate([vertices for vertices, _ in meshes]), np.concatenate(faces)
