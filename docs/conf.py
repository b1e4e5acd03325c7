"""How the documentation is built: ``make docs``. It looks nothing up in the network."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "ext"))

from sphinx.ext.napoleon.docstring import GoogleDocstring

from depthpose import __version__

# Else what stands before the first colon of a field's meaning would be shown as its type.
GoogleDocstring._parse_attribute_docstring = GoogleDocstring._consume_to_end

project = "depthpose"
author = "The depthpose authors"
copyright = "The depthpose authors, MIT licence"
release = version = __version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "classes",
    "imports",
    "networks",
    "names",
]
exclude_patterns = ["ext", "static"]
source_suffix = {".md": "markdown", ".rst": "restructuredtext"}

# A link that leads nowhere or a name that nobody documents fails the build (with -W).
nitpicky = True
# What a signature quotes or takes from others: shapes, and classes of torch and numpy.
nitpick_ignore_regex = [
    ("py:class", r"'.*'|AnyInput|Tensor|ndarray|(tuple|dict|jaxtyping|collections)\b.*")
]
myst_heading_anchors = 4
myst_enable_extensions = ["deflist"]

autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
autodoc_default_options = {"members": True}
napoleon_numpy_docstring = False
napoleon_use_ivar = True
napoleon_attr_annotations = False
add_module_names = False
python_maximum_signature_line_length = 88

html_theme = "furo"
html_title = f"depthpose {release}"
html_static_path = ["static"]
html_extra_path = ["poses.schema.json"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sourcelink = False
html_show_copyright = False
highlight_language = "text"
pygments_style = "friendly"
pygments_dark_style = "monokai"
