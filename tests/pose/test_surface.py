"""The samples of a surface: nearest without searching, and what a camera would see of it."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from tests.pose.synthetic_objects import bottle, bracket, cloud_of, pose_at

from depthpose.core.rigid import Rigid
from depthpose.pose.geometry.surface import Surface, look_along_rays, prepare_surface
from depthpose.pose.mesh import make_model
from depthpose.pose.types import ObjectModel, SurfaceColors


@pytest.fixture(scope="module")
def part() -> ObjectModel:
    return bracket()


@pytest.fixture(scope="module")
def surface(part: ObjectModel) -> Surface:
    return prepare_surface(part)


def test_a_real_object_differs_more_from_a_scan_than_from_a_cad_file(part: ObjectModel) -> None:
    points = replace(part, faces=part.faces[:0])
    point = torch.zeros(1, 3)
    colors = SurfaceColors(points_m=point, normals=point, rgb=point, spacing_m=1.0)
    colored = replace(part, colors=colors)
    deviations_m = [prepare_surface(model, 500).deviation_m for model in (part, points, colored)]
    assert deviations_m == [0.001, 0.002, 0.002]
    assert prepare_surface(points, 500, deviation_m=0.0003).deviation_m == 0.0003


def batch_of(*poses: Rigid) -> Rigid:
    return Rigid(
        torch.stack([pose.R.double() for pose in poses]),
        torch.stack([pose.t_m.double() for pose in poses]),
    )


def test_the_table_is_off_by_no_more_than_a_box(surface: Surface) -> None:
    points_m = surface.points_m + 0.01 * torch.randn(
        surface.points_m.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    found_m = surface.nearest(points_m, is_exact=False).distance_m
    true_m = surface.nearest(points_m).distance_m
    assert float((found_m - true_m).min()) >= 0
    # The middle of a box lies half of its diagonal from its corner, there and back.
    assert float((found_m - true_m).max()) < 3**0.5 * surface.boxes.side_m
    assert float((found_m - true_m).mean()) < 0.2 * surface.boxes.side_m


def test_batches_and_points_beyond_the_table_have_answers(surface: Surface) -> None:
    some_m = torch.stack(
        [surface.points_m[:5], surface.points_m[5:10] + 9.0, -9.0 + torch.zeros(5, 3)]
    )
    found = surface.boxes.look_up(some_m.double())
    assert found.shape == (3, 5)
    assert int(found.min()) >= 0
    assert int(found.max()) < len(surface.points_m)
    assert torch.equal(found[0], surface.boxes.look_up(surface.points_m[:5]))


def test_a_thin_plate_has_a_table_of_its_shape() -> None:
    mesh = trimesh.creation.box((0.2, 0.1, 0.001))
    vertices, faces = (torch.from_numpy(np.array(part)) for part in (mesh.vertices, mesh.faces))
    boxes = prepare_surface(make_model(vertices, faces, name="plate")).boxes
    assert boxes.counts.tolist() == [48, 31, 13]
    assert len(boxes.nearest) == 48 * 31 * 13


def test_the_true_pose_hides_nothing_and_shows_what_was_seen(
    part: ObjectModel, surface: Surface
) -> None:
    truth, cloud_m = pose_at(), cloud_of(part, pose_at()).double()
    nearer = Rigid(truth.R, truth.t_m - torch.tensor([0.0, 0, 0.05]))
    beside = Rigid(truth.R, truth.t_m + torch.tensor([0.5, 0, 0]))
    behind = Rigid(truth.R, -truth.t_m)
    poses = batch_of(truth, nearer, beside, behind)
    front, unseen = look_along_rays(cloud_m, poses, surface)
    assert front.tolist() == pytest.approx([0, 1, 0, 1], abs=0.08)
    assert unseen.tolist() == pytest.approx([0, 0, 1, 1], abs=0.16)
    # Each is checked alone.
    alone = [look_along_rays(cloud_m, batch_of(Rigid(R, t_m)), surface)
             for R, t_m in zip(poses.R, poses.t_m, strict=True)]  # fmt: skip
    assert torch.equal(torch.cat([f for f, _ in alone]), front)
    assert torch.equal(torch.cat([u for _, u in alone]), unseen)


def test_half_of_a_cloud_leaves_half_of_the_surface_unseen(
    part: ObjectModel, surface: Surface
) -> None:
    cloud_m = cloud_of(part, pose_at()).double()
    half_m = cloud_m[cloud_m[:, 0] < cloud_m[:, 0].median()]
    _, whole = look_along_rays(cloud_m, batch_of(pose_at()), surface)
    _, unseen = look_along_rays(half_m, batch_of(pose_at()), surface)
    assert 0.3 < float(unseen - whole) < 0.6


@pytest.mark.parametrize("point", [(0.0, 0, 0), (0.05, 0, 0), (0.05, 0.02, 1e-7), (0.0, 0, -1)])
def test_points_at_and_behind_the_camera_are_no_part_of_what_it_saw(
    part: ObjectModel, surface: Surface, point: tuple[float, float, float]
) -> None:
    """Organised clouds write missing readings so; their rays reach nowhere, or everywhere."""
    cloud_m = cloud_of(part, pose_at()).double()
    odd_m = torch.cat([torch.tensor([point]).double(), cloud_m])
    pose = batch_of(pose_at())
    for clean, odd in zip(
        look_along_rays(cloud_m, pose, surface), look_along_rays(odd_m, pose, surface), strict=True
    ):
        assert float(odd) == pytest.approx(float(clean), abs=0.01)
    none = look_along_rays(torch.zeros(5, 3).double(), pose, surface)
    assert [float(share) for share in none] == [1.0, 1.0]


def test_a_surface_knows_the_poses_that_look_alike(surface: Surface) -> None:
    assert len(prepare_surface(bottle()).symmetries.R) > 30
    assert len(surface.symmetries.R) == 1


def test_a_camera_on_any_side_has_a_view_from_nearby(surface: Surface) -> None:
    """Below the model too: a view of another side shows points that the camera does not see."""
    ways = torch.randn(500, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    ways = torch.nn.functional.normalize(ways, dim=-1)
    cosine, side = (ways @ surface.views.toward.T).max(-1)
    assert float(cosine.min()) > np.cos(np.radians(12))
    for way, points_m in zip(ways[:20], surface.views.points_m[side[:20]], strict=True):
        top_m = points_m[points_m.isfinite().all(-1)] @ way
        assert (
            float(top_m.max()) > float((surface.points_m @ way).max()) - 0.05 * surface.diameter_m
        )


def test_rims_and_edges_are_not_inside() -> None:
    """Of a tube seen along its axis all is rim; of a plate seen from the front the border is."""
    tube = trimesh.creation.annulus(r_min=0.046, r_max=0.05, height=0.1)
    plate = trimesh.creation.box((0.1, 0.1, 0.004))
    for mesh, inner in ((tube, 0.0), (plate, 0.75)):
        vertices_m = torch.tensor(mesh.vertices).float()
        model = make_model(vertices_m, torch.tensor(mesh.faces), name="thing")
        views = prepare_surface(model).views
        side = int(views.toward[:, 2].argmax())
        seen = views.points_m[side].isfinite().all(-1)
        share = float(views.is_inner[side][seen].double().mean())
        assert share == pytest.approx(inner, abs=0.15)
    radius_m = views.points_m[side][views.is_inner[side], :2].abs().amax(-1)
    assert float(radius_m.max()) < 0.049, "not at the border of the plate"
