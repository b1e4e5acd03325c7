"""Links of Markdown and names of Python that are written for a reader of the source."""

import re
from itertools import takewhile
from typing import cast

from docutils import nodes
from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.util.nodes import make_refnode

HOMES = (
    (re.compile(r"^(\.\./)?README\.md"), "index.md"),
    (re.compile(r"^(\.\./)?CONTRIBUTING\.md"), "contributing.md"),
    (re.compile(r"^(\.\./)?CHANGELOG\.md"), "changes.md"),
    (re.compile(r"^(\.\./)?src/depthpose/weights(/[\w-]+\.md)?"), "weights.md"),
    (re.compile(r"^docs/"), ""),
)
"""Where the site shows what a link names in the repository."""


def site_link(match: re.Match[str]) -> str:
    """Turn the target of a link, written for the repository, into one of the site."""
    target = match[1]
    for place, page in HOMES:
        target = place.sub(page, target)
    return f"]({target}"


def rewrite_links(*event: object) -> None:
    """Rewrite the links of a page, or of a file that a page includes."""
    content = cast("list[str]", event[-1])
    content[0] = re.sub(r"\]\(((?!https?:|#)[^)#\s]+)", site_link, content[0])


def resolve_name(
    app: Sphinx, env: BuildEnvironment, node: addnodes.pending_xref, contnode: nodes.Element
) -> nodes.Element | None:
    """Find a name of ours by its last part.

    A name is documented where users import it from (``depthpose.core.camera.Camera``), and
    referred to by the file that defines it, or by the name alone.
    """
    if node.get("refdomain") != "py":
        return None
    target = str(node["reftarget"])
    objects = env.domains.python_domain.objects
    here = target if "." in target else str(node.get("py:module", ""))
    last = target.rsplit(".", 1)[-1]
    places = [name for name in objects if name.rsplit(".", 1)[-1] == last]
    near = max((_shared(name, here) for name in places), default=0)
    # One place may have two names: that of the package, and that of the file.
    found = {objects[name].node_id: name for name in places if _shared(name, here) == near}
    if len(found) != 1:
        # A signature's types come from the code: those that nobody documents stand as they are.
        return contnode if "." in target and "refwarn" not in node else None
    node_id, name = found.popitem()
    place = objects[name].docname
    return make_refnode(app.builder, str(node["refdoc"]), place, node_id, contnode, name)


def _shared(name: str, here: str) -> int:
    """Count the leading parts that a documented name shares with the place that refers to it."""
    pairs = zip(name.split("."), here.split("."), strict=False)
    return sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], pairs))


def keep_colon(*event: object) -> None:
    """Keep napoleon from taking what stands before a colon for a type: ours are annotated.

    It looks at the first line alone: an empty comment.
    """
    if event[1] in ("attribute", "data", "property"):
        cast("list[str]", event[-1])[:0] = ["..", ""]


def setup(app: Sphinx) -> dict[str, bool]:
    """Tell Sphinx of all."""
    app.connect("autodoc-process-docstring", keep_colon, priority=400)
    app.connect("source-read", rewrite_links)
    app.connect("include-read", rewrite_links)
    app.connect("missing-reference", resolve_name)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
