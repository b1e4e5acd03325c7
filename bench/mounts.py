"""Depth from one image by cameras of other mounts: synthetic streets, nothing known, height, tilt.

    python bench/mounts.py [--weights default kitti-nc] [--streets 1]

Each street is seen by 27 cameras (heights, tilts, fields of view; 640x360), at the quick speed.
AbsRel between 1 and 80 m without anything, with the height, with height and tilt given; where no
road is found, the estimate without them counts. Views are kept in views.npz and drawn once.
"""

import argparse
import dataclasses
import itertools
import math
from pathlib import Path
from typing import Any

import numpy as np
import torch

from depthpose.core.camera import Camera
from depthpose.core.errors import InputError
from depthpose.depth.config import MatcherConfig
from depthpose.depth.estimator import FakestereoNet
from depthpose.depth.ground import scale_by_mount
from depthpose.depth.synthetic.dataset import draw_light, draw_sensors, expose, view_from
from depthpose.depth.synthetic.scene import make_scene
from depthpose.depth.synthetic.shading import prepare
from depthpose.depth.types import StereoInput
from depthpose.report.page import markdown_table, write_table

WIDTH, HEIGHT = 640, 360
HEIGHTS_M, TILTS_DEG, FOVS_DEG = (1.2, 1.65, 2.5), (-5, 0, 5), (50, 80, 110)
MADE_AT_M = 1.65
BEHIND_M = 12.0
"""What lies farther behind the camera is left out."""


def camera(fov_deg: float, **mount: float) -> Camera:
    """Make a camera with its axis through the middle."""
    f = WIDTH / 2 / math.tan(math.radians(fov_deg / 2))
    K = torch.tensor([[f, 0, (WIDTH - 1) / 2], [0, f, (HEIGHT - 1) / 2], [0, 0, 1]]).double()
    return Camera(width=WIDTH, height=HEIGHT, K=K, **mount)


def draw(street: int, height_m: float, tilt_deg: int, fov_deg: int) -> dict[str, Any]:
    """Draw one street from a mount: 8-bit picture and depth [m]."""
    scene = make_scene((777, street), MADE_AT_M)
    raised_m = np.array([0, height_m - MADE_AT_M, 0])
    world = scene.mesh.corners.astype(float) @ scene.camera_from_world + raised_m
    normals = scene.mesh.normals @ scene.camera_from_world.astype(np.float32)
    c, s = math.cos(math.radians(tilt_deg)), math.sin(math.radians(tilt_deg))
    R = np.array([[1, 0, 0], [0, c, s], [0, -s, c]])
    corners = (world @ R.T).astype(np.float32)
    turned = dataclasses.replace(
        scene.mesh, corners=corners, normals=normals @ R.T.astype(np.float32)
    )
    mesh = turned.part(corners[:, :, 2].max(1) > -BEHIND_M)
    seen = dataclasses.replace(scene, mesh=mesh, camera_from_world=R)
    stage = prepare(seen, WIDTH * HEIGHT)
    sight = view_from(stage, camera(fov_deg).K, (HEIGHT, WIDTH), torch.zeros(3))
    light = draw_light(stage, sight)
    seed = [street, int(height_m * 100), 9 - tilt_deg, fov_deg]
    sensor, _ = draw_sensors(np.random.default_rng(seed), light, 0.3)
    picture = (expose(light, sensor) * 255).round().byte().numpy()
    return {"picture": picture, "depth_m": sight.raster.depth_m.half().numpy()}


def abs_rel(depth_m: np.ndarray, truth_m: np.ndarray) -> float:
    """Mean relative error where truth is 1 to 80 m; estimates are capped there."""
    known = np.isfinite(truth_m) & (truth_m > 1) & (truth_m < 80) & np.isfinite(depth_m)
    return float(np.abs(np.clip(depth_m[known], 0.5, 80) / truth_m[known] - 1).mean())


def means(rows: list[dict[str, Any]], by: str) -> list[dict[str, Any]]:
    """Give the mean errors for each value of one property of the mount."""
    found = []
    for weights, value in dict.fromkeys((row["weights"], row[by]) for row in rows):
        mine = [row for row in rows if (row["weights"], row[by]) == (weights, value)]
        ways = ("nothing", "height", "height and tilt", "road")
        mean = {way: float(np.mean([row[way] for row in mine])) for way in ways}
        found.append({"weights": weights, by: value, "views": len(mine)} | mean)
    return found


def main() -> None:
    """Draw what is not there yet, estimate, write the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--weights", nargs="+", default=["default", "kitti-nc"])
    parser.add_argument("--streets", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("out/bench/mounts"))
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    kinds = list(itertools.product(range(options.streets), HEIGHTS_M, TILTS_DEG, FOVS_DEG))
    looks = []
    for kind in kinds:
        path = options.out / f"{'_'.join(map(str, kind))}.npz"
        if not path.exists():
            np.savez_compressed(path, **draw(*kind))
        looks.append(np.load(path))
    rows: list[dict[str, Any]] = []
    for weights in options.weights:
        net = FakestereoNet.load(weights, config=MatcherConfig(speed="quick"), allow_ood=True)
        for (_, height_m, tilt_deg, fov_deg), look_at in zip(kinds, looks, strict=True):
            image = StereoInput(
                name="view", left=torch.from_numpy(look_at["picture"]).float() / 255, right=None,
                camera=camera(fov_deg),
            )  # fmt: skip
            found, truth_m = net.estimate_pair(image), look_at["depth_m"].astype(np.float32)
            row = {
                "weights": weights,
                "height_m": height_m,
                "tilt_deg": tilt_deg,
                "fov_deg": fov_deg,
            }
            for name, mount in (
                ("nothing", {}),
                ("height", {"mount_height_m": height_m}),
                ("height and tilt", {"mount_height_m": height_m, "tilt_deg": float(tilt_deg)}),
            ):
                asked = dataclasses.replace(image, camera=camera(fov_deg, **mount))
                try:
                    depth_m = scale_by_mount(found, asked).depth_m
                except InputError:
                    depth_m = found.depth_m
                assert depth_m is not None
                row[name] = abs_rel(depth_m.numpy(), truth_m)
            rows.append(row | {"road": found.ground is not None})
    write_table(options.out, rows, name="mounts")
    for by in ("height_m", "tilt_deg", "fov_deg"):
        print(markdown_table(means(rows, by)))


if __name__ == "__main__":
    main()
