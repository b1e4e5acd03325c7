"""Wrong arguments in Python are explained; types are not checked here, as at a user's."""

import contextlib
import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from depthpose.cli import main
from depthpose.core.files import write_image

MISTAKES = {
    "unit of a cloud": (
        "pose.estimate(cloud=points, object='flange', unit='millimeters')",
        "unit is 'millimeters'; Known: 'm', 'mm'.",
    ),
    "unit of depth": (
        "pose.estimate(depth=depth_m, mask=mask, camera=camera, object='flange', unit='cm')",
        "unit is 'cm'; did you mean 'm'? Known: 'm', 'mm'.",
    ),
    "unit of a mesh": (
        "read_model('part.stl', 'metres')",
        "unit is 'metres'; Known: 'm', 'mm'.",
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
    "K as a camera": (
        "depth.estimate(torch.rand(3, 48, 64), np.array(K))",
        "camera is a ndarray; give a Camera(width=, height=, K=)",
    ),
    "a mapping as a camera": (
        "pose.estimate(depth=depth_m, mask=mask, camera={'K': K}, object='flange')",
        "a dict where numbers belong; give a tensor or array of numbers, or a file's path",
    ),
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
from depthpose import FakestereoNet, GeoPoseNet
from depthpose.core.camera import Camera
from depthpose.core.errors import InputError
from depthpose.depth.config import GeneratorConfig
from depthpose.depth.synthesis import UNetGenerator, make_synthesiser
from depthpose.pose.config import EstimateConfig, EvaluationConfig, VotingConfig
from depthpose.pose.mesh import read_model

pose, depth = GeoPoseNet.load("parts"), FakestereoNet.load("default")
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


def test_every_mistake_is_named_with_its_remedy() -> None:
    wanted = MISTAKES if torch.cuda.is_available() else MISTAKES | GPU_MISTAKES
    codes = json.dumps({name: code for name, (code, _) in wanted.items()})
    command = [sys.executable, "-c", PROGRAM, codes]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    for name, (_, message) in wanted.items():
        if name in GPU_MISTAKES:
            assert f"device {message} cannot be used here" in said[name], name
        else:
            assert message in said[name], f"{name}: {said[name]}"


@pytest.mark.parametrize(
    "words",
    [
        ["depth", "predict", "x.png", "--focal-px", "50"],
        ["pose", "predict", "--cloud", "x.ply", "--object", "flange"],
    ],
    ids=" ".join,
)
def test_a_device_that_is_not_there_ends_in_a_line(
    words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_image(tmp_path / "x.png", torch.rand(3, 48, 64))
    with contextlib.chdir(tmp_path):
        assert main([*words, "--device", "toaster", "--out", "out"]) == 2
    assert "device 'toaster' cannot be used here" in capsys.readouterr().err
