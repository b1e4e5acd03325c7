"""The commands that write, with inputs as small as they can be."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from tests.depth.constant_selection import sure_of
from tests.pose.synthetic_frames import frame_models, make_dataset
from tests.pose.synthetic_objects import bracket, cloud_of, pose_at, tiny_weights, write_part
from tests.raw_pairs import make_raw, write_kalibr
from tests.synthetic_street import make_street, write_pairs
from tests.test_cli_engine import make_home

from depthpose.core.camera import write_camera
from depthpose.core.files import PointCloud, write_cloud, write_depth_png, write_image
from depthpose.depth.types import DepthSample
from depthpose.depth.weights import write_depth_weights
from depthpose.pose.datasets import write_bop_models
from depthpose.pose.networks.fcn import ResNet18
from depthpose.pose.synthetic import make_part
from depthpose.pose.weights import write_pose_weights

VIEW = """
generator: {width: 2, levels: 3, virtual_focal_px: 130.0}
discriminator_width: 2
pairs: {focal_px: 130.0, augment: {crop_px: [32, 64]}}
loop: {steps: 12, batch_size: 2, device: cpu, save_every_steps: 3, validate_every_steps: 4}
"""
PART = """
network: {first_kernel: 3, encoder: [4, 4, 8, 8], decoder: [4, 4, 4, 8]}
cloud: {max_points: 200}
objects: {views: 2}
held_out: {number: 2, occlusions: [0.0]}
loop: {steps: 6, batch_size: 2, device: cpu, save_every_steps: 2}
"""


@dataclass(frozen=True)
class Command:
    """A command of the outcome table.

    Attributes:
        words: without ``--out``; ``{home}`` is the folder that :func:`make_inputs` has filled.
        out: file or folder of the results.
    """

    words: str
    out: str = "out"

    @property
    def name(self) -> str:
        """What a table calls it."""
        return self.words.partition(" -")[0].partition(" {")[0]

    @property
    def is_file(self) -> bool:
        """Whether it writes one file, and refuses to write over it."""
        return "." in self.out

    def given(self, home: Path, disk: Path) -> list[str]:
        """The words for results on ``disk``."""
        words = [word.format(home=home) for word in self.words.split()]
        return [*words, "--out", str(disk / self.out)]


_DEPTH = "--camera {home}/rig.json --weights {home}/w.safetensors"
_BOP = "--bop {home}/bop --weights {home}/p.safetensors"
COMMANDS: Sequence[Command] = (
    Command(f"depth predict {{home}}/left {_DEPTH} --cloud"),
    Command(f"depth predict {{home}}/left {_DEPTH} --cloud --engine ray --block 2"),
    Command(
        "depth match {home}/left {home}/right --camera {home}/rig.json --no-check "
        "--weights {home}/m.safetensors --cloud"
    ),
    Command(
        "depth evaluate --data {home}/pairs --protocol kitti-2015 --weights {home}/m.safetensors"
    ),
    Command("depth train view --config {home}/view.yaml --data {home}/pairs --resume"),
    Command(
        "depth calibrate {home}/s.safetensors --data {home}/pairs --alarm-share 0.5",
        "c.safetensors",
    ),
    Command("pose predict --cloud {home}/clouds --object bracket --weights {home}/p.safetensors"),
    Command(f"pose predict {_BOP}"),
    Command(f"pose evaluate {_BOP}"),
    Command(
        "pose train --cad {home}/bracket.stl --unit mm --config {home}/part.yaml --resume",
    ),
    Command("data make streets --number 2 --scale 0.15"),
    Command("data make near --number 1 --first 12"),
    Command("data make objects --cad {home}/bracket.stl --unit mm --number 2"),
    Command("data pack {home}/pairs"),
    Command("data label {home}/pairs --weights {home}/m.safetensors --min-confidence 0"),
    Command("data rectify {home}/raw/left.png {home}/raw/right.png --camera {home}/camchain.yaml"),
    Command(
        "weights pack {home}/w.safetensors --trained-on nothing --licence MIT",
        "packed.safetensors",
    ),
    Command("weights complete {home}/bare.safetensors --models {home}/parts", "whole.safetensors"),
    Command("weights import resnet18 {home}/resnet18.pth", "resnet18.safetensors"),
    # Stands for "export depth" too: the same function writes the file and its proof.
    Command("export pose --weights {home}/p.safetensors", "pose.onnx"),
    Command(
        "reproduce 2.2 --kitti {home}/street --split all --weights {home}/m.safetensors "
        "--protocol eigen-raw-camera"
    ),
    Command("reproduce 3.3 --weights {home}/p.safetensors --points 60 --synthetic 1"),
    Command("figure 3-4 --weights {home}/p.safetensors --number 1"),
    Command("demo --weights {home}/w.safetensors"),
)


def make_inputs(home: Path) -> Path:
    """Write what the commands read."""
    make_home(home)
    write_pairs(home / "pairs", (0.1, 0.1, 0.1))
    write_depth_weights(home / "s.safetensors", generator=sure_of(1), facts={})
    for name, text in (("view", VIEW), ("part", PART)):
        (home / f"{name}.yaml").write_text(text)
    make_dataset(home / "bop", frames=2)
    weights = tiny_weights(*frame_models())
    write_pose_weights(home / "p.safetensors", weights)
    part = make_part("bracket", 3)
    write_bop_models(home / "parts", [part])
    write_pose_weights(home / "bare.safetensors", tiny_weights(part), with_meshes=False)
    torch.save(ResNet18().state_dict(), home / "resnet18.pth")
    for k in range(2):
        cloud = PointCloud(points=cloud_of(bracket(), pose_at(seed=k)))
        write_cloud(home / "clouds" / f"{k}.ply", cloud)
    write_part("bracket", home).rename(home / "bracket.stl")
    street = make_street(0.25)
    write_street(home / "street", street)
    raw = make_raw(street.input)
    write_image(home / "raw/left.png", raw.left)
    write_image(home / "raw/right.png", raw.right)
    write_kalibr(home / "camchain.yaml", raw.pair)
    return home


def write_street(folder: Path, street: DepthSample) -> None:
    """Write two pairs with depth in KITTI's frame."""
    assert street.input.right is not None
    assert street.input.camera is not None
    assert street.truth.depth_m is not None
    for name in "ab":
        write_image(folder / "left" / f"{name}.png", street.input.left)
        write_image(folder / "right" / f"{name}.png", street.input.right)
        write_depth_png(folder / "lidar_depth" / f"{name}.png", street.truth.depth_m)
    write_camera(folder / "camera.json", street.input.camera)
