"""Accuracy over time of matchers on real pairs: ours at both speeds beside OpenCV's SGBM.

    python bench/matchers.py [--data PAIRS] [--weights default kitti-nc] [--number 25] [--threads 2]

Without --data the only pair is Middlebury's Motorcycle, from scikit-image's package. SGBM is given
the largest true disparity of each pair, ours are not. Methods alternate, pair by pair, in
one process, so their ratios are valid on a busy machine too.
"""

import argparse
import time
from collections.abc import Iterator, Mapping
from pathlib import Path

import torch

from depthpose.core.arrays import take_evenly
from depthpose.core.camera import StereoRig
from depthpose.demo import read_motorcycle
from depthpose.depth.config import MatcherConfig, SGBMConfig
from depthpose.depth.datasets import open_dataset
from depthpose.depth.estimator import FakestereoNet
from depthpose.depth.types import StereoSample
from depthpose.report.page import markdown_table

SGBM = "SGBM, holes filled"
LIMITS_PX = (1.0, 2.0, 3.0)


def samples(data: Path | None, number: int) -> Iterator[StereoSample]:
    """Give pairs with true disparity, spread evenly over a data set."""
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
        f"{name}, {speed}": FakestereoNet.load(name, config=MatcherConfig(speed=speed))
        for name in names
        for speed in ("quick", "fine")
    }
    return {SGBM: FakestereoNet.load(matcher="sgbm"), **ours}


def sgbm_for(sample: StereoSample) -> FakestereoNet:
    """Build SGBM with the range of a pair."""
    truth_px = sample.truth.disparity_px
    assert truth_px is not None
    camera = sample.input.camera
    apart_px = camera.cx_right_minus_left_px if isinstance(camera, StereoRig) else 0.0
    reach_px = float(truth_px[truth_px.isfinite()].max()) + max(apart_px, 0.0)
    reach = 16 * (int(reach_px) // 16 + 1)
    config = SGBMConfig(num_disparities=reach, with_filled_holes=True)
    return FakestereoNet.load(matcher="sgbm", config=config)


def measure(net: FakestereoNet, sample: StereoSample) -> dict[str, float]:
    """Match a pair: its errors, and the seconds of this processor."""
    truth_px = sample.truth.disparity_px
    assert truth_px is not None
    began, spent = time.perf_counter(), time.process_time()
    found_px = net.estimate_pair(sample.input, with_check=False).disparity_px
    seconds = {"wall": time.perf_counter() - began, "cpu": time.process_time() - spent}
    known = truth_px.isfinite() & (truth_px > 0)
    error_px = (found_px - truth_px).abs()[known].nan_to_num(torch.inf)
    shares = {f"off by {px:g} px": float((error_px > px).float().mean()) for px in LIMITS_PX}
    wrong = (error_px > 3) & (error_px > 0.05 * truth_px[known])
    return {
        "EPE": float(error_px.mean()), "D1": float(wrong.float().mean()), **shares, **seconds
    }  # fmt: skip


def row(name: str, found: list[dict[str, float]], peer: list[dict[str, float]]) -> dict[str, str]:
    """Average over pairs; times beside the peer's."""
    mean = {key: sum(one[key] for one in found) / len(found) for key in found[0]}
    ratio = sum(one["cpu"] for one in found) / sum(one["cpu"] for one in peer)
    percents: Mapping[str, str] = {
        key: f"{100 * value:.1f} %" for key, value in mean.items() if key[0] in "Do"
    }
    return {
        "method": name, "EPE": f"{mean['EPE']:.2f}", **percents,
        "seconds": f"{mean['wall']:.2f}", "CPU time / SGBM": f"{ratio:.1f}",
    }  # fmt: skip


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path)
    parser.add_argument("--weights", nargs="*", default=["default"])
    parser.add_argument("--number", type=int, default=25)
    parser.add_argument("--threads", type=int, default=2)
    given = parser.parse_args()
    torch.set_num_threads(given.threads)
    nets = make_nets(given.weights)
    found: dict[str, list[dict[str, float]]] = {name: [] for name in nets}
    for number, sample in enumerate(samples(given.data, given.number)):
        nets[SGBM] = sgbm_for(sample)
        if number == 0:
            for net in nets.values():
                net.estimate_pair(
                    sample.input, with_check=False
                )  # the first match makes what later ones reuse
        for name, net in nets.items():
            found[name].append(measure(net, sample))
    peer = found[SGBM]
    print(markdown_table([row(name, each, peer) for name, each in found.items()]))


if __name__ == "__main__":
    main()
