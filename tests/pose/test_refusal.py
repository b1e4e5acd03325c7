"""The risk of an estimate and its limit, on made signals whose truth is known."""

import math

import pytest
import torch
from tests.pose.synthetic_objects import Oracle, bracket, cloud_of, pose_at, tiny_weights

from depthpose.core.checkpoint import SHIPPED, read_checkpoint
from depthpose.core.config import config_from_dict
from depthpose.core.errors import InputError
from depthpose.core.rigid import Rigid
from depthpose.pose.config import EstimateConfig, IcpConfig, RefusalConfig
from depthpose.pose.estimator import calibrate_refusal, fit_candidate_slopes, risk_of
from depthpose.pose.estimator.alternatives import share_out
from depthpose.pose.estimator.evidence import SIGNALS, observability, surface_signals
from depthpose.pose.estimator.refusal import reason_of
from depthpose.pose.metrics import risk_coverage
from depthpose.pose.surface import prepare_surface
from depthpose.pose.types import PoseEstimate

EYE = Rigid(torch.eye(3), torch.zeros(3))


def answer(**signals: float) -> PoseEstimate:
    every = {name: signals.get(name, 0.0) for name in SIGNALS}
    return PoseEstimate(name="a", object="b", status="ok", camera_from_model=EYE, signals=every)


def labelled_answers(count: int, seed: int) -> tuple[list[PoseEstimate], list[bool]]:
    """Wrong with the odds ``(20 far + 0.2)^4 / 400``, whatever ``tilt`` says."""
    generator = torch.Generator().manual_seed(seed)
    far, tilt, luck = torch.rand(3, count, generator=generator)
    is_right = luck > (4 * (20 * far + 0.2).log() - math.log(400)).sigmoid()
    answers = [answer(far=float(f), tilt=float(t)) for f, t in zip(far, tilt, strict=True)]
    return answers, is_right.tolist()


def test_the_risk_is_the_logistic_of_the_signals_logarithms() -> None:
    config = RefusalConfig(bias=-1.0, slopes={"far": 2.0, "gap": 3.0})
    signals = answer(far=0.99, gap=0.49).signals
    assert risk_of(signals, config) == pytest.approx(1 / (1 + math.exp(1) * 2**3))
    assert risk_of(signals, RefusalConfig()) is None
    assert risk_of(signals, RefusalConfig(bias=1e9, slopes={"far": 1.0})) == 1.0


def test_the_weights_here_weigh_the_signals_that_there_are() -> None:
    for path in SHIPPED.glob("*.safetensors"):
        refusal = read_checkpoint(path).config.get("refusal", {})
        assert refusal.get("slopes", {}).keys() <= SIGNALS.keys(), path.name


def test_folds_are_no_objects() -> None:
    """Views go round the objects. One of five is always wrong, and nothing but ``few`` tells it."""
    answers = [answer(few=0.4 if k % 5 == 4 else 0.1) for k in range(500)]
    config = calibrate_refusal(answers, [k % 5 != 4 for k in range(500)])
    kept = [k for k in range(500) if (risk_of(answers[k].signals, config) or 0) <= config.max_risk]
    assert kept == [k for k in range(500) if k % 5 != 4]


def test_a_refusal_names_the_signal_that_is_unusual() -> None:
    """What is always large, and weighs much, makes no answer more doubtful than others."""
    slopes, signals = {"unseen": 4.0, "far": 4.0}, answer(unseen=0.7, far=0.4).signals
    config = RefusalConfig(slopes=slopes, means={"unseen": math.log(0.66), "far": math.log(0.02)})
    assert reason_of(signals, 0.9, config).startswith("40% of the points are nowhere near")
    # Weights that were written before means were: those of 0.
    assert reason_of(signals, 0.9, RefusalConfig(slopes=slopes)).startswith("70% of the posed")
    old = {"max_risk": 0.3, "bias": -1.0, "slopes": slopes}
    assert config_from_dict(old, RefusalConfig, source="old").means == {}


def test_the_means_are_those_of_right_answers() -> None:
    answers = [answer(far=0.1), answer(far=0.3), answer(far=0.9)]
    config = calibrate_refusal(answers, [True, True, False])
    assert config.means["far"] == pytest.approx((math.log(0.11) + math.log(0.31)) / 2)
    assert config.means.keys() == config.slopes.keys()
    assert calibrate_refusal(answers, [False] * 3).means == {}


