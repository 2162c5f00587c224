"""SlicerHeart: leaflets, annulus, landmarks and papillary muscles of its export modules."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from mvest.cases.band import two_loops
from mvest.cases.case import Role, ValveCase
from mvest.cases.tissue import FAMILIES, GENERIC_THICKNESS
from mvest.errors import InputError
from mvest.exchange.importing.joining import REGIONS, Leaflet, commissures_on, joined
from mvest.exchange.importing.slicerheart_folder import PHASES, SeenPhase, read_folder
from mvest.exchange.importing.written import FoundFrame, case_of_frames, check_options
from mvest.exchange.markups import TO_LPS
from mvest.reading.text import named
from mvest.typing import FloatArray
from mvest.valve.anatomy.dimensions import ChordLayout

OPEN, CLOSED = ("MD", "ED", "CD"), ("MS", "ES", "CS")
"""Phases in the order in which they are preferred."""
TIMES = {"MS": 0.3, "CS": 0.4, "ES": 0.5}
"""s after the open phase, in the order of a cardiac cycle."""
GENERIC_PRESSURE = 110.0
"""mmHg on the closed valve: ventricle less atrium from mid to end of systole."""
CORRELATED_MM = 10.0
"""Along the leaflets, over which errors of a segmentation are correlated."""
MAX_RMS = 4.0
"""mm between the annulus and the leaflets' edges, beyond which they are not of one valve."""
MARGINAL_MM = 4.0
"""From the free edge, within which a chord inserts as marginal ones do."""
MAX_AWAY = 3.0
"""mm from where a chord begins to its papillary tip."""

_Seen: TypeAlias = tuple[SeenPhase, Role]


@dataclass(frozen=True, slots=True)
class SlicerheartOptions:
    """What a folder of SlicerHeart does not say.

    Attributes
    ----------
    scene : str or None
        Whose files are taken where a folder holds those of several.
    only : str or None
        What the names of surfaces must hold, where there are several of one leaflet.
    open, closed : str or None
        Phase (MD, ED, MS, ES, ...) of the reference and of the closed frame; MD, ED, CD and MS,
        ES, CS in this order if not given. For folders of ValveFemExport, which name no phase,
        ``closed`` is the folder with the closed valve.
    tips, tips_closed : tuple of float or None
        Papillary tips, antero-lateral and postero-medial: six numbers, LPS mm; ``tips_closed``
        those of the closed frame where it has others.
    pressure_mmHg : float or None
        Transmitral pressure on the closed valve; 110 mmHg assumed.
    thickness_mm : tuple of float or None
        Of the anterior and the posterior leaflet; generic values if not given.
    midsurface : bool
        Whether the surfaces are midsurfaces already; those of ValveBatchExport are atrial ones, and
        are moved to the ventricle by half the thickness, as those of ValveFemExport are, whose
        shells follow the side that is met first.
    edge_mm : float
        Of the triangles of the case.
    seam_mm : float
        Up to which distance the leaflets are joined where they part at a commissure.
    std_mm : float or None
        Standard deviation of a coordinate of the surfaces; 1 mm assumed.
    mirrored : bool
        Take the valve although its landmarks lie as in a mirror.
    """

    scene: str | None = None
    only: str | None = None
    open: str | None = None
    closed: str | None = None
    tips: tuple[float, ...] | None = None
    tips_closed: tuple[float, ...] | None = None
    pressure_mmHg: float | None = None
    thickness_mm: tuple[float, ...] | None = None
    midsurface: bool = False
    edge_mm: float = 1.0
    seam_mm: float = 1.5
    std_mm: float | None = None
    mirrored: bool = False

    def __post_init__(self) -> None:
        counts = {"tips": 6, "tips_closed": 6, "thickness_mm": 2}
        check_options(self, counts, {"edge_mm": (0.3, 5.0), "seam_mm": (0.0, 10.0)})

    @property
    def thickness(self) -> tuple[float, ...]:
        """Of the anterior and the posterior leaflet (mm), stated or generic."""
        return self.thickness_mm or tuple(GENERIC_THICKNESS[name] for name in REGIONS)


