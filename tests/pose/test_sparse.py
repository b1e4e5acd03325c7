"""The sparse convolution against the dense one of torch, and the laws that it obeys."""

from importlib import import_module

import pytest
import torch
import torch.nn.functional as F
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from depthpose.core.errors import InputError
from depthpose.pose.networks.kernel_map import (
    CLOUD_LIMIT,
    COORDINATE_LIMIT,
    CoordinateCache,
    list_offsets,
    pack,
    unpack,
)
from depthpose.pose.networks.sparse import SparseConv, SparseConvTranspose, Voxels, convolve

CONV = import_module("depthpose.pose.networks.sparse")
SIDE = 8
"""Dense grids run from -SIDE to SIDE - 1."""


def cloud(points: int = 60, clouds: int = 2, seed: int = 0) -> Tensor:
    """Distinct voxels about the origin, in no order."""
    generator = torch.Generator().manual_seed(seed)
    xyz = torch.randint(-5, 5, (points, 3), generator=generator)
    number = torch.randint(0, clouds, (points, 1), generator=generator)
    distinct = torch.unique(torch.cat([number, xyz], 1), dim=0)
    return distinct[torch.randperm(len(distinct), generator=generator)]


def features_of(coordinates: Tensor, channels: int, seed: int = 1) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(len(coordinates), channels, generator=generator, dtype=torch.float64)


def weight_of(kernel: int, inputs: int, outputs: int) -> Tensor:
    generator = torch.Generator().manual_seed(2)
    return torch.randn(kernel**3, inputs, outputs, generator=generator, dtype=torch.float64)


