"""The work behind ``depthpose pose predict``, here or by an engine."""

import math
import operator
import re
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any

import torch
from scipy.spatial.transform import Rotation
from torch import Tensor
from tqdm import tqdm

from depthpose.cli import pose_methods
from depthpose.cli.engine import EngineOptions, Weights, print_shards
from depthpose.cli.pose_methods import PoseMethod, PoseMethodSource
from depthpose.cli.pose_options import DataSetOptions, PoseInputs
from depthpose.core import run
from depthpose.core.camera import AnyLens, Camera, camera_of
from depthpose.core.checkpoint import file_sha256, find_weights
from depthpose.core.config import config_to_dict
from depthpose.core.engine import (
    Files,
    Function,
    Inputs,
    Sample,
    Work,
)
from depthpose.core.errors import InputError, nearest_name
from depthpose.core.files import (
    CLOUD_READERS,
    MAP_SUFFIXES,
    image_size,
    list_images,
    read_image,
    read_stored_depth,
    write_cloud,
    write_image,
    write_json,
)
from depthpose.core.files.disk import natural_order
from depthpose.core.files.images import LISTED_SUFFIXES, refuse_among_inputs
from depthpose.core.rigid import Rigid
from depthpose.core.run import is_whole, note_result
from depthpose.core.runner import Job, Results, run_jobs
from depthpose.core.units import Unit
from depthpose.pose.background import AnyBackground, PosedBin, with_background
from depthpose.pose.color_inputs import with_color
from depthpose.pose.config import EstimateConfig
from depthpose.pose.datasets import (
    BopDataset,
    Box,
    Detection,
    encode_rle,
    group_by_image,
    name_objects,
    open_bop,
    parse_box,
    parse_labels,
    read_detections,
    read_labels,
    read_targets,
)
from depthpose.pose.evaluate import select_targets
from depthpose.pose.inputs import AnyMask, cloud_input, view_input
from depthpose.pose.predictions import (
    CLOUD,
    PICTURE,
    POSES,
    PoseJob,
    Prediction,
    earlier_predictions,
    predict,
    prediction_row,
    results_name,
    write_bop_results,
    write_predictions,
)
from depthpose.pose.types import ObjectModel, PoseEstimate, ViewInput
from depthpose.report import pose as drawn
from depthpose.report.page import Section, choose_answers, plain_table, write_page

_PAGE = "report.html"
_WITH_ALTERNATIVES = "depthpose-alternatives"  # the method of a csv that has them too
_MOST_SHOWN = 20  # of the answers, on the terminal; poses.json holds all
_MOST_PRINTED = 5  # inputs whose alternatives are printed; poses.json holds those of all
_MOST_ROWS = 1000  # of the answers, in the table of the page
_PRINTED = ("input", "object", "status", "x, y, z [m]", "qx, qy, qz, qw", "base x, y, z [m]",
            "base qx, qy, qz, qw", "agreement", "certainty", "of this copy", "identity",
            "visible", "pick rank", "tracking")  # fmt: skip
"""Columns on the terminal."""
_BASE_COLUMNS = ("base_x_m", "base_y_m", "base_z_m")
_FRAME = """camera_from_model: x right, y down, z forward
certainty: the probability that the pose is right, up to the near-symmetries of the model
of this copy: that it is this very copy of a nearly symmetric model
visible: share of the surface that faces the camera on which readings lie"""
_RANKED = "pick rank: what lies before another comes first, then what is surer and more visible"


def claim_for_jobs(
    out: Path,
    settings: dict[str, Any],
    jobs: list[PoseJob[Any]],
    is_result: Callable[[str, str], bool] = operator.eq,
) -> None:
    """Claim a folder for the poses of clouds or depth images, whose jobs name their files.

    Poses of an earlier run are deleted, to be estimated anew, if the record of the files that they
    were estimated from is lost.

    Args:
        out: the folder.
        settings: JSON values that decide the poses.
        jobs: each with the files that it reads.
        is_result: whether a result of the first name is of the input of the second.
    """
    run.claim_folder(out, settings, [POSES, _PAGE])
    if run.find_rank().world == 1 and not run.read_sources(out):
        (out / POSES).unlink(missing_ok=True)

    def is_finished(name: str) -> bool:
        predictions = earlier_predictions(out).values()
        done = [p.estimate.name for p in predictions if p.estimate.status != "unreadable"]
        return any(is_result(result_name, name) for result_name in done)

    run.claim_names(
        out,
        {job.name: job.source for job in jobs if job.source is not None},
        [f".{end}" for end in (PICTURE, CLOUD)],
        is_finished=is_finished,
    )


def is_result_of(name: str, image: str) -> bool:
    """Whether a result is of an image without a mask: its name, or that and a number."""
    return re.fullmatch(rf"{re.escape(image)}(_\d+)?", name) is not None


