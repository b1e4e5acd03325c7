"""Twenty parts whose poses are easily confused: long, thin, toothed and nearly symmetric ones.

Imported by ``score_parts`` and ``fit_probability``. Each part has one small feature that decides
between two similar poses, such as the block at one end of a profile. Its twin has that feature in
another place. Sizes of the parts are in millimetres.
"""

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
import torch
import trimesh
from torch import Tensor

from depthpose.core.camera.pinhole import intrinsics
from depthpose.core.loop import make_sample_generator
from depthpose.core.render import rasterize
from depthpose.core.rigid import Rigid
from depthpose.pose.config import SensorKind, SyntheticSensorConfig
from depthpose.pose.mesh import drawn_triangles
from depthpose.pose.synthetic.depth_sensors import simulate_depth
from depthpose.pose.synthetic.parts import (
    Mesh,
    join,
    make_box,
    make_circle,
    make_ring,
    move,
    revolve,
    rotate,
)
from depthpose.pose.synthetic.random_numbers import random_rotation, uniform
from depthpose.pose.types import ObjectModel

FOCAL_PX = 570.0
WIDTH, HEIGHT = 640, 480
K = intrinsics(FOCAL_PX, FOCAL_PX, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)
SENSORS: tuple[SensorKind, ...] = ("structured light", "active stereo", "time of flight", "laser")
"""Simulated in turn, from view to view."""
MIN_DISTANCE_M = 0.35  # of these sensors
LENGTH_PX = (120.0, 300.0)  # of a part in an image
MIN_MASK_PX = 300
MIN_DIFFERENT_PX = 200
"""A view shows the difference between a part and its twin if so many pixels of depth differ."""
MIN_DIFFERENCE_M = 0.012
"""Of such a pixel: more than three deviations of these sensors' noise at the usual distance."""
MAX_TRIES = 20  # random poses for each view
SEED = 0x20A7
Y = (0.0, 1.0, 0.0)


class Part(NamedTuple):
    """A part and its twin, which differs in one feature.

    ``mesh``: makes the mesh by the shift of that feature [mm]. ``twin_mm``: its shift in the twin.
    ``symmetry``: of the true surface, as :func:`~depthpose.pose.mesh.declare_symmetry` takes it.
    ``right_deg``: rotations with a smaller error are right; at most half a tooth. ``is_held``: left
    out of every choice.
    """

    mesh: Callable[[float], Mesh]
    twin_mm: float
    symmetry: str | None = None
    right_deg: float = 15.0
    is_held: bool = False

    def as_trimesh(self, *, is_twin: bool = False) -> trimesh.Trimesh:
        """Make the mesh of the part or of its twin."""
        vertices, faces = self.mesh(self.twin_mm if is_twin else 0.0)
        return trimesh.Trimesh(vertices, faces, process=False)


def teeth(number: int, radius: float, depth: float, *, is_leaning: bool = False) -> np.ndarray:
    """Outline a toothed wheel about the origin, with as many corners as a circle."""
    unit = make_circle(1.0)
    phase = number * np.arange(len(unit)) % len(unit) / len(unit)  # 0 to 1 over each tooth
    height = 1 - 2 * phase if is_leaning else np.tanh(3 * np.cos(2 * math.pi * phase))
    return (radius + depth / 2 * height)[:, None] * unit


def notched(radius: float, depth: float, width_rad: float) -> np.ndarray:
    """Outline a circle with a notch along x; one of negative depth points outward."""
    unit = make_circle(1.0)
    is_notch = unit[:, 0] > math.cos(width_rad / 2)
    return (radius - depth * is_notch)[:, None] * unit


def bar(length: float, radius: float) -> Mesh:
    """A round bar along x."""
    half = length / 2
    upright = revolve([(0, -half), (radius, -half), (radius, half), (0, half)])
    return rotate(upright, Y, 90.0)


def profile(shift: float) -> Mesh:
    """An L profile of 600 mm with a block at one end."""
    flange = move(make_box((600, 40, 3)), (0, 0, -11))
    web = move(make_box((600, 3, 25)), (0, -18.5, 0))
    return join(flange, web, move(make_box((20, 30, 12)), (285 - shift, 2, -4)))


def channel(shift: float) -> Mesh:
    """A U channel of 500 mm with a wall near one end."""
    base = move(make_box((500, 30, 2)), (0, 0, -14))
    sides = [move(make_box((500, 2, 30)), (0, y, 0)) for y in (-14.0, 14.0)]
    return join(base, *sides, move(make_box((3, 28, 26)), (240 - shift, 0, 0)))


def keyed_shaft(shift: float) -> Mesh:
    """A shaft of 300 mm with a key near one end."""
    return join(bar(300, 12), move(make_box((40, 6, 10)), (115 - shift, 0, 11)))


