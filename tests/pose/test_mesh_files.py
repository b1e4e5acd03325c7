"""Model files as others write them: the same solid from each, or an error that names the flaw."""

import json
import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.fuzz.damage import pack_glb

from depthpose.core.errors import InputError, Notice
from depthpose.core.rigid import rotation_by
from depthpose.pose.cloud import advise_unit
from depthpose.pose.mesh import read_geometry, read_model
from depthpose.pose.mesh.polygons import cut_polygons
from depthpose.pose.registration import Registration

# An L of 30 x 20 x 10 (mm), its caps concave: volume 4000, area 2 * 400 + 100 * 10.
OUTLINE = [(0, 0), (30, 0), (30, 10), (10, 10), (10, 20), (0, 20)]
POINTS = np.array([(x, y, z) for z in (0, 10) for x, y in OUTLINE], dtype=float)
FACES = [
    [5, 4, 3, 2, 1, 0],
    [6, 7, 8, 9, 10, 11],
    *([k, (k + 1) % 6, 6 + (k + 1) % 6, 6 + k] for k in range(6)),
]
AREA, VOLUME = 1800.0, 4000.0


def size_of(path: Path) -> tuple[float, float]:
    """Area and volume of a model file; the volume is right only where every face looks outward."""
    points, faces = read_geometry(path)
    a, b, c = np.moveaxis(points[faces], 1, 0)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=-1).sum() / 2
    return float(area), float((a * np.cross(b, c)).sum() / 6)


def saved(folder: Path, name: str, content: str | bytes) -> Path:
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def rows(values: np.ndarray, start: str = "") -> str:
    return "".join(f"{start}{' '.join(f'{v:g}' for v in row)}\n" for row in values)


VERTICES = rows(POINTS, "v ")


def faces_of_obj(shift: int = 1, after: str = "") -> str:
    return "".join(f"f {' '.join(f'{k + shift}{after}' for k in face)}\n" for face in FACES)


def text_ply(name: str = "vertex_indices", count: int = len(FACES)) -> str:
    head = f"ply\nformat ascii 1.0\nelement vertex {len(POINTS)}\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz")
    head += f"element face {count}\nproperty list uchar int {name}\nend_header\n"
    return head + rows(POINTS) + "".join(f"{len(f)} {' '.join(map(str, f))}\n" for f in FACES)


def binary_ply(order: str = "<", name: str = "vertex_indices", *, triangles: bool = False) -> bytes:
    """Faces before vertices, a scalar before the list, another list behind it."""
    kind = "little" if order == "<" else "big"
    triples = cut_polygons("", POINTS, np.array([len(f) for f in FACES]), np.concatenate(FACES))
    faces: Sequence[Sequence[int]] = triples.tolist() if triangles else FACES
    head = (
        f"ply\nformat binary_{kind}_endian 1.0\nelement face {len(faces)}\nproperty uchar flags\n"
        f"property list uchar int {name}\nproperty list uchar float texcoord\n"
        f"element vertex {len(POINTS)}\nproperty double x\nproperty double y\nproperty double z\n"
        "end_header\n"
    )
    body = b"".join(
        struct.pack(f"{order}BB{len(f)}iB2f", 7, len(f), *f, 2, 0.5, 0.25) for f in faces
    )
    return head.encode() + body + POINTS.astype(f"{order}f8").tobytes()


def text_stl() -> str:
    facets = (
        f"facet normal 0 0 0\nouter loop\n{rows(POINTS[face], 'vertex ')}endloop\nendfacet\n"
        for face in FACES
    )
    return f"solid a vertex of l\n{''.join(facets)}endsolid a\n"


def binary_stl() -> bytes:
    sizes = np.array([len(f) for f in FACES])
    triples = cut_polygons("", POINTS, sizes, np.concatenate(FACES))
    found = trimesh.Trimesh(POINTS, triples, process=False).export(file_type="stl")
    assert isinstance(found, bytes)
    return found


