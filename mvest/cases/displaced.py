"""A case as it would be if its frames were in error as one of its samples says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from mvest.cases.case import Role, ValveCase
from mvest.cases.chord_layout import LeafletBand, lay_out_chordae
from mvest.errors import InputError
from mvest.typing import FloatArray
from mvest.valve.anatomy.valve import Chordae

__all__ = ["displaced_case"]


def displaced_case(case: ValveCase, sample: int) -> ValveCase:
    """The case with all frames where one of its error samples says they may have been.

    Annulus and free edge move with their vertices. Chordae that follow the frames are laid out anew
    on these; of others the insertions move with the nearest vertex.

    Raises
    ------
    InputError
        The case has no such sample.
    GeometryError
        The displaced reference frame is no valve.
    """
    samples = case.error_samples
    if samples is None or not 0 <= sample < len(samples):
        count = 0 if samples is None else len(samples)
        raise InputError(f"case {case.name}: error sample {sample} of {count}")
    moves, tips = samples.vertices[sample], samples.tips[sample]
    frames = tuple(
        replace(
            frame,
            vertices=frame.vertices + move,
            annulus=frame.annulus + move[case.annulus],
            free_edge=frame.free_edge + move[case.free_edge]
            if len(frame.free_edge) == len(case.free_edge)
            else frame.free_edge,
            papillary_tips=frame.papillary_tips + tip,
        )
        for frame, move, tip in zip(case.frames, moves, tips, strict=True)
    )
    number = next(k for k, frame in enumerate(case.frames) if frame.role is Role.REFERENCE)
    surface = replace(case.surface, vertices=frames[number].vertices)
    # What is stated of the errors is of the case as it was seen.
    moved = replace(case, surface=surface, frames=frames, error_samples=None)
    return replace(moved, chordae=_chordae(case, moved, moves[number]))


def _chordae(case: ValveCase, moved: ValveCase, move: FloatArray) -> Chordae:
    if not case.chordae_follow:
        nearest = cKDTree(case.surface.vertices).query(case.chordae.insertion)[1]
        return replace(case.chordae, insertion=case.chordae.insertion + move[nearest])
    surface, closed = moved.surface, moved.frame(Role.CLOSED)
    band = LeafletBand.of(
        surface.vertices,
        surface.triangles,
        surface.region,
        moved.annulus,
        moved.free_edge,
        surface.region_names.index("anterior"),
    )
    tips = np.asarray(moved.frame(Role.REFERENCE).papillary_tips)
    return lay_out_chordae(band, tips, closed.vertices, closed.papillary_tips)
