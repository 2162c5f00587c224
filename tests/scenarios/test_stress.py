"""Peak stress against stresses that are known by hand."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from mvest.closure.stress import nodal_stress, peak_stress, principal_cauchy
from mvest.mechanics.law.biot import BiotLaw
from mvest.mechanics.law.moduli import TransverselyIsotropic
from mvest.mechanics.solid import Solid
from mvest.mechanics.system import System
from mvest.scenarios.measures import contact_pressure
from tests.mechanics.bodies import block
from tests.mechanics.forces.test_contact import pair

E, NU, STRAIN = 2.0, 0.3, 0.08
SIZE = (4.0, 3.0, 2.0)

P95, P99, LARGEST = (f"stress_{kind}_tissue_mpa" for kind in ("p95", "p99", "max"))


def six(tensor, shear=1.0):
    t = tensor
    return np.array([t[0, 0], t[1, 1], t[2, 2], shear * t[1, 2], shear * t[0, 2], shear * t[0, 1]])


def test_principal_stress_is_that_of_the_push_forward():
    rng = np.random.default_rng(4)
    f = np.eye(3) + 0.3 * rng.uniform(-1, 1, (3, 3))
    s = rng.uniform(-1, 1, (3, 3))
    s = s + s.T
    cauchy = f @ s @ f.T / np.linalg.det(f)
    green = 0.5 * (f.T @ f - np.eye(3))
    found = principal_cauchy(six(green, 2.0)[None], six(s)[None])
    np.testing.assert_allclose(found, [np.linalg.eigvalsh(cauchy)[-1]], rtol=1e-12)


def test_contact_pressure_is_force_over_area():
    # The potential of the two points at 1.2 mm pushes both apart with the same force.
    contact, pairs, y = pair(1.2)
    system = SimpleNamespace(contact=contact)
    rest, pressure = contact_pressure(system, y)
    force = np.linalg.norm(contact.forces(pairs, y)[0])
    assert pressure == pytest.approx(
        [force / contact.sheet.areas[0], force / contact.sheet.areas[1], 0.0]
    )
    assert force > 0
    assert np.array_equal(rest, contact.sheet.rest)
    assert len(contact_pressure(SimpleNamespace(contact=None), y)[1]) == 0


def test_a_small_part_under_high_stress_counts_by_its_volume():
    # Two cells in a row, 39 and 1 of 40 parts of the volume, stretched by 1 % and 10 %: without
    # lateral contraction the stresses are E e = 0.02 and 0.2 MPa. Half of the points lie in the
    # small cell, but only 2.5 % of the volume.
    mesh = block("hex18", (2, 1, 1), SIZE)
    wide, half = 3.9, 0.5 * SIZE[0]
    share = mesh.nodes[:, 0] / half
    graded = np.where(share <= 1, wide * share, wide + (SIZE[0] - wide) * (share - 1))
    nodes = np.column_stack([graded, mesh.nodes[:, 1:]])
    system = System(
        Solid(replace(mesh, nodes=nodes), BiotLaw.of((TransverselyIsotropic.isotropic(E, 0.0),)))
    )
    x = nodes.copy()
    x[:, 0] = np.where(graded <= wide, 1.01 * graded, 1.01 * wide + 1.1 * (graded - wide))
    peak = peak_stress(system, x)
    assert peak[P95] == pytest.approx(0.01 * E, rel=1e-6)
    assert peak[P99] == pytest.approx(0.1 * E, rel=1e-6)
    assert peak[LARGEST] == pytest.approx(0.1 * E, rel=1e-6)
    # Nodes at the far end belong to the small cell alone.
    assert nodal_stress(system, x).max() == pytest.approx(0.1 * E, rel=1e-6)
