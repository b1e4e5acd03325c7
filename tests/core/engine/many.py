"""Run the engine on Ray over a manifest of N rows that repeats one small file; print peak memory.

python -m tests.core.engine.many N FOLDER
"""

import json
import resource
import sys
from collections.abc import Sequence
from pathlib import Path

from tests.core.engine.doubles import TEXTS

from depthpose.core.engine import (
    Computation,
    LocalInput,
    RayEngine,
    ResultWriter,
    ShardedJob,
    list_inputs,
    run_job,
)


def _start() -> ResultWriter:
    return _write_peaks


def _write_peaks(samples: Sequence[LocalInput], out: Path) -> list[str]:
    """Give for each input the peak memory of the process that took it, in kB."""
    for sample in samples:
        assert sample.files[0].read_text() == "small"
        (out / f"{sample.name}.peak_kb").write_text(str(_peak_kb()))
    return [""] * len(samples)


def _peak_kb() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def main(total: int, home: Path) -> None:
    (home / "small.txt").write_text("small")
    rows = [f"small.txt,{k:06d}" for k in range(total)]
    (home / "list.csv").write_text("\n".join(["text,name", *rows]))
    job = ShardedJob(
        computation=Computation(
            make_writer=_start, input_format=TEXTS, endings=("peak_kb",), batch=16
        ),
        inputs=list_inputs([str(home / "list.csv")], TEXTS),
        out=str(home / "out"),
        settings={},
        block_size=500,
    )
    done = run_job(job, RayEngine(workers=2))
    said = {"inputs": sum(len(one.entries) for one in done), "command_kb": _peak_kb()}
    sys.stdout.write(f"{json.dumps(said)}\n")


if __name__ == "__main__":
    main(int(sys.argv[1]), Path(sys.argv[2]))
