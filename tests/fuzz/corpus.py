"""One good file of every kind that a reader takes, and the readers that take it."""

import contextlib
import io
import json
import os
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import torch
import trimesh
from PIL import Image
from tests.core.test_files_fuzz import CALIB, CAMERA, CASES, LZF_PCD, MIDDLEBURY, ROS, XML
from tests.fuzz import damage
from tests.pose.synthetic_frames import make_dataset
from tests.pose.synthetic_objects import bracket, tiny_weights

from depthpose.cli.doctor_files import describe_files
from depthpose.core.camera import StereoRig, read_camera, read_raw_pair
from depthpose.core.checkpoint import read_checkpoint, read_torch_file
from depthpose.core.config import read_config
from depthpose.core.files import (
    image_size,
    read_cloud,
    read_depth_png,
    read_image,
    read_json,
    read_key_values,
    read_map,
    read_points_bin,
    write_depth_png,
    write_json,
)
from depthpose.core.files.images import read_views
from depthpose.core.loop import read_metrics
from depthpose.core.run_folder import claim_folder, claim_names, read_settings
from depthpose.depth.config import GeneratorConfig, PSMNetConfig
from depthpose.depth.datasets import open_dataset, read_split, write_raw_frame
from depthpose.depth.datasets.frames import read_object_calibration, read_plain_calibration
from depthpose.depth.generators import UNetGenerator
from depthpose.depth.stereo import PSMNet
from depthpose.depth.train import STAGES as DEPTH_STAGES
from depthpose.depth.types import RawFrame
from depthpose.depth.weights import read_depth_weights, write_depth_weights
from depthpose.pose.datasets import open_bop, read_detections, read_mask
from depthpose.pose.datasets.entries import read_mapping
from depthpose.pose.datasets.masks import RunLengths
from depthpose.pose.mesh import read_model
from depthpose.pose.predictions import read_bop_results, read_predictions
from depthpose.pose.train import STAGES as POSE_STAGES
from depthpose.pose.weights import read_object_numbers, read_pose_weights, write_pose_weights

Reader = Callable[[Path], object]
CONFIGS = Path(__file__).parents[2] / "configs"


@dataclass(frozen=True, kw_only=True)
class Kind:
    """A good file, how it is damaged, and what reads it.

    Attributes:
        file: its name, in the folder that the readers are given where ``is_folder``.
        good: its bytes.
        damage: makes other bytes of them.
        readers: each gets the file, or the folder.
        beside: the other files of the folder.
        is_folder: whether the readers take the folder.
    """

    file: str
    good: bytes
    damage: damage.Damage
    readers: tuple[Reader, ...]
    beside: Mapping[str, bytes] | None = None
    is_folder: bool = False


def look(path: Path) -> object:
    """What ``depthpose doctor FILE`` does."""
    with contextlib.redirect_stdout(io.StringIO()):
        return describe_files([path])


def written(write: Callable[[Path], object], name: str) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        write(Path(folder) / name)
        return (Path(folder) / name).read_bytes()


