"""The work behind ``depthpose pose predict``."""

import operator
import re
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from scipy.spatial.transform import Rotation
from tqdm import tqdm

from depthpose.cli.engine import EngineOptions
from depthpose.cli.pose_inputs import (
    Unreadable,
    bop_jobs,
    camera_facts,
    chosen_objects,
    cloud_jobs,
    object_facts,
    object_named,
    safely,
    view_jobs,
)
from depthpose.cli.pose_methods import (
    MethodSource,
    PoseMethod,
    find_masks,
    of_dataset,
)
from depthpose.cli.pose_options import DataSetOptions, OneObjectOptions
from depthpose.core.config import config_to_dict
from depthpose.core.errors import InputError
from depthpose.core.files import read_image, write_cloud, write_image
from depthpose.core.rigid import numbers_text
from depthpose.core.run import (
    ProcessRank,
    claim_folder,
    claim_names,
    environment,
    find_rank,
    is_whole,
    note_result,
    read_sources,
    wait_for,
)
from depthpose.pose.cloud import object_points
from depthpose.pose.datasets import BopDataset, open_bop, read_targets
from depthpose.pose.evaluate import of_targets
from depthpose.pose.predictions import (
    CLOUD,
    PICTURE,
    POSES,
    Job,
    Prediction,
    alternatives_name,
    is_finished,
    kept_predictions,
    predict,
    results_name,
    write_bop_results,
    write_predictions,
)
from depthpose.pose.types import ObjectModel, PoseEstimate, ViewInput
from depthpose.report.page import Section, choose_answers, plain_table, write_page
from depthpose.report.pose import (
    PoseShown,
    alternative_lines,
    draw_pose,
    grey_depth,
    picture_of,
    pose_section,
    posed_cloud,
)
from depthpose.report.viewer import Viewer, open_viewer

PAGE = "report.html"
_MOST_SHOWN = 20
"""Of the answers, on the terminal; poses.json holds all."""
_FRAME = """camera_from_model: x right, y down, z forward
certainty: the chance that the pose is right and not one of its alternatives"""

_SAID = 5
"""Of so many inputs the alternatives are printed; of all they are in poses.json."""


def claim(
    out: Path,
    settings: dict[str, Any],
    jobs: list[Job[Any]],
    source: Path,
    is_result: Callable[[str, str], bool] = operator.eq,
) -> None:
    """Claim a folder for the poses of clouds or depth images.

    Args:
        out: the folder.
        settings: that decide the results.
        jobs: inputs.
        source: of those that name none.
        is_result: whether a result of the first name is of the input of the second.

    Raises:
        InputError: it is another run's, or holds a file of somebody else that would be written
            over.
    """
    claim_folder(out, settings, [POSES, PAGE])
    if find_rank().world == 1 and not read_sources(out):  # lost: of what the poses are
        (out / POSES).unlink(missing_ok=True)
    endings = [f".{end}" for end in (PICTURE, CLOUD)]
    done = _finished(out)
    sources = {job.name: job.source or source for job in jobs}
    claim_names(
        out, sources, endings, is_finished=lambda name: any(is_result(n, name) for n in done)
    )


def is_result_of(name: str, image: str) -> bool:
    """Whether a result is of an image without a mask: its name, or that and a number."""
    return re.fullmatch(rf"{re.escape(image)}(_\d+)?", name) is not None


def claim_bop(out: Path, settings: dict[str, Any], dataset: BopDataset) -> None:
    """Claim a folder for the poses of a data set; raises as :func:`claim`."""
    images = {(i.scene_id, i.image_id) for i in dataset.instances}
    pictures = (_picture_name(*image) for image in sorted(images))
    tables = [results_name(dataset), alternatives_name(dataset)]
    claim_folder(out, settings, [POSES, PAGE, *tables, *pictures])


