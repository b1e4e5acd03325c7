"""Known objects in depth without masks: what is answered, once each, and what is not."""

from dataclasses import replace

import pytest
import torch
from scipy.spatial import KDTree
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
from depthpose.pose.cloud import cloud_from_depth
from depthpose.pose.config import RefusalConfig
from depthpose.pose.geometry.surface import NEAR, prepare_surface
from depthpose.pose.inliers import view_inliers
from depthpose.pose.inputs import view_input
from depthpose.pose.mesh import make_model
from depthpose.pose.metrics import add_m
from depthpose.pose.search import nothing_found
from depthpose.pose.types import (
    Alternative,
    CloudInput,
    Evidence,
    ObjectModel,
    PoseEstimate,
    ViewInput,
)
from depthpose.pose.verify.decide import choose_object
from depthpose.pose.verify.evidence import compare, observe
from depthpose.pose.verify.probability import probability_right

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
    view = ViewInput(name="a", depth_m=depth_m, mask=mask, K=K, object=model.name)
    surface = prepare_surface(model)
    cloud_m = cloud_from_depth(depth_m, mask, K)
    observation = observe(cloud_m, view, surface, is_masked=False)
    evidence = compare(observation, pose, surface)
    assert (probability_right(evidence, is_expected=False) == 0) == is_cut


def test_readings_on_a_posed_surface_are_all_that_are_near_it() -> None:
    """A noisy sensor, so that many are about as far off as what counts as near."""
    model, pose = bracket(), TRUTHS[0].double()
    surface, noise = prepare_surface(model), torch.Generator().manual_seed(0)
    depth_m = (table() + 0.01 * torch.randn(240, 320, generator=noise)).double()
    local_m = pose.inverse().apply(back_project(depth_m, K.double()))
    distance_m = torch.from_numpy(KDTree(surface.points_m.numpy()).query(local_m.numpy())[0])
    view = ViewInput(name="a", depth_m=depth_m, mask=depth_m > 0, K=K, object=model.name)
    found, near = view_inliers(view, pose, surface), distance_m < NEAR * surface.diameter_m
    assert int(near.sum()) > 500
    assert int((found != near).sum()) < 3, "but for rounding"


def test_what_the_camera_saw_through_a_found_pose_counts() -> None:
    depth_m = table(with_thing=False)
    _, mask = view_of(bracket(), TRUTHS[0])
    rows = mask.any(1).nonzero()[:, 0]
    hole = mask & (torch.arange(240)[:, None] > int(rows.double().quantile(0.6)))
    assert len(Oracle(tiny_weights(bracket()), TRUTHS).find(depth_m, CAMERA)) == 2
    depth_m[hole] = 1.2
    (found,) = Oracle(tiny_weights(bracket()), TRUTHS).find(depth_m, CAMERA)
    assert found.evidence is not None
    assert found.evidence.agreement > 0.95


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


def test_a_search_for_nothing_is_an_error() -> None:
    net = Oracle(tiny_weights(bracket()), TRUTHS)
    with pytest.raises(InputError, match="find: objects names none"):
        net.find(table(), CAMERA, [])
    with pytest.raises(InputError, match="find: objects names none"):
        net.find(view_input(table(), None, CAMERA, "bracket", "a"), objects=[])


def test_a_view_has_its_own_background() -> None:
    net = Oracle(tiny_weights(bracket()), TRUTHS)
    view = view_input(table(), None, CAMERA, "bracket", "a")
    with pytest.raises(InputError, match="find: background= belong to a depth image, and a view"):
        net.find(view, background=table())


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


def test_another_object_that_fits_too_lowers_the_probability_of_every_pose() -> None:
    evidence = Evidence(
        visible=20.0, supported=18.0, explained=18.0,
        unobserved=1.0, seen_through=1.0, bulging=0.0, beside=0.0, silhouette=0.0, continued=0.0,
        rms=0.6, noise_m=0.001,
    )  # fmt: skip
    copy = Alternative(
        camera_from_model=TRUTHS[1], probability=0.4, difference="turned", is_copy=True
    )
    likely = PoseEstimate(
        name="a", object="bracket", status="ok", camera_from_model=TRUTHS[0], certainty=0.9,
        copy_certainty=0.5, alternatives=(copy,), evidence=evidence,
    )  # fmt: skip
    less = replace(evidence, supported=16.0, explained=16.0, seen_through=3.0)
    found = choose_object([likely, replace(likely, object="bottle", evidence=less)], 0.9)
    assert found.certainty is not None
    share = found.certainty / 0.9
    assert 0.8 < share < 0.99
    assert found.copy_certainty == pytest.approx(0.5 * share)
    assert found.alternatives[0].probability == pytest.approx(0.4 * share)


def test_a_cloud_of_none_of_several_objects_is_refused() -> None:
    generator = torch.Generator().manual_seed(0)
    blob = 0.03 * torch.randn(2000, 3, generator=generator) + torch.tensor([0.0, 0.0, 0.8])
    net = Oracle(tiny_weights(bracket(), bottle(), refusal=REFUSAL), [pose_at()])
    found = net.estimate(cloud=blob)
    assert found.camera_from_model is None
    assert found.reason is not None
    assert found.reason.startswith("none of bracket, bottle surely; ")


def test_a_cloud_that_may_show_anything_needs_more_evidence() -> None:
    """Where an object is only asked for, it is likelier not to be there than in its own mask."""
    truth = pose_at(seed=3)
    net = Oracle(tiny_weights(bracket()), [truth])
    given = CloudInput(name="a", points_m=cloud_of(bracket(), truth), object="bracket")
    asked = net._estimate(given, is_expected=False)
    (masked,) = net.estimate_many([given])
    assert asked.certainty is not None
    assert masked.certainty is not None
    assert asked.certainty < masked.certainty


def test_two_objects_that_look_alike_are_named_and_refused() -> None:
    twin = replace(bracket(), name="twin")
    truth = pose_at(seed=3)
    net = Oracle(tiny_weights(bracket(), twin, refusal=REFUSAL), [truth])
    found = net.estimate(cloud=cloud_of(bracket(), truth))
    assert found.status == "doubtful"
    assert found.reason == "it may be bracket (50%), twin (50%); say which by object"
    two = Oracle(tiny_weights(bracket(), twin, refusal=REFUSAL), TRUTHS)
    without_mask = two.find(table(), CAMERA)
    assert not any(estimate.is_posed for estimate in without_mask), "neither is answered"


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
    found = nothing_found(view, "bracket", [], 0.1)
    assert found.status == status
    assert found.reason is not None
    assert said in found.reason
