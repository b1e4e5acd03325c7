"""Estimates as files of a folder: writing them, and reading ours or those of other methods."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

from jaxtyping import Float
from torch import Tensor

from depthpose.core import files
from depthpose.core.camera import Camera, StereoRig
from depthpose.core.config import config_from_dict
from depthpose.core.draw import draw_depth, draw_disparity
from depthpose.core.errors import InputError
from depthpose.core.files.disk import read_text, write_bytes
from depthpose.core.run_folder import claim_folder, claim_names, is_result_finished, note_result
from depthpose.core.runner import Job, Results, run_jobs
from depthpose.depth.config import COLOR_RANGE_M
from depthpose.depth.disparity import depth_from_disparity, disparity_from_depth
from depthpose.depth.metrics import SMALLEST_DEPTH_M
from depthpose.depth.types import DepthEstimate, DepthInput, Estimator, Ground, Map

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


ENDINGS = (
    CLOUD,
    "warning.txt",
    "ground.json",
    "depth_m.npy",
    "depth.png",  # 16 bits, metres x 256
    "confidence.npy",
    "right.png",  # the synthesised right view
    "sky.png",
    "color.png",
    LAST,  # in pixels of the frame's own rig
)
"""What follows ``NAME.`` in the names of the files of an estimate, in the order of writing."""


@dataclass(frozen=True, kw_only=True)
class OutputOptions:
    """What the files of an estimate show."""

    range_m: tuple[float, float] = COLOR_RANGE_M  #: depths of the first and the last colour
    #: distance up to which a cloud (``DepthEstimate.cloud``) has points; None: no cloud is written
    cloud_m: float | None = None
    min_confidence: float | None = None  #: least confidence of the cloud's points


def write_estimate(
    folder: Path, estimate: DepthEstimate, options: OutputOptions | None = None
) -> list[Path]:
    """Write the files of one estimate, and return their paths; the disparity comes last.

    They are called ``NAME.ENDING``, with the name of its input and the ``ENDINGS`` of what the
    estimate has.
    """
    options = options or OutputOptions()
    depth_m = estimate.depth_m
    if depth_m is None:
        color = draw_disparity(estimate.disparity_px, is_sky=estimate.is_sky)
    else:
        color = draw_depth(depth_m, *options.range_m)
    written: list[Path] = []

    def write(ending: str, writer: Callable[[Path, Any], None], content: object) -> None:
        path = folder / f"{estimate.input.name}.{ending}"
        writer(path, content)
        written.append(path)

    if options.cloud_m is not None:
        cloud = estimate.cloud(options.cloud_m, options.min_confidence)
        write(CLOUD, files.write_cloud, cloud)
    if estimate.warning:
        write("warning.txt", write_bytes, f"{estimate.warning}\n".encode())
    if estimate.ground is not None:
        write("ground.json", files.write_json, _round_ground(estimate.ground))
    if depth_m is not None:
        write("depth_m.npy", files.write_map, depth_m)
        write("depth.png", files.write_depth_png, depth_m)
    if estimate.confidence is not None:
        write("confidence.npy", files.write_map, estimate.confidence)
    if estimate.right is not None:
        write("right.png", files.write_image, estimate.right)
    if estimate.is_sky is not None:
        write("sky.png", files.write_image, estimate.is_sky.float().expand(3, -1, -1))
    write("color.png", files.write_image, color)
    write(LAST, files.write_map, estimate.disparity_px)
    return written


def _round_ground(ground: Ground) -> dict[str, float]:
    """Round the values of a road, by name, to digits that every run repeats."""
    return {name: round(value, _DECIMALS) for name, value in asdict(ground).items()}


def is_finished(folder: Path, name: str, *, with_cloud: bool = False) -> bool:
    """Whether an earlier run wrote the whole estimate of this frame.

    ``with_cloud``: only an estimate with a cloud counts.
    """
    needed = (LAST, CLOUD) if with_cloud else (LAST,)
    return is_result_finished(folder, name, [f"{name}.{ending}" for ending in needed])


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


def read_estimate(folder: Path, depth_input: DepthInput) -> DepthEstimate:
    """Read the estimate of an input that :func:`write_estimate` wrote.

    A rig of the input makes depth of the disparity where no depth was written.

    Raises:
        InputError: there is no prediction of its name, or a file of it is damaged.
    """
    name = depth_input.name
    disparity_px = read_part(folder, name, LAST)
    if disparity_px is None:
        raise InputError(f"{folder}: no prediction for frame {name!r}; predict it again")
    warning_path = _find_file(folder / name, ("warning.txt",))
    sky = read_part(folder, name, "sky.png")
    depth_m = read_part(folder, name, "depth_m.npy")
    if depth_m is None and isinstance(depth_input.camera, StereoRig):
        depth_m = depth_from_disparity(disparity_px, depth_input.camera)
    return DepthEstimate(
        input=depth_input,
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
class DepthResults(Results[DepthInput, DepthEstimate]):
    """Results of a run of estimates: files of one folder, as :func:`write_estimate` names them."""

    folder: Path  #: claimed before (:func:`depthpose.core.run_folder.claim_folder`)
    options: OutputOptions = OutputOptions()

    def is_finished(self, job: Job[DepthInput]) -> bool:
        """Whether an earlier run wrote the whole estimate, with a cloud if there shall be one."""
        return is_finished(self.folder, job.name, with_cloud=self.options.cloud_m is not None)

    def store(self, job: Job[DepthInput], result: DepthEstimate) -> None:
        """Write the files of an estimate, and record that it is finished."""
        written = write_estimate(self.folder, result, self.options)
        note_result(self.folder, job.name, written)


def estimate_missing_depth(
    net: Estimator,
    jobs: Sequence[Job[DepthInput]],
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

    def estimate_many(pairs: Sequence[DepthInput]) -> list[DepthEstimate]:
        return [net.estimate_input(pair) for pair in pairs]

    for outcome in run_jobs(jobs, estimate_many, DepthResults(folder=folder)):
        if outcome.failure is not None:
            raise outcome.failure
        yield outcome.job.name
