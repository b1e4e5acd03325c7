"""Whether a pose fits what the camera saw, at the sensor's own scale, and what is said of it."""

from dataclasses import replace

import pytest
import torch
from bench.negatives import scaled
from tests.pose.synthetic_objects import (
    CAMERA,
    K,
    Oracle,
    bracket,
    cloud_of,
    pose_at,
    tiny_weights,
    view_of,
)
from torch import Tensor

from depthpose.core.checkpoint import SHIPPED, read_checkpoint
from depthpose.core.config import config_from_dict
from depthpose.core.errors import InputError
from depthpose.core.rigid import Rigid
from depthpose.pose.cloud import ObjectCloud, grow_mask, prepare_cloud
from depthpose.pose.config import CloudConfig, EstimateConfig, IcpConfig, RefusalConfig
from depthpose.pose.copies import (
    Candidate,
    KnownObject,
    find_copies,
    surface_signals,
)
from depthpose.pose.identity import (
    answer_of,
    fit_of,
    misfit_of,
    observability,
    seen_about,
    with_status,
)
from depthpose.pose.surface import prepare_surface
from depthpose.pose.types import Fit, ObjectModel, PoseEstimate, ViewInput

TRUTH = pose_at()
SURFACE = prepare_surface(bracket())
WALL_M = 1.3
LOOSE = RefusalConfig(max_beyond=1.0, max_size_error=1.0, min_found=0.0)


def seen_in(model: ObjectModel, noise_m: float = 0.0) -> ViewInput:
    """A model before a wall."""
    depth_m, mask = view_of(model, TRUTH)
    depth_m = torch.where(mask, depth_m, torch.tensor(WALL_M).to(depth_m))
    depth_m = depth_m + noise_m * torch.randn(240, 320, generator=torch.Generator().manual_seed(0))
    return ViewInput(name="a", depth_m=depth_m.float(), mask=mask, K=K, object="bracket")


def fit(view: ViewInput, pose: Rigid = TRUTH, *, as_cloud: bool = False) -> Fit:
    from depthpose.pose.cloud import cloud_from_depth

    cloud_m = cloud_from_depth(view.depth_m, view.mask, K)
    cloud_m = cloud_m[cloud_m[:, 2] < WALL_M - 0.1]  # as flying pixels are dropped
    seen = seen_about(cloud_m, None if as_cloud else view, SURFACE.diameter_m)
    return fit_of(seen, pose, SURFACE)


def left_part(view: ViewInput) -> Tensor:
    """The pixels left of the middle of the object."""
    columns = torch.arange(320).expand(240, 320)
    return view.mask & (columns < columns[view.mask].median())


@pytest.mark.parametrize("as_cloud", [False, True])
def test_the_true_pose_fits_and_the_noise_is_that_of_the_sensor(as_cloud: bool) -> None:
    found = fit(seen_in(bracket(), 0.002), as_cloud=as_cloud)
    assert found.agrees > 0.99
    assert found.seen > 0.95
    assert found.beyond < 0.005
    assert found.noise_m == pytest.approx(0.002, rel=0.25)


@pytest.mark.parametrize(
    ("grow_px", "right_px", "offset_m"), [(3, 0, 0.0), (-3, 0, 0.0), (0, 3, 0.0), (0, 0, 0.006)]
)
def test_a_real_sensors_errors_are_no_misfit(grow_px: int, right_px: int, offset_m: float) -> None:
    """Masks are dilated, eroded or shifted; all readings are off along the ray alike."""
    view = seen_in(bracket(), 0.001)
    mask = grow_mask(view.mask, grow_px).roll(right_px, 1)
    mask[:, :right_px] = False
    found = fit(replace(view, mask=mask, depth_m=view.depth_m + offset_m))
    assert misfit_of(found, RefusalConfig()) is None, found


def test_what_the_camera_saw_through_or_before_a_pose_does_not_agree() -> None:
    view = seen_in(bracket())
    beside = Rigid(TRUTH.R, TRUTH.t_m + torch.tensor([0.4 * SURFACE.diameter_m, 0.0, 0.0]))
    behind = Rigid(TRUTH.R, TRUTH.t_m + torch.tensor([0.0, 0.0, 0.3 * SURFACE.diameter_m]))
    for pose in (beside, behind, Rigid(TRUTH.R, -TRUTH.t_m)):
        assert fit(view, pose).agrees < 0.7
    half = replace(view, mask=left_part(view))
    through = torch.where(left_part(view) | ~view.mask, view.depth_m, torch.tensor(WALL_M))
    assert fit(replace(half, depth_m=through)).agrees < 0.7
    for depth_m in (torch.nan, 0.4):  # no reading, or something before it: no contradiction
        other_m = torch.where(left_part(view), view.depth_m, torch.tensor(depth_m))
        found = fit(replace(half, depth_m=other_m))
        assert found.agrees > 0.99
        assert 0.3 < found.seen < 0.7


