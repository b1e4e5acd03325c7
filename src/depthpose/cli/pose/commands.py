"""``depthpose pose ...``."""

from dataclasses import replace
from pathlib import Path
from typing import Any

from depthpose.cli.engine import EngineOptions
from depthpose.cli.options import PoseMeasureOptions
from depthpose.cli.pose.options import (
    DataSetOptions,
    EstimateOptions,
    OneObjectOptions,
    RegisterOptions,
    refuse_mixture,
)
from depthpose.core.errors import InputError
from depthpose.pose.config import SymmetryRule


def predict(
    out: str,
    weights: str = "parts",
    inputs: OneObjectOptions = OneObjectOptions(),
    dataset: DataSetOptions = DataSetOptions(),
    estimates: EstimateOptions = EstimateOptions(),
    register: RegisterOptions = RegisterOptions(),
    view: str | None = None,
    engine: EngineOptions = EngineOptions(),
) -> int:
    """The pose of known objects from clouds, depth images or a data set; or the reason for none.

    poses.json holds for each input camera_from_model (metres), its covariance (about this answer
    alone), its certainty, the alternatives that fit as well with their probabilities, the risk that
    none of them is right, status and reason, and the seconds of each stage.
    A cloud or depth image NAME gives NAME.pose.ply, the posed model beside the cloud, and
    NAME.pose.png over the depth image; a data set gives depthpose_DATASET-SPLIT.csv, if there
    are alternatives depthpose-alternatives_DATASET-SPLIT.csv, and SCENE_IMAGE.pose.png. report.html
    shows some of them in 3D, and every refusal. A rerun skips what is finished; other settings need
    another --out; only files of the same run are overwritten. Processes of torchrun share the work.

        depthpose pose predict --cloud part.ply --unit mm --object part --out out
        depthpose pose predict --depth d.png --mask m.png --camera cam.json --out out
        depthpose pose predict --depth d.png --camera cam.json --out out
        depthpose pose predict --bop lm --split test --weights linemod.safetensors --out out
        depthpose pose predict --method register --cad p.stl --unit mm --cloud p.ply --out out

    Args:
        out: folder for the results.
        weights: of a pose network, by name or file ('depthpose weights list').
        view: live shows each result in Rerun's viewer (an extra) as it comes; FILE.rrd records it.
    """
    from depthpose.cli.pose.finding import find_all
    from depthpose.cli.pose.inputs import object_named
    from depthpose.cli.pose.methods import source_of

    refuse_mixture(inputs, dataset)
    config = estimates.config
    bop = None if dataset.bop is None else (dataset.bop, dataset.split)
    source = source_of(weights, register, inputs.unit, bop, config)
    if engine.is_ray:
        return _predict_on_ray(inputs, dataset, source, estimates.batch, out, engine)
    method = source.build()
    if dataset.bop is not None:
        run = (estimates.batch, config.device, view)
        return _predict_bop(method, dataset, inputs.object, Path(out), *run)
    if inputs.cloud is not None and not method.takes_clouds:
        raise InputError(
            f"--cloud {inputs.cloud}: the weights {weights} need depth images; give --depth, "
            "--mask and --camera, or weights that vote"
        )
    if inputs.depth is not None and inputs.mask is None and inputs.camera is not None:
        known = tuple(model.name for model in method.models)
        wanted = known if inputs.object is None else (object_named(inputs.object, method),)
        place = Path(inputs.depth)
        if view is not None:
            raise InputError("--view shows inputs that have a mask; omit it, or give --mask")
        return find_all(method, place, inputs.camera, wanted, inputs.unit, Path(out))
    return _predict_here(method, inputs, Path(out), estimates.batch, view)


def _predict_here(
    method: Any,  # noqa: ANN401  a type of this would load torch for --help
    given: OneObjectOptions,
    out: Path,
    batch: int,
    view: str | None,
) -> int:
    """Pose clouds, or masked depth images, in this process."""
    from depthpose.cli.pose import predicting
    from depthpose.cli.pose.page import write_pose_page

    jobs, settings = _jobs_of(method, given, out)
    predicting.claim(out, settings, jobs, Path(given.cloud or given.depth or out))
    predictions = predicting.predict_all(method, jobs, out, settings, batch, view)
    if predictions is None:
        return 0
    predicting.write_files(predictions, jobs, out, method)
    write_pose_page(out, predictions, jobs, method)
    return predicting.say_result(predictions, out)


def _jobs_of(
    method: Any,  # noqa: ANN401
    given: OneObjectOptions,
    out: Path,
) -> tuple[list[Any], dict[str, Any]]:
    """List the inputs, and what decides their results."""
    from depthpose.cli.pose import inputs

    name = inputs.object_named(given.object, method)
    settings = {**method.settings, "object": name}
    if given.cloud is not None:
        unit = given.unit or "m"
        jobs = inputs.cloud_jobs(Path(given.cloud), unit, name, out)
        return jobs, {**settings, "unit": unit}
    if given.depth is None or given.mask is None or given.camera is None:
        raise InputError("--depth needs --camera beside it, and --mask unless it is to be found")
    files = (Path(given.depth), Path(given.mask), given.camera)
    jobs = inputs.view_jobs(files, name, given.unit, out)
    settings |= inputs.camera_facts(given.camera) | {"mask": str(files[1].resolve())}
    return jobs, settings | ({} if given.unit is None else {"unit": given.unit})


