"""Sphinx configuration: `make docs` builds the site into docs/_build/html."""

from fieldlum.version import __version__

project = "fieldlum"
author = "fieldlum contributors"
copyright = author
release = __version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = "fieldlum"

# Links to headings (page.md#heading) are resolved down to this level; a missing one is an error.
myst_heading_anchors = 3
autodoc_typehints = "none"  # the signature has them
autodoc_preserve_defaults = True
default_role = "code"  # `name` in docstrings
napoleon_google_docstring = False
