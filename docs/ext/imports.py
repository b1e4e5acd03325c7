"""Pictures of who imports whom, drawn from the code while the pages are built.

A page says ``{imports} depthpose.depth``: a box for each module of that package, a row for each
level, an arrow from an importer to what it imports. Arrows that others imply are drawn when the
pointer is on their box.
"""

from collections.abc import Mapping, Set
from functools import cache
from graphlib import TopologicalSorter

import grimp
from docutils import nodes
from docutils.parsers.rst import Directive
from sphinx.application import Sphinx

BOX_PX, ROW_PX, WIDTH_PX = 24, 62, 720
LETTER_PX = 7.3
Imports = Mapping[str, Set[str]]


@cache
def import_graph() -> grimp.ImportGraph:
    """Read every import statement of the package."""
    return grimp.build_graph("depthpose")


def imports_within(package: str) -> Imports:
    """Say for each module or package right below ``package`` which of its siblings it imports."""
    graph = import_graph()
    children = sorted(graph.find_children(package))
    return {
        child: {
            other
            for other in children
            if other != child
            and graph.direct_import_exists(importer=child, imported=other, as_packages=True)
        }
        for child in children
    }


def levels(imports: Imports) -> dict[str, int]:
    """Give each module a level above all that it imports; a circle is an error of graphlib's."""
    found: dict[str, int] = {}
    for module in TopologicalSorter(imports).static_order():
        found[module] = max((found[other] + 1 for other in imports[module]), default=0)
    return found


def reachable(imports: Imports, module: str) -> set[str]:
    """Everything that ``module`` imports, or what it imports does."""
    below = set(imports[module])
    for other in imports[module]:
        below |= reachable(imports, other)
    return below


def implied(imports: Imports, module: str) -> set[str]:
    """Imports of ``module`` that another of its imports has as well."""
    return set(imports[module]) & {
        far for other in imports[module] for far in reachable(imports, other)
    }


def place(imports: Imports) -> dict[str, tuple[float, float]]:
    """Give each module the middle of its box: a row a level, near what it imports."""
    rows: dict[int, list[str]] = {}
    for module, level in levels(imports).items():
        rows.setdefault(level, []).append(module)
    places: dict[str, tuple[float, float]] = {}
    for level in sorted(rows):
        y = (len(rows) - level - 0.5) * ROW_PX
        row = sorted(rows[level], key=lambda module: (_wish(imports[module], places), module))
        gap = (WIDTH_PX - sum(map(_width, row))) / len(row)
        left = gap / 2
        for module in row:
            places[module] = (left + _width(module) / 2, y)
            left += _width(module) + gap
    return places


def draw(package: str) -> str:
    """Draw the modules of a package as an SVG that takes its colours from the page."""
    imports = imports_within(package)
    places = place(imports)
    height = (max(levels(imports).values()) + 1) * ROW_PX
    # From the top down: a box hides the arrows that pass behind it.
    downwards = sorted(imports, key=lambda module: places[module][1])
    groups = "".join(_module(module, imports, places) for module in downwards)
    return (
        f'<svg class="imports" viewBox="0 0 {WIDTH_PX} {height}" role="img" '
        f'aria-label="imports within {package}"><defs><marker id="tip" viewBox="0 0 8 8" '
        'refX="7" refY="4" markerWidth="8" markerHeight="8" markerUnits="userSpaceOnUse" '
        'orient="auto">'
        f'<path d="M0 0 8 4 0 8z"/></marker></defs>{groups}</svg>'
    )


def _width(module: str) -> float:
    """Pixels of a box, by its letters."""
    return len(module.rsplit(".", 1)[-1]) * LETTER_PX + 14


def _wish(imported: Set[str], places: Mapping[str, tuple[float, float]]) -> float:
    """Where a module would like to stand: above the middle of what it imports."""
    return sum(places[other][0] for other in imported) / len(imported) if imported else 0.0


def _module(module: str, imports: Imports, places: Mapping[str, tuple[float, float]]) -> str:
    """Draw one module and its arrows, those that others imply apart."""
    far = implied(imports, module)
    arrows = "".join(
        _arrow(places[module], places[other], "implied" if other in far else "import")
        for other in sorted(imports[module])
    )
    return f"<g>{arrows}{_box(module, *places[module])}</g>"


def _arrow(start: tuple[float, float], end: tuple[float, float], kind: str) -> str:
    (x, y), (to_x, to_y) = start, end
    y, to_y = y + BOX_PX / 2, to_y - BOX_PX / 2
    bend = (to_y - y) / 2
    return (
        f'<path class="{kind}" marker-end="url(#tip)" d="M{x:.0f} {y:.0f} '
        f'C{x:.0f} {y + bend:.0f} {to_x:.0f} {to_y - bend:.0f} {to_x:.0f} {to_y:.0f}"/>'
    )


def _box(module: str, x: float, y: float) -> str:
    name, width = module.rsplit(".", 1)[-1], _width(module)
    return (
        f'<rect x="{x - width / 2:.1f}" y="{y - BOX_PX / 2:.1f}" '
        f'width="{width:.1f}" height="{BOX_PX}" rx="4"/>'
        f'<text x="{x:.1f}" y="{y + 4:.1f}">{name}</text>'
    )


class ImportPicture(Directive):
    """``{imports} PACKAGE``."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """Draw it into the page."""
        return [nodes.raw("", f"<figure>{draw(self.arguments[0])}</figure>", format="html")]


def setup(app: Sphinx) -> dict[str, bool]:
    """Tell Sphinx of the directive."""
    app.add_directive("imports", ImportPicture)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
