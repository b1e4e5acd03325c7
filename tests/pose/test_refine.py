import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from tests.pose.synthetic_objects import bracket, bracket_surface, cloud_of, pose_at
from torch import Tensor

from depthpose.core.config import config_from_dict
from depthpose.core.errors import InputError
from depthpose.core.render import rasterize
from depthpose.core.rigid import Rigid, cross_matrix, geodesic_rad, perturb
from depthpose.pose.cloud import cloud_from_depth
from depthpose.pose.config import IcpConfig, SensorKind, SyntheticSensorConfig
from depthpose.pose.datasets import open_bop
from depthpose.pose.geometry.surface import Surface, prepare_surface
from depthpose.pose.icp import (
    Linearised,
    _estimate_covariance,
    refine_best,
    refine_exactly,
    rotate_starts,
)
from depthpose.pose.mesh import drawn_triangles, make_model, sample_surface
from depthpose.pose.mesh.models import turn_about
from depthpose.pose.metrics import add_m
from depthpose.pose.synthetic.depth_sensors import simulate_depth
from depthpose.pose.types import ObjectModel, PoseFit, Symmetries
from depthpose.report.pose import select_object_points

ORIGIN = torch.zeros(3).double()


@pytest.fixture(scope="module")
def stone() -> ObjectModel:
    points = np.random.default_rng(0).normal(size=(25, 3)) * [0.03, 0.05, 0.07]
    mesh = trimesh.convex.convex_hull(points)
    vertices = torch.from_numpy(np.array(mesh.vertices))
    return make_model(vertices, torch.from_numpy(np.array(mesh.faces)), name="stone")


@pytest.fixture(scope="module")
def surface(stone: ObjectModel) -> Surface:
    return prepare_surface(stone)


def pose_near(true: Rigid, seed: int, turn_rad: float, shift_m: float) -> Rigid:
    generator = torch.Generator().manual_seed(seed)
    axis, way = torch.nn.functional.normalize(
        torch.randn(2, 3, generator=generator, dtype=torch.float64), dim=-1
    )
    turned = perturb(Rigid(true.R, torch.zeros(3).double()),
                     torch.cat([turn_rad * axis, torch.zeros(3).double()]))  # fmt: skip
    return Rigid(turned.R, true.t_m + shift_m * way)


def seen_half(stone: ObjectModel, pose: Rigid, count: int = 3000) -> torch.Tensor:
    points, normals = sample_surface(stone, count)
    moved = pose.apply(points.double())
    return moved[(moved * (normals.double() @ pose.R.mT)).sum(-1) < 0]


def refine_from_rotated(cloud_m: Tensor, poses: Rigid, surface: Surface) -> tuple[PoseFit, Rigid]:
    """The best of seven starts from each pose."""
    rotated = rotate_starts(poses.double(), surface, 7)
    return refine_best(cloud_m, poses, surface, IcpConfig(), rotated)


TRUE = perturb(
    Rigid(torch.eye(3).double(), torch.zeros(3).double()),
    torch.tensor([0.5, -0.8, 0.3, 0.05, -0.02, 0.8]).double(),
)


def test_a_near_pose_becomes_the_true_one(stone: ObjectModel, surface: Surface) -> None:
    cloud = seen_half(stone, TRUE)
    starts = [pose_near(TRUE, seed, math.radians(8), 0.005) for seed in range(4)]
    batch = Rigid(torch.stack([s.R for s in starts]), torch.stack([s.t_m for s in starts]))
    refined = refine_exactly(cloud, batch, surface)
    assert float(geodesic_rad(refined.camera_from_model.R, TRUE.R.expand(4, 3, 3)).max()) < 2e-3
    assert float((refined.camera_from_model.t_m - TRUE.t_m).norm(dim=-1).max()) < 3e-4
    assert refined.inlier_share.min() == 1
    assert float(refined.residual_m.max()) < 2e-4
    one = refine_exactly(cloud, starts[2], surface).camera_from_model
    assert torch.allclose(one.R, refined.camera_from_model.R[2], atol=1e-4)


def test_the_refined_pose_turns_with_the_cloud(stone: ObjectModel, surface: Surface) -> None:
    """About the camera: else another side of the stone would face it."""
    cloud, start = seen_half(stone, TRUE), pose_near(TRUE, 5, 0.1, 0.005)
    motion = perturb(
        Rigid(torch.eye(3).double(), ORIGIN), torch.tensor([0.3, 0.4, -0.8, 0, 0, 0]).double()
    )
    here = refine_exactly(cloud, start, surface).camera_from_model
    there = refine_exactly(motion.apply(cloud), motion @ start, surface).camera_from_model
    assert torch.allclose((motion @ here).R, there.R, atol=1e-9)
    assert torch.allclose((motion @ here).t_m, there.t_m, atol=1e-9)


