"""The section of a report page that shows an estimate of depth: pictures, facts, a 3D view."""

import numpy as np
import torch

from depthpose.core.arrays import take_evenly
from depthpose.core.camera import Camera, StereoRig, back_project
from depthpose.core.draw import (
    MAX_DISPARITY_PX,
    Rgb,
    draw_depth,
    draw_disparity,
    draw_error_points,
    draw_points,
    draw_share,
)
from depthpose.core.files import PointCloud
from depthpose.depth.config import COLOR_RANGE_M
from depthpose.depth.types import DepthEstimate, DepthInput, ErrorMaps, Map
from depthpose.report.page import (
    Drawing,
    Layer,
    Scene,
    Section,
    make_depth_color_bar,
    make_rising_color_bar,
)

WORST_PX = 4.0
"""Error of disparity that gets the brightest colour, as do larger ones [px]."""
WORST_SHARE = 0.3
"""Error of depth that gets the brightest colour, as do larger ones, as a share of the truth."""

_SPARSE_SHARE = 0.25
"""Share of pixels with truth below which it is taken for LiDAR's, and drawn as points."""
_POINT_RADIUS_PX = 2
_TRUE_COLOR: Rgb = (0.1, 0.8, 0.2)
_MAX_TRUE_POINTS = 20_000
"""Most points of the truth in the 3D view."""


def make_depth_section(
    title: str,
    estimate: DepthEstimate,
    text: str = "",
    *,
    range_m: tuple[float, float] = COLOR_RANGE_M,
    error: ErrorMaps | None = None,
    with_image: bool = True,
) -> Section:
    """Make the section of an estimate: its facts, its maps as pictures, and its points in 3D.

    Args:
        title: title of the section.
        estimate: depth or, without a camera, disparity.
        text: a paragraph below the title.
        range_m: depth of the brightest and of the darkest colour; the 3D view ends at the latter.
        error: error of each pixel, and the truth; None: the truth is unknown.
        with_image: show the left image too.
    """
    _, far_m = range_m
    depth_input = estimate.input
    grey_meaning = "grey: none" if estimate.is_sky is None else "grey: sky or no answer"
    pictures = [Drawing(image=depth_input.left, caption="image")] if with_image else []
    if estimate.depth_m is None:
        disparity = Drawing(
            image=draw_disparity(estimate.disparity_px, is_sky=estimate.is_sky),
            caption=f"estimated disparity, large (near) bright; {grey_meaning}",
            color_bar=make_rising_color_bar("disparity [px]", MAX_DISPARITY_PX, has_more=True),
        )
        pictures.append(disparity)
    else:
        depth = Drawing(
            image=draw_depth(estimate.depth_m, *range_m),
            caption=f"estimated depth, near bright and far dark; {grey_meaning}",
            color_bar=make_depth_color_bar(*range_m),
        )
        pictures.append(depth)
    if error is not None:
        pictures += _draw_errors(depth_input, error, range_m)
    if estimate.confidence is not None:
        confidence = Drawing(
            image=draw_share(1 - estimate.confidence),
            caption="confidence: bright is sure, dark a guess",
            color_bar=make_rising_color_bar("confidence", 1.0),
        )
        pictures.append(confidence)
    if estimate.right is not None:
        pictures.append(Drawing(image=estimate.right, caption="right view as drawn"))

    scenes: list[Scene] = []
    if estimate.depth_m is not None and depth_input.camera is not None:
        scene = make_depth_scene(estimate, far_m, f"{title}: the cloud")
        if error is not None and error.true_depth_m is not None:
            scene = _add_truth(scene, error.true_depth_m, depth_input.camera, far_m)
        scenes.append(scene)
    facts = list_depth_facts(estimate)
    return Section(title=title, text=text, facts=facts, pictures=pictures, scenes=scenes)


