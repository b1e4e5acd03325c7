"""The estimator with an oracle in place of its network: every step but the learning."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from tests.pose.synthetic_objects import (
    CAMERA,
    FACTS,
    K,
    Oracle,
    bottle,
    bracket,
    cloud_of,
    pose_at,
    tiny_weights,
    view_of,
)

import depthpose
from depthpose.core.camera import back_project, write_camera
from depthpose.core.checkpoint import LicenceNotice
from depthpose.core.errors import InputError
from depthpose.core.files import PointCloud, write_cloud, write_depth_png, write_image
from depthpose.core.rigid import Rigid, geodesic_rad, rotation_by
from depthpose.pose.cloud import prepare_cloud
from depthpose.pose.config import CloudConfig, EstimateConfig, VotingConfig
from depthpose.pose.mesh import (
    make_model,
    propose_symmetries,
    sample_surface,
    symmetries_from_proposals,
)
from depthpose.pose.metrics import add_m, adds_m
from depthpose.pose.network_pose import GeoPoseNet
from depthpose.pose.registration import Registration
from depthpose.pose.types import CloudInput, ObjectModel, PoseEstimate, ViewInput
from depthpose.pose.weights import write_pose_weights

VOTE_ALONE = EstimateConfig(with_icp=False)


@pytest.fixture(scope="module")
def part() -> ObjectModel:
    return bracket()


def assert_close(found: PoseEstimate, truth: Rigid, limit_m: float = 0.002) -> None:
    assert found.status == "ok", found.reason
    assert found.camera_from_model is not None
    assert float(add_m(found.camera_from_model, truth, bracket().vertices_m)) < limit_m


@pytest.mark.parametrize("method", ["ransac", "least squares"])
@pytest.mark.parametrize("with_icp", [True, False])
def test_true_directions_give_the_true_pose(part: ObjectModel, method: str, with_icp: bool) -> None:
    truth = pose_at()
    voting = VotingConfig(method=method)  # pyright: ignore[reportArgumentType]
    config = EstimateConfig(voting=voting, with_icp=with_icp)
    net = Oracle(tiny_weights(part), [truth], config=config)
    found = net.estimate(cloud=cloud_of(part, truth))
    assert_close(found, truth, 0.0005)
    stages = ["cloud", "network", "proposal", "icp", "evidence", "decision"]
    assert list(found.seconds) == [s for s in stages if with_icp or s != "icp"]
    assert found.covariance is not None
    assert bool(torch.linalg.eigvalsh(found.covariance.double()).min() > 0)


def test_noise_and_outliers_are_survived(part: ObjectModel) -> None:
    truth = pose_at(seed=3)
    net = Oracle(tiny_weights(part), [truth], noise=0.05, wrong=0.3)
    assert_close(net.estimate(cloud=cloud_of(part, truth)), truth)


def test_files_arrays_and_tensors_are_one_input(part: ObjectModel, tmp_path: Path) -> None:
    truth = pose_at()
    net = Oracle(tiny_weights(part), [truth], config=VOTE_ALONE)
    depth_m, mask = view_of(part, truth)
    units = (1000 * depth_m.nan_to_num(0.0)).round().to(torch.int32)
    write_depth_png(tmp_path / "d.png", units / 1000, 0.001)
    write_image(tmp_path / "m.png", mask.float().expand(3, -1, -1))
    write_camera(tmp_path / "c.json", CAMERA)
    inputs = [
        (tmp_path / "d.png", tmp_path / "m.png", tmp_path / "c.json"),
        (units, mask, CAMERA),
        (units.numpy().astype(np.uint16), mask.numpy(), CAMERA),
        (units.float() / 1000, mask.to(torch.uint8), K.numpy()),
    ]
    poses = []
    for depth, pixels, camera in inputs:
        found = net.estimate(depth=depth, mask=pixels, camera=camera, object="bracket")
        assert_close(found, truth)
        assert found.camera_from_model is not None
        poses.append(found.camera_from_model)
    assert all(torch.allclose(pose.t_m, poses[0].t_m, atol=1e-6) for pose in poses)


def test_millimetres_are_millimetres(part: ObjectModel, tmp_path: Path) -> None:
    truth = pose_at()
    net = Oracle(tiny_weights(part), [truth])
    cloud = cloud_of(part, truth)
    write_cloud(tmp_path / "c.ply", PointCloud(points=1000 * cloud))
    assert_close(net.estimate(cloud=tmp_path / "c.ply", unit="mm"), truth)
    assert_close(net.estimate(cloud=cloud.double().numpy()), truth)


def test_the_same_input_gives_the_same_bits(part: ObjectModel) -> None:
    truth = pose_at()
    net = Oracle(tiny_weights(part), [truth], noise=0.1)
    cloud = cloud_of(part, truth)
    first, second = (net.estimate(cloud=cloud).camera_from_model for _ in range(2))
    assert first is not None
    assert second is not None
    assert torch.equal(first.R, second.R)
    assert torch.equal(first.t_m, second.t_m)


def test_many_at_once_are_each_as_alone(part: ObjectModel) -> None:
    """Two objects and a refusal among them; the network is called once for all."""
    truths = [pose_at(-0.3, seed=1), pose_at(0.0, seed=2), pose_at(0.3, seed=4)]
    models = (part, bottle())
    net = Oracle(tiny_weights(*models), truths, noise=0.02)
    names = ["bracket", "bottle", "bracket"]
    inputs: list[CloudInput | ViewInput] = [
        CloudInput(name=str(k), points_m=cloud_of(models[n == "bottle"], t), object=n)
        for k, (n, t) in enumerate(zip(names, truths, strict=True))
    ]
    inputs.insert(1, CloudInput(name="none", points_m=torch.zeros(0, 3), object="bottle"))
    together = net.estimate_many(inputs)
    assert net.calls == [3]
    assert [e.name for e in together] == ["0", "none", "1", "2"]
    assert [e.is_posed for e in together] == [True, False, True, True]
    for given, found in zip(inputs, together, strict=True):
        alone = net.estimate_many([given])[0]
        assert (alone.status, alone.object) == (found.status, found.object)
        if alone.camera_from_model is not None and found.camera_from_model is not None:
            assert torch.equal(alone.camera_from_model.t_m, found.camera_from_model.t_m)


@pytest.mark.parametrize("threads", [1, 2])
def test_what_cannot_be_taken_costs_the_others_nothing(
    part: ObjectModel, threads: int, capsys: pytest.CaptureFixture[str]
) -> None:
    """Unknown objects have a reason; the rest is as alone."""
    truth = pose_at()
    net = Oracle(tiny_weights(part), [truth])
    seen = CloudInput(name="seen", points_m=cloud_of(part, truth), object="bracket")
    cut = dataclasses.replace(seen, name="cut", object="")
    inputs = [
        seen,
        dataclasses.replace(seen, name="foreign", object="brackte"),
        cut,
        dataclasses.replace(seen, name="s"),
    ]
    found = net.estimate_many((one for one in inputs), threads=threads, with_progress=True)
    assert "4 poses" in capsys.readouterr().err
    assert [one.name for one in found] == ["seen", "foreign", "cut", "s"]
    assert [one.status for one in found] == ["ok", "unreadable", "unreadable", "ok"]
    assert "do not know it; did you mean 'bracket'" in found[1].reason
    assert_close(found[0], truth)
    assert_close(found[3], truth)


def test_calls_of_the_network_are_bounded(part: ObjectModel) -> None:
    truth = pose_at()
    net = Oracle(tiny_weights(part), [truth], config=EstimateConfig(batch_voxels=1))
    given = CloudInput(name="a", points_m=cloud_of(part, truth), object="bracket")
    net.estimate_many([given, given])
    assert net.calls == [1, 1]


def test_instances_of_one_mask_are_distinguished(part: ObjectModel) -> None:
    truths = [pose_at(-0.13, 0.7, seed=1), pose_at(0.12, 0.9, seed=2)]
    net = Oracle(tiny_weights(part), truths)
    depth_m, mask = view_of(part, *truths)
    mask[2:5, 2:5] = True  # a crumb
    found = net.estimate_instances(depth=depth_m, mask=mask, camera=CAMERA)
    assert [e.name for e in found] == ["input_0", "input_1"]
    for estimate, truth in zip(found, truths, strict=True):
        assert_close(estimate, truth)


def test_a_declared_axis_is_no_reason_to_refuse() -> None:
    model, truth = bottle(), pose_at(seed=5)
    net = Oracle(tiny_weights(model), [truth], noise=0.02)
    found = net.estimate(cloud=cloud_of(model, truth))
    assert found.is_posed, found.reason
    assert found.camera_from_model is not None
    assert found.free_motions is not None
    assert found.covariance is not None
    assert float(adds_m(found.camera_from_model, truth, model.vertices_m)) < 0.002
    assert found.free_motions.shape == (1, 6)
    along = found.free_motions[0].double() @ found.covariance.double()
    assert float(along.norm()) < 1e-9


def test_a_ball_whose_symmetries_were_found_is_posed() -> None:
    ball = trimesh.creation.icosphere(3, 0.06)
    vertices, faces = (torch.from_numpy(np.array(part)) for part in (ball.vertices, ball.faces))
    plain = make_model(vertices, faces, name="ball")
    found = symmetries_from_proposals(propose_symmetries(plain))
    assert len(found.continuous) == 2
    model, truth = dataclasses.replace(plain, symmetries=found), pose_at(seed=5)
    net = Oracle(tiny_weights(model), [truth], noise=0.02)
    answer = net.estimate(cloud=cloud_of(model, truth))
    assert answer.status == "ok", answer.reason
    assert answer.camera_from_model is not None
    assert answer.free_motions is not None
    assert answer.free_motions.shape == (3, 6)
    assert float((answer.camera_from_model.t_m - truth.t_m).norm()) < 0.002
    assert answer.alternatives == (), "every turn of a ball is one pose"
    assert answer.certainty is None or answer.certainty > 0.9


def test_a_part_may_be_longer_than_its_distance() -> None:
    """A rail of 1.2 m, 0.5 m away: seen, so not centred."""
    box = trimesh.creation.box((1.2, 0.06, 0.03))
    vertices_m, faces = torch.from_numpy(np.array(box.vertices)), torch.from_numpy(box.faces)
    model = make_model(vertices_m, faces, name="rail")
    turn = rotation_by(torch.tensor([0.7, 0.1, 0.0]))
    truth = Rigid(turn, torch.tensor([0.02, 0.0, 0.5]))
    depth_m, mask = view_of(model, truth)
    view = ViewInput(name="rail", depth_m=depth_m, mask=mask, K=K, object=model.name)
    cloud = CloudInput(name="rail", points_m=back_project(depth_m, K)[mask], object=model.name)
    for given in (view, cloud):
        prepare_cloud(given, model, CloudConfig(), EstimateConfig())  # raises nothing


def test_points_without_a_reading_take_no_others_place(part: ObjectModel) -> None:
    """An organised cloud is mostly NaN."""
    points_m = cloud_of(part, pose_at()).float()
    grid = torch.full((150_000, 3), torch.nan)
    grid[1::7] = torch.finfo(torch.float32).max  # what some sensors write
    grid[:: 150_000 // len(points_m)][: len(points_m)] = points_m
    given = CloudInput(name="x", points_m=grid, object=part.name)
    prepared = prepare_cloud(given, part, CloudConfig(), EstimateConfig())
    assert len(prepared.cloud_m) > 0.95 * len(points_m)


def test_a_cloud_of_which_the_camera_sees_a_part_costs_the_others_nothing(
    part: ObjectModel,
) -> None:
    """A part that stands on its end, in the frame of a table: some points are below the table."""
    truth = pose_at(seed=3)
    seen_m = cloud_of(part, truth).float()
    standing_m = truth.inverse().apply(seen_m)[:, [1, 2, 0]]
    table_m = standing_m - standing_m.amin(0) + torch.tensor([0.08, 0.08, -0.03])
    given = [
        CloudInput(name="table", points_m=table_m, object=part.name),
        CloudInput(name="camera", points_m=seen_m, object=part.name),
    ]
    below, found = Registration([part]).estimate_many(given)
    assert found.is_posed, found.reason
    assert below.status == "unusable input"
    assert "of the points lie behind the camera or beside it" in below.reason
    assert "Or is the cloud not in the camera's frame (x right, y down, z forward)?" in below.reason


def test_stray_points_that_no_camera_sees_are_left_out(part: ObjectModel) -> None:
    near = Rigid(pose_at(seed=3).R, torch.tensor([0.0, 0.0, 0.25]))
    points_m = cloud_of(part, near).float()
    strays_m = torch.tensor([[0.0, 0.0, -0.05], [0.1, 0.0, 0.0], [0.1, 0.0, 1e-6]])
    given = CloudInput(name="x", points_m=torch.cat([points_m, strays_m]), object=part.name)
    prepared = prepare_cloud(given, part, CloudConfig(), EstimateConfig())
    assert torch.equal(prepared.cloud_m, points_m)


@pytest.mark.slow
def test_about_an_axis_that_nobody_declared_every_rotation_is_named() -> None:
    plain = bottle()
    model = dataclasses.replace(plain, symmetries=type(plain.symmetries)())
    truth = pose_at(seed=5)
    found = Oracle(tiny_weights(model), [truth]).estimate(cloud=cloud_of(model, truth))
    assert found.camera_from_model is not None, found.reason
    assert float(adds_m(found.camera_from_model, truth, model.vertices_m)) < 0.002
    assert found.certainty is not None
    assert found.copy_certainty is not None
    assert found.copy_certainty < 0.1 < found.certainty
    assert sum(alternative.is_copy for alternative in found.alternatives) > 10


def test_one_flat_side_is_not_observable(part: ObjectModel) -> None:
    """Noise hides from the eye that the points are a plane, but not from the surface's normals."""
    truth = Rigid(torch.eye(3), torch.tensor([0.0, 0.0, 0.8]))
    points = torch.rand(2000, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    model_points = points * torch.tensor([0.19, 0.055, 0.0]) + torch.tensor([0.0, 0.0, -0.025])
    model_points[:, 2] += 0.001 * torch.randn(2000, generator=torch.Generator().manual_seed(1))
    found = Oracle(tiny_weights(part), [truth]).estimate(cloud=truth.apply(model_points))
    assert found.status == "not observable"
    assert "leaves one shift undetermined" in found.reason or "one turn" in found.reason


def test_directions_that_do_not_meet_are_refused(part: ObjectModel) -> None:
    truth = pose_at()
    votes = EstimateConfig(with_icp=False)
    net = Oracle(tiny_weights(part), [truth], wrong=1.0, config=votes)
    found = net.estimate(cloud=cloud_of(part, truth))
    assert found.status in {"votes do not meet", "keypoints do not fit"}
    assert "but 4 are needed" in found.reason


def test_the_keypoints_of_another_object_do_not_fit(part: ObjectModel) -> None:
    truth = pose_at()
    cloud = cloud_of(part, truth)
    net = Oracle(tiny_weights(part), [truth])
    stretched = dataclasses.replace(part, keypoints_m=part.keypoints_m.flip(0) * 1.2)
    weights = dataclasses.replace(net.weights, models=(stretched,))

    class Liar(Oracle):
        def _true(self, points_m: torch.Tensor, number: int) -> torch.Tensor:
            return net._true(points_m, number)

    votes = EstimateConfig(with_icp=False)
    found = Liar(weights, [truth], config=votes).estimate(cloud=cloud)
    assert found.status == "keypoints do not fit"
    assert "another object, or too much of it occluded" in found.reason


def test_rough_votes_are_refined_where_icp_follows(part: ObjectModel) -> None:
    """Keypoints off by a seventh of the diameter break the strict test; ICP mends their pose."""
    truth = pose_at()
    cloud = cloud_of(part, truth)
    off_m = 0.14 * part.diameter_m * torch.randn(8, 3, generator=torch.Generator().manual_seed(1))
    rough = dataclasses.replace(part, keypoints_m=part.keypoints_m + off_m)
    net = Oracle(tiny_weights(rough), [truth])

    class Rough(Oracle):
        def _true(self, points_m: torch.Tensor, number: int) -> torch.Tensor:
            return net._true(points_m, number)

    votes = EstimateConfig(with_icp=False)
    strict = Rough(tiny_weights(part), [truth], config=votes).estimate(cloud=cloud)
    assert strict.status == "keypoints do not fit"
    assert_close(Rough(tiny_weights(part), [truth]).estimate(cloud=cloud), truth)


def test_an_untrained_network_is_refused_or_doubted(part: ObjectModel) -> None:
    """The real network, from the first to the last step; its votes alone."""
    found = GeoPoseNet(tiny_weights(part), VOTE_ALONE).estimate(cloud=cloud_of(part, pose_at()))
    assert found.status != "ok"
    assert found.reason
    assert found.camera_from_model is None


def test_poses_by_point_pairs_compete_with_wrong_votes(part: ObjectModel) -> None:
    """An untrained network votes for nothing right."""
    net = GeoPoseNet(tiny_weights(part))
    cloud = cloud_of(part, pose_at())
    assert_close(net.estimate(cloud=cloud, object=part.name), pose_at())


def test_rotation_of_the_view_turns_the_answer(part: ObjectModel) -> None:
    """Turning cloud and truth about the camera turns the pose, to the sampling of voxels."""
    truth = pose_at(seed=2)
    turn = Rigid(pose_at(seed=9).R, torch.zeros(3))
    turned = turn @ truth
    if float(turned.t_m[2]) < 0:
        flip = Rigid(torch.diag(torch.tensor([1.0, -1, -1])), torch.zeros(3))
        turn, turned = flip @ turn, flip @ turned
    cloud = cloud_of(part, truth)
    first = Oracle(tiny_weights(part), [truth]).estimate(cloud=cloud).camera_from_model
    second = Oracle(tiny_weights(part), [turned]).estimate(cloud=turn.apply(cloud))
    assert first is not None
    assert second.camera_from_model is not None
    assert float(geodesic_rad((turn @ first).R, second.camera_from_model.R)) < 0.01


def test_terms_are_said_and_names_are_found(part: ObjectModel, tmp_path: Path) -> None:
    facts = {**FACTS, "terms": "for research alone"}
    write_pose_weights(tmp_path / "part-nc.safetensors", tiny_weights(part, facts=facts))
    with pytest.warns(LicenceNotice, match="for research alone"):
        net = depthpose.GeoPoseNet.load(tmp_path / "part-nc.safetensors")
    assert net.objects == ("bracket",)
    assert net.terms == "for research alone"
    with pytest.raises(InputError, match="neither a file nor the name of weights"):
        GeoPoseNet.load("no-such")


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ({}, "give cloud=, or depth=, camera= and one of mask= and box= together"),
        (
            {"cloud": torch.zeros(3, 3), "depth": torch.zeros(2, 2)},
            "depth= belong to a depth image",
        ),
        (
            {"cloud": torch.zeros(3, 3), "camera": K, "color": torch.zeros(2, 2, 3)},
            "camera=, color= belong to a depth image, not to cloud=",
        ),
        ({"depth": torch.ones(240, 320), "mask": torch.ones(240, 320)}, "give cloud=, or depth="),
        ({"cloud": torch.zeros(3, 50)}, r"is of shape \(3, 50\); give points as rows"),
        ({"cloud": torch.zeros(30, 3), "object": "braket"}, "did you mean 'bracket'"),
        ({"cloud": Path("none.ply")}, "none.ply"),
        (
            {"depth": torch.ones(240, 320), "mask": torch.ones(24, 32), "camera": CAMERA},
            r"the mask is of shape \(24, 32\), but the depth image of \(240, 320\)",
        ),
        (
            {"depth": torch.ones(480, 640), "mask": torch.ones(480, 640), "camera": CAMERA},
            "is 640x480 but its camera is 320x240; the aspect agrees",
        ),
        (
            {"depth": torch.ones(100, 100), "mask": torch.ones(100, 100), "camera": K},
            "the principal point \\(160, 120\\) lies outside the image of 100x100",
        ),
        (
            {"depth": torch.ones(100, 100), "mask": torch.ones(100, 100), "camera": K.T},
            "it looks transposed",
        ),
        (
            {
                "depth": torch.ones(240, 320).int(),
                "mask": torch.ones(240, 320),
                "camera": dataclasses.replace(CAMERA, depth_unit_m=None),
            },
            "whole numbers, and nothing says of what",
        ),
        (
            {"depth": torch.ones(1, 240, 320), "mask": torch.ones(240, 320), "camera": CAMERA},
            r"the depth is of shape \(1, 240, 320\), not \(h, w\)",
        ),
    ],
)
def test_what_cannot_be_used_is_an_error(part: ObjectModel, given: dict, text: str) -> None:
    with pytest.raises(InputError, match=text):
        Oracle(tiny_weights(part), [pose_at()]).estimate(**given)


