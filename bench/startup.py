"""Time of ``--help`` of each command, of an empty Python, of ``import torch`` and of ours.

python bench/startup.py
"""

import subprocess
import sys
import time

from shared import make_parser, report

from depthpose.cli import COMMANDS


def least_wall_seconds(*arguments: str) -> float:
    """Measure the least wall time [s] of three runs of ``python ARGUMENTS``."""
    times_s = []
    for _ in range(3):
        start_s = time.perf_counter()
        subprocess.run([sys.executable, *arguments], check=True, capture_output=True)
        times_s.append(time.perf_counter() - start_s)
    return min(times_s)


def main() -> None:
    """Print a table and write out/bench/startup.json."""
    make_parser(__doc__).parse_args()
    arguments_of: dict[str, tuple[str, ...]] = {
        "python -c pass": ("-c", "pass"),
        "python -c 'import torch'": ("-c", "import torch"),
        "python -c 'import depthpose'": ("-c", "import depthpose"),
    }
    for name in ("", *COMMANDS):
        arguments_of[f"depthpose {name} --help"] = ("-m", "depthpose", *name.split(), "--help")
    rows = [
        {"command": name, "seconds": least_wall_seconds(*arguments)}
        for name, arguments in arguments_of.items()
    ]
    report("startup", rows)


if __name__ == "__main__":
    main()
