"""Run the quick tables of docs/results.md again; list the numbers that changed.

    DEPTHPOSE_DATA=SAMPLES python bench/recheck.py [--only NAME ...] [--out out/bench/recheck]

A quick table takes minutes on one core and needs only the shipped weights and the published PSMNet
of the samples. Times, memory and rounding errors depend on the machine and are not compared, nor
are rows whose weights are not shipped. A number has changed if it differs from the printed one by
more than half of the last digit plus a five-hundredth of itself, which another processor may cause.
The exit code is 1 if a number changed.
"""

import argparse
import itertools
import json
import os
import re
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs/results.md"
_PSMNET = (
    "depthpose weights import psmnet SAMPLES/reference/psmnet/published_kitti2015.tar "
    "--align-corners true --out OUT/psmnet.safetensors"
)
_EVALUATE = "depthpose depth evaluate --data SAMPLES/depth"
_PAIRS = "SAMPLES/depth/street_pairs"
_TRAIN = (
    f"--train {_PAIRS}/kitti2015_train_drives {_PAIRS}/kitti_object_more --train-without "
    "train_000007 train_000008 train_000009 train_000010 train_000013"
)
_DEPTH = {"AbsRel": "abs_rel", "SqRel": "sq_rel", "RMSE": "rmse", "RMSElog": "rmse_log"}
_DELTAS = {"d1": "d1", "d2": "d2", "d3": "d3"}
_BASELINES = {
    "best constant depth of each row": {"method": "baseline: rows"},
    "nearest training image's depth": {"method": "baseline: nearest"},
}
_ONE_IMAGE = {
    f"one image, {name}, {speed}": {"weights": name, "speed": speed, "input": "left view"}
    for name in ("default", "kitti-nc")
    for speed in ("fine", "quick")
}
_PAIRS_BY = {
    **{
        f"real stereo, {name}, {speed}": {"weights": name, "speed": speed}
        for name in ("default", "kitti-nc", "psmnet-compact")
        for speed in ("fine", "quick")
    },
    "real stereo, SGBM, holes filled": {"method": "sgbm (holes filled)"},
}
_STEREO = {
    "SGBM, holes filled": {"method": "sgbm (holes filled)"},
    "PSMNet, published KITTI-2015 weights": {"method": "psmnet"},
}


def _at_80_m(rows: Mapping[str, Mapping[str, str]]) -> dict[str, dict[str, str]]:
    """Choose the rows of an evaluation that are capped at 80 m."""
    return {name: {**values, "cap_m": "80"} for name, values in rows.items()}


@dataclass(frozen=True, kw_only=True)
class Table:
    """A printed table, and the commands that reproduce it.

    Attributes:
        name: for ``--only``.
        after: text of the page; the table is the first one below it.
        commands: run in order; SAMPLES and OUT are replaced by folders.
        files: JSON rows that they write, under OUT.
        numbers: columns that are compared, by name on the page and in the rows.
        key: columns that identify a row, besides the first.
        rows: values in the rows for each name in the first column; other names are not compared.
            None: it is a column of the rows itself, named in ``key``.
        tolerance: share of a number by which another processor may change it.
    """

    name: str
    after: str
    commands: tuple[str, ...]
    files: tuple[str, ...]
    numbers: Mapping[str, str]
    key: Mapping[str, str] = field(default_factory=dict)
    rows: Mapping[str, Mapping[str, str]] | None = None
    tolerance: float = 0.002

    def printed(self) -> list[dict[str, str]]:
        """Read the printed table from the page: cells by column, without marks."""
        return printed_rows(PAGE.read_text(), self.after)


