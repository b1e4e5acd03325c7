"""Near scenes: rooms, tables, bins, shelves and walls with objects, from 5 cm to 20 m.

Disparity depends on the shape of a scene and on its distance in baselines, not on its size in
metres. So a scene is built and lit at the scale at which its baseline is that of a street's rig,
where textures, shadows and lenses have their usual sizes, and is scaled to its true metres last.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch

from depthpose.core.camera import StereoRig
from depthpose.core.camera.pinhole import intrinsics
from depthpose.core.camera.rectified import grey_from_rgb
from depthpose.core.errors import InputError
from depthpose.depth.config import NearConfig, StreetsConfig
from depthpose.depth.synthetic.dataset import Projector, StreetFrame, draw_scene
from depthpose.depth.synthetic.mesh import MeshBuilder, Values
from depthpose.depth.synthetic.near_shapes import PLAIN, add_thing, random_kind, random_near_surface
from depthpose.depth.synthetic.scene import (
    Markings,
    StreetScene,
    draw_weather,
    log_uniform,
)
from depthpose.depth.types import Mask, View

NearKind = Literal["room", "table", "bin", "shelf", "wall"]
"""Kind of a near scene."""

_KINDS: tuple[NearKind, ...] = ("room", "table", "table", "bin", "shelf", "wall")
"""A kind is repeated in proportion to how often it is drawn."""

_DRAWN_BASELINE_M = 0.5
"""Baseline at which scenes are drawn; with a true one of 5 cm all true lengths are a tenth."""

_BASELINES_M = (0.01, 0.54)
_DISTANCES_M = (0.05, 5.0)
"""Ranges of the baseline and of the distance of the nearest object, in true metres."""
_FARTHEST_M = 20.0
"""Largest distance of a room's back wall, in true metres."""


@dataclass(frozen=True, kw_only=True, eq=False)
class NearScene:
    """A near scene and its rig, at the scale at which it is drawn."""

    scene: StreetScene  #: mesh and light, in the frame of the left camera
    rig: StereoRig  #: the cameras, at the same scale
    metres_per_unit: float  #: true metres per metre of the scene
    kind: NearKind  #: kind of the scene


def make_near(config: NearConfig, index: int) -> NearScene:
    """Make scene ``index``: a function of the configuration and the index alone.

    Raises:
        InputError: the index is negative.
    """
    if index < 0:
        raise InputError(f"index is {index}, but scenes are counted from 0; take another")
    rng = np.random.default_rng([76, config.seed, index])

    # The camera, and the distance of the nearest object.
    low, high = config.columns_px
    width = 16 * round(rng.uniform(low, high) / 16)
    height = 8 * round(width * float(rng.choice([3 / 4, 9 / 16, 5 / 8])) / 8)
    focal_px = width * rng.uniform(0.55, 1.6)
    largest_px = log_uniform(rng, 8, config.largest_share * width)
    near_m = focal_px * _DRAWN_BASELINE_M / largest_px

    # The true scale: a baseline by which the nearest object is within the range of distances.
    baseline_m = log_uniform(rng, *_BASELINES_M)
    distance_m = np.clip(near_m * baseline_m / _DRAWN_BASELINE_M, *_DISTANCES_M)
    least, most = (limit_m / _DRAWN_BASELINE_M for limit_m in _BASELINES_M)
    metres_per_unit = float(np.clip(distance_m / near_m, least, most))

    K = intrinsics(focal_px, focal_px, (width - 1) / 2, (height - 1) / 2)
    rig = StereoRig(width=width, height=height, K=K, baseline_m=_DRAWN_BASELINE_M)

    # The surfaces.
    kind = _KINDS[int(rng.integers(len(_KINDS)))]
    scene_builder = _NearSceneBuilder(
        rng, near_m, (width / focal_px / 2, height / focal_px / 2), config.plain_share
    )
    farthest = min(12.0, _FARTHEST_M / (near_m * metres_per_unit))
    match kind:
        case "room":
            scene_builder.add_room(near_m * log_uniform(rng, 1.5, farthest))
            scene_builder.scatter(int(rng.integers(6, 40)))
        case "table" | "bin":
            scene_builder.add_table(is_bin=kind == "bin")
        case "shelf":
            scene_builder.add_shelf()
        case "wall":
            scene_builder.add_wall(near_m * log_uniform(rng, 1.2, 6))
            scene_builder.scatter(int(rng.integers(3, 30)))
    mesh = scene_builder.builder.finish()
    # Only a backdrop, which reaches beside the camera, may be nearer than the nearest object.
    is_far = mesh.corners[:, :, 2].min(1) > 0.97 * near_m
    is_backdrop = mesh.thing <= scene_builder.backdrop
    weather = replace(draw_weather(rng), haze_m=1e5)
    scene = StreetScene(
        mesh=mesh.part(is_far | is_backdrop),
        markings=Markings(
            lines=np.zeros((0, 4)), bars=np.zeros((0, 5)), brightness=0.5, wheel_tracks=(0.0, 3.0)
        ),
        weather=weather,
        camera_from_world=np.eye(3),
        place="clutter",
    )
    return NearScene(scene=scene, rig=rig, metres_per_unit=metres_per_unit, kind=kind)