def import_slicerheart(source: Path, options: SlicerheartOptions) -> ValveCase:
    """A case of a folder that SlicerHeart's ValveBatchExport or ValveFemExport wrote.

    An open phase becomes the reference, a closed one the closed frame, another closed one is held
    out. Leaflets, which are separate surfaces there, are joined along the commissures.

    Parameters
    ----------
    source
        The folder of one scene, with ``*_atrial_*.vtk`` and, if they were exported,
        ``AnnulusContourPoints.csv``, ``ValveLandmarkPoints.csv`` and ``*_landmarks.fcsv``;
        papillary muscles are lists of points whose file names say so (``PapillaryMarkup-...``).
    options

    Raises
    ------
    InputError, GeometryError
        What is missing, by the name of its option; damaged files, axes that contradict each other.
    """
    if not source.is_dir():
        raise InputError(f"{source}: no such folder; expected one that SlicerHeart wrote")
    derived: list[str] = []
    with named(source):
        chosen = _chosen(source, options, derived)
        frames = _frames(chosen, options, derived)
        chordae = _chordae(chosen[0][0], frames[0], derived)
        std, known = options.std_mm, {"correlation_length_mm": CORRELATED_MM}
        document = {
            "name": "valve from SlicerHeart",  # names of files and scenes may be those of patients
            "source": "SlicerHeart",
            "regions": list(REGIONS),
            "thickness": dict(zip(REGIONS, map(float, options.thickness), strict=True)),
            **({} if std is None else {"observation": {"std_mm": std, **known}}),
            "derived": derived,
        }
        return case_of_frames(frames, document, chordae)


def _chosen(source: Path, options: SlicerheartOptions, derived: list[str]) -> list[_Seen]:
    """The phases that are taken, in the order of time."""
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
        derived.append(f"phases {', '.join(left)} not taken")
    order = sorted(roles, key=lambda p: (roles[p] is not Role.REFERENCE, TIMES.get(p, 0.6)))
    return [(by_phase[p], roles[p]) for p in order]


