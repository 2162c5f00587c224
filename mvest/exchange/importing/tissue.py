"""Which voxels or closed surfaces of a source are which leaflet."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np

from mvest.errors import GeometryError, InputError
from mvest.exchange.regions import RegionSurface, merged, part_of
from mvest.exchange.surfaces import SURFACE_SUFFIXES, read_surface
from mvest.exchange.volumes import LabelMap, Segment, read_labels
from mvest.exchange.vtk_xml import SurfaceFile
from mvest.reading.text import one_line
from mvest.typing import BoolArray, FloatArray, IntArray
from mvest.valve.geometry.leaflet_fields import STEP_MM, inside_surfaces
from mvest.valve.geometry.surface_checks import check_surface, enclosed_volume

REGIONS = ("anterior", "posterior")
TERMS = {"anterior": "sh-leaflet-mv-a", "posterior": "sh-leaflet-mv-p"}
"""Codes of SlicerHeart's terminology for the leaflets of the mitral valve."""
WORDS = {"anterior": {"anterior", "aml", "amvl"}, "posterior": {"posterior", "pml", "pmvl"}}
SCALLOPS = {"anterior": {"a1", "a2", "a3"}, "posterior": {"p1", "p2", "p3"}}
"""Carpentier's names of the segments of a leaflet."""
BOTH = {"leaflets", "leaflet", "valve", "mv"}
"""Words in the name of both leaflets together."""
OTHERS = {"papillary", "muscle", "commissure", "annulus", "chordae", "tricuspid", "aortic"}
"""Words in the names of what is no mitral leaflet."""
VALVE_MM = (10.0, 120.0)
"""Size of a valve."""
Content: TypeAlias = LabelMap | SurfaceFile


@dataclass(frozen=True, slots=True, eq=False)
class Tissue:
    """The leaflets of one frame.

    Attributes
    ----------
    masks : tuple of (I, J, K)
        Voxels of both leaflets together, or of the anterior and of the posterior one.
    spacing, direction, origin
        Of the voxels, as in `mvest.exchange.volumes.LabelMap`.
    surface : ((n, 3) mm, (m, 3)) or None
        One closed surface of both leaflets; there are no masks then.
    titles : tuple of str
        What the masks are called, where that does not say which leaflet is which.
    """

    masks: tuple[BoolArray, ...]
    spacing: FloatArray
    direction: FloatArray
    origin: FloatArray
    surface: tuple[FloatArray, IntArray] | None = None
    titles: tuple[str, ...] = ()

    @property
    def points(self) -> FloatArray:
        """``(k, 3)`` mm: vertices, or centres of voxels."""
        if self.surface is not None:
            return self.surface[0]
        index = np.argwhere(np.any(self.masks, axis=0))
        return np.asarray(self.origin + (index * self.spacing) @ self.direction.T)


def is_surface(path: Path) -> bool:
    """Whether a file is one of surfaces, by its extension; others are label maps."""
    return path.suffix.lower() in SURFACE_SUFFIXES


def leaflet_of(name: str) -> str | None:
    """The leaflet that a name tells, if it tells one."""
    words = _words(name)
    for table in (WORDS, SCALLOPS):
        found = [region for region in REGIONS if words & table[region]]
        if found:
            return found[0] if len(found) == 1 and not words & OTHERS else None
    return None


def _words(name: str) -> set[str]:
    parted = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name).lower()
    return set(re.findall(r"[a-z]+\d*", parted))


def paired_files(source: Path) -> tuple[Path, ...]:
    """A source as files: itself, or one for each leaflet.

    These are the two of a folder whose names tell the leaflets, or a file and its neighbour whose
    name differs from it by the leaflet alone.

    Raises
    ------
    InputError
        A folder without two such files.
    """
    if source.is_dir():
        files = sorted(file for file in source.iterdir() if file.is_file())
        found = [[file for file in files if leaflet_of(file.name) == name] for name in REGIONS]
        if [len(own) for own in found] != [1, 1]:
            raise InputError(
                f"{len(found[0])} files of an anterior and {len(found[1])} of a posterior leaflet "
                "by their names, expected one of each; give the file of the anterior one as SOURCE "
                "and posterior=FILE"
            )
        return found[0][0], found[1][0]
    names = [re.sub("anterior|posterior", name, source.name, flags=re.I) for name in REGIONS]
    both = [source.with_name(name) for name in names]
    is_pair = leaflet_of(source.name) is not None and source in both and both[0] != both[1]
    return tuple(both) if is_pair and all(file.is_file() for file in both) else (source,)


