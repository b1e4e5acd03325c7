"""The work behind ``depthpose depth evaluate``."""

import hashlib
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any, cast, get_args

from tqdm import tqdm

from depthpose.cli.depth_options import MethodOptions
from depthpose.cli.depth_predict import DepthMethod, DepthMethodSource
from depthpose.core import engine
from depthpose.core.errors import InputError
from depthpose.core.run import environment, find_rank, read_settings, wait_for
from depthpose.core.runner import Job
from depthpose.depth.baselines import NearestImageBaseline, RowDepthBaseline
from depthpose.depth.config import Answer, BaselineName, MatcherConfig, Speed
from depthpose.depth.datasets import Dataset, join_datasets, open_dataset, refuse_common
from depthpose.depth.estimator import FakestereoNet
from depthpose.depth.evaluate import (
    PROTOCOLS,
    Evaluation,
    EvaluationRow,
    Measured,
    Protocol,
    evaluate,
    frame_result,
    has_truth,
    measure_frame,
    summarise,
)
from depthpose.depth.metrics import METRICS, RANKING
from depthpose.depth.predictions import is_finished, predict
from depthpose.depth.types import DepthEstimate, StereoInput
from depthpose.report import page
from depthpose.report.depth import depth_section
from depthpose.report.page import Section

_IN_THE_TABLE = ("method", "input", "speed", "weights", "protocol", "dataset")
"""Columns that the title of a frame's part of the page says already."""


def open_frames(data: Path, split: str | None) -> Dataset:
    """Open the dataset and print what it is."""
    dataset = open_dataset(data, split)
    print(f"{dataset.name}: {len(dataset)} frames, layout {dataset.layout}")
    return dataset


def predict_dataset(dataset: Dataset, method: DepthMethod, rule: Protocol, folder: Path) -> Path:
    """Predict every frame that has truth to compare with, and a right view if it is needed.

    Of several processes each predicts its share, and the first goes on when all files are there.
    """
    process = find_rank()
    home = folder / method.name
    usable = [
        (i, frame)
        for i, frame in enumerate(dataset.frames)
        if has_truth(frame, rule) and (frame.right is not None or not method.with_right)
    ]

    def read(index: int) -> StereoInput:
        pair = dataset.read_input(index)
        return pair if method.with_right else replace(pair, right=None)  # what it must not see

    mine = process.share_of(usable)
    frame_jobs = [Job(name=frame.name, read=partial(read, i)) for i, frame in mine]
    sources = {f.name: f.seen_files(with_right=method.with_right) for _, f in usable}
    net = _Unchecked(method.net) if isinstance(method.net, FakestereoNet) else method.net
    written = predict(net, frame_jobs, home, method.settings, sources)
    for _ in tqdm(written, method.name, total=len(frame_jobs), disable=None, unit=" frames"):
        pass
    if process.rank == 0:
        wait_for(list(sources), partial(is_finished, home))
    return home


@dataclass(frozen=True)
class _Unchecked:
    """A network that answers every pair, as a measurement must."""

    net: FakestereoNet

    def estimate_pair(self, pair: StereoInput, /) -> DepthEstimate:
        return self.net.estimate_pair(pair, with_check=False)


def choose_methods(
    options: MethodOptions, config: MatcherConfig, dataset: Dataset
) -> list[DepthMethod]:
    """Build the methods that are measured: SGBM, weights and baselines, in this order."""
    chosen: list[DepthMethod] = []
    if options.matcher == "sgbm":
        is_filled = options.holes == "fill"
        sgbm = DepthMethodSource(weights=None, config=config, with_filled_holes=is_filled)
        chosen.append(sgbm.build())
    chosen += [named_method(name, config) for name in options.weights]
    names = [method.name for method in chosen]
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise InputError(
            f"two methods are called {twice!r}, and their predictions need two folders; name each "
            "method once, or give files of other names"
        )
    has_right = any(frame.right is not None for frame in dataset.frames)
    if not has_right and (
        matching := next((method for method in chosen if method.with_right), None)
    ):
        raise InputError(
            f"{matching.name} matches both views, and {dataset.name} has no right view; leave it "
            "out ('quick:' and 'fine:' are for both views: for one image, give --speed)"
        )
    if options.baseline:
        training = open_training(options.train, options.train_without, dataset)
        chosen += [baseline_method(name, training) for name in dict.fromkeys(options.baseline)]
    return chosen


