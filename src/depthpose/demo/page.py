"""The demo's work: both halves estimated, measured, and put on a page."""

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
    "street", "motorcycle", "fakestereo-net-compact", "psmnet-compact", "sgbm-holes-filled",
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
    tell: Callable[[str], None] | None = None,
) -> DemoResult:
    """Estimate the poses of made parts on a table, and depth of a real pair and a made street.

    Args:
        out: folder for the data, the estimates, the tables and the page ``report.html``.
        weights: of the depth room, by name or file.
        parts: of the pose room, by name or file; they know made parts.
        scale: size of the street's images as a share of KITTI's.
        tell: told what is done next.

    Raises:
        InputError: ``out`` holds files of somebody else that would be written over.
    """
    claim_folder(out, {"command": "demo"}, [*_FOLDERS, *table_files("depths", "poses"), _PAGE])
    tell = tell or (lambda _: None)
    tell("made parts on a table are posed from a depth image ...")
    poses, of_pose = show_poses(out, parts)
    tell("depth of a real pair and of a made street ...")
    depths, of_depth = show_depth(out, weights, scale)
    write_table(out, depths, name="depths")
    write_table(out, poses, name="poses")
    page = out / _PAGE
    title = "depthpose: a depth sensor to poses, images to metric depth"
    write_page(page, title, [*of_pose, *of_depth], environment())
    return DemoResult(page, depths, poses)
