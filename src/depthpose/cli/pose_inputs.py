"""What ``depthpose pose predict`` is given: clouds, depth images, data sets, as jobs."""

import re
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from depthpose.cli.pose_methods import EstimateMany, Masks, PoseMethod, match_names
from depthpose.core.checkpoint import file_sha256
from depthpose.core.errors import InputError, nearest_name
from depthpose.core.files import MAP_SUFFIXES, cloud_suffixes, list_images
from depthpose.core.files.disk import natural_order
from depthpose.core.rigid import Rigid
from depthpose.core.run import refuse_among_inputs
from depthpose.core.units import Unit
from depthpose.pose.datasets import BopDataset, encode_rle, object_names, read_labels
from depthpose.pose.estimator.inputs import AnyInput, AnyMask, cloud_input, rigid_input, view_input
from depthpose.pose.predictions import Job, Place
from depthpose.pose.types import PoseEstimate


def object_named(name: str | None, method: PoseMethod) -> str:
    """Give the object that is meant."""
    known = list(method.models_by_name)
    if name is None and len(known) > 1:
        raise InputError(f"the {method.holder} know {', '.join(known)}; say which by --object")
    if name is not None and name not in known:
        raise InputError(
            f"--object {name}: the {method.holder} do not know it; {nearest_name(name, known)}"
        )
    return known[0] if name is None else name


def read_pose(path: Path) -> Rigid:
    """Read the 4x4 matrix of a pose from a text file; brackets and commas do no harm."""
    try:
        words = re.sub(r"[\[\],;]", " ", path.read_text()).split()
        values = torch.tensor([float(word) for word in words], dtype=torch.float64)
    except (OSError, ValueError) as error:
        raise InputError(
            f"--first {path}: cannot be read as numbers ({error}); give a text file with the 4x4 "
            "matrix camera_from_model in metres"
        ) from error
    if len(values) != 16:
        raise InputError(f"--first {path}: {len(values)} numbers; give the 16 of a 4x4 matrix")
    try:
        return rigid_input(values.reshape(4, 4))
    except InputError as error:
        raise InputError(f"--first {path}: {error}") from error


def camera_facts(camera: Path | float) -> dict[str, Any]:
    """Give what of a camera file, or a focal length, decides the poses, for the record of a run."""
    if not isinstance(camera, Path):
        return {"focal_px": camera}
    return {"camera": str(camera.resolve()), "camera_sha256": file_sha256(camera)}


def cloud_jobs(cloud: Path, unit: Unit, object: str, out: Path) -> list[Job[Any]]:
    """Take a cloud, or every one of a folder."""
    known = cloud_suffixes()
    files = [cloud]
    if cloud.is_dir():
        named = [path for path in cloud.iterdir() if not path.name.startswith(".")]
        files = [path for path in named if path.suffix.lower() in known]
    files.sort(key=natural_order)
    if not files:
        raise InputError(f"{cloud}: no {', '.join(known)} file there; give a cloud, or a folder")
    _refuse_one_name(files)
    refuse_among_inputs(out, [cloud], files)
    return [
        input_job(p.stem, object, partial(cloud_input, p, unit, object, p.stem), source=p)
        for p in files
    ]


def view_jobs(
    depth: Path,
    mask: Path,
    camera: Path | float,
    object: str,
    unit: Unit | None,
    out: Path,
) -> list[Job[Any]]:
    """Take a depth image, its mask and its camera, or images and masks of one name in two folders.

    Of a mask that numbers several objects each is an input: NAME_1, NAME_2, ...
    """
    runs = sorted(mask.glob("*.json")) if mask.is_dir() else []  # of run lengths
    depths, pictures = _list_depths(depth), runs or list_images(mask)
    refuse_among_inputs(out, [depth, mask], [*depths, *pictures])
    _refuse_one_name(depths)
    _refuse_one_name(pictures)
    masks = {path.stem: path for path in pictures}
    if len(depths) == len(masks) == 1 and not depth.is_dir():
        masks = {depths[0].stem: next(iter(masks.values()))}
    lost = [path.stem for path in depths if path.stem not in masks]
    if lost:
        raise InputError(
            f"{mask}: no mask called {lost[0]!r}; a mask has the name of its depth image"
        )
    jobs: list[Job[Any]] = []
    for path in depths:
        own: dict[str, AnyMask] = {"": masks[path.stem]}
        with suppress(InputError):  # it will be said where the mask is read
            labels = read_labels(masks[path.stem])
            numbers = labels[labels != 0].unique().tolist()
            runs = {k: encode_rle(labels == k)[0] for k in numbers if len(numbers) > 1}
            size = list(labels.shape)
            own = {f"_{k}": {"size": size, "counts": list(r)} for k, r in runs.items()} or own
        for end, one in own.items():
            name = path.stem + end
            read = partial(view_input, path, one, camera, object, name, unit)
            jobs.append(input_job(name, object, read, source=(path, masks[path.stem])))
    twice = [name for name, count in Counter(job.name for job in jobs).items() if count > 1]
    if twice:
        raise InputError(
            f"{depth}: two results would be called {twice[0]!r}, the name of a depth image and a "
            "number of its mask; rename the other"
        )
    return jobs