def read_files(files: Sequence[Path]) -> list[Content]:
    """Surfaces or label maps, by the extensions of the files."""
    return [read_surface(file) if is_surface(file) else read_labels(file) for file in files]


def tissue_of(
    contents: Sequence[Content],
    frame: int,
    layer: int | None,
    given: Mapping[str, tuple[str, ...]],
    scale: float,
    derived: list[str],
) -> Tissue:
    """The leaflets of one frame.

    Parameters
    ----------
    contents
        Of one file, or of those of the anterior and of the posterior leaflet.
    frame, layer
        Of label maps: number of the frame, and of the only layer that is looked at.
    given
        Names or numbers of the parts that are ``anterior``, ``posterior`` and ``leaflets`` (both).
    scale
        mm per unit of surfaces.
    derived
        Gets a sentence for what is used and what is not.

    Raises
    ------
    InputError, GeometryError
        Leaflets that are not recognised, surfaces in disorder, files that do not go together.
    """
    surfaces = [one for one in contents if isinstance(one, SurfaceFile)]
    maps = [one for one in contents if isinstance(one, LabelMap)]
    if surfaces and maps:
        raise InputError("one leaflet is a surface and the other a label map, expected two alike")
    if surfaces:
        return _of_surfaces(surfaces, given, scale, derived)
    first = maps[0]
    grid = first.spacing, first.direction, first.origin
    if len(maps) == 2:
        other = maps[1].spacing, maps[1].direction, maps[1].origin
        alike = all(np.allclose(a, b, atol=1e-3) for a, b in zip(grid, other, strict=True))
        if not alike or first.frames.shape != maps[1].frames.shape:
            raise InputError("the files of the two leaflets have different grids, expected one")
        return Tissue(tuple(one.frames[frame] != 0 for one in maps), *grid)

    def mask(part: Segment) -> BoolArray:
        return np.asarray(first.frames[part.layer if first.is_layers else frame] == part.label)

    values = np.unique(first.frames[frame]).tolist()
    parts = first.segments or tuple(Segment(str(v), "", v, frame) for v in values if v)
    filled = [part for part in parts if layer in (None, part.layer) and mask(part).any()]
    empty = ", ".join(part.name for part in parts if part not in filled)
    if empty:
        derived.append(f"no voxels of {one_line(empty, 200)}")
    found, titles = _chosen(filled, given, derived)
    masks = [np.asarray(np.any([mask(part) for part in own], axis=0)) for own in found]
    return Tissue(tuple(masks), *grid, titles=titles)


def muscle_points(word: str, source: Content, frame: int, scale: float) -> FloatArray:
    """Points ``(k, 3)`` mm of a papillary muscle: a file of surfaces, or a part of the source.

    Raises
    ------
    InputError, GeometryError
        A damaged file, or no such part.
    """
    if Path(word).is_file():
        return scale * read_surface(word).vertices
    if isinstance(source, SurfaceFile):
        return scale * part_of(source, word).vertices
    alone = {"leaflets": (word,), "anterior": (), "posterior": ()}
    return tissue_of([source], frame, None, alone, scale, []).points


def _of_surfaces(
    wholes: Sequence[SurfaceFile],
    given: Mapping[str, tuple[str, ...]],
    scale: float,
    derived: list[str],
) -> Tissue:
    """As `tissue_of`; all but a single closed surface become voxels of `STEP_MM`."""
    names = sorted(set(wholes[0].groups))
    chosen, titles = [[whole] for whole in wholes], ()
    if len(wholes) == 1 and (len(names) > 1 or any(given.values())):
        found, titles = _chosen([Segment(name, "", -1, 0) for name in names], given, derived)
        chosen = [[part_of(wholes[0], part.name) for part in own] for own in found]
    closed = [[_outwards(scale * one.vertices, one.triangles) for one in own] for own in chosen]
    pieces = [piece for own in closed for piece in own]
    size = float(np.ptp(np.concatenate([vertices for vertices, _ in pieces]), axis=0).max())
    if not VALVE_MM[0] <= size <= VALVE_MM[1]:
        raise GeometryError(
            f"{size:.3g} mm across, expected a valve of {VALVE_MM[0]:g} to {VALVE_MM[1]:g} mm: is "
            "units= right?"
        )
    if len(pieces) == 1:
        return Tissue((), np.ones(3), np.eye(3), np.zeros(3), pieces[0])
    inside, origin = inside_surfaces(pieces, STEP_MM)
    ends = np.cumsum([len(own) for own in closed])
    masks = [np.asarray(np.any(own, axis=0)) for own in np.split(np.array(inside), ends[:-1])]
    return Tissue(tuple(masks), np.full(3, STEP_MM), np.eye(3), origin, titles=titles)


