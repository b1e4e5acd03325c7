"""Compiled loops give what plain formulas give, of NumPy and SciPy, and are kept on disk."""

from collections.abc import Callable, Iterator
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from torch import Tensor

from depthpose.core.rigid import Rigid, perturb, rotation_by
from depthpose.pose import compiled
from depthpose.pose.geometry.kdtree import build_tree, find_nearest_points
from depthpose.pose.geometry.surface import Surface, look_along_rays, match, prepare_surface
from depthpose.pose.icp import (
    Residuals,
    build_normal_equations,
    icp,
    make_rotation,
    refine_roughly,
    tukey_weight,
)
from depthpose.pose.propose.pair_votes import ANGLES, DISTANCES, TURNS
from depthpose.pose.propose.point_pairs import STEP, PairTable, prepare_pairs, vote_poses
from depthpose.pose.synthetic.parts import make_part
from depthpose.pose.verify.identity import _linearise_growth

PARTS = ("bracket", "spool")


@pytest.fixture(autouse=True)
def _without_gradients() -> Iterator[None]:
    with torch.no_grad():
        yield


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


def test_nearest_surface_points(surface: Surface) -> None:
    generator = torch.Generator().manual_seed(1)
    asked_m = surface.diameter_m * torch.randn(3, 300, 3, generator=generator).double()
    _, expected = KDTree(surface.points_m.numpy()).query(asked_m.numpy())
    assert torch.equal(surface.nearest(asked_m).sample, torch.from_numpy(expected))


