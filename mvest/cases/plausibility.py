"""Could this be a mitral valve that closes? What in a case contradicts itself or the literature.

`mvest.cases.folder` refuses what cannot be read or computed. What is judged here can be computed,
to moduli that mean nothing: leaflets that shrink to half when the valve closes, the two leaflets
exchanged, thickness in centimetres. Nothing here closes a valve; it takes milliseconds.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from mvest.cases.case import Frame, Role, ValveCase
from mvest.errors import GeometryError, InputError
from mvest.typing import FloatArray, IntArray
from mvest.valve.geometry.triangles import areas
from mvest.valve.measure.annulus import AnnulusPlane, annulus_plane, measure_annulus
from mvest.valve.measure.coaptation import orifice_area
from mvest.valve.measure.measurements import leaflet_length


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
        13.0,
        40.0,
        "mm",
        "20 to 25 mm in adults, up to 40 % more in myxomatous valves, children's less",
    ),
    "posterior_length": HumanRange(
        6.0, 30.0, "mm", "10 to 14 mm in adults, up to twice that in myxomatous valves"
    ),
    "open_orifice": HumanRange(
        50.0,
        900.0,
        "mm²",
        "4 to 6 cm² in adults; below 1 cm² is severe stenosis, of which the "
        "leaflets are not those of the model",
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
        0.8,
        1.5,
        "",
        "areal stretch of leaflets in vivo is 1.1 to 1.4; they do not shrink under load",
    ),
    "stretch": HumanRange(
        0.55,
        1.6,
        "",
        "principal stretches in vivo are 1.0 to 1.3; a distance across a bend is shorter",
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


def doubts(case: ValveCase) -> tuple[Doubt, ...]:
    """All that is doubtful about a case, mistakes first; empty if nothing is."""
    found = [
        *_of_pressure(case),
        *_of_thickness(case),
        *_of_annulus(case),
        *_of_leaflets(case),
        *_of_orifice(case),
        *_of_stretch(case),
        *_of_chordae(case),
        *_of_motion(case),
    ]
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


def _of_pressure(case: ValveCase) -> Iterator[Doubt]:
    closed = case.closed
    if closed is None:
        return
    for frame in (closed, *case.fitted):
        pressure = frame.pressure_mmHg
        # kPa taken for mmHg: 120 mmHg are 16 kPa.
        hint = "is it in kPa?" if 8.0 <= pressure <= 27.0 else ""
        field = "frames.pressure" if frame is closed else f"frames.{frame.name}.pressure"
        what = "the pressure on the closed valve"
        yield from _outside(field, what, pressure, "closing_pressure", hint)
    for frame in case.fitted:
        yield from _of_order(case, closed, frame)


def _of_order(case: ValveCase, closed: Frame, other: Frame) -> Iterator[Doubt]:
    """Whether the leaflets are nearer to the atrium under the larger of two pressures."""
    heights = []
    for frame in (closed, other):
        plane = _plane(case, frame)
        if plane is None:
            return
        heights.append(-float(plane.coordinates(frame.vertices)[:, 2] @ _weights(frame)))
    rise = (heights[1] - heights[0]) * np.sign(other.pressure_mmHg - closed.pressure_mmHg)
    doubt = case.uncertainty
    size = float(areas(closed.vertices, closed.triangles).sum())
    alike = 2.0 * np.pi * doubt.correlation_length_mm**2
    independent = len(closed.vertices) if alike == 0.0 else max(size / alike, 1.0)
    if rise < -ORDER_STDS * doubt.typical_mm * np.sqrt(2.0 / independent):
        high, low = sorted((closed, other), key=lambda f: f.pressure_mmHg, reverse=True)
        yield Doubt(
            f"frames.{other.name}.pressure",
            f"under {high.pressure_mmHg:.3g} mmHg in {high.name!r} the leaflets lie {-rise:.1f} mm "
            f"farther from the atrium than under {low.pressure_mmHg:.3g} mmHg in {low.name!r}: are "
            "frames or pressures exchanged?",
            mistake=True,
        )


def _weights(frame: Frame) -> FloatArray:
    """Share of a frame's area ``(n,)`` about each of its vertices."""
    own = np.repeat(areas(frame.vertices, frame.triangles) / 3.0, 3)
    about = np.bincount(frame.triangles.ravel(), own, len(frame.vertices))
    return about / about.sum()


