"""Synthetic views of known objects, and random changes that keep a pose true.

A view is drawn at a pose, or turned out of a view that was drawn before. A camera that turns about
its own centre sees the same surface points, along other rays. A stored view is therefore a view
from every direction of gaze, and only its pixels are interpolated: inverse depth, which is linear
in the picture of a plane, so that flat parts stay exact.

Changes (occluders, wrong masks, a sensor's errors) take their chance from a generator alone. Depth
is NaN where nothing is seen.
"""

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from scipy.spatial import ConvexHull, QhullError
from torch import Tensor

from depthpose.core.camera.pinhole import crop_intrinsics
from depthpose.core.errors import InputError
from depthpose.core.loop import sample_generator
from depthpose.core.render import rasterize
from depthpose.core.rigid import Rigid
from depthpose.pose.cloud import grow_mask, lift_sample
from depthpose.pose.config import CloudConfig, ObjectsConfig, SensorKind, SyntheticSensorConfig
from depthpose.pose.grid import rotation_from_z_to
from depthpose.pose.mesh import drawn_triangles
from depthpose.pose.types import CloudSample, ObjectModel, PoseTruth, ViewInput, ViewSample

Depth = Float[Tensor, "h w"]
Mask = Bool[Tensor, "h w"]

_KINECT_BASELINE_M = 0.075
_KINECT_STEPS_PER_PX = 8  # of its disparity
_STEREO_BASELINE_M = 0.05
_STEREO_STEPS_PER_PX = 32
_STEREO_CORRELATION_PX = (3.0, 6.0)  # range of the width of its noise
_STEREO_WINDOW_PX = 2  # by which active stereo displaces an edge at most
_STEEPEST = math.tan(math.radians(80))
"""No sensor reads a surface that is turned farther away than 80 degrees."""
_JUMP = 0.02
"""Neighbours whose depths differ by more than this share lie on different surfaces, and are not
interpolated between."""


def uniform(generator: torch.Generator, low: float, high: float) -> float:
    """Draw a number of a range."""
    return low + (high - low) * float(torch.rand((), generator=generator))


def random_index(generator: torch.Generator, count: int) -> int:
    """Draw a whole number, 0 to count - 1, all equally likely."""
    return int(torch.randint(count, (), generator=generator))


def random_rotation(generator: torch.Generator) -> Float[Tensor, "3 3"]:
    """Draw a rotation, all equally likely: a quaternion of four normal numbers, in float64."""
    q = torch.randn(4, generator=generator, dtype=torch.float64)
    w, x, y, z = (q / q.norm()).tolist()
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return torch.tensor(rows, dtype=torch.float64)


def draw_levels(height: int, width: int, generator: torch.Generator) -> Depth:
    """Draw an image whose sublevel sets are half-planes, ellipses, boxes or convex polygons.

    Where it lies below a quantile of its values on an object, exactly that share of the object is
    occluded.
    """
    # Coordinates about a random place, along a random direction and across it.
    size = max(height, width)
    angle = uniform(generator, 0.0, 2 * math.pi)
    stretch = uniform(generator, 0.3, 1.0)
    row = uniform(generator, 0.0, float(height))
    column = uniform(generator, 0.0, float(width))
    v = (torch.arange(height)[:, None] - row) / size
    u = (torch.arange(width)[None] - column) / size
    along = math.cos(angle) * u + math.sin(angle) * v
    across = (math.cos(angle) * v - math.sin(angle) * u) * stretch
    match random_index(generator, 4):
        case 0:  # half-planes
            return along
        case 1:  # ellipses
            return along.square() + across.square()
        case 2:  # boxes
            return torch.maximum(along.abs(), across.abs())
        case _:
            return _draw_polygon_levels(along, across, generator)


def _draw_polygon_levels(along: Depth, across: Depth, generator: torch.Generator) -> Depth:
    """Draw an image whose sublevel sets are convex polygons of three to six sides.

    ``along`` and ``across`` are the coordinates of each pixel.
    """
    sides = 3 + random_index(generator, 4)
    gaps = torch.rand(sides, generator=generator).cumsum(0)
    angles = 2 * math.pi * gaps / (gaps[-1] + uniform(generator, 0.2, 0.8))
    extents = 0.5 + torch.rand(sides, generator=generator)
    level = torch.full_like(along, -torch.inf)
    for angle, extent in zip(angles.tolist(), extents.tolist(), strict=True):
        side = math.cos(angle) * along + math.sin(angle) * across
        level = torch.maximum(level, side / extent)
    return level


