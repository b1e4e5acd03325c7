"""The work behind ``depthpose depth predict``."""

import re
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from depthpose.cli.depth_methods import Method
from depthpose.cli.depth_options import LensOptions, PredictOutput, ScaleOptions
from depthpose.core.camera import Camera, FieldOfView, StereoRig, camera_of, read_camera
from depthpose.core.camera.pinhole import camera_keys
from depthpose.core.draw import draw_depth
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
from depthpose.core.files.text import read_text
from depthpose.core.run import (
    claim_folder,
    claim_names,
    environment,
    find_rank,
    note_result,
    refuse_among_inputs,
)
from depthpose.depth.estimator import FakestereoNet
from depthpose.depth.ground import scale_by_distance
from depthpose.depth.predictions import (
    CLOUD_M,
    COLOR_RANGE_M,
    ENDINGS,
    is_finished,
    read_estimate,
    write_estimate,
)
from depthpose.depth.types import StereoInput
from depthpose.report.depth import DepthShown, depth_section
from depthpose.report.page import MOST_VIEWS, Film, Section, spread_evenly, write_page
from depthpose.report.viewer import Viewer, open_viewer

PAGE = "report.html"
_VIDEO = ".color.mp4"
_SAME_FOCAL = 0.01


@dataclass(frozen=True, kw_only=True)
class Lens:
    """What is known of the camera, and what sets the scale."""

    camera: Camera | FieldOfView | float
    scale: ScaleOptions

    def camera_of(self, image: Tensor) -> Camera:
        """Make the camera of an image."""
        camera = camera_of(self.camera, (image.shape[2], image.shape[1]))
        assert camera is not None
        mount = {"mount_height_m": self.scale.camera_height, "tilt_deg": self.scale.camera_tilt}
        return replace(camera, **{key: value for key, value in mount.items() if value is not None})


def read_lens(options: LensOptions, sources: Sequence[Path], scale: ScaleOptions) -> Lens:
    """Read what the user knows of the camera; where its file says no size, that of the images.

    Without any of it the EXIF of the images is asked.
    """
    focal_px, fov = options.focal_px, options.fov
    named = {"--camera": options.camera, "--focal-px": focal_px, "--fov": fov}
    words = [word for word, value in named.items() if value is not None]
    if len(words) > 1:
        raise InputError(f"{' and '.join(words)} all give the focal length; omit all but one")
    if focal_px is not None and not 1 < focal_px < 1e6:
        raise InputError(f"--focal-px {focal_px}: not a focal length in pixels; KITTI's is 721.5.")
    if fov is not None:
        return Lens(camera=FieldOfView(fov), scale=scale)
    if options.camera is None:
        focal_px = _exif_of_all(sources) if focal_px is None else focal_px
        return Lens(camera=focal_px, scale=scale)
    size = None
    for source in sources:
        with suppress(InputError):  # an image that cannot be read fails by itself, later
            if _is_video(source):
                _, frame = next(iter(read_video(source)))
                size = frame.shape[2], frame.shape[1]
            else:
                size = image_size(source)
            break
    read = read_camera(options.camera, size)
    if isinstance(read, StereoRig):
        print("the camera's baseline is ignored: one image has none", file=sys.stderr)
        keys = {key: getattr(read, key) for key in ("mount_height_m", "tilt_deg")}
        read = Camera(width=read.width, height=read.height, K=read.K, **keys)
    return Lens(camera=read, scale=scale)


def _exif_of_all(sources: Sequence[Path]) -> float:
    """Read the focal length that the EXIF of all images says, and say it."""
    known: dict[str, tuple[float, str]] = {}
    for source in sources:
        focal = None
        if not _is_video(source):
            try:
                focal = read_exif_focal(source)
            except InputError:  # what cannot be read fails by itself, later
                continue
        if focal is None:
            raise InputError(
                f"metres from one image need its focal length, and {source.name} has none in its "
                "EXIF: give --camera FILE, --focal-px, or --fov, the angle from left to right (a "
                "phone's main camera has about 0.75 times the image's width, or 67 degrees)"
            )
        known[source.name] = focal
    if not known:
        raise InputError(
            "no image can be read; give --camera, --focal-px or --fov, and intact ones"
        )
    (first, (focal_px, tags)), *others = known.items()
    other = next((one for one in others if abs(one[1][0] / focal_px - 1) > _SAME_FOCAL), None)
    if other is not None:
        raise InputError(
            f"the EXIF of {first} says a focal length of {focal_px:.0f} px and that of {other[0]} "
            f"{other[1][0]:.0f} px; predict them apart"
        )
    print(f"a focal length of {focal_px:.0f} px, by the EXIF of {first} ({tags}); of a cropped "
          "picture it is another", file=sys.stderr)  # fmt: skip
    return focal_px


