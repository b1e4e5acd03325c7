"""Poses without training: point pairs of a CAD file and of a cloud, ICP, refusal."""

import pickle
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
import torch
from bench.negatives import random_part
from tests.pose.synthetic_objects import K, pose_at, view_of, write_part

from depthpose import GeoPoseNet, Registration
from depthpose.core.checkpoint import find_weights
from depthpose.core.errors import InputError
from depthpose.core.rigid import Rigid, geodesic_rad
from depthpose.pose.cloud import cloud_from_depth
from depthpose.pose.config import EstimateConfig, ObjectsConfig, VotingConfig
from depthpose.pose.geometry.surface import prepare_surface
from depthpose.pose.mesh import make_model, sample_surface
from depthpose.pose.metrics import add_m
from depthpose.pose.network_pose import CloudJob
from depthpose.pose.propose.point_pairs import prepare_pairs, propose_poses
from depthpose.pose.refusals import Refused
from depthpose.pose.synthetic import SyntheticViews, make_part
from depthpose.pose.types import CloudInput, CloudSample, ObjectModel, PoseEstimate, ViewInput
from depthpose.pose.weights import read_pose_weights


@cache
def part() -> ObjectModel:
    return make_part("connector")


@cache
def registration() -> Registration:
    return Registration([part()])


def view(model: ObjectModel, index: int, seed: int = 5) -> CloudSample:
    config = ObjectsConfig(views=None, resolution=(1.0, 1.0), occluded_share=0.0, seed=seed)
    return SyntheticViews([model], config)[index]


def test_poses_of_a_part_that_no_training_saw_are_right_or_refused() -> None:
    samples = [view(part(), index) for index in range(4)]
    found = registration().estimate_many([sample.input for sample in samples])
    points_m = sample_surface(part(), 500)[0]
    poses = [(one.camera_from_model, sample.truth.camera_from_model)
             for one, sample in zip(found, samples, strict=True)]  # fmt: skip
    errors_m = [float(add_m(pose, truth, points_m)) for pose, truth in poses if pose is not None]
    assert len(errors_m) >= 3
    assert max(errors_m) < 0.05 * part().diameter_m
    for one in found:
        assert one.evidence is not None
        assert {"cloud", "proposal", "icp", "evidence", "decision"} <= one.seconds.keys()


def test_what_it_registers_is_said() -> None:
    assert repr(registration()) == "Registration(of connector)"


def test_another_process_can_be_given_it() -> None:
    registration().estimate_many([view(part(), 0).input])  # what it keeps of its model goes along
    other = pickle.loads(pickle.dumps(registration()))
    assert other.objects == registration().objects


def test_two_threads_give_what_one_gives_and_an_error_costs_nothing() -> None:
    given = [view(part(), index).input for index in range(3)]
    given.insert(1, replace(given[0], object="conector"))
    alone = registration().estimate_many(given)
    together = registration().estimate_many(iter(given), threads=2)
    assert alone[1].status == together[1].status == "unreadable"
    assert "did you mean 'connector'" in alone[1].reason
    for one, other in zip(alone, together, strict=True):
        assert one.status == other.status
        if one.camera_from_model is not None and other.camera_from_model is not None:
            assert torch.equal(one.camera_from_model.t_m, other.camera_from_model.t_m)


@pytest.mark.parametrize("index", range(3))
def test_a_foreign_part_is_refused(index: int) -> None:
    foreign = make_part("mug") if index == 0 else random_part(torch.Generator().manual_seed(index))
    given = replace(view(foreign, index).input, object="connector")
    assert not registration().estimate_many([given])[0].is_ok


def test_a_cloud_in_the_frame_of_a_robot_is_refused_and_its_frame_is_named() -> None:
    """A camera saw the part from above; the points are in the base's frame, z up."""
    z_up = torch.tensor([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
    for index in (0, 1, 6):  # doubtful, and ambiguous the last
        points_m = view(part(), index).input.points_m.float()
        base_m = (points_m - points_m.mean(0)) @ z_up.T + torch.tensor([0.05, 0.04, 0.35])
        found = registration().estimate(cloud=base_m)
        assert not found.is_ok
        assert "A robot's base and the world have z up" in found.reason


def test_one_seed_gives_one_answer() -> None:
    given = view(part(), 0).input
    first, again = (registration().estimate_many([given])[0] for _ in range(2))
    other = Registration([part()], EstimateConfig(voting=VotingConfig(seed=0)))
    apart = other.estimate_many([given])[0]
    assert first.certainty == again.certainty == apart.certainty
    assert first.camera_from_model is not None
    assert apart.camera_from_model is not None
    assert torch.equal(first.camera_from_model.R, apart.camera_from_model.R)


def test_pairs_find_the_pose_whatever_side_the_faces_look_at() -> None:
    """Some CAD programs write faces inside out, and scans have them mixed."""
    inside_out = replace(part(), faces=part().faces.flip(-1))
    points_m, normals = (x.double() for x in sample_surface(part(), 600))
    truth = Rigid(torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(1))
                                  .double()).Q, torch.tensor([0.0, 0.0, 0.8]).double())  # fmt: skip
    truth = replace(truth, R=truth.R * truth.R.det())
    seen_m, towards = truth.apply(points_m), normals @ truth.R.mT
    faces_us = (towards * seen_m).sum(-1) < 0
    for model in (part(), inside_out):
        pairs, generator = prepare_pairs(prepare_surface(model)), torch.Generator().manual_seed(0)
        found = propose_poses(seen_m[faces_us], towards[faces_us], pairs, 5, generator)
        off = geodesic_rad(found.R, truth.R.expand_as(found.R))
        assert float(off.min()) < 0.3


