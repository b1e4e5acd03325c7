import math
from pathlib import Path

import pytest
import torch

from depthpose.core.camera import project
from depthpose.core.config import config_from_dict
from depthpose.core.errors import InputError
from depthpose.core.files import read_depth_png, read_image
from depthpose.pose.cloud import cloud_from_depth, is_reading, require_points
from depthpose.pose.config import SHAPE_FEATURES, CloudConfig
from depthpose.pose.geometry.grid import rotation_from_z_to, sample_points, voxelise
from depthpose.pose.refusals import Refused
from depthpose.pose.types import CloudInput
from depthpose.report.pose import select_object_points

K = torch.tensor([[500.0, 0, 32], [0, 500, 24], [0, 0, 1]]).double()


def test_a_cloud_projects_onto_its_mask() -> None:
    mask = torch.zeros(48, 64, dtype=torch.bool)
    mask[10:20, 30:50] = True
    depth = torch.full((48, 64), 0.8)
    depth[12, 30] = torch.nan
    depth[13, 31] = 0
    cloud = cloud_from_depth(depth, mask, K)
    assert len(cloud) == 198
    pixels = project(cloud, K).round().long()
    assert bool(mask[pixels[:, 1], pixels[:, 0]].all())


def test_a_cloud_of_slanted_pixels_projects_onto_its_mask() -> None:
    mask = torch.zeros(48, 64, dtype=torch.bool)
    mask[10:40, 20:50] = True
    slanted = K.clone()
    slanted[0, 1] = 25.0
    pixels = project(cloud_from_depth(torch.full((48, 64), 0.8).double(), mask, slanted), slanted)
    torch.testing.assert_close(pixels, mask.nonzero().flip(-1).double(), rtol=0, atol=1e-9)


def test_flying_pixels_are_dropped() -> None:
    depth = torch.full((48, 64), 0.8)
    depth[:, 33:] = 2.0
    mask = torch.zeros(48, 64, dtype=torch.bool)
    mask[10:20, 20:36] = True
    assert len(cloud_from_depth(depth, mask, K)) == 160
    assert len(cloud_from_depth(depth, mask, K, diameter_m=0.1)) == 130


def test_a_mask_of_another_size_is_refused() -> None:
    with pytest.raises(InputError, match="the mask is 3x2, but the depth image is 64x48"):
        cloud_from_depth(torch.ones(48, 64), torch.ones(2, 3, dtype=torch.bool), K)


def test_too_small_a_cloud_is_refused_with_a_reason() -> None:
    require_points(torch.rand(16, 3))
    with pytest.raises(Refused) as refused:
        require_points(torch.rand(15, 3))
    assert refused.value.status == "too few points"
    assert refused.value.reason == (
        "the cloud has 15 points, fewer than the 16 that a pose takes: is the mask empty, or the "
        "depth missing there?"
    )
    empty = cloud_from_depth(torch.ones(4, 4), torch.zeros(4, 4, dtype=torch.bool), K, 0.1)
    with pytest.raises(Refused, match="0 points"):
        require_points(empty)


def plain(voxel_m: float) -> CloudConfig:
    return CloudConfig(voxel_m=voxel_m, with_sight_axis=False)


def test_voxels_are_what_a_plain_loop_gives() -> None:
    points = torch.randn(400, 3, generator=torch.Generator().manual_seed(0)) * 0.03
    voxels = voxelise(points, plain(0.01))
    seen: dict[tuple[int, ...], int] = {}
    for i, cell in enumerate(((points - points.mean(0)) / 0.01).floor().long().tolist()):
        seen.setdefault(tuple(cell), i)
    assert voxels.kept.tolist() == list(seen.values())
    assert [tuple(c) for c in voxels.coordinates.tolist()] == list(seen)
    cells = ((points - points.mean(0)) / 0.01).floor().long()
    assert torch.equal(voxels.coordinates[voxels.row_of_point], cells)
    assert torch.equal(voxels.features, torch.ones(len(seen), 1))


def test_voxels_do_not_know_where_the_object_is() -> None:
    points = torch.rand(300, 3, generator=torch.Generator().manual_seed(1)).double()
    here, there = voxelise(points, plain(0.1)), voxelise(points + 0.5, plain(0.1))
    assert torch.equal(here.coordinates, there.coordinates)
    assert torch.equal(here.kept, there.kept)


