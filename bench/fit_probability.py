"""Fit the coefficients of a judgement by exact masks, beside those of ``pose/probability.py``.

    python bench/fit_probability.py [--samples SAMPLES] [--views 20]

Every pose that competes for a view is collected with its evidence, and called right if it is the
true one up to a near-symmetry. Views: the ten parts of ``twenty_parts.py`` that take part in
choices, by four simulated sensors; with SAMPLES also the real instances of ``real_poses.py``. The
shares of the area that contradict a pose, or are not observed, are gamma distributed from view to
view, so that counts of patches are negative binomial: mean and shape by maximum likelihood.

Each part, and the real instances, are left out in turn: the range of each coefficient, and how well
the probability of the best pose predicts whether it is right (mean log loss, and how many of those
that are given 0.9 and more are right) by the file and by fits without them. The ten parts that are
held back from choices are judged at the end, by the file and by the fit to all others.
"""

import argparse
import math
import multiprocessing
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
from real_poses import RealCase
from scipy.optimize import minimize
from score_instances import EXACT, arguments_of, cases, registration_of
from score_parts import model_of
from twenty_parts import PARTS, K, views

from depthpose import Registration
from depthpose.core.rigid import Rigid
from depthpose.pose import hypotheses, probability
from depthpose.pose.hypotheses import Hypothesis
from depthpose.pose.probability import LEAST_AGREEMENT, LEAST_AREA, GammaShare
from depthpose.pose.types import Evidence
from depthpose.report.page import markdown_table

REAL = "real instances"
SURE = 0.9


@dataclass(frozen=True)
class Coefficients:
    """What is fitted."""

    right_contradicted: GammaShare = probability.RIGHT_CONTRADICTED
    wrong_contradicted: GammaShare = probability.WRONG_CONTRADICTED
    right_unobserved: GammaShare = probability.RIGHT_UNOBSERVED
    wrong_unobserved: GammaShare = probability.WRONG_UNOBSERVED
    wrong_rms: float = probability.WRONG_RMS
    prior_masked: float = probability.PRIOR_MASKED


@dataclass(frozen=True)
class View:
    """The poses that competed for a view: their evidence, and which of them are right."""

    group: str
    evidences: tuple[Evidence, ...]
    is_right: tuple[bool, ...]


