"""Tilt and roll of a street's camera by the straight edges in its image, without any scale.

Along a street most long edges run forward (lanes, kerbs, eaves), upright or across, so that they
meet in three vanishing points. Of a camera's angles that predict these points, those fit best whose
points most edges aim at (after Coughlan and Yuille 1999). Everything else, such as trees and
shadows, is an edge of any direction.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from depthpose.core.camera import Camera
from depthpose.core.camera.rectified import grey_of
from depthpose.depth.types import View

_MOST_PIXELS = 500_000
"""Larger images are halved until they have fewer: edges in a street are long."""
_LEAST_CONTRAST = 0.012
"""Of an edge: change of grey a pixel, of a white that is 1."""
_MIN_COS_TURN = math.cos(math.radians(20))
"""Cosine of the angle by which gradients of two neighbours on one segment differ at most."""
_LEAST_LENGTH_PX = 20.0
_MOST_WIDTH = 0.03
"""Of a segment, as a share of its length, or 1.5 pixels: wider ones are curves."""
_SEGMENTS = 60
"""The longest are looked at; all of KITTI's 300 were worse: short ones are leaves and shadows."""
_OFF_PX = 0.5
_OFF_RAD = math.radians(0.6)
"""Deviation of the ends of a segment, and of the directions of what is built straight."""
_FORWARD = 0.25
_UPRIGHT = 0.15
_ACROSS = 0.1
"""Shares of the segments that run in these directions; the rest has any."""
_PER_SEGMENT = 0.2
"""How much of an observation a segment is: those of one house or lane err together."""
_PAN_STD_DEG = 2.0
"""Of a forward camera against the street."""
_PANS = np.arange(-5.0, 5.1, 1.0)
_TILTS = np.linspace(-3.0, 3.0, 25)
_ROLLS = np.linspace(-2.4, 2.4, 7)
"""Where the angles are looked for: degrees of pan, and deviations around those expected."""

Segments = Float[np.ndarray, "n 5"]  # column, row of the middle; direction (x, y); length [px]


@dataclass(frozen=True, kw_only=True)
class Angles:
    """Tilt and roll of a camera against the road, signs as in :class:`~..types.Ground`."""

    tilt_deg: float
    tilt_std_deg: float
    roll_deg: float
    roll_std_deg: float


def find_segments(grey: Float[np.ndarray, "h w"]) -> Segments:
    """Find straight edges, the longest first: chains of edge pixels whose gradients agree.

    A line is fitted to each chain by its moments; curved ones are left out.
    """
    smooth = ndimage.gaussian_filter(grey.astype(np.float32), 1.0)
    across = np.zeros_like(smooth)
    across[:, 1:-1] = (smooth[:, 2:] - smooth[:, :-2]) / 2
    down = np.zeros_like(smooth)
    down[1:-1] = (smooth[2:] - smooth[:-2]) / 2
    strength = np.hypot(across, down)

    # An edge is one pixel wide, the strongest along the axis that its gradient is nearer to.
    is_steep = np.abs(across) > np.abs(down)
    inner = strength[1:-1, 1:-1]
    is_column_peak = (inner >= strength[1:-1, :-2]) & (inner > strength[1:-1, 2:])
    is_row_peak = (inner >= strength[:-2, 1:-1]) & (inner > strength[2:, 1:-1])
    is_peak = np.where(is_steep[1:-1, 1:-1], is_column_peak, is_row_peak)
    rows, columns = np.nonzero(is_peak & (inner > _LEAST_CONTRAST))
    rows += 1
    columns += 1
    count = len(rows)
    if not count:
        return np.zeros((0, 5))

    # Neighbours of like gradients are connected.
    number = np.full((grey.shape[0] + 2, grey.shape[1] + 2), -1)
    number[rows + 1, columns + 1] = np.arange(count)
    power = strength[rows, columns]
    slope_x = across[rows, columns] / power
    slope_y = down[rows, columns] / power
    firsts: list[np.ndarray] = []
    seconds: list[np.ndarray] = []
    for step_y, step_x in ((0, 1), (1, -1), (1, 0), (1, 1)):
        other = number[rows + 1 + step_y, columns + 1 + step_x]
        first = np.nonzero(other >= 0)[0]
        second = other[first]
        cos_turn = slope_x[first] * slope_x[second] + slope_y[first] * slope_y[second]
        firsts.append(first[cos_turn > _MIN_COS_TURN])
        seconds.append(second[cos_turn > _MIN_COS_TURN])
    joined = (np.concatenate(firsts), np.concatenate(seconds))
    links = coo_array((np.ones(len(joined[0]), np.int8), joined), shape=(count, count))
    chains, chain = connected_components(links, directed=False)

    # The top of a parabola through three strengths is the edge's place between pixels.
    x = columns + np.where(is_steep[rows, columns], _top(strength, rows, columns, 0, 1), 0)
    y = rows + np.where(is_steep[rows, columns], 0, _top(strength, rows, columns, 1, 0))
    return _fit_segments(x, y, chain, chains)