def draw_near(config: NearConfig, index: int) -> StreetFrame:
    """Draw scene ``index``, in true metres.

    A share of the pairs is infrared, in grey, and in a share of these a projector adds dots. A
    share has black borders, where truth is unknown.
    """
    near = make_near(config, index)
    rng = np.random.default_rng([78, config.seed, index])
    is_infrared = bool(rng.random() < config.infrared_share)
    projector = None
    if is_infrared and rng.random() < config.dots_share:
        projector = Projector(
            place_m=(float(rng.uniform(-0.5, 1.0)) * _DRAWN_BASELINE_M, 0.0, 0.0),
            # Three to ten pixels apart.
            dots_per_radian=float(near.rig.K[0, 0]) / log_uniform(rng, 3, 10),
            strength=log_uniform(rng, 0.15, 4),
        )
    settings = StreetsConfig(
        seed=config.seed,
        jpeg_share=config.jpeg_share,
        rectification_error_px=config.rectification_error_px,
    )
    seed = (config.seed, index, 78)
    frame = draw_scene(near.scene, near.rig, settings, seed, projector)

    # Grey views: infrared is a random mixture of the channels.
    views = [frame.left, frame.right]
    if is_infrared:
        shares = torch.from_numpy(rng.dirichlet([2, 2, 2])).float()[:, None, None]
        views = [(view * shares).sum(0, keepdim=True).expand(3, -1, -1) for view in views]
    elif rng.random() < config.grey_share:
        views = [grey_from_rgb(view).expand(3, -1, -1) for view in views]

    left_px = frame.disparity_px
    right_px = frame.right_disparity_px
    if rng.random() < config.border_share:
        views, (is_left_black, is_right_black) = _with_borders(rng, views)
        left_px = left_px.masked_fill(is_left_black, torch.nan)
        right_px = right_px.masked_fill(is_right_black, torch.nan)
    true_rig = replace(frame.rig, baseline_m=frame.rig.baseline_m * near.metres_per_unit)
    return replace(
        frame,
        left=(views[0] * 255).round() / 255,
        right=(views[1] * 255).round() / 255,
        disparity_px=left_px,
        right_disparity_px=right_px,
        depth_m=frame.depth_m * near.metres_per_unit,
        rig=true_rig,
    )


def _with_borders(rng: np.random.Generator, views: list[View]) -> tuple[list[View], list[Mask]]:
    """Blacken the borders of each view at random, as a rectification leaves them.

    Gives the views, and the black pixels of each.
    """
    height, width = views[0].shape[1:]
    blackened: list[View] = []
    masks: list[Mask] = []
    for view in views:
        left, right = np.round(rng.uniform(0, 0.06, 2) * width).astype(int)
        top, bottom = np.round(rng.uniform(0, 0.06, 2) * height).astype(int)
        is_black = torch.ones(height, width, dtype=torch.bool)
        is_black[top : height - bottom, left : width - right] = False
        blackened.append(view.masked_fill(is_black, 0.0))
        masks.append(is_black)
    return blackened, masks


