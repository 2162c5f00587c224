"""All files of other programs that are read, and the page of the documentation that lists them.

``python -m tests.exchange.variants`` writes the page from the makers.
"""

from __future__ import annotations

from tests.exchange.markup_variants import markup_variants
from tests.exchange.surface_variants import surface_variants
from tests.exchange.variant import Variant
from tests.exchange.volume_variants import label_variants, volume_variants
from tests.places import ROOT

SURFACES = tuple(surface_variants())
VOLUMES = tuple(volume_variants())
LABELS = tuple(label_variants())
MARKUPS = tuple(markup_variants())
PAGE = ROOT / "docs" / "formats.md"
HEAD = """# Formats that are read

The tests make each of these files with the libraries that other programs use (VTK, trimesh, meshio,
SimpleITK, nibabel, pynrrd, pydicom, slicerio), read it, and compare it with what was written. A dot
separates options that are combined.

| format | variants | files |
|---|---|---|
"""
FOOT = """
[Folders of SlicerHeart](slicer.md) and [FEBio](febio.md) have pages of their own. What a file does
not state (units, times, which leaflet is which) is asked for in one line. Every file is read by a
child process whose memory and time are bounded; a damaged one costs one line. This page is made by
`python -m tests.exchange.variants`.
"""


def page() -> str:
    """The page, a line for all variants of a format with the same number of options."""
    rows: dict[tuple[str, int], list[Variant]] = {}
    for variant in (*SURFACES, *VOLUMES, *LABELS, *MARKUPS):
        rows.setdefault((variant.format, len(variant.options)), []).append(variant)
    lines = [
        f"| {form} | {_options(variants)} | {len(variants)} |"
        for (form, _), variants in rows.items()
    ]
    return HEAD + "\n".join(lines) + "\n" + FOOT


def _options(variants: list[Variant]) -> str:
    columns = zip(*(variant.options for variant in variants), strict=True)
    return " · ".join(", ".join(dict.fromkeys(column)) for column in columns)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