def test_voxels_of_nothing_and_of_millimetres_are_refused() -> None:
    with pytest.raises(InputError, match="no point"):
        voxelise(torch.empty(0, 3), CloudConfig())
    with pytest.raises(InputError, match="are its points in mm"):
        voxelise(torch.tensor([[0.0, 0, 0], [1e6, 0, 0]]), plain(0.001))


def test_voxels_are_those_of_the_network_whatever_the_default_of_torch_is() -> None:
    points = torch.rand(50, 3)
    want = voxelise(points, CloudConfig())
    torch.set_default_dtype(torch.float64)
    try:
        found = voxelise(points, CloudConfig())
    finally:
        torch.set_default_dtype(torch.float32)
    assert found.features.dtype == want.features.dtype == torch.float32
    assert torch.equal(found.coordinates, want.coordinates)


def test_a_point_in_the_camera_is_no_reading() -> None:
    points = torch.tensor([[0, 0, 0], [0, 0, 1], [torch.nan, 0, 1], [0, 0.1, 0], [0, 0, torch.inf],
                           [0, 0, torch.finfo(torch.float32).max]])  # fmt: skip
    assert is_reading(points).tolist() == [False, True, False, True, False, False]
    given = CloudInput(name="a", points_m=points, object="b")
    assert torch.equal(select_object_points(given, 1.0), points[[1, 3]])


def test_samples_are_a_subset_in_order_and_reproducible() -> None:
    points = torch.arange(300.0).reshape(100, 3)
    taken = [sample_points(points, 10, torch.Generator().manual_seed(3)) for _ in range(2)]
    assert torch.equal(*taken)
    assert taken[0][:, 0].diff().min() > 0
    generator = torch.Generator()
    assert sample_points(points, None, generator) is points
    assert sample_points(points, 100, generator) is points


@pytest.mark.parametrize(
    ("setting", "value", "said"),
    [
        ("voxel_m", 8.0, r"voxel_m must be in \(0, 1\), got 8.0; the default is 0.008"),
        ("voxel_m", 0.0, r"voxel_m must be in \(0, 1\), got 0.0"),
        ("min_points", 2, r"min_points must be in \[3, inf\), got 2"),
        ("max_points", 10, "every cloud would be refused"),
        ("max_offset_diameters", 0.0, r"max_offset_diameters must be in \(0, inf\), got 0.0"),
    ],
)
def test_settings_out_of_range_are_refused(setting: str, value: object, said: str) -> None:
    with pytest.raises(InputError, match=said):
        config_from_dict({setting: value}, CloudConfig, source="test")


def test_the_real_cat(real: Path) -> None:
    folder = real / "pose/lm/test/000006"
    depth = read_depth_png(folder / "depth/000000.png", 0.001)
    mask = read_image(folder / "mask_visib/000000_000000.png")[0] > 0.5
    intrinsic = torch.tensor([[572.4114, 0, 325.2611], [0, 573.57043, 242.04899], [0, 0, 1]])
    cloud = cloud_from_depth(depth, mask, intrinsic.double(), 0.1545)
    assert 2000 < len(cloud) <= 2212
    assert float((cloud.amax(0) - cloud.amin(0)).norm()) < 0.25
    assert 50 < len(voxelise(cloud, plain(0.008)).kept) < 500


def test_a_point_that_is_none_does_not_move_all_others() -> None:
    points_m = torch.rand(50, 3)
    points_m[3, 0] = torch.nan
    with pytest.raises(InputError, match="voxelise: 1 points are not finite; leave such"):
        voxelise(points_m, plain(0.1))


def test_a_cloud_at_the_side_has_the_grid_of_one_straight_ahead() -> None:
    generator = torch.Generator().manual_seed(2)
    ahead = torch.rand(500, 3, generator=generator) * 0.1
    ahead = ahead - ahead.mean(0) + torch.tensor([0.0, 0.0, 0.8])
    away = rotation_from_z_to(torch.tensor([0.5, -0.3, 1.0])).float()
    side = ahead @ away.mT
    first = voxelise(ahead, CloudConfig(voxel_m=0.01))
    second = voxelise(side, CloudConfig(voxel_m=0.01))
    assert torch.allclose(first.grid_from_camera, torch.eye(3), atol=1e-6)
    assert torch.allclose(second.grid_from_camera @ away, torch.eye(3), atol=1e-6)
    # Rounding moves a point or two across a wall.
    same = (first.coordinates[:, None] == second.coordinates[None]).all(-1).any(1)
    assert float(same.float().mean()) > 0.98
    assert torch.equal(voxelise(side, plain(0.01)).grid_from_camera, torch.eye(3))


