"""``depthpose data ...``."""

import math
import re
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import tyro

from depthpose.cli.arguments import Device, NewPath, Source, WeightsName
from depthpose.core.errors import InputError
from depthpose.core.units import Unit, metres_of
from depthpose.pose.config import SensorKind

if TYPE_CHECKING:  # --help must not load torch
    from collections.abc import Iterator, Sequence

    from torch import Tensor

    from depthpose.core.camera import RectificationReport, Rectifier

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
        seed: of the random streets, and number of the drives.
        scale: size of the images: 0.5 gives half as many rows and columns.
        with_lidar: scan each scene with a LiDAR of 64 beams.
        clutter_share: share of scenes that show random shapes before a ground, a wall or in a box
            instead of a street; for training matchers.
    """
    from tqdm import tqdm

    from depthpose.core.run import claim_folder
    from depthpose.depth.config import StreetsConfig
    from depthpose.depth.datasets import has_calibration, has_raw_frame, write_raw_frame
    from depthpose.depth.synthetic import draw_street, rig_number

    if number < 1 or first < 0 or not 0 <= seed <= 9999:
        raise InputError(
            f"--number {number} --first {first} --seed {seed}: at least 1 frame, from 0 on, and a "
            "seed of four digits at most"
        )
    config = StreetsConfig(
        seed=seed,
        scale=scale,
        clutter_share=clutter_share,
        with_lidar=with_lidar,
    )
    # The frames of each seed are a drive of their own, so seeds may share the folder.
    dates = [f"2100_01_{day:02d}" for day in range(1, 6)]
    settings = {key: value for key, value in asdict(config).items() if key != "seed"}
    claim_folder(out, settings, dates)
    indices = range(first, first + number)
    date_of = {index: dates[rig_number(config, index)] for index in indices}
    drive_of = {index: f"{date}_drive_{seed:04d}_sync" for index, date in date_of.items()}

    # A frame is missing if it is not there, or if it is to bring the calibration of its date.
    last_of_date = {date: index for index, date in date_of.items()}
    uncalibrated = {index for date, index in last_of_date.items() if not has_calibration(out, date)}
    missing = [
        index
        for index in indices
        if index in uncalibrated or not has_raw_frame(out, drive_of[index], index)
    ]
    for index in tqdm(missing, unit=" frames", leave=False, disable=None):
        write_raw_frame(out, drive_of[index], index, draw_street(config, index))
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
        seed: of the random scenes.
        plain: share of the walls, floors and table tops that show next to no texture.
    """
    from tqdm import tqdm

    from depthpose.core.config import config_to_dict
    from depthpose.core.run import claim_folder
    from depthpose.depth.config import NearConfig
    from depthpose.depth.datasets import has_scene, write_scene
    from depthpose.depth.synthetic import draw_near

    if number < 1 or first < 0 or not 0 <= seed <= 9999:
        raise InputError(
            f"--number {number} --first {first} --seed {seed}: at least 1 scene, from 0 on, and a "
            "seed of four digits at most"
        )
    config = NearConfig(seed=seed, plain_share=plain)
    names = {index: f"near_{seed:04d}_{index:06d}" for index in range(first, first + number)}
    settings = {key: value for key, value in config_to_dict(config).items() if key != "seed"}
    claim_folder(out, settings, list(names.values()))
    missing = [index for index, name in names.items() if not has_scene(out, name)]
    for index in tqdm(missing, unit=" scenes", leave=False, disable=None):
        write_scene(out, names[index], draw_near(config, index))
    print(f"{out}: {len(missing)} scenes made, {number - len(missing)} were there")
    return 0


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
        unit: of the numbers in the files.
        number: how many frames.
        split: name of the part of the data set.
        seed: of the random frames.
        distance: nearest and farthest view [m].
        sensor: kind of depth sensor whose errors are simulated.
        clutter: fewest and most other things among the objects.
        pile: each frame shows so many copies of one part, dropped onto each other.
        symmetries: found: declare those that a part's shape shows; none: only print them.
    """
    from tqdm import tqdm

    from depthpose.core.checkpoint import file_sha256
    from depthpose.core.config import config_to_dict
    from depthpose.core.run import claim_folder, note_result
    from depthpose.pose.config import ObjectsConfig, SyntheticSensorConfig
    from depthpose.pose.datasets import write_bop_models, write_bop_scene
    from depthpose.pose.mesh import read_model, refuse_one_name, with_found_symmetries
    from depthpose.pose.synthetic import make_frames

    if number < 1:
        raise InputError(f"--number {number}: at least 1 frame")
    max_number = _SCENES_PER_SEED * _FRAMES_PER_SCENE
    if not 0 <= seed <= _MAX_SEED or number > max_number:
        raise InputError(
            f"--seed {seed} --number {number}: scenes are numbered by the seed; take a seed of 0 "
            f"to {_MAX_SEED}, and at most {max_number} frames of each"
        )
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
    # What decides the frames. The seed only decides the numbers of scenes, which share the folder.
    settings = config_to_dict(config)
    del settings["number"], settings["seed"]
    numbered_files = list(enumerate(cad, start=1))
    settings["unit"] = unit
    settings["symmetries"] = symmetries
    settings["cad"] = {
        f"object {k}": {"file": path.name, "sha256": file_sha256(path)}
        for k, path in numbered_files
    }
    models = [read_model(path, unit, number=k) for k, path in numbered_files]
    refuse_one_name(models)
    models = [
        with_found_symmetries(model, on_message=tqdm.write, is_taken=symmetries == "found")
        for model in models
    ]
    claim_folder(out, settings, ["models", split])
    write_bop_models(out, models)

    # The scenes by their numbers, each with the numbers of its frames.
    scenes: dict[int, range] = {}
    for k, first in enumerate(range(0, number, _FRAMES_PER_SCENE)):
        last = min(first + _FRAMES_PER_SCENE, number)
        scenes[seed * _SCENES_PER_SEED + k] = range(first, last)
    missing = [k for k, frames in scenes.items() if not _has_whole_scene(out, split, k, frames)]
    for k in missing:
        count = len(scenes[k])
        frames = make_frames(models, config, count, scenes[k].start)
        shown = tqdm(frames, total=count, unit=" frames", leave=False, disable=None)
        home = write_bop_scene(out, split, k, list(shown))
        files = sorted(path for path in home.rglob("*") if path.is_file())
        note_result(out, home.relative_to(out).as_posix(), files)
    print(f"{out}: {len(missing)} scenes made, {len(scenes) - len(missing)} were there")
    return 0


def _has_whole_scene(out: Path, split: str, scene: int, frames: range) -> bool:
    """Whether a scene exists with all of its frames, every file as it was written."""
    from depthpose.core.files import read_json
    from depthpose.core.run import is_whole

    home = f"{split}/{scene:06d}"
    if not is_whole(out, home, [f"{home}/scene_camera.json"]):
        return False
    frames_of_scene = read_json(out / home / "scene_camera.json")
    return isinstance(frames_of_scene, dict) and {str(n) for n in frames} <= set(frames_of_scene)


def check(
    path: tyro.conf.Positional[Path], split: str | None = None, with_decoding: bool = True
) -> int:
    """Read a data set and list everything that is wrong: pairs, KITTI, Middlebury, BOP, LineMOD.

    A line for each missing, truncated or wrong file, and a summary. Exit code 0: nothing wrong. 1:
    something is. 2: the layout of the folder is unknown.

    Args:
        path: the dataset's folder.
        split: only these frames: eigen-train, -val, -train-val, -test, -benchmark, a file of
            monodepth's or monodepth2's form, or a split of a BOP dataset.
        with_decoding: decode every image in full, which finds truncation, and pairs that are
            swapped, not rectified or no pair; off reads headers only.
    """
    from tqdm import tqdm

    from depthpose.depth.datasets import check_dataset
    from depthpose.pose.datasets import LAYOUTS, check_bop

    is_bop = any(layout.splits(path) for layout in LAYOUTS.values())
    check_folder = check_bop if is_bop else check_dataset
    with tqdm(unit=" frames", leave=False, disable=None) as bar:

        def show(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        report = check_folder(path, split, with_decoding=with_decoding, progress=show)
    for problem in (*report.notices, *report.problems):
        print(f"{problem.kind}: {problem.path}: {problem.message}")
    print(report.summary)
    return 0 if report.is_ok else 1


def pack(
    path: tyro.conf.Positional[Path], out: NewPath, split: str | None = None, shard_mb: int = 256
) -> int:
    """Pack a data set of images, pairs and their truth into tar shards, in WebDataset's form.

    OUT, or a URL of its copy (s3://, gs://), is used as any data set; a URL's shards are cached in
    ~/.cache/depthpose or $DEPTHPOSE_CACHE. Files are unchanged. Interrupted, packing begins again.

        depthpose data pack KITTI --split eigen-train-val --out shards

    Args:
        path: the data set's folder.
        out: a new folder for shards, calibration and index.
        split: pack these frames alone.
        shard_mb: size from which on the next shard begins [1e6 bytes].
    """
    from tqdm import tqdm

    from depthpose.core.run import refuse_to_replace
    from depthpose.depth.datasets import open_dataset, pack_frames

    if shard_mb < 1:
        raise InputError(f"--shard-mb {shard_mb}: a shard has a megabyte or more; take 256")
    dataset = open_dataset(path, split)
    refuse_to_replace(out / "index.json")
    if any(part.suffix == ".tar" for frame in dataset.frames[:1] for part in frame.left.parents):
        raise InputError(f"{path}: is packed already; give the folder that it was made of")
    if out.resolve() == path.resolve():
        raise InputError(
            f"--out {out}: is the data set itself, which would be read as packed from then on; "
            "choose another folder"
        )
    with tqdm(total=len(dataset), unit=" frames", disable=None) as bar:
        shards = pack_frames(dataset.frames, out, shard_mb * 10**6, lambda _: bar.update())
    print(f"{len(dataset)} frames in {shards} shards: {out}")
    return 0


def label(
    path: tyro.conf.Positional[Path],
    out: NewPath,
    weights: WeightsName = "default",
    device: Device = "cpu",
    max_difference_px: float = 1.0,
    max_difference_share: float = 0.03,
    min_confidence: float = 0.5,
) -> int:
    """Label stereo pairs that have no true disparity: match them, keep where both views agree.

    Writes a folder of pairs that every training takes, with the pseudo-labels as truth; pairs that
    cannot be read are left out. Labels are no better than the matcher, and if it was trained on
    evaluation frames, so is what trains on its labels.

        depthpose data label my-pairs --out my-pairs-labelled

    Args:
        path: a dataset with right views and calibration.
        out: folder to write to.
        weights: with a matcher, by name or file; their terms hold for the labels too.
        max_difference_px: largest difference of the two views' disparities.
        max_difference_share: the same as a share of the disparity; the larger limit counts.
        min_confidence: least confidence of the matcher.
    """
    from tqdm import tqdm

    from depthpose.core.checkpoint import file_sha256, find_weights
    from depthpose.depth.config import MatcherConfig
    from depthpose.depth.datasets import open_dataset
    from depthpose.depth.estimator import FakestereoNet
    from depthpose.depth.labels import LabelConfig, label_pairs

    # What decides the labels, and so stands in the record of the folder.
    config = LabelConfig(
        largest_difference_px=max_difference_px,
        largest_share=max_difference_share,
        least_confidence=min_confidence,
    )
    dataset = open_dataset(path)
    sha256 = file_sha256(find_weights(weights))
    settings = {"dataset": dataset.name, "weights_sha256": sha256, **asdict(config)}

    # A pair that fails is named at the end and stops no other; the only pair ends the command.
    failures: list[InputError] = []
    collected = failures if len(dataset) > 1 else None
    net = FakestereoNet.load(weights, config=MatcherConfig(device=device))
    labelled = label_pairs(net, dataset, config, out, settings, failures=collected)
    shares = [share for _, share in tqdm(labelled, unit=" pairs", leave=False, disable=None)]

    for failure in failures:
        print(f"depthpose: failed: {failure}", file=sys.stderr)
    print(f"{out}: {_summarise_labels(shares, len(failures))}")
    return 1 if failures else 0


def _summarise_labels(shares: list[float], failures: int) -> str:
    """Summarise a labelling: how many pairs, which share of their pixels, how many failed."""
    share = f", {sum(shares) / len(shares):.0%} of their pixels labelled" if shares else ""
    failed = f"{failures} failed, " if failures else ""
    return f"{len(shares)} pairs labelled{share}; {failed}the others were labelled before"


_CHECKED_PAIRS = 8
"""Pairs whose rows are compared before anything is written."""
_MAX_OFFSET_PX = 0.5
"""Largest difference of rows in a rectified pair without a warning."""
_SIDES = ("left", "right")
_CALIBRATION_QUESTION = (
    "were the cameras moved since, or are the images scaled or cropped? Calibrate anew"
)


def rectify(
    left: tyro.conf.Positional[Source],
    right: tyro.conf.Positional[Source],
    camera: Path,
    out: NewPath,
    unit: Unit | None = None,
    fisheye: bool = False,
    keep: float = 0.0,
    check: bool = True,
) -> int:
    """Rectify raw stereo pairs by the calibration of their two cameras, with OpenCV.

    Writes left/NAME.png, right/NAME.png and camera.json: OUT is input for 'depth match'. First,
    corners of up to 8 pairs are matched and the differences of their rows printed: a warning above
    0.5 px, an error where most of these pairs are not rectified. Needs the extra 'opencv'.

        depthpose data rectify left.png right.png --camera stereo.yaml --out rectified
        depthpose data rectify 'raw/cam0/*.png' 'raw/cam1/*.png' --camera camchain.yaml --out out
        depthpose depth match rectified/left rectified/right --camera rectified/camera.json --out o

    Args:
        left: raw left image, a folder of them, or a quoted pattern such as 'left/*.png'.
        right: raw right image, folder or pattern; paired by their names, or the numbers in them.
        camera: calibration of both cameras: a camchain of Kalibr, a file of OpenCV's K1, D1, K2,
            D2, R, T (YAML, XML, JSON), or a folder with its intrinsics.yml and extrinsics.yml or
            with left.yaml and right.yaml of ROS.
        out: folder for the results.
        unit: of the translation between the cameras: that of the calibration board (default m).
        fisheye: the lenses are fisheyes (OpenCV's cv2.fisheye); ROS and Kalibr files have it.
        keep: 0 keeps only what the raw images show, 1 all of it, with black borders.
        check: refuse what is swapped or differs by more than a row.
    """
    from tqdm import tqdm

    from depthpose.cli.depth_inputs import list_pairs
    from depthpose.core.camera import make_rectifier, read_raw_pair, write_camera
    from depthpose.core.files import image_size, read_image, write_image
    from depthpose.core.run import claim_folder, claim_names

    # Refuse what cannot be rectified, before anything is written.
    unit_m = metres_of(unit) if unit else None
    calibration = read_raw_pair(camera, unit_m=unit_m, is_fisheye=fisheye or None)
    pairs = list_pairs(left, right)
    result_folders = {(out / side).resolve() for side in _SIDES}
    if any(path.parent.resolve() in result_folders for pair in pairs for path in pair):
        raise InputError(
            f"--out {out}: the inputs lie in its left or right, where the results would be written "
            "over them; choose another folder"
        )
    rectifier = make_rectifier(calibration, image_size(pairs[0][0]), keep)
    _check_rows(rectifier, pairs, is_refused=check)

    # All that decides the results, for the record of the folder.
    settings: dict[str, Any] = {
        "command": "data rectify",
        "keep": keep,
        "right_from_left": calibration.right_from_left.matrix().tolist(),
    }
    for side, raw in zip(_SIDES, (calibration.left, calibration.right), strict=True):
        settings[side] = {
            "K": raw.K.tolist(),
            "D": list(raw.distortion),
            "is_fisheye": raw.is_fisheye,
        }
    claim_folder(out, settings, [*_SIDES, "camera.json"])
    claim_names(out, {pair[0].stem: pair for pair in pairs})

    for first, second in tqdm(pairs, unit=" pairs", leave=False, disable=None):
        names = [str(first), str(second)]
        rectified = rectifier.rectify(read_image(first), read_image(second), names)
        for side, image in zip(_SIDES, rectified, strict=True):
            write_image(out / side / f"{first.stem}.png", image)
    write_camera(out / "camera.json", rectifier.rig)
    print(f"{out}: {len(pairs)} pairs in left and right, their camera in camera.json")
    return 0


def split(files: tyro.conf.Positional[tuple[Source, ...]], out: NewPath) -> int:
    """Part pictures and videos that hold both views of a stereo camera.

    Finds whether the views are side by side, one above the other or one after the other (.mpo), and
    which is the left one. Writes left/NAME.png and right/NAME.png: OUT is input for 'depth match',
    or for 'data rectify' where the views are raw.

        depthpose data split street.jps drive.mp4 --out parted

    Args:
        files: pictures, videos, folders or quoted patterns.
        out: folder for the results.
    """
    from depthpose.cli.depth_inputs import list_images_and_videos
    from depthpose.core.camera import order_views
    from depthpose.core.files import write_image
    from depthpose.core.run import claim_folder

    sources = list_images_and_videos(files, out)
    claim_folder(out, {"command": "data split"}, _SIDES)
    count = 0
    for source in sources:
        for name, images in _read_two_view_pictures(source):
            first, second = images if len(images) == 2 else _split_picture(images[0], source, name)
            for side, view in zip(_SIDES, order_views(first, second), strict=True):
                write_image(out / side / f"{name}.png", view)
            count += 1
    print(f"{out}: {count} pairs in left and right")
    return 0


def _read_two_view_pictures(source: Path) -> "Iterator[tuple[str, Sequence[Tensor]]]":
    """Read a picture, or the frames of a video, with their names.

    Each is one image that holds both views, or (of .mpo) two images.
    """
    from depthpose.core.files import VIDEO_SUFFIXES, read_video
    from depthpose.core.files.images import read_views

    if source.suffix.lower() not in VIDEO_SUFFIXES:
        yield source.stem, read_views(source)
        return
    for name, frame in read_video(source):
        yield name, [frame]


def _split_picture(picture: "Tensor", source: Path, name: str) -> "tuple[Tensor, Tensor]":
    """Split a picture into its two views, side by side or one above the other."""
    from depthpose.core.camera import find_two_views, split_halves

    layout = find_two_views(picture)
    if layout is None:
        raise InputError(
            f"{source}: {name} does not look like two views of one scene, side by side or one "
            "above the other; leave it out"
        )
    return split_halves(picture, layout)


def _check_rows(
    rectifier: "Rectifier", pairs: list[tuple[Path, Path]], *, is_refused: bool
) -> None:
    """Print by how much the rows of some rectified pairs differ.

    ``is_refused``: raise an error where most of them are swapped or not rectified; else warn.
    """
    from statistics import median

    rig = rectifier.rig
    x, y = rectifier.left_maps
    is_visible = (x >= 0) & (x <= rig.width - 1) & (y >= 0) & (y <= rig.height - 1)
    print(
        f"rectified camera: {rig.width}x{rig.height}, fx {float(rig.K[0, 0]):.1f} px, baseline "
        f"{rig.baseline_m:.4f} m; the raw images show {is_visible.mean():.1%} of the left view"
    )
    reports = _compare_rows(rectifier, pairs)
    judged = [report for report in reports if report.is_rectified is not None]
    if not judged:
        message = f"depthpose: the rows cannot be checked: {reports[0].message}"
        print(message, file=sys.stderr)
        return

    # The median over pairs; pairs without any match have no offset.
    matched = [report for report in judged if report.matches] or judged
    offset_px = median(abs(report.vertical_offset_px) for report in matched)
    spread_px = median(report.vertical_spread_px for report in matched)
    difference = f"they differ by {offset_px:.2f} px, with a spread of {spread_px:.2f} px"
    if not math.isfinite(offset_px):
        difference = "no difference is common to their matches"
    match_count = sum(report.matches for report in judged)
    message = f"rows of {len(judged)} pairs: {difference} ({match_count} matches)"

    # An error where it holds for most pairs, a warning where the rows differ a little.
    swapped_count = sum(bool(report.is_swapped) for report in judged)
    wrong_count = sum(report.is_wrong for report in judged)
    reason = ""
    if 2 * swapped_count > len(judged):
        reason = "left and right look swapped (disparities are negative); exchange LEFT and RIGHT"
    elif 2 * wrong_count > len(judged):
        reason = (
            "they are not rectified by it, so this is not the calibration of these images, or "
            f"LEFT and RIGHT are exchanged; {_CALIBRATION_QUESTION}"
        )
    if reason and is_refused:
        raise InputError(
            f"{message}: {reason}. Nothing was written (--no-check writes all the same)"
        )
    print(message)
    if not reason and offset_px > _MAX_OFFSET_PX:
        reason = (
            f"that is above {_MAX_OFFSET_PX:g} px, which costs depth far away; "
            f"{_CALIBRATION_QUESTION}"
        )
    if reason:
        print(f"depthpose: {reason}", file=sys.stderr)


def _compare_rows(
    rectifier: "Rectifier", pairs: list[tuple[Path, Path]]
) -> "list[RectificationReport]":
    """Rectify some pairs, spread over all, and compare the rows of what matches in them."""
    from depthpose.core.camera import check_rectified
    from depthpose.core.files import read_image

    count = min(_CHECKED_PAIRS, len(pairs))
    checked_pairs = [pairs[k * len(pairs) // count] for k in range(count)]
    reports: list[RectificationReport] = []
    for first, second in checked_pairs:
        names = [str(first), str(second)]
        left, right = rectifier.rectify(read_image(first), read_image(second), names)
        reports.append(check_rectified(left, right, rectifier.rig.cx_right_minus_left_px))
    return reports
