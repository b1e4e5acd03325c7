"""The scoreboard: results on real data, rendered parts and sequences, beside an earlier run.

    python bench/real.py $DEPTHPOSE_DATA --json out/real.json
    python bench/real.py $DEPTHPOSE_DATA --before out/real.json
    python bench/real.py $DEPTHPOSE_DATA --only masks scans --seeds 20

Where a number of the earlier run differs, it stands in brackets. ``use`` is "choice" for sets by
which methods and limits may be chosen, "held" for sets that are only measured. The docstring of
each section's module (``score_*.py``) defines which answers are right. CPU seconds leave out the
preparation of models. Each process computes with one thread.
"""

import json
import multiprocessing
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch is imported

import torch
from score import Job, Row, Section
from score_depth import IMAGES, INDOOR, STREET_PAIRS
from score_instances import BOXES, MASKS, NETWORKS, SCANS
from score_parts import PART_SHAPES
from score_reports import REPORTS
from score_scenes import BINS, FRAMES
from score_tracking import TRACKING
from shared import make_parser, with_cpu_seconds

from depthpose.core.environment import describe_environment
from depthpose.report.page import format_markdown_table

SECTIONS: dict[str, Section] = {
    "masks": MASKS,
    "scans": SCANS,
    "networks": NETWORKS,
    "boxes": BOXES,
    "bins": BINS,
    "frames": FRAMES,
    "reports": REPORTS,
    "parts": PART_SHAPES,
    "tracking": TRACKING,
    "indoor": INDOOR,
    "streets": STREET_PAIRS,
    "image": IMAGES,
}


def main() -> None:
    """Run the sections one after the other; print and store each as it is done."""
    parser = make_parser(__doc__)
    parser.add_argument("samples", type=Path, help="folder with pose/ and depth/")
    parser.add_argument("--only", nargs="+", choices=SECTIONS, default=list(SECTIONS))
    parser.add_argument(
        "--seeds", type=int, default=1, help="of each real instance; views of parts are multiplied"
    )
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument(
        "--json", type=Path, help="file for all rows and tables; sections not run are kept in it"
    )
    parser.add_argument("--before", type=Path, help="such a file of an earlier run")
    options = parser.parse_args()

    earlier_results = {} if options.before is None else json.loads(options.before.read_text())
    results = {}
    if options.json is not None and options.json.exists():
        results = json.loads(options.json.read_text())
    for name in options.only:
        section = SECTIONS[name]
        start_s = time.perf_counter()
        rows, cpu_s = run_jobs(section.jobs(options.samples, options.seeds), options.processes)
        wall_s = time.perf_counter() - start_s
        table = section.table(rows)
        results[name] = {
            "seeds": options.seeds,
            "environment": describe_environment(),
            "cpu_s": cpu_s,
            "table": table,
            "rows": rows,
        }

        earlier = earlier_results.get(name, {})
        print(f"\n## {section.title} ({name})\n")
        print(format_markdown_table(with_earlier(table, earlier.get("table", []))))
        print(f"{cpu_s:.0f} CPU s with all preparation, {wall_s:.0f} s")
        if earlier:
            print(f"in brackets: {describe_run(earlier)}")
        sys.stdout.flush()
        if options.json is not None:
            options.json.write_text(json.dumps(results, indent=1))


def describe_run(section: Row) -> str:
    """Describe what an earlier section was measured with: commit, date and seeds."""
    facts = section["environment"]
    return f"commit {facts.get('commit', 'unknown')} of {facts['date']}, {section['seeds']} seeds"


def run_jobs(jobs: Sequence[Job], processes: int) -> tuple[list[Row], float]:
    """Run jobs in some processes; return all their rows in order, and their CPU seconds."""
    with multiprocessing.get_context("spawn").Pool(
        processes, initializer=torch.set_num_threads, initargs=(1,)
    ) as pool:
        rows_and_seconds = list(pool.imap(with_cpu_seconds, jobs))
    all_rows = [row for rows, _ in rows_and_seconds for row in rows]
    return all_rows, sum(cpu_s for _, cpu_s in rows_and_seconds)


def with_earlier(table: Sequence[Row], before: Sequence[Row]) -> list[Row]:
    """Add cells of an earlier table in brackets where they differ; the first column names lines."""
    earlier_lines = {next(iter(line.values())): line for line in before}
    lines = list[Row]()
    for line in table:
        first_column, *columns = line
        earlier_line = earlier_lines.get(line[first_column], {})
        cells = {
            column: format_cell(line[column], earlier_line.get(column, line[column]))
            for column in columns
        }
        lines.append({first_column: line[first_column], **cells})
    return lines


def format_cell(value: object, earlier_value: object) -> str:
    """Format a cell, with the earlier value in brackets where it differs."""
    text = format_value(value)
    earlier_text = format_value(earlier_value)
    return text if text == earlier_text else f"{text} ({earlier_text or 'none'})"


def format_value(value: object) -> str:
    """Format a value: a fraction with three digits, None as nothing."""
    match value:
        case None:
            return ""
        case bool():
            return "yes" if value else "no"
        case float():
            return f"{value:.3g}"
        case _:
            return str(value)


if __name__ == "__main__":
    main()
