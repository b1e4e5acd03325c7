"""RANSAC: pairs of points propose keypoints, all points judge them, those that agree refit."""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from depthpose.pose.config import VotingConfig
from depthpose.pose.types import Vote
from depthpose.pose.voting.lines import Lines, meet_prepared, prepare_lines

_PARALLEL = 1e-6
_BLOCK = 2**18
"""Votes judged at a time on a CPU: a block of float32 stays in its cache, which is twice as fast
as one pass over all. A GPU is given everything at once."""


def vote_ransac(
    points_m: Float[Tensor, "*batch n 3"],
    directions: Float[Tensor, "*batch n k 3"],
    weight: Float[Tensor, "*batch n k"] | None = None,
    config: VotingConfig | None = None,
) -> Vote:
    """Find each keypoint where most directions agree, and refit it on those.

    One program over hypotheses, keypoints and objects: nothing is tried one by one. The score of a
    hypothesis is the weight of its inliers; pairs come from ``config.seed`` alone, drawn evenly
    from the votes of positive weight. The refit chooses its inliers twice: by the best hypothesis,
    then by what those agree on.

    Args:
        points_m: where the votes stand.
        directions: of any length; a zero direction does not vote.
        weight: 0 leaves a vote out; None counts all alike.
        config: number of hypotheses, test for inliers, seed.

    Raises:
        InputError: fewer than two directions of a keypoint carry weight.
    """
    config = VotingConfig() if config is None else config
    lines, centre_m = prepare_lines(points_m, directions, weight)
    tried, is_crossing = cross_lines(lines, *draw_pairs(lines[2], config.hypotheses, config.seed))
    judge = Judge(lines, config)
    # Parallel pairs propose nothing, yet score 0 so that one always wins.
    best = torch.where(is_crossing, judge.score(tried), 0).argmax(-1)[..., None, None]
    keypoint = tried.gather(-2, best.expand(*best.shape[:-1], 3))
    # Once toward what the best hypothesis gathered, then with those that agree on that.
    used, _ = _inliers(lines, judge, keypoint)
    vote = meet_prepared((*lines[:2], used), centre_m, min(config.refinements, 1))
    used, share = _inliers(lines, judge, (vote.keypoints_m - centre_m)[..., None, :])
    vote = meet_prepared((*lines[:2], used), centre_m, config.refinements)
    return replace(vote, inlier_share=share)


def draw_pairs(
    w: Float[Tensor, "*batch k n"], hypotheses: int, seed: int
) -> tuple[Int64[Tensor, "*batch k h"], Int64[Tensor, "*batch k h"]]:
    """Draw pairs of two different votes of positive weight for each keypoint, on any device alike.

    Each row of ``w`` has two such votes at least.
    """
    counts = (w > 0).sum(-1, keepdim=True)
    generator = torch.Generator().manual_seed(seed)
    shape = (2, *counts.shape[:-1], hypotheses)
    draws = torch.rand(shape, generator=generator, dtype=torch.float64).to(w.device)
    first = (draws[0] * counts).long()
    # A step of 1 .. count - 1 further round never comes back to the first.
    second = (first + 1 + (draws[1] * (counts - 1)).long()) % counts
    if int(counts.min()) == w.shape[-1]:
        return first, second
    voters = (w > 0).to(torch.uint8).argsort(dim=-1, descending=True, stable=True)
    return voters.gather(-1, first), voters.gather(-1, second)


def cross_lines(
    lines: Lines, first: Int64[Tensor, "*batch k h"], second: Int64[Tensor, "*batch k h"]
) -> tuple[Float[Tensor, "*batch k h 3"], Bool[Tensor, "*batch k h"]]:
    """Give the point nearest to both lines of each pair, and whether they are not parallel.

    The middle of the common perpendicular.
    """
    x1, n1 = _pick(lines, first)
    x2, n2 = _pick(lines, second)
    gap = x1 - x2
    cosine = (n1 * n2).sum(-2, keepdim=True)
    d, e = (n1 * gap).sum(-2, keepdim=True), (n2 * gap).sum(-2, keepdim=True)
    sine_squared = 1 - cosine * cosine
    is_crossing = sine_squared > _PARALLEL
    scale = torch.where(is_crossing, sine_squared, 1)
    on_first = x1 + n1 * ((cosine * e - d) / scale)
    on_second = x2 + n2 * ((e - cosine * d) / scale)
    return ((on_first + on_second) / 2).mT, is_crossing.squeeze(-2)


class Judge:
    """Says which lines agree with which hypotheses.

    Both tests compare polynomials in the hypothesis h, and so are two products of matrices:
    ``reach = n . (h - x)`` and ``range^2 = |h|^2 - 2 h . x + |x|^2``. By angle a line agrees when
    ``reach |reach| > cos^2 range^2``, signed, so that a vote that points away does not; by distance
    when ``range^2 - reach^2 < limit^2``, whatever the sense of the vote (published practice).
    """

    def __init__(self, lines: Lines, config: VotingConfig) -> None:
        local, n, self._w = lines
        self._limit = config.max_distance_m**2 if config.inlier_test == "distance" else None
        self._reach = torch.cat([n, -(n * local).sum(-2, keepdim=True)], -2)
        square = local.square().sum(-2, keepdim=True)
        polynomial = torch.cat([-2 * local, torch.ones_like(square), square], -2)
        # The scale of the test goes into the small factor, not into the large product.
        self._range = polynomial * (config.min_cosine**2 if self._limit is None else 1.0)

    def score(self, tried: Float[Tensor, "*batch k h 3"]) -> Float[Tensor, "*batch k h"]:
        """Add up the weight of the lines that agree with each hypothesis."""
        rows = tried.shape[-2]
        if tried.device.type == "cpu":
            rows = max(1, _BLOCK * rows // (tried[..., 0].numel() * self._w.shape[-1]))
        blocks = tried.split(rows, dim=-2)
        weight = self._w[..., None, :]
        return torch.cat([self.agree(block).mul_(weight).sum(-1) for block in blocks], -1)

    def agree(self, tried: Float[Tensor, "*batch k h 3"]) -> Float[Tensor, "*batch k h n"]:
        """Give 1 where a line agrees with a hypothesis, else 0."""
        ones = torch.ones_like(tried[..., :1])
        square = tried.square().sum(-1, keepdim=True)
        reach = torch.cat([tried, ones], -1) @ self._reach
        far = torch.cat([tried, square, ones], -1) @ self._range
        if self._limit is None:
            return far.addcmul_(reach, reach.abs(), value=-1).lt_(0)
        return far.addcmul_(reach, reach, value=-1).lt_(self._limit)


def _pick(lines: Lines, index: Int64[Tensor, "*batch k h"]) -> tuple[Tensor, Tensor]:
    local, n, _ = lines
    wide = index[..., None, :].expand(*index.shape[:-1], 3, index.shape[-1])
    return local.expand_as(n).gather(-1, wide), n.gather(-1, wide)


def _inliers(
    lines: Lines, judge: Judge, keypoint: Float[Tensor, "*batch k 1 3"]
) -> tuple[Float[Tensor, "*batch k n"], Float[Tensor, "*batch k"]]:
    """Give the weights of the lines that agree with a keypoint, and their share."""
    w = lines[2]
    kept = judge.agree(keypoint).squeeze(-2) * w
    is_enough = (kept > 0).sum(-1, keepdim=True) >= 3
    # Where fewer agree than fix a point with its covariance all votes speak; a share of 0 tells.
    share = torch.where(is_enough, kept, 0).sum(-1) / w.sum(-1)
    return torch.where(is_enough, kept, w), share