def test_of_several_instances_the_object_must_be_named(part: ObjectModel) -> None:
    net = Oracle(tiny_weights(part, bottle()), [pose_at()])
    with pytest.raises(InputError, match="the weights know bracket, bottle; say which by object="):
        net.estimate_instances(depth=torch.ones(4, 4), mask=torch.ones(4, 4), focal_px=5.0)


def line() -> torch.Tensor:
    return torch.linspace(0, 0.1, 200)[:, None] * torch.tensor([1.0, 0.5, 0.2]) + torch.tensor(
        [0.0, 0.0, 0.8]
    )


def plane() -> torch.Tensor:
    grid = torch.cartesian_prod(torch.linspace(0, 0.12, 30), torch.linspace(0, 0.1, 30))
    return torch.cat([grid, torch.full((900, 1), 0.8)], 1)


@pytest.mark.parametrize(
    ("name", "status", "text"),
    [
        ("empty", "too few points", "the cloud is empty"),
        ("three points", "too few points", "the cloud has 3 points, fewer than the 16"),
        ("NaN", "too few points", "the cloud has no point with finite coordinates"),
        ("line", "not observable", "the points lie on a line"),
        ("plane", "not observable", "the points lie in a plane"),
        ("one place", "not observable", "the points lie in one place"),
        ("millimetres", "unusable input", "times larger than the model: is it in mm?"),
        ("metres for mm", "unusable input", "times larger than the cloud: is it in mm?"),
        ("scene", "unusable input", "times larger than the model: is this the right object"),
        ("backward", "unusable input", "100% of the points lie behind the camera"),
        ("model's frame", "unusable input", "the cloud lies about the origin"),
        ("centred", "unusable input", "the cloud lies about the origin"),
        ("no return", "too few points", "is (0, 0, 0), no reading, in every point"),
    ],
)
def test_bad_clouds_are_refused_with_a_reason(
    part: ObjectModel, name: str, status: str, text: str
) -> None:
    cloud = cloud_of(part, pose_at())
    clouds = {
        "empty": cloud[:0],
        "three points": cloud[:3],
        "NaN": cloud * torch.nan,
        "line": line(),
        "plane": plane(),
        "one place": cloud[:1].expand(100, 3),
        "millimetres": 1000 * cloud,
        "metres for mm": 0.001 * cloud,
        "scene": (cloud - cloud.mean(0)) * 4.5 + torch.tensor([0.0, 0, 2]),
        "backward": -cloud,
        "model's frame": sample_surface(part, 2000)[0],
        "centred": sample_surface(part, 2000)[0] - sample_surface(part, 2000)[0].mean(0),
        "no return": 0 * cloud,
    }
    found = Oracle(tiny_weights(part), [pose_at()]).estimate(cloud=clouds[name])
    assert found.status == status
    assert text in found.reason
    assert found.camera_from_model is None


