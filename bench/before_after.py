"""Processor seconds of the commands of two states of the source, by turns, and their ratio.

    git worktree add /tmp/before COMMIT
    python bench/before_after.py --before /tmp/before/src --samples $DEPTHPOSE_DATA --demo out/demo

Each is a process of its own, from its start to its end, with one thread: --help, importing the
two estimators, one image, one pair, one pose by the network and one by registration (of the part of
`make demo`). Given is the least of the repeats: what else the machine does only adds to it.
"""

import argparse
import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from depthpose.report.page import markdown_table

RIG = (
    '{"width": 1242, "height": 375, "baseline_m": 0.54, '
    '"K": [[721.5, 0, 609.6], [0, 721.5, 172.9], [0, 0, 1]]}'
)
IMPORT = "import depthpose; depthpose.GeoPoseNet, depthpose.FakestereoNet"


def cpu_seconds(arguments: list[str], source: Path, folder: Path) -> float:
    """Run Python in a folder with the package of one source; give user and system seconds."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    environment = {**os.environ, "PYTHONPATH": str(source), "OMP_NUM_THREADS": "1"}
    done = subprocess.run([sys.executable, *arguments], check=False, cwd=folder, env=environment,
                          capture_output=True, text=True)  # fmt: skip
    if done.returncode:
        raise SystemExit(f"{source}: {' '.join(arguments)}\n{done.stderr[-2000:]}")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def commands(samples: Path, demo: Path) -> dict[str, list[str]]:
    """Give what is run, by its name; `OUT` stands for a new folder of results."""
    frames = samples / "depth/kitti_2015/training"
    left, right = (str(frames / side / "000046_10.png") for side in ("image_2", "image_3"))
    part = ["--depth", f"{demo}/depth.png", "--mask", f"{demo}/mask.png",
            "--camera", f"{demo}/camera.json", "--out", "OUT"]  # fmt: skip
    cad = f"{demo.parent}/parts/models/obj_000002.ply"
    command = ["-m", "depthpose"]
    rig = ["--camera", "rig.json", "--out", "OUT"]
    one, pose = [*command, "depth", "predict", left], [*command, "pose", "predict"]
    network = ["--weights", "parts", "--object", "mug"]
    register = ["--method", "register", "--cad", cad, "--cad-unit", "mm"]
    return {
        "depthpose --help": [*command, "--help"],
        "import depthpose": ["-c", IMPORT],
        "depth predict": [*one, "--focal-px", "721.5", "--out", "OUT"],
        "depth match": [*command, "depth", "match", left, right, *rig],
        "pose predict, network": [*pose, *network, *part],
        "pose predict, registration": [*pose, *register, *part],
    }  # fmt: skip


def main() -> None:
    """Run every command by both sources in turns; print the least of each, and the ratio."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--before", type=Path, required=True, help="folder src of the other state")
    parser.add_argument("--samples", type=Path, required=True)
    parser.add_argument("--demo", type=Path, required=True, help="out/demo of `make demo`")
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    now = Path(__file__).parents[1] / "src"
    rows: list[dict[str, Any]] = []
    for name, arguments in commands(options.samples, options.demo / "part").items():
        least = {}
        for turn in range(options.repeats + 1):
            for source in (options.before, now):
                with tempfile.TemporaryDirectory() as folder:
                    Path(folder, "rig.json").write_text(RIG)
                    words = [word.replace("OUT", f"{folder}/out") for word in arguments]
                    spent = cpu_seconds(words, source, Path(folder))
                if turn:  # the first compiles
                    least[source] = min(spent, least.get(source, spent))
        before, after = least[options.before], least[now]
        rows.append({"command": name, "before [s]": before, "now [s]": after,
                     "ratio": after / before})  # fmt: skip
        print(markdown_table(rows[-1:]), flush=True)
    print(markdown_table(rows))


if __name__ == "__main__":
    main()
