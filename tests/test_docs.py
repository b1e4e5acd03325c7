"""The built documentation: strict, and read without a network."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
from tests.written import ROOT

LOADED = re.compile(
    r'<(?:script|img|iframe|link rel="(?:stylesheet|icon|preload)")[^>]*(?:src|href)="([^"]+)"'
)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    words = ["-q", "-W", "--keep-going", str(ROOT / "docs"), str(folder)]
    done = subprocess.run(
        [sys.executable, "-m", "sphinx", *words], capture_output=True, check=False
    )
    assert done.returncode == 0, done.stderr.decode()[-3000:]
    return folder


@pytest.mark.slow
def test_a_page_loads_nothing_from_the_network(site: Path) -> None:
    pages = list(site.rglob("*.html"))
    assert len(pages) > 20
    for page in pages:
        loaded = LOADED.findall(page.read_text())
        assert loaded
        for target in loaded:
            assert not re.match(r"(https?:)?//", target), (page, target)
            assert (page.parent / target.split("?")[0]).exists(), (page, target)
    for sheet in site.rglob("*.css"):
        assert not re.search(r"url\(['\"]?(https?:)?//|@import", sheet.read_text()), sheet


@pytest.mark.slow
def test_the_search_finds_the_estimators_without_a_server(site: Path) -> None:
    index = (site / "searchindex.js").read_text()
    assert index.startswith("Search.setIndex(")
    assert "geoposenet" in index


@pytest.mark.slow
def test_the_pictures_show_every_room_and_module(site: Path) -> None:
    page = (site / "architecture.html").read_text()
    for room in ("core", "depth", "pose"):
        for path in (ROOT / "src/depthpose" / room).iterdir():
            if (
                path.stem.isidentifier()
                and not path.stem.startswith("__")
                and path.suffix in ("", ".py")
            ):
                assert f">{path.stem}</text>" in page, path