def find_sources(words: Sequence[str], out: Path) -> list[Path]:
    """List images and videos."""
    sources: list[Path] = []
    for word in words:
        sources += [Path(word)] if _is_video(Path(word)) else list_images(word)
    stems = Counter(path.stem for path in sources)
    twice = next((stem for stem, times in stems.items() if times > 1), None)
    if twice is not None:
        raise InputError(f"two inputs are called {twice!r}, and so would their results be.")
    frames = [re.fullmatch(re.escape(path.stem) + r"_\d{6}", stem) for path in sources
              if _is_video(path) for stem in stems]  # fmt: skip
    if (frame := next(filter(None, frames), None)) is not None:
        raise InputError(
            f"an input is called {frame[0]!r}, as a frame of a video would be, and so would their "
            "results; rename one of the two"
        )
    refuse_among_inputs(out, words, sources)
    return sources


def predict_all(
    sources: list[Path], lens: Lens, method: Method, out: Path, output: PredictOutput
) -> int:
    """Predict what is not finished; an image that fails is named and stops no other."""
    claim_folder(out, settings_of(method.settings, lens, output), [PAGE])
    videos = [source.stem for source in sources if _is_video(source)]
    endings = [f".{end}" for end in ENDINGS] + [_VIDEO]
    claim_names(out, {source.stem: source for source in sources}, endings, videos)
    mine = [sources[k] for k in find_rank().share(len(sources))]
    assert isinstance(method.net, FakestereoNet), "weights build no other"
    with open_viewer(None if find_rank().rank else output.view) as viewer:
        predictor = Predictor(lens=lens, net=method.net, out=out, output=output, viewer=viewer)
        images = {path.stem: path for path in mine if not _is_video(path)}
        frames = predictor.read_images(images)
        done = len(predictor.predict(frames, len(images), "images"))
        for path in filter(_is_video, mine):
            done += predictor.predict_video(path)
    failures = list(predictor.failures.values())
    if failures and not done and len(sources) == 1:
        raise failures[0]
    for failure in failures:
        print(f"depthpose: failed: {failure}", file=sys.stderr)
    print(f"{done} depth maps are in {out}")
    if find_rank().rank == 0:  # the page of what is finished: others may still be at work
        finished = {source: _finished_names(source, out) for source in sources}

        def read(names: Sequence[str]) -> Iterator[StereoInput]:
            for source in sources:
                wanted = [name for name in finished[source] if name in names]
                with suppress(InputError):
                    for name, image in _read_some(source, wanted):
                        camera = lens.camera_of(image)
                        yield StereoInput(name=name, left=image, right=None, camera=camera)

        names = [name for some in finished.values() for name in some]
        write_depth_page(
            out, names, read, [str(failure) for failure in failures], output.color_range
        )
    return 1 if failures else 0


@dataclass(frozen=True, kw_only=True)
class Predictor:
    """Images in, files out; what fails is remembered in ``failures``, by its name."""

    lens: Lens
    net: FakestereoNet
    out: Path
    output: PredictOutput
    viewer: Viewer | None = None
    failures: dict[str, InputError] = field(default_factory=dict)

    def predict_video(self, source: Path) -> int:
        """Predict a video's frames, and make a video of them; give how many are done."""
        frames: list[str] = []

        def noted() -> Iterator[tuple[str, Tensor]]:
            for name, image in video:
                frames.append(name)
                yield name, image

        def colors() -> Iterator[Tensor]:
            """Draw each frame's depth, in grey where there is none, so that none is missing."""
            done, first = set(names), self.out / f"{min(names)}.depth_m.npy"
            unknown = torch.full_like(read_map(first), torch.nan)
            for name in frames:
                depth_m = read_map(self.out / f"{name}.depth_m.npy") if name in done else unknown
                yield draw_depth(depth_m, *self.output.color_range)

        try:
            video = read_video(source)
            names = self.predict(noted(), video.frames or None, source.name)
            drawn = colors() if names else iter(())
            write_video(self.out / f"{source.stem}{_VIDEO}", drawn, video.fps)
        except InputError as error:
            self.failures[source.name] = error
            return 0
        return len(names)

    def read_images(self, sources: Mapping[str, Path]) -> Iterator[tuple[str, Tensor]]:
        """Read images, each with the name of its results."""
        for name, source in sources.items():
            try:
                yield name, read_image(source)
            except InputError as error:
                self.failures[name] = error

    def predict(
        self, frames: Iterator[tuple[str, Tensor]], total: int | None, what: str
    ) -> list[str]:
        """Predict named frames, a batch together, and write their files; give what is done."""
        names: list[str] = []
        cloud_m, distance = CLOUD_M if self.output.cloud else None, self.lens.scale.distance
        with tqdm(total=total, desc=what, disable=None, unit=" images") as bar:
            while chunk := list(islice(frames, self.output.batch)):
                inputs = [
                    StereoInput(name=name, left=left, right=None, camera=self.lens.camera_of(left))
                    for name, left in chunk
                    if not is_finished(self.out, name, with_cloud=self.output.cloud)
                ]
                estimates = self.net.estimate_many(inputs, batch=self.output.batch)
                for image, estimate in zip(inputs, estimates, strict=True):
                    try:
                        if isinstance(estimate, InputError):
                            raise estimate
                        scaled = estimate
                        if distance is not None:
                            scaled = scale_by_distance(estimate, image.name, distance)
                        colors_m = self.output.color_range
                        files = write_estimate(self.out, image, scaled, colors_m, cloud_m)
                        note_result(self.out, image.name, files)
                    except InputError as error:
                        self.failures[image.name] = error
                        continue
                    if scaled.warning:
                        said = f"depthpose: warning: {image.name}: {scaled.warning}"
                        tqdm.write(said, sys.stderr)
                    if scaled.ground is not None:
                        tqdm.write(f"{image.name}: {scaled.ground}")
                    if self.viewer is not None:
                        self.viewer.show_depth(image, scaled)
                names += [name for name, _ in chunk if name not in self.failures]
                bar.update(len(chunk))
        return names


