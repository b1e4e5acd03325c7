"""The road, the ground and the objects beside it, and its traffic.

All of it is built along a straight street first, at (x to the right, y down, s ahead) with the
camera's car at x = s = 0, and then bent to the curves of the road.
"""

from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Literal

import numpy as np
from jaxtyping import Float, Float64

from depthpose.depth.synthetic import models
from depthpose.depth.synthetic.buildings import Plot, add_house
from depthpose.depth.synthetic.mesh import Mesh, MeshBuilder, Number, Surface, place

Place = Literal["city", "suburb", "avenue", "rural", "forest"]
PLACES: dict[Place, float] = {
    "city": 0.2, "suburb": 0.28, "avenue": 0.26, "rural": 0.14, "forest": 0.12
}  # fmt: skip
"""Kinds of places, and the share of each."""

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
    sides: tuple[int, ...]  # 1 right, -1 left


@dataclass(frozen=True, kw_only=True, eq=False)
class Road:
    """Plan of a road."""

    place: Place  # kind of its surroundings
    edge_m: dict[int, float]  # x of its left edge (-1) and of its right edge (1)
    lanes: int  # number of lanes
    lane_m: float  # width of a lane
    parking_m: tuple[Number, Number]  # width of the strip for parked cars, on the left and right
    walk_m: Number  # width of the pavement; 0: none
    curb_m: float  # height of the pavement above the road
    verge_m: Number  # width of the grass between road and pavement
    side_streets: tuple[SideStreet, ...]
    centre: Float64[np.ndarray, "n 5"]  # centre line of the road: s, x, y, z [m] and heading [rad]

    def is_side_street(self, s_m: Number, side: int, margin_m: Number = 0.0) -> bool:
        """Whether a side street joins at a place, or within a margin of it."""
        return any(
            side in street.sides and abs(s_m - street.s_m) < street.half_m + margin_m
            for street in self.side_streets
        )