def test_far_points_have_no_say(stone: ObjectModel, surface: Surface) -> None:
    cloud = seen_half(stone, TRUE)
    wrong = cloud[::3] + torch.tensor([0.1, 0, 0])
    clean = refine_exactly(cloud, pose_near(TRUE, 6, 0.05, 0.003), surface)
    mixed = refine_exactly(torch.cat([cloud, wrong]), pose_near(TRUE, 6, 0.05, 0.003), surface)
    error_m = add_m(mixed.camera_from_model, clean.camera_from_model, stone.vertices_m)
    assert float(error_m) < 0.01 * stone.diameter_m
    assert float(mixed.inlier_share) < float(clean.inlier_share) - 0.1


def test_a_pose_that_meets_nothing_stays(stone: ObjectModel, surface: Surface) -> None:
    away = Rigid(TRUE.R, TRUE.t_m + torch.tensor([0.5, 0, 0]))
    refined = refine_exactly(seen_half(stone, TRUE), away, surface)
    assert torch.allclose(refined.camera_from_model.t_m, away.t_m)
    assert float(refined.inlier_share) == 0
    assert math.isinf(float(refined.residual_m))


def test_a_far_turn_ends_at_the_true_pose_and_turns_about_the_object(
    stone: ObjectModel, surface: Surface
) -> None:
    """At 0.8 m a turn of 25 degrees about the camera would carry the object away by its size."""
    start = pose_near(TRUE, 3, math.radians(25), 0.0)
    refined = refine_exactly(seen_half(stone, TRUE), start, surface)
    assert float(geodesic_rad(refined.camera_from_model.R, TRUE.R)) < 5e-3
    far = TRUE.t_m + torch.tensor([0, 0, 5.0])
    moved = refine_exactly(
        seen_half(stone, TRUE) + torch.tensor([0, 0, 5.0]), Rigid(start.R, far), surface
    )
    assert torch.allclose(moved.camera_from_model.t_m, refined.camera_from_model.t_m
                          + torch.tensor([0, 0, 5.0]), atol=2e-4)  # fmt: skip


def test_the_best_of_several_starts_is_found(stone: ObjectModel, surface: Surface) -> None:
    cloud = seen_half(stone, TRUE)
    given = [pose_near(TRUE, seed, turn, 0.01) for seed, turn in ((0, 2.0), (1, 0.35), (2, 1.5))]
    batch = Rigid(torch.stack([g.R for g in given]), torch.stack([g.t_m for g in given]))
    best, others = refine_from_rotated(cloud, batch, surface)
    assert float(geodesic_rad(best.camera_from_model.R, TRUE.R)) < 5e-3
    assert 1 <= len(others.R) <= 3
    _, others = refine_from_rotated(cloud, pose_near(TRUE, 5, 0.05, 0.002)[None], surface)
    assert len(others.R) == 0


def test_rotated_starts_are_turned_about_the_middle_of_the_object(surface: Surface) -> None:
    given = Rigid.stack([TRUE, pose_near(TRUE, 0, 0.5, 0.01)])
    assert len(rotate_starts(given, surface, 1).R) == 0
    rotated = rotate_starts(given, surface, 7)
    assert len(rotated.R) == 6 * len(given.R)
    middle_m = surface.points_m.mean(0)[None]
    for k in range(6):
        of_rotation = rotated[slice(2 * k, 2 * k + 2)]
        angle = geodesic_rad(of_rotation.R, given.R)
        assert torch.allclose(angle, torch.full_like(angle, math.radians(15)))
        assert torch.allclose(of_rotation.apply(middle_m), given.apply(middle_m))


def test_a_pose_that_would_hide_what_was_seen_is_not_the_best() -> None:
    """A plate looks alike from both sides, but its far side was not seen through the near one."""
    mesh = trimesh.creation.box((0.16, 0.1, 0.03))
    vertices, faces = (torch.from_numpy(np.array(part)) for part in (mesh.vertices, mesh.faces))
    plate = make_model(vertices, faces, name="plate")
    toward = -torch.sign(TRUE.R[:, 2] @ TRUE.t_m) * TRUE.R[:, 2]
    seen = seen_half(plate, TRUE)
    face = seen[(seen - TRUE.t_m) @ toward > 0.0149]
    # Pushed toward the camera by its thickness, its far side lies where the near one was seen.
    batch = Rigid(TRUE.R.expand(2, 3, 3), torch.stack([TRUE.t_m + 0.03 * toward, TRUE.t_m]))
    best, _ = refine_from_rotated(face, batch, prepare_surface(plate))
    assert float(((best.camera_from_model.t_m - TRUE.t_m) @ toward).abs()) < 1e-3


