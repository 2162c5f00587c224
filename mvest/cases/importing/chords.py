"""Chordae from the line models of other programs, and their table in a case."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from mvest.cases.chord_layout import FAMILIES
from mvest.cases.tissue import CHORD_COLUMNS
from mvest.errors import InputError
from mvest.reading.text import write_columns
from mvest.typing import FloatArray
from mvest.valve.anatomy.dimensions import ChordLayout

MARGINAL_MM = 4.0
"""From the free edge, within which a chord inserts as marginal ones do."""
MAX_AWAY = 3.0
"""mm from where a chord begins to its papillary tip."""


def chord_lines(segments: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Chords from papillary tip to insertion of segments that may branch.

    Parameters
    ----------
    segments : (k, 2, 3) mm
        Each from where it begins to where it ends; a branch begins where its trunk ends.

    Returns
    -------
    chords : (c, 2, 3) mm
        From tip to insertion.
    lengths : (c,) mm
        Along trunk and branch.
    tips : (t, 3) mm
    """
    joints, number = np.unique(np.round(segments.reshape(-1, 3), 3), axis=0, return_inverse=True)
    begin, end = number.reshape(-1, 2).T
    length = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1)
    trunk = {int(e): k for k, e in enumerate(end)}
    chords, lengths, tips = [], [], []
    for k in range(len(segments)):
        if end[k] in begin:
            continue
        root, total, seen = k, float(length[k]), {k}
        while (before := trunk.get(int(begin[root]))) is not None and before not in seen:
            root, total = before, total + float(length[before])
            seen.add(before)
        chords.append([segments[root, 0], segments[k, 1]])
        lengths.append(total)
        tips.append(int(begin[root]))
    return (
        np.array(chords).reshape(-1, 2, 3),
        np.array(lengths),
        joints[sorted(set(tips))].reshape(-1, 3),
    )


def write_chords(
    folder: Path,
    chords: FloatArray,
    lengths: FloatArray,
    tips: FloatArray,
    free_edge: FloatArray,
    derived: list[str],
) -> dict[str, Any]:
    """Write the table of a case's chordae; returns its entry in ``case.yaml``.

    Parameters
    ----------
    folder
    chords, lengths
        ``(c, 2, 3)`` from tip to insertion and ``(c,)``, mm.
    tips, free_edge
        ``(t, 3)`` and ``(k, 3)`` mm.
    derived
        Gets a sentence about families and stiffness, of which such models say nothing.

    Raises
    ------
    InputError
        Chords begin elsewhere than at the tips.
    """
    away = np.linalg.norm(chords[:, 0, None] - tips, axis=2)
    if away.min(axis=1).max() > MAX_AWAY:
        raise InputError("chords begin elsewhere than at the papillary tips; leave out tips=...")
    layout, insertion = ChordLayout(), chords[:, 1]
    to_edge = np.atleast_1d(cKDTree(free_edge).query(insertion)[0])
    family = np.where(to_edge > MARGINAL_MM, 1, 0)
    # As stiff together as the template's, of which there may be fewer.
    marginal = len(layout.marginal_phi) * layout.marginal_stiffness
    basal = len(layout.basal) * layout.basal_stiffness
    count = np.bincount(family, minlength=2)
    each = 2 * np.array([marginal, basal]) / np.maximum(count, 1)
    write_columns(
        folder / "chordae.csv",
        CHORD_COLUMNS,
        zip(
            away.argmin(axis=1).tolist(),
            *insertion.T.tolist(),
            [FAMILIES[k] for k in family],
            lengths.tolist(),
            each[family].tolist(),
            strict=True,
        ),
    )
    derived.append(
        f"chordae: {len(chords)} of the export, as long as there; the {count[0]} within "
        f"{MARGINAL_MM:g} mm of the free edge are marginal; as stiff together as the template's"
    )
    return {"chordae": {"file": "chordae.csv", "families": list(FAMILIES)}}