def named_method(word: str, config: MatcherConfig) -> DepthMethod:
    """Build the method of a name: weights by file or name, perhaps with ``both:`` and the like."""
    prefix, _, name = word.rpartition(":")
    source = DepthMethodSource(
        weights=name, config=config, with_right=prefix not in get_args(Answer)
    )
    if prefix in get_args(Answer):  # what depth of one image comes from
        return replace(source, answer=cast("Answer", prefix)).build()
    if prefix == "both":
        return source.build()
    if prefix in get_args(Speed):  # how much time the match of a real pair may take
        method = replace(source, config=replace(config, speed=prefix)).build()
        return method._replace(name=f"{method.name}-{prefix}")
    if prefix == "sgbm":
        return replace(source, with_right=False, matcher="sgbm").build()
    return DepthMethodSource(weights=word, config=config).build()


def baseline_method(name: BaselineName, training: Dataset) -> DepthMethod:
    """Fit a baseline to the truth of training frames."""
    kinds = {"rows": RowDepthBaseline, "nearest": NearestImageBaseline}
    names = "\n".join(frame.name for frame in training.frames)
    settings = {
        "matcher": f"baseline: {name}",
        "input": "left view" if name == "nearest" else "no image",
        "train": training.name,
        "train_frames": len(training),
        "train_sha256": hashlib.sha256(names.encode()).hexdigest(),
    }
    show = partial(tqdm, desc=f"fit {name}", unit=" frames", disable=None)
    return DepthMethod(
        f"baseline-{name}", kinds[name].fit(training, show), settings, with_right=False
    )


def open_training(folders: Sequence[Path], without: Sequence[str], measured: Dataset) -> Dataset:
    """Open the frames that a baseline is fitted to, none of which may be measured."""
    if not folders:
        raise InputError(
            "a baseline is fitted to training frames: give --train FOLDER, or several."
        )
    training = join_datasets([open_dataset(folder) for folder in folders], without)
    remedy = "give --train other folders, or name these in --train-without"
    refuse_common(training.frames, measured.frames, "frames to measure", remedy)
    return training


def measure(
    dataset: Dataset,
    folders: Sequence[Path],
    protocol: str,
    caps_m: Sequence[float],
    out: Path,
    ready: Sequence[Evaluation] = (),
) -> int:
    """Measure, write rows, a table and a page, and print; rows that are ``ready`` come last."""
    if find_rank().rank > 0:
        return 0
    evaluations = measure_each(dataset, folders, protocol, caps_m)
    measured = join([*evaluations, *ready])
    rows = [row.columns() for row in measured.rows]
    page.write_table(out, rows)

    # Numbers of pairs without a calibration compare with no others.
    about = f"{protocol}: {PROTOCOLS[protocol].summary}."
    unknown = sum(frame.right is not None and not frame.calibration for frame in dataset.frames)
    if unknown:
        message = (
            f"{unknown} of {len(dataset)} pairs have no calibration, so a network matches them at "
            "their own focal length, not at the one it knows: compare no numbers with those of "
            "frames that have one (KITTI 2015 has calib_cam_to_cam in a download of its own)"
        )
        print(f"depthpose: {message}", file=sys.stderr)
        about += f" {message}."

    # The page: the table, then the best and the worst frames of each method.
    shares = page.share_views(len(folders))
    frame_sections = [
        section
        for folder, evaluation, most in zip(folders, evaluations, shares, strict=True)
        for section in _frame_sections(dataset, folder, evaluation.per_frame, protocol, most)
    ]
    sections = [
        Section(title="Mean over frames", text=about, rows=rows),
        *frame_sections,
        *write_details(measured, out),
    ]
    title = f"{protocol} on {dataset.name}"
    page.write_page(out / "report.html", title, sections, environment())

    metrics = [metric.name for metric in METRICS.values() if metric.is_printed]
    about_row = ["method", "weights", "speed", "cap_m", "frames", "coverage"]
    print(page.plain_table(rows, [*about_row, *metrics, "ause"]))  # files hold every column
    for name, reason in measured.skipped.items():
        print(f"skipped: {name}: {reason}", file=sys.stderr)
    print(f"{len(measured.skipped)} frames skipped")
    print(f"every column: {out / 'table.md'}, rows.csv; the page: {out / 'report.html'}")
    return 0


def _frame_sections(
    dataset: Dataset,
    folder: Path,
    per_frame: Sequence[EvaluationRow],
    protocol: str,
    most: int,
) -> list[Section]:
    """Show up to ``most`` frames of a method, chosen by AbsRel or EPE, at the first cap alone."""
    cap_m = per_frame[0].cap_m
    rows_at_cap = [row for row in per_frame if row.cap_m == cap_m and row.pixels]
    metric = METRICS[RANKING["disparity" if cap_m is None else "depth"]]
    sign = 1 if metric.better == "lower" else -1
    cap_text = "" if cap_m is None else f", truth up to {cap_m:g} m"
    frame_count = f"{len(rows_at_cap)} frame{'' if len(rows_at_cap) == 1 else 's'}"
    index_of = {frame.name: index for index, frame in enumerate(dataset.frames)}
    sections: list[Section] = []
    errors = [sign * row.metrics[metric.name] for row in rows_at_cap]
    for role, k in page.choose_ranked(errors, most):
        row = rows_at_cap[k]
        index = index_of[row.frame or ""]
        estimate, error = frame_result(dataset, index, folder, protocol, row.cap_m)
        section = depth_section(
            f"{folder.name}: {row.frame}, {role}",
            dataset.read_input(index),
            estimate,
            f"The {role} of {frame_count} by {metric.name}: "
            f"{row.metrics[metric.name]:.4f}{cap_text}.",
            error=error,
        )
        columns = {name: v for name, v in row.columns().items() if name not in _IN_THE_TABLE}
        sections.append(replace(section, rows=[columns]))
    return sections