def _draw_errors(
    depth_input: DepthInput, error: ErrorMaps, range_m: tuple[float, float]
) -> list[Drawing]:
    """Draw the true depth, if it is known in metres, and the error of each pixel.

    If few pixels have a truth, as of LiDAR, they are drawn as points over the dimmed image.
    """
    near_m, far_m = range_m
    compared_share = float(error.error.isfinite().double().mean())
    is_sparse = compared_share < _SPARSE_SHARE
    note = "over the dimmed image" if is_sparse else "grey: not compared"
    drawings: list[Drawing] = []
    if error.true_depth_m is not None:
        if is_sparse:
            image = draw_points(
                depth_input.left, error.true_depth_m, far_m, _POINT_RADIUS_PX, near_m
            )
        else:
            image = draw_depth(error.true_depth_m, near_m, far_m)
        color_bar = make_depth_color_bar(near_m, far_m)
        drawings.append(Drawing(image=image, caption=f"true depth; {note}", color_bar=color_bar))

    if error.is_disparity:
        worst = WORST_PX
        noun = "disparity error"
        color_bar = make_rising_color_bar("disparity error [px]", worst, has_more=True)
    else:
        worst = WORST_SHARE
        noun = "depth error as a share of the truth"
        color_bar = make_rising_color_bar("depth error [%]", 100 * worst, has_more=True)
    if is_sparse:
        image = draw_error_points(depth_input.left, error.error, worst, _POINT_RADIUS_PX)
    else:
        image = draw_share(1 - error.error / worst)  # no error is 1, the dark end of the colours
    caption = f"{noun}: dark is right, bright is wrong; {note}"
    drawings.append(Drawing(image=image, caption=caption, color_bar=color_bar))
    return drawings


def _add_truth(scene: Scene, true_m: Map, camera: Camera, far_m: float) -> Scene:
    """Add the points of the true depth up to ``far_m`` to a 3D view, in green."""
    points_m = back_project(true_m, camera.K).reshape(-1, 3).float()
    is_included = points_m.isfinite().all(-1) & (points_m[:, 2] <= far_m)
    points_m = points_m[is_included]
    points_m = take_evenly(points_m, _MAX_TRUE_POINTS)
    color = torch.tensor(_TRUE_COLOR).expand(len(points_m), 3)
    layer = Layer(name="true points", shape=PointCloud(points=points_m, color=color))
    caption = f"{scene.caption}; the truth in green"
    return Scene(caption=caption, layers=[*scene.layers, layer])


def list_depth_facts(estimate: DepthEstimate, focal_note: str = "") -> list[tuple[str, str]]:
    """List facts about an estimate, each a name and a value, for people.

    ``focal_note``: text behind the focal length, such as where it is from.
    """
    depth_input = estimate.input
    camera = depth_input.camera
    depth_m = estimate.depth_m
    height, width = depth_input.left.shape[1:]
    facts = [("size", f"{width} x {height} px")]
    if isinstance(camera, Camera):
        facts.append(("focal length", f"{float(camera.K[0, 0]):.1f} px{focal_note}"))
    if depth_input.right is not None and isinstance(camera, StereoRig):
        facts.append(("baseline", f"{camera.baseline_m:g} m"))

    if depth_m is not None:
        finite_m = depth_m[depth_m.isfinite()]
        facts.append(("pixels with depth", f"{len(finite_m) / depth_m.numel():.1%}"))
        if len(finite_m):
            near, median, far = np.percentile(finite_m.numpy(), (1, 50, 99))
            facts.append(("1, 50, 99 % are nearer than", f"{near:.2f}, {median:.2f}, {far:.2f} m"))

    if estimate.is_sky is not None:
        facts.append(("sky", f"{float(estimate.is_sky.float().mean()):.1%} of the pixels"))
    if estimate.ground is not None:
        facts.append(("ground", str(estimate.ground)))
    if estimate.warning:
        facts.insert(0, ("warning", estimate.warning))

    if estimate.confidence is not None:
        facts.append(("mean confidence", f"{float(estimate.confidence.nanmean()):.2f}"))
        if depth_input.right is not None:
            sure_count = estimate.is_sure().sum()
            point_count = estimate.is_sure(0.0).sum().clamp(min=1)  # all that have depth
            unsure_share = 1 - float(sure_count / point_count)
            facts.append(("unsure, not in the cloud", f"{unsure_share:.1%} of the depth"))
    return facts


def make_depth_scene(estimate: DepthEstimate, far_m: float, caption: str = "The cloud") -> Scene:
    """Make the 3D view of an estimate's points up to ``far_m``, in the colours of the image.

    ``caption`` begins the text below it.
    """
    cloud = estimate.cloud(far_m)
    return Scene(
        caption=f"{caption} up to {far_m:g} m, in the camera's frame",
        layers=[Layer(name="points", shape=cloud)],
    )
