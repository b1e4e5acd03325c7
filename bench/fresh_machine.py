"""The README's commands on a fresh machine: seconds, and disk space of each command.

    python bench/fresh_machine.py [--data $DEPTHPOSE_DATA] [--with-tests]

Clones the last commit into an empty home, installs the wheel into an empty environment, and runs
each command of the README, the quick start and the weights page. Trainings are cut to a few steps;
commands that need KITTI run with ``--data`` alone.
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
PAGES = ("README.md", "docs/quickstart.md", "docs/weights.md")
SHORTENED = {
    "--number 1000": "--number 4",
    "--data streets": "--data streets --steps 4",
    "--unit mm --out my_part": "--unit mm --steps 4 --out my_part",
    "--kitti KITTI": "--kitti KITTI --split all",
}


def disk_mb(folder: Path) -> float:
    """Compute the size of the files in a folder [MB]."""
    return sum(path.lstat().st_size for path in folder.rglob("*") if path.is_file()) / 1e6


class Machine:
    """A home with a clone of the project, in which commands are run and measured."""

    def __init__(self, folder: Path, data: Path | None) -> None:
        self.folder = folder
        self.clone = folder / "depthpose"
        self.environment = {
            name: value
            for name, value in os.environ.items()
            if name in ("PATH", "LANG") or name.startswith("PIP_")
        }
        self.environment["HOME"] = str(folder)
        self.environment["DEPTHPOSE_DATA"] = str(data or "")

    def run(self, line: str, folder: Path) -> None:
        """Run a line of shell in a folder and print its row; a failure ends the script."""
        disk_before_mb = disk_mb(self.folder)
        start_s = time.perf_counter()
        process = subprocess.run(
            line,
            check=False,
            shell=True,
            cwd=folder,
            env=self.environment,
            capture_output=True,
            text=True,
        )
        wall_s = time.perf_counter() - start_s
        growth_mb = disk_mb(self.folder) - disk_before_mb
        # Commands on data return 1 when they report a problem of the data.
        if process.returncode and " data " not in line:
            sys.exit(f"{line}\n{process.stdout[-2000:]}\n{process.stderr[-4000:]}")
        output_lines = process.stdout.strip().splitlines() or [""]
        last_line = output_lines[-1][:80].replace("|", " ")
        command = line.replace(str(self.folder), "~").replace(str(PROJECT), "REPOSITORY")
        print(f"| `{command}` | {wall_s:.0f} | {growth_mb:.1f} | {last_line} |", flush=True)


def documented_commands() -> list[str]:
    """Read the commands of the pages, shortened where they would take hours."""
    text = "\n".join((PROJECT / page).read_text() for page in PAGES)
    blocks = re.findall(r"^```bash\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    lines = re.sub(r"\\\n *", " ", "\n".join(blocks)).splitlines()
    for long, short in SHORTENED.items():
        lines = [line.replace(long, short) for line in lines]
    return [line for line in lines if line.startswith("depthpose ")]


def main() -> None:
    """Print a Markdown table with a row for each command."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, help="folder of the real samples")
    parser.add_argument("--with-tests", action="store_true", help="make check and make test too")
    options = parser.parse_args()
    print("| command | seconds | MB it leaves | its last line |\n| --- | ---: | ---: | --- |")
    with tempfile.TemporaryDirectory() as name:
        machine = Machine(Path(name), options.data)
        work = machine.folder / "work"
        work.mkdir()
        machine.run(f"git clone --quiet --depth 1 file://{PROJECT} depthpose", machine.folder)
        targets = ["demo", "check", "test"] if options.with_tests else ["demo"]
        for target in targets:
            machine.run(f"make {target}", machine.clone)
        machine.run("pip wheel --quiet --no-deps --wheel-dir wheels depthpose/", machine.folder)
        machine.run("python3 -m venv env", machine.folder)
        machine.environment["PATH"] = f"{machine.folder}/env/bin:{machine.environment['PATH']}"
        machine.run(f"pip install --quiet {TORCH}", machine.folder)
        machine.run("pip install --quiet wheels/*.whl", machine.folder)
        machine.run("depthpose doctor", work)
        machine.run("pip install --quiet 'depthpose[demo,train]'", machine.folder)
        prepare(machine, work, options.data)
        for line in documented_commands():
            if options.data or not re.search("KITTI|psmnet", line):
                machine.run(line, work)


def prepare(machine: Machine, work: Path, data: Path | None) -> None:
    """Provide the inputs of the commands: configs, a CAD file, the real samples."""
    (work / "configs").symlink_to(machine.clone / "configs")
    machine.run(f"python {machine.clone}/bench/own_part.py part.stl", work)
    if data:
        published = data / "reference/psmnet/published_kitti2015.tar"
        (work / "pretrained_model_KITTI2015.tar").symlink_to(published)
        (work / "KITTI").symlink_to(data / "depth/kitti_object")
        (work / "MY_PAIRS").symlink_to(data / "depth/street_pairs/kitti_single")


if __name__ == "__main__":
    main()
