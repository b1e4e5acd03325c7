"""People on foot and on bicycles, who face along z; made once and placed many times."""

from functools import cache
from itertools import pairwise

import numpy as np

from depthpose.depth.synthetic.materials import Appearance, Color, Number
from depthpose.depth.synthetic.mesh import Mesh, MeshBuilder
from depthpose.depth.synthetic.randomness import Stream, make_rng

PEDESTRIAN_COUNT = 10
CYCLIST_COUNT = 5
"""Number of different models of each."""

_SKINS: list[Color] = [(0.5, 0.31, 0.22), (0.42, 0.25, 0.17), (0.2, 0.11, 0.07)]
_RUBBER = Appearance("tyre", (0.025, 0.025, 0.028))


@cache
def make_pedestrian(number: int) -> Mesh:
    """Make a person on foot, at a random moment of a step; some carry a bag."""
    builder = MeshBuilder(make_rng(Stream.PEDESTRIAN, number))
    height = builder.rng.uniform(1.55, 1.9)
    step = builder.rng.uniform(-0.28, 0.28)
    coat = _draw_cloth(builder.rng, 0.45)
    trousers = _draw_cloth(builder.rng, 0.22)

    # Legs with shoes, and arms, which swing against them.
    for side in (-1, 1):
        foot = (side * 0.1, -0.04, side * step)
        hip_joint = np.array([side * 0.09, -0.48 * height, 0])
        builder.add_tube(foot, hip_joint, (0.06, 0.09), trousers)
        builder.add_box((foot[0], -0.04, foot[2] + 0.05), (0.09, 0.08, 0.26), _RUBBER)
        hand = (side * 0.27, -0.47 * height, -side * step * 0.8)
        shoulder = (side * 0.2, -0.81 * height, 0)
        builder.add_tube(hand, shoulder, (0.045, 0.06), coat)

    hip = np.array([0, -0.48 * height, 0])
    neck = np.array([0, -0.82 * height, 0.02])
    _add_upper_body(builder, hip, neck, np.array([0, -0.93 * height, 0.03]), coat)
    if builder.rng.random() < 0.4:
        bag = _draw_cloth(builder.rng, 0.4)
        builder.add_box((0.3, -0.4 * height, 0), (0.12, 0.3, 0.34), bag)
    return builder.finish()


def _add_bicycle_wheel(builder: MeshBuilder, z: float, metal: Appearance) -> None:
    """Add a wheel of a bicycle that rides along z: its tyre, its axle and its spokes."""
    radius = 0.33
    axle_y = -0.34
    angle = np.linspace(0, 2 * np.pi, 19)
    rim = np.stack(
        [np.zeros_like(angle), axle_y + radius * np.cos(angle), z + radius * np.sin(angle)], 1
    )
    for start, stop in pairwise(rim):
        builder.add_tube(start, stop, 0.02, _RUBBER, 4)
    builder.add_tube((-0.05, axle_y, z), (0.05, axle_y, z), 0.03, metal, 5)
    for spoke_end in rim[:-1:3]:
        builder.add_tube((0, axle_y, z), spoke_end, 0.005, metal, 3)


_BICYCLE_JOINTS = {
    "rear": (-0.34, -0.52), "front": (-0.34, 0.52), "saddle": (-0.9, -0.2),
    "pedals": (-0.3, -0.02), "head": (-0.86, 0.36), "bar": (-1.05, 0.36),
}  # fmt: skip
"""y and z of the joints of a bicycle's frame [m]."""
_BICYCLE_TUBES = (("rear", "saddle"), ("rear", "pedals"), ("pedals", "saddle"), ("pedals", "head"),
                  ("saddle", "head"), ("head", "front"), ("head", "bar"))  # fmt: skip
"""Joints that a tube of the frame connects."""


@cache
def make_cyclist(number: int) -> Mesh:
    """Make a person on a bicycle, riding along z."""
    builder = MeshBuilder(make_rng(Stream.CYCLIST, number))
    frame = Appearance("metal", tuple(builder.rng.uniform(0.03, 0.4, 3)))

    # The bicycle: wheels, frame, handlebar and saddle.
    for z in (-0.52, 0.52):
        _add_bicycle_wheel(builder, z, frame)
    for start, stop in _BICYCLE_TUBES:
        start_point = (0.0, *_BICYCLE_JOINTS[start])
        stop_point = (0.0, *_BICYCLE_JOINTS[stop])
        builder.add_tube(start_point, stop_point, 0.022, frame, 5)
    builder.add_tube((-0.28, -1.06, 0.36), (0.28, -1.06, 0.36), 0.016, _RUBBER, 4)
    builder.add_box((0, -0.94, -0.22), (0.16, 0.06, 0.26), _RUBBER)

    # The person: legs on the pedals, hands on the handlebar.
    coat = _draw_cloth(builder.rng, 0.45)
    trousers = _draw_cloth(builder.rng, 0.22)
    hip = np.array([0, -0.98, -0.22])
    neck = np.array([0, -1.5, 0.02])
    for side in (-1, 1):
        knee = (side * 0.1, -0.68, 0.15)
        pedal = (side * 0.1, -0.28 - 0.13 * side, 0.0)
        hip_joint = hip + np.array([side * 0.08, 0, 0])
        builder.add_tube(pedal, knee, (0.05, 0.065), trousers)
        builder.add_tube(knee, hip_joint, (0.065, 0.09), trousers)
        hand = (side * 0.25, -1.08, 0.42)
        shoulder = neck + np.array([side * 0.18, 0, 0])
        builder.add_tube(hand, shoulder, (0.04, 0.055), coat)
    _add_upper_body(builder, hip, neck, np.array([0, -1.7, 0.08]), coat)
    return builder.finish()


def _add_upper_body(
    builder: MeshBuilder, hip: np.ndarray, neck: np.ndarray, head: np.ndarray, coat: Appearance
) -> None:
    """Add a trunk with shoulders, sometimes a bag on its back, a neck and a head with hair.

    ``hip``, ``neck`` and ``head`` are the points (3,) where these are [m].
    """
    middle = (hip + neck) / 2
    builder.add_tube(hip, middle, (0.17, 0.2), coat, 10)
    builder.add_tube(middle, neck, (0.2, 0.16), coat, 10)
    builder.add_ellipsoid(neck, (0.2, 0.09, 0.13), coat, 1)
    if builder.rng.random() < 0.3:
        bag = hip * 0.35 + neck * 0.65 - [0, 0, 0.2]
        builder.add_box(bag, (0.3, 0.42, 0.18), _draw_cloth(builder.rng, 0.4))

    skin = Appearance("skin", _SKINS[builder.rng.integers(len(_SKINS))])
    brown = np.array([1, 0.8, 0.6])
    hair = Appearance("cloth", tuple(builder.rng.uniform(0.01, 0.25) * brown))
    builder.add_tube(head + np.array([0, 0.2, 0]), head, 0.06, skin, 6)
    builder.add_ellipsoid(head, (0.085, 0.125, 0.1), skin, 2)
    builder.add_ellipsoid(head - [0, 0.03, 0.02], (0.098, 0.11, 0.105), hair, 2)


def _draw_cloth(rng: np.random.Generator, max_brightness: Number) -> Appearance:
    """Draw a cloth of random colour, no brighter than ``max_brightness``."""
    color = rng.uniform(0.1, 1, 3) * rng.uniform(0.15, 1) * max_brightness
    return Appearance("cloth", tuple(color), 0.6, int(rng.integers(4)))
