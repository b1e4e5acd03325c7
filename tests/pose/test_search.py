"""Objects by their models alone in whole depth images: planes, votes, and what is answered."""

import math
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import pytest
import torch
from tests.pose.synthetic_objects import (
    CAMERA,
    K,
    box_faces,
    bracket,
    bracket_surface,
    pose_at,
    view_of,
)

from depthpose.core.camera import Camera, back_project
from depthpose.core.rigid import Rigid, geodesic_rad, rotation_by
from depthpose.core.stopwatch import Stopwatch
from depthpose.pose import search
from depthpose.pose.cloud import cloud_from_depth, grow_mask
from depthpose.pose.config import EstimateConfig, RefusalConfig
from depthpose.pose.frame import crop_to_region, prepare_frame
from depthpose.pose.geometry.surface import prepare_surface
from depthpose.pose.inliers import frame_inliers, share_in_background
from depthpose.pose.inputs import view_input
from depthpose.pose.mesh import make_model
from depthpose.pose.metrics import add_m
from depthpose.pose.pipeline import register
from depthpose.pose.propose.image import propose_in_frame, score_by_image
from depthpose.pose.propose.point_pairs import prepare_pairs
from depthpose.pose.registration import Registration
from depthpose.pose.search import SearchTargets, find_objects
from depthpose.pose.sensor import SHARED_PER_WHITE
from depthpose.pose.synthetic.parts import make_part
from depthpose.pose.types import CloudInput, Evidence, ObjectModel, PoseEstimate, ViewInput
from depthpose.pose.verify.copies import find_copies
from depthpose.pose.verify.evidence import compare, observe
from depthpose.pose.verify.target_object import TargetObject

TRUTHS = [pose_at(-0.13, 0.7, seed=1), pose_at(0.12, 0.9, seed=2)]


@pytest.fixture(scope="module")
def net() -> Registration:
    made = Registration([bracket()])
    made.prepare()
    return made


def table() -> torch.Tensor:
    """Two brackets before a wall that leans back, seen with noise of half a millimetre."""
    v = torch.arange(240)[:, None].expand(240, 320)
    seen, mask = view_of(bracket(), *TRUTHS)
    noise = 0.0005 * torch.randn(240, 320, generator=torch.Generator().manual_seed(0))
    return torch.where(mask, seen.float(), 1.25 - 0.0005 * v.float()) + noise


def test_planes_go_and_objects_stay() -> None:
    depth_m = table()
    _, mask = view_of(bracket(), *TRUTHS)
    frame = prepare_frame(depth_m, K.float())
    is_plane = frame.background_limit_m >= bracket().diameter_m
    assert float(is_plane[~mask].float().mean()) > 0.95
    assert not bool(is_plane[mask].any())
    # A wall no wider than an object may be an object's side: it stays.
    assert not bool((frame.background_limit_m >= 5.0).any())


@pytest.mark.parametrize("skew", [0.0, 30.0])
def test_the_normals_of_a_plane_are_exact(skew: float) -> None:
    skewed = K.clone()
    skewed[0, 1] = skew
    normal = torch.tensor([-0.6, 0.3, -0.8], dtype=torch.float64)
    normal /= normal.norm()
    rays = back_project(torch.ones(240, 320).double(), skewed.double())
    frame = prepare_frame(-0.7 / (rays @ normal), skewed)
    cosine = frame.normals[frame.is_smooth] @ normal
    assert frame.is_smooth.any()
    assert float(cosine.min()) > 1 - 1e-9


def test_normals_are_those_of_the_surface() -> None:
    depth_m, mask = view_of(bracket(), TRUTHS[0])
    frame = prepare_frame(depth_m, K)
    surface = bracket_surface()
    assert frame.step == 1
    assert not bool(frame.is_smooth[~mask].any())
    inner = frame.is_smooth & mask
    local_m = TRUTHS[0].inverse().apply(frame.points_m[inner].float()).double()
    index = surface.nearest(local_m).sample
    cosine = (frame.normals[inner] * (surface.normals[index] @ TRUTHS[0].R.double().mT)).sum(-1)
    assert float((cosine.abs() > 0.98).double().mean()) > 0.85, "all but those at edges"
    assert bool(((frame.normals * frame.points_m).sum(-1)[inner] < 0).all()), "toward the camera"


