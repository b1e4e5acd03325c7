"""Real instances of known pose: ours beside Open3D's FPFH + RANSAC + ICP, in one run.

    python bench/pose_peers.py $DEPTHPOSE_DATA --seeds 20 --register --weights ycb

First ``pip install -e '.[open3d]'``, and of the system libusb-1.0 and libGL (Debian: ``apt install
libusb-1.0-0 libgl1``). Trained weights run on their own objects. Answers are counted as in
``bench/real.py`` (see ``score``); Open3D names no alternatives and is never unsure. Seconds are of
one thread each, without the preparation of models.
"""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Protocol

import torch
from fpfh import VOXEL_DIAMETERS, FpfhEstimator
from real_poses import RealCase
from score import Row, errors_of, use_seed
from score_instances import cases, line, registration_of
from shared import make_parser, with_cpu_seconds

from depthpose import GeoPoseNet
from depthpose.core.checkpoint import find_weights
from depthpose.pose.types import CloudInput, PoseEstimate, ViewInput
from depthpose.report.page import format_markdown_table, write_table


class Method(Protocol):
    """An estimator of poses."""

    def estimate_many(self, inputs: Sequence[CloudInput | ViewInput]) -> list[PoseEstimate]:
        """Pose inputs one after the other."""
        ...


MethodOf = Callable[[RealCase, int], Method]
"""Makes the estimator for an instance and a seed."""


def open3d_for(case: RealCase, seed: int, voxel_diameters: float) -> Method:
    """Prepare Open3D's registration of one model."""
    return FpfhEstimator([case.model], voxel_diameters, seed)


def registration_for(case: RealCase, seed: int, samples: Path) -> Method:
    """Return our registration of one model, prepared once."""
    registration = registration_of(samples, case.name)
    use_seed(registration, seed)
    return registration


def network_for(case: RealCase, seed: int, net: GeoPoseNet) -> Method:
    """Return the network, which knows the instance's object."""
    del case
    use_seed(net, seed)
    return net


def pose(method_of: MethodOf, case: RealCase, seeds: int) -> Iterator[Row]:
    """Pose an instance by each seed, and measure each answer."""
    cloud_or_view = case.sample.input
    method_of(case, 0).estimate_many([cloud_or_view])  # the first call prepares the model
    for seed in range(seeds):
        method = method_of(case, seed)
        (estimate,), cpu_s = with_cpu_seconds(
            lambda method=method: method.estimate_many([cloud_or_view])
        )
        errors = errors_of(estimate, case.sample.truth.camera_from_model, case.model)
        yield {"instance": case.name, "seed": seed, **errors, "cpu_s": cpu_s}


def main() -> None:
    """Run the methods on the instances; count for YCB's and for the others."""
    parser = make_parser(__doc__)
    parser.add_argument("samples", type=Path, help="folder with pose/")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--only", default="", help="instances whose name contains this")
    parser.add_argument("--voxel", type=float, default=VOXEL_DIAMETERS)
    parser.add_argument("--weights", nargs="*", default=[], help="of ours")
    parser.add_argument("--no-peer", action="store_true", help="ours alone")
    parser.add_argument("--register", action="store_true", help="ours without training too")
    parser.add_argument("--out", type=Path, default=Path("out/pose_peers"))
    options = parser.parse_args()
    torch.set_num_threads(1)

    instances = [case for name, case in cases(options.samples).items() if options.only in name]
    runs = dict[str, tuple[MethodOf, list[RealCase]]]()
    if not options.no_peer:
        runs["Open3D"] = (partial(open3d_for, voxel_diameters=options.voxel), instances)
    if options.register:
        runs["registration"] = (partial(registration_for, samples=options.samples), instances)
    for name in options.weights:
        net = GeoPoseNet.load(find_weights(name))
        known_instances = [case for case in instances if case.model.name in net.objects]
        runs[name] = (partial(network_for, net=net), known_instances)

    rows = list[Row]()
    table = list[Row]()
    for name, (method_of, run_instances) in runs.items():
        run_rows = [
            {"method": name, **row}
            for case in run_instances
            for row in pose(method_of, case, options.seeds)
        ]
        ycb = [row for row in run_rows if row["instance"].startswith("ycb")]
        others = [row for row in run_rows if not row["instance"].startswith("ycb")]
        if ycb:
            table.append(line(f"{name}, YCB", ycb))
        if others:
            table.append(line(f"{name}, others", others))
        rows += run_rows
    write_table(options.out, rows)
    print(format_markdown_table(table))


if __name__ == "__main__":
    main()
