"""A case as input of FEBio: what is in the file, read by Python's XML reader alone."""

from xml.etree import ElementTree as Xml

import numpy as np
import pytest

from experiments import cli
from mvest.cases.folder import write_case
from mvest.errors import InputError
from mvest.exchange.exporting.febio import (
    FebioOptions,
    export_febio,
    model_of_case,
    valve_document,
)
from mvest.mechanics.forces.cables import cable_force
from mvest.mechanics.valve_system import build_system
from tests.cases.folders import template_case, tree_case


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    place = tmp_path_factory.mktemp("case")
    write_case(place, template_case())
    return place


@pytest.fixture(scope="module")
def root(folder):
    target = folder / "valve.feb"
    assert export_febio(folder, target, FebioOptions(columns=12, rows=2)) == target
    return Xml.parse(target).getroot()


def values(element):
    return np.array([float(word) for word in element.text.split(",")])


def rows(elements):
    return np.array([values(e) for e in elements])


def test_numbers_of_nodes_and_elements_are_whole(root):
    nodes = root.findall("Mesh/Nodes/node")
    assert [int(n.get("id")) for n in nodes] == list(range(1, len(nodes) + 1))
    elements = root.findall("Mesh/Elements/elem")
    assert [int(e.get("id")) for e in elements] == list(range(1, 25))
    x = rows(nodes)
    corners = rows(elements).astype(int)[:, :8] - 1
    # Six times the volume of the tetrahedron at the first corner.
    a, b, c, d = (x[corners[:, k]] for k in (0, 1, 3, 4))
    assert np.all(np.einsum("ei,ei->e", np.cross(b - a, c - a), d - a) > 0)
    for name in ("anterior", "posterior"):
        own = root.find(f"Mesh/Elements[@name='{name}']")
        data = root.find(f"MeshData/ElementData[@elem_set='{name}']")
        assert [int(e.get("lid")) for e in data] == list(range(1, len(own) + 1))
        assert root.find(f"Material/material[@name='{name}']") is not None


def test_pressure_and_motion_follow_the_ramp(root):
    load = root.find("Loads/surface_load/pressure")
    points = rows(root.findall(f"LoadData/load_controller[@id='{load.get('lc')}']/points/pt"))
    assert points[0].tolist() == [0.0, 0.0]
    assert points[-1, 0] == pytest.approx(0.3)
    assert points[-1, 1] == pytest.approx(121.3 * 133.322e-6, rel=1e-4)
    tips = root.find("MeshData/NodeData[@name='tips_z']")
    case = template_case()
    move = case.closed.papillary_tips - case.frames[0].papillary_tips
    # Then the anchors of the junctions, each with its tip.
    assert [float(e.text) for e in tips[:2]] == pytest.approx(move[:, 2])


def test_a_chord_pulls_as_here(root):
    case = template_case()
    chordae = case.chordae
    ends = root.findall("Mesh/DiscreteSet")
    x = rows(root.findall("Mesh/Nodes/node"))
    for k in np.flatnonzero(chordae.parent[: len(chordae.insertion)] < 0)[[0, -1]]:
        pair = values(ends[k].find("delem")).astype(int) - 1
        apart = np.linalg.norm(x[pair[1]] - x[pair[0]])
        np.testing.assert_allclose(x[pair[0]], case.frames[0].papillary_tips[chordae.tip[k]])
        # The patch's average lies within its radius of the insertion.
        assert np.linalg.norm(x[pair[1]] - chordae.insertion[k]) < 2.0
        force = rows(root.findall("Discrete/discrete_material")[k].findall("force/points/pt"))
        for strain in (-0.2, 0.5 * chordae.toe_strain, chordae.toe_strain, 0.08):
            elongation = chordae.rest_length[k] * (1 + strain) - apart
            wanted = (
                chordae.axial_stiffness[k] * cable_force(np.array(strain), chordae.toe_strain)[0]
            )
            found = np.interp(elongation, force[:, 0], force[:, 1])
            assert found == pytest.approx(float(wanted), abs=1e-4)


