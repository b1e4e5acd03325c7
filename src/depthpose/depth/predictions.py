"""Estimates as files: writing them all or nothing, reading them back, and as other tools keep them.

These are COLMAP's dense workspace (``stereo/depth_maps``) and nerfstudio's data sets.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from depthpose.core import files
from depthpose.core.camera import Camera, StereoRig
from depthpose.core.config import config_from_dict
from depthpose.core.draw import draw_depth, draw_disparity
from depthpose.core.errors import InputError
from depthpose.core.files.disk import AnyPath, write_bytes
from depthpose.core.files.text import read_text
from depthpose.core.run import claim_folder, claim_names, is_whole, note_result, read_sources
from depthpose.depth.disparity import depth_from_disparity, disparity_from_depth
from depthpose.depth.metrics import SMALLEST_DEPTH_M
from depthpose.depth.types import DepthEstimate, Ground, Map, StereoInput


@runtime_checkable
class Estimator(Protocol):
    """What predicts: :class:`FakestereoNet`, a baseline, or anybody's."""

    def estimate_pair(self, pair: StereoInput, /) -> DepthEstimate:
        """Estimate depth of one input whose images are read already."""
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
CLOUD = "cloud.ply"
ENDINGS = (
    "depth_m.npy", "depth.png", "confidence.npy", "right.png", "sky.png", "color.png",
    "disparity_px.npy", "warning.txt", "ground.json", CLOUD,
)  # fmt: skip
"""What follows ``NAME.`` in the names of the files of an estimate."""

CLOUD_M = 80.0
"""Distance up to which a cloud is written, unless another is given."""
COLOR_RANGE_M = (3.0, 80.0)
"""Near and far end of the colours of depth, one for all pictures, so that they compare."""


def write_estimate(
    folder: Path,
    pair: StereoInput,
    estimate: DepthEstimate,
    range_m: tuple[float, float] = COLOR_RANGE_M,
    cloud_m: float | None = None,
) -> list[Path]:
    """Write the files of one estimate, and give them; the disparity comes last.

    ``NAME.depth_m.npy``, ``NAME.depth.png`` (uint16, metres x 256), ``NAME.confidence.npy``,
    ``NAME.color.png``, ``NAME.right.png`` (synthesised), ``NAME.sky.png`` (8 bit, 255 in the sky),
    ``NAME.ground.json`` (:class:`~depthpose.depth.types.Ground`), ``NAME.warning.txt`` and
    ``NAME.disparity_px.npy``, each where the estimate has it, and ``NAME.cloud.ply``
    (``DepthEstimate.cloud``) of what is nearer than ``cloud_m``, if that is given. The disparity is
    that of the frame's own rig.
    """
    written: list[Path] = []

    def new(ending: str) -> Path:
        written.append(folder / f"{pair.name}.{ending}")
        return written[-1]

    if cloud_m is not None:
        files.write_cloud(new(CLOUD), replace(estimate, seen=pair).cloud(cloud_m))
    if estimate.warning:
        write_bytes(new("warning.txt"), f"{estimate.warning}\n".encode())
    if estimate.ground is not None:
        files.write_json(new("ground.json"), asdict(estimate.ground))
    if estimate.depth_m is not None:
        files.write_map(new("depth_m.npy"), estimate.depth_m)
        files.write_depth_png(new("depth.png"), estimate.depth_m)
    if estimate.confidence is not None:
        files.write_map(new("confidence.npy"), estimate.confidence)
    if estimate.right is not None:
        files.write_image(new("right.png"), estimate.right)
    if estimate.is_sky is not None:
        files.write_image(new("sky.png"), estimate.is_sky.float().expand(3, -1, -1))
    picture = (
        draw_disparity(estimate.disparity_px, is_sky=estimate.is_sky)
        if estimate.depth_m is None
        else draw_depth(estimate.depth_m, *range_m)
    )
    files.write_image(new("color.png"), picture)
    files.write_map(new("disparity_px.npy"), estimate.disparity_px)
    return written


def is_finished(folder: Path, name: str, *, with_cloud: bool = False) -> bool:
    """Whether an earlier run left the estimate of this frame whole, and its cloud if wanted."""
    endings = ("disparity_px.npy", CLOUD) if with_cloud else ("disparity_px.npy",)
    return is_whole(folder, name, [f"{name}.{ending}" for ending in endings])


def has_prediction(folder: Path, name: str, *, of_disparity: bool = False) -> bool:
    """Whether the folder holds a prediction of this frame, or one of disparity by its name."""
    endings = _DISPARITY if of_disparity else (*_DISPARITY, *_DEPTH, _KITTI)
    return _first(folder / name, endings) is not None


