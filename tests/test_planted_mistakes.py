"""The unit doctor: planted mistakes are named, and the right inputs are not."""

import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import torch
from PIL import Image
from tests.core.test_camera_rectified import pair
from tests.pose.synthetic_objects import K, bracket, cloud_of, pose_at, view_of

from depthpose.core.camera import (
    Camera,
    StereoRig,
    check_image_matches_camera,
    describe_suspicious_centre,
    read_camera,
)
from depthpose.core.errors import InputError
from depthpose.core.files import write_depth_png
from depthpose.core.files.images import check_image
from depthpose.core.units import Unit
from depthpose.depth.disparity import disparity_from_depth
from depthpose.depth.estimator import check_rectified_pair
from depthpose.depth.types import DepthInput
from depthpose.depth.unit_mistakes import find_unit_mistake
from depthpose.pose.cloud import prepare_cloud
from depthpose.pose.config import CloudConfig, EstimateConfig
from depthpose.pose.inputs import AnyInput, cloud_input, view_input
from depthpose.pose.mesh import read_model
from depthpose.pose.refusals import Refused
from depthpose.pose.types import CloudInput, ViewInput

CAMERA: dict[str, Any] = {
    "width": 640,
    "height": 480,
    "K": [[500, 0, 320], [0, 500, 240], [0, 0, 1]],
    "baseline_m": 0.12,
    "depth_unit_m": 0.001,
}
SIZE = (640, 480)
KITTI_K = [[721.5377, 0.0, 609.5593], [0.0, 721.5377, 172.854], [0.0, 0.0, 1.0]]
PART = bracket()
POSE = pose_at()


def said_by(work: Callable[[], object]) -> str:
    """What is answered: an error, a refusal or advice; nothing where all is well."""
    try:
        answer = work()
    except (InputError, Refused) as error:
        return str(error)
    return answer if isinstance(answer, str) else ""


def camera(folder: Path, text: str = "", **changes: object) -> Camera:
    path = folder / "camera"
    path.write_text(text or json.dumps({**CAMERA, **changes}))
    return read_camera(path, SIZE)


def doubts(K: list[list[float]], width: int, height: int) -> str | None:
    """What the doctor says of a camera that names its size."""
    matrix = torch.tensor(K, dtype=torch.float64)
    return describe_suspicious_centre(Camera(width=width, height=height, K=matrix))


@cache
def good_pair() -> tuple[torch.Tensor, torch.Tensor]:
    return pair()


def look(left: torch.Tensor, right: torch.Tensor) -> None:
    given = DepthInput(name="pair", left=left, right=right, camera=None)
    check_rectified_pair(given)


@cache
def seen_cloud() -> torch.Tensor:
    return cloud_of(PART, POSE)


@cache
def view() -> ViewInput:
    depth_m, mask = view_of(PART, POSE)
    wall_m = torch.where(mask, depth_m, 1.5)
    return ViewInput(name="view", depth_m=wall_m, mask=mask, K=K, object=PART.name)


def prepare(given: AnyInput) -> object:
    return prepare_cloud(given, PART, CloudConfig(), EstimateConfig())


def cloud(points: torch.Tensor, unit: Unit = "m") -> CloudInput:
    return cloud_input(points, unit, PART.name, "cloud")


def stored_depth(folder: Path, unit_m: float) -> Path:
    write_depth_png(folder / "depth.png", view().depth_m, unit_m)
    return folder / "depth.png"


def read_view(folder: Path, *, stored_m: float, read_m: float) -> ViewInput:
    height, width = view().mask.shape
    known = Camera(width=width, height=height, K=K, depth_unit_m=read_m)
    return view_input(stored_depth(folder, stored_m), view().mask, known, PART.name, "view")


def pictured_depth(folder: Path) -> object:
    Image.new("L", (320, 240), 7).save(folder / "depth.png")
    known = Camera(width=320, height=240, K=K, depth_unit_m=0.001)
    return view_input(folder / "depth.png", view().mask, known, PART.name, "view")


def stl(folder: Path, scale: float) -> Path:
    corners = (scale * PART.vertices_m)[PART.faces].tolist()
    vertex = "\n".join(
        "facet normal 0 0 0\nouter loop\n"
        + "".join(f"vertex {x} {y} {z}\n" for x, y, z in corner)
        + "endloop\nendfacet"
        for corner in corners
    )
    (folder / "part.stl").write_text(f"solid part\n{vertex}\nendsolid part\n")
    return folder / "part.stl"


RIG = StereoRig(width=64, height=48, K=torch.tensor(
    [[50.0, 0, 31.5], [0, 50, 23.5], [0, 0, 1]], dtype=torch.float64), baseline_m=0.5)  # fmt: skip


def truth_m() -> torch.Tensor:
    return torch.linspace(2, 10, 64).expand(48, 64)


def advice_for(depth_m: torch.Tensor) -> str | None:
    return find_unit_mistake(
        disparity_from_depth(depth_m, RIG), disparity_from_depth(truth_m(), RIG)
    )


