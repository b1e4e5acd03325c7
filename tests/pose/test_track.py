"""One object through synthetic frames: followed by ICP, lost where it is not, and found anew."""

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from tests.pose.synthetic_objects import (
    CAMERA,
    K,
    Oracle,
    bottle,
    bracket,
    bracket_surface,
    cloud_of,
    pose_at,
    tiny_weights,
    view_of,
)

from depthpose.core.camera import back_project
from depthpose.core.errors import InputError
from depthpose.core.rigid import Rigid, rotation_by
from depthpose.pose import track as track_module
from depthpose.pose.background import add_background
from depthpose.pose.config import EstimateConfig
from depthpose.pose.metrics import add_m
from depthpose.pose.predictions import Prediction, parse_prediction, prediction_row
from depthpose.pose.refusals import Refused
from depthpose.pose.registration import Registration
from depthpose.pose.track import track
from depthpose.pose.types import Alternative, CloudInput, PoseEstimate, ViewInput
from depthpose.pose.verify.target_object import TargetObject

HIDDEN = 0.68


def moving(count: int, step_m: float = 0.008, step_deg: float = 2.0) -> list[Rigid]:
    """A bracket that goes to the right and turns, frame after frame."""
    pose, poses = pose_at(-0.08, 0.7, seed=3), []
    axis = torch.nn.functional.normalize(torch.tensor([1.0, 2.0, 0.5]), dim=0)
    turn = rotation_by(math.radians(step_deg) * axis)
    for _ in range(count):
        poses.append(pose)
        pose = Rigid(turn @ pose.R, pose.t_m + torch.tensor([step_m, 0, 0]))
    return poses


def frame(truth: Rigid | None, seed: int = 0) -> torch.Tensor:
    """A depth image before a leaning wall; None: of the wall alone."""
    v = torch.arange(240)[:, None].expand(240, 320)
    depth_m = 1.25 - 0.0005 * v.float()
    if truth is not None:
        seen, mask = view_of(bracket(), truth)
        depth_m = torch.where(mask, seen.float(), depth_m)
    return depth_m + 0.0005 * torch.randn(240, 320, generator=torch.Generator().manual_seed(seed))


def error_of(found: PoseEstimate, truth: Rigid) -> float:
    assert found.camera_from_model is not None
    return float(add_m(found.camera_from_model, truth, bracket().vertices_m))


def oracle(poses: list[Rigid]) -> Oracle:
    return Oracle(tiny_weights(bracket()), poses)


def test_a_known_first_pose_is_followed_without_the_network() -> None:
    poses = moving(8)
    net = oracle(poses)
    found = list(net.track([frame(p, k) for k, p in enumerate(poses)], CAMERA, first=poses[0]))
    assert [e.tracking for e in found] == ["tracked"] * 8
    assert [e.name for e in found] == [f"input_{k}" for k in range(8)]
    assert max(error_of(e, p) for e, p in zip(found, poses, strict=True)) < 0.003
    assert net.calls == []
    assert found[0].covariance is not None


def test_frames_that_agree_make_it_surer_little_by_little() -> None:
    """The sensor and the object err alike in each: a second frame is no second opinion."""
    poses = moving(3)
    frames = [frame(p, k) for k, p in enumerate(poses)]
    found = [e.certainty or 0.0 for e in oracle(poses).track(frames, CAMERA, first=poses[0])]
    assert found[0] < 0.99 < found[1] < found[2] < 1


def test_without_a_first_pose_it_is_found_and_then_followed() -> None:
    poses = moving(3)
    net = oracle(poses[:1])
    found = list(net.track([frame(p) for p in poses], CAMERA))
    assert [e.tracking for e in found] == ["found", "tracked", "tracked"]
    assert error_of(found[2], poses[2]) < 0.003


@pytest.mark.slow
def test_it_is_lost_where_it_is_taken_away_or_covered_and_found_when_back() -> None:
    poses = moving(8)
    frames = [frame(p, k) for k, p in enumerate(poses)]
    frames[2] = frame(None)
    frames[3] = frame(None)
    frames[6] = torch.where(torch.arange(320) > 20, torch.tensor(0.4), frames[6])
    net = oracle(poses)
    found = list(net.track(frames, CAMERA, first=poses[0]))
    kinds = ["tracked", "tracked", "lost", "lost", "found", "tracked", "lost", "found"]
    assert [e.tracking for e in found] == kinds
    assert all(e.reason for e in found if e.tracking == "lost")
    assert max(error_of(found[k], poses[k]) for k in (0, 1, 4, 5, 7)) < 0.003


