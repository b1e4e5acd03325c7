"""Synthetic views of known objects, by index.

A view is rendered at a pose, or resampled from a stored view by rotating the camera about its
centre. The rotated camera sees the same surface points along other rays, so that a stored view
serves every direction of the optical axis, and only its pixels are interpolated: inverse depth,
which is linear in the picture of a plane, so that flat parts stay exact. Depth is NaN where nothing
is seen.
"""

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from scipy.spatial import ConvexHull, QhullError
from torch import Tensor

from depthpose.core.camera.pinhole import crop_intrinsics
from depthpose.core.errors import InputError
from depthpose.core.loop import make_sample_generator
from depthpose.core.render import rasterize
from depthpose.core.rigid import Rigid
from depthpose.pose.cloud import grow_mask, lift_sample
from depthpose.pose.config import CloudConfig, ObjectsConfig
from depthpose.pose.geometry.grid import rotation_from_z_to
from depthpose.pose.mesh import drawn_triangles
from depthpose.pose.synthetic.depth_sensors import JUMP, simulate_depth
from depthpose.pose.synthetic.occluders import draw_levels, occlude
from depthpose.pose.synthetic.random_numbers import random_index, random_rotation, uniform
from depthpose.pose.types import CloudSample, ObjectModel, PoseTruth, ViewInput, ViewSample

Depth = Float[Tensor, "h w"]
Mask = Bool[Tensor, "h w"]

MARGIN_PX = 8  #: around the object, in which the background is visible where a mask is too large


@dataclass(frozen=True, kw_only=True, eq=False)
class Shape:
    """The geometry of an object for rendering.

    The pose ``Rigid(R, t - R @ middle_m)`` rotates it by R and puts its middle at t.
    """

    triangles_m: Float[Tensor, "n 3 3"]  #: in the model frame
    hull_m: Float[Tensor, "m 3"]  #: corners of the convex hull, about the middle
    middle_m: Float[Tensor, "3"]  #: of the box about the object


@dataclass(frozen=True, kw_only=True, eq=False)
class CleanView:
    """An object alone, without any error, in a window of the image."""

    depth_m: Float[Tensor, "h w"]  #: NaN beside the object
    K: Float[Tensor, "3 3"]  #: intrinsic matrix of the window
    camera_from_model: Rigid  #: the pose


@dataclass(frozen=True, kw_only=True, eq=False)
class _StoredView:
    """A clean view of an object on the optical axis, in half of the memory."""

    offset_m: Float[Tensor, "h w"]  #: depth minus ``distance_m``: float16 is exact to 0.1 mm
    distance_m: float  #: of the middle of the object
    K: Float[Tensor, "3 3"]  #: intrinsic matrix of the window
    camera_from_model: Rigid  #: the pose

    def restore(self) -> CleanView:
        """Restore the view with its depth."""
        depth_m = self.offset_m.float() + self.distance_m
        return CleanView(depth_m=depth_m, K=self.K, camera_from_model=self.camera_from_model)


def make_shape(model: ObjectModel) -> Shape:
    """Compute the geometry of an object, once for many views."""
    triangles = drawn_triangles(model)
    corners = triangles.reshape(-1, 3).double()
    middle = (corners.amin(0) + corners.amax(0)) / 2
    hull_m = corners
    with suppress(QhullError, ValueError):  # flat: every corner counts
        hull_m = corners[torch.from_numpy(ConvexHull(corners.numpy()).vertices).long()]
    return Shape(triangles_m=triangles, hull_m=hull_m - middle, middle_m=middle)


def aim_camera(direction: Float[Tensor, "3"], roll_rad: float) -> Float[Tensor, "3 3"]:
    """Make the rotation that rolls a camera and then points its optical axis at a direction."""
    cosine = math.cos(roll_rad)
    sine = math.sin(roll_rad)
    roll = [[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]]
    return rotation_from_z_to(direction) @ torch.tensor(roll, dtype=torch.float64)


