"""Depth from one image by cameras that are mounted at other heights and tilts.

    python bench/mounts.py --samples SAMPLES [--weights default] [--speed quick] [--sets kitti dgp]

Synthetic streets, each seen by 27 cameras (heights, tilts, fields of view, rolls; 640x360, drawn
once into --out), and real ones. Parameters may be chosen by the set `choice` (DrivingStereo's two
pairs and KITTI's training drives); the others are evaluation alone. True height and tilt are those
of a plane fitted to the true ground.

Each view is measured in these ways (column `given`):

- map: the depth of the network, uncorrected
- nothing: corrected without knowledge of the mount
- height, height and tilt: corrected by the true mount; where that is refused, by nothing
- frames: corrected by what earlier frames of the drive say of their common mount

Measured where the truth is 1 to 80 m: AbsRel, AbsRel after median scaling, the share d1, scale
(median of estimate / truth), and its variation, the standard deviation of the scale's logarithm
among the frames of a drive.
"""

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
from shared import group_rows, make_parser, mean_of

from depthpose.core.camera import Camera, StereoRig, read_rig
from depthpose.core.errors import InputError
from depthpose.core.files import read_image
from depthpose.depth.config import MatcherConfig
from depthpose.depth.estimator import FakestereoNet
from depthpose.depth.estimator.single_image import depth_from_images
from depthpose.depth.ground import fit_ground
from depthpose.depth.mount import MountFilter, scale_by_mount
from depthpose.depth.synthetic.sensor import draw_sensors, expose
from depthpose.depth.synthetic.shading import prepare_stage
from depthpose.depth.synthetic.street import make_street
from depthpose.depth.synthetic.visibility import render_light, view_from
from depthpose.depth.types import DepthEstimate, DepthInput
from depthpose.report.page import format_markdown_table, write_table

WIDTH, HEIGHT = 640, 360
HEIGHTS_M = (1.2, 1.65, 2.5)
TILTS_DEG = (-5, 0, 5)
FOVS_DEG = (50, 80, 110)
ROLLS_DEG = (0, 2, -2)
SCENE_HEIGHT_M = 1.65  # of the camera for which a scene is made
MAX_BEHIND_M = 12.0  # what lies farther behind the camera is left out
STREET_SEED = 777
FIRST_CHOICE_STREET = 11
"""This street and later ones take part in choices; those before are for evaluation."""
SETS = ("choice", "synthetic", "kitti", "kitti360", "dgp")
WAYS = ("map", "nothing", "height", "height and tilt", "frames")
MIN_DEPTH_M, MAX_DEPTH_M = 1.0, 80.0

# Points of a scan that may be ground, in the camera's frame.
GROUND_Z_M = (3.0, 25.0)
MAX_GROUND_X_M = 6.0
MIN_GROUND_Y_M = 0.8
# The plane through them.
MIN_GROUND_POINTS = 100
RANSAC_ITERATIONS = 300
MAX_RESIDUAL_M = 0.05
MAX_ROLL_SLOPE, MAX_TILT_SLOPE = 0.1, 0.15
MIN_DRIVE_FRAMES = 3  # of which a variation is computed

Row = dict[str, Any]


@dataclass(frozen=True)
class View:
    """An image, the true depth of some pixels, and the mount of its camera.

    Attributes:
        camera: name in the table.
        drive: name; empty if the view belongs to none.
        image: without a right view.
        depth_m: true depth [m]; NaN where it is unknown.
        mount: true height [m] and tilt [degrees] of the camera, where they are known.
    """

    camera: str
    drive: str
    image: DepthInput
    depth_m: np.ndarray
    mount: tuple[float, float] | None


def camera_of_fov(fov_deg: float) -> Camera:
    """Make a camera of a horizontal field of view, with its axis through the middle."""
    f = WIDTH / 2 / math.tan(math.radians(fov_deg / 2))
    K = torch.tensor([[f, 0, (WIDTH - 1) / 2], [0, f, (HEIGHT - 1) / 2], [0, 0, 1]]).double()
    return Camera(width=WIDTH, height=HEIGHT, K=K)


