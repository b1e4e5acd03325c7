"""Accuracy over time of matchers on real pairs: ours at both speeds beside OpenCV's SGBM.

    python bench/matchers.py [--data PAIRS] [--weights default kitti-nc] [--number 25] [--threads 2]

Without --data the only pair is Middlebury's Motorcycle, from scikit-image's package. SGBM is given
the largest true disparity of each pair, ours are not. Methods alternate, pair by pair, in one
process, so that their ratios are valid on a busy machine too.
"""

import time
from collections.abc import Iterator
from pathlib import Path

import torch
from indoor import is_outlier
from shared import make_parser, mean_of

from depthpose.core.arrays import take_evenly
from depthpose.core.camera import StereoRig
from depthpose.demo import read_motorcycle
from depthpose.depth.config import MatcherConfig, SGBMConfig
from depthpose.depth.datasets import open_dataset
from depthpose.depth.estimator import FakestereoNet
from depthpose.depth.stereo import SGBMMatcher
from depthpose.depth.types import DepthSample
from depthpose.report.page import format_markdown_table

SGBM = "SGBM, holes filled"
LIMITS_PX = (1.0, 2.0, 3.0)


def samples(data: Path | None, number: int) -> Iterator[DepthSample]:
    """Read pairs with true disparity, spread evenly over a dataset."""
    if data is None:
        motorcycle = read_motorcycle()
        assert motorcycle is not None, "pip install -e '.[demo]'"
        yield motorcycle
        return
    dataset = open_dataset(data)
    for index in take_evenly(torch.arange(len(dataset)), number).tolist():
        yield dataset[index]


def make_nets(names: list[str]) -> dict[str, FakestereoNet]:
    """Build every method."""
    ours = {
        f"{name}, {speed}": FakestereoNet.load(
            name, config=MatcherConfig(speed=speed), with_check=False
        )
        for name in names
        for speed in ("quick", "fine")
    }
    return {SGBM: FakestereoNet.load(matcher="sgbm", with_check=False), **ours}


def sgbm_for(sample: DepthSample) -> FakestereoNet:
    """Build SGBM with the range of a pair."""
    truth_px = sample.truth.disparity_px
    assert truth_px is not None
    camera = sample.input.camera
    doffs_px = camera.cx_right_minus_left_px if isinstance(camera, StereoRig) else 0.0
    largest_px = float(truth_px[truth_px.isfinite()].max()) + max(doffs_px, 0.0)
    num_disparities = 16 * (int(largest_px) // 16 + 1)
    config = SGBMConfig(num_disparities=num_disparities, with_filled_holes=True)
    return FakestereoNet(SGBMMatcher(config), with_check=False)


def measure(net: FakestereoNet, sample: DepthSample) -> dict[str, float]:
    """Match a pair; return its errors, wall time and CPU time."""
    truth_px = sample.truth.disparity_px
    assert truth_px is not None
    start_s = time.perf_counter()
    start_cpu_s = time.process_time()
    disparity_px = net.estimate_input(sample.input).disparity_px
    wall_s = time.perf_counter() - start_s
    cpu_s = time.process_time() - start_cpu_s
    has_truth = truth_px.isfinite() & (truth_px > 0)
    error_px = (disparity_px - truth_px).abs()[has_truth].nan_to_num(torch.inf)
    wrong = is_outlier(error_px, truth_px[has_truth])
    return {
        "EPE": float(error_px.mean()),
        "D1": float(wrong.float().mean()),
        **{off_by(limit_px): float((error_px > limit_px).float().mean()) for limit_px in LIMITS_PX},
        "wall": wall_s,
        "cpu": cpu_s,
    }


def off_by(limit_px: float) -> str:
    """Name the share of pixels whose error is larger than a limit."""
    return f"off by {limit_px:g} px"


def table_row(
    name: str, pairs: list[dict[str, float]], sgbm_pairs: list[dict[str, float]]
) -> dict[str, str]:
    """Average over pairs, and compare the CPU time with SGBM's."""
    ratio = sum(pair["cpu"] for pair in pairs) / sum(pair["cpu"] for pair in sgbm_pairs)
    shares = ("D1", *map(off_by, LIMITS_PX))
    return {
        "method": name,
        "EPE": f"{mean_of(pairs, 'EPE'):.2f}",
        **{share: f"{100 * mean_of(pairs, share):.1f} %" for share in shares},
        "seconds": f"{mean_of(pairs, 'wall'):.2f}",
        "CPU time / SGBM": f"{ratio:.1f}",
    }


def main() -> None:
    """Print the table."""
    parser = make_parser(__doc__)
    parser.add_argument("--data", type=Path)
    parser.add_argument("--weights", nargs="*", default=["default"])
    parser.add_argument("--number", type=int, default=25)
    parser.add_argument("--threads", type=int, default=2)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    nets = make_nets(options.weights)
    results: dict[str, list[dict[str, float]]] = {name: [] for name in nets}
    for index, sample in enumerate(samples(options.data, options.number)):
        nets[SGBM] = sgbm_for(sample)
        if index == 0:  # the first match prepares what later ones reuse
            for net in nets.values():
                net.estimate_input(sample.input)
        for name, net in nets.items():
            results[name].append(measure(net, sample))
    table = [table_row(name, pairs, results[SGBM]) for name, pairs in results.items()]
    print(format_markdown_table(table))


if __name__ == "__main__":
    main()
