"""``depthpose demo``."""

from pathlib import Path

from depthpose.cli.arguments import NewPath, WeightsName

_POSE_COLUMNS = (
    "object",
    "status",
    "copies",
    "error_mm",
    "of_diameter",
    "rotation_deg",
    "translation_mm",
)
_DEPTH_COLUMNS = ("scene", "method", "input", "abs_rel", "rmse", "d1", "epe_px")
"""Columns that are printed; the page and the files hold all."""


def demo(
    out: NewPath = Path("out/demo"),
    weights: WeightsName = "default",
    pose_weights: WeightsName = "parts",
) -> int:
    """Pose synthetic parts, estimate depth of a real pair and of a street; write a page about it.

    Needs no network and no data. Five synthetic parts on a table are posed from a depth image. The
    depth of a synthetic street is estimated from both images and from one, and compared with the
    truth and with OpenCV's StereoSGBM. The real pair comes with scikit-image (the extra 'demo').

    Args:
        out: folder for pictures, maps, poses and report.html.
        weights: weights of the depth networks, by name or file ('depthpose weights list').
        pose_weights: weights of a pose network for these parts, by name or file.
    """
    from functools import partial

    from depthpose.demo import make_demo
    from depthpose.report.page import format_plain_table

    result = make_demo(out, weights, pose_weights, on_message=partial(print, flush=True))
    print(format_plain_table(result.poses, _POSE_COLUMNS))
    print(format_plain_table(result.depths, _DEPTH_COLUMNS))
    print(f"The page: {result.page}")
    return 0
