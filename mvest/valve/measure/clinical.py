"""Clinical measurements of a valve in one frame, following the usual echocardiographic definitions.

Depth and height are distances from the annulus plane; *the middle section* is the plane through the
annulus centre that holds its normal and the anterior direction.

* ``annulus_area``: within the annulus seen along its normal; ``annulus_area_3d``: of the minimal
  surface in it. ``ap_diameter`` and ``commissural_diameter``: chords through the centre seen along
  the normal. ``height_to_width_ratio``: height over commissural diameter; ``sphericity_ratio``:
  anteroposterior over commissural diameter.
* ``tenting_height``: largest depth of the leaflets in the middle section; ``tenting_volume``:
  between annulus plane and leaflets, negative above the plane.
* ``prolapse``: leaflets above the annulus plane (a saddle-shaped annulus has some of it in every
  valve: Levine et al. 1987, Circulation 75:756); ``billow``: above the minimal surface instead.
* ``orifice``: area within the annulus that no leaflet covers seen along the normal.
* ``coaptation_length``: over which two leaflets touch in the middle section, the smaller of both;
  ``coaptation_area``: over which leaflets touch, half the sum over all of them.
* ``length`` of a leaflet: from annulus to free edge in the middle section.
* ``tip_depth``, ``tip_annulus_distance``: means over the papillary tips, the latter to the nearest
  annulus points; ``tip_separation``: between the tips.
"""

from collections.abc import Callable, Sequence
from typing import Any, Protocol, TypeAlias

import numpy as np

from mvest.errors import MvestError
from mvest.typing import FloatArray, IntArray
from mvest.valve.geometry.moving_distance import closest_on_loop
from mvest.valve.geometry.proximity import plane_section
from mvest.valve.geometry.triangles import areas
from mvest.valve.measure.annulus import (
    AnnulusPlane,
    annulus_plane,
    checked_loop,
    measure_annulus,
    spanning_surface,
)
from mvest.valve.measure.coaptation import (
    coaptation_area,
    coaptation_length,
    orifice_area,
    project_leaflets,
)

Numbers: TypeAlias = dict[str, float]
"""Name with its unit -> number."""

_NAMES = (
    "annulus_circumference_mm", "annulus_area_mm2", "annulus_area_3d_mm2", "ap_diameter_mm",
    "commissural_diameter_mm", "annulus_height_mm", "annulus_height_to_width_ratio",
    "annulus_sphericity_ratio", "tenting_height_mm", "tenting_volume_mm3", "prolapse_height_mm",
    "prolapse_volume_mm3", "billow_height_mm", "billow_volume_mm3", "orifice_mm2",
    "coaptation_length_mm", "coaptation_area_mm2", "tip_depth_mm", "tip_annulus_distance_mm",
    "tip_separation_mm",
)  # fmt: skip
_OF_LEAFLET, _OF_TIP = ("area_mm2", "length_mm"), ("depth_mm", "annulus_distance_mm")


class MeasuredLeaflets(Protocol):
    """Triangles of leaflets, such as a `LeafletSurface`."""

    @property
    def triangles(self) -> IntArray:
        """``(m, 3)``, normals to the ventricle."""

    @property
    def region(self) -> IntArray:
        """``(m,)`` leaflet of each triangle."""

    @property
    def region_names(self) -> tuple[str, ...]:
        """Of the leaflets, the anterior one first."""


def clinical_names(region_names: Sequence[str], tip_names: Sequence[str] = ()) -> list[str]:
    """All names that `clinical_measurements` can return for two leaflets, in order."""
    leaflets = [f"{name}_{ending}" for name in region_names for ending in _OF_LEAFLET]
    return [*_NAMES, *leaflets, *(f"{name}_{ending}" for name in tip_names for ending in _OF_TIP)]


