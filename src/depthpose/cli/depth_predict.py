"""The work behind ``depthpose depth predict`` and ``depth match``, here or by an engine."""

import re
import sys
from collections import Counter
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
from depthpose.core.camera.pinhole import camera_keys
from depthpose.core.checkpoint import file_sha256, find_weights, read_checkpoint
from depthpose.core.devices import device_of_process, usable_device, usable_precision
from depthpose.core.draw import draw_depth
from depthpose.core.engine import Files, Function, Inputs, Sample, Work
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
from depthpose.core.files.disk import find_partners, read_text
from depthpose.core.files.images import LISTED_SUFFIXES, refuse_among_inputs
from depthpose.core.runner import Job, run_jobs
from depthpose.depth.config import Answer, MatcherConfig, SGBMConfig
from depthpose.depth.estimator import FakestereoNet
from depthpose.depth.ground import MountFilter, scale_by_distance
from depthpose.depth.predictions import (
    CLOUD_M,
    ENDINGS,
    LAST,
    DepthResults,
    Estimator,
    read_estimate,
    read_ground,
)
from depthpose.depth.stereo import SGBMMatcher
from depthpose.depth.types import DepthEstimate, StereoInput
from depthpose.depth.weights import MATCHERS, Use
from depthpose.report.depth import depth_section
from depthpose.report.page import MOST_VIEWS, Film, Section, spread_evenly, write_page

IMAGES = Files(roles=("image",), suffixes=LISTED_SUFFIXES)
PAIRS = Files(roles=("left", "right"), suffixes=LISTED_SUFFIXES)
_PAGE = "report.html"
_VIDEO = ".color.mp4"
_SAME_FOCAL = 0.01


class DepthMethod(NamedTuple):
    """An estimator, what to call it, and the JSON values that decide its results.

    ``with_right`` says whether it is given the real right view.
    """

    name: str
    net: Estimator
    settings: dict[str, Any]
    with_right: bool = True


@dataclass(frozen=True, kw_only=True)
class DepthMethodSource:
    """What a method is built from, in this process or by the workers of an engine."""

    weights: str | Weights | None  #: by name or file, or packed to travel; None: OpenCV's matcher
    config: MatcherConfig  #: how the networks run
    with_right: bool | None = None  #: give them the real right view; None: a matcher alone needs it
    matcher: str | None = None  #: for the synthesised view: other weights, or sgbm; None: their own
    allow_ood: bool = True  #: answer out-of-distribution images too, as a measurement must
    answer: Answer | None = None  #: where depth of one image comes from; None: as the weights say
    use: Use | None = None  #: build what these take alone; None: all networks
    with_filled_holes: bool = False  #: of OpenCV's matcher: give every pixel an answer

    def build(self) -> DepthMethod:
        """Build the networks on the device of the config."""
        if self.weights is None:  # OpenCV's StereoSGBM with the settings of our tables
            sgbm = SGBMConfig(with_filled_holes=self.with_filled_holes)
            name = "sgbm-filled" if self.with_filled_holes else "sgbm"
            net = FakestereoNet.load(matcher="sgbm", config=sgbm)
            return DepthMethod(name, net, {"matcher": "sgbm", **asdict(sgbm)})
        if isinstance(self.weights, Weights):
            with self.weights.unpacked() as file:
                return replace(self, weights=file).build()

        # Refused before anything is read; the precision that is recorded is the one computed in.
        device = device_of_process(self.config.device)
        usable_device(device)
        is_bf16 = usable_precision(self.config.precision, device) == "bf16"
        precision = "bf16" if is_bf16 else "fp32"
        config = replace(self.config, precision=precision, device=device)
        path = find_weights(self.weights)
        kind = read_checkpoint(path).kind
        is_matcher = kind in MATCHERS
        with_right = is_matcher if self.with_right is None else self.with_right
        if is_matcher and not with_right:
            raise InputError(
                f"{path}: matches pairs, but depth from one image is asked for. Give weights that "
                "synthesise the right view."
            )

        # Its name in tables, and what decides its results.
        facts: dict[str, Any] = {"matcher": kind, "weights": path.stem}
        facts["weights_sha256"] = file_sha256(path)
        if not is_matcher:
            facts["input"] = "both views" if with_right else "left view"
        settings = asdict(config)
        matcher = None
        answer = self.answer
        if self.matcher is None:
            name = path.stem + ("-both" if with_right and not is_matcher else "")
            name += "" if answer is None else f"-{answer}"
        else:  # OpenCV, or other weights, match the view of the generator
            other = self.matcher
            answer = "matched"
            if self.matcher == "sgbm":
                sgbm = SGBMConfig(with_filled_holes=True)
                matcher = SGBMMatcher(sgbm)
                settings = {**settings, **asdict(sgbm)}
            else:
                matcher = find_weights(self.matcher)
                other = matcher.stem
                facts["matcher_sha256"] = file_sha256(matcher)
            name = f"{path.stem}-{other}"
            facts["matcher"] = f"{kind} with {other}"

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
            facts["answer"] = net.synthesiser.config.answer
            facts["scales"] = list(net.synthesiser.scales)
        return DepthMethod(name, net, {**facts, **settings}, with_right)

    def packed(self) -> "DepthMethodSource":
        """Give the same with the weights in memory."""
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