def flat_shaft(shift: float) -> Mesh:
    """A shaft of 250 mm with a flat of 60 mm at one end."""
    outline = make_circle(14.0).copy()
    outline[:, 0] = np.minimum(outline[:, 0], 8.0)
    flat = rotate(make_ring(outline, make_circle(0.01), 60.0 + shift), Y, 90.0)
    round_part = bar(190.0 - shift, 14.0)
    return join(move(round_part, (-30.0 - shift / 2, 0, 0)), move(flat, (95 - shift / 2, 0, 0)))


def flanged_tube(shift: float) -> Mesh:
    """A tube of 350 mm with a flange near one end."""
    tube = rotate(make_ring(make_circle(20), make_circle(16), 350), Y, 90.0)
    flange = rotate(make_ring(make_circle(32), make_circle(18), 8), Y, 90.0)
    return join(tube, move(flange, (160 - shift, 0, 0)))


def rail(shift: float) -> Mesh:
    """A rail of 400 mm with two carriages, not at equal distances from the ends."""
    carriages = [move(make_box((50, 36, 16)), (x, 0, 12)) for x in (-130.0, 90.0 + shift)]
    return join(make_box((400, 24, 14)), *carriages)


def plate(shift: float) -> Mesh:
    """A plate of 3 mm with a boss off its middle."""
    return join(
        make_box((150, 100, 3)),
        move(make_ring(make_circle(14), make_circle(7), 8), (35 - shift, 18, 4)),
    )


def washer(shift: float) -> Mesh:
    """A washer of 3 mm with a notch."""
    return make_ring(notched(40, 9 - shift, 0.5), make_circle(20), 3)


def sheet_bracket(shift: float) -> Mesh:
    """A bracket of sheet metal of 2 mm, with a tab on one side."""
    base = make_box((80, 60, 2))
    wall = move(make_box((2, 60, 50)), (-39, 0, 25))
    return join(base, wall, move(make_box((20, 2, 14)), (15 - shift, 29, 7)))


def clip(shift: float) -> Mesh:
    """A clip of sheet metal with legs of unlike length."""
    back = move(make_box((2, 24, 40)), (-30, 0, 0))
    long_leg = move(make_box((70, 24, 2)), (5, 0, 19))
    short_leg = move(make_box((50 + shift, 24, 2)), (-5 + shift / 2, 0, -19))
    return join(back, long_leg, short_leg)


def comb(shift: float) -> Mesh:
    """A comb of five prongs, of which the outer one is shorter."""
    prongs = [move(make_box((8, 60, 4)), (x, 38, 0)) for x in (-40.0, -20.0, 0.0, 20.0)]
    return join(
        make_box((100, 18, 4)), *prongs, move(make_box((8, 40 + shift, 4)), (40, 28 + shift / 2, 0))
    )


def gear(shift: float) -> Mesh:
    """A gear of 24 teeth with a hub and a keyway."""
    wheel = make_ring(teeth(24, 50, 7), notched(12, -5, 0.6), 14)
    return join(
        wheel, move(make_ring(make_circle(20), notched(12, -5, 0.6), 10 + shift), (0, 0, 12))
    )


def sprocket(shift: float) -> Mesh:
    """A sprocket of 12 teeth with a pin off its middle."""
    pin = revolve([(0, 0), (5, 0), (5, 12), (0, 12)])
    return join(make_ring(teeth(12, 45, 10), make_circle(8), 6), move(pin, (24 - shift, 0, 3)))


def rack(shift: float) -> Mesh:
    """A rack of 200 mm with a block on one end."""
    ridges = [move(make_box((5, 20, 6)), (x, 0, 11)) for x in np.arange(-95.0, 96.0, 10.0)]
    return join(
        make_box((200, 20, 16)), *ridges, move(make_box((16, 20, 12)), (92 - shift, 0, -14))
    )


def ratchet(shift: float) -> Mesh:
    """A ratchet of 16 leaning teeth with a hub on one side."""
    wheel = make_ring(teeth(16, 40, 9, is_leaning=True), make_circle(10), 8)
    return join(wheel, move(make_ring(make_circle(18), make_circle(10), 12 + shift), (0, 0, 10)))


def nut(shift: float) -> Mesh:
    """A nut of 60 mm with a collar on one side."""
    unit = make_circle(1.0)
    angle = np.arange(len(unit)) * (2 * math.pi / len(unit))
    to_side = (angle + math.pi / 6) % (math.pi / 3) - math.pi / 6
    hexagon = (30 / np.cos(to_side))[:, None] * unit
    collar = move(make_ring(make_circle(38 - shift), make_circle(16), 4), (0, 0, -12))
    return join(make_ring(hexagon, make_circle(16), 24), collar)


def dice(shift: float) -> Mesh:
    """A cube of 50 mm with a boss off the middle of one face."""
    boss = revolve([(0, 0), (9, 0), (9, 8), (0, 8)])
    return join(make_box((50, 50, 50)), move(boss, (10 - shift, 6, 25)))


