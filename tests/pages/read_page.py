"""A page as a reader has it: headings, words, cells, pictures and scenes, entities resolved."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

from depthpose.report.page import Drawing, Section

_TEXT = {"h1", "h2", "p", "td", "dd", "dt", "figcaption"}


@dataclass
class ReadPage(HTMLParser):
    """What stands on a page; ``texts`` by the tag around them."""

    texts: dict[str, list[str]] = field(default_factory=dict)
    pictures: list[dict[str, str]] = field(default_factory=list)
    scenes: list[dict[str, Any]] = field(default_factory=list)
    tags: set[str] = field(default_factory=set)
    _open: str = ""

    def __post_init__(self) -> None:
        super().__init__()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        facts = {name: value or "" for name, value in attrs}
        self.tags.add(tag)
        if tag == "img":
            self.pictures.append(facts)
        if facts.get("type") == "application/json":
            self._open = "scene"
        elif tag in _TEXT:
            self._open = tag
            self.texts.setdefault(tag, []).append("")

    def handle_endtag(self, tag: str) -> None:
        del tag
        self._open = ""

    def handle_data(self, data: str) -> None:
        if self._open == "scene":
            self.scenes.append(json.loads(data))
        elif self._open:
            self.texts[self._open][-1] += data

    def layers(self, scene: int) -> list[str]:
        return [layer["name"] for layer in self.scenes[scene]["layers"]]


def read_page(path: Path) -> ReadPage:
    """Read a page that must stand alone: it names no address but its own data."""
    html = path.read_text(encoding="utf-8")
    assert "://" not in html
    assert path.stat().st_size < 20e6
    page = ReadPage()
    page.feed(html)
    assert all(picture["src"].startswith("data:image/") for picture in page.pictures)
    assert all(picture["alt"] for picture in page.pictures)
    return page


def drawings(section: Section) -> Sequence[Drawing]:
    """Give the pictures of a part that lie on its page alone."""
    found = [picture for picture in section.pictures if isinstance(picture, Drawing)]
    assert len(found) == len(section.pictures)
    return found
