"""The page under load: a real server in a process of its own, real sockets, many clients."""

import json
import os
import select
import signal
import socket
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import httpx2
import pytest
from tests.web.samples import write_street

pytestmark = pytest.mark.slow

SERVER = """
import pathlib, sys, time, torch
from depthpose.depth.estimator import FakestereoNet
from depthpose.depth.stereo import CallableMatcher
from depthpose.pose.network_pose import GeoPoseNet
from depthpose.web import Limits, make_app, open_socket, run

class Counted:
    active = most = calls = 0

    def __call__(self, left, right):
        self.active += 1
        self.most, self.calls = max(self.most, self.active), self.calls + 1
        while pathlib.Path(sys.argv[2]).exists():
            time.sleep(0.02)
        time.sleep(float(sys.argv[1]))
        self.active -= 1
        return torch.full(left.shape[1:], 8.0)

counted = Counted()
taken = open_socket("127.0.0.1", 0)
app = make_app(FakestereoNet(CallableMatcher(counted)), GeoPoseNet.load("parts"), Limits())
print(taken.getsockname()[1], flush=True)
try:
    run(app, taken)
except KeyboardInterrupt:
    pass
print(counted.most, counted.calls, flush=True)
"""


@dataclass
class Served:
    """A page in another process, whose matcher takes some time."""

    process: "subprocess.Popen[str]"
    port: int
    hold: Path
    """While this file exists, no computation ends."""

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def memory_kb(self) -> int:
        status = Path(f"/proc/{self.process.pid}/status").read_text()
        return int(status.partition("VmRSS:")[2].split()[0])

    def before(self, ticket: str) -> int | None:
        """How many computations end before that of a ticket."""
        return json.loads(httpx2.get(f"{self.url}/queue/{ticket}", timeout=60).text)["before"]

    def await_place(self, ticket: str, place: int | None) -> None:
        until = time.monotonic() + 60
        while self.before(ticket) != place:
            assert time.monotonic() < until
            time.sleep(0.02)

    def stop(self) -> tuple[int, int]:
        """Most computations at the same time, and how many there were."""
        self.process.send_signal(signal.SIGINT)
        said, _ = self.process.communicate(timeout=60)
        most, calls = said.split()
        return int(most), int(calls)


