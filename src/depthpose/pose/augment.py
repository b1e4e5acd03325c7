"""Random changes that keep a pose true: occluders, wrong masks, a sensor's errors.

Each takes its chance from a generator alone. Depth is NaN where nothing is seen.
"""

import math

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from depthpose.pose.config import SensorConfig, SensorKind

Depth = Float[Tensor, "h w"]
Mask = Bool[Tensor, "h w"]

_KINECT_BASELINE_M = 0.075
_STEPS_A_PIXEL = 8
_STEREO_BASELINE_M = 0.05
_STEREO_STEPS_A_PIXEL = 32
_STEREO_CORRELATION_PX = (3.0, 6.0)
_STEREO_WINDOW = 2
"""Pixels by which active stereo displaces an edge at most."""
_STEEPEST = math.tan(math.radians(80))
"""No sensor reads a surface that is turned farther away than 80 degrees."""
_JUMP = 0.02
"""Neighbours whose depths differ by more than this share lie on different surfaces."""


def uniform(generator: torch.Generator, low: float, high: float) -> float:
    """Draw a number of a range."""
    return low + (high - low) * float(torch.rand((), generator=generator))


def whole(generator: torch.Generator, count: int) -> int:
    """Draw one of 0 .. count - 1."""
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


def random_levels(height: int, width: int, generator: torch.Generator) -> Depth:
    """Draw a function whose lower parts are half-planes, ellipses, boxes or convex polygons.

    Cut at a quantile, it occludes exactly the wanted share of anything.
    """
    size = max(height, width)
    angle, stretch = uniform(generator, 0.0, 2 * math.pi), uniform(generator, 0.3, 1.0)
    row, column = uniform(generator, 0.0, float(height)), uniform(generator, 0.0, float(width))
    v = (torch.arange(height)[:, None] - row) / size
    u = (torch.arange(width)[None] - column) / size
    along = math.cos(angle) * u + math.sin(angle) * v
    across = (math.cos(angle) * v - math.sin(angle) * u) * stretch
    match whole(generator, 4):
        case 0:
            return along
        case 1:
            return along.square() + across.square()
        case 2:
            return torch.maximum(along.abs(), across.abs())
        case _:  # a convex polygon
            sides = 3 + whole(generator, 4)
            turns = torch.rand(sides, generator=generator).cumsum(0)
            angles = 2 * math.pi * turns / (turns[-1] + uniform(generator, 0.2, 0.8))
            far = 0.5 + torch.rand(sides, generator=generator)
            level = torch.full_like(along, -torch.inf)
            for turn, extent in zip(angles.tolist(), far.tolist(), strict=True):
                side = (math.cos(turn) * along + math.sin(turn) * across) / extent
                level = torch.maximum(level, side)
            return level


def occlude(
    depth_m: Depth, silhouette: Mask, share: float, generator: torch.Generator
) -> tuple[Depth, Mask]:
    """Occlude exactly a share of a silhouette by something before it; give what is left of both."""
    count = round(share * int(silhouette.sum()))
    levels = random_levels(depth_m.shape[0], depth_m.shape[1], generator)
    gap_m = uniform(generator, 0.005, 0.15)
    if count == 0:
        return depth_m, silhouette
    is_hidden = levels <= levels[silhouette].kthvalue(count).values
    # Nearer than all that it occludes.
    nearest_m = depth_m.masked_fill(~(silhouette & is_hidden), torch.inf).min()
    occluder_m = (nearest_m - gap_m).clamp(min=0.1 * nearest_m)
    return torch.where(is_hidden, occluder_m, depth_m), silhouette & ~is_hidden


def shift_mask(mask: Mask, rows: int, columns: int) -> Mask:
    """Shift a mask by so many pixels down and right; what comes in is not of it."""
    shifted = mask.roll((rows, columns), (0, 1))
    for axis, steps in enumerate((rows, columns)):
        if steps:
            size = mask.shape[axis]
            start = 0 if steps > 0 else max(0, size + steps)
            shifted.narrow(axis, start, min(abs(steps), size)).fill_(False)
    return shifted


