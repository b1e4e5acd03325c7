"""Known objects in depth without masks: planes go, regions are parted, answers do not overlap."""

from collections.abc import Sequence
from dataclasses import replace

import pytest
import torch
from tests.pose.synthetic_objects import (
    CAMERA,
    K,
    Oracle,
    bottle,
    box_faces,
    bracket,
    pose_at,
    tiny_weights,
    view_of,
)

from depthpose.core.camera import back_project
from depthpose.core.errors import InputError
from depthpose.core.rigid import Rigid
from depthpose.pose.config import RefusalConfig
from depthpose.pose.estimator.find import is_cut_out, nothing_found
from depthpose.pose.estimator.inputs import AnyInput
from depthpose.pose.mesh import make_model
from depthpose.pose.metrics import add_m
from depthpose.pose.regions import extent_m, find_regions, part_cloud, split_at_necks
from depthpose.pose.surface import prepare_surface
from depthpose.pose.types import CloudInput, ObjectModel, PoseEstimate, ViewInput

TRUTHS = [pose_at(-0.13, 0.7, seed=1), pose_at(0.12, 0.9, seed=2)]
REFUSAL = RefusalConfig()


def table(with_thing: bool = True) -> torch.Tensor:
    """Two brackets before a wall that leans back, and a thing that nobody knows."""
    v = torch.arange(240)[:, None].expand(240, 320)
    depth_m = 1.25 - 0.0005 * v.float()
    if with_thing:
        r2 = (torch.arange(320) - 280.0)[None].square() + (torch.arange(240) - 40.0)[
            :, None
        ].square()
        depth_m = torch.where(r2 < 400, 0.9 - 0.03 * (1 - r2 / 400).clamp(min=0).sqrt(), depth_m)
    seen, mask = view_of(bracket(), *TRUTHS)
    noise = 0.0005 * torch.randn(240, 320, generator=torch.Generator().manual_seed(0))
    return torch.where(mask, seen.float(), depth_m) + noise


def test_planes_go_and_regions_stay() -> None:
    depth_m = table()
    regions, _, is_plane = find_regions(depth_m, K.float(), bracket().diameter_m)
    _, mask = view_of(bracket(), *TRUTHS)
    assert len(regions) == 3
    assert float(is_plane[~mask].float().mean()) > 0.95
    assert not bool(is_plane[mask].any())
    assert abs(sum(map(len, regions[:2])) - int(mask.sum())) < 0.02 * int(mask.sum())
    assert extent_m(regions[2]) < 0.1
    assert extent_m(torch.rand(2**20 + 5, 3)) == pytest.approx(1.4, abs=0.1), "of a fine scanner"
    # A wall no wider than an object may be an object's side: it stays.
    assert max(map(len, find_regions(depth_m, K.float(), 5.0)[0])) > 0.5 * 320 * 240


def test_a_plane_through_several_objects_is_no_plane() -> None:
    """Five blocks of one height in front of a wall: no plane through all of them cuts bands out."""
    depth_m = torch.full((240, 320), 1.2)
    mask = torch.zeros(240, 320).bool()
    for k in range(5):
        block = (slice(60, 180), slice(20 + 60 * k, 60 + 60 * k))
        depth_m[block] = (0.9 + 0.001 * torch.arange(120).float())[:, None]
        mask[block] = True
    regions = find_regions(depth_m, K.float(), 0.15)
    assert bool(regions.is_plane[~mask].all())
    assert not bool(regions.is_plane[mask].any())
    assert [len(cloud) for cloud in regions.clouds_m] == [120 * 40] * 5


