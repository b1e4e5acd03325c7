"""Depth on a page: picture, depth, confidence, right view, error, and the cloud in 3D."""

from dataclasses import replace

import numpy as np
import torch

from depthpose.core.arrays import take_evenly
from depthpose.core.camera import Camera, StereoRig, back_project
from depthpose.core.draw import (
    draw_depth,
    draw_disparity,
    draw_error_points,
    draw_points,
    draw_share,
)
from depthpose.core.files import Cloud
from depthpose.depth.config import COLOR_RANGE_M
from depthpose.depth.types import DepthError, DepthEstimate, Map, StereoInput
from depthpose.report.page import (
    Drawing,
    Layer,
    Scene,
    Section,
    depth_scale,
    rising_scale,
)

WORST_PX = 4.0
"""Error of disparity [px] that gets the brightest colour."""
WORST_SHARE = 0.3
"""Error of depth, as a share of the truth, that gets the brightest colour."""

_SPARSE_SHARE = 0.25
"""Share of pixels with truth below which they are drawn as points: it is LiDAR's."""
_POINT_RADIUS_PX = 2
_WIDEST_DISPARITY_PX = 96.0
"""Largest disparity of the colour bar; a larger one is as bright."""
_TRUE_COLOR = (0.1, 0.8, 0.2)
_MAX_TRUE_POINTS = 20_000


def depth_section(
    title: str,
    pair: StereoInput,
    estimate: DepthEstimate,
    text: str = "",
    *,
    range_m: tuple[float, float] = COLOR_RANGE_M,
    error: DepthError | None = None,
    with_image: bool = True,
) -> Section:
    """Show one estimate: the facts, pictures with the bars of their colours, the cloud in 3D.

    Args:
        title: title of the section.
        pair: the input.
        estimate: its depth.
        text: a paragraph below the title.
        range_m: depth of the brightest and of the darkest colour.
        error: error of each pixel, and the truth, where they are known.
        with_image: show the left image too.
    """
    _, far_m = range_m
    grey = "grey: none" if estimate.is_sky is None else "grey: sky or no answer"
    pictures = [Drawing(image=pair.left, caption="image")] if with_image else []
    if estimate.depth_m is None:
        disparity = Drawing(
            image=draw_disparity(estimate.disparity_px, is_sky=estimate.is_sky),
            caption=f"estimated disparity, large (near) bright; {grey}",
            scale=rising_scale("disparity [px]", _WIDEST_DISPARITY_PX, has_more=True),
        )
        pictures.append(disparity)
    else:
        depth = Drawing(
            image=draw_depth(estimate.depth_m, *range_m),
            caption=f"estimated depth, near bright and far dark; {grey}",
            scale=depth_scale(*range_m),
        )
        pictures.append(depth)
    if error is not None:
        pictures += _draw_errors(pair, error, range_m)
    if estimate.confidence is not None:
        confidence = Drawing(
            image=draw_share(1 - estimate.confidence),
            caption="confidence: bright is sure, dark a guess",
            scale=rising_scale("confidence", 1.0),
        )
        pictures.append(confidence)
    if estimate.right is not None:
        pictures.append(Drawing(image=estimate.right, caption="right view as drawn"))

    scenes: list[Scene] = []
    if estimate.depth_m is not None and pair.camera is not None:
        scene = depth_scene(pair, estimate, far_m, f"{title}: the cloud")
        if error is not None and error.true_depth_m is not None:
            scene = _with_truth(scene, error.true_depth_m, pair.camera, far_m)
        scenes.append(scene)
    facts = depth_facts(pair, estimate)
    return Section(title=title, text=text, facts=facts, pictures=pictures, scenes=scenes)


