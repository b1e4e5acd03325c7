"""The work behind ``depthpose pose track``: one object through the frames of a sequence."""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from depthpose.cli.pose import inputs, predicting
from depthpose.cli.pose.finding import explained_job
from depthpose.cli.pose.inputs import Unreadable
from depthpose.cli.pose.masks import named_file, of_dataset
from depthpose.cli.pose.methods import PoseMethod, match_names
from depthpose.cli.pose.page import write_pose_page
from depthpose.core.files import read_depth_png
from depthpose.core.rigid import Rigid
from depthpose.pose.config import Unit
from depthpose.pose.datasets import BopDataset, Instance, open_bop
from depthpose.pose.predictions import (
    Job,
    Prediction,
    kept_predictions,
    place_of,
    write_predictions,
)
from depthpose.pose.types import PoseEstimate, ViewInput


def track_folder(
    method: PoseMethod,
    given: tuple[Path | None, Path | None, Path | None, Path | None],
    object: str | None,
    unit: Unit | None,
    out: Path,
) -> int:
    """Follow one object through depth images with a camera, or clouds; give the exit code."""
    depth, camera, cloud, first = given
    start = None if first is None else inputs.read_pose(first)
    name = inputs.object_named(object, method)
    settings = {**method.settings, "track": name} | ({} if unit is None else {"unit": unit})
    if cloud is not None:
        jobs = inputs.cloud_jobs(cloud, unit or "m", name, out)
    else:
        assert depth is not None
        assert camera is not None
        jobs = inputs.frame_jobs(depth, camera, name, unit, out)
        settings |= inputs.camera_facts(camera)
    if first is not None:
        settings |= {"first": named_file(first)}
    predicting.claim(out, settings, jobs, cloud or depth or out)
    predictions = _kept(_followed(method, jobs, name, start), out)
    shown = _shown(predictions, jobs, method)
    predicting.write_files(predictions, shown, out, method)
    write_pose_page(out, predictions, shown, method)
    return _say(predictions, out)


def track_bop(method: PoseMethod, given: tuple[Path, str, str | None], out: Path) -> int:
    """Follow each known object of each scene, or one; give the exit code."""
    folder, split, object = given
    dataset = inputs.chosen_objects(open_bop(folder, split), method, object)
    names = match_names(dataset, method.models)
    settings = {**method.settings, **of_dataset(dataset), "track": sorted(names.values())}
    predicting.claim_bop(out, settings, dataset)
    sequences = list(_sequences(dataset, names))
    jobs = [job for _, own in sequences for job in own]
    coming = (one for name, own in sequences for one in _followed(method, own, name))
    predictions = _kept(coming, out)
    predicting.write_bop_files(predictions, dataset, out, method)
    write_pose_page(out, predictions, _shown(predictions, jobs, method), method, dataset)
    return _say(predictions, out)


def _sequences(dataset: BopDataset, names: dict[int, str]) -> Iterator[tuple[str, list[Job[Any]]]]:
    """Give the frames of each object of each scene, in the order of their images."""
    frames: dict[tuple[int, int], dict[int, Instance]] = {}
    for one in sorted(dataset.instances, key=lambda i: (i.image_id, i.index)):
        frames.setdefault((one.scene_id, one.object_id), {}).setdefault(one.image_id, one)
    for (_, number), images in sorted(frames.items()):
        name = names[number]
        yield name, [_frame_job(one, name) for one in images.values()]


def _frame_job(one: Instance, name: str) -> Job[Any]:
    return inputs.input_job(one.name, name, partial(_whole_view, one, name), place_of(one))


def _whole_view(instance: Instance, name: str) -> ViewInput:
    """Give the depth image of an instance without its mask."""
    depth_m = read_depth_png(instance.depth, instance.depth_unit_m)
    return ViewInput(
        name=instance.name,
        depth_m=depth_m,
        mask=torch.ones_like(depth_m, dtype=torch.bool),
        K=instance.K,
        object=name,
    )


def _kept(coming: Iterable[Prediction], out: Path) -> list[Prediction]:
    """Take predictions as they come; they are written where the work is interrupted, too.

    What an earlier run found of frames that this one did not reach stays in the file.
    """
    left = kept_predictions(out)
    found: list[Prediction] = []
    try:
        for one in coming:
            found.append(one)  # noqa: PERF402  those before an interruption must be there
        left = []
    finally:
        names = {one.estimate.name for one in found}
        if found:
            write_predictions(out, [*found, *(p for p in left if p.estimate.name not in names)])
    return found


def _followed(
    method: PoseMethod, jobs: Sequence[Job[Any]], name: str, first: Rigid | None = None
) -> Iterator[Prediction]:
    """Follow an object, frame by frame; one that cannot be read is skipped."""
    places = {job.name: job.place for job in jobs}
    unread: list[PoseEstimate] = []

    def readable() -> Iterator[Any]:
        for job in tqdm(jobs, disable=None, unit=" frames"):
            given = job.read()
            if isinstance(given, Unreadable):
                unread.append(predicting.unread(given))
            else:
                yield given

    assert method.track is not None
    for found in method.track(readable(), name, first):
        # What could not be read was passed on the way to this frame.
        for estimate in [*unread, found]:
            yield Prediction(estimate=estimate, place=places[estimate.name])
        unread.clear()
    for estimate in unread:
        yield Prediction(estimate=estimate, place=places[estimate.name])


def _shown(
    predictions: Sequence[Prediction], jobs: Sequence[Job[Any]], method: PoseMethod
) -> list[Job[Any]]:
    """Give of each frame what the pose explains."""
    pairs = zip(predictions, jobs, strict=True)
    return [explained_job(job, prediction.estimate, method) for prediction, job in pairs]


def _say(predictions: list[Prediction], out: Path) -> int:
    """Print what became of the frames beside what 'pose predict' says."""
    code = predicting.say_result(predictions, out)
    kinds = Counter(p.estimate.tracking for p in predictions if p.estimate.tracking is not None)
    print(", ".join(f"{kinds[kind]} {kind}" for kind in ("tracked", "found", "lost")))
    return code