def claim_for_dataset(out: Path, settings: dict[str, Any], dataset: BopDataset) -> None:
    """Claim a folder for the poses of a data set."""
    images = sorted({(i.scene_id, i.image_id) for i in dataset.instances})
    pictures = [f"{scene:06d}_{image:06d}.{PICTURE}" for scene, image in images]
    tables = [results_name(dataset), results_name(dataset, _WITH_ALTERNATIVES)]
    run.claim_folder(out, settings, [POSES, _PAGE, *tables, *pictures])


def object_named(name: str | None, method: PoseMethod) -> str:
    """Give the object of this name, or the only one; refuse unknown names."""
    known_names = [model.name for model in method.models]
    if name is None and len(known_names) > 1:
        raise InputError(
            f"the {method.holder} know {', '.join(known_names)}; say which by --object"
        )
    if name is not None and name not in known_names:
        raise InputError(
            f"--object {name}: the {method.holder} do not know it; "
            f"{nearest_name(name, known_names)}"
        )
    return known_names[0] if name is None else name


def camera_facts(camera: Path | float) -> dict[str, Any]:
    """Give the values of a camera file or a focal length that decide the poses, for the record."""
    if not isinstance(camera, Path):
        return {"focal_px": camera}
    return {"camera": str(camera.resolve()), "camera_sha256": file_sha256(camera)}


def cloud_jobs(cloud: Path, unit: Unit, object: str, out: Path) -> list[PoseJob[Any]]:
    """Make a job of a cloud, or of every cloud of a folder."""
    suffixes = tuple(CLOUD_READERS)
    files = [cloud]
    if cloud.is_dir():
        named = [path for path in cloud.iterdir() if not path.name.startswith(".")]
        files = [path for path in named if path.suffix.lower() in suffixes]
    files.sort(key=natural_order)
    if not files:
        raise InputError(f"{cloud}: no {', '.join(suffixes)} file there; give a cloud, or a folder")
    _refuse_one_name(files)
    refuse_among_inputs(out, [cloud], files)
    return [
        PoseJob(
            name=p.stem,
            read=partial(cloud_input, p, unit, object, p.stem),
            object=object,
            source=p,
        )
        for p in files
    ]


def mask_jobs(
    depth: Path,
    mask: Path,
    camera: Path | float,
    object: str | None,
    unit: Unit | None,
    out: Path,
    labels: Mapping[str, str] | None = None,
) -> list[PoseJob[Any]]:
    """Take a depth image, its mask and its camera, or images and masks of one name in two folders.

    Of a mask that numbers several objects each is an input: NAME_1, NAME_2, ... All are of
    ``object``, or each of the object that ``labels`` names by its number.
    """
    runs = sorted(mask.glob("*.json")) if mask.is_dir() else []  # of run lengths
    depths = _list_depths(depth)
    pictures = runs or list_images(mask)
    refuse_among_inputs(out, [depth, mask], [*depths, *pictures])
    masks = _beside_depths(depths, pictures, depth, mask, "mask")
    jobs: list[PoseJob[Any]] = []
    for path in depths:
        shown: dict[str, tuple[str, AnyMask]] = {}
        if labels is not None:
            shown = _labelled_masks(masks[path.stem], labels, object)
        else:
            assert object is not None
            shown[""] = object, masks[path.stem]
            with suppress(InputError):  # it will be said where the mask is read
                numbered = read_labels(masks[path.stem])
                numbers = numbered[numbered != 0].unique().tolist()
                several = numbers if len(numbers) > 1 else []
                shown = {f"_{k}": (object, _run_lengths(numbered == k)) for k in several} or shown
        for end, (name, pixels) in shown.items():
            read = partial(view_input, path, pixels, camera, name, path.stem + end, unit)
            files = (path, masks[path.stem])
            jobs.append(PoseJob(name=path.stem + end, read=read, object=name, source=files))
    _refuse_twice(jobs, depth)
    return jobs


def _labelled_masks(
    mask: Path, labels: Mapping[str, str], wanted: str | None
) -> dict[str, tuple[str, AnyMask]]:
    """Give the object and the run lengths of each number of a label map that is there."""
    words = [label for label in labels if not label.isdecimal()]
    if words:
        raise InputError(
            f"--labels {words[0]}={labels[words[0]]}: the objects of a mask have numbers; write "
            "1=OBJECT,2=OBJECT"
        )
    objects = {int(label): name for label, name in labels.items()}
    numbered = read_labels(mask, list(objects))
    # What is asked for and is not there has an empty mask, and so a refusal.
    shown = [k for k in sorted(objects) if objects[k]]
    return {
        f"_{k}": (objects[k], _run_lengths(numbered == k))
        for k in shown
        if wanted in (None, objects[k])
    }


def _run_lengths(pixels: Tensor) -> AnyMask:
    counts, height, width = encode_rle(pixels)
    return {"size": [height, width], "counts": list(counts)}


