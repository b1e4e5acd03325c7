"""``depthpose data make ...``."""

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from depthpose.core.errors import InputError

_FRAMES_A_SCENE = 50
_SCENES_A_SEED = 1000

if TYPE_CHECKING:
    from depthpose.depth.config import StreetsConfig


def make_streets(
    out: Path,
    number: int = 100,
    first: int = 0,
    seed: int = 0,
    scale: float = 1.0,
    with_antialiasing: bool = True,
    with_lidar: bool = True,
    clutter_share: float = 0.0,
) -> int:
    """Render synthetic street scenes with exact disparity, in KITTI's raw layout.

    Existing frames are skipped, so an interrupted run can be resumed, and several
    runs with different --first share the work. Each rig of KITTI's five recording days gets a
    date of its own, 2100_01_01 to 2100_01_05, which no real drive has.

    Args:
        out: folder to write to.
        number: how many frames.
        first: number of the first one.
        seed: of the random streets, and number of the drives.
        scale: size of the images: 0.5 gives half as many rows and columns.
        with_antialiasing: smooth edges.
        with_lidar: scan each scene with a LiDAR of 64 beams.
        clutter_share: share of scenes that show random shapes before a ground, a wall or in a box
            instead of a street; for training matchers.
    """
    from tqdm import tqdm

    from depthpose.core.run import claim_folder
    from depthpose.depth.config import StreetsConfig
    from depthpose.depth.datasets import has_raw_frame
    from depthpose.depth.synthetic import rig_number

    if number < 1 or first < 0 or not 0 <= seed <= 9999:
        raise InputError(
            f"--number {number} --first {first} --seed {seed}: at least 1 frame, from 0 on, and a "
            "seed of four digits at most"
        )
    config = StreetsConfig(
        seed=seed,
        scale=scale,
        clutter_share=clutter_share,
        with_antialiasing=with_antialiasing,
        with_lidar=with_lidar,
    )
    # Seeds have drives of their own, so they may share a folder.
    days = [_day(day) for day in range(1, 6)]
    claim_folder(out, {k: v for k, v in asdict(config).items() if k != "seed"}, days)
    indices = range(first, first + number)
    drives = {index: _drive(config, 1 + rig_number(config, index)) for index in indices}
    wanted = [index for index in indices if not has_raw_frame(out, drives[index], index)]
    for index in tqdm(wanted, unit=" frames", leave=False, disable=None):
        _make_street(out, drives[index], config, index)
    print(f"{out}: {len(wanted)} frames made, {number - len(wanted)} were there")
    return 0


def make_objects(
    cad: tuple[Path, ...],
    out: Path,
    unit: Literal["m", "mm"] = "mm",
    number: int = 100,
    split: str = "train",
    seed: int = 0,
    distance: tuple[float, float] = (0.6, 1.1),
    sensor: Literal["structured light", "time of flight", "laser", "none"] = "structured light",
    symmetries: Literal["none", "found"] = "none",
) -> int:
    """Render frames of objects on a table, with image, depth, masks and poses, in BOP's layout.

    A scene has 50 frames; existing scenes are skipped, so an interrupted run can be resumed.
    'depthpose data check OUT' checks the result.

        depthpose data make objects --cad part.stl clamp.stl --unit mm --out made --number 500

    Args:
        cad: model files with a surface or points; the first is object 1.
        out: folder to write to.
        unit: of the numbers in the files.
        number: how many frames.
        split: name of the part of the data set.
        seed: of the random frames.
        distance: nearest and farthest view [m].
        sensor: whose errors the depth has.
        symmetries: found: declare the symmetries that are found from a part's shape; none: only
            print them.
    """
    from tqdm import tqdm

    from depthpose.core.config import config_to_dict
    from depthpose.core.run import claim_folder
    from depthpose.pose.config import ObjectsConfig, SensorConfig
    from depthpose.pose.datasets import write_bop_models, write_bop_scene
    from depthpose.pose.mesh import read_model, with_found_symmetries
    from depthpose.pose.synthetic import make_frames

    if number < 1:
        raise InputError(f"--number {number}: at least 1 frame")
    models = [
        with_found_symmetries(
            read_model(path, unit, number=i), tqdm.write, is_taken=symmetries == "found"
        )
        for i, path in enumerate(cad, start=1)
    ]
    config = ObjectsConfig(
        seed=seed, distance_m=distance, sensor=SensorConfig(kinds=(sensor,)), number=number
    )
    said = {k: v for k, v in config_to_dict(config).items() if k not in ("number", "seed")}
    files = {f"object {i}": _fingerprint(path) for i, path in enumerate(cad, start=1)}
    settings = {**said, "cad": files, "unit": unit, "symmetries": symmetries}
    claim_folder(out, settings, ["models", split])
    write_bop_models(out, models)
    scenes = [
        range(first, min(first + _FRAMES_A_SCENE, number))
        for first in range(0, number, _FRAMES_A_SCENE)
    ]
    # Of another seed, other scenes: they may share a folder.
    number_of = {scene: seed * _SCENES_A_SEED + scene.start // _FRAMES_A_SCENE for scene in scenes}
    wanted = [scene for scene in scenes if not _is_made(out / split, number_of[scene], scene)]
    with tqdm(total=sum(map(len, wanted)), unit=" frames", leave=False, disable=None) as bar:
        for scene in wanted:
            frames = []
            for frame in make_frames(models, config, len(scene), scene.start):
                frames.append(frame)
                bar.update()
            write_bop_scene(out, split, number_of[scene], frames)
    print(f"{out}: {len(wanted)} scenes made, {len(scenes) - len(wanted)} were there")
    return 0


def _fingerprint(path: Path) -> dict[str, str]:
    from depthpose.core.checkpoint import file_sha256

    return {"file": path.name, "sha256": file_sha256(path)}


def _is_made(split: Path, scene: int, frames: range) -> bool:
    """Whether a scene exists with all of its frames, by the file that is written last."""
    from depthpose.core.files import read_json

    path = split / f"{scene:06d}" / "scene_camera.json"
    if not path.is_file():
        return False
    there = read_json(path)
    return isinstance(there, dict) and {str(n) for n in frames} <= set(there)


def _drive(config: "StreetsConfig", day: int) -> str:
    return f"{_day(day)}_drive_{config.seed:04d}_sync"


def _day(day: int) -> str:
    return f"2100_01_{day:02d}"


def _make_street(out: Path, drive: str, config: "StreetsConfig", index: int) -> None:
    from depthpose.depth.datasets import RawFrame, write_raw_frame
    from depthpose.depth.synthetic import camera_from_velodyne, draw_street

    frame = draw_street(config, index)
    raw = RawFrame(
        left=frame.left,
        right=frame.right,
        rig=frame.rig,
        disparity_px=frame.disparity_px,
        occluded=frame.occluded,
        is_sky=frame.is_sky,
        points=frame.lidar_points,
        camera_from_velodyne=camera_from_velodyne(),
    )
    write_raw_frame(out, drive, index, raw)
