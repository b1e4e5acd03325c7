"""Time and memory of one estimate, stage by stage, at several numbers of voxels.

python bench/pose_speed.py [--voxels 500 2000 10000] [--threads 1] [--rounds 7] [--width full|half]

The network is untrained, which takes as long as a trained one; its directions are then
replaced by true ones with noise (15 degrees for a tenth of the points, 3 for the rest), so that
the later stages run as in use. Stages are those of ``PoseEstimate.seconds``: cloud
(thinning, flying pixels, voxels), network (with kernel maps), voting, svd (outliers and fit),
icp, check (signals, observability, refusal). The least of the rounds is shown, of wall time.
Memory is the growth of the resident set's peak over a first estimate of that size after one of a
small cloud, in its own process, Linux only. For the network alone, compared with
other engines, see bench/sparse_speed.py.
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path

import torch
from sparse_speed import child_memory, status_bytes, surface
from torch import Tensor

from depthpose.core.rigid import Rigid
from depthpose.pose.config import CloudConfig, EstimateConfig, RefusalConfig, VotingConfig
from depthpose.pose.estimator import GeoPoseNet
from depthpose.pose.estimator.net import CloudToPose
from depthpose.pose.mesh import make_model
from depthpose.pose.network import ResUNet, ResUNetConfig
from depthpose.pose.types import CloudInput, ObjectModel, PoseEstimate
from depthpose.pose.weights import PoseWeights

VOXEL_M = 0.004
STAGES = ("cloud", "network", "voting", "svd", "icp", "check")
HALF = ResUNetConfig(
    classes=1, norm="none", with_bias=True, first_kernel=5,
    encoder=(16, 32, 64, 128), decoder=(32, 32, 32, 64),
)  # fmt: skip
FULL = ResUNetConfig(classes=1, norm="none")
NO_RISK = RefusalConfig(min_agreement=0.0, max_beyond=1.0, min_found=0.0, min_observability=0.0)


class NoisyTruth(GeoPoseNet):
    """Calls the network, and replaces its directions by true ones with noise."""

    truth: Rigid

    def _ask_network(
        self, group: list[CloudToPose | PoseEstimate]
    ) -> list[CloudToPose | PoseEstimate]:
        for one in super()._ask_network(group):
            if isinstance(one, CloudToPose):
                one.outputs = self._true(one.cloud.points_m, one.known.number)
        return group

    def _true(self, points_m: Tensor, number: int) -> Tensor:
        keypoints_m = self.truth.apply(self.weights.models[number].keypoints_m)
        way = torch.nn.functional.normalize(keypoints_m[None] - points_m[:, None], dim=-1)
        generator = torch.Generator().manual_seed(0)
        is_bad = torch.rand(len(points_m), 1, 1, generator=generator) < 0.1
        return way + torch.randn(way.shape, generator=generator) * torch.where(is_bad, 0.26, 0.05)


def cloud_of(voxels: int) -> tuple[Tensor, ObjectModel]:
    """A bumpy closed surface of about ``voxels`` voxels, fully visible, and its model of points."""
    points_m = VOXEL_M * (surface(voxels)[:, 1:].float() + 0.5)
    return points_m, make_model(points_m, torch.zeros(0, 3, dtype=torch.long), name="bumpy")


def estimator(model: ObjectModel, width: str, voting: VotingConfig) -> NoisyTruth:
    """Make an estimator that answers for this object."""
    torch.manual_seed(0)
    weights = PoseWeights(
        network=ResUNet(FULL if width == "full" else HALF),
        models=(model,),
        cloud=CloudConfig(voxel_m=VOXEL_M, max_points=None),
        refusal=NO_RISK,
        facts={},
    )
    net = NoisyTruth(weights, EstimateConfig(voting=voting))
    net.truth = Rigid(torch.eye(3), torch.tensor([0.0, 0.0, 3.0]))
    return net


def bench(voxels: int, args: argparse.Namespace) -> list[dict]:
    """Time RANSAC and least squares on one cloud."""
    points_m, model = cloud_of(voxels)
    given = CloudInput(name="c", points_m=points_m + torch.tensor([0.0, 0, 3]), object="bumpy")
    words = ("--threads", args.threads, "--memory-of", voxels, "--width", args.width)
    rows = []
    for method in ("ransac", "least squares"):
        net = estimator(model, args.width, VotingConfig(method=method))
        estimates = [net.estimate_many([given])[0] for _ in range(args.rounds + 1)][1:]
        assert all(e.is_posed for e in estimates), estimates[0].reason
        stages = {stage: min(e.seconds[stage] for e in estimates) for stage in STAGES}
        rows.append({"voxels": voxels, "votes_by": method, **stages})
        rows[-1] |= {"whole": min(sum(e.seconds.values()) for e in estimates)}
        rows[-1] |= {"memory_mb": child_memory(__file__, *words) if method == "ransac" else None}
        print(as_line(rows[-1]), flush=True)
    return rows


def as_line(row: dict) -> str:
    """Write a row in Markdown."""
    times = " | ".join(f"{1e3 * row[stage]:.1f}" for stage in (*STAGES, "whole"))
    memory = "" if row["memory_mb"] is None else f"{row['memory_mb']:.0f}"
    return f"| {row['voxels']} | {row['votes_by']} | {times} | {memory} |"


def measure_memory(voxels: int, width: str) -> int:
    """Peak growth of the resident set over an estimate [bytes]."""
    for size in (50, voxels):
        points_m, model = cloud_of(size)
        given = CloudInput(name="c", points_m=points_m + torch.tensor([0.0, 0, 3]), object="bumpy")
        net = estimator(replace(model), width, VotingConfig())
        before = status_bytes("VmRSS")
        Path("/proc/self/clear_refs").write_text("5")
        net.estimate_many([given])
    return status_bytes("VmHWM") - before


def main() -> None:
    """Print a table and write out/bench/pose_speed.json."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--voxels", nargs="+", type=int, default=[500, 2000, 10000])
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--width", choices=("full", "half"), default="half")
    parser.add_argument("--memory-of", type=int, help=argparse.SUPPRESS)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    if args.memory_of:
        print(measure_memory(args.memory_of, args.width))
        return
    print(f"{args.threads} threads, torch {torch.__version__}, network of {args.width} width")
    print(f"| voxels | votes by | {' ms | '.join(STAGES)} ms | whole ms | MB |")
    print("| --- " * (len(STAGES) + 4) + "|")
    rows = [row for voxels in args.voxels for row in bench(voxels, args)]
    folder = Path("out/bench")
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "pose_speed.json").write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
