"""The run of ``depthpose depth predict`` and ``depth match``, in this process or by an engine."""

import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from depthpose.cli.depth.inputs import (
    PAIRS,
    InputReader,
    is_frame_name,
    is_video,
    select_result_names,
)
from depthpose.cli.depth.methods import DepthMethod, DepthMethodSpec, settings_on_workers
from depthpose.cli.depth.options import PredictOutput
from depthpose.cli.depth.page import PAGE, VIDEO_ENDING, write_depth_page
from depthpose.cli.engine import EngineOptions, print_shards
from depthpose.core import run_folder
from depthpose.core.draw import draw_depth
from depthpose.core.engine import Computation, InputFormat, JobInputs, LocalInput, ResultWriter
from depthpose.core.errors import InputError, result_or_error
from depthpose.core.files import read_map, read_video, write_video
from depthpose.core.processes import find_rank, wait_for
from depthpose.core.runner import Job, run_jobs
from depthpose.depth.estimator import FakestereoNet
from depthpose.depth.mount import MountFilter, scale_by_distance
from depthpose.depth.predictions import (
    CLOUD_M,
    ENDINGS,
    DepthResults,
    OutputOptions,
    is_finished,
    read_ground,
)
from depthpose.depth.types import DepthEstimate, DepthInput


def predict_depth_of_files(
    sources: Sequence[tuple[Path, ...]],
    method: DepthMethod,
    reader: InputReader,
    output: PredictOutput,
    out: Path,
) -> int:
    """Estimate what is not finished, write files, page and failures, and return the exit code.

    An input that fails is named and stops no other. Of several processes each takes its share, and
    the first waits for the others and writes the page.

    Args:
        sources: the file of each image or video, or the files of each pair.
        method: estimates their depth.
        reader: reads them.
        output: which files are written.
        out: folder of the results.

    Raises:
        InputError: ``out`` holds results of other settings or inputs, the only input failed, or
            frames of one camera are scaled by one known distance.
    """
    has_frames = reader.scale.one_mount or any(is_video(files[0]) for files in sources)
    if has_frames and reader.scale.known_distance is not None:
        raise InputError(
            "--known-distance holds for one image, and the frames of a video or of --one-mount see "
            "another distance each; give --camera-height, or omit it"
        )
    settings = run_settings(method.settings, reader, output)
    _claim_results(sources, settings, out)
    process = find_rank()
    if reader.scale.one_mount and process.world > 1:
        raise InputError("--one-mount takes the images one after the other; omit it, or run alone")

    # Images and pairs first, then videos one by one.
    share = process.share_of(sources)
    stills = [files for files in share if not is_video(files[0])]
    videos = [files[0] for files in share if is_video(files[0])]
    predictor = DepthPredictor(
        method=method,
        reader=reader,
        output=output,
        out=out,
        is_shared=process.world > 1,
    )
    still_jobs = (job for files in stills for job in reader.make_jobs(files))
    mount = MountFilter() if reader.scale.one_mount else None
    count = len(predictor.predict(still_jobs, len(stills), "images", mount))
    count += sum(predictor.predict_video(video) for video in videos)

    # What could not be estimated, in words, and the page.
    failures = list(predictor.failures.values())
    if failures and not count and len(sources) == 1:
        raise failures[0]
    for failure in failures:
        print(f"depthpose: failed: {failure}", file=sys.stderr)
    total = f"{count} of {len(share)} pairs" if reader.files == PAIRS else f"{count} depth maps"
    print(f"{total} are in {out}")
    if process.rank == 0:
        reasons = [str(failure) for failure in failures]
        if process.world > 1:
            wait_for_results(sources, out, with_cloud=output.cloud)
            reasons = _read_failures(sources, out)
        write_depth_page(sources, reader, output.color_range, out, reasons)
    return 1 if failures else 0


def _claim_results(
    sources: Sequence[tuple[Path, ...]], settings: dict[str, Any], out: Path
) -> None:
    """Claim a folder, and in it the names of the results of these inputs.

    Raises:
        InputError: the folder holds results of other settings or inputs.
    """
    run_folder.claim_folder(out, settings, [PAGE])
    files_of_stem = {files[0].stem: files for files in sources}
    video_stems = [stem for stem, files in files_of_stem.items() if is_video(files[0])]
    endings = [f".{ending}" for ending in ENDINGS] + [VIDEO_ENDING]
    run_folder.claim_names(out, files_of_stem, endings, video_stems)


