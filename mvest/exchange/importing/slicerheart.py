"""Imports SlicerHeart exports: leaflets, annulus, landmarks and papillary muscles."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np
from scipy.spatial import cKDTree

from mvest.cases.band import find_loops
from mvest.cases.case import Role, ValveCase
from mvest.errors import InputError
from mvest.exchange.importing.joining import EDGE_MM, Leaflet, commissures_on, joined, united
from mvest.exchange.importing.slicerheart_folder import PHASES, SeenPhase, read_folder
from mvest.exchange.importing.written import (
    REGIONS,
    FoundFrame,
    Pair,
    Tips,
    case_of_frames,
    check_sides,
)
from mvest.exchange.markups import TO_LPS
from mvest.quantities import Length, Pressure
from mvest.reading.text import named
from mvest.typing import FloatArray, IntArray
from mvest.valve.anatomy.dimensions import FAMILIES
from mvest.valve.anatomy.template import Template
from mvest.valve.anatomy.valve import Chordae, paths

OPEN, CLOSED = ("MD", "ED", "CD"), ("MS", "ES", "CS")
"""Phases in order of preference."""
TIMES = {"MS": 0.3, "CS": 0.4, "ES": 0.5}
"""Times (s) after the open phase, in cardiac order."""
GENERIC_PRESSURE = 110.0
"""mmHg on the closed valve: ventricular minus atrial pressure, mid to end of systole."""
CORRELATED_MM = 10.0
"""Correlation length of segmentation errors along the leaflets."""
MAX_RMS = 4.0
"""Largest RMS distance (mm) between the annulus and the leaflet edges."""
DECIMALS = 3
"""Points (mm) that agree in so many decimals are one: text has six digits."""
MARGINAL_MM = 4.0
"""Largest distance from the free edge at which a marginal chord inserts."""
MAX_AWAY = 3.0
"""Largest distance (mm) of a chord's beginning from its papillary tip."""

_Seen: TypeAlias = tuple[SeenPhase, Role]


@dataclass(frozen=True, slots=True)
class SlicerheartOptions:
    """Values that a SlicerHeart folder does not state.

    Attributes
    ----------
    scene : str or None
        Scene to import, if the folder holds several.
    only : str or None
        Word in file names that selects one of several surfaces of a leaflet.
    open, closed : str or None
        Phases (MD, ED, MS, ES, ...) of the reference and of the closed frame; by default the first
        available of MD, ED, CD and of MS, ES, CS. If file names have no phases, ``closed`` is the
        folder of the closed valve.
    tips : tuple of float or None
        Papillary tips of the reference, antero-lateral and postero-medial: six numbers, LPS mm.
    pressure_mmHg : float or None
        Transmitral pressure on the closed valve; 110 mmHg by default.
    thickness_mm : tuple of float or None
        Thickness of the anterior and posterior leaflets; generic by default.
    midsurface : bool
        Whether the surfaces are midsurfaces. By default they are atrial sides, which are moved
        towards the ventricle by half the thickness.
    std_mm : float or None
        Standard deviation of a coordinate of the surfaces; 1 mm by default.
    mirrored : bool
        Accept a mirrored valve.
    """

    scene: str | None = None
    only: str | None = None
    open: str | None = None
    closed: str | None = None
    tips: Tips | None = None
    pressure_mmHg: Pressure | None = None
    thickness_mm: Pair | None = None
    midsurface: bool = False
    std_mm: Length | None = None
    mirrored: bool = False

    @property
    def offset_mm(self) -> tuple[float, float] | None:
        """Shift of each leaflet towards the ventricle; None: half the assumed thickness."""
        if self.midsurface or self.thickness_mm is None:
            return (0.0, 0.0) if self.midsurface else None
        return 0.5 * self.thickness_mm[0], 0.5 * self.thickness_mm[1]


