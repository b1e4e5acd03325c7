"""Real pairs that are no streets, and Middlebury's Motorcycle: ours beside OpenCV's SGBM.

    python bench/indoor.py SAMPLES/depth/indoor [--weights default] [--speed fine] [--out FILE]
    python bench/indoor.py --near near_held      # scenes of 'depthpose data make near'
    python bench/indoor.py --wide 20             # scenes of 640 to 1920 columns, by disparity

SGBM is given the largest true disparity of each pair, and its holes are filled; ours is given the
images and, where it is known, the camera. Methods alternate, pair by pair, in one process. Errors
are of disparity, at every pixel with truth: D1 (off by more than 3 px and 5 %), off by more than a
factor of two, the median relative error; and of depth where the camera is known.

``--wide`` groups the pixels of synthetic pairs by their true disparity. For each group it prints
the errors, the share of pixels whose disparity lies beyond the searched range, and the confidence
there: once with the range that is measured, once with half of the largest disparity as
``max_disparity_px``.
"""

import time
from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from shared import group_rows, make_parser, mean_of, with_cpu_seconds
from torch import Tensor

from depthpose.core.camera import StereoRig
from depthpose.core.camera.pinhole import intrinsics
from depthpose.core.files import read_image, read_json, write_json
from depthpose.demo import read_motorcycle
from depthpose.depth.config import MatcherConfig, NearConfig, SGBMConfig
from depthpose.depth.datasets import open_dataset, read_disparity
from depthpose.depth.disparity import depth_from_disparity
from depthpose.depth.estimator import FakestereoNet
from depthpose.depth.stereo import SGBMMatcher
from depthpose.depth.stereo.network_matcher import NetworkMatcher
from depthpose.depth.stereo.search_range import choose_search_range, measure_disparity_range
from depthpose.depth.synthetic import render_near
from depthpose.depth.types import DepthEstimate, DepthInput, DepthSample, DepthTruth
from depthpose.report.page import format_markdown_table

MAX_PX = 100_000
BANDS_PX = ((0, 50), (50, 70), (70, 100), (100, MAX_PX))
"""Of the largest true disparity of a pair."""
SGBM = "SGBM, told the range"
Result = dict[str, Any]


def read_indoor_pair(folder: Path) -> DepthSample:
    """Read one pair of the indoor samples; its camera where focal length and doffs are known."""
    left = read_image(folder / "left.png")
    right = read_image(folder / "right.png")
    disparity_px = read_disparity(folder / "disparity.png")
    meta = read_json(folder / "meta.json")
    assert isinstance(meta, dict)
    focal_px, baseline_m, doffs_px = (meta.get(key) for key in ("focal_px", "baseline_m", "doffs"))
    rig = depth_m = None
    if focal_px and baseline_m and doffs_px is not None:
        height, width = left.shape[1:]
        # No principal point is given; depth does not depend on it.
        K = intrinsics(focal_px, focal_px, (width - 1) / 2, (height - 1) / 2)
        rig = StereoRig(
            width=width, height=height, K=K, baseline_m=baseline_m, cx_right_minus_left_px=doffs_px
        )
        depth_m = depth_from_disparity(disparity_px, rig)
    return DepthSample(
        input=DepthInput(name=folder.name, left=left, right=right, camera=rig),
        truth=DepthTruth(disparity_px=disparity_px, depth_m=depth_m),
    )


def indoor_samples(folder: Path | None, *, with_motorcycle: bool = True) -> Iterator[DepthSample]:
    """Read the indoor pairs of a folder, and Motorcycle from scikit-image."""
    if folder is not None:
        for meta_file in sorted(folder.glob("*/meta.json")):
            yield read_indoor_pair(meta_file.parent)
    motorcycle = read_motorcycle() if with_motorcycle else None
    if motorcycle is not None:
        yield motorcycle


def largest_px(sample: DepthSample) -> float:
    """Compute the largest true disparity of a pair [px]."""
    truth_px = sample.truth.disparity_px
    assert truth_px is not None
    return float(truth_px[truth_px.isfinite()].max())


