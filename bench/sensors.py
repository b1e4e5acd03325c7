"""Noise and edges of real depth sensors beside those of synthetic views.

    DEPTHPOSE_DATA=SAMPLES python bench/sensors.py

Columns:

- noise: deviation of the disparity of a stereo camera of 7.5 cm [px] on the largest plane of a
  frame, after subtraction of the plane and of the mean over 41x41 pixels
- alike at N px: correlation of this noise at a distance of N pixels
- between, lost: of the pixels within 3 px of an object's border where depth jumps by 3 cm or more,
  the share of readings between both surfaces, and the share without a reading
- bend: how far four means of 5x5 readings, up to 13 px to both sides of a pixel of a wide plane,
  are off a straight line (80 % are off by less), beside two deviations of the noise that evidence
  assumes of such means

Real frames are LineMOD's (Kinect) and PoseCNN's of YCB objects (RealSense); synthetic ones show a
disc of 12 cm before a slanted plane at the same distance.
"""

import json
import math
import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from shared import make_parser
from torch import Tensor

from depthpose.core.files import read_depth_png, read_image
from depthpose.pose.cloud import grow_mask
from depthpose.pose.config import SensorKind, SyntheticSensorConfig
from depthpose.pose.frame import prepare_frame
from depthpose.pose.sensor import AVERAGED_PER_WHITE, FLAT_M
from depthpose.pose.synthetic.depth_sensors import simulate_depth
from depthpose.pose.verify.evidence import _ACROSS, _MEETING, _mean_depth
from depthpose.report.page import format_markdown_table

_BASELINE_M = 0.075
_LAGS = (1, 2, 4, 8)
_FARTHEST_M = 1.6
_SIZE = (480, 640)
_LINE = np.stack([np.ones(4), np.array(_ACROSS)], 1)
_RESIDUALS_OF_LINE = np.eye(4) - _LINE @ np.linalg.pinv(_LINE)
"""Times four values, the residuals of the line through them."""
_BEND_PLACES = 6000


@dataclass(frozen=True)
class Frame:
    """Depth, focal length, and which pixels show what stands before the plane."""

    name: str
    depth_m: Tensor
    focal_px: float
    is_object: Tensor


def real_frames(samples: Path) -> list[Frame]:
    """Read every depth image with masks of LineMOD and of the YCB frames."""
    frames = []
    for path in sorted(samples.glob("pose/*/test/*/depth/*.png")):
        scene = path.parents[1]
        camera = json.loads((scene / "scene_camera.json").read_text())[str(int(path.stem))]
        masks = [read_image(mask)[0] > 0.5 for mask in scene.glob(f"mask_visib/{path.stem}_*.png")]
        frames.append(Frame(
            name=f"{scene.parents[1].name} {scene.name}/{path.stem}",
            depth_m=read_depth_png(path, camera["depth_scale"] / 1000).double(),
            focal_px=camera["cam_K"][0],
            is_object=torch.stack(masks).any(0),
        ))  # fmt: skip
    return frames


def synthetic_frame(kind: SensorKind, noise_correlation_px: float | None, like: Frame) -> Frame:
    """Measure a disc before a plane at the distance of a real frame's plane."""
    height, width = _SIZE
    row_share = torch.arange(height)[:, None] / height
    column_share = torch.arange(width) / width
    distance_m = float(like.depth_m[like.is_object].nanmedian())
    depth_m = distance_m * 1.1 + 0.3 * (0.5 - row_share) + 0.05 * column_share
    radius_px = 0.06 * like.focal_px / distance_m
    y = torch.arange(height)[:, None] - height / 2
    x = torch.arange(width) - width / 2
    is_object = y.square() + x.square() < radius_px**2
    depth_m = torch.where(is_object, torch.tensor(distance_m - 0.05), depth_m)
    config = SyntheticSensorConfig(kinds=(kind,), noise=(1.0, 1.0), missing=(0.0, 0.0))
    name: str = kind
    if noise_correlation_px is not None:
        correlation_px = (noise_correlation_px, noise_correlation_px)
        config = replace(config, noise_correlation_px=correlation_px)
        name = f"{kind}, alike over {noise_correlation_px:g} px"
    generator = torch.Generator().manual_seed(0)
    focal_px = (like.focal_px, like.focal_px)
    measured_m = simulate_depth(depth_m, focal_px, config, generator)
    return Frame(f"{name}, as {like.name}", measured_m.double(), like.focal_px, is_object)


