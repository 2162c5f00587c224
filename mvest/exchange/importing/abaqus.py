"""A closure computed with Abaqus: its input deck and the frames beside it, as of Texas TriValve."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mvest.cases.case import Frame, Role, Uncertainty, ValveCase
from mvest.errors import InputError
from mvest.exchange.abaqus.deck_file import read_deck
from mvest.exchange.abaqus.mesh import SetNames
from mvest.exchange.abaqus.recording import Recording, read_recording, recording_files
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
    toe_strain : float
        Of the chordae, up to which their stiffness rises; it is linearised there.
    name, description, licence : str
        Of the case.
    """

    leaflets: tuple[str, ...] | None = None
    annulus: str | None = None
    free_edge: str | None = None
    std_mm: float | None = None
    toe_strain: float = 0.01
    name: str = ""
    description: str = ""
    licence: str = ""


def import_abaqus(source: Path, options: AbaqusOptions) -> ValveCase:
    """A case from a folder NAME with NAME.inp and NAME_0.vtu, NAME_1.vtu, ...

    The first frame is the reference, the last one the closed frame. Lengths are mm, stresses MPa.

    Raises
    ------
    InputError
        If sets are not named, or as `mvest.exchange.abaqus.recording.read_recording`.
    """
    recording = read_recording(source, _names(source, options))
    valve = recording.valve(linearisation_strain=options.toe_strain, toe_strain=options.toe_strain)
    derived = [
        "fibres: parallel to the annulus; the deck's own directions are not read",
        f"chordae: {len(valve.chordae)} straight ones as long as their ways through the network, "
        f"of the stiffness at {100 * options.toe_strain:g} % strain",
    ]
    if options.std_mm is None:
        derived.append(f"observation: {STD_MM:g} mm assumed; std_mm=... states it")
    return ValveCase(
        name=options.name or source.resolve().name,
        description=options.description,
        source="computed with Abaqus",
        licence=options.licence,
        simulated=True,
        surface=recording.surface,
        annulus=recording.annulus,
        free_edge=recording.free_edge,
        frames=(_frame(recording, 0), _frame(recording, -1)),
        chordae=valve.chordae,
        uncertainty=Uncertainty(options.std_mm or STD_MM, CORRELATED_MM),
        derived=tuple(derived),
    )


def _names(source: Path, options: AbaqusOptions) -> SetNames:
    """Names of the sets, each asked for by its option where it is not given."""
    pairs = [word.partition(":") for word in options.leaflets or ()]
    missing = {
        "leaflets=[REGION:SET,...]": not pairs or not all(part for pair in pairs for part in pair),
        "annulus=SET": not options.annulus,
        "free_edge=SET": not options.free_edge,
    }
    if any(missing.values()):
        deck = read_deck(recording_files(source)[0])
        asked = ", ".join(option for option, absent in missing.items() if absent)
        sets = one_line(", ".join([*deck.element_sets, *deck.node_sets]), 400)
        raise InputError(f"{source}: give {asked}; the deck's sets are {sets}")
    leaflets = {region: name for region, _, name in pairs}
    return SetNames(leaflets, options.annulus or "", options.free_edge or "")


def _frame(recording: Recording, at: int) -> Frame:
    reference = at == 0
    # Frames are stored in single precision.
    vertices = recording.surface.vertices if reference else recording.frames[at]
    return Frame(
        name="open" if reference else "closed",
        time=float(recording.times[at]),
        role=Role.REFERENCE if reference else Role.CLOSED,
        pressure_mmHg=mpa_to_mmhg(recording.pressure) * float(recording.pressure_share[at]),
        vertices=vertices,
        triangles=recording.surface.triangles,
        region=recording.surface.region,
        annulus=np.asarray(vertices[recording.annulus]),
        free_edge=np.asarray(vertices[recording.free_edge]),
        papillary_tips=recording.papillary_tips[at],
        corresponds=True,
    )
