"""Why a pose that was found is withheld: its risk, what is not observable, another shape."""

import math
from dataclasses import replace
from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor

from depthpose.core.rigid import Rigid
from depthpose.pose.config import RefusalConfig
from depthpose.pose.estimator.evidence import LATE, observability
from depthpose.pose.estimator.mirror import mirror_gain
from depthpose.pose.estimator.outline import overhang, shortfall
from depthpose.pose.estimator.prepare import Prepared, Refusal
from depthpose.pose.estimator.refusal import reason_of, risk_of
from depthpose.pose.estimator.scale import Scale, scale_of
from depthpose.pose.estimator.scene import seen_through
from depthpose.pose.mesh import is_mirror_alike
from depthpose.pose.surface import Surface
from depthpose.pose.types import ObjectModel

_MIRRORED = 0.02
"""Gain from which a cloud is that of a mirrored copy, 0.1 % of the diameter: of right answers for
synthetic views it was at most 0.004, where the mirror image is not nearly the model."""


_UNREFINED = 0.1
"""Share of the largest risk that a pose without ICP may have, where the limit counts on signals
that only ICP gives: at the whole limit a fifth of such answers was wrong at 20 % occlusion, at this
share less than 1 % (``bench/synthetic_linemod.py``)."""


class Posed(NamedTuple):
    """A cloud and the pose that was found for it; ``free``: the motions that symmetries allow."""

    cloud: Prepared
    pose: Rigid
    model: ObjectModel
    surface: Surface
    free: Float[Tensor, "m 6"]


def find_refusal(
    posed: Posed, signals: dict[str, float], config: RefusalConfig, *, with_icp: bool
) -> Refusal | None:
    """Say why a pose is withheld; None where there is no evidence against it.

    What a depth image shows about the object and signals that take long are measured here, and
    added to ``signals``.

    Args:
        posed: the pose.
        signals: the evidence against it.
        config: the limits.
        with_icp: whether ICP refined it; else neither its size nor its mirror image is tested.
    """
    if not with_icp and not config.slopes.keys().isdisjoint(LATE):
        config = replace(config, max_risk=_UNREFINED * config.max_risk)
    if posed.cloud.view is not None:
        signals["through"] = seen_through(posed.cloud.view, posed.pose, posed.surface)
    least = {**signals, **dict.fromkeys(LATE, 0.0)}
    found = refuse_risky(least, signals, config) or _not_observable(posed, config)
    if found is None and with_icp and config.max_scale_error < 1:
        found = _other_shape(posed, signals, config)
    return found or refuse_risky(signals, signals, config)


def refuse_risky(
    signals: dict[str, float], named: dict[str, float], config: RefusalConfig
) -> Refusal | None:
    """Refuse a risk above the limit; ``named`` are the signals that the reason is made of.

    A signal that was not measured counts as is usual for right answers.
    """
    risk, said = risk_of(signals, config), risk_of(named, config)
    if risk is None or said is None or risk <= config.max_risk:
        return None
    return Refusal(status="doubtful", reason=reason_of(named, said, config), risk=risk)


def _not_observable(posed: Posed, config: RefusalConfig) -> Refusal | None:
    observable, motion = observability(posed.cloud.cloud_m, posed.pose, posed.surface, posed.free)
    if observable >= config.min_hold:
        return None
    turn = float(motion[:3].norm())
    what = "turn" if turn > math.sqrt(0.5) else "shift"
    return Refusal(
        status="not observable",
        reason=f"the seen part of the object leaves one {what} undetermined: it moves the surface "
        f"along its normals by {observable:.1%} of the motion only; no declared symmetry allows "
        "it. Declare the symmetry, or look from a side that shows more",
    )


def _other_shape(posed: Posed, signals: dict[str, float], config: RefusalConfig) -> Refusal | None:
    """Fit another size and the mirror image, and name what fits better than the object itself.

    How far cloud and silhouette reach beyond each other is measured for the risk.
    """
    scale = scale_of(posed.cloud.cloud_m, posed.pose, posed.surface)
    is_alike = is_mirror_alike(posed.model)
    mirror = 0.0 if is_alike else mirror_gain(posed.cloud.cloud_m, posed.pose, posed.surface)
    signals["scale"], signals["size"] = scale.times, scale.doubt
    signals["grown"], signals["mirror"] = max(0.0, scale.gain), max(0.0, mirror)
    seen = (posed.cloud.cloud_m, posed.pose, posed.surface)
    signals["overhang"] = overhang(*seen)
    if posed.cloud.view is not None:
        signals["shortfall"] = shortfall(posed.cloud.view, *seen)
    reasons = [_other_size(scale, config), _mirrored(mirror)]
    if mirror > scale.gain:
        reasons.reverse()
    return reasons[0] or reasons[1]


def _other_size(scale: Scale, config: RefusalConfig) -> Refusal | None:
    if scale.error <= config.max_scale_error:
        return None
    return Refusal(
        status="doubtful",
        reason=f"the cloud fits the object best at {scale.times:.2f} times its size (standard "
        f"deviation {scale.sigma:.2f}), and {config.max_scale_error:.0%} are allowed: a copy of "
        "another size, another object, or a wrong unit or camera",
    )


def _mirrored(gain: float) -> Refusal | None:
    if gain <= _MIRRORED:
        return None
    return Refusal(
        status="doubtful",
        reason=f"the cloud fits the mirror image better (by {gain:.2g} of the distance up to "
        "which a point is near): a mirrored copy, another object, or a camera whose x or y axis "
        "points the other way",
    )
