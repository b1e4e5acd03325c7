import socket
import sys

import pytest

from depthpose.cli import main


def test_a_port_in_use_is_said_with_a_remedy(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        assert main(["serve", "--port", str(port)]) == 2
    assert f"127.0.0.1:{port} cannot be used: " in (said := capsys.readouterr().err)
    assert "choose another --port (0: any that is free)" in said


def test_a_port_that_cannot_be_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["serve", "--port", "70000"]) == 2
    assert "port 70000: there are 0 (any that is free) to 65535" in capsys.readouterr().err


def test_an_address_of_nobody_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["serve", "--host", "192.0.2.1", "--port", "0"]) == 2
    assert "192.0.2.1:0 cannot be used" in capsys.readouterr().err


def test_nothing_may_be_uploaded_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["serve", "--max-upload-mb", "0"]) == 2
    assert "--max-upload-mb 0: take 1 at least" in capsys.readouterr().err


def test_without_the_extra_it_says_which(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in [n for n in sys.modules if n.partition(".")[0] == "starlette"]:
        monkeypatch.delitem(sys.modules, name)
    for name in [n for n in sys.modules if n.startswith("depthpose.web")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "starlette", None)
    assert main(["serve"]) == 2
    assert "needs starlette, which is not installed: pip install 'depthpose[serve]'" in (
        capsys.readouterr().err
    )
