"""Real instances of known pose: LineMOD, scans of the bunny, YCB, a basket, a bottle.

Two of LineMOD, five scans of the bunny, ten in YCB's two frames, the basket, and two frames of the
bottle; all but the scans as depth images with masks. From ``$DEPTHPOSE_DATA/pose``; the data have a
non-commercial licence and are never committed.
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from depthpose.core.files import read_cloud, read_depth_png
from depthpose.core.render import rasterize
from depthpose.core.rigid import Rigid
from depthpose.pose.datasets import open_bop
from depthpose.pose.mesh import read_model, with_found_symmetries
from depthpose.pose.types import (
    CloudInput,
    CloudSample,
    ObjectModel,
    PoseTruth,
    ViewInput,
    ViewSample,
)
from depthpose.report.pose import object_points

_MASK_TOLERANCE_M = 0.03  # by which the depth may differ from the annotated pose, inside a mask
_SCANNER_M = 0.7
"""The bunny's scanner looks along -z, our camera along +z, from about this distance."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RealCase:
    """A real instance with its true pose and its model.

    Attributes:
        sample: the cloud or the view, and the true pose.
        model: of the object.
        is_symmetric: whether it is measured by ADD-S. All of YCB are: geometry alone does not show
            the sides of boxes, nor how a can is rotated.
        frame: the image that shows it; images of tables show several instances.
        color: the colour image registered to the depth, where there is one.
    """

    sample: CloudSample | ViewSample
    model: ObjectModel
    is_symmetric: bool
    frame: str
    color: Path | None = None

    @property
    def name(self) -> str:
        """Data set, object and frame."""
        return self.sample.input.name

    @property
    def points_m(self) -> torch.Tensor:
        """The points of the object."""
        return object_points(self.sample.input, self.model.diameter_m)


def lm_cases(folder: Path) -> Iterator[RealCase]:
    """One Kinect frame of LineMOD: cat, annotated, and ape, of a fitted pose."""
    data = open_bop(folder / "lm")
    for instance in data.instances:
        model = data.objects[instance.object_id]
        name = f"lm {model.name}"
        is_symmetric = not model.symmetries.is_none
        yield _case(name, data.view(instance), model, is_symmetric, frame="lm")


def bunny_cases(folder: Path, every: int = 5) -> Iterator[RealCase]:
    """Range scans of the bunny, each ``every``-th point of some 40,000."""
    model = read_model(folder / "bunny/model/bun_zipper_res2.ply", "m", name="bunny")
    flip = Rigid(torch.diag(torch.tensor([1.0, -1.0, -1.0])), torch.tensor([0, 0, _SCANNER_M]))
    for line in (folder / "bunny/bun.conf").read_text().splitlines():
        words = line.split()
        scan = folder / "bunny/scans" / words[1] if words[:1] == ["bmesh"] else None
        if scan is None or not scan.is_file():
            continue
        t_m = np.array(words[2:5], float)
        quaternion = np.array(words[5:9], float)
        R = Rotation.from_quat(quaternion).as_matrix()
        pose = Rigid(torch.from_numpy(R).float(), torch.from_numpy(-R @ t_m).float())
        points_m = flip.apply(read_cloud(scan).points[::every].float())
        truth = PoseTruth(camera_from_model=flip @ pose)
        cloud = CloudInput(name=scan.stem, points_m=points_m, object="bunny")
        sample = CloudSample(input=cloud, truth=truth)
        yield _case(f"bunny {scan.stem}", sample, model, is_symmetric=False)


def ycb_cases(folder: Path) -> Iterator[RealCase]:
    """Ten instances in two frames of a RealSense; poses fitted, models of bare points."""
    data = open_bop(folder / "ycb_frames")
    for instance in data.instances:
        model = data.objects[instance.object_id]
        name = f"ycb {instance.image_id} {model.name}"
        frame = f"ycb {instance.image_id}"
        case = _case(name, data.view(instance), model, is_symmetric=True, frame=frame)
        yield replace(case, color=instance.rgb)


def basket_cases(folder: Path) -> Iterator[RealCase]:
    """A basket on a table; its mask is the annotated pose, drawn, where the depth is near it."""
    home = folder / "real_frames/basket"
    model = read_model(home / "obj_000019.ply", "mm", name="basket")
    model = with_found_symmetries(model, None, is_taken=True)
    truth = json.loads((home / "truth.json").read_text())
    R = torch.tensor(truth["cam_R_m2c"]).reshape(3, 3).double()
    pose = Rigid(R, torch.tensor(truth["cam_t_m2c_mm"]).double() / 1000)
    K = torch.tensor(json.loads((home / "camera.json").read_text())["K"]).double()
    depth_m = read_depth_png(home / "depth.png", 0.001)
    yield _case("basket", _view_with_mask(depth_m, K, model, pose), model, is_symmetric=True)


def bottle_cases(folder: Path) -> Iterator[RealCase]:
    """Two frames of a RealSense; the pose is the authors' start, 6 to 7 mm off."""
    home = folder / "real_frames/bottle"
    model = read_model(home / "bottle.obj", "m", name="bottle")
    model = with_found_symmetries(model, None, is_taken=True)
    annotation = json.loads((home / "poses.json").read_text())
    color_from_model = torch.tensor(annotation["model_to_color_camera_authors_test_pose"]).double()
    color_from_depth = torch.tensor(annotation["depth_camera_to_color_camera"]).double()
    matrix = torch.linalg.inv(color_from_depth) @ color_from_model
    pose = Rigid(matrix[:3, :3], matrix[:3, 3])
    fx, fy, cx, cy = annotation["depth_K"]
    K = torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64)
    for frame in annotation["frames"]:
        depth_m = read_depth_png(home / f"depth_{frame}.png", annotation["depth_scale_m"])
        view = _view_with_mask(depth_m, K, model, pose)
        yield _case(f"bottle {frame}", view, model, is_symmetric=True)


def _view_with_mask(
    depth_m: torch.Tensor, K: torch.Tensor, model: ObjectModel, pose: Rigid
) -> ViewSample:
    """Make the view of an instance whose mask is its rendered pose, where the depth agrees."""
    corners = pose.apply(model.vertices_m.double())[model.faces]
    height, width = depth_m.shape
    raster = rasterize(corners, K, width, height, with_barycentric=False)
    mask = (depth_m.double() - raster.depth_m).abs() < _MASK_TOLERANCE_M
    view = ViewInput(name="", depth_m=depth_m, mask=mask, K=K, object=model.name)
    return ViewSample(input=view, truth=PoseTruth(camera_from_model=pose))


def real_cases(folder: Path) -> list[RealCase]:
    """Load all instances of all data sets."""
    loaders = (lm_cases, bunny_cases, ycb_cases, basket_cases, bottle_cases)
    return [case for load in loaders for case in load(folder)]


def _case(
    name: str,
    sample: CloudSample | ViewSample,
    model: ObjectModel,
    is_symmetric: bool,
    frame: str | None = None,
) -> RealCase:
    """Make an instance and name its sample; without a ``frame`` it is alone in its image."""
    return RealCase(
        sample=replace(sample, input=replace(sample.input, name=name)),
        model=model,
        is_symmetric=is_symmetric,
        frame=frame or name,
    )
