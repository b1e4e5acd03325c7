"""Laws of the baselines: crops, rotations, points in any order, heads of each class."""

from dataclasses import replace
from itertools import permutations

import torch
import torch.nn.functional as F
from tests.pose.synthetic_objects import bracket
from torch import Tensor

from depthpose.core.camera import project
from depthpose.core.render import rasterize
from depthpose.core.rigid import Rigid, perturb
from depthpose.pose.geometry.grid import rotation_from_z_to
from depthpose.pose.losses import model_point_loss
from depthpose.pose.mesh import drawn_triangles, sample_surface
from depthpose.pose.networks.baselines import (
    EMPTY,
    DepthCrop,
    DepthImageConfig,
    DepthImageNet,
    PointNet,
    PointNetConfig,
    cut_depth,
    make_poses,
)
from depthpose.pose.types import ViewInput, VotingPoints

K = torch.tensor([[500.0, 0, 160], [0, 510.0, 120], [0, 0, 1]], dtype=torch.float64)
SMALL = DepthImageConfig(classes=3, crop_px=32, widths=(4, 4, 8, 8))
POINTNET = PointNetConfig(classes=2, keypoints=4, local=(8, 8), pooled=(8, 8, 16), head=(16, 8, 8))


def regressed(numbers: Tensor) -> Rigid:
    """Give the poses of nine numbers, in a crop a metre wide about the camera's own axes."""
    eye, count = torch.eye(3).to(numbers), len(numbers)
    crop = DepthCrop(torch.zeros(count, 1, 4, 4), eye.expand(count, 3, 3),
                     numbers.new_zeros(count, 3), numbers.new_ones(count))  # fmt: skip
    return make_poses(numbers, crop)


