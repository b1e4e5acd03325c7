"""The stages of ``depthpose depth evaluate``: methods, their predictions, and the measurement."""

import hashlib
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any, cast, get_args

from tqdm import tqdm

from depthpose.cli.depth.methods import DepthMethod, DepthNetworkSpec, SGBMSpec
from depthpose.cli.depth.options import DepthMethodOptions
from depthpose.core import engine
from depthpose.core.environment import describe_environment
from depthpose.core.errors import InputError
from depthpose.core.processes import find_rank, wait_for
from depthpose.core.run_folder import read_settings
from depthpose.core.runner import Job
from depthpose.depth.baselines import NearestImageBaseline, RowDepthBaseline
from depthpose.depth.config import Answer, BaselineName, MatcherConfig, Speed
from depthpose.depth.datasets import (
    Dataset,
    join_datasets,
    list_truth_kinds,
    open_dataset,
    refuse_shared_frames,
)
from depthpose.depth.evaluate import (
    Evaluation,
    EvaluationRow,
    FrameMetrics,
    evaluate,
    measure_frame,
    read_frame_result,
    summarise,
)
from depthpose.depth.metrics import METRICS, RANKING
from depthpose.depth.predictions import estimate_missing_depth, is_finished
from depthpose.depth.protocols import PROTOCOLS, Protocol, has_truth
from depthpose.depth.types import DepthInput
from depthpose.report import page
from depthpose.report.depth import make_depth_section
from depthpose.report.page import Section

_COLUMNS_OF_METHOD = ("method", "input", "speed", "weights", "protocol", "dataset")
"""Columns that are the same for all frames of a method, and left out of the table of one frame."""


def open_frames(data: Path, split: str | None) -> Dataset:
    """Open a dataset, or a split of it, and print its name, number of frames and layout."""
    dataset = open_dataset(data, split)
    print(f"{dataset.name}: {len(dataset)} frames, layout {dataset.layout}")
    return dataset


def predict_depth_of_dataset(
    dataset: Dataset, method: DepthMethod, rule: Protocol, folder: Path
) -> Path:
    """Predict every frame that has truth, and a right view if the method needs it.

    In a launch of several processes each predicts its share, and the first waits for all files.

    Args:
        dataset: the frames.
        method: estimates their depth.
        rule: protocol by which the truth is read.
        folder: folder of the predictions of all methods.

    Returns:
        The folder of the method's predictions, ``FOLDER/METHOD``.
    """
    process = find_rank()
    method_folder = folder / method.name
    usable: list[int] = []
    sources: dict[str, list[Path]] = {}
    for index, frame in enumerate(dataset.frames):
        has_views = frame.right is not None or not method.with_right
        if has_views and has_truth(frame, rule):
            usable.append(index)
            sources[frame.name] = frame.list_input_files(with_right=method.with_right)

    jobs: list[Job[DepthInput]] = []
    for index in process.share_of(usable):
        read = partial(_read_views, dataset, index, with_right=method.with_right)
        jobs.append(Job(name=dataset.frames[index].name, read=read))
    names = estimate_missing_depth(method.estimator, jobs, method_folder, method.settings, sources)
    for _ in tqdm(names, method.name, total=len(jobs), disable=None, unit=" frames"):
        pass  # each frame is estimated and written as its name is asked for
    if process.rank == 0:
        wait_for(list(sources), partial(is_finished, method_folder))
    return method_folder


def _read_views(dataset: Dataset, index: int, *, with_right: bool) -> DepthInput:
    """Read the views of a frame that a method may see: of depth of one image the left alone."""
    pair = dataset.read_input(index)
    return pair if with_right else replace(pair, right=None)


