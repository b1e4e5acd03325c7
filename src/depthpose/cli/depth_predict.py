"""The work behind ``depthpose depth predict`` and ``depth match``, here or by an engine."""

import re
import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor
from tqdm import tqdm

from depthpose.cli.depth_options import LensOptions, PairNetworks, PredictOutput, ScaleOptions
from depthpose.cli.engine import EngineOptions, Weights, print_shards
from depthpose.core import run
from depthpose.core.camera import Camera, FieldOfView, StereoRig, camera_of, read_camera, read_rig
from depthpose.core.camera.camera_facts import camera_keys
from depthpose.core.checkpoint import file_sha256, find_weights, read_checkpoint
from depthpose.core.devices import device_of_process, usable_device, usable_precision
from depthpose.core.draw import draw_depth
from depthpose.core.engine import Computation, InputFormat, JobInputs, LocalInput, ResultWriter
from depthpose.core.errors import InputError
from depthpose.core.files import (
    VIDEO_SUFFIXES,
    image_size,
    list_images,
    read_exif_focal,
    read_image,
    read_map,
    read_video,
    write_video,
)
from depthpose.core.files.disk import find_partners, read_text, refuse_equal_stems
from depthpose.core.files.images import LISTED_SUFFIXES, refuse_among_inputs
from depthpose.core.runner import Job, run_jobs
from depthpose.depth.config import Answer, MatcherConfig, SGBMConfig
from depthpose.depth.estimator import FakestereoNet
from depthpose.depth.mount import MountFilter, scale_by_distance
from depthpose.depth.predictions import (
    CLOUD_M,
    ENDINGS,
    DepthResults,
    Estimator,
    is_finished,
    read_estimate,
    read_ground,
)
from depthpose.depth.stereo import SGBMMatcher
from depthpose.depth.types import DepthEstimate, StereoInput
from depthpose.depth.weights import MATCHERS, Use
from depthpose.report.depth import make_depth_section
from depthpose.report.page import MOST_VIEWS, Film, Section, spread_evenly, write_page

IMAGES = InputFormat(roles=("image",), suffixes=LISTED_SUFFIXES)
PAIRS = InputFormat(roles=("left", "right"), suffixes=LISTED_SUFFIXES)
_PAGE = "report.html"
_VIDEO = ".color.mp4"
"""Ending of the video of a video's depth."""
_SAME_FOCAL = 0.01
"""Largest relative difference of the focal lengths of images of one camera."""


class DepthMethod(NamedTuple):
    """An estimator, its name in tables, and the JSON values that decide its results.

    ``with_right``: whether it is given the real right view.
    """

    name: str
    net: Estimator
    settings: dict[str, Any]
    with_right: bool = True


