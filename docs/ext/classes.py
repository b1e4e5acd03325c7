"""A page for each class of the API, and a list of them where its module is described.

The pages are written into ``api/classes`` before Sphinx looks for sources: a page of the API says
which modules there are (``automodule``), the modules say which classes.
"""

import inspect
import re
from importlib import import_module
from pathlib import Path

from sphinx.application import Sphinx

FOLDER = "api/classes"
_MODULE = re.compile(
    r"```\{eval-rst\}\n\.\. automodule:: (?P<name>[\w.]+)\n(?P<options>[^`]*)```\n"
)


def classes_of(module_name: str, *, with_imported: bool) -> dict[str, type]:
    """List the public classes of a module that have a docstring, in the order of its names.

    Args:
        module_name: the module, as ``automodule`` names it.
        with_imported: whether classes that it imports are its own too.
    """
    module = import_module(module_name)
    return {
        name: found
        for name, found in vars(module).items()
        if inspect.isclass(found)
        and not name.startswith("_")
        and vars(found).get("__doc__")
        and (found.__module__ == module_name or with_imported)
        and found.__module__.startswith("depthpose")
    }


def _foreign_bases(found: type) -> list[str]:
    """Name the bases of a class that are not of this package: what it inherits is not shown."""
    return [base.__name__ for base in found.__mro__ if not base.__module__.startswith("depthpose")]


def write_pages(app: Sphinx) -> None:
    """Write a page for each class; remove those of classes that are no more."""
    folder = Path(app.srcdir) / FOLDER
    folder.mkdir(exist_ok=True)
    wanted: dict[Path, str] = {}
    for page in sorted((Path(app.srcdir) / "api").glob("*.md")):
        for match in _MODULE.finditer(page.read_text()):
            module = match["name"]
            for name in _classes(match):
                text = f"{name}\n{'=' * len(name)}\n\n.. autoclass:: {module}.{name}\n"
                foreign = ", ".join(_foreign_bases(getattr(import_module(module), name)))
                text += f"   :inherited-members: {foreign}\n"
                wanted[folder / f"{module}.{name}.rst"] = text
    for path in set(folder.glob("*.rst")) - wanted.keys():
        path.unlink()
    for path, text in wanted.items():
        if not path.exists() or path.read_text() != text:
            path.write_text(text)


def add_pages(*event: object) -> None:
    """Put the pages of a module's classes into the sidebar, under the page of the module."""
    _, name, content = event
    assert isinstance(name, str)
    assert isinstance(content, list)
    if re.fullmatch(r"api/\w+", name):
        content[0] = _MODULE.sub(_with_pages, content[0])


def list_classes(*event: object) -> None:
    """Put the list of a module's classes behind what is said of the module."""
    _, what, module, _, options, lines = event
    assert isinstance(lines, list)
    if what != "module":
        return
    found = classes_of(str(module), with_imported=bool(getattr(options, "imported_members", None)))
    if found:
        rows = [f"- :py:class:`{n} <{module}.{n}>`: {_summary(c)}" for n, c in found.items()]
        lines += ["", *rows, ""]


def skip_class(*event: object) -> bool | None:
    """Leave classes out of the description of a module: they have pages of their own."""
    _, what, _, found, *_ = event
    return True if what == "module" and inspect.isclass(found) else None


def _classes(match: re.Match[str]) -> dict[str, type]:
    return classes_of(match["name"], with_imported=":imported-members:" in match["options"])


def _with_pages(match: re.Match[str]) -> str:
    pages = [f"classes/{match['name']}.{name}" for name in _classes(match)]
    tree = ["```{toctree}", ":hidden:", "", *pages, "```", ""]
    return "\n".join([match[0], *tree]) if pages else match[0]


def _summary(found: type) -> str:
    """Give the first sentence of a docstring."""
    return " ".join((inspect.getdoc(found) or "").partition("\n\n")[0].split())


def setup(app: Sphinx) -> dict[str, bool]:
    """Tell Sphinx of all."""
    app.connect("builder-inited", write_pages)
    app.connect("source-read", add_pages)
    app.connect("autodoc-process-docstring", list_classes)
    app.connect("autodoc-skip-member", skip_class)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