def invert_intrinsics(K: Float[Tensor, "3 3"]) -> Float[Tensor, "3 3"]:
    """Invert an intrinsic matrix without skew, in a tenth of the time of a general inverse."""
    (fx, _, cx), (_, fy, cy), _ = K.tolist()
    rows = [[1 / fx, 0, -cx / fx], [0, 1 / fy, -cy / fy], [0, 0, 1]]
    return torch.tensor(rows, dtype=torch.float64)


def find_window(
    shape: Shape, pose: Rigid, K: Float[Tensor, "3 3"]
) -> tuple[Float[Tensor, "3 3"], int, int]:
    """Find the window of an image in which an object lies, with a margin.

    Args:
        shape: of the object.
        pose: ``camera_from_model``.
        K: intrinsic matrix of the image.

    Returns:
        The intrinsic matrix of the window, its width and its height.
    """
    corners = shape.hull_m @ pose.R.mT + (pose.t_m + pose.R @ shape.middle_m)
    pixels = (corners @ K.mT)[:, :2] / corners[:, 2:]
    left, top = (pixels.amin(0).floor() - MARGIN_PX).tolist()
    right, bottom = (pixels.amax(0).ceil() + MARGIN_PX).tolist()
    window_K = crop_intrinsics(K, int(left), int(top))
    return window_K, int(right - left) + 1, int(bottom - top) + 1


def render_view(shape: Shape, pose: Rigid, K: Float[Tensor, "3 3"]) -> CleanView:
    """Render an object in the window around it; the arguments are those of :func:`find_window`."""
    window_K, width, height = find_window(shape, pose, K)
    # float64 poses: the corners are rounded once.
    triangles = (shape.triangles_m.double() @ pose.R.mT + pose.t_m).float()
    raster = rasterize(triangles, window_K, width, height, with_barycentric=False)
    return CleanView(depth_m=raster.depth_m, K=window_K, camera_from_model=pose)


def turn_view(
    view: CleanView, turn: Float[Tensor, "3 3"], shape: Shape, K: Float[Tensor, "3 3"]
) -> CleanView:
    """Resample a view as a camera rotated about its centre sees it: ``x_new = turn @ x_old``.

    Args:
        view: the view.
        turn: rotation of the camera frame.
        shape: of the object, for the window.
        K: intrinsic matrix of the image of the new view.
    """
    old = view.camera_from_model
    pose = Rigid(turn @ old.R, turn @ old.t_m)
    window_K, width, height = find_window(shape, pose, K)

    # The old pixel of each new one: [source_u, source_v, 1] w = H [u, v, 1], where w is the old
    # depth over the new one.
    H = view.K @ (turn.mT @ invert_intrinsics(window_K))
    (h11, h12, h13), (h21, h22, h23), (h31, h32, h33) = H.tolist()
    u = torch.arange(width)[None]
    v = torch.arange(height)[:, None]
    w = h31 * u + h32 * v + h33
    source_u = (h11 * u + h12 * v + h13) / w
    source_v = (h21 * u + h22 * v + h23) / w
    old_inverse_depth = _interpolate_inverse_depth(view.depth_m, source_u, source_v)
    return CleanView(depth_m=1 / (old_inverse_depth * w), K=window_K, camera_from_model=pose)


def _interpolate_inverse_depth(
    depth_m: Float[Tensor, "h w"],
    u: Float[Tensor, "rows columns"],
    v: Float[Tensor, "rows columns"],
) -> Float[Tensor, "rows columns"]:
    """Interpolate 1 / depth at places (u, v) between pixels; NaN outside of the image.

    At depth discontinuities, and next to pixels without depth, it is the nearest neighbour's value.
    Within half a pixel beyond the outermost pixel centres it is extrapolated.
    """
    # The four pixels about each place.
    height, width = depth_m.shape
    left = u.floor().clamp_(0, width - 2)
    top = v.floor().clamp_(0, height - 2)
    x = u - left
    y = v - top
    index = (top * width + left).long()
    flat = (1 / depth_m).reshape(-1)
    nw, ne, sw, se = (flat[index + beyond] for beyond in (0, 1, width, width + 1))

    # On one surface the bilinear mean, else the nearest pixel. A comparison with NaN is false:
    # where one of the four pixels is empty the nearest is taken.
    upper = torch.lerp(nw, ne, x)
    lower = torch.lerp(sw, se, x)
    smooth = torch.lerp(upper, lower, y)
    nearest_upper = torch.where(x < 0.5, nw, ne)
    nearest_lower = torch.where(x < 0.5, sw, se)
    nearest = torch.where(y < 0.5, nearest_upper, nearest_lower)
    highest = torch.maximum(torch.maximum(nw, ne), torch.maximum(sw, se))
    lowest = torch.minimum(torch.minimum(nw, ne), torch.minimum(sw, se))
    interpolated = torch.where(highest - lowest < JUMP * smooth, smooth, nearest)

    # The image ends half a pixel beyond the centres of its outermost pixels.
    is_inside = (x - 0.5).abs().maximum((y - 0.5).abs()) <= 1
    return torch.where(is_inside, interpolated, torch.nan)


