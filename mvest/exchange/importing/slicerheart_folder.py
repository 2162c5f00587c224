"""Folders that SlicerHeart's modules ValveBatchExport and ValveFemExport write, as they stand.

Names and columns are those of its source (``ValveBatchExport/ValveBatchExportRules``,
``ValveFemExport/ValveFemExport.py``, ``HeartValveLib/Constants.py``). Models are in the axes that
their header names (``SPACE=LPS``; without it RAS, as before Slicer 4.11), tables in R, A, S of the
same origin. Everything is LPS in mm here.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from mvest.errors import GeometryError, InputError
from mvest.exchange.importing.parts import chord_lines
from mvest.exchange.markups import TO_LPS, read_markups
from mvest.exchange.surfaces import check_finite
from mvest.exchange.vtk_legacy import PolyDataFile, read_polydata
from mvest.reading.bounded import refusing
from mvest.reading.text import numbers, read_columns
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
"""Names of the phases by what file names and tables call them."""
_SURFACE = re.compile(
    rf"(?P<scene>.+?)_(?P<valve>[^_]+)_(?:frame_(?P<frame>\d{{1,6}})_)?(?P<phase>{'|'.join(PHASES)})"
    r"(?:_(?P<again>\d+))?_atrial_(?P<leaflet>.+)\.vtk"
)
_CONTOUR = ("AnnulusContourX", "AnnulusContourY", "AnnulusContourZ")
_LANDMARK = ("LandmarkR", "LandmarkA", "LandmarkS")
_TABLES = {
    "AnnulusContourPoints.csv": (
        "Filename",
        "Phase",
        "FrameNumber",
        "Valve",
        *_CONTOUR,
        "AnnulusContourLabel",
    ),
    "ValveLandmarkPoints.csv": (
        "Filename",
        "Phase",
        "Valve",
        "FrameNumber",
        "LandmarkLabel",
        *_LANDMARK,
    ),
}
_SPACE = re.compile(r"\bSPACE=(LPS|RAS)\b")
_MUSCLES = (r"antero.?lateral|\bAL\b", r"postero.?medial|\bPM\b")
"""Of the two papillary muscles, in the order of a case's tips."""
MAX_FILES = 2000


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
        ``(3,)`` mm by label: A, P, AL, PM, ALC, PMC, MC, ...
    tips
        ``(2, 3)`` mm, antero-lateral and postero-medial, or None.
    chords
        ``(c, 2, 3)`` mm from tip to insertion, with their lengths in ``chord_lengths``.
    notes
        What was assumed in reading.
    """

    phase: str
    leaflets: tuple[tuple[FloatArray, IntArray], tuple[FloatArray, IntArray]]
    contour: FloatArray | None
    landmarks: dict[str, FloatArray]
    tips: FloatArray | None
    chords: FloatArray = field(default_factory=lambda: np.zeros((0, 2, 3)))
    chord_lengths: FloatArray = field(default_factory=lambda: np.zeros(0))
    notes: tuple[str, ...] = ()


def read_batch(folder: Path, scene: str | None) -> list[SeenPhase]:
    """Every phase of the mitral valve of one scene that ValveBatchExport wrote.

    Raises
    ------
    InputError, GeometryError
        No atrial surfaces of a mitral valve, several scenes, a damaged file.
    """
    files = _named(folder, _SURFACE, "**/*_atrial_*.vtk")
    scenes = sorted({match["scene"] for match in files.values()})
    if scene is None and len(scenes) > 1:
        raise InputError(
            f"{folder}: {len(scenes)} scenes ({', '.join(scenes[:5])}); give scene=NAME"
        )
    chosen = scenes[0] if scene is None and scenes else scene
    mine = {
        file: match
        for file, match in files.items()
        if match["scene"] == chosen and match["valve"].lower() == "mitral"
    }
    if not mine:
        valves = sorted({match["valve"] for match in files.values()}) or ["none"]
        raise InputError(
            f"{folder}: no surfaces SCENE_mitral_frame_N_PHASE_atrial_LEAFLET.vtk"
            f"{'' if chosen is None else f' of scene {chosen!r}'} (valves: "
            f"{', '.join(valves[:5])}; scenes: {', '.join(scenes[:5]) or 'none'})"
        )
    tables = {
        name: rows for name in _TABLES if (rows := _rows(folder, next(iter(mine)).parent, name))
    }
    seen = []
    for phase in sorted({match["phase"] for match in mine.values()}, key=list(PHASES).index):
        of_phase = {f: m for f, m in mine.items() if m["phase"] == phase}
        frames = sorted({m["frame"] or "" for m in of_phase.values()}, key=lambda n: int(n or -1))
        notes = []
        if len(frames) > 1:
            notes.append(
                f"{phase}: frame {frames[0]} taken of frames {', '.join(frames)} of this phase"
            )
        # A second valve model of the same frame has a number behind its phase.
        files_now = {
            f: m for f, m in of_phase.items() if (m["frame"] or "") == frames[0] and not m["again"]
        }
        surfaces, spaces = _leaflets({m["leaflet"]: f for f, m in files_now.items()}, folder)
        notes += spaces
        this = {"Filename": chosen or "", "Phase": phase, "FrameNumber": frames[0]}
        contour, labelled = _contour(tables.get("AnnulusContourPoints.csv"), this)
        landmarks = labelled | _landmarks(tables.get("ValveLandmarkPoints.csv"), this)
        stem = next(iter(files_now)).name.partition("_atrial_")[0]
        for file in sorted(next(iter(files_now)).parent.glob(f"{_escaped(stem)}_landmarks.fcsv")):
            landmarks |= _as_dict(read_fcsv(file))
        tips = _tips(folder, phase, notes)
        seen.append(SeenPhase(phase, surfaces, contour, landmarks, tips, notes=tuple(notes)))
    return seen


def _named(folder: Path, pattern: re.Pattern[str], glob: str) -> dict[Path, re.Match[str]]:
    found = {}
    for number, file in enumerate(sorted(folder.glob(glob))):
        if number >= MAX_FILES:
            raise InputError(f"{folder}: more than {MAX_FILES} surfaces; name one scene's folder")
        match = pattern.fullmatch(file.name)
        if match:
            found[file] = match
    return found


def _escaped(name: str) -> str:
    return re.sub(r"([*?\[])", r"[\1]", name)


def _leaflets(
    files: dict[str, Path], folder: Path
) -> tuple[tuple[tuple[FloatArray, IntArray], tuple[FloatArray, IntArray]], list[str]]:
    """Surfaces of the anterior and the posterior leaflet, and what their axes were taken to be."""
    notes: list[str] = []
    chosen = []
    for leaflet in ("anterior", "posterior"):
        fitting = sorted(name for name in files if leaflet in name.lower())
        if len(fitting) != 1:
            raise InputError(
                f"{folder}: {len(fitting)} surfaces of the {leaflet} leaflet "
                f"({', '.join(fitting or sorted(files)[:5])}), expected one whose name says so"
            )
        file = files[fitting[0]]
        with refusing(file, "leaflet"):
            surface = _model(file, notes)
            if surface.lines or not len(surface.triangles):
                raise GeometryError("holds lines or no triangles; expected a surface")
        chosen.append((surface.points, surface.triangles))
    return (chosen[0], chosen[1]), notes


def _model(file: Path, notes: list[str]) -> PolyDataFile:
    """A model with its points in LPS."""
    model = read_polydata(file)
    space = _SPACE.search(model.title)
    if space is None:
        notes.append("a surface names no axes in its header, so R, A, S are assumed")
    check_finite(model.points)
    return replace(model, points=model.points * TO_LPS[space[1] if space else "RAS"])


def _rows(folder: Path, beside: Path, name: str) -> tuple[Path, dict[str, list[str]]] | None:
    """A table that lies beside the surfaces or above them, as columns."""
    for place in (beside, folder, folder.parent):
        file = place / name
        if file.is_file():
            return file, read_columns(file, _TABLES[name])
    return None


def _of(
    table: tuple[Path, dict[str, list[str]]], this: dict[str, str], coordinates: Iterable[str]
) -> tuple[list[int], FloatArray]:
    """Numbers of the rows of one frame, and their positions ``(r, 3)`` LPS."""
    file, columns = table
    rows = [
        k
        for k, valve in enumerate(columns["Valve"])
        if valve.lower() == "mitral"
        and all(columns[name][k] == value or not value for name, value in this.items())
    ]
    cells = [numbers(file, name, [columns[name][k] for k in rows]) for name in coordinates]
    return rows, np.column_stack(cells).reshape(-1, 3) * TO_LPS["RAS"]


def _contour(
    table: tuple[Path, dict[str, list[str]]] | None, this: dict[str, str]
) -> tuple[FloatArray | None, dict[str, FloatArray]]:
    """Contour and labelled points of the table of annulus points."""
    if table is None:
        return None, {}
    rows, points = _of(table, this, _CONTOUR)
    labels = [table[1]["AnnulusContourLabel"][k] for k in rows]
    if len(points) < 8:
        return None, {}
    return points, _as_dict((label, p) for label, p in zip(labels, points, strict=True) if label)


def _landmarks(
    table: tuple[Path, dict[str, list[str]]] | None, this: dict[str, str]
) -> dict[str, FloatArray]:
    if table is None:
        return {}
    rows, points = _of(table, this, _LANDMARK)
    return _as_dict((table[1]["LandmarkLabel"][k], p) for k, p in zip(rows, points, strict=True))


def _as_dict(points: Iterable[tuple[str, FloatArray]]) -> dict[str, FloatArray]:
    return {label.strip(): point for label, point in points}


def _tips(folder: Path, phase: str, notes: list[str]) -> FloatArray | None:
    """Tips from lists of points named after the papillary muscles, their second point of three."""
    files = [
        file
        for pattern in ("*.mrk.json", "*.fcsv")
        for file in sorted(folder.rglob(pattern))
        if "papillary" in file.name.lower()
    ]
    own = [f for f in files if _token(phase, f.name)]
    files = own or [f for f in files if not any(_token(other, f.name) for other in PHASES)]
    tips: dict[int, FloatArray] = {}
    for file in files:
        for name, points in _point_lists(file).items():
            for muscle, words in enumerate(_MUSCLES):
                labelled = [p for label, p in points if re.fullmatch(words[-6:], label, re.I)]
                if re.search(words, f"{file.name} {name}".replace("_", " "), re.I):
                    tip = [p for label, p in points if "tip" in label.lower()]
                    if not tip and len(points) < 2:
                        raise InputError(
                            f"{file}: {len(points)} points of a papillary muscle, expected base, "
                            "tip and insertion"
                        )
                    tips[muscle] = tip[0] if tip else points[1][1]
                elif labelled:
                    tips[muscle] = labelled[0]
    if len(tips) < 2:
        return None
    if not own:
        notes.append(f"{phase}: papillary tips of a file that names no phase")
    return np.stack([tips[0], tips[1]])


def _token(phase: str, name: str) -> bool:
    return bool(phase) and re.search(rf"(?<![A-Za-z0-9]){phase}(?![A-Za-z0-9])", name) is not None


def _point_lists(file: Path) -> dict[str, list[tuple[str, FloatArray]]]:
    if file.suffix == ".fcsv":
        return {file.name: read_fcsv(file)}
    return {
        name: list(zip(item.labels, item.points, strict=True))
        for name, item in read_markups(file).items()
    }


def read_fem(folder: Path, phase: str) -> SeenPhase:
    """What ValveFemExport wrote of one valve.

    Leaflets are the models whose names say so, as open surfaces; the annulus is the middle of the
    tube that stands for it; chords are the line models, from tip to insertion, the branches of one
    joined to its trunk.

    Raises
    ------
    InputError, GeometryError
        No leaflets, a damaged file.
    """
    files = [file for file in sorted(folder.glob("*.vtk"))[:MAX_FILES] if file.is_file()]
    lines = [f for f in files if f.name.startswith("Chords_mesh")]
    surfaces = {f.stem: f for f in files if f not in lines and "leaflet" in f.stem.lower()}
    if not surfaces:
        raise InputError(
            f"{folder}: no surfaces *_atrial_*.vtk of ValveBatchExport and no models *leaflet*.vtk "
            "of ValveFemExport"
        )
    # Where a shell was fitted to a leaflet its name goes on, and the leaflet itself may lie beside.
    fitted = {name: file for name, file in surfaces.items() if name.endswith("-fit")}
    leaflets, notes = _leaflets(fitted or surfaces, folder)
    contour = None
    for file in files:
        if re.search(r"annulus", file.stem, re.I) and file not in surfaces.values():
            with refusing(file, "annulus"):
                contour = _middle_of_tube(_model(file, notes).points)
    ends = [_ends(file, notes) for file in lines]
    segments = np.concatenate(ends) if ends else np.zeros((0, 2, 3))
    chords, lengths, tips = chord_lines(segments)
    if len(tips) not in (0, 2):
        raise InputError(
            f"{folder}: chords begin at {len(tips)} points, expected two papillary tips"
        )
    own = _tips(folder, phase, notes)
    return SeenPhase(
        phase,
        leaflets,
        contour,
        {},
        own if own is not None else (tips if len(tips) else None),
        chords,
        lengths,
        tuple(notes),
    )


def _ends(file: Path, notes: list[str]) -> FloatArray:
    with refusing(file, "chords"):
        model = _model(file, notes)
        if any(len(line) != 2 for line in model.lines):
            raise InputError("lines of other than two points, expected one for every chord")
        return model.points[np.array(model.lines, dtype=np.int64).reshape(-1, 2)]


def _middle_of_tube(points: FloatArray) -> FloatArray:
    """The curve in the middle of a tube whose points are rings one after another.

    Raises
    ------
    GeometryError
        They are no such rings.
    """
    for sides in range(3, 101):
        if len(points) % sides or len(points) // sides < 8:
            continue
        rings = points.reshape(-1, sides, 3)
        middle = rings.mean(axis=1)
        radius = np.linalg.norm(rings - middle[:, None], axis=2)
        if np.ptp(radius) < 0.05 * radius.mean():
            return middle
    raise GeometryError(f"{len(points)} points that are no tube; expected that of the annulus")