def test_a_shelf_whose_upper_board_was_seen_is_not_posed_by_its_lower_one() -> None:
    """The lower board fits as well, but then the upper one would hide what was seen."""
    boards = [trimesh.creation.box((0.16, 0.1, 0.004)) for _ in range(2)]
    boards[1].apply_translation([0, 0, 0.03])
    wall = trimesh.creation.box((0.004, 0.1, 0.03))
    wall.apply_translation([-0.08, 0, 0.015])
    mesh: Any = trimesh.util.concatenate([*boards, wall])
    vertices, faces = (torch.from_numpy(np.array(part)) for part in (mesh.vertices, mesh.faces))
    shelf = make_model(vertices, faces, name="shelf")
    true = perturb(
        Rigid(torch.eye(3).double(), torch.zeros(3).double()),
        torch.tensor([0.02, -0.03, 0.4, 0.0, 0.0, 0.8]).double(),
    )
    points_m = sample_surface(shelf, 8000)[0].double()
    seen_m = true.apply(points_m[points_m[:, 2] < -0.0019])
    lower = Rigid(true.R, true.t_m - 0.03 * true.R[:, 2])
    batch = Rigid(true.R.expand(2, 3, 3), torch.stack([lower.t_m, true.t_m]))
    best, _ = refine_from_rotated(seen_m, batch, prepare_surface(shelf))
    off_m = (best.camera_from_model.t_m - true.t_m) @ true.R[:, 2]
    assert float(off_m.abs()) < 1e-3


@pytest.mark.parametrize("kind", ["mesh", "inside out", "mixed", "points"])
def test_a_thin_plate_is_not_found_on_its_back(kind: str) -> None:
    """Its own thickness nearer to the camera the back lies where the front was seen."""
    mesh = trimesh.creation.box((0.16, 0.1, 0.008)).subdivide().subdivide().subdivide()
    vertices, faces = (torch.from_numpy(np.array(part)) for part in (mesh.vertices, mesh.faces))
    plate = make_model(vertices, faces, name="plate")
    seen = seen_half(plate, TRUE)
    toward = -torch.sign(TRUE.R[:, 2] @ TRUE.t_m) * TRUE.R[:, 2]
    if kind == "points":
        plate = make_model(sample_surface(plate, 5000)[0], torch.zeros(0, 3).long(), name="plate")
    elif kind != "mesh":
        every = 1 if kind == "inside out" else 2
        faces[::every] = faces[::every].flip(1)
        plate = make_model(vertices, faces, name="plate")
    start = Rigid(TRUE.R, TRUE.t_m + 0.008 * toward)
    found = refine_exactly(seen, start, prepare_surface(plate)).camera_from_model
    assert float(((found.t_m - TRUE.t_m) @ toward).abs()) < 5e-4


def test_noise_along_the_ray_draws_nothing_nearer() -> None:
    model, offs_m = bracket(), []
    truth, part = pose_at(seed=3), bracket_surface()
    true = Rigid(truth.R.double(), truth.t_m.double())
    clean_m = cloud_of(model, truth).double()
    for seed in range(8):
        generator = torch.Generator().manual_seed(seed)
        noise = torch.randn(len(clean_m), 1, generator=generator, dtype=torch.float64)
        found = refine_exactly(clean_m * (1 + 0.003 / clean_m[:, 2:] * noise), true, part)
        offs_m.append(found.camera_from_model.t_m[2] - true.t_m[2])
    assert abs(float(torch.stack(offs_m).mean())) < 4e-4


