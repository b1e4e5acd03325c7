"""Lines to the point where they meet, how sure it is, and how badly it is posed.

Inside, coordinates lie before points, ``(..., k, 3, n)``: every pass then runs along memory.
"""

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from depthpose.core.errors import InputError
from depthpose.pose.compiled import serves
from depthpose.pose.types import Vote

_SMALLEST = 1e-12
_NEAREST = 0.1
"""Points nearer to a keypoint than this share of the mean distance weigh no more: a point on the
keypoint would outweigh all others, and its direction means nothing."""

Lines = tuple[Tensor, Tensor, Tensor]
"""Points (..., 1, 3, n) about their mean, unit directions (..., k, 3, n), weights (..., k, n)."""


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
    """Turn coordinates before points, about the points' mean, with unit directions.

    Raises:
        InputError: fewer than two lines of a keypoint have weight.
    """
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
    return (local, n, w), centre_m


def meet_prepared(lines: Lines, centre_m: Float[Tensor, "*batch 1 3"], refinements: int) -> Vote:
    """Do as :func:`meet_lines` does, for what :func:`prepare_lines` gave."""
    w = lines[2]
    if _is_single(lines):
        from depthpose.pose.compiled.vote import met

        p, covariance, condition = met(lines, refinements, _NEAREST)
        every = torch.ones(len(w), dtype=w.dtype)
        return Vote(
            keypoints_m=p + centre_m, covariance_m2=covariance, condition=condition,
            inlier_share=every,
        )  # fmt: skip
    A, p = _nearest(lines)
    condition = _condition(A)
    gradient = None
    for _ in range(refinements):
        A, gradient = _score(lines, p)
        p = p + _short_step(A, gradient.sum(-1).double(), lines[0], p)
    if refinements == 0:
        gradient = _nearest_gradient(lines, p)
    assert gradient is not None
    covariance = _sandwich(A, gradient, (w > 0).sum(-1))
    total = w.sum(-1)
    return Vote(
        keypoints_m=p.to(centre_m) + centre_m,
        covariance_m2=covariance.to(centre_m),
        condition=condition.to(centre_m),
        inlier_share=torch.ones_like(total),
    )


def locate(lines: Lines, refinements: int) -> Float64[Tensor, "*b k 3"]:
    """Give the point alone, about the points' mean, without its covariance."""
    if _is_single(lines):
        from depthpose.pose.compiled.vote import met

        return met(lines, refinements, _NEAREST)[0]
    _, p = _nearest(lines)
    for _ in range(refinements):
        A, gradient = _score(lines, p)
        p = p + _short_step(A, gradient.sum(-1).double(), lines[0], p)
    return p


def _is_single(lines: Lines) -> bool:
    """Whether compiled functions serve: one object, on the processor, in float64."""
    n = lines[1]
    return n.ndim == 3 and n.dtype == torch.float64 and serves(*lines)


def _nearest(lines: Lines) -> tuple[Float64[Tensor, "*b k 3 3"], Float64[Tensor, "*b k 3"]]:
    local, n, w = lines
    wn = n * w[..., None, :]
    along = (n * local).sum(-2, keepdim=True)
    total = w.sum(-1).double()[..., None, None]
    A = total * torch.eye(3, dtype=torch.float64, device=n.device) - (wn @ n.mT).double()
    b = (local @ w[..., None]) - wn @ along.mT
    # Over the sum of weights, the damping is a pure number.
    A, b = A / total, b.double() / total
    return A, torch.linalg.solve(_damped(A), b).squeeze(-1)


def _nearest_gradient(lines: Lines, p: Tensor) -> Float[Tensor, "*b k 3 n"]:
    local, n, w = lines
    offset = p.to(n)[..., None] - local
    rest = offset - n * (n * offset).sum(-2, keepdim=True)
    return rest * (w / w.sum(-1, keepdim=True))[..., None, :]


def _score(
    lines: Lines, p: Tensor
) -> tuple[Float64[Tensor, "*b k 3 3"], Float[Tensor, "*b k 3 n"]]:
    """Give the information matrix, and the gradient of each line, over the sum of weights."""
    local, n, w = lines
    offset = p.to(n)[..., None] - local
    reach = offset.square().sum(-2).sqrt_()
    scale = reach.mean(-1, keepdim=True).clamp(min=_SMALLEST)
    q = offset / reach.clamp(min=_SMALLEST)[..., None, :]
    reach = torch.maximum(reach, _NEAREST * scale)
    cosine = (n * q).sum(-2)
    pull = w / reach
    pull = pull / w.sum(-1, keepdim=True)
    gradient = (n - q * cosine[..., None, :]) * pull[..., None, :]
    # Outliers may not turn the matrix negative: each line counts as half at least.
    amount = pull / reach * cosine.clamp(min=0.5)
    outer = ((q * amount[..., None, :]) @ q.mT).double()
    eye = torch.eye(3, dtype=torch.float64, device=n.device)
    return amount.sum(-1).double()[..., None, None] * eye - outer, gradient


def _short_step(A: Tensor, gradient: Tensor, local: Tensor, p: Tensor) -> Float64[Tensor, "*b k 3"]:
    """Solve for the step, and keep it within the distance of the keypoint to the points."""
    step = torch.linalg.solve(_damped(A), gradient[..., None]).squeeze(-1)
    spread = local.square().sum(-2).mean(-1).double()
    limit = (p.square().sum(-1) + spread).sqrt()
    return step * (limit / step.norm(dim=-1).clamp(min=_SMALLEST)).clamp(max=1.0)[..., None]


def _sandwich(A: Tensor, gradient: Tensor, votes: Tensor) -> Float64[Tensor, "*b k 3 3"]:
    inverse = torch.linalg.inv(_damped(A))
    # n lines of rank 2 fix 3 unknowns: few lines look surer than they are.
    spare = (2 * votes.double() / (2 * votes - 3).clamp(min=1))[..., None, None]
    return spare * (inverse @ (gradient @ gradient.mT).double() @ inverse)


def _condition(A: Float64[Tensor, "*b k 3 3"]) -> Float64[Tensor, "*b k"]:
    values = torch.linalg.eigvalsh(A)
    # Of a trace of 2, what lies below is the rounding of float32 sums.
    is_real = values[..., 0] > 1e-7
    return torch.where(is_real, values[..., 2] / values[..., 0].clamp(min=1e-7), torch.inf)


def _damped(A: Float64[Tensor, "*b k 3 3"]) -> Float64[Tensor, "*b k 3 3"]:
    """Keep parallel lines solvable: their point stays near the mean of the points."""
    size = A.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None].clamp(min=1e-300)
    return A + 1e-12 * size * torch.eye(3, dtype=A.dtype, device=A.device)
