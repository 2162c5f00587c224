"""Value objects of the anatomy: leaflets, chordae, motion of the boundary, and the whole valve.

All lengths are millimetres. Every object is frozen and checked on construction; the message of a
failed check names the field and the entry.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple, Protocol

import numpy as np

from mvest.errors import GeometryError, InputError
from mvest.typing import BoolArray, FloatArray, IntArray
from mvest.valve.geometry.proximity import closest_points
from mvest.valve.geometry.triangles import area_vectors, area_vectors_change, areas

MAX_CHORD_GAP_MM = 3.0
"""From the insertion of a chord to the leaflets."""


def checked_floats(name: str, array: FloatArray, shape: tuple[int | None, ...]) -> FloatArray:
    """A read-only copy as float64; InputError on a wrong shape or an entry that is not finite.

    None in the shape stands for any length.
    """
    result = np.array(array, dtype=np.float64, order="C")
    _check_shape(name, result.shape, shape)
    bad = np.argwhere(~np.isfinite(result))
    if bad.size:
        raise InputError(f"{name}: entry {tuple(int(i) for i in bad[0])} is not finite")
    result.setflags(write=False)
    return result


def checked_indices(
    name: str, array: IntArray, upper: int, shape: tuple[int | None, ...], lower: int = 0
) -> IntArray:
    """A read-only copy as int64; InputError on a wrong shape or type, or outside [lower, upper)."""
    given = np.asarray(array)
    if given.size and not np.issubdtype(given.dtype, np.integer):
        raise InputError(f"{name}: {given.dtype}, expected integers")
    result = np.array(given, dtype=np.int64, order="C")
    _check_shape(name, result.shape, shape)
    bad = np.argwhere((result < lower) | (result >= upper))
    if bad.size:
        where = tuple(int(i) for i in bad[0])
        found = f"entry {where} is {result[where]}, expected {lower} to {upper - 1}"
        raise InputError(f"{name}: {found}")
    result.setflags(write=False)
    return result


def _check_shape(name: str, shape: tuple[int, ...], expected: tuple[int | None, ...]) -> None:
    if len(shape) != len(expected) or any(
        want is not None and want != got for want, got in zip(expected, shape, strict=True)
    ):
        raise InputError(f"{name}: shape {shape}, expected {expected} (None: any length)")


class BandGrid(NamedTuple):
    """A grid of leaflets from annulus to free edge, in material coordinates.

    ``phi (n,)`` degrees and ``s (n,)`` of the vertices, ``triangles (m, 3)``, and the leaflet
    ``region (m,)`` of each triangle.
    """

    phi: FloatArray
    s: FloatArray
    triangles: IntArray
    region: IntArray


def band_grid(columns: int, rows: int, sections: Sequence[int] = (0, 1)) -> BandGrid:
    """A grid of ``columns x rows`` vertices from annulus to free edge, equal columns per leaflet.

    Vertex ``j * columns + i`` is column i, row j: the first row is the annulus, the last one the
    free edge. Normals of triangles point to the ventricle where phi runs as in the template.
    ``sections`` are those of `MaterialSurface`.
    """
    i, j = (v.ravel() for v in np.meshgrid(np.arange(columns), np.arange(rows)))
    cell_i, cell_j = (v.ravel() for v in np.meshgrid(np.arange(columns), np.arange(rows - 1)))
    a = cell_j * columns + cell_i
    b = cell_j * columns + (cell_i + 1) % columns
    c, d = b + columns, a + columns
    return BandGrid(
        phi=360.0 * i / columns,
        s=j / (rows - 1),
        triangles=np.concatenate([np.stack([a, d, c], 1), np.stack([a, c, b], 1)]),
        region=np.tile(np.array(sections)[len(sections) * cell_i // columns], 2),
    )


def vertex_normals(vertices: FloatArray, triangles: IntArray) -> FloatArray:
    """Area-weighted unit normals ``(n, 3)`` of a triangulated surface."""
    face = area_vectors(vertices, triangles)
    normal = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(normal, triangles[:, k], face)
    return normal / np.linalg.norm(normal, axis=1, keepdims=True)


def lumped_areas(vertices: FloatArray, triangles: IntArray) -> FloatArray:
    """Area ``(n,)`` mm² of each vertex: a third of each adjacent triangle."""
    share = np.repeat(areas(vertices, triangles) / 3, 3)
    total = np.bincount(triangles.ravel(), share, minlength=len(vertices))
    return np.asarray(total, dtype=np.float64)


def lumped_areas_change(vertices: FloatArray, triangles: IntArray, moves: FloatArray) -> FloatArray:
    """Change ``(n, q)`` mm² of `lumped_areas` by displacements ``(n, 3, q)`` of the vertices."""
    face = area_vectors(vertices, triangles)
    unit = face / np.linalg.norm(face, axis=1, keepdims=True)
    change = np.einsum("mi,miq->mq", unit, area_vectors_change(vertices, triangles, moves)) / 3
    out = np.zeros((len(vertices), moves.shape[2]))
    for own in triangles.T:
        np.add.at(out, own, change)
    return out


@dataclass(frozen=True, slots=True, eq=False)
class LeafletSurface:
    """Midsurface of all leaflets in the reference (open) frame.

    InputError or GeometryError for wrong shapes, values that are not finite, unknown regions,
    thickness that is not positive, or fibres without direction.
    """

    vertices: FloatArray  #: (n, 3) mm
    triangles: IntArray  #: ``(m, 3)``; their normals point to the ventricle
    region: IntArray  #: ``(m,)`` leaflet of each triangle, an index into ``region_names``
    region_names: tuple[str, ...]
    fibre: FloatArray  #: ``(n, 3)`` unit vectors, collagen direction at the vertices
    thickness: FloatArray  #: ``(n,)`` mm, positive

    def __post_init__(self) -> None:
        set_ = object.__setattr__
        set_(self, "vertices", checked_floats("vertices", self.vertices, (None, 3)))
        n = len(self.vertices)
        set_(self, "triangles", checked_indices("triangles", self.triangles, n, (None, 3)))
        m = len(self.triangles)
        set_(self, "region", checked_indices("region", self.region, len(self.region_names), (m,)))
        set_(self, "thickness", checked_floats("thickness", self.thickness, (n,)))
        if np.any(self.thickness <= 0):
            i = int(np.argmin(self.thickness))
            raise GeometryError(f"thickness of vertex {i} is {self.thickness[i]} mm, expected > 0")
        fibre = checked_floats("fibre", self.fibre, (n, 3))
        length = np.linalg.norm(fibre, axis=1)
        if np.any(length < 1e-8):
            raise GeometryError(f"fibre of vertex {int(np.argmin(length))} has no direction")
        set_(self, "fibre", checked_floats("fibre", fibre / length[:, None], (n, 3)))

    @property
    def normals(self) -> FloatArray:
        """Unit vertex normals ``(n, 3)``, towards the ventricle."""
        return vertex_normals(self.vertices, self.triangles)

    @property
    def areas(self) -> FloatArray:
        """Lumped vertex areas ``(n,)`` mm^2."""
        return lumped_areas(self.vertices, self.triangles)

    @property
    def vertex_region(self) -> IntArray:
        """Region ``(n,)`` of each vertex: the smallest index among its triangles."""
        result = np.full(len(self.vertices), len(self.region_names), dtype=np.int64)
        np.minimum.at(result, self.triangles.ravel(), np.repeat(self.region, 3))
        return result


@dataclass(frozen=True, slots=True, eq=False)
class Chordae:
    """Chordae tendineae: cables from the papillary tips to the leaflets, which may branch.

    The k = c + j segments form trees, each rooted at a papillary tip. Segment i < c ends at
    insertion i, segment c + i at junction i. Straight chordae have no junctions.

    InputError for wrong shapes, values that are not finite or not positive, unknown families or
    parents, or segments that form no trees.
    """

    tip: IntArray  #: ``(k,)`` index of the papillary tip at the root
    insertion: FloatArray  #: ``(c, 3)`` mm, leaflet ends on the midsurface in the reference frame
    family: IntArray  #: ``(k,)`` index into ``family_names`` (marginal, basal, ...)
    family_names: tuple[str, ...]
    rest_length: FloatArray  #: (k,) mm
    axial_stiffness: FloatArray  #: ``(k,)`` N, Young's modulus times cross section
    toe_strain: float  #: strain over which the stiffness rises from zero to ``axial_stiffness``
    #: ``(j, 3)`` mm, points at which chordae branch, in the reference frame
    junction: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    #: ``(k,)`` junction at which each segment starts, or -1 at the tip; if empty, all start there
    parent: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))

    def __post_init__(self) -> None:
        set_ = object.__setattr__
        set_(self, "insertion", checked_floats("chordae insertion", self.insertion, (None, 3)))
        set_(self, "junction", checked_floats("chordae junction", self.junction, (None, 3)))
        c, j = len(self.insertion), len(self.junction)
        k = c + j
        set_(self, "tip", checked_indices("chordae tip", self.tip, np.iinfo(np.int64).max, (k,)))
        n_families = len(self.family_names)
        set_(self, "family", checked_indices("chordae family", self.family, n_families, (k,)))
        for name in ("rest_length", "axial_stiffness"):
            value = checked_floats(f"chordae {name}", getattr(self, name), (k,))
            if np.any(value <= 0):
                i = int(np.argmin(value))
                raise InputError(f"{name} of chord {i} is {value[i]}, expected > 0")
            set_(self, name, value)
        if not 0 < self.toe_strain < 0.5:
            raise InputError(f"toe strain {self.toe_strain}, expected between 0 and 0.5")
        parent = self.parent if len(self.parent) or j else np.full(k, -1)
        parent = checked_indices("chordae parent", parent, j, (k,), lower=-1)
        set_(self, "parent", parent)
        barren = np.setdiff1d(np.arange(j), parent)
        if barren.size:
            raise InputError(f"chordae junction {barren[0]}: no segment starts at it")
        paths(parent, c)  # checks that there is no cycle
        other = np.flatnonzero((parent >= 0) & (self.tip != self.tip[c + parent]))
        if other.size:
            i = int(other[0])
            raise InputError(
                f"chordae tip: segment {i} belongs to tip {self.tip[i]}, but starts at junction "
                f"{parent[i]} of tip {self.tip[c + parent[i]]}"
            )

    def __len__(self) -> int:
        return len(self.tip)

    @property
    def paths(self) -> BoolArray:
        """See `paths`."""
        return paths(self.parent, len(self.insertion))

    @property
    def end_tip(self) -> IntArray:
        """Papillary tip ``(c,)`` of each leaflet end."""
        return self.tip[: len(self.insertion)]

    def along(self, values: FloatArray) -> FloatArray:
        """Sums ``(c,)`` of values ``(k,)`` over the segments from the tip to each leaflet end."""
        return np.asarray(self.paths[: len(self.insertion)] @ values)

    def ends(self, tips: FloatArray) -> FloatArray:
        """Start and end ``(k, 2, 3)`` mm of each segment, with the papillary tips ``(t, 3)``."""
        points = np.concatenate([self.insertion, self.junction])
        branches = (self.parent >= 0)[:, None]
        start = np.where(branches, points[self.parent + len(self.insertion)], tips[self.tip])
        return np.stack([start, points], axis=1)

    def moved(self, tips: FloatArray, ends: FloatArray) -> Chordae:
        """The chordae with other tips and leaflet ends; their junctions follow proportionally.

        A junction moves with its tip and the mean of the leaflet ends beyond it, each weighted by
        the length of the chord on the other side.

        ``tips, ends`` ``(t, 3) and (c, 3) mm``: displacements of the papillary tips and of the
        insertions.
        """
        weights = leverage(self.parent, self.rest_length, len(self.insertion))
        held = (1 - weights.sum(axis=1, keepdims=True)) * tips[self.tip[len(self.insertion) :]]
        junction = self.junction + held + weights @ ends
        return replace(self, insertion=self.insertion + ends, junction=junction)


def paths(parent: IntArray, c: int) -> BoolArray:
    """Whether segment (row) or its trunk contains a segment (column), ``(k, k)``.

    A row has the segments on the way from the tip to the segment's end. ``parent (k,)`` and c are
    those of `Chordae`; InputError if segments form a cycle.
    """
    out = np.eye(len(parent), dtype=np.bool_)
    at = np.where(parent >= 0, c + parent, -1)
    for _ in parent:
        on = np.flatnonzero(at >= 0)
        if not on.size:
            return out
        out[on, at[on]] = True
        at[on] = np.where(parent[at[on]] >= 0, c + parent[at[on]], -1)
    looped = np.flatnonzero(at >= 0)
    if looped.size:
        raise InputError(f"chordae parent: segment {looped[0]} hangs on a cycle of junctions")
    return out


def leverage(parent: IntArray, rest_length: FloatArray, c: int) -> FloatArray:
    """Share ``(j, c)`` of each leaflet end's displacement that `Chordae.moved` gives a junction."""
    on = paths(parent, c)
    length = on @ rest_length
    beyond = on[:c, c:].T / on[:c, c:].sum(axis=0)[:, None]
    return np.asarray(beyond * (length[c:] / (beyond @ length[:c]))[:, None])


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """Prescribed positions of annulus and papillary tips at key frames."""

    #: ``(f,)`` strictly increasing from 0 (reference frame) to 1 (closed frame). The loading
    #: defines the phase as a function of time.
    phase: FloatArray
    annulus: FloatArray  #: ``(f, n_annulus, 3)`` mm; entry 0 equals the reference positions
    papillary_tips: FloatArray  #: (f, n_tips, 3) mm

    def __post_init__(self) -> None:
        set_ = object.__setattr__
        set_(self, "phase", checked_floats("motion phase", self.phase, (None,)))
        f = len(self.phase)
        if f < 2 or self.phase[0] != 0 or self.phase[-1] != 1 or np.any(np.diff(self.phase) <= 0):
            raise InputError(f"motion phase {self.phase}: expected strictly increasing from 0 to 1")
        set_(self, "annulus", checked_floats("motion annulus", self.annulus, (f, None, 3)))
        tips = checked_floats("motion papillary_tips", self.papillary_tips, (f, None, 3))
        set_(self, "papillary_tips", tips)