def _draw_offset(generator: torch.Generator, most: int) -> int:
    """Draw a whole number from -most to most, all equally likely."""
    return random_index(generator, 2 * most + 1) - most


def _shift_mask(mask: Mask, down: int, right: int) -> Mask:
    """Shift a mask by some pixels; those that come in at a border are not of the object."""
    mask = mask.roll((down, right), (0, 1))
    for axis, steps in enumerate((down, right)):
        if steps:
            size = mask.shape[axis]
            start = 0 if steps > 0 else max(0, size + steps)
            mask.narrow(axis, start, min(abs(steps), size)).fill_(False)
    return mask


_STORED_SEED = 0x0B7EC7  # added to the seed, so that stored views have random numbers of their own
_MOST_TILT_RAD = math.radians(75)  # of the plane behind an object against the line of sight
_NEAREST_M = 1e-3  # of an object to the camera, where its size in the image is computed


class SyntheticViews:
    """Synthetic partial views of objects by index; each depends on the seed and its index alone.

    Args:
        models: of the objects; sample i shows ``models[i % len(models)]``.
        config: of the views.
        cloud: how they are lifted to clouds.

    Raises:
        InputError: no model, or one that does not fit before the camera.
    """

    def __init__(
        self,
        models: Sequence[ObjectModel],
        config: ObjectsConfig | None = None,
        cloud: CloudConfig | None = None,
    ) -> None:
        if not models:
            raise InputError("there is no object to show; give one model at least")
        self.models = tuple(models)
        self.config = ObjectsConfig() if config is None else config
        self.cloud = CloudConfig() if cloud is None else cloud
        nearest = self.config.distance_m[0]
        for model in self.models:
            if nearest < model.diameter_m:
                raise InputError(
                    f"distance_m begins at {nearest:g} m, but object {model.name!r} is "
                    f"{model.diameter_m:.3g} m wide: the camera would stand in it. Begin at "
                    f"{1.5 * model.diameter_m:.2g} or farther, or correct the unit of the model."
                )
        self._shapes = [make_shape(model) for model in self.models]
        self._stored: dict[tuple[int, int], _StoredView] = {}  # by index of object and of view

    def __len__(self) -> int:
        return self.config.number

    def __getitem__(self, index: int) -> CloudSample:
        """Make the partial cloud of an index, with the true pose.

        Raises:
            IndexError: there is no such sample.
        """
        if not 0 <= index < len(self):
            raise IndexError(f"sample {index} of {len(self)}")
        diameter_m = self.models[index % len(self.models)].diameter_m
        return lift_sample(self.view(index), diameter_m, self.cloud)

    def render_stored(self, workers: int) -> None:
        """Render all stored views now, in ``workers`` threads, for processes forked later."""
        keys = [
            (object_index, view_index)
            for view_index in range(self.config.views or 0)
            for object_index in range(len(self.models))
        ]
        with ThreadPoolExecutor(workers) as pool:
            for _ in pool.map(lambda key: self._find_stored(*key), keys):
                pass

    def view(self, index: int) -> ViewSample:
        """Make the depth window and the mask that a sample is lifted from, and the true pose."""
        # The object alone.
        object_index = index % len(self.models)
        generator = make_sample_generator(index, self.config.seed)
        clean = self._make_clean_view(object_index, generator)
        silhouette = clean.depth_m.isfinite()
        depth_m = clean.depth_m
        visible = silhouette

        # A background behind the object, and something that occludes a part of it.
        if self.config.with_background:
            depth_m = self._add_background(clean, self._shapes[object_index], generator)
        if uniform(generator, 0.0, 1.0) < self.config.occluded_share:
            share = uniform(generator, *self.config.occlusion)
            depth_m, visible = occlude(depth_m, silhouette, share, generator)

        # The errors of a mask, and those of a sensor. Masks err by whole pixels of the full image.
        scale = float(clean.K[0, 0]) / self.config.focal_px[0]  # of the window's pixels to these
        grow_px = _draw_offset(generator, self.config.mask_error_px)
        mask = grow_mask(visible, round(grow_px * scale))
        focal_px = (float(clean.K[0, 0]), self.config.focal_px[0])
        measured_m = simulate_depth(depth_m, focal_px, self.config.sensor, generator)
        down = round(_draw_offset(generator, self.config.mask_shift_px) * scale)
        right = round(_draw_offset(generator, self.config.mask_shift_px) * scale)
        mask = _shift_mask(mask, down, right)

        model = self.models[object_index]
        view = ViewInput(
            name=f"{model.name}_{self.config.seed}_{index:06d}",
            depth_m=measured_m,
            mask=mask,
            K=clean.K,
            object=model.name,
        )
        truth = PoseTruth(
            camera_from_model=clean.camera_from_model.float(),
            visible_fraction=int(visible.sum()) / max(int(silhouette.sum()), 1),
        )
        return ViewSample(input=view, truth=truth)

    def _make_clean_view(self, object_index: int, generator: torch.Generator) -> CleanView:
        """Make a view of an object without errors.

        It is rendered anew, or a stored one is rotated about the camera centre.
        """
        shape = self._shapes[object_index]
        stored_views = self.config.views
        if stored_views is not None:
            stored = self._find_stored(object_index, random_index(generator, stored_views))
            resolution = float(stored.K[0, 0]) / self.config.focal_px[0]
            K = self.make_intrinsics(resolution)
            turn = self._draw_camera_rotation(object_index, stored.distance_m, K, generator)
            return turn_view(stored.restore(), turn, shape, K)

        # Rendered anew: the object on the optical axis is rotated about the camera centre to
        # another place in the image, and so is its middle, (0, 0, distance).
        R = random_rotation(generator)
        distance_m = uniform(generator, *self.config.distance_m)
        K = self.make_intrinsics(uniform(generator, *self.config.resolution))
        turn = self._draw_camera_rotation(object_index, distance_m, K, generator)
        R = turn @ R
        middle_m = turn[:, 2] * distance_m
        return render_view(shape, Rigid(R, middle_m - R @ shape.middle_m), K)

    def _find_stored(self, object_index: int, view_index: int) -> _StoredView:
        """Find a stored view of an object; it is rendered when first needed."""
        key = (object_index, view_index)
        if key not in self._stored:
            # On the optical axis.
            index = view_index * len(self.models) + object_index
            generator = make_sample_generator(index, self.config.seed + _STORED_SEED)
            shape = self._shapes[object_index]
            R = random_rotation(generator)
            distance_m = uniform(generator, *self.config.distance_m)
            K = self.make_intrinsics(uniform(generator, *self.config.resolution))
            middle_m = torch.tensor([0.0, 0.0, distance_m], dtype=torch.float64)
            pose = Rigid(R, middle_m - R @ shape.middle_m)
            view = render_view(shape, pose, K)
            self._stored[key] = _StoredView(
                offset_m=(view.depth_m - distance_m).half(),
                distance_m=distance_m,
                K=view.K,
                camera_from_model=pose,
            )
        return self._stored[key]

    def make_intrinsics(self, scale: float = 1.0) -> Float[Tensor, "3 3"]:
        """Make the intrinsic matrix of the sensor's image, enlarged by ``scale``."""
        assert self.config.centre_px is not None, "the config computes a centre left out"
        fx, fy = self.config.focal_px
        cx, cy = self.config.centre_px
        rows = [
            [scale * fx, 0, scale * (cx + 0.5) - 0.5],
            [0, scale * fy, scale * (cy + 0.5) - 0.5],
        ]
        return torch.tensor([*rows, [0, 0, 1]], dtype=torch.float64)

    def _draw_camera_rotation(
        self, object_index: int, distance_m: float, K: Tensor, generator: torch.Generator
    ) -> Float[Tensor, "3 3"]:
        """Draw a rotation of the camera by which an object lies wholly in the image, anywhere.

        Args:
            object_index: of the object.
            distance_m: of its middle.
            K: intrinsic matrix of the image.
            generator: of random numbers.
        """
        # The radius of the object in the image, by its nearest point.
        radius_m = 0.5 * self.models[object_index].diameter_m
        nearest_m = max(distance_m - radius_m, _NEAREST_M)
        radius_px = float(K[0, 0]) * radius_m / nearest_m

        # A place at which the whole object is in the image; the middle, where it is too large.
        scale = float(K[0, 0]) / self.config.focal_px[0]
        place: list[float] = []
        for size, middle in zip(self.config.image_px, K[:2, 2].tolist(), strict=True):
            low = radius_px
            high = scale * size - 1 - radius_px
            place.append(uniform(generator, low, high) if low < high else middle)

        # A camera that looks there, rolled.
        roll_rad = uniform(generator, 0.0, 2 * math.pi)
        pixel = torch.tensor([*place, 1.0], dtype=torch.float64)
        return aim_camera(invert_intrinsics(K) @ pixel, roll_rad)

    def _add_background(
        self, clean: CleanView, shape: Shape, generator: torch.Generator
    ) -> Float[Tensor, "h w"]:
        """Compute depth with a table or wall behind the object of a view, and clutter beside it."""
        # A plane behind the object, and its depth in each pixel; none where its ray misses it.
        pose = clean.camera_from_model
        hull_m = shape.hull_m @ pose.R.mT + (pose.t_m + pose.R @ shape.middle_m)
        plane = _draw_plane_behind(hull_m, generator)
        height, width = clean.depth_m.shape
        a, b, c = (plane.normal @ invert_intrinsics(clean.K)).tolist()
        slope = a * torch.arange(width)[None] + b * torch.arange(height)[:, None] + c  # n . ray
        is_met = slope * plane.offset_m > 0
        behind_m = torch.where(is_met, plane.offset_m / slope, torch.nan)

        # Clutter: a shape parallel to the image, at about the depth of the object.
        levels = draw_levels(height, width, generator)
        lowest = float(levels.amin())
        level = lowest + uniform(generator, 0.0, 0.6) * float(levels.amax() - levels.amin())
        nearest_m = float(hull_m[:, 2].min())
        farthest_m = float(hull_m[:, 2].max())
        clutter_m = uniform(generator, nearest_m, farthest_m + 0.2)
        is_clutter = (levels < level) & ~(behind_m < clutter_m)
        behind_m = torch.where(is_clutter, clutter_m, behind_m)
        return torch.where(clean.depth_m.isfinite(), clean.depth_m, behind_m)


class _Plane(NamedTuple):
    """The points with ``normal . x = offset``, in the camera frame."""

    normal: Float[Tensor, "3"]  #: unit vector
    offset_m: float


def _draw_plane_behind(hull_m: Float[Tensor, "n 3"], generator: torch.Generator) -> _Plane:
    """Draw a plane that touches an object or lies behind it, tilted against the line of sight.

    ``hull_m`` are the corners of the object's convex hull, in the camera frame.
    """
    tilt_rad = uniform(generator, 0.0, _MOST_TILT_RAD)
    side_rad = uniform(generator, 0.0, 2 * math.pi)
    tilted = torch.tensor([math.sin(tilt_rad), 0.0, -math.cos(tilt_rad)], dtype=torch.float64)
    normal = aim_camera(hull_m.mean(0), side_rad) @ tilted
    gap_m = max(0.0, uniform(generator, -0.2, 0.3))  # none, in two of five
    return _Plane(normal, float((hull_m @ normal).min()) - gap_m)
