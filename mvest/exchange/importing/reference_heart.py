"""The mitral valve of a reference heart: thick leaflets and papillary muscles, each closed.

Nothing marks the papillary tips: they are found on the surfaces of the whole muscles.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter1d

from mvest.cases.case import Frame, Role, Uncertainty, ValveCase
from mvest.cases.chord_layout import LeafletBand, assumed_closure, lay_out_chordae
from mvest.cases.frames import MM_PER
from mvest.errors import GeometryError, InputError
from mvest.exchange.regions import part_of
from mvest.exchange.surfaces import SurfaceFile, read_surface
from mvest.quantities import Length, Share, Thickness
from mvest.typing import FloatArray
from mvest.valve.anatomy.dimensions import ChordLayout
from mvest.valve.anatomy.valve import LeafletSurface
from mvest.valve.geometry.midsurface import Midsurface, midsurface
from mvest.valve.geometry.surface_coordinates import surface_coordinates

HEAD_MM = 5.0
"""mm, height of the head of a muscle, from all of which its chordae rise."""
MIN_SLENDER = 1.5
"""Length of a muscle over its width, below which it has no long axis and so no tip."""


def papillary_tip(muscle: FloatArray, leaflets: FloatArray) -> FloatArray:
    """The middle ``(3,)`` mm of a muscle's head: its last `HEAD_MM` along its own long axis.

    Parameters
    ----------
    muscle
        ``(n, 3)`` mm, vertices of the muscle's surface.
    leaflets
        ``(m, 3)`` mm; the head is at the end that is nearer to their middle.

    Raises
    ------
    GeometryError
        The muscle is not longer than wide.
    """
    middle = muscle.mean(axis=0)
    _, _, axes = np.linalg.svd(muscle - middle, full_matrices=False)
    length, width = (float(np.ptp((muscle - middle) @ axis)) for axis in axes[:2])
    if length < MIN_SLENDER * width:
        raise GeometryError(
            f"papillary muscle near {np.round(middle, 1).tolist()}: {length:.1f} mm long and "
            f"{width:.1f} mm wide, so which end is its tip is not known; give tips instead"
        )
    axis = axes[0] * np.sign((leaflets.mean(axis=0) - middle) @ axes[0])
    along = (muscle - middle) @ axis
    return np.asarray(muscle[along >= along.max() - HEAD_MM].mean(axis=0))


DATA_VARIABLE = "MVEST_HRA"
"""Environment variable that names the file of the heart, or a folder with its parts."""
PARTS = (
    "mitral_valve.ply",
    "papillary_muscle_anterolateral.ply",
    "papillary_muscle_posteromedial.ply",
)
OBJECTS = (
    "VH_M_mitral_valve",
    "VH_M_papillary_muscle_of_heart_anterolateral",
    "VH_M_papillary_muscle_of_heart_posteromedial",
)
"""What the parts are called in the heart's own file, whose lengths are metres."""
CITATION = (
    "Browne K., Schlehlein H., Herr B. W., Quardokus E., Bueckle A., Börner K. 2022, 3D Reference "
    "Organ for Heart, Male v1.2, doi 10.48539/HBM373.VSTV.568, licence CC BY 4.0; midsurface, "
    "thickness, tips and chordae derived from it by mvest"
)
SHAPE_ALONE = (
    "One still shape, modelled by illustrators from sections of a male donor (Visible Human): its "
    "shape is all that is real. Motion, pressure, chordae and moduli are assumed, and nothing "
    "about the moduli of this donor follows."
)
REGIONS = ("anterior", "posterior")


@dataclass(frozen=True, slots=True)
class ReferenceHeartOptions:
    """What the three surfaces do not say, or say in more detail than a mesh follows.

    Attributes
    ----------
    smoothing_mm : float
        Standard deviation, along the annulus, of the weights with which lines round the valve are
        averaged; on shorter lines, such as the free edge, it is shorter in proportion.
    min_thickness_mm, max_thickness_mm : float
        Between which the thickness is kept: at the ends of the slit leaflets of their thickness
        would overlap, and where they grow out of the heart's skeleton the surface is no leaflet.
    closed_depth : float
        Of the free edges below the annulus, closed over open, for which the chordae are long
        enough.
    """

    smoothing_mm: Length = 4.0
    min_thickness_mm: Thickness = 0.3
    max_thickness_mm: Thickness = 3.0
    closed_depth: Share = 0.5

    def __post_init__(self) -> None:
        if not 0 <= self.smoothing_mm <= 10:
            raise InputError(f"smoothing_mm = {self.smoothing_mm}, expected 0 to 10")
        if not 0 < self.min_thickness_mm < self.max_thickness_mm <= 5:
            raise InputError(
                f"min_thickness_mm = {self.min_thickness_mm} and max_thickness_mm = "
                f"{self.max_thickness_mm}, expected 0 < min < max <= 5"
            )
        if not 0 <= self.closed_depth <= 1:
            raise InputError(f"closed_depth = {self.closed_depth}, expected 0 to 1")


