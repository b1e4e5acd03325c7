"""From directions to keypoints to a pose: voting, a check of rigidity, and Kabsch."""

import math
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor

from depthpose.core.errors import InputError
from depthpose.core.rigid import Rigid, cross_matrix, fit_rigid, rotation_by
from depthpose.pose.config import EstimateConfig, VotingConfig
from depthpose.pose.refusals import Refused
from depthpose.pose.types import ObjectModel, PoseFit, Vote

_SMALLEST = 1e-12  # length by which a vector is divided, or that a direction has
_NEAREST = 0.1
"""Share of the mean distance to a keypoint: nearer points weigh no more than at this distance. A
point on the keypoint would outweigh all others, and its direction means nothing."""
_LEAST_COSINE = 0.5
"""Between a direction and the way to the keypoint, in the information of a vote: outliers would
make its matrix indefinite."""
_DAMPING = 1e-12
"""Share of the trace that is added to a matrix of lines, so that parallel ones have a solution."""
_EIGENVALUE_ROUNDING = 1e-7
"""Rounding error of the eigenvalues of a matrix of trace 2, whose sums are in float32: a smaller
eigenvalue is that of parallel lines."""


class VoteLines(NamedTuple):
    """Lines of votes, from n points to each of k keypoints; the points are the last axis.

    Coordinates are about the mean of the points.
    """

    points: Float[Tensor, "*batch 1 3 n"]  #: one on each line
    directions: Float[Tensor, "*batch k 3 n"]  #: unit vectors
    weights: Float[Tensor, "*batch k n"]  #: 0 leaves a line out


def meet_lines(
    points_m: Float[Tensor, "*batch n 3"],
    directions: Float[Tensor, "*batch n k 3"],
    weight: Float[Tensor, "*batch n k"] | None = None,
    refinements: int = 3,
) -> Vote:
    """Find for each keypoint the point where the lines ``x_i + s n_i`` meet best.

    The start is the point nearest to all of them, ``(sum w (I - n n^T)) p = sum w (I - n n^T) x``.
    It is biased toward the points, since the noise of ``n`` enters both sides. Each refinement is a
    step of Fisher scoring to the largest ``sum w n . q`` with ``q = (p - x) / |p - x|``, the most
    likely point where directions err by angles (von Mises-Fisher). Its expected gradient is zero at
    the truth for any error that is symmetric about the true direction, however large.

    The covariance is ``A^-1 (sum g g^T) A^-1`` with the gradient ``g`` of each line (White 1980):
    right whatever the size of each error, as long as the errors are independent; errors of
    neighbouring points that agree make it too small. Parallel lines meet nowhere: the condition is
    then infinite and the point arbitrary along them.

    Args:
        points_m: where the votes start.
        directions: of any length; a zero direction does not vote.
        weight: 0 leaves a vote out (padding, outliers); None counts all alike.
        refinements: steps after the nearest point.

    Returns:
        The keypoints in the frame of the points, and how well the lines fix them.

    Raises:
        InputError: fewer than two lines of a keypoint have weight.
    """
    lines, centre_m = _make_lines(points_m, directions, weight)
    return _meet(lines, centre_m, refinements)


def _make_lines(
    points_m: Float[Tensor, "*batch n 3"],
    directions: Float[Tensor, "*batch n k 3"],
    weight: Float[Tensor, "*batch n k"] | None,
) -> tuple[VoteLines, Float[Tensor, "*batch 1 3"]]:
    """Make lines of points and directions; return them, and the mean of the points.

    Raises:
        InputError: fewer than two lines of a keypoint have weight.
    """
    # Coordinates about the mean of the points, and unit vectors.
    centre_m = points_m.mean(-2, keepdim=True)
    local = (points_m - centre_m).mT[..., None, :, :].contiguous()
    n = directions.movedim(-3, -1).contiguous()
    lengths = n.square().sum(-2).sqrt_()
    w = (lengths > _SMALLEST).to(n)
    n = n / lengths.clamp_(min=_SMALLEST)[..., None, :]

    # A direction of length 0 has no weight, as those that are left out.
    w = w if weight is None else w * weight.mT
    least = int((w > 0).sum(-1).min()) if w.numel() else 0
    if least < 2:
        raise InputError(
            f"voting: {least} directions of some keypoint carry weight, but two lines at least "
            "fix a point. Give more points or a positive weight to more of them."
        )
    return VoteLines(points=local, directions=n, weights=w), centre_m


