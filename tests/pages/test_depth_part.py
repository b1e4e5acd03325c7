"""A depth estimate as a part of a page."""

from dataclasses import replace

import pytest
import torch
from tests.pages.read_page import drawings
from tests.synthetic_street import make_street

from depthpose.core.draw import draw_depth, draw_share
from depthpose.core.files import PointCloud
from depthpose.depth.types import DepthEstimate, ErrorMaps
from depthpose.report.depth import make_depth_section

SAMPLE = make_street(0.1)
PAIR = replace(SAMPLE.input, right=None)


def truth_m() -> torch.Tensor:
    assert SAMPLE.truth.depth_m is not None
    return SAMPLE.truth.depth_m


def estimate(**more: torch.Tensor) -> DepthEstimate:
    assert SAMPLE.truth.disparity_px is not None
    found = DepthEstimate(input=PAIR, depth_m=truth_m(), disparity_px=SAMPLE.truth.disparity_px)
    return replace(found, **more)


def test_what_there_is_is_shown_in_its_colours() -> None:
    confidence = torch.rand(truth_m().shape)
    found = estimate(confidence=confidence, right=PAIR.left)
    section = make_depth_section("a frame", found, range_m=(2.0, 40.0))
    image, depth, sure, right = drawings(section)
    assert [p.caption.split(",")[0] for p in (image, right)] == ["image", "right view as drawn"]
    assert torch.equal(depth.image, draw_depth(truth_m(), 2.0, 40.0))
    assert torch.equal(sure.image, draw_share(1 - confidence))
    assert depth.color_bar is not None
    assert [depth.color_bar.marks[0], depth.color_bar.marks[-1]] == [(0.0, "2"), (1.0, "40")]
    assert sure.color_bar is not None
    assert sure.color_bar.title == "confidence"
    (scene,) = section.scenes
    cloud = scene.layers[0].shape
    assert isinstance(cloud, PointCloud)
    assert len(cloud.points) == int((truth_m() <= 40.0).sum())


def test_the_facts_are_those_of_the_map() -> None:
    facts = dict(make_depth_section("a", estimate()).facts)
    known_m = truth_m()[truth_m().isfinite()]
    numbers = [float(known_m.double().quantile(share)) for share in (0.01, 0.5, 0.99)]
    assert facts["1, 50, 99 % are nearer than"] == "{:.2f}, {:.2f}, {:.2f} m".format(*numbers)
    assert facts["pixels with depth"] == f"{len(known_m) / truth_m().numel():.1%}"
    assert "baseline" not in facts, "one image has none"
    assert "mean confidence" not in facts


def test_the_sky_is_grey_and_said_and_has_no_points() -> None:
    is_sky = torch.zeros(truth_m().shape, dtype=torch.bool)
    is_sky[:9] = True
    depth_m = torch.where(is_sky, torch.nan, 7.0)
    found = replace(estimate(), depth_m=depth_m, is_sky=is_sky)
    section = make_depth_section("a", found)
    _, depth = drawings(section)
    assert depth.caption.endswith("grey: sky or no answer")
    assert bool((depth.image[:, :9] == 0.5).all())
    assert dict(section.facts)["sky"] == f"{float(is_sky.float().mean()):.1%} of the pixels"
    cloud = section.scenes[0].layers[0].shape
    assert isinstance(cloud, PointCloud)
    assert len(cloud.points) == int((~is_sky).sum())
    plain = make_depth_section("a", estimate())
    assert drawings(plain)[1].caption.endswith("grey: none")
    assert "sky" not in dict(plain.facts)


def test_without_a_camera_there_is_disparity_and_no_cloud() -> None:
    found = replace(estimate(), input=replace(PAIR, camera=None), depth_m=None)
    section = make_depth_section("a", found)
    assert section.pictures[1].color_bar is not None
    assert section.pictures[1].color_bar.title == "disparity [px]"
    assert not section.scenes


@pytest.mark.parametrize("is_sparse", [True, False])
def test_the_error_is_where_the_truth_is(is_sparse: bool) -> None:
    error = torch.full(truth_m().shape, torch.nan)
    known_m = error.clone()
    part = (slice(20, 22), slice(30, 32)) if is_sparse else (slice(None), slice(None))
    error[part], known_m[part] = 0.3, 10.0
    wrong = ErrorMaps(error=error, is_disparity=False, true_depth_m=known_m)
    section = make_depth_section("a", estimate(), error=wrong, with_image=False)
    _, truth, errors = drawings(section)
    bright = draw_share(torch.zeros(1, 1))[:, 0, 0]
    ten = draw_depth(torch.full((1, 1), 10.0))[:, 0, 0]
    for picture, ink in ((truth, ten), (errors, bright)):
        image = picture.image
        assert torch.equal(image[:, 21, 31], ink)
        # Points are grown by two pixels, and no further.
        assert torch.equal(image[:, 23, 33], ink)
        assert torch.equal(image[:, 25, 35], 0.35 * PAIR.left[:, 25, 35] if is_sparse else ink)
    assert errors.color_bar is not None
    assert errors.color_bar.marks[-1] == (1.0, "30+")
    layers = section.scenes[0].layers
    assert [layer.name for layer in layers] == ["points", "true points"]
    points = layers[1].shape
    assert isinstance(points, PointCloud)
    assert bool(points.points[:, 2].allclose(torch.tensor(10.0)))
