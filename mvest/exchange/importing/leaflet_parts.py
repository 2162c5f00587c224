"""Identifies the voxels or closed surfaces of each leaflet in a source."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeAlias

import numpy as np

from mvest.errors import GeometryError, InputError
from mvest.exchange._images import Segment
from mvest.exchange.importing.written import REGIONS
from mvest.exchange.surfaces import Surface, merged
from mvest.exchange.volumes import LabelMap
from mvest.reading.text import one_line
from mvest.typing import BoolArray, FloatArray, IntArray
from mvest.valve.geometry.leaflet_fields import STEP_MM, inside_surfaces
from mvest.valve.geometry.surface_checks import check_surface, enclosed_volume

TERMS = {"anterior": "sh-leaflet-mv-a", "posterior": "sh-leaflet-mv-p"}
"""SlicerHeart's terminology codes for the mitral leaflets."""
WORDS = {
    "anterior": {"anterior", "aml", "amvl", "a1", "a2", "a3"},
    "posterior": {"posterior", "pml", "pmvl", "p1", "p2", "p3"},
}
"""Words that name leaflets, and scallops (Carpentier)."""
SCALLOPS = {"a1", "a2", "a3", "p1", "p2", "p3", "scallop"}
OTHERS = {"papillary", "muscle", "commissure", "annulus", "chordae", "tricuspid", "aortic"}
"""Words that name other structures."""
VALVE_MM = (10.0, 120.0)
"""Plausible size of a valve."""
Content: TypeAlias = Surface | LabelMap
Grid: TypeAlias = tuple[FloatArray, FloatArray, FloatArray]
"""Spacing, direction and origin of voxels, as in `mvest.exchange.volumes.LabelMap`."""


@dataclass(frozen=True, slots=True, eq=False)
class Tissue:
    """The leaflets of one frame, either both together or anterior and posterior separately."""

    masks: tuple[BoolArray, ...]  # (I, J, K) each
    grid: Grid
    surface: tuple[FloatArray, IntArray] | None = None  # of both leaflets, replaces masks
    nameless: tuple[str, ...] = ()  # two labels whose names do not identify a leaflet

    @property
    def points(self) -> FloatArray:
        """``(k, 3)`` mm: vertices of the surface, or centres of the voxels."""
        if self.surface is not None:
            return self.surface[0]
        spacing, direction, origin = self.grid
        index = np.argwhere(np.any(self.masks, axis=0))
        return np.asarray(origin + (index * spacing) @ direction.T)


def filled_frames(labels: LabelMap) -> list[int]:
    """Indices of the frames or layers that contain labels."""
    filled: list[int] = np.flatnonzero(labels.frames.any(axis=(1, 2, 3))).tolist()
    return filled


def tissue_of(
    contents: Sequence[Content],
    frame: int | None,
    given: Mapping[str, Sequence[str]],
    scale: float,
    derived: list[str],
) -> Tissue:
    """The leaflets of a frame, as voxels unless they are a single closed surface.

    ``contents`` come from one file, or from one file for each leaflet. ``frame`` selects a frame of
    a label map over time (None: the first with labels), or one layer of a segmentation (None: all).
    ``given`` has the names or numbers of the parts of the ``anterior`` and the ``posterior``
    leaflet, or of both (``leaflets``); by default terminology and names decide. ``scale`` is mm per
    unit of surfaces. Sentences about used and unused parts are appended to ``derived``.

    InputError or GeometryError if leaflets are not recognised, files are inconsistent, or surfaces
    are defective.
    """
    chosen = [_parts(content, frame) for content in contents]
    nameless: tuple[str, ...] = ()
    if len(contents) == 1:
        chosen, nameless = _chosen(chosen[0], given, derived)
    else:
        derived.append("each leaflet from a separate file")
    maps = [content for content in contents if isinstance(content, LabelMap)]
    if maps:
        grids = [(m.spacing, m.direction, m.origin) for m in maps]
        same = [np.allclose(a, b, atol=1e-3) for a, b in zip(grids[0], grids[-1], strict=True)]
        same += [len(maps) == len(contents), maps[0].frames.shape == maps[-1].frames.shape]
        if not all(same):
            raise InputError("the two files do not have the same voxels")
        masks = [np.asarray(np.any([p.shape() for p in own], axis=0)) for own in chosen]
        return Tissue(tuple(masks), grids[0], nameless=nameless)
    pieces = [[_outwards(part.shape(), scale) for part in own] for own in chosen]
    whole = [piece for own in pieces for piece in own]
    size = float(np.ptp(np.concatenate([points for points, _ in whole]), axis=0).max())
    if not VALVE_MM[0] <= size <= VALVE_MM[1]:
        raise GeometryError(
            f"{size:.3g} mm across, expected a valve of {VALVE_MM[0]:g} to {VALVE_MM[1]:g} mm: is "
            "units= right?"
        )
    if len(whole) == 1:
        return Tissue((), (np.ones(3), np.eye(3), np.zeros(3)), whole[0])
    inside, origin = inside_surfaces(whole, STEP_MM)
    parted = np.split(np.array(inside), np.cumsum([len(own) for own in pieces])[:-1])
    masks = [np.asarray(own.any(axis=0)) for own in parted]
    return Tissue(tuple(masks), (np.full(3, STEP_MM), np.eye(3), origin), nameless=nameless)


