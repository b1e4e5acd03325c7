"""Estimates as files of a folder: writing them, and reading ours or those of other methods."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from depthpose.core import files
from depthpose.core.camera import Camera, StereoRig
from depthpose.core.config import config_from_dict
from depthpose.core.draw import draw_depth, draw_disparity
from depthpose.core.errors import InputError
from depthpose.core.files.disk import read_text, write_bytes
from depthpose.core.run_folder import claim_folder, claim_names, is_whole, note_result
from depthpose.core.runner import Job, Results, run_jobs
from depthpose.depth.config import COLOR_RANGE_M
from depthpose.depth.disparity import depth_from_disparity, disparity_from_depth
from depthpose.depth.metrics import SMALLEST_DEPTH_M
from depthpose.depth.types import DepthEstimate, Ground, Map, StereoInput, View


@runtime_checkable
class Estimator(Protocol):
    """Anything that estimates depth: :class:`FakestereoNet`, a baseline, or your own method."""

    def estimate_input(self, pair: StereoInput, /) -> DepthEstimate:
        """Estimate depth of one input, whose images are in memory."""
        ...


_DISPARITY = ("disparity_px.npy", "disparity_px.pfm")
_DEPTH = ("depth_m.npy", "depth_m.pfm", "depth.png")
_KITTI = "png"
"""NAME.png as KITTI's benchmarks take it: metres x 256, or pixels of disparity x 256."""
EXPECTED = (
    "NAME.disparity_px.npy or .pfm (pixels at the map's own width), NAME.depth_m.npy or .pfm, "
    "NAME.depth.png (metres x 256), or NAME.png as KITTI's benchmarks take it"
)

_NEARLY_ALL = 0.9
"""Share of the pixels with a negative depth from which its sign is wrong."""
CLOUD = "cloud.ply"
LAST = "disparity_px.npy"
"""Ending of the file that every estimate has, and that is written last."""
_DECIMALS = 6
"""Decimals of the values of a road in its file: further digits differ from run to run, since
threads add in another order."""
CLOUD_M = 80.0
"""Distance up to which a cloud is written, unless another is given."""


@dataclass(frozen=True, kw_only=True)
class _FileOptions:
    """Options of the files of an estimate, as :func:`write_estimate` takes them."""

    range_m: tuple[float, float]
    cloud_m: float | None
    min_confidence: float | None


class _EstimateFile(NamedTuple):
    """A kind of file ``NAME.ENDING`` of an estimate: how it is written, and what it holds.

    ``content`` gives None where an estimate has nothing of the kind.
    """

    ending: str
    write: Callable[[Path, Any], None]
    content: Callable[[DepthEstimate, _FileOptions], Any]


def _make_cloud(estimate: DepthEstimate, options: _FileOptions) -> files.PointCloud | None:
    """Make the cloud of an estimate; None where none is to be written."""
    if options.cloud_m is None:
        return None
    return estimate.cloud(options.cloud_m, options.min_confidence)


def _encode_warning(estimate: DepthEstimate, _: _FileOptions) -> bytes | None:
    """Encode the warning of an estimate as a line of text; None where it has none."""
    return f"{estimate.warning}\n".encode() if estimate.warning else None


def _round_ground(estimate: DepthEstimate, _: _FileOptions) -> dict[str, float] | None:
    """Round the values of the road, by name, to digits that every run repeats; None without one."""
    if estimate.ground is None:
        return None
    return {name: round(value, _DECIMALS) for name, value in asdict(estimate.ground).items()}


def _draw_sky(estimate: DepthEstimate, _: _FileOptions) -> View | None:
    """Draw the sky white, and all else black; None where the sky is not recognised."""
    return None if estimate.is_sky is None else estimate.is_sky.float().expand(3, -1, -1)


def _draw_colors(estimate: DepthEstimate, options: _FileOptions) -> View:
    """Draw the depth of an estimate in colours, or its disparity where it has no depth."""
    if estimate.depth_m is None:
        return draw_disparity(estimate.disparity_px, is_sky=estimate.is_sky)
    return draw_depth(estimate.depth_m, *options.range_m)


_FILES = (
    _EstimateFile(CLOUD, files.write_cloud, _make_cloud),
    _EstimateFile("warning.txt", write_bytes, _encode_warning),
    _EstimateFile("ground.json", files.write_json, _round_ground),
    _EstimateFile("depth_m.npy", files.write_map, lambda estimate, _: estimate.depth_m),
    # 16 bits, metres x 256.
    _EstimateFile("depth.png", files.write_depth_png, lambda estimate, _: estimate.depth_m),
    _EstimateFile("confidence.npy", files.write_map, lambda estimate, _: estimate.confidence),
    # The synthesised right view.
    _EstimateFile("right.png", files.write_image, lambda estimate, _: estimate.right),
    _EstimateFile("sky.png", files.write_image, _draw_sky),
    _EstimateFile("color.png", files.write_image, _draw_colors),
    # In pixels of the frame's own rig.
    _EstimateFile(LAST, files.write_map, lambda estimate, _: estimate.disparity_px),
)
"""The files of an estimate, in the order in which they are written."""
ENDINGS = tuple(file.ending for file in _FILES)
"""What follows ``NAME.`` in the names of the files of an estimate."""


