"""A bin that is known, by its CAD file and pose or an empty frame: what lies on it is no object."""

import math
from pathlib import Path

import pytest
import torch
from tests.pose.synthetic_objects import (
    CAMERA,
    K,
    box_faces,
    bracket,
    bracket_surface,
    pose_at,
    view_of,
)

from depthpose.core.errors import InputError
from depthpose.core.rigid import Rigid
from depthpose.pose.background import PosedBin, add_background
from depthpose.pose.cloud import cloud_from_depth, grow_mask
from depthpose.pose.frame import prepare_frame
from depthpose.pose.geometry.surface import prepare_surface
from depthpose.pose.inliers import share_in_background
from depthpose.pose.inputs import view_input
from depthpose.pose.mesh import make_model
from depthpose.pose.metrics import add_m
from depthpose.pose.registration import Registration
from depthpose.pose.types import ObjectModel, PoseEstimate, ViewInput
from depthpose.pose.verify.evidence import compare, observe
from depthpose.pose.verify.probability import MOST_CONTINUED

TRUTH = pose_at(-0.12, 0.75, seed=1)
FIXTURE = pose_at(0.13, 0.78, seed=2)
"""Where the bin has a bracket of its own."""


@pytest.fixture(scope="module")
def net() -> Registration:
    made = Registration([bracket()])
    made.prepare()
    return made


def bin_model() -> ObjectModel:
    """A bin with a waved floor, walls, and a fixture that looks like the part."""
    x, y = torch.meshgrid(*[torch.linspace(-0.4, 0.4, 81)] * 2, indexing="ij")
    floor = torch.stack([x, y, 0.95 + 0.02 * torch.cos(40 * x)], -1).reshape(-1, 3)
    k = torch.arange(81 * 81).reshape(81, 81)
    a, b, c, d = k[:-1, :-1], k[1:, :-1], k[1:, 1:], k[:-1, 1:]
    faces = [torch.stack([a, b, c], -1).reshape(-1, 3), torch.stack([a, c, d], -1).reshape(-1, 3)]
    corners, cube = box_faces()
    vertices = [floor]
    long, tall, thin = 0.84, 0.25, 0.02
    walls = [((x, 0, 0.85), (thin, long, tall)) for x in (-0.41, 0.41)]
    walls += [((0, y, 0.85), (long, thin, tall)) for y in (-0.41, 0.41)]
    for at, size in walls:
        faces.append(cube + sum(map(len, vertices)))
        vertices.append(corners * torch.tensor(size) + torch.tensor(at))
    faces.append(bracket().faces + sum(map(len, vertices)))
    vertices.append(FIXTURE.apply(bracket().vertices_m))
    return make_model(torch.cat(vertices), torch.cat(faces), name="bin", number=9)


TILT = Rigid(torch.eye(3), torch.tensor([0.0, 0.0, -0.4]))
"""The frame of the bin's file in that of the camera, so that its pose is not none."""


def posed_bin() -> PosedBin:
    model = bin_model()
    moved = make_model(TILT.inverse().apply(model.vertices_m), model.faces, name="bin", number=9)
    return PosedBin(model=moved, camera_from_model=TILT)


def noise(seed: int) -> torch.Tensor:
    return 0.0005 * torch.randn(240, 320, generator=torch.Generator().manual_seed(seed))


def empty_frame() -> torch.Tensor:
    return posed_bin().draw(K, 240, 320) + noise(1)


def full_frame() -> torch.Tensor:
    """The bin with one bracket in it."""
    seen, mask = view_of(bracket(), TRUTH)
    bin_m = posed_bin().draw(K, 240, 320)
    return torch.where(mask, seen.float(), bin_m) + noise(2)


def off_m(estimate: PoseEstimate, truth: Rigid) -> float:
    assert estimate.camera_from_model is not None
    return float(add_m(estimate.camera_from_model, truth, bracket().vertices_m))


def test_what_belongs_to_the_bin_is_not_found(net: Registration) -> None:
    unaware = net.find(full_frame(), CAMERA)
    assert min(off_m(found, FIXTURE) for found in unaware) < 0.005, "it looks like the part"
    for background in (posed_bin(), empty_frame()):
        (found,) = net.find(full_frame(), CAMERA, background=background)
        assert off_m(found, TRUTH) < 0.005


def test_an_empty_bin_holds_nothing(net: Registration) -> None:
    bin_m = posed_bin().draw(K, 240, 320) + noise(3)
    (found,) = net.find(bin_m, CAMERA, background=empty_frame())
    assert not found.is_posed


def test_readings_on_the_bin_are_background_and_those_of_the_part_are_not() -> None:
    view = add_background(view_input(full_frame(), None, CAMERA, "bracket", "x"), posed_bin())
    assert view.background is not None
    _, mask = view_of(bracket(), TRUTH)
    is_near_part = grow_mask(mask, 2)
    assert float(view.background.is_seen[~is_near_part].double().mean()) > 0.99
    assert float(view.background.is_seen[grow_mask(mask, -2)].double().mean()) < 0.01
    frame = prepare_frame(view.depth_m, view.K, None, view.background)
    assert bool((frame.background_limit_m[~is_near_part] == math.inf).double().mean() > 0.99)


