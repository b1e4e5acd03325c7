"""``depthpose data make ...``."""

import re
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from depthpose.cli.arguments import NewPath, group
from depthpose.core.errors import InputError
from depthpose.core.units import Unit

if TYPE_CHECKING:
    from depthpose.depth.config import StreetsConfig
    from depthpose.pose.config import ObjectsConfig


_FRAMES_A_SCENE = 50
_SCENES_A_SEED = 1000
_MOST_SEED = 10**6 - 1
"""Of frames of objects: a scene has nine digits at most, three of them beside the seed's."""


@group
class StreetsOptions:
    """Which streets are rendered, and how."""

    number: int = 100
    """how many frames."""
    first: int = 0
    """number of the first one."""
    seed: int = 0
    """of the random streets, and number of the drives."""
    scale: float = 1.0
    """size of the images: 0.5 gives half as many rows and columns."""
    with_antialiasing: bool = True
    """smooth edges."""
    with_lidar: bool = True
    """scan each scene with a LiDAR of 64 beams."""
    clutter_share: float = 0.0
    """share of scenes that show random shapes before a ground, a wall or in a box instead of a
    street; for training matchers."""

    @property
    def config(self) -> "StreetsConfig":
        """Settings of the streets."""
        from depthpose.depth.config import StreetsConfig

        if self.number < 1 or self.first < 0 or not 0 <= self.seed <= 9999:
            raise InputError(
                f"--number {self.number} --first {self.first} --seed {self.seed}: at least 1 "
                "frame, from 0 on, and a seed of four digits at most"
            )
        own = {k: v for k, v in vars(self).items() if k not in ("number", "first")}
        return StreetsConfig(**own)


@group
class ObjectsOptions:
    """Which frames are rendered, and how."""

    unit: Unit = "mm"
    """of the numbers in the files."""
    number: int = 100
    """how many frames."""
    split: str = "train"
    """name of the part of the data set."""
    seed: int = 0
    """of the random frames."""
    distance: tuple[float, float] = (0.6, 1.1)
    """nearest and farthest view [m]."""
    sensor: Literal["structured light", "active stereo", "time of flight", "laser", "none"] = (
        "structured light"
    )
    """kind of depth sensor whose errors are simulated."""
    pile: int = 0
    """each frame shows so many copies of one part, dropped onto each other."""
    symmetries: Literal["none", "found"] = "none"
    """found: declare the symmetries that are found from a part's shape; none: only print them."""

    @property
    def config(self) -> "ObjectsConfig":
        """Settings of the frames."""
        from depthpose.pose.config import ObjectsConfig, SensorConfig

        if self.number < 1:
            raise InputError(f"--number {self.number}: at least 1 frame")
        if not 0 <= self.seed <= _MOST_SEED or self.number > _SCENES_A_SEED * _FRAMES_A_SCENE:
            raise InputError(
                f"--seed {self.seed} --number {self.number}: scenes are numbered by the seed; take "
                f"a seed of 0 to {_MOST_SEED}, and at most {_SCENES_A_SEED * _FRAMES_A_SCENE} "
                "frames of each"
            )
        if not re.fullmatch(r"[\w-]+", self.split) or self.split == "models":
            raise InputError(f"--split {self.split}: a name of letters and digits, not 'models'")
        sensor = SensorConfig(kinds=(self.sensor,))
        return ObjectsConfig(
            seed=self.seed,
            distance_m=self.distance,
            sensor=sensor,
            number=self.number,
            frame_pile=self.pile,
        )


