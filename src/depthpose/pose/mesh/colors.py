"""Colours of a model file, of its vertices, faces, materials or texture, over its surface."""

import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from scipy.spatial import KDTree
from torch import Tensor

from depthpose.core.errors import InputError, Notice
from depthpose.core.files import CLOUD_READERS, AnyPath, read_bytes, read_cloud
from depthpose.core.files.disk import refused_as
from depthpose.pose.mesh.sampling import spread_over_triangles
from depthpose.pose.types import ObjectModel, SurfaceColors

_SAMPLES = 10_000  # about 1 % of the diameter apart, as far as a pose is usually off
_AVERAGED = 4  # colours that are averaged in each sample
_PROBED_EVERY = 10  # one in this many points of a cloud is used to measure their spacing
_LEAST_CONTRAST = 0.01  # standard deviation of colours below which a model is of one colour
_SAME_BOX = 1e-3  # of the extent: two readers of one file may differ by less
_LEAST_INSIDE = 0.5  # share of the coloured surface that must lie in the shape's box
_MOST_TEXELS = 2**26  # 8192 x 8192
_SRGB_GAMMA = 2.2
_WITH_COLORS = (".ply", ".obj", ".glb")


def read_colors(path: AnyPath, unit_m: float, model: ObjectModel) -> SurfaceColors | None:
    """Read the colours of a model file at points spread evenly over its surface.

    They are those of vertices or faces, of materials, or of textures (of PLY by ``TextureFile``, of
    OBJ by its MTL file, of GLB inside). Each sample has the mean colour about it, so that print
    finer than the samples is no noise.

    Args:
        path: PLY, OBJ, GLB, or points with colours.
        unit_m: metres in a unit of its numbers.
        model: the same file's geometry, in metres.

    Returns:
        The colours; None where the file has none, or a single one, which tells no side from
        another. Where a texture or material file is missing a notice names it.
    """
    suffix = Path(path).suffix.lower()
    if len(model.faces) == 0:
        return _read_point_colors(path, model) if suffix in CLOUD_READERS else None
    if suffix not in _WITH_COLORS or not _may_have_colors(path, suffix):
        return None
    try:
        with refused_as(path, "model with colours", "export it again"):
            scene, missing_files = _load_scene(path, suffix)
            samples = _sample_colors(scene, is_file_missing=bool(missing_files))
    except InputError as error:
        message = f"{path}: {str(error).removeprefix(f'{path}: ')}"
        warnings.warn(f"{message} (its shape is read, its colours are not)", Notice, stacklevel=3)
        return None
    if missing_files:
        warnings.warn(
            f"{path}: its file {missing_files[0]!r} is not beside it, so what is coloured by it "
            "has no colours; put it there, or export the model as GLB with its textures inside",
            Notice,
            stacklevel=3,
        )
    if samples is None:
        return None

    # Those of the shape alone. The shape is read by another reader, which leaves stray bodies out.
    points_m = unit_m * samples.points
    is_inside = _mark_inside_box(points_m, model)
    if float(is_inside.double().mean()) < _LEAST_INSIDE:
        warnings.warn(
            f"{path}: its colours lie beside its shape, so they are left out; export it as GLB",
            Notice,
            stacklevel=3,
        )
        return None
    return average_colors(points_m[is_inside], samples.normals[is_inside], samples.rgb[is_inside])


def _mark_inside_box(points_m: Float64[Tensor, "n 3"], model: ObjectModel) -> Bool[Tensor, " n"]:
    """Mark the points that lie in the box about a model."""
    low_m = model.vertices_m.amin(0).double()
    high_m = model.vertices_m.amax(0).double()
    slack_m = _SAME_BOX * float((high_m - low_m).max())
    return ((points_m > low_m - slack_m) & (points_m < high_m + slack_m)).all(-1)