def occlude(
    depth_m: Depth, silhouette: Mask, share: float, generator: torch.Generator
) -> tuple[Depth, Mask]:
    """Occlude exactly a share of a silhouette by something before it.

    Args:
        depth_m: of the object and what is behind it.
        silhouette: pixels of the object.
        share: of them, that is occluded.
        generator: of random numbers.

    Returns:
        The depth with the occluder, and the part of the silhouette that stays visible.
    """
    count = round(share * int(silhouette.sum()))
    levels = draw_levels(depth_m.shape[0], depth_m.shape[1], generator)
    gap_m = uniform(generator, 0.005, 0.15)
    if count == 0:
        return depth_m, silhouette
    is_hidden = levels <= levels[silhouette].kthvalue(count).values
    # The occluder is nearer than all that it occludes.
    nearest_m = depth_m.masked_fill(~(silhouette & is_hidden), torch.inf).min()
    occluder_m = (nearest_m - gap_m).clamp(min=0.1 * nearest_m)
    return torch.where(is_hidden, occluder_m, depth_m), silhouette & ~is_hidden


def simulate_depth(
    depth_m: Depth,
    focal_px: tuple[float, float],
    config: SyntheticSensorConfig,
    generator: torch.Generator,
) -> Depth:
    """Simulate the measurement of a clean depth window by a sensor.

    Args:
        depth_m: of every pixel of the window; NaN where there is no surface.
        focal_px: of this window, and of the sensor's full image (which says how fine its disparity
            is).
        config: kinds of sensor, and their errors.
        generator: of random numbers.
    """
    # The sensor of this view, and the pixels that it does not read.
    kind: SensorKind = config.kinds[random_index(generator, len(config.kinds))]
    noise = uniform(generator, *config.noise)
    missing = uniform(generator, *config.missing)
    if kind == "none":
        return depth_m
    is_lost = _mark_steep(depth_m, focal_px[0], is_laser=kind == "laser")
    is_lost |= _mark_gaps(depth_m.shape, missing, generator)

    # Noise that neighbours share, by a width in pixels of the full image.
    correlation_px = config.noise_correlation_px
    if kind == "active stereo":
        correlation_px = correlation_px or _STEREO_CORRELATION_PX
    scale = focal_px[0] / focal_px[1]
    width_px = scale * uniform(generator, *correlation_px) if correlation_px else 0.0
    unit_noise = noise * draw_smooth_noise(
        (depth_m.shape[0], depth_m.shape[1]), width_px, generator
    )

    # What each kind of sensor reads.
    if kind == "structured light":
        is_lost |= _mark_shadow(depth_m, focal_px[0])
        read_m = _swap_neighbours(depth_m, generator)
        # Nguyen, Izadi and Lovell 2012: sigma_z = 0.0012 + 0.0019 (z - 0.4)^2 [m].
        read_m = read_m + unit_noise * (0.0012 + 0.0019 * (read_m - 0.4).square())
        scale_px_m = _KINECT_STEPS_PER_PX * focal_px[1] * _KINECT_BASELINE_M
        read_m = _round_disparity(read_m, scale_px_m)
    elif kind == "active stereo":
        is_lost |= _mark_shadow(depth_m.flip(1), focal_px[0], _STEREO_BASELINE_M).flip(1)
        first, second = (_displace(depth_m, scale, generator) for _ in range(2))
        read_m = torch.lerp(first, second, torch.rand(depth_m.shape, generator=generator))
        read_m = read_m + unit_noise * 0.003 * read_m.square()
        scale_px_m = _STEREO_STEPS_PER_PX * focal_px[1] * _STEREO_BASELINE_M
        read_m = _round_disparity(read_m, scale_px_m)
    elif kind == "time of flight":
        read_m = _mix_at_jumps(depth_m, generator)
        read_m = read_m + unit_noise * (0.001 + 0.002 * read_m.square())
    else:  # a laser
        read_m = depth_m + 0.0005 * unit_noise

    # All readings are off alike.
    read_m = read_m + uniform(generator, *config.offset_m)
    return torch.where(is_lost, torch.nan, read_m)


