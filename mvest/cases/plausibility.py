"""Implausible values of a case: contradictions within it, or to the literature.

`mvest.cases.folder` refuses what cannot be read or computed. These values can be computed, but give
meaningless moduli: leaflets that shrink to half when the valve closes, exchanged leaflets or
frames, thickness in centimetres. No valve is closed here; it takes milliseconds.
"""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from scipy.spatial import cKDTree

from mvest.cases.band import loop_vector_area
from mvest.cases.case import Frame, Role, ValveCase
from mvest.errors import GeometryError, InputError
from mvest.quantities import Within
from mvest.typing import FloatArray, IntArray
from mvest.valve.geometry.triangles import areas
from mvest.valve.measure.annulus import AnnulusPlane, annulus_plane, measure_annulus
from mvest.valve.measure.clinical import leaflet_length
from mvest.valve.measure.coaptation import orifice_area

RANGES = {
    name: Within(low, high, unit, why)
    for name, low, high, unit, why in (
        ("ap_diameter", 15.0, 51.0, "mm", "24 ± 3 to 36 ± 5 mm, and three SD beyond: 3D "
         "echocardiography of normal and regurgitant valves, means and standard deviations"),
        ("commissural_diameter", 20.0, 58.0, "mm", "35 ± 5 to 43 ± 5 mm, likewise"),
        ("anterior_length", 13.0, 40.0, "mm", "20 to 25 mm in adults, 40 % more in myxomatous "
         "valves, less in children"),
        ("posterior_length", 6.0, 30.0, "mm", "10 to 14 mm in adults, up to twice that in "
         "myxomatous valves"),
        ("open_orifice", 50.0, 900.0, "mm²", "4 to 6 cm² in adults; below 1 cm² is severe "
         "stenosis, no model's valve"),
        ("chord_length", 3.0, 45.0, "mm", "10 to 25 mm from papillary tip to insertion, along its "
         "branches"),
        ("thickness", 0.3, 3.5, "mm", "1.2 to 1.3 mm in the paper, 5 mm at the rough edge of "
         "myxomatous leaflets"),
        ("closing_pressure", 60.0, 200.0, "mmHg", "left ventricular systolic less left atrial "
         "pressure"),
        ("area_change", 0.8, 1.5, "", "areal stretch of leaflets in vivo is 1.1 to 1.4; they do "
         "not shrink"),
        ("stretch", 0.55, 1.6, "", "principal stretches in vivo are 1.0 to 1.3; bends bring "
         "points nearer"),
        ("chord_strain", -0.2, 0.25, "", "chordae stretch by 4.3 ± 3.4 % (porcine); a closed "
         "valve hangs on them"),
        ("annulus_change", 0.7, 1.3, "", "its area changes by 10 to 25 % over a beat"),
        ("motion", 0.0, 30.0, "mm", "a leaflet's edge travels at most about its own length"),
        ("tip_motion", 0.0, 15.0, "mm", "papillary muscles shorten by less than a centimetre"),
    )
}  # fmt: skip
"""Expected ranges of a human mitral valve, each with its source or derivation."""

LOST = (0.2, 4.0)
"""Stretches of vertices that do not correspond at all."""
REACH_MM = 4.0
"""Distance over which stretch is measured: several edges, so that noise counts less."""
MAX_VERTICES = 1500
"""Number of vertices, evenly chosen, whose stretch is measured."""
EXTREME_SHARE = 0.02
"""Share of stretches left out at each end."""


@dataclass(frozen=True, slots=True)
class Implausible:
    """An implausible value of a case."""

    field: str  #: of case.yaml
    text: str  #: the value, the expected range, and the likely mistake
    mistake: bool = False  #: a mistake makes such a value, and hardly any valve does

    def __str__(self) -> str:
        return f"{self.field}: {self.text}"


Value: TypeAlias = tuple[str, str, float, str, str]
"""Field, quantity, value, its entry in `RANGES`, and the likely mistake (empty: none)."""


def implausible_values(case: ValveCase) -> tuple[Implausible, ...]:
    """All implausible values of a case, likely mistakes first."""
    values = [*_anatomy(case), *_motion(case)]
    if case.closed is not None:
        values += _closing(case, case.closed)
    found = [*_exchanged(case)]
    for field, what, value, name, hint in values:
        expected = RANGES[name]
        if not expected.low <= value <= expected.high:
            text = f"{what} is {value:.3g} {expected.unit}".rstrip()
            text += f", expected {expected.low:g} to {expected.high:g} {expected.unit}".rstrip()
            # A few outliers are not a mistake of the whole case: with one vertex in fifty wrong, 38
            # of 40 intervals held. Vertices in another order are far beyond.
            mistake = bool(hint) and (name != "stretch" or not LOST[0] < value < LOST[1])
            found.append(Implausible(field, f"{text}: {hint}" if hint else text, mistake=mistake))
    return tuple(sorted(found, key=lambda value: not value.mistake))