def read_lens(options: LensOptions, sources: Sequence[Path]) -> Camera | FieldOfView | float:
    """Read the camera of the options; without one, the EXIF of the images."""
    focal_px = options.focal_px
    fov = options.fov
    if focal_px is not None and not 1 < focal_px < 1e6:
        raise InputError(f"--focal-px {focal_px}: not a focal length in pixels; KITTI's is 721.5.")
    if fov is not None:
        return FieldOfView(fov)
    if options.camera is None:
        return _exif_focal_px(sources) if focal_px is None else focal_px

    camera = read_camera(options.camera, _size_of_first(sources))
    if not isinstance(camera, StereoRig):
        return camera
    print("the camera's baseline is ignored: one image has none", file=sys.stderr)
    keys = {key: getattr(camera, key) for key in ("mount_height_m", "tilt_deg")}
    return Camera(width=camera.width, height=camera.height, K=camera.K, **keys)


def _exif_focal_px(sources: Sequence[Path]) -> float:
    """Give the focal length [px] on which the EXIF of all images agrees, and print it."""
    focal_of: dict[str, tuple[float, str]] = {}
    for source in sources:
        try:
            focal = None if _is_video(source) else read_exif_focal(source)
        except InputError:  # what cannot be read fails by itself, later
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
    (first, (focal_px, tags)), *others = focal_of.items()
    for other, (other_px, _) in others:
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


def _size_of_first(sources: Sequence[Path]) -> tuple[int, int] | None:
    """Give width and height [px] of the first image or video that can be read, None if none can."""
    for source in sources:
        with suppress(InputError):  # what cannot be read fails by itself, later
            if not _is_video(source):
                return image_size(source)
            _, frame = next(iter(read_video(source)))
            return (frame.shape[2], frame.shape[1])
    return None


def image_work(
    lens: LensOptions,
    scale: ScaleOptions,
    output: PredictOutput,
    method: DepthMethodSource,
    sources: Sequence[Path],
) -> "DepthWork":
    """Describe the work on single images, whose EXIF may be the only source of their camera."""
    camera = read_lens(lens, sources)
    return DepthWork(method=method, camera=camera, scale=scale, output=output)


def pair_work(
    camera: Path, pairs: PairNetworks, method: DepthMethodSource, files: Sequence[Path]
) -> "DepthWork":
    """Describe the work on pairs; the first gives the size if the camera's file has none."""
    rig = read_rig(camera, image_size(files[0]))
    output = PredictOutput(cloud=pairs.cloud, min_confidence=pairs.min_confidence)
    return DepthWork(method=method, camera=rig, output=output, with_check=pairs.check, files=PAIRS)


def find_sources(words: Sequence[str], out: Path) -> list[Path]:
    """List images and videos."""
    sources: list[Path] = []
    for word in words:
        sources += [Path(word)] if _is_video(word) else list_images(word)
    stems = Counter(path.stem for path in sources)
    twice = next((stem for stem, times in stems.items() if times > 1), None)
    if twice is not None:
        raise InputError(f"two inputs are called {twice!r}, and so would their results be.")
    for video in filter(_is_video, sources):
        frame = next((stem for stem in stems if _frame_of(video, stem)), None)
        if frame is not None:
            raise InputError(
                f"an input is called {frame!r}, as a frame of a video would be, and so would their "
                "results; rename one of the two"
            )
    refuse_among_inputs(out, words, sources)
    return sources


def _frame_of(video: Path, name: str) -> bool:
    """Whether a frame of a video has this name."""
    return re.fullmatch(re.escape(video.stem) + r"_\d{6}", name) is not None