TABLES = (
    Table(
        name="raw",
        after="The raw layout, frames 0 and 1",
        commands=(
            _PSMNET,
            *(
                f"{_EVALUATE}/kitti_raw --protocol {protocol} --matcher sgbm "
                f"--weights OUT/psmnet.safetensors --out OUT/raw/{protocol}"
                for protocol in ("eigen-raw", "eigen-raw-camera")
            ),
        ),
        files=("raw/eigen-raw/rows.json", "raw/eigen-raw-camera/rows.json"),
        numbers={**_DEPTH, "d1": "d1"},
        key={"protocol": "protocol"},
        rows=_at_80_m(_STEREO),
    ),
    Table(
        name="mono",
        after="25 real pairs of six Eigen test drives",
        commands=(
            f"depthpose depth evaluate --data {_PAIRS}/kitti2015_eval_drives "
            "--protocol eigen-raw-camera --matcher sgbm --baseline rows nearest "
            f"{_TRAIN} "
            "--weights default fine:default quick:default kitti-nc fine:kitti-nc quick:kitti-nc "
            "fine:psmnet-compact quick:psmnet-compact --out OUT/mono",
            f"depthpose depth evaluate --data {_PAIRS}/kitti2015_eval_drives "
            "--protocol eigen-raw-camera --weights default kitti-nc --speed quick "
            "--out OUT/mono-quick",
        ),
        files=("mono/rows.json", "mono-quick/rows.json"),
        numbers={**_DEPTH, **_DELTAS},
        rows=_at_80_m({**_BASELINES, **_ONE_IMAGE, **_PAIRS_BY}),
    ),
    Table(
        name="mono-0052",
        after="Eight more frames, of one other Eigen test drive",
        commands=(
            f"{_EVALUATE}/kitti_raw/2011_09_26/2011_09_26_drive_0052_sync "
            f"--protocol eigen-raw-camera --baseline rows nearest {_TRAIN} "
            "--weights default kitti-nc --out OUT/mono-0052",
            f"{_EVALUATE}/kitti_raw/2011_09_26/2011_09_26_drive_0052_sync "
            "--protocol eigen-raw-camera --weights default kitti-nc --speed quick "
            "--out OUT/mono-0052-quick",
        ),
        files=("mono-0052/rows.json", "mono-0052-quick/rows.json"),
        numbers={"AbsRel": "abs_rel", "RMSE": "rmse", "d1": "d1"},
        rows=_at_80_m({**_BASELINES, **_ONE_IMAGE}),
    ),
    Table(
        name="disparity",
        after="25 real pairs of six Eigen test drives",
        commands=(
            f"depthpose depth evaluate --data {_PAIRS}/kitti2015_eval_drives --protocol kitti-2015 "
            "--weights default fine:default quick:default kitti-nc fine:kitti-nc quick:kitti-nc "
            "fine:psmnet-compact quick:psmnet-compact --matcher sgbm --out OUT/disparity",
            f"depthpose depth evaluate --data {_PAIRS}/kitti2015_eval_drives --protocol kitti-2015 "
            "--weights default kitti-nc --speed quick --out OUT/disparity-quick",
        ),
        files=("disparity/rows.json", "disparity-quick/rows.json"),
        numbers={"EPE [px]": "epe_px", "D1": "d1_all"},
        rows={**_ONE_IMAGE, **_PAIRS_BY},
    ),
    Table(
        name="votes",
        after="### Voting",
        commands=("python bench/voting_speed.py --points 2000",),
        files=("out/bench/voting_speed.json",),
        numbers={"error, mm": "error_mm"},
        key={"points": "points", "method": "method", "hypotheses": "hypotheses"},
        tolerance=0.01,
    ),
    Table(
        name="demo-depth",
        after="## Demo",
        commands=("depthpose demo --out OUT/demo",),
        files=("demo/depths.json",),
        numbers={"EPE [px]": "epe_px", "D1": "d1_all", "AbsRel": "abs_rel", "d1": "d1"},
        key={"scene": "scene", "method": "method"},
    ),
)  # fmt: skip
"""Every quick table."""


