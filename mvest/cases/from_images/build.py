"""The open and the closed frame of a sequence, and the case that they make."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mvest.cases.band import (
    check_annulus_size,
    check_band,
    check_closing_pressure,
    check_normals,
    check_thickness,
    check_tips,
    ventricular_side,
)
from mvest.cases.case import ErrorSamples, Frame, Role, Uncertainty, ValveCase
from mvest.cases.from_images.measures import Row, closed_frame
from mvest.cases.tissue import GENERIC_THICKNESS, SEEN_CLOSURE, lay_out_chordae, weighted
from mvest.errors import GeometryError, InputError
from mvest.imaging.layout import ValveLayout
from mvest.imaging.valve_sequence import MIN_CONFIDENCE, ValveSequence
from mvest.typing import FloatArray
from mvest.valve.anatomy.dimensions import TemplateParameters
from mvest.valve.anatomy.template import Template, vertex_region
from mvest.valve.anatomy.valve import LeafletSurface
from mvest.valve.geometry.surface_coordinates import surface_coordinates
from mvest.valve.geometry.triangles import unit_rows

UNSEEN_STD_MM = 10.0
"""Standard deviation of a vertex whose error was never measured, so that it has no weight."""


@dataclass(frozen=True, slots=True)
class CaseFrames:
    """Numbers of the open and the closed frame of a sequence, of which a case is made."""

    open: int
    closed: int
    pressure_mmHg: float  #: transmitral, in the closed frame
    derived: tuple[str, ...] = ()  #: how frames were chosen that were not given

    def __post_init__(self) -> None:
        if self.open == self.closed:
            raise InputError(f"frame {self.open} is both the open and the closed one")
        check_closing_pressure(self.pressure_mmHg, "mmHg")

    @property
    def in_order(self) -> list[int]:
        """Both, in the order of time."""
        return sorted([self.open, self.closed])


def choose_frames(
    sequence: ValveSequence,
    rows: Sequence[Row],
    pressure_mmhg: float | Callable[[float], float],
    *,
    open_: int | None = None,
    closed: int | None = None,
    min_confidence: float = MIN_CONFIDENCE,
) -> CaseFrames:
    """Choose the open and the closed frame if they are not given.

    The closed frame is the one in which the leaflets touch over the largest area, the open frame
    the one with the largest orifice, both among frames of sufficient confidence. ``rows`` are the
    measures of the sequence (`measure_sequence`). The pressure is that of the closed frame, or a
    function of time (s). InputError if a given frame does not exist, or none can be chosen.
    """
    count = len(sequence.times)
    for name, number in (("open", open_), ("closed", closed)):
        if number is not None and not 0 <= number < count:
            raise InputError(f"{name} frame {number}, expected one of 0 to {count - 1}")
    sure = {
        t: row
        for t, row in enumerate(rows)
        if sequence.frame_confidence[t] >= min_confidence and row["orifice_mm2"] is not None
    }
    among = f"among {len(sure)} of {count} frames with a confidence of {min_confidence:g} or more"
    derived = []
    if closed is None:
        closed = closed_frame(list(sure.values()))
        derived.append(
            f"closed frame: {closed}, whose leaflets touch over the largest area, {among}"
        )
    if open_ is None:
        orifice = {t: row["orifice_mm2"] or 0.0 for t, row in sure.items() if t != closed}
        open_ = max(orifice, key=orifice.__getitem__, default=None)
        derived.append(f"open frame: {open_}, with the largest orifice, {among}")
    if open_ is None or closed is None:
        highest = float(np.max(sequence.frame_confidence))
        raise InputError(
            f"no open and closed frame can be chosen {among} (the best: {highest:.2f}); give "
            "imaged.open_frame and imaged.closed_frame"
        )
    if callable(pressure_mmhg):
        pressure_mmhg = pressure_mmhg(float(sequence.times[closed]))
    return CaseFrames(open_, closed, pressure_mmhg, tuple(derived))


def case_of_sequence(
    sequence: ValveSequence,
    frames: CaseFrames,
    texts: Mapping[str, Any],
    *,
    thickness_mm: Mapping[str, float] | None = None,
    error_samples: ErrorSamples | None = None,
) -> ValveCase:
    """Make a case of two frames of a sequence.

    Thickness and fibres vary over a leaflet as in the template, because images do not show them.

    InputError or GeometryError if a surface is not a valve: the message names the frame and the
    fault.

    Parameters
    ----------
    texts : mapping
        The case's name, description, source, licence and whether it is simulated.
    thickness_mm : mapping, optional
        Of each leaflet next to the annulus; default: generic values.
    error_samples : ErrorSamples, optional
        In the frames of the case, in the order of time.
    """
    layout, reference = sequence.layout, sequence.vertices[frames.open]
    _check_frames(sequence, frames)
    given = GENERIC_THICKNESS if thickness_mm is None else thickness_mm
    if set(given) != set(layout.region_names):
        raise InputError(
            f"thickness of {', '.join(given)}, expected of {', '.join(layout.region_names)}"
        )
    changes = {f"leaflets.{name}.thickness": mm for name, mm in given.items()}
    typical = Template(TemplateParameters().changed(changes))
    thickness = typical.thickness(layout.phi, layout.s)
    check_thickness(thickness)
    shape = reference, layout.triangles, layout.region, layout.region_names
    surface = LeafletSurface(*shape, _fibres(layout, reference, typical), thickness)
    chordae = lay_out_chordae(
        lambda phi, s: weighted(reference, *layout.locate(phi, s)),
        sequence.tips[frames.open],
        lambda phi, s: weighted(sequence.vertices[frames.closed], *layout.locate(phi, s)),
        sequence.tips[frames.closed],
        SEEN_CLOSURE,
    )
    derived = list(frames.derived)
    if thickness_mm is None:
        listed = ", ".join(f"{given[name]:g} mm ({name})" for name in layout.region_names)
        derived.append(f"thickness: {listed} assumed")
    derived += [
        "thickness: falls towards the free edge as in the template, to "
        f"{typical.parameters.leaflets.edge_thinning:.0%}",
        "fibre: around the valve, turned as in the template near the commissures of the anterior "
        "leaflet",
        "annulus and free edge: the first and the last row of the image step's layout",
        f"chordae: {len(chordae.insertion)} leaflet ends laid out as in the template, those of a "
        "half to its nearer papillary tip, "
        "rest lengths from the closed frame (through its vertices)",
    ]
    return ValveCase(
        **texts,
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
    """Directions ``(n, 3)`` around the valve, turned by the template's angle."""
    loops = layout.annulus, layout.free_edge
    t = surface_coordinates(vertices, layout.triangles, *loops).circumferential
    grid = vertices.reshape(layout.rows, layout.columns, 3)
    onward = (np.roll(grid, -1, axis=1) - np.roll(grid, 1, axis=1)).reshape(-1, 3)
    t = t * np.sign(np.sum(t * onward, axis=1))[:, None]
    r = np.asarray(np.gradient(grid, axis=0)).reshape(-1, 3)
    r = unit_rows(r - np.sum(r * t, axis=1)[:, None] * t)
    angle = typical.fibre_angle(layout.phi, vertex_region(layout.phi))[:, None]
    return np.asarray(np.cos(angle) * t - np.sin(angle) * r)


