"""Synthetic views: exact, reproducible, and what the settings say."""

import dataclasses
from pathlib import Path

import pytest
import torch
import trimesh

from depthpose.core.errors import InputError
from depthpose.core.render import rasterize
from depthpose.core.rigid import Rigid
from depthpose.pose.config import ObjectsConfig, SyntheticSensorConfig
from depthpose.pose.datasets import check_bop, open_bop, write_bop_models, write_bop_scene
from depthpose.pose.mesh import drawn_triangles, make_model, sample_surface
from depthpose.pose.mesh.models import triangulate_points
from depthpose.pose.synthetic import SyntheticViews, depth_sensors, make_frames
from depthpose.pose.synthetic.random_numbers import random_rotation
from depthpose.pose.synthetic.views import aim_camera, make_shape, render_view, turn_view
from depthpose.pose.types import ObjectModel, ViewSample

_K = torch.tensor([[572.4, 0, 325.3], [0, 573.6, 242.0], [0, 0, 1]], dtype=torch.float64)
_CLEAN = {
    "occluded_share": 0.0,
    "with_background": False,
    "mask_error_px": 0,
    "mask_shift_px": 0,
    "sensor": SyntheticSensorConfig(kinds=("none",)),
}


def _model(name: str = "part", shift_m: float = 0.0) -> ObjectModel:
    """A box with a ball on a corner: no symmetry, and its origin is not its middle."""
    box = trimesh.creation.box((0.10, 0.06, 0.03)).subdivide().subdivide()
    ball = trimesh.creation.icosphere(2, 0.025)
    ball.apply_translation((0.05, 0.03, 0.02))
    both = trimesh.util.concatenate([box, ball])
    assert isinstance(both, trimesh.Trimesh)
    vertices = torch.tensor(both.vertices) + torch.tensor([shift_m, 0.02, 0.0])
    return make_model(vertices, torch.tensor(both.faces), name=name)


def _drawn_again(view: ViewSample, model: ObjectModel) -> torch.Tensor:
    pose, given = view.truth.camera_from_model, view.input
    height, width = given.depth_m.shape
    return rasterize(pose.apply(drawn_triangles(model)), given.K, width, height).depth_m


@pytest.mark.parametrize("views", [None, 3])
def test_a_clean_view_is_what_its_truth_looks_like(views: int | None) -> None:
    model = _model(shift_m=0.1)
    objects = SyntheticViews([model], ObjectsConfig(views=views, **_CLEAN))
    for index in range(6):
        view = objects.view(index)
        again_m = _drawn_again(view, model)
        assert torch.equal(view.input.mask, view.input.depth_m.isfinite())
        differs = view.input.mask ^ again_m.isfinite()
        # A turned view knows its silhouette to a pixel.
        assert int(differs.sum()) <= (0 if views is None else 0.06 * int(view.input.mask.sum()))
        error_m = (view.input.depth_m - again_m).abs()
        error_m = error_m[error_m.isfinite()]
        assert float(error_m.median()) < (1e-6 if views is None else 1e-4)
        assert float(error_m.mean()) < (1e-6 if views is None else 8e-4)


def test_a_turned_view_of_a_plane_is_exact_to_rounding() -> None:
    # Inverse depth is linear in the picture of a plane.
    corners = torch.tensor([[-0.1, -0.1, 0], [0.1, -0.1, 0], [0.1, 0.1, 0], [-0.1, 0.1, 0.0]])
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    shape = make_shape(make_model(corners, faces, name="plate"))
    tilt = aim_camera(torch.tensor([0.5, 0.3, 1.0], dtype=torch.float64), 0.4)
    middle_m = torch.tensor([0.0, 0.0, 0.8], dtype=torch.float64)
    pose = Rigid(tilt, middle_m - tilt @ shape.middle_m)
    turn = aim_camera(torch.tensor([-0.2, 0.3, 1.0], dtype=torch.float64), 2.0)
    turned = turn_view(render_view(shape, pose, _K), turn, shape, _K)
    error_m = (turned.depth_m - render_view(shape, turned.camera_from_model, _K).depth_m).abs()
    inside = error_m[error_m.isfinite()]
    assert len(inside) > 10000
    # Beside the rim the nearest pixel is taken.
    assert float(inside.quantile(0.9)) < 2e-6


def test_gaze_turns_the_axis_to_the_direction() -> None:
    for direction in ([0.0, 0.0, 1.0], [0.4, -0.2, 1.0], [-3.0, 1.0, 0.5]):
        towards = torch.tensor(direction, dtype=torch.float64)
        R = aim_camera(towards, 0.7)
        assert torch.allclose(R[:, 2], towards / towards.norm(), atol=1e-12)
        assert torch.allclose(R @ R.mT, torch.eye(3).double(), atol=1e-12)
        assert float(torch.linalg.det(R)) > 0