def choose_methods(
    options: DepthMethodOptions, config: MatcherConfig, dataset: Dataset
) -> list[DepthMethod]:
    """Build the methods that are measured: SGBM, weights and baselines, in this order.

    Args:
        options: names of the methods.
        config: how networks run.
        dataset: the frames that are measured.

    Raises:
        InputError: two have one name, or one needs a right view that no frame has.
    """
    chosen: list[DepthMethod] = []
    if options.matcher == "sgbm":
        chosen.append(SGBMSpec(with_filled_holes=options.holes == "fill").build())
    chosen += [build_network_method(word, config) for word in options.weights]

    # Their predictions need folders of different names, and their inputs must be there.
    names = [method.name for method in chosen]
    repeated = next((name for name in names if names.count(name) > 1), None)
    if repeated is not None:
        raise InputError(
            f"two methods are called {repeated!r}, and their predictions need two folders; name "
            "each method once, or give files of other names"
        )
    has_right = any(frame.right is not None for frame in dataset.frames)
    stereo_method = next((method for method in chosen if method.with_right), None)
    if stereo_method is not None and not has_right:
        raise InputError(
            f"{stereo_method.name} matches both views, and {dataset.name} has no right view; leave "
            "it out ('quick:' and 'fine:' are for both views: for one image, give --speed)"
        )
    if options.baseline:
        training = open_training(options.train, options.train_without, dataset)
        chosen += [fit_baseline(name, training) for name in dict.fromkeys(options.baseline)]
    return chosen


def build_network_method(word: str, config: MatcherConfig) -> DepthMethod:
    """Build the method of weights by file or name, perhaps with a prefix that says how they run.

    ``own:`` and ``matched:`` say what depth of one image comes from, ``sgbm:`` lets OpenCV match
    the synthesised view; ``both:`` matches real pairs, ``quick:`` and ``fine:`` at that speed.
    """
    prefix, _, name = word.rpartition(":")
    mono = DepthNetworkSpec(weights=name, config=config, with_right=False)
    stereo = replace(mono, with_right=True)
    if prefix in get_args(Answer):
        return replace(mono, answer=cast("Answer", prefix)).build()
    if prefix == "sgbm":
        return replace(mono, matcher="sgbm").build()
    if prefix == "both":
        return stereo.build()
    if prefix in get_args(Speed):
        method = replace(stereo, config=replace(config, speed=prefix)).build()
        return method._replace(name=f"{method.name}-{prefix}")
    # No prefix; a colon may be one of the path, as in C:/weights.safetensors.
    return DepthNetworkSpec(weights=word, config=config).build()


def fit_baseline(name: BaselineName, training: Dataset) -> DepthMethod:
    """Fit a baseline to the truth of training frames, and return it as a method."""
    classes = {"rows": RowDepthBaseline, "nearest": NearestImageBaseline}
    names = "\n".join(frame.name for frame in training.frames)
    settings = {
        "matcher": f"baseline: {name}",
        "input": "left view" if name == "nearest" else "no image",
        "train": training.name,
        "train_frames": len(training),
        "train_sha256": hashlib.sha256(names.encode()).hexdigest(),
    }
    with_progress = partial(tqdm, desc=f"fit {name}", unit=" frames", disable=None)
    baseline = classes[name].fit(training, with_progress)
    return DepthMethod(f"baseline-{name}", baseline, settings, with_right=False)


def open_training(folders: Sequence[Path], without: Sequence[str], measured: Dataset) -> Dataset:
    """Open the frames that a baseline is fitted to.

    Args:
        folders: datasets, which are joined.
        without: names of frames to leave out.
        measured: the frames that are measured.

    Raises:
        InputError: a training frame is measured too.
    """
    training = join_datasets([open_dataset(folder) for folder in folders], without)
    remedy = "give --train other folders, or name these in --train-without"
    refuse_shared_frames(training.frames, measured.frames, "frames to measure", remedy)
    return training