def test_a_larger_copy_reaches_beyond_the_silhouette_and_a_smaller_is_seen_through() -> None:
    larger, smaller = fit(seen_in(scaled(bracket(), 1.25))), fit(seen_in(scaled(bracket(), 0.8)))
    assert larger.beyond > 0.03
    assert smaller.beyond == 0
    assert smaller.agrees < fit(seen_in(bracket())).agrees - 0.05


def test_a_misfit_is_refused_with_its_numbers() -> None:
    view = seen_in(bracket())
    hollow = torch.where(left_part(view) | ~view.mask, view.depth_m, torch.tensor(WALL_M))
    net = Oracle(tiny_weights(bracket()), [TRUTH])
    given = {"camera": CAMERA, "depth": hollow.float().numpy(), "mask": left_part(view).numpy()}
    found = net.estimate(**given)
    assert found.status == "doubtful"
    assert found.camera_from_model is None
    assert found.fit is not None
    lost = f"{1 - found.fit.agrees:.0%} lies where the camera saw something else, and 20% may"
    assert lost in found.reason
    loose = RefusalConfig(min_agreement=0.0, min_found=0.0)
    assert Oracle(tiny_weights(bracket(), refusal=loose), [TRUTH]).estimate(**given).is_posed
    beside = Fit(agrees=1.0, seen=1.0, beyond=0.5, explained=1.0, noise_m=0.0)
    refusal = misfit_of(beside, RefusalConfig())
    assert refusal is not None
    assert "50.0% of the object's readings lie beside the posed silhouette" in refusal.reason


def answer(
    depth_m: Tensor, mask: Tensor, disagree: float | None = 0.1, refusal: RefusalConfig = LOOSE
) -> PoseEstimate:
    """What is said of the true pose, the only candidate, by a network that disagrees so much."""
    view = ViewInput(name="a", depth_m=depth_m, mask=mask, K=K, object="bracket")
    cloud = prepare_cloud(view, bracket(), CloudConfig(), EstimateConfig())
    assert isinstance(cloud, ObjectCloud)
    alone = [Candidate(TRUTH.double(), torch.eye(6), 0.001)]
    copies = find_copies(bracket(), up_to_symmetry=False)
    known = KnownObject(number=0, model=bracket(), surface=SURFACE, copies=copies)
    evidence = dict.fromkeys(RefusalConfig().candidate_slopes, 0.1)
    del evidence["disagree"]
    if disagree is not None:
        evidence["disagree"] = disagree
    even = replace(refusal, candidate_slopes=dict.fromkeys(evidence, 1.0))
    return answer_of(cloud, known, alone, [evidence], even, EstimateConfig(), {})


def test_a_pose_of_which_some_disagrees_is_not_certain_though_no_other_was_found() -> None:
    view = seen_in(bracket())
    behind = view.depth_m.clone()
    rows = view.mask.any(1).nonzero()[:, 0]
    own_rows = rows[int(0.78 * len(rows)) :]
    behind[own_rows] = torch.where(view.mask[own_rows], behind[own_rows] + 0.05, behind[own_rows])
    whole, some = (answer(depth_m, view.mask, None) for depth_m in (view.depth_m, behind))
    assert whole.is_ok
    assert some.fit is not None
    assert 0.8 < some.fit.agrees < 0.85
    assert some.status == "ambiguous"


@pytest.mark.parametrize("noise_m", [0.0, 0.002])
def test_what_a_network_doubts_or_a_view_hardly_fixes_is_less_certain(noise_m: float) -> None:
    view = seen_in(bracket(), noise_m)
    sure, unsure, registered = (
        answer(view.depth_m, view.mask, disagree).certainty for disagree in (0.1, 0.9, None)
    )
    rows = view.mask.any(1).nonzero()[:, 0]
    corner = view.mask.clone()
    corner[: rows[int(0.8 * len(rows))]] = False
    little = answer(view.depth_m, corner, 0.9).certainty
    assert sure is not None
    assert unsure is not None
    assert registered is not None
    assert little is not None
    assert sure > registered > unsure > little


