"""Directions to keypoints to a pose: least squares, RANSAC, rigidity, Kabsch, covariances."""

import math
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from depthpose.core.errors import InputError
from depthpose.core.rigid import Rigid, cross_matrix, fit_rigid, rotation_by
from depthpose.pose.config import EstimateConfig, VotingConfig
from depthpose.pose.types import ObjectModel, PoseFit, Refusal, Vote

_SMALLEST = 1e-12
_NEAREST = 0.1
"""Points nearer to a keypoint than this share of the mean distance weigh no more: a point on the
keypoint would outweigh all others, and its direction means nothing."""


class Lines(NamedTuple):
    """Lines through points about their mean, of unit directions; a weight of 0 leaves one out."""

    points: Float[Tensor, "*batch 1 3 n"]
    directions: Float[Tensor, "*batch k 3 n"]
    weights: Float[Tensor, "*batch k n"]


def meet_lines(
    points_m: Float[Tensor, "*batch n 3"],
    directions: Float[Tensor, "*batch n k 3"],
    weight: Float[Tensor, "*batch n k"] | None = None,
    refinements: int = 3,
) -> Vote:
    """Find for each keypoint the point where the lines ``x_i + s n_i`` meet best.

    First the point nearest to all of them, ``(sum w (I - n n^T)) p = sum w (I - n n^T) x``. It is
    biased toward the points: the noise of ``n`` enters both sides. Each refinement is then a step
    of Fisher scoring to the largest ``sum w n . q`` with ``q = (p - x) / |p - x|``, the most
    likely point when directions err by angles (von Mises-Fisher). Its expected gradient is zero at
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

    Raises:
        InputError: fewer than two lines of a keypoint have weight.
    """
    lines, centre_m = prepare_lines(points_m, directions, weight)
    return meet_prepared(lines, centre_m, refinements)


def prepare_lines(
    points_m: Float[Tensor, "*batch n 3"],
    directions: Float[Tensor, "*batch n k 3"],
    weight: Float[Tensor, "*batch n k"] | None,
) -> tuple[Lines, Float[Tensor, "*batch 1 3"]]:
    """Turn coordinates before points, about the points' mean, with unit directions."""
    centre_m = points_m.mean(-2, keepdim=True)
    local = (points_m - centre_m).mT[..., None, :, :].contiguous()
    n = directions.movedim(-3, -1).contiguous()
    lengths = n.square().sum(-2).sqrt_()
    w = (lengths > _SMALLEST).to(n)
    n = n / lengths.clamp_(min=_SMALLEST)[..., None, :]
    w = w if weight is None else w * weight.mT
    least = int((w > 0).sum(-1).min()) if w.numel() else 0
    if least < 2:
        raise InputError(
            f"voting: {least} directions of some keypoint carry weight, but two lines at least "
            "fix a point. Give more points or a positive weight to more of them."
        )
    return Lines(local, n, w), centre_m


def meet_prepared(lines: Lines, centre_m: Float[Tensor, "*batch 1 3"], refinements: int) -> Vote:
    """Do as :func:`meet_lines` does, for what :func:`prepare_lines` gave."""
    local, n, w = lines
    all_count = torch.ones_like(w[..., 0])
    along, total = (n * local).sum(-2, keepdim=True), w.sum(-1).double()[..., None, None]
    wn, eye = n * w[..., None, :], torch.eye(3, dtype=torch.float64, device=n.device)
    # Over the sum of weights, the damping is a pure number.
    A = (total * eye - (wn @ n.mT).double()) / total
    b = (local @ w[..., None] - wn @ along.mT).double() / total
    p = torch.linalg.solve(_damped(A), b).squeeze(-1)
    values = torch.linalg.eigvalsh(A)
    # Of a trace of 2, what lies below is the rounding of float32 sums.
    is_real = values[..., 0] > 1e-7
    condition = torch.where(is_real, values[..., 2] / values[..., 0].clamp(min=1e-7), torch.inf)
    offset = p.to(n)[..., None] - local
    gradient = offset - n * (n * offset).sum(-2, keepdim=True)
    gradient = gradient * (w / w.sum(-1, keepdim=True))[..., None, :]
    for _ in range(refinements):
        # The information matrix, and the gradient of each line, over the sum of weights.
        offset = p.to(n)[..., None] - local
        distance = offset.square().sum(-2).sqrt_()
        scale = distance.mean(-1, keepdim=True).clamp(min=_SMALLEST)
        q = offset / distance.clamp(min=_SMALLEST)[..., None, :]
        distance = torch.maximum(distance, _NEAREST * scale)
        cosine = (n * q).sum(-2)
        pull = w / distance / w.sum(-1, keepdim=True)
        gradient = (n - q * cosine[..., None, :]) * pull[..., None, :]
        # Outliers may not turn the matrix negative: each line counts as half at least.
        amount = pull / distance * cosine.clamp(min=0.5)
        outer = ((q * amount[..., None, :]) @ q.mT).double()
        A = amount.sum(-1).double()[..., None, None] * eye - outer
        step = torch.linalg.solve(_damped(A), gradient.sum(-1).double()[..., None]).squeeze(-1)
        # Within the distance of the keypoint to the points.
        spread = local.square().sum(-2).mean(-1).double()
        limit = (p.square().sum(-1) + spread).sqrt()
        p = p + step * (limit / step.norm(dim=-1).clamp(min=_SMALLEST)).clamp(max=1.0)[..., None]
    inverse, votes = torch.linalg.inv(_damped(A)), (w > 0).sum(-1)
    # n lines of rank 2 fix 3 unknowns: few lines look surer than they are.
    spare = (2 * votes.double() / (2 * votes - 3).clamp(min=1))[..., None, None]
    covariance = spare * (inverse @ (gradient @ gradient.mT).double() @ inverse)
    return Vote(
        keypoints_m=p.to(centre_m) + centre_m,
        covariance_m2=covariance.to(centre_m),
        condition=condition.to(centre_m),
        inlier_share=all_count,
    )


