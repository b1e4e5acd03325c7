import csv
import io
import json
import re
from base64 import b64decode
from pathlib import Path

import torch
from PIL import Image

from depthpose.core.files import PointCloud, write_image
from depthpose.report.page import (
    Drawing,
    Layer,
    PictureFile,
    Scene,
    Section,
    embed_picture,
    format_markdown_table,
    format_plain_table,
    make_frame_axes,
    make_rising_color_bar,
    write_markdown,
    write_page,
    write_table,
)

ROWS = [{"name": "a|b", "x": 0.123456, "n": 3}, {"name": "c", "x": 80.0, "more": None}]


def test_markdown_has_every_column_in_order() -> None:
    assert format_markdown_table(ROWS) == (
        "| name | x | n | more |\n| --- | --- | --- | --- |\n"
        "| a\\|b | 0.1235 | 3 |  |\n| c | 80 |  |  |\n"
    )


def test_a_frame_is_drawn_by_where_its_axes_point() -> None:
    """Turned by 90 degrees about z: x points along the camera's y, y against its x."""
    R = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    origin_m = torch.tensor([1.0, 2, 3])
    axes = make_frame_axes(origin_m, R, 0.5)
    assert axes.ends_m[:, 0].tolist() == [[1, 2, 3]] * 3
    assert axes.ends_m[:, 1].tolist() == [[1, 2.5, 3], [0.5, 2, 3], [1, 2, 3.5]]


def test_csv_keeps_every_digit(tmp_path: Path) -> None:
    write_table(tmp_path, ROWS)
    read = list(csv.DictReader(io.StringIO((tmp_path / "rows.csv").read_text())))
    assert float(read[0]["x"]) == 0.123456


def test_the_table_is_written_three_times(tmp_path: Path) -> None:
    write_table(tmp_path, ROWS)
    assert json.loads((tmp_path / "rows.json").read_text()) == ROWS
    assert sorted(path.name for path in tmp_path.iterdir()) == ["rows.csv", "rows.json", "table.md"]


def test_the_page_stands_alone_and_escapes_what_it_shows(tmp_path: Path) -> None:
    write_image(tmp_path / "p.png", torch.zeros(3, 2, 2))
    picture = PictureFile(path=tmp_path / "p.png", caption="a <picture>")
    sections = [Section(title="T & S", text="<script>x</script>", rows=ROWS, pictures=[picture])]
    write_page(tmp_path / "page.html", "Title", sections, {"torch": "2"})
    html = (tmp_path / "page.html").read_text()
    assert "data:image/png;base64," in html
    assert 'width="2" height="2"' in html, "nothing moves when the picture comes"
    assert "&lt;script&gt;x" in html
    assert "a &lt;picture&gt;" in html
    assert "http" not in html
    assert 'src="p.png' not in html


def test_the_head_of_a_column_says_what_it_is(tmp_path: Path) -> None:
    rows = [{"success": 0.84, "instances": 25, "d1_all": 0.1}]
    write_page(tmp_path / "page.html", "Title", [Section(title="One", rows=rows)], {})
    heads = (tmp_path / "page.html").read_text().split("<th ")[1:]
    said = [re.search(r'title="([^"]+)"', head.partition(">")[0]) for head in heads]
    assert said[0] is not None
    assert "65 to 94 %" in said[0][1], "of few views a share is no point"
    assert said[1] is None
    assert said[2] is not None
    assert "3 px" in said[2][1]


def test_a_page_holds_its_scenes_and_the_viewer_once(tmp_path: Path) -> None:
    cloud = Layer(name="</script><b>", shape=PointCloud(points=torch.zeros(2, 3)))
    scene = Scene(caption="a <cloud>", layers=[cloud])
    sections = [Section(title="One", scenes=[scene, scene]), Section(title="Two", scenes=[scene])]
    write_page(tmp_path / "page.html", "Title", sections, {})
    html = (tmp_path / "page.html").read_text()
    assert html.count("const showScene") == 1
    found = re.findall(r'<script type="application/json">(.*?)</script>', html, re.DOTALL)
    assert [json.loads(text) for text in found] == [scene.encode()] * 3
    assert "a &lt;cloud&gt;" in html
    assert "://" not in html


def test_a_page_shows_facts_numbers_and_pictures_of_no_file(tmp_path: Path) -> None:
    bar = make_rising_color_bar("error <px>", 4.0)
    drawing = Drawing(image=torch.rand(3, 1000, 1000), caption="a <drawing>", color_bar=bar)
    section = Section(
        title="One",
        facts=[("size", "2 < 3")],
        tables={"R | t": [["1.0", "<2>"]]},
        pictures=[drawing],
    )
    write_page(tmp_path / "page.html", "Title", [section], {})
    html = (tmp_path / "page.html").read_text()
    assert "<dt>size</dt><dd>2 &lt; 3</dd>" in html
    assert "<caption>R | t</caption>" in html
    assert "<td>1.0</td><td>&lt;2&gt;</td>" in html
    assert "error &lt;px&gt;" in html
    assert 'alt="a &lt;drawing&gt;"' in html
    assert "linear-gradient(to right, rgb(5, 5, 26), " in html
    encoded = re.findall(r'src="data:image/jpeg;base64,(.*?)"', html)
    (picture,) = (Image.open(io.BytesIO(b64decode(text))) for text in encoded)
    assert 460_000 < picture.width * picture.height <= 480_000
    assert [path.name for path in tmp_path.iterdir()] == ["page.html"]


def test_a_page_without_scenes_brings_no_viewer(tmp_path: Path) -> None:
    write_page(tmp_path / "page.html", "Title", [Section(title="One", rows=ROWS)], {})
    assert "showScene" not in (tmp_path / "page.html").read_text()


def test_the_words_and_tables_of_a_page_are_markdown_too(tmp_path: Path) -> None:
    sections = [Section(title="One", text="Words.", rows=ROWS), Section(title="Two")]
    write_markdown(tmp_path / "r.md", "Title", sections, {"torch": "2", "date": "today"})
    text = (tmp_path / "r.md").read_text()
    assert text.startswith("# Title\n\n## One\n\nWords.\n\n| name | x |")
    assert text.endswith("## Two\n\ntorch 2 · date today\n")


def test_a_table_for_the_terminal_has_the_columns_that_are_asked_for() -> None:
    rows = [
        {"method": "ours", "d1": 0.5, "much": 1, "none": None},
        {"method": "theirs", "d1": 0.25, "much": 2, "none": None},
    ]
    assert format_plain_table(rows, ["method", "d1", "none", "elsewhere"]) == (
        "method  d1\nours    0.5000\ntheirs  0.2500\n"
    )
    assert format_plain_table(rows).startswith("method  d1      much\n")


def test_a_large_picture_is_made_small_enough_for_a_page(tmp_path: Path) -> None:
    noise = torch.rand(3, 800, 1000, generator=torch.Generator().manual_seed(0))
    write_image(tmp_path / "p.png", noise)
    picture = PictureFile(path=tmp_path / "p.png", caption="noise")
    width, height, address = embed_picture(picture)
    assert (width, height) == (1000, 800)
    assert address.startswith("data:image/jpeg;base64,")
    assert len(address) < (tmp_path / "p.png").stat().st_size / 2
