"""Noise and edges of real depth sensors beside those of synthetic views.

    DEPTHPOSE_DATA=SAMPLES python bench/sensors.py

Noise is measured on the largest plane of a frame: what is left of inverse depth beyond the plane
and its mean over 41x41 pixels, as disparity in pixels of a stereo camera of 7.5 cm, and how alike
it is some pixels apart. Edges are measured within 3 px of the border of what stands before the
plane, where depth jumps by 3 cm or more: the share of readings that lie between both surfaces, and
of pixels without a reading. The bend is what four means of 5x5 readings, 8 to 13 px to each side of
a pixel of a wide plane, are off a straight line (80 % are off by less), beside two deviations of
the noise that evidence assumes of such means. Real frames are LineMOD's (Kinect) and PoseCNN's of
YCB objects (RealSense); synthetic ones show a disc of 12 cm before a slanted plane at the same
distance.
"""

import json
import math
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from depthpose.core.files import read_depth_png, read_image
from depthpose.pose.cloud import grow_mask
from depthpose.pose.config import SensorKind, SyntheticSensorConfig
from depthpose.pose.evidence import _ACROSS, _MEETING, _mean_depth
from depthpose.pose.frame import prepare_frame
from depthpose.pose.sensor import AVERAGED_PER_WHITE, FLAT_M
from depthpose.pose.synthetic.views import simulate_depth
from depthpose.report.page import markdown_table

_BASELINE_M = 0.075
_LAGS = (1, 2, 4, 8)
_FARTHEST_M = 1.6
_SIZE = (480, 640)
_LINE = np.stack([np.ones(4), np.array(_ACROSS)], 1)
_OFF_LINE = np.eye(4) - _LINE @ np.linalg.pinv(_LINE)
"""Residuals of the line through four values."""


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
    rows, columns = torch.arange(height)[:, None] / height, torch.arange(width) / width
    distance_m = float(like.depth_m[like.is_object].nanmedian())
    depth_m = distance_m * 1.1 + 0.3 * (0.5 - rows) + 0.05 * columns
    radius_px = 0.06 * like.focal_px / distance_m
    y, x = torch.arange(height)[:, None] - height / 2, torch.arange(width) - width / 2
    is_object = y.square() + x.square() < radius_px**2
    depth_m = torch.where(is_object, torch.tensor(distance_m - 0.05), depth_m)
    config = SyntheticSensorConfig(
        kinds=(kind,),
        noise=(1.0, 1.0),
        missing=(0.0, 0.0),
        noise_correlation_px=None
        if noise_correlation_px is None
        else (noise_correlation_px, noise_correlation_px),
    )
    generator = torch.Generator().manual_seed(0)
    read_m = simulate_depth(depth_m, (like.focal_px, like.focal_px), config, generator)
    name = (
        kind if noise_correlation_px is None else f"{kind}, alike over {noise_correlation_px:g} px"
    )
    return Frame(f"{name}, as {like.name}", read_m.double(), like.focal_px, is_object)


def noise_of_plane(frame: Frame) -> tuple[float, list[float]]:
    """Give the deviation of disparity [px], and its correlation at each lag."""
    inverse = 1 / frame.depth_m
    usable = inverse.isfinite() & (frame.depth_m < _FARTHEST_M) & ~frame.is_object
    rest, on_plane = _beyond_plane(inverse, usable)
    kept = on_plane & (_mean(on_plane.double(), 9) > 0.98)
    share = _mean(on_plane.double(), 41).clamp(min=1e-6)
    local = _mean(torch.where(on_plane, rest, 0.0), 41) / share
    error_px = torch.where(kept, rest - local, torch.nan) * frame.focal_px * _BASELINE_M
    deviation_px = float(error_px[kept].std())
    alike = []
    for lag in _LAGS:
        pairs = ((error_px[:, :-lag], error_px[:, lag:]), (error_px[:-lag], error_px[lag:]))
        products = torch.cat([(a * b).flatten() for a, b in pairs])
        alike.append(float(products.nanmean()) / deviation_px**2)
    return deviation_px, alike


def _beyond_plane(inverse: Tensor, usable: Tensor) -> tuple[Tensor, Tensor]:
    """Fit the plane that most pixels lie on; inverse depth is linear in the pixel there."""
    height, width = inverse.shape
    rows, columns = torch.arange(height) / height - 0.5, torch.arange(width) / width - 0.5
    grid = torch.stack([*torch.meshgrid(rows, columns, indexing="ij"), torch.ones_like(inverse)], 2)
    grid, places = grid.double(), usable.nonzero()
    generator, best, most = torch.Generator().manual_seed(0), torch.zeros(3).double(), -1
    for _ in range(300):
        y, x = places[torch.randint(len(places), (3,), generator=generator)].unbind(1)
        found, failed = torch.linalg.solve_ex(grid[y, x], inverse[y, x])
        count = int((usable & ((grid @ found - inverse).abs() < 0.01)).sum())
        if int(failed) == 0 and count > most:
            best, most = found, count
    for _ in range(5):
        near = usable & ((grid @ best - inverse).abs() < 0.012)
        best = torch.linalg.lstsq(grid[near], inverse[near][:, None]).solution[:, 0]
    rest = inverse - grid @ best
    return rest, usable & (rest.abs() < 0.015)


