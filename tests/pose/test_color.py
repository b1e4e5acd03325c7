"""Colour as evidence: the right one of copies, whatever the light, and nothing where it is mute."""

import math
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
import torch
from tests.pose.textured_objects import (
    CAN_M,
    HEIGHT,
    WIDTH,
    K,
    Light,
    drawn_view,
    random_pose,
    saved_glb,
    textured_box,
    textured_can,
)
from torch import Tensor

from depthpose.core.rigid import Rigid, geodesic_rad, rotation_by
from depthpose.pose.mesh import read_model, with_found_symmetries
from depthpose.pose.registration import Registration
from depthpose.pose.types import Axis, ColorImage, ObjectModel, Symmetries
from depthpose.pose.verify import color_copies
from depthpose.pose.verify.color import measure_color_agreement
from depthpose.pose.verify.color_copies import align_print, propose_color_copies, rotate_to_print

Z = Axis(direction=torch.tensor([0.0, 0, 1]), point_m=torch.zeros(3))


def half_turns(pose: Rigid) -> Rigid:
    """A pose, and the three half turns about the model's axes from it."""
    turns = rotation_by(math.pi * torch.eye(3).double())
    return Rigid(
        torch.cat([pose.R[None], pose.R @ turns]), pose.t_m.expand(4, 3).contiguous()
    ).double()


def moved(poses: Rigid, seed: int, share: float, diameter_m: float) -> Rigid:
    """Poses that are all off by a share of the diameter, and by as much of a radian."""
    random = torch.Generator().manual_seed(seed)
    turn = torch.randn(3, generator=random).double()
    shift = torch.randn(3, generator=random).double()
    R = rotation_by(share * turn / turn.norm())
    return Rigid(poses.R @ R, poses.t_m + share * diameter_m * shift / shift.norm())


@cache
def box(seed: int = 0) -> ObjectModel:
    with TemporaryDirectory() as folder:
        return read_model(saved_glb(textured_box(seed), Path(folder) / "box.glb"), "m")


@cache
def can(seed: int = 0) -> ObjectModel:
    with TemporaryDirectory() as folder:
        return read_model(saved_glb(textured_can(seed), Path(folder) / "can.glb"), "m")


@pytest.mark.parametrize("seed", range(8))
def test_the_right_half_turn_of_a_box_is_chosen(seed: int) -> None:
    model, pose = box(seed), random_pose(seed)
    random = torch.Generator().manual_seed(seed)
    light = Light(
        toward=tuple(torch.randn(3, generator=random).tolist()),
        ambient=0.3,
        gains=tuple((0.6 + 0.8 * torch.rand(3, generator=random)).tolist()),
        noise=0.03,
        seed=seed,
    )
    view = drawn_view(textured_box(seed), pose, light)
    agreement = measure_color_agreement(
        moved(half_turns(pose), seed, 0.01, model.diameter_m), model, view
    )
    likelihood = agreement.log_likelihood
    assert int(likelihood.argmax()) == 0
    assert float(likelihood[0] - likelihood[1:].max()) > math.log(1000)
    assert float(agreement.correlation[0].min()) > 0.7


def test_wrong_prints_are_as_likely_as_chance_lets_them_be() -> None:
    # Of prints that have nothing to do with the image, twice the log likelihood of each of three
    # correlations is chi-squared with one degree of freedom in half of the cases, else 0.
    wrong: list[Tensor] = []
    for seed in range(6):
        model, pose = box(seed), random_pose(seed)
        view = drawn_view(textured_box(seed), pose)
        wrong.append(measure_color_agreement(half_turns(pose), model, view).log_likelihood[1:])
    every = torch.cat(wrong)
    assert float(every.mean()) < 2.0  # 0.75 were it exact
    assert float((every > math.log(100)).double().mean()) < 0.1
    assert float(every.max()) > 0.5  # and it is no constant


