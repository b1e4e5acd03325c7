"""Near scenes: rooms, tables, bins, shelves and walls with objects, from 5 cm to 20 m.

Disparity depends on the shape of a scene and on its distance in baselines, not on its size in
metres. So a scene is built and lit at the scale at which its baseline is that of a street's rig,
where textures, shadows and lenses have their usual sizes, and is scaled to its true metres last.
"""

from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
import torch

from depthpose.core.arrays import grey_from_rgb
from depthpose.core.camera import StereoRig
from depthpose.core.camera.pinhole import intrinsics
from depthpose.core.errors import InputError
from depthpose.depth.config import NearConfig, StreetsConfig
from depthpose.depth.synthetic.dataset import SyntheticFrame, render_scene
from depthpose.depth.synthetic.materials import Appearance
from depthpose.depth.synthetic.mesh import MeshBuilder, Values, rotation_about_y
from depthpose.depth.synthetic.near_objects import (
    PLAIN_MATERIALS,
    add_near_object,
    draw_near_appearance,
    draw_near_kind,
)
from depthpose.depth.synthetic.projector import Projector
from depthpose.depth.synthetic.randomness import Stream, draw_log_uniform, make_rng
from depthpose.depth.synthetic.scene import NO_MARKINGS, SyntheticScene, draw_weather
from depthpose.depth.types import Mask, View

NearKind = Literal["room", "table", "bin", "shelf", "wall"]
"""Kind of a near scene."""

_KINDS: tuple[NearKind, ...] = ("room", "table", "table", "bin", "shelf", "wall")
"""A kind is repeated in proportion to how often it is drawn."""

_BUILT_BASELINE_M = 0.5
"""Baseline at which scenes are built; with a true one of 5 cm all true lengths are a tenth."""

_BASELINES_M = (0.01, 0.54)
_DISTANCES_M = (0.05, 5.0)
"""Ranges of the baseline and of the distance of the nearest object, in true metres."""
_FARTHEST_M = 20.0
"""Largest distance of a room's back wall, in true metres."""
_MAX_ROOM_DEPTH = 12.0
"""Largest distance of that wall, in distances of the nearest object."""
_NEAREST_SHARE = 0.97
"""Triangles of objects nearer than this share of the distance of the nearest one are removed."""
_NO_HAZE_M = 1e5
"""Distance of haze in a near scene: so far away that none is visible."""


@dataclass(frozen=True, kw_only=True, eq=False)
class NearScene:
    """A near scene and its rig, at the scale at which it is built."""

    scene: SyntheticScene  #: mesh and light, in the frame of the left camera
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
    rng = make_rng(Stream.NEAR_SCENE, config.seed, index)

    # The camera, and the distance of the nearest object by the largest disparity.
    rig = _draw_rig(rng, config)
    focal_px = float(rig.K[0, 0])
    largest_px = draw_log_uniform(rng, 8, config.largest_share * rig.width)
    near_m = focal_px * _BUILT_BASELINE_M / largest_px

    # The surfaces.
    metres_per_unit = _draw_true_scale(rng, near_m)
    kind = _KINDS[int(rng.integers(len(_KINDS)))]
    tan_half_fov = (rig.width / focal_px / 2, rig.height / focal_px / 2)
    scene_builder = _NearSceneBuilder(rng, near_m, tan_half_fov, config.plain_share)
    match kind:
        case "room":
            max_depth = min(_MAX_ROOM_DEPTH, _FARTHEST_M / (near_m * metres_per_unit))
            scene_builder.add_room(near_m * draw_log_uniform(rng, 1.5, max_depth))
            scene_builder.scatter(int(rng.integers(6, 40)))
        case "table" | "bin":
            scene_builder.add_table(is_bin=kind == "bin")
        case "shelf":
            scene_builder.add_shelf()
        case "wall":
            scene_builder.add_wall(near_m * draw_log_uniform(rng, 1.2, 6))
            scene_builder.scatter(int(rng.integers(3, 30)))

    # Only a backdrop, which reaches beside the camera, may be nearer than the nearest object.
    mesh = scene_builder.builder.finish()
    is_far = mesh.corners[:, :, 2].min(1) > _NEAREST_SHARE * near_m
    is_backdrop = mesh.object_id <= scene_builder.last_backdrop_id
    scene = SyntheticScene(
        mesh=mesh.select(is_far | is_backdrop),
        markings=NO_MARKINGS,
        weather=replace(draw_weather(rng), haze_m=_NO_HAZE_M),
        camera_from_world=np.eye(3),
        place="clutter",
    )
    return NearScene(scene=scene, rig=rig, metres_per_unit=metres_per_unit, kind=kind)