def test_calibration_finds_what_makes_answers_wrong() -> None:
    config = calibrate_refusal(*labelled_answers(4000, 0), max_wrong_share=0.02)
    assert config.slopes["far"] == pytest.approx(4, rel=0.2)
    assert config.bias == pytest.approx(4 * math.log(20) - math.log(400), rel=0.2)
    assert 0 <= config.slopes["tilt"] < 0.5
    assert "gap" not in config.slopes
    assert all(slope >= 0 for slope in config.slopes.values())


def test_a_rough_cloud_excuses_tilted_normals() -> None:
    """Wrong where the tilt exceeds the noise of the sensor, which ``rough`` tells."""
    generator = torch.Generator().manual_seed(0)
    rough, excess = torch.rand(2, 2000, generator=generator)
    answers = [
        answer(rough=float(r), tilt=float(r * (0.2 + 0.8 * e)))
        for r, e in zip(rough, excess, strict=True)
    ]
    is_right = (excess < 0.4).tolist()
    config = calibrate_refusal(answers, is_right)
    assert config.slopes["rough"] < -1
    kept = [(risk_of(a.signals, config) or 0.0) <= config.max_risk for a in answers]
    blind = calibrate_refusal(answers, is_right, without=("rough",))
    assert "rough" not in blind.slopes
    blindly = [(risk_of(a.signals, blind) or 0.0) <= blind.max_risk for a in answers]
    assert sum(kept) > 2 * sum(blindly)
    # Whatever it weighs, it is never the reason; what is as usual is none either.
    signals = answer(rough=0.0, tilt=0.9).signals
    assert reason_of(signals, 0.9, config).startswith("the cloud's normals differ")
    alone = RefusalConfig(slopes={"rough": -1.0, "tilt": 1.0}, means={"tilt": math.log(0.01)})
    for given in (answer().signals, {"rough": 0.1}):
        assert reason_of(given, 0.9, alone).startswith("no single sign, but all of them together")
    with pytest.raises(InputError, match="a signal in without is 'tlit'"):
        calibrate_refusal(answers, is_right, without=("tlit",))


def test_wrong_answers_stay_below_the_settled_share_on_other_data() -> None:
    config = calibrate_refusal(*labelled_answers(4000, 0), max_wrong_share=0.02)
    answers, is_right = labelled_answers(4000, 1)
    risks = [risk_of(a.signals, config) or 0.0 for a in answers]
    kept = [ok for ok, risk in zip(is_right, risks, strict=True) if risk <= config.max_risk]
    assert 300 < len(kept) < 1600
    assert kept.count(False) / len(kept) < 0.03


def test_too_few_data_for_the_share_allow_no_mistake() -> None:
    answers = [answer(far=k / 20) for k in range(20)]
    config = calibrate_refusal(answers, [k < 12 for k in range(20)], max_wrong_share=0.01)
    risks = [risk_of(a.signals, config) or 0.0 for a in answers]
    kept = [k for k, risk in enumerate(risks) if risk <= config.max_risk]
    assert set(kept) <= set(range(13))
    assert len(kept) > 6


def test_answers_that_are_all_right_are_all_given() -> None:
    answers, _ = labelled_answers(200, 0)
    config = calibrate_refusal(answers, [True] * 200)
    assert all((risk_of(a.signals, config) or 0) <= config.max_risk for a in answers)


def test_a_signal_that_was_not_measured_counts_as_usual() -> None:
    config = RefusalConfig(slopes={"far": 1.0, "size": 2.0}, means={"size": math.log(0.06)})
    usual = risk_of({"far": 0.2, "size": 0.05}, config)
    assert risk_of({"far": 0.2}, config) == pytest.approx(usual)
    assert reason_of({"far": 0.2}, 0.9, config).startswith("20% of the points are nowhere near")
    with pytest.raises(InputError, match="the refusal weighs 'near', but the signals are misfit"):
        risk_of({"far": 0.2}, RefusalConfig(slopes={"near": 1.0}))


