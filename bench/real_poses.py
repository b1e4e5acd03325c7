"""Real instances of known pose, for other scripts: LineMOD, the bunny, YCB, a basket, a bottle.

Two instances of LineMOD, five scans of the bunny, ten instances in two frames of YCB, the basket,
and two frames of the bottle; all but the scans are depth images with masks. They are read from
``$DEPTHPOSE_DATA/pose``. The data have a non-commercial licence and are never committed.
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from depthpose.core.camera.pinhole import intrinsics
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
from depthpose.report.pose import select_object_points

MASK_TOLERANCE_M = 0.03
"""Inside a mask, the depth differs less than this from the rendered annotated pose."""
SCANNER_DISTANCE_M = 0.7
"""Of the bunny, about; the scanner looks along -z, our camera along +z."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RealCase:
    """A real instance with its true pose and its model.

    Attributes:
        sample: the cloud or the view, and the true pose.
        model: of the object.
        is_symmetric: whether its error is ADD-S. That of all YCB objects is: depth shows neither
            which side of a box it sees nor how a can is rotated.
        frame: name of the image; images of tables show several instances.
        color: the colour image registered to the depth, where there is one.
    """

    sample: CloudSample | ViewSample
    model: ObjectModel
    is_symmetric: bool
    frame: str
    color: Path | None = None

    @property
    def name(self) -> str:
        """Dataset, object and frame."""
        return self.sample.input.name

    @property
    def points_m(self) -> torch.Tensor:
        """The points of the object."""
        return select_object_points(self.sample.input, self.model.diameter_m)


def lm_cases(folder: Path) -> Iterator[RealCase]:
    """Load one Kinect frame of LineMOD: the cat by its annotation, the ape by a fitted pose."""
    data = open_bop(folder / "lm")
    for instance in data.instances:
        model = data.objects[instance.object_id]
        name = f"lm {model.name}"
        is_symmetric = not model.symmetries.is_none
        yield make_case(name, data.view(instance), model, is_symmetric, frame="lm")


def bunny_cases(folder: Path, every: int = 5) -> Iterator[RealCase]:
    """Load the range scans of the bunny, every fifth point of some 40,000."""
    home = folder / "bunny"
    model = read_model(home / "model/bun_zipper_res2.ply", "m", name="bunny")
    camera_from_scanner = Rigid(
        torch.diag(torch.tensor([1.0, -1.0, -1.0])), torch.tensor([0, 0, SCANNER_DISTANCE_M])
    )
    for line in (home / "bun.conf").read_text().splitlines():
        words = line.split()
        if words[:1] != ["bmesh"]:
            continue
        scan = home / "scans" / words[1]
        if not scan.is_file():
            continue
        t_m = np.array(words[2:5], float)
        quaternion = np.array(words[5:9], float)
        R = Rotation.from_quat(quaternion).as_matrix()
        scanner_from_model = Rigid(torch.from_numpy(R).float(), torch.from_numpy(-R @ t_m).float())
        points_m = camera_from_scanner.apply(read_cloud(scan).points[::every].float())
        cloud = CloudInput(name=scan.stem, points_m=points_m, object="bunny")
        truth = PoseTruth(camera_from_model=camera_from_scanner @ scanner_from_model)
        sample = CloudSample(input=cloud, truth=truth)
        yield make_case(f"bunny {scan.stem}", sample, model, is_symmetric=False)


def ycb_cases(folder: Path) -> Iterator[RealCase]:
    """Load ten instances in two frames of a RealSense; poses are fitted, models have no faces."""
    data = open_bop(folder / "ycb_frames")
    for instance in data.instances:
        model = data.objects[instance.object_id]
        name = f"ycb {instance.image_id} {model.name}"
        frame = f"ycb {instance.image_id}"
        case = make_case(name, data.view(instance), model, is_symmetric=True, frame=frame)
        yield replace(case, color=instance.rgb)


def basket_cases(folder: Path) -> Iterator[RealCase]:
    """Load a basket on a table, of annotated pose."""
    home = folder / "real_frames/basket"
    model = read_model(home / "obj_000019.ply", "mm", name="basket")
    model = with_found_symmetries(model)
    truth = json.loads((home / "truth.json").read_text())
    R = torch.tensor(truth["cam_R_m2c"]).reshape(3, 3).double()
    t_m = torch.tensor(truth["cam_t_m2c_mm"]).double() / 1000
    K = torch.tensor(json.loads((home / "camera.json").read_text())["K"]).double()
    depth_m = read_depth_png(home / "depth.png", 0.001)
    view = view_of_pose(depth_m, K, model, Rigid(R, t_m))
    yield make_case("basket", view, model, is_symmetric=True)


def bottle_cases(folder: Path) -> Iterator[RealCase]:
    """Load a bottle in two frames of a RealSense; the authors' pose is 6 to 7 mm off."""
    home = folder / "real_frames/bottle"
    model = read_model(home / "bottle.obj", "m", name="bottle")
    model = with_found_symmetries(model)
    annotation = json.loads((home / "poses.json").read_text())
    color_from_model = torch.tensor(annotation["model_to_color_camera_authors_test_pose"]).double()
    color_from_depth = torch.tensor(annotation["depth_camera_to_color_camera"]).double()
    depth_from_model = torch.linalg.inv(color_from_depth) @ color_from_model
    pose = Rigid(depth_from_model[:3, :3], depth_from_model[:3, 3])
    K = intrinsics(*annotation["depth_K"])
    for frame in annotation["frames"]:
        depth_m = read_depth_png(home / f"depth_{frame}.png", annotation["depth_scale_m"])
        view = view_of_pose(depth_m, K, model, pose)
        yield make_case(f"bottle {frame}", view, model, is_symmetric=True)


def view_of_pose(
    depth_m: torch.Tensor, K: torch.Tensor, model: ObjectModel, pose: Rigid
) -> ViewSample:
    """Make a view of an instance; its mask is where depth agrees with the rendered pose."""
    corners = pose.apply(model.vertices_m.double())[model.faces]
    height, width = depth_m.shape
    raster = rasterize(corners, K, width, height, with_barycentric=False)
    difference_m = (depth_m.double() - raster.depth_m).abs()
    mask = difference_m < MASK_TOLERANCE_M
    view = ViewInput(name="", depth_m=depth_m, mask=mask, K=K, object=model.name)
    return ViewSample(input=view, truth=PoseTruth(camera_from_model=pose))


def real_cases(folder: Path) -> list[RealCase]:
    """Load all instances of all datasets."""
    loaders = (lm_cases, bunny_cases, ycb_cases, basket_cases, bottle_cases)
    return [case for load in loaders for case in load(folder)]


def make_case(
    name: str,
    sample: CloudSample | ViewSample,
    model: ObjectModel,
    is_symmetric: bool,
    frame: str | None = None,
) -> RealCase:
    """Name a sample and join it with its model; without a ``frame`` it is alone in its image."""
    return RealCase(
        sample=replace(sample, input=replace(sample.input, name=name)),
        model=model,
        is_symmetric=is_symmetric,
        frame=frame or name,
    )