@dataclass(frozen=True, kw_only=True)
class DepthMethodSource:
    """The description of a method, from which this process or the workers of an engine build it."""

    weights: str | Weights | None  #: name or file, or their bytes; None: OpenCV's matcher
    config: MatcherConfig  #: how the networks run
    with_right: bool | None = None  #: give them the real right view; None: a matcher alone needs it
    matcher: str | None = None  #: for the synthesised view: other weights, or sgbm; None: their own
    allow_ood: bool = True  #: answer out-of-distribution images too, as a measurement must
    answer: Answer | None = None  #: where depth of one image comes from; None: as the weights say
    use: Use | None = None  #: build what these take alone; None: all networks
    with_filled_holes: bool = False  #: of OpenCV's matcher: give every pixel an answer

    def build(self) -> DepthMethod:
        """Build the estimator on the device of the config."""
        if self.weights is None:
            return self._build_sgbm()
        if isinstance(self.weights, Weights):
            with self.weights.unpacked() as file:
                return self._build_networks(file)
        return self._build_networks(self.weights)

    def _build_sgbm(self) -> DepthMethod:
        """Build OpenCV's StereoSGBM, with the settings of our tables."""
        config = SGBMConfig(with_filled_holes=self.with_filled_holes)
        name = "sgbm-filled" if self.with_filled_holes else "sgbm"
        net = FakestereoNet.load(matcher="sgbm", config=config)
        return DepthMethod(name, net, {"matcher": "sgbm", **asdict(config)})

    def _build_networks(self, weights: str) -> DepthMethod:
        """Build the networks of a weights file, perhaps with another matcher."""
        # Refused before anything is read; the precision that is recorded is the one computed in.
        device = device_of_process(self.config.device)
        usable_device(device)
        is_bf16 = usable_precision(self.config.precision, device) == "bf16"
        config = replace(self.config, precision="bf16" if is_bf16 else "fp32", device=device)
        path = find_weights(weights)
        kind = read_checkpoint(path).kind
        is_matcher = kind in MATCHERS
        with_right = is_matcher if self.with_right is None else self.with_right
        if is_matcher and not with_right:
            raise InputError(
                f"{path}: matches pairs, but depth from one image is asked for. Give weights that "
                "synthesise the right view."
            )

        # What decides the results.
        settings: dict[str, Any] = {
            "matcher": kind,
            "weights": path.stem,
            "weights_sha256": file_sha256(path),
        }
        if not is_matcher:
            settings["input"] = "both views" if with_right else "left view"
        settings |= asdict(config)

        # Which matcher runs, and where depth of one image comes from.
        matcher: SGBMMatcher | Path | None = None
        answer = self.answer
        if self.matcher is None:
            name = path.stem
            name += "-both" if with_right and not is_matcher else ""
            name += "" if answer is None else f"-{answer}"
        else:
            answer = "matched"
            matcher, matcher_name, matcher_settings = _load_other_matcher(self.matcher)
            name = f"{path.stem}-{matcher_name}"
            settings |= {**matcher_settings, "matcher": f"{kind} with {matcher_name}"}

        net = FakestereoNet.load(
            path,
            matcher=matcher,
            config=config,
            answer=answer,
            allow_ood=self.allow_ood,
            use=self.use,
        )
        if with_right and net.matcher is None:
            raise InputError(
                f"{path}: answers depth of one image, and holds no matcher, which a pair needs. "
                "Give weights with one, or sgbm."
            )
        if not with_right and net.synthesiser is not None:
            settings["answer"] = net.synthesiser.config.answer
            settings["scales"] = list(net.synthesiser.scales)
        return DepthMethod(name, net, settings, with_right)

    def with_packed_weights(self) -> "DepthMethodSource":
        """Return the source with the bytes of its weights, for workers of other machines."""
        if self.matcher not in (None, "sgbm"):
            raise InputError(
                f"--matcher {self.matcher}: --engine ray takes sgbm or the weights' own; make one "
                "file of both by 'depthpose weights pack G --matcher S --trained-on DATA --licence "
                "L --out W'"
            )
        if not isinstance(self.weights, str):
            return self
        path = find_weights(self.weights)
        return replace(self, weights=Weights(name=path.name, data=path.read_bytes()))


def _load_other_matcher(matcher: str) -> tuple[SGBMMatcher | Path, str, dict[str, Any]]:
    """Load the matcher of the synthesised view that replaces the weights' own.

    Returns:
        OpenCV's matcher or a weights file, its name, and the JSON values that decide its results.
    """
    if matcher == "sgbm":
        config = SGBMConfig(with_filled_holes=True)
        return SGBMMatcher(config), "sgbm", asdict(config)
    path = find_weights(matcher)
    return path, path.stem, {"matcher_sha256": file_sha256(path)}


def read_lens(options: LensOptions, sources: Sequence[Path]) -> Camera | FieldOfView | float:
    """Read the camera of single images: a file, a field of view or a focal length [px].

    Without any of these options the focal length is that of the images' EXIF.
    """
    focal_px = options.focal_px
    fov = options.fov
    if focal_px is not None and not 1 < focal_px < 1e6:
        raise InputError(f"--focal-px {focal_px}: not a focal length in pixels; KITTI's is 721.5.")
    if fov is not None:
        return FieldOfView(fov)
    if options.camera is None:
        return _read_exif_focal_px(sources) if focal_px is None else focal_px

    camera = read_camera(options.camera, _read_first_size(sources))
    if not isinstance(camera, StereoRig):
        return camera
    print("the camera's baseline is ignored: one image has none", file=sys.stderr)
    keys = {key: getattr(camera, key) for key in ("mount_height_m", "tilt_deg")}
    return Camera(width=camera.width, height=camera.height, K=camera.K, **keys)


