"""``depthpose doctor FILE...``: what files are, in which unit, and what is odd."""

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from tests.core.test_camera_rectified import pair
from tests.pose.synthetic_objects import K, bracket, cloud_of, pose_at, view_of

from depthpose.cli import main
from depthpose.core.camera import Camera, StereoRig, write_camera
from depthpose.core.errors import Notice
from depthpose.core.files import PointCloud, write_cloud, write_depth_png, write_image, write_map
from depthpose.pose.types import ObjectModel


@pytest.fixture
def things(tmp_path: Path) -> Path:
    """One of each kind, as it should be; millimetres and metres where people have them."""
    left, right = pair()
    for name, image in (("left", left), ("right", right)):
        write_image(tmp_path / f"{name}.png", image)
    part, pose = bracket(), pose_at()
    depth_m, mask = view_of(part, pose)
    write_depth_png(tmp_path / "depth.png", depth_m, 0.001)
    write_map(tmp_path / "depth.npy", depth_m)
    Image.fromarray(mask.numpy()).save(tmp_path / "mask.png")
    write_cloud(tmp_path / "cloud.ply", PointCloud(points=cloud_of(part, pose).float()))
    write_obj(tmp_path / "part.obj", part, 1000)
    write_camera(tmp_path / "sensor.json", Camera(width=320, height=240, K=K, depth_unit_m=0.001))
    wide = torch.tensor([[400.0, 0, 239.5], [0, 400, 119.5], [0, 0, 1]], dtype=torch.float64)
    write_camera(tmp_path / "rig.json", StereoRig(width=480, height=240, K=wide, baseline_m=0.12))
    return tmp_path


def write_obj(path: Path, part: ObjectModel, scale: float) -> None:
    points = [f"v {x} {y} {z}" for x, y, z in (scale * part.vertices_m).tolist()]
    faces = [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in part.faces.tolist()]
    path.write_text("\n".join([*points, *faces]) + "\n")


def said(capsys: pytest.CaptureFixture[str], *files: Path) -> tuple[int, str]:
    code = main(["doctor", *map(str, files)])
    return code, capsys.readouterr().out