def _is_video(path: str | Path) -> bool:
    return Path(path).suffix.lower() in VIDEO_SUFFIXES


def list_pairs(left: str, right: str) -> list[tuple[Path, Path]]:
    """List the images of both sides, paired by their names or the numbers in them."""
    lefts = list_images(left)
    rights = list_images(right)
    stems, others = ([path.stem for path in side] for side in (lefts, rights))
    if len(set(stems)) != len(stems):
        twice = next(stem for stem in stems if stems.count(stem) > 1)
        raise InputError(f"{left}: two images are called {twice!r}, so would their results.")
    if (lefts, rights) != ([Path(left)], [Path(right)]):
        rights = [rights[k] for k in find_partners(stems, others, f"{left} and {right}")]
    return list(zip(lefts, rights, strict=True))


@dataclass(frozen=True, kw_only=True)
class DepthWork:
    """Images or pairs to the files of their depth, in this process or by workers of an engine.

    ``camera``: what is known of that of the images, or the rig of pairs.
    """

    method: DepthMethodSource
    camera: Camera | FieldOfView | float
    output: PredictOutput
    scale: ScaleOptions = field(default_factory=ScaleOptions)
    with_check: bool = True
    files: Files = IMAGES

    def input_of(self, name: str, left: Tensor | Path, right: Path | None = None) -> StereoInput:
        """Make the input of an image or a pair, read already or not."""
        image = read_image(left) if isinstance(left, Path) else left
        camera = camera_of(self.camera, (image.shape[2], image.shape[1]))
        assert camera is not None
        mount = {"mount_height_m": self.scale.camera_height, "tilt_deg": self.scale.camera_tilt}
        camera = replace(camera, **{key: v for key, v in mount.items() if v is not None})
        other = None if right is None else read_image(right)
        return StereoInput(name=name, left=image, right=other, camera=camera)

    def jobs_of(self, files: Sequence[Path]) -> Iterator[Job[StereoInput]]:
        """Give the job of an image or a pair, or the jobs of all frames of a video."""
        if not _is_video(files[0]):
            name = files[0].stem
            yield Job(name=name, read=partial(self.input_of, name, *files))
            return
        for name, frame in read_video(files[0]):
            yield Job(name=name, read=partial(self.input_of, name, frame))

    def estimate_many(
        self, net: FakestereoNet, inputs: Sequence[StereoInput], mount: MountFilter | None = None
    ) -> list[DepthEstimate | InputError]:
        """Estimate inputs together; ``mount`` is that of frames of one camera."""
        named = [(depth_input.name, depth_input) for depth_input in inputs]
        estimates = net.estimate_together(named, with_check=self.with_check, mount=mount)
        if self.scale.known_distance is None:
            return estimates
        return [
            self._scaled(depth_input.name, estimate)
            for depth_input, estimate in zip(inputs, estimates, strict=True)
        ]

    def _scaled(
        self, name: str, estimate: DepthEstimate | InputError
    ) -> DepthEstimate | InputError:
        """Scale an estimate by the distance that the user knows."""
        if isinstance(estimate, InputError):
            return estimate
        try:
            return scale_by_distance(estimate, name, self.scale.measured_point)
        except InputError as error:
            return error

    def settings(self, method: dict[str, Any]) -> dict[str, Any]:
        """Give the JSON values that decide the results, for the record of a run."""
        camera: dict[str, Any] = {"focal_px": self.camera}
        if isinstance(self.camera, FieldOfView):
            camera = {"fov_deg": self.camera.degrees}
        elif isinstance(self.camera, StereoRig):
            camera = {"K": self.camera.K.tolist(), "baseline_m": self.camera.baseline_m}
            camera["cx_right_minus_left_px"] = self.camera.cx_right_minus_left_px
        elif isinstance(self.camera, Camera):
            keys = camera_keys(self.camera)
            camera = {key: keys[key] for key in ("K", "mount_height_m", "tilt_deg") if key in keys}
        camera |= {key: v for key, v in asdict(self.scale).items() if v not in (None, False)}
        output: dict[str, Any] = {}
        if self.files != PAIRS:
            output["color_range_m"] = list(self.output.color_range)
        if self.output.cloud:
            output["min_confidence"] = self.output.min_confidence
        return {**method, "camera": camera, **output}

    def start(self) -> Function:
        """Build the networks."""
        method = self.method.build()

        def estimate(samples: Sequence[Sample], out: Path) -> list[str]:
            """Estimate a batch of a worker into a folder; give of each why it failed, or ""."""
            depth_run = DepthRun(work=self, method=method, out=out)
            jobs = [
                Job(name=sample.name, read=partial(self.input_of, sample.name, *sample.files))
                for sample in samples
            ]
            depth_run.estimate(jobs, len(samples), "images")
            return [str(depth_run.failures.get(sample.name, "")) for sample in samples]

        return estimate


