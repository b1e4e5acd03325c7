"""The card of what a training leaves: a page for people, beside the weights."""

import shlex
from collections.abc import Mapping
from pathlib import Path

from depthpose.core.files import atomic_write
from depthpose.core.loop.journal import read_metrics
from depthpose.core.run import environment

_HELD_OUT = "held_out/"
"""Begins the names of numbers that validation found."""


def card_text(name: str, facts: Mapping[str, str], measured: str = "") -> str:
    """Say what weights are, and what was measured of them.

    Args:
        name: of the weights.
        facts: a line each.
        measured: Markdown that follows.
    """
    lines = [f"- **{_spoken(fact)}**: {value}" for fact, value in facts.items()]
    return "\n".join([f"# {name}", "", *lines, *(["", measured.strip()] if measured else []), ""])


def leave_card(
    weights: Path, words: str, seconds: float, facts: Mapping[str, str], measured: str
) -> None:
    """Write ``W.md`` beside the weights: what they are, the command, its time, what was measured.

    Args:
        weights: the file, in the folder of its run.
        words: of the command that trains such, as ``depth train view``.
        seconds: what the training took.
        facts: of the weights.
        measured: Markdown; :func:`held_out_text` where validation measured.
    """
    folder, here = weights.parent, environment()
    steps = max((row["step"] for row in read_metrics(folder)), default=0)
    where = ", ".join(here[name] for name in ("machine", "gpu") if name in here)
    made = {
        "command": f"`depthpose {words} --config config.yaml --out {shlex.quote(folder.name)}`",
        "time": f"{steps} steps in {_duration(seconds)} on {where}; {here['date']}",
    }
    with atomic_write(weights.with_suffix(".md")) as part:
        part.write_text(card_text(weights.stem, {**facts, **made}, measured))


def held_out_text(folder: Path, sentence: str) -> str:
    """Show what the last validation of a run found.

    Args:
        folder: of the run.
        sentence: what was looked at, and what the numbers mean.
    """
    found = [
        {name: value for name, value in row.items() if name.startswith(_HELD_OUT)}
        for row in read_metrics(folder)
    ]
    found = [numbers for numbers in found if numbers]
    if not found:
        return "Nothing was held out, so nothing was measured."
    rows = [
        f"| {name.removeprefix(_HELD_OUT)} | {value:.4g} |" for name, value in found[-1].items()
    ]
    return "\n".join([sentence, "", "| held out | |", "| --- | --- |", *rows])


def _spoken(name: str) -> str:
    return name.replace("_", " ").capitalize()


def _duration(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"
