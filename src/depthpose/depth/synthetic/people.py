"""People on foot and on bicycles, as models."""

from functools import cache
from itertools import pairwise

import numpy as np

from depthpose.depth.synthetic.materials import Color, Number, Surface
from depthpose.depth.synthetic.mesh import Mesh, MeshBuilder
from depthpose.depth.synthetic.vegetation import add_ball

WALKERS = 10
RIDERS = 5
"""How many different models there are of each."""

_SKINS: list[Color] = [(0.5, 0.31, 0.22), (0.42, 0.25, 0.17), (0.2, 0.11, 0.07)]
_BLACK = Surface("tyre", (0.025, 0.025, 0.028))


@cache
def walker(number: int) -> Mesh:
    """Give a person on foot, looking along z, caught at some moment of a step."""
    rng = np.random.default_rng([31, number])
    builder = MeshBuilder()
    height, step = rng.uniform(1.55, 1.9), rng.uniform(-0.28, 0.28)
    coat, trousers = _cloth(rng, 0.45), _cloth(rng, 0.22)
    for side in (-1, 1):
        foot, hip = (side * 0.1, -0.04, side * step), np.array([side * 0.09, -0.48 * height, 0])
        builder.tube(foot, hip, (0.06, 0.09), trousers)
        builder.box((foot[0], -0.04, foot[2] + 0.05), (0.09, 0.08, 0.26), _BLACK)
        hand = (side * 0.27, -0.47 * height, -side * step * 0.8)
        builder.tube(hand, (side * 0.2, -0.81 * height, 0), (0.045, 0.06), coat)
    _trunk(builder, rng, (0, -0.48 * height, 0), (0, -0.82 * height, 0.02), coat)
    _head(builder, rng, (0, -0.93 * height, 0.03))
    if rng.random() < 0.4:
        builder.box((0.3, -0.4 * height, 0), (0.12, 0.3, 0.34), _cloth(rng, 0.4))
    return builder.finish()


@cache
def rider(number: int) -> Mesh:
    """Give a person on a bicycle, riding along z."""
    rng = np.random.default_rng([32, number])
    builder = MeshBuilder()
    frame = Surface("metal", tuple(rng.uniform(0.03, 0.4, 3)))
    _bicycle(builder, frame)
    coat, trousers = _cloth(rng, 0.45), _cloth(rng, 0.22)
    hip, neck = np.array([0, -0.98, -0.22]), np.array([0, -1.5, 0.02])
    for side in (-1, 1):
        knee, pedal = (side * 0.1, -0.68, 0.15), (side * 0.1, -0.28 - 0.13 * side, 0.0)
        builder.tube(pedal, knee, (0.05, 0.065), trousers)
        builder.tube(knee, hip + np.array([side * 0.08, 0, 0]), (0.065, 0.09), trousers)
        builder.tube(
            (side * 0.25, -1.08, 0.42), neck + np.array([side * 0.18, 0, 0]), (0.04, 0.055), coat
        )
    _trunk(builder, rng, tuple(hip), tuple(neck), coat)
    _head(builder, rng, (0, -1.7, 0.08))
    return builder.finish()


def _bicycle(builder: MeshBuilder, frame: Surface) -> None:
    for z in (-0.52, 0.52):
        angle = np.linspace(0, 2 * np.pi, 19)
        rim = np.stack([0 * angle, -0.34 + 0.33 * np.cos(angle), z + 0.33 * np.sin(angle)], 1)
        for start, stop in pairwise(rim):
            builder.tube(start, stop, (0.02, 0.02), _BLACK, 4)
        builder.tube((-0.05, -0.34, z), (0.05, -0.34, z), (0.03, 0.03), frame, 5)
        for spoke in rim[:-1:3]:
            builder.tube((0, -0.34, z), spoke, (0.005, 0.005), frame, 3)
    joints = {"rear": (-0.34, -0.52), "front": (-0.34, 0.52), "saddle": (-0.9, -0.2),
              "pedals": (-0.3, -0.02), "head": (-0.86, 0.36), "bar": (-1.05, 0.36)}  # fmt: skip
    links = ("rear saddle", "rear pedals", "pedals saddle", "pedals head", "saddle head",
             "head front", "head bar")  # fmt: skip
    for link in links:
        start, stop = ((0.0, *joints[name]) for name in link.split())
        builder.tube(start, stop, (0.022, 0.022), frame, 5)
    builder.tube((-0.28, -1.06, 0.36), (0.28, -1.06, 0.36), (0.016, 0.016), _BLACK, 4)
    builder.box((0, -0.94, -0.22), (0.16, 0.06, 0.26), _BLACK)


def _trunk(
    builder: MeshBuilder, rng: np.random.Generator, hip: tuple, neck: tuple, coat: Surface
) -> None:
    low, high = np.array(hip), np.array(neck)
    builder.tube(low, (low + high) / 2, (0.17, 0.2), coat, 10)
    builder.tube((low + high) / 2, high, (0.2, 0.16), coat, 10)
    add_ball(builder, high, (0.2, 0.09, 0.13), coat, 1)
    if rng.random() < 0.3:
        middle = low * 0.35 + high * 0.65 - [0, 0, 0.2]
        builder.box(middle, (0.3, 0.42, 0.18), _cloth(rng, 0.4))


def _head(builder: MeshBuilder, rng: np.random.Generator, centre: tuple) -> None:
    middle = np.array(centre)
    skin = Surface("skin", _SKINS[rng.integers(len(_SKINS))])
    r, g, b = rng.uniform(0.01, 0.25) * np.array([1, 0.8, 0.6])
    builder.tube(middle + np.array([0, 0.2, 0]), middle, (0.06, 0.06), skin, 6)
    add_ball(builder, middle, (0.085, 0.125, 0.1), skin, 2)
    add_ball(
        builder, middle - [0, 0.03, 0.02], (0.098, 0.11, 0.105), Surface("cloth", (r, g, b)), 2
    )


def _cloth(rng: np.random.Generator, light: Number) -> Surface:
    r, g, b = rng.uniform(0.1, 1, 3) * rng.uniform(0.15, 1) * light
    return Surface("cloth", (r, g, b), 0.6, int(rng.integers(4)))