def box_jobs(
    depth: Path,
    boxes: Sequence[str],
    camera: Path | float,
    object: str,
    unit: Unit | None,
    out: Path,
) -> list[PoseJob[Any]]:
    """Make a job of each box in each depth image: NAME, or of several NAME_1, NAME_2, ..."""
    depths = _list_depths(depth)
    refuse_among_inputs(out, [depth], depths)
    _refuse_one_name(depths)
    detections = [Detection(object=object, box=parse_box(text)) for text in boxes]
    jobs = [
        job for path in depths for job in _detection_jobs(path, detections, (path,), camera, unit)
    ]
    _refuse_twice(jobs, depth)
    return jobs


def detection_file_jobs(
    depth: Path,
    detections: Path,
    camera: Path | float,
    objects: tuple[Mapping[str, str], Sequence[str], str | None],
    asked: Sequence[str],
    unit: Unit | None,
    out: Path,
) -> list[PoseJob[Any]]:
    """Take what a detector found in depth images: NAME, or of several NAME_1 (the surest), ...

    ``detections``: a file, or a folder of files with the names of the images. ``objects``: labels,
    known names and the wanted one, as :func:`name_objects` takes them. ``asked``: objects that have
    a job in every image, whether they are detected there or not.
    """
    depths = _list_depths(depth)
    _refuse_one_name(depths)
    files = [detections]
    if detections.is_dir():
        named = [p for p in detections.iterdir() if p.suffix.lower() in (".json", ".txt")]
        files = [p for p in named if not p.name.startswith(".")]
    refuse_among_inputs(out, [depth, detections], [*depths, *files])

    # The detections of each image, from one file of all or from a file for each.
    by_image: dict[str, list[Detection]] = {}
    if len(files) == 1 and files[0].suffix.lower() == ".json":
        read = read_detections(files[0])
        beside = dict.fromkeys((path.stem for path in depths), files[0])
        by_image = group_by_image(read, [path.stem for path in depths], str(files[0]))
    else:
        beside = _beside_depths(depths, files, depth, detections, "file of detections")
        for path in depths:
            file = beside[path.stem]
            size = None
            if file.suffix.lower() == ".txt":
                height, width = read_stored_depth(path).shape
                size = (width, height)
            by_image[path.stem] = read_detections(file, size)

    # Those of the wanted objects, the surest first.
    jobs: list[PoseJob[Any]] = []
    is_any = False
    for path in depths:
        of_image = name_objects(by_image[path.stem], *objects, source=str(beside[path.stem]))
        of_image.sort(key=lambda detection: -detection.score)
        is_any |= bool(of_image)
        detected = {detection.object for detection in of_image}
        absent = [name for name in asked if name not in detected]
        jobs += _detection_jobs(path, of_image, (path, beside[path.stem]), camera, unit, absent)
    if not is_any:
        raise InputError(f"{detections}: holds no detection of what is asked for in {depth}")
    _refuse_twice(jobs, depth)
    return jobs


def _detection_jobs(
    path: Path,
    detections: Sequence[Detection],
    files: tuple[Path, ...],
    camera: Path | float,
    unit: Unit | None,
    absent: Sequence[str] = (),
) -> list[PoseJob[Any]]:
    """Make a job of each detection in a depth image: NAME, or of several NAME_1, NAME_2, ...

    ``absent``: objects that are not detected there, which have one too.
    """
    jobs: list[PoseJob[Any]] = []
    every = [(detection.object, detection) for detection in detections]
    every += [(object, None) for object in absent]
    for k, (object, detection) in enumerate(every, 1):
        assert object is not None
        name = path.stem + (f"_{k}" if len(every) > 1 else "")
        read = partial(_read_detection, path, object, detection, camera, name, unit)
        jobs.append(PoseJob(name=name, read=read, object=object, source=files))
    return jobs


def _read_detection(
    path: Path,
    object: str,
    detection: Detection | None,
    camera: AnyLens,
    name: str,
    unit: Unit | None,
) -> ViewInput:
    """Read a depth image with the pixels of a detection; with no pixel where there is none."""
    view = view_input(path, None, camera, object, name, unit)
    if detection is None:
        return replace(view, mask=torch.zeros_like(view.mask), is_region=True)
    mask = detection.mask(*view.depth_m.shape)
    return replace(view, mask=mask, is_region=detection.box is not None)


def _beside_depths(
    depths: Sequence[Path], others: Sequence[Path], depth: Path, place: Path, what: str
) -> dict[str, Path]:
    """Give the file of each depth image that has its name."""
    _refuse_one_name(depths)
    _refuse_one_name(others)
    by_name = {path.stem: path for path in others}
    if len(depths) == len(by_name) == 1 and not depth.is_dir():
        by_name = {depths[0].stem: next(iter(by_name.values()))}
    lost = [path.stem for path in depths if path.stem not in by_name]
    if lost:
        raise InputError(
            f"{place}: no {what} called {lost[0]!r}; a {what} has the name of its depth image"
        )
    return by_name