def test_a_track_that_its_history_ends_does_not_blame_the_frame() -> None:
    pose = pose_at(z_m=0.7, seed=3)
    target = TargetObject(number=0, model=bracket())
    doubted = track_module._Track(pose=pose.double(), motion=None, log_odds=-9.0, first=None)
    depth_m = frame(pose)
    everywhere = torch.ones_like(depth_m, dtype=torch.bool)
    view = ViewInput(name="a", depth_m=depth_m, mask=everywhere, K=K.float(), object="bracket")
    said = "together with the frames before it the pose is right with a .* alone with 100%$"
    with pytest.raises(Refused, match=said):
        track_module._follow(view, doubted, target, EstimateConfig())


def test_what_is_computed_of_the_model_is_not_in_the_time_of_the_first_frame() -> None:
    poses = moving(1)
    net = oracle(poses)
    net.track([frame(poses[0])], CAMERA, first=poses[0])
    assert "copies" in vars(net._find_object("bracket")), "before any frame is taken"


def test_a_part_that_is_hidden_does_not_lose_it() -> None:
    poses = moving(4)
    frames = []
    for k, pose in enumerate(poses):
        depth_m = frame(pose, k)
        middle = int((K @ pose.t_m.double() / pose.t_m[2])[0])
        depth_m[:, middle - 12 : middle + 12] = 0.45
        frames.append(depth_m)
    found = list(oracle(poses).track(frames, CAMERA, first=poses[0]))
    assert [e.tracking for e in found] == ["tracked"] * 4
    assert max(error_of(e, p) for e, p in zip(found, poses, strict=True)) < 0.005


def test_it_is_followed_where_what_is_not_hidden_was_seen() -> None:
    """A plate before most of it; a third that agrees is enough for what was followed there."""
    poses, column, frames = moving(4), torch.arange(320).expand(240, 320), []
    for k, pose in enumerate(poses):
        _, mask = view_of(bracket(), pose)
        cut = column[mask].double().quantile(HIDDEN)
        hides = (column >= column[mask].min() - 5) & (column < cut)
        assert (hides & mask).sum() > 0.5 * mask.sum(), "else nothing is tested"
        frames.append(torch.where(hides, torch.tensor(0.45), frame(pose, k)))
    found = list(oracle(poses).track(frames, CAMERA, first=poses[0]))
    assert [e.tracking for e in found] == ["tracked"] * 4
    assert max(error_of(e, p) for e, p in zip(found, poses, strict=True)) < 0.01


def test_the_motion_goes_on_as_it_was() -> None:
    """Speeding up step by step, it goes farther a frame than ICP alone would reach."""
    poses = [moving(1)[0]]
    for k in range(1, 7):
        last, step = poses[-1], 0.01 * k
        poses.append(Rigid(last.R, last.t_m + torch.tensor([0.4 * step, 0, step])))
    frames = [frame(pose, k) for k, pose in enumerate(poses)]
    net = oracle(poses)
    followed = list(net.track(frames, CAMERA, first=poses[0]))
    assert [e.tracking for e in followed] == ["tracked"] * 7
    # Without the motion it is not reached, and looked for anew.
    assert next(oracle(poses).track(frames[6:], CAMERA, first=poses[5])).tracking == "found"


def test_what_rests_on_a_table_does_not_wander_over_it() -> None:
    """The table's points lie around the part, as near to its surface as those of the part."""
    up = torch.tensor([0.0, -0.6, -0.8])
    table_m = -0.56
    lying = rotation_by(torch.tensor([math.pi - math.atan2(0.6, 0.8), 0.0, 0.0]))
    poses = []
    for k in range(8):
        R = rotation_by(math.radians(4 * k) * up) @ lying
        t_m = torch.tensor([-0.03 + 0.008 * k, 0.0, 0.7])
        lowest_m = ((bracket().vertices_m @ R.mT + t_m) @ up).min()
        poses.append(Rigid(R, t_m + (table_m - lowest_m) * up))
    rays = back_project(torch.ones(240, 320).double(), K).float()
    frames = []
    for k, pose in enumerate(poses):
        seen, mask = view_of(bracket(), pose)
        depth_m = torch.where(mask, seen.float(), table_m / (rays @ up))
        noise = torch.randn(240, 320, generator=torch.Generator().manual_seed(k))
        frames.append(depth_m + 0.001 * noise)
    found = list(oracle([]).track(frames, CAMERA, first=poses[0]))
    assert [e.tracking for e in found] == ["tracked"] * 8
    assert max(error_of(e, p) for e, p in zip(found, poses, strict=True)) < 0.003