def test_a_pose_is_refused_where_the_right_one_is_hardly_among_those_found() -> None:
    view = seen_in(bracket(), 0.002)
    rows = view.mask.any(1).nonzero()[:, 0]
    corner = view.mask.clone()
    corner[: rows[int(0.8 * len(rows))]] = False
    found = answer(view.depth_m, corner, 1.5, RefusalConfig())
    assert found.status == "doubtful"
    assert found.camera_from_model is None
    assert "the right pose is among those that were found: " in found.reason
    assert answer(view.depth_m, corner, 1.5, RefusalConfig(min_found=0.0)).is_posed
    assert answer(view.depth_m, view.mask, 0.3, RefusalConfig()).is_ok


def test_an_answer_below_the_wanted_certainty_is_ambiguous() -> None:
    pose = Rigid(torch.eye(3), torch.zeros(3))
    sure = PoseEstimate(name="a", object="b", status="ok", camera_from_model=pose, certainty=0.6)
    found = with_status(sure, 0.9)
    assert (found.status, found.is_ok, found.is_posed) == ("ambiguous", False, True)
    assert found.camera_from_model is pose
    assert found.reason == (
        "this pose has a certainty of 60%, below min_certainty 90%: others may fit"
    )
    assert with_status(found, 0.5).status == "ok"
    assert with_status(found, 0.5).reason == ""
    refused = PoseEstimate(name="a", object="b", status="doubtful", reason="so")
    assert with_status(refused, 0.5) is refused
    with pytest.raises(InputError, match=r"min_certainty must be in \[0, 1\], got 1.5"):
        EstimateConfig(min_certainty=1.5)


def test_settings_of_the_risk_of_before_are_left_out() -> None:
    old = {"max_risk": 0.3, "slopes": {"far": 4.0}, "min_explained": 0.75, "min_hold": 0.1}
    assert config_from_dict(old, RefusalConfig, source="old") == RefusalConfig(
        min_observability=0.1
    )
    for path in SHIPPED.glob("*.safetensors"):
        refusal = read_checkpoint(path).config.get("refusal", {})
        config_from_dict(refusal, RefusalConfig, source=path.name)


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"min_agreement": 1.5}, r"min_agreement must be in \[0, 1\], got 1.5; the default is 0.8"),
        ({"max_beyond": -1.0}, r"max_beyond must be in \[0, 1\], got -1.0"),
        ({"min_observability": -0.1}, r"min_observability must be in \[0, 1\), got -0.1"),
        ({"max_size_error": 0.0}, r"max_size_error must be in \(0, 1\], got 0.0"),
    ],
)
def test_settings_beyond_their_range_are_refused(values: dict, text: str) -> None:
    with pytest.raises(InputError, match=text):
        RefusalConfig(**values)


def test_settings_of_an_estimate_beyond_their_range_are_refused() -> None:
    with pytest.raises(InputError, match=r"batch_voxels must be in \[1, inf\), got 0"):
        EstimateConfig(batch_voxels=0)
    with pytest.raises(InputError, match=r"starts must be in \[1, 7\], got 8"):
        IcpConfig(starts=8)
    with pytest.raises(InputError, match=r"rough_rigidity_diameters is 0\.05, but the strict one"):
        EstimateConfig(rough_rigidity_diameters=0.05)


def test_a_wrong_pose_has_worse_signals_than_the_true_one() -> None:
    model, truth = bracket(), pose_at()
    surface, cloud = prepare_surface(model), cloud_of(model, truth)
    nearer = Rigid(truth.R.double(), truth.t_m.double() - torch.tensor([0.0, 0, 0.04]))
    turned = Rigid(pose_at(seed=5).R.double(), truth.t_m.double())
    poses = Rigid.stack([truth.double(), nearer, turned])
    true, *wrong = surface_signals(cloud, poses, surface)
    assert true["far"] == 0
    assert true["front"] < 0.1
    assert true["gap"] < 0.01
    assert true["unseen"] < 0.1
    assert wrong[0]["front"] > 0.5
    for name in ("far", "unseen", "tilt"):
        assert wrong[1][name] > true[name] + 0.1


def test_a_plane_is_unobservable_and_a_corner_is_not() -> None:
    model = bracket()
    surface = prepare_surface(model)
    pose = Rigid(torch.eye(3).double(), torch.tensor([0.0, 0, 0.8]).double())
    flat = torch.rand(500, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    side = flat * torch.tensor([0.19, 0.05, 0]) + torch.tensor([0.0, 0, -0.025])
    none = torch.zeros(0, 6)
    lock_folder, motion = observability(pose.apply(side.double()), pose, surface, none)
    assert lock_folder < 1e-6
    assert float(motion.norm()) == pytest.approx(1)
    whole, _ = observability(pose.apply(surface.points_m), pose, surface, none)
    assert whole > 0.15
    away, _ = observability(torch.ones(100, 3), pose, surface, none)
    assert away == 0
