"""Configuration of the documentation site: `make docs` builds it, without the network."""

from __future__ import annotations

import re
import sys
import tomllib
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sphinx.application import Sphinx

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
sys.path[:0] = [str(ROOT), str(HERE / "_extensions")]

project = "mvest"
author = "mvest developers"
project_copyright = "mvest developers, MIT licence"
release = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
version = release

extensions = [
    "myst_parser",
    "numpydoc",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.mathjax",
    "sphinx-mathjax-offline",
    "sphinx_design",
    "sphinx_gallery.gen_gallery",
    "api_pages",
    "import_graph",
    "study_pages",
    "computed_tables",
]
myst_enable_extensions = ["attrs_block", "colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3
exclude_patterns = ["_build", "_extensions", "study_notes"]
numpydoc_show_class_members = False
default_role = "py:obj"
autosummary_generate = ["api/index.rst"]
autodoc_typehints = "none"
autodoc_member_order = "bysource"

html_theme = "pydata_sphinx_theme"
html_title = f"mvest {release}"
html_static_path = ["_static"]
html_css_files = ["mvest.css"]
html_show_sourcelink = False
html_sidebars = {"index": [], "start": []}
html_copy_source = False
html_theme_options = {
    "navigation_with_keys": False,
    "header_links_before_dropdown": 7,
    "show_prev_next": False,
    "secondary_sidebar_items": ["page-toc"],
    "footer_start": ["copyright"],
    "footer_end": [],
}

sphinx_gallery_conf = {
    "examples_dirs": "../examples/gallery",
    "gallery_dirs": "gallery",
    "filename_pattern": r"\.py$",
    "abort_on_example_error": False,
    "only_warn_on_example_error": False,
    "download_all_examples": False,
    "show_signature": False,
    "capture_repr": (),
    "remove_config_comments": True,
    "min_reported_time": 1,
    "image_scrapers": ("matplotlib", "figure_scraper"),
    "ignore_pattern": "drawing",
    "run_stale_examples": True,  # what they call may have changed
    "within_subsection_order": "FileNameSortKey",
}

warnings.filterwarnings("ignore", message=".*non-interactive.*")

README_PAGES = {
    "../cases/README.md": "own_valve.md",
    "../imaging/README.md": "volume.md",
    "../external/README.md": "own_model.md",
}
"""Where the READMEs that lie beside the code are found on the site."""


def link_to_pages(app: Sphinx, path: Path, docname: str, content: list[str]) -> None:
    """Turn the links between included files into links between pages."""
    for readme, page in README_PAGES.items():
        content[0] = re.sub(rf"\({re.escape(readme)}(#[^)]*)?\)", f"({page})", content[0])
    content[0] = re.sub(r"\(docs/(\w+\.md)\)", r"(\1)", content[0])
    content[0] = content[0].replace("(SECURITY.md)", "(security.md)")


def setup(app: Sphinx) -> None:
    """Follow links of included files."""
    app.connect("include-read", link_to_pages)
