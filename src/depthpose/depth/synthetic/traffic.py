"""Vehicles and people: parked, driving, standing, walking, riding."""

import numpy as np

from depthpose.depth.synthetic import people, vehicles
from depthpose.depth.synthetic.materials import Number
from depthpose.depth.synthetic.mesh import MeshBuilder, place
from depthpose.depth.synthetic.road import Road

_FAR_M = 110.0


class _Places:
    """What ground is taken, as boxes (x, s, half width, half length) along the street [m]."""

    def __init__(self) -> None:
        self._taken = [(0.0, 0.5, 1.5, 4.5)]  # the camera's own car, and sight before it

    def claim(self, x: Number, s: float, half_x: Number, half_s: float) -> bool:
        """Take a place, if it is free."""
        for other in self._taken:
            if abs(x - other[0]) < half_x + other[2] and abs(s - other[1]) < half_s + other[3]:
                return False
        self._taken.append((x, s, half_x, half_s))
        return True


def add_traffic(builder: MeshBuilder, rng: np.random.Generator, road: Road) -> None:
    """Fill the road and its pavements."""
    places = _Places()
    _parked(builder, rng, road, places)
    _driving(builder, rng, road, places)
    _crossing(builder, rng, road, places)
    _people(builder, rng, road, places)


def _parked(builder: MeshBuilder, rng: np.random.Generator, road: Road, places: _Places) -> None:
    for side in (-1, 1):
        width = road.parking_m[(side + 1) // 2]
        on_edge = not width and road.place in ("city", "suburb") and rng.random() < 0.25
        if not width and not on_edge:
            continue
        fill, s = rng.uniform(0.3, 0.95), rng.uniform(-4, 9)
        while s < 85:
            x = road.edge_m(side) - side * rng.uniform(0.92, 1.15)
            if rng.random() < fill and not road.is_side_street(s, side, 3):
                ahead = 0.0 if (side > 0) == (rng.random() < 0.93) else np.pi
                _vehicle(builder, rng, places, (x, s, ahead + rng.normal(0, 0.02)))
            s += rng.uniform(5.0, 6.5)


def _driving(builder: MeshBuilder, rng: np.random.Generator, road: Road, places: _Places) -> None:
    density = rng.uniform(0.15, 1) * {"avenue": 1.3, "forest": 0.6, "rural": 0.6}.get(
        road.place, 0.9
    )
    for lane in range(road.lanes):
        x = road.left_m + road.parking_m[0] + (lane + 0.5) * road.lane_m
        is_oncoming = lane < road.lanes // 2
        s = rng.uniform(7, 30)
        while s < _FAR_M:
            if rng.random() < density * 0.6:
                yaw = rng.normal(0, 0.02) + (np.pi if is_oncoming else 0)
                _vehicle(builder, rng, places, (x + rng.normal(0, 0.25), s, yaw))
            s += rng.uniform(7, 32)


def _crossing(builder: MeshBuilder, rng: np.random.Generator, road: Road, places: _Places) -> None:
    """Vehicles in the side streets, waiting or turning."""
    for street in road.side_streets:
        for side in street.sides:
            if rng.random() < 0.5 and street.s_m > 8:
                x = road.edge_m(side) + side * rng.uniform(2.5, 16)
                s = street.s_m + rng.choice([-0.45, 0.45]) * street.half_m
                yaw = rng.choice([-1, 1]) * np.pi / 2 + rng.normal(0, 0.1)
                _vehicle(builder, rng, places, (x, s, yaw))


def _vehicle(
    builder: MeshBuilder,
    rng: np.random.Generator,
    places: _Places,
    where: tuple[Number, Number, Number],
) -> None:
    x, s, yaw = where
    kind = vehicles.draw_kind(rng)
    length, width, _ = vehicles.BODIES[kind].size_m
    c, t = abs(np.cos(yaw)), abs(np.sin(yaw))
    half_x, half_s = (width * c + length * t) / 2 + 0.1, (length * c + width * t) / 2 + 0.3
    if not places.claim(x, s, half_x, half_s):
        return
    color = vehicles.paint_color(rng)
    model = vehicles.vehicle(kind, int(rng.integers(vehicles.MODELS)))
    tints = {"paint": color, "side": color}
    builder.add(place(model, (x, 0, s), yaw, rng.uniform(0.96, 1.04, 3), tints))


def _people(builder: MeshBuilder, rng: np.random.Generator, road: Road, places: _Places) -> None:
    mean = {"city": 5.0, "suburb": 1.5, "avenue": 2.0}.get(road.place, 0.4)
    for _ in range(int(rng.poisson(mean))):
        side = int(rng.choice([-1, 1]))
        s, strip = rng.uniform(5, 50), road.verge_m + road.walk_m
        x = road.edge_m(side) + side * rng.uniform(0.3, max(0.6, strip - 0.2))
        if rng.random() < 0.12:
            x = rng.uniform(road.left_m, road.right_m)
        _person(
            builder, rng, places, (x, s), on_road=bool(road.left_m < x < road.right_m), road=road
        )
    for _ in range(int(rng.poisson(mean * 0.3))):
        side = int(rng.choice([-1, 1]))
        x = road.edge_m(side) - side * (road.parking_m[(side + 1) // 2] + rng.uniform(0.3, 0.9))
        s = rng.uniform(6, 45)
        if places.claim(x, s, 0.4, 1.0):
            yaw = rng.normal(0, 0.08) + (0 if side > 0 else np.pi)
            builder.add(place(people.rider(int(rng.integers(people.RIDERS))), (x, 0, s), yaw))


def _person(
    builder: MeshBuilder,
    rng: np.random.Generator,
    places: _Places,
    where: tuple[Number, Number],
    *,
    on_road: bool,
    road: Road,
) -> None:
    if not places.claim(where[0], where[1], 0.3, 0.3):
        return
    turns = rng.choice([0, np.pi, np.pi / 2, -np.pi / 2], p=[0.35, 0.35, 0.15, 0.15])
    yaw = float(turns) + rng.normal(0, 0.2) + (np.pi / 2 if on_road else 0)
    y = 0.0 if on_road else -road.curb_m
    model = people.walker(int(rng.integers(people.WALKERS)))
    builder.add(place(model, (where[0], y, where[1]), yaw))
