"""The work behind ``depthpose pose predict``, here or by an engine."""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any

from tqdm import tqdm

from depthpose.cli import pose_methods
from depthpose.cli.engine import EngineOptions, Weights, print_shards
from depthpose.cli.pose_jobs import object_named, plan_jobs, read_detection
from depthpose.cli.pose_methods import PoseMethod, PoseMethodSource
from depthpose.cli.pose_options import DataSetOptions, PoseInputs
from depthpose.cli.pose_output import (
    claim_for_dataset,
    claim_for_jobs,
    print_result,
    write_files,
)
from depthpose.core import run
from depthpose.core.camera import Camera, camera_of
from depthpose.core.checkpoint import find_weights
from depthpose.core.config import config_to_dict
from depthpose.core.engine import Files, Function, Inputs, Sample, Work
from depthpose.core.errors import InputError
from depthpose.core.files import CLOUD_READERS, image_size, write_json
from depthpose.core.files.images import LISTED_SUFFIXES
from depthpose.core.runner import Job, Results, run_jobs
from depthpose.core.units import Unit
from depthpose.pose.config import EstimateConfig
from depthpose.pose.datasets import Box, Detection, open_bop, parse_box, read_targets
from depthpose.pose.evaluate import select_targets
from depthpose.pose.inputs import cloud_input, view_input
from depthpose.pose.predictions import (
    PoseJob,
    Prediction,
    earlier_predictions,
    predict,
    prediction_row,
    write_predictions,
)
from depthpose.pose.types import PoseEstimate

ENDING = "pose.json"  # of the one file of a result: an entry of poses.json


def predict_files(method: PoseMethod, inputs: PoseInputs, out: Path, batch: int) -> int:
    """Pose clouds, or parts of depth images, in this process; give the exit code."""
    plan = plan_jobs(method, inputs, out)
    settings = {**method.settings, **plan.settings}
    claim_for_jobs(out, settings, plan.jobs)
    predictions = estimate_jobs(method, plan.jobs, out, settings, batch)
    if predictions is None:
        return 0
    write_files(predictions, plan.jobs, out, method)
    return print_result(predictions, out)


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
                read_detection, sample.files[0], object, detection, camera, sample.name, unit
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