def read_disparity(
    folder: Path, name: str, camera: Camera | None, *, with_disparity_png: bool = False
) -> Map:
    """Read one predicted disparity [px at its own width], ours or anybody's.

    ``NAME.disparity_px.npy`` (or ``.pfm``) is taken first; what :func:`read_depth` finds is turned
    into disparity by the rig. NaN alone says that there is no answer: depth of zero or below is
    the smallest of the protocol, as the published script takes it.

    Args:
        folder: of the predictions.
        name: of the frame.
        camera: of the frame.
        with_disparity_png: ``NAME.png`` is disparity x 256, else metres x 256.

    Raises:
        InputError: no file is there, or depth without a rig.
    """
    base = folder / name
    if (path := _first(base, _DISPARITY)) is not None:
        return files.read_map(path)
    path = _first(base, (*_DEPTH, _KITTI))
    if path is None:
        raise InputError(
            f"{folder}: no prediction for frame {name!r}. Expected {EXPECTED.replace('NAME', name)}"
        )
    if with_disparity_png and path == _first(base, (_KITTI,)):
        return files.read_disparity_png(path)
    depth_m = read_depth(folder, name)
    assert depth_m is not None
    if not isinstance(camera, StereoRig):
        raise InputError(f"{path}: depth becomes disparity by a rig, and this frame has none.")
    if float((depth_m < 0).float().mean()) > _NEARLY_ALL:
        raise InputError(f"{path}: its depth is negative; save metres in front of the camera")
    # The map may have a size of its own: its disparity is counted in its own pixels.
    least_m = depth_m.clamp(min=SMALLEST_DEPTH_M)
    return disparity_from_depth(least_m, camera) * (depth_m.shape[1] / camera.width)


def read_depth(folder: Path, name: str) -> Map | None:
    """Read one predicted depth [m at its own size]; None where there is no file of depth.

    ``NAME.depth_m.npy`` or ``.pfm`` comes before ``NAME.depth.png`` and ``NAME.png``.
    """
    path = _first(folder / name, (*_DEPTH, _KITTI))
    if path is None:
        return None
    return files.read_depth_png(path) if path.suffix.lower() == ".png" else files.read_map(path)


def _first(base: Path, endings: tuple[str, ...]) -> Path | None:
    named = (base.with_name(f"{base.name}.{end}") for end in endings)
    both = (path for file in named for path in (file, file.with_suffix(file.suffix.upper())))
    return next((path for path in both if path.is_file()), None)


def read_part(folder: Path, name: str, ending: str) -> Float[Tensor, "*c h w"] | None:
    """Read a map or a picture of ``ENDINGS``; None where the prediction has none."""
    path = _first(folder / name, (ending,))
    if path is None:
        return None
    return files.read_image(path) if path.suffix.lower() == ".png" else files.read_map(path)


def read_estimate(folder: Path, name: str, camera: Camera | None) -> DepthEstimate:
    """Read back what :func:`write_estimate` wrote.

    Raises:
        InputError: there is no prediction of that name, or a file of it is damaged.
    """
    disparity_px = read_disparity(folder, name, camera)
    warning, ground = (_first(folder / name, (end,)) for end in ("warning.txt", "ground.json"))
    metres, sky = (read_part(folder, name, end) for end in ("depth_m.npy", "sky.png"))
    if metres is None and isinstance(camera, StereoRig):
        metres = depth_from_disparity(disparity_px, camera)
    plane = None
    if ground is not None:
        content = files.read_json(ground)
        if not isinstance(content, dict):
            kind = type(content).__name__
            raise InputError(f"{ground}: holds no ground, but {kind}; predict again")
        plane = config_from_dict(content, Ground, source=str(ground))
    return DepthEstimate(
        depth_m=metres,
        disparity_px=disparity_px,
        confidence=read_part(folder, name, "confidence.npy"),
        right=read_part(folder, name, "right.png"),
        is_sky=None if sky is None else sky[0] > 0,
        ground=plane,
        warning="" if warning is None else read_text(warning).strip(),
    )


def predict(
    net: Estimator,
    inputs: Mapping[str, Callable[[], StereoInput]],
    folder: Path,
    settings: dict[str, Any],
    sources: Mapping[str, Path | Sequence[Path]],
) -> Iterable[str]:
    """Estimate what is not finished yet, one frame at a time, and yield each name.

    Args:
        net: the estimator.
        inputs: readers of the inputs by name, called only for unfinished frames.
        folder: where the files go; refused if other settings or images made what it holds.
        settings: what decides the results.
        sources: the files behind each name, the image first, of all processes that write to the
            folder.
    """
    claim_folder(folder, settings, (f"{name}.{end}" for name in inputs for end in ENDINGS))
    claim_names(folder, sources, is_finished=partial(is_finished, folder))
    for name, read_input in inputs.items():
        if not is_finished(folder, name):
            pair = read_input()
            note_result(folder, name, write_estimate(folder, pair, net.estimate_pair(pair)))
        yield name


