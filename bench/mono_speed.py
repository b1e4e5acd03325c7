"""Depth from one 375x1242 image: seconds, peak memory and operations of each stage.

    python bench/mono_speed.py [--weights default] [--precision fp32 bf16] [--device cpu]

The shipped weights, and a network of full width with random weights, on which time does not depend.
Stages, memory and operations are those of the quick speed; ``fine_s`` is the total at the fine one.
Each set runs in a process of its own, so that its peak memory is its own.
"""

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from shared import (
    least_seconds,
    make_parser,
    peak_growth_bytes,
    report,
    setting,
    with_cpu_seconds,
)
from stereo_speed import peak_flops
from torch.utils.flop_counter import FlopCounterMode

from depthpose.core.camera import StereoRig, camera_of
from depthpose.core.checkpoint import find_weights
from depthpose.depth.config import GeneratorConfig, MatcherConfig, Speed
from depthpose.depth.disparity import resize_image, size_at_focal_length
from depthpose.depth.estimator import FakestereoNet
from depthpose.depth.generators import UNetGenerator
from depthpose.depth.stereo import (
    NetworkMatcher,
    PSMNet,
    PSMNetMatcher,
    match_in_usual_range,
)
from depthpose.depth.synthesis import make_synthesiser
from depthpose.depth.types import DepthInput
from depthpose.depth.weights import MATCHERS
from depthpose.report.page import format_markdown_table

HEIGHT, WIDTH, FOCAL_PX = 375, 1242, 721.5377


def make_net(weights: str, config: MatcherConfig) -> FakestereoNet:
    """Load a set by name, or build the network of full width."""
    if weights != "full":
        return FakestereoNet.load(find_weights(weights), config=config, allow_ood=True)
    torch.manual_seed(0)
    generator = UNetGenerator(GeneratorConfig()).eval()
    return FakestereoNet(
        PSMNetMatcher(PSMNet().eval(), config), make_synthesiser(generator, config.device)
    )


def street() -> DepthInput:
    """Make an image of KITTI's size, of noise: time does not depend on what it shows."""
    K = torch.tensor([[FOCAL_PX, 0, 609.6], [0, FOCAL_PX, 172.9], [0, 0, 1]], dtype=torch.float64)
    rig = StereoRig(width=WIDTH, height=HEIGHT, K=K, baseline_m=0.5327)
    image = torch.rand(3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(0))
    return DepthInput(name="street", left=image, right=None, camera=rig)


def warm_seconds(run: Callable[[], object], device: str) -> float:
    """Measure the least time of three runs after one to warm up [s]."""

    def run_and_wait() -> None:
        run()
        if device != "cpu":
            torch.cuda.synchronize()

    run_and_wait()
    return least_seconds(run_and_wait, 3)


def count_flops(run: Callable[[], object]) -> int:
    """Count the operations of a call of a network."""
    with FlopCounterMode(display=False) as counter:
        run()
    return counter.get_total_flops()