def predict_on_ray(
    words: Sequence[str],
    files: Files,
    work_of: Callable[[Sequence[Path]], DepthWork],
    out: str,
    engine: EngineOptions,
) -> int:
    """Estimate images or pairs, manifests or tar shards, by the workers of an engine."""
    if (video := next(filter(_is_video, words), None)) is not None:
        raise InputError(f"{video}: --engine ray takes no videos; omit --engine for them")
    inputs = Inputs.find(words, files)
    with inputs.first() as first:
        first_work = work_of(first)
    if first_work.scale.one_mount:
        raise InputError("--one-mount takes the images one after the other; omit it, or --engine")
    method_settings = (
        replace(first_work.method, config=replace(first_work.method.config, device="cpu"))
        .build()
        .settings
    )
    if "device" in method_settings:  # that of the workers, which this machine need not have
        method_settings["device"] = first_work.method.config.device
    settings = first_work.settings(method_settings)
    work = Work(start=first_work.start, files=files, endings=ENDINGS, batch=first_work.output.batch)
    what = "pairs" if files == PAIRS else "depth maps"
    return print_shards(engine.run(work, inputs, out, settings), out, what)


def predict_files(
    sources: Sequence[tuple[Path, ...]], work: DepthWork, method: DepthMethod, out: Path
) -> int:
    """Estimate what is not finished; an input that fails is named and stops no other.

    Of several processes each takes its share, and the first writes the page.
    """
    videos = [files[0].stem for files in sources if _is_video(files[0])]
    run.claim_folder(out, work.settings(method.settings), [_PAGE])
    endings = [f".{end}" for end in ENDINGS] + [_VIDEO]
    run.claim_names(out, {files[0].stem: files for files in sources}, endings, videos)
    process = run.find_rank()
    if work.scale.one_mount and process.world > 1:
        raise InputError("--one-mount takes the images one after the other; omit it, or run alone")

    mine = process.share_of(sources)
    depth_run = DepthRun(work=work, method=method, out=out)
    stills = [files for files in mine if not _is_video(files[0])]
    still_jobs = (job for files in stills for job in work.jobs_of(files))
    mount = MountFilter() if work.scale.one_mount else None
    count = len(depth_run.estimate(still_jobs, len(stills), "images", mount))
    count += sum(depth_run.estimate_video(video) for video, *_ in mine if _is_video(video))

    failures = list(depth_run.failures.values())
    if failures and not count and len(sources) == 1:
        raise failures[0]
    for failure in failures:
        print(f"depthpose: failed: {failure}", file=sys.stderr)
    total = f"{count} of {len(mine)} pairs" if work.files == PAIRS else f"{count} depth maps"
    print(f"{total} are in {out}")
    if process.rank == 0:
        write_depth_page(sources, work, out, failures)
    return 1 if failures else 0


def write_depth_page(
    sources: Sequence[tuple[Path, ...]], work: DepthWork, out: Path, failures: Sequence[InputError]
) -> None:
    """Write a page of some of the finished depth maps, of every failure and of every warning."""
    finished_names = {
        name for name in run.read_results(out) if run.is_whole(out, name, [f"{name}.{LAST}"])
    }
    names_of: dict[tuple[Path, ...], list[str]] = {}
    for files in sources:
        if _is_video(files[0]):
            frames = (name for name in finished_names if _frame_of(files[0], name))
            names_of[files] = sorted(frames)
        else:
            names_of[files] = [name for name in (files[0].stem,) if name in finished_names]
    names = [name for names_of_source in names_of.values() for name in names_of_source]
    chosen = {names[k] for k in spread_evenly(len(names), MOST_VIEWS)}
    shown = list(_read_chosen(names_of, work, chosen))

    selection = "all" if len(shown) == len(names) else "spread evenly"
    number = f"{len(names)} depth map{'s' * (len(names) != 1)}"
    text = f"Shown: {len(shown)} of {number} in this folder ({selection})."
    rows = [{"not estimated, because": str(reason)} for reason in failures]
    warnings = {name: out / f"{name}.warning.txt" for name in names}
    rows += [
        {"warning": f"{name}: {read_text(path).strip()}"}
        for name, path in warnings.items()
        if path.is_file()
    ]
    sections = [Section(title="What is here", text=text, rows=rows)]

    range_m = work.output.color_range
    colours = f"depth, {range_m[0]:g} m bright to {range_m[1]:g} m dark"
    films = [Film(path=p, caption=f"{p.name}: {colours}") for p in sorted(out.glob(f"*{_VIDEO}"))]
    sections += [Section(title="Videos", films=films)] if films else []
    for depth_input in shown:
        estimate = read_estimate(out, depth_input.name, depth_input.camera)
        sections.append(depth_section(depth_input.name, depth_input, estimate, range_m=range_m))
    title = f"Depth of {len(names)} image{'s' * (len(names) != 1)}"
    write_page(out / _PAGE, title, sections, run.environment())
    print(f"the page: {out / _PAGE}")


