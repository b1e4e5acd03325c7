"""Traffic: vehicles and people as models, and their places on the road.

Models are made once and placed often. Vehicles are lofted from cross-sections.
"""

from functools import cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from depthpose.depth.synthetic.mesh import Mesh, MeshBuilder, place
from depthpose.depth.synthetic.models import add_ball
from depthpose.depth.synthetic.road import Road
from depthpose.depth.synthetic.textures import Color, Number, Surface


class Body(NamedTuple):
    """The shape of a kind of vehicle; lengths and heights of its parts are shares of its own."""

    size_m: tuple[Number, Number, Number]  # length, width and height
    stations: tuple[tuple[Number, Number, Number], ...]  # length (rear -0.5), belt, roof
    glazed: tuple[int, int]  # stations between this pair have windows
    wheels: tuple[float, ...]  # where the axles are
    share: Number  # how often it is met


_HATCH = ((-0.5, 0.4, 0.45), (-0.49, 0.6, 0.62), (-0.45, 0.62, 0.66), (-0.35, 0.62, 0.96),
          (-0.05, 0.62, 1.0), (0.07, 0.62, 0.98), (0.25, 0.61, 0.63), (0.45, 0.52, 0.54),
          (0.49, 0.42, 0.44), (0.5, 0.3, 0.34))  # fmt: skip
_SEDAN = ((-0.5, 0.4, 0.48), (-0.49, 0.62, 0.66), (-0.33, 0.64, 0.68), (-0.19, 0.64, 0.97),
          (-0.04, 0.64, 1.0), (0.07, 0.63, 0.98), (0.24, 0.62, 0.64), (0.45, 0.52, 0.55),
          (0.49, 0.42, 0.45), (0.5, 0.3, 0.34))  # fmt: skip
_WAGON = ((-0.5, 0.4, 0.45), (-0.495, 0.6, 0.63), (-0.47, 0.62, 0.66), (-0.42, 0.62, 0.93),
          (-0.05, 0.62, 1.0), (0.08, 0.62, 0.98), (0.25, 0.61, 0.63), (0.46, 0.52, 0.54),
          (0.49, 0.42, 0.44), (0.5, 0.3, 0.34))  # fmt: skip
_VAN = ((-0.5, 0.5, 0.9), (-0.48, 0.55, 1.0), (-0.46, 0.55, 1.0), (0.12, 0.55, 1.0),
        (0.2, 0.55, 0.98), (0.36, 0.52, 0.56), (0.48, 0.42, 0.46), (0.5, 0.3, 0.34))  # fmt: skip
_BOXY = ((-0.5, 0.5, 0.96), (-0.49, 0.5, 1.0), (0.2, 0.5, 1.0), (0.44, 0.5, 0.97),
         (0.49, 0.46, 0.84), (0.5, 0.3, 0.4))  # fmt: skip

BODIES: dict[str, Body] = {
    "hatch": Body((4.0, 1.72, 1.48), _HATCH, (2, 6), (-0.31, 0.31), 0.32),
    "sedan": Body((4.6, 1.8, 1.44), _SEDAN, (2, 6), (-0.3, 0.31), 0.22),
    "wagon": Body((4.6, 1.8, 1.5), _WAGON, (2, 6), (-0.3, 0.31), 0.2),
    "suv": Body((4.6, 1.9, 1.75), _WAGON, (2, 6), (-0.3, 0.31), 0.1),
    "van": Body((5.1, 1.95, 2.05), _VAN, (2, 5), (-0.31, 0.32), 0.1),
    "lorry": Body((7.4, 2.4, 3.1), _BOXY, (3, 4), (-0.36, 0.36), 0.04),
    "bus": Body((11.0, 2.5, 3.0), _BOXY, (1, 4), (-0.28, 0.3), 0.02),
}
MODELS = 4
"""Different models of each kind."""

_PAINTS: list[tuple[Color, float]] = [
    ((0.52, 0.53, 0.55), 0.24), ((0.02, 0.02, 0.023), 0.2), ((0.16, 0.17, 0.19), 0.16),
    ((0.8, 0.8, 0.78), 0.15), ((0.35, 0.025, 0.025), 0.08), ((0.03, 0.07, 0.25), 0.08),
    ((0.05, 0.12, 0.07), 0.03), ((0.33, 0.28, 0.2), 0.04), ((0.55, 0.35, 0.03), 0.02),
]  # fmt: skip
_BLACK = Surface("tyre", (0.02, 0.02, 0.022))


