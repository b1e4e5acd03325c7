"""From a pair to poses: parts on a table, seen by stereo rigs and by a depth sensor.

    python bench/pair_pose.py [--scenes 3] [--weights default] [--pictures FOLDER]

Each scene has the five synthetic parts on a table, seen obliquely from above. It is rendered for a
rig with a baseline of 5 cm in infrared (848x480, like a RealSense D435, without and with its
projector) and for one of 12 cm in colour (1280x720, like a ZED), with textured parts and with plain
grey ones.

Pairs are matched, depth with a confidence below 0.5 is left out, and registration poses each part
with its exact mask. For comparison it does so on the depth of an active stereo camera, which is
simulated from the exact depth of the same views. A pose is right if its ADD-S is below a tenth of
the diameter. The answers that are wrong and ``ok`` are those that a robot would trust.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from shared import group_rows, make_parser, with_cpu_seconds
from torch import Tensor

from depthpose.core.camera import StereoRig
from depthpose.core.camera.pinhole import intrinsics
from depthpose.core.files import write_image, write_json
from depthpose.core.rigid import Rigid
from depthpose.depth.config import MatcherConfig, StreetsConfig
from depthpose.depth.disparity import depth_std_from_confidence
from depthpose.depth.estimator import FakestereoNet
from depthpose.depth.synthetic import render_scene
from depthpose.depth.synthetic.materials import Appearance
from depthpose.depth.synthetic.mesh import MeshBuilder
from depthpose.depth.synthetic.projector import Projector
from depthpose.depth.synthetic.scene import NO_MARKINGS, SyntheticScene, draw_weather
from depthpose.depth.types import DepthInput
from depthpose.pose.config import SyntheticSensorConfig
from depthpose.pose.mesh import sample_surface
from depthpose.pose.metrics import SUCCESS_SHARE, adds_m
from depthpose.pose.registration import Registration
from depthpose.pose.synthetic.depth_sensors import simulate_depth
from depthpose.pose.synthetic.parts import PARTS, make_part
from depthpose.pose.synthetic.random_numbers import random_rotation
from depthpose.pose.synthetic.views import make_shape, render_view
from depthpose.pose.types import ViewInput
from depthpose.report.page import format_markdown_table

MIN_CONFIDENCE = 0.5  # the default of ``pose predict --left``
DRAWN_BASELINE_M = 0.5
"""Scenes are enlarged to this baseline, so that light and textures have their usual sizes."""
MASK_TOLERANCE_M = 1e-3
SURFACE_POINTS = 2000  # of each part, by which ADD-S is measured
PAIR, SENSOR = "pair", "depth sensor"
Row = dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class Rig:
    """A stereo camera that looks at the table."""

    name: str
    columns: int
    rows: int
    focal_px: float
    baseline_m: float
    is_infrared: bool
    distance_m: tuple[float, float]


RIGS = (
    Rig(name="5 cm, infrared", columns=848, rows=480, focal_px=424.0, baseline_m=0.05,
        is_infrared=True, distance_m=(0.4, 0.6)),
    Rig(name="12 cm, colour", columns=1280, rows=720, focal_px=700.0, baseline_m=0.12,
        is_infrared=False, distance_m=(0.5, 0.8)),
)  # fmt: skip
LOOKS = ("textured", "grey", "grey, projector")


@dataclass(frozen=True, kw_only=True, eq=False)
class TableScene:
    """A rendered pair, its exact depth, and the poses and visible pixels of the parts."""

    rig: StereoRig
    left: Tensor
    right: Tensor
    depth_m: Tensor
    poses: dict[str, Rigid]
    masks: dict[str, Tensor]


def place_parts(rng: np.random.Generator, rig: Rig) -> tuple[dict[str, Rigid], np.ndarray]:
    """Lay the parts on a plane; return their poses, and the plane's axes and origin as (4, 3)."""
    generator = torch.Generator().manual_seed(int(rng.integers(2**31)))
    distance_m = float(rng.uniform(*rig.distance_m))
    tilt = math.radians(rng.uniform(20, 55))
    # The normal of the table points to the camera; ``right`` and ``ahead`` lie in the table.
    normal = np.array([0.0, -math.sin(tilt), -math.cos(tilt)])
    right = np.array([1.0, 0, 0])
    ahead = np.cross(right, normal)
    origin = np.array([0.0, 0, distance_m])
    poses = {}
    angles = np.arange(5) * 2 * np.pi / 5
    for name, angle in zip(rng.permutation(PARTS), angles, strict=True):
        model = make_part(str(name))
        R = random_rotation(generator).numpy()
        lowest_m = float((model.vertices_m.numpy() @ R.T @ normal).min())
        radius_m = rng.uniform(0.11, 0.14)
        position_m = origin + radius_m * (np.cos(angle) * right + np.sin(angle) * ahead)
        t_m = position_m - lowest_m * normal
        poses[str(name)] = Rigid(torch.from_numpy(R).double(), torch.from_numpy(t_m).double())
    return poses, np.stack([right, ahead, normal, origin])


