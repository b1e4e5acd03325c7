"""``pose predict --left --right``: a rectified pair to the pose of a part, in one command."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from tests.pose.synthetic_objects import write_part

from depthpose.cli import main
from depthpose.cli.pose.pairs import DEPTH, DEVIATION
from depthpose.core.camera import StereoRig, write_camera
from depthpose.core.camera.pinhole import intrinsics
from depthpose.core.checkpoint import SHIPPED
from depthpose.core.files import read_map, write_image
from depthpose.depth.config import StreetsConfig
from depthpose.depth.disparity import depth_std_from_confidence
from depthpose.depth.synthetic import render_scene
from depthpose.depth.synthetic.materials import Appearance
from depthpose.depth.synthetic.mesh import MeshBuilder
from depthpose.depth.synthetic.scene import NO_MARKINGS, SyntheticScene, draw_weather
from depthpose.pose.synthetic.parts import make_part_mesh

pytestmark = pytest.mark.skipif(
    not (SHIPPED / "default.safetensors").is_file(), reason="no weights ship yet"
)
PLACE_M = np.array([0.02, -0.01, 0.9])


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A part before a wall, seen by a rig of 8 cm; its mask, and its CAD file in millimetres."""
    home = tmp_path_factory.mktemp("pair")
    write_part("bracket", home)
    vertices_mm, faces = make_part_mesh("bracket")
    turn = Rotation.from_euler("xyz", [200, 25, 40], degrees=True).as_matrix()
    corners = np.asarray(vertices_mm)[np.asarray(faces)] / 1000 @ turn.T + PLACE_M
    rng = np.random.default_rng(2)
    builder = MeshBuilder(rng)
    wall = Appearance("brick", (0.5, 0.45, 0.4), 0.3, 1)
    builder.add_rectangle([-2, 1.5, 1.3], [4, 0, 0], [0, -3, 0], wall)
    builder.begin_object()
    # Textured by its places in x and y of the camera: no seam matters to a matcher.
    builder.add_triangles(corners, corners[..., :2], Appearance("stone", (0.6, 0.6, 0.65), 0.08, 0))
    scene = SyntheticScene(
        mesh=builder.finish(),
        markings=NO_MARKINGS,
        weather=draw_weather(rng),
        camera_from_world=np.eye(3),
        place="clutter",
    )
    K = intrinsics(700.0, 700.0, 319.5, 239.5)
    rig = StereoRig(width=640, height=480, K=K, baseline_m=0.08)
    frame = render_scene(scene, rig, StreetsConfig(jpeg_share=0.0, rectification_error_px=0.0))
    write_image(home / "left.png", frame.left)
    write_image(home / "right.png", frame.right)
    write_image(home / "mask.png", (frame.depth_m < 1.25).float().expand(3, -1, -1))
    write_camera(home / "rig.json", rig)
    np.savetxt(home / "truth.txt", np.vstack([np.column_stack([turn, PLACE_M]), [0, 0, 0, 1]]))
    torch.save(frame.depth_m, home / "depth.pt")
    return home


def predict(home: Path, out: Path, *words: str) -> int:
    views = ["--left", str(home / "left.png"), "--right", str(home / "right.png")]
    part = ["--method", "register", "--cad", str(home / "bracket.stl"), "--unit", "mm"]
    camera = ["--camera", str(home / "rig.json"), "--out", str(out)]
    return main(["pose", "predict", *views, *part, *camera, *words])


