"""The run of ``depthpose pose predict``, in this process or by an engine."""

import math
import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any

from tqdm import tqdm

from depthpose.cli.engine import EngineOptions, print_shards
from depthpose.cli.pose.dataset import choose_objects, dataset_settings, match_names, open_dataset
from depthpose.cli.pose.file_jobs import read_detection
from depthpose.cli.pose.masks import prepare_masks
from depthpose.cli.pose.methods import (
    PoseMethod,
    PoseMethodSpec,
    PoseNetworkSpec,
    resolve_object,
)
from depthpose.cli.pose.options import DataSetOptions, PoseInputs
from depthpose.cli.pose.output import (
    claim_for_dataset,
    claim_for_jobs,
    print_result,
    write_files,
)
from depthpose.cli.pose.plans import plan_jobs
from depthpose.core import run_folder
from depthpose.core.camera import Camera, camera_of
from depthpose.core.config import config_to_dict
from depthpose.core.engine import Computation, InputFormat, JobInputs, LocalInput, ResultWriter
from depthpose.core.errors import InputError
from depthpose.core.files import CLOUD_READERS, image_size, write_json
from depthpose.core.files.images import LISTED_SUFFIXES
from depthpose.core.processes import find_rank, wait_for
from depthpose.core.runner import Job, Results, run_jobs
from depthpose.core.units import Unit
from depthpose.pose.config import EstimateConfig
from depthpose.pose.datasets import Box, Detection, parse_box
from depthpose.pose.inputs import cloud_input, view_input
from depthpose.pose.predictions import (
    POSES,
    PoseJob,
    PoseResults,
    Prediction,
    prediction_row,
    read_earlier_predictions,
    write_predictions,
)
from depthpose.pose.types import PoseEstimate

ENDING = "pose.json"
"""Ending of the file of one estimate in a shard: an entry of ``poses.json``."""
_REREAD_INTERVAL_S = 1.0
"""How often the predictions of other processes are read again."""


def predict_poses_of_files(method: PoseMethod, inputs: PoseInputs, out: Path, batch: int) -> int:
    """Pose clouds, or masked parts of depth images, write their files, and return the exit code.

    Args:
        method: estimates the poses.
        inputs: options that name the files.
        out: folder of the results.
        batch: inputs that are estimated together.
    """
    plan = plan_jobs(method, inputs, out)
    settings = {**method.settings, **plan.settings}
    claim_for_jobs(out, settings, plan.jobs)
    predictions = estimate_jobs(method, plan.jobs, out, settings, batch)
    if predictions is None:
        return 0
    write_files(predictions, plan.jobs, out, method)
    return print_result(predictions, out)


def predict_poses_of_dataset(
    method: PoseMethod,
    options: DataSetOptions,
    object: str | None,
    config: EstimateConfig,
    out: Path,
    batch: int,
) -> int:
    """Pose the objects of a dataset, write the files of the poses, and return the exit code.

    Args:
        method: estimates the poses.
        options: the dataset, and its masks.
        object: name or number of the only object that is posed; None: all that the method has.
        config: settings of the estimator; its device also segments, where masks are segmented.
        out: folder of the results.
        batch: views that are estimated together.
    """
    assert options.bop is not None
    dataset = open_dataset(options.bop, options.split, options.targets)
    dataset = choose_objects(dataset, method, object)
    (masks,) = prepare_masks([options.masks], dataset, out, config.device)
    jobs = masks.make_jobs(match_names(dataset, method.models))
    settings = {
        **method.settings,
        **dataset_settings(dataset),
        "masks": masks.name,
        **masks.settings,
    }
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
    """Estimate what is not finished; several processes each write their share to a folder.

    Args:
        method: estimates the poses.
        jobs: the inputs of all processes.
        out: folder of the results, which is claimed before.
        settings: JSON values that decide the results.
        batch: inputs that are estimated together.

    Returns:
        The predictions of all jobs, in their order; None in every process but the first.
    """
    process = find_rank()
    process_folder = out
    if process.world > 1:
        process_folder = out / f"part-{process.rank}"
        run_folder.claim_folder(process_folder, settings, [POSES])

    results = PoseResults[Any](process_folder, out)
    estimated = estimate_unfinished(method, process.share_of(jobs), results, batch)
    if process.rank > 0:
        return None

    # The first process joins the files of all, and keeps what earlier runs posed of other inputs.
    if process.world > 1:
        _wait_for_predictions(out, jobs)
    by_name = read_earlier_predictions(out) | estimated
    if process.world > 1:
        # What another process could not read may be a failure of an earlier run, which that
        # process is still to try again: it is tried here too.
        failed = [
            job
            for job in jobs
            if job.name not in estimated and by_name[job.name].estimate.status == "unreadable"
        ]
        if failed:
            results = PoseResults[Any](process_folder, out)
            by_name |= estimate_unfinished(method, failed, results, batch)
    predictions = [by_name.pop(job.name) for job in jobs]
    write_predictions(out, [*by_name.values(), *predictions])
    return predictions


