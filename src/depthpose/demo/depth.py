"""Depth in the demo: a synthetic street and a real pair, estimated and measured."""

import math
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

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

STREETS_SEED = 9
"""No weights were trained on streets of this seed."""

_STREET = 1
_CAP_M = 80.0
_FROM_ONE, _FROM_PAIR = "one image", "both images"
Nets = Mapping[str, tuple[str, FakestereoNet]]


def show_depth(
    out: Path, weights: str | Path, scale: float
) -> tuple[list[dict[str, Any]], list[Section]]:
    """Estimate depth of both scenes; give a row for each method, and the parts of the page.

    Args:
        out: folder for the pairs, their cameras and the estimates.
        weights: of generator and matcher, or of a generator with an answer of its own, by name or
            file.
        scale: size of the street's images as a share of KITTI's.
    """
    street = Streets(StreetsConfig(seed=STREETS_SEED, scale=scale))[_STREET]
    street = replace(street, input=replace(street.input, name="street"))
    network = FakestereoNet.load(weights)
    rows, sections = [], []
    for sample, intro in ((read_motorcycle(), _MOTORCYCLE_TEXT), (street, _STREET_TEXT)):
        if sample is None:
            continue
        more, shown = _try_all(out, sample, _nets(network, sample), intro)
        rows += more
        sections += shown
    return rows, sections


def _nets(network: FakestereoNet, sample: StereoSample) -> Nets:
    """Methods of a scene; the generator knows streets alone, so it draws no motorcycle."""
    # The nearest surfaces of both scenes; OpenCV leaves that many columns unmatched.
    columns = 16 * math.ceil(sample.input.left.shape[2] / 16 / 10)
    sgbm = SGBMConfig(num_disparities=columns, with_filled_holes=True)
    matched = {} if network.matcher is None else {"stereo network": (_FROM_PAIR, network)}
    filled = FakestereoNet.load(matcher="sgbm", config=sgbm)
    pairs = {**matched, "SGBM, holes filled": (_FROM_PAIR, filled)}
    is_street = sample.input.name == "street"
    return {**pairs, "selecting generator": (_FROM_ONE, network)} if is_street else pairs


def _try_all(
    out: Path, sample: StereoSample, nets: Nets, text: str
) -> tuple[list[dict[str, Any]], list[Section]]:
    """Estimate with each method; rows and sections of one scene."""
    name = sample.input.name
    _write_pair(out / name, sample)
    rows, shown = [], []
    for method, (given, net) in nets.items():
        pair = sample.input if given == _FROM_PAIR else replace(sample.input, right=None)
        estimate = net.estimate_pair(pair, with_check=False)
        rows.append({"scene": name, "method": method, "input": given, **_measure(sample, estimate)})
        title = f"{name}: {method}, {given}"
        shown.append(_show(out / _folder(method), title, replace(sample, input=pair), estimate))
    method = next(iter(nets))
    best = Picture(
        path=out / _folder(method) / f"{name}.color.png",
        caption=f"depth from both: {method}",
        scale=depth_scale(*_range_m(sample)),
    )
    return rows, [_opening(out / name, sample, text, rows, best), *shown]


def _write_pair(folder: Path, sample: StereoSample) -> None:
    """Write the pair as files that the commands take, and a picture of the truth."""
    pair, truth = sample.input, sample.truth
    assert pair.right is not None
    assert pair.camera is not None
    assert truth.depth_m is not None
    write_image(folder / "left.png", pair.left)
    write_image(folder / "right.png", pair.right)
    write_camera(folder / "camera.json", pair.camera)
    write_image(folder / "depth.color.png", draw_depth(truth.depth_m, *_range_m(sample)))


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


def _range_m(sample: StereoSample) -> tuple[float, float]:
    """Colours reach to 80 m on the street, to 8 m on the motorcycle."""
    return (3.0, 80.0) if sample.input.name == "street" else (1.5, 8.0)


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


def _folder(method: str) -> str:
    return method.lower().replace(",", "").replace(" ", "-")


def _opening(
    folder: Path, sample: StereoSample, text: str, rows: list[dict[str, Any]], best: Picture
) -> Section:
    scale = depth_scale(*_range_m(sample))
    return Section(
        title=f"The {sample.input.name}",
        text=text,
        rows=rows,
        pictures=[
            Picture(path=folder / "left.png", caption="left image"),
            Picture(path=folder / "right.png", caption="right image"),
            best,
            Picture(path=folder / "depth.color.png", caption="true depth; grey: none", scale=scale),
        ],
    )


def _show(folder: Path, title: str, sample: StereoSample, estimate: DepthEstimate) -> Section:
    truth_px = sample.truth.disparity_px
    assert truth_px is not None
    range_m = _range_m(sample)
    write_estimate(folder, sample.input, estimate, range_m, CLOUD_M)
    error = DepthError(error=(estimate.disparity_px - truth_px).abs(), is_disparity=True)
    shown = DepthShown(pair=sample.input, estimate=estimate, range_m=range_m, error=error)
    return depth_section(title, shown, with_image=False)


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
    pair = StereoInput(name="motorcycle", left=_image(left), right=_image(right), camera=rig)
    return StereoSample(input=pair, truth=truth)


def _image(pixels: np.ndarray) -> Float[Tensor, "3 h w"]:
    return torch.from_numpy(np.ascontiguousarray(pixels)).permute(2, 0, 1).float() / 255
