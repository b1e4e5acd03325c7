"""Evidence of competing poses to probabilities, a status and its reason."""

import math
from dataclasses import replace
from functools import partial

import pytest
import torch
from tests.pose.synthetic_objects import pose_at

from depthpose.core.errors import InputError
from depthpose.core.rigid import Rigid
from depthpose.pose.config import EstimateConfig
from depthpose.pose.types import Alternative, Evidence, PoseEstimate, PoseFit
from depthpose.pose.verify.decide import explain_doubt, seconds_of_all, with_status
from depthpose.pose.verify.hypotheses import (
    Competition,
    Hypothesis,
    share_among_copies,
    share_among_poses,
)
from depthpose.pose.verify.probability import (
    PRIOR_EXPECTED,
    PRIOR_UNEXPECTED,
    GammaShare,
    log_likelihood_ratio,
    probability_right,
)

GOOD = Evidence(
    visible=40.0, supported=38.0, explained=38.0,
    unobserved=2.0, seen_through=0.0, bulging=0.0, beside=0.0, silhouette=25.0, continued=0.0,
    rms=0.5, noise_m=0.001,
)  # fmt: skip
"""What a right pose leaves."""
BAD = replace(
    GOOD, supported=20.0, explained=20.0, unobserved=6.0, seen_through=8.0, bulging=6.0, rms=1.3
)
"""What a wrong one leaves."""


def hypothesis(evidence: Evidence, votes_rad: float | None = None, color: float = 0) -> Hypothesis:
    refined = PoseFit(
        camera_from_model=pose_at().double(),
        covariance=torch.eye(6),
        residual_m=torch.tensor(0.001),
        inlier_share=torch.tensor(1.0),
    )
    return Hypothesis(refined=refined, evidence=evidence, votes_rad=votes_rad, log_color=color)


@pytest.mark.parametrize(
    "share", [GammaShare(mean=0.1, shape=1.0), GammaShare(mean=0.5, shape=3.0)]
)
@pytest.mark.parametrize("area", [1.0, 30.0])
def test_counts_have_a_distribution(share: GammaShare, area: float) -> None:
    probabilities = [math.exp(share.log_likelihood(count, area)) for count in range(2000)]
    assert sum(probabilities) == pytest.approx(1)
    mean = sum(count * p for count, p in enumerate(probabilities))
    assert mean == pytest.approx(share.mean * area, rel=1e-6)


def test_the_seconds_of_several_tries_add_up() -> None:
    tries = [
        PoseEstimate(name="a", object="part", status="doubtful", reason="no", seconds=seconds)
        for seconds in ({"cloud": 1.0, "icp": 2.0}, {"icp": 0.5, "search": 4.0})
    ]
    assert seconds_of_all(tries) == {"cloud": 1.0, "icp": 2.5, "search": 4.0}


def test_each_kind_of_contradiction_lowers_the_probability() -> None:
    right = probability_right(GOOD, is_expected=True)
    assert right > 0.99
    for kind in ("seen_through", "bulging", "beside"):
        before = right
        evidence = GOOD
        for patches in (2.0, 8.0, 20.0):
            evidence = replace(GOOD, supported=38.0 - patches, **{kind: patches})
            assert evidence.contradicted == patches
            after = probability_right(evidence, is_expected=True)
            assert after < before or after == before == 0, (kind, patches)
            before = after
        # Where the rest lies no nearer than it does by accident, it is refused.
        assert probability_right(replace(evidence, rms=1.7), is_expected=False) < 0.1, kind


def test_a_surface_that_goes_on_across_half_of_the_silhouette_is_of_something_larger() -> None:
    touching = replace(GOOD, continued=2.0)
    larger = replace(GOOD, continued=12.0)
    assert abs(log_likelihood_ratio(touching) - log_likelihood_ratio(GOOD)) < 1
    assert log_likelihood_ratio(larger) < log_likelihood_ratio(GOOD) - 4
    # Of a length that was not examined nothing is said.
    masked = replace(GOOD, silhouette=0.0)
    assert abs(log_likelihood_ratio(masked) - log_likelihood_ratio(GOOD)) < 1


