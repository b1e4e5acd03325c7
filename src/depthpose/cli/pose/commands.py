"""``depthpose pose ...``."""

from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from depthpose.cli.engine import EngineOptions, Weights
from depthpose.core.errors import InputError
from depthpose.pose.config import (
    DiameterTable,
    EstimateConfig,
    EvaluationConfig,
    SymmetryRule,
    Unit,
    VotingConfig,
    VotingMethod,
)

Voting = Literal["ransac", "least-squares"]
Engine = Annotated[EngineOptions, tyro.conf.OmitArgPrefixes]


def voting_method(name: Voting) -> VotingMethod:
    """Give the method of an option's value, which a shell takes without quotes."""
    return "least squares" if name == "least-squares" else "ransac"


def predict(
    out: str,
    weights: str = "parts",
    cloud: str | None = None,
    unit: Unit | None = None,
    depth: str | None = None,
    mask: str | None = None,
    camera: Path | None = None,
    object: str | None = None,
    bop: Path | None = None,
    split: str = "test",
    masks: str = "truth",
    voting: Voting = "ransac",
    hypotheses: int = 128,
    icp: bool = True,
    up_to_symmetry: bool = False,
    batch: int = 16,
    device: str = "cpu",
    view: str | None = None,
    engine: Engine = EngineOptions(),  # noqa: B008  frozen
) -> int:
    """The pose of known objects from clouds, depth images or a data set; or the reason for none.

    poses.json holds for each input camera_from_model (metres), its covariance (about this answer
    alone), its certainty, the alternatives that fit as well with their probabilities, the risk that
    none of them is right, status and reason, and the seconds of each stage.
    A cloud or depth image NAME gives NAME.pose.ply, the posed model beside the cloud, and
    NAME.pose.png over the depth image; a data set gives depthpose_DATASET-SPLIT.csv, with the
    alternatives too depthpose-alternatives_DATASET-SPLIT.csv, and SCENE_IMAGE.pose.png. report.html
    shows some of them in 3D, and every refusal. A rerun skips
    what is finished; other settings need another --out; no file is written over that is not the
    run's own. Processes of torchrun share the work.

        depthpose pose predict --cloud part.ply --unit mm --object part --out out
        depthpose pose predict --depth d.png --mask m.png --camera cam.json --out out
        depthpose pose predict --depth d.png --camera cam.json --out out
        depthpose pose predict --bop lm --split test --weights linemod.safetensors --out out

    Args:
        out: folder for the results.
        weights: of a pose network, by name or file ('depthpose weights list').
        cloud: points of one object (PLY, PCD, NPY, text), in the camera frame: x right, y down, z
            forward; or a folder of such files.
        unit: of the clouds, metres by default; of depth images, where their camera says none.
        depth: 16-bit PNG in the camera's depth_unit_m, or a folder of them.
        mask: picture, not black is the object, or .json with COCO's run lengths; or a folder of
            masks with the names of the depth images. Without, the image is searched: its planes
            are taken away, and what is left is tried for every object, or for --object alone.
        camera: JSON file: {"width", "height", "K": 3x3, "depth_unit_m"}, or that of BOP, TUM RGB-D,
            ROS, OpenCV, KITTI or Middlebury.
        object: which of the objects that the weights know.
        bop: folder of a data set in BOP's layout, or of Linemod_preprocessed.
        split: of the data set.
        masks: truth (the annotated ones), predicted (those that came with Linemod_preprocessed),
            a JSON file of BOP detections, or weights of a segmentation, by name or file.
        voting: ransac, or least-squares.
        hypotheses: of RANSAC, for each keypoint.
        icp: refine the voted pose by ICP.
        up_to_symmetry: copies of an object that look nearly alike are one answer, not alternatives.
        batch: inputs in one call of the network.
        device: cpu, cuda, cuda:1, ...
        view: live shows each result in Rerun's viewer (an extra) as it comes; FILE.rrd records it.
        engine: where the work is done.
    """
    from depthpose.cli.pose import inputs, predicting
    from depthpose.cli.pose.methods import pose_methods
    from depthpose.cli.pose.page import write_pose_page
    from depthpose.core.run import own_device

    _refuse_mixture(cloud, depth, bop)
    config = EstimateConfig(
        voting=VotingConfig(method=voting_method(voting), hypotheses=hypotheses),
        with_icp=icp,
        up_to_symmetry=up_to_symmetry,
        device=own_device(device),
    )
    if engine.is_ray:
        given = (cloud, depth, mask, camera) if bop is None else (bop, split, masks)
        return _predict_on_ray(given, weights, config, (object, unit, batch), out, engine)
    (method,) = pose_methods([weights], config)
    if bop is not None:
        return _predict_bop(method, (bop, split, masks), Path(out), batch, config.device, view)
    if cloud is not None and not method.takes_clouds:
        raise InputError(
            f"--cloud {cloud}: the weights {weights} use depth images; give --depth, --mask "
            "and --camera, or weights that vote"
        )
    home = Path(out)
    if depth is not None and mask is None and camera is not None:
        known = tuple(model.name for model in method.models)
        wanted = known if object is None else (inputs.object_named(object, method),)
        from depthpose.cli.pose.finding import find_all

        return find_all(method, Path(depth), camera, wanted, unit, home)
    name = inputs.object_named(object, method)
    if cloud is not None:
        jobs = inputs.cloud_jobs(Path(cloud), unit or "m", name, home)
        settings: dict[str, Any] = {"unit": unit or "m"}
    else:
        assert depth is not None
        if mask is None or camera is None:
            raise InputError(
                "--depth needs --camera beside it, and --mask unless it is to be found"
            )
        jobs = inputs.view_jobs((Path(depth), Path(mask), camera), name, unit, home)
        settings = {"camera": str(camera.resolve()), "mask": str(Path(mask).resolve())}
        settings |= {} if unit is None else {"unit": unit}
    settings = {**method.settings, "object": name, **settings}
    predicting.claim(home, settings, jobs, Path(cloud or depth or out))
    predictions = predicting.predict_all(method, jobs, home, settings, batch, view)
    if predictions is None:
        return 0
    predicting.write_files(predictions, jobs, home, method)
    write_pose_page(home, predictions, jobs, method)
    return predicting.say_result(predictions, home)