def predict_files(
    method: PoseMethod, inputs: OneObjectOptions, out: Path, batch: int, view: str | None
) -> int:
    """Pose clouds, or masked depth images, in this process; give the exit code."""
    name = object_named(inputs.object, method)
    settings = {**method.settings, "object": name}
    if inputs.cloud is not None:
        unit = inputs.unit or "m"
        jobs = cloud_jobs(Path(inputs.cloud), unit, name, out)
        settings |= {"unit": unit}
    elif inputs.depth is None or inputs.mask is None or inputs.lens is None:
        raise InputError(
            "--depth needs --camera or --focal-px beside it, and --mask unless it is to be found"
        )
    else:
        mask = Path(inputs.mask)
        jobs = view_jobs(Path(inputs.depth), mask, inputs.lens, name, inputs.unit, out)
        settings |= camera_facts(inputs.lens) | {"mask": str(mask.resolve())}
        settings |= {} if inputs.unit is None else {"unit": inputs.unit}
    claim(out, settings, jobs, Path(inputs.cloud or inputs.depth or out))
    predictions = predict_all(method, jobs, out, settings, batch, view)
    if predictions is None:
        return 0
    write_files(predictions, jobs, out, method)
    write_pose_page(out, predictions, jobs, method)
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
    if engine.is_ray:
        from depthpose.cli.pose_ray import refuse_unshared

        refuse_unshared(options.masks, out)
    method, home = source.build("cpu" if engine.is_ray else None), Path(out)
    dataset = open_bop(options.bop, options.split)
    if options.targets is not None:
        dataset = of_targets(dataset, read_targets(options.targets, options.bop))
    dataset = chosen_objects(dataset, method, object)
    (masks,) = find_masks([options.masks], dataset, home, source.config.device)
    jobs = bop_jobs(dataset, masks, method)
    settings = {**method.settings, "estimate": config_to_dict(source.config)}
    settings |= {**of_dataset(dataset), "masks": masks.name, **object_facts(dataset, object)}
    settings |= {**masks.settings, **({"shards": engine.shards} if engine.is_ray else {})}
    claim_bop(home, settings, dataset)
    if engine.is_ray:
        from depthpose.cli.pose_ray import predict_instances

        predictions = predict_instances(
            source, options, dataset, jobs, batch, out, settings, engine
        )
    else:
        predictions = predict_all(method, jobs, home, settings, batch, view)
    if predictions is None:
        return 0
    write_bop_files(predictions, dataset, home, method)
    write_pose_page(home, predictions, jobs, method, dataset)
    return say_result(predictions, home)


def predict_all(method: PoseMethod, jobs: list[Job[Any]], out: Path, settings: dict[str, Any],
                batch: int, view: str | None) -> list[Prediction] | None:  # fmt: skip
    """Estimate what is not finished; several processes share the work through the files."""
    process = find_rank()
    home = out if process.world == 1 else out / f"part-{process.rank}"
    done = _finished(out)
    left = [jobs[k] for k in process.share(len(jobs)) if jobs[k].name not in done]
    if left:
        with open_viewer(None if process.rank else view) as viewer:
            shown = method if viewer is None else _watched(method, viewer)
            names = predict(safely(shown), left, home, settings, batch)
            for _ in tqdm(names, total=len(left), disable=None, unit=" poses"):
                pass
    if process.rank:
        return None
    return _gather(jobs, out, process)


def say_result(predictions: list[Prediction], out: Path) -> int:
    """Print how many were posed and why others were not; give the exit code."""
    failed = [p.estimate for p in predictions if not is_finished(p)]
    shown = [p.estimate for p in predictions if is_finished(p)]
    for estimate in failed:
        print(f"depthpose: failed: {estimate.name}: {estimate.reason}", file=sys.stderr)
    if shown:
        print(plain_table([_answer_row(estimate) for estimate in shown[:_MOST_SHOWN]]), end="")
        print(_FRAME)
    if len(shown) == 1 and not shown[0].is_ok:
        what = "refused" if shown[0].camera_from_model is None else shown[0].status
        print(f"{what}: {shown[0].reason}")
    for prediction in predictions[:_SAID]:
        for line in alternative_lines(prediction.estimate):
            print(f"{prediction.estimate.name}: {line}")
    statuses = Counter(estimate.status for estimate in shown)
    said = ", ".join(f"{count} {status}" for status, count in sorted(statuses.items()))
    inputs = "1 input" if len(predictions) == 1 else f"{len(predictions)} inputs"
    print(f"{inputs}: {said or 'none readable'}; {out / 'poses.json'}")
    return 1 if failed else 0


