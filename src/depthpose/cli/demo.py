"""``depthpose demo``."""

from pathlib import Path


def demo(out: Path = Path("out/demo"), weights: str = "default") -> int:
    """Estimate depth of a made street and of a real pair, and write a page about it.

    Needs no network and no data. The street's depth is known exactly: it is estimated from one
    image and from both, beside OpenCV's StereoSGBM. The real pair comes with scikit-image (the
    extra 'demo'); without it the page shows the street alone.

    Args:
        out: folder for the pictures, the maps and report.html.
        weights: weights of both networks, by name or file ('depthpose weights list').
    """
    from depthpose.core.report import markdown_table
    from depthpose.demo import make_demo

    result = make_demo(out, weights)
    print(markdown_table(result.rows))
    print(f"The page: {result.page}")
    return 0