def estimate_unfinished(
    method: PoseMethod,
    jobs: Sequence[PoseJob[Any]],
    results: PoseResults[Any],
    batch: int,
    label: str | None = None,
) -> dict[str, Prediction]:
    """Estimate the jobs without a result in this process.

    Args:
        method: estimates the poses.
        jobs: the inputs, finished ones too.
        results: where the results are stored.
        batch: inputs that are estimated together. Each then takes an equal share of the time.
        label: what the bar of progress says.

    Returns:
        The new predictions by name.

    Raises:
        InputError: an input that ``results`` must have cannot be read.
    """
    estimated: dict[str, Prediction] = {}
    with closing(run_jobs(jobs, method.estimate_many, results, batch)) as outcomes:
        for outcome in tqdm(outcomes, label, total=len(jobs), disable=None, unit=" poses"):
            name = outcome.job.name
            is_new = outcome.result is not None or outcome.failure is not None
            if is_new:
                estimated[name] = results.predictions[name]
    return estimated


@dataclass
class _WrittenNames:
    """The names of the predictions that all processes have written to the folders of a run."""

    out: Path
    names: set[str] = field(default_factory=set)
    read_s: float = -math.inf  #: when the files were read last

    def has(self, name: str) -> bool:
        """Whether a prediction of this name is written; the files are read once a second."""
        if name not in self.names and time.monotonic() - self.read_s > _REREAD_INTERVAL_S:
            self.names = set(read_earlier_predictions(self.out))
            self.read_s = time.monotonic()
        return name in self.names


def _wait_for_predictions(out: Path, jobs: Sequence[PoseJob[Any]]) -> None:
    """Wait until the files of all processes together hold a prediction of every job."""
    wait_for([job.name for job in jobs], _WrittenNames(out).has)


@dataclass(frozen=True)
class PoseFiles(Results[Any, PoseEstimate]):
    """A file for each estimate in a folder, as a worker puts them into a shard."""

    folder: Path

    def store(self, job: Job[Any], result: PoseEstimate) -> None:
        """Write an estimate as an entry of ``poses.json`` has it."""
        row = prediction_row(Prediction(estimate=result))
        write_json(self.folder / f"{job.name}.{ENDING}", row)