def test_a_large_image_is_thinned() -> None:
    lens = torch.diag(torch.tensor([900.0, 900, 1]))
    frame = prepare_frame(torch.full((1200, 1600), 1.0), lens)
    assert frame.step == 5
    assert frame.depth_m.shape == (240, 320)
    assert float(frame.K[0, 0]) == 180


def test_a_plane_through_several_objects_is_no_plane() -> None:
    """Five blocks of one height in front of a wall: no plane through all of them cuts bands out."""
    depth_m = torch.full((240, 320), 1.2)
    mask = torch.zeros(240, 320).bool()
    for k in range(5):
        block = (slice(60, 180), slice(20 + 60 * k, 60 + 60 * k))
        depth_m[block] = (0.9 + 0.001 * torch.arange(120).float())[:, None]
        mask[block] = True
    is_plane = prepare_frame(depth_m, K.float()).background_limit_m >= 0.15
    assert bool(is_plane[~mask].all())
    assert not bool(is_plane[mask].any())


def test_a_plane_that_things_are_seen_behind_joins_the_tops_of_several_parts() -> None:
    """Touching bars before a wall: the wall is background, the tops of the bars are none.

    A board of the same size is, for nothing is seen behind it.
    """
    for is_board in (True, False):
        depth_m = torch.full((240, 320), 1.2)
        top = (1 / (1.1 - 0.0005 * torch.arange(120).float()))[:, None].expand(120, 240)
        is_top = torch.ones(120, 240).bool()
        if not is_board:
            is_top = (torch.arange(240) % 30 < 20).expand(120, 240).clone()
            is_top[:10] = is_top[110:] = True  # where they touch
        depth_m[60:180, 40:280] = torch.where(is_top, top, 1.2)
        is_background = prepare_frame(depth_m, K.float()).background_limit_m >= 0.15
        within = is_background[60:180, 40:280]
        assert float(within[is_top].float().mean()) == pytest.approx(float(is_board), abs=0.02)
        assert bool(is_background[:60].all())


def test_the_image_agrees_with_the_true_pose_and_with_none_beside_it() -> None:
    truth = TRUTHS[0].double()
    surface = bracket_surface()
    frame = prepare_frame(table(), K)
    aside = [Rigid(truth.R, truth.t_m + torch.tensor(shift).double())
             for shift in ([0.05, 0, 0], [0, 0, 0.06], [0, 0, -0.06])]  # fmt: skip
    score = score_by_image(frame, Rigid.stack([truth, *aside]), surface)
    assert float(score[0]) > 0.75, "at creases the normals of both are between those of two sides"
    assert float(score[1:].max()) < 0.1


def test_edges_that_a_sensor_cuts_contradict_no_pose_and_a_missing_half_does() -> None:
    """Stereo reads what is behind the object up to four pixels from its border."""
    model, truth = bracket(), TRUTHS[0]
    surface = bracket_surface()
    seen, mask = view_of(model, truth)
    cut, half = mask & ~grow_mask(mask, -4), mask.clone()
    half[:, : int(mask.nonzero()[:, 1].median())] = False
    pose = Rigid(truth.R.double(), truth.t_m.double())
    roughly, agreement = {}, {}
    for name, lost in (("cut", cut), ("half", half)):
        depth_m = torch.where(mask & ~lost, seen.float(), 1.25)
        frame = prepare_frame(depth_m, K.float())
        roughly[name] = float(score_by_image(frame, pose[None], surface))
        view = view_input(depth_m, mask & ~lost, CAMERA, model.name, "view", None)
        own_m = cloud_from_depth(depth_m, mask & ~lost, K.float())
        observation = observe(own_m, view, surface, is_masked=False)
        agreement[name] = compare(observation, pose, surface).agreement
    assert roughly["half"] < 0.2
    assert roughly["cut"] > 0.5
    assert agreement["half"] < 0.6 < agreement["cut"]


def nearest_m(poses: Rigid, truth: Rigid, model: ObjectModel) -> float:
    each = (poses[k].float() for k in range(len(poses.t_m)))
    return min(float(add_m(pose, truth, model.vertices_m)) for pose in each)


