"""``depthpose data check``, ``data pack`` and ``data label``: datasets that exist."""

import sys
from dataclasses import asdict
from pathlib import Path

import tyro

from depthpose.cli.arguments import Device, NewPath, WeightsName, refuse_below
from depthpose.core.errors import InputError


def check_dataset(
    path: tyro.conf.Positional[Path], split: str | None = None, with_decoding: bool = True
) -> int:
    """Read a dataset and list everything that is wrong: pairs, KITTI, Middlebury, BOP, LineMOD.

    A line for each missing, truncated or wrong file, and a summary. Exit code 0: nothing wrong. 1:
    something is. 2: the layout of the folder is unknown.

    Args:
        path: the dataset's folder.
        split: only these frames: eigen-train, -val, -train-val, -test, -benchmark, a file of
            monodepth's or monodepth2's form, or a split of a BOP dataset.
        with_decoding: decode every image in full, which finds truncation, and pairs that are
            swapped, not rectified or no pair; off reads headers only.
    """
    from tqdm import tqdm

    from depthpose.depth import datasets as depth_datasets
    from depthpose.pose.datasets import LAYOUTS, check_bop

    is_bop = any(layout.splits(path) for layout in LAYOUTS.values())
    check_folder = check_bop if is_bop else depth_datasets.check_dataset
    with tqdm(unit=" frames", leave=False, disable=None) as bar:

        def show(done: int, total: int) -> None:
            """Move the bar to the number of frames that are done."""
            bar.total = total
            bar.update(done - bar.n)

        report = check_folder(path, split, with_decoding=with_decoding, progress=show)
    for problem in (*report.notices, *report.problems):
        print(f"{problem.kind}: {problem.path}: {problem.message}")
    print(report.summary)
    return 0 if report.is_ok else 1


def pack_dataset(
    path: tyro.conf.Positional[Path], out: NewPath, split: str | None = None, shard_mb: int = 256
) -> int:
    """Pack a dataset of images, pairs and their truth into tar shards, in WebDataset's form.

    OUT, or a URL of its copy (s3://, gs://), is used as any dataset; a URL's shards are cached in
    ~/.cache/depthpose or $DEPTHPOSE_CACHE. Files are unchanged. Interrupted, packing begins again.

        depthpose data pack KITTI --split eigen-train-val --out shards

    Args:
        path: the dataset's folder.
        out: a new folder for shards, calibration and index.
        split: pack these frames alone.
        shard_mb: size from which on the next shard begins [1e6 bytes].
    """
    from tqdm import tqdm

    from depthpose.core.run_folder import refuse_to_replace
    from depthpose.depth.datasets import open_dataset, pack_frames

    refuse_below(1, "--shard-mb", shard_mb, "256")
    dataset = open_dataset(path, split)
    refuse_to_replace(out / "index.json")
    # The images of packed datasets lie in tar files.
    first_folders = [folder for frame in dataset.frames[:1] for folder in frame.left.parents]
    if any(folder.suffix == ".tar" for folder in first_folders):
        raise InputError(f"{path}: is packed already; give the folder that it was made of")
    if out.resolve() == path.resolve():
        raise InputError(
            f"--out {out}: is the dataset itself, which would be read as packed from then on; "
            "choose another folder"
        )
    with tqdm(total=len(dataset), unit=" frames", disable=None) as bar:
        shards = pack_frames(dataset.frames, out, shard_mb * 10**6, lambda _: bar.update())
    print(f"{len(dataset)} frames in {shards} shards: {out}")
    return 0


def label_dataset(
    path: tyro.conf.Positional[Path],
    out: NewPath,
    weights: WeightsName = "default",
    device: Device = "cpu",
    max_difference_px: float = 1.0,
    max_difference_share: float = 0.03,
    min_confidence: float = 0.5,
) -> int:
    """Label stereo pairs that have no true disparity: match them, keep where both views agree.

    Writes a folder of pairs that every training takes, with the pseudo-labels as truth; pairs that
    cannot be read are left out. Labels are no better than the matcher, and if it was trained on
    evaluation frames, so is what trains on its labels.

        depthpose data label my-pairs --out my-pairs-labelled

    Args:
        path: a dataset with right views and calibration.
        out: folder to write to.
        weights: weights with a matcher, by name or file; their terms hold for the labels too.
        max_difference_px: largest difference of the two views' disparities.
        max_difference_share: the same as a share of the disparity; the larger limit counts.
        min_confidence: least confidence of the matcher.
    """
    from tqdm import tqdm

    from depthpose.core.checkpoint import file_sha256, find_weights
    from depthpose.depth.config import MatcherConfig
    from depthpose.depth.datasets import open_dataset
    from depthpose.depth.estimator import FakestereoNet
    from depthpose.depth.labels import LabelConfig, label_pairs

    # What decides the labels, and so stands in the record of the folder.
    config = LabelConfig(
        largest_difference_px=max_difference_px,
        largest_share=max_difference_share,
        least_confidence=min_confidence,
    )
    dataset = open_dataset(path)
    sha256 = file_sha256(find_weights(weights))
    settings = {"dataset": dataset.name, "weights_sha256": sha256, **asdict(config)}

    # A pair that fails is named at the end and stops no other; the only pair ends the command.
    failures: list[InputError] = []
    collected = failures if len(dataset) > 1 else None
    net = FakestereoNet.load(weights, config=MatcherConfig(device=device), with_check=False)
    labelled = label_pairs(net, dataset, config, out, settings, failures=collected)
    shown = tqdm(labelled, unit=" pairs", leave=False, disable=None)
    shares = [labelled_share for _, labelled_share in shown]

    for failure in failures:
        print(f"depthpose: failed: {failure}", file=sys.stderr)
    print(f"{out}: {_summarise_labels(shares, len(failures))}")
    return 1 if failures else 0


def _summarise_labels(shares: list[float], failure_count: int) -> str:
    """Describe the outcome of a labelling for the user.

    ``shares``: share of the pixels that were labelled, of each pair.
    """
    share = f", {sum(shares) / len(shares):.0%} of their pixels labelled" if shares else ""
    failed = f"{failure_count} failed, " if failure_count else ""
    return f"{len(shares)} pairs labelled{share}; {failed}the others were labelled before"
