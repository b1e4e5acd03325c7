"""``depthpose pose ...``."""

from dataclasses import replace
from pathlib import Path

from depthpose.cli.arguments import NewPath, NewPlace, WeightsName
from depthpose.cli.engine import EngineOptions
from depthpose.cli.pose import options
from depthpose.core.errors import InputError
from depthpose.pose.config import EstimateConfig, SymmetryRule


def predict_poses(
    out: NewPlace,
    inputs: options.InputOptions = options.InputOptions(),
    details: options.InputDetailOptions = options.InputDetailOptions(),
    pair: options.PairOptions = options.PairOptions(),
    dataset: options.DataSetOptions = options.DataSetOptions(),
    estimates: options.EstimateOptions = options.EstimateOptions(),
    engine: EngineOptions = EngineOptions(),
) -> int:
    """Pose known objects from clouds, depth images, pairs or a dataset, or say why not.

    poses.json holds for each input camera_from_model (metres), its covariance (about this answer
    alone), its certainty, the alternatives that fit as well with their probabilities, status and
    reason, and the seconds of each stage.
    A cloud or depth image NAME gives NAME.pose.ply, the posed model beside the cloud, and
    NAME.pose.png over the depth image; a dataset gives depthpose_DATASET-SPLIT.csv, if there
    are alternatives depthpose-alternatives_DATASET-SPLIT.csv, and SCENE_IMAGE.pose.png. report.html
    shows some of them in 3D, and every refusal. A rerun skips what is finished; other settings need
    another --out; only files of the same run are overwritten. Processes of torchrun share the work.

        depthpose pose predict --cad p.stl --cad-unit mm --depth d.png --camera c.json --out out
        depthpose pose predict --cad p.stl --cad-unit mm --depth d.png --camera c.json
            --box 120,80,260,210 --out out
        depthpose pose predict --cad p.stl --unit mm --cloud p.ply --out out
        depthpose pose predict --depth d.png --mask m.png --camera c.json --object flange
            --out out
        depthpose pose predict --cad p.stl --cad-unit mm --left l.png --right r.png
            --camera rig.json --mask m.png --out out
        depthpose pose predict --bop lm --split test --weights linemod.safetensors --out out

    Args:
        out: folder for the results.
    """
    from depthpose.cli.pose.methods import make_method_spec
    from depthpose.cli.pose.predict import (
        predict_poses_of_dataset,
        predict_poses_of_files,
        predict_poses_on_ray,
    )
    from depthpose.cli.pose.search import search_dataset, search_files

    # The estimator: a trained network, or registration of CAD files. Workers build their own.
    pose_inputs = options.PoseInputs(**vars(inputs), **vars(details))
    spec = make_method_spec(
        estimates.weights,
        pose_inputs,
        pose_inputs.unit,
        dataset,
        estimates.config,
        pose_inputs.base_from_camera,
        is_registration=estimates.is_registration(pose_inputs.cad),
    )

    # A pair is matched first, to depth images in metres.
    matching_code = 0
    if pair.left is not None:
        from depthpose.cli.pose.pairs import match_pairs_for_poses

        matched = match_pairs_for_poses(pair, pose_inputs.camera, estimates.device, Path(out))
        matching_code = matched.exit_code
        cad_unit = pose_inputs.cad_unit or pose_inputs.unit
        pose_inputs = replace(pose_inputs, depth=str(matched.depth), unit=None, cad_unit=cad_unit)

    batch = estimates.batch
    if engine.engine == "ray":
        return predict_poses_on_ray(pose_inputs, spec, batch, out, engine)
    method = spec.build()

    # Pose a dataset, or search whole images, or pose clouds and masked parts of images.
    out_folder = Path(out)
    if dataset.bop is not None:
        if dataset.masks == "search":
            return search_dataset(method, dataset, pose_inputs.object, out_folder)
        return predict_poses_of_dataset(
            method, dataset, pose_inputs.object, spec.config, out_folder, batch
        )
    if pose_inputs.cloud is not None and method.estimator.needs_mask:
        raise InputError(
            f"--cloud {pose_inputs.cloud}: the weights {estimates.weights} need depth images; give "
            "--depth, --mask and --camera, or weights that vote"
        )
    if pose_inputs.depth is not None and not pose_inputs.has_regions:
        code = search_files(method, pose_inputs, out_folder)
    else:
        code = predict_poses_of_files(method, pose_inputs, out_folder, batch)
    return max(code, matching_code)