@pytest.mark.parametrize(
    ("name", "status", "text"),
    [
        ("no mask", "too few points", "the mask is empty"),
        ("no depth", "too few points", "the depth image has no reading at all"),
        ("no depth there", "too few points", "masked pixels has a depth reading"),
        ("millimetres", "unusable input", "times larger than the model: is it in mm?"),
        ("another K", "unusable input", "a K of another image size, changes the size of its cloud"),
    ],
)
def test_bad_views_are_refused_with_a_reason(
    part: ObjectModel, name: str, status: str, text: str
) -> None:
    depth_m, mask = view_of(part, pose_at())
    wide = K.clone()
    wide[0, 0] = wide[1, 1] = 100.0
    views = {
        "no mask": (depth_m, mask & False, K),
        "no depth": (torch.zeros(240, 320), mask, K),
        "no depth there": (torch.where(mask, 0.0, 1.0), mask, K),
        "millimetres": (1000 * depth_m, mask, K),
        "another K": (depth_m, mask, wide),
    }
    depth, pixels, camera = views[name]
    net = Oracle(tiny_weights(part), [pose_at()])
    found = net.estimate(depth=depth, mask=pixels, camera=camera)
    assert found.status == status
    assert text in found.reason


def test_some_nan_and_flying_pixels_do_no_harm(part: ObjectModel) -> None:
    truth = pose_at()
    cloud = cloud_of(part, truth)
    cloud[::10] = torch.nan
    cloud[5::10, 2] += 1.5
    assert_close(Oracle(tiny_weights(part), [truth]).estimate(cloud=cloud), truth)