def _read_exif_focal_px(sources: Sequence[Path]) -> float:
    """Read the focal length [px] on which the EXIF of all images agrees, and print it."""
    focal_of: dict[str, tuple[float, str]] = {}  # by file name: focal length [px], EXIF's tags
    for source in sources:
        try:
            focal = None if _is_video(source) else read_exif_focal(source)
        except InputError:  # the image fails by itself, later
            continue
        if focal is None:
            raise InputError(
                f"metres from one image need its focal length, and {source.name} has none in "
                "its EXIF: give --camera FILE, --focal-px, or --fov, the angle from left to "
                "right (a phone's main camera has about 0.75 times the image's width, or 67 "
                "degrees)"
            )
        focal_of[source.name] = focal

    if not focal_of:
        raise InputError(
            "no image can be read; give --camera, --focal-px or --fov, and intact ones"
        )

    first = next(iter(focal_of))
    focal_px, tags = focal_of[first]
    for other, (other_px, _) in focal_of.items():
        if abs(other_px / focal_px - 1) > _SAME_FOCAL:
            raise InputError(
                f"the EXIF of {first} says a focal length of {focal_px:.0f} px and that of "
                f"{other} {other_px:.0f} px; predict them apart"
            )

    print(
        f"a focal length of {focal_px:.0f} px, by the EXIF of {first} ({tags}); of a cropped "
        "picture it is another",
        file=sys.stderr,
    )
    return focal_px


def _read_first_size(sources: Sequence[Path]) -> tuple[int, int] | None:
    """Read width and height [px] of the first image or video that can be read, None if none can."""
    for source in sources:
        with suppress(InputError):  # the image fails by itself, later
            if not _is_video(source):
                return image_size(source)
            _, frame = next(iter(read_video(source)))
            return (frame.shape[2], frame.shape[1])
    return None


def image_work(
    lens: LensOptions,
    scale: ScaleOptions,
    output: PredictOutput,
    source: DepthMethodSource,
    images: Sequence[Path],
) -> "DepthWork":
    """Describe the work on single images; their EXIF is read where the options have no camera."""
    camera = read_lens(lens, images)
    return DepthWork(source=source, camera=camera, scale=scale, output=output)


def pair_work(
    camera: Path, pairs: PairNetworks, source: DepthMethodSource, first_pair: Sequence[Path]
) -> "DepthWork":
    """Describe the work on pairs; the first one has the size if the camera's file has none."""
    rig = read_rig(camera, image_size(first_pair[0]))
    output = PredictOutput(cloud=pairs.cloud, min_confidence=pairs.min_confidence)
    return DepthWork(source=source, camera=rig, output=output, with_check=pairs.check, files=PAIRS)


def list_sources(words: Sequence[str], out: Path) -> list[Path]:
    """List the images and videos of files, folders and patterns.

    Raises:
        InputError: two of them would have results of one name, or ``out`` lies among them.
    """
    sources: list[Path] = []
    for word in words:
        sources += [Path(word)] if _is_video(word) else list_images(word)
    refuse_equal_stems(sources)
    stems = [path.stem for path in sources]
    for video in filter(_is_video, sources):
        frame = next((stem for stem in stems if _is_frame_name(stem, video)), None)
        if frame is not None:
            raise InputError(
                f"an input is called {frame!r}, as a frame of a video would be, and so would their "
                "results; rename one of the two"
            )
    refuse_among_inputs(out, words, sources)
    return sources


def _is_frame_name(name: str, video: Path) -> bool:
    """Whether a frame of a video has this name: that of the video, and six digits."""
    return re.fullmatch(re.escape(video.stem) + r"_\d{6}", name) is not None


def _is_video(path: str | Path) -> bool:
    """Whether a file is a video, by its suffix."""
    return Path(path).suffix.lower() in VIDEO_SUFFIXES


