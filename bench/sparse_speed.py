"""Time and memory of the sparse ResUNet beside other engines: same weights, voxels and process.

python bench/sparse_speed.py [--voxels 500 2000 10000] [--threads 1] [--rounds 7]

Peers: MinkowskiEngine where it is installed (0.5.4 is built from source: pip install
--no-build-isolation, after mending four 'from collections import Sequence'), and the same maps
with torch's own autograd, offset by offset. A forward pass starts from coordinates, so hashing and
kernel maps count; a step is forward pass, loss and backward pass, without the optimiser, which is
the same for all. Engines alternate in each round; the least of each is shown. Memory is the
growth of the resident set's peak over a step, each in its own process, Linux only.
"""

import argparse
import subprocess
import sys
import time
from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
from shared import peak_growth_bytes, report, setting
from torch import Tensor, nn

from depthpose.pose.network import ResUNet, ResUNetConfig
from depthpose.pose.sparse import KernelMap, SparseConv, Voxels

Run = Callable[[], Tensor]


def surface(voxels: int) -> Tensor:
    """Voxels of a bumpy closed surface, about as many as asked for."""
    direction = torch.randn(40 * voxels + 20000, 3, generator=torch.Generator().manual_seed(0))
    direction /= direction.norm(dim=1, keepdim=True)
    bumps = 1 + 0.15 * torch.sin(5 * direction[:, :1]) * torch.cos(4 * direction[:, 1:2])
    shape = direction * bumps * torch.tensor([1.0, 0.8, 0.6])
    low, high, found = 2.0, 400.0, torch.zeros(0, 3, dtype=torch.int32)
    for _ in range(25):
        middle = (low + high) / 2
        found = torch.unique((shape * middle).floor().int(), dim=0)
        low, high = (low, middle) if len(found) > voxels else (middle, high)
    return torch.nn.functional.pad(found, (1, 0))


def plain_conv(features: Tensor, weight: Tensor, kernel_map: KernelMap) -> Tensor:
    """Convolve offset by offset under torch's autograd, which keeps every gathered row."""
    near = kernel_map.neighbours
    written = near.fine_rows if kernel_map.is_transposed else near.table.shape[1]
    out = features.new_zeros(written, weight.shape[2])
    for offset, read, write in kernel_map.by_offset():
        out = out.index_add(0, write, features[read] @ weight[offset])
    return out if near.centre is None else out + features @ weight[near.centre]


class MinkowskiVoxels:
    """A tensor of MinkowskiEngine with the interface of our voxels."""

    def __init__(self, tensor: Any) -> None:  # noqa: ANN401
        self.tensor, self.features = tensor, tensor.F

    def with_features(self, features: Tensor) -> "MinkowskiVoxels":
        """Give other features on the same coordinates."""
        key, manager = self.tensor.coordinate_map_key, self.tensor.coordinate_manager
        engine = import_module("MinkowskiEngine")
        return MinkowskiVoxels(
            engine.SparseTensor(features, coordinate_map_key=key, coordinate_manager=manager)
        )

    def at_points(self) -> Tensor:
        """Rows keep the order in which they were given."""
        return self.features


class MinkowskiLayer(nn.Module):
    """One of our layers, computed by MinkowskiEngine."""

    def __init__(self, ours: SparseConv) -> None:
        super().__init__()
        engine = import_module("MinkowskiEngine")
        of = "Transpose" if ours.is_transposed else ""
        self.weight, self.bias = ours.weight, None
        self.conv = getattr(engine, f"MinkowskiConvolution{of}")(
            *ours.weight.shape[1:], kernel_size=ours.kernel, stride=ours.stride, dimension=3
        )
        with torch.no_grad():
            self.conv.kernel.copy_(ours.weight)

    def forward(self, voxels: MinkowskiVoxels) -> MinkowskiVoxels:
        """Convolve."""
        return MinkowskiVoxels(self.conv(voxels.tensor))


def with_minkowski(network: ResUNet) -> ResUNet:
    """Give a twin whose convolutions MinkowskiEngine computes; 1x1 ones are products already."""
    twin = ResUNet(network.config)
    twin.load_state_dict(network.state_dict())
    for module in list(twin.modules()):
        for name, child in list(module.named_children()):
            if isinstance(child, SparseConv) and child.kernel > 1:
                setattr(module, name, MinkowskiLayer(child))
    return twin