def run_settings(
    method_settings: dict[str, Any], reader: InputReader, output: PredictOutput
) -> dict[str, Any]:
    """List the JSON values that decide the results, for the record of a run.

    ``method_settings``: those of the estimator.
    """
    settings = {**method_settings, "camera": reader.camera_settings()}
    if reader.files != PAIRS:
        settings["color_range_m"] = list(output.color_range)
    if output.cloud:
        settings["min_confidence"] = output.min_confidence
    return settings


def wait_for_results(sources: Sequence[tuple[Path, ...]], out: Path, *, with_cloud: bool) -> None:
    """Wait until all processes of a launch have a result of each input, or a reason why not.

    A failure of an earlier run counts as one, since the process whose input it is may try again at
    any time.

    Args:
        sources: the files of each input, of all processes.
        out: folder of the results.
        with_cloud: a result needs its cloud.

    Raises:
        InputError: the others make no progress for an hour.
    """
    videos = {_name_source(files): files[0] for files in sources if is_video(files[0])}

    def is_there(name: str) -> bool:
        """Whether the input of this name has a result, or has failed."""
        if name in run_folder.read_failures(out):
            return True
        if name in videos:
            return run_folder.is_result_finished(out, name, [_name_video_file(videos[name])])
        return is_finished(out, name, with_cloud=with_cloud)

    names = [_name_source(files) for files in sources]
    wait_for(names, is_there, count_steps=lambda: len(run_folder.read_results(out)))


def _read_failures(sources: Sequence[tuple[Path, ...]], out: Path) -> list[str]:
    """Read why inputs, or frames of them, have no result, as all processes noted it."""
    failures = run_folder.read_failures(out)
    reasons: list[str] = []
    for files in sources:
        reasons += [failures[name] for name in select_result_names(failures, files)]
        if is_video(files[0]) and files[0].name in failures:
            reasons.append(failures[files[0].name])
    return reasons


def _name_source(files: Sequence[Path]) -> str:
    """Name an image or a pair as its result is named, and a video with its suffix."""
    return files[0].name if is_video(files[0]) else files[0].stem


def _name_video_file(video: Path) -> str:
    """Name the file with the depth of a video."""
    return f"{video.stem}{VIDEO_ENDING}"


@dataclass(frozen=True, kw_only=True)
class DepthPredictor:
    """Estimates depth of inputs, writes the results to a folder, and collects the failures.

    ``is_shared``: other processes write to the folder too. ``failures``: by the names of images,
    pairs and frames, and of whole videos.
    """

    method: DepthMethod
    reader: InputReader
    output: PredictOutput
    out: Path
    is_shared: bool = False
    failures: dict[str, InputError] = field(default_factory=dict)

    def predict(
        self,
        jobs: Iterable[Job[DepthInput]],
        total: int | None,
        label: str,
        mount: MountFilter | None = None,
    ) -> list[str]:
        """Estimate what is not finished; return the names of all inputs that have a result then.

        Args:
            jobs: images, pairs or the frames of a video.
            total: how many there are; None: unknown.
            label: word for them beside the progress.
            mount: mount of the camera, where they are frames of one.
        """
        results = DepthResults(
            folder=self.out,
            options=OutputOptions(
                range_m=self.output.color_range,
                cloud_m=CLOUD_M if self.output.cloud else None,
                min_confidence=self.output.min_confidence,
            ),
        )
        estimate_many = partial(self._estimate_many, mount=mount)
        outcomes = run_jobs(jobs, estimate_many, results, self.output.batch)

        names: list[str] = []
        for outcome in tqdm(outcomes, label, total, disable=None, unit=f" {label}"):
            name = outcome.job.name
            try:
                if outcome.failure is not None:
                    raise outcome.failure
                if outcome.result is not None:
                    self._print_remarks(name, outcome.result)
                elif mount is not None:  # finished by an earlier run: later frames go on from it
                    mount.last = read_ground(self.out, name) or mount.last
                names.append(name)
            except InputError as error:
                self._note_failure(name, error)
        return names

    def _estimate_many(
        self, inputs: Sequence[DepthInput], mount: MountFilter | None
    ) -> list[DepthEstimate | InputError]:
        """Estimate inputs together; ``mount``: of the camera, where all are frames of one."""
        net = self.method.estimator
        assert isinstance(net, FakestereoNet), "weights build no other"
        estimates = net.estimate_batch(inputs, mount=mount)
        if self.reader.scale.known_distance is None:
            return estimates
        distance = self.reader.scale.parse_known_distance()
        return [
            estimate
            if isinstance(estimate, InputError)
            else result_or_error(scale_by_distance, estimate, distance)
            for estimate in estimates
        ]

    def _note_failure(self, name: str, error: InputError) -> None:
        """Keep why an input has no result, and tell the other processes of a launch."""
        self.failures[name] = error
        if self.is_shared:
            run_folder.note_failure(self.out, name, str(error))

    def predict_video(self, video: Path) -> int:
        """Estimate the frames of a video and write a video of their depth; return their number."""
        try:
            frames = read_video(video)
            jobs = self.reader.make_jobs([video])
            names = self.predict(jobs, frames.frames or None, video.name, MountFilter())
            pictures = self._draw_frames(video, names) if names else ()
            file = self.out / _name_video_file(video)
            write_video(file, pictures, frames.fps)
            if self.is_shared:
                run_folder.note_result(self.out, video.name, [file])
        except InputError as error:
            self._note_failure(video.name, error)
            return 0
        return len(names)

    def _draw_frames(self, video: Path, names: Sequence[str]) -> Iterator[Tensor]:
        """Draw the depth of each frame, and a grey picture for each frame that failed.

        ``names``: of the frames that have depth.
        """
        failed = {name for name in self.failures if is_frame_name(name, video)}
        first_m = read_map(self.out / f"{names[0]}.depth_m.npy")
        unknown_m = torch.full_like(first_m, torch.nan)
        for name in sorted([*names, *failed]):
            depth_m = unknown_m if name in failed else read_map(self.out / f"{name}.depth_m.npy")
            yield draw_depth(depth_m, *self.output.color_range)

    def _print_remarks(self, name: str, estimate: DepthEstimate) -> None:
        """Print how much the cloud of an estimate leaves out, its warning and its ground."""
        min_confidence = self.output.min_confidence
        if self.output.cloud and min_confidence > 0:
            sure_count = estimate.is_sure(min_confidence).sum()
            point_count = estimate.is_sure(0.0).sum().clamp(min=1)  # all that have depth
            left_out = 1 - float(sure_count / point_count)
            tqdm.write(
                f"{name}: {left_out:.1%} of the depth is less sure than {min_confidence:g} and "
                "left out of the cloud"
            )
        if estimate.warning:
            tqdm.write(f"depthpose: warning: {name}: {estimate.warning}", sys.stderr)
        if estimate.ground is not None:
            tqdm.write(f"{name}: {estimate.ground}")


