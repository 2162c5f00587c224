"""The case that a sequence tells."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mvest.cases.case import ErrorSamples, Frame, Role, Uncertainty, ValveCase
from mvest.cases.checks import (
    check_annulus_size,
    check_band,
    check_normals,
    check_thickness,
    check_tips,
    ventricular_side,
)
from mvest.cases.chord_layout import SEEN_CLOSURE, lay_out_chordae
from mvest.cases.from_images.frame_choice import CaseFrames
from mvest.cases.tissue import GENERIC_THICKNESS
from mvest.errors import GeometryError, InputError
from mvest.imaging.layout import ValveLayout
from mvest.imaging.valve_sequence import ValveSequence
from mvest.typing import FloatArray, IntArray
from mvest.valve.anatomy.dimensions import TemplateParameters
from mvest.valve.anatomy.template import Template, vertex_region
from mvest.valve.anatomy.valve import LeafletSurface
from mvest.valve.geometry.surface_coordinates import surface_coordinates
from mvest.valve.geometry.triangles import unit_rows

UNSEEN_STD_MM = 10.0
"""Standard deviation of a vertex whose error was never measured: it is given no weight."""


@dataclass(frozen=True, slots=True, eq=False)
class _Placed:
    """The valve of a frame, whose layout knows the template's coordinates."""

    vertices: FloatArray
    layout: ValveLayout

    def locate(self, phi: FloatArray, s: FloatArray) -> tuple[IntArray, FloatArray]:
        return self.layout.locate(phi, s)


@dataclass(frozen=True, slots=True)
class CaseTexts:
    """What a case says of itself."""

    name: str
    description: str = ""
    source: str = ""
    licence: str = ""
    simulated: bool = False


def case_of_sequence(
    sequence: ValveSequence,
    frames: CaseFrames,
    texts: CaseTexts,
    *,
    thickness_mm: Mapping[str, float] | None = None,
    error_samples: ErrorSamples | None = None,
) -> ValveCase:
    """The case that a sequence tells.

    Thickness and fibres vary over a leaflet as they do in the template: that cannot be seen.

    Parameters
    ----------
    sequence : ValveSequence
    frames : CaseFrames
    texts : CaseTexts
    thickness_mm : mapping, optional
        Of each leaflet next to the annulus; generic values if not given.
    error_samples : ErrorSamples, optional
        In the frames of the case, in the order of time.

    Raises
    ------
    InputError, GeometryError
        A surface is no valve: the message names the frame and says what is wrong.
    """
    layout = sequence.layout
    derived = list(frames.derived)
    reference = sequence.vertices[frames.open]
    annulus = reference[layout.annulus]
    side = ventricular_side(annulus, reference[layout.free_edge])
    for number in frames.in_order:
        _check_frame(sequence, number, side, is_reference=number == frames.open)
    given = GENERIC_THICKNESS if thickness_mm is None else thickness_mm
    if set(given) != set(layout.region_names):
        raise InputError(
            f"thickness of {', '.join(given)}, expected of {', '.join(layout.region_names)}"
        )
    if thickness_mm is None:
        listed = ", ".join(f"{given[name]:g} mm ({name})" for name in layout.region_names)
        derived.append(f"thickness: {listed} assumed")
    typical = Template(
        TemplateParameters().changed(
            {f"leaflets.{name}.thickness": mm for name, mm in given.items()}
        )
    )
    thickness = typical.thickness(layout.phi, layout.s)
    check_thickness(thickness)
    derived += [
        "thickness: falls towards the free edge as in the template, to "
        f"{typical.parameters.leaflets.edge_thinning:.0%}",
        "fibre: around the valve, turned as in the template near the commissures of the anterior "
        "leaflet",
        "annulus and free edge: the first and the last row of the image step's layout",
    ]
    surface = LeafletSurface(
        reference,
        layout.triangles,
        layout.region,
        layout.region_names,
        _fibres(layout, reference, typical),
        thickness,
    )
    chordae = lay_out_chordae(
        _Placed(reference, layout),
        sequence.tips[frames.open],
        sequence.vertices[frames.closed],
        sequence.tips[frames.closed],
        SEEN_CLOSURE,
    )
    derived.append(
        f"chordae: {len(chordae)} laid out as in the template, each to its nearer papillary tip, "
        "rest lengths from the closed frame (through its vertices)"
    )
    return ValveCase(
        name=texts.name,
        description=texts.description,
        source=texts.source,
        licence=texts.licence,
        simulated=texts.simulated,
        surface=surface,
        annulus=layout.annulus,
        free_edge=layout.free_edge,
        frames=tuple(_frame(sequence, frames, number) for number in frames.in_order),
        chordae=chordae,
        uncertainty=_uncertainty(sequence, derived),
        derived=tuple(derived),
        error_samples=error_samples,
        chordae_follow=True,
    )