def evaluate_poses(
    bop: Path,
    out: NewPath,
    split: str = "test",
    weights: tuple[WeightsName, ...] = (),
    csv: tuple[Path, ...] = (),
    predictions: tuple[Path, ...] = (),
    objects: tuple[str, ...] = (),
    adds: SymmetryRule = "declared",
    estimates: options.PoseMeasureOptions = options.PoseMeasureOptions(vsd=True),
) -> int:
    """Measure poses on a BOP or Linemod_preprocessed dataset, and write rows, a table and a page.

    Predictions are made once, as files in OUT/predictions/METHOD_MASKS (poses.json and BOP's csv),
    and measured from there; a second run measures without predicting anew. Several weights and
    kinds of masks may be named at once: their rows share the table. What is not estimated, or
    refused, counts as a failure.

        depthpose pose evaluate --bop lm --split test --weights W.safetensors --out out/lm

    Args:
        bop: folder of the dataset.
        out: folder for rows.json, rows.csv, table.md, report.html, instances.csv and predictions.
        split: name of the split: train, test, ...
        weights: files or names, of the method or of a baseline; also register (registration
            without training), which needs no weights.
        csv: BOP results of any method.
        predictions: folders with poses.json.
        objects: keep these alone, by name or number.
        adds: ADD-S for declared symmetric objects (of LineMOD eggbox and glue), or for all.
    """
    from depthpose.cli.pose.dataset import open_dataset
    from depthpose.cli.pose.evaluate import measure_and_report, predict_instances, print_instances
    from depthpose.cli.pose.masks import prepare_masks
    from depthpose.cli.pose.methods import build_methods
    from depthpose.core.config import config_to_dict
    from depthpose.core.run_folder import claim_folder
    from depthpose.pose.config import EvaluationConfig
    from depthpose.report.page import list_table_files

    dataset = open_dataset(bop, split, estimates.targets, objects)
    print_instances(dataset)
    files = [
        *list_table_files("rows", "instances", "risk"),
        "report.html",
        "predictions",
        "detections",
    ]
    rule = EvaluationConfig(diameters=estimates.diameters, with_vsd=estimates.vsd, adds=adds)
    # Objects and targets are no settings of the folder: a later run may ask for more of them.
    settings = {"bop": str(bop.resolve()), "split": split, "rule": config_to_dict(rule)}
    claim_folder(out, {"command": "pose evaluate", **settings}, files)

    # Predict what is missing, then measure it with the predictions that are given.
    methods = build_methods(weights, estimates.config, tuple(dataset.objects.values()))
    all_masks = prepare_masks(estimates.masks, dataset, out, estimates.device) if methods else []
    folders = [
        predict_instances(dataset, method, masks, out) for method in methods for masks in all_masks
    ]
    return measure_and_report(dataset, [*folders, *csv, *predictions], rule, out)


def track_object(
    out: NewPath,
    weights: WeightsName = "parts",
    frames: options.SequenceOptions = options.SequenceOptions(),
    register: options.RegisterOptions = options.RegisterOptions(),
) -> int:
    """Follow a known object through depth images, clouds or the scenes of a dataset.

    Each frame starts from the pose of the one before and needs ICP alone. Where the depth
    contradicts the pose, the object is detected again in that frame; where that fails too,
    the frame is lost, and the next is searched. In poses.json "tracking" is tracked, found
    (detected again) or lost for each frame; otherwise the files are those of 'pose predict'. Frames
    are taken in the order of their names, numbers in them by value (2 before 10). A rerun begins
    anew; what an interrupted one has found is in poses.json.

        depthpose pose track --depth frames --camera cam.json --object mug --out out
        depthpose pose track --bop lm --split test --weights linemod.safetensors --out out
        depthpose pose track --method register --cad p.stl --cad-unit mm --cloud frames --out out

    Args:
        out: folder for the results.
        weights: weights of a pose network, by name or file ('depthpose weights list').
    """
    from depthpose.cli.pose.methods import make_method_spec
    from depthpose.cli.pose.track import track_dataset, track_files
    from depthpose.core.processes import find_rank

    if find_rank().world > 1:
        raise InputError("a sequence is followed by one process; start one")
    config = EstimateConfig(device=frames.device, min_certainty=frames.min_certainty)
    spec = make_method_spec(
        weights,
        register,
        frames.unit,
        frames,
        config,
        frames.base_from_camera,
        is_registration=register.is_registration(register.cad),
    )
    method = spec.build()
    if method.estimator.needs_mask:
        raise InputError(f"--weights {weights}: these need masked views; give weights that vote")
    track = track_files if frames.bop is None else track_dataset
    return track(method, frames, out)
