"""Objects beside a road: lamps, signs, traffic lights, small objects at the kerb and fences.

A model stands on y = 0 at the origin. It is made once, by its number, and placed many times.
"""

from functools import cache
from typing import NamedTuple

import numpy as np

from depthpose.depth.synthetic.materials import Appearance, Color, Number
from depthpose.depth.synthetic.mesh import Mesh, MeshBuilder
from depthpose.depth.synthetic.randomness import Stream, make_rng

_GREY_METAL = Appearance("metal", (0.25, 0.26, 0.27))
DARK_METAL = Appearance("metal", (0.03, 0.035, 0.035))
_SIGN_COLORS: list[Color] = [
    (0.5, 0.02, 0.02), (0.03, 0.09, 0.4), (0.75, 0.75, 0.72), (0.6, 0.42, 0.02)
]  # fmt: skip
_SIGN_SIDES = (20, 3, 4, 8)
"""Number of corners of the signs of each colour; 20 look round."""


@cache
def make_lamp(number: int) -> Mesh:
    """Make a street lamp: one of an odd number has an arm towards +x, the others a lantern."""
    builder = MeshBuilder(make_rng(Stream.LAMP, number))
    height = builder.rng.uniform(5, 9)
    steel = Appearance("metal", (0.22, 0.23, 0.23))
    concrete = Appearance("concrete", (0.4, 0.39, 0.37))
    pole = steel if number % 3 else concrete
    builder.add_tube((0, 0.1, 0), (0, -height, 0), (0.1, 0.055), pole, 10)
    builder.add_tube((0, 0, 0), (0, -0.9, 0), 0.13, pole, 10)
    if number % 2:
        reach = builder.rng.uniform(1.2, 2.4)
        arm_end = (reach, -height - 0.3, 0)
        builder.add_tube((0, -height, 0), arm_end, (0.045, 0.035), pole)
        builder.add_box((reach + 0.25, -height - 0.3, 0), (0.7, 0.12, 0.24), _GREY_METAL)
    else:
        builder.add_box((0, -height - 0.2, 0), (0.4, 0.4, 0.4), _GREY_METAL, taper=1.5)
    return builder.finish()


@cache
def make_sign(number: int) -> Mesh:
    """Make a traffic sign whose face looks along -z, to the oncoming camera.

    Every fifth one is a board with words, the others are a disc or polygon with a border.
    """
    builder = MeshBuilder(make_rng(Stream.SIGN, number))
    height = builder.rng.uniform(2.1, 2.8)
    radius = builder.rng.uniform(0.3, 0.42)
    builder.add_tube((0, 0.1, 0), (0, -height - radius, 0), 0.035, _GREY_METAL)
    color = _SIGN_COLORS[number % 4]
    if number % 5 == 4:
        width = builder.rng.uniform(0.8, 2.2)
        board = Appearance("sign", color, 1.0, number)
        builder.add_box((0, -height, -0.05), (width, 0.7, 0.04), board)
        words = Appearance("sign", (0.7, 0.7, 0.68), 0.8, number + 1)
        builder.add_box((0, -height, -0.075), (width * 0.9, 0.56, 0.02), words)
        return builder.finish()

    # The border, the face before it, and the grey back.
    sides = _SIGN_SIDES[number % 4]
    border = Appearance("metal", color)
    face = Appearance("sign", (0.8, 0.8, 0.78), 1.0, number)
    builder.add_disc((0, -height, -0.045), (0, 0, -1), radius, border, sides)
    builder.add_disc((0, -height, -0.055), (0, 0, -1), radius * 0.78, face, sides)
    builder.add_disc((0, -height, -0.035), (0, 0, 1), radius, _GREY_METAL, sides)
    return builder.finish()


@cache
def make_traffic_light(number: int) -> Mesh:
    """Make a traffic light looking along -z; every second one reaches over the road, to +x."""
    builder = MeshBuilder(make_rng(Stream.TRAFFIC_LIGHT, number))
    builder.add_tube((0, 0.1, 0), (0, -3.4, 0), (0.08, 0.07), DARK_METAL, 10)
    heads = [(0.0, -2.6)]  # x and y of the middle of each set of three lamps
    if number % 2:
        builder.add_tube((0, -3.4, 0), (0, -5.6, 0), (0.09, 0.08), DARK_METAL, 10)
        builder.add_tube((0, -5.6, 0), (4.2, -5.8, 0), (0.07, 0.05), DARK_METAL)
        heads.append((4.0, -5.3))

    lit_lamp = int(builder.rng.integers(3))
    for x, y in heads:
        builder.add_box((x, y, -0.14), (0.34, 0.95, 0.26), DARK_METAL)
        builder.add_box((x, y, -0.02), (0.5, 1.1, 0.02), DARK_METAL)
        for lamp, color in enumerate([(0.9, 0.03, 0.02), (0.9, 0.5, 0.03), (0.03, 0.75, 0.25)]):
            brightness = 1.0 if lamp == lit_lamp else 0.1
            lens = Appearance("lamp", tuple(np.array(color) * brightness))
            builder.add_disc((x, y - 0.29 + 0.29 * lamp, -0.28), (0, 0, -1), 0.105, lens)
    return builder.finish()


GUIDE_POST = 3
"""Number of a small object that stands beside country roads too."""


