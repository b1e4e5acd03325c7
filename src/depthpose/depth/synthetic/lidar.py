"""A LiDAR of 64 beams on the car, as KITTI's."""

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from depthpose.depth.synthetic.materials import MATERIAL_IDS
from depthpose.depth.synthetic.shading import TINT, Stage
from depthpose.depth.synthetic.textures import Indices, Numbers
from depthpose.depth.synthetic.visibility import find_nearest, find_neighbours, view_from

_BEAMS_RAD = np.deg2rad(np.concatenate([np.linspace(2, -8.33, 32), np.linspace(-8.87, -24.33, 32)]))
_AZIMUTHS_RAD = np.deg2rad(np.arange(-44.5, 44.5, 0.1728))
"""Elevations of the LiDAR's beams, and the azimuths in the cameras' field of view."""

_ORIGIN_M = (0.056, -0.076, -0.272)
"""Position of the LiDAR in the left camera's frame: a little above and behind."""

_AXES = [[0, -1, 0], [0, 0, -1], [1, 0, 0]]
CAMERA_FROM_VELODYNE = np.vstack([np.column_stack([_AXES, _ORIGIN_M]), [0, 0, 0, 1.0]])
"""From the LiDAR (x forward, y left, z up) to the left camera."""

_ROWS_PX = 440
_COLUMNS_PX = 1200
_HORIZON_ROW_PX = 40
_FOCAL_PX = 600.0
"""Size, row of the horizon and focal length of the image by which triangles near the beams are
found."""
_MAX_RANGE_M = 115.0
_RANGE_STD_M = 0.015
"""Standard deviation of the LiDAR's ranges."""


def scan(stage: Stage, rng: np.random.Generator) -> Float[Tensor, "n 4"]:
    """Scan a scene by the LiDAR: a row for each return, x forward, y left, z up [m], reflectance.

    But for noise the returns are exact: an image from the LiDAR's position shows which triangles
    are near each beam, and the beam is intersected with these.
    """
    # Unit vectors along the beams, in the axes of the camera: x right, y down, z ahead.
    grid = np.meshgrid(_BEAMS_RAD, _AZIMUTHS_RAD, indexing="ij")
    elevation, azimuth = (torch.from_numpy(angles.ravel()) for angles in grid)
    x = elevation.cos() * azimuth.sin()
    y = -elevation.sin()
    z = elevation.cos() * azimuth.cos()
    beams = torch.stack([x, y, z], 1)

    primitive, range_m = _intersect(stage, beams)
    tint = stage.attributes[primitive.clamp(min=0), TINT].mean(1)
    lost_share = _estimate_lost_share(stage, primitive, range_m, tint)
    chance = torch.from_numpy(rng.random(len(primitive)))
    is_returned = (primitive >= 0) & (range_m < _MAX_RANGE_M) & (chance > lost_share)

    returned = is_returned.nonzero()[:, 0]
    noise_m = torch.from_numpy(rng.normal(0, _RANGE_STD_M, len(returned)))
    measured_m = range_m[returned].double() + noise_m
    x, y, z = (beams[returned] * measured_m[:, None]).unbind(1)
    reflectance = tint[returned].clamp(0.02, 0.99).double()
    return torch.stack([z, -x, -y, reflectance], 1).float()


def _intersect(stage: Stage, beams: Float64[Tensor, "n 3"]) -> tuple[Indices, Numbers]:
    """Find the triangle that each beam hits (-1: none), and its range [m].

    ``beams``: unit vectors in the axes of the camera.
    """
    K = torch.tensor(
        [[_FOCAL_PX, 0, _COLUMNS_PX / 2], [0, _FOCAL_PX, _HORIZON_ROW_PX], [0, 0, 1]],
        dtype=torch.float64,
    )
    visibility = view_from(stage, K, (_ROWS_PX, _COLUMNS_PX), torch.tensor(_ORIGIN_M))
    pixels = (beams @ K.T)[:, :2] / beams[:, 2:]
    column = pixels[:, 0].round().long().clamp(0, _COLUMNS_PX - 1)
    row = pixels[:, 1].round().long().clamp(0, _ROWS_PX - 1)
    candidates = find_neighbours(visibility.raster.primitive, row * _COLUMNS_PX + column)
    (nearest,) = find_nearest(visibility, candidates, [pixels])
    return nearest.primitive, nearest.depth_m / beams[:, 2]


def _estimate_lost_share(
    stage: Stage, primitive: Indices, range_m: Numbers, tint: Numbers
) -> Numbers:
    """Estimate the share of beams that do not return: many of glass, and of far dark surfaces.

    ``tint``: mean of the channels of each surface.
    """
    # Of all some, more with distance; of glass two thirds; of black up to 0.3, from 40 m on.
    material = stage.material[primitive.clamp(min=0)]
    is_glass = (material == MATERIAL_IDS["glass"]) | (material == MATERIAL_IDS["pane"])
    darkness = (0.12 - tint).clamp(min=0) * 2.5
    return 0.03 + 0.0025 * range_m + 0.65 * is_glass + darkness * (range_m / 40).clamp(max=1)
