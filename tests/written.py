"""What a page of the documentation tells its reader to type, typed.

A fenced block says after its language what it is: ```` ```bash ```` and ```` ```python ```` run as
they stand, and what follows as ```` ```text ```` must be in what they print. Marks:

    slow     takes more than some seconds
    long     a training: one step of it is run
    data     needs real samples
    exit N   ends with that exit code
    manual   opens something, or never ends: not run
    slurm    a job script, run with the scheduler played

The last digit of a decimal number may differ by one: another processor sums in another order.
"""

import importlib.util
import re
import shlex
import sys
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import pytest

from depthpose.cli import main

ROOT = Path(__file__).parents[1]
_DECIMAL = re.compile(r"\d+\.\d+")
_FENCE = re.compile(r"^```(\w+)(?: ([\w ]+))?\n(.*?)^```$", re.MULTILINE | re.DOTALL)


@dataclass(frozen=True)
class Block:
    """One fenced block, and the text that follows it as its output."""

    language: str
    mark: str
    code: str
    printed: tuple[str, ...] = ()


def read_blocks(page: Path) -> list[Block]:
    """Read the fenced blocks of a page; a text belongs to the block before it."""
    blocks: list[Block] = []
    for language, mark, code in _FENCE.findall(page.read_text()):
        if language == "text":
            last = blocks.pop()
            blocks.append(Block(last.language, last.mark, last.code, tuple(code.splitlines())))
        else:
            blocks.append(Block(language, mark, code))
    return blocks


def commands(blocks: list[Block]) -> list[str]:
    """Every line that calls depthpose, with what a backslash at its end joins to it."""
    typed = "\n".join(block.code for block in blocks if block.language == "bash")
    lines = re.sub(r"\\\n *", " ", typed).splitlines()
    return [line for line in lines if line.startswith("depthpose ")]


def run(line: str) -> int:
    """Run one command in this process; give its exit code."""
    return main(shlex.split(line, comments=True)[1:])


def run_block(
    block: Block, names: dict[str, object], capfd: pytest.CaptureFixture[str], more: str = ""
) -> None:
    """Run a block, and hold what it prints against the text that follows it."""
    capfd.readouterr()
    if block.language == "python":
        exec(block.code, names)  # the page is ours
    else:
        code = int(block.mark.removeprefix("exit ")) if block.mark.startswith("exit") else 0
        for line in commands([block]):
            assert run(line + more) == code, line
    shown = "".join(capfd.readouterr())
    for line in block.printed:
        assert is_printed(line, shown), f"{line!r} is not in\n{shown}"


def is_printed(line: str, shown: str) -> bool:
    """Say whether a line is in a text, up to one unit in the last place of its decimal numbers."""
    words = map(re.escape, _DECIMAL.split(line))
    numbers = _DECIMAL.findall(line)
    like_line = re.finditer(rf"({_DECIMAL.pattern})".join(words), shown)
    return any(all(map(_is_near, numbers, match.groups())) for match in like_line)


def _is_near(number: str, other: str) -> bool:
    """Whether decimal numbers differ by at most one unit in the last place of the first."""
    unit = 10.0 ** -len(number.partition(".")[2])
    return abs(float(number) - float(other)) < 1.5 * unit


def bench_module(name: str) -> ModuleType:
    """Import a script of the benchmarks, which are no package."""
    spec = importlib.util.spec_from_file_location(name, ROOT / f"bench/{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # its dataclass looks its own annotations up
    spec.loader.exec_module(module)
    return module
