import dataclasses
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from tests.pose.synthetic_objects import FACTS, bottle, bracket, tiny_weights, write_part

from depthpose.cli import main
from depthpose.core.checkpoint import SHIPPED, Checkpoint, read_checkpoint, save_checkpoint
from depthpose.core.errors import InputError
from depthpose.core.rigid import Rigid
from depthpose.pose.config import CloudConfig, RefusalConfig
from depthpose.pose.datasets import write_bop_models
from depthpose.pose.synthetic import make_part
from depthpose.pose.types import ObjectModel, SurfaceColors, Symmetries
from depthpose.pose.weights import (
    PoseWeights,
    complete_weights,
    read_pose_weights,
    write_pose_weights,
)


def assert_same_model(one: ObjectModel, other: ObjectModel) -> None:
    assert (one.name, one.number, one.diameter_m) == (other.name, other.number, other.diameter_m)
    for name in ("vertices_m", "faces", "normals", "keypoints_m"):
        mine, theirs = getattr(one, name), getattr(other, name)
        assert mine.dtype == theirs.dtype
        assert torch.equal(mine, theirs)


def turned() -> ObjectModel:
    """Declare half a turn about z, which nothing here checks."""
    half = Rigid(torch.diag(torch.tensor([-1.0, -1, 1]))[None], torch.tensor([[0.01, 0, 0]]))
    return dataclasses.replace(bracket("turned"), symmetries=Symmetries(discrete=half))


def test_network_and_objects_come_back_exactly(tmp_path: Path) -> None:
    cloud = CloudConfig(voxel_m=0.005, max_points=None)
    refusal = RefusalConfig(min_probability=0.7, max_size_error=0.05)
    weights = tiny_weights(bracket(), bottle(), turned(), cloud=cloud, refusal=refusal)
    write_pose_weights(tmp_path / "w.safetensors", weights)
    again = read_pose_weights(tmp_path / "w.safetensors")
    assert (again.cloud, again.refusal, again.facts) == (cloud, refusal, FACTS)
    assert again.network.config == weights.network.config
    assert not again.network.training
    for name, tensor in weights.network.state_dict().items():
        assert torch.equal(again.network.state_dict()[name], tensor)
    for mine, theirs in zip(again.models, weights.models, strict=True):
        assert_same_model(mine, theirs)
    assert again.models[0].symmetries.is_none
    assert again.models[1].symmetries.continuous[0].direction.tolist() == [0, 0, 1]
    discrete = again.models[2].symmetries.discrete
    assert discrete is not None
    assert discrete.t_m.tolist() == [pytest.approx([0.01, 0, 0])]


def test_meshes_that_were_kept_back_are_put_in_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    weights = tiny_weights(make_part("bracket", 3))
    bare, whole = tmp_path / "bare.safetensors", tmp_path / "whole.safetensors"
    write_pose_weights(bare, weights, with_meshes=False)
    kept = [name for name in read_checkpoint(bare).state if name.startswith("models.")]
    assert kept == ["models.0.keypoints_m"]
    with pytest.raises(InputError, match=f"depthpose weights complete {bare} --models FOLDER"):
        read_pose_weights(bare)
    write_bop_models(tmp_path / "data", weights.models)
    words = ["weights", "complete", str(bare), "--models", str(tmp_path / "data")]
    assert main([*words, "--out", str(whole)]) == 0
    mine, theirs = read_pose_weights(whole).models[0], weights.models[0]
    torch.testing.assert_close(mine.vertices_m, theirs.vertices_m, rtol=0, atol=1e-6)
    assert torch.equal(mine.keypoints_m, theirs.keypoints_m)
    file = write_part("bracket", tmp_path)
    assert main([*words[:-1], str(file), "--out", str(whole)]) == 2
    assert "is there already; delete it" in capsys.readouterr().err
    whole.unlink()
    assert main([*words[:-1], str(file), "--out", str(whole)]) == 0
    assert len(read_pose_weights(whole).models[0].faces) > 0
    write_bop_models(tmp_path / "other", [make_part("mug", 3)])
    whole.unlink()
    assert main([*words[:-1], str(tmp_path / "other"), "--out", str(whole)]) == 2
    assert "another object, frame or unit" in capsys.readouterr().err
    write_bop_models(tmp_path / "few", [bottle()])
    assert main([*words[:-1], str(tmp_path / "few"), "--out", str(whole)]) == 2


