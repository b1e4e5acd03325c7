"""Colours of model files: those of vertices, faces, materials and textures, wherever they are."""

import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from tests.pose.textured_objects import BOX_M, Mesh, saved_glb, textured_box, trimesh

from depthpose.core.errors import Notice
from depthpose.core.files import PointCloud, write_cloud
from depthpose.pose.mesh import read_model
from depthpose.pose.types import SurfaceColors

SIDES = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [0, 1, 1], [1, 0, 1]], float)


def six_sided() -> Mesh:
    """A cube of 100 whose sides -x, x, -y, y, -z, z have a colour each."""
    mesh = textured_box()
    picture = Image.new("RGB", (6 * 8, 8))
    for k, color in enumerate(SIDES):
        red, green, blue = (int(255 * c) for c in color)
        picture.paste((red, green, blue), (8 * k, 0, 8 * k + 8, 8))
    mesh.visual.material.image = picture
    mesh.vertices = mesh.vertices / BOX_M * 100
    return mesh


def expected(colors: SurfaceColors) -> torch.Tensor:
    """The colour of the side that each sample lies on, by its place."""
    axis = colors.points_m.abs().argmax(-1)
    is_high = colors.points_m.gather(1, axis[:, None])[:, 0] > 0
    return torch.from_numpy(SIDES).float()[2 * axis + is_high]


def check_sides(colors: SurfaceColors | None, most: float = 0.02) -> None:
    assert colors is not None
    assert float((colors.rgb - expected(colors)).abs().mean()) < most
    # Evenly spread over the sides, and each normal is that of its side.
    axis = colors.points_m.abs().argmax(-1)
    along = colors.normals.gather(1, axis[:, None])[:, 0]
    assert torch.allclose(along, colors.points_m.gather(1, axis[:, None])[:, 0].sign(), atol=1e-3)
    assert torch.allclose(
        axis.bincount(minlength=3) / len(axis), torch.full((3,), 1 / 3), atol=0.01
    )
    assert float(colors.points_m.abs().max()) == pytest.approx(0.05, abs=1e-4)


def save_obj(folder: Path, mesh: Mesh) -> Path:
    text, files = trimesh.exchange.obj.export_obj(mesh, return_texture=True)
    for name, data in files.items():
        (folder / name).write_bytes(data)
    (folder / "cube.obj").write_text(text)
    return folder / "cube.obj"


def test_texture_of_glb(tmp_path: Path) -> None:
    check_sides(read_model(saved_glb(six_sided(), tmp_path / "c.glb"), "mm").colors)


def test_texture_of_obj(tmp_path: Path) -> None:
    check_sides(read_model(save_obj(tmp_path, six_sided()), "mm").colors)


def test_texture_of_ply(tmp_path: Path) -> None:
    mesh = six_sided()
    mesh.visual.material.image.save(tmp_path / "sides.png")
    vertices = "".join(
        f"{x} {y} {z} {u} {v}\n"
        for (x, y, z), (u, v) in zip(mesh.vertices, mesh.visual.uv, strict=True)
    )
    faces = "".join(f"3 {a} {b} {c}\n" for a, b, c in mesh.faces)
    names = "".join(f"property float {n}\n" for n in ("x", "y", "z", "texture_u", "texture_v"))
    (tmp_path / "c.ply").write_text(
        f"ply\nformat ascii 1.0\ncomment TextureFile sides.png\nelement vertex {len(mesh.vertices)}"
        f"\n{names}element face {len(mesh.faces)}\nproperty list uchar int vertex_indices\n"
        f"end_header\n{vertices}{faces}"
    )
    check_sides(read_model(tmp_path / "c.ply", "mm").colors)


@pytest.mark.parametrize("kind", ["vertex", "face"])
def test_colours_of_vertices_and_faces_of_ply(tmp_path: Path, kind: str) -> None:
    mesh = six_sided()
    sides = np.concatenate([SIDES, np.ones((6, 1))], 1)
    each = {"vertex": sides.repeat(4, 0), "face": sides.repeat(2, 0)}[kind]
    colors = {f"{kind}_colors": (255 * each).astype(np.uint8)}
    plain = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False, **colors)
    plain.export(tmp_path / "c.ply")
    check_sides(read_model(tmp_path / "c.ply", "mm").colors)


def test_colours_of_vertices_of_obj(tmp_path: Path) -> None:
    mesh = six_sided()
    each = SIDES.repeat(4, 0)
    vertices = "".join(
        f"v {' '.join(map(str, (*p, *c)))}\n" for p, c in zip(mesh.vertices, each, strict=True)
    )
    faces = "".join(f"f {a + 1} {b + 1} {c + 1}\n" for a, b, c in mesh.faces)
    (tmp_path / "c.obj").write_text(vertices + faces)
    check_sides(read_model(tmp_path / "c.obj", "mm").colors)