def scatter(features: Tensor, coordinates: Tensor, stride: int) -> Tensor:
    """Write rows into a dense grid of cells ``stride`` wide."""
    side = SIDE // stride
    b, x, y, z = coordinates.unbind(1)
    grid = features.new_zeros(int(b.max()) + 1, 2 * side, 2 * side, 2 * side, features.shape[1])
    cell = (b, x // stride + side, y // stride + side, z // stride + side)
    return grid.index_put(cell, features).permute(0, 4, 1, 2, 3)


def gather(grid: Tensor, coordinates: Tensor, stride: int) -> Tensor:
    b, x, y, z = coordinates.unbind(1)
    side = SIDE // stride
    cell = (b, x // stride + side, y // stride + side, z // stride + side)
    return grid.permute(0, 2, 3, 4, 1)[cell]


def dense_weight(weight: Tensor) -> Tensor:
    """(volume, in, out), x fastest, as torch's (out, in, x, y, z)."""
    k = round(len(weight) ** (1 / 3))
    return weight.view(k, k, k, *weight.shape[1:]).permute(4, 3, 2, 1, 0)


def dense_conv(x: Tensor, weight: Tensor, stride: int, *, is_transposed: bool) -> Tensor:
    k = round(len(weight) ** (1 / 3))
    w = dense_weight(weight)
    if is_transposed:
        return F.conv_transpose3d(x, w.transpose(0, 1), None, stride, k // 2, stride - 1)
    if k % 2 == 0:
        return F.conv3d(x, w, None, stride)
    return F.conv3d(x, w, None, stride, k // 2)


@pytest.fixture(params=["by grid", "by offset"])
def way(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both ways of computing the same."""
    module = vars(CONV)
    monkeypatch.setitem(module, "GRID_PRODUCTS", -1 if request.param == "by offset" else 1 << 30)


CASES = [
    (kernel, stride, is_transposed, inputs)
    for kernel, stride, is_transposed in [
        (3, 1, False), (5, 1, False), (7, 1, False), (3, 2, False), (5, 2, False), (3, 1, True),
        (7, 2, False), (2, 2, False), (3, 2, True), (5, 2, True), (1, 2, False),
        (7, 2, True), (7, 1, True), (3, 4, False), (3, 4, True),
    ]
    for inputs in (1, 6)
]  # fmt: skip


@pytest.mark.usefixtures("way")
@pytest.mark.parametrize(("kernel", "stride", "is_transposed", "inputs"), CASES)
def test_equals_the_dense_convolution(
    kernel: int, stride: int, is_transposed: bool, inputs: int
) -> None:
    """Forward and every gradient, in float64, with negative coordinates and two clouds."""
    points = Voxels.from_points(cloud(), features_of(cloud(), inputs))
    levels = stride.bit_length() - 1
    start, end = (levels, 0) if is_transposed else (0, levels)
    cache = points.cache
    x = features_of(unpack(cache.keys(start)), inputs).requires_grad_()
    weight = weight_of(kernel, inputs, 5).requires_grad_()
    found = convolve(
        x, weight, cache.kernel_map(start, kernel, stride, is_transposed=is_transposed)
    )

    grid = scatter(x, unpack(cache.keys(start)), 2**start)
    answer = dense_conv(grid, weight, stride, is_transposed=is_transposed)
    expected = gather(answer, unpack(cache.keys(end)), 2**end)
    # torch's transposed convolution is the adjoint of its convolution, as ours is of ours.
    torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-12)
    pull = features_of(expected, 5, seed=3)
    mine = torch.autograd.grad(found, (x, weight), pull)
    theirs = torch.autograd.grad(expected, (x, weight), pull)
    for gradient, wanted in zip(mine, theirs, strict=True):
        torch.testing.assert_close(gradient, wanted, rtol=1e-11, atol=1e-11)


def test_two_levels_down_and_up_equal_the_dense_convolutions() -> None:
    voxels = Voxels.from_points(cloud(), features_of(cloud(), 2))
    convs = [SparseConv(2, 3, 3, 2), SparseConv(3, 4, 3, 2, has_bias=True)]
    ups = [SparseConvTranspose(4, 3, 3, 2), SparseConvTranspose(3, 2, 3, 2)]
    found, grid = voxels, scatter(voxels.features, unpack(voxels.cache.keys(0)), 1)
    for layer in [*(c.double() for c in convs), *(u.double() for u in ups)]:
        found = layer(found)
        grid = dense_conv(grid, layer.weight, 2, is_transposed=layer.is_transposed)
        grid = grid if layer.bias is None else grid + layer.bias[:, None, None, None]
        stride, cells = 2**found.level, unpack(found.cache.keys(found.level))
        torch.testing.assert_close(found.features, gather(grid, cells, stride))
        # Between levels only stored voxels live on.
        grid = scatter(found.features, cells, stride)
    assert found.level == 0


def test_pairs_of_a_small_case_by_hand() -> None:
    """Three voxels in a row along x, and one apart: who meets whom, at which offset."""
    cache = CoordinateCache(pack(torch.tensor([[0, -1, 0, 0], [0, 0, 0, 0], [0, 1, 0, 0],
                                               [1, 0, 0, 0]])))  # fmt: skip
    kernel_map = cache.kernel_map(0, 3)
    pairs = kernel_map.neighbours.pairs
    met = set(zip(*(t.tolist() for t in (pairs.slot // 2, pairs.fine, pairs.coarse)), strict=True))
    offsets = list_offsets(3)
    left, right = offsets.index((-1, 0, 0)), offsets.index((1, 0, 0))
    assert met == {(left, 0, 1), (left, 1, 2), (right, 1, 0), (right, 2, 1)}
    pairs = kernel_map.neighbours.pairs
    assert (kernel_map.neighbours.centre, pairs.filled, pairs.counts) == (13, (left, right), (2, 2))
    assert unpack(cache.keys(1)).tolist() == [[0, -2, 0, 0], [0, 0, 0, 0], [1, 0, 0, 0]]


def test_a_table_and_a_binary_search_find_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    cloud_keys = Voxels.from_points(cloud()).cache
    by_table = [cloud_keys.kernel_map(*a).neighbours.table for a in ((0, 5), (0, 3, 2), (1, 3))]
    monkeypatch.setattr("depthpose.pose.networks.kernel_map.MAX_CELLS", 0)
    cloud_keys = CoordinateCache(cloud_keys.keys(0))
    by_search = [cloud_keys.kernel_map(*a).neighbours.table for a in ((0, 5), (0, 3, 2), (1, 3))]
    assert all(map(torch.equal, by_table, by_search))


@pytest.mark.parametrize(("kernel", "stride"), [(7, 1), (7, 2), (3, 4), (4, 4), (2, 4), (1, 4)])
@pytest.mark.parametrize("shift", range(4))
def test_no_look_leaves_the_table(
    kernel: int, stride: int, shift: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A full block, whichever of its planes the coarser voxels lie on or before."""
    xyz = torch.cartesian_prod(*[torch.arange(5) - shift] * 3)
    keys = pack(F.pad(xyz, (1, 0)))
    found = CoordinateCache(keys.sort().values).kernel_map(0, kernel, stride).neighbours.table
    monkeypatch.setattr("depthpose.pose.networks.kernel_map.MAX_CELLS", 0)
    wanted = CoordinateCache(keys.sort().values).kernel_map(0, kernel, stride).neighbours.table
    assert torch.equal(found, wanted)


@pytest.mark.parametrize(("kernel", "stride"), [(11, 1), (9, 2), (5, 4), (7, 4), (3, 8)])
def test_a_kernel_that_looks_beyond_the_table_is_refused(kernel: int, stride: int) -> None:
    cache = Voxels.from_points(cloud()).cache
    with pytest.raises(AssertionError, match=f"kernel {kernel} with stride {stride} looks"):
        cache.kernel_map(0, kernel, stride)


def test_voxels_far_apart_need_no_table_of_the_air_between() -> None:
    ends = COORDINATE_LIMIT - 1
    far = torch.tensor([[0, -ends, -ends, -ends], [0, ends, ends, ends], [0, ends, ends, ends - 1]])
    table = Voxels.from_points(far).cache.kernel_map(0, 3).neighbours.table
    assert int((table < 3).sum()) == 3 + 2


def test_offsets_run_with_x_fastest() -> None:
    assert list_offsets(3)[:4] == ((-1, -1, -1), (0, -1, -1), (1, -1, -1), (-1, 0, -1))
    assert list_offsets(2)[:3] == ((0, 0, 0), (1, 0, 0), (0, 1, 0))


def test_gradients_by_differences() -> None:
    cache = Voxels.from_points(cloud(12)).cache
    x = features_of(unpack(cache.keys(0)), 5).requires_grad_()
    weight = weight_of(3, 5, 2).requires_grad_()
    for kernel_map in (cache.kernel_map(0, 3), cache.kernel_map(0, 3, 2)):
        assert torch.autograd.gradcheck(lambda a, w, m=kernel_map: convolve(a, w, m), (x, weight))


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 10**6), st.tuples(*[st.integers(-50, 50)] * 3))
def test_moving_the_cloud_by_the_stride_moves_the_answer(
    seed: int, move: tuple[int, int, int]
) -> None:
    coordinates = cloud(40, seed=seed)
    down, up = SparseConv(2, 3, 3, 2).double(), SparseConvTranspose(3, 2, 3, 2).double()
    moved = coordinates + torch.tensor([0, *move]) * 2
    x = features_of(coordinates, 2)
    here, there = (Voxels.from_points(c, x) for c in (coordinates, moved))
    torch.testing.assert_close(
        up(down(here)).at_points(), up(down(there)).at_points(), rtol=0, atol=0
    )


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 10**6), st.randoms(use_true_random=False))
def test_the_order_of_points_changes_no_bit(seed: int, random: object) -> None:
    coordinates = cloud(40, seed=seed)
    order = list(range(len(coordinates)))
    random.shuffle(order)  # pyright: ignore[reportAttributeAccessIssue]
    x, layer = features_of(coordinates, 2), SparseConv(2, 3, 5).double()
    straight = layer(Voxels.from_points(coordinates, x)).at_points()
    shuffled = layer(Voxels.from_points(coordinates[order], x[order])).at_points()
    assert torch.equal(straight[order], shuffled)


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 10**6), st.floats(-3, 3), st.floats(-3, 3))
def test_linear_in_features_and_in_weight(seed: int, a: float, b: float) -> None:
    coordinates = cloud(40, seed=seed)
    m = Voxels.from_points(coordinates).cache.kernel_map(0, 3)
    x, y = (features_of(coordinates, 6, seed=s) for s in (3, 4))
    v, w = weight_of(3, 6, 3), weight_of(3, 6, 3).flip(0)
    torch.testing.assert_close(
        convolve(a * x + b * y, w, m), a * convolve(x, w, m) + b * convolve(y, w, m)
    )
    torch.testing.assert_close(
        convolve(x, a * v + b * w, m), a * convolve(x, v, m) + b * convolve(x, w, m)
    )


