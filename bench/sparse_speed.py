"""Time and memory of the sparse ResUNet beside other engines: same weights, voxels and process.

    python bench/sparse_speed.py [--voxels 500 2000 10000] [--threads 1] [--rounds 7]

Peers: MinkowskiEngine where it is installed (0.5.4 is built from source: pip install
--no-build-isolation, after changing four 'from collections import Sequence'), and the same kernel
maps under torch's own autograd, offset by offset. A forward pass starts from coordinates, so that
hashing and kernel maps count; a step is a forward pass, loss and backward pass, without the
optimiser, which is the same for all. Engines alternate in each round; the least of each is shown,
of one thread in processor time. Memory is the growth of the peak of resident memory over a step,
each in a process of its own, Linux only.
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
from shared import make_parser, peak_growth_bytes, report, setting
from torch import Tensor, nn

from depthpose.pose.networks.kernel_map import KernelMap
from depthpose.pose.networks.resunet import ResUNet, ResUNetConfig
from depthpose.pose.networks.sparse import SparseConv, Voxels

Run = Callable[[], Tensor]


def surface(voxels: int) -> Tensor:
    """Make about ``voxels`` voxels of a bumpy closed surface; the size is found by bisection."""
    direction = torch.randn(40 * voxels + 20000, 3, generator=torch.Generator().manual_seed(0))
    direction /= direction.norm(dim=1, keepdim=True)
    bumps = 1 + 0.15 * torch.sin(5 * direction[:, :1]) * torch.cos(4 * direction[:, 1:2])
    points = direction * bumps * torch.tensor([1.0, 0.8, 0.6])
    low, high = 2.0, 400.0
    coordinates = torch.zeros(0, 3, dtype=torch.int32)
    for _ in range(25):
        size = (low + high) / 2
        coordinates = torch.unique((points * size).floor().int(), dim=0)
        if len(coordinates) > voxels:
            high = size
        else:
            low = size
    batch_index = (1, 0)
    return torch.nn.functional.pad(coordinates, batch_index)


def plain_conv(features: Tensor, weight: Tensor, kernel_map: KernelMap) -> Tensor:
    """Convolve offset by offset under torch's autograd, which keeps every gathered row."""
    neighbours = kernel_map.neighbours
    rows = neighbours.fine_rows if kernel_map.is_transposed else neighbours.table.shape[1]
    out = features.new_zeros(rows, weight.shape[2])
    for offset, source_rows, target_rows in kernel_map.by_offset():
        out = out.index_add(0, target_rows, features[source_rows] @ weight[offset])
    if neighbours.centre is None:
        return out
    return out + features @ weight[neighbours.centre]


class MinkowskiVoxels:
    """A tensor of MinkowskiEngine with the interface of our voxels."""

    def __init__(self, tensor: Any) -> None:  # noqa: ANN401
        self.tensor = tensor
        self.features = tensor.F

    def with_features(self, features: Tensor) -> "MinkowskiVoxels":
        """Put other features on the same coordinates."""
        engine = import_module("MinkowskiEngine")
        tensor = engine.SparseTensor(
            features,
            coordinate_map_key=self.tensor.coordinate_map_key,
            coordinate_manager=self.tensor.coordinate_manager,
        )
        return MinkowskiVoxels(tensor)

    def at_points(self) -> Tensor:
        """Return the features; rows keep the order of the points."""
        return self.features


class MinkowskiLayer(nn.Module):
    """One of our layers, computed by MinkowskiEngine."""

    def __init__(self, ours: SparseConv) -> None:
        super().__init__()
        engine = import_module("MinkowskiEngine")
        suffix = "Transpose" if ours.is_transposed else ""
        convolution = getattr(engine, f"MinkowskiConvolution{suffix}")
        self.weight = ours.weight
        self.bias = None
        self.conv = convolution(
            *ours.weight.shape[1:], kernel_size=ours.kernel, stride=ours.stride, dimension=3
        )
        with torch.no_grad():
            self.conv.kernel.copy_(ours.weight)

    def forward(self, voxels: MinkowskiVoxels) -> MinkowskiVoxels:
        """Convolve."""
        return MinkowskiVoxels(self.conv(voxels.tensor))


def with_minkowski(network: ResUNet) -> ResUNet:
    """Copy a network, with convolutions by MinkowskiEngine; those of size 1 are plain products."""
    twin = ResUNet(network.config)
    twin.load_state_dict(network.state_dict())
    for module in list(twin.modules()):
        for name, child in list(module.named_children()):
            if isinstance(child, SparseConv) and child.kernel > 1:
                setattr(module, name, MinkowskiLayer(child))
    return twin