def test_another_pose_of_a_symmetric_part_is_kept() -> None:
    """A U of which one corner is seen: its leg and its bar may be exchanged."""
    parts = [((100, 20, 20), (0, 0, 0)), ((20, 70, 20), (40, 45, 0)), ((20, 70, 20), (-40, 45, 0))]
    boxes = [trimesh.creation.box(size).apply_translation(at) for size, at in parts]
    mesh = trimesh.util.concatenate(boxes)
    assert isinstance(mesh, trimesh.Trimesh)
    half_turn = Rigid(torch.diag(torch.tensor([-1.0, 1.0, -1.0])).double()[None], ORIGIN[None])
    vertices = torch.from_numpy(np.array(mesh.vertices)) / 1000
    symmetries = Symmetries(discrete=half_turn)
    faces = torch.from_numpy(np.array(mesh.faces))
    model = make_model(vertices, faces, name="u", symmetries=symmetries)
    corner_m = torch.tensor([-0.05, -0.01, 0.0]).double()
    about = turn_about(torch.tensor([1.0, 1.0, 0.0]).double(), corner_m, torch.tensor(math.pi))
    swapped = TRUE @ about
    points_m = sample_surface(model, 4000)[0].double()
    seen_m = points_m[(points_m[:, 0] < 0.01) & (points_m[:, 1] < 0.05)]
    both = Rigid.stack([TRUE, swapped])
    found, others = refine_from_rotated(TRUE.apply(seen_m), both, prepare_surface(model))
    best = found.camera_from_model.double()
    other = swapped if float(geodesic_rad(best.R, TRUE.R)) < 0.1 else TRUE
    copies = [other, other @ half_turn[0]]
    gaps_m = [float(add_m(p, c, vertices)) for p in others for c in copies]
    assert min(gaps_m) < 0.05 * model.diameter_m


def test_what_a_start_won_is_not_lost_on_the_way() -> None:
    """A given pose may be nearer than steps of a tenth of the diameter reach."""
    model = bracket()
    truth, part = pose_at(seed=3), bracket_surface()
    start = pose_near(
        Rigid(truth.R.double(), truth.t_m.double()), 46, math.radians(25), 0.15 * model.diameter_m
    )
    found, _ = refine_from_rotated(cloud_of(model, truth), start[None], part)
    assert float(add_m(found.camera_from_model, truth, model.vertices_m)) < 0.01 * model.diameter_m


def test_exact_steps_end_no_worse_than_rough_ones() -> None:
    """From here exact steps end beside the bottle's pose with its points near, rough ones at it."""
    body, cap = trimesh.creation.capsule(0.1, 0.03), trimesh.creation.cylinder(0.012, 0.05)
    body.apply_scale([1.5, 1, 1])
    cap.apply_translation([0.01, 0, 0.15])
    mesh = body + cap
    vertices, faces = (torch.from_numpy(np.array(part)) for part in (mesh.vertices, mesh.faces))
    model = make_model(vertices, faces, name="bottle")
    truth = pose_at(seed=0)
    start = pose_near(
        Rigid(truth.R.double(), truth.t_m.double()), 155, math.radians(50), 0.12 * model.diameter_m
    )
    found, _ = refine_from_rotated(cloud_of(model, truth), start[None], prepare_surface(model))
    assert float(add_m(found.camera_from_model, truth, model.vertices_m)) < 1e-3 * model.diameter_m


def test_one_step_is_checked_by_the_last_limit(stone: ObjectModel, surface: Surface) -> None:
    cloud = seen_half(stone, TRUE)
    noise = torch.randn(cloud.shape, generator=torch.Generator().manual_seed(0)).double()
    cloud = cloud + 0.04 * stone.diameter_m * noise
    shares = [
        float(refine_exactly(cloud, TRUE, surface, iterations=count).inlier_share)
        for count in (1, 30)
    ]
    assert shares[0] == pytest.approx(shares[1], abs=0.05)


def test_its_covariance_is_honest(stone: ObjectModel, surface: Surface) -> None:
    squares = []
    for seed in range(60):
        generator = torch.Generator().manual_seed(seed)
        cloud = seen_half(stone, TRUE, 900)
        cloud = cloud + 0.001 * torch.randn(cloud.shape, generator=generator, dtype=torch.float64)
        refined = refine_exactly(cloud, TRUE, surface, sensor_offset_m=0.0)
        turn = TRUE.R @ refined.camera_from_model.R.T
        rotation = torch.stack([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0],
                                turn[1, 0] - turn[0, 1]]) / 2  # fmt: skip
        shift = TRUE.t_m - turn @ refined.camera_from_model.t_m
        error = torch.cat([rotation, shift])
        squares.append(float(error @ torch.linalg.solve(refined.covariance, error)))
    # 6 of a chi-square with 6 degrees of freedom; less, as each direction has the mean at least.
    assert 2 < float(np.mean(squares)) < 8