def list_pairs(left: str, right: str) -> list[tuple[Path, Path]]:
    """List the images of two folders or patterns, paired by their names or the numbers in them.

    Two single files are a pair, whatever their names.
    """
    lefts = list_images(left)
    rights = list_images(right)
    refuse_equal_stems(lefts)
    left_stems = [path.stem for path in lefts]
    right_stems = [path.stem for path in rights]
    are_files = lefts == [Path(left)] and rights == [Path(right)]
    if not are_files:
        partners = find_partners(left_stems, right_stems, f"{left} and {right}")
        rights = [rights[k] for k in partners]
    return list(zip(lefts, rights, strict=True))


@dataclass(frozen=True, kw_only=True)
class DepthWork:
    """The estimation of depth files from images or pairs, here or by workers of an engine.

    ``camera``: camera of the images (a field of view or focal length [px] does), or rig of a pair.
    ``with_check``: refuse pairs that are swapped, not rectified or no pair.
    """

    source: DepthMethodSource
    camera: Camera | FieldOfView | float
    output: PredictOutput
    scale: ScaleOptions = field(default_factory=ScaleOptions)
    with_check: bool = True
    files: InputFormat = IMAGES

    def make_input(self, name: str, left: Tensor | Path, right: Path | None = None) -> StereoInput:
        """Make the input of an image or a pair; files are read, a frame of a video is there."""
        image = read_image(left) if isinstance(left, Path) else left
        height, width = image.shape[1:]
        camera = camera_of(self.camera, (width, height))
        assert camera is not None
        if self.scale.camera_height is not None:
            camera = replace(camera, mount_height_m=self.scale.camera_height)
        if self.scale.camera_tilt is not None:
            camera = replace(camera, tilt_deg=self.scale.camera_tilt)
        right_image = None if right is None else read_image(right)
        return StereoInput(name=name, left=image, right=right_image, camera=camera)

    def make_jobs(self, files: Sequence[Path]) -> Iterator[Job[StereoInput]]:
        """Make the job of an image or a pair, or the jobs of all frames of a video."""
        if not _is_video(files[0]):
            name = files[0].stem
            yield Job(name=name, read=partial(self.make_input, name, *files))
            return
        for name, frame in read_video(files[0]):
            yield Job(name=name, read=partial(self.make_input, name, frame))

    def estimate_many(
        self, net: FakestereoNet, inputs: Sequence[StereoInput], mount: MountFilter | None = None
    ) -> list[DepthEstimate | InputError]:
        """Estimate inputs together; ``mount``: of the camera, where all are frames of one."""
        named_inputs = [(depth_input.name, depth_input) for depth_input in inputs]
        estimates = net.estimate_batch(named_inputs, with_check=self.with_check, mount=mount)
        if self.scale.known_distance is None:
            return estimates
        return [
            self._scale_by_known_distance(name, estimate)
            for (name, _), estimate in zip(named_inputs, estimates, strict=True)
        ]

    def _scale_by_known_distance(
        self, name: str, estimate: DepthEstimate | InputError
    ) -> DepthEstimate | InputError:
        """Scale an estimate to the depth measured at a pixel; a failed one stays as it is."""
        if isinstance(estimate, InputError):
            return estimate
        try:
            return scale_by_distance(estimate, name, self.scale.parse_known_distance())
        except InputError as error:
            return error

    def settings(self, method_settings: dict[str, Any]) -> dict[str, Any]:
        """Give the JSON values that decide the results, for the record of a run.

        ``method_settings``: those of the estimator.
        """
        if isinstance(self.camera, FieldOfView):
            camera: dict[str, Any] = {"fov_deg": self.camera.degrees}
        elif isinstance(self.camera, StereoRig):
            camera = {
                "K": self.camera.K.tolist(),
                "baseline_m": self.camera.baseline_m,
                "cx_right_minus_left_px": self.camera.cx_right_minus_left_px,
            }
        elif isinstance(self.camera, Camera):
            keys = camera_keys(self.camera)
            camera = {key: keys[key] for key in ("K", "mount_height_m", "tilt_deg") if key in keys}
        else:
            camera = {"focal_px": self.camera}
        scale = asdict(self.scale)
        camera |= {key: value for key, value in scale.items() if value not in (None, False)}

        settings = {**method_settings, "camera": camera}
        if self.files != PAIRS:
            settings["color_range_m"] = list(self.output.color_range)
        if self.output.cloud:
            settings["min_confidence"] = self.output.min_confidence
        return settings

    def start(self) -> ResultWriter:
        """Build the networks, and give the function that estimates a batch of a worker."""
        method = self.source.build()

        def estimate(samples: Sequence[LocalInput], out: Path) -> list[str]:
            """Write the depth of a batch into a folder; give why each has none, "" if it has."""
            depth_run = DepthRun(work=self, method=method, out=out)
            jobs = [
                Job(name=sample.name, read=partial(self.make_input, sample.name, *sample.files))
                for sample in samples
            ]
            depth_run.estimate(jobs, len(samples), "images")
            return [str(depth_run.failures.get(sample.name, "")) for sample in samples]

        return estimate