def _meet(lines: VoteLines, centre_m: Float[Tensor, "*batch 1 3"], refinements: int) -> Vote:
    """Find where lines meet best, as :func:`meet_lines`; ``centre_m`` is added to the points."""
    local, n, w = lines  # points x, unit directions n and weights w, as in the formulas
    p, A = _find_nearest_point(lines)
    condition = _measure_condition(A)

    # The gradient of each line there, in case that there is no refinement.
    offset = p.to(n)[..., None] - local
    gradient = offset - n * (n * offset).sum(-2, keepdim=True)
    gradient = gradient * (w / w.sum(-1, keepdim=True))[..., None, :]
    for _ in range(refinements):
        p, A, gradient = _step_to_likeliest(lines, p)

    # Each line gives 2 equations for 3 unknowns: the correction for the degrees of freedom.
    inverse = torch.linalg.inv(_damp(A))
    votes = (w > 0).sum(-1)
    correction = (2 * votes.double() / (2 * votes - 3).clamp(min=1))[..., None, None]
    covariance = correction * (inverse @ (gradient @ gradient.mT).double() @ inverse)
    return Vote(
        keypoints_m=p.to(centre_m) + centre_m,
        covariance_m2=covariance.to(centre_m),
        condition=condition.to(centre_m),
        inlier_share=torch.ones_like(w[..., 0]),
    )


def _find_nearest_point(
    lines: VoteLines,
) -> tuple[Float64[Tensor, "*b k 3"], Float64[Tensor, "*b k 3 3"]]:
    """Find the points nearest to all lines, ``A p = b``; return p and A.

    ``A = sum w (I - n n^T) / sum w``, of a trace of 2, and ``b = sum w (I - n n^T) x / sum w``.
    """
    local, n, w = lines
    eye = torch.eye(3, dtype=torch.float64, device=n.device)
    along = (n * local).sum(-2, keepdim=True)
    total = w.sum(-1).double()[..., None, None]
    wn = n * w[..., None, :]
    A = (total * eye - (wn @ n.mT).double()) / total
    b = (local @ w[..., None] - wn @ along.mT).double() / total
    return torch.linalg.solve(_damp(A), b).squeeze(-1), A


def _measure_condition(A: Float64[Tensor, "*b k 3 3"]) -> Float64[Tensor, "*b k"]:
    """Measure the ratio of the largest to the least eigenvalue; infinite for parallel lines."""
    eigenvalues = torch.linalg.eigvalsh(A)  # ascending
    least = eigenvalues[..., 0]
    ratio = eigenvalues[..., 2] / least.clamp(min=_EIGENVALUE_ROUNDING)
    return torch.where(least > _EIGENVALUE_ROUNDING, ratio, torch.inf)