def draw_table(number: int, rig: Rig, look: str) -> TableScene:
    """Render scene ``number`` for a rig."""
    rng = np.random.default_rng([57, number, rig.columns])
    poses, (right, ahead, _, origin) = place_parts(rng, rig)
    scale = DRAWN_BASELINE_M / rig.baseline_m
    builder = MeshBuilder(rng)
    materials = ("wood", "stone", "concrete", "brick")
    material = materials[number % len(materials)]
    table = Appearance(material, (0.5, 0.45, 0.4), 0.4 * scale, number)
    corner = (origin - 3 * (right + ahead)) * scale
    builder.add_rectangle(corner, 6 * scale * right, 6 * scale * ahead, table)
    for name, pose in poses.items():
        add_part(builder, name, pose, scale, is_textured=look == "textured")
    scene = SyntheticScene(
        mesh=builder.finish(),
        markings=NO_MARKINGS,
        weather=replace(draw_weather(rng), haze_m=1e5),
        camera_from_world=np.eye(3),
        place="clutter",
    )
    K = intrinsics(rig.focal_px, rig.focal_px, (rig.columns - 1) / 2, (rig.rows - 1) / 2)
    drawn = StereoRig(width=rig.columns, height=rig.rows, K=K, baseline_m=DRAWN_BASELINE_M)
    projector = None
    if look.endswith("projector"):
        projector = Projector(
            place_m=(0.5 * DRAWN_BASELINE_M, 0.0, 0.0),
            dots_per_radian=rig.focal_px / 5,
            strength=1.0,
        )
    config = StreetsConfig(jpeg_share=0.0, rectification_error_px=0.1)
    frame = render_scene(scene, drawn, config, (57, number), projector)
    left, right = frame.left, frame.right
    if rig.is_infrared:
        left, right = grey(left), grey(right)
    depth_m = frame.depth_m.double() / scale
    return TableScene(
        rig=replace(drawn, baseline_m=rig.baseline_m),
        left=left.contiguous(),
        right=right.contiguous(),
        depth_m=depth_m,
        poses=poses,
        masks={name: mask_of(name, pose, K, depth_m) for name, pose in poses.items()},
    )


def grey(image: Tensor) -> Tensor:
    """Average the colours of an image."""
    return image.mean(0, keepdim=True).expand(3, -1, -1)


def add_part(
    builder: MeshBuilder, name: str, pose: Rigid, scale: float, *, is_textured: bool
) -> None:
    """Add a part to a scene that is enlarged by ``scale``."""
    builder.begin_object()
    surface = Appearance("paint", (0.35, 0.35, 0.37), 10 * scale, 0)
    if is_textured:
        surface = Appearance("stone", (0.6, 0.55, 0.5), 0.06 * scale, builder.object_id)
    model = make_part(name)
    triangles_m = model.vertices_m.double().numpy()[model.faces.numpy()]
    corners = (triangles_m @ pose.R.numpy().T + pose.t_m.numpy()) * scale
    # A texture is projected along the axis that a face is most perpendicular to.
    first, second, third = triangles_m.transpose(1, 0, 2)
    normals = np.cross(second - first, third - first)
    main_axis = np.abs(normals).argmax(1)
    other_axes = np.array([[1, 2], [0, 2], [0, 1]])[main_axis]
    uv = np.take_along_axis(triangles_m, other_axes[:, None, :].repeat(3, 1), 2) * scale
    builder.add_triangles(corners, uv, surface)


