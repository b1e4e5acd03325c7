"""Twenty instances at once, and one after the other, with compiled loops and with torch alone.

    python bench/pose_batch.py $DEPTHPOSE_DATA/pose --weights linemod.safetensors ycb

The real instances of each weights file are taken in turn until there are twenty. Each engine runs
in a process of its own ('DEPTHPOSE_COMPILED=0' keeps to torch); the least of the rounds is shown,
processor time of one instance [ms]. 'pip install -e .[fast]' for the compiled loops.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import torch
from real_poses import real_cases

from depthpose.core.checkpoint import find_weights
from depthpose.pose.estimator import GeoPoseNet
from depthpose.pose.types import CloudInput, ViewInput
from depthpose.pose.weights import read_pose_weights
from depthpose.report.page import markdown_table

NUMBER = 20


def inputs_of(folder: Path, net: GeoPoseNet) -> list[CloudInput | ViewInput]:
    """Take the instances that a network knows in turn, until there are twenty."""
    known = [c.sample.input for c in real_cases(folder) if c.sample.input.object in net.objects]
    return [known[k % len(known)] for k in range(NUMBER)]


def measure(options: argparse.Namespace) -> list[dict[str, Any]]:
    """Time this process's engine."""
    torch.set_num_threads(1)
    rows = []
    for name in options.weights:
        net = GeoPoseNet(read_pose_weights(find_weights(name)))
        inputs = inputs_of(options.folder, net)
        net.estimate_many(inputs)  # surfaces, copies, compilation
        alone, together = [], []
        for _ in range(options.rounds):
            began = time.process_time()
            for given in inputs:
                net.estimate_many([given])
            middle = time.process_time()
            net.estimate_many(inputs)
            alone.append(middle - began)
            together.append(time.process_time() - middle)
        row = {"weights": Path(name).stem, "one by one": alone, "together": together}
        rows.append({k: v if isinstance(v, str) else 1e3 * min(v) / NUMBER for k, v in row.items()})
    return rows


def main() -> None:
    """Measure both engines and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--weights", nargs="+", default=["ycb"])
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        print(json.dumps(measure(options)))
        return
    rows = []
    for engine, switch in (("torch", "0"), ("compiled", "1")):
        environment = {**os.environ, "DEPTHPOSE_COMPILED": switch, "OMP_NUM_THREADS": "1"}
        command = [sys.executable, "-W", "ignore", *sys.argv, "--child"]
        said = subprocess.run(command, check=True, env=environment, capture_output=True, text=True)
        found = json.loads(said.stdout.splitlines()[-1])
        rows += [{"engine": engine, **row} for row in found]
    print(markdown_table(rows))


if __name__ == "__main__":
    main()
