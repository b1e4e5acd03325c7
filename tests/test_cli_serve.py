import re
import socket
import sys

import pytest

from depthpose.cli import main
from depthpose.web import Limits, find_address_and_hosts
from depthpose.web.server import LOOPBACK


def _has_ipv6() -> bool:
    try:
        socket.create_server(("::1", 0), family=socket.AF_INET6).close()
    except OSError:
        return False
    return True


_HAS_IPV6 = _has_ipv6()


def test_a_port_in_use_is_said_with_a_remedy(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        assert main(["serve", "--port", str(port)]) == 2
    assert f"127.0.0.1:{port} cannot be used: " in (said := capsys.readouterr().err)
    assert "choose another --port (0: any that is free)" in said


def test_a_port_that_cannot_be_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["serve", "--port", "70000"]) == 2
    assert "port 70000: there are 0 (any that is free) to 65535" in capsys.readouterr().err


@pytest.fixture
def served(monkeypatch: pytest.MonkeyPatch) -> list[Limits]:
    """Limits of the pages that ``serve`` would run; nothing is loaded, and none runs."""
    limits: list[Limits] = []

    class Unloaded:
        @staticmethod
        def load(_: str, **__: bool) -> None:
            return None

    monkeypatch.setattr("depthpose.depth.estimator.FakestereoNet", Unloaded)
    monkeypatch.setattr("depthpose.pose.network_pose.GeoPoseNet", Unloaded)
    monkeypatch.setattr("depthpose.web.make_app", lambda *given: limits.append(given[-1]))
    monkeypatch.setattr("depthpose.web.run", lambda _, taken: taken.close())
    return limits


@pytest.mark.parametrize("host", ["0.0.0.0", "", "0", "0x0", "0.0", "000.0.0.0"])
def test_all_addresses_are_open_to_everyone_however_they_are_written(
    host: str, served: list[Limits], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["serve", "--host", host, "--port", "0"]) == 0
    assert [limits.hosts for limits in served] == [None]
    said = capsys.readouterr().out
    assert re.match(r"http://0\.0\.0\.0:\d+/ ", said)
    assert "whoever can reach this address may use the page: no password, no encryption" in said


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost", "127.1"])
def test_this_machine_alone_answers_to_its_names(
    host: str, served: list[Limits], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["serve", "--host", host, "--port", "0"]) == 0
    assert [set(limits.hosts or ()) for limits in served] == [{*LOOPBACK, host}]
    assert "password" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("bound", "is_open"),
    [
        ("::", True),
        ("::ffff:0.0.0.0", True),
        ("0.0.0.0", True),
        ("::1", False),
        ("192.0.2.7", False),
        ("fe80::1%lo", False),
    ],
)
def test_what_counts_is_the_address_that_was_taken(bound: str, is_open: bool) -> None:
    class Taken(socket.socket):
        def getsockname(self) -> tuple[str, int]:
            return bound, 8000

    with Taken() as taken:
        _, names = find_address_and_hosts("My-Robot", taken)
    assert names == (None if is_open else (*LOOPBACK, "my-robot", bound))


@pytest.mark.skipif(not _HAS_IPV6, reason="this machine has no IPv6")
@pytest.mark.parametrize("host", ["::", "::0", "0:0:0:0:0:0:0:0"])
def test_all_addresses_of_ipv6_are_open_too(host: str, served: list[Limits]) -> None:
    assert main(["serve", "--host", host, "--port", "0"]) == 0
    assert [limits.hosts for limits in served] == [None]


def test_an_address_of_nobody_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["serve", "--host", "192.0.2.1", "--port", "0"]) == 2
    assert "192.0.2.1:0 cannot be used" in capsys.readouterr().err


def test_nothing_may_be_uploaded_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["serve", "--max-upload-mb", "0"]) == 2
    assert "--max-upload-mb 0: give 1 or more" in capsys.readouterr().err


def test_the_time_of_a_computation_is_limited(
    served: list[Limits], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["serve", "--port", "0", "--max-seconds", "7"]) == 0
    assert main(["serve", "--port", "0"]) == 0
    assert [limits.compute_s for limits in served] == [7, 120]
    assert main(["serve", "--max-seconds", "0"]) == 2
    assert "--max-seconds 0: give 1 or more" in capsys.readouterr().err


def test_without_the_extra_it_says_which(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in [n for n in sys.modules if n.partition(".")[0] == "starlette"]:
        monkeypatch.delitem(sys.modules, name)
    for name in [n for n in sys.modules if n.startswith("depthpose.web")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "starlette", None)
    assert main(["serve"]) == 2
    assert "needs starlette, which is not installed: pip install -e '.[serve]'" in (
        capsys.readouterr().err
    )