def _fit_segments(x: np.ndarray, y: np.ndarray, chain: np.ndarray, chains: int) -> Segments:
    """Fit a line to the points of each chain by their moments; give straight ones, longest first.

    ``chain``: the number of each point's chain; ``chains``: how many there are.
    """
    size = np.bincount(chain, minlength=chains).astype(float)
    middle_x = np.bincount(chain, x, chains) / size
    middle_y = np.bincount(chain, y, chains) / size
    from_x = x - middle_x[chain]
    from_y = y - middle_y[chain]
    xx = np.bincount(chain, from_x * from_x, chains) / size
    yy = np.bincount(chain, from_y * from_y, chains) / size
    xy = np.bincount(chain, from_x * from_y, chains) / size
    angle = np.arctan2(2 * xy, xx - yy) / 2
    spread = np.hypot((xx - yy) / 2, xy)
    # Of a uniform distribution over a length the variance is a twelfth of its square.
    length = np.sqrt(12 * ((xx + yy) / 2 + spread))
    width = np.sqrt(12 * np.clip((xx + yy) / 2 - spread, 0, None))
    is_straight = (length > _LEAST_LENGTH_PX) & (width < np.maximum(_MOST_WIDTH * length, 1.5))
    segments = np.stack([middle_x, middle_y, np.cos(angle), np.sin(angle), length], 1)[is_straight]
    return segments[np.argsort(-segments[:, 4], kind="stable")]


def _top(
    strength: np.ndarray, rows: np.ndarray, columns: np.ndarray, step_y: int, step_x: int
) -> np.ndarray:
    """Give the offset of the maximum of a parabola through three strengths, -0.5 to 0.5."""
    before = strength[rows - step_y, columns - step_x]
    after = strength[rows + step_y, columns + step_x]
    bend = before - 2 * strength[rows, columns] + after
    return np.clip((before - after) / 2 / np.minimum(bend, -1e-9), -0.5, 0.5)


def find_angles(image: View, camera: Camera, expected: Angles) -> Angles:
    """Improve what is expected of a forward camera's tilt and roll by the edges in its image.

    Args:
        image: the image of the camera.
        camera: its intrinsics.
        expected: mean and deviation before the image is looked at.

    Returns:
        Mean and deviation of the angles by both. Where there is no edge, those expected.
    """
    # Edges of a smaller copy, in pixels of the image.
    halvings = max(math.ceil(math.log2(image.shape[1] * image.shape[2] / _MOST_PIXELS) / 2), 0)
    scale = 2**halvings
    grey = grey_of(image.detach().cpu().float())
    if halvings:
        grey = torch.nn.functional.avg_pool2d(grey[None, None], scale)[0, 0]
    segments = find_segments(grey.numpy())[:_SEGMENTS]
    # The middle of a square of pixels is at its own place in the larger image.
    segments[:, :2] = (segments[:, :2] + 0.5) * scale - 0.5
    segments[:, 4] *= scale

    # The posterior on a grid of angles: how well edges point to their vanishing points, times the
    # normal distributions of what is expected.
    pans, tilts, rolls = (
        part.ravel()
        for part in np.meshgrid(
            _PANS,
            expected.tilt_deg + _TILTS * expected.tilt_std_deg,
            expected.roll_deg + _ROLLS * expected.roll_std_deg,
            indexing="ij",
        )
    )
    log_likelihood = _log_likelihood(segments, camera, pans, tilts, rolls, _OFF_PX * scale)
    squared_deviation = (
        (pans / _PAN_STD_DEG) ** 2
        + ((tilts - expected.tilt_deg) / expected.tilt_std_deg) ** 2
        + ((rolls - expected.roll_deg) / expected.roll_std_deg) ** 2
    )
    log_posterior = _PER_SEGMENT * log_likelihood - squared_deviation / 2
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


def _log_likelihood(
    segments: Segments,
    camera: Camera,
    pans_deg: np.ndarray,
    tilts_deg: np.ndarray,
    rolls_deg: np.ndarray,
    off_px: float,
) -> Float[np.ndarray, " angles"]:
    """Give the log likelihood of the directions of all segments, for each choice of angles."""
    pan, tilt, roll = (np.radians(angle) for angle in (pans_deg, tilts_deg, rolls_deg))
    down = np.stack([-np.tan(roll), np.ones_like(roll), -np.tan(tilt)], 1)
    down /= np.linalg.norm(down, axis=1, keepdims=True)
    level = np.stack([np.sin(pan), np.zeros_like(pan), np.cos(pan)], 1)
    forward = level - (level * down).sum(1, keepdims=True) * down
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(down, forward)

    x, y, along_x, along_y, length = segments.astype(np.float32).T
    deviation = np.hypot(math.sqrt(12) * off_px / length, _OFF_RAD)
    density = np.full((len(pan), len(segments)), 1 - _FORWARD - _UPRIGHT - _ACROSS, np.float32)
    K = camera.K.numpy()
    for direction, share in ((forward, _FORWARD), (down, _UPRIGHT), (right, _ACROSS)):
        point = (direction @ K.T).astype(np.float32)  # homogeneous, so it may be at infinity
        to_x = point[:, :1] - x * point[:, 2:]
        to_y = point[:, 1:2] - y * point[:, 2:]
        off = (along_x * to_y - along_y * to_x) / (np.hypot(to_x, to_y) + 1e-6)
        # Relative to the density of segments of any direction, 1 / pi.
        peak = share * math.pi / (math.sqrt(2 * math.pi) * deviation)
        density += peak * np.exp(-0.5 * (off / deviation) ** 2)
    return np.log(density).sum(1)
