"""The plan of a road, and its ground.

All of a street is built along a straight road first, at (x to the right, y down, s ahead) with the
camera's car at x = s = 0, and then bent to the curves of the road.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np
from jaxtyping import Float, Float64

from depthpose.depth.synthetic.materials import Appearance, Number
from depthpose.depth.synthetic.mesh import Mesh, MeshBuilder

Place = Literal["city", "suburb", "avenue", "rural", "forest"]
"""Kind of the surroundings of a road."""
PLACE_SHARES: dict[Place, float] = {
    "city": 0.2, "suburb": 0.28, "avenue": 0.26, "rural": 0.14, "forest": 0.12
}  # fmt: skip

LEFT = -1
RIGHT = 1
SIDES = (LEFT, RIGHT)
"""The left and the right side of a road."""

BEHIND_M = 14.0
AHEAD_M = 420.0
"""Extent of the ground behind and ahead of the car."""

_WIDE_M = 400.0
"""Extent of the ground to each side; only hills are visible beyond."""


@dataclass(frozen=True, kw_only=True)
class SideStreet:
    """A side street that joins the road."""

    s_m: Number  # its position along the road
    half_m: float  # half of its width
    sides: tuple[int, ...]  # of the road: 1 right, -1 left


@dataclass(frozen=True, kw_only=True, eq=False)
class CentreLine:
    """The line x = 0 of the straight road, where it lies in the world; a row for each metre."""

    s_m: Float64[np.ndarray, " n"]  # position along the road
    x_m: Float64[np.ndarray, " n"]
    y_m: Float64[np.ndarray, " n"]
    z_m: Float64[np.ndarray, " n"]
    heading_rad: Float64[np.ndarray, " n"]  # direction of the road: 0 ahead, positive to the right


@dataclass(frozen=True, kw_only=True, eq=False)
class Road:
    """Plan of a road."""

    place: Place  # kind of its surroundings
    edge_m: dict[int, float]  # x of its left edge and of its right edge, by ``SIDES``
    lanes: int  # number of lanes
    lane_m: float  # width of a lane
    parking_m: dict[int, float]  # width of the strip for parked cars on each side; 0: none
    walk_m: Number  # width of the pavement; 0: none
    curb_m: float  # height of the pavement above the road
    verge_m: Number  # width of the grass between road and pavement
    side_streets: tuple[SideStreet, ...]
    centre: CentreLine

    def is_side_street(self, s_m: Number, side: int, margin_m: Number = 0.0) -> bool:
        """Whether a side street joins at a position, or within a margin of it."""
        return any(
            side in street.sides and abs(s_m - street.s_m) < street.half_m + margin_m
            for street in self.side_streets
        )


def draw_road(rng: np.random.Generator) -> Road:
    """Draw the plan of a road, with the camera's car somewhere in one of its right lanes."""
    places = list(PLACE_SHARES)
    place = places[rng.choice(len(places), p=list(PLACE_SHARES.values()))]

    # Lanes and strips for parked cars.
    avenue_lanes = int(rng.integers(3, 6))
    city_lanes = int(rng.integers(2, 4))
    lanes = {"avenue": avenue_lanes, "city": city_lanes}.get(place, 2)
    lane_m = rng.uniform(2.7, 3.7) + 0.2 * (place == "avenue")
    parking_share = {"city": 0.6, "suburb": 0.45}.get(place, 0.0)
    strip_m = rng.uniform(1.9, 2.3, 2)
    parking = strip_m * (rng.random(2) < parking_share)
    width_m = lanes * lane_m + parking.sum()

    # The car is at x = 0, in the right lane or at times the one beside it.
    lane = lanes - 1 - int(rng.random() < 0.35 and lanes > 2)
    right_m = (lanes - lane - 0.5) * lane_m + parking[1] + rng.normal(0, 0.3)
    if lanes == 2 and rng.random() < 0.12:  # a narrow street without lanes, driven in the middle
        right_m = width_m / 2 + rng.normal(0, 0.4)
    left_m = float(right_m - width_m)
    right_m = float(right_m)

    # Pavement and verge.
    has_walk = place in ("city", "suburb") or (place == "avenue" and rng.random() < 0.7)
    walk_m, curb_m = (rng.uniform(1.4, 4.0), rng.uniform(0.06, 0.15)) if has_walk else (0.0, 0.0)
    verge_m = rng.uniform(1, 5) if place == "avenue" else 0.0

    side_streets = _draw_side_streets(rng, place)
    centre = _draw_centre_line(rng, place)
    parking_m = {LEFT: float(parking[0]), RIGHT: float(parking[1])}
    return Road(
        place=place,
        edge_m={LEFT: left_m, RIGHT: right_m},
        lanes=lanes,
        lane_m=(right_m - left_m - sum(parking_m.values())) / lanes,
        parking_m=parking_m,
        walk_m=walk_m,
        curb_m=curb_m,
        verge_m=verge_m,
        side_streets=side_streets,
        centre=centre,
    )


