import json
import math
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
import torch
import trimesh

from depthpose.core.errors import InputError
from depthpose.core.files import read_json
from depthpose.core.rigid import Rigid, geodesic_rad, rotation_by
from depthpose.pose.cloud import advise_unit
from depthpose.pose.config import MeshConfig
from depthpose.pose.mesh import (
    SymmetryProposal,
    farthest_points,
    make_model,
    measure_diameter,
    propose_symmetries,
    read_model,
    sample_surface,
    symmetries_from_bop,
    symmetries_from_proposals,
    symmetries_to_bop,
    symmetry_transforms,
    turn_about,
)
from depthpose.pose.mesh.deviation import SurfaceDeviation
from depthpose.pose.types import Axis, ObjectModel, Symmetries


def model_of(mesh: trimesh.Trimesh, config: MeshConfig | None = None) -> ObjectModel:
    vertices = torch.from_numpy(np.array(mesh.vertices))
    return make_model(vertices, torch.from_numpy(np.array(mesh.faces)), name="it", config=config)


@pytest.fixture
def box() -> ObjectModel:
    return model_of(trimesh.creation.box((0.1, 0.2, 0.3)))


def stone(scale: float = 1) -> trimesh.Trimesh:
    """Make a body whose points have no equal distances: nothing about it is a matter of chance."""
    points = np.random.default_rng(0).normal(size=(20, 3)) * [0.05, 0.08, 0.1] * scale
    return trimesh.convex.convex_hull(points)


@pytest.mark.parametrize("link", ["stone.bin", "https://example.org/stone.bin"])
def test_a_glb_whose_numbers_are_elsewhere_is_named(tmp_path: Path, link: str) -> None:
    path = tmp_path / "stone.glb"
    data = stone().export(file_type="glb")
    assert isinstance(data, bytes)
    size = int.from_bytes(data[12:16], "little")
    scene = json.loads(data[20 : 20 + size])
    scene["buffers"][0]["uri"] = link
    head = json.dumps(scene).encode()
    path.write_bytes(data[:12] + len(head).to_bytes(4, "little") + data[16:20] + head)
    with pytest.raises(InputError, match=rf"numbers are in another file, {link!r}, .* buffers in"):
        read_model(path, "m")


