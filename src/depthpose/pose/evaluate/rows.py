"""The rows of an evaluation, each with its columns in order.

With what they depend on: the list of instances, the diameters, and which of the two ADDs.
"""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from depthpose.pose.evaluate.errors import METRICS, Errors

Number = float | None


@dataclass(frozen=True, kw_only=True)
class Origin:
    """Whose predictions a row measures; the first columns of its row.

    Attributes:
        method: its name.
        masks: kind of masks that it was given.
        weights: file or name, where it has any.
        weights_sha256: its first digits; of a file of predictions by others the file's own.
    """

    method: str
    masks: str = ""
    weights: str = ""
    weights_sha256: str = ""


@dataclass(frozen=True, kw_only=True)
class Conditions:
    """What a number cannot be compared without; the last columns of its row.

    Attributes:
        diameters: whose table of diameters.
        frames: data set and split.
        frames_sha256: first digits of :func:`frames_hash`.
    """

    diameters: str
    frames: str
    frames_sha256: str


@dataclass(frozen=True, kw_only=True, eq=False)
class InstanceRow:
    """One instance and the errors of its estimate.

    Attributes:
        instance: its name.
        object: name of its model.
        status: of the estimate; ``missing`` where there is none.
        is_success: whether ADD (ADD-S of a symmetric object) is below a tenth of the diameter.
        score: of the answer, larger is surer.
        visible_fraction: share of the silhouette that is seen, where it is given.
        truth: ``annotated``, or ``fitted`` to the same depth.
        diameter_m: of the table that was asked for.
        metric: ``ADD`` or ``ADD-S``.
        errors: by the names of ``METRICS``; what is not measured is left out.
        ms: milliseconds of each stage and in ``total``; None where it has not run.
        reason: of a refusal.
        origin: whose estimate it is.
    """

    instance: str
    object: str
    status: str
    is_success: bool
    score: Number
    visible_fraction: Number
    truth: str
    diameter_m: float
    metric: str
    errors: Mapping[str, Errors]
    ms: Mapping[str, Number]
    reason: str
    origin: Origin | None = None

    def error(self, name: str) -> Number:
        """Give an error by its name, or None where it is not measured or infinite."""
        if name not in self.errors:
            return None
        mean = float(self.errors[name].mean())
        return mean if math.isfinite(mean) else None

    def columns(self) -> dict[str, Any]:
        """Give the columns of a table, in its order."""
        return {
            **_method_of(self.origin),
            "instance": self.instance,
            "object": self.object,
            "status": self.status,
            "is_success": self.is_success,
            "score": self.score,
            "visible_fraction": self.visible_fraction,
            "truth": self.truth,
            "diameter_m": self.diameter_m,
            "metric": self.metric,
            **{name: self.error(name) for name in METRICS},
            **_times(self.ms),
            "reason": self.reason,
        }


@dataclass(frozen=True, kw_only=True)
class ObjectRow:
    """The instances of an object, the ``mean`` of objects, or ``all`` instances.

    Attributes:
        object: what the row is called.
        instances: how many.
        annotated: how many of them have a pose that was annotated, not fitted.
        success: share of instances.
        refused: share of instances without an answer.
        wrong: share of instances with an answer that is no success.
        coverage: share of instances with an answer.
        scores: the summaries of ``METRICS``, ``ar`` and medians; None where not measured.
        ms: mean milliseconds of each stage and in ``total``.
        metric: ``ADD`` or ``ADD-S``, where it is of one object.
        diameter_m: the same.
        conditions: of the evaluation.
        origin: whose estimates they are.
    """

    object: str
    instances: int
    annotated: int
    success: float
    refused: float
    wrong: float
    coverage: float
    scores: Mapping[str, Number]
    ms: Mapping[str, Number]
    metric: str | None = None
    diameter_m: float | None = None
    conditions: Conditions | None = None
    origin: Origin | None = None

    def columns(self) -> dict[str, Any]:
        """Give the columns of a table, in its order."""
        found: dict[str, Any] = {} if self.origin is None else asdict(self.origin)
        found |= {
            "object": self.object,
            "instances": self.instances,
            "annotated": self.annotated,
            "success": self.success,
            "refused": self.refused,
            "wrong": self.wrong,
            "coverage": self.coverage,
            **self.scores,
            **_times(self.ms),
        }
        if self.metric is not None:
            found |= {"metric": self.metric, "diameter_m": self.diameter_m}
        return found | ({} if self.conditions is None else asdict(self.conditions))


@dataclass(frozen=True, kw_only=True)
class RiskRow:
    """How many answers are wrong if only the surest are given.

    Attributes:
        coverage: share of all instances that is answered.
        answers: their number.
        least_score: of the least sure of them.
        risk: share of wrong ones among them.
        conditions: of the evaluation.
        origin: whose estimates they are.
    """

    coverage: float
    answers: int
    least_score: Number
    risk: float
    conditions: Conditions | None = None
    origin: Origin | None = None

    def columns(self) -> dict[str, Any]:
        """Give the columns of a table, in its order."""
        return {
            **_method_of(self.origin),
            "coverage": self.coverage,
            "answers": self.answers,
            "least_score": self.least_score,
            "risk": self.risk,
            **({} if self.conditions is None else asdict(self.conditions)),
        }


def _method_of(origin: Origin | None) -> dict[str, Any]:
    return {} if origin is None else {"method": origin.method, "masks": origin.masks}


def _times(ms: Mapping[str, Number]) -> dict[str, Any]:
    return {f"ms_{stage}": value for stage, value in ms.items()}