def write_estimate(
    folder: Path,
    pair: StereoInput,
    estimate: DepthEstimate,
    range_m: tuple[float, float] = COLOR_RANGE_M,
    cloud_m: float | None = None,
    min_confidence: float | None = None,
) -> list[Path]:
    """Write the files of one estimate, and return their paths; the disparity comes last.

    They are called ``NAME.ENDING``, with the ``ENDINGS`` of what the estimate has.

    Args:
        folder: folder of the files.
        pair: the input; its name is ``NAME``.
        estimate: what was estimated from it.
        range_m: depths of the first and the last colour.
        cloud_m: distance up to which a cloud (``DepthEstimate.cloud``) has points; None: no cloud.
        min_confidence: least confidence of the cloud's points.
    """
    options = _FileOptions(range_m=range_m, cloud_m=cloud_m, min_confidence=min_confidence)
    estimate = replace(estimate, input=pair)  # which colours the cloud
    written: list[Path] = []
    for file in _FILES:
        content = file.content(estimate, options)
        if content is not None:
            path = folder / f"{pair.name}.{file.ending}"
            file.write(path, content)
            written.append(path)
    return written


def is_finished(folder: Path, name: str, *, with_cloud: bool = False) -> bool:
    """Whether an earlier run wrote the whole estimate of this frame.

    ``with_cloud``: only an estimate with a cloud counts.
    """
    needed = (LAST, CLOUD) if with_cloud else (LAST,)
    return is_whole(folder, name, [f"{name}.{ending}" for ending in needed])


def has_prediction(folder: Path, name: str, *, of_disparity: bool = False) -> bool:
    """Whether the folder holds a prediction of this frame.

    ``of_disparity``: only files whose names say that they hold disparity count.
    """
    endings = _DISPARITY if of_disparity else (*_DISPARITY, *_DEPTH, _KITTI)
    return _find_file(folder / name, endings) is not None


def read_disparity(
    folder: Path, name: str, camera: Camera | None, *, with_disparity_png: bool = False
) -> Map:
    """Read one predicted disparity, of ours or of another method [px of the map's own width].

    ``NAME.disparity_px.npy`` (or ``.pfm``) comes first; without it, the depth that
    :func:`read_depth` reads is converted by the rig. A pixel without a prediction is NaN. Depth of
    zero or below is a prediction too, and becomes the smallest depth of the protocol, as in the
    published script.

    Args:
        folder: folder of the predictions.
        name: name of the frame.
        camera: camera of the frame.
        with_disparity_png: ``NAME.png`` is disparity x 256, else metres x 256.

    Raises:
        InputError: there is no file, or there is depth and no rig, or it is nearly all negative.
    """
    base = folder / name
    disparity_path = _find_file(base, _DISPARITY)
    if disparity_path is not None:
        return files.read_map(disparity_path)
    path = _find_file(base, (*_DEPTH, _KITTI))
    if path is None:
        raise InputError(
            f"{folder}: no prediction for frame {name!r}. Expected {EXPECTED.replace('NAME', name)}"
        )
    if with_disparity_png and path == _find_file(base, (_KITTI,)):
        return files.read_depth_png(path)

    # Depth, as disparity of the rig.
    depth_m = read_depth(folder, name)
    assert depth_m is not None
    if not isinstance(camera, StereoRig):
        raise InputError(f"{path}: depth becomes disparity by a rig, and this frame has none.")
    return disparity_of_predicted_depth(depth_m, camera, str(path))


def disparity_of_predicted_depth(depth_m: Map, rig: StereoRig, source: str) -> Map:
    """Convert a predicted depth to disparity [px of the map's own width].

    ``source``: file or frame of the depth, for errors.

    Raises:
        InputError: nearly all of it is negative.
    """
    if float((depth_m < 0).float().mean()) > _NEARLY_ALL:
        raise InputError(f"{source}: its depth is negative; save metres in front of the camera")
    positive_m = depth_m.clamp(min=SMALLEST_DEPTH_M)
    # A map of another size than the image has its disparity in its own pixels.
    return disparity_from_depth(positive_m, rig) * (depth_m.shape[1] / rig.width)


def read_depth(folder: Path, name: str) -> Map | None:
    """Read one predicted depth [m at its own size]; None where there is no file of depth.

    ``NAME.depth_m.npy`` or ``.pfm`` comes before ``NAME.depth.png`` and ``NAME.png``.
    """
    path = _find_file(folder / name, (*_DEPTH, _KITTI))
    if path is None:
        return None
    is_png = path.suffix.lower() == ".png"
    return files.read_depth_png(path) if is_png else files.read_map(path)