def predict_depth_on_ray(
    words: Sequence[str],
    files: InputFormat,
    make_work: Callable[[Sequence[Path]], DepthWork],
    out: str,
    engine: EngineOptions,
) -> int:
    """Estimate images or pairs by the workers of an engine; give the exit code.

    Args:
        words: files, folders or patterns, manifests or tar shards.
        files: what an input is made of.
        make_work: describes the work, given the files of the first input.
        out: folder or URL for the shards.
        engine: its options.
    """
    video = next(filter(_is_video, words), None)
    if video is not None:
        raise InputError(f"{video}: --engine ray takes no videos; omit --engine for them")
    inputs = JobInputs.find(words, files)
    with inputs.open_first() as first_files:
        depth_work = make_work(first_files)
    if depth_work.scale.one_mount:
        raise InputError("--one-mount takes the images one after the other; omit it, or --engine")

    # The settings are read from networks on this machine, which need not have the workers' device.
    config = depth_work.source.config
    on_cpu = replace(depth_work.source, config=replace(config, device="cpu"))
    method_settings = on_cpu.build().settings
    if "device" in method_settings:
        method_settings["device"] = config.device
    settings = depth_work.settings(method_settings)
    work = Computation(
        make_writer=depth_work.start,
        input_format=files,
        endings=ENDINGS,
        batch=depth_work.output.batch,
    )
    noun = "pairs" if files == PAIRS else "depth maps"
    return print_shards(engine.run(work, inputs, out, settings), out, noun)


def predict_depth_of_files(
    sources: Sequence[tuple[Path, ...]], work: DepthWork, method: DepthMethod, out: Path
) -> int:
    """Estimate what is not finished, and give the exit code.

    An input that fails is named and stops no other. Of several processes each takes its share, and
    the first waits for the others and writes the page.
    """
    video_stems = [files[0].stem for files in sources if _is_video(files[0])]
    run.claim_folder(out, work.settings(method.settings), [_PAGE])
    endings = [f".{end}" for end in ENDINGS] + [_VIDEO]
    run.claim_names(out, {files[0].stem: files for files in sources}, endings, video_stems)
    process = run.find_rank()
    if work.scale.one_mount and process.world > 1:
        raise InputError("--one-mount takes the images one after the other; omit it, or run alone")

    # Images and pairs first, then videos one by one.
    share = process.share_of(sources)
    stills = [files for files in share if not _is_video(files[0])]
    videos = [files[0] for files in share if _is_video(files[0])]
    depth_run = DepthRun(work=work, method=method, out=out, is_shared=process.world > 1)
    still_jobs = (job for files in stills for job in work.make_jobs(files))
    mount = MountFilter() if work.scale.one_mount else None
    count = len(depth_run.estimate(still_jobs, len(stills), "images", mount))
    count += sum(depth_run.estimate_video(video) for video in videos)

    failures = list(depth_run.failures.values())
    if failures and not count and len(sources) == 1:
        raise failures[0]
    for failure in failures:
        print(f"depthpose: failed: {failure}", file=sys.stderr)
    total = f"{count} of {len(share)} pairs" if work.files == PAIRS else f"{count} depth maps"
    print(f"{total} are in {out}")
    if process.rank == 0:
        reasons = [str(failure) for failure in failures]
        if process.world > 1:
            wait_for_results(sources, work, out)
            reasons = _read_failures(sources, out)
        write_depth_page(sources, work, out, reasons)
    return 1 if failures else 0