def _outwards(vertices: FloatArray, triangles: IntArray) -> tuple[FloatArray, IntArray]:
    """One closed surface with its normals outwards and coincident vertices one."""
    one = merged(RegionSurface(vertices, triangles, np.zeros(len(triangles), dtype=np.int64), {}))
    faces = one.triangles
    if enclosed_volume(one.vertices, faces) < 0:
        faces = faces[:, ::-1]
    check_surface(one.vertices, faces, self_intersections=False, name="leaflets")
    return one.vertices, faces


def _chosen(
    parts: Sequence[Segment], given: Mapping[str, tuple[str, ...]], derived: list[str]
) -> tuple[list[list[Segment]], tuple[str, ...]]:
    """The parts of both leaflets or of each; and their names where these do not say which.

    Raises
    ------
    InputError
        No such part, or parts that are not recognised.
    """
    found = [_called(parts, given["leaflets"])] if given["leaflets"] else _recognised(parts, given)
    titles: tuple[str, ...] = ()
    if not found:
        found = [[part] for part in parts]
        titles = tuple(_listed(own) for own in found)
    elif len(found) == 2 and any(part in found[1] for part in found[0]):
        raise InputError("anterior= and posterior= share a part; expected different ones")
    names = REGIONS if len(found) == 2 else ("both",)
    if not titles:
        words = [f"{n}, {_listed(own)}" for n, own in zip(names, found, strict=True)]
        derived.append(f"leaflets: {'; '.join(words)}")
    unused = [part for part in parts if not any(part in own for own in found)]
    if unused:
        derived.append(f"not used: {_listed(unused)}")
    return found, titles


def _recognised(
    parts: Sequence[Segment], given: Mapping[str, tuple[str, ...]]
) -> list[list[Segment]]:
    """Parts by what is given, by terminology or by names; none where these tell no two apart."""
    found = {region: _called(parts, given[region]) for region in REGIONS}
    for region, own in found.items():
        if not own:
            own += [part for part in parts if TERMS[region] in part.tags]
        if not own:
            own += [part for part in parts if leaflet_of(part.name) == region]
        joined = given[region] or all(_words(part.name) & SCALLOPS[region] for part in own)
        if len(own) > 1 and not joined:
            raise InputError(f"{_listed(own)}: each is the {region} leaflet; give {region}=NAME")
    missing = [region for region, own in found.items() if not own]
    rest = [part for part in parts if part not in found["anterior"] + found["posterior"]]
    if len(missing) == 1 and len(rest) == 1 and any(given.values()):
        found[missing.pop()] = rest
    if not missing:
        return list(found.values())
    whole = [p for p in parts if _words(p.name) & BOTH and not _words(p.name) & OTHERS]
    if len(missing) == 2 and len(whole) == 1:
        return [whole]
    if len(missing) == 2 and len(parts) == 1:
        return [list(parts)]
    if len(missing) == 2 and len(parts) == 2:
        return []
    raise InputError(
        f"there are {_listed(parts)}: which is the {' and which the '.join(missing)} leaflet? give "
        "anterior=N posterior=N (names, numbers, or lists of them), or leaflets=N if it is both"
    )


def _called(parts: Sequence[Segment], words: Sequence[str]) -> list[Segment]:
    """Parts by names or numbers, one for each word."""
    result: list[Segment] = []
    for word in words:
        own = [part for part in parts if part.name == word]
        own = own or [part for part in parts if word.isdecimal() and part.label == int(word)]
        if len(own) != 1:
            raise InputError(
                f"{len(own)} parts of the name or number {one_line(word, 80)}, expected one of "
                f"{_listed(parts)}"
            )
        result += own
    return result


def _listed(parts: Sequence[Segment]) -> str:
    """Names with their labels; in a map without names these are one."""
    titles = [p.name if p.label < 0 else f"{p.name} (label {p.label})" for p in parts]
    titles = [
        f"label {part.label}" if part.name == str(part.label) else title
        for part, title in zip(parts, titles, strict=True)
    ]
    return one_line(", ".join(titles) or "no parts", 300)
