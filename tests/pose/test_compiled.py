"""What numba compiles gives what torch gives."""

import inspect
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from typing import Any, TypeVar

import pytest
import torch
from torch import Tensor

from depthpose.core.errors import Notice
from depthpose.core.rigid import Rigid, rotation_by
from depthpose.pose import compiled
from depthpose.pose.config import IcpConfig
from depthpose.pose.icp import RefinedPose, refine_best, refine_pose, refine_roughly
from depthpose.pose.identity import scale_of
from depthpose.pose.network import ResUNet, ResUNetConfig
from depthpose.pose.propose.point_pairs import prepare_pairs, vote_poses
from depthpose.pose.sparse import Voxels, conv
from depthpose.pose.surface import Surface, look_along_rays, prepare_surface
from depthpose.pose.synthetic.parts import make_part

pytest.importorskip("numba")

T = TypeVar("T")
PARTS = ("bracket", "spool")


@pytest.fixture(autouse=True)
def _without_gradients() -> Iterator[None]:
    with torch.no_grad():
        yield
    compiled.is_compiled.cache_clear()


def both(compute: Callable[[], T], monkeypatch: pytest.MonkeyPatch) -> tuple[T, T]:
    """Compute with torch, then with compiled functions."""
    found = []
    for switch in ("0", "1"):
        monkeypatch.setenv("DEPTHPOSE_COMPILED", switch)
        compiled.is_compiled.cache_clear()
        assert compiled.is_compiled() == (switch == "1")
        found.append(compute())
    return found[0], found[1]


@pytest.fixture(params=PARTS, scope="module")
def surface(request: pytest.FixtureRequest) -> Surface:
    return prepare_surface(make_part(request.param), 4000)


def seen(surface: Surface, pose: Rigid, count: int = 800) -> Tensor:
    """Noisy points of a posed surface, and some that lie elsewhere."""
    generator = torch.Generator().manual_seed(3)
    index = torch.randint(len(surface.points_m), (count,), generator=generator)
    noise = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    noise *= 0.003 * surface.diameter_m
    noise[::10] *= 60
    return pose.apply(surface.points_m[index] + noise)


def poses(surface: Surface, count: int, spread: float = 0.2) -> Rigid:
    """Poses about one that lies before the camera; the first is that one."""
    generator = torch.Generator().manual_seed(5)
    turn, shift = torch.randn(2, count, 3, generator=generator, dtype=torch.float64)
    turn[0] = shift[0] = 0
    middle_m = torch.tensor([0.03, -0.02, 0.7], dtype=torch.float64)
    return Rigid(rotation_by(spread * turn), middle_m + 0.1 * spread * shift * surface.diameter_m)


def is_near(a: Tensor, b: Tensor, limit: float) -> bool:
    return bool(((a - b).abs() <= limit).all())


def test_nearest_surface_points(surface: Surface, monkeypatch: pytest.MonkeyPatch) -> None:
    generator = torch.Generator().manual_seed(1)
    asked_m = surface.diameter_m * torch.randn(3, 300, 3, generator=generator).double()
    first, second = both(lambda: surface.nearest(asked_m), monkeypatch)
    assert torch.equal(first, second)
    assert first.shape == (3, 300)


