"""The work behind ``depthpose pose predict --engine ray``, ``--bop`` included.

With ``--bop`` workers open the data set themselves, as a mask or a camera is not a file of its own
there; their estimates come back in shards, and the files of the plain command are made of these.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from depthpose.cli.engine import EngineOptions, Inputs, run, say
from depthpose.cli.pose.inputs import (
    bop_jobs,
    chosen_objects,
    input_job,
    object_facts,
    object_named,
)
from depthpose.cli.pose.masks import find_masks, of_dataset
from depthpose.cli.pose.methods import MethodSource, PoseMethod
from depthpose.cli.pose.page import write_pose_page
from depthpose.cli.pose.predicting import claim_bop, estimate_jobs, say_result, write_bop_files
from depthpose.core.camera import Camera, read_camera
from depthpose.core.config import config_to_dict
from depthpose.core.engine import (
    Done,
    Files,
    Function,
    Item,
    Sample,
    is_url,
    shard_results,
    stem,
)
from depthpose.core.errors import InputError
from depthpose.core.files import cloud_suffixes, image_size, write_json
from depthpose.core.files.images import LISTED_SUFFIXES
from depthpose.pose.config import Unit
from depthpose.pose.datasets import BopDataset, open_bop
from depthpose.pose.estimator.given import cloud_input, view_input
from depthpose.pose.estimator.prepare import AnyInput
from depthpose.pose.predictions import Job as PoseJob
from depthpose.pose.predictions import (
    Prediction,
    is_finished,
    parse_prediction,
    prediction_row,
    write_predictions,
)
from depthpose.pose.types import PoseEstimate

VIEW_FILES = Files(roles=("depth", "mask"), suffixes=(*LISTED_SUFFIXES, ".json"))


def cloud_files() -> Files:
    """Give the kinds of files that are clouds."""
    return Files(roles=("cloud",), suffixes=cloud_suffixes())


ENDING = "pose.json"
"""Of the one file of a result: an entry of ``poses.json``."""


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
        return partial(_predict, self.source.build(), self)


def predict(
    words: Sequence[str],
    files: Files,
    work: PoseWork,
    camera: Path | None,
    out: str,
    options: EngineOptions,
) -> int:
    """Pose by an engine.

    Args:
        words: clouds, or depth images and masks, manifests or tar shards.
        files: what an input is made of.
        work: without the camera, and with the object that the user named.
        camera: file of the depth images' camera.
        out: folder of the results.
        options: of the engine.
    """
    inputs = Inputs.find(words, files)
    _refuse_other_masks(words, inputs)
    method = work.source.build("cpu")
    name = object_named(work.object or None, method)
    known = None
    with inputs.first() as first:
        if camera is not None:
            known = read_camera(camera, image_size(first[0]))
    work = replace(work, object=name, camera=known)
    return say(run(work, inputs, out, _settings(work, method), options), out, "inputs")


def _settings(work: PoseWork, method: PoseMethod) -> dict[str, Any]:
    """What a folder of results remembers of the run."""
    camera = work.camera
    facts = {} if camera is None else {"K": camera.K.tolist(), "depth_unit_m": camera.depth_unit_m}
    return {
        **method.settings,
        "estimate": config_to_dict(work.source.config),
        "object": work.object,
        "unit": work.unit,
        **facts,
    }


def _refuse_other_masks(words: Sequence[str], inputs: Inputs) -> None:
    """Refuse two folders whose files are not called alike; one manifest pairs as it likes."""
    for item in inputs.items if len(words) == 2 else ():
        depth, mask = map(stem, item.files)
        if depth != mask and len(inputs.items) > 1:
            raise InputError(
                f"{words[1]}: no mask called {depth!r}; a mask has the name of its depth image"
            )


def _predict(method: PoseMethod, work: PoseWork, samples: Sequence[Sample], out: Path) -> list[str]:
    jobs = [input_job(s.name, work.object, partial(_read, work, s)) for s in samples]
    reasons: list[str] = []
    for estimate in estimate_jobs(method, jobs):
        prediction = Prediction(estimate=estimate)
        write_json(out / f"{estimate.name}.{ENDING}", prediction_row(prediction))
        reasons.append("" if is_finished(prediction) else estimate.reason)
    return reasons


def _read(work: PoseWork, sample: Sample) -> AnyInput:
    if work.camera is None:
        return cloud_input(sample.files[0], work.unit or "m", work.object, sample.name)
    depth, mask = sample.files
    return view_input(depth, mask, work.camera, work.object, sample.name, work.unit)


NO_FILES = Files(roles=(), suffixes=())


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
        jobs = bop_jobs(*self.open(), method)
        return partial(_predict_instances, method, {job.name: job for job in jobs})

    def open(self) -> tuple[BopDataset, Any]:
        """Give the data set and its masks."""
        dataset = open_bop(Path(self.folder), self.split).of_objects(*self.objects)
        return dataset, find_masks([self.masks], dataset, Path())[0]


def predict_bop(
    given: tuple[Path, str, str, str | None],
    source: MethodSource,
    batch: int,
    out: str,
    options: EngineOptions,
) -> int:
    """Pose the objects of a data set by an engine.

    Args:
        given: folder, split and masks of the data set, and which of its objects; None: all.
        source: of the estimator, packed.
        batch: inputs in one call of the network.
        out: folder of the results.
        options: of the engine.

    Raises:
        InputError: ``out`` is in a store, or the masks are yet to be found by a segmentation.
    """
    folder, split, masks, object = given
    _refuse_what_is_not_shared(masks, out)
    method = source.build("cpu")
    chosen = chosen_objects(open_bop(folder, split), method, object)
    work = BopWork(
        source=source,
        folder=str(folder.resolve()),
        split=split,
        masks=masks if masks in ("truth", "predicted") else str(Path(masks).resolve()),
        objects=tuple(sorted({instance.object_id for instance in chosen.instances})),
        batch=batch,
    )
    dataset, shown = work.open()
    jobs = bop_jobs(dataset, shown, method)
    facts = {**of_dataset(dataset), "masks": shown.name, **object_facts(chosen, object)}
    settings = {**method.settings, "estimate": config_to_dict(source.config), **facts}
    settings = {**settings, **shown.settings, "shards": options.shards}
    claim_bop(Path(out), settings, dataset)
    inputs = Inputs(items=[Item(one.name, ()) for one in jobs], tars=(), files=NO_FILES)
    predictions = _gather(run(work, inputs, out, settings, options), out, jobs)
    write_predictions(Path(out), predictions)
    write_bop_files(predictions, dataset, Path(out), method)
    write_pose_page(Path(out), predictions, jobs, method, dataset)
    return say_result(predictions, Path(out))


def _refuse_what_is_not_shared(masks: str, out: str) -> None:
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


def _predict_instances(
    method: PoseMethod, jobs: Mapping[str, PoseJob[Any]], samples: Sequence[Sample], out: Path
) -> list[str]:
    wanted = [jobs[sample.name] for sample in samples]
    reasons: list[str] = []
    for job, estimate in zip(wanted, estimate_jobs(method, wanted), strict=True):
        spent = {**job.seconds, **estimate.seconds}
        prediction = Prediction(estimate=replace(estimate, seconds=spent), place=job.place)
        write_json(out / f"{job.name}.{ENDING}", prediction_row(prediction))
        reasons.append("" if is_finished(prediction) else estimate.reason)
    return reasons


def _gather(every: Sequence[Done], out: str, jobs: Sequence[PoseJob[Any]]) -> list[Prediction]:
    """Read all shards, in the order of the jobs."""
    found: dict[str, Prediction] = {}
    failed: dict[str, str] = {}
    for done in every:
        failed |= dict(done.failures)
        for name, files in shard_results(out, done):
            row = json.loads(files[ENDING])
            found[name] = parse_prediction(row, f"{done.shard}: {name}")
    return [found.get(job.name) or _unread(job, failed[job.name]) for job in jobs]


def _unread(job: PoseJob[Any], reason: str) -> Prediction:
    given = job.read()
    estimate = PoseEstimate(name=job.name, object=given.object, status="unreadable", reason=reason)
    return Prediction(estimate=estimate, place=job.place)
