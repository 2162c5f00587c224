"""Folders of SlicerHeart: what each file is, by the words of its name.

ValveBatchExport begins every name with ``SCENE_VALVE_frame_N_PHASE`` (``ValveBatchExportRules/
base.py``). What follows changed over the months: leaflet surfaces were ``mitral_anterior_leaflet``
from April 2026, ``atrial_mitral_anterior_leaflet`` from August 2026, when the former became the
name of closed surfaces of segments. ValveFemExport, and people who save models one by one, name
neither scene nor phase. Models are in the axes that they name (``SPACE=LPS``; without it RAS, as
before Slicer 4.11), tables in R, A, S of the same origin. Everything is LPS in mm here.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from mvest.errors import GeometryError, InputError
from mvest.exchange.markups import TO_LPS, PointList, read_markups
from mvest.exchange.surfaces import SURFACE_SUFFIXES, Surface, read_mesh
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
"""Names of the phases by what file names and tables call them (``HeartValveLib/Constants.py``)."""
_NAME = re.compile(
    r"(?P<scene>.+?)_(?P<valve>mitral|tricuspid|aortic|pulmonary|cavc|lavv|unknown|\S+ \w+ valve)"
    rf"(?:_frame_(?P<frame>\d{{1,6}}))?_(?P<phase>{'|'.join(PHASES)})(?:_(?P<again>\d+))?"
    r"(?:_(?P<rest>.+))?"
)
_PHASE = re.compile(r"(?:.*[^A-Za-z0-9])?(?P<phase>[MEC][DS])(?:[^A-Za-z0-9].*)?")
"""In names of other kinds, where CT is a modality and P1 a scallop."""
LEAFLETS = {"anterior": {"anterior", "aml", "amvl"}, "posterior": {"posterior", "pml", "pmvl"}}
MUSCLES = (
    ({"antero", "lateral"}, {"anterolateral"}, {"al"}),
    ({"postero", "medial"}, {"posteromedial"}, {"pm"}),
)
"""Words of the two papillary muscles, in the order of a case's tips."""
PAPILLARY = {"papillary", "muscle", "muscles", "tip", "tips"}
CHORDS, ANNULUS, MARKS = {"chords", "chordae"}, {"annulus"}, {"landmarks", "labels"}
NO_LEAFLET = PAPILLARY | CHORDS | ANNULUS | {"ventricular"}
LANDMARKS = ("A", "P", "AL", "PM", "ALC", "PMC")
_COMMON = ("Filename", "Phase", "FrameNumber", "Valve")
_TABLES = {
    "AnnulusContourPoints.csv": ("AnnulusContourLabel", [f"AnnulusContour{k}" for k in "XYZ"]),
    "ValveLandmarkPoints.csv": ("LandmarkLabel", [f"Landmark{k}" for k in "RAS"]),
}
MIN_CONTOUR = 8
"""Points of an annulus."""
MAX_FILES = 20_000