def _damped(A: Float64[Tensor, "*b k 3 3"]) -> Float64[Tensor, "*b k 3 3"]:
    """Keep parallel lines solvable: their point stays near the mean of the points."""
    size = A.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None].clamp(min=1e-300)
    return A + 1e-12 * size * torch.eye(3, dtype=A.dtype, device=A.device)


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
    # Pairs of two different votes of positive weight for each keypoint, on any device alike.
    w = lines.weights
    counts = (w > 0).sum(-1, keepdim=True)
    generator = torch.Generator().manual_seed(config.seed)
    shape = (2, *counts.shape[:-1], config.hypotheses)
    draws = torch.rand(shape, generator=generator, dtype=torch.float64).to(w.device)
    first = (draws[0] * counts).long()
    # A step of 1 .. count - 1 further round never comes back to the first.
    second = (first + 1 + (draws[1] * (counts - 1)).long()) % counts
    if int(counts.min()) < w.shape[-1]:
        voters = (w > 0).to(torch.uint8).argsort(dim=-1, descending=True, stable=True)
        first, second = voters.gather(-1, first), voters.gather(-1, second)
    # The middle of the common perpendicular of each pair, where they cross.
    wide = (*first.shape[:-1], 3, first.shape[-1])
    x1, x2, n1, n2 = (
        values.expand_as(lines.directions).gather(-1, index[..., None, :].expand(wide))
        for values in (lines.points, lines.directions)
        for index in (first, second)
    )
    gap = x1 - x2
    cosine = (n1 * n2).sum(-2, keepdim=True)
    d, e = (n1 * gap).sum(-2, keepdim=True), (n2 * gap).sum(-2, keepdim=True)
    sine_squared = 1 - cosine * cosine
    is_crossing = sine_squared > _PARALLEL
    scale = torch.where(is_crossing, sine_squared, 1)
    is_crossing = is_crossing.squeeze(-2)
    on_first = x1 + n1 * ((cosine * e - d) / scale)
    on_second = x2 + n2 * ((e - cosine * d) / scale)
    tried = ((on_first + on_second) / 2).mT
    inlier_test = InlierTest(lines, config)
    # Parallel pairs propose nothing, yet score 0 so that one always wins.
    best = torch.where(is_crossing, inlier_test.score(tried), 0).argmax(-1)[..., None, None]
    keypoint = tried.gather(-2, best.expand(*best.shape[:-1], 3))
    # Once toward what the best hypothesis gathered, then with those that agree on that.
    for steps in (min(config.refinements, 1), config.refinements):
        agreeing = inlier_test.agree(keypoint).squeeze(-2) * w
        is_enough = (agreeing > 0).sum(-1, keepdim=True) >= 3
        # Where fewer agree than fix a point with its covariance all votes are used, the share is 0.
        share = torch.where(is_enough, agreeing, 0).sum(-1) / w.sum(-1)
        used = lines._replace(weights=torch.where(is_enough, agreeing, w))
        vote = meet_prepared(used, torch.zeros_like(centre_m), steps)
        keypoint = vote.keypoints_m[..., None, :]
    return replace(vote, keypoints_m=vote.keypoints_m + centre_m, inlier_share=share)