def _refuse_twice(jobs: Sequence[PoseJob[Any]], depth: Path) -> None:
    """Refuse jobs of one name: their results would overwrite each other."""
    twice = [name for name, count in Counter(job.name for job in jobs).items() if count > 1]
    if twice:
        raise InputError(
            f"{depth}: two results would be called {twice[0]!r}, the name of a depth image and a "
            "number of its mask or detection; rename the other"
        )


def frame_jobs(
    depth: Path, camera: Path | float, object: str, unit: Unit | None, out: Path
) -> list[PoseJob[Any]]:
    """Take whole depth images, without masks."""
    depths = _list_depths(depth)
    refuse_among_inputs(out, [depth], depths)
    _refuse_one_name(depths)
    return [
        PoseJob(
            name=p.stem,
            read=partial(view_input, p, None, camera, object, p.stem, unit),
            object=object,
            source=p,
        )
        for p in depths
    ]


def background_jobs(
    jobs: list[PoseJob[Any]], inputs: PoseInputs, settings: dict[str, Any]
) -> list[PoseJob[Any]]:
    """Give each depth image the known bin or empty frame, if any; add to the settings which."""
    lens = inputs.camera or inputs.focal_px
    background: AnyBackground
    if inputs.bin is not None:
        if inputs.bin_pose is None:
            raise InputError(
                f"--bin {inputs.bin}: where is it? Give --bin-pose, a text file with its 4x4 "
                "matrix camera_from_model in metres, or --empty-frame in place of both"
            )
        pose = pose_methods.read_pose(inputs.bin_pose, "--bin-pose")
        unit = pose_methods.unit_of_cad([inputs.bin], inputs.cad_unit, inputs.unit)
        background = PosedBin.load(inputs.bin, pose, unit)
        settings["bin"] = pose_methods.name_with_checksum(Path(inputs.bin))
        settings["bin_pose"] = pose.matrix().tolist()
    elif inputs.empty_frame is not None:
        background = Path(inputs.empty_frame)
        settings["empty_frame"] = pose_methods.name_with_checksum(background)
    else:
        return jobs
    return [
        replace(job, read=partial(_read_with_background, job.read, background, lens, inputs.unit))
        for job in jobs
    ]


def _read_with_background(
    read: Callable[[], ViewInput],
    background: AnyBackground,
    camera: Path | float | None,
    unit: Unit | None,
) -> ViewInput:
    return with_background(read(), background, camera, unit)


def colored_jobs(
    jobs: list[PoseJob[Any]],
    inputs: PoseInputs,
    models: Sequence[ObjectModel],
    out: Path,
    settings: dict[str, Any],
) -> list[PoseJob[Any]]:
    """Give each depth image the colour picture of its name, where such pictures are given.

    What decides the colours is added to the settings. ``models``: those that may be there.
    """
    if inputs.color is None:
        if inputs.color_camera is not None or inputs.color_from_depth is not None:
            raise InputError("--color-camera and --color-from-depth are of --color; give that too")
        return jobs
    if inputs.depth is None:
        raise InputError(f"--color {inputs.color}: is beside --depth; a cloud has no colour image")
    color = Path(inputs.color)
    depth = Path(inputs.depth)
    pictures = list_images(color)
    refuse_among_inputs(out, [color], pictures)
    beside = _beside_depths(_list_depths(depth), pictures, depth, color, "colour picture")
    settings["color"] = str(color.resolve())

    # The camera of the pictures, and where the depth camera is in its frame.
    camera = inputs.color_camera
    color_from_depth = None
    if camera is not None:
        settings["color_camera"] = pose_methods.name_with_checksum(camera)
    if inputs.color_from_depth is not None:
        color_from_depth = pose_methods.read_pose(
            inputs.color_from_depth, "--color-from-depth", "color_from_depth"
        )
        settings["color_from_depth"] = color_from_depth.matrix().tolist()

    colored: list[PoseJob[Any]] = []
    for job in jobs:
        sources = job.source if isinstance(job.source, tuple) else (job.source,)
        assert sources[0] is not None
        picture = beside[sources[0].stem]
        read = partial(_read_colored, job.read, models, picture, camera, color_from_depth)
        colored.append(replace(job, read=read, source=(*sources, picture)))
    return colored


def _read_colored(
    read: Callable[[], ViewInput],
    models: Sequence[ObjectModel],
    picture: Path,
    camera: Path | None,
    color_from_depth: Rigid | None,
) -> ViewInput:
    """Read a depth image together with its colour picture."""
    return with_color(read(), models, picture, camera, color_from_depth)


def _list_depths(depth: Path) -> list[Path]:
    """List depth images: pictures; in a folder without pictures, maps."""
    try:
        return list_images(depth)
    except InputError:
        maps = [p for p in depth.glob("*") if p.suffix.lower() in MAP_SUFFIXES]
        if not maps:
            raise
        return sorted(maps, key=natural_order)


def _refuse_one_name(files: Sequence[Path]) -> None:
    """Refuse files of one stem: results bear the stems of their inputs."""
    first: dict[str, Path] = {}
    for path in files:
        other = first.setdefault(path.stem, path)
        if other != path:
            raise InputError(
                f"{path.parent}: {other.name} and {path.name} would both be {path.stem!r} in the "
                "results; rename one, or move it to another folder"
            )


