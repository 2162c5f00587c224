"""The table of a closed valve against balances and measures by other ways, and its marks."""

from dataclasses import replace

import numpy as np
import pytest

from mvest.closure.model import ClosureModel
from mvest.closure.physiology import (
    QUANTITIES,
    beside_ranges,
    chord_loads,
    closed_loads,
    modulus_parts,
    open_physiology,
    physiology,
    resistance_rows,
)
from mvest.closure.stress import peak_stress
from mvest.mechanics.forces.trees import SUPPORT
from mvest.mechanics.resistance import WAYS
from mvest.mechanics.settings import ClosureProtocol, MechanicsSettings, TissueSettings
from mvest.valve.anatomy.template import Template
from mvest.valve.geometry.proximity import plane_section
from mvest.valve.geometry.triangles import areas
from mvest.valve.measure.clinical import plane_of_leaflets
from mvest.valve.measure.coaptation import touching_triangles
from mvest.valve.measure.strain import triangle_strains
from mvest.valve.mesh.structured import structured_mesh

TEMPLATE = Template()
TISSUE = {"anterior": TissueSettings(6.23 / 2.35), "posterior": TissueSettings(2.09 / 1.89)}
AT = np.array([6.23, 2.09])


@pytest.fixture(scope="module")
def closed():
    """A valve closed at rest: its model, system, positions, and derivatives of the positions."""
    model = ClosureModel(
        TEMPLATE.valve(64, 17),
        TEMPLATE.valve(48, 12),
        structured_mesh(TEMPLATE, "hex18", 16, 2),
        MechanicsSettings(TISSUE, ClosureProtocol(pressure_mmHg=60.0)),
        ("E_f.anterior", "E_f.posterior"),
    )
    result = model.close(AT)
    assert result.simulation.converged
    simulation = result.simulation
    return model, result.system, simulation.frames[-1], simulation.sensitivities[-1]


@pytest.fixture(scope="module")
def found(closed):
    return {(row["quantity"], row["part"]): row for row in physiology(*closed[:3])}


def test_tips_and_annulus_carry_the_pressure(closed, found):
    model, system, x, _ = closed
    loads = closed_loads(model, system)
    push = np.zeros(3)
    for face, own in zip(system.pressure.faces, system.pressure.forces(x), strict=True):
        assert len(face) == len(own)
        push += loads.pressure * own.sum(axis=0)
    ring = system.hinge.forces(x, loads.hinge).sum(axis=0)
    pull = chord_loads(system, x, loads).at_tip
    # The springs that hold the junctions of slack trees bear the rest, below a millinewton.
    cables, c = system.cables, len(system.cables.patches)
    hung = loads.tips[cables.tip[c:]] + cables.place
    junctions = cables.state(x, loads.tips, *system.factors.chordae).end[c:]
    springs = SUPPORT * (junctions - hung).sum(axis=0)
    assert np.linalg.norm(springs) < 1e-3
    np.testing.assert_allclose(pull.sum(axis=0) + springs + ring, push, atol=1e-9)
    for k, own in enumerate(pull):
        assert found["force on a papillary tip", f"tip {k + 1}"]["value"] == np.linalg.norm(own)


def test_chordae_are_counted_by_family(closed, found):
    model, system, x, _ = closed
    chordae = model.valve.chordae
    chords = chord_loads(system, x, closed_loads(model, system))
    for k, family in enumerate(chordae.family_names):
        own = chordae.family == k
        value = {q: found[q, family]["value"] for q, part in found if part == family}
        slack = (chords.force[own] == 0).sum()
        assert (value["chordae"], value["slack chordae"]) == (own.sum(), slack)
        assert value["largest chordal force"] == chords.force[own].max()
        assert value["mean chordal force"] == chords.force[own].mean()
        assert value["largest chordal strain"] == 100 * chords.strain[own].max()
    # Some marginal chordae are taut and some slack. On this coarse mesh the struts are slack.
    force = chords.force[chordae.family == 0]
    assert 0 < np.count_nonzero(force) < len(force)