def import_slicerheart(source: Path, options: SlicerheartOptions) -> ValveCase:
    """Make a case from a folder written by SlicerHeart's ValveBatchExport or ValveFemExport.

    An open phase becomes the reference and a closed phase the closed frame; another closed phase is
    held out. The leaflets are separate surfaces in the export; they are joined at the commissures.

    InputError or GeometryError if a required option is missing (the message names it), or files are
    damaged or contradictory.

    ``source``: the folder of one scene, with ``*_atrial_*.vtk`` and, if exported,
    ``AnnulusContourPoints.csv``, ``ValveLandmarkPoints.csv`` and ``*_landmarks.fcsv``; papillary
    muscles are lists of points in files named ``PapillaryMarkup-...``.
    """
    if not source.is_dir():
        raise InputError(f"{source}: no such folder; expected one that SlicerHeart wrote")
    derived: list[str] = []
    with named(source):
        chosen = _chosen(source, options, derived)
        frames = _frames(chosen, options, derived)
        chordae = _chordae(chosen[0][0].chords, frames[0], derived)
        std, known = options.std_mm, {"correlation_length_mm": CORRELATED_MM}
        document = {
            "name": "valve from SlicerHeart",  # names of files and scenes may identify patients
            "source": "SlicerHeart",
            **({} if std is None else {"observation": {"std_mm": std, **known}}),
            "derived": derived,
        }
        if options.thickness_mm is not None:
            document["thickness"] = dict(zip(REGIONS, options.thickness_mm, strict=True))
        return case_of_frames(frames, document, chordae, mirrored=options.mirrored)


def _chosen(source: Path, options: SlicerheartOptions, derived: list[str]) -> list[_Seen]:
    """The phases to import, in time order."""
    by_phase = read_folder(source, options.scene, options.only)
    closed = options.closed
    if closed is not None and Path(closed).is_dir():
        others = read_folder(Path(closed), options.scene, options.only)
        if len(others) > 1:
            raise InputError(f"closed={closed}: {len(others)} phases, expected one")
        ((name, seen),) = others.items()
        closed = name or "closed"
        by_phase[closed] = seen
    listed = ", ".join(by_phase) or "one without a name"
    for name, phase in (("open", options.open), ("closed", closed)):
        if phase is not None and phase not in by_phase:
            raise InputError(f"{name}={phase}: no such phase, there are {listed}")
    opened = options.open or next((p for p in (*OPEN, "") if p in by_phase), None)
    if opened is None:
        raise InputError(f"no open phase ({', '.join(OPEN)}) among {listed}; give open=PHASE")
    closed = closed or next((p for p in CLOSED if p in by_phase and p != opened), None)
    roles = {opened: Role.REFERENCE}
    roles |= {p: Role.HELD_OUT for p in CLOSED if p in by_phase and p != opened}
    if closed is not None:
        roles[closed] = Role.CLOSED
    if left := [p for p in by_phase if p not in roles]:
        derived.append(f"phases {', '.join(left)} not used")
    order = sorted(roles, key=lambda p: (roles[p] is not Role.REFERENCE, TIMES.get(p, 0.6)))
    return [(by_phase[p], roles[p]) for p in order]


def _frames(
    chosen: Sequence[_Seen], options: SlicerheartOptions, derived: list[str]
) -> list[FoundFrame]:
    """The frames with joined leaflets, in time order."""
    frames: list[FoundFrame] = []
    pressure = GENERIC_PRESSURE if options.pressure_mmHg is None else options.pressure_mmHg
    offset, seams = options.offset_mm, None
    if not options.midsurface:
        shift = "the assumed one" if offset is None else "{:g} and {:g} mm".format(*offset)
        derived.append(
            f"midsurface: the atrial surfaces moved to the ventricle by half the thickness ({shift}"
            "); edges that curl by over 30 degrees left out"
        )
    for seen, role in chosen:
        label = seen.phase or ("closed" if role is Role.CLOSED else "open")
        notes = list(seen.notes)
        with named(label):
            tips = _tips_of(seen, role, options, frames, notes)
            leaflets, commissures, down = _placed(seen, tips, options.mirrored, notes)
            # Closed edges touch all along, so they are joined as far as the open ones.
            surface, seams, gap = joined(
                leaflets, commissures, seen.contour, down, offset_mm=offset, seams=seams
            )
        shares = ", ".join(f"{100 * share:.0f}" for share in seams.ravel())
        notes.append(
            f"leaflets joined at the commissures over {shares} % of their free edges, across at "
            f"most {gap:.1f} mm"
        )
        derived += [f"{label}: {note}" for note in notes]
        at, load = 0.0, 0.0
        if role is not Role.REFERENCE:
            at, load = max(frames[-1].time + 0.01, TIMES.get(seen.phase, 0.6)), pressure
        name = PHASES.get(seen.phase, label)
        frames.append(FoundFrame(name, role, at, load, surface, tips))
    derived.append(f"surfaces remeshed with edges of about {EDGE_MM:g} mm")
    if len(frames) > 1:
        derived.append("times: by the order of the phases in a generic cardiac cycle")
        if options.pressure_mmHg is None:
            derived.append(
                f"pressure: {pressure:g} mmHg on the closed valve assumed, none on the open one; "
                "pressure_mmHg=... states it"
            )
    return frames


