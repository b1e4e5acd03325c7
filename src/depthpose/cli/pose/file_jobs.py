"""Files of the user become jobs, each of which reads one cloud or (masked) depth image."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Int64
from torch import Tensor

from depthpose.core.camera import AnyLens
from depthpose.core.errors import InputError
from depthpose.core.files import (
    CLOUD_READERS,
    MAP_SUFFIXES,
    image_size,
    list_images,
    read_stored_depth,
)
from depthpose.core.files.disk import natural_sort_key, refuse_equal_stems
from depthpose.core.files.images import refuse_among_inputs
from depthpose.core.units import Unit
from depthpose.pose.datasets import (
    Detection,
    encode_rle,
    group_by_image,
    mask_view,
    name_objects,
    parse_box,
    read_detections,
    read_labels,
)
from depthpose.pose.inputs import AnyMask, cloud_input, view_input
from depthpose.pose.predictions import PoseJob
from depthpose.pose.types import ViewInput


@dataclass(frozen=True, kw_only=True)
class WantedObjects:
    """The objects whose detections are posed."""

    names: Sequence[str]  #: names of all objects of the method
    labels: Mapping[str, str]  #: object of a detector's class, where the class has another name
    only: str | None  #: the only object whose detections are posed; None: all
    expected: Sequence[str]  #: objects that have a result in every image, detected there or not


def make_cloud_jobs(cloud: Path, unit: Unit, object: str, out: Path) -> list[PoseJob[Any]]:
    """Make a job of a cloud, or of every cloud of a folder.

    Args:
        cloud: file or folder.
        unit: unit of the numbers in the files.
        object: name of the object that they show.
        out: folder of the results, which may not lie among the clouds.

    Raises:
        InputError: there is no cloud, or two have one name.
    """
    suffixes = tuple(CLOUD_READERS)
    files = _list_visible_files(cloud, suffixes) if cloud.is_dir() else [cloud]
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


def _list_visible_files(folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
    """List the files of a folder with one of these suffixes, without hidden ones."""
    return [
        path
        for path in folder.iterdir()
        if path.suffix.lower() in suffixes and not path.name.startswith(".")
    ]


def make_mask_jobs(
    depth: Path,
    mask: Path,
    camera: Path | float,
    object: str | None,
    unit: Unit | None,
    out: Path,
    labels: Mapping[str, str] | None = None,
) -> list[PoseJob[Any]]:
    """Make a job of each object that masks show in depth images.

    A mask that numbers several objects gives a job for each: NAME_1, NAME_2, ...

    Args:
        depth: a depth image, or a folder of them.
        mask: its mask, or a folder of masks with the names of the depth images.
        camera: camera file, or focal length [px].
        object: name of the object that all masks show; may be None beside ``labels``.
        unit: unit of the depth images; None: the camera says it.
        out: folder of the results, which may not lie among the inputs.
        labels: name of the object by the number in a mask; None: every number is an ``object``.

    Raises:
        InputError: files are missing or do not match, or two results would have one name.
    """
    # The mask of each depth image. If a folder has files of run lengths (.json), its pictures are
    # not taken.
    run_length_files = sorted(mask.glob("*.json")) if mask.is_dir() else []
    depth_files = list_depths(depth)
    mask_files = run_length_files or list_images(mask)
    refuse_among_inputs(out, [depth, mask], [*depth_files, *mask_files])
    mask_of_depth = match_to_depths(depth_files, mask_files, depth, mask, "mask")

    jobs: list[PoseJob[Any]] = []
    for depth_file in depth_files:
        mask_file = mask_of_depth[depth_file.stem]
        if labels is not None:
            parts = _split_by_label(mask_file, labels, object)
        else:
            assert object is not None
            parts = _split_by_number(mask_file, object)
        for part in parts:
            name = depth_file.stem + part.ending
            read = partial(view_input, depth_file, part.mask, camera, part.object, name, unit)
            source = (depth_file, mask_file)
            jobs.append(PoseJob(name=name, read=read, object=part.object, source=source))
    _refuse_equal_names(jobs, depth)
    return jobs


class _MaskPart(NamedTuple):
    """An object that a mask shows."""

    ending: str  #: end of the name of its result, after that of the depth image
    object: str  #: name of the object
    mask: AnyMask  #: its pixels


def _split_by_number(mask: Path, object: str) -> list[_MaskPart]:
    """Split a mask by its numbers, all of one object; a mask with one number stays whole."""
    whole_mask = [_MaskPart(ending="", object=object, mask=mask)]
    label_map = _try_read_labels(mask)
    if label_map is None:  # the job reads the mask again, and is the one to fail
        return whole_mask
    numbers = label_map[label_map != 0].unique().tolist()
    if len(numbers) <= 1:
        return whole_mask
    parts: list[_MaskPart] = []
    for number in numbers:
        part_mask = _encode_run_lengths(label_map == number)
        parts.append(_MaskPart(ending=f"_{number}", object=object, mask=part_mask))
    return parts


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
    is_readable = _try_read_labels(mask) is not None
    label_map = read_labels(mask, list(objects)) if is_readable else None
    parts: list[_MaskPart] = []
    for number in sorted(objects):
        object = objects[number]
        is_left_out = not object  # "3=" leaves number 3 out
        if not is_left_out and wanted in (None, object):
            # A job reads a mask that cannot be read again, and is the one to fail.
            part_mask = mask if label_map is None else _encode_run_lengths(label_map == number)
            parts.append(_MaskPart(ending=f"_{number}", object=object, mask=part_mask))
    return parts


def _try_read_labels(mask: Path) -> Int64[Tensor, "h w"] | None:
    """Read the numbers of a mask; None where it cannot be read."""
    try:
        return read_labels(mask)
    except InputError:
        return None


def _encode_run_lengths(pixels: Tensor) -> AnyMask:
    """Encode a mask by run lengths, which take less memory than pixels."""
    counts, height, width = encode_rle(pixels)
    return {"size": [height, width], "counts": list(counts)}


def make_box_jobs(
    depth: Path,
    boxes: Sequence[str],
    camera: Path | float,
    object: str,
    unit: Unit | None,
    out: Path,
) -> list[PoseJob[Any]]:
    """Make a job of each box in each depth image: NAME, or of several NAME_1, NAME_2, ...

    Args:
        depth: a depth image, or a folder of them.
        boxes: each left, top, right and bottom edge [px], as ``X0,Y0,X1,Y1``.
        camera: camera file, or focal length [px].
        object: name of the object in all boxes.
        unit: unit of the depth images; None: the camera says it.
        out: folder of the results, which may not lie among the inputs.

    Raises:
        InputError: files are missing, a box has no four edges, or two results would have one name.
    """
    depths = list_depths(depth)
    refuse_among_inputs(out, [depth], depths)
    refuse_equal_stems(depths)
    detections = [Detection(object=object, box=parse_box(text)) for text in boxes]
    jobs: list[PoseJob[Any]] = []
    for path in depths:
        jobs += _make_jobs_in_image(path, detections, (path,), camera, unit)
    _refuse_equal_names(jobs, depth)
    return jobs


def make_detection_jobs(
    depth: Path,
    detections: Path,
    camera: Path | float,
    wanted: WantedObjects,
    unit: Unit | None,
    out: Path,
) -> list[PoseJob[Any]]:
    """Make a job of each detection in depth images: NAME, or of several NAME_1 (the surest), ...

    Args:
        depth: a depth image, or a folder of them.
        detections: a file, or a folder of files with the names of the images.
        camera: camera file, or focal length [px].
        wanted: the objects whose detections are posed.
        unit: unit of the depth images; None: the camera says it.
        out: folder of the results, which may not lie among the inputs.

    Raises:
        InputError: files are missing or do not match, or hold no detection of these objects.
    """
    depths = list_depths(depth)
    refuse_equal_stems(depths)
    files = [detections]
    if detections.is_dir():
        files = _list_visible_files(detections, (".json", ".txt"))
    refuse_among_inputs(out, [depth, detections], [*depths, *files])

    # The detections of each image, from one file of all images or from a file for each.
    by_image: dict[str, list[Detection]] = {}
    if len(files) == 1 and files[0].suffix.lower() == ".json":
        file_of = dict.fromkeys((path.stem for path in depths), files[0])
        images = [path.stem for path in depths]
        by_image = group_by_image(read_detections(files[0]), images, str(files[0]))
    else:
        file_of = match_to_depths(depths, files, depth, detections, "file of detections")
        for path in depths:
            by_image[path.stem] = _read_detections_of(path, file_of[path.stem])

    # Those of the wanted objects, the surest first.
    jobs: list[PoseJob[Any]] = []
    has_detection = False
    for path in depths:
        file = file_of[path.stem]
        named = name_objects(
            by_image[path.stem], wanted.labels, wanted.names, wanted.only, source=str(file)
        )
        named.sort(key=lambda detection: -detection.score)
        has_detection |= bool(named)
        detected_objects = {detection.object for detection in named}
        undetected = [name for name in wanted.expected if name not in detected_objects]
        jobs += _make_jobs_in_image(path, named, (path, file), camera, unit, undetected)
    if not has_detection:
        raise InputError(f"{detections}: holds no detection of what is asked for in {depth}")
    _refuse_equal_names(jobs, depth)
    return jobs


def _read_detections_of(depth: Path, file: Path) -> list[Detection]:
    """Read the detections of one depth image; YOLO's text files need its size for their shares."""
    size = None
    if file.suffix.lower() == ".txt":
        if depth.suffix.lower() in MAP_SUFFIXES:
            height, width = read_stored_depth(depth).shape
            size = (width, height)
        else:  # without its pixels, which may be damaged: the job reads them
            size = image_size(depth)
    return read_detections(file, size)