def predict_files(method: PoseMethod, inputs: PoseInputs, out: Path, batch: int) -> int:
    """Pose clouds, or parts of depth images, in this process; give the exit code."""
    settings = dict(method.settings)
    unit = inputs.unit
    if inputs.cloud is not None:
        settings["object"] = name = object_named(inputs.object, method)
        jobs = cloud_jobs(Path(inputs.cloud), unit or "m", name, out)
        settings |= {"unit": unit or "m"}
    else:
        jobs = region_jobs(method, inputs, out, settings)
        settings |= {} if unit is None else {"unit": unit}
    posed = {job.object for job in jobs}
    models = [model for model in method.models if model.name in posed]
    jobs = background_jobs(jobs, inputs, settings)
    jobs = colored_jobs(jobs, inputs, models, out, settings)
    claim_for_jobs(out, settings, jobs)
    predictions = estimate_jobs(method, jobs, out, settings, batch)
    if predictions is None:
        return 0
    write_files(predictions, jobs, out, method)
    return print_result(predictions, out)


def region_jobs(
    method: PoseMethod, inputs: PoseInputs, out: Path, settings: dict[str, Any]
) -> list[PoseJob[Any]]:
    """Take depth images and where objects are in them; add to the settings what decides that."""
    lens = inputs.camera or inputs.focal_px
    unit = inputs.unit
    regions = {"mask": inputs.mask, "box": inputs.box, "detections": inputs.detections}
    options = [f"--{name}" for name, value in regions.items() if value]
    if inputs.depth is None or lens is None or not options:
        raise InputError(
            "--depth needs --camera or --focal-px beside it, and --mask, --box or --detections "
            "unless it is to be found"
        )
    if len(options) > 1:
        raise InputError(f"{' and '.join(options)} say where objects are; give one of them")
    depth = Path(inputs.depth)
    known_names = [model.name for model in method.models]
    labels = None if inputs.labels is None else parse_labels(inputs.labels, known_names)
    is_one = inputs.object is not None or len(known_names) == 1
    wanted = object_named(inputs.object, method) if is_one else None
    settings |= camera_facts(lens) | ({} if labels is None else {"labels": labels})
    if wanted is not None:
        settings["object"] = wanted
    if inputs.detections is not None:
        settings["detections"] = str(Path(inputs.detections).resolve())
        objects = (labels or {}, known_names, wanted)
        if wanted is not None:
            asked = [wanted]
        elif labels is not None:
            asked = [name for name in dict.fromkeys(labels.values()) if name]
        else:  # CAD files are asked for by being given, objects of weights are not
            asked = [] if method.holder == "weights" else known_names
        return detection_file_jobs(depth, Path(inputs.detections), lens, objects, asked, unit, out)
    if inputs.box:
        settings["box"] = list(inputs.box)
        name = object_named(inputs.object, method)
        return box_jobs(depth, inputs.box, lens, name, unit, out)
    assert inputs.mask is not None
    mask = Path(inputs.mask)
    settings["mask"] = str(mask.resolve())
    if wanted is None and labels is None:
        raise InputError(
            f"the {method.holder} know {', '.join(known_names)}; say which by --object, or which "
            f"number of the mask is which by --labels 1={known_names[0]},2={known_names[1]}"
        )
    return mask_jobs(depth, mask, lens, wanted, unit, out, labels)


def predict_dataset(
    method: PoseMethod,
    options: DataSetOptions,
    object: str | None,
    config: EstimateConfig,
    out: Path,
    batch: int,
) -> int:
    """Pose the objects of a data set, or one; give the exit code."""
    assert options.bop is not None
    dataset = open_bop(options.bop, options.split)
    if options.targets is not None:
        dataset = select_targets(dataset, read_targets(options.targets, options.bop))
    dataset = pose_methods.choose_objects(dataset, method, object)
    (masks,) = pose_methods.find_masks([options.masks], dataset, out, config.device)
    names = pose_methods.match_names(dataset, method.models)
    jobs: list[PoseJob[Any]] = [
        replace(job, object=names[job.place.object_id])
        for job in masks.jobs(names)
        if job.place is not None
    ]
    settings = {**method.settings, "estimate": config_to_dict(config)}
    settings |= {**pose_methods.dataset_settings(dataset), "masks": masks.name, **masks.settings}
    if object is not None:
        settings["objects"] = sorted({i.object_id for i in dataset.instances})
    claim_for_dataset(out, settings, dataset)
    predictions = estimate_jobs(method, jobs, out, settings, batch)
    if predictions is None:
        return 0
    write_files(predictions, jobs, out, method, dataset)
    return print_result(predictions, out)