def evaluate(
    bop: Path,
    out: Path,
    split: str = "test",
    weights: tuple[str, ...] = (),
    csv: tuple[Path, ...] = (),
    predictions: tuple[Path, ...] = (),
    objects: tuple[str, ...] = (),
    adds: SymmetryRule = "declared",
    estimates: PoseMeasureOptions = PoseMeasureOptions(vsd=True),
) -> int:
    """Measure poses on a BOP or Linemod_preprocessed data set, and write rows, a table and a page.

    Predictions are made once, as files in OUT/predictions/METHOD_MASKS (poses.json and BOP's csv),
    and measured from there; a second run measures without predicting anew. Several weights and
    kinds of masks may be named at once: their rows share the table. What is not estimated, or
    refused, counts as a failure.

        depthpose pose evaluate --bop lm --split test --weights W.safetensors --out out/lm

    Args:
        bop: folder of the data set.
        out: folder for rows.json, rows.csv, table.md, report.html, instances.csv and predictions.
        split: train, test, ...
        weights: files or names, of the method or of a baseline; also register (registration
            without training) and open3d (Open3D's, an extra), which need no weights.
        csv: BOP results of any method.
        predictions: folders with poses.json.
        objects: keep these alone, by name or number.
        adds: ADD-S for declared symmetric objects (of LineMOD eggbox and glue), or for all.
    """
    from depthpose.cli.pose import evaluating
    from depthpose.cli.pose.masks import find_masks
    from depthpose.cli.pose.methods import pose_methods, predict_all
    from depthpose.core.config import config_to_dict
    from depthpose.core.run import claim_folder
    from depthpose.report.page import table_files

    if not (weights or csv or predictions):
        raise InputError("measure --weights FILE, --csv FILE or --predictions DIR, or several.")
    dataset = evaluating.open_instances(bop, split, objects, estimates.targets)
    files = [*table_files("rows", "instances", "risk"), "report.html", "predictions", "detections"]
    rule = replace(estimates.evaluation, adds=adds)
    # More objects, or all of the targets, may be asked for later.
    about = {"bop": str(bop.resolve()), "split": split, "rule": config_to_dict(rule)}
    claim_folder(out, {"command": "pose evaluate", **about}, files)
    methods = pose_methods(weights, estimates.estimate, tuple(dataset.objects.values()))
    shown = find_masks(estimates.masks, dataset, out, estimates.device) if methods else []
    paths = [predict_all(dataset, method, one, out) for method in methods for one in shown]
    return evaluating.measure(dataset, [*paths, *csv, *predictions], rule, out)


def _predict_bop(
    method: Any,  # noqa: ANN401  a type of this would load torch for --help
    given: DataSetOptions,
    object: str | None,
    out: Path,
    batch: int,
    device: str,
    view: str | None,
) -> int:
    from depthpose.cli.pose import inputs, predicting
    from depthpose.cli.pose.masks import find_masks, of_dataset
    from depthpose.cli.pose.page import write_pose_page
    from depthpose.pose.datasets import open_bop

    assert given.bop is not None
    dataset = inputs.chosen_objects(open_bop(given.bop, given.split), method, object)
    (masks,) = find_masks([given.masks], dataset, out, device)
    jobs = inputs.bop_jobs(dataset, masks, method)
    chosen = {"masks": masks.name, **inputs.object_facts(dataset, object)}
    settings = {**method.settings, **of_dataset(dataset), **chosen, **masks.settings}
    predicting.claim_bop(out, settings, dataset)
    predictions = predicting.predict_all(method, jobs, out, settings, batch, view)
    if predictions is None:
        return 0
    predicting.write_bop_files(predictions, dataset, out, method)
    write_pose_page(out, predictions, jobs, method, dataset)
    return predicting.say_result(predictions, out)


def _predict_on_ray(
    given: OneObjectOptions,
    dataset: DataSetOptions,
    source: Any,  # noqa: ANN401  a type of this would load torch for --help
    batch: int,
    out: str,
    on: EngineOptions,
) -> int:
    from depthpose.cli.pose import engine

    if dataset.bop is not None:
        asked = (dataset.bop, dataset.split, dataset.masks, given.object)
        return engine.predict_bop(asked, source.packed(), batch, out, on)
    if given.depth is not None and given.camera is None:
        raise InputError("--depth needs --camera beside it")
    files = engine.cloud_files() if given.depth is None else engine.VIEW_FILES
    work = engine.PoseWork(
        source=source.packed(),
        object=given.object or "",
        unit=given.unit,
        camera=None,
        files=files,
        batch=batch,
    )
    words = [word for word in (given.cloud, given.depth, given.mask) if word is not None]
    return engine.predict(words, files, work, given.camera, out, on)
