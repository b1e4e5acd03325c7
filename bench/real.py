"""The scoreboard: every figure of real data, beside those of an earlier run.

    python bench/real.py $DEPTHPOSE_DATA --json out/real.json
    python bench/real.py $DEPTHPOSE_DATA --before out/real.json
    python bench/real.py $DEPTHPOSE_DATA --only masks scans --seeds 20

A figure of the earlier run stands in brackets where it was another. ``use`` says of each set
whether it takes part when a method or a limit is chosen (choice), or is only looked at afterwards
(held). CPU seconds leave out the preparation of models. Each process computes with one thread.
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
    parser.add_argument("--seeds", type=int, default=1, help="of each instance one by one")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument(
        "--json", type=Path, help="file for all rows and tables; other sections stay"
    )
    parser.add_argument("--before", type=Path, help="such a file of an earlier run")
    words = parser.parse_args()

    before = {} if words.before is None else json.loads(words.before.read_text())
    done = (
        {} if words.json is None or not words.json.exists() else json.loads(words.json.read_text())
    )
    for name in words.only:
        section = SECTIONS[name]
        began = time.perf_counter()
        rows, cpu_s = run_jobs(section.jobs(words.samples, words.seeds), words.processes)
        table = section.table(rows)

        earlier = before.get(name, {})
        facts = {"seeds": words.seeds, "environment": environment()}
        done[name] = {**facts, "cpu_s": cpu_s, "table": table, "rows": rows}
        print(f"\n## {section.title} ({name})\n")
        print(markdown_table(beside(table, earlier.get("table", []))))
        print(f"{cpu_s:.0f} CPU s with all preparation, {time.perf_counter() - began:.0f} s")
        if earlier:
            print(f"in brackets: {described(earlier)}")
        sys.stdout.flush()
        if words.json is not None:
            words.json.write_text(json.dumps(done, indent=1))


def described(section: Row) -> str:
    """Say of what an earlier section was measured."""
    facts = section["environment"]
    return f"commit {facts.get('commit', 'unknown')} of {facts['date']}, {section['seeds']} seeds"


def run_jobs(jobs: Sequence[Job], processes: int) -> tuple[list[Row], float]:
    """Run jobs in so many processes; give all their rows in order, and the CPU seconds of all."""
    with multiprocessing.get_context("spawn").Pool(
        processes, initializer=torch.set_num_threads, initargs=(1,)
    ) as pool:
        done = list(pool.imap(timed, jobs))
    return [row for rows, _ in done for row in rows], sum(cpu_s for _, cpu_s in done)


def timed(job: Job) -> tuple[list[Row], float]:
    """Run a job, and give its CPU seconds too."""
    began = time.process_time()
    rows = job()
    return rows, time.process_time() - began


def beside(table: Sequence[Row], before: Sequence[Row]) -> list[Row]:
    """Write what differs in an earlier table in brackets; a line is known by its first column."""
    earlier = {next(iter(line.values())): line for line in before}
    lines = list[Row]()
    for line in table:
        name, *columns = line
        old = earlier.get(line[name], {})
        cells = {column: shown(line[column], old.get(column, line[column])) for column in columns}
        lines.append({name: line[name], **cells})
    return lines


def shown(value: object, old: object) -> str:
    """Write a cell, and what it was if that was something else."""
    return (
        short(value) if short(value) == short(old) else f"{short(value)} ({short(old) or 'none'})"
    )


def short(value: object) -> str:
    """Write three digits of a fraction, and nothing for None."""
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
