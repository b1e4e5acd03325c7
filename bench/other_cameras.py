"""Depth from one image by cameras of other cars than KITTI's, with and without their mount.

    python bench/other_cameras.py --samples SAMPLES [--weights default kitti-nc] [--speed fine]

KITTI-360 (five frames of one camera) and two scenes in DGP's layout (six cameras, of which 05 to 09
look aside or back), against scans. Height and tilt are those of a plane through the scan's points
on the ground. AbsRel, d1 and scale (median of estimate / truth) where truth is 1 to 80 m; where no
road is found, the estimate without the mount counts.
"""

import argparse
import json
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from depthpose.core.camera import Camera
from depthpose.core.errors import InputError
from depthpose.core.files import read_image
from depthpose.depth.config import MatcherConfig
from depthpose.depth.estimator import FakestereoNet
from depthpose.depth.ground import scale_by_mount
from depthpose.depth.types import StereoInput
from depthpose.report.page import markdown_table, write_table

MOUNTS = ("nothing", "height", "height and tilt")
LEAST_M, MOST_M = 1.0, 80.0
GROUND_M = (3.0, 25.0)
"""Where along the optical axis points of the scan are taken for the ground."""


@dataclass(frozen=True)
class View:
    """An image, the true depth of some pixels, and how the camera is mounted."""

    camera: str
    image: StereoInput
    depth_m: np.ndarray
    mount: tuple[float, float] | None


def mount_of(points: np.ndarray) -> tuple[float, float] | None:
    """Give height [m] and tilt [degrees] by a plane through points of a scan, (n, 3), by RANSAC."""
    x, y, z = points.T
    near = points[(z > GROUND_M[0]) & (z < GROUND_M[1]) & (np.abs(x) < 6) & (y > 0.8)]
    if len(near) < 100:
        return None
    rng = np.random.default_rng(0)
    rows = np.c_[near[:, [0, 2]], np.ones(len(near))]  # y = a x + b z + c
    best = np.zeros(len(near), bool)
    for _ in range(300):
        three = rng.choice(len(near), 3, replace=False)
        try:
            plane = np.linalg.solve(rows[three], near[three, 1])
        except np.linalg.LinAlgError:
            continue
        is_on = np.abs(rows @ plane - near[:, 1]) < 0.05
        if abs(plane[0]) < 0.1 and abs(plane[1]) < 0.15 and is_on.sum() > best.sum():
            best = is_on
    if best.sum() < 100:
        return None
    a, b, c = np.linalg.lstsq(rows[best], near[best, 1], rcond=None)[0]
    return float(c / math.sqrt(1 + a * a + b * b)), math.degrees(math.atan(b))


def seen_by(points: np.ndarray, K: np.ndarray, height: int, width: int) -> np.ndarray:
    """Give the depth map of points in the camera's frame, the nearest first; NaN elsewhere."""
    ahead = points[points[:, 2] > LEAST_M]
    ahead = ahead[np.argsort(-ahead[:, 2])]
    pixels = ahead @ K.T
    u, v = (np.round(pixels[:, k] / pixels[:, 2]).astype(int) for k in (0, 1))
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    depth_m = np.full((height, width), np.nan, np.float32)
    depth_m[v[inside], u[inside]] = ahead[inside, 2]
    return depth_m


def view_of(name: str, path: Path, K: np.ndarray, points: np.ndarray) -> View:
    """Read an image, and look at the points of a scan in the frame of its camera."""
    left = read_image(path)
    height, width = left.shape[1:]
    camera = Camera(width=width, height=height, K=torch.from_numpy(K))
    image = StereoInput(name=path.stem, left=left, right=None, camera=camera)
    return View(name, image, seen_by(points, K, height, width), mount_of(points))


def kitti360(folder: Path) -> Iterator[View]:
    """Read the frames of KITTI-360's left camera."""
    calibration = dict(
        line.split(":", 1)
        for line in (folder / "calib/perspective.txt").read_text().splitlines()
        if ":" in line
    )
    P, R = (
        np.array(calibration[key].split(), float).reshape(3, -1)
        for key in ("P_rect_00", "R_rect_00")
    )
    text = (folder / "calib/calib_cam_to_velo.txt").read_text()
    velo_from_camera = np.array(text.split(), float).reshape(3, 4)
    for path in sorted((folder / "left").glob("*.png")):
        scan = np.fromfile(folder / "lidar" / f"{path.stem}.bin", np.float32).reshape(-1, 4)
        in_camera = (scan[:, :3] - velo_from_camera[:, 3]) @ velo_from_camera[:, :3]
        yield view_of("KITTI-360", path, P[:, :3], in_camera @ R.T)


