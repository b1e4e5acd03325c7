"""Peak memory of stereo matching, with a bound and without, each run in a process of its own.

python bench/stereo_memory.py [--size 375x1242] [--bound-mb 1000] [--weights F.tar]
"""

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import torch
from shared import make_parser, peak_growth_bytes, report, size_of
from stereo_speed import network_for, plain_match, random_pair

from depthpose.depth.config import MatcherConfig
from depthpose.depth.stereo import PSMNetMatcher
from depthpose.depth.stereo.psmnet import psmnet_bytes

PLAIN = 0  # in place of a bound: the plain network


def run_once(size: tuple[int, int], weights: Path | None, bound: int | None, out: Path) -> None:
    """Match once and write disparity and the rise of peak memory after loading."""
    network = network_for(weights)
    left, right = random_pair(size, torch.Generator().manual_seed(0))
    matcher = PSMNetMatcher(network, MatcherConfig(max_memory_bytes=bound or None))

    def match() -> None:
        if bound == PLAIN:
            disparity_px = plain_match(network, (left, right))
        else:
            disparity_px = matcher.match(left, right).disparity_px
        maps.append(disparity_px.numpy())

    maps: list[np.ndarray] = []
    activations = peak_growth_bytes(match)
    np.savez(out, disparity_px=maps[0], activations=activations)


def measure(
    size: tuple[int, int], weights: Path | None, bound: int | None
) -> tuple[np.ndarray, int]:
    """Run in a fresh process: memory kept from one run would mask that of the next."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run.npz"
        command = [sys.executable, __file__, "--size", f"{size[0]}x{size[1]}", "--child", str(out)]
        command += ["--weights", str(weights)] if weights else []
        command += ["--bound-mb", str(bound / 1e6)] if bound is not None else []
        subprocess.run(command, check=True)
        with np.load(out) as run:
            return run["disparity_px"], int(run["activations"])


def least_bytes(size: tuple[int, int], weights: Path | None) -> int:
    """Compute the least bound that is accepted."""
    config = network_for(weights).config
    height, width = (max(config.min_side_px, -(-side // 16) * 16) for side in size)
    return psmnet_bytes(config, config.max_disparity_px, height, width, torch.float32)


def main() -> None:
    """Print a table and write out/bench/stereo_memory.json."""
    parser = make_parser(__doc__)
    parser.add_argument("--size", nargs="+", default=["375x1242"])
    parser.add_argument("--bound-mb", type=float, default=1000)
    parser.add_argument("--weights", type=Path)
    parser.add_argument("--child", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        has_bound = "--bound-mb" in sys.argv
        bound = round(options.bound_mb * 1e6) if has_bound else None
        run_once(size_of(options.size[0]), options.weights, bound, options.child)
        return
    rows = [row for size in options.size for row in rows_of(size_of(size), options)]
    report("stereo_memory", rows)


def rows_of(size: tuple[int, int], options: argparse.Namespace) -> list[dict[str, object]]:
    """Measure the network as it is trained, then the matcher without a bound and with two.

    The unbounded matcher is compared with the plain network, the bounded ones with the unbounded.
    """
    plain_px, plain_peak = measure(size, options.weights, PLAIN)
    unbounded_px, unbounded_peak = measure(size, options.weights, None)
    rows: list[dict[str, object]] = []

    def add_row(bound: str | int, peak: int, difference_px: float) -> None:
        rows.append(
            {
                "size": f"{size[0]}x{size[1]}",
                "bound_mb": bound,
                "peak_mb": peak // 10**6,
                "max_px": difference_px,
            }
        )

    add_row("plain network", plain_peak, 0.0)
    add_row("none", unbounded_peak, float(np.abs(unbounded_px - plain_px).max()))
    for bound in (round(options.bound_mb * 1e6), least_bytes(size, options.weights)):
        disparity_px, peak = measure(size, options.weights, bound)
        difference_px = float(np.abs(disparity_px - unbounded_px).max())
        add_row(-(-bound // 10**6), peak, difference_px)
    return rows


if __name__ == "__main__":
    main()