@pytest.fixture(scope="module")
def samples(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_street(tmp_path_factory.mktemp("samples"))


@pytest.fixture
def serve(tmp_path: Path) -> Iterator[Callable[[float], Served]]:
    """Starts a page whose matcher takes so many seconds."""
    started: list[subprocess.Popen[str]] = []

    def start(seconds: float) -> Served:
        hold = tmp_path / "hold"
        words = [sys.executable, "-c", SERVER, str(seconds), str(hold)]
        # What is freed goes back to the system at once, so that memory is what is held.
        own = {**os.environ, "TMPDIR": str(tmp_path), "MALLOC_ARENA_MAX": "1"}
        own |= {"MALLOC_MMAP_THRESHOLD_": "65536", "MALLOC_TRIM_THRESHOLD_": "65536"}
        started.append(subprocess.Popen(words, stdout=subprocess.PIPE, text=True, env=own))
        assert started[-1].stdout is not None
        return Served(started[-1], int(started[-1].stdout.readline()), hold)

    yield start
    for process in started:
        process.kill()
        process.communicate()


def ask(served: Served, samples: Path, ticket: str = "", timeout_s: float = 300) -> httpx2.Response:
    names = {"image": "left.png", "right": "right.png", "camera": "camera.json"}
    files = {field: (name, (samples / name).read_bytes()) for field, name in names.items()}
    headers = {"X-Ticket": ticket}
    url = f"{served.url}/estimate/depth"
    return httpx2.post(url, files=files, headers=headers, timeout=timeout_s)


def test_two_hundred_requests_at_once(
    serve: Callable[[float], Served],
    samples: Path,
    tmp_path: Path,
    record_property: Callable[[str, object], None],
) -> None:
    served, memory_kb, answers = serve(0.05), list[int](), Counter[int]()
    assert ask(served, samples).status_code == 200
    with ThreadPoolExecutor(200) as pool:
        for _ in range(4):
            found = pool.map(lambda _: ask(served, samples), range(200))
            for response in found:
                answers[response.status_code] += 1
                assert response.status_code == 200 or "try again" in response.json()["error"]
            memory_kb.append(served.memory_kb())
    record_property("memory_kb", memory_kb)
    record_property("answers", dict(answers))
    assert set(answers) == {200, 503}
    assert memory_kb[-1] - memory_kb[0] < 10_000, f"memory is flat: {memory_kb}"
    assert ask(served, samples).status_code == 200
    assert served.stop() == (1, answers[200] + 2)
    assert not list(tmp_path.glob("depthpose-*")), "no upload is left"


def test_slow_uploads_block_nobody_and_are_ended(
    serve: Callable[[float], Served], samples: Path, tmp_path: Path
) -> None:
    served, open_ones = serve(0.05), list[socket.socket]()
    head = (
        "POST /estimate/depth HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 1000000\r\n"
        "Content-Type: multipart/form-data; boundary=x\r\n\r\n"
        '--x\r\nContent-Disposition: form-data; name="note"\r\n\r\n'
    )
    for _ in range(20):
        open_ones.append(socket.create_connection(("127.0.0.1", served.port)))
        open_ones[-1].sendall(head.encode())
    began, said = time.monotonic(), list[bytes]()
    while open_ones:
        start = time.monotonic()
        assert start - began < 120
        assert ask(served, samples).status_code == 200, "others are answered meanwhile"
        for one in select.select(open_ones, [], [], 0)[0]:
            said.append(one.recv(4096))
            open_ones.remove(one)
            one.close()
        for one in open_ones:
            one.sendall(b"-")
        time.sleep(max(0.0, start + 1 - time.monotonic()))
    assert time.monotonic() - began > 9
    assert all(data.startswith(b"HTTP/1.1 408 ") for data in said)
    assert all(b"the upload came too slowly" in data for data in said)
    served.stop()
    assert not list(tmp_path.glob("depthpose-*")), "no upload is left"


def test_the_place_in_the_queue_is_true(serve: Callable[[float], Served], samples: Path) -> None:
    served = serve(1.0)
    served.hold.touch()
    with ThreadPoolExecutor(5) as pool:
        waiting = []
        for k in range(5):
            waiting.append(pool.submit(ask, served, samples, f"t{k}"))
            served.await_place(f"t{k}", k)
        assert ask(served, samples).status_code == 503
        served.hold.unlink()
        seen: list[int] = []
        while (place := served.before("t4")) is not None:
            seen.append(place)
            time.sleep(0.1)
        assert seen == sorted(seen, reverse=True)
        assert {2, 1, 0} <= set(seen)
        assert [one.result().status_code for one in waiting] == [200] * 5
    assert served.before("t4") is None


def test_nothing_is_computed_for_who_has_gone(
    serve: Callable[[float], Served], samples: Path
) -> None:
    served = serve(0.0)
    served.hold.touch()
    with ThreadPoolExecutor(4) as pool:
        first = pool.submit(ask, served, samples, "first")
        served.await_place("first", 0)
        gone = []
        for k in range(3):
            gone.append(pool.submit(ask, served, samples, f"gone{k}", timeout_s=3))
            served.await_place(f"gone{k}", k + 1)
        for one in gone:
            assert isinstance(one.exception(), httpx2.TimeoutException)
        served.hold.unlink()
        assert first.result().status_code == 200
        assert ask(served, samples).status_code == 200
    assert served.stop() == (1, 2)


def test_half_heads_do_not_keep_others_out(serve: Callable[[float], Served], samples: Path) -> None:
    """More connections than are taken at once, of which each sends the beginning of a request."""
    served = serve(0.0)
    with ExitStack() as stack:
        open_ones = list[socket.socket]()
        for _ in range(405):
            one = socket.create_connection(("127.0.0.1", served.port), timeout=60)
            open_ones.append(stack.enter_context(one))
            one.sendall(b"POST /estimate/depth HTTP/1.1\r\nHost: 127")
        assert ask(served, samples).status_code == 503
        until = time.monotonic() + 60
        while ask(served, samples).status_code != 200:
            assert time.monotonic() < until
            time.sleep(0.5)
        assert all(one.recv(10) == b"" for one in open_ones), "they were closed"


def test_half_a_head_behind_an_answer_is_closed_too(serve: Callable[[float], Served]) -> None:
    served = serve(0.0)
    with socket.create_connection(("127.0.0.1", served.port), timeout=60) as one:
        one.sendall(b"GET /queue/x HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        answer = b""
        while not answer.endswith(b'{"before":null}'):
            answer += one.recv(4096)
        one.sendall(b"GET /queue/x HTTP/1.1\r\nHost: ")
        assert one.recv(4096) == b""


def test_a_size_of_thousands_of_digits_is_refused(serve: Callable[[float], Served]) -> None:
    served = serve(0.0)
    with socket.create_connection(("127.0.0.1", served.port), timeout=60) as one:
        size = "9" * 4401
        head = f"POST /estimate/depth HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: {size}"
        one.sendall(f"{head}\r\n\r\n".encode())
        assert one.recv(4096).startswith((b"HTTP/1.1 413 ", b"HTTP/1.1 400 "))
