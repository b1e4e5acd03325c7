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
from depthpose.depth.predictions import COLOR_RANGE_M
from depthpose.depth.types import DepthError, DepthEstimate, StereoInput
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

_SPARSE = 0.25
"""Below this share of known pixels, LiDAR's, points are grown to be seen."""
_RADIUS_PX = 2
_TRUE = (0.1, 0.8, 0.2)
_TRUE_POINTS = 20_000


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

    The colours of depth go from bright to dark over ``range_m``.
    """
    near_m, far_m = range_m
    facts = depth_facts(pair, estimate)
    grey = "grey: none" if estimate.is_sky is None else "grey: sky or no answer"
    true_m = None if error is None else error.true_depth_m
    scenes: list[Scene] = []
    if estimate.depth_m is not None and (camera := pair.camera) is not None:
        scenes = [depth_scene(pair, estimate, far_m, f"{title}: the cloud")]
        if true_m is not None:
            points_m = back_project(true_m, camera.K).reshape(-1, 3).float()
            points_m = points_m[points_m.isfinite().all(-1) & (points_m[:, 2] <= far_m)]
            points_m = take_evenly(points_m, _TRUE_POINTS)
            color = torch.tensor(_TRUE).expand(len(points_m), 3)
            layer = Layer(name="true points", shape=Cloud(points=points_m, color=color))
            caption = f"{scenes[0].caption}; the truth in green"
            layers = [*scenes[0].layers, layer]
            scenes = [Scene(caption=caption, layers=layers)]
    pictures = [Drawing(image=pair.left, caption="image")] if with_image else []
    if estimate.depth_m is None:
        disparity = Drawing(
            image=draw_disparity(estimate.disparity_px, is_sky=estimate.is_sky),
            caption=f"estimated disparity, large (near) bright; {grey}",
            scale=rising_scale("disparity [px]", 96.0, has_more=True),
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
        wrong = error.error
        left = pair.left
        is_sparse = float(wrong.isfinite().double().mean()) < _SPARSE
        note = "over the dimmed image" if is_sparse else "grey: not compared"
        if error.is_disparity:
            top = WORST_PX
            what = "disparity error"
            scale = rising_scale("disparity error [px]", top, has_more=True)
        else:
            top = WORST_SHARE
            what = "depth error as a share of the truth"
            scale = rising_scale("depth error [%]", 100 * top, has_more=True)
        if true_m is not None:
            if is_sparse:
                image = draw_points(left, true_m, far_m, _RADIUS_PX, near_m)
            else:
                image = draw_depth(true_m, near_m, far_m)
            caption = f"true depth; {note}"
            bar = depth_scale(near_m, far_m)
            pictures.append(Drawing(image=image, caption=caption, scale=bar))
        if is_sparse:
            image = draw_error_points(left, wrong, top, _RADIUS_PX)
        else:
            image = draw_share(1 - wrong / top)
        caption = f"{what}: dark is right, bright is wrong; {note}"
        pictures.append(Drawing(image=image, caption=caption, scale=scale))
    if estimate.confidence is not None:
        confidence = Drawing(
            image=draw_share(1 - estimate.confidence),
            caption="confidence: bright is sure, dark a guess",
            scale=rising_scale("confidence", 1.0),
        )
        pictures.append(confidence)
    if estimate.right is not None:
        pictures.append(Drawing(image=estimate.right, caption="right view as drawn"))
    return Section(title=title, text=text, facts=facts, pictures=pictures, scenes=scenes)


def depth_facts(
    pair: StereoInput, estimate: DepthEstimate, focal: str = ""
) -> list[tuple[str, str]]:
    """List sizes and metres of an estimate; ``focal``: words behind the focal length."""
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
            low, middle, high = np.percentile(known_m.numpy(), (1, 50, 99))
            facts.append(("1, 50, 99 % are nearer than", f"{low:.2f}, {middle:.2f}, {high:.2f} m"))
    if estimate.is_sky is not None:
        facts.append(("sky", f"{float(estimate.is_sky.float().mean()):.1%} of the pixels"))
    if estimate.ground is not None:
        facts.append(("ground", str(estimate.ground)))
    if estimate.warning:
        facts.insert(0, ("warning", estimate.warning))
    if estimate.confidence is not None:
        facts.append(("mean confidence", f"{float(estimate.confidence.nanmean()):.2f}"))
        shown = replace(estimate, input=pair)
        doubted = 1 - float(shown.is_sure().sum() / shown.is_sure(0.0).sum().clamp(min=1))
        if pair.right is not None:
            facts.append(("unsure, not in the cloud", f"{doubted:.1%} of the depth"))
    return facts


def depth_scene(
    pair: StereoInput, estimate: DepthEstimate, far_m: float, caption: str = "The cloud"
) -> Scene:
    """Show the points nearer than ``far_m`` in the colours of the image."""
    return Scene(
        caption=f"{caption} up to {far_m:g} m, in the camera's frame",
        layers=[Layer(name="points", shape=replace(estimate, input=pair).cloud(far_m))],
    )
