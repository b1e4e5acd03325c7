"""Features of point pairs, and the votes of equal features, in compiled loops.

The feature of a pair is the distance of its points, the angles of both normals to the line between
them, and the angle between the normals (Drost et al., Model Globally, Match Locally, CVPR 2010,
equation 1). The turn of a pair is the angle of its second point about the normal of the first.
"""

from typing import NamedTuple

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


class ModelPairs(NamedTuple):
    """The point pairs of a model, sorted by feature."""

    bounds: Int32[np.ndarray, " bounds"]  #: pairs ``bounds[k]`` to ``bounds[k + 1]`` have key ``k``
    first: Int32[np.ndarray, " pairs"]  #: index of the first point of each pair
    turn: Float32[np.ndarray, " pairs"]  #: of each pair [rad]


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
        Keys and turns [rad] of the pairs (0, 1), (0, 2), ..., (1, 0), (1, 2), ...
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
    """Compute the feature of a pair of points, as fractions of bins, and its turn.

    Args:
        points: of the model or the scene.
        bases: normal and two tangents of each, as columns.
        first: index of the first point of the pair.
        second: index of the second.
        bin_width: of the distance.
        feature: output, the four fractions of bins.

    Returns:
        The turn [rad].
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
    return np.arctan2(up, aside)


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
    pairs: ModelPairs,
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
        pairs: of the model.
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
    voted = np.zeros(len(pairs.bounds), np.uint32)
    feature = np.empty(_PARTS)
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
                _vote_by_pair(feature, turn, pairs, voted, counts)
        _find_peaks(counts, best_point[row], best_turn[row], best_votes[row])
    return best_point, best_turn, best_votes


@compiled
def _vote_by_pair(
    feature: Float64[np.ndarray, "4"],
    turn: float,
    pairs: ModelPairs,
    voted: UInt32[np.ndarray, " bounds"],
    counts: Float32[np.ndarray, "m turns"],
) -> None:
    """Add the votes of the model's pairs with the feature of a pair of the scene, or nearly so.

    Args:
        feature: of the pair of the scene, as fractions of bins.
        turn: of that pair.
        pairs: of the model.
        voted: as of :func:`_add_votes`; changed.
        counts: votes of each model point and turn; changed.
    """
    key = _make_key(feature)
    _add_votes(key, turn, pairs, voted, counts)

    # In each part of the feature the bin next to the pair's too; beyond the last it is the same.
    for part in range(_PARTS):
        pair_bin = int(feature[part])
        nearest_other = pair_bin + (-1 if feature[part] - pair_bin < 0.5 else 1)
        change = _clamp_bin(nearest_other, part) - _clamp_bin(pair_bin, part)
        if change != 0:
            place_value = ANGLES ** (_PARTS - 1 - part)
            _add_votes(key + change * place_value, turn, pairs, voted, counts)


@compiled
def _add_votes(
    key: int,
    turn: float,
    pairs: ModelPairs,
    voted: UInt32[np.ndarray, " bounds"],
    counts: Float32[np.ndarray, "m turns"],
) -> None:
    """Add the votes of the model's pairs with a feature; each turn votes for it only once.

    Args:
        key: of the feature.
        turn: of the pair of the scene.
        pairs: of the model.
        voted: of each feature the turns that have voted, bit ``b`` for bin ``b``; changed.
        counts: votes of each model point and turn; changed.
    """
    low = pairs.bounds[key]
    high = pairs.bounds[key + 1]
    bit = np.uint32(1 << min(int((turn + np.pi) / (2 * np.pi) * TURNS), TURNS - 1))
    if high == low or voted[key] & bit:
        return
    voted[key] |= bit
    weight = np.float32(1 / np.sqrt(high - low))  # rare features weigh more
    for pair in range(low, min(high, low + _MOST_ALIKE)):
        counts[pairs.first[pair], _find_turn_bin(turn - pairs.turn[pair])] += weight


@compiled
def _find_turn_bin(turn: float) -> int:
    """Find the bin of the difference of two angles between -pi and pi."""
    value = turn * (TURNS / (2 * np.pi))
    turn_bin = int(value + TURNS if value < 0 else value)
    return turn_bin - TURNS if turn_bin >= TURNS else turn_bin


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
        best_votes: output: the votes of each.
    """
    # The best turn of each model point. Neighbouring turns share their votes.
    model_points = len(counts)
    most = np.empty(model_points)
    turn = np.empty(model_points, np.int64)
    for point in range(model_points):
        most[point] = -1.0
        for turn_bin in range(TURNS):
            before = counts[point, turn_bin - 1]
            after = counts[point, (turn_bin + 1) % TURNS]
            votes = 2 * counts[point, turn_bin] + before + after
            if votes > most[point]:
                most[point] = votes
                turn[point] = turn_bin

    # The points of the most votes, one after the other.
    for place in range(len(best_point)):
        point = np.argmax(most)
        best_point[place] = point
        best_turn[place] = turn[point]
        best_votes[place] = most[point]
        most[point] = -1.0
