"""Direct differentiation against central differences of whole runs, with a study of the step."""

import numpy as np
import pytest

from mvest.errors import InputError
from mvest.mechanics.integrate import simulate
from mvest.mechanics.parameters import Parameter
from mvest.mechanics.steps import NewtonSettings, Step
from mvest.mechanics.system import Factors
from tests.mechanics.bodies import sandwich

TRUE = {
    "E_f.lower": 0.6,
    "E_f.upper": 0.5,
    "pressure_scale": 1.1,
    "chord_stiffness": 0.9,
    "chord_rest_length": 1.02,
}
NAMES = tuple(TRUE)
STEPS = [Step(t) for t in (0.02, 0.04, 0.06, 0.1, 0.2)] + [Step(1.2, static=True)]


NEWTON = NewtonSettings(tolerance=1e-13, smallest_move=1e-13)


def system_of(values, contact=True):
    v = dict(zip(NAMES, values, strict=True))
    return sandwich(
        (v["E_f.lower"], v["E_f.upper"]),
        Factors(v["pressure_scale"], v["chord_stiffness"], v["chord_rest_length"]),
        contact=contact,
        cells=2,
        samples=11,
    )


def run(values, parameters=(), contact=True):
    system, loading = system_of(values, contact)
    result = simulate(system, loading, STEPS, newton=NEWTON, parameters=parameters)
    assert result.converged
    assert all(r.halvings == 0 for r in result.records)
    return result


@pytest.fixture(scope="module")
def reference():
    result = run(TRUE.values(), [Parameter(n, TRUE[n]) for n in NAMES])
    assert min(r.active_contacts for r in result.records[2:]) > 20
    return result


@pytest.mark.parametrize("name", NAMES)
def test_sensitivities_agree_with_central_differences(reference, name):
    # Dynamic steps with damping (history of strain, velocity, position), then a static step, with
    # cables taut and contact active. The error of central differences falls as h^2, so from h to
    # h/4 its ratio is 16, and the extrapolation (16 D(h/4) - D(h)) / 15 removes it. A missing
    # history or load term leaves an error that does not fall.
    values = np.array([TRUE[n] for n in NAMES])
    k = NAMES.index(name)
    exact = reference.sensitivities[1:, k]
    size = np.linalg.norm(exact, axis=(1, 2))
    assert size.min() > 0
    differences = []
    # The chords' stiffness is nearly linear: larger steps keep its error above the round-off.
    coarse = 1e-2 if name == "chord_stiffness" else 1.6e-3
    for relative in (coarse, coarse / 4):
        h = np.zeros(len(NAMES))
        h[k] = relative * values[k]
        ahead, behind = run(values + h).frames, run(values - h).frames
        differences.append((ahead - behind)[1:] / (2 * h[k]))
    errors = [(np.linalg.norm(d - exact, axis=(1, 2)) / size).max() for d in differences]
    assert errors[0] / errors[1] == pytest.approx(16, rel=0.1)
    best = (16 * differences[1] - differences[0]) / 15
    # Relative to the size of the derivative, in every frame after the start.
    assert (np.linalg.norm(best - exact, axis=(1, 2)) / size).max() < 1e-6


def test_an_unknown_region_is_told_the_known_ones():
    with pytest.raises(InputError, match=r"unknown region.*lower, upper"):
        run(TRUE.values(), [Parameter("E_f.middle", 1.0)], contact=False)


def test_derivatives_of_the_last_frame_alone_are_the_same(reference):
    # An equilibrium has no history, so that nothing before the last, static step needs to be
    # differentiated.
    system, loading = system_of(TRUE.values())
    result = simulate(
        system,
        loading,
        STEPS,
        newton=NEWTON,
        parameters=[Parameter(n, TRUE[n]) for n in NAMES],
        final_only=True,
    )
    np.testing.assert_allclose(result.frames[-1], reference.frames[-1], atol=1e-9)
    size = np.abs(reference.sensitivities[-1]).max(axis=(1, 2), keepdims=True)
    difference = result.sensitivities[-1] - reference.sensitivities[-1]
    assert np.abs(difference / size).max() < 1e-7
