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
HEAD = """# Formats

The tests write each of these files with the libraries that other programs use (VTK, trimesh,
meshio, SimpleITK, nibabel, pynrrd, pydicom, slicerio), read it, and compare the content. A dot
separates options that are combined.

Importers recognise leaflets by words in names, upper or lower case: `anterior`, `AML`, `AMVL` or
`A1` to `A3`, and `posterior`, `PML`, `PMVL` or `P1` to `P3`; in `case.yaml` write `anterior` and
`posterior`.

| format | variants | files |
|---|---|---|
"""
FOOT = """
[SlicerHeart folders](slicer.md) and [FEBio](febio.md) have pages of their own. If a file does not
state something (units, times, which leaflet is which), an error of one line asks for it. This page
is written by `python -m tests.exchange.variants`.
"""


def page() -> str:
    """The page: a line for all variants of a format with the same number of options.

    Formats with the same options share a line.
    """
    rows: dict[tuple[str, int], list[Variant]] = {}
    for variant in (*SURFACES, *VOLUMES, *LABELS, *MARKUPS):
        rows.setdefault((variant.format, len(variant.options)), []).append(variant)
    alike: dict[str, tuple[list[str], int]] = {}
    for (form, _), variants in rows.items():
        forms, count = alike.get(_options(variants), ([], 0))
        alike[_options(variants)] = ([*forms, form], count + len(variants))
    lines = [
        f"| {', '.join(forms)} | {options} | {count} |" for options, (forms, count) in alike.items()
    ]
    return HEAD + "\n".join(lines) + "\n" + FOOT


def _options(variants: list[Variant]) -> str:
    columns = zip(*(variant.options for variant in variants), strict=True)
    return " · ".join(", ".join(dict.fromkeys(column)) for column in columns)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
