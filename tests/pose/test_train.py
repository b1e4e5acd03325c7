"""Training of the direction network: samples by ticket, truth, evaluation, the run."""

import dataclasses
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from tests.pose.stopping import StoppedError, stop_after
from tests.pose.synthetic_objects import bottle, bracket, tiny_weights, write_part

from depthpose.core.checkpoint import read_checkpoint
from depthpose.core.config import read_config
from depthpose.core.errors import InputError
from depthpose.core.loop import AdamConfig, LoopConfig, TrainingRun
from depthpose.core.rigid import Rigid
from depthpose.pose.config import CloudConfig, MeshConfig, ObjectsConfig, SyntheticSensorConfig
from depthpose.pose.datasets import write_bop_models, write_bop_scene
from depthpose.pose.networks.resunet import ResUNet, ResUNetConfig, fold_norms
from depthpose.pose.networks.sparse import Voxels
from depthpose.pose.synthetic import SyntheticViews, make_frames
from depthpose.pose.train import (
    STAGES,
    FramesConfig,
    HeldOutConfig,
    ModelsConfig,
    PoseTask,
    PoseTraining,
    TrainingClouds,
    read_models,
    train_pose_network,
)
from depthpose.pose.train.clouds import TrainingViews
from depthpose.pose.train.held_out import (
    HELD_OUT_SEED,
    format_held_out_table,
    make_held_out_views,
    score_held_out,
)
from depthpose.pose.train.poses import make_pose_weights
from depthpose.pose.types import ObjectModel, PoseEstimate, Symmetries, VotingPoints
from depthpose.pose.weights import (
    PoseWeights,
    build_pose_network,
    read_pose_weights,
    write_pose_weights,
)

CONFIGS = Path(__file__).parents[2] / "configs" / "pose"
_SMALL = ResUNetConfig(classes=2, first_kernel=3, encoder=(4, 4, 8, 8), decoder=(4, 4, 4, 8))
_CLOUD = CloudConfig(voxel_m=0.01, max_points=300)
_VIEWS = ObjectsConfig(views=2, number=6)
_FOUR_KEYPOINTS = ModelsConfig(parts=("bracket",), mesh=MeshConfig(keypoints=4))


def _models() -> tuple[ObjectModel, ...]:
    return (
        dataclasses.replace(bracket(), number=1),
        dataclasses.replace(bottle(), number=2),
    )


