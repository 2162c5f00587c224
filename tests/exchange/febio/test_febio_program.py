"""Bodies in FEBio beside this project's; only where the program is (see `program`)."""

from dataclasses import replace

import numpy as np
import pytest

from mvest.errors import ConfigurationError
from mvest.exchange.febio.document import FebDocument, febio_law
from mvest.mechanics.body import simulate_body
from mvest.mechanics.law import Law
from mvest.mechanics.law.moduli import PoissonReading, TransverselyIsotropic
from mvest.mechanics.steps import NewtonSettings
from tests.exchange.febio.program import febio_mesh, febio_program, run_febio
from tests.exchange.febio.test_febio_mesh import mesh_of
from tests.mechanics.bodies import SaintVenantKirchhoff

MATERIAL = TransverselyIsotropic.from_ratio(6.23, 2.651, 0.488, PoissonReading.LITERAL)
PRESSURE = 0.03


@pytest.fixture
def program():
    try:
        return febio_program()
    except ConfigurationError as error:
        pytest.skip(str(error))


def sheet(kind):
    """A sheet of 8 x 6 x 1.3 mm whose fibres run askew."""
    mesh = mesh_of(kind, (4, 3, 1), (8.0, 6.0, 1.3))
    fibre = np.tile([0.8, 0.6, 0.0], (len(mesh.nodes), 1))
    rim = np.flatnonzero(np.isin(mesh.nodes[:, 0], (0.0, 8.0)))
    return mesh, fibre, rim


def ours(mesh, fibre, rim, law):
    return simulate_body(
        mesh.nodes,
        mesh.elements,
        mesh.element_type,
        material=law,
        fibre=fibre[0],
        fixed_nodes=rim,
        pressure_faces=mesh.pressure_faces,
        pressure=[(0.0, 0.0), (1.0, PRESSURE)],
        times=np.arange(1, 6) / 5,
        static=True,
        newton=NewtonSettings(tolerance=1e-11),
    )


def theirs(mesh, fibre, rim, kind, folder):
    directed = replace(mesh, fibre=fibre)
    own = febio_mesh(directed)
    nodes = np.flatnonzero(np.isin(own.nodes[:, 0], (0.0, 8.0)))
    curve = np.array([[0.0, 0.0], [1.0, 1.0]])
    document = FebDocument(own, [febio_law(MATERIAL, kind)], 1.0, 0.2, 1e-9)
    document.prescribe("rim", nodes, np.zeros((len(nodes), 3)), curve)
    document.press(own.pressure_faces, curve * [1.0, PRESSURE])
    return run_febio(document, directed, folder / "sheet.feb")


# FEBio writes twelve digits, and knows the points of integration of tet10 to eight.
@pytest.mark.parametrize(("kind", "difference"), [("tet4", 1e-10), ("tet10", 2e-8)])
def test_a_sheet_is_the_same_where_element_and_law_are(kind, difference, program, tmp_path):
    mesh, fibre, rim = sheet(kind)
    law = SaintVenantKirchhoff([MATERIAL])
    assert isinstance(law, Law)
    here = ours(mesh, fibre, rim, law)
    there = theirs(mesh, fibre, rim, "orthotropic", tmp_path)
    assert there.converged, there.reason
    assert there.version.startswith("4")
    assert there.times[-1] == pytest.approx(1.0)
    moved = np.abs(here.frames[-1] - mesh.nodes).max()
    assert moved > 0.15
    assert np.abs(there.frames[-1] - here.frames[-1]).max() < difference
    # Another law is not the same at these strains.
    other = ours(mesh, fibre, rim, MATERIAL)
    assert np.abs(other.frames[-1] - here.frames[-1]).max() > 1e-3