def matcher_flops(net: FakestereoNet, height: int, width: int) -> int:
    """Count operations of the plain matcher at this size, without computing anything."""
    assert isinstance(net.matcher, NetworkMatcher)
    config = net.matcher.network_config
    kind = next(kind for kind in MATCHERS.values() if isinstance(config, kind.config))
    step = config.step_px
    rows, columns = (max(config.min_side_px, -(-side // step) * step) for side in (height, width))
    with torch.device("meta"):
        network = kind.network(config).eval()
        left, right = torch.empty(2, 1, 3, rows, columns)
        return count_flops(lambda: network(left, right))


def uses_matcher(net: FakestereoNet) -> bool:
    """Whether depth from one image uses the matcher."""
    assert net.synthesiser is not None
    config = net.synthesiser.config
    return isinstance(config, GeneratorConfig) or config.answer != "own"


def run_once(weights: str, precision: str, device: str) -> dict[str, object]:
    """Measure one set in this process."""
    arguments: Any = {"precision": precision, "device": device}
    image = street()
    net = make_net(weights, MatcherConfig(**arguments, speed="quick"))
    start_s = time.perf_counter()
    memory = peak_growth_bytes(lambda: net.estimate_input(image))
    first_s = time.perf_counter() - start_s
    if device != "cpu":
        memory = torch.cuda.max_memory_allocated()
    quick_s = warm_seconds(lambda: net.estimate_input(image), device)
    fine_net = make_net(weights, MatcherConfig(**arguments))
    fine_s = warm_seconds(lambda: fine_net.estimate_input(image), device)

    assert net.synthesiser is not None
    assert image.camera is not None
    draw = net.synthesiser.synthesise
    size = size_at_focal_length(image.camera, net.synthesiser.config.virtual_focal_px)
    left = resize_image(image.left, *size)
    right = draw(left[None]).right[0]
    draw_s = warm_seconds(lambda: draw(left[None]), device)
    draw_flops = count_flops(lambda: draw(left[None]))
    match_s = 0.0
    match_flops = 0
    matcher = net.matcher
    if matcher is not None and uses_matcher(net):
        camera = camera_of(net.synthesiser.config.virtual_focal_px, (size[1], size[0]))
        match_s = warm_seconds(lambda: match_in_usual_range(matcher, left, right, camera), device)
        match_flops = matcher_flops(net, *size)

    share_of_peak = None
    if device == "cpu":
        peak = peak_flops(torch.bfloat16 if precision == "bf16" else torch.float32)
        share_of_peak = (draw_flops + match_flops) / quick_s / peak
    return {
        "set": weights,
        "precision": precision,
        "seconds": quick_s,
        "fine_s": fine_s,
        "first_s": first_s,
        "draw_s": draw_s,
        "match_s": match_s,
        "memory_mb": memory / 1e6,
        "draw_gflop": draw_flops / 1e9,
        "match_gflop": match_flops / 1e9,
        "share_of_peak": share_of_peak,
    }


def compare(names: list[str], runs: int = 6) -> list[dict[str, object]]:
    """Measure the least processor time of sets that alternate in one process, on one thread."""
    torch.set_num_threads(1)
    image = street()
    speeds: tuple[Speed, ...] = ("quick", "fine")
    nets = {
        (name, speed): make_net(name, MatcherConfig(speed=speed))
        for name in names
        for speed in speeds
    }
    times_s: dict[tuple[str, str], list[float]] = {key: [] for key in nets}
    for _ in range(runs):
        for key, net in nets.items():
            _, cpu_s = with_cpu_seconds(lambda net=net: net.estimate_input(image))
            times_s[key].append(cpu_s)
    return [
        {"set": Path(name).stem, "speed": speed, "processor_s": min(times)}
        for (name, speed), times in times_s.items()
    ]


def main() -> None:
    """Run each set of weights in a separate process and print a table."""
    parser = make_parser(__doc__)
    parser.add_argument("--weights", nargs="+", default=["default", "full"])
    parser.add_argument("--precision", nargs="+", default=["fp32", "bf16"])
    parser.add_argument("--device", default="cpu")
    parser.add_argument(
        "--compare", nargs="+", metavar="W", help="processor time of one thread, alternating runs"
    )
    parser.add_argument("--child", nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        weights, precision = options.child
        print(json.dumps(run_once(weights, precision, options.device)))
        return
    if options.compare:
        print(format_markdown_table(compare(options.compare)))
        return
    rows = []
    for weights in options.weights:
        for precision in options.precision:
            command = [sys.executable, __file__, "--device", options.device]
            command += ["--child", weights, precision]
            process = subprocess.run(command, check=True, capture_output=True, text=True)
            rows.append(json.loads(process.stdout.splitlines()[-1]))
    print(f"{setting()}, {WIDTH}x{HEIGHT}")
    report("mono_speed", rows)


if __name__ == "__main__":
    main()
