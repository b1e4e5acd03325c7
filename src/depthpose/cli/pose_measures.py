"""``depthpose pose evaluate``."""

from pathlib import Path

from depthpose.core.errors import InputError
from depthpose.pose.config import (
    DiameterTable,
    EstimateConfig,
    EvaluationConfig,
    SymmetryRule,
    VotingConfig,
    VotingMethod,
)


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
    voting: VotingMethod = "ransac",
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
        weights: files or names, of the method or of a baseline.
        csv: BOP results of any method.
        predictions: folders with poses.json.
        masks: truth; predicted (those that came with Linemod_preprocessed); a JSON file of BOP
            detections; or weights of a segmentation. Each is a column of its own.
        objects: keep these alone, by name or number.
        targets: a BOP list of targets, such as test_targets_bop19.json; by default all instances.
        diameters: bop: as the data set declares them; pvnet: PVNet's table of LineMOD.
        adds: declared: ADD-S for objects declared symmetric (of LineMOD eggbox and glue); all.
        vsd: draw poses for VSD and BOP's average recall, which takes most of the time.
        voting: ransac, or least squares.
        icp: refine each pose by ICP.
        device: cpu, cuda, cuda:1, ...
    """
    from depthpose.cli import pose_evaluating, pose_methods

    if not (weights or csv or predictions):
        raise InputError("measure --weights FILE, --csv FILE or --predictions DIR, or several.")
    dataset = pose_evaluating.open_instances(bop, split, objects, targets)
    config = EstimateConfig(voting=VotingConfig(method=voting), with_icp=icp, device=device)
    methods = [pose_methods.pose_method(word, config) for word in weights]
    shown = [pose_methods.find_masks(word, dataset, out) for word in masks] if methods else []
    paths = [
        pose_methods.predict_all(dataset, method, one, out) for method in methods for one in shown
    ]
    rule = EvaluationConfig(diameters=diameters, adds=adds, with_vsd=vsd)
    measured = pose_evaluating.measure_all(dataset, [*paths, *csv, *predictions], rule)
    return pose_evaluating.report(dataset, measured, out)
