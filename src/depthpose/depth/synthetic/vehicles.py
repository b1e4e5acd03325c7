"""Vehicles, lofted from cross-sections: cars, vans, lorries and buses.

A model drives along z and its ground is y = 0, y downwards. It is made once and placed many times.
"""

from functools import cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from depthpose.depth.synthetic.materials import Appearance, Color, Number
from depthpose.depth.synthetic.mesh import UNIT_SQUARE, Mesh, MeshBuilder
from depthpose.depth.synthetic.randomness import Stream, make_rng


class Body(NamedTuple):
    """Shape of a kind of vehicle; positions of its parts are shares of its length and height."""

    size_m: tuple[Number, Number, Number]  # length, width and height
    # of each cross-section: position along the length (rear -0.5), heights of belt line and roof
    stations: tuple[tuple[Number, Number, Number], ...]
    glazed: tuple[int, int]  # first and last cross-section with windows between them
    axles: tuple[float, ...]  # positions of the axles along the length
    share: Number  # share of all vehicles


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
MODELS_PER_BODY = 4
"""Number of different models of each kind."""

PAINTS: list[tuple[Color, float]] = [
    ((0.52, 0.53, 0.55), 0.24), ((0.02, 0.02, 0.023), 0.2), ((0.16, 0.17, 0.19), 0.16),
    ((0.8, 0.8, 0.78), 0.15), ((0.35, 0.025, 0.025), 0.08), ((0.03, 0.07, 0.25), 0.08),
    ((0.05, 0.12, 0.07), 0.03), ((0.33, 0.28, 0.2), 0.04), ((0.55, 0.35, 0.03), 0.02),
]  # fmt: skip
"""Colours, and the share of vehicles that have each."""

_BLACK_RUBBER = Appearance("tyre", (0.02, 0.02, 0.022))
_UPPER_FLANK_FACES = (2, 6)
_ROOF_FACES = (3, 4, 5)
"""Numbers of faces between two cross-sections: 0 to 2 and 6 to 8 are the flanks, from the sill up
on the right and down on the left."""
_STEEP_ROOF = 0.2
"""Change of the roof's height, between cross-sections, from which it is a windscreen or rear
window [heights of the body]."""


@cache
def make_vehicle(kind: str, number: int) -> Mesh:
    """Make model ``number`` of a kind of ``BODIES``, white; each differs in size and shape."""
    builder = MeshBuilder(make_rng(Stream.VEHICLE, list(BODIES).index(kind), number))
    body = BODIES[kind]
    size = np.array(body.size_m) * builder.rng.uniform(0.95, 1.05, 3)

    # Cross-sections of the middle are moved a little along the length.
    shift = np.zeros((len(body.stations), 3))
    shift[2:-2, 0] = builder.rng.normal(0, 0.008, len(shift) - 4)
    stations = np.array(body.stations) + shift
    _add_shell(builder, stations, size, body.glazed)

    rim = Appearance("wheel", (0.4, 0.41, 0.43), 1.0, number)
    for side in (-1, 1):
        for axle in body.axles:
            _add_wheel(builder, size, side, axle * size[0], rim)
    _add_fittings(builder, *size)
    return builder.finish()


def _add_shell(
    builder: MeshBuilder,
    stations: Float[np.ndarray, "n 3"],
    size: Float[np.ndarray, "3"],
    glazed: tuple[int, int],
) -> None:
    """Add the body of a vehicle: the faces between its cross-sections, and its two ends.

    Arguments are as in :class:`Body`, ``size`` [m].
    """
    length, _, height = size
    paint = Appearance("paint")
    flank = Appearance("side", variant=int(length * 100))  # any one: the length is random
    sections = [_make_section(station, size) for station in stations]
    for i, (rear, front) in enumerate(pairwise(sections)):
        is_glazed = glazed[0] <= i < glazed[1]
        is_steep = abs(stations[i + 1, 2] - stations[i, 2]) > _STEEP_ROOF
        for j in range(len(rear) - 1):
            face = np.stack([rear[j], rear[j + 1], front[j + 1], front[j]])
            is_roof = j in _ROOF_FACES
            if is_glazed and (j in _UPPER_FLANK_FACES or (is_steep and is_roof)):
                _add_window(builder, face)
            elif is_roof:
                builder.add_quads([face], [face[:, [0, 2]]], paint)
            else:
                uv = np.stack([face[:, 2] / length + 0.5, -face[:, 1] / height], -1)
                builder.add_quads([face], [uv], flank)

    # The ends are fans of triangles about their middles.
    for section in (sections[0], sections[-1]):
        hub = np.broadcast_to(section.mean(0), section.shape)
        triangles = np.stack([hub, section, np.roll(section, -1, 0)], 1)
        builder.add_triangles(triangles, triangles[..., :2], paint)


_UPRIGHT_M = 1.9
"""Height from which a vehicle is a box: its rear is upright, and its roof nearly as wide as it."""
_PANE_OFFSET_M = 0.006
"""Distance of a pane from its frame, so that it covers it."""