def _tips_of(
    seen: SeenPhase,
    role: Role,
    options: SlicerheartOptions,
    before: Sequence[FoundFrame],
    notes: list[str],
) -> FloatArray:
    """Papillary tips ``(t, 3)`` mm of a phase, two unless they are where chords begin."""
    if role is Role.REFERENCE and options.tips is not None:
        return np.array(options.tips, dtype=np.float64).reshape(2, 3)
    if seen.tips is None and len(begin := beginnings(seen.chords)) > 1:
        notes.append(f"{len(begin)} papillary tips where chords begin")
        middles = [np.concatenate([x for x, _ in own]).mean(axis=0) for own in seen.leaflets]
        down = begin.mean(axis=0) - np.mean(middles, axis=0)
        # Seen from the atrium, the antero-lateral one is on the left of the anterior leaflet.
        left = np.cross(middles[0] - middles[1], down)
        return begin[np.argsort(-begin @ left)]
    if seen.tips is None and before:
        notes.append(f"papillary tips of {before[0].name}")
        return before[0].tips
    if seen.tips is None:
        raise InputError(
            "no papillary tips (lists of points PapillaryMarkup-antero-lateral and -postero-medial"
            ", with base, tip and insertion); give tips=[x,y,z,x,y,z] in LPS mm"
        )
    return seen.tips


def _chordae(segments: FloatArray, reference: FoundFrame, derived: list[str]) -> Chordae | None:
    """The exported chordae; None without any."""
    if not len(segments):
        return None
    surface = reference.surface
    edge = find_loops(surface.vertices, surface.triangles, reference.tips).free_edge
    chordae = chordae_of_lines(segments, reference.tips, surface.vertices[edge])
    derived.append(
        f"chordae: {len(chordae.insertion)} leaflet ends and {len(chordae.junction)} branching "
        "points of the export, as long as drawn; those within "
        f"{MARGINAL_MM:g} mm of the free edge are marginal; as stiff together as the template's"
    )
    return chordae


def _placed(
    seen: SeenPhase, tips: FloatArray, mirrored: bool, notes: list[str]
) -> tuple[list[Leaflet], FloatArray, FloatArray]:
    """Leaflets, commissures ``(2, 3)`` mm, and the direction ``(3,)`` to the ventricle.

    The annulus must be close to the leaflets, and landmarks must not be mirrored.
    """
    leaflets, marks = [], seen.landmarks
    for name, segments in zip(REGIONS, seen.leaflets, strict=True):
        with named(f"{name} leaflet"):
            leaflets.append(united([Leaflet.of(*segment) for segment in segments]))
        if leaflets[-1].holes:
            notes.append(f"{name} leaflet: {leaflets[-1].holes} holes closed")
    edges = np.concatenate([leaflet.curve for leaflet in leaflets])
    down = tips.mean(axis=0) - edges.mean(axis=0)
    if seen.contour is not None:
        away, turned = (
            float(np.sqrt(np.mean(np.square(cKDTree(edges).query(seen.contour * axes)[0]))))
            for axes in (TO_LPS["LPS"], TO_LPS["RAS"])
        )
        if away > MAX_RMS:
            hint = (
                f" (with x and y turned it would be {turned:.1f} mm: one of them is in RAS where "
                "LPS is stated, or the other way round)"
            )
            raise InputError(
                f"the annulus lies {away:.1f} mm from the leaflets, expected at most {MAX_RMS:g} mm"
                f"{hint if turned < MAX_RMS else ''}"
            )
    for left, right in (("ALC", "PMC"), ("AL", "PM")):
        if not mirrored and {"A", "P", left, right} <= set(marks):
            to_left, to_front = marks[left] - marks[right], marks["A"] - marks["P"]
            check_sides(f"landmark {left}", to_left, to_front, down)
    if {"ALC", "PMC"} <= set(marks):
        commissures = np.stack([marks["ALC"], marks["PMC"]])
    elif seen.contour is not None:
        commissures = commissures_on(seen.contour, leaflets)
        notes.append("commissures where the leaflet nearer to the annulus changes")
    else:
        raise InputError(
            "neither the landmarks ALC and PMC nor the annulus; export ValveLandmarkPoints.csv or "
            "AnnulusContourPoints.csv"
        )
    return leaflets, commissures, down


