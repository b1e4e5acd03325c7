"""Time and error of voting, in the manner of table 3.3: RANSAC one by one, ours, least squares.

python bench/voting_speed.py [--points 500 1000 2000 5000] [--hypotheses 50 128 1024] [--noise 0.05]

The peer tests one hypothesis at a time in NumPy, vectorised over the points, like published code;
it draws its pairs, tests and refits as ours does without refinement. Votes err by ``noise``
[rad, each way] and a fifth of them are random. Each time is the least of many runs, in
processor time of the one thread used, so that other work on the machine counts little; all rows
come from one process.
"""

import argparse
import time
from collections.abc import Callable

import numpy as np
import torch
from shared import report

from depthpose.pose.config import VotingConfig
from depthpose.pose.propose import meet_lines, vote_ransac
from depthpose.thesis.pose_tables import ransac_one_by_one

KEYPOINTS = 8
WRONG_SHARE = 0.2


def exact_votes(points: int, noise: float, seed: int) -> tuple[torch.Tensor, ...]:
    """The visible half of a ball of 5 cm, eight keypoints in and about it, noisy directions."""
    generator = torch.Generator().manual_seed(seed)
    x = torch.nn.functional.normalize(torch.randn(points, 3, generator=generator), dim=-1) * 0.05
    x[:, 2] = -x[:, 2].abs() + 0.8
    keypoints = torch.nn.functional.normalize(torch.randn(8, 3, generator=generator), dim=-1) * 0.06
    keypoints[:, 2] += 0.8
    n = torch.nn.functional.normalize(keypoints - x[:, None], dim=-1)
    n = torch.nn.functional.normalize(n + noise * torch.randn(n.shape, generator=generator), dim=-1)
    wrong = torch.nn.functional.normalize(torch.randn(n.shape, generator=generator), dim=-1)
    is_wrong = torch.rand(points, generator=generator) < WRONG_SHARE
    return x, torch.where(is_wrong[:, None, None], wrong, n), keypoints


def least_seconds(run: Callable[[], object], budget_s: float = 1.5, most: int = 200) -> float:
    """Least processor time of one call, over as many as fit the budget."""
    run()
    least, start = float("inf"), time.perf_counter()
    for _ in range(most):
        began = time.thread_time()
        run()
        least = min(least, time.thread_time() - began)
        if time.perf_counter() - start > budget_s:
            break
    return least


def measure(points: int, hypotheses: list[int], noise: float) -> list[dict[str, object]]:
    """Measure all ways for one number of points; errors are means over ten clouds."""
    clouds = [exact_votes(points, noise, seed) for seed in range(10)]
    x, n, _ = clouds[0]
    x_numpy, n_numpy = x.double().numpy(), n.double().numpy()
    ways: list[tuple[str, int, Callable[..., np.ndarray], Callable[[], object]]] = []
    for h in hypotheses:
        plain = VotingConfig(hypotheses=h, refinements=0)
        config = VotingConfig(hypotheses=h)
        cosine = config.min_cosine
        ways += [
            ("RANSAC one by one (NumPy)", h,
             lambda a, b, h=h, c=cosine: ransac_one_by_one(a.double().numpy(), b.double().numpy(),
                                                           h, c, 0),
             lambda h=h, c=cosine: ransac_one_by_one(x_numpy, n_numpy, h, c, 0)),
            ("RANSAC, published refit", h,
             lambda a, b, c=plain: vote_ransac(a, b, None, c).keypoints_m.numpy(),
             lambda c=plain: vote_ransac(x, n, None, c)),
            ("RANSAC", h, lambda a, b, c=config: vote_ransac(a, b, None, c).keypoints_m.numpy(),
             lambda c=config: vote_ransac(x, n, None, c)),
        ]  # fmt: skip
    ways += [
        ("least squares, published", 0, lambda a, b: meet_lines(a, b, None, 0).keypoints_m.numpy(),
         lambda: meet_lines(x, n, None, 0)),
        ("least squares", 0, lambda a, b: meet_lines(a, b).keypoints_m.numpy(),
         lambda: meet_lines(x, n)),
    ]  # fmt: skip
    rows = []
    peer_s: dict[int, float] = {}
    for name, h, answer, run in ways:
        seconds = least_seconds(run)
        if "NumPy" in name:
            peer_s[h] = seconds
        errors = [np.linalg.norm(answer(a, b) - k.numpy(), axis=-1).mean() for a, b, k in clouds]
        rows.append({
            "points": points, "method": name, "hypotheses": h or None,
            "milliseconds": round(1000 * seconds, 3),
            "times_faster": round(peer_s[h] / seconds, 1) if h else None,
            "error_mm": round(1000 * float(np.mean(errors)), 3),
        })  # fmt: skip
    return rows


def main() -> None:
    """Measure and write ``out/bench/voting_speed.json``."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--points", type=int, nargs="+", default=[500, 1000, 2000, 5000])
    parser.add_argument("--hypotheses", type=int, nargs="+", default=[50, 128, 1024])
    parser.add_argument("--noise", type=float, default=0.05)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    rows = [
        row
        for points in arguments.points
        for row in measure(points, arguments.hypotheses, arguments.noise)
    ]
    report("voting_speed", rows)


if __name__ == "__main__":
    main()
