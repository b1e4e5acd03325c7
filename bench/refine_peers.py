"""Point-to-plane ICP here and in small_gicp, on real partial clouds of known pose.

python bench/refine_peers.py SAMPLES/pose [--turn-deg 25] [--shift 0.1]

SAMPLES/pose holds lm (BOP layout) and bunny (range scans). ``pip install small_gicp`` first. Times
are processor time of the one thread used.
"""

import argparse
import math
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from real_poses import bunny_cases, lm_cases
from torch import Tensor

from depthpose.core.rigid import Rigid, perturb
from depthpose.pose.metrics import add_m
from depthpose.pose.refine import refine_pose
from depthpose.pose.surface import prepare_surface
from depthpose.pose.types import ObjectModel

STARTS = 20
Case = tuple[str, Tensor, Rigid, ObjectModel]


def cases_in(folder: Path) -> list[Case]:
    """The two instances of LineMOD and three scans of the bunny, with their poses."""
    cases: list[Case] = []
    for case in (*lm_cases(folder), *bunny_cases(folder, every=20)):
        if not case.name.endswith(("090", "270")):
            pose = case.sample.truth.camera_from_model
            pose = pose.double()
            cases.append((case.name, case.points_m, pose, case.model))
    return cases


def starts_near(true: Rigid, turn_rad: float, shift_m: float) -> list[Rigid]:
    """Poses up to a turn about the model's origin and a shift away."""
    generator = torch.Generator().manual_seed(0)
    starts = []
    for _ in range(STARTS):
        draws = torch.randn(2, 3, generator=generator, dtype=torch.float64)
        axis, way = torch.nn.functional.normalize(draws, dim=-1)
        turn = turn_rad * torch.rand(1, generator=generator).double().sqrt() * axis
        still = Rigid(true.R, torch.zeros(3).double())
        turned = perturb(still, torch.cat([turn, torch.zeros(3).double()]))
        starts.append(Rigid(turned.R, true.t_m + shift_m * way))
    return starts


def peer(cloud: Tensor, model: ObjectModel, kind: str) -> Callable[[Rigid], Rigid]:
    """small_gicp, its target prepared once."""
    import small_gicp  # pyright: ignore[reportMissingImports]

    target = small_gicp.PointCloud(prepare_surface(model).points_m.numpy())
    tree = small_gicp.KdTree(target)
    small_gicp.estimate_normals_covariances(target, tree, num_neighbors=10)
    points = cloud.double().numpy()

    def run(start: Rigid) -> Rigid:
        source = small_gicp.PointCloud(points)
        if kind == "GICP":
            small_gicp.estimate_covariances(source, small_gicp.KdTree(source))
        guess = np.eye(4)
        inverse = start.inverse()
        guess[:3, :3], guess[:3, 3] = inverse.R.numpy(), inverse.t_m.numpy()
        found = small_gicp.align(
            target, source, tree, guess, registration_type=kind, num_threads=1,
            max_correspondence_distance=0.1 * model.diameter_m, max_iterations=30,
        )  # fmt: skip
        T = torch.from_numpy(found.T_target_source.copy())
        return Rigid(T[:3, :3], T[:3, 3]).inverse()

    return run


def report(case: Case, method: str, run: Callable[[Rigid], Rigid], starts: list[Rigid]) -> None:
    """Run all starts and print one row."""
    name, _, true, model = case
    began = time.thread_time()
    poses = [run(start) for start in starts]
    milliseconds = 1000 * (time.thread_time() - began) / len(starts)
    points = model.vertices_m.double()[::7]
    errors = torch.stack([add_m(pose, true, points) for pose in poses]) / model.diameter_m
    share = float((errors < 0.1).double().mean())
    print(f"{name} | {method} | {float(errors.median()):.4f} | {share:.2f} | {milliseconds:.1f}",
          flush=True)  # fmt: skip


def main() -> None:
    """Compare on every case."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("samples", type=Path)
    parser.add_argument("--turn-deg", type=float, default=25)
    parser.add_argument("--shift", type=float, default=0.1)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    print("cloud | method | median ADD in diameters | below 10 % | ms")
    for case in cases_in(arguments.samples):
        _, cloud, true, model = case
        turn, shift_m = math.radians(arguments.turn_deg), arguments.shift * model.diameter_m
        starts = starts_near(true, turn, shift_m)
        surface = prepare_surface(model)
        report(case, "ours", lambda s, c=cloud, f=surface: refine_pose(c, s, f).camera_from_model,
               starts)  # fmt: skip
        for kind in ("PLANE_ICP", "GICP"):
            report(case, f"small_gicp {kind}", peer(cloud, model, kind), starts)


if __name__ == "__main__":
    main()
