"""Figures of gallery scripts that the library made, without pyplot: those called ``figure``."""

from __future__ import annotations

from typing import Any

import matplotlib.pyplot as plt
from matplotlib.figure import Figure
from sphinx_gallery.scrapers import figure_rst


def figure_scraper(block: Any, block_vars: dict[str, Any], gallery_conf: dict[str, Any]) -> str:
    """Save what a block left as ``figure``, once, if pyplot knows nothing of it."""
    names = block_vars["example_globals"]
    figure = names.get("figure")
    if not isinstance(figure, Figure) or hasattr(figure, "number"):
        return ""
    path = next(block_vars["image_path_iterator"])
    figure.savefig(path, dpi=100)
    names["figure"] = None
    return str(figure_rst([path], gallery_conf["src_dir"], ""))


def _get_sg_image_scraper() -> Any:
    """What sphinx-gallery asks a module for that it is told as a scraper."""
    plt.rcParams["savefig.bbox"] = "standard"
    return figure_scraper