def test_point_pairs_propose_every_instance() -> None:
    model = bracket()
    surface = bracket_surface()
    frame = prepare_frame(table(), K)
    everywhere = torch.ones(frame.depth_m.shape, dtype=torch.bool)
    poses, score = propose_in_frame(frame, everywhere, prepare_pairs(surface))
    expected = score_by_image(frame, poses, surface)
    assert torch.allclose(score, expected)
    assert bool((score.diff() <= 1e-9).all()), "what the image agrees with best comes first"
    for truth in TRUTHS:
        assert nearest_m(poses, truth, model) < 0.06 * model.diameter_m


def test_what_is_no_longer_left_votes_for_nothing() -> None:
    """Without the pixels of one of two instances, the other is proposed alone."""
    model = bracket()
    surface = bracket_surface()
    frame = prepare_frame(table(), K)
    middle_m = TRUTHS[0].apply(model.vertices_m.mean(0, keepdim=True)).double()[0]
    is_left = ~((frame.points_m - middle_m).norm(dim=-1) < model.diameter_m)
    poses, _ = propose_in_frame(frame, is_left, prepare_pairs(surface))
    assert nearest_m(poses, TRUTHS[0], model) > 0.3 * model.diameter_m
    assert nearest_m(poses, TRUTHS[1], model) < 0.06 * model.diameter_m


def turns_of(model: ObjectModel) -> Rigid:
    copies = find_copies(model)
    return Rigid.cat([copies.near_copies, copies.lookalikes])


@pytest.mark.slow
@pytest.mark.parametrize("is_handle_first", [False, True])
def test_a_mug_turned_about_its_axis_looks_alike_but_for_its_handle(is_handle_first: bool) -> None:
    mug = make_part("mug")  # its handle comes last
    turns = turns_of(replace(mug, faces=mug.faces.flip(0)) if is_handle_first else mug)
    upright = turns.R[turns.R[:, 2, 2] > 0.99]
    angle = torch.atan2(upright[:, 1, 0], upright[:, 0, 0]).rad2deg()
    every = torch.arange(-180.0, 180.0, 5.0)[:, None]
    apart = ((every - torch.cat([angle, torch.zeros(1)]) + 180) % 360 - 180).abs().amin(1)
    assert float(apart.max()) <= 20, "by any angle"


def test_half_turns_lay_half_of_a_part_on_itself() -> None:
    turns = turns_of(make_part("connector"))
    angle = geodesic_rad(turns.R, torch.eye(3).double().expand_as(turns.R)).rad2deg()
    assert len(angle) > 0
    assert float(angle.max()) > 170


def test_a_needle_of_few_points_can_be_looked_for_in_itself() -> None:
    corners, faces = box_faces()
    needle = make_model(corners * torch.tensor([0.002, 0.002, 0.2]), faces, name="needle")
    pairs = prepare_pairs(prepare_surface(needle))
    assert len(pairs.points_m) < 48, "fewer than each of them would propose"
    assert turns_of(needle).R.shape[1:] == (3, 3)


@pytest.mark.parametrize("handle", ["seen", "hidden"])
def test_the_handle_of_a_mug_decides_its_turn(handle: str) -> None:
    """A mug on its side: its handle is toward the camera, or hidden, and any turn fits."""
    mug = make_part("mug")
    toward = -1.0 if handle == "seen" else 1.0  # the camera looks along z, the handle is at x
    R = torch.tensor([[0.0, -toward, 0], [0, 0, -1], [toward, 0, 0]])
    truth = Rigid(R, torch.tensor([0.0, 0.05, 0.6]))
    seen, mask = view_of(mug, truth)
    depth_m = torch.where(mask, seen.float(), 1.2)
    (found,) = Registration([mug]).find(depth_m, CAMERA)
    assert found.camera_from_model is not None, found.reason
    error_m = float(add_m(found.camera_from_model, truth, mug.vertices_m))
    if handle == "seen":
        assert error_m < 0.05 * mug.diameter_m
        return
    named = [found.camera_from_model, *(other.camera_from_model for other in found.alternatives)]
    assert min(float(add_m(pose, truth, mug.vertices_m)) for pose in named) < 0.2 * mug.diameter_m
    assert found.certainty is not None
    assert found.copy_certainty is not None
    assert found.copy_certainty < 0.5 * found.certainty


