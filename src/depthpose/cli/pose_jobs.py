"""Inputs of the pose commands: files become jobs, each of which reads one input."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from depthpose.cli import file_names, pose_methods, pose_transforms
from depthpose.cli.pose_methods import PoseMethod
from depthpose.cli.pose_options import PoseInputs
from depthpose.core.camera import AnyLens
from depthpose.core.checkpoint import file_sha256
from depthpose.core.errors import InputError, suggest_name
from depthpose.core.files import CLOUD_READERS, MAP_SUFFIXES, list_images, read_stored_depth
from depthpose.core.files.disk import natural_sort_key, refuse_equal_stems
from depthpose.core.files.images import refuse_among_inputs
from depthpose.core.rigid import Rigid
from depthpose.core.units import Unit
from depthpose.pose.background import AnyBackground, PosedBin, add_background
from depthpose.pose.color_inputs import add_color
from depthpose.pose.datasets import (
    Detection,
    encode_rle,
    group_by_image,
    name_objects,
    parse_box,
    parse_labels,
    read_detections,
    read_labels,
)
from depthpose.pose.inputs import AnyMask, cloud_input, view_input
from depthpose.pose.predictions import PoseJob
from depthpose.pose.types import ObjectModel, ViewInput


@dataclass(frozen=True, kw_only=True)
class JobPlan:
    """Jobs, and the JSON values that decide their results, apart from those of the method."""

    jobs: list[PoseJob[Any]]
    settings: dict[str, Any]


def plan_jobs(method: PoseMethod, inputs: PoseInputs, out: Path) -> JobPlan:
    """Make the jobs of clouds, or of the masks, boxes or detections in depth images."""
    if inputs.cloud is not None:
        name = object_named(inputs.object, method)
        unit = inputs.unit or "m"
        jobs = cloud_jobs(Path(inputs.cloud), unit, name, out)
        plan = JobPlan(jobs=jobs, settings={"object": name, "unit": unit})
    else:
        plan = _plan_regions(method, inputs, out)
    objects = {job.object for job in plan.jobs}
    models = [model for model in method.models if model.name in objects]
    plan = _with_background(plan, inputs)
    return _with_color(plan, inputs, models, out)


def plan_searches(
    method: PoseMethod, inputs: PoseInputs, objects: Sequence[str], out: Path
) -> JobPlan:
    """Make the jobs of whole depth images, which are searched for objects."""
    assert inputs.depth is not None
    assert inputs.lens is not None
    jobs = frame_jobs(Path(inputs.depth), inputs.lens, objects[0], inputs.unit, out)
    settings = {
        "find": sorted(objects),
        **camera_settings(inputs.lens),
        **unit_settings(inputs.unit),
    }
    plan = JobPlan(jobs=jobs, settings=settings)
    models = [model for model in method.models if model.name in objects]
    plan = _with_background(plan, inputs)
    return _with_color(plan, inputs, models, out)


def _plan_regions(method: PoseMethod, inputs: PoseInputs, out: Path) -> JobPlan:
    """Make the jobs of what masks, boxes or detections show in depth images."""
    regions = {"mask": inputs.mask, "box": inputs.box, "detections": inputs.detections}
    options = [f"--{name}" for name, value in regions.items() if value]
    if inputs.depth is None or inputs.lens is None or not options:
        raise InputError(
            "--depth needs --camera or --focal-px beside it, and --mask, --box or --detections "
            "unless it is to be found"
        )
    if len(options) > 1:
        raise InputError(f"{' and '.join(options)} say where objects are; give one of them")

    # Which objects may be there: one by name or because the method has no other, or labelled ones.
    names = [model.name for model in method.models]
    labels = None if inputs.labels is None else parse_labels(inputs.labels, names)
    object = None
    if inputs.object is not None or len(names) == 1:
        object = object_named(inputs.object, method)
    settings = {**camera_settings(inputs.lens), **unit_settings(inputs.unit)}
    if labels is not None:
        settings["labels"] = labels
    if object is not None:
        settings["object"] = object

    depth = Path(inputs.depth)
    if inputs.detections is not None:
        detections = Path(inputs.detections)
        settings["detections"] = str(detections.resolve())
        wanted = _choose_wanted(method, labels, object)
        jobs = detection_file_jobs(depth, detections, inputs.lens, wanted, inputs.unit, out)
    elif inputs.box:
        settings["box"] = list(inputs.box)
        box_object = object_named(inputs.object, method)
        jobs = box_jobs(depth, inputs.box, inputs.lens, box_object, inputs.unit, out)
    else:
        assert inputs.mask is not None
        mask = Path(inputs.mask)
        settings["mask"] = str(mask.resolve())
        if object is None and labels is None:
            raise InputError(
                f"the {method.holder} know {', '.join(names)}; say which by --object, or which "
                f"number of the mask is which by --labels 1={names[0]},2={names[1]}"
            )
        jobs = mask_jobs(depth, mask, inputs.lens, object, inputs.unit, out, labels)
    return JobPlan(jobs=jobs, settings=settings)


@dataclass(frozen=True, kw_only=True)
class WantedObjects:
    """The objects whose detections are posed.

    ``names``: names of all objects of the method. ``labels``: the object of a detector's class,
    where it is not named so. ``only``: the single object that is wanted; None: all. ``expected``:
    objects that have a result in every image, detected there or not.
    """

    names: Sequence[str]
    labels: Mapping[str, str]
    only: str | None
    expected: Sequence[str]


def _choose_wanted(
    method: PoseMethod, labels: Mapping[str, str] | None, only: str | None
) -> WantedObjects:
    """Decide which detections are posed, and which objects have a result in every image.

    With ``only``, its detections alone are posed; else those of every object. Every image has a
    result, a refusal where nothing was detected, of these objects:

    - of ``only``, where it is given;
    - else of those in ``labels``, where there are labels;
    - else of all objects, if the method expects all of them in an image; else of none.
    """
    names = [model.name for model in method.models]
    if only is not None:
        expected = [only]
    elif labels is not None:
        # Two classes may be the same object; and "3=" leaves class 3 out, with an empty name.
        expected = [name for name in dict.fromkeys(labels.values()) if name]
    else:
        expected = names if method.expects_all else []
    return WantedObjects(names=names, labels=labels or {}, only=only, expected=expected)


def object_named(name: str | None, method: PoseMethod) -> str:
    """Give the object of ``--object``, which the method must have, or its only object."""
    names = [model.name for model in method.models]
    if name is None and len(names) > 1:
        raise InputError(f"the {method.holder} know {', '.join(names)}; say which by --object")
    if name is not None and name not in names:
        raise InputError(
            f"--object {name}: the {method.holder} do not know it; {suggest_name(name, names)}"
        )
    return names[0] if name is None else name


def camera_settings(camera: Path | float) -> dict[str, Any]:
    """Give the settings of a run that a camera file, or a focal length [px], stands for."""
    if not isinstance(camera, Path):
        return {"focal_px": camera}
    return {"camera": str(camera.resolve()), "camera_sha256": file_sha256(camera)}


def unit_settings(unit: Unit | None) -> dict[str, Any]:
    """Give the settings of a run that ``--unit`` stands for; none where it was left out."""
    return {} if unit is None else {"unit": unit}


def cloud_jobs(cloud: Path, unit: Unit, object: str, out: Path) -> list[PoseJob[Any]]:
    """Make a job of a cloud, or of every cloud of a folder."""
    suffixes = tuple(CLOUD_READERS)
    files = _list_visible(cloud, suffixes) if cloud.is_dir() else [cloud]
    files.sort(key=natural_sort_key)
    if not files:
        raise InputError(f"{cloud}: no {', '.join(suffixes)} file there; give a cloud, or a folder")
    refuse_equal_stems(files)
    refuse_among_inputs(out, [cloud], files)
    jobs: list[PoseJob[Any]] = []
    for path in files:
        read = partial(cloud_input, path, unit, object, path.stem)
        jobs.append(PoseJob(name=path.stem, read=read, object=object, source=path))
    return jobs


def _list_visible(folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
    """List the files of a folder with one of these suffixes, without hidden ones."""
    return [
        path
        for path in folder.iterdir()
        if path.suffix.lower() in suffixes and not path.name.startswith(".")
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
    """Make a job of each object that masks show in depth images.

    ``depth`` and ``mask`` are files, or folders whose files have the same names. A mask that
    numbers several objects gives a job for each: NAME_1, NAME_2, ... All are of ``object``, or each
    of the object that ``labels`` has for its number.
    """
    run_length_files = sorted(mask.glob("*.json")) if mask.is_dir() else []
    depths = _list_depths(depth)
    mask_files = run_length_files or list_images(mask)
    refuse_among_inputs(out, [depth, mask], [*depths, *mask_files])
    masks = _match_to_depths(depths, mask_files, depth, mask, "mask")

    jobs: list[PoseJob[Any]] = []
    for path in depths:
        mask_file = masks[path.stem]
        if labels is not None:
            parts = _split_by_label(mask_file, labels, object)
        else:
            assert object is not None
            parts = _split_by_number(mask_file, object)
        for part in parts:
            name = path.stem + part.ending
            read = partial(view_input, path, part.mask, camera, part.object, name, unit)
            files = (path, mask_file)
            jobs.append(PoseJob(name=name, read=read, object=part.object, source=files))
    _refuse_equal_names(jobs, depth)
    return jobs


class _MaskPart(NamedTuple):
    """An object that a mask shows: what the name of its result ends in, its name, its pixels."""

    ending: str
    object: str
    mask: AnyMask


def _split_by_number(mask: Path, object: str) -> list[_MaskPart]:
    """Split a mask by its numbers, all of one object; a mask with one number stays whole."""
    whole_mask = [_MaskPart("", object, mask)]
    try:
        label_map = read_labels(mask)
    except InputError:  # the job reads the mask again, and is the one to fail
        return whole_mask
    numbers = label_map[label_map != 0].unique().tolist()
    if len(numbers) <= 1:
        return whole_mask
    return [_MaskPart(f"_{k}", object, _run_lengths(label_map == k)) for k in numbers]


def _split_by_label(mask: Path, labels: Mapping[str, str], wanted: str | None) -> list[_MaskPart]:
    """Split a mask by the numbers that ``--labels`` names; only of ``wanted``, if given.

    A number that the mask lacks has an empty part, whose pose is then refused.
    """
    words = [label for label in labels if not label.isdecimal()]
    if words:
        raise InputError(
            f"--labels {words[0]}={labels[words[0]]}: the objects of a mask have numbers; write "
            "1=OBJECT,2=OBJECT"
        )
    objects = {int(label): name for label, name in labels.items()}
    label_map = read_labels(mask, list(objects))
    parts: list[_MaskPart] = []
    for number in sorted(objects):
        object = objects[number]
        is_left_out = not object  # "3=" leaves number 3 out
        if not is_left_out and wanted in (None, object):
            parts.append(_MaskPart(f"_{number}", object, _run_lengths(label_map == number)))
    return parts


def _run_lengths(pixels: Tensor) -> AnyMask:
    """Encode a mask by run lengths, which take less memory than pixels."""
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
    refuse_equal_stems(depths)
    detections = [Detection(object=object, box=parse_box(text)) for text in boxes]
    jobs: list[PoseJob[Any]] = []
    for path in depths:
        jobs += _make_detection_jobs(path, detections, (path,), camera, unit)
    _refuse_equal_names(jobs, depth)
    return jobs


def detection_file_jobs(
    depth: Path,
    detections: Path,
    camera: Path | float,
    wanted: WantedObjects,
    unit: Unit | None,
    out: Path,
) -> list[PoseJob[Any]]:
    """Make a job of each detection in depth images: NAME, or of several NAME_1 (the surest), ...

    ``detections``: a file, or a folder of files with the names of the images.
    """
    depths = _list_depths(depth)
    refuse_equal_stems(depths)
    files = [detections]
    if detections.is_dir():
        files = _list_visible(detections, (".json", ".txt"))
    refuse_among_inputs(out, [depth, detections], [*depths, *files])

    # The detections of each image, from one file of all images or from a file for each.
    by_image: dict[str, list[Detection]] = {}
    if len(files) == 1 and files[0].suffix.lower() == ".json":
        file_of = dict.fromkeys((path.stem for path in depths), files[0])
        images = [path.stem for path in depths]
        by_image = group_by_image(read_detections(files[0]), images, str(files[0]))
    else:
        file_of = _match_to_depths(depths, files, depth, detections, "file of detections")
        for path in depths:
            by_image[path.stem] = _read_detections_of(path, file_of[path.stem])

    # Those of the wanted objects, the surest first.
    jobs: list[PoseJob[Any]] = []
    has_detection = False
    for path in depths:
        file = file_of[path.stem]
        in_image = name_objects(
            by_image[path.stem], wanted.labels, wanted.names, wanted.only, source=str(file)
        )
        in_image.sort(key=lambda detection: -detection.score)
        has_detection |= bool(in_image)
        detected = {detection.object for detection in in_image}
        undetected = [name for name in wanted.expected if name not in detected]
        jobs += _make_detection_jobs(path, in_image, (path, file), camera, unit, undetected)
    if not has_detection:
        raise InputError(f"{detections}: holds no detection of what is asked for in {depth}")
    _refuse_equal_names(jobs, depth)
    return jobs


def _read_detections_of(depth: Path, file: Path) -> list[Detection]:
    """Read the detections of one depth image; YOLO's text files need its size for their shares."""
    size = None
    if file.suffix.lower() == ".txt":
        height, width = read_stored_depth(depth).shape
        size = (width, height)
    return read_detections(file, size)


