"""Could this be a mitral valve that closes? What in a case contradicts itself or the literature.

`mvest.cases.folder` refuses what cannot be read or computed. What is judged here can be computed,
to moduli that mean nothing: leaflets that shrink to half when the valve closes, the two leaflets
exchanged, thickness in centimetres. Nothing here closes a valve; it takes milliseconds.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from mvest.cases.case import Frame, Role, ValveCase
from mvest.cases.rims import loop_vector_area
from mvest.errors import GeometryError, InputError
from mvest.typing import FloatArray
from mvest.valve.anatomy.valve import LeafletSurface, lumped_areas
from mvest.valve.geometry.triangles import areas
from mvest.valve.measure.annulus import AnnulusPlane, annulus_plane, measure_annulus
from mvest.valve.measure.clinical import leaflet_length
from mvest.valve.measure.coaptation import orifice_area


@dataclass(frozen=True, slots=True)
class HumanRange:
    """Between which values a quantity of a human mitral valve is expected, and why.

    Attributes
    ----------
    low, high : float
    unit : str
    why : str
        Source, or what the limit is derived from.
    """

    low: float
    high: float
    unit: str
    why: str

    def __contains__(self, value: float) -> bool:
        return self.low <= value <= self.high

    def __str__(self) -> str:
        return f"{self.low:g} to {self.high:g} {self.unit}".rstrip()


_SIZES = (
    "3D echocardiography of normal and regurgitant valves: means and standard deviations of "
    "24 ± 3 to 36 ± 5 mm (AP) and 35 ± 5 to 43 ± 5 mm (commissural), and three of them beyond"
)
RANGES: Mapping[str, HumanRange] = {
    "ap_diameter": HumanRange(15.0, 51.0, "mm", _SIZES),
    "commissural_diameter": HumanRange(20.0, 58.0, "mm", _SIZES),
    "anterior_length": HumanRange(
        13.0, 40.0, "mm", "20 to 25 mm in adults, 40 % more in myxomatous valves, less in children"
    ),
    "posterior_length": HumanRange(
        6.0, 30.0, "mm", "10 to 14 mm in adults, up to twice that in myxomatous valves"
    ),
    "open_orifice": HumanRange(
        50.0, 900.0, "mm²", "4 to 6 cm² in adults; below 1 cm² is severe stenosis, no model's valve"
    ),
    "chord_length": HumanRange(
        3.0, 45.0, "mm", "10 to 25 mm from papillary tip to insertion; branches are shorter"
    ),
    "thickness": HumanRange(
        0.3, 3.5, "mm", "1.2 to 1.3 mm in the paper, 5 mm at the rough edge of myxomatous leaflets"
    ),
    "closing_pressure": HumanRange(
        60.0, 200.0, "mmHg", "left ventricular systolic less left atrial pressure"
    ),
    "area_change": HumanRange(
        0.8, 1.5, "", "areal stretch of leaflets in vivo is 1.1 to 1.4; they do not shrink"
    ),
    "stretch": HumanRange(
        0.55, 1.6, "", "principal stretches in vivo are 1.0 to 1.3; bends bring points nearer"
    ),
    "chord_strain": HumanRange(
        -0.2, 0.25, "", "chordae stretch by 4.3 ± 3.4 % (porcine); a closed valve hangs on them"
    ),
    "annulus_change": HumanRange(0.7, 1.3, "", "its area changes by 10 to 25 % over a beat"),
    "motion": HumanRange(0.0, 30.0, "mm", "a leaflet's edge travels at most about its own length"),
    "tip_motion": HumanRange(
        0.0, 15.0, "mm", "papillary muscles shorten by less than a centimetre"
    ),
}
"""What is expected of a human mitral valve."""

REACH_MM = 4.0
"""Distance over which stretch is judged: several edges, so that noise counts less."""
ORDER_STDS = 3.0
"""Standard deviations by which the leaflets lie the wrong way before pressures are doubted."""
MAX_VERTICES = 1500
"""As many are looked at, evenly, so that the time is milliseconds for any surface."""
EXTREME_SHARE = 0.02
"""Of stretches, the share left out at each end."""


@dataclass(frozen=True, slots=True)
class Doubt:
    """Something about a case that is hardly so.

    Attributes
    ----------
    field : str
        Where in ``case.yaml`` it is said.
    text : str
        What is seen, with its numbers, and what it may be.
    mistake : bool
        Whether it is of the kind that a mistake makes, and hardly any valve.
    """

    field: str
    text: str
    mistake: bool = False

    def __str__(self) -> str:
        return f"{self.field}: {self.text}"


Planes = Mapping[str, AnnulusPlane | None]
"""Plane of the annulus by the name of a frame; None where it has none."""


def doubts(case: ValveCase) -> tuple[Doubt, ...]:
    """All that is doubtful about a case, mistakes first; empty if nothing is."""
    planes = {frame.name: _plane(case, frame) for frame in case.frames}
    found = [*_of_anatomy(case, planes), *_of_leaflets(case, planes), *_of_orifice(case, planes)]
    if case.closed is not None:
        found += [*_of_closing(case, case.closed, planes), *_of_motion(case)]
    return tuple(sorted(found, key=lambda doubt: not doubt.mistake))


def require_plausible(case: ValveCase) -> None:
    """Raise where anything about a case is doubtful.

    Raises
    ------
    InputError
        That names all of it.
    """
    found = doubts(case)
    if found:
        raise InputError(f"case {case.name} is not plausible: " + "; ".join(map(str, found)))


def _outside(field: str, what: str, value: float, name: str, hint: str = "") -> Iterator[Doubt]:
    expected = RANGES[name]
    if value not in expected:
        unit = f" {expected.unit}" if expected.unit else ""
        text = f"{what} is {value:.3g}{unit}, expected {expected}"
        yield Doubt(field, f"{text}: {hint}" if hint else text, mistake=bool(hint))


def _of_anatomy(case: ValveCase, planes: Planes) -> Iterator[Doubt]:
    """Thickness, chordae and the annulus of each frame."""
    typical = float(np.median(case.surface.thickness))
    hint = "is it in cm?" if 10 * typical in RANGES["thickness"] else ""
    yield from _outside("thickness", "the leaflets' typical thickness", typical, "thickness", hint)
    for frame in case.frames:
        plane, field = planes[frame.name], f"frames.{frame.name}.annulus"
        if plane is None:
            continue
        try:
            size = measure_annulus(frame.annulus, plane)
        except GeometryError as fault:
            yield Doubt(field, str(fault))
            continue
        width, depth = size.commissural_diameter, size.anteroposterior_diameter
        yield from _outside(field, "its anteroposterior diameter", depth, "ap_diameter")
        yield from _outside(field, "its commissural diameter", width, "commissural_diameter")
    tips = case.frame(Role.REFERENCE).papillary_tips[case.chordae.tip]
    length = np.linalg.norm(case.chordae.insertion - tips, axis=1)
    expected = RANGES["chord_length"]
    strange = [k for k, own in enumerate(length) if float(own) not in expected]
    if strange:
        yield Doubt(
            "chordae",
            f"{len(strange)} of {len(length)} chords are not {expected} long, chord {strange[0]} "
            f"{length[strange[0]]:.1f} mm",
        )


def _of_leaflets(case: ValveCase, planes: Planes) -> Iterator[Doubt]:
    """Lengths of the leaflets, and whether they are exchanged."""
    surface, plane = case.surface, planes[case.frame(Role.REFERENCE).name]
    if set(surface.region_names) != {"anterior", "posterior"} or plane is None:
        return
    annulus = surface.vertices[case.annulus]
    step = np.linalg.norm(np.roll(annulus, -1, axis=0) - annulus, axis=1)
    length, share = {}, {}
    for number, name in enumerate(surface.region_names):
        triangles = surface.triangles[surface.region == number]
        length[name] = leaflet_length(surface.vertices, triangles, plane)
        own = np.isin(case.annulus, triangles)
        share[name] = float(step[own & np.roll(own, -1)].sum())
    part = share["anterior"] / max(sum(share.values()), 1e-12)
    if part > 0.5 and length["anterior"] < length["posterior"]:
        yield Doubt(
            "regions",
            f"the anterior leaflet has {100 * part:.0f} % of the annulus and is "
            f"{length['anterior']:.1f} mm long, the posterior {length['posterior']:.1f} mm; the "
            "anterior one is the longer, on the shorter part of the annulus: are they exchanged?",
            mistake=True,
        )
    for name, own_length in length.items():
        what = f"the length of the {name} leaflet"
        yield from _outside("regions", what, own_length, f"{name}_length")


def _of_orifice(case: ValveCase, planes: Planes) -> Iterator[Doubt]:
    """What the leaflets leave free, and whether the frames are exchanged."""
    reference, closed = case.frame(Role.REFERENCE), case.closed
    free = [_free(frame, planes[frame.name]) for frame in (reference, closed or reference)]
    if free[0] is None or free[1] is None:
        return
    if closed is not None and free[1] > free[0]:
        yield Doubt(
            "frames",
            f"the closed frame {closed.name!r} leaves {free[1]:.0f} mm² free, the reference "
            f"{reference.name!r} {free[0]:.0f} mm²: are the frames exchanged?",
            mistake=True,
        )
    else:
        field = f"frames.{reference.name}"
        yield from _outside(field, "the open orifice", free[0], "open_orifice")


def free_orifice(case: ValveCase, frame: Frame, vertices: FloatArray | None = None) -> float | None:
    """Area (mm²) that the leaflets leave free in a frame, seen along the normal of the annulus.

    None where the annulus has no plane.

    Parameters
    ----------
    case : ValveCase
    frame : Frame
    vertices : (n, 3) mm, optional
        Where a model has the vertices of the reference frame, instead of what was seen.
    """
    plane = _plane(case, frame)
    if vertices is not None:
        triangles, annulus = case.surface.triangles, vertices[case.annulus]
        frame = replace(frame, vertices=vertices, triangles=triangles, annulus=annulus)
    return _free(frame, plane)


def _free(frame: Frame, plane: AnnulusPlane | None) -> float | None:
    if plane is None:
        return None
    try:
        return orifice_area(frame.vertices, frame.triangles, frame.annulus, plane, 0.5)
    except GeometryError:
        return None


def _of_closing(case: ValveCase, closed: Frame, planes: Planes) -> Iterator[Doubt]:
    """Pressures, and what they do to leaflets and chordae."""
    for frame in (closed, *case.fitted):
        pressure = frame.pressure_mmHg
        # kPa taken for mmHg: 120 mmHg are 16 kPa.
        hint = "is it in kPa?" if 8.0 <= pressure <= 27.0 else ""
        field = "frames.pressure" if frame is closed else f"frames.{frame.name}.pressure"
        what = "the pressure on the closed valve"
        yield from _outside(field, what, pressure, "closing_pressure", hint)
    for frame in case.fitted:
        yield from _of_order(case, closed, frame, planes)
    for number, name in enumerate(case.surface.region_names):
        yield from _of_stretch(case.surface, closed, number, name)
    if closed.corresponds and len(case.chordae):
        chordae = case.chordae
        _, at = cKDTree(case.surface.vertices).query(chordae.insertion)
        length = np.linalg.norm(closed.vertices[at] - closed.papillary_tips[chordae.tip], axis=1)
        # Single chords end where noise takes them.
        tight, middle = np.quantile(length / chordae.rest_length - 1.0, [0.9, 0.5])
        too_tight = tight > RANGES["chord_strain"].high
        share, strain = ("a tenth", tight) if too_tight else ("half", middle)
        what = f"the strain that {share} of the chordae exceed"
        field = f"frames.{closed.name}.papillary_tips"
        yield from _outside(field, what, float(strain), "chord_strain")


def _of_order(case: ValveCase, closed: Frame, other: Frame, planes: Planes) -> Iterator[Doubt]:
    """Whether the leaflets are nearer to the atrium under the larger of two pressures."""
    heights = []
    for frame in (closed, other):
        plane, size = planes[frame.name], lumped_areas(frame.vertices, frame.triangles)
        if plane is None:
            return
        heights.append(-float(plane.coordinates(frame.vertices)[:, 2] @ size / size.sum()))
    rise = (heights[1] - heights[0]) * np.sign(other.pressure_mmHg - closed.pressure_mmHg)
    doubt = case.uncertainty
    alike = 2.0 * np.pi * doubt.correlation_length_mm**2
    whole = areas(closed.vertices, closed.triangles).sum()
    independent = len(closed.vertices) if alike == 0.0 else max(whole / alike, 1.0)
    if rise < -ORDER_STDS * doubt.typical_mm * np.sqrt(2.0 / independent):
        high, low = sorted((closed, other), key=lambda f: f.pressure_mmHg, reverse=True)
        yield Doubt(
            f"frames.{other.name}.pressure",
            f"under {high.pressure_mmHg:.3g} mmHg in {high.name!r} the leaflets lie {-rise:.1f} mm "
            f"farther from the atrium than under {low.pressure_mmHg:.3g} mmHg in {low.name!r}: are "
            "frames or pressures exchanged?",
            mistake=True,
        )


def _of_stretch(surface: LeafletSurface, closed: Frame, number: int, name: str) -> Iterator[Doubt]:
    """Whether a leaflet keeps its size from the open to the closed frame."""
    field, own = f"frames.{closed.name}.surface", surface.triangles[surface.region == number]
    before = areas(surface.vertices, own).sum()
    after = areas(closed.vertices, closed.triangles[closed.region == number]).sum()
    if before <= 0 or after <= 0:
        return
    what = f"area of the {name} leaflet, closed over open,"
    yield from _outside(field, what, after / before, "area_change")
    if not closed.corresponds:
        return
    members = np.unique(own)
    members = members[:: max(1, len(members) // MAX_VERTICES)]
    rest, moved = surface.vertices[members], closed.vertices[members]
    pairs = cKDTree(rest).query_pairs(REACH_MM, output_type="ndarray")
    apart, now = (np.linalg.norm(np.diff(x[pairs], axis=1)[:, 0], axis=1) for x in (rest, moved))
    far = apart > 0.7 * REACH_MM
    if not far.any():
        return
    low, high = np.quantile(now[far] / apart[far], [EXTREME_SHARE, 1 - EXTREME_SHARE])
    expected = RANGES["stretch"]
    if low not in expected or high not in expected:
        yield Doubt(
            field,
            f"points of the {name} leaflet {0.7 * REACH_MM:.1f} to {REACH_MM:g} mm apart come to "
            f"{low:.2f} to {high:.2f} times their distance in the open frame, expected "
            f"{expected}: do its vertices correspond?",
            mistake=True,
        )


def _of_motion(case: ValveCase) -> Iterator[Doubt]:
    """How far each frame is from the reference."""
    reference = case.frame(Role.REFERENCE)
    for frame in case.frames:
        if frame is reference:
            continue
        field = f"frames.{frame.name}"
        if frame.corresponds:
            motion = float(np.linalg.norm(frame.vertices - reference.vertices, axis=1).max())
            yield from _outside(field, "the largest motion of a vertex", motion, "motion")
        tips = np.linalg.norm(frame.papillary_tips - reference.papillary_tips, axis=1)
        what = "the largest motion of a tip"
        yield from _outside(f"{field}.papillary_tips", what, float(tips.max()), "tip_motion")
        sizes = [np.linalg.norm(loop_vector_area(one.annulus)) for one in (frame, reference)]
        what = "the area of the annulus over that of the reference"
        change = float(sizes[0] / sizes[1])
        yield from _outside(f"{field}.annulus", what, change, "annulus_change")


def _plane(case: ValveCase, frame: Frame) -> AnnulusPlane | None:
    """The plane of the annulus in a frame; None where it has none, which is said elsewhere.

    The anterior direction is to the leaflet of that name, or to the first.
    """
    surface, names = case.surface, case.surface.region_names
    number = names.index("anterior") if "anterior" in names else 0
    anterior = np.isin(case.annulus, surface.triangles[surface.region == number])
    if not anterior.any() or len(frame.annulus) != len(case.annulus):
        return None
    try:
        return annulus_plane(
            frame.annulus, frame.papillary_tips.mean(axis=0), frame.annulus[anterior].mean(axis=0)
        )
    except GeometryError:
        return None