@pytest.mark.parametrize("kind", ["structured light", "active stereo", "time of flight"])
def test_its_covariance_covers_the_errors_of_sensors(kind: SensorKind) -> None:
    """Neighbours err alike and edges bleed: 85 % of errors and more lie within 95 % intervals."""
    model, part = bracket(), bracket_surface()
    K = torch.tensor([[400.0, 0, 79.5], [0, 400, 59.5], [0, 0, 1]], dtype=torch.float64)
    times, claimed_m, errors_m = [], [], []
    for seed in range(5):
        pose = pose_at(seed=seed)
        R = pose.R.double()
        at_m = torch.tensor([0.01, -0.02, 0.6]).double()
        true = Rigid(R, at_m - R @ part.points_m.mean(0))
        clean_m = rasterize(true.apply(drawn_triangles(model).double()), K, 160, 120).depth_m
        mask, generator = clean_m.isfinite(), torch.Generator().manual_seed(seed)
        sensor = SyntheticSensorConfig(kinds=(kind,), noise=(1.0, 1.0), offset_m=(0.0, 0.0))
        by = torch.cat([-cross_matrix(at_m), torch.eye(3).double()], 1)
        for _ in range(2):
            depth_m = simulate_depth(
                clean_m.nan_to_num(0.8).float(), (400.0, 400.0), sensor, generator
            )
            cloud_m = cloud_from_depth(depth_m, mask & depth_m.isfinite(), K.float()).double()
            found = refine_exactly(cloud_m, true, part, sensor_offset_m=0.0)
            middle_m = found.camera_from_model.apply(part.points_m.mean(0)[None])[0]
            std_m = (by @ found.covariance @ by.mT).diagonal().sqrt()
            times.append((middle_m - at_m).abs() / std_m)
            claimed_m.append(std_m)
            errors_m.append(middle_m - at_m)
    assert float((torch.stack(times) < 1.96).double().mean()) >= 0.85
    ratio = torch.stack(claimed_m).square().mean() / torch.stack(errors_m).square().mean()
    assert 0.5 < float(ratio.sqrt()) < 3


def test_an_offset_of_the_sensor_is_in_the_covariance_along_the_ray() -> None:
    model, pose = bracket(), pose_at(seed=3)
    cloud_m, true = cloud_of(model, pose).double(), Rigid(pose.R.double(), pose.t_m.double())
    part = bracket_surface()
    found = [refine_exactly(cloud_m, true, part, sensor_offset_m=offset_m)
             for offset_m in (0.0, 0.004)]  # fmt: skip
    more = found[1].covariance - found[0].covariance
    middle_m = cloud_m.mean(0)
    along_m = torch.cat([torch.zeros(3), middle_m / middle_m.norm()]).double()
    assert torch.allclose(more, 0.004**2 * torch.outer(along_m, along_m), atol=2e-7)


def test_what_a_surface_does_not_fix_is_uncertain() -> None:
    ball = trimesh.creation.icosphere(3, 0.05)
    vertices = torch.from_numpy(np.array(ball.vertices))
    model = make_model(vertices, torch.from_numpy(np.array(ball.faces)), name="ball")
    pose = Rigid(torch.eye(3).double(), torch.tensor([0, 0, 0.5]).double())
    refined = refine_exactly(seen_half(model, pose), pose, prepare_surface(model))
    at_centre = torch.eye(6).double()
    at_centre[3:, :3] = -torch.tensor([[0, -0.5, 0], [0.5, 0, 0], [0, 0, 0]]).double()
    own = at_centre @ refined.covariance @ at_centre.mT
    assert float(own[:3, :3].diagonal().min().sqrt()) > 10 * float(own[3:, 3:].diagonal().max())
    assert float((refined.camera_from_model.t_m - pose.t_m).norm()) < 2e-4


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"iterations": 0}, "must be in"),
        ({"cloud_points": 10}, "must be in"),
        ({"end_distance_diameters": 0.2}, "the limit shrinks"),
    ],
)
def test_settings_out_of_range_are_refused(values: dict[str, object], said: str) -> None:
    with pytest.raises(InputError, match=said):
        config_from_dict(values, IcpConfig, source="test")


