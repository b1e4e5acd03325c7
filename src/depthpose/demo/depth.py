"""Depth in the demo: a synthetic street and a real pair, estimated and measured."""

import math
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from depthpose.core.camera import StereoRig, write_camera
from depthpose.core.draw import depth_scale, draw_depth
from depthpose.core.files import write_image
from depthpose.depth.config import SGBMConfig, StreetsConfig
from depthpose.depth.disparity import depth_from_disparity
from depthpose.depth.estimator import FakestereoNet
from depthpose.depth.evaluate import clamped_depth
from depthpose.depth.metrics import depth_errors, disparity_errors
from depthpose.depth.predictions import CLOUD_M, write_estimate
from depthpose.depth.synthetic import Streets
from depthpose.depth.types import DepthEstimate, StereoInput, StereoSample, StereoTruth
from depthpose.report.depth import DepthError, DepthShown, depth_section
from depthpose.report.tables import Picture, Section

_STREETS_SEED = 9
"""No weights were trained on streets of this seed."""
_STREET = 1
_CAP_M = 80.0
_FROM_ONE, _FROM_PAIR = "one image", "both images"
Nets = Mapping[str, tuple[str, FakestereoNet]]

_STREET_TEXT = (
    "A synthetic street of a seed that no training used; its depth is known exactly. Distances "
    "from 3 m (bright) to 80 m (dark); the sky is grey. epe_px and d1_all measure disparity, the "
    "other columns depth, over all pixels nearer than 80 m, occluded ones too. Depth from one "
    "image is an estimate from what streets usually look like: good for road, cars and house "
    "fronts at a usual camera's height, too near far away, and for streets alone."
)
_MOTORCYCLE_TEXT = (
    "A real pair: Motorcycle of the Middlebury 2014 benchmark (Scharstein et al., GCPR 2014), as "
    "scikit-image ships it. Distances from 1.5 m to 8 m. The shipped matcher was trained on "
    "synthetic scenes alone."
)


def show_depth(
    out: Path, weights: str | Path, scale: float
) -> tuple[list[dict[str, Any]], list[Section]]:
    """Estimate depth of both scenes; give a row for each method, and the parts of the page."""
    street = Streets(StreetsConfig(seed=_STREETS_SEED, scale=scale))[_STREET]
    street = replace(street, input=replace(street.input, name="street"))
    network = FakestereoNet.load(weights)
    scenes = [(street, _STREET_TEXT, (3.0, 80.0))]
    if (motorcycle := read_motorcycle()) is not None:
        scenes.insert(0, (motorcycle, _MOTORCYCLE_TEXT, (1.5, 8.0)))
    rows, sections = [], []
    for sample, text, range_m in scenes:
        more, shown = _show_scene(out, sample, _nets(network, sample), text, range_m)
        rows += more
        sections += shown
    return rows, sections


def _nets(network: FakestereoNet, sample: StereoSample) -> Nets:
    """Methods of a scene; the generator knows streets alone, so it draws no motorcycle."""
    # The nearest surfaces of both scenes, in views moved by the distance of the principal points;
    # OpenCV leaves that many columns unmatched.
    rig = sample.input.camera
    assert isinstance(rig, StereoRig)
    nearest_px = sample.input.left.shape[2] / 10 + max(rig.cx_right_minus_left_px, 0.0)
    columns = 16 * math.ceil(nearest_px / 16)
    sgbm = SGBMConfig(num_disparities=columns, with_filled_holes=True)
    matched = {} if network.matcher is None else {"stereo network": (_FROM_PAIR, network)}
    filled = FakestereoNet.load(matcher="sgbm", config=sgbm)
    pairs = {**matched, "SGBM, holes filled": (_FROM_PAIR, filled)}
    is_street = sample.input.name == "street"
    return {**pairs, "selecting generator": (_FROM_ONE, network)} if is_street else pairs


