"""Physiology of a closed valve beside the literature, and the tissue through which moduli act.

`physiology` measures strain, stress, coaptation, chordae and size of a closed valve. Quantities
stand beside the ranges of ``physiology.toml`` and are marked if they are outside. The ranges are
those of normal mitral valves; a valve with other leaflets than two has none.

The belly of a leaflet is what touches no leaflet that faces it, within the reach of the contact,
and lies farther than `COMMISSURE_MM` from the line between the leaflets in the open valve: the
commissural leaflets are no belly.
Strain is that from the open to the closed shape of the midsurface, as in animals with markers. The
tenting height is the depth of the coaptation point below the annulus plane, the tenting area that
below the line between the hinges of both leaflets.

`resistance_rows` says by which tissue a leaflet resists (`mvest.mechanics.resistance`).
"""

import tomllib
from collections import defaultdict
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from scipy.spatial import cKDTree

from mvest.closure.model import ClosureModel
from mvest.closure.stress import peak_stress
from mvest.errors import InputError
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
from mvest.valve.geometry.triangles import areas, edges_between
from mvest.valve.measure.clinical import clinical_measurements, plane_of_leaflets
from mvest.valve.measure.coaptation import (
    coaptation_depth,
    find_gap,
    project_leaflets,
    touching_triangles,
)
from mvest.valve.measure.strain import triangle_strains, weighted_quantiles

QUANTITIES: dict[str, dict[str, Any]] = tomllib.loads(
    Path(__file__).with_name("physiology.toml").read_text(encoding="utf-8")
)
"""The quantities of ``physiology.toml``."""

PIXEL_MM = 0.2
COMMISSURE_MM = 5.0
"""Reach of the commissural leaflets from the line between the leaflets [choice]."""

Values: TypeAlias = dict[tuple[str, str], float | list[float]]
"""Quantity and part of the valve -> value, or median and quantiles at 5 and 95 % of the area."""


Row: TypeAlias = dict[str, Any]
"""One quantity beside its range: ``quantity``; ``part``, a leaflet, family of chordae, papillary
tip or the valve; ``value``, a median if it has the quantiles ``p5`` and ``p95`` by area; ``unit``;
``low`` and ``high`` ends of the range, None if open; ``source`` of the range; ``mark``, ``inside``,
``outside``, or empty without a range."""


def beside_ranges(values: Values, *, mitral: bool) -> list[Row]:
    """The finite values in the order of `QUANTITIES`, of a mitral valve with its ranges."""
    rows, order = [], list(QUANTITIES)
    for (quantity, part), given in sorted(values.items(), key=lambda one: order.index(one[0][0])):
        value, p5, p95 = given if isinstance(given, list) else (given, None, None)
        about = QUANTITIES[quantity] | QUANTITIES[quantity].get(part, {})
        low, high = (about.get(end) if mitral else None for end in ("low", "high"))
        ranged = low is not None or high is not None
        inside = (low is None or value >= low) and (high is None or value <= high)
        if np.isfinite(value):
            row = {"quantity": quantity, "part": part, "value": float(value), "p5": p5, "p95": p95}
            row |= {"unit": about["unit"], "low": low, "high": high}
            row["mark"] = ("inside" if inside else "outside") if ranged else ""
            rows.append(row | {"source": about["source"] if ranged else ""})
    return rows


def physiology(model: ClosureModel, system: System, x: FloatArray) -> list[Row]:
    """Measure a closed valve.

    Quantities that it does not admit are left out, as those of coaptation lines are for other than
    two leaflets.

    Parameters
    ----------
    model : ClosureModel
    system : System
        The model's, at the parameters for which ``x`` is in equilibrium.
    x : (n, 3) mm
        Nodal positions.
    """
    valve, shape, reach = model.valve, model.observed(x), model.contact_reach_mm
    surface, ring, loads = valve.surface, shape[valve.annulus], closed_loads(model, system)
    plane = plane_of_leaflets(shape, surface, ring, loads.tips)
    leaflets = [surface.triangles[surface.region == k] for k in range(len(surface.region_names))]
    image = project_leaflets(shape, surface.triangles, ring, plane, PIXEL_MM)
    seen = np.where(image.inside, image.depth, np.inf)[:, np.argmin(np.abs(image.lateral))]
    section = seen[np.isfinite(seen)]
    hinges = np.linspace(section[0], section[-1], len(section)) if len(section) else 0.0
    peaks: dict[str, float] = {}
    with suppress(InputError):  # an element is turned inside out
        peaks = peak_stress(system, x)
    values = _sizes(valve, (shape, loads.tips, reach)) | _strains(valve, shape, reach)
    for name in surface.region_names:
        values["99 % of the principal stress", name] = peaks.get(f"stress_p99_{name}_mpa", np.nan)
        values["largest stress", name] = peaks.get(f"stress_max_{name}_mpa", np.nan)
    if len(leaflets) == 2:
        depth = coaptation_depth(shape, leaflets[0], leaflets[1], plane, reach)
        values["tenting height", "valve"] = depth
    values["tenting area, middle section", "valve"] = PIXEL_MM * float(np.sum(section - hinges))
    values["closed gap", "valve"] = find_gap(shape, surface.triangles, ring, plane, reach).area
    values |= _chordae(chord_loads(system, x, loads))
    return beside_ranges(values, mitral=len(leaflets) == 2)


