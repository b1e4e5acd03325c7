"""The README's commands on a fresh machine: seconds, and disk space of each command.

    python bench/fresh_machine.py [--data $DEPTHPOSE_DATA] [--with-tests]

A clone of the last commit, an empty home, an empty environment with the wheel, then each command
of the README. Trainings are cut to a few steps, and commands that need KITTI run with ``--data``.
"""

import argparse
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

PROJECT = Path(__file__).parents[1]
TORCH = next(
    line for line in (PROJECT / "constraints.txt").read_text().split() if line.startswith("torch")
)
SHORTER = {
    "--number 1000": "--number 4",
    "--data streets": "--data streets --steps 4",
    "--unit mm --out my_part": "--unit mm --steps 4 --out my_part",
    "--kitti KITTI": "--kitti KITTI --split all",
}


def disk_mb(folder: Path) -> float:
    """Megabytes below a folder."""
    return sum(f.lstat().st_size for f in folder.rglob("*") if f.is_file()) / 1e6


class Machine:
    """A home, a clone in it, and a row for each command that was run there."""

    def __init__(self, folder: Path, data: Path | None) -> None:
        self.folder, self.clone = folder, folder / "depthpose"
        keep = {name: os.environ[name] for name in ("PATH", "LANG") if name in os.environ}
        keep |= {name: word for name, word in os.environ.items() if name.startswith("PIP_")}
        self.environment = keep | {"HOME": str(folder), "DEPTHPOSE_DATA": str(data or "")}

    def run(self, line: str, at: Path) -> None:
        """Run a line of shell and print its row; a failure ends the script with what it printed."""
        before, start = disk_mb(self.folder), time.perf_counter()
        done = subprocess.run(
            line,
            check=False,
            shell=True,
            cwd=at,
            env=self.environment,
            capture_output=True,
            text=True,
        )
        seconds, more = time.perf_counter() - start, disk_mb(self.folder) - before
        if done.returncode and " data " not in line:  # those answer 1 where they find something
            sys.exit(f"{line}\n{done.stdout[-2000:]}\n{done.stderr[-4000:]}")
        said = (done.stdout.strip().splitlines() or [""])[-1][:80].replace("|", " ")
        shown = line.replace(str(self.folder), "~").replace(str(PROJECT), "REPOSITORY")
        print(f"| `{shown}` | {seconds:.0f} | {more:.1f} | {said} |", flush=True)


def readme_commands() -> list[str]:
    """Commands of README, quick start and weights, shortened where they would take hours."""
    pages = ("README.md", "docs/quickstart.md", "docs/weights.md")
    text = "\n".join((PROJECT / page).read_text() for page in pages)
    blocks = re.findall(r"^```bash\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    lines = re.sub(r"\\\n *", " ", "\n".join(blocks)).splitlines()
    for long, short in SHORTER.items():
        lines = [line.replace(long, short) for line in lines]
    return [line for line in lines if line.startswith("depthpose ")]


def main() -> None:
    """Print a Markdown table with a row for each command."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--data", type=Path, help="folder of the real samples")
    parser.add_argument("--with-tests", action="store_true", help="make check and make test too")
    words = parser.parse_args()
    print("| command | seconds | MB it leaves | its last line |\n| --- | ---: | ---: | --- |")
    with tempfile.TemporaryDirectory() as name:
        machine = Machine(Path(name), words.data)
        work = machine.folder / "work"
        work.mkdir()
        machine.run(f"git clone --quiet --depth 1 file://{PROJECT} depthpose", machine.folder)
        for target in ("demo", *(("check", "test") if words.with_tests else ())):
            machine.run(f"make {target}", machine.clone)
        machine.run("pip wheel --quiet --no-deps --wheel-dir wheels depthpose/", machine.folder)
        machine.run("python3 -m venv env", machine.folder)
        machine.environment["PATH"] = f"{machine.folder}/env/bin:{machine.environment['PATH']}"
        machine.run(f"pip install --quiet {TORCH}", machine.folder)
        machine.run("pip install --quiet wheels/*.whl", machine.folder)
        machine.run("depthpose doctor", work)
        machine.run("pip install --quiet 'depthpose[demo,train]'", machine.folder)
        prepare(machine, work, words.data)
        for line in readme_commands():
            if words.data or not re.search("KITTI|psmnet", line):
                machine.run(line, work)


def prepare(machine: Machine, work: Path, data: Path | None) -> None:
    """Inputs of the README's commands: configs, a CAD file, the real samples."""
    (work / "configs").symlink_to(machine.clone / "configs")
    machine.run(f"python {machine.clone}/bench/own_part.py part.stl", work)
    if data:
        published = data / "reference/psmnet/published_kitti2015.tar"
        (work / "pretrained_model_KITTI2015.tar").symlink_to(published)
        (work / "KITTI").symlink_to(data / "depth/kitti_object")
        (work / "MY_PAIRS").symlink_to(data / "depth/street_pairs/kitti_single")


if __name__ == "__main__":
    main()
