"""Thickness, fibres and chordae of a case, given or derived.

A two-leaflet valve without chordae gets those of the template's layout, in the template's
coordinates. The template (`mvest.valve.anatomy.template`) places its chordae by an angle phi, with
the commissures at 0 and 180 degrees and the anterior leaflet between them, and by s from the
annulus to the free edge. Any band has harmonic coordinates
(`mvest.valve.geometry.surface_coordinates`), but their angle is not distributed along the edges as
the template's is, and the borders between the leaflets are not lines of constant angle. So phi is
the share of the arc length between the commissures, on the annulus (s = 0) and on the free edge (s
= 1). Between the two, the harmonic angle of a phi is linear in s.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TypeAlias

import numpy as np

from mvest.cases.band import arc_shares, check_thickness, commissures, directed, loop_vector_area
from mvest.cases.case import Frame, Role
from mvest.cases.frames import MM_PER, CheckedFrame, SeenFrame
from mvest.cases.schema import CaseFolder, PointData
from mvest.errors import GeometryError, InputError
from mvest.reading.text import indices, numbers, one_line, read_columns, write_columns
from mvest.typing import FloatArray, IntArray
from mvest.valve.anatomy.dimensions import ChordLayout, TemplateParameters
from mvest.valve.anatomy.template import Template, laid_out, vertex_region
from mvest.valve.anatomy.valve import Chordae, LeafletSurface, vertex_normals
from mvest.valve.geometry.surface_coordinates import (
    SurfaceCoordinates,
    surface_coordinates,
    wrapped,
)

CHORD_COLUMNS = ("tip", "x", "y", "z", "family", "rest_length_mm", "stiffness_n")
BRANCH_COLUMNS = ("start", "end")
"""Names of the branching points at which a segment starts and ends; empty at tips and leaflets."""
MAX_SEGMENTS = 5000
GENERIC_THICKNESS = {"anterior": 1.32, "posterior": 1.26}
"""mm, the method paper's values (ISBI 2013)."""

CLOSED_DEPTH = 0.74
"""Depth of the free edge below the annulus, closed over open, if there is no closed frame: the mean
(SD 0.02) in the 13 of 16 simulated valves that closed, varied from the template with random moduli
(36 x 4 cells). The depth falls from 13.2 to 9.8 mm on average."""

SEEN_CLOSURE = replace(ChordLayout(), marginal_slack=1.003, basal_slack=1.005)
"""The template's layout for an observed closed valve instead of the template's intended closure.

Under pressure a valve does not close exactly as intended, and its chordae are stretched. In the
thirteen valves of `CLOSED_DEPTH`, rest length over the length in the closed valve, from tip to
leaflet end through a junction as `laid_out` places it, is 1.003 (SD from way to way 0.025, from
valve to valve 0.006, marginal) and 1.005 (0.027, 0.009, basal 1.011 and strut 0.987 together)."""

SEEN_ON_BAND = replace(ChordLayout(), marginal_slack=0.997, basal_slack=0.993)
"""The same for chordae placed by a `LeafletBand`, which shifts them by up to 2.1 mm: 0.997 (SD from
way to way 0.024, marginal) and 0.993 (0.041, basal 1.012 and strut 0.935) in these valves."""

Positions: TypeAlias = Callable[[FloatArray, FloatArray], FloatArray]
"""Positions ``(k, 3)`` mm of points at phi (degrees) and s, such as `LeafletBand.position`."""


def read_leaflets(folder: CaseFolder, reference: CheckedFrame) -> LeafletSurface:
    """The midsurface of the reference frame; assumptions are added to ``derived``."""
    seen, names = reference.seen, folder.document.region_names
    n = len(seen.vertices)
    shape = seen.vertices, seen.triangles, reference.region, names
    bare = LeafletSurface(*shape, np.tile([1.0, 0.0, 0.0], (n, 1)), np.ones(n))
    with folder.at("thickness"):
        thickness = _thickness(folder, reference, names, bare.vertex_region)
        check_thickness(thickness)
    with folder.at("fibre"):
        fibre = _fibre(folder, reference)
    return LeafletSurface(*shape, fibre, thickness)