GOOD: dict[str, Callable[[], str | bytes]] = {
    "polygons.obj": lambda: VERTICES + faces_of_obj(),
    "back.obj": lambda: "v 9 9 9\n" + VERTICES + faces_of_obj(-len(POINTS)),
    "two blocks, back.obj": lambda: (
        "".join(rows(POINTS[f], "v ") + f"f {' '.join(str(k) for k in range(-len(f), 0))}\n"
                for f in FACES)
    ),
    "normals and comments.obj": lambda: "\ufeff# L\n" + VERTICES.replace("\n", " 1 0 0 # red\n")
    + "vt 0 0\nvn 0 0 1\n" + faces_of_obj(1, "/1/1") + "l 1 2\n",
    "old Mac, continued.obj": lambda: (VERTICES + faces_of_obj()).replace(" 4 ", " \\\n4 ").replace(
        "\n", "\r"),
    "before its points.obj": lambda: faces_of_obj() + VERTICES,
    "old faces.obj": lambda: VERTICES + faces_of_obj().replace("f ", "fo "),
    "capitals.obj": (VERTICES + faces_of_obj()).upper,
    "text.ply": text_ply,
    "text, CR.ply": lambda: text_ply().replace("\n", "\r"),
    "indexes.ply": lambda: text_ply("vertex_indexes"),
    "mixed.ply": binary_ply,
    "mixed, big-endian.ply": lambda: binary_ply(">"),
    "triangles, a scalar first.ply": lambda: binary_ply(triangles=True),
    "indexes, big-endian.ply": lambda: binary_ply(">", "vertex_indexes", triangles=True),
    "line end behind.ply": lambda: binary_ply() + b"\r\n",
    "loops of six.stl": text_stl,
    "CR, two solids.stl": lambda: text_stl().replace("\n", "\r") + "solid b\rendsolid b\r",
    "capitals.stl": lambda: text_stl().upper(),
    "byte order mark.stl": lambda: "\ufeff" + text_stl(),
    "binary.stl": binary_stl,
    "a byte behind.stl": lambda: binary_stl() + b"\0",
    "called solid facet, a byte behind.stl": lambda: b"solid facet".ljust(80) + binary_stl()[80:]
    + b"\n",
    "count 0.stl": lambda: binary_stl()[:80] + bytes(4) + binary_stl()[84:],
}  # fmt: skip


@pytest.mark.parametrize("name", GOOD)
def test_what_other_programs_write_is_the_same_solid(tmp_path: Path, name: str) -> None:
    assert size_of(saved(tmp_path, name, GOOD[name]())) == pytest.approx((AREA, VOLUME))


DAMAGED: dict[str, tuple[Callable[[], str | bytes], str]] = {
    "0.obj": (lambda: VERTICES + "f 0 1 2\n", "line 13, 'f 0 1 2': a face names points from 1 on"),
    "far back.obj": (lambda: VERTICES + "f -1 -2 -13\n", r"line 13, .* or back from -1 to -12"),
    "beyond.obj": (lambda: VERTICES + "f 1 2 99\n", "line 13 names point 99 of 12"),
    "comma.obj": (lambda: VERTICES.replace("v 0 0 0", "v 0,5 0 0"), "line 1, 'v 0,5 0 0', does"),
    "crossing.obj": (lambda: VERTICES + "f 1 3 2 4\n", "face 0 crosses itself"),
    "cut in a face.obj": (lambda: VERTICES + "f 1 2 3\nf 4 5\n", "face 1 has 2 corners, and 3 to"),
    "wires.obj": (lambda: VERTICES + "l 1 2\n", "surfaces or lines alone, and no triangles"),
    "short loop.stl": (lambda: "solid a\nfacet\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nendloop\n"
                       "vertex 0 1 0\nvertex 0 0 1\nendloop\nendsolid a\n", "0 has 2 corners"),
    "json.glb": (lambda: '{"asset": {"version": "2.0"}}', "not by 'glTF'; export it as binary GLB"),
    "curves.obj": (lambda: VERTICES + "surf 0 1 0 1 1 2 3 4\n", "surfaces or lines alone"),
    "cut.ply": (lambda: text_ply().rsplit("\n", 3)[0], "8 face but 6 rows follow; it is trunc"),
    "cut in a row.ply": (lambda: text_ply()[:-4], "row 8 of face, '4 5 0 6', is not what the"),
    "negative.ply": (lambda: text_ply().rstrip().rpartition("\n")[0] + "\n-3 4 5 0\n",
                     "row 8 of face, '-3 4 5 0', is not what the"),
    "more.ply": (lambda: text_ply(count=6), r"2 rows follow what its header declares \(12 vertex"),
    "huge.ply": (lambda: text_ply().replace("vertex 12", "vertex 1000000000000")[:195],
                 "declares 1000000000000 points but 4 rows follow"),
    "cut binary.ply": (lambda: binary_ply()[:-9], "of 288 bytes but 279 follow; it is truncated"),
    "more bytes.ply": (lambda: binary_ply() + bytes(9), "9 bytes follow what its header declares"),
    "other lists.ply": (lambda: text_ply("corners"), r"\['face corners'\], where one 'face vert"),
    "cut.stl": (lambda: binary_stl()[:-70], r"declares 20 triangles, and 930 bytes follow"),
    "longer.stl": (lambda: binary_stl() + bytes(50), "20 triangles, and 1050 bytes follow"),
    "nothing.stl": (lambda: bytes(84), "declares 0 triangles, and 0 bytes follow"),
    "cut text.stl": (lambda: text_stl()[:400], "STL in text that ends by .* it is truncated"),
    "comma.stl": (lambda: text_stl().replace("vertex 30 0 0", "vertex 30,0 0 0"), "decimal points"),
}  # fmt: skip


