"""What depth sensors read of exact depth: missing pixels, blurred edges, noise and rounding.

Chance is a generator alone. Depth is NaN where nothing is read.
"""

import math

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from depthpose.pose.config import SensorKind, SyntheticSensorConfig
from depthpose.pose.synthetic.random_numbers import random_index, uniform

Depth = Float[Tensor, "h w"]
Mask = Bool[Tensor, "h w"]

_KINECT_BASELINE_M = 0.075  # from its projector to its camera
_KINECT_STEPS_PER_PX = 8  # of its disparity
_STEREO_BASELINE_M = 0.05
_STEREO_STEPS_PER_PX = 32
_STEREO_CORRELATION_PX = (3.0, 6.0)  # range of the width of its noise
_STEREO_WINDOW_PX = 2  # by which active stereo displaces an edge at most
_DISPLACEMENT_PX = 1.2  # standard deviation of that displacement
_DISPLACEMENT_WIDTH_PX = 3.0  # distance over which neighbours are displaced alike
_LASER_NOISE_M = 0.0005  # standard deviation
_SHADOW_PX = 1.5  # by which a column of the projector lies before another that hides it
_PATCH_PX = 12  # width of a patch of missing pixels
_STEEPEST = math.tan(math.radians(80))
"""No sensor but a laser reads a surface that is turned farther away than 80 degrees."""
JUMP = 0.02
"""Neighbours whose depths differ by more than this share lie on different surfaces."""


def simulate_depth(
    depth_m: Depth,
    focal_px: tuple[float, float],
    config: SyntheticSensorConfig,
    generator: torch.Generator,
) -> Depth:
    """Simulate the measurement of a clean depth window by a sensor.

    Args:
        depth_m: exact depth of every pixel of the window; NaN where there is no surface.
        focal_px: of this window, and of the sensor's full image (which says how fine its disparity
            is).
        config: kinds of sensor, and their errors.
        generator: of random numbers.

    Returns:
        What the sensor reads [m]; NaN where it reads nothing.
    """
    # The sensor of this view, and the pixels that no sensor reads.
    window_focal_px, image_focal_px = focal_px
    kind: SensorKind = config.kinds[random_index(generator, len(config.kinds))]
    noise = uniform(generator, *config.noise)
    missing = uniform(generator, *config.missing)
    if kind == "none":
        return depth_m
    is_lost = _mark_steep(depth_m, window_focal_px, is_laser=kind == "laser")
    is_lost |= _mark_gaps(depth_m.shape, missing, generator)

    # Noise that neighbours share, by a width in pixels of the full image.
    correlation_px = config.noise_correlation_px
    if kind == "active stereo":
        correlation_px = correlation_px or _STEREO_CORRELATION_PX
    scale = window_focal_px / image_focal_px
    width_px = scale * uniform(generator, *correlation_px) if correlation_px else 0.0
    unit_noise = noise * draw_smooth_noise(
        (depth_m.shape[0], depth_m.shape[1]), width_px, generator
    )

    # What each kind of sensor reads.
    if kind == "structured light":
        is_lost |= _mark_shadow(depth_m, window_focal_px)
        read_m = _read_structured_light(depth_m, unit_noise, image_focal_px, generator)
    elif kind == "active stereo":
        # Its second camera is on the other side: the shadow falls to the other side too.
        is_lost |= _mark_shadow(depth_m.flip(1), window_focal_px, _STEREO_BASELINE_M).flip(1)
        read_m = _read_active_stereo(depth_m, unit_noise, focal_px, generator)
    elif kind == "time of flight":
        read_m = _read_time_of_flight(depth_m, unit_noise, generator)
    else:  # a laser
        read_m = depth_m + _LASER_NOISE_M * unit_noise

    # All readings are off alike.
    read_m = read_m + uniform(generator, *config.offset_m)
    return torch.where(is_lost, torch.nan, read_m)


def _read_structured_light(
    depth_m: Depth, unit_noise: Depth, image_focal_px: float, generator: torch.Generator
) -> Depth:
    """Read depth as a Kinect does: blurred edges, noise, and steps of disparity."""
    read_m = _read_random_neighbours(depth_m, generator)
    # Nguyen, Izadi and Lovell 2012: sigma_z = 0.0012 + 0.0019 (z - 0.4)^2 [m].
    read_m = read_m + unit_noise * (0.0012 + 0.0019 * (read_m - 0.4).square())
    scale_px_m = _KINECT_STEPS_PER_PX * image_focal_px * _KINECT_BASELINE_M
    return _round_disparity(read_m, scale_px_m)