def dgp(folder: Path) -> Iterator[View]:
    """Read the scenes of a folder in DGP's layout: every image with the scan of its sample."""
    for scene in sorted(folder.glob("scene_*")):
        facts = json.loads(next(iter(scene.glob("scene_*.json"))).read_text())
        known = json.loads(next(iter(scene.glob("calibration/*.json"))).read_text())
        lenses = dict(zip(known["names"], known["intrinsics"], strict=True))
        data = {one["key"]: one for one in facts["data"]}
        for sample in facts["samples"]:
            members = [data[key] for key in sample["datum_keys"]]
            scan = next(
                one["datum"]["point_cloud"] for one in members if one["id"]["name"] == "LIDAR"
            )
            points = np.load(scene / scan["filename"])["data"][:, :3]
            turn, shift = pose(scan["pose"])
            world = points @ turn.T + shift
            for one in members:
                name = one["id"]["name"]
                if name == "LIDAR":
                    continue
                lens, picture = lenses[name], one["datum"]["image"]
                K = np.array([
                    [lens["fx"], 0, lens["cx"]], [0, lens["fy"], lens["cy"]], [0, 0, 1],
                ])  # fmt: skip
                turn, shift = pose(picture["pose"])
                path = scene / picture["filename"]
                yield view_of(f"DGP {scene.name[-1]}, {name[-2:]}", path, K, (world - shift) @ turn)


def pose(entry: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Give rotation and place of a sensor in the world."""
    turn, shift = entry["rotation"], entry["translation"]
    R = Rotation.from_quat([turn["qx"], turn["qy"], turn["qz"], turn["qw"]]).as_matrix()
    return R, np.array([shift["x"], shift["y"], shift["z"]])


def errors(depth_m: np.ndarray, truth_m: np.ndarray) -> dict[str, float]:
    """Compare where truth is 1 to 80 m; the sky counts as 80 m."""
    known = (truth_m > LEAST_M) & (truth_m < MOST_M)
    ratio = np.clip(np.nan_to_num(depth_m[known], nan=MOST_M), LEAST_M, MOST_M) / truth_m[known]
    return {
        "abs_rel": float(np.abs(ratio - 1).mean()),
        "d1": float((np.maximum(ratio, 1 / ratio) < 1.25).mean()),
        "scale": float(np.median(ratio)),
    }


def measured(view: View, net: FakestereoNet) -> list[dict[str, Any]]:
    """Estimate a view once, and scale it by what is known of the mount."""
    camera = view.image.camera
    assert camera is not None
    found = net.estimate_pair(view.image)
    rows: list[dict[str, Any]] = []
    for number, given in enumerate(MOUNTS):
        keys = ("mount_height_m", "tilt_deg")[:number]
        known = dict(zip(keys, view.mount or (), strict=False))
        asked = replace(view.image, camera=replace(camera, **known))
        try:
            depth_m = scale_by_mount(found, asked).depth_m
        except InputError:
            depth_m = found.depth_m
        assert depth_m is not None
        rows.append({
            "camera": view.camera, "given": given, "image": view.image.name,
            "height_m": view.mount and view.mount[0], "tilt_deg": view.mount and view.mount[1],
            "road": found.ground is not None, "confidence": found.image_confidence,
        } | errors(depth_m.numpy(), view.depth_m))  # fmt: skip
    return rows


def main() -> None:
    """Estimate, and print the means of each camera."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--samples", type=Path, required=True)
    parser.add_argument("--weights", nargs="+", default=["default", "kitti-nc"])
    parser.add_argument("--speed", default="fine")
    parser.add_argument("--out", type=Path, default=Path("out/bench/other_cameras"))
    options = parser.parse_args()
    more = options.samples / "depth/more"
    views = [*kitti360(more / "kitti360"), *dgp(more / "tri_dgp")]
    rows: list[dict[str, Any]] = []
    for weights in options.weights:
        net = FakestereoNet.load(weights, config=MatcherConfig(speed=options.speed), allow_ood=True)
        for view in views:
            rows += [{"weights": weights} | row for row in measured(view, net)]
    options.out.mkdir(parents=True, exist_ok=True)
    write_table(options.out, rows, name="other_cameras")
    summed = []
    for key in dict.fromkeys((row["weights"], row["camera"], row["given"]) for row in rows):
        mine = [row for row in rows if (row["weights"], row["camera"], row["given"]) == key]
        numbers = ("height_m", "tilt_deg", "abs_rel", "d1", "scale")
        known = {n: [row[n] for row in mine if row[n] is not None] for n in numbers}
        row = {"weights": key[0], "camera": key[1], "given": key[2], "views": len(mine)}
        row["roads"] = sum(one["road"] for one in mine)
        summed.append(row | {n: float(np.mean(v)) if v else None for n, v in known.items()})
    print(markdown_table(summed))


if __name__ == "__main__":
    main()
