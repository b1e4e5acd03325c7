import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from depthpose.core.rigid import Rigid, geodesic_rad
from depthpose.pose.config import EvaluationConfig
from depthpose.pose.datasets import open_bop
from depthpose.pose.evaluate import prepare_errors
from depthpose.pose.evaluate.errors import METRICS
from depthpose.pose.mesh import read_model, symmetries_from_bop, symmetry_transforms
from depthpose.pose.metrics import (
    BOP_PIXELS,
    BOP_SHARES,
    VSD_DELTA_M,
    add_m,
    add_of_nearest_m,
    adds_m,
    auc,
    average_recall,
    mspd_px,
    mssd_m,
    vsd,
)
from depthpose.pose.types import Axis, Symmetries

K = torch.tensor(
    [[572.4114, 0, 325.2611], [0, 573.57043, 242.04899], [0, 0, 1]], dtype=torch.float64
)


def pose_of(R: list[float], t_mm: list[float]) -> Rigid:
    rotation = torch.tensor(R, dtype=torch.float64).reshape(3, 3)
    return Rigid(rotation, torch.tensor(t_mm, dtype=torch.float64) / 1000)


def random_pose(seed: int) -> Rigid:
    generator = torch.Generator().manual_seed(seed)
    q, _ = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64))
    return Rigid(q * torch.linalg.det(q), torch.tensor([0.1, -0.1, 0.9]).double())


def test_errors_are_those_of_the_bop_toolkit(real: Path) -> None:
    reference = json.loads((real / "reference/bop_errors/errors.json").read_text())
    folder = real / "pose/lm/models"
    info = json.loads((folder / "models_info.json").read_text())
    points, symmetries = {}, {}
    for number in {row["obj_id"] for row in reference["errors"]}:
        model = read_model(folder / f"obj_{number:06d}.ply", "mm")
        points[number] = model.vertices_m.double()[:: reference["vertex_stride"]]
        declared = symmetries_from_bop(info[str(number)], source="models_info.json")
        symmetries[number] = symmetry_transforms(declared)
    for row in reference["errors"]:
        estimated, true = pose_of(row["R_est"], row["t_est"]), pose_of(row["R_gt"], row["t_gt"])
        cloud, turns = points[row["obj_id"]], symmetries[row["obj_id"]]
        ours = [
            1000 * float(add_m(estimated, true, cloud)),
            1000 * float(adds_m(estimated, true, cloud)),
            1000 * float(mssd_m(estimated, true, cloud, turns)),
            float(mspd_px(estimated, true, cloud, turns, K)),
            math.degrees(float(geodesic_rad(estimated.R.double(), true.R.double()))),
            1000 * float((estimated.t_m.double() - true.t_m.double()).norm()),
        ]
        names = ("add_mm", "adds_mm", "mssd_mm", "mspd_px", "rotation_deg", "translation_mm")
        assert ours == pytest.approx([row[name] for name in names], rel=1e-6, abs=2e-6)


def test_vsd_is_that_of_the_bop_toolkit(real: Path) -> None:
    reference = json.loads((real / "reference/bop_errors/errors.json").read_text())["vsd"]
    data = open_bop(real / "pose/lm").of_objects("cat")
    assert len(data) == 1
    cat = data.objects[6]
    context = prepare_errors(cat, EvaluationConfig(vsd_delta_m=VSD_DELTA_M))
    first = reference["rows"][0]
    true = replace(data.instances[0], camera_from_model=pose_of(first["R_est"], first["t_est"]))
    assert tuple(reference["taus"]) == BOP_SHARES
    for row in reference["rows"]:
        ours = torch.as_tensor(
            METRICS["vsd"].measure(pose_of(row["R_est"], row["t_est"]), true, context)
        )
        assert ours.tolist() == pytest.approx(row["vsd"], abs=0.01)


def test_an_exact_pose_has_no_error_and_a_symmetric_one_neither() -> None:
    pose, points = random_pose(0), torch.rand(50, 3).double() * 0.1
    axis = Axis(direction=torch.tensor([0.0, 0, 1]).double(), point_m=torch.zeros(3).double())
    turns = symmetry_transforms(Symmetries(continuous=(axis,)))
    ring = torch.tensor([math.cos(1.0), math.sin(1.0)])
    turned = pose @ Rigid(
        torch.tensor([[ring[0], -ring[1], 0], [ring[1], ring[0], 0], [0, 0, 1]]).double(),
        torch.zeros(3).double(),
    )
    assert float(add_m(pose, pose, points)) == 0
    assert float(mssd_m(pose, pose, points, turns)) < 1e-9
    assert float(add_m(turned, pose, points)) > 0.01
    # BOP's steps are 0.02 rad: half a step at a radius below 0.15 m stays under 1.5 mm.
    assert float(mssd_m(turned, pose, points, turns)) < 0.0015
    assert float(mspd_px(turned, pose, points, turns, K)) < 1.5
    assert float(add_of_nearest_m(turned, pose, points, turns)) < 0.001