def _draw_errors(
    pair: StereoInput, error: DepthError, range_m: tuple[float, float]
) -> list[Drawing]:
    """Draw the true depth, where it is known, and the error of each pixel.

    Few pixels, as of LiDAR, are drawn as points over the dimmed image.
    """
    near_m, far_m = range_m
    is_sparse = float(error.error.isfinite().double().mean()) < _SPARSE_SHARE
    note = "over the dimmed image" if is_sparse else "grey: not compared"
    drawings: list[Drawing] = []
    if error.true_depth_m is not None:
        if is_sparse:
            image = draw_points(pair.left, error.true_depth_m, far_m, _POINT_RADIUS_PX, near_m)
        else:
            image = draw_depth(error.true_depth_m, near_m, far_m)
        scale = depth_scale(near_m, far_m)
        drawings.append(Drawing(image=image, caption=f"true depth; {note}", scale=scale))

    if error.is_disparity:
        worst = WORST_PX
        noun = "disparity error"
        scale = rising_scale("disparity error [px]", worst, has_more=True)
    else:
        worst = WORST_SHARE
        noun = "depth error as a share of the truth"
        scale = rising_scale("depth error [%]", 100 * worst, has_more=True)
    if is_sparse:
        image = draw_error_points(pair.left, error.error, worst, _POINT_RADIUS_PX)
    else:
        image = draw_share(1 - error.error / worst)  # no error is 1, the dark end of the colours
    caption = f"{noun}: dark is right, bright is wrong; {note}"
    drawings.append(Drawing(image=image, caption=caption, scale=scale))
    return drawings


def _with_truth(scene: Scene, true_m: Map, camera: Camera, far_m: float) -> Scene:
    """Return a scene with the points of the true depth up to ``far_m`` too, in green."""
    points_m = back_project(true_m, camera.K).reshape(-1, 3).float()
    points_m = points_m[points_m.isfinite().all(-1) & (points_m[:, 2] <= far_m)]
    points_m = take_evenly(points_m, _MAX_TRUE_POINTS)
    color = torch.tensor(_TRUE_COLOR).expand(len(points_m), 3)
    layer = Layer(name="true points", shape=Cloud(points=points_m, color=color))
    caption = f"{scene.caption}; the truth in green"
    return Scene(caption=caption, layers=[*scene.layers, layer])


def depth_facts(
    pair: StereoInput, estimate: DepthEstimate, focal: str = ""
) -> list[tuple[str, str]]:
    """List the facts of an estimate: names and values.

    ``focal``: words after the focal length, such as its origin.
    """
    camera = pair.camera
    depth_m = estimate.depth_m
    height, width = pair.left.shape[1:]
    facts = [("size", f"{width} x {height} px")]
    if isinstance(camera, Camera):
        facts.append(("focal length", f"{float(camera.K[0, 0]):.1f} px{focal}"))
    if pair.right is not None and isinstance(camera, StereoRig):
        facts.append(("baseline", f"{camera.baseline_m:g} m"))

    if depth_m is not None:
        known_m = depth_m[depth_m.isfinite()]
        facts.append(("pixels with depth", f"{len(known_m) / depth_m.numel():.1%}"))
        if len(known_m):
            near, median, far = np.percentile(known_m.numpy(), (1, 50, 99))
            facts.append(("1, 50, 99 % are nearer than", f"{near:.2f}, {median:.2f}, {far:.2f} m"))

    if estimate.is_sky is not None:
        facts.append(("sky", f"{float(estimate.is_sky.float().mean()):.1%} of the pixels"))
    if estimate.ground is not None:
        facts.append(("ground", str(estimate.ground)))
    if estimate.warning:
        facts.insert(0, ("warning", estimate.warning))

    if estimate.confidence is not None:
        facts.append(("mean confidence", f"{float(estimate.confidence.nanmean()):.2f}"))
        if pair.right is not None:
            of_pair = replace(estimate, input=pair)
            sure_count = of_pair.is_sure().sum()
            point_count = of_pair.is_sure(0.0).sum().clamp(min=1)
            unsure = 1 - float(sure_count / point_count)
            facts.append(("unsure, not in the cloud", f"{unsure:.1%} of the depth"))
    return facts


def depth_scene(
    pair: StereoInput, estimate: DepthEstimate, far_m: float, caption: str = "The cloud"
) -> Scene:
    """Make the 3D view of the points nearer than ``far_m``, in the colours of the image."""
    cloud = replace(estimate, input=pair).cloud(far_m)
    return Scene(
        caption=f"{caption} up to {far_m:g} m, in the camera's frame",
        layers=[Layer(name="points", shape=cloud)],
    )
