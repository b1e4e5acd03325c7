"""Fit the coefficients of ``pose/verify/probability.py`` by exact masks, beside those there.

    python bench/fit_probability.py [--samples SAMPLES] [--views 20]

The fit is to all poses that compete for a view, each with its evidence and with whether it is right
(the true pose up to a near-symmetry). Views: the ten parts of ``twenty_parts.py`` that take part in
choices, by four simulated sensors; with SAMPLES also the real instances of ``real_poses.py``. The
share of the area that contradicts a pose, or is not observed, is taken to be gamma distributed from
view to view, so that counts of patches are negative binomial; mean and shape are fitted by maximum
likelihood.

Printed are the coefficients and their range in fits that leave out one group (a part, or the real
instances); then how well the probability of the best pose predicts whether it is right: the mean
log loss, and how many of the poses with a probability of 0.9 and more are right. Each group is
judged by the file and by the fit without it, the ten parts that are held back from choices by the
file and by the fit to all others.
"""

import math
import multiprocessing
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
from scipy.optimize import minimize
from score_instances import EXACT, arguments_of, cases, registration_of
from score_parts import model_of
from shared import make_parser
from twenty_parts import PARTS, K, views

from depthpose import Registration
from depthpose.core.rigid import Rigid
from depthpose.pose.types import Evidence
from depthpose.pose.verify import hypotheses, probability
from depthpose.pose.verify.hypotheses import Hypothesis
from depthpose.pose.verify.probability import LEAST_AGREEMENT, LEAST_AREA, GammaShare
from depthpose.report.page import format_markdown_table

REAL = "real instances"
SURE = 0.9  # least probability of a sure pose
Row = dict[str, Any]


@dataclass(frozen=True)
class Coefficients:
    """The coefficients that are fitted, as ``pose/verify/probability.py`` has them."""

    right_contradicted: GammaShare = probability.RIGHT_CONTRADICTED
    wrong_contradicted: GammaShare = probability.WRONG_CONTRADICTED
    right_unobserved: GammaShare = probability.RIGHT_UNOBSERVED
    wrong_unobserved: GammaShare = probability.WRONG_UNOBSERVED
    wrong_rms: float = probability.WRONG_RMS
    prior_expected: float = probability.PRIOR_EXPECTED


@dataclass(frozen=True)
class View:
    """The poses that competed for a view: their evidence, and which of them are right."""

    group: str
    evidences: tuple[Evidence, ...]
    is_right: tuple[bool, ...]


def main() -> None:
    """Collect, fit, leave out in turn, and print."""
    parser = make_parser(__doc__)
    parser.add_argument("--samples", type=Path, help="folder with pose/: real instances as well")
    parser.add_argument("--views", type=int, default=20, help="of each part")
    parser.add_argument("--processes", type=int, default=2)
    options = parser.parse_args()

    jobs: list[Callable[[], list[View]]] = []
    jobs += [partial(part_views, name, options.views) for name in PARTS]
    if options.samples is not None:
        jobs.append(partial(real_views, options.samples))
    with multiprocessing.get_context("spawn").Pool(
        options.processes, initializer=torch.set_num_threads, initargs=(1,)
    ) as pool:
        collected = [view for job_views in pool.imap(call, jobs) for view in job_views]
    held_out = [view for view in collected if is_held_out(view)]
    choice = [view for view in collected if not is_held_out(view)]

    fitted = fit(choice)
    groups = dict.fromkeys(view.group for view in choice)
    fitted_without = {
        group: fit([view for view in choice if view.group != group]) for group in groups
    }
    print(format_markdown_table(coefficient_rows(fitted, list(fitted_without.values()))))

    left_out = [(view, fitted_without[view.group]) for view in choice]
    prediction_rows = [
        prediction_row("choice, file", [(view, Coefficients()) for view in choice]),
        prediction_row("choice, each group by the others", left_out),
        prediction_row("held back, file", [(view, Coefficients()) for view in held_out]),
        prediction_row("held back, fit", [(view, fitted) for view in held_out]),
    ]
    print(format_markdown_table(prediction_rows))


def coefficient_rows(fitted: Coefficients, without_a_group: Sequence[Coefficients]) -> list[Row]:
    """List the coefficients of the file and of the fit, and their range without a group."""
    rows: list[Row] = []
    for name in vars(fitted):
        values = [getattr(coefficients, name) for coefficients in without_a_group]
        values.sort(key=mean_of_share)
        least = format_coefficient(values[0])
        most = format_coefficient(values[-1])
        rows.append(
            {
                "coefficient": name,
                "file": format_coefficient(getattr(Coefficients(), name)),
                "fit": format_coefficient(getattr(fitted, name)),
                "without a group": f"{least} to {most}",
            }
        )
    return rows


def is_held_out(view: View) -> bool:
    """Whether a view is of a part that takes part in no choice."""
    return view.group in PARTS and PARTS[view.group].is_held


def call(job: Callable[[], list[View]]) -> list[View]:
    """Run a job in a process of its own."""
    return job()


def part_views(name: str, number: int) -> list[View]:
    """Collect the views of one part."""
    part = PARTS[name]
    registration = Registration.load(part.as_trimesh(), unit="mm")
    model = model_of(part, is_twin=False)
    seed = 2 * list(PARTS).index(name)
    collected = []
    for view in views(model, number, seed):
        arguments = {"depth": view.depth_m, "mask": view.mask, "camera": K}
        collected.append(view_of(name, registration, arguments, view.truth))
    return collected


def real_views(samples: Path) -> list[View]:
    """Collect the real instances."""
    collected = []
    for name, case in cases(samples).items():
        truth = case.sample.truth.camera_from_model
        registration = registration_of(samples, name)
        collected.append(view_of(REAL, registration, arguments_of(case, EXACT), truth))
    return collected