def make_streets(out: NewPath, streets: StreetsOptions = StreetsOptions()) -> int:
    """Render synthetic street scenes with exact disparity, in KITTI's raw layout.

    Existing frames are skipped, so an interrupted run can be resumed, and a later run with another
    --first adds to it; runs at the same time need a folder each. Each rig of KITTI's five recording
    days gets a date of its own, 2100_01_01 to 2100_01_05, which no real drive has.

    Args:
        out: folder to write to.
    """
    from tqdm import tqdm

    from depthpose.core.run import claim_folder
    from depthpose.depth.datasets import RawFrame, has_calibration, has_raw_frame, write_raw_frame
    from depthpose.depth.synthetic import camera_from_velodyne, draw_street, rig_number

    config = streets.config
    # Seeds have drives of their own, so they may share a folder.
    days = [f"2100_01_{day:02d}" for day in range(1, 6)]
    claim_folder(out, {k: v for k, v in asdict(config).items() if k != "seed"}, days)
    indices = range(streets.first, streets.first + streets.number)
    drives = {k: f"{days[rig_number(config, k)]}_drive_{config.seed:04d}_sync" for k in indices}
    dates = {drive[:10]: index for index, drive in drives.items()}
    lost = {index for date, index in dates.items() if not has_calibration(out, date)}
    wanted = [i for i in indices if i in lost or not has_raw_frame(out, drives[i], i)]
    for index in tqdm(wanted, unit=" frames", leave=False, disable=None):
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
        write_raw_frame(out, drives[index], index, raw)
    print(f"{out}: {len(wanted)} frames made, {streets.number - len(wanted)} were there")
    return 0


def make_objects(
    cad: tuple[Path, ...],
    out: NewPath,
    frames: ObjectsOptions = ObjectsOptions(),
) -> int:
    """Render frames of objects on a table, with image, depth, masks and poses, in BOP's layout.

    A scene has 50 frames; existing scenes are skipped, so an interrupted run can be resumed.
    'depthpose data check OUT' checks the result.

        depthpose data make objects --cad part.stl clamp.stl --unit mm --out synthetic --number 500

    Args:
        cad: model files with a surface or points; the first is object 1.
        out: folder to write to.
    """
    from tqdm import tqdm

    from depthpose.core.checkpoint import file_sha256
    from depthpose.core.config import config_to_dict
    from depthpose.core.run import claim_folder, note_result
    from depthpose.pose.datasets import write_bop_models, write_bop_scene
    from depthpose.pose.mesh import read_model, refuse_one_name, with_found_symmetries
    from depthpose.pose.synthetic import make_frames

    # What decides the frames; of another seed, other scenes: they may share the folder.
    config, split = frames.config, frames.split
    settings = {k: v for k, v in config_to_dict(config).items() if k not in ("number", "seed")}
    settings["cad"] = {
        f"object {number}": {"file": path.name, "sha256": file_sha256(path)}
        for number, path in enumerate(cad, start=1)
    }
    settings |= {"unit": frames.unit, "symmetries": frames.symmetries}
    models = [read_model(path, frames.unit, number=i) for i, path in enumerate(cad, start=1)]
    refuse_one_name(models)
    is_taken = frames.symmetries == "found"
    models = [with_found_symmetries(model, tqdm.write, is_taken=is_taken) for model in models]
    claim_folder(out, settings, ["models", split])
    write_bop_models(out, models)
    scenes = {
        frames.seed * _SCENES_A_SEED + k: range(first, min(first + _FRAMES_A_SCENE, frames.number))
        for k, first in enumerate(range(0, frames.number, _FRAMES_A_SCENE))
    }
    wanted = {k: scene for k, scene in scenes.items() if not _is_made(out, split, k, scene)}
    total = sum(map(len, wanted.values()))
    with tqdm(total=total, unit=" frames", leave=False, disable=None) as bar:
        for number, scene in wanted.items():
            made = []
            for frame in make_frames(models, config, len(scene), scene.start):
                made.append(frame)
                bar.update()
            home = write_bop_scene(out, split, number, made)
            files = sorted(path for path in home.rglob("*") if path.is_file())
            note_result(out, home.relative_to(out).as_posix(), files)
    print(f"{out}: {len(wanted)} scenes made, {len(scenes) - len(wanted)} were there")
    return 0


def _is_made(out: Path, split: str, scene: int, frames: range) -> bool:
    """Whether a scene exists with all of its frames, every file as it was written."""
    from depthpose.core.files import read_json
    from depthpose.core.run import is_whole

    home = f"{split}/{scene:06d}"
    if not is_whole(out, home, [f"{home}/scene_camera.json"]):
        return False
    there = read_json(out / home / "scene_camera.json")
    return isinstance(there, dict) and {str(n) for n in frames} <= set(there)