def clinical_measurements(
    vertices: FloatArray,
    surface: MeasuredLeaflets,
    annulus: FloatArray,
    tips: FloatArray,
    contact_distance: float,
    *,
    tip_names: Sequence[str] = (),
) -> Numbers:
    """Measure a valve in one frame.

    Diameters, areas, height and circumference of the annulus are those of three-dimensional
    echocardiography (Grewal et al. 2010, Circulation 121:1423), its height over its width that of
    Salgo et al. 2002 (Circulation 106:711).

    Returns a dict: name with unit -> number. Measurements that the shape does not admit are
    missing; all are if the annulus has no plane.

    Parameters
    ----------
    vertices : (n, 3) mm
        Positions in this frame.
    surface : MeasuredLeaflets
        The first region is the anterior leaflet.
    annulus : (k, 3) mm
        In loop order.
    tips : (t, 3) mm
        Papillary tips.
    contact_distance : float
        mm between midsurfaces that count as touching.
    tip_names : sequence of str
        Names of the tips, such as ``tip_0``, to report each one as well as their mean.
    """
    try:
        plane = plane_of_leaflets(vertices, surface, annulus, tips)
    except MvestError:
        return {}
    triangles, region = surface.triangles, np.asarray(surface.region)
    leaflets = [triangles[region == number] for number in range(len(surface.region_names))]
    seen = vertices, triangles, annulus, plane
    numbers = _tried(_annulus, annulus, plane)
    numbers |= _tried(tenting, *seen)
    numbers |= _tried(_prolapse, *seen)
    numbers |= _tried(closure, *seen, leaflets, contact_distance)
    for name, own in zip(surface.region_names, leaflets, strict=True):
        numbers[f"{name}_area_mm2"] = float(areas(vertices, own).sum())
        if len(leaflets) == 2:
            numbers[f"{name}_length_mm"] = leaflet_length(vertices, own, plane)
    return numbers | _tips(tips, annulus, plane, tip_names)


def annulus_and_tips(
    vertices: FloatArray, surface: MeasuredLeaflets, annulus: FloatArray, tips: FloatArray
) -> Numbers:
    """The measurements of `clinical_measurements` that need no leaflets, a hundred times faster."""
    try:
        plane = plane_of_leaflets(vertices, surface, annulus, tips)
    except MvestError:
        return {}
    return _tried(_annulus, annulus, plane) | _tips(tips, annulus, plane, ())


def plane_of_leaflets(
    vertices: FloatArray, surface: MeasuredLeaflets, annulus: FloatArray, tips: FloatArray
) -> AnnulusPlane:
    """Plane of an annulus ``(k, 3)`` mm; leaflets and tips ``(t, 3)`` mm tell its sides."""
    # The middle of a leaflet's own annulus is nearest to that leaflet.
    first = np.unique(surface.triangles[surface.region == 0])
    gap = np.linalg.norm(annulus[:, None] - vertices[first][None], axis=2).min(axis=1)
    near = annulus[gap <= np.quantile(gap, 0.25)]
    return annulus_plane(annulus, tips.mean(axis=0), near.mean(axis=0))


def _tried(measure: Callable[..., Numbers], *shape: Any) -> Numbers:
    """Measurements, or none if the shape does not admit them."""
    try:
        return measure(*shape)
    except MvestError:
        return {}


def _annulus(annulus: FloatArray, plane: AnnulusPlane) -> Numbers:
    size = measure_annulus(annulus, plane)
    return {
        "ap_diameter_mm": size.anteroposterior_diameter,
        "commissural_diameter_mm": size.commissural_diameter,
        "annulus_height_mm": size.height,
        "annulus_height_to_width_ratio": size.height / size.commissural_diameter,
        "annulus_sphericity_ratio": size.anteroposterior_diameter / size.commissural_diameter,
        "annulus_circumference_mm": size.circumference,
        "annulus_area_mm2": size.projected_area,
    }


