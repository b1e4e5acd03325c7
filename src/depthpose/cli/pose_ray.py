"""The work behind ``depthpose pose predict --engine ray``, ``--bop`` included.

With ``--bop`` workers open the data set themselves, as a mask or a camera is not a file of its own
there; their estimates come back in shards, and the files of the plain command are made of these.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from depthpose.cli.engine import EngineOptions, Inputs, say
from depthpose.cli.pose_inputs import bop_jobs, estimate_jobs, input_job, object_named
from depthpose.cli.pose_methods import MethodSource, PoseMethod, find_masks
from depthpose.cli.pose_options import DataSetOptions, OneObjectOptions
from depthpose.core.camera import Camera, camera_of
from depthpose.core.config import config_to_dict
from depthpose.core.engine import Files, Function, Item, Sample, is_url, shard_results, stem
from depthpose.core.errors import InputError
from depthpose.core.files import cloud_suffixes, image_size, write_json
from depthpose.core.files.images import LISTED_SUFFIXES
from depthpose.core.units import Unit
from depthpose.pose.datasets import BopDataset, open_bop
from depthpose.pose.estimator.inputs import AnyInput, cloud_input, view_input
from depthpose.pose.predictions import (
    Job,
    Prediction,
    is_finished,
    parse_prediction,
    prediction_row,
    write_predictions,
)
from depthpose.pose.types import PoseEstimate

VIEW_FILES = Files(roles=("depth", "mask"), suffixes=(*LISTED_SUFFIXES, ".json"))
NO_FILES = Files(roles=(), suffixes=())
ENDING = "pose.json"
"""Of the one file of a result: an entry of ``poses.json``."""


def cloud_files() -> Files:
    """Give the kinds of files that are clouds."""
    return Files(roles=("cloud",), suffixes=cloud_suffixes())


@dataclass(frozen=True, kw_only=True)
class PoseWork:
    """Clouds, or depth images and masks, to poses or the reasons for none."""

    source: MethodSource
    object: str
    unit: Unit | None
    camera: Camera | None
    files: Files
    batch: int
    endings: Sequence[str] = (ENDING,)

    def start(self) -> Function:
        """Build the estimator."""
        method = self.source.build()

        def predict(samples: Sequence[Sample], out: Path) -> list[str]:
            jobs = [input_job(s.name, self.object, partial(self._read, s)) for s in samples]
            return _write_estimates(method, jobs, out)

        return predict

    def _read(self, sample: Sample) -> AnyInput:
        if self.camera is None:
            return cloud_input(sample.files[0], self.unit or "m", self.object, sample.name)
        depth, mask = sample.files
        return view_input(depth, mask, self.camera, self.object, sample.name, self.unit)


@dataclass(frozen=True, kw_only=True)
class BopWork:
    """Objects of a data set, by their names, to poses or the reasons for none.

    Attributes:
        folder: of the data set, which all workers see.
        split: of it.
        masks: ``truth``, ``predicted`` or a file of detections, which all workers see.
        objects: numbers of the objects that the estimator knows.
    """

    source: MethodSource
    folder: str
    split: str
    masks: str
    objects: tuple[int, ...]
    batch: int
    files: Files = NO_FILES
    endings: Sequence[str] = (ENDING,)

    def start(self) -> Function:
        """Build the estimator and open the data set."""
        method = self.source.build()
        dataset = open_bop(Path(self.folder), self.split).of_objects(*self.objects)
        (masks,) = find_masks([self.masks], dataset, Path())
        jobs = {job.name: job for job in bop_jobs(dataset, masks, method)}

        def predict(samples: Sequence[Sample], out: Path) -> list[str]:
            return _write_estimates(method, [jobs[sample.name] for sample in samples], out)

        return predict


def _write_estimates(method: PoseMethod, jobs: Sequence[Job[Any]], out: Path) -> list[str]:
    """Estimate some inputs and write an entry of each; give for each "" or why it failed."""
    reasons: list[str] = []
    for job, estimate in zip(jobs, estimate_jobs(method, jobs), strict=True):
        spent = {**job.seconds, **estimate.seconds}
        prediction = Prediction(estimate=replace(estimate, seconds=spent), place=job.place)
        write_json(out / f"{job.name}.{ENDING}", prediction_row(prediction))
        reasons.append("" if is_finished(prediction) else estimate.reason)
    return reasons


def predict_on_ray(
    options: OneObjectOptions, source: MethodSource, batch: int, out: str, engine: EngineOptions
) -> int:
    """Pose clouds, depth images and masks, manifests or tar shards by the workers of an engine."""
    if options.depth is not None and options.lens is None:
        raise InputError("--depth needs --camera or --focal-px beside it")
    files = cloud_files() if options.depth is None else VIEW_FILES
    words = [word for word in (options.cloud, options.depth, options.mask) if word is not None]
    inputs = Inputs.find(words, files)
    for item in inputs.items if len(words) == 2 else ():  # one manifest pairs as it likes
        depth, mask = map(stem, item.files)
        if depth != mask and len(inputs.items) > 1:
            raise InputError(
                f"{words[1]}: no mask called {depth!r}; a mask has the name of its depth image"
            )
    source = source.packed()
    method = source.build("cpu")
    object = object_named(options.object or None, method)
    with inputs.first() as first:
        lens = options.lens
        camera = None if lens is None else camera_of(lens, image_size(first[0]))
    work = PoseWork(
        source=source, object=object, unit=options.unit, camera=camera, files=files, batch=batch
    )
    settings = {**method.settings, "estimate": config_to_dict(source.config), "object": object}
    settings |= {"unit": options.unit}
    if camera is not None:
        settings |= {"K": camera.K.tolist(), "depth_unit_m": camera.depth_unit_m}
    return say(engine.run(work, inputs, out, settings), out, "inputs")


def refuse_unshared(masks: str, out: str) -> None:
    """Refuse what the workers cannot share of a data set."""
    if is_url(out):
        raise InputError(
            f"--out {out}: poses of a data set come together in poses.json and BOP's csv, which "
            "need a disk; give a folder, and copy it"
        )
    if masks not in ("truth", "predicted") and not masks.endswith(".json"):
        raise InputError(
            f"--masks {masks}: workers take masks that are there already; give truth, predicted, "
            "or a file of BOP detections, such as 'pose evaluate --masks WEIGHTS' leaves"
        )


def predict_instances(
    source: MethodSource,
    options: DataSetOptions,
    dataset: BopDataset,
    jobs: Sequence[Job[Any]],
    batch: int,
    out: str,
    settings: dict[str, Any],
    engine: EngineOptions,
) -> list[Prediction]:
    """Pose the instances of a data set by the workers of an engine, and write ``poses.json``."""
    shipped = options.masks in ("truth", "predicted")
    work = BopWork(
        source=source.packed(),
        folder=str(dataset.folder.resolve()),
        split=options.split,
        masks=options.masks if shipped else str(Path(options.masks).resolve()),
        objects=tuple(sorted({instance.object_id for instance in dataset.instances})),
        batch=batch,
    )
    inputs = Inputs(items=[Item(job.name, ()) for job in jobs], tars=(), files=NO_FILES)
    known: dict[str, Prediction] = {}
    failed: dict[str, str] = {}
    for done in engine.run(work, inputs, out, settings):
        failed |= dict(done.failures)
        for name, files in shard_results(out, done):
            known[name] = parse_prediction(json.loads(files[ENDING]), f"{done.shard}: {name}")
    predictions: list[Prediction] = []
    for job in jobs:
        if job.name not in known:
            estimate = PoseEstimate(
                name=job.name,
                object=job.read().object,
                status="unreadable",
                reason=failed[job.name],
            )
            known[job.name] = Prediction(estimate=estimate, place=job.place)
        predictions.append(known[job.name])
    write_predictions(Path(out), predictions)
    return predictions
