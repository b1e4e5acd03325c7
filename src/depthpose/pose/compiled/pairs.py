"""Votes of point pairs: the model points and rotations that most pairs of a reference vote for."""

import numpy as np

from depthpose.pose.compiled import ANGLES, DISTANCES, MOST_ALIKE, TURNS, compiled


@compiled
def _feature(points, frames, i, j, far, step, value):
    """Write the four features of a pair, in bins; give the angle of its second point [rad].

    As ``_features`` of ``propose/point_pairs.py``: ``far`` is the distance of points ``i`` and
    ``j``, ``step`` a bin of it, and the angle is that about the normal of ``i``.
    """
    along, aside, up, m, nm = 0.0, 0.0, 0.0, 0.0, 0.0
    for c in range(3):
        way = points[j, c] - points[i, c]
        along += way * frames[i, c, 0]
        aside += way * frames[i, c, 1]
        up += way * frames[i, c, 2]
        m += way * frames[j, c, 0]
        nm += frames[i, c, 0] * frames[j, c, 0]
    value[0] = far / step
    value[1], value[2], value[3] = along / far, m / far, nm
    for k in range(1, 4):
        value[k] = np.arccos(min(1.0, max(-1.0, value[k]))) * (ANGLES / np.pi)
    return np.arctan2(up, aside)


@compiled
def vote(
    points, frames, references, bounds, first, turns, models, step, out_point, out_turn, out_votes
):  # fmt: skip
    """Let every pair of a reference point vote; write the points, turns and votes of its peaks.

    As ``_peaks`` of ``propose/point_pairs.py``.

    Args:
        points: of the scene (n, 3).
        frames: normal and two tangents of each, as columns (n, 3, 3).
        references: indices of the points that vote with each of the others.
        bounds: of ``PairTable``, as ``first`` and ``turns`` (its ``turn_rad``).
        first: index of the first model point of each pair.
        turns: angle of the second point of each pair [rad].
        models: number of model points.
        step: a bin of the distance of a pair.
        out_point: model point of each peak (references, peaks).
        out_turn: bin of its turn.
        out_votes: and its votes.
    """
    counts = np.zeros((models, TURNS), np.float32)
    value, own, aside = np.empty(4), np.empty(4, np.int64), np.empty(4, np.int64)
    voted = np.zeros(len(bounds), np.uint32)  # bit b: the feature has had a vote of turn bin b
    best, best_bin = np.empty(models), np.empty(models, np.int64)
    for r in range(len(references)):
        i = references[r]
        counts[:] = 0
        voted[:] = 0
        for j in range(len(points)):
            square = 0.0
            for c in range(3):
                square += (points[j, c] - points[i, c]) ** 2
            if square <= step * step or square >= (DISTANCES * step) ** 2:
                continue
            turn = _feature(points, frames, i, j, np.sqrt(square), step, value)
            turn_bin = min(int((turn + np.pi) / (2 * np.pi) * TURNS), TURNS - 1)
            bit = np.uint32(1 << turn_bin)

            # In each of the four features the pair's own bin, and the nearer one beside it.
            for k in range(4):
                last = DISTANCES if k == 0 else ANGLES - 1
                below = int(value[k])
                beside = below + (-1 if value[k] - below < 0.5 else 1)
                own[k], aside[k] = min(below, last), min(max(beside, 0), last)

            # Votes of the model's pairs with the own bins, and with each of the four others.
            for e in range(5):
                key = 0
                for k in range(4):
                    key = key * ANGLES + (aside[k] if e == k + 1 else own[k])
                low, high = bounds[key], bounds[key + 1]
                is_own_again = e > 0 and aside[e - 1] == own[e - 1]  # beyond the last bin
                if high == low or voted[key] & bit or is_own_again:
                    continue
                voted[key] |= bit
                weight = np.float32(1 / np.sqrt(high - low))
                for p in range(low, min(high, low + MOST_ALIKE)):
                    t = (turn - turns[p]) * (TURNS / (2 * np.pi))
                    b = int(t + TURNS if t < 0 else t)
                    b = b - TURNS if b >= TURNS else b
                    counts[first[p], b] += weight

        # The best turn of each model point, and of these the best model points.
        for m in range(models):
            best[m] = -1.0
            for b in range(TURNS):
                v = 2 * counts[m, b] + counts[m, b - 1] + counts[m, (b + 1) % TURNS]
                if v > best[m]:
                    best[m], best_bin[m] = v, b
        for k in range(out_point.shape[1]):
            m = np.argmax(best)
            out_point[r, k], out_turn[r, k], out_votes[r, k] = m, best_bin[m], best[m]
            best[m] = -1.0
