"""What the scripts here share: where they write, their tables, processor time, memory.

Real instances and frames are loaded by ``real_poses`` and ``find_tables``.
"""

import json
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from depthpose.report.page import markdown_table

Row = Mapping[str, Any]


def report(name: str, rows: Sequence[Row]) -> None:
    """Print rows as a Markdown table and write them to ``out/bench/NAME.json``."""
    print(markdown_table(rows), flush=True)
    path = Path("out/bench", f"{name}.json")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(rows, indent=1))


def setting() -> str:
    """Name what a time depends on beside the processor."""
    return f"{torch.get_num_threads()} threads, torch {torch.__version__}"


def size_of(text: str) -> tuple[int, int]:
    """Read ``256x512`` as rows and columns."""
    rows, columns = text.split("x")
    return int(rows), int(columns)


def least_seconds(run: Callable[[], object], repeats: int) -> float:
    """Least processor time of some runs [s], all threads together; the caller has warmed up."""
    times = []
    for _ in range(repeats):
        began = time.process_time()
        run()
        times.append(time.process_time() - began)
    return min(times)


def resident_bytes(field: str) -> int:
    """Read a line of this process's memory, VmRSS or VmHWM [bytes]. Linux only."""
    status = Path("/proc/self/status").read_text()
    return 1024 * int(next(line for line in status.splitlines() if field in line).split()[1])


def peak_growth_bytes(run: Callable[[], object]) -> int:
    """How far a call raises this process's peak above what it holds before [bytes]. Linux only."""
    before = resident_bytes("VmRSS")
    # What came before may have peaked higher: 5 resets the peak (Linux, proc_pid_clear_refs).
    Path("/proc/self/clear_refs").write_text("5")
    run()
    return resident_bytes("VmHWM") - before
