"""The work behind ``depthpose pose predict``, here or by an engine."""

import json
import operator
import re
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from scipy.spatial.transform import Rotation
from tqdm import tqdm

from depthpose.cli import pose_methods
from depthpose.cli.engine import EngineOptions, say
from depthpose.cli.pose_methods import MethodSource, PoseMethod
from depthpose.cli.pose_options import DataSetOptions, OneObjectOptions
from depthpose.core import run
from depthpose.core.camera import Camera, camera_of
from depthpose.core.config import config_to_dict
from depthpose.core.engine import (
    Files,
    Function,
    Inputs,
    Item,
    Sample,
    Work,
    is_url,
    shard_results,
    stem,
)
from depthpose.core.errors import InputError
from depthpose.core.files import (
    cloud_suffixes,
    image_size,
    read_image,
    write_cloud,
    write_image,
    write_json,
)
from depthpose.core.files.images import LISTED_SUFFIXES
from depthpose.core.rigid import numbers_text
from depthpose.core.run import is_whole, note_result
from depthpose.core.units import Unit
from depthpose.pose.cloud import object_points
from depthpose.pose.datasets import BopDataset, open_bop, read_targets
from depthpose.pose.estimator.inputs import AnyInput, cloud_input, view_input
from depthpose.pose.evaluate import of_targets
from depthpose.pose.predictions import (
    CLOUD,
    PICTURE,
    POSES,
    Job,
    Prediction,
    is_finished,
    kept_predictions,
    parse_prediction,
    predict,
    prediction_row,
    results_name,
    write_bop_results,
    write_predictions,
)
from depthpose.pose.types import PoseEstimate, ViewInput
from depthpose.report import pose as drawn
from depthpose.report.page import Section, choose_answers, plain_table, write_page
from depthpose.report.viewer import open_viewer

_PAGE = "report.html"
_WITH_ALTERNATIVES = "depthpose-alternatives"  # the method of a csv that has them too
_MOST_SHOWN = 20  # of the answers, on the terminal; poses.json holds all
_SAID = 5  # of so many inputs the alternatives are printed; of all they are in poses.json
_MOST_ROWS = 1000  # of the answers, in the table of the page
_PRINTED = ("input", "object", "status", "x, y, z [m]", "qx, qy, qz, qw", "fit", "certainty",
            "identity", "tracking")  # fmt: skip
"""Columns on the terminal."""
_FRAME = """camera_from_model: x right, y down, z forward
certainty: the chance that the pose is right and not one of its alternatives"""


def claim(
    out: Path,
    settings: dict[str, Any],
    jobs: list[Job[Any]],
    is_result: Callable[[str, str], bool] = operator.eq,
) -> None:
    """Claim a folder for the poses of clouds or depth images, whose jobs name their files.

    ``is_result``: whether a result of the first name is of the input of the second.
    """
    run.claim_folder(out, settings, [POSES, _PAGE])
    if run.find_rank().world == 1 and not run.read_sources(out):  # lost: of what the poses are
        (out / POSES).unlink(missing_ok=True)
    done = _finished(out)
    run.claim_names(
        out,
        {job.name: job.source for job in jobs if job.source is not None},
        [f".{end}" for end in (PICTURE, CLOUD)],
        is_finished=lambda name: any(is_result(n, name) for n in done),
    )


def is_result_of(name: str, image: str) -> bool:
    """Whether a result is of an image without a mask: its name, or that and a number."""
    return re.fullmatch(rf"{re.escape(image)}(_\d+)?", name) is not None


def claim_bop(out: Path, settings: dict[str, Any], dataset: BopDataset) -> None:
    """Claim a folder for the poses of a data set."""
    images = sorted({(i.scene_id, i.image_id) for i in dataset.instances})
    pictures = [_picture_name(*image) for image in images]
    tables = [results_name(dataset), results_name(dataset, _WITH_ALTERNATIVES)]
    run.claim_folder(out, settings, [POSES, _PAGE, *tables, *pictures])