def require_plausible(case: ValveCase) -> None:
    """Raise InputError with all implausible values of a case, if it has any."""
    found = implausible_values(case)
    if found:
        raise InputError(f"case {case.name} is not plausible: " + "; ".join(map(str, found)))


def _anatomy(case: ValveCase) -> Iterator[Value]:
    """Thickness, chordae, annulus of each frame, leaflets and open orifice."""
    reference = case.frame(Role.REFERENCE)
    typical = float(np.median(case.surface.thickness))
    usual = RANGES["thickness"]
    hint = "is it in cm?" if usual.low <= 10 * typical <= usual.high else ""
    yield "thickness", "the leaflets' typical thickness", typical, "thickness", hint
    ends = case.chordae.ends(np.asarray(reference.papillary_tips))
    length = case.chordae.along(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1))
    for what, extreme in (("shortest", min), ("longest", max)) if len(length) else ():
        yield "chordae", f"the length of the {what} chord", extreme(length), "chord_length", ""
    for frame in case.frames:
        field, plane = f"frames.{frame.name}.annulus", _plane(case, frame)
        if plane is None:
            continue
        depth = width = np.nan
        with suppress(GeometryError):
            size = measure_annulus(frame.annulus, plane)
            depth, width = size.anteroposterior_diameter, size.commissural_diameter
        yield field, "its anteroposterior diameter", depth, "ap_diameter", ""
        yield field, "its commissural diameter", width, "commissural_diameter", ""
    for name, own in _leaflet_lengths(case).items():
        yield "regions", f"the length of the {name} leaflet", own, f"{name}_length", ""
    free = free_orifice(case, reference)
    if free is not None:
        yield f"frames.{reference.name}", "the open orifice", free, "open_orifice", ""


def _leaflets(case: ValveCase) -> dict[str, IntArray]:
    """Triangles ``(m, 3)`` of each leaflet."""
    names, triangles = enumerate(case.surface.region_names), case.surface.triangles
    return {name: triangles[case.surface.region == number] for number, name in names}


def _leaflet_lengths(case: ValveCase) -> dict[str, float]:
    """Length (mm) of the anterior and the posterior leaflet; empty for other leaflets."""
    plane, leaflets = _plane(case, case.frame(Role.REFERENCE)), _leaflets(case)
    if set(leaflets) != {"anterior", "posterior"} or plane is None:
        return {}
    x = case.surface.vertices
    return {name: leaflet_length(x, own, plane) for name, own in leaflets.items()}


def _motion(case: ValveCase) -> Iterator[Value]:
    """Differences of each frame from the reference."""
    reference = case.frame(Role.REFERENCE)
    for frame in case.frames:
        if frame is reference:
            continue
        field = f"frames.{frame.name}"
        if frame.corresponds:
            motion = float(np.linalg.norm(frame.vertices - reference.vertices, axis=1).max())
            yield field, "the largest motion of a vertex", motion, "motion", ""
        tips = np.linalg.norm(frame.papillary_tips - reference.papillary_tips, axis=1)
        what = "the largest motion of a tip"
        yield f"{field}.papillary_tips", what, float(tips.max()), "tip_motion", ""
        sizes = [np.linalg.norm(loop_vector_area(one.annulus)) for one in (frame, reference)]
        what = "the area of the annulus over that of the reference"
        yield f"{field}.annulus", what, float(sizes[0] / sizes[1]), "annulus_change", ""


def _closing(case: ValveCase, closed: Frame) -> Iterator[Value]:
    """Pressures, and the deformation of leaflets and chordae by them."""
    for frame in (closed, *case.fitted):
        pressure = frame.pressure_mmHg
        # 120 mmHg are 16 kPa.
        hint = "is it in kPa?" if 8.0 <= pressure <= 27.0 else ""
        field = "frames.pressure" if frame is closed else f"frames.{frame.name}.pressure"
        yield field, "the pressure on the closed valve", pressure, "closing_pressure", hint
    surface, chordae, field = case.surface, case.chordae, f"frames.{closed.name}.surface"
    for number, (name, own) in enumerate(_leaflets(case).items()):
        before = areas(surface.vertices, own).sum()
        after = areas(closed.vertices, closed.triangles[closed.region == number]).sum()
        if before <= 0 or after <= 0:
            continue
        what = f"area of the {name} leaflet, closed over open,"
        yield field, what, float(after / before), "area_change", ""
        what = (
            f"the distance of points of the {name} leaflet {0.7 * REACH_MM:.1f} to {REACH_MM:g} mm "
            "apart, closed over open,"
        )
        for stretch in _stretches(surface.vertices, closed, np.unique(own)):
            yield field, what, stretch, "stretch", "do its vertices correspond?"
    if closed.corresponds and len(chordae):
        _, at = cKDTree(surface.vertices).query(chordae.insertion)
        away = closed.vertices[at] - closed.papillary_tips[chordae.end_tip]
        # The least strain of a branching chord. Quantiles, because noise moves single ends.
        least = np.linalg.norm(away, axis=1) / chordae.along(chordae.rest_length) - 1.0
        tight, middle = np.quantile(least, [0.9, 0.5])
        too_tight = tight > RANGES["chord_strain"].high
        share, strain = ("a tenth", tight) if too_tight else ("half", middle)
        what = f"the strain that {share} of the chordae exceed"
        yield f"frames.{closed.name}.papillary_tips", what, float(strain), "chord_strain", ""


