"""Votes of point pairs: the model points and turns that most pairs of a reference point name."""

import numpy as np

from depthpose.pose.compiled import compiled, finite_array

Array = np.ndarray


def pair_peaks(
    scene: tuple[Array, Array],
    partners: int,
    references: Array,
    pairs: tuple[Array, Array, Array],
    counts: tuple[int, int, int],
    sizes: tuple[float, float, float],
    bins: tuple[int, int, int],
) -> tuple[Array, Array, Array]:
    """Let every pair of a reference point vote, and give the peaks of each.

    Args:
        scene: points (n, 3) and frames (n, 3, 3): normal and two tangents as columns.
        partners: the first so many of the points are second ones.
        references: numbers of the points that vote, (r,).
        pairs: bounds of each feature's pairs, their first points and turns.
        counts: points of the model, peaks of each reference, pairs of one feature that vote.
        sizes: a bin of distance, and the least and largest distance of a pair.
        bins: the last of the distance; those of an angle and of the turn.

    Returns:
        Model points, bins of the turn and votes, each (r, peaks).

    Raises:
        ValueError: a value is not finite.
    """
    models, peaks, most = counts
    peaks = min(peaks, models)
    shape = (len(references), peaks)
    point, turn, votes = np.zeros(shape, np.int64), np.zeros(shape, np.int64), np.zeros(shape)
    points, frames = (finite_array(a) for a in scene)
    _vote(
        points, frames, partners, references, *pairs, models, most, *sizes, *bins, point, turn,
        votes,
    )  # fmt: skip
    return point, turn, votes


@compiled
def _feature(points, frames, i, j, far, step, angles, value):
    """Write the features of a pair in bins; give the turn of its second point."""
    way, local = points[j] - points[i], np.zeros(3)
    m, nm = 0.0, 0.0
    for c in range(3):
        for k in range(3):
            local[k] += way[c] * frames[i, c, k]
        m += way[c] * frames[j, c, 0]
        nm += frames[i, c, 0] * frames[j, c, 0]
    value[0] = far / step
    value[1], value[2], value[3] = local[0] / far, m / far, nm
    for k in range(1, 4):
        value[k] = np.arccos(min(1.0, max(-1.0, value[k]))) * (angles / np.pi)
    return np.arctan2(local[2], local[1])


@compiled
def _vote(
    points, frames, partners, references, bounds, first, turns, models, most, step, least, reach,
    distances, angles, turn_bins, out_point, out_turn, out_votes,
):  # fmt: skip
    counts = np.zeros((models, turn_bins), np.float32)
    value, own, aside = np.empty(4), np.empty(4, np.int64), np.empty(4, np.int64)
    seen = np.zeros(len(bounds), np.uint32)
    best, best_bin = np.empty(models), np.empty(models, np.int64)
    for r in range(len(references)):
        i = references[r]
        counts[:] = 0
        seen[:] = 0
        for j in range(partners):
            square = 0.0
            for c in range(3):
                square += (points[j, c] - points[i, c]) ** 2
            if square <= least * least or square >= reach * reach:
                continue
            turn = _feature(points, frames, i, j, np.sqrt(square), step, angles, value)
            turned = min(int((turn + np.pi) / (2 * np.pi) * turn_bins), turn_bins - 1)
            bit = np.uint32(1 << turned)
            for k in range(4):
                last = distances if k == 0 else angles - 1
                below = int(value[k])
                beside = below + (-1 if value[k] - below < 0.5 else 1)
                own[k], aside[k] = min(below, last), min(max(beside, 0), last)
            for e in range(5):
                key = 0
                for k in range(4):
                    key = key * angles + (aside[k] if e == k + 1 else own[k])
                low, high = bounds[key], bounds[key + 1]
                if high == low or seen[key] & bit or (e > 0 and aside[e - 1] == own[e - 1]):
                    continue
                seen[key] |= bit
                weight = np.float32(1 / np.sqrt(high - low))
                for p in range(low, min(high, low + most)):
                    t = (turn - turns[p]) * (turn_bins / (2 * np.pi))
                    b = int(t + turn_bins if t < 0 else t)
                    b = b - turn_bins if b >= turn_bins else b
                    counts[first[p], b] += weight
        for m in range(models):
            best[m] = -1.0
            for b in range(turn_bins):
                v = 2 * counts[m, b] + counts[m, b - 1] + counts[m, (b + 1) % turn_bins]
                if v > best[m]:
                    best[m], best_bin[m] = v, b
        for k in range(out_point.shape[1]):
            m = np.argmax(best)
            out_point[r, k], out_turn[r, k], out_votes[r, k] = m, best_bin[m], best[m]
            best[m] = -1.0