class _NearSceneBuilder:
    """Builds the surfaces of a near scene, within the camera's field of view.

    Args:
        rng: the random numbers.
        near_m: least distance of an object.
        half: tangents of half of the camera's horizontal and vertical angle of view.
        plain_share: share of the large surfaces with next to no texture.
    """

    def __init__(
        self, rng: np.random.Generator, near_m: float, half: tuple[float, float], plain_share: float
    ) -> None:
        self.rng = rng
        self.near_m = near_m
        self.half = half
        self.plain_share = plain_share
        self.builder = MeshBuilder(rng)
        self.backdrop = 0
        self.far_m = near_m

    def sheet(self, corner: Values, along: Values, up: Values) -> None:
        """Add a large rectangle to the backdrop, which may be nearer than objects."""
        self.builder.thing += 1
        size_m = float(np.linalg.norm(np.asarray(along, float)))
        surface = random_near_surface(
            self.rng, self.near_m * log_uniform(self.rng, 0.3, 3), self.plain_share
        )
        if surface.material in PLAIN:
            surface = surface._replace(tile_m=size_m)
        self.builder.rectangle(corner, along, up, surface)
        self.backdrop = self.builder.thing

    def add_wall(self, far_m: float) -> None:
        """Add a plane across the view, at any slant at which all of it is far enough."""
        slope_x, slope_y = self.rng.normal(0, 0.45, 2)
        # z = far + slope_x x + slope_y y, which is far / (1 - slope_x u - slope_y v) on the ray
        # (u, v, 1): of the divisor's range in the view, the largest is that of the nearest point.
        smallest = 1 - abs(slope_x) * self.half[0] - abs(slope_y) * self.half[1]
        largest = 1 + abs(slope_x) * self.half[0] + abs(slope_y) * self.half[1]
        if smallest < 0.15:
            slope_x = 0.0
            slope_y = 0.0
            largest = 1.0
        far_m = max(far_m, self.near_m * largest)
        half_side = 30 * far_m
        along = np.array([1, 0, slope_x]) * 2 * half_side
        up = np.array([0, -1, -slope_y]) * 2 * half_side
        self.sheet(np.array([0, 0, far_m]) - (along + up) / 2, along, up)
        self.far_m = far_m

    def add_room(self, far_m: float) -> None:
        """Add a floor, a back wall, mostly two side walls, sometimes a ceiling."""
        rng = self.rng
        near_m = self.near_m
        half = near_m * self.half[0] * log_uniform(rng, 1, 4)
        floor, top = (near_m * self.half[1] * log_uniform(rng, 1, 4) for _ in range(2))
        up = [0, -(floor + top), 0]
        self.sheet([-half, floor, 0], [2 * half, 0, 0], [0, 0, far_m])
        wide = max(half, 3 * far_m * self.half[0])
        is_closed = rng.random() < 0.7
        across = half if is_closed else wide
        high = [0, -30 * far_m, 0]
        self.sheet([-across, floor, far_m], [2 * across, 0, 0], up if is_closed else high)
        if is_closed:
            for x in (-half, half):
                self.sheet([x, floor, 0], [0, 0, far_m], up)
            self.sheet([-half, -top, 0], [2 * half, 0, 0], [0, 0, far_m])
        self.far_m = far_m

    def add_table(self, *, is_bin: bool) -> None:
        """Add a plane that is seen from above, a wall behind it, and objects that lie on it.

        A bin has four sides, and many objects of one kind.
        """
        rng = self.rng
        near_m = self.near_m
        tilt = np.deg2rad(rng.uniform(0, 75 if not is_bin else 35))
        roll = rng.normal(0, 0.15)

        # Its axes. Up from the plane, towards the camera: straight at it, or aslant.
        normal = np.array([np.sin(roll), -np.sin(tilt), -np.cos(tilt) * np.cos(roll)])
        normal /= np.linalg.norm(normal)
        right = np.cross(normal, [0.0, 1, 0]) if tilt < 0.1 else np.cross([0.0, 0, -1], normal)
        right /= np.linalg.norm(right)
        ahead = np.cross(right, normal)

        # The plane passes through the axis so far away that its nearest visible corner is far
        # enough; a ray (u, v, 1) meets it at z = distance * normal_z / (normal . ray).
        rays = np.array([[u, v, 1.0] for u in (-1, 0, 1) for v in (-1, 0, 1)])
        rays[:, :2] *= self.half
        aligned = rays @ normal
        nearest = (normal[2] / aligned[aligned < -0.03]).min()
        distance_m = near_m * rng.uniform(1.05, 1.6) / nearest

        # The wall behind, the plane, and the sides of a bin.
        middle = np.array([0, 0, distance_m])
        extent_m = distance_m * log_uniform(rng, 0.5, 4)
        if is_bin:
            extent_m = distance_m * self.half[0] * rng.uniform(0.6, 1.2)
        self.add_wall(distance_m * log_uniform(rng, 1.3, 5))
        corner = middle - extent_m * (right + ahead)
        self.sheet(corner, 2 * extent_m * right, 2 * extent_m * ahead)
        height_m = extent_m * rng.uniform(0.15, 0.6)
        if is_bin:
            self.builder.thing += 1
            sides = ((right, ahead), (-right, ahead), (ahead, right), (-ahead, right))
            for outwards, along in sides:
                corner = middle + extent_m * (outwards - along)
                surface = random_near_surface(rng, extent_m)
                self.builder.rectangle(corner, 2 * extent_m * along, height_m * normal, surface)

        # Objects on it, where random rays meet the plane.
        common = random_kind(rng) if is_bin else None
        common_m = distance_m * self.half[0] * log_uniform(rng, 0.1, 0.5)
        for _ in range(int(rng.integers(20, 70) if is_bin else rng.integers(2, 30))):
            ray = np.array([*(rng.uniform(-1, 1, 2) * self.half), 1.0])
            away = float(ray @ normal)
            if away > -0.05:
                continue
            z = distance_m * normal[2] / away
            size_m = common_m if common else z * self.half[0] * log_uniform(rng, 0.08, 0.7)
            lift = rng.uniform(0.1, 1.0) * height_m if common else rng.uniform(0.2, 0.6) * size_m
            self.add_thing(ray * z + lift * normal, size_m, common)
        self.far_m = distance_m

    def add_shelf(self) -> None:
        """Add a shelf of boards and uprights before a wall, with objects on the boards."""
        rng = self.rng
        near_m = self.near_m
        depth_m = near_m * rng.uniform(0.1, 0.8)
        front_m = near_m * rng.uniform(1.02, 1.5)
        back_m = front_m + depth_m
        self.add_wall(back_m * rng.uniform(1.0, 1.6))

        # Size, surface and rotation of the shelf.
        half_x, half_y = (back_m * side * rng.uniform(0.6, 1.5) for side in self.half)
        thick_m = depth_m * rng.uniform(0.02, 0.12)
        surface = random_near_surface(rng, half_x)
        turn = rng.normal(0, 0.25)
        rotation = np.array(
            [[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]]
        )

        # Boards and uprights.
        middle = np.array([0, 0, front_m + depth_m / 2])
        levels = np.linspace(-half_y, half_y, int(rng.integers(2, 6)))
        columns = np.linspace(-half_x, half_x, int(rng.integers(2, 6)))
        self.builder.thing += 1
        for y in levels:
            size = (2 * half_x, thick_m, depth_m)
            self.builder.box(middle + rotation @ [0, y, 0], size, surface, rotation)
        for x in columns:
            size = (thick_m, 2 * half_y, depth_m)
            self.builder.box(middle + rotation @ [x, 0, 0], size, surface, rotation)

        # Objects on all boards but the uppermost.
        cell_m = float(levels[1] - levels[0])
        for _ in range(int(rng.integers(5, 40))):
            size_m = cell_m * rng.uniform(0.2, 0.8)
            floor = levels[int(rng.integers(1, len(levels)))] - thick_m / 2
            where = np.array([
                rng.uniform(-half_x, half_x), floor - size_m / 2, rng.uniform(-0.4, 0.4) * depth_m
            ])  # fmt: skip
            self.add_thing(middle + rotation @ where, size_m)
        self.far_m = back_m

    def scatter(self, count: int) -> None:
        """Add objects at random places between the nearest distance and the backdrop."""
        rng = self.rng
        for _ in range(count):
            z = log_uniform(rng, 1.05 * self.near_m, max(1.1 * self.near_m, self.far_m))
            centre = np.array([*(rng.uniform(-1, 1, 2) * self.half * z), z])
            self.add_thing(centre, z * self.half[0] * log_uniform(rng, 0.06, 0.7))

    def add_thing(self, centre: np.ndarray, size_m: float, kind: str | None = None) -> None:
        """Add an object about a point (3,) [m], moved away along its ray if it is too near.

        ``kind``: None for a random one.
        """
        min_m = self.near_m + 0.6 * size_m
        centre = centre * max(1.0, min_m / max(float(centre[2]), 1e-6))
        add_thing(self.builder, kind or random_kind(self.rng), centre, size_m)
