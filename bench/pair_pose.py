"""From a pair to poses: parts on a table, seen by stereo rigs and by a depth sensor.

    python bench/pair_pose.py [--scenes 3] [--weights default] [--pictures FOLDER]

Each scene has the five synthetic parts on a table that is seen from above at a slant. It is drawn
for a rig of 5 cm in infrared (848x480, as of a RealSense D435, without and with its projector) and
for one of 12 cm in colour (1280x720, as of a ZED), with textured parts and with plain grey ones.
Pairs are matched, depth that is less sure than 0.5 is left out, and registration poses each part
with its exact mask; so it does on the depth of a sensor like an active stereo camera, which is
simulated on the exact depth of the same views. A pose is right where ADD-S is below a tenth of the
diameter. Wrong and ``ok`` are the answers that a robot would trust.
"""

import argparse
import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from depthpose.core.camera import StereoRig
from depthpose.core.camera.pinhole import intrinsics
from depthpose.core.files import write_image, write_json
from depthpose.core.rigid import Rigid
from depthpose.depth.config import MatcherConfig, StreetsConfig
from depthpose.depth.disparity import depth_deviation
from depthpose.depth.estimator import FakestereoNet
from depthpose.depth.synthetic import draw_scene
from depthpose.depth.synthetic.dataset import Projector
from depthpose.depth.synthetic.mesh import MeshBuilder, Surface
from depthpose.depth.synthetic.scene import Markings, StreetScene, draw_weather
from depthpose.depth.types import StereoInput
from depthpose.pose.config import SyntheticSensorConfig
from depthpose.pose.mesh import sample_surface
from depthpose.pose.metrics import SUCCESS_SHARE, adds_m
from depthpose.pose.registration import Registration
from depthpose.pose.synthetic.parts import PARTS, make_part
from depthpose.pose.synthetic.views import draw_view, make_shape, random_rotation, simulate_depth
from depthpose.pose.types import ViewInput
from depthpose.report.page import markdown_table

MIN_CONFIDENCE = 0.5
"""As ``pose predict --left`` has it by default."""
DRAWN_BASELINE_M = 0.5
"""Scenes are drawn so much larger that light and textures have their usual sizes."""
PAIR, SENSOR = "pair", "depth sensor"


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
    """A drawn pair, its exact depth, and what lies on the table."""

    rig: StereoRig
    left: Tensor
    right: Tensor
    depth_m: Tensor
    poses: dict[str, Rigid]
    masks: dict[str, Tensor]


def place_parts(rng: np.random.Generator, rig: Rig) -> tuple[dict[str, Rigid], np.ndarray]:
    """Lay the parts on a plane; give their poses, and the plane's axes and origin as (4, 3)."""
    generator = torch.Generator().manual_seed(int(rng.integers(2**31)))
    distance_m = float(rng.uniform(*rig.distance_m))
    tilt = math.radians(rng.uniform(20, 55))
    # Out of the table, towards the camera, and the two axes in it.
    normal = np.array([0.0, -math.sin(tilt), -math.cos(tilt)])
    right = np.array([1.0, 0, 0])
    ahead = np.cross(right, normal)
    origin = np.array([0.0, 0, distance_m])
    poses = {}
    for name, angle in zip(rng.permutation(PARTS), np.arange(5) * 2 * np.pi / 5, strict=True):
        model = make_part(str(name))
        R = random_rotation(generator).numpy()
        lowest_m = float((model.vertices_m.numpy() @ R.T @ normal).min())
        radius_m = rng.uniform(0.11, 0.14)
        at = origin + radius_m * (np.cos(angle) * right + np.sin(angle) * ahead)
        t_m = at - lowest_m * normal
        poses[str(name)] = Rigid(torch.from_numpy(R).double(), torch.from_numpy(t_m).double())
    return poses, np.stack([right, ahead, normal, origin])