def predict_files(
    method: PoseMethod, inputs: OneObjectOptions, out: Path, batch: int, view: str | None
) -> int:
    """Pose clouds, or masked depth images, in this process; give the exit code."""
    name, lens = pose_methods.object_named(inputs.object, method), inputs.lens
    settings = {**method.settings, "object": name}
    if inputs.cloud is not None:
        unit = inputs.unit or "m"
        jobs = pose_methods.cloud_jobs(Path(inputs.cloud), unit, name, out)
        settings |= {"unit": unit}
    elif inputs.depth is None or inputs.mask is None or lens is None:
        raise InputError(
            "--depth needs --camera or --focal-px beside it, and --mask unless it is to be found"
        )
    else:
        mask = Path(inputs.mask)
        jobs = pose_methods.view_jobs(Path(inputs.depth), mask, lens, name, inputs.unit, out)
        settings |= pose_methods.camera_facts(lens) | {"mask": str(mask.resolve())}
        settings |= {} if inputs.unit is None else {"unit": inputs.unit}
    claim(out, settings, jobs)
    predictions = predict_all(method, jobs, out, settings, batch, view)
    if predictions is None:
        return 0
    write_files(predictions, jobs, out, method)
    return say_result(predictions, out)


def predict_dataset(
    source: MethodSource,
    options: DataSetOptions,
    object: str | None,
    out: str,
    batch: int,
    view: str | None,
    engine: EngineOptions,
) -> int:
    """Pose the objects of a data set, or one, here or by an engine; give the exit code."""
    assert options.bop is not None
    if engine.engine == "ray":
        if is_url(out):
            raise InputError(
                f"--out {out}: poses of a data set come together in poses.json and BOP's csv, "
                "which need a disk; give a folder, and copy it"
            )
        if options.masks not in ("truth", "predicted") and not options.masks.endswith(".json"):
            raise InputError(
                f"--masks {options.masks}: workers take masks that are there already; give "
                "truth, predicted, or a file of BOP detections, such as 'pose evaluate --masks "
                "WEIGHTS' leaves"
            )
    method, home = source.build("cpu" if engine.engine == "ray" else None), Path(out)
    dataset = open_bop(options.bop, options.split)
    if options.targets is not None:
        dataset = of_targets(dataset, read_targets(options.targets, options.bop))
    dataset = pose_methods.chosen_objects(dataset, method, object)
    masks = options.masks
    (found,) = pose_methods.find_masks([masks], dataset, home, source.config.device)
    jobs = pose_methods.bop_jobs(dataset, found, method)
    settings = {**method.settings, "estimate": config_to_dict(source.config)}
    settings |= {**pose_methods.of_dataset(dataset), "masks": found.name, **found.settings}
    if object is not None:
        settings["objects"] = sorted({i.object_id for i in dataset.instances})
    if engine.engine == "ray":
        settings["shards"] = engine.shards
    claim_bop(home, settings, dataset)
    if engine.engine == "ray":
        start = partial(
            start_bop,
            source=source.packed(),
            folder=str(dataset.folder.resolve()),
            split=options.split,
            masks=str(Path(masks).resolve()) if masks.endswith(".json") else masks,
            objects=tuple(sorted({instance.object_id for instance in dataset.instances})),
        )
        inputs = Inputs(items=[Item(job.name, ()) for job in jobs], files=Files((), ()))
        work = Work(start=start, files=inputs.files, endings=(ENDING,), batch=batch)
        known: dict[str, Prediction] = {}
        failed: dict[str, str] = {}
        for done in engine.run(work, inputs, out, settings):
            failed |= dict(done.failures)
            for name, files in shard_results(out, done):
                known[name] = parse_prediction(json.loads(files[ENDING]), f"{done.shard}: {name}")
        for job in jobs:
            if job.name not in known:
                lost = PoseEstimate(
                    name=job.name,
                    object=job.read().object,
                    status="unreadable",
                    reason=failed[job.name],
                )
                known[job.name] = Prediction(estimate=lost, place=job.place)
        predictions = [known[job.name] for job in jobs]
        write_predictions(Path(out), predictions)
    else:
        predictions = predict_all(method, jobs, home, settings, batch, view)
    if predictions is None:
        return 0
    write_files(predictions, jobs, home, method, dataset)
    return say_result(predictions, home)


