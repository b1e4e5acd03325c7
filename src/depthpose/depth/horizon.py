"""Tilt and roll of a street's camera by the straight edges in its image, without any scale.

Along a street most long edges run forward (lanes, kerbs, eaves), upright or across, so their lines
meet in three vanishing points. The angles of a camera predict these points; the best angles are
those to whose points most edges run (after Coughlan and Yuille 1999). All other edges, such as
those of trees and shadows, may have any direction.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from depthpose.core.arrays import grey_from_rgb
from depthpose.core.camera import Camera
from depthpose.depth.types import View

_MAX_PIXELS = 500_000
"""Larger images are halved until they have fewer: edges in a street are long."""
_MIN_CONTRAST = 0.012
"""Least contrast of an edge: change of grey from pixel to pixel; white is 1."""
_SMOOTHING_PX = 1.0
"""Standard deviation of the Gaussian that an image is smoothed by before its gradient is taken."""
_MIN_COS_ANGLE = math.cos(math.radians(20))
"""Cosine of the largest angle between the gradients of two neighbours on one segment."""
_MIN_LENGTH_PX = 20.0
_MAX_WIDTH_SHARE = 0.03
_MIN_WIDTH_LIMIT_PX = 1.5
"""Largest width of a segment, as a share of its length, but at least this many pixels: wider
ones are curves."""
_MAX_SEGMENTS = 60
"""Only the longest segments are used; all of KITTI's 300 were worse: short ones are leaves and
shadows."""
_END_STD_PX = 0.5
_DIRECTION_STD_RAD = math.radians(0.6)
"""Standard deviations of the ends of a segment, and of the directions of what is built straight."""
_FORWARD_SHARE = 0.25
_UPRIGHT_SHARE = 0.15
_ACROSS_SHARE = 0.1
"""Shares of the segments that run in these directions; the others run in any direction."""
_SEGMENT_WEIGHT = 0.2
"""Each segment counts as this share of an independent observation: the errors of segments on one
house or lane are correlated."""
_PAN_STD_DEG = 2.0
"""Standard deviation of a forward camera's pan from the direction of the street."""
_PANS_DEG = np.arange(-5.0, 5.1, 1.0)
_TILT_STEPS = np.linspace(-3.0, 3.0, 25)
_ROLL_STEPS = np.linspace(-2.4, 2.4, 7)
"""Grid of angles: pans in degrees; tilts and rolls in standard deviations from those expected."""

Segments = Float[np.ndarray, "n 5"]
"""Straight edges, one a row: column and row of the middle, direction (x, y), length [px]."""


@dataclass(frozen=True, kw_only=True)
class Angles:
    """Tilt and roll of a camera against the road, with standard deviations.

    The tilt is positive where the camera looks up, the roll where the horizon falls to the right.
    """

    tilt_deg: float
    tilt_std_deg: float
    roll_deg: float
    roll_std_deg: float


def find_segments(grey: Float[np.ndarray, "h w"]) -> Segments:
    """Find straight edges: chains of edge pixels whose gradients have nearly one direction.

    Curved chains are left out. The longest segments come first. ``grey``: black is 0, white 1.
    """
    smooth = ndimage.gaussian_filter(grey.astype(np.float32), _SMOOTHING_PX)
    gradient_x = np.zeros_like(smooth)
    gradient_x[:, 1:-1] = (smooth[:, 2:] - smooth[:, :-2]) / 2
    gradient_y = np.zeros_like(smooth)
    gradient_y[1:-1] = (smooth[2:] - smooth[:-2]) / 2
    strength = np.hypot(gradient_x, gradient_y)

    # An edge is one pixel wide: the strongest along the axis that its gradient is nearer to, and of
    # two equal neighbours the second.
    is_along_x = np.abs(gradient_x) > np.abs(gradient_y)
    inner = strength[1:-1, 1:-1]
    is_peak_in_row = (inner >= strength[1:-1, :-2]) & (inner > strength[1:-1, 2:])
    is_peak_in_column = (inner >= strength[:-2, 1:-1]) & (inner > strength[2:, 1:-1])
    is_peak = np.where(is_along_x[1:-1, 1:-1], is_peak_in_row, is_peak_in_column)
    rows, columns = np.nonzero(is_peak & (inner > _MIN_CONTRAST))
    rows += 1
    columns += 1
    if not len(rows):
        return np.zeros((0, 5))

    direction_x = gradient_x[rows, columns] / strength[rows, columns]
    direction_y = gradient_y[rows, columns] / strength[rows, columns]
    chain_count, chains = _connect_edges(rows, columns, direction_x, direction_y, grey.shape)

    # Across the edge its place is refined to a fraction of a pixel.
    is_along_x = is_along_x[rows, columns]
    x = columns + np.where(is_along_x, _compute_peak_offset(strength, rows, columns, 0, 1), 0)
    y = rows + np.where(is_along_x, 0, _compute_peak_offset(strength, rows, columns, 1, 0))
    return _fit_segments(x, y, chains, chain_count)


