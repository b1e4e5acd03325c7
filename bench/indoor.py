"""Real pairs that are no streets, and Middlebury's Motorcycle: ours beside OpenCV's SGBM.

    python bench/indoor.py SAMPLES/depth/indoor [--weights default] [--speed fine] [--out FILE]
    python bench/indoor.py --near near_held      # scenes of 'depthpose data make near'
    python bench/indoor.py --wide 20             # scenes of 640 to 1920 columns, by disparity

SGBM is given the largest true disparity of each pair, its holes are filled; ours is given the
images and, where it is known, the camera. Methods alternate, pair by pair, in one process. Errors
are of disparity, at every pixel with truth: D1 (off by more than 3 px and 5 %), off by more than a
factor of two, the median relative error; of depth where the camera is known.

``--wide`` sorts the pixels of synthetic pairs by their true disparity, and says how many lie beyond
what was searched and how sure the answer is there: with the range that is measured, and with half
of the largest disparity as ``max_disparity_px``.
"""

import argparse
import time
from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import torch

from depthpose.core.camera import StereoRig
from depthpose.core.camera.pinhole import intrinsics
from depthpose.core.files import read_image, read_json, write_json
from depthpose.demo import read_motorcycle
from depthpose.depth.config import MatcherConfig, NearConfig, SGBMConfig
from depthpose.depth.datasets import open_dataset, read_disparity
from depthpose.depth.disparity import depth_from_disparity
from depthpose.depth.estimator import FakestereoNet
from depthpose.depth.stereo import SGBMMatcher
from depthpose.depth.stereo.matcher import NetworkMatcher
from depthpose.depth.stereo.search_range import choose_search_range, measure_disparity_range
from depthpose.depth.synthetic import draw_near
from depthpose.depth.types import DepthEstimate, StereoInput, StereoSample, StereoTruth
from depthpose.report.page import markdown_table

BANDS_PX = ((0, 50), (50, 70), (70, 100), (100, 100_000))
"""Of the largest true disparity of a pair."""
SGBM = "SGBM, told the range"


def read_indoor_pair(home: Path) -> StereoSample:
    """Read one pair of the indoor samples; its camera where focal length and doffs are known."""
    left, right = (read_image(home / f"{side}.png") for side in ("left", "right"))
    facts = read_json(home / "meta.json")
    assert isinstance(facts, dict)
    height, width = left.shape[1:]
    known = (facts.get(key) for key in ("focal_px", "baseline_m", "doffs"))
    focal_px, baseline_m, apart_px = known
    rig = depth_m = None
    disparity_px = read_disparity(home / "disparity.png")
    if focal_px and baseline_m and apart_px is not None:
        # No principal point is given; depth does not depend on it.
        K = intrinsics(focal_px, focal_px, (width - 1) / 2, (height - 1) / 2)
        rig = StereoRig(
            width=width, height=height, K=K, baseline_m=baseline_m, cx_right_minus_left_px=apart_px
        )
        depth_m = depth_from_disparity(disparity_px, rig)
    return StereoSample(
        input=StereoInput(name=home.name, left=left, right=right, camera=rig),
        truth=StereoTruth(disparity_px=disparity_px, depth_m=depth_m),
    )


def indoor_samples(folder: Path | None, *, with_motorcycle: bool = True) -> Iterator[StereoSample]:
    """Give the indoor pairs of a folder, and Motorcycle from scikit-image."""
    homes = [] if folder is None else sorted(path.parent for path in folder.glob("*/meta.json"))
    for home in homes:
        yield read_indoor_pair(home)
    motorcycle = read_motorcycle() if with_motorcycle else None
    if motorcycle is not None:
        yield motorcycle


def largest_px(sample: StereoSample) -> float:
    """Give the largest true disparity of a pair [px]."""
    truth_px = sample.truth.disparity_px
    assert truth_px is not None
    return float(truth_px[truth_px.isfinite()].max())


