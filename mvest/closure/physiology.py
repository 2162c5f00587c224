"""Physiology of a closed valve beside the literature, and the tissue through which moduli act.

`physiology` measures strain, stress, coaptation, chordae and size of a closed valve. Quantities
stand beside the ranges of ``physiology.toml`` and are marked if they are outside. The ranges are
those of normal mitral valves; a valve with other leaflets than two has none.

The belly of a leaflet is what touches no leaflet that faces it, within the reach of the contact.
Strain is that from the open to the closed shape of the midsurface, as in animals with markers. The
tenting height is the depth of the coaptation point below the annulus plane, the tenting area that
below the line between the hinges of both leaflets.

`resistance_rows` says by which tissue a leaflet resists (`mvest.mechanics.resistance`).
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mvest.closure.model import ClosureModel
from mvest.closure.stress import peak_stress
from mvest.mechanics.resistance import (
    WAYS,
    has_one_layer,
    information_shares,
    sensitivity_parts,
    work_shares,
)
from mvest.mechanics.system import Loads, System
from mvest.mechanics.valve_system import boundary_loading
from mvest.typing import BoolArray, FloatArray
from mvest.valve.anatomy.valve import Valve
from mvest.valve.geometry.triangles import areas
from mvest.valve.measure.clinical import Numbers, clinical_measurements, plane_of_leaflets
from mvest.valve.measure.coaptation import (
    coaptation_depth,
    find_gap,
    project_leaflets,
    touching_triangles,
)
from mvest.valve.measure.strain import triangle_strains, weighted_quantiles

MITRAL: dict[str, dict[str, Any]] = tomllib.loads(
    Path(__file__).with_name("physiology.toml").read_text(encoding="utf-8")
)
"""Quantity, or quantity and part -> ``low`` and ``high`` of its published range, and ``source``."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One quantity of a valve and its published range."""

    quantity: str
    part: str  #: leaflet, family of chordae, papillary tip, annulus or valve
    value: float  #: a median over the area if there are quantiles
    unit: str
    p5: float | None = None  #: quantile by area
    p95: float | None = None  #: quantile by area
    low: float | None = None  #: end of the published range; None: open
    high: float | None = None  #: end of the published range; None: open
    source: str = ""  #: of the range, empty without one
    mark: str = ""  #: ``inside``, ``outside``, or empty without a range

    def beside(self, low: float = -np.inf, high: float = np.inf, source: str = "") -> Finding:
        """The same with a range, open at missing ends, and the mark that follows."""
        ends = {name: end for name, end in (("low", low), ("high", high)) if np.isfinite(end)}
        mark = "inside" if low <= self.value <= high else "outside"
        return replace(self, **ends, source=source, mark=mark if ends else "")


def physiology(model: ClosureModel, system: System, x: FloatArray) -> tuple[Finding, ...]:
    """Measure a closed valve.

    Quantities that its shape does not admit are left out, as those of coaptation lines are for
    other than two leaflets.

    Parameters
    ----------
    model : ClosureModel
    system : System
        The model's, at the parameters for which ``x`` is in equilibrium.
    x : (n, 3) mm
        Nodal positions.

    Raises
    ------
    InputError
        If an element is turned inside out.
    """
    valve, shape = model.valve, model.observed(x)
    loads = closed_loads(model, system)
    found = [
        *_strains(valve, shape, model.contact_reach_mm),
        *_stresses(valve, peak_stress(system, x)),
        *_closed_shape(valve, shape, loads, model.contact_reach_mm),
        *_chordae(chord_loads(system, x, loads)),
        *_open_shape(valve),
    ]
    return _marked(valve, found)


def open_physiology(valve: Valve) -> tuple[Finding, ...]:
    """What is known of a valve that was not closed: leaflets, orifice and annulus."""
    return _marked(valve, _open_shape(valve))


def _marked(valve: Valve, found: Iterable[Finding]) -> tuple[Finding, ...]:
    known = MITRAL if len(valve.surface.region_names) == 2 else {}
    return tuple(
        one.beside(**known.get(f"{one.quantity}, {one.part}", known.get(one.quantity, {})))
        for one in found
        if np.isfinite(one.value)
    )


def closed_loads(model: ClosureModel, system: System) -> Loads:
    """The loads at the end of the closure."""
    loading = boundary_loading(system, model.valve, model.contact_valve, model.settings)
    return loading(model.settings.protocol.steps()[-1].time)