def main() -> None:
    """Collect, fit, leave out in turn, and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--samples", type=Path, help="folder with pose/: real instances as well")
    parser.add_argument("--views", type=int, default=20, help="of each part")
    parser.add_argument("--processes", type=int, default=2)
    options = parser.parse_args()

    jobs: list[Callable[[], list[View]]] = [partial(part_views, name, options.views)
                                            for name in PARTS]  # fmt: skip
    if options.samples is not None:
        jobs.append(partial(real_views, options.samples))
    with multiprocessing.get_context("spawn").Pool(
        options.processes, initializer=torch.set_num_threads, initargs=(1,)
    ) as pool:
        collected = [view for part in pool.imap(call, jobs) for view in part]
    held_out = [view for view in collected if is_held_out(view)]
    choice = [view for view in collected if not is_held_out(view)]

    # The coefficients, and their range when a group is left out.
    fitted = fit(choice)
    groups = list(dict.fromkeys(view.group for view in choice))
    fitted_without = {group: fit([v for v in choice if v.group != group]) for group in groups}
    rows: list[dict[str, Any]] = []
    for name in vars(fitted):
        values = sorted((getattr(other, name) for other in fitted_without.values()), key=mean_of)
        rows.append({
            "coefficient": name, "file": format_coefficient(getattr(Coefficients(), name)),
            "fit": format_coefficient(getattr(fitted, name)),
            "without a group":
                f"{format_coefficient(values[0])} to {format_coefficient(values[-1])}",
        })  # fmt: skip
    print(markdown_table(rows))

    # What they predict of views that took no part in the fit.
    left_out = [(view, fitted_without[view.group]) for view in choice]
    print(markdown_table([
        row("choice, file", [(view, Coefficients()) for view in choice]),
        row("choice, each group by the others", left_out),
        row("held back, file", [(view, Coefficients()) for view in held_out]),
        row("held back, fit", [(view, fitted) for view in held_out]),
    ]))  # fmt: skip


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
    return [
        view_of(name, registration, {"depth": v.depth_m, "mask": v.mask, "camera": K}, v.truth)
        for v in views(model, number, seed)
    ]


def real_views(samples: Path) -> list[View]:
    """Collect the real instances."""

    def view(name: str, case: RealCase) -> View:
        truth = case.sample.truth.camera_from_model
        return view_of(REAL, registration_of(samples, name), arguments_of(case, EXACT), truth)

    return [view(name, case) for name, case in cases(samples).items()]


def view_of(group: str, registration: Registration, arguments: Any, truth: Rigid) -> View:  # noqa: ANN401
    """Estimate a view, and collect the poses that compete before their copies do."""
    competing: list[Hypothesis] = []
    share = hypotheses.share_among_poses

    def remember(poses: Sequence[Hypothesis], *, is_masked: bool) -> torch.Tensor:
        competing[:] = poses
        return share(poses, is_masked=is_masked)

    with patch.object(hypotheses, "share_among_poses", remember):
        registration.estimate(**arguments)
    copies = registration._object(registration.objects[0]).prepare().copies
    alike = Rigid.cat([copies.symmetries, copies.near_copies])
    true_pose = truth.double()[None]
    is_right = [bool(copies.is_same(h.pose, true_pose, alike).any()) for h in competing]
    return View(group, tuple(h.evidence for h in competing), tuple(is_right))


def fit(collected: Sequence[View]) -> Coefficients:
    """Fit all coefficients to some views."""
    labelled = [
        pair for view in collected for pair in zip(view.evidences, view.is_right, strict=True)
    ]
    right = [evidence for evidence, is_right in labelled if is_right]
    wrong = [evidence for evidence, is_right in labelled if not is_right]
    has_right = sum(any(view.is_right) for view in collected)
    # The root mean square whose log likelihood is the mean of those of wrong poses.
    mean_log = sum(math.log(1 + e.rms**2) for e in wrong) / len(wrong)
    return Coefficients(
        right_contradicted=fit_share([contradicted(e) for e in right]),
        wrong_contradicted=fit_share([contradicted(e) for e in wrong]),
        right_unobserved=fit_share([unobserved(e) for e in right]),
        wrong_unobserved=fit_share([unobserved(e) for e in wrong]),
        wrong_rms=math.sqrt(math.exp(mean_log) - 1),
        prior_masked=has_right / max(1, len(collected) - has_right),
    )


def contradicted(evidence: Evidence) -> tuple[float, float]:
    """Give the contradicting patches, and the area in which they may lie."""
    area = max(LEAST_AREA, evidence.visible)
    return evidence.contradicted, max(LEAST_AREA, area - evidence.unobserved)


def unobserved(evidence: Evidence) -> tuple[float, float]:
    """Give the patches that are not observed, and the area in which they may lie."""
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
    """Give the probability of the best pose, and whether it is right."""
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
    log_odds = math.log(coefficients.prior_masked) + log_ratios[best]
    probable = 1 / (1 + math.exp(-max(-50.0, min(log_odds, 50.0))))
    if view.evidences[best].agreement < LEAST_AGREEMENT:
        probable = 0.0
    return probable * float(shares[best]), view.is_right[best]


def row(title: str, judged: Sequence[tuple[View, Coefficients]]) -> dict[str, Any]:
    """Say how well probabilities predict what is right."""
    pairs = [judge(view, coefficients) for view, coefficients in judged if view.evidences]
    losses = [-math.log(max(p if is_right else 1 - p, 1e-4)) for p, is_right in pairs]
    sure = [is_right for p, is_right in pairs if p >= SURE]
    return {
        "views": title, "number": len(pairs), "right": sum(is_right for _, is_right in pairs),
        "log loss": f"{sum(losses) / len(losses):.3f}", "sure": len(sure),
        "sure and right": sum(sure),
    }  # fmt: skip


def mean_of(value: GammaShare | float) -> float:
    """Give the mean of a share, or the number itself, to sort by."""
    return value.mean if isinstance(value, GammaShare) else value


def format_coefficient(value: GammaShare | float) -> str:
    """Format a coefficient."""
    if isinstance(value, GammaShare):
        return f"{value.mean:.3f}, {value.shape:.2f}"
    return f"{value:.2f}"


if __name__ == "__main__":
    main()