def average_colors(
    points_m: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"], rgb: Float[Tensor, "n 3"]
) -> SurfaceColors | None:
    """Keep every fourth of the samples of a surface, each with the mean colour about it.

    Args:
        points_m: samples, evenly spread.
        normals: outward.
        rgb: colour of each, 0..1.

    Returns:
        The points that are kept, with their colours; None where all samples have one colour.
    """
    if float(rgb.double().std(0).max()) < _LEAST_CONTRAST:
        return None

    # The fourth part of the samples, and how far they lie apart, by about a thousand of them.
    kept_m = points_m[::_AVERAGED].double()
    kept_normals = normals[::_AVERAGED].double()
    tree = KDTree(kept_m.numpy())
    few_m = kept_m.numpy()[:: max(1, len(kept_m) // 1000)]
    distance_m, _ = tree.query(few_m, k=2)  # the nearest is the point itself
    spacing_m = float(np.median(distance_m[:, 1]))

    # The kept point nearest to each sample. On a thin sheet a sample of the other side, which may
    # have another colour, is left out.
    _, index = tree.query(points_m.double().numpy())
    nearest = torch.from_numpy(np.asarray(index))
    is_same_side = (normals.double() * kept_normals[nearest]).sum(-1) > 0
    nearest = nearest[is_same_side]
    colors = rgb.double()[is_same_side]

    # The mean colour of the samples about each kept point.
    count = torch.zeros(len(kept_m), dtype=torch.float64)
    count.index_add_(0, nearest, torch.ones_like(nearest, dtype=torch.float64))
    total = torch.zeros_like(kept_m).index_add_(0, nearest, colors)
    mean = torch.where(count[:, None] > 0, total / count[:, None], rgb[::_AVERAGED].double())
    return SurfaceColors(
        points_m=kept_m.float(),
        normals=kept_normals.float(),
        rgb=mean.float(),
        spacing_m=spacing_m,
    )


def _may_have_colors(path: AnyPath, suffix: str) -> bool:
    """Whether a PLY, OBJ or GLB may hold colours; most do not, and need no second reading."""
    data = read_bytes(path)
    if suffix == ".ply":
        header = data[: data.find(b"end_header")].lower()
        return b" red" in header or b"texturefile" in header
    if suffix == ".obj":
        vertex = data[: 2**16].partition(b"\nv ")[2].partition(b"\n")[0]
        return b"mtllib" in data or len(vertex.split()) > 4  # more than x, y, z and a weight
    return True


def _read_point_colors(path: AnyPath, model: ObjectModel) -> SurfaceColors | None:
    """Read the colours of a file of bare points; None where it has none, or a single one."""
    rgb = read_cloud(path).color
    if rgb is None or len(rgb) != len(model.vertices_m):
        return None
    if float(rgb.double().std(0).max()) < _LEAST_CONTRAST:
        return None
    points_m = model.vertices_m
    # Some of the points tell the spacing. The nearest to each is the point itself.
    few_m = points_m.numpy()[::_PROBED_EVERY]
    distance_m, _ = KDTree(points_m.numpy()).query(few_m, k=2)
    return SurfaceColors(
        points_m=points_m,
        normals=model.normals,
        rgb=rgb,
        spacing_m=float(np.median(distance_m[:, 1])),
    )


class _Samples(NamedTuple):
    """Coloured points of a surface."""

    points: Float[Tensor, "n 3"]  #: in the file's own unit
    normals: Float[Tensor, "n 3"]  #: outward
    rgb: Float[Tensor, "n 3"]  #: 0..1


def _load_scene(path: AnyPath, suffix: str) -> tuple[Any, list[str]]:
    """Load a file as a scene of trimesh; return it, and the names of files not beside it."""
    import trimesh

    files = _make_resolver(path)
    with _silence_trimesh():
        scene: Any = trimesh.load_scene(
            BytesIO(read_bytes(path)),
            file_type=suffix[1:],
            resolver=files,
            process=False,
            allow_remote=False,
        )
    return scene, files.missing


def _sample_colors(scene: Any, *, is_file_missing: bool) -> _Samples | None:  # noqa: ANN401
    """Sample the coloured surface of a scene of trimesh; None where no part of it has a colour.

    ``is_file_missing``: as of :func:`_color_points`.
    """
    # The meshes of the scene, and their vertices where the scene places them.
    meshes: list[Any] = []
    placed_vertices: list[np.ndarray] = []
    for node in scene.graph.nodes_geometry:
        transform, geometry = scene.graph[node]
        mesh = scene.geometry[geometry]
        if len(getattr(mesh, "faces", ())):
            vertices = np.asarray(mesh.vertices, np.float64)
            meshes.append(mesh)
            placed_vertices.append(vertices @ transform[:3, :3].T + transform[:3, 3])
    if not meshes:
        return None

    # Samples by area over all meshes at once.
    pairs = zip(meshes, placed_vertices, strict=True)
    corners = torch.from_numpy(np.concatenate([vertices[mesh.faces] for mesh, vertices in pairs]))
    face, barycentric = spread_over_triangles(corners, _AVERAGED * _SAMPLES)
    points = (corners[face] * barycentric[..., None]).sum(-2)
    normals = torch.nn.functional.normalize(_compute_outward_normals(corners)[face], dim=-1)

    # The colours of the samples of each mesh, whose faces follow those of the mesh before.
    rgb = torch.full((len(face), 3), torch.nan, dtype=torch.float64)
    first_face = 0
    for mesh in meshes:
        last_face = first_face + len(mesh.faces)
        is_of_mesh = (face >= first_face) & (face < last_face)
        colors = _color_points(
            mesh,
            (face[is_of_mesh] - first_face).numpy(),
            barycentric[is_of_mesh].numpy(),
            is_file_missing=is_file_missing,
        )
        if colors is not None:
            rgb[is_of_mesh] = torch.from_numpy(colors)
        first_face = last_face
    has_color = rgb.isfinite().all(-1)
    if not bool(has_color.any()):
        return None
    return _Samples(points[has_color], normals[has_color], rgb[has_color])


def _compute_outward_normals(corners: Float64[Tensor, "f 3 3"]) -> Float64[Tensor, "f 3"]:
    """Compute the normals of a surface's triangles, outward, each as long as its doubled area."""
    sides = corners[:, 1:] - corners[:, :1]
    normals = torch.linalg.cross(sides[:, 0], sides[:, 1])
    # Where faces look inward, the volume that they enclose is negative.
    middle = corners.flatten(0, 1).mean(0)
    volume = float(((corners.mean(1) - middle) * normals).sum())
    return normals if volume >= 0 else -normals


def _color_points(
    mesh: Any,  # noqa: ANN401  trimesh's classes carry no types
    face: np.ndarray,
    barycentric: np.ndarray,
    *,
    is_file_missing: bool,
) -> np.ndarray | None:
    """Compute the colours of points of a mesh, by whatever colours the mesh has.

    Args:
        mesh: of trimesh.
        face: of each point (n,).
        barycentric: coordinates of each point in it (n, 3).
        is_file_missing: whether a file with colours was missing; then the material that trimesh
            puts in its place does not count.

    Returns:
        RGB of each point (n, 3), 0..1; None where the mesh has no colours.
    """
    visual = mesh.visual
    corners = np.asarray(mesh.faces)[face]
    if visual.kind == "face":
        return np.asarray(visual.face_colors)[face, :3] / 255
    if visual.kind == "vertex":
        return _interpolate_corners(visual.vertex_colors, corners, barycentric) / 255
    if visual.kind != "texture":
        return None
    return _color_by_material(visual, corners, barycentric, is_file_missing=is_file_missing)


def _color_by_material(
    visual: Any,  # noqa: ANN401  trimesh's classes carry no types
    corners: np.ndarray,
    barycentric: np.ndarray,
    *,
    is_file_missing: bool,
) -> np.ndarray | None:
    """Compute colours of points by a texture, else by vertices, else by the material's colour.

    Args:
        visual: of trimesh.
        corners: indices of the three corners of each point's face (n, 3).
        barycentric: coordinates of each point in its face (n, 3).
        is_file_missing: as of :func:`_color_points`.

    Returns:
        RGB of each point (n, 3), 0..1; None where there is no colour.

    Raises:
        InputError: the texture is too large.
    """
    from trimesh.visual.color import uv_to_interpolated_color

    material = visual.material
    vertex_colors = visual.vertex_attributes.get("color")
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    # A factor of glTF is linear, and multiplies here values of sRGB: it is encoded as these are.
    factor = getattr(material, "baseColorFactor", None)
    tint = np.ones(3)
    if factor is not None:
        tint = (np.asarray(factor)[:3] / 255) ** (1 / _SRGB_GAMMA)
    if image is not None and image.width * image.height > _MOST_TEXELS:
        raise InputError(
            f"its texture is {image.width}x{image.height}, more than {_MOST_TEXELS} pixels; save "
            "it smaller"
        )

    # The first of the three that there is.
    if image is not None and visual.uv is not None:
        uv = _interpolate_corners(visual.uv, corners, barycentric)
        return uv_to_interpolated_color(uv, image)[:, :3] / 255 * tint
    if vertex_colors is not None:
        return _interpolate_corners(vertex_colors, corners, barycentric)[:, :3] / 255 * tint
    if is_file_missing:
        return None
    plain = tint if factor is not None else np.asarray(material.main_color)[:3] / 255
    return np.broadcast_to(plain, (len(corners), 3))


def _interpolate_corners(values: Any, corners: np.ndarray, barycentric: np.ndarray) -> np.ndarray:  # noqa: ANN401
    """Interpolate values of vertices (uv or RGB, without alpha) at points of faces (n, 2 or 3)."""
    at_corners = np.asarray(values, np.float64)[corners][..., :3]
    return (at_corners * barycentric[..., None]).sum(1)


def _make_resolver(path: AnyPath) -> Any:  # noqa: ANN401  trimesh's classes carry no types
    """Make the resolver by which trimesh reads files beside a model; it notes missing ones."""
    from trimesh.resolvers import FilePathResolver

    class FilesBeside(FilePathResolver):
        """Reads files in the model's folder alone, by their own name where the path is another."""

        def __init__(self) -> None:
            super().__init__(str(path))
            self.missing: list[str] = []

        def get(self, name: str) -> bytes:
            """Read a file beside the model; note the name of one that is missing."""
            try:
                return super().get(name.replace("\\", "/"))
            except (OSError, ValueError):
                self.missing.append(name.strip())
                raise

    return FilesBeside()


@contextmanager
def _silence_trimesh() -> Iterator[None]:
    """Keep trimesh from logging the traceback of a missing texture, which a notice names."""
    log = logging.getLogger("trimesh")
    level = log.level
    log.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        log.setLevel(level)