def test_a_clean_cloud_lies_on_the_surface() -> None:
    model = _model()
    tree = trimesh.proximity.ProximityQuery(
        trimesh.Trimesh(model.vertices_m.numpy(), model.faces.numpy(), process=False)
    )
    objects = SyntheticViews([model], ObjectsConfig(views=None, **_CLEAN))
    sample = objects[0]
    on_model = sample.truth.camera_from_model.inverse().apply(sample.input.points_m)
    near = trimesh.points.PointCloud(on_model.numpy()[::20])
    _, distance, _ = trimesh.proximity.closest_point_naive(tree._mesh, near.vertices)
    assert float(distance.max()) < 2e-6


def test_a_sample_depends_on_seed_and_index_alone() -> None:
    models = [_model("first"), _model("second", 0.03)]
    config = ObjectsConfig(views=2, number=20)
    ahead, alone = SyntheticViews(models, config), SyntheticViews(models, config)
    for index in range(12):
        ahead.view(index)
    first, second = ahead.view(7), alone.view(7)
    assert torch.equal(first.input.mask, second.input.mask)
    assert torch.equal(first.input.depth_m.nan_to_num(), second.input.depth_m.nan_to_num())
    assert first.input.name == "second_0_000007"
    assert first.input.object == "second"
    other = SyntheticViews(models, dataclasses.replace(config, seed=1)).view(7)
    assert not torch.equal(first.truth.camera_from_model.R, other.truth.camera_from_model.R)
    assert torch.equal(alone[7].input.points_m, ahead[7].input.points_m)


def test_views_drawn_ahead_are_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    models = [_model("first"), _model("second", 0.03)]
    ahead, alone = (SyntheticViews(models, ObjectsConfig(views=3, number=20)) for _ in range(2))
    ahead.render_stored(workers=2)
    expected = [alone.view(index).input.depth_m.nan_to_num() for index in range(12)]

    def draw(*_: object) -> None:
        raise AssertionError("every stored view is drawn already")

    monkeypatch.setattr("depthpose.pose.synthetic.views.render_view", draw)
    found = [ahead.view(index).input.depth_m for index in range(12)]
    for mine, theirs in zip(found, expected, strict=True):
        assert torch.equal(mine.nan_to_num(), theirs)


def test_the_number_of_samples_is_kept() -> None:
    objects = SyntheticViews([_model()], ObjectsConfig(number=2, views=1))
    assert len(objects) == 2
    with pytest.raises(IndexError, match="sample 2 of 2"):
        objects[2]
    assert bool(objects.view(2).input.mask.any())


def test_visible_fractions_fill_their_range() -> None:
    config = ObjectsConfig(views=4, occluded_share=1.0, occlusion=(0.2, 0.5))
    objects = SyntheticViews([_model()], config)
    found = [objects.view(i).truth.visible_fraction for i in range(30)]
    given = [share for share in found if share is not None]
    assert len(given) == 30
    assert 0.48 < min(given) < 0.6
    assert 0.7 < max(given) < 0.82


def test_grown_masks_hold_what_is_behind() -> None:
    values = {**_CLEAN, "with_background": True, "mask_error_px": 3, "resolution": (1.0, 1.0)}
    model = _model()
    objects = SyntheticViews([model], ObjectsConfig(views=None, **values))
    grown = 0
    for index in range(12):
        view = objects.view(index)
        shape = _drawn_again(view, model).isfinite()
        grown += bool((view.input.mask & ~shape & view.input.depth_m.isfinite()).any())
        is_object = shape & view.input.mask
        error_m = view.input.depth_m[is_object] - _drawn_again(view, model)[is_object]
        assert float(error_m.abs().max()) < 1e-6
    assert grown >= 3


def test_the_object_lies_whole_in_the_image() -> None:
    config = ObjectsConfig(views=2, resolution=(1.0, 1.0))
    objects = SyntheticViews([_model()], config)
    for index in range(10):
        view = objects.view(index)
        pose = view.truth.camera_from_model
        points = pose.apply(objects.models[0].vertices_m).double()
        K = objects.make_intrinsics()
        pixels = (points @ K.mT)[:, :2] / points[:, 2:]
        assert float(pixels.min()) > 0
        assert bool((pixels.amax(0) < torch.tensor([640, 480])).all())
        assert 0.5 < float(pose.t_m.norm()) < 1.2


