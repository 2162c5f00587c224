"""Measures of a closing valve, against the same quantities computed by hand."""

import numpy as np
import pytest

from mvest.closure.model import ClosureModel
from mvest.mechanics.forces.cables import cable_force
from mvest.mechanics.settings import ClosureProtocol, MechanicsSettings, TissueSettings
from mvest.scenarios.measures import measure_steps
from mvest.valve.anatomy.template import Template
from mvest.valve.mesh.structured import structured_mesh

TEMPLATE = Template()
TISSUE = {"anterior": TissueSettings(6.23 / 2.35), "posterior": TissueSettings(2.09 / 1.89)}
LOW = ClosureProtocol(pressure_mmHg=20.0, ramp=0.1, dt=0.05, end=0.1, equilibrium=False)


def normals(columns, rows):
    j, i = (v.ravel() for v in np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij"))
    return TEMPLATE.normal(360.0 * i / columns, j / (rows - 1))


@pytest.fixture(scope="module")
def closing():
    model = ClosureModel(
        TEMPLATE.valve(40, 11),
        TEMPLATE.valve(40, 10),
        structured_mesh(TEMPLATE, "hex18", 12, 2),
        MechanicsSettings(TISSUE, LOW),
        ("E_f.anterior", "chord_rest_length"),
        {"E_f.posterior": 4.0, "chord_stiffness": 2.0},
    )
    result = model.close(np.array([6.0, 0.95]), sensitivities=False)
    assert result.simulation.converged
    return model, result, measure_steps(model, result, 2.0, normals(40, 11))


def test_the_open_valve_is_the_template(closing):
    _, _, steps = closing
    first = steps[0]
    assert first["smallest det F"] == pytest.approx(1.0, abs=1e-12)
    assert first["intersections"] == 0
    assert first["coaptation"] == 0.0
    # Seen from the atrium the opening lies within the open free edge, the lens between
    # y = 1.83 + 6.5 and 1.83 - 10.5 and x = +-15.5 of 2/3 (parabolas): 17 x 31 x 2/3 = 351 mm2,
    # less half a thickness along its rim of some 75 mm.
    assert 200 < first["orifice"] < 351


def test_chordae_are_measured_with_the_factors_of_the_run(closing):
    model, result, steps = closing
    chordae, cables = model.valve.chordae, result.system.cables
    for step in (0, -1):
        ends = cables.patches(result.simulation.frames[step])
        span = np.linalg.norm(ends - model.valve.papillary_tips[chordae.tip], axis=1)
        strain = span / (0.95 * chordae.rest_length) - 1
        force = 2.0 * chordae.axial_stiffness * cable_force(strain, chordae.toe_strain)[0]
        assert steps[step]["chord strain"] == pytest.approx(strain.max(), rel=1e-12)
        assert steps[step]["chord force"] == pytest.approx(force.max(), rel=1e-9)
    assert steps[-1]["chord force"] > 0.1