def test_materials_of_parts_that_are_placed(tmp_path: Path) -> None:
    # One side each, a part of a scene that is moved into place: as CAD exports coloured parts.
    mesh, scene = six_sided(), trimesh.Scene()
    for k, color in enumerate(SIDES):
        faces = mesh.faces[2 * k : 2 * k + 2]
        shift = np.array([7.0 * k, 0, 3])
        part = trimesh.Trimesh(mesh.vertices - shift, faces, process=False)
        material = trimesh.visual.material.PBRMaterial(baseColorFactor=[*color, 1.0])
        part.visual = trimesh.visual.TextureVisuals(material=material)
        placed = np.eye(4)
        placed[:3, 3] = shift
        scene.add_geometry(part, transform=placed)
    (tmp_path / "c.glb").write_bytes(scene.export(file_type="glb"))
    check_sides(read_model(tmp_path / "c.glb", "mm").colors)


def test_print_finer_than_the_samples_is_averaged(tmp_path: Path) -> None:
    # Black and white texels, 0.1 mm each, where samples are 1.2 mm apart: averaged to greys.
    mesh = six_sided()
    fine = np.random.default_rng(0).integers(0, 2, (1000, 6000)).astype(np.uint8) * 255
    half = np.indices(fine.shape).sum(0) % 2 * 255
    fine[:, 3000:] = half[:, 3000:] // 8  # darker on the sides y, -z, z
    mesh.visual.material.image = Image.fromarray(fine).convert("RGB")
    colors = read_model(saved_glb(mesh, tmp_path / "c.glb"), "mm").colors
    assert colors is not None
    bright = colors.rgb.mean(-1)
    assert float(bright.std()) < 0.27  # of random black and white it would be 0.45
    assert float(colors.spacing_m) < 0.003


def test_points_with_colours(tmp_path: Path) -> None:
    mesh = six_sided()
    points, face = trimesh.sample.sample_surface(mesh, 4000, seed=1)
    cloud = PointCloud(
        points=torch.from_numpy(points).float(), color=torch.from_numpy(SIDES[face // 2]).float()
    )
    write_cloud(tmp_path / "c.ply", cloud)
    colors = read_model(tmp_path / "c.ply", "mm").colors
    assert colors is not None
    assert torch.equal(colors.rgb, expected(colors))


def test_a_file_turned_inside_out_has_its_colours_outside(tmp_path: Path) -> None:
    mesh = six_sided()
    mesh.faces = mesh.faces[:, ::-1]
    check_sides(read_model(saved_glb(mesh, tmp_path / "c.glb"), "mm").colors)


@pytest.mark.parametrize("name", ["material.mtl", "material_0.png"])
def test_a_missing_file_is_named_and_the_shape_stays(tmp_path: Path, name: str) -> None:
    path = save_obj(tmp_path, six_sided())
    (tmp_path / name).unlink()
    with pytest.warns(Notice, match=rf"cube.obj: its file '{name}' is not beside it"):
        model = read_model(path, "mm")
    assert model.colors is None
    assert model.diameter_m == pytest.approx(0.1 * 3**0.5)


def test_a_damaged_texture_leaves_the_shape(tmp_path: Path) -> None:
    path = save_obj(tmp_path, six_sided())
    (tmp_path / "material_0.png").write_bytes(b"no picture")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", Notice)
        assert read_model(path, "mm").colors is None


def test_a_texture_too_large_to_read_leaves_the_shape(tmp_path: Path) -> None:
    path = save_obj(tmp_path, six_sided())
    Image.new("1", (8200, 8200)).save(tmp_path / "material_0.png")
    with pytest.warns(Notice, match=r"cube.obj: its texture is 8200x8200, more than 67108864"):
        model = read_model(path, "mm")
    assert model.colors is None


def test_an_absolute_path_of_another_machine_is_found_beside_the_model(tmp_path: Path) -> None:
    path = save_obj(tmp_path, six_sided())
    mtl = (tmp_path / "material.mtl").read_text()
    (tmp_path / "material.mtl").write_text(
        mtl.replace("material_0.png", "C:\\work\\textures\\material_0.png")
    )
    check_sides(read_model(path, "mm").colors)


def test_one_colour_or_none_is_none(tmp_path: Path) -> None:
    mesh = six_sided()
    mesh.visual.material.image = Image.new("RGB", (8, 8), (90, 120, 30))
    assert read_model(saved_glb(mesh, tmp_path / "c.glb"), "mm").colors is None
    trimesh.Trimesh(mesh.vertices, mesh.faces).export(tmp_path / "c.stl")
    assert read_model(tmp_path / "c.stl", "mm").colors is None
