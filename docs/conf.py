"""Sphinx: the documentation site, from the pages of this folder, the docstrings, and the configuration.

.venv/bin/sphinx-build -W --keep-going docs build/docs
"""

from __future__ import annotations

import inspect
import re
import sys
from pathlib import Path
from typing import Any

from sphinx.util.inspect import stringify_signature

import modgnn_rl

DOCS = Path(__file__).parent

project = "modgnn_rl"
author = "The modgnn-rl authors"
release = version = modgnn_rl.__version__
extensions = ["sphinx.ext.autodoc", "sphinx.ext.napoleon", "myst_nb", "sphinx_copybutton"]
exclude_patterns = ["_static", "**.ipynb_checkpoints"]
suppress_warnings = ["ref.python"]  # names that are imported for type checkers alone are looked up by their last part

# Pages are written for GitHub too: headings are linked to by the names that GitHub gives them.
myst_heading_anchors = 4
myst_enable_extensions = ["attrs_block", "attrs_inline", "colon_fence"]
nb_execution_mode = "off"  # notebooks are stored with their results; the tests run them

# In docstrings, `name` leads to what it names, where that is documented.
default_role = "py:obj"
autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
autodoc_class_signature = "mixed"
napoleon_numpy_docstring = False
napoleon_use_ivar = True
python_maximum_signature_line_length = 80
add_module_names = False
toc_object_entries_show_parents = "hide"

html_theme = "furo"
html_title = "modgnn_rl"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sphinx = False
html_theme_options = {"navigation_with_keys": True}
copybutton_exclude = ".linenos, .gp, .go"


def setup(app: Any) -> None:
    """Make the pages that are generated, and mend what Sphinx reads otherwise than GitHub does."""
    sys.path.insert(0, str(DOCS))
    from api import api_pages
    from generate import reference_pages, root_pages, write_pages

    app.connect("builder-inited", lambda app: write_pages(DOCS / "reference", reference_pages() | root_pages()))
    app.connect("builder-inited", lambda app: write_pages(DOCS / "reference" / "api", api_pages()))
    app.connect("source-read", mend_links)
    app.connect("autodoc-process-signature", signature_of_init)
    app.connect("autodoc-process-docstring", escape_shapes, priority=400)  # before napoleon


def mend_links(app: Any, name: str, source: list[str]) -> None:
    """Lead links to the README and its like to their pages here.

    Pages of results/ are no part of the site: they are offered as files.
    """
    text = re.sub(r"\]\((?:\.\./)+([A-Z]+)\.md", lambda link: f"](/reference/{link[1].lower()}.md", source[0])
    source[0] = re.sub(r"\]\((?=(?:\.\./)+results/[\w/-]+\.md\))", "](path:", text)


def escape_shapes(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Keep the asterisk of a shape such as [*B, N] from beginning emphasis, but for shapes in ``literals``."""
    for index, line in enumerate(lines):
        parts = line.split("``")
        parts[::2] = [re.sub(r"(?<=[\[, ])\*(?=[A-Z,\]])", r"\\*", part) for part in parts[::2]]
        lines[index] = "``".join(parts)


def signature_of_init(app: Any, what: str, name: str, obj: Any, options: Any, given: str, returns: str) -> Any:
    """Show how a class is made where a metaclass hides it behind ``(*args, **kwargs)``, as TensorDictModule's does."""
    if what != "class" or given != "(*args, **kwargs)":
        return None
    own = inspect.signature(obj.__init__)
    own = own.replace(parameters=list(own.parameters.values())[1:], return_annotation=inspect.Signature.empty)
    return stringify_signature(own, show_annotation=False), returns