def _find_file(base: Path, endings: tuple[str, ...]) -> Path | None:
    """Find the first file ``BASE.ENDING`` that exists; its suffix may be in capital letters."""
    for ending in endings:
        file = base.with_name(f"{base.name}.{ending}")
        for path in (file, file.with_suffix(file.suffix.upper())):
            if path.is_file():
                return path
    return None


def read_part(folder: Path, name: str, ending: str) -> Float[Tensor, "*c h w"] | None:
    """Read the map or picture ``NAME.ENDING`` of a prediction; None where there is none."""
    path = _find_file(folder / name, (ending,))
    if path is None:
        return None
    is_png = path.suffix.lower() == ".png"
    return files.read_image(path) if is_png else files.read_map(path)


def read_estimate(folder: Path, name: str, camera: Camera | None) -> DepthEstimate:
    """Read an estimate that :func:`write_estimate` wrote, without its input.

    ``camera`` of the frame makes depth of the disparity where no depth was written.

    Raises:
        InputError: there is no prediction of that name, or a file of it is damaged.
    """
    disparity_px = read_part(folder, name, LAST)
    if disparity_px is None:
        raise InputError(f"{folder}: no prediction for frame {name!r}; predict it again")
    warning_path = _find_file(folder / name, ("warning.txt",))
    sky = read_part(folder, name, "sky.png")
    depth_m = read_part(folder, name, "depth_m.npy")
    if depth_m is None and isinstance(camera, StereoRig):
        depth_m = depth_from_disparity(disparity_px, camera)
    return DepthEstimate(
        depth_m=depth_m,
        disparity_px=disparity_px,
        confidence=read_part(folder, name, "confidence.npy"),
        right=read_part(folder, name, "right.png"),
        is_sky=None if sky is None else sky[0] > 0,
        ground=read_ground(folder, name),
        warning="" if warning_path is None else read_text(warning_path).strip(),
    )


def read_ground(folder: Path, name: str) -> Ground | None:
    """Read the road of an estimate; None where it has none.

    Raises:
        InputError: the file is damaged.
    """
    path = _find_file(folder / name, ("ground.json",))
    if path is None:
        return None
    content = files.read_json(path)
    if not isinstance(content, dict):
        kind = type(content).__name__
        raise InputError(f"{path}: holds no ground, but {kind}; predict again")
    return config_from_dict(content, Ground, source=str(path))


@dataclass(frozen=True, kw_only=True)
class DepthResults(Results[StereoInput, DepthEstimate]):
    """Results of a run of estimates: files of one folder, as :func:`write_estimate` names them."""

    folder: Path  #: claimed before (:func:`depthpose.core.run_folder.claim_folder`)
    range_m: tuple[float, float] = COLOR_RANGE_M
    cloud_m: float | None = None  #: None: no cloud is written
    min_confidence: float | None = None  #: least confidence of a cloud's points

    def is_finished(self, job: Job[StereoInput]) -> bool:
        """Whether an earlier run wrote the whole estimate, with a cloud if there shall be one."""
        return is_finished(self.folder, job.name, with_cloud=self.cloud_m is not None)

    def store(self, job: Job[StereoInput], data: StereoInput, result: DepthEstimate) -> None:
        """Write the files of an estimate, and record that it is finished."""
        written = write_estimate(
            self.folder, data, result, self.range_m, self.cloud_m, self.min_confidence
        )
        note_result(self.folder, job.name, written)


def estimate_missing_depth(
    net: Estimator,
    jobs: Sequence[Job[StereoInput]],
    folder: Path,
    settings: dict[str, Any],
    sources: Mapping[str, Path | Sequence[Path]],
) -> Iterator[str]:
    """Estimate and write the frames that are not finished yet, one by one, and yield their names.

    Args:
        net: the estimator.
        jobs: the frames of this process.
        folder: where the files go; refused if other settings or images made the files in it.
        settings: all settings that the results depend on.
        sources: the files behind each name, the image first, of all processes that write to the
            folder.

    Raises:
        InputError: an input cannot be read or estimated.
    """
    names = (f"{job.name}.{ending}" for job in jobs for ending in ENDINGS)
    claim_folder(folder, settings, names)
    claim_names(folder, sources, is_finished=partial(is_finished, folder))

    def estimate_many(pairs: Sequence[StereoInput]) -> list[DepthEstimate]:
        return [net.estimate_input(pair) for pair in pairs]

    for outcome in run_jobs(jobs, estimate_many, DepthResults(folder=folder)):
        if outcome.failure is not None:
            raise outcome.failure
        yield outcome.job.name
