"""Depth of real pairs and of single real images by the default weights, beside OpenCV's SGBM.

Sections ``indoor``, ``streets`` and ``image`` of ``bench/real.py``. SGBM is given the largest true
disparity of each pair, and its holes are filled. D1 is the share of pixels off by more than 3 px
and 5 %; AbsRel is that of Eigen's protocol (camera z of one LiDAR scan, Garg crop, up to 80 m). No
weights were trained on these images and nothing was chosen by them, so all are held.
"""

from collections.abc import Sequence
from functools import cache, partial
from pathlib import Path

import torch
from indoor import BANDS_PX, SGBM, largest_px, match_sgbm, pair_errors, read_indoor_pair
from score import Job, Row, Section
from shared import group_rows, mean_of, with_cpu_seconds

from depthpose import FakestereoNet
from depthpose.depth.datasets import open_dataset, read_true_depth
from depthpose.depth.metrics import SMALLEST_DEPTH_M, garg_crop, measure
from depthpose.depth.types import DepthEstimate, DepthSample

OURS = "default"
CAP_M = 80.0
STREETS = "street_pairs/kitti2015_eval_drives"  # 25 pairs with LiDAR
SINGLE_IMAGES = (STREETS, "kitti_raw/2011_09_26/2011_09_26_drive_0052_sync")
ALL_BANDS_PX = (0, BANDS_PX[-1][1])


@cache
def network() -> FakestereoNet:
    """Load the weights once in a process."""
    return FakestereoNet.load(OURS, with_check=False)


def indoor_jobs(samples: Path, seeds: int) -> list[Job]:
    """Match each pair that is no street."""
    del seeds
    meta_files = sorted((samples / "depth/indoor").glob("*/meta.json"))
    return [partial(match_indoor, path.parent) for path in meta_files]


def match_indoor(folder: Path) -> list[Row]:
    """Match one pair by both methods."""
    sample = read_indoor_pair(folder)
    rows = list[Row]()
    for method, estimate, cpu_s in match_by_both(sample):
        facts = {"pair": folder.name, "largest_px": largest_px(sample), "method": method}
        errors = pair_errors(estimate, sample.truth)
        rows.append({**facts, **errors, "cpu_s": cpu_s})
    return rows


def match_by_both(sample: DepthSample) -> list[tuple[str, DepthEstimate, float]]:
    """Match a pair by SGBM and by ours; return method, estimate and CPU seconds of each."""
    net = network()
    sgbm, sgbm_s = with_cpu_seconds(lambda: match_sgbm(sample))
    ours, ours_s = with_cpu_seconds(lambda: net.estimate_input(sample.input))
    return [(SGBM, sgbm, sgbm_s), (OURS, ours, ours_s)]


def indoor_table(rows: Sequence[Row]) -> list[Row]:
    """Average by the largest disparity, and over all."""
    lines = list[Row]()
    for band_px in (*BANDS_PX, ALL_BANDS_PX):
        low_px, high_px = band_px
        band_name = "all" if band_px == ALL_BANDS_PX else f"from {low_px} px"
        band_rows = [row for row in rows if low_px <= row["largest_px"] < high_px]
        for method in (OURS, SGBM):
            method_rows = [row for row in band_rows if row["method"] == method]
            if not method_rows:
                continue
            lines.append(
                {
                    "largest disparity, method": f"{band_name}, {method}",
                    "use": "held",
                    "pairs": len(method_rows),
                    "D1 %": 100 * mean_of(method_rows, "D1"),
                    "off by twice %": 100 * mean_of(method_rows, "off by twice"),
                    "median relative %": 100 * mean_of(method_rows, "median relative"),
                    "CPU s": mean_of(method_rows, "cpu_s"),
                }
            )
    return lines


def street_jobs(samples: Path, seeds: int) -> list[Job]:
    """Match each pair of streets."""
    del seeds
    folder = samples / "depth" / STREETS
    return [partial(match_street, folder, index) for index in range(len(open_dataset(folder)))]


def match_street(folder: Path, index: int) -> list[Row]:
    """Match one pair of streets by both methods."""
    dataset = open_dataset(folder)
    sample = dataset[index]
    truth_m = read_true_depth(dataset, index)
    truth_px = sample.truth.disparity_px
    assert truth_m is not None
    assert truth_px is not None
    has_truth = truth_px.isfinite()
    rows = list[Row]()
    for method, estimate, cpu_s in match_by_both(sample):
        disparity_px = estimate.disparity_px.nan_to_num(0.0)
        errors = measure("disparity", disparity_px[has_truth], truth_px[has_truth])
        rows.append(
            {
                "pair": sample.input.name,
                "method": method,
                "D1": errors["d1_all"],
                "AbsRel": abs_rel(estimate, truth_m),
                "cpu_s": cpu_s,
            }
        )
    return rows


def street_table(rows: Sequence[Row]) -> list[Row]:
    """Average over the pairs of each method."""
    lines = list[Row]()
    for method in (OURS, SGBM):
        method_rows = [row for row in rows if row["method"] == method]
        lines.append(
            {
                "method": method,
                "use": "held",
                "pairs": len(method_rows),
                "D1 %": 100 * mean_of(method_rows, "D1"),
                "AbsRel": mean_of(method_rows, "AbsRel"),
                "CPU s": mean_of(method_rows, "cpu_s"),
            }
        )
    return lines


def image_jobs(samples: Path, seeds: int) -> list[Job]:
    """Estimate each left image of the streets alone."""
    del seeds
    jobs = list[Job]()
    for name in SINGLE_IMAGES:
        folder = samples / "depth" / name
        jobs += [
            partial(estimate_image, folder, index) for index in range(len(open_dataset(folder)))
        ]
    return jobs


def estimate_image(folder: Path, index: int) -> list[Row]:
    """Estimate the depth of one image."""
    dataset = open_dataset(folder)
    image = dataset[index].input
    camera = image.camera
    truth_m = read_true_depth(dataset, index)
    if truth_m is None:
        return []
    assert camera is not None
    net = network()
    estimate, cpu_s = with_cpu_seconds(lambda: net.estimate(image.left, camera))
    facts = {"set": folder.name, "image": image.name}
    return [{**facts, "AbsRel": abs_rel(estimate, truth_m), "cpu_s": cpu_s}]


def image_table(rows: Sequence[Row]) -> list[Row]:
    """Average over the images of each set."""
    return [
        {
            "set": name,
            "use": "held",
            "images": len(set_rows),
            "AbsRel": mean_of(set_rows, "AbsRel"),
            "CPU s": mean_of(set_rows, "cpu_s"),
        }
        for (name,), set_rows in group_rows(rows, "set").items()
    ]


def abs_rel(estimate: DepthEstimate, truth_m: torch.Tensor) -> float:
    """Measure depth by Eigen's protocol; where there is no estimate, as in the sky, it is 80 m."""
    assert estimate.depth_m is not None
    has_truth = (truth_m > SMALLEST_DEPTH_M) & (truth_m < CAP_M)
    is_measured = has_truth & garg_crop(*truth_m.shape)
    depth_m = estimate.depth_m.nan_to_num(CAP_M).clamp(SMALLEST_DEPTH_M, CAP_M)
    return measure("depth", depth_m[is_measured], truth_m[is_measured])["abs_rel"]


INDOOR = Section("Pairs that are no streets, beside SGBM", indoor_jobs, indoor_table)
STREET_PAIRS = Section("Pairs of streets, beside SGBM", street_jobs, street_table)
IMAGES = Section("One image of a street", image_jobs, image_table)
