"""Command lines, tables, processor time and memory for the scripts of this folder.

Real instances are loaded by ``real_poses``, synthetic frames by ``find_tables``.
"""

import argparse
import json
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import torch

from depthpose.report.page import format_markdown_table

Row = Mapping[str, Any]
AnyRow = TypeVar("AnyRow", bound=Row)
Result = TypeVar("Result")


def make_parser(docstring: str | None) -> argparse.ArgumentParser:
    """Make the parser of a script, whose help shows the script's docstring as it is written."""
    return argparse.ArgumentParser(
        description=docstring, formatter_class=argparse.RawDescriptionHelpFormatter
    )


def group_rows(rows: Sequence[AnyRow], *columns: str) -> dict[tuple[Any, ...], list[AnyRow]]:
    """Group rows by their values in some columns, in the order in which these appear."""
    groups: dict[tuple[Any, ...], list[AnyRow]] = {}
    for row in rows:
        values = tuple(row[column] for column in columns)
        groups.setdefault(values, []).append(row)
    return groups


def mean_of(rows: Sequence[Row], column: str) -> float:
    """Average a column; NaN of no rows."""
    if not rows:
        return float("nan")
    return sum(row[column] for row in rows) / len(rows)


def with_cpu_seconds(run: Callable[[], Result]) -> tuple[Result, float]:
    """Run something; return its result and its processor time [s], of all threads together."""
    start_s = time.process_time()
    result = run()
    return result, time.process_time() - start_s


def report(name: str, rows: Sequence[Row]) -> None:
    """Print rows as a Markdown table and write them to ``out/bench/NAME.json``."""
    print(format_markdown_table(rows), flush=True)
    path = Path("out/bench", f"{name}.json")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(rows, indent=1))


def setting() -> str:
    """Describe what a time depends on besides the processor: threads and version of torch."""
    return f"{torch.get_num_threads()} threads, torch {torch.__version__}"


def size_of(text: str) -> tuple[int, int]:
    """Read a size such as ``256x512``, rows and columns."""
    rows, columns = text.split("x")
    return int(rows), int(columns)


def least_seconds(run: Callable[[], object], repeats: int) -> float:
    """Measure the least processor time of some runs [s], of all threads together.

    The caller has run it before, so that nothing is loaded or compiled meanwhile.
    """
    return min(with_cpu_seconds(run)[1] for _ in range(repeats))


def resident_bytes(field: str) -> int:
    """Read this process's resident memory: now (``VmRSS``) or at its peak (``VmHWM``) [bytes].

    Linux only.
    """
    status = Path("/proc/self/status").read_text()
    line = next(line for line in status.splitlines() if field in line)
    kibibytes = int(line.split()[1])
    return 1024 * kibibytes


def peak_growth_bytes(run: Callable[[], object]) -> int:
    """Measure by how much the peak memory of a call exceeds the memory before it [bytes].

    Linux only.
    """
    before = resident_bytes("VmRSS")
    # Earlier work may have peaked higher: 5 resets the peak (Linux, proc_pid_clear_refs).
    Path("/proc/self/clear_refs").write_text("5")
    run()
    return resident_bytes("VmHWM") - before