def cup(shift: float) -> Mesh:
    """A cup with a small handle."""
    wall = revolve([(0, 0), (30, 0), (36, 70), (32, 70), (27, 5), (0, 5)])
    return join(wall, move(make_box((18, 8, 26)), (40, 0, 40 - shift)))


def knob(shift: float) -> Mesh:
    """A knob with a pointer."""
    body = revolve([(0, 0), (28, 0), (24, 24), (0, 24)])
    return join(body, move(make_box((22, 6, 6)), (12 - shift, 0, 26)))


def lid(shift: float) -> Mesh:
    """A box of 90x50x30 mm with a lip along one long edge."""
    return join(make_box((90, 50, 30)), move(make_box((60, 8, 4)), (shift, 28, 11)))


PARTS: dict[str, Part] = {
    "profile": Part(profile, 40),
    "channel": Part(channel, 40, is_held=True),
    "keyed shaft": Part(keyed_shaft, 30),
    "flat shaft": Part(flat_shaft, 30, is_held=True),
    "flanged tube": Part(flanged_tube, 30, "x,free"),
    "rail": Part(rail, 20, is_held=True),
    "plate": Part(plate, 12),
    "washer": Part(washer, -7, "x,2", is_held=True),
    "sheet bracket": Part(sheet_bracket, 14),
    "clip": Part(clip, 10, is_held=True),
    "comb": Part(comb, 12),
    "gear": Part(gear, 10, right_deg=7.5),
    "sprocket": Part(sprocket, 10, right_deg=14.0, is_held=True),
    "rack": Part(rack, 20),
    "ratchet": Part(ratchet, 20, "z,16", right_deg=10.0, is_held=True),
    "nut": Part(nut, 12, "z,6"),
    "dice": Part(dice, 12, is_held=True),
    "cup": Part(cup, 14),
    "knob": Part(knob, 14, is_held=True),
    "lid": Part(lid, 14, is_held=True),
}


class PartView(NamedTuple):
    """A view of a part: depth [m], its exact mask, the true pose."""

    depth_m: Tensor
    mask: Tensor
    truth: Rigid


def views(
    model: ObjectModel, number: int, seed: int, unlike: ObjectModel | None = None
) -> Iterator[PartView]:
    """Render views of a part before a wall, from any side, measured by one sensor after another.

    Args:
        model: of the part.
        number: of views; up to ``MAX_TRIES`` random poses are tried for each.
        seed: of the random poses.
        unlike: only views in which this model in the same pose looks different.
    """
    triangles_m = drawn_triangles(model).double()
    centre_of_model_m = triangles_m.reshape(-1, 3).mean(0)
    view_count = 0
    for attempt in range(MAX_TRIES * number):
        generator = make_sample_generator(attempt, SEED + seed)
        length_px = uniform(generator, *LENGTH_PX)
        distance_m = max(MIN_DISTANCE_M, FOCAL_PX * model.diameter_m / length_px)
        R = random_rotation(generator).double()
        sideways_m = (torch.rand(2, generator=generator).double() - 0.5) * 0.2 * distance_m
        centre_m = torch.cat([sideways_m, torch.tensor([distance_m], dtype=torch.float64)])
        truth = Rigid(R, centre_m - R @ centre_of_model_m)
        part_m = render_depth(model, truth)
        mask = part_m.isfinite()
        if int(mask.sum()) < MIN_MASK_PX or touches_border(mask):
            continue
        wall_m = distance_m + 0.6 * model.diameter_m + 0.2
        scene_m = torch.where(mask, part_m, wall_m)
        if unlike is not None:
            other_scene_m = render_depth(unlike, truth).clamp(max=wall_m)
            is_different = (scene_m - other_scene_m).abs() > MIN_DIFFERENCE_M
            if int(is_different.sum()) < MIN_DIFFERENT_PX:
                continue
        sensor = SyntheticSensorConfig(kinds=(SENSORS[view_count % len(SENSORS)],))
        depth_m = simulate_depth(scene_m.float(), (FOCAL_PX, FOCAL_PX), sensor, generator)
        yield PartView(depth_m, mask, truth)
        view_count += 1
        if view_count == number:
            return


def render_depth(model: ObjectModel, pose: Rigid) -> Tensor:
    """Render the depth of a posed model; infinite beside it."""
    points_m = drawn_triangles(model).double().reshape(-1, 3)
    triangles_m = pose.apply(points_m).reshape(-1, 3, 3)
    return rasterize(triangles_m, K, WIDTH, HEIGHT).depth_m


def touches_border(mask: Tensor) -> bool:
    """Whether a pixel of a mask lies at the border of the image."""
    return bool(mask[0].any() | mask[-1].any() | mask[:, 0].any() | mask[:, -1].any())