def engines(network: ResUNet, coordinates: Tensor) -> dict[str, Run]:
    """List the installed engines; each computes the outputs from the coordinates."""

    def ours() -> Tensor:
        return network(Voxels.from_points(coordinates))

    def plain() -> Tensor:
        with patch.object(import_module("depthpose.pose.networks.sparse"), "convolve", plain_conv):
            return network(Voxels.from_points(coordinates))

    runs: dict[str, Run] = {"ours": ours, "plain autograd": plain}
    if find_spec("MinkowskiEngine"):
        engine = import_module("MinkowskiEngine")
        minkowski_network = with_minkowski(network)

        def minkowski() -> Tensor:
            features = torch.ones(len(coordinates), 1)
            tensor = engine.SparseTensor(features, coordinates)
            return minkowski_network(MinkowskiVoxels(tensor))

        runs["MinkowskiEngine"] = minkowski
    return runs


def step(run: Run) -> None:
    """Run forward pass, loss and backward pass; gradients are added to the existing ones."""
    run().square().mean().backward()


def forward(run: Run) -> None:
    """Run the forward pass alone."""
    with torch.no_grad():
        run()


def seconds(work: Callable[[Run], None], run: Run) -> float:
    """Measure one run [s]: of one thread in processor time, which depends less on other load."""
    clock = time.process_time if torch.get_num_threads() == 1 else time.perf_counter
    start_s = clock()
    work(run)
    return clock() - start_s


def measure_memory(network: ResUNet, voxels: int, engine: str) -> int:
    """Measure the growth of the peak of resident memory over a step [bytes].

    A step on a small cloud runs before, so that the gradients exist. The measured step is the first
    of its size, for the allocator keeps the memory of earlier ones.
    """
    run = engines(network, surface(voxels))[engine]
    step(engines(network, surface(50))[engine])
    return peak_growth_bytes(lambda: step(run))


def memory_in_new_process(engine: str, voxels: int, threads: int) -> float:
    """Measure the memory of a step in a new process [MB]; NaN where there is no /proc."""
    if not Path("/proc/self/clear_refs").exists():
        return float("nan")
    command = [
        sys.executable, "-W", "ignore", __file__, "--threads", str(threads),
        "--memory-of", engine, "--voxels", str(voxels),
    ]  # fmt: skip
    process = subprocess.run(command, check=True, capture_output=True, text=True)
    return int(process.stdout.split()[-1]) / 1e6


def measure_cloud(network: ResUNet, voxels: int, options: argparse.Namespace) -> list[dict]:
    """Time every engine on one cloud."""
    runs = engines(network, surface(voxels))
    with torch.no_grad():
        outputs = {name: run() for name, run in runs.items()}
    forward_times_s: dict[str, list[float]] = {name: [] for name in runs}
    step_times_s: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(options.rounds + 1):
        for name, run in runs.items():
            forward_times_s[name].append(seconds(forward, run))
            step_times_s[name].append(seconds(step, run))
    largest_output = outputs["ours"].abs().max()
    rows: list[dict] = []
    for name in runs:
        forward_s = min(forward_times_s[name][1:])  # the first round warms up
        step_s = min(step_times_s[name][1:])
        difference = (outputs[name] - outputs["ours"]).abs().max() / largest_output
        row = {
            "voxels": len(outputs[name]),
            "engine": name,
            "forward_s": forward_s,
            "step_s": step_s,
            "memory_mb": memory_in_new_process(name, voxels, options.threads),
        }
        rows.append(row)
        row["forward_ratio"] = forward_s / rows[0]["forward_s"]
        row["difference"] = float(difference)
        row["step_ratio"] = step_s / rows[0]["step_s"]
    return rows


def main() -> None:
    """Print a table and write out/bench/sparse_speed.json."""
    parser = make_parser(__doc__)
    parser.add_argument("--voxels", nargs="+", type=int, default=[500, 2000, 10000])
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--memory-of", help=argparse.SUPPRESS)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    torch.manual_seed(0)
    network = ResUNet(ResUNetConfig(norm="none"))
    if options.memory_of:
        print(measure_memory(network, options.voxels[0], options.memory_of))
        return
    print(f"{setting()}, {ResUNetConfig(norm='none')}")
    rows = [row for voxels in options.voxels for row in measure_cloud(network, voxels, options)]
    report("sparse_speed", rows)


if __name__ == "__main__":
    main()
