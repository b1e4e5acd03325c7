"""Wrong arguments in Python are explained; types are not checked here, as at a user's."""

import contextlib
import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from depthpose.cli import main
from depthpose.core.files import PointCloud, write_cloud, write_image

MISTAKES = {
    "unit of a cloud": (
        "pose.estimate(cloud=points, object='flange', unit='millimeters')",
        "unit is 'millimeters'; Known: 'cm', 'm', 'mm'.",
    ),
    "unit of depth": (
        "pose.estimate(depth=depth_m, mask=mask, camera=camera, object='flange', unit='inch')",
        "unit is 'inch'; Known: 'cm', 'm', 'mm'.",
    ),
    "a list of CAD files": (
        "Registration.load(['part.stl'], unit='mm')",
        "a list is no model: give files, or meshes of trimesh or Open3D, one by one",
    ),
    "a depth image in another format": (
        "pose.estimate(depth='depth.exr', mask=mask, camera=camera, object='flange')",
        "depth.exr: .exr is no depth image format; use .png, .tif, .tiff, .npy, .pfm",
    ),
    "unit of a mesh": (
        "read_model('part.stl', 'metres')",
        "unit is 'metres'; Known: 'cm', 'm', 'mm'.",
    ),
    "K as an array": (
        "Camera(width=64, height=48, K=np.array(K))",
        "K is a ndarray, not a tensor; pass torch.tensor(K, dtype=torch.float64)",
    ),
    "K as a list": (
        "Camera(width=64, height=48, K=K)",
        "K is a list, not a tensor; pass torch.tensor(K, dtype=torch.float64)",
    ),
    "K in float32": (
        "Camera(width=64, height=48, K=torch.tensor(K))",
        "K is of torch.float32, not torch.float64; pass K.double()",
    ),
    "a word as a camera": (
        "depth.estimate(torch.rand(3, 48, 64), object())",
        "camera is a object; give a Camera(width=, height=, K=)",
    ),
    "letters as a camera": (
        "depth.estimate(torch.rand(3, 48, 64), [['a', 'b', 'c']] * 3)",
        "camera is a list; give a Camera(width=, height=, K=)",
    ),
    "a key of a camera": (
        "pose.estimate(depth=depth_m, mask=mask, camera={'focal': 50}, object='flange')",
        "unknown key 'focal'; ",
    ),
    "a function as a matcher": (
        "FakestereoNet(lambda left, right: left.mean(0))",
        "matcher is a function, which has no method 'match'; make a matcher of a function by "
        "CallableMatcher(function)",
    ),
    "camera and focal length": (
        "depth.estimate(torch.rand(3, 48, 64), camera, focal_px=50)",
        "camera and focal_px are both given; omit one of the two",
    ),
    "a mapping as a cloud": (
        "pose.estimate(cloud={'points': points}, object='flange')",
        "a dict where numbers belong; give a tensor or array of numbers, or a file's path",
    ),
    "complex numbers as depth": (
        "pose.estimate(depth=depth_m * 1j, mask=mask, camera=camera, object='flange')",
        "complex numbers where real numbers belong; give a tensor or array of numbers",
    ),
    "a number as an object": (
        "pose.estimate(cloud=points, object=2)",
        "object 2 is no text; give the name of one: 'bracket', 'flange'",
    ),
    "a folder as frames": (
        "pose.track('seq/depth', camera, object='flange')",
        "frames is 'seq/depth', one path; give a list of files or arrays in their order",
    ),
    "a float image of 0 to 255": (
        "depth.estimate(np.full((48, 64, 3), 127.0), camera)",
        "must lie in [0, 1], got 127 .. 127; divide 8-bit values by 255",
    ),
    "a batch": (
        "depth.estimate(torch.rand(2, 3, 48, 64), camera)",
        "(2, 3, 48, 64), a batch; give one image, or the batch to estimate_many(batch, camera)",
    ),
    "many files": (
        "pose.estimate_many(['a.ply'])",
        "estimate_many takes CloudInput and ViewInput of depthpose.pose.types, not a str; files",
    ),
    "one input": (
        "pose.estimate_many(CloudInput(name='a', points_m=points, object='flange'))",
        "estimate_many takes several inputs; give one as [input]",
    ),
    "no thread": ("depth.estimate_many([], K, threads=0)", "threads is 0; take 1 or more, 2 where"),
    "voting": ("VotingConfig(method='ransack')", "method is 'ransack'; did you mean 'ransac'?"),
    "inliers": ("VotingConfig(inlier_test='x')", "inlier_test is 'x'; Known: 'angle', 'distance'"),
    "diameters": ("EvaluationConfig(diameters='BOP')", "diameters is 'BOP'; Known: 'bop'"),
    "symmetries": ("EvaluationConfig(adds='some')", "adds is 'some'; Known: 'all', 'declared'"),
}
GPU_MISTAKES = {
    "pose device": ("GeoPoseNet.load('parts', config=EstimateConfig(device='cuda'))", "'cuda'"),
    "view device": ("make_synthesiser(UNetGenerator(GeneratorConfig()), 'cuda')", "'cuda'"),
}
PROGRAM = """
import json, sys
import numpy as np
import torch
from PIL import Image
from depthpose import FakestereoNet, GeoPoseNet, Registration
from depthpose.core.camera import Camera
from depthpose.core.errors import InputError
from depthpose.depth.config import GeneratorConfig
from depthpose.depth.generators import UNetGenerator
from depthpose.depth.synthesis import make_synthesiser
from depthpose.pose.config import EstimateConfig, EvaluationConfig, VotingConfig
from depthpose.pose.mesh import read_model
from depthpose.pose.types import CloudInput

pose, depth = GeoPoseNet.load("parts"), FakestereoNet.load("default", allow_ood=True)
K = [[50.0, 0.0, 31.5], [0.0, 50.0, 23.5], [0.0, 0.0, 1.0]]
camera = Camera(width=64, height=48, K=torch.tensor(K, dtype=torch.float64))
points, depth_m, mask = torch.rand(99, 3), torch.ones(48, 64), torch.ones(48, 64) > 0
said = {}
for name, code in json.loads(sys.argv[1]).items():
    try:
        eval(code)
        said[name] = "nothing"
    except InputError as error:
        said[name] = str(error)
    except Exception as error:
        said[name] = repr(error)
print(json.dumps(said))
"""