def measure(
    depth_m: Depth, focal_px: tuple[float, float], config: SensorConfig, generator: torch.Generator
) -> Depth:
    """Measure a clean depth window as a sensor would.

    Args:
        depth_m: of every pixel of the window; NaN where there is nothing.
        focal_px: of this window, and of the sensor's full image (which says how fine its disparity
            is).
        config: kinds of sensor, and how bad they are.
        generator: of the chance.
    """
    kind: SensorKind = config.kinds[whole(generator, len(config.kinds))]
    noise, missing = uniform(generator, *config.noise), uniform(generator, *config.missing)
    if kind == "none":
        return depth_m
    steepest = _STEEPEST if kind != "laser" else 2 * _STEEPEST
    is_lost = _is_steep(depth_m, focal_px[0], steepest)
    # Half of the missing readings singly, half in patches.
    height, width = depth_m.shape
    is_lost |= torch.rand(height, width, generator=generator) < 0.5 * missing
    coarse = torch.rand(1, 1, 2 + height // 12, 2 + width // 12, generator=generator)
    patches = F.interpolate(coarse, (height, width), mode="bilinear", align_corners=False)[0, 0]
    # Their level is met on every fourth row and column: the share is a matter of chance anyway.
    some = patches[::4, ::4].flatten()
    if count := round(0.5 * missing * len(some)):
        is_lost |= patches <= some.kthvalue(count).values
    correlation_px = config.noise_correlation_px
    if kind == "active stereo":
        correlation_px = correlation_px or _STEREO_CORRELATION_PX
    of_full = focal_px[0] / focal_px[1]
    width_px = of_full * uniform(generator, *correlation_px) if correlation_px else 0.0
    white = noise * smooth_noise((depth_m.shape[0], depth_m.shape[1]), width_px, generator)
    if kind == "structured light":
        is_lost |= _is_shadowed(depth_m, focal_px[0])
        # Each pixel reads one that is a pixel or none away: edges are blurred. At the ends of a row
        # it reads beyond; windows have a margin there.
        steps, index = torch.tensor([-1, 0, 0, 1]), torch.arange(height * width)
        moves = (steps[:, None] * width + steps).flatten()
        index += moves[torch.randint(16, (height * width,), generator=generator)]
        index = index.clamp_(0, height * width - 1)
        read_m = depth_m.reshape(-1)[index].view(height, width)
        # Nguyen, Izadi and Lovell 2012: sigma_z = 0.0012 + 0.0019 (z - 0.4)^2 [m].
        read_m = read_m + white * (0.0012 + 0.0019 * (read_m - 0.4).square())
        scale = _STEPS_A_PIXEL * focal_px[1] * _KINECT_BASELINE_M
        read_m = scale / (scale / read_m).round()
    elif kind == "active stereo":
        is_lost |= _is_shadowed(depth_m.flip(1), focal_px[0], _STEREO_BASELINE_M).flip(1)
        one, other = (_displaced(depth_m, of_full, generator) for _ in range(2))
        read_m = torch.lerp(one, other, torch.rand(depth_m.shape, generator=generator))
        read_m = read_m + white * 0.003 * read_m.square()
        scale = _STEREO_STEPS_A_PIXEL * focal_px[1] * _STEREO_BASELINE_M
        read_m = scale / (scale / read_m).round()
    elif kind == "time of flight":
        # A pixel is mixed with its right or lower neighbour where depth jumps.
        share = torch.rand(depth_m.shape, generator=generator)
        right, lower = depth_m.roll(-1, 1), depth_m.roll(-1, 0)
        right[:, -1], lower[-1] = depth_m[:, -1], depth_m[-1]
        read_m = depth_m
        for other in (right, lower):
            is_jump = (other - read_m).abs() > _JUMP * read_m
            read_m = torch.where(is_jump, torch.lerp(read_m, other, share), read_m)
        read_m = read_m + white * (0.001 + 0.002 * read_m.square())
    else:
        read_m = depth_m + 0.0005 * white
    read_m = read_m + uniform(generator, *config.offset_m)
    return torch.where(is_lost, torch.nan, read_m)


def smooth_noise(size: tuple[int, int], width_px: float, generator: torch.Generator) -> Depth:
    """Draw normal noise of deviation 1 that neighbours share: white noise under a Gaussian.

    ``size`` is rows and columns; a Gaussian of deviation ``width_px`` 0 leaves the noise white.
    """
    radius = math.ceil(3 * width_px)
    white = torch.randn(size[0] + 2 * radius, size[1] + 2 * radius, generator=generator)
    if radius == 0:
        return white
    weights = (-0.5 * (torch.arange(-radius, radius + 1) / width_px).square()).exp()
    weights = weights / weights.norm()
    along = F.conv2d(white[None, None], weights.view(1, 1, 1, -1))
    return F.conv2d(along, weights.view(1, 1, -1, 1))[0, 0]


def _is_steep(depth_m: Depth, focal_px: float, steepest: float) -> Mask:
    """Mark surfaces seen at a grazing angle: one pixel on, the depth changes by far too much."""
    limit_m = depth_m * (steepest / focal_px)
    is_steep = torch.zeros_like(depth_m, dtype=torch.bool)
    across, down = depth_m.diff(dim=1).abs_(), depth_m.diff(dim=0).abs_()
    # A jump to another surface is steep on one side alone: the flatter side decides.
    is_steep[:, 1:-1] = torch.fmin(across[:, 1:], across[:, :-1]) > limit_m[:, 1:-1]
    is_steep[1:-1] |= torch.fmin(down[1:], down[:-1]) > limit_m[1:-1]
    return is_steep


def _is_shadowed(depth_m: Depth, focal_px: float, baseline_m: float = _KINECT_BASELINE_M) -> Mask:
    """Mark what the projector, beside the camera, cannot light: something nearer is in its way."""
    column = torch.arange(depth_m.shape[1])
    lit = column + (focal_px * baseline_m / depth_m).nan_to_num(-torch.inf)
    # The projector's columns ascend along a row, but for what lies behind an edge.
    return lit < lit.cummax(1).values - 1.5


def _displaced(depth_m: Depth, scale: float, generator: torch.Generator) -> Depth:
    """Read each pixel ``scale`` times some pixels away, alike its neighbours: edges wander."""
    height, width = depth_m.shape
    ways = [1.2 * smooth_noise((height, width), 3.0 * scale, generator) for _ in range(2)]
    farthest = _STEREO_WINDOW * scale
    dy, dx = ((scale * way).clamp(-farthest, farthest).round().long() for way in ways)
    rows = (torch.arange(height)[:, None] + dy).clamp(0, height - 1)
    columns = (torch.arange(width) + dx).clamp(0, width - 1)
    return depth_m[rows, columns]
