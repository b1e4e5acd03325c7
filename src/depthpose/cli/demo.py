"""``depthpose demo``."""

from pathlib import Path


def demo(
    out: Path = Path("out/demo"), weights: str = "default", pose_weights: str = "parts"
) -> int:
    """Estimate depth of a street and of a real pair, and poses of parts; write a page about it.

    Needs no network and no data. The street's depth is known exactly: it is estimated from one
    image and from both, beside OpenCV's StereoSGBM. The real pair comes with scikit-image (the
    extra 'demo'); without it the page shows the street alone. Five made parts on a table are posed
    from a depth image.

    Args:
        out: folder for the pictures, the maps, the poses and report.html.
        weights: of the depth networks, by name or file ('depthpose weights list').
        pose_weights: of a pose network that knows made parts, by name or file.
    """
    from depthpose.core.report import markdown_table
    from depthpose.demo import make_demo

    result = make_demo(out, weights, pose_weights)
    print(markdown_table(result.depths))
    print(markdown_table(result.poses))
    print(f"The page: {result.page}")
    return 0