def noise_of_plane(frame: Frame) -> tuple[float, list[float]]:
    """Compute the deviation of disparity [px], and its correlation at each lag."""
    inverse_depth = 1 / frame.depth_m
    is_usable = inverse_depth.isfinite() & (frame.depth_m < _FARTHEST_M) & ~frame.is_object
    residual, on_plane = _fit_plane(inverse_depth, is_usable)
    is_inner = on_plane & (_mean(on_plane.double(), 9) > 0.98)
    share = _mean(on_plane.double(), 41).clamp(min=1e-6)
    local_mean = _mean(torch.where(on_plane, residual, 0.0), 41) / share
    noise = torch.where(is_inner, residual - local_mean, torch.nan)
    noise_px = noise * frame.focal_px * _BASELINE_M
    deviation_px = float(noise_px[is_inner].std())
    correlations = []
    for lag in _LAGS:
        across = (noise_px[:, :-lag] * noise_px[:, lag:]).flatten()
        down = (noise_px[:-lag] * noise_px[lag:]).flatten()
        covariance_px2 = float(torch.cat([across, down]).nanmean())
        correlations.append(covariance_px2 / deviation_px**2)
    return deviation_px, correlations


def _fit_plane(inverse_depth: Tensor, is_usable: Tensor) -> tuple[Tensor, Tensor]:
    """Fit the plane that most pixels lie on, where inverse depth is linear in the pixel.

    Returns the residuals of inverse depth, and which pixels lie on the plane.
    """
    height, width = inverse_depth.shape
    row = torch.arange(height) / height - 0.5
    column = torch.arange(width) / width - 0.5
    rows, columns = torch.meshgrid(row, column, indexing="ij")
    grid = torch.stack([rows, columns, torch.ones_like(inverse_depth)], 2).double()
    usable_pixels = is_usable.nonzero()
    generator = torch.Generator().manual_seed(0)
    best = torch.zeros(3).double()
    best_count = -1
    for _ in range(300):
        sample = torch.randint(len(usable_pixels), (3,), generator=generator)
        y, x = usable_pixels[sample].unbind(1)
        plane, failure = torch.linalg.solve_ex(grid[y, x], inverse_depth[y, x])
        is_inlier = is_usable & ((grid @ plane - inverse_depth).abs() < 0.01)
        count = int(is_inlier.sum())
        if int(failure) == 0 and count > best_count:
            best = plane
            best_count = count
    for _ in range(5):
        is_inlier = is_usable & ((grid @ best - inverse_depth).abs() < 0.012)
        solution = torch.linalg.lstsq(grid[is_inlier], inverse_depth[is_inlier][:, None]).solution
        best = solution[:, 0]
    residual = inverse_depth - grid @ best
    return residual, is_usable & (residual.abs() < 0.015)


def edges(frame: Frame) -> tuple[float, float]:
    """Compute the shares of readings between two surfaces, and of lost pixels, at edges."""
    near_object = _largest(frame.is_object.double(), 7) > 0
    near_background = _largest((~frame.is_object).double(), 7) > 0
    depth_m = frame.depth_m.nan_to_num(0.0)
    has_depth = depth_m > 0
    farthest_m = _largest(depth_m, 9)
    nearest_m = -_largest(-torch.where(has_depth, depth_m, torch.inf), 9)
    jump_m = farthest_m - nearest_m
    is_edge = near_object & near_background & (jump_m > 0.03) & (jump_m < 0.5)
    is_read = is_edge & has_depth
    is_behind_near = depth_m > nearest_m + 0.25 * jump_m
    is_before_far = depth_m < farthest_m - 0.25 * jump_m
    is_between = is_read & is_behind_near & is_before_far
    return float(is_between.sum() / is_read.sum()), float(1 - is_read.sum() / is_edge.sum())