def main() -> int:
    """Run, compare, and print the numbers that changed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="+", choices=[table.name for table in TABLES], default=())
    parser.add_argument("--out", type=Path, default=Path("out/bench/recheck"))
    arguments = parser.parse_args()
    samples = os.environ.get("DEPTHPOSE_DATA", "")
    changed = 0
    for table in TABLES:
        if arguments.only and table.name not in arguments.only:
            continue
        if not samples and any("SAMPLES" in command for command in table.commands):
            print(f"{table.name}: skipped, for $DEPTHPOSE_DATA names no samples", flush=True)
            continue
        rows = run(table, arguments.out.resolve(), samples)
        differences, compared, left_out = compare(table, table.printed(), rows)
        changed += len(differences)
        print(f"{table.name}: {compared} numbers, {len(differences)} moved", flush=True)
        print("".join(f"  {line}\n" for line in differences), end="")
        print("".join(f"  not compared: {name}\n" for name in left_out), end="", flush=True)
    return 1 if changed else 0


def run(table: Table, out: Path, samples: str) -> list[dict[str, Any]]:
    """Run the commands of a table in OUT, and read the rows that they write."""
    out.mkdir(parents=True, exist_ok=True)
    for command in table.commands:
        _execute(command.replace("SAMPLES", samples).replace("OUT", str(out)), out)
    return [row for name in table.files for row in json.loads((out / name).read_text())]


@cache
def _execute(command: str, out: Path) -> None:
    """Run a command, once for all tables that need it."""
    program, *words = command.split()
    start = ["-m", program] if program == "depthpose" else [str(ROOT / words.pop(0))]
    subprocess.run([sys.executable, *start, *words], cwd=out, check=True, stdout=subprocess.DEVNULL)


def printed_rows(text: str, after: str) -> list[dict[str, str]]:
    """Read the first Markdown table below a part of a text: cells by column, without marks."""
    assert text.count(after) == 1, f"{after!r} stands {text.count(after)} times"
    lines = text[text.index(after) :].splitlines()
    is_row = [line.startswith("|") for line in lines]
    first = is_row.index(True)
    last = is_row.index(False, first) if False in is_row[first:] else len(lines)
    names, _, *rows = [_cells(line) for line in lines[first:last]]
    # A row without its last cells ends early.
    return [dict(itertools.zip_longest(names, row, fillvalue="")) for row in rows]


def _cells(line: str) -> list[str]:
    """Split a row of a Markdown table, without marks."""
    return [re.sub(r"[`*]", "", cell).strip() for cell in line.strip("| ").split("|")]


def compare(
    table: Table, printed: Sequence[Mapping[str, str]], rows: Sequence[Mapping[str, Any]]
) -> tuple[list[str], int, list[str]]:
    """List each change, count the compared numbers, and list the rows that are not compared."""
    changes: list[str] = []
    left_out: list[str] = []
    compared = 0
    for line in printed:
        name = " ".join([next(iter(line.values())), *(line[c] for c in table.key)])
        identity = _identity(table, line)
        if not identity:
            left_out.append(name)
            continue
        matches = [row for row in rows if _has_values(row, identity)]
        if len(matches) != 1:
            changes.append(f"{name}: {len(matches)} rows are {identity}")
            continue
        row = matches[0]
        for column, key in table.numbers.items():
            if not line[column]:
                continue
            compared += 1
            if has_moved(line[column], row[key], table.tolerance):
                changes.append(f"{name}: {column} is {row[key]}, printed {line[column]}")
    return changes, compared, left_out


def has_moved(printed: str, now: float | None, tolerance: float) -> bool:
    """Whether a number differs from the printed one, ``0.472`` or ``68.8 %``.

    Beyond half of the last printed digit it may be off by ``tolerance`` of itself.
    """
    number = re.match(r"-?\d*(?:\.(\d+))?", printed)
    assert number is not None
    if now is None:
        return True
    scale = 100 if printed.endswith("%") else 1
    half_digit = 0.5 * 10 ** -len(number[1] or "")
    return abs(scale * now - float(number[0])) > half_digit + tolerance * abs(scale * now)


def _identity(table: Table, line: Mapping[str, str]) -> dict[str, str]:
    """Return the values that identify the row of a printed line; none if it is not compared."""
    by_column = {key: line[column] for column, key in table.key.items()}
    if table.rows is None:
        return by_column
    by_name = table.rows.get(next(iter(line.values())))
    if by_name is None:
        return {}
    return {**by_name, **by_column}


def _has_values(row: Mapping[str, Any], values: Mapping[str, str]) -> bool:
    """Whether a row has values, as they are printed."""
    return all(_format(row[key]) == value for key, value in values.items())


def _format(value: object) -> str:
    if isinstance(value, float | int):
        return f"{value:g}"
    return str(value or "")


if __name__ == "__main__":
    sys.exit(main())