def measure_each(
    dataset: Dataset, folders: Sequence[Path], protocol: str, caps_m: Sequence[float]
) -> list[Evaluation]:
    """Measure folders of predictions one by one; each row says whose it is."""
    show = partial(tqdm, unit=" frames", disable=None)
    return [
        with_source(
            evaluate(dataset, folder, protocol, caps_m, show), folder.name, read_settings(folder)
        )
        for folder in folders
    ]


def with_source(result: Evaluation, name: str, settings: dict[str, Any] | None) -> Evaluation:
    """Add to each row which method, weights and input made the predictions.

    ``settings``: those of the run that made them; None of files by others, which ``name`` names.
    """
    holes = {True: " (holes filled)", False: " (matched pixels)"}
    made_by = settings or {"matcher": name, "input": ""}
    source = {
        "method": made_by.get("matcher", "") + holes.get(made_by.get("with_filled_holes", ""), ""),
        "input": made_by.get("input", "both views"),
        "speed": made_by.get("speed", ""),
        "weights": made_by.get("weights", ""),
    }
    sha256 = made_by.get("weights_sha256", "")[:12]
    return replace(
        result,
        rows=[replace(row, weights_sha256=sha256, **source) for row in result.rows],
        per_frame=[replace(row, **source) for row in result.per_frame],
        deciles=[replace(row, **source) for row in result.deciles],
    )


def join(evaluations: Sequence[Evaluation]) -> Evaluation:
    """Put the rows of several evaluations below each other."""
    return Evaluation(
        rows=[row for evaluation in evaluations for row in evaluation.rows],
        per_frame=[row for evaluation in evaluations for row in evaluation.per_frame],
        deciles=[row for evaluation in evaluations for row in evaluation.deciles],
        skipped={
            name: reason
            for evaluation in evaluations
            for name, reason in evaluation.skipped.items()
        },
    )


def write_details(measured: Evaluation, out: Path) -> list[Section]:
    """Write each frame's numbers, and the error by confidence; give them as parts of a page."""
    frames, deciles = (
        [row.columns() for row in rows] for rows in (measured.per_frame, measured.deciles)
    )
    page.write_table(out, frames, name="frames")
    if deciles:
        page.write_table(out, deciles, name="confidence")
    else:  # those of another method that was measured here before
        for file in page.table_files("confidence"):
            (out / file).unlink(missing_ok=True)
    text = "Mean error of the least sure tenth of each frame's pixels (1) to the surest (10)"
    skipped = [{"frame": name, "why": reason} for name, reason in measured.skipped.items()]
    sections = [
        Section(title="Error by confidence", text=text, rows=deciles),
        Section(title="Each frame", rows=frames),
        Section(title="Skipped frames", rows=skipped),
    ]
    return [section for section in sections if section.rows]


def measure_shards(
    dataset: Dataset, predictions: str, protocol: str, caps_m: Sequence[float]
) -> Evaluation:
    """Measure shards of predictions, one after the other; the rows say whose they are."""
    name = PurePosixPath(predictions).stem
    settings = read_settings(predictions)
    places = {frame.name: index for index, frame in enumerate(dataset.frames)}
    rows: dict[str, list[Measured] | str] = {}
    for done in tqdm(engine.read_results(predictions), name, disable=None, unit=" shards"):
        for frame, files in engine.shard_results(predictions, done):
            if frame not in places:
                continue
            with tempfile.TemporaryDirectory(prefix="depthpose-") as folder:
                for ending, content in files.items():
                    path = Path(folder) / f"{frame}.{ending}"
                    path.parent.mkdir(parents=True, exist_ok=True)
                    path.write_bytes(content)
                rows[frame] = measure_frame(dataset, places[frame], Path(folder), protocol, caps_m)
    with tempfile.TemporaryDirectory() as nothing:
        for frame, index in places.items():
            if frame not in rows:  # it has no truth, or its absence is an error
                rows[frame] = measure_frame(dataset, index, Path(nothing), protocol, caps_m)
    return with_source(summarise(dataset, protocol, rows), name, settings)