def match_sgbm(sample: DepthSample) -> DepthEstimate:
    """Match a pair by SGBM with the range of its truth."""
    pair = sample.input
    assert pair.right is not None
    num_disparities = 16 * (int(largest_px(sample)) // 16 + 1)
    matcher = SGBMMatcher(SGBMConfig(num_disparities=num_disparities, with_filled_holes=True))
    disparity_px = matcher.match(pair.left, pair.right).disparity_px
    rig = pair.camera if isinstance(pair.camera, StereoRig) else None
    depth_m = None if rig is None else depth_from_disparity(disparity_px, rig)
    return DepthEstimate(depth_m=depth_m, disparity_px=disparity_px, input=pair)


def is_outlier(error_px: Tensor, true_px: Tensor) -> Tensor:
    """Whether disparities count for D1: off by more than 3 px and 5 %."""
    return (error_px > 3) & (error_px > 0.05 * true_px)


def is_off_by_twice(disparity_px: Tensor, true_px: Tensor) -> Tensor:
    """Whether disparities are off by more than a factor of two."""
    ratio = disparity_px / true_px
    return (ratio > 2) | (ratio < 0.5)


def pair_errors(estimate: DepthEstimate, truth: DepthTruth) -> dict[str, float]:
    """Measure the disparity of a pair, and its depth where both are known."""
    assert truth.disparity_px is not None
    assert estimate.disparity_px is not None
    has_truth = truth.disparity_px.isfinite() & (truth.disparity_px > 0)
    true_px = truth.disparity_px[has_truth]
    disparity_px = estimate.disparity_px[has_truth].nan_to_num(0.0).clamp(min=1e-3)
    error_px = (disparity_px - true_px).abs()
    errors = {
        "D1": float(is_outlier(error_px, true_px).float().mean()),
        "off by twice": float(is_off_by_twice(disparity_px, true_px).float().mean()),
        "median relative": float((error_px / true_px).median()),
        "EPE": float(error_px.mean()),
    }
    if estimate.depth_m is not None and truth.depth_m is not None:
        is_measured = truth.depth_m.isfinite() & estimate.depth_m.isfinite()
        error_m = (estimate.depth_m - truth.depth_m)[is_measured].abs()
        if bool(is_measured.any()):
            errors["AbsRel"] = float((error_m / truth.depth_m[is_measured]).mean())
            errors["RMSE"] = float(error_m.square().mean().sqrt())
    if estimate.confidence is not None:
        confidence = estimate.confidence[has_truth]
        is_wrong = error_px > 0.05 * true_px.clamp(min=60)
        if bool(is_wrong.any()):
            errors["confidence where wrong"] = float(confidence[is_wrong].mean())
        if not bool(is_wrong.all()):
            errors["confidence where right"] = float(confidence[~is_wrong].mean())
    return errors


def compare(samples: Iterable[DepthSample], net: FakestereoNet, name: str) -> list[Result]:
    """Match every pair by both methods, and measure."""
    results: list[Result] = []
    for sample in samples:
        reports = []
        for method in (SGBM, name):
            start_s = time.perf_counter()
            estimate = match_sgbm(sample) if method == SGBM else net.estimate_input(sample.input)
            wall_s = time.perf_counter() - start_s
            result = {
                "pair": sample.input.name,
                "method": method,
                "largest": largest_px(sample),
                **pair_errors(estimate, sample.truth),
                "seconds": wall_s,
            }
            results.append(result)
            reports.append(
                f"{'SGBM' if method == SGBM else 'ours'} D1 {100 * result['D1']:.1f} %, "
                f"twice {100 * result['off by twice']:.1f}"
            )
        print(f"{sample.input.name} ({largest_px(sample):.0f} px): {'; '.join(reports)}",
              flush=True)  # fmt: skip
    return results


def band_rows(results: list[Result]) -> list[dict[str, str]]:
    """Average over the pairs of each band, and over all."""
    rows: list[dict[str, str]] = []
    for low, high in (*BANDS_PX, (0, MAX_PX)):
        band = f"over {low}" if high == MAX_PX else f"{low} to {high}"
        if (low, high) == (0, MAX_PX):
            band = "all"
        for (method,), method_results in group_rows(results, "method").items():
            pairs = [result for result in method_results if low <= result["largest"] < high]
            if not pairs:
                continue
            rows.append(
                {
                    "largest disparity [px]": band,
                    "pairs": str(len(pairs)),
                    "method": method,
                    "D1": f"{100 * mean_of(pairs, 'D1'):.1f} %",
                    "off by twice": f"{100 * mean_of(pairs, 'off by twice'):.2f} %",
                    "median relative": f"{100 * mean_of(pairs, 'median relative'):.2f} %",
                    "seconds": f"{mean_of(pairs, 'seconds'):.2f}",
                }
            )
    return rows


def depth_rows(results: list[Result]) -> list[dict[str, str]]:
    """List the errors of depth of the pairs whose camera is known."""
    return [
        {
            "pair": result["pair"],
            "method": result["method"],
            "AbsRel": f"{result['AbsRel']:.4f}",
            "RMSE [m]": f"{result['RMSE']:.3f}",
        }
        for result in results
        if "AbsRel" in result
    ]


WIDTHS_PX = (640, 960, 1280, 1600, 1920)
PIXEL_BANDS_PX = (0, 5, 25, 50, 100, 200, 400, 600)
"""Of the true disparity of a pixel."""
MEASURED, HALVED = "measured", "halved"
"""The searched range: as it is measured, or up to half of the largest disparity."""
SURE = 0.1  # confidence of a disparity beyond the searched range that is wrongly sure


def wide_samples(number: int, seed: int) -> Iterator[DepthSample]:
    """Draw near scenes of several widths, with disparities up to 600 px."""
    for index in range(number):
        width = WIDTHS_PX[index % len(WIDTHS_PX)]
        share = min(0.6, PIXEL_BANDS_PX[-1] / width)
        config = NearConfig(seed=seed, columns_px=(width, width), largest_share=share)
        frame = render_near(config, index)
        yield DepthSample(
            input=DepthInput(
                name=f"{index} {width}x{frame.left.shape[1]}",
                left=frame.left,
                right=frame.right,
                camera=frame.rig,
            ),
            truth=DepthTruth(disparity_px=frame.disparity_px, depth_m=frame.depth_m),
        )


def last_searched_px(net: FakestereoNet, pair: DepthInput) -> float:
    """Compute the largest disparity that is searched in a pair [px]."""
    assert isinstance(net.matcher, NetworkMatcher)
    assert pair.right is not None
    measured = measure_disparity_range(net.matcher, pair.left, pair.right, 0.0)
    search = choose_search_range(net.matcher, measured, pair.left.shape[1:], pair.camera)
    return search.end_in_images_px


def match_wide(samples: Iterable[DepthSample], net: FakestereoNet) -> list[Result]:
    """Match every pair with the range that is measured and with half of it; measure by band."""
    assert isinstance(net.matcher, NetworkMatcher)
    results: list[Result] = []
    for sample in samples:
        truth_px = sample.truth.disparity_px
        assert truth_px is not None
        has_truth = truth_px.isfinite() & (truth_px > 0)
        true_px = truth_px[has_truth]
        for searched in (MEASURED, HALVED):
            max_px = None if searched == MEASURED else max(1, int(largest_px(sample) / 2))
            net.matcher.config = replace(net.matcher.config, max_disparity_px=max_px)
            last_px = last_searched_px(net, sample.input)
            estimate, cpu_s = with_cpu_seconds(lambda pair=sample.input: net.estimate_input(pair))
            assert estimate.disparity_px is not None
            assert estimate.confidence is not None
            disparity_px = estimate.disparity_px[has_truth].nan_to_num(0.0)
            confidence = estimate.confidence[has_truth]
            is_beyond = true_px > last_px
            facts = {"pair": sample.input.name, "searched": searched}
            bands = band_errors(disparity_px, true_px, confidence, is_beyond)
            results += [{**facts, **band} for band in bands]
            share = float(is_beyond.float().mean())
            sure_share = float((confidence[is_beyond] > SURE).float().mean()) if share else 0
            print(
                f"{sample.input.name}, {largest_px(sample):.0f} px, {searched}: "
                f"searched to {last_px:.0f} px, {share:.2%} beyond, of these with a confidence "
                f"over {SURE} {sure_share:.2%}; "
                f"{cpu_s:.1f} s of a processor; {estimate.warning}",
                flush=True,
            )
    net.matcher.config = replace(net.matcher.config, max_disparity_px=None)
    return results


def band_errors(
    disparity_px: Tensor, true_px: Tensor, confidence: Tensor, is_beyond: Tensor
) -> Iterator[Result]:
    """Measure the pixels of each band of true disparities."""
    error_px = (disparity_px - true_px).abs()
    wrong = is_outlier(error_px, true_px)
    off_by_twice = is_off_by_twice(disparity_px, true_px)
    sure_beyond = is_beyond & (confidence > SURE)
    for low, high in pairwise(PIXEL_BANDS_PX):
        in_band = (true_px >= low) & (true_px < high)
        if not bool(in_band.any()):
            continue
        yield {
            "low": low,
            "high": high,
            "pixels": int(in_band.sum()),
            "EPE": float(error_px[in_band].mean()),
            "D1": float(wrong[in_band].float().mean()),
            "off by twice": float(off_by_twice[in_band].float().mean()),
            "relative": float((error_px / true_px)[in_band].mean()),
            "beyond": float(is_beyond[in_band].float().mean()),
            "beyond and sure": float(sure_beyond[in_band].float().mean()),
            "confidence": float(confidence[in_band].mean()),
        }


def pixel_rows(results: list[Result]) -> list[dict[str, str]]:
    """Average over all pixels of each band of disparities."""
    measures = ("EPE", "D1", "off by twice", "relative", "beyond", "beyond and sure", "confidence")
    rows: list[dict[str, str]] = []
    for searched in (MEASURED, HALVED):
        for low, high in pairwise(PIXEL_BANDS_PX):
            pairs = [
                result
                for result in results
                if result["searched"] == searched and result["low"] == low
            ]
            if not pairs:
                continue
            pixels = sum(pair["pixels"] for pair in pairs)
            mean = {
                name: sum(pair[name] * pair["pixels"] for pair in pairs) / pixels
                for name in measures
            }
            rows.append(
                {
                    "searched": searched,
                    "disparity [px]": f"{low} to {high}",
                    "pairs": str(len(pairs)),
                    "EPE [px]": f"{mean['EPE']:.2f}",
                    "D1": f"{100 * mean['D1']:.1f} %",
                    "off by twice": f"{100 * mean['off by twice']:.2f} %",
                    "mean relative": f"{100 * mean['relative']:.1f} %",
                    "beyond": f"{100 * mean['beyond']:.2f} %",
                    "beyond, confidence over 0.1": f"{100 * mean['beyond and sure']:.3f} %",
                    "mean confidence": f"{mean['confidence']:.2f}",
                }
            )
    return rows


def main() -> None:
    """Print a table of bands and one of the pairs."""
    parser = make_parser(__doc__)
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--near", type=Path)
    parser.add_argument("--wide", type=int, help="so many synthetic pairs of 640 to 1920 columns")
    parser.add_argument("--seed", type=int, default=57, help="of --wide")
    parser.add_argument("--weights", default="default")
    parser.add_argument("--speed", default="fine", choices=["quick", "fine"])
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    net = FakestereoNet.load(
        options.weights, config=MatcherConfig(speed=options.speed), with_check=False
    )
    if options.wide is not None:
        results = match_wide(wide_samples(options.wide, options.seed), net)
        print(format_markdown_table(pixel_rows(results)))
    else:
        samples = indoor_samples(options.folder, with_motorcycle=options.near is None)
        if options.near is not None:
            dataset = open_dataset(options.near)
            samples = (dataset[index] for index in range(len(dataset)))
        results = compare(samples, net, f"{options.weights}, {options.speed}")
        print(format_markdown_table(band_rows(results)))
        print(format_markdown_table(depth_rows(results)))
    if options.out is not None:
        write_json(options.out, results)


if __name__ == "__main__":
    main()
