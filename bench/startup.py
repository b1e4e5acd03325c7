"""Time of ``--help`` of each command, of an empty Python, of ``import torch`` and of ours.

python bench/startup.py
"""

import subprocess
import sys
import time

from shared import report

from depthpose.cli import COMMANDS


def seconds(*words: str) -> float:
    """Best of three runs of ``python WORDS``: the machine's noise only ever adds."""
    runs = []
    for _ in range(3):
        start = time.perf_counter()
        subprocess.run([sys.executable, *words], check=True, capture_output=True)
        runs.append(time.perf_counter() - start)
    return min(runs)


def main() -> None:
    """Print a table and write out/bench/startup.json."""
    words_of: dict[str, tuple[str, ...]] = {
        "python -c pass": ("-c", "pass"),
        "python -c 'import torch'": ("-c", "import torch"),
        "python -c 'import depthpose'": ("-c", "import depthpose"),
    }
    for name in ("", *COMMANDS):
        words_of[f"depthpose {name} --help"] = ("-m", "depthpose", *name.split(), "--help")
    rows = [{"command": name, "seconds": seconds(*words)} for name, words in words_of.items()]
    report("startup", rows)


if __name__ == "__main__":
    main()
