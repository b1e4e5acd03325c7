"""Results and inputs in an object store: nanio, a small S3 server, on the loopback address.

It is a real server that keeps objects on disk and checks signatures; it is not Amazon's.
"""

import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
from tests.core.engine.doubles import InProcessEngine
from tests.test_cli_engine import RAY, double, files_of, home, match, predict, truth, unpacked

from depthpose.cli import main

pytestmark = [
    pytest.mark.slow,
    # Looked for and not imported: every worker collects this file, and s3fs takes a second.
    *(
        pytest.mark.skipif(
            find_spec(name) is None, reason=f"{name} is not installed: pip install it"
        )
        for name in ("nanio", "s3fs")
    ),
]

__all__ = ["double", "home", "truth"]  # fixtures
KEYS = {"AWS_ACCESS_KEY_ID": "tester", "AWS_SECRET_ACCESS_KEY": "a-secret-of-the-tests"}


@pytest.fixture
def bucket(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """An empty bucket of a server that lives as long as the test."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    words = [
        "serve",
        "--data-dir",
        str(tmp_path / "s3"),
        "--host",
        "127.0.0.1",
        "--port",
        str(port),
    ]
    own = {"NANIO_ACCESS_KEY": KEYS["AWS_ACCESS_KEY_ID"],
           "NANIO_SECRET_KEY": KEYS["AWS_SECRET_ACCESS_KEY"]}  # fmt: skip
    server = subprocess.Popen(
        [str(Path(sys.executable).with_name("nanio")), *words], env=os.environ | own,
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    for name, value in {
        **KEYS, "AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}", "AWS_DEFAULT_REGION": "us-east-1"
    }.items():  # fmt: skip
        monkeypatch.setenv(name, value)
    try:
        _wait_for(port)
        s3fs().mkdir("street")
        yield "s3://street"
    finally:
        server.kill()
        server.wait()


def s3fs() -> Any:  # noqa: ANN401  its types are not installed everywhere
    store = import_module("s3fs").S3FileSystem
    store.clear_instance_cache()
    return store()


def _wait_for(port: int) -> None:
    for _ in range(600):
        with suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=1):
            return
        time.sleep(0.1)
    raise AssertionError("the S3 server does not answer")


def test_images_and_results_in_a_bucket(
    home: Path, truth: Path, tmp_path: Path, bucket: str, double: InProcessEngine
) -> None:
    sides = [str(home / "left"), str(home / "right")]
    assert match(home, tmp_path / "plain", *sides) == 0
    store = s3fs()
    for side in ("left", "right"):
        store.put(str(home / side), f"street/in/{side}", recursive=True)
    assert len(store.ls("street/in/left")) == 5
    out = f"{bucket}/out"
    words = [f"{bucket}/in/left", f"{bucket}/in/right", "--block", "2", *RAY]
    for _ in range(2):  # the second run finds all there
        assert main(["depth", "match", *words, "--camera", str(home / "rig.json"), "--no-check",
                     "--weights", str(home / "m.safetensors"), "--out", out]) == 0  # fmt: skip
    store.get("street/out", str(tmp_path / "copy"), recursive=True)
    assert unpacked(tmp_path / "copy") == files_of(tmp_path / "plain")
    measure = ["depth", "evaluate", "--data", str(truth), "--protocol", "kitti-2015"]
    for name, given in (("a", str(tmp_path / "plain")), ("b", out)):
        where = ["--predictions", given, "--out", str(tmp_path / name)]
        assert main([*measure, *where]) == 0
    one, other = ((tmp_path / name / "frames.json").read_text() for name in "ab")
    assert one == other


def test_a_store_that_refuses_is_named(
    home: Path, tmp_path: Path, bucket: str, double: InProcessEngine,
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    s3fs().put(str(home / "left"), "street/in", recursive=True)
    assert predict(home, tmp_path / "out", f"{bucket}/nothing", *RAY) == 2
    assert "s3://street/nothing: no .png" in capsys.readouterr().err
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "not the secret")
    s3fs()  # forgets the connection that knew the secret
    assert predict(home, tmp_path / "out", f"{bucket}/in", *RAY) == 2
    assert "check the address and the credentials" in capsys.readouterr().err
