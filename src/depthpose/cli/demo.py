"""``depthpose demo``."""

from pathlib import Path


def demo(out: Path = Path("out/demo"), weights: Path | None = None) -> int:
    """Match a made street whose disparity is known exactly, and write a page about it.

    Needs no network and no data. OpenCV's StereoSGBM matches the pair; PSMNet does too where its
    weights are given.

    Args:
        out: folder for the pictures, the maps and report.html.
        weights: PSMNet weights (.safetensors) to match with as well.
    """
    from depthpose.core.report import markdown_table
    from depthpose.demo import make_demo

    result = make_demo(out, weights)
    print(markdown_table(result.rows))
    print(f"The page: {result.page}")
    return 0
