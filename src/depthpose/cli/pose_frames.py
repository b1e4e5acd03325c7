"""Whole depth images, without masks: searched one by one, or followed as a sequence."""

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from depthpose.cli import pose_methods, pose_predict
from depthpose.cli.pose_methods import PoseMethod
from depthpose.cli.pose_options import DataSetOptions, OneObjectOptions, SequenceOptions
from depthpose.core.errors import InputError
from depthpose.core.files import read_depth_png
from depthpose.core.rigid import Rigid
from depthpose.core.run import find_rank
from depthpose.pose.datasets import BopDataset, Instance, open_bop, read_targets
from depthpose.pose.evaluate import of_targets
from depthpose.pose.inputs import AnyInput
from depthpose.pose.predictions import (
    Job,
    Place,
    Prediction,
    kept_predictions,
    place_of,
    unreadable,
    write_predictions,
)
from depthpose.pose.search import explained_mask
from depthpose.pose.surface import prepare_surface
from depthpose.pose.types import PoseEstimate, ViewInput


def find_all(method: PoseMethod, inputs: OneObjectOptions, out: Path) -> int:
    """Find objects in every depth image, write the files of each, and give the exit code.

    Every object that is looked for has an entry, found or not: in an image NAME they are called
    NAME_0, NAME_1, ..., or NAME where one was looked for and not found. A rerun goes on where it
    was, and reads again what could not be read.
    """
    lens = inputs.camera or inputs.focal_px
    assert inputs.depth is not None
    assert lens is not None
    objects = tuple(model.name for model in method.models)
    if inputs.object is not None:
        objects = (pose_predict.object_named(inputs.object, method),)
    if method.find is None:
        raise InputError(
            "--depth without --mask: these weights need masked views; give --mask, --box or "
            "--detections"
        )
    if find_rank().world > 1:
        raise InputError("--depth without --mask is done by one process; give --mask, or start one")
    unit = inputs.unit
    jobs = pose_predict.frame_jobs(Path(inputs.depth), lens, objects[0], unit, out)
    names = {job.name for job in jobs}
    for name in sorted(names):
        if (plain := re.sub(r"_\d+$", "", name)) != name and plain in names:
            raise InputError(
                f"two depth images are called {plain!r} and {name!r}, and so would be what is "
                "found in the first; rename one"
            )
    facts = pose_predict.camera_facts(lens) | ({} if unit is None else {"unit": unit})
    settings = {**method.settings, "find": sorted(objects), **facts}
    models = [model for model in method.models if model.name in objects]
    jobs = pose_predict.colored_jobs(jobs, inputs, models, out, settings)
    pose_predict.claim(out, settings, jobs, pose_predict.is_result_of)
    left = [p for p in kept_predictions(out).values() if p.estimate.status != "unreadable"]
    results: list[tuple[Prediction, Job[Any]]] = []
    for job in tqdm(jobs, disable=None, unit=" images"):
        own = [p for p in left if pose_predict.is_result_of(p.estimate.name, job.name)]
        left = [p for p in left if p not in own]
        if not own:
            try:
                view = job.read()
            except InputError as error:
                found = [unreadable(job.name, objects[0], error)]
            else:
                found = method.find(view, objects)
            own = [Prediction(estimate=one) for one in found]
        results += [
            (one, replace(job, name=one.estimate.name, read=partial(_explained, job, one, method)))
            for one in own
        ]
        write_predictions(out, [*(prediction for prediction, _ in results), *left])
    pose_predict.claim(out, settings, [job for _, job in results], pose_predict.is_result_of)
    predictions = [prediction for prediction, _ in results]
    searched = [job for _, job in results]
    pose_predict.write_files(predictions, searched, out, method, inputs=len(jobs))
    return pose_predict.say_result(predictions, out, len(jobs))


def search_dataset(
    method: PoseMethod, options: DataSetOptions, object: str | None, out: Path
) -> int:
    """Search every image of a data set for every object of it, as 6D detection; give the exit code.

    No mask and no identity is told. A rerun goes on where it was.
    """
    assert options.bop is not None
    if method.find is None:
        raise InputError("--masks search: these weights need masked views; give other --masks")
    if find_rank().world > 1:
        raise InputError("--masks search is done by one process; give other --masks, or start one")
    dataset = open_bop(options.bop, options.split)
    if options.targets is not None:
        dataset = of_targets(dataset, read_targets(options.targets, options.bop))
    dataset = pose_methods.chosen_objects(dataset, method, object)
    numbers = {name: n for n, name in pose_methods.match_names(dataset, method.models).items()}
    settings = {**method.settings, **pose_methods.of_dataset(dataset), "masks": "search"}
    settings["find"] = sorted(numbers)
    pose_predict.claim_bop(out, settings, dataset)
    images = {(i.scene_id, i.image_id): i for i in dataset.instances}
    left = list(kept_predictions(out).values())
    results: list[tuple[Prediction, Job[Any]]] = []
    for (scene, image), instance in tqdm(sorted(images.items()), disable=None, unit=" images"):
        job = Job[Any](
            name=f"{scene:06d}_{image:06d}",
            read=partial(_whole_view, instance, next(iter(numbers))),
        )
        of_image = [p for p in left if p.place is not None and p.place[:2] == (scene, image)]
        if not of_image:
            view = replace(job.read(), name=job.name)
            estimates = method.find(view, list(numbers))
            of_image = [
                Prediction(estimate=one, place=Place(scene, image, numbers[one.object]))
                for one in estimates
            ]
        results += [
            (one, replace(job, name=one.estimate.name, read=partial(_explained, job, one, method)))
            for one in of_image
        ]
        left = [p for p in left if p not in of_image]
        write_predictions(out, [*(prediction for prediction, _ in results), *left])
    predictions = [prediction for prediction, _ in results]
    searched = [job for _, job in results]
    pose_predict.write_files(predictions, searched, out, method, dataset, inputs=len(images))
    return pose_predict.say_result(predictions, out, len(images))