@pytest.mark.parametrize("name", DAMAGED)
def test_a_damaged_model_is_refused_where_it_is_damaged(tmp_path: Path, name: str) -> None:
    content, said = DAMAGED[name]
    with pytest.raises(InputError, match=said):
        read_geometry(saved(tmp_path, name, content()))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"extensionsRequired": ["KHR_draco_mesh_compression"]}, "needs 'KHR_draco_mesh_compr"),
        ({"extensionsRequired": ["EXT_meshopt_compression"]}, "needs 'EXT_meshopt_compression'"),
        ({"buffers": [{"uri": "part.bin", "byteLength": 9}]}, "in another file, 'part.bin'"),
        ({"nodes": [{"mesh": 0, "skin": 0}], "skins": [{"joints": [0]}]}, "needs 'a skin'"),
        ({"nodes": [{"mesh": 0, "weights": [0.0, 1.0]}]}, "needs 'morph targets'"),
        ({"nodes": [{"mesh": 0, "weights": [0.0]}]}, None),
        ({"extensionsRequired": ["KHR_materials_unlit"]}, None),
        ({"extensionsUsed": ["KHR_draco_mesh_compression"]}, None),
    ],
)
def test_what_a_glb_needs_is_named_where_it_is_not_read(
    tmp_path: Path, change: dict[str, object], said: str | None
) -> None:
    good = trimesh.creation.box((0.1, 0.2, 0.3)).export(file_type="glb")
    assert isinstance(good, bytes)
    (size,) = struct.unpack("<I", good[12:16])
    path = saved(tmp_path, "a.glb", pack_glb(json.loads(good[20 : 20 + size]) | change,
                                             good[20 + size :]))  # fmt: skip
    if said is None:
        assert size_of(path) == pytest.approx((0.22, 0.006))
    else:
        with pytest.raises(InputError, match=said):
            read_geometry(path)


def test_moved_points_of_a_sparse_glb_are_not_ignored(tmp_path: Path) -> None:
    good = trimesh.creation.box((0.1, 0.2, 0.3)).export(file_type="glb")
    assert isinstance(good, bytes)
    (size,) = struct.unpack("<I", good[12:16])
    scene = json.loads(good[20 : 20 + size])
    place = scene["meshes"][0]["primitives"][0]["attributes"]["POSITION"]
    scene["accessors"][place]["sparse"] = {"count": 1}
    with pytest.raises(InputError, match="needs 'sparse accessors'"):
        read_geometry(saved(tmp_path, "a.glb", pack_glb(scene, good[20 + size :])))


def test_a_glb_is_in_metres_and_other_files_say_no_unit(tmp_path: Path) -> None:
    trimesh.creation.box((0.1, 0.2, 0.3)).export(tmp_path / "a.glb")
    assert read_model(tmp_path / "a.glb").diameter_m == pytest.approx(0.14**0.5)
    assert Registration.load(tmp_path / "a.glb").objects == ("a",)
    with pytest.raises(InputError, match=r"a\.stl: no unit is given, .* give --unit mm"):
        read_model(saved(tmp_path, "a.stl", binary_stl()))


