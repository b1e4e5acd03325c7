"""How much more readings are off on slanted surfaces: real objects at their estimated poses.

    python bench/slants.py SAMPLES

Instances of YCB objects and two bottles by their exact masks, and elbows in three of the bins that
may take part in a choice, all before RealSenses. Residuals are means over 5x5 readings, away from
edges, less the posed model, along the optical axis. For each range of slants: their deviation (by
the median, so that a few dents count little), and the shift across the axis, in pixels of the depth
image, that explains by how much it is larger than that of the least slanted surface.
"""

import argparse
import math
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy import ndimage
from score_instances import EXACT, arguments_of, cases, registration_of
from score_scenes import bins_of, part_of

from depthpose import Registration
from depthpose.core.rigid import Rigid
from depthpose.pose import evidence, hypotheses
from depthpose.pose.evidence import Observation
from depthpose.pose.rendering import render_surface
from depthpose.pose.surface import Surface
from depthpose.pose.types import PoseEstimate, ViewInput
from depthpose.report.page import markdown_table

TANGENTS = (0.0, 0.4, 0.8, 1.2, 1.7, 2.3, 3.2)  # of the angle between ray and normal
FARTHEST_M = 0.03  # off the model: of something else
FILLED = 0.5  # of a mean's square
FEWEST = 300
MEDIAN_TO_DEVIATION = 1.4826
SETS = ("ycb", "bottle")
BINS = 3


class Residuals(NamedTuple):
    """Means of residuals [m], tangents of the slant, and the size of a pixel there [m]."""

    mean_m: np.ndarray
    tangent: np.ndarray
    pixel_m: np.ndarray


Compared = tuple[Observation, Rigid, Surface]


def main() -> None:
    """Print a table of each kind of object."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("samples", type=Path)
    samples: Path = parser.parse_args().samples

    compared: list[Compared] = []

    def remember(observation: Observation, pose: Rigid, surface: Surface) -> evidence.Evidence:
        compared.append((observation, pose, surface))
        return evidence.compare(observation, pose, surface)

    hypotheses.compare = remember
    for name in SETS:
        measured = list(of_masks(samples, name, compared))
        print(f"\n{name}: {len(measured)} instances\n\n{markdown_table(rows_of(measured))}")
    measured = list(of_bins(samples / "pose/bins", compared))
    print(f"\nelbows: {len(measured)} instances\n\n{markdown_table(rows_of(measured))}")


def of_masks(samples: Path, kind: str, compared: list[Compared]) -> Iterator[Residuals]:
    """Measure the instances of one kind by their exact masks."""
    for name, case in cases(samples).items():
        if name.split()[0] != kind or not isinstance(case.sample.input, ViewInput):
            continue
        compared.clear()
        estimate = registration_of(samples, name).estimate(**arguments_of(case, EXACT))
        yield from of_estimates([estimate], compared)


def of_bins(home: Path, compared: list[Compared]) -> Iterator[Residuals]:
    """Measure what is found in some bins of elbows."""
    for scene in bins_of(home, "elbows")[::2][:BINS]:
        registration: Registration = part_of(scene.parent)[0]
        compared.clear()
        found = registration.find(scene / "depth.png", scene / "camera.json")
        yield from of_estimates(found, compared)


def of_estimates(estimates: list[PoseEstimate], compared: list[Compared]) -> Iterator[Residuals]:
    """Measure each estimate by the observation that its pose was compared with."""
    for estimate in estimates:
        if estimate.camera_from_model is None:
            continue
        pose = estimate.camera_from_model.double()
        observation, _, surface = min(
            compared,
            key=lambda other: float((other[1].matrix().double() - pose.matrix()).norm()),
        )
        yield residuals(observation, pose, surface)


def residuals(observation: Observation, pose: Rigid, surface: Surface) -> Residuals:
    """Average the readings less the posed surface over squares, as evidence does."""
    K = observation.K
    drawn_m, cosine, window = render_surface(surface, pose, K, *observation.depth_m.shape)
    step = observation.step
    inner = evidence._without_edges(drawn_m, np.isfinite(drawn_m), surface.diameter_m, step)
    residual_m = observation.depth_m[window] - drawn_m
    is_used = inner & (np.abs(np.nan_to_num(residual_m, nan=np.inf)) < FARTHEST_M)
    side = evidence._averaged_side(step)
    filled = ndimage.uniform_filter(is_used.astype(np.float32), side)
    sum_m = ndimage.uniform_filter(np.where(is_used, residual_m, 0).astype(np.float32), side)
    has_mean = inner & (filled > FILLED)
    return Residuals(
        mean_m=sum_m[has_mean] / filled[has_mean],
        tangent=np.sqrt(1 / np.clip(cosine[has_mean], 0.15, 1) ** 2 - 1),
        pixel_m=drawn_m[has_mean] / (float(K[0, 0]) * step),
    )


def rows_of(measured: list[Residuals]) -> list[dict[str, str]]:
    """Give the deviation for each range of slants, and the shift that explains its growth."""
    mean_m = np.concatenate([each.mean_m for each in measured])
    tangent = np.concatenate([each.tangent for each in measured])
    pixel_m = np.concatenate([each.pixel_m for each in measured])
    rows: list[dict[str, str]] = []
    least_m: float | None = None
    for low, high in pairwise(TANGENTS):
        is_here = (tangent >= low) & (tangent < high)
        if is_here.sum() < FEWEST:
            continue
        deviation_m = MEDIAN_TO_DEVIATION * float(np.median(np.abs(mean_m[is_here])))
        least_m = deviation_m if least_m is None else least_m
        grown_m = math.sqrt(max(deviation_m**2 - least_m**2, 0))
        shift_px = grown_m / float(np.median(tangent[is_here]) * np.median(pixel_m[is_here]))
        rows.append({
            "tangent": f"{low} to {high}", "means": str(int(is_here.sum())),
            "deviation [mm]": f"{1000 * deviation_m:.2f}", "shift [px]": f"{shift_px:.2f}",
        })  # fmt: skip
    return rows


if __name__ == "__main__":
    main()