TAKEN = {
    "a dict": "pose.estimate(depth=depth_m, mask=mask, camera={'K': K}, object='flange')",
    "a list": "pose.estimate(depth=depth_m, mask=mask, camera=K, object='flange')",
    "K of float32": "depth.estimate(np.zeros((48, 64), np.uint8), torch.tensor(K))",
    "a focal length": "pose.estimate(depth=depth_m, mask=mask, focal_px=50, object='flange')",
    "one of Pillow's": "depth.estimate(Image.new('RGBA', (64, 48)), K)",
    "one name to find": "pose.find(depth_m, K, objects='flange')",
    "Pillow's mask": "pose.estimate(depth=depth_m, mask=Image.new('L', (64, 48), 255), "
    "camera=K, object='flange')",
}
"""What gave an AttributeError, or an error about types, and is plain to read."""


def test_every_mistake_is_named_with_its_remedy_and_what_people_have_in_hand_is_taken() -> None:
    wanted = MISTAKES if torch.cuda.is_available() else MISTAKES | GPU_MISTAKES
    codes = json.dumps(TAKEN | {name: code for name, (code, _) in wanted.items()})
    command = [sys.executable, "-c", PROGRAM, codes]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    assert {name: said[name] for name in TAKEN} == dict.fromkeys(TAKEN, "nothing"), done.stderr
    for name, (_, message) in wanted.items():
        if name in GPU_MISTAKES:
            assert f"device {message} cannot be used here" in said[name], name
        else:
            assert message in said[name], f"{name}: {said[name]}"


@pytest.mark.parametrize(
    "words",
    [
        ["depth", "predict", "x.png", "--focal-px", "50"],
        ["depth", "predict", "x.png", "--focal-px", "50", "--precision", "bf16"],
        ["pose", "predict", "--cloud", "x.ply", "--object", "flange"],
    ],
    ids=" ".join,
)
def test_a_device_that_is_not_there_ends_in_a_line(
    words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_image(tmp_path / "x.png", torch.rand(3, 48, 64))
    write_cloud(tmp_path / "x.ply", PointCloud(points=torch.rand(9, 3)))
    with contextlib.chdir(tmp_path):
        assert main([*words, "--device", "toaster", "--out", "out"]) == 2
    assert "device 'toaster' cannot be used here" in capsys.readouterr().err