@dataclass(frozen=True, slots=True, eq=False)
class Valve:
    """One valve in one resolution."""

    surface: LeafletSurface
    annulus: IntArray  #: ``(k,)`` vertices of ``surface`` along the annulus, in loop order
    free_edge: IntArray  #: ``(k2,)`` vertices along the free edge, in loop order
    papillary_tips: FloatArray  #: ``(n_tips, 3)`` mm in the reference frame
    chordae: Chordae
    motion: Motion  #: of the vertices ``annulus`` and of the tips

    def __post_init__(self) -> None:
        set_ = object.__setattr__
        n = len(self.surface.vertices)
        set_(self, "annulus", checked_indices("annulus", self.annulus, n, (None,)))
        set_(self, "free_edge", checked_indices("free_edge", self.free_edge, n, (None,)))
        tips = checked_floats("papillary_tips", self.papillary_tips, (None, 3))
        set_(self, "papillary_tips", tips)
        n_tips = len(tips)
        if len(self.chordae) and int(self.chordae.tip.max()) >= n_tips:
            i = int(np.argmax(self.chordae.tip))
            raise InputError(
                f"chord {i} starts at papillary tip {self.chordae.tip[i]}, but there are {n_tips}"
            )
        for what, moved, own in (
            ("annulus points", self.motion.annulus.shape[1], len(self.annulus)),
            ("papillary tips", self.motion.papillary_tips.shape[1], n_tips),
        ):
            if moved != own:
                raise InputError(f"motion moves {moved} {what}, the valve has {own}")
        if len(self.chordae):
            surface = self.surface.vertices, self.surface.triangles
            gap = closest_points(self.chordae.insertion, *surface).distance
            if np.max(gap) > MAX_CHORD_GAP_MM:
                i = int(np.argmax(gap))
                raise GeometryError(
                    f"chord {i} is disconnected: its insertion is {gap[i]:.1f} mm from the leaflets"
                )