def test_turns_that_fit_as_well_are_named() -> None:
    """The handle of a mug is not among the readings: every turn fits, and the true one is named."""
    mug = make_part("mug")
    R = torch.tensor([[1.0, 0, 0], [0, 0.6, 0.8], [0, -0.8, 0.6]])
    truth = Rigid(R, torch.tensor([0.0, 0.05, 0.6]))
    seen, mask = view_of(mug, truth)
    local_m = truth.inverse().apply(back_project(seen, K).float())
    view = view_input(seen, mask & (local_m[..., 0] < 0.043), CAMERA, "mug", "view", None)
    cloud = CloudInput(name="view", points_m=cloud_from_depth(seen, view.mask, K), object="mug",
                       view=view)  # fmt: skip
    net = Registration([mug])
    found = register(
        cloud,
        net._find_object("mug").prepare(),
        EstimateConfig(refusal=RefusalConfig(min_observability=0.0, min_probability=0.0)),
        Stopwatch(),
        proposals=truth[None],
        is_expected=False,
    )
    assert found.camera_from_model is not None
    named = [found.camera_from_model, *(one.camera_from_model for one in found.alternatives)]
    assert len(named) > 5
    assert min(float(add_m(pose, truth, mug.vertices_m)) for pose in named) < 0.1 * mug.diameter_m


@pytest.mark.parametrize(
    "depth_m",
    [
        torch.full((240, 320), torch.nan),
        torch.full((240, 320), 0.7),
        0.5 + 0.4 * torch.rand(240, 320, generator=torch.Generator().manual_seed(0)),
        torch.full((3, 2), 0.5),
    ],
    ids=["no reading", "a wall", "noise", "six pixels"],
)
def test_where_nothing_is_nothing_is_found_soon(depth_m: torch.Tensor, net: Registration) -> None:
    height, width = depth_m.shape
    small = torch.tensor([[500.0, 0, width / 2], [0, 500, height / 2], [0, 0, 1]]).double()
    began = time.process_time()
    (found,) = net.find(depth_m, Camera(width=width, height=height, K=small))
    assert not found.is_posed
    assert time.process_time() - began < 10


@pytest.mark.slow
def test_a_model_larger_than_the_view_has_an_answer_soon() -> None:
    """Of a part ten times as large a corner fills the image: an answer or none, in bounded time."""
    small = bracket()
    large = make_model(10 * small.vertices_m, small.faces, name="large")
    began = time.process_time()
    found = Registration([large]).find(table(), CAMERA)
    assert not any(estimate.is_ok for estimate in found), "two small parts before a wall are none"
    assert time.process_time() - began < 20


@pytest.mark.slow
def test_forty_models_take_bounded_time(net: Registration, monkeypatch: pytest.MonkeyPatch) -> None:
    """Forty of one shape: what is there may be any of them, so none is answered."""
    view = view_input(table(), None, CAMERA, "bracket", "input", None)
    registered = list[str]()

    def count(
        cloud: CloudInput, target: TargetObject, config: EstimateConfig, watch: Stopwatch,
        **options: Any,  # noqa: ANN401
    ) -> PoseEstimate:  # fmt: skip
        registered.append(cloud.name)
        return register(cloud, target, config, watch, **options)

    monkeypatch.setattr(search, "register", count)
    target = net._find_object("bracket").prepare()
    objects: dict[str, TargetObject] = {}
    for k in range(40):
        model = replace(target.model, name=f"part {k}")
        copy = TargetObject(number=k, model=model)
        copy.surface, copy.copies, copy.pairs = target.surface, target.copies, target.pairs
        objects[model.name] = copy
    targets = replace(TARGETS, objects=objects)
    began = time.process_time()
    assert not any(estimate.is_posed for estimate in find_objects(view, targets))
    assert len(registered) <= 160, "which bounds the memory too"
    assert time.process_time() - began < 60