class ChordLoads(NamedTuple):
    """What the chordae bear: ``force (c,)`` N and ``strain (c,)``, negative if slack.

    ``at_tip (t, 3)`` N is their pull on each papillary tip, ``families`` the members ``(c,)`` of
    each.
    """

    force: FloatArray
    strain: FloatArray
    at_tip: FloatArray
    families: dict[str, BoolArray]


def chord_loads(system: System, x: FloatArray, loads: Loads) -> ChordLoads:
    """What the chordae bear at nodal positions ``x (n, 3)`` mm; empty without chordae."""
    cables, at_tip = system.cables, np.zeros_like(loads.tips)
    if cables is None:
        return ChordLoads(np.zeros(0), np.zeros(0), at_tip, {})
    pull = cables.forces(x, loads.tips, *system.factors.chordae)[0]
    np.add.at(at_tip, cables.tip, pull)
    strain = cables.strain(x, loads.tips, system.factors.chord_rest_length)
    return ChordLoads(np.linalg.norm(pull, axis=1), strain, at_tip, dict(cables.families))


def _strains(valve: Valve, shape: FloatArray, reach: float) -> Iterator[Finding]:
    surface = valve.surface
    strain = 100.0 * triangle_strains(surface.vertices, shape, surface)
    size = areas(surface.vertices, surface.triangles)
    free = ~touching_triangles(shape, surface.triangles, reach)
    for number, name in enumerate(surface.region_names):
        leaflet = surface.region == number
        belly = leaflet & free
        for k, way in enumerate(("along", "across")) if belly.any() else ():
            low, middle, high = weighted_quantiles(strain[belly, k], size[belly], (0.05, 0.5, 0.95))
            yield Finding(f"membrane strain {way} the fibres", name, middle, "%", low, high)
        for what, own in (("belly", belly), ("leaflet", leaflet)):
            if own.any():
                share = 100.0 * float(size[own & (strain[:, 0] < 0)].sum() / size[own].sum())
                yield Finding(f"{what} compressed along the fibres", name, share, "% of area")


def _stresses(valve: Valve, peaks: dict[str, float]) -> Iterator[Finding]:
    for name in valve.surface.region_names:
        for kind, words in (("p99", "99 % of the principal stress"), ("max", "largest stress")):
            yield Finding(words, name, peaks[f"stress_{kind}_{name}_mpa"], "MPa")


def _closed_shape(valve: Valve, shape: FloatArray, loads: Loads, reach: float) -> Iterator[Finding]:
    surface, ring = valve.surface, shape[valve.annulus]
    plane = plane_of_leaflets(shape, surface, ring, loads.tips)
    closed = clinical_measurements(shape, surface, ring, loads.tips, reach)
    image = project_leaflets(shape, surface.triangles, ring, plane, 0.2)
    middle = int(np.argmin(np.abs(image.lateral)))
    seen = image.inside[:, middle] & np.isfinite(image.depth[:, middle])
    if len(surface.region_names) == 2:
        pair = [surface.triangles[surface.region == k] for k in (0, 1)]
        height = closed.get("coaptation_length_mm", np.nan)
        yield Finding("coaptation height, middle section", "valve", height, "mm")
        area = closed.get("coaptation_area_mm2", np.nan)
        yield Finding("coaptation area", "valve", area, "mm²")
        depth = coaptation_depth(shape, pair[0], pair[1], plane, reach)
        yield Finding("tenting height", "valve", depth, "mm")
    depths = image.depth[seen, middle]
    hinges = np.linspace(depths[0], depths[-1], len(depths)) if len(depths) else 0.0
    tented = 0.2 * float((depths - hinges).sum())
    yield Finding("tenting area, middle section", "valve", tented, "mm²")
    volume = closed.get("tenting_volume_mm3", np.nan)
    yield Finding("tenting volume", "valve", volume, "mm³")
    gap = find_gap(shape, surface.triangles, ring, plane, reach).area
    yield Finding("closed gap", "valve", gap, "mm²")
    before = _open(valve)
    for words, name in SIZES.items():
        size = closed.get(name, np.nan)
        yield Finding(f"{words}, closed", "annulus", size, "mm²" if words == "area" else "mm")
        change = 100.0 * (size / before.get(name, np.nan) - 1.0)
        yield Finding(f"{words}, change", "annulus", change, "%")
    ratio = 100.0 * closed.get("annulus_height_to_width_ratio", np.nan)
    yield Finding("height over commissural diameter, closed", "annulus", ratio, "%")