@pytest.mark.parametrize("count", [1, 7, 8, 9, 100])
def test_trees_of_few_points(count: int) -> None:
    generator = torch.Generator().manual_seed(count)
    points = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    points[count // 2] = points[0]  # two alike
    asked = torch.randn(50, 3, generator=generator, dtype=torch.float64)
    tree = build_tree(points.numpy(), np.zeros((count, 3)))
    index = find_nearest_points(asked.numpy(), tree)
    distances = torch.cdist(asked, points, compute_mode="donot_use_mm_for_euclid_dist")
    found = distances[torch.arange(50), torch.from_numpy(index)]
    assert torch.allclose(found, distances.amin(1), rtol=0, atol=1e-12)


@pytest.mark.parametrize("is_exact", [True, False])
def test_matches_face_the_camera(surface: Surface, is_exact: bool) -> None:
    target, generator = surface.sample_tree, np.random.default_rng(2)
    queries = 0.4 * surface.diameter_m * generator.normal(size=(200, 3))
    eye, limit = np.array([0.1, -0.3, 0.8]), 0.15 * surface.diameter_m
    places = np.full(200, -1)
    match(queries, target, tuple(eye), 0.0, limit, is_exact, places)
    points, outward = target.tree.points, target.tree.outward
    is_facing = ((eye - points) * outward).sum(1) >= 0
    distance = np.linalg.norm(queries[:, None] - points, axis=2)
    if is_exact:
        distance[:, ~is_facing] = np.inf
        nearest = distance.argmin(1)
        expected = np.where(distance.min(1) < limit, nearest, -1)
    else:  # the sample in the table, else that across the wall
        near = surface.boxes.look_up(torch.from_numpy(queries)).numpy()
        place = np.argsort(target.tree.order)
        first = place[near]
        across = np.append(place, -1)[surface.across.numpy()[near]]
        second = np.where((across >= 0) & is_facing[across], across, -1)
        expected = np.where(is_facing[first], first, second)
    assert 0 < (expected >= 0).sum() < 200
    assert np.array_equal(places, expected)


def test_a_table_is_looked_up_in_the_box_of_a_point(surface: Surface) -> None:
    boxes, generator = surface.boxes, torch.Generator().manual_seed(4)
    points_m = surface.diameter_m * torch.randn(2, 90, 3, generator=generator).double()
    box = ((points_m - boxes.low_m) / boxes.side_m).long().clamp(min=0).minimum(boxes.counts - 1)
    number = (box[..., 0] * boxes.counts[1] + box[..., 1]) * boxes.counts[2] + box[..., 2]
    assert torch.equal(boxes.look_up(points_m), boxes.nearest[number])


def test_tukey_weights() -> None:
    square = np.array([0.0, 1.0, 4.0, 9.0])
    assert np.allclose(tukey_weight(square, 2.0), [1, 9 / 16, 0, 0])
    assert tukey_weight(1.0, 2.0) == pytest.approx(9 / 16)


@pytest.mark.parametrize("angle", [0.0, 1e-7, 5e-5, 0.3, 3.0])
def test_rotation_matrices(angle: float) -> None:
    vector = angle * np.array([2.0, -1.0, 2.0]) / 3
    expected = Rotation.from_rotvec(vector).as_matrix()
    assert np.allclose(make_rotation(vector), expected, rtol=0, atol=1e-14)


def test_normal_equations() -> None:
    generator = np.random.default_rng(0)
    J, distance, weight = generator.normal(size=(40, 6)), generator.normal(size=40), np.ones(40)
    weight[::3] = 0.0
    J[weight == 0] = np.inf  # what has no weight is not read
    H, b = build_normal_equations(Residuals(J, distance, weight), 1e-6)
    J = J[weight > 0]
    assert np.allclose(H, J.T @ J, rtol=1e-8)
    assert np.allclose(b, J.T @ distance[weight > 0])
    none = Residuals(np.zeros((4, 6)), np.zeros(4), np.zeros(4))
    assert np.allclose(build_normal_equations(none, 1e-6)[0], 1e-15 * np.eye(6), rtol=1e-12, atol=0)


def test_residuals_change_with_a_scale_as_their_derivatives_say(surface: Surface) -> None:
    local_m = seen(surface, Rigid(torch.eye(3).double(), torch.zeros(3).double())).numpy()
    middle = surface.middle_m.numpy()
    limit = 0.1 * surface.diameter_m
    places = np.full((2, len(local_m)), -1)
    here, there = (
        _linearise_growth(local_m, scale, middle, limit, surface.sample_tree, True, places[k])
        for k, scale in enumerate((1.0, 1.0 + 1e-7))
    )
    both = (here.weight > 0) & (there.weight > 0) & (places[0] == places[1])
    assert both.sum() > 300
    change = (there.distance - here.distance)[both]
    assert np.allclose(change, -1e-7 * here.jacobian[both, 6], rtol=0, atol=1e-13)


def test_residuals_of_a_pose(surface: Surface) -> None:
    """Distances from the planes of the samples, which move with the pose."""
    pose = poses(surface, 1)[0]
    cloud_m = seen(surface, pose)
    limit_m = 0.05 * surface.diameter_m
    _, found = icp(cloud_m, pose, surface, distances_m=[limit_m], max_points=800, is_exact=False)
    local_m = pose.inverse().apply(cloud_m)
    index = surface.boxes.look_up(local_m)
    sample_m = surface.points_m[index]
    normal = surface.normals[index] @ pose.R.mT
    gap_m = cloud_m - pose.apply(sample_m)
    weight = (1 - gap_m.square().sum(-1) / limit_m**2).clamp(min=0).square()
    camera_m = pose.inverse().t_m
    is_facing = ((camera_m - sample_m) * surface.outward[index]).sum(-1) > 0
    is_compared = is_facing & (weight > 0)
    assert int(is_compared.sum()) > 200
    distance_m = (normal * gap_m).sum(-1)
    assert torch.allclose(found.weight[is_facing], weight[is_facing], atol=1e-9)
    assert torch.allclose(found.residual_m[is_compared], distance_m[is_compared], atol=1e-12)

    # A small motion about the middle of the cloud.
    middle_m = cloud_m.mean(0)
    generator = torch.Generator().manual_seed(0)
    motion = 1e-6 * torch.randn(6, generator=generator, dtype=torch.float64)
    turned = perturb(Rigid(pose.R, pose.t_m - middle_m), motion)
    moved_m = turned.apply(sample_m) + middle_m
    change_m = -(normal * (moved_m - pose.apply(sample_m))).sum(-1)
    expected_m = -(found.jacobian @ motion)
    assert torch.allclose(change_m[is_compared], expected_m[is_compared], rtol=0, atol=1e-11)


def test_rays(surface: Surface) -> None:
    every = poses(surface, 5, spread=1.0)
    every = Rigid(every.R, torch.cat([every.t_m[:4], -every.t_m[4:]]))  # the last behind the camera
    cloud_m = seen(surface, every[0])
    violation, unobserved = look_along_rays(cloud_m, every, surface, every=2)
    cloud = cloud_m.numpy()
    scale = np.sort(cloud[:, 2])[(len(cloud) - 1) // 2] * 24 / surface.diameter_m

    def cells(points: np.ndarray) -> np.ndarray:
        rays = points[:, :2] / points[:, 2:] * scale
        return np.floor(rays - np.floor(np.sort(cloud_rays, 0)[(len(cloud) - 1) // 2]))

    cloud_rays = cloud[:, :2] / cloud[:, 2:] * scale
    cloud_cells = [tuple(cell) for cell in cells(cloud)]
    limit_m = 1.5 * 0.05 * surface.diameter_m
    for k in range(4):
        posed = every[k].apply(surface.points_m[::2]).numpy()
        nearest: dict[tuple[float, ...], float] = {}
        for cell, z in zip(cells(posed), posed[:, 2], strict=True):
            nearest[tuple(cell)] = min(z, nearest.get(tuple(cell), np.inf))
        occluded = [
            nearest.get(cell, np.inf) < z - limit_m
            for cell, z in zip(cloud_cells, cloud[:, 2], strict=True)
        ]
        missed = [cell not in set(cloud_cells) for cell in nearest]
        assert float(violation[k]) == pytest.approx(np.mean(occluded), abs=1e-12)
        assert float(unobserved[k]) == pytest.approx(np.mean(missed), abs=1e-12)
    assert float(violation[4]) == float(unobserved[4]) == 1


def feature_of(points: np.ndarray, bases: np.ndarray, i: int, j: int) -> tuple[np.ndarray, float]:
    """The feature of a pair, distance in metres and angles in bins, and its turn."""
    way = points[j] - points[i]
    along = way / max(float(np.linalg.norm(way)), 1e-12)  # both sides of a sheet are at one place
    n, m = bases[i, :, 0], bases[j, :, 0]
    angles = np.arccos(np.clip([along @ n, along @ m, n @ m], -1, 1)) * ANGLES / np.pi
    turn = np.arctan2(way @ bases[i, :, 2], way @ bases[i, :, 1])
    return np.array([np.linalg.norm(way), *angles]), turn


def votes_by_hand(points: np.ndarray, bases: np.ndarray, i: int, table: PairTable) -> np.ndarray:
    """The votes of one reference, by dictionaries: (model points, turns)."""
    step = STEP * table.surface.diameter_m
    bounds = table.bounds.numpy()
    counts = np.zeros((len(table.points_m), TURNS))
    seen_features: set[tuple[int, int]] = set()
    last = np.array([DISTANCES, ANGLES - 1, ANGLES - 1, ANGLES - 1])
    for j in range(len(points)):
        distance = np.linalg.norm(points[j] - points[i])
        if not step < distance < DISTANCES * step:
            continue
        feature, turn = feature_of(points, bases, i, j)
        feature[0] /= step
        own = np.floor(feature)
        beside = own + np.where(feature - own < 0.5, -1, 1) * np.eye(4)
        bins = np.clip([own, *beside], 0, last).astype(int)
        for key in dict.fromkeys(int(row @ [ANGLES**3, ANGLES**2, ANGLES, 1]) for row in bins):
            turn_bin = int((turn + np.pi) / (2 * np.pi) * TURNS)
            pairs = range(bounds[key], bounds[key + 1])
            if (key, turn_bin) in seen_features or not pairs:
                continue
            seen_features.add((key, turn_bin))
            for p in pairs[:150]:
                share = (turn / (2 * np.pi) - float(table.turn[p]) / TURNS) % 1
                counts[int(table.first[p]), int(share * TURNS) % TURNS] += len(pairs) ** -0.5
    return 2 * counts + np.roll(counts, 1, 1) + np.roll(counts, -1, 1)


def test_votes_of_point_pairs() -> None:
    part = prepare_surface(make_part("bracket"), 4000)
    generator = torch.Generator().manual_seed(2)
    chosen = torch.randperm(len(part.points_m), generator=generator)[:150]
    pose = poses(part, 1)[0]
    # Noisy, since a right angle lies in the middle of a bin, where rounding decides.
    noise = 0.05 * torch.randn(150, 3, generator=generator, dtype=torch.float64)
    normals = torch.nn.functional.normalize(part.normals[chosen] @ pose.R.mT + noise, dim=-1)
    points_m = pose.apply(part.points_m[chosen])
    table, references = prepare_pairs(part), torch.arange(3)
    found, votes = vote_poses(points_m, normals, references, table, 4)
    assert found.R.shape == (12, 3, 3)
    least = torch.eye(3).double()[normals.abs().argmin(-1)]
    first = torch.nn.functional.normalize(torch.linalg.cross(normals, least), dim=-1)
    bases = torch.stack([normals, first, torch.linalg.cross(normals, first)], -1).numpy()
    for r in range(3):
        by_hand = votes_by_hand(points_m.numpy(), bases, r, table)
        best = np.sort(by_hand.max(1))[::-1][:4]
        assert np.allclose(votes[4 * r : 4 * r + 4].numpy(), best, rtol=1e-4)
    # Each pose puts a point of the model on its reference, with its normal.
    on_reference_m = (
        found.apply(table.points_m) - points_m[[0] * 4 + [1] * 4 + [2] * 4, None]
    ).norm(dim=-1)
    assert float(on_reference_m.amin(1).max()) < 1e-9


def test_pairs_of_a_model_are_sorted_by_their_features() -> None:
    table = prepare_pairs(prepare_surface(make_part("bracket"), 4000))
    points, bases = table.points_m.numpy(), table.bases.numpy()
    bounds, generator = table.bounds.numpy(), np.random.default_rng(0)
    assert bounds[-1] == len(table.first) == len(points) * (len(points) - 1)
    step = STEP * table.surface.diameter_m
    for p in generator.integers(len(table.first), size=20):
        # Some second point makes a pair of the feature that its place says, with its turn.
        i, key = int(table.first[p]), int(np.searchsorted(bounds, p, side="right")) - 1
        of_first = []
        for j in range(len(points)):
            if j == i:
                continue
            feature, turn = feature_of(points, bases, i, j)
            feature[0] /= step
            own = np.clip(feature.astype(int), 0, [DISTANCES, *[ANGLES - 1] * 3])
            if int(own @ [ANGLES**3, ANGLES**2, ANGLES, 1]) == key:
                of_first.append(abs(turn - float(table.turn[p]) * 2 * np.pi / TURNS))
        assert min(of_first) < 1e-6


def test_what_is_not_finite_is_refused(surface: Surface) -> None:
    pose = poses(surface, 1)
    cloud_m = seen(surface, pose[0])
    cloud_m[3, 1] = torch.nan
    strange = Rigid(pose.R, pose.t_m * torch.nan)
    calls = (
        lambda: surface.nearest(cloud_m),
        lambda: surface.boxes.look_up(cloud_m),
        lambda: look_along_rays(cloud_m, pose, surface),
        lambda: look_along_rays(cloud_m[5:], strange, surface),
        lambda: refine_roughly(cloud_m[5:], strange, surface),
    )
    for call in calls:
        with pytest.raises(ValueError, match="finite"):
            call()


def test_what_has_gradients_is_taken_without_them(surface: Surface) -> None:
    starts = poses(surface, 2)
    cloud_m = seen(surface, starts[0])
    plain = refine_roughly(cloud_m, starts, surface)
    with torch.enable_grad():
        learned = Rigid(starts.R, starts.t_m.clone().requires_grad_())
        refined = refine_roughly(cloud_m, learned, surface)
    assert torch.equal(refined.t_m, plain.t_m)
    assert not refined.t_m.requires_grad


def test_without_a_folder_for_what_is_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    import numba

    given = []

    def njit(*, cache: bool = False, **words: object) -> Callable[[object], object]:
        if cache:
            raise RuntimeError("cannot cache function: no locator available")
        given.append(words)
        return lambda function: function

    monkeypatch.setattr(numba, "njit", njit)
    assert compiled.compiled(plus_one)(2) == 3
    assert len(given) == 1


def plus_one(number: int) -> int:
    return number + 1


def written(folder: Path, name: str, text: str) -> ModuleType:
    """Write a module, and import it."""
    path = folder / f"{name}.py"
    path.write_text(text)
    spec = spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_what_is_compiled_is_kept_until_a_file_changes(tmp_path: Path) -> None:
    """Also where the file of a function that is called changes, which numba does not look at."""
    head = "from depthpose.pose.compiled import compiled\n\n@compiled\n"
    inner = head + "def step(x):\n    return x + {}\n"
    outer = head + "def twice(x):\n    return step(step(x))\n"
    # Numbers of unlike lengths: within a second Python tells two states of a file by its length.
    for added, answer in ((1, 2), (50, 100), (1, 2)):
        called = written(tmp_path, "called", inner.format(added))
        caller = written(tmp_path, "caller", outer)
        vars(caller)["step"] = called.step
        assert caller.twice(0) == answer
    kept = {path.name for path in tmp_path.rglob("*.nbi") if path.name.startswith("caller.")}
    assert len(kept) == 2, "the third time it was read"