def frame_jobs(
    depth: Path, camera: Path | float, object: str, unit: Unit | None, out: Path
) -> list[Job[Any]]:
    """Take whole depth images, without masks."""
    depths = _list_depths(depth)
    refuse_among_inputs(out, [depth], depths)
    _refuse_one_name(depths)
    return [
        input_job(
            p.stem, object, partial(view_input, p, None, camera, object, p.stem, unit), source=p
        )
        for p in depths
    ]


def _list_depths(depth: Path) -> list[Path]:
    """List depth images: pictures, or the maps of a folder without such."""
    try:
        return list_images(depth)
    except InputError:
        maps = [p for p in depth.glob("*") if p.suffix.lower() in MAP_SUFFIXES]
        if not maps:
            raise
        return sorted(maps, key=natural_order)


def _refuse_one_name(files: Sequence[Path]) -> None:
    """Results bear the names of their inputs, without the suffix."""
    first: dict[str, Path] = {}
    for path in files:
        other = first.setdefault(path.stem, path)
        if other != path:
            raise InputError(
                f"{path.parent}: {other.name} and {path.name} would both be {path.stem!r} in the "
                "results; rename one, or move it to another folder"
            )


def chosen_objects(dataset: BopDataset, method: PoseMethod, object: str | None) -> BopDataset:
    """Keep the objects of a data set that the weights know, and say others; or the one named."""
    numbers = {model.name: model.number for model in method.models}
    if object is not None:
        is_theirs = object in object_names(dataset.folder).values()
        return dataset.of_objects(object if is_theirs else numbers.get(object, object))
    there = sorted({instance.object_id for instance in dataset.instances})
    known = [n for n in there if n in numbers.values() or dataset.objects[n].name in numbers]
    left_out = sorted(set(there) - set(known))
    if not known:
        raise InputError(
            f"{dataset.folder}: holds objects {left_out}, but the {method.holder} know "
            f"{', '.join(numbers)}; give {method.holder} of its objects"
        )
    if left_out:
        said = f"left out, as the {method.holder} do not know them: objects {left_out}"
        print(said, file=sys.stderr)
    return dataset.of_objects(*known)


def bop_jobs(dataset: BopDataset, masks: Masks, method: PoseMethod) -> list[Job[Any]]:
    """Take the instances of a data set by some masks."""
    names = match_names(dataset, method.models)
    jobs = masks.jobs(names)
    return [_safe(job, names[job.place.object_id]) for job in jobs if job.place is not None]


def input_job(
    name: str,
    object: str,
    read: Callable[[], AnyInput],
    place: Place | None = None,
    source: Path | tuple[Path, ...] | None = None,
) -> Job[Any]:
    """Take one input; one that cannot be read stops no other."""
    return _safe(Job(name=name, read=read, place=place, source=source), object)


def _safe(job: Job[Any], object: str) -> Job[Any]:
    """Let the job of what cannot be read give the estimate that says so."""

    def read() -> AnyInput | PoseEstimate:
        try:
            return job.read()
        except InputError as error:
            said = f"cannot be read: {error}"
            return PoseEstimate(name=job.name, object=object, status="unreadable", reason=said)

    return replace(job, read=read)


def safely(method: PoseMethod) -> EstimateMany:
    """Let a method skip what could not be read."""

    def estimate_many(inputs: Sequence[Any]) -> list[PoseEstimate]:
        readable = [one for one in inputs if not isinstance(one, PoseEstimate)]
        estimates = iter(method.estimate_many(readable))
        return [one if isinstance(one, PoseEstimate) else next(estimates) for one in inputs]

    return estimate_many
