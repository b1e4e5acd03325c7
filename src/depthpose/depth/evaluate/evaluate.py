"""Each frame measured, the means over frames, and the rows that hold them."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from depthpose.core.errors import InputError
from depthpose.core.frame import data_frame
from depthpose.depth.datasets import Dataset
from depthpose.depth.datasets import read_disparity as read_truth_disparity
from depthpose.depth.evaluate.frames import (
    NO_PREDICTION,
    Compared,
    Prepared,
    Protocol,
    compare_depth,
    compare_disparity,
    find_protocol,
    prepare,
)
from depthpose.depth.metrics import (
    METRICS,
    RANKING,
    Metric,
    error_by_decile,
    measure,
    score_confidence,
)
from depthpose.depth.predictions import EXPECTED

Cell = str | int | float
"""What a table holds."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """A row whose columns are its fields, in order.

    A field that is None is no column; a mapping is a column for each of its entries.
    """

    def columns(self) -> dict[str, Cell]:
        """Give the columns by name, as files and printed tables hold them."""
        found: dict[str, Cell] = {}
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, Mapping):
                found |= value
            elif value is not None:
                found[field.name] = value
        return found


@dataclass(frozen=True, kw_only=True)
class EvaluationRow(Row):
    """Numbers of one frame, their mean over frames (each counts the same), or one decile of it.

    Attributes:
        method: whose predictions were measured; None, as the next four: not known.
        input: which images it was given.
        speed: at which networks ran.
        weights: name of the file.
        weights_sha256: the first 12 digits.
        protocol: by which the frames were measured.
        dataset: its name.
        frame: of one frame, its name.
        cap_m: truth beyond it does not count; None for disparity.
        frames: how many a mean is over.
        pixels: that were compared, in all frames.
        coverage: share of the pixels with truth that have a prediction.
        confidence_decile: n, where the numbers are of the n-th tenth of the pixels, from the least
            sure (1) to the surest (10).
        metrics: what all frames with a predicted pixel have, in the order of
            ``depth.metrics.METRICS``, then those of the drawn view and of the confidence.
    """

    method: str | None = None
    input: str | None = None
    speed: str | None = None
    weights: str | None = None
    weights_sha256: str | None = None
    protocol: str
    dataset: str
    frame: str | None = None
    cap_m: float | None
    frames: int | None = None
    pixels: int | None = None
    coverage: float | None = None
    confidence_decile: int | None = None
    metrics: Mapping[str, float]


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """What evaluating one set of predictions gave.

    Attributes:
        rows: means over frames, one row for each cap.
        per_frame: one row for each frame and cap.
        deciles: mean error of the least sure tenth of each frame's pixels (1) to the surest (10),
            for predictions with a confidence.
        skipped: frames that do not count, each with the reason.
    """

    rows: list[EvaluationRow]
    per_frame: list[EvaluationRow]
    deciles: list[EvaluationRow]
    skipped: dict[str, str]

    def to_frame(self) -> Any:  # noqa: ANN401  pandas is no dependency
        """Give ``per_frame`` as a ``pandas.DataFrame``; the columns are those of its table.

        Raises:
            ImportError: pandas is not installed.
        """
        return data_frame(row.columns() for row in self.per_frame)


@dataclass(frozen=True, kw_only=True, eq=False)
class Measured:
    """One frame's numbers by one cap (None for disparity), and its error by decile."""

    frame: str
    cap_m: float | None
    pixels: int
    coverage: float
    metrics: Mapping[str, float]
    deciles: Float[Tensor, "10"] | None = None

    def to_values(self) -> dict[str, Any]:
        """Give it as JSON values, exactly."""
        cap = {} if self.cap_m is None else {"cap_m": self.cap_m}
        counts = {"pixels": self.pixels, "coverage": self.coverage}
        return {
            "row": {"frame": self.frame, **cap, **counts, **self.metrics},
            "deciles": None if self.deciles is None else self.deciles.tolist(),
        }

    @classmethod
    def from_values(cls, values: Mapping[str, Any]) -> "Measured":
        """Read what :meth:`to_values` gave."""
        row, deciles = dict(values["row"]), values["deciles"]
        return cls(
            frame=row.pop("frame"),
            cap_m=row.pop("cap_m", None),
            pixels=row.pop("pixels"),
            coverage=row.pop("coverage"),
            metrics=row,
            deciles=None if deciles is None else torch.tensor(deciles, dtype=torch.float64),
        )