def mask_of(name: str, pose: Rigid, K: Tensor, depth_m: Tensor) -> Tensor:
    """Compute the pixels in which a part is visible."""
    part = render_view(make_shape(make_part(name)), pose, K.double())
    left, top = (K.double()[:2, 2] - part.K[:2, 2]).round().long().tolist()
    height, width = part.depth_m.shape
    rows = slice(max(top, 0), min(top + height, depth_m.shape[0]))
    columns = slice(max(left, 0), min(left + width, depth_m.shape[1]))
    part_m = part.depth_m[
        rows.start - top : rows.stop - top, columns.start - left : columns.stop - left
    ]
    mask = torch.zeros(depth_m.shape, dtype=torch.bool)
    mask[rows, columns] = (part_m - depth_m[rows, columns]).abs() < MASK_TOLERANCE_M
    return mask


def table_scenes(number: int) -> Iterator[tuple[str, str, int, TableScene]]:
    """Render every scene for every rig and look."""
    for rig in RIGS:
        for look in LOOKS:
            if look.endswith("projector") and not rig.is_infrared:
                continue
            for index in range(number):
                yield rig.name, look, index, draw_table(index, rig, look)


def match_table(net: FakestereoNet, scene: TableScene) -> tuple[Tensor, Tensor, float]:
    """Match a scene; return its sure depth, the deviation of depth, and the share left out."""
    pair = DepthInput(name="table", left=scene.left, right=scene.right, camera=scene.rig)
    estimate = net.estimate_input(pair)
    assert estimate.depth_m is not None
    assert estimate.confidence is not None
    is_sure = estimate.is_sure(MIN_CONFIDENCE)
    deviation_m = depth_std_from_confidence(estimate.depth_m, estimate.confidence, scene.rig)
    share_left_out = 1 - float(is_sure.float().mean())
    return estimate.depth_m.where(is_sure, torch.nan), deviation_m, share_left_out


def sense_table(scene: TableScene, seed: int) -> Tensor:
    """Simulate the depth [m] that an active stereo camera measures of a scene."""
    generator = torch.Generator().manual_seed(seed)
    focal_px = float(scene.rig.K[0, 0])
    sensor = SyntheticSensorConfig(kinds=("active stereo",))
    return simulate_depth(scene.depth_m.float(), (focal_px, focal_px), sensor, generator)


def pose_part(
    registration: Registration, surface_m: Tensor, scene: TableScene, name: str, depth_m: Tensor
) -> Row:
    """Pose a part by measured depth; return the errors of its pose and of the depth in its mask."""
    mask = scene.masks[name]
    view = ViewInput(name=name, depth_m=depth_m.float(), mask=mask, K=scene.rig.K, object=name)
    (estimate,) = registration.estimate_many([view])
    error = math.inf
    if estimate.camera_from_model is not None:
        error_m = adds_m(estimate.camera_from_model.double(), scene.poses[name], surface_m)
        error = float(error_m) / make_part(name).diameter_m
    depth_error_m = (depth_m - scene.depth_m)[mask]
    has_depth = depth_error_m.isfinite()
    median_error_m = None
    if bool(has_depth.any()):
        median_error_m = float(depth_error_m[has_depth].abs().median())
    return {
        "part": name,
        "status": estimate.status,
        "error": error,
        "is right": error < SUCCESS_SHARE,
        "seen": float(has_depth.float().mean()),
        "off": median_error_m,
    }