def wait_for_results(sources: Sequence[tuple[Path, ...]], work: DepthWork, out: Path) -> None:
    """Wait until all processes of a launch have a result of each input, or a reason why not.

    A failure of an earlier run counts as one, since the process whose input it is may try again at
    any time.

    Raises:
        InputError: the others make no progress for an hour.
    """
    videos = {_name_source(files): files[0] for files in sources if _is_video(files[0])}

    def is_there(name: str) -> bool:
        if name in run.read_failures(out):
            return True
        if name in videos:
            return run.is_whole(out, name, [_name_video_file(videos[name])])
        return is_finished(out, name, with_cloud=work.output.cloud)

    names = [_name_source(files) for files in sources]
    run.wait_for(names, is_there, count_steps=lambda: len(run.read_results(out)))


def _read_failures(sources: Sequence[tuple[Path, ...]], out: Path) -> list[str]:
    """Read why inputs, or frames of them, have no result, as all processes noted it."""
    failures = run.read_failures(out)
    reasons: list[str] = []
    for files in sources:
        reasons += [failures[name] for name in _choose_result_names(files, failures)]
        if _is_video(files[0]) and files[0].name in failures:
            reasons.append(failures[files[0].name])
    return reasons


def _name_source(files: Sequence[Path]) -> str:
    """Name an image or a pair as its result is named, and a video with its suffix."""
    return files[0].name if _is_video(files[0]) else files[0].stem


def _name_video_file(video: Path) -> str:
    """Name the file with the depth of a video."""
    return f"{video.stem}{_VIDEO}"


def write_depth_page(
    sources: Sequence[tuple[Path, ...]], work: DepthWork, out: Path, failures: Sequence[str]
) -> None:
    """Write a page of some of the finished depth maps, of every failure and of every warning."""
    # The finished results of each input, and those that are shown.
    finished = {name for name in run.read_results(out) if is_finished(out, name)}
    names_of = {files: _choose_result_names(files, finished) for files in sources}
    names = [name for names_of_source in names_of.values() for name in names_of_source]
    chosen = {names[k] for k in spread_evenly(len(names), MOST_VIEWS)}
    shown_inputs = list(_read_chosen(names_of, work, chosen))

    selection = "all" if len(shown_inputs) == len(names) else "spread evenly"
    number = f"{len(names)} depth map{'s' * (len(names) != 1)}"
    text = f"Shown: {len(shown_inputs)} of {number} in this folder ({selection})."
    rows = [{"not estimated, because": reason} for reason in failures]
    for name in names:
        warning_file = out / f"{name}.warning.txt"
        if warning_file.is_file():
            rows.append({"warning": f"{name}: {read_text(warning_file).strip()}"})
    sections = [Section(title="What is here", text=text, rows=rows)]

    near_m, far_m = work.output.color_range
    colors = f"depth, {near_m:g} m bright to {far_m:g} m dark"
    videos = sorted(out.glob(f"*{_VIDEO}"))
    films = [Film(path=path, caption=f"{path.name}: {colors}") for path in videos]
    if films:
        sections.append(Section(title="Videos", films=films))
    for depth_input in shown_inputs:
        estimate = read_estimate(out, depth_input.name, depth_input.camera)
        section = make_depth_section(
            depth_input.name, depth_input, estimate, range_m=(near_m, far_m)
        )
        sections.append(section)
    title = f"Depth of {len(names)} image{'s' * (len(names) != 1)}"
    write_page(out / _PAGE, title, sections, run.describe_environment())
    print(f"the page: {out / _PAGE}")


def _choose_result_names(files: Sequence[Path], names: Collection[str]) -> list[str]:
    """Choose, of the names of results, those of an image, a pair or the frames of a video."""
    if _is_video(files[0]):
        return sorted(name for name in names if _is_frame_name(name, files[0]))
    name = files[0].stem
    return [name] if name in names else []


