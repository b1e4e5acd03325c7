"""Real instances of known pose: ours beside Open3D's FPFH + RANSAC + ICP, in one run.

    python bench/pose_peers.py $DEPTHPOSE_DATA --seeds 20 --register --weights ycb

``pip install -e '.[open3d]'`` first, and of the system libusb-1.0 and libGL (Debian: ``apt install
libusb-1.0-0 libgl1``). Ours runs on the objects of the weights. What is counted is that of
``bench/real.py`` (see ``score``); Open3D names no alternatives and is never unsure. Seconds are of
one thread each, without the preparation of models.
"""

import argparse
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Protocol

import torch
from fpfh import VOXEL_DIAMETERS, FpfhEstimator
from real_poses import RealCase
from score import Row, errors_of, use_seed
from score_instances import cases, line, registration_of

from depthpose import GeoPoseNet
from depthpose.core.checkpoint import find_weights
from depthpose.pose.types import CloudInput, PoseEstimate, ViewInput
from depthpose.report.page import markdown_table, write_table


class Method(Protocol):
    """What poses one input after the other."""

    def estimate_many(self, inputs: Sequence[CloudInput | ViewInput]) -> list[PoseEstimate]:
        """Pose inputs."""
        ...


MethodOf = Callable[[RealCase, int], Method]
"""Makes the method that poses an instance, by a seed."""


def open3d_for(case: RealCase, seed: int, voxel_diameters: float) -> Method:
    """Open3D's registration of one model."""
    return FpfhEstimator([case.model], voxel_diameters, seed)


def registration_for(case: RealCase, seed: int, samples: Path) -> Method:
    """Our registration of one model, prepared once."""
    registration = registration_of(samples, case.name)
    use_seed(registration, seed)
    return registration


def network_for(case: RealCase, seed: int, net: GeoPoseNet) -> Method:
    """Trained weights, one object of which is posed."""
    del case
    use_seed(net, seed)
    return net


def pose(method_of: MethodOf, case: RealCase, seeds: int) -> Iterator[Row]:
    """Pose an instance by each seed, and measure each answer."""
    given = case.sample.input
    method_of(case, 0).estimate_many([given])  # the first prepares the model
    for seed in range(seeds):
        method = method_of(case, seed)
        began = time.process_time()
        (estimate,) = method.estimate_many([given])
        cpu_s = time.process_time() - began
        errors = errors_of(estimate, case.sample.truth.camera_from_model, case.model)
        yield {"instance": case.name, "seed": seed, **errors, "cpu_s": cpu_s}


def main() -> None:
    """Run the methods on the instances; count for YCB's and for the others."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("samples", type=Path, help="folder with pose/")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--only", default="", help="instances whose name contains this")
    parser.add_argument("--voxel", type=float, default=VOXEL_DIAMETERS)
    parser.add_argument("--weights", nargs="*", default=[], help="of ours")
    parser.add_argument("--no-peer", action="store_true", help="ours alone")
    parser.add_argument("--register", action="store_true", help="ours without training too")
    parser.add_argument("--out", type=Path, default=Path("out/pose_peers"))
    words = parser.parse_args()
    torch.set_num_threads(1)

    wanted = [case for name, case in cases(words.samples).items() if words.only in name]
    runs = dict[str, tuple[MethodOf, list[RealCase]]]()
    if not words.no_peer:
        runs["Open3D"] = (partial(open3d_for, voxel_diameters=words.voxel), wanted)
    if words.register:
        runs["registration"] = (partial(registration_for, samples=words.samples), wanted)
    for name in words.weights:
        net = GeoPoseNet.load(find_weights(name))
        own = [case for case in wanted if case.model.name in net.objects]
        runs[name] = (partial(network_for, net=net), own)

    rows = list[Row]()
    table = list[Row]()
    for name, (method_of, shown) in runs.items():
        mine = [{"method": name, **row} for case in shown
                for row in pose(method_of, case, words.seeds)]  # fmt: skip
        groups = {
            "YCB": [row for row in mine if row["instance"].startswith("ycb")],
            "others": [row for row in mine if not row["instance"].startswith("ycb")],
        }
        table += [line(f"{name}, {group}", some) for group, some in groups.items() if some]
        rows += mine
    write_table(words.out, rows)
    print(markdown_table(table))


if __name__ == "__main__":
    main()
