"""Each frame measured, and the means over frames."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from depthpose.core.errors import InputError
from depthpose.depth.datasets import Dataset
from depthpose.depth.datasets import read_disparity as read_truth_disparity
from depthpose.depth.evaluate.frames import (
    Compared,
    Prepared,
    Protocol,
    compare_depth,
    compare_disparity,
    find_protocol,
    prepare,
)
from depthpose.depth.metrics import (
    depth_errors,
    disparity_errors,
    error_by_decile,
    score_confidence,
)


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """What evaluating one set of predictions gave.

    Attributes:
        rows: one a cap (or a set of pixels), names to values, ready for a report.
        per_frame: the same for each frame.
        deciles: mean error of the least sure tenth of each frame's pixels (1) to the surest (10),
            for predictions with a confidence.
        skipped: frames that do not count, each with the reason.
    """

    rows: list[dict[str, Any]]
    per_frame: list[dict[str, Any]]
    deciles: list[dict[str, Any]]
    skipped: dict[str, str]


@dataclass(frozen=True, kw_only=True, eq=False)
class Measured:
    """One frame's row of numbers by one cap, and its error by decile of confidence."""

    row: dict[str, Any]
    deciles: Float[Tensor, "10"] | None

    def to_values(self) -> dict[str, Any]:
        """Give it as JSON values, exactly."""
        deciles = None if self.deciles is None else self.deciles.tolist()
        return {"row": self.row, "deciles": deciles}

    @classmethod
    def from_values(cls, values: Mapping[str, Any]) -> "Measured":
        """Read what :meth:`to_values` gave."""
        deciles = values["deciles"]
        made = None if deciles is None else torch.tensor(deciles, dtype=torch.float64)
        return cls(row=values["row"], deciles=made)


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
    return prepared if isinstance(prepared, str) else _measure(prepared, rule, caps_m)


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
    if not measured:
        raise InputError(
            f"{dataset.name}: none of its {len(dataset)} frames has the truth that protocol "
            f"{protocol!r} needs ({rule.truth}). Choose another protocol or folder."
        )
    stamp = {"protocol": protocol, "dataset": dataset.name}
    per_frame = [item.row for item in measured]
    error_name = "epe_px" if rule.truth == "disparity" else "abs_rel"
    return Evaluation(
        rows=[stamp | row for row in _mean_rows(per_frame)],
        per_frame=[stamp | row for row in per_frame],
        deciles=[stamp | row for row in _decile_rows(measured, error_name)],
        skipped=skipped,
    )


def _measure(prepared: Prepared, rule: Protocol, caps_m: Sequence[float]) -> list[Measured]:
    if rule.truth == "disparity":
        return [_measure_disparity(prepared)]
    return [_measure_depth(prepared, rule, cap_m) for cap_m in caps_m]


def _measure_depth(prepared: Prepared, rule: Protocol, cap_m: float) -> Measured:
    compared = compare_depth(prepared, rule, cap_m)
    mask, row = _count(compared, {"frame": prepared.frame.name, "cap_m": cap_m})
    predicted_m, true_m = compared.predicted[mask], compared.truth[mask]
    row |= asdict(depth_errors(predicted_m, true_m)) | prepared.view
    relative = (predicted_m - true_m).abs() / true_m
    return _score(row, relative, prepared.confidence, mask)


def _measure_disparity(prepared: Prepared) -> Measured:
    compared = compare_disparity(prepared)
    mask, row = _count(compared, {"frame": prepared.frame.name})
    predicted_px, true_px = compared.predicted[mask], compared.truth[mask]
    row |= asdict(disparity_errors(predicted_px, true_px))
    if prepared.frame.disparity_noc is not None:
        seen_px = read_truth_disparity(prepared.frame.disparity_noc)
        seen = torch.isfinite(seen_px) & torch.isfinite(prepared.disparity_px)
        errors = disparity_errors(prepared.disparity_px[seen], seen_px[seen])
        row |= {"epe_noc_px": errors.epe_px, "d1_noc": errors.d1_all}
    row |= prepared.view
    return _score(row, (predicted_px - true_px).abs(), prepared.confidence, mask)


def _count(compared: Compared, row: dict[str, Any]) -> tuple[Bool[Tensor, "h w"], dict[str, Any]]:
    """Find the pixels that are measured, and say how many and what share they are."""
    counts = torch.isfinite(compared.truth)
    mask = counts & torch.isfinite(compared.predicted)
    share = float(mask.sum() / counts.sum())
    return mask, row | {"pixels": int(mask.sum()), "coverage": share}


def _score(
    row: dict[str, Any],
    error: Float[Tensor, " n"],
    confidence: Float[Tensor, "h w"] | None,
    mask: Bool[Tensor, "h w"],
) -> Measured:
    """Add what the confidence is worth, where there is one."""
    if confidence is None:
        return Measured(row=row, deciles=None)
    score = asdict(score_confidence(error, confidence[mask]))
    return Measured(row=row | score, deciles=error_by_decile(error, confidence[mask]))


def _mean_rows(per_frame: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """One row a cap; each frame counts the same."""
    rows: list[dict[str, Any]] = []
    for cap in _caps(per_frame):
        of_cap = [row for row in per_frame if row.get("cap_m") == cap]
        row: dict[str, Any] = {} if cap is None else {"cap_m": cap}
        row |= {"frames": len(of_cap), "pixels": sum(item["pixels"] for item in of_cap)}
        names = [n for n in of_cap[0] if n not in ("frame", "cap_m", "pixels")]
        names = [n for n in names if all(n in item for item in of_cap)]
        rows.append(row | {n: sum(item[n] for item in of_cap) / len(of_cap) for n in names})
    return rows


def _decile_rows(measured: list[Measured], error_name: str) -> list[dict[str, Any]]:
    """Ten rows a cap; each frame counts the same."""
    rows: list[dict[str, Any]] = []
    for cap in _caps([item.row for item in measured]):
        of_cap = [item.deciles for item in measured
                  if item.row.get("cap_m") == cap and item.deciles is not None]  # fmt: skip
        if not of_cap:
            continue
        first = {} if cap is None else {"cap_m": cap}
        errors = torch.stack(of_cap).nanmean(0).tolist()
        rows += [
            first | {"frames": len(of_cap), "confidence_decile": k, error_name: error}
            for k, error in enumerate(errors, 1)
        ]
    return rows


def _caps(rows: list[dict[str, Any]]) -> list[float | None]:
    return list(dict.fromkeys(row.get("cap_m") for row in rows))
