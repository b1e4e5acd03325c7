"""``depthpose figure 3-2``, ``3-4`` and ``3-5``."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from depthpose.cli.options import PoseDataOptions, refuse_below

if TYPE_CHECKING:
    from depthpose.cli.thesis.views import Views
    from depthpose.pose.estimator import GeoPoseNet

_FEATURES = (
    "Alike features have alike colours (t-SNE to one number for all clouds, Spectral); the model "
    "is black, each cloud posed on it by the truth."
)


def figure_3_2(
    weights: str,
    out: Path,
    data: PoseDataOptions = PoseDataOptions(),
    number: int = 4,
    perplexity: float = 40.0,
) -> int:
    """Draw figure 3-2: features of partial clouds as colours, each cloud posed on its model.

    The features before the last layer (64 numbers a point) of all clouds are mapped to one number
    by an exact t-SNE and shown in the Spectral scale; the model is black. Without a data set the
    clouds are synthetic views of the weights' objects. Writes figure-3-2.png, panels, report.html.

        depthpose figure 3-2 --weights W.safetensors --out out/figure-3-2

    Args:
        weights: file or name, of the sparse network.
        out: folder for the figure.
        number: how many clouds.
        perplexity: of t-SNE.
    """
    from depthpose.cli.thesis import pose_figures

    net, views = _open(weights, data, number)
    _claim(out, "3-2", weights, {**views.settings, "perplexity": perplexity})
    panels = pose_figures.feature_panels(net, views, perplexity)
    return pose_figures.write_figure("3-2", _FEATURES, panels, out, columns=4)


def figure_3_4(
    weights: str,
    out: Path,
    data: PoseDataOptions = PoseDataOptions(),
    number: int = 20,
    keypoint: int | None = None,
) -> int:
    """Draw figure 3-4: true and predicted directions to the keypoint with the largest error.

    Looks at some views and shows the worst. In the plane of the camera's x and y: a yellow star is
    the true keypoint, a red cross the voted one. Without a data set the views are synthetic, of the
    weights' objects. Writes figure-3-4.png, panels and report.html.

        depthpose figure 3-4 --weights W.safetensors --out out/figure-3-4

    Args:
        weights: file or name, of the sparse network.
        out: folder for the figure.
        number: how many views are looked at.
        keypoint: only this one, from 0 on.
    """
    from depthpose.cli.thesis import pose_figures

    net, views = _open(weights, data, number)
    _claim(out, "3-4", weights, {**views.settings, "keypoint": keypoint})
    panels = pose_figures.field_panels(net, views, keypoint)
    text = "Plane of x (right) and y (down); star: true keypoint; cross: voted, by RANSAC."
    return pose_figures.write_figure("3-4", text, panels, out, columns=3)


def figure_3_5(
    weights: str,
    out: Path,
    data: PoseDataOptions = PoseDataOptions(),
    number: int = 6,
) -> int:
    """Draw figure 3-5: boxes of true (green, dashed) and estimated (blue, solid) poses.

    Over the picture, or the depth where there is none. Without a data set the views are synthetic,
    of the weights' objects. Writes figure-3-5.png, panels and report.html.

        depthpose figure 3-5 --weights W.safetensors --linemod Linemod_preprocessed --out out

    Args:
        weights: file or name, of the method or of a baseline that votes.
        out: folder for the figure.
        number: how many views.
    """
    from depthpose.cli.thesis import pose_figures

    net, views = _open(weights, data, number)
    _claim(out, "3-5", weights, views.settings)
    panels = pose_figures.box_panels(net, views)
    return pose_figures.write_figure("3-5", pose_figures.BOXES, panels, out, columns=3)


def _open(weights: str, data: PoseDataOptions, number: int) -> "tuple[GeoPoseNet, Views]":
    from depthpose.cli.thesis.views import open_views
    from depthpose.pose.estimator import GeoPoseNet

    refuse_below(1, "--number", number, "4")
    net = GeoPoseNet.load(weights)
    return net, open_views(net, data, number, number)


def _claim(out: Path, number: str, weights: str, settings: Mapping[str, Any]) -> None:
    """Claim the folder for a figure by these weights, and by these settings of its own."""
    from depthpose.cli.thesis.depth_tables import claim_figure
    from depthpose.core.checkpoint import file_sha256, find_weights

    sha256 = file_sha256(find_weights(weights))
    claim_figure(out, number, {"weights_sha256": sha256, **settings})