@pytest.mark.parametrize(
    ("solid", "distance_m"),
    [
        (trimesh.creation.icosphere(4, 0.05), 0.5),
        (trimesh.creation.cylinder(0.04, 0.12), 0.6),
        (trimesh.creation.torus(0.05, 0.012), 0.6),
        (trimesh.creation.box((0.12, 0.06, 0.004)), 0.6),
    ],
    ids=["ball", "can", "ring", "plate"],
)
def test_triangles_between_points_stand_for_their_surface(
    solid: trimesh.Trimesh, distance_m: float
) -> None:
    mesh = make_model(torch.tensor(solid.vertices), torch.tensor(solid.faces), name="mesh")
    random_m = trimesh.sample.sample_surface(solid, 2600, seed=1)[0]
    points = make_model(torch.tensor(random_m), torch.empty(0, 3), name="points")
    R = random_rotation(torch.Generator().manual_seed(1)).double()
    pose = Rigid(R, torch.tensor([0, 0, distance_m]).double() - R @ make_shape(mesh).middle_m)
    mesh_m, points_m = (
        rasterize(pose.apply(drawn_triangles(model).double()).float(), _K, 640, 480).depth_m
        for model in (mesh, points)
    )
    is_mesh, is_points = mesh_m.isfinite(), points_m.isfinite()
    is_both = is_mesh & is_points
    assert float(is_both.sum() / (is_mesh | is_points).sum()) > 0.95
    difference_m = (points_m - mesh_m)[is_both].abs()
    assert float(difference_m.median()) < 5e-4
    # Nothing of the far side shows through gaps, and no hole of the body is closed.
    assert float((difference_m > 2e-3).float().mean()) < 0.02


@pytest.mark.parametrize(
    ("count", "scale", "repeats", "is_surface"),
    [(3, (1, 1, 1), 1, False), (600, (1, 1, 0), 1, True), (600, (1, 1, 0), 2, True),
     (600, (1, 0, 0), 1, False)],
    ids=["three points", "a plane", "each point twice", "a line"],
)  # fmt: skip
def test_points_that_are_no_body_are_joined_where_they_are_a_surface(
    count: int, scale: tuple[float, ...], repeats: int, is_surface: bool
) -> None:
    points_m = torch.rand(count, 3, generator=torch.Generator().manual_seed(0))
    points_m = (points_m * torch.tensor(scale, dtype=torch.float32)).repeat(repeats, 1)
    normals = torch.tensor([0.0, 0.0, 1.0]).expand(len(points_m), 3)
    triangles_m = triangulate_points(points_m, normals)
    sides_m = triangles_m - triangles_m.roll(1, 1)
    area_m2 = torch.linalg.cross(sides_m[:, 0], sides_m[:, 1]).norm(dim=-1) / 2
    assert (float(area_m2.sum()) > 0.9) == is_surface


def test_errors_say_what_to_do() -> None:
    with pytest.raises(InputError, match="there is no object to show; give one model at least"):
        SyntheticViews([])
    with pytest.raises(
        InputError, match=r"the camera would stand in it\. Begin at 0\.[0-9]+ or farther"
    ):
        SyntheticViews([_model()], ObjectsConfig(distance_m=(0.06, 1.0)))


def _numbered(number: int) -> ObjectModel:
    return dataclasses.replace(_model(f"part_{number}", 0.01 * number), number=number)


_FRAME = ObjectsConfig(
    image_px=(160, 120),
    focal_px=(143.0, 143.0),
    centre_px=(81.0, 60.0),
    frame_objects=(3, 3),
    sensor=SyntheticSensorConfig(kinds=("none",)),
)


def test_a_model_of_points_is_drawn_in_a_frame() -> None:
    points_m, _ = sample_surface(_numbered(1), 3000)
    scan = make_model(points_m, torch.zeros(0, 3).long(), name="scan")
    of_points = dataclasses.replace(scan, number=1)
    frame = next(make_frames([of_points], _FRAME, 1))
    shown = frame.objects[0].visible
    assert int(shown.sum()) > 50
    assert frame.rgb is not None
    assert float(frame.rgb[:, shown].std()) > 0.01, "it is shaded"


def test_a_frame_is_what_its_poses_look_like() -> None:
    models = [_numbered(n) for n in (1, 2, 3)]
    for frame in make_frames(models, _FRAME, 3):
        assert frame.rgb is not None
        assert frame.rgb.shape == (3, 120, 160)
        assert 0 <= float(frame.rgb.min()) <= float(frame.rgb.max()) <= 1
        assert len(frame.objects) >= 2
        for shown in frame.objects:
            corners = shown.camera_from_model.apply(drawn_triangles(models[shown.number - 1]))
            alone_m = rasterize(corners, frame.K, 160, 120).depth_m
            assert torch.equal(shown.silhouette, alone_m.isfinite())
            assert not (shown.visible & ~shown.silhouette).any()
            gap_m = (frame.depth_m - alone_m)[shown.silhouette]
            # Where it is visible its own surface was measured, elsewhere something nearer.
            assert float(gap_m[shown.visible[shown.silhouette]].abs().max()) < 1e-6
            assert bool((gap_m <= 1e-6).all())


