"""``depthpose data make ...``: synthetic datasets."""

import re
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from depthpose.cli.arguments import NewPath, refuse_below
from depthpose.core.errors import InputError
from depthpose.core.units import Unit
from depthpose.pose.config import SensorKind

if TYPE_CHECKING:  # --help must not load torch
    from depthpose.pose.config import ObjectsConfig
    from depthpose.pose.types import ObjectModel

_RECORDING_DATES = tuple(f"2100_01_{day:02d}" for day in range(1, 6))
"""A date for each rig of KITTI's five recording days, that no real drive has."""
_MAX_SEED_OF_SCENES = 9999
"""Largest seed of streets and near scenes, whose names have four digits for it."""
_FRAMES_PER_SCENE = 50
_SCENES_PER_SEED = 1000
_MAX_SEED = 10**6 - 1
"""Largest seed of frames of objects: scene numbers have nine digits at most, and the last three
count the scenes of a seed."""


def make_streets(
    out: NewPath,
    number: int = 100,
    first: int = 0,
    seed: int = 0,
    scale: float = 1.0,
    with_lidar: bool = True,
    clutter_share: float = 0.0,
) -> int:
    """Render synthetic street scenes with exact disparity, in KITTI's raw layout.

    Existing frames are skipped, and a later run with another --first adds to them; runs at the same
    time need a folder each. Each rig of KITTI's five recording days gets a date that no real drive
    has, 2100_01_01 to 2100_01_05.

    Args:
        out: folder to write to.
        number: how many frames.
        first: number of the first one.
        seed: seed of the random streets, and number of the drives.
        scale: size of the images: 0.5 gives half as many rows and columns.
        with_lidar: scan each scene with a LiDAR of 64 beams.
        clutter_share: share of scenes that show random shapes before a ground, a wall or in a box
            instead of a street; for training matchers.
    """
    from tqdm import tqdm

    from depthpose.core.run_folder import claim_folder
    from depthpose.depth.config import StreetsConfig
    from depthpose.depth.datasets import has_calibration, has_raw_frame, write_raw_frame
    from depthpose.depth.synthetic import draw_rig_number, render_street

    _refuse_scene_numbers(number, first, seed, "frame")
    config = StreetsConfig(
        seed=seed,
        scale=scale,
        clutter_share=clutter_share,
        with_lidar=with_lidar,
    )
    settings = {key: value for key, value in asdict(config).items() if key != "seed"}
    claim_folder(out, settings, _RECORDING_DATES)

    # The frames of each seed are a drive of their own, so seeds may share the folder.
    indices = range(first, first + number)
    date_of = {index: _RECORDING_DATES[draw_rig_number(config, index)] for index in indices}
    drive_of = {index: f"{date}_drive_{seed:04d}_sync" for index, date in date_of.items()}

    # A frame is rendered if it is not there. The calibration of a date is written with any of its
    # frames: where it is not there, the last frame of the date is rendered in any case.
    last_of_date = {date: index for index, date in date_of.items()}
    uncalibrated = {index for date, index in last_of_date.items() if not has_calibration(out, date)}
    missing = [
        index
        for index in indices
        if index in uncalibrated or not has_raw_frame(out, drive_of[index], index)
    ]
    for index in tqdm(missing, unit=" frames", leave=False, disable=None):
        write_raw_frame(out, drive_of[index], index, render_street(config, index))
    print(f"{out}: {len(missing)} frames made, {number - len(missing)} were there")
    return 0


