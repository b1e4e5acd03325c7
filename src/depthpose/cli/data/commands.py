"""``depthpose data ...``."""

import math
import sys
from collections.abc import Iterable
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import tyro

from depthpose.cli.help import group
from depthpose.cli.options import Device
from depthpose.core.errors import InputError

if TYPE_CHECKING:
    from depthpose.depth.datasets import Duplicate, Frame
    from depthpose.depth.estimator import FakestereoNet
    from depthpose.depth.labels import LabelConfig


@group
class LabelOptions:
    """What matches the pairs, and what counts as known."""

    weights: str = "default"
    """with a matcher, by name or file; their terms hold for the labels too."""
    device: Device = "cpu"
    max_difference_px: float = 1.0
    """largest difference of the two views' disparities."""
    max_difference_share: float = 0.03
    """the same as a share of the disparity; the larger limit counts."""
    min_confidence: float = 0.5
    """least confidence of the matcher."""

    @property
    def config(self) -> "LabelConfig":
        """Limits of the labels."""
        from depthpose.depth.labels import LabelConfig  # --help must not load torch

        return LabelConfig(
            largest_difference_px=self.max_difference_px,
            largest_share=self.max_difference_share,
            least_confidence=self.min_confidence,
        )

    def load(self) -> "FakestereoNet":
        """Build the matcher of the weights."""
        from depthpose.depth.config import MatcherConfig
        from depthpose.depth.estimator import FakestereoNet  # --help must not load torch

        return FakestereoNet.load(self.weights, config=MatcherConfig(device=self.device))


@group
class ExportOptions:
    """Whose files are written."""

    files: Literal["png", "npy"] = "png"
    """of nerfstudio: png holds at most 65.535 m, farther pixels are unknown; npy holds all."""
    images: Path | None = None
    """of colmap: folder that image names are relative to; by default that of each image."""
    scale: float = 1.0
    """units of the reconstruction per metre."""

    def refuse_unusable(self, format: str) -> None:
        """Refuse a scale out of its range, and images of another format.

        Raises:
            InputError: which, and the rule.
        """
        if not (math.isfinite(self.scale) and self.scale > 0):
            raise InputError(
                f"--scale {self.scale:g}: units per metre must be positive; 1 for metres"
            )
        if self.images is not None and format != "colmap":
            raise InputError(f"--images {self.images} is for --format colmap; remove it")


def check(
    path: tyro.conf.Positional[Path], split: str | None = None, with_decoding: bool = True
) -> int:
    """Read a data set and list everything that is wrong: pairs, KITTI, Middlebury, BOP, LineMOD.

    Prints a line for each file that is missing, truncated or of the wrong size, and a summary.
    Exit code 0: nothing wrong. 1: something is. 2: the layout of the folder is unknown.

    Args:
        path: the dataset's folder.
        split: only these frames: eigen-train, -val, -train-val, -test, -benchmark, or a file of
            monodepth's or monodepth2's form; of a BOP dataset, one of its splits.
        with_decoding: decode every image in full, which finds truncation, and pairs that are
            swapped, not rectified or no pair; off reads headers only.
    """
    from tqdm import tqdm

    from depthpose.depth.datasets import check_dataset
    from depthpose.pose.datasets import check_bop, is_bop

    check_folder = check_bop if is_bop(path) else check_dataset
    with tqdm(unit=" frames", leave=False, disable=None) as bar:
        show = partial(_show_done, bar)
        report = check_folder(path, split, with_decoding=with_decoding, progress=show)
    for problem in (*report.notices, *report.problems):
        print(f"{problem.kind}: {problem.path}: {problem.message}")
    print(report.summary)
    return 0 if report.is_ok else 1


def _show_done(bar: Any, done: int, total: int) -> None:  # noqa: ANN401  tqdm's
    bar.total = total
    bar.update(done - bar.n)