def bend_of_planes(frame: Frame) -> tuple[float, float]:
    """Compute the bend [m] that 80 % of means on wide planes stay below, and two deviations."""
    focal_px = frame.focal_px
    height, width = frame.depth_m.shape
    K = torch.tensor([[focal_px, 0, width / 2], [0, focal_px, height / 2], [0, 0, 1]])
    prepared = prepare_frame(frame.depth_m.float(), K)
    is_plane = prepared.background_limit_m > 0
    is_plane = is_plane.repeat_interleave(prepared.step, 0).repeat_interleave(prepared.step, 1)
    inner = torch.zeros(height, width, dtype=torch.bool)  # far enough from the plane's border
    inner[14:-14, 14:-14] = grow_mask(is_plane[:height, :width], -14)[14:-14, 14:-14]
    generator = np.random.default_rng(0)
    middles = inner.nonzero().numpy()
    middles = middles[generator.integers(len(middles), size=_BEND_PLACES)].T
    angle_rad = generator.uniform(0, 2 * np.pi, _BEND_PLACES)
    length_px = generator.uniform(8, 13, _BEND_PLACES)
    offset_px = np.stack([np.sin(angle_rad), np.cos(angle_rad)]) * length_px
    inverse_depth = 1 / _mean_depth(frame.depth_m.float().numpy(), 5)
    places = [middles + np.rint(factor * offset_px).astype(int) for factor in _ACROSS]
    across = np.stack([inverse_depth[row, column] for row, column in places])
    depth_m = 1 / inverse_depth[middles[0], middles[1]]
    bend_m = np.abs(_RESIDUALS_OF_LINE @ across).max(0) * depth_m**2
    white_std_m = prepared.noise_per_m2 * float(np.nanmedian(depth_m)) ** 2
    limit_m = _MEETING * math.hypot(AVERAGED_PER_WHITE * white_std_m, FLAT_M)
    return float(np.nanquantile(bend_m, 0.8)), limit_m


def _mean(values: Tensor, size: int) -> Tensor:
    return F.avg_pool2d(values[None, None], size, 1, size // 2, count_include_pad=False)[0, 0]


def _largest(values: Tensor, size: int) -> Tensor:
    return F.max_pool2d(values[None, None], size, 1, size // 2)[0, 0]


def row_of(frame: Frame) -> dict[str, str]:
    """Measure a frame for the table."""
    deviation_px, correlations = noise_of_plane(frame)
    between, lost = edges(frame)
    bend_m, limit_m = bend_of_planes(frame)
    return {
        "frame": frame.name,
        "noise [px]": f"{deviation_px:.3f}",
        **{
            f"alike at {lag} px": f"{correlation:.2f}"
            for lag, correlation in zip(_LAGS, correlations, strict=True)
        },
        "between": f"{between:.1%}",
        "lost": f"{lost:.0%}",
        "bend [mm]": f"{1000 * bend_m:.2f}",
        "two deviations [mm]": f"{1000 * limit_m:.2f}",
    }


def main() -> None:
    """Print the table."""
    make_parser(__doc__).parse_args()
    frames = real_frames(Path(os.environ["DEPTHPOSE_DATA"]))
    kinect, realsense = frames[0], frames[-1]
    simulated: list[tuple[SensorKind, float | None, Frame]] = [
        ("structured light", None, kinect),
        ("structured light", 3.0, kinect),
        ("active stereo", None, realsense),
        ("time of flight", None, kinect),
    ]
    frames += [synthetic_frame(*arguments) for arguments in simulated]
    print(format_markdown_table([row_of(frame) for frame in frames]))


if __name__ == "__main__":
    main()