def test_strain_of_the_belly_excludes_what_touches(closed, found):
    model, _, x, _ = closed
    surface = model.valve.surface
    strain = 100 * triangle_strains(surface.vertices, model.observed(x), surface)[:, 0]
    for k, name in enumerate(surface.region_names):
        one = found["membrane strain along the fibres", name]
        own = strain[surface.region == k]
        assert own.min() <= one["p5"] < one["value"] < one["p95"] <= own.max()
        belly, leaflet = (
            found[f"area of the {what} compressed along the fibres", name]["value"]
            for what in ("belly", "leaflet")
        )
        assert 0 < belly < 100
        assert belly != leaflet
        # The median is a strain of tissue in tension if and only if less than half is compressed.
        assert (one["value"] > 0) == (belly < 50)


def test_stress_coaptation_and_tenting_are_the_valves(closed, found):
    model, system, x, _ = closed
    peaks = peak_stress(system, x)
    for name in ("anterior", "posterior"):
        largest = peaks[f"stress_max_{name}_mpa"]
        assert found["largest stress", name]["value"] == largest
        assert (
            found["99 % of the principal stress", name]["value"] < peaks[f"stress_max_{name}_mpa"]
        )
    height = found["coaptation height, middle section", "valve"]["value"]
    area, tenting = (found[q, "valve"]["value"] for q in ("coaptation area", "tenting height"))
    surface, shape = model.valve.surface, model.observed(x)
    touching = touching_triangles(shape, surface.triangles, model.contact_reach_mm)
    both = areas(shape, surface.triangles)[touching].sum()
    assert area == pytest.approx(0.5 * both, rel=0.1)
    # The coaptation zone ends above the lowest point of the leaflets.
    lowest = -shape[:, 2].min()
    assert 0 < tenting < tenting + height <= lowest + 1.0


def test_a_mark_follows_the_range():
    def mark(value, quantity="tenting height", part="valve", mitral=True):
        (row,) = beside_ranges({(quantity, part): value}, mitral=mitral)
        return row["mark"], row["low"], row["high"]

    assert mark(9.3) == ("outside", 4.0, 6.0)
    assert mark(3.9)[0] == "outside"
    assert mark(5.0)[0] == mark(6.0)[0] == "inside"
    assert mark(9.3, mitral=False) == ("", None, None)
    assert mark(0.1, "closed gap") == ("outside", None, 0.0)
    assert mark(-0.1, "annulus height, change") == ("outside", 0.0, None)
    assert mark([4.0, -9.0, 30.0], "membrane strain along the fibres", "anterior")[0] == "inside"
    # A range may be that of one leaflet.
    assert mark(12.0, "length, middle section", "posterior")[0] == "inside"
    assert mark(12.0, "length, middle section", "anterior")[0] == "outside"
    assert mark(600.0, "area", "anterior") == ("", None, None)
    assert beside_ranges({("tenting height", "valve"): np.nan}, mitral=True) == []


def test_every_quantity_is_found_and_every_range_has_a_source(found):
    assert list(dict.fromkeys(quantity for quantity, _ in found)) == list(QUANTITIES)
    for row in found.values():
        low, high = row["low"], row["high"]
        assert bool(row["source"]) == bool(row["mark"]) == ((low, high) != (None, None))
        assert (-np.inf if low is None else low) < (np.inf if high is None else high)


