"""Words of a case that came from a volume: the frames, and what errors of the images do."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from mvest.reporting.case.findings import CaseFindings
from mvest.reporting.case.words import percent

__all__ = ["frame_rows", "image_error_words"]

SHOWN = {
    "frame": ("frame", 0),
    "time_s": ("time [s]", 3),
    "confidence": ("confidence", 2),
    "annulus_area_mm2": ("annulus area [mm²]", 0),
    "orifice_mm2": ("orifice [mm²]", 0),
    "coaptation_area_mm2": ("coaptation [mm²]", 0),
}
"""Measure -> its column and digits."""


def frame_rows(frames: Sequence[Mapping[str, Any]]) -> list[dict[str, str]]:
    """Table of the frames of a sequence; a dash for what could not be measured."""
    return [
        {
            column: "–" if row.get(name) is None else f"{row[name]:.{digits}f}"
            for name, (column, digits) in SHOWN.items()
            if name in row
        }
        for row in frames
    ]


def image_error_words(case: CaseFindings) -> list[str]:
    """What errors of the frames do to the intervals; empty where nothing is known of them."""
    errors = case.image_errors
    if errors is None:
        return []
    out = [
        f"The valve was closed anew with {errors.samples} samples of the errors of its images: "
        "of the open shape, annulus, tips and chordae as well as of the closed frame."
    ]
    if errors.failures:
        out.append(
            f"{len(errors.failures)} of them did not close and were left out: {errors.failures[0]}."
        )
    labels = {row.name: row.label for row in case.unknowns}
    for name, share in (errors.share_of_variance or {}).items():
        out.append(f"Of the variance of {labels.get(name, name)} they make {percent(share)}.")
    return out
