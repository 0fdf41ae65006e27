# SPDX-License-Identifier: Apache-2.0
"""Settings of Sphinx."""

from __future__ import annotations

from site_contents import NOT_PUBLIC

from shmmap.version import __version__

project = "shmmap"
version = release = __version__
html_title = f"shmmap {__version__}"
extensions = [
    "myst_parser",  # pages are Markdown
    "numpydoc",  # the style of docstrings
    "sphinx.ext.autodoc",
    "site_names",
    "sphinx.ext.githubpages",  # a file that lets the pages host serve folders whose names begin with _
]
root_doc = "index"
nitpicky = True
nitpick_ignore_regex = [("py:.*", name) for name in NOT_PUBLIC]
default_role = "py:obj"
myst_enable_extensions = ["attrs_inline"]
myst_heading_anchors = 4  # as on GitHub

autodoc_default_options = {"members": True}
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autodoc_typehints = "signature"
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 80
numpydoc_show_class_members = False  # autodoc does it
numpydoc_class_members_toctree = False

html_theme = "furo"
html_copy_source = False
html_show_sourcelink = False
html_show_copyright = False
html_theme_options = {"navigation_with_keys": True}
