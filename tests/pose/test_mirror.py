"""A mirrored copy is not the object, unless the object is its own mirror image."""

from dataclasses import replace
from functools import cache

import pytest
import torch
from bench.negatives import mirrored, negative_kinds
from tests.pose.synthetic_objects import (
    Oracle,
    bottle,
    bracket,
    cloud_of,
    noisy,
    pose_at,
    tiny_weights,
)

from depthpose.core.rigid import Rigid
from depthpose.pose.config import RefusalConfig
from depthpose.pose.geometry.surface import Surface, prepare_surface
from depthpose.pose.icp import refine_exactly
from depthpose.pose.mesh import MIRROR_ALIKE, mirror_deviation
from depthpose.pose.synthetic.parts import make_part
from depthpose.pose.types import ObjectModel, PoseEstimate
from depthpose.pose.verify.identity import measure_mirror_gain

TRUTH = pose_at(seed=1)


@pytest.mark.parametrize(
    ("model", "is_alike"),
    [(bracket(), False), (bottle(), True), (make_part("mug"), True)],
    ids=["bracket", "bottle", "mug"],
)
def test_the_mirror_image_of_a_model_is_measured(model: ObjectModel, is_alike: bool) -> None:
    assert (mirror_deviation(model) <= MIRROR_ALIKE) == is_alike
    assert (mirror_deviation(model) < 0.01) == is_alike
    # However the model lies in its frame.
    assert mirror_deviation(mirrored(model)) == pytest.approx(mirror_deviation(model), abs=0.01)
    assert ("mirrored" in negative_kinds(model)) != is_alike


@cache
def surface_off_origin(origin_m: float) -> Surface:
    """Surface of a bracket that lies so far from its file's origin along each axis."""
    return prepare_surface(replace(bracket(), vertices_m=bracket().vertices_m + origin_m))


def gain(seen: ObjectModel, seed: int, origin_m: float = 0.0) -> float:
    """Mirror gain of a bracket's file whose origin lies so far to each side of the part."""
    truth = pose_at(seed=seed)
    cloud_m = noisy(cloud_of(seen, truth)).double()
    shift_m = torch.full((3,), origin_m)
    surface = surface_off_origin(origin_m)
    begun = Rigid(truth.R.double(), (truth.t_m - truth.R @ shift_m).double())
    return measure_mirror_gain(
        cloud_m, refine_exactly(cloud_m, begun, surface).camera_from_model, surface
    )


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_mirror_image_fits_a_mirrored_copy_better_and_the_object_worse(seed: int) -> None:
    assert gain(bracket(), seed) < 0.005
    assert gain(mirrored(bracket()), seed) > 0.05


def test_where_the_origin_of_a_file_lies_changes_no_mirror_gain() -> None:
    """In an assembly it may be a metre from the part, where no camera was."""
    near = gain(mirrored(bracket()), 1)
    assert gain(mirrored(bracket()), 1, origin_m=1.0) == pytest.approx(near, abs=0.02)


def estimated(model: ObjectModel, seen: ObjectModel) -> PoseEstimate:
    refusal = RefusalConfig(min_probability=0.0)
    net = Oracle(tiny_weights(model, refusal=refusal), [TRUTH])
    return net.estimate(cloud=noisy(cloud_of(seen, TRUTH)))


def mirror_gain_of(found: PoseEstimate) -> float:
    assert found.identity is not None
    assert found.identity.mirror_gain is not None
    return found.identity.mirror_gain


def test_a_mirrored_copy_is_refused_with_its_reason() -> None:
    refused = estimated(bracket(), mirrored(bracket()))
    assert refused.status == "doubtful"
    assert refused.reason.startswith("the mirror image of bracket fits better (by ")
    assert refused.camera_from_model is None
    assert mirror_gain_of(refused) > 0.0025
    assert mirror_gain_of(estimated(bracket(), bracket())) < -0.001


def test_an_object_that_is_its_own_mirror_image_is_answered() -> None:
    found = estimated(bottle(), mirrored(bottle()))
    assert found.is_posed
    assert found.identity is not None
    assert found.identity.mirror_gain is None
