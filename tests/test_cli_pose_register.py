"""``pose predict --method register``: a CAD file alone to the poses of clouds and depth images."""

import csv
import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from tests.pose.synthetic_frames import draw_frame, frame_models, make_dataset
from tests.pose.synthetic_objects import write_part

from depthpose.cli import main
from depthpose.core.camera import Camera, write_camera
from depthpose.core.errors import Notice
from depthpose.core.files import PointCloud, read_cloud, write_cloud, write_depth_png, write_image
from depthpose.pose.config import ObjectsConfig
from depthpose.pose.datasets import write_bop_models, write_bop_scene
from depthpose.pose.inputs import rigid_input
from depthpose.pose.metrics import add_m
from depthpose.pose.synthetic import SyntheticViews, make_part


@pytest.fixture
def cad(drawn: Path, tmp_path: Path) -> Path:
    """The folder of :func:`drawn` for a test of its own; its CAD file."""
    shutil.copytree(drawn, tmp_path, dirs_exist_ok=True)
    return tmp_path / "bracket.stl"


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A part, a cloud of it in millimetres, and a depth image with its mask and camera."""
    folder = tmp_path_factory.mktemp("part")
    write_part("bracket", folder)
    config = ObjectsConfig(views=None, resolution=(1.0, 1.0), occluded_share=0.0, seed=5)
    views = SyntheticViews([make_part("bracket")], config)
    write_cloud(folder / "scan.ply", PointCloud(points=1000 * views[0].input.points_m))
    window = views.view(0).input
    centre_px = torch.tensor(config.centre_px)
    left, top = (centre_px - window.K[:2, 2]).round().long().tolist()
    width, height = config.image_px
    height_px, width_px = window.mask.shape
    depth_m, mask = torch.full((height, width), torch.nan), torch.zeros(3, height, width)
    place = (slice(top, top + height_px), slice(left, left + width_px))
    depth_m[place], mask[:, *place] = window.depth_m.float(), window.mask.float()
    K = window.K.double() + torch.tensor([[0, 0, left], [0, 0, top], [0, 0, 0]])
    camera = Camera(width=width, height=height, K=K, depth_unit_m=0.0001)
    write_camera(folder / "camera.json", camera)
    write_depth_png(folder / "depth.png", depth_m, 0.0001)
    write_image(folder / "mask.png", mask)
    return folder


def predict(*words: str | Path) -> int:
    return main(["pose", "predict", "--method", "register", *map(str, words)])


def rows(out: Path) -> list[dict]:
    return json.loads((out / "poses.json").read_text())


def test_a_cad_file_and_a_cloud_give_a_pose(cad: Path, tmp_path: Path) -> None:
    words = ["--cad", cad, "--unit", "mm", "--cloud", tmp_path / "scan.ply"]
    assert predict(*words, "--out", tmp_path / "out") == 0
    (row,) = rows(tmp_path / "out")
    # A cloud alone shows less than a depth image: nothing is seen through.
    assert row["object"] == "bracket"
    assert row["status"] in ("ok", "ambiguous")
    assert (tmp_path / "out/scan.pose.ply").is_file()
    assert (tmp_path / "out/report.html").is_file()


@pytest.mark.slow
def test_a_notice_on_a_file_that_the_report_reads_again_is_given_once(
    cad: Path, tmp_path: Path
) -> None:
    write_cloud(tmp_path / "scan.pcd", read_cloud(tmp_path / "scan.ply"))
    data = (tmp_path / "scan.pcd").read_bytes()
    moved = data.replace(b"VIEWPOINT 0 0 0 1", b"VIEWPOINT 0.5 0 0 1")
    (tmp_path / "scan.pcd").write_bytes(moved)
    words = [
        "--cad",
        cad,
        "--unit",
        "mm",
        "--cloud",
        tmp_path / "scan.pcd",
        "--out",
        tmp_path / "o",
    ]
    command = [sys.executable, "-m", "depthpose", "pose", "predict", "--method", "register"]
    done = subprocess.run([*command, *map(str, words)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("VIEWPOINT 0.5 0 0 1 0 0 0") == 1


@pytest.mark.slow
def test_a_declared_symmetry_is_taken_and_doubted_aloud(cad: Path, tmp_path: Path) -> None:
    words = ["--cad", cad, "--unit", "mm", "--cloud", tmp_path / "scan.ply"]
    with pytest.warns(Notice, match="bracket: turned by the symmetry z,2 its surface lies"):
        assert predict(*words, "--symmetry", "bracket:z,2", "--out", tmp_path / "out") == 0
    assert rows(tmp_path / "out")[0]["status"] in ("ok", "ambiguous")
    # Results of other symmetries are other results.
    assert predict(*words, "--out", tmp_path / "out") == 2


def test_a_depth_image_has_a_unit_of_its_own(cad: Path, tmp_path: Path) -> None:
    files = [word for name in ("depth.png", "mask.png", "camera.json")
             for word in (f"--{name.split('.')[0]}", tmp_path / name)]  # fmt: skip
    words = ["--cad", cad, "--cad-unit", "mm", *files, "--out", tmp_path / "out"]
    assert predict(*words) == 0
    assert rows(tmp_path / "out")[0]["status"] in ("ok", "ambiguous")


def test_a_data_set_brings_its_models(tmp_path: Path) -> None:
    data = make_dataset(tmp_path / "made", frames=1)
    assert predict("--bop", data.folder, "--out", tmp_path / "out") == 0
    assert len(rows(tmp_path / "out")) == len(data)


def test_targets_of_the_challenge_give_its_csv(tmp_path: Path) -> None:
    data = tmp_path / "tless"  # whose folder of scenes has a type in its name
    part = frame_models()[0]
    frames = [draw_frame(number, [part, part]) for number in range(3)]
    write_bop_models(data, [part])
    write_bop_scene(data, "test_primesense", 2, frames)
    target = {"scene_id": 2, "obj_id": 7}
    targets = [{"im_id": 0, "inst_count": 2, **target}, {"im_id": 2, "inst_count": 1, **target}]
    (data / "test_targets_bop19.json").write_text(json.dumps(targets))
    words = ["--bop", data, "--split", "test_primesense", "--out", tmp_path / "out"]
    assert predict(*words, "--targets", "test_targets_bop19.json") == 0
    text = (tmp_path / "out/depthpose_tless-test-primesense.csv").read_text()
    head, *answers = csv.reader(text.splitlines())
    assert head == ["scene_id", "im_id", "obj_id", "score", "R", "t", "time"]
    assert [row[:3] for row in answers] == [["2", "0", "7"], ["2", "0", "7"], ["2", "2", "7"]]
    for _, image, _, score, R, t_mm, _ in answers:
        pose = torch.eye(4)
        pose[:3, :3] = torch.tensor([float(word) for word in R.split(" ")]).reshape(3, 3)
        pose[:3, 3] = torch.tensor([float(word) for word in t_mm.split(" ")]) / 1000
        estimates = [
            rigid_input(torch.tensor(row["camera_from_model"]))
            for row in rows(tmp_path / "out")
            if row["im_id"] == int(image)
        ]
        errors = [float(add_m(rigid_input(pose), one, part.vertices_m)) for one in estimates]
        assert min(errors) < 1e-4
        assert 0 < float(score) <= 1
    assert answers[0][6] == answers[1][6] != answers[2][6]
    assert float(answers[0][6]) > 0


def test_a_cad_file_is_followed_through_frames(
    cad: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scan = read_cloud(tmp_path / "scan.ply").points
    for k in range(3):
        moved = scan + torch.tensor([2.0 * k, 0.0, 0.0])
        write_cloud(tmp_path / f"frames/{k}.ply", PointCloud(points=moved))
    words = ["--cad", str(cad), "--unit", "mm"]  # a CAD file is registered
    frames = ["--cloud", str(tmp_path / "frames"), "--out", str(tmp_path / "out")]
    assert main(["pose", "track", *words, *frames]) == 0
    assert "2 tracked, 1 found, 0 lost" in capsys.readouterr().out
    places = [torch.tensor(row["camera_from_model"])[:3, 3] for row in rows(tmp_path / "out")]
    torch.testing.assert_close(
        places[2] - places[0], torch.tensor([0.004, 0, 0]), atol=1e-3, rtol=0
    )


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--method register --cloud scan.ply", "give --cad part.stl --unit mm, or --bop"),
        ("--method register --cad bracket.stl --cloud scan.ply", "give --unit mm"),
        ("--cad bracket.stl --unit mm --cloud scan.ply --method network",
         "weights know their own objects; leave --method network out"),
        ("--cad bracket.stl --unit mm --cloud scan.ply --weights parts", "without a network"),
        ("--method register --cad bracket.stl --bop .", "Leave --cad out"),
        ("--cad-unit mm --cloud scan.ply", "no CAD file is given. Leave --cad-unit out"),
        ("--method register --cad scan.txt --unit mm --cloud scan.ply", "triangles, such as STL"),
        ("--symmetry z,2 --cloud scan.ply", "--symmetry: has no effect here; it is of --cad"),
        ("--method register --symmetry z,2 --bop .", "--symmetry: has no effect here"),
        ("--method register --cad bracket.stl --unit mm --symmetry z,two --cloud scan.ply",
         "symmetry 'z,two': 'z,two' is no axis with 2 to 360 turns; write AXIS,N"),
        ("--method register --cad bracket.stl --unit mm --symmetry plug:z,2 --cloud scan.ply",
         "no object is called so; Known: 'bracket'"),
    ],
)  # fmt: skip
def test_what_is_missing_is_said(
    cad: Path,
    words: str,
    said: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(cad.parent)
    Path("scan.txt").write_text("".join(f"{k} {k * k} {k % 7}\n" for k in range(20)))
    assert main(["pose", "predict", *words.split(), "--out", "out"]) == 2
    assert said in capsys.readouterr().err