def _make_jobs_in_image(
    path: Path,
    detections: Sequence[Detection],
    files: tuple[Path, ...],
    camera: Path | float,
    unit: Unit | None,
    undetected: Sequence[str] = (),
) -> list[PoseJob[Any]]:
    """Make a job of each detection in a depth image: NAME, or of several NAME_1, NAME_2, ...

    Args:
        path: the depth image.
        detections: the detections in it, each with its object.
        files: all files that the jobs read.
        camera: camera file, or focal length [px].
        unit: unit of the depth image; None: the camera says it.
        undetected: further objects, which get a job without a detection, and so a refusal.
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
    """Read a depth image with the mask or box of a detection; without one the mask is empty.

    Args:
        path: the depth image.
        object: name of the object.
        detection: where it is; None: nowhere.
        camera: camera of the depth image, in any form.
        name: name of the result.
        unit: unit of the depth image; None: the camera says it.

    Raises:
        InputError: the image cannot be read, or has no unit.
    """
    view = view_input(path, None, camera, object, name, unit)
    if detection is None:
        return replace(view, mask=torch.zeros_like(view.mask), is_region=True)
    return mask_view(view, detection)


def match_to_depths(
    depths: Sequence[Path], files: Sequence[Path], depth: Path, source: Path, kind: str
) -> dict[str, Path]:
    """Match files to depth images of the same name; a single file to a single image of any name.

    Args:
        depths: the depth images.
        files: masks, detections or pictures.
        depth: path that was given for the depth images: one file, or their folder.
        source: path that was given for the files, for errors.
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


def make_depth_jobs(
    depth: Path, camera: Path | float, object: str, unit: Unit | None, out: Path
) -> list[PoseJob[Any]]:
    """Make a job of a whole depth image, or of every one of a folder, without masks.

    Args:
        depth: file or folder.
        camera: camera file, or focal length [px].
        object: an object that may be in them.
        unit: unit of the depth images; None: the camera says it.
        out: folder of the results, which may not lie among the inputs.

    Raises:
        InputError: there is no depth image, or two have one name.
    """
    depths = list_depths(depth)
    refuse_among_inputs(out, [depth], depths)
    refuse_equal_stems(depths)
    jobs: list[PoseJob[Any]] = []
    for path in depths:
        read = partial(view_input, path, None, camera, object, path.stem, unit)
        jobs.append(PoseJob(name=path.stem, read=read, object=object, source=path))
    return jobs


def list_depths(depth: Path) -> list[Path]:
    """List depth images: a file, or the pictures of a folder; in one without pictures, its maps."""
    try:
        return list_images(depth)
    except InputError:
        maps = [p for p in depth.glob("*") if p.suffix.lower() in MAP_SUFFIXES]
        if not maps:
            raise
        return sorted(maps, key=natural_sort_key)