def evaluate(
    dataset: Dataset,
    predictions: Path,
    protocol: str,
    caps_m: Sequence[float] = (80.0, 50.0),
    progress: Callable[[Sequence[int]], Iterable[int]] = iter,
) -> Evaluation:
    """Measure the predictions in a folder by a named protocol.

    Args:
        dataset: frames with truth; those without are listed as skipped.
        predictions: folder of ``NAME.disparity_px.npy`` (see ``predictions``).
        protocol: a key of ``PROTOCOLS``.
        caps_m: truth beyond a cap does not count and predictions are clamped to it; one row each.
        progress: wraps the sequence of frames, to show how far it is.

    Raises:
        InputError: an unknown protocol, a missing prediction, or no frame with truth.
    """
    found = {
        dataset.frames[index].name: measure_frame(dataset, index, predictions, protocol, caps_m)
        for index in progress(range(len(dataset)))
    }
    return summarise(dataset, protocol, found)


def measure_frame(
    dataset: Dataset, index: int, predictions: Path, protocol: str, caps_m: Sequence[float]
) -> list[Measured] | str:
    """Measure one frame by each cap, or say why it does not count.

    Raises:
        InputError: an unknown protocol, or a missing or damaged prediction.
    """
    rule = find_protocol(protocol)
    prepared = prepare(dataset, index, predictions, rule)
    if isinstance(prepared, str):
        return prepared
    if rule.truth == "disparity":
        by_cap = [_measure_disparity(prepared)]
    else:
        by_cap = [_measure_depth(prepared, rule, cap_m) for cap_m in caps_m]
    measured = [one for one in by_cap if one is not None]
    return measured or "no truth within the caps and the crop"


def summarise(
    dataset: Dataset, protocol: str, found: Mapping[str, list[Measured] | str]
) -> Evaluation:
    """Make the rows of a table of its frames, the same ones wherever they were measured.

    Args:
        dataset: whose order of frames counts.
        protocol: by which they were measured.
        found: of each frame's name what :func:`measure_frame` gave.

    Raises:
        InputError: no frame has truth.
    """
    rule = find_protocol(protocol)
    each = {frame.name: found[frame.name] for frame in dataset.frames}
    skipped = {name: why for name, why in each.items() if isinstance(why, str)}
    measured = [one for some in each.values() if not isinstance(some, str) for one in some]
    if not measured and NO_PREDICTION in skipped.values():
        name = next(name for name, why in skipped.items() if why == NO_PREDICTION)
        raise InputError(
            f"{dataset.name}: no frame has both truth and a prediction; {name!r} has the truth and "
            f"{NO_PREDICTION}. Predictions are called {EXPECTED}"
        )
    if not measured:
        raise InputError(
            f"{dataset.name}: none of its {len(dataset)} frames has the truth that protocol "
            f"{protocol!r} needs ({rule.truth}). Choose another protocol or folder."
        )
    row = partial(EvaluationRow, protocol=protocol, dataset=dataset.name)
    evaluation = Evaluation(
        rows=[],
        per_frame=[
            row(
                frame=one.frame,
                cap_m=one.cap_m,
                pixels=one.pixels,
                coverage=one.coverage,
                metrics=one.metrics,
            )
            for one in measured
        ],
        deciles=[],
        skipped=skipped,
    )
    for cap_m in dict.fromkeys(one.cap_m for one in measured):
        of_cap = [one for one in measured if one.cap_m == cap_m]
        answered = [one for one in of_cap if one.pixels]
        if not answered:
            raise InputError(f"{dataset.name}: no prediction has a pixel where there is truth")
        names = [n for n in answered[0].metrics if all(n in one.metrics for one in answered)]
        evaluation.rows.append(
            row(
                cap_m=cap_m,
                frames=len(of_cap),
                pixels=sum(one.pixels for one in of_cap),
                coverage=sum(one.coverage for one in of_cap) / len(of_cap),
                metrics={n: sum(one.metrics[n] for one in answered) / len(answered) for n in names},
            )
        )
        deciles = [one.deciles for one in of_cap if one.deciles is not None]
        errors = torch.stack(deciles).nanmean(0).tolist() if deciles else []
        ranked_by = ranking_metric(cap_m).name
        for n, error in enumerate(errors, 1):
            metrics = {ranked_by: error}
            evaluation.deciles.append(
                row(cap_m=cap_m, frames=len(deciles), confidence_decile=n, metrics=metrics)
            )
    return evaluation