def test_clouds_of_a_batch_do_not_meet() -> None:
    one, two = cloud(30, 1, seed=5)[:, 1:], cloud(30, 1, seed=6)[:, 1:]
    layer = SparseConv(1, 4, 3, 2)
    first, second, alone = (
        F.pad(xyz, (1, 0), value=k) for xyz, k in ((one, 0), (two, 1), (two, 0))
    )
    together = layer(Voxels.from_points(torch.cat([first, second])))
    apart = [layer(Voxels.from_points(xyz)) for xyz in (first, alone)]
    torch.testing.assert_close(together.features, torch.cat([v.features for v in apart]))


@pytest.mark.parametrize("inputs", [1, 8])
def test_an_empty_cloud_is_a_cloud(inputs: int) -> None:
    nothing = torch.zeros(0, 4, dtype=torch.int64)
    voxels = Voxels.from_points(nothing, torch.zeros(0, inputs))
    down, same = SparseConv(inputs, 5, 3, 2), SparseConv(5, 5, 3)
    up = SparseConvTranspose(5, 2, 3, 2)
    answer = up(same(down(voxels))).at_points()
    assert answer.shape == (0, 2)
    answer.sum().backward()
    assert not down.weight.grad.any()  # pyright: ignore[reportOptionalMemberAccess]


