"""Synthetic streets, as the camera of a car sees them.

By streets alone a matcher learns the shape of streets, upright walls beside a plane: ``clutter``
and ``near`` have other shapes.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float64

from depthpose.depth.synthetic import road as roads
from depthpose.depth.synthetic.materials import Appearance
from depthpose.depth.synthetic.mesh import MeshBuilder, Rotation, join_meshes, quads_between
from depthpose.depth.synthetic.randomness import Stream, make_rng
from depthpose.depth.synthetic.roadside import add_roadside
from depthpose.depth.synthetic.scene import (
    CrossBar,
    LaneLine,
    Markings,
    SyntheticScene,
    Vector,
    draw_weather,
)
from depthpose.depth.synthetic.traffic import Traffic

_REACH_BEHIND_M = 12
"""Distance behind the camera beyond which nothing casts a visible shadow."""


def make_street(seed: tuple[int, ...], mount_height_m: float = 1.65) -> SyntheticScene:
    """Make the street that belongs to ``seed``, any whole numbers.

    ``mount_height_m``: mean height of the cameras above the road; it varies by some centimetres.
    """
    rng = make_rng(Stream.STREET, *seed)
    road = roads.draw_road(rng)

    # Everything along a straight road, which is then bent.
    builder = MeshBuilder(rng)
    roads.add_ground(builder, road)
    add_roadside(builder, road)
    traffic = Traffic(builder, road)
    traffic.add_parked()
    traffic.add_driving()
    traffic.add_people()
    street = roads.bend(builder.finish(), road)

    # The hills have a builder of their own, since they do not follow the curves of the road.
    hills_builder = MeshBuilder(rng)
    _add_hills(hills_builder)
    hills = hills_builder.finish()
    hills = replace(hills, object_id=hills.object_id + street.object_id.max() + 1)

    # Into the camera's frame. Points are rows here, so R p is written p @ R.T.
    camera_from_world, position_m = _draw_camera(rng, mount_height_m)
    R = camera_from_world.astype(np.float32)
    mesh = join_meshes([street, hills])
    corners = (mesh.corners - position_m.astype(np.float32)) @ R.T
    mesh = replace(mesh, corners=corners, normals=mesh.normals @ R.T)
    is_in_reach = corners[:, :, 2].max(1) > -_REACH_BEHIND_M
    return SyntheticScene(
        mesh=mesh.select(is_in_reach),
        markings=_draw_markings(rng, road),
        weather=draw_weather(rng),
        camera_from_world=camera_from_world,
        place=road.place,
    )


def _draw_camera(rng: np.random.Generator, mount_height_m: float) -> tuple[Rotation, Vector]:
    """Draw the rotation ``camera_from_world`` and the position of a camera in the world [m].

    It is nearly level, and sometimes turned away from the road's direction.
    """
    pitch = rng.normal(0, 0.012)
    roll = rng.normal(0, 0.009)
    yaw = rng.normal(0, 0.03) if rng.random() < 0.8 else rng.normal(0, 0.2)
    position_m = np.array([rng.normal(0, 0.05), -mount_height_m + rng.normal(0, 0.04), 0.0])
    return _make_rotation(pitch, yaw, roll), position_m


def _make_rotation(pitch: float, yaw: float, roll: float) -> Float64[np.ndarray, "3 3"]:
    """Make a camera's rotation of angles [rad] about x, y and z; yaw first, roll last."""
    c = np.cos([pitch, yaw, roll])
    s = np.sin([pitch, yaw, roll])
    about_x = np.array([[1, 0, 0], [0, c[0], -s[0]], [0, s[0], c[0]]])
    about_y = np.array([[c[1], 0, s[1]], [0, 1, 0], [-s[1], 0, c[1]]])
    about_z = np.array([[c[2], -s[2], 0], [s[2], c[2], 0], [0, 0, 1]])
    return about_z @ about_x @ about_y


_HILLS_M = 900
"""Distance of the hills."""


def _add_hills(builder: MeshBuilder) -> None:
    """Add a ring of hills or woods ahead, 900 m away."""
    # The height over the angle is a sum of sine waves, the higher their frequency the smaller.
    angle = np.linspace(-1.35, 1.35, 120)
    wave = np.zeros_like(angle)
    for frequency in (3, 7, 17, 43):
        wave += np.sin(angle * frequency + builder.rng.uniform(0, 6.28)) / frequency**0.7
    height = builder.rng.uniform(8, 40) * np.clip(0.55 + 0.45 * wave, 0.1, None)

    # One row of faces, from 90 m below the road, which may slope, to that height.
    x = _HILLS_M * np.sin(angle)
    z = _HILLS_M * np.cos(angle)
    foot_y = np.full_like(x, 90)
    along = np.arange(len(angle)) * 12.0  # on the texture
    faces = quads_between(np.stack([x, foot_y, z], 1), np.stack([x, -height, z], 1))
    uv = quads_between(np.stack([along, -foot_y], 1), np.stack([along, height], 1))
    variant = int(builder.rng.integers(2))
    builder.add_quads(faces, uv, Appearance("hills", (0.045, 0.065, 0.03), 150.0, variant))


def _draw_markings(rng: np.random.Generator, road: roads.Road) -> Markings:
    """Draw random markings: lines of the lanes; stop lines and zebra crossings at side streets."""
    is_marked = road.place in ("avenue", "rural", "forest") or rng.random() < 0.5
    dash_m = float(rng.uniform(2, 6))
    half_width_m = float(rng.uniform(0.05, 0.08))
    period_m = dash_m * float(rng.uniform(2, 3))
    left_m = road.edge_m[roads.LEFT]
    right_m = road.edge_m[roads.RIGHT]
    first_lane_x_m = left_m + road.parking_m[roads.LEFT]

    # Lines along the lanes: solid at both edges, where a kerb often replaces them, and at times in
    # the middle.
    lines: list[LaneLine] = []
    line_count = road.lanes + 1 if is_marked else 0
    for line in range(line_count):
        is_edge = line in (0, road.lanes)
        is_solid = is_edge or (line == road.lanes // 2 and rng.random() < 0.3)
        if is_edge and road.curb_m and rng.random() < 0.7:
            continue
        inset_m = 0.0
        if is_edge:
            inset_m = 0.15 if line == 0 else -0.15
        marking = LaneLine(
            x_m=float(first_lane_x_m + line * road.lane_m + inset_m),
            half_width_m=half_width_m,
            period_m=period_m,
            dash_m=period_m if is_solid else dash_m,
        )
        lines.append(marking)

    # Zebra crossings, and stop lines of the right half, before side streets.
    bars: list[CrossBar] = []
    for street in road.side_streets:
        start_m = street.s_m - street.half_m
        if rng.random() < 0.4:
            zebra = CrossBar(
                s_m=float(start_m - 3.5),
                half_length_m=1.5,
                first_x_m=left_m,
                last_x_m=right_m,
                is_striped=True,
            )
            bars.append(zebra)
        if rng.random() < 0.4:
            stop_line = CrossBar(
                s_m=float(start_m - 6),
                half_length_m=0.2,
                first_x_m=(left_m + right_m) / 2,
                last_x_m=right_m,
                is_striped=False,
            )
            bars.append(stop_line)
    return Markings(
        lines=tuple(lines),
        bars=tuple(bars),
        brightness=rng.uniform(0.4, 0.75),
        first_lane_x_m=first_lane_x_m,
        lane_m=road.lane_m,
    )
