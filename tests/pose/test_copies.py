"""Symmetries, near-symmetric copies and look-alikes of a model, and the words for them."""

import math
import re
from dataclasses import replace
from functools import cache
from typing import Any

import pytest
import torch
import trimesh as _trimesh
from tests.pose.synthetic_objects import bar, bottle, box_faces, boxes, bracket, gear, pose_at

from depthpose.core.rigid import Rigid, geodesic_rad
from depthpose.pose.mesh import make_model, turn_about, with_found_symmetries
from depthpose.pose.synthetic.parts import make_part
from depthpose.pose.verify.copies import (
    SymmetricCopies,
    describe_difference,
    describe_near_symmetries,
    find_copies,
)

trimesh: Any = _trimesh  # its classes carry no types
ORIGIN = torch.zeros(3, dtype=torch.float64)


def rotation(axis: list[float], degrees: float) -> Rigid:
    angle = torch.tensor(math.radians(degrees), dtype=torch.float64)
    return turn_about(torch.tensor(axis).double(), ORIGIN, angle)


def degrees_to(motions: Rigid, wanted: Rigid) -> float:
    """Angle between a motion and the nearest of several."""
    if len(motions.R) == 0:
        return math.inf
    return math.degrees(float(geodesic_rad(motions.R, wanted.R.expand_as(motions.R)).min()))


def every_copy(copies: SymmetricCopies) -> Rigid:
    """The copies with those of their poses that are the same after a symmetry."""
    moved = copies.near_copies[:, None] @ copies.symmetries
    return Rigid(moved.R.flatten(0, 1), moved.t_m.flatten(0, 1))


@cache
def copies_of_gear(keyway_mm: float) -> SymmetricCopies:
    return find_copies(with_found_symmetries(gear(12, keyway_mm)))


@pytest.mark.slow
def test_a_gear_is_the_same_after_a_step_of_any_number_of_teeth() -> None:
    copies = copies_of_gear(0.0)
    for step in range(1, 12):
        about = rotation([0.0, 0, 1.0], 30.0 * step)
        assert degrees_to(copies.symmetries, about) < 2, step
    assert len(copies.near_copies.R) <= 1, "all are one pose, but for the two faces at most"


def test_a_keyway_makes_the_steps_of_a_gear_other_poses() -> None:
    copies = copies_of_gear(1.0)
    for step in range(1, 12):
        about = rotation([0.0, 0, 1.0], 30.0 * step)
        assert degrees_to(copies.symmetries, about) > 15, step
        assert degrees_to(every_copy(copies), about) < 2, step


def test_a_gear_says_how_much_its_keyway_deviates() -> None:
    lines = describe_near_symmetries(with_found_symmetries(gear(12, 1.0)))
    assert lines
    for line in lines:
        assert re.fullmatch(r"rotated by \d+ degrees about .* \(\d+\.\d%\)", line), line


@pytest.mark.slow
def test_the_ends_of_a_bar_that_differ_a_little_are_copies_and_no_symmetries() -> None:
    copies = find_copies(with_found_symmetries(bar(0.002)))
    for axis in ([0, 1.0, 0], [0, 0, 1.0]):
        assert degrees_to(copies.symmetries, rotation(axis, 180)) > 90
        assert degrees_to(every_copy(copies), rotation(axis, 180)) < 2
    # About the long axis it is the same.
    assert degrees_to(copies.symmetries, rotation([1.0, 0, 0], 180)) < 2


def test_what_is_declared_is_no_copy() -> None:
    flange = find_copies(make_part("flange"))
    for step in range(1, 6):
        assert degrees_to(flange.symmetries, rotation([0.0, 0, 1.0], 60.0 * step)) < 1
        assert degrees_to(flange.near_copies, rotation([0.0, 0, 1.0], 60.0 * step)) > 20
    upright = find_copies(bottle())
    assert len(upright.near_copies.R) == 1, "after any rotation about its axis it is one pose"
    assert float(upright.near_copies.R[0, 2, 2]) < -0.99, "it may stand on its head"


def test_a_mug_has_an_axis_of_near_symmetry() -> None:
    axis = find_copies(make_part("mug", 1)).near_axis
    assert axis is not None
    assert abs(float(axis.direction[2])) == pytest.approx(1.0, abs=0.01)
    off_m = torch.linalg.cross(axis.point_m, axis.direction)
    assert float(off_m.norm()) < 0.003


