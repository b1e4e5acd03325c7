"""Synthetic street scenes as a dataset: both views, disparity, occlusion and a LiDAR scan."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from depthpose.core.camera import StereoRig
from depthpose.core.errors import InputError
from depthpose.depth.config import StreetsConfig
from depthpose.depth.disparity import disparity_from_depth
from depthpose.depth.synthetic.clutter import make_clutter
from depthpose.depth.synthetic.materials import NUMBER
from depthpose.depth.synthetic.scene import StreetScene, make_scene, street_rig
from depthpose.depth.synthetic.sensor import draw_sensors, expose, scan
from depthpose.depth.synthetic.stage import Stage, prepare
from depthpose.depth.synthetic.view import Sight, draw_light, look, nearest_at, neighbours
from depthpose.depth.types import StereoInput, StereoSample, StereoTruth

_OCCLUSION_SHARE = 1e-4
"""What is nearer by this share of the depth hides a point; less is the point itself, rounded."""


@dataclass(frozen=True, kw_only=True, eq=False)
class StreetFrame:
    """A synthetic pair and everything that is known about it.

    Attributes:
        left: left image.
        right: right image.
        disparity_px: of the left image, exact; NaN in the sky.
        right_disparity_px: of the right image.
        depth_m: of the left image, camera z; NaN in the sky.
        occluded: left pixels whose point the right camera does not see: hidden, or outside.
        is_sky: left pixels that see the sky.
        is_road: left pixels that see the carriageway.
        lidar_points: x forward, y left, z up [m], reflectance; None where not asked for.
        rig: the cameras.
    """

    left: Float[Tensor, "3 h w"]
    right: Float[Tensor, "3 h w"]
    disparity_px: Float[Tensor, "h w"]
    right_disparity_px: Float[Tensor, "h w"]
    depth_m: Float[Tensor, "h w"]
    occluded: Bool[Tensor, "h w"]
    is_sky: Bool[Tensor, "h w"]
    is_road: Bool[Tensor, "h w"]
    lidar_points: Float[Tensor, "n 4"] | None
    rig: StereoRig


def draw_street(config: StreetsConfig, index: int) -> StreetFrame:
    """Make frame ``index``: a function of the configuration and the index alone.

    Args:
        config: what frames are like.
        index: any whole number that is not negative.

    Raises:
        InputError: the index is negative.
    """
    if index < 0:
        raise InputError(f"index is {index}, but frames are counted from 0; take another")
    rig, mount_height_m = street_rig(config, index)
    scene = _make_scene(config, index, mount_height_m)
    return draw_scene(scene, rig, config, (config.seed, index))


def _make_scene(config: StreetsConfig, index: int, mount_height_m: float) -> StreetScene:
    seed = (config.seed, index)
    if np.random.default_rng([75, *seed]).random() < config.clutter_share:
        return make_clutter(seed)
    return make_scene(seed, mount_height_m)


def draw_scene(
    scene: StreetScene, rig: StereoRig, config: StreetsConfig, seed: tuple[int, ...] = (0,)
) -> StreetFrame:
    """Draw a scene with a rig.

    Args:
        scene: one that :func:`make_scene` made.
        rig: the cameras; the size of the pictures is theirs. Scale and crop of ``config`` are not
            applied.
        config: how to draw.
        seed: of the sensors' noise, their small misalignment and the LiDAR's.
    """
    rng = np.random.default_rng([73, *seed])
    stage = prepare(scene, rig.width * rig.height)
    left = look(stage, rig.K, (rig.height, rig.width), torch.zeros(3))
    right = _look_right(stage, rig, rng.normal(0, 1) * config.rectification_error_px)
    light, other_light = (
        draw_light(stage, sight, with_antialiasing=config.with_antialiasing)
        for sight in (left, right)
    )
    sensors = draw_sensors(rng, light, config.jpeg_share)
    points = scan(stage, rng) if config.with_lidar else None
    primitive, depth_m = left.raster.primitive, left.raster.depth_m
    disparity_px = disparity_from_depth(depth_m, rig)
    return StreetFrame(
        left=expose(light, sensors[0]),
        right=expose(other_light, sensors[1]),
        disparity_px=disparity_px,
        right_disparity_px=disparity_from_depth(right.raster.depth_m, rig),
        depth_m=depth_m,
        occluded=_occluded(left, right, rig),
        is_sky=primitive < 0,
        is_road=(primitive >= 0) & (stage.material[primitive.clamp(min=0)] == NUMBER["road"]),
        lidar_points=points,
        rig=rig,
    )


def _look_right(stage: Stage, rig: StereoRig, rows_px: float) -> Sight:
    """See with the right camera, whose rows are off by a fraction of a pixel as real ones are."""
    K = rig.K.clone()
    K[0, 2] += rig.cx_right_minus_left_px
    K[1, 2] += rows_px
    eye = torch.tensor([rig.baseline_m, 0.0, 0.0])
    return look(stage, K, (rig.height, rig.width), eye)


def _occluded(left: Sight, right: Sight, rig: StereoRig) -> Bool[Tensor, "h w"]:
    """Ask for each left point what the right camera sees where it should be."""
    height, width = left.raster.primitive.shape
    primitive, depth_m = left.raster.primitive.flatten(), left.raster.depth_m.flatten()
    occluded = torch.zeros(height * width, dtype=torch.bool)
    index = (primitive >= 0).nonzero()[:, 0]
    pixels = torch.stack([index % width, index // width], 1).double()
    disparity_px = disparity_from_depth(depth_m[None, index], rig)[0].double()
    pixels[:, 0] -= disparity_px
    pixels[:, 1] += right.K[1, 2] - left.K[1, 2]
    near = pixels.round().long()
    is_outside = (near[:, 0] < 0) | (near[:, 0] >= width)
    near = near[:, 1].clamp(0, height - 1) * width + near[:, 0].clamp(0, width - 1)
    candidates = neighbours(right.raster.primitive, near)
    # Most see the same triangle there, and nothing else need be asked.
    is_same = (candidates[:, :1] == primitive[index, None])[:, 0] & ~is_outside
    asked = (~is_same & ~is_outside).nonzero()[:, 0]
    _, _, seen_m = nearest_at(right, candidates[asked], [pixels[asked]])[0]
    occluded[index[asked]] = seen_m < depth_m[index[asked]] * (1 - _OCCLUSION_SHARE)
    occluded[index[is_outside]] = True
    return occluded.reshape(height, width)


@dataclass(frozen=True)
class Streets:
    """Synthetic pairs, each a function of the seed and its index alone.

    Attributes:
        config: what the frames are like.
    """

    config: StreetsConfig

    def __len__(self) -> int:
        """How many there are."""
        return self.config.frames

    def __getitem__(self, index: int) -> StereoSample:
        """Make one sample; its truth is exact, and NaN in the sky.

        Raises:
            IndexError: there is no such frame.
        """
        if not 0 <= index < len(self):
            raise IndexError(f"frame {index} of {len(self)}")
        frame = draw_street(self.config, index)
        name = f"street_{self.config.seed}_{index:06d}"
        return StereoSample(
            input=StereoInput(name=name, left=frame.left, right=frame.right, camera=frame.rig),
            truth=StereoTruth(
                disparity_px=frame.disparity_px,
                depth_m=frame.depth_m,
                occluded=frame.occluded,
                right_disparity_px=frame.right_disparity_px,
                is_sky=frame.is_sky,
            ),
        )