def _draw_side_streets(rng: np.random.Generator, place: Place) -> tuple[SideStreet, ...]:
    """Draw the side streets that join a road in a kind of place."""
    probability = {"city": 0.7, "suburb": 0.65, "avenue": 0.6}.get(place, 0.2)
    streets: list[SideStreet] = []
    s = rng.uniform(4, 40)
    while rng.random() < probability and s < 110:
        sides = ((1,), (-1,), (-1, 1))[rng.choice(3, p=[0.3, 0.3, 0.4])]
        streets.append(SideStreet(s_m=s, half_m=rng.uniform(2.8, 6), sides=sides))
        s += rng.uniform(25, 60)
    return tuple(streets)


_CURVE_RAMP_M = 12
"""Length over which a curve reaches its full curvature, and loses it again."""


def _draw_centre_line(rng: np.random.Generator, place: Place) -> CentreLine:
    """Draw the centre line of a road by its curvature and slope.

    At the car the road is level and leads ahead.
    """
    s = np.arange(-BEHIND_M - 2, AHEAD_M + 2, 1.0)
    curvature = np.zeros_like(s)
    slope = np.zeros_like(s)

    # Up to three curves [1/m], each a trapezoid over s, and up to three changes of the slope.
    if rng.random() < {"city": 0.35, "avenue": 0.45}.get(place, 0.65):
        start = rng.uniform(-5, 45)
        for _ in range(3):
            radius = rng.uniform(45, 400) * rng.choice([-1, 1])
            length = min(rng.uniform(15, 70), 0.9 * abs(radius))
            ramp_up = np.clip((s - start) / _CURVE_RAMP_M, 0, 1)
            ramp_down = np.clip((start + length - s) / _CURVE_RAMP_M, 0, 1)
            curvature += ramp_up * ramp_down / radius
            start += length + rng.uniform(0, 60)
    if rng.random() < 0.55:
        for _ in range(3):
            change_s = rng.uniform(10, 160)
            change_m = rng.uniform(15, 50)
            slope += rng.normal(0, 0.022) * (1 + np.tanh((s - change_s) / change_m)) / 2
        slope -= np.interp(0.0, s, slope)

    # Sums over steps of a metre are integrals.
    heading = np.cumsum(curvature)
    heading -= np.interp(0.0, s, heading)
    line = np.cumsum(np.sin(heading)), -np.cumsum(slope), np.cumsum(np.cos(heading))
    x, y, z = (values - np.interp(0.0, s, values) for values in line)
    return CentreLine(s_m=s, x_m=x, y_m=y, z_m=z, heading_rad=heading)


