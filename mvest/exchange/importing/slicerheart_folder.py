"""SlicerHeart folders: the words in a file's name identify its content.

ValveBatchExport begins every name with ``SCENE_VALVE_frame_N_PHASE`` (``ValveBatchExportRules/
base.py``). The rest has changed: leaflet surfaces were ``mitral_anterior_leaflet`` in April 2026,
and ``atrial_mitral_anterior_leaflet`` from August 2026, when the old name was given to closed
surfaces of segments. ValveFemExport, and models saved by hand, name neither scene nor phase. Models
use the axes that they name (``SPACE=LPS``), or RAS as before Slicer 4.11. Tables use RAS with the
same origin. Here everything is LPS in mm.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import numpy as np

from mvest.errors import InputError
from mvest.exchange.importing.leaflet_parts import SCALLOPS, WORDS
from mvest.exchange.importing.written import REGIONS
from mvest.exchange.markups import TO_LPS, PointList, read_markups
from mvest.exchange.surfaces import SURFACE_SUFFIXES, read_mesh, read_surface
from mvest.reading.text import numbers, one_line, read_columns
from mvest.typing import FloatArray, IntArray

PHASES = {
    "MD": "mid-diastole",
    "ED": "end-diastole",
    "MS": "mid-systole",
    "ES": "end-systole",
    "CD": "custom-diastolic",
    "CS": "custom-systolic",
    "CT": "custom-transition",
    "UN": "unknown",
    **{f"P{k}": f"custom{k}" for k in range(1, 5)},
}
"""Phases, by their abbreviation in file names and tables (``HeartValveLib/Constants.py``)."""
_NAME = re.compile(
    r"(?P<scene>.+?)_(?P<valve>mitral|tricuspid|aortic|pulmonary|cavc|lavv|unknown|\S+ \w+ valve)"
    rf"(?:_frame_(?P<frame>\d{{1,6}}))?_(?P<phase>{'|'.join(PHASES)})(?:_(?P<again>\d+))?"
    r"(?:_(?P<rest>.+))?"
)
_PHASE = re.compile(r"(?:.*[^A-Za-z0-9])?(?P<phase>[MEC][DS])(?:[^A-Za-z0-9].*)?")
"""Phases in other names, where CT is a modality and P1 a scallop."""
MUSCLES = (
    ({"antero", "lateral"}, {"anterolateral"}, {"al"}),
    ({"postero", "medial"}, {"posteromedial"}, {"pm"}),
)
"""Words for the papillary muscles, in the order of a case's tips."""
PAPILLARY = {"papillary", "muscle", "muscles", "tip", "tips"}
ANNULUS, MARKS = {"annulus"}, {"landmarks", "labels"}
CHORDS = {"chords", "chordae"}
NO_LEAFLET = PAPILLARY | ANNULUS | CHORDS | {"ventricular"}
LANDMARKS = ("A", "P", "AL", "PM", "ALC", "PMC")
_COMMON = ("Filename", "Phase", "FrameNumber", "Valve")
_TABLES = {
    "AnnulusContourPoints.csv": ("AnnulusContourLabel", [f"AnnulusContour{k}" for k in "XYZ"]),
    "ValveLandmarkPoints.csv": ("LandmarkLabel", [f"Landmark{k}" for k in "RAS"]),
}
MIN_CONTOUR = 8
"""Smallest number of annulus points."""
MAX_FILES = 20_000