def draw_table(number: int, rig: Rig, look: str) -> TableScene:
    """Draw scene ``number`` for a rig."""
    rng = np.random.default_rng([57, number, rig.columns])
    poses, (right, ahead, _, origin) = place_parts(rng, rig)
    scale = DRAWN_BASELINE_M / rig.baseline_m
    builder = MeshBuilder(rng)
    tops = ("wood", "stone", "concrete", "brick")
    top = Surface(tops[number % len(tops)], (0.5, 0.45, 0.4), 0.4 * scale, number)
    corner = (origin - 3 * (right + ahead)) * scale
    builder.rectangle(corner, 6 * scale * right, 6 * scale * ahead, top)
    for name, pose in poses.items():
        builder.thing += 1
        model = make_part(name)
        local_m = model.vertices_m.double().numpy()[model.faces.numpy()]
        corners = (local_m @ pose.R.numpy().T + pose.t_m.numpy()) * scale
        surface = Surface("paint", (0.35, 0.35, 0.37), 10 * scale, 0)
        if look == "textured":
            surface = Surface("stone", (0.6, 0.55, 0.5), 0.06 * scale, builder.thing)
        # A texture lies on the faces as seen along the axis that they face most.
        normals = np.cross(local_m[:, 1] - local_m[:, 0], local_m[:, 2] - local_m[:, 0])
        along = np.abs(normals).argmax(1)
        across = np.array([[1, 2], [0, 2], [0, 1]])[along]
        uv = np.take_along_axis(local_m, across[:, None, :].repeat(3, 1), 2) * scale
        builder.triangles(corners, uv, surface)
    scene = StreetScene(
        mesh=builder.finish(),
        markings=Markings(
            lines=np.zeros((0, 4)), bars=np.zeros((0, 5)), brightness=0.5, wheel_tracks=(0.0, 3.0)
        ),
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
    frame = draw_scene(scene, drawn, config, (57, number), projector)
    views = [frame.left, frame.right]
    if rig.is_infrared:
        views = [view.mean(0, keepdim=True).expand(3, -1, -1) for view in views]
    depth_m = frame.depth_m.double() / scale
    return TableScene(
        rig=replace(drawn, baseline_m=rig.baseline_m),
        left=views[0].contiguous(),
        right=views[1].contiguous(),
        depth_m=depth_m,
        poses=poses,
        masks={name: mask_of(name, pose, K, depth_m) for name, pose in poses.items()},
    )


def mask_of(name: str, pose: Rigid, K: Tensor, depth_m: Tensor) -> Tensor:
    """Give the pixels in which a part is seen."""
    view = draw_view(make_shape(make_part(name)), pose, K.double())
    left, top = (K.double()[:2, 2] - view.K[:2, 2]).round().long().tolist()
    height, width = view.depth_m.shape
    rows = slice(max(top, 0), min(top + height, depth_m.shape[0]))
    columns = slice(max(left, 0), min(left + width, depth_m.shape[1]))
    alone_m = view.depth_m[
        rows.start - top : rows.stop - top, columns.start - left : columns.stop - left
    ]
    mask = torch.zeros(depth_m.shape, dtype=torch.bool)
    mask[rows, columns] = (alone_m - depth_m[rows, columns]).abs() < 1e-3
    return mask


def scenes(number: int) -> Iterator[tuple[str, str, int, TableScene]]:
    """Draw every scene for every rig and look."""
    for rig in RIGS:
        for look in LOOKS:
            if look.endswith("projector") and not rig.is_infrared:
                continue
            for index in range(number):
                yield rig.name, look, index, draw_table(index, rig, look)


def matched_depth(net: FakestereoNet, scene: TableScene) -> tuple[Tensor, Tensor, float]:
    """Match a scene; give the depth that is sure, its deviation, and the share left out."""
    pair = StereoInput(name="table", left=scene.left, right=scene.right, camera=scene.rig)
    found = net.estimate_pair(pair, with_check=False)
    assert found.depth_m is not None
    assert found.confidence is not None
    is_sure = found.is_sure(MIN_CONFIDENCE)
    deviation_m = depth_deviation(found.depth_m, found.confidence, scene.rig)
    left_out = 1 - float(is_sure.float().mean())
    return found.depth_m.where(is_sure, torch.nan), deviation_m, left_out


def main() -> None:
    """Print a table of rigs, looks and kinds of depth."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=3)
    parser.add_argument("--weights", default="default")
    parser.add_argument("--pictures", type=Path, help="write the left views here")
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    torch.set_num_threads(1)
    net = FakestereoNet.load(given.weights, config=MatcherConfig(speed="fine"))
    models = {name: make_part(name) for name in PARTS}
    surfaces = {name: sample_surface(model, 2000)[0] for name, model in models.items()}
    parts = Registration(list(models.values()))
    results = []
    for rig, look, index, scene in scenes(given.scenes):
        if given.pictures is not None:
            write_image(given.pictures / f"{rig} {look} {index}.png".replace(",", ""), scene.left)
        began = time.process_time()
        pair_m, deviation_m, left_out = matched_depth(net, scene)
        seconds = time.process_time() - began
        generator = torch.Generator().manual_seed(index)
        focal_px = float(scene.rig.K[0, 0])
        sensor = SyntheticSensorConfig(kinds=("active stereo",))
        sensed_m = simulate_depth(scene.depth_m.float(), (focal_px, focal_px), sensor, generator)
        for kind, depth_m in ((PAIR, pair_m), (SENSOR, sensed_m)):
            for name, mask in scene.masks.items():
                view = ViewInput(
                    name=name, depth_m=depth_m.float(), mask=mask, K=scene.rig.K, object=name
                )
                (found,) = parts.estimate_many([view])
                error = math.inf
                if found.camera_from_model is not None:
                    true = scene.poses[name]
                    error_m = adds_m(found.camera_from_model.double(), true, surfaces[name])
                    error = float(error_m) / models[name].diameter_m
                error_z_m = (depth_m - scene.depth_m)[mask]
                known = error_z_m.isfinite()
                results.append({
                    "rig": rig, "look": look, "depth": kind, "part": name, "status": found.status,
                    "error": error, "is right": error < SUCCESS_SHARE,
                    "seen": float(known.float().mean()),
                    "off": float(error_z_m[known].abs().median()) if bool(known.any()) else None,
                    "left out": left_out if kind == PAIR else None, "seconds": seconds,
                    "told": float(deviation_m[mask][known].median())
                    if kind == PAIR and bool(known.any()) else None,
                })  # fmt: skip
        of_pair = [r for r in results[-10:] if r["depth"] == PAIR]
        print(
            f"{rig}, {look}, {index}: right {sum(r['is right'] for r in of_pair)} of 5, "
            + "; ".join(f"{r['part']} {r['status']} {r['error']:.3f}" for r in of_pair),
            flush=True,
        )
    rows = []
    for key in dict.fromkeys((r["rig"], r["look"], r["depth"]) for r in results):
        chosen = [r for r in results if (r["rig"], r["look"], r["depth"]) == key]
        off = [r["off"] for r in chosen if r["off"] is not None]
        told = [r["told"] for r in chosen if r["told"] is not None]
        rows.append({
            "rig": key[0], "parts": key[1], "depth": key[2], "poses": str(len(chosen)),
            "right": f"{100 * np.mean([r['is right'] for r in chosen]):.0f} %",
            "right and ok":
                f"{100 * np.mean([r['is right'] and r['status'] == 'ok' for r in chosen]):.0f} %",
            "wrong and ok": str(sum(not r["is right"] and r["status"] == "ok" for r in chosen)),
            "refused": str(sum(r["error"] == math.inf for r in chosen)),
            "seen of the mask": f"{100 * np.mean([r['seen'] for r in chosen]):.0f} %",
            "median error of depth [mm]": f"{1000 * np.median(off):.1f}",
            "its deviation as told [mm]": f"{1000 * np.median(told):.1f}" if told else "",
        })  # fmt: skip
    print(markdown_table(rows))
    if given.out is not None:
        refusals = {math.inf: None}
        write_json(given.out, [{k: refusals.get(v, v) for k, v in r.items()} for r in results])


if __name__ == "__main__":
    main()