def test_a_good_pair_is_named_and_nothing_is_odd(
    things: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out = said(capsys, things / "left.png", things / "right.png", things / "rig.json")
    assert code == 0
    assert "left.png: picture of 480x240\n" in out
    assert "rig.json: camera of 480x240, fx 400.0 px, 62 degrees wide, baseline 0.12 m\n" in out
    assert "left.png and right.png as a pair: rows agree to" in out
    assert "odd" not in out


def test_swapped_sides_are_odd(things: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, out = said(capsys, things / "right.png", things / "left.png")
    assert code == 1
    assert "right.png and left.png as a pair\n  odd: left and right look swapped" in out
    code, out = said(capsys, things / "left.png", things / "left.png")
    assert code == 1
    assert "odd: left and right are the same picture" in out


def test_depth_mask_and_camera_fit(things: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = [things / name for name in ("depth.png", "depth.npy", "mask.png", "sensor.json")]
    code, out = said(capsys, *files)
    assert (code, "odd" in out) == (0, False)
    assert "depth.png: 16-bit depth of 320x240" in out
    assert "m (most sensors)" in out
    assert "depth.npy: map of 320x240" in out
    assert "mask.png: mask of 320x240" in out
    assert "sensor.json: camera of 320x240" in out
    assert "depth in units of 0.001 m" in out


def test_a_mesh_in_millimetres_beside_a_cloud_in_metres(
    things: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out = said(capsys, things / "part.obj", things / "cloud.ply")
    assert code == 1
    assert "across: millimetres (--unit mm)\n" in out
    assert "from the origin: metres\n" in out
    assert "odd: beside cloud.ply: your model is " in out
    assert "is it in mm?" in out


@pytest.mark.parametrize(
    ("scale", "mesh", "cloud"),
    [
        (1.0, "metres (--unit m)", "metres"),
        (100.0, "metres, cm or mm; measure it", "centimetres"),
        (1000.0, "millimetres (--unit mm)", "millimetres"),
    ],
)
def test_centimetres_are_a_unit_too(
    scale: float, mesh: str, cloud: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A tetrahedron 0.14 m across, 0.7 m away."""
    corners = scale * np.array([[0, 0, 0.7], [0.1, 0, 0.7], [0, 0.1, 0.7], [0, 0, 0.75]])
    rows = [" ".join(map(str, row)) for row in corners]
    faces = "f 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"
    (tmp_path / "part.obj").write_text("".join(f"v {row}\n" for row in rows) + faces)
    (tmp_path / "cloud.xyz").write_text("\n".join(rows))
    _, out = said(capsys, tmp_path / "part.obj", tmp_path / "cloud.xyz")
    assert f"across: {mesh}\n" in out
    assert f"from the origin: {cloud}\n" in out


def test_each_oddity_is_said_with_its_file(
    things: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Image.new("L", (320, 240), 255).save(things / "inverted.png")
    write_depth_png(things / "far.png", torch.full((240, 320), 3e-4), 1e-5)
    (things / "low.txt").write_text("100 100 80 60\n")
    (things / "none.yaml").write_text("hello: world\n")
    write_map(things / "mm.npy", torch.full((5, 6), 850.0))
    names = ("inverted.png", "far.png", "low.txt", "none.yaml", "mm.npy")
    code, out = said(capsys, *(things / name for name in names))
    assert code == 1
    assert "covers 100% of the image and its border: is it inverted?" in out
    assert "no value is above 255: a picture of depth, not the data?" in out
    assert "low.txt: cannot be used\n  odd: the principal point (80, 60) lies far off" in out
    assert "none.yaml: cannot be used\n  odd: no camera that is known" in out
    assert "the median 850 is too far; is it in millimetres? Divide by 1000" in out


def test_a_camera_of_another_size_and_unit_is_odd(
    things: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_camera(things / "unit.json", Camera(width=320, height=240, K=K, depth_unit_m=1.0))
    code, out = said(capsys, things / "depth.png", things / "left.png", things / "unit.json")
    assert code == 1
    assert "odd: beside unit.json: it is 480x240 but its camera is 320x240;" in out
    assert "m by the camera's depth_unit_m 1; 0.001 means millimetres" in out


def test_a_picture_of_ten_bits_is_no_depth(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    grey = np.random.default_rng(0).integers(1, 1024, (12, 16)).repeat(4, 0).repeat(4, 1)
    Image.fromarray(grey.astype(np.uint16)).save(tmp_path / "mono10.png")
    with pytest.warns(Notice, match="is taken as black"):
        code, text = said(capsys, tmp_path / "mono10.png")
    assert code == 0
    assert "picture of 64x48, 16 bits a value, from" in text
    ramp = np.linspace(800, 900, 48 * 64).reshape(48, 64)
    ramp[:4] = 0
    Image.fromarray(ramp.astype(np.uint16)).save(tmp_path / "depth.png")
    assert "16-bit depth of 64x48" in said(capsys, tmp_path / "depth.png")[1]


def test_a_pose_is_no_cloud_of_four_points(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    matrix = pose_at(0.1, 0.6).matrix().double().numpy()
    np.savetxt(tmp_path / "pose.txt", matrix)
    matrix[:3, 3] *= 1000
    (tmp_path / "pose.json").write_text(str(matrix.tolist()))
    code, out = said(capsys, tmp_path / "pose.txt")
    assert code == 0
    assert out.startswith(f"{tmp_path / 'pose.txt'}: pose, turned by ")
    assert "degrees, 0.6083 m away\n" in out
    code, out = said(capsys, tmp_path / "pose.json")
    assert code == 1
    assert "odd: it moves by 608.3, taken as metres: is it in millimetres?" in out


def test_points_that_faces_share_are_counted_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """STL repeats them for every face."""
    import trimesh

    trimesh.creation.box((0.1, 0.2, 0.3)).export(tmp_path / "box.stl")
    _, out = said(capsys, tmp_path / "box.stl")
    assert "mesh of 8 points and 12 faces, 0.3742 across" in out
