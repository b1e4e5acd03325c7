"""Furniture of a street: lamps, signs, lights, posts, fences, walls, bins, wires."""

from functools import cache
from itertools import pairwise

import numpy as np

from depthpose.depth.synthetic.materials import Color, Number, Surface
from depthpose.depth.synthetic.mesh import Mesh, MeshBuilder

_GREY = Surface("metal", (0.25, 0.26, 0.27))
_DARK = Surface("metal", (0.03, 0.035, 0.035))
WOOD = Surface("wood", (0.16, 0.12, 0.09))
"""What poles are made of."""

_SIGN_COLORS: list[Color] = [
    (0.5, 0.02, 0.02),
    (0.03, 0.09, 0.4),
    (0.75, 0.75, 0.72),
    (0.6, 0.42, 0.02),
]
FENCE_M = 4.0
"""Length of one piece of fence, along z."""


@cache
def lamp(number: int) -> Mesh:
    """Give a street lamp at the kerb; its arm reaches towards +x."""
    rng = np.random.default_rng([41, number])
    builder = MeshBuilder()
    height = rng.uniform(5, 9)
    pole = (
        Surface("metal", (0.22, 0.23, 0.23))
        if number % 3
        else Surface("concrete", (0.4, 0.39, 0.37))
    )
    builder.tube((0, 0.1, 0), (0, -height, 0), (0.1, 0.055), pole, 10)
    builder.tube((0, 0, 0), (0, -0.9, 0), (0.13, 0.13), pole, 10)
    if number % 2:
        reach = rng.uniform(1.2, 2.4)
        builder.tube((0, -height, 0), (reach, -height - 0.3, 0), (0.045, 0.035), pole)
        builder.box((reach + 0.25, -height - 0.3, 0), (0.7, 0.12, 0.24), _GREY)
    else:
        builder.box((0, -height - 0.2, 0), (0.4, 0.4, 0.4), _GREY, taper=1.5)
    return builder.finish()


@cache
def sign(number: int) -> Mesh:
    """Give a traffic sign whose face looks along -z, to the oncoming camera."""
    rng = np.random.default_rng([42, number])
    builder = MeshBuilder()
    height, radius = rng.uniform(2.1, 2.8), rng.uniform(0.3, 0.42)
    builder.tube((0, 0.1, 0), (0, -height - radius, 0), (0.035, 0.035), _GREY)
    color = _SIGN_COLORS[number % 4]
    face = Surface("sign", (0.8, 0.8, 0.78), 1.0, number)
    if number % 5 == 4:
        wide = rng.uniform(0.8, 2.2)
        board = Surface("sign", color, 1.0, number)
        builder.box((0, -height, -0.05), (wide, 0.7, 0.04), board)
        builder.box(
            (0, -height, -0.075),
            (wide * 0.9, 0.56, 0.02),
            Surface("sign", (0.7, 0.7, 0.68), 0.8, number + 1),
        )
        return builder.finish()
    sides = (20, 3, 4, 8)[number % 4]
    builder.disc((0, -height, -0.045), (0, 0, -1), radius, Surface("metal", color), sides)
    builder.disc((0, -height, -0.055), (0, 0, -1), radius * 0.78, face, sides)
    builder.disc((0, -height, -0.035), (0, 0, 1), radius, _GREY, sides)
    return builder.finish()


@cache
def traffic_light(number: int) -> Mesh:
    """Give a traffic light looking along -z; every second one reaches over the road, to +x."""
    rng = np.random.default_rng([43, number])
    builder = MeshBuilder()
    builder.tube((0, 0.1, 0), (0, -3.4, 0), (0.08, 0.07), _DARK, 10)
    heads = [(0.0, -2.6)]
    if number % 2:
        builder.tube((0, -3.4, 0), (0, -5.6, 0), (0.09, 0.08), _DARK, 10)
        builder.tube((0, -5.6, 0), (4.2, -5.8, 0), (0.07, 0.05), _DARK)
        heads.append((4.0, -5.3))
    lit = int(rng.integers(3))
    for x, y in heads:
        builder.box((x, y, -0.14), (0.34, 0.95, 0.26), _DARK)
        builder.box((x, y, -0.02), (0.5, 1.1, 0.02), _DARK)
        for i, color in enumerate([(0.9, 0.03, 0.02), (0.9, 0.5, 0.03), (0.03, 0.75, 0.25)]):
            glow = 1.0 if i == lit else 0.1
            lens = Surface("lamp", (color[0] * glow, color[1] * glow, color[2] * glow))
            builder.disc((x, y - 0.29 + 0.29 * i, -0.28), (0, 0, -1), 0.105, lens)
    return builder.finish()


