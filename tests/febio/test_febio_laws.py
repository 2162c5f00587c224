"""Laws as FEBio has them, worked out here by its formulas."""

import numpy as np
import pytest

from mvest.errors import InputError
from mvest.febio.laws import febio_law
from mvest.mechanics.law.exponential import ExponentialLaw
from mvest.mechanics.law.moduli import PoissonReading, TransverselyIsotropic
from mvest.mechanics.settings import ExponentialTissue

A = TransverselyIsotropic.from_ratio(6.23, 2.651, 0.488, PoissonReading.LITERAL)
C = TransverselyIsotropic.from_ratio(6.23, 2.651, 0.488, PoissonReading.NEARLY_INCOMPRESSIBLE)
REST = np.zeros((1, 1, 6))


def stretched(seed=0, size=0.15):
    """A symmetric deformation gradient far from the reference."""
    h = np.random.default_rng(seed).uniform(-size, size, (3, 3))
    return np.eye(3) + 0.5 * (h + h.T)


def invariants(c):
    return {
        "I1": np.trace(c),
        "I2": 0.5 * (np.trace(c) ** 2 - np.trace(c @ c)),
        "I4": c[0, 0],
        "I5": (c @ c)[0, 0],
        "J": np.sqrt(np.linalg.det(c)),
    }


def energy_of(expression, values):
    functions = {"sqrt": np.sqrt, "exp": np.exp, "H": lambda x: float(x > 0)}
    return eval(expression.replace("^", "**"), {"__builtins__": {}}, {**functions, **values})


def stress_by_differences(energy, c, step=1e-5):
    """S = 2 dW/dC as a six-vector."""
    out = []
    for i, j in ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1)):
        d = np.zeros((3, 3))
        d[i, j] += 0.5
        d[j, i] += 0.5
        out.append((energy(c + step * d) - energy(c - step * d)) / step)
    return np.array(out)


def green(c):
    e = 0.5 * (c - np.eye(3))
    return np.array([[[e[0, 0], e[1, 1], e[2, 2], 2 * e[1, 2], 2 * e[0, 2], 2 * e[0, 1]]]])


@pytest.mark.parametrize("material", [A, C])
def test_the_orthotropic_stiffness_is_the_same(material):
    p = febio_law(material, "orthotropic").parameters
    # FEOrthoElastic::EvaluateLameCoefficients: the compliance that it inverts.
    s = np.array(
        [
            [1 / p["E1"], -p["v12"] / p["E1"], -p["v31"] / p["E3"]],
            [-p["v12"] / p["E1"], 1 / p["E2"], -p["v23"] / p["E2"]],
            [-p["v31"] / p["E3"], -p["v23"] / p["E2"], 1 / p["E3"]],
        ]
    )
    np.testing.assert_allclose(np.linalg.inv(s), material.stiffness[:3, :3], rtol=1e-12)
    shear = [p["G23"], p["G31"], p["G12"]]
    np.testing.assert_allclose(shear, np.diag(material.stiffness)[3:], rtol=1e-12)


def test_the_exponential_is_the_same_where_the_volume_is():
    tissue = ExponentialTissue(0.02, 4.0, 300.0)
    law = febio_law(tissue)
    f = stretched(1, 0.1)
    f /= np.cbrt(np.linalg.det(f))
    c = f.T @ f
    ours = ExponentialLaw.of([tissue]).response(green(c), np.zeros(1, int), REST, 0.0)[0][0, 0]

    def energy(x):
        values = invariants(x)
        volume = values["J"]
        values |= {"I1": values["I1"] * volume ** (-2 / 3)}
        bulk = law.parameters["k"] / 4 * (volume**2 - 1 - 2 * np.log(volume))
        return energy_of(law.parameters["W"], values) + bulk

    np.testing.assert_allclose(stress_by_differences(energy, c), ours, rtol=1e-5, atol=1e-7)


def test_an_unknown_law_is_refused():
    with pytest.raises(InputError, match="orthotropic, neo-hookean"):
        febio_law(A, "mooney")