def test_what_was_not_observed_lowers_it_less_than_what_contradicts() -> None:
    hidden = replace(GOOD, supported=20.0, explained=20.0, unobserved=20.0)
    through = replace(GOOD, supported=20.0, explained=20.0, seen_through=18.0)
    assert log_likelihood_ratio(through) < log_likelihood_ratio(hidden) < log_likelihood_ratio(GOOD)


def test_a_pose_that_a_search_proposed_needs_more_evidence_than_one_in_a_mask() -> None:
    evidence = replace(GOOD, supported=28.0, explained=28.0, unobserved=10.0, seen_through=2.0)
    masked, proposed = (
        probability_right(evidence, is_expected=is_expected) for is_expected in (True, False)
    )
    assert masked > proposed
    odds = [p / (1 - p) for p in (masked, proposed)]
    assert odds[0] / odds[1] == pytest.approx(PRIOR_EXPECTED / PRIOR_UNEXPECTED, rel=1e-6)


def test_poses_share_the_probability_of_one() -> None:
    shares = share_among_poses([hypothesis(GOOD), hypothesis(BAD), hypothesis(BAD)], is_masked=True)
    assert float(shares.sum()) == pytest.approx(1)
    assert float(shares[0]) > 0.99
    assert float(shares[1]) == float(shares[2])
    assert share_among_poses([hypothesis(BAD)], is_masked=True).tolist() == [1.0]


def test_without_a_mask_the_pose_that_explains_more_of_the_same_readings_is_likelier() -> None:
    small = replace(GOOD, visible=10.0, supported=10.0)
    few = replace(GOOD, seen_through=2.0, supported=38.0)
    assert GOOD.visible == 40.0
    shares = share_among_poses([hypothesis(small), hypothesis(few)], is_masked=False)
    assert float(shares[1]) > 0.8
    # Also one that nothing contradicts; within a mask it is the readings beside it that count.
    clean = replace(GOOD, visible=20.0, supported=20.0, explained=20.0, unobserved=0.0)
    most = replace(
        GOOD, visible=60.0, supported=40.0, explained=40.0, unobserved=10.0, seen_through=10.0
    )
    both = [hypothesis(clean), hypothesis(most)]
    assert float(share_among_poses(both, is_masked=False)[1]) > 0.9
    assert float(share_among_poses(both, is_masked=True)[0]) > 0.9


def test_copies_share_by_a_patch_that_tells_them_apart() -> None:
    """A keyway where the model has none contradicts a copy by a few patches, of very many."""
    keyway = replace(GOOD, supported=35.0, explained=35.0, bulging=1.5, seen_through=1.5)
    shares = share_among_copies([hypothesis(GOOD), *[hypothesis(keyway)] * 3], is_masked=True)
    assert float(shares.sum()) == pytest.approx(1)
    assert float(shares[0]) > float(shares[1])
    # A handle that should be seen and is not: another copy has it on the far side.
    unseen = replace(GOOD, supported=30.0, explained=30.0, unobserved=10.0)
    assert (
        float(share_among_copies([hypothesis(GOOD), hypothesis(unseen)], is_masked=True)[0]) > 0.6
    )
    alike = share_among_copies([hypothesis(GOOD)] * 4, is_masked=True)
    assert alike.tolist() == pytest.approx([0.25] * 4)


def test_without_a_mask_a_copy_that_leaves_a_handle_unexplained_is_unlikely() -> None:
    """Nothing contradicts it: its own handle would be hidden behind the mug."""
    left_out = replace(GOOD, visible=34.0, supported=34.0, explained=34.0, unobserved=0.0)
    both = [hypothesis(GOOD), hypothesis(left_out)]
    in_a_mask = share_among_copies(both, is_masked=True)
    without = share_among_copies(both, is_masked=False)
    assert float(without[0]) > 0.6 > float(in_a_mask[0])


