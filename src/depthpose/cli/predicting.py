"""The work behind ``depthpose depth predict``."""

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor
from tqdm import tqdm

from depthpose.cli.methods import Method
from depthpose.core.camera import Camera, StereoRig, read_camera
from depthpose.core.draw import draw_depth
from depthpose.core.errors import InputError
from depthpose.core.files import (
    VIDEO_SUFFIXES,
    list_images,
    read_image,
    read_map,
    read_video,
    write_video,
)
from depthpose.core.run import claim_folder, claim_names, find_shard
from depthpose.depth.predictions import is_finished, write_estimate, write_estimate_cloud
from depthpose.depth.types import StereoInput


@dataclass(frozen=True, kw_only=True)
class Lens:
    """What is known of the camera: all of it, or its focal length alone."""

    camera: Camera | None
    focal_px: float | None

    def camera_of(self, image: Tensor) -> Camera:
        """Make the camera of an image."""
        if self.camera is not None:
            return self.camera
        assert self.focal_px is not None
        height, width = image.shape[1:]
        f = self.focal_px
        K = [[f, 0, (width - 1) / 2], [0, f, (height - 1) / 2], [0, 0, 1]]
        return Camera(width=width, height=height, K=torch.tensor(K, dtype=torch.float64))


@dataclass(frozen=True, kw_only=True)
class Look:
    """Which pictures and clouds are written beside the maps."""

    range_m: tuple[float, float]
    with_cloud: bool


def read_lens(camera: Path | None, focal_px: float | None) -> Lens:
    """Read what the user knows of the camera.

    Raises:
        InputError: neither of the two is given, or both.
    """
    if (camera is None) == (focal_px is None):
        raise InputError(
            "metres from one image need its focal length: give --camera FILE.json, or --focal-px "
            "(a phone's main camera has about 0.75 times the image's width)."
        )
    if focal_px is not None and not 1 < focal_px < 1e6:
        raise InputError(f"--focal-px {focal_px}: not a focal length in pixels; KITTI's is 721.5.")
    read = None if camera is None else read_camera(camera)
    if isinstance(read, StereoRig):
        print("the camera's baseline is not looked at: one image has none", file=sys.stderr)
    return Lens(camera=read, focal_px=focal_px)


def find_sources(words: Sequence[str]) -> list[Path]:
    """List images and videos.

    Raises:
        InputError: nothing there, or two inputs whose results would have one name.
    """
    found: list[Path] = []
    for word in words:
        is_video = Path(word).suffix.lower() in VIDEO_SUFFIXES
        found += [Path(word)] if is_video else list_images(word)
    stems = [path.stem for path in found]
    twice = next((stem for stem in stems if stems.count(stem) > 1), None)
    if twice is not None:
        raise InputError(f"two inputs are called {twice!r}, and so would their results be.")
    return found


def predict_all(sources: list[Path], lens: Lens, method: Method, out: Path, look: Look) -> int:
    """Predict what is not finished; an image that fails is named and stops no other."""
    known = lens.camera
    facts = {"K": known.K.tolist()} if known else {"focal_px": lens.focal_px}
    claim_folder(out, {**method.settings, "camera": facts, "color_range_m": list(look.range_m)})
    claim_names(out, {source.stem: source for source in sources})
    mine = [sources[k] for k in find_shard().share(len(sources))]
    failures: list[str] = []
    done = 0
    for source in mine:
        try:
            done += _predict_source(source, lens, method, out, look)
        except InputError as error:
            if len(sources) == 1:
                raise
            failures.append(str(error))
    for failure in failures:
        print(f"depthpose: failed: {failure}", file=sys.stderr)
    print(f"{done} depth maps are in {out}")
    return 1 if failures else 0


def _predict_source(source: Path, lens: Lens, method: Method, out: Path, look: Look) -> int:
    video = read_video(source) if source.suffix.lower() in VIDEO_SUFFIXES else None
    frames = iter(video) if video else iter([(source.stem, None)])
    names: list[str] = []
    total = (video.frames or None) if video else 1
    for name, image in tqdm(frames, source.name, total=total, disable=None, unit=" images"):
        _predict_one(name, read_image(source) if image is None else image, lens, method, out, look)
        names.append(name)
    if video:
        write_video(out / f"{source.stem}.color.mp4", _colors(names, out, look), video.fps)
    return len(names)


def _predict_one(
    name: str, image: Tensor, lens: Lens, method: Method, out: Path, look: Look
) -> None:
    if is_finished(out, name) and (not look.with_cloud or (out / f"{name}.ply").is_file()):
        return
    pair = StereoInput(name=name, left=image, right=None, camera=lens.camera_of(image))
    estimate = method.net.estimate_pair(pair)
    if look.with_cloud:
        write_estimate_cloud(out, pair, estimate)
    write_estimate(out, pair, estimate, look.range_m)


def _colors(names: list[str], out: Path, look: Look) -> Iterator[Tensor]:
    for name in names:
        yield draw_depth(read_map(out / f"{name}.depth_m.npy"), *look.range_m)
