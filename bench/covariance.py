"""Whether the covariance of a pose agrees with its errors, for four kinds of sensor.

    python bench/covariance.py [--views 2] [--repeats 8] [--offset-m 0.005]

Parts of the shipped weights ``parts`` are rendered 0.7 m away and measured repeatedly by each kind
of synthetic sensor; ICP starts from the true pose. With ``--offset-m`` all readings of a
measurement are off by up to so much along the ray, and the covariance allows for the product's
default offset; else for none. Columns, at the middle of the object:

- bias along the ray, bias: error of the mean pose [mm], the mean over views
- scatter, claimed: standard deviation [mm] of the errors and by the covariance, of all three axes
- squares: median squared error in units of the covariance (Mahalanobis); 5.3 for normal errors
- pose within, axis within: share of errors in the region that should hold 68 and 95 %, of the whole
  pose and of the position along each axis of the camera
"""

import torch
from scipy.stats import chi2
from shared import make_parser
from torch import Tensor

from depthpose import GeoPoseNet
from depthpose.core.camera.pinhole import intrinsics
from depthpose.core.checkpoint import find_weights
from depthpose.core.loop import make_sample_generator
from depthpose.core.render import rasterize
from depthpose.core.rigid import Rigid, cross_matrix
from depthpose.pose.cloud import cloud_from_depth
from depthpose.pose.config import IcpConfig, SensorKind, SyntheticSensorConfig
from depthpose.pose.geometry.surface import prepare_surface
from depthpose.pose.icp import refine_exactly
from depthpose.pose.mesh import drawn_triangles
from depthpose.pose.synthetic.depth_sensors import simulate_depth
from depthpose.pose.synthetic.random_numbers import random_rotation
from depthpose.report.page import format_markdown_table

KINDS: tuple[SensorKind, ...] = ("structured light", "active stereo", "time of flight", "laser")
WIDTH, HEIGHT, FOCAL_PX = 640, 480, 600.0
DISTANCE_M = 0.7
WALL_M = 0.9
K = intrinsics(FOCAL_PX, FOCAL_PX, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)
SEED = 0xC0FA
SHARES = (0.68, 0.95)


def motion_to_truth(pose: Rigid, truth: Rigid) -> Tensor:
    """Compute the small motion (rotation, translation) from an estimated pose to the true one."""
    R = truth.R @ pose.R.mT
    rotation = torch.stack([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / 2
    return torch.cat([rotation, truth.t_m - R @ pose.t_m])


def measure_view(
    kind: SensorKind, number: int, seed: int, repeats: int, noise: float, offset_m: float
) -> dict[str, Tensor]:
    """Measure one view of a part repeatedly; return errors and claimed deviations at its middle."""
    model = PARTS[number]
    surface = SURFACES[number]
    generator = make_sample_generator(seed, SEED)
    R = random_rotation(generator).double()
    middle_m = surface.points_m.mean(0)
    truth = Rigid(R, torch.tensor([0.02, -0.03, DISTANCE_M]).double() - R @ middle_m)
    middle_in_camera_m = truth.apply(middle_m[None])[0]
    # Times a small motion, the shift of the middle.
    jacobian = torch.cat([-cross_matrix(middle_in_camera_m), torch.eye(3).double()], 1)
    part_m = rasterize(truth.apply(drawn_triangles(model).double()), K, WIDTH, HEIGHT).depth_m
    mask = part_m.isfinite()
    scene_m = torch.where(mask, part_m, WALL_M).float()
    sensor = SyntheticSensorConfig(
        kinds=(kind,), noise=(noise, noise), offset_m=(-offset_m, offset_m)
    )
    sensor_offset_m = IcpConfig.sensor_offset_m if offset_m else 0.0
    squares, errors_mm, deviations_mm = [], [], []
    for _ in range(repeats):
        depth_m = simulate_depth(scene_m, (FOCAL_PX, FOCAL_PX), sensor, generator)
        cloud_m = cloud_from_depth(depth_m, mask & depth_m.isfinite(), K.float())
        refined = refine_exactly(cloud_m.double(), truth, surface, sensor_offset_m=sensor_offset_m)
        motion = motion_to_truth(refined.camera_from_model, truth)
        squares.append(motion @ torch.linalg.solve(refined.covariance, motion))
        errors_mm.append(1000 * jacobian @ motion)
        covariance_m2 = jacobian @ refined.covariance @ jacobian.mT
        deviations_mm.append(1000 * covariance_m2.diagonal().sqrt())
    error_mm = torch.stack(errors_mm)
    mean_mm = error_mm.mean(0)
    ray = middle_in_camera_m / middle_in_camera_m.norm()
    return {
        "error": error_mm,
        "deviation": torch.stack(deviations_mm),
        "squares": torch.stack(squares),
        "bias along the ray": (mean_mm @ ray)[None],
        "bias": mean_mm.norm()[None],
        "scatter": error_mm.var(0).sum().sqrt()[None],
    }


def coverage(squares: Tensor, share: float, degrees_of_freedom: int) -> str:
    """Compute the share of squared errors in the region that should hold ``share`` of them."""
    limit = float(chi2.ppf(share, degrees_of_freedom))
    return f"{float((squares < limit).double().mean()):.0%}"


def main() -> None:
    """Print a row for each kind of sensor."""
    parser = make_parser(__doc__)
    parser.add_argument("--views", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=8)
    parser.add_argument("--noise", type=float, default=1.0, help="times the noise of the kind")
    parser.add_argument("--offset-m", type=float, default=0.0, help="of all readings, at most")
    options = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    for kind in KINDS:
        views = [
            measure_view(
                kind, part, 100 * part + view, options.repeats, options.noise, options.offset_m
            )
            for part in range(len(PARTS))
            for view in range(options.views)
        ]
        values = {name: torch.cat([view[name] for view in views]) for name in views[0]}
        axis_squares = (values["error"] / values["deviation"]).square()
        rows.append(
            {
                "sensor": kind,
                "bias along the ray": round(float(values["bias along the ray"].mean()), 2),
                "bias": round(float(values["bias"].mean()), 2),
                "scatter": round(float(values["scatter"].mean()), 2),
                "claimed": round(float(values["deviation"].norm(dim=-1).mean()), 2),
                "squares": round(float(values["squares"].median()), 1),
                **{
                    f"pose within {share:.0%}": coverage(values["squares"], share, 6)
                    for share in SHARES
                },
                **{
                    f"axis within {share:.0%}": coverage(axis_squares, share, 1) for share in SHARES
                },
            }
        )
        print(rows[-1], flush=True)
    print(format_markdown_table(rows))


PARTS = [
    model
    for model in GeoPoseNet.load(find_weights("parts")).weights.models
    if not model.symmetries.continuous
]
SURFACES = [prepare_surface(model) for model in PARTS]

if __name__ == "__main__":
    main()
