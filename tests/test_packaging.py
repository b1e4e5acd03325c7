"""Image, CI file and release checklist: what they name exists.

No builder of images is at hand where these tests run; the CI file builds one.
"""

import json
import os
import re
import shlex
import subprocess
import sys
import threading
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import is_dataclass
from fnmatch import fnmatch
from http.server import BaseHTTPRequestHandler, HTTPServer
from importlib import import_module
from inspect import signature
from pathlib import Path
from typing import Any

import pytest
import yaml
from tests.written import ROOT

from depthpose import __version__
from depthpose.cli import COMMANDS

PROJECT: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text())
RELEASE = (ROOT / "docs/release.md").read_text()


def read_dockerfile() -> list[tuple[str, str]]:
    """Each instruction of the Dockerfile and what follows it, in order."""
    text = (ROOT / "Dockerfile").read_text().replace("\\\n", " ")
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    return [(name, rest.strip()) for name, _, rest in (line.partition(" ") for line in lines)]


STEPS = read_dockerfile()


def of(name: str) -> list[str]:
    return [rest for instruction, rest in STEPS if instruction == name]


def is_sent(path: str) -> bool:
    """Whether .dockerignore lets a file through: the last line that matches decides."""
    sent = True
    for line in (ROOT / ".dockerignore").read_text().splitlines():
        if not line or line.startswith("#"):
            continue
        pattern, is_kept = line.removeprefix("!"), line.startswith("!")
        names = [path, *(str(parent) for parent in Path(path).parents)]
        bare = pattern.removeprefix("**/")
        if any(fnmatch(name, pattern) or fnmatch(Path(name).name, bare) for name in names):
            sent = is_kept
    return sent


@pytest.mark.parametrize("name", ["Dockerfile", ".dockerignore", ".github/workflows/ci.yml"])
def test_no_host_is_named_but_this_machine(name: str) -> None:
    hosts = re.findall(r"://([^/'\"\s:]+)", (ROOT / name).read_text())
    assert set(hosts) <= {"127.0.0.1"}


def test_what_is_copied_exists_and_is_sent() -> None:
    for line in of("COPY"):
        *sources, target = shlex.split(line)
        assert target.startswith("./")
        for source in sources:
            assert (ROOT / source).exists(), source
            assert is_sent(source), source
    assert is_sent("src/depthpose/weights/default.safetensors")
    assert is_sent("src/depthpose/weights/parts.safetensors")


def test_what_is_not_for_everyone_is_not_sent() -> None:
    weights = [path.name for path in (ROOT / "src/depthpose/weights").iterdir()]
    kept_back = [name for name in weights if "-nc." in name or name.startswith("ycb.")]
    assert kept_back
    for name in (*(f"src/depthpose/weights/{kept}" for kept in kept_back), ".git", "out", "tests"):
        assert not is_sent(name), name


def test_what_starts_is_a_command_with_its_options() -> None:
    (entry,), (first, *options) = (json.loads(of(name)[0]) for name in ("ENTRYPOINT", "CMD"))
    assert entry in PROJECT["project"]["scripts"]
    home, _, function = COMMANDS[first][0].partition(":")
    parameters = signature(getattr(import_module(f"depthpose.cli.{home}"), function)).parameters
    groups = [vars(p.default) for p in parameters.values() if is_dataclass(p.default)]
    known = set(parameters).union(*groups)
    given = dict(zip(options[::2], options[1::2], strict=True))
    assert {name.removeprefix("--").replace("-", "_") for name in given} <= known
    assert given["--host"] == "0.0.0.0"  # else nothing outside the container reaches it
    assert given["--port"] == of("EXPOSE")[0]
    assert f"127.0.0.1:{given['--port']}/" in of("HEALTHCHECK")[0]


class _Answer(BaseHTTPRequestHandler):
    status = 200

    def do_GET(self) -> None:
        self.send_response(self.status)
        self.end_headers()

    def log_message(self, *_: object, **__: object) -> None: ...


@contextmanager
def answering(status: int) -> Iterator[int]:
    handler = type("Handler", (_Answer,), {"status": status})
    server = HTTPServer(("127.0.0.1", 0), handler)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield server.server_address[1]
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def health(port: int) -> int:
    """Run the image's health check against a port of this machine; give its exit code."""
    python, *words = json.loads(of("HEALTHCHECK")[0].partition("CMD")[2])
    assert python == "python"
    words = [word.replace(":8000/", f":{port}/") for word in words]
    return subprocess.run([sys.executable, *words], capture_output=True, check=False).returncode


def test_the_health_check_tells_a_page_from_none() -> None:
    with answering(200) as port:
        assert health(port) == 0
    assert health(port) != 0
    with answering(500) as port:
        assert health(port) != 0


@pytest.mark.skipif(sys.platform == "win32", reason="a script of bash")
def test_each_version_of_the_pages_has_a_folder(tmp_path: Path) -> None:
    names = {f"GIT_{who}_{what}": "a@b" for who in ("AUTHOR", "COMMITTER")
             for what in ("NAME", "EMAIL")}  # fmt: skip

    def call(*words: str, at: Path = tmp_path) -> str:
        done = subprocess.run(
            words, cwd=at, env={**os.environ, **names}, capture_output=True, text=True, check=True
        )
        return done.stdout

    call("git", "init", "--quiet", "--bare", "origin")
    call("git", "clone", "--quiet", "origin", "clone")
    clone, site = tmp_path / "clone", tmp_path / "site"
    (clone / "file").write_text("of the project")
    call("git", "add", "file", at=clone)
    call("git", "commit", "--quiet", "--message", "one", at=clone)
    site.mkdir()
    for version in ("v0.9.0", "v0.10.0", "v0.9.1", "v0.9.1"):
        (site / "index.html").write_text(f"pages of {version}")
        call(str(ROOT / ".ci/pages"), str(site), version, at=clone)
    listed = call("git", "ls-tree", "-r", "--name-only", "gh-pages", at=tmp_path / "origin")
    kept = [f"{version}/index.html" for version in ("v0.10.0", "v0.9.0", "v0.9.1")]
    assert listed.split() == [".nojekyll", "index.html", *kept]
    index = call("git", "show", "gh-pages:index.html", at=tmp_path / "origin")
    assert re.findall(r'href="([^"]+)"', index) == [kept[0], kept[2], kept[1]]
    of_last = call("git", "show", "gh-pages:v0.9.1/index.html", at=tmp_path / "origin")
    assert of_last == "pages of v0.9.1"
    assert (clone / "file").read_text() == "of the project"


def test_the_release_checklist_names_what_is_there() -> None:
    makefile = (ROOT / "Makefile").read_text()
    for target in re.findall(r"`make (\w+)`", RELEASE):
        assert re.search(rf"^{target}:", makefile, re.MULTILINE), target
    names = re.findall(r"`([\w./-]+(?:\.(?:py|md|cff|toml|txt)|/run|Dockerfile))`", RELEASE)
    assert len(names) >= 5
    for name in names:
        assert (ROOT / name).exists(), name
    for command in re.findall(r"`depthpose (\w+)`", RELEASE):
        assert command in COMMANDS, command
    assert re.findall(r"\[([\w,]+)\]", RELEASE)


def test_one_version_stands_everywhere() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert str(citation["version"]) == __version__
    newest = re.findall(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)[0]
    assert newest == __version__
