"""What the tests of the page upload: a synthetic street and part, small ones of the demo's."""

from pathlib import Path

import torch
from tests.pose.synthetic_objects import write_part
from torch.nn.functional import pad

from depthpose.core.camera import Camera, write_camera
from depthpose.core.files import PointCloud, write_cloud, write_depth_png, write_image
from depthpose.core.rigid import Rigid
from depthpose.depth.config import StreetsConfig
from depthpose.depth.synthetic import Streets
from depthpose.pose.cloud import cloud_from_depth
from depthpose.pose.config import ObjectsConfig
from depthpose.pose.datasets.dataset import write_mask
from depthpose.pose.synthetic import SyntheticViews, make_part

PART = "flange"


def write_street(folder: Path, scale: float = 0.25) -> Path:
    """Write ``left.png``, ``right.png`` and ``camera.json``."""
    pair = Streets(StreetsConfig(seed=9, scale=scale))[1].input
    assert pair.right is not None
    assert pair.camera is not None
    write_image(folder / "left.png", pair.left)
    write_image(folder / "right.png", pair.right)
    write_camera(folder / "camera.json", pair.camera)
    return folder


def write_view(folder: Path) -> Rigid:
    """Write ``depth.png``, ``mask.png``, ``view.json``, ``cloud.ply`` and STLs; give the pose."""
    config = ObjectsConfig(seed=4, number=1, occluded_share=0.0, views=None, resolution=(1.0, 1.0))
    sample = SyntheticViews((make_part(PART),), config).view(0)
    window = sample.input
    # The window of the object leaves the principal point out: a margin takes it in.
    margin = 8
    K = window.K.double()
    K[:2, 2] += margin
    depth_m = pad(window.depth_m, [margin] * 4, value=torch.nan)
    mask = pad(window.mask, [margin] * 4)
    height, width = mask.shape
    camera = Camera(width=width, height=height, K=K, depth_unit_m=0.0001)
    write_camera(folder / "view.json", camera)
    write_depth_png(folder / "depth.png", depth_m, 0.0001)
    write_mask(folder / "mask.png", mask)
    points_m = cloud_from_depth(depth_m, mask, K).float()
    write_cloud(folder / "cloud.ply", PointCloud(points=1000 * points_m))
    write_part(PART, folder)
    write_part("mug", folder)
    return sample.truth.camera_from_model
