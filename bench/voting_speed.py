"""Time and error of voting, as in table 3.3: RANSAC one by one, ours, least squares.

    python bench/voting_speed.py [--points 500 1000 2000 5000] [--hypotheses 50 128 1024]
        [--noise 0.05]

"One by one" tests one hypothesis at a time in NumPy, vectorised over the points, like published
code; it draws its pairs, tests and refits as ours does without refinement. Votes have normal errors
of ``noise`` [rad, each way], and a fifth of them are random. Each time is the least processor time
of many runs, on one thread; all rows come from one process.
"""

import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from shared import make_parser, report

from depthpose.pose.config import VotingConfig
from depthpose.pose.propose import meet_lines, vote_ransac
from depthpose.thesis.pose_voting import ransac_one_by_one

KEYPOINTS = 8
WRONG_SHARE = 0.2
CLOUDS = 10  # over which errors are averaged
BUDGET_S = 1.5  # of the runs of one method
MAX_RUNS = 200
ONE_BY_ONE = "RANSAC one by one (NumPy)"


class Method(NamedTuple):
    """A method of voting: ``vote`` takes points (n, 3) [m] and directions (n, k, 3)."""

    name: str
    hypotheses: int | None
    vote: Callable[[Any, Any], Any]


def random_directions(shape: tuple[int, ...], generator: torch.Generator) -> torch.Tensor:
    """Draw unit vectors."""
    return torch.nn.functional.normalize(torch.randn(shape, generator=generator), dim=-1)


def noisy_votes(
    points: int, noise: float, seed: int
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Make the visible half of a ball of 5 cm, noisy directions to keypoints, and the keypoints."""
    generator = torch.Generator().manual_seed(seed)
    points_m = random_directions((points, 3), generator) * 0.05
    points_m[:, 2] = -points_m[:, 2].abs() + 0.8
    keypoints_m = random_directions((KEYPOINTS, 3), generator) * 0.06
    keypoints_m[:, 2] += 0.8
    exact = torch.nn.functional.normalize(keypoints_m - points_m[:, None], dim=-1)
    errors = noise * torch.randn(exact.shape, generator=generator)
    noisy = torch.nn.functional.normalize(exact + errors, dim=-1)
    wrong = random_directions(tuple(exact.shape), generator)
    is_wrong = torch.rand(points, generator=generator) < WRONG_SHARE
    return points_m, torch.where(is_wrong[:, None, None], wrong, noisy), keypoints_m


def least_seconds(run: Callable[[], object]) -> float:
    """Measure the least processor time of one call [s], over as many as fit the budget."""
    run()
    times_s = []
    start_s = time.perf_counter()
    while len(times_s) < MAX_RUNS and time.perf_counter() - start_s <= BUDGET_S:
        start_cpu_s = time.thread_time()
        run()
        times_s.append(time.thread_time() - start_cpu_s)
    return min(times_s)


def methods(hypotheses: list[int]) -> list[Method]:
    """List the methods, for each number of hypotheses."""
    result = []
    for count in hypotheses:
        config = VotingConfig(hypotheses=count)
        unrefined = VotingConfig(hypotheses=count, refinements=0)
        one_by_one = partial(
            ransac_one_by_one, hypotheses=count, min_cosine=config.min_cosine, seed=0
        )
        result += [
            Method(ONE_BY_ONE, count, one_by_one),
            Method("RANSAC, published refit", count, partial(vote_ransac, config=unrefined)),
            Method("RANSAC", count, partial(vote_ransac, config=config)),
        ]
    return [
        *result,
        Method("least squares, published", None, partial(meet_lines, refinements=0)),
        Method("least squares", None, meet_lines),
    ]


def measure(points: int, hypotheses: list[int], noise: float) -> list[dict[str, object]]:
    """Measure all methods for one number of points."""
    clouds = [noisy_votes(points, noise, seed) for seed in range(CLOUDS)]
    rows = []
    one_by_one_s: dict[int | None, float] = {}
    for method in methods(hypotheses):
        is_numpy = method.name == ONE_BY_ONE
        errors_m = []
        for points_m, directions, keypoints_m in clouds:
            if is_numpy:
                voted_m = method.vote(points_m.double().numpy(), directions.double().numpy())
            else:
                voted_m = method.vote(points_m, directions).keypoints_m.numpy()
            errors_m.append(np.linalg.norm(voted_m - keypoints_m.numpy(), axis=-1).mean())
        points_m, directions, _ = clouds[0]
        arguments: tuple[Any, Any] = (points_m, directions)
        if is_numpy:
            arguments = (points_m.double().numpy(), directions.double().numpy())
        seconds = least_seconds(partial(method.vote, *arguments))
        if is_numpy:
            one_by_one_s[method.hypotheses] = seconds
        times_faster = None
        if method.hypotheses is not None:
            times_faster = round(one_by_one_s[method.hypotheses] / seconds, 1)
        rows.append(
            {
                "points": points,
                "method": method.name,
                "hypotheses": method.hypotheses,
                "milliseconds": round(1000 * seconds, 3),
                "times_faster": times_faster,
                "error_mm": round(1000 * float(np.mean(errors_m)), 3),
            }
        )
    return rows


def main() -> None:
    """Measure and write ``out/bench/voting_speed.json``."""
    parser = make_parser(__doc__)
    parser.add_argument("--points", type=int, nargs="+", default=[500, 1000, 2000, 5000])
    parser.add_argument("--hypotheses", type=int, nargs="+", default=[50, 128, 1024])
    parser.add_argument("--noise", type=float, default=0.05)
    options = parser.parse_args()
    torch.set_num_threads(1)
    rows = [
        row
        for points in options.points
        for row in measure(points, options.hypotheses, options.noise)
    ]
    report("voting_speed", rows)


if __name__ == "__main__":
    main()