@dataclass(frozen=True, kw_only=True)
class DepthWorker:
    """The estimation of depth by a worker of an engine, to which this is sent."""

    spec: DepthMethodSpec
    reader: InputReader
    output: PredictOutput

    def make_writer(self) -> ResultWriter:
        """Build the estimator, and return the function that estimates a batch of inputs."""
        return partial(self._estimate_samples, self.spec.build())

    def _estimate_samples(
        self, method: DepthMethod, samples: Sequence[LocalInput], out: Path
    ) -> list[str]:
        """Write the depth of inputs into a folder; return why each has none, "" if it has."""
        predictor = DepthPredictor(
            method=method,
            reader=self.reader,
            output=self.output,
            out=out,
        )
        jobs: list[Job[DepthInput]] = []
        for sample in samples:
            read = partial(self.reader.read_input, sample.name, *sample.files)
            jobs.append(Job(name=sample.name, read=read))
        predictor.predict(jobs, len(jobs), "images")
        return [str(predictor.failures.get(sample.name, "")) for sample in samples]


def find_inputs_for_ray(words: Sequence[str], files: InputFormat) -> JobInputs:
    """List the inputs of files, folders, patterns, manifests or tar shards; videos are refused.

    ``files``: what an input consists of.
    """
    video = next(filter(is_video, words), None)
    if video is not None:
        raise InputError(f"{video}: --engine ray takes no videos; omit --engine for them")
    return JobInputs.find(words, files)


def predict_depth_on_ray(
    inputs: JobInputs, worker: DepthWorker, out: str, engine: EngineOptions
) -> int:
    """Estimate images or pairs by the workers of an engine, and return the exit code.

    Args:
        inputs: images or pairs.
        worker: what each worker does.
        out: folder or URL for the shards.
        engine: options of the engine.
    """
    reader = worker.reader
    settings = run_settings(settings_on_workers(worker.spec), reader, worker.output)
    computation = Computation(
        make_writer=worker.make_writer,
        input_format=reader.files,
        endings=ENDINGS,
        batch=worker.output.batch,
    )
    noun = "pairs" if reader.files == PAIRS else "depth maps"
    return print_shards(engine.run(computation, inputs, out, settings), out, noun)
