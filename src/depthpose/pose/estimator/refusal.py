"""From signals to one risk, and the risk beyond which an answer is withheld: chosen on data."""

import math
from collections.abc import Mapping, Sequence

import numpy as np
from scipy.optimize import minimize

from depthpose.core.errors import InputError, refuse_unknown
from depthpose.pose.config import RefusalConfig
from depthpose.pose.estimator.evidence import CONTEXT, SIGNALS, log_signal
from depthpose.pose.types import PoseEstimate

_FOLDS = 5
_RIDGE = 3.0
"""Of the slopes in units of each signal's spread: no signal decides alone."""
_CANDIDATE_RIDGE = 3.0
_LEARNT = tuple(name for name in SIGNALS if name != "gap")
"""How far points lie off the surface is the sensor's noise as much as the pose's error. On
synthetic views it separates right from wrong best of all; a real sensor that is noisier than the
simulated one would have its right answers refused by it, as LineMOD's cat was."""


def risk_of(signals: Mapping[str, float], config: RefusalConfig) -> float | None:
    """Chance of being wrong, ``1 / (1 + exp(-odds))``; None where no slope is.

    The odds are ``bias + sum slope log(0.01 + signal)``: twice as much of a bad sign counts as much
    from 1 % to 2 % as from 20 % to 40 %. A signal that was not measured counts as is usual for
    right answers.

    Raises:
        InputError: a slope is of a signal that there is not.
    """
    if not config.slopes:
        return None
    unknown = sorted(config.slopes.keys() - SIGNALS.keys())
    if unknown:
        raise InputError(
            f"the refusal weighs {unknown[0]!r}, but the signals are {', '.join(SIGNALS)}; the "
            "weights are of another version: calibrate them again by 'depthpose pose calibrate'"
        )
    logs = {name: log_signal(value) for name, value in signals.items()}
    odds = config.bias + sum(
        k * logs.get(name, _usual(name, config)) for name, k in config.slopes.items()
    )
    return 1 / (1 + math.exp(-max(-700.0, min(700.0, odds))))


def _usual(name: str, config: RefusalConfig) -> float:
    return config.means.get(name, log_signal(0.0))


def reason_of(signals: Mapping[str, float], risk: float, config: RefusalConfig) -> str:
    """Say in a sentence what makes an answer doubtful most, by how far it is above the usual."""

    def excess(name: str) -> float:
        return config.slopes[name] * (log_signal(signals[name]) - _usual(name, config))

    named = [
        name
        for name, slope in config.slopes.items()
        if slope > 0 and name in signals and name not in CONTEXT
    ]
    worst = max(named, key=excess, default=None)
    what = "no single sign, but all of them together are evidence against it"
    if worst is not None and excess(worst) > 0:
        what = SIGNALS[worst].format(signals[worst])
    return (
        f"{what}: the risk of a wrong pose is {risk:.2g}, above the {config.max_risk:.2g} that was "
        "settled"
    )


def calibrate_refusal(
    estimates: Sequence[PoseEstimate],
    is_right: Sequence[bool],
    max_wrong_share: float = 0.01,
    negatives: Sequence[PoseEstimate] = (),
    max_negative_share: float = 0.01,
    without: Sequence[str] = (),
) -> RefusalConfig:
    """Learn the risk from estimates whose truth is known, and choose its limit.

    The risk is a logistic regression on the logarithms of the signals but ``gap``; no slope is
    negative (more of a bad sign is never better) but that of ``rough``, which says how much tilted
    normals mean, and a ridge keeps them small. The limit is chosen by risks that each fifth of the
    data got from the other four: the largest at which ``(wrong + 1) / (answered + 1)`` is still
    ``max_wrong_share`` at most; where the data are too few for that, the largest at which nothing
    is wrong. Negatives, clouds of something else, count as wrong where the risk is learnt; of them
    the limit lets at most ``max_negative_share`` be answered, by the same rule. The risk is then
    that of as many negatives among the objects.

    Args:
        estimates: computed with ``RefusalConfig(max_risk=1.0)``, so that nothing was withheld for
            its risk; on views that training has not seen, the hard ones too.
        is_right: whether each is right; what was refused anyhow does not count.
        max_wrong_share: of the answers that are given.
        negatives: estimates, computed as those, for clouds that do not show the requested object.
        max_negative_share: of all negatives, also of those that were refused anyhow.
        without: signals that do not count, because real clouds contradict what synthetic ones say.

    Raises:
        InputError: numbers that differ, a share that is none, a signal that there is not, or no
            answer at all.
    """
    _refuse_settings(max_wrong_share, max_negative_share, without)
    given, verdicts = len(estimates), len(is_right)
    if given != verdicts:
        raise InputError(f"calibrate_refusal: {given} estimates, {verdicts} verdicts; give as many")
    answered = [(e, ok) for e, ok in zip(estimates, is_right, strict=True) if e.is_ok]
    if not answered:
        raise InputError(
            "calibrate_refusal: not one estimate is an answer; train longer, or show easier views"
        )
    foreign = [e for e in negatives if e.is_ok]
    every = [e for e, _ in answered] + foreign
    names = [
        name for name in _LEARNT if name not in without and all(name in e.signals for e in every)
    ]
    x = np.array([[log_signal(e.signals[name]) for name in names] for e in every])
    wrong = np.array([not ok for _, ok in answered] + [True] * len(foreign), dtype=float)
    risks, own = _risks_by_others(x, wrong, names), len(answered)
    bias, slopes = _fit(x, wrong, names)
    limits = [_choose_limit(risks[:own], wrong[:own], max_wrong_share)]
    if foreign:
        limits.append(_negative_limit(risks[own:], len(negatives), max_negative_share))
    return RefusalConfig(
        max_risk=min(limits),
        bias=float(bias),
        slopes=dict(zip(names, slopes.tolist(), strict=True)),
        means=_means(x[wrong == 0], names),
    )


