"""What the README tells a newcomer to type, typed."""

import re
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.pose.synthetic_objects import write_part
from tests.written import ROOT, read_blocks, run
from tests.written import commands as commands_of

from depthpose.cli import COMMANDS
from depthpose.core.files import read_depth_png

README = (ROOT / "README.md").read_text()


def commands(page: str) -> list[str]:
    return commands_of(read_blocks(ROOT / page))


@pytest.fixture
def demo_folder(after_demo: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(after_demo)
    return after_demo


@pytest.mark.slow
def test_the_commands_of_the_readme_run(demo_folder: Path) -> None:
    lines = commands("README.md")
    assert lines
    assert [run(line) for line in lines] == [0] * len(lines)
    assert (demo_folder / "out/predict/left.cloud.ply").is_file()
    assert (demo_folder / "out/registered/poses.json").is_file()


@pytest.mark.parametrize("page", ["README.md", "docs/quickstart.md"])
def test_the_python_lines_run_and_end_in_metres(demo_folder: Path, page: str) -> None:
    names: dict[str, object] = {}
    for block in read_blocks(ROOT / page):
        if block.language == "python":
            exec(block.code, names)  # the pages are ours
    assert names["depth_m"].ndim == 2  # pyright: ignore[reportAttributeAccessIssue]
    assert demo_folder.is_dir()


@pytest.mark.slow
def test_the_service_of_the_page_answers(demo_folder: Path) -> None:
    """The page's own lines: many inputs with an error among them, and a service for a part."""
    testclient = pytest.importorskip("starlette.testclient")
    names: dict[str, Any] = {}
    for block in read_blocks(ROOT / "docs/services.md"):
        exec(block.code, names)  # the pages are ours
    with testclient.TestClient(names["app"]) as client:
        depth_m = read_depth_png(demo_folder / "out/demo/part/depth.png", 0.0001)
        body = BytesIO()
        np.save(body, depth_m.numpy())
        rows = client.post("/find", content=body.getvalue()).json()
        assert {row["status"] for row in rows} <= {"ok", "ambiguous"}
        refused = client.post("/find", content=b"no numbers")
        assert refused.status_code == 400
        assert refused.json()["error"]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::depthpose.core.devices.PrecisionNotice")
def test_the_commands_of_the_quick_start_run(demo_folder: Path) -> None:
    """A training for one step, in place of thousands."""
    (demo_folder / "configs").symlink_to(ROOT / "configs")
    write_part("bracket", demo_folder).rename(demo_folder / "part.stl")
    lines = [line.replace("part.yaml", "part.yaml --steps 1")
             for line in commands("docs/quickstart.md") if not line.endswith(" demo")]  # fmt: skip
    assert lines
    assert [run(line) for line in lines] == [0] * len(lines)
    assert (demo_folder / "out/measured/report.html").is_file()


@pytest.mark.data
@pytest.mark.slow
def test_published_weights_are_imported_and_match(demo_folder: Path, real: Path) -> None:
    published = demo_folder / "pretrained_model_KITTI2015.tar"
    published.symlink_to(real / "reference/psmnet/published_kitti2015.tar")
    lines = commands("docs/weights.md")
    assert lines
    assert [run(line) for line in lines] == [0] * len(lines)


@pytest.mark.parametrize("target", sorted(set(re.findall(r"^make (\w+)", README, re.MULTILINE))))
def test_the_make_targets_exist(target: str) -> None:
    assert re.search(rf"^{target}:", (ROOT / "Makefile").read_text(), re.MULTILINE)


PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


@pytest.mark.parametrize("page", PAGES)
def test_commands_in_the_text_exist(page: Path) -> None:
    groups = "|".join(sorted({name.split()[0] for name in COMMANDS if " " in name}))
    named = re.findall(rf"`(?:depthpose )?((?:{groups}) [a-z][a-z-]*)", page.read_text())
    known = {" ".join(name.split()[:2]) for name in COMMANDS}
    assert not set(named) - known


def test_the_links_lead_somewhere() -> None:
    for link in re.findall(r"\]\(([^)#]+)\)", README):
        assert link.startswith("http") or (ROOT / link).exists(), link


def test_nothing_names_a_release_that_there_is_not() -> None:
    """No index has a package of this name yet: an extra is installed from the clone."""
    for path in [ROOT / "README.md", *ROOT.glob("docs/**/*.md"), *ROOT.glob("src/**/*.py")]:
        assert not re.search(r"pip install [^\n`]*depthpose\[", path.read_text()), path


def extras_of(script: Path) -> set[str]:
    """Extras that a bench needs for other systems, by its text and that of what it imports."""
    text = script.read_text()
    needed = {"open3d"} & set(re.findall(r'import_extra\("(\w+)"', text))
    needed |= {"opencv"} if re.search(r"import cv2|\bSGBM(Matcher|Config)\b", text) else set()
    for name in re.findall(r"^ *from (\w+) import", text, re.MULTILINE):
        if (other := script.with_name(f"{name}.py")).is_file():
            needed |= extras_of(other)
    return needed


def test_results_say_which_extra_each_command_needs() -> None:
    text = (ROOT / "docs/results.md").read_text()
    head, _, rest = text.partition("## One image")
    rows = re.findall(r"^\| `(\w+)` \| (.*) \|$", head, re.MULTILINE)
    said = {extra: set(re.findall(r"bench/(\w+)\.py", row)) for extra, row in rows}
    needed: dict[str, set[str]] = {"open3d": set(), "opencv": set()}
    for script in set(re.findall(r"bench/(\w+)\.py", rest)):
        for extra in extras_of(ROOT / f"bench/{script}.py"):
            needed[extra].add(script)
    assert said == needed
