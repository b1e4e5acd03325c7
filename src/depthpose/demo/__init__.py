"""The page of ``depthpose demo``: synthetic parts posed, a street and a real pair matched."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from depthpose.core.run import claim_folder, environment
from depthpose.demo.depth import show_depth
from depthpose.demo.pose import show_poses
from depthpose.report.tables import table_files, write_page, write_table

_PAGE = "report.html"
_FOLDERS = (
    "street", "motorcycle", "selecting-generator", "stereo-network", "sgbm-holes-filled",
    "part", "parts", "geo-posenet",
)  # fmt: skip


@dataclass(frozen=True)
class DemoResult:
    """Where the page is, and the rows on it: a depth for each method, a pose for each part."""

    page: Path
    depths: list[dict[str, Any]]
    poses: list[dict[str, Any]]


def make_demo(
    out: Path,
    weights: str | Path = "default",
    parts: str | Path = "parts",
    scale: float = 1.0,
    on_message: Callable[[str], None] | None = None,
) -> DemoResult:
    """Pose synthetic parts on a table; estimate depth of a real pair and a synthetic street.

    Args:
        out: folder for the data, the estimates, the tables and the page ``report.html``.
        weights: of the depth networks, by name or file.
        parts: weights of a pose network for the parts, by name or file.
        scale: size of the street's images as a share of KITTI's.
        on_message: called with what is done next.

    Raises:
        InputError: ``out`` holds files that the demo did not write and would replace.
    """
    claim_folder(out, {"command": "demo"}, [*_FOLDERS, *table_files("depths", "poses"), _PAGE])
    on_message = on_message or (lambda _: None)
    on_message("synthetic parts on a table are posed from a depth image ...")
    poses, of_pose = show_poses(out, parts)
    on_message("depth of a real pair and of a synthetic street ...")
    depths, of_depth = show_depth(out, weights, scale)
    write_table(out, depths, name="depths")
    write_table(out, poses, name="poses")
    page = out / _PAGE
    title = "depthpose: a depth sensor to poses, images to metric depth"
    write_page(page, title, [*of_pose, *of_depth], environment())
    return DemoResult(page, depths, poses)