def predict_all(
    method: PoseMethod,
    jobs: list[Job[Any]],
    out: Path,
    settings: dict[str, Any],
    batch: int,
    view: str | None,
) -> list[Prediction] | None:
    """Estimate what is not finished; several processes share the work through the files.

    Gives all predictions in the first of them, None in the others.
    """
    process = run.find_rank()
    home = out if process.world == 1 else out / f"part-{process.rank}"
    done = _finished(out)
    left = [jobs[k] for k in process.share(len(jobs)) if jobs[k].name not in done]
    if left:
        with open_viewer(None if process.rank else view) as viewer:
            names = predict(pose_methods.safely(method, viewer), left, home, settings, batch)
            for _ in tqdm(names, total=len(left), disable=None, unit=" poses"):
                pass
    if process.rank:
        return None
    if process.world > 1:
        seen: dict[str, Any] = {"at": -10.0, "names": set()}

        def is_there(name: str) -> bool:
            # Files of all parts are read for all names at once, every second.
            if name not in seen["names"] and time.monotonic() - seen["at"] > 1:
                seen["names"], seen["at"] = set(_known(out)), time.monotonic()
            return name in seen["names"]

        run.wait_for([job.name for job in jobs], is_there)
    known = _known(out)
    predictions = [known.pop(job.name) for job in jobs]
    # Inputs of earlier runs stay in the file.
    write_predictions(out, [*known.values(), *predictions])
    return predictions


def _finished(out: Path) -> set[str]:
    return {name for name, prediction in _known(out).items() if is_finished(prediction)}


def _known(out: Path) -> dict[str, Prediction]:
    folders = [out, *sorted(out.glob("part-*"))]
    every = [p for folder in folders for p in kept_predictions(folder)]
    # What was read at last counts, whatever another part said of an earlier try.
    return {p.estimate.name: p for p in sorted(every, key=is_finished)}


def write_files(
    predictions: list[Prediction],
    jobs: list[Job[Any]],
    out: Path,
    method: PoseMethod,
    dataset: BopDataset | None = None,
) -> None:
    """Write the files of poses, or of a data set's, and the page."""
    if dataset is not None:
        write_bop_results(out / results_name(dataset), predictions)
        if any(p.estimate.alternatives for p in predictions):
            more = out / results_name(dataset, _WITH_ALTERNATIVES)
            write_bop_results(more, predictions, with_alternatives=True)
        image_of = {(i.scene_id, i.image_id): i for i in dataset.instances}
        posed: dict[tuple[int, int], list[PoseEstimate]] = defaultdict(list)
        for prediction in predictions:
            if prediction.place is not None and prediction.estimate.is_posed:
                posed[prediction.place[:2]].append(prediction.estimate)
        for image, estimates in posed.items():
            name = _picture_name(*image)
            if not is_whole(out, name, [name]):
                picture = drawn.picture_of(image_of[image])
                for estimate in estimates:
                    assert estimate.camera_from_model is not None
                    model = method.models_by_name[estimate.object]
                    pose, K = estimate.camera_from_model, image_of[image].K
                    picture = drawn.draw_pose(picture, pose, model, K)
                write_image(out / name, picture)
                note_result(out, name, [out / name])
    for prediction, job in zip(predictions, jobs, strict=True) if dataset is None else ():
        pose = prediction.estimate.camera_from_model
        if pose is None:
            continue
        view, model = job.read(), method.models_by_name[prediction.estimate.object]
        points_m = object_points(view, model.diameter_m)
        files = [out / f"{job.name}.{CLOUD}"]
        write_cloud(files[0], drawn.posed_cloud(points_m, pose, model))
        if isinstance(view, ViewInput):
            files.append(out / f"{job.name}.{PICTURE}")
            write_image(
                files[1], drawn.draw_pose(drawn.grey_depth(view.depth_m), pose, model, view.K)
            )
        note_result(out, job.name, files)
    _write_page(out, predictions, jobs, method, dataset)


