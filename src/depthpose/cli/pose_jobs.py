"""Inputs of the pose commands: files become jobs, each of which reads one input."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from depthpose.cli import pose_methods
from depthpose.cli.pose_methods import PoseMethod
from depthpose.cli.pose_options import PoseInputs
from depthpose.core.camera import AnyLens
from depthpose.core.checkpoint import file_sha256
from depthpose.core.errors import InputError, nearest_name
from depthpose.core.files import CLOUD_READERS, MAP_SUFFIXES, list_images, read_stored_depth
from depthpose.core.files.disk import natural_order
from depthpose.core.files.images import refuse_among_inputs
from depthpose.core.rigid import Rigid
from depthpose.core.units import Unit
from depthpose.pose.background import AnyBackground, PosedBin, with_background
from depthpose.pose.color_inputs import with_color
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
    """Jobs, and the JSON values that decide their results beside those of the method."""

    jobs: list[PoseJob[Any]]
    settings: dict[str, Any]


def plan_jobs(method: PoseMethod, inputs: PoseInputs, out: Path) -> JobPlan:
    """Plan to pose clouds, or the parts of depth images that masks, boxes or detections show."""
    if inputs.cloud is not None:
        name = object_named(inputs.object, method)
        unit = inputs.unit or "m"
        jobs = cloud_jobs(Path(inputs.cloud), unit, name, out)
        plan = JobPlan(jobs=jobs, settings={"object": name, "unit": unit})
    else:
        plan = _plan_regions(method, inputs, out)
    posed = {job.object for job in plan.jobs}
    models = [model for model in method.models if model.name in posed]
    return _with_color(_with_background(plan, inputs), inputs, models, out)


def plan_searches(
    method: PoseMethod, inputs: PoseInputs, objects: Sequence[str], out: Path
) -> JobPlan:
    """Plan to search whole depth images for objects."""
    lens = inputs.camera or inputs.focal_px
    assert inputs.depth is not None
    assert lens is not None
    jobs = frame_jobs(Path(inputs.depth), lens, objects[0], inputs.unit, out)
    settings = {"find": sorted(objects), **camera_facts(lens), **unit_facts(inputs.unit)}
    plan = JobPlan(jobs=jobs, settings=settings)
    models = [model for model in method.models if model.name in objects]
    return _with_color(_with_background(plan, inputs), inputs, models, out)


def _plan_regions(method: PoseMethod, inputs: PoseInputs, out: Path) -> JobPlan:
    """Plan to pose what masks, boxes or detections show in depth images."""
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
    settings = {**camera_facts(lens), **unit_facts(unit)}
    if labels is not None:
        settings["labels"] = labels
    if wanted is not None:
        settings["object"] = wanted

    if inputs.detections is not None:
        settings["detections"] = str(Path(inputs.detections).resolve())
        objects = (labels or {}, known_names, wanted)
        file = Path(inputs.detections)
        if wanted is not None:
            asked = [wanted]
        elif labels is not None:
            asked = [name for name in dict.fromkeys(labels.values()) if name]
        else:  # CAD files are asked for by being given, objects of weights are not
            asked = known_names if method.expects_all else []
        jobs = detection_file_jobs(depth, file, lens, objects, asked, unit, out)
        return JobPlan(jobs=jobs, settings=settings)
    if inputs.box:
        settings["box"] = list(inputs.box)
        name = object_named(inputs.object, method)
        jobs = box_jobs(depth, inputs.box, lens, name, unit, out)
        return JobPlan(jobs=jobs, settings=settings)
    assert inputs.mask is not None
    mask = Path(inputs.mask)
    settings["mask"] = str(mask.resolve())
    if wanted is None and labels is None:
        raise InputError(
            f"the {method.holder} know {', '.join(known_names)}; say which by --object, or which "
            f"number of the mask is which by --labels 1={known_names[0]},2={known_names[1]}"
        )
    jobs = mask_jobs(depth, mask, lens, wanted, unit, out, labels)
    return JobPlan(jobs=jobs, settings=settings)


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


def unit_facts(unit: Unit | None) -> dict[str, Any]:
    """Give the unit of clouds or depth images for the record, where one is given."""
    return {} if unit is None else {"unit": unit}


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


def _with_background(plan: JobPlan, inputs: PoseInputs) -> JobPlan:
    """Give each depth image the known bin or empty frame, if there is one."""
    lens = inputs.camera or inputs.focal_px
    background: AnyBackground
    settings = dict(plan.settings)
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
        return plan
    jobs = [
        replace(job, read=partial(_read_with_background, job.read, background, lens, inputs.unit))
        for job in plan.jobs
    ]
    return JobPlan(jobs=jobs, settings=settings)


def _read_with_background(
    read: Callable[[], ViewInput],
    background: AnyBackground,
    camera: Path | float | None,
    unit: Unit | None,
) -> ViewInput:
    return with_background(read(), background, camera, unit)


def _with_color(
    plan: JobPlan, inputs: PoseInputs, models: Sequence[ObjectModel], out: Path
) -> JobPlan:
    """Give each depth image the colour picture of its name, where such pictures are given.

    ``models``: those that may be there.
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
    beside = _beside_depths(_list_depths(depth), pictures, depth, color, "colour picture")
    settings = {**plan.settings, "color": str(color.resolve())}

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
    for job in plan.jobs:
        sources = job.source if isinstance(job.source, tuple) else (job.source,)
        assert sources[0] is not None
        picture = beside[sources[0].stem]
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