def pack(
    path: tyro.conf.Positional[Path], out: Path, split: str | None = None, shard_mb: int = 256
) -> int:
    """Pack a data set of images, pairs and their truth into tar shards, in WebDataset's form.

    OUT, or a URL of its copy (s3://, gs://), is used as any data set; a URL's shards are cached in
    ~/.cache/depthpose or $DEPTHPOSE_CACHE. Files are unchanged. Interrupted, packing begins again.

        depthpose data pack KITTI --split eigen-train-val --out shards

    Args:
        path: the data set's folder.
        out: a new folder for shards, calibration and index.
        split: pack these frames alone.
        shard_mb: size from which on the next shard begins [1e6 bytes].
    """
    from tqdm import tqdm

    from depthpose.depth.datasets import open_dataset, pack_frames

    if shard_mb < 1:
        raise InputError(f"--shard-mb {shard_mb}: a shard has a megabyte or more; take 256")
    dataset = open_dataset(path, split)
    _refuse_to_pack(path, dataset.frames, out)
    with tqdm(total=len(dataset), unit=" frames", disable=None) as bar:
        shards = pack_frames(dataset.frames, out, shard_mb * 10**6, lambda _: bar.update())
    print(f"{len(dataset)} frames in {shards} shards: {out}")
    return 0


def _refuse_to_pack(path: Path, frames: "list[Frame]", out: Path) -> None:
    from depthpose.core.run import refuse_to_replace

    refuse_to_replace(out / "index.json")
    if any(part.suffix == ".tar" for frame in frames[:1] for part in frame.left.parents):
        raise InputError(f"{path}: is packed already; give the folder that it was made of")
    if out.resolve() == path.resolve():
        raise InputError(
            f"--out {out}: is the data set itself, which would be read as packed from then on; "
            "choose another folder"
        )


def duplicates(
    train: tyro.conf.Positional[Path],
    evaluation: tyro.conf.Positional[Path],
    at_least: float = 0.3,
    out: Path | None = None,
) -> int:
    """List images of one set that show nearly the same as images of another.

    Training on frames of the evaluation's drives makes every number too good. Left images are
    compared by their fine structure over small shifts and zooms: 1 is the same image, two streets
    stay below 0.3. Check the listed images by eye. The most similar pair is always printed. Exit
    code 0: none listed. 1: some.

        depthpose data duplicates my-pairs kitti-eval

    Args:
        train: folder of the first set, in any layout that 'data check' knows.
        evaluation: folder of the second set.
        at_least: least similarity of a listed pair.
        out: folder to write the list to as well: duplicates.json, .csv and .md.
    """
    from tqdm import tqdm

    from depthpose.core.run import claim_folder
    from depthpose.depth.datasets import find_duplicates, open_dataset
    from depthpose.report.page import table_files

    if not -1 <= at_least <= 1:
        raise InputError(f"--at-least {at_least:g}: a similarity is -1 .. 1; take 0.3")
    sets = open_dataset(train), open_dataset(evaluation)
    if out is not None:
        about = {"train": str(train.resolve()), "evaluation": str(evaluation.resolve())}
        about |= {"command": "data duplicates", "at_least": at_least}
        claim_folder(out, about, table_files("duplicates"))
    ranked = find_duplicates(*sets, at_least, partial(tqdm, unit=" frames", disable=None))
    count = _list_duplicates([pair for pair in ranked if pair.similarity >= at_least], out)
    best = f"{ranked[0].first} and {ranked[0].second}, {ranked[0].similarity:.3f}"
    size = f"{len(sets[0])} x {len(sets[1])} images"
    print(f"{size}: {count} pairs of similarity {at_least:g} or more; the most similar: {best}")
    return 1 if count else 0


def _list_duplicates(pairs: "list[Duplicate]", out: Path | None) -> int:
    """Print pairs, and write them; give their number."""
    from depthpose.report.page import markdown_table, write_table

    rows = [asdict(pair) for pair in pairs]
    if rows:
        print(markdown_table(rows))
    if out is not None:
        write_table(out, rows, name="duplicates")
    return len(rows)


def label(
    path: tyro.conf.Positional[Path],
    out: Path,
    labels: LabelOptions = LabelOptions(),
) -> int:
    """Make truth for pairs that have none: match them both ways, keep where both views agree.

    Writes a folder of pairs that every training takes; those that cannot be read are left out. Such
    labels are no better than their matcher, and leak evaluation frames that it was trained on.

        depthpose data label my-pairs --out my-pairs-labelled

    Args:
        path: a dataset with right views and calibration.
        out: folder to write to.
    """
    from depthpose.core.checkpoint import file_sha256, find_weights
    from depthpose.depth.datasets import open_dataset
    from depthpose.depth.labels import label_pairs

    config = labels.config
    dataset = open_dataset(path)
    sha256 = file_sha256(find_weights(labels.weights))
    settings = {"dataset": dataset.name, "weights_sha256": sha256, **asdict(config)}
    failures: list[InputError] = []
    noted = failures if len(dataset) > 1 else None
    labelled = label_pairs(labels.load(), dataset, config, out, settings, failures=noted)
    shares = [share for _, share in _shown(labelled, None, "pairs")]
    return _say_labelled(out, shares, failures)