def _picture_name(scene: int, image: int) -> str:
    return f"{scene:06d}_{image:06d}.{PICTURE}"


def say_result(predictions: list[Prediction], out: Path) -> int:
    """Print how many were posed and why others were not; give the exit code."""
    failed = [p.estimate for p in predictions if not is_finished(p)]
    shown = [p.estimate for p in predictions if is_finished(p)]
    for estimate in failed:
        print(f"depthpose: failed: {estimate.name}: {estimate.reason}", file=sys.stderr)
    if shown:
        rows: list[dict[str, Any]] = []
        for estimate in shown[:_MOST_SHOWN]:
            row, pose = _row(estimate), estimate.camera_from_model
            if pose is not None:
                quaternion = Rotation.from_matrix(pose.R.double()).as_quat()
                row["x, y, z [m]"] = numbers_text(pose.t_m.tolist())
                row["qx, qy, qz, qw"] = numbers_text(quaternion.tolist())
            certain = {
                key: value for key in ("fit", "certainty") if (value := row[key]) is not None
            }
            rows.append(row | {key: f"{value:.3f}" for key, value in certain.items()})
        print(plain_table(rows, _PRINTED), end="")
        print(_FRAME)
    if len(shown) == 1 and not shown[0].is_ok:
        what = "refused" if shown[0].camera_from_model is None else shown[0].status
        print(f"{what}: {shown[0].reason}")
    for prediction in predictions[:_SAID]:
        for line in drawn.alternative_lines(prediction.estimate):
            print(f"{prediction.estimate.name}: {line}")
    inputs = "1 input" if len(predictions) == 1 else f"{len(predictions)} inputs"
    print(f"{inputs}: {_statuses(shown) or 'none readable'}; {out / 'poses.json'}")
    return 1 if failed else 0


def _row(estimate: PoseEstimate) -> dict[str, Any]:
    """Say what was found of one input, as the page and the terminal show it."""
    pose, fit, identity = estimate.camera_from_model, estimate.fit, estimate.identity
    place = [None] * 3 if pose is None else pose.t_m.double().tolist()
    return {
        "input": estimate.name,
        "object": estimate.object,
        "status": estimate.status,
        **({} if estimate.tracking is None else {"tracking": estimate.tracking}),
        **dict(zip(("x_m", "y_m", "z_m"), place, strict=True)),
        "fit": None if fit is None else fit.agrees,
        "identity": None if identity is None else identity.status,
        "certainty": estimate.certainty,
        "alternatives": "; ".join(drawn.alternative_lines(estimate)),
        "reason": estimate.reason,
    }


def _statuses(estimates: Sequence[PoseEstimate]) -> str:
    counts = Counter(estimate.status for estimate in estimates)
    return ", ".join(f"{count} {status}" for status, count in sorted(counts.items()))