def _thickness(
    folder: CaseFolder, reference: CheckedFrame, names: tuple[str, ...], vertex_region: IntArray
) -> FloatArray:
    given, seen = folder.document.thickness, reference.seen
    if isinstance(given, PointData):
        return MM_PER[folder.document.units.length] * point_data(seen, given.point_data, 1)[:, 0]
    if isinstance(given, float):
        return np.full(len(seen.vertices), given)
    if given is None:
        if sorted(names) != sorted(GENERIC_THICKNESS):
            missing = [name for name in names if name not in GENERIC_THICKNESS] or names
            raise InputError(
                f"none for the region {', '.join(missing)}; give one in mm, or name the regions "
                "anterior and posterior (not Anterior, AML or PML)"
            )
        listed = ", ".join(f"{GENERIC_THICKNESS[name]:g} mm ({name})" for name in names)
        folder.derived.append(f"thickness: {listed} assumed next to the annulus, and thinner edges")
        return _band_of(reference, names).thickness
    if missing := [name for name in names if name not in given]:
        raise InputError(f"none for the region {', '.join(missing)}; give one in mm")
    if unknown := [name for name in given if name not in names]:
        raise InputError(f"unknown region {unknown[0]!r}; known are {', '.join(names)}")
    return np.array([given[name] for name in names])[vertex_region]


def _fibre(folder: CaseFolder, reference: CheckedFrame) -> FloatArray:
    seen, names = reference.seen, folder.document.region_names
    if folder.document.fibre is not None:
        return point_data(seen, folder.document.fibre, 3)
    around = "fibre: circumferential, perpendicular to the gradient from annulus to free edge"
    if sorted(names) != sorted(GENERIC_THICKNESS):
        folder.derived.append(around)
        loops = reference.annulus, reference.free_edge
        return surface_coordinates(seen.vertices, seen.triangles, *loops).circumferential
    folder.derived.append(f"{around}, turning to it in the anterior leaflet near the commissures")
    return _band_of(reference, names).fibre


def _band_of(frame: CheckedFrame, names: tuple[str, ...]) -> LeafletBand:
    loops = frame.annulus, frame.free_edge
    return LeafletBand.of(*frame.labelled, *loops, names.index("anterior"))


def point_data(seen: SeenFrame, name: str, components: int) -> FloatArray:
    """Finite point data ``(n, components)`` of the reference surface."""
    if name not in seen.point_data:
        listed = ", ".join(sorted(seen.point_data)) or "none"
        raise InputError(
            f"the reference surface has no point data {name!r}; found {listed} (only .vtp, .vtu "
            "and .vtk hold any)"
        )
    values = np.asarray(seen.point_data[name], dtype=np.float64).reshape(len(seen.vertices), -1)
    if values.shape[1] != components:
        raise InputError(
            f"point data {name!r} has {values.shape[1]} components, expected {components}"
        )
    bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
    if len(bad):
        raise GeometryError(f"point data {name!r} is not finite at vertices {bad[:5].tolist()}")
    return values


def read_chordae(
    folder: CaseFolder, reference: CheckedFrame, placed: list[tuple[Frame, CheckedFrame]]
) -> Chordae:
    """The chordae of the table, or laid out, which is added to ``derived``."""
    entry = folder.document.chordae
    if entry is None:
        with folder.at("chordae"):
            return _laid_out(folder, reference, placed)
    file = folder.file(entry.file, "chordae")
    if "toe_strain" not in entry.model_fields_set:
        folder.derived.append(f"chordae: toe strain {entry.toe_strain:g} assumed")
    measured = ("x", "y", "z", "rest_length_mm", "stiffness_n")
    with folder.at("chordae"):
        columns = read_columns(file, CHORD_COLUMNS, optional=BRANCH_COLUMNS)
        tip = indices(file, "tip", columns["tip"])
        order, leaflet_ends, parent = _branching(file, tip, columns)
        names = entry.families or list(dict.fromkeys(columns["family"]))
        for row, name in enumerate(columns["family"]):
            if name not in names:
                raise InputError(
                    f"{file}: family of row {row} is {name!r}; known are {', '.join(names)}"
                )
        x, y, z, length, stiffness = (numbers(file, name, columns[name]) for name in measured)
        points = MM_PER[folder.document.units.length] * np.column_stack([x, y, z])[order]
        family = np.array([names.index(name) for name in columns["family"]], dtype=np.int64)
        return Chordae(
            tip=tip[order],
            insertion=points[:leaflet_ends],
            family=family[order],
            family_names=tuple(names),
            rest_length=length[order],
            axial_stiffness=stiffness[order],
            toe_strain=entry.toe_strain,
            junction=points[leaflet_ends:],
            parent=parent[order],
        )


