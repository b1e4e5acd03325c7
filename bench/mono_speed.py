"""Depth from one 375x1242 image: seconds, peak memory and operations of each stage.

    python bench/mono_speed.py [--weights default] [--precision fp32 bf16] [--device cpu]

The shipped weights and those of full width (random weights: time does not depend on them). Stages,
memory and operations are of the quick speed, ``fine_s`` is the whole at the fine one.
Each runs in a separate process, so that peak memory is measured separately.
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
from shared import least_seconds, peak_growth_bytes, report, setting
from stereo_speed import peak_flops
from torch.utils.flop_counter import FlopCounterMode

from depthpose.core.camera import StereoRig
from depthpose.core.checkpoint import find_weights
from depthpose.depth.config import GeneratorConfig, MatcherConfig, Speed
from depthpose.depth.disparity import resize_image, size_at_focal_length
from depthpose.depth.estimator import FakestereoNet
from depthpose.depth.stereo import NetworkMatcher, PSMNet, PSMNetMatcher
from depthpose.depth.synthesis import UNetGenerator, make_synthesiser
from depthpose.depth.types import StereoInput
from depthpose.depth.weights import MATCHERS
from depthpose.report.page import markdown_table

HEIGHT, WIDTH, FOCAL_PX = 375, 1242, 721.5377


def make_net(weights: str, config: MatcherConfig) -> FakestereoNet:
    """Load a set by name, or build the full width."""
    if weights != "full":
        return FakestereoNet.load(find_weights(weights), config=config, allow_ood=True)
    torch.manual_seed(0)
    generator = UNetGenerator(GeneratorConfig()).eval()
    return FakestereoNet(
        PSMNetMatcher(PSMNet().eval(), config), make_synthesiser(generator, config.device)
    )


def street() -> StereoInput:
    """An image of KITTI's size; what it shows does not matter."""
    K = torch.tensor([[FOCAL_PX, 0, 609.6], [0, FOCAL_PX, 172.9], [0, 0, 1]], dtype=torch.float64)
    rig = StereoRig(width=WIDTH, height=HEIGHT, K=K, baseline_m=0.5327)
    image = torch.rand(3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(0))
    return StereoInput(name="street", left=image, right=None, camera=rig)


def seconds(run: Callable[[], object], device: str) -> float:
    """Least time of three runs after one to warm up."""

    def waited() -> None:
        run()
        if device != "cpu":
            torch.cuda.synchronize()

    waited()
    return least_seconds(waited, 3)


def count_flops(run: Callable[[], object]) -> int:
    """Count operations of the generator, module by module."""
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
        shadow = kind.network(config).eval()
        views = torch.empty(2, 1, 3, rows, columns)
        return count_flops(lambda: shadow(views[0], views[1]))


def uses_matcher(net: FakestereoNet) -> bool:
    """Whether depth from one image uses the matcher."""
    assert net.synthesiser is not None
    config = net.synthesiser.config
    return isinstance(config, GeneratorConfig) or config.answer != "own"


def run_once(weights: str, precision: str, device: str) -> dict[str, object]:
    """Measure one set in this process."""
    run: Any = {"precision": precision, "device": device}
    config = MatcherConfig(**run, speed="quick")
    net, image = make_net(weights, config), street()
    began = time.perf_counter()
    memory = peak_growth_bytes(lambda: net.estimate_pair(image))
    first = time.perf_counter() - began
    if device != "cpu":
        memory = torch.cuda.max_memory_allocated()
    assert net.synthesiser is not None
    assert image.camera is not None
    draw = net.synthesiser.draw
    size = size_at_focal_length(image.camera, net.synthesiser.config.virtual_focal_px)
    left = resize_image(image.left, *size)
    right = draw(left[None]).right[0]
    whole_s = seconds(lambda: net.estimate_pair(image), device)
    fine = make_net(weights, MatcherConfig(**run))
    fine_s = seconds(lambda: fine.estimate_pair(image), device)
    drawing = count_flops(lambda: draw(left[None]))
    matching = matcher_flops(net, *size) if uses_matcher(net) else 0
    peak = peak_flops(torch.bfloat16 if precision == "bf16" else torch.float32)
    matcher = net.matcher
    match_s = 0.0
    if matcher is not None and uses_matcher(net):
        match_s = seconds(lambda: matcher.match(left, right), device)
    return {
        "set": weights,
        "precision": precision,
        "seconds": whole_s,
        "fine_s": fine_s,
        "first_s": first,
        "draw_s": seconds(lambda: draw(left[None]), device),
        "match_s": match_s,
        "memory_mb": memory / 1e6,
        "draw_gflop": drawing / 1e9,
        "match_gflop": matching / 1e9,
        "share_of_peak": (drawing + matching) / whole_s / peak if device == "cpu" else None,
    }


def compare(names: list[str], runs: int = 6) -> list[dict[str, object]]:
    """Alternate in one process, one thread; processor time is valid on a busy machine too."""
    torch.set_num_threads(1)
    image = street()
    speeds: tuple[Speed, ...] = ("quick", "fine")
    nets = {
        (name, speed): make_net(name, MatcherConfig(speed=speed))
        for name in names
        for speed in speeds
    }
    times: dict[tuple[str, str], list[float]] = {each: [] for each in nets}
    for _ in range(runs):
        for each, net in nets.items():
            begin = time.process_time()
            net.estimate_pair(image)
            times[each].append(time.process_time() - begin)
    return [
        {"set": Path(name).stem, "speed": speed, "processor_s": min(found)}
        for (name, speed), found in times.items()
    ]


def main() -> None:
    """Run each set of weights in a separate process and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
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
        print(markdown_table(compare(options.compare)))
        return
    rows = []
    for weights in options.weights:
        for precision in options.precision:
            command = [sys.executable, __file__, "--device", options.device]
            command += ["--child", weights, precision]
            done = subprocess.run(command, check=True, capture_output=True, text=True)
            rows.append(json.loads(done.stdout.splitlines()[-1]))
    print(f"{setting()}, {WIDTH}x{HEIGHT}")
    report("mono_speed", rows)


if __name__ == "__main__":
    main()
