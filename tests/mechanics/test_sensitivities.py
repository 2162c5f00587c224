"""Direct differentiation against central differences of whole runs, with a study of the step."""

import numpy as np
import pytest

from mvest.errors import InputError
from mvest.mechanics.integrate import NewtonSettings, Step, simulate
from mvest.mechanics.system import Factors, Parameter
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


def run(values, contact, parameters=()):
    v = dict(zip(NAMES, values, strict=True))
    system, loading = sandwich(
        (v["E_f.lower"], v["E_f.upper"]),
        Factors(v["pressure_scale"], v["chord_stiffness"], v["chord_rest_length"]),
        contact=contact,
        samples=11,
    )
    newton = NewtonSettings(tolerance=1e-13, smallest_move=1e-13)
    result = simulate(system, loading, STEPS, newton=newton, parameters=parameters)
    assert result.converged
    assert all(r.halvings == 0 for r in result.records)
    return result


@pytest.mark.parametrize("contact", [False, True], ids=["cables", "cables and contact"])
def test_sensitivities_agree_with_central_differences(contact):
    # Dynamic steps with damping (history of strain, velocity, position), then a static step. The
    # difference's own error falls as h^2 until round-off, so the right derivative is met to 1e-6 at
    # the small step and with ratio 16 between steps h and h/4; a missing history or load term leaves
    # an error that does not fall.
    values = np.array([TRUE[n] for n in NAMES])
    result = run(values, contact, [Parameter(n, TRUE[n]) for n in NAMES])
    if contact:
        assert min(r.active_contacts for r in result.records[2:]) > 20
    for k, name in enumerate(NAMES):
        errors = []
        for relative in (4e-3, 1e-3, 1e-4):
            h = relative * values * (np.arange(len(NAMES)) == k)
            ahead, behind = run(values + h, contact).frames, run(values - h, contact).frames
            difference = (ahead - behind) / (2 * h[k])
            exact = result.sensitivities[:, k]
            # Relative to the size of the derivative in each frame after the start.
            size = np.linalg.norm(exact[1:], axis=(1, 2))
            assert size.min() > 0
            errors.append(np.linalg.norm((difference - exact)[1:], axis=(1, 2)) / size)
        assert errors[2].max() < 1e-6, name
        ratio = errors[0].max() / errors[1].max()
        assert ratio == pytest.approx(16, rel=0.25), name


def test_sensitivities_do_not_change_the_run_and_have_their_shape():
    values = [TRUE[n] for n in NAMES]
    plain = run(values, False)
    both = run(values, False, [Parameter(n, TRUE[n]) for n in NAMES])
    np.testing.assert_array_equal(plain.frames, both.frames)
    assert both.sensitivities.shape == (len(STEPS) + 1, len(NAMES), *plain.frames.shape[1:])
    assert plain.sensitivities.shape == (len(STEPS) + 1, 0, *plain.frames.shape[1:])
    assert np.all(both.sensitivities[0] == 0)


@pytest.mark.parametrize(
    ("name", "message"),
    [("E_f.middle", "unknown region.*lower, upper"), ("viscosity", "known: E_f.REGION, pressure")],
)
def test_an_unknown_parameter_names_the_known_ones(name, message):
    with pytest.raises(InputError, match=message):
        run(list(TRUE.values()), False, [Parameter(name, 1.0)])