def _draw_rig(rng: np.random.Generator, config: NearConfig) -> StereoRig:
    """Draw a rig of any size and focal length, with the baseline at which scenes are built."""
    low_px, high_px = config.columns_px
    # Whole multiples of 16 columns and of 8 rows.
    width = 16 * round(rng.uniform(low_px, high_px) / 16)
    height_share = float(rng.choice([3 / 4, 9 / 16, 5 / 8]))
    height = 8 * round(width * height_share / 8)
    focal_px = width * rng.uniform(0.55, 1.6)
    K = intrinsics(focal_px, focal_px, (width - 1) / 2, (height - 1) / 2)
    return StereoRig(width=width, height=height, K=K, baseline_m=_BUILT_BASELINE_M)


def _draw_true_scale(rng: np.random.Generator, near_m: float) -> float:
    """Draw the true metres per metre of a scene, by a random true baseline.

    The distance ``near_m`` of the nearest object becomes one within ``_DISTANCES_M``, as far as the
    baseline stays within ``_BASELINES_M``.
    """
    baseline_m = draw_log_uniform(rng, *_BASELINES_M)
    distance_m = np.clip(near_m * baseline_m / _BUILT_BASELINE_M, *_DISTANCES_M)
    min_scale, max_scale = (limit_m / _BUILT_BASELINE_M for limit_m in _BASELINES_M)
    return float(np.clip(distance_m / near_m, min_scale, max_scale))


def render_near(config: NearConfig, index: int) -> SyntheticFrame:
    """Render scene ``index``, in true metres: both views, disparity and depth.

    A share of the pairs is infrared, in grey, and in a share of these a projector adds dots. A
    share has black borders, where truth is unknown (NaN).

    Raises:
        InputError: the index is negative.
    """
    near = make_near(config, index)
    rng = make_rng(Stream.NEAR_CAMERAS, config.seed, index)
    is_infrared = bool(rng.random() < config.infrared_share)
    projector = None
    if is_infrared and rng.random() < config.dots_share:
        projector = _draw_projector(rng, near.rig)
    settings = StreetsConfig(
        seed=config.seed,
        jpeg_share=config.jpeg_share,
        rectification_error_px=config.rectification_error_px,
    )
    seed = (config.seed, index, int(Stream.NEAR_CAMERAS))
    frame = render_scene(near.scene, near.rig, settings, seed, projector)

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
        is_left_black, is_right_black = (_draw_border(rng, view) for view in views)
        views = [views[0].masked_fill(is_left_black, 0), views[1].masked_fill(is_right_black, 0)]
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


def _draw_projector(rng: np.random.Generator, rig: StereoRig) -> Projector:
    """Draw a projector near the cameras, whose dots are three to ten pixels apart."""
    x_m = float(rng.uniform(-0.5, 1.0)) * _BUILT_BASELINE_M
    step_px = draw_log_uniform(rng, 3, 10)
    return Projector(
        place_m=(x_m, 0.0, 0.0),
        dots_per_radian=float(rig.K[0, 0]) / step_px,
        strength=draw_log_uniform(rng, 0.15, 4),
    )


def _draw_border(rng: np.random.Generator, view: View) -> Mask:
    """Draw the pixels of a random black border of a view, as a rectification leaves one."""
    height, width = view.shape[1:]
    left, right = np.round(rng.uniform(0, 0.06, 2) * width).astype(int)
    top, bottom = np.round(rng.uniform(0, 0.06, 2) * height).astype(int)
    is_black = torch.ones(height, width, dtype=torch.bool)
    is_black[top : height - bottom, left : width - right] = False
    return is_black