@dataclass(frozen=True, kw_only=True, eq=False)
class PoseWorker:
    """The estimation of poses by a worker of an engine, to which this is sent."""

    spec: PoseMethodSpec  #: what the estimator is built from
    object: str  #: name of the object in all files
    unit: Unit | None  #: unit of clouds, m by default; of depth images where their camera has none
    camera: Camera | None  #: camera of depth images; None: the files are clouds
    box: Box | None  #: where the object is in all depth images; None: each has a mask

    def make_writer(self) -> ResultWriter:
        """Build the estimator, and return the function that poses a batch of inputs."""
        return partial(self._estimate_samples, self.spec.build())

    def _estimate_samples(
        self, method: PoseMethod, samples: Sequence[LocalInput], out: Path
    ) -> list[str]:
        """Write the poses of inputs into a folder; return why each has none, "" if it has."""
        jobs = [self._make_job(sample) for sample in samples]
        outcomes = run_jobs(jobs, method.estimate_many, PoseFiles(out), max(1, len(jobs)))
        failures = [outcome.failure for outcome in outcomes]
        return ["" if error is None else f"cannot be read: {error}" for error in failures]

    def _make_job(self, sample: LocalInput) -> Job[Any]:
        """Make the job of a cloud, or of a depth image and its mask or box."""
        name = sample.name
        if self.camera is None:
            read = partial(cloud_input, sample.files[0], self.unit or "m", self.object, name)
        elif self.box is None:
            depth, mask = sample.files
            read = partial(view_input, depth, mask, self.camera, self.object, name, self.unit)
        else:
            depth = sample.files[0]
            detection = Detection(object=self.object, box=self.box)
            read = partial(
                read_detection, depth, self.object, detection, self.camera, name, self.unit
            )
        return Job(name=name, read=read)


def predict_poses_on_ray(
    options: PoseInputs, spec: PoseMethodSpec, batch: int, out: str, engine: EngineOptions
) -> int:
    """Pose clouds, or depth images with masks or a box, by the workers of an engine.

    Args:
        options: options that name the inputs: files, manifests or tar shards.
        spec: what the estimator is built from.
        batch: inputs that are estimated together.
        out: folder or URL for the shards.
        engine: options of the engine.

    Returns:
        The exit code.
    """
    # What the files are: clouds, depth images with masks, or depth images alone.
    # Several boxes were refused before (``option_rules``).
    box = parse_box(options.box[0]) if options.box else None
    if options.depth is None:
        files = InputFormat(roles=("cloud",), suffixes=tuple(CLOUD_READERS))
    elif box is None:
        files = InputFormat(roles=("depth", "mask"), suffixes=(*LISTED_SUFFIXES, ".json"))
    else:
        files = InputFormat(roles=("depth",), suffixes=LISTED_SUFFIXES)
    paths = [path for path in (options.cloud, options.depth, options.mask) if path is not None]
    inputs = JobInputs.find(paths, files)
    if len(paths) == 2:  # a single path is a manifest, which pairs files of any names
        _refuse_other_mask_names(inputs, paths[1])

    # What is estimated; the weights travel to the workers.
    if isinstance(spec, PoseNetworkSpec):
        spec = spec.with_packed_weights()
    # This machine builds the method for its objects and settings alone, and may lack the device.
    method = replace(spec, config=replace(spec.config, device="cpu")).build()
    object = resolve_object(options.object or None, method)
    camera = None
    if options.lens is not None:
        with inputs.open_first() as first:
            camera = camera_of(options.lens, image_size(first[0]))
    worker = PoseWorker(spec=spec, object=object, unit=options.unit, camera=camera, box=box)

    # All that decides the poses, for the record of the run.
    settings = {
        **method.settings,
        "estimate": config_to_dict(spec.config),  # with the device of the workers, not of `method`
        "object": object,
        "unit": options.unit,
    }
    if box is not None:
        settings["box"] = box
    if camera is not None:
        settings["K"] = camera.K.tolist()
        settings["depth_unit_m"] = camera.depth_unit_m
    computation = Computation(
        make_writer=worker.make_writer, input_format=files, endings=(ENDING,), batch=batch
    )
    return print_shards(engine.run(computation, inputs, out, settings), out, "inputs")


def _refuse_other_mask_names(inputs: JobInputs, masks: str) -> None:
    """Refuse masks that are not named after their depth images; a single pair may differ."""
    if len(inputs.listed) == 1:
        return
    for listed in inputs.listed:
        depth, mask = (PurePosixPath(file).stem for file in listed.files)
        if depth != mask:
            raise InputError(
                f"{masks}: no mask called {depth!r}; a mask has the name of its depth image"
            )