EVIDENCE = Evidence(
    visible=20.0, supported=20.0, explained=20.0,
    unobserved=0.0, seen_through=0.0, bulging=0.0, beside=0.0, silhouette=0.0, continued=0.0,
    rms=0.5, noise_m=0.001,
)  # fmt: skip


def registered(
    object: str, log_odds: float, columns: slice, number: int = 0, seen_through: float = 0.0
) -> search.Candidate:
    """A candidate that explains some columns of an image of 4 x 40, of a certainty of 1."""
    inliers = torch.zeros(4, 40, dtype=torch.bool)
    inliers[:, columns] = True
    pose = pose_at(0.01 * number, 0.7, seed=number).double()
    evidence = replace(EVIDENCE, seen_through=seen_through, supported=20.0 - seen_through)
    estimate = PoseEstimate(
        name="", object=object, status="ok", certainty=1.0, copy_certainty=1.0,
        camera_from_model=pose.float(), evidence=evidence,
    )  # fmt: skip
    return search.Candidate(
        object=object, surface=PREPARED.surface, pose=pose, inliers=inliers, evidence=evidence,
        log_odds=log_odds, estimate=estimate,
    )  # fmt: skip


PREPARED = TargetObject(number=0, model=bracket())
TARGETS = SearchTargets(
    objects={"a": PREPARED, "b": PREPARED, "c": PREPARED},
    config=EstimateConfig(),
)


def suppress(
    candidates: Sequence[search.Candidate], claimed: Sequence[search.Candidate] = ()
) -> tuple[list[search.Candidate], dict[str, str]]:
    """The candidates that stay, and of the others, by their objects, why they do not."""
    maxima, suppressed = search._suppress(candidates, claimed)
    weighed = search._weigh_objects(maxima, candidates)
    rejected = {one.object: one.rejected for one in [*suppressed, *weighed] if one.rejected}
    return search._remaining(weighed), rejected


def test_what_may_be_either_of_two_objects_stays_unanswered_in_later_rounds() -> None:
    both = [registered("a", 2.0, slice(0, 10)), registered("b", 1.9, slice(0, 10))]
    kept, rejected = suppress(both)
    assert kept == []
    assert rejected == {
        "a": "what lies there may be b as well",
        "b": "what lies there is more likely a",
    }
    maxima, _ = search._suppress(both, [])
    assert suppress(both[:1], maxima)[0] == []


def test_the_object_whose_pose_is_contradicted_less_is_answered() -> None:
    both = [
        registered("a", 4.0, slice(0, 10)),
        registered("b", -4.0, slice(0, 10), seen_through=12.0),
    ]
    (kept,), _ = suppress(both)
    assert kept.object == "a"
    assert kept.estimate is not None
    assert kept.estimate.certainty is not None
    assert 0.8 < kept.estimate.certainty < 1


def test_an_object_of_a_small_share_is_not_answered_as_another() -> None:
    """By its log odds ``a`` is likelier, by its evidence ``b``: neither is taken for the other."""
    both = [
        registered("a", 5.0, slice(0, 10), seen_through=12.0),
        registered("b", 4.0, slice(0, 10)),
    ]
    kept, rejected = suppress(both)
    assert kept == []
    assert rejected["a"] == "what lies there may be b as well"


def test_what_lies_on_something_surer_is_no_rival_of_what_is_beside_it() -> None:
    """``b`` shares a third with ``a``, which is surer, and most with ``c``: ``c`` is itself."""
    candidates = [
        registered("a", 5.0, slice(0, 20)),
        registered("b", 4.0, slice(13, 33), 1),
        registered("c", 2.0, slice(20, 40), 2),
    ]
    kept, _ = suppress(candidates)
    assert [candidate.object for candidate in kept] == ["a", "c"]
    assert [one.estimate.object for one in kept if one.estimate is not None] == ["a", "c"]


def test_poses_of_one_object_on_the_same_readings_are_one_answer() -> None:
    candidates = [registered("a", 3.0, slice(0, 20)), registered("a", 2.0, slice(10, 24), 1)]
    kept, rejected = suppress(candidates)
    assert [candidate.log_odds for candidate in kept] == [3.0]
    assert not rejected, "it is no other thing that was refused"


