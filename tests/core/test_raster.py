import pytest
import torch

from depthpose.core import render as raster
from depthpose.core.errors import InputError
from depthpose.core.render import edge_functions, rasterize, rasterize_orthographic

WIDTH, HEIGHT = 37, 23
K = torch.tensor([[40.0, 1.5, 17.2], [0, 33.0, 11.4], [0, 0, 1]], dtype=torch.float64)


def random_triangles(seed: int, count: int, near: float = -2.0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    centre = torch.rand(count, 1, 3, generator=generator, dtype=torch.float64)
    centre = (centre - 0.5) * torch.tensor([8, 6, 0]) + torch.tensor([0, 0, 1.0]) * (
        near + 12 * torch.rand(count, 1, 1, generator=generator, dtype=torch.float64)
    )
    spread = torch.randn(count, 3, 3, generator=generator, dtype=torch.float64)
    return centre + spread


def by_rays(triangles: torch.Tensor, near_m: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Meet every ray with every triangle (Moeller and Trumbore 1997)."""
    v, u = torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij")
    pixels = torch.stack([u, v, torch.ones_like(u)], -1).double().reshape(-1, 1, 3)
    rays = pixels @ K.inverse().mT
    a, b, c = triangles.unbind(1)
    p = torch.linalg.cross(rays, (c - a)[None].expand(len(rays), -1, -1))
    determinant = (p * (b - a)).sum(-1)
    share_b = -(p * a).sum(-1) / determinant
    q = torch.linalg.cross(-a, b - a)
    share_c = (rays * q).sum(-1) / determinant
    depth = ((c - a) * q).sum(-1) / determinant
    hit = (share_b >= 0) & (share_c >= 0) & (share_b + share_c <= 1) & (depth >= near_m)
    depth = torch.where(hit, depth, torch.inf)
    nearest, which = depth.min(1)
    which = torch.where(nearest.isinf(), -1, which)
    return nearest.reshape(HEIGHT, WIDTH), which.reshape(HEIGHT, WIDTH)


@pytest.mark.parametrize("seed", range(5))
def test_it_sees_what_rays_see_even_across_the_camera_plane(seed: int) -> None:
    triangles = random_triangles(seed, 60)
    depth_m, which = by_rays(triangles, 0.05)
    drawn = rasterize(triangles, K, WIDTH, HEIGHT, 0.05)
    assert torch.equal(drawn.primitive, which)
    seen = which >= 0
    torch.testing.assert_close(drawn.depth_m[seen], depth_m[seen], rtol=1e-6, atol=0)
    assert bool(drawn.depth_m[~seen].isnan().all())


@pytest.mark.parametrize("near_m", [0.5, 2.0, 4.0])
def test_of_triangles_that_cross_the_near_plane_what_lies_beyond_is_seen(near_m: float) -> None:
    triangles = random_triangles(3, 60)
    is_near = triangles[..., 2] < near_m
    assert int((is_near.any(1) & ~is_near.all(1)).sum()) > 3, "some cross it"
    _, which = by_rays(triangles, near_m)
    drawn = rasterize(triangles, K, WIDTH, HEIGHT, near_m)
    assert torch.equal(drawn.primitive, which)
    assert float(drawn.depth_m[which >= 0].min()) >= near_m


def test_barycentric_shares_lead_to_the_seen_point() -> None:
    triangles = random_triangles(9, 40)
    drawn = rasterize(triangles, K, WIDTH, HEIGHT)
    seen = drawn.primitive >= 0
    assert drawn.barycentric is not None
    shares = drawn.barycentric[seen].double()
    points = (triangles[drawn.primitive[seen]] * shares[..., None]).sum(1)
    v, u = seen.nonzero().double().unbind(1)
    pixels = points @ K.mT
    torch.testing.assert_close(points[:, 2], drawn.depth_m[seen], rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(pixels[:, 0] / pixels[:, 2], u, rtol=0, atol=1e-3)
    torch.testing.assert_close(pixels[:, 1] / pixels[:, 2], v, rtol=0, atol=1e-3)
    assert bool((drawn.barycentric[~seen] == 0).all())


def test_edge_functions_give_barycentric_shares_over_depth() -> None:
    triangles = random_triangles(3, 1, near=4.0)
    edges, volume = edge_functions(triangles.double() @ K.mT)
    middle = triangles[0].mean(0)
    pixel = (middle @ K.mT) / middle[2]
    weight = edges[0] @ pixel / volume[0]
    torch.testing.assert_close(weight * middle[2], torch.full((3,), 1 / 3, dtype=torch.float64))


@pytest.mark.parametrize("shift", [0.0, 0.5, 1 / 3])
def test_shared_edges_have_no_cracks(shift: float) -> None:
    """A wall of a fan and of tiles whose edges run through pixel centres, seen whole."""
    steps = torch.linspace(-40, 80, 31, dtype=torch.float64) + shift
    u, v = torch.meshgrid(steps, steps, indexing="ij")
    depth = 5 + 0.02 * u
    pixels = torch.stack([u, v, torch.ones_like(u)], -1) * depth[..., None]
    grid = (pixels @ K.inverse().mT).float()
    a, b, c, d = grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]
    tiles = torch.stack([torch.stack([a, b, c], -2), torch.stack([a, c, d], -2)]).reshape(-1, 3, 3)
    angle = torch.linspace(0, 6.2832, 17)[:-1]
    rim = torch.stack([angle.cos() * 50, angle.sin() * 50, torch.full((16,), 9.0)], -1)
    fan = torch.stack([torch.tensor([[0.1, -0.1, 8]]).expand(16, 3), rim, rim.roll(-1, 0)], 1)
    for wall in (tiles, fan):
        assert bool((rasterize(wall, K, WIDTH, HEIGHT).primitive >= 0).all())


def test_the_order_of_triangles_does_not_matter() -> None:
    triangles = random_triangles(4, 50)
    order = torch.randperm(50, generator=torch.Generator().manual_seed(0))
    one, other = (rasterize(t, K, WIDTH, HEIGHT) for t in (triangles, triangles[order]))
    torch.testing.assert_close(one.depth_m, other.depth_m, rtol=0, atol=0, equal_nan=True)
    named = torch.where(other.primitive >= 0, order[other.primitive.clamp(min=0)], -1)
    assert torch.equal(one.primitive, named)


def test_a_small_budget_of_memory_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    triangles = random_triangles(5, 50)
    whole = rasterize(triangles, K, WIDTH, HEIGHT)
    monkeypatch.setattr(raster, "_MAX_ROWS", 30)
    monkeypatch.setattr(raster, "_MAX_PIXELS", 50)
    assert torch.equal(whole.primitive, rasterize(triangles, K, WIDTH, HEIGHT).primitive)


def test_the_lower_number_wins_between_equals() -> None:
    triangle = random_triangles(6, 1, near=5.0)
    drawn = rasterize(triangle.expand(3, 3, 3), K, WIDTH, HEIGHT)
    assert set(drawn.primitive.unique().tolist()) == {-1, 0}


def test_nothing_is_seen_of_nothing() -> None:
    flat = torch.tensor([[[0.0, 0, 5], [1, 1, 5], [2, 2, 5]], [[0, 0, 5], [0, 0, 5], [0, 0, 5]]])
    behind = torch.tensor([[[0.0, 0, -5], [1, 0, -5], [0, 1, -5]]])
    for triangles in (torch.zeros(0, 3, 3), flat, behind):
        drawn = rasterize(triangles, K, WIDTH, HEIGHT)
        assert bool((drawn.primitive == -1).all())
        assert bool(drawn.depth_m.isnan().all())
    assert bool((rasterize_orthographic(torch.zeros(0, 3, 3), 4, 5).primitive == -1).all())


def test_parallel_rays_see_the_lowest() -> None:
    roof = torch.tensor(
        [[[-1.0, -1, -3], [9, -1, -3], [-1, 9, 7]], [[0, 0, 1], [4, 0, 1], [0, 4, 1]]]
    )
    drawn = rasterize_orthographic(roof, 6, 5)
    assert drawn.barycentric is not None
    assert drawn.primitive[0, 0] == 0
    torch.testing.assert_close(drawn.depth_m[1, 0], torch.tensor(-1.0))
    # The slope reaches depth 1 at row 3: below it the second triangle is nearer, where it is.
    assert drawn.primitive[4, 0] == 1
    assert drawn.primitive[4, 5] == -1
    middle = (roof[0] * drawn.barycentric[1, 2][:, None]).sum(0)
    torch.testing.assert_close(middle, torch.tensor([2.0, 1.0, -1.0]), atol=1e-5, rtol=0)


def test_bad_input_is_refused() -> None:
    triangle = random_triangles(7, 1)
    with pytest.raises(InputError, match="width is 0"):
        rasterize(triangle, K, 0, 4)
    with pytest.raises(InputError, match="near_m is 0"):
        rasterize(triangle, K, 4, 4, 0.0)
    with pytest.raises(InputError, match="transposed"):
        rasterize(triangle, K.mT.contiguous(), 4, 4)
    with pytest.raises(InputError, match="not finite"):
        rasterize(triangle * torch.nan, K, 4, 4)
    with pytest.raises(InputError, match="height is -1"):
        rasterize_orthographic(triangle, 4, -1)


@pytest.mark.gpu
def test_the_accelerator_sees_the_same() -> None:
    if not torch.cuda.is_available():
        pytest.skip("no accelerator here")
    triangles = random_triangles(8, 80)
    one, other = (rasterize(t, K, WIDTH, HEIGHT) for t in (triangles, triangles.cuda()))
    assert torch.equal(one.primitive, other.primitive.cpu())