def _measure_depth(prepared: Prepared, rule: Protocol, cap_m: float) -> Measured | None:
    compared = compare_depth(prepared, rule, cap_m)
    mask, counted = _count(prepared, compared, cap_m)
    if counted is None or counted.pixels == 0:
        return counted
    predicted_m, true_m = compared.predicted[mask], compared.truth[mask]
    metrics = measure("depth", predicted_m, true_m) | prepared.view
    relative = (predicted_m - true_m).abs() / true_m
    return _score(replace(counted, metrics=metrics), relative, prepared.confidence, mask)


def _measure_disparity(prepared: Prepared) -> Measured | None:
    compared = compare_disparity(prepared)
    mask, counted = _count(prepared, compared, None)
    if counted is None or counted.pixels == 0:
        return counted
    predicted_px, true_px = compared.predicted[mask], compared.truth[mask]
    metrics = measure("disparity", predicted_px, true_px)
    if prepared.frame.disparity_noc is not None:
        seen_px = read_truth_disparity(prepared.frame.disparity_noc)
        seen = torch.isfinite(seen_px) & torch.isfinite(prepared.disparity_px)
        if bool(seen.any()):
            metrics |= measure("disparity_noc", prepared.disparity_px[seen], seen_px[seen])
    counted = replace(counted, metrics=metrics | prepared.view)
    return _score(counted, (predicted_px - true_px).abs(), prepared.confidence, mask)


def _count(
    prepared: Prepared, compared: Compared, cap_m: float | None
) -> tuple[Bool[Tensor, "h w"], Measured | None]:
    """Find the pixels that are measured, how many they are, and their share of the truth."""
    counts = torch.isfinite(compared.truth)
    mask = counts & torch.isfinite(compared.predicted)
    if not bool(counts.any()):
        return mask, None
    share = float(mask.sum() / counts.sum())
    counted = Measured(
        frame=prepared.frame.name, cap_m=cap_m, pixels=int(mask.sum()), coverage=share, metrics={}
    )
    return mask, counted


def _score(
    measured: Measured,
    error: Float[Tensor, " n"],
    confidence: Float[Tensor, "h w"] | None,
    mask: Bool[Tensor, "h w"],
) -> Measured:
    """Add AUSE and error by decile of the confidence, where there is one."""
    if confidence is None:
        return measured
    score = score_confidence(error, confidence[mask])
    deciles = error_by_decile(error, confidence[mask])
    return replace(measured, metrics={**measured.metrics, **score}, deciles=deciles)


def ranking_metric(cap_m: float | None) -> Metric:
    """Give the metric by which frames are ranked: of depth up to a cap, or of disparity (None)."""
    return METRICS[RANKING["disparity" if cap_m is None else "depth"]]
