"""The file's answers beside PyTorch's: largest and mean difference, and the limit that holds."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

import numpy as np

from depthpose.core.errors import InputError

Row = dict[str, str | float]


@dataclass(frozen=True, kw_only=True, eq=False)
class Case:
    """One input and what PyTorch answers.

    Attributes:
        name: its size, for the table.
        inputs: by the names of the graph's inputs.
        expected: by the names of its outputs; what is not named is not compared.
        where: the part of an output that is compared, where it is not all of it.
    """

    name: str
    inputs: Mapping[str, np.ndarray]
    expected: Mapping[str, np.ndarray]
    where: Mapping[str, np.ndarray] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Limit:
    """How far an output may be off.

    Attributes:
        value: the limit, in the output's unit.
        of: the largest difference, or the mean one where the output is discontinuous.
        is_relative: differences are shares of what PyTorch answers.
        flips: share of the numbers that may be off by more, or be NaN in one answer alone, and are
            left out of the differences: where a decision is at its limit.
    """

    value: float
    of: Literal["largest", "mean"] = "largest"
    is_relative: bool = False
    flips: float = 0.0


def measure_differences(
    path: Path, cases: Iterable[Case], limits: Mapping[str, Limit]
) -> list[Row]:
    """Run a file with onnxruntime on each case, on the CPU, and give a row for each output.

    Raises:
        InputError: an output is NaN where PyTorch's is not, or the other way round, or off by
            more than its limit, on more pixels than may flip; or there is no number to compare.
    """
    session = import_module("onnxruntime").InferenceSession(
        str(path), providers=["CPUExecutionProvider"]
    )
    rows: list[Row] = []
    for case in cases:
        answers = session.run(list(case.expected), dict(case.inputs))
        for (name, expected), answer in zip(case.expected.items(), answers, strict=True):
            if name in case.where and answer.shape == expected.shape:
                answer, expected = (m[case.where[name]] for m in (answer, expected))  # noqa: PLW2901
            rows.append(_row(case.name, name, (answer, expected), limits[name]))
    if not rows:
        raise InputError("no output is compared with PyTorch's; nothing is written. Name a case.")
    return rows


def refuse_beyond(rows: Iterable[Row]) -> None:
    """Raise where a difference is beyond its limit.

    Raises:
        InputError: the first such row.
    """
    for row in rows:
        found, limit = row[f"{row['limited']} difference"], row["limit"]
        if not found <= limit:  # pyright: ignore[reportOperatorIssue]  NaN fails too
            raise InputError(
                f"{row['output']} of {row['input']}: PyTorch and onnxruntime differ by "
                f"{found:.3g} ({row['limited']}), the limit is {limit:.3g}; nothing is written. "
                "Install other versions of onnxscript and onnxruntime, and report this."
            )


def _row(case: str, output: str, pair: tuple[Any, np.ndarray], limit: Limit) -> Row:
    answer, expected = (np.asarray(values, np.float64) for values in pair)
    is_nan = np.isnan(answer), np.isnan(expected)
    is_other = answer.shape != expected.shape
    if is_other or ((is_nan[0] != is_nan[1]).any() and not limit.flips):
        raise InputError(
            f"{output} of {case}: onnxruntime answers {answer.shape} with "
            f"{is_nan[0].sum()} NaN, PyTorch {expected.shape} with "
            f"{is_nan[1].sum()}; nothing is written."
        )
    difference = np.abs(answer - expected)
    if limit.is_relative:
        difference /= np.abs(expected)
    difference = np.where(is_nan[0] != is_nan[1], np.inf, difference)
    difference = difference[~np.isnan(difference)]
    flipped: Row = {}
    if limit.flips:
        difference, share = _without_flips(difference, limit)
        if share > limit.flips:
            raise InputError(
                f"{output} of {case}: PyTorch and onnxruntime differ by more than {limit.value:g} "
                f"on {share:.3%} of the numbers, {limit.flips:.3%} may; nothing is written."
            )
        flipped = {"flipped": share}
    if not difference.size:
        raise InputError(
            f"{output} of {case}: PyTorch gives not one number that could be compared, and what is "
            "not compared is not proven; nothing is written. Are these the weights of a training "
            "that went well?"
        )
    return {
        "input": case,
        "output": output,
        "largest difference": float(difference.max()),
        "mean difference": float(difference.mean()),
        "limited": limit.of,
        "limit": limit.value,
        "unit": "share" if limit.is_relative else "as the output",
        **flipped,
    }


def _without_flips(difference: np.ndarray, limit: Limit) -> tuple[np.ndarray, float]:
    """Give the differences within the limit, and the share of those beyond it."""
    is_kept = difference <= limit.value
    return difference[is_kept], 1.0 - float(is_kept.mean()) if is_kept.size else 0.0
