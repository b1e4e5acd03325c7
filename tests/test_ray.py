"""``--engine ray`` on real Ray clusters of several nodes on this machine, with kills."""

import json
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
from tests.test_cli_engine import files_of, make_home, predict, unpacked
from tests.written import ROOT

pytestmark = [
    pytest.mark.slow,
    # Looked for and not imported: every worker collects this file, and Ray takes two seconds.
    pytest.mark.skipif(
        find_spec("ray") is None, reason="Ray is not installed: pip install -e '.[ray]'"
    ),
]

# Ray's workers are polite (nice 15): on a machine that others keep busy they would get no core.
os.environ.setdefault("RAY_worker_niceness", "0")
SECOND_CTRL_C_S = float(os.environ.get("DEPTHPOSE_PATIENCE_S", "540"))
"""How long a command may take: a worker that starts again loads torch for half a minute where
cores are shared."""


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_home(tmp_path_factory.mktemp("ray"))


class Nodes:
    """A Ray cluster on this machine: a head without cores and two nodes of one core each."""

    def __init__(self) -> None:
        cluster: Any = import_module("ray.cluster_utils")
        self._cluster = cluster.Cluster(
            initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False}
        )
        self.nodes = [self.add_node() for _ in range(2)]

    @property
    def address(self) -> str:
        return self._cluster.address

    def add_node(self) -> Any:  # noqa: ANN401  Ray's own
        return self._cluster.add_node(num_cpus=1, object_store_memory=80 * 2**20)

    def workers(self) -> list[int]:
        """Process numbers of the workers that hold a network."""
        return [
            pid
            for node in self.nodes
            for pid in _children(self._raylet(node))
            if b"MapWorker" in _command(pid)
        ]

    def kill_worker(self, choose: random.Random) -> bool:
        there = self.workers()
        if there:
            os.kill(choose.choice(there), signal.SIGKILL)
        return bool(there)

    def kill_node(self, choose: random.Random) -> None:
        """End everything on a node at once, and let another one join."""
        node = self.nodes.pop(choose.randrange(len(self.nodes)))
        raylet = self._raylet(node)
        for pid in [raylet, *_children(raylet)]:
            _kill(pid)
        self.nodes.append(self.add_node())

    def shutdown(self) -> None:
        self._cluster.shutdown()

    def _raylet(self, node: Any) -> int:  # noqa: ANN401  Ray's own
        return node.all_processes["raylet"][0].process.pid


@pytest.fixture
def nodes() -> Iterator[Nodes]:
    made = Nodes()
    yield made
    made.shutdown()


def _children(parent: int) -> list[int]:
    found: list[int] = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdecimal():
            try:
                fields = (entry / "stat").read_text().rpartition(")")[2].split()
            except OSError:
                continue
            found += [int(entry.name)] if int(fields[1]) == parent else []
    return found


def _command(pid: int) -> bytes:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return b""


def _kill(pid: int) -> None:
    with suppress(ProcessLookupError):
        os.kill(pid, signal.SIGKILL)


def command(home: Path, out: str, *words: str) -> list[str]:
    fixed = ["--camera", str(home / "rig.json"), "--weights", str(home / "w.safetensors")]
    return [sys.executable, "-m", "depthpose", "depth", "predict", *words, *fixed, "--out", out,
            "--cloud", "--engine", "ray"]  # fmt: skip


def run(
    words: list[str],
    meanwhile: Callable[[], None] = lambda: None,
    env: Mapping[str, str] | None = None,
) -> str:
    """Run a command to its end, and give what it printed."""
    with subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        env=os.environ | (env or {}),
    ) as process:  # fmt: skip
        try:
            meanwhile()
            said, _ = process.communicate(timeout=SECOND_CTRL_C_S)
        finally:
            process.kill()
    assert process.returncode == 0, said[-3000:]
    return said


def repeated(home: Path, times: int) -> Path:
    """Write a manifest that names the five images again and again."""
    rows = [f"left/{k % 5}.png,{k:06d}" for k in range(times)]
    path = home / f"{times}.csv"
    path.write_text("\n".join(["image,name", *rows]))
    return path


def test_two_nodes_give_what_one_process_gives(home: Path, tmp_path: Path, nodes: Nodes) -> None:
    assert predict(home, tmp_path / "plain", str(home / "left")) == 0
    words = [str(home / "left"), "--address", nodes.address, "--block", "1"]
    said = run(command(home, str(tmp_path / "big"), *words))
    assert "5 of 5 depth maps are in 5 shards" in said
    assert unpacked(tmp_path / "big") == files_of(tmp_path / "plain")