@given(
    radii=st.lists(st.floats(0.1, 1), min_size=4, max_size=40),
    turn=st.tuples(*[st.floats(-3, 3)] * 3),
    is_reversed=st.booleans(),
)
@settings(max_examples=60, deadline=None)
def test_triangles_of_a_star_have_its_area(
    radii: list[float], turn: tuple[float, ...], is_reversed: bool
) -> None:
    angles = np.arange(len(radii)) / len(radii) * 2 * np.pi
    star = np.stack([radii * np.cos(angles), radii * np.sin(angles), 0 * angles], -1)
    after = np.roll(star, -1, 0)
    area = (star[:, 0] * after[:, 1] - star[:, 1] * after[:, 0]).sum() / 2
    points = star @ rotation_by(torch.tensor(turn, dtype=torch.float64)).numpy().T + [5, -3, 2]
    order = np.arange(len(star))[:: -1 if is_reversed else 1]
    triangles = cut_polygons("star", points, np.array([len(star)]), order)
    assert triangles.shape == (len(star) - 2, 3)
    sides = points[triangles[:, 1:]] - points[triangles[:, :1]]
    found = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=-1).sum() / 2
    assert found == pytest.approx(area)


def test_a_hole_that_is_joined_to_the_border_stays_a_hole() -> None:
    outer, inner = [(0, 0), (4, 0), (4, 4), (0, 4)], [(1, 1), (1, 3), (3, 3), (3, 1)]
    places = [*outer, outer[0], *inner, inner[0]]
    points = np.array([(x, y, 0) for x, y in places], dtype=float)
    triangles = cut_polygons("hole", points, np.array([10]), np.arange(10))
    a, b, c = np.moveaxis(points[triangles], 1, 0)
    assert np.cross(b - a, c - a)[:, 2].sum() / 2 == pytest.approx(12)
    middles = (a + b + c) / 3
    assert not ((middles[:, :2] > 1) & (middles[:, :2] < 3)).all(-1).any()


def test_a_bent_polygon_is_cut_as_it_is_seen_from_above() -> None:
    points = POINTS[:6].copy()
    points[3, 2] = 2.0
    triangles = cut_polygons("bent", points, np.array([6]), np.arange(6))
    a, b, c = np.moveaxis(points[triangles], 1, 0)
    up = np.cross(b - a, c - a)[:, 2]
    assert (up > 0).all()
    assert up.sum() / 2 == pytest.approx(400)


@pytest.mark.parametrize(("factor", "said"), [(0.01, "is it in cm?"), (0.001, "is it in mm?")])
def test_a_model_in_centimetres_is_not_called_inches(factor: float, said: str) -> None:
    diameter, seen = float(np.linalg.norm(POINTS.max(0))), torch.from_numpy(0.6 * POINTS)
    smaller = advise_unit(diameter, factor * seen)
    larger = advise_unit(diameter / 10, seen)
    assert smaller is not None
    assert larger is not None
    assert said in smaller.message
    assert "mask fit it? Or is the model in cm?" in larger.message


def part_and(*others: tuple[float, float]) -> Any:  # noqa: ANN401  a mesh of trimesh's
    """A box of 60 x 40 x 20, and cubes of a side at a place along x."""
    cubes = [trimesh.creation.box([side] * 3) for side, _ in others]
    for cube, (_, x) in zip(cubes, others, strict=True):
        cube.apply_translation([x, 0, 0])
    return trimesh.util.concatenate([trimesh.creation.box((60, 40, 20)), *cubes])