@cache
def vehicle(kind: str, number: int) -> Mesh:
    """Give model ``number`` of a kind, white, looking along z."""
    b = MeshBuilder(np.random.default_rng([21, list(BODIES).index(kind), number]))
    body = BODIES[kind]
    size = np.array(body.size_m) * b.rng.uniform(0.95, 1.05, 3)
    shift = np.zeros((len(body.stations), 3))
    shift[2:-2, 0] = b.rng.normal(0, 0.008, len(shift) - 4)
    stations = np.array(body.stations) + shift
    rings = [_ring(station, size) for station in stations]
    for i, (rear, front) in enumerate(pairwise(rings)):
        is_glazed = body.glazed[0] <= i < body.glazed[1]
        is_steep = abs(stations[i + 1, 2] - stations[i, 2]) > 0.2
        for j in range(9):
            face = np.stack([rear[j], rear[j + 1], front[j + 1], front[j]])
            if is_glazed and (j in (2, 6) or (is_steep and j in (3, 4, 5))):
                _add_window(b, face)
            elif j in (3, 4, 5):
                b.quads([face], [np.stack([face[:, 0], face[:, 2]], -1)], Surface("paint"))
            else:
                uv = np.stack([face[:, 2] / size[0] + 0.5, -face[:, 1] / size[2]], -1)
                b.quads([face], [uv], Surface("side", variant=int(size[0] * 100)))
    for ring in (rings[0], rings[-1]):
        hub = np.broadcast_to(ring.mean(0), ring.shape)
        faces = np.stack([hub, ring, np.roll(ring, -1, 0)], 1)
        b.triangles(faces, faces[..., :2], Surface("paint"))
    radius = 0.31 if size[2] < 2.5 else 0.47
    rim = Surface("wheel", (0.4, 0.41, 0.43), 1.0, number)
    for side in (-1, 1):
        axis = (side, 0, 0)
        for share in body.wheels:
            hub = np.array([side * (size[1] / 2 + 0.01), -radius, share * size[0]])
            b.disc(hub - [side * 0.004, 0.02, 0], axis, radius * 1.18, _BLACK, 16)
            b.tube(hub - [side * 0.22, 0, 0], hub, radius, _BLACK, 16)
            b.disc(hub + np.array([side * 0.003, 0, 0]), axis, radius, _BLACK, 16)
            b.disc(hub + np.array([side * 0.012, 0, 0]), axis, radius * 0.66, rim, 12)
    _add_trim(b, *size)
    return b.finish()


def _ring(
    station: Float[np.ndarray, "3"], size: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "10 3"]:
    """One cross-section: sill, flank, belt, roof edge and roof of one side, then the other's."""
    length, width, height = size
    place, belt, roof = station[0], station[1] * height, station[2] * height
    sill = 0.16 * min(height, 1.8) + 0.03
    half = width / 2 * (1 - 0.1 * abs(2 * place) ** 6)
    lean = 0.8 if height < 1.9 else 0.93
    high = half * lean if roof > belt + 0.1 else half * 0.95
    x = [half * 0.96, half, half * 0.985, high, high * 0.6]
    y = [sill, sill + 0.4 * (belt - sill), belt, roof, roof + 0.012 * height]
    one = [(a, -b, place * length) for a, b in zip(x, y, strict=True)]
    return np.array(one + [(-a, b, c) for a, b, c in reversed(one)])


def _add_window(b: MeshBuilder, face: Float[np.ndarray, "4 3"]) -> None:
    """A pane in a painted frame, so that pillars part the windows; it looks outwards."""
    uv = [[0, 0], [1, 0], [1, 1], [0, 1]]
    b.quads([face], [uv], Surface("tyre", (0.015, 0.015, 0.017)))
    middle = face.mean(0)
    outward = np.cross(face[1] - face[0], face[3] - face[0])
    outward *= 0.006 / (np.linalg.norm(outward) + 1e-9)
    outward *= 1 if outward @ middle > 0 or outward[1] < 0 else -1
    # Towards the outside: a body's panes look away from its middle.
    if outward @ (middle - np.array([0, middle[1] * 0.5, 0])) < 0:
        outward = -outward
    pane = middle + (face - middle) * 0.93 + outward
    b.quads([pane], [uv], Surface("glass", (0.03, 0.035, 0.04)))


