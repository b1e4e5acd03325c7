"""Probabilities of several poses that fit: slopes from synthetic views, and their calibration.

    python bench/pose_candidates.py --weights linemod.safetensors bunny.safetensors parts ycb

Synthetic views of all objects, three in ten unoccluded, the others occluded by up to a half. Every
candidate is compared with the truth by ADD; copies count as right if a declared symmetry, or
a detected one that is exact to 1 % of the diameter, allows it. Cases are views with several
candidates one of which is right below 10 % of the diameter. Slopes are fitted on four fifths and
evaluated on the other, five times; those of all cases are printed last.
"""

import argparse
import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from scipy.optimize import minimize

from depthpose.core.checkpoint import find_weights
from depthpose.core.rigid import Rigid
from depthpose.pose.config import ObjectsConfig, RefusalConfig
from depthpose.pose.estimator import GeoPoseNet
from depthpose.pose.estimator.candidates import PoseAmbiguities, find_copies
from depthpose.pose.estimator.fit import FLOOR, share_out
from depthpose.pose.synthetic import Objects
from depthpose.pose.types import PoseEstimate
from depthpose.pose.weights import read_pose_weights
from depthpose.report.page import markdown_table

SEED = 0xCA5E
BANDS = ((0.0, 0.5), (0.5, 0.8), (0.8, 0.9), (0.9, 0.99), (0.99, 1.01))
Case = tuple[list[dict[str, float]], int]
RIDGE = 3.0


def add_of(pose: Rigid, truth: Rigid, copies: PoseAmbiguities) -> float:
    """ADD in diameters to the nearest true copy."""
    double = truth.double() @ copies.same
    there_m = pose.double().apply(copies.points_m)
    gap_m = there_m - double.apply(copies.points_m.expand(len(double.R), -1, -1))
    return float(gap_m.norm(dim=-1).mean(-1).min()) / copies.diameter_m


def case_of(found: PoseEstimate, truth: Rigid, copies: PoseAmbiguities) -> Case | None:
    """Give the signals of all candidates and the index of the right one, if there is one."""
    if found.camera_from_model is None or not found.alternatives:
        return None
    poses = [found.camera_from_model, *(a.camera_from_model for a in found.alternatives)]
    errors = [add_of(pose, truth, copies) for pose in poses]
    right = min(range(len(errors)), key=errors.__getitem__)
    signals = [found.signals, *(a.signals for a in found.alternatives)]
    return (signals, right) if errors[right] < 0.1 else None


def cases_of(name: str, number: int) -> tuple[list[Case], int]:
    """Pose synthetic views of the objects of weights, with all candidates, nothing refused."""
    weights = read_pose_weights(find_weights(name))
    even = dict.fromkeys(RefusalConfig().candidate_slopes, 0.0)
    opened = RefusalConfig(min_agreement=0.0, max_beyond=1.0, min_found=0.0, candidate_slopes=even)
    net = GeoPoseNet(dataclasses.replace(weights, refusal=opened))
    config = ObjectsConfig(
        number=number * len(weights.models), seed=SEED, views=None, resolution=(1.0, 1.0),
        occluded_share=0.7, occlusion=(0.0, 0.5),
    )  # fmt: skip
    views = Objects(weights.models, config, weights.cloud)
    copies = [find_copies(model, up_to_symmetry=False) for model in weights.models]
    found: list[Case | None] = []
    for k in range(len(views)):
        view = views[k]
        estimate = net.estimate_many([view.input])[0]
        truth = view.truth.camera_from_model
        found.append(case_of(estimate, truth, copies[k % len(weights.models)]))
    return [case for case in found if case is not None], len(views)


def fit_candidate_slopes(
    cases: Sequence[tuple[Sequence[Mapping[str, float]], int]],
    ridge: float = RIDGE,
) -> dict[str, float]:
    """Learn how to share the probability of one among poses that fit, from cases of known truth.

    A conditional logit (McFadden 1974) on the logarithms of the signals; no slope is negative.

    Args:
        cases: the signals of all candidates of a view, and the number of the right one.
        ridge: of the slopes; it keeps shares nearer to each other than synthetic views give, as
            real sensors err alike from pixel to pixel.
    """
    names = list(RefusalConfig().candidate_slopes)
    x = [np.array([[np.log(FLOOR + one[n]) for n in names] for one in some]) for some, _ in cases]

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


def measure(cases: Sequence[Case]) -> list[tuple[float, bool]]:
    """Give each case's largest share and whether its candidate is right, cross-validated."""
    pairs: list[tuple[float, bool]] = []
    for fold in range(5):
        slopes = fit_candidate_slopes([c for k, c in enumerate(cases) if k % 5 != fold])
        for signals, right in cases[fold::5]:
            shares = share_out(signals, slopes)
            pairs.append((float(shares.max()), int(shares.argmax()) == right))
    return pairs


def main() -> None:
    """Print the calibration of the shares, and the slopes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--weights", nargs="+", default=["parts", "ycb"])
    parser.add_argument("--number", type=int, default=12, help="views of each object")
    words = parser.parse_args()
    torch.set_num_threads(1)
    every: list[Case] = []
    for name in words.weights:
        cases, views = cases_of(name, words.number)
        every += cases
        first = sum(right == 0 for _, right in cases)
        print(f"{name}: {views} views, {len(cases)} cases, ICP's best right in {first}")
    pairs = measure(every)
    rows = []
    for low, high in BANDS:
        some = [ok for share, ok in pairs if low <= share < high]
        said = [share for share, _ in pairs if low <= share < high]
        rows.append({
            "largest share": f"{low:g} to {min(high, 1):g}", "cases": len(some),
            "mean share": sum(said) / len(said) if said else None,
            "right": sum(some) / len(some) if some else None,
        })  # fmt: skip
    print(markdown_table(rows))
    print({name: round(value, 2) for name, value in fit_candidate_slopes(every).items()})


if __name__ == "__main__":
    main()
