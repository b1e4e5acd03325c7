"""Depth from one image by cameras of other mounts: nothing known, the height, height and tilt.

    python bench/mounts.py --samples SAMPLES [--weights default] [--speed quick] [--sets kitti dgp]

Synthetic streets, each seen by 27 cameras (heights, tilts, fields of view, rolls; 640x360, drawn
once into --out), and real ones: `choice` is what parameters may be chosen by (DrivingStereo's two
pairs and KITTI's training drives), all others are evaluation alone. True height and tilt are those
of a plane through the truth's ground. What is measured where truth is 1 to 80 m: AbsRel, the same
after median scaling, scale (median of estimate / truth), and its variation, the standard deviation
of the scale's logarithm among the frames of a drive. `map` is the network's depth, uncorrected;
`frames` has nothing given either, but takes a drive's frames for those of one mount. Where a given
mount is refused, the depth without it counts.
"""

import argparse
import dataclasses
import itertools
import json
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

from depthpose.core.camera import Camera, StereoRig, read_rig
from depthpose.core.errors import InputError
from depthpose.core.files import read_image
from depthpose.depth.config import MatcherConfig, SelectionConfig
from depthpose.depth.estimator import FakestereoNet
from depthpose.depth.ground import MountFilter, fit_ground, scale_by_mount
from depthpose.depth.synthetic.dataset import draw_light, draw_sensors, expose, view_from
from depthpose.depth.synthetic.scene import make_scene
from depthpose.depth.synthetic.shading import prepare
from depthpose.depth.types import StereoInput
from depthpose.report.page import markdown_table, write_table

WIDTH, HEIGHT = 640, 360
HEIGHTS_M, TILTS_DEG, FOVS_DEG, ROLLS_DEG = (1.2, 1.65, 2.5), (-5, 0, 5), (50, 80, 110), (0, 2, -2)
MADE_AT_M = 1.65
BEHIND_M = 12.0
"""What lies farther behind the camera is left out."""
SEEDED_BY = 777
CHOICE_STREETS = 11
"""The first street that takes part in choices; those before it are for evaluation."""
SETS = ("choice", "synthetic", "kitti", "kitti360", "dgp")
WAYS = ("map", "nothing", "height", "height and tilt", "frames")
LEAST_M, MOST_M = 1.0, 80.0
GROUND_M = (3.0, 25.0)
"""Where along the optical axis points of the scan are taken for the ground."""


@dataclass(frozen=True)
class View:
    """An image, the true depth of some pixels, and how the camera is mounted."""

    camera: str
    drive: str
    image: StereoInput
    depth_m: np.ndarray
    mount: tuple[float, float] | None


def camera_of_fov(fov_deg: float) -> Camera:
    """Make a camera with its axis through the middle."""
    f = WIDTH / 2 / math.tan(math.radians(fov_deg / 2))
    K = torch.tensor([[f, 0, (WIDTH - 1) / 2], [0, f, (HEIGHT - 1) / 2], [0, 0, 1]]).double()
    return Camera(width=WIDTH, height=HEIGHT, K=K)


def draw(
    street: int, height_m: float, tilt_deg: int, roll_deg: int, fov_deg: int
) -> dict[str, Any]:
    """Draw one street from a mount: 8-bit picture and depth [m]."""
    scene = make_scene((SEEDED_BY, street), MADE_AT_M)
    raised_m = np.array([0, height_m - MADE_AT_M, 0])
    world = scene.mesh.corners.astype(float) @ scene.camera_from_world + raised_m
    normals = scene.mesh.normals @ scene.camera_from_world.astype(np.float32)
    # Down in the camera is the second column of R: (-sin roll, cos roll cos tilt, ...).
    R = Rotation.from_euler("xz", [-tilt_deg, roll_deg], degrees=True).as_matrix()
    corners = (world @ R.T).astype(np.float32)
    turned = dataclasses.replace(
        scene.mesh, corners=corners, normals=normals @ R.T.astype(np.float32)
    )
    mesh = turned.part(corners[:, :, 2].max(1) > -BEHIND_M)
    seen = dataclasses.replace(scene, mesh=mesh, camera_from_world=R)
    stage = prepare(seen, WIDTH * HEIGHT)
    sight = view_from(stage, camera_of_fov(fov_deg).K, (HEIGHT, WIDTH), torch.zeros(3))
    light = draw_light(stage, sight)
    seed = [street, int(height_m * 100), 9 - tilt_deg, fov_deg]
    sensor, _ = draw_sensors(np.random.default_rng(seed), light, 0.3)
    picture = (expose(light, sensor) * 255).round().byte().numpy()
    return {"picture": picture, "depth_m": sight.raster.depth_m.half().numpy()}