def match_sgbm(sample: StereoSample) -> DepthEstimate:
    """Match a pair by SGBM with the range of its truth."""
    pair = sample.input
    assert pair.right is not None
    reach = 16 * (int(largest_px(sample)) // 16 + 1)
    matcher = SGBMMatcher(SGBMConfig(num_disparities=reach, with_filled_holes=True))
    disparity_px = matcher.match(pair.left, pair.right).disparity_px
    rig = pair.camera if isinstance(pair.camera, StereoRig) else None
    depth_m = None if rig is None else depth_from_disparity(disparity_px, rig)
    return DepthEstimate(depth_m=depth_m, disparity_px=disparity_px, input=pair)


def pair_errors(found: DepthEstimate, truth: StereoTruth) -> dict[str, float]:
    """Measure the disparity of a pair, and its depth where both are known."""
    truth_px, found_px = truth.disparity_px, found.disparity_px
    assert truth_px is not None
    assert found_px is not None
    known = truth_px.isfinite() & (truth_px > 0)
    true_px, answer_px = truth_px[known], found_px[known].nan_to_num(0.0).clamp(min=1e-3)
    error_px = (answer_px - true_px).abs()
    ratio = answer_px / true_px
    errors = {
        "D1": float(((error_px > 3) & (error_px > 0.05 * true_px)).float().mean()),
        "off by twice": float(((ratio > 2) | (ratio < 0.5)).float().mean()),
        "median relative": float((error_px / true_px).median()),
        "EPE": float(error_px.mean()),
    }
    if found.depth_m is not None and truth.depth_m is not None:
        seen = truth.depth_m.isfinite() & found.depth_m.isfinite()
        error_m = (found.depth_m - truth.depth_m)[seen].abs()
        if bool(seen.any()):
            errors["AbsRel"] = float((error_m / truth.depth_m[seen]).mean())
            errors["RMSE"] = float(error_m.square().mean().sqrt())
    if found.confidence is not None:
        wrong = error_px > 0.05 * true_px.clamp(min=60)
        sure = found.confidence[known]
        for what, part in (("wrong", sure[wrong]), ("right", sure[~wrong])):
            if len(part):
                errors[f"confidence where {what}"] = float(part.mean())
    return errors


Result = dict[str, float | str]


def compare(samples: Iterable[StereoSample], net: FakestereoNet, name: str) -> list[Result]:
    """Match every pair by both methods, and measure."""
    results: list[Result] = []
    for sample in samples:
        for method in (SGBM, name):
            began = time.perf_counter()
            if method == SGBM:
                found = match_sgbm(sample)
            else:
                found = net.estimate_pair(sample.input, with_check=False)
            seconds = time.perf_counter() - began
            errors = pair_errors(found, sample.truth)
            results.append({
                "pair": sample.input.name, "method": method, "largest": largest_px(sample),
                **errors, "seconds": seconds,
            })  # fmt: skip
        pairs = zip(results[-2:], ("SGBM", "ours"), strict=True)
        said = (f"{who} D1 {100 * float(r['D1']):.1f} %, twice {100 * float(r['off by twice']):.1f}"
                for r, who in pairs)  # fmt: skip
        print(f"{sample.input.name} ({largest_px(sample):.0f} px): {'; '.join(said)}", flush=True)
    return results


def band_rows(results: list[Result]) -> list[dict[str, str]]:
    """Average over the pairs of each band, and over all."""
    rows: list[dict[str, str]] = []
    methods = list(dict.fromkeys(str(result["method"]) for result in results))
    for low, high in (*BANDS_PX, (0, 100_000)):
        for method in methods:
            chosen = [
                r for r in results if r["method"] == method and low <= float(r["largest"]) < high
            ]
            if not chosen:
                continue
            mean = {
                key: sum(float(r[key]) for r in chosen) / len(chosen)
                for key in ("D1", "off by twice", "median relative", "seconds")
            }
            band = "all" if (low, high) == (0, 100_000) else f"{low} to {high}"
            rows.append({
                "largest disparity [px]": band.replace("100 to 100000", "over 100"),
                "pairs": str(len(chosen)), "method": method,
                "D1": f"{100 * mean['D1']:.1f} %",
                "off by twice": f"{100 * mean['off by twice']:.2f} %",
                "median relative": f"{100 * mean['median relative']:.2f} %",
                "seconds": f"{mean['seconds']:.2f}",
            })  # fmt: skip
    return rows


WIDTHS_PX = (640, 960, 1280, 1600, 1920)
PIXEL_BANDS_PX = (0, 5, 25, 50, 100, 200, 400, 600)
"""Of the true disparity of a pixel."""
MEASURED, HALVED = "measured", "halved"
"""What is searched: what was measured, or up to half of the largest disparity."""


def wide_samples(number: int, seed: int) -> Iterator[StereoSample]:
    """Draw near scenes of several widths, with disparities up to 600 px."""
    for index in range(number):
        width = WIDTHS_PX[index % len(WIDTHS_PX)]
        share = min(0.6, PIXEL_BANDS_PX[-1] / width)
        config = NearConfig(seed=seed, columns_px=(width, width), largest_share=share)
        frame = draw_near(config, index)
        yield StereoSample(
            input=StereoInput(
                name=f"{index} {width}x{frame.left.shape[1]}",
                left=frame.left,
                right=frame.right,
                camera=frame.rig,
            ),
            truth=StereoTruth(disparity_px=frame.disparity_px, depth_m=frame.depth_m),
        )


def last_searched_px(net: FakestereoNet, pair: StereoInput) -> float:
    """Give the largest disparity that is searched in a pair [px]."""
    assert isinstance(net.matcher, NetworkMatcher)
    assert pair.right is not None
    measured = measure_disparity_range(net.matcher, pair.left, pair.right, 0.0)
    search = choose_search_range(net.matcher, measured, pair.left.shape[1:], pair.camera)
    return search.last_in_images_px


def match_wide(samples: Iterable[StereoSample], net: FakestereoNet) -> list[Result]:
    """Match every pair with the range that is measured and with half of it; measure by band."""
    assert isinstance(net.matcher, NetworkMatcher)
    results: list[Result] = []
    for sample in samples:
        truth_px = sample.truth.disparity_px
        assert truth_px is not None
        known = truth_px.isfinite() & (truth_px > 0)
        true_px = truth_px[known]
        for what in (MEASURED, HALVED):
            most = None if what == MEASURED else max(1, int(largest_px(sample) / 2))
            net.matcher.config = replace(net.matcher.config, max_disparity_px=most)
            last_px = last_searched_px(net, sample.input)
            began = time.process_time()
            found = net.estimate_pair(sample.input, with_check=False)
            seconds = time.process_time() - began
            assert found.disparity_px is not None
            assert found.confidence is not None
            answer_px = found.disparity_px[known].nan_to_num(0.0)
            sure = found.confidence[known]
            error_px = (answer_px - true_px).abs()
            ratio = answer_px / true_px
            is_beyond = true_px > last_px
            for low, high in pairwise(PIXEL_BANDS_PX):
                of_band = (true_px >= low) & (true_px < high)
                if not bool(of_band.any()):
                    continue
                bad = (error_px > 3) & (error_px > 0.05 * true_px)
                twice = (ratio > 2) | (ratio < 0.5)
                results.append({
                    "pair": sample.input.name, "searched": what, "low": low, "high": high,
                    "pixels": int(of_band.sum()),
                    "EPE": float(error_px[of_band].mean()),
                    "D1": float(bad[of_band].float().mean()),
                    "off by twice": float(twice[of_band].float().mean()),
                    "relative": float((error_px / true_px)[of_band].mean()),
                    "beyond": float(is_beyond[of_band].float().mean()),
                    "beyond and sure": float((is_beyond & (sure > 0.1))[of_band].float().mean()),
                    "confidence": float(sure[of_band].mean()),
                })  # fmt: skip
            share = float(is_beyond.float().mean())
            print(
                f"{sample.input.name}, {largest_px(sample):.0f} px, {what}: "
                f"searched to {last_px:.0f} px, {share:.2%} beyond, of these with a confidence "
                f"over 0.1 {float((sure[is_beyond] > 0.1).float().mean()) if share else 0:.2%}; "
                f"{seconds:.1f} s of a processor; {found.warning}",
                flush=True,
            )
    net.matcher.config = replace(net.matcher.config, max_disparity_px=None)
    return results


def pixel_rows(results: list[Result]) -> list[dict[str, str]]:
    """Average over all pixels of each band of disparities."""
    rows: list[dict[str, str]] = []
    for what in (MEASURED, HALVED):
        of_search = [r for r in results if r["searched"] == what]
        for low, high in pairwise(PIXEL_BANDS_PX):
            chosen = [r for r in of_search if r["low"] == low]
            count = sum(float(r["pixels"]) for r in chosen)
            if not chosen:
                continue
            mean = {
                key: sum(float(r[key]) * float(r["pixels"]) for r in chosen) / count
                for key in ("EPE", "D1", "off by twice", "relative", "beyond", "beyond and sure",
                            "confidence")
            }  # fmt: skip
            rows.append({
                "searched": what, "disparity [px]": f"{low} to {high}", "pairs": str(len(chosen)),
                "EPE [px]": f"{mean['EPE']:.2f}", "D1": f"{100 * mean['D1']:.1f} %",
                "off by twice": f"{100 * mean['off by twice']:.2f} %",
                "mean relative": f"{100 * mean['relative']:.1f} %",
                "beyond": f"{100 * mean['beyond']:.2f} %",
                "beyond, confidence over 0.1": f"{100 * mean['beyond and sure']:.3f} %",
                "mean confidence": f"{mean['confidence']:.2f}",
            })  # fmt: skip
    return rows


def main() -> None:
    """Print a table of bands and one of the pairs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--near", type=Path)
    parser.add_argument("--wide", type=int, help="so many synthetic pairs of 640 to 1920 columns")
    parser.add_argument("--seed", type=int, default=57, help="of --wide")
    parser.add_argument("--weights", default="default")
    parser.add_argument("--speed", default="fine", choices=["quick", "fine"])
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    torch.set_num_threads(given.threads)
    net = FakestereoNet.load(given.weights, config=MatcherConfig(speed=given.speed))
    if given.wide is not None:
        results = match_wide(wide_samples(given.wide, given.seed), net)
        print(markdown_table(pixel_rows(results)))
        if given.out is not None:
            write_json(given.out, results)
        return
    samples = indoor_samples(given.folder, with_motorcycle=given.near is None)
    if given.near is not None:
        dataset = open_dataset(given.near)
        samples = (dataset[index] for index in range(len(dataset)))
    results = compare(samples, net, f"{given.weights}, {given.speed}")
    print(markdown_table(band_rows(results)))
    depth = [r for r in results if "AbsRel" in r]
    print(markdown_table([
        {"pair": str(r["pair"]), "method": str(r["method"]), "AbsRel": f"{r['AbsRel']:.4f}",
         "RMSE [m]": f"{r['RMSE']:.3f}"} for r in depth
    ]))  # fmt: skip
    if given.out is not None:
        write_json(given.out, results)


if __name__ == "__main__":
    main()
