"""What a small file may cost: refused soon, below a gigabyte, measured in child processes."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from tests.fuzz.bombs import BOMBS

ROOT = Path(__file__).parents[2]
READ = ("key values of lines", "OBJ of a comb")
"""Large, and no bomb."""


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, Any]]:
    if not hasattr(os, "fork"):
        pytest.skip("a system without fork")
    folder = tmp_path_factory.mktemp("bombs")
    command = [sys.executable, "-m", "tests.fuzz.bombs", str(folder)]
    source = {"PYTHONPATH": os.pathsep.join([str(ROOT / "src"), str(ROOT)])}
    done = subprocess.run(
        command, cwd=ROOT, env={**os.environ, **source}, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    return {row["name"]: row for row in rows}


@pytest.mark.slow
@pytest.mark.parametrize("name", BOMBS)
def test_a_bomb_is_refused_soon_and_in_little_memory(
    found: dict[str, dict[str, Any]], name: str
) -> None:
    row = found[name]
    # The doctor says what is odd of a file that cannot be used.
    assert row["outcome"] in (("read",) if name in READ else ("refused", "odd")), row
    assert row["mb"] < 1000, row
    # Processor time: up to 27 s on a slow machine; what grows with the square takes an hour.
    assert row["s"] < 90, row