def _say_labelled(out: Path, shares: list[float], failures: list[InputError]) -> int:
    for failure in failures:
        print(f"depthpose: failed: {failure}", file=sys.stderr)
    known = f", {sum(shares) / len(shares):.0%} of their pixels labelled" if shares else ""
    failed = f"{len(failures)} failed, " if failures else ""
    print(f"{out}: {len(shares)} pairs labelled{known}; {failed}the others were there")
    return 1 if failures else 0


def export_depth(
    results: tyro.conf.Positional[Path],
    format: Literal["colmap", "nerfstudio"],
    out: Path,
    export: ExportOptions = ExportOptions(),
) -> int:
    """Write depth of 'depth predict' or 'depth match' as files of COLMAP or nerfstudio.

    colmap: OUT/stereo/depth_maps/IMAGE.geometric.bin; OUT is a dense workspace. COLMAP's
    stereo_fusion needs normal maps too, which are not written.
    nerfstudio: OUT/depths/NAME.png or .npy in millimetres, 0 where nothing is known. Where OUT
    holds transforms.json, transforms_depth.json is written beside it, with depth_file_path of
    each frame: ns-train depth-nerfacto --data OUT/transforms_depth.json.
    Depth is in metres; a reconstruction from images alone has another unit: --scale is the number
    of its units in a metre.

        depthpose data export-depth out --format colmap --out dense
        depthpose data export-depth out --format nerfstudio --files npy --out data

    Args:
        results: folder of predictions.
        format: program whose format is written.
        out: folder to write to: COLMAP's dense workspace, or nerfstudio's data set.
    """
    export.refuse_unusable(format)
    if format == "colmap":
        return _export_colmap(results, out, export)
    return _export_nerfstudio(results, out, export)


def _export_colmap(results: Path, out: Path, options: ExportOptions) -> int:
    from depthpose.core.run import claim_folder
    from depthpose.depth import exchange

    named = exchange.colmap_files(results, options.images)
    claim_folder(out, _export_settings(results, options, "colmap"), named.values())
    list(_shown(exchange.write_colmap(results, out, named, options.scale), len(named), "frames"))
    print(f"{out}: depth of {len(named)} images in stereo/depth_maps")
    return 0


def _export_nerfstudio(results: Path, out: Path, options: ExportOptions) -> int:
    from depthpose.core.run import claim_folder
    from depthpose.depth import exchange

    named = exchange.nerfstudio_files(results, options.files)
    frames = exchange.nerfstudio_frames(out, named)
    own = {**_export_settings(results, options, "nerfstudio"), "files": options.files}
    claim_folder(out, own, [*named.values(), exchange.TRANSFORMS_DEPTH])
    written = exchange.write_nerfstudio(results, out, named, options.scale)
    lost = sum(_shown(written, len(named), "frames"))
    if frames is not None:
        exchange.write_transforms(out, frames)
    _say_nerfstudio(out, len(named), lost, is_listed=frames is not None)
    return 0


def _export_settings(results: Path, options: ExportOptions, format: str) -> dict[str, Any]:
    folder = str(results.resolve())
    own = {"command": "data export-depth", "results": folder, "scale": options.scale}
    return {**own, "format": format}


def _shown(written: "Iterable[Any]", total: int | None, what: str) -> "Iterable[Any]":
    from tqdm import tqdm

    return tqdm(written, total=total, unit=f" {what}", leave=False, disable=None)


def _say_nerfstudio(out: Path, frames: int, lost: int, *, is_listed: bool) -> None:
    beside = "transforms_depth.json names them" if is_listed else "there is no transforms.json"
    print(f"{out}: depth of {frames} frames in depths; {beside}")
    if lost:
        print(
            f"depthpose: {lost} pixels are beyond 65.535 m, which a PNG cannot hold, and are "
            "unknown there; --files npy keeps them",
            file=sys.stderr,
        )