@pytest.mark.slow
def test_a_pair_becomes_a_pose(
    pair: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert predict(pair, out, "--mask", str(pair / "mask.png")) == 0
    assert "% of the depth is less sure than 0.5 and left out" in capsys.readouterr().err
    (row,) = json.loads((out / "poses.json").read_text())
    assert row["status"] in ("ok", "ambiguous")
    found, truth = np.array(row["camera_from_model"]), np.loadtxt(pair / "truth.txt")
    assert np.linalg.norm(found[:3, 3] - truth[:3, 3]) < 0.01
    # From this side the part turned by half looks nearly alike, and may be named in its place.
    named = [found, *(np.array(one["camera_from_model"]) for one in row["alternatives"])]
    turns = [Rotation.from_matrix(one[:3, :3].T @ truth[:3, :3]).magnitude() for one in named]
    assert np.rad2deg(min(turns)) < 8
    # What was posed is the depth of the pair where it is sure, and how far off it may be.
    depth_m, deviation_m = (read_map(out / name / "left.npy") for name in (DEPTH, DEVIATION))
    true_m = torch.load(pair / "depth.pt")
    known = depth_m.isfinite()
    assert float(((depth_m - true_m).abs() / true_m)[known].median()) < 0.01
    assert torch.equal(deviation_m.isfinite(), known)
    before = (out / DEPTH / "left.npy").stat().st_mtime_ns
    assert predict(pair, out, "--mask", str(pair / "mask.png")) == 0
    assert (out / DEPTH / "left.npy").stat().st_mtime_ns == before, "a rerun keeps what is there"


@pytest.mark.slow
def test_a_pair_that_fails_is_named_and_stops_no_other(
    pair: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for side in ("left", "right"):
        (tmp_path / side).mkdir()
        content = (pair / f"{side}.png").read_bytes()
        (tmp_path / side / "good.png").write_bytes(content)
        (tmp_path / side / "torn.png").write_bytes(content[: None if side == "left" else 5000])
    out = tmp_path / "out"
    views = ["--left", str(tmp_path / "left"), "--right", str(tmp_path / "right")]
    words = ["--camera", str(pair / "rig.json"), "--matcher", "sgbm", "--out", str(out)]
    words += ["--cad", str(pair / "bracket.stl"), "--unit", "mm", "--box", "150,100,500,400"]
    assert main(["pose", "predict", *views, *words]) == 1
    assert "depthpose: failed:" in capsys.readouterr().err
    assert {row["name"] for row in json.loads((out / "poses.json").read_text())} == {"good"}

    # Another pair in the same folder: the one before is not posed again.
    for side in ("left", "right"):
        (tmp_path / side / "torn.png").unlink()
        (tmp_path / side / "good.png").rename(tmp_path / side / "other.png")
        (tmp_path / side / "more.png").write_bytes((tmp_path / side / "other.png").read_bytes())
    assert main(["pose", "predict", *views, *words]) == 0
    assert {path.stem for path in (out / DEPTH).glob("*.npy")} == {"other", "more"}


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--min-confidence", "1.5"], "--min-confidence 1.5: give 0 to 1"),
        (["--depth", "mask.png"], "give one of --cloud, --depth, --left and --bop"),
    ],
)
def test_what_is_no_pair_is_refused(
    pair: Path, tmp_path: Path, words: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    found = [str(pair / word) if word.endswith(".png") else word for word in words]
    assert predict(pair, tmp_path / "out", *found) == 2
    assert said in capsys.readouterr().err


def test_the_deviation_of_depth_grows_with_its_square_and_with_doubt() -> None:
    K = intrinsics(50.0, 50.0, 31.5, 23.5)
    rig = StereoRig(width=64, height=48, K=K, baseline_m=0.1)
    # Disparities of 5, 2.5 and 0.25 px: a share of the disparity, then the least that is told.
    depth_m = torch.tensor([[1.0, 2.0, 10.0, 20.0, 1.0, torch.nan]])
    confidence = torch.tensor([[0.95, 0.95, 1.0, 1.0, 0.4, 0.9]])
    first, second, far, farther, unsure, unknown = depth_std_from_confidence(
        depth_m, confidence, rig
    )[0]
    assert float(first) == pytest.approx(0.2 / 5)
    assert float(second) == pytest.approx(4 * 0.2 / 5)
    assert float(farther) == pytest.approx(4 * float(far))
    assert float(unsure) == pytest.approx(0.085 * 5 / 5)
    assert bool(unknown.isnan())
