"""Cars, vans, lorries and buses, lofted from cross-sections; models made once, placed often."""

from functools import cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from depthpose.depth.synthetic.materials import Color, Number, Surface
from depthpose.depth.synthetic.mesh import Mesh, MeshBuilder

Ring = Float[np.ndarray, "10 3"]


class Body(NamedTuple):
    """The shape of a kind of vehicle.

    Attributes:
        size_m: length, width and height.
        stations: share of the length (-0.5 rear, 0.5 front), and heights of belt and roof as
            shares of the height.
        glazed: stations between this pair have windows.
        wheels: shares of the length where the axles are.
        share: how often it is met.
    """

    size_m: tuple[Number, Number, Number]
    stations: tuple[tuple[Number, Number, Number], ...]
    glazed: tuple[int, int]
    wheels: tuple[float, ...]
    share: Number


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


def paint_color(rng: np.random.Generator) -> Color:
    """Draw a colour of cars: silver, black, grey and white before all others."""
    shares = np.array([share for _, share in _PAINTS])
    color, _ = _PAINTS[rng.choice(len(_PAINTS), p=shares / shares.sum())]
    light = rng.uniform(0.8, 1.15)
    return color[0] * light, color[1] * light, color[2] * light


def draw_kind(rng: np.random.Generator) -> str:
    """Draw a kind of vehicle."""
    shares = np.array([body.share for body in BODIES.values()])
    return list(BODIES)[rng.choice(len(shares), p=shares / shares.sum())]


@cache
def vehicle(kind: str, number: int) -> Mesh:
    """Give model ``number`` of a kind, white, looking along z."""
    rng = np.random.default_rng([21, list(BODIES).index(kind), number])
    body = BODIES[kind]
    size = np.array(body.size_m) * rng.uniform(0.95, 1.05, 3)
    builder = MeshBuilder()
    _shell(builder, rng, body, size)
    _wheels(builder, body, size, number)
    _trim(builder, size)
    return builder.finish()


def _shell(
    builder: MeshBuilder, rng: np.random.Generator, body: Body, size: Float[np.ndarray, "3"]
) -> None:
    shift = np.zeros((len(body.stations), 3))
    shift[2:-2, 0] = rng.normal(0, 0.008, len(shift) - 4)
    stations = np.array(body.stations) + shift
    rings = [_ring(station, size) for station in stations]
    for i, (rear, front) in enumerate(pairwise(rings)):
        is_glazed = body.glazed[0] <= i < body.glazed[1]
        is_steep = abs(stations[i + 1, 2] - stations[i, 2]) > 0.2
        for j in range(9):
            is_window = is_glazed and (j in (2, 6) or (is_steep and j in (3, 4, 5)))
            _panel(builder, (rear, front), j, size, is_window=bool(is_window))
    for ring in (rings[0], rings[-1]):
        hub = np.broadcast_to(ring.mean(0), ring.shape)
        faces = np.stack([hub, ring, np.roll(ring, -1, 0)], 1)
        builder.triangles(faces, faces[..., :2], Surface("paint"))


def _ring(station: Float[np.ndarray, "3"], size: Float[np.ndarray, "3"]) -> Ring:
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


def _panel(
    builder: MeshBuilder,
    rings: tuple[Ring, Ring],
    j: int,
    size: Float[np.ndarray, "3"],
    *,
    is_window: bool,
) -> None:
    face = np.stack([rings[0][j], rings[0][j + 1], rings[1][j + 1], rings[1][j]])
    if is_window:
        _window(builder, face)
        return
    is_flank = j in (0, 1, 2, 6, 7, 8)
    uv = np.stack([face[:, 2] / size[0] + 0.5, -face[:, 1] / size[2]], -1)
    # The roof's picture starts at the top of the side's, where there is plain paint.
    uv = uv if is_flank else np.stack([face[:, 0], face[:, 2]], -1)
    surface = Surface("side", variant=int(size[0] * 100)) if is_flank else Surface("paint")
    builder.quads([face], [uv], surface)


def _window(builder: MeshBuilder, face: Float[np.ndarray, "4 3"]) -> None:
    """A pane in a painted frame, so that pillars part the windows."""
    uv = [[0, 0], [1, 0], [1, 1], [0, 1]]
    builder.quads([face], [uv], Surface("tyre", (0.015, 0.015, 0.017)))
    middle = face.mean(0)
    outward = np.cross(face[1] - face[0], face[3] - face[0])
    outward *= 0.006 / (np.linalg.norm(outward) + 1e-9)
    outward *= 1 if outward @ middle > 0 or outward[1] < 0 else -1
    # Towards the outside: a body's panes look away from its middle.
    if outward @ (middle - np.array([0, middle[1] * 0.5, 0])) < 0:
        outward = -outward
    builder.quads(
        [middle + (face - middle) * 0.93 + outward], [uv], Surface("glass", (0.03, 0.035, 0.04))
    )


def _wheels(builder: MeshBuilder, body: Body, size: Float[np.ndarray, "3"], number: int) -> None:
    radius = 0.31 if size[2] < 2.5 else 0.47
    rim = Surface("wheel", (0.4, 0.41, 0.43), 1.0, number)
    for side in (-1, 1):
        outside = side * (size[1] / 2 + 0.01)
        for share in body.wheels:
            hub = np.array([outside, -radius, share * size[0]])
            inside = hub - [side * 0.22, 0, 0]
            arch = hub - [side * 0.004, 0.02, 0]
            builder.disc(arch, (side, 0, 0), radius * 1.18, _BLACK, 16)
            builder.tube(inside, hub, (radius, radius), _BLACK, 16)
            builder.disc(hub + np.array([side * 0.003, 0, 0]), (side, 0, 0), radius, _BLACK, 16)
            builder.disc(hub + np.array([side * 0.012, 0, 0]), (side, 0, 0), radius * 0.66, rim, 12)


def _trim(builder: MeshBuilder, size: Float[np.ndarray, "3"]) -> None:
    length, width, height = size
    low = min(height, 1.6)
    white, red = Surface("lamp", (0.8, 0.81, 0.83)), Surface("lamp", (0.4, 0.02, 0.02))
    sill = 0.16 * min(height, 1.8) + 0.03
    builder.box((0, -sill + 0.02, 0), (width * 0.9, 0.14, length * 0.94), _BLACK)
    for side in (-1, 1):
        front, rear = side * width * 0.36, side * width * 0.4
        builder.box((front, -0.46 * low, 0.487 * length), (0.32, 0.13, 0.08), white)
        builder.box((rear, -0.55 * low, -0.488 * length), (0.2, 0.22, 0.06), red)
        mirror = (side * (width / 2 + 0.08), -0.66 * min(height, 2), 0.2 * length)
        builder.box(mirror, (0.18, 0.13, 0.1), Surface("paint"))
    plate = Surface("plate", (0.8, 0.8, 0.76), 0.52)
    builder.box((0, -0.42 * low, -0.502 * length), (0.52, 0.12, 0.03), plate)
    builder.box((0, -0.28 * low, 0.503 * length), (0.52, 0.12, 0.03), plate)
    builder.box((0, -0.33 * low, 0.495 * length), (width * 0.55, 0.12, 0.04), _BLACK)
    builder.box((0, -0.24 * low, -0.496 * length), (width * 0.94, 0.16, 0.06), _BLACK)
    if height > 1.9:  # what is loft from glass elsewhere stands upright here
        pane = Surface("glass", (0.03, 0.03, 0.035))
        where = (0, -0.74 * height, -0.499 * length)
        builder.box(where, (width * 0.72, height * 0.28, 0.02), pane)
