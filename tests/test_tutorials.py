"""The tutorials, walked by a reader who types every block from top to bottom."""

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from tests.written import ROOT, Block, is_printed, read_blocks, run, run_block

TUTORIALS = sorted(set((ROOT / "docs/tutorials").glob("*.md")) - {ROOT / "docs/tutorials/index.md"})
QUICK = {"replace"}
"""Walked by the quick tests too; slow tests walk them all, whole."""
MARKS = {"", "slow", "long", "data", "manual", "slurm", "exit 2"}


def walk(
    page: Path, folder: Path, marks: set[str], capfd: pytest.CaptureFixture[str]
) -> list[Block]:
    """Run the blocks that bear one of some marks, and those that bear none; give them."""
    (folder / "configs").symlink_to(ROOT / "configs")
    kept = {"", "exit 2"} | marks
    blocks = [b for b in read_blocks(page) if b.language in ("bash", "python") and b.mark in kept]
    names: dict[str, object] = {}
    for block in blocks:
        run_block(block, names, capfd, " --steps 1" if block.mark == "long" else "")
    return blocks


@pytest.fixture
def folder(after_demo: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of the test's own in which ``depthpose demo`` has run."""
    shutil.copytree(after_demo / "out/demo", tmp_path / "out/demo")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("name", sorted(QUICK))
def test_a_quick_tutorial_runs(name: str, folder: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert walk(ROOT / f"docs/tutorials/{name}.md", folder, set(), capfd)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::depthpose.core.devices.PrecisionNotice")
@pytest.mark.parametrize("page", TUTORIALS, ids=lambda page: page.stem)
def test_a_tutorial_runs_whole(page: Path, folder: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert walk(page, folder, {"slow", "long"}, capfd)


@pytest.mark.data
@pytest.mark.slow
def test_the_kitti_tutorial_runs_on_kitti(
    real: Path, folder: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    published = folder / "pretrained_model_KITTI2015.tar"
    published.symlink_to(real / "reference/psmnet/published_kitti2015.tar")
    # One frame with a scan: the matcher takes nearly all the time, and sees each frame twice.
    kitti = real / "depth/kitti_object/training"
    frame = min((kitti / "velodyne").iterdir()).stem
    for path in kitti.glob(f"*/{frame}.*"):
        link = folder / "KITTI/training" / path.relative_to(kitti)
        link.parent.mkdir(parents=True, exist_ok=True)
        link.symlink_to(path)
    page = ROOT / "docs/tutorials/kitti.md"
    blocks = [block for block in read_blocks(page) if block.mark == "data"]
    assert len(blocks) == 3
    for block in blocks:
        run_block(block, {}, capfd)


@pytest.mark.parametrize("page", TUTORIALS, ids=lambda page: page.stem)
def test_every_block_says_how_it_is_run(page: Path) -> None:
    blocks = read_blocks(page)
    assert blocks
    assert {block.mark for block in blocks} <= MARKS


def job_script() -> str:
    (block,) = (b for b in read_blocks(ROOT / "docs/tutorials/cluster.md") if b.mark == "slurm")
    return block.code


PLAY = {
    "scontrol": "echo here",
    "srun": 'exec "$@"',
    "accelerate": """echo "$@" > launched
while [ "$1" != -m ]; do shift; done
exec "$PYTHON" "$@" --device cpu --steps 1""",
}
"""The scheduler's programs, and a launcher that runs one process and one step."""


@pytest.mark.slow
def test_the_job_script_trains_and_goes_on(folder: Path) -> None:
    (folder / "configs").symlink_to(ROOT / "configs")
    assert run("depthpose data make streets --out KITTI --number 3 --scale 0.5") == 0
    for name, body in PLAY.items():
        (folder / name).write_text(f"#!/bin/bash\n{body}\n")
        (folder / name).chmod(0o755)
    (folder / "job.sh").write_text(job_script().replace("view.yaml", "compact-view.yaml"))
    job = {"SLURM_NNODES": "2", "SLURM_GPUS_ON_NODE": "4", "SLURM_NODEID": "0"}
    env = (
        os.environ
        | job
        | {
            "PATH": f"{folder}:{os.environ['PATH']}",
            "PYTHON": sys.executable,
            "SLURM_JOB_NODELIST": "here",
        }
    )
    for _ in range(2):
        done = subprocess.run(["bash", "job.sh"], env=env, capture_output=True, check=False)
        assert done.returncode == 0, done.stderr.decode()[-2000:]
    assert (folder / "runs/view/generator.safetensors").is_file()
    assert "--num_processes 8" in (folder / "launched").read_text()


def test_accelerate_knows_the_words_of_the_job_script() -> None:
    from accelerate.commands.launch import launch_command_parser

    words = job_script().split("accelerate launch")[1].replace("\\\n", " ").rstrip("'\n")
    words = re.sub(r"\$\(\(.*?\)\)|\$\w+", "1", words)
    parsed = launch_command_parser().parse_args(shlex.split(words))
    assert parsed.module
    assert parsed.training_script == "depthpose"
    assert parsed.training_script_args[-1] == "--resume"


def test_only_the_last_digit_of_a_decimal_number_may_differ() -> None:
    assert is_printed("bin 5.0 m, 1.01 of 3", "a\nbin 4.9 m, 1.02 of 3\n")
    for other in ("bin 4.8 m, 1.01 of 3", "bin 5.0 m, 1.01 of 4", "box 5.0 m, 1.01 of 3"):
        assert not is_printed("bin 5.0 m, 1.01 of 3", other)