def _frames(
    chosen: Sequence[_Seen], options: SlicerheartOptions, derived: list[str]
) -> list[FoundFrame]:
    """The frames with their leaflets made one, in the order of time."""
    frames: list[FoundFrame] = []
    pressure = GENERIC_PRESSURE if options.pressure_mmHg is None else options.pressure_mmHg
    offset, seams = (0.0, 0.0), None
    if options.thickness_mm is None:
        derived.append(
            "thickness: {} mm (anterior), {} mm (posterior) assumed; thickness_mm=[...] states it"
            "".format(*options.thickness)
        )
    if not options.midsurface:
        offset = (options.thickness[0] / 2, options.thickness[1] / 2)
        derived.append(
            "midsurface: the atrial surfaces moved to the ventricle by half the thickness "
            f"({offset[0]:g} and {offset[1]:g} mm); edges that curl by over 30 degrees left out"
        )
    for seen, role in chosen:
        label = seen.phase or ("closed" if role is Role.CLOSED else "open")
        notes = list(seen.notes)
        with named(label):
            tips = _tips_of(seen, role, options, frames, notes)
            leaflets, commissures, down = _placed(seen, tips, options.mirrored, notes)
            # The closed edges lie side by side all along: joined as far as the open ones.
            surface, seams, gap = joined(
                leaflets,
                commissures,
                seen.contour,
                down,
                seam_mm=options.seam_mm,
                edge_mm=options.edge_mm,
                offset_mm=offset,
                seams=seams,
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
    derived.append(
        f"surfaces drawn anew on the lines of their coordinates, edges about {options.edge_mm:g} mm"
    )
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
    """Papillary tips ``(t, 3)`` mm of a phase, in the order of those of the first frame."""
    given = {Role.REFERENCE: options.tips, Role.CLOSED: options.tips_closed}.get(role)
    if given is not None:
        return np.array(given, dtype=np.float64).reshape(2, 3)
    if seen.tips is None and before:
        notes.append(f"papillary tips where they are in {before[0].name}")
        return before[0].tips
    if seen.tips is None:
        raise InputError(
            "no papillary tips (lists of points PapillaryMarkup-antero-lateral and -postero-medial"
            ", with base, tip and insertion); give tips=[x,y,z,x,y,z] in LPS mm"
        )
    if before and len(seen.tips) == len(before[0].tips):
        return seen.tips[linear_sum_assignment(cdist(before[0].tips, seen.tips))[1]]
    return seen.tips


def _placed(
    seen: SeenPhase, tips: FloatArray, mirrored: bool, notes: list[str]
) -> tuple[list[Leaflet], FloatArray, FloatArray]:
    """Leaflets, commissures ``(2, 3)`` mm, and the direction ``(3,)`` to the ventricle."""
    leaflets = []
    for name, (vertices, triangles) in zip(REGIONS, seen.leaflets, strict=True):
        with named(f"{name} leaflet"):
            leaflets.append(Leaflet.of(vertices, triangles))
        if leaflets[-1].holes:
            notes.append(f"{name} leaflet: {leaflets[-1].holes} holes closed")
    edges = np.concatenate([leaflet.curve for leaflet in leaflets])
    down = tips.mean(axis=0) - edges.mean(axis=0)
    _check_axes(seen, edges, down, mirrored)
    if {"ALC", "PMC"} <= set(seen.landmarks):
        commissures = np.stack([seen.landmarks["ALC"], seen.landmarks["PMC"]])
    elif seen.contour is not None:
        commissures = commissures_on(seen.contour, leaflets)
        notes.append("commissures where the leaflet nearer to the annulus changes")
    else:
        raise InputError(
            "neither the landmarks ALC and PMC nor the annulus; export ValveLandmarkPoints.csv or "
            "AnnulusContourPoints.csv"
        )
    return leaflets, commissures, down


def _check_axes(seen: SeenPhase, edges: FloatArray, down: FloatArray, mirrored: bool) -> None:
    """Raise where tables and surfaces have other axes, or the valve is its own mirror image."""
    if seen.contour is not None and (away := _rms(seen.contour, edges)) > MAX_RMS:
        other = _rms(seen.contour * TO_LPS["RAS"], edges)
        hint = (
            f" (with x and y turned it would be {other:.1f} mm: one of them is in RAS where LPS is "
            "stated, or the other way round)"
        )
        raise InputError(
            f"the annulus lies {away:.1f} mm from the leaflets, expected at most {MAX_RMS:g} mm"
            f"{hint if other < MAX_RMS else ''}"
        )
    marks = seen.landmarks
    for left, right in (("ALC", "PMC"), ("AL", "PM")):
        if not mirrored and {"A", "P", left, right} <= set(marks):
            sides = np.stack([marks[left] - marks[right], marks["A"] - marks["P"], down])
            # From the atrium the antero-lateral commissure is on the left of the anterior leaflet.
            if np.linalg.det(sides) < 0:
                raise InputError(
                    f"the landmarks A, P, {left} and {right} lie as in a mirror: from the atrium "
                    f"{left} is on the right; is one axis turned? (mirrored=true takes it so)"
                )


def _rms(points: FloatArray, edges: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(cKDTree(edges).query(points)[0]))))


def _chordae(
    seen: SeenPhase, reference: FoundFrame, derived: list[str]
) -> list[tuple[object, ...]]:
    """Rows of the table of chordae; none if the export has none.

    Raises
    ------
    InputError
        Chords begin elsewhere than at the tips.
    """
    if not len(seen.chords):
        return []
    reach = cdist(seen.chords[:, 0], reference.tips)
    if (away := reach.min(axis=1).max()) > MAX_AWAY:
        raise InputError(
            f"chords begin up to {away:.1f} mm from the papillary tips, expected {MAX_AWAY:g} mm"
        )
    vertices, insertion = reference.surface.vertices, seen.chords[:, 1]
    loops = [vertices[loop] for loop in two_loops(vertices, reference.surface.triangles)]
    edge = min(loops, key=lambda curve: _rms(curve, reference.tips))
    basal = np.where(cKDTree(edge).query(insertion)[0] > MARGINAL_MM, 1, 0)
    # As stiff together as the template's, of which there may be fewer.
    template, count = ChordLayout(), np.bincount(basal, minlength=2)
    marginal = len(template.marginal_phi) * template.marginal_stiffness
    both = np.array([marginal, len(template.basal) * template.basal_stiffness])
    stiffness = 2 * both / np.maximum(count, 1)
    derived.append(
        f"chordae: {len(basal)} of the export, as long as there; the {count[0]} within "
        f"{MARGINAL_MM:g} mm of the free edge are marginal; as stiff together as the template's"
    )
    names = np.array(FAMILIES)[basal]
    columns = (reach.argmin(axis=1), *insertion.T, names, seen.chord_lengths, stiffness[basal])
    return list(zip(*(column.tolist() for column in columns), strict=True))