def make_near(
    out: NewPath, number: int = 100, first: int = 0, seed: int = 0, plain: float = 0.45
) -> int:
    """Render synthetic near scenes with exact disparity, in Middlebury's layout.

    Rooms, tables, bins, shelves and walls with things, 5 cm to 20 m away, seen by rigs of 1 to
    54 cm in colour, grey and infrared, with and without a projected pattern. Existing scenes are
    skipped, and a later run with another --first or --seed adds to them.

        depthpose data make near --out near --number 300

    Args:
        out: folder to write to.
        number: how many scenes.
        first: number of the first one.
        seed: seed of the random scenes.
        plain: share of the walls, floors and table tops that show next to no texture.
    """
    from tqdm import tqdm

    from depthpose.core.config import config_to_dict
    from depthpose.core.run_folder import claim_folder
    from depthpose.depth.config import NearConfig
    from depthpose.depth.datasets import has_scene, write_scene
    from depthpose.depth.synthetic import render_near

    _refuse_scene_numbers(number, first, seed, "scene")
    config = NearConfig(seed=seed, plain_share=plain)
    names = {index: f"near_{seed:04d}_{index:06d}" for index in range(first, first + number)}
    settings = {key: value for key, value in config_to_dict(config).items() if key != "seed"}
    claim_folder(out, settings, list(names.values()))
    missing = [index for index, name in names.items() if not has_scene(out, name)]
    for index in tqdm(missing, unit=" scenes", leave=False, disable=None):
        write_scene(out, names[index], render_near(config, index))
    print(f"{out}: {len(missing)} scenes made, {number - len(missing)} were there")
    return 0


def _refuse_scene_numbers(number: int, first: int, seed: int, noun: str) -> None:
    """Refuse a count below 1, a negative first number, and a seed that names have no room for.

    ``noun``: the word for what is counted.
    """
    if number < 1 or first < 0 or not 0 <= seed <= _MAX_SEED_OF_SCENES:
        raise InputError(
            f"--number {number} --first {first} --seed {seed}: at least 1 {noun}, from 0 on, and a "
            "seed of four digits at most"
        )


def make_objects(
    cad: tuple[Path, ...],
    out: NewPath,
    unit: Unit = "mm",
    number: int = 100,
    split: str = "train",
    seed: int = 0,
    distance: tuple[float, float] = (0.6, 1.1),
    sensor: SensorKind = "structured light",
    clutter: tuple[int, int] = (0, 4),
    pile: int = 0,
    symmetries: Literal["none", "found"] = "none",
) -> int:
    """Render frames of objects on a table, with image, depth, masks and poses, in BOP's layout.

    A scene has 50 frames; existing scenes are skipped. 'depthpose data check OUT' checks them.

        depthpose data make objects --cad part.stl clamp.stl --unit mm --out synthetic --number 500

    Args:
        cad: model files with a surface or points; the first is object 1.
        out: folder to write to.
        unit: unit of the numbers in the files.
        number: how many frames.
        split: name of the part of the dataset.
        seed: seed of the random frames.
        distance: nearest and farthest view [m].
        sensor: kind of depth sensor whose errors are simulated.
        clutter: fewest and most other things among the objects.
        pile: each frame shows so many copies of one part, dropped onto each other.
        symmetries: found: declare those that a part's shape shows; none: only print them.
    """
    from tqdm import tqdm

    from depthpose.core.run_folder import claim_folder
    from depthpose.pose.config import ObjectsConfig, SyntheticSensorConfig
    from depthpose.pose.datasets import write_bop_models
    from depthpose.pose.mesh import (
        describe_found_symmetries,
        read_model,
        refuse_equal_names,
        with_found_symmetries,
    )

    _refuse_frame_numbers(number, seed)
    if not re.fullmatch(r"[\w-]+", split) or split == "models":
        raise InputError(f"--split {split}: a name of letters and digits, not 'models'")
    config = ObjectsConfig(
        seed=seed,
        distance_m=distance,
        sensor=SyntheticSensorConfig(kinds=(sensor,)),
        number=number,
        frame_clutter=clutter,
        frame_pile=pile,
    )
    models = [read_model(path, unit, number=k) for k, path in enumerate(cad, start=1)]
    refuse_equal_names(models)
    searched = [with_found_symmetries(model) for model in models]
    are_used = symmetries == "found"
    for sentence in describe_found_symmetries(models, searched, are_used=are_used):
        tqdm.write(sentence)
    models = searched if are_used else models
    settings = {
        **_list_frame_settings(config),
        "unit": unit,
        "symmetries": symmetries,
        "cad": _fingerprint_files(cad),
    }
    claim_folder(out, settings, ["models", split])
    write_bop_models(out, models)

    scenes = _divide_into_scenes(number, seed)
    missing = [
        scene for scene, frames in scenes.items() if not _has_whole_scene(out, split, scene, frames)
    ]
    for scene in missing:
        _render_scene(models, config, scenes[scene], out, split, scene)
    print(f"{out}: {len(missing)} scenes made, {len(scenes) - len(missing)} were there")
    return 0