def test_a_plate_that_lies_mostly_on_itself_after_a_small_turn_has_no_such_axis() -> None:
    """Four fifths of it, after 13 degrees: but a quarter turn is another pose."""
    plate = boxes(
        "plate", ((0.15, 0.1, 0.003), (0, 0, 0)), ((0.028, 0.028, 0.008), (0.035, 0.018, 0.005))
    )
    assert find_copies(plate).near_axis is None


def test_what_looks_alike_from_no_two_sides_has_no_copy() -> None:
    copies = find_copies(bracket())
    assert len(copies.symmetries.R) == 1
    assert len(copies.near_copies.R) == 0
    assert copies.mirror > 0.02


def test_a_ball_is_one_pose_whatever_its_rotation() -> None:
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.05)
    vertices_m, faces = torch.tensor(mesh.vertices), torch.tensor(mesh.faces).long()
    ball = make_model(vertices_m, faces, name="ball", number=1)
    copies = find_copies(with_found_symmetries(ball))
    assert len(copies.near_copies.R) == len(copies.lookalikes.R) == 0
    first = pose_at(seed=1).double()
    other = Rigid(pose_at(seed=2).R.double(), first.t_m)[None]
    assert bool(copies.is_same(first, other, copies.symmetries).all())
    beside = Rigid(first.R, first.t_m + torch.tensor([0.02, 0, 0]))[None]
    assert not bool(copies.is_same(first, beside, copies.symmetries).any())


def test_two_poses_are_one_where_both_angle_and_distance_are_small() -> None:
    copies, pose = find_copies(bracket()), pose_at(seed=1).double()
    identity = copies.symmetries
    for degrees, is_same in ((3.0, True), (15.0, False)):
        other = (pose @ rotation([0.0, 0, 1.0], degrees))[None]
        assert bool(copies.is_same(pose, other, identity)[0]) == is_same
    for shift, is_same in ((0.02, True), (0.2, False)):
        moved = pose.t_m + torch.tensor([shift * copies.diameter_m, 0, 0])
        assert bool(copies.is_same(pose, Rigid(pose.R, moved)[None], identity)[0]) == is_same


def test_half_turns_about_the_principal_axes_are_look_alikes() -> None:
    corners, faces = box_faces()
    sizes = torch.tensor([0.2, 0.03, 0.03])
    ends = torch.tensor([0.03, 0.03, 0.06])
    at = torch.tensor([0.1, 0.0, 0.03])
    vertices = torch.cat([corners * sizes, corners * ends + at])
    profile = make_model(vertices, torch.cat([faces, faces + 8]), name="profile", number=1)
    copies = find_copies(profile)
    every = Rigid.cat([copies.near_copies, copies.lookalikes])
    for axis in ([1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]):
        assert degrees_to(every, rotation(axis, 180)) < 20, axis


def test_words_tell_the_axis_and_the_shift() -> None:
    copies, first = find_copies(bar()), pose_at(seed=1).double()
    turned = first @ rotation([0.0, 0, 1.0], 180)
    assert (
        describe_difference(turned, first, copies) == "rotated by 180 degrees about the short axis"
    )
    moved = Rigid(turned.R, turned.t_m + torch.tensor([0.03, 0, 0]))
    words = "rotated by 180 degrees about the short axis and shifted by 30 mm"
    assert describe_difference(moved, first, copies) == words
    oblique = first @ rotation([1.0, 1.0, 0], 90)
    words = "rotated by 90 degrees about the model's axis (0.71, 0.71, 0.00)"
    assert describe_difference(oblique, first, copies) == words


def test_an_axis_that_is_hardly_longer_than_the_next_is_named_by_its_direction() -> None:
    of_bar, first = find_copies(bar()), pose_at(seed=1).double()
    copies = replace(of_bar, lengths_m=torch.tensor([0.21, 0.2, 0.03]).double())
    turned = first @ rotation([1.0, 0, 0], 90)
    words = "rotated by 90 degrees about the model's axis (1.00, 0.00, 0.00)"
    assert describe_difference(turned, first, copies) == words
    flat = first @ rotation([0, 0, 1.0], 90)
    assert describe_difference(flat, first, copies) == "rotated by 90 degrees about the short axis"