def _make_detection_jobs(
    path: Path,
    detections: Sequence[Detection],
    files: tuple[Path, ...],
    camera: Path | float,
    unit: Unit | None,
    undetected: Sequence[str] = (),
) -> list[PoseJob[Any]]:
    """Make a job of each detection in a depth image: NAME, or of several NAME_1, NAME_2, ...

    ``undetected``: further objects, which get a job without a detection, and so a refusal.
    """
    jobs: list[PoseJob[Any]] = []
    targets = [(detection.object, detection) for detection in detections]
    targets += [(object, None) for object in undetected]
    for k, (object, detection) in enumerate(targets, 1):
        assert object is not None
        name = path.stem + (f"_{k}" if len(targets) > 1 else "")
        read = partial(read_detection, path, object, detection, camera, name, unit)
        jobs.append(PoseJob(name=name, read=read, object=object, source=files))
    return jobs


def read_detection(
    path: Path,
    object: str,
    detection: Detection | None,
    camera: AnyLens,
    name: str,
    unit: Unit | None,
) -> ViewInput:
    """Read a depth image with the mask or box of a detection; None: with an empty mask."""
    view = view_input(path, None, camera, object, name, unit)
    if detection is None:
        return replace(view, mask=torch.zeros_like(view.mask), is_region=True)
    mask = detection.mask(*view.depth_m.shape)
    return replace(view, mask=mask, is_region=detection.box is not None)