def _mark_steep(depth_m: Depth, focal_px: float, *, is_laser: bool) -> Mask:
    """Mark pixels of a surface seen at a grazing angle, which a sensor does not read."""
    steepest = 2 * _STEEPEST if is_laser else _STEEPEST
    limit_m = depth_m * (steepest / focal_px)  # largest change of depth to the next pixel
    across_m = depth_m.diff(dim=1).abs_()
    down_m = depth_m.diff(dim=0).abs_()
    # A jump to another surface is steep on one side alone: the flatter side decides.
    is_steep = torch.zeros_like(depth_m, dtype=torch.bool)
    is_steep[:, 1:-1] = torch.fmin(across_m[:, 1:], across_m[:, :-1]) > limit_m[:, 1:-1]
    is_steep[1:-1] |= torch.fmin(down_m[1:], down_m[:-1]) > limit_m[1:-1]
    return is_steep


def _mark_gaps(size: torch.Size, share: float, generator: torch.Generator) -> Mask:
    """Mark a share of the pixels as missing, half of them singly, half in patches."""
    # Single ones.
    height, width = size
    is_missing = torch.rand(height, width, generator=generator) < 0.5 * share

    # Patches, where a smooth image is low.
    coarse = torch.rand(1, 1, 2 + height // 12, 2 + width // 12, generator=generator)
    patches = F.interpolate(coarse, (height, width), mode="bilinear", align_corners=False)[0, 0]
    # The level of the patches is a quantile of every fourth row and column, which is near enough.
    sampled = patches[::4, ::4].flatten()
    if count := round(0.5 * share * len(sampled)):
        is_missing |= patches <= sampled.kthvalue(count).values
    return is_missing


def _swap_neighbours(depth_m: Depth, generator: torch.Generator) -> Depth:
    """Let each pixel read one that is a pixel or none away: edges are blurred.

    At the ends of a row it reads the next row; windows have a margin there.
    """
    height, width = depth_m.shape
    steps = torch.tensor([-1, 0, 0, 1])
    moves = (steps[:, None] * width + steps).flatten()
    index = torch.arange(height * width)
    index += moves[torch.randint(16, (height * width,), generator=generator)]
    index = index.clamp_(0, height * width - 1)
    return depth_m.reshape(-1)[index].view(height, width)


def _round_disparity(depth_m: Depth, scale_px_m: float) -> Depth:
    """Round depth to whole steps of disparity, which is ``scale_px_m`` over the depth.

    The scale is the steps in a pixel times focal length [px] and baseline [m].
    """
    return scale_px_m / (scale_px_m / depth_m).round()


def _mix_at_jumps(depth_m: Depth, generator: torch.Generator) -> Depth:
    """Mix each pixel with its right or lower neighbour where depth jumps."""
    share = torch.rand(depth_m.shape, generator=generator)
    right_m = depth_m.roll(-1, 1)
    lower_m = depth_m.roll(-1, 0)
    right_m[:, -1] = depth_m[:, -1]
    lower_m[-1] = depth_m[-1]
    mixed_m = depth_m
    for neighbour_m in (right_m, lower_m):
        is_jump = (neighbour_m - mixed_m).abs() > _JUMP * mixed_m
        mixed_m = torch.where(is_jump, torch.lerp(mixed_m, neighbour_m, share), mixed_m)
    return mixed_m


def draw_smooth_noise(size: tuple[int, int], width_px: float, generator: torch.Generator) -> Depth:
    """Draw normal noise of deviation 1, correlated between neighbours.

    It is white noise convolved with a Gaussian of deviation ``width_px``, 0 for white noise;
    ``size`` is rows and columns.
    """
    # White noise, with a margin for the Gaussian.
    radius = math.ceil(3 * width_px)
    white = torch.randn(size[0] + 2 * radius, size[1] + 2 * radius, generator=generator)
    if radius == 0:
        return white

    # The Gaussian, one axis after the other.
    weights = (-0.5 * (torch.arange(-radius, radius + 1) / width_px).square()).exp()
    weights = weights / weights.norm()
    along = F.conv2d(white[None, None], weights.view(1, 1, 1, -1))
    return F.conv2d(along, weights.view(1, 1, -1, 1))[0, 0]


def _mark_shadow(depth_m: Depth, focal_px: float, baseline_m: float = _KINECT_BASELINE_M) -> Mask:
    """Mark pixels in shadow: a nearer surface hides them from the projector beside the camera."""
    column = torch.arange(depth_m.shape[1])
    projector_column = column + (focal_px * baseline_m / depth_m).nan_to_num(-torch.inf)
    # The projector's columns ascend along a row, except behind an edge.
    return projector_column < projector_column.cummax(1).values - 1.5


def _displace(depth_m: Depth, scale: float, generator: torch.Generator) -> Depth:
    """Let each pixel read one some pixels away, as its neighbours do: edges wander.

    ``scale`` is that of the window to the full image, in whose pixels the displacement is drawn.
    """
    height, width = depth_m.shape
    shifts = [1.2 * draw_smooth_noise((height, width), 3.0 * scale, generator) for _ in range(2)]
    farthest = _STEREO_WINDOW_PX * scale
    dy, dx = ((scale * shift).clamp(-farthest, farthest).round().long() for shift in shifts)
    rows = (torch.arange(height)[:, None] + dy).clamp(0, height - 1)
    columns = (torch.arange(width) + dx).clamp(0, width - 1)
    return depth_m[rows, columns]


MARGIN_PX = 8  #: around the object, in which the background is visible where a mask is too large


@dataclass(frozen=True, kw_only=True, eq=False)
class Shape:
    """The geometry of an object for drawing.

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
    """A view of an object on the optical axis, in half of the memory."""

    offset_m: Float[Tensor, "h w"]  #: depth minus ``distance_m``: float16 is exact to 0.1 mm
    distance_m: float  #: of the middle of the object
    K: Float[Tensor, "3 3"]  #: intrinsic matrix of the window
    camera_from_model: Rigid  #: the pose

    def restore_depth(self) -> CleanView:
        """Restore the depth of the view."""
        depth_m = self.offset_m.float() + self.distance_m
        return CleanView(depth_m=depth_m, K=self.K, camera_from_model=self.camera_from_model)


def make_shape(model: ObjectModel) -> Shape:
    """Prepare an object for many views."""
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
    """Find the window in which an object lies, with a margin: its intrinsics, width and height."""
    corners = shape.hull_m @ pose.R.mT + (pose.t_m + pose.R @ shape.middle_m)
    pixels = (corners @ K.mT)[:, :2] / corners[:, 2:]
    left, top = (pixels.amin(0).floor() - MARGIN_PX).tolist()
    right, bottom = (pixels.amax(0).ceil() + MARGIN_PX).tolist()
    window_K = crop_intrinsics(K, int(left), int(top))
    return window_K, int(right - left) + 1, int(bottom - top) + 1


def draw_view(shape: Shape, pose: Rigid, K: Float[Tensor, "3 3"]) -> CleanView:
    """Draw an object in the window around it."""
    window_K, width, height = find_window(shape, pose, K)
    # float64 poses: the corners are rounded once.
    triangles = (shape.triangles_m.double() @ pose.R.mT + pose.t_m).float()
    raster = rasterize(triangles, window_K, width, height, with_barycentric=False)
    return CleanView(depth_m=raster.depth_m, K=window_K, camera_from_model=pose)


def turn_view(
    view: CleanView, turn: Float[Tensor, "3 3"], shape: Shape, K: Float[Tensor, "3 3"]
) -> CleanView:
    """Resample a view as a rotated camera sees it: ``x_new = turn @ x_old``.

    Args:
        view: the view.
        turn: rotation of the camera frame.
        shape: of the object, for the window.
        K: intrinsic matrix of the image of the new view.
    """
    old = view.camera_from_model
    pose = Rigid(turn @ old.R, turn @ old.t_m)
    window_K, width, height = find_window(shape, pose, K)

    # The old pixel of each new one, and w, the old depth over the new one.
    ray_from_pixel = turn.mT @ invert_intrinsics(window_K)
    (a, b, c), (d, e, f), (g, h, i) = (view.K @ ray_from_pixel).tolist()
    u = torch.arange(width)[None]
    v = torch.arange(height)[:, None]
    w = g * u + h * v + i
    source_u = (a * u + b * v + c) / w
    source_v = (d * u + e * v + f) / w

    # 1 / depth, interpolated between pixels; at edges and beside the object that of the nearest
    # pixel; NaN outside.
    inverse = 1 / view.depth_m
    rows, columns = inverse.shape
    left = source_u.floor().clamp_(0, columns - 2)
    top = source_v.floor().clamp_(0, rows - 2)
    x = source_u - left
    y = source_v - top
    index = (top * columns + left).long()
    flat = inverse.reshape(-1)
    nw, ne, sw, se = (flat[index + beyond] for beyond in (0, 1, columns, columns + 1))
    upper = torch.lerp(nw, ne, x)
    lower = torch.lerp(sw, se, x)
    smooth = torch.lerp(upper, lower, y)
    nearest_upper = torch.where(x < 0.5, nw, ne)
    nearest_lower = torch.where(x < 0.5, sw, se)
    nearest = torch.where(y < 0.5, nearest_upper, nearest_lower)
    # A comparison with NaN is false: where one of the four pixels is empty the nearest is taken.
    highest = torch.maximum(torch.maximum(nw, ne), torch.maximum(sw, se))
    lowest = torch.minimum(torch.minimum(nw, ne), torch.minimum(sw, se))
    resampled = torch.where(highest - lowest < _JUMP * smooth, smooth, nearest)

    # Pixels beyond the old window see nothing.
    is_inside = (x - 0.5).abs().maximum((y - 0.5).abs()) <= 1
    resampled = torch.where(is_inside, resampled, torch.nan)
    return CleanView(depth_m=1 / (resampled * w), K=window_K, camera_from_model=pose)


def _draw_offset(generator: torch.Generator, most: int) -> int:
    """Draw a whole number, -most to most, all equally likely."""
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


_BANK_SEED = 0x0B7EC7  # added to the seed, for stored views
_MOST_TILT_RAD = math.radians(75)  # of the plane behind an object against the line of sight


class Objects:
    """Synthetic partial views by index; each depends on the seed and its index alone.

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
        self._views: dict[tuple[int, int], _StoredView] = {}

    def __len__(self) -> int:
        return self.config.number

    def __getitem__(self, index: int) -> CloudSample:
        """Make one partial cloud.

        Raises:
            IndexError: there is no such sample.
        """
        if not 0 <= index < len(self):
            raise IndexError(f"sample {index} of {len(self)}")
        diameter_m = self.models[index % len(self.models)].diameter_m
        return lift_sample(self.view(index), diameter_m, self.cloud)

    def draw_stored(self, workers: int) -> None:
        """Draw all stored views now, in ``workers`` threads: processes forked later share them."""
        keys = [(n, k) for k in range(self.config.views or 0) for n in range(len(self.models))]
        with ThreadPoolExecutor(workers) as pool:
            for _ in pool.map(self._find_stored, keys):
                pass

    def view(self, index: int) -> ViewSample:
        """Make the window of depth and the mask that a sample is lifted from."""
        number = index % len(self.models)
        generator = sample_generator(index, self.config.seed)
        clean = self._make_clean_view(number, generator)
        silhouette = clean.depth_m.isfinite()
        depth_m = clean.depth_m
        visible = silhouette

        # A background behind the object, and something that occludes a part of it.
        if self.config.with_background:
            depth_m = self._add_background(clean, self._shapes[number], generator)
        if uniform(generator, 0.0, 1.0) < self.config.occluded_share:
            share = uniform(generator, *self.config.occlusion)
            depth_m, visible = occlude(depth_m, silhouette, share, generator)

        # The errors of a mask, and those of a sensor.
        scale = float(clean.K[0, 0]) / self.config.focal_px[0]  # to pixels of the full image
        grow_px = _draw_offset(generator, self.config.mask_error_px)
        mask = grow_mask(visible, round(grow_px * scale))
        focal_px = (float(clean.K[0, 0]), self.config.focal_px[0])
        measured_m = simulate_depth(depth_m, focal_px, self.config.sensor, generator)
        down = round(_draw_offset(generator, self.config.mask_shift_px) * scale)
        right = round(_draw_offset(generator, self.config.mask_shift_px) * scale)
        mask = _shift_mask(mask, down, right)

        model = self.models[number]
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

    def _make_clean_view(self, number: int, generator: torch.Generator) -> CleanView:
        """Make a view of an object without errors: drawn anew, or a stored one, rotated."""
        shape = self._shapes[number]
        views = self.config.views

        # Drawn anew: the object on the optical axis, turned with the camera to another place in the
        # image. Its middle (0, 0, distance) is then the third column of the turn, so many times.
        if views is None:
            R = random_rotation(generator)
            distance_m = uniform(generator, *self.config.distance_m)
            K = self.intrinsics(uniform(generator, *self.config.resolution))
            turn = self._draw_gaze(number, distance_m, K, generator)
            R = turn @ R
            pose = Rigid(R, turn[:, 2] * distance_m - R @ shape.middle_m)
            return draw_view(shape, pose, K)

        # A stored view, in which the object lies on the axis: its pixels are turned likewise.
        stored = self._find_stored((number, random_index(generator, views)))
        K = self.intrinsics(float(stored.K[0, 0]) / self.config.focal_px[0])
        turn = self._draw_gaze(number, stored.distance_m, K, generator)
        return turn_view(stored.restore_depth(), turn, shape, K)

    def _find_stored(self, key: tuple[int, int]) -> _StoredView:
        """Find a stored view by the numbers of its object and of the view; drawn when needed."""
        if key not in self._views:
            # Drawn on the optical axis, by a seed of its own.
            number, place = key
            index = place * len(self.models) + number
            generator = sample_generator(index, self.config.seed + _BANK_SEED)
            shape = self._shapes[number]
            R = random_rotation(generator)
            distance_m = uniform(generator, *self.config.distance_m)
            K = self.intrinsics(uniform(generator, *self.config.resolution))
            middle_m = torch.tensor([0.0, 0.0, distance_m], dtype=torch.float64)
            pose = Rigid(R, middle_m - R @ shape.middle_m)
            view = draw_view(shape, pose, K)
            self._views[key] = _StoredView(
                offset_m=(view.depth_m - distance_m).half(),
                distance_m=distance_m,
                K=view.K,
                camera_from_model=pose,
            )
        return self._views[key]

    def intrinsics(self, scale: float = 1.0) -> Float[Tensor, "3 3"]:
        """Give the intrinsic matrix of the sensor's image, enlarged by ``scale``."""
        assert self.config.centre_px is not None, "the config computes a centre left out"
        fx, fy = self.config.focal_px
        cx, cy = self.config.centre_px
        rows = [
            [scale * fx, 0, scale * (cx + 0.5) - 0.5],
            [0, scale * fy, scale * (cy + 0.5) - 0.5],
        ]
        return torch.tensor([*rows, [0, 0, 1]], dtype=torch.float64)

    def _draw_gaze(
        self, number: int, distance_m: float, K: Tensor, generator: torch.Generator
    ) -> Float[Tensor, "3 3"]:
        """Draw a rotation of the camera by which an object lies wholly in the image, anywhere.

        Args:
            number: of the object.
            distance_m: of its middle.
            K: intrinsic matrix of the image.
            generator: of random numbers.
        """
        # A place at which the whole object is in the image; the middle, where it is too large.
        diameter = self.models[number].diameter_m
        scale = float(K[0, 0]) / self.config.focal_px[0]
        radius_px = float(K[0, 0]) * 0.5 * diameter / max(distance_m - 0.5 * diameter, 1e-3)
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
        """Put a table or wall behind an object, and clutter beside it; give the depth."""
        # A plane that touches the object or lies behind it, tilted against the line of sight.
        pose = clean.camera_from_model
        hull_m = shape.hull_m @ pose.R.mT + (pose.t_m + pose.R @ shape.middle_m)
        tilt = uniform(generator, 0.0, _MOST_TILT_RAD)
        side = uniform(generator, 0.0, 2 * math.pi)
        tilted = torch.tensor([math.sin(tilt), 0.0, -math.cos(tilt)], dtype=torch.float64)
        normal = aim_camera(hull_m.mean(0), side) @ tilted

        # Its depth in each pixel; none where the ray does not meet it.
        gap_m = max(0.0, uniform(generator, -0.2, 0.3))
        offset = float((hull_m @ normal).min()) - gap_m
        a, b, c = (normal @ invert_intrinsics(clean.K)).tolist()
        height, width = clean.depth_m.shape
        slope = a * torch.arange(width)[None] + b * torch.arange(height)[:, None] + c
        behind_m = torch.where(slope * offset > 0, offset / slope, torch.nan)

        # Clutter: a shape parallel to the image, at about the depth of the object.
        nearest_m = float(hull_m[:, 2].min())
        farthest_m = float(hull_m[:, 2].max())
        levels = draw_levels(height, width, generator)
        lowest = float(levels.amin())
        level = lowest + uniform(generator, 0.0, 0.6) * float(levels.amax() - levels.amin())
        clutter_m = uniform(generator, nearest_m, farthest_m + 0.2)
        is_clutter = (levels < level) & ~(behind_m < clutter_m)
        behind_m = torch.where(is_clutter, clutter_m, behind_m)
        return torch.where(clean.depth_m.isfinite(), clean.depth_m, behind_m)
