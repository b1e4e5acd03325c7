"""The scoreboard: real data, and rendered parts and sequences, beside those of an earlier run.

    python bench/real.py $DEPTHPOSE_DATA --json out/real.json
    python bench/real.py $DEPTHPOSE_DATA --before out/real.json
    python bench/real.py $DEPTHPOSE_DATA --only masks scans --seeds 20

A number of the earlier run stands in brackets where it differs. ``use`` says of each set whether
methods and limits are chosen by it (choice), or it is only measured afterwards (held). The module
of a section (``score_*.py``) says which answers are right. CPU seconds leave out the preparation of
models. Each process computes with one thread.
"""

import argparse
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

from depthpose.core.run import environment
from depthpose.report.page import markdown_table

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
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
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

    before = {} if options.before is None else json.loads(options.before.read_text())
    done = {}
    if options.json is not None and options.json.exists():
        done = json.loads(options.json.read_text())
    for name in options.only:
        section = SECTIONS[name]
        began = time.perf_counter()
        rows, cpu_s = run_jobs(section.jobs(options.samples, options.seeds), options.processes)
        table = section.table(rows)

        earlier = before.get(name, {})
        facts = {"seeds": options.seeds, "environment": environment()}
        done[name] = {**facts, "cpu_s": cpu_s, "table": table, "rows": rows}
        print(f"\n## {section.title} ({name})\n")
        print(markdown_table(with_earlier(table, earlier.get("table", []))))
        print(f"{cpu_s:.0f} CPU s with all preparation, {time.perf_counter() - began:.0f} s")
        if earlier:
            print(f"in brackets: {describe_run(earlier)}")
        sys.stdout.flush()
        if options.json is not None:
            options.json.write_text(json.dumps(done, indent=1))


def describe_run(section: Row) -> str:
    """Describe what an earlier section was measured with: commit, date and seeds."""
    facts = section["environment"]
    return f"commit {facts.get('commit', 'unknown')} of {facts['date']}, {section['seeds']} seeds"


def run_jobs(jobs: Sequence[Job], processes: int) -> tuple[list[Row], float]:
    """Run jobs in some processes; return all their rows in order, and their CPU seconds."""
    with multiprocessing.get_context("spawn").Pool(
        processes, initializer=torch.set_num_threads, initargs=(1,)
    ) as pool:
        done = list(pool.imap(timed, jobs))
    return [row for rows, _ in done for row in rows], sum(cpu_s for _, cpu_s in done)


def timed(job: Job) -> tuple[list[Row], float]:
    """Run a job; return its rows and its CPU seconds."""
    began = time.process_time()
    rows = job()
    return rows, time.process_time() - began


def with_earlier(table: Sequence[Row], before: Sequence[Row]) -> list[Row]:
    """Add the cells of an earlier table that differ in brackets; lines are named by column one."""
    earlier = {next(iter(line.values())): line for line in before}
    lines = list[Row]()
    for line in table:
        name, *columns = line
        old = earlier.get(line[name], {})
        cells = {
            column: format_cell(line[column], old.get(column, line[column])) for column in columns
        }
        lines.append({name: line[name], **cells})
    return lines


def format_cell(value: object, old: object) -> str:
    """Format a cell, with the earlier value in brackets where it differs."""
    now = format_value(value)
    before = format_value(old)
    return now if now == before else f"{now} ({before or 'none'})"


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