def bend(mesh: Mesh, road: Road) -> Mesh:
    """Bend a mesh from the straight road to the curves and slopes of the road."""
    # Position, heading and curvature, a row for each metre of the road.
    line = road.centre
    curvature = np.gradient(line.heading_rad, line.s_m)
    table = np.column_stack([line.x_m, line.y_m, line.z_m, line.heading_rad, curvature])
    table = table.astype(np.float32)

    # Their values where each point is along the road, interpolated.
    points = mesh.corners.reshape(-1, 3)
    position = np.clip(points[:, 2] - line.s_m.astype(np.float32)[0], 0, len(table) - 1.001)
    row = position.astype(np.int64)
    share = (position - row)[:, None]
    x, y, z, heading, curvature = (table[row] * (1 - share) + table[row + 1] * share).T

    # On the inside of a curve no point may lie beyond its centre, or the ground would fold: with
    # t = x curvature, which is 1 at the centre, x becomes x / (1 + t^4)^(1/4).
    inward = np.clip(points[:, 0] * curvature, 0, None)
    across = points[:, 0] / (1 + inward**4) ** 0.25

    # Points and normals turn by the heading.
    cos = np.cos(heading)
    sin = np.sin(heading)
    bent = np.stack([x + across * cos, y + points[:, 1], z - across * sin], 1)
    nx, ny, nz = mesh.normals.reshape(-1, 3).T
    turned = np.stack([nx * cos + nz * sin, ny, nz * cos - nx * sin], 1)
    corners, normals = (v.reshape(-1, 3, 3).astype(np.float32) for v in (bent, turned))
    return replace(mesh, corners=corners, normals=normals)


@dataclass(frozen=True, kw_only=True)
class _GroundColors:
    """How the parts of the ground look in one scene."""

    asphalt: Appearance
    walk: Appearance
    grass: Appearance
    land: Appearance  # beyond pavement and verge


def _draw_ground_colors(rng: np.random.Generator, place: Place) -> _GroundColors:
    """Draw how the ground looks: grey asphalt and pavements, and grass between green and yellow."""
    brightness = rng.uniform(0.7, 1.45)
    color = (0.105 * brightness, 0.105 * brightness, 0.107 * brightness)
    asphalt = Appearance("road", color, 3.0, int(rng.integers(4)))
    # Two of the four are used; all are drawn, so that scenes stay what they were.
    variants = [int(v) for v in rng.integers(0, 6, 4)]
    grey = rng.uniform(0.6, 1.2)
    green = rng.uniform(0.75, 1.4)
    warmth = 1 + 0.2 * rng.normal()
    color = (0.2 * grey, 0.19 * grey, 0.18 * grey)
    walk = Appearance("pavement", color, rng.uniform(1.6, 3.2), variants[1])
    color = (0.075 * green * warmth, 0.088 * green, 0.02 * green)
    grass = Appearance("grass", color, 3.0, variants[2])
    is_paved = place == "city" and rng.random() < 0.7
    return _GroundColors(asphalt=asphalt, walk=walk, grass=grass, land=walk if is_paved else grass)


def add_ground(builder: MeshBuilder, road: Road) -> None:
    """Add the carriageway, pavements, verges and the land beside, side streets between them."""
    colors = _draw_ground_colors(builder.rng, road.place)

    # The carriageway, in pieces that grow longer with distance.
    builder.begin_object()
    near = np.arange(-BEHIND_M, 60, 4)
    middle = np.arange(60, 150, 10)
    far = np.arange(150, AHEAD_M + 1, 30)
    stations = np.concatenate([near, middle, far])
    edges = (road.edge_m[LEFT], road.edge_m[RIGHT])
    _add_strip(builder, edges, (0.0, 0.0), colors.asphalt, stations)

    # Side streets on each side, and the ground between them.
    for side in SIDES:
        edge = road.edge_m[side]
        for piece, is_street in _cut_at_side_streets(road, side, stations):
            builder.begin_object()
            if is_street:
                street = (edge, edge + side * _WIDE_M)
                _add_strip(builder, street, (0.0, 0.0), colors.asphalt, piece)
            else:
                _add_side(builder, road, side, colors, piece)


def _cut_at_side_streets(
    road: Road, side: int, stations: Float64[np.ndarray, " n"]
) -> Iterator[tuple[Float64[np.ndarray, " m"], bool]]:
    """Cut the stations s along one side of the road into pieces, and say which are side streets."""
    streets = [street for street in road.side_streets if side in street.sides]
    cuts = [street.s_m + sign * street.half_m for street in streets for sign in (-1, 1)]
    stations = np.unique(np.concatenate([stations, cuts]))
    middles = (stations[1:] + stations[:-1]) / 2
    is_street = np.array([road.is_side_street(float(s), side) for s in middles])
    changes = np.flatnonzero(is_street[1:] != is_street[:-1]) + 1
    for first, last in pairwise([0, *changes, len(is_street)]):
        yield stations[first : last + 1], bool(is_street[first])