@pytest.mark.parametrize("ending", ["stl", "ply", "obj", "glb"])
def test_a_small_body_far_from_the_part_is_named_and_left_out(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"part.{ending}"
    part_and((2, 1200)).export(path)
    said = r"left out 1 small body far from the part of 74.83 \(one of 3.46 at \(1199, -1, -1\)"
    with pytest.warns(Notice, match=said):
        points, faces = read_geometry(path)
    assert len(faces) == 12
    assert np.abs(points).max() <= 30


def test_what_is_near_the_part_is_of_it(tmp_path: Path, recwarn: pytest.WarningsRecorder) -> None:
    """A body at a quarter of its length, and one that is near to that one."""
    path = tmp_path / "part.stl"
    part_and((2, 45), (2, 64), (30, 110)).export(path)
    points, faces = read_geometry(path)
    assert len(faces) == 4 * 12
    assert points[:, 0].max() == 125
    assert not [one for one in recwarn if issubclass(one.category, Notice)]


def test_many_small_bodies_are_counted(tmp_path: Path) -> None:
    path = tmp_path / "part.stl"
    part_and(*((2, 500.0 + 100 * k) for k in range(5))).export(path)
    with pytest.warns(Notice, match=r"left out 5 small bodies .* and 2 more, in the file's unit"):
        assert len(read_geometry(path)[1]) == 12


def test_two_parts_far_from_each_other_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "two.stl"
    part_and((30, 500)).export(path)
    with pytest.raises(InputError, match="cannot be known which of them is the object"):
        read_geometry(path)


def box_glb(**change: object) -> bytes:
    """A box whose JSON is changed at its top."""
    good = trimesh.creation.box((0.1, 0.2, 0.3)).export(file_type="glb")
    assert isinstance(good, bytes)
    (size,) = struct.unpack("<I", good[12:16])
    return pack_glb(json.loads(good[20 : 20 + size]) | change, good[20 + size :])


SCENE = {"scene": 0, "scenes": [{"nodes": [0]}]}


@pytest.mark.parametrize(
    ("nodes", "said"),
    [
        ([{"mesh": 0, "matrix": [1e308, *[0] * 4, 1, *[0] * 4, 1, *[0] * 4, 1]}], "1e.308, which"),
        ([{"mesh": 0, "translation": [0, 1e20, 0]}], "translation of node 0 holds 1e.20, which"),
        ([{"mesh": 0, "scale": [1, "nan", 1]}], "scale of node 0 holds nan"),
        ([{"children": [1, 2]}, {"children": [3]}, {"children": [3]}, {"mesh": 0}],
         "node 3 hangs under nodes (1 and 2|2 and 1)"),
        ([{"mesh": 0}, {"children": [2]}, {"children": [1]}], "node 1 hangs under itself"),
        ([{"mesh": 0, "children": [0]}], "node 0 hangs under itself"),
        ([*({"mesh": 0, "children": [k + 1]} for k in range(400)), {"mesh": 0}],
         "401 nodes hang too deep in each other"),
    ],
)  # fmt: skip
def test_nodes_of_a_glb_that_are_no_tree_are_refused(
    tmp_path: Path, nodes: list[object], said: str
) -> None:
    with pytest.raises(InputError, match=said):
        read_geometry(saved(tmp_path, "a.glb", box_glb(nodes=nodes, **SCENE)))


def test_nodes_of_a_glb_that_are_a_tree_are_read(tmp_path: Path) -> None:
    """One mesh in two places is no mistake."""
    nodes = [{"children": [1, 2]}, {"mesh": 0}, {"mesh": 0, "translation": [0.2, 0, 0]}]
    path = saved(tmp_path, "a.glb", box_glb(nodes=nodes, **SCENE))
    assert size_of(path) == pytest.approx((0.44, 0.012))


def test_a_line_that_goes_on_is_one_line(tmp_path: Path) -> None:
    text = VERTICES + faces_of_obj()
    text = text.replace("f 6 5", "f 6 \\\n5").replace("v 30 0 0", "v \\\n30 \\\n0 0", 1)
    # The last line of the file too, behind which nothing comes.
    text = text.removesuffix("\n") + " \\"
    assert size_of(saved(tmp_path, "a.obj", text)) == pytest.approx((AREA, VOLUME))


def comb(teeth: int) -> np.ndarray:
    """An outline that turns back twice at each tooth."""
    rows = [(2 * k + x, y) for k in range(teeth) for x, y in ((0, 0), (0.9, 10), (1, 10), (1.9, 0))]
    return np.array([(x, y, 0) for x, y in [*rows, (2 * teeth, -1), (0, -1)]], dtype=float)


def test_a_polygon_of_many_corners_is_cut() -> None:
    """By looking at each corner some times, not at each of them for each that is cut."""
    points = comb(300)
    triangles = cut_polygons("comb", points, np.array([len(points)]), np.arange(len(points)))
    sides = points[triangles[:, 1:]] - points[triangles[:, :1]]
    area = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=-1).sum() / 2
    x, y, _ = points.T
    outline = (x * np.roll(y, -1) - y * np.roll(x, -1)).sum() / 2
    assert area == pytest.approx(abs(outline))


def test_polygons_that_take_too_long_are_refused() -> None:
    points = comb(1200)
    sizes = np.full(40, len(points))
    with pytest.raises(InputError, match="too many corners to be cut in some seconds"):
        cut_polygons("combs", points, sizes, np.tile(np.arange(len(points)), 40))