def measure_table(
    net: FakestereoNet, registration: Registration, surfaces_m: dict[str, Tensor],
    scene: TableScene, seed: int,
) -> list[Row]:  # fmt: skip
    """Pose the parts of a scene by the depth of the pair and by that of the sensor."""
    (pair_m, deviation_m, share_left_out), cpu_s = with_cpu_seconds(lambda: match_table(net, scene))
    rows: list[Row] = []
    for kind, depth_m in ((PAIR, pair_m), (SENSOR, sense_table(scene, seed))):
        for name, mask in scene.masks.items():
            row = {
                "depth": kind,
                **pose_part(registration, surfaces_m[name], scene, name, depth_m),
                "left out": None,
                "seconds": cpu_s,
                "told": None,
            }
            if kind == PAIR:
                has_depth = mask & depth_m.isfinite()
                row["left out"] = share_left_out
                if bool(has_depth.any()):
                    row["told"] = float(deviation_m[has_depth].median())
            rows.append(row)
    return rows


def print_poses(title: str, rows: list[Row]) -> None:
    """Print the poses by the depth of a pair."""
    pair_rows = [row for row in rows if row["depth"] == PAIR]
    right = sum(row["is right"] for row in pair_rows)
    parts = [f"{row['part']} {row['status']} {row['error']:.3f}" for row in pair_rows]
    print(f"{title}: right {right} of 5, {'; '.join(parts)}", flush=True)


def summary(rows: list[Row]) -> list[dict[str, str]]:
    """Average over the scenes of each rig, look and kind of depth."""
    table = []
    for (rig, look, kind), group in group_rows(rows, "rig", "look", "depth").items():
        is_right = [row["is right"] for row in group]
        is_ok = [row["status"] == "ok" for row in group]
        right_and_ok = [right and ok for right, ok in zip(is_right, is_ok, strict=True)]
        errors_m = [row["off"] for row in group if row["off"] is not None]
        deviations_m = [row["told"] for row in group if row["told"] is not None]
        deviation_mm = f"{1000 * np.median(deviations_m):.1f}" if deviations_m else ""
        table.append(
            {
                "rig": rig,
                "parts": look,
                "depth": kind,
                "poses": str(len(group)),
                "right": f"{100 * np.mean(is_right):.0f} %",
                "right and ok": f"{100 * np.mean(right_and_ok):.0f} %",
                "wrong and ok": str(sum(is_ok) - sum(right_and_ok)),
                "refused": str(sum(row["error"] == math.inf for row in group)),
                "seen of the mask": f"{100 * np.mean([row['seen'] for row in group]):.0f} %",
                "median error of depth [mm]": f"{1000 * np.median(errors_m):.1f}",
                "its deviation as told [mm]": deviation_mm,
            }
        )
    return table


def main() -> None:
    """Print a table of rigs, looks and kinds of depth."""
    parser = make_parser(__doc__)
    parser.add_argument("--scenes", type=int, default=3)
    parser.add_argument("--weights", default="default")
    parser.add_argument("--pictures", type=Path, help="write the left views here")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(1)
    net = FakestereoNet.load(options.weights, config=MatcherConfig(speed="fine"), with_check=False)
    models = {name: make_part(name) for name in PARTS}
    surfaces_m = {name: sample_surface(model, SURFACE_POINTS)[0] for name, model in models.items()}
    registration = Registration(list(models.values()))
    rows: list[Row] = []
    for rig, look, index, scene in table_scenes(options.scenes):
        if options.pictures is not None:
            file_name = f"{rig} {look} {index}.png".replace(",", "")
            write_image(options.pictures / file_name, scene.left)
        scene_rows = measure_table(net, registration, surfaces_m, scene, index)
        print_poses(f"{rig}, {look}, {index}", scene_rows)
        rows += [{"rig": rig, "look": look, **row} for row in scene_rows]
    print(format_markdown_table(summary(rows)))
    if options.out is not None:
        for row in rows:
            row["error"] = None if row["error"] == math.inf else row["error"]
        write_json(options.out, rows)


if __name__ == "__main__":
    main()