def _add_window(builder: MeshBuilder, face: Float[np.ndarray, "4 3"]) -> None:
    """Add a dark frame, a four-cornered face of a body [m], and a pane just outside it."""
    builder.add_quads([face], [UNIT_SQUARE], Appearance("tyre", (0.015, 0.015, 0.017)))
    middle = face.mean(0)
    outward = np.cross(face[1] - face[0], face[3] - face[0])
    outward *= _PANE_OFFSET_M / (np.linalg.norm(outward) + 1e-9)

    # A pane looks away from the middle of its body.
    body_middle = np.array([0, middle[1] * 0.5, 0])
    if outward @ (middle - body_middle) < 0:
        outward = -outward
    pane = middle + (face - middle) * 0.93 + outward
    builder.add_quads([pane], [UNIT_SQUARE], Appearance("glass", (0.03, 0.035, 0.04)))


_TALL_M = 2.5
"""Height from which a vehicle has the wheels of a lorry."""


def _add_wheel(
    builder: MeshBuilder, size: Float[np.ndarray, "3"], side: int, axle_m: Number, rim: Appearance
) -> None:
    """Add a wheel in its arch, on the right (1) or the left (-1) side of a body.

    ``size``: length, width and height of the body [m]; ``axle_m``: position of the axle along it.
    """
    _, width, height = size
    radius = 0.31 if height < _TALL_M else 0.47
    axis = (side, 0, 0)
    hub = np.array([side * (width / 2 + 0.01), -radius, axle_m])

    # From inside to outside: the dark arch, the tyre's tread and flank, the rim.
    builder.add_disc(hub - [side * 0.004, 0.02, 0], axis, radius * 1.18, _BLACK_RUBBER, 16)
    builder.add_tube(hub - [side * 0.22, 0, 0], hub, radius, _BLACK_RUBBER, 16)
    builder.add_disc(hub + np.array([side * 0.003, 0, 0]), axis, radius, _BLACK_RUBBER, 16)
    builder.add_disc(hub + np.array([side * 0.012, 0, 0]), axis, radius * 0.66, rim, 12)


def _compute_sill_height(height_m: float) -> float:
    """Compute the height of a body's lower edge [m]."""
    return 0.16 * min(height_m, 1.8) + 0.03


def _make_section(
    station: Float[np.ndarray, "3"], size: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "10 3"]:
    """Make the points of a cross-section of a vehicle, from the right sill over the roof.

    On each side: sill, flank, belt, roof edge and roof. Arguments are as in :class:`Body`, ``size``
    [m].
    """
    length, width, height = size
    position, belt_share, roof_share = station
    belt = belt_share * height
    roof = roof_share * height
    sill = _compute_sill_height(height)

    # Both ends are a tenth narrower, and the roof is narrower than the belt.
    half_width = width / 2 * (1 - 0.1 * abs(2 * position) ** 6)
    roof_width_share = 0.8 if height < _UPRIGHT_M else 0.93
    has_cabin = roof > belt + 0.1  # else this is the bonnet or the boot
    roof_half_width = half_width * roof_width_share if has_cabin else half_width * 0.95

    x = [half_width * 0.96, half_width, half_width * 0.985, roof_half_width, roof_half_width * 0.6]
    heights = [sill, sill + 0.4 * (belt - sill), belt, roof, roof + 0.012 * height]
    z = position * length
    right = [(a, -h, z) for a, h in zip(x, heights, strict=True)]
    left = [(-a, y, z) for a, y, z in reversed(right)]
    return np.array(right + left)


def _add_fittings(builder: MeshBuilder, length: float, width: float, height: float) -> None:
    """Add lights, mirrors, plates and bumpers to a vehicle of a size [m].

    A tall one gets a rear window too: its rear is upright.
    """
    light_height = min(height, 1.6)  # lights of tall vehicles are no higher than those of a car
    sill = _compute_sill_height(height)
    white = Appearance("lamp", (0.8, 0.81, 0.83))
    red = Appearance("lamp", (0.4, 0.02, 0.02))
    underbody = (width * 0.9, 0.14, length * 0.94)
    builder.add_box((0, -sill + 0.02, 0), underbody, _BLACK_RUBBER)
    for side in (-1, 1):
        headlight = (side * width * 0.36, -0.46 * light_height, 0.487 * length)
        rear_light = (side * width * 0.4, -0.55 * light_height, -0.488 * length)
        mirror = (side * (width / 2 + 0.08), -0.66 * min(height, 2), 0.2 * length)
        builder.add_box(headlight, (0.32, 0.13, 0.08), white)
        builder.add_box(rear_light, (0.2, 0.22, 0.06), red)
        builder.add_box(mirror, (0.18, 0.13, 0.1), Appearance("paint"))

    plate = Appearance("plate", (0.8, 0.8, 0.76), 0.52)
    plate_m = (0.52, 0.12, 0.03)
    builder.add_box((0, -0.42 * light_height, -0.502 * length), plate_m, plate)
    builder.add_box((0, -0.28 * light_height, 0.503 * length), plate_m, plate)
    grille = (0, -0.33 * light_height, 0.495 * length)
    builder.add_box(grille, (width * 0.55, 0.12, 0.04), _BLACK_RUBBER)
    rear_bumper = (0, -0.24 * light_height, -0.496 * length)
    builder.add_box(rear_bumper, (width * 0.94, 0.16, 0.06), _BLACK_RUBBER)

    if height > _UPRIGHT_M:
        pane = Appearance("glass", (0.03, 0.03, 0.035))
        rear_window = (0, -0.74 * height, -0.499 * length)
        builder.add_box(rear_window, (width * 0.72, height * 0.28, 0.02), pane)