def _add_trim(b: MeshBuilder, length: float, width: float, height: float) -> None:
    """Lights, mirrors, plates and bumpers."""
    low, sill = min(height, 1.6), 0.16 * min(height, 1.8) + 0.03
    white, red = Surface("lamp", (0.8, 0.81, 0.83)), Surface("lamp", (0.4, 0.02, 0.02))
    b.box((0, -sill + 0.02, 0), (width * 0.9, 0.14, length * 0.94), _BLACK)
    for side in (-1, 1):
        front, rear = side * width * 0.36, side * width * 0.4
        b.box((front, -0.46 * low, 0.487 * length), (0.32, 0.13, 0.08), white)
        b.box((rear, -0.55 * low, -0.488 * length), (0.2, 0.22, 0.06), red)
        mirror = (side * (width / 2 + 0.08), -0.66 * min(height, 2), 0.2 * length)
        b.box(mirror, (0.18, 0.13, 0.1), Surface("paint"))
    plate = Surface("plate", (0.8, 0.8, 0.76), 0.52)
    b.box((0, -0.42 * low, -0.502 * length), (0.52, 0.12, 0.03), plate)
    b.box((0, -0.28 * low, 0.503 * length), (0.52, 0.12, 0.03), plate)
    b.box((0, -0.33 * low, 0.495 * length), (width * 0.55, 0.12, 0.04), _BLACK)
    b.box((0, -0.24 * low, -0.496 * length), (width * 0.94, 0.16, 0.06), _BLACK)
    if height > 1.9:  # what is loft from glass elsewhere stands upright here
        pane = Surface("glass", (0.03, 0.03, 0.035))
        where = (0, -0.74 * height, -0.499 * length)
        b.box(where, (width * 0.72, height * 0.28, 0.02), pane)


WALKERS = 10
RIDERS = 5
"""How many different models there are of each."""

_SKINS: list[Color] = [(0.5, 0.31, 0.22), (0.42, 0.25, 0.17), (0.2, 0.11, 0.07)]
_RUBBER = Surface("tyre", (0.025, 0.025, 0.028))


@cache
def walker(number: int) -> Mesh:
    """Give a person on foot, looking along z, caught at some moment of a step."""
    b = MeshBuilder(np.random.default_rng([31, number]))
    height, step = b.rng.uniform(1.55, 1.9), b.rng.uniform(-0.28, 0.28)
    coat, trousers = _cloth(b, 0.45), _cloth(b, 0.22)
    for side in (-1, 1):
        foot, hip = (side * 0.1, -0.04, side * step), np.array([side * 0.09, -0.48 * height, 0])
        b.tube(foot, hip, (0.06, 0.09), trousers)
        b.box((foot[0], -0.04, foot[2] + 0.05), (0.09, 0.08, 0.26), _RUBBER)
        hand = (side * 0.27, -0.47 * height, -side * step * 0.8)
        b.tube(hand, (side * 0.2, -0.81 * height, 0), (0.045, 0.06), coat)
    hip, neck = np.array([0, -0.48 * height, 0]), np.array([0, -0.82 * height, 0.02])
    _add_upper_body(b, hip, neck, np.array([0, -0.93 * height, 0.03]), coat)
    if b.rng.random() < 0.4:
        b.box((0.3, -0.4 * height, 0), (0.12, 0.3, 0.34), _cloth(b, 0.4))
    return b.finish()


