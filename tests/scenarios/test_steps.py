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
    model, _, steps = closing
    first = steps[0]
    assert first["smallest det F"] == pytest.approx(1.0, abs=1e-12)
    assert first["intersections"] == 0
    assert first["coaptation"] == 0.0
    # Seen from the atrium the opening lies within the open free edge, less half a thickness of
    # 0.75 x 1.3 mm along its rim.
    edge = model.valve.surface.vertices[model.valve.free_edge, :2]
    rim = np.roll(edge, -1, axis=0)
    lens = 0.5 * abs(np.sum(edge[:, 0] * rim[:, 1] - edge[:, 1] * rim[:, 0]))
    around = np.linalg.norm(rim - edge, axis=1).sum()
    assert 100 < lens < 130
    assert lens - 0.49 * around < first["orifice"] < lens


def test_chordae_are_measured_with_the_factors_of_the_run(closing):
    model, result, steps = closing
    chordae, cables = model.valve.chordae, result.system.cables
    c, branch = len(chordae.insertion), chordae.parent[:, None] >= 0
    for step in (0, -1):
        x, tips = result.simulation.frames[step], model.valve.papillary_tips
        ends = np.concatenate([cables.patches(x), cables.state(x, tips, 2.0, 0.95).end[c:]])
        starts = np.where(branch, ends[c + chordae.parent], tips[chordae.tip])
        span = np.linalg.norm(ends - starts, axis=1)
        strain = span / (0.95 * chordae.rest_length) - 1
        force = 2.0 * chordae.axial_stiffness * cable_force(strain, chordae.toe_strain)[0]
        assert steps[step]["chord strain"] == pytest.approx(strain.max(), rel=1e-12)
        assert steps[step]["chord force"] == pytest.approx(force.max(), rel=1e-9)
    assert steps[-1]["chord force"] > 0.1