def _read_active_stereo(
    depth_m: Depth, unit_noise: Depth, focal_px: tuple[float, float], generator: torch.Generator
) -> Depth:
    """Read depth as a stereo pair with a projector does: wandering edges, noise, and steps.

    ``focal_px``: as of :func:`simulate_depth`.
    """
    # At an edge the depths of two displaced places are mixed.
    window_focal_px, image_focal_px = focal_px
    scale = window_focal_px / image_focal_px
    first, second = (_displace(depth_m, scale, generator) for _ in range(2))
    read_m = torch.lerp(first, second, torch.rand(depth_m.shape, generator=generator))

    # sigma_z = 0.003 z^2 [m].
    read_m = read_m + unit_noise * 0.003 * read_m.square()
    scale_px_m = _STEREO_STEPS_PER_PX * image_focal_px * _STEREO_BASELINE_M
    return _round_disparity(read_m, scale_px_m)


def _read_time_of_flight(depth_m: Depth, unit_noise: Depth, generator: torch.Generator) -> Depth:
    """Read depth by time of flight: mixed pixels at edges, and noise."""
    read_m = _mix_at_jumps(depth_m, generator)
    # sigma_z = 0.001 + 0.002 z^2 [m].
    return read_m + unit_noise * (0.001 + 0.002 * read_m.square())


def _mark_steep(depth_m: Depth, focal_px: float, *, is_laser: bool) -> Mask:
    """Mark pixels of a surface seen at a grazing angle, which a sensor does not read."""
    steepest = 2 * _STEEPEST if is_laser else _STEEPEST  # a laser reads steeper surfaces
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
    # Singly.
    height, width = size
    is_missing = torch.rand(height, width, generator=generator) < 0.5 * share

    # In patches, where a smooth image is low.
    rows = 2 + height // _PATCH_PX
    columns = 2 + width // _PATCH_PX
    coarse = torch.rand(1, 1, rows, columns, generator=generator)
    patches = F.interpolate(coarse, (height, width), mode="bilinear", align_corners=False)[0, 0]
    # The level of the patches is a quantile of every fourth row and column, which is near enough.
    sampled = patches[::4, ::4].flatten()
    if count := round(0.5 * share * len(sampled)):
        is_missing |= patches <= sampled.kthvalue(count).values
    return is_missing


def _read_random_neighbours(depth_m: Depth, generator: torch.Generator) -> Depth:
    """Let each pixel read itself or a neighbour at random: edges are blurred.

    At the ends of a row it reads the next row; windows have a margin there.
    """
    height, width = depth_m.shape
    steps = torch.tensor([-1, 0, 0, 1])  # along each axis, to stay twice as likely
    moves = (steps[:, None] * width + steps).flatten()  # of the index of a pixel
    index = torch.arange(height * width)
    index += moves[torch.randint(len(moves), (height * width,), generator=generator)]
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
        is_jump = (neighbour_m - mixed_m).abs() > JUMP * mixed_m
        mixed_m = torch.where(is_jump, torch.lerp(mixed_m, neighbour_m, share), mixed_m)
    return mixed_m


def draw_smooth_noise(size: tuple[int, int], width_px: float, generator: torch.Generator) -> Depth:
    """Draw normal noise of standard deviation 1, which neighbours share.

    Args:
        size: rows and columns.
        width_px: standard deviation of the Gaussian by which white noise is smoothed; 0: it is not.
        generator: of random numbers.
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
    """Mark pixels in shadow: a nearer surface hides them from the projector left of the camera."""
    column = torch.arange(depth_m.shape[1])
    disparity_px = (focal_px * baseline_m / depth_m).nan_to_num(-torch.inf)
    projector_column = column + disparity_px
    # The projector's columns ascend along a row, except behind an edge.
    return projector_column < projector_column.cummax(1).values - _SHADOW_PX


def _displace(depth_m: Depth, scale: float, generator: torch.Generator) -> Depth:
    """Let each pixel read one some pixels away, as its neighbours do: edges wander.

    ``scale`` is that of the window to the full image, in whose pixels the displacement is drawn.
    """
    height, width = depth_m.shape
    width_px = _DISPLACEMENT_WIDTH_PX * scale
    shifts = [
        _DISPLACEMENT_PX * draw_smooth_noise((height, width), width_px, generator) for _ in range(2)
    ]
    farthest = _STEREO_WINDOW_PX * scale
    dy, dx = ((scale * shift).clamp(-farthest, farthest).round().long() for shift in shifts)
    rows = (torch.arange(height)[:, None] + dy).clamp(0, height - 1)
    columns = (torch.arange(width) + dx).clamp(0, width - 1)
    return depth_m[rows, columns]