def _explained(job: Job[Any], found: Prediction, method: PoseMethod) -> AnyInput:
    """Read a whole depth image as if a mask had shown what was found in it."""
    view, pose = job.read(), found.estimate.camera_from_model
    model = next((one for one in method.models if one.name == found.estimate.object), None)
    if model is None or pose is None or not isinstance(view, ViewInput):
        return view
    mask = explained_mask(view, pose, prepare_surface(model))
    return replace(view, name=found.estimate.name, mask=mask, object=model.name)


def track_folder(method: PoseMethod, frames: SequenceOptions, out: Path) -> int:
    """Follow one object through depth images with a camera, or clouds; give the exit code."""
    unit = frames.unit
    start = None if frames.first is None else pose_methods.read_pose(frames.first)
    name = pose_predict.object_named(frames.object, method)
    settings = {**method.settings, "track": name} | ({} if unit is None else {"unit": unit})
    if frames.cloud is not None:
        jobs = pose_predict.cloud_jobs(frames.cloud, unit or "m", name, out)
    else:
        assert frames.depth is not None
        assert frames.camera is not None
        jobs = pose_predict.frame_jobs(frames.depth, frames.camera, name, unit, out)
        settings |= pose_predict.camera_facts(frames.camera)
    if frames.first is not None:
        settings |= {"first": pose_methods.named_file(frames.first)}
    pose_predict.claim(out, settings, jobs)
    return _finish(method, _followed(method, jobs, name, start), jobs, out)


def track_bop(method: PoseMethod, frames: SequenceOptions, out: Path) -> int:
    """Follow each known object of each scene, or one; give the exit code."""
    assert frames.bop is not None
    dataset = open_bop(frames.bop, frames.split)
    dataset = pose_methods.chosen_objects(dataset, method, frames.object)
    names = pose_methods.match_names(dataset, method.models)
    settings = {
        **method.settings,
        **pose_methods.of_dataset(dataset),
        "track": sorted(names.values()),
    }
    pose_predict.claim_bop(out, settings, dataset)
    images: dict[tuple[int, int], dict[int, Instance]] = {}
    for one in sorted(dataset.instances, key=lambda i: (i.image_id, i.index)):
        images.setdefault((one.scene_id, one.object_id), {}).setdefault(one.image_id, one)
    sequences = [
        (names[number], list(some.values())) for (_, number), some in sorted(images.items())
    ]
    sequences = [
        (name, [Job(name=one.name, read=partial(_whole_view, one, name), object=name,
                    place=place_of(one)) for one in some])
        for name, some in sequences
    ]  # fmt: skip
    jobs = [job for _, own in sequences for job in own]
    coming = (one for name, own in sequences for one in _followed(method, own, name))
    return _finish(method, coming, jobs, out, dataset)


def _whole_view(instance: Instance, name: str) -> ViewInput:
    """Read the depth image of an instance without its mask."""
    depth_m = read_depth_png(instance.depth, instance.depth_unit_m)
    everywhere = torch.ones_like(depth_m, dtype=torch.bool)
    return ViewInput(
        name=instance.name, depth_m=depth_m, mask=everywhere, K=instance.K, object=name
    )


def _finish(
    method: PoseMethod,
    coming: Iterable[Prediction],
    jobs: Sequence[Job[Any]],
    out: Path,
    dataset: BopDataset | None = None,
) -> int:
    """Take predictions as they come, write their files, and print what became of the frames.

    They are written where the work is interrupted, too; what an earlier run found of frames that
    this one did not reach stays in the file.
    """
    left = list(kept_predictions(out).values())
    predictions: list[Prediction] = []
    try:
        for one in coming:
            predictions.append(one)  # noqa: PERF402  those before an interruption must be there
        left = []
    finally:
        names = {one.estimate.name for one in predictions}
        if predictions:
            others = [p for p in left if p.estimate.name not in names]
            write_predictions(out, [*predictions, *others])
    pairs = zip(predictions, jobs, strict=True)
    explained = [
        replace(job, name=one.estimate.name, read=partial(_explained, job, one, method))
        for one, job in pairs
    ]
    pose_predict.write_files(predictions, explained, out, method, dataset)
    code = pose_predict.say_result(predictions, out)
    kinds = Counter(p.estimate.tracking for p in predictions if p.estimate.tracking is not None)
    print(", ".join(f"{kinds[kind]} {kind}" for kind in ("tracked", "found", "lost")))
    return code


def _followed(
    method: PoseMethod, jobs: Sequence[Job[Any]], name: str, first: Rigid | None = None
) -> Iterator[Prediction]:
    """Follow an object, frame by frame; of one that cannot be read the estimate says so."""

    def frames() -> Iterator[AnyInput | PoseEstimate]:
        for job in tqdm(jobs, disable=None, unit=" frames"):
            try:
                frame = job.read()
            except InputError as error:
                frame = unreadable(job.name, name, error)
            yield frame

    assert method.track is not None
    estimates = method.track(frames(), name, first)
    for job, estimate in zip(jobs, estimates, strict=True):
        yield Prediction(estimate=estimate, place=job.place)