class InlierTest:
    """Says which lines agree with which hypotheses.

    Both tests compare polynomials in the hypothesis h, and so are two products of matrices:
    ``along = n . (h - x)`` and ``range^2 = |h|^2 - 2 h . x + |x|^2``. By angle a line agrees when
    ``along > cos range``, so that a vote that points away does not; by distance when ``range^2 -
    along^2 < limit^2``, whatever the sense of the vote (published practice).
    """

    def __init__(self, lines: Lines, config: VotingConfig) -> None:
        local, n, w = lines
        self._limit = config.max_distance_m**2 if config.inlier_test == "distance" else None
        along = torch.cat([n, -(n * local).sum(-2, keepdim=True)], -2)
        square = local.square().sum(-2, keepdim=True)
        far = torch.cat([-2 * local, torch.ones_like(square), square], -2)
        # The scale of the test goes into the small factor, not into the large product.
        far = far * (config.min_cosine**2 if self._limit is None else 1.0)
        # Keypoints and objects are alike here: one axis.
        self._along = along.detach().flatten(0, -3)
        self._far = far.detach().expand(*n.shape[:-2], *far.shape[-2:]).flatten(0, -3)
        self._w = w.detach().flatten(0, -2)[:, None]
        self._is_weighted = not bool((w == 1).all())

    @torch.no_grad()
    def score(self, tried: Float[Tensor, "*batch k h 3"]) -> Float[Tensor, "*batch k h"]:
        """Add up the weight of the lines that agree with each hypothesis."""
        flat, n = tried.flatten(0, -3), self._w.shape[-1]
        lines, rows = flat.shape[:2]
        if tried.device.type == "cpu":
            rows = max(1, min(rows, _BLOCK // (lines * n)))
        memory = tried.new_empty(2, lines * rows * n)
        scores = tried.new_empty(flat.shape[:-1])
        for part in range(0, flat.shape[1], rows):
            agreed = self.agree(flat[:, part : part + rows], memory)
            agreed = agreed.mul_(self._w) if self._is_weighted else agreed
            scores[:, part : part + rows] = agreed.sum(-1)
        return scores.view(tried.shape[:-1])

    @torch.no_grad()
    def agree(
        self, tried: Float[Tensor, "*batch k h 3"], memory: Tensor | None = None
    ) -> Float[Tensor, "*batch k h n"]:
        """Give 1 where a line agrees with a hypothesis, else 0; the answer lies in ``memory``."""
        flat = tried.detach().flatten(0, -3)
        square, ones = flat.square().sum(-1, keepdim=True), torch.ones_like(flat[..., :1])
        shape = (*flat.shape[:2], self._w.shape[-1])
        size = math.prod(shape)
        memory = tried.new_empty(2, size) if memory is None else memory
        along, far = (part[:size].view(shape) for part in memory)
        torch.bmm(torch.cat([flat, ones], -1), self._along, out=along)
        torch.bmm(torch.cat([flat, square, ones], -1), self._far, out=far)
        if self._limit is not None:
            agreed = far.addcmul_(along, along, value=-1).lt_(self._limit)
        else:  # what points away reaches nothing, and no square is below its own share
            agreed = far.addcmul_(along.clamp_(min=0), along, value=-1).lt_(0)
        return agreed.view(*tried.shape[:-1], shape[-1])


_LEAST = 4  # keypoints that must agree: three fix a pose with nothing left to contradict it
_STEPS = 4  # Gauss-Newton from Kabsch: the fourth step is below float64's noise


def fits_of(vote: Vote, model: ObjectModel, config: EstimateConfig) -> PoseFit | Refusal:
    """Fit the keypoints that agree; where ICP refines the fits, also all of them.

    Returns:
        One fit or two as a batch; or why there is none.
    """
    is_intersection = (vote.condition <= config.voting.max_condition) & (vote.inlier_share > 0)
    total = len(is_intersection)
    met = int(is_intersection.sum())
    if met < _LEAST:
        return Refusal(
            status="votes do not meet",
            reason=f"the directions meet at {met} of {total} keypoints, but {_LEAST} are "
            "needed: too few points, or not the object that the mask promises",
        )
    strict, rough = config.voting.rigidity_diameters, config.rough_rigidity_diameters
    limit_m = model.diameter_m * (rough if config.with_icp else strict)
    used = consistent_keypoints(vote.keypoints_m, model.keypoints_m, limit_m, is_intersection)
    choices = [used] if int(used.sum()) >= _LEAST else []
    if config.with_icp and not torch.equal(used, is_intersection):
        choices.append(is_intersection)
    if not choices:
        return Refusal(
            status="keypoints do not fit",
            reason=f"{int(used.sum())} of {total} keypoints have the model's distances within "
            f"{limit_m:.2g} m, but {_LEAST} are needed: another object, or too much of it occluded",
        )
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
    """Carry the model's keypoints onto the found ones.

    Begins with the weighted Kabsch fit, weights one over each covariance's trace, then minimises
    ``sum e^T C^-1 e`` with ``e = R m + t - p`` over left perturbations. A vote is far surer across
    its lines than along them, which one weight a keypoint cannot say. The covariance of the pose is
    the inverse of ``sum J^T C^-1 J`` with ``J = [-[R m + t]_x, I]``.

    Args:
        keypoints_m: found, in the camera frame.
        covariance_m2: of each; a lower bound keeps exact keypoints finite.
        model_keypoints_m: known, in the model frame.
        is_used: which count; None: all. Three at least, not on a line.

    Raises:
        InputError: fewer than three keypoints are used.
    """
    found, model = keypoints_m.double(), model_keypoints_m.double()
    model = model.expand_as(found)
    used = torch.ones_like(found[..., 0], dtype=torch.bool) if is_used is None else is_used
    # No keypoint is known better than a millionth of the object, whatever its votes say.
    spread = (model - model.mean(-2, keepdim=True)).square().sum(-1).mean(-1)
    floor = (1e-12 * spread)[..., None, None, None] * torch.eye(3).to(model)
    information = torch.linalg.inv(covariance_m2.double() + floor) * used[..., None, None]
    trace = information.diagonal(dim1=-2, dim2=-1).sum(-1)
    # One keypoint that looks exact must not decide alone; a rotation takes three.
    most = 100 * trace.median(-1, keepdim=True).values.clamp(min=1e-300)
    pose = fit_rigid(model, found, trace.clamp(max=most))
    moved_m, eye = pose.apply(model), torch.eye(3).to(model).expand(*model.shape, 3)
    steps = 0
    while True:
        # The information matrix of (rotation, translation), and the right side.
        J = torch.cat([-cross_matrix(moved_m), eye], -1)
        weighted = J.mT @ information
        H = (weighted @ J).sum(-3)
        if steps == _STEPS:
            break
        pull = (weighted @ (found - moved_m)[..., None]).sum(-3).squeeze(-1)
        motion = torch.linalg.solve(H, pull)
        pose = Rigid(rotation_by(motion[..., :3]), motion[..., 3:]) @ pose
        moved_m = pose.apply(model)
        steps += 1
    error_m = moved_m - found
    square = (error_m.square().sum(-1) * used).sum(-1) / used.sum(-1)
    return PoseFit(
        camera_from_model=Rigid(pose.R.to(keypoints_m), pose.t_m.to(keypoints_m)),
        covariance=torch.linalg.inv(H).to(keypoints_m),
        residual_m=square.sqrt().to(keypoints_m),
    )


def consistent_keypoints(
    keypoints_m: Float[Tensor, "*batch k 3"],
    model_keypoints_m: Float[Tensor, "k 3"],
    tolerance_m: float,
    is_found: Bool[Tensor, "*batch k"] | None = None,
) -> Bool[Tensor, "*batch k"]:
    """Outvote keypoints until no pair of those that stay breaks its distance.

    In each round the keypoint in most broken pairs goes; of equals the one with the larger sum of
    errors. Two keypoints that are wrong together by a common motion cannot be distinguished from
    right ones by this test, except where they are in the minority.

    Args:
        keypoints_m: found.
        model_keypoints_m: known, in any frame: distances alone count.
        tolerance_m: by how much a distance may differ.
        is_found: those to begin with; None: all.

    Returns:
        Those that stay; three or more of them fix a pose.
    """
    found, known = (
        (points_m[..., :, None, :] - points_m[..., None, :, :]).norm(dim=-1)
        for points_m in (keypoints_m, model_keypoints_m.to(keypoints_m))
    )
    errors_m = (found - known).abs()
    count = keypoints_m.shape[-2]
    stays = torch.ones(keypoints_m.shape[:-1], dtype=torch.bool, device=keypoints_m.device)
    stays = stays if is_found is None else is_found.clone()
    # Errors beyond the limit decide ties: capped, so that they never weigh as much as a pair.
    severity = (errors_m / tolerance_m).clamp(max=100.0) / (200.0 * count)
    for _ in range(count):
        pairs = stays[..., :, None] & stays[..., None, :]
        broken = pairs & (errors_m > tolerance_m)
        blame = (broken * (1 + severity)).sum(-1)
        worst = torch.nn.functional.one_hot(blame.argmax(-1), count).bool()
        stays = stays & ~(worst & broken.any((-1, -2))[..., None])
    return stays