def test_copies_of_a_symmetric_part_are_one_answer() -> None:
    flange = make_part("flange")
    sample = view(flange, 1)
    found = Registration([flange]).estimate_many([sample.input])[0]
    assert found.is_posed, found.reason
    assert all("degrees about" in other.difference for other in found.alternatives)
    assert not any(other.probability > 0.4 for other in found.alternatives)


def test_cad_files_are_read_and_their_symmetries_found(tmp_path: Path) -> None:
    net = Registration.load(write_part("flange", tmp_path), unit="mm")
    assert net.objects == ("flange",)
    assert not net.models[0].symmetries.is_none


def test_models_that_cannot_be_looked_for_are_named() -> None:
    with pytest.raises(InputError, match=r"none is given; name one: STL"):
        Registration([])
    with pytest.raises(
        InputError, match=r"two models are called 'connector' \(numbers 1 and 2: .*rename one"
    ):
        Registration([replace(part(), number=number) for number in (1, 2)])
    corners = make_model(part().vertices_m[:60], torch.zeros(0, 3).long(), name="dots")
    with pytest.raises(InputError, match=r"dots: 60 points without faces.*triangles, such as STL"):
        Registration([corners])
    with pytest.raises(InputError, match=r"'mug': the models do not know it"):
        registration().estimate(cloud=torch.ones(30, 3), object="mug")


def test_registration_without_icp_is_an_error() -> None:
    with pytest.raises(InputError, match="registration refines by ICP"):
        Registration([part()], EstimateConfig(with_icp=False))


class Doubting(GeoPoseNet):
    """A network that takes none of its own answers."""

    def _estimate_by_votes(self, job: CloudJob) -> PoseEstimate:
        raise Refused("doubtful", f"{job.target.model.name} is doubted")


@cache
def doubting_net() -> GeoPoseNet:
    weights = read_pose_weights(find_weights("parts"))
    return Doubting(weights, EstimateConfig(register_refused=True))


def test_what_the_network_doubts_is_registered_where_wanted() -> None:
    model = next(m for m in doubting_net().models if m.name == "connector")
    samples = [view(model, index) for index in range(4)]
    found = doubting_net().estimate_many([sample.input for sample in samples])
    answered = [(f, s) for f, s in zip(found, samples, strict=True) if f.is_posed]
    assert len(answered) >= 2
    points_m = sample_surface(model, 500)[0]
    for one, sample in answered:
        assert one.camera_from_model is not None
        error_m = add_m(one.camera_from_model, sample.truth.camera_from_model, points_m)
        assert float(error_m) < 0.05 * model.diameter_m
        assert "network" in one.seconds
        assert "registration" in one.seconds


def test_registration_that_finds_nothing_leaves_the_network_s_reason() -> None:
    given = replace(view(make_part("mug"), 0).input, object="connector")
    found = doubting_net().estimate_many([given])[0]
    assert (found.status, found.reason) == ("doubtful", "connector is doubted")
    assert "registration" in found.seconds


def test_registration_that_fails_leaves_the_votes(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> PoseEstimate:
        raise InputError("the memory is full")

    monkeypatch.setattr(Doubting, "_register_or_search", fail)
    found = doubting_net().estimate_many([view(make_part("connector"), 0).input])[0]
    assert (found.status, found.reason) == ("doubtful", "connector is doubted")


@pytest.mark.slow
def test_regions_that_may_show_anything_are_not_registered() -> None:
    samples = [view(make_part("connector"), index) for index in range(2)]
    cloud_m = samples[0].input.points_m
    found = doubting_net().estimate(cloud=cloud_m.numpy(), object=None)
    assert not found.is_ok
    assert "registration" not in found.seconds


def test_what_a_network_refuses_is_registered_by_networks_that_vote() -> None:
    with pytest.raises(InputError, match="no network whose refusals it could register; omit"):
        Registration([part()], EstimateConfig(register_refused=True))


def test_registration_of_what_is_refused_needs_icp() -> None:
    with pytest.raises(InputError, match="registration refines by ICP"):
        EstimateConfig(register_refused=True, with_icp=False)


def test_a_cloud_beside_its_depth_image_is_refused() -> None:
    depth_m, mask = view_of(part(), pose_at())
    of_image = ViewInput(name="x", depth_m=depth_m, mask=mask, K=K, object=part().name)
    points_m = cloud_from_depth(depth_m, mask, K)
    inside = CloudInput(name="in", points_m=points_m, object=part().name, view=of_image)
    aside_m = points_m + torch.tensor([0.6, 0.0, 0.0])
    refused, posed = registration().estimate_many([replace(inside, points_m=aside_m), inside])
    assert posed.is_posed
    assert refused.status == "unusable input"
    assert "100% of the points lie outside the" in refused.reason