def _of_thickness(case: ValveCase) -> Iterator[Doubt]:
    typical = float(np.median(case.surface.thickness))
    expected = RANGES["thickness"]
    hint = "is it in cm?" if 10 * typical in expected and typical not in expected else ""
    yield from _outside("thickness", "the leaflets' typical thickness", typical, "thickness", hint)


def _of_annulus(case: ValveCase) -> Iterator[Doubt]:
    for frame in case.frames:
        plane = _plane(case, frame)
        if plane is None:
            continue
        try:
            size = measure_annulus(frame.annulus, plane)
        except GeometryError as fault:
            yield Doubt(f"frames.{frame.name}.annulus", str(fault))
            continue
        field = f"frames.{frame.name}.annulus"
        width, depth = size.commissural_diameter, size.anteroposterior_diameter
        yield from _outside(field, "its anteroposterior diameter", depth, "ap_diameter")
        yield from _outside(field, "its commissural diameter", width, "commissural_diameter")


def _of_leaflets(case: ValveCase) -> Iterator[Doubt]:
    """Lengths of the leaflets, and whether they are exchanged."""
    surface = case.surface
    names = surface.region_names
    reference = case.frame(Role.REFERENCE)
    plane = _plane(case, reference)
    if set(names) != {"anterior", "posterior"} or plane is None:
        return
    length, share = {}, {}
    on_annulus = np.zeros(len(surface.vertices), dtype=bool)
    on_annulus[case.annulus] = True
    for number, name in enumerate(names):
        triangles = surface.triangles[surface.region == number]
        length[name] = leaflet_length(surface.vertices, triangles, plane)
        own = np.zeros(len(surface.vertices), dtype=bool)
        own[triangles] = True
        share[name] = _arc(surface.vertices, case.annulus, own)
    part = share["anterior"] / max(sum(share.values()), 1e-12)
    if part > 0.5 and length["anterior"] < length["posterior"]:
        yield Doubt(
            "regions",
            f"the anterior leaflet has {100 * part:.0f} % of the annulus and is "
            f"{length['anterior']:.1f} mm long, the posterior {length['posterior']:.1f} mm; the "
            "anterior one is the longer, on the shorter part of the annulus: are they exchanged?",
            mistake=True,
        )
    for name in names:
        yield from _outside(
            "regions", f"the length of the {name} leaflet", length[name], f"{name}_length"
        )


def _arc(vertices: FloatArray, loop: IntArray, own: np.typing.NDArray[np.bool_]) -> float:
    following = np.roll(loop, -1)
    length = np.linalg.norm(vertices[following] - vertices[loop], axis=1)
    return float(length[own[loop] & own[following]].sum())


def _of_orifice(case: ValveCase) -> Iterator[Doubt]:
    reference, closed = case.frame(Role.REFERENCE), case.closed
    open_ = free_orifice(case, reference)
    if open_ is None:
        return
    left = None if closed is None else free_orifice(case, closed)
    if closed is not None and left is None:
        return
    if closed is not None and left is not None and left > open_:
        yield Doubt(
            "frames",
            f"the closed frame {closed.name!r} leaves {left:.0f} mm² free, the reference "
            f"{reference.name!r} {open_:.0f} mm²: are the frames exchanged?",
            mistake=True,
        )
        return
    yield from _outside(f"frames.{reference.name}", "the open orifice", open_, "open_orifice")


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
    if plane is None:
        return None
    try:
        if vertices is not None:
            triangles = case.surface.triangles
            return orifice_area(vertices, triangles, vertices[case.annulus], plane, 0.5)
        return orifice_area(frame.vertices, frame.triangles, frame.annulus, plane, 0.5)
    except GeometryError:
        return None