def of_one_object(*log_odds: float) -> list[search.Candidate]:
    """Instances of one object, whose probabilities are those of their log odds."""
    instances = list[search.Candidate]()
    for k, odds in enumerate(log_odds):
        instance = registered("a", odds, slice(8 * k, 8 * k + 8), k)
        instances.append(with_certainty(instance, 1 / (1 + math.exp(-odds))))
    return instances


def with_certainty(instance: search.Candidate, certainty: float) -> search.Candidate:
    assert instance.estimate is not None
    return replace(instance, estimate=replace(instance.estimate, certainty=certainty))


def certainties(instances: Sequence[search.Candidate]) -> list[float | None]:
    return [one.estimate.certainty for one in instances if one.estimate is not None]


def test_a_second_place_needs_more_than_the_first() -> None:
    """Two to one is enough for what is there once, and too little beside what is surely there."""
    (alone,) = search._weigh_instances(of_one_object(math.log(2)), TARGETS)
    assert not alone.rejected
    (certainty,) = certainties([alone])
    assert certainty is not None
    assert 0.6 < certainty < 0.7
    first, second = search._weigh_instances(of_one_object(5.0, math.log(2)), TARGETS)
    assert first.log_odds == 5
    assert not first.rejected
    assert "other poses and places" in second.rejected


def test_a_place_that_another_pose_explains_as_well_is_a_miss() -> None:
    """The place is right with 99 %, but each of two poses there with less than a half."""
    (instance,) = of_one_object(5.0)
    (undecided,) = search._weigh_instances([with_certainty(instance, 0.47)], TARGETS)
    assert "47%" in undecided.rejected


def test_a_box_holds_one() -> None:
    """Of two places in a box that are as likely neither is; in a whole frame both may be right."""
    instances = of_one_object(math.log(20), math.log(20))
    assert len(search._remaining(search._weigh_instances(instances, TARGETS))) == 2
    weighed = search._weigh_instances(instances, replace(TARGETS, instances="one at most"))
    assert all("49%" in instance.rejected for instance in weighed), "20 of 41"


def test_in_a_bin_of_many_each_is_as_likely_as_alone() -> None:
    bin_of_six = of_one_object(5.0, 5.0, 5.0, 5.0, 5.0, math.log(2))
    weighed = search._weigh_instances(bin_of_six, TARGETS)
    assert search._remaining(weighed) == weighed
    assert certainties(weighed) == pytest.approx(certainties(bin_of_six), abs=0.01)


def test_what_would_lie_in_the_wall_is_not_possible(net: Registration) -> None:
    """The wall hides no half of an object that is seen before it; a gap in the wall may."""
    surface = net._find_object("bracket").prepare().surface
    pose = pose_at(0.0, 1.19, seed=1)  # the wall is 1.2 m away there
    seen, mask = view_of(bracket(), pose)
    wall = table()
    wall[:, 100:220] = 1.25 - 0.0005 * torch.arange(240)[:, None]  # neither bracket
    depth_m = torch.where(mask, torch.minimum(seen.float(), wall), wall)
    frame = prepare_frame(depth_m, K.float())
    assert share_in_background(frame, pose.double(), surface) > search._MOST_SUNK
    before = Rigid(pose.R, pose.t_m - torch.tensor([0.0, 0.0, 0.15]))
    assert share_in_background(frame, before.double(), surface) <= search._MOST_SUNK
    gap = replace(frame, depth_m=torch.where(grow_mask(mask, 12), 3.0, frame.depth_m))
    assert share_in_background(gap, pose.double(), surface) <= search._MOST_SUNK


