"""Evidence for and against a pose: drawn surfaces beside what the camera saw."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import ndimage
from tests.pose.synthetic_objects import (
    Block,
    K,
    bottle,
    boxes,
    bracket,
    generator,
    pose_at,
    view_of,
)
from torch import Tensor

from depthpose.core.camera import back_project
from depthpose.core.render import rasterize
from depthpose.core.rigid import Rigid, rotation_by
from depthpose.pose.cloud import cloud_from_depth, grow_mask
from depthpose.pose.geometry.rendering import render_surface
from depthpose.pose.geometry.surface import prepare_surface
from depthpose.pose.mesh import turn_about
from depthpose.pose.synthetic.parts import make_part
from depthpose.pose.types import Evidence, ObjectModel, ViewInput
from depthpose.pose.verify.evidence import Observation, _mean_depth, compare, observe

WALL_M = 1.3

BAR = boxes("bar", ((0.2, 0.07, 0.03), (0.0, 0.0, 0.0)))


def view_before_wall(model: ObjectModel, pose: Rigid, noise_m: float = 0.0) -> ViewInput:
    """A model before a wall, with independent noise, and its exact mask."""
    depth_m, mask = view_of(model, pose)
    depth_m = torch.where(mask, depth_m, torch.tensor(WALL_M).to(depth_m))
    depth_m = depth_m + noise_m * torch.randn(240, 320, generator=generator(0))
    return ViewInput(name="a", depth_m=depth_m.float(), mask=mask, K=K, object=model.name)


def observation_of(view: ViewInput, model: ObjectModel, *, is_masked: bool = True) -> Observation:
    cloud_m = cloud_from_depth(view.depth_m, view.mask, K)
    return observe(cloud_m, view, prepare_surface(model), is_masked=is_masked)


def evidence_of(
    view: ViewInput, model: ObjectModel, pose: Rigid, *, is_masked: bool = True
) -> Evidence:
    observation = observation_of(view, model, is_masked=is_masked)
    return compare(observation, pose, prepare_surface(model))


def left_part(mask: Tensor) -> Tensor:
    """The pixels of a mask that are left of its middle column."""
    columns = torch.arange(320).expand(240, 320)
    return mask & (columns < columns[mask].median())


@pytest.mark.parametrize("model", [BAR, bottle(), make_part("mug")], ids=lambda model: model.name)
@pytest.mark.parametrize("seed", [0, 3])
def test_a_rendered_surface_is_that_of_its_triangles(model: ObjectModel, seed: int) -> None:
    pose = pose_at(z_m=0.6, seed=seed).double()
    depth_m, cosine, window = render_surface(prepare_surface(model), pose, K, 240, 320)
    image_m = np.full((240, 320), np.nan)
    image_m[window] = depth_m
    triangles = pose.apply(model.vertices_m.double())[model.faces]
    raster = rasterize(triangles, K, 320, 240)
    exact_m = raster.depth_m.double().numpy()
    is_drawn, is_exact = np.isfinite(image_m), np.isfinite(exact_m)
    assert is_exact.sum() > 2000
    assert (is_drawn != is_exact).sum() < 0.002 * is_exact.sum(), "but for rounding at edges"
    both = is_drawn & is_exact
    assert np.quantile(np.abs(image_m - exact_m)[both], 0.99) < 1e-6

    # The cosine is that between the ray and the normal of the triangle.
    corners_m = triangles[raster.primitive]
    normals = torch.linalg.cross(
        corners_m[..., 1, :] - corners_m[..., 0, :], corners_m[..., 2, :] - corners_m[..., 0, :]
    )
    points_m = back_project(torch.from_numpy(exact_m), K)
    expected = torch.cosine_similarity(normals, points_m, dim=-1).abs().numpy()
    whole = np.ones((240, 320))
    whole[window] = cosine
    assert np.quantile(np.abs(whole - expected)[both], 0.98) < 1e-4


def test_of_very_many_faces_the_samples_are_rendered(monkeypatch: pytest.MonkeyPatch) -> None:
    """A disc at each sample lies in the surface, and reaches beyond a silhouette by its radius."""
    monkeypatch.setattr("depthpose.pose.geometry.surface._MOST_FACES", 100)
    mug = make_part("mug")
    surface = prepare_surface(mug)
    pose = pose_at(z_m=0.6).double()
    depth_m, _, window = render_surface(surface, pose, K, 240, 320)
    triangles = pose.apply(mug.vertices_m.double())[mug.faces]
    exact_m = rasterize(triangles, K, 320, 240).depth_m.double().numpy()[window]
    both = np.isfinite(depth_m) & np.isfinite(exact_m)
    assert both.sum() > 0.99 * np.isfinite(exact_m).sum()
    assert np.median(np.abs(depth_m - exact_m)[both]) < 0.0005


def test_slanted_pixels_are_drawn_as_the_renderer_draws_them() -> None:
    """A skew of 40 px moves a pixel by 8 % of its height."""
    slanted = K.clone()
    slanted[0, 1] = 40.0
    pose = pose_at(z_m=0.6, seed=3).double()
    drawn_m, _, window = render_surface(prepare_surface(BAR), pose, slanted, 240, 320)
    triangles = pose.apply(BAR.vertices_m.double())[BAR.faces]
    exact_m = rasterize(triangles, slanted, 320, 240).depth_m.double().numpy()[window]
    bend_m = np.abs(ndimage.laplace(np.where(np.isfinite(exact_m), exact_m, 9.0)))
    inner = np.logical_not(ndimage.binary_dilation(bend_m > 0.0003, iterations=5))
    inner &= np.isfinite(drawn_m)
    assert inner.sum() > 2000
    assert np.abs(drawn_m - exact_m)[inner].max() < 1e-6


def test_nothing_is_drawn_behind_the_camera_or_beside_the_image() -> None:
    surface = prepare_surface(bracket())
    for t_m in ([0.0, 0.0, -0.8], [5.0, 0.0, 0.8]):
        pose = Rigid(torch.eye(3).double(), torch.tensor(t_m).double())
        drawn_m, _, window = render_surface(surface, pose, K, 240, 320)
        assert drawn_m.size == 0
        assert window == (slice(0, 0), slice(0, 0))


@pytest.mark.parametrize("noise_m", [0.0, 0.001, 0.003])
@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("model", [BAR, bracket()], ids=["bar", "bracket"])
def test_the_right_pose_is_not_contradicted(model: ObjectModel, noise_m: float, seed: int) -> None:
    truth = pose_at(seed=seed)
    evidence = evidence_of(view_before_wall(model, truth, noise_m), model, truth)
    assert evidence.agreement > 0.99
    assert evidence.rms < 1
    assert evidence.supported_share > 0.9
    if noise_m > 0:
        assert evidence.contradicted == 0
        assert evidence.noise_m == pytest.approx(noise_m, rel=0.3)


def test_exact_readings_of_an_exact_model_support_its_pose() -> None:
    """A side across the optical axis, without noise and without deviation of the real object."""
    plate = boxes("plate", ((0.25, 0.125, 1 / 32), (0.0, 0.0, 0.0)))
    pose = Rigid(torch.eye(3), torch.tensor([0.0, 0.0, 0.75 + 1 / 64]))
    _, mask = view_of(plate, pose)
    depth_m = torch.where(mask, 0.75, WALL_M)
    view = ViewInput(name="a", depth_m=depth_m, mask=mask, K=K, object="plate")
    cloud_m = cloud_from_depth(view.depth_m, view.mask, K)
    surface = prepare_surface(plate, deviation_m=0.0)
    exact = observe(cloud_m, view, surface, is_masked=True)
    with np.errstate(divide="raise", invalid="raise"):
        evidence = compare(exact, pose, surface)
    assert evidence.agreement == 1.0
    assert 0 <= evidence.rms < 1


@pytest.mark.parametrize(
    ("grow_px", "right_px", "offset_m"), [(2, 0, 0.0), (-3, 0, 0.0), (0, 2, 0.0), (0, 0, 0.002)]
)
def test_errors_of_masks_and_sensors_contradict_little(
    grow_px: int, right_px: int, offset_m: float
) -> None:
    """Masks are dilated, eroded or shifted; all readings are off along the ray alike."""
    model, truth = bracket(), pose_at()
    view = view_before_wall(model, truth, 0.001)
    mask = grow_mask(view.mask, grow_px).roll(right_px, 1)
    mask[:, :right_px] = False
    mask &= view.depth_m < WALL_M - 0.1  # as flying pixels are dropped
    evidence = evidence_of(replace(view, mask=mask, depth_m=view.depth_m + offset_m), model, truth)
    assert evidence.agreement > 0.97, evidence


def test_the_camera_saw_through_a_pose_behind_which_the_wall_is() -> None:
    model, truth = bracket(), pose_at()
    view = view_before_wall(model, truth, 0.001)
    beside = Rigid(truth.R, truth.t_m + torch.tensor([0.4 * model.diameter_m, 0.0, 0.0]))
    evidence = evidence_of(view, model, beside)
    assert evidence.seen_through > 0.3 * evidence.visible
    nearer = Rigid(truth.R, truth.t_m - torch.tensor([0.0, 0.0, 0.03]))
    evidence = evidence_of(view, model, nearer)
    assert evidence.seen_through > 0.8 * evidence.visible
    assert evidence.bulging == 0


def test_own_readings_before_the_posed_surface_bulge() -> None:
    model, truth = bracket(), pose_at()
    view = view_before_wall(model, truth, 0.001)
    farther = Rigid(truth.R, truth.t_m + torch.tensor([0.0, 0.0, 0.03]))
    evidence = evidence_of(view, model, farther)
    assert evidence.bulging > 0.7 * evidence.visible
    assert evidence.seen_through == 0
    # Where it is not known what of the readings is the object, something else may be before it.
    unmasked = evidence_of(view, model, farther, is_masked=False)
    assert unmasked.contradicted == 0
    assert unmasked.unobserved > 0.7 * unmasked.visible


@pytest.mark.parametrize(
    ("off_m", "through", "bulging"),
    [(0.0028, 0, 0), (-0.0028, 0, 0), (0.0033, 1, 0), (-0.0033, 0, 1)],
)
def test_more_than_three_deviations_contradict_behind_and_before(
    off_m: float, through: int, bulging: int
) -> None:
    """Before a camera without noise the deviation is that of the object: a millimetre."""
    pose = Rigid(torch.eye(3), torch.tensor([0.0, 0.0, 0.6]))
    view = view_before_wall(BAR, pose)
    moved = replace(view, depth_m=torch.where(view.mask, view.depth_m + off_m, view.depth_m))
    evidence = evidence_of(moved, BAR, pose)
    visible = evidence.visible
    assert visible > 50
    assert evidence.seen_through == (pytest.approx(visible, rel=0.02) if through else 0)
    assert evidence.bulging == (pytest.approx(visible, rel=0.02) if bulging else 0)
    assert evidence.unobserved == pytest.approx(0, abs=0.02 * visible)
    if through + bulging == 0:
        assert evidence.supported == pytest.approx(visible, rel=0.02)
        assert evidence.rms == pytest.approx(2.8, rel=0.02)
    else:
        assert evidence.supported == 0
    # What lies before it and is not known to be the object hides it, and contradicts nothing.
    unmasked = evidence_of(moved, BAR, pose, is_masked=False)
    assert unmasked.seen_through == evidence.seen_through
    assert unmasked.bulging == 0
    assert unmasked.unobserved == pytest.approx(bulging * visible, abs=0.02 * visible)


@pytest.mark.parametrize(("side_px", "through"), [(9, 1.0), (4, 0.0)])
def test_a_small_hole_is_one_observation(side_px: int, through: float) -> None:
    """One is less than the 10 px that are independent, the other as wide as an edge may move."""
    pose = Rigid(torch.eye(3), torch.tensor([0.0, 0.0, 0.6]))
    view = view_before_wall(BAR, pose)
    view.depth_m[118 : 118 + side_px, 150 : 150 + side_px] = WALL_M
    assert evidence_of(view, BAR, pose).seen_through == through


def test_readings_near_an_edge_are_explained_and_support_nothing() -> None:
    """A bar shows more of its edges than a plate, and explains its readings as well."""
    pose = Rigid(torch.eye(3), torch.tensor([0.0, 0.0, 0.6]))
    view = view_before_wall(BAR, pose)
    evidence = evidence_of(view, BAR, pose, is_masked=False)
    all_readings = float(view.mask.sum()) / 10**2  # in patches of 10 px
    assert evidence.explained == pytest.approx(all_readings, rel=0.02)
    assert evidence.supported < 0.9 * evidence.explained
    moved = Rigid(pose.R, pose.t_m + torch.tensor([0.0, 0.0, 0.02]))
    assert evidence_of(view, BAR, moved, is_masked=False).explained == 0


@pytest.mark.parametrize(("grow_px", "is_beside"), [(7, False), (11, True)])
def test_a_mask_may_end_a_few_pixels_beside_the_silhouette(grow_px: int, is_beside: bool) -> None:
    """Of its border 3 px are left out, and 4 px beside the silhouette may be its edge."""
    pose = Rigid(torch.eye(3), torch.tensor([0.0, 0.0, 0.6]))
    view = view_before_wall(BAR, pose)
    view = replace(view, mask=grow_mask(view.mask, grow_px), depth_m=view.depth_m.clamp(max=0.6))
    assert (evidence_of(view, BAR, pose).beside > 1) == is_beside


def test_a_moved_edge_of_a_thin_part_does_not_contradict() -> None:
    """A strip of 5 px is all edge: a sensor that moves its edge by two shows the wall on it."""
    strip = boxes("strip", ((0.2, 0.006, 0.006), (0, 0, 0)))
    pose = Rigid(torch.eye(3), torch.tensor([0.0, 0.0, 0.6]))
    view = view_before_wall(strip, pose, 0.001)
    moved = replace(view, depth_m=view.depth_m.roll(2, 0))
    evidence = evidence_of(moved, strip, pose)
    assert evidence.visible > 1
    assert evidence.contradicted == 0
    # Where it is not it is seen through.
    beside = Rigid(pose.R, pose.t_m + torch.tensor([0.0, 0.012, 0.0]))
    assert evidence_of(view, strip, beside).seen_through > 1


def test_own_readings_beside_the_silhouette_contradict() -> None:
    with_arm = boxes("arm", ((0.16, 0.05, 0.04), (0, 0, 0)), ((0.03, 0.09, 0.03), (0.05, 0.06, 0)))
    without = boxes("bar", ((0.16, 0.05, 0.04), (0, 0, 0)))
    pose = Rigid(torch.eye(3), torch.tensor([0.0, 0.0, 0.7]))
    view = view_before_wall(with_arm, pose, 0.001)
    evidence = evidence_of(view, without, pose)
    assert evidence.beside > 1
    assert evidence.seen_through == evidence.bulging == 0
    assert evidence_of(view, with_arm, pose).contradicted == 0


@pytest.mark.parametrize(("step_m", "is_continued"), [(0.0, True), (0.02, False)])
def test_without_a_mask_a_surface_that_goes_on_contradicts(
    step_m: float, is_continued: bool
) -> None:
    """A bar is posed on a longer one, or stands a step before what lies beside it."""
    bar = boxes("bar", ((0.1, 0.05, 0.04), (0, 0, 0)))
    more = boxes("more", ((0.1, 0.05, 0.04), (0, 0, 0)), ((0.1, 0.05, 0.04), (0.1, 0, step_m)))
    pose = Rigid(torch.eye(3), torch.tensor([0.0, 0.0, 0.7]))
    evidence = evidence_of(view_before_wall(more, pose, 0.001), bar, pose, is_masked=False)
    assert (evidence.continued > 1) == is_continued
    assert evidence.seen_through == evidence.bulging == 0


@pytest.mark.parametrize(
    ("beside_it", "axis", "is_continued"),
    [(((0.1, 0.1, 0.1), (0, 0, 0.002)), (0.0, 1.0, 0.0), True),
     (((0.3, 0.004, 0.3), (0, 0.052, 0)), (1.0, 0.0, 0.0), False)],
    ids=["one side of a box", "standing on a table"],
)  # fmt: skip
def test_without_a_mask_a_surface_that_bends_away_at_the_silhouette_goes_on(
    beside_it: Block, axis: tuple[float, float, float], is_continued: bool
) -> None:
    """Round its corner a box goes on; where a plate touches a table the edge is concave."""
    plate_block = ((0.1, 0.1, 0.004), (0, 0, -0.048))
    plate = boxes("plate", plate_block)
    more = boxes("more", plate_block, beside_it)
    R = rotation_by(0.7 * torch.tensor(axis))
    pose = Rigid(R, torch.tensor([0.0, 0.0, 0.7]))
    evidence = evidence_of(view_before_wall(more, pose, 0.001), plate, pose, is_masked=False)
    assert evidence.supported > 0.9 * evidence.visible
    assert (evidence.continued > 1) == is_continued


@pytest.mark.parametrize("reading_m", [math.nan, 0.45], ids=["no reading", "something before it"])
def test_a_hidden_part_is_unobserved_and_contradicts_nothing(reading_m: float) -> None:
    model, truth = bracket(), pose_at()
    view = view_before_wall(model, truth, 0.001)
    left = left_part(view.mask)
    depth_m = torch.where(left | ~view.mask, view.depth_m, torch.tensor(reading_m))
    evidence = evidence_of(replace(view, depth_m=depth_m, mask=left), model, truth)
    assert evidence.contradicted == 0
    assert 0.3 < evidence.unobserved / evidence.visible < 0.7
    assert evidence.rms < 1
    # The same half, seen through: now it contradicts.
    through_m = torch.where(left | ~view.mask, view.depth_m, torch.tensor(WALL_M))
    evidence = evidence_of(replace(view, depth_m=through_m, mask=left), model, truth)
    assert evidence.seen_through > 0.3 * evidence.visible


@pytest.mark.parametrize(
    "block",
    [((0.03, 0.03, 0.025), (-0.135, 0, -0.0275)), ((0.025, 0.025, 0.03), (-0.1375, -0.0275, 0))],
    ids=["toward the camera", "at the side"],
)
def test_a_long_part_with_its_ends_swapped_is_contradicted_by_a_patch(
    block: Block,
) -> None:
    """A profile of 30 cm with a small block at one end: most of the wrong pose agrees."""
    profile = boxes("profile", ((0.3, 0.03, 0.03), (0, 0, 0)), block)
    truth = Rigid(torch.eye(3), torch.tensor([0.0, 0.0, 0.6])).double()
    axis = torch.tensor([0.0, 0.0, 1.0] if block[1][2] else [0.0, 1.0, 0.0]).double()
    swapped = truth @ turn_about(axis, torch.zeros(3).double(), torch.tensor(math.pi).double())
    view = view_before_wall(profile, truth.float(), 0.001)
    right, wrong = (evidence_of(view, profile, pose) for pose in (truth, swapped))
    assert right.contradicted == 0
    assert wrong.agreement > 0.6
    assert wrong.contradicted > 1, "an independent patch"


def test_a_large_object_is_thinned_and_the_evidence_stays() -> None:
    """Of an object of very many pixels every n-th is compared: areas hardly change."""
    model, near = bracket(), Rigid(pose_at().R, torch.tensor([0.0, 0.0, 0.3]))
    shifted = Rigid(near.R, near.t_m + torch.tensor([0.03, 0.0, 0.0]))
    wide_K = K * torch.tensor([[4.0], [4.0], [1.0]]).double()
    found = []
    for lens, width, height in ((K, 320, 240), (wide_K, 1280, 960)):
        triangles = near.apply(model.vertices_m)[model.faces]
        depth_m = rasterize(triangles, lens, width, height).depth_m.float()
        mask = depth_m.isfinite()
        view = ViewInput(name="a", depth_m=depth_m, mask=mask, K=lens, object="bracket")
        cloud_m = cloud_from_depth(depth_m, mask, lens)
        observation = observe(cloud_m, view, prepare_surface(model), is_masked=True)
        assert observation.depth_m.size < 250_000
        found.append((observation.step, compare(observation, shifted, prepare_surface(model))))
    (small_step, small), (large_step, large) = found
    assert large_step > small_step
    assert large.contradicted > 0
    assert large.agreement == pytest.approx(small.agreement, abs=0.15)


def test_a_cloud_without_its_image_is_compared_as_well() -> None:
    model, truth = bracket(), pose_at()
    view = view_before_wall(model, truth, 0.001)
    cloud_m = cloud_from_depth(view.depth_m, view.mask, K)
    surface = prepare_surface(model)
    observation = observe(cloud_m, None, surface, is_masked=True)
    right = compare(observation, truth, surface)
    assert right.agreement > 0.97
    assert right.rms < 1
    farther = Rigid(truth.R, truth.t_m + torch.tensor([0.0, 0.0, 0.03]))
    assert compare(observation, farther, surface).bulging > 0.5 * right.visible


def test_means_of_readings_are_of_those_that_are_there() -> None:
    """A drop-out stays one, and takes nothing from the mean of its neighbours."""
    depth_m = np.full((9, 9), 2.0)
    depth_m[4, 4] = np.nan
    depth_m[4, 5] = 2.9
    mean_m = _mean_depth(depth_m, 3)
    assert np.isnan(mean_m[4, 4])
    assert mean_m[4, 6] == pytest.approx(2.1)
    assert mean_m[3, 4] == pytest.approx(2 + 0.9 / 8), "eight readings in nine pixels"