def _connect_edges(
    rows: np.ndarray,
    columns: np.ndarray,
    direction_x: np.ndarray,
    direction_y: np.ndarray,
    shape: tuple[int, ...],
) -> tuple[int, np.ndarray]:
    """Connect neighbouring edge pixels of similar gradients to chains.

    Args:
        rows: rows of the edge pixels.
        columns: columns of the edge pixels.
        direction_x: x of the unit vectors of their gradients.
        direction_y: y of these unit vectors.
        shape: rows and columns of the image.

    Returns:
        The number of chains, and for each edge pixel the number of its chain, from 0.
    """
    count = len(rows)
    # The index of the edge pixel at each place, -1 where there is none; with a border of one pixel.
    index_at = np.full((shape[0] + 2, shape[1] + 2), -1)
    index_at[rows + 1, columns + 1] = np.arange(count)

    # Each pixel and its neighbours at the right and below, so that no pair comes twice.
    firsts: list[np.ndarray] = []
    seconds: list[np.ndarray] = []
    for step_y, step_x in ((0, 1), (1, -1), (1, 0), (1, 1)):
        neighbour = index_at[rows + 1 + step_y, columns + 1 + step_x]
        first = np.nonzero(neighbour >= 0)[0]
        second = neighbour[first]
        cos_angle = (
            direction_x[first] * direction_x[second] + direction_y[first] * direction_y[second]
        )
        is_similar = cos_angle > _MIN_COS_ANGLE
        firsts.append(first[is_similar])
        seconds.append(second[is_similar])
    pairs = (np.concatenate(firsts), np.concatenate(seconds))
    graph = coo_array((np.ones(len(pairs[0]), np.int8), pairs), shape=(count, count))
    return connected_components(graph, directed=False)


def _fit_segments(x: np.ndarray, y: np.ndarray, chains: np.ndarray, chain_count: int) -> Segments:
    """Fit a line segment to each chain by the moments of its points; curved chains are left out.

    ``x`` and ``y``: the points [px]; ``chains``: the number of each point's chain, below
    ``chain_count``. The longest segments come first.
    """
    size = np.bincount(chains, minlength=chain_count).astype(float)
    middle_x = np.bincount(chains, x, chain_count) / size
    middle_y = np.bincount(chains, y, chain_count) / size

    # The covariance of the points of each chain.
    from_middle_x = x - middle_x[chains]
    from_middle_y = y - middle_y[chains]
    xx = np.bincount(chains, from_middle_x * from_middle_x, chain_count) / size
    yy = np.bincount(chains, from_middle_y * from_middle_y, chain_count) / size
    xy = np.bincount(chains, from_middle_x * from_middle_y, chain_count) / size

    # The eigenvalues of the covariance are the variances along and across the segment. A uniform
    # distribution over a length has the variance length^2 / 12.
    angle = np.arctan2(2 * xy, xx - yy) / 2
    mean_variance = (xx + yy) / 2
    half_difference = np.hypot((xx - yy) / 2, xy)
    length = np.sqrt(12 * (mean_variance + half_difference))
    width = np.sqrt(12 * np.clip(mean_variance - half_difference, 0, None))

    max_width = np.maximum(_MAX_WIDTH_SHARE * length, _MIN_WIDTH_LIMIT_PX)
    is_straight = (length > _MIN_LENGTH_PX) & (width < max_width)
    columns = (middle_x, middle_y, np.cos(angle), np.sin(angle), length)
    segments = np.stack(columns, 1)[is_straight]
    longest_first = np.argsort(-segments[:, 4], kind="stable")
    return segments[longest_first]


def _compute_peak_offset(
    strength: np.ndarray, rows: np.ndarray, columns: np.ndarray, step_y: int, step_x: int
) -> np.ndarray:
    """Compute how far from a pixel's centre the gradient is strongest, -0.5 to 0.5 [px].

    That is the top of the parabola through the strengths of the pixel and of its neighbours a step
    before and after it, along one axis.
    """
    before = strength[rows - step_y, columns - step_x]
    after = strength[rows + step_y, columns + step_x]
    # a x^2 + b x + c has its top at -b / (2 a), with b = (after - before) / 2 and 2 a = curvature.
    curvature = before - 2 * strength[rows, columns] + after
    return np.clip((before - after) / 2 / np.minimum(curvature, -1e-9), -0.5, 0.5)