def estimate_jobs(
    method: PoseMethod,
    jobs: list[PoseJob[Any]],
    out: Path,
    settings: dict[str, Any],
    batch: int,
) -> list[Prediction] | None:
    """Estimate what is not finished; several processes share the work through the files.

    Gives all predictions in the first of them, None in the others.
    """
    process = run.find_rank()
    home = out if process.world == 1 else out / f"part-{process.rank}"
    by_name = earlier_predictions(out)
    unreadable = {name for name, p in by_name.items() if p.estimate.status == "unreadable"}
    finished = by_name.keys() - unreadable
    unfinished = [job for job in process.share_of(jobs) if job.name not in finished]
    if unfinished:
        written = predict(method.estimate_many, unfinished, home, settings, batch)
        for prediction in tqdm(written, total=len(unfinished), disable=None, unit=" poses"):
            by_name[prediction.estimate.name] = prediction

    # The first process puts the files of all together, with the inputs of earlier runs.
    if process.rank:
        return None
    if process.world > 1:
        _wait_for_predictions(out, jobs)
        by_name = earlier_predictions(out)
    predictions = [by_name.pop(job.name) for job in jobs]
    write_predictions(out, [*by_name.values(), *predictions])
    return predictions


def _wait_for_predictions(out: Path, jobs: Sequence[PoseJob[Any]]) -> None:
    """Wait until the files of all processes together hold a prediction of every job."""
    names: set[str] = set()
    last_read_s = -math.inf

    def is_written(name: str) -> bool:
        """Whether a prediction of this name is in the files."""
        nonlocal names, last_read_s
        # The files are read for all names at once, every second.
        if name not in names and time.monotonic() - last_read_s > 1:
            names = set(earlier_predictions(out))
            last_read_s = time.monotonic()
        return name in names

    run.wait_for([job.name for job in jobs], is_written)


def write_files(
    predictions: list[Prediction],
    jobs: list[PoseJob[Any]],
    out: Path,
    method: PoseMethod,
    dataset: BopDataset | None = None,
    input_count: int | None = None,
) -> None:
    """Write the page of poses, and the files of each input, or of a data set."""
    models = {model.name: model for model in method.models}
    if dataset is None:
        _write_job_files(predictions, jobs, out, models)
    else:
        _write_dataset_files(predictions, dataset, out, models)
    _write_page(out, predictions, jobs, models, dataset, input_count)


def _write_dataset_files(
    predictions: Sequence[Prediction],
    dataset: BopDataset,
    out: Path,
    models: Mapping[str, ObjectModel],
) -> None:
    """Write BOP's csv of a data set's poses, and a picture of each image with its poses."""
    write_bop_results(out / results_name(dataset), predictions)
    if any(p.estimate.alternatives for p in predictions):
        table = out / results_name(dataset, _WITH_ALTERNATIVES)
        write_bop_results(table, predictions, with_alternatives=True)

    image_of = {(i.scene_id, i.image_id): i for i in dataset.instances}
    posed: dict[tuple[int, int], list[PoseEstimate]] = defaultdict(list)
    for prediction in predictions:
        if prediction.place is not None and prediction.estimate.is_posed:
            posed[prediction.place[:2]].append(prediction.estimate)
    for image, estimates in posed.items():
        name = f"{image[0]:06d}_{image[1]:06d}.{PICTURE}"
        if is_whole(out, name, [name]):
            continue
        picture = drawn.picture_of(image_of[image])
        for estimate in estimates:
            pose = estimate.camera_from_model
            assert pose is not None
            picture = drawn.draw_pose(picture, pose, models[estimate.object], image_of[image].K)
        write_image(out / name, picture)
        note_result(out, name, [out / name])


def _write_job_files(
    predictions: Sequence[Prediction],
    jobs: Sequence[PoseJob[Any]],
    out: Path,
    models: Mapping[str, ObjectModel],
) -> None:
    """Write the posed model beside each cloud, and a picture of each depth image with its pose."""
    for prediction, job in zip(predictions, jobs, strict=True):
        pose = prediction.estimate.camera_from_model
        if pose is None:
            continue
        model = models[prediction.estimate.object]
        try:
            view = job.read()
        except InputError:  # unreadable by now
            continue
        points_m = drawn.object_points(view, model.diameter_m)
        files = [out / f"{job.name}.{CLOUD}"]
        write_cloud(files[0], drawn.posed_cloud(points_m, pose.double(), model))
        if isinstance(view, ViewInput):
            files.append(out / f"{job.name}.{PICTURE}")
            picture = drawn.draw_region(drawn.grey_depth(view.depth_m), view, pose)
            write_image(files[1], drawn.draw_pose(picture, pose, model, view.K))
        note_result(out, job.name, files)


