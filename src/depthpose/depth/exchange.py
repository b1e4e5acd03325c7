"""Predicted depth as other tools keep it: COLMAP's dense workspace, nerfstudio's data sets.

COLMAP's maps are those of its dense reconstruction (``stereo/depth_maps``).
"""

from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from depthpose.core.errors import InputError
from depthpose.core.files import read_json, read_map, write_depth_png, write_map
from depthpose.core.files.disk import AnyPath, write_bytes
from depthpose.core.run import read_sources
from depthpose.depth.types import Map

NERFSTUDIO_UNIT = 0.001
"""What nerfstudio multiplies depth files of either kind by, by default."""
TRANSFORMS, TRANSFORMS_DEPTH = "transforms.json", "transforms_depth.json"
_DEPTH = ".depth_m.npy"


def read_predicted(results: Path) -> dict[str, Callable[[], Map]]:
    """Give readers of depth [m], NaN where unknown, of the frames of a folder of predictions."""
    names = sorted(path.name.removesuffix(_DEPTH) for path in results.glob(f"*{_DEPTH}"))
    if not names:
        raise InputError(
            f"{results}: no NAME{_DEPTH} in it; give a folder that 'depth predict' or 'depth "
            "match' wrote, with a camera"
        )

    def read(name: str) -> Map:
        depth_m = read_map(results / f"{name}{_DEPTH}")
        return torch.where(depth_m > 0, depth_m, torch.nan)

    return {name: partial(read, name) for name in names}


def colmap_files(results: Path, names: Iterable[str], images: Path | None = None) -> dict[str, str]:
    """Say where in COLMAP's workspace the depth of each frame belongs.

    COLMAP calls a map by its image, suffix and all: ``stereo/depth_maps/a.jpg.geometric.bin``.
    """
    sources = read_sources(results)
    files = {}
    for name in names:
        image = sources.get(name, Path(f"{name}.png"))
        if images is None:
            inside = Path(image.name)
        elif image.is_relative_to(images.resolve()):
            inside = image.relative_to(images.resolve())
        else:
            raise InputError(f"{image}: does not lie in --images {images}; name their folder")
        files[name] = f"stereo/depth_maps/{inside.as_posix()}.geometric.bin"
    return files


def nerfstudio_frames(out: Path, files: Mapping[str, str]) -> dict[str, Any] | None:
    """Give ``transforms.json`` of a data set with the depth of each frame; None where it has none.

    Raises:
        InputError: it lists no frames, or one without a prediction: nerfstudio takes depth for
            all frames or for none.
    """
    path = out / TRANSFORMS
    if not path.exists():
        return None
    content = read_json(path)
    frames = content.get("frames") if isinstance(content, dict) else None
    is_list = isinstance(frames, list) and all(isinstance(f, dict) for f in frames)
    if not isinstance(content, dict) or not is_list:
        raise InputError(f"{path}: has no list of 'frames'; give one that ns-process-data wrote")
    given = []
    for frame in frames or ():
        name = Path(str(frame.get("file_path", ""))).stem
        if name not in files:
            raise InputError(
                f"{path}: frame {name!r} has no prediction, and nerfstudio takes depth for all "
                f"frames or for none; predict it too. There are {', '.join(list(files)[:3])}, ..."
            )
        given.append({**frame, "depth_file_path": files[name]})
    return {**content, "frames": given, "depth_unit_scale_factor": NERFSTUDIO_UNIT}


def write_nerfstudio_map(path: Path, depth: Map) -> int:
    """Write depth in thousandths, and give how many pixels a PNG, up to 65.535 units, lost."""
    if path.suffix == ".png":
        write_depth_png(path, depth, NERFSTUDIO_UNIT)
        return int((depth > 65535 * NERFSTUDIO_UNIT).sum())
    write_map(path, depth.nan_to_num(0.0) / NERFSTUDIO_UNIT)
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