@cache
def make_small_object(number: int) -> Mesh:
    """Make a bin (number 0), a box (1), a bollard (2), a guide post (3), a bench or a pillar.

    Numbers are taken modulo 6.
    """
    builder = MeshBuilder(make_rng(Stream.SMALL_OBJECT, number))
    random_color = tuple(builder.rng.uniform(0.02, 0.3, 3))
    match number % 6:
        case 0:  # a bin with a lid
            plastic = Appearance("concrete", random_color)
            builder.add_box((0, -0.5, 0), (0.55, 1.0, 0.6), plastic, taper=1.1)
            builder.add_box((0, -1.03, 0), (0.6, 0.08, 0.66), plastic)
        case 1:  # a box of a telephone or power network
            grey = Appearance("concrete", (0.3, 0.33, 0.3))
            builder.add_box((0, -0.6, 0), (0.5, 1.2, 0.9), grey)
        case 2:  # a bollard with a bright ring
            ring = Appearance("lamp", (0.7, 0.7, 0.7))
            builder.add_tube((0, 0.1, 0), (0, -0.95, 0), 0.06, DARK_METAL)
            builder.add_tube((0, -0.7, 0), (0, -0.82, 0), 0.065, ring)
        case 3:  # a guide post with a black band
            white = Appearance("concrete", (0.75, 0.75, 0.74))
            builder.add_box((0, -0.5, 0), (0.12, 1.0, 0.1), white)
            builder.add_box((0, -0.82, 0), (0.13, 0.2, 0.11), DARK_METAL)
        case 4:  # a bench: seat, back and two feet
            wood = Appearance("wood", (0.25, 0.17, 0.1))
            builder.add_box((0, -0.45, 0), (0.35, 0.05, 1.6), wood)
            builder.add_box((0.2, -0.75, 0), (0.05, 0.3, 1.6), wood)
            for z in (-0.6, 0.6):
                builder.add_box((0, -0.22, z), (0.3, 0.44, 0.06), DARK_METAL)
        case _:  # a pillar with posters and a cap
            poster = Appearance("poster", (0.7, 0.68, 0.62), 1.9, number)
            builder.add_tube((0, 0, 0), (0, -2.9, 0), 0.6, poster, 14)
            builder.add_tube((0, -2.9, 0), (0, -3.2, 0), (0.66, 0.3), _GREY_METAL, 14)
    return builder.finish()


FENCE_M = 4.0
"""Length of one piece of fence, along z."""


class _FenceBars(NamedTuple):
    """The upright bars of a fence, and its rails."""

    bar_m: tuple[Number, Number, Number]  # size of a bar along x, y and z
    step_m: Number  # distance of the bars
    rail_heights_m: tuple[Number, ...]


_SLATS = _FenceBars((0.02, 1.1, 0.11), 0.16, (0.25, 0.85))
_BARS = _FenceBars((0.02, 1.2, 0.02), 0.14, (0.15, 1.1))
_WIRE = _FenceBars((0.05, 1.2, 0.05), 2.0, (0.2, 0.45, 0.7, 0.95, 1.15))


@cache
def make_fence(number: int) -> Mesh:
    """Make one piece of fence or wall along z.

    By ``number`` modulo 5: wooden slats, bars, wires, a guard rail, or a low wall.
    """
    builder = MeshBuilder(make_rng(Stream.FENCE, number))
    rng = builder.rng
    match number % 5:
        case 0:
            color = np.array([0.25, 0.17, 0.1]) * rng.uniform(0.6, 1.6)
            _add_bars(builder, _SLATS, Appearance("wood", tuple(color)))
        case 1:
            _add_bars(builder, _BARS, DARK_METAL)
        case 2:
            _add_bars(builder, _WIRE, Appearance("metal", (0.04, 0.13, 0.08)))
        case 3:
            rail = Appearance("metal", (0.4, 0.41, 0.42))
            builder.add_box((0, -0.6, 0), (0.06, 0.3, FENCE_M), rail)
            for z in (-FENCE_M / 4, FENCE_M / 4):
                builder.add_box((0.06, -0.35, z), (0.08, 0.8, 0.12), _GREY_METAL)
        case _:
            height = rng.uniform(0.6, 1.9)
            material = ("brick", "stone", "plaster", "concrete")[(number // 5) % 4]
            tint = (0.35, 0.2, 0.15) if material == "brick" else (0.5, 0.47, 0.42)
            wall = Appearance(material, tint, 2.0, number)
            builder.add_box((0, -height / 2, 0), (0.25, height, FENCE_M), wall)
            coping = Appearance("concrete", (0.45, 0.44, 0.42))
            builder.add_box((0, -height - 0.04, 0), (0.33, 0.08, FENCE_M), coping)
    return builder.finish()


def _add_bars(builder: MeshBuilder, bars: _FenceBars, appearance: Appearance) -> None:
    """Add the upright bars of one piece of fence, and the rails along it."""
    end_m = FENCE_M / 2 - 0.01  # a bar at the very end belongs to the next piece
    for z in np.arange(-FENCE_M / 2, end_m, bars.step_m):
        builder.add_box((0, -bars.bar_m[1] / 2, z), bars.bar_m, appearance)
    for height in bars.rail_heights_m:
        builder.add_box((0.02, -height, 0), (0.03, 0.05, FENCE_M), appearance)