def view_of(group: str, registration: Registration, arguments: Any, truth: Rigid) -> View:  # noqa: ANN401
    """Estimate a view, and collect the poses that compete, before their copies are added."""
    competing: list[Hypothesis] = []
    share_among_poses = hypotheses.share_among_poses

    def remember(poses: Sequence[Hypothesis], *, is_masked: bool) -> torch.Tensor:
        competing[:] = poses
        return share_among_poses(poses, is_masked=is_masked)

    with patch.object(hypotheses, "share_among_poses", remember):
        registration.estimate(**arguments)
    copies = registration._find_object(registration.objects[0]).prepare().copies
    symmetries = Rigid.cat([copies.symmetries, copies.near_copies])
    true_pose = truth.double()[None]
    is_right = [
        bool(copies.is_same(hypothesis.pose, true_pose, symmetries).any())
        for hypothesis in competing
    ]
    evidences = [hypothesis.evidence for hypothesis in competing]
    return View(group, tuple(evidences), tuple(is_right))


def fit(collected: Sequence[View]) -> Coefficients:
    """Fit all coefficients to some views."""
    right: list[Evidence] = []
    wrong: list[Evidence] = []
    for view in collected:
        for evidence, is_right in zip(view.evidences, view.is_right, strict=True):
            (right if is_right else wrong).append(evidence)
    views_with_right = sum(any(view.is_right) for view in collected)
    # The root mean square whose log likelihood is the mean of those of wrong poses.
    mean_log = sum(math.log(1 + evidence.rms**2) for evidence in wrong) / len(wrong)
    return Coefficients(
        right_contradicted=fit_share(list(map(contradicted, right))),
        wrong_contradicted=fit_share(list(map(contradicted, wrong))),
        right_unobserved=fit_share(list(map(unobserved, right))),
        wrong_unobserved=fit_share(list(map(unobserved, wrong))),
        wrong_rms=math.sqrt(math.exp(mean_log) - 1),
        prior_expected=views_with_right / max(1, len(collected) - views_with_right),
    )


def contradicted(evidence: Evidence) -> tuple[float, float]:
    """Return the contradicting patches, and the area in which they may lie."""
    area = max(LEAST_AREA, evidence.visible)
    return evidence.contradicted, max(LEAST_AREA, area - evidence.unobserved)


def unobserved(evidence: Evidence) -> tuple[float, float]:
    """Return the patches that are not observed, and the area in which they may lie."""
    area = max(LEAST_AREA, evidence.visible)
    return evidence.unobserved, max(LEAST_AREA, area - evidence.seen_through - evidence.bulging)


def fit_share(counts: Sequence[tuple[float, float]]) -> GammaShare:
    """Fit mean and shape to counts in areas, by maximum likelihood."""

    def loss(logs: Any) -> float:  # noqa: ANN401
        share = GammaShare(mean=math.exp(logs[0]), shape=math.exp(logs[1]))
        return -sum(share.log_likelihood(count, area) for count, area in counts)

    bounds = [(math.log(1e-3), math.log(5.0)), (math.log(0.05), math.log(20.0))]
    best = minimize(loss, [math.log(0.2), 0.0], method="L-BFGS-B", bounds=bounds)
    return GammaShare(mean=math.exp(best.x[0]), shape=math.exp(best.x[1]))


def judge(view: View, coefficients: Coefficients) -> tuple[float, bool]:
    """Return the probability of the best pose, and whether it is right."""
    names = {
        "RIGHT_CONTRADICTED": coefficients.right_contradicted,
        "WRONG_CONTRADICTED": coefficients.wrong_contradicted,
        "RIGHT_UNOBSERVED": coefficients.right_unobserved,
        "WRONG_UNOBSERVED": coefficients.wrong_unobserved,
        "WRONG_RMS": coefficients.wrong_rms,
    }
    with patch.multiple(probability, **names):
        log_ratios = [probability.log_likelihood_ratio(evidence) for evidence in view.evidences]
    best = max(range(len(log_ratios)), key=log_ratios.__getitem__)
    shares = torch.tensor(log_ratios, dtype=torch.float64).softmax(0)
    log_odds = math.log(coefficients.prior_expected) + log_ratios[best]
    log_odds = max(-50.0, min(log_odds, 50.0))
    probability_of_object = 1 / (1 + math.exp(-log_odds))
    if view.evidences[best].agreement < LEAST_AGREEMENT:
        probability_of_object = 0.0
    return probability_of_object * float(shares[best]), view.is_right[best]


def prediction_row(title: str, judged: Sequence[tuple[View, Coefficients]]) -> Row:
    """Measure how well the probabilities of best poses predict whether they are right."""
    pairs = [judge(view, coefficients) for view, coefficients in judged if view.evidences]
    losses = [-math.log(max(p if is_right else 1 - p, 1e-4)) for p, is_right in pairs]
    sure = [is_right for p, is_right in pairs if p >= SURE]
    return {
        "views": title,
        "number": len(pairs),
        "right": sum(is_right for _, is_right in pairs),
        "log loss": f"{sum(losses) / len(losses):.3f}",
        "sure": len(sure),
        "sure and right": sum(sure),
    }


def mean_of_share(value: GammaShare | float) -> float:
    """Return the mean of a share, or the number itself, to sort by."""
    return value.mean if isinstance(value, GammaShare) else value


def format_coefficient(value: GammaShare | float) -> str:
    """Format a coefficient."""
    if isinstance(value, GammaShare):
        return f"{value.mean:.3f}, {value.shape:.2f}"
    return f"{value:.2f}"


if __name__ == "__main__":
    main()