def _read_chosen(
    names_of: Mapping[tuple[Path, ...], Sequence[str]], work: DepthWork, chosen: Collection[str]
) -> Iterator[StereoInput]:
    """Read the inputs of chosen results again; one that is unreadable by now is left out.

    ``names_of``: the results of each image, pair or video, by its files.
    """
    for files, names in names_of.items():
        wanted = [name for name in names if name in chosen]
        if not wanted:
            continue
        with suppress(InputError):
            for job in work.make_jobs(files):
                if job.name in wanted:
                    yield job.read()
                if job.name == wanted[-1]:
                    break


@dataclass(frozen=True, kw_only=True)
class DepthRun:
    """Writes the estimates of one process to ``out``, and collects its failures.

    ``failures``: by the names of images, pairs and frames, and of whole videos.
    """

    work: DepthWork
    method: DepthMethod
    out: Path
    is_shared: bool = False  #: other processes of a launch write there too
    failures: dict[str, InputError] = field(default_factory=dict)

    def estimate(
        self,
        jobs: Iterable[Job[StereoInput]],
        total: int | None,
        label: str,
        mount: MountFilter | None = None,
    ) -> list[str]:
        """Estimate what is not finished; give the names of all inputs that have a result then.

        Args:
            jobs: images, pairs or the frames of a video.
            total: how many there are; None: unknown.
            label: what they are called beside the progress.
            mount: mount of the camera, where they are frames of one.
        """
        output = self.work.output
        results = DepthResults(
            folder=self.out,
            range_m=output.color_range,
            cloud_m=CLOUD_M if output.cloud else None,
            min_confidence=output.min_confidence,
        )
        assert isinstance(self.method.net, FakestereoNet), "weights build no other"
        estimate_many = partial(self.work.estimate_many, self.method.net, mount=mount)
        outcomes = run_jobs(jobs, estimate_many, results, output.batch)

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

    def _note_failure(self, name: str, error: InputError) -> None:
        """Keep why an input has no result, and tell the other processes of a launch."""
        self.failures[name] = error
        if self.is_shared:
            run.note_failure(self.out, name, str(error))

    def estimate_video(self, source: Path) -> int:
        """Estimate the frames of a video and write a video of their depth; give their number."""
        try:
            video = read_video(source)
            jobs = self.work.make_jobs([source])
            names = self.estimate(jobs, video.frames or None, source.name, MountFilter())
            pictures = self._draw_frames(source, names) if names else ()
            file = self.out / _name_video_file(source)
            write_video(file, pictures, video.fps)
            if self.is_shared:
                run.note_result(self.out, source.name, [file])
        except InputError as error:
            self._note_failure(source.name, error)
            return 0
        return len(names)

    def _draw_frames(self, source: Path, names: Sequence[str]) -> Iterator[Tensor]:
        """Draw the depth of each frame, and a grey picture for each frame that failed."""
        failed = {name for name in self.failures if _is_frame_name(name, source)}
        unknown = torch.full_like(read_map(self.out / f"{names[0]}.depth_m.npy"), torch.nan)
        for name in sorted([*names, *failed]):
            depth_m = unknown if name in failed else read_map(self.out / f"{name}.depth_m.npy")
            yield draw_depth(depth_m, *self.work.output.color_range)

    def _print_remarks(self, name: str, estimate: DepthEstimate) -> None:
        """Print how much the cloud of an estimate leaves out, its warning and its ground."""
        output = self.work.output
        if output.cloud and output.min_confidence > 0:
            sure_count = estimate.is_sure(output.min_confidence).sum()
            point_count = estimate.is_sure(0.0).sum().clamp(min=1)
            left_out = 1 - float(sure_count / point_count)
            tqdm.write(
                f"{name}: {left_out:.1%} of the depth is less sure than {output.min_confidence:g} "
                "and left out of the cloud"
            )
        if estimate.warning:
            tqdm.write(f"depthpose: warning: {name}: {estimate.warning}", sys.stderr)
        if estimate.ground is not None:
            tqdm.write(f"{name}: {estimate.ground}")