@cache
def rider(number: int) -> Mesh:
    """Give a person on a bicycle, riding along z."""
    b = MeshBuilder(np.random.default_rng([32, number]))
    frame = Surface("metal", tuple(b.rng.uniform(0.03, 0.4, 3)))
    for z in (-0.52, 0.52):
        angle = np.linspace(0, 2 * np.pi, 19)
        rim = np.stack([0 * angle, -0.34 + 0.33 * np.cos(angle), z + 0.33 * np.sin(angle)], 1)
        for start, stop in pairwise(rim):
            b.tube(start, stop, 0.02, _RUBBER, 4)
        b.tube((-0.05, -0.34, z), (0.05, -0.34, z), 0.03, frame, 5)
        for spoke in rim[:-1:3]:
            b.tube((0, -0.34, z), spoke, 0.005, frame, 3)
    joints = {"rear": (-0.34, -0.52), "front": (-0.34, 0.52), "saddle": (-0.9, -0.2),
              "pedals": (-0.3, -0.02), "head": (-0.86, 0.36), "bar": (-1.05, 0.36)}  # fmt: skip
    links = ("rear saddle", "rear pedals", "pedals saddle", "pedals head", "saddle head",
             "head front", "head bar")  # fmt: skip
    for link in links:
        start, stop = ((0.0, *joints[name]) for name in link.split())
        b.tube(start, stop, 0.022, frame, 5)
    b.tube((-0.28, -1.06, 0.36), (0.28, -1.06, 0.36), 0.016, _RUBBER, 4)
    b.box((0, -0.94, -0.22), (0.16, 0.06, 0.26), _RUBBER)
    coat, trousers = _cloth(b, 0.45), _cloth(b, 0.22)
    hip, neck = np.array([0, -0.98, -0.22]), np.array([0, -1.5, 0.02])
    for side in (-1, 1):
        knee, pedal = (side * 0.1, -0.68, 0.15), (side * 0.1, -0.28 - 0.13 * side, 0.0)
        b.tube(pedal, knee, (0.05, 0.065), trousers)
        b.tube(knee, hip + np.array([side * 0.08, 0, 0]), (0.065, 0.09), trousers)
        shoulder = neck + np.array([side * 0.18, 0, 0])
        b.tube((side * 0.25, -1.08, 0.42), shoulder, (0.04, 0.055), coat)
    _add_upper_body(b, hip, neck, np.array([0, -1.7, 0.08]), coat)
    return b.finish()


def _add_upper_body(
    b: MeshBuilder, hip: np.ndarray, neck: np.ndarray, head: np.ndarray, coat: Surface
) -> None:
    middle = (hip + neck) / 2
    b.tube(hip, middle, (0.17, 0.2), coat, 10)
    b.tube(middle, neck, (0.2, 0.16), coat, 10)
    add_ball(b, neck, (0.2, 0.09, 0.13), coat, 1)
    if b.rng.random() < 0.3:
        bag = hip * 0.35 + neck * 0.65 - [0, 0, 0.2]
        b.box(bag, (0.3, 0.42, 0.18), _cloth(b, 0.4))
    skin = Surface("skin", _SKINS[b.rng.integers(len(_SKINS))])
    hair = Surface("cloth", tuple(b.rng.uniform(0.01, 0.25) * np.array([1, 0.8, 0.6])))
    b.tube(head + np.array([0, 0.2, 0]), head, 0.06, skin, 6)
    add_ball(b, head, (0.085, 0.125, 0.1), skin, 2)
    add_ball(b, head - [0, 0.03, 0.02], (0.098, 0.11, 0.105), hair, 2)


def _cloth(b: MeshBuilder, light: Number) -> Surface:
    color = b.rng.uniform(0.1, 1, 3) * b.rng.uniform(0.15, 1) * light
    return Surface("cloth", tuple(color), 0.6, int(b.rng.integers(4)))


_FAR_M = 110.0


def add_traffic(b: MeshBuilder, road: Road) -> None:
    """Fill the road and its pavements."""
    traffic = _Traffic(b, road)
    traffic.add_parked()
    traffic.add_driving()
    traffic.add_crossing()
    traffic.add_people()