def turned(seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    numbers = F.pad(torch.randn(1, 6, generator=generator), (0, 3))
    return regressed(numbers).R[0]


def view_of(pose: Rigid, size: tuple[int, int] = (240, 320)) -> ViewInput:
    triangles = pose.apply(drawn_triangles(bracket()).reshape(-1, 3)).reshape(-1, 3, 3)
    depth_m = rasterize(triangles, K, size[1], size[0]).depth_m
    return ViewInput(name="v", depth_m=depth_m, mask=depth_m.isfinite(), K=K, object="bracket")


def batched(crop: DepthCrop) -> DepthCrop:
    return DepthCrop(*(part[None] for part in crop))


# the crop


def test_the_middle_of_the_crop_projects_to_the_middle_of_the_box() -> None:
    view = view_of(Rigid(turned(0), torch.tensor([0.1, -0.05, 0.8])))
    crop = cut_depth(view, SMALL)
    assert crop is not None
    rows, columns = view.mask.nonzero(as_tuple=True)
    middle = torch.stack([columns.min() + columns.max(), rows.min() + rows.max()]) / 2
    torch.testing.assert_close(project(crop.middle_m[None], K)[0], middle)
    assert torch.isclose(crop.middle_m[2], view.depth_m[view.mask].mean())
    on_axis = crop.R @ torch.tensor([0.0, 0, 1])
    torch.testing.assert_close(on_axis, crop.middle_m / crop.middle_m.norm())
    wide_m = 1.1 * float(max(rows.max() - rows.min(), columns.max() - columns.min()) + 1)
    assert torch.isclose(crop.side_m, wide_m * crop.middle_m[2] / 500)


def test_an_object_looks_alike_wherever_in_the_image_it_is() -> None:
    """The camera turns about its centre: the crop hardly changes, nor the pose in its frame."""
    pose = Rigid(turned(1), torch.tensor([0.0, 0.0, 0.9]))
    wide = replace(SMALL, crop_px=64, contrast=0.2)
    turn = rotation_from_z_to(torch.tensor([0.2, 0.1, 1.0])).float()
    there = Rigid(turn @ pose.R, turn @ pose.t_m)
    one, two = (cut_depth(view_of(p), wide) for p in (pose, there))
    assert one is not None
    assert two is not None
    near = ((one.image > EMPTY) == (two.image > EMPTY)).float().mean()
    assert float(near) > 0.9
    local = [crop.R.T @ p.R for crop, p in ((one, pose), (two, there))]
    angle = torch.acos(((local[0].T @ local[1]).trace() - 1) / 2)
    assert float(angle) < 0.03  # the box's middle moves by perspective
    assert float((pose.R.T @ there.R).trace()) < 2.96  # without the crop's frame: 0.22 rad


def test_a_square_is_cut_exactly() -> None:
    depth_m = torch.full((40, 60), torch.nan)
    depth_m[10:20, 30:40] = torch.linspace(0.9, 1.1, 10)[:, None]
    view = ViewInput(name="v", depth_m=depth_m, mask=depth_m.isfinite(), K=K, object="o")
    crop = cut_depth(view, replace(SMALL, crop_px=40, margin=2.0, contrast=0.1))
    assert crop is not None
    rows = crop.image[0][:, 20]
    assert bool((rows[:10] == EMPTY).all() & (rows[30:] == EMPTY).all())
    torch.testing.assert_close(rows[10:30:2], torch.linspace(-1, 1, 10), atol=1e-4, rtol=0.0)


def test_pixels_beyond_the_image_and_beside_the_mask_are_empty() -> None:
    depth_m = torch.ones(20, 20)
    mask = torch.zeros(20, 20, dtype=torch.bool)
    mask[:8, :6] = True
    view = ViewInput(name="v", depth_m=depth_m, mask=mask, K=K, object="o")
    crop = cut_depth(view, replace(SMALL, crop_px=32, margin=1.0))
    assert crop is not None
    assert float((crop.image == 0).float().mean()) == 6 / 8
    assert set(crop.image.unique().tolist()) == {0.0, EMPTY}


def test_too_few_pixels_give_no_crop_and_far_ones_are_left_out() -> None:
    view = view_of(Rigid(turned(0), torch.tensor([0.0, 0, 0.8])))
    depth_m = view.depth_m.clone()
    depth_m[:4, :4] = 3.0
    mask = view.mask.clone()
    mask[:4, :4] = True
    spoilt = replace(view, depth_m=depth_m, mask=mask)
    one, two = cut_depth(view, SMALL), cut_depth(spoilt, SMALL, bracket().diameter_m)
    assert one is not None
    assert two is not None
    assert torch.equal(one.image, two.image)
    assert cut_depth(replace(view, mask=view.mask & False), SMALL, 0.2) is None


# the depth image


def test_six_numbers_give_a_rotation_whose_columns_they_span() -> None:
    numbers = torch.randn(50, 6, dtype=torch.float64)
    R = regressed(F.pad(numbers, (0, 3))).R
    torch.testing.assert_close(R @ R.mT, torch.eye(3).double().expand(50, 3, 3))
    assert bool((torch.linalg.det(R) > 0).all())
    again = regressed(F.pad(torch.cat([R[..., 0], R[..., 1]], -1), (0, 3))).R
    torch.testing.assert_close(again, R)


def test_the_network_begins_at_the_crops_middle_and_each_class_has_its_head() -> None:
    torch.manual_seed(0)
    network = DepthImageNet(SMALL).eval()
    crop = cut_depth(view_of(Rigid(turned(0), torch.tensor([0.1, 0, 0.8]))), SMALL)
    assert crop is not None
    image = crop.image[None].expand(3, -1, -1, -1)
    outputs = network(image, torch.tensor([0, 1, 2]))
    assert outputs.shape == (3, 9)
    assert not torch.allclose(outputs[0], outputs[1])
    middle = torch.tensor([[1.0, 0, 0, 0, 1, 0, 0, 0, 0]])
    pose = make_poses(middle, batched(crop))
    torch.testing.assert_close(pose.t_m[0], crop.middle_m)
    torch.testing.assert_close(pose.R[0], crop.R)


def test_offsets_are_in_widths_of_the_crop() -> None:
    crop = DepthCrop(
        image=torch.zeros(1, 1, 4, 4), R=turned(3)[None], middle_m=torch.ones(1, 3),
        side_m=torch.tensor([0.5]),
    )  # fmt: skip
    pose = make_poses(torch.tensor([[1.0, 0, 0, 0, 1, 0, 0, 0, 2.0]]), crop)
    torch.testing.assert_close(pose.t_m[0], torch.ones(3) + turned(3)[:, 2])


def test_the_network_of_default_size_is_resnet_18s() -> None:
    # The encoder with one channel in, and nine outputs.
    assert sum(p.numel() for p in DepthImageNet().parameters()) == 11_176_512 - 6_272 + 4_617


# the loss on model points


def test_the_loss_is_add_and_the_same_for_every_symmetric_truth() -> None:
    points_m = sample_surface(bracket(), 200)[0][None]
    half = Rigid(torch.diag(torch.tensor([-1.0, -1, 1])), torch.zeros(3))
    copies = Rigid(torch.stack([torch.eye(3), half.R])[None], torch.zeros(1, 2, 3))
    true = Rigid(turned(1)[None], torch.tensor([[0.1, 0.2, 0.9]]))
    found = perturb(true, torch.tensor([[0.1, 0.0, 0.2, 0.01, 0, 0.02]]))
    alone = Rigid(copies.R[:, :1], copies.t_m[:, :1])
    by_hand = (found.apply(points_m) - true.apply(points_m)).norm(dim=-1).mean()
    assert torch.isclose(model_point_loss(found, true, points_m, alone)[0], by_hand)
    other = Rigid(true.R @ half.R, true.t_m)
    losses = [model_point_loss(found, t, points_m, copies) for t in (true, other)]
    torch.testing.assert_close(losses[0], losses[1])
    assert float(model_point_loss(other, true, points_m, copies)) < 1e-6
    assert float(model_point_loss(other, true, points_m, alone)) > 0.01


def test_the_loss_brings_a_pose_to_its_truth() -> None:
    points_m = sample_surface(bracket(), 200)[0][None]
    copies = Rigid(torch.eye(3)[None, None], torch.zeros(1, 1, 3))
    true = Rigid(turned(1)[None], torch.zeros(1, 3))
    numbers = torch.tensor([[1.0, 0, 0, 0, 1, 0, 0.1, 0, 0]], requires_grad=True)
    adam = torch.optim.Adam([numbers], 0.02)
    for _ in range(300):
        adam.zero_grad()
        found = regressed(numbers)
        model_point_loss(found, true, points_m, copies).sum().backward()
        adam.step()
    found = regressed(numbers)
    assert float(model_point_loss(found, true, points_m, copies)[0].detach()) < 0.004


# PointNet


def test_pointnet_of_default_size() -> None:
    assert 3_500_000 < sum(p.numel() for p in PointNet().parameters()) < 3_600_000


def test_the_order_of_points_and_the_company_of_clouds_change_nothing() -> None:
    torch.manual_seed(0)
    network = PointNet(POINTNET).eval()
    for layer in (network.turn_points, network.turn_features):
        assert layer is not None
        torch.nn.init.normal_(layer.final.weight, std=0.1)
    clouds = [0.1 * torch.randn(n, 3) for n in (5, 9, 1)]
    alone = [network(c, torch.zeros(len(c), dtype=torch.long)) for c in clouds]
    for order in permutations(range(3)):
        points = torch.cat([clouds[i].flip(0) for i in order])
        cloud = torch.cat([torch.full((len(clouds[i]),), place) for place, i in enumerate(order)])
        together = network(points, cloud).split([len(clouds[i]) for i in order])
        for part, i in zip(together, order, strict=True):
            torch.testing.assert_close(part, alone[i].flip(0), rtol=1e-4, atol=1e-5)


def test_each_point_is_answered_for_its_class_about_its_clouds_mean() -> None:
    network = PointNet(POINTNET).eval()
    points = 0.1 * torch.randn(6, 3)
    every = network(points, torch.zeros(6, dtype=torch.long))
    assert every.shape == (6, 2, 4, 3)
    rows = torch.zeros(6, 4, dtype=torch.long)
    # Wherever the cloud is: only places about its mean are looked at.
    classes = torch.tensor([0, 1, 1, 0, 1, 0])
    seen = VotingPoints(
        points_m=points + 1.0,
        coordinates=rows,
        features=torch.ones(6, 1),
        class_of_point=classes,
    )
    own = network.directions(seen)
    about = network(points - points.mean(0), rows[:, 0])
    torch.testing.assert_close(own, about[torch.arange(6), classes], rtol=1e-4, atol=1e-5)


def test_every_weight_of_pointnet_learns_and_transforms_begin_as_nothing() -> None:
    torch.manual_seed(0)
    network = PointNet(POINTNET)
    points, cloud = 0.1 * torch.randn(20, 3), torch.arange(20) // 10
    for layer in (network.turn_points, network.turn_features):
        turns = layer(torch.randn(20, layer.width), [10, 10])
        torch.testing.assert_close(turns, torch.eye(layer.width).expand_as(turns))
        torch.nn.init.normal_(layer.final.weight, std=0.1)
    network(points, cloud).square().sum().backward()
    assert all(p.grad is not None and bool(p.grad.isfinite().all()) for p in network.parameters())


def test_a_training_step_takes_a_cloud_of_one_point() -> None:
    network = PointNet(POINTNET).train()
    assert network(torch.zeros(1, 3), torch.zeros(1, dtype=torch.long)).isfinite().all()


def test_a_view_of_double_precision_is_cropped() -> None:
    view = view_of(Rigid(turned(0), torch.tensor([0.1, -0.05, 0.8])))
    single = cut_depth(view, SMALL)
    double = cut_depth(replace(view, depth_m=view.depth_m.double()), SMALL)
    assert single is not None
    assert double is not None
    torch.testing.assert_close(double.R.float(), single.R)
    torch.testing.assert_close(double.middle_m.float(), single.middle_m)
