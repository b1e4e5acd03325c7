"""The hub is a server of ours on this machine; nothing here leaves it."""

import hashlib
import inspect
import sys
import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
import torch

from depthpose.cli import main
from depthpose.core import hub
from depthpose.core.checkpoint import Checkpoint, find_weights, read_checkpoint, save_checkpoint
from depthpose.core.errors import InputError, MissingExtraError

huggingface_hub = pytest.importorskip("huggingface_hub")
constants = pytest.importorskip("huggingface_hub.constants")
errors = pytest.importorskip("huggingface_hub.errors")
REAL_API = huggingface_hub.HfApi
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
        threading.Thread(target=running.serve_forever, daemon=True).start()
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
        ("hf://me/pa--rt", "no name that the hub allows"),
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


class FakeApi:
    """What is asked of the hub's API, each call held to the signature of the real one."""

    calls: list[tuple[str, dict[str, Any]]]

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401
        signature = inspect.signature(getattr(REAL_API, name))

        def call(*args: object, **options: object) -> str:
            given = signature.bind(self, *args, **options).arguments
            self.calls.append((name, given))
            return "https://huggingface.co/me/part"

        return call


@pytest.fixture
def api(monkeypatch: pytest.MonkeyPatch) -> type[FakeApi]:
    FakeApi.calls = []
    monkeypatch.setattr(huggingface_hub, "HfApi", FakeApi)
    return FakeApi


@pytest.mark.parametrize("is_private", [True, False])
def test_weights_and_card_are_one_commit(
    is_private: bool, api: type[FakeApi], tmp_path: Path
) -> None:
    path = write_weights(tmp_path / "part.safetensors")
    assert hub.push_weights(path, "# Part\n", "me/part", is_private=is_private).endswith("me/part")
    (made, made_with), (committed, commit) = api.calls
    assert (made, committed) == ("create_repo", "create_commit")
    assert (made_with["repo_id"], made_with["private"]) == ("me/part", is_private)
    assert made_with["exist_ok"]
    sent = {one.path_in_repo: one.path_or_fileobj for one in commit["operations"]}
    assert sent == {"model.safetensors": str(path), "README.md": b"# Part\n"}


@pytest.mark.parametrize("name", ["part", "a/b/c", "https://huggingface.co/me/part", ""])
def test_a_repository_without_owner_is_refused(
    name: str, api: type[FakeApi], tmp_path: Path
) -> None:
    with pytest.raises(InputError, match="a repository on the hub is OWNER/NAME"):
        hub.push_weights(tmp_path / "part.safetensors", "", name, is_private=True)
    assert api.calls == []


def test_without_a_login_the_remedy_is_said(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    class Stranger(FakeApi):
        def create_repo(self, *args: object, **options: object) -> str:  # noqa: ARG002
            raise errors.LocalTokenNotFoundError("no token")

    monkeypatch.setattr(huggingface_hub, "HfApi", Stranger)
    path = write_weights(tmp_path / "part.safetensors")
    with pytest.raises(InputError, match=r"no token\. To upload, 'hf auth login' first"):
        hub.push_weights(path, "", "me/part", is_private=True)


def test_a_connection_that_breaks_under_a_push_is_said(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    broken = next(k for k in errors.HfHubHTTPError.__mro__[1:] if k.__module__ != "builtins")

    class Dead(FakeApi):
        def create_repo(self, *args: object, **options: object) -> str:  # noqa: ARG002
            raise broken("connection refused")

    monkeypatch.setattr(huggingface_hub, "HfApi", Dead)
    path = write_weights(tmp_path / "part.safetensors")
    with pytest.raises(InputError, match=r"the hub refused: connection refused"):
        hub.push_weights(path, "", "me/part", is_private=True)


@pytest.mark.parametrize(
    ("licence", "written"),
    [("MIT", "mit"), ("CC BY-NC-SA 3.0", "cc-by-nc-sa-3.0"), ("research only", "other")],
)
def test_the_readme_names_the_licence_as_the_hub_does(licence: str, written: str) -> None:
    text = hub.readme_of("# Part\n", {"licence": licence})
    assert text == f"---\nlibrary_name: depthpose\nlicense: {written}\n---\n\n# Part\n"


def readme_sent(api: type[FakeApi]) -> str:
    (_, commit) = api.calls[-1]
    (readme,) = [o for o in commit["operations"] if o.path_in_repo == "README.md"]
    return readme.path_or_fileobj.decode()


def test_the_command_pushes_a_card_and_keeps_to_itself_what_is_new(
    api: type[FakeApi], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_weights(tmp_path / "part.safetensors", licence="MIT", trained_on="cups")
    assert main(["weights", "push", str(path), "me/part"]) == 0
    assert "load them by hf://me/part" in capsys.readouterr().out
    assert "# part\n\n- **Licence**: MIT\n- **Trained on**: cups\n" in readme_sent(api)
    assert api.calls[0][1]["private"]
    (tmp_path / "part.md").write_text("# The card\n")
    assert main(["weights", "push", str(path), "me/part", "--public"]) == 0
    assert readme_sent(api).endswith("---\n\n# The card\n")
    assert not api.calls[-2][1]["private"]


def test_terms_are_said_before_a_push(
    api: type[FakeApi], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_weights(tmp_path / "part-nc.safetensors", terms="For research alone.")
    assert main(["weights", "push", str(path), "me/part"]) == 2
    said = capsys.readouterr()
    assert "For research alone." in said.out
    assert "If you may, add --accept-terms" in said.err
    assert api.calls == []
    assert main(["weights", "push", str(path), "me/part", "--accept-terms"]) == 0
    assert "For research alone." in capsys.readouterr().out
    assert len(api.calls) == 2
