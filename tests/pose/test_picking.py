"""The order to pick in: what lies before another goes first, then what is visible and sure."""

import itertools
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from tests.pose.synthetic_objects import CAMERA, K, bracket, pose_at, view_of

from depthpose.core.render import rasterize
from depthpose.core.rigid import Rigid
from depthpose.pose.config import ObjectsConfig, SyntheticSensorConfig
from depthpose.pose.datasets import BopFrame
from depthpose.pose.geometry.surface import Surface, prepare_surface
from depthpose.pose.mesh import drawn_triangles
from depthpose.pose.picking import rank_picks
from depthpose.pose.registration import Registration
from depthpose.pose.synthetic import make_frames
from depthpose.pose.synthetic.parts import make_part
from depthpose.pose.types import Evidence, PoseEstimate, ViewInput

EVIDENCE = Evidence(
    visible=20.0, supported=20.0, explained=20.0,
    unobserved=0.0, seen_through=0.0, bulging=0.0, beside=0.0, silhouette=0.0, continued=0.0,
    rms=0.5, noise_m=0.001,
)  # fmt: skip


@cache
def surface() -> Surface:
    return prepare_surface(bracket())


def posed(x_m: float, z_m: float, certainty: float = 1.0, visible: float = 1.0) -> PoseEstimate:
    """A bracket before the camera, so sure and so visible."""
    return PoseEstimate(
        name="", object="bracket", status="ok", certainty=certainty,
        camera_from_model=Rigid(torch.eye(3), torch.tensor([x_m, 0.0, z_m])),
        evidence=replace(EVIDENCE, supported=20.0 * visible),
    )  # fmt: skip


def ranks(*estimates: PoseEstimate) -> list[int | None]:
    depth_m = torch.full((240, 320), 2.0)
    view = ViewInput(name="x", depth_m=depth_m, mask=depth_m > 0, K=K, object="bracket")
    surfaces = {"bracket": surface()}
    return [estimate.pick_rank for estimate in rank_picks(estimates, view, surfaces)]


def test_what_lies_before_another_goes_first_however_unsure_it_is() -> None:
    below = posed(0.0, 0.9)
    above = posed(0.05, 0.7, certainty=0.5, visible=0.4)
    top = posed(0.1, 0.5, certainty=0.4, visible=0.3)
    assert ranks(below, above, top) == [3, 2, 1]
    assert ranks(top, below, above) == [1, 3, 2]


def test_of_what_lies_free_the_surest_and_most_visible_goes_first() -> None:
    assert ranks(posed(-0.15, 0.8, certainty=0.9), posed(0.15, 0.8)) == [2, 1]
    assert ranks(posed(-0.15, 0.8, visible=0.6), posed(0.15, 0.8, certainty=0.7)) == [2, 1]


def test_what_was_refused_has_no_rank() -> None:
    refused = PoseEstimate(name="", object="bracket", status="doubtful", reason="it is none")
    assert ranks(refused, posed(0.0, 0.8)) == [None, 1]


def pile(seed: int) -> BopFrame:
    """Connectors on one another, without noise."""
    config = ObjectsConfig(frame_pile=25, seed=seed, distance_m=(0.7, 0.7),
                           sensor=SyntheticSensorConfig(kinds=("none",)))  # fmt: skip
    return next(make_frames([make_part("connector")], config, 1))


def true_estimates(frame: BopFrame) -> list[PoseEstimate]:
    """The true poses, each as visible as it is."""
    estimates = []
    for k, one in enumerate(frame.objects):
        visible = float(one.visible.sum() / one.silhouette.sum())
        estimate = PoseEstimate(
            name=f"{k}", object="connector", status="ok", camera_from_model=one.camera_from_model,
            certainty=1.0, evidence=replace(EVIDENCE, supported=20 * visible),
        )  # fmt: skip
        estimates.append(estimate)
    return estimates


def hiding_pairs(frame: BopFrame) -> list[tuple[int, int]]:
    """Pairs of which the first lies before a tenth of the second, and not the other way round."""
    corners_m = drawn_triangles(make_part("connector"))
    height, width = frame.depth_m.shape
    drawn_m = [
        rasterize(one.camera_from_model.apply(corners_m), frame.K.double(), width, height).depth_m
        for one in frame.objects
    ]
    pairs = []
    for above, below in itertools.permutations(range(len(drawn_m)), 2):
        before_px = int((drawn_m[above] < drawn_m[below]).sum())
        behind_px = int((drawn_m[above] > drawn_m[below]).sum())
        if before_px > max(0.1 * int(drawn_m[below].isfinite().sum()), 2 * behind_px):
            pairs.append((above, below))
    return pairs


@pytest.mark.slow
def test_a_pile_is_picked_from_the_top() -> None:
    surfaces = {"connector": prepare_surface(make_part("connector"))}
    total = 0
    for seed in range(2):
        frame = pile(seed)
        estimates = true_estimates(frame)
        view = ViewInput(
            name="x", depth_m=frame.depth_m, mask=frame.depth_m > 0, K=frame.K, object="connector"
        )
        ranked = rank_picks(estimates, view, surfaces)
        order = [estimate.pick_rank or 0 for estimate in ranked]
        assert sorted(order) == list(range(1, len(order) + 1))
        pairs = hiding_pairs(frame)
        assert all(order[above] < order[below] for above, below in pairs)
        assert any(above > below for above, below in pairs), "in the order of dropping it is not so"
        total += len(pairs)
        first = frame.objects[order.index(1)]
        assert float(first.visible.sum() / first.silhouette.sum()) > 0.97, "nothing lies over it"
    assert total > 10


@pytest.mark.parametrize("farther_m", [-0.12, 0.12])
def test_a_search_ranks_what_it_finds(farther_m: float) -> None:
    """Of two brackets one lies before the other."""
    truths = [pose_at(-0.05, 0.75, seed=2), pose_at(0.05, 0.75 + farther_m, seed=4)]
    seen, mask = view_of(bracket(), *truths)
    noise = 0.0005 * torch.randn(240, 320, generator=torch.Generator().manual_seed(0))
    found = Registration([bracket()]).find(torch.where(mask, seen.float(), 1.2) + noise, CAMERA)
    found.sort(key=lambda estimate: np.asarray(estimate.camera_from_model)[2, 3])
    nearer, farther = found
    assert (nearer.pick_rank, farther.pick_rank) == (1, 2)
    assert nearer.visible_share is not None
    assert farther.visible_share is not None
    assert nearer.visible_share > farther.visible_share
