"""The page and the demo's report in Debian's Chromium: upload, wait, look, take away."""

import io
import json
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from playwright.sync_api import Browser, Page, sync_playwright
from tests.web.samples import PART, write_street, write_view

from depthpose.cli import main
from depthpose.core.files import PointCloud
from depthpose.report.page import Layer, Scene, Section, make_lines, write_page

pytestmark = pytest.mark.slow

CHROMIUM = shutil.which("chromium")
# Software rendering: a machine that tests has no graphics card.
FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
PATIENCE_MS = 300_000
"""A busy machine is slow, not wrong."""


@pytest.fixture(scope="module")
def samples(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = write_street(tmp_path_factory.mktemp("samples"))
    write_view(folder)
    (folder / "words.txt").write_text("no picture")
    return folder


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    """Where ``depthpose serve`` answers."""
    command = [sys.executable, "-m", "depthpose", "serve", "--port", "0", "--max-upload-mb", "8"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        found = re.match(r"(http://127\.0\.0\.1:\d+/) ", server.stdout.readline())
        assert found is not None
        yield found[1]
        server.terminate()


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    if CHROMIUM is None:
        pytest.skip("there is no chromium on PATH: apt-get install chromium")
    with sync_playwright() as play:
        found = play.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield found
        found.close()


@pytest.fixture
def page(browser: Browser) -> Iterator[Page]:
    """A page that fails its test by any error in its scripts, or by asking another server."""
    context = browser.new_context(accept_downloads=True)
    made = context.new_page()
    made.set_default_timeout(PATIENCE_MS)
    wrong: list[str] = []
    made.on("pageerror", lambda error: wrong.append(str(error)))
    asked: list[str] = []
    made.on("request", lambda request: asked.append(request.url))
    yield made
    context.close()
    assert not wrong
    assert not [url for url in asked if not url.startswith(("http://127.0.0.1:", "file:", "data:"))]


def drawn_share(page: Page, within: str) -> float:
    """Give the share of the 3D view's pixels that something was drawn on."""
    return page.locator(f"{within} .scene canvas").evaluate(
        """canvas => {
          const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
          let drawn = 0;
          for (let i = 3; i < data.length; i += 4) drawn += data[i] > 0;
          return drawn / (data.length / 4);
        }"""
    )


def picture_of(page: Page, within: str) -> bytes:
    return page.locator(f"{within} .scene canvas").screenshot()


def take(page: Page, within: str, name: str) -> bytes:
    with page.expect_download() as waiting:
        page.locator(f"{within} .downloads a[download='{name}']").click()
    return Path(waiting.value.path()).read_bytes()


def send(page: Page, kind: str, files: dict[str, Path]) -> str:
    """Choose files, press the button, and give the sentence that comes back."""
    for field, path in files.items():
        page.locator(f"#{kind} input[name={field}]").set_input_files(path)
    page.locator(f"#{kind} .go").click()
    page.locator(f"#{kind} .answer .said").wait_for()
    return page.locator(f"#{kind} .said").text_content() or ""


def test_depth_good(page: Page, address: str, samples: Path) -> None:
    page.goto(f"{address}#depth")
    files = {"image": samples / "left.png", "camera": samples / "camera.json"}
    assert "half of these are nearer than" in send(page, "depth", files)
    assert page.locator("#depth .terms").count() == 0, "the weights have none"
    assert 0.05 < drawn_share(page, "#depth") < 1
    pictures = page.locator("#depth .pictures img")
    assert pictures.count() == 4, "the picture itself stands beside its depth"
    for k in range(4):
        shape = pictures.nth(k).evaluate("i => i.decode().then(() => [i.width / i.height, "
                                         "i.naturalWidth / i.naturalHeight])")  # fmt: skip
        assert shape[0] == pytest.approx(shape[1], rel=0.02)
        assert pictures.nth(k).get_attribute("height"), "nothing moves when it comes"
        assert pictures.nth(k).evaluate("image => image.decode().then(() => image.naturalWidth)")
    depth_m = np.load(io.BytesIO(take(page, "#depth", "left.depth_m.npy")))
    # The number under the pointer is the one in the file.
    bar = page.locator("#depth .pictures .scale").first
    assert bar.locator(".of").text_content() == "depth [m]"
    assert bar.locator(".marks span").first.text_content() == "3"
    assert "gradient" in bar.locator(".bar").evaluate("bar => getComputedStyle(bar).background")
    depth = pictures.nth(1)
    box = depth.bounding_box()
    assert box is not None
    depth.hover(position={"x": box["width"] / 2, "y": box["height"] * 0.9})
    page.locator("#depth .read", has_text="At (").wait_for()
    said = page.locator("#depth .read").nth(1).text_content() or ""
    found = re.search(r"At \((\d+), (\d+)\): ([\d.]+) m", said)
    assert found is not None
    u, v, shown_m = int(found[1]), int(found[2]), float(found[3])
    assert shown_m == pytest.approx(float(depth_m[v, u]), abs=0.006)
    before = picture_of(page, "#depth")
    page.locator("#depth canvas").press("ArrowLeft")
    page.wait_for_timeout(1000)
    assert picture_of(page, "#depth") != before, "the cloud turns"


@pytest.mark.parametrize("kind", ["pose", "depth"])
def test_an_example_fills_the_form_and_is_answered(page: Page, address: str, kind: str) -> None:
    page.goto(address if kind == "pose" else f"{address}#depth")
    assert page.locator(f"#{kind}").is_visible(), "poses lead"
    page.locator(f"#{kind} .try").click()
    page.locator(f"#{kind} .answer .said").wait_for()
    assert page.locator(f"#{kind} .said.failed").count() == 0
    assert page.locator(f"#{kind} .drop.has").count() == 3
    page.set_viewport_size({"width": 400, "height": 900})
    page.wait_for_timeout(500)
    width = page.evaluate("document.documentElement.scrollWidth")
    assert width <= 400, "a phone need not scroll sideways"
    cut = page.locator(f"#{kind} .table").evaluate_all(
        "tables => tables.map(table => table.scrollWidth - table.clientWidth)"
    )
    assert all(more <= 1 for more in cut), "nor in a table"


def test_terms_of_the_weights_are_read_with_the_answer(
    page: Page, address: str, samples: Path
) -> None:
    page.add_init_script("""const real = window.fetch;
      window.fetch = async (...words) => {
        const answer = await real(...words);
        if (!answer.url.includes("/estimate/")) return answer;
        const terms = "For <b>research</b> alone";
        return new Response(JSON.stringify({ ...await answer.json(), terms }));
      };""")
    kinds = {
        "depth": {"image": "left.png", "camera": "camera.json"},
        "pose": {"cloud": "cloud.ply"},
    }
    for kind, names in kinds.items():
        page.goto(f"{address}#{kind}")
        page.reload()
        page.locator("#pose details.box").evaluate("box => { box.open = true; }")
        send(page, kind, {field: samples / name for field, name in names.items()})
        said = page.locator(f"#{kind} [aria-live] .terms").text_content(timeout=5000)
        assert said == "Terms of the weights: For <b>research</b> alone"


def test_depth_bad(page: Page, address: str, samples: Path) -> None:
    page.goto(f"{address}#depth")
    said = send(page, "depth", {"image": samples / "words.txt"})
    assert "'words.txt' is not a picture; this field takes .png" in said
    page.reload()
    pair = {"image": samples / "left.png", "right": samples / "right.png"}
    assert "fill in the baseline in metres" in send(page, "depth", pair)
    assert page.locator("#depth .scene").count() == 0


def test_pose_good(page: Page, address: str, samples: Path) -> None:
    page.goto(f"{address}#pose")
    assert not page.locator("#depth").is_visible()
    page.locator("#pose select[name=object]").select_option(PART)
    view = {"depth": "depth.png", "mask": "mask.png", "camera": "view.json"}
    said = send(page, "pose", {field: samples / name for field, name in view.items()})
    assert said.startswith(f"The {PART} is at x ")
    assert page.locator("#pose .terms").count() == 0, "the weights have none"
    assert drawn_share(page, "#pose") > 0.02
    votes = page.locator("#pose .keys label").filter(has_text=re.compile(r"^\s*votes$"))
    before = picture_of(page, "#pose")
    votes.locator("input").check()
    page.wait_for_timeout(1000)
    assert picture_of(page, "#pose") != before, "the votes are drawn"
    assert page.locator("#pose .table").count() == 3
    (row,) = json.loads(take(page, "#pose", "poses.json"))
    assert row["status"] == "ok"
    assert take(page, "#pose", "all.zip").startswith(b"PK")


def test_pose_bad(page: Page, address: str, samples: Path) -> None:
    page.goto(f"{address}#pose")
    said = send(page, "pose", {"depth": samples / "depth.png"})
    assert "focal length: without it a depth image has no size" in said
    page.reload()
    page.locator("#pose select[name=object]").select_option("spool")
    view = {"depth": "depth.png", "mask": "mask.png", "camera": "view.json"}
    said = send(page, "pose", {field: samples / name for field, name in view.items()})
    assert said.startswith("Refused (")
    assert page.locator("#pose .said.refused").is_visible()


def test_a_report_turns_hides_sorts_and_needs_no_server(page: Page, tmp_path: Path) -> None:
    cloud = PointCloud(points=torch.rand(5000, 3) + torch.tensor([0.0, 0.0, 2.0]))
    box = make_lines(torch.tensor([[[0.0, 0, 2], [1, 1, 3]]]), (1.0, 0.0, 0.0))
    scene = Scene(
        caption="c", layers=[Layer(name="cloud", shape=cloud), Layer(name="box", shape=box)]
    )
    rows = [{"name": n, "x": x} for n, x in (("b", 10.0), ("a", 9.0), ("c", None))]
    write_page(tmp_path / "r.html", "T", [Section(title="S", rows=rows, scenes=[scene])], {})
    page.goto((tmp_path / "r.html").as_uri())
    page.locator(".scene canvas").wait_for()
    page.wait_for_timeout(1000)
    whole = drawn_share(page, "body")
    assert whole > 0.05
    page.locator(".keys label", has_text="cloud").locator("input").uncheck()
    page.wait_for_timeout(1000)
    assert 0 < drawn_share(page, "body") < whole / 2, "the box alone"
    for click, order in enumerate((["a", "b", "c"], ["b", "a", "c"])):
        page.locator("th", has_text="x").click()
        assert page.locator("td:first-child").all_text_contents() == order, click


@pytest.mark.parametrize("kind", ["depth", "pose"])
def test_the_page_of_a_prediction_is_drawn(
    page: Page, samples: Path, tmp_path: Path, kind: str
) -> None:
    given = {
        "depth": ["left.png", "--camera", "camera.json"],
        "pose": ["--depth", "depth.png", "--mask", "mask.png", "--camera", "view.json"],
    }[kind]
    words = [str(samples / word) if "." in word else word for word in given]
    words += ["--object", PART] if kind == "pose" else []
    assert main([kind, "predict", *words, "--out", str(tmp_path)]) == 0
    said: list[str] = []
    page.on("console", lambda message: said.append(message.text))
    page.goto((tmp_path / "report.html").as_uri())
    page.locator(".scene").scroll_into_view_if_needed()
    page.locator(".scene canvas").wait_for()
    page.wait_for_timeout(1000)
    assert drawn_share(page, "body") > 0.02
    before = picture_of(page, "body")
    page.locator(".scene canvas").press("ArrowLeft")
    page.wait_for_timeout(1000)
    assert picture_of(page, "body") != before, "the cloud turns"
    for picture in page.locator("img").all():
        assert picture.evaluate("image => image.decode().then(() => image.naturalWidth)")
    if kind == "pose":
        swatches = page.locator(".keys label", has_text="posed model").locator(".swatch")
        ink = swatches.first.evaluate("element => getComputedStyle(element).backgroundColor")
        assert ink == "rgb(38, 89, 255)"
    else:
        assert page.locator(".scale .marks span").first.text_content() == "3"
    assert not said


def test_without_webgl_there_is_a_sentence(page: Page, tmp_path: Path) -> None:
    page.add_init_script("""const real = HTMLCanvasElement.prototype.getContext;
      HTMLCanvasElement.prototype.getContext = function (kind, ...rest) {
        return kind === "webgl" ? null : real.call(this, kind, ...rest);
      };""")
    scene = Scene(
        caption="c", layers=[Layer(name="cloud", shape=PointCloud(points=torch.zeros(2, 3)))]
    )
    write_page(tmp_path / "r.html", "T", [Section(title="S", scenes=[scene])], {})
    page.goto((tmp_path / "r.html").as_uri())
    page.locator(".lacking").wait_for()
    assert "shows no WebGL" in (page.locator(".lacking").text_content() or "")