def _read_chosen(
    names_of: Mapping[tuple[Path, ...], Sequence[str]], work: DepthWork, chosen: Collection[str]
) -> Iterator[StereoInput]:
    """Read the chosen inputs again; what cannot be read any more is left out."""
    for files, names in names_of.items():
        wanted = [name for name in names if name in chosen]
        with suppress(InputError):
            for job in work.jobs_of(files) if wanted else ():
                if job.name in wanted:
                    yield job.read()
                if job.name == wanted[-1]:
                    break


@dataclass(frozen=True, kw_only=True)
class DepthRun:
    """Estimates of one process as files in ``out``, and its failures by the names of inputs."""

    work: DepthWork
    method: DepthMethod
    out: Path
    failures: dict[str, InputError] = field(default_factory=dict)

    def estimate(
        self,
        jobs: Iterable[Job[StereoInput]],
        total: int | None,
        what: str,
        mount: MountFilter | None = None,
    ) -> list[str]:
        """Estimate what is not finished, and give the names of all that is now.

        Args:
            jobs: images, pairs or the frames of a video.
            total: how many there are; None: unknown.
            what: they are called, beside the progress.
            mount: that of the inputs, where they are frames of one camera.
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
        for outcome in tqdm(outcomes, what, total, disable=None, unit=f" {what}"):
            name = outcome.job.name
            try:
                if outcome.failure is not None:
                    raise outcome.failure
                if outcome.result is not None:
                    self._print_remarks(name, outcome.result)
                elif mount is not None:  # of an earlier run, whose mount counts for what follows
                    mount.last = read_ground(self.out, name) or mount.last
                names.append(name)
            except InputError as error:
                self.failures[name] = error
        return names

    def estimate_video(self, source: Path) -> int:
        """Estimate the frames of a video, and make a video of them; give how many are done."""
        try:
            video = read_video(source)
            jobs = self.work.jobs_of([source])
            names = self.estimate(jobs, video.frames or None, source.name, MountFilter())
            drawn = self._draw_frames(source, names) if names else ()
            write_video(self.out / f"{source.stem}{_VIDEO}", drawn, video.fps)
        except InputError as error:
            self.failures[source.name] = error
            return 0
        return len(names)

    def _draw_frames(self, source: Path, names: Sequence[str]) -> Iterator[Tensor]:
        """Draw each frame's depth, in grey where there is none, so that none is missing."""
        failed = {name for name in self.failures if _frame_of(source, name)}
        unknown = torch.full_like(read_map(self.out / f"{names[0]}.depth_m.npy"), torch.nan)
        for name in sorted([*names, *failed]):
            depth_m = unknown if name in failed else read_map(self.out / f"{name}.depth_m.npy")
            yield draw_depth(depth_m, *self.work.output.color_range)

    def _print_remarks(self, name: str, estimate: DepthEstimate) -> None:
        """Print the warning of an estimate, its mount, and how much its cloud leaves out."""
        output = self.work.output
        if output.cloud and output.min_confidence > 0:
            sure_count = estimate.is_sure(output.min_confidence).sum()
            share = 1 - float(sure_count / estimate.is_sure(0.0).sum().clamp(min=1))
            tqdm.write(
                f"{name}: {share:.1%} of the depth is less sure than {output.min_confidence:g} "
                "and left out of the cloud"
            )
        if estimate.warning:
            tqdm.write(f"depthpose: warning: {name}: {estimate.warning}", sys.stderr)
        if estimate.ground is not None:
            tqdm.write(f"{name}: {estimate.ground}")