def engines(network: ResUNet, coordinates: Tensor) -> dict[str, Run]:
    """Every engine that is installed: coordinates to outputs."""

    def ours() -> Tensor:
        return network(Voxels.from_points(coordinates))

    def plain() -> Tensor:
        with patch.object(import_module("depthpose.pose.sparse"), "conv", plain_conv):
            return network(Voxels.from_points(coordinates))

    runs: dict[str, Run] = {"ours": ours, "plain autograd": plain}
    if find_spec("MinkowskiEngine"):
        engine, twin = import_module("MinkowskiEngine"), with_minkowski(network)
        runs["MinkowskiEngine"] = lambda: twin(
            MinkowskiVoxels(engine.SparseTensor(torch.ones(len(coordinates), 1), coordinates))
        )
    return runs


def step(run: Run) -> None:
    """Forward, loss, backward; gradients add up in place, as after ``zero_grad`` in place."""
    run().square().mean().backward()


def forward(run: Run) -> None:
    """Forward alone."""
    with torch.no_grad():
        run()


def seconds(work: Callable[[Run], None], run: Run) -> float:
    """Time of one run: of the processor for one thread, which others' load blurs less."""
    clock = time.process_time if torch.get_num_threads() == 1 else time.perf_counter
    begin = clock()
    work(run)
    return clock() - begin


def measure_memory(network: ResUNet, voxels: int, engine: str) -> int:
    """Peak growth of the resident set over a step [bytes], after one on a small cloud.

    The small one makes the gradients, so that the first of its size shows what the allocator would
    afterwards keep.
    """
    run = engines(network, surface(voxels))[engine]
    step(engines(network, surface(50))[engine])
    return peak_growth_bytes(lambda: step(run))


def child_memory(script: str, *words: object) -> float:
    """Memory that a script prints, run in a fresh process [MB]; NaN where there is no /proc."""
    if not Path("/proc/self/clear_refs").exists():
        return float("nan")
    command = [sys.executable, "-W", "ignore", script, *map(str, words)]
    answer = subprocess.run(command, check=True, capture_output=True, text=True)
    return int(answer.stdout.split()[-1]) / 1e6


def bench(network: ResUNet, voxels: int, args: argparse.Namespace) -> list[dict]:
    """Time every engine on one cloud."""
    runs = engines(network, surface(voxels))
    with torch.no_grad():
        answers = {name: run() for name, run in runs.items()}
    times = {(name, work.__name__): [] for name in runs for work in (forward, step)}
    for _ in range(args.rounds + 1):
        for name, run in runs.items():
            for work in (forward, step):
                times[name, work.__name__].append(seconds(work, run))
    rows = []
    for name in runs:
        ahead, whole = (min(times[name, what][1:]) for what in ("forward", "step"))
        rows.append({"voxels": len(answers[name]), "engine": name, "forward_s": ahead})
        words = ("--threads", args.threads, "--memory-of", name, "--voxels", voxels)
        rows[-1] |= {"step_s": whole, "memory_mb": child_memory(__file__, *words)}
        difference = (answers[name] - answers["ours"]).abs().max() / answers["ours"].abs().max()
        rows[-1] |= {"forward_ratio": ahead / rows[0]["forward_s"], "difference": float(difference)}
        rows[-1] |= {"step_ratio": whole / rows[0]["step_s"]}
    return rows


def main() -> None:
    """Print a table and write out/bench/sparse_speed.json."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--voxels", nargs="+", type=int, default=[500, 2000, 10000])
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--memory-of", help=argparse.SUPPRESS)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    torch.manual_seed(0)
    network = ResUNet(ResUNetConfig(norm="none"))
    if args.memory_of:
        print(measure_memory(network, args.voxels[0], args.memory_of))
        return
    print(f"{setting()}, {ResUNetConfig(norm='none')}")
    rows = [row for voxels in args.voxels for row in bench(network, voxels, args)]
    report("sparse_speed", rows)


if __name__ == "__main__":
    main()