def tenting(
    vertices: FloatArray,
    triangles: IntArray,
    annulus: FloatArray,
    plane: AnnulusPlane,
    resolution: float = 0.2,
) -> Numbers:
    """Depth of the first leaflet surface seen from the atrium below the annulus plane.

    Lines of sight through an open orifice have no depth.

    Parameters
    ----------
    vertices, triangles
        Midsurface of all leaflets, ``(n, 3)`` mm and ``(m, 3)``.
    annulus, plane
        ``(k, 3)`` mm in loop order, and its plane.
    resolution
        Pixel size, mm.
    """
    image = project_leaflets(vertices, triangles, annulus, plane, resolution)
    seen = image.inside & np.isfinite(image.depth)
    depth = np.where(seen, image.depth, 0.0)
    middle = int(np.argmin(np.abs(image.lateral)))
    return {
        "tenting_height_mm": float(depth[:, middle].max()),
        "tenting_volume_mm3": float(depth.sum() * resolution**2),
    }


def _prolapse(
    vertices: FloatArray, triangles: IntArray, annulus: FloatArray, plane: AnnulusPlane
) -> Numbers:
    """The first leaflet surface seen from the atrium above the plane and the minimal surface."""
    film, step = spanning_surface(annulus, plane), 0.2
    image = project_leaflets(vertices, triangles, annulus, plane, step)
    below = project_leaflets(*film, annulus, plane, step).depth
    seen = image.inside & np.isfinite(image.depth)
    over_plane = np.where(seen, np.maximum(-image.depth, 0.0), 0.0)
    both = seen & np.isfinite(below)
    over_film = np.zeros_like(over_plane)
    over_film[both] = np.maximum(below[both] - image.depth[both], 0.0)
    return {
        "annulus_area_3d_mm2": float(areas(*film).sum()),
        "prolapse_height_mm": float(over_plane.max()),
        "prolapse_volume_mm3": float(over_plane.sum() * step**2),
        "billow_height_mm": float(over_film.max()),
        "billow_volume_mm3": float(over_film.sum() * step**2),
    }


def closure(
    vertices: FloatArray,
    triangles: IntArray,
    annulus: FloatArray,
    plane: AnnulusPlane,
    leaflets: Sequence[IntArray],
    reach: float,
) -> Numbers:
    """Orifice and coaptation; the middle section of two leaflets alone shows how long they touch.

    Parameters
    ----------
    vertices, triangles, annulus, plane
        As in `tenting`.
    leaflets : sequence of (m, 3) arrays
        Triangles of each leaflet, the anterior one first.
    reach : float
        mm between midsurfaces that count as touching.
    """
    numbers = {"orifice_mm2": orifice_area(vertices, triangles, annulus, plane)}
    if len(leaflets) == 2:
        length = coaptation_length(vertices, leaflets[0], leaflets[1], plane, reach)
        numbers["coaptation_length_mm"] = length
    return numbers | {"coaptation_area_mm2": coaptation_area(vertices, leaflets, reach)}


def leaflet_length(vertices: FloatArray, triangles: IntArray, plane: AnnulusPlane) -> float:
    """Length (mm) of a leaflet's ``triangles`` from annulus to free edge in the middle section."""
    segments, _ = plane_section(vertices, triangles, plane.origin, plane.lateral)
    return float(np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1).sum())


def _tips(
    tips: FloatArray, annulus: FloatArray, plane: AnnulusPlane, names: Sequence[str]
) -> Numbers:
    depth = plane.coordinates(tips)[:, 2]
    away = np.linalg.norm(closest_on_loop(tips, checked_loop(annulus))[2], axis=1)
    numbers: Numbers = {
        "tip_depth_mm": float(depth.mean()),
        "tip_annulus_distance_mm": float(away.mean()),
    }
    if len(tips) == 2:
        numbers["tip_separation_mm"] = float(np.linalg.norm(tips[0] - tips[1]))
    for k, name in enumerate(names):
        numbers[f"{name}_depth_mm"] = float(depth[k])
        numbers[f"{name}_annulus_distance_mm"] = float(away[k])
    return numbers