def test_a_pose_in_a_wave_of_the_floor_is_no_place() -> None:
    """The floor is no plane: it is the known bin that a pose would lie in."""
    surface = bracket_surface()
    sunk = Rigid(TRUTH.R, TRUTH.t_m + torch.tensor([0.12, 0.0, 0.2])).double()
    depth_m = posed_bin().draw(K, 240, 320) + noise(2)
    plain = view_input(depth_m, None, CAMERA, "bracket", "x")
    assert share_in_background(prepare_frame(plain.depth_m, plain.K), sunk, surface) < 0.05
    view = add_background(plain, posed_bin())
    frame = prepare_frame(view.depth_m, view.K, None, view.background)
    assert share_in_background(frame, sunk, surface) > 0.05
    before = Rigid(TRUTH.R, TRUTH.t_m).double()
    assert share_in_background(frame, before, surface) < 0.05


def test_a_plane_through_the_tops_of_parts_is_no_background_before_a_known_bin() -> None:
    """Parts of one height that touch: where the bin is known, what lies before it is a part."""
    wall_m = torch.full((240, 320), 1.2) + noise(1)
    depth_m = wall_m.clone()
    depth_m[40:200, 40:280] = 0.9 + noise(2)[40:200, 40:280]
    view = view_input(depth_m, None, CAMERA, "bracket", "x")
    known = add_background(view, wall_m).background
    tops = prepare_frame(view.depth_m, view.K).background_limit_m[44:196, 44:276]
    assert bool((tops > 0.15).all()), "of smaller parts it is taken for a table"
    frame = prepare_frame(view.depth_m, view.K, None, known)
    assert not bool(frame.background_limit_m[44:196, 44:276].any())


def test_a_mask_that_takes_in_the_floor_is_reduced_to_the_part(net: Registration) -> None:
    _, mask = view_of(bracket(), TRUTH)
    loose = grow_mask(mask, 12)
    exact = net.estimate(depth=full_frame(), mask=mask, camera=CAMERA)
    found = net.estimate(depth=full_frame(), mask=loose, camera=CAMERA, background=empty_frame())
    assert found.evidence is not None
    assert exact.evidence is not None
    assert "search" not in found.seconds, "the mask fits, so the region is not searched"
    assert found.evidence.agreement > exact.evidence.agreement - 0.03
    assert off_m(found, TRUTH) < 0.003


def test_a_mask_of_the_bin_alone_says_so(net: Registration) -> None:
    _, fixture = view_of(bracket(), FIXTURE)
    found = net.estimate(
        depth=full_frame(), mask=grow_mask(fixture, -2), camera=CAMERA, background=posed_bin()
    )
    assert found.camera_from_model is None
    assert "every reading lies on the background" in found.reason


def test_a_plate_that_lies_flush_in_its_tray_is_not_cut_out_of_it() -> None:
    """The tray goes on beside the plate in one plane; it is known, so it is no part of it."""
    corners, faces = box_faces()
    plate = make_model(corners * torch.tensor([0.16, 0.14, 0.012]), faces, name="plate", number=7)
    pose = Rigid(torch.eye(3), torch.tensor([0.0, 0.0, 0.7]))
    seen, mask = view_of(plate, pose)
    level_m = float(seen[mask].median())
    empty_m = torch.where(grow_mask(mask, 1), level_m + 0.012, level_m)
    depth_m = torch.where(mask, seen.float(), empty_m) + noise(2)
    plain = view_input(depth_m, mask, CAMERA, "plate", "x")
    known = add_background(plain, empty_m + noise(1))
    surface = prepare_surface(plate)
    cloud_m = cloud_from_depth(depth_m, mask, K)

    def continued_share(view: ViewInput, *, is_masked: bool) -> float:
        observation = observe(cloud_m, view, surface, is_masked=is_masked)
        evidence = compare(observation, pose, surface)
        return evidence.continued / max(1.0, evidence.silhouette)

    assert continued_share(plain, is_masked=False) > MOST_CONTINUED
    assert continued_share(known, is_masked=False) < 0.1
    assert continued_share(plain, is_masked=True) == 0, "the mask says where it ends"


def test_backgrounds_that_cannot_be_are_refused() -> None:
    view = view_input(full_frame(), None, CAMERA, "bracket", "x")
    raised = Rigid(torch.eye(3), torch.tensor([0.0, 0.0, -0.5]))
    millimetres = Rigid(torch.eye(3), torch.tensor([0.0, 0.0, -400.0]))
    model = posed_bin().model
    for background, reason in (
        (torch.ones(120, 160), "the empty frame has 160x120 pixels, the depth image 320x240"),
        (torch.full((240, 320), torch.nan), "no pixel has a reading both"),
        (
            PosedBin(model=model, camera_from_model=raised),
            "lie behind the bin, 99.4 mm in the median",
        ),
        (PosedBin(model=model, camera_from_model=millimetres), "the bin is not in view"),
        (empty_frame() + 0.1, "of the readings lie on the empty frame, as if it were not there"),
    ):
        with pytest.raises(InputError, match=reason):
            add_background(view, background)


def test_a_cloud_has_no_background(net: Registration) -> None:
    with pytest.raises(InputError, match="background= belong to a depth image"):
        net.estimate(cloud=torch.rand(500, 3), background=empty_frame())


def test_a_bin_is_read_with_its_pose_and_unit(tmp_path: Path) -> None:
    import trimesh

    corners, faces = box_faces()
    trimesh.Trimesh(corners.numpy() * 300, faces.numpy()).export(tmp_path / "bin.stl")
    pose = torch.eye(4)
    pose[2, 3] = 1.0
    depth_m = PosedBin.load(tmp_path / "bin.stl", pose, "mm").draw(K, 240, 320)
    assert float(depth_m[120, 160]) == pytest.approx(0.85)
    with pytest.raises(InputError, match="the pose of the bin is no rigid transform"):
        PosedBin.load(tmp_path / "bin.stl", 2 * pose, "mm")