def _of_stretch(case: ValveCase) -> Iterator[Doubt]:
    """Whether the leaflets keep their size from the open to the closed frame."""
    surface, closed = case.surface, case.closed
    if closed is None:
        return
    field = f"frames.{closed.name}.surface"
    for number, name in enumerate(surface.region_names):
        before = areas(surface.vertices, surface.triangles[surface.region == number]).sum()
        after = areas(closed.vertices, closed.triangles[closed.region == number]).sum()
        if before <= 0 or after <= 0:
            continue
        change = float(after / before)
        yield from _outside(
            field, f"area of the {name} leaflet, closed over open,", change, "area_change"
        )
        if not closed.corresponds:
            continue
        members = np.unique(surface.triangles[surface.region == number])
        members = members[:: max(1, len(members) // MAX_VERTICES)]
        rest, moved = surface.vertices[members], closed.vertices[members]
        first, second = cKDTree(rest).query_pairs(REACH_MM, output_type="ndarray").T
        apart = np.linalg.norm(rest[first] - rest[second], axis=1)
        far = apart > 0.7 * REACH_MM
        if not far.any():
            continue
        now = np.linalg.norm(moved[first] - moved[second], axis=1)
        stretch = (now / np.maximum(apart, 1e-12))[far]
        low, high = np.quantile(stretch, [EXTREME_SHARE, 1 - EXTREME_SHARE])
        expected = RANGES["stretch"]
        if low not in expected or high not in expected:
            yield Doubt(
                field,
                f"points of the {name} leaflet {0.7 * REACH_MM:.1f} to {REACH_MM:g} mm apart come "
                f"to {low:.2f} to {high:.2f} times their distance in the open frame, expected "
                f"{expected}: do its vertices correspond?",
                mistake=True,
            )


def _of_chordae(case: ValveCase) -> Iterator[Doubt]:
    chordae = case.chordae
    if not len(chordae):
        return
    reference, closed = case.frame(Role.REFERENCE), case.closed
    open_ = np.linalg.norm(chordae.insertion - reference.papillary_tips[chordae.tip], axis=1)
    expected = RANGES["chord_length"]
    strange = [k for k, length in enumerate(open_) if float(length) not in expected]
    if strange:
        yield Doubt(
            "chordae",
            f"{len(strange)} of {len(open_)} chords are not {expected} long, chord {strange[0]} "
            f"{open_[strange[0]]:.1f} mm",
        )
    if closed is None or not closed.corresponds:
        return
    _, at = cKDTree(case.surface.vertices).query(chordae.insertion)
    length = np.linalg.norm(closed.vertices[at] - closed.papillary_tips[chordae.tip], axis=1)
    strain = length / chordae.rest_length - 1.0
    field = f"frames.{closed.name}.papillary_tips"
    # Single chords end where noise takes them.
    tight, middle = np.quantile(strain, [0.9, 0.5])
    if tight > RANGES["chord_strain"].high:
        what = "the strain that a tenth of the chordae exceed"
        yield from _outside(field, what, float(tight), "chord_strain")
    else:
        what = "the strain that half of the chordae exceed"
        yield from _outside(field, what, float(middle), "chord_strain")


def _of_motion(case: ValveCase) -> Iterator[Doubt]:
    reference = case.frame(Role.REFERENCE)
    size = _loop_area(reference.annulus)
    for frame in case.frames:
        if frame is reference:
            continue
        field = f"frames.{frame.name}"
        if frame.corresponds:
            motion = float(np.linalg.norm(frame.vertices - reference.vertices, axis=1).max())
            yield from _outside(field, "the largest motion of a vertex", motion, "motion")
        tips = np.linalg.norm(frame.papillary_tips - reference.papillary_tips, axis=1)
        yield from _outside(
            f"{field}.papillary_tips",
            "the largest motion of a tip",
            float(tips.max()),
            "tip_motion",
        )
        yield from _outside(
            f"{field}.annulus",
            "the area of the annulus over that of the reference",
            _loop_area(frame.annulus) / size,
            "annulus_change",
        )


def _loop_area(loop: FloatArray) -> float:
    spokes = loop - loop.mean(axis=0)
    return 0.5 * float(np.linalg.norm(np.cross(spokes, np.roll(spokes, -1, axis=0)).sum(axis=0)))


def _plane(case: ValveCase, frame: Frame) -> AnnulusPlane | None:
    """The plane of the annulus in a frame; None where it has none, which is said elsewhere.

    The anterior direction is to the leaflet of that name, or to the first.
    """
    surface = case.surface
    names = surface.region_names
    number = names.index("anterior") if "anterior" in names else 0
    own = np.zeros(len(surface.vertices), dtype=bool)
    own[surface.triangles[surface.region == number]] = True
    anterior = own[case.annulus]
    if not anterior.any() or len(frame.annulus) != len(case.annulus):
        return None
    try:
        return annulus_plane(
            frame.annulus, frame.papillary_tips.mean(axis=0), frame.annulus[anterior].mean(axis=0)
        )
    except GeometryError:
        return None
