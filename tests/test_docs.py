"""The built documentation: strict, and read without a network."""

import os
import re
import shutil
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
    """The site that ``DEPTHPOSE_SITE`` names, as .ci/run has just built it, or one of our own."""
    if "DEPTHPOSE_SITE" in os.environ:
        return ROOT / os.environ["DEPTHPOSE_SITE"]
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
def test_the_pictures_show_every_package_and_module(site: Path) -> None:
    page = (site / "architecture.html").read_text()
    for package in ("core", "depth", "pose"):
        for path in (ROOT / "src/depthpose" / package).iterdir():
            if (
                path.stem.isidentifier()
                and not path.stem.startswith("__")
                and path.suffix in ("", ".py")
            ):
                assert f">{path.stem}</text>" in page, path


@pytest.mark.slow
def test_each_class_of_the_api_has_a_page(site: Path) -> None:
    for module, name in (
        ("core.camera", "StereoRig"),
        ("core.camera", "Rectifier"),
        ("depth.estimator", "FakestereoNet"),
        ("pose.network_pose", "GeoPoseNet"),
        ("core.errors", "InputError"),
    ):
        full = f"depthpose.{module}.{name}"
        assert f'id="{full}"' in (site / f"api/classes/{full}.html").read_text()
        page = (site / f"api/{module.partition('.')[0]}.html").read_text()
        assert f'href="classes/{full}.html"' in page
        assert f'<dt class="sig sig-object py" id="{full}">' not in page


@pytest.mark.slow
def test_install_and_quick_start_lead_the_sidebar(site: Path) -> None:
    links = re.findall(r'toctree-l1[^>]*><a[^>]*href="([^"]+)"', (site / "index.html").read_text())
    assert links[:2] == ["install.html", "quickstart.html"]
    for page, words in (("install", "make demo"), ("quickstart", "depthpose demo")):
        shown = re.sub(r"<[^>]+>", "", (site / f"{page}.html").read_text())
        assert f"{words}\n" in shown, page


CUT = """() => [...document.querySelectorAll("article pre")]
    .filter(code => code.scrollWidth > code.clientWidth + 1).map(code => code.innerText)"""


@pytest.mark.slow
def test_no_code_is_cut_off_on_a_small_laptop(site: Path) -> None:
    chromium = shutil.which("chromium")
    if chromium is None:
        pytest.skip("there is no chromium on PATH: apt-get install chromium")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        look = browser.new_page(viewport={"width": 1280, "height": 800})
        for page in sorted(site.glob("*.html")) + sorted(site.glob("tutorials/*.html")):
            look.goto(page.as_uri())
            assert look.evaluate(CUT) == [], page.name
        browser.close()
