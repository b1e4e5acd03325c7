"""``depthpose data ...``."""

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from depthpose.core.errors import InputError

_FRAMES_A_SCENE = 50
_SCENES_A_SEED = 1000

if TYPE_CHECKING:
    from depthpose.depth.config import StreetsConfig


def check(
    path: tyro.conf.Positional[Path], split: str | None = None, with_decoding: bool = True
) -> int:
    """Walk a dataset and name everything that is wrong: pairs, KITTI, Middlebury, BOP, LineMOD.

    A line for each file that is missing, truncated or of the wrong size, then a summary. Exit code
    0: nothing wrong. 1: something is. 2: the folder cannot be understood.

    Args:
        path: the dataset's folder.
        split: check only these frames: eigen-train, eigen-val, eigen-train-val, eigen-test,
            eigen-benchmark, or a file of monodepth's or monodepth2's form; of a BOP dataset, one
            of its splits.
        with_decoding: decode every image in full, which finds truncation; off reads headers only.
    """
    from tqdm import tqdm

    from depthpose.depth.kitti import check_dataset
    from depthpose.pose.bop import check_bop, is_bop

    check_folder = check_bop if is_bop(path) else check_dataset
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
    path: tyro.conf.Positional[Path],
    out: Path,
    split: str | None = None,
    shard_mb: int = 256,
) -> int:
    """Pack a data set of images, pairs and their truth into tar shards, in WebDataset's form.

    Whatever takes a data set takes OUT, or a URL to which it was copied (s3://, gs://): a training
    reads it by index, and a shard of a store comes to this machine, into ~/.cache/depthpose or
    $DEPTHPOSE_CACHE, when it is first read. Files are copied as they are. index.json is written
    last; what was stopped before begins again.

        depthpose data pack KITTI --split eigen-train-val --out shards

    Args:
        path: the data set's folder.
        out: a new folder for shards, calibration and index.
        split: pack these frames alone.
        shard_mb: megabytes of a shard, from which on the next one begins.
    """
    from tqdm import tqdm

    from depthpose.core.run import refuse_to_replace
    from depthpose.depth.kitti import open_dataset, pack_frames

    if shard_mb < 1:
        raise InputError(f"--shard-mb {shard_mb}: a shard has a megabyte or more; take 256")
    refuse_to_replace(out / "index.json")
    dataset = open_dataset(path, split)
    with tqdm(total=len(dataset), unit=" frames", disable=None) as bar:
        shards = pack_frames(dataset.frames, out, shard_mb * 10**6, lambda _: bar.update())
    print(f"{len(dataset)} frames in {shards} shards: {out}")
    return 0


def duplicates(
    train: tyro.conf.Positional[Path],
    evaluation: tyro.conf.Positional[Path],
    at_least: float | None = None,
    out: Path | None = None,
) -> int:
    """List images of one set that show nearly the same as images of another.

    Training on a frame of the evaluation's drives flatters every number. Left images are compared
    by their fine structure over small shifts and zooms: 1 is the same picture, two streets stay
    below 0.3. The list is for the eye: look at what it names. Always says the likest pair. Exit
    code 0: none. 1: some.

        depthpose data duplicates my-pairs kitti-eval

    Args:
        train: folder of the first set, in any layout that 'data check' knows.
        evaluation: folder of the second set.
        at_least: list pairs from this likeness on; 0.3 by default.
        out: folder to write the list to as well: duplicates.json, .csv and .md.
    """
    from dataclasses import asdict

    from tqdm import tqdm

    from depthpose.core.report import markdown_table, table_files, write_table
    from depthpose.core.run import claim_folder
    from depthpose.depth.kitti import DUPLICATE_LIKENESS, find_duplicates, open_dataset

    threshold = DUPLICATE_LIKENESS if at_least is None else at_least
    if not -1 <= threshold <= 1:
        raise InputError(f"--at-least {threshold:g}: a likeness is -1 .. 1; take 0.3")
    first, second = open_dataset(train), open_dataset(evaluation)
    ranked = find_duplicates(
        first, second, threshold, lambda frames: tqdm(frames, unit=" frames", disable=None)
    )
    rows = [asdict(pair) for pair in ranked if pair.likeness >= threshold]
    if rows:
        print(markdown_table(rows))
    if out is not None:
        claim_folder(out, {"command": "data duplicates"}, table_files("duplicates"))
        write_table(out, rows, name="duplicates")
    likest = f"the likest: {ranked[0].first} and {ranked[0].second}, {ranked[0].likeness:.3f}"
    what = f"{len(first)} x {len(second)} images"
    print(f"{what}: {len(rows)} pairs of likeness {threshold:g} or more; {likest}")
    return 1 if rows else 0