def test_add_s_forgives_what_no_symmetry_allows() -> None:
    grid = torch.cartesian_prod(*[torch.linspace(-0.05, 0.05, 21)] * 2, torch.zeros(1)).double()
    half = Rigid(torch.diag(torch.tensor([-1.0, -1, 1])).double()[None], torch.zeros(1, 3).double())
    halves = symmetry_transforms(Symmetries(discrete=half))
    true = Rigid(torch.eye(3).double(), torch.zeros(3).double())
    quarter = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]).double()
    turned, back = (Rigid(R, torch.zeros(3).double()) for R in (quarter, half.R[0]))
    assert float(adds_m(turned, true, grid)) < 1e-9
    assert float(add_of_nearest_m(turned, true, grid, halves)) > 0.02
    assert float(add_of_nearest_m(back, true, grid, halves)) < 1e-9


def test_both_ways_of_add_s_differ_where_the_shape_is_uneven() -> None:
    points = torch.cat([torch.zeros(9, 3), torch.tensor([[0.1, 0, 0]])]).double()
    true = Rigid(torch.eye(3).double(), torch.zeros(3).double())
    moved = Rigid(torch.eye(3).double(), torch.tensor([0.1, 0, 0]).double())
    assert float(adds_m(moved, true, points)) == pytest.approx(0.09)
    assert float(adds_m(true, moved, points)) == pytest.approx(0.01)


def test_add_takes_batches() -> None:
    poses = [random_pose(i) for i in range(4)]
    batch = Rigid(torch.stack([p.R for p in poses]), torch.stack([p.t_m for p in poses]))
    points = torch.rand(20, 3).double()
    for errors, one in ((add_m(batch, poses[0], points), add_m),
                        (adds_m(batch, Rigid(poses[0].R.expand(4, 3, 3), poses[0].t_m.expand(4, 3)),
                                points), adds_m)):  # fmt: skip
        assert errors.tolist() == pytest.approx([float(one(p, poses[0], points)) for p in poses])


def test_missing_estimates_stay_in_the_denominator() -> None:
    errors = torch.tensor([0.0, 0.05, math.inf, math.nan])
    assert auc(errors) == pytest.approx((1 + 0.5) / 4)
    assert average_recall(errors[:, None], BOP_SHARES) == pytest.approx((10 + 9) / 40)
    assert len(BOP_PIXELS) == 10


def test_vsd_counts_what_is_seen_in_one_render_alone() -> None:
    flat = torch.full((4, 4), 1.0).double()
    poses = {0.0: flat.clone(), 1.0: flat.clone()}
    poses[0.0][:, 2:] = torch.nan
    poses[1.0][:, :1] = 0

    def render(pose: Rigid) -> Tensor:
        return poses[float(pose.t_m[0])]

    first = Rigid(torch.eye(3).double(), torch.tensor([0.0, 0, 0]).double())
    second = Rigid(torch.eye(3).double(), torch.tensor([1.0, 0, 0]).double())
    # Truth covers columns 0-1, the estimate 1-3: one of four columns is common and right.
    assert vsd(second, first, flat, K, render, [0.01]).tolist() == [0.75]
    nothing = torch.full((4, 4), 0.5).double()
    assert vsd(second, first, nothing, K, render, [0.01, 0.1]).tolist() == [
        1,
        1,
    ]


def test_a_point_behind_the_camera_has_no_picture() -> None:
    pose = Rigid(torch.eye(3).double(), torch.tensor([0, 0, -1.0]).double())
    eye = symmetry_transforms(Symmetries())
    assert math.isinf(float(mspd_px(pose, random_pose(1), torch.zeros(1, 3), eye, K)))


def test_vsd_is_along_the_ray_of_a_slanted_pixel() -> None:
    """A pixel with ray (x, y, 1), x = -3 y by the skew: 0.1 m of depth are 0.1 |ray| along it."""
    slanted = torch.tensor([[10.0, 30, 0], [0, 10, 0], [0, 0, 1]], dtype=torch.float64)
    true, found = (pose_of([1, 0, 0, 0, 1, 0, 0, 0, 1], [k, 0, 0]) for k in (0, 1))

    def render(pose: Rigid) -> Tensor:
        return torch.full((11, 1), 1.0 if float(pose.t_m[0]) == 0 else 1.1, dtype=torch.float64)

    measured = torch.zeros(11, 1, dtype=torch.float64)
    y = torch.arange(11).double() / 10
    off = float((0.1 * (1 + 10 * y.square()).sqrt() >= 0.2).double().mean())
    assert off == 5 / 11
    assert vsd(found, true, measured, slanted, render, [0.2]).tolist() == pytest.approx([off])