def test_votes_and_colour_tell_apart_what_depth_does_not() -> None:
    voted = [hypothesis(GOOD, votes_rad=0.1), hypothesis(GOOD, votes_rad=1.0)]
    shares = share_among_poses(voted, is_masked=True)
    assert float(shares[0]) > 0.95
    for share in (
        partial(share_among_poses, is_masked=True),
        partial(share_among_copies, is_masked=True),
    ):
        shares = share([hypothesis(GOOD, color=0.0), hypothesis(GOOD, color=math.log(9.0))])
        assert shares.tolist() == pytest.approx([0.1, 0.9])


def test_a_pose_and_its_copies_have_the_share_of_the_group() -> None:
    competition = Competition(
        best=hypothesis(GOOD), best_share=0.5, copies=[(hypothesis(GOOD), 0.3)] * 1,
        others=[(hypothesis(BAD), 0.2)],
    )  # fmt: skip
    assert competition.group_share == pytest.approx(0.8)


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("seen_through", "the camera saw through 50% of the posed surface"),
        ("bulging", "50% of its readings lie before the posed surface"),
        ("beside", "50% of the object's readings lie beside the posed silhouette"),
        ("continued", "the surface within the posed silhouette goes on beyond it"),
        ("unobserved", "50% of the posed surface was not observed"),
    ],
)
def test_a_refusal_says_what_contradicts_the_pose_most(kind: str, words: str) -> None:
    evidence = replace(GOOD, supported=20.0, explained=20.0, unobserved=0.0)
    evidence = replace(evidence, **{kind: 20.0})
    reason = explain_doubt(evidence, 0.125, is_masked=True)
    assert reason.startswith("the best pose is right with a probability of 12%: ")
    assert words in reason
    assert "a mask of more than the object" in reason
    searched = explain_doubt(evidence, 0.125, is_masked=False)
    assert words in searched
    assert "mask" not in searched, "a search was given none"


def test_less_than_one_patch_says_nothing_for_a_pose() -> None:
    little = replace(GOOD, visible=0.7, supported=0.7, explained=0.7, unobserved=0.0)
    assert log_likelihood_ratio(little) == 0
    assert log_likelihood_ratio(replace(little, visible=1.5, supported=1.5, explained=1.5)) > 0


def test_a_pose_on_something_larger_is_refused_for_this_reason_beside_larger_areas() -> None:
    evidence = replace(GOOD, silhouette=20.0, continued=7.0, unobserved=30.0)
    assert probability_right(evidence, is_expected=True) == 0
    assert "goes on beyond it" in explain_doubt(evidence, 0.0, is_masked=False)
    evidence = replace(evidence, continued=5.0)
    assert probability_right(evidence, is_expected=True) > 0.5, "objects touch"
    assert "was not observed" in explain_doubt(evidence, 0.0, is_masked=False)


def test_an_answer_below_the_wanted_certainty_is_ambiguous() -> None:
    pose = Rigid(torch.eye(3), torch.zeros(3))
    other = Alternative(camera_from_model=pose, probability=0.2, difference="so")
    sure = PoseEstimate(
        name="a", object="b", status="ok", camera_from_model=pose, certainty=0.6,
        alternatives=(other, replace(other, is_copy=True)),
    )  # fmt: skip
    found = with_status(sure, 0.9)
    assert (found.status, found.is_ok, found.is_posed) == ("ambiguous", False, True)
    assert found.camera_from_model is pose
    words = "this pose has a certainty of 60 %, below min_certainty 90 %: "
    assert found.reason == words + "1 others fit too", "copies are the same up to near-symmetry"
    alone = with_status(replace(sure, alternatives=()), 0.9)
    assert alone.reason == words + "others may fit"
    nearly = with_status(replace(sure, certainty=0.8996), 0.9)
    assert "a certainty of 89.96 %, below min_certainty 90 %" in nearly.reason
    assert with_status(found, 0.5).status == "ok"
    assert with_status(found, 0.5).reason == ""
    refusal = PoseEstimate(name="a", object="b", status="doubtful", reason="so")
    assert with_status(refusal, 0.5) is refusal
    with pytest.raises(InputError, match=r"min_certainty must be in \[0, 1\], got 1.5"):
        EstimateConfig(min_certainty=1.5)