def files_of(folder: Path) -> dict[str, bytes]:
    """Take every file of a folder, by its path in it."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def read_in_mm(path: Path) -> object:
    return read_model(path, "mm")


@cache
def kinds() -> dict[str, Kind]:
    """Every kind, by what it is called."""
    every = {**_pictures(), **_maps(), **_clouds(), **_meshes(), **_cameras(), **_weights()}
    every |= {**_records(), **_configs(), **_bop(), **_kitti(), **_real()}
    return every


def _pictures() -> dict[str, Kind]:
    found = {
        name: Kind(
            file=f"x{suffix}",
            good=good,
            damage=damage.hurt_png if suffix == ".png" else damage.hurt_bytes,
            readers=(*readers, read_mask, look),
        )
        for name, (suffix, readers, good) in CASES.items()
        if suffix in (".png", ".jpg", ".tif", ".webp", ".gif", ".bmp", ".ppm")
    }
    stream = io.BytesIO()
    Image.fromarray(np.arange(256, dtype=np.uint8).reshape(16, 16)).save(stream, "PNG")
    found["grey png"] = Kind(
        file="g.png", good=stream.getvalue(), damage=damage.hurt_png,
        readers=(read_image, read_mask, image_size, read_depth_png),
    )  # fmt: skip
    views = [Image.fromarray(np.full((16, 24, 3), value, np.uint8)) for value in (90, 160)]
    stream = io.BytesIO()
    views[0].save(stream, "MPO", save_all=True, append_images=views[1:])
    found["both views, mpo"] = Kind(
        file="x.mpo", good=stream.getvalue(), damage=damage.hurt_bytes,
        readers=(read_views,),
    )  # fmt: skip
    stream = io.BytesIO()
    pages = [Image.new("RGB", (24, 16)), Image.new("RGB", (24, 16))]
    pages[0].save(stream, "TIFF", save_all=True, append_images=pages[1:])
    found["pages, tiff"] = Kind(
        file="x.tif", good=stream.getvalue(), damage=damage.hurt_bytes, readers=(read_image,)
    )
    return found


def _maps() -> dict[str, Kind]:
    stream = io.BytesIO()
    np.save(stream, np.random.default_rng(0).random((4, 3)).astype(np.float32))
    both = (read_map, read_cloud, look)
    return {
        "npy": Kind(file="x.npy", good=stream.getvalue(), damage=damage.hurt_npy, readers=both),
        "pfm": Kind(file="x.pfm", good=CASES["pfm"][2], damage=damage.hurt_text,
                    readers=(read_map, look)),
    }  # fmt: skip


def _clouds() -> dict[str, Kind]:
    def kind(name: str, suffix: str, hurt: damage.Damage) -> Kind:
        readers: tuple[Reader, ...] = (read_cloud, read_in_mm, look)
        return Kind(file=f"x{suffix}", good=CASES[name][2], damage=hurt, readers=readers)

    return {
        "ply": kind("ply", ".ply", damage.hurt_text),
        "text ply": kind("text ply", ".ply", damage.hurt_text),
        "pcd": kind("pcd", ".pcd", damage.hurt_text),
        "text pcd": kind("text pcd", ".pcd", damage.hurt_text),
        "packed pcd": Kind(file="x.pcd", good=LZF_PCD, damage=damage.hurt_text,
                           readers=(read_cloud, look)),
        "xyz": kind("xyz", ".xyz", damage.hurt_text),
        "velodyne": Kind(file="x.bin", good=CASES["velodyne"][2], damage=damage.hurt_bytes,
                         readers=(read_points_bin,)),
    }  # fmt: skip


def _meshes() -> dict[str, Kind]:
    mesh = trimesh.creation.box((100, 60, 30))
    goods = {
        "text stl": ("x.stl", mesh.export(file_type="stl_ascii"), damage.hurt_text),
        "stl": ("x.stl", mesh.export(file_type="stl"), damage.hurt_bytes),
        "obj": ("x.obj", mesh.export(file_type="obj"), damage.hurt_text),
        "mesh ply": ("x.ply", mesh.export(file_type="ply"), damage.hurt_text),
        "text mesh ply": (
            "x.ply", mesh.export(file_type="ply", encoding="ascii"), damage.hurt_text,
        ),
        "glb": ("x.glb", mesh.export(file_type="glb"), damage.hurt_glb),
        "sparse glb": ("x.glb", sparse_glb(3), damage.hurt_glb),
    }  # fmt: skip
    return {
        name: Kind(
            file=file,
            good=data.encode() if isinstance(data, str) else bytes(data),
            damage=hurt,
            readers=(read_in_mm, look),
        )
        for name, (file, data, hurt) in goods.items()
    }


def sparse_glb(count: int) -> bytes:
    """A triangle whose corners are a sparse accessor of ``count`` zeros, some of them replaced."""
    values = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4").tobytes()
    body = np.array([0, 1, 2, 0], "<u2").tobytes() + values
    views = [{"buffer": 0, "byteOffset": 0, "byteLength": 6},
             {"buffer": 0, "byteOffset": 8, "byteLength": len(values)}]  # fmt: skip
    sparse = {"count": 3, "indices": {"bufferView": 0, "componentType": 5123},
              "values": {"bufferView": 1}}  # fmt: skip
    tree = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {"componentType": 5126, "count": count, "type": "VEC3", "sparse": sparse,
             "min": [0, 0, 0], "max": [1, 1, 0]},
            {"bufferView": 0, "componentType": 5123, "count": 3, "type": "SCALAR"},
        ],
        "bufferViews": views,
        "buffers": [{"byteLength": len(body)}],
    }  # fmt: skip
    rest = len(body).to_bytes(4, "little") + b"BIN\x00" + body
    return damage.pack_glb(tree, rest)


def _cameras() -> dict[str, Kind]:
    bop = {"fx": 500.0, "fy": 500, "cx": 320, "cy": 240, "width": 640, "height": 480,
           "depth_scale": 0.1}  # fmt: skip
    scene = {"1": {"cam_K": [500, 0, 320, 0, 500, 240, 0, 0, 1], "depth_scale": 1.0}}
    orb = (
        b"%YAML:1.0\nCamera.fx: 500.0\nCamera.fy: 500.0\nCamera.cx: 320\nCamera.cy: 240\n"
        b"Camera.width: 640\nCamera.height: 480\nCamera.bf: 40.0\nCamera.k1: 0.0\n"
    )
    opencv = {"K": {"type_id": "opencv-matrix", "rows": 3, "cols": 3, "dt": "d",
                    "data": [500.0, 0, 320, 0, 500, 240, 0, 0, 1]}, "image_width": 640,
              "image_height": 480}  # fmt: skip
    plain = b"focal_px: 500\ncx: 320\ncy: 240\nbaseline_m: 0.5\nwidth: 640\nheight: 480\n"
    realsense = {"width": 640, "height": 480, "fx": 500, "fy": 500, "ppx": 320, "ppy": 240,
                 "model": "distortion.brown_conrady", "coeffs": [0, 0, 0, 0, 0]}  # fmt: skip
    lens = b"camera_model: pinhole\nfisheye_model: 0\nxi: 0.0\ndistortion_model: plumb_bob\n"
    goods = {
        "RealSense camera": ("c.json", json.dumps(realsense).encode(), damage.hurt_json),
        "COLMAP camera": ("c.txt", b"# Camera list\n1 OPENCV 640 480 500 500 320 240 0 0 0 0\n",
                          damage.hurt_text),
        "lens by name": ("c.yaml", ROS + lens, damage.hurt_yaml),
        "camera": ("c.json", CAMERA, damage.hurt_json),
        "BOP camera": ("c.json", json.dumps(bop).encode(), damage.hurt_json),
        "BOP scene camera": ("c.json", json.dumps(scene).encode(), damage.hurt_json),
        "OpenCV JSON": ("c.json", json.dumps(opencv).encode(), damage.hurt_json),
        "ROS camera": ("c.yaml", ROS, damage.hurt_yaml),
        "ORB-SLAM settings": ("c.yaml", orb, damage.hurt_text),
        "OpenCV XML": ("c.xml", XML, damage.hurt_text),
        "Middlebury camera": ("c.txt", MIDDLEBURY, damage.hurt_text),
        "plain camera": ("c.txt", plain, damage.hurt_text),
        "TUM camera": ("c.txt", b"535.4 539.2 320.1 247.6 0 0 0 0 0\n", damage.hurt_text),
        "matrix": ("c.txt", b"500 0 320\n0 500 240\n0 0 1\n0.5\n", damage.hurt_text),
        "KITTI camera": ("c.txt", b"P2: 721 0 609 45 0 721 172 0.2 0 0 1 0.003\n"
                         b"P3: 721 0 609 -339 0 721 172 2.2 0 0 1 0.003\n", damage.hurt_text),
    }  # fmt: skip
    found = {
        name: Kind(file=file, good=good, damage=hurt,
                   readers=(lambda path: read_camera(path, (640, 480)), look))
        for name, (file, good, hurt) in goods.items()
    }  # fmt: skip
    right = ROS.replace(b"-60.0", b"0.0")
    found["ROS pair"] = Kind(
        file="left.yaml", good=ROS, damage=damage.hurt_yaml, beside={"right.yaml": right},
        is_folder=True, readers=(lambda folder: read_camera(folder, (640, 480)),),
    )  # fmt: skip
    eye, K = [1, 0, 0, 0, 1, 0, 0, 0, 1], [500, 0, 320, 0, 500, 240, 0, 0, 1]
    stereo = {"K1": K, "D1": [0.1, 0, 0, 0], "K2": K, "D2": [0.1, 0, 0, 0], "R": eye,
              "T": [-0.1, 0, 0], "fisheye_model": 1}  # fmt: skip
    found["stereo calibration"] = Kind(
        file="stereo.json", good=json.dumps(stereo).encode(), damage=damage.hurt_json,
        readers=(read_raw_pair,),
    )  # fmt: skip
    return found


def _weights() -> dict[str, Kind]:
    torch.manual_seed(0)
    generator = UNetGenerator(GeneratorConfig(width=2, levels=3))
    matcher = PSMNet(PSMNetConfig(width=2, max_disparity_px=16, blocks=(1, 1, 1, 1), pools=(2,)))
    facts = {"trained_on": "nothing", "licence": "MIT"}

    def write_depth(path: Path) -> None:
        write_depth_weights(path, generator=generator, matcher=matcher, facts=facts)

    def write_pose(path: Path) -> None:
        write_pose_weights(path, tiny_weights(bracket()))

    name = "w.safetensors"
    stream = io.BytesIO()
    torch.save({"state_dict": {"a": torch.rand(4, 3)}, "epoch": 3}, stream)
    return {
        "depth weights": Kind(
            file=name, good=written(write_depth, name), damage=damage.hurt_safetensors,
            readers=(read_checkpoint, read_depth_weights),
        ),
        "pose weights": Kind(
            file=name, good=written(write_pose, name), damage=damage.hurt_safetensors,
            readers=(read_pose_weights, read_object_numbers),
        ),
        "torch file": Kind(file="w.pt", good=stream.getvalue(), damage=damage.hurt_bytes,
                           readers=(read_torch_file,)),
    }  # fmt: skip


def _records() -> dict[str, Kind]:
    metrics = b"".join(
        json.dumps({"step": step, "net/loss": 1 / step, "held_out/x": step}).encode() + b"\n"
        for step in range(1, 9)
    )
    run = json.dumps({"settings": {"a": 1, "b": {"c": [2]}}, "environment": {"date": "x"}}).encode()
    sources = json.dumps({"a": "/x/a.png"}).encode()
    rle = json.dumps({"size": [4, 5], "counts": [3, 4, 13]}).encode()
    packed = json.dumps({"segmentation": {"size": [4, 5], "counts": "34="}}).encode()
    split = b"2011_09_26/2011_09_26_drive_0002_sync 0000000069 l\n" * 3

    def claim(folder: Path) -> None:
        read_settings(folder)
        claim_folder(folder, {"a": 1})

    def names(folder: Path) -> None:
        claim_names(folder, {"a": Path("/x/a.png")}, [".ply"])

    def kind(file: str, good: bytes, hurt: damage.Damage, *readers: Reader) -> Kind:
        return Kind(file=file, good=good, damage=hurt, readers=readers)

    def folder(file: str, good: bytes, hurt: damage.Damage, *readers: Reader) -> Kind:
        return Kind(file=file, good=good, damage=hurt, readers=readers, is_folder=True)

    return {
        "metrics": folder("metrics.jsonl", metrics, damage.hurt_text, read_metrics),
        "metrics by bytes": folder("metrics.jsonl", metrics, damage.hurt_bytes, read_metrics),
        "run record": folder("run.json", run, damage.hurt_json, claim),
        "sources": folder("sources.json", sources, damage.hurt_json, names),
        "JSON": kind("x.json", b'{"a": [1, 2.5, null, true, "x"]}', damage.hurt_json, read_json),
        "run lengths": kind("m.json", rle, damage.hurt_json, read_mask, look),
        "packed run lengths": kind("m.json", packed, damage.hurt_json, read_mask, look),
        "split": kind("s.txt", split, damage.hurt_text, read_split),
        "key values": kind("k.txt", CALIB, damage.hurt_text, read_key_values),
    }


def _configs() -> dict[str, Kind]:
    stages = {
        "depth/view.yaml": DEPTH_STAGES["view"][0],
        "depth/compact-stereo.yaml": DEPTH_STAGES["stereo"][0],
        "depth/compact-finetune.yaml": DEPTH_STAGES["finetune"][0],
        "pose/linemod-four.yaml": POSE_STAGES["pose"][0],
        "pose/parts-masks.yaml": POSE_STAGES["segmentation"][0],
        "pose/linemod-four-pointnet.yaml": POSE_STAGES["pointnet"][0],
        "pose/linemod-four-depth-image.yaml": POSE_STAGES["depth-image"][0],
    }
    return {
        f"config {name}": Kind(
            file="c.yaml", good=(CONFIGS / name).read_bytes(), damage=damage.hurt_yaml,
            readers=(lambda path, stage=stage: read_config(path, stage),),
        )
        for name, stage in stages.items()
    }  # fmt: skip


def _bop() -> dict[str, Kind]:
    def read_all(folder: Path) -> None:
        dataset = open_bop(folder)
        for instance in list(dataset.instances)[:2]:
            dataset.view(instance)

    def read_objects(folder: Path) -> None:
        _ = open_bop(folder).objects

    with tempfile.TemporaryDirectory() as home:
        make_dataset(Path(home), 1)
        files = files_of(Path(home))
    with tempfile.TemporaryDirectory() as home:
        found = open_bop_results(Path(home))
    scene = min(name for name in files if name.endswith("scene_gt.json")).rpartition("/")[0]
    readers = {f"{scene}/scene_gt.json": read_all, f"{scene}/scene_camera.json": read_all,
               f"{scene}/scene_gt_info.json": read_all,
               "models/models_info.json": read_objects}  # fmt: skip
    every = {
        f"BOP {name}": Kind(
            file=name, good=files[name], damage=damage.hurt_json, readers=(reader,),
            beside=files, is_folder=True,
        )
        for name, reader in readers.items()
    }  # fmt: skip
    return every | found


def open_bop_results(home: Path) -> dict[str, Kind]:
    """Results, detections and predictions of a dataset."""
    from tests.pose.synthetic_frames import pose_in_frame

    from depthpose.pose.datasets import Detection, write_detections
    from depthpose.pose.predictions import Place, Prediction, write_bop_results, write_predictions

    pose = pose_in_frame(0.1, 3)
    detection = Detection(scene_id=0, image_id=1, object_id=7, score=0.5,
                          segmentation=RunLengths((3, 4, 13), 4, 5))  # fmt: skip
    write_detections(home / "d.json", [detection] * 2)
    from depthpose.pose.types import PoseEstimate

    estimate = PoseEstimate(
        name="a", object="b", status="ok", camera_from_model=pose,
        covariance=torch.eye(6), free_motions=torch.zeros(0, 6), keypoints_m=torch.rand(8, 3),
        inlier_share=0.5, residual_m=0.1, certainty=0.9, copy_certainty=0.6, seconds={"icp": 0.1},
    )  # fmt: skip
    rows = [Prediction(estimate=estimate, place=Place(0, k, 7)) for k in range(3)]
    write_bop_results(home / "r.csv", rows)
    refusal = PoseEstimate(name="c", object="b", status="doubtful", reason="why")
    write_predictions(home, [Prediction(estimate=estimate), Prediction(estimate=refusal)])
    gt = {1: [{"obj_id": 7, "cam_R_m2c": [1, 0, 0, 0, 1, 0, 0, 0, 1], "cam_t_m2c": [0, 0, 1]}]}
    write_json(home / "gt.json", gt)
    return {
        "BOP results": Kind(file="r.csv", good=(home / "r.csv").read_bytes(),
                            damage=damage.hurt_text, readers=(read_bop_results,)),
        "BOP detections": Kind(file="d.json", good=(home / "d.json").read_bytes(),
                               damage=damage.hurt_json, readers=(read_detections,)),
        "poses": Kind(file="poses.json", good=(home / "poses.json").read_bytes(),
                      damage=damage.hurt_json, readers=(read_predictions,), is_folder=True),
        "LineMOD YAML": Kind(file="gt.yml", good=(home / "gt.json").read_bytes(),
                             damage=damage.hurt_yaml, readers=(read_mapping,)),
    }  # fmt: skip


def _kitti() -> dict[str, Kind]:
    def read_first(folder: Path) -> None:
        dataset = open_dataset(folder)
        dataset.read_input(0)
        dataset.read_truth(0)

    K = torch.tensor([[70.0, 0, 31.5], [0, 70, 11.5], [0, 0, 1]], dtype=torch.float64)
    rig = StereoRig(width=64, height=24, K=K, baseline_m=0.54)
    image = torch.rand(3, 24, 64, generator=torch.Generator().manual_seed(0))
    points = torch.tensor([[5.0, 0.1, 0.2, 0.5], [9.0, -1.0, 0.1, 0.5]])
    frame = RawFrame(
        left=image, right=image, rig=rig, disparity_px=torch.full((24, 64), 5.0),
        occluded=torch.zeros(24, 64, dtype=torch.bool),
        is_sky=torch.zeros(24, 64, dtype=torch.bool), lidar_points=points,
        camera_from_velodyne=torch.tensor([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0],
                                           [0, 0, 0, 1]], dtype=torch.float64).numpy(),
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as home:
        write_raw_frame(Path(home), "2100_01_01_drive_0000_sync", 0, frame)
        files = files_of(Path(home))
    hurt = {".txt": damage.hurt_text, ".png": damage.hurt_png, ".bin": damage.hurt_bytes}
    found = {
        f"KITTI {name.rpartition('/')[2] if name.endswith('txt') else name}": Kind(
            file=name, good=good, damage=hurt[Path(name).suffix], readers=(read_first,),
            beside=files, is_folder=True,
        )
        for name, good in files.items()
        if name.endswith(tuple(hurt))
    }  # fmt: skip
    lines = b"a 640 480 500 320 240 0.5\nb 640 480 500 320 240 0.5\n"
    of_object = (
        b"P2: 721 0 609 45 0 721 172 0.2 0 0 1 0.003\nP3: 721 0 609 -339 0 721 172 2 0 0 "
        b"1 0.003\nR0_rect: 1 0 0 0 1 0 0 0 1\nTr_velo_to_cam: 0 -1 0 0 0 0 -1 0 1 0 0 0\n"
    )
    found["KITTI object"] = Kind(
        file="000000.txt", good=of_object, damage=damage.hurt_text,
        readers=(lambda path: read_object_calibration(path, 1242, 375),),
    )  # fmt: skip
    found["plain calibration"] = Kind(
        file="calib.txt", good=lines, damage=damage.hurt_text,
        readers=(lambda path: read_plain_calibration(path, "a", 640, 480),),
    )  # fmt: skip
    depth = written(lambda path: write_depth_png(path, 80 * torch.rand(9, 8)), "d.png")
    found["depth png"] = Kind(file="d.png", good=depth, damage=damage.hurt_png,
                              readers=(read_depth_png, look))  # fmt: skip
    return found


def _real() -> dict[str, Kind]:
    """Real files, where there are any."""
    home = Path(os.environ.get("DEPTHPOSE_DATA") or "/nowhere")
    wanted: dict[str, tuple[damage.Damage, tuple[Reader, ...]]] = {
        "*.ply": (damage.hurt_text, (read_cloud, read_in_mm)),
        "calib*.txt": (damage.hurt_text, (read_key_values, read_camera)),
        "*camera*.json": (damage.hurt_json, (read_camera,)),
        "*.pfm": (damage.hurt_text, (read_map,)),
        "*.jpg": (damage.hurt_bytes, (read_image,)),
        "*.bin": (damage.hurt_bytes, (read_points_bin,)),
        "models_info.json": (damage.hurt_json, (read_json,)),
    }
    found: dict[str, Kind] = {}
    for pattern, (hurt, readers) in wanted.items():
        files = sorted(p for p in home.rglob(pattern) if p.is_file() and p.stat().st_size < 300_000)
        if files:
            found[f"real {pattern}"] = Kind(
                file=files[0].name, good=files[0].read_bytes(), damage=hurt, readers=readers
            )
    return found
