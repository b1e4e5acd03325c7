"""Rectified pairs in place of depth images: they are matched, and unsure depth is left out."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import torch

from depthpose.cli.depth.inputs import PAIRS, InputReader, list_pairs
from depthpose.cli.depth.methods import make_pair_spec
from depthpose.cli.depth.options import PredictOutput
from depthpose.cli.depth.predict import predict_depth_of_files, wait_for_results
from depthpose.cli.pose.options import PairOptions
from depthpose.core.camera import StereoRig, read_rig
from depthpose.core.errors import InputError, result_or_error
from depthpose.core.files import image_size, read_map, write_map
from depthpose.core.files.images import refuse_among_inputs
from depthpose.core.processes import find_rank
from depthpose.core.run_folder import claim_folder, is_result_finished, note_result
from depthpose.depth.config import MatcherConfig
from depthpose.depth.disparity import depth_std_from_confidence

MATCHED = "matched"
"""Folder of the files that 'depth match' writes."""
DEPTH = "depth"
"""Folder of the depth that is posed."""
DEVIATION = "depth_std"
"""Folder of the standard deviation of that depth."""


class MatchedPairs(NamedTuple):
    """Pairs as depth images."""

    depth: Path  #: OUT/depth/NAME.npy of a single pair, or the folder OUT/depth of several
    exit_code: int  #: 1 where some pairs have no depth


def match_pairs_for_poses(
    options: PairOptions, camera: Path | None, device: str, out: Path
) -> MatchedPairs:
    """Match pairs, and write their depth as input of an estimate of poses.

    OUT/matched gets what 'depth match' writes, OUT/depth the depth [m] whose confidence is
    ``options.min_confidence`` at least, and OUT/depth_std its standard deviation [m]. A rerun does
    not match again. A pair without depth that is sure enough is named, and stops no other.

    Args:
        options: left and right images, or their folders; what matches them; the least confidence.
        camera: file of the rig, with its baseline.
        device: device that the matcher runs on.
        out: folder of the run.

    Raises:
        InputError: an image has no partner, a camera no baseline, or no pair has depth that is sure
            enough.
    """
    assert options.left is not None
    assert options.right is not None
    assert camera is not None
    pairs = list_pairs(options.left, options.right)
    images = [path for both in pairs for path in both]
    refuse_among_inputs(out, (options.left, options.right), images)
    spec = make_pair_spec(options.matcher, "default", MatcherConfig(device=device))
    rig = read_rig(camera, image_size(pairs[0][0]))
    reader = InputReader(camera=rig, files=PAIRS)
    exit_code = predict_depth_of_files(pairs, spec.build(), reader, PredictOutput(), out / MATCHED)
    if find_rank().world > 1:
        # This process has matched its share of the pairs, and all need the results of the others.
        wait_for_results(pairs, out / MATCHED, with_cloud=False)

    names = [left.stem for left, _ in pairs]
    if not _write_all_sure_depth(names, rig, options.min_confidence, out):
        exit_code = 1
    if len(names) == 1:
        # A file, not its folder: masks of a folder are matched by name, and that of a file is not.
        return MatchedPairs(out / DEPTH / f"{names[0]}.npy", exit_code)
    if not any((out / DEPTH / f"{name}.npy").is_file() for name in names):
        raise InputError(f"{options.left}: no pair has depth, for the reasons above; correct these")
    _remove_depth_of_others(names, out)
    return MatchedPairs(out / DEPTH, exit_code)


def _write_all_sure_depth(
    names: Sequence[str], rig: StereoRig, min_confidence: float, out: Path
) -> bool:
    """Write the depth of every matched pair where it is sure enough; return whether none failed.

    Raises:
        InputError: every pair failed.
    """
    results = [result_or_error(_write_sure_depth, name, rig, min_confidence, out) for name in names]
    failures = [result for result in results if isinstance(result, InputError)]
    if failures and len(failures) == len(names):
        raise failures[0]
    for failure in failures:
        print(f"depthpose: failed: {failure}", file=sys.stderr)
    return not failures


def _remove_depth_of_others(names: Sequence[str], out: Path) -> None:
    """Remove the depth of other pairs, by an earlier run here, so that it is not posed again."""
    for path in (out / DEPTH).glob("*.npy"):
        if path.stem not in names:
            path.unlink(missing_ok=True)


def _write_sure_depth(name: str, rig: StereoRig, min_confidence: float, out: Path) -> None:
    """Write the depth of a matched pair where it is sure enough, and its standard deviation.

    Nothing is written of a pair that could not be matched, or that an earlier run has finished.

    Args:
        name: name of the pair's results.
        rig: cameras of the pair.
        min_confidence: confidence from which depth is sure enough.
        out: folder of the run.

    Raises:
        InputError: no depth is sure enough.
    """
    matched_folder = out / MATCHED
    if not is_result_finished(matched_folder, name, [f"{name}.depth_m.npy"]):
        return
    settings = {"min_confidence": min_confidence}
    folders = [out / DEPTH, out / DEVIATION]
    for folder in folders:
        claim_folder(folder, settings)
    if all(is_result_finished(folder, name, [f"{name}.npy"]) for folder in folders):
        return

    depth_m = read_map(matched_folder / f"{name}.depth_m.npy")
    # A matcher without confidence is trusted everywhere.
    confidence = torch.ones_like(depth_m)
    confidence_file = matched_folder / f"{name}.confidence.npy"
    if confidence_file.is_file():
        confidence = read_map(confidence_file)
    is_sure = confidence >= min_confidence
    sure_m = torch.where(is_sure, depth_m, torch.nan)
    if not bool(sure_m.isfinite().any()):
        raise InputError(
            f"{name}: no depth is as sure as {min_confidence:g}, so there is nothing to pose; "
            "give a lower --min-confidence"
        )

    unsure = 1 - float(sure_m.isfinite().sum() / depth_m.isfinite().sum())
    print(
        f"{name}: {unsure:.1%} of the depth is less sure than {min_confidence:g} and left out",
        file=sys.stderr,
    )

    deviation_m = depth_std_from_confidence(depth_m, confidence, rig)
    sure_deviation_m = torch.where(is_sure, deviation_m, torch.nan)
    for folder, values_m in zip(folders, (sure_m, sure_deviation_m), strict=True):
        write_map(folder / f"{name}.npy", values_m)
        note_result(folder, name, [folder / f"{name}.npy"])