def words_of(name: str) -> set[str]:
    """Lower-case words of a name, also in camel case (``AnnulusContour``)."""
    return {word.lower() for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+", name)}


class _File:
    """A file with the words of its name, and the groups of `_NAME` (empty if it does not match)."""

    def __init__(self, path: Path) -> None:
        self.path = path
        stem = path.name.removesuffix(".json").rpartition(".")[0]
        match = _NAME.fullmatch(stem) or _PHASE.fullmatch(stem)
        found = {key: value or "" for key, value in match.groupdict().items()} if match else {}
        self.scene, self.valve, self.frame, self.phase, self.again = (
            found.get(key, "") for key in ("scene", "valve", "frame", "phase", "again")
        )
        self.words = words_of(found.get("rest", stem))
        # A scallop is one word here, as in "P2" or "posterior leaflet P2".
        self.segment = set(re.findall(r"[a-z]+\d*", found.get("rest", stem).lower())) & SCALLOPS
        named = [name for name, words in WORDS.items() if words & (self.words | self.segment)]
        self.leaflet = "" if len(named) != 1 or self.words & NO_LEAFLET else named[0]

    def fits(self, other: _File) -> bool:
        """Whether its name agrees with the scene, frame and phase of a surface."""
        pairs = ((self.scene, other.scene), (self.frame, other.frame))
        named = self.valve.lower() in ("", "mitral") and self.phase in ("", other.phase)
        return named and all(a == b or not a or not b for a, b in pairs)


@dataclass(frozen=True, slots=True, eq=False)
class SeenPhase:
    """One valve in one phase; ``notes`` lists assumptions and unused data."""

    phase: str  # key of `PHASES`; empty if the export names none
    #: segments of the anterior and of the posterior leaflet: (n, 3) mm, (m, 3)
    leaflets: tuple[tuple[tuple[FloatArray, IntArray], ...], ...]
    contour: FloatArray | None  # (k, 3) mm, closed curve along the annulus
    landmarks: dict[str, FloatArray]  # (3,) mm by label, of `LANDMARKS`
    tips: FloatArray | None  # (2, 3) mm, antero-lateral and postero-medial
    chords: FloatArray  # (k, 2, 3) mm, segments from the tips to the leaflets
    notes: tuple[str, ...]


def read_folder(
    folder: Path, scene: str | None = None, only: str | None = None
) -> dict[str, SeenPhase]:
    """All phases of one scene's mitral valve, by abbreviation or an empty name.

    ``scene`` selects one of several scenes; ``only`` is a word in file names that selects one of
    several surfaces of a leaflet.

    InputError or GeometryError if there are no mitral leaflets, several scenes, or several surfaces
    of one leaflet, or a file is damaged.
    """
    paths = sorted(islice(folder.rglob("*"), MAX_FILES + 1))
    if len(paths) > MAX_FILES:
        raise InputError(f"{folder}: more than {MAX_FILES} files; name one scene's folder")
    models, lists = (
        [_File(path) for path in paths if path.name.lower().endswith(ends) and path.is_file()]
        for ends in (SURFACE_SUFFIXES, (".fcsv", ".mrk.json"))
    )
    above = [f for f in models if f.path.parent == folder]
    models = above if any(f.leaflet for f in above) else models
    leaflets = [f for f in models if f.leaflet and (only or "").lower() in f.path.name.lower()]
    scenes = sorted({f.scene for f in leaflets} - {""})
    chosen = [f for f in leaflets if scene in (None, f.scene) and f.valve.lower() in ("mitral", "")]
    if not chosen:
        found = one_line(", ".join(f.path.name for f in leaflets or models) or "no models", 150)
        raise InputError(
            f"{folder}: no surfaces of mitral leaflets, named anterior and posterior (or AML, PML)"
            f"{'' if scene is None else f', of scene {scene!r}'}; found {found}"
        )
    if len(scenes) > 1 and scene is None:
        raise InputError(
            f"{folder}: {len(scenes)} scenes ({', '.join(scenes[:5])}); give scene=NAME"
        )
    phases = [phase for phase in PHASES if any(f.phase == phase for f in chosen)]
    seen = {
        phase: _read_phase(folder, [f for f in chosen if f.phase == phase], models, lists)
        for phase in phases or [""]
    }
    if phases and not all(f.phase for f in chosen):
        first = seen[phases[0]]
        notes = (*first.notes, "surfaces that name no phase not used")
        seen[phases[0]] = replace(first, notes=notes)
    return seen


def _read_phase(
    folder: Path, mine: Sequence[_File], models: Sequence[_File], lists: Sequence[_File]
) -> SeenPhase:
    """Read one phase from its leaflet surfaces."""
    notes: list[str] = []
    this = min(mine, key=lambda f: int(f.frame or -1))
    if len(frames := sorted({f.frame for f in mine})) > 1:
        notes.append(f"frame {this.frame} taken of frames {', '.join(frames)} of this phase")
    mine = [f for f in mine if f.frame == this.frame]
    surfaces = tuple(_leaflet(folder, mine, name, notes) for name in REGIONS)
    places = (this.path.parent, folder, folder.parent)
    labels, contour = _table("AnnulusContourPoints.csv", places, this)
    names, points = _table("ValveLandmarkPoints.csv", places, this)
    landmarks = dict(zip((*labels, *names), (*contour, *points), strict=True))
    curves = [contour]
    tips: dict[int, FloatArray] = {}
    # Lists that name this phase come last and override those that name none.
    for file in sorted((f for f in lists if f.fits(this)), key=lambda f: bool(f.phase)):
        for name, item in read_markups(file.path).items():
            words = file.words | words_of(name)
            found = _tips_in(file.path, words, item) if words & PAPILLARY else {}
            used = bool(found)
            tips |= found
            if found and this.phase and not file.phase:
                notes.append("papillary tips of a file that names no phase")
            if item.kind in ("Curve", "ClosedCurve") and words & ANNULUS:
                curves, used = [*curves, item.points], True
            if item.kind == "Fiducial" and words & MARKS:
                landmarks |= zip(item.labels, item.points, strict=True)
                used = True
            if not used and item.labels:
                listed = ", ".join(item.labels)
                notes.append(f"{item.kind} of {len(item.labels)} points ({listed}) not used")
            if item.unplaced:
                notes.append(f"points {', '.join(item.unplaced)} not placed, so not used")
    chords = [np.zeros((0, 2, 3))]
    for file in (f for f in models if f.words & CHORDS and f.phase == this.phase and f.fits(this)):
        drawn = read_mesh(file.path)
        chords.append((drawn.vertices * TO_LPS[drawn.space or "RAS"])[drawn.lines])
    known = {label.strip().upper(): point for label, point in landmarks.items()}
    if unused := known.keys() - {"", *LANDMARKS}:
        notes.append(f"landmarks {', '.join(sorted(unused))} not used")
    return SeenPhase(
        this.phase,
        surfaces,
        next((curve for curve in curves if len(curve) >= MIN_CONTOUR), None),
        {label: known[label] for label in LANDMARKS if label in known},
        np.stack([tips[k] for k in range(2)]) if len(tips) == 2 else None,
        np.concatenate(chords),
        tuple(dict.fromkeys(one_line(note) for note in notes)),
    )


def _leaflet(
    folder: Path, files: Sequence[_File], name: str, notes: list[str]
) -> tuple[tuple[FloatArray, IntArray], ...]:
    """The segments of a leaflet, mostly one; atrial sides and fitted shells come first."""
    fitting = [f for f in files if f.leaflet == name]
    for better in ("atrial", "fit"):
        fitting = [f for f in fitting if better in f.words] or fitting
    # Further valve models of a frame have a number after the phase.
    fitting = [f for f in fitting if not f.again] or fitting
    segments = [f.segment - {"scallop"} or (f.segment and {f.path.stem}) for f in fitting]
    apart = all(segments) and len(set().union(*segments)) == sum(map(len, segments))
    if len(fitting) != 1 and not (fitting and apart):
        listed = one_line(", ".join(f.path.name for f in fitting or files), 150)
        raise InputError(
            f"{folder}: {len(fitting)} surfaces of the {name} leaflet ({listed}), expected one, or "
            "one of each scallop (P1, P2, ...); only=WORD takes those with a word in their names"
        )
    if apart:
        listed = ", ".join(sorted(segment.upper() for own in segments for segment in own))
        notes.append(f"{name} leaflet: {listed}")
    surfaces = [read_surface(f.path) for f in fitting]
    if any(surface.space is None for surface in surfaces):
        notes.append("a surface names no axes in its header, so R, A, S are assumed")
    return tuple((s.vertices * TO_LPS[s.space or "RAS"], s.triangles) for s in surfaces)


def _table(name: str, places: Sequence[Path], this: _File) -> tuple[list[str], FloatArray]:
    """Labels and positions ``(r, 3)`` mm of one frame, from the first folder with the table."""
    label, position = _TABLES[name]
    file = next((place / name for place in places if (place / name).is_file()), None)
    if file is None:
        return [], np.zeros((0, 3))
    columns = read_columns(file, (*_COMMON, label, *position))
    wanted = (("Filename", this.scene), ("Phase", this.phase), ("FrameNumber", this.frame))
    rows = [
        k
        for k, valve in enumerate(columns["Valve"])
        if valve.lower() == "mitral" and all(columns[key][k] == v for key, v in wanted if v)
    ]
    cells = [numbers(file, axis, [columns[axis][k] for k in rows]) for axis in position]
    points = np.column_stack(cells).reshape(-1, 3) * TO_LPS["RAS"]
    return [columns[label][k] for k in rows], points


def _muscle(words: set[str]) -> int | None:
    """Index of the papillary muscle that the words name, if any."""
    found = [k for k, names in enumerate(MUSCLES) if any(name <= words for name in names)]
    return found[0] if len(found) == 1 else None


def _tips_in(file: Path, words: set[str], item: PointList) -> dict[int, FloatArray]:
    """Tips by muscle, from the list of one muscle or from points labelled by muscle.

    The list of one muscle has base, tip and insertion (``PAPILLARY_MUSCLE_POINT_LABELS``).
    """
    muscle = _muscle(words)
    if muscle is None:
        which = [(_muscle(words_of(label)), k) for k, label in enumerate(item.labels)]
        return {m: item.points[k] for m, k in which if m is not None}
    tip = [k for k, label in enumerate(item.labels) if "tip" in label.lower()]
    if not tip and len(item.points) < 2:
        raise InputError(
            f"{file}: {len(item.points)} points of a papillary muscle, expected base, tip and "
            "insertion"
        )
    return {muscle: item.points[tip[0] if tip else 1]}