class MaterialSurface(Protocol):
    """A valve in material coordinates, where each of n leaflets has ``360 / n`` degrees of phi."""

    @property
    def region_names(self) -> tuple[str, ...]:
        """Names of the leaflets."""

    @property
    def sections(self) -> tuple[int, ...]:
        """The leaflet in each section of phi, an index into ``region_names``."""

    def position(
        self, phi: FloatArray, s: FloatArray, zeta: FloatArray | float = 0.0
    ) -> FloatArray:
        """Reference positions ``(..., 3)`` mm of material points."""

    def fibre(self, phi: FloatArray, s: FloatArray, region: IntArray) -> FloatArray:
        """Unit fibre directions ``(..., 3)`` as seen from the leaflet ``region``."""

    def thickness(self, phi: FloatArray, s: FloatArray) -> FloatArray:
        """Thickness ``(k,)`` mm."""


def sampled_valve(
    shape: MaterialSurface,
    columns: int,
    rows: int,
    attached: Callable[[FloatArray], tuple[FloatArray, Chordae, Motion]],
) -> Valve:
    """A valve on a grid of ``columns x rows`` vertices.

    InputError if the numbers are too small or do not divide among the leaflets.

    Parameters
    ----------
    shape : MaterialSurface
    columns, rows : int
        Vertices around the valve, at least 8 and as many for each leaflet, and from annulus to free
        edge, at least 3.
    attached : callable
        Angles ``(columns,)`` of the annulus' vertices -> papillary tips ``(t, 3)`` mm, chordae, and
        the motion of annulus and tips.
    """
    sections, leaflets = np.array(shape.sections), len(shape.sections)
    if columns < 8 or columns % leaflets or rows < 3:
        raise InputError(
            f"valve of {columns} x {rows} vertices, expected a multiple of {leaflets} >= 8 x >= 3"
        )
    phi, s, triangles, region = band_grid(columns, rows, shape.sections)
    # A vertex between two leaflets belongs to the later one, at phi = 0 to the last one.
    of_vertex = sections[np.where(phi > 0, (phi * leaflets / 360.0).astype(np.int64), -1)]
    surface = LeafletSurface(
        shape.position(phi, s),
        triangles,
        region,
        shape.region_names,
        shape.fibre(phi, s, of_vertex),
        shape.thickness(phi, s),
    )
    annulus = np.arange(columns)
    return Valve(surface, annulus, annulus + (rows - 1) * columns, *attached(phi[:columns]))