class _TablePlane(NamedTuple):
    """The plane of a table, in the frame of the left camera."""

    right: np.ndarray  # unit vector in the plane
    ahead: np.ndarray  # unit vector in the plane, away from the camera
    normal: np.ndarray  # unit vector up from the plane
    distance_m: float  # camera z where the optical axis meets it

    @property
    def middle(self) -> np.ndarray:
        """The point (3,) where the optical axis meets the plane [m]."""
        return np.array([0, 0, self.distance_m])


class _NearSceneBuilder:
    """Builds the surfaces of a near scene, within the camera's field of view.

    Args:
        rng: the random numbers.
        near_m: least distance of an object.
        tan_half_fov: tangents of half the camera's horizontal and vertical field of view.
        plain_share: share of the large surfaces with next to no texture.

    Attributes:
        builder: the mesh.
        last_backdrop_id: largest number of an object that belongs to the backdrop.
        far_m: distance of the backdrop.
    """

    def __init__(
        self,
        rng: np.random.Generator,
        near_m: float,
        tan_half_fov: tuple[float, float],
        plain_share: float,
    ) -> None:
        self.rng = rng
        self.near_m = near_m
        self.tan_half_fov = tan_half_fov
        self.plain_share = plain_share
        self.builder = MeshBuilder(rng)
        self.last_backdrop_id = 0
        self.far_m = near_m

    def _add_sheet(self, corner: Values, along: Values, up: Values) -> None:
        """Add a large rectangle of random appearance to the backdrop."""
        self._place_sheet(corner, along, up, self._draw_sheet_appearance())

    def _draw_sheet_appearance(self) -> Appearance:
        """Draw the appearance of a large rectangle."""
        texture_m = self.near_m * draw_log_uniform(self.rng, 0.3, 3)
        return draw_near_appearance(self.rng, texture_m, self.plain_share)

    def _place_sheet(
        self, corner: Values, along: Values, up: Values, appearance: Appearance
    ) -> None:
        """Add a large rectangle to the backdrop, which may be nearer than objects."""
        self.builder.begin_object()
        if appearance.material in PLAIN_MATERIALS:  # one tile, so that nothing repeats
            length_m = float(np.linalg.norm(np.asarray(along, float)))
            appearance = appearance._replace(tile_m=length_m)
        self.builder.add_rectangle(corner, along, up, appearance)
        self.last_backdrop_id = self.builder.object_id

    def add_wall(self, far_m: float) -> None:
        """Add a plane across the view, at any slant at which all of it is far enough.

        ``far_m``: its distance on the optical axis, if that is far enough.
        """
        slope_x, slope_y = self.rng.normal(0, 0.45, 2)
        # z = far + slope_x x + slope_y y, which is far / (1 - slope_x u - slope_y v) on the ray
        # (u, v, 1): of the divisor's range in the view, the largest is that of the nearest point.
        half_u, half_v = self.tan_half_fov
        smallest = 1 - abs(slope_x) * half_u - abs(slope_y) * half_v
        largest = 1 + abs(slope_x) * half_u + abs(slope_y) * half_v
        if smallest < 0.15:  # so slanted that the far end would be at infinity: take none
            slope_x = 0.0
            slope_y = 0.0
            largest = 1.0
        far_m = max(far_m, self.near_m * largest)
        half_side = 30 * far_m  # fills the view at any of these slants
        along = np.array([1, 0, slope_x]) * 2 * half_side
        up = np.array([0, -1, -slope_y]) * 2 * half_side
        self._add_sheet(np.array([0, 0, far_m]) - (along + up) / 2, along, up)
        self.far_m = far_m

    def add_room(self, far_m: float) -> None:
        """Add a floor and a back wall at ``far_m``; in 70 % of rooms side walls and a ceiling."""
        rng = self.rng
        half_u, half_v = self.tan_half_fov
        # Floor, side walls and ceiling come into view at ``near_m`` or beyond.
        half_x = self.near_m * half_u * draw_log_uniform(rng, 1, 4)
        floor_y, ceiling_height = (
            self.near_m * half_v * draw_log_uniform(rng, 1, 4) for _ in range(2)
        )
        floor_appearance = self._draw_sheet_appearance()
        is_closed = rng.random() < 0.7
        if not is_closed:  # floor and back wall fill the view
            half_x = max(half_x, 3 * far_m * half_u)
        width = [2 * half_x, 0, 0]
        depth_edge = [0, 0, far_m]
        self._place_sheet([-half_x, floor_y, 0], width, depth_edge, floor_appearance)

        wall_corner = [-half_x, floor_y, far_m]
        if is_closed:
            up = [0, -(floor_y + ceiling_height), 0]
            self._add_sheet(wall_corner, width, up)
            for x in (-half_x, half_x):
                self._add_sheet([x, floor_y, 0], depth_edge, up)
            self._add_sheet([-half_x, -ceiling_height, 0], width, depth_edge)
        else:
            self._add_sheet(wall_corner, width, [0, -30 * far_m, 0])
        self.far_m = far_m

    def add_table(self, *, is_bin: bool) -> None:
        """Add a plane that is seen from above, a wall behind it, and objects that lie on it.

        A bin has four sides, and many objects of one kind.
        """
        rng = self.rng
        table = self._draw_table_plane(max_tilt_deg=35 if is_bin else 75)
        half_side_m = table.distance_m * draw_log_uniform(rng, 0.5, 4)
        if is_bin:
            half_side_m = table.distance_m * self.tan_half_fov[0] * rng.uniform(0.6, 1.2)
        self.add_wall(table.distance_m * draw_log_uniform(rng, 1.3, 5))
        corner = table.middle - half_side_m * (table.right + table.ahead)
        self._add_sheet(corner, 2 * half_side_m * table.right, 2 * half_side_m * table.ahead)
        height_m = half_side_m * rng.uniform(0.15, 0.6)
        if is_bin:
            self._add_bin_sides(table, half_side_m, height_m)
            self._fill_bin(table, height_m)
        else:
            self._cover_table(table)
        self.far_m = table.distance_m

    def _draw_table_plane(self, max_tilt_deg: float) -> _TablePlane:
        """Draw the plane of a table; a tilt of 0 faces the camera, one of 90 degrees is level."""
        tilt = np.deg2rad(self.rng.uniform(0, max_tilt_deg))
        roll = self.rng.normal(0, 0.15)
        normal = np.array([np.sin(roll), -np.sin(tilt), -np.cos(tilt) * np.cos(roll)])
        normal /= np.linalg.norm(normal)

        # A plane that faces the camera is nearly perpendicular to its optical axis.
        faces_camera = tilt < 0.1
        right = np.cross(normal, [0.0, 1, 0]) if faces_camera else np.cross([0.0, 0, -1], normal)
        right /= np.linalg.norm(right)

        # The plane passes through the axis so far away that its nearest visible corner is far
        # enough; a ray (u, v, 1) meets it at z = distance * normal_z / (normal . ray).
        rays = np.array([[u, v, 1.0] for u in (-1, 0, 1) for v in (-1, 0, 1)])
        rays[:, :2] *= self.tan_half_fov
        aligned = rays @ normal
        meets_plane = aligned < -0.03  # and not very far away
        nearest_share = (normal[2] / aligned[meets_plane]).min()
        distance_m = self.near_m * self.rng.uniform(1.05, 1.6) / nearest_share
        return _TablePlane(right, np.cross(right, normal), normal, distance_m)

    def _add_bin_sides(self, table: _TablePlane, half_side_m: float, height_m: float) -> None:
        """Add the four sides of a bin, each of its own appearance."""
        right, ahead = table.right, table.ahead
        self.builder.begin_object()
        for outwards, along in ((right, ahead), (-right, ahead), (ahead, right), (-ahead, right)):
            corner = table.middle + half_side_m * (outwards - along)
            appearance = draw_near_appearance(self.rng, half_side_m)
            side = 2 * half_side_m * along
            self.builder.add_rectangle(corner, side, height_m * table.normal, appearance)

    def _fill_bin(self, table: _TablePlane, height_m: float) -> None:
        """Add many objects of one kind and size, heaped up to the height of the bin."""
        rng = self.rng
        kind = draw_near_kind(rng)
        size_m = table.distance_m * self.tan_half_fov[0] * draw_log_uniform(rng, 0.1, 0.5)
        for _ in range(int(rng.integers(20, 70))):
            point = self._draw_point_on(table)
            if point is not None:
                lift_m = rng.uniform(0.1, 1.0) * height_m
                self._add_object(point + lift_m * table.normal, size_m, kind)

    def _cover_table(self, table: _TablePlane) -> None:
        """Add objects of random kinds and sizes, each about half above the table."""
        rng = self.rng
        draw_log_uniform(rng, 0.1, 0.5)  # unused: without it, earlier scenes would change
        for _ in range(int(rng.integers(2, 30))):
            point = self._draw_point_on(table)
            if point is not None:
                size_m = point[2] * self.tan_half_fov[0] * draw_log_uniform(rng, 0.08, 0.7)
                lift_m = rng.uniform(0.2, 0.6) * size_m
                self._add_object(point + lift_m * table.normal, size_m)

    def _draw_point_on(self, table: _TablePlane) -> np.ndarray | None:
        """Draw a visible point (3,) of a table [m], on a random ray of the camera.

        None where the ray meets the plane very far away, or not at all.
        """
        ray = np.array([*(self.rng.uniform(-1, 1, 2) * self.tan_half_fov), 1.0])
        normal_part = float(ray @ table.normal)
        if normal_part > -0.05:
            return None
        return ray * (table.distance_m * table.normal[2] / normal_part)

    def add_shelf(self) -> None:
        """Add a shelf of boards and uprights before a wall, with objects on the boards."""
        rng = self.rng
        depth_m = self.near_m * rng.uniform(0.1, 0.8)
        front_m = self.near_m * rng.uniform(1.02, 1.5)
        back_m = front_m + depth_m
        self.add_wall(back_m * rng.uniform(1.0, 1.6))

        # Size, appearance and rotation of the shelf.
        half_x, half_y = (back_m * side * rng.uniform(0.6, 1.5) for side in self.tan_half_fov)
        thick_m = depth_m * rng.uniform(0.02, 0.12)
        appearance = draw_near_appearance(rng, half_x)
        rotation = rotation_about_y(rng.normal(0, 0.25))

        # Boards and uprights.
        middle = np.array([0, 0, front_m + depth_m / 2])
        levels = np.linspace(-half_y, half_y, int(rng.integers(2, 6)))
        columns = np.linspace(-half_x, half_x, int(rng.integers(2, 6)))
        self.builder.begin_object()
        for y in levels:
            board = (2 * half_x, thick_m, depth_m)
            self.builder.add_box(middle + rotation @ [0, y, 0], board, appearance, rotation)
        for x in columns:
            upright = (thick_m, 2 * half_y, depth_m)
            self.builder.add_box(middle + rotation @ [x, 0, 0], upright, appearance, rotation)

        # Objects on all boards but the uppermost.
        cell_m = float(levels[1] - levels[0])
        for _ in range(int(rng.integers(5, 40))):
            size_m = cell_m * rng.uniform(0.2, 0.8)
            board_y = levels[int(rng.integers(1, len(levels)))] - thick_m / 2
            x = rng.uniform(-half_x, half_x)
            z = rng.uniform(-0.4, 0.4) * depth_m
            offset = np.array([x, board_y - size_m / 2, z])
            self._add_object(middle + rotation @ offset, size_m)
        self.far_m = back_m

    def scatter(self, count: int) -> None:
        """Add objects at random places between the nearest distance and the backdrop."""
        rng = self.rng
        for _ in range(count):
            z = draw_log_uniform(rng, 1.05 * self.near_m, max(1.1 * self.near_m, self.far_m))
            centre = np.array([*(rng.uniform(-1, 1, 2) * self.tan_half_fov * z), z])
            size_m = z * self.tan_half_fov[0] * draw_log_uniform(rng, 0.06, 0.7)
            self._add_object(centre, size_m)

    def _add_object(self, centre: np.ndarray, size_m: float, kind: str | None = None) -> None:
        """Add an object about a point (3,) [m], moved away along its ray if it is too near.

        ``kind``: None for a random one.
        """
        min_m = self.near_m + 0.6 * size_m
        centre = centre * max(1.0, min_m / max(float(centre[2]), 1e-6))
        add_near_object(self.builder, kind or draw_near_kind(self.rng), centre, size_m)