def test_a_valve_of_three_leaflets_has_what_needs_no_pair(closed, found):
    # The same closed valve with its posterior leaflet in two.
    model, _, x, _ = closed
    surface, mesh = model.valve.surface, model.mesh
    names = ("anterior", "posterior", "septal")

    def cut(own, at):
        region = np.where((own.region == 1) & (at[:, 0] > 0), 2, own.region)
        return replace(own, region_names=names, region=region)

    three = ClosureModel(
        replace(
            model.valve, surface=cut(surface, surface.vertices[surface.triangles].mean(axis=1))
        ),
        model.contact_valve,
        cut(mesh, mesh.nodes[mesh.elements].mean(axis=1)),
        replace(model.settings, tissue=TISSUE | {"septal": TISSUE["posterior"]}),
        tuple(f"E_f.{name}" for name in names),
    )
    system, _ = three.tuned(np.array([*AT, AT[1]]))
    seen = {(row["quantity"], row["part"]): row for row in physiology(three, system, x)}
    assert {part for _, part in seen} >= {*names, "valve", "tip 1", "tip 2"}
    assert not any(row["mark"] or row["source"] for row in seen.values())
    quantities = {quantity for quantity, _ in seen}
    pair = {"tenting height", "coaptation height, middle section", "posterior over anterior area"}
    assert not quantities & pair
    assert {"tenting volume", "closed gap", "coaptation area"} <= quantities
    for what in ("force on a papillary tip", "largest stress", "membrane strain along the fibres"):
        same = "tip 1" if "tip" in what else "anterior"
        assert seen[what, same]["value"] == pytest.approx(found[what, same]["value"], rel=1e-6)


def test_an_open_valve_has_its_sizes_only():
    found = {row["quantity"] for row in open_physiology(TEMPLATE.valve(64, 17))}
    assert {"area", "length, middle section", "open orifice"} <= found
    assert not any("strain" in name or "force" in name for name in found)


def test_shares_of_information_and_energy_add_up(closed):
    model, system, x, dx = closed
    rows = resistance_rows(model, AT, x)
    assert [(row["part"], row["of"]) for row in rows] == [
        (name, what)
        for what in ("strain energy", "information on E_f")
        for name in ("anterior", "posterior")
    ]
    for row in rows:
        assert sum(row[way] for way in WAYS) == pytest.approx(100.0, abs=1e-9)
    parts = modulus_parts(model, AT, x, closed_loads(model, system))
    seen = np.stack([model.observed(own) for own in dx], axis=-1)
    np.testing.assert_allclose(parts.sum(axis=-1), seen, atol=1e-6 * np.abs(seen).max())
    # By hand: J . J_part / J . J of the posterior modulus, with one error for all coordinates.
    J = seen[..., 1].ravel()
    expected = [100 * J @ parts[..., 1, w].ravel() / (J @ J) for w in range(4)]
    assert [rows[3][way] for way in WAYS] == pytest.approx(expected, rel=1e-5)


def test_tetrahedra_do_not_tell_bending_from_stretching(closed):
    model = replace(closed[0].fresh(), mesh=structured_mesh(TEMPLATE, "tet10", 12, 2))
    assert resistance_rows(model, AT, model.mesh.nodes) == []


def test_the_tenting_area_is_that_below_the_line_between_the_hinges(closed, found):
    # The nearest leaflet to the atrium along lines of sight through the cut leaflets.
    model, system, x, _ = closed
    surface, shape = model.valve.surface, model.observed(x)
    tips = closed_loads(model, system).tips
    plane = plane_of_leaflets(shape, surface, shape[model.valve.annulus], tips)
    cut, _ = plane_section(shape, surface.triangles, plane.origin, plane.lateral)
    ends = plane.coordinates(cut.reshape(-1, 3)).reshape(-1, 2, 3)[..., [0, 2]]
    ends = np.take_along_axis(ends, np.argsort(ends[..., :1], axis=1), axis=1)
    along = np.linspace(ends[..., 0].min() + 1e-6, ends[..., 0].max() - 1e-6, 2001)
    depth = np.full(len(along), np.inf)
    for (a, low), (b, high) in ends:
        at = (along >= a) & (along <= b)
        depth[at] = np.minimum(depth[at], np.interp(along[at], (a, b), (low, high)))
    below = depth - np.interp(along, along[[0, -1]], depth[[0, -1]])
    area = found["tenting area, middle section", "valve"]["value"]
    assert area == pytest.approx(np.trapezoid(below, along), rel=0.03)