def _refuse_frame_numbers(number: int, seed: int) -> None:
    """Refuse numbers of frames and seeds for which there are no numbers of scenes."""
    refuse_below(1, "--number", number, "100")
    max_number = _SCENES_PER_SEED * _FRAMES_PER_SCENE
    if not 0 <= seed <= _MAX_SEED or number > max_number:
        raise InputError(
            f"--seed {seed} --number {number}: scenes are numbered by the seed; take a seed of 0 "
            f"to {_MAX_SEED}, and at most {max_number} frames of each"
        )


def _list_frame_settings(config: "ObjectsConfig") -> dict[str, Any]:
    """List the settings that decide the frames of a folder, which several seeds may share."""
    from depthpose.core.config import config_to_dict

    settings = config_to_dict(config)
    del settings["number"], settings["seed"]  # they only decide which scenes there are
    return settings


def _fingerprint_files(files: Sequence[Path]) -> dict[str, dict[str, str]]:
    """Compute the SHA-256 of each file, beside its name; the first is that of object 1."""
    from depthpose.core.checkpoint import file_sha256

    return {
        f"object {k}": {"file": path.name, "sha256": file_sha256(path)}
        for k, path in enumerate(files, start=1)
    }


def _divide_into_scenes(number: int, seed: int) -> dict[int, range]:
    """Divide frames 0 to ``number`` into scenes; return the frames of each, by its number."""
    scenes: dict[int, range] = {}
    for k, first in enumerate(range(0, number, _FRAMES_PER_SCENE)):
        end = min(first + _FRAMES_PER_SCENE, number)
        scenes[seed * _SCENES_PER_SEED + k] = range(first, end)
    return scenes


def _render_scene(
    models: Sequence["ObjectModel"],
    config: "ObjectsConfig",
    frames: range,
    out: Path,
    split: str,
    scene: int,
) -> None:
    """Render the frames of a scene, and write them into a split of a dataset in BOP's layout.

    Args:
        models: the objects.
        config: how their frames are drawn.
        frames: the numbers of the frames.
        out: folder of the dataset.
        split: name of the split.
        scene: number of the scene.
    """
    from tqdm import tqdm

    from depthpose.core.run_folder import note_result
    from depthpose.pose.datasets import write_bop_scene
    from depthpose.pose.synthetic import make_frames

    rendered = make_frames(models, config, len(frames), frames.start)
    shown = tqdm(rendered, total=len(frames), unit=" frames", leave=False, disable=None)
    scene_folder = write_bop_scene(out, split, scene, list(shown))
    files = sorted(path for path in scene_folder.rglob("*") if path.is_file())
    note_result(out, scene_folder.relative_to(out).as_posix(), files)


def _has_whole_scene(out: Path, split: str, scene: int, frames: range) -> bool:
    """Whether a scene exists with all of its frames, every file as it was written."""
    from depthpose.core.files import read_json
    from depthpose.core.run_folder import is_result_finished

    scene_folder = f"{split}/{scene:06d}"
    if not is_result_finished(out, scene_folder, [f"{scene_folder}/scene_camera.json"]):
        return False
    frames_of_scene = read_json(out / scene_folder / "scene_camera.json")
    return isinstance(frames_of_scene, dict) and {str(n) for n in frames} <= set(frames_of_scene)