def test_exposure_white_balance_and_gamma_change_little() -> None:
    model, pose = box(), random_pose(3)
    plain = drawn_view(textured_box(), pose, Light(noise=0.005))
    assert plain.color is not None
    dim = drawn_view(textured_box(), pose, Light(gains=(0.5, 0.35, 0.25), noise=0.005))
    contrast = replace(plain, color=replace(plain.color, rgb=plain.color.rgb**1.4))
    first = measure_color_agreement(half_turns(pose), model, plain).correlation
    for view in (dim, contrast):
        other = measure_color_agreement(half_turns(pose), model, view).correlation
        assert torch.allclose(first, other, atol=0.08)


def test_light_from_one_side_is_no_print() -> None:
    # A can of one colour but for a thin line, lit from the left: brightness falls off around it.
    model, mesh = can(), textured_can()
    mesh.visual.material.image.paste((120, 120, 120), (0, 0, 512, 256))
    pose = Rigid(
        rotation_by(torch.tensor([math.pi / 2, 0, 0]).double()), torch.tensor([0, 0, 0.5]).double()
    )
    view = drawn_view(mesh, pose, Light(toward=(-1, 0, -0.4), ambient=0.1))
    spins = pose[None] @ Rigid(
        rotation_by(torch.linspace(0, 6, 20).double()[:, None] * Z.direction.double()),
        torch.zeros(20, 3).double(),
    )
    assert float(measure_color_agreement(spins, model, view).log_likelihood.max()) < math.log(100)


def test_colour_is_mute_without_print_or_image() -> None:
    model, pose = box(), random_pose(1)
    view = drawn_view(textured_box(), pose)
    assert model.colors is not None
    assert view.color is not None
    grey = replace(model, colors=replace(model.colors, rgb=torch.full_like(model.colors.rgb, 0.4)))
    white = replace(view, color=replace(view.color, rgb=torch.ones(3, HEIGHT, WIDTH)))
    nothing = replace(view, mask=torch.zeros_like(view.mask))
    cases = [
        (replace(model, colors=None), view),
        (grey, view),
        (model, replace(view, color=None)),
        (model, white),
        (model, nothing),
    ]
    for one, seen in cases:
        agreement = measure_color_agreement(half_turns(pose), one, seen)
        assert agreement.log_likelihood.tolist() == [0.0] * 4
        assert agreement.correlation.tolist() == [[0.0] * 3] * 4


def test_colour_of_clipped_pixels_is_not_compared() -> None:
    model, pose = box(), random_pose(2)
    bright = drawn_view(textured_box(), pose, Light(gains=(2.5, 2.5, 2.5)))
    agreement = measure_color_agreement(half_turns(pose), model, bright)
    assert int(agreement.log_likelihood.argmax()) == 0
    assert float(agreement.correlation[0, 1:].min()) > 0.6


def test_a_colour_camera_beside_the_depth_camera() -> None:
    model, pose = box(), random_pose(4)
    beside = Rigid(
        rotation_by(torch.tensor([0.01, -0.03, 0.02]).double()),
        torch.tensor([0.05, 0.002, -0.004]).double(),
    )
    color_K = torch.tensor([[900.0, 0, 330], [0, 905, 230], [0, 0, 1]]).double()
    view = drawn_view(
        textured_box(), pose, color_from_depth=beside, color_K=color_K, size=(640, 480)
    )
    assert view.color is not None
    agreement = measure_color_agreement(half_turns(pose), model, view)
    assert float(agreement.correlation[0].min()) > 0.8
    assert float(agreement.log_likelihood[0] - agreement.log_likelihood[1:].max()) > 10
    # The same image taken for one of the depth camera's own frame has the print elsewhere.
    wrong = replace(view, color=replace(view.color, color_from_depth=None))
    apart = measure_color_agreement(half_turns(pose), model, wrong)
    assert float(apart.correlation[0].max()) < 0.7


