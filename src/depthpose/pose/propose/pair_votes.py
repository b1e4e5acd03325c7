"""Features of point pairs, and the votes of equal features, in compiled loops.

The feature of a pair is the distance of its points, the angles of both normals to the line between
them, and the angle between the normals (Drost et al., Model Globally, Match Locally, CVPR 2010,
equation 1). The turn of a pair is the angle of its second point about the normal of the first, in
bins, so that the innermost loop only subtracts.
"""

import numpy as np
from jaxtyping import Float32, Float64, Int32, Int64, UInt32

from depthpose.pose.compiled import compiled

DISTANCES = 15
"""Bins of the length of a point pair; one more holds all longer pairs."""
ANGLES = 15
"""Bins of each of the three angles of a point pair, from 0 to 180 degrees."""
FEATURES = (DISTANCES + 1) * ANGLES**3
"""Number of different features, as keys of bins."""
TURNS = 30
"""Bins of the rotation about the normal of the first point of a pair, from 0 to 360 degrees."""
_PARTS = 4
"""Numbers of a feature: a distance and three angles."""
_MOST_ALIKE = 150
"""Largest number of pairs of the model with one feature that vote: all pairs of a plane are alike
and tell little."""
_LEAST_DISTANCE = 1e-12
"""Both sides of a thin sheet may have a point at one place: their distance is no divisor of 0."""


@compiled
def describe_all_pairs(
    points: Float64[np.ndarray, "n 3"], bases: Float64[np.ndarray, "n 3 3"], bin_width: float
) -> tuple[Int64[np.ndarray, " pairs"], Float64[np.ndarray, " pairs"]]:
    """Compute the key of the feature and the turn of every pair of different points.

    Args:
        points: of a model.
        bases: normal and two tangents of each, as columns.
        bin_width: of the distance of a pair.

    Returns:
        Keys, and turns in bins, of the pairs (0, 1), (0, 2), ..., (1, 0), (1, 2), ...
    """
    count = len(points)
    keys = np.empty(count * (count - 1), np.int64)
    turns = np.empty(count * (count - 1))
    feature = np.empty(_PARTS)
    pair = 0
    for first in range(count):
        for second in range(count):
            if second == first:
                continue
            turns[pair] = _describe_pair(points, bases, first, second, bin_width, feature)
            keys[pair] = _make_key(feature)
            pair += 1
    return keys, turns


@compiled
def _describe_pair(
    points: Float64[np.ndarray, "n 3"],
    bases: Float64[np.ndarray, "n 3 3"],
    first: int,
    second: int,
    bin_width: float,
    feature: Float64[np.ndarray, "4"],
) -> float:
    """Compute the feature of a pair of points, in bins, not rounded, and its turn.

    Args:
        points: of the model or the scene.
        bases: normal and two tangents of each, as columns.
        first: index of the first point of the pair.
        second: index of the second.
        bin_width: of the distance.
        feature: output, the four parts in bins, not rounded.

    Returns:
        The turn, in bins.
    """
    # The way from the first point to the second along the first's normal and tangents, and along
    # the second's normal; and the cosine of the two normals.
    along, aside, up = 0.0, 0.0, 0.0
    along_second = 0.0
    cosine = 0.0
    square = 0.0
    for axis in range(3):
        way = points[second, axis] - points[first, axis]
        square += way * way
        along += way * bases[first, axis, 0]
        aside += way * bases[first, axis, 1]
        up += way * bases[first, axis, 2]
        along_second += way * bases[second, axis, 0]
        cosine += bases[first, axis, 0] * bases[second, axis, 0]
    distance = max(np.sqrt(square), _LEAST_DISTANCE)
    feature[0] = distance / bin_width
    feature[1] = _bins_from_cosine(along / distance)
    feature[2] = _bins_from_cosine(along_second / distance)
    feature[3] = _bins_from_cosine(cosine)
    return np.arctan2(up, aside) * (TURNS / (2 * np.pi))


@compiled
def _bins_from_cosine(cosine: float) -> float:
    """Convert the cosine of an angle to the angle, in bins."""
    return np.arccos(min(1.0, max(-1.0, cosine))) * (ANGLES / np.pi)


@compiled
def _make_key(feature: Float64[np.ndarray, "4"]) -> int:
    """Make one number of the bins of a feature."""
    key = 0
    for part in range(_PARTS):
        key = key * ANGLES + _clamp_bin(int(feature[part]), part)
    return key


@compiled
def _clamp_bin(number: int, part: int) -> int:
    """Clamp the bin of a part of a feature: values beyond the bins are in the last one."""
    last = DISTANCES if part == 0 else ANGLES - 1
    return min(max(number, 0), last)


