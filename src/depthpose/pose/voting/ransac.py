"""RANSAC: pairs of points propose keypoints, all points score them, those that agree refit."""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from depthpose.pose.config import VotingConfig
from depthpose.pose.types import Vote
from depthpose.pose.voting.lines import Lines, locate, meet_prepared, prepare_lines

_PARALLEL = 1e-6
_BLOCK = 2**17
"""Votes scored at a time on a CPU. All blocks of a call share two pieces of memory that stay in its
cache: fresh megabytes for each call cost three times the arithmetic in page faults alone. A GPU is
given everything at once."""


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
        points_m: where the votes start.
        directions: of any length; a zero direction does not vote.
        weight: 0 leaves a vote out; None counts all alike.
        config: number of hypotheses, test for inliers, seed.

    Raises:
        InputError: fewer than two directions of a keypoint carry weight.
    """
    config = VotingConfig() if config is None else config
    lines, centre_m = prepare_lines(points_m, directions, weight)
    tried, is_crossing = cross_lines(lines, *draw_pairs(lines[2], config.hypotheses, config.seed))
    inlier_test = InlierTest(lines, config)
    # Parallel pairs propose nothing, yet score 0 so that one always wins.
    best = torch.where(is_crossing, inlier_test.score(tried), 0).argmax(-1)[..., None, None]
    keypoint = tried.gather(-2, best.expand(*best.shape[:-1], 3))
    # Once toward what the best hypothesis gathered, then with those that agree on that.
    used, _ = _inliers(lines, inlier_test, keypoint)
    keypoint = locate((*lines[:2], used), min(config.refinements, 1))[..., None, :]
    used, share = _inliers(lines, inlier_test, keypoint.to(centre_m))
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


class InlierTest:
    """Says which lines agree with which hypotheses.

    Both tests compare polynomials in the hypothesis h, and so are two products of matrices:
    ``reach = n . (h - x)`` and ``range^2 = |h|^2 - 2 h . x + |x|^2``. By angle a line agrees when
    ``reach > cos range``, so that a vote that points away does not; by distance when ``range^2 -
    reach^2 < limit^2``, whatever the sense of the vote (published practice).
    """

    def __init__(self, lines: Lines, config: VotingConfig) -> None:
        local, n, w = lines
        self._limit = config.max_distance_m**2 if config.inlier_test == "distance" else None
        reach = torch.cat([n, -(n * local).sum(-2, keepdim=True)], -2)
        square = local.square().sum(-2, keepdim=True)
        far = torch.cat([-2 * local, torch.ones_like(square), square], -2)
        # The scale of the test goes into the small factor, not into the large product.
        far = far * (config.min_cosine**2 if self._limit is None else 1.0)
        # Keypoints and objects are alike here: one axis.
        self._reach = reach.detach().flatten(0, -3)
        self._far = far.detach().expand(*n.shape[:-2], *far.shape[-2:]).flatten(0, -3)
        self._w = w.detach().flatten(0, -2)[:, None]
        self._is_weighted = not bool((w == 1).all())

    @torch.no_grad()
    def score(self, tried: Float[Tensor, "*batch k h 3"]) -> Float[Tensor, "*batch k h"]:
        """Add up the weight of the lines that agree with each hypothesis."""
        each, n = _polynomials(tried), self._w.shape[-1]
        lines, rows = each[0].shape[:2]
        if tried.device.type == "cpu":
            rows = max(1, min(rows, _BLOCK // (lines * n)))
        memory = tried.new_empty(2, lines * rows * n)
        scores = tried.new_empty(tried.shape[:-1])
        flat = scores.view(lines, -1)
        for part in range(0, flat.shape[-1], rows):
            agreed = self._agree([e[:, part : part + rows] for e in each], memory)
            agreed = agreed.mul_(self._w) if self._is_weighted else agreed
            flat[:, part : part + rows] = agreed.sum(-1)
        return scores

    @torch.no_grad()
    def agree(self, tried: Float[Tensor, "*batch k h 3"]) -> Float[Tensor, "*batch k h n"]:
        """Give 1 where a line agrees with a hypothesis, else 0."""
        n = self._w.shape[-1]
        memory = tried.new_empty(2, tried[..., 0].numel() * n)
        return self._agree(_polynomials(tried), memory).view(*tried.shape[:-1], n)

    def _agree(self, tried: list[Tensor], memory: Tensor) -> Float[Tensor, "b h n"]:
        shape = (*tried[0].shape[:2], self._w.shape[-1])
        size = shape[0] * shape[1] * shape[2]
        reach = torch.bmm(tried[0], self._reach, out=memory[0, :size].view(shape))
        far = torch.bmm(tried[1], self._far, out=memory[1, :size].view(shape))
        if self._limit is not None:
            return far.addcmul_(reach, reach, value=-1).lt_(self._limit)
        # What points away reaches nothing, and no square is below its own share.
        return far.addcmul_(reach.clamp_(min=0), reach, value=-1).lt_(0)


def _polynomials(tried: Float[Tensor, "*batch k h 3"]) -> list[Tensor]:
    """Give ``(h, 1)`` and ``(h, |h|^2, 1)``, keypoints and objects on one axis."""
    flat = tried.detach().flatten(0, -3)
    whole = torch.cat(
        [flat, flat.square().sum(-1, keepdim=True), torch.ones_like(flat[..., :1])], -1
    )
    return [whole[..., [0, 1, 2, 4]], whole]


def _pick(lines: Lines, index: Int64[Tensor, "*batch k h"]) -> tuple[Tensor, Tensor]:
    local, n, _ = lines
    wide = index[..., None, :].expand(*index.shape[:-1], 3, index.shape[-1])
    return local.expand_as(n).gather(-1, wide), n.gather(-1, wide)


def _inliers(
    lines: Lines, inlier_test: InlierTest, keypoint: Float[Tensor, "*batch k 1 3"]
) -> tuple[Float[Tensor, "*batch k n"], Float[Tensor, "*batch k"]]:
    """Give the weights of the lines that agree with a keypoint, and their share."""
    w = lines[2]
    kept = inlier_test.agree(keypoint).squeeze(-2) * w
    is_enough = (kept > 0).sum(-1, keepdim=True) >= 3
    # Where fewer agree than fix a point with its covariance all votes are used; the share is 0.
    share = torch.where(is_enough, kept, 0).sum(-1) / w.sum(-1)
    return torch.where(is_enough, kept, w), share