def test_what_is_hidden_is_not_compared() -> None:
    model, pose = box(), random_pose(5)
    view = drawn_view(textured_box(), pose)
    assert view.color is not None
    columns = view.mask.nonzero()[:, 1].sort().values
    middle = int(columns[len(columns) // 2])
    depth_m, rgb = view.depth_m.clone(), view.color.rgb.clone()
    depth_m[:, :middle] = 0.4
    random = torch.Generator().manual_seed(0)
    rgb[:, :, :middle] = torch.rand(rgb[:, :, :middle].shape, generator=random)
    hidden = replace(view, depth_m=depth_m, color=replace(view.color, rgb=rgb))
    whole, half = (
        measure_color_agreement(half_turns(pose), model, seen) for seen in (view, hidden)
    )
    assert 0.3 < float(half.visible_count[0] / whole.visible_count[0]) < 0.7
    assert float(half.correlation[0].min()) > 0.8
    assert int(half.log_likelihood.argmax()) == 0


def test_colour_tells_twins_apart() -> None:
    model, twin, pose = box(0), box(1), random_pose(6)
    view = drawn_view(textured_box(1), pose)
    one, other = (
        float(measure_color_agreement(half_turns(pose), m, view).log_likelihood.max())
        for m in (model, twin)
    )
    assert other - one > 10


@pytest.mark.parametrize("seed", range(4))
def test_the_spin_of_a_can_is_found(seed: int) -> None:
    model, pose = can(seed), random_pose(seed, 0.5)
    view = drawn_view(textured_can(seed), pose, Light(noise=0.03, seed=seed))
    spun = Rigid(pose.R @ rotation_by(torch.tensor([0, 0, 1.0 + seed]).double()), pose.t_m)
    found = rotate_to_print(moved(spun[None], seed, 0.01, model.diameter_m)[0], Z, model, view)
    assert len(found.R) <= 3
    # The pose is off by 1.2 mm, which is two degrees of the can's circumference.
    assert math.degrees(float(geodesic_rad(found.R[0], pose.R))) < 5
    likelihood = measure_color_agreement(found, model, view).log_likelihood
    assert int(likelihood.argmax()) == 0


def test_a_spin_without_colour_stays() -> None:
    model, pose = can(), random_pose(0, 0.5)
    view = replace(drawn_view(textured_can(), pose), color=None)
    found = rotate_to_print(pose, Z, model, view)
    assert torch.equal(found.R, pose.R[None])
    assert torch.equal(propose_color_copies(pose, model, view).R, pose.R[None])


@pytest.mark.slow
def test_copies_of_a_can_hold_the_right_one() -> None:
    # Upside down and spun: found in the shape as a half turn across the axis, and the axis.
    flip = Rigid(rotation_by(torch.tensor([[math.pi, 0, 0]]).double()), torch.zeros(1, 3).double())
    model = replace(can(), symmetries=Symmetries(discrete=flip, continuous=(Z,), is_found=True))
    pose = random_pose(1, 0.5)
    view = drawn_view(textured_can(), pose)
    wrong = Rigid(pose.R @ rotation_by(torch.tensor([0, 0, 2.0]).double()), pose.t_m) @ flip[0]
    copies = propose_color_copies(wrong, model, view)
    assert torch.equal(copies.R[0], wrong.R)
    best = copies[int(measure_color_agreement(copies, model, view).log_likelihood.argmax())]
    assert math.degrees(float(geodesic_rad(best.R, pose.R))) < 3
    # What the user declares alike is one answer, and no copy is proposed.
    declared = replace(model, symmetries=replace(model.symmetries, is_found=False))
    assert len(propose_color_copies(wrong, declared, view).R) < len(copies.R)


@pytest.mark.slow
def test_an_axis_of_many_turns_is_swept(monkeypatch: pytest.MonkeyPatch) -> None:
    # A can whose shape was found to be alike after turns by 30 degrees, upside down too.
    angles = torch.arange(1, 12).double() * (math.pi / 6)
    spins = rotation_by(angles[:, None] * Z.direction.double())
    flip = rotation_by(torch.tensor([[math.pi, 0, 0]]).double())
    turns = torch.cat([spins, flip, flip @ spins])
    off_m = torch.tensor([0.0001, -0.0002, 0.0]).double()
    found = Rigid(turns, off_m - turns @ off_m)
    model = replace(can(), symmetries=Symmetries(discrete=found, is_found=True))
    pose = random_pose(2, 0.5)
    view = drawn_view(textured_can(), pose)
    wrong = Rigid(pose.R @ rotation_by(torch.tensor([0, 0, 2.2]).double()), pose.t_m)
    for start in (wrong, Rigid(wrong.R @ flip[0], wrong.t_m)):
        copies = propose_color_copies(start, model, view)
        assert 2 <= len(copies.R) <= 9
        # Between the turns that were found, and the first of those that are proposed.
        assert math.degrees(float(geodesic_rad(copies.R[1], pose.R))) < 4
    monkeypatch.setattr(color_copies, "_MOST_COPIES", 1)
    assert len(propose_color_copies(wrong, model, view).R) == 2


@pytest.mark.parametrize("off_deg", [-13.0, 4.0, 18.0])
def test_a_spin_that_depth_does_not_fix_is_settled(off_deg: float) -> None:
    model = replace(can(), symmetries=Symmetries(continuous=(Z,), is_found=True))
    pose = random_pose(3, 0.5)
    view = drawn_view(textured_can(), pose)
    turn = rotation_by(math.radians(off_deg) * Z.direction.double())
    drifted = Rigid(pose.R @ turn, pose.t_m)
    settled = align_print(drifted, model, view)
    assert math.degrees(float(geodesic_rad(settled.R, pose.R))) < 2
    mute = align_print(drifted, model, replace(view, color=None))
    assert torch.equal(mute.R, drifted.R)
    declared = replace(model, symmetries=replace(model.symmetries, is_found=False))
    assert torch.equal(align_print(drifted, declared, view).R, drifted.R)


def test_half_turns_of_a_box_are_proposed() -> None:
    model, pose = box(), random_pose(6)
    view = drawn_view(textured_box(), pose)
    for wrong in half_turns(pose)[1:].R:
        copies = propose_color_copies(Rigid(wrong, pose.t_m), model, view)
        assert math.degrees(float(geodesic_rad(copies.R[1], pose.R))) < 1
        alone = propose_color_copies(
            Rigid(wrong, pose.t_m), model, view, motions=half_turns(pose)[:0]
        )
        assert torch.equal(alone.R, wrong[None])


def test_a_window_of_the_depth_image_changes_nothing() -> None:
    model, pose = box(), random_pose(7)
    view = drawn_view(textured_box(), pose)
    top, left = (int(k) - 2 for k in view.mask.nonzero().amin(0))
    assert top > 0
    shifted = view.K.clone()
    shifted[:2, 2] -= torch.tensor([float(left), float(top)])
    depth_m, mask = view.depth_m[top:, left:], view.mask[top:, left:]
    window = replace(view, depth_m=depth_m, mask=mask, K=shifted)
    one, other = (measure_color_agreement(half_turns(pose), model, seen) for seen in (view, window))
    assert torch.allclose(one.correlation, other.correlation, atol=1e-6)


def test_a_can_is_as_wide_as_drawn() -> None:
    # The fixture itself: a can's silhouette from the side is its diameter times its height.
    pose = Rigid(
        rotation_by(torch.tensor([math.pi / 2, 0, 0]).double()), torch.tensor([0, 0, 0.5]).double()
    )
    view = drawn_view(textured_can(), pose)
    rows, columns = view.mask.nonzero(as_tuple=True)
    width_px, height_px = columns.max() - columns.min() + 1, rows.max() - rows.min() + 1
    assert float(width_px) == pytest.approx(2 * CAN_M[0] / 0.5 * float(K[0, 0]), rel=0.03)
    assert float(height_px) == pytest.approx(CAN_M[1] / 0.466 * float(K[1, 1]), rel=0.05)
    assert isinstance(view.color, ColorImage)


@pytest.mark.slow
def test_a_printed_box_is_posed_as_its_print_says() -> None:
    """By shape alone a box fits at four poses; a colour image says which of them is right."""
    model = replace(box(), name="thing")
    net = Registration([with_found_symmetries(model)])
    pose = random_pose(1)
    view = drawn_view(textured_box(), pose)
    (found,) = net.estimate_many([view])
    assert found.camera_from_model is not None, found.reason
    assert math.degrees(float(geodesic_rad(found.camera_from_model.R.double(), pose.R))) < 3
    assert found.copy_certainty is not None
    assert found.copy_certainty > 0.9
    (by_shape,) = net.estimate_many([replace(view, color=None)])
    assert by_shape.is_ok, by_shape.reason