def print_result(predictions: list[Prediction], out: Path, input_count: int | None = None) -> int:
    """Print the poses, their alternatives and the reasons of refusals; give the exit code.

    ``input_count``: where an input may have several estimates; None: one each.
    """
    failed = [p.estimate for p in predictions if p.estimate.status == "unreadable"]
    shown = [p.estimate for p in predictions if p.estimate.status != "unreadable"]
    for estimate in failed:
        print(f"depthpose: failed: {estimate.name}: {estimate.reason}", file=sys.stderr)

    # A table of the first estimates.
    if shown:
        rows: list[dict[str, Any]] = []
        for estimate in shown[:_MOST_SHOWN]:
            row = _row(estimate)
            row |= _pose_words(estimate.camera_from_model, "")
            row |= _pose_words(estimate.base_from_model, "base ")
            certain = {
                key: value
                for key in ("agreement", "certainty", "of this copy", "visible")
                if (value := row[key]) is not None
            }
            rows.append(row | {key: f"{value:.3f}" for key, value in certain.items()})
        print(plain_table(rows, _PRINTED), end="")
        print(_FRAME)
        if any(estimate.pick_rank is not None for estimate in shown):
            print(_RANKED)

    # Why there is no sure pose, and what else fits.
    if len(shown) == 1 and not shown[0].is_ok:
        what = "refused" if shown[0].camera_from_model is None else shown[0].status
        print(f"{what}: {shown[0].reason}")
    refused = [estimate for estimate in shown if not estimate.is_posed]
    for estimate in refused[:_MOST_PRINTED] if len(shown) > 1 else ():
        print(f"{estimate.name}: no {estimate.object}: {estimate.reason}")
    for prediction in predictions[:_MOST_PRINTED]:
        for other in prediction.estimate.alternatives:
            print(f"{prediction.estimate.name}: {other}")

    counts = Counter(estimate.status for estimate in shown)
    statuses = ", ".join(f"{count} {status}" for status, count in sorted(counts.items()))
    total = _count_inputs(predictions, input_count)
    print(f"{total}: {statuses or 'none readable'}; {out / 'poses.json'}")
    return 1 if failed else 0


def _pose_words(pose: Rigid | None, before: str) -> dict[str, str]:
    """Format position and quaternion of a pose for the columns of a table."""
    if pose is None:
        return {}
    quaternion = Rotation.from_matrix(pose.R.double()).as_quat()
    return {
        f"{before}x, y, z [m]": ", ".join(f"{value:.4f}" for value in pose.t_m.tolist()),
        f"{before}qx, qy, qz, qw": ", ".join(f"{value:.4f}" for value in quaternion.tolist()),
    }


def _count_inputs(predictions: Sequence[Prediction], input_count: int | None) -> str:
    """Give the number of inputs, and that of estimates where it is another."""
    count = len(predictions) if input_count is None else input_count
    answers = len(predictions)
    total = f"{count} input{'s' * (count != 1)}"
    return total if count == answers else f"{total}, {answers} answer{'s' * (answers != 1)}"


def _row(estimate: PoseEstimate) -> dict[str, Any]:
    """Give the row of an estimate for the page and the terminal."""
    pose = estimate.camera_from_model
    evidence = estimate.evidence
    identity = estimate.identity
    place = [None] * 3 if pose is None else pose.t_m.double().tolist()
    base = estimate.base_from_model
    return {
        "input": estimate.name,
        "object": estimate.object,
        "status": estimate.status,
        **({} if estimate.tracking is None else {"tracking": estimate.tracking}),
        **dict(zip(("x_m", "y_m", "z_m"), place, strict=True)),
        **({} if base is None else dict(zip(_BASE_COLUMNS, base.t_m.tolist(), strict=True))),
        "agreement": None if evidence is None else evidence.agreement,
        "identity": None if identity is None else identity.status,
        "certainty": estimate.certainty,
        "of this copy": estimate.copy_certainty,
        "visible": estimate.visible_share,
        **({} if estimate.pick_rank is None else {"pick rank": estimate.pick_rank}),
        "alternatives": "; ".join(map(str, estimate.alternatives)),
        "reason": estimate.reason,
    }


def _write_page(
    out: Path,
    predictions: Sequence[Prediction],
    jobs: Sequence[PoseJob[Any]],
    models: dict[str, ObjectModel],
    dataset: BopDataset | None,
    input_count: int | None,
) -> None:
    """Write a page with some of the predictions and the reason of every refusal."""
    # The table: refusals first, for they are what is looked for.
    estimates = [prediction.estimate for prediction in predictions]
    numbers = Counter(estimate.status for estimate in estimates)
    counts = ", ".join(f"{count} {status}" for status, count in sorted(numbers.items()))
    rows = [
        _row(listed)
        for listed in sorted(estimates, key=lambda listed: listed.is_posed)[:_MOST_ROWS]
    ]

    # Some inputs with their poses, and some that were refused.
    instances = () if dataset is None else dataset.instances
    image_of = {(i.scene_id, i.image_id): i.rgb for i in instances}
    readable = [k for k, listed in enumerate(estimates) if listed.status != "unreadable"]
    sections: list[Section] = []
    for k in choose_answers([predictions[k].estimate.is_posed for k in readable]):
        estimate = predictions[readable[k]].estimate
        place = predictions[readable[k]].place
        try:
            shown_input = jobs[readable[k]].read()
        except InputError:  # unreadable by now
            continue
        is_searched = isinstance(shown_input, ViewInput) and bool(shown_input.mask.all())
        if is_searched and not estimate.is_posed:  # a whole image; its row says why
            continue
        rgb = None if place is None else image_of[place[:2]]
        model = models[estimate.object]
        image = None if rgb is None else read_image(rgb)
        section = drawn.pose_section(estimate.name, shown_input, estimate, model, image=image)
        sections.append(section)

    number = len(predictions)
    total = _count_inputs(predictions, input_count)
    text = f"{total}: {counts}. Shown below: {len(sections)}"
    text += "." if len(sections) == number else ", answers and refusals spread evenly."
    if number > _MOST_ROWS:
        text += f" The table holds the first {_MOST_ROWS}, refusals before answers; all are in "
        text += "poses.json."
    results = Section(title="What was found", text=text, rows=rows)
    title = f"Poses of {total}"
    write_page(out / _PAGE, title, [results, *sections], run.environment())
    print(f"the page: {out / _PAGE}")