def _step_to_likeliest(
    lines: VoteLines, p: Float64[Tensor, "*b k 3"]
) -> tuple[Float64[Tensor, "*b k 3"], Float64[Tensor, "*b k 3 3"], Float[Tensor, "*b k 3 n"]]:
    """Make a step of Fisher scoring from points p to the largest ``sum w n . q / sum w``.

    Returns:
        The next points; the information matrix; and the gradient of each line, both at p.
    """
    # The unit vector q from each line's point to p, and its distance. A point near p would pull
    # without bound: it counts as one at a tenth of the mean distance.
    local, n, w = lines
    offset = p.to(n)[..., None] - local
    distance = offset.square().sum(-2).sqrt_()
    scale = distance.mean(-1, keepdim=True).clamp(min=_SMALLEST)
    q = offset / distance.clamp(min=_SMALLEST)[..., None, :]
    distance = torch.maximum(distance, _NEAREST * scale)

    # The gradient, (n - q cos) / distance, and the information, (I - q q^T) cos / distance^2.
    cosine = (n * q).sum(-2)
    pull = w / distance / w.sum(-1, keepdim=True)
    gradient = (n - q * cosine[..., None, :]) * pull[..., None, :]
    amount = pull / distance * cosine.clamp(min=_LEAST_COSINE)
    outer = ((q * amount[..., None, :]) @ q.mT).double()
    eye = torch.eye(3, dtype=torch.float64, device=n.device)
    A = amount.sum(-1).double()[..., None, None] * eye - outer
    step = torch.linalg.solve(_damp(A), gradient.sum(-1).double()[..., None]).squeeze(-1)

    # No step is longer than the root mean square distance of the keypoint to the points.
    spread = local.square().sum(-2).mean(-1).double()
    limit = (p.square().sum(-1) + spread).sqrt()
    shortening = (limit / step.norm(dim=-1).clamp(min=_SMALLEST)).clamp(max=1.0)
    return p + step * shortening[..., None], A, gradient


def _damp(A: Float64[Tensor, "*b k 3 3"]) -> Float64[Tensor, "*b k 3 3"]:
    """Add a little to the diagonal: parallel lines then meet near the mean of the points."""
    trace = A.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None].clamp(min=1e-300)
    return A + _DAMPING * trace * torch.eye(3, dtype=A.dtype, device=A.device)


_PARALLEL = 1e-6  # square of the sine of the angle of two lines, below which they do not cross
_LEAST_INLIERS = 3  # lines that fix a point and its covariance
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
    """Find each keypoint where most directions agree, by RANSAC, and refit it to its inliers.

    A hypothesis is where the lines of two votes nearly cross; its score is the weight of its
    inliers. Pairs are drawn evenly from the votes of positive weight, by ``config.seed`` alone. All
    hypotheses, keypoints and objects are computed at once. The inliers are chosen twice: those of
    the best hypothesis, then those of the point that is fitted to them.

    Args:
        points_m: where the votes start.
        directions: of any length; a zero direction does not vote.
        weight: 0 leaves a vote out; None counts all alike.
        config: number of hypotheses, test for inliers, seed.

    Returns:
        The keypoints in the frame of the points, and how well their inliers fix them.

    Raises:
        InputError: fewer than two directions of a keypoint carry weight.
    """
    config = VotingConfig() if config is None else config
    lines, centre_m = _make_lines(points_m, directions, weight)
    first, second = _draw_pairs(lines.weights, config)
    hypotheses, is_crossing = _find_crossings(lines, first, second)

    # The best hypothesis. Parallel pairs score 0, as the least of all, so that one always wins.
    scorer = InlierScorer(lines, config)
    scores = torch.where(is_crossing, scorer.score(hypotheses), 0)
    best = scores.argmax(-1)[..., None, None]
    keypoint = hypotheses.gather(-2, best.expand(*best.shape[:-1], 3))

    # Refitted to its inliers, then to those of the refitted point.
    w = lines.weights
    for steps in (min(config.refinements, 1), config.refinements):
        inlier_weight = scorer.mark_inliers(keypoint).squeeze(-2) * w
        is_enough = (inlier_weight > 0).sum(-1, keepdim=True) >= _LEAST_INLIERS
        # Where there are too few inliers all votes are used, and the share is 0.
        share = torch.where(is_enough, inlier_weight, 0).sum(-1) / w.sum(-1)
        used = lines._replace(weights=torch.where(is_enough, inlier_weight, w))
        vote = _meet(used, torch.zeros_like(centre_m), steps)
        keypoint = vote.keypoints_m[..., None, :]
    return replace(vote, keypoints_m=vote.keypoints_m + centre_m, inlier_share=share)


