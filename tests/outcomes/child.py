"""Commands in processes that begin with everything imported, so that kills meet their work."""

import multiprocessing
import os
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

_forks = multiprocessing.get_context("forkserver")
_forks.set_forkserver_preload([__name__, "tests.outcomes.loaded"])


@dataclass(frozen=True)
class Ended:
    """How a command ended: its exit code (-9: killed), what it said, the seconds it took."""

    code: int
    said: str
    seconds: float


def run(words: Sequence[str], *, temporary: Path | None = None, kill_after_s: float = 0) -> Ended:
    """Run a command in a process of its own.

    Args:
        words: of the command.
        temporary: where temporary files go.
        kill_after_s: SIGKILL after so long; 0: never.
    """
    with tempfile.TemporaryDirectory() as folder:
        said, start = Path(folder) / "said", time.monotonic()
        process = _forks.Process(target=_main, args=(list(words), said, temporary))
        process.start()
        process.join(kill_after_s or 600)
        process.kill()
        process.join()
        code = -1 if process.exitcode is None else process.exitcode
        text = said.read_text() if said.exists() else ""
        return Ended(code=code, said=text, seconds=time.monotonic() - start)


def _main(words: list[str], said: Path, temporary: Path | None) -> None:
    file = said.open("w", buffering=1)
    sys.stdout = sys.stderr = file
    os.dup2(file.fileno(), 1)
    os.dup2(file.fileno(), 2)
    if temporary is not None:
        tempfile.tempdir = str(temporary)
    from tests.core.engine.doubles import InProcessEngine

    from depthpose.cli import engine, main

    # One process stands for the cluster: what is written, and when, is the same.
    engine.EngineOptions.build = lambda _: InProcessEngine()  # type: ignore[method-assign,assignment]
    sys.exit(main(words))
