"""Long parts slide along themselves for ICP: their ends in the image put them right."""

from dataclasses import replace
from functools import cache

import pytest
import torch
from tests.pose.synthetic_objects import K, boxes, view_of

from depthpose import Registration
from depthpose.core.rigid import Rigid, cross_matrix, rotation_by
from depthpose.pose.cloud import cloud_from_depth
from depthpose.pose.icp import refine_exactly
from depthpose.pose.metrics import add_m
from depthpose.pose.types import ObjectModel, ViewInput
from depthpose.pose.verify.evidence import Observation, compare, observe
from depthpose.pose.verify.sliding import find_fixed_shift, slide
from depthpose.pose.verify.target_object import TargetObject

ALONG = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
"""The direction of the profile before the camera."""


@cache
def angle() -> TargetObject:
    """An L profile of 400 mm, with a block near one end."""
    sides = [((0.4, 0.05, 0.004), (0.0, 0.0, 0.0)), ((0.4, 0.004, 0.04), (0.0, 0.025, 0.02))]
    block = ((0.03, 0.02, 0.012), (0.15, -0.01, 0.006))
    return TargetObject(number=0, model=boxes("angle", *sides, block))


def pose_of(middle_m: float) -> Rigid:
    """The pose of the profile, tilted to show both sides, with its middle so far to the right."""
    R = rotation_by(torch.tensor([2.6, 0.0, 0.0], dtype=torch.float64))
    return Rigid(R, torch.tensor([middle_m, 0.0, 0.35]).double())


def view_before_wall(model: ObjectModel, pose: Rigid) -> ViewInput:
    depth_m, mask = view_of(model, pose.float())
    depth_m = torch.where(mask, depth_m, torch.tensor(1.0).to(depth_m))
    return ViewInput(name="x", depth_m=depth_m.float(), mask=mask, K=K.float(), object=model.name)


def view_at(middle_m: float) -> ViewInput:
    return view_before_wall(angle().model, pose_of(middle_m))


def observation_at(middle_m: float, *, is_masked: bool = True) -> Observation:
    view = view_at(middle_m)
    cloud_m = cloud_from_depth(view.depth_m, view.mask, K)
    return observe(cloud_m, view, angle().surface, is_masked=is_masked)


def shifted(pose: Rigid, shift_m: float) -> Rigid:
    return Rigid(pose.R, pose.t_m + shift_m * ALONG)


@pytest.mark.parametrize("shift_m", [-0.03, 0.02])
def test_a_pose_slides_to_where_its_end_is_seen(shift_m: float) -> None:
    truth = pose_of(-0.12)
    observation = observation_at(-0.12)
    surface = angle().surface
    fit = refine_exactly(observation.cloud_m, truth, surface)
    fit = replace(fit, camera_from_model=shifted(truth, shift_m))
    evidence = compare(observation, fit.camera_from_model, surface)
    assert evidence.contradicted > 1
    slid, evidence_there = slide(fit, evidence, observation, surface)
    offset_m = slid.camera_from_model.t_m - truth.t_m
    assert float(offset_m.norm()) < 0.004
    assert evidence_there.contradicted < 0.1 * evidence.contradicted
    of_middle = torch.cat([-cross_matrix(observation.cloud_m.mean(0)), torch.eye(3).double()], 1)
    covariance = of_middle @ slid.covariance.double() @ of_middle.mT
    assert float(offset_m.norm()) / 2 < float(covariance[0, 0]) ** 0.5 < 0.01


def test_a_pose_that_nothing_contradicts_stays_as_it_is() -> None:
    observation = observation_at(-0.12)
    fit = refine_exactly(observation.cloud_m, pose_of(-0.12), angle().surface)
    evidence = compare(observation, fit.camera_from_model, angle().surface)
    assert evidence.contradicted == 0
    slid, _ = slide(fit, evidence, observation, angle().surface)
    assert slid is fit


def test_an_end_in_the_image_fixes_a_shift_that_no_point_does() -> None:
    with_end = observation_at(-0.12)
    fixed = find_fixed_shift(pose_of(-0.12), ALONG, with_end, angle().surface)
    assert fixed is not None
    assert 0 < fixed.deviation_m <= 0.05 * angle().surface.diameter_m
    # The middle of the points moves by v + w x c.
    of_middle = torch.cat([-cross_matrix(fixed.middle_m), torch.eye(3).double()], 1)
    covariance = of_middle @ fixed.set_deviation(torch.eye(6).double()) @ of_middle.mT
    assert float(covariance[0, 0]) == pytest.approx(fixed.deviation_m**2)
    assert float(covariance[1, 1]) > 1

    bar = boxes("bar", ((0.8, 0.05, 0.02), (0.0, 0.0, 0.0)))
    target = TargetObject(number=0, model=bar)
    pose = pose_of(0.0)
    view = view_before_wall(bar, pose)
    cloud_m = cloud_from_depth(view.depth_m, view.mask, K)
    without_end = observe(cloud_m, view, target.surface, is_masked=True)
    assert find_fixed_shift(pose, ALONG, without_end, target.surface) is None


def registered_poses(model: ObjectModel, view: ViewInput) -> list[Rigid]:
    """The pose that a registration gives, and those that it names beside it."""
    estimate = Registration([model]).estimate_many([view])[0]
    assert estimate.camera_from_model is not None, estimate.reason
    others = [alternative.camera_from_model for alternative in estimate.alternatives]
    return [estimate.camera_from_model, *others]


@pytest.mark.parametrize("middle_m", [-0.12, -0.1])
def test_a_long_part_that_leaves_the_image_is_named_where_it_is(middle_m: float) -> None:
    poses = registered_poses(angle().model, view_at(middle_m))
    errors_m = [
        float(add_m(pose.double(), pose_of(middle_m), angle().model.vertices_m.double()))
        for pose in poses
    ]
    assert min(errors_m) < 0.006