def _show_scene(
    out: Path, sample: StereoSample, nets: Nets, text: str, range_m: tuple[float, float]
) -> tuple[list[dict[str, Any]], list[Section]]:
    """Write the pair as files that commands take; estimate by each method; rows and sections."""
    pair, truth, folder = sample.input, sample.truth, out / sample.input.name
    assert pair.right is not None
    assert pair.camera is not None
    assert truth.depth_m is not None
    assert truth.disparity_px is not None
    write_image(folder / "left.png", pair.left)
    write_image(folder / "right.png", pair.right)
    write_camera(folder / "camera.json", pair.camera)
    write_image(folder / "depth.color.png", draw_depth(truth.depth_m, *range_m))
    rows, sections = [], []
    homes = {method: out / method.lower().replace(",", "").replace(" ", "-") for method in nets}
    for method, (given, net) in nets.items():
        seen = pair if given == _FROM_PAIR else replace(pair, right=None)
        estimate = net.estimate_pair(seen, with_check=False)
        measured = _measure(sample, estimate)
        rows.append({"scene": pair.name, "method": method, "input": given, **measured})
        write_estimate(homes[method], seen, estimate, range_m, CLOUD_M)
        error_px = (estimate.disparity_px - truth.disparity_px).abs()
        error = DepthError(error=error_px, is_disparity=True)
        shown = DepthShown(pair=seen, estimate=estimate, range_m=range_m, error=error)
        title = f"{pair.name}: {method}, {given}"
        sections.append(depth_section(title, shown, with_image=False))
    best, scale = next(iter(nets)), depth_scale(*range_m)
    pictures = [
        Picture(path=folder / "left.png", caption="left image"),
        Picture(path=folder / "right.png", caption="right image"),
        Picture(
            path=homes[best] / f"{pair.name}.color.png",
            caption=f"depth from both: {best}",
            scale=scale,
        ),
        Picture(path=folder / "depth.color.png", caption="true depth; grey: none", scale=scale),
    ]
    opening = Section(title=f"The {pair.name}", text=text, rows=rows, pictures=pictures)
    return rows, [opening, *sections]


def _measure(sample: StereoSample, estimate: DepthEstimate) -> dict[str, Any]:
    """Every measure over the pixels that have truth within the cap and a prediction."""
    rig, true_px, true_m = sample.input.camera, sample.truth.disparity_px, sample.truth.depth_m
    assert isinstance(rig, StereoRig)
    assert true_px is not None
    assert true_m is not None
    predicted_m = clamped_depth(estimate.disparity_px, rig, _CAP_M)
    counts = true_m < _CAP_M
    mask = counts & torch.isfinite(estimate.disparity_px)
    row = {"coverage": float(mask.sum() / counts.sum())}
    row |= asdict(disparity_errors(estimate.disparity_px[mask], true_px[mask]))
    return row | asdict(depth_errors(predicted_m[mask], true_m[mask]))


def read_motorcycle() -> StereoSample | None:
    """Read the pair with its true disparity, or None where scikit-image is not installed.

    Calibration is that of scikit-image's documentation: images a quarter of the original size,
    principal points 31.086 px apart, baseline 193.001 mm.
    """
    try:
        from skimage.data import stereo_motorcycle
    except ImportError:
        return None
    left, right, disparity = stereo_motorcycle()
    K = torch.tensor([[994.978, 0, 311.193], [0, 994.978, 254.877], [0, 0, 1]], dtype=torch.float64)
    rig = StereoRig(
        width=left.shape[1],
        height=left.shape[0],
        K=K,
        baseline_m=0.193001,
        cx_right_minus_left_px=31.086,
    )
    disparity_px = torch.from_numpy(np.array(disparity, np.float32))
    disparity_px[~torch.isfinite(disparity_px)] = torch.nan
    truth = StereoTruth(disparity_px=disparity_px, depth_m=depth_from_disparity(disparity_px, rig))
    views = [
        torch.from_numpy(np.array(view)).permute(2, 0, 1).float() / 255 for view in (left, right)
    ]
    pair = StereoInput(name="motorcycle", left=views[0], right=views[1], camera=rig)
    return StereoSample(input=pair, truth=truth)