def shape_of(points: torch.Tensor, voxel_m: float = 0.01) -> torch.Tensor:
    config = CloudConfig(voxel_m=voxel_m, with_shape=True)
    features = voxelise(points, config).features
    assert features.shape[1] == SHAPE_FEATURES
    return features


def test_the_shape_of_a_voxel_is_what_a_plain_loop_gives() -> None:
    points = torch.randn(400, 3, generator=torch.Generator().manual_seed(0)).double() * 0.03
    config = CloudConfig(voxel_m=0.01, with_sight_axis=False, with_shape=True)
    voxels = voxelise(points, config)
    places = (points - points.mean(0)) / 0.01
    for row, cell in enumerate(voxels.coordinates):
        mine = places[(places.floor() == cell).all(-1)]
        inside = 2 * (mine.mean(0) - cell) - 1
        expected = torch.cat([torch.ones(1), inside, torch.tensor([math.log2(len(mine))])])
        torch.testing.assert_close(voxels.features[row, :5], expected.float(), atol=1e-5, rtol=0)
    assert float(voxels.features[:, 4].max()) > 1


def test_a_plane_has_its_normal_toward_the_camera_and_a_ball_is_bent() -> None:
    generator = torch.Generator().manual_seed(3)
    flat = torch.rand(600, 3, generator=generator) * torch.tensor([0.1, 0.1, 0.0])
    tilt = rotation_from_z_to(torch.tensor([0.3, 0.2, -1.0]))
    plane = (flat.double() @ tilt.mT + torch.tensor([0.1, -0.2, 0.9])).float()
    features = shape_of(plane)
    turn = voxelise(plane, CloudConfig()).grid_from_camera
    normal = (turn.double() @ tilt[:, 2]).float()
    normal = normal * -torch.sign(normal @ (turn @ plane.mean(0)))
    assert float(normal[2]) < -0.5  # the third axis of the grid points away from the camera
    torch.testing.assert_close(features[:, 5:8], normal.expand(len(features), 3), atol=1e-3, rtol=0)
    assert float(features[:, 8].max()) < 1e-5
    ball = torch.randn(600, 3, generator=generator) * 0.01 + torch.tensor([0.0, 0.0, 1.0])
    assert 0.1 < float(shape_of(ball)[:, 8].mean()) < 1


def test_the_shape_turns_with_the_camera() -> None:
    generator = torch.Generator().manual_seed(4)
    ahead = torch.rand(500, 3, generator=generator).double() * 0.1 + torch.tensor([0.0, 0.0, 0.8])
    ahead -= torch.tensor([*ahead.mean(0)[:2], 0.0])
    away = rotation_from_z_to(torch.tensor([0.5, -0.3, 1.0])).double()
    here, there = shape_of(ahead), shape_of(ahead @ away.mT)
    if len(here) == len(there):
        near = (here - there).abs().amax(1) < 1e-3
        assert float(near.float().mean()) > 0.95
    else:
        pytest.fail(f"{len(here)} voxels became {len(there)}")


def test_three_points_have_a_shape_too() -> None:
    few = torch.tensor([[0.0, 0.0, 1.0], [0.1, 0.0, 1.0], [0.0, 0.1, 1.0]])
    features = shape_of(few)
    assert bool(features.isfinite().all())
    torch.testing.assert_close(features[:, 8], torch.zeros(3))
    assert bool(shape_of(few[:1]).isfinite().all())


@pytest.mark.parametrize("direction", [(0, 0, 1), (0, 0, -1), (0.3, -2, 0.1)])
def test_the_axis_turns_to_a_direction_the_shortest_way(direction: tuple[float, ...]) -> None:
    towards = torch.tensor(direction, dtype=torch.float64)
    R = rotation_from_z_to(towards)
    assert torch.allclose(R[:, 2], towards / towards.norm(), atol=1e-9)
    assert torch.allclose(R @ R.mT, torch.eye(3).double(), atol=1e-9)
    assert float(torch.linalg.det(R)) > 0
    angle = torch.acos((towards / towards.norm())[2])
    # The shortest: it turns by no more than the angle between the two.
    assert torch.allclose((R.trace() - 1) / 2, angle.cos(), atol=1e-9)