def ros(Tx: float, distortion: float = 0.0) -> str:
    return (
        f"image_width: 640\nimage_height: 480\ndistortion_coefficients: {{data: [{distortion}]}}\n"
        f"projection_matrix: {{data: [500, 0, 320, {Tx}, 0, 500, 240, 0, 0, 0, 1, 0]}}\n"
    )


KITTI_P2 = "P2: 700 0 320 0 0 700 240 0 0 0 1 0\n"
Work = Callable[[Path], object]
MISTAKES: dict[str, tuple[Work, Work, str]] = {
    "baseline in millimetres": (
        lambda folder: camera(folder, baseline_m=120),
        camera,
        "baseline_m is 120, which looks like millimetres; divide by 1000",
    ),
    "baseline in centimetres": (
        lambda folder: camera(folder, ros(Tx=-6000.0)),
        lambda folder: camera(folder, ros(Tx=-60.0)),
        "baseline_m is 12, which looks like centimetres; divide by 100 (0.12). If it is in mill",
    ),
    "baseline divided once too often": (
        lambda folder: camera(folder, baseline_m=0.12 / 1000),
        camera,
        "baseline_m is 0.00012, less than two lenses can stand apart; write metres, once",
    ),
    "two calibrations": (
        lambda folder: camera(folder, KITTI_P2 + KITTI_P2.replace("P2: 700", "P3: 600")),
        lambda folder: camera(folder, KITTI_P2),
        "fx of the left camera is 700 and of the right one 600, but a rectified pair shares fx",
    ),
    "K scaled in one direction alone": (
        lambda folder: camera(folder, K=[[500, 0, 320], [0, 1000, 240], [0, 0, 1]]),
        camera,
        "K has fx 500 and fy 1000, as if pixels were 2 times wider than high",
    ),
    "baseline of the wrong sign": (
        lambda folder: camera(folder, ros(Tx=60.0)),
        lambda folder: camera(folder, ros(Tx=-60.0)),
        "baseline_m is -0.12, but the right camera stands at a positive x; are left and right",
    ),
    "K normalised": (
        lambda folder: camera(folder, K=[[0.8, 0, 0.5], [0, 1.04, 0.5], [0, 0, 1]]),
        camera,
        "K has fx 0.8 for 640x480 pixels, so it looks normalised; multiply its first row by",
    ),
    "focal length in millimetres": (
        lambda folder: camera(folder, K=[[4, 0, 320], [0, 4, 240], [0, 0, 1]]),
        camera,
        "K has fx 4 for 640x480 pixels, so it looks like millimetres; divide by the width of a p",
    ),
    "K of another resolution": (
        lambda folder: camera(folder, "1000 1000 500 370"),
        lambda folder: camera(folder, "500 500 325 235"),
        "K looks like that of about 994x746. Multiply fx, fy, cx and cy by 0.644, or take the im",
    ),
    "K of KITTI's full size with a half-size image": (
        lambda _: doubts(KITTI_K, 621, 188),
        lambda _: doubts(KITTI_K, 1242, 375),
        "K looks like that of about 1183x358. Multiply fx, fy, cx and cy by 0.525, or take the im",
    ),
    "principal point far off the centre": (
        lambda _: doubts([[500, 0, 560], [0, 500, 240], [0, 0, 1]], 640, 480),
        lambda _: doubts([[500, 0, 470], [0, 500, 240], [0, 0, 1]], 640, 480),
        "lies at 88% of the width and 50% of the height of 640x480, more than a quarter off",
    ),
    "picture of 0 to 255 as floats": (
        lambda _: check_image(255 * torch.rand(3, 9, 9), "street.png"),
        lambda _: said_by(lambda: check_image(torch.rand(3, 9, 9), "street.png")),
        "divide 8-bit values by 255",
    ),
    "camera of another size": (
        lambda folder: check_image_matches_camera(camera(folder), 1280, 960, "left.png"),
        lambda folder: check_image_matches_camera(camera(folder), 640, 480, "left.png"),
        "left.png is 1280x960 but its camera is 640x480; the aspect agrees: resize the image to",
    ),
    "lens distortion": (
        lambda folder: camera(folder, ros(0.0, distortion=-0.28)),
        lambda folder: camera(folder, ros(0.0)),
        "lens distortion (-0.28), and only images without are understood; undistort them by cv2.",
    ),
    "depth unit as units a metre": (
        lambda folder: camera(folder, depth_unit_m=5000),
        lambda folder: camera(folder, depth_unit_m=0.0002),
        "depth_unit_m is 5000, which looks like units a metre; it is metres a unit: write 0.0002",
    ),
    "left and right exchanged": (
        lambda _: look(*good_pair()[::-1]),
        lambda _: look(*good_pair()),
        "left and right look swapped (only 0% of disparities are positive); exchange the two imag",
    ),
    "not rectified": (
        lambda _: look(*pair(down_px=3)),
        lambda _: look(*good_pair()),
        "rows do not agree: the right image lies +3.0 px lower",
    ),
    "right image mirrored": (
        lambda _: look(good_pair()[0], good_pair()[1].flip(2)),
        lambda _: look(*good_pair()),
        "the right image is mirrored beside the left one; turn it back",
    ),
    "one camera upside down": (
        lambda _: look(good_pair()[0], good_pair()[1].flip(1, 2)),
        lambda _: look(*good_pair()),
        "the right image is upside down beside the left one; turn it back",
    ),
    "one picture twice": (
        lambda _: look(good_pair()[0], good_pair()[0]),
        lambda _: look(*good_pair()),
        "left and right are the same picture; give the view of each camera",
    ),
    "cloud in millimetres": (
        lambda _: prepare(cloud(1000 * seen_cloud())),
        lambda _: prepare(cloud(1000 * seen_cloud(), "mm")),
        "times larger than the model: is it in mm?",
    ),
    "model in millimetres": (
        lambda folder: read_model(stl(folder, 1000.0), "m"),
        lambda folder: read_model(stl(folder, 1000.0), "mm"),
        "m long, and no sensor sees it whole; is it in mm? Then say unit mm",
    ),
    "model in metres": (
        lambda folder: read_model(stl(folder, 1.0), "mm"),
        lambda folder: read_model(stl(folder, 1.0), "m"),
        "below what a sensor resolves; is it in metres? Then say unit m",
    ),
    "z backward, y up": (
        lambda _: prepare(cloud(seen_cloud() * torch.tensor([1.0, -1, -1]))),
        lambda _: prepare(cloud(seen_cloud())),
        "100% of the points lie behind the camera (z <= 0): is its z backward",
    ),
    "x forward, as a robot's": (
        lambda _: prepare(cloud(seen_cloud()[:, [2, 0, 1]] * torch.tensor([1.0, -1, -1]))),
        lambda _: prepare(cloud(seen_cloud())),
        "the points lie along x, more than 60 degrees off z: does x point forward",
    ),
    "cloud centred": (
        lambda _: prepare(cloud(seen_cloud() - seen_cloud().mean(0) + torch.tensor([0, 0, 0.01]))),
        lambda _: prepare(cloud(seen_cloud())),
        "the cloud lies about the origin, where the camera is: it was centred, or is in",
    ),
    "depth of TUM read as millimetres": (
        lambda folder: prepare(read_view(folder, stored_m=0.0002, read_m=0.001)),
        lambda folder: prepare(read_view(folder, stored_m=0.0002, read_m=0.0002)),
        "and so does another depth unit: 0.001 m of most sensors, 0.0002 m of TUM RGB-D",
    ),
    "a picture of depth": (
        pictured_depth,
        lambda folder: read_view(folder, stored_m=0.001, read_m=0.001),
        "depth or disparity needs a 16-bit greyscale PNG; an 8-bit or colour file is a picture of",
    ),
    "mask of another size": (
        lambda _: view_input(view().depth_m, view().mask[:100], K, PART.name, "view"),
        lambda _: view_input(view().depth_m, view().mask, K, PART.name, "view"),
        "the mask is of shape (100, 320), but the depth image of (240, 320); give the mask of th",
    ),
    "mask inverted": (
        lambda _: prepare(replace(view(), mask=~view().mask)),
        lambda _: prepare(view()),
        "of the image and its border: is it inverted?",
    ),
    "mask of another image": (
        lambda _: prepare(replace(view(), mask=view().mask.roll((60, 110), (0, 1)))),
        lambda _: prepare(view()),
        "or give the mask of this image: this one may lie on the background",
    ),
    "prediction in millimetres": (
        lambda _: advice_for(1000 * truth_m()),
        lambda _: advice_for(1.3 * truth_m()),
        "as far as the truth: is its depth in millimetres (divide by 1000)",
    ),
    "prediction times 256": (
        lambda _: advice_for(256 * truth_m()),
        lambda _: advice_for(0.6 * truth_m()),
        "is its depth metres x 256, as KITTI's PNG holds it (divide by 256)?",
    ),
    "disparity of the other sign": (
        lambda _: find_unit_mistake(-torch.full((4, 5), 9.0), torch.full((4, 5), 9.0)),
        lambda _: find_unit_mistake(torch.full((4, 5), 9.0), torch.full((4, 5), 9.0)),
        "100% of the disparities are negative: left and right were exchanged",
    ),
}


@pytest.mark.filterwarnings("ignore:a camera_info of ROS. it is the right one alone")
@pytest.mark.parametrize("name", MISTAKES)
def test_a_planted_mistake_is_named_and_the_right_input_is_not(tmp_path: Path, name: str) -> None:
    wrong, right, text = MISTAKES[name]
    assert text in said_by(lambda: wrong(tmp_path))
    assert said_by(lambda: right(tmp_path)) == ""