_CURB_M = 0.15
"""Width of the kerb's upper face."""


def _add_side(
    builder: MeshBuilder,
    road: Road,
    side: int,
    colors: _GroundColors,
    stations: Float64[np.ndarray, " n"],
) -> None:
    """Add the ground of one side: kerb, verge, pavement and land, with banks at both ends.

    ``stations``: the positions s along the road between which the strips are divided.
    """
    rng = builder.rng
    y = -road.curb_m
    curb = Appearance("curb", (0.3, 0.29, 0.28), 1.0)
    edge = road.edge_m[side]

    # The kerb, or a strip of dirt that reaches a little under the grass.
    if road.curb_m:
        _add_strip(builder, (edge, edge), (0.0, y), curb, stations)
        x = edge + side * _CURB_M
        _add_strip(builder, (edge, x), (y, y), curb, stations)
    else:
        dirt = Appearance("dirt", (0.2, 0.165, 0.12), 2.0)
        dirt_end = edge + side * rng.uniform(0.3, 1.2)
        _add_strip(builder, (edge, dirt_end), (0.0, 0.02), dirt, stations)
        x = edge + side * 0.3

    for width, appearance in ((road.verge_m, colors.grass), (road.walk_m, colors.walk)):
        if width:
            _add_strip(builder, (x, x + side * width), (y, y), appearance, stations)
            x += side * width

    # Land that rises or falls, a little at first.
    rise = rng.normal(0, 0.8 if road.place in ("rural", "forest") else 0.1)
    near_x = x + side * 8
    near_y = y - 0.3 * rise
    far_x = near_x + side * _WIDE_M
    far_y = y - 3 * rise
    _add_strip(builder, (x, near_x), (y, near_y), colors.land, stations)
    _add_strip(builder, (near_x, far_x), (near_y, far_y), colors.land, stations)

    # Banks close the step between the land and a side street at y = 0.
    profile = [(edge, y), (near_x - side * 8, y), (near_x, near_y), (far_x, far_y)]
    for s in (stations[0], stations[-1]):
        faces = [
            [(x0, y0, s), (x1, y1, s), (x1, 0.0, s), (x0, 0.0, s)]
            for (x0, y0), (x1, y1) in pairwise(profile)
        ]
        corners = np.array(faces, np.float32)
        builder.add_quads(corners, corners[..., :2], curb if road.curb_m else colors.land)


def _add_strip(
    builder: MeshBuilder,
    x_m: tuple[Number, Number],
    y_m: tuple[Number, Number],
    appearance: Appearance,
    stations: Float[np.ndarray, " n"],
) -> None:
    """Add a flat strip along the straight road, a face between each two neighbouring stations.

    Its texture lies along (x, s), on an upright strip along (y, s).

    Args:
        builder: takes the faces.
        x_m: x of the strip's two long edges, to the right.
        y_m: y of the same edges, down.
        appearance: material and colour.
        stations: ascending positions s ahead, along the road [m].
    """
    u_m = y_m if x_m[0] == x_m[1] else x_m
    near_m = stations[:-1]
    far_m = stations[1:]

    # The corners of all faces in turn: number of the edge, and position along the road.
    corners = ((0, near_m), (1, near_m), (1, far_m), (0, far_m))
    positions: list[np.ndarray] = []
    uvs: list[np.ndarray] = []
    for edge, s_m in corners:
        x, y, u = (np.full(len(s_m), float(edges[edge])) for edges in (x_m, y_m, u_m))
        positions.append(np.stack([x, y, s_m], 1))
        uvs.append(np.stack([u, s_m], 1))
    builder.add_quads(np.stack(positions, 1), np.stack(uvs, 1), appearance)