def _match_to_depths(
    depths: Sequence[Path], files: Sequence[Path], depth: Path, source: Path, kind: str
) -> dict[str, Path]:
    """Match files to depth images of the same name; a single file to a single image of any name.

    Args:
        depths: the depth images.
        files: masks, detections or pictures.
        depth: option that names the depth images: one file, or a folder.
        source: option that names the files, for errors.
        kind: what the files are called in errors.

    Returns:
        The file of each depth image, by its stem.
    """
    refuse_equal_stems(depths)
    refuse_equal_stems(files)
    by_name = {path.stem: path for path in files}
    if len(depths) == len(files) == 1 and not depth.is_dir():
        by_name = {depths[0].stem: files[0]}
    missing = [path.stem for path in depths if path.stem not in by_name]
    if missing:
        raise InputError(
            f"{source}: no {kind} called {missing[0]!r}; a {kind} has the name of its depth image"
        )
    return by_name


def _refuse_equal_names(jobs: Sequence[PoseJob[Any]], depth: Path) -> None:
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
    """Make a job of a whole depth image, or of every one of a folder, without masks."""
    depths = _list_depths(depth)
    refuse_among_inputs(out, [depth], depths)
    refuse_equal_stems(depths)
    jobs: list[PoseJob[Any]] = []
    for path in depths:
        read = partial(view_input, path, None, camera, object, path.stem, unit)
        jobs.append(PoseJob(name=path.stem, read=read, object=object, source=path))
    return jobs