def draw_road(rng: np.random.Generator) -> Road:
    """Draw the plan of a road, with the camera's car somewhere in one of its right lanes."""
    names = list(PLACES)
    place = names[rng.choice(len(names), p=list(PLACES.values()))]

    # Lanes and strips for parked cars, and where the car is among them.
    lanes = {"avenue": int(rng.integers(3, 6)), "city": int(rng.integers(2, 4))}.get(place, 2)
    lane_m = rng.uniform(2.7, 3.7) + 0.2 * (place == "avenue")
    parking = rng.uniform(1.9, 2.3, 2) * (
        rng.random(2) < {"city": 0.6, "suburb": 0.45}.get(place, 0.0)
    )
    width_m = lanes * lane_m + parking.sum()
    lane = lanes - 1 - int(rng.random() < 0.35 and lanes > 2)
    right_m = (lanes - lane - 0.5) * lane_m + parking[1] + rng.normal(0, 0.3)
    if lanes == 2 and rng.random() < 0.12:  # a narrow street without lanes, driven in the middle
        right_m = width_m / 2 + rng.normal(0, 0.4)

    # Pavement and verge.
    has_walk = place in ("city", "suburb") or (place == "avenue" and rng.random() < 0.7)
    walk_m, curb_m = (rng.uniform(1.4, 4.0), rng.uniform(0.06, 0.15)) if has_walk else (0.0, 0.0)
    verge_m = rng.uniform(1, 5) if place == "avenue" else 0.0

    side_streets = _draw_side_streets(rng, place)
    centre = _draw_centre(rng, place)
    left_m = float(right_m - width_m)
    right_m = float(right_m)
    parking_m = (float(parking[0]), float(parking[1]))
    return Road(
        place=place,
        edge_m={-1: left_m, 1: right_m},
        lanes=lanes,
        lane_m=(right_m - left_m - sum(parking_m)) / lanes,
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


def _draw_centre(rng: np.random.Generator, place: Place) -> Float64[np.ndarray, "n 5"]:
    """Draw the centre line of a road by its curvature and slope: s, x, y, z [m] and heading [rad].

    At the car the road is level and leads ahead.
    """
    along = np.arange(-BEHIND_M - 2, AHEAD_M + 2, 1.0)
    curvature = np.zeros_like(along)
    slope = np.zeros_like(along)

    # Up to three curves, and up to three changes of the slope.
    if rng.random() < {"city": 0.35, "avenue": 0.45}.get(place, 0.65):
        start = rng.uniform(-5, 45)
        for _ in range(3):
            radius = rng.uniform(45, 400) * rng.choice([-1, 1])
            length = min(rng.uniform(15, 70), 0.9 * abs(radius))
            ramp = np.clip((along - start) / 12, 0, 1) * np.clip(
                (start + length - along) / 12, 0, 1
            )
            curvature += ramp / radius
            start += length + rng.uniform(0, 60)
    if rng.random() < 0.55:
        for _ in range(3):
            where = rng.uniform(10, 160)
            width = rng.uniform(15, 50)
            slope += rng.normal(0, 0.022) * (1 + np.tanh((along - where) / width)) / 2
        slope -= np.interp(0.0, along, slope)

    heading = np.cumsum(curvature)
    heading -= np.interp(0.0, along, heading)
    line = np.cumsum(np.sin(heading)), -np.cumsum(slope), np.cumsum(np.cos(heading))
    x, y, z = (values - np.interp(0.0, along, values) for values in line)
    return np.stack([along, x, y, z, heading], 1)


def bend(mesh: Mesh, road: Road) -> Mesh:
    """Bend a mesh from the straight street to the curves and slopes of the road."""
    # The centre line and its curvature, a row for each metre of the road.
    curvature = np.gradient(road.centre[:, 4], road.centre[:, 0])
    table = np.column_stack([road.centre, curvature]).astype(np.float32)

    # Its values where each point is along the road, interpolated.
    points = mesh.corners.reshape(-1, 3)
    place = np.clip(points[:, 2] - table[0, 0], 0, len(table) - 1.001)
    row = place.astype(np.int64)
    share = (place - row)[:, None]
    here = table[row] * (1 - share) + table[row + 1] * share
    x, y, z, heading, curvature = here[:, 1:].T

    # On the inside of a curve no point may lie beyond its centre, or the ground would fold.
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


def add_ground(b: MeshBuilder, road: Road) -> None:
    """Add the carriageway, pavements, verges and the land beside, side streets between them."""
    # Surfaces, each of one colour in a scene.
    rng = b.rng
    light = rng.uniform(0.7, 1.45)
    color = (0.105 * light, 0.105 * light, 0.107 * light)
    asphalt = Surface("road", color, 3.0, int(rng.integers(4)))
    variants = [int(v) for v in rng.integers(0, 6, 4)]
    grey = rng.uniform(0.6, 1.2)
    green = rng.uniform(0.75, 1.4)
    warm = 1 + 0.2 * rng.normal()
    color = (0.2 * grey, 0.19 * grey, 0.18 * grey)
    walk = Surface("pavement", color, rng.uniform(1.6, 3.2), variants[1])
    grass = Surface("grass", (0.075 * green * warm, 0.088 * green, 0.02 * green), 3.0, variants[2])

    # The carriageway, in pieces that grow longer with distance.
    b.thing += 1
    even = np.concatenate(
        [np.arange(-BEHIND_M, 60, 4), np.arange(60, 150, 10), np.arange(150, AHEAD_M + 1, 30)]
    )
    _add_strip(b, (road.edge_m[-1], road.edge_m[1]), (0.0, 0.0), asphalt, even)

    # Side streets on each side, and the ground between them.
    land = walk if road.place == "city" and rng.random() < 0.7 else grass
    for side in (-1, 1):
        streets = [street for street in road.side_streets if side in street.sides]
        cuts = [street.s_m + sign * street.half_m for street in streets for sign in (-1, 1)]
        stations = np.unique(np.concatenate([even, cuts]))
        middle = (stations[1:] + stations[:-1]) / 2
        is_street = np.array([road.is_side_street(float(s), side) for s in middle])
        starts = [0, *(np.flatnonzero(is_street[1:] != is_street[:-1]) + 1), len(is_street)]
        for first, last in pairwise(starts):
            b.thing += 1
            piece = stations[first : last + 1]
            edge = road.edge_m[side]
            if is_street[first]:
                _add_strip(b, (edge, edge + side * _WIDE_M), (0.0, 0.0), asphalt, piece)
            else:
                _add_side(b, road, side, walk, grass, land, piece)


def _add_side(
    b: MeshBuilder,
    road: Road,
    side: int,
    walk: Surface,
    grass: Surface,
    land: Surface,
    stations: Float64[np.ndarray, " n"],
) -> None:
    """Add the ground of one side: kerb, verge, pavement and land, with banks at both ends.

    ``stations``: the positions s along the road between which the strips are divided.
    """
    rng = b.rng
    high = -road.curb_m
    curb = Surface("curb", (0.3, 0.29, 0.28), 1.0)
    x = edge = road.edge_m[side]

    def strip(width: Number, heights: tuple[Number, Number], surface: Surface) -> None:
        _add_strip(b, (x, x + side * width), heights, surface, stations)

    if road.curb_m:
        strip(0.0, (0.0, high), curb)
        strip(0.15, (high, high), curb)
        x += side * 0.15
    else:
        strip(rng.uniform(0.3, 1.2), (0.0, 0.02), Surface("dirt", (0.2, 0.165, 0.12), 2.0))
        x += side * 0.3
    for width, surface in ((road.verge_m, grass), (road.walk_m, walk)):
        if width:
            strip(width, (high, high), surface)
            x += side * width
    rise = rng.normal(0, 0.8 if road.place in ("rural", "forest") else 0.1)
    strip(8.0, (high, high - 0.3 * rise), land)
    x += side * 8
    strip(_WIDE_M, (high - 0.3 * rise, high - 3 * rise), land)
    profile = [(edge, high), (x - side * 8, high), (x, high - 0.3 * rise),
               (x + side * _WIDE_M, high - 3 * rise)]  # fmt: skip
    for s in (stations[0], stations[-1]):
        # The bank closes the step between the land and a side street at y = 0.
        faces = [
            [(x0, y0, s), (x1, y1, s), (x1, 0.0, s), (x0, 0.0, s)]
            for (x0, y0), (x1, y1) in pairwise(profile)
        ]
        corners = np.array(faces, np.float32)
        b.quads(corners, corners[..., :2], curb if road.curb_m else land)


def _add_strip(
    b: MeshBuilder,
    x_m: tuple[Number, Number],
    y_m: tuple[Number, Number],
    surface: Surface,
    stations: Float[np.ndarray, " n"],
) -> None:
    """Add a flat strip along the straight road, a face between each two neighbouring stations.

    Its texture lies along (x, s), on an upright strip along (y, s).

    Args:
        b: takes the faces.
        x_m: x of the strip's two long edges, to the right.
        y_m: y of the same edges, down.
        surface: material and colour.
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
    b.quads(np.stack(positions, 1), np.stack(uvs, 1), surface)


_FAR_M = 130.0
"""Distance up to which the roadside has objects."""
_DETAIL_M = 45.0
"""Distance up to which houses have details."""
_WOOD = Surface("wood", (0.16, 0.12, 0.09))
_DARK = Surface("metal", (0.03, 0.035, 0.035))


def add_roadside(b: MeshBuilder, road: Road) -> None:
    """Add houses, plants and street furniture on both sides, and the background at the end."""
    rng = b.rng
    sides = {side: _Roadside(b, road, side) for side in (-1, 1)}
    for beside in sides.values():
        match road.place:
            case "city":
                beside.add_houses()
            case "suburb":
                beside.add_gardens()
            case "avenue":
                beside.add_avenue()
            case _:
                beside.add_country()
        beside.add_kerb()
        beside.add_wood()

    # Trees across the end of the road's straight part, and a wood behind them.
    if rng.random() < 0.85:
        for _ in range(int(rng.integers(30, 90))):
            beside = sides[int(rng.choice([-1, 1]))]
            x = beside.x_m(rng.uniform(2, 90))
            beside.add_tree(x, rng.uniform(90, 230), rng.uniform(7, 16))
    if rng.random() < 0.6:
        s = rng.uniform(170, 300)
        half = rng.uniform(60, 160)
        stop = (half, s + rng.uniform(-40, 40))
        models.add_wood_edge(b, (-half, s), stop, rng.uniform(7, 14))


@dataclass(frozen=True, eq=False)
class _Roadside:
    """Builds the objects on one side of a road; every method adds to the mesh of the builder."""

    b: MeshBuilder
    road: Road
    side: int  # 1 right, -1 left

    def x_m(self, beyond_m: Number) -> Number:
        """Give x at a distance behind the pavement and verge, where the plots begin."""
        plot_m = self.road.edge_m[self.side] + self.side * (self.road.verge_m + self.road.walk_m)
        return plot_m + self.side * beyond_m

    def add_houses(self) -> None:
        """Add houses at the pavement, wall to wall."""
        rng = self.b.rng
        if self.road.walk_m > 2 and rng.random() < 0.55:
            self.add_tree_row(self.road.edge_m[self.side] + self.side * 0.9)
        s = rng.uniform(-12, -4)
        set_back = rng.uniform(0, 3) * (rng.random() < 0.4)
        tall = rng.uniform(6, 17)
        while s < _FAR_M:
            length = rng.uniform(8, 20)
            half = length / 2
            if not self.road.is_side_street(s + half, self.side, half + 1):
                height = tall * rng.uniform(0.75, 1.25)
                self.add_house(s, length, set_back + rng.uniform(0, 0.6), height)
            elif rng.random() < 0.5:
                self.add_tree(self.x_m(rng.uniform(6, 12)), s, rng.uniform(5, 12))
            s += length + (rng.uniform(2, 9) if rng.random() < 0.3 else 0.0)

    def add_gardens(self) -> None:
        """Add houses behind hedges and fences, with trees and bushes about them."""
        rng = self.b.rng
        s = rng.uniform(-12, -2)
        back = rng.uniform(2.5, 7)
        border = int(rng.integers(4))
        while s < _FAR_M:
            length = rng.uniform(8, 15)
            half = length / 2
            if self.road.is_side_street(s + half, self.side, half + 1):
                s += length
                continue
            if rng.random() < 0.78:
                self.add_house(s, length, back * rng.uniform(0.8, 1.3), rng.uniform(3.5, 7.5))
            border = int(rng.integers(4)) if rng.random() < 0.5 else border
            self.add_border(s, s + length + 3, border)
            for _ in range(int(rng.integers(0, 3))):
                x = self.x_m(rng.uniform(1.3, back + 1))
                self.add_tree(x, s + rng.uniform(0, length), rng.uniform(3, 9))
            for _ in range(int(rng.integers(1, 5))):
                x = self.x_m(rng.uniform(0.9, 3))
                self.add_bush(x, s + rng.uniform(0, length), rng.uniform(0.6, 1.9))
            s += length + rng.uniform(1.5, 7)

    def add_avenue(self) -> None:
        """Add rows of trees, hedges or rails of a wide road, and set-back houses or copses."""
        rng = self.b.rng
        has_row, has_border, has_houses = rng.random(3) < (0.7, 0.5, 0.35)
        rail = int(rng.integers(4))
        if has_row:
            beyond = rng.uniform(1.2, max(1.5, self.road.verge_m))
            self.add_tree_row(self.road.edge_m[self.side] + self.side * beyond)
        if has_border:
            self.add_border(-8, 100, rail)
        s = rng.uniform(-10, 5)
        while s < _FAR_M:
            length = rng.uniform(10, 26)
            half = length / 2
            is_free = not self.road.is_side_street(s + half, self.side, half + 1)
            if has_houses and rng.random() < 0.7 and is_free:
                self.add_house(s, length, rng.uniform(5, 22), rng.uniform(5, 16))
            else:
                self.add_copse(s, length, rng.uniform(4, 14))
            s += length + rng.uniform(0, 10)

    def add_country(self) -> None:
        """Add open fields with some trees, or the edge of a forest."""
        rng = self.b.rng
        is_forest = self.road.place == "forest"
        is_open = not is_forest and rng.random() < 0.55
        edge = rng.uniform(1.0, 4.5)
        height = rng.uniform(9, 15)
        s = rng.uniform(-10, -4)
        while s < _FAR_M + 30:
            if is_forest:
                for depth in (0.0, 4.5) if s < 60 else (0.0,):
                    x = self.x_m(edge + depth + rng.uniform(0, 2.5))
                    self.add_tree(x, s + rng.uniform(-2, 2), height * rng.uniform(0.75, 1.25))
                if rng.random() < 0.8:
                    x = self.x_m(edge + rng.uniform(-0.4, 1.5))
                    self.add_bush(x, s + rng.uniform(0, 3), rng.uniform(0.8, 2.6))
                s += rng.uniform(2.6, 5) + max(0.0, s) * 0.04
            else:
                if rng.random() < (0.25 if is_open else 0.9):
                    self.add_copse(s, 12.0, 25.0 if is_open else 7.0)
                s += rng.uniform(8, 18)
        if not is_forest and rng.random() < 0.45:
            self.add_border(-8, 90, int(rng.integers(4)))

    def add_wood(self) -> None:
        """Add at times the edge of a wood: right behind a forest's first trees, else far behind."""
        rng = self.b.rng
        is_forest = self.road.place == "forest"
        probability = {"forest": 0.9, "city": 0.1, "suburb": 0.35}.get(self.road.place, 0.55)
        if rng.random() > probability:
            return
        near, height = (rng.uniform(8, 13), 13.0) if is_forest else (rng.uniform(14, 55), 9.0)
        s = rng.uniform(-10, 0 if is_forest else 60)
        x = self.x_m(near)
        stop = s + rng.uniform(60, 200)
        other = x + self.side * rng.uniform(-2, 15)
        models.add_wood_edge(self.b, (x, s), (other, stop), height * rng.uniform(0.7, 1.3))

    def add_copse(self, s: Number, length: Number, depth: Number) -> None:
        """Add some trees and bushes on a plot of a length and depth, unless a street is there."""
        rng = self.b.rng
        is_street = self.road.is_side_street(s + length / 2, self.side, length / 2)
        for _ in range(int(rng.integers(1, 7))):
            x = self.x_m(1.5 + depth * rng.uniform(0, 1))
            if not is_street:
                self.add_tree(x, s + rng.uniform(0, length), rng.uniform(4, 13))
        for _ in range(int(rng.integers(0, 4))):
            x = self.x_m(0.8 + depth * rng.uniform(0, 0.6))
            if not is_street:
                self.add_bush(x, s + rng.uniform(0, length), rng.uniform(0.7, 2.2))

    def add_kerb(self) -> None:
        """Add lamps, signs, traffic lights, boxes and poles with cables at the kerb."""
        rng = self.b.rng
        road = self.road
        side = self.side
        x = self.road.edge_m[self.side] + side * (0.5 if road.walk_m else 1.3)
        y = -road.curb_m

        # Lamps, at even distances.
        if rng.random() <= {"forest": 0.1, "rural": 0.3}.get(road.place, 0.7):
            number = int(rng.integers(6))
            step = rng.uniform(16, 34)
            for s in np.arange(rng.uniform(2, 25), 110, step):
                if not road.is_side_street(s, side):
                    self.b.add(place(models.lamp(number), (x, y, s), 0.0 if side < 0 else np.pi))

        # Signs, small things and trees; in the country guide posts in place of small things.
        s = rng.uniform(3, 12)
        is_town = road.place not in ("rural", "forest")
        while s < 70:
            if not road.is_side_street(s, side, 0.5):
                where = (x + side * rng.uniform(0, 0.4), y, s)
                kind = rng.random()
                if kind < 0.4:
                    model = models.sign(int(rng.integers(20)))
                    yaw = rng.normal(0, 0.12) + np.pi * (rng.random() < 0.2)
                    self.b.add(place(model, where, yaw))
                elif kind < 0.8 or not is_town:
                    number = int(rng.choice([0, 1, 2, 3, 4, 5])) if is_town else 3
                    self.b.add(place(models.small_thing(number), where, rng.normal(0, 0.1)))
                else:
                    self.add_tree(where[0] + side * 0.4, s, rng.uniform(3.5, 7))
            s += rng.uniform(3, 14) * (1 if is_town else 1.8)

        # Traffic lights, before side streets.
        for street in road.side_streets:
            if side in street.sides and rng.random() < 0.4:
                light = models.traffic_light(int(rng.integers(4)))
                where = (x, y, street.s_m - street.half_m - 1)
                self.b.add(place(light, where, 0, (-side, 1, 1)))
        if rng.random() < 0.25:
            self.add_cables(x + side * rng.uniform(0.5, 3))

    def add_cables(self, x_m: Number) -> None:
        """Add a row of wooden poles along the road, and two cables that hang between them."""
        rng = self.b.rng
        height = rng.uniform(6, 8)
        gap = rng.uniform(22, 38)
        places = np.arange(rng.uniform(-15, 10), 120, gap)
        self.b.thing += 1
        for s in places:
            self.b.tube((x_m, 0.2, s), (x_m, -height, s), (0.12, 0.09), _WOOD, 8)
            self.b.box((x_m, -height + 0.3, s), (1.4, 0.1, 0.1), _WOOD)

        # A cable sags in a parabola, by a fiftieth of its length.
        share = np.linspace(0, 1, 7)[:, None]
        for ends in pairwise(places):
            for shift in (-0.6, 0.6):
                start, stop = (np.array([x_m + shift, -height + 0.22, s]) for s in ends)
                points = start * (1 - share) + stop * share
                sag = (4 * share * (1 - share))[:, 0] * 0.02
                points[:, 1] += sag * np.linalg.norm(stop - start)
                for here, there in pairwise(points):
                    self.b.tube(here, there, 0.018, _DARK, 3)

    def add_house(self, s: Number, length: Number, back: Number, height: float) -> None:
        """Add a house at a distance ``back`` behind the pavement."""
        plot = Plot(
            x_m=self.x_m(back + 0.15),
            start_m=s,
            stop_m=s + length,
            side=self.side,
            depth_m=self.b.rng.uniform(7, 12),
            height_m=height,
            ground_m=-self.road.curb_m + 0.2,
        )
        add_house(self.b, plot, with_details=s < _DETAIL_M)

    def add_border(self, start: Number, stop: Number, kind: int) -> None:
        """Add pieces of hedge (kind 1) or fence at the back of the pavement; kind 0 adds none."""
        if kind == 0:
            return
        rng = self.b.rng
        number = int(rng.integers(20))
        height = rng.uniform(0.7, 1.9)
        color = models.leaf_color(rng)
        for s in np.arange(start + 2, min(stop, 95), models.FENCE_M):
            if self.road.is_side_street(s, self.side, 2.2):
                continue
            where = (self.x_m(0.45), -self.road.curb_m, s)
            if kind == 1:
                model = models.hedge(int(rng.integers(models.HEDGES)))
                self.b.add(place(model, where, 0, (1, height, 1), {"leaf": color}))
            else:
                self.b.add(place(models.fence(number), where))

    def add_tree_row(self, x: Number) -> None:
        """Add a row of trees along the road, at nearly even distances."""
        rng = self.b.rng
        step = rng.uniform(6, 14)
        height = rng.uniform(5, 13)
        for s in np.arange(rng.uniform(-8, 6), _FAR_M, step):
            if not self.road.is_side_street(s, self.side, 2) and rng.random() < 0.85:
                place_m = (x + rng.normal(0, 0.3), s + rng.normal(0, 0.8))
                self.add_tree(*place_m, height * rng.uniform(0.8, 1.2))

    def add_tree(self, x_m: Number, s_m: Number, height_m: Number) -> None:
        """Add a tree of a random model at x and s, with fewer leaves where it is far away."""
        rng = self.b.rng
        number = int(rng.integers(models.TREES))
        width_m = height_m * rng.uniform(0.85, 1.15)
        coarseness = int(s_m > 24) + int(s_m > 48 or abs(x_m) > 25)
        model = models.tree(number, coarseness)
        scale = np.array([width_m, height_m, width_m]) / models.TREE_M
        tints = {"leaf": models.leaf_color(rng)}
        yaw = rng.uniform(0, 6.28)
        self.b.add(place(model, (x_m, 0, s_m), yaw, scale, tints))

    def add_bush(self, x_m: Number, s_m: Number, height_m: Number) -> None:
        """Add a bush of a random model at x and s, with fewer leaves where it is far away."""
        rng = self.b.rng
        number = int(rng.integers(models.BUSHES))
        model = models.bush(number, coarseness=int(s_m > 20))
        scale = height_m * rng.uniform(0.7, 1.3, 3)
        tints = {"leaf": models.leaf_color(rng)}
        yaw = rng.uniform(0, 6.28)
        self.b.add(place(model, (x_m, 0, s_m), yaw, scale, tints))


_OWN_CAR = (0.0, 0.5, 1.5, 4.5)
"""Rectangle of the camera's car and its free view: x, s, half width and half length [m]."""


@dataclass(frozen=True, eq=False)
class Traffic:
    """Adds vehicles and people to a road, so that no two overlap."""

    b: MeshBuilder
    road: Road
    _taken: list[tuple[Number, float, Number, float]] = field(default_factory=lambda: [_OWN_CAR])

    def claim(self, x: Number, s: float, half_x: Number, half_s: float) -> bool:
        """Reserve a rectangle [m] if it is free, and give whether it was."""
        for other in self._taken:
            if abs(x - other[0]) < half_x + other[2] and abs(s - other[1]) < half_s + other[3]:
                return False
        self._taken.append((x, s, half_x, half_s))
        return True

    def add_parked(self) -> None:
        """Add parked cars in the parking strips, or at the edge of streets without one."""
        rng = self.b.rng
        road = self.road
        for side in (-1, 1):
            width = road.parking_m[(side + 1) // 2]
            on_edge = not width and road.place in ("city", "suburb") and rng.random() < 0.25
            if not width and not on_edge:
                continue
            fill = rng.uniform(0.3, 0.95)
            s = rng.uniform(-4, 9)
            while s < 85:
                x = road.edge_m[side] - side * rng.uniform(0.92, 1.15)
                if rng.random() < fill and not road.is_side_street(s, side, 3):
                    ahead = 0.0 if (side > 0) == (rng.random() < 0.93) else np.pi
                    self.add_vehicle(x, s, ahead + rng.normal(0, 0.02))
                s += rng.uniform(5.0, 6.5)

    def add_driving(self) -> None:
        """Add vehicles in the lanes and in the side streets."""
        rng = self.b.rng
        road = self.road
        usual = {"avenue": 1.3, "forest": 0.6, "rural": 0.6}.get(road.place, 0.9)
        density = rng.uniform(0.15, 1) * usual
        for lane in range(road.lanes):
            x = road.edge_m[-1] + road.parking_m[0] + (lane + 0.5) * road.lane_m
            is_oncoming = lane < road.lanes // 2
            s = rng.uniform(7, 30)
            while s < 110:
                if rng.random() < density * 0.6:
                    yaw = rng.normal(0, 0.02) + (np.pi if is_oncoming else 0)
                    self.add_vehicle(x + rng.normal(0, 0.25), s, yaw)
                s += rng.uniform(7, 32)
        for street in road.side_streets:
            for side in street.sides:
                if rng.random() < 0.5 and street.s_m > 8:
                    x = road.edge_m[side] + side * rng.uniform(2.5, 16)
                    s = street.s_m + rng.choice([-0.45, 0.45]) * street.half_m
                    self.add_vehicle(x, s, rng.choice([-1, 1]) * np.pi / 2 + rng.normal(0, 0.1))

    def add_vehicle(self, x: Number, s: Number, yaw: Number) -> None:
        """Add a vehicle of a random kind and colour, if its place is free."""
        rng = self.b.rng
        shares = np.array([body.share for body in models.BODIES.values()])
        kind = list(models.BODIES)[rng.choice(len(shares), p=shares / shares.sum())]

        # The rectangle along x and s that it covers.
        length, width, _ = models.BODIES[kind].size_m
        cos = abs(np.cos(yaw))
        sin = abs(np.sin(yaw))
        half_x = (width * cos + length * sin) / 2 + 0.1
        half_s = (length * cos + width * sin) / 2 + 0.3
        if not self.claim(x, s, half_x, half_s):
            return

        shares = np.array([share for _, share in models.PAINTS])
        color, _ = models.PAINTS[rng.choice(len(models.PAINTS), p=shares / shares.sum())]
        color = tuple(np.array(color) * rng.uniform(0.8, 1.15))
        model = models.vehicle(kind, int(rng.integers(models.MODELS)))
        tints = {"paint": color, "side": color}
        self.b.add(place(model, (x, 0, s), yaw, rng.uniform(0.96, 1.04, 3), tints))

    def add_people(self) -> None:
        """Add people on foot, mostly on the pavements, and cyclists at the edges of the road.

        ``x`` is to the right and ``s`` along the road [m]; a figure faces along the road or across.
        """
        rng = self.b.rng
        road = self.road
        mean_count = {"city": 5.0, "suburb": 1.5, "avenue": 2.0}.get(road.place, 0.4)
        for _ in range(int(rng.poisson(mean_count))):
            side = int(rng.choice([-1, 1]))
            s = rng.uniform(5, 50)
            strip = road.verge_m + road.walk_m
            x = road.edge_m[side] + side * rng.uniform(0.3, max(0.6, strip - 0.2))
            if rng.random() < 0.12:
                x = rng.uniform(road.edge_m[-1], road.edge_m[1])
            if not self.claim(x, s, 0.3, 0.3):
                continue
            on_road = road.edge_m[-1] < x < road.edge_m[1]
            turns = rng.choice([0, np.pi, np.pi / 2, -np.pi / 2], p=[0.35, 0.35, 0.15, 0.15])
            yaw = float(turns) + rng.normal(0, 0.2) + (np.pi / 2 if on_road else 0)
            y = 0.0 if on_road else -road.curb_m
            self.b.add(place(models.walker(int(rng.integers(models.WALKERS))), (x, y, s), yaw))

        # Cyclists ride beside the parked cars, each in the direction of its side.
        for _ in range(int(rng.poisson(mean_count * 0.3))):
            side = int(rng.choice([-1, 1]))
            x = road.edge_m[side] - side * (road.parking_m[(side + 1) // 2] + rng.uniform(0.3, 0.9))
            s = rng.uniform(6, 45)
            if self.claim(x, s, 0.4, 1.0):
                yaw = rng.normal(0, 0.08) + (0 if side > 0 else np.pi)
                self.b.add(place(models.rider(int(rng.integers(models.RIDERS))), (x, 0, s), yaw))