@cache
def small_thing(number: int) -> Mesh:
    """Give a bin, a box, a bollard, a guide post, a bench or a bus stop's pillar."""
    rng = np.random.default_rng([44, number])
    builder = MeshBuilder()
    kind = number % 6
    color = tuple(rng.uniform(0.02, 0.3, 3))
    if kind == 0:
        builder.box((0, -0.5, 0), (0.55, 1.0, 0.6), Surface("concrete", color), taper=1.1)
        builder.box((0, -1.03, 0), (0.6, 0.08, 0.66), Surface("concrete", color))
    elif kind == 1:
        builder.box((0, -0.6, 0), (0.5, 1.2, 0.9), Surface("concrete", (0.3, 0.33, 0.3)))
    elif kind == 2:
        builder.tube((0, 0.1, 0), (0, -0.95, 0), (0.06, 0.06), _DARK)
        builder.tube((0, -0.7, 0), (0, -0.82, 0), (0.065, 0.065), Surface("lamp", (0.7, 0.7, 0.7)))
    elif kind == 3:
        builder.box((0, -0.5, 0), (0.12, 1.0, 0.1), Surface("concrete", (0.75, 0.75, 0.74)))
        builder.box((0, -0.82, 0), (0.13, 0.2, 0.11), _DARK)
    elif kind == 4:
        for height in (0.45, 0.75):
            builder.box(
                (0.2 * (height > 0.6), -height, 0),
                (0.35 - 0.3 * (height > 0.6), 0.05 + 0.25 * (height > 0.6), 1.6),
                Surface("wood", (0.25, 0.17, 0.1)),
            )
        for z in (-0.6, 0.6):
            builder.box((0, -0.22, z), (0.3, 0.44, 0.06), _DARK)
    else:
        builder.tube(
            (0, 0, 0),
            (0, -2.9, 0),
            (0.6, 0.6),
            Surface("poster", (0.7, 0.68, 0.62), 1.9, number),
            14,
        )
        builder.tube((0, -2.9, 0), (0, -3.2, 0), (0.66, 0.3), _GREY, 14)
    return builder.finish()


@cache
def fence(number: int) -> Mesh:
    """Give one piece of fence or wall along z: slats, bars, wire, a rail, or a low wall."""
    rng = np.random.default_rng([45, number])
    builder = MeshBuilder()
    kind = number % 5
    ends = np.array([-FENCE_M / 2, FENCE_M / 2])
    if kind == 0:
        wood = Surface("wood", tuple(np.array([0.25, 0.17, 0.1]) * rng.uniform(0.6, 1.6)))
        _bars(builder, wood, (0.02, 1.1, 0.11), 0.16, (0.25, 0.85))
    elif kind == 1:
        _bars(builder, _DARK, (0.02, 1.2, 0.02), 0.14, (0.15, 1.1))
    elif kind == 2:
        green = Surface("metal", (0.04, 0.13, 0.08))
        _bars(builder, green, (0.05, 1.2, 0.05), 2.0, (0.2, 0.45, 0.7, 0.95, 1.15))
    elif kind == 3:
        builder.box((0, -0.6, 0), (0.06, 0.3, FENCE_M), Surface("metal", (0.4, 0.41, 0.42)))
        for z in ends / 2:
            builder.box((0.06, -0.35, z), (0.08, 0.8, 0.12), _GREY)
    else:
        height = rng.uniform(0.6, 1.9)
        stuff = ("brick", "stone", "plaster", "concrete")[(number // 5) % 4]
        tint = (0.35, 0.2, 0.15) if stuff == "brick" else (0.5, 0.47, 0.42)
        builder.box((0, -height / 2, 0), (0.25, height, FENCE_M), Surface(stuff, tint, 2.0, number))
        builder.box(
            (0, -height - 0.04, 0), (0.33, 0.08, FENCE_M), Surface("concrete", (0.45, 0.44, 0.42))
        )
    return builder.finish()


def _bars(
    builder: MeshBuilder,
    surface: Surface,
    bar_m: tuple[Number, Number, Number],
    step_m: Number,
    rails_m: tuple[float, ...],
) -> None:
    for z in np.arange(-FENCE_M / 2, FENCE_M / 2 - 0.01, step_m):
        builder.box((0, -bar_m[1] / 2, z), bar_m, surface)
    for height in rails_m:
        builder.box((0.02, -height, 0), (0.03, 0.05, FENCE_M), surface)


def add_wires(builder: MeshBuilder, start: np.ndarray, stop: np.ndarray) -> None:
    """Hang a cable between two points [m]."""
    share = np.linspace(0, 1, 7)[:, None]
    points = start * (1 - share) + stop * share
    points[:, 1] += (4 * share * (1 - share))[:, 0] * 0.02 * np.linalg.norm(stop - start)
    for a, b in pairwise(points):
        builder.tube(a, b, (0.018, 0.018), _DARK, 3)