def evaluate(
    bop: Path,
    out: Path,
    split: str = "test",
    weights: tuple[str, ...] = (),
    csv: tuple[Path, ...] = (),
    predictions: tuple[Path, ...] = (),
    masks: tuple[str, ...] = ("truth",),
    objects: tuple[str, ...] = (),
    targets: Path | None = None,
    diameters: DiameterTable = "bop",
    adds: SymmetryRule = "declared",
    vsd: bool = True,
    voting: Voting = "ransac",
    icp: bool = True,
    device: str = "cpu",
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
        weights: files or names, of the method or of a baseline; open3d is registration by
            Open3D (an extra), which has none.
        csv: BOP results of any method.
        predictions: folders with poses.json.
        masks: truth; predicted (those that came with Linemod_preprocessed); a JSON file of BOP
            detections; or weights of a segmentation. Each is a column of its own.
        objects: keep these alone, by name or number.
        targets: a BOP list of targets, such as test_targets_bop19.json; by default all instances.
        diameters: bop: as the data set declares them; pvnet: PVNet's table of LineMOD.
        adds: declared: ADD-S for objects declared symmetric (of LineMOD eggbox and glue); all.
        vsd: draw poses for VSD and BOP's average recall, which takes most of the time.
        voting: ransac, or least-squares.
        icp: refine each pose by ICP.
        device: cpu, cuda, cuda:1, ...
    """
    from depthpose.cli.pose import evaluating
    from depthpose.cli.pose.masks import find_masks
    from depthpose.cli.pose.methods import pose_methods, predict_all
    from depthpose.core.run import claim_folder
    from depthpose.report.tables import table_files

    if not (weights or csv or predictions):
        raise InputError("measure --weights FILE, --csv FILE or --predictions DIR, or several.")
    dataset = evaluating.open_instances(bop, split, objects, targets)
    files = [*table_files("rows", "instances", "risk"), "report.html", "predictions", "detections"]
    claim_folder(out, {"command": "pose evaluate"}, files)
    config = EstimateConfig(
        voting=VotingConfig(method=voting_method(voting)), with_icp=icp, device=device
    )
    methods = pose_methods(weights, config, tuple(dataset.objects.values()))
    shown = find_masks(masks, dataset, out, device) if methods else []
    paths = [predict_all(dataset, method, one, out) for method in methods for one in shown]
    rule = EvaluationConfig(diameters=diameters, adds=adds, with_vsd=vsd)
    return evaluating.measure(dataset, [*paths, *csv, *predictions], rule, out)


def _predict_bop(
    method: Any,  # noqa: ANN401  a type of this would load torch for --help
    given: tuple[Path, str, str],
    out: Path,
    batch: int,
    device: str,
    view: str | None,
) -> int:
    from depthpose.cli.pose import inputs, predicting
    from depthpose.cli.pose.masks import find_masks
    from depthpose.cli.pose.page import write_pose_page
    from depthpose.pose.datasets import open_bop

    folder, split, word = given
    dataset = open_bop(folder, split)
    dataset = dataset.of_objects(*inputs.known_objects(dataset, method))
    (masks,) = find_masks([word], dataset, out, device)
    settings = {"dataset": dataset.folder.resolve().name, "split": split, "masks": masks.name}
    jobs = inputs.bop_jobs(dataset, masks, method)
    settings = {**method.settings, **settings, **masks.settings}
    predicting.claim_bop(out, settings, dataset)
    predictions = predicting.predict_all(method, jobs, out, settings, batch, view)
    if predictions is None:
        return 0
    predicting.write_bop_files(predictions, dataset, out, method)
    write_pose_page(out, predictions, jobs, method, dataset)
    return predicting.say_result(predictions, out)


def _predict_on_ray(
    given: tuple[str | None, str | None, str | None, Path | None] | tuple[Path, str, str],
    weights: str,
    config: EstimateConfig,
    details: tuple[str | None, Unit | None, int],
    out: str,
    on: EngineOptions,
) -> int:
    from depthpose.cli.pose import engine

    object, unit, batch = details
    if len(given) == 3:
        return engine.predict_bop(given, Weights.read(weights), config, batch, out, on)
    cloud, depth, mask, camera = given
    if depth is not None and camera is None:
        raise InputError("--depth needs --camera beside it")
    files = engine.cloud_files() if depth is None else engine.VIEW_FILES
    work = engine.PoseWork(
        weights=Weights.read(weights),
        config=config,
        object=object or "",
        unit=unit,
        camera=None,
        files=files,
        batch=batch,
    )
    words = [word for word in (cloud, depth, mask) if word is not None]
    return engine.predict(words, files, work, camera, out, on)


def _refuse_mixture(cloud: str | None, depth: str | None, bop: Path | None) -> None:
    given = sum(word is not None for word in (cloud, depth, bop))
    if given != 1:
        raise InputError(
            f"{given} of --cloud, --depth and --bop are given; give one: a cloud, a depth image "
            "with --mask and --camera, or a data set"
        )
