"""What is refused, and how a user is told: poses that the image contradicts, unobservable views."""

from dataclasses import replace

import pytest
import torch
from bench.negatives import scaled
from tests.pose.synthetic_objects import CAMERA, K, Oracle, bracket, pose_at, tiny_weights, view_of
from torch import Tensor

from depthpose.core.errors import InputError
from depthpose.core.rigid import Rigid
from depthpose.pose.config import EstimateConfig, IcpConfig, RefusalConfig, VotingConfig
from depthpose.pose.geometry.surface import prepare_surface
from depthpose.pose.registration import Registration
from depthpose.pose.types import ObjectModel, PoseEstimate, ViewInput
from depthpose.pose.verify.observability import observability

TRUTH = pose_at()
WALL_M = 1.3


def view_before_wall(model: ObjectModel, noise_m: float = 0.001) -> ViewInput:
    """A model before a wall."""
    depth_m, mask = view_of(model, TRUTH)
    depth_m = torch.where(mask, depth_m, torch.tensor(WALL_M).to(depth_m))
    depth_m = depth_m + noise_m * torch.randn(240, 320, generator=torch.Generator().manual_seed(0))
    return ViewInput(name="a", depth_m=depth_m.float(), mask=mask, K=K, object="bracket")


def left_part(view: ViewInput) -> Tensor:
    """The pixels left of the middle of the object."""
    columns = torch.arange(320).expand(240, 320)
    return view.mask & (columns < columns[view.mask].median())


def estimated(view: ViewInput, refusal: RefusalConfig | None = None) -> PoseEstimate:
    """What is said of a view by a network that is right."""
    net = Oracle(tiny_weights(bracket(), refusal=refusal or RefusalConfig()), [TRUTH])
    return net.estimate(camera=CAMERA, depth=view.depth_m.numpy(), mask=view.mask.numpy())


def test_what_the_camera_saw_through_is_refused_with_its_share() -> None:
    view = view_before_wall(bracket())
    left = left_part(view)
    hollow = torch.where(left | ~view.mask, view.depth_m, torch.tensor(WALL_M))
    given = replace(view, depth_m=hollow, mask=left)
    refused = estimated(given)
    assert refused.status == "doubtful"
    assert refused.camera_from_model is None
    assert refused.certainty is None
    assert refused.evidence is not None
    share = refused.evidence.seen_through / refused.evidence.visible
    assert 0.3 < share < 0.7
    assert f"the camera saw through {share:.0%} of the posed surface" in refused.reason
    loose = RefusalConfig(min_probability=0.0, max_size_error=1.0)
    assert estimated(given, loose).is_posed


def test_what_is_hidden_is_less_certain_and_what_is_seen_through_less_still() -> None:
    """Half of the object: behind something nearer, or not there."""
    loose = RefusalConfig(min_probability=0.0, max_size_error=1.0)
    view = view_before_wall(bracket())
    left = left_part(view)
    certainties = [estimated(view, loose).certainty]
    for depth_m in (0.45, WALL_M):
        seen_m = torch.where(left | ~view.mask, view.depth_m, torch.tensor(depth_m))
        certainties.append(estimated(replace(view, depth_m=seen_m, mask=left), loose).certainty)
    whole, hidden, through = (certainty or 0.0 for certainty in certainties)
    assert whole > 0.95
    assert whole > hidden > through
    assert through < 0.5


def test_the_limits_of_the_weights_hold_for_every_pose_unless_the_config_has_others() -> None:
    view = view_before_wall(bracket())
    box = replace(view, is_region=True)
    strict = RefusalConfig(min_probability=1.0)
    weights = tiny_weights(bracket(), refusal=strict)
    refused = Oracle(weights, [TRUTH]).estimate_many([view, box])
    assert [estimate.status for estimate in refused] == ["doubtful", "doubtful"]
    usual = EstimateConfig(refusal=RefusalConfig())
    posed = Oracle(weights, [TRUTH], config=usual).estimate_many([view, box])
    assert [estimate.status for estimate in posed] == ["ok", "ok"]
    (registered,) = Registration([bracket()], EstimateConfig(refusal=strict)).estimate_many([view])
    assert registered.status == "doubtful"


def test_a_copy_of_another_size_is_no_answer() -> None:
    for times in (0.8, 1.25):
        refused = estimated(view_before_wall(scaled(bracket(), times)))
        assert refused.status == "doubtful", times
        assert refused.camera_from_model is None


def with_boss(at: tuple[float, float, float]) -> ObjectModel:
    """The bracket with a boss of 2 x 2 x 1.5 cm elsewhere than the model has any."""
    from tests.pose.synthetic_objects import box_faces

    from depthpose.pose.mesh import make_model

    corners, faces = box_faces()
    boss_m = corners * torch.tensor([0.025, 0.025, 0.025]) + torch.tensor(at)
    model = bracket()
    return make_model(
        torch.cat([model.vertices_m, boss_m]),
        torch.cat([model.faces, faces + len(model.vertices_m)]),
        name="bracket",
        number=model.number,
    )


def test_a_twin_with_a_boss_elsewhere_is_not_confirmed() -> None:
    net = Registration([bracket()])
    view = view_before_wall(bracket())
    (found,) = net.estimate_many([view])
    assert found.is_ok, found.reason
    assert found.identity is not None
    assert found.identity.status == "confirmed", found.identity
    # On the side that the camera sees.
    toward = TRUTH.inverse().R[:, 2] * -1
    side = int(toward.abs().argmax())
    at = [0.0, 0.0, 0.0]
    at[side] = float(toward[side].sign()) * (0.1, 0.03, 0.025)[side]
    twin = view_before_wall(with_boss((at[0], at[1], at[2])))
    assert int((twin.depth_m < view.depth_m - 0.005).sum()) > 200, "else the boss is not seen"
    (found,) = net.estimate_many([twin])
    assert found.identity is None or found.identity.status != "confirmed", found.identity
    if found.identity is not None and found.identity.status == "not excluded":
        assert found.identity.reason


@pytest.mark.parametrize(
    ("values", "text"),
    [
        (
            {"min_probability": 1.5},
            r"min_probability must be in \[0, 1\], got 1.5; the default is 0.5",
        ),
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


def test_a_plane_is_unobservable_and_a_corner_is_not() -> None:
    model = bracket()
    surface = prepare_surface(model)
    pose = Rigid(torch.eye(3).double(), torch.tensor([0.0, 0, 0.8]).double())
    flat = torch.rand(500, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    side = flat * torch.tensor([0.19, 0.05, 0]) + torch.tensor([0.0, 0, -0.025])
    none = torch.zeros(0, 6)
    of_side = observability(pose.apply(side.double()), pose, surface, none)
    assert of_side is not None
    assert of_side[0] < 1e-6
    assert float(of_side[1].norm()) == pytest.approx(1)
    of_whole = observability(pose.apply(surface.points_m), pose, surface, none)
    assert of_whole is not None
    assert of_whole[0] > 0.15
    assert observability(torch.ones(100, 3), pose, surface, none) is None


def test_the_rigidity_of_rough_votes_counts_only_with_icp() -> None:
    config = EstimateConfig(with_icp=False, voting=VotingConfig(rigidity_diameters=0.4))
    assert config.voting.rigidity_diameters > config.rough_rigidity_diameters