def _branching(
    file: Path, tip: IntArray, columns: Mapping[str, list[str]]
) -> tuple[IntArray, int, IntArray]:
    """Rows in the order of `Chordae`, the number of leaflet ends, and the parent of each row."""
    if len(tip) > MAX_SEGMENTS:
        raise InputError(f"{file}: {len(tip)} rows, expected at most {MAX_SEGMENTS}")
    starts, ends = (columns.get(name, [""] * len(tip)) for name in BRANCH_COLUMNS)
    trunk: dict[str, int] = {}
    for row, end in enumerate(ends):
        if end and trunk.setdefault(end, row) != row:
            raise InputError(
                f"{file}: end of row {row} is {end!r} as that of row {trunk[end]}, expected one "
                "row that ends at a branching point"
            )
    known = one_line(", ".join(trunk) or "none", 80)
    for row, (start, end) in enumerate(zip(starts, ends, strict=True)):
        if start and start not in trunk:
            raise InputError(
                f"{file}: start of row {row} is {start!r}, expected a name in the column end "
                f"({known}), or nothing at a papillary tip"
            )
        if end and end not in starts:
            raise InputError(
                f"{file}: end of row {row} is {end!r}, expected a name in the column start, or "
                "nothing on a leaflet"
            )
        if start and tip[row] != tip[trunk[start]]:
            raise InputError(
                f"{file}: tip of row {row} is {tip[row]}, expected {tip[trunk[start]]} as in row "
                f"{trunk[start]}, from which it branches"
            )
    rooted, waiting = {""}, dict(trunk)
    while found := [name for name, row in waiting.items() if starts[row] in rooted]:
        rooted.update(found)
        waiting = {name: row for name, row in waiting.items() if name not in rooted}
    for row in waiting.values():
        raise InputError(
            f"{file}: start of row {row} is {starts[row]!r}, in a cycle; expected a way from a "
            "papillary tip"
        )
    number = {name: k for k, name in enumerate(trunk)}
    on_leaflet = [row for row, end in enumerate(ends) if not end]
    order = np.array([*on_leaflet, *trunk.values()], dtype=np.int64)
    parent = np.array([number.get(start, -1) for start in starts], dtype=np.int64)
    return order, len(on_leaflet), parent


def write_chordae(file: Path, chordae: Chordae) -> None:
    """Write the table of chordae, without `BRANCH_COLUMNS` if none branches; lengths in mm."""
    names: tuple[str, ...] = CHORD_COLUMNS
    points = np.concatenate([chordae.insertion, chordae.junction])
    families = [chordae.family_names[k] for k in chordae.family]
    lengths, stiffness = chordae.rest_length.tolist(), chordae.axial_stiffness.tolist()
    columns = [chordae.tip.tolist(), *points.T.tolist(), families, lengths, stiffness]
    if len(chordae.junction):
        names += BRANCH_COLUMNS
        columns.append(["" if k < 0 else f"b{k}" for k in chordae.parent.tolist()])
        columns.append(
            [""] * len(chordae.insertion) + [f"b{k}" for k in range(len(chordae.junction))]
        )
    write_columns(file, names, zip(*columns, strict=True))