def _check_frames(sequence: ValveSequence, frames: CaseFrames) -> None:
    layout, reference = sequence.layout, sequence.vertices[frames.open]
    side = ventricular_side(reference[layout.annulus], reference[layout.free_edge])
    for number in frames.in_order:
        vertices, tips = sequence.vertices[number], sequence.tips[number]
        is_open = number == frames.open
        try:
            if not (np.isfinite(vertices).all() and np.isfinite(tips).all()):
                raise GeometryError("a position is not finite, expected a valve in this frame")
            check_band(vertices, layout.triangles, self_intersections=is_open)
            check_annulus_size(vertices[layout.annulus])
            check_tips(vertices[layout.annulus], side, tips)
            check_normals(vertices, layout.triangles, layout.annulus, tips)
        except InputError as fault:
            kind = "open" if is_open else "closed"
            raise type(fault)(f"valve from images, {kind} frame {number}: {fault}") from fault


def _frame(sequence: ValveSequence, frames: CaseFrames, number: int) -> Frame:
    layout, vertices, is_open = sequence.layout, sequence.vertices[number], number == frames.open
    return Frame(
        name="open" if is_open else "closed",
        time=float(sequence.times[number]),
        role=Role.REFERENCE if is_open else Role.CLOSED,
        pressure_mmHg=0.0 if is_open else float(frames.pressure_mmHg),
        vertices=vertices,
        triangles=layout.triangles,
        region=layout.region,
        annulus=vertices[layout.annulus],
        free_edge=vertices[layout.free_edge],
        papillary_tips=sequence.tips[number],
        corresponds=True,
    )


def _uncertainty(sequence: ValveSequence, derived: list[str]) -> Uncertainty:
    std = sequence.std_mm
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
    return Uncertainty(np.where(unknown, UNSEEN_STD_MM, std), float(sequence.correlation_length_mm))