class _Traffic:
    """Vehicles and people on a road, none where another one is; every method adds to the mesh."""

    def __init__(self, b: MeshBuilder, road: Road) -> None:
        self.b, self.rng, self.road = b, b.rng, road
        # x, s, half width and half length of the camera's own car, and of sight before it [m].
        self._taken = [(0.0, 0.5, 1.5, 4.5)]

    def claim(self, x: Number, s: float, half_x: Number, half_s: float) -> bool:
        """Take a place [m], if it is free."""
        for other in self._taken:
            if abs(x - other[0]) < half_x + other[2] and abs(s - other[1]) < half_s + other[3]:
                return False
        self._taken.append((x, s, half_x, half_s))
        return True

    def add_parked(self) -> None:
        """Cars in the strips for them, or at the edge of streets without one."""
        rng, road = self.rng, self.road
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
                    self.add_vehicle(x, s, ahead + rng.normal(0, 0.02))
                s += rng.uniform(5.0, 6.5)

    def add_driving(self) -> None:
        """Vehicles in the lanes."""
        rng, road = self.rng, self.road
        usual = {"avenue": 1.3, "forest": 0.6, "rural": 0.6}.get(road.place, 0.9)
        density = rng.uniform(0.15, 1) * usual
        for lane in range(road.lanes):
            x = road.left_m + road.parking_m[0] + (lane + 0.5) * road.lane_m
            is_oncoming = lane < road.lanes // 2
            s = rng.uniform(7, 30)
            while s < _FAR_M:
                if rng.random() < density * 0.6:
                    yaw = rng.normal(0, 0.02) + (np.pi if is_oncoming else 0)
                    self.add_vehicle(x + rng.normal(0, 0.25), s, yaw)
                s += rng.uniform(7, 32)

    def add_crossing(self) -> None:
        """Vehicles in the side streets, waiting or turning."""
        rng, road = self.rng, self.road
        for street in road.side_streets:
            for side in street.sides:
                if rng.random() < 0.5 and street.s_m > 8:
                    x = road.edge_m(side) + side * rng.uniform(2.5, 16)
                    s = street.s_m + rng.choice([-0.45, 0.45]) * street.half_m
                    self.add_vehicle(x, s, rng.choice([-1, 1]) * np.pi / 2 + rng.normal(0, 0.1))

    def add_vehicle(self, x: Number, s: Number, yaw: Number) -> None:
        """A vehicle of some kind and colour, if its place is free."""
        rng, shares = self.rng, np.array([body.share for body in BODIES.values()])
        kind = list(BODIES)[rng.choice(len(shares), p=shares / shares.sum())]
        length, width, _ = BODIES[kind].size_m
        c, t = abs(np.cos(yaw)), abs(np.sin(yaw))
        half_x, half_s = (width * c + length * t) / 2 + 0.1, (length * c + width * t) / 2 + 0.3
        if not self.claim(x, s, half_x, half_s):
            return
        shares = np.array([share for _, share in _PAINTS])
        color, _ = _PAINTS[rng.choice(len(_PAINTS), p=shares / shares.sum())]
        color = tuple(np.array(color) * rng.uniform(0.8, 1.15))
        model = vehicle(kind, int(rng.integers(MODELS)))
        tints = {"paint": color, "side": color}
        self.b.add(place(model, (x, 0, s), yaw, rng.uniform(0.96, 1.04, 3), tints))

    def add_people(self) -> None:
        """People on foot, on the pavement and now and then the road, and on bicycles."""
        rng, road = self.rng, self.road
        mean = {"city": 5.0, "suburb": 1.5, "avenue": 2.0}.get(road.place, 0.4)
        for _ in range(int(rng.poisson(mean))):
            side = int(rng.choice([-1, 1]))
            s, strip = rng.uniform(5, 50), road.verge_m + road.walk_m
            x = road.edge_m(side) + side * rng.uniform(0.3, max(0.6, strip - 0.2))
            if rng.random() < 0.12:
                x = rng.uniform(road.left_m, road.right_m)
            if not self.claim(x, s, 0.3, 0.3):
                continue
            on_road = road.left_m < x < road.right_m
            turns = rng.choice([0, np.pi, np.pi / 2, -np.pi / 2], p=[0.35, 0.35, 0.15, 0.15])
            yaw = float(turns) + rng.normal(0, 0.2) + (np.pi / 2 if on_road else 0)
            y = 0.0 if on_road else -road.curb_m
            self.b.add(place(walker(int(rng.integers(WALKERS))), (x, y, s), yaw))
        for _ in range(int(rng.poisson(mean * 0.3))):
            side = int(rng.choice([-1, 1]))
            x = road.edge_m(side) - side * (road.parking_m[(side + 1) // 2] + rng.uniform(0.3, 0.9))
            s = rng.uniform(6, 45)
            if self.claim(x, s, 0.4, 1.0):
                yaw = rng.normal(0, 0.08) + (0 if side > 0 else np.pi)
                self.b.add(place(rider(int(rng.integers(RIDERS))), (x, 0, s), yaw))
