"""The notebooks: their cells, from top to bottom, in a plain Python."""

import ast
import json
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
from PIL import Image
from tests.written import ROOT

NOTEBOOKS = sorted((ROOT / "docs/notebooks").glob("*.ipynb"))


def run_cells(path: Path) -> list[object]:
    """Run a notebook's code, and give what each cell would show: its last expression."""
    shown: list[object] = []
    names: dict[str, Any] = {}
    for cell in json.loads(path.read_text())["cells"]:
        if cell["cell_type"] != "code":
            continue
        assert cell["outputs"] == [], "outputs are of one machine; clear them"
        *body, last = ast.parse("".join(cell["source"])).body
        exec(compile(ast.Module(body, []), path.name, "exec"), names)  # the notebooks are ours
        if isinstance(last, ast.Expr):
            shown.append(eval(compile(ast.Expression(last.value), path.name, "eval"), names))
        else:
            exec(compile(ast.Module([last], []), path.name, "exec"), names)
    return shown


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_and_shows_pictures_and_a_page(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    display = ModuleType("IPython.display")
    display.IFrame = lambda src, *_: SimpleNamespace(src=Path(src))  # pyright: ignore[reportAttributeAccessIssue]
    monkeypatch.setitem(sys.modules, "IPython", ModuleType("IPython"))
    monkeypatch.setitem(sys.modules, "IPython.display", display)
    monkeypatch.chdir(tmp_path)
    shown = run_cells(path)
    assert sum(isinstance(one, Image.Image) for one in shown) >= 2
    (page,) = (one.src for one in shown if isinstance(one, SimpleNamespace))
    assert "<canvas" in page.read_text() or 'class="scene"' in page.read_text()


def test_there_is_a_notebook_of_each_half() -> None:
    assert [path.stem for path in NOTEBOOKS] == ["depth", "pose"]