def heart_files(place: Path | str | None = None) -> tuple[Path, ...]:
    """The heart's own file (GLB), or those of its parts in a folder; or where ``MVEST_HRA`` says.

    Raises
    ------
    InputError
        They are not there; the message says where to get them.
    """
    place = place or os.environ.get(DATA_VARIABLE)
    if place is not None and Path(place).suffix.lower() == ".glb" and Path(place).is_file():
        return (Path(place),)
    files = tuple(Path(place or ".") / name for name in PARTS)
    missing = [file.name for file in files if not file.is_file()]
    if place is None or missing:
        where = "no folder is named" if place is None else f"{place}: no {', '.join(missing)}"
        raise InputError(
            f"{where}. The reference heart is not part of this package: take "
            "v1.2/models/VH_M_Heart.glb from https://github.com/hubmapconsortium/ccf-releases and "
            f"name it here or in {DATA_VARIABLE}, or a folder with its parts in mm, "
            f"{', '.join(PARTS)}"
        )
    return files


def import_reference_heart(source: Path | None, options: ReferenceHeartOptions) -> ValveCase:
    """A case of an open frame alone from the thick valve and its papillary muscles.

    Midsurface, thickness, commissures and leaflets follow from the closed surface, the tips from
    the muscles; fibres run round the valve, and the chordae are laid out as in the template.

    Parameters
    ----------
    source : Path or None
        See `heart_parts`.
    options : ReferenceHeartOptions

    Raises
    ------
    InputError, GeometryError
        A part is missing or is none of a thick valve with two muscles.
    """
    valve, *muscles = heart_parts(source)
    tips = np.stack([papillary_tip(muscle.vertices, valve.vertices) for muscle in muscles])
    middle = midsurface(valve.vertices, valve.triangles, tips=tips)
    vertices, moved = _smoothed(middle, options.smoothing_mm)
    thickness = np.clip(middle.thickness, options.min_thickness_mm, options.max_thickness_mm)
    loops = middle.annulus, middle.free_edge
    coordinates = surface_coordinates(vertices, middle.triangles, *loops)
    surface = LeafletSurface(
        vertices, middle.triangles, middle.region, REGIONS, coordinates.circumferential, thickness
    )
    band = LeafletBand.of(vertices, middle.triangles, middle.region, *loops, anterior=0)
    closed = assumed_closure(band, vertices[middle.annulus], tips, options.closed_depth)
    chordae = lay_out_chordae(band, tips, closed, tips, ChordLayout())
    frame = Frame(
        "open",
        0.0,
        Role.REFERENCE,
        0.0,
        vertices,
        middle.triangles,
        middle.region,
        vertices[middle.annulus],
        vertices[middle.free_edge],
        tips,
        corresponds=True,
    )
    return ValveCase(
        name="mitral valve of a reference heart",
        description=SHAPE_ALONE,
        source=CITATION,
        licence="CC BY 4.0",
        simulated=False,
        surface=surface,
        annulus=middle.annulus,
        free_edge=middle.free_edge,
        frames=(frame,),
        chordae=chordae,
        uncertainty=Uncertainty(1.0, 10.0),
        derived=tuple(_derived(middle, moved, options, len(chordae))),
        chordae_follow=True,
    )


def heart_parts(source: Path | None) -> list[SurfaceFile]:
    """The closed surfaces of the thick valve and of its two muscles, mm.

    Parameters
    ----------
    source : Path or None
        The heart as its origin has it (``VH_M_Heart.glb``), or a folder with its parts in mm; None:
        what ``MVEST_HRA`` names.

    Raises
    ------
    InputError, GeometryError
        A part is missing or damaged.
    """
    files = heart_files(source)
    if len(files) > 1:
        return [read_surface(file) for file in files]
    heart = read_surface(files[0])
    parts = [part_of(heart, name) for name in OBJECTS]
    return [replace(part, vertices=MM_PER["m"] * part.vertices) for part in parts]


def _smoothed(middle: Midsurface, width_mm: float) -> tuple[FloatArray, float]:
    """Vertices ``(n, 3)`` averaged round the valve, and by how many mm one of them moves at most.

    The spike of the annulus and the ends of the slit are sharper than leaflets are thick.
    """
    columns = len(middle.annulus)
    grid = middle.vertices.reshape(-1, columns, 3)
    step = np.linalg.norm(np.roll(grid[0], -1, axis=0) - grid[0], axis=1).mean()
    smooth = gaussian_filter1d(grid, width_mm / step, axis=1, mode="wrap") if width_mm else grid
    vertices = smooth.reshape(-1, 3)
    return vertices, float(np.linalg.norm(vertices - middle.vertices, axis=1).max())


def _derived(
    middle: Midsurface, moved: float, options: ReferenceHeartOptions, chords: int
) -> Iterable[str]:
    yield "midsurface and thickness: the medial sheet of the closed surface"
    yield from middle.derived
    yield f"papillary tips: the middle of the last {HEAD_MM:g} mm of each muscle along its axis"
    yield (
        f"shape: smoothed round the valve over {options.smoothing_mm:g} mm of the annulus, which "
        f"moves it by at most {moved:.1f} mm"
    )
    low, high = options.min_thickness_mm, options.max_thickness_mm
    thin, thick = (
        100 * float(np.mean(outside))
        for outside in (middle.thickness < low, middle.thickness > high)
    )
    yield (
        f"thickness: kept between {low:g} mm ({thin:.0f} % of the vertices are thinner) and "
        f"{high:g} mm ({thick:.0f} % are thicker, up to {middle.thickness.max():.1f} mm)"
    )
    yield "fibre: circumferential, perpendicular to the gradient from annulus to free edge"
    yield (
        f"chordae: {chords} laid out as in the template, each to its nearer papillary tip, rest "
        "lengths from an assumed closure: the free edges meet half-way between where they are "
        f"open, at {options.closed_depth:g} of their depth below the annulus"
    )
    yield "annulus and papillary tips: they stay where they are, unless a motion is stated"
