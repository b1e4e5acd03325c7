"""Depth of real pairs and of single real images by the default weights, beside OpenCV's SGBM.

SGBM is told the largest disparity of each pair, and its holes are filled. D1 is the share of the
pixels off by more than 3 px and 5 %; AbsRel is that of Eigen's protocol (camera z of one LiDAR
scan, Garg crop, up to 80 m). No weights were trained on these images and nothing was chosen by
them, so all are held.
"""

import time
from collections.abc import Sequence
from functools import cache, partial
from pathlib import Path

import torch
from indoor import BANDS_PX, SGBM, largest_px, match_sgbm, pair_errors, read_indoor_pair
from score import Job, Row, Section

from depthpose import FakestereoNet
from depthpose.depth.datasets import open_dataset, read_known_depth
from depthpose.depth.metrics import SMALLEST_DEPTH_M, garg_crop, measure
from depthpose.depth.types import DepthEstimate, StereoSample

OURS = "default"
CAP_M = 80.0
STREETS = "street_pairs/kitti2015_eval_drives"  # 25 pairs with LiDAR
ONE_IMAGE = (STREETS, "kitti_raw/2011_09_26/2011_09_26_drive_0052_sync")


@cache
def network() -> FakestereoNet:
    """Load the weights once in a process."""
    return FakestereoNet.load("default")


def indoor_jobs(samples: Path, seeds: int) -> list[Job]:
    """Match each pair that is no street."""
    del seeds
    return [partial(match_indoor, path.parent)
            for path in sorted((samples / "depth/indoor").glob("*/meta.json"))]  # fmt: skip


def match_indoor(home: Path) -> list[Row]:
    """Match one pair by both methods."""
    sample = read_indoor_pair(home)
    facts = {"pair": home.name, "largest_px": largest_px(sample)}
    return [{**facts, "method": method, **pair_errors(found, sample.truth), "cpu_s": cpu_s}
            for method, found, cpu_s in matched(sample)]  # fmt: skip


def matched(sample: StereoSample) -> list[tuple[str, DepthEstimate, float]]:
    """Match a pair by SGBM and by ours; give the CPU seconds of each."""
    began = time.process_time()
    peer = match_sgbm(sample)
    between = time.process_time()
    ours = network().estimate_pair(sample.input, with_check=False)
    ended = time.process_time()
    return [(SGBM, peer, between - began), (OURS, ours, ended - between)]


def indoor_table(rows: Sequence[Row]) -> list[Row]:
    """Take means by the largest disparity, and over all."""
    lines = list[Row]()
    for low, high in (*BANDS_PX, (0, BANDS_PX[-1][1])):
        band = [row for row in rows if low <= row["largest_px"] < high]
        name = "all" if (low, high) == (0, BANDS_PX[-1][1]) else f"from {low} px"
        for method in (OURS, SGBM):
            some = [row for row in band if row["method"] == method]
            if some:
                lines.append({
                    "largest disparity, method": f"{name}, {method}", "use": "held",
                    "pairs": len(some),
                    "D1 %": 100 * mean(some, "D1"),
                    "off by twice %": 100 * mean(some, "off by twice"),
                    "median relative %": 100 * mean(some, "median relative"),
                    "CPU s": mean(some, "cpu_s"),
                })  # fmt: skip
    return lines


def street_jobs(samples: Path, seeds: int) -> list[Job]:
    """Match each pair of streets."""
    del seeds
    number = len(open_dataset(samples / "depth" / STREETS))
    return [partial(match_street, samples / "depth" / STREETS, index) for index in range(number)]


def match_street(folder: Path, index: int) -> list[Row]:
    """Match one pair of streets by both methods."""
    dataset = open_dataset(folder)
    sample = dataset[index]
    truth_m = read_known_depth(dataset, index)
    truth_px = sample.truth.disparity_px
    assert truth_m is not None
    assert truth_px is not None
    known = truth_px.isfinite()
    rows = list[Row]()
    for method, found, cpu_s in matched(sample):
        disparity_px = found.disparity_px.nan_to_num(0.0)
        errors = measure("disparity", disparity_px[known], truth_px[known])
        rows.append({
            "pair": sample.input.name, "method": method, "D1": errors["d1_all"],
            "AbsRel": abs_rel(found, truth_m), "cpu_s": cpu_s,
        })  # fmt: skip
    return rows


def street_table(rows: Sequence[Row]) -> list[Row]:
    """Take means of each method."""
    lines = list[Row]()
    for method in (OURS, SGBM):
        some = [row for row in rows if row["method"] == method]
        lines.append({
            "method": method, "use": "held", "pairs": len(some), "D1 %": 100 * mean(some, "D1"),
            "AbsRel": mean(some, "AbsRel"), "CPU s": mean(some, "cpu_s"),
        })  # fmt: skip
    return lines


def image_jobs(samples: Path, seeds: int) -> list[Job]:
    """Estimate each left image of the streets alone."""
    del seeds
    return [partial(estimate_image, samples / "depth" / folder, index)
            for folder in ONE_IMAGE
            for index in range(len(open_dataset(samples / "depth" / folder)))]  # fmt: skip


def estimate_image(folder: Path, index: int) -> list[Row]:
    """Estimate the depth of one image."""
    dataset = open_dataset(folder)
    given = dataset[index].input
    truth_m = read_known_depth(dataset, index)
    if truth_m is None:
        return []
    assert given.camera is not None
    began = time.process_time()
    found = network().estimate(given.left, given.camera)
    cpu_s = time.process_time() - began
    row = {"set": folder.name, "image": given.name, "AbsRel": abs_rel(found, truth_m)}
    return [row | {"cpu_s": cpu_s}]


def image_table(rows: Sequence[Row]) -> list[Row]:
    """Take means of each set."""
    lines = list[Row]()
    for name in dict.fromkeys(row["set"] for row in rows):
        some = [row for row in rows if row["set"] == name]
        lines.append({
            "set": name, "use": "held", "images": len(some), "AbsRel": mean(some, "AbsRel"),
            "CPU s": mean(some, "cpu_s"),
        })  # fmt: skip
    return lines


def abs_rel(found: DepthEstimate, truth_m: torch.Tensor) -> float:
    """Measure depth as Eigen's protocol does; where there is none, as in the sky, it is the cap."""
    assert found.depth_m is not None
    counts = (truth_m > SMALLEST_DEPTH_M) & (truth_m < CAP_M) & garg_crop(*truth_m.shape)
    predicted_m = found.depth_m.nan_to_num(CAP_M).clamp(SMALLEST_DEPTH_M, CAP_M)
    return measure("depth", predicted_m[counts], truth_m[counts])["abs_rel"]


def mean(rows: Sequence[Row], column: str) -> float:
    """Average a column; NaN of no rows."""
    return sum(row[column] for row in rows) / len(rows) if rows else float("nan")


INDOOR = Section("Pairs that are no streets, beside SGBM", indoor_jobs, indoor_table)
STREET_PAIRS = Section("Pairs of streets, beside SGBM", street_jobs, street_table)
IMAGES = Section("One image of a street", image_jobs, image_table)