def test_coarse_meshes_are_put_in_again_too(tmp_path: Path) -> None:
    """Keypoints of a mesh of few points lie inside its faces."""
    weights = tiny_weights(bracket())
    (model,) = weights.models
    assert float(torch.cdist(model.keypoints_m, model.vertices_m).amin(1).max()) > 0.01
    write_pose_weights(tmp_path / "bare.safetensors", weights, with_meshes=False)
    complete_weights(tmp_path / "bare.safetensors", {7: model}, tmp_path / "whole.safetensors")
    assert_same_model(read_pose_weights(tmp_path / "whole.safetensors").models[0], model)
    longer = {"vertices_m": 1.1 * model.vertices_m, "diameter_m": 1.1 * model.diameter_m}
    for change in (longer, {"vertices_m": model.vertices_m + 0.01}):
        other = {7: dataclasses.replace(model, **change)}
        with pytest.raises(InputError, match="another object, frame or unit"):
            complete_weights(tmp_path / "bare.safetensors", other, tmp_path / "no.safetensors")


def test_one_file_completes_no_weights_of_several_objects(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bare, file = tmp_path / "bare.safetensors", write_part("bracket", tmp_path)
    write_pose_weights(bare, tiny_weights(bracket(), bottle()), with_meshes=False)
    words = ["weights", "complete", str(bare), "--models", str(file)]
    assert main([*words, "--out", str(tmp_path / "whole.safetensors")]) == 2
    assert f"one file serves weights of one object, and {bare} knows 2; give the folder" in (
        capsys.readouterr().err
    )


def test_half_precision_halves_the_network_and_keeps_models_exact(tmp_path: Path) -> None:
    weights = tiny_weights(bracket())
    for name, half in (("full", False), ("half", True)):
        write_pose_weights(tmp_path / f"{name}.safetensors", weights, with_half=half)
    again = read_pose_weights(tmp_path / "half.safetensors")
    assert_same_model(again.models[0], weights.models[0])
    state = again.network.state_dict()
    for name, tensor in weights.network.state_dict().items():
        assert state[name].dtype == tensor.dtype
        torch.testing.assert_close(state[name], tensor, rtol=1e-3, atol=1e-4)
    sizes = [(tmp_path / f"{name}.safetensors").stat().st_size for name in ("full", "half")]
    numbers = sum(t.numel() for t in weights.network.parameters())
    assert sizes[0] - sizes[1] == pytest.approx(2 * numbers, rel=0.05)


def test_colours_of_a_model_come_back(tmp_path: Path) -> None:
    torch.manual_seed(0)
    points_m, rgb = torch.rand(500, 3), torch.rand(500, 3)
    normals = torch.nn.functional.normalize(torch.randn(500, 3), dim=-1)
    colors = SurfaceColors(points_m=points_m, normals=normals, rgb=rgb, spacing_m=0.0025)
    colored = dataclasses.replace(bracket(), colors=colors)
    write_pose_weights(tmp_path / "w.safetensors", tiny_weights(colored, bottle()))
    first, second = read_pose_weights(tmp_path / "w.safetensors").models
    assert second.colors is None
    assert first.colors is not None
    assert torch.equal(first.colors.points_m, points_m)
    torch.testing.assert_close(first.colors.normals, normals, atol=1e-3, rtol=0)
    torch.testing.assert_close(first.colors.rgb, rgb, atol=1 / 500, rtol=0)
    assert first.colors.spacing_m == pytest.approx(0.0025)
    # They are of the surface: kept back with it, and put in again with it.
    without, whole = tmp_path / "n.safetensors", tmp_path / "c.safetensors"
    write_pose_weights(without, tiny_weights(colored), with_meshes=False)
    assert not any("colors" in name for name in read_checkpoint(without).state)
    complete_weights(without, {colored.number: colored}, whole)
    again = read_pose_weights(whole).models[0].colors
    assert again is not None
    assert torch.equal(again.points_m, points_m)


def test_many_objects_stay_small(tmp_path: Path) -> None:
    """21 models of 2,600 points and 4 meshes of 10,000 vertices, beside any network."""
    few = tiny_weights(bracket()).models[0]
    points = few.vertices_m.new_zeros(2600, 3)
    cloud = dataclasses.replace(few, vertices_m=points, normals=points, faces=few.faces[:0])
    vertices, faces = points.new_zeros(10_000, 3), torch.zeros(20_000, 3, dtype=torch.long)
    mesh = dataclasses.replace(few, vertices_m=vertices, normals=vertices, faces=faces)
    every = [dataclasses.replace(m, name=str(k)) for k, m in enumerate([cloud] * 21 + [mesh] * 4)]
    path = tmp_path / "w.safetensors"
    write_pose_weights(path, tiny_weights(*every))
    assert path.stat().st_size < 4e6


def test_the_command_line_knows_the_kind(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_pose_weights(tmp_path / "mine.safetensors", tiny_weights(bracket(), bottle()))
    assert main(["weights", "list", "--folder", str(tmp_path)]) == 0
    listed = capsys.readouterr().out.splitlines()
    assert listed[0].split() == ["name", "kind", "MB", "licence", "trained", "on"]
    assert listed[1].startswith("mine  geoposenet  ")
    assert main(["weights", "list"]) == 0
    assert max(map(len, capsys.readouterr().out.splitlines())) <= 100
    assert main(["weights", "show", str(tmp_path / "mine.safetensors")]) == 0
    said = capsys.readouterr().out
    assert "objects: bracket (7), bottle (0)" in said
    assert "licence: MIT" in said
    parameters = sum(p.numel() for p in tiny_weights(bracket(), bottle()).network.parameters())
    assert f"parameters: {parameters}\n" in said


@pytest.mark.parametrize("path", sorted(SHIPPED.glob("*.safetensors")), ids=lambda path: path.stem)
def test_weights_that_ship_have_the_settings_of_today(path: Path) -> None:
    assert main(["weights", "show", str(path)]) == 0


def without(content: dict, name: str) -> dict:
    return {key: value for key, value in content.items() if key != name}


CHANGES: dict[str, Callable[[dict, dict], tuple[dict, dict]]] = {
    "no network": lambda config, state: (without(config, "network"), state),
    "no cloud": lambda config, state: (without(config, "cloud"), state),
    "no models": lambda config, state: ({**config, "models": []}, state),
    "no name": lambda config, state: ({**config, "models": [{"number": 1}]}, state),
    "no faces": lambda config, state: (config, without(state, "models.0.faces")),
    "wild face": lambda config, state: (
        config, {**state, "models.0.faces": state["models.0.faces"] + 1000}),
    "flat": lambda config, state: (
        config, {**state, "models.0.keypoints_m": state["models.0.keypoints_m"][:, :2]}),
    "stray": lambda config, state: (
        config, {**state, "models.1.faces": state["models.0.faces"].clone()}),
    "lost weight": lambda config, state: (config, without(state, "network.final.bias")),
    "other cloud": lambda config, state: ({**config, "cloud": {"voxels_m": 1.0}}, state),
}  # fmt: skip


def broken(path: Path, change: str) -> Path:
    """Write weights with one thing wrong."""
    write_pose_weights(path, tiny_weights(bracket()))
    found = read_checkpoint(path)
    config, state = CHANGES[change](dict(found.config), dict(found.state))
    save_checkpoint(path, Checkpoint(kind=found.kind, config=config, state=state))
    return path


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ("no network", "its config has no 'network'"),
        ("no cloud", "its config has no 'cloud'"),
        ("no models", "its config lists no 'models'"),
        ("no name", "model 0 has no 'name'"),
        ("no faces", "model 0 has no 'faces'"),
        ("wild face", "model 0: a face names vertex 10"),
        ("flat", "model 0 has tensors of shapes"),
        ("stray", "tensor 'models.1.faces' is unexpected"),
        ("lost weight", "final.bias is missing"),
        ("other cloud", "unknown key 'voxels_m'"),
    ],
)
def test_a_file_that_is_not_whole_is_refused(tmp_path: Path, change: str, text: str) -> None:
    with pytest.raises(InputError, match=text):
        read_pose_weights(broken(tmp_path / "w.safetensors", change))


def test_objects_and_classes_must_agree() -> None:
    weights = tiny_weights(bracket())
    parts = {name: getattr(weights, name) for name in ("network", "cloud", "refusal", "facts")}
    with pytest.raises(InputError, match="knows 1 classes, but 2 models"):
        PoseWeights(models=(bracket(), bottle()), **parts)
    with pytest.raises(InputError, match="8 keypoints, but object 'bracket' has 5"):
        PoseWeights(models=(bracket(keypoints=5),), **parts)
    with pytest.raises(InputError, match="two models are called 'bracket'"):
        tiny_weights(bracket(), bracket())