def _with_background(plan: JobPlan, inputs: PoseInputs) -> JobPlan:
    """Return a plan whose depth images have the bin or the empty frame, if either is given."""
    background: AnyBackground
    settings = dict(plan.settings)
    if inputs.bin is not None:
        if inputs.bin_pose is None:
            raise InputError(
                f"--bin {inputs.bin}: where is it? Give --bin-pose, a text file with its 4x4 "
                "matrix camera_from_model in metres, or --empty-frame in place of both"
            )
        pose = pose_transforms.read_pose(inputs.bin_pose, "--bin-pose")
        unit = pose_methods.unit_of_cad([inputs.bin], inputs.cad_unit, inputs.unit)
        background = PosedBin.load(inputs.bin, pose, unit)
        settings["bin"] = file_names.name_with_checksum(Path(inputs.bin))
        settings["bin_pose"] = pose.matrix().tolist()
    elif inputs.empty_frame is not None:
        background = Path(inputs.empty_frame)
        settings["empty_frame"] = file_names.name_with_checksum(background)
    else:
        return plan
    jobs: list[PoseJob[Any]] = []
    for job in plan.jobs:
        read = partial(_read_with_background, job.read, background, inputs.lens, inputs.unit)
        jobs.append(replace(job, read=read))
    return JobPlan(jobs=jobs, settings=settings)