def _training(**changes: object) -> PoseTraining:
    config = PoseTraining(
        models=ModelsConfig(parts=("bracket",)),
        objects=_VIEWS,
        cloud=_CLOUD,
        network=_SMALL,
        held_out=HeldOutConfig(number=2, occlusions=(0.0,)),
        loop=LoopConfig(steps=3, batch_size=2, device="cpu", log_every_steps=1),
    )
    return dataclasses.replace(config, **changes)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Weights of :func:`_training`, in the folder of its run."""
    return train_pose_network(
        _training(), TrainingRun(folder=tmp_path_factory.mktemp("trained") / "run")
    )


def _clouds(models: Sequence[ObjectModel], **settings: Any) -> TrainingClouds:  # noqa: ANN401
    config = PoseTraining(**{"objects": _VIEWS, "cloud": _CLOUD, **settings})
    return TrainingClouds(models, config, 0)


def test_an_index_gives_the_same_cloud_at_any_time() -> None:
    one, other = (_clouds(_models()) for _ in range(2))
    for ticket in (0, 5, 17):
        first, second = one[ticket], other[ticket]
        assert torch.equal(first.points_m, second.points_m)
        assert first.class_number == ticket % 2
    assert not torch.equal(one[0].R, one[2].R)


def test_the_first_object_may_begin_alone() -> None:
    clouds = _clouds(_models(), first_alone=4)
    assert [clouds[i].class_number for i in range(8)] == [0, 0, 0, 0, 0, 1, 0, 1]
    plain = _clouds(_models())
    assert torch.equal(clouds[5].points_m, plain[5].points_m)
    # They are different views.
    assert not torch.equal(clouds[1].R, clouds[2].R)


def test_a_batch_keeps_clouds_apart_and_points_in_their_voxels() -> None:
    clouds = _clouds(_models())
    parts = [clouds[i] for i in range(3)]
    batch = TrainingClouds.collate(parts)
    assert batch.class_of.tolist() == [0, 1, 0]
    for number, part in enumerate(parts):
        own = batch.coordinates[:, 0] == number
        assert torch.equal(batch.points_m[own], part.points_m)
        # Points of one cloud have voxels of their own: none is kept twice.
        assert len(torch.unique(part.coordinates, dim=0)) == len(part.coordinates)
        spread = part.points_m.amax(0) - part.points_m.amin(0)
        cells = part.coordinates.amax(0) - part.coordinates.amin(0)
        assert bool(((cells * 0.01 - spread).abs() <= 0.0101).all())


class _Oracle(ResUNet):
    """Answers with the true directions, whatever it is shown."""

    truth: torch.Tensor

    def directions(self, points: VotingPoints) -> torch.Tensor:  # noqa: ARG002
        return self.truth


def _truth_of(batch, models, copy: int) -> torch.Tensor:  # noqa: ANN001
    copies = PoseTask(_Oracle(_SMALL), models, _training())._copies_m[batch.class_of, copy]
    posed = copies @ batch.R.mT + batch.t_m[:, None]
    way = posed[batch.coordinates[:, 0].long()] - batch.points_m[:, None]
    return F.normalize(way, dim=-1)


@pytest.mark.parametrize("copy", [0, 7])
def test_true_directions_cost_nothing_whichever_copy_they_point_at(copy: int) -> None:
    models = _models()
    clouds = _clouds(models)
    batch = TrainingClouds.collate([clouds[0], clouds[1]])
    network = _Oracle(_SMALL)
    task = PoseTask(network, models, _training())
    network.truth = _truth_of(batch, models, copy)
    # The bracket has one copy alone, which is repeated.
    (turn,) = list(task.step(batch))
    assert turn.loss.item() < 1e-9
    network.truth = -network.truth
    (turn,) = list(task.step(batch))
    assert turn.loss.item() > 0.5


def test_copies_of_the_keypoints_lie_on_the_turned_object() -> None:
    copies = PoseTask(_Oracle(_SMALL), _models(), _training())._copies_m
    assert copies.shape == (2, 63, 8, 3)
    assert torch.equal(copies[0], copies[0, :1].expand(63, -1, -1))
    height, radius = copies[1, ..., 2], copies[1, ..., :2].norm(dim=-1)
    assert torch.allclose(height, height[:1].expand(63, -1), atol=1e-6)
    assert torch.allclose(radius, radius[:1].expand(63, -1), atol=1e-6)


def test_the_loss_falls() -> None:
    torch.manual_seed(0)
    models = _models()
    clouds = _clouds(models)
    batch = TrainingClouds.collate([clouds[i] for i in range(4)])
    config = _training(adam=AdamConfig(learning_rate=0.01))
    task = PoseTask(ResUNet(_SMALL), models, config)
    optimizer, _ = task.optimizers["network"]
    losses = []
    for _ in range(40):
        (turn,) = list(task.step(batch))
        turn.loss.backward()
        optimizer.step()
        optimizer.zero_grad()
        losses.append(turn.loss.item())
    assert losses[0] < 0.5
    assert losses[-1] < 0.5 * losses[0]


def _frames_folder(folder: Path) -> Path:
    models = _models()
    config = ObjectsConfig(
        image_px=(160, 120),
        focal_px=(143.0, 143.0),
        centre_px=(81.0, 60.0),
        frame_clutter=(0, 0),
        sensor=SyntheticSensorConfig(kinds=("laser",), missing=(0.0, 0.0)),
    )
    write_bop_models(folder, models)
    write_bop_scene(folder, "train", 0, list(make_frames(models, config, 4)))
    return folder


def test_frames_and_synthetic_views_mix_and_frames_stay_true(tmp_path: Path) -> None:
    folder = _frames_folder(tmp_path)
    models = read_models(ModelsConfig(bop=str(folder)))
    frames = FramesConfig(folder=str(folder), share=0.5)
    clouds = _clouds(models, frames=frames)
    real = TrainingClouds(
        models,
        PoseTraining(objects=_VIEWS, frames=dataclasses.replace(frames, share=1.0), cloud=_CLOUD),
        0,
    )
    assert len(clouds) == 2 * len(real)
    made = SyntheticViews(models, _VIEWS, _CLOUD)
    is_made = [
        torch.allclose(clouds[i].t_m.norm(), made.view(i).truth.camera_from_model.t_m.norm())
        for i in range(30)
    ]
    assert 5 < sum(is_made) < 25
    for index in range(4):
        cloud = real[index]
        local = Rigid(cloud.R, cloud.t_m).inverse().apply(cloud.points_m)
        surface = models[cloud.class_number].vertices_m
        low, high = surface.amin(0) - 0.005, surface.amax(0) + 0.005
        assert float(((local > low) & (local < high)).all(1).float().mean()) > 0.9


def test_frames_of_other_names_are_refused(tmp_path: Path) -> None:
    folder = _frames_folder(tmp_path)
    frames = FramesConfig(folder=str(folder))
    models = [dataclasses.replace(model, name=model.name + "_x") for model in _models()]
    with pytest.raises(InputError, match="is called 'bracket' there, and 'bracket_x' here"):
        _clouds(models, frames=frames)


def test_views_too_far_for_their_voxels_are_refused_with_a_reason() -> None:
    far = dataclasses.replace(_VIEWS, distance_m=(19.0, 20.0))
    clouds = TrainingClouds(
        _models(), PoseTraining(objects=far, cloud=CloudConfig(min_points=500)), 0
    )
    with pytest.raises(InputError, match="20 samples in a row have fewer than 500 points; bring"):
        clouds[0]


def test_held_out_views_are_not_those_that_are_trained_on() -> None:
    models, held_out = _models(), HeldOutConfig(number=2)
    task = PoseTask(ResUNet(_SMALL), models, _training(held_out=held_out))
    trained = TrainingViews(models, PoseTraining(objects=_VIEWS, cloud=_CLOUD), 0).synthetic
    known = [trained.view(i).truth.camera_from_model.R for i in range(8)]
    numbers = task.validate().numbers
    assert task.network.training
    assert len(task._held_out[0.3]) == 4
    for view in task._held_out[0.3]:
        assert not any(torch.allclose(view.truth.camera_from_model.R, R) for R in known)
    assert set(numbers) == {
        f"held_out/occluded_{o}/ransac_{k}" for o in (0, 30) for k in ("add_10", "median")
    }
    assert HELD_OUT_SEED > 0


def test_a_held_out_view_of_too_few_points_is_a_failure() -> None:
    held_out = HeldOutConfig(number=3, occlusions=(0.0,))
    network = ResUNet(_SMALL).eval()
    made = make_held_out_views(_models(), _VIEWS, _CLOUD, held_out, 0.0)
    seen = [len(made[i].input.points_m) for i in range(6)]
    cloud = dataclasses.replace(_CLOUD, max_points=None, min_points=sorted(seen)[4])
    task = PoseTask(network, _models(), _training(held_out=held_out, cloud=cloud))
    with torch.no_grad():
        errors = [task.measure_view(made.view(i), i) for i in range(6)]
    assert [math.isfinite(error) for error in errors] == [n >= cloud.min_points for n in seen]
    assert task.validate().numbers["held_out/occluded_0/ransac_median"] == math.inf


def test_a_training_leaves_weights_a_card_and_its_config(trained: Path) -> None:
    weights = read_pose_weights(trained)
    assert isinstance(weights.network, ResUNet)
    assert weights.network.config.norm == "none"
    assert [model.name for model in weights.models] == ["bracket"]
    assert weights.cloud == _CLOUD
    assert "synthetic views of bracket" in weights.facts["trained_on"]
    card = trained.with_suffix(".md").read_text()
    assert "- **Objects**: bracket (160 mm)\n" in card
    assert "`depthpose pose train --what pose --config config.yaml --out run`" in card
    assert "- **Time**: " in card
    assert "| occluded % | right % |" in card
    rows = json.loads(trained.with_suffix(".json").read_text())["held_out"]
    assert set(rows) == {"0"}
    shares = [rows["0"][name] for name in ("right", "wrong", "refused")]
    assert sum(shares) == pytest.approx(1)
    again = read_config(trained.parent / "config.yaml", PoseTraining)
    assert again.network.classes == 1
    with pytest.raises(InputError, match="holds a training"):
        train_pose_network(_training(), TrainingRun(folder=trained.parent))


@pytest.mark.slow
def test_a_training_begins_with_what_other_objects_taught(trained: Path, tmp_path: Path) -> None:
    """Whether or not the weights hold their meshes."""
    bare = tmp_path / "bare.safetensors"
    write_pose_weights(bare, read_pose_weights(trained), with_meshes=False)
    loop = LoopConfig(steps=1, batch_size=16, device="cpu", log_every_steps=1)
    still = AdamConfig(learning_rate=1e-9)
    parts = ModelsConfig(parts=("bracket", "mug"))
    paths = [trained]
    for start in (trained, bare):
        config = _training(models=parts, start=str(start), adam=still, loop=loop)
        paths.append(
            train_pose_network(config, TrainingRun(folder=tmp_path / f"then {start.stem}"))
        )
    networks = [build_pose_network(read_checkpoint(path), str(path)) for path in paths]
    cloud = TrainingClouds(_models(), PoseTraining(objects=_VIEWS, cloud=_CLOUD), seed=1)[0]
    voxels = Voxels.from_points(F.pad(cloud.coordinates, (1, 0)))
    seen = [n.features(voxels).at_points().detach() for n in networks if isinstance(n, ResUNet)]
    assert len(seen) == 3
    for found in seen[1:]:
        assert float((found - seen[0]).norm() / seen[0].norm()) < 0.1
    other = dataclasses.replace(_SMALL, keypoints=4)
    with pytest.raises(InputError, match="trained with keypoints = 8"):
        train_pose_network(
            dataclasses.replace(config, network=other, models=_FOUR_KEYPOINTS),
            TrainingRun(folder=tmp_path / "other"),
        )


def test_terms_of_the_start_bind_what_comes_of_it(tmp_path: Path) -> None:
    bound = dataclasses.replace(_training().models, terms="For research alone.")
    first = train_pose_network(_training(models=bound), TrainingRun(folder=tmp_path / "first"))
    for terms, expected in (
        ("", "For research alone."),
        ("Cite us.", "Cite us. For research alone."),
    ):
        models = dataclasses.replace(bound, terms=terms)
        config = _training(models=models, start=str(first))
        with pytest.warns(UserWarning, match="For research alone"):
            then = train_pose_network(config, TrainingRun(folder=tmp_path / f"then{len(terms)}"))
        facts = read_pose_weights(then).facts
        assert facts["terms"] == expected
        assert facts["began_with"] == "pose"
        assert expected in then.with_suffix(".md").read_text()


def test_a_start_with_other_voxel_features_is_refused(trained: Path, tmp_path: Path) -> None:
    cloud = dataclasses.replace(_CLOUD, with_shape=True)
    with pytest.raises(InputError, match="inputs = 1, but the config says 9"):
        train_pose_network(
            _training(cloud=cloud, start=str(trained)), TrainingRun(folder=tmp_path / "more")
        )
    with pytest.raises(InputError, match=r"takes 1 features of a voxel, .* clouds give 9\. Set"):
        dataclasses.replace(read_pose_weights(trained), cloud=cloud)


def test_a_training_without_norms_begins_with_weights_that_have_its_biases(tmp_path: Path) -> None:
    path = tmp_path / "folded.safetensors"
    config = _training()
    network = fold_norms(ResUNet(dataclasses.replace(_SMALL, classes=1)))
    write_pose_weights(path, make_pose_weights(network, read_models(config.models), config))
    plain = dataclasses.replace(_SMALL, norm="none")
    with pytest.raises(InputError) as error:
        train_pose_network(
            _training(start=str(path), network=plain), TrainingRun(folder=tmp_path / "plain")
        )
    assert str(error.value) == (
        f"{path}: was trained with with_bias = True, but the config says False. Give the config "
        "the weights' own."
    )
    biased = dataclasses.replace(plain, with_bias=True)
    still = _training(start=str(path), network=biased, adam=AdamConfig(learning_rate=1e-12))
    then = read_pose_weights(
        train_pose_network(still, TrainingRun(folder=tmp_path / "biased"))
    ).network
    for name, tensor in network.state_dict().items():
        assert torch.allclose(then.state_dict()[name], tensor, atol=1e-6), name


def test_a_resumed_training_ends_as_one_that_nothing_stopped(trained: Path, tmp_path: Path) -> None:
    loop = LoopConfig(steps=3, batch_size=2, device="cpu", log_every_steps=1, save_every_steps=1)
    with pytest.raises(StoppedError):
        train_pose_network(
            _training(loop=loop), TrainingRun(folder=tmp_path / "cut", on_step=stop_after(2))
        )
    cut = train_pose_network(
        _training(loop=loop), TrainingRun(folder=tmp_path / "cut", resume=True)
    )
    one, other = (read_pose_weights(path).network.state_dict() for path in (trained, cut))
    assert all(torch.equal(one[name], other[name]) for name in one)


def test_weights_are_measured_as_the_file_has_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[PoseWeights] = []

    def counted(weights: PoseWeights, *_: object) -> dict[str, dict[str, float | None]]:
        seen.append(weights)
        return {}

    monkeypatch.setattr("depthpose.pose.train.poses.score_held_out", counted)
    path = train_pose_network(_training(with_half=True), TrainingRun(folder=tmp_path / "run"))
    written = read_pose_weights(path)
    (measured,) = seen
    for name, tensor in written.network.state_dict().items():
        assert torch.equal(measured.network.state_dict()[name], tensor), name


def test_held_out_views_are_right_ambiguous_wrong_or_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pose = Rigid(torch.eye(3), torch.ones(3))
    shared = {"name": "", "object": "", "camera_from_model": pose}
    sure = PoseEstimate(status="ok", **shared)
    unsure = PoseEstimate(status="ambiguous", reason="others fit", **shared)
    none = PoseEstimate(name="", object="", status="doubtful", reason="so")
    rows = [(sure, 0.02)] * 5 + [(sure, 0.4), (unsure, 0.01), (unsure, 0.5), (none, math.inf)] * 1
    answers = ([one for one, _ in rows], [error for _, error in rows])
    monkeypatch.setattr("depthpose.pose.train.held_out._estimate_views", lambda *_: answers)
    held_out = HeldOutConfig(number=4, occlusions=(0.0,))
    table = score_held_out(tiny_weights(*_models()), _VIEWS, held_out)
    shares = {"right": 5 / 9, "ambiguous": 2 / 9, "wrong": 1 / 9, "refused": 1 / 9, "median": 0.02}
    assert table["0"] == pytest.approx(shares)
    assert "| occluded % | right % | ambiguous % | wrong % | refused %" in format_held_out_table(
        table
    )
    assert (
        format_held_out_table(table)
        .splitlines()[-1]
        .startswith("| 0 | 55.6 | 22.2 | 11.1 | 11.1 | 2.0 |")
    )


def test_models_come_from_one_source(tmp_path: Path) -> None:
    file = str(write_part("flange", tmp_path))
    with pytest.raises(InputError, match="there is no object to learn; name its CAD file"):
        read_models(ModelsConfig())
    with pytest.raises(InputError, match="cad and parts are given; take the models from one"):
        read_models(ModelsConfig(cad=(file,), parts=("mug",)))
    with pytest.raises(InputError, match=r"flange.stl: no unit is given, .* unit: mm in a config"):
        read_models(ModelsConfig(cad=(file,)))
    with pytest.raises(InputError, match="two models are called 'flange'"):
        read_models(ModelsConfig(cad=(file, file), unit="mm"))
    four = ModelsConfig(parts=("mug", "spool"), mesh=MeshConfig(keypoints=4))
    assert [len(model.keypoints_m) for model in read_models(four)] == [4, 4]


def test_symmetries_of_a_cad_file_are_reported_and_taken_on_request(tmp_path: Path) -> None:
    file, printed = str(write_part("flange", tmp_path)), []
    (plain,) = read_models(ModelsConfig(cad=(file,), unit="mm"), printed.append)
    assert plain.symmetries.is_none
    assert "flange: looks the same after 5 turns, and after any turn about 0 axes" in printed[0]
    assert "--symmetries found" in printed[0]
    taking = ModelsConfig(cad=(file,), unit="mm", with_found_symmetries=True)
    (taken,) = read_models(taking, printed.append)
    assert taken.symmetries.discrete is not None
    assert len(taken.symmetries.discrete.R) == 5


@pytest.mark.slow
def test_symmetries_that_a_data_set_does_not_declare_are_found_too(tmp_path: Path) -> None:
    declared = dataclasses.replace(bottle(), number=1)
    silent = dataclasses.replace(bottle(), number=2, symmetries=Symmetries())
    write_bop_models(tmp_path, [declared, silent])
    printed: list[str] = []
    config = ModelsConfig(bop=str(tmp_path), with_found_symmetries=True)
    models = read_models(config, printed.append)
    assert [len(model.symmetries.continuous) for model in models] == [1, 1]
    axis = models[1].symmetries.continuous[0].direction
    assert float(axis[2].abs()) == pytest.approx(1, abs=1e-3)
    # What is declared stands, and nobody looks for more.
    assert len(printed) == 1
    assert "about 1 axes" in printed[0]
    assert read_models(ModelsConfig(bop=str(tmp_path)))[1].symmetries.is_none


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*.yaml")), ids=lambda path: path.stem)
def test_a_config_is_read_and_opens_with_its_own_command(path: Path) -> None:
    text = path.read_text()
    what = next((w for w in STAGES if f"--what {w} " in text), "pose")
    read_config(path, STAGES[what][0])
    head = " ".join(line for line in text.splitlines() if line.startswith("#"))
    assert f"depthpose pose train --config configs/pose/{path.name}" in head
    assert "Wall time" in head


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (FramesConfig, "frames has no folder"),
        (lambda: HeldOutConfig(occlusions=()), "nothing would be measured; take (0, 0.3)"),
    ],
)
def test_settings_that_cannot_be_are_refused(make, said: str) -> None:  # noqa: ANN001
    with pytest.raises(InputError) as error:
        make()
    assert said in str(error.value)