def measure_and_report(
    dataset: Dataset,
    folders: Sequence[Path],
    protocol: str,
    caps_m: Sequence[float],
    out: Path,
    further: Sequence[Evaluation] = (),
) -> int:
    """Measure folders of predictions, write rows, a table and a page, and print the table.

    In a launch of several processes the first does it. Returns the exit code.

    Args:
        dataset: frames with truth.
        folders: the folder of each method's predictions.
        protocol: name of the protocol.
        caps_m: truth beyond a cap does not count; a row for each.
        out: folder of the files.
        further: evaluations that exist already; their rows come last.
    """
    if find_rank().rank > 0:
        return 0
    evaluations = measure_folders(dataset, folders, protocol, caps_m)
    measured = join_evaluations([*evaluations, *further])
    rows = [row.columns() for row in measured.rows]
    page.write_table(out, rows)

    text = f"{protocol}: {PROTOCOLS[protocol].summary}."
    advices = (_advise_on_calibration(dataset), _advise_on_truth(dataset, protocol))
    for advice in filter(None, advices):
        print(f"depthpose: {advice}", file=sys.stderr)
        text += f" {advice}."

    # The page: the table, then the best and the worst frames of each method.
    view_counts = page.share_views(len(folders))
    frame_sections: list[Section] = []
    for folder, evaluation, count in zip(folders, evaluations, view_counts, strict=True):
        frame_sections += _make_frame_sections(
            dataset, folder, evaluation.per_frame, protocol, count
        )
    sections = [
        Section(title="Mean over frames", text=text, rows=rows),
        *frame_sections,
        *write_detail_tables(measured, out),
    ]
    title = f"{protocol} on {dataset.name}"
    page.write_page(out / "report.html", title, sections, describe_environment())

    metrics = [metric.name for metric in METRICS.values() if metric.is_printed]
    origin = ["method", "weights", "speed", "cap_m", "frames", "coverage"]
    print(page.format_plain_table(rows, [*origin, *metrics, "ause"]))
    for name, reason in measured.skipped.items():
        print(f"skipped: {name}: {reason}", file=sys.stderr)
    print(f"{len(measured.skipped)} frames skipped")
    print(f"every column: {out / 'table.md'}, rows.csv; the page: {out / 'report.html'}")
    return 0


def _advise_on_calibration(dataset: Dataset) -> str | None:
    """Advise that numbers of pairs without a calibration compare with no others; None: all have."""
    uncalibrated_count = sum(
        frame.right is not None and not frame.calibration for frame in dataset.frames
    )
    if not uncalibrated_count:
        return None
    return (
        f"{uncalibrated_count} of {len(dataset)} pairs have no calibration, so a network matches "
        "them at their own focal length, not at the one it knows: compare no numbers with "
        "those of frames that have one (KITTI 2015 has calib_cam_to_cam in a download of its "
        "own)"
    )


def _advise_on_truth(dataset: Dataset, protocol: str) -> str | None:
    """Advise that depth maps of plain folders need not be annotated ones; None: there are none."""
    if PROTOCOLS[protocol].truth != "depth":
        return None
    plain_count = sum(
        frame.depth is not None and "annotated" not in list_truth_kinds(frame)
        for frame in dataset.frames
    )
    if not plain_count:
        return None
    return (
        f"the truth of {plain_count} frames is lidar_depth/ of a folder of pairs: compare no "
        f"numbers with those of {protocol} elsewhere unless it holds annotated maps (of scans, "
        "take eigen-raw-camera)"
    )


def _make_frame_sections(
    dataset: Dataset,
    folder: Path,
    per_frame: Sequence[EvaluationRow],
    protocol: str,
    max_count: int,
) -> list[Section]:
    """Make sections of the worst, the median and the best frame of a method.

    Frames are ranked by AbsRel, or by EPE where disparity is measured, at the first cap.

    Args:
        dataset: the frames.
        folder: the method's predictions.
        per_frame: the method's rows of frames.
        protocol: name of the protocol.
        max_count: most frames that are shown.
    """
    cap_m = per_frame[0].cap_m
    rows_at_cap = [row for row in per_frame if row.cap_m == cap_m and row.pixels]
    metric = METRICS[RANKING["disparity" if cap_m is None else "depth"]]
    sign = 1 if metric.better == "lower" else -1  # so that a larger value is a larger error

    # Words for the text of each section.
    cap_text = "" if cap_m is None else f", truth up to {cap_m:g} m"
    frame_count = f"{len(rows_at_cap)} frame{'' if len(rows_at_cap) == 1 else 's'}"
    index_of = {frame.name: index for index, frame in enumerate(dataset.frames)}

    sections: list[Section] = []
    errors = [sign * row.metrics[metric.name] for row in rows_at_cap]
    for role, k in page.choose_ranked(errors, max_count):
        row = rows_at_cap[k]
        index = index_of[row.frame or ""]
        estimate, error = read_frame_result(dataset, index, folder, protocol, row.cap_m)
        value = row.metrics[metric.name]
        section = make_depth_section(
            f"{folder.name}: {row.frame}, {role}",
            estimate,
            f"The {role} of {frame_count} by {metric.name}: {value:.4f}{cap_text}.",
            error=error,
        )
        columns = {
            name: cell for name, cell in row.columns().items() if name not in _COLUMNS_OF_METHOD
        }
        sections.append(replace(section, rows=[columns]))
    return sections