def _draw_pairs(
    weights: Float[Tensor, "*batch k n"], config: VotingConfig
) -> tuple[Int64[Tensor, "*batch k h"], Int64[Tensor, "*batch k h"]]:
    """Draw pairs of two different votes of positive weight, on any device alike.

    Returns:
        The indices of the first and of the second vote of each keypoint's hypotheses.
    """
    # Two different numbers below the count of votes with weight.
    counts = (weights > 0).sum(-1, keepdim=True)
    generator = torch.Generator().manual_seed(config.seed)
    shape = (2, *counts.shape[:-1], config.hypotheses)
    draws = torch.rand(shape, generator=generator, dtype=torch.float64).to(weights.device)
    first = (draws[0] * counts).long()
    # 1 to count - 1 further round, which never is the first itself.
    second = (first + 1 + (draws[1] * (counts - 1)).long()) % counts
    if int(counts.min()) == weights.shape[-1]:
        return first, second

    # To the indices of these votes.
    voters = (weights > 0).to(torch.uint8).argsort(dim=-1, descending=True, stable=True)
    return voters.gather(-1, first), voters.gather(-1, second)


def _find_crossings(
    lines: VoteLines, first: Int64[Tensor, "*batch k h"], second: Int64[Tensor, "*batch k h"]
) -> tuple[Float[Tensor, "*batch k h 3"], Bool[Tensor, "*batch k h"]]:
    """Find where pairs of lines nearly cross: the middle of their common perpendicular.

    Args:
        lines: of the votes.
        first: index of the first line of each pair.
        second: index of the second.

    Returns:
        The middles, and whether the lines cross: parallel ones do not.
    """
    x1, n1 = _select_lines(lines, first)
    x2, n2 = _select_lines(lines, second)

    # The feet of the perpendicular: with gap = x1 - x2, c = n1 . n2, d = n1 . gap, e = n2 . gap
    # they are x1 + n1 (c e - d) / (1 - c^2) and x2 + n2 (e - c d) / (1 - c^2).
    gap = x1 - x2
    cosine = (n1 * n2).sum(-2, keepdim=True)
    d = (n1 * gap).sum(-2, keepdim=True)
    e = (n2 * gap).sum(-2, keepdim=True)
    sine_squared = 1 - cosine * cosine
    is_crossing = sine_squared > _PARALLEL
    scale = torch.where(is_crossing, sine_squared, 1)
    on_first = x1 + n1 * ((cosine * e - d) / scale)
    on_second = x2 + n2 * ((e - cosine * d) / scale)
    return ((on_first + on_second) / 2).mT, is_crossing.squeeze(-2)


def _select_lines(
    lines: VoteLines, index: Int64[Tensor, "*batch k h"]
) -> tuple[Float[Tensor, "*batch k 3 h"], Float[Tensor, "*batch k 3 h"]]:
    """Select lines by index: a point on each, and its direction."""
    index = index[..., None, :].expand(*index.shape[:-1], 3, index.shape[-1])
    points = lines.points.expand_as(lines.directions)
    return points.gather(-1, index), lines.directions.gather(-1, index)