def test_the_real_cat_and_ape(real: Path) -> None:
    data = open_bop(real / "pose/lm")
    for i in range(2):
        sample, model = data[i], data.objects[data.instances[i].object_id]
        true = sample.truth.camera_from_model
        starts = [pose_near(true, seed, math.radians(8), 0.04 * model.diameter_m)
                  for seed in range(5)]  # fmt: skip
        batch = Rigid(torch.stack([s.R for s in starts]), torch.stack([s.t_m for s in starts]))
        points_m = select_object_points(sample.input, model.diameter_m)
        refined = refine_exactly(points_m, batch, prepare_surface(model))
        known = Rigid(true.R.expand(5, 3, 3), true.t_m.expand(5, 3))
        error_m = add_m(refined.camera_from_model, known, model.vertices_m[::7])
        assert float(error_m.max()) < 0.025 * model.diameter_m


def test_nothing_and_no_numbers_are_refused() -> None:
    surface = bracket_surface()
    start = Rigid(torch.eye(3), torch.zeros(3))
    for cloud, said in (
        (torch.zeros(0, 3), "ICP of 0 points, 0 of them not finite"),
        (torch.full((40, 3), torch.nan), "ICP of 40 points, 40 of them"),
    ):
        with pytest.raises(InputError, match=said):
            refine_exactly(cloud, start, surface)
        with pytest.raises(InputError, match=said):
            refine_best(cloud, start, surface, IcpConfig())


def covariance_of(
    cloud_m: Tensor, H: Tensor, J: Tensor, weight: Tensor, residual_m: Tensor, limit_m: float
) -> Tensor:
    return _estimate_covariance(cloud_m, Linearised(H, J, weight, residual_m), limit_m, 0.2)


def test_a_covariance_of_few_points_is_finite_and_symmetric() -> None:
    """Four points fix six directions to rounding alone, which a factorisation refused."""
    torch.manual_seed(11)
    cloud_m = 0.05 * torch.randn(4, 3).double() + torch.tensor([0.0, 0.0, 0.7])
    J = torch.randn(2, 4, 6).double() * torch.tensor([0.1, 0.1, 0.1, 1.0, 1.0, 1.0])
    weight, residual_m = torch.rand(2, 4).double(), 0.001 * torch.randn(2, 4).double()
    H = (weight[..., None] * J).mT @ J
    size = H.diagonal(dim1=-2, dim2=-1).amax(-1)[..., None, None]
    H = H + 1e-9 * size * torch.eye(6).double()
    found = covariance_of(cloud_m, H, J, weight, residual_m, 0.01)
    assert found.isfinite().all()
    assert torch.allclose(found, found.mT, rtol=1e-6, atol=0)


def test_a_covariance_is_of_as_many_residuals_as_are_free() -> None:
    """A fit of 6 numbers leaves n - 6; all points in one block, and weights of 1 nearly."""
    torch.manual_seed(3)
    count = 10
    cloud_m = 0.002 * torch.rand(count, 3).double() + torch.tensor([0.001, 0.001, 0.7])
    J = torch.randn(count, 6).double()
    root, _ = torch.linalg.qr(J)
    noise_m = 0.001 * torch.randn(count).double()
    residual_m = noise_m - root @ (root.mT @ noise_m)  # as a fit leaves them
    H = J.mT @ J
    weight = torch.ones(count).double()
    found = covariance_of(cloud_m, H, J, weight, residual_m, 10.0)
    variance_m2 = residual_m.square().sum() / (count - 6)
    assert torch.allclose(found, variance_m2 * torch.linalg.inv(H), rtol=1e-3)


def test_a_covariance_is_of_the_slope_of_tukeys_residuals() -> None:
    """Where residuals are not small beside the limit, they hold less than they weigh."""
    torch.manual_seed(4)
    count = 200
    limit_m = 0.004
    cloud_m = 0.002 * torch.rand(count, 3).double() + torch.tensor([0.001, 0.001, 0.7])
    residual_m = 0.001 * torch.randn(count).double().clamp(-3, 3)
    root = 1 - (residual_m / limit_m).square()
    weight = root.square()
    pull = (weight * residual_m)[:, None]
    J = torch.randn(count, 6).double()
    J = J - pull @ (pull.mT @ J) / pull.square().sum()  # at the best pose nothing pulls
    H = (weight[:, None] * J).mT @ J
    found = covariance_of(cloud_m, H, J, weight, residual_m, limit_m)
    slope = root * (root - 4 * (residual_m / limit_m).square())
    variance_m2 = (weight * residual_m.square()).sum() / (weight.sum() - 6)
    expected = variance_m2 * torch.linalg.inv((slope[:, None] * J).mT @ J)
    assert torch.allclose(found, expected, rtol=1e-3, atol=1e-3 * float(expected.abs().max()))
    assert float(expected.trace()) > 1.2 * float(variance_m2 * torch.linalg.inv(H).trace())
