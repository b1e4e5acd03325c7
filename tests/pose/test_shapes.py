"""Meshes and clouds of other libraries, in memory, in place of files."""

from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from tests.pose.synthetic_objects import bracket, cloud_of, pose_at

from depthpose import Registration
from depthpose.core.errors import InputError
from depthpose.pose.inputs import cloud_input
from depthpose.pose.mesh import read_model

TRUTH = pose_at(seed=1)


def mesh_mm() -> trimesh.Trimesh:
    model = bracket()
    return trimesh.Trimesh(1000 * model.vertices_m.numpy(), model.faces.numpy(), process=False)


def test_a_mesh_of_trimesh_is_a_model() -> None:
    shape = mesh_mm()
    with pytest.raises(InputError, match="no unit is given"):
        read_model(shape)
    model = read_model(shape, "mm", number=3)
    assert model.name == "object_3"
    assert model.diameter_m == pytest.approx(bracket().diameter_m)
    assert len(model.faces) == len(bracket().faces)
    shape.metadata["name"] = "corner"
    shape.units = "mm"
    assert read_model(shape).name == "corner"
    assert read_model(shape).diameter_m == pytest.approx(bracket().diameter_m)
    assert read_model(shape, "mm", name="mine").name == "mine"


def test_a_file_that_trimesh_read_has_its_name(tmp_path: Path) -> None:
    mesh_mm().export(tmp_path / "corner.stl")
    model = read_model(trimesh.load_mesh(tmp_path / "corner.stl"), "mm")
    from_file = read_model(tmp_path / "corner.stl", "mm")
    assert model.name == from_file.name == "corner"
    assert model.diameter_m == pytest.approx(from_file.diameter_m)


def test_the_nodes_of_a_scene_are_in_their_places() -> None:
    scene = trimesh.Scene()
    for x in (0.0, 100.0):
        scene.add_geometry(
            trimesh.creation.box((100, 100, 100)),
            transform=trimesh.transformations.translation_matrix([x, 0, 0]),
        )
    model = read_model(scene, "mm")
    assert float(np.ptp(model.vertices_m.numpy(), axis=0)[0]) == pytest.approx(0.2)


def test_what_is_no_shape_is_refused() -> None:
    for value, reason in (
        ([mesh_mm()], "a list is no model: give files, or meshes"),
        (3.0, "a float is no model"),
        (trimesh.Trimesh(), "a Trimesh without points is no model"),
    ):
        with pytest.raises(InputError, match=reason):
            read_model(value, "mm")


def test_a_registration_takes_meshes_and_clouds_in_memory() -> None:
    shape = mesh_mm()
    shape.metadata["name"] = "corner"
    parts = Registration.load(shape, unit="mm")
    assert parts.objects == ("corner",)
    points_m = cloud_of(bracket(), TRUTH)
    cloud = trimesh.PointCloud(1000 * points_m.numpy())
    given = cloud_input(cloud, "mm", "corner", "a")
    torch.testing.assert_close(given.points_m, points_m.float(), rtol=1e-5, atol=1e-6)
    found = parts.estimate(cloud=cloud, unit="mm")
    assert found.camera_from_model is not None
    assert float((found.camera_from_model.t_m - TRUTH.t_m).norm()) < 0.002


class Legacy:
    """As an ``open3d.geometry`` class: its arrays are vectors of rows."""

    def __init__(self, **rows: Any) -> None:  # noqa: ANN401
        vars(self).update({name: [tuple(row) for row in values] for name, values in rows.items()})


class OfTensors:
    """As an ``open3d.t.geometry`` class."""

    def __init__(self, legacy: Legacy) -> None:
        self.to_legacy = lambda: legacy


@pytest.mark.parametrize("of_tensors", [False, True])
def test_meshes_and_clouds_of_open3d_are_taken(
    monkeypatch: pytest.MonkeyPatch, *, of_tensors: bool
) -> None:
    """By the names of its fields; Open3D itself is a gigabyte, and needs libGL."""
    for kind in (Legacy, OfTensors):
        monkeypatch.setattr(kind, "__module__", "open3d.cpu.pybind.geometry")
    model = bracket()
    mesh: Any = Legacy(vertices=model.vertices_m.numpy(), triangles=model.faces.numpy())
    cloud: Any = Legacy(points=cloud_of(model, TRUTH).numpy())
    if of_tensors:
        mesh, cloud = OfTensors(mesh), OfTensors(cloud)
    read = read_model(mesh, "m", name="corner")
    assert read.diameter_m == pytest.approx(model.diameter_m)
    assert len(read.faces) == len(model.faces)
    given = cloud_input(cloud, "m", "corner", "a")
    assert len(given.points_m) == len(cloud_of(model, TRUTH))


def test_open3d_itself_where_it_is_installed() -> None:
    open3d: ModuleType | Any = pytest.importorskip("open3d")
    model = bracket()
    mesh = open3d.geometry.TriangleMesh(
        open3d.utility.Vector3dVector(model.vertices_m.double().numpy()),
        open3d.utility.Vector3iVector(model.faces.int().numpy()),
    )
    tensors = open3d.t.geometry.TriangleMesh.from_legacy(mesh)
    for shape in (mesh, tensors):
        assert read_model(shape, "m").diameter_m == pytest.approx(model.diameter_m)
    cloud = open3d.geometry.PointCloud(
        open3d.utility.Vector3dVector(cloud_of(model, TRUTH).double().numpy())
    )
    for shape in (cloud, open3d.t.geometry.PointCloud.from_legacy(cloud)):
        assert len(cloud_input(shape, "m", "b", "a").points_m) == len(cloud.points)
