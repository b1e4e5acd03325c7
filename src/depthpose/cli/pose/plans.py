"""What pose commands estimate: their options become jobs and the settings that decide results."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from depthpose.cli import file_names
from depthpose.cli.pose.file_jobs import (
    WantedObjects,
    list_depths,
    make_box_jobs,
    make_cloud_jobs,
    make_depth_jobs,
    make_detection_jobs,
    make_mask_jobs,
    match_to_depths,
)
from depthpose.cli.pose.methods import PoseMethod, find_cad_unit, resolve_object
from depthpose.cli.pose.options import PoseInputs
from depthpose.cli.pose.transforms import read_pose
from depthpose.core.checkpoint import file_sha256
from depthpose.core.errors import InputError
from depthpose.core.files import list_images
from depthpose.core.files.images import refuse_among_inputs
from depthpose.core.rigid import Rigid
from depthpose.core.units import Unit
from depthpose.pose.background import AnyBackground, PosedBin, add_background
from depthpose.pose.color_inputs import add_color
from depthpose.pose.datasets import parse_labels
from depthpose.pose.predictions import PoseJob
from depthpose.pose.types import ObjectModel, ViewInput


@dataclass(frozen=True, kw_only=True)
class JobPlan:
    """The jobs of a run, and what decides their results."""

    jobs: list[PoseJob[Any]]
    settings: dict[str, Any]  #: JSON values beside those of the method


def plan_jobs(method: PoseMethod, inputs: PoseInputs, out: Path) -> JobPlan:
    """Make the jobs of clouds, or of the masks, boxes or detections in depth images.

    Args:
        method: estimates the poses.
        inputs: options that name the files.
        out: folder of the results, which may not lie among the inputs.

    Raises:
        InputError: options or files are missing, or contradict each other.
    """
    if inputs.cloud is not None:
        name = resolve_object(inputs.object, method)
        unit = inputs.unit or "m"
        jobs = make_cloud_jobs(Path(inputs.cloud), unit, name, out)
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
    """Make the jobs of whole depth images, which are searched for objects.

    Args:
        method: finds the objects.
        inputs: options that name the files.
        objects: names of the objects, one at least.
        out: folder of the results, which may not lie among the inputs.

    Raises:
        InputError: files are missing, or contradict each other.
    """
    assert inputs.depth is not None
    assert inputs.lens is not None
    # A job has a single object: here any one, since the search looks for all of them.
    jobs = make_depth_jobs(Path(inputs.depth), inputs.lens, objects[0], inputs.unit, out)
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
    """Make the jobs of what masks, boxes or detections show in depth images.

    The arguments and errors are those of :func:`plan_jobs`.
    """
    assert inputs.depth is not None
    assert inputs.lens is not None

    # What may be in the images: one object, named or the only one, or those that labels name.
    names = [model.name for model in method.models]
    labels = None if inputs.labels is None else parse_labels(inputs.labels, names)
    object = None
    if inputs.object is not None or len(names) == 1:
        object = resolve_object(inputs.object, method)
    settings = {**camera_settings(inputs.lens), **unit_settings(inputs.unit)}
    if labels is not None:
        settings["labels"] = labels
    if object is not None:
        settings["object"] = object

    depth = Path(inputs.depth)
    if inputs.detections is not None:
        detections = Path(inputs.detections)
        settings["detections"] = str(detections.resolve())
        wanted = _choose_wanted_objects(method, labels, object)
        jobs = make_detection_jobs(depth, detections, inputs.lens, wanted, inputs.unit, out)
    elif inputs.box:
        settings["box"] = list(inputs.box)
        box_object = resolve_object(inputs.object, method)
        jobs = make_box_jobs(depth, inputs.box, inputs.lens, box_object, inputs.unit, out)
    else:
        assert inputs.mask is not None
        mask = Path(inputs.mask)
        settings["mask"] = str(mask.resolve())
        if object is None and labels is None:
            raise InputError(
                f"the {method.holder} know {', '.join(names)}; say which by --object, or which "
                f"number of the mask is which by --labels 1={names[0]},2={names[1]}"
            )
        jobs = make_mask_jobs(depth, mask, inputs.lens, object, inputs.unit, out, labels)
    return JobPlan(jobs=jobs, settings=settings)


def _choose_wanted_objects(
    method: PoseMethod, labels: Mapping[str, str] | None, only: str | None
) -> WantedObjects:
    """Choose whose detections are posed, and which objects have a result in every image.

    With ``only``, its detections alone are posed; else those of every object. Every image has a
    result, a refusal where nothing was detected, of these objects:

    - of ``only``, where it is given;
    - else of those in ``labels``, where there are labels;
    - else of all objects, if the method expects all of them in an image; else of none.

    Args:
        method: estimates the poses.
        labels: the object of each class of the detector, or None where classes are named so.
        only: the object of ``--object``; None: it was left out.
    """
    names = [model.name for model in method.models]
    if only is not None:
        expected = [only]
    elif labels is not None:
        # Two classes may be the same object; and "3=" leaves class 3 out, with an empty name.
        expected = [name for name in dict.fromkeys(labels.values()) if name]
    else:
        expected = names if method.estimator.expects_all else []
    return WantedObjects(names=names, labels=labels or {}, only=only, expected=expected)


def camera_settings(camera: Path | float) -> dict[str, Any]:
    """List the settings of a run with this camera: a file, or a focal length [px]."""
    if not isinstance(camera, Path):
        return {"focal_px": camera}
    return {"camera": str(camera.resolve()), "camera_sha256": file_sha256(camera)}


def unit_settings(unit: Unit | None) -> dict[str, Any]:
    """List the settings of a run with this ``--unit``; none where it was left out."""
    return {} if unit is None else {"unit": unit}


def _with_background(plan: JobPlan, inputs: PoseInputs) -> JobPlan:
    """Return the plan with the bin or empty frame behind its depth images, if one is given."""
    background: AnyBackground
    if inputs.bin is not None:
        background, settings = _load_bin(inputs.bin, inputs)
    elif inputs.empty_frame is not None:
        background = Path(inputs.empty_frame)
        settings = {"empty_frame": file_names.name_with_checksum(background)}
    else:
        return plan
    jobs: list[PoseJob[Any]] = []
    for job in plan.jobs:
        read = partial(_read_with_background, job.read, background, inputs.lens, inputs.unit)
        jobs.append(replace(job, read=read))
    return JobPlan(jobs=jobs, settings={**plan.settings, **settings})


def _load_bin(file: str, inputs: PoseInputs) -> tuple[PosedBin, dict[str, Any]]:
    """Load the CAD file of a bin and its pose.

    Returns:
        The bin, and the JSON values that it adds to the settings.

    Raises:
        InputError: the unit is missing, or a file cannot be read.
    """
    assert inputs.bin_pose is not None
    pose = read_pose(inputs.bin_pose, "--bin-pose")
    unit = find_cad_unit([file], inputs.cad_unit, inputs.unit)
    settings = {
        "bin": file_names.name_with_checksum(Path(file)),
        "bin_pose": pose.matrix().tolist(),
    }
    return PosedBin.load(file, pose, unit), settings


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
    """Return the plan with the colour pictures beside its depth images, if any are given.

    Args:
        plan: the jobs without them.
        inputs: options that name the pictures and their camera.
        models: models of the objects that may be visible.
        out: folder of the results, which may not lie among the pictures.

    Raises:
        InputError: a depth image has no picture.
    """
    if inputs.color is None:
        return plan
    assert inputs.depth is not None
    color = Path(inputs.color)
    depth = Path(inputs.depth)
    pictures = list_images(color)
    refuse_among_inputs(out, [color], pictures)
    picture_of = match_to_depths(list_depths(depth), pictures, depth, color, "colour picture")
    settings = {**plan.settings, "color": str(color.resolve())}

    # The camera of the pictures, and where the depth camera is in its frame.
    camera = inputs.color_camera
    color_from_depth = None
    if camera is not None:
        settings["color_camera"] = file_names.name_with_checksum(camera)
    if inputs.color_from_depth is not None:
        color_from_depth = read_pose(
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