def _stretches(rest: FloatArray, closed: Frame, members: IntArray) -> tuple[float, ...]:
    """The least and the largest stretch of a leaflet; none if vertices do not correspond."""
    if not closed.corresponds:
        return ()
    members = members[:: max(1, len(members) // MAX_VERTICES)]
    x, moved = rest[members], closed.vertices[members]
    pairs = cKDTree(x).query_pairs(REACH_MM, output_type="ndarray")
    apart, now = (np.linalg.norm(np.diff(one[pairs], axis=1)[:, 0], axis=1) for one in (x, moved))
    far = apart > 0.7 * REACH_MM
    if not far.any():
        return ()
    return tuple(np.quantile(now[far] / apart[far], [EXTREME_SHARE, 1 - EXTREME_SHARE]).tolist())


def _exchanged(case: ValveCase) -> Iterator[Implausible]:
    """Exchanged leaflets and frames."""
    reference, closed, length = case.frame(Role.REFERENCE), case.closed, _leaflet_lengths(case)
    part = _anterior_share(case) if length else 0.0
    if part > 0.5 and length["anterior"] < length["posterior"]:
        text = (
            f"the anterior leaflet has {100 * part:.0f} % of the annulus and is "
            f"{length['anterior']:.1f} mm long, the posterior {length['posterior']:.1f} mm; the "
            "anterior one is the longer, on the shorter part of the annulus: are they exchanged?"
        )
        yield Implausible("regions", text, mistake=True)
    if closed is None:
        return
    before, after = (free_orifice(case, frame) for frame in (reference, closed))
    if before is not None and after is not None and after > before:
        text = (
            f"the closed frame {closed.name!r} leaves {after:.0f} mm² free, the reference "
            f"{reference.name!r} {before:.0f} mm²: are the frames exchanged?"
        )
        yield Implausible("frames", text, mistake=True)


def _anterior_share(case: ValveCase) -> float:
    """Share of the annulus' length that belongs to the anterior leaflet of two."""
    annulus = case.surface.vertices[case.annulus]
    step = np.linalg.norm(np.roll(annulus, -1, axis=0) - annulus, axis=1)
    length = {}
    for name, triangles in _leaflets(case).items():
        own = np.isin(case.annulus, triangles)
        length[name] = float(step[own & np.roll(own, -1)].sum())
    return length["anterior"] / max(sum(length.values()), 1e-12)


def free_orifice(case: ValveCase, frame: Frame, vertices: FloatArray | None = None) -> float | None:
    """Orifice area (mm²) in a frame along the normal of the annulus; None without such a plane.

    ``vertices (n, 3)`` mm are those of the reference in a model, instead of the observed ones.
    """
    plane = _plane(case, frame)
    if plane is None:
        return None
    if vertices is not None:
        triangles, annulus = case.surface.triangles, vertices[case.annulus]
        frame = replace(frame, vertices=vertices, triangles=triangles, annulus=annulus)
    with suppress(GeometryError):
        return orifice_area(frame.vertices, frame.triangles, frame.annulus, plane, 0.5)
    return None


def _plane(case: ValveCase, frame: Frame) -> AnnulusPlane | None:
    """The plane of the annulus in a frame, if it has one.

    Its anterior direction is that of the anterior leaflet, or of the first if none has that name.
    """
    leaflets = _leaflets(case)
    own = leaflets.get("anterior", next(iter(leaflets.values())))
    anterior = np.isin(case.annulus, own)
    if not anterior.any() or len(frame.annulus) != len(case.annulus):
        return None
    with suppress(GeometryError):
        tips, front = frame.papillary_tips.mean(axis=0), frame.annulus[anterior].mean(axis=0)
        return annulus_plane(frame.annulus, tips, front)
    return None