@dataclass(frozen=True, slots=True, eq=False)
class _Part:
    """A segment, label or object, and a function that gives its voxels or surface.

    A nameless label has its number as name.
    """

    name: str
    label: str
    tags: str
    shape: Callable[[], Any]

    @property
    def words(self) -> set[str]:
        """Lower-case words of the name."""
        return set(re.findall(r"[a-z]+\d*", re.sub(r"([a-z])([A-Z])", r"\1 \2", self.name).lower()))


def _parts(content: Content, frame: int | None) -> list[_Part]:
    """The non-empty parts of a file."""
    if isinstance(content, Surface):
        names = sorted(set(content.groups))
        if len(names) < 2:
            return [_Part("".join(names) or "surface", "", "", lambda: content)]
        return [_Part(name, "", "", partial(_object, content, name)) for name in names]
    filled = filled_frames(content)
    if frame not in (None, *filled):
        raise InputError(f"frame {frame} holds no labels, expected one of {filled}")
    at = filled[0] if frame is None else frame
    values = np.unique(content.frames[at]).tolist()
    parts = []
    for one in content.segments or [Segment(str(v), "", v, at) for v in values if v]:
        layer = one.layer if content.is_layers else at
        mask = partial(np.equal, content.frames[layer], one.label)
        if frame in (None, layer) and mask().any():
            parts.append(_Part(one.name, str(one.label), one.tags, mask))
    return parts


def _object(surface: Surface, name: str) -> Surface:
    used, triangles = np.unique(
        surface.triangles[np.array(surface.groups) == name], return_inverse=True
    )
    return Surface(surface.vertices[used], triangles.reshape(-1, 3).astype(np.int64))


def _chosen(
    parts: Sequence[_Part], given: Mapping[str, Sequence[str]], derived: list[str]
) -> tuple[list[list[_Part]], tuple[str, ...]]:
    """The parts of both leaflets together or of each, and the names of two nameless parts."""
    both, *chosen = (
        [_called(parts, word) for word in given.get(name, ())] for name in ("leaflets", *REGIONS)
    )
    for region, own in zip(REGIONS, chosen, strict=True):
        if not own:
            own += [part for part in parts if TERMS[region] in part.tags]
        if not own:
            own += [p for p in parts if p.words & WORDS[region] and not p.words & OTHERS]
        if len(own) > 1 and not given.get(region) and not all(p.words & SCALLOPS for p in own):
            raise InputError(f"{_listed(own)}: which is the {region} leaflet? give {region}=NAME")
    if both or (len(parts) == 1 and not any(chosen)):
        chosen = [both or list(parts)]
    elif len(parts) == 2 and not any(chosen):
        return [[part] for part in parts], tuple(f"label {part.name}" for part in parts)
    elif not all(chosen) or set(chosen[0]) & set(chosen[1]):
        raise InputError(
            f"the leaflets are not recognised among {_listed(parts)}: give anterior=N and "
            "posterior=N (names, numbers, lists of them, or a file), or leaflets=N if one is both"
        )
    rest = [part for part in parts if not any(part in own for own in chosen)]
    if len(parts) > 1:
        names = REGIONS if len(chosen) == 2 else ("both leaflets",)
        words = [f"{name}: {_listed(own)}" for name, own in zip(names, chosen, strict=True)]
        derived.append("; ".join(words + [f"not used: {_listed(rest)}"] * bool(rest)))
    return chosen, ()


def _called(parts: Sequence[_Part], word: str) -> _Part:
    found = [p for p in parts if p.name == word] or [p for p in parts if p.label == word]
    if len(found) != 1:
        raise InputError(
            f"{len(found)} parts of the name or number {one_line(word, 80)}, expected one of "
            f"{_listed(parts)}"
        )
    return found[0]


def _listed(parts: Sequence[_Part]) -> str:
    names = [p.name if p.label in ("", p.name) else f"{p.name} ({p.label})" for p in parts]
    return one_line(", ".join(names), 300)


def _outwards(part: Surface, scale: float) -> tuple[FloatArray, IntArray]:
    """A closed surface in mm with merged vertices and outward normals."""
    one = merged(Surface(scale * part.vertices, part.triangles))
    faces = one.triangles
    if enclosed_volume(one.vertices, faces) < 0:
        faces = faces[:, ::-1]
    check_surface(one.vertices, faces, self_intersections=False, name="leaflets")
    return one.vertices, faces