@compiled
def cast_votes(
    points: Float64[np.ndarray, "n 3"],
    bases: Float64[np.ndarray, "n 3 3"],
    references: Int64[np.ndarray, " r"],
    bounds: Int32[np.ndarray, " bounds"],
    first: Int32[np.ndarray, " pairs"],
    pair_turn: Float32[np.ndarray, " pairs"],
    model_points: int,
    bin_width: float,
    peaks: int,
) -> tuple[
    Int64[np.ndarray, "r peaks"], Int64[np.ndarray, "r peaks"], Float64[np.ndarray, "r peaks"]
]:
    """Let every pair of a reference point vote for a model point and a turn about its normal.

    Args:
        points: of the scene.
        bases: normal and two tangents of each, as columns.
        references: indices of the points that vote with each of the others.
        bounds: the model's pairs ``bounds[k]`` to ``bounds[k + 1]`` have the feature of key ``k``.
        first: index of the first point of each pair of the model.
        pair_turn: its turn, in bins.
        model_points: number of its points.
        bin_width: of the distance of a pair.
        peaks: how many model points are chosen for each reference, those of the most votes.

    Returns:
        For each reference the indices of these model points, the bins of their turns, and their
        votes.
    """
    shape = (len(references), peaks)
    best_point = np.empty(shape, np.int64)
    best_turn = np.empty(shape, np.int64)
    best_votes = np.empty(shape)
    counts = np.zeros((model_points, TURNS), np.float32)
    voted = np.zeros(len(bounds), np.uint32)
    feature = np.empty(_PARTS)
    keys = np.empty(1 + _PARTS, np.int64)
    for row in range(len(references)):
        reference = references[row]
        counts[:] = 0
        voted[:] = 0
        # With every other point that is neither too near nor too far.
        for other in range(len(points)):
            square = 0.0
            for axis in range(3):
                square += (points[other, axis] - points[reference, axis]) ** 2
            if square > bin_width * bin_width and square < (DISTANCES * bin_width) ** 2:
                turn = _describe_pair(points, bases, reference, other, bin_width, feature)
                key_count = _find_near_keys(feature, keys)
                _add_votes(keys[:key_count], turn, bounds, first, pair_turn, voted, counts)
        _find_peaks(counts, best_point[row], best_turn[row], best_votes[row])
    return best_point, best_turn, best_votes


@compiled
def _find_near_keys(feature: Float64[np.ndarray, "4"], keys: Int64[np.ndarray, "5"]) -> int:
    """Find the keys of a feature and of the nearest other bin in each of its parts.

    Args:
        feature: in bins, not rounded.
        keys: output.

    Returns:
        How many there are: beyond the last bin of a part the other bin is the same.
    """
    key = _make_key(feature)
    keys[0] = key
    count = 1
    for part in range(_PARTS):
        pair_bin = int(feature[part])
        nearest_other = pair_bin + (-1 if feature[part] - pair_bin < 0.5 else 1)
        change = _clamp_bin(nearest_other, part) - _clamp_bin(pair_bin, part)
        if change != 0:
            keys[count] = key + change * ANGLES ** (_PARTS - 1 - part)
            count += 1
    return count


@compiled
def _add_votes(
    keys: Int64[np.ndarray, " k"],
    turn: float,
    bounds: Int32[np.ndarray, " bounds"],
    first: Int32[np.ndarray, " pairs"],
    pair_turn: Float32[np.ndarray, " pairs"],
    voted: UInt32[np.ndarray, " bounds"],
    counts: Float32[np.ndarray, "m turns"],
) -> None:
    """Add the votes of the model's pairs with any of some features; a turn votes for each once.

    Args:
        keys: of the features.
        turn: of the pair of the scene, in bins.
        bounds: of the model's pairs, as of :func:`cast_votes`.
        first: of the model's pairs.
        pair_turn: of the model's pairs.
        voted: of each feature the turns that have voted for this reference, bit ``b`` for bin
            ``b``; changed.
        counts: votes of each model point and turn; changed.
    """
    bit = np.uint32(1 << min(int(turn + TURNS / 2), TURNS - 1))
    for key in keys:
        low = bounds[key]
        high = bounds[key + 1]
        if high == low or voted[key] & bit:
            continue
        voted[key] |= bit
        weight = np.float32(1 / np.sqrt(high - low))  # rare features weigh more
        for pair in range(low, min(high, low + _MOST_ALIKE)):
            # Indices without a sign: one with a sign may count from the end, which is a branch.
            counts[np.uint32(first[pair]), _find_turn_bin(turn - pair_turn[pair])] += weight


@compiled
def _find_turn_bin(turn: float) -> np.uint32:
    """Find the bin of the difference of two turns, which is between -TURNS and TURNS."""
    turn_bin = np.uint32(turn + TURNS)
    for _ in range(2):
        turn_bin -= np.uint32(TURNS) if turn_bin >= TURNS else np.uint32(0)
    return turn_bin


@compiled
def _find_peaks(
    counts: Float32[np.ndarray, "m turns"],
    best_point: Int64[np.ndarray, " peaks"],
    best_turn: Int64[np.ndarray, " peaks"],
    best_votes: Float64[np.ndarray, " peaks"],
) -> None:
    """Find the model points with the most votes, at the best turn of each.

    Args:
        counts: votes of each model point and turn.
        best_point: output: indices of the model points, that of the most votes first.
        best_turn: output: the bin of the turn of each.
        best_votes: output: the votes of each, smoothed over neighbouring turns.
    """
    # The best turn of each model point. Neighbouring turns share their votes.
    model_points = len(counts)
    most = np.empty(model_points)
    turn = np.empty(model_points, np.int64)
    for point in range(model_points):
        most[point] = -1.0
        before = counts[point, TURNS - 1]
        here = counts[point, 0]
        for turn_bin in range(TURNS):
            after = counts[point, turn_bin + 1 if turn_bin + 1 < TURNS else 0]
            votes = 2 * here + before + after
            if votes > most[point]:
                most[point] = votes
                turn[point] = turn_bin
            before = here
            here = after

    # The points of the most votes, one after the other.
    for place in range(len(best_point)):
        point = np.argmax(most)
        best_point[place] = point
        best_turn[place] = turn[point]
        best_votes[place] = most[point]
        most[point] = -1.0
