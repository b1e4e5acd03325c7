"""Vehicles and people on a road, so that no two overlap."""

from dataclasses import dataclass, field

import numpy as np

from depthpose.depth.synthetic.materials import Number
from depthpose.depth.synthetic.mesh import MeshBuilder, place_model
from depthpose.depth.synthetic.people import (
    CYCLIST_COUNT,
    PEDESTRIAN_COUNT,
    make_cyclist,
    make_pedestrian,
)
from depthpose.depth.synthetic.road import LEFT, RIGHT, SIDES, Road
from depthpose.depth.synthetic.vehicles import BODIES, MODELS_PER_BODY, PAINTS, make_vehicle


@dataclass(frozen=True, kw_only=True)
class _Rectangle:
    """A part of the road's plane: its middle (x, s) and half of its sides [m]."""

    x: Number
    s: Number
    half_x: Number
    half_s: Number

    def overlaps(self, other: "_Rectangle") -> bool:
        """Whether the two have points in common."""
        is_near_x = abs(self.x - other.x) < self.half_x + other.half_x
        is_near_s = abs(self.s - other.s) < self.half_s + other.half_s
        return bool(is_near_x and is_near_s)  # of floats of NumPy too


_CAMERA_CAR = _Rectangle(x=0.0, s=0.5, half_x=1.5, half_s=4.5)
"""The camera's car and its free view."""

_PARKED_REACH_M = 85
_DRIVING_REACH_M = 110
"""Distance ahead up to which cars are parked, and vehicles are in the lanes."""
_FULL_LANE_SHARE = 0.6
"""Probability of a vehicle at each place along a lane, in traffic of density 1."""
_CYCLISTS_PER_PEDESTRIAN = 0.3
_MIN_CROSSING_M = 8
"""Least distance ahead of a side street with a vehicle, which would fill the view if nearer."""


