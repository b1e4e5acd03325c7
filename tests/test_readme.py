"""What the README tells a newcomer to type, typed."""

import re
from pathlib import Path

import pytest
from tests.written import ROOT, read_blocks, run
from tests.written import commands as commands_of

from depthpose.pose.synthetic import write_part

README = (ROOT / "README.md").read_text()
BLOCKS = read_blocks(ROOT / "README.md")
PUBLISHED = "pretrained_model_KITTI2015.tar"


def commands() -> list[str]:
    return commands_of(BLOCKS)


@pytest.fixture
def demo_folder(after_demo: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(after_demo)
    return after_demo


def test_the_commands_that_need_no_data_run(demo_folder: Path) -> None:
    lines = [line for line in commands() if " depth " in line and " out/demo" in line]
    lines = [line for line in lines if "psmnet" not in line]
    assert len(lines) == 2
    assert [run(line) for line in lines] == [0] * len(lines)
    assert (demo_folder / "out/predict/left.cloud.ply").is_file()


def test_the_commands_that_pose_run(demo_folder: Path) -> None:
    lines = [line for line in commands() if " pose " in line and " out/demo" in line]
    assert len(lines) == 5
    assert [run(line) for line in lines] == [0] * len(lines)
    assert (demo_folder / "out/measured/report.html").is_file()


def test_the_python_lines_run_and_end_in_metres(demo_folder: Path) -> None:
    names: dict[str, object] = {}
    for block in BLOCKS:
        if block.language == "python":
            exec(block.code, names)  # the README is ours
    assert names["depth_m"].ndim == 2  # pyright: ignore[reportAttributeAccessIssue]


@pytest.mark.data
@pytest.mark.slow
def test_the_commands_that_need_data_run(demo_folder: Path, real: Path) -> None:
    (demo_folder / PUBLISHED).symlink_to(real / "reference/psmnet/published_kitti2015.tar")
    (demo_folder / "KITTI").symlink_to(real / "depth/kitti_object")
    (demo_folder / "MY_PAIRS").symlink_to(real / "depth/street_pairs/kitti_single")
    lines = [line for line in commands() if "psmnet" in line or "KITTI" in line]
    assert len(lines) == 6
    for line in lines:
        # The samples are no whole KITTI: three frames stand for the 697 of the split.
        more = " --split all" if " reproduce " in line else ""
        allowed = (0, 1) if " data " in line else (0,)
        assert run(line + more) in allowed, line


@pytest.mark.filterwarnings("ignore::depthpose.core.devices.PrecisionNotice")
def test_the_commands_that_train_run(demo_folder: Path) -> None:
    """On three streets and for one step, in place of a thousand and of three thousand."""
    (demo_folder / "configs").symlink_to(ROOT / "configs")
    write_part("bracket", demo_folder).rename(demo_folder / "part.stl")
    lines = [line for line in commands() if " make streets" in line or " train " in line]
    assert len(lines) == 3
    for line in lines:
        short = line.replace("--number 1000", "--number 3").replace(
            "--data streets", "--data streets --steps 1"
        )
        assert run(short.replace("part.yaml", "part.yaml --steps 1")) == 0, line


@pytest.mark.parametrize("target", sorted(set(re.findall(r"^make (\w+)", README, re.MULTILINE))))
def test_the_make_targets_exist(target: str) -> None:
    assert re.search(rf"^{target}:", (ROOT / "Makefile").read_text(), re.MULTILINE)


def test_the_links_lead_somewhere() -> None:
    for link in re.findall(r"\]\(([^)#]+)\)", README):
        assert link.startswith("http") or (ROOT / link).exists(), link


def test_the_first_lines_to_type_are_there() -> None:
    """Tests, the command on the path, the size of torch and the smaller build."""
    install = README.partition("## Install")[2].partition("\n## ")[0]
    for words in ("make demo\n", "make test\n", "source .venv/bin/activate", "6.3 GB",
                  "PIP_EXTRA_INDEX_URL=URL make demo"):  # fmt: skip
        assert words in install, words


def test_poses_lead_and_one_image_comes_last() -> None:
    assert README.index("GeoPoseNet.load(") < README.index("FakestereoNet.load(")
    words = ("pose predict", "depth match", "depth predict")
    assert [w for line in commands() for w in words if f" {w} " in line and "demo" in line][:4] == [
        "pose predict", "pose predict", "depth match", "depth predict",
    ]  # fmt: skip
    assert "streets seen by a forward camera" in README.partition("## Install")[0]


def test_nothing_names_a_release_that_there_is_not() -> None:
    """No index has a package of this name yet: an extra is installed from the clone."""
    for path in [ROOT / "README.md", *ROOT.glob("docs/**/*.md"), *ROOT.glob("src/**/*.py")]:
        if path.name != "fresh.md":  # what was typed there installed a wheel
            assert not re.search(r"pip install [^\n`]*depthpose\[", path.read_text()), path