def _answer_row(estimate: PoseEstimate) -> dict[str, Any]:
    """Say what was found of one input: object, status, translation, quaternion, the answers."""
    row: dict[str, Any] = {
        "input": estimate.name,
        "object": estimate.object,
        "status": estimate.status,
    }
    pose = estimate.camera_from_model
    if pose is not None:
        quaternion = Rotation.from_matrix(pose.R.double().numpy()).as_quat()
        row |= {"x, y, z [m]": numbers_text(pose.t_m.tolist())}
        row |= {"qx, qy, qz, qw": numbers_text(quaternion.tolist())}
    fit, certainty, identity = estimate.fit, estimate.certainty, estimate.identity
    row["fit"] = None if fit is None else f"{fit.agrees:.3f}"
    row["certainty"] = None if certainty is None else f"{certainty:.3f}"
    row["identity"] = None if identity is None else identity.status
    return row if estimate.tracking is None else row | {"tracking": estimate.tracking}


def write_files(
    predictions: list[Prediction], jobs: list[Job[Any]], out: Path, method: PoseMethod
) -> None:
    """Write NAME.pose.ply, and NAME.pose.png where there is a depth image."""
    for prediction, job in zip(predictions, jobs, strict=True):
        estimate = prediction.estimate
        pose = estimate.camera_from_model
        if pose is None:
            continue
        view, model = job.read(), _model(method, estimate.object)
        points_m = object_points(view, model.diameter_m)
        files = [out / f"{job.name}.{CLOUD}"]
        write_cloud(files[0], posed_cloud(points_m, pose, model))
        if isinstance(view, ViewInput):
            picture = draw_pose(grey_depth(view.depth_m), pose, model, view.K)
            files.append(out / f"{job.name}.{PICTURE}")
            write_image(files[1], picture)
        note_result(out, job.name, files)


def write_bop_files(
    predictions: list[Prediction], dataset: BopDataset, out: Path, method: PoseMethod
) -> None:
    """Write BOP's csv, and a picture SCENE_IMAGE.pose.png of each image."""
    write_bop_results(out / results_name(dataset), predictions)
    if any(p.estimate.alternatives for p in predictions):
        write_bop_results(out / alternatives_name(dataset), predictions, with_alternatives=True)
    image_of = {(i.scene_id, i.image_id): i for i in dataset.instances}
    posed: dict[tuple[int, int], list[PoseEstimate]] = defaultdict(list)
    for prediction in predictions:
        if prediction.place is not None and prediction.estimate.is_posed:
            posed[prediction.place[:2]].append(prediction.estimate)
    for (scene, image), estimates in posed.items():
        name = _picture_name(scene, image)
        if not is_whole(out, name, [name]):
            instance = image_of[scene, image]
            picture = picture_of(instance)
            for estimate in estimates:
                assert estimate.camera_from_model is not None
                model = _model(method, estimate.object)
                picture = draw_pose(picture, estimate.camera_from_model, model, instance.K)
            write_image(out / name, picture)
            note_result(out, name, [out / name])


def _picture_name(scene: int, image: int) -> str:
    return f"{scene:06d}_{image:06d}.{PICTURE}"


def _finished(out: Path) -> set[str]:
    return {name for name, prediction in _known(out).items() if is_finished(prediction)}


def _known(out: Path) -> dict[str, Prediction]:
    folders = [out, *sorted(out.glob("part-*"))]
    every = [p for folder in folders for p in kept_predictions(folder)]
    # What was read at last counts, whatever another part said of an earlier try.
    return {p.estimate.name: p for p in sorted(every, key=is_finished)}


def _gather(jobs: list[Job[Any]], out: Path, process: ProcessRank) -> list[Prediction]:
    if process.world > 1:
        seen: dict[str, Any] = {"at": -10.0, "names": set()}

        def is_there(name: str) -> bool:
            # Files of all parts are read for all names at once, every second.
            if name not in seen["names"] and time.monotonic() - seen["at"] > 1:
                seen["names"], seen["at"] = set(_known(out)), time.monotonic()
            return name in seen["names"]

        wait_for([job.name for job in jobs], is_there)
    known = _known(out)
    predictions = [known.pop(job.name) for job in jobs]
    # Inputs of earlier runs stay in the file.
    write_predictions(out, [*known.values(), *predictions])
    return predictions


