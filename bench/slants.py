"""How depth errors grow with the slant of a surface: real objects at their estimated poses.

    python bench/slants.py SAMPLES

Instances of YCB objects and two bottles by their exact masks, and elbows in three of the bins that
may take part in a choice, all seen by RealSenses. Residuals are means over 5x5 readings, away from
edges, minus the depth of the posed model. Printed for each range of slants: their deviation
(computed by the median, which a few dents change little), and the sideways shift in pixels of the
depth image that explains the growth since the least slanted surface.
"""

import math
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy import ndimage
from score_instances import EXACT, arguments_of, cases, registration_of
from score_scenes import bins_of, part_of
from shared import make_parser

from depthpose import Registration
from depthpose.core.rigid import Rigid
from depthpose.pose.geometry.rendering import render_surface
from depthpose.pose.geometry.surface import Surface
from depthpose.pose.types import PoseEstimate, ViewInput
from depthpose.pose.verify import evidence, hypotheses
from depthpose.pose.verify.evidence import Observation
from depthpose.report.page import format_markdown_table

TANGENTS = (0.0, 0.4, 0.8, 1.2, 1.7, 2.3, 3.2)  # of the angle between ray and normal
MAX_RESIDUAL_M = 0.03  # readings farther off the model show something else
MIN_FILLED = 0.5  # share of readings in the square of a mean
MIN_MEANS = 300  # of a range of slants
MEDIAN_TO_DEVIATION = 1.4826  # of a normal distribution
MIN_COSINE = 0.15
SETS = ("ycb", "bottle")
BINS = 3


class Residuals(NamedTuple):
    """Mean residuals [m], tangents of the slant, and widths of a pixel on the surface [m]."""

    mean_m: np.ndarray
    tangent: np.ndarray
    pixel_m: np.ndarray


Compared = tuple[Observation, Rigid, Surface]


def main() -> None:
    """Print a table of each kind of object."""
    parser = make_parser(__doc__)
    parser.add_argument("samples", type=Path)
    samples: Path = parser.parse_args().samples

    compared: list[Compared] = []

    def remember(observation: Observation, pose: Rigid, surface: Surface) -> evidence.Evidence:
        compared.append((observation, pose, surface))
        return evidence.compare(observation, pose, surface)

    hypotheses.compare = remember
    for name in SETS:
        measured = list(of_masks(samples, name, compared))
        print(f"\n{name}: {len(measured)} instances\n\n{format_markdown_table(rows_of(measured))}")
    measured = list(of_bins(samples / "pose/bins", compared))
    print(f"\nelbows: {len(measured)} instances\n\n{format_markdown_table(rows_of(measured))}")


def of_masks(samples: Path, kind: str, compared: list[Compared]) -> Iterator[Residuals]:
    """Measure the instances of one kind by their exact masks."""
    for name, case in cases(samples).items():
        if name.split()[0] != kind or not isinstance(case.sample.input, ViewInput):
            continue
        compared.clear()
        estimate = registration_of(samples, name).estimate(**arguments_of(case, EXACT))
        yield from of_estimates([estimate], compared)


def of_bins(home: Path, compared: list[Compared]) -> Iterator[Residuals]:
    """Measure the elbows that are found in some bins."""
    for scene in bins_of(home, "elbows")[::2][:BINS]:
        registration: Registration = part_of(scene.parent)[0]
        compared.clear()
        answers = registration.find(scene / "depth.png", scene / "camera.json")
        estimates = [estimate for estimate in answers if estimate.is_posed]
        yield from of_estimates(estimates, compared)


def of_estimates(estimates: list[PoseEstimate], compared: list[Compared]) -> Iterator[Residuals]:
    """Measure each estimate by the observation that its pose was compared with."""
    for estimate in estimates:
        if estimate.camera_from_model is None:
            continue
        pose = estimate.camera_from_model.double()
        matrix = pose.matrix()
        distances = [float((other.matrix().double() - matrix).norm()) for _, other, _ in compared]
        observation, _, surface = compared[distances.index(min(distances))]
        yield residuals(observation, pose, surface)


def residuals(observation: Observation, pose: Rigid, surface: Surface) -> Residuals:
    """Average the readings minus the posed surface over squares, as evidence does."""
    K = observation.K
    drawn_m, cosine, window = render_surface(surface, pose, K, *observation.depth_m.shape)
    step = observation.step
    inner = evidence._without_edges(drawn_m, np.isfinite(drawn_m), surface.diameter_m, step)
    residual_m = observation.depth_m[window] - drawn_m
    is_used = inner & (np.abs(np.nan_to_num(residual_m, nan=np.inf)) < MAX_RESIDUAL_M)
    side = evidence._averaged_side(step)
    filled = ndimage.uniform_filter(is_used.astype(np.float32), side)
    used_m = np.where(is_used, residual_m, 0).astype(np.float32)
    average_m = ndimage.uniform_filter(used_m, side)
    has_mean = inner & (filled > MIN_FILLED)
    return Residuals(
        mean_m=average_m[has_mean] / filled[has_mean],
        tangent=np.sqrt(1 / np.clip(cosine[has_mean], MIN_COSINE, 1) ** 2 - 1),
        pixel_m=drawn_m[has_mean] / (float(K[0, 0]) * step),
    )


def rows_of(measured: list[Residuals]) -> list[dict[str, str]]:
    """Compute the deviation for each range of slants, and the shift that explains its growth."""
    mean_m = np.concatenate([each.mean_m for each in measured])
    tangent = np.concatenate([each.tangent for each in measured])
    pixel_m = np.concatenate([each.pixel_m for each in measured])
    rows: list[dict[str, str]] = []
    least_slanted_m: float | None = None
    for low, high in pairwise(TANGENTS):
        in_range = (tangent >= low) & (tangent < high)
        if in_range.sum() < MIN_MEANS:
            continue
        deviation_m = MEDIAN_TO_DEVIATION * float(np.median(np.abs(mean_m[in_range])))
        if least_slanted_m is None:
            least_slanted_m = deviation_m
        growth_m = math.sqrt(max(deviation_m**2 - least_slanted_m**2, 0))
        growth_of_1_px_m = float(np.median(tangent[in_range]) * np.median(pixel_m[in_range]))
        rows.append(
            {
                "tangent": f"{low} to {high}",
                "means": str(int(in_range.sum())),
                "deviation [mm]": f"{1000 * deviation_m:.2f}",
                "shift [px]": f"{growth_m / growth_of_1_px_m:.2f}",
            }
        )
    return rows


if __name__ == "__main__":
    main()
