"""Rendered pairs with exact truth, and synthetic streets as a dataset.

A scene is prepared (``shading``), each camera finds what it sees and its light (``visibility``),
and a sensor makes the picture (``sensor``).
"""

from dataclasses import dataclass

import torch

from depthpose.core.camera import StereoRig, resize_camera
from depthpose.core.errors import InputError
from depthpose.depth.config import StreetsConfig
from depthpose.depth.disparity import disparity_from_depth
from depthpose.depth.synthetic.clutter import make_clutter
from depthpose.depth.synthetic.kitti_rigs import draw_rig_number, kitti_rig
from depthpose.depth.synthetic.lidar import CAMERA_FROM_VELODYNE, scan
from depthpose.depth.synthetic.materials import MATERIAL_IDS
from depthpose.depth.synthetic.projector import Projector, project_dots
from depthpose.depth.synthetic.randomness import Stream, make_rng
from depthpose.depth.synthetic.scene import SyntheticScene
from depthpose.depth.synthetic.sensor import draw_sensors, expose
from depthpose.depth.synthetic.shading import prepare_stage
from depthpose.depth.synthetic.street import make_street
from depthpose.depth.synthetic.visibility import (
    Visibility,
    find_nearest,
    find_neighbours,
    render_light,
    view_from,
)
from depthpose.depth.types import DepthInput, DepthSample, DepthTruth, Map, Mask, RawFrame


@dataclass(frozen=True, kw_only=True, eq=False)
class SyntheticFrame(RawFrame):
    """A synthetic pair with its exact truth."""

    right_disparity_px: Map  #: disparity of the right image; NaN in the sky
    depth_m: Map  #: camera z in the left image; NaN in the sky
    is_road: Mask  #: left pixels that show the carriageway


def render_street(config: StreetsConfig, index: int) -> SyntheticFrame:
    """Render frame ``index``: a function of the configuration and the index alone.

    A share of the frames is clutter. The size is that of KITTI's images times ``config.scale``.

    Raises:
        InputError: the index is negative.
    """
    if index < 0:
        raise InputError(f"index is {index}, but frames are counted from 0; take another")
    seed = (config.seed, index)
    is_clutter = make_rng(Stream.IS_CLUTTER, *seed).random() < config.clutter_share
    scene = make_clutter(seed) if is_clutter else make_street(seed)
    rig = kitti_rig(draw_rig_number(config, index))
    width = max(1, round(rig.width * config.scale))
    height = max(1, round(rig.height * config.scale))
    return render_scene(scene, resize_camera(rig, width, height), config, seed)


def render_scene(
    scene: SyntheticScene,
    rig: StereoRig,
    config: StreetsConfig,
    seed: tuple[int, ...] = (0,),
    projector: Projector | None = None,
) -> SyntheticFrame:
    """Render a scene with a rig: both views with their truth.

    Args:
        scene: the scene.
        rig: the cameras, whose size the views have, whatever the scale of ``config``.
        config: settings of the sensors.
        seed: seed of the noise and misalignment of the cameras, and of the LiDAR.
        projector: adds dots; None: none.
    """
    rng = make_rng(Stream.CAMERAS, *seed)
    stage = prepare_stage(scene, rig.width * rig.height)
    size = (rig.height, rig.width)
    left = view_from(stage, rig.K, size, torch.zeros(3))

    # The right camera, whose rows are off by a fraction of a pixel as real ones are.
    K = rig.K.clone()
    K[0, 2] += rig.cx_right_minus_left_px
    K[1, 2] += rng.normal(0, 1) * config.rectification_error_px
    right = view_from(stage, K, size, torch.tensor([rig.baseline_m, 0.0, 0.0]))

    left_light = render_light(stage, left)
    right_light = render_light(stage, right)
    if projector is not None:
        left_light = project_dots(left_light, left, projector)
        right_light = project_dots(right_light, right, projector)
    left_sensor, right_sensor = draw_sensors(rng, left_light, config.jpeg_share)
    points = scan(stage, rng) if config.with_lidar else None
    primitive = left.raster.primitive
    depth_m = left.raster.depth_m
    material = stage.material[primitive.clamp(min=0)]
    return SyntheticFrame(
        left=expose(left_light, left_sensor),
        right=expose(right_light, right_sensor),
        disparity_px=disparity_from_depth(depth_m, rig),
        right_disparity_px=disparity_from_depth(right.raster.depth_m, rig),
        depth_m=depth_m,
        occluded=_find_occluded(left, right, rig),
        is_sky=primitive < 0,
        is_road=(primitive >= 0) & (material == MATERIAL_IDS["road"]),
        lidar_points=points,
        camera_from_velodyne=CAMERA_FROM_VELODYNE,
        rig=rig,
    )


_OCCLUSION_SHARE = 1e-4
"""A surface occludes a point if it is nearer by this share of the depth; less is rounding."""


def _find_occluded(left: Visibility, right: Visibility, rig: StereoRig) -> Mask:
    """Find left pixels whose point is occluded in the right image, or lies outside of it."""
    height, width = left.raster.primitive.shape
    primitive = left.raster.primitive.flatten()
    depth_m = left.raster.depth_m.flatten()
    is_occluded = torch.zeros(height * width, dtype=torch.bool)
    index = (primitive >= 0).nonzero()[:, 0]

    # Where each point lies in the right image, and the triangles that are visible there.
    pixels = torch.stack([index % width, index // width], 1).double()
    pixels[:, 0] -= disparity_from_depth(depth_m[None, index], rig)[0].double()
    pixels[:, 1] += right.K[1, 2] - left.K[1, 2]
    column, row = pixels.round().long().unbind(1)
    is_outside = (column < 0) | (column >= width)
    right_index = row.clamp(0, height - 1) * width + column.clamp(0, width - 1)
    candidates = find_neighbours(right.raster.primitive, right_index)

    # Most points have the same triangle there; the others are compared with the right depth.
    is_same = (candidates[:, :1] == primitive[index, None])[:, 0] & ~is_outside
    undecided = (~is_same & ~is_outside).nonzero()[:, 0]
    (nearest,) = find_nearest(right, candidates[undecided], [pixels[undecided]])
    occluder_limit_m = depth_m[index[undecided]] * (1 - _OCCLUSION_SHARE)
    is_occluded[index[undecided]] = nearest.depth_m < occluder_limit_m
    is_occluded[index[is_outside]] = True
    return is_occluded.reshape(height, width)


@dataclass(frozen=True)
class Streets:
    """A dataset of synthetic pairs, each rendered on demand from the seed and its index alone."""

    config: StreetsConfig  #: settings of the frames

    def __len__(self) -> int:
        """Return the number of frames."""
        return self.config.frames

    def __getitem__(self, index: int) -> DepthSample:
        """Render one sample; its truth is exact, and NaN in the sky.

        Raises:
            IndexError: there are fewer frames.
        """
        if not 0 <= index < len(self):
            raise IndexError(f"frame {index} of {len(self)}")
        frame = render_street(self.config, index)
        name = f"street_{self.config.seed}_{index:06d}"
        return DepthSample(
            input=DepthInput(name=name, left=frame.left, right=frame.right, camera=frame.rig),
            truth=DepthTruth(
                disparity_px=frame.disparity_px,
                depth_m=frame.depth_m,
                occluded=frame.occluded,
                right_disparity_px=frame.right_disparity_px,
                is_sky=frame.is_sky,
            ),
        )