def _fibres(layout: ValveLayout, vertices: FloatArray, typical: Template) -> FloatArray:
    """Directions ``(n, 3)`` around the valve, turned towards its axis as they typically are."""
    loops = layout.annulus, layout.free_edge
    t = surface_coordinates(vertices, layout.triangles, *loops).circumferential
    grid = vertices.reshape(layout.rows, layout.columns, 3)
    onward = (np.roll(grid, -1, axis=1) - np.roll(grid, 1, axis=1)).reshape(-1, 3)
    t = t * np.sign(np.sum(t * onward, axis=1))[:, None]
    r = np.asarray(np.gradient(grid, axis=0)).reshape(-1, 3)
    r = unit_rows(r - np.sum(r * t, axis=1)[:, None] * t)
    angle = typical.fibre_angle(layout.phi, vertex_region(layout.phi))[:, None]
    return np.asarray(np.cos(angle) * t - np.sin(angle) * r)


def _check_frame(sequence: ValveSequence, number: int, side: float, *, is_reference: bool) -> None:
    layout, vertices, tips = sequence.layout, sequence.vertices[number], sequence.tips[number]
    try:
        if not (np.isfinite(vertices).all() and np.isfinite(tips).all()):
            raise GeometryError("a position is not finite, expected a valve in this frame")
        check_band(vertices, layout.triangles, self_intersections=is_reference)
        check_annulus_size(vertices[layout.annulus])
        check_tips(vertices[layout.annulus], side, tips)
        check_normals(vertices, layout.triangles, layout.annulus, tips)
    except InputError as fault:
        kind = "open" if is_reference else "closed"
        raise type(fault)(f"valve from images, {kind} frame {number}: {fault}") from fault


def _frame(sequence: ValveSequence, frames: CaseFrames, number: int) -> Frame:
    layout, vertices = sequence.layout, sequence.vertices[number]
    if number == frames.open:
        name, role, pressure = "open", Role.REFERENCE, 0.0
    elif number == frames.closed:
        name, role, pressure = "closed", Role.CLOSED, frames.pressure_mmHg
    else:
        name, role, pressure = f"frame_{number}", Role.HELD_OUT, frames.held_out[number]
    return Frame(
        name,
        float(sequence.times[number]),
        role,
        float(pressure),
        vertices,
        layout.triangles,
        layout.region,
        vertices[layout.annulus],
        vertices[layout.free_edge],
        sequence.tips[number],
        True,
    )


def _uncertainty(sequence: ValveSequence, derived: list[str]) -> Uncertainty:
    std, length = sequence.std_mm, sequence.correlation_length_mm
    unknown = ~np.isfinite(std)
    if unknown.all():
        raise InputError(
            "valve from images: no vertex has a standard deviation; expected a detection model "
            "whose accuracy was measured"
        )
    if unknown.any():
        derived.append(
            f"observation: {int(unknown.sum())} vertices whose error was never measured are given "
            f"{UNSEEN_STD_MM:g} mm"
        )
    return Uncertainty(np.where(unknown, UNSEEN_STD_MM, std), float(length))