def _laid_out(
    folder: CaseFolder, reference: CheckedFrame, placed: list[tuple[Frame, CheckedFrame]]
) -> Chordae:
    names = folder.document.region_names
    seen = reference.seen
    if len(names) != 2 or "anterior" not in names or len(seen.tips) != 2:
        raise InputError(
            f"missing; it can be left out only for two regions, one of them named anterior, and "
            f"two papillary tips (here: {', '.join(names)}; {len(seen.tips)} tips)"
        )

    opened = _band_of(reference, names)
    closed, band = next((p for p in placed if p[0].role is Role.CLOSED), placed[0])
    layout = SEEN_ON_BAND
    if closed.role is not Role.CLOSED:
        layout = ChordLayout()
        how = (
            "an assumed closure: the free edges meet half-way between their open positions, at "
            f"{CLOSED_DEPTH:g} of their depth below the annulus"
        )
        goal = assumed_closure(opened, closed.annulus, closed.papillary_tips)
    elif closed.corresponds:
        how = "the closed frame (through its vertices)"
        goal = replace(opened, vertices=closed.vertices)
    else:
        how = "the closed frame (through the same material coordinates in it)"
        goal = _band_of(band, names)
    chordae = lay_out_chordae(
        opened.position, seen.tips, goal.position, closed.papillary_tips, layout
    )
    folder.derived.append(
        f"chordae: {len(chordae.insertion)} leaflet ends laid out as in the template, those of a "
        f"half to its nearer papillary tip, rest lengths from {how}"
    )
    return chordae


@dataclass(frozen=True, eq=False)
class LeafletBand:
    """A two-leaflet surface with the template's coordinates."""

    vertices: FloatArray  #: (n, 3) mm
    coordinates: SurfaceCoordinates
    annulus_angle: FloatArray  #: (2, k), phi (0 to 360 degrees), harmonic angle (rad, unwrapped)
    edge_angle: FloatArray  #: the same along the free edge

    @classmethod
    def of(
        cls,
        vertices: FloatArray,
        triangles: IntArray,
        region: IntArray,
        annulus: IntArray,
        free_edge: IntArray,
        anterior: int,
    ) -> LeafletBand:
        """Solve for the coordinates of a band; ``anterior`` is the number of that leaflet.

        GeometryError if the coordinates fold over, or a leaflet does not meet the annulus or the
        free edge in one piece.
        """
        around, edge = directed(annulus, triangles), directed(free_edge, triangles)
        coordinates = surface_coordinates(vertices, triangles, around, free_edge)
        pieces, of_edge = (commissures(loop, triangles, region) for loop in (around, edge))
        on_annulus = _angle_table(vertices, pieces, around, coordinates.theta, anterior)
        # The free edge runs against the annulus.
        on_edge = _angle_table(vertices, of_edge, edge, coordinates.theta, anterior, backwards=True)
        on_edge[1] += 2 * np.pi * np.round((on_annulus[1, 0] - on_edge[1, 0]) / (2 * np.pi))
        return cls(vertices, coordinates, on_annulus, on_edge)

    @cached_property
    def phi(self) -> FloatArray:
        """Phi ``(n,)`` of the vertices, degrees; linear in s between annulus and free edge."""
        theta, s = self.coordinates.theta, self.coordinates.s
        around, along = (
            np.interp(angle[0] + np.mod(theta - angle[0], 2 * np.pi), angle, phi)
            for phi, angle in (self.annulus_angle, self.edge_angle)
        )
        return np.asarray(np.mod(around + s * np.degrees(wrapped(np.radians(along - around))), 360))

    @property
    def thickness(self) -> FloatArray:
        """The template's thickness ``(n,)`` mm."""
        return Template(TemplateParameters()).thickness(self.phi, self.coordinates.s)

    @property
    def fibre(self) -> FloatArray:
        """The template's fibre directions ``(n, 3)``; the triangles face the ventricle."""
        around, normal = (
            self.coordinates.circumferential,
            vertex_normals(self.vertices, self.coordinates.triangles),
        )
        angle = Template(TemplateParameters()).fibre_angle(self.phi, vertex_region(self.phi))
        down = np.cross(around, normal)
        return np.asarray(np.cos(angle)[:, None] * around - np.sin(angle)[:, None] * down)

    def locate(self, phi: FloatArray, s: FloatArray) -> tuple[IntArray, FloatArray]:
        """Corners ``(k, 3)`` and weights ``(k, 3)`` of points at phi (degrees) and s."""
        turn = np.mod(phi, 360.0)
        theta = (1 - s) * np.interp(turn, *self.annulus_angle)
        theta += s * np.interp(turn, *self.edge_angle)
        triangle, weights = self.coordinates.locate(np.mod(theta, 2 * np.pi), s)
        return self.coordinates.triangles[triangle], weights

    def position(self, phi: FloatArray, s: FloatArray) -> FloatArray:
        """Positions ``(k, 3)`` mm of points at phi (degrees) and s."""
        return weighted(self.vertices, *self.locate(phi, s))