def test_objects_of_a_frame_stand_on_one_table_and_not_in_each_other() -> None:
    models = [_numbered(n) for n in (1, 2, 3)]
    for frame in make_frames(models, _FRAME, 3):
        clouds = [o.camera_from_model.apply(models[o.number - 1].vertices_m) for o in frame.objects]
        for i, cloud in enumerate(clouds):
            for other in clouds[:i]:
                assert float(torch.cdist(cloud, other).min()) > 1e-4


def test_copies_of_a_pile_touch_and_do_not_cut_into_each_other() -> None:
    ball = trimesh.creation.icosphere(3, 0.03)
    model = make_model(torch.tensor(ball.vertices) + 0.1, torch.tensor(ball.faces), name="ball")
    model = dataclasses.replace(model, number=7)
    settings = dataclasses.replace(_FRAME, frame_pile=8)
    for frame in make_frames([model], settings, 2):
        assert len(frame.objects) == 8
        assert {shown.number for shown in frame.objects} == {7}
        middle_m = torch.stack(
            [shown.camera_from_model.apply(torch.full((1, 3), 0.1))[0] for shown in frame.objects]
        )
        apart_m = torch.cdist(middle_m, middle_m) + torch.eye(8)
        assert float(apart_m.min()) > 0.05  # cells of 4 mm: they may overlap by a little
        assert sum(bool((row < 0.07).any()) for row in apart_m) >= 4
        assert any(bool((shown.silhouette & ~shown.visible).any()) for shown in frame.objects)


def test_a_pile_of_hundreds_is_refused() -> None:
    with pytest.raises(InputError, match=r"frame_pile must be in"):
        dataclasses.replace(_FRAME, frame_pile=201)


def test_frames_are_numbered_and_repeatable() -> None:
    models = [_numbered(1)]
    frames = list(make_frames(models, _FRAME, 3))
    again = next(iter(make_frames(models, _FRAME, 1, first=2)))
    assert [frame.number for frame in frames] == [0, 1, 2]
    assert frames[2].rgb is not None
    assert again.rgb is not None
    assert torch.equal(frames[2].rgb, again.rgb)
    assert not torch.equal(frames[1].rgb if frames[1].rgb is not None else again.rgb, again.rgb)


def test_frames_go_through_bops_layout_and_back(tmp_path: Path) -> None:
    models = [_numbered(1), _numbered(2)]
    frames = list(make_frames(models, _FRAME, 2))
    write_bop_models(tmp_path, models)
    write_bop_scene(tmp_path, "train", 0, frames)
    assert check_bop(tmp_path).is_ok
    back = open_bop(tmp_path, "train")
    assert len(back) == sum(len(frame.objects) for frame in frames)
    sample, shown = back[0], frames[0].objects[0]
    found, known = sample.truth.camera_from_model.R, shown.camera_from_model.R
    assert torch.allclose(found.float(), known, atol=1e-6)
    assert sample.input.object == f"part_{shown.number}"


def test_frames_refuse_what_they_cannot_show() -> None:
    with pytest.raises(InputError, match="two models have the number 1"):
        next(make_frames([_numbered(1), _numbered(1)], _FRAME, 1))
    with pytest.raises(InputError, match=r"distance_m begins at 0\.2 m, but the largest object"):
        next(make_frames([_numbered(1)], dataclasses.replace(_FRAME, distance_m=(0.2, 1.0)), 1))
    with pytest.raises(InputError, match="there is no object to show"):
        next(make_frames([], _FRAME, 1))
    with pytest.raises(InputError, match=r"frame_objects must be in \[1, inf\), got \(0, 2\)"):
        dataclasses.replace(_FRAME, frame_objects=(0, 2))


def test_the_projector_throws_the_shadow_of_a_thing_onto_what_lies_behind_it() -> None:
    """To one side alone, as wide as its disparities differ."""
    depth_m = torch.full((3, 60), 2.0)
    depth_m[:, 20:30] = 1.0
    is_shadowed = depth_sensors._mark_shadow(depth_m, focal_px=100.0, baseline_m=0.2)
    columns = is_shadowed[0].nonzero().flatten().tolist()
    wide_px = 100 * 0.2 * (1 / 1.0 - 1 / 2.0)
    # Half a pixel more than one is tolerated at its end.
    assert columns == list(range(30, 30 + int(wide_px) - 2))
    assert torch.equal(is_shadowed, is_shadowed[:1].expand(3, -1))