def fit_candidate_slopes(
    cases: Sequence[tuple[Sequence[Mapping[str, float]], int]],
    ridge: float = _CANDIDATE_RIDGE,
) -> dict[str, float]:
    """Learn how to share the probability of one among poses that fit, from cases of known truth.

    A conditional logit (McFadden 1974) on the logarithms of the signals; no slope is negative.

    Args:
        cases: the signals of all candidates of a view, and the number of the right one.
        ridge: of the slopes; it keeps shares nearer to each other than synthetic views give, as
            real sensors err alike from pixel to pixel.

    Raises:
        InputError: there is no case.
    """
    if not cases:
        raise InputError("fit_candidate_slopes: no view has several poses that fit; give more")
    names = list(RefusalConfig().candidate_slopes)
    x = [np.array([[log_signal(one[n]) for n in names] for one in some]) for some, _ in cases]

    def loss(slopes: np.ndarray) -> tuple[float, np.ndarray]:
        value, pull = 0.5 * ridge * float(slopes @ slopes), ridge * slopes
        for signals, (_, right) in zip(x, cases, strict=True):
            odds = -signals @ slopes
            log_share = odds - np.logaddexp.reduce(odds)
            value -= float(log_share[right])
            pull = pull + signals[right] - np.exp(log_share) @ signals
        return float(value), pull

    start = np.ones(len(names))
    found = minimize(loss, start, jac=True, bounds=[(0.0, None)] * len(names), method="L-BFGS-B")
    return dict(zip(names, found.x.tolist(), strict=True))


def _refuse_settings(
    max_wrong_share: float, max_negative_share: float, without: Sequence[str]
) -> None:
    for name in without:
        refuse_unknown("calibrate_refusal: a signal in without", name, SIGNALS)
    shares = {"max_wrong_share": max_wrong_share, "max_negative_share": max_negative_share}
    for name, share in shares.items():
        if not 0 < share < 1:
            raise InputError(
                f"calibrate_refusal: {name} is {share}, but a share is between 0 and 1; take 0.01"
            )


def _risks_by_others(x: np.ndarray, wrong: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """Give each row the risk fitted on the other four fifths."""
    # Views go round the objects: in order, a fold would be an object.
    fold = np.random.default_rng(0).permutation(len(x)) % _FOLDS
    risks = np.empty(len(x))
    for k in range(_FOLDS):
        bias, slopes = _fit(x[fold != k], wrong[fold != k], names)
        risks[fold == k] = _sigmoid(bias + x[fold == k] @ slopes)
    return risks


def _fit(x: np.ndarray, wrong: np.ndarray, names: Sequence[str]) -> tuple[float, np.ndarray]:
    """Fit bias and slopes by penalised likelihood; only what is context may have a negative one."""
    if len(x) == 0:
        return 0.0, np.zeros(x.shape[1])
    middle, spread = x.mean(0), np.maximum(x.std(0), 1e-3)
    z = (x - middle) / spread

    def loss(theta: np.ndarray) -> tuple[float, np.ndarray]:
        odds = theta[0] + z @ theta[1:]
        value = np.logaddexp(0, odds).sum() - wrong @ odds
        value += 0.5 * _RIDGE * (theta[1:] @ theta[1:])
        pull = _sigmoid(odds) - wrong
        return value, np.concatenate([[pull.sum()], z.T @ pull + _RIDGE * theta[1:]])

    # A bias beyond e^-12 would need more answers than anybody calibrates with.
    bounds = [(-12.0, 12.0), *((None if name in CONTEXT else 0.0, None) for name in names)]
    found = minimize(loss, np.zeros(1 + z.shape[1]), jac=True, bounds=bounds, method="L-BFGS-B")
    slopes = found.x[1:] / spread
    return float(found.x[0] - middle @ slopes), slopes


def _means(x: np.ndarray, names: Sequence[str]) -> dict[str, float]:
    return dict(zip(names, x.mean(0).tolist(), strict=True)) if len(x) else {}


def _negative_limit(risks: np.ndarray, total: int, share: float) -> float:
    """Choose the largest risk at which ``(answered + 1) / (total + 1)`` negatives are few enough.

    Where there are too few negatives for that, none is answered.
    """
    allowed = max(0, math.floor(share * (total + 1)) - 1)
    order = np.sort(risks)
    if allowed >= len(order):
        return 1.0
    before = float(order[allowed - 1]) if allowed else 0.0
    return (before + float(order[allowed])) / 2


def _choose_limit(risks: np.ndarray, wrong: np.ndarray, share: float) -> float:
    order = np.argsort(risks, kind="stable")
    mistakes = np.cumsum(wrong[order])
    bound = (mistakes + 1) / (np.arange(len(order)) + 2)
    good = np.flatnonzero(bound <= share)
    if len(good) == 0:
        good = np.flatnonzero(mistakes == 0)
    if len(good) == 0:
        return 0.0
    last = int(good[-1])
    # Halfway to the next one, which is refused; where all are good, as far beyond as below 1.
    after = 1.0 if last + 1 == len(order) else float(risks[order[last + 1]])
    return (float(risks[order[last]]) + after) / 2


def _sigmoid(odds: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-np.clip(odds, -700, 700)))