def synthetic(folder: Path, first: int, streets: int) -> Iterator[View]:
    """Give the views of streets, drawn where they are not there yet."""
    folder.mkdir(parents=True, exist_ok=True)
    kinds = itertools.product(range(first, first + streets), HEIGHTS_M, TILTS_DEG, FOVS_DEG)
    for number, (street, height_m, tilt_deg, fov_deg) in enumerate(kinds):
        roll_deg = ROLLS_DEG[(number + number // 3 + number // 9) % 3]
        name = f"{street}_{height_m}_{tilt_deg}_{roll_deg}_{fov_deg}"
        path = folder / f"{name}.npz"
        if not path.exists():
            np.savez_compressed(path, **draw(street, height_m, tilt_deg, roll_deg, fov_deg))
        look = np.load(path)
        left = torch.from_numpy(look["picture"]).float() / 255
        image = StereoInput(name=name, left=left, right=None, camera=camera_of_fov(fov_deg))
        depth_m = look["depth_m"].astype(np.float32)
        mount = (height_m, float(tilt_deg))
        what = "choice, synthetic" if street >= CHOICE_STREETS else "synthetic"
        yield View(f"{what} {height_m} m", "", image, depth_m, mount)


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


def of_scan(name: str, path: Path, K: np.ndarray, points: np.ndarray) -> View:
    """Read an image, and look at the points of a scan in the frame of its camera."""
    left = read_image(path)
    height, width = left.shape[1:]
    camera = Camera(width=width, height=height, K=torch.from_numpy(K))
    image = StereoInput(name=path.stem, left=left, right=None, camera=camera)
    return View(name, name, image, seen_by(points, K, height, width), mount_of(points))


def of_disparity(name: str, drive: str, left: Path, truth: Path, rig: StereoRig) -> View:
    """Read an image with a disparity map of 16 bit, pixels x 256."""
    px = np.asarray(Image.open(truth)).astype(np.float32) / 256
    focal_m_px = float(rig.K[0, 0]) * rig.baseline_m
    depth_m = np.where(px > 0, focal_m_px / np.maximum(px, 1e-6), np.nan).astype(np.float32)
    camera = Camera(width=rig.width, height=rig.height, K=rig.K)
    image = StereoInput(name=left.stem, left=read_image(left), right=None, camera=camera)
    ground = fit_ground(torch.from_numpy(depth_m), camera)
    mount = None if ground is None else (ground.height_m, ground.tilt_deg)
    return View(name, drive, image, depth_m, mount)


def driving_stereo(folder: Path) -> Iterator[View]:
    """Read DrivingStereo's pairs."""
    rig = read_rig(folder / "camera.json")
    for left in sorted(folder.glob("*-left.jpg")):
        truth = left.with_name(left.name.replace("-left.jpg", "-disparity.png"))
        yield of_disparity("DrivingStereo", left.stem, left, truth, rig)


def kitti(folder: Path, name: str) -> Iterator[View]:
    """Read frames of KITTI 2015, in the order of their drives."""
    rig = read_rig(folder / "calib.txt", (1242, 375))
    lines = (folder / "index.txt").read_text().splitlines()
    entries = [line.split() for line in lines if line and line[0] != "#"]
    for frame, _, drive, number, *_ in sorted(entries, key=lambda entry: (entry[2], entry[3])):
        left = folder / "left" / f"{frame}.jpg"
        if int(number) >= 0 and left.exists():
            yield of_disparity(name, drive, left, folder / "disp_occ" / f"{frame}.png", rig)


def kitti_raw(folder: Path, drive: str, name: str) -> Iterator[View]:
    """Read the left images of a raw drive with scans."""
    camera = dict(
        line.split(":", 1)
        for line in (folder / "calib_cam_to_cam.txt").read_text().splitlines()
        if ":" in line
    )
    lidar = dict(
        line.split(":", 1)
        for line in (folder / "calib_velo_to_cam.txt").read_text().splitlines()
        if ":" in line
    )
    P = np.array(camera["P_rect_02"].split(), float).reshape(3, 4)
    level = np.array(camera["R_rect_00"].split(), float).reshape(3, 3)
    turn = np.array(lidar["R"].split(), float).reshape(3, 3)
    shift = np.array(lidar["T"].split(), float)
    K = P[:, :3]
    from_middle = np.linalg.solve(K, P[:, 3])
    for path in sorted((folder / drive / "image_02/data").iterdir()):
        scan = folder / drive / "velodyne_points/data" / f"{path.stem}.bin"
        points = np.fromfile(scan, np.float32).reshape(-1, 4)[:, :3]
        yield of_scan(name, path, K, (points @ turn.T + shift) @ level.T + from_middle)


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
        yield of_scan("KITTI-360", path, P[:, :3], in_camera @ R.T)


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
                side = "front" if name.endswith("01") else "aside and back"
                view = of_scan(f"DGP, {side}", path, K, (world - shift) @ turn)
                yield replace(view, drive=f"{scene.name} {name}")


def pose(entry: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Give rotation and place of a sensor in the world."""
    turn, shift = entry["rotation"], entry["translation"]
    R = Rotation.from_quat([turn["qx"], turn["qy"], turn["qz"], turn["qw"]]).as_matrix()
    return R, np.array([shift["x"], shift["y"], shift["z"]])


def errors(depth_m: np.ndarray, truth_m: np.ndarray) -> dict[str, float]:
    """Compare where truth is 1 to 80 m; the sky counts as 80 m."""
    known = (truth_m > LEAST_M) & (truth_m < MOST_M)
    ratio = np.clip(np.nan_to_num(depth_m[known], nan=MOST_M), LEAST_M, MOST_M) / truth_m[known]
    scale = float(np.median(ratio))
    return {
        "abs_rel": float(np.abs(ratio - 1).mean()),
        "median_scaled": float(np.abs(ratio / scale - 1).mean()),
        "d1": float((np.maximum(ratio, 1 / ratio) < 1.25).mean()),
        "scale": scale,
    }


def measured(view: View, net: FakestereoNet, mount: MountFilter) -> list[dict[str, Any]]:
    """Estimate a view once, and correct it by what is known of the mount."""
    camera = view.image.camera
    assert camera is not None
    (unscaled,) = net.estimate_without_mount([view.image], net.virtual_sizes(view.image))
    assert net.synthesiser is not None
    rig = net.synthesiser.config
    assert isinstance(rig, SelectionConfig)
    nothing = scale_by_mount(unscaled, view.image, None, rig)
    rows: list[dict[str, Any]] = []
    for way in WAYS if view.drive else WAYS[:-1]:
        found = nothing
        asked = view.image
        if way == "map":
            found = unscaled
        elif way == "frames":
            found = scale_by_mount(unscaled, asked, mount, rig)
        elif way != "nothing" and view.mount is not None:
            height_m, tilt_deg = view.mount
            known = {"mount_height_m": height_m}
            known |= {"tilt_deg": tilt_deg} if way == "height and tilt" else {}
            asked = replace(asked, camera=replace(camera, **known))
            try:
                found = scale_by_mount(unscaled, asked, None, rig)
            except InputError:
                found = nothing
        assert found.depth_m is not None and unscaled.depth_m is not None  # noqa: PT018
        row = {
            "camera": view.camera, "given": way, "drive": view.drive, "image": view.image.name,
            "road": nothing.ground is not None,
        } | errors(found.depth_m.numpy(), view.depth_m)  # fmt: skip
        ground = fit_ground(unscaled.depth_m, camera) if way == "map" else found.ground
        if ground is not None and view.mount is not None:
            row["tilt_off_deg"] = ground.tilt_deg - view.mount[1]
            row["height_off"] = math.log(ground.height_m / view.mount[0])
            row["tilt_deviations"] = row["tilt_off_deg"] / ground.tilt_std_deg
        rows.append(row)
    return rows


def views_of(name: str, depth: Path, folder: Path, streets: int) -> Iterator[View]:
    """Give the views of a set, of the samples' folder `depth`, or drawn into `folder`."""
    pairs = depth / "street_pairs"
    if name == "choice":
        yield from driving_stereo(depth / "driving_stereo")
        yield from kitti(pairs / "kitti2015_train_drives", "KITTI, training drives")
        yield from synthetic(folder, CHOICE_STREETS, streets)
    elif name == "synthetic":
        yield from synthetic(folder, 0, streets)
    elif name == "kitti":
        yield from kitti(pairs / "kitti2015_eval_drives", "KITTI, evaluation drives")
        drive = "2011_09_26_drive_0052_sync"
        yield from kitti_raw(depth / "kitti_raw/2011_09_26", drive, "KITTI, drive 0052")
    elif name == "kitti360":
        yield from kitti360(depth / "more/kitti360")
    else:
        yield from dgp(depth / "more/tri_dgp")


def variation(rows: list[dict[str, Any]]) -> float | None:
    """Give the standard deviation of the logarithm of the scale within drives of three or more."""
    squares: list[float] = []
    for drive in dict.fromkeys(row["drive"] for row in rows):
        logs = np.log([row["scale"] for row in rows if row["drive"] == drive])
        squares += list((logs - logs.mean()) ** 2) if drive and len(logs) > 2 else []
    return math.sqrt(float(np.mean(squares))) if squares else None


def summed(rows: list[dict[str, Any]], weights: str) -> list[dict[str, Any]]:
    """Give the means of each camera and of what was given."""
    table: list[dict[str, Any]] = []
    for camera, given in dict.fromkeys((row["camera"], row["given"]) for row in rows):
        mine = [row for row in rows if (row["camera"], row["given"]) == (camera, given)]
        row = {"weights": weights, "camera": camera, "given": given, "views": len(mine)}
        row["roads"] = sum(one["road"] for one in mine)
        for name in ("abs_rel", "median_scaled", "d1", "scale"):
            row[name] = float(np.mean([one[name] for one in mine]))
        row["variation"] = variation(mine)
        for name in ("tilt_off_deg", "height_off", "tilt_deviations"):
            offs = [one[name] for one in mine if name in one]
            row[name] = math.sqrt(float(np.mean(np.square(offs)))) if offs else None
        table.append(row)
    return table


def main() -> None:
    """Estimate, and print the means of each camera."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--samples", type=Path, required=True)
    parser.add_argument("--weights", nargs="+", default=["default"])
    parser.add_argument("--speed", default="quick")
    parser.add_argument("--streets", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("out/bench/mounts"))
    parser.add_argument("--sets", nargs="+", default=SETS, choices=SETS)
    options = parser.parse_args()
    rows: list[dict[str, Any]] = []
    for weights in options.weights:
        net = FakestereoNet.load(
            weights, config=MatcherConfig(speed=options.speed), allow_ood=True, use="images"
        )
        mine: list[dict[str, Any]] = []
        for name in options.sets:
            drive = None
            mount = MountFilter()
            samples = options.samples / "depth"
            for view in views_of(name, samples, options.out, options.streets):
                if view.drive != drive or not drive:
                    mount = MountFilter()
                drive = view.drive
                mine += measured(view, net, mount)
        rows += [{"weights": weights} | row for row in mine]
        print(markdown_table(summed(mine, weights)))
    write_table(options.out, rows, name="mounts")


if __name__ == "__main__":
    main()
