"""``depthpose data export-depth``."""

import math
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Literal

import tyro

from depthpose.core.errors import InputError


def export_depth(
    results: tyro.conf.Positional[Path],
    format: Literal["colmap", "nerfstudio"],
    out: Path,
    files: Literal["png", "npy"] = "png",
    images: Path | None = None,
    scale: float = 1.0,
) -> int:
    """Write depth of 'depth predict' or 'depth match' where COLMAP or nerfstudio look for it.

    colmap: OUT/stereo/depth_maps/IMAGE.geometric.bin; OUT is a dense workspace. COLMAP's
    stereo_fusion wants normal maps too, which are not written.
    nerfstudio: OUT/depths/NAME.png or .npy in millimetres, 0 where nothing is known. Where OUT
    holds transforms.json, transforms_depth.json is written beside it, with depth_file_path of
    each frame: ns-train depth-nerfacto --data OUT/transforms_depth.json.

    A reconstruction from images alone has a scale of its own, and depth is in metres: --scale says
    how many of its units a metre is.

        depthpose data export-depth out --format colmap --out dense
        depthpose data export-depth out --format nerfstudio --files npy --out data

    Args:
        results: folder of predictions.
        format: whose files.
        out: folder to write to: COLMAP's dense workspace, or nerfstudio's data set.
        files: of nerfstudio: png holds 65.535 m at most, what is farther becomes unknown; npy all.
        images: of colmap: the folder that its names of images count from, if not each one's own.
        scale: units of the reconstruction a metre.
    """
    from depthpose.core.run import claim_folder
    from depthpose.depth import exchange

    if not (math.isfinite(scale) and scale > 0):
        raise InputError(f"--scale {scale:g}: units a metre are positive; 1 where metres are meant")
    if images is not None and format != "colmap":
        raise InputError(f"--images {images} is for --format colmap; leave it away")
    settings = {"command": "data export-depth", "results": str(results.resolve()), "scale": scale}
    if format == "colmap":
        named = exchange.colmap_files(results, images)
        claim_folder(out, {**settings, "format": format}, named.values())
        _count(exchange.write_colmap(results, out, named, scale), len(named))
        print(f"{out}: depth of {len(named)} images in stereo/depth_maps")
        return 0
    named = exchange.nerfstudio_files(results, files)
    told = exchange.nerfstudio_frames(out, named)
    own = {**settings, "format": format, "files": files}
    claim_folder(out, own, [*named.values(), exchange.TRANSFORMS_DEPTH])
    lost = sum(_count(exchange.write_nerfstudio(results, out, named, scale), len(named)))
    if told is not None:
        exchange.write_transforms(out, told)
    _say_nerfstudio(out, len(named), lost, is_told=told is not None)
    return 0


def _count(written: "Iterable[Any]", total: int) -> list[Any]:
    from tqdm import tqdm

    return list(tqdm(written, total=total, unit=" frames", leave=False, disable=None))


def _say_nerfstudio(out: Path, frames: int, lost: int, *, is_told: bool) -> None:
    beside = "transforms_depth.json names them" if is_told else "no transforms.json lies there"
    print(f"{out}: depth of {frames} frames in depths; {beside}")
    if lost:
        print(
            f"depthpose: {lost} pixels are beyond 65.535 m, which a PNG cannot hold, and are "
            "unknown there; --files npy keeps them",
            file=sys.stderr,
        )