def find_angles(image: View, camera: Camera, expected: Angles) -> Angles:
    """Estimate a forward camera's tilt and roll from the edges in its image and a prior.

    Args:
        image: the image of the camera.
        camera: its intrinsics.
        expected: the prior: mean and standard deviation without the image.

    Returns:
        Mean and standard deviation of the posterior; those of the prior where there is no edge.
    """
    # Segments in a copy of the image, whose sides are halved until it has few enough pixels.
    pixel_count = image.shape[1] * image.shape[2]
    halvings = max(math.ceil(math.log2(pixel_count / _MAX_PIXELS) / 2), 0)
    scale = 2**halvings
    grey = grey_from_rgb(image.detach().cpu().float())
    if halvings:
        grey = torch.nn.functional.avg_pool2d(grey[None, None], scale)[0, 0]
    segments = find_segments(grey.numpy())[:_MAX_SEGMENTS]
    # To pixels of the image: a pixel of the copy lies at the middle of a square of them.
    segments[:, :2] = (segments[:, :2] + 0.5) * scale - 0.5
    segments[:, 4] *= scale

    # The grid of pan, tilt and roll over which the posterior is summed.
    tilt_axis = expected.tilt_deg + _TILT_STEPS * expected.tilt_std_deg
    roll_axis = expected.roll_deg + _ROLL_STEPS * expected.roll_std_deg
    grid = np.meshgrid(_PANS_DEG, tilt_axis, roll_axis, indexing="ij")
    pans, tilts, rolls = (angles.ravel() for angles in grid)

    # The posterior: how well edges run to their vanishing points, times the normal priors.
    log_likelihood = _compute_log_likelihood(
        segments, camera, pans, tilts, rolls, _END_STD_PX * scale
    )
    squared_deviation = (
        (pans / _PAN_STD_DEG) ** 2
        + ((tilts - expected.tilt_deg) / expected.tilt_std_deg) ** 2
        + ((rolls - expected.roll_deg) / expected.roll_std_deg) ** 2
    )
    log_posterior = _SEGMENT_WEIGHT * log_likelihood - squared_deviation / 2
    weight = np.exp(log_posterior - log_posterior.max())
    weight /= weight.sum()

    tilt_deg = float(weight @ tilts)
    roll_deg = float(weight @ rolls)
    return Angles(
        tilt_deg=tilt_deg,
        tilt_std_deg=math.sqrt(weight @ (tilts - tilt_deg) ** 2),
        roll_deg=roll_deg,
        roll_std_deg=math.sqrt(weight @ (rolls - roll_deg) ** 2),
    )


def _compute_log_likelihood(
    segments: Segments,
    camera: Camera,
    pans_deg: np.ndarray,
    tilts_deg: np.ndarray,
    rolls_deg: np.ndarray,
    end_std_px: float,
) -> Float[np.ndarray, " angles"]:
    """Compute the log likelihood of the directions of all segments, for each triple of angles.

    ``end_std_px``: standard deviation of the ends of a segment, in pixels of the image.
    """
    forward, down, right = _compute_street_directions(pans_deg, tilts_deg, rolls_deg)

    # Standard deviations of the segments' directions [rad]: of a line fit, and of what is built.
    x, y, along_x, along_y, length = segments.astype(np.float32).T
    direction_std = np.hypot(math.sqrt(12) * end_std_px / length, _DIRECTION_STD_RAD)

    # The density of the angle between a segment and the line to a vanishing point: a mixture of one
    # normal distribution for each of the three directions and a uniform one for all other segments,
    # relative to 1 / pi, the density of the uniform one.
    other_share = 1 - _FORWARD_SHARE - _UPRIGHT_SHARE - _ACROSS_SHARE
    density = np.full((len(pans_deg), len(segments)), other_share, np.float32)
    K = camera.K.numpy()
    directions = ((forward, _FORWARD_SHARE), (down, _UPRIGHT_SHARE), (right, _ACROSS_SHARE))
    for direction, share in directions:
        # Homogeneous, for a vanishing point may be at infinity.
        vanishing_point = (direction @ K.T).astype(np.float32)
        to_x = vanishing_point[:, :1] - x * vanishing_point[:, 2:]
        to_y = vanishing_point[:, 1:2] - y * vanishing_point[:, 2:]
        sine = (along_x * to_y - along_y * to_x) / (np.hypot(to_x, to_y) + 1e-6)
        peak = share * math.pi / (math.sqrt(2 * math.pi) * direction_std)
        density += peak * np.exp(-0.5 * (sine / direction_std) ** 2)
    return np.log(density).sum(1)


def _compute_street_directions(
    pans_deg: np.ndarray, tilts_deg: np.ndarray, rolls_deg: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute the directions of a street in the camera's frame (x right, y down, z forward).

    The signs of tilt and roll are those of :class:`Angles`; a positive pan turns ``forward``
    to the right.

    Returns:
        Unit vectors forward along the street, down, and right across the street, each (angles, 3).
    """
    pan = np.radians(pans_deg)
    tilt = np.radians(tilts_deg)
    roll = np.radians(rolls_deg)
    # The horizon is the line y = x tan(roll) + tan(tilt) in normalised coordinates (x, y, 1). Down
    # is the normal of the plane through it and the camera.
    down = np.stack([-np.tan(roll), np.ones_like(roll), -np.tan(tilt)], 1)
    down /= np.linalg.norm(down, axis=1, keepdims=True)
    # Forward is the part of the panned axis that is perpendicular to down.
    ahead = np.stack([np.sin(pan), np.zeros_like(pan), np.cos(pan)], 1)
    forward = ahead - (ahead * down).sum(1, keepdims=True) * down
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    return forward, down, np.cross(down, forward)