class InlierScorer:
    """Tests which lines agree with which hypotheses, by angle or by distance.

    Both tests compare polynomials in the hypothesis h, and so are two products of matrices:
    ``along = n . (h - x)`` and ``range^2 = |h|^2 - 2 h . x + |x|^2``. By angle a line agrees where
    ``along > cos range``, so that a vote that points away does not; by distance where ``range^2 -
    along^2 < limit^2``, whatever the sense of the vote (published practice).
    """

    def __init__(self, lines: VoteLines, config: VotingConfig) -> None:
        # The polynomials' coefficients of each line, of [h, 1] and of [h, |h|^2, 1].
        local, n, w = lines
        self._limit = config.max_distance_m**2 if config.inlier_test == "distance" else None
        along = torch.cat([n, -(n * local).sum(-2, keepdim=True)], -2)
        square = local.square().sum(-2, keepdim=True)
        far = torch.cat([-2 * local, torch.ones_like(square), square], -2)
        # The test's cosine is multiplied into the small factor, not into the large product.
        far = far * (config.min_cosine**2 if self._limit is None else 1.0)
        # Keypoints and objects become one axis.
        self._along = along.detach().flatten(0, -3)
        self._far = far.detach().expand(*n.shape[:-2], *far.shape[-2:]).flatten(0, -3)
        self._w = w.detach().flatten(0, -2)[:, None]
        self._is_weighted = not bool((w == 1).all())

    @torch.no_grad()
    def score(self, hypotheses: Float[Tensor, "*batch k h 3"]) -> Float[Tensor, "*batch k h"]:
        """Add up the weights of the lines that agree with each hypothesis."""
        # As many hypotheses at a time as keep to the cache.
        flat = hypotheses.flatten(0, -3)
        votes = self._w.shape[-1]
        keypoints, rows = flat.shape[:2]
        if hypotheses.device.type == "cpu":
            rows = max(1, min(rows, _BLOCK // (keypoints * votes)))
        memory = hypotheses.new_empty(2, keypoints * rows * votes)
        scores = hypotheses.new_empty(flat.shape[:-1])
        for start in range(0, flat.shape[1], rows):
            agreed = self.mark_inliers(flat[:, start : start + rows], memory)
            agreed = agreed.mul_(self._w) if self._is_weighted else agreed
            scores[:, start : start + rows] = agreed.sum(-1)
        return scores.view(hypotheses.shape[:-1])

    @torch.no_grad()
    def mark_inliers(
        self, hypotheses: Float[Tensor, "*batch k h 3"], memory: Tensor | None = None
    ) -> Float[Tensor, "*batch k h n"]:
        """Mark the lines that agree with each hypothesis by 1, the others by 0.

        Args:
            hypotheses: points.
            memory: two rows, each for as many numbers as there are marks, into one of which these
                are written; None: it is made.
        """
        # Both polynomials, as products of matrices.
        flat = hypotheses.detach().flatten(0, -3)
        square = flat.square().sum(-1, keepdim=True)
        ones = torch.ones_like(flat[..., :1])
        shape = (*flat.shape[:2], self._w.shape[-1])
        size = math.prod(shape)
        memory = hypotheses.new_empty(2, size) if memory is None else memory
        along, far = (part[:size].view(shape) for part in memory)
        torch.bmm(torch.cat([flat, ones], -1), self._along, out=along)
        torch.bmm(torch.cat([flat, square, ones], -1), self._far, out=far)

        # By distance, or by angle.
        if self._limit is not None:
            agreed = far.addcmul_(along, along, value=-1).lt_(self._limit)
        else:  # a vote that points away gets an along of 0, and does not agree
            agreed = far.addcmul_(along.clamp_(min=0), along, value=-1).lt_(0)
        return agreed.view(*hypotheses.shape[:-1], shape[-1])


_LEAST_KEYPOINTS = 4  # that must agree: three fix a pose with nothing left to contradict it
_STEPS = 4  # Gauss-Newton from Kabsch: the fourth step is below float64's noise
_EXACT = 1e-12  # of the squared extent: no keypoint has a smaller variance, a millionth of the size
_MOST_WEIGHT = 100  # times the median weight, in Kabsch's fit
_MOST_SEVERITY = 100.0  # tolerances, of an error that decides which keypoint is removed


def fit_poses(vote: Vote, model: ObjectModel, config: EstimateConfig) -> PoseFit:
    """Fit a pose to the keypoints that are consistent; where ICP follows, also to all of them.

    Args:
        vote: observed keypoints of one object.
        model: the object.
        config: what keypoints must fulfil, and whether ICP follows.

    Returns:
        A batch of one or two fits.

    Raises:
        Refused: fewer than four keypoints are met by votes, or consistent.
    """
    # Keypoints at which the votes meet.
    is_met = (vote.condition <= config.voting.max_condition) & (vote.inlier_share > 0)
    total = len(is_met)
    if int(is_met.sum()) < _LEAST_KEYPOINTS:
        raise Refused(
            "votes do not meet",
            f"the directions meet at {int(is_met.sum())} of {total} keypoints, but "
            f"{_LEAST_KEYPOINTS} are needed: too few points, or not the object that the mask "
            "promises",
        )

    # Of these the ones with the model's distances.
    limit_diameters = config.voting.rigidity_diameters
    if config.with_icp:
        limit_diameters = config.rough_rigidity_diameters
    limit_m = model.diameter_m * limit_diameters
    is_consistent = find_consistent_keypoints(vote.keypoints_m, model.keypoints_m, limit_m, is_met)
    consistent = int(is_consistent.sum())
    choices = [is_consistent] if consistent >= _LEAST_KEYPOINTS else []
    if config.with_icp and not torch.equal(is_consistent, is_met):
        choices.append(is_met)
    if not choices:
        raise Refused(
            "keypoints do not fit",
            f"{consistent} of {total} keypoints have the model's distances within "
            f"{limit_m:.2g} m, but {_LEAST_KEYPOINTS} are needed: another object, or too much of "
            "it occluded",
        )

    # A fit to each choice.
    count = len(choices)
    return fit_pose(
        vote.keypoints_m.expand(count, -1, -1),
        vote.covariance_m2.expand(count, -1, -1, -1),
        model.keypoints_m,
        torch.stack(choices),
    )


def fit_pose(
    keypoints_m: Float[Tensor, "*batch k 3"],
    covariance_m2: Float[Tensor, "*batch k 3 3"],
    model_keypoints_m: Float[Tensor, "k 3"],
    is_used: Bool[Tensor, "*batch k"] | None = None,
) -> PoseFit:
    """Fit the pose that moves the model's keypoints onto observed ones.

    Begins with the weighted Kabsch fit, weights the trace of each inverse covariance, then
    minimises ``sum e^T C^-1 e`` with ``e = R m + t - p`` over left perturbations: a keypoint is far
    more certain across its votes' lines than along them, which one weight cannot express. The
    covariance of the pose is the inverse of ``sum J^T C^-1 J`` with ``J = [-[R m + t]_x, I]``.

    Args:
        keypoints_m: observed, in the camera frame.
        covariance_m2: of each; a lower bound keeps the information of exact keypoints finite.
        model_keypoints_m: in the model frame.
        is_used: which keypoints count; None: all. Three at least, not on a line.

    Raises:
        InputError: fewer than three keypoints are used.
    """
    # Observed keypoints, those of the model, and which are used.
    observed_m = keypoints_m.double()
    model_m = model_keypoints_m.double().expand_as(observed_m)
    used = torch.ones_like(observed_m[..., 0], dtype=torch.bool) if is_used is None else is_used

    # Information of each keypoint; none is known better than a millionth of the object.
    spread_m2 = (model_m - model_m.mean(-2, keepdim=True)).square().sum(-1).mean(-1)
    floor_m2 = (_EXACT * spread_m2)[..., None, None, None] * torch.eye(3).to(model_m)
    information = torch.linalg.inv(covariance_m2.double() + floor_m2) * used[..., None, None]

    # Kabsch. One keypoint that looks exact must not decide alone, since a rotation takes three: no
    # weight is above a hundred times the median of those used.
    trace = information.diagonal(dim1=-2, dim2=-1).sum(-1)
    median = trace.masked_fill(~used, torch.nan).nanmedian(-1, keepdim=True).values
    most = _MOST_WEIGHT * median.clamp(min=1e-300)
    pose = fit_rigid(model_m, observed_m, trace.clamp(max=most))

    # Gauss-Newton from there.
    for _ in range(_STEPS):
        moved_m = pose.apply(model_m)
        weighted, H = _linearise_motion(moved_m, information)
        gradient = (weighted @ (observed_m - moved_m)[..., None]).sum(-3).squeeze(-1)
        motion = torch.linalg.solve(H, gradient)
        pose = Rigid(rotation_by(motion[..., :3]), motion[..., 3:]) @ pose

    # Covariance and residual of the last pose.
    moved_m = pose.apply(model_m)
    _, H = _linearise_motion(moved_m, information)
    error_m = moved_m - observed_m
    mean_square_m2 = (error_m.square().sum(-1) * used).sum(-1) / used.sum(-1)
    return PoseFit(
        camera_from_model=Rigid(pose.R.to(keypoints_m), pose.t_m.to(keypoints_m)),
        covariance=torch.linalg.inv(H).to(keypoints_m),
        residual_m=mean_square_m2.sqrt().to(keypoints_m),
        inlier_share=used.to(keypoints_m).mean(-1),
    )


def _linearise_motion(
    moved_m: Float64[Tensor, "*batch k 3"], information: Float64[Tensor, "*batch k 3 3"]
) -> tuple[Float64[Tensor, "*batch k 6 3"], Float64[Tensor, "*batch 6 6"]]:
    """Compute ``J^T C^-1`` of each keypoint, and ``sum J^T C^-1 J``, by left perturbations.

    Args:
        moved_m: keypoints of the model at the pose.
        information: ``C^-1`` of each observed keypoint.
    """
    eye = torch.eye(3).to(moved_m).expand(*moved_m.shape, 3)
    J = torch.cat([-cross_matrix(moved_m), eye], -1)
    weighted = J.mT @ information
    return weighted, (weighted @ J).sum(-3)


def find_consistent_keypoints(
    keypoints_m: Float[Tensor, "*batch k 3"],
    model_keypoints_m: Float[Tensor, "k 3"],
    tolerance_m: float,
    is_considered: Bool[Tensor, "*batch k"] | None = None,
) -> Bool[Tensor, "*batch k"]:
    """Remove keypoints until all pairs that remain have the distance of the model.

    In each round the keypoint in most inconsistent pairs is removed; of equals the one with the
    larger sum of errors. Keypoints that are wrong by a common motion pass this test, unless they
    are in the minority.

    Args:
        keypoints_m: observed.
        model_keypoints_m: in any frame, for distances alone count.
        tolerance_m: largest difference of a distance.
        is_considered: keypoints to begin with; None: all.

    Returns:
        Whether each keypoint remains; three or more fix a pose.
    """
    # By how much the distance of each pair is off.
    distance_m = _measure_pairs(keypoints_m)
    model_distance_m = _measure_pairs(model_keypoints_m.to(keypoints_m))
    errors_m = (distance_m - model_distance_m).abs()
    count = keypoints_m.shape[-2]
    remains = torch.ones(keypoints_m.shape[:-1], dtype=torch.bool, device=keypoints_m.device)
    remains = remains if is_considered is None else is_considered.clone()

    # Errors decide ties: they are capped, so that all of a keypoint weigh less than one pair.
    severity = (errors_m / tolerance_m).clamp(max=_MOST_SEVERITY) / (2 * _MOST_SEVERITY * count)
    for _ in range(count):
        is_pair = remains[..., :, None] & remains[..., None, :]
        is_inconsistent = is_pair & (errors_m > tolerance_m)
        blame = (is_inconsistent * (1 + severity)).sum(-1)
        is_worst = torch.nn.functional.one_hot(blame.argmax(-1), count).bool()
        remains = remains & ~(is_worst & is_inconsistent.any((-1, -2))[..., None])
    return remains


def _measure_pairs(points_m: Float[Tensor, "*batch k 3"]) -> Float[Tensor, "*batch k k"]:
    """Measure the distance of every pair of points."""
    return (points_m[..., :, None, :] - points_m[..., None, :, :]).norm(dim=-1)