@dataclass(frozen=True, eq=False)
class Traffic:
    """Adds vehicles and people to a road, at (x to the right, s ahead) [m]."""

    builder: MeshBuilder
    road: Road
    _taken: list[_Rectangle] = field(default_factory=lambda: [_CAMERA_CAR])

    def _claim(self, rectangle: _Rectangle) -> bool:
        """Reserve a rectangle if it is free, and return whether it was."""
        if any(rectangle.overlaps(other) for other in self._taken):
            return False
        self._taken.append(rectangle)
        return True

    def add_parked(self) -> None:
        """Add parked cars in the parking strips, or at the edge of streets without one."""
        rng = self.builder.rng
        road = self.road
        for side in SIDES:
            has_strip = road.parking_m[side] > 0
            is_on_edge = not has_strip and road.place in ("city", "suburb") and rng.random() < 0.25
            if not has_strip and not is_on_edge:
                continue
            occupied_share = rng.uniform(0.3, 0.95)
            s = rng.uniform(-4, 9)
            while s < _PARKED_REACH_M:
                x = road.edge_m[side] - side * rng.uniform(0.92, 1.15)
                if rng.random() < occupied_share and not road.is_side_street(s, side, 3):
                    # Most stand in the direction of the traffic on their side.
                    is_usual_direction = rng.random() < 0.93
                    is_ahead = (side > 0) == is_usual_direction
                    yaw = 0.0 if is_ahead else np.pi
                    self.add_vehicle(x, s, yaw + rng.normal(0, 0.02))
                s += rng.uniform(5.0, 6.5)

    def add_driving(self) -> None:
        """Add vehicles in the lanes, of which the left half is oncoming, and in side streets."""
        rng = self.builder.rng
        road = self.road
        usual_density = {"avenue": 1.3, "forest": 0.6, "rural": 0.6}.get(road.place, 0.9)
        density = rng.uniform(0.15, 1) * usual_density
        for lane in range(road.lanes):
            x = road.edge_m[LEFT] + road.parking_m[LEFT] + (lane + 0.5) * road.lane_m
            is_oncoming = lane < road.lanes // 2
            s = rng.uniform(7, 30)
            while s < _DRIVING_REACH_M:
                if rng.random() < density * _FULL_LANE_SHARE:
                    yaw = rng.normal(0, 0.02) + (np.pi if is_oncoming else 0)
                    self.add_vehicle(x + rng.normal(0, 0.25), s, yaw)
                s += rng.uniform(7, 32)

        # In side streets, half of the arms have a vehicle: it leaves or comes to our road.
        for street in road.side_streets:
            for side in street.sides:
                if rng.random() < 0.5 and street.s_m > _MIN_CROSSING_M:
                    x = road.edge_m[side] + side * rng.uniform(2.5, 16)
                    s = street.s_m + rng.choice([-0.45, 0.45]) * street.half_m
                    yaw = rng.choice([-1, 1]) * np.pi / 2 + rng.normal(0, 0.1)
                    self.add_vehicle(x, s, yaw)

    def add_vehicle(self, x: Number, s: Number, yaw_rad: Number) -> None:
        """Add a vehicle of a random kind and colour, if its place is free."""
        rng = self.builder.rng
        body_shares = np.array([body.share for body in BODIES.values()])
        kind = list(BODIES)[rng.choice(len(BODIES), p=body_shares / body_shares.sum())]

        # The rectangle along x and s about the rotated one that it covers, with a margin.
        length, width, _ = BODIES[kind].size_m
        cos = abs(np.cos(yaw_rad))
        sin = abs(np.sin(yaw_rad))
        half_x = (width * cos + length * sin) / 2 + 0.1
        half_s = (length * cos + width * sin) / 2 + 0.3
        if not self._claim(_Rectangle(x=x, s=s, half_x=half_x, half_s=half_s)):
            return

        paint_shares = np.array([share for _, share in PAINTS])
        paint, _ = PAINTS[rng.choice(len(PAINTS), p=paint_shares / paint_shares.sum())]
        color = tuple(np.array(paint) * rng.uniform(0.8, 1.15))
        model = make_vehicle(kind, int(rng.integers(MODELS_PER_BODY)))
        scale = rng.uniform(0.96, 1.04, 3)
        tints = {"paint": color, "side": color}
        self.builder.add_model(place_model(model, (x, 0, s), yaw_rad, scale, tints))

    def add_people(self) -> None:
        """Add people on foot, and cyclists at the edges of the road."""
        mean_count = {"city": 5.0, "suburb": 1.5, "avenue": 2.0}.get(self.road.place, 0.4)
        self._add_pedestrians(mean_count)
        self._add_cyclists(mean_count * _CYCLISTS_PER_PEDESTRIAN)

    def _add_pedestrians(self, mean_count: float) -> None:
        """Add people on foot, mostly on the pavements; they face along the road or across it."""
        rng = self.builder.rng
        road = self.road
        left_m = road.edge_m[LEFT]
        right_m = road.edge_m[RIGHT]
        for _ in range(int(rng.poisson(mean_count))):
            side = int(rng.choice([-1, 1]))
            s = rng.uniform(5, 50)
            walk_end = max(0.6, road.verge_m + road.walk_m - 0.2)
            x = road.edge_m[side] + side * rng.uniform(0.3, walk_end)
            if rng.random() < 0.12:
                x = rng.uniform(left_m, right_m)
            if not self._claim(_Rectangle(x=x, s=s, half_x=0.3, half_s=0.3)):
                continue

            # Most face along the road, but those on it cross it.
            directions = [0, np.pi, np.pi / 2, -np.pi / 2]
            direction = float(rng.choice(directions, p=[0.35, 0.35, 0.15, 0.15]))
            is_on_road = left_m < x < right_m
            yaw = direction + rng.normal(0, 0.2) + (np.pi / 2 if is_on_road else 0)
            y = 0.0 if is_on_road else -road.curb_m
            model = make_pedestrian(int(rng.integers(PEDESTRIAN_COUNT)))
            self.builder.add_model(place_model(model, (x, y, s), yaw))

    def _add_cyclists(self, mean_count: float) -> None:
        """Add cyclists beside the parked cars, each in the direction of its side."""
        rng = self.builder.rng
        road = self.road
        for _ in range(int(rng.poisson(mean_count))):
            side = int(rng.choice([-1, 1]))
            from_edge = road.parking_m[side] + rng.uniform(0.3, 0.9)
            x = road.edge_m[side] - side * from_edge
            s = rng.uniform(6, 45)
            if self._claim(_Rectangle(x=x, s=s, half_x=0.4, half_s=1.0)):
                yaw = rng.normal(0, 0.08) + (0 if side > 0 else np.pi)
                model = make_cyclist(int(rng.integers(CYCLIST_COUNT)))
                self.builder.add_model(place_model(model, (x, 0, s), yaw))