@pytest.mark.parametrize("scale", [1, 4])
def test_two_things_that_touch_are_split_at_their_neck(scale: int) -> None:
    mask = torch.zeros(100, 140).bool()
    mask[20:70, 10:60] = mask[30:70, 70:120] = mask[45:51, 60:70] = True
    mask = mask.repeat_interleave(scale, 0).repeat_interleave(scale, 1)
    pieces = split_at_necks(mask)
    assert sorted(int(piece.sum()) // scale**2 // 100 for piece in pieces) == [20, 25]
    assert not bool((pieces[0] & pieces[1]).any())
    assert bool((pieces[0] | pieces[1]).eq(mask).all())
    assert split_at_necks(mask[: 70 * scale, : 60 * scale]) == [], "one thing without a neck"


def test_a_region_that_is_too_small_for_an_object_is_not_tried() -> None:
    """Of a bracket a fragment is left that is long enough for it, but thin."""
    asked = []

    class Counting(Oracle):
        def _try_many(self, inputs: Sequence[AnyInput]) -> list[PoseEstimate]:
            asked.extend(inputs)
            return super()._try_many(inputs)

    depth_m = torch.full((240, 320), 1.25)
    depth_m[100, 100:150] = depth_m[101, 100:150] = 0.9
    net = Counting(tiny_weights(bracket(), refusal=REFUSAL), TRUTHS)
    assert net.find(depth_m, CAMERA) == []
    assert asked == []
    depth_m[80:120, 100:150] = 0.9
    net.find(depth_m, CAMERA)
    assert len(asked) == 1


def test_a_depth_image_without_readings_has_no_region() -> None:
    regions, _, is_plane = find_regions(torch.full((24, 32), torch.nan), K.float(), 0.2)
    assert regions == []
    assert not bool(is_plane.any())


def test_what_is_too_long_is_parted_by_place() -> None:
    generator = torch.Generator().manual_seed(0)
    blobs = [0.02 * torch.randn(500, 3, generator=generator) + torch.tensor([0.3 * k, 0, 1.0])
             for k in range(3)]  # fmt: skip
    parts = part_cloud(torch.cat(blobs), 3)
    assert sorted(len(part) for part in parts) == [500, 500, 500]


def test_two_instances_are_found_and_an_unknown_thing_is_not() -> None:
    model = bracket()
    net = Oracle(tiny_weights(model, bottle(), refusal=REFUSAL), TRUTHS)
    found = net.find(table(), CAMERA, ["bracket"])
    assert [estimate.name for estimate in found] == ["input_0", "input_1"]
    errors = []
    for truth in TRUTHS:
        poses = [e.camera_from_model for e in found]
        errors += [min(float(add_m(p, truth, model.vertices_m)) for p in poses if p is not None)]
    assert max(errors) < 0.003


def plate() -> ObjectModel:
    """A flat part, 16 by 14 cm."""
    corners, faces = box_faces()
    return make_model(corners * torch.tensor([0.16, 0.14, 0.012]), faces, name="plate", number=7)


@pytest.mark.parametrize(
    ("model", "beside", "is_cut"),
    [
        (plate(), "nothing", False),
        (plate(), "a neighbour of its height", False),
        (plate(), "a panel", True),
        (plate(), "a strip of its width", True),
        (bracket(), "a panel", False),
    ],
)
def test_a_piece_of_a_larger_plane_is_no_flat_part(
    model: ObjectModel, beside: str, is_cut: bool
) -> None:
    pose = (
        Rigid(torch.eye(3), torch.tensor([0.0, 0.0, 0.7])) if model.name == "plate" else TRUTHS[0]
    )
    seen, mask = view_of(model, pose)
    top_m = float(seen[mask].median())
    columns, rows = mask.any(0).nonzero()[:, 0], mask.any(1).nonzero()[:, 0]
    depth_m = torch.full((240, 320), 1.2)
    if beside == "a panel":
        depth_m[:, 20:300] = top_m
    elif beside == "a strip of its width":
        depth_m[:, columns[0] : columns[-1] + 1] = top_m
    elif beside == "a neighbour of its height":
        depth_m[rows[0] : rows[-1] + 1, columns[-1] :] = top_m
    depth_m = torch.where(mask, seen.float(), depth_m)
    depth_m += 0.001 * torch.randn(240, 320, generator=torch.Generator().manual_seed(0))
    view = ViewInput(name="", depth_m=depth_m, mask=mask, K=K.float(), object=model.name)
    assert is_cut_out(view, pose, prepare_surface(model)) == is_cut


def test_what_the_camera_saw_through_a_found_pose_counts() -> None:
    depth_m = table(with_thing=False)
    _, mask = view_of(bracket(), TRUTHS[0])
    rows = mask.any(1).nonzero()[:, 0]
    hole = mask & (torch.arange(240)[:, None] > int(rows.double().quantile(0.6)))
    assert len(Oracle(tiny_weights(bracket()), TRUTHS).find(depth_m, CAMERA)) == 2
    depth_m[hole] = 1.2
    (found,) = Oracle(tiny_weights(bracket()), TRUTHS).find(depth_m, CAMERA)
    assert found.fit is not None
    assert found.fit.agrees > 0.95


def test_the_same_thing_is_found_once_however_it_is_parted() -> None:
    """Half of a bracket hides behind a bar: its two parts are one answer."""
    model = bracket()
    depth_m = table(with_thing=False)
    points_m = back_project(depth_m.double(), K)
    column = int((K @ TRUTHS[0].t_m.double() / TRUTHS[0].t_m[2])[0])
    depth_m[:, column - 4 : column + 4] = 0.45
    assert bool(points_m.isfinite().all())
    net = Oracle(tiny_weights(model, refusal=REFUSAL), TRUTHS)
    found = net.find(depth_m, CAMERA)
    near = [e for e in found if e.camera_from_model is not None
            and float(add_m(e.camera_from_model, TRUTHS[0], model.vertices_m)) < 0.02]  # fmt: skip
    assert len(near) == 1


def test_an_object_that_the_weights_do_not_know_is_refused() -> None:
    net = Oracle(tiny_weights(bracket()), TRUTHS)
    with pytest.raises(InputError, match="object 'spoon': the weights do not know it"):
        net.find(table(), CAMERA, ["spoon"])


def cloud_of(model: ObjectModel, truth: Rigid) -> torch.Tensor:
    depth_m, mask = view_of(model, truth)
    return back_project(depth_m.double(), K)[mask].float()


def test_which_object_a_cloud_shows_is_answered() -> None:
    truth = pose_at(seed=3)
    net = Oracle(tiny_weights(bracket(), bottle(), refusal=REFUSAL), [truth])
    for model in (bracket(), bottle()):
        found = net.estimate(cloud=cloud_of(model, truth))
        assert (found.object, found.status) == (model.name, "ok")
        named = net.estimate(cloud=cloud_of(model, truth), object=model.name)
        assert found.certainty is not None
        assert named.certainty is not None
        assert found.certainty <= named.certainty


def test_a_cloud_of_none_of_several_objects_is_refused() -> None:
    generator = torch.Generator().manual_seed(0)
    blob = 0.03 * torch.randn(2000, 3, generator=generator) + torch.tensor([0.0, 0.0, 0.8])
    net = Oracle(tiny_weights(bracket(), bottle(), refusal=REFUSAL), [pose_at()])
    found = net.estimate(cloud=blob)
    assert found.camera_from_model is None
    assert found.reason is not None
    assert found.reason.startswith("none of bracket, bottle surely; ")


def test_a_cloud_that_hardly_shows_its_object_is_refused_early() -> None:
    """What is likely to be there is compared in all its poses; what is not, in the best alone."""
    generator = torch.Generator().manual_seed(0)
    blob = 0.03 * torch.randn(2000, 3, generator=generator) + torch.tensor([0.0, 0.0, 0.8])
    strict = RefusalConfig(min_agreement=1.0, max_beyond=0.0, min_explained=1.0)
    net = Oracle(tiny_weights(bracket(), refusal=strict), [pose_at()])
    given = CloudInput(name="blob", points_m=blob, object="bracket")
    (early,), (whole,) = net._try_many([given]), net.estimate_many([given])
    for refused in (early, whole):
        assert refused.status == "doubtful"
    assert "check" in whole.seconds
    assert "check" not in early.seconds


def test_two_objects_that_look_alike_are_named_and_refused() -> None:
    twin = replace(bracket(), name="twin")
    truth = pose_at(seed=3)
    net = Oracle(tiny_weights(bracket(), twin, refusal=REFUSAL), [truth])
    found = net.estimate(cloud=cloud_of(bracket(), truth))
    assert found.status == "doubtful"
    assert found.reason == "it may be bracket (50%), twin (50%); say which by object"
    two = Oracle(tiny_weights(bracket(), twin, refusal=REFUSAL), TRUTHS)
    assert two.find(table(), CAMERA) == [], "without a mask neither is answered"


@pytest.mark.parametrize(
    ("depth_m", "status", "said"),
    [
        (torch.nan, "too few points", "no reading at all: every pixel is 0 or NaN"),
        (800.0, "doubtful", "its depths are 800 to 800 m: if they are right"),
    ],
)
def test_an_image_in_which_nothing_is_found_says_what_it_shows(
    depth_m: float, status: str, said: str
) -> None:
    view = ViewInput(
        name="a",
        depth_m=torch.full((24, 32), depth_m),
        mask=torch.ones(24, 32).bool(),
        K=K.float(),
        object="bracket",
    )
    found = nothing_found(view, "bracket")
    assert found.status == status
    assert found.reason is not None
    assert said in found.reason