NERFSTUDIO_UNIT = 0.001
"""What nerfstudio multiplies depth files of either kind by, by default."""
TRANSFORMS, TRANSFORMS_DEPTH = "transforms.json", "transforms_depth.json"
_METRES = ".depth_m.npy"


def read_predicted(results: Path) -> dict[str, Callable[[], Map]]:
    """Give readers of depth [m], NaN where unknown, of the frames of a folder of predictions."""
    names = sorted(path.name.removesuffix(_METRES) for path in results.glob(f"*{_METRES}"))
    if not names:
        raise InputError(
            f"{results}: no NAME{_METRES} in it; give a folder that 'depth predict' or 'depth "
            "match' wrote, with a camera"
        )

    def read(name: str) -> Map:
        depth_m = files.read_map(results / f"{name}{_METRES}")
        return torch.where(depth_m > 0, depth_m, torch.nan)

    return {name: partial(read, name) for name in names}


def colmap_files(results: Path, names: Iterable[str], images: Path | None = None) -> dict[str, str]:
    """Say where in COLMAP's workspace the depth of each frame belongs.

    COLMAP calls a map by its image, suffix and all: ``stereo/depth_maps/a.jpg.geometric.bin``.
    """
    sources = read_sources(results)
    places = {}
    for name in names:
        image = sources.get(name, Path(f"{name}.png"))
        if images is None:
            inside = Path(image.name)
        elif image.is_relative_to(images.resolve()):
            inside = image.relative_to(images.resolve())
        else:
            raise InputError(f"{image}: does not lie in --images {images}; name their folder")
        places[name] = f"stereo/depth_maps/{inside.as_posix()}.geometric.bin"
    return places


def nerfstudio_frames(out: Path, named: Mapping[str, str]) -> dict[str, Any] | None:
    """Give ``transforms.json`` of a data set with the depth of each frame; None where it has none.

    Raises:
        InputError: it lists no frames, or one without a prediction: nerfstudio takes depth for
            all frames or for none.
    """
    path = out / TRANSFORMS
    if not path.exists():
        return None
    content = files.read_json(path)
    frames = content.get("frames") if isinstance(content, dict) else None
    is_list = isinstance(frames, list) and all(isinstance(f, dict) for f in frames)
    if not isinstance(content, dict) or not is_list:
        raise InputError(f"{path}: has no list of 'frames'; give one that ns-process-data wrote")
    given = []
    for frame in frames or ():
        name = Path(str(frame.get("file_path", ""))).stem
        if name not in named:
            raise InputError(
                f"{path}: frame {name!r} has no prediction, and nerfstudio takes depth for all "
                f"frames or for none; predict it too. There are {', '.join(list(named)[:3])}, ..."
            )
        given.append({**frame, "depth_file_path": named[name]})
    return {**content, "frames": given, "depth_unit_scale_factor": NERFSTUDIO_UNIT}


def write_nerfstudio_map(path: Path, depth: Map) -> int:
    """Write depth in thousandths, and give how many pixels a PNG, up to 65.535 units, lost."""
    if path.suffix == ".png":
        files.write_depth_png(path, depth, NERFSTUDIO_UNIT)
        return int((depth > 65535 * NERFSTUDIO_UNIT).sum())
    files.write_map(path, depth.nan_to_num(0.0) / NERFSTUDIO_UNIT)
    return 0


def write_colmap_map(path: AnyPath, depth: Map) -> None:
    """Write a depth map; 0 where it is NaN.

    ``WIDTH&HEIGHT&CHANNELS&`` in text, then little-endian float32, columns fastest, as
    ``scripts/python/read_dense.py`` of COLMAP reads it.

    Args:
        path: ``stereo/depth_maps/IMAGE.geometric.bin``, IMAGE with its own suffix.
        depth: in the unit of the reconstruction, NaN where nothing is known.

    Raises:
        InputError: the map is empty or holds infinity, or the disk refuses.
    """
    rows = depth.detach().cpu().float().nan_to_num(0.0, torch.inf, -torch.inf).numpy()
    if rows.size == 0 or np.isinf(rows).any():
        raise InputError(f"{path}: the map is empty or holds infinity; mark invalid pixels by NaN")
    height, width = rows.shape
    write_bytes(path, f"{width}&{height}&1&".encode() + rows.astype("<f4").tobytes())