@pytest.mark.parametrize("count", [1, 7, 8, 9, 100])
def test_trees_of_few_points(count: int) -> None:
    from depthpose.pose.compiled.points import Tree, build_tree, nearest_many

    generator = torch.Generator().manual_seed(count)
    points = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    points[count // 2] = points[0]  # two alike
    asked = torch.randn(50, 3, generator=generator, dtype=torch.float64)
    _, found = nearest_many(asked.numpy(), Tree(*build_tree(points.numpy())))
    true = torch.cdist(asked, points, compute_mode="donot_use_mm_for_euclid_dist").amin(1)
    assert is_near(torch.from_numpy(found), true, 1e-12)


def equal(a: RefinedPose, b: RefinedPose, limit: float) -> bool:
    pairs = [
        (a.camera_from_model.R, b.camera_from_model.R),
        (a.camera_from_model.t_m, b.camera_from_model.t_m),
        (a.residual_m, b.residual_m),
        (a.inlier_share, b.inlier_share),
    ]
    return all(is_near(*pair, limit) for pair in pairs)


def test_refined_poses(surface: Surface, monkeypatch: pytest.MonkeyPatch) -> None:
    starts = poses(surface, 4)
    cloud_m = seen(surface, starts[0])
    a, b = both(lambda: refine_pose(cloud_m, starts, surface), monkeypatch)
    # A spool turns freely about its axis, where rounding decides.
    assert equal(a, b, 1e-6 if len(surface.symmetries.R) > 1 else 1e-10)
    one, other = both(lambda: refine_pose(cloud_m, starts[1], surface), monkeypatch)
    assert one.camera_from_model.R.shape == (3, 3)
    assert equal(one, other, 1e-6 if len(surface.symmetries.R) > 1 else 1e-10)


def test_nothing_near_moves_nothing(surface: Surface, monkeypatch: pytest.MonkeyPatch) -> None:
    start = poses(surface, 1)[0]
    away_m = seen(surface, start) + 5.0
    for found in both(lambda: refine_pose(away_m, start, surface), monkeypatch):
        assert torch.equal(found.camera_from_model.R, start.R)
        assert float(found.inlier_share) == 0


def test_rough_poses(surface: Surface, monkeypatch: pytest.MonkeyPatch) -> None:
    starts = poses(surface, 6)
    cloud_m = seen(surface, starts[0])
    a, b = both(lambda: refine_roughly(cloud_m, starts, surface, IcpConfig()), monkeypatch)
    assert is_near(a.R, b.R, 1e-6)
    assert is_near(a.t_m, b.t_m, 1e-7)


def test_the_best_pose(surface: Surface, monkeypatch: pytest.MonkeyPatch) -> None:
    starts = poses(surface, 2)
    cloud_m = seen(surface, starts[0])
    a, b = both(lambda: refine_best(cloud_m, starts, surface), monkeypatch)
    assert equal(a.refined, b.refined, 1e-6)


@pytest.mark.parametrize("times", [1.0, 1.06, 0.9])
def test_scales(times: float, surface: Surface, monkeypatch: pytest.MonkeyPatch) -> None:
    pose = poses(surface, 1)[0]
    cloud_m = pose.apply(times * pose.inverse().apply(seen(surface, pose)))
    a, b = both(lambda: scale_of(cloud_m, pose, surface, 0.001), monkeypatch)
    assert abs(a.times - b.times) < 1e-6
    assert abs(a.sigma - b.sigma) < 1e-6
    assert abs(a.gain - b.gain) < 1e-6


def test_rays(surface: Surface, monkeypatch: pytest.MonkeyPatch) -> None:
    every = poses(surface, 5, spread=1.0)
    every = Rigid(every.R, torch.cat([every.t_m[:4], -every.t_m[4:]]))  # the last behind the camera
    cloud_m = seen(surface, every[0])
    a, b = both(lambda: look_along_rays(cloud_m, every, surface, every=2), monkeypatch)
    for first, second in zip(a, b, strict=True):
        assert is_near(first, second, 1e-12)
    assert float(a[0][-1]) == float(a[1][-1]) == 1


def test_networks(monkeypatch: pytest.MonkeyPatch) -> None:
    torch.manual_seed(0)
    widths = {"encoder": (8, 8, 16, 16), "decoder": (8, 8, 8, 8), "first_kernel": 5}
    network = ResUNet(ResUNetConfig(classes=2, keypoints=8, inputs=9, **widths)).eval()
    generator = torch.Generator().manual_seed(8)
    cells = torch.randint(-9, 9, (400, 3), generator=generator).unique(dim=0)
    clouds = torch.cat([torch.nn.functional.pad(cells, (1, 0), value=k) for k in (0, 3)])
    features = torch.randn(len(clouds), 9, generator=generator)
    a, b = both(lambda: network(Voxels.from_points(clouds, features)), monkeypatch)
    assert is_near(a, b, 1e-5)
    assert float(a.abs().max()) > 1e-3


def test_gradients_are_torch_s(monkeypatch: pytest.MonkeyPatch) -> None:
    network = ResUNet(ResUNetConfig(classes=1, encoder=(4, 4, 4, 4), decoder=(4, 4, 4, 4)))
    cells = torch.nn.functional.pad(torch.randint(0, 6, (60, 3)).unique(dim=0), (1, 0))

    def gradient() -> Tensor:
        with torch.enable_grad():
            network.zero_grad()
            network(Voxels.from_points(cells)).square().sum().backward()
        found = network.final.weight.grad
        assert found is not None
        return found.clone()

    a, b = both(gradient, monkeypatch)
    assert torch.equal(a, b)


def test_what_is_not_finite_is_refused(surface: Surface) -> None:
    pose = poses(surface, 1)
    cloud_m = seen(surface, pose[0])
    cloud_m[3, 1] = torch.nan
    strange = Rigid(pose.R, pose.t_m * torch.nan)
    calls = (
        lambda: surface.nearest(cloud_m),
        lambda: look_along_rays(cloud_m, pose, surface),
        lambda: look_along_rays(cloud_m[5:], strange, surface),
        lambda: refine_roughly(cloud_m[5:], strange, surface, IcpConfig()),
    )
    for call in calls:
        with pytest.raises(ValueError, match="finite"):
            call()


def test_rows_that_do_not_fit_are_refused() -> None:
    cells = torch.nn.functional.pad(torch.randint(0, 6, (60, 3)).unique(dim=0), (1, 0))
    kernel_map = Voxels.from_points(cells).cache.kernel_map(0, 3)
    with pytest.raises(AssertionError, match="a row for each voxel"):
        conv(torch.zeros(3, 8), torch.zeros(27, 8, 5), kernel_map)


def test_gradients_pass_through_rays_and_rough_poses(surface: Surface) -> None:
    starts = poses(surface, 2)
    cloud_m = seen(surface, starts[0])
    with torch.enable_grad():
        moved = Rigid(starts.R, starts.t_m.clone().requires_grad_())
        look_along_rays(cloud_m, moved, surface)
        assert refine_roughly(cloud_m, moved, surface, IcpConfig()).t_m.requires_grad


def test_without_a_folder_for_what_is_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    import numba

    given = []

    def njit(*, cache: bool = False, **words: object) -> Callable[[T], T]:
        if cache:
            raise RuntimeError("cannot cache function: no locator available")
        given.append(words)
        return lambda function: function

    monkeypatch.setattr(numba, "njit", njit)
    assert compiled.compiled(test_networks) is inspect.unwrap(test_networks)
    assert len(given) == 1


def test_what_is_compiled_is_kept_by_all_sources(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config: Any = import_module("numba").config
    before = config.CACHE_DIR
    folders = []

    def njit(**words: object) -> Callable[[T], T]:
        folders.append(config.CACHE_DIR)
        return lambda function: function

    monkeypatch.setattr("numba.njit", njit)
    monkeypatch.setattr(compiled, "__file__", str(tmp_path / "__init__.py"))
    for text in ("one", "another"):
        (tmp_path / "loop.py").write_text(text)
        compiled.compiled(test_networks)
    assert folders[0] != folders[1]
    assert before == config.CACHE_DIR


def test_a_numba_that_cannot_be_imported_is_no_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(name: str) -> None:
        raise ImportError(f"{name} needs NumPy 2.3 or less")

    monkeypatch.setenv("DEPTHPOSE_COMPILED", "1")
    monkeypatch.setattr(compiled, "import_module", fail)
    compiled.is_compiled.cache_clear()
    with pytest.warns(Notice, match=r"numba needs NumPy 2.3 or less.*computed by torch"):
        assert not compiled.is_compiled()


def test_votes_of_point_pairs(monkeypatch: pytest.MonkeyPatch) -> None:
    part = prepare_surface(make_part("bracket"), 4000)
    generator = torch.Generator().manual_seed(2)
    chosen = torch.randperm(len(part.points_m), generator=generator)[:150]
    pose = poses(part, 1)[0]
    points_m, normals = pose.apply(part.points_m[chosen]), part.normals[chosen] @ pose.R.mT
    table, references = prepare_pairs(part), torch.arange(10)
    first, second = both(lambda: vote_poses(points_m, normals, references, table, 3), monkeypatch)
    assert len(first[1]) == 30
    assert is_near(first[1], second[1], 1e-4 * float(first[1].max()))
    is_same = (first[0].t_m - second[0].t_m).norm(dim=-1) < 1e-9
    assert float(is_same.double().mean()) > 0.9, "but for ties"


@pytest.mark.slow
def test_the_rest_of_the_tests_with_torch_alone() -> None:
    """Edge cases are tested once, by what is installed: here without numba.

    Searches for alternatives have one form, and their refinement is that of ``refine``.
    """
    names = ("refine", "surface", "voting", "scale", "mirror", "sparse", "cloud",
             "refusal", "keypoint_pose", "network", "estimator")  # fmt: skip
    files = [f"tests/pose/test_{name}.py" for name in names]
    environment = {**os.environ, "DEPTHPOSE_COMPILED": "0"}
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *files]
    subprocess.run(command, check=True, env=environment)