def label(
    path: tyro.conf.Positional[Path],
    out: Path,
    weights: str = "default",
    device: str = "cpu",
    max_difference_px: float = 1.0,
    max_difference_share: float = 0.03,
    min_confidence: float = 0.5,
) -> int:
    """Match pairs that have no truth both ways, and keep as truth what both views agree on.

    What is written is a folder of pairs that every training takes. What comes of such labels is no
    better than their matcher, and has its blind spots; a matcher that has seen evaluation frames
    tells them on.

        depthpose data label my-pairs --out my-pairs-labelled

    Args:
        path: a dataset with right views and calibration.
        out: folder to write to.
        weights: weights with a matcher, by name or file; the terms of theirs bind what comes of it.
        device: cpu, cuda, cuda:1, ...
        max_difference_px: largest difference of both views' disparities.
        max_difference_share: the same as a share of the disparity; the larger limit holds.
        min_confidence: least confidence of the matcher.
    """
    from tqdm import tqdm

    from depthpose.core.checkpoint import file_sha256, find_weights
    from depthpose.depth.config import MatcherConfig
    from depthpose.depth.estimator import FakestereoNet
    from depthpose.depth.kitti import open_dataset
    from depthpose.depth.labels import LabelConfig, label_pairs

    config = LabelConfig(
        largest_difference_px=max_difference_px,
        largest_share=max_difference_share,
        least_confidence=min_confidence,
    )
    dataset = open_dataset(path)
    settings = {
        "dataset": dataset.name,
        "weights_sha256": file_sha256(find_weights(weights)),
        **asdict(config),
    }
    net = FakestereoNet.load(weights, config=MatcherConfig(device=device))
    labelled = label_pairs(net, dataset, config, out, settings)
    shares = [share for _, share in tqdm(labelled, unit=" pairs", leave=False, disable=None)]
    known = f", {sum(shares) / len(shares):.0%} of their pixels are known" if shares else ""
    print(f"{out}: {len(shares)} pairs labelled{known}; the others were there")
    return 0


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

    from depthpose.core.run import claim_folder
    from depthpose.depth.config import StreetsConfig
    from depthpose.depth.kitti import has_raw_frame
    from depthpose.depth.streets import rig_number

    if number < 1 or first < 0 or not 0 <= seed <= 9999:
        raise InputError(
            f"--number {number} --first {first} --seed {seed}: at least 1 frame, from 0 on, and a "
            "seed of four digits at most"
        )
    config = StreetsConfig(
        seed=seed, scale=scale, with_antialiasing=with_antialiasing, with_lidar=with_lidar
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
    """Make frames of objects on a table, with picture, depth, masks and poses, in BOP's layout.

    A scene holds 50 frames; scenes that are there are skipped, so an interrupted run goes on where
    it was. 'depthpose data check OUT' reads what this writes.

        depthpose data make objects --cad part.stl clamp.stl --unit mm --out made --number 500

    Args:
        cad: model files, of any kind that holds a surface or points; the first is object 1.
        out: folder to write to.
        unit: of the numbers in the files.
        number: how many frames.
        split: name of the part of the data set.
        seed: another seed, other frames.
        distance: nearest and farthest view [m].
        sensor: whose errors the depth has.
        symmetries: found looks whether a part looks alike from several sides, and declares it;
            without, you are told of what is found.
    """
    from tqdm import tqdm

    from depthpose.core.config import config_to_dict
    from depthpose.core.run import claim_folder
    from depthpose.pose.bop import write_bop_models, write_bop_scene
    from depthpose.pose.config import ObjectsConfig, SensorConfig
    from depthpose.pose.mesh import read_model, with_found_symmetries
    from depthpose.pose.objects import make_frames

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
    """Whether a scene is there with all of its frames; its last file says so."""
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
    from depthpose.depth.kitti import RawFrame, write_raw_frame
    from depthpose.depth.streets import camera_from_velodyne, draw_street

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