ENDING = "pose.json"  # of the one file of a result: an entry of poses.json


@dataclass(frozen=True)
class EntryFiles(Results[Any, PoseEstimate]):
    """A file for each estimate, for the shards of an engine."""

    folder: Path

    def store(self, job: Job[Any], data: Any, result: PoseEstimate) -> None:  # noqa: ANN401, ARG002
        """Write an estimate as an entry of ``poses.json`` has it."""
        row = prediction_row(Prediction(estimate=result))
        write_json(self.folder / f"{job.name}.{ENDING}", row)


def start_files(
    source: PoseMethodSource,
    object: str,
    unit: Unit | None,
    camera: Camera | None,
    box: Box | None = None,
) -> Function:
    """Build the estimator; clouds or depth images to poses or the reasons for none.

    Depth images have masks, or are all searched in one box.
    """
    method = source.build()

    def job_of(sample: Sample) -> Job[Any]:
        """Make the job of a cloud, or of a depth image and its mask."""
        if camera is None:
            cloud = sample.files[0]
            read = partial(cloud_input, cloud, unit or "m", object, sample.name)
        elif box is not None:
            detection = Detection(object=object, box=box)
            read = partial(
                _read_detection, sample.files[0], object, detection, camera, sample.name, unit
            )
        else:
            depth, mask = sample.files
            read = partial(view_input, depth, mask, camera, object, sample.name, unit)
        return Job(name=sample.name, read=read)

    def estimate(samples: Sequence[Sample], out: Path) -> list[str]:
        jobs = [job_of(sample) for sample in samples]
        outcomes = run_jobs(jobs, method.estimate_many, EntryFiles(out), max(1, len(jobs)))
        return ["" if o.failure is None else f"cannot be read: {o.failure}" for o in outcomes]

    return estimate


def predict_on_ray(
    options: PoseInputs, source: PoseMethodSource, batch: int, out: str, engine: EngineOptions
) -> int:
    """Pose clouds, depth images with masks or a box, manifests or tar shards by an engine."""
    if options.depth is not None and (options.camera or options.focal_px) is None:
        raise InputError("--depth needs --camera or --focal-px beside it")
    if options.box and options.mask is not None:
        raise InputError("--mask and --box say where objects are; give one of them")
    box = parse_box(options.box[0]) if options.box else None
    views = Files(roles=("depth", "mask"), suffixes=(*LISTED_SUFFIXES, ".json"))
    if box is not None:
        views = Files(roles=("depth",), suffixes=LISTED_SUFFIXES)
    clouds = Files(roles=("cloud",), suffixes=tuple(CLOUD_READERS))
    files = clouds if options.depth is None else views
    words = [word for word in (options.cloud, options.depth, options.mask) if word is not None]
    inputs = Inputs.find(words, files)
    for item in inputs.items if len(words) == 2 else ():  # one manifest pairs as it likes
        depth, mask = (PurePosixPath(file).stem for file in item.files)
        if depth != mask and len(inputs.items) > 1:
            raise InputError(
                f"{words[1]}: no mask called {depth!r}; a mask has the name of its depth image"
            )
    if isinstance(source.weights, str):
        path = find_weights(source.weights)
        source = replace(source, weights=Weights(name=path.name, data=path.read_bytes()))
    method = source.build("cpu")
    object = object_named(options.object or None, method)
    with inputs.first() as first:
        lens = options.camera or options.focal_px
        camera = None if lens is None else camera_of(lens, image_size(first[0]))
    start = partial(start_files, source, object, options.unit, camera, box)
    work = Work(start=start, files=files, endings=(ENDING,), batch=batch)
    settings = {**method.settings, "estimate": config_to_dict(source.config), "object": object}
    settings |= {"unit": options.unit} | ({} if box is None else {"box": box})
    if camera is not None:
        settings |= {"K": camera.K.tolist(), "depth_unit_m": camera.depth_unit_m}
    return print_shards(engine.run(work, inputs, out, settings), out, "inputs")