def _read_with_background(
    read: Callable[[], ViewInput],
    background: AnyBackground,
    camera: Path | float | None,
    unit: Unit | None,
) -> ViewInput:
    """Read a depth image together with its background."""
    return add_background(read(), background, camera, unit)


def _with_color(
    plan: JobPlan, inputs: PoseInputs, models: Sequence[ObjectModel], out: Path
) -> JobPlan:
    """Return a plan whose depth images have the colour pictures of their names, if any are given.

    ``models``: models of the objects that may be visible.
    """
    if inputs.color is None:
        if inputs.color_camera is not None or inputs.color_from_depth is not None:
            raise InputError("--color-camera and --color-from-depth are of --color; give that too")
        return plan
    if inputs.depth is None:
        raise InputError(f"--color {inputs.color}: is beside --depth; a cloud has no colour image")
    color = Path(inputs.color)
    depth = Path(inputs.depth)
    pictures = list_images(color)
    refuse_among_inputs(out, [color], pictures)
    picture_of = _match_to_depths(_list_depths(depth), pictures, depth, color, "colour picture")
    settings = {**plan.settings, "color": str(color.resolve())}

    # The camera of the pictures, and where the depth camera is in its frame.
    camera = inputs.color_camera
    color_from_depth = None
    if camera is not None:
        settings["color_camera"] = file_names.name_with_checksum(camera)
    if inputs.color_from_depth is not None:
        color_from_depth = pose_transforms.read_pose(
            inputs.color_from_depth, "--color-from-depth", "color_from_depth"
        )
        settings["color_from_depth"] = color_from_depth.matrix().tolist()

    colored: list[PoseJob[Any]] = []
    for job in plan.jobs:
        sources = job.source if isinstance(job.source, tuple) else (job.source,)
        assert sources[0] is not None
        picture = picture_of[sources[0].stem]
        read = partial(_read_colored, job.read, models, picture, camera, color_from_depth)
        colored.append(replace(job, read=read, source=(*sources, picture)))
    return JobPlan(jobs=colored, settings=settings)


def _read_colored(
    read: Callable[[], ViewInput],
    models: Sequence[ObjectModel],
    picture: Path,
    camera: Path | None,
    color_from_depth: Rigid | None,
) -> ViewInput:
    """Read a depth image together with its colour picture."""
    return add_color(read(), models, picture, camera, color_from_depth)


def _list_depths(depth: Path) -> list[Path]:
    """List depth images: a file, or the pictures of a folder; in one without pictures, its maps."""
    try:
        return list_images(depth)
    except InputError:
        maps = [p for p in depth.glob("*") if p.suffix.lower() in MAP_SUFFIXES]
        if not maps:
            raise
        return sorted(maps, key=natural_sort_key)
