"""Processor seconds of the commands of two states of the source, and their ratio.

    git worktree add /tmp/before COMMIT
    python bench/before_after.py --before /tmp/before/src --samples $DEPTHPOSE_DATA --demo out/demo

Each command is a process of its own, measured from its start to its end, with one thread: --help,
importing the two estimators, one image, one pair, one pose by the network and one by registration
(of the part of `make demo`). The two states alternate; the least of the repeats is printed.
"""

import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from shared import make_parser

from depthpose.report.page import format_markdown_table

RIG = (
    '{"width": 1242, "height": 375, "baseline_m": 0.54, '
    '"K": [[721.5, 0, 609.6], [0, 721.5, 172.9], [0, 0, 1]]}'
)
IMPORT = "import depthpose; depthpose.GeoPoseNet, depthpose.FakestereoNet"


def cpu_seconds(arguments: list[str], source: Path, folder: Path) -> float:
    """Run Python in a folder with the package of one source; give user and system seconds."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    environment = {**os.environ, "PYTHONPATH": str(source), "OMP_NUM_THREADS": "1"}
    process = subprocess.run([sys.executable, *arguments], check=False, cwd=folder,
                             env=environment, capture_output=True, text=True)  # fmt: skip
    if process.returncode:
        raise SystemExit(f"{source}: {' '.join(arguments)}\n{process.stderr[-2000:]}")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def commands(samples: Path, demo: Path) -> dict[str, list[str]]:
    """List the arguments of Python by the command's name; OUT stands for a new folder."""
    frames = samples / "depth/kitti_2015/training"
    left = f"{frames}/image_2/000046_10.png"
    right = f"{frames}/image_3/000046_10.png"
    cad = f"{demo.parent}/parts/models/obj_000002.ply"
    depthpose = ["-m", "depthpose"]
    predict_pose = [*depthpose, "pose", "predict"]
    registration = ["--method", "register", "--cad", cad, "--cad-unit", "mm"]
    view = [
        "--depth", f"{demo}/depth.png", "--mask", f"{demo}/mask.png",
        "--camera", f"{demo}/camera.json", "--out", "OUT",
    ]  # fmt: skip
    return {
        "depthpose --help": [*depthpose, "--help"],
        "import depthpose": ["-c", IMPORT],
        "depth predict": [
            *depthpose, "depth", "predict", left, "--focal-px", "721.5", "--out", "OUT"
        ],
        "depth match": [
            *depthpose, "depth", "match", left, right, "--camera", "rig.json", "--out", "OUT"
        ],
        "pose predict, network": [*predict_pose, "--weights", "parts", "--object", "mug", *view],
        "pose predict, registration": [*predict_pose, *registration, *view],
    }  # fmt: skip


def main() -> None:
    """Run every command by both sources in turns; print the least of each, and the ratio."""
    parser = make_parser(__doc__)
    parser.add_argument("--before", type=Path, required=True, help="folder src of the other state")
    parser.add_argument("--samples", type=Path, required=True)
    parser.add_argument("--demo", type=Path, required=True, help="out/demo of `make demo`")
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    sources = (options.before.resolve(), Path(__file__).resolve().parents[1] / "src")
    part = options.demo.resolve() / "part"
    rows: list[dict[str, Any]] = []
    for name, arguments in commands(options.samples.resolve(), part).items():
        times_s: dict[Path, list[float]] = {source: [] for source in sources}
        for _ in range(options.repeats + 1):
            for source in sources:
                with tempfile.TemporaryDirectory() as folder:
                    Path(folder, "rig.json").write_text(RIG)
                    in_folder = [word.replace("OUT", f"{folder}/out") for word in arguments]
                    times_s[source].append(cpu_seconds(in_folder, source, Path(folder)))
        # The first run compiles.
        before_s, now_s = (min(times_s[source][1:]) for source in sources)
        rows.append(
            {
                "command": name,
                "before [s]": before_s,
                "now [s]": now_s,
                "ratio": now_s / before_s,
            }
        )
        print(format_markdown_table(rows[-1:]), flush=True)
    print(format_markdown_table(rows))


if __name__ == "__main__":
    main()