def draw_street(
    street: int, height_m: float, tilt_deg: int, roll_deg: int, fov_deg: int
) -> dict[str, Any]:
    """Draw one street from a mount: 8-bit picture and depth [m]."""
    scene = make_street((STREET_SEED, street), SCENE_HEIGHT_M)
    raised_m = np.array([0, height_m - SCENE_HEIGHT_M, 0])
    corners_in_world_m = scene.mesh.corners.astype(float) @ scene.camera_from_world + raised_m
    normals_in_world = scene.mesh.normals @ scene.camera_from_world.astype(np.float32)
    # Down in the camera is the second column of R: (-sin roll, cos roll cos tilt, ...).
    R = Rotation.from_euler("xz", [-tilt_deg, roll_deg], degrees=True).as_matrix()
    corners_m = (corners_in_world_m @ R.T).astype(np.float32)
    normals = normals_in_world @ R.T.astype(np.float32)
    mesh = dataclasses.replace(scene.mesh, corners=corners_m, normals=normals)
    is_near = corners_m[:, :, 2].max(1) > -MAX_BEHIND_M
    scene = dataclasses.replace(scene, mesh=mesh.select(is_near), camera_from_world=R)
    stage = prepare_stage(scene, WIDTH * HEIGHT)
    sight = view_from(stage, camera_of_fov(fov_deg).K, (HEIGHT, WIDTH), torch.zeros(3))
    light = render_light(stage, sight)
    rng = np.random.default_rng([street, int(height_m * 100), 9 - tilt_deg, fov_deg])
    sensor, _ = draw_sensors(rng, light, 0.3)
    picture = (expose(light, sensor) * 255).round().byte().numpy()
    return {"picture": picture, "depth_m": sight.raster.depth_m.half().numpy()}