def measure_folders(
    dataset: Dataset, folders: Sequence[Path], protocol: str, caps_m: Sequence[float]
) -> list[Evaluation]:
    """Measure folders of predictions one by one; the rows say which method made them.

    Args:
        dataset: frames with truth.
        folders: the folder of each method's predictions.
        protocol: name of the protocol.
        caps_m: truth beyond a cap [m] does not count; a row for each.
    """
    with_progress = partial(tqdm, unit=" frames", disable=None)
    evaluations: list[Evaluation] = []
    for folder in folders:
        evaluation = evaluate(dataset, folder, protocol, caps_m, with_progress)
        evaluations.append(with_origin(evaluation, folder.name, read_settings(folder)))
    return evaluations


def with_origin(evaluation: Evaluation, name: str, settings: dict[str, Any] | None) -> Evaluation:
    """Return an evaluation whose rows say which method, weights and input made the predictions.

    Args:
        evaluation: of the predictions of one method.
        name: name of the method where there are no settings.
        settings: those of the run that made the predictions; None: other software made them.
    """
    settings = settings or {"matcher": name, "input": ""}
    # Only runs that may take one image record their input: a matcher always has both views.
    views = settings.get("input", "both views")
    method = settings.get("matcher", "")
    if "with_filled_holes" in settings:  # OpenCV's matcher ran; no other has holes
        method += " (holes filled)" if settings["with_filled_holes"] else " (matched pixels)"
    origin = {
        "method": method,
        "input": views,
        "speed": settings.get("speed", ""),
        "weights": settings.get("weights", ""),
    }
    # Rows of frames and deciles stand beside the rows of means, which have the checksum.
    sha256 = settings.get("weights_sha256", "")[:12]
    return replace(
        evaluation,
        rows=[replace(row, weights_sha256=sha256, **origin) for row in evaluation.rows],
        per_frame=[replace(row, **origin) for row in evaluation.per_frame],
        deciles=[replace(row, **origin) for row in evaluation.deciles],
    )


def join_evaluations(evaluations: Sequence[Evaluation]) -> Evaluation:
    """Join the rows of several evaluations into one."""
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


def write_detail_tables(measured: Evaluation, out: Path) -> list[Section]:
    """Write tables of frames and of the error by confidence; return the sections that show them."""
    frames = [row.columns() for row in measured.per_frame]
    deciles = [row.columns() for row in measured.deciles]
    page.write_table(out, frames, name="frames")
    if deciles:
        page.write_table(out, deciles, name="confidence")
    else:  # an earlier run may have measured a method with confidence here
        for file in page.list_table_files("confidence"):
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
    """Measure shards of predictions, which an engine wrote, frame by frame.

    Args:
        dataset: frames with truth.
        predictions: folder or URL of the shards.
        protocol: name of the protocol.
        caps_m: truth beyond a cap [m] does not count; a row for each.
    """
    name = PurePosixPath(predictions).stem
    settings = read_settings(predictions)
    index_of = {frame.name: index for index, frame in enumerate(dataset.frames)}
    measured: dict[str, list[FrameMetrics] | str] = {}
    given_notices: set[str] = set()  # each once for all frames
    for shard in tqdm(engine.read_records(predictions), name, disable=None, unit=" shards"):
        for frame, files in engine.read_shard(predictions, shard):
            if frame not in index_of:
                continue
            with tempfile.TemporaryDirectory(prefix="depthpose-") as folder:
                for ending, content in files.items():
                    path = Path(folder) / f"{frame}.{ending}"
                    path.parent.mkdir(parents=True, exist_ok=True)
                    path.write_bytes(content)
                measured[frame] = measure_frame(
                    dataset, index_of[frame], Path(folder), protocol, caps_m, given_notices
                )

    # Frames without a prediction: those without truth are skipped, others are an error.
    with tempfile.TemporaryDirectory() as empty_folder:
        for frame, index in index_of.items():
            if frame not in measured:
                measured[frame] = measure_frame(
                    dataset, index, Path(empty_folder), protocol, caps_m
                )
    return with_origin(summarise(dataset, protocol, measured), name, settings)
