"""The demo's work: draw, match, measure, write the page."""

import math
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from depthpose.core.camera import StereoRig, write_camera
from depthpose.core.draw import draw_depth, draw_share
from depthpose.core.files import write_image
from depthpose.core.report import Picture, Section, write_page, write_table
from depthpose.core.run import environment
from depthpose.demo.scene import make_street
from depthpose.depth.config import MatcherConfig, SGBMConfig
from depthpose.depth.estimator import FakestereoNet
from depthpose.depth.evaluate import clamped_depth
from depthpose.depth.metrics import depth_errors, disparity_errors
from depthpose.depth.predictions import write_estimate, write_estimate_cloud
from depthpose.depth.types import DepthEstimate, StereoSample

_CAP_M = 80.0
_WORST_PX = 4.0


@dataclass(frozen=True)
class DemoResult:
    """Where the page is, and the rows on it."""

    page: Path
    rows: list[dict[str, Any]]


def make_demo(out: Path, weights: Path | None = None, scale: float = 1.0) -> DemoResult:
    """Match the made street and write ``report.html`` with everything that it shows.

    Args:
        out: folder for the pair, its camera, the estimates, the table and the page.
        weights: PSMNet weights to match with as well.
        scale: size of the images as a share of 1242 x 375.
    """
    sample = make_street(scale)
    _write_pair(out / "street", sample)
    # The nearest surface is 66 px away at full size; OpenCV leaves that many columns unmatched.
    sgbm = SGBMConfig(num_disparities=16 * math.ceil(5 * scale))
    nets = {
        "SGBM, holes filled": _sgbm(replace(sgbm, with_filled_holes=True)),
        "SGBM, matched pixels": _sgbm(sgbm),
    }
    if weights is not None:
        nets["PSMNet"] = FakestereoNet.load(weights, config=MatcherConfig())
    rows: list[dict[str, Any]] = []
    sections: list[Section] = []
    for name, net in nets.items():
        estimate = net.estimate_pair(sample.input, with_check=True)
        rows.append({"method": name, **_measure(sample, estimate)})
        sections.append(_show(out / name.lower().replace(",", "").replace(" ", "-"), name, sample,
                              estimate))  # fmt: skip
    write_table(out, rows)
    page = out / "report.html"
    write_page(page, "depthpose: a stereo pair to metric depth", [_opening(out, rows), *sections],
               environment())  # fmt: skip
    return DemoResult(page, rows)


def _sgbm(config: SGBMConfig) -> FakestereoNet:
    return FakestereoNet.load(matcher="sgbm", config=config)


def _write_pair(folder: Path, sample: StereoSample) -> None:
    """Write the pair as files that ``depthpose depth match`` takes, and pictures of the truth."""
    pair, truth = sample.input, sample.truth
    assert pair.right is not None
    assert pair.camera is not None
    assert truth.depth_m is not None
    write_image(folder / "left.png", pair.left)
    write_image(folder / "right.png", pair.right)
    write_camera(folder / "camera.json", pair.camera)
    write_image(folder / "depth.png", draw_depth(truth.depth_m))


def _measure(sample: StereoSample, estimate: DepthEstimate) -> dict[str, Any]:
    """Every measure over the pixels that have truth within the cap and a prediction."""
    rig, true_px, true_m = sample.input.camera, sample.truth.disparity_px, sample.truth.depth_m
    assert isinstance(rig, StereoRig)
    assert true_px is not None
    assert true_m is not None
    predicted_m = clamped_depth(estimate.disparity_px, rig, _CAP_M)
    counts = true_m < _CAP_M
    mask = counts & torch.isfinite(estimate.disparity_px)
    row = {"cap_m": _CAP_M, "coverage": float(mask.sum() / counts.sum())}
    row |= asdict(disparity_errors(estimate.disparity_px[mask], true_px[mask]))
    return row | asdict(depth_errors(predicted_m[mask], true_m[mask]))


def _opening(out: Path, rows: list[dict[str, Any]]) -> Section:
    folder = out / "street"
    return Section(
        title="A made street, its depth known exactly",
        text="Every pixel's ray was cut with the scene in closed form. Distances from 3 m (bright) "
        "to 80 m (dark), grey where there is none. epe_px and d1_all measure disparity, the other "
        "columns depth, over all pixels nearer than cap_m, hidden ones too.",
        rows=rows,
        pictures=[
            Picture(path=folder / "left.png", caption="left image"),
            Picture(path=folder / "right.png", caption="right image"),
            Picture(path=folder / "depth.png", caption="true depth"),
        ],
    )


def _show(folder: Path, name: str, sample: StereoSample, estimate: DepthEstimate) -> Section:
    truth_px = sample.truth.disparity_px
    assert truth_px is not None
    write_estimate(folder, sample.input, estimate)
    write_estimate_cloud(folder, sample.input, estimate)
    error = folder / "error.png"
    write_image(error, _draw_error(estimate.disparity_px, truth_px))
    depth = folder / f"{sample.input.name}.color.png"
    return Section(
        title=name,
        pictures=[
            Picture(path=depth, caption="estimated depth, same colours"),
            Picture(path=error, caption=f"disparity error, dark 0 to bright {_WORST_PX:.0f} px"),
        ],
    )


def _draw_error(
    predicted_px: Float[Tensor, "h w"], true_px: Float[Tensor, "h w"]
) -> Float[Tensor, "3 h w"]:
    return draw_share(1 - (predicted_px - true_px).abs() / _WORST_PX)