def _angle_table(
    vertices: FloatArray,
    pieces: dict[int, tuple[int, int]],
    loop: IntArray,
    theta: FloatArray,
    anterior: int,
    backwards: bool = False,
) -> FloatArray:
    """Phi (degrees) and harmonic angle (rad, unwrapped) ``(2, k)`` along a loop in its pieces."""
    tables = []
    for label in sorted(pieces, key=lambda piece: piece != anterior):
        positions, share = arc_shares(vertices[loop], *pieces[label])
        if backwards:
            positions, share = positions[::-1], 1.0 - share[::-1]
        start = 0.0 if label == anterior else 180.0
        tables.append((start + 180.0 * share, theta[loop[positions]]))
    phi, angle = (np.concatenate(parts) for parts in zip(*tables, strict=True))
    return np.stack([phi, np.unwrap(angle)])


def weighted(vertices: FloatArray, corners: IntArray, weights: FloatArray) -> FloatArray:
    """Points ``(k, 3)`` in triangles with these corners and weights ``(k, 3)``."""
    result: FloatArray = np.einsum("ka,kai->ki", weights, vertices[corners])
    return result


def assumed_closure(
    open_valve: LeafletBand,
    annulus: FloatArray,
    tips: FloatArray,
    closed_depth: float = CLOSED_DEPTH,
) -> LeafletBand:
    """The band with assumed positions of its vertices in the closed valve, from its open shape.

    The free edges of the two leaflets meet half-way, at points of equal share between the
    commissures, at ``closed_depth`` of their depth below the annulus. Leaflets follow in proportion
    to their coordinate s. A valve does not close like this, but the shape determines how long
    chordae must be to let it close. The annulus ``(k, 3)`` mm is in loop order, the tips ``(t, 3)``
    mm are on the ventricular side.
    """
    phi, theta = open_valve.edge_angle
    here, there = (open_valve.position(turn, np.ones(len(phi))) for turn in (phi, 360.0 - phi))
    goal = 0.5 * (here + there)
    centre, normal = annulus.mean(axis=0), loop_vector_area(annulus)
    down = normal / np.linalg.norm(normal) * np.sign((tips.mean(axis=0) - centre) @ normal)
    depth = (goal - centre) @ down
    move = goal - (1 - closed_depth) * depth[:, None] * down - here
    coordinates = open_valve.coordinates
    along = [np.interp(coordinates.theta, theta, each, period=2 * np.pi) for each in move.T]
    moved = coordinates.s[:, None] * np.stack(along, axis=1)
    return replace(open_valve, vertices=open_valve.vertices + moved)


def lay_out_chordae(
    open_valve: Positions,
    open_tips: FloatArray,
    closed_valve: Positions,
    closed_tips: FloatArray,
    layout: ChordLayout,
) -> Chordae:
    """Place the chordae of a layout on a valve with two papillary tips ``(2, 3)`` mm.

    All chordae of a half start at one tip: the one to which their sum of distances in the reference
    frame is least. Rest lengths are those of `laid_out`. The layout is the template's for an
    intended closed frame (`assumed_closure`); for an observed one `SEEN_CLOSURE`, or `SEEN_ON_BAND`
    if the valves are bands. InputError if there are not two tips.
    """
    if len(open_tips) != 2 or len(closed_tips) != 2:
        raise InputError(f"{len(open_tips)} papillary tips; the layout of chordae needs two")
    places = Template(TemplateParameters(chordae=layout)).chord_places()
    insertion, closed = (at(places.phi, places.s) for at in (open_valve, closed_valve))
    own = places.tip[: len(insertion)]
    reach = [np.linalg.norm(insertion - open_tips[end], axis=1).sum() for end in (own, 1 - own)]
    tip = places.tip if reach[0] <= reach[1] else 1 - places.tip
    ends, tips = (insertion, closed), (open_tips, closed_tips)
    return laid_out(places._replace(tip=tip), layout, ends, tips)
