"""A rectified pair as the depth image of a pose: matched, without what the match is unsure of."""

import sys
from pathlib import Path

import torch

from depthpose.cli import depth_predict as work
from depthpose.cli.depth_options import PairNetworks
from depthpose.cli.pose_options import PairOptions
from depthpose.core.camera import StereoRig, read_rig
from depthpose.core.errors import InputError
from depthpose.core.files import image_size, read_map, write_map
from depthpose.core.files.images import refuse_among_inputs
from depthpose.core.run import claim_folder, is_whole, note_result
from depthpose.depth.config import MatcherConfig
from depthpose.depth.disparity import depth_deviation

MATCHED = "matched"
DEPTH = "depth"
DEVIATION = "depth_std"
"""Folders of what 'depth match' writes, of the depth that is posed, and of its deviation."""


def match_pairs(pair: PairOptions, camera: Path | None, device: str, out: Path) -> Path:
    """Match pairs, and give their depth for pose commands: NAME.npy in metres, or its folder.

    OUT/matched has what 'depth match' writes, OUT/depth the depth that is as sure as
    ``pair.min_confidence``, and OUT/depth_std its standard deviation. A rerun does not match again.

    Raises:
        InputError: no right image, a camera without a baseline, or no depth that is sure enough.
    """
    if pair.left is None or pair.right is None or camera is None:
        raise InputError(
            "--left needs --right and --camera beside it: the other view, and the file of the rig "
            'with "baseline_m"'
        )
    if not 0 <= pair.min_confidence <= 1:
        raise InputError(
            f"--min-confidence {pair.min_confidence:g}: a confidence lies in 0 to 1; 0 keeps all"
        )
    pairs = work.list_pairs(pair.left, pair.right)
    refuse_among_inputs(out, (pair.left, pair.right), [path for both in pairs for path in both])
    networks = PairNetworks(matcher=pair.matcher)
    weights = None if pair.matcher == "sgbm" else pair.matcher or "default"
    method = work.DepthMethodSource(
        weights=weights, config=MatcherConfig(device=device), with_right=True, use="pairs"
    )
    depth_work = work.pair_work(camera, networks, method, pairs[0])
    built = method.build()
    work.predict_files(pairs, depth_work, built, out / MATCHED)
    rig = read_rig(camera, image_size(pairs[0][0]))
    for first, _ in pairs:
        _keep_sure(first.stem, rig, pair.min_confidence, out)
    # One pair is one depth image, whose mask may have any name.
    return out / DEPTH / f"{pairs[0][0].stem}.npy" if len(pairs) == 1 else out / DEPTH


def _keep_sure(name: str, rig: StereoRig, min_confidence: float, out: Path) -> None:
    """Write the depth of a pair where it is sure enough, and its standard deviation."""
    home = out / MATCHED
    if not is_whole(home, name, [f"{name}.depth_m.npy"]):
        return  # it failed, as was said
    settings = {"min_confidence": min_confidence}
    folders = [out / DEPTH, out / DEVIATION]
    for folder in folders:
        claim_folder(folder, settings)
    if all(is_whole(folder, name, [f"{name}.npy"]) for folder in folders):
        return
    depth_m = read_map(home / f"{name}.depth_m.npy")
    confidence = torch.ones_like(depth_m)
    if (home / f"{name}.confidence.npy").is_file():
        confidence = read_map(home / f"{name}.confidence.npy")
    is_sure = confidence >= min_confidence
    kept_m = torch.where(is_sure, depth_m, torch.nan)
    if not bool(kept_m.isfinite().any()):
        raise InputError(
            f"{name}: no depth is as sure as {min_confidence:g}, so there is nothing to pose; "
            "give a lower --min-confidence"
        )
    left_out = 1 - float(kept_m.isfinite().sum() / depth_m.isfinite().sum())
    print(
        f"{name}: {left_out:.1%} of the depth is less sure than {min_confidence:g} and left out",
        file=sys.stderr,
    )
    deviation_m = depth_deviation(depth_m, confidence, rig)
    for folder, values in zip(folders, (kept_m, deviation_m), strict=True):
        write_map(folder / f"{name}.npy", torch.where(is_sure, values, torch.nan))
        note_result(folder, name, [folder / f"{name}.npy"])
