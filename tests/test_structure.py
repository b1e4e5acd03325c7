"""The shape of the code: no endless functions and files, no cycle among modules."""

import ast
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

import grimp

SOURCE = Path(__file__).parents[1] / "src/depthpose"


def lengths(folder: Path) -> Iterator[tuple[int, str]]:
    """Lines of every function, docstrings too, and where it is."""
    for path in folder.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                assert node.end_lineno is not None
                yield node.end_lineno - node.lineno + 1, f"{path.name}: {node.name}"


def test_functions_and_files_can_be_read_in_one_sitting() -> None:
    longest = max(lengths(SOURCE))
    assert longest[0] <= 80, longest
    for path in SOURCE.rglob("*.py"):
        assert len(path.read_text().splitlines()) <= 650, path


def test_no_module_imports_itself_through_others() -> None:
    graph = grimp.build_graph("depthpose", cache_dir=None)
    imported = {module: graph.find_modules_directly_imported_by(module) for module in graph.modules}
    TopologicalSorter(imported).prepare()  # names a cycle that it finds
