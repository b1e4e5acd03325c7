"""Synthetic scenes, streets and clutter: mesh, weather and markings; and the rigs that see them.

Rigs are those of KITTI's recording days. By streets alone a matcher learns the shape of streets,
upright walls beside a plane. Clutter has thin, slanted, round, leafy, textureless, repetitive and
reflecting objects at every distance.
"""

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float64

from depthpose.core.camera import StereoRig
from depthpose.depth.config import StreetsConfig
from depthpose.depth.synthetic import road as roads
from depthpose.depth.synthetic.mesh import (
    Mesh,
    MeshBuilder,
    Rotation,
    Surface,
    Values,
    between,
    join,
)
from depthpose.depth.synthetic.models import add_ball, add_leaves

Vector = Float64[np.ndarray, "3"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Weather:
    """The light of a scene."""

    sun: Vector  # unit vector towards the sun, in the world's frame (y down)
    sun_color: Vector  # linear light of the sun; small where clouds cover it
    zenith: Vector  # light of the sky at the zenith
    horizon: Vector  # light of the sky at the horizon
    is_overcast: bool  # no shadows are cast
    cloud: float  # cover of clouds: 0 a clear sky, 1 covered
    haze_m: float  # distance at which two thirds of the light come from haze
    shift: tuple[float, float]  # offset of the textures of clouds and stains, in tiles


def draw_weather(rng: np.random.Generator) -> Weather:
    """Draw random weather: mostly sunny, as KITTI's, else overcast; sometimes hazy."""
    is_overcast = bool(rng.random() < 0.25)
    height = np.deg2rad(rng.uniform(12, 62))
    turn = rng.uniform(0, 2 * np.pi)
    sun = np.array([np.cos(height) * np.sin(turn), -np.sin(height), np.cos(height) * np.cos(turn)])
    low = np.clip((height - 0.2) / 0.6, 0, 1)
    strength = rng.uniform(0, 0.2) if is_overcast else rng.uniform(3.2, 5.0)
    sky = rng.uniform(0.8, 1.5) * (1.2 if is_overcast else 1.0)
    blue = np.array([0.85, 0.9, 1.0]) if is_overcast else np.array([0.13, 0.33, 0.85])
    pale = np.array([0.95, 0.98, 1.0]) if is_overcast else np.array([0.42, 0.68, 1.05])
    glare = 1.0 if is_overcast else max(1.0, float(np.exp(rng.uniform(-0.5, 1.3))))
    haze = rng.uniform(220, 600) if rng.random() < 0.12 else rng.uniform(600, 4000)
    return Weather(
        sun=sun,
        sun_color=np.array([1.0, 0.78 + 0.18 * low, 0.55 + 0.36 * low]) * strength,
        zenith=blue * sky * glare**0.5,
        # A brighter sky is whiter.
        horizon=(pale / glare + (1 - 1 / glare)) * sky * glare,
        is_overcast=is_overcast,
        cloud=float(rng.uniform(0.3, 1)) if is_overcast else float(rng.uniform(0, 1)) ** 2,
        haze_m=float(haze),
        shift=(float(rng.random()), float(rng.random())),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Markings:
    """Paint on the road, in road coordinates (x across, s along) [m]."""

    # Along the road: x, half width, period and length of the dashes; both equal for a solid line.
    lines: Float64[np.ndarray, "n 4"]
    # Across the road: s, half length, first and last x, and 1 if it is striped, else 0.
    bars: Float64[np.ndarray, "m 5"]
    brightness: float  # brightness of the paint
    wheel_tracks: tuple[float, float]  # x of the left lane's left edge, width of the lanes


@dataclass(frozen=True, kw_only=True, eq=False)
class StreetScene:
    """A street or clutter, in the frame of its left camera (x right, y down, z forward) [m]."""

    mesh: Mesh  #: all surfaces
    markings: Markings  #: paint on the road
    weather: Weather  #: the light, in the world's frame
    camera_from_world: Float64[np.ndarray, "3 3"]  #: rotation of the camera
    place: roads.Place | Literal["clutter"]  #: kind of the scene


def make_scene(seed: tuple[int, ...], mount_height_m: float = 1.65) -> StreetScene:
    """Make the street that belongs to ``seed``, any whole numbers.

    ``mount_height_m``: mean height of the cameras above the road; it varies by some centimetres.
    """
    rng = np.random.default_rng([71, *seed])
    road = roads.draw_road(rng)
    builder = MeshBuilder(rng)
    roads.add_ground(builder, road)
    roads.add_roadside(builder, road)
    traffic = roads.Traffic(builder, road)
    traffic.add_parked()
    traffic.add_driving()
    traffic.add_people()
    street = roads.bend(builder.finish(), road)
    # The hills have a builder of their own, since they do not follow the curves of the road.
    hills_builder = MeshBuilder(rng)
    _add_hills(hills_builder)
    hills = hills_builder.finish()
    hills = replace(hills, thing=hills.thing + street.thing.max() + 1)

    # Into the camera's frame. Points are rows here, so R p is written p @ R.T.
    camera_from_world, position_m = _draw_camera(rng, mount_height_m)
    R = camera_from_world.astype(np.float32)
    mesh = join([street, hills])
    corners = (mesh.corners - position_m.astype(np.float32)) @ R.T
    mesh = replace(mesh, corners=corners, normals=mesh.normals @ R.T)
    is_near_view = corners[:, :, 2].max(1) > -12  # farther behind nothing casts a visible shadow
    return StreetScene(
        mesh=mesh.part(is_near_view),
        markings=_draw_markings(rng, road),
        weather=draw_weather(rng),
        camera_from_world=camera_from_world,
        place=road.place,
    )


def _draw_camera(rng: np.random.Generator, mount_height_m: float) -> tuple[Rotation, Vector]:
    """Draw the rotation ``camera_from_world`` and the place of a camera in the world [m].

    It is nearly level, and sometimes turned away from the road's direction.
    """
    pitch = rng.normal(0, 0.012)
    roll = rng.normal(0, 0.009)
    yaw = rng.normal(0, 0.03) if rng.random() < 0.8 else rng.normal(0, 0.2)
    position_m = np.array([rng.normal(0, 0.05), -mount_height_m + rng.normal(0, 0.04), 0.0])
    return _make_rotation(pitch, yaw, roll), position_m


def _add_hills(b: MeshBuilder) -> None:
    """Add a ring of hills or woods, 900 m away."""
    angle = np.linspace(-1.35, 1.35, 120)
    wave = np.zeros_like(angle)
    for frequency in (3, 7, 17, 43):
        wave += np.sin(angle * frequency + b.rng.uniform(0, 6.28)) / frequency**0.7
    height = b.rng.uniform(8, 40) * np.clip(0.55 + 0.45 * wave, 0.1, None)
    x = 900 * np.sin(angle)
    z = 900 * np.cos(angle)
    along = np.arange(len(angle)) * 12.0
    faces = between(np.stack([x, 0 * x + 90, z], 1), np.stack([x, -height, z], 1))
    uv = between(np.stack([along, 0 * along - 90], 1), np.stack([along, height], 1))
    b.quads(faces, uv, Surface("hills", (0.045, 0.065, 0.03), 150.0, int(b.rng.integers(2))))


def _make_rotation(pitch: float, yaw: float, roll: float) -> Float64[np.ndarray, "3 3"]:
    """Make a camera's rotation of angles [rad] about x, y and z; yaw first, roll last."""
    c = np.cos([pitch, yaw, roll])
    s = np.sin([pitch, yaw, roll])
    about_x = np.array([[1, 0, 0], [0, c[0], -s[0]], [0, s[0], c[0]]])
    about_y = np.array([[c[1], 0, s[1]], [0, 1, 0], [-s[1], 0, c[1]]])
    about_z = np.array([[c[2], -s[2], 0], [s[2], c[2], 0], [0, 0, 1]])
    return about_z @ about_x @ about_y


def _draw_markings(rng: np.random.Generator, road: roads.Road) -> Markings:
    """Draw random markings: lines of the lanes; stop lines and zebra crossings at side streets."""
    is_marked = road.place in ("avenue", "rural", "forest") or rng.random() < 0.5
    dash_m = rng.uniform(2, 6)
    half_width_m = rng.uniform(0.05, 0.08)
    period_m = dash_m * rng.uniform(2, 3)
    first_x_m = road.edge_m[-1] + road.parking_m[0]
    lines: list[tuple[float, ...]] = []
    bars: list[tuple[float, ...]] = []
    for line in range(road.lanes + 1) if is_marked else ():
        is_edge = line in (0, road.lanes)
        is_solid = is_edge or (line == road.lanes // 2 and rng.random() < 0.3)
        if is_edge and road.curb_m and rng.random() < 0.7:
            continue
        inset_m = 0.0
        if is_edge:
            inset_m = 0.15 if line == 0 else -0.15
        x = first_x_m + line * road.lane_m + inset_m
        lines.append((x, half_width_m, period_m, period_m if is_solid else dash_m))

    for street in road.side_streets:
        start = street.s_m - street.half_m
        if rng.random() < 0.4:
            bars.append((start - 3.5, 1.5, road.edge_m[-1], road.edge_m[1], 1.0))
        if rng.random() < 0.4:
            middle = (road.edge_m[-1] + road.edge_m[1]) / 2
            bars.append((start - 6, 0.2, middle, road.edge_m[1], 0.0))
    return Markings(
        lines=np.array(lines, float).reshape(-1, 4),
        bars=np.array(bars, float).reshape(-1, 5),
        brightness=rng.uniform(0.4, 0.75),
        wheel_tracks=(first_x_m, road.lane_m),
    )


KITTI_RIGS = (
    (1242, 375, 721.5377, 609.5593, 172.8540, 0.5327),
    (1224, 370, 707.0493, 604.0814, 180.5066, 0.5373),
    (1238, 374, 718.3351, 600.3891, 181.5122, 0.5301),
    (1226, 370, 707.0912, 601.8873, 183.1104, 0.5371),
    (1241, 376, 718.8560, 607.1928, 185.2157, 0.5372),
)
"""Width, height, focal length, principal point [px] and baseline [m] of the five recording days."""

_KITTI_SHARES = (0.6, 0.1, 0.1, 0.1, 0.1)
"""Nearly all benchmarks are of the first day."""


def rig_number(config: StreetsConfig, index: int) -> int:
    """Draw which of KITTI's rigs a frame has; most often that of the first day."""
    rng = np.random.default_rng([72, config.seed, index])
    return int(rng.choice(len(KITTI_RIGS), p=_KITTI_SHARES))


def kitti_rig(number: int = 0) -> StereoRig:
    """Give the rig of one of KITTI's five recording days, as published."""
    width, height, focal_px, cx, cy, baseline_m = KITTI_RIGS[number]
    K = torch.tensor([[focal_px, 0, cx], [0, focal_px, cy], [0, 0, 1]], dtype=torch.float64)
    return StereoRig(width=width, height=height, K=K, baseline_m=baseline_m)


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """Draw a number between two others whose logarithm is uniformly distributed."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


_DEPTHS_M = (3.5, 45.0)
"""Nearest and farthest centre of an object of clutter; with KITTI's rig 110 and 9 px of
disparity."""

_PLAIN = ("paint", "skin", "glass", "plaster", "metal")
_RICH = ("pavement", "grass", "brick", "stone", "concrete", "roof", "bark", "leaf", "wood", "side",
         "pane", "plate", "sign", "poster", "cloth", "dirt", "hills")  # fmt: skip
_PLAIN_SHARE = 0.3
_SHAPES = ("ball", "box", "box", "card", "pole", "pole", "fence", "wheel", "lattice", "leaves")
"""Kinds of objects of clutter; a kind is repeated in proportion to how often it is drawn."""


def make_clutter(seed: tuple[int, ...]) -> StreetScene:
    """Make the clutter that belongs to ``seed``, any whole numbers."""
    rng = np.random.default_rng([74, *seed])
    b = MeshBuilder(rng)

    def sheet(corner: Values, along: Values, up: Values) -> None:
        b.thing += 1
        b.rectangle(corner, along, up, random_surface(rng, rng.uniform(0.5, 4)))

    # The backdrop: a slightly slanted ground; a ground and a wall; or the inside of a box.
    backdrop = int(rng.integers(3))
    if backdrop == 2:
        half = rng.uniform(3, 14)
        depth = rng.uniform(8, 45)
        floor = rng.uniform(1, 3)
        top = rng.uniform(-6, -2)
        up = [0, -(floor - top), 0]
        sheet([-half, floor, 0], [2 * half, 0, 0], [0, 0, depth])
        sheet([-half, floor, depth], [2 * half, 0, 0], up)
        for x in (-half, half):
            sheet([x, floor, 0], [0, 0, depth], up)
        if rng.random() < 0.6:
            sheet([-half, top, 0], [2 * half, 0, 0], [0, 0, depth])
    elif backdrop == 1:
        turn = rng.uniform(-0.9, 0.9)
        z = rng.uniform(18, 60)
        along = np.array([np.cos(turn), rng.normal(0, 0.1), np.sin(turn)]) * 300
        sheet(np.array([0, 20, z]) - along / 2, along, [0, -40, rng.normal(0, 10)])
    if backdrop != 2:
        y = rng.uniform(1.0, 3.0)
        slope = rng.normal(0, 0.02)
        sheet([-150, y, 0], [300, rng.normal(0, 8), 0], [0, slope * 300, 300])

    for _ in range(int(rng.integers(12, 60))):
        b.thing += 1
        z = log_uniform(rng, *_DEPTHS_M)
        centre = np.array([rng.uniform(-0.95, 0.95) * z, rng.uniform(-0.3, 0.3) * z, z])
        size_m = min(z, 25.0) * log_uniform(rng, 0.03, 0.3)
        add_shape(b, _SHAPES[int(rng.integers(len(_SHAPES)))], centre, size_m)
    mesh = b.finish()

    # No object may be nearer than the rig's largest disparity allows. The backdrop reaches behind
    # the camera, and is told by its large triangles.
    is_far = mesh.corners[:, :, 2].min(1) > 0.85 * _DEPTHS_M[0]
    is_far_enough = is_far | (np.ptp(mesh.corners, axis=1).max(1) > _DEPTHS_M[0])
    return StreetScene(
        mesh=mesh.part(is_far_enough),
        markings=Markings(
            lines=np.zeros((0, 4)), bars=np.zeros((0, 5)), brightness=0.5, wheel_tracks=(0.0, 3.0)
        ),
        weather=draw_weather(rng),
        camera_from_world=np.eye(3),
        place="clutter",
    )


def random_surface(rng: np.random.Generator, size_m: float) -> Surface:
    """Draw a surface of any material and colour for an object of ``size_m``, mostly pale ones."""
    names = _PLAIN if rng.random() < _PLAIN_SHARE else _RICH
    tile_m = size_m * log_uniform(rng, 0.15, 3.0)
    material = names[int(rng.integers(len(names)))]
    grey = log_uniform(rng, 0.03, 0.8)
    color = np.clip(grey * np.exp(rng.normal(0, rng.choice([0.05, 0.4, 1.0]), 3)), 0.01, 0.9)
    return Surface(material, tuple(color.tolist()), tile_m, int(rng.integers(8)))


def random_rotation(rng: np.random.Generator) -> Rotation:
    """Draw a uniformly distributed rotation."""
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.sign(np.linalg.det(q))


def add_shape(b: MeshBuilder, kind: str, centre: np.ndarray, size_m: float) -> None:
    """Add an object of a kind of ``_SHAPES`` about a point, with a random surface and shape."""
    rng = b.rng
    match kind:
        case "ball":
            radii = size_m / 2 * rng.uniform(0.5, 1.5, 3)
            dents = rng.uniform(0, 0.5) if rng.random() < 0.6 else 0.0
            add_ball(b, centre, radii, random_surface(rng, size_m), 3, dents)
        case "box":
            R = random_rotation(rng) if rng.random() < 0.5 else np.eye(3)
            sides = size_m * np.exp(rng.normal(0, 0.6, 3))
            b.box(centre, sides, random_surface(rng, size_m), R, rng.uniform(0.4, 1))
        case "card":
            R = random_rotation(rng)
            along = R[0] * size_m * rng.uniform(0.5, 2)
            up = R[1] * size_m * rng.uniform(0.5, 2)
            b.rectangle(centre - (along + up) / 2, along, up, random_surface(rng, size_m))
        case "pole":
            half = random_rotation(rng)[0] * size_m * rng.uniform(0.7, 3)
            if rng.random() < 0.5:
                half = half * [0.05, 1, 0.05]
            radius = size_m * log_uniform(rng, 0.01, 0.2)
            radii = (radius, radius * rng.uniform(0.3, 1))
            b.tube(centre - half, centre + half, radii, random_surface(rng, size_m), 10)
        case "fence":  # bars side by side: repetition has many matches
            turn = rng.uniform(-0.8, 0.8)
            along = np.array([np.cos(turn), 0, np.sin(turn)]) * size_m * rng.uniform(1, 3)
            up = np.array([0, size_m / 2, 0])
            surface = random_surface(rng, size_m)
            count = int(rng.integers(4, 20))
            radius = float(np.linalg.norm(along)) / count * rng.uniform(0.05, 0.3)
            for share in np.linspace(-0.5, 0.5, count):
                foot = centre + share * along
                b.tube(foot - up, foot + up, radius, surface)
            for height in (-0.8, 0.8):
                middle = centre + height * up
                b.tube(middle - along / 2, middle + along / 2, radius, surface)
        case "wheel":  # a rim with spokes: the background is visible through the gaps
            R = random_rotation(rng) if rng.random() < 0.5 else np.eye(3)
            surface = random_surface(rng, size_m)
            radius = size_m * rng.uniform(0.5, 1.2)
            angle = np.linspace(0, 2 * np.pi, 25)[:, None]
            rim = centre + radius * (np.cos(angle) * R[0] + np.sin(angle) * R[1])
            thick = radius * rng.uniform(0.03, 0.2)
            for start, end in pairwise(rim):
                b.tube(start, end, thick, surface, 6)
            thin = radius * rng.uniform(0.01, 0.08)
            for place in np.linspace(0, 24, int(rng.integers(3, 14)), endpoint=False).astype(int):
                b.tube(centre, rim[place], (thin * rng.uniform(1, 2), thin), surface, 6)
        case "lattice":  # flat bars that cross, as shelves, window frames and benches have
            R = random_rotation(rng) if rng.random() < 0.3 else np.eye(3)
            sides = size_m * rng.uniform(0.6, 2.5, 2)
            surface = random_surface(rng, size_m)
            deep = size_m * float(np.exp(rng.uniform(-4, 0)))
            for axis in (0, 1):
                count = int(rng.integers(2, 8))
                bar = np.array([*sides, deep])
                bar[axis] = sides[axis] / count * rng.uniform(0.05, 0.4)
                for share in np.linspace(-0.5, 0.5, count):
                    b.box(centre + share * sides[axis] * R[:, axis], bar, surface, R)
        case _:  # leaves
            radii = size_m * rng.uniform(0.4, 1.2, 3)
            count = int(rng.integers(100, 1200))
            length_m = size_m * rng.uniform(0.03, 0.2)
            surface = random_surface(rng, size_m)
            is_block = bool(rng.random() < 0.3)
            add_leaves(b, centre, radii, count, length_m, surface, is_block)