def test_proposals_at_one_place_leave_room_for_others(
    net: Registration, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Sixty lie on a first part, and only then some on a second: these are looked at too."""
    target = net._find_object("bracket").prepare()
    truths = [pose_at(x_m).double() for x_m in (-0.15, 0.15)]
    depth_m, _ = view_of(target.model, *(truth.float() for truth in truths))
    view = view_input(depth_m.float(), None, CAMERA, "bracket", "x", None)
    frame = prepare_frame(view.depth_m, view.K, target.surface.diameter_m)
    first, second = truths
    names = ["a", "b"]

    def propose(*_: object) -> tuple[Rigid, torch.Tensor]:
        return Rigid.stack([first] * 30 + [second] * 3), torch.linspace(1.0, 0.5, 33)

    monkeypatch.setattr(search, "propose_in_frame", propose)
    targets = replace(TARGETS, objects=dict.fromkeys(names, target))
    everywhere = torch.ones_like(frame.depth_m, dtype=torch.bool)
    candidates = search._propose(frame, everywhere, names, [], targets)
    at_first = [one for one in candidates if torch.equal(one.pose.t_m, first.t_m)]
    at_second = [one.object for one in candidates if torch.equal(one.pose.t_m, second.t_m)]
    assert at_second == names, "one more place of each, not one more pose at a place"
    assert len(at_first) == search._MOST_PROPOSALS


def test_the_best_evidence_leads_a_place_not_the_first_proposal(
    net: Registration, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each proposal is refined on what it explains: a coarse right one passes a wrong one."""
    target = net._find_object("bracket").prepare()
    truth = pose_at()
    depth_m, _ = view_of(target.model, truth)
    view = view_input(depth_m.float(), None, CAMERA, "bracket", "x", None)
    frame = prepare_frame(view.depth_m, view.K, target.surface.diameter_m)
    half_turn = rotation_by(torch.tensor([0.0, 0.0, math.pi]).double())
    coarse = Rigid(truth.R.double(), truth.t_m.double() + torch.tensor([0.002, 0.001, 0.003]))
    wrong = Rigid(truth.R.double() @ half_turn, coarse.t_m)
    surface = target.surface
    candidates = [
        search.Candidate(
            object="bracket", surface=surface, pose=pose,
            inliers=frame_inliers(frame, pose, surface),
        )
        for pose in (wrong, coarse)
    ]  # fmt: skip
    targets = replace(TARGETS, objects={"bracket": target})
    refined = search._refine(candidates, frame, view, targets)
    assert not any(candidate.rejected for candidate in refined)
    leader = search._group(refined)[0][0]
    assert float((leader.pose.t_m - truth.t_m).norm()) < 0.001, "refined"
    assert float(geodesic_rad(leader.pose.R.float(), truth.R.float())) < 0.1

    monkeypatch.setattr(search, "LEAST_POSSIBLE", 1.1)
    hopeless = search._refine(candidates, frame, view, targets)
    for candidate, other in zip(hopeless, refined, strict=True):
        assert candidate.rejected
        assert torch.equal(candidate.pose.t_m, other.pose.t_m), "it is a miss where it was compared"


def test_what_is_there_twice_is_searched_for_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two of ``a`` and one of ``b`` at first, then a third ``a``, the surest; then nothing."""
    small = torch.tensor([[300.0, 0, 20], [0, 300, 2], [0, 0, 1]]).double()
    camera = Camera(width=40, height=4, K=small)
    view = view_input(torch.full((4, 40), 0.7), None, camera, "a", "x", None)
    rounds = [
        [registered("a", 7.0, slice(0, 8)), registered("a", 6.0, slice(8, 16), 1),
         registered("b", 5.0, slice(16, 24), 2)],
        [registered("a", 8.0, slice(24, 32), 3)],
        [],
    ]  # fmt: skip
    searched = list[tuple[Sequence[str], int]]()

    def propose(
        _: object, is_left: torch.Tensor, names: Sequence[str], *rest: object
    ) -> list[object]:
        del rest
        searched.append((list(names), int(is_left[0].sum())))
        return []

    monkeypatch.setattr(search, "_propose", propose)
    monkeypatch.setattr(search, "rank_picks", lambda estimates, *_: estimates)
    monkeypatch.setattr(search, "_register", lambda *_: rounds[len(searched) - 1])
    targets = replace(TARGETS, objects={"a": PREPARED, "b": PREPARED})
    found = find_objects(view, targets)
    assert searched == [(["a", "b"], 40), (["a"], 16), (["a"], 8)]
    assert [estimate.object for estimate in found] == ["a", "a", "a", "b"], "the surest first"
    assert [estimate.name for estimate in found] == ["x_0", "x_1", "x_2", "x_3"]
    searched.clear()
    single = find_objects(view, replace(targets, instances="one at most"))
    assert [estimate.object for estimate in single] == ["a", "b"], "searched once, one of each"


def test_every_instance_is_found_once_and_nothing_else(net: Registration) -> None:
    found = net.find(table(), CAMERA)
    assert [estimate.name for estimate in found] == ["input_0", "input_1"]
    for truth in TRUTHS:
        poses = [e.camera_from_model for e in found]
        errors = [float(add_m(p, truth, bracket().vertices_m)) for p in poses if p is not None]
        assert min(errors) < 0.01


def test_a_box_finds_the_object_that_its_mask_does(net: Registration) -> None:
    """A detector's box shows a part of the wall too, and of no other object."""
    depth_m = table()
    for truth in TRUTHS:
        _, mask = view_of(bracket(), truth)
        rows, columns = mask.any(1).nonzero()[:, 0], mask.any(0).nonzero()[:, 0]
        edges = (int(columns[0]) - 6, int(rows[0]) - 6, int(columns[-1]) + 7, int(rows[-1]) + 7)
        by_box = net.estimate(depth=depth_m, box=edges, camera=CAMERA, object="bracket")
        assert by_box.camera_from_model is not None, by_box.reason
        assert float(add_m(by_box.camera_from_model, truth, bracket().vertices_m)) < 0.005
        assert by_box.name == "input"
        assert "search" in by_box.seconds
        by_mask = net.estimate(depth=depth_m, mask=mask.numpy(), camera=CAMERA, object="bracket")
        assert by_mask.camera_from_model is not None, by_mask.reason
        apart_m = add_m(by_box.camera_from_model, by_mask.camera_from_model, bracket().vertices_m)
        assert float(apart_m) < 0.005


def test_a_box_without_the_object_is_refused(net: Registration) -> None:
    found = net.estimate(depth=table(), box=(130, 180, 200, 235), camera=CAMERA, object="bracket")
    assert found.camera_from_model is None
    assert found.reason


def test_a_mask_that_does_not_fit_is_searched_as_a_region(net: Registration) -> None:
    """A loose mask shows wall beside the object, which is no evidence against the right pose."""
    _, mask = view_of(bracket(), TRUTHS[0])
    loose = grow_mask(mask, 12)
    found = net.estimate(depth=table(), mask=loose.numpy(), camera=CAMERA, object="bracket")
    assert found.camera_from_model is not None, found.reason
    assert float(add_m(found.camera_from_model, TRUTHS[0], bracket().vertices_m)) < 0.005


def test_a_window_has_the_noise_of_the_whole_image() -> None:
    """White noise shows that neighbours share none; a small window shows too few of them."""
    random = torch.Generator().manual_seed(0)
    depth_m = 1 + 0.001 * torch.randn(240, 320, generator=random)
    mask = torch.zeros(240, 320, dtype=torch.bool)
    mask[100:120, 100:120] = True
    whole = ViewInput(name="x", depth_m=depth_m, mask=mask, K=K.float(), object="bracket")
    window = crop_to_region(whole)
    assert window.depth_m.shape < whole.depth_m.shape
    assert window.shared_per_white == whole.shared_per_white < SHARED_PER_WHITE
    assert replace(window, whole_m=None).shared_per_white == SHARED_PER_WHITE


def test_a_box_of_any_object_needs_more_evidence(
    net: Registration, monkeypatch: pytest.MonkeyPatch
) -> None:
    instances: list[str] = []

    def record(view: ViewInput, targets: SearchTargets) -> list[PoseEstimate]:
        instances.append(targets.instances)
        return [PoseEstimate(name=view.name, object=view.object, status="doubtful", reason="x")]

    monkeypatch.setattr("depthpose.pose.estimator.find_objects", record)
    region = ViewInput(
        name="x", depth_m=table(), mask=torch.ones(240, 320, dtype=torch.bool), K=K.float(),
        object="bracket", is_region=True,
    )  # fmt: skip
    net._search_region(region)
    net._search_region(region, is_expected=False)
    assert instances == ["one", "one at most"]
