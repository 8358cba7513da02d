"""How the documentation is built: ``sphinx-build -W -n docs site``, without a network."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "_extensions"))

import polmvs

project = "polmvs"
author = "the polmvs developers"
copyright = "BSD 3-Clause"
version = release = polmvs.__version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.viewcode",
    "numpydoc",
    "command_reference",
    "docstrings",
    "mathml",
    "notebook_page",
]
source_suffix = {".md": "markdown"}
exclude_patterns = ["_extensions", "_build"]
html_theme = "furo"
html_title = f"polmvs {release}"
html_static_path: list[str] = []
html_show_copyright = False
html_theme_options = {"navigation_with_keys": True}

myst_enable_extensions = ["dollarmath", "deflist", "attrs_inline"]
myst_heading_anchors = 3

# Every reference to something of polmvs must have a target; those of other packages have none here.
nitpicky = True
nitpick_ignore_regex = [
    (r"py:.*", r"(?!polmvs\.).*"),
    (r"py:class", r"polmvs\.(config\.T|geometry\.Float)"),  # type variables
]
numpydoc_show_class_members = False
autosummary_generate = False  # which numpydoc brings
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
python_use_unqualified_type_names = True
autodoc_default_options = {"members": True, "exclude-members": "check"}
# Annotations that would show the text of their definition.
autodoc_type_aliases = {
    name: name
    for name in ("Array", "Floats", "Mask", "Image", "PathArg", "ArrayLike", "Angles", "Rgb")
}