def test_zeros_of_a_driver_are_no_points(part: ObjectModel) -> None:
    truth = pose_at()
    cloud = cloud_of(part, truth)
    organised = torch.cat([cloud, cloud.new_zeros(3 * len(cloud), 3)])
    assert_close(Oracle(tiny_weights(part), [truth]).estimate(cloud=organised), truth)


@pytest.mark.slow
def test_a_mesh_with_holes_and_bad_faces_serves_as_well(part: ObjectModel) -> None:
    faces = torch.cat([part.faces[3:], part.faces[5:8], torch.tensor([[1, 1, 2], [0, 0, 0]])])
    worn = dataclasses.replace(part, faces=faces)
    truth = pose_at()
    found = Oracle(tiny_weights(worn), [truth]).estimate(cloud=cloud_of(part, truth))
    assert_close(found, truth)


def test_a_million_points_are_thinned_first(part: ObjectModel) -> None:
    truth = pose_at()
    cloud = cloud_of(part, truth)
    many = cloud[torch.arange(1_000_000) * len(cloud) // 1_000_000]
    config = EstimateConfig(max_cloud_points=5000)
    weights = tiny_weights(part, cloud=CloudConfig(max_points=None))
    net = Oracle(weights, [truth], config=config)
    assert_close(net.estimate(cloud=many), truth)


def test_estimates_and_networks_are_one_readable_line() -> None:
    net = GeoPoseNet.load()
    assert repr(net) == (
        "GeoPoseNet(ResUNet of bracket, flange, mug, connector, spool, weights 'parts', cpu)"
    )
    assert repr(GeoPoseNet.from_pretrained("parts")) == repr(net)
    assert repr(GeoPoseNet.load("ycb")) == "GeoPoseNet(ResUNet of 21 objects, weights 'ycb', cpu)"
    pose = Rigid(torch.eye(3), torch.tensor([0.1, -0.25, 1.0]))
    found = PoseEstimate(
        name="a", object="mug", status="ok", camera_from_model=pose, certainty=0.99
    )
    assert repr(found) == "PoseEstimate(mug: ok, t_m=[0.1000, -0.2500, 1.0000], certainty 0.990)"
    none = PoseEstimate(name="a", object="mug", status="doubtful", reason="who knows")
    assert repr(none) == "PoseEstimate(mug: doubtful, who knows)"
