"""A LiDAR of 64 beams on the roof, as KITTI's: exact ranges, then noise and dropouts."""

import numpy as np
import torch
from jaxtyping import Float, Float64, Int
from torch import Tensor

from depthpose.core.camera import StereoRig
from depthpose.depth.streets.materials import NUMBER
from depthpose.depth.streets.sight import look, nearest_at, neighbours
from depthpose.depth.streets.stage import Stage

_BEAMS_RAD = np.deg2rad(np.concatenate([np.linspace(2, -8.33, 32), np.linspace(-8.87, -24.33, 32)]))
_TURN_RAD = np.deg2rad(np.arange(-44.5, 44.5, 0.1728))
"""Elevations of the beams, and the turns that lie in the cameras' sight."""

_ORIGIN_M = (0.056, -0.076, -0.272)
"""Where it stands in the left camera's frame: a little above and behind."""

_SIZE_PX = (440, 1200)
_FOCAL_PX = 600.0
_MAX_RANGE_M = 115.0
_NOISE_M = 0.015


def camera_from_velodyne() -> Float64[np.ndarray, "4 4"]:
    """Give the transform from the LiDAR (x forward, y left, z up) to the left camera."""
    transform = np.eye(4)
    transform[:3, :3] = [[0, -1, 0], [0, 0, -1], [1, 0, 0]]
    transform[:3, 3] = _ORIGIN_M
    return transform


def scan(stage: Stage, rng: np.random.Generator) -> Float[Tensor, "n 4"]:
    """Scan a stage: x forward, y left, z up [m] and reflectance, a row a return.

    The beams are met exactly: a wide picture from the LiDAR's place tells which triangles are near
    each beam, and these are intersected.
    """
    tilt, turn = (
        torch.from_numpy(a.ravel()) for a in np.meshgrid(_BEAMS_RAD, _TURN_RAD, indexing="ij")
    )
    towards = torch.stack([tilt.cos() * turn.sin(), -tilt.sin(), tilt.cos() * turn.cos()], 1)
    height, width = _SIZE_PX
    K = torch.tensor(
        [[_FOCAL_PX, 0, width / 2], [0, _FOCAL_PX, 40], [0, 0, 1]], dtype=torch.float64
    )
    sight = look(stage, K, _SIZE_PX, torch.tensor(_ORIGIN_M))
    pixels = (towards @ K.T)[:, :2] / towards[:, 2:]
    column = pixels[:, 0].round().long().clamp(0, width - 1)
    row = pixels[:, 1].round().long().clamp(0, height - 1)
    candidates = neighbours(sight.raster.primitive, row * width + column)
    primitive, _, depth_m = nearest_at(sight, candidates, [pixels])[0]
    range_m = depth_m / towards[:, 2]
    returned = _returned(stage, rng, primitive, range_m)
    noise = torch.from_numpy(rng.normal(0, _NOISE_M, len(returned)))
    far = range_m[returned].double() + noise
    x, y, z = (towards[returned] * far[:, None]).unbind(1)
    light = stage.attributes[primitive[returned], 15:18].mean(1).clamp(0.02, 0.99)
    return torch.stack([z, -x, -y, light.double()], 1).float()


def _returned(
    stage: Stage, rng: np.random.Generator, primitive: Tensor, range_m: Tensor
) -> Int[Tensor, " m"]:
    """Which beams come back: few from glass, fewer from afar and from what is dark."""
    chance = torch.from_numpy(rng.random(len(primitive)))
    seen = primitive.clamp(min=0)
    material = stage.material[seen]
    is_glass = (material == NUMBER["glass"]) | (material == NUMBER["pane"])
    dark = (0.12 - stage.attributes[seen, 15:18].mean(1)).clamp(min=0) * 2.5
    lost = 0.03 + 0.0025 * range_m + 0.65 * is_glass + dark * (range_m / 40).clamp(max=1)
    kept = (primitive >= 0) & (range_m < _MAX_RANGE_M) & (chance > lost)
    return kept.nonzero()[:, 0]


def sparse_depth(points: Float[Tensor, "n 4"], rig: StereoRig) -> Float[Tensor, "h w"]:
    """Draw a scan into the left image: camera z at the nearest pixel [m], the nearest return wins.

    NaN where no return falls. Nothing is moved by a pixel, as KITTI's own protocol does.
    """
    homogeneous = torch.cat([points[:, :3], torch.ones(len(points), 1)], 1).double()
    in_camera = (homogeneous @ torch.from_numpy(camera_from_velodyne()).T)[:, :3]
    in_camera = in_camera[in_camera[:, 2] > 0.1]
    pixels = in_camera @ rig.K.T
    column, row = (pixels[:, :2] / pixels[:, 2:]).round().long().unbind(1)
    inside = (column >= 0) & (column < rig.width) & (row >= 0) & (row < rig.height)
    depth_m = torch.full((rig.height * rig.width,), torch.inf)
    place = (row * rig.width + column)[inside]
    depth_m.scatter_reduce_(0, place, in_camera[inside, 2].float(), "amin")
    return torch.where(depth_m.isinf(), torch.nan, depth_m).reshape(rig.height, rig.width)
