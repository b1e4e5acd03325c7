"""The hub is a server of ours on this machine; nothing here leaves it."""

import hashlib
import sys
import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
import torch

from depthpose.core import hub
from depthpose.core.checkpoint import Checkpoint, find_weights, read_checkpoint, save_checkpoint
from depthpose.core.errors import InputError, MissingExtraError

huggingface_hub = pytest.importorskip("huggingface_hub")
constants = pytest.importorskip("huggingface_hub.constants")
errors = pytest.importorskip("huggingface_hub.errors")
COMMIT = "0123456789abcdef0123456789abcdef01234567"


def write_weights(path: Path, **facts: str) -> Path:
    state = {"w": torch.arange(3.0)}
    save_checkpoint(path, Checkpoint(kind="toy", config={}, state=state, facts=facts))
    return path


class FakeHub(BaseHTTPRequestHandler):
    """Two repositories with the answers that the hub gives; private and unknown ones without."""

    files: dict[str, bytes]
    asked: list[str]

    def do_HEAD(self) -> None:
        self.asked.append(f"{self.command} {self.path}")
        repository, _, rest = self.path.strip("/").partition("/resolve/")
        revision, _, file = rest.partition("/")
        if repository == "gated/part":
            self._refuse(403, "GatedRepo")
        elif repository != "me/part":
            self._refuse(404, "RepoNotFound")
        elif revision not in ("main", "v1"):
            self._refuse(404, "RevisionNotFound")
        elif file not in self.files:
            self._refuse(404, "EntryNotFound")
        else:
            self._give(self.files[file])

    do_GET = do_HEAD  # noqa: N815

    def _give(self, content: bytes) -> None:
        self.send_response(200)
        self.send_header("X-Repo-Commit", COMMIT)
        self.send_header("ETag", f'"{hashlib.sha256(content).hexdigest()}"')
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        if self.command == "GET":
            self.wfile.write(content)

    def _refuse(self, status: int, code: str) -> None:
        self.send_response(status)
        self.send_header("X-Error-Code", code)
        self.send_header("X-Error-Message", code)
        self.send_header("Content-Length", "0")
        self.end_headers()

    def log_message(self, format: str, *args: object) -> None:
        pass


@pytest.fixture
def server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[type[FakeHub]]:
    FakeHub.files = {}
    FakeHub.asked = []
    content = write_weights(tmp_path / "there.safetensors", licence="MIT").read_bytes()
    FakeHub.files |= {"model.safetensors": content, "other/second.safetensors": content}
    with ThreadingHTTPServer(("127.0.0.1", 0), FakeHub) as running:
        threading.Thread(target=running.serve_forever, args=(0.02,), daemon=True).start()
        address = f"http://127.0.0.1:{running.server_port}"
        template = address + "/{repo_id}/resolve/{revision}/{filename}"
        monkeypatch.setattr(constants, "ENDPOINT", address)
        monkeypatch.setattr(constants, "HUGGINGFACE_CO_URL_TEMPLATE", template)
        monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
        monkeypatch.setattr(constants, "HF_HUB_DISABLE_IMPLICIT_TOKEN", True)
        hub.fetch_weights.cache_clear()
        yield FakeHub
        running.shutdown()
    hub.fetch_weights.cache_clear()


@pytest.mark.parametrize(
    "name",
    [
        "hf://me/part",
        "hf://me/part@v1",
        "hf://me/part/other/second.safetensors",
        Path("hf://me/part"),
    ],
)
def test_weights_are_fetched_from_the_hub(name: str | Path, server: type[FakeHub]) -> None:
    found = read_checkpoint(find_weights(name))
    assert found.facts["licence"] == "MIT"
    assert torch.equal(found.state["w"], torch.arange(3.0))
    asked = len(server.asked)
    assert find_weights(name) == find_weights(name)
    assert len(server.asked) == asked


def test_nothing_is_asked_of_the_hub_but_by_its_name(server: type[FakeHub], tmp_path: Path) -> None:
    assert find_weights("default").name == "default.safetensors"
    with pytest.raises(InputError, match="neither a file nor the name of weights"):
        find_weights("me/part")
    with pytest.raises(InputError, match=r"only \.safetensors are fetched"):
        find_weights("hf://me/part/weights.pt")
    assert server.asked == []


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("hf://part", r"'hf://part': weights on the hub are hf://OWNER/NAME"),
        ("hf://me/part@", "weights on the hub are"),
        ("hf://me/pa--rt", "no name that the hub allows: [^{]*pa--rt"),
        ("hf://me/none", "no such repository, or it is private.*'hf auth login'"),
        ("hf://gated/part", "its owner asks for consent"),
        ("hf://me/part@v9", "no such revision"),
        ("hf://me/part/none.safetensors", "no such file .*hf://OWNER/NAME/FILE"),
    ],
)
def test_a_name_that_leads_nowhere_is_refused(
    name: str, message: str, server: type[FakeHub]
) -> None:
    with pytest.raises(InputError, match=message):
        find_weights(name)


def test_offline_the_cache_serves_and_what_it_lacks_is_said(
    server: type[FakeHub], monkeypatch: pytest.MonkeyPatch
) -> None:
    before = find_weights("hf://me/part")
    hub.fetch_weights.cache_clear()
    asked = len(server.asked)
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    assert find_weights("hf://me/part") == before
    with pytest.raises(InputError, match="cannot be reached, and it is not in the cache"):
        find_weights("hf://me/other")
    assert len(server.asked) == asked


def test_a_hub_that_does_not_answer_is_said(
    server: type[FakeHub], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(time, "sleep", lambda _seconds: None)  # between the library's own tries
    # Port 1 of this machine: nobody listens there.
    nowhere = "http://127.0.0.1:1"
    template = nowhere + "/{repo_id}/resolve/{revision}/{filename}"
    monkeypatch.setattr(constants, "ENDPOINT", nowhere)
    monkeypatch.setattr(constants, "HUGGINGFACE_CO_URL_TEMPLATE", template)
    with pytest.raises(InputError, match=r"hub cannot be reached.*give its path"):
        find_weights("hf://me/part")


def test_a_missing_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    hub.fetch_weights.cache_clear()
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(MissingExtraError, match=r"pip install -e '.\[hub\]'"):
        find_weights("hf://me/part")


def test_a_folder_of_weights_is_found(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"holds one \.safetensors file.*here: none"):
        find_weights(tmp_path)
    one = write_weights(tmp_path / "one.safetensors")
    assert find_weights(tmp_path) == one
    write_weights(tmp_path / "two.safetensors")
    with pytest.raises(InputError, match=r"here: one\.safetensors, two\.safetensors\. Name"):
        find_weights(tmp_path)
    assert find_weights(write_weights(tmp_path / "model.safetensors").parent).stem == "model"