@pytest.mark.parametrize("suffix", ["ply", "stl", "obj", "glb"])
def test_every_format_gives_the_same_object(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"stone.{suffix}"
    stone(1000).export(path)
    model, expected = read_model(path, "mm"), model_of(stone())
    assert model.name == "stone"
    assert model.diameter_m == pytest.approx(expected.diameter_m)
    assert len(model.faces) == len(expected.faces)
    # Formats keep the faces in order, but not the points, and STL repeats them.
    assert torch.allclose(model.keypoints_m, expected.keypoints_m, atol=1e-6)


@pytest.mark.parametrize("suffix", ["ply", "xyz", "npy"])
def test_points_alone_are_a_model(tmp_path: Path, suffix: str) -> None:
    points = trimesh.creation.icosphere(3, 0.1).vertices
    path = tmp_path / f"ball.{suffix}"
    match suffix:
        case "npy":
            np.save(path, points)
        case "xyz":
            np.savetxt(path, points)
        case _:
            trimesh.PointCloud(points).export(path)
    model = read_model(path, "m")
    assert len(model.faces) == 0
    assert model.diameter_m == pytest.approx(0.2)
    # Of a ball, the normal is the radius.
    assert float((model.normals * model.vertices_m).sum(-1).min()) > 0.099
    cloud, normals = sample_surface(model, 100)
    assert cloud.shape == normals.shape == (100, 3)


def test_a_damaged_file_is_refused_with_a_remedy(tmp_path: Path) -> None:
    for name, data in (("a.stl", b"garbage"), ("a.glb", b"glTF"), ("a.ply", b"ply\nwhat"),
                       ("a.obj", b"v 1 2"), ("a.ply", b"")):  # fmt: skip
        (tmp_path / name).write_bytes(data)
        with pytest.raises(InputError, match=r"[Ee]xport it again|no PLY header .* a PLY file\?"):
            read_model(tmp_path / name, "mm")
    with pytest.raises(InputError, match=r"no model format; use .ply"):
        read_model(tmp_path / "a.step", "mm")
    with pytest.raises(InputError, match="no such file"):
        read_model(tmp_path / "none.ply", "mm")


def _saved(path: Path, vertices: np.ndarray, faces: np.ndarray) -> Path:
    trimesh.Trimesh(vertices, faces, process=False).export(path)
    return path


@pytest.mark.parametrize("suffix", ["ply", "stl"])
def test_a_mesh_with_holes_is_a_model(tmp_path: Path, suffix: str) -> None:
    whole = stone(1000)
    faces = np.array(whole.faces)[2:]
    model = read_model(_saved(tmp_path / f"open.{suffix}", whole.vertices, faces), "mm")
    assert len(model.faces) == len(whole.faces) - 2
    points, normals = sample_surface(model, 500)
    assert torch.allclose(normals.norm(dim=-1), torch.ones(500))
    assert len(torch.unique(points, dim=0)) == 500


@pytest.mark.parametrize("suffix", ["ply", "stl"])
def test_faces_twice_and_faces_without_area_are_dropped(tmp_path: Path, suffix: str) -> None:
    whole = stone(1000)
    faces = np.array(whole.faces)
    # Again, from another corner; from behind; three points of which two are one, or on one line.
    middle = whole.vertices[faces[0, :2]].mean(0)
    vertices = np.concatenate([whole.vertices, middle[None]])
    extra = [np.roll(faces[3], 1), faces[4][::-1], [*faces[5, :2], faces[5, 0]],
             [*faces[0, :2], len(whole.vertices)]]  # fmt: skip
    damaged = np.concatenate([faces, np.array(extra)])
    path = _saved(tmp_path / f"twice.{suffix}", vertices, damaged)
    model, expected = read_model(path, "mm"), model_of(stone())
    # In 32 bits a point on a line is off by a little: that face may stay, of no weight.
    assert len(faces) <= len(model.faces) <= len(faces) + 1
    for mine, theirs in zip(sample_surface(model, 300), sample_surface(expected, 300), strict=True):
        assert torch.allclose(mine, theirs, atol=1e-5)


def test_faces_that_are_no_surface_are_refused(tmp_path: Path) -> None:
    whole = stone(1000)
    beyond = tmp_path / "beyond.ply"
    faces = np.array(whole.faces)
    faces[7, 2] = len(whole.vertices)
    last = len(whole.vertices) - 1
    beyond.write_text(
        f"ply\nformat ascii 1.0\nelement vertex {last + 1}\n"
        + "".join(f"property float {axis}\n" for axis in "xyz")
        + f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
        + "".join(f"{x} {y} {z}\n" for x, y, z in whole.vertices)
        + "".join(f"3 {a} {b} {c}\n" for a, b, c in faces)
    )
    with pytest.raises(InputError) as error:
        read_model(beyond, "mm")
    assert str(error.value) == (
        f"{beyond}: face 7 names point {last + 1}, but the {last + 1} points are numbered 0 .. "
        f"{last}; the file is damaged. Export it again."
    )
    lines = faces[:, [0, 1, 0]]
    path = _saved(tmp_path / "lines.ply", whole.vertices, lines)
    with pytest.raises(InputError) as error:
        read_model(path, "mm")
    assert str(error.value) == (
        f"{path}: its {len(faces)} faces have no area, so there is no surface to see; all are "
        "lines or points. Export it again as triangles, or as points without faces."
    )


def test_the_wrong_unit_is_reported(tmp_path: Path) -> None:
    trimesh.creation.box((100, 200, 300)).export(tmp_path / "mm.ply")
    trimesh.creation.box((0.1, 0.2, 0.3)).export(tmp_path / "m.ply")
    with pytest.raises(InputError, match=r"is 300 m long.*is it in mm"):
        read_model(tmp_path / "mm.ply", "m")
    with pytest.raises(InputError, match=r"is 0.3 mm long.*is it in metres"):
        read_model(tmp_path / "m.ply", "mm")


def test_the_unit_doctor(box: ObjectModel) -> None:
    def message(diameter_m: float, points_m: torch.Tensor) -> str:
        advice = advise_unit(diameter_m, points_m)
        assert advice is not None
        assert advice.is_cloud_larger == (float(points_m.abs().max()) > diameter_m)
        return advice.message

    cloud, _ = sample_surface(box, 500)
    assert advise_unit(box.diameter_m, cloud[:250]) is None
    assert message(1000 * box.diameter_m, cloud) == (
        f"your model is {1000 / size_share(box, cloud):.0f} times larger than the cloud: "
        "is it in mm?"
    )
    assert "is it in inches?" in message(39.37 * box.diameter_m, cloud)
    assert "your cloud is" in message(box.diameter_m, 1000 * cloud)
    assert "is this the right object" in message(4 * box.diameter_m / 0.3, cloud)
    assert advise_unit(box.diameter_m, cloud[:1]) is None


def size_share(model: ObjectModel, cloud: torch.Tensor) -> float:
    distance = (cloud - cloud.median(0).values).norm(dim=-1)
    return 2 * float(distance.quantile(0.95)) / model.diameter_m


def test_diameters_are_those_of_bop(real: Path) -> None:
    folder = real / "pose/lm/models"
    info = read_json(folder / "models_info.json")
    assert isinstance(info, dict)
    for number in (1, 5, 6, 10):
        model = read_model(folder / f"obj_{number:06d}.ply", "mm")
        assert 1000 * model.diameter_m == pytest.approx(info[str(number)]["diameter"], abs=2e-4)


def test_a_diameter_is_the_largest_distance() -> None:
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(300, 3, generator=generator)
    assert measure_diameter(points) == pytest.approx(float(torch.cdist(points, points).max()))
    flat = points * torch.tensor([1, 1, 0])
    assert measure_diameter(flat) == pytest.approx(float(torch.cdist(flat, flat).max()))
    assert measure_diameter(torch.cat([points, points])) == measure_diameter(points)
    assert measure_diameter(points[:2]) == pytest.approx(float((points[0] - points[1]).norm()))


def test_the_diameter_of_a_large_smooth_hull_is_found_in_directions(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """900 corners, all on the hull: more than are compared each with each."""
    monkeypatch.setattr("depthpose.pose.mesh.models._MOST_HULL_CORNERS", 800)
    monkeypatch.setattr("depthpose.pose.mesh.models._HULL_DIRECTIONS", 1024)
    turns = torch.linspace(0, 2 * math.pi, 31)[:-1]
    rings = torch.linspace(0.01, math.pi - 0.01, 30)
    up, around = torch.meshgrid(rings, turns, indexing="ij")
    ball = torch.stack([up.sin() * around.cos(), up.sin() * around.sin(), up.cos()], -1)
    points = ball.reshape(-1, 3) * torch.tensor([0.1, 0.2, 0.25])
    points = points @ rotation_by(torch.tensor([0.3, 1.0, 0.2])).mT
    # A ball is alike on both sides; where it is cut it has no corner opposite to another.
    cut = points[points @ torch.tensor([0.6, 0.0, 0.8]) > -0.08]
    assert len(cut) > 500
    monkeypatch.setattr("depthpose.pose.mesh.models._MOST_HULL_CORNERS", 400)
    assert measure_diameter(cut) == pytest.approx(float(torch.cdist(cut, cut).max()), rel=1e-3)
    monkeypatch.setattr("depthpose.pose.mesh.models._MOST_HULL_CORNERS", 800)
    with patch.object(torch, "cdist", wraps=torch.cdist) as compared:
        assert measure_diameter(points) == pytest.approx(0.5 * math.cos(0.01), rel=2e-3)
    assert sum(len(call.args[0]) for call in compared.call_args_list) < 900


def test_a_stray_vertex_is_no_surface() -> None:
    mesh = trimesh.creation.box((0.1, 0.2, 0.3))
    vertices = torch.cat(
        [torch.full((1, 3), 9.0).double(), torch.from_numpy(np.array(mesh.vertices))]
    )
    model = make_model(vertices, torch.from_numpy(np.array(mesh.faces)) + 1, name="it")
    assert model.diameter_m == pytest.approx(math.sqrt(0.14))
    assert len(model.vertices_m) == 8


def test_farthest_points_are_farthest() -> None:
    points = torch.rand(200, 3, generator=torch.Generator().manual_seed(1))
    chosen = farthest_points(points, 20).tolist()
    centre = (points.amin(0) + points.amax(0)) / 2
    assert chosen[0] == int((points - centre).norm(dim=-1).argmax())
    for i in range(1, 20):
        nearest = torch.cdist(points, points[chosen[:i]]).amin(-1)
        assert float(nearest[chosen[i]]) == pytest.approx(float(nearest.max()))
    assert farthest_points(points, 8).tolist() == chosen[:8]
    with pytest.raises(InputError, match="only 1 different points"):
        farthest_points(torch.ones(5, 3), 4)


def test_keypoints_move_with_the_model_and_are_always_the_same() -> None:
    mesh = stone()
    first = model_of(mesh)
    assert torch.equal(first.keypoints_m, model_of(mesh).keypoints_m)
    vertices = first.vertices_m.double() + torch.tensor([0.5, -0.25, 1.0])
    moved = make_model(vertices, first.faces, name="it")
    shift = moved.keypoints_m - first.keypoints_m
    assert torch.allclose(shift, torch.tensor([0.5, -0.25, 1.0]).expand_as(shift), atol=1e-6)
    for count in (4, 12, 16, 20):
        assert len(model_of(mesh, MeshConfig(keypoints=count)).keypoints_m) == count


def test_a_surface_is_sampled_evenly(box: ObjectModel) -> None:
    points, normals = sample_surface(box, 2200)
    assert torch.equal(points, sample_surface(box, 2200)[0])
    # Each lies on the face that its normal names, and faces have their share of the area.
    half = torch.tensor([0.05, 0.1, 0.15])
    assert torch.allclose((points * normals).sum(-1), normals.abs() @ half, atol=1e-6)
    assert (normals.abs() @ torch.tensor([1.0, 0, 0])).sum() == pytest.approx(1200, abs=3)
    # Evener than chance: no wide gap.
    assert float(torch.cdist(points, points).fill_diagonal_(9).amin(-1).max()) < 0.012


def test_normals_of_bare_points_are_those_of_the_surface(box: ObjectModel) -> None:
    points, normals = sample_surface(box, 4000)
    bare = make_model(points, torch.zeros(0, 3, dtype=torch.int64), name="bare")
    cosine = (bare.normals * normals).sum(-1)
    assert float((cosine > 0.99).float().mean()) > 0.7


def test_symmetries_go_to_bop_and_back() -> None:
    half = turn_about(torch.tensor([0, 0, 1.0]).double(), torch.tensor([0.01, 0, 0]).double(),
                      torch.tensor([math.pi]))  # fmt: skip
    axis = Axis(direction=torch.tensor([0, 1.0, 0]).double(), point_m=torch.ones(3).double() * 0.02)
    info = symmetries_to_bop(Symmetries(discrete=half, continuous=(axis,)))
    assert info["symmetries_discrete"][0][3] == pytest.approx(20)
    assert info["symmetries_continuous"][0]["offset"] == pytest.approx([20] * 3)
    again = symmetries_from_bop(info, source="here")
    assert again.discrete is not None
    assert torch.allclose(again.discrete.t_m, half.t_m)
    assert torch.allclose(again.discrete.R, half.R)
    assert symmetries_to_bop(Symmetries()) == {}
    assert symmetries_from_bop({}, source="here").is_none


def test_symmetries_that_are_none_are_refused() -> None:
    for row in ([1, 2, 3], "x", [-1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1], [1.0] * 16):
        with pytest.raises(InputError, match=r"info.json: the symmetry"):
            symmetries_from_bop({"symmetries_discrete": [row]}, source="info.json")
    for entry in ({}, {"axis": [0, 0, 0]}, {"axis": [1, 2]}, 3):
        with pytest.raises(InputError, match=r"info.json: the continuous symmetry"):
            symmetries_from_bop({"symmetries_continuous": [entry]}, source="info.json")


def test_symmetry_transforms_leave_the_object_as_it_is() -> None:
    axis = Axis(direction=torch.tensor([0, 0, 1.0]), point_m=torch.tensor([0.1, 0, 0]))
    flip = turn_about(torch.tensor([1.0, 0, 0]), torch.zeros(3), torch.tensor([math.pi]))
    turns = symmetry_transforms(Symmetries(discrete=flip, continuous=(axis,)))
    assert len(turns.R) == 2 * 315
    assert torch.equal(turns.R[0], torch.eye(3))
    ends = turns.apply(torch.tensor([[0.1, 0, 0.2]]).expand(630, 1, 3))[:, 0]
    assert torch.allclose(ends.abs(), torch.tensor([0.1, 0, 0.2]).expand(630, 3), atol=1e-6)


@pytest.mark.parametrize(
    ("mesh", "turns", "axes"),
    [
        (trimesh.creation.box((0.1, 0.2, 0.3)), 3, 0),
        (trimesh.creation.cylinder(0.05, 0.2), 1, 1),
        (trimesh.creation.box((0.1, 0.1, 0.3)), 7, 0),
    ],
    ids=["box", "cylinder", "square rod"],
)
def test_symmetries_of_plain_bodies_are_found(mesh: trimesh.Trimesh, turns: int, axes: int) -> None:
    mesh = mesh.copy()
    mesh.apply_transform(trimesh.transformations.random_rotation_matrix(np.array([0.2, 0.7, 0.4])))
    mesh.apply_translation((0.01, -0.02, 0.03))
    model = model_of(mesh)
    proposals = propose_symmetries(model)
    found = symmetries_from_proposals(proposals)
    assert len(found.continuous) == axes
    assert (0 if found.discrete is None else len(found.discrete.R)) == turns
    assert all(p.certainty > 0.9 for p in proposals if p.certainty > 0.5)
    cloud, _ = sample_surface(model, 300)
    for turn in symmetry_transforms(found, max_step=0.5).R:
        assert float(geodesic_rad(turn.mT @ turn, torch.eye(3, dtype=turn.dtype))) < 1e-3
    assert cloud.shape == (300, 3)


def test_a_nearly_round_block_of_points_is_square() -> None:
    block = trimesh.creation.box((0.1, 0.1, 0.2))
    points, faces = trimesh.sample.sample_surface_even(block, 2600, seed=0)
    noise = np.random.default_rng(0).normal(0.0, 0.001, (len(points), 1))
    points = torch.from_numpy(np.asarray(points + noise * block.face_normals[faces]))
    model = make_model(points, torch.zeros(0, 3).long(), name="block")
    proposals = propose_symmetries(model, 0.045)
    # 45 degrees about the long axis move an edge by 20 mm, 0.085 diameters.
    (nearly,) = (p for p in proposals if p.kind == "continuous")
    assert 0.2 < nearly.certainty < 0.5
    found = symmetries_from_proposals(proposals)
    assert found.continuous == ()
    assert found.discrete is not None
    assert len(found.discrete.R) == 7


def test_two_knobs_of_four_are_no_quarter_turn_either_way_however_dense_they_are() -> None:
    """A scan has many points of one knob and few of the next, which a share of points overlooks."""
    generator = np.random.default_rng(0)
    plate = trimesh.creation.box((0.2, 0.2, 0.01))
    knobs = [trimesh.creation.box((0.02, 0.02, 0.08)) for _ in range(2)]
    knobs[0].apply_translation([0.08, 0, 0.045])
    knobs[1].apply_translation([0, 0.08, 0.045])
    parts = []
    for mesh, count in ((plate, 4400), (knobs[0], 550), (knobs[1], 50)):
        points, faces = trimesh.sample.sample_surface(mesh, count, seed=0)[:2]
        parts.append(np.hstack([points, mesh.face_normals[faces]]))
    rows = torch.from_numpy(generator.permutation(np.concatenate(parts)))
    model = make_model(rows[:, :3], torch.zeros(0, 3).long(), name="knobs")
    surface = SurfaceDeviation(model)
    quarter = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)
    off = surface.deviation(torch.stack([quarter, quarter.mT]))
    assert bool((off > 0.1).all()), off


def test_real_symmetries(real: Path) -> None:
    cat = read_model(real / "pose/lm/models/obj_000006.ply", "mm")
    assert propose_symmetries(cat) == []
    eggbox = read_model(real / "pose/lm/models/obj_000010.ply", "mm")
    (half_turn,) = propose_symmetries(eggbox)
    assert half_turn.angle_rad == pytest.approx(math.pi)
    assert abs(float(half_turn.direction[2])) > 0.99
    # Half as sure as a perfect copy would be: the scan is of a real, slightly bent box.
    assert 0.4 < half_turn.certainty < 0.6


def test_turns_are_completed_to_a_group() -> None:
    proposals = [
        SymmetryProposal("discrete", direction, (0.0, 0.0, 0.0), angle, 0.0, 1.0)
        for direction, angle in (((0.0, 0.0, 1.0), math.pi / 3), ((1.0, 0.0, 0.0), math.pi))
    ]
    found = symmetries_from_proposals(proposals)
    assert found.discrete is not None
    assert len(found.discrete.R) == 11


@pytest.mark.parametrize("teeth", [18, 32, 60])
def test_a_wheel_that_looks_alike_from_both_sides_has_twice_as_many_as_teeth(teeth: int) -> None:
    proposals = [
        SymmetryProposal("discrete", direction, (0.0, 0.0, 0.0), angle, 0.0, 1.0)
        for direction, angle in (((0.0, 0.0, 1.0), 2 * math.pi / teeth), ((1.0, 0.0, 0.0), math.pi))
    ]
    found = symmetries_from_proposals(proposals)
    assert found.discrete is not None
    assert len(found.discrete.R) == 2 * teeth - 1


def test_an_object_of_one_point_is_refused() -> None:
    with pytest.raises(InputError, match=r"diameter of 0.0 m; it is a single point"):
        make_model(torch.ones(9, 3), torch.empty(0, 3).long(), name="it")


def test_too_few_keypoints_are_refused() -> None:
    with pytest.raises(InputError, match=r"keypoints must be in .* default is 8"):
        MeshConfig(keypoints=3)


def test_turning_about_a_line_leaves_the_line() -> None:
    point = torch.tensor([0.1, 0.2, 0.3]).double()
    direction = torch.tensor([1.0, -1, 2]).double()
    turn = turn_about(direction, point, torch.tensor(0.7))
    line = point + direction * torch.linspace(-1, 1, 5).double()[:, None]
    assert isinstance(turn, Rigid)
    assert torch.allclose(turn.apply(line), line)