def test_few_negatives_are_answered_on_other_data() -> None:
    """Right answers and negatives overlap in ``size``; views alone say nothing about it."""

    def drawn(seed: int) -> tuple[list[PoseEstimate], list[PoseEstimate]]:
        generator = torch.Generator().manual_seed(seed)
        own, foreign = torch.rand(2, 1000, generator=generator)
        return ([answer(size=0.3 * float(v)) for v in own],
                [answer(size=0.2 + 0.3 * float(v)) for v in foreign])  # fmt: skip

    right, negatives = drawn(0)
    config = calibrate_refusal(right, [True] * 1000, 0.01, negatives)
    right, negatives = drawn(1)

    def kept(answers: list[PoseEstimate]) -> int:
        return sum((risk_of(a.signals, config) or 0.0) <= config.max_risk for a in answers)

    assert kept(negatives) <= 25
    assert 600 < kept(right) < 750
    # What was refused anyhow counts as a negative too: more of the others may be answered.
    refused = PoseEstimate(name="a", object="b", status="doubtful", reason="so")
    more = calibrate_refusal(right, [True] * 1000, 0.01, [*negatives, *[refused] * 9000])
    assert more.max_risk > config.max_risk
    # So few allow no mistake.
    few = calibrate_refusal(right[:50], [True] * 50, 0.01, negatives[:50])
    assert all((risk_of(a.signals, few) or 0.0) > few.max_risk for a in negatives[:50])


def test_what_cannot_be_calibrated_is_an_error() -> None:
    with pytest.raises(InputError, match="2 estimates, 1 verdicts; give as many"):
        calibrate_refusal([answer()] * 2, [True])
    with pytest.raises(InputError, match=r"max_negative_share is 0.0, but a share is between"):
        calibrate_refusal([answer()], [True], 0.01, [answer()], 0.0)
    refused = PoseEstimate(name="a", object="b", status="doubtful", reason="so")
    with pytest.raises(InputError, match="not one estimate is an answer"):
        calibrate_refusal([refused], [False])


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"max_risk": 1.5}, "max_risk is 1.5, but a risk lies between 0 and 1"),
        ({"min_hold": -0.1}, "min_hold is -0.1, but it is a share"),
    ],
)
def test_settings_beyond_their_range_are_refused(values: dict, text: str) -> None:
    with pytest.raises(InputError, match=text):
        RefusalConfig(**values)
    with pytest.raises(InputError, match="batch_voxels 0; take 100 and 1 at least"):
        EstimateConfig(batch_voxels=0)
    with pytest.raises(InputError, match="starts is 8; take 1, the voted pose, to 7"):
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


def test_risk_and_coverage_of_a_toy() -> None:
    risks = torch.tensor([0.3, 0.1, 0.1, torch.inf, 0.9])
    is_right = torch.tensor([True, True, False, False, False])
    coverage, wrong = risk_coverage(risks, is_right)
    assert coverage.tolist() == pytest.approx([0.4, 0.6, 0.8])
    assert wrong.tolist() == pytest.approx([1 / 2, 1 / 3, 2 / 4])


def test_slopes_of_candidates_are_those_that_made_the_cases() -> None:
    """Right candidates are drawn by shares of known slopes; the fit finds these again."""
    generator = torch.Generator().manual_seed(0)
    names = list(RefusalConfig().candidate_slopes)
    true = dict(zip(names, (2.0, 0.0, 1.0, 0.5, 0.0, 3.0), strict=True))
    cases = []
    for _ in range(1500):
        rows = torch.rand(3, len(names), generator=generator).square()
        some = [dict(zip(names, row, strict=True)) for row in rows.tolist()]
        right = int(torch.multinomial(share_out(some, true), 1, generator=generator))
        cases.append((some, right))
    found = fit_candidate_slopes(cases)
    assert all(abs(found[name] - true[name]) < 0.35 for name in names)
    with pytest.raises(InputError, match="no view has several poses that fit"):
        fit_candidate_slopes([])


def test_the_reason_gives_the_risk_that_the_estimate_has() -> None:
    """What takes long is not measured where the rest refuses already; its usual value stands in."""
    part = bracket()
    config = RefusalConfig(
        max_risk=0.01,
        bias=9.0,
        slopes={"disagree": 1.0, "size": 1.0},
        means={"disagree": -3.0, "size": -2.0},
    )
    net = Oracle(tiny_weights(part, refusal=config), [pose_at()], noise=0.3)
    found = net.estimate(cloud=cloud_of(part, pose_at()))
    assert found.status == "doubtful"
    assert found.risk is not None
    assert f"the risk of a wrong pose is {found.risk:.2g}" in found.reason
