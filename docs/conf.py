"""Build the site: ``make docs``, or ``make docs-fast``, which executes neither the gallery nor the tour."""

from __future__ import annotations

import os
import tempfile
from typing import Any

from rille.pipeline.cli import app as commands
from rille.pipeline.engine.keys import installed

FAST = "RILLE_DOCS_FAST" in os.environ
"""Whether examples are shown and not executed."""

WORK = tempfile.TemporaryDirectory(prefix="rille-docs-")
"""Folder of the cache of all examples."""

os.environ["RILLE_CACHE"] = f"{WORK.name}/cache"
os.environ.pop("RILLE_DATA", None)  # the site needs no data

project = "Rille"
author = "the authors of Rille"
project_copyright = author
release = version = installed()["rille"]

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_gallery.gen_gallery",
]
exclude_patterns = ["_build", "gallery", "examples/*.ipynb", "**/sg_execution_times.rst", "sg_execution_times.rst"]

highlight_language = "none"  # blocks without a language are what a program prints

html_theme = "pydata_sphinx_theme"
html_title = "Rille"
html_static_path = ["_static"]
html_css_files = ["rille.css"]
html_show_sourcelink = False
html_sidebars = {"when-something-goes-wrong": []}  # its section has no other page
html_theme_options = {
    "navbar_align": "left",
    "header_links_before_dropdown": 7,
    "show_prev_next": True,
    "secondary_sidebar_items": ["page-toc"],
    "footer_start": ["copyright"],
    "footer_end": ["sphinx-version"],
    "navbar_persistent": ["search-button"],
}

myst_enable_extensions = ["colon_fence", "deflist"]
myst_heading_anchors = 3
nb_execution_mode = "off" if FAST else "force"
nb_execution_timeout = 300
nb_execution_raise_on_error = True
nb_execution_in_temp = True
nb_merge_streams = True

autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
autodoc_typehints_format = "short"
autodoc_member_order = "bysource"
napoleon_google_docstring = False
napoleon_use_rtype = False

sphinx_gallery_conf = {
    "examples_dirs": "gallery",
    "gallery_dirs": "examples",
    "filename_pattern": r"/\w+\.py$",
    "within_subsection_order": "FileNameSortKey",
    "abort_on_example_error": True,
    "remove_config_comments": True,
    "capture_repr": ("_repr_html_",),
    "show_memory": False,
    "download_all_examples": False,
    "show_signature": False,
    "plot_gallery": not FAST,
    "run_stale_examples": True,  # a script depends on the program, too
}


def command_line(_app: Any, page: str, source: list[str]) -> None:
    """Put the reference of all commands, as the program's own parser describes them, into their page."""
    if page == "reference/command-line":
        text = commands.generate_docs(heading_level=2, flatten_commands=True, usage_name="rille")
        text = text[text.index("**Commands**") :].replace("#rille-install", "#rille---install")
        source[0] = source[0].replace("<!-- commands -->", text)


def setup(app: Any) -> None:
    """Connect what Sphinx calls."""
    app.connect("source-read", command_line)
