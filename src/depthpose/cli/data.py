"""``depthpose data ...``."""

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from depthpose.core.errors import InputError

if TYPE_CHECKING:
    from depthpose.depth.config import StreetsConfig


def check(
    path: tyro.conf.Positional[Path], split: str | None = None, with_decoding: bool = True
) -> int:
    """Walk a folder of pairs or a KITTI or Middlebury dataset, and name everything that is wrong.

    A line for each file that is missing, truncated or of the wrong size, then a summary. Exit code
    0: nothing wrong. 1: something is. 2: the folder cannot be understood.

    Args:
        path: the dataset's folder.
        split: check only these frames: eigen-train, eigen-val, eigen-test, eigen-benchmark, or a
            file of monodepth's or monodepth2's form.
        with_decoding: decode every image in full, which finds truncation; off reads headers only.
    """
    from tqdm import tqdm

    from depthpose.depth.kitti import check_dataset

    with tqdm(unit=" frames", leave=False, disable=None) as bar:

        def show(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        report = check_dataset(path, split, with_decoding=with_decoding, progress=show)
    for problem in (*report.notices, *report.problems):
        print(f"{problem.kind}: {problem.path}: {problem.message}")
    print(report.summary)
    return 0 if report.is_ok else 1


def make_streets(
    out: Path,
    number: int = 100,
    first: int = 0,
    seed: int = 0,
    scale: float = 1.0,
    with_antialiasing: bool = True,
    with_lidar: bool = True,
) -> int:
    """Make street scenes with exact disparity, in KITTI's raw layout.

    Frames that are there are skipped, so an interrupted run goes on where it was, and several
    runs with different --first share the work. Each rig of KITTI's five recording days gets a
    date of its own, 2100_01_01 to 2100_01_05, which no real drive has.

    Args:
        out: folder to write to.
        number: how many frames.
        first: number of the first one.
        seed: another seed, other streets; it is the number of the drives too.
        scale: size of the pictures: 0.5 makes half as many rows and columns.
        with_antialiasing: smooth edges.
        with_lidar: scan each scene with a LiDAR of 64 beams.
    """
    from tqdm import tqdm

    from depthpose.depth.config import StreetsConfig
    from depthpose.depth.kitti import has_raw_frame
    from depthpose.depth.streets import street_rig

    if number < 1 or first < 0 or not 0 <= seed <= 9999:
        raise InputError(
            f"--number {number} --first {first} --seed {seed}: at least 1 frame, from 0 on, and a "
            "seed of four digits at most"
        )
    config = StreetsConfig(
        seed=seed, scale=scale, with_antialiasing=with_antialiasing, with_lidar=with_lidar
    )
    _keep_settings(out, asdict(config))
    indices = range(first, first + number)
    drives = {index: _drive(config, street_rig(config, index)[0].width) for index in indices}
    wanted = [index for index in indices if not has_raw_frame(out, drives[index], index)]
    for index in tqdm(wanted, unit=" frames", leave=False, disable=None):
        _make_street(out, drives[index], config, index)
    print(f"{out}: {len(wanted)} frames made, {number - len(wanted)} were there")
    return 0


def _keep_settings(out: Path, settings: dict) -> None:
    """Refuse to mix frames of different settings in one folder."""
    from depthpose.core.files import read_json, write_json

    path = out / "streets.json"
    if not path.exists():
        write_json(path, settings)
        return
    read = read_json(path)
    there = read if isinstance(read, dict) else {}
    # Seeds have drives of their own, so they may share a folder.
    differing = [key for key in settings if key != "seed" and there.get(key) != settings[key]]
    if differing:
        raise InputError(
            f"{path}: the frames here were made with other settings ({', '.join(differing)}); "
            "write to another folder, or remove this one"
        )


def _drive(config: "StreetsConfig", width: int) -> str:
    from depthpose.depth.streets.rigs import KITTI_RIGS

    day = next(n for n, rig in enumerate(KITTI_RIGS, 1) if round(rig[0] * config.scale) == width)
    return f"2100_01_{day:02d}_drive_{config.seed:04d}_sync"


def _make_street(out: Path, drive: str, config: "StreetsConfig", index: int) -> None:
    from depthpose.depth.kitti import RawFrame, write_raw_frame
    from depthpose.depth.streets import camera_from_velodyne, draw_street

    frame = draw_street(config, index)
    raw = RawFrame(
        left=frame.left,
        right=frame.right,
        rig=frame.rig,
        disparity_px=frame.disparity_px,
        occluded=frame.occluded,
        points=frame.lidar_points,
        camera_from_velodyne=camera_from_velodyne(),
    )
    write_raw_frame(out, drive, index, raw)
