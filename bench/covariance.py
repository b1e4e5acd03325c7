"""Whether poses err as much as they say, for four kinds of sensor.

    python bench/covariance.py [--views 2] [--repeats 8] [--offset-m 0.005]

Parts of the shipped weights ``parts`` are rendered 0.7 m away and measured again and again by each
kind of synthetic sensor; ICP begins at the true pose. All readings of a measurement are off by up
to ``--offset-m`` along the ray; where that is given, the covariance has the product's default for
it, and none where it is 0. Bias is how far the mean of the poses is off
at the middle of the object, along the ray and in all [mm], the mean over views; scatter and claimed
are standard deviations there, all three axes together. Squares are squared errors in units of the
covariance (Mahalanobis), whose median is 5.3 where errors are normal. Coverage is the share of
errors within what should hold 68 and 95 %: of the whole pose, and of the place along each axis of
the camera.
"""

import argparse

import torch
from scipy.stats import chi2
from torch import Tensor

from depthpose import GeoPoseNet
from depthpose.core.checkpoint import find_weights
from depthpose.core.loop import sample_generator
from depthpose.core.render import rasterize
from depthpose.core.rigid import Rigid, cross_matrix
from depthpose.pose.cloud import cloud_from_depth
from depthpose.pose.config import IcpConfig, SensorKind, SyntheticSensorConfig
from depthpose.pose.icp import refine_pose
from depthpose.pose.mesh import drawn_triangles
from depthpose.pose.surface import prepare_surface
from depthpose.pose.synthetic.views import random_rotation, simulate_depth
from depthpose.report.page import markdown_table

KINDS: tuple[SensorKind, ...] = ("structured light", "active stereo", "time of flight", "laser")
WIDTH, HEIGHT, FOCAL_PX, AWAY_M, BEHIND_M = 640, 480, 600.0, 0.7, 0.9
K = torch.tensor([[FOCAL_PX, 0, 319.5], [0, FOCAL_PX, 239.5], [0, 0, 1]], dtype=torch.float64)
SEED = 0xC0FA


def errors_of(found: Rigid, true: Rigid) -> Tensor:
    """The motion (rotation, translation) by which the truth differs from what was found."""
    turn = true.R @ found.R.mT
    about = torch.stack([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    return torch.cat([about / 2, true.t_m - turn @ found.t_m])


def view_rows(
    kind: SensorKind, number: int, seed: int, repeats: int, noise: float, offset_m: float
) -> dict[str, Tensor]:
    """Measure one view of a part again and again; errors at its middle, and what was claimed."""
    model = PARTS[number]
    surface, generator = SURFACES[number], sample_generator(seed, SEED)
    R, middle_m = random_rotation(generator).double(), surface.points_m.mean(0)
    true = Rigid(R, torch.tensor([0.02, -0.03, AWAY_M]).double() - R @ middle_m)
    at_m = true.apply(middle_m[None])[0]
    by = torch.cat([-cross_matrix(at_m), torch.eye(3).double()], 1)
    clean_m = rasterize(true.apply(drawn_triangles(model).double()), K, WIDTH, HEIGHT).depth_m
    mask = clean_m.isfinite()
    clean_m = torch.where(mask, clean_m, BEHIND_M).float()
    offs, squares, spreads = [], [], []
    sensor = SyntheticSensorConfig(
        kinds=(kind,), noise=(noise, noise), offset_m=(-offset_m, offset_m)
    )
    icp = IcpConfig() if offset_m else IcpConfig(sensor_offset_m=0.0)
    for _ in range(repeats):
        depth_m = simulate_depth(clean_m, (FOCAL_PX, FOCAL_PX), sensor, generator)
        cloud_m = cloud_from_depth(depth_m, mask & depth_m.isfinite(), K.float())
        refined = refine_pose(cloud_m.double(), true, surface, icp)
        off = errors_of(refined.camera_from_model, true)
        squares.append(off @ torch.linalg.solve(refined.covariance, off))
        offs.append(1000 * by @ off)
        spreads.append(1000 * (by @ refined.covariance @ by.mT).diagonal().sqrt())
    off_mm, ray = torch.stack(offs), at_m / at_m.norm()
    return {
        "off": off_mm, "std": torch.stack(spreads), "squares": torch.stack(squares),
        "ray": (off_mm.mean(0) @ ray)[None], "bias": off_mm.mean(0).norm()[None],
        "scatter": off_mm.var(0).sum().sqrt()[None],
    }  # fmt: skip


def main() -> None:
    """Print a row for each kind of sensor."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--views", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=8)
    parser.add_argument("--noise", type=float, default=1.0, help="times the noise of the kind")
    parser.add_argument("--offset-m", type=float, default=0.0, help="of all readings, at most")
    words = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    for kind in KINDS:
        every = [
            view_rows(kind, number, 100 * number + view, words.repeats, words.noise, words.offset_m)
            for number in range(len(PARTS))
            for view in range(words.views)
        ]
        one = {name: torch.cat([row[name] for row in every]) for name in every[0]}
        times = (one["off"] / one["std"]).abs()
        rows.append({
            "sensor": kind,
            "bias along the ray": round(float(one["ray"].mean()), 2),
            "bias": round(float(one["bias"].mean()), 2),
            "scatter": round(float(one["scatter"].mean()), 2),
            "claimed": round(float(one["std"].norm(dim=-1).mean()), 2),
            "squares": round(float(one["squares"].median()), 1),
            **{f"pose within {share:.0%}":
               f"{float((one['squares'] < float(chi2.ppf(share, 6))).double().mean()):.0%}"
               for share in (0.68, 0.95)},
            **{f"axis within {share:.0%}":
               f"{float((times < float(chi2.ppf(share, 1)) ** 0.5).double().mean()):.0%}"
               for share in (0.68, 0.95)},
        })  # fmt: skip
        print(rows[-1], flush=True)
    print(markdown_table(rows))


PARTS = [m for m in GeoPoseNet.load(find_weights("parts")).weights.models
         if not m.symmetries.continuous]  # fmt: skip
SURFACES = [prepare_surface(model) for model in PARTS]

if __name__ == "__main__":
    main()