def _is_video(path: Path) -> bool:
    return path.suffix.lower() in VIDEO_SUFFIXES


def _finished_names(source: Path, out: Path) -> list[str]:
    """List what is finished of an image, or of a video's frames."""
    if not _is_video(source):
        return [source.stem] if is_finished(out, source.stem) else []
    frame = re.compile(re.escape(source.stem) + r"_\d{6}\.disparity_px\.npy")
    names = sorted(path.name for path in out.iterdir() if frame.fullmatch(path.name))
    return [name.removesuffix(".disparity_px.npy") for name in names]


def _read_some(source: Path, wanted: Sequence[str]) -> Iterator[tuple[str, Tensor]]:
    """Read an image again, or some frames of a video, no further than to the last of them."""
    if wanted and not _is_video(source):
        yield source.stem, read_image(source)
    elif wanted:
        for name, image in read_video(source):
            if name in wanted:
                yield name, image
            if name == wanted[-1]:
                return


def write_depth_page(
    out: Path,
    names: Sequence[str],
    read: Callable[[Sequence[str]], Iterator[StereoInput]],
    failures: Sequence[str],
    range_m: tuple[float, float] = COLOR_RANGE_M,
) -> None:
    """Write a page of some depth maps of a folder, whose inputs ``read`` gives, and of warnings."""
    chosen = [names[k] for k in spread_evenly(len(names), MOST_VIEWS)]
    pairs = list(read(chosen))
    which = "all" if len(pairs) == len(names) else "spread evenly"
    text = f"Shown: {len(pairs)} of {_count(len(names), 'depth map')} in this folder ({which})."
    noted = [{"not estimated, because": reason} for reason in failures]
    doubts = {name: out / f"{name}.warning.txt" for name in names}
    noted += [
        {"warning": f"{name}: {read_text(path).strip()}"}
        for name, path in doubts.items()
        if path.is_file()
    ]
    sections = [Section(title="What is here", text=text, rows=noted)]
    said = f"depth, {range_m[0]:g} m bright to {range_m[1]:g} m dark"
    films = [Film(path=p, caption=f"{p.name}: {said}") for p in sorted(out.glob(f"*{_VIDEO}"))]
    sections += [Section(title="Videos", films=films)] if films else []
    for pair in pairs:
        estimate = read_estimate(out, pair.name, pair.camera)
        shown = DepthShown(pair=pair, estimate=estimate, range_m=range_m)
        sections.append(depth_section(pair.name, shown))
    page = out / PAGE
    write_page(page, f"Depth of {_count(len(names), 'image')}", sections, environment())
    print(f"the page: {page}")


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"


def settings_of(method: dict[str, Any], lens: Lens, output: PredictOutput) -> dict[str, Any]:
    """Give what decides the results, as JSON values, for the record of a run."""
    known: dict[str, Any] = {"focal_px": lens.camera}
    if isinstance(lens.camera, FieldOfView):
        known = {"fov_deg": lens.camera.degrees}
    elif isinstance(lens.camera, Camera):
        keys = camera_keys(lens.camera)
        known = {key: keys[key] for key in ("K", "mount_height_m", "tilt_deg") if key in keys}
    known |= {key: value for key, value in asdict(lens.scale).items() if value is not None}
    return {**method, "camera": known, "color_range_m": list(output.color_range)}