def open_physiology(valve: Valve) -> list[Row]:
    """What is known of a valve that was not closed: leaflets and orifice."""
    return beside_ranges(_sizes(valve), mitral=len(valve.surface.region_names) == 2)


def closed_loads(model: ClosureModel, system: System) -> Loads:
    """The loads at the end of the closure."""
    loading = boundary_loading(system, model.valve, model.contact_valve, model.settings)
    return loading(model.settings.protocol.steps()[-1].time)


class ChordLoads(NamedTuple):
    """What the chordae bear."""

    force: FloatArray  #: (k,) N, of the segments
    strain: FloatArray  #: ``(k,)``, negative if slack
    at_tip: FloatArray  #: ``(t, 3)`` N, pull on each papillary tip
    families: Mapping[str, BoolArray]  #: family -> its members ``(k,)``


def chord_loads(system: System, x: FloatArray, loads: Loads) -> ChordLoads:
    """What the chordae bear at nodal positions ``x (n, 3)`` mm; empty without chordae."""
    cables, at_tip = system.cables, np.zeros_like(loads.tips)
    if cables is None:
        return ChordLoads(np.zeros(0), np.zeros(0), at_tip, {})
    state = cables.state(x, loads.tips, *system.factors.chordae)
    root = np.flatnonzero(cables.trees.parent < 0)
    np.add.at(at_tip, cables.tip[root], (state.tension[:, None] * state.direction)[root])
    return ChordLoads(state.tension, state.strain, at_tip, cables.families)


def _strains(valve: Valve, shape: FloatArray, reach: float) -> Values:
    surface, values = valve.surface, Values()
    strain = 100.0 * triangle_strains(surface.vertices, shape, surface)
    size = areas(surface.vertices, surface.triangles)
    free = ~touching_triangles(shape, surface.triangles, reach)
    between = surface.vertices[edges_between(surface.triangles, surface.region).ravel()]
    if len(between):
        middles = surface.vertices[surface.triangles].mean(axis=1)
        free &= cKDTree(between).query(middles)[0] > COMMISSURE_MM
    for number, name in enumerate(surface.region_names):
        leaflet = surface.region == number
        belly = leaflet & free
        for k, way in enumerate(("along", "across")) if belly.any() else ():
            found = weighted_quantiles(strain[belly, k], size[belly], (0.5, 0.05, 0.95))
            values[f"membrane strain {way} the fibres", name] = found
        for what, own in (("belly", belly), ("leaflet", leaflet)):
            share = size[own] @ (strain[own, 0] < 0) / max(size[own].sum(), 1e-300)
            values[f"area of the {what} compressed along the fibres", name] = 100.0 * float(share)
    return values


def _chordae(chords: ChordLoads) -> Values:
    values: Values = {
        ("force on a papillary tip", f"tip {k + 1}"): float(np.linalg.norm(pull))
        for k, pull in enumerate(chords.at_tip)
    }
    for family, own in chords.families.items():
        force, strain = chords.force[own], chords.strain[own]
        values["chordae", family] = float(own.sum())
        if own.any():
            values["mean chordal force", family] = float(force.mean())
            values["largest chordal force", family] = float(force.max())
            values["largest chordal strain", family] = 100.0 * float(strain.max())
            values["slack chordae", family] = float((strain <= 0).sum())
    return values


def _sizes(valve: Valve, closed: tuple[FloatArray, FloatArray, float] | None = None) -> Values:
    """Clinical measurements of the open valve and the closed one: shape, tips and reach."""
    surface, values = valve.surface, Values()
    frames = {"open": (surface.vertices, valve.papillary_tips, 0.0)}
    frames |= {} if closed is None else {"closed": closed}
    measured = {
        frame: defaultdict(
            lambda: np.nan, clinical_measurements(x, surface, x[valve.annulus], tips, reach)
        )
        for frame, (x, tips, reach) in frames.items()
    }
    for quantity, about in QUANTITIES.items():
        frame, _, name = about.get("measure", "").partition(" ")
        for part in surface.region_names if "{part}" in name else ("valve",):
            key = name.format(part=part)
            if frame in measured:
                values[quantity, part] = measured[frame][key]
            elif frame == "change" and closed is not None:
                change = measured["closed"][key] / measured["open"][key] - 1.0
                values[quantity, part] = 100.0 * change
    size = [measured["open"][f"{name}_area_mm2"] for name in surface.region_names]
    if len(size) == 2:
        values["posterior over anterior area", "valve"] = size[1] / size[0]
    ring = measured["open"]["annulus_area_3d_mm2"]
    values["leaflet over annulus area", "valve"] = sum(size) / ring
    return values


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
) -> list[Row]:
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