def _write_page(
    out: Path,
    predictions: Sequence[Prediction],
    jobs: Sequence[Job[Any]],
    method: PoseMethod,
    dataset: BopDataset | None,
) -> None:
    """Write a page of some of the predictions, and of the reason of each refusal."""
    instances = () if dataset is None else dataset.instances
    image_of = {(i.scene_id, i.image_id): i.rgb for i in instances}
    readable = [k for k, prediction in enumerate(predictions) if is_finished(prediction)]
    sections: list[Section] = []
    for k in choose_answers([predictions[k].estimate.is_posed for k in readable]):
        estimate, place = predictions[readable[k]].estimate, predictions[readable[k]].place
        shown_input = jobs[readable[k]].read()
        if isinstance(shown_input, PoseEstimate):  # unreadable by now
            continue
        rgb = None if place is None else image_of[place[:2]]
        shown = drawn.PoseShown(
            input=shown_input,
            estimate=estimate,
            model=method.models_by_name[estimate.object],
            image=None if rgb is None else read_image(rgb),
        )
        sections.append(drawn.pose_section(estimate.name, shown))
    number = len(predictions)
    estimates = [prediction.estimate for prediction in predictions]
    text = f"{number} inputs: {_statuses(estimates)}. Shown below: {len(sections)}"
    text += "." if len(sections) == number else ", answers and refusals spread evenly."
    if number > _MOST_ROWS:
        text += f" The table holds the first {_MOST_ROWS}, refusals before answers; all are in "
        text += "poses.json."
    rows = [_row(one) for one in sorted(estimates, key=lambda one: one.is_posed)[:_MOST_ROWS]]
    results = Section(title="What was found", text=text, rows=rows)
    title = f"Poses of {number} input{'s' * (number != 1)}"
    write_page(out / _PAGE, title, [results, *sections], run.environment())
    print(f"the page: {out / _PAGE}")


ENDING = "pose.json"  # of the one file of a result: an entry of poses.json


def cloud_files() -> Files:
    """Give the kinds of files that are clouds."""
    return Files(roles=("cloud",), suffixes=cloud_suffixes())


def start_files(
    source: MethodSource, object: str, unit: Unit | None, camera: Camera | None
) -> Function:
    """Build the estimator; clouds, or depth images and masks, to poses or the reasons for none."""
    method = source.build()

    def read(sample: Sample) -> AnyInput:
        if camera is None:
            return cloud_input(sample.files[0], unit or "m", object, sample.name)
        depth, mask = sample.files
        return view_input(depth, mask, camera, object, sample.name, unit)

    def predict(samples: Sequence[Sample], out: Path) -> list[str]:
        named = [Job(name=sample.name, read=partial(read, sample)) for sample in samples]
        jobs = [pose_methods.safe_job(job, object) for job in named]
        return _write_estimates(method, jobs, out)

    return predict


def start_bop(
    source: MethodSource, folder: str, split: str, masks: str, objects: tuple[int, ...]
) -> Function:
    """Build the estimator, and open the data set; its objects, by name, to poses or the reasons.

    All workers see the folder and a file of detections, if ``masks`` is one.
    """
    method = source.build()
    dataset = open_bop(Path(folder), split).of_objects(*objects)
    (found,) = pose_methods.find_masks([masks], dataset, Path())
    jobs = {job.name: job for job in pose_methods.bop_jobs(dataset, found, method)}

    def predict(samples: Sequence[Sample], out: Path) -> list[str]:
        return _write_estimates(method, [jobs[sample.name] for sample in samples], out)

    return predict


def _write_estimates(method: PoseMethod, jobs: Sequence[Job[Any]], out: Path) -> list[str]:
    """Estimate some inputs and write an entry of each; give for each "" or why it failed."""
    reasons: list[str] = []
    for job, estimate in zip(
        jobs, pose_methods.safely(method)([job.read() for job in jobs]), strict=True
    ):
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
    views = Files(roles=("depth", "mask"), suffixes=(*LISTED_SUFFIXES, ".json"))
    files = cloud_files() if options.depth is None else views
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
    object = pose_methods.object_named(options.object or None, method)
    with inputs.first() as first:
        lens = options.lens
        camera = None if lens is None else camera_of(lens, image_size(first[0]))
    start = partial(start_files, source, object, options.unit, camera)
    work = Work(start=start, files=files, endings=(ENDING,), batch=batch)
    settings = {**method.settings, "estimate": config_to_dict(source.config), "object": object}
    settings |= {"unit": options.unit}
    if camera is not None:
        settings |= {"K": camera.K.tolist(), "depth_unit_m": camera.depth_unit_m}
    return say(engine.run(work, inputs, out, settings), out, "inputs")