# -- chordae --------------------------------------------------------------------------------------
# Line segments, as ValveFemExport writes them. Every segment has two points of its own and runs
# from a papillary tip to the leaflets: a trunk to its branching point, branches from there (a fan
# at the free edge, radial ones on the body of a leaflet).
def _graph(segments: FloatArray) -> tuple[FloatArray, IntArray]:
    """Points ``(n, 3)`` mm, and the first and last point ``(k, 2)`` of the different segments."""
    points = segments.reshape(-1, 3)
    rounded = np.round(points, DECIMALS)
    _, first, number = np.unique(rounded, axis=0, return_index=True, return_inverse=True)
    pairs = np.unique(number.reshape(-1, 2), axis=0)
    return points[first], pairs[pairs[:, 0] != pairs[:, 1]]


def beginnings(segments: FloatArray) -> FloatArray:
    """The points ``(t, 3)`` mm at which chords begin.

    None if there are as many as segments: these then run from the leaflets, or are single chords
    whose tips are unknown.
    """
    points, pairs = _graph(segments)
    roots = np.setdiff1d(pairs[:, 0], pairs[:, 1])
    return points[roots] if len(roots) < len(pairs) else points[:0]


def chordae_of_lines(segments: FloatArray, tips: FloatArray, free_edge: FloatArray) -> Chordae:
    """Chordae of segments ``(k, 2, 3)`` mm, with papillary tips ``(t, 3)`` and edge ``(e, 3)``.

    They are as long as they are drawn. Chords within `MARGINAL_MM` of the edge are marginal, others
    basal. Each family is as stiff at the tips as that of the template, each of its leaflet ends has
    the same share, and a trunk is as stiff as its branches together.

    InputError if chords begin elsewhere than at the tips, meet, or form a cycle.
    """
    points, pairs = _graph(segments)
    branches = np.isin(pairs[:, 1], pairs[:, 0])
    # Leaflet ends first, then branching points in the order of their numbers.
    begin, end = pairs[np.lexsort([pairs[:, 1], branches])].T
    c = int(np.count_nonzero(~branches))
    junction, count = np.unique(end[c:], return_counts=True)
    if np.any(count > 1):
        at = np.round(points[junction[np.argmax(count)]], 1).tolist()
        raise InputError(f"{count.max()} chords meet at {at}, where others begin; expected one")
    parent = np.where(np.isin(begin, junction), np.searchsorted(junction, begin), -1)
    on = paths(parent, c)
    root = np.argmax(on & (parent < 0), axis=1)
    away, tip = map(np.asarray, cKDTree(tips).query(points[begin[root]]))
    if away.max() > MAX_AWAY:
        raise InputError(
            f"chords begin up to {away.max():.1f} mm from the papillary tips, expected at most "
            f"{MAX_AWAY:g} mm"
        )
    template = Template().chordae()
    at_tip = template.axial_stiffness * (template.parent < 0)
    marginal = template.family == template.family_names.index(FAMILIES[0])
    inwards = np.asarray(cKDTree(free_edge).query(points[end[:c]])[0])
    family = (inwards > MARGINAL_MM).astype(np.int64)
    total = np.array([at_tip[marginal].sum(), at_tip[~marginal].sum()])
    stiffness = (total / np.maximum(np.bincount(family, minlength=2), 1))[family]
    beyond = on[:c].T  # leaflet ends (columns) of each segment
    return Chordae(
        tip=tip,
        insertion=points[end[:c]],
        family=1 - np.any(beyond & (family == 0), axis=1),
        family_names=FAMILIES,
        rest_length=np.linalg.norm(points[end] - points[begin], axis=1),
        axial_stiffness=beyond @ stiffness,
        toe_strain=template.toe_strain,
        junction=points[junction],
        parent=parent,
    )