def edges(frame: Frame) -> tuple[float, float]:
    """Give the shares of readings between two surfaces, and of pixels without one, at edges."""
    grown, shrunk = (_largest(x.double(), 7) for x in (frame.is_object, ~frame.is_object))
    border = (grown > 0) & (shrunk > 0)
    far = frame.depth_m.nan_to_num(0.0)
    near = torch.where(far > 0, far, torch.inf)
    high, low = _largest(far, 9), -_largest(-near, 9)
    jump = high - low
    at_edge = border & (jump > 0.03) & (jump < 0.5)
    is_read = at_edge & (far > 0)
    between = is_read & (far > low + 0.25 * jump) & (far < high - 0.25 * jump)
    return float(between.sum() / is_read.sum()), float(1 - is_read.sum() / at_edge.sum())


def bend_of_planes(frame: Frame) -> tuple[float, float]:
    """Give the bend [m] that 80 % of the means on wide planes stay below, and two deviations."""
    focal_px = frame.focal_px
    height, width = frame.depth_m.shape
    K = torch.tensor([[focal_px, 0, width / 2], [0, focal_px, height / 2], [0, 0, 1]])
    prepared = prepare_frame(frame.depth_m.float(), K)
    is_plane = prepared.background_limit_m > 0
    is_plane = is_plane.repeat_interleave(prepared.step, 0).repeat_interleave(prepared.step, 1)
    inner = torch.zeros(height, width, dtype=torch.bool)  # a line across stays on the plane
    inner[14:-14, 14:-14] = grow_mask(is_plane[:height, :width], -14)[14:-14, 14:-14]
    generator = np.random.default_rng(0)
    middles = inner.nonzero().numpy()
    middles = middles[generator.integers(len(middles), size=6000)].T
    angle_rad = generator.uniform(0, 2 * np.pi, 6000)
    toward = np.stack([np.sin(angle_rad), np.cos(angle_rad)]) * generator.uniform(8, 13, 6000)
    inverse = 1 / _mean_depth(frame.depth_m.float().numpy(), 5)
    places = [middles + np.rint(times * toward).astype(int) for times in _ACROSS]
    across = np.stack([inverse[row, column] for row, column in places])
    depth_m = 1 / inverse[middles[0], middles[1]]
    bend_m = np.abs(_OFF_LINE @ across).max(0) * depth_m**2
    white_std_m = prepared.noise_per_m2 * float(np.nanmedian(depth_m)) ** 2
    limit_m = _MEETING * math.hypot(AVERAGED_PER_WHITE * white_std_m, FLAT_M)
    return float(np.nanquantile(bend_m, 0.8)), limit_m


def _mean(values: Tensor, size: int) -> Tensor:
    return F.avg_pool2d(values[None, None], size, 1, size // 2, count_include_pad=False)[0, 0]


def _largest(values: Tensor, size: int) -> Tensor:
    return F.max_pool2d(values[None, None], size, 1, size // 2)[0, 0]


def row_of(frame: Frame) -> dict[str, str]:
    """Measure a frame for the table."""
    deviation_px, alike = noise_of_plane(frame)
    between, lost = edges(frame)
    bend_m, limit_m = bend_of_planes(frame)
    return {
        "frame": frame.name,
        "noise [px]": f"{deviation_px:.3f}",
        **{f"alike at {lag} px": f"{value:.2f}" for lag, value in zip(_LAGS, alike, strict=True)},
        "between": f"{between:.1%}",
        "lost": f"{lost:.0%}",
        "bend [mm]": f"{1000 * bend_m:.2f}",
        "two deviations [mm]": f"{1000 * limit_m:.2f}",
    }


def main() -> None:
    """Print the table."""
    frames = real_frames(Path(os.environ["DEPTHPOSE_DATA"]))
    kinect, realsense = frames[0], frames[-1]
    kinds: list[tuple[SensorKind, float | None, Frame]] = [
        ("structured light", None, kinect),
        ("structured light", 3.0, kinect),
        ("active stereo", None, realsense),
        ("time of flight", None, kinect),
    ]
    every = [*frames, *(synthetic_frame(*kind) for kind in kinds)]
    print(markdown_table([row_of(frame) for frame in every]))


if __name__ == "__main__":
    main()
