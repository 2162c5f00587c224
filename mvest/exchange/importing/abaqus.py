"""A closure computed with Abaqus: its input deck and the frames beside it, as of Texas TriValve."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mvest.cases.case import Frame, Role, Uncertainty, ValveCase
from mvest.errors import InputError
from mvest.exchange.abaqus.chordae import TOE_STRAIN
from mvest.exchange.abaqus.recording import (
    Recording,
    deck_sets,
    read_recording,
    recording_files,
)
from mvest.exchange.child import in_child
from mvest.reading.text import one_line
from mvest.units import mpa_to_mmhg

STD_MM, CORRELATED_MM = 1.0, 10.0
"""Of a coordinate, and along the leaflets, where nothing is stated."""


@dataclass(frozen=True, slots=True)
class AbaqusOptions:
    """What a deck does not say.

    Attributes
    ----------
    leaflets : tuple of str or None
        ``REGION:SET`` for each leaflet: its name, and the element set that it is.
    annulus, free_edge : str or None
        Node sets.
    std_mm : float or None
        Standard deviation of a coordinate of the closed frame; 1 mm assumed.
    """

    leaflets: tuple[str, ...] | None = None
    annulus: str | None = None
    free_edge: str | None = None
    std_mm: float | None = None


def import_abaqus(source: Path, options: AbaqusOptions) -> ValveCase:
    """A case from a folder NAME with NAME.inp and NAME_0.vtu, NAME_1.vtu, ...

    The first frame is the reference, the last one the closed frame. Lengths are mm, stresses MPa.

    Raises
    ------
    InputError
        If sets are not named, or as `mvest.exchange.abaqus.recording.read_recording`.
    """
    leaflets = dict(word.split(":", 1) for word in options.leaflets or () if ":" in word)
    missing = {
        "leaflets=[REGION:SET,...]": len(leaflets) < len(options.leaflets or "?"),
        "annulus=SET": not options.annulus,
        "free_edge=SET": not options.free_edge,
    }
    if any(missing.values()):
        known = one_line(", ".join(in_child(deck_sets, recording_files(source)[0])), 400)
        asked = ", ".join(option for option, absent in missing.items() if absent)
        raise InputError(f"{source}: give {asked}; the deck's sets are {known}")
    sets = leaflets, options.annulus or "", options.free_edge or ""
    recording = read_recording(source, *sets)
    valve = recording.valve
    derived = [
        "fibres: parallel to the annulus; the deck's own directions are not read",
        f"chordae: {len(valve.chordae)} straight ones as long as their ways through the network, "
        f"of the stiffness at {100 * TOE_STRAIN:g} % strain",
    ]
    if options.std_mm is None:
        derived.append(f"observation: {STD_MM:g} mm assumed; std_mm=... states it")
    return ValveCase(
        name=source.resolve().name,
        description="",
        licence="",
        source="computed with Abaqus",
        simulated=True,
        surface=valve.surface,
        annulus=valve.annulus,
        free_edge=valve.free_edge,
        frames=(_frame(recording, 0), _frame(recording, -1)),
        chordae=valve.chordae,
        uncertainty=Uncertainty(options.std_mm or STD_MM, CORRELATED_MM),
        derived=tuple(derived),
    )


def _frame(recording: Recording, at: int) -> Frame:
    valve, reference = recording.valve, at == 0
    # Frames are stored in single precision.
    vertices = valve.surface.vertices if reference else recording.frames[at]
    return Frame(
        name="open" if reference else "closed",
        time=float(recording.times[at]),
        role=Role.REFERENCE if reference else Role.CLOSED,
        pressure_mmHg=mpa_to_mmhg(recording.pressure) * float(recording.pressure_share[at]),
        vertices=vertices,
        triangles=valve.surface.triangles,
        region=valve.surface.region,
        annulus=np.asarray(vertices[valve.annulus]),
        free_edge=np.asarray(vertices[valve.free_edge]),
        papillary_tips=valve.motion.papillary_tips[at],
        corresponds=True,
    )