SIZES = {
    "anteroposterior diameter": "ap_diameter_mm",
    "commissural diameter": "commissural_diameter_mm",
    "height": "annulus_height_mm",
    "area": "annulus_area_mm2",
}
"""Sizes of the annulus -> their clinical measurements."""


def _chordae(chords: ChordLoads) -> Iterator[Finding]:
    for k, pull in enumerate(chords.at_tip):
        force = float(np.linalg.norm(pull))
        yield Finding("force on a papillary tip", f"tip {k + 1}", force, "N")
    for family, own in chords.families.items():
        if not own.any():
            continue
        force, strain = chords.force[own], chords.strain[own]
        yield Finding("mean chordal force", family, float(force.mean()), "N")
        yield Finding("largest chordal force", family, float(force.max()), "N")
        yield Finding("largest chordal strain", family, 100.0 * float(strain.max()), "%")
        yield Finding("slack chordae", family, float((strain <= 0).sum()), f"of {own.sum()}")


def _open(valve: Valve) -> Numbers:
    surface, tips = valve.surface, valve.papillary_tips
    return clinical_measurements(
        surface.vertices, surface, surface.vertices[valve.annulus], tips, 0.0
    )


def _open_shape(valve: Valve) -> Iterator[Finding]:
    measured, names = _open(valve), valve.surface.region_names
    own = [measured[f"{name}_area_mm2"] for name in names if f"{name}_area_mm2" in measured]
    for name, size in zip(names, own, strict=False):
        yield Finding("area", name, size, "mm²")
        length = measured.get(f"{name}_length_mm", np.nan)
        yield Finding("length, middle section", name, length, "mm")
    if len(own) == 2:
        yield Finding("posterior over anterior area", "valve", own[1] / own[0], "")
    ring = measured.get("annulus_area_3d_mm2", np.nan)
    yield Finding("leaflet over annulus area", "valve", sum(own) / ring, "")
    yield Finding("open orifice", "valve", measured.get("orifice_mm2", np.nan), "mm²")


def modulus_parts(model: ClosureModel, m: FloatArray, x: FloatArray, loads: Loads) -> FloatArray:
    """Parts ``(n, 3, r, 4)`` mm/MPa of the derivatives of the observed vertices by the r moduli.

    The moduli are the parameters ``E_f`` among the model's, in their order.

    Parameters
    ----------
    m : (p,)
    x : (n, 3) mm
        Nodal positions in equilibrium with these parameters under the loads.
    """
    system, parameters = model.tuned(m)
    moduli = [one for one in parameters if one.kind == "E_f"]
    parts = sensitivity_parts(system, x, loads, moduli, model.solver)
    seen = [[model.observed(way) for way in own] for own in parts]
    return np.moveaxis(np.array(seen), (0, 1), (2, 3))


def resistance_rows(
    model: ClosureModel, m: FloatArray, x: FloatArray, whitened: FloatArray | None = None
) -> list[dict[str, Any]]:
    """By which tissue each leaflet resists, in % of its strain energy and of the information.

    A share of the information on a modulus, all else known, is negative where the tissue works
    against the rest; the shares of a row add up to 100 %. Nothing if the thickness is not one layer
    of elements.

    Parameters
    ----------
    model : ClosureModel
    m : (p,)
    x : (n, 3) mm
        Nodal positions of the closed valve in equilibrium.
    whitened : (k, r, 4), optional
        Parts of the derivatives of an observation by the moduli, whitened by its errors. Default:
        every observed vertex of the closed valve, with independent errors of one size.
    """
    system, parameters = model.tuned(m)
    if not has_one_layer(system.solid.mesh):
        return []
    found = [("strain energy", system.solid.mesh.region_names, work_shares(system, x))]
    moduli = tuple(one.region for one in parameters if one.kind == "E_f")
    if moduli:
        if whitened is None:
            whitened = modulus_parts(model, m, x, closed_loads(model, system))
        parts = np.moveaxis(whitened.reshape(-1, len(moduli), len(WAYS)), 0, -1)
        found.append(("information on E_f", moduli, information_shares(parts)))
    return [
        {"part": part, "of": what, **dict(zip(WAYS, (100.0 * own).tolist(), strict=True))}
        for what, regions, shares in found
        for part, own in zip(regions, shares, strict=True)
    ]