def test_a_cloud_of_the_scene_is_followed_too() -> None:
    poses = moving(3)
    clouds = [back_project(frame(p, k).double(), K).reshape(-1, 3) for k, p in enumerate(poses)]
    found = list(oracle(poses).track(clouds, first=poses[0]))
    assert [e.tracking for e in found] == ["tracked"] * 3
    assert error_of(found[2], poses[2]) < 0.003


def test_in_clouds_of_the_scene_it_is_followed_again_where_it_was() -> None:
    """A network would refuse such a cloud for its size."""
    poses = moving(5, step_m=0.003)
    clouds = [back_project(frame(p, k).double(), K).reshape(-1, 3) for k, p in enumerate(poses)]
    clouds[2] = back_project(frame(None).double(), K).reshape(-1, 3)
    found = list(oracle(poses).track(clouds, first=poses[0]))
    assert [e.tracking for e in found] == ["tracked", "tracked", "lost", "tracked", "tracked"]
    assert error_of(found[4], poses[4]) < 0.003


def test_what_else_it_may_be_moves_along() -> None:
    poses = moving(2)
    half = Rigid(torch.diag(torch.tensor([-1.0, -1.0, 1.0])), torch.zeros(3))
    other = Alternative(
        camera_from_model=poses[0] @ half, probability=0.3, difference="rotated by 180 degrees",
        is_copy=True,
    )  # fmt: skip
    start = PoseEstimate(
        name="a", object="bracket", status="ok", camera_from_model=poses[0], certainty=0.8,
        copy_certainty=0.5, alternatives=(other,),
    )  # fmt: skip
    net = oracle(poses)
    model = net.weights.models[0]
    target = TargetObject(number=0, model=model)
    views = [back_project(frame(p).double(), K).reshape(-1, 3) for p in poses]
    from depthpose.pose.types import CloudInput

    inputs = [CloudInput(name=str(k), points_m=v, object="bracket") for k, v in enumerate(views)]
    first, second = track(inputs, target, net.config, search=lambda _: start)
    assert (first.tracking, second.tracking) == ("found", "tracked")
    assert second.certainty is not None
    assert second.copy_certainty is not None
    assert second.certainty > 0.8, "another frame agrees"
    assert second.copy_certainty == pytest.approx(second.certainty * 0.5 / 0.8)
    assert second.alternatives[0].probability == pytest.approx(second.certainty * 0.3 / 0.8)
    moved = second.alternatives[0].camera_from_model
    assert float(add_m(moved, poses[1] @ half, model.vertices_m)) < 0.003


def test_frames_are_taken_as_they_come() -> None:
    poses, asked = moving(3), []

    def camera_frames():  # noqa: ANN202
        for k, pose in enumerate(poses):
            asked.append(k)
            yield frame(pose, k)

    answers = oracle(poses).track(camera_frames(), CAMERA, first=poses[0])
    assert next(answers).is_ok
    assert asked == [0]


def test_a_frame_that_cannot_be_read_does_not_end_the_sequence() -> None:
    poses = moving(6)
    net = oracle(poses)
    frames: list[Any] = [frame(pose, k) for k, pose in enumerate(poses)]
    frames[2] = None  # a camera lost it
    frames[4] = frames[4][:-7]  # one of another size
    found = list(net.track(frames, CAMERA, first=poses[0]))
    assert [one.name for one in found] == [f"input_{k}" for k in range(6)]
    assert [one.tracking for one in found] == ["tracked"] * 2 + [None, "tracked", None, "tracked"]
    assert [one.status for one in found].count("unreadable") == 2
    assert "there is no frame" in found[2].reason
    assert "320x233" in found[4].reason
    assert max(error_of(found[k], poses[k]) for k in (3, 5)) < 0.003
    assert net.calls == []  # nothing was looked for