def test_one_voxel_meets_itself_alone() -> None:
    layer = SparseConv(5, 3, 3)
    x = torch.randn(1, 5)
    answer = layer(Voxels.from_points(torch.tensor([[0, -7, 3, 0]]), x)).features
    torch.testing.assert_close(answer, x @ layer.weight[13])


def test_maps_are_made_once() -> None:
    cache = Voxels.from_points(cloud()).cache
    down = cache.kernel_map(0, 3, 2)
    assert cache.kernel_map(0, 3, 2).neighbours is down.neighbours
    assert cache.kernel_map(1, 3, 2, is_transposed=True).neighbours is down.neighbours
    assert cache.kernel_map(0, 3).neighbours is not down.neighbours


def test_the_gathered_rows_are_not_kept() -> None:
    """Only features and weight are saved for the way back."""
    coordinates = cloud(400)
    m = Voxels.from_points(coordinates).cache.kernel_map(0, 3)
    x = features_of(coordinates, 6).requires_grad_()
    kept: list[int] = []

    def note(tensor: Tensor) -> Tensor:
        kept.append(tensor.numel())
        return tensor

    weight = weight_of(3, 6, 5).requires_grad_()
    with torch.autograd.graph.saved_tensors_hooks(note, lambda tensor: tensor):
        convolve(x, weight, m)
    assert sorted(kept) == sorted([x.numel(), weight.numel()])


def test_autocast_is_followed() -> None:
    coordinates = cloud(400)
    m = Voxels.from_points(coordinates).cache.kernel_map(0, 3)
    x, weight = features_of(coordinates, 6).float(), weight_of(3, 6, 5).float().requires_grad_()
    with torch.autocast("cpu", torch.bfloat16):
        half = convolve(x, weight, m)
    assert half.dtype == torch.bfloat16
    torch.testing.assert_close(half.float(), convolve(x, weight, m), rtol=0.05, atol=0.3)
    half.float().sum().backward()
    assert weight.grad is not None


def test_keys_come_back_and_sort_as_coordinates_do() -> None:
    limit = COORDINATE_LIMIT
    ends = torch.tensor(
        [[0, -limit, 0, limit - 1], [0, -1, -1, -1], [3, 0, -limit, 0], [CLOUD_LIMIT - 1, 1, 2, 3]]
    )
    assert torch.equal(unpack(pack(ends)), ends)
    assert torch.equal(pack(ends).sort().values, pack(ends))


@pytest.mark.parametrize(
    ("row", "text"),
    [
        ([0, COORDINATE_LIMIT, 0, 0], "centre each cloud on its mean"),
        ([0, 0, 0, -COORDINATE_LIMIT - 1], r"run from -61441 to 0.*\[-61440, 61440\)"),
        ([-1, 0, 0, 0], "cloud numbers run from -1 to -1"),
        ([CLOUD_LIMIT, 0, 0, 0], "split the batch"),
    ],
)
def test_coordinates_out_of_range_are_refused(row: list[int], text: str) -> None:
    with pytest.raises(InputError, match=text):
        Voxels.from_points(torch.tensor([row]))


def test_points_in_one_voxel_are_refused() -> None:
    coordinates = torch.tensor([[0, 1, 0, 0], [0, -2, 0, 5], [0, 1, 0, 0]])
    x = torch.tensor([[1.0], [10.0], [3.0]])
    with pytest.raises(InputError, match=r"1 points share .* \[1, 0, 0\] of cloud 0; keep one"):
        Voxels.from_points(coordinates, x)


@pytest.mark.gpu
def test_cuda_answers_as_the_cpu_does_and_the_same_each_time() -> None:
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    coordinates = cloud(900)
    x, weight = features_of(coordinates, 6), weight_of(3, 6, 5)
    expected = convolve(x, weight, Voxels.from_points(coordinates).cache.kernel_map(0, 3))
    there = Voxels.from_points(coordinates.cuda()).cache.kernel_map(0, 3)
    torch.use_deterministic_algorithms(True)
    try:
        found = [convolve(x.cuda(), weight.cuda(), there) for _ in range(5)]
    finally:
        torch.use_deterministic_algorithms(False)
    torch.testing.assert_close(found[0].cpu(), expected, rtol=1e-12, atol=1e-12)
    assert all(torch.equal(found[0], again) for again in found)
