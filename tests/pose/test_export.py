import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from tests.pose.synthetic_objects import bottle, bracket, tiny_weights
from torch import Tensor

from depthpose.cli import main
from depthpose.core.errors import InputError
from depthpose.pose.export import build_direction_graph, pose_export
from depthpose.pose.networks.baselines import PointNet, PointNetConfig
from depthpose.pose.networks.resunet import ResUNet, ResUNetConfig
from depthpose.pose.networks.sparse import Voxels
from depthpose.pose.weights import write_pose_weights

onnxruntime = pytest.importorskip("onnxruntime")


def clouds(*counts: int, spread: int = 6, at: int = 0) -> Tensor:
    """Distinct voxels in a cube about ``at``, in no order; a cloud a count."""
    torch.manual_seed(3)
    cells = [
        (torch.rand(count, 3) * 2 * spread - spread).floor().long().unique(dim=0) + at
        for count in counts
    ]
    mixed = [one[torch.randperm(len(one))] for one in cells]
    return torch.cat([F.pad(one, (1, 0), value=k) for k, one in enumerate(mixed)])


@pytest.fixture(scope="module", params=["batch", "none"])
def network(request: pytest.FixtureRequest) -> ResUNet:
    torch.manual_seed(0)
    small = (4, 5, 6, 7)
    kernel = {"batch": 3, "none": 7}[request.param]
    config = ResUNetConfig(
        classes=2, keypoints=3, inputs=3, encoder=small, decoder=small, norm=request.param,
        with_bias=request.param == "none", first_kernel=kernel,
    )  # fmt: skip
    made = ResUNet(config)
    for name, tensor in made.named_buffers():
        if name.endswith("running_var"):
            tensor.uniform_(0.05, 0.2)
        elif name.endswith("running_mean"):
            tensor.normal_(0, 0.1)
    return made.eval()


@pytest.fixture(scope="module")
def session(network: ResUNet) -> Iterator[object]:
    return onnxruntime.InferenceSession(
        build_direction_graph(network).model({}).SerializeToString()
    )


@pytest.mark.parametrize(
    "coordinates",
    [
        clouds(1),
        clouds(300),
        clouds(200, spread=60),
        clouds(250, at=-1001),
        clouds(120, 1, 80),
        clouds(40, at=777),
    ],
    ids=["one voxel", "dense", "far apart", "negative and odd", "three clouds", "odd"],
)
def test_the_graph_is_the_network(network: ResUNet, session: object, coordinates: Tensor) -> None:
    # Large, since a small network may answer a single voxel of small features by zeros alone.
    features = 10 * torch.randn(len(coordinates), 3, generator=torch.Generator().manual_seed(2))
    with torch.no_grad():
        expected = network(Voxels.from_points(coordinates, features))
    given = {"coordinates": coordinates.numpy(), "features": features.numpy()}
    (answer,) = session.run(None, given)  # pyright: ignore[reportAttributeAccessIssue]
    assert answer.shape == (len(coordinates), 2, 3, 3)
    assert expected.std() > 1e-3
    np.testing.assert_allclose(answer, expected.numpy(), rtol=1e-4, atol=1e-4)


def test_the_command_writes_what_a_user_of_the_file_must_know(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    weights = tiny_weights(bracket(), bottle())
    write_pose_weights(tmp_path / "w.safetensors", weights)
    words = ["--weights", str(tmp_path / "w.safetensors"), "--out", str(tmp_path / "p.onnx")]
    assert main(["export", "pose", *words]) == 0
    assert "clouds 3 | directions |" in capsys.readouterr().out
    record = json.loads((tmp_path / "p.proof.json").read_text())
    assert record["facts"]["cloud"]["voxel_m"] == weights.cloud.voxel_m
    assert record["facts"]["objects"] == [model.name for model in weights.models]
    assert len(record["differences"]) == 4


def test_a_baseline_is_refused() -> None:
    whole = tiny_weights(bracket())
    keypoints = len(whole.models[0].keypoints_m)
    network = PointNet(PointNetConfig(classes=1, keypoints=keypoints))
    weights = dataclasses.replace(whole, network=network)
    with pytest.raises(InputError, match="of a baseline"):
        pose_export(weights, {})