def test_a_mask_that_does_not_fit_its_frame_does_not_end_the_sequence() -> None:
    poses = moving(3)
    everywhere = torch.ones(240, 320, dtype=torch.bool)
    views = [
        ViewInput(name=str(k), depth_m=frame(p, k), mask=everywhere, K=K.float(), object="bracket")
        for k, p in enumerate(poses)
    ]
    said = "the mask is 320x30, but the depth image is 320x240"
    for number in (0, 1):
        frames = list(views)
        frames[number] = replace(views[number], mask=everywhere[:30])
        for first in (None, poses[0]):
            found = list(oracle(poses).track(frames, object="bracket", first=first))
            assert found[number].status == "unreadable"
            assert said in found[number].reason
            assert [one.is_ok for one in found] == [k != number for k in range(3)]


def test_points_on_a_known_background_are_not_followed() -> None:
    pose = pose_at(z_m=0.7, seed=3)
    everywhere = torch.ones(240, 320, dtype=torch.bool)
    alone = ViewInput(name="a", depth_m=frame(pose), mask=everywhere, K=K.float(), object="bracket")
    view = add_background(alone, frame(None, seed=1))
    assert view.background is not None
    surface = bracket_surface()
    scene_m = track_module._gather_scene(view, pose[None].double(), surface)
    of_all_m = track_module._gather_scene(alone, pose[None].double(), surface)
    assert 0 < len(scene_m) < len(of_all_m)
    assert float(scene_m[:, 2].max()) < 1.0, "the wall is at 1.1 m at the nearest"


def test_clouds_that_cannot_be_read_do_not_end_the_sequence() -> None:
    poses = moving(3)
    clouds: list[Any] = [back_project(frame(p, k), K).reshape(-1, 3) for k, p in enumerate(poses)]
    clouds[1] = torch.zeros(0)
    found = list(oracle(poses).track(clouds, first=poses[0]))
    assert [one.status for one in found] == ["ok", "unreadable", "ok"]
    assert "give points as rows of x, y and z" in found[1].reason


def test_the_first_pose_may_be_a_matrix() -> None:
    poses = moving(2)
    first = poses[0].matrix()
    frames = [frame(pose) for pose in poses]
    given = (first, first.numpy(), first.float(), poses[0])
    found = [list(oracle(poses).track(frames, K, first=one))[1] for one in given]
    assert {one.tracking for one in found} == {"tracked"}
    assert max(error_of(one, poses[1]) for one in found) < 0.004
    for wrong, said in (
        (first.T, "first is no rigid transform"),
        (2 * first, "first is no rigid transform"),
        (first[:3], r"of shape \(3, 4\); give a Rigid"),
        ("pose.json", r"first is a str of shape \(0,\); give a Rigid"),
    ):
        with pytest.raises(InputError, match=said):
            oracle(poses).track(frames, K, first=wrong)


def test_an_unknown_object_is_an_error() -> None:
    with pytest.raises(InputError, match="object 'spoon': the weights do not know it"):
        oracle(moving(1)).track([], CAMERA, "spoon")


def test_files_say_how_an_estimate_came_about() -> None:
    lost = PoseEstimate(name="a", object="b", status="doubtful", reason="so", tracking="lost")
    row = prediction_row(Prediction(estimate=lost))
    assert parse_prediction(row, "here").estimate.tracking == "lost"
    plain = prediction_row(
        Prediction(estimate=PoseEstimate(name="a", object="b", status="doubtful", reason="so"))
    )
    assert "tracking" not in plain
    with pytest.raises(InputError, match="tracking is 'sort of'; write one of"):
        parse_prediction({**row, "tracking": "sort of"}, "here")


def test_a_track_follows_its_object_whatever_clouds_name() -> None:
    parts = [bracket(), bottle()]
    truth = pose_at()
    cloud = CloudInput(name="x", points_m=cloud_of(bracket(), truth).float(), object="bracket")
    tracked = Registration(parts).track([cloud, cloud], object="bottle", first=truth)
    assert {estimate.object for estimate in tracked} == {"bottle"}
    found = Registration(parts).track([cloud, cloud], object="bottle")
    assert {estimate.object for estimate in found} == {"bottle"}