def words_of(name: str) -> set[str]:
    """Words of a name, also of one like ``AnnulusContour``, in lower case."""
    return {word.lower() for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+", name)}


class _File:
    """A file, the words of its name, and what `_NAME` finds in it; empty where it does not."""

    def __init__(self, path: Path) -> None:
        self.path = path
        stem = path.name.removesuffix(".json").rpartition(".")[0]
        match = _NAME.fullmatch(stem) or _PHASE.fullmatch(stem)
        found = {key: value or "" for key, value in match.groupdict().items()} if match else {}
        self.scene, self.valve, self.frame, self.phase, self.again = (
            found.get(key, "") for key in ("scene", "valve", "frame", "phase", "again")
        )
        self.words = words_of(found.get("rest", stem))
        named = [name for name, words in LEAFLETS.items() if words & self.words]
        self.leaflet = "" if len(named) != 1 or self.words & NO_LEAFLET else named[0]

    def fits(self, other: _File) -> bool:
        """Whether it is of the scene, the frame and the phase of a surface, as far as it says."""
        pairs = ((self.scene, other.scene), (self.frame, other.frame))
        named = self.valve.lower() in ("", "mitral") and self.phase in ("", other.phase)
        return named and all(a == b or not a or not b for a, b in pairs)


@dataclass(frozen=True, slots=True, eq=False)
class SeenPhase:
    """One valve in one phase.

    Attributes
    ----------
    phase : str
        Key of `PHASES`; empty where the export names none.
    leaflets
        Vertices ``(n, 3)`` mm and triangles ``(m, 3)``: anterior, posterior.
    contour
        ``(k, 3)`` mm, closed curve along the annulus, or None.
    landmarks
        ``(3,)`` mm by label, of `LANDMARKS`.
    tips
        ``(2, 3)`` mm, antero-lateral and postero-medial; or ``(t, 3)`` where chords begin, from
        left to right; or None.
    chords
        ``(c, 2, 3)`` mm, from where each begins to where it ends on a leaflet.
    chord_lengths
        ``(c,)`` mm along the lines.
    notes
        What was assumed in reading, and what was not used.
    """

    phase: str
    leaflets: tuple[tuple[FloatArray, IntArray], ...]
    contour: FloatArray | None
    landmarks: dict[str, FloatArray]
    tips: FloatArray | None
    chords: FloatArray
    chord_lengths: FloatArray
    notes: tuple[str, ...]


def read_folder(
    folder: Path, scene: str | None = None, only: str | None = None
) -> dict[str, SeenPhase]:
    """Every phase of the mitral valve of one scene by its name; ValveFemExport gives it none.

    Parameters
    ----------
    folder
    scene
        Whose files are taken where there are those of several.
    only
        What the names of surfaces must hold, where there are several of one leaflet.

    Raises
    ------
    InputError, GeometryError
        No leaflets of a mitral valve, several scenes, several surfaces of a leaflet, a damaged
        file.
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
    named = [phase for phase in PHASES if any(f.phase == phase for f in chosen)]
    seen = {
        phase: _read_phase(folder, [f for f in chosen if f.phase == phase], models, lists)
        for phase in named or [""]
    }
    if named and not all(f.phase for f in chosen):
        first = seen[named[0]]
        notes = (*first.notes, "surfaces that name no phase not used")
        seen[named[0]] = replace(first, notes=notes)
    return seen


def _read_phase(
    folder: Path, mine: Sequence[_File], models: Sequence[_File], lists: Sequence[_File]
) -> SeenPhase:
    """What there is of the phase that some surfaces of leaflets are of."""
    notes: list[str] = []
    this = min(mine, key=lambda f: int(f.frame or -1))
    if len(frames := sorted({f.frame for f in mine})) > 1:
        notes.append(f"frame {this.frame} taken of frames {', '.join(frames)} of this phase")
    mine = [f for f in mine if f.frame == this.frame]
    surfaces = tuple(_leaflet(folder, mine, name, notes) for name in LEAFLETS)
    beside = [f for f in models if f.phase == this.phase and f.fits(this) and not f.leaflet]
    places = (this.path.parent, folder, folder.parent)
    labels, contour = _table("AnnulusContourPoints.csv", places, this)
    named, points = _table("ValveLandmarkPoints.csv", places, this)
    landmarks = dict(zip((*labels, *named), (*contour, *points), strict=True))
    curves = [contour]
    if len(contour) < MIN_CONTOUR:
        curves += [_middle_of_tube(f, notes) for f in beside if f.words & ANNULUS]
    tips: dict[int, FloatArray] = {}
    # Those of this phase last, so that they stand before those that name no phase.
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
    chords, lengths = _chords([_model(f, notes) for f in beside if f.words & CHORDS])
    begins = np.unique(chords[:, 0], axis=0)
    # Fewer than there are chords, or these run the other way.
    if len(tips) < 2 <= len(begins) < len(chords):
        tips = dict(enumerate(begins[::-1]))  # the left one is the antero-lateral one
    known = {label.strip().upper(): point for label, point in landmarks.items()}
    if unused := known.keys() - {"", *LANDMARKS}:
        notes.append(f"landmarks {', '.join(sorted(unused))} not used")
    return SeenPhase(
        this.phase,
        surfaces,
        next((curve for curve in curves if len(curve) >= MIN_CONTOUR), None),
        {label: known[label] for label in LANDMARKS if label in known},
        np.stack([tips[k] for k in range(len(tips))]) if len(tips) > 1 else None,
        chords,
        lengths,
        tuple(dict.fromkeys(one_line(note) for note in notes)),
    )


def _leaflet(
    folder: Path, files: Sequence[_File], name: str, notes: list[str]
) -> tuple[FloatArray, IntArray]:
    """The surface of a leaflet: the atrial side before others, a fitted shell before its model."""
    fitting = [f for f in files if f.leaflet == name]
    for better in ("atrial", "fit"):
        fitting = [f for f in fitting if better in f.words] or fitting
    # A second valve model of the same frame has a number behind its phase.
    fitting = [f for f in fitting if not f.again] or fitting
    if len(fitting) != 1:
        listed = one_line(", ".join(f.path.name for f in fitting or files), 150)
        raise InputError(
            f"{folder}: {len(fitting)} surfaces of the {name} leaflet ({listed}), expected one; "
            "only=WORD takes those with a word in their names"
        )
    surface = _model(fitting[0], notes)
    if not len(surface.triangles):
        raise GeometryError(f"{fitting[0].path}: no triangles; expected a surface")
    return surface.vertices, surface.triangles


def _model(file: _File, notes: list[str]) -> Surface:
    """A model with its points in LPS."""
    model = read_mesh(file.path)
    if model.space is None:
        notes.append("a surface names no axes in its header, so R, A, S are assumed")
    return replace(model, vertices=model.vertices * TO_LPS[model.space or "RAS"])


def _table(name: str, places: Sequence[Path], this: _File) -> tuple[list[str], FloatArray]:
    """Labels and positions ``(r, 3)`` of one frame, of a table in the first place that has it."""
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
    """Which papillary muscle some words name, if they name one."""
    found = [k for k, names in enumerate(MUSCLES) if any(name <= words for name in names)]
    return found[0] if len(found) == 1 else None


def _tips_in(file: Path, words: set[str], item: PointList) -> dict[int, FloatArray]:
    """Tips by muscle: of a list of one muscle, or of points that are labelled with theirs.

    A list of one has base, tip and insertion (``PAPILLARY_MUSCLE_POINT_LABELS``).
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


def _chords(models: Sequence[Surface]) -> tuple[FloatArray, FloatArray]:
    """Chords of models of lines, ``(c, 2, 3)`` mm, and their lengths ``(c,)`` mm along these.

    Lines run from the papillary muscles to the leaflets, and a branch begins where its trunk ends.
    A chord begins where no line ends. Each line that ends where none begins is the end of one;
    lines with the same ends count once.
    """
    parts = [model.vertices[model.segments] for model in models]
    points = np.concatenate([np.zeros((0, 2, 3)), *parts]).reshape(-1, 3)
    rounded = np.round(points, 3)  # of text have six digits
    _, first, number = np.unique(rounded, axis=0, return_index=True, return_inverse=True)
    pairs = np.unique(number.reshape(-1, 2), axis=0)
    begin, end = pairs[pairs[:, 0] != pairs[:, 1]].T
    length = np.linalg.norm(points[first[end]] - points[first[begin]], axis=1)
    roots, last = np.setdiff1d(begin, end), ~np.isin(end, begin)
    if not len(roots):
        return np.zeros((0, 2, 3)), np.zeros(0)
    graph = csr_matrix((length, (begin, end)), shape=(len(first), len(first)))
    way = dijkstra(graph, indices=roots)[:, begin[last]] + length[last]
    root, line = np.nonzero(np.isfinite(way))
    chords = points[first[np.column_stack([roots[root], end[last][line]])]]
    return chords, way[root, line]


def _middle_of_tube(file: _File, notes: list[str]) -> FloatArray:
    """The curve in the middle of a tube whose points are rings one after another."""
    points = _model(file, notes).vertices
    for sides in range(3, 101):
        if len(points) % sides or len(points) // sides < 8:
            continue
        rings = points.reshape(-1, sides, 3)
        middle = rings.mean(axis=1)
        radius = np.linalg.norm(rings - middle[:, None], axis=2)
        if np.ptp(radius) < 0.05 * radius.mean():
            return middle
    raise GeometryError(f"{file.path}: {len(points)} points, expected the tube of the annulus")
