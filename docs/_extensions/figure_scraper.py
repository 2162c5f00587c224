"""Saves figures of gallery scripts named ``figure`` that were made without pyplot."""

from __future__ import annotations

from typing import Any

import matplotlib.pyplot as plt
from matplotlib.figure import Figure
from sphinx_gallery.scrapers import figure_rst


def figure_scraper(block: Any, block_vars: dict[str, Any], gallery_conf: dict[str, Any]) -> str:
    """Save the variable ``figure`` of a block, once, unless pyplot manages it."""
    names = block_vars["example_globals"]
    figure = names.get("figure")
    if not isinstance(figure, Figure) or hasattr(figure, "number"):
        return ""
    path = next(block_vars["image_path_iterator"])
    figure.savefig(path, dpi=100)
    names["figure"] = None
    return str(figure_rst([path], gallery_conf["src_dir"], ""))


def _get_sg_image_scraper() -> Any:
    """The scraper, under the name that sphinx-gallery expects."""
    plt.rcParams["savefig.bbox"] = "standard"
    return figure_scraper