def synthetic_views(folder: Path, first_street: int, count: int) -> Iterator[View]:
    """Yield the views of some streets; those that are not in the folder are drawn."""
    folder.mkdir(parents=True, exist_ok=True)
    streets = range(first_street, first_street + count)
    mounts = itertools.product(streets, HEIGHTS_M, TILTS_DEG, FOVS_DEG)
    for index, (street, height_m, tilt_deg, fov_deg) in enumerate(mounts):
        roll_deg = ROLLS_DEG[(index + index // 3 + index // 9) % 3]
        name = f"{street}_{height_m}_{tilt_deg}_{roll_deg}_{fov_deg}"
        path = folder / f"{name}.npz"
        if not path.exists():
            arrays = draw_street(street, height_m, tilt_deg, roll_deg, fov_deg)
            np.savez_compressed(path, **arrays)
        arrays = np.load(path)
        left = torch.from_numpy(arrays["picture"]).float() / 255
        image = DepthInput(name=name, left=left, right=None, camera=camera_of_fov(fov_deg))
        use = "choice, synthetic" if street >= FIRST_CHOICE_STREET else "synthetic"
        yield View(
            camera=f"{use} {height_m} m",
            drive="",
            image=image,
            depth_m=arrays["depth_m"].astype(np.float32),
            mount=(height_m, float(tilt_deg)),
        )


def mount_of_scan(points_m: np.ndarray) -> tuple[float, float] | None:
    """Fit the ground to the points of a scan, (n, 3), by RANSAC: height [m] and tilt [degrees]."""
    x, y, z = points_m.T
    is_ahead = (z > GROUND_Z_M[0]) & (z < GROUND_Z_M[1])
    is_low = (np.abs(x) < MAX_GROUND_X_M) & (y > MIN_GROUND_Y_M)
    ground_m = points_m[is_ahead & is_low]
    if len(ground_m) < MIN_GROUND_POINTS:
        return None
    # The plane is y = a x + b z + c.
    xz1 = np.c_[ground_m[:, [0, 2]], np.ones(len(ground_m))]
    y = ground_m[:, 1]
    rng = np.random.default_rng(0)
    best = np.zeros(len(ground_m), bool)
    for _ in range(RANSAC_ITERATIONS):
        sample = rng.choice(len(ground_m), 3, replace=False)
        try:
            plane = np.linalg.solve(xz1[sample], y[sample])
        except np.linalg.LinAlgError:
            continue
        is_level = abs(plane[0]) < MAX_ROLL_SLOPE and abs(plane[1]) < MAX_TILT_SLOPE
        is_inlier = np.abs(xz1 @ plane - y) < MAX_RESIDUAL_M
        if is_level and is_inlier.sum() > best.sum():
            best = is_inlier
    if best.sum() < MIN_GROUND_POINTS:
        return None
    a, b, c = np.linalg.lstsq(xz1[best], y[best], rcond=None)[0]
    height_m = float(c / math.sqrt(1 + a * a + b * b))
    return height_m, math.degrees(math.atan(b))


def project_depth(points_m: np.ndarray, K: np.ndarray, height: int, width: int) -> np.ndarray:
    """Project points in the camera's frame to a depth map; near ones hide far ones, else NaN."""
    ahead_m = points_m[points_m[:, 2] > MIN_DEPTH_M]
    far_to_near_m = ahead_m[np.argsort(-ahead_m[:, 2])]
    pixels = far_to_near_m @ K.T
    u = np.round(pixels[:, 0] / pixels[:, 2]).astype(int)
    v = np.round(pixels[:, 1] / pixels[:, 2]).astype(int)
    is_inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    depth_m = np.full((height, width), np.nan, np.float32)
    depth_m[v[is_inside], u[is_inside]] = far_to_near_m[is_inside, 2]
    return depth_m


def view_with_scan(name: str, path: Path, K: np.ndarray, points_m: np.ndarray) -> View:
    """Read an image; its truth are the points of a scan in the frame of its camera."""
    left = read_image(path)
    height, width = left.shape[1:]
    camera = Camera(width=width, height=height, K=torch.from_numpy(K))
    return View(
        camera=name,
        drive=name,
        image=DepthInput(name=path.stem, left=left, right=None, camera=camera),
        depth_m=project_depth(points_m, K, height, width),
        mount=mount_of_scan(points_m),
    )


def view_with_disparity(name: str, drive: str, left: Path, truth: Path, rig: StereoRig) -> View:
    """Read an image; its truth is a disparity map of 16 bit, pixels x 256."""
    disparity_px = np.asarray(Image.open(truth)).astype(np.float32) / 256
    depth_at_1_px_m = float(rig.K[0, 0]) * rig.baseline_m
    depth_m = depth_at_1_px_m / np.maximum(disparity_px, 1e-6)
    depth_m = np.where(disparity_px > 0, depth_m, np.nan).astype(np.float32)
    camera = Camera(width=rig.width, height=rig.height, K=rig.K)
    ground = fit_ground(torch.from_numpy(depth_m), camera)
    return View(
        camera=name,
        drive=drive,
        image=DepthInput(name=left.stem, left=read_image(left), right=None, camera=camera),
        depth_m=depth_m,
        mount=None if ground is None else (ground.height_m, ground.tilt_deg),
    )


def driving_stereo_views(folder: Path) -> Iterator[View]:
    """Read DrivingStereo's pairs."""
    rig = read_rig(folder / "camera.json")
    for left in sorted(folder.glob("*-left.jpg")):
        truth = left.with_name(left.name.replace("-left.jpg", "-disparity.png"))
        yield view_with_disparity("DrivingStereo", left.stem, left, truth, rig)


def kitti_views(folder: Path, name: str) -> Iterator[View]:
    """Read frames of KITTI 2015, in the order of their drives."""
    rig = read_rig(folder / "calib.txt", (1242, 375))
    lines = (folder / "index.txt").read_text().splitlines()
    entries = [line.split() for line in lines if line and line[0] != "#"]
    for frame, _, drive, number, *_ in sorted(entries, key=lambda entry: (entry[2], entry[3])):
        left = folder / "left" / f"{frame}.jpg"
        truth = folder / "disp_occ" / f"{frame}.png"
        if int(number) >= 0 and left.exists():
            yield view_with_disparity(name, drive, left, truth, rig)


def read_calibration(path: Path) -> dict[str, str]:
    """Read a calibration of KITTI: the values of each ``key: values``, as text."""
    lines = path.read_text().splitlines()
    return dict(line.split(":", 1) for line in lines if ":" in line)


def matrix(text: str, columns: int) -> np.ndarray:
    """Read a matrix of three rows."""
    return np.array(text.split(), float).reshape(3, columns)


def read_scan(path: Path) -> np.ndarray:
    """Read the points of a Velodyne scan, (n, 3) [m]."""
    return np.fromfile(path, np.float32).reshape(-1, 4)[:, :3]


def kitti_raw_views(folder: Path, drive: str, name: str) -> Iterator[View]:
    """Read the left images of a raw drive with scans."""
    cameras = read_calibration(folder / "calib_cam_to_cam.txt")
    lidar = read_calibration(folder / "calib_velo_to_cam.txt")
    P = matrix(cameras["P_rect_02"], 4)
    K = P[:, :3]
    R_rectified = matrix(cameras["R_rect_00"], 3)
    R_lidar = matrix(lidar["R"], 3)
    t_lidar_m = np.array(lidar["T"].split(), float)
    t_left_m = np.linalg.solve(K, P[:, 3])
    for path in sorted((folder / drive / "image_02/data").iterdir()):
        points_m = read_scan(folder / drive / "velodyne_points/data" / f"{path.stem}.bin")
        points_m = points_m @ R_lidar.T + t_lidar_m
        points_m = points_m @ R_rectified.T + t_left_m
        yield view_with_scan(name, path, K, points_m)


def kitti360_views(folder: Path) -> Iterator[View]:
    """Read the frames of KITTI-360's left camera."""
    calibration = read_calibration(folder / "calib/perspective.txt")
    K = matrix(calibration["P_rect_00"], 4)[:, :3]
    R_rectified = matrix(calibration["R_rect_00"], 3)
    lidar_from_camera = matrix((folder / "calib/calib_cam_to_velo.txt").read_text(), 4)
    R_lidar, t_lidar_m = lidar_from_camera[:, :3], lidar_from_camera[:, 3]
    for path in sorted((folder / "left").glob("*.png")):
        points_m = read_scan(folder / "lidar" / f"{path.stem}.bin")
        points_m = (points_m - t_lidar_m) @ R_lidar
        points_m = points_m @ R_rectified.T
        yield view_with_scan("KITTI-360", path, K, points_m)


def dgp_views(folder: Path) -> Iterator[View]:
    """Read the scenes of a folder in DGP's layout: every image with the scan of its sample."""
    for scene in sorted(folder.glob("scene_*")):
        (scene_file,) = scene.glob("scene_*.json")
        (calibration_file,) = scene.glob("calibration/*.json")
        index = json.loads(scene_file.read_text())
        calibration = json.loads(calibration_file.read_text())
        intrinsics = dict(zip(calibration["names"], calibration["intrinsics"], strict=True))
        entries = {entry["key"]: entry for entry in index["data"]}
        for sample in index["samples"]:
            sensors = {
                entries[key]["id"]["name"]: entries[key]["datum"] for key in sample["datum_keys"]
            }
            lidar = sensors.pop("LIDAR")["point_cloud"]
            points_m = np.load(scene / lidar["filename"])["data"][:, :3]
            R, t_m = world_from_sensor(lidar["pose"])
            points_in_world_m = points_m @ R.T + t_m
            for name, datum in sensors.items():
                picture = datum["image"]
                fx, fy, cx, cy = (intrinsics[name][key] for key in ("fx", "fy", "cx", "cy"))
                K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
                R, t_m = world_from_sensor(picture["pose"])
                side = "front" if name.endswith("01") else "aside and back"
                view = view_with_scan(
                    f"DGP, {side}", scene / picture["filename"], K, (points_in_world_m - t_m) @ R
                )
                yield replace(view, drive=f"{scene.name} {name}")


def world_from_sensor(pose: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Read the rotation and the position [m] of a sensor in the world."""
    rotation, translation = pose["rotation"], pose["translation"]
    quaternion = [rotation[key] for key in ("qx", "qy", "qz", "qw")]
    t_m = np.array([translation[key] for key in ("x", "y", "z")])
    return Rotation.from_quat(quaternion).as_matrix(), t_m


def depth_errors(depth_m: np.ndarray, truth_m: np.ndarray) -> dict[str, float]:
    """Compare depth where the truth is 1 to 80 m; no depth, as in the sky, counts as 80 m."""
    is_measured = (truth_m > MIN_DEPTH_M) & (truth_m < MAX_DEPTH_M)
    estimate_m = np.nan_to_num(depth_m[is_measured], nan=MAX_DEPTH_M)
    ratio = np.clip(estimate_m, MIN_DEPTH_M, MAX_DEPTH_M) / truth_m[is_measured]
    scale = float(np.median(ratio))
    return {
        "abs_rel": float(np.abs(ratio - 1).mean()),
        "median_scaled": float(np.abs(ratio / scale - 1).mean()),
        "d1": float((np.maximum(ratio, 1 / ratio) < 1.25).mean()),
        "scale": scale,
    }


def measure_view(view: View, net: FakestereoNet, mount_filter: MountFilter) -> list[Row]:
    """Estimate a view once, correct it in each way, and measure each."""
    camera = view.image.camera
    assert camera is not None
    assert net.synthesiser is not None
    (unscaled,) = depth_from_images(net.synthesiser, net.matcher, [view.image], allow_ood=True)
    config = net.synthesiser.config
    without_mount = scale_by_mount(unscaled, None, config)

    def corrected(way: str) -> DepthEstimate:
        if way == "map":
            return unscaled
        if way == "frames":
            return scale_by_mount(unscaled, mount_filter, config)
        if way == "nothing" or view.mount is None:
            return without_mount
        height_m, tilt_deg = view.mount
        mounted = replace(camera, mount_height_m=height_m)
        if way == "height and tilt":
            mounted = replace(mounted, tilt_deg=tilt_deg)
        try:
            by_mount = replace(unscaled, input=replace(view.image, camera=mounted))
            return scale_by_mount(by_mount, None, config)
        except InputError:
            return without_mount

    rows: list[Row] = []
    ways = WAYS if view.drive else [way for way in WAYS if way != "frames"]
    for way in ways:
        estimate = corrected(way)
        assert estimate.depth_m is not None
        assert unscaled.depth_m is not None
        row = {
            "camera": view.camera,
            "given": way,
            "drive": view.drive,
            "image": view.image.name,
            "road": without_mount.ground is not None,
            **depth_errors(estimate.depth_m.numpy(), view.depth_m),
        }
        ground = fit_ground(unscaled.depth_m, camera) if way == "map" else estimate.ground
        if ground is not None and view.mount is not None:
            height_m, tilt_deg = view.mount
            row["tilt_off_deg"] = ground.tilt_deg - tilt_deg
            row["height_off"] = math.log(ground.height_m / height_m)
            row["tilt_deviations"] = row["tilt_off_deg"] / ground.tilt_std_deg
        rows.append(row)
    return rows


def views_of(name: str, depth: Path, folder: Path, streets: int) -> Iterator[View]:
    """Yield the views of a set, from the samples' folder ``depth`` or drawn into ``folder``."""
    pairs = depth / "street_pairs"
    if name == "choice":
        yield from driving_stereo_views(depth / "driving_stereo")
        yield from kitti_views(pairs / "kitti2015_train_drives", "KITTI, training drives")
        yield from synthetic_views(folder, FIRST_CHOICE_STREET, streets)
    elif name == "synthetic":
        yield from synthetic_views(folder, 0, streets)
    elif name == "kitti":
        yield from kitti_views(pairs / "kitti2015_eval_drives", "KITTI, evaluation drives")
        drive = "2011_09_26_drive_0052_sync"
        yield from kitti_raw_views(depth / "kitti_raw/2011_09_26", drive, "KITTI, drive 0052")
    elif name == "kitti360":
        yield from kitti360_views(depth / "more/kitti360")
    else:
        yield from dgp_views(depth / "more/tri_dgp")


def scale_variation(rows: list[Row]) -> float | None:
    """Compute the deviation of the scale's logarithm within drives of three frames or more."""
    squares: list[float] = []
    for (drive,), drive_rows in group_rows(rows, "drive").items():
        if not drive or len(drive_rows) < MIN_DRIVE_FRAMES:
            continue
        logs = np.log([row["scale"] for row in drive_rows])
        squares += list((logs - logs.mean()) ** 2)
    return math.sqrt(float(np.mean(squares))) if squares else None


def root_mean_square(values: list[float]) -> float | None:
    """Compute the root mean square; None of no values."""
    return math.sqrt(float(np.mean(np.square(values)))) if values else None


def summary(rows: list[Row], weights: str) -> list[Row]:
    """Average over the views of each camera and way."""
    table: list[Row] = []
    for (camera, way), views in group_rows(rows, "camera", "given").items():
        line = {"weights": weights, "camera": camera, "given": way, "views": len(views)}
        line["roads"] = sum(row["road"] for row in views)
        for name in ("abs_rel", "median_scaled", "d1", "scale"):
            line[name] = mean_of(views, name)
        line["variation"] = scale_variation(views)
        for name in ("tilt_off_deg", "height_off", "tilt_deviations"):
            line[name] = root_mean_square([row[name] for row in views if name in row])
        table.append(line)
    return table


def main() -> None:
    """Measure every view of the sets by each set of weights; print the means of each camera."""
    parser = make_parser(__doc__)
    parser.add_argument("--samples", type=Path, required=True)
    parser.add_argument("--weights", nargs="+", default=["default"])
    parser.add_argument("--speed", default="quick")
    parser.add_argument("--streets", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("out/bench/mounts"))
    parser.add_argument("--sets", nargs="+", default=SETS, choices=SETS)
    options = parser.parse_args()
    all_rows: list[Row] = []
    for weights in options.weights:
        config = MatcherConfig(speed=options.speed)
        net = FakestereoNet.load(weights, config=config, allow_ood=True, use="images")
        rows: list[Row] = []
        for name in options.sets:
            drive = None
            mount_filter = MountFilter()
            for view in views_of(name, options.samples / "depth", options.out, options.streets):
                if view.drive != drive or not view.drive:
                    mount_filter = MountFilter()
                drive = view.drive
                rows += measure_view(view, net, mount_filter)
        all_rows += [{"weights": weights} | row for row in rows]
        print(format_markdown_table(summary(rows, weights)))
    write_table(options.out, all_rows, name="mounts")


if __name__ == "__main__":
    main()