def _model(method: PoseMethod, name: str) -> ObjectModel:
    return next(model for model in method.models if model.name == name)


def _watched(method: PoseMethod, viewer: Viewer) -> PoseMethod:
    """Give a method whose every estimate is shown as soon as it is there."""
    models = {model.name: model for model in method.models}

    def estimate_many(inputs: Sequence[Any]) -> list[PoseEstimate]:
        estimates = list(method.estimate_many(inputs))
        for view, estimate in zip(inputs, estimates, strict=True):
            viewer.show_pose(view, estimate, models[view.object])
        return estimates

    return replace(method, estimate_many=estimate_many)


_MOST_ROWS = 1000


def write_pose_page(
    out: Path,
    predictions: Sequence[Prediction],
    jobs: Sequence[Job[Any]],
    method: PoseMethod,
    dataset: BopDataset | None = None,
) -> None:
    """Write a page of some of the predictions, and of the reason of each refusal."""
    sections = _answer_sections(predictions, jobs, method, dataset)
    counts = Counter(prediction.estimate.status for prediction in predictions)
    said = ", ".join(f"{count} {status}" for status, count in sorted(counts.items()))
    rows = [_row(p.estimate) for p in sorted(predictions, key=lambda p: p.estimate.is_posed)]
    number, shown = len(predictions), len(sections)
    text = f"{number} inputs: {said}. Shown below: {shown}"
    text += "." if shown == number else ", answers and refusals spread evenly."
    if number > _MOST_ROWS:
        text += f" The table holds the first {_MOST_ROWS}, refusals before answers; all are in "
        text += "poses.json."
    results = Section(title="What was found", text=text, rows=rows[:_MOST_ROWS])
    page = out / PAGE
    title = f"Poses of {number} input{'s' * (number != 1)}"
    write_page(page, title, [results, *sections], environment())
    print(f"the page: {page}")


def _answer_sections(
    predictions: Sequence[Prediction],
    jobs: Sequence[Job[Any]],
    method: PoseMethod,
    dataset: BopDataset | None,
) -> list[Section]:
    """Show some of the inputs that could be read, answered and refused."""
    instances = () if dataset is None else dataset.instances
    image_of = {(i.scene_id, i.image_id): i.rgb for i in instances}
    models = {model.name: model for model in method.models}
    readable = [k for k, prediction in enumerate(predictions) if is_finished(prediction)]
    answered = [predictions[k].estimate.is_posed for k in readable]
    sections: list[Section] = []
    for k in (readable[chosen] for chosen in choose_answers(answered)):
        shown_input = jobs[k].read()
        if isinstance(shown_input, Unreadable):  # by now; it was read when it was estimated
            continue
        estimate, place = predictions[k].estimate, predictions[k].place
        rgb = None if place is None else image_of[place[:2]]
        image = None if rgb is None else read_image(rgb)
        model = models[estimate.object]
        shown = PoseShown(input=shown_input, estimate=estimate, model=model, image=image)
        sections.append(pose_section(estimate.name, shown))
    return sections


def _row(estimate: PoseEstimate) -> dict[str, Any]:
    pose = estimate.camera_from_model
    x_m, y_m, z_m = (None, None, None) if pose is None else pose.t_m.double().tolist()
    tracking = {} if estimate.tracking is None else {"tracking": estimate.tracking}
    return {
        "input": estimate.name,
        "object": estimate.object,
        "status": estimate.status,
        **tracking,
        "x_m": x_m,
        "y_m": y_m,
        "z_m": z_m,
        "fit": None if estimate.fit is None else estimate.fit.agrees,
        "identity": None if estimate.identity is None else estimate.identity.status,
        "certainty": estimate.certainty,
        "alternatives": "; ".join(alternative_lines(estimate)),
        "reason": estimate.reason,
    }