def test_kills_at_random_moments_lose_nothing(
    home: Path, tmp_path: Path, nodes: Nodes, record_property: Callable[[str, object], None]
) -> None:
    choose = random.Random(int(os.environ.get("DEPTHPOSE_SEED", "0")))
    total, kills = int(os.environ.get("DEPTHPOSE_KILL_INPUTS", "180")), []

    # Each moment is a number of shards, all in the first two thirds: work remains after the last.
    moments = sorted(choose.sample(range(1, total // 5 * 2 // 3), 6))

    def kill_six() -> None:
        shards, until = tmp_path / "out" / "shards", time.monotonic() + SECOND_CTRL_C_S
        while len(kills) < 6 and time.monotonic() < until:
            time.sleep(choose.uniform(0.0, 0.3))
            if len(list(shards.glob("*.json"))) < moments[len(kills)]:
                continue
            if len(kills) % 3 == 2:
                nodes.kill_node(choose)
                kills.append("node")
            elif nodes.kill_worker(choose):
                kills.append("worker")

    words = [str(repeated(home, total)), "--address", nodes.address, "--block", "5"]
    start = time.monotonic()
    run(command(home, str(tmp_path / "out"), *words), kill_six)
    record_property("seconds", time.monotonic() - start)
    assert (kills.count("worker"), kills.count("node")) == (4, 2)
    assert predict(home, tmp_path / "plain", str(home / "left")) == 0
    wanted, found = files_of(tmp_path / "plain"), unpacked(tmp_path / "out")
    assert sorted(found) == [f"{k:06d}" for k in range(total)], "nothing lost, nothing twice"
    for name, files in found.items():
        assert files == wanted[str(int(name) % 5)], name
    shards = {path.name for path in (tmp_path / "out" / "shards").iterdir()}
    assert shards == {f"{k:06d}.{end}" for k in range(total // 5) for end in ("tar", "json")}
    assert (tmp_path / "out" / "manifest.csv").read_text().count("\n") == total + 1


def test_a_killed_command_goes_on_where_it_was(home: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    words = command(home, str(out), str(repeated(home, 300)), "--block", "10", "--workers", "1")
    with subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        until = time.monotonic() + SECOND_CTRL_C_S
        while len(list((out / "shards").glob("*.json"))) < 5 and time.monotonic() < until:
            time.sleep(0.1)
        process.kill()
    time.sleep(5)  # Ray's processes notice that the command is gone
    before = {path.name: path.stat().st_mtime_ns for path in (out / "shards").glob("*.json")}
    assert 5 <= len(before) < 30
    run(words)
    after = {path.name: path.stat().st_mtime_ns for path in (out / "shards").glob("*.json")}
    assert len(after) == 30
    assert before.items() <= after.items(), "what was finished is not done again"
    assert len(unpacked(out)) == 300


def test_an_address_where_nothing_answers_is_refused(home: Path, tmp_path: Path) -> None:
    words = [str(home / "left"), "--address", "127.0.0.1:1"]
    made = subprocess.run(
        command(home, str(tmp_path), *words),
        capture_output=True, text=True, check=False, timeout=SECOND_CTRL_C_S,
    )  # fmt: skip
    assert made.returncode == 2
    assert "--address 127.0.0.1:1: no Ray cluster answers there" in made.stderr


def test_memory_stays_bounded_with_many_thousand_inputs(tmp_path: Path) -> None:
    pytest.importorskip("resource", reason="a system that says no peak of memory")
    peaks: dict[int, tuple[int, int]] = {}
    for total in (1_000, 31_000):
        home = tmp_path / str(total)
        home.mkdir()
        words = [sys.executable, "-m", "tests.core.engine.many", str(total), str(home)]
        paths = f"{ROOT}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"
        said = json.loads(run(words, env={"PYTHONPATH": paths}).splitlines()[-1])
        found = unpacked(home / "out")
        assert len(found) == said["inputs"] == total
        workers_kb = max(int(files["peak_kb"]) for files in found.values())
        peaks[total] = (said["command_kb"], workers_kb)
    (few, worker_few), (many, worker_many) = peaks.values()
    assert many - few < 60_000, "2 kB an input in the command at most"
    assert worker_many - worker_few < 100_000, "a worker holds its block alone"