def test_branching_chordae_pull_as_the_cables(tmp_path):
    """Springs of the file, its leaflet ends and junctions at a closed state, in balance."""
    case, options = tree_case(), FebioOptions(columns=12, rows=2)
    model = model_of_case(case, options)
    target = valve_document(model, np.zeros(0), options).write(tmp_path / "trees.feb")
    root = Xml.parse(target).getroot()
    start = rows(root.findall("Mesh/Nodes/node"))
    mesh = model.mesh
    system = build_system(model.valve, model.contact_valve, mesh, model.settings, model.fixed)
    n, x = len(mesh.nodes), start.copy()
    x[:n] = mesh.nodes + np.array([0.0, 0.3, 3.0])  # the chordae are taut
    tips = case.closed.papillary_tips
    state = system.cables.state(x[:n], tips)
    k, c = len(state.end), len(case.chordae.insertion)
    x[n : n + 2], x[n + 2 : n + 2 + k] = tips, state.end
    tension = []
    force = np.zeros_like(x)
    for number in range(k):
        spring = root.find(f"Mesh/DiscreteSet[@name='spring_{number}']/delem")
        pair = values(spring).astype(int) - 1
        arm, before = np.diff(x[pair], axis=0)[0], np.diff(start[pair], axis=0)[0]
        law = rows(root.find(f".//discrete_material[@name='chord_{number}']/force/points"))
        longer = np.linalg.norm(arm) - np.linalg.norm(before)
        tension.append(np.interp(longer, *law.T))
        pull = tension[-1] * arm / np.linalg.norm(arm)
        force[pair[0]] += pull
        force[pair[1]] -= pull
    j = len(case.chordae.junction)
    assert len(tension) == c + j
    taut = [0, 1, 2, 3, 4, 5, c, c + 1, c + j - 1]  # the first two fans and their common trunk
    assert min(state.tension[taut]) > 0.01
    np.testing.assert_allclose(tension, state.tension, atol=1e-4)
    junctions = n + 2 + c + np.arange(j)
    assert np.abs(force[junctions]).max() < 3e-4
    ends = n + 2 + np.arange(c)
    np.testing.assert_allclose(-force[ends], system.cables.forces(x[:n], tips)[0], atol=1e-4)
    # The anchor of a junction begins there and moves with its tip.
    anchors = junctions + j
    np.testing.assert_allclose(start[anchors], start[junctions])
    moves = case.closed.papillary_tips - case.frames[0].papillary_tips
    found = [float(e.text) for e in root.find("MeshData/NodeData[@name='tips_z']")]
    assert found == pytest.approx(moves[[0, 1, *case.chordae.tip[c:]], 2])


def test_averages_are_averages(root):
    x = rows(root.findall("Mesh/Nodes/node"))
    following = root.findall("Boundary/bc[@type='linear constraint']")
    assert len(following) == 3 * len(template_case().chordae.insertion)
    for bc in following[::3]:
        children = bc.findall("child_dof")
        weights = np.array([float(c.find("value").text) for c in children])
        nodes = np.array([int(c.find("node").text) for c in children]) - 1
        assert weights.sum() == pytest.approx(1.0)
        np.testing.assert_allclose(weights @ x[nodes], x[int(bc.find("node").text) - 1], atol=1e-9)
    for one in root.findall("Constraints/constraint/linear_constraint")[:6]:
        own = np.array([float(n.text) for n in one])
        assert own[0] < 0
        assert own.sum() == pytest.approx(0.0, abs=1e-12)


def test_contact_presses_as_its_reference_pressure(root):
    contact = root.find("Contact/contact")
    assert contact.get("type") == "contact potential"
    kc, p, inner, outer = (float(contact.find(t).text) for t in ("kc", "p", "R_in", "R_out"))
    c1 = 0.5 * p * kc / ((outer - inner) * inner ** (p + 1))
    c2 = kc / inner**p - c1 * (inner - outer) ** 2
    # FEContactPotential::PotentialDerive, summed over a plane: each pair counts twice.
    step = 0.004
    plane = np.arange(-outer, outer, step)
    u, v = np.meshgrid(plane, plane)
    r = np.sqrt(u**2 + v**2 + 1.0)
    force = np.where(r < inner, kc / r**p - c2, np.where(r < outer, c1 * (r - outer) ** 2, 0.0))
    pressure = 2 * np.sum(force * 1.0 / r) * step**2
    assert pressure == pytest.approx(0.016, rel=2e-3)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"E_f": (3.0,)}, "expected one of each of anterior, posterior"),
        ({"contact": "glue"}, "potential, none"),
        ({"contact_gap_mm": 2.0}, "gap < reach"),
        ({"law": "mooney"}, "orthotropic, neo-hookean"),
    ],
)
def test_what_is_wrong_is_said(folder, tmp_path, given, words):
    with pytest.raises(InputError, match=words):
        export_febio(folder, tmp_path / "a.feb", FebioOptions(columns=12, rows=2, **given))


def test_estimates_are_given_by_name(folder, tmp_path, capsys):
    words = ["febio", str(folder), str(tmp_path / "a.feb"), "columns=12", "rows=2", "E_f=[7,2]"]
    words += ["ratio=[2,1]", "law=orthotropic", "pressure_mmHg=60", "contact=none"]
    assert cli.main(["export", *words]) == 0
    assert "a.feb" in capsys.readouterr().out
    root = Xml.parse(tmp_path / "a.feb").getroot()
    materials = root.findall("Material/material")
    assert [[float(m.find(t).text) for t in ("E1", "E2", "v12")] for m in materials] == [
        [7.0, pytest.approx(3.5), 0.488],
        [2.0, pytest.approx(2.0), 0.488],
    ]
    load = root.find("Loads/surface_load/pressure")
    points = rows(root.findall(f"LoadData/load_controller[@id='{load.get('lc')}']/points/pt"))
    assert points[-1, 1] == pytest.approx(60 * 133.322e-6, rel=1e-4)
    assert cli.main(["export", "febio", str(folder), str(tmp_path / "a.txt")]) == 2
    assert ".feb" in capsys.readouterr().err
